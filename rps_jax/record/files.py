"""Files that are written whole or not at all, some with a checksum; nothing is ever pickled.

The checksum of a file is in NAME.sha256, as `sha256sum` writes and checks it. Readers compare it
first, since HDF5 never returns for some damaged files.

A writer removes the old checksum, renames the new file, and then adds the new checksum. A killed
process leaves the old file or the new one, whole, with its own checksum or with none, but never
with that of the other. A file without a checksum is read unchecked, as older versions had none.
"""

import contextlib
import hashlib
import io
import json
import operator
import os
import stat
import zipfile
import zlib
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike

from rps_jax.errors import InputError, one_line, require

FileKind = Literal["json", "yaml", "image", "python", "xml", "policy", "table", "part", "results"]
_MAX_PART = 2**33  # [bytes]
_KINDS: dict[FileKind, tuple[int, str]] = {  # greatest size [bytes], and a description
    "json": (2**26, "a JSON file"),
    "yaml": (2**20, "a YAML file"),
    "image": (2**28, "an image as PGM or PNG"),
    "python": (2**22, "a Python file"),
    "xml": (2**24, "an MJCF file"),
    "policy": (2**28, "a policy's FILE.npz"),
    "table": (2**28, "a table FILE.csv"),
    "part": (_MAX_PART, "the folder of a run"),
    "results": (2**37, "a file of results"),
}
POINTER = b"version https://"  # first bytes of a pointer of Git LFS
FETCH = "it is a pointer of Git LFS: fetch the file itself by `git lfs pull`"
FIELD_FILES = (".json", ".yaml", ".yml")  # suffixes of files with names and values
_SAMPLE = 4096  # values of a column of results
_COMPRESSION = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
Arrays = dict[str, np.ndarray]  # by name
JsonObject = dict[str, Any]  # parsed JSON has values of any type


class MissingFileError(InputError):
    """A file that does not exist."""


class CorruptFileError(InputError):
    """A file, or another source, whose content cannot be decoded."""

    def __init__(self, source: object, reason: object) -> None:
        text = one_line(reason).rstrip(".")
        super().__init__(
            f"{source} is corrupt ({text}): restore it, or delete it and run the same command "
            "again."
        )


# --- writing --------------------------------------------------------------------------------


def write_atomically(path: Path, write: Callable[[Path], object]) -> Path:
    """Have `write` fill a temporary file, and rename that to `path`; an OSError names `path`."""
    partial = path.with_name(f".{path.stem}.partial{path.suffix}")
    try:
        partial.unlink(missing_ok=True)  # a pipe of this name would block
        write(partial)
        with open(partial, "rb+") as file:
            os.fsync(file.fileno())
        checksum_path(path).unlink(missing_ok=True)
        os.replace(partial, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        partial.unlink(missing_ok=True)
    return path


def write_text(path: Path, text: str) -> Path:
    """Write a text file in UTF-8 atomically; file names that are not UTF-8 keep their bytes."""
    return write_bytes(path, text.encode(errors="surrogateescape"))


def write_bytes(path: Path, content: bytes, *, checked: bool = False) -> Path:
    """Write a file atomically, with its checksum if `checked`."""
    write_atomically(path, lambda partial: partial.write_bytes(content))
    if checked:
        line = f"{sha256(content)}  {path.name}\n".encode()
        write_atomically(checksum_path(path), lambda partial: partial.write_bytes(line))
    return path


def write_csv(path: Path, table: pd.DataFrame) -> Path:
    """Write a table with its index; NaN is an empty cell."""
    return write_text(path, table.to_csv(lineterminator="\n"))


def write_json(path: Path, content: object, *, checked: bool = False) -> Path:
    """Write readable JSON in the order of its keys, with its checksum if `checked`."""
    return write_bytes(path, (json_text(content, 2) + "\n").encode(), checked=checked)


def json_text(content: object, indent: int | None = None) -> str:
    """Return content as JSON, with numbers of NumPy and JAX."""
    return json.dumps(content, indent=indent, default=operator.methodcaller("tolist"))


def write_results(path: Path, results: xr.Dataset) -> Path:
    """Write a NetCDF 4 file of labelled results, with its checksum."""
    return write_bytes(path, encode_results(results), checked=True)


def suffix_of(path: str | Path) -> str:
    """Return the suffix of a file name in lower case."""
    return Path(path).suffix.lower()


def checksum_path(path: Path) -> Path:
    """Return the path of the checksum of a file."""
    return path.with_name(f"{path.name}.sha256")


def sha256(content: bytes) -> str:
    """Return the SHA-256 in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


# --- reading --------------------------------------------------------------------------------


def read_regular(path: Path, kind: FileKind = "results") -> bytes:
    """Read a regular file of bounded size; nothing else is opened, so that nothing blocks.

    Raises:
      MissingFileError: it does not exist.
      InputError: it cannot be read, is no regular file, or is larger than files of its kind are.
    """
    max_bytes, description = _KINDS[kind]
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):
            raise ValueError("it is no regular file")
        if status.st_size > max_bytes:
            raise ValueError(f"it has more than {max_bytes / 2**20:.0f} MiB")
        with open(path, "rb") as file:
            content = file.read(status.st_size or 2**16)  # some files of the system have no size
    except (OSError, ValueError) as error:
        is_missing = isinstance(error, FileNotFoundError | NotADirectoryError)
        error_type = MissingFileError if is_missing else InputError
        reason = getattr(error, "strerror", error)
        raise error_type(f"{path} cannot be read ({reason}): give {description}.") from error
    if content.startswith(POINTER):
        raise InputError(f"{path} cannot be read: {FETCH}.")
    return content


def read_checked(path: Path, kind: FileKind = "results") -> bytes:
    """Read a file, and compare its checksum if it has one."""
    content, checksum = read_regular(path, kind), checksum_path(path)
    with contextlib.suppress(MissingFileError):  # there is no checksum
        if read_regular(checksum, "json").split(b" ")[0] != sha256(content).encode():
            if read_regular(path, kind) != content:  # another process has just replaced it
                return read_checked(path, kind)
            reason = f"{checksum.name} is of another content; delete that if the change was yours"
            raise CorruptFileError(path, reason)
    return content


def parse_json(content: bytes | str) -> JsonObject:
    """Parse a JSON object; ValueError if it is none, or has a name twice."""
    try:
        return _named_values(json.loads(content, object_pairs_hook=_unique))
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def _unique(pairs: Sequence[tuple[str, object]]) -> JsonObject:
    """Return names with values; ValueError if a name is repeated."""
    fields: JsonObject = {}
    for name, value in pairs:
        if name in fields:
            raise ValueError(f"it has {name} twice")
        fields[name] = value
    return fields


def _named_values(value: object) -> JsonObject:
    if not isinstance(value, dict):
        raise ValueError("it holds no names with values")
    return value


def read_json(path: Path) -> JsonObject:
    """Read a JSON object from a file that a user wrote; InputError if it is none."""
    content = read_regular(path, "json")
    try:
        return parse_json(content)
    except ValueError as error:
        raise InputError(f'{path} is no JSON object ({error}): write {{"name": value}}.') from error


def read_fields(path: Path) -> JsonObject:
    """Read names with values from a JSON or YAML file; its `image` is relative to the file."""
    if suffix_of(path) == ".json":
        fields = read_json(path)
    else:
        content, yaml = read_regular(path, "yaml"), require("ruamel.yaml", "bags")
        try:
            fields = _named_values(yaml.YAML(typ="safe", pure=True).load(content))
        except Exception as error:  # of any kind: the file is no mapping
            reason = one_line(error)
            raise InputError(f"{path} is no YAML mapping ({reason}): write name: value.") from error
    image = {"image": str(path.parent / str(fields["image"]))} if "image" in fields else {}
    return fields | image


def read_checked_json(path: Path) -> JsonObject:
    """Read a JSON object of a run folder; InputError if it is missing or corrupt."""
    try:
        content = read_checked(path, "json")
    except MissingFileError as error:
        fault = f"run = {path.parent} holds no {path.name}: give the folder of a run."
        raise InputError(fault) from error
    try:
        return parse_json(content)
    except ValueError as error:
        raise CorruptFileError(path, error) from error


def read_dataset(path: Path) -> xr.Dataset:
    """Read labelled results from a file; InputError if it is missing or corrupt."""
    return decode_results(read_checked(path), path)


def read_results(folder: Path) -> xr.Dataset:
    """Read the results of a run folder; InputError if they are missing or corrupt."""
    folder = Path(folder)
    path = folder / "results.nc"
    if not path.exists():
        inner = next((f", as {file.parent}" for file in sorted(folder.glob("*/results.nc"))), "")
        fault = f"run = {folder} holds no results.nc: give the folder of a finished run{inner}."
        raise InputError(fault)
    return read_dataset(path)


# --- results as bytes -----------------------------------------------------------------------


def encode_results(results: xr.Dataset) -> bytes:
    """Return a NetCDF 4 file that depends on the results alone, not on time or machine.

    It is built in memory, since HDF5 crashes the process when its disk is full.
    """
    # A view that Python's garbage collector finds first crashes Python before 3.12.2.
    encoding = {name: _packed(column.values) for name, column in results.variables.items()}
    with results.to_netcdf(engine="h5netcdf", encoding=encoding) as view:
        return bytes(view)


def _packed(values: np.ndarray) -> Mapping[str, object]:
    """Return the encoding of a column: compressed if that saves 15 %, by a sample."""
    if values.size < _SAMPLE:
        return {}
    if values.dtype.kind in "OU":
        return {"dtype": "S1"} | _COMPRESSION
    sample = np.ascontiguousarray(values.reshape(-1)[:_SAMPLE])
    bytes_of_sample = sample.view(np.uint8).reshape(_SAMPLE, -1)
    size = len(zlib.compress(bytes_of_sample.T.tobytes(), 1))
    return _COMPRESSION if size < 0.85 * bytes_of_sample.size else {}


def decode_results(content: bytes, source: object) -> xr.Dataset:
    """Return the results of `encode_results`, as xarray opens them; errors name the `source`."""
    try:
        with xr.open_dataset(io.BytesIO(content), engine="h5netcdf") as results:
            size = sum(variable.nbytes for variable in results.variables.values())
            if size > 1024 * len(content) + 2**20:  # HDF5 does not store values never written
                raise ValueError(f"it claims {size} bytes of numbers")
            results.load()
        names = [name for name, column in results.variables.items() if column.dtype.kind == "O"]
        results = results.assign({name: results[name].astype(str) for name in names})
    except Exception as error:  # of any kind, by HDF5 on damaged files
        raise CorruptFileError(source, error) from error
    return results


def check_columns(
    results: xr.Dataset,
    source: object,
    dims: Mapping[str, Sequence[str]],
    sizes: Mapping[Hashable, int],
) -> xr.Dataset:
    """Return the results of a source if they have numeric variables of these dimensions.

    Dimensions in `sizes` must have that length.
    """
    for name, expected in dims.items():
        if name not in results.variables:
            raise CorruptFileError(source, f"it lacks {name}")
        column = results.variables[name]
        lengths = {dim: sizes.get(dim, column.sizes.get(dim)) for dim in expected}
        if column.dtype.kind not in "biuf" or [*column.sizes.items()] != [*lengths.items()]:
            holds = f"{name} holds {column.dtype} of {dict(column.sizes)}"
            raise CorruptFileError(source, f"{holds}, not numbers of {lengths}")
    return results


def encode_arrays(**arrays: ArrayLike) -> bytes:
    """Return the content of a NumPy archive (.npz)."""
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **arrays)
    return content.getvalue()


def decode_arrays(content: bytes) -> Arrays:
    """Return the arrays of a NumPy archive (.npz) without pickled objects.

    Raises:
      ValueError: it is no such archive, is damaged, or would unpack to more than a part may have.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sum(member.file_size for member in archive.infolist()) > _MAX_PART:
                raise ValueError("it claims to hold more than such files do")
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except Exception as error:  # of any kind, by zipfile, zlib and NumPy on damaged files
        raise ValueError(str(error) or type(error).__name__) from error
