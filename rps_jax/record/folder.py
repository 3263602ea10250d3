"""Run folders: what was asked, and who may write there now."""

import contextlib
import json
import reprlib
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from rps_jax.errors import InputError
from rps_jax.record import files

MANIFEST = "manifest.json"  # of a run that can be continued


def remove_run(folder: Path) -> None:
    """Remove the run that a folder holds, and nothing else; InputError if it is in use."""
    for inner in sorted(folder.rglob(MANIFEST)):  # runs in its folders, as of models
        if inner.parent != folder:
            remove_run(inner.parent)
    if not (folder / MANIFEST).exists():
        return
    ensure_writable(folder)
    with lock(folder):
        try:
            shutil.rmtree(folder / "parts", ignore_errors=True)
            for name in (MANIFEST, "results.nc", "points.nc", "environment.json"):
                for path in (folder / name, folder / f"{name}.sha256"):
                    path.unlink(missing_ok=True)
        except OSError as error:
            raise InputError(
                f"out = {folder} cannot be removed ({error.strerror}): choose another folder."
            ) from error


def ensure_writable(folder: Path) -> Path:
    """The folder, made if need be; InputError if it cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(
            f"out = {folder} cannot be written ({error.strerror}): choose a writable folder."
        ) from error
    return folder


def claim(folder: Path, wanted: dict[str, Any]) -> Path:
    """The folder of a run that can be continued, with its configuration as `manifest.json`."""
    ensure_writable(folder)
    wanted = json.loads(json.dumps(wanted))
    with lock_briefly(folder):
        if not (folder / MANIFEST).exists():
            files.write_json(folder / MANIFEST, wanted, checked=True)
        elif (found := files.read_checked_json(folder / MANIFEST)) != wanted:
            raise InputError(
                f"out = {folder} holds another run ({describe_difference(found, wanted)}): choose "
                "another folder, ask for the same, or pass --overwrite."
            )
    return folder


def lock_briefly(folder: Path) -> FileLock:
    """A lock for the moment of a look and a note, for which other processes wait.

    Like every lock here it is let go by the operating system when its process is killed.
    """
    return FileLock(folder / ".lock", poll_interval=0.01)


@contextlib.contextmanager
def lock(folder: Path, number: int = 1, of: int = 1) -> Iterator[None]:
    """Hold a run folder, or one of several equal shares of it; InputError if others do."""
    with contextlib.ExitStack() as held:
        with lock_briefly(folder):
            for path in folder.glob(".lock-*-*"):
                if not path.name.endswith(f"-{of}"):
                    _seize(path, folder).release()
            held.callback(_seize(folder / f".lock-{number}-{of}", folder).release)
        yield


def _seize(path: Path, folder: Path) -> FileLock:
    lock = FileLock(path, timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise InputError(
            f"out = {folder} is in use by another process: wait for its end, or choose another "
            "folder."
        ) from error
    return lock


def read_manifest(folder: Path) -> dict[str, Any]:
    """The configuration of the run in a folder; InputError if there is none, or it is corrupt."""
    return files.read_checked_json(folder / MANIFEST)


_SHORT = reprlib.Repr()
_SHORT.maxlevel = 1


def describe_difference(found: Any, wanted: Any) -> str:
    """The first few differences of two JSON values, in words."""
    differences = list(_differences(found, wanted, ""))
    more = f" and {len(differences) - 3} more" if len(differences) > 3 else ""
    return "; ".join(differences[:3]) + more


def _differences(found: Any, wanted: Any, path: str) -> Iterator[str]:
    if isinstance(found, dict) and isinstance(wanted, dict):
        for key in [*found, *(k for k in wanted if k not in found)]:
            there, asked = (side.get(key, "nothing") for side in (found, wanted))
            yield from _differences(there, asked, f"{path}.{key}" if path else key)
    elif found != wanted:
        yield f"{path} = {_SHORT.repr(found)} there, {_SHORT.repr(wanted)} asked for"
