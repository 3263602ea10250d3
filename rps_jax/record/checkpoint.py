"""Checkpoints: the finished parts of a run, which are not run again when it is continued."""

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

    The digest is of the file's content and is compared before anything else looks at the file. A
    file that is not what was written is set aside, as `*.corrupt`, and its part is as if it had
    never been finished.
    """

    run: Path

    @property
    def folder(self) -> Path:
        """Where the files are."""
        return self.run / "parts"

    def paths(self) -> dict[str, Path]:
        """The files of all parts, in the order of their names."""
        return {name: path for name, path, _ in self._sound()}

    def items(self, names: Container[str] | None = None) -> Iterator[tuple[str, bytes]]:
        """Names and contents of all parts, or of these, in the order of their names."""
        for name, _, content in self._sound(names):
            yield name, content

    def get(self, name: str) -> bytes | None:
        """The content of one part, if it is finished."""
        return next((content for _, content in self.items((name,))), None)

    def put(self, name: str, content: bytes, suffix: str = ".nc", *, new: bool = False) -> Path:
        """Write the file of a part, whole or not at all, and then remove what it had before.

        A process that is killed in between leaves both, of which the newer counts. Nothing is
        removed for a part that the caller knows to be `new`, which spares a look at the folder.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        older = [] if new else self._files((name,))
        path = self.folder / f"{name}-{files.sha256(content)[:_DIGITS]}{suffix}"
        files.write_bytes(path, content)
        for one in older:
            if one != path:
                one.unlink(missing_ok=True)
        return path

    def load_or_compute(self, name: str, make: Callable[[], xr.Dataset]) -> xr.Dataset:
        """The labelled results of a part, which are made and put if it is not finished."""
        if (content := self.get(name)) is None:
            content = files.encode_results(make().assign_attrs(part=name))
            self.put(name, content)
        found = files.decode_results(content, self.folder / name, own=True)
        if found.attrs.pop("part", None) != name:
            raise files.CorruptFileError(self.folder / name, "it holds another part")
        return found

    def _files(self, names: Container[str] | None = None) -> list[Path]:
        """Files of some parts, or of all, by name, and of one name the newest first."""
        found = []
        for path in self.folder.glob("*-*"):
            whole = path.name[0] != "." and path.suffix != ".corrupt"
            if whole and (names is None or _name(path) in names):
                with contextlib.suppress(FileNotFoundError):  # another process has set it aside
                    found.append((_name(path), -path.stat().st_mtime_ns, path))
        return [path for *_, path in sorted(found)]

    def _sound(self, names: Container[str] | None = None) -> Iterator[tuple[str, Path, bytes]]:
        """The newest sound file of every part, or of some: name, path and content."""
        last = None
        for path in self._files(names):
            if _name(path) != last and (content := _content(path)) is not None:
                last = _name(path)
                yield last, path, content


def _name(path: Path) -> str:
    return path.stem.rpartition("-")[0]


def _content(path: Path) -> bytes | None:
    """What was written into a file; None of one that is damaged, which is set aside, or gone."""
    with contextlib.suppress(FileNotFoundError):  # another process has set it aside
        with contextlib.suppress(InputError):  # no regular file, which is as good as damaged
            content = files.read_regular(path, "part")
            if files.sha256(content)[:_DIGITS] == path.stem.rpartition("-")[2]:
                return content
        path.replace(path.with_name(f"{path.name}.corrupt"))
    return None
