"""Files that are written whole or not at all, some with a checksum. Nothing is ever pickled.

The checksum of a file stands beside it in NAME.sha256, as `sha256sum` writes and checks it, and is
compared before anything else looks at the file: HDF5 hangs on some damaged files.

Whatever writes a file removes its old checksum, puts the file in place, and then adds the new
checksum. A process that is killed in between leaves the old file or the new one, whole, with its
own checksum or with none, but never with that of the other. A file without a checksum is read
unchecked, as are the files of older versions, which had none.
"""

import contextlib
import hashlib
import io
import json
import os
import stat
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import xarray as xr

from rps_jax.errors import InputError

FileKind = Literal["json", "python", "xml", "policy", "part", "results"]
# [bytes] that a file of a kind may have. What is larger is none of ours, or the wrong file.
MAX_BYTES: dict[FileKind, int] = {
    "json": 2**26,
    "python": 2**22,
    "xml": 2**24,
    "policy": 2**28,
    "part": 2**33,
    "results": 2**37,
}
_STRUCTURE = "structure"  # attribute of a NetCDF file
_DEEPEST = 32  # levels of nested JSON
_KINDS = {
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


def write_atomically(path: Path, write: Callable[[Path], Any]) -> Path:
    """Have `write` fill a file beside `path`, then put that in place; an OSError names `path`."""
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
    """A text file in UTF-8, whole or not at all; names that are no UTF-8 keep their bytes."""
    return write_bytes(path, text.encode(errors="surrogateescape"))


def write_bytes(path: Path, content: bytes, *, checked: bool = False) -> Path:
    """A file of this content, whole or not at all; if `checked`, with its checksum."""
    write_atomically(path, lambda partial: partial.write_bytes(content))
    if checked:
        line = f"{sha256(content)}  {path.name}\n".encode()
        write_atomically(checksum_path(path), lambda partial: partial.write_bytes(line))
    return path


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """A table with a header: the names of all rows; None and NaN stay empty."""
    return write_text(path, pd.DataFrame(list(rows)).to_csv(index=False, lineterminator="\n"))


def write_json(path: Path, content: Any, *, checked: bool = False) -> Path:
    """Readable JSON, keys in the order given; if `checked`, with its checksum."""
    text = json.dumps(content, indent=2, allow_nan=True) + "\n"
    return write_bytes(path, text.encode(), checked=checked)


def write_results(path: Path, results: xr.Dataset) -> Path:
    """A NetCDF 4 file of labelled results, with its checksum."""
    return write_bytes(path, encode_results(results), checked=True)


def checksum_path(path: Path) -> Path:
    """The file that holds the checksum of another."""
    return path.with_name(f"{path.name}.sha256")


def sha256(content: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def encode_results(results: xr.Dataset) -> bytes:
    """NetCDF 4, which depends on the results alone, not on when or where it is made.

    It is made in memory, since HDF5 crashes the process when its disk is full. An attribute holds
    the digest of its structure, by which `decode_results` knows what somebody has edited.
    """
    signed = results.assign_attrs({_STRUCTURE: _structure(results)})
    # A view that Python's garbage collector finds first crashes Python before 3.12.2.
    with signed.to_netcdf(engine="h5netcdf") as view:
        return bytes(view)


def _structure(results: xr.Dataset) -> str:
    """Digest of the names, dimensions, sizes, kinds and units of all variables."""
    told = []
    for name, one in sorted(results.variables.items(), key=lambda item: str(item[0])):
        kind = "text" if one.dtype.kind in "OUST" else one.dtype.str  # texts of any length
        told.append((str(name), one.dims, one.shape, kind, one.attrs.get("units", "")))
    return sha256(repr(told).encode())[:16]


def read_regular(path: Path, kind: FileKind = "results") -> bytes:
    """Read a regular file of bounded size; nothing else is opened, so that nothing blocks.

    Raises:
      OSError: it is not there, or cannot be read.
      InputError: it is a folder, a pipe or a device, or larger than files of its kind are.
    """
    try:
        _check_regular(path, os.stat(path).st_mode)
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{str(path)!r} is no path ({error}).") from error
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    with open(os.open(path, flags), "rb") as file:
        status = os.fstat(file.fileno())
        _check_regular(path, status.st_mode)
        if status.st_size > MAX_BYTES[kind]:
            raise InputError(
                f"{path} is too large: a {kind} file has at most {MAX_BYTES[kind] / 2**20:.0f} MiB."
            )
        return file.read(status.st_size or 2**16)  # some files of the system tell no size


def _check_regular(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        what = _KINDS.get(stat.S_IFMT(mode), "no regular file")
        raise InputError(f"{path} cannot be read (it is {what}): give a regular file.")


def decode_results(content: bytes, source: Any, *, own: bool = False) -> xr.Dataset:
    """The labelled results that `encode_results` made into bytes; InputError names the `source`.

    If they are `own`, only `encode_results` can have made them, and so signed their structure.
    """
    try:
        with xr.open_dataset(io.BytesIO(content), engine="h5netcdf") as found:
            size = sum(variable.nbytes for variable in found.variables.values())
            if size > 8 * len(content) + 2**20:  # HDF5 stores what was never written as nothing
                raise ValueError(f"it claims {size} bytes of numbers")
            found.load()
    except Exception as error:  # whatever HDF5 raises on a file that is none, or is damaged
        raise CorruptFileError(source, error) from error
    signed = found.attrs.pop(_STRUCTURE, None)
    if signed != _structure(found) and (own or signed is not None):
        raise CorruptFileError(
            source, "its names, sizes, types or units are not those that were written"
        )
    return found


def check_columns(
    results: xr.Dataset,
    source: Any,
    dims: Mapping[str, Sequence[Any]],
    sizes: Mapping[Any, int],
) -> xr.Dataset:
    """Return the results from `source` if they have these variables of numbers, or InputError.

    They must have the dimensions `dims`, and lengths where these are known.
    """
    for name, wanted in dims.items():
        if name not in results.variables:
            raise CorruptFileError(source, f"it lacks {name}")
        column = results[name]
        if column.dims != tuple(wanted):
            raise CorruptFileError(
                source, f"{name} has the dimensions {column.dims}, not {tuple(wanted)}"
            )
        if column.dtype.kind not in "biuf":
            raise CorruptFileError(source, f"{name} holds {column.dtype}, not numbers")
        for dim in wanted:
            if dim in sizes and column.sizes[dim] != sizes[dim]:
                raise CorruptFileError(
                    source, f"{dim} has the length {column.sizes[dim]}, not {sizes[dim]}"
                )
    return results


def check_like(results: xr.Dataset, like: xr.Dataset, source: Any) -> xr.Dataset:
    """Return the results if they have the numbers and coordinates of others, or raise InputError.

    The sentence names what is missing, too much or of another kind.
    """
    if odd := sorted(map(str, {*like.variables} ^ {*results.variables})):
        raise CorruptFileError(
            source, f"it {'holds' if odd[0] in results.variables else 'lacks'} {odd[0]}"
        )
    every = like.variables.items()
    numbers = {
        str(name): list(map(str, one.dims)) for name, one in every if one.dtype.kind in "biuf"
    }
    check_columns(results, source, numbers, like.sizes)
    for name in like.coords:
        if not np.array_equal(results[name].values, like[name].values):
            raise CorruptFileError(source, f"{name} is of another run")
    return results


def encode_arrays(**arrays: Any) -> bytes:
    """The content of a NumPy archive (.npz)."""
    content = io.BytesIO()
    np.savez(content, **arrays)
    return content.getvalue()


def decode_arrays(content: bytes) -> dict[str, np.ndarray]:
    """The arrays of a NumPy archive (.npz) without pickled objects.

    What the archive says of itself is compared with its size before anything is unpacked.

    Raises:
      ValueError: it is no such archive, or damaged.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sum(one.file_size for one in archive.infolist()) > MAX_BYTES["part"]:
                raise ValueError("it claims to hold more than such files do")
            for one in archive.infolist():
                if one.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise ValueError("it is compressed in an unusual way")
                _check_member(archive, one)
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except ValueError:
        raise
    except Exception as error:  # whatever zipfile, zlib and NumPy raise on other content
        raise ValueError(str(error) or type(error).__name__) from error


def _check_member(archive: zipfile.ZipFile, one: zipfile.ZipInfo) -> None:
    with archive.open(one) as file:
        version = np.lib.format.read_magic(file)
        reads = {(1, 0): np.lib.format.read_array_header_1_0}
        read = reads.get(version, np.lib.format.read_array_header_2_0)
        shape, _, dtype = read(file)
        if dtype.hasobject:
            raise ValueError(f"{one.filename} holds pickled objects")
        size = dtype.itemsize * int(np.prod(shape, dtype=object))
        if file.tell() + size != one.file_size:
            raise ValueError(f"{one.filename} is not as long as it says")


def read_checked(path: Path, kind: FileKind = "results") -> bytes:
    """The content of a file; InputError if it is not what the checksum beside it says, if any."""
    content, beside = read_regular(path, kind), checksum_path(path)
    with contextlib.suppress(FileNotFoundError):  # there is none
        if read_regular(beside, "json").split(b" ")[0] != sha256(content).encode():
            if read_regular(path, kind) != content:  # another process has just written it anew
                return read_checked(path, kind)
            why = f"{beside.name} is of another content; delete that if the change was yours"
            raise CorruptFileError(path, why)
    return content


def parse_json(content: bytes | str) -> Any:
    """What JSON says; ValueError for none, and for one nested deeper than people write."""
    try:
        found = json.loads(content)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    level, depth = [found], 0
    while level:
        depth += 1
        if depth > _DEEPEST:
            raise ValueError("it is nested too deeply")
        level = [
            inner
            for one in level
            if isinstance(one, dict | list)
            for inner in (one.values() if isinstance(one, dict) else one)
        ]
    return found


def read_checked_json(path: Path) -> dict[str, Any]:
    """What a JSON file of a run folder says, by name; InputError if it is missing or corrupt."""
    try:
        content = read_checked(path, "json")
    except (FileNotFoundError, NotADirectoryError) as error:
        raise InputError(
            f"run = {path.parent} holds no {path.name}: give the folder of a run."
        ) from error
    try:
        found = parse_json(content)
    except ValueError as error:
        raise CorruptFileError(path, error) from error
    if not isinstance(found, dict):
        raise CorruptFileError(path, "it holds no names with values")
    return found


def read_dataset(path: Path) -> xr.Dataset:
    """The labelled results of one file; InputError if it is missing or corrupt."""
    try:
        content = read_checked(path)
    except OSError as error:
        raise InputError(
            f"{path} cannot be read ({error.strerror}): give a file of results."
        ) from error
    return decode_results(content, path)


def read_results(folder: Path) -> xr.Dataset:
    """The results of a run folder; InputError if it holds none, or they are corrupt."""
    path = Path(folder) / "results.nc"
    if not path.exists():
        raise InputError(f"run = {folder} holds no results.nc: give the folder of a finished run.")
    return read_dataset(path)


def read_json(path: Path) -> dict[str, Any]:
    """Names with values from a JSON file that a user wrote; InputError if it is none."""
    try:
        content = read_regular(path, "json")
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}): give a JSON file.") from error
    try:
        values = parse_json(content)
    except ValueError as error:
        raise InputError(f"{path} is not JSON ({error}).") from error
    if not isinstance(values, dict):
        raise InputError(f'{path} holds no names with values: write {{"name": value}}.')
    return values
