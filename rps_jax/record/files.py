"""Files that are written whole or not at all, some with a checksum. Nothing is ever pickled.

The checksum of a file stands beside it in NAME.sha256, as `sha256sum` writes and checks it, and is
compared before anything else looks at the file: HDF5 hangs on some damaged files.

Whatever writes a file removes its old checksum, puts the file in place, and then adds the new
checksum. A process that is killed in between leaves the old file or the new one, whole, with its
own checksum or with none, but never with that of the other. A file without a checksum is read
unchecked, as are the files of older versions, which had none.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import xarray as xr

from rps_jax.errors import InputError


def atomic(path: Path, write: Callable[[Path], Any]) -> Path:
    """Have `write` fill a file beside `path`, then put it in place whole.

    Raises:
      OSError: it cannot be written; the error names `path`, and nothing is left behind.
    """
    partial = path.with_name(f".{path.stem}.partial{path.suffix}")
    try:
        write(partial)
        with open(partial, "rb+") as file:
            os.fsync(file.fileno())
        checksum(path).unlink(missing_ok=True)
        os.replace(partial, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        partial.unlink(missing_ok=True)
    return path


def write_text(path: Path, text: str) -> Path:
    """A text file, whole or not at all."""
    return write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes, *, checked: bool = False) -> Path:
    """A file of this content, whole or not at all; if `checked`, with its checksum."""
    atomic(path, lambda partial: partial.write_bytes(content))
    if checked:
        line = f"{digest(content)}  {path.name}\n".encode()
        atomic(checksum(path), lambda partial: partial.write_bytes(line))
    return path


def write_json(path: Path, content: Any, *, checked: bool = False) -> Path:
    """Readable JSON, keys in the order given; if `checked`, with its checksum."""
    text = json.dumps(content, indent=2, allow_nan=True) + "\n"
    return write_bytes(path, text.encode(), checked=checked)


def write_results(path: Path, results: xr.Dataset) -> Path:
    """A NetCDF 4 file of labelled results, with its checksum."""
    return write_bytes(path, encoded(results), checked=True)


def checksum(path: Path) -> Path:
    """The file that holds the checksum of another."""
    return path.with_name(f"{path.name}.sha256")


def digest(content: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def encoded(results: xr.Dataset) -> bytes:
    """NetCDF 4, which depends on the results alone, not on when or where it is made.

    It is made in memory, since HDF5 crashes the process when its disk is full.
    """
    return bytes(results.to_netcdf(engine="h5netcdf"))


def decoded(content: bytes, source: Any) -> xr.Dataset:
    """The labelled results that `encoded` made into bytes.

    Raises:
      InputError: the bytes, which came from `source`, are something else.
    """
    try:
        return xr.load_dataset(io.BytesIO(content), engine="h5netcdf")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise corrupt(source, error) from error


def read_bytes(path: Path) -> bytes:
    """The content of a file, compared with the checksum beside it, if there is one.

    Raises:
      InputError: the two differ.
    """
    content, beside = path.read_bytes(), checksum(path)
    with contextlib.suppress(FileNotFoundError):  # there is none
        if beside.read_bytes().split(b" ")[0] != digest(content).encode():
            if path.read_bytes() != content:  # another process has just written it anew
                return read_bytes(path)
            why = f"{beside.name} is of another content; delete that if the change was yours"
            raise corrupt(path, why)
    return content


def noted(path: Path) -> dict[str, Any]:
    """What a JSON file of a run folder says, by name.

    Raises:
      InputError: there is no such file, or it is corrupt.
    """
    try:
        content = read_bytes(path)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise InputError(
            f"run = {path.parent} holds no {path.name}: give the folder of a run."
        ) from error
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise corrupt(path, error) from error
    if not isinstance(found, dict):
        raise corrupt(path, "it holds no names with values")
    return found


def read(path: Path) -> xr.Dataset:
    """The labelled results of one file.

    Raises:
      InputError: it is not there, or it is corrupt.
    """
    try:
        content = read_bytes(path)
    except OSError as error:
        raise InputError(
            f"{path} cannot be read ({error.strerror}): give a file of results."
        ) from error
    return decoded(content, path)


def read_results(folder: Path) -> xr.Dataset:
    """The results of a run folder.

    Raises:
      InputError: the folder holds no results, or they are corrupt.
    """
    path = Path(folder) / "results.nc"
    if not path.exists():
        raise InputError(f"run = {folder} holds no results.nc: give the folder of a finished run.")
    return read(path)


def corrupt(source: Any, why: Any) -> InputError:
    """The error for a file, or another source, that cannot be understood."""
    reason = " ".join(str(why).split()).rstrip(".")
    return InputError(
        f"{source} is corrupt ({reason}): restore it, or delete it and run the same command again."
    )


def read_json(path: Path) -> dict[str, Any]:
    """Names with values from a JSON file that a user wrote.

    Raises:
      InputError: it cannot be read, or holds something else.
    """
    try:
        values = json.loads(path.read_text())
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}): give a JSON file.") from error
    except ValueError as error:
        raise InputError(f"{path} is not JSON ({error}).") from error
    if not isinstance(values, dict):
        raise InputError(f'{path} holds no names with values: write {{"name": value}}.')
    return values
