"""Bags of ROS 2: observations and commands of a law, in standard messages.

`write` makes an MCAP file. `read` also reads sqlite3 (.db3), folders of `ros2 bag record`, and zstd
compression. Each topic has one message per control step, except `/tf` and the markers:

    /odom           nav_msgs/Odometry              pose of the base and its velocity in its frame
    /target         geometry_msgs/PointStamped     the target (read, too: PoseStamped)
    /contact        geometry_msgs/PolygonStamped   in base_link: no point without contact, one for a
                                                   point contact, twice the same for a line contact
    /taxels         std_msgs/Float32MultiArray     relative change of capacitance of each taxel,
                                                   along the strip; filtered if there are contacts,
                                                   else the raw signal
    /force          geometry_msgs/WrenchStamped    of the object on the base, if a law senses it
    /object         visualization_msgs/Marker      a cylinder as wide as the object, if a law senses
                                                   its pose
    /cmd_vel        geometry_msgs/TwistStamped     the command, last of its step (read, too: Twist)
    /target_marker  visualization_msgs/Marker      the target, once a second
    /tf             tf2_msgs/TFMessage             odom to base_link and to object

Time is that of the header stamps. A topic whose messages have no stamp, or the stamp zero, has the
time of receipt less the median delay of the stamped topics. The order of the file does not matter.

The law needs target and object in the frame of the odometry, and contact and force in its child
frame. `read` transforms them from other frames by `/tf`, `/tf_static` and the odometry, at their
stamps. An empty frame is the one that the law needs.
"""

from __future__ import annotations

import functools
import math
from array import array
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rps_jax import errors
from rps_jax.errors import InputError
from rps_jax.record import bag_storage, files, options
from rps_jax.record.bag_storage import is_bag as is_bag

Message = dict[str, Any]  # fields of any type
Floats = Sequence[float] | np.ndarray
TopicsLike = str | Mapping[str, str] | Sequence[str]  # names of topics: see `topic_names`
_MAX_NUMBERS = 2**28  # of all messages, and of all steps; a message counts 8 more
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
_REQUIRED = ("odom", "target", "cmd_vel")
_TOUCH = ("contact", "taxels")  # of which one is required, too
_STALE = 1.0  # [s] that a stream of messages may pause
_EARLY = 0.1  # [s] before a transform that it holds
_SKEW = 0.5  # [s] of 80 % of the delays between stamp and receipt
_MAX_TILT = 0.1  # [rad] of the base against the floor
_UNIT = 1e-3  # [1] by which the norm of a quaternion may differ from 1
_SAME = 1e-6  # [m] by which two frames may differ that are one


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


def topic_names(topics: TopicsLike) -> dict[str, str]:
    """Return the topics of a bag by their keys, as {"odom": "/odom", ...}.

    Args:
      topics: other names, as {"odom": "/ridgeback/odom"} or texts `odom=/ridgeback/odom`.

    Raises:
      InputError: a key is unknown or repeated, or a name is missing.
    """
    renamed = _renamed(topics)
    return {key: f"/{key}" for key in _READERS if key not in renamed} | renamed


def _renamed(topics: TopicsLike) -> dict[str, str]:
    """Return the topics that have other names, by their keys."""
    whole = topics if isinstance(topics, str | Mapping) else ",".join(map(str, topics))
    names = options.parse_names("topic", whole)
    for key in names:
        errors.check_name("key of a topic", key, _READERS)
    return {key: f"/{name.strip('/')}" for key, name in names.items()}


def read(path: Path, topics: TopicsLike = ()) -> dict[str, np.ndarray]:
    """Return the steps of a bag as arrays, by the fields of `Step` that it has, and `period`.

    A step is a command, with the latest message of each other topic that is not after it. Steps
    begin when each topic has had a message. A bag with `/taxels` alone, as of a robot, has no
    `contact_type` and no `p_robot_contact`.

    Args:
      path: of an MCAP file, of an sqlite3 file, or of a folder of `ros2 bag record`.
      topics: other names of topics: see `topic_names`.

    Raises:
      InputError: the path is no bag; the bag is damaged or too large, or lacks a topic; or its
        messages have no order, numbers that are not finite, an unknown frame, or no rotation.
    """
    names, renamed = topic_names(topics), _renamed(topics)
    check()
    try:
        return _steps(Path(path), names, renamed)
    except InputError as error:
        raise InputError(f"bag = {path} {str(error).rstrip('.')}.") from error


def _steps(path: Path, names: dict[str, str], required: Iterable[str]) -> dict[str, np.ndarray]:
    """Return the steps of a bag, as `read` does."""
    logs, contents = _collect(path, {k: v for k, v in names.items() if k not in _FRAMES})
    missing = [names[key] for key in {**dict.fromkeys(_REQUIRED), **dict.fromkeys(required)}
               if key not in logs and key not in _FRAMES]  # fmt: skip
    if not any(key in logs for key in _TOUCH):
        missing.append(" or ".join(names[key] for key in _TOUCH))
    if missing:
        kinds = [f"{topic} ({kind})"[:90] for topic, kind in sorted(contents.items())]
        more = f" and {len(kinds) - 10} more" if len(kinds) > 10 else ""
        raise InputError(
            f"has no messages on {', '.join(missing)}; its topics are "
            f"{', '.join(kinds[:10]) or 'none'}{more}: name others by --topic KEY=/TOPIC"
        )
    delay = _delay(logs.values())
    series = {key: log.in_order(delay) for key, log in logs.items()}
    commands = series.pop("cmd_vel")
    commands = commands.at(np.flatnonzero(np.append(np.diff(commands.time) > 0, True)))
    last = max(series.values(), key=lambda s: s.time[0])  # to begin
    commands = commands.at(commands.time >= last.time[0])
    if len(commands.time) < 2:
        raise InputError(
            f"has too few commands, {len(commands.time)}, on {commands.topic} after the first "
            f"message of {last.topic} at {_seconds(last.time[0])} s: record at least two"
        )
    widths = sum(s.values.shape[1] + 8 for s in [commands, *series.values()])
    _check_size(len(commands.time) * widths)
    rows = {key: s.at(s.latest(commands.time)) for key, s in series.items()}
    for key, row in rows.items():
        is_stream = key != "target" and len(series[key].time) > len(commands.time) / 4
        age = 1e-9 * (commands.time - row.time)
        if (key == "odom" or is_stream) and age.max() > _STALE:
            when = _seconds(commands.time[age.argmax()])
            raise InputError(
                f"has no message on {row.topic} in the {age.max():.3g} s before the command at "
                f"{when} s: cut the bag there, or synchronise the clocks"
            )
    rows["cmd_vel"] = commands
    for key, row in rows.items():
        row.check(_MAX_TILT if key == "odom" else None)
    _to_frames(rows, _Transforms(path, names, series["odom"], delay))
    return _fields(commands, rows)


def _fields(commands: _Series, rows: Mapping[str, _Series]) -> dict[str, np.ndarray]:
    """Return the fields of `Step`, by the values of topics at the commands."""
    odom = rows["odom"].values
    # math.atan2 has the same bits on every machine.
    yaw = [2 * math.atan2(z, w) for z, w in odom[:, 5:].tolist()]
    time = 1e-9 * commands.time
    periods = np.diff(time)
    fields = {
        "time": time,
        "period": np.concatenate([[np.median(periods)], periods]),
        "pose": np.column_stack([odom[:, :2], np.unwrap(yaw)]),
        "target": rows["target"].values[:, :2],
        "twist": commands.values,
    }
    if "contact" in rows:
        fields["contact_type"] = rows["contact"].values[:, 3].astype(int)
        fields["p_robot_contact"] = rows["contact"].values[:, :2]
    if "taxels" in rows:
        fields["signal"] = rows["taxels"].values.astype(np.float32)
    if "force" in rows:
        fields["f_robot"] = rows["force"].values[:, :2]
    if "object" in rows:
        fields["p_world_object"] = rows["object"].values[:, :2]
        fields["r_object"] = 0.5 * rows["object"].values[:, 3]
    return fields


def _seconds(time: float) -> str:
    return f"{1e-9 * time:.3f}"


# --- messages as arrays --------------------------------------------------------------------


@dataclass
class _Log:
    """Messages of one topic in the order of the bag, in compact arrays."""

    topic: str
    receipt: array[int] = field(default_factory=lambda: array("q"))  # [ns]
    stamp: array[int] = field(default_factory=lambda: array("q"))  # [ns] of the header, or 0
    frames: array[int] = field(default_factory=lambda: array("q"))  # indices of `pairs`
    pairs: dict[tuple[str, str], int] = field(default_factory=dict)  # of the header, of the child
    values: array[float] = field(default_factory=lambda: array("d"))
    width: int = 0  # of the values of a message

    def append(self, receipt: int, part: Any, values: Floats) -> None:
        """Append the values of a message, or of a part of one."""
        header, child = getattr(part, "header", None), getattr(part, "child_frame_id", "")
        stamp = 0 if header is None else header.stamp.sec * 10**9 + header.stamp.nanosec
        frame = "" if header is None else header.frame_id
        pair = frame.lstrip("/"), child.lstrip("/")
        self.width = self.width or len(values)
        if self.width != len(values) or not self.width:
            raise InputError(
                f"has {self.width} and {len(values)} values on {self.topic}, at "
                f"{_seconds(stamp or receipt)} s: cut the bag there"
            )
        self.receipt.append(receipt)
        self.stamp.append(stamp)
        self.frames.append(self.pairs.setdefault(pair, len(self.pairs)))
        self.values.frombytes(np.asarray(values, float).tobytes())

    def in_order(self, delay: int | None, *, merged: bool = False) -> _Series:
        """Return the messages in the order of time; the last of equal times is the last received.

        Args:
          delay: [ns] from stamp to receipt, or None if it is not constant.
          merged: whether the topic has several publishers, whose stamps may overlap.

        Raises:
          InputError: header stamps go back, or a topic without them has no time.
        """
        receipt, stamp = np.asarray(self.receipt), np.asarray(self.stamp)
        if stamp.any():
            time, by_receipt = stamp, np.argsort(receipt, kind="stable")
            back = np.diff(stamp) < 0
            # One of both orders may be wrong: files are reordered, and clocks of receivers jump.
            if not merged and back.any() and (np.diff(stamp[by_receipt]) < 0).any():
                i = int(np.argmax(back))
                raise InputError(
                    f"has header stamps on {self.topic} that go back from {_seconds(stamp[i])} to "
                    f"{_seconds(stamp[i + 1])} s: cut the bag there"
                )
        elif delay is None:
            raise InputError(
                f"has no header stamps on {self.topic}, and times of receipt that do not keep pace "
                "with the stamps of other topics: record all topics by one clock, in simulation "
                "with --use-sim-time"
            )
        else:
            time = receipt - delay
        order = np.lexsort((receipt, time))
        values = np.frombuffer(self.values).reshape(len(time), self.width)
        frames = np.asarray(self.frames)[order]
        return _Series(self.topic, time[order], values[order], frames, list(self.pairs))


class _Series(NamedTuple):
    """Messages of one topic in the order of time."""

    topic: str
    time: np.ndarray  # (N,) [ns]
    values: np.ndarray  # (N, k)
    frames: np.ndarray  # (N,) indices of `pairs`
    pairs: list[tuple[str, str]]  # frames of headers, and of children

    def at(self, index: np.ndarray) -> _Series:
        """Return some of the messages."""
        time, values, frames = self.time[index], self.values[index], self.frames[index]
        return self._replace(time=time, values=values, frames=frames)

    def latest(self, time: np.ndarray) -> np.ndarray:
        """Return the index of the latest message at each time [ns]; -1 before the first."""
        return np.searchsorted(self.time, time, side="right") - 1

    def check(self, max_tilt: float | None = None) -> None:
        """Raise InputError unless the numbers are finite, and the quaternions of poses rotations.

        Args:
          max_tilt: [rad] of the quaternions in the columns 3 to 6 against the floor, if there are.
        """
        faults = [(~np.isfinite(self.values).all(1), "a number that is not finite")]
        if max_tilt is not None:
            x, y, *_ = q = self.values[:, 3:].T
            with np.errstate(all="ignore"):
                tilt = 2 * np.arcsin(np.minimum(np.hypot(x, y), 1))
                excess = abs(np.linalg.norm(q, axis=0) - 1)
            words = "a quaternion {} whose norm is not 1"
            faults.append((excess > _UNIT, words))
            faults.append((tilt > max_tilt, f"a quaternion {{}} that tilts beyond {max_tilt} rad"))
        for bad, words in faults:
            if bad.any():
                i = int(np.argmax(bad))
                q = ", ".join(f"{v:.3g}" for v in self.values[i, 3:])
                raise InputError(
                    f"has {words.format(f'({q})')} on {self.topic} at {_seconds(self.time[i])} s: "
                    "cut it out, or correct the node that publishes it"
                )


def _collect(path: Path, names: Mapping[str, str]) -> tuple[dict[str, _Log], dict[str, str]]:
    """Return the messages of some topics by their keys, and the types of all topics of a bag."""
    keys = {name: key for key, slashed in names.items() for name in (slashed, slashed[1:])}
    logs, contents, size = dict[str, _Log](), dict[str, str](), 0
    for channel, receipt, data in bag_storage.entries(path, keys):
        contents[channel.topic] = channel.kind
        if data is None:
            continue
        key = keys[channel.topic]
        if channel.kind not in _READERS[key]:
            kinds = " or ".join(_READERS[key])
            raise InputError(f"has {channel.kind[:60]} on {channel.topic}: record {kinds}")
        log = logs.setdefault(key, _Log(channel.topic))
        try:
            message = bag_storage.decoded(channel, data)
            for part in message.transforms if key in _FRAMES else (message,):
                values = _READERS[key][channel.kind](part)
                log.append(receipt, part, values)
                size += len(values) + 8
        except InputError:
            raise
        except Exception as error:  # of any kind, by the readers of odd messages and types
            raise InputError(
                f"has a message on {channel.topic} that cannot be decoded as {channel.kind} "
                f"({bag_storage.reason(error)}): record it again with ROS 2"
            ) from error
        _check_size(size)
    return logs, contents


def _check_size(count: int) -> None:
    if count > _MAX_NUMBERS:
        raise InputError(f"has more than {_MAX_NUMBERS} numbers: cut it into parts")


def _delay(logs: Iterable[_Log]) -> int | None:
    """Return the median time [ns] from stamp to receipt; None if it changes, 0 without stamps."""
    delays = [np.subtract(log.receipt, log.stamp) for log in logs if np.any(log.stamp)]
    if not delays:
        return 0
    delay = np.sort(np.concatenate(delays))
    low, middle, high = delay[[len(delay) // 10, len(delay) // 2, -1 - len(delay) // 10]]
    return None if 1e-9 * (high - low) > _SKEW else int(middle)


def _point(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def _pose(position: Any, q: Any) -> list[float]:
    return [*_point(position), q.x, q.y, q.z, q.w]


def _command(twist: Any) -> list[float]:
    return [twist.linear.x, twist.linear.y, twist.angular.z]


def _contact(message: Any) -> list[float]:
    """Return the middle of a contact, and its type."""
    points = message.polygon.points
    if len(points) > 2:
        raise InputError(
            f"has a contact of {len(points)} points: publish none without contact, one of a point "
            "contact, and two of a line contact"
        )
    extremes = [_point(points[i]) for i in (0, -1)] if points else np.zeros((2, 3))
    return [*np.mean(extremes, axis=0), len(points)]


_Reader = Callable[[Any], Floats]
_FRAMES = ("tf", "tf_static")
_TRANSFORMS: dict[str, _Reader] = {
    "tf2_msgs/TFMessage": lambda m: _pose(m.transform.translation, m.transform.rotation)
}
# Values of a message, or of a transform of one, by the key of the topic and the type.
_READERS: dict[str, dict[str, _Reader]] = {
    "odom": {"nav_msgs/Odometry": lambda m: _pose(m.pose.pose.position, m.pose.pose.orientation)},
    "target": {
        "geometry_msgs/PointStamped": lambda m: _point(m.point),
        "geometry_msgs/PoseStamped": lambda m: _point(m.pose.position),
    },
    "contact": {"geometry_msgs/PolygonStamped": _contact},
    "taxels": {"std_msgs/Float32MultiArray": lambda m: m.data},
    "force": {"geometry_msgs/WrenchStamped": lambda m: _point(m.wrench.force)},
    "object": {"visualization_msgs/Marker": lambda m: [*_point(m.pose.position), m.scale.x]},
    "cmd_vel": {
        "geometry_msgs/TwistStamped": lambda m: _command(m.twist),
        "geometry_msgs/Twist": _command,
    },
    **dict.fromkeys(_FRAMES, _TRANSFORMS),
}


# --- frames --------------------------------------------------------------------------------


def _to_frames(rows: Mapping[str, _Series], transforms: _Transforms) -> None:
    """Transform points and forces, in place, into the frames that the law needs.

    These are the frame of the odometry and its child frame. An empty frame is the right one.

    Raises:
      InputError: the bag has no transform, or commands are in another frame.
    """
    odom = rows["odom"]
    if len(used := np.unique(odom.frames)) > 1:
        pairs = " and ".join(" to ".join(odom.pairs[i]) for i in used)
        raise InputError(f"has several frames on {odom.topic}, {pairs}: cut the bag there")
    world, base = (x or y for x, y in zip(odom.pairs[used[0]], ("odom", "base_link"), strict=True))
    goals = {"target": world, "object": world, "contact": base, "force": base, "cmd_vel": base}
    for key, goal in goals.items():
        if key not in rows:
            continue
        row = rows[key]
        for i in np.unique(row.frames):
            if (frame := row.pairs[i][0]) in ("", goal):
                continue
            at = row.frames == i
            if key == "contact":
                at &= row.values[:, 3] > 0  # without contact the position is 0
            if not at.any():
                continue
            move = partial(transforms.move, row.topic, row.time[at], frame, goal)
            points = row.values[at, :3]
            if key == "force":
                points = move(points) - move(0 * points)
            elif key != "cmd_vel":
                points = move(points)
            elif any(abs(move(x + 0 * points) - x).max() > _SAME for x in np.eye(3)):
                raise InputError(
                    f"has {row.topic} in the frame {frame}: publish commands in {goal}, the frame "
                    f"of the base in {odom.topic}"
                )
            row.values[at, :3] = points


class _Transforms:
    """Transforms of a bag, which are read when the first point is in another frame."""

    def __init__(self, path: Path, names: Mapping[str, str], odom: _Series, delay: int | None):
        self.path, self.names, self.odom, self.delay = path, names, odom, delay

    @functools.cached_property
    def edges(self) -> dict[str, dict[str, tuple[_Series, bool]]]:
        """Poses of frames in others, by both names; whether to invert them."""
        edges = defaultdict[str, dict[str, tuple[_Series, bool]]](dict)
        logs, _ = _collect(self.path, {key: self.names[key] for key in _FRAMES})
        poses = [log.in_order(self.delay, merged=True) for log in logs.values()]
        for series in (*poses, self.odom):
            order = np.argsort(series.frames, kind="stable")
            stops = np.cumsum(np.bincount(series.frames, minlength=len(series.pairs)))
            groups = zip(series.pairs, np.split(order, stops[:-1]), strict=True)
            for (parent, child), index in groups:
                edges[child][parent] = series.at(index), False
                edges[parent][child] = series.at(index), True
        return edges

    def move(
        self, topic: str, time: np.ndarray, frame: str, goal: str, points: np.ndarray
    ) -> np.ndarray:
        """Return points (N, 3) in the frame `goal`, at times (N,) [ns]."""
        for edge, inverse in self._path(topic, frame, goal):
            is_static = edge.topic == self.names["tf_static"]
            latest = np.maximum(edge.latest(time), 0)
            pose = edge.at(np.full(len(time), -1) if is_static else latest)
            age = 1e-9 * (time - pose.time)
            bad = (age > _STALE) | (age < -_EARLY)
            if not is_static and bad.any():
                frames = " to ".join(edge.pairs[edge.frames[0]])
                raise InputError(
                    f"has no transform of {frames} at the time of {topic}, "
                    f"{_seconds(time[bad.argmax()])} s: record {edge.topic} all the time"
                )
            pose.check(math.inf)
            turn, shift = Rotation.from_quat(pose.values[:, 3:]), pose.values[:, :3]
            points = turn.apply(points - shift, True) if inverse else turn.apply(points) + shift
        return points

    def _path(self, topic: str, frame: str, goal: str) -> list[tuple[_Series, bool]]:
        """Return the shortest chain of transforms from a frame to another."""
        chains: dict[str, str] = {goal: ""}  # the next frame on the way to the goal
        queue = deque([goal])
        while queue and frame not in chains:
            last = queue.popleft()
            for neighbour in self.edges.get(last, {}):
                if neighbour not in chains:
                    chains[neighbour] = last
                    queue.append(neighbour)
        if frame not in chains:
            raise InputError(
                f"has {topic} in the frame {frame}, and no transform from it to {goal}, a frame of "
                f"{self.odom.topic}: record /tf and /tf_static, or publish it in {goal}"
            )
        path = []
        while frame != goal:
            path.append(self.edges[frame][chains[frame]])
            frame = chains[frame]
        return path
