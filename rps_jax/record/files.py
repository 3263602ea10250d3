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
import os
import stat
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike

from rps_jax.errors import InputError

FileKind = Literal["json", "python", "xml", "policy", "part", "results"]
MAX_BYTES: dict[FileKind, int] = {
    "json": 2**26,
    "python": 2**22,
    "xml": 2**24,
    "policy": 2**28,
    "part": 2**33,
    "results": 2**37,
}
JsonObject = dict[str, Any]  # parsed JSON has values of any type
_STRUCTURE = "structure"  # attribute of a NetCDF file
_MAX_DEPTH = 32  # levels of nested JSON
_FILE_TYPES = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


class CorruptFileError(InputError):
    """A file, or another source, whose content cannot be decoded."""

    def __init__(self, source: object, reason: object) -> None:
        text = " ".join(str(reason).split()).rstrip(".")
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


def write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> Path:
    """Write a table, whose header has the names of all rows; None and NaN are empty cells."""
    return write_text(path, pd.DataFrame(list(rows)).to_csv(index=False, lineterminator="\n"))


def write_json(path: Path, content: object, *, checked: bool = False) -> Path:
    """Write readable JSON in the order of its keys, with its checksum if `checked`."""
    text = json.dumps(content, indent=2, allow_nan=True) + "\n"
    return write_bytes(path, text.encode(), checked=checked)


def write_results(path: Path, results: xr.Dataset) -> Path:
    """Write a NetCDF 4 file of labelled results, with its checksum."""
    return write_bytes(path, encode_results(results), checked=True)


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
      OSError: it does not exist, or cannot be read.
      InputError: it is a folder, a pipe or a device, or larger than files of its kind are.
    """
    try:
        status = os.stat(path)
    except ValueError as error:
        raise InputError(f"{str(path)!r} is no path ({error}).") from error
    if not stat.S_ISREG(status.st_mode):
        file_type = _FILE_TYPES.get(stat.S_IFMT(status.st_mode), "no regular file")
        raise InputError(f"{path} cannot be read (it is {file_type}): give a regular file.")
    if status.st_size > MAX_BYTES[kind]:
        raise InputError(
            f"{path} is too large: a {kind} file has at most {MAX_BYTES[kind] / 2**20:.0f} MiB."
        )
    with open(path, "rb") as file:
        return file.read(status.st_size or 2**16)  # some files of the system have no size


def read_checked(path: Path, kind: FileKind = "results") -> bytes:
    """Read a file, and compare its checksum if it has one."""
    content, checksum = read_regular(path, kind), checksum_path(path)
    with contextlib.suppress(FileNotFoundError):  # there is no checksum
        if read_regular(checksum, "json").split(b" ")[0] != sha256(content).encode():
            if read_regular(path, kind) != content:  # another process has just replaced it
                return read_checked(path, kind)
            raise CorruptFileError(
                path, f"{checksum.name} is of another content; delete that if the change was yours"
            )
    return content


def parse_json(content: bytes | str) -> Any:
    """Parse JSON; ValueError if it is not JSON, or nested deeper than people write."""
    try:
        value = json.loads(content)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    level: list[object] = [value]
    for _ in range(_MAX_DEPTH):
        level = [inner for outer in level for inner in _children(outer)]
    if level:
        raise ValueError("it is nested too deeply")
    return value


def _children(value: object) -> Iterable[object]:
    if isinstance(value, dict):
        return value.values()
    return value if isinstance(value, list) else ()


def read_json(path: Path) -> JsonObject:
    """Read a JSON object from a file that a user wrote; InputError if it is none."""
    try:
        content = parse_json(read_regular(path, "json"))
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}): give a JSON file.") from error
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{path} is not JSON ({error}).") from error
    if not isinstance(content, dict):
        raise InputError(f'{path} holds no names with values: write {{"name": value}}.')
    return content


def read_checked_json(path: Path) -> JsonObject:
    """Read a JSON object of a run folder; InputError if it is missing or corrupt."""
    try:
        content = parse_json(read_checked(path, "json"))
    except (FileNotFoundError, NotADirectoryError) as error:
        raise InputError(
            f"run = {path.parent} holds no {path.name}: give the folder of a run."
        ) from error
    except InputError:
        raise
    except ValueError as error:
        raise CorruptFileError(path, error) from error
    if not isinstance(content, dict):
        raise CorruptFileError(path, "it holds no names with values")
    return content


def read_dataset(path: Path) -> xr.Dataset:
    """Read labelled results from a file; InputError if it is missing or corrupt."""
    try:
        content = read_checked(path)
    except OSError as error:
        raise InputError(
            f"{path} cannot be read ({error.strerror}): give a file of results."
        ) from error
    return decode_results(content, path)


def read_results(folder: Path) -> xr.Dataset:
    """Read the results of a run folder; InputError if they are missing or corrupt."""
    path = Path(folder) / "results.nc"
    if not path.exists():
        raise InputError(f"run = {folder} holds no results.nc: give the folder of a finished run.")
    return read_dataset(path)


# --- results as bytes -----------------------------------------------------------------------


def encode_results(results: xr.Dataset) -> bytes:
    """Return a NetCDF 4 file that depends on the results alone, not on time or machine.

    It is built in memory, since HDF5 crashes the process when its disk is full. An attribute holds
    the digest of its structure, by which `decode_results` notices edits.
    """
    signed = results.assign_attrs({_STRUCTURE: _structure(results)})
    # A view that Python's garbage collector finds first crashes Python before 3.12.2.
    with signed.to_netcdf(engine="h5netcdf") as view:
        return bytes(view)


def _structure(results: xr.Dataset) -> str:
    """Return the digest of the names, dimensions, sizes, types and units of all variables."""
    variables = []
    for name, variable in sorted(results.variables.items(), key=lambda item: str(item[0])):
        # Texts may have any length.
        dtype = "text" if variable.dtype.kind in "OUST" else variable.dtype.str
        unit = variable.attrs.get("units", "")
        variables.append((str(name), variable.dims, variable.shape, dtype, unit))
    return sha256(repr(variables).encode())[:16]


def decode_results(content: bytes, source: object, *, signed: bool = False) -> xr.Dataset:
    """Return the results of `encode_results`; errors name the `source`.

    If they must be `signed`, files without a digest of their structure are refused, too.
    """
    try:
        with xr.open_dataset(io.BytesIO(content), engine="h5netcdf") as results:
            size = sum(variable.nbytes for variable in results.variables.values())
            if size > 8 * len(content) + 2**20:  # HDF5 does not store values never written
                raise ValueError(f"it claims {size} bytes of numbers")
            results.load()
    except Exception as error:  # of any kind, by HDF5 on damaged files
        raise CorruptFileError(source, error) from error
    structure = results.attrs.pop(_STRUCTURE, None)
    if structure != _structure(results) and (signed or structure is not None):
        raise CorruptFileError(
            source, "its names, sizes, types or units are not those that were written"
        )
    return results


def check_columns(
    results: xr.Dataset,
    source: object,
    dims: Mapping[str, Sequence[str]],
    sizes: Mapping[Any, int],  # xarray's keys: any hashable
) -> xr.Dataset:
    """Return the results of a source if they have numeric variables of these dimensions.

    Dimensions in `sizes` must have that length.
    """
    for name, expected in dims.items():
        if name not in results.variables:
            raise CorruptFileError(source, f"it lacks {name}")
        column = results[name]
        if column.dims != tuple(expected):
            raise CorruptFileError(
                source, f"{name} has the dimensions {column.dims}, not {tuple(expected)}"
            )
        if column.dtype.kind not in "biuf":
            raise CorruptFileError(source, f"{name} holds {column.dtype}, not numbers")
        for dim in expected:
            if dim in sizes and column.sizes[dim] != sizes[dim]:
                raise CorruptFileError(
                    source, f"{dim} has the length {column.sizes[dim]}, not {sizes[dim]}"
                )
    return results


def check_like(results: xr.Dataset, template: xr.Dataset, source: object) -> xr.Dataset:
    """Return the results of a source if they have the variables and coordinates of a template."""
    if differing := sorted(map(str, {*template.variables} ^ {*results.variables})):
        name = differing[0]
        raise CorruptFileError(
            source, f"it {'holds' if name in results.variables else 'lacks'} {name}"
        )
    dims = {
        str(name): list(map(str, variable.dims))
        for name, variable in template.variables.items()
        if variable.dtype.kind in "biuf"
    }
    check_columns(results, source, dims, template.sizes)
    for name in template.coords:
        if not np.array_equal(results[name].values, template[name].values):
            raise CorruptFileError(source, f"{name} is of another run")
    return results


def encode_arrays(**arrays: ArrayLike) -> bytes:
    """Return the content of a NumPy archive (.npz)."""
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **arrays)
    return content.getvalue()


def decode_arrays(content: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of a NumPy archive (.npz) without pickled objects.

    Raises:
      ValueError: it is no such archive, is damaged, or would unpack to more than a part may have.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sum(member.file_size for member in archive.infolist()) > MAX_BYTES["part"]:
                raise ValueError("it claims to hold more than such files do")
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except Exception as error:  # of any kind, by zipfile, zlib and NumPy on damaged files
        raise ValueError(str(error) or type(error).__name__) from error
