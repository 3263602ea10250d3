"""Run folders: their configuration, and locks against other processes."""

import contextlib
import json
import reprlib
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from filelock import FileLock, Timeout

from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.record.files import JsonObject

MANIFEST = "manifest.json"  # of a run that can be continued
_SOURCES = "sources"  # folder of copies of the files that a configuration names
_SHORT = reprlib.Repr()
_SHORT.maxlevel = 1


def remove_run(folder: Path) -> None:
    """Remove the runs in a folder, and nothing else; InputError if one is in use."""
    for manifest in sorted(folder.rglob(MANIFEST)):  # it may hold others, as of models
        run = ensure_writable(manifest.parent)
        with lock(run):
            try:
                for name in ("parts", _SOURCES):
                    shutil.rmtree(run / name, ignore_errors=True)
                for name in (MANIFEST, "results.nc", "points.nc", "environment.json"):
                    for path in (run / name, run / f"{name}.sha256"):
                        path.unlink(missing_ok=True)
            except OSError as error:
                fault = f"out = {run} cannot be removed ({error.strerror}): choose another folder."
                raise InputError(fault) from error


def ensure_writable(folder: Path) -> Path:
    """Return the folder, created if it is missing; InputError if it cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        fault = f"out = {folder} cannot be written ({error.strerror}): choose a writable folder."
        raise InputError(fault) from error
    return folder


def claim(folder: Path, configuration: JsonObject) -> Path:
    """Write the configuration of a run to its folder; InputError if it holds another run."""
    ensure_writable(folder)
    new = json.loads(files.json_text(configuration))
    with lock_briefly(folder):
        if not (folder / MANIFEST).exists():
            _copy_sources(folder, configuration)
            files.write_json(folder / MANIFEST, new, checked=True)
        elif words := difference(folder, configuration):
            raise InputError(
                f"out = {folder} holds another run ({words}): choose another folder, ask for the "
                "same, or remove it first by --overwrite (in Python overwrite=True)."
            )
    return folder


def difference(folder: Path, configuration: JsonObject) -> str:
    """Return how the run in a folder differs from a configuration, in words; "" without a run."""
    if not (folder / MANIFEST).exists():
        return ""
    stored = files.read_checked_json(folder / MANIFEST)
    return describe_difference(stored, json.loads(files.json_text(configuration)))


def sources(folder: Path, digest: str) -> Path:
    """Return the folder in a run's folder with copies of a source file and of its imports."""
    return folder / _SOURCES / digest


def _copy_sources(folder: Path, value: object) -> None:
    """Copy the files that a configuration names with their digests, and their imports."""
    if not isinstance(value, Mapping):
        return
    if {"file", "digest"} <= value.keys():
        file = Path(value["file"])
        for name in (file.name, *value.get("imports", ())):
            copy = sources(folder, value["digest"]) / name
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file.parent / name, copy)
    for item in value.values():
        _copy_sources(folder, item)


def lock_briefly(folder: Path) -> FileLock:
    """Return a lock for a read and a write, for which other processes wait.

    The operating system releases all locks of a process that is killed.
    """
    return FileLock(folder / ".lock", poll_interval=0.01)


@contextlib.contextmanager
def lock(folder: Path, shard: int = 1, shards: int = 1) -> Iterator[None]:
    """Lock a run folder, or one of its shards; InputError if another process has it locked."""
    with contextlib.ExitStack() as stack:
        with lock_briefly(folder):
            for path in folder.glob(".lock-*-*"):
                if not path.name.endswith(f"-{shards}"):
                    _acquire(path, folder).release()
            stack.callback(_acquire(folder / f".lock-{shard}-{shards}", folder).release)
        yield


def _acquire(path: Path, folder: Path) -> FileLock:
    file_lock = FileLock(path, timeout=0)
    try:
        file_lock.acquire()
    except Timeout as error:
        raise InputError(
            f"out = {folder} is in use by another process: wait for its end, or choose another "
            "folder."
        ) from error
    return file_lock


def read_manifest(folder: Path) -> JsonObject:
    """Return the configuration of the run in a folder; InputError if missing or corrupt."""
    return files.read_checked_json(folder / MANIFEST)


_ABSENT = {"drive": "omni"}  # values of fields that records of version 0.4 lack


def describe_difference(stored: object, new: object) -> str:
    """Return the first three differences of two JSON values, in words.

    A field of None and a missing one are equal: later versions have more fields.
    """
    differences = list(_differences(stored, new, ""))
    more = f" and {len(differences) - 3} more" if len(differences) > 3 else ""
    return "; ".join(differences[:3]) + more


def _differences(stored: object, new: object, path: str) -> Iterator[str]:
    if isinstance(stored, dict) and isinstance(new, dict):
        skipped = set()
        if "file" not in new and files.suffix_of(str(stored.get("file"))) == ".npz":
            skipped = {"file", "digest"}  # of a policy that is shipped now; its class has a digest
        for key in (key for key in {**stored, **new} if key not in skipped):
            absent = _ABSENT.get(key)
            pair = stored.get(key, absent), new.get(key, absent)
            yield from _differences(*pair, f"{path}.{key}" if path else key)
    elif stored != new:
        yield f"{path} = {_SHORT.repr(stored)} there, {_SHORT.repr(new)} asked for"
