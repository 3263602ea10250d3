"""Logs of pushes as `rps fit` takes them: read, checked, and brought to one clock.

A log is a trace, as `push` and `replay` return it or keep it in their run folder; a bag, as
`rps push --bag` writes it or a robot records it (`record.bag` lists the topics); or a table
`FILE.csv` with a header and the columns

    time                             [s]
    x, y, yaw                        [m, m, rad] of the base, by its odometry
    contact_type                     0 none, 1 a point, 2 a line
    contact_x, contact_y             [m] of the contact in the robot frame; 0 without contact
    taxel_0, taxel_1, ...            [1] relative change of capacitance, along the strip; without
                                     the contact's columns these are made of them
    v_x, v_y, omega                  [m/s, m/s, rad/s] commanded, in the robot frame
    target_x, target_y               [m] in the frame of the base's pose
    object_x, object_y, object_yaw   [m, m, rad] of the object, if known, in that frame
    force_x, force_y                 [N] of the object on the base, if known, in the robot frame
"""

import re
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax.errors import InputError
from rps_jax.geometry import planar
from rps_jax.record import bag, files
from rps_jax.robot.shell import Shell
from rps_jax.robot.skin import CapacitiveSkin, check_taxels, with_contacts
from rps_jax.runs.push import Trace
from rps_jax.world.scene import JOINTS

COLUMNS = {
    "time": ("time",),
    "pose": ("x", "y", "yaw"),
    "contact_type": ("contact_type",),
    "p_robot_contact": ("contact_x", "contact_y"),
    "twist": ("v_x", "v_y", "omega"),
    "target": ("target_x", "target_y"),
    "object_pose": ("object_x", "object_y", "object_yaw"),
    "f_robot": ("force_x", "force_y"),
}
OPTIONAL = ("object_pose", "f_robot", "signal")  # what a log may have besides
_TOUCH = ("contact_type", "p_robot_contact")
_SHORTEST = 5.0  # [s]
_SLOWEST = 0.2  # [s] between two rows
_STILL = 0.001  # [m] that a target may move
# Greatest numbers of a log, and what they would otherwise be.
_MOST = {
    "twist": (np.array([3.0, 3.0, 10.0]), "v_x and v_y [m/s] and omega [rad/s]"),
    "f_robot": (np.full(2, 1e5), "forces [N]"),
}


class Log(NamedTuple):
    """Pushes (B) on one clock (T); what is not known is None."""

    valid: np.ndarray  # (B, T) bool: before its end
    pose: np.ndarray  # (B, T, 3) [m, m, rad] of the base
    contact_type: np.ndarray  # (B, T)
    p_robot_contact: np.ndarray  # (B, T, 2) [m]
    twist: np.ndarray  # (B, T, 3) [m/s, m/s, rad/s] commanded
    target: np.ndarray  # (B, 2) [m]
    object_pose: np.ndarray | None = None  # (B, T, 3) [m, m, rad]
    f_robot: np.ndarray | None = None  # (B, T, 2) [N]
    signal: np.ndarray | None = None  # (B, T, taxels) [1]


class Given(NamedTuple):
    """A log as it was given, (N, ...) by the fields of `Log`, with `time` (N,) [s]."""

    columns: dict[str, np.ndarray]
    exact: bool  # the pose is where the base was, not where it believed to be


def read(source: Any, shell: Shell) -> Given:
    """Read and check one log, a trace or the path of one; `shell` is that of the robot.

    Raises:
      InputError: it cannot be read, lacks a column, or holds what cannot be of this robot.
    """
    name = f"log = {'a trace' if isinstance(source, Trace) else source}"
    if isinstance(source, Trace):
        found = _of_trace(source.data, name)
    elif Path(source).is_dir():
        found = _of_trace(files.read_results(Path(source)), name)
    elif Path(source).suffix == ".mcap" and Path(source).is_file():
        bag.check()
        steps = with_contacts(bag.read(Path(source)), shell, f"bag = {source}")
        known = (*COLUMNS, "signal")
        found = Given({k: np.asarray(v, float) for k, v in steps.items() if k in known}, False)
    elif Path(source).suffix == ".csv" and Path(source).is_file():
        found = _of_table(Path(source), name)
    else:
        raise InputError(
            f"{name} is not allowed: give a trace, a run folder of rps push, FILE.csv or FILE.mcap."
        )
    columns = found.columns
    if "signal" in columns:
        check_taxels(columns["signal"], shell, name)
    if "contact_type" not in columns:
        columns |= _touch_of(columns["signal"], shell)
    _check(columns, name, shell)
    return found


def _of_trace(data: xr.Dataset, name: str) -> Given:
    if "qpos" not in data or "time" not in data.dims:
        raise InputError(f"{name} is not allowed: the run holds no trace of rps push or replay.")
    qpos, x = np.asarray(data.qpos.values, float), JOINTS.object.start
    yaw = np.unwrap(np.asarray(planar.yaw_of_quaternion(jnp.asarray(qpos[:, x + 3 : x + 7]))))
    columns = {
        "time": data.time.values,
        "pose": qpos[:, :3],
        "contact_type": data.contact_type.values,
        "p_robot_contact": data.p_robot_contact.values,
        "twist": np.stack([np.broadcast_to(data[k], len(qpos)) for k in COLUMNS["twist"]], -1),
        "target": data.p_world_target.values,
        "object_pose": np.column_stack([qpos[:, x : x + 2], yaw]),
    }
    return Given({k: np.asarray(v, float) for k, v in columns.items()}, True)


def _of_table(path: Path, name: str) -> Given:
    text = path.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    if len(text) < 2:
        raise InputError(f"{name} is empty: give a header and at least two rows.")
    header = [one.strip() for one in text[0].split(",")]
    at = {one: i for i, one in enumerate(header)}
    taxels = sorted(
        (one for one in at if re.fullmatch(r"taxel_\d+", one)), key=lambda n: int(n[6:])
    )
    needed = [k for k in COLUMNS if k not in OPTIONAL and not (taxels and k in _TOUCH)]
    if lacking := [one for k in needed for one in COLUMNS[k] if one not in at]:
        raise InputError(f"{name} lacks the column {lacking[0]}: `rps fit --help` lists them.")
    try:
        rows = np.array([[float(one or "nan") for one in row.split(",")] for row in text[1:]])
    except ValueError as error:
        raise InputError(
            f"{name} is not allowed ({error}): write numbers in every cell."
        ) from error
    wanted = {k: c for k, c in COLUMNS.items() if all(one in at for one in c)}
    found = {k: rows[:, [at[one] for one in c]] for k, c in wanted.items()}
    found |= {k: found[k][:, 0] for k in ("time", "contact_type") if k in found}
    if taxels:
        found["signal"] = rows[:, [at[one] for one in taxels]]
    return Given(found, False)


def _touch_of(signal: np.ndarray, shell: Shell) -> dict[str, np.ndarray]:
    """Contacts of taxels (N, T), as the simulated skin has them."""
    active, middles = signal > CapacitiveSkin().threshold, np.asarray(shell.taxels()[:, 0])
    first, last = active.argmax(1), active.shape[1] - 1 - active[:, ::-1].argmax(1)
    kind = np.minimum(active.sum(1), 2)
    place = np.where(kind[:, None] > 0, (middles[first] + middles[last]) / 2, 0.0)
    return {"contact_type": kind.astype(float), "p_robot_contact": place}


def _check(found: dict[str, np.ndarray], name: str, shell: Shell) -> None:
    """Raises InputError for a log that cannot be of this robot, in these units."""
    for key, values in found.items():
        if len(bad := np.argwhere(~np.isfinite(values))):
            raise InputError(f"{name} has no number for {key} in row {bad[0][0]}: fill or cut it.")
    targets = np.atleast_2d(found["target"])
    if np.ptp(targets, axis=0).max() > _STILL:
        raise InputError(f"{name} has a target that moves: cut the log where it does.")
    found["target"] = targets[0]
    time, steps = found["time"], np.diff(found["time"])
    if len(time) < 2 or (steps <= 0).any():
        raise InputError(f"{name} is not allowed: its time must rise, over at least two rows.")
    usual = float(np.median(steps))
    if usual > _SLOWEST:
        raise InputError(
            f"{name} has a row every {usual:g} s: give seconds, and a row every {_SLOWEST} s at "
            "least."
        )
    if (worst := float(steps.max())) > max(5 * usual, _SLOWEST):
        when = float(time[steps.argmax()])
        raise InputError(f"{name} has a gap of {worst:.2g} s at {when:.2f} s: cut the log there.")
    if time[-1] - time[0] < _SHORTEST:
        raise InputError(f"{name} lasts {time[-1] - time[0]:.1f} s: it must last {_SHORTEST:g} s.")
    for key, (most, told) in _MOST.items():
        if key in found and (abs(found[key]) > most).any():
            raise InputError(f"{name} has {key} up to {abs(found[key]).max():g}: write {told}.")
    moved = np.abs(np.diff(found["pose"], axis=0)).max(0)
    if (moved > np.array([0.5, 0.5, 1.0])).any():
        raise InputError(
            f"{name} has a pose that jumps by {moved.max():.3g} between two rows: write x and y "
            "[m] and an unbroken yaw [rad]."
        )
    touching = found["contact_type"] > 0
    if not touching.any():
        raise InputError(f"{name} has no contact, so that it tells nothing: log a push.")
    place, half = np.abs(found["p_robot_contact"][touching]), np.array(shell.half, float)
    inside = np.median(np.max(place - half, axis=-1))
    if (place > half + 0.03).any() or inside < -0.05:
        x, y = place.max(0)
        raise InputError(
            f"{name} has contacts up to ({x:.3f}, {y:.3f}) m, and the robot ends at ({half[0]:.3f},"
            f" {half[1]:.3f}) m: it is of another robot, or not in metres; see --robot."
        )


def on_clock(given: Given, interval: float, window: float) -> Log:
    """One log (1, T, ...), its rows held until the next, every `interval` [s] of `window` [s]."""
    found = given.columns
    grid = found["time"][0] + interval * np.arange(round(window / interval))
    at = np.searchsorted(found["time"], grid + 1e-6, side="right") - 1
    rows = {k: v[at][None] for k, v in found.items() if k not in ("time", "target")}
    return Log(valid=(grid <= found["time"][-1] + 1e-6)[None], target=found["target"][None], **rows)


def pace(given: Given, period: float) -> float:
    """The interval [s] of a log's rows, as a multiple of the control period [s]."""
    usual = float(np.median(np.diff(given.columns["time"])))
    return period * max(1, int(np.ceil(usual / period - 0.05)))


def length(given: Given) -> float:
    """How long [s] a log is."""
    time = given.columns["time"]
    return float(time[-1] - time[0])


# --- what a log tells ----------------------------------------------------------------------

_BLOCKS = 10


def mirrored(log: Log) -> Log:
    """The same pushes seen in a mirror at the robot's axis, y to -y."""
    planar_ = np.array([1.0, -1.0, -1.0])
    flip = {"pose": planar_, "twist": planar_, "object_pose": planar_}
    flip |= dict.fromkeys(("p_robot_contact", "target", "f_robot"), planar_[:2])
    turned = {k: getattr(log, k) * sign for k, sign in flip.items() if getattr(log, k) is not None}
    signal = None if log.signal is None else log.signal[..., ::-1]
    return log._replace(**turned, signal=signal)


def statistics(log: Log, interval: float) -> dict[str, np.ndarray]:
    """Summary statistics (B,) of pushes, by name; NaN where there is nothing to tell.

    A name begins with what it needs besides the pose, contacts and commands: `object_pose/`,
    `f_robot/` or `signal/`; the others with `base/`.
    """
    found: dict[str, np.ndarray] = {}

    def put(name: str, values: np.ndarray, group: str = "base") -> None:
        """One column (B,), or several (B, k)."""
        values = np.asarray(values, float)
        for i, column in enumerate(values.reshape(len(values), -1).T):
            found[f"{group}/{name}_{i}"] = column

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
    # What the base did of what it was told, and how much later.
    told, half = _rotate(pose[..., 2], log.twist), max(1, round(0.5 / interval))
    way = interval * np.cumsum(told, axis=1)
    for span in (half, 4 * half):
        at, both = -pose[:, :-span, 2], valid[:, span:] & valid[:, :-span]
        did, want, change = (_rotate(at, _over(x, span)) for x in (pose, way, told))
        for axis in range(3):
            of = slice(axis, axis + 1)
            heard = np.concatenate([want[..., of], change[..., of]], -1)
            put(f"follow_{span}_{axis}", _regression(heard, did[..., of], both))
    # How the contact moves on the base.
    place = log.p_robot_contact
    both = touch[:, half:] & touch[:, :-half] & (_over(np.cumsum(touch, 1), half) == half)
    mean_twist = _over(np.cumsum(log.twist, 1), half) / half
    put("l_noise", _log(_jitter(place, touch)))
    put("l_size", _mean(np.abs(place), touch))
    put("switches", _mean((np.diff(log.contact_type, axis=1) != 0)[..., None], valid[:, 1:]))
    put("first", np.where(touch.any(1), touch.argmax(1), -1) * interval)
    drive = np.concatenate(
        [mean_twist, place[:, :-half, 1:], np.ones_like(mean_twist[..., :1])], -1
    )
    put("slide", _regression(drive, _over(place, half)[..., 1:] / 0.5, both))
    if log.object_pose is not None:
        thing = log.object_pose
        seen = _relative(thing, log.pose)
        turn = seen[..., 2:]
        whole = np.concatenate([seen, np.cos(turn), np.sin(turn)], -1)
        put("seen", _blocks(whole, valid), "object_pose")
        away = np.linalg.norm(seen[..., :2] - place, axis=-1, keepdims=True)
        put("away", np.column_stack([_mean(away, touch), _rms(away, touch)]), "object_pose")
        on_it = _rotate(
            -thing[..., 2], _rotate(log.pose[..., 2], place) + (log.pose - thing)[..., :2]
        )
        put("on_it", _blocks(on_it, touch), "object_pose")
        moved = _rotate(-log.pose[:, :-half, 2], _over(thing, half)) / 0.5
        arm = place[:, :-half, 1:] - seen[:, :-half, 1:2]
        pushed = np.concatenate([mean_twist, arm, mean_twist[..., :1] * arm], -1)
        put("moved", _regression(pushed, moved, both), "object_pose")
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
        level, quiet = np.nanmean(signal, 1), _jitter(log.signal, valid)
        still = ~dead & (np.nanmax(signal, 1) < 0.25)
        put("quiet", _log(_mean(quiet[..., None], still)), "signal")
        deviation = np.nanstd(signal, 1)
        put("drift", _log(_mean(deviation[..., None], still)), "signal")
        put("level", np.sort(np.where(dead, -1, level), -1)[:, -8:], "signal")
        highest = np.sort(np.where(valid[..., None], log.signal, 0.0), -1)[..., -4:]
        put("highest", _blocks(np.arcsinh(highest[..., -1:]), touch), "signal")
        put("reach", _quantiles(highest[..., -1], touch), "signal")
    return found


def _rotate(angle: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors (..., 2) turned by angles (...), whatever follows their first two numbers."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]
    return np.concatenate([np.stack([x, y], -1), v[..., 2:]], -1)


def _relative(pose: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Poses (..., 3) as seen from others."""
    return _rotate(-frame[..., 2], pose - frame)


def _over(values: np.ndarray, span: int) -> np.ndarray:
    """Change over `span` samples."""
    return values[:, span:] - values[:, :-span]


def _mean(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Mean over time (B, k) of (B, T, k), where it holds; NaN where it never does."""
    count = where.sum(1)[:, None]
    total = np.where(where[..., None], values, 0.0).sum(1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _rms(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    return np.sqrt(_mean(values**2, where))


def _log(values: np.ndarray) -> np.ndarray:
    return np.log(np.maximum(values, 1e-6))


def _jitter(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Standard deviation (B, k) of white noise on smooth values, by second differences."""
    second = values[:, 2:] - 2 * values[:, 1:-1] + values[:, :-2]
    return _rms(second / np.sqrt(6), where[:, 2:] & where[:, 1:-1] & where[:, :-2])


def _blocks(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Means (B, blocks * k) over equal shares of the time."""
    cuts = np.linspace(0, values.shape[1], _BLOCKS + 1).astype(int)
    parts = [_mean(values[:, a:b], where[:, a:b]) for a, b in pairwise(cuts)]
    return np.concatenate(parts, -1)


def _quantiles(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Quantiles (B, 5) over time, where it holds."""
    kept = np.where(where, values, np.nan)
    kept[~where.any(1)] = 0.0
    return np.nanquantile(kept, [0.05, 0.25, 0.5, 0.75, 0.95], axis=1).T


def _regression(x: np.ndarray, y: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Ridge coefficients (B, k * m) of y (B, T, m) on x (B, T, k), and residuals (B, m)."""
    x, y = np.where(where[..., None], x, 0.0), np.where(where[..., None], y, 0.0)
    count = np.maximum(where.sum(1), 1)[:, None, None]
    scale = np.sqrt((x**2).sum(1) / count[:, 0]) + 1e-4
    x = x / scale[:, None]
    gram = np.einsum("btk,btl->bkl", x, x) / count + 1e-3 * np.eye(x.shape[-1])
    slope = np.linalg.solve(gram, np.einsum("btk,btm->bkm", x, y) / count)
    left = _log(_rms(y - np.einsum("btk,bkm->btm", x, slope), where))
    return np.concatenate([(slope / scale[..., None]).reshape(len(x), -1), left], -1)
