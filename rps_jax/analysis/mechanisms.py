"""Mechanisms of a failed trial, measured in its trace over time.

A mechanism is named only with its measure in this trace, and only from a threshold on. Motion is
that of the poses of base and object, not that of the commands. Events between two snapshots of the
trace are not counted.
"""

import numpy as np
import xarray as xr
from scipy import signal
from scipy.spatial.transform import Rotation

from rps_jax.robot import skin

AWAY = 0.5  # [m] by which the base drives away from the target
STILL_TIME = 10.0  # [s] for which the base stands still
STILL_SPEED = 0.001  # [m/s] of the base's corners then, at most
SIDE_TIME = 10.0  # [s] of contact behind the front of the base
CORNER = 0.03  # [m] behind the front, at most
LOST_TIME = 5.0  # [s] without contact after the first touch
REVERSALS = 4  # of a motion to and fro
SWAY = 0.05  # [m] of lateral motion of the base between two reversals
CROSSING = 1.0  # [1] half widths of the base that the contact crosses between two reversals
TILT = np.deg2rad(5.0)  # [rad] of the object
TURN = np.deg2rad(90.0)  # [rad] of the object about the vertical

THRESHOLDS = (
    "A mechanism is listed only with its measure in the world's trace, and from a threshold on: "
    f"{AWAY:g} m of driving away from the target, {STILL_TIME:g} s of standing still (below "
    f"{1000 * STILL_SPEED:g} mm/s), {LOST_TIME:g} s without contact after the first touch, "
    f"{REVERSALS} reversals of a motion to and fro (of {100 * SWAY:g} cm; of the contact over half "
    f"of the base's width), a tilt of {np.rad2deg(TILT):.0f} deg, a turn of the object by "
    f"{np.rad2deg(TURN):.0f} deg, {SIDE_TIME:g} s of contact on a side of the base (more than "
    f"{100 * CORNER:g} cm behind the front), and any time in the Realignment State or a reposition."
)


def measured(trace: xr.Dataset) -> dict[str, str]:
    """Return the mechanisms of one trial, each with its measure in the trial's trace.

    Args:
      trace: a trial over time, as `Trace.data`.

    Returns:
      Names and measures; empty if no measure reaches its threshold.
    """
    time, qpos = trace.time.values, trace.qpos.values
    touching = trace.contact_type.values != skin.NONE
    period, base, yaw = np.diff(time), qpos[:, :2], np.unwrap(qpos[:, 2])
    half = float(trace.half_length), float(trace.half_width)
    measures = {}

    if trace.outcome_nan_twist:
        measures["command that is not finite"] = f"at {float(trace.outcome_time):.2f} s"

    distance = np.linalg.norm(base - trace.p_world_target.values, axis=1)
    rise = distance - np.minimum.accumulate(distance)
    if (greatest := rise.max()) >= AWAY:
        end = int(rise.argmax())
        duration = time[end] - time[distance[: end + 1].argmin()]
        measures["driving away from the target"] = f"{greatest:.2f} m in {duration:.0f} s"

    realigning = trace.realigning.values > 0.5
    if realigning.any():
        duration = period[realigning[:-1]].sum()
        measures["realigning or repositioning"] = f"{_times(realigning)}, {duration:.0f} s in all"

    lateral = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)  # axis of the base
    sway = np.sum(np.diff(base, axis=0) * (lateral[:-1] + lateral[1:]) / 2, axis=1).cumsum()
    across = trace.p_robot_contact.values[touching, 1]
    behind_front = half[0] - trace.p_robot_contact.values[:, 0] > CORNER
    if (duration := period[(touching & behind_front)[:-1]].sum()) >= SIDE_TIME:
        measures["contact on a side of the base"] = f"{duration:.0f} s"
    for name, path, least in (
        ("reversals of the base's lateral motion", sway, SWAY),
        ("reversals of the contact across the base", across, CROSSING * half[1]),
    ):
        if (count := reversals(path, least)) >= REVERSALS:
            measures[name] = str(count)

    lost = ~touching & np.logical_or.accumulate(touching)
    if (duration := float(trace.outcome_contact_lost_time)) >= LOST_TIME:
        name = "no contact after the first touch"
        measures[name] = f"{duration:.0f} s, lost {_times(lost)}"

    speed = np.linalg.norm(np.diff(base, axis=0), axis=1) + np.hypot(*half) * np.abs(np.diff(yaw))
    still = speed < STILL_SPEED * period
    for name, mask in (("against the object", touching), ("without contact", ~touching)):
        if (duration := period[still & mask[:-1]].sum()) >= STILL_TIME:
            measures[f"base still {name}"] = f"{duration:.0f} s"

    rotation = Rotation.from_quat(qpos[:, 6:10], scalar_first=True)
    tilt = np.arccos(np.clip(rotation.apply([0, 0, 1])[:, 2], -1, 1))
    if (greatest := float(trace.outcome_tilt)) >= TILT:
        measures["tilt of the object"] = f"{np.rad2deg(greatest):.0f} deg"
        upright = time[tilt < TILT]
        if trace.outcome_tipped and upright.size:
            duration = float(trace.outcome_time) - upright[-1]
            measures["fall of the object"] = f"{duration:.1f} s from {np.rad2deg(TILT):.0f} deg on"
    ahead = rotation.apply([1, 0, 0])
    turn = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    if (greatest := np.abs(turn - turn[0]).max()) >= TURN:
        measures["turn of the object"] = f"{np.rad2deg(greatest):.0f} deg"
    return measures


def describe(trace: xr.Dataset) -> str:
    """Return the mechanisms of one trial with their measures as text, empty without any."""
    return "; ".join(f"{name}: {measure}" for name, measure in measured(trace).items())


def reversals(path: np.ndarray, least: float) -> int:
    """Count the turning points of a path (N,) before and after which it moves by `least`."""
    return sum(signal.find_peaks(side, prominence=least)[0].size for side in (path, -path))


def _times(active: np.ndarray) -> str:
    """Return the number of intervals in which a mask (T,) is true, in words."""
    count = int((np.diff(active.astype(int), prepend=0) > 0).sum())
    return "once" if count == 1 else f"{count} times"
