"""Bags of ROS 2: observations and commands of a law, in standard messages.

`write` makes an MCAP file. `read` also reads sqlite3 (.db3) and folders of `ros2 bag record`. Each
topic has one message per control step, except `/tf` and the markers:

    /odom           nav_msgs/Odometry              pose of the base and its velocity in its frame
    /target         geometry_msgs/PointStamped     the law's target, on a path a lookahead ahead
                                                   (read, too: PoseStamped)
    /goal           geometry_msgs/PoseStamped      target with the heading of the goal
    /path           nav_msgs/Path                  of a task, once a second; all of a bag have as
                                                   many poses; one without poses ends the steps
    /walls          visualization_msgs/Marker      of a task, once a second
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
time of receipt less the median delay of the stamped topics; if their clock has another pace, as a
simulation's, it is interpolated. The order of the file does not matter.

Target, path and object are in the frame of the odometry, and contact, force and command in its
child frame. An empty frame is this one; other frames are refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from rps_jax import errors
from rps_jax.errors import InputError
from rps_jax.record import files, options
from rps_jax.record.files import Arrays

Message = dict[str, Any]  # fields of any type
RosMessage: TypeAlias = Any  # of rosbags, with fields as attributes
Floats = Sequence[float] | np.ndarray
TopicsLike = str | Mapping[str, str] | Sequence[str]  # names of topics: see `topic_names`
_MAX_NUMBERS = 2**27  # of all messages, and of all steps; a message counts 32 more
_MARKER_PERIOD = 1.0  # [s] between two target markers
_STALE = 1.0  # [s] that a stream of messages may pause
_SKEW = 5e8  # [ns] of 80 % of the delays between stamp and receipt, or of 90 % of late stamps
_DRIFT = 2e7  # [ns] change of the delay from the first to the last quarter of the messages
_MAX_TILT = 0.1  # [rad] of the base against the floor
_UNIT = 1e-3  # [1] by which the norm of a quaternion may differ from 1
_CORRECT = "cut the bag there, or correct the node that publishes it, or its clock (use_sim_time)"
_SUFFIXES = (".mcap", ".db3", ".bag")
_FIX = (
    "give FILE.mcap, FILE.db3, or a folder of `ros2 bag record`; `mcap recover` and `ros2 bag "
    "reindex` repair these, and `rosbags-convert` converts bags of ROS 1"
)
_NO_HEADER = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="")


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
    path: np.ndarray | None = None  # (K, 2) [m] of the task, in the world
    walls: np.ndarray | None = None  # (W, 2, 2) [m] for viewers alone
    yaw_target: float | None = None  # [rad] heading of the goal, NaN before the end of a path


def check() -> None:
    """Raise InputError unless the packages of the extra `bags` are installed."""
    _ = errors.require("mcap_ros2.writer", "bags"), errors.require("rosbags.typesys", "bags")


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag by its name, or a folder of `ros2 bag record`."""
    return files.suffix_of(path) in _SUFFIXES or (path / "metadata.yaml").exists()


# --- topics --------------------------------------------------------------------------------


def _floats(*vectors: str) -> Callable[[RosMessage], Floats]:
    """Return what reads numbers from a message, by names as `pose.position.xyz`."""
    parts = [vector.rpartition(".") for vector in vectors]
    return attrgetter(*(f"{owner}.{axis}" for owner, _, axes in parts for axis in axes))


def _contact(message: RosMessage) -> Floats:
    """Return the middle of a contact, and its type."""
    points = [(p.x, p.y, p.z) for p in message.polygon.points]
    if len(points) > 2:
        raise ValueError(f"a contact of {len(points)} points, not of none, one or two")
    middle = (sum(axis) / len(points) for axis in zip(*points, strict=True))
    return [*middle, len(points)] if points else [0.0, 0.0, 0.0, 0.0]


def _plane_pose(values: np.ndarray) -> np.ndarray:
    # math.atan2 has the same bits on every machine.
    yaw = [2 * math.atan2(z, w) for z, w in values[:, 5:].tolist()]
    return np.column_stack([values[:, :2], np.unwrap(yaw)])


def _xy(values: np.ndarray) -> np.ndarray:
    return values[:, :2]


_RARE = ("target", "goal", "path")  # topics that are no streams
_POSITION = _floats("pose.position.xyz")
_READERS: dict[str, dict[str, Callable[[RosMessage], Floats]]] = {  # of messages, by topic and type
    "odom": {"nav_msgs/Odometry": _floats("pose.pose.position.xyz", "pose.pose.orientation.xyzw")},
    "target": {
        "geometry_msgs/PointStamped": _floats("point.xyz"),
        "geometry_msgs/PoseStamped": _POSITION,
    },
    "goal": {"geometry_msgs/PoseStamped": _floats("pose.position.xyz", "pose.orientation.xyzw")},
    "path": {"nav_msgs/Path": lambda m: [x for pose in m.poses for x in _POSITION(pose)]},
    "contact": {"geometry_msgs/PolygonStamped": _contact},
    "taxels": {"std_msgs/Float32MultiArray": attrgetter("data")},
    "force": {"geometry_msgs/WrenchStamped": _floats("wrench.force.xyz")},
    "object": {"visualization_msgs/Marker": _floats("pose.position.xyz", "scale.x")},
    "cmd_vel": {
        "geometry_msgs/TwistStamped": _floats("twist.linear.xy", "twist.angular.z"),
        "geometry_msgs/Twist": _floats("linear.xy", "angular.z"),
    },
}
_FIELDS: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {  # of values (N, k)
    "pose": ("odom", _plane_pose),
    "target": ("target", _xy),
    "yaw_target": ("goal", lambda v: _plane_pose(v)[:, 2]),
    "path": ("path", lambda v: v.reshape(len(v), -1, 3)[..., :2]),
    "contact_type": ("contact", lambda v: v[:, 3].astype(int)),
    "p_robot_contact": ("contact", lambda v: np.where(v[:, 3:] > 0, v[:, :2], 0.0)),
    "signal": ("taxels", lambda v: v.astype(np.float32)),
    "f_robot": ("force", _xy),
    "p_world_object": ("object", _xy),
    "r_object": ("object", lambda v: 0.5 * v[:, 3]),
    "twist": ("cmd_vel", lambda v: v),
}
TOPICS = {f"/{key}": next(iter(readers)) for key, readers in _READERS.items()}  # types
TOPICS |= dict.fromkeys(("/target_marker", "/walls"), TOPICS["/object"])
TOPICS["/tf"] = "tf2_msgs/TFMessage"


# --- writing -------------------------------------------------------------------------------


def write(path: Path, steps: Iterable[Step], metadata: Mapping[str, str]) -> Path:
    """Write a bag atomically."""
    check()
    from mcap_ros2.writer import Writer
    from rosbags.typesys import Stores, get_typestore

    definitions = get_typestore(Stores.ROS2_HUMBLE)

    def fill(partial: Path) -> None:
        with open(partial, "wb") as file, Writer(file) as writer:
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
        pose = {"pose": _pose(*step.pose)}
        child = {"header": odom, "child_frame_id": "base_link"}
        yield "/odom", stamp, {**child, "pose": pose, "twist": {"twist": _velocity(previous, step)}}
        yield "/target", stamp, {"header": odom, "point": _xyz(*step.target)}
        if step.yaw_target is not None and not math.isnan(step.yaw_target):
            x, y = step.target
            goal = _pose(x, y, step.yaw_target)
            yield "/goal", stamp, {"header": odom, "pose": goal}
        points = [_xyz(*step.p_robot_contact)] * int(step.contact_type)
        yield "/contact", stamp, {"header": base, "polygon": {"points": points}}
        if step.signal is not None:
            dim = {"label": "taxels", "size": len(step.signal), "stride": len(step.signal)}
            yield "/taxels", stamp, {"layout": {"dim": [dim]}, "data": list(step.signal)}
        if step.f_robot is not None:
            yield "/force", stamp, {"header": base, "wrench": {"force": _xyz(*step.f_robot)}}
        if step.p_world_object is not None:
            yield "/object", stamp, _cylinder(odom, "object", step.p_world_object, step.r_object)
        frames = [_frame(odom, "base_link", *step.pose)]
        if step.object_pose is not None:
            frames.append(_frame(odom, "object", *step.object_pose))
        yield "/tf", stamp, {"transforms": frames}
        if step.time >= marker_time + _MARKER_PERIOD:
            marker_time = step.time
            yield "/target_marker", stamp, _cylinder(odom, "target", step.target, 0.05)
            if step.path is not None:
                poses = [{"header": odom, "pose": _pose(*point)} for point in step.path]
                yield "/path", stamp, {"header": odom, "poses": poses}
            if step.walls is not None:
                vertices = [_xyz(*end) for end in step.walls.reshape(-1, 2)]
                lines = {"type": 5, "points": vertices, "pose": _pose(0, 0), "scale": {"x": 0.04}}
                yield "/walls", stamp, _cylinder(odom, "walls", (0, 0), 0.0) | lines
        yield "/cmd_vel", stamp, {"header": base, "twist": _twist(*step.twist)}
        previous = step


def _header(stamp: int, frame: str) -> Message:
    return {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": frame}


def _xyz(x: float, y: float) -> dict[str, float]:
    return {"x": float(x), "y": float(y)}


def _pose(x: float, y: float, yaw: float = 0.0) -> Message:
    half = float(yaw) / 2
    return {"position": _xyz(x, y), "orientation": {"z": math.sin(half), "w": math.cos(half)}}


def _twist(v_x: float, v_y: float, omega: float) -> Message:
    return {"linear": _xyz(v_x, v_y), "angular": {"z": float(omega)}}


def _velocity(last: Step | None, step: Step) -> Message:
    """Return the velocity of the base since the last step, in its own frame."""
    if last is None or step.time <= last.time:
        return _twist(0, 0, 0)
    v_x, v_y, omega = np.subtract(step.pose, last.pose, dtype=float) / (step.time - last.time)
    c, s = math.cos(step.pose[2]), math.sin(step.pose[2])
    return _twist(c * v_x + s * v_y, c * v_y - s * v_x, omega)


def _frame(header: Message, child: str, x: float, y: float, yaw: float) -> Message:
    transform = {"translation": _xyz(x, y), "rotation": _pose(x, y, yaw)["orientation"]}
    return {"header": header, "child_frame_id": child, "transform": transform}


def _cylinder(header: Message, name: str, center: Floats, r: float) -> Message:
    """Return a marker of type 3 with a radius [m]."""
    scale, color = _xyz(2 * r, 2 * r) | {"z": 0.01}, {"r": 0.1, "g": 0.6, "b": 0.2, "a": 0.8}
    shape = {"type": 3, "pose": _pose(*center), "scale": scale, "color": color}
    return {"header": header, "ns": name, **shape}


# --- reading -------------------------------------------------------------------------------


def topic_names(topics: TopicsLike) -> dict[str, str]:
    """Return the topics of a bag that have other names, by their keys, as {"odom": "/r1/odom"}.

    Args:
      topics: names by keys, or texts `odom=/r1/odom`.

    Raises:
      InputError: a key is unknown or repeated, or a name is missing.
    """
    whole = topics if isinstance(topics, str | Mapping) else ",".join(map(str, topics))
    names = options.parse_names("topic", whole)
    for key in names:
        errors.check_name("key of a topic", key, _READERS)
    return {key: f"/{name.strip('/')}" for key, name in names.items()}


def read(
    path: str | Path, topics: TopicsLike = (), senses: Collection[str] = tuple(Step._fields)
) -> Arrays:
    """Return the steps of a bag as arrays, by the fields of `Step` that it has, and `period`.

    A step is a command, with the latest message of each other topic that is not after it. Steps
    begin when each topic but `/goal` has had a message, and end at a path without poses. Before the
    first `/goal`, headings are NaN. A bag with `/taxels` alone, as of a robot, has no
    `contact_type` and no `p_robot_contact`.

    Args:
      path: of an MCAP file, of an sqlite3 file, or of a folder of `ros2 bag record`.
      topics: other names of topics: see `topic_names`.
      senses: optional fields to read. Without `path`, it is read if there is no target; without
        `signal`, the taxels are read if there are no contacts.

    Raises:
      InputError: the path is no bag; the bag is damaged or too large, or lacks a topic; or its
        messages have no order, numbers that are not finite, an unknown frame, or no rotation.

    Examples:
      >>> import tempfile
      >>> import rps_jax
      >>> from rps_jax.record import bag
      >>> brief = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=3.0))
      >>> with tempfile.TemporaryDirectory() as folder:
      ...     trace = rps_jax.push("cylinder", bag=f"{folder}/push.mcap", setting=brief)
      ...     steps = bag.read(f"{folder}/push.mcap")
      >>> steps["twist"].shape  # 50 steps a second, and the last one
      (151, 3)
    """
    names = topic_names(topics)
    check()
    try:
        return _steps(Path(path), names, senses)
    except InputError as error:
        raise InputError(f"bag = {path} {str(error).rstrip('.')}.") from error


def _steps(path: Path, renamed: dict[str, str], senses: Collection[str]) -> Arrays:
    """Return the steps of a bag, as `read` does."""
    names = {key: f"/{key}" for key in _READERS if key not in renamed} | renamed
    logs, contents, faults = _collect(path, names)
    known = logs.keys() | faults.keys()
    goal = "path" if known & {"path", _END} and "target" not in known else "target"
    required = dict.fromkeys(["odom", goal, "cmd_vel", *renamed])
    missing = [
        f"{names[key]}{' with poses' if key == 'path' else ''}"
        for key in required
        if key not in known
    ]
    if not known & {"contact", "taxels"}:
        missing.append(f"{names['contact']} or {names['taxels']}")
    if missing:
        raise InputError(
            f"has no messages on {', '.join(missing)}; its topics are "
            f"{', '.join(sorted(contents)) or 'none'}: name others by --topic KEY=/TOPIC"
        )
    used = [*required, "contact" if "contact" in known else "taxels"]
    used += [_FIELDS[name][0] for name in senses if name in _FIELDS]
    for key in used:
        if key in faults:
            raise faults[key]
    logs = {key: log for key, log in logs.items() if key in {*used, _END}}
    clock = _clock(logs.values())
    names[_END] = names["path"]
    series = {key: _in_order(names[key], log, clock) for key, log in logs.items()}
    commands, end = series.pop("cmd_vel"), series.pop(_END, None)
    first = max(s.time[0] for key, s in series.items() if key != "goal")
    commands = commands.at(commands.time >= first)
    if end is not None and "path" in series:
        paths = series["path"]
        if (stops := end.time[end.time > paths.time[0]]).size:
            paths.refuse(paths.time > stops[0], "a path after one without poses")
            commands = commands.at(commands.time < stops[0])
    if (count := len(commands.time)) < 2:
        words = f"has too few commands, {count}, on {commands.topic} after all topics have begun"
        raise InputError(f"{words}: record at least two")
    _check_size(count * sum(s.values.shape[1] + 32 for s in series.values()))
    rows = {"cmd_vel": commands} | {key: s.latest(commands.time) for key, s in series.items()}
    for key, row in rows.items():
        if key == "odom" or (key not in _RARE and len(logs[key]) > count / 4):  # a stream
            late = commands.time - row.time > 1e9 * _STALE
            commands.refuse(late, f"no message on {row.topic} in the {_STALE:g} s before that")
        row.check(_MAX_TILT if key == "odom" else None)
    _check_frames(rows)
    time = 1e-9 * commands.time
    steps = {name: get(rows[key].values) for name, (key, get) in _FIELDS.items() if key in rows}
    if "goal" in series:
        steps["yaw_target"][commands.time < series["goal"].time[0]] = np.nan
    return {"time": time, "period": np.insert(np.diff(time), 0, np.median(np.diff(time))), **steps}


# --- messages as arrays --------------------------------------------------------------------

# Rows of a topic: time of receipt [ns]; stamp [ns] of the header, or 0; frames of header and child;
# values.
_Pair = tuple[str, str]
_Log = list[tuple[np.int64, int, _Pair, np.ndarray]]
_Clock = Callable[[np.ndarray], np.ndarray] | None  # from times of receipt [ns] to stamps
_END = "end"  # key of the paths without poses


class _Series(NamedTuple):
    """Messages of one topic in the order of time."""

    topic: str
    time: np.ndarray  # (N,) [ns]
    values: np.ndarray  # (N, k)
    frames: np.ndarray  # (N, 2) of the headers, and of the children

    def at(self, index: np.ndarray) -> _Series:
        """Return some of the messages."""
        return _Series(self.topic, *(column[index] for column in self[1:]))

    def latest(self, time: np.ndarray) -> _Series:
        """Return the latest message at each time [ns], or the first before it."""
        return self.at(np.maximum(np.searchsorted(self.time, time, side="right") - 1, 0))

    def refuse(self, bad: np.ndarray | np.bool, words: str, fix: str = _CORRECT) -> None:
        """Raise InputError if a message is bad; its quaternion replaces `{}` in the words."""
        if bad.any():
            i = int(bad.argmax())
            words = words.replace("{}", ", ".join(f"{v:.3g}" for v in self.values[i, 3:]))
            raise InputError(f"has {words} on {self.topic} at {1e-9 * self.time[i]:.3f} s: {fix}")

    def check(self, max_tilt: float | None = None) -> None:
        """Raise InputError unless numbers are finite, and quaternions rotations.

        Args:
          max_tilt: [rad] of the quaternions in the columns 3 to 6 against the floor, if there are.
        """
        self.refuse(~np.isfinite(self.values).all(axis=1), "a number that is not finite")
        if max_tilt is not None:
            x, y, *_ = q = self.values[:, 3:].T
            excess = abs(np.linalg.norm(q, axis=0) - 1)
            self.refuse(excess > _UNIT, "a quaternion ({}) whose norm is not 1")
            tilt = 2 * np.arcsin(np.minimum(np.hypot(x, y), 1))
            self.refuse(tilt > max_tilt, f"a quaternion ({{}}) that tilts beyond {max_tilt} rad")


def _entries(path: Path, topics: Collection[str]) -> Iterator[tuple[str, str, int, bytes | None]]:
    """Yield all topics with their types, and then the messages of some, with the time of receipt.

    Raises:
      InputError: the path is no bag, or is damaged.
    """
    from rosbags.rosbag2 import Reader

    try:
        with Reader(path) as reader:
            for x in reader.connections:
                yield x.topic, x.msgtype.replace("/msg/", "/"), 0, None
            if chosen := [x for x in reader.connections if x.topic in topics]:
                for x, receipt, data in reader.messages(chosen):
                    yield x.topic, x.msgtype.replace("/msg/", "/"), receipt, data
    except Exception as error:  # of any kind, by the readers of a damaged file
        heads = (x.open("rb").read(16) for x in (path, *path.glob("*")) if x.is_file())
        fix = files.FETCH if any(x.startswith(files.POINTER) for x in heads) else _FIX
        raise InputError(f"cannot be read ({_reason(error)}): {fix}") from error


def _reason(error: Exception) -> str:
    """Return what an error of a reader says, in one line."""
    return errors.one_line(error)[:300].rstrip(".") or type(error).__name__


def _collect(
    path: Path, names: Mapping[str, str]
) -> tuple[dict[str, _Log], set[str], dict[str, InputError]]:
    """Return the messages of topics by their keys, all topics with their types, and faults by key.

    A topic with a fault lacks the messages after it.
    """
    from rosbags.typesys import Stores, get_typestore

    keys = {name: key for key, slashed in names.items() for name in (slashed, slashed[1:])}
    logs, contents, faults = dict[str, _Log](), set[str](), dict[str, InputError]()
    pairs, size, store = dict[_Pair, _Pair](), 0, get_typestore(Stores.ROS2_HUMBLE)
    for topic, kind, receipt, data in _entries(path, keys):
        if data is None:
            contents.add(f"{topic} ({kind})")
            continue
        if (key := keys[topic]) in faults:
            continue
        readers = _READERS[key]
        try:
            message: RosMessage = store.deserialize_cdr(data, kind.replace("/", "/msg/"))
            values = np.array(readers[kind](message), float)
            header = getattr(message, "header", _NO_HEADER)
            stamp = header.stamp.sec * 10**9 + header.stamp.nanosec
            pair = header.frame_id.lstrip("/"), getattr(message, "child_frame_id", "").lstrip("/")
            log = logs.setdefault(key if len(values) or key != "path" else _END, [])
            log.append((np.int64(receipt), stamp, pairs.setdefault(pair, pair), values))
            size += len(values) + 32
            if (count := len(values)) != (first := len(log[0][3])):
                raise InputError(
                    f"has a {kind} of {count} numbers on {topic} after one of {first}, "
                    f"received at {receipt} ns: cut the bag there, or publish equally many"
                )
        except InputError as error:
            faults[key] = error
        except Exception as error:  # of any kind, by the readers of odd messages and types
            faults[key] = InputError(
                f"has a {kind} on {topic} that cannot be decoded ({_reason(error)}), received at "
                f"{receipt} ns: record {' or '.join(readers)} with ROS 2, or cut it out"
            )
        _check_size(size)
    return logs, contents, faults


def _check_size(count: int) -> None:
    if count > _MAX_NUMBERS:
        raise InputError(f"has more than {_MAX_NUMBERS} numbers: cut it into parts")


def _clock(logs: Iterable[_Log]) -> _Clock:
    """Return the clock of the stamped messages; None if they have several."""
    pairs = sorted(row[:2] for log in logs for row in log if row[1]) or [(np.int64(0), 0)]
    receipt, stamp = np.array(pairs).T
    delay, latest = receipt - stamp, np.maximum.accumulate(stamp)
    low, middle, high = (np.sort(delay)[int(q * len(pairs))] for q in (0.1, 0.5, 0.9))
    quarter = len(pairs) // 4 + 1
    drift = np.median(delay[:quarter]) - np.median(delay[-quarter:])
    is_one = np.quantile(latest - stamp, 0.9) <= _SKEW
    if high - low <= _SKEW and not (is_one and abs(drift) > _DRIFT):
        return lambda time: time - middle
    if not is_one:
        return None
    past, passed = receipt - receipt[0], latest - latest[0]  # small enough for floats
    return lambda time: latest[0] + np.rint(np.interp(time - receipt[0], past, passed)).astype(int)


def _in_order(topic: str, log: _Log, clock: _Clock) -> _Series:
    """Return messages in the order of time; of equal times, the last received.

    Args:
      topic: their name.
      log: the messages of the topic in the order of receipt.
      clock: that of the stamped topics, or None.

    Raises:
      InputError: header stamps go back, or a topic without them has no time.
    """
    receipt, stamp = np.array([row[:2] for row in log]).T
    time = stamp if stamp.any() else receipt if clock is None else clock(receipt)
    values = np.concatenate([row[3] for row in log]).reshape(len(log), len(log[0][3]))
    series = _Series(topic, time, values, np.array([row[2] for row in log], object))
    bad = (stamp == 0) & (clock is None and not stamp.any())
    series.refuse(bad, "no header stamp, nor times of receipt at the pace of other topics,")
    series.refuse(np.append(False, np.diff(stamp) < 0), "a header stamp that goes back")
    return series.at(np.append(np.diff(time) > 0, True))


def _check_frames(rows: Mapping[str, _Series]) -> None:
    """Raise InputError for messages that are neither in the odometry's frame nor in its child's."""
    odom = rows["odom"]
    odom.refuse((odom.frames != odom.frames[0]).any(axis=1), "a change of frames")
    world, base = odom.frames[0][0] or "odom", odom.frames[0][1] or "base_link"
    frames = dict.fromkeys(("target", "goal", "path", "object"), world)
    frames |= dict.fromkeys(("contact", "force", "cmd_vel"), base)
    for key in frames.keys() & rows.keys():
        bad = (rows[key].frames[:, 0] != frames[key]) & (rows[key].frames[:, 0] != "")
        rows[key].refuse(bad, f"a frame other than {frames[key]}", "publish it in that frame")
