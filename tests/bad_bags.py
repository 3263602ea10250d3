"""Bags of many kinds: reordered, of other formats, frames and names, and invalid.

Each case writes a bag of the same push, and expects either the steps of the plain bag or a sentence
that contains some words. `tests/test_bags.py` runs all cases.
"""

from __future__ import annotations

import copy
import io
import random
import sqlite3
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from mcap_ros2.writer import Writer as EncodingWriter
from numpy.random import default_rng
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from rps_jax.errors import InputError
from rps_jax.record import bag
from rps_jax.record.bag import Step

STORE = get_typestore(Stores.ROS2_HUMBLE)
COUNT = 40
KINDS = bag.TOPICS | {
    "/plain": "geometry_msgs/Twist",
    "/pose": "geometry_msgs/PoseStamped",
}
MS, SECOND = 10**6, 10**9


Writer = Callable[[Path], Path]  # writes a bag into a folder, and returns its path
Edit = Callable[[dict[str, Any]], object]  # of the fields of a message


class Row(NamedTuple):
    """A message as fields, with its time of receipt [ns]."""

    topic: str
    time: int
    message: dict[str, Any]


class Record(NamedTuple):
    """A message as bytes."""

    topic: str
    kind: str
    text: str  # definition of the type
    time: int
    data: bytes


class Case(NamedTuple):
    """Bag and its expected outcome."""

    kind: str
    source: list[Row] | Writer  # messages, or what writes a file into a folder
    expected: str = ""  # words of the sentence, or nothing if the steps are those of the plain bag
    topics: Mapping[str, str] | Sequence[str] = ()
    atol: float = 0.0
    senses: Sequence[str] = Step._fields


def push() -> list[Step]:
    """Return steps in which each field changes at each step."""
    rng = default_rng(0)
    steps = []
    for i in range(COUNT):
        kind = (0, 1, 2, 1)[i % 4]
        contact = np.float32([0.36, 0.01 * i - 0.2]) * (kind > 0)
        signal, force = np.float32(rng.random(42)), rng.normal(0, 20, 2)
        pose, twist = (0.1 * i, 0.02 * i, 0.15 * i - 3.0), (0.05, 0.001 * i, -0.002 * i)
        object_ = {"p_world_object": (1 + 0.1 * i, 0.5), "r_object": 0.25}
        steps.append(
            Step(1 + 0.02 * i, pose, (6.0, 2.0), kind, contact, twist, signal, force, **object_)
        )
    return steps


def rows() -> list[Row]:
    """Return the messages of the plain bag."""
    return [Row(*row) for row in bag._messages(push())]


def edited(
    topic: str,
    edit: Edit,
    at: Iterable[int] | None = None,
    source: Iterable[Row] | None = None,
) -> list[Row]:
    """Return rows with some messages of a topic changed, by default all."""
    result, i = [], -1
    for row in rows() if source is None else source:
        if row.topic == topic:
            i += 1
            if at is None or i in at:
                row = row._replace(message=copy.deepcopy(row.message))
                edit(row.message)
        result.append(row)
    return result


def received(
    shift: Callable[[Row, int], int], topic: str | None = None, at: Iterable[int] | None = None
) -> list[Row]:
    """Return rows with other times of receipt."""
    result, counts = [], dict[str, int]()
    for row in rows():
        i = counts[row.topic] = counts.get(row.topic, -1) + 1
        if topic in (None, row.topic) and (at is None or i in at):
            row = row._replace(time=shift(row, i))
        result.append(row)
    return result


def stamped(change: Callable[[int], int], topics: Iterable[str] = ()) -> list[Row]:
    """Return rows with other header stamps [ns]."""

    def edit(message: dict[str, Any]) -> None:
        for part in message.get("transforms", [message]):
            if "header" in part:
                stamp = part["header"]["stamp"]
                time = change(stamp["sec"] * SECOND + stamp["nanosec"])
                part["header"] |= {"stamp": {"sec": time // SECOND, "nanosec": time % SECOND}}

    result = rows()
    for topic in topics or KINDS:
        result = edited(topic, edit, source=result)
    return result


def renamed(names: Mapping[str, str]) -> list[Row]:
    return [row._replace(topic=names.get(row.topic[1:], row.topic)) for row in rows()]


def without(*topics: str) -> list[Row]:
    return [row for row in rows() if row.topic not in topics]


def set_(path: str, value: object) -> Edit:
    """Return an edit of one field, as `pose.pose.position.x`."""

    def edit(message: dict[str, Any]) -> None:
        *owners, last = path.split(".")
        for owner in owners:
            message = message[int(owner) if owner.isdigit() else owner]
        message[last] = value

    return edit


def framed(topic: str, frame: str, source: Iterable[Row] | None = None) -> list[Row]:
    return edited(topic, set_("header.frame_id", frame), source=source)


def encode(messages: Iterable[Row], kinds: Mapping[str, str] = KINDS) -> list[Record]:
    """Return messages as bytes, in their order."""
    file, schemas, messages = io.BytesIO(), {}, list(messages)
    writer = EncodingWriter(file, compression=CompressionType.NONE)
    for i, row in enumerate(messages):
        name = kinds["/" + row.topic.rsplit("/", 1)[-1]].replace("/", "/msg/")
        if name not in schemas:
            text, _ = STORE.generate_msgdef(name, ros_version=2)
            schemas[name] = writer.register_msgdef(name, text)
        writer.write_message(row.topic, schemas[name], row.message, i, i)
    writer.finish()
    records = zip(messages, records_of(file.getvalue()), strict=True)
    return [record._replace(time=row.time) for row, record in records]


def records_of(content: bytes) -> list[Record]:
    """Return the messages of an MCAP file."""
    reader = NonSeekingReader(io.BytesIO(content))
    return [
        Record(channel.topic, schema.name, schema.data.decode(), message.log_time, message.data)
        for schema, channel, message in reader.iter_messages(log_time_order=False)
    ]


def mcap(
    records: Iterable[Record],
    name: str = "bag.mcap",
    *,
    schema: str = "ros2msg",
    encoding: str = "cdr",
    profile: str = "ros2",
    text: Callable[[Record], str] = lambda r: r.text,
    **options: Any,
) -> Writer:
    """Return what writes an MCAP file."""

    def write(folder: Path) -> Path:
        path, channels = folder / name, dict[tuple[str, str], int]()
        path.parent.mkdir(exist_ok=True)
        with open(path, "wb") as file:
            writer = McapWriter(file, **options)
            writer.start(profile)
            for r in records:
                if (key := (r.topic, r.kind)) not in channels:
                    number = writer.register_schema(r.kind, schema, text(r).encode())
                    channels[key] = writer.register_channel(r.topic, encoding, number)
                writer.add_message(channels[key], max(r.time, 0), r.data, max(r.time, 0))
            writer.finish()
        return path

    return write


def plain(messages: Iterable[Row], **options: Any) -> Writer:
    """Return what writes rows as an MCAP file."""
    return lambda folder: mcap(encode(messages), **options)(folder)


def folder_of(plugin: str = "MCAP", compression: str = "NONE", parts: int = 1) -> Writer:
    """Return what writes a folder as `ros2 bag record` does, split into files."""

    def write(folder: Path) -> Path:
        records, names = encode(rows()), list[str]()
        for i in range(parts):
            part = folder / f"push {i}"
            storage = rosbag2.StoragePlugin[plugin]
            writer = rosbag2.Writer(part, version=9, storage_plugin=storage)
            writer.set_compression(
                rosbag2.CompressionMode[compression], rosbag2.CompressionFormat.ZSTD
            )
            with writer:
                channels = {}
                for r in records[i * len(records) // parts : (i + 1) * len(records) // parts]:
                    if r.topic not in channels:
                        channels[r.topic] = writer.add_connection(r.topic, r.kind, typestore=STORE)
                    writer.write(channels[r.topic], r.time, r.data)
            names += [p.name for p in part.iterdir() if p.suffix != ".yaml"]
        first = folder / "push 0"
        for i in range(1, parts):
            (folder / f"push {i}" / names[i]).rename(first / names[i])
        if parts > 1:
            text = (first / "metadata.yaml").read_text()
            listed = "".join(f"\n  - {name}" for name in names)
            text = text.replace(
                f"relative_file_paths:\n  - {names[0]}", f"relative_file_paths:{listed}"
            )
            assert names[1] in text
            (first / "metadata.yaml").write_text(text)
        return first.rename(folder / "one push")

    return write


def file_of(write: Writer, name: str = "") -> Writer:
    """Return what writes a folder, and gives its only file of messages, as `name`."""

    def inner(folder: Path) -> Path:
        (path,) = (p for p in write(folder).iterdir() if p.suffix != ".yaml")
        return path.rename(folder / name) if name else path

    return inner


def cut(write: Writer, share: float) -> Writer:
    """Return what writes the first part of a file."""

    def inner(folder: Path) -> Path:
        path = write(folder)
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
        return path

    return inner


def content(data: bytes, name: str = "bag.mcap") -> Writer:
    def write(folder: Path) -> Path:
        (folder / name).write_bytes(data)
        return folder / name

    return write


def flipped(folder: Path) -> Path:
    """Write an MCAP file with one wrong bit in a number."""
    path = mcap(encode(rows()), compression=CompressionType.NONE)(folder)
    data = bytearray(path.read_bytes())
    data[data.index(struct.pack("<d", 6.0)) + 5] ^= 1
    path.write_bytes(data)
    return path


def old_sqlite(folder: Path) -> Path:
    """Write a bag as the first releases of ROS 2 did, without definitions."""
    path = file_of(folder_of("SQLITE3"))(folder)
    with sqlite3.connect(path) as database:
        for table in ("message_definitions", "metadata", "schema"):
            database.execute(f"DROP TABLE {table}")
        for column in ("offered_qos_profiles", "type_description_hash"):
            database.execute(f"ALTER TABLE topics DROP COLUMN {column}")
    return path


def odd_sqlite(folder: Path) -> Path:
    """Write a bag with a text for a time."""
    path = file_of(folder_of("SQLITE3"))(folder)
    with sqlite3.connect(path) as database:
        database.execute("UPDATE messages SET timestamp = 'soon' WHERE id = 9")
    return path


def other_sqlite(folder: Path) -> Path:
    with sqlite3.connect(folder / "bag.db3") as database:
        database.execute("CREATE TABLE notes (id INTEGER)")
    return folder / "bag.db3"


def ros1_bag(folder: Path) -> Path:
    """Write a bag of ROS 1."""
    store = get_typestore(Stores.ROS1_NOETIC)
    with rosbag1.Writer(folder / "push.bag") as writer:
        channels = {}
        for r in encode(without("/object", "/target_marker", "/tf")):
            if r.topic not in channels:
                channels[r.topic] = writer.add_connection(r.topic, r.kind, typestore=store)
            data = STORE.cdr_to_ros1(r.data, r.kind)
            writer.write(channels[r.topic], r.time, bytes(data))
    return folder / "push.bag"


def changed(change: Callable[[Record], Record]) -> Writer:
    """Return what writes an MCAP file with changed records."""
    return lambda folder: mcap(map(change, encode(rows())))(folder)


def changed_folder(change: Callable[[Path], object], parts: int = 1) -> Writer:
    def write(folder: Path) -> Path:
        path = folder_of(parts=parts)(folder)
        change(path)
        return path

    return write


# --- cases ---------------------------------------------------------------------------------


def repeated() -> list[Row]:
    """Return each message twice; the first of two commands is another."""
    twice = [row for row in rows() for _ in range(2)]
    return edited("/cmd_vel", set_("twist.linear.x", 9.0), range(0, 2 * COUNT, 2), twice)


def as_twist(source: Iterable[Row]) -> list[Row]:
    return [
        Row("/plain", row.time, row.message["twist"]) if row.topic == "/cmd_vel" else row
        for row in source
    ]


def as_pose(source: Iterable[Row]) -> list[Row]:
    def pose(message: dict[str, Any]) -> dict[str, Any]:
        return {"header": message["header"], "pose": {"position": message["point"]}}

    return [
        Row("/pose", row.time, pose(row.message)) if row.topic == "/target" else row
        for row in source
    ]


def prefixed() -> list[Row]:
    """Return rows with a prefix of all frames."""
    result = edited("/odom", set_("child_frame_id", "r1/base_link"))
    for topic, frame in zip(STAMPED, ["odom"] * 3 + ["base_link"] * 3, strict=True):
        result = framed(topic, f"r1/{frame}", result)
    return result


def on_path(paths: Mapping[int, Sequence[tuple[float, float]]], *left_out: str) -> list[Row]:
    """Return rows with paths [m] that are published at some steps, without some topics."""
    result = without(*left_out)
    for i, points in paths.items():
        header = bag._header(round(1e9 * push()[i].time), "odom")
        poses = [{"header": header, "pose": bag._pose(*point)} for point in points]
        stamp = header["stamp"]["sec"] * SECOND + header["stamp"]["nanosec"]
        result.append(Row("/path", stamp, {"header": header, "poses": poses}))
    return result


NO_INDEX = {
    "index_types": IndexType.NONE,
    "use_statistics": False,
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_summary_offsets": False,
}
TOUCH = ("contact_type", "p_robot_contact", "target")  # fields that laws of touch sense
LINE = ((0.0, 0.0), (3.0, 1.0), (6.0, 2.0))  # [m] a path
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"
STAMPED = ("/odom", "/target", "/object", "/contact", "/force", "/cmd_vel")
NAN = float("nan")


def cases() -> list[Case]:
    """Return all cases."""
    return [
        *(Case(kind, *entry) for kind, entry in _order().items()),
        *(Case(kind, *entry) for kind, entry in (_formats() | _invalid_files()).items()),
        *(Case(kind, *entry) for kind, entry in (_frames() | _topics() | _values()).items()),
    ]


def _order() -> dict[str, tuple[Any, ...]]:
    """Return bags in other orders, and with other stamps."""
    late, hour = 1_700_000_000 * SECOND, 3600 * SECOND
    whole, sorted_ = rows(), sorted(rows(), key=lambda r: r.topic)
    by_system = stamped(lambda t: t + late, ["/cmd_vel"])
    by_two = received(lambda r, i: r.time + i % 2 * hour)
    ends = [
        r._replace(time=r.time * 10)
        for r in stamped(lambda t: 10 * t)
        if r.topic != "/odom" or r.time < 1.4 * SECOND
    ]
    return {
        "as written": (whole,),
        "topic after topic": (sorted_,),
        "commands before observations of the same stamp": (
            sorted(rows(), key=lambda r: (r.time, r.topic != "/cmd_vel")),
        ),
        "the whole file reversed": (whole[::-1],),
        "shuffled, small chunks": (
            plain(random.Random(3).sample(whole, len(whole)), chunk_size=500),
        ),
        "a receipt ahead by an hour": (
            received(lambda r, _: r.time + hour, "/cmd_vel", [9]),
            "a header stamp that goes back",
        ),
        "receipts repeated": (received(lambda r, i: SECOND + i // 2 * 40 * MS, "/cmd_vel"),),
        "receipts late by 80 ms": (received(lambda r, _: r.time + 80 * MS),),
        "receipts by another clock": (received(lambda r, _: r.time + late),),
        "receipts of stamped topics late by 0 to 9 ms": (
            [
                r._replace(time=r.time + (i * 7 % 10 if r.topic in STAMPED else 4) * MS)
                for i, r in enumerate(whole)
            ],
        ),
        "each message twice, the last counts": (repeated(),),
        "stamps of the system clock": (
            [r._replace(time=r.time + late) for r in stamped(lambda t: t + late)],
            "",
            (),
            1e-6,
        ),
        "no stamps, shuffled": (random.Random(1).sample(stamped(lambda t: 0), len(whole)),),
        "no stamps of the target, receipts late by 80 ms": (
            [r._replace(time=r.time + 80 * MS) for r in stamped(lambda t: 0, ["/target"])],
        ),
        "commands without header, reversed": (as_twist(whole[::-1]), "", ["cmd_vel=/plain"]),
        "commands without header, receipts by another clock": (
            as_twist(received(lambda r, _: r.time + late)),
            "",
            "cmd_vel=plain",
        ),
        "a target as a pose": (as_pose(whole), "", {"target": "/pose"}),
        "only commands": (sorted_[:COUNT], "has no messages on /odom"),
        "header stamps begin anew": (
            [*whole, *received(lambda r, _: r.time + 2 * SECOND)],
            "a header stamp that goes back",
        ),
        "a header stamp of odom goes back": (
            edited("/odom", set_("header.stamp", {"sec": 1}), [9]),
            "a header stamp that goes back on /odom at 1.000 s",
        ),
        "sim time and system time mixed": (
            [r for r in by_system if r.topic != "/taxels"],
            "in the 1 s before that on /cmd_vel",
        ),
        "sim time and system time mixed, taxels": (by_system, "of other topics, on /taxels"),
        "a simulation 20 times slower than the clock": (received(lambda r, _: 20 * r.time),),
        "a simulation that pauses, and then is slower": (
            received(lambda r, _: r.time if r.time < 1400 * MS else 3 * r.time + hour),
        ),
        "receipts by two clocks": (by_two, "a header stamp that goes back"),
        "an object of another clock, which a law does not sense": (
            stamped(lambda t: t + late, ["/object"]),
            "",
            (),
            0.0,
            TOUCH,
        ),
        "odom ends early": (ends, "no message on /odom in the 1 s before that on /cmd_vel at 15"),
    }


def _formats() -> dict[str, tuple[Any, ...]]:
    """Return bags in other formats."""
    whole = rows()
    folders = {
        f"{plugin}: {kind}": (folder_of(plugin, *options),)
        for plugin in ("MCAP", "SQLITE3")
        for kind, options in {
            "folder": (),
            "folder of 3 files": ("NONE", 3),
            "folder, messages compressed": ("MESSAGE",),
            "folder, files compressed": ("FILE",),
            "folder of 2 files, files compressed": ("FILE", 2),
        }.items()
    }
    return folders | {
        "MCAP with lz4": (plain(whole, compression=CompressionType.LZ4),),
        "MCAP without chunks and summary": (plain(whole, use_chunking=False, **NO_INDEX),),
        "MCAP without checksums": (plain(whole, enable_crcs=False),),
        "schemas without text and language": (plain(whole, schema="", text=lambda r: ""),),
        "types without msg": (changed(lambda r: r._replace(kind=r.kind.replace("/msg/", "/"))),),
        "a file .db3": (file_of(folder_of("SQLITE3")),),
        "a file .db3 without definitions": (old_sqlite,),
        "other topics of unknown types": (
            lambda f: mcap([*encode(whole), Record("/raw", "x/msg/Y", "~?", SECOND, b"?")])(f),
        ),
    }


def _invalid_files() -> dict[str, tuple[Any, ...]]:
    """Return files that are no bags, or damaged."""
    whole = rows()
    return {
        "an empty file": (content(b""), "seems to be empty): give FILE.mcap"),
        "a pointer of Git LFS": (content(POINTER), "fetch the file itself by `git lfs pull`"),
        "a folder of pointers of Git LFS": (
            changed_folder(lambda p: (p / "push 0.mcap").write_bytes(POINTER)),
            "`git lfs pull`",
        ),
        "a path that is missing": (lambda f: f / "none.mcap", "does not exist"),
        "a cut MCAP file": (cut(plain(whole), 0.5), "cannot be read"),
        "an MCAP file without end": (cut(plain(whole, **NO_INDEX), 0.99), "cannot be read"),
        "a wrong bit": (flipped, "Chunk checksum mismatch"),
        "a cut file .db3": (cut(file_of(folder_of("SQLITE3")), 0.5), "cannot be read"),
        "another suffix": (content(b"", "a.zstd"), "Unrecognized storage format"),
        "another sqlite3 file": (other_sqlite, "cannot be read"),
        "ROS 1": (ros1_bag, "`rosbags-convert` converts bags of ROS 1"),
        "messages in protobuf": (
            plain(whole, encoding="protobuf", schema="protobuf"),
            "cannot be read",
        ),
        "messages of odd bytes": (
            changed(lambda r: r._replace(data=b"odd")),
            "has a nav_msgs/Odometry on /odom that cannot be decoded",
        ),
        "a schema of odd text": (plain(whole, text=lambda r: "~?"),),
        "an empty folder": (lambda f: f, "Expected metadata file"),
        "a folder that lacks a file": (
            changed_folder(lambda p: (p / "push 1.mcap").unlink(), 3),
            "push 1.mcap",
        ),
        "a folder with odd metadata": (
            changed_folder(lambda p: (p / "metadata.yaml").write_text("a: [")),
            "ros2 bag reindex",
        ),
        "a receipt as text": (odd_sqlite, "cannot be"),
        "a receipt beyond 64 bits": (
            changed(lambda r: r._replace(time=2**64 - 1)),
            "cannot be",
        ),
    }


def _frames() -> dict[str, tuple[Any, ...]]:
    """Return bags in other frames."""
    return {
        "frames with a slash": (framed("/target", "/odom", framed("/contact", "/base_link")),),
        "empty frames": (framed("/target", "", framed("/contact", "", framed("/cmd_vel", ""))),),
        "empty frames of odom": (
            edited("/odom", set_("child_frame_id", ""), source=framed("/odom", "")),
        ),
        "frames with a prefix": (prefixed(),),
        "a target in map": (framed("/target", "map"), "a frame other than odom on /target"),
        "commands in odom": (framed("/cmd_vel", "odom"), "a frame other than base_link"),
        "frames of odom change": (
            edited("/odom", set_("header.frame_id", "map"), range(9)),
            "a change of frames on",
        ),
    }


def _topics() -> dict[str, tuple[Any, ...]]:
    """Return bags with other topics."""
    whole, names = rows(), {topic[1:]: f"/ridgeback{topic}" for topic in STAMPED}
    other = renamed(names)
    texts = [f"{key}={name}" for key, name in names.items()]
    one = [r for r in whole if r.topic != "/cmd_vel" or r.time < 1.01 * SECOND]
    return {
        "other names, in one text": (other, "", ",".join(texts)),
        "names without slash": ([r._replace(topic=r.topic[1:]) for r in whole],),
        "names that are not told": (
            other,
            "has no messages on /odom, /target, /cmd_vel; its topics are "
            "/ridgeback/cmd_vel (geometry_msgs/TwistStamped)",
        ),
        "a wrong name": (
            whole,
            "has no messages on /odometry; its topics are /cmd_vel",
            {"odom": "/odometry"},
        ),
        "a wrong name of an optional topic": (whole, "no messages on /ft", {"force": "/ft"}),
        "a wrong key": (whole, "unknown key of a topic 'odometry'", {"odometry": "/odom"}),
        "a key twice": (whole, "name each once", ["odom=/odom", "odom=/o"]),
        "a topic of another type": (
            whole,
            "has a std_msgs/Float32MultiArray on /taxels that cannot",
            {"odom": "/taxels"},
        ),
        "no contacts and taxels": (
            [r for r in whole if r.topic not in ("/contact", "/taxels")],
            "has no messages on /contact or /taxels",
        ),
        "no messages": ([], "its topics are none"),
        "a path": (on_path({0: LINE, 20: LINE}),),
        "a path without poses before the path": (on_path({0: (), 20: LINE}),),
        "a path without poses, and a target": (on_path({0: (), 20: ()}),),
        "a path without poses, and no target": (
            on_path({0: (), 20: ()}, "/target"),
            "has no messages on /path with poses",
        ),
        "a path that is shortened": (
            on_path({0: LINE, 20: LINE[1:]}),
            "Path of 6 numbers on /path after one of 9, received",
        ),
        "a path that is shortened, beside a target": (
            on_path({0: LINE, 20: LINE[1:]}),
            "",
            (),
            0.0,
            TOUCH,
        ),
        "a path again after its end": (
            on_path({0: LINE, 20: (), 30: LINE}),
            "a path after one without poses on /path at 1.6",
        ),
        "one command": (one, "has too few commands, 1, on /cmd_vel"),
    }


def _values() -> dict[str, tuple[Any, ...]]:
    """Return bags with odd values."""
    zero = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 0.0}
    norm, tilt = "whose norm is not 1", "that tilts beyond 0.1 rad"
    quaternions = {
        "a quaternion of zeros": ({}, norm),
        "a quaternion of norm 1.01": ({"w": 1.01}, norm),
        "a quaternion with NaN": ({"z": NAN, "w": 1.0}, "a number that is not finite"),
        "a base on its side": ({"x": 0.7071068, "w": 0.7071068}, tilt),
        "a quaternion with w first": ({"x": 1.0}, tilt),
    }
    fields = (
        ("/odom", "pose.pose.position.x", NAN),
        ("/target", "point.x", NAN),
        ("/contact", "polygon.points", [{"x": NAN}]),
        ("/taxels", "data", [NAN] * 42),
        ("/force", "wrench.force.x", NAN),
        ("/object", "scale.x", NAN),
        ("/cmd_vel", "twist.linear.x", NAN),
        ("/cmd_vel", "twist.angular.z", float("inf")),
    )

    def opposite(message: dict[str, Any]) -> None:
        q = message["pose"]["pose"]["orientation"]
        message["pose"]["pose"]["orientation"] = {k: -v for k, v in q.items()}

    def apart(message: dict[str, Any]) -> None:
        ends = zip(message["polygon"]["points"], (-0.25, 0.25), strict=True)
        message["polygon"] = {"points": [p | {"y": p["y"] + shift} for p, shift in ends]}

    return {
        **{
            kind: (
                edited("/odom", set_("pose.pose.orientation", zero | q), [5]),
                f"{words} on /odom at 1.100 s",
            )
            for kind, (q, words) in quaternions.items()
        },
        **{
            f"{path} of {topic} = {str(value)[:20]}": (
                edited(topic, set_(path, value), [5]),
                f"not finite on {topic} at 1.100 s",
            )
            for topic, path, value in fields
        },
        "a quaternion of the opposite sign": (edited("/odom", opposite, [5]), "", (), 1e-12),
        "a contact with both ends": (edited("/contact", apart, [2, 6, 10]), "", (), 1e-7),
        "a contact of 4 points": (
            edited("/contact", set_("polygon.points", [{}] * 4), [5]),
            "a contact of 4 points",
        ),
        "taxels of two counts": (
            edited("/taxels", set_("data", [0.0] * 41), [5]),
            "of 41 numbers on /taxels after one",
        ),
        "taxels of two counts, which a law does not sense": (
            edited("/taxels", set_("data", [0.0] * 41), [5]),
            "",
            (),
            0.0,
            TOUCH,
        ),
    }


ALL = cases()


def reference(folder: Path) -> dict[str, np.ndarray]:
    """Return the steps of the plain bag, as `rps push` writes it."""
    return bag.read(bag.write(folder / "reference.mcap", push(), {}))


def result_of(case: Case, folder: Path, expected: dict[str, np.ndarray]) -> str:
    """Return the sentence of a refusal, or how the steps differ; nothing if they are equal."""
    try:
        write = case.source if callable(case.source) else plain(case.source)
        steps = bag.read(write(folder), case.topics, case.senses)
    except InputError as error:
        return str(error)
    late = steps["time"][0] - expected["time"][-len(steps["time"])]
    steps["time"] = steps["time"] - late if abs(late) > 1e8 else steps["time"]
    for name, values in expected.items():
        if name not in steps:
            if "object" not in name and name in case.senses:
                return f"{name} is missing"
            continue
        part = values[-len(steps["time"]) :]
        if name == "period":
            part, steps[name] = part[1:], steps[name][1:]
        difference = np.abs(steps[name] - part).max()
        if not difference <= case.atol:
            return f"{name} differs by {difference:.3g}"
    return ""
