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

from rps_jax import errors
from rps_jax.errors import InputError
from sweeps.real_pushes import sliding
from sweeps.real_pushes.sliding import Ground, turned

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
UNKNOWN = "unknown_3pts"  # three feet of which the logs do not tell where; taken for the usual
USUAL = "30_90_30_30_30_90"
KINDS = ("point", "two_point_rotation", "two_point_translation")
_ALONG = np.array([[1, 0], [-np.sqrt(0.5), np.sqrt(0.5)], [0, -1]])  # the edges 0, 1, 2
_CELLS = 9  # of a flat object's grid, along each leg
_FAR = 1e3  # [m] where a finger is that is not there
POSE = ("x", "y", "yaw")
_NEEDED = {
    "point": ("tip_x0", "tip_y0", "tip_x1", "tip_y1"),
    "two_point_translation": ("tip_x0", "tip_y0", "tip_x1", "tip_y1", "edge"),
    "two_point_rotation": ("cor_bx", "cor_by", "commanded", "close", "point_bx", "point_by",
                           "edge"),
}  # fmt: skip


def read(table: PushTable | None = None) -> pd.DataFrame:
    """Read a table of pushes; by default the project's own.

    Args:
      table: a data frame, a dataset of one dimension, or the path of a CSV file, with the columns
        of `data/pushes.csv` (m, rad) that the kind of each push needs. Rows whose column `usable`,
        if there is one, is 0 are left out.

    Raises:
      InputError: it cannot be read, has no rows, or a column or a number is missing.
    """
    found: Any = DATA / "pushes.csv" if table is None else table
    if isinstance(found, xr.Dataset):
        found = found.to_dataframe().reset_index()
    if not isinstance(found, pd.DataFrame):
        try:
            found = pd.read_csv(found)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error).strip()
            raise InputError(
                f"pushes = {found} cannot be read ({reason}): give a CSV file of pushes."
            ) from error
    if "usable" in found:
        found = found[found.usable != 0]
    found = found.reset_index(drop=True)
    if found.empty:
        raise InputError("pushes without a usable row are not allowed: give at least one push.")
    _require(found, ("kind", "support", *(f"pre_{name}" for name in POSE)), "all")
    for kind in pd.unique(found.kind):
        errors.check_name("kind of push", kind, KINDS)
        _require(chosen(found, found.kind == kind), _NEEDED[kind], kind)
    for name in pd.unique(found.support):
        feet_of(name)
    if "edge" in found and not found.edge.dropna().isin([0, 1, 2]).all():
        raise InputError("pushes: column edge must be 0 (y = 0), 1 (hypotenuse) or 2 (x = 0).")
    return found


def _require(table: pd.DataFrame, names: tuple[str, ...], kind: str) -> None:
    """Raises InputError unless columns are there and have no gaps."""
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
    """Poses (n, 3) [m, m, rad] after the pushes; NaN where none was measured."""
    return np.stack(
        [np.asarray(table[f"post_{p}"], float) if f"post_{p}" in table
         else np.full(len(table), np.nan) for p in POSE], axis=1)  # fmt: skip


def before(table: pd.DataFrame) -> np.ndarray:
    """Poses (n, 3) [m, m, rad] before the pushes."""
    return np.asarray(table[[f"pre_{p}" for p in POSE]], float)


def kind_of_finger(table: pd.DataFrame) -> np.ndarray:
    """Whether pushes (n,) are `point` or `two-point`."""
    return np.where(table.kind == "point", "point", "two-point")


def chosen(table: pd.DataFrame, rows: np.ndarray) -> pd.DataFrame:
    """Some rows of a table, by a mask (n,)."""
    return table.iloc[np.flatnonzero(rows)].reset_index(drop=True)


def doubted(table: pd.DataFrame) -> np.ndarray:
    """Whether (n,) the logs disagree about what the object stood on, or do not tell."""
    noted = table.note.notna() if "note" in table else np.zeros(len(table), bool)
    return np.asarray(noted | (table.support == UNKNOWN), bool)


# --- what the object stands on --------------------------------------------------------------


@functools.cache
def feet_of(support: str) -> np.ndarray:
    """Feet (S, 2) [m] of a support by its name, body frame: all x in mm, then all y.

    A flat object stands on a grid of points. Raises InputError for a name that means nothing.
    """
    if support == FLAT:
        x, y = np.meshgrid(*[(np.arange(_CELLS) + 0.5) / _CELLS * 0.15] * 2)
        return np.stack([x, y], axis=-1)[x + y < 0.15 - 1e-9]
    x = y = np.zeros(0)
    try:
        numbers = np.array((USUAL if support == UNKNOWN else support).split("_"), float) / 1000
        x, y = numbers.reshape(2, -1)
    except ValueError:
        pass  # told below
    if x.size < 3:
        raise InputError(
            f"support = {support} is not allowed: give {FLAT}, {UNKNOWN} or three x and three y in "
            f"mm, as {USUAL}."
        )
    return np.stack([x, y], axis=1)


def grounds(table: pd.DataFrame, *, on: str) -> Ground:
    """What the object stands on: its `feet`, the `corners` of its outline, or an `ellipsoid`.

    The ellipsoid's c is the mean distance of the load from the centre of mass.
    """
    count = len(table)
    corners = [OUTLINE] * count
    feet = corners if on == "corners" else [feet_of(name) for name in table.support]
    most = max(map(len, feet))
    at, weight = np.zeros((count, most, 2)), np.zeros((count, most))
    for i, one in enumerate(feet):
        at[i, : len(one)], weight[i, : len(one)] = one - COM, 1.0
    zero = np.zeros(count)
    surface = table.surface if "surface" in table else [""] * count
    shift = np.array([GROUND.get(name, GROUND["hardboard"]) * PUSHED_AT for name in surface])
    if on == "ellipsoid":
        load = sliding.borne(at, weight, np.zeros((count, 2)))
        arm = np.sum(load * np.linalg.norm(at, axis=-1), axis=1)
        return Ground(np.zeros((count, 1, 2)), np.ones((count, 1)), arm, zero)
    return Ground(at, weight, zero, shift)


# --- where the fingers go -------------------------------------------------------------------


def ways(table: pd.DataFrame, steps: int) -> np.ndarray:
    """Ways (T + 1, n, 2, 2) [m] of two fingers, world; that of a point has its second far away.

    A point and two points that do not turn follow the logged tip in a line, two points that turn a
    circle about the commanded centre, by the commanded angle.
    """
    share, pre = np.linspace(0, 1, steps + 1)[:, None, None], before(table)
    found = np.full((steps + 1, len(table), 2, 2), _FAR)
    kind = table.kind.to_numpy()
    width = np.full(len(table), 0.05)
    if "finger_width" in table:
        width = np.where(table.finger_width > 0, table.finger_width, width)
    edge = np.asarray(table.edge.fillna(0), int) if "edge" in table else np.zeros(len(table), int)
    along = _ALONG[edge]
    inward = np.stack([-along[:, 1], along[:, 0]], axis=1)
    straight = kind != "two_point_rotation"
    if straight.any():
        tips = [np.asarray(table[[f"tip_x{i}", f"tip_y{i}"]], float)[straight] for i in (0, 1)]
        line = tips[0] + share * (tips[1] - tips[0])
        apart = turned(pre[straight, 2], along[straight]) * width[straight, None] / 2
        double = (kind[straight] != "point")[:, None]
        found[:, straight, 0] = line - np.where(double, apart, 0)
        found[:, straight, 1] = np.where(double, line + apart, _FAR)
    if (some := ~straight).any():
        part = chosen(table, some)
        centre = np.asarray(part[["cor_bx", "cor_by"]], float)
        angle = share[..., 0] * np.asarray(part.commanded, float)
        meet = np.asarray(part[["point_bx", "point_by"]], float)
        meet = meet - np.asarray(part.close, float)[:, None] * inward[some]
        for i, sign in enumerate((-0.5, 0.5)):
            start = meet + sign * width[some, None] * along[some]
            at = centre + turned(angle, np.broadcast_to(start - centre, (*angle.shape, 2)))
            found[:, some, i] = pre[some, :2] + turned(pre[some, 2], at)
    return found


# --- what models that slide predict ---------------------------------------------------------


class Found(NamedTuple):
    """What became of pushes."""

    pose: np.ndarray  # (n, 3) [m, m, rad] at the end
    force: np.ndarray  # (n, 2) [mu m g] mean of the second half of the way, world


def slide(table: pd.DataFrame, friction: np.ndarray, *, on: str, steps: int) -> Found:
    """Slide a rigid object that stands `on` its feet, its outline's corners or an ellipsoid."""
    pose, force = np.zeros((len(table), 3)), np.zeros((len(table), 2))
    flat = np.asarray(table.support == FLAT)
    for rows in (flat, ~flat):  # of equally many feet
        if rows.any():
            part = chosen(table, rows)
            found = sliding.push(
                OUTLINE, COM, grounds(part, on=on), ways(part, steps), before(part), friction[rows]
            )
            pose[rows], force[rows] = found.pose[-1], found.force[steps // 2 :].mean(axis=0)
    return Found(pose, force)


def no_motion(table: pd.DataFrame) -> np.ndarray:
    """Poses (n, 3): those before the push."""
    return before(table)


def with_pusher(table: pd.DataFrame, steps: int) -> np.ndarray:
    """Poses (n, 3) of an object that moves as its pusher does, from where they meet."""
    pre, way = before(table), ways(table, steps)
    seen = turned(-pre[:, None, 2], way - pre[:, None, :2])
    gap = sliding.nearest(OUTLINE, seen)[0].min(axis=2)
    meets = gap <= 0
    first = np.where(meets.any(axis=0), meets.argmax(axis=0), gap.argmin(axis=0))
    start, end = way[first, np.arange(len(table))], way[-1]
    double = np.asarray(table.kind == "two_point_rotation")
    span = [np.where(double[:, None], one[:, 1] - one[:, 0], [1.0, 0.0]) for one in (start, end)]
    turn = np.arctan2(*(span[1][:, ::-1]).T) - np.arctan2(*(span[0][:, ::-1]).T)
    turn = angle(turn)
    moved = end[:, 0] + turned(turn, pre[:, :2] - start[:, 0])
    return np.column_stack([moved, pre[:, 2] + turn])


def angle(difference: np.ndarray) -> np.ndarray:
    """Angles [rad] between -pi and pi."""
    return (difference + np.pi) % (2 * np.pi) - np.pi


class Errors(NamedTuple):
    """How far predicted poses (..., n) are from measured ones."""

    place: np.ndarray  # [m] of the centroid
    turn: np.ndarray  # [rad]
    both: np.ndarray  # [m] of the object's area, root of the mean square


def errors_of(predicted: np.ndarray, actual: np.ndarray) -> Errors:
    """Errors of poses (..., n, 3) [m, m, rad].

    `both` is how far each piece of the object's area is from where it was measured, root of the
    mean square: the distance of the centroids, and the turn about them times the radius of
    gyration, 50 mm.
    """
    turn = np.abs(angle(predicted[..., 2] - actual[..., 2]))
    centre = [p[..., :2] + turned(p[..., 2], COM) for p in (predicted, actual)]
    place = np.linalg.norm(centre[0] - centre[1], axis=-1)
    return Errors(place, turn, np.hypot(place, 2 * GYRATION * np.sin(turn / 2)))
