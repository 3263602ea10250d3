"""Run folders: what was asked, what it ran on, and labelled results. Nothing is ever pickled."""

from __future__ import annotations

import contextlib
import fcntl
import importlib.metadata
import json
import os
import platform
import reprlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import xarray as xr

from rps_jax.errors import InputError

MANIFEST = "manifest.json"  # of a run that can be continued
CONFIG = "config.json"  # of one that cannot
ENVIRONMENT = "environment.json"
_PACKAGES = (
    *("rps_jax", "jax", "jaxlib", "mujoco", "mujoco-mjx", "warp-lang"),
    *("numpy", "scipy", "xarray"),
)


def prepare(folder: Path, *, overwrite: bool = False) -> Path:
    """The folder of a new run, made if need be and tried for writing.

    Raises:
      InputError: it cannot be written, or holds a run already and `overwrite` is off.
    """
    if (folder / MANIFEST).exists():
        raise InputError(
            f"out = {folder} holds a run that can be continued: choose another folder."
        )
    if (folder / CONFIG).exists() and not overwrite:
        raise InputError(
            f"out = {folder} already holds a run: choose another folder or pass --overwrite."
        )
    return writable(folder)


def writable(folder: Path) -> Path:
    """The folder, made if need be and tried for writing.

    Raises:
      InputError: it cannot be written.
    """
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
    """The folder of a run that can be continued, with its configuration as `manifest.json`.

    Raises:
      InputError: it cannot be written, or holds a run of another configuration.
    """
    writable(folder)
    if (folder / CONFIG).exists():
        raise InputError(f"out = {folder} holds another run: choose another folder.")
    wanted = json.loads(json.dumps(wanted))
    with _alone(folder):
        if not (folder / MANIFEST).exists():
            write_json(folder / MANIFEST, wanted)
        elif (found := manifest(folder)) != wanted:
            raise InputError(
                f"out = {folder} holds another run ({difference(found, wanted)}): choose another "
                "folder, or ask for the same."
            )
    return folder


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """For the moment of a look and a note other processes wait."""
    with open(folder / ".lock", "a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


@contextlib.contextmanager
def hold(folder: Path, number: int = 1, of: int = 1) -> Iterator[None]:
    """Hold a run folder, or one of several equal shares of it, against other processes.

    Raises:
      InputError: another process holds it, or shares it otherwise.
    """
    own = folder / f".lock-{number}-{of}"
    with open(own, "a") as file:
        with _alone(folder):
            for path in folder.glob(".lock-*-*"):
                if not path.name.endswith(f"-{of}"):
                    with open(path, "a") as other:
                        _seize(other, folder)  # and let go at once
            _seize(file, folder)
        yield


def _seize(file: IO[str], folder: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise InputError(
            f"out = {folder} is in use by another process: wait for its end, or choose another "
            "folder."
        ) from error


def manifest(folder: Path) -> dict[str, Any]:
    """The configuration of the run in a folder.

    Raises:
      InputError: there is none, or it is corrupt.
    """
    return _noted(folder, MANIFEST)


def _noted(folder: Path, name: str) -> dict[str, Any]:
    path = folder / name
    try:
        found = json.loads(path.read_text())
    except (FileNotFoundError, NotADirectoryError) as error:
        raise InputError(f"run = {folder} holds no {name}: give the folder of a run.") from error
    except ValueError as error:
        raise corrupt(path, error) from error
    if not isinstance(found, dict):
        raise corrupt(path, "it holds no names with values")
    return found


def corrupt(path: Path, why: Any) -> InputError:
    """The error for a file that cannot be understood."""
    reason = str(why).rstrip(".")
    return InputError(f"{path} is corrupt ({reason}): restore it, or choose another folder.")


def difference(found: Any, wanted: Any) -> str:
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
        yield f"{path} = {reprlib.repr(found)} there, {reprlib.repr(wanted)} asked for"


def atomic(path: Path, write: Callable[[Path], Any]) -> Path:
    """Have `write` fill a file beside `path`, then put it in place whole.

    Raises:
      OSError: it cannot be written; the error names `path`, and nothing is left behind.
    """
    partial = path.with_name(f".{path.stem}.partial{path.suffix}")
    try:
        write(partial)
        with open(partial, "rb") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        partial.unlink(missing_ok=True)
    return path


def write_json(path: Path, content: Any) -> Path:
    """Readable JSON, keys in the order given."""
    text = json.dumps(content, indent=2, allow_nan=True) + "\n"
    return write_text(path, text)


def write_text(path: Path, text: str) -> Path:
    """A text file, whole or not at all."""
    return atomic(path, lambda partial: partial.write_text(text))


def write_bytes(path: Path, content: bytes) -> Path:
    """A file of this content, whole or not at all."""
    return atomic(path, lambda partial: partial.write_bytes(content))


def write_results(path: Path, results: xr.Dataset) -> Path:
    """A NetCDF 4 file of labelled results."""
    return write_bytes(path, encoded(results))


def encoded(results: xr.Dataset) -> bytes:
    """NetCDF 4, which depends on the results alone, not on when or where it is made.

    It is made in memory, since HDF5 crashes the process when its disk is full.
    """
    return bytes(results.to_netcdf(engine="h5netcdf"))


def read_results(folder: Path) -> xr.Dataset:
    """The results of a run folder.

    Raises:
      InputError: the folder holds no results, or its file cannot be read.
    """
    path = Path(folder) / "results.nc"
    if not path.exists():
        raise InputError(f"run = {folder} holds no results.nc: give the folder of a finished run.")
    return read(path)


def read(path: Path) -> xr.Dataset:
    """The labelled results of one file.

    Raises:
      InputError: it cannot be read.
    """
    try:
        return xr.load_dataset(path, engine="h5netcdf")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise InputError(f"{path} is corrupt ({error}): run again, or restore it.") from error


def environment() -> dict[str, Any]:
    """Versions, device, commit and command of this process."""
    import jax

    device = jax.devices()[0]
    return {
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "commit": commit(),
        "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processors": os.cpu_count(),
        "device": {
            "platform": device.platform,
            "kind": device.device_kind,
            "count": jax.device_count(),
        },
        "x64": bool(jax.config.jax_enable_x64),
        "packages": {name: _version(name) for name in _PACKAGES},
    }


def sign(folder: Path, signed: Mapping[str, Any] | None = None) -> None:
    """Note in `environment.json` on what a run, or some of it, is made: by default by this process.

    What it was made on before stays there, under `before`, if anything but the time differs.
    """
    new = dict(signed or environment())
    with _alone(folder):
        earlier = []
        if (folder / ENVIRONMENT).exists():
            old = _noted(folder, ENVIRONMENT)
            earlier = [*old.pop("before", []), old]
        earlier = [*new.pop("before", []), *earlier]
        others = [one for one in earlier if not _same(one, new)]
        write_json(folder / ENVIRONMENT, new | ({"before": others} if others else {}))


def signed(folder: Path) -> dict[str, Any]:
    """What `sign` noted.

    Raises:
      InputError: there is nothing, or it is corrupt.
    """
    return _noted(folder, ENVIRONMENT)


def _same(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether it is one process, whose workers may have become more, or another all like it."""
    process = all(one.get(name) == other.get(name) for name in ("time", "command"))
    differ = {name for name in (*one, *other) if one.get(name) != other.get(name)}
    return process or differ <= {"time", "workers", "before"}


def told(folder: Path) -> str:
    """What `sign` noted, in words."""
    found = signed(folder)
    try:
        last, *before = (
            f"`{' '.join(one['command'])}`, commit {one['commit']}, {one['time']}, on "
            f"{one['device']['kind']} with {one['processors']} processors, jax "
            f"{one['packages']['jax']}, mujoco {one['packages']['mujoco']}"
            for one in (found, *reversed(found.get("before", [])))
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise corrupt(folder / ENVIRONMENT, error) from error
    return f"Made by {'; before that by '.join([last, *before])}."


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def commit() -> str | None:
    """The git commit of the checkout this code runs from, marked if changed; None elsewhere."""
    here = Path(__file__).resolve().parent.parent

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", "-C", str(here), *arguments],
            capture_output=True,
            text=True,
            check=True,
            timeout=10,
        ).stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")) != here.parent:
            return None
        return git("rev-parse", "HEAD") + (
            "-changed" if git("status", "--porcelain", "-uno") else ""
        )
    except (OSError, subprocess.SubprocessError):
        return None
