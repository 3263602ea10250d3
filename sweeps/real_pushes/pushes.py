"""Real pushes as a table: the object, the ways of the fingers, and what models that slide predict.

The object is an aluminium right triangle, legs 150 mm; its frame has its origin in the right-angled
corner. Poses are of this corner.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr

from rps_jax import InputError, errors
from rps_jax.geometry.solid import rotate, wrap
from sweeps.real_pushes import fingers
from sweeps.real_pushes.fingers import Ground
from sweeps.real_pushes.predict_push import uniform_pressure

PushTable = pd.DataFrame | xr.Dataset | Path | str
DATA = Path(__file__).parent / "data"
OUTLINE = np.array([[0.0, 0.0], [0.15, 0.0], [0.0, 0.15]])  # [m] counter-clockwise
COM = np.array([0.05, 0.05])  # [m] the centroid
GYRATION = 0.05  # [m] root of the mean square distance of the object's area from its centroid
MASS = 1.518  # [kg]
HEIGHT = 0.05  # [m] of the object
PUSHED_AT = 0.012  # [m] above the ground, taken for the log's 10 to 13 mm above the frame
GROUND = {"hardboard": 0.28, "plywood": 0.34}  # [1] friction by the authors' code; else the first
FLAT = "patch"  # the support of a flat object
UNKNOWN = "unknown_3pts"  # three feet at unknown positions; the default is assumed
DEFAULT_FEET = "30_90_30_30_30_90"
_ALONG = np.array([[1, 0], [-np.sqrt(0.5), np.sqrt(0.5)], [0, -1]])  # the edges 0, 1, 2
_FAR = 1e3  # [m] where a finger is that is not there
POSE = ("x", "y", "yaw")
_NEEDED = {
    "point": ("tip_x0", "tip_y0", "tip_x1", "tip_y1"),
    "two_point_translation": ("tip_x0", "tip_y0", "tip_x1", "tip_y1", "edge"),
    "two_point_rotation": (
        "cor_bx",
        "cor_by",
        "commanded",
        "close",
        "point_bx",
        "point_by",
        "edge",
    ),
}


def read(table: PushTable | None = None) -> pd.DataFrame:
    """Load a table of pushes; by default the table of this project.

    Args:
      table: a data frame, a dataset of one dimension, or the path of a CSV file, with the columns
        of `data/pushes.csv` (m, rad) that the kind of each push needs. Rows whose column `usable`,
        if there is one, is 0 are left out.

    Raises:
      InputError: the table cannot be read, has no rows, or lacks a column or a value.
    """
    pushes: Any = DATA / "pushes.csv" if table is None else table
    if isinstance(pushes, xr.Dataset):
        pushes = pushes.to_dataframe().reset_index()
    if not isinstance(pushes, pd.DataFrame):
        try:
            pushes = pd.read_csv(pushes)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error).strip()
            raise InputError(
                f"pushes = {pushes} cannot be read ({reason}): give a CSV file of pushes."
            ) from error
    if "usable" in pushes:
        pushes = pushes[pushes.usable != 0]
    pushes = pushes.reset_index(drop=True)
    if pushes.empty:
        raise InputError("pushes without a usable row are not allowed: give at least one push.")
    _require(pushes, ("kind", "support", *(f"pre_{name}" for name in POSE)), "all")
    for kind in pd.unique(pushes.kind):
        errors.check_name("kind of push", kind, _NEEDED)
        _require(chosen(pushes, pushes.kind == kind), _NEEDED[kind], kind)
    for name in pd.unique(pushes.support):
        feet_of(name)
    if "edge" in pushes and not pushes.edge.dropna().isin([0, 1, 2]).all():
        raise InputError("pushes: column edge must be 0 (y = 0), 1 (hypotenuse) or 2 (x = 0).")
    return pushes


def _require(table: pd.DataFrame, names: tuple[str, ...], kind: str) -> None:
    """Raise InputError unless all columns exist and have no gaps."""
    for name in names:
        if name not in table:
            raise InputError(f"pushes lack the column {name}, which kind = {kind} needs.")
        values: Any = table[name]
        if name not in ("kind", "support"):
            values = pd.Series(pd.to_numeric(values, errors="coerce"))
            values = values.where(np.isfinite(values))
        bad = values.isna().to_numpy()
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            raise InputError(
                f"pushes: {name} = {table[name].iloc[row]} in row {table.index[row]} is not "
                f"allowed: kind = {kind} needs it."
            )


def measured(table: pd.DataFrame) -> np.ndarray:
    """Return measured poses (n, 3) [m, m, rad] after the pushes; NaN where unknown."""
    return np.asarray(table.reindex(columns=[f"post_{p}" for p in POSE]), float)


def initial_poses(table: pd.DataFrame) -> np.ndarray:
    """Return poses (n, 3) [m, m, rad] before the pushes."""
    return np.asarray(table[[f"pre_{p}" for p in POSE]], float)


def kind_of_finger(table: pd.DataFrame) -> np.ndarray:
    """Return the kind of finger of pushes (n,): `point` or `two-point`."""
    return np.where(table.kind == "point", "point", "two-point")


def edges(table: pd.DataFrame) -> np.ndarray:
    """Return the pushed edges (n,); 0 where unknown."""
    return np.asarray(table.edge.fillna(0), int) if "edge" in table else np.zeros(len(table), int)


def chosen(table: pd.DataFrame, rows: np.ndarray) -> pd.DataFrame:
    """Return the rows of a table in a mask (n,)."""
    return table.iloc[np.flatnonzero(rows)].reset_index(drop=True)


def doubted(table: pd.DataFrame) -> np.ndarray:
    """Return whether the support of pushes (n,) is uncertain or missing in the logs."""
    noted = table.note.notna() if "note" in table else np.zeros(len(table), bool)
    return np.asarray(noted | (table.support == UNKNOWN), bool)


def actions(table: pd.DataFrame) -> np.ndarray:
    """Return labels (n,) of turns that were repeated on the same feet; -1 for all other pushes."""
    turns = (table.kind == "two_point_rotation") & (table.support != FLAT) & ~doubted(table)
    keys = table.reindex(columns=["support", "surface", *_NEEDED["two_point_rotation"]]).round(4)
    group = keys.groupby(list(keys), dropna=False)
    return np.where(turns & (group.support.transform("size") > 1), group.ngroup(), -1)


# --- support points -------------------------------------------------------------------------


@functools.cache
def feet_of(support: str) -> np.ndarray:
    """Return feet (S, 2) [m] of a support in the body frame; its name has all x in mm, then all y.

    A flat object stands on many points. Raises InputError for an invalid name.
    """
    if support == FLAT:
        return uniform_pressure(OUTLINE, COM)[:, :2]  # of equal areas
    words = (DEFAULT_FEET if support == UNKNOWN else support).split("_")
    try:
        x, y = np.array(words, float).reshape(2, -1) / 1000
    except ValueError:
        x = y = np.zeros(0)
    if x.size < 3:
        rule = f"give {FLAT}, {UNKNOWN} or three x and three y in mm, as {DEFAULT_FEET}"
        raise errors.not_allowed("support", support, rule)
    return np.stack([x, y], axis=1)


def grounds(table: pd.DataFrame, *, on: str) -> Ground:
    """Return the support: its `feet`, the `corners` of its outline, or an `ellipsoid`."""
    count = len(table)
    corners = [OUTLINE] * count
    feet = corners if on == "corners" else [feet_of(name) for name in table.support]
    max_feet = max(map(len, feet))
    at, weight = np.zeros((count, max_feet, 2)), np.zeros((count, max_feet))
    for i, points in enumerate(feet):
        at[i, : len(points)], weight[i, : len(points)] = points - COM, 1.0
    zero = np.zeros(count)
    surface = table.surface if "surface" in table else [""] * count
    shift = np.array([GROUND.get(name, GROUND["hardboard"]) * PUSHED_AT for name in surface])
    ground = Ground(at, weight, zero, shift)
    return ground.ellipsoid() if on == "ellipsoid" else ground


# --- paths of the fingers -------------------------------------------------------------------


def finger_paths(table: pd.DataFrame, steps: int) -> np.ndarray:
    """Return paths (T + 1, n, 2, 2) [m] of two fingers, world; a missing finger is far away.

    A point and two points that do not turn follow the logged tip in a line, two points that turn a
    circle about the commanded centre, by the commanded angle.
    """
    share, pre = np.linspace(0, 1, steps + 1)[:, None, None], initial_poses(table)
    paths = np.full((steps + 1, len(table), 2, 2), _FAR)
    kind = table.kind.to_numpy()
    width = np.full(len(table), 0.05)
    if "finger_width" in table:
        width = np.where(table.finger_width > 0, table.finger_width, width)
    along = _ALONG[edges(table)]
    inward = np.stack([-along[:, 1], along[:, 0]], axis=1)
    straight = kind != "two_point_rotation"
    if straight.any():
        tips = [np.asarray(table[[f"tip_x{i}", f"tip_y{i}"]], float)[straight] for i in (0, 1)]
        line = tips[0] + share * (tips[1] - tips[0])
        half_width = rotate(pre[straight, 2], along[straight]) * width[straight, None] / 2
        double = (kind[straight] != "point")[:, None]
        paths[:, straight, 0] = line - np.where(double, half_width, 0)
        paths[:, straight, 1] = np.where(double, line + half_width, _FAR)
    if (turning := ~straight).any():
        part = chosen(table, turning)
        centre = np.asarray(part[["cor_bx", "cor_by"]], float)
        angle = share[..., 0] * np.asarray(part.commanded, float)
        meet = np.asarray(part[["point_bx", "point_by"]], float)
        meet = meet - np.asarray(part.close, float)[:, None] * inward[turning]
        for i, sign in enumerate((-0.5, 0.5)):
            start = meet + sign * width[turning, None] * along[turning]
            at = centre + rotate(angle, np.broadcast_to(start - centre, (*angle.shape, 2)))
            paths[:, turning, i] = pre[turning, :2] + rotate(pre[turning, 2], at)
    return paths


# --- predictions of sliding models ----------------------------------------------------------


class Motion(NamedTuple):
    """Predicted motion of pushes."""

    pose: np.ndarray  # (n, 3) [m, m, rad] at the end
    force: np.ndarray  # (n, 2) [mu m g] mean of the second half of the path, world


def slide(table: pd.DataFrame, friction: np.ndarray, *, on: str, steps: int) -> Motion:
    """Push a rigid object `on` its feet, the corners of its outline or an ellipsoid."""
    pose, force = np.zeros((len(table), 3)), np.zeros((len(table), 2))
    flat = np.asarray(table.support == FLAT)
    for rows in (flat, ~flat):  # of equally many feet
        if rows.any():
            part = chosen(table, rows)
            inputs = finger_paths(part, steps), initial_poses(part), friction[rows]
            motion = fingers.push(OUTLINE, COM, grounds(part, on=on), *inputs)
            pose[rows], force[rows] = motion.pose[-1], motion.force[steps // 2 :].mean(axis=0)
    return Motion(pose, force)


def with_pusher(table: pd.DataFrame, steps: int) -> np.ndarray:
    """Return poses (n, 3) of an object that moves with its pusher after the first contact."""
    pre, path = initial_poses(table), finger_paths(table, steps)
    path_in_body = rotate(-pre[:, None, 2], path - pre[:, None, :2])
    gap = fingers.nearest(OUTLINE, path_in_body)[0].min(axis=2)
    meets = gap <= 0
    first = np.where(meets.any(axis=0), meets.argmax(axis=0), gap.argmin(axis=0))
    start, end = path[first, np.arange(len(table))], path[-1]
    double = np.asarray(table.kind == "two_point_rotation")
    directions = [
        np.arctan2(*np.where(double[:, None], points[:, 1] - points[:, 0], [1.0, 0.0])[:, ::-1].T)
        for points in (start, end)
    ]
    turn = wrap(directions[1] - directions[0])
    moved = end[:, 0] + rotate(turn, pre[:, :2] - start[:, 0])
    return np.column_stack([moved, pre[:, 2] + turn])


class Errors(NamedTuple):
    """Errors of predicted poses (..., n)."""

    place: np.ndarray  # [m] of the centroid
    turn: np.ndarray  # [rad]
    both: np.ndarray  # [m] root mean square over the object's area


def errors_of(predicted: np.ndarray, actual: np.ndarray) -> Errors:
    """Return the errors of poses (..., n, 3) [m, m, rad].

    `both` is the root-mean-square displacement of the object's area: the distance of the centroids
    combined with the rotation times the radius of gyration, 50 mm.
    """
    turn = np.abs(wrap(predicted[..., 2] - actual[..., 2]))
    centre = [p[..., :2] + rotate(p[..., 2], COM) for p in (predicted, actual)]
    distance = np.linalg.norm(centre[0] - centre[1], axis=-1)
    return Errors(distance, turn, np.hypot(distance, 2 * GYRATION * np.sin(turn / 2)))


def repetitions(results: xr.Dataset) -> tuple[Errors, np.ndarray]:
    """Return the differences between repetitions of a push, and the repeated pushes (n,).

    The differences are of the motions in the frame of the object before the push.
    """
    initial, action = results.initial.values, results.action.values
    moved = rotate(-initial[:, 2], results.measured.values - initial)
    first, second = np.nonzero(np.triu(action[:, None] == action, 1) & (action >= 0))
    return errors_of(moved[first], moved[second]), np.unique([first, second])
