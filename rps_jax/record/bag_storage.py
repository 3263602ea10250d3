"""Messages in the files of bags: MCAP, sqlite3, folders of `ros2 bag record`, zstd compression.

A kind of file is known by its first bytes, whatever its name. Sizes are bounded before memory is
allocated. Errors lack the path, which `bag.read` adds.
"""

from __future__ import annotations

import contextlib
import functools
import shlex
import sqlite3
import tempfile
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO, NamedTuple

from rps_jax import errors
from rps_jax.errors import InputError

_MAX_BYTES = 64 * 2**20  # of a record, and of an unpacked chunk or message
_MAX_FILE = 2 * 2**30  # of an unpacked file
_MAX_DEFINITION = 2**20  # characters of the definition of a type
_SUFFIXES = (".mcap", ".db3", ".bag", ".zstd")
_MCAP, _SQLITE, _ZSTD = b"\x89MCAP0\r\n", b"SQLite format 3\0", b"\x28\xb5\x2f\xfd"
_ROS_1 = b"#ROSBAG V"
_NO_BAG = "is no bag: give FILE.mcap, FILE.db3, or a folder of `ros2 bag record`"
_REPAIR = {
    _MCAP: "save the rest by `mcap recover {} -o whole.mcap`",
    _SQLITE: "save the rest by `sqlite3 {} .recover | sqlite3 whole.db3`",
    _ZSTD: "compress it again",
}

_require = functools.partial(errors.require, extra="bags")


class Channel(NamedTuple):
    """Topic of a file, and how its messages are encoded."""

    topic: str
    kind: str  # type of the messages, as nav_msgs/Odometry
    encoding: str  # cdr, or ros1
    language: str  # of the definition: ros2msg, ros1msg, ros2idl or omgidl
    definition: str  # text; empty for the standard type


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag by its name or its first bytes, or a folder of bags."""
    try:
        if path.is_dir():
            is_run = (path / "results.nc").exists()
            return not is_run and ((path / "metadata.yaml").exists() or bool(_bags(path)))
        return path.is_file() and (path.suffix.lower() in _SUFFIXES or bool(_magic(path)))
    except OSError:
        return True  # reading it says why it cannot be read


Entry = tuple[Channel, int, bytes | None]  # with the time of receipt [ns]; no bytes: no message


def entries(path: Path, topics: Collection[str]) -> Iterator[Entry]:
    """Yield all channels, and the messages of some topics, in the order of the files.

    Raises:
      InputError: the path is no bag, or a file is damaged, too large, or of an unknown format.
    """
    try:
        files = [(file, _magic(file)) for file in _files(path)]
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})") from error
    for file, magic in files:
        name = shlex.quote(str(file))
        if magic == _ROS_1:
            raise InputError(
                f"is a ROS 1 bag: run `rosbags-convert --src {name} --dst ros2_bag`, and give the "
                "folder ros2_bag"
            )
        if not magic:
            raise InputError(_NO_BAG if file.stat().st_size else "is empty: record it again")
        try:
            with contextlib.ExitStack() as stack:
                content, kind = file, magic
                if magic == _ZSTD:
                    folder = stack.enter_context(tempfile.TemporaryDirectory())
                    content, kind = _unpacked_file(file, Path(folder) / "bag")
                read = {_MCAP: _mcap_entries, _SQLITE: _sqlite_entries}[kind]
                yield from read(content, topics)
        except InputError:
            raise
        except Exception as error:  # of any kind, by the readers of a damaged file
            fault = "cut off" if _is_cut(file, magic) else f"damaged ({reason(error)})"
            raise InputError(f"is {fault}: {_REPAIR[magic].format(name)}") from error


def reason(error: Exception) -> str:
    """Return what an error of a reader says, in one line."""
    return " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__


def _is_cut(file: Path, magic: bytes) -> bool:
    """Return whether an MCAP file lacks its end."""
    if magic != _MCAP:
        return False
    with open(file, "rb") as stream:
        stream.seek(max(file.stat().st_size - len(_MCAP), 0))
        return stream.read() != _MCAP


def _magic(path: Path) -> bytes:
    """Return the first bytes of a file that name its kind, or nothing."""
    with open(path, "rb") as file:
        start = file.read(16)
    return next((m for m in (_MCAP, _SQLITE, _ZSTD, _ROS_1) if start.startswith(m)), b"")


def _bags(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in _SUFFIXES)


def _files(path: Path) -> list[Path]:
    """Return the files of a bag."""
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise InputError(_NO_BAG)
    metadata = path / "metadata.yaml"
    if not metadata.is_file():
        if not (files := _bags(path)):
            raise InputError(f"has no file .mcap or .db3, so it {_NO_BAG}")
        if len(files) > 1:
            raise InputError(
                f"has {len(files)} files and no metadata.yaml: give one of them, or run "
                f"`ros2 bag reindex {path}`"
            )
        return files
    try:
        content = _require("ruamel.yaml").YAML(typ="safe").load(metadata)
        names = content["rosbag2_bagfile_information"]["relative_file_paths"]
        files = [path / Path(name).name for name in names]
    except Exception as error:  # of any kind, by the reader of YAML
        raise InputError(
            f"has a metadata.yaml that cannot be read: run `ros2 bag reindex {path}`"
        ) from error
    if missing := [file.name for file in files if not file.is_file()]:
        raise InputError(
            f"lacks {missing[0]}, which its metadata.yaml lists: copy the whole folder, or run "
            f"`ros2 bag reindex {path}`"
        )
    return files


# --- compression ---------------------------------------------------------------------------


def _unpacked_file(path: Path, target: Path) -> tuple[Path, bytes]:
    """Unpack a file, and return the new path and its first bytes."""
    size = 0
    with _require("zstandard").open(path, "rb") as source, open(target, "wb") as sink:
        while block := source.read(2**20):
            size += sink.write(block)
            if size > _MAX_FILE:
                raise InputError(f"has more than {_MAX_FILE} bytes: cut it into parts")
    if (magic := _magic(target)) not in (_MCAP, _SQLITE):
        raise ValueError("its content is no bag")
    return target, magic


def _unpacked(data: bytes, compression: str) -> bytes:
    """Return the content of a chunk or message."""
    if not compression:
        return data
    if compression == "lz4":
        reader = _require("lz4.frame").LZ4FrameDecompressor()
        content = reader.decompress(data, max_length=_MAX_BYTES + 1)
        _check_size(len(content))
        return content
    if compression != "zstd":
        raise InputError(f"has the compression {compression[:60]}: record it with zstd or lz4")
    zstandard = _require("zstandard")
    _check_size(zstandard.frame_content_size(data))
    return zstandard.decompress(data, _MAX_BYTES)


def _check_size(size: int) -> None:
    if size > _MAX_BYTES:
        raise InputError(
            f"has a chunk of {size} bytes, and the limit is {_MAX_BYTES}: write it with smaller "
            "chunks by `ros2 bag convert`"
        )


# --- containers ----------------------------------------------------------------------------


def _mcap_entries(path: Path, topics: Collection[str]) -> Iterator[Entry]:
    kinds = _require("mcap.records")
    schemas, channels = {}, dict[int, Channel]()
    with open(path, "rb") as file:
        for record in _mcap_records(file):
            if isinstance(record, kinds.Schema):
                schemas[record.id] = record
            elif isinstance(record, kinds.Channel):
                schema = schemas.get(record.schema_id)
                name, language = (schema.name, schema.encoding) if schema else ("no type", "")
                text = schema.data.decode() if schema else ""
                channel = Channel(
                    record.topic, _kind(name), record.message_encoding, language, text
                )
                channels[record.id] = channel
                yield channel, 0, None
            elif isinstance(record, kinds.Message):
                channel = channels[record.channel_id]
                if channel.topic in topics:
                    yield channel, record.log_time, record.data


def _mcap_records(file: BinaryIO) -> Iterator[object]:
    """Yield the records of an MCAP file, with those of its chunks; check all checksums."""
    module, chunk_type = _require("mcap.stream_reader"), _require("mcap.records").Chunk
    limits = {"record_size_limit": _MAX_BYTES, "validate_crcs": True, "emit_chunks": True}
    for record in module.StreamReader(file, **limits).records:
        if not isinstance(record, chunk_type):
            yield record
            continue
        _check_size(record.uncompressed_size)
        record.data, record.compression = _unpacked(record.data, record.compression), ""
        yield from module.breakup_chunk(record, validate_crc=True)


def _sqlite_entries(path: Path, topics: Collection[str]) -> Iterator[Entry]:
    database = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)
    with contextlib.closing(database):
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_BYTES)
        names = database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        if not {"topics", "messages"} <= (tables := {name for (name,) in names}):
            raise InputError(f"has no tables topics and messages, so it {_NO_BAG}")
        texts: dict[str, tuple[str, str]] = {}
        if "message_definitions" in tables:
            columns = "topic_type, encoding, encoded_message_definition"
            rows = database.execute(f"SELECT {columns} FROM message_definitions")
            texts = {kind: (language, text) for kind, language, text in rows}
        channels = {}
        columns = "id, name, type, serialization_format"
        for key, topic, kind, encoding in database.execute(f"SELECT {columns} FROM topics"):
            channel = Channel(topic, _kind(kind), encoding, *texts.get(kind, ("", "")))
            channels[key] = channel
            yield channel, 0, None
        for key, time, data in database.execute(
            "SELECT topic_id, timestamp, data FROM messages JOIN topics ON topic_id = topics.id "
            f"WHERE name IN ({', '.join('?' * len(topics))}) ORDER BY messages.id",
            [*topics],
        ):
            yield channels[key], time, data


# --- messages ------------------------------------------------------------------------------


def _kind(name: str) -> str:
    return name.replace("/msg/", "/")


def decoded(channel: Channel, data: bytes) -> Any:
    """Return a message, with its fields as attributes; its bytes may be compressed."""
    if data.startswith(_ZSTD):
        data = _unpacked(data, "zstd")
    return _decoder(channel)(data)


@functools.lru_cache(maxsize=64)
def _decoder(channel: Channel) -> Callable[[bytes], Any]:
    """Return the decoder of the messages of a channel."""
    typesys = _require("rosbags.typesys")
    name, text = "/msg/".join(channel.kind.rsplit("/", 1)), channel.definition
    if len(text) > _MAX_DEFINITION:
        raise ValueError(f"{channel.topic} has a definition of {len(text)} characters")
    if channel.encoding not in ("cdr", "ros1"):
        raise InputError(
            f"has {channel.topic} in the encoding {channel.encoding[:60]}: record it with ROS 2 "
            "in cdr"
        )
    if not text.strip():
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    else:
        store = typesys.get_typestore(typesys.Stores.EMPTY)
        store.register(_types(typesys, name, channel.language, text))
    decode = store.deserialize_ros1 if channel.encoding == "ros1" else store.deserialize_cdr
    return functools.partial(decode, typename=name)


def _types(typesys: ModuleType, name: str, language: str, text: str) -> dict[str, object]:
    """Return the types that a definition has."""
    if not language.endswith("idl"):
        return typesys.get_types_from_msg(text, name)
    types = {}
    for part in filter(str.strip, text.split(f"{'=' * 80}\n")):
        types |= typesys.get_types_from_idl(part.partition("\n")[2] if part[:4] == "IDL:" else part)
    return types
