"""Bags of ROS 2 (MCAP): observations and commands of a law, in standard messages.

Each topic has one message per control step, except `/tf` and the markers, which are for viewers:

    /odom           nav_msgs/Odometry              pose of the base and its velocity in its frame
    /target         geometry_msgs/PointStamped     the target, in the frame odom
    /contact        geometry_msgs/PolygonStamped   in base_link: no point without contact, one for a
                                                   point contact, twice the same for a line contact
    /taxels         std_msgs/Float32MultiArray     relative change of capacitance of each taxel,
                                                   along the strip; filtered if there are contacts,
                                                   else the raw signal
    /force          geometry_msgs/WrenchStamped    of the object on the base, if a law senses it
    /object         visualization_msgs/Marker      a cylinder as wide as the object, if a law senses
                                                   its pose
    /cmd_vel        geometry_msgs/TwistStamped     the command, last of its step
    /target_marker  visualization_msgs/Marker      the target, once a second
    /tf             tf2_msgs/TFMessage             odom to base_link and to object
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rps_jax import errors
from rps_jax.errors import InputError
from rps_jax.record import files

Message = dict[str, Any]  # fields of any type
Floats = Sequence[float] | np.ndarray
_MAX_BYTES = 64 * 2**20  # of a record, and of an unpacked chunk
_MAX_NUMBERS = 2**28  # of all steps; each field counts 8 more for its Python object
_MARKER_PERIOD = 1.0  # [s] between two target markers
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
_REQUIRED = ("/odom", "/target", "/cmd_vel")
_TOUCH_TOPICS = ("/contact", "/taxels")  # of which one is required, too


class Step(NamedTuple):
    """Observation and command of a control step."""

    time: float  # [s]
    pose: Floats  # (3,) [m, m, rad] of the base in the world, by odometry
    target: Floats  # (2,) [m] in the world
    contact_type: int  # 0 none, 1 a point, 2 a line
    p_robot_contact: Floats  # (2,) [m] in the robot frame
    twist: Floats  # (3,) [m/s, m/s, rad/s] commanded, in the robot frame
    signal: Floats | None = None  # (T,) [1] of the taxels
    f_robot: Floats | None = None  # (2,) [N] of the object on the base
    p_world_object: Floats | None = None  # (2,) [m]
    r_object: float = 0.0  # [m]
    object_pose: Floats | None = None  # (3,) [m, m, rad] for viewers alone


_require = partial(errors.require, extra="bags")


def check() -> None:
    """Raise InputError unless the packages of the extra `bags` are installed."""
    _ = _require("mcap_ros2.writer"), _require("rosbags.typesys")


# --- writing -------------------------------------------------------------------------------


def write(path: Path, steps: Iterable[Step], metadata: Mapping[str, str]) -> Path:
    """Write a bag atomically."""
    module, typesys = _require("mcap_ros2.writer"), _require("rosbags.typesys")
    definitions = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)

    def fill(partial: Path) -> None:
        with open(partial, "wb") as file, module.Writer(file) as writer:
            schemas = {}
            for kind in dict.fromkeys(TOPICS.values()):
                name = kind.replace("/", "/msg/")
                text, _ = definitions.generate_msgdef(name, ros_version=2)
                schemas[kind] = writer.register_msgdef(name, text)
            writer.add_metadata("rps_jax", dict(metadata))
            for topic, time, message in _messages(steps):
                writer.write_message(topic, schemas[TOPICS[topic]], message, time, time)

    return files.write_atomically(path, fill)


def _messages(steps: Iterable[Step]) -> Iterator[tuple[str, int, Message]]:
    """Yield topics, times [ns] and messages of steps in order; absent fields are zero."""
    previous, marker_time = None, -math.inf
    for step in steps:
        stamp = round(1e9 * step.time)
        odom, base = _header(stamp, "odom"), _header(stamp, "base_link")
        x, y, yaw = map(float, step.pose)
        pose = {"position": _xyz(x, y), "orientation": _yaw(yaw)}
        yield "/odom", stamp, {
            "header": odom,
            "child_frame_id": "base_link",
            "pose": {"pose": pose},
            "twist": {"twist": _velocity(previous, step)},
        }  # fmt: skip
        yield "/target", stamp, {"header": odom, "point": _xyz(*step.target)}
        points = [_xyz(*step.p_robot_contact)] * int(step.contact_type)
        yield "/contact", stamp, {"header": base, "polygon": {"points": points}}
        if step.signal is not None:
            count = len(step.signal)
            dim = [{"label": "taxels", "size": count, "stride": count}]
            yield "/taxels", stamp, {"layout": {"dim": dim}, "data": list(step.signal)}
        if step.f_robot is not None:
            yield "/force", stamp, {"header": base, "wrench": {"force": _xyz(*step.f_robot)}}
        if step.p_world_object is not None:
            width = 2 * float(step.r_object)
            yield "/object", stamp, _cylinder(odom, "object", step.p_world_object, width)
        frames = [_frame(odom, "base_link", x, y, yaw)]
        if step.object_pose is not None:
            frames.append(_frame(odom, "object", *map(float, step.object_pose)))
        yield "/tf", stamp, {"transforms": frames}
        if step.time >= marker_time + _MARKER_PERIOD:
            marker_time = step.time
            yield "/target_marker", stamp, _cylinder(odom, "target", step.target, 0.1)
        yield "/cmd_vel", stamp, {"header": base, "twist": _twist(*step.twist)}
        previous = step


def _header(stamp: int, frame: str) -> Message:
    return {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": frame}


def _xyz(x: float, y: float) -> dict[str, float]:
    return {"x": float(x), "y": float(y)}


def _yaw(yaw: float) -> dict[str, float]:
    return {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def _twist(v_x: float, v_y: float, omega: float) -> Message:
    return {"linear": _xyz(v_x, v_y), "angular": {"z": float(omega)}}


def _velocity(previous: Step | None, step: Step) -> Message:
    """Return the velocity of the base since the previous step, in its own frame."""
    if previous is None or step.time <= previous.time:
        return _twist(0, 0, 0)
    pose = np.asarray(step.pose, float)
    v_x, v_y, omega = (pose - np.asarray(previous.pose, float)) / (step.time - previous.time)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return _twist(c * v_x + s * v_y, c * v_y - s * v_x, omega)


def _frame(header: Message, child: str, x: float, y: float, yaw: float) -> Message:
    transform = {"translation": _xyz(x, y), "rotation": _yaw(yaw)}
    return {"header": header, "child_frame_id": child, "transform": transform}


def _cylinder(header: Message, name: str, center: Floats, width: float) -> Message:
    """Return a marker of type 3."""
    pose = {"position": _xyz(*center), "orientation": _yaw(0)}
    return {
        **{"header": header, "ns": name, "type": 3, "pose": pose},
        "scale": {"x": width, "y": width, "z": 0.01},
        "color": {"r": 0.1, "g": 0.6, "b": 0.2, "a": 0.8},
    }


# --- reading -------------------------------------------------------------------------------


def read(path: Path) -> dict[str, np.ndarray]:
    """Return the steps of a bag as arrays, by the fields of `Step` that it has, and `period`.

    A step is a command with the latest messages before it. A bag with `/taxels` alone, as of a
    robot, has no `contact_type` and no `p_robot_contact`.

    Raises:
      InputError: the file is no bag, is damaged or too large, or lacks a topic.
    """
    rows: list[dict[str, Any]] = []
    latest: dict[str, Any] = {}
    size = 0
    try:
        with open(path, "rb") as file:
            for topic, time, message in _decoded(file):
                if topic == "/contact" and topic not in latest:
                    rows.clear()  # earlier steps have none
                latest[topic] = message
                if topic == "/cmd_vel" and not _missing(latest):
                    rows.append(_observed(1e-9 * time, latest))
                    size += sum(8 + np.size(value) for value in rows[-1].values())
                    if size > _MAX_NUMBERS:
                        raise ValueError(f"it has more than {_MAX_NUMBERS} numbers")
        if missing := _missing(latest):
            raise ValueError(f"it has no messages on {', '.join(missing)}")
        if not rows:
            raise ValueError("it has no command after its observations")
        steps = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        for name, values in steps.items():
            if not np.isfinite(values).all():
                raise ValueError(f"its {name} is not finite")
        periods = np.diff(steps["time"])
        if len(rows) < 2 or (periods <= 0).any():
            raise ValueError("its commands are not at least two, one after the other")
    except InputError:
        raise
    except Exception as error:  # of any kind, by the readers of a damaged file
        text = getattr(error, "strerror", None) or " ".join(str(error).split())[:200].rstrip(".")
        raise InputError(
            f"bag = {path} cannot be read ({text or type(error).__name__}): give an MCAP file with "
            f"the topics {', '.join(_REQUIRED)}, and {' or '.join(_TOUCH_TOPICS)}."
        ) from error
    steps["pose"][:, 2] = np.unwrap(steps["pose"][:, 2])
    steps["period"] = np.concatenate([[np.median(periods)], periods])
    return steps


def _missing(latest: Mapping[str, Any]) -> list[str]:
    """Return the required topics that a bag lacks."""
    has_touch = any(topic in latest for topic in _TOUCH_TOPICS)
    touch = [] if has_touch else [" or ".join(_TOUCH_TOPICS)]
    return [topic for topic in _REQUIRED if topic not in latest] + touch


def _decoded(file: Any) -> Iterator[tuple[str, int, Any]]:
    """Yield topics, times [ns] and messages of a file, chunk by chunk."""
    stream, readers = _require("mcap.stream_reader"), _require("mcap.reader")
    limit = {"record_size_limit": _MAX_BYTES}
    for record in stream.StreamReader(file, emit_chunks=True, **limit).records:
        if (size := getattr(record, "uncompressed_size", 0)) > _MAX_BYTES:
            raise ValueError(f"it has a chunk of {size} bytes")
    file.seek(0)
    decoders = [_require("mcap_ros2.decoder").DecoderFactory()]
    reader = readers.NonSeekingReader(file, decoder_factories=decoders, **limit)
    # In the order of the file, without loading it whole.
    for entry in reader.iter_decoded_messages([*TOPICS], log_time_order=False):
        topic, kind = entry.channel.topic, entry.schema.name if entry.schema else "no type"
        if kind.replace("/msg/", "/") != TOPICS[topic]:
            raise ValueError(f"{topic} has {kind[:60]} for {TOPICS[topic]}")
        yield topic, entry.message.log_time, entry.decoded_message


def _observed(time: float, latest: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of `Step` in the latest messages."""
    pose, twist = latest["/odom"].pose.pose, latest["/cmd_vel"].twist
    yaw = 2 * math.atan2(pose.orientation.z, pose.orientation.w)
    fields: dict[str, Any] = {
        "time": time,
        "pose": (*_xy(pose.position), yaw),
        "target": _xy(latest["/target"].point),
        "twist": (*_xy(twist.linear), twist.angular.z),
    }
    if "/contact" in latest:
        points = latest["/contact"].polygon.points
        fields["contact_type"] = min(len(points), 2)
        fields["p_robot_contact"] = _xy(points[0]) if points else (0.0, 0.0)
    if "/taxels" in latest:
        fields["signal"] = np.array(latest["/taxels"].data, np.float32)
    if "/force" in latest:
        fields["f_robot"] = _xy(latest["/force"].wrench.force)
    if "/object" in latest:
        fields["p_world_object"] = _xy(latest["/object"].pose.position)
        fields["r_object"] = 0.5 * latest["/object"].scale.x
    return fields


def _xy(vector: Any) -> tuple[float, float]:
    return vector.x, vector.y
