"""Checkpoints: the finished parts of a run, which are loaded when the run is continued."""

import contextlib
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from pathlib import Path

import xarray as xr

from rps_jax.errors import InputError
from rps_jax.record import files

_DIGITS = 16  # of the digest in a file's name


@dataclass(frozen=True)
class Checkpoints:
    """The finished parts of a run, each in a file `parts/NAME-DIGEST.SUFFIX` of its folder.

    The digest is of the file's content and is compared before anything else reads the file. A
    damaged file is renamed to `*.corrupt`, and its part counts as unfinished.
    """

    run: Path

    @property
    def folder(self) -> Path:
        """Folder of the files."""
        return self.run / "parts"

    def paths(self) -> dict[str, Path]:
        """Return the files of all parts, in the order of their names."""
        return {name: path for name, path, _ in self._valid()}

    def items(self, names: Container[str] | None = None) -> Iterator[tuple[str, bytes]]:
        """Return names and contents of all parts, or of some, in the order of their names."""
        return ((name, content) for name, _, content in self._valid(names))

    def get(self, name: str) -> bytes | None:
        """Return the content of one part; None if it is unfinished."""
        return next((content for _, content in self.items((name,))), None)

    def put(self, name: str, content: bytes, suffix: str = ".nc", *, new: bool = False) -> Path:
        """Write the file of a part atomically, and then remove its earlier files.

        A process that is killed in between leaves both, of which the newer counts. For a `new` part
        the folder is not searched for earlier files.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        earlier = [] if new else self._files((name,))
        path = self.folder / f"{name}-{files.sha256(content)[:_DIGITS]}{suffix}"
        files.write_bytes(path, content)
        for old in earlier:
            if old != path:
                old.unlink(missing_ok=True)
        return path

    def load_or_compute(self, name: str, compute: Callable[[], xr.Dataset]) -> xr.Dataset:
        """Load the results of a part; compute and store them if it is unfinished."""
        if (content := self.get(name)) is None:
            content = files.encode_results(compute().assign_attrs(part=name))
            self.put(name, content)
        results = files.decode_results(content, self.folder / name)
        if results.attrs.pop("part", None) != name:
            raise files.CorruptFileError(self.folder / name, "it holds another part")
        return results

    def _files(self, names: Container[str] | None = None) -> list[Path]:
        """Return the files of all parts, or of some, by name, and the newest of a name first."""
        entries = []
        for path in self.folder.glob("*-*"):
            complete = path.name[0] != "." and path.suffix != ".corrupt"
            if complete and (names is None or _part_name(path) in names):
                with contextlib.suppress(FileNotFoundError):  # another process has renamed it
                    entries.append((_part_name(path), -path.stat().st_mtime_ns, path))
        return [path for *_, path in sorted(entries)]

    def _valid(self, names: Container[str] | None = None) -> Iterator[tuple[str, Path, bytes]]:
        """Yield name, path and content of the newest valid file of all parts, or of some."""
        last = None
        for path in self._files(names):
            name = _part_name(path)
            if name != last and (content := _valid_content(path)) is not None:
                last = name
                yield name, path, content


def _part_name(path: Path) -> str:
    return path.stem.rpartition("-")[0]


def _valid_content(path: Path) -> bytes | None:
    """Return the content of a file; rename a damaged one and return None."""
    with contextlib.suppress(InputError):  # a pipe or the like counts as damaged
        content = files.read_regular(path, "part")
        if files.sha256(content)[:_DIGITS] == path.stem.rpartition("-")[2]:
            return content
    with contextlib.suppress(FileNotFoundError):  # another process has renamed it
        path.replace(path.with_name(f"{path.name}.corrupt"))
    return None
