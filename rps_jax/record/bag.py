"""Bags of ROS 2 (MCAP): what a law observed and what was commanded, in standard messages.

Topics, each with one message a control step but `/tf` and the marker, which are for looking:

    /odom           nav_msgs/Odometry              pose of the base and its velocity in its frame
    /target         geometry_msgs/PointStamped     the target, in the frame odom
    /contact        geometry_msgs/PolygonStamped   in base_link: no point without contact, one for
                                                   a contact that is a point, twice the same for a
                                                   line
    /taxels         std_msgs/Float32MultiArray     relative change of capacitance of each taxel,
                                                   along the strip; filtered if there are contacts,
                                                   and else as the skin answered
    /force          geometry_msgs/WrenchStamped    of the object on the base, where a law senses it
    /object         visualization_msgs/Marker      a cylinder as wide as the object, where a law
                                                   senses its pose
    /cmd_vel        geometry_msgs/TwistStamped     what was commanded then, last of its step
    /target_marker  visualization_msgs/Marker      the target, once a second
    /tf             tf2_msgs/TFMessage             odom to base_link and to object
"""

from __future__ import annotations

import dataclasses
import io
import math
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rps_jax import errors
from rps_jax.errors import InputError
from rps_jax.record import files

_MOST = 64 * 2**20  # bytes of a record, and of a chunk when it is unpacked
_MOST_NUMBERS = 2**28  # of all steps, where a field counts 8 more, which Python adds to it
_SHOWN = 1.0  # [s] between two markers
_FIELDS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "std_msgs/ColorRGBA": "float32 r\nfloat32 g\nfloat32 b\nfloat32 a",
    "std_msgs/MultiArrayDimension": "string label\nuint32 size\nuint32 stride",
    "std_msgs/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim\nuint32 data_offset",
    "std_msgs/Float32MultiArray": "std_msgs/MultiArrayLayout layout\nfloat32[] data",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Point32": "float32 x\nfloat32 y\nfloat32 z",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/Wrench": "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque",
    "geometry_msgs/Polygon": "geometry_msgs/Point32[] points",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\n"
    "geometry_msgs/Quaternion rotation",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "geometry_msgs/PointStamped": "std_msgs/Header header\ngeometry_msgs/Point point",
    "geometry_msgs/TwistStamped": "std_msgs/Header header\ngeometry_msgs/Twist twist",
    "geometry_msgs/WrenchStamped": "std_msgs/Header header\ngeometry_msgs/Wrench wrench",
    "geometry_msgs/PolygonStamped": "std_msgs/Header header\ngeometry_msgs/Polygon polygon",
    "geometry_msgs/TransformStamped": "std_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/Transform transform",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "nav_msgs/Odometry": "std_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist",
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data",
    "visualization_msgs/UVCoordinate": "float32 u\nfloat32 v",
    "visualization_msgs/MeshFile": "string filename\nuint8[] data",
    "visualization_msgs/Marker": "std_msgs/Header header\nstring ns\nint32 id\nint32 type\n"
    "int32 action\ngeometry_msgs/Pose pose\ngeometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\n"
    "builtin_interfaces/Duration lifetime\nbool frame_locked\ngeometry_msgs/Point[] points\n"
    "std_msgs/ColorRGBA[] colors\nstring texture_resource\nsensor_msgs/CompressedImage texture\n"
    "visualization_msgs/UVCoordinate[] uv_coordinates\nstring text\nstring mesh_resource\n"
    "visualization_msgs/MeshFile mesh_file\nbool mesh_use_embedded_materials",
}
TOPICS = {
    "/odom": "nav_msgs/Odometry",
    "/target": "geometry_msgs/PointStamped",
    "/contact": "geometry_msgs/PolygonStamped",
    "/taxels": "std_msgs/Float32MultiArray",
    "/force": "geometry_msgs/WrenchStamped",
    "/object": "visualization_msgs/Marker",
    "/cmd_vel": "geometry_msgs/TwistStamped",
    "/target_marker": "visualization_msgs/Marker",
    "/tf": "tf2_msgs/TFMessage",
}
_NEEDED = ("/odom", "/target", "/cmd_vel")
_TOUCH = ("/contact", "/taxels")  # of which one is needed, too


class Step(NamedTuple):
    """One control step of a bag."""

    time: float  # [s]
    pose: Any  # (3,) [m, m, rad] of the base in the world, as odometry has it
    target: Any  # (2,) [m] in the world
    contact_type: int  # 0 none, 1 a point, 2 a line
    p_robot_contact: Any  # (2,) [m] in the robot frame
    twist: Any  # (3,) [m/s, m/s, rad/s] commanded, in the robot frame
    signal: Any = None  # (T,) [1] of the taxels
    f_robot: Any = None  # (2,) [N] of the object on the base
    p_world_object: Any = None  # (2,) [m]
    r_object: Any = None  # () [m]
    object_pose: Any = None  # (3,) [m, m, rad] for looking alone


_require = partial(errors.require, extra="bags")


def check() -> None:
    """Raises InputError unless what bags need is installed."""
    _require("mcap_ros2.writer")


def _definition(kind: str) -> str:
    """A message definition with those of its parts, as bags have them."""
    parts, waiting = [], [kind]
    for one in waiting:
        for line in _FIELDS[one].splitlines():
            inner = line.split()[0].split("[")[0]
            if inner in _FIELDS and inner not in waiting:
                waiting.append(inner)
        parts.append((f"MSG: {one}\n" if one != kind else "") + _FIELDS[one] + "\n")
    return ("=" * 80 + "\n").join(parts)


# --- writing -------------------------------------------------------------------------------


def write(path: Path, steps: Iterable[Step], about: Mapping[str, str]) -> Path:
    """Write a bag, whole or not at all; `about` is kept as its metadata."""
    module = _require("mcap_ros2.writer")

    def fill(partial: Path) -> None:
        with open(partial, "wb") as file, module.Writer(file) as writer:
            names = {kind: kind.replace("/", "/msg/") for kind in TOPICS.values()}
            kinds = {k: writer.register_msgdef(names[k], _definition(k)) for k in names}
            writer.add_metadata("rps_jax", dict(about))
            for topic, time, message in _messages(steps):
                writer.write_message(topic, kinds[TOPICS[topic]], message, time, time)

    return files.write_atomically(path, fill)


def _messages(steps: Iterable[Step]) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Topics, times [ns] and messages of steps, in their order; what a message lacks is zero."""
    before, shown = None, -math.inf
    for step in steps:
        now = round(1e9 * step.time)
        odom, base = _header(now, "odom"), _header(now, "base_link")
        x, y, yaw = map(float, step.pose)
        placed = {"position": _xyz(x, y), "orientation": _turned(yaw)}
        yield "/odom", now, {
            "header": odom,
            "child_frame_id": "base_link",
            "pose": {"pose": placed},
            "twist": {"twist": _velocity(before, step)},
        }  # fmt: skip
        yield "/target", now, {"header": odom, "point": _xyz(*step.target)}
        touched = [_xyz(*step.p_robot_contact)] * int(step.contact_type)
        yield "/contact", now, {"header": base, "polygon": {"points": touched}}
        if step.signal is not None:
            count = len(step.signal)
            dim = [{"label": "taxels", "size": count, "stride": count}]
            yield "/taxels", now, {"layout": {"dim": dim}, "data": list(step.signal)}
        if step.f_robot is not None:
            yield "/force", now, {"header": base, "wrench": {"force": _xyz(*step.f_robot)}}
        if step.p_world_object is not None:
            width = 2 * float(step.r_object)
            yield "/object", now, _cylinder(odom, "object", step.p_world_object, width)
        moved = [_frame(odom, "base_link", x, y, yaw)]
        if step.object_pose is not None:
            moved.append(_frame(odom, "object", *map(float, step.object_pose)))
        yield "/tf", now, {"transforms": moved}
        if step.time >= shown + _SHOWN:
            shown = step.time
            yield "/target_marker", now, _cylinder(odom, "target", step.target, 0.1)
        yield "/cmd_vel", now, {"header": base, "twist": _twist(*step.twist)}
        before = step


def _header(now: int, frame: str) -> dict[str, Any]:
    return {"stamp": {"sec": now // 10**9, "nanosec": now % 10**9}, "frame_id": frame}


def _xyz(x: Any, y: Any) -> dict[str, float]:
    return {"x": float(x), "y": float(y)}


def _turned(yaw: float) -> dict[str, float]:
    return {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def _twist(v_x: Any, v_y: Any, omega: Any) -> dict[str, Any]:
    return {"linear": _xyz(v_x, v_y), "angular": {"z": float(omega)}}


def _velocity(before: Step | None, step: Step) -> dict[str, Any]:
    """The velocity of the base since the step before, in its own frame."""
    if before is None or step.time <= before.time:
        return _twist(0, 0, 0)
    way = (np.asarray(step.pose, float) - np.asarray(before.pose, float)) / (
        step.time - before.time
    )
    c, s = math.cos(step.pose[2]), math.sin(step.pose[2])
    return _twist(c * way[0] + s * way[1], c * way[1] - s * way[0], way[2])


def _frame(header: Any, child: str, x: float, y: float, yaw: float) -> dict[str, Any]:
    transform = {"translation": _xyz(x, y), "rotation": _turned(yaw)}
    return {"header": header, "child_frame_id": child, "transform": transform}


def _cylinder(header: Any, name: str, place: Any, width: float) -> dict[str, Any]:
    """A marker of type 3."""
    return {
        **{"header": header, "ns": name, "type": 3, "pose": {"position": _xyz(*place)}},
        "scale": {"x": width, "y": width, "z": 0.01},
        "color": {"r": 0.1, "g": 0.6, "b": 0.2, "a": 0.8},
    }


# --- reading -------------------------------------------------------------------------------


def read(path: Path) -> dict[str, np.ndarray]:
    """The steps of a bag, as arrays by the fields of `Step`; those that it lacks are missing.

    A step is a command, with what was heard last before it. The period of each is beside. A bag
    with `/taxels` alone, as a robot's is, has no `contact_type` and no `p_robot_contact`.

    Raises:
      InputError: the file is no bag, is damaged or too large, or lacks a topic.
    """
    columns: dict[str, list[Any]] = {}
    latest: dict[str, Any] = {}
    held = 0
    try:
        with open(path, "rb") as file:
            for topic, time, message in _decoded(file):
                if topic == "/contact" and topic not in latest:
                    columns.clear()  # what came before has none
                latest[topic] = message
                if topic == "/cmd_vel" and not _missing(latest):
                    for name, value in _observed(1e-9 * time, latest).items():
                        columns.setdefault(name, []).append(value)
                        held += 8 + np.size(value)
                    if held > _MOST_NUMBERS:
                        raise ValueError(f"it has more than {_MOST_NUMBERS} numbers")
        if missing := _missing(latest):
            raise ValueError(f"it has no messages on {', '.join(missing)}")
        if not columns:
            raise ValueError("it has no command after its observations")
        count = len(columns["time"])
        found = {k: np.array(v) for k, v in columns.items() if len(v) == count}
        if odd := [name for name, values in found.items() if not np.isfinite(values).all()]:
            raise ValueError(f"its {odd[0]} is not finite")
        periods = np.diff(found["time"])
        if count < 2 or (periods <= 0).any():
            raise ValueError("its commands are not at least two, one after the other")
    except InputError:
        raise
    except (OSError, MemoryError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or type(error).__name__
        raise InputError(f"bag = {path} cannot be read ({reason}): give an MCAP file.") from error
    except Exception as error:  # whatever the readers of a damaged file raise
        said = " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__
        raise InputError(
            f"bag = {path} is not allowed ({said}): give an MCAP file with the topics "
            f"{', '.join(_NEEDED)}, and {' or '.join(_TOUCH)}."
        ) from error
    found["pose"][:, 2] = np.unwrap(found["pose"][:, 2])
    found["period"] = np.concatenate([[np.median(periods)], periods])
    return found


def _missing(latest: Mapping[str, Any]) -> list[str]:
    """Topics that a bag must have, and has not."""
    touch = [] if any(one in latest for one in _TOUCH) else [" or ".join(_TOUCH)]
    return [one for one in _NEEDED if one not in latest] + touch


def _decoded(file: Any) -> Iterator[tuple[str, int, Any]]:
    """Topics, times [ns] and messages of a file, chunk by chunk."""
    stream, records = _require("mcap.stream_reader"), _require("mcap.records")
    decoders = _require("mcap_ros2.decoder").DecoderFactory()
    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    reader = stream.StreamReader(file, emit_chunks=True, record_size_limit=_MOST)
    for outer in reader.records:
        inside = isinstance(outer, records.Chunk)
        for record in stream.breakup_chunk(_unpacked(outer)) if inside else [outer]:
            if isinstance(record, records.Schema):
                schemas[record.id] = record
            elif isinstance(record, records.Channel):
                channels[record.id] = record
            elif isinstance(record, records.Message):
                channel = channels[record.channel_id]
                wanted, schema = TOPICS.get(channel.topic), schemas.get(channel.schema_id)
                kind = schema.name if schema else "no type"
                if wanted is None:
                    continue
                if kind.replace("/msg/", "/") != wanted:
                    raise ValueError(f"{channel.topic} has {kind[:60]} for {wanted}")
                decode = decoders.decoder_for(channel.message_encoding, schema)
                if decode is None:
                    raise ValueError(f"{channel.topic} is not encoded as ROS 2 does")
                yield channel.topic, record.log_time, decode(record.data)


def _unpacked(chunk: Any) -> Any:
    """A chunk without compression, of a bounded size whatever it says."""
    if chunk.compression == "zstd":
        reader = _require("zstandard").ZstdDecompressor().stream_reader(io.BytesIO(chunk.data))
        data = reader.read(_MOST + 1)
    elif chunk.compression == "lz4":
        data = _require("lz4.frame").LZ4FrameDecompressor().decompress(chunk.data, _MOST + 1)
    else:
        return chunk
    if len(data) > _MOST or len(data) != chunk.uncompressed_size:
        raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes is not what it says")
    return dataclasses.replace(chunk, data=data, compression="")


def _observed(time: float, latest: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of `Step` in the latest messages."""
    pose = latest["/odom"].pose.pose
    turn, place, target = pose.orientation, pose.position, latest["/target"].point
    sent = latest["/cmd_vel"].twist
    found: dict[str, Any] = {
        "time": time,
        "pose": (place.x, place.y, 2 * math.atan2(turn.z, turn.w)),
        "target": (target.x, target.y),
        "twist": (sent.linear.x, sent.linear.y, sent.angular.z),
    }
    if "/contact" in latest:
        points = latest["/contact"].polygon.points
        found["contact_type"] = min(len(points), 2)
        found["p_robot_contact"] = (points[0].x, points[0].y) if points else (0.0, 0.0)
    if "/taxels" in latest:
        found["signal"] = np.array(latest["/taxels"].data, np.float32)
    if "/force" in latest:
        force = latest["/force"].wrench.force
        found["f_robot"] = (force.x, force.y)
    if "/object" in latest:
        thing = latest["/object"]
        found["p_world_object"] = (thing.pose.position.x, thing.pose.position.y)
        found["r_object"] = 0.5 * thing.scale.x
    return found
