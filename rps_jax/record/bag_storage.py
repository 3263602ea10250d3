"""Messages in the files of bags: MCAP, sqlite3, folders of `ros2 bag record`, zstd compression.

A kind of file is known by its first bytes, whatever its name. Sizes are bounded before memory is
allocated. Errors lack the path, which `bag.read` adds.
"""

from __future__ import annotations

import contextlib
import functools
import io
import shlex
import sqlite3
import tempfile
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

from rps_jax.errors import InputError
from rps_jax.record import files

_LIMIT = 64 * 2**20  # of a record, and of an unpacked chunk or message
_MAX_FILE = 2 * 2**30  # of an unpacked file
_SUFFIXES = (".mcap", ".db3", ".bag", ".zstd")
_MCAP, _SQLITE, _ZSTD = b"\x89MCAP0\r\n", b"SQLite format 3\0", b"\x28\xb5\x2f\xfd"
_FIXES = {  # of a file that cannot be read, by its first bytes
    _MCAP: "if it is cut off or damaged, save the rest by `mcap recover {} -o whole.mcap`",
    _SQLITE: "if it is cut off or damaged, save the rest by `sqlite3 {} .recover | sqlite3 b.db3`",
    _ZSTD: "compress it again",
    b"#ROSBAG V": "convert this ROS 1 bag by `rosbags-convert --src {} --dst ros2_bag`",
    files.POINTER: files.FETCH,
    b"": "give FILE.mcap, FILE.db3, or a folder of them (`ros2 bag reindex FOLDER` repairs it)",
}

# Topic, type as nav_msgs/Odometry, encoding, time of receipt [ns], and bytes of a message. A topic
# itself has no bytes.
Entry = tuple[str, str, str, int, bytes | None]


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag by its name or its first bytes, or a folder of bags."""
    try:
        if path.is_dir():
            names = [*path.glob("metadata.yaml"), *_bags(path)]
            return bool(names) and not (path / "results.nc").exists()
        return path.is_file() and (files.suffix_of(path) in _SUFFIXES or bool(_magic(path)))
    except OSError:
        return True  # reading it says why it cannot be read


def entries(path: Path, topics: Collection[str]) -> Iterator[Entry]:
    """Yield all topics, and the messages of some topics, in the order of the files.

    Raises:
      InputError: the path is no bag, or a file is damaged, too large, or of an unknown format.
    """
    file, magic = path, b""
    try:
        for file, magic in [(file, _magic(file)) for file in _files(path)]:
            with tempfile.TemporaryDirectory() as folder:
                content = file if magic != _ZSTD else Path(folder) / "bag"
                if magic == _ZSTD:
                    content.write_bytes(_unpacked(file.read_bytes(), "zstd", _MAX_FILE))
                read = {_MCAP: _mcap_entries, _SQLITE: _sqlite_entries}.get(_magic(content))
                if read is None:
                    raise ValueError("its content is no bag of ROS 2")
                yield from read(content, topics)
    except Exception as error:  # of any kind, by the readers of a damaged file
        fix = _FIXES[magic].format(shlex.quote(str(file)))
        raise InputError(f"cannot be read ({reason(error)}): {fix}") from error


def reason(error: Exception) -> str:
    """Return what an error of a reader says, in one line."""
    return " ".join(str(error).split())[:300].rstrip(".") or type(error).__name__


def _magic(path: Path) -> bytes:
    """Return the first bytes of a file that name its kind, or nothing."""
    with open(path, "rb") as file:
        start = file.read(16)
    return next(magic for magic in _FIXES if start.startswith(magic))


def _bags(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if files.suffix_of(file) in _SUFFIXES)


def _files(path: Path) -> list[Path]:
    """Return the files of a bag in their order."""
    from ruamel.yaml import YAML

    if not path.is_dir():
        return [path]
    metadata, bags = path / "metadata.yaml", _bags(path)
    if metadata.exists() or len(bags) != 1:
        content = (YAML(typ="safe").load(metadata) or {})["rosbag2_bagfile_information"]
        bags = [path / Path(name).name for name in content["relative_file_paths"]]
    return bags


# --- compression ---------------------------------------------------------------------------


def _unpacked(data: bytes, compression: str, limit: int = _LIMIT) -> bytes:
    """Return the content of a chunk, message or file."""
    import lz4.frame
    import zstandard

    formats = {"": contextlib.nullcontext, "zstd": zstandard.open, "lz4": lz4.frame.open}
    if compression not in formats:
        raise ValueError(f"the compression {compression}, neither zstd nor lz4")
    with formats[compression](io.BytesIO(data)) as stream:
        content = stream.read(limit + 1)
    if len(content) > limit:
        raise ValueError(f"more than {limit} bytes in a chunk, message or file, so cut it up")
    return content


# --- containers ----------------------------------------------------------------------------


def _mcap_entries(path: Path, topics: Collection[str]) -> Iterator[Entry]:
    from mcap.records import Channel, Message, Schema

    kinds, channels = {0: "no type"}, dict[int, tuple[str, str, str]]()
    for record in _mcap_records(path):
        if isinstance(record, Message):
            if (channel := channels[record.channel_id])[0] in topics:
                yield *channel, record.log_time, record.data
        elif isinstance(record, Schema):
            kinds[record.id] = record.name.replace("/msg/", "/")
        elif isinstance(record, Channel):
            channels[record.id] = record.topic, kinds[record.schema_id], record.message_encoding
            yield *channels[record.id], 0, None


def _mcap_records(path: Path) -> Iterator[object]:
    """Yield the records of an MCAP file, with those of its chunks; check all checksums."""
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader, breakup_chunk

    with open(path, "rb") as file:
        reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=_LIMIT)
        for record in reader.records:
            if isinstance(record, Chunk):
                record.data, record.compression = _unpacked(record.data, record.compression), ""
                yield from breakup_chunk(record, validate_crc=True)
            else:
                yield record


def _sqlite_entries(path: Path, topics: Collection[str]) -> Iterator[Entry]:
    uri = f"{path.absolute().as_uri()}?mode=ro"
    with contextlib.closing(sqlite3.connect(uri, uri=True)) as database:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LIMIT)
        columns = "name, replace(type, '/msg/', '/'), serialization_format"
        for channel in database.execute(f"SELECT {columns} FROM topics"):
            yield *channel, 0, None
        yield from database.execute(
            f"SELECT {columns}, timestamp, data FROM messages JOIN topics ON topic_id = topics.id "
            f"WHERE name IN ({', '.join('?' * len(topics))}) ORDER BY messages.id",
            [*topics],
        )


# --- messages ------------------------------------------------------------------------------


def decoded(kind: str, encoding: str, data: bytes) -> Any:
    """Return a message of a standard type, with its fields as attributes; it may be compressed."""
    data = _unpacked(data, "zstd") if data.startswith(_ZSTD) else data
    return _decoder(encoding)(data, kind.replace("/", "/msg/"))


@functools.cache
def _decoder(encoding: str) -> Callable[[bytes, str], Any]:
    """Return the decoder of messages in the encoding of ROS 2, `cdr`, or of ROS 1, `ros1`."""
    from rosbags.typesys import Stores, get_typestore

    if encoding == "ros1":
        return get_typestore(Stores.ROS1_NOETIC).deserialize_ros1
    return get_typestore({"cdr": Stores.ROS2_HUMBLE}[encoding]).deserialize_cdr
