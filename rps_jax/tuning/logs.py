"""Logs of pushes for `rps fit`: loaded, validated, resampled to one clock, and summarised.

A log is one of these: a trace, which `push` and `replay` return or store in their run folder; a
bag, which `rps push --bag` writes or a robot records (`record.bag` lists the topics); or a table
as CSV (see `record.table`), with the columns

    time                             [s]
    x, y, yaw                        [m, m, rad] of the base, by its odometry
    contact_type                     0 none, 1 a point, 2 a line
    contact_x, contact_y             [m] of the contact in the robot frame; 0 without contact
    taxel_0, taxel_1, ...            [1] relative change of capacitance, along the strip; they give
                                     the contact if its columns are missing
    v_x, v_y, omega                  [m/s, m/s, rad/s] commanded, in the robot frame
    target_x, target_y               [m] in the frame of the base's pose
    object_x, object_y, object_yaw   [m, m, rad] of the object, if known, in that frame
    force_x, force_y                 [N] of the object on the base, if known, in the robot frame
"""

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr

from rps_jax.errors import InputError, not_allowed
from rps_jax.geometry import planar
from rps_jax.geometry.solid import rotate
from rps_jax.record import bag, files, table
from rps_jax.record.files import Arrays
from rps_jax.robot.shell import Shell
from rps_jax.robot.skin import check_taxels, with_contacts
from rps_jax.runs.push import Trace
from rps_jax.world.scene import JOINTS

# Columns of a table, by the field of a log, with their units.
COLUMNS = {
    "time": {"time": "s"},
    "pose": {"x": "m", "y": "m", "yaw": "rad"},
    "contact_type": {"contact_type": ""},
    "p_robot_contact": {"contact_x": "m", "contact_y": "m"},
    "twist": {"v_x": "m/s", "v_y": "m/s", "omega": "rad/s"},
    "target": {"target_x": "m", "target_y": "m"},
    "object_pose": {"object_x": "m", "object_y": "m", "object_yaw": "rad"},
    "f_robot": {"force_x": "N", "force_y": "N"},
}
_UNITS = {title: unit for titles in COLUMNS.values() for title, unit in titles.items()}
_TAXEL = re.compile(r"taxel_(\d+)")
OPTIONAL = ("object_pose", "f_robot", "signal")  # fields that a log may lack
_TOUCH = ("contact_type", "p_robot_contact")
_SHORTEST = 5.0  # [s]
_SLOWEST = 0.2  # [s] between two rows, at most
_JUMPS = (0.5, 0.5, 1.0)  # [m, m, rad] between two rows, at least
_RARE = 0.02  # share of jumps that are no error of the unit of x or y, at most
_STILL = 0.001  # [m] that a target may move
# Motion is compared with commands over windows, so that noise and delays matter little.
_WINDOW = 2.0  # [s]
_RESOLUTION = 0.05  # [m] and [rad] of both motions
_MISFIT = 5.0  # greatest ratio of motion to command, as root mean squares
_LOST = 0.08  # least ratio of the two; wheels may lose 90 %
_ALIGNED = 0.7  # similarity of the two at least, if the base moves less than commanded
_FRAMES = "yaw may be in deg or rise clockwise, or v_x and v_y may be in the frame of x and y"
_FIX = "write SI units, or name the unit in the title of a table, as 'time [ms]' or 'yaw [deg]'"

LogLike = Trace | str | Path


class Log(NamedTuple):
    """Pushes (B) on one clock (T); fields that a log lacks are None."""

    valid: np.ndarray  # (B, T) bool: before the end of the log
    pose: np.ndarray  # (B, T, 3) [m, m, rad] of the base
    contact_type: np.ndarray  # (B, T)
    p_robot_contact: np.ndarray  # (B, T, 2) [m]
    twist: np.ndarray  # (B, T, 3) [m/s, m/s, rad/s] commanded
    target: np.ndarray  # (B, 2) [m]
    object_pose: np.ndarray | None = None  # (B, T, 3) [m, m, rad]
    f_robot: np.ndarray | None = None  # (B, T, 2) [N]
    signal: np.ndarray | None = None  # (B, T, taxels) [1]


class RawLog(NamedTuple):
    """Log with its own rows: columns (N, ...) by the fields of `Log`, and `time` (N,) [s]."""

    columns: Arrays
    exact: bool  # the pose is the true one, not the one by odometry
    rows: np.ndarray | None = None  # (N,) in a table


def read(source: LogLike, shell: Shell, topics: bag.TopicsLike = ()) -> RawLog:
    """Load and validate one log, a trace or a path.

    Args:
      source: the log.
      shell: that of the robot.
      topics: other names of a bag's topics: see `bag.topic_names`.

    Raises:
      InputError: the log cannot be read, lacks a column, is not of this robot, or not in its units.
    """
    path = Path("a trace" if isinstance(source, Trace) else source)
    name = f"log = {path}"
    if isinstance(source, Trace):
        log = _from_trace(source.data, name)
    elif bag.is_bag(path):
        known = (*COLUMNS, "signal", "period", "path")
        steps = bag.read(path, topics, known)
        log = RawLog({k: np.asarray(v, float) for k, v in steps.items() if k in known}, False)
    elif path.is_dir():
        log = _from_trace(files.read_results(path), name)
    elif files.suffix_of(path) in table.SUFFIXES:
        log = _from_table(path, name)
    else:
        rule = "give a trace, a run folder of rps push, a table FILE.csv, or a bag FILE.mcap"
        raise not_allowed("log", path, rule)
    columns = log.columns
    if "path" in columns:
        raise InputError(f"{name} has a path: fit needs a log with one target.")
    # Taxels of other logs are filtered already.
    period = columns.pop("period", np.full(np.size(columns["time"]), np.inf))
    if "signal" in columns:
        check_taxels(columns["signal"], shell, name)
    for fault in _faults(log):
        raise InputError(f"{name} {fault}.")
    contacts = with_contacts(columns | {"period": period}, shell, name)
    columns |= {key: np.asarray(contacts[key], float) for key in (*columns, *_TOUCH)}
    for fault in _unit_faults(columns, shell):
        raise InputError(f"{name} {fault}.")
    columns["target"] = np.atleast_2d(columns["target"])[0]
    return log


def _from_trace(data: xr.Dataset, name: str) -> RawLog:
    """Return the log of a trace."""
    if "qpos" not in data or "time" not in data.dims:
        raise InputError(f"{name} is not allowed: the run has no trace of rps push or replay.")
    qpos, x = np.asarray(data.qpos.values, float), JOINTS.object.start
    yaw = np.unwrap(np.asarray(planar.yaw_of_quaternion(jnp.asarray(qpos[:, x + 3 : x + 7]))))
    columns = {
        "time": data.time.values,
        "pose": qpos[:, :3],
        "contact_type": data.contact_type.values,
        "p_robot_contact": data.p_robot_contact.values,
        "twist": np.stack([np.broadcast_to(data[k], len(qpos)) for k in COLUMNS["twist"]], -1),
        "target": data.p_world_target.values,
        **({"path": data.path.values} if "path" in data else {}),
        "object_pose": np.column_stack([qpos[:, x : x + 2], yaw]),
    }
    return RawLog({k: np.asarray(v, float) for k, v in columns.items()}, True)


def _unit_of(name: str) -> str | None:
    """Return the unit of a column of a table, or None if the name is unknown."""
    return _UNITS.get(name, "1" if _TAXEL.fullmatch(name) else None)


def _from_table(path: Path, name: str) -> RawLog:
    """Return the log of a table."""
    cells = table.read(path, name, _unit_of)
    taxels = sorted(filter(_TAXEL.fullmatch, cells), key=lambda title: int(title[6:]))
    optional = (*OPTIONAL, *(_TOUCH if taxels else ()))
    fields = {k: list(x) for k, x in (COLUMNS | {"signal": taxels}).items()}
    fields = {k: x for k, x in fields.items() if k not in optional or {*x} & {*cells}}
    table.require(cells, name, (title for titles in fields.values() for title in titles))
    columns = {k: cells[x].to_numpy(float, copy=True) for k, x in fields.items()}
    columns |= {k: columns[k][:, 0] for k in ("time", "contact_type") if k in columns}
    for key in {"p_robot_contact", "f_robot"} & {*columns} if "contact_type" in columns else ():
        unused = np.isnan(columns[key]) & (columns["contact_type"] == 0)[:, None]
        columns[key] = np.where(unused, 0.0, columns[key])
    for key in {"pose", "object_pose"} & {*columns}:
        columns[key][:, 2] = np.unwrap(columns[key][:, 2])
    return RawLog(columns, False, cells.index.to_numpy())


def _faults(log: RawLog) -> Iterator[str]:
    """Yield the faults of the clock, the cells and the motion of a log."""
    columns = log.columns

    def at(i: int | np.intp) -> str:
        return f"step {i}" if log.rows is None else f"row {log.rows[i]}"

    if np.size(columns["time"]) < 2:
        yield "is empty: give a header and at least two rows"
    for key, values in columns.items():
        if len(bad := np.argwhere(~np.isfinite(values))):
            yield f"has no number for {key} in {at(bad[0][0])}: fill or remove the row"
    kinds = columns.get("contact_type", np.zeros(1))
    for i in np.flatnonzero(~np.isin(kinds, (0, 1, 2))):
        yield f"has contact_type = {kinds[i]:g} in {at(i)}: write 0 none, 1 a point, 2 a line"
    if np.ptp(np.atleast_2d(columns["target"]), axis=0).max() > _STILL:
        yield "has a target that moves: cut the log where it does"
    time, steps = columns["time"], np.diff(columns["time"])
    for i in np.flatnonzero(steps <= 0) + 1:
        yield f"is not allowed: its time must rise, and is {time[i]:.9g} s in {at(i)}, not later"
    interval, worst = float(np.median(steps)), float(steps.max())
    if interval > _SLOWEST:
        yield f"has a row every {interval:g} s, and it must be every {_SLOWEST} s: {_FIX}"
    if worst > max(5 * interval, _SLOWEST):
        i = int(steps.argmax())
        yield f"has a gap of {worst:.2g} s at {time[i]:.2f} s, {at(i)}: cut the log there"
    if time[-1] - time[0] < _SHORTEST:
        yield f"lasts {time[-1] - time[0]:.1f} s: it must last {_SHORTEST:g} s"
    jumps = np.abs(np.diff(columns["pose"], axis=0)) > np.array(_JUMPS)
    if 0 < jumps.mean() < _RARE:
        i, axis = np.argwhere(jumps)[0]
        change = " to ".join(f"{value:.3g}" for value in columns["pose"][i : i + 2, axis])
        change = f"{[*COLUMNS['pose']][axis]} from {change} in {at(i + 1)}"
        yield f"has a pose that jumps: {change}: cut the log there, or {_FIX}"
    yield from motion_faults(time, columns["pose"], columns["twist"])


def motion_faults(time: np.ndarray, pose: np.ndarray, twist: np.ndarray) -> Iterator[str]:
    """Yield the contradictions of motion (N, 3) and commands (N, 3), by their units or frames.

    A base that slips, lags, or is blocked for some time passes.
    """
    period = np.diff(time, append=time[-1])[:, None]
    span = min(len(time) - 1, max(1, round(_WINDOW / float(np.median(period)))))
    worlds = (rotate(yaw, twist) for yaw in (pose[:, 2], np.radians(pose[:, 2])))
    integrals = (np.cumsum(x * period, axis=0) for x in (twist, *worlds))
    moved, size, path, path_by_deg = (_over(x[None], span)[0] for x in (pose, *integrals))
    for part, titles, units, commands, rates, least in (
        (slice(2, 3), "yaw", "deg", "omega", "deg/s", -_ALIGNED),
        (slice(2), "x and y", "mm or cm", "v_x and v_y", "mm/s or cm/s", 0.5),
    ):
        a, b = (np.linalg.norm(x[:, part]) / np.sqrt(len(x)) for x in (moved, size))
        ratio = float(np.hypot(a, _RESOLUTION) / np.hypot(b, _RESOLUTION))
        likeness, by_deg = (_similarity(moved[:, part], x[:, part]) for x in (path, path_by_deg))
        if by_deg > max(0.9, likeness) and np.abs(pose[:, 2]).max() > 2 * np.pi:
            least = 0.95
        if ratio > _MISFIT or (ratio < _LOST and likeness > _ALIGNED):
            suspect, unit = (titles, units) if ratio > 1 else (commands, rates)
            fault = f"moves {ratio:.3g} times as far in {titles} as {commands} command"
            yield f"has a base that {fault}: {suspect} may be in {unit}; {_FIX}"
        elif likeness < least and 0.5 < ratio < 2:
            yield f"has a base that does not move in the direction of {commands}: {_FRAMES}"


def _similarity(a: np.ndarray, b: np.ndarray) -> float:
    """Return the cosine between vectors (N, k), of all entries together."""
    return float(np.sum(a * b) / max(1e-12, np.linalg.norm(a) * np.linalg.norm(b)))


def _unit_faults(columns: Arrays, shell: Shell) -> Iterator[str]:
    """Yield the quantities that are too large for their units, and contacts beyond the robot."""
    in_contact, pose = columns["contact_type"] > 0, columns["pose"]
    if not in_contact.any():
        yield "has no contact, so it has no information: log a push"
    object_pose = columns.get("object_pose", pose * [1, 1, 0])
    turned = _over(object_pose[None, :, 2], round(_WINDOW / np.median(np.diff(columns["time"]))))
    for titles, values, limit, unit in (
        ("v_x and v_y", columns["twist"][:, :2], 3.0, "m/s"),
        ("omega", columns["twist"][:, 2], 10.0, "rad/s"),
        ("target_x and target_y", columns["target"] - pose[0, :2], 100.0, "m"),
        ("object_x and object_y", (object_pose - pose)[in_contact, :2], 20.0, "m"),
        ("object_yaw", np.append(turned, object_pose[0, 2]), 2 * np.pi, "rad"),
        ("force_x and force_y", columns.get("f_robot", 0 * pose), 1e4, "N"),
        ("taxels", columns.get("signal", 0 * pose), 1000.0, "1"),
    ):
        if (value := np.abs(values).max(initial=0)) > limit:
            yield f"has {titles} up to {value:.4g} {unit}, beyond the limit of {limit:.3g}: {_FIX}"
    contacts = columns["p_robot_contact"][in_contact]
    reach, half = np.abs(contacts), np.array(shell.half, float)
    # The exact distance from the outline, in NumPy: nothing is compiled before a log is refused.
    core, radius = (half, 0.0) if shell.radius is None else (0 * half, half[0])
    beyond = reach - core
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1) - radius
    outside += np.minimum(np.max(beyond, axis=1), 0)
    if (outside > 0.03).any() or np.median(outside) < -0.05:
        (x, y), (length, width) = reach.max(0), half
        sizes = f"({x:.3f}, {y:.3f}) m, and the robot ends at ({length:.3f}, {width:.3f}) m"
        reason = "it is of another robot (see --robot), or contact_x and contact_y may be in mm"
        yield f"has contacts up to {sizes}: {reason} or cm; {_FIX}"


def resample(raw: RawLog, interval: float, window: float) -> Log:
    """Return a log (1, T, ...) with a row every `interval` [s] of `window` [s]; rows are held."""
    columns, time = raw.columns, raw.columns["time"]
    grid = time[0] + interval * np.arange(round(window / interval))
    index = np.searchsorted(time, grid + 1e-6, side="right") - 1
    rows = {k: v[index][None] for k, v in columns.items() if k not in ("time", "target")}
    return Log(valid=(grid <= time[-1] + 1e-6)[None], target=columns["target"][None], **rows)


# --- summary statistics --------------------------------------------------------------------

_BLOCKS = 10
_MEANINGS = {"object_pose": "the object's pose", "f_robot": "the forces", "signal": "the taxels"}
_MEANINGS |= {"noise": "the noise of pose and twist", "follow": "the response to commands"}


def meaning(statistic: str) -> str:
    """Return what a statistic describes, in words."""
    group, _, rest = statistic.partition("/")
    key = rest.partition("_")[0] if group == "base" else group
    return _MEANINGS.get(key, "the path, the commands and the contacts")


def mirror(log: Log) -> Log:
    """Return the pushes mirrored at the robot's x axis, y to -y."""
    signs = np.array([1.0, -1.0, -1.0])
    flip = dict.fromkeys(("pose", "twist", "object_pose"), signs)
    flip |= dict.fromkeys(("p_robot_contact", "target", "f_robot"), signs[:2])
    fields = {k: getattr(log, k) * sign for k, sign in flip.items() if getattr(log, k) is not None}
    signal = None if log.signal is None else log.signal[..., ::-1]
    return log._replace(**fields, signal=signal)


def statistics(log: Log, interval: float) -> pd.DataFrame:
    """Return summary statistics of pushes, a row for each; NaN where one is undefined.

    A name starts with the optional field that the statistic needs, `object_pose/`, `f_robot/` or
    `signal/`; the names of all others start with `base/`.
    """
    columns: Arrays = {}

    def put(name: str, values: np.ndarray, group: str = "base") -> None:
        """Add one column (B,), or several (B, k)."""
        values = np.asarray(values, float)
        for i, column in enumerate(values.reshape(len(values), -1).T):
            columns[f"{group}/{name}_{i}"] = column

    valid, touch = log.valid, log.valid & (log.contact_type > 0)
    start = log.pose[:, :1]
    pose = _relative(log.pose, start)
    target = _relative(np.pad(log.target, ((0, 0), (0, 1)))[:, None], start)[:, 0, :2]
    distance = np.linalg.norm(target, axis=-1)
    put("target", np.column_stack([distance, target / distance[:, None]]))
    for name, values, where in (
        ("pose", pose, valid),
        ("twist", log.twist, valid),
        ("touch", touch[..., None], valid),
        ("line", (log.contact_type == 2)[..., None], touch),
        ("contact", log.p_robot_contact, touch),
    ):
        put(name, _blocks(values, where))
    put("noise", _log(_jitter(np.concatenate([pose, log.twist], -1), valid)))
    # How well, and with which delay, the base follows the commands.
    command, half = rotate(pose[..., 2], log.twist), max(1, round(0.5 / interval))
    path = interval * np.cumsum(command, axis=1)
    for span in (half, 4 * half):
        angle, both = -pose[:, :-span, 2], valid[:, span:] & valid[:, :-span]
        motion, expected, change = (rotate(angle, _over(x, span)) for x in (pose, path, command))
        for axis in range(3):
            row = slice(axis, axis + 1)
            inputs = np.concatenate([expected[..., row], change[..., row]], -1)
            put(f"follow_{span}_{axis}", _regression(inputs, motion[..., row], both))
    # How the contact moves on the base.
    contact = log.p_robot_contact
    both = touch[:, half:] & touch[:, :-half] & (_over(np.cumsum(touch, 1), half) == half)
    mean_twist = _over(np.cumsum(log.twist, 1), half) / half
    put("l_noise", _log(_jitter(contact, touch)))
    put("l_size", _mean(np.abs(contact), touch))
    put("switches", _mean((np.diff(log.contact_type, axis=1) != 0)[..., None], valid[:, 1:]))
    put("first", np.where(touch.any(1), touch.argmax(1), -1) * interval)
    constant = np.ones_like(mean_twist[..., :1])
    drive = np.concatenate([mean_twist, contact[:, :-half, 1:], constant], -1)
    put("slide", _regression(drive, _over(contact, half)[..., 1:] / 0.5, both))
    if log.object_pose is not None:
        pose_world = log.object_pose
        pose_robot = _relative(pose_world, log.pose)
        yaw = pose_robot[..., 2:]
        with_yaw = np.concatenate([pose_robot, np.cos(yaw), np.sin(yaw)], -1)
        put("seen", _blocks(with_yaw, valid), "object_pose")
        distance = np.linalg.norm(pose_robot[..., :2] - contact, axis=-1, keepdims=True)
        spread = np.column_stack([_mean(distance, touch), _rms(distance, touch)])
        put("away", spread, "object_pose")
        offset = rotate(log.pose[..., 2], contact) + (log.pose - pose_world)[..., :2]
        p_object_contact = rotate(-pose_world[..., 2], offset)
        put("on_it", _blocks(p_object_contact, touch), "object_pose")
        velocity = rotate(-log.pose[:, :-half, 2], _over(pose_world, half)) / 0.5
        arm = contact[:, :-half, 1:] - pose_robot[:, :-half, 1:2]
        inputs = np.concatenate([mean_twist, arm, mean_twist[..., :1] * arm], -1)
        put("moved", _regression(inputs, velocity, both), "object_pose")
    if log.f_robot is not None:
        force = log.f_robot
        felt = touch & (np.linalg.norm(force, axis=-1) > 0)
        size = np.log(np.maximum(np.linalg.norm(force, axis=-1), 1.0))
        slope = force[..., 1] / np.maximum(np.abs(force[..., 0]), 1.0)
        for name, values in (("size", size), ("slope", slope), ("steep", np.abs(slope))):
            put(name, _quantiles(values, felt), "f_robot")
        put("force", _blocks(np.arcsinh(force / 10), touch), "f_robot")
    if log.signal is not None:
        signal = np.where(valid[..., None], log.signal, np.nan)
        dead = np.all(np.nan_to_num(signal) == 0, axis=1)
        put("dead", dead.mean(-1), "signal")
        level = np.nanmean(signal, 1)
        still = ~dead & (np.nanmax(signal, 1) < 0.25)
        for name, noise in (("quiet", _jitter(log.signal, valid)), ("drift", np.nanstd(signal, 1))):
            put(name, _log(_mean(noise[..., None], still)), "signal")
        put("level", np.sort(np.where(dead, -1, level), -1)[:, -8:], "signal")
        highest = np.where(valid[..., None], log.signal, 0.0).max(-1)
        put("highest", _blocks(np.arcsinh(highest[..., None]), touch), "signal")
        put("reach", _quantiles(highest, touch), "signal")
    return pd.DataFrame(columns)


def _relative(pose: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Return poses (..., 3) relative to frames (..., 3)."""
    return rotate(-frame[..., 2], pose - frame)


def _over(values: np.ndarray, span: int) -> np.ndarray:
    """Return the change over `span` samples."""
    return values[:, span:] - values[:, :-span]


def _mean(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Return the mean over time (B, k) of (B, T, k) where the mask is true; NaN if it never is."""
    count = where.sum(1)[:, None]
    total = np.where(where[..., None], values, 0.0).sum(1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _rms(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    return np.sqrt(_mean(values**2, where))


def _log(values: np.ndarray) -> np.ndarray:
    return np.log(np.maximum(values, 1e-6))


def _jitter(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Return the standard deviation (B, k) of white noise, from second differences."""
    second = values[:, 2:] - 2 * values[:, 1:-1] + values[:, :-2]
    return _rms(second / np.sqrt(6), where[:, 2:] & where[:, 1:-1] & where[:, :-2])


def _blocks(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Return means (B, blocks * k) over equal shares of the time."""
    cuts = np.linspace(0, values.shape[1], _BLOCKS + 1).astype(int)
    parts = [_mean(values[:, a:b], where[:, a:b]) for a, b in pairwise(cuts)]
    return np.concatenate(parts, -1)


def _quantiles(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Return quantiles (B, 5) over time, where the mask is true."""
    masked = np.where(where, values, np.nan)
    masked[~where.any(1)] = 0.0
    return np.nanquantile(masked, [0.05, 0.25, 0.5, 0.75, 0.95], axis=1).T


def _regression(x: np.ndarray, y: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Return ridge coefficients (B, k * m) of y (B, T, m) on x (B, T, k), and residuals (B, m)."""
    x, y = np.where(where[..., None], x, 0.0), np.where(where[..., None], y, 0.0)
    count = np.maximum(where.sum(1), 1)[:, None, None]
    scale = np.sqrt((x**2).sum(1) / count[:, 0]) + 1e-4
    x = x / scale[:, None]
    gram = np.einsum("btk,btl->bkl", x, x) / count + 1e-3 * np.eye(x.shape[-1])
    slope = np.linalg.solve(gram, np.einsum("btk,btm->bkm", x, y) / count)
    residual = _log(_rms(y - np.einsum("btk,bkm->btm", x, slope), where))
    return np.concatenate([(slope / scale[..., None]).reshape(len(x), -1), residual], -1)
