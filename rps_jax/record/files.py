"""Files written whole or not at all: text, JSON, and labelled results as NetCDF. No pickles."""

from __future__ import annotations

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


def corrupt(path: Path, why: Any) -> InputError:
    """The error for a file that cannot be understood."""
    reason = str(why).rstrip(".")
    return InputError(f"{path} is corrupt ({reason}): restore it, or choose another folder.")


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
