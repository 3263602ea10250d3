"""Fit friction, pressure and offsets of sensors to pushes of one object by one round finger.

    rps fit object outline.csv pushes.csv --radius 0.00475

Contact alone shows how the camera is placed against the robot and the markers on the object: at the
end of a push the finger touches the outline. The pressure under the object is the exponential of a
few smooth functions, and the push that ends at the measured pose has a friction. All are fitted
together, with priors, to robust residuals (Cauchy). A Gaussian process over the place and the
direction of a push corrects what the fitted pushes leave nearby.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from rps_jax import errors
from rps_jax.analysis.report import Section
from rps_jax.engines import finger
from rps_jax.geometry import planar, polyline, solid
from rps_jax.geometry.arrays import Array, Pair
from rps_jax.record import files, table
from rps_jax.record.files import JsonObject
from rps_jax.record.options import option
from rps_jax.runs.question import Question, Rows, Run, call_of

# Priors (mean, standard deviation) of the parameters; pressures are logarithms per unit of the
# functions of `_pressure`, offsets are in m and rad.
PRIOR: Mapping[str, tuple[float, float]] = {
    "log_friction": (-1.5, 0.4),
    "ring": (0.3, 1.0),
    **dict.fromkeys(("tilt_x", "tilt_y", "saddle", "shear"), (0.0, 0.4)),
    **dict.fromkeys(("cubic_x", "cubic_y", "trefoil_x", "trefoil_y", "quartic"), (0.0, 0.3)),
    **dict.fromkeys(
        ("quartic_saddle", "quartic_shear", "quatrefoil_x", "quatrefoil_y"), (0.0, 0.2)
    ),
    "camera_x": (0.0, 1e-3),
    "camera_y": (0.0, 1e-3),
    "marker_x": (0.0, 5e-4),
    "marker_y": (0.0, 5e-4),
    "marker_yaw": (0.0, 0.015),
    "size": (0.0, 5e-3),
    "finger": (0.0, 1e-4),
}
_OFFSETS = {"camera_x": "m", "camera_y": "m", "marker_x": "m", "marker_y": "m", "marker_yaw": "rad"}
_GAP = 2e-4  # [m] standard deviation of gaps
_LOSS = 1e-3, 0.05  # scale of Cauchy's loss: [m], and share of the motion of the object
_APART = 1e-3  # [m] gap at the end of a push whose finger no longer touches
_MOST_GAP = 5e-4  # [m] median gap at the end that a fit leaves, at most
_FOOT = 1e-3  # [m] radius of a known foot
_INSIDE = 5e-3  # [m] of the finger in the object at the start, at most
# Beyond these, numbers are in other units: [m/s] median speed of the finger, [m] median gap at the
# end, and motion of the object over that of the finger, of which sliding objects have at most 1.
_SPEEDS, _AWAY, _CARRIED = (5e-4, 5.0), 0.02, 2.0
# Scatter of a prediction, from other objects: a constant and a share of the motion. Quantiles of
# errors over the scatter at 90 %, and the number of pushes that they count for in a fit.
_SCATTER = {"place": (3e-4, 0.045), "turn": (5e-3, 0.075)}
_QUANTILE, _PSEUDO = {"place": 2.75, "turn": 2.7}, 20
# Lengths of the Gaussian process, from other objects: of the place of the finger over the half size
# of the object, of the direction of the push, and of that of the object. Variance of the noise over
# that of the process, and residuals beyond which they are cut, over 1.5 times their median.
_NEAR, _NOISE, _CUT = (0.3, 0.4, 1.0), 0.7, 3.0
_SMALL_BATCH, _BATCH, _MAX_PUSHES = (
    32,
    128,
    512,
)  # pushes of a small and a large batch, and of a fit at most
_PADS, _CORNERS = 64, (8, 128)  # of an object, padded
_COLUMNS = {"push": "", "time": "s", "x": "m", "y": "m", "yaw": "rad", "tip_x": "m", "tip_y": "m"}


class Pushes(NamedTuple):
    """Pushes of one object: arrays of n pushes."""

    path: np.ndarray  # (n, P, 2) [m] of the finger's middle, world; straight between points
    start: np.ndarray  # (n, 3) [m, m, rad] measured pose of the object before
    end: np.ndarray  # (n, 3) after; NaN where unknown

    def gaps(self, outline: ArrayLike, radius: float, at_end: bool = False) -> np.ndarray:
        """Return the gaps (n,) [m] between outline and finger at the start, negative inside."""
        pose = self.end if at_end else self.start
        points = solid.rotate(-pose[:, 2], self.path[:, -at_end] - pose[:, :2])
        p, a = (points @ (1, 1j))[:, None], np.asarray(outline) @ (1, 1j)
        edges = a, np.roll(a, -1)
        away = polyline.to_segment(p, *edges).min(axis=1)
        return np.where(polyline.is_inside(p, *edges), -away, away) - radius


PushesLike = str | Path | pd.DataFrame | Pushes


def read_pushes(pushes: PushesLike) -> Pushes:
    """Return pushes from a table with a row for each time of each push.

    Columns are `push`, `time` [s], the pose `x`, `y` [m], `yaw` [rad] of the object and the middle
    `tip_x`, `tip_y` [m] of the finger.

    Raises:
      InputError: the table lacks a column or numbers, has other units, or the times of a push do
        not increase.
    """
    if isinstance(pushes, Pushes):
        return pushes
    name = "pushes" if isinstance(pushes, pd.DataFrame) else f"pushes = {pushes}"
    if not isinstance(pushes, pd.DataFrame):
        pushes = table.read(Path(pushes), name, _COLUMNS.get)
    table.require(pushes, name, _COLUMNS)
    numbers = pushes[list(_COLUMNS)].apply(pd.to_numeric, errors="coerce")
    columns = f"pushes ({', '.join(_COLUMNS)})"
    rows = errors.check_array(columns, numbers, ("n", len(_COLUMNS)))
    largest = numbers[[name for name, unit in _COLUMNS.items() if unit == "m"]].abs().max()
    if largest.max() > 50:
        rule = "it is at most 50 m: give x and y in m and yaw in rad"
        raise errors.not_allowed(str(largest.idxmax()), f"up to {largest.max():.3g}", rule)
    parts = [rows[rows[:, 0] == name] for name in dict.fromkeys(rows[:, 0])]
    for part in parts:
        if len(part) < 2 or (np.diff(part[:, 1]) <= 0).any():
            rule = "give 2 or more rows whose times increase"
            raise errors.not_allowed("time", f"that of push {part[0, 0]:g}", rule)
        errors.check_angle(f"yaw at the start of push {part[0, 0]:g}", part[0, 4])
    ways = (np.linalg.norm(np.diff(part[:, 5:], axis=0), axis=1).sum() for part in parts)
    speeds = [way / np.ptp(part[:, 1]) for way, part in zip(ways, parts, strict=True)]
    if not _SPEEDS[0] <= (speed := np.median(speeds)) <= _SPEEDS[1]:
        rule = "it is {:g} to {:g} m/s: give time in s, tip_x and tip_y in m".format(*_SPEEDS)
        raise errors.not_allowed("speed of the finger", f"{speed:.2g} m/s (median)", rule)
    length = max(map(len, parts))
    path = [x[np.minimum(np.arange(length), len(x) - 1), 5:] for x in parts]
    return Pushes(np.array(path), *(np.array([x[i, 2:5] for x in parts]) for i in (0, -1)))


def _pressure(theta: Mapping[str, Array], pads: np.ndarray) -> Array:
    """Return the shares (S,) of the load of pads of equal density."""
    at, load = pads[:, :2], pads[:, 2]
    at = at - load @ at
    x, y = (at / jnp.sqrt(load @ jnp.sum(at**2, axis=1))).T
    square, saddle, shear = x * x + y * y, x * x - y * y, 2 * x * y
    functions = {
        "ring": square - 1,
        "tilt_x": x,
        "tilt_y": y,
        "saddle": saddle,
        "shear": shear,
        "cubic_x": x * (square - 2),
        "cubic_y": y * (square - 2),
        "trefoil_x": x * saddle - y * shear,
        "trefoil_y": x * shear + y * saddle,
        "quartic": square * square - 3 * square + 1,
        "quartic_saddle": saddle * (square - 2),
        "quartic_shear": shear * (square - 2),
        "quatrefoil_x": saddle**2 - shear**2,
        "quatrefoil_y": 2 * saddle * shear,
    }
    logarithm: Any = sum(theta[name] * f for name, f in functions.items())
    share = load * jnp.exp(jnp.clip(logarithm, -8.0, 8.0))
    return share / share.sum()


def _slider(x: Array, outline: np.ndarray, pads: np.ndarray, radius: float) -> Any:
    """Return the object that parameters describe, and the offset (2,) [m] of the camera."""
    theta = dict(zip(PRIOR, x, strict=True))
    size, shift = 1 + theta["size"], jnp.stack([theta["marker_x"], theta["marker_y"]])

    def placed(points: np.ndarray) -> Array:
        return planar.rotate(theta["marker_yaw"], size * points) + shift

    support = jnp.column_stack([placed(pads[:, :2]), _pressure(theta, pads), pads[:, 3]])
    friction = jnp.exp(theta["log_friction"])
    slider = finger.Slider(placed(outline), support, friction, radius + theta["finger"])
    return slider, jnp.stack([theta["camera_x"], theta["camera_y"]])


@jax.jit
def _simulate(x: Array, fixed: tuple, path: Array, start: Array, end: Array) -> Pair:
    """Return final poses (n, 3) and gaps (n, 3) [m].

    These are at measured starts, if negative; at measured ends, if the finger still touches there;
    and at the ends of the model.
    """
    slider, camera = _slider(x, *fixed)
    pushed = finger.push(slider, path + camera, start)
    gap = jax.vmap(lambda pose, tip: finger.gap_of(slider, pose, tip + camera)[0])
    inside = jnp.minimum(gap(start, path[:, 0]), 0.0)
    touches = jax.lax.stop_gradient(pushed.gap[:, -1]) < _APART
    at_end = jnp.where(touches, gap(end, path[:, -1]), 0.0)
    return pushed.pose[:, -1], jnp.stack([inside, at_end, pushed.gap[:, -1]], axis=1)


_derivatives = jax.jit(jax.jacfwd(_simulate))  # by the parameters, along the last axis


@dataclass(frozen=True)
class ObjectFit:
    """Fitted object: parameters, their covariance, and predictions."""

    # `mean`, `deviation`, `prior` (parameter), `covariance`, `gap` (push) [m]
    data: xr.Dataset = field(repr=False)
    outline: np.ndarray  # (N, 2) [m] counter-clockwise
    radius: float  # [m] of the finger
    quantile: Mapping[str, float]  # of the errors over their scatter, at 90 %
    # (S, 4) of even pressure: x, y [m], share [1] and radius [m]
    pads: np.ndarray = field(repr=False)
    # Fitted pushes (n, 6) as of `_traits`, and their weights (n, 3) [m, m, rad] for other pushes
    nearby: tuple[np.ndarray, np.ndarray] = field(
        default=(np.zeros((0, 6)), np.zeros((0, 3))), repr=False
    )

    @property
    def friction(self) -> float:
        """Friction between object and finger [1]."""
        return float(np.exp(self.data["mean"].sel(parameter="log_friction")))

    @property
    def feet(self) -> np.ndarray:
        """Pads (S, 5) of the pressure for `register_object`, at most 16."""
        counts = range(14, 0, -1) if len(self.pads) > 16 else ()
        smaller = (finger.uniform_pads(self.outline, n) for n in counts)
        pads = next((x for x in smaller if len(x) <= 16), self.pads)
        theta = {name: jnp.asarray(float(self.data["mean"].sel(parameter=name))) for name in PRIOR}
        share = np.asarray(_pressure(theta, pads), float)
        return np.column_stack([pads[:, :2], share, np.ones(len(pads)), pads[:, 3]])

    def predict(self, pushes: PushesLike) -> xr.Dataset:
        """Predict pushes.

        Returns:
          `pose` (push, axis) [m, m, rad] at the end, and the radii `place` [m] and `turn` [rad]
          (push) within which 90 % of the measured ends are expected.
        """
        pushes = read_pushes(pushes)
        pose, slope = self._pose_and_slope(pushes)
        scatter = _scatter(pose, slope, pushes.start, self.data.covariance.values)
        fitted, weight = self.nearby
        change = _kernel(_traits(self.outline, pushes), fitted) @ weight
        pose = pose + solid.rotate(pushes.start[:, 2], change)
        radii = {name: ("push", self.quantile[name] * x) for name, x in scatter.items()}
        coords = {"axis": ["x", "y", "yaw"]}
        return xr.Dataset({"pose": (("push", "axis"), pose), **radii}, coords)

    def _pose_and_slope(self, pushes: Pushes) -> tuple[np.ndarray, np.ndarray]:
        """Return final poses (n, 3) and their derivatives (n, 3, p)."""
        fixed = _fixed(self.outline, self.pads, self.radius)
        inputs = self.data["mean"].values, fixed, pushes
        return _batched(_simulate, *inputs)[0], _batched(_derivatives, *inputs)[0]

    @property
    def misplaced(self) -> str:
        """Sentence about offsets of camera and markers that differ from zero."""
        words = []
        for name, unit in _OFFSETS.items():
            mean, sd = (float(self.data[x].sel(parameter=name)) for x in ("mean", "deviation"))
            scale, unit = (1e3, "mm") if unit == "m" else (180 / np.pi, "deg")
            if abs(mean) > 2 * sd:
                words.append(f"{name} {scale * mean:.2f} +- {scale * sd:.2f} {unit}")
        listing = ", ".join(words)
        return (
            f"The sensors are misplaced: {listing}." if words else "The sensors fit the contacts."
        )


def _pads_of(feet: ArrayLike, outline: np.ndarray) -> np.ndarray:
    """Return pads (S, 4) of equal loads at feet (S, 2) [m] under an outline."""
    at = errors.check_array("feet", feet, ("S", 2))
    if not 3 <= len(at) <= _PADS:
        raise errors.not_allowed("feet", f"{len(at)} points", f"give 3 to {_PADS} points x, y [m]")
    if (away := np.abs(at - outline.mean(axis=0)).max()) > 2 * _half_size(outline):
        rule = "they are under the object: give x, y [m] in the frame of the outline"
        raise errors.not_allowed("feet", f"up to {away:.3g} m from its middle", rule)
    return np.column_stack([at, np.full(len(at), 1 / len(at)), np.full(len(at), _FOOT)])


def _fixed(
    outline: np.ndarray, pads: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return outline, pads and radius, repeated so that many objects share a program."""
    unused = np.repeat(pads[-1:] * [1, 1, 0, 1], max(0, _PADS - len(pads)), axis=0)
    corners = next((n for n in _CORNERS if n >= len(outline)), len(outline))
    repeated = outline[np.minimum(np.arange(corners), len(outline) - 1)]
    return repeated, np.concatenate([pads, unused]), radius


def _batched(
    function: Callable[..., Pair], x: np.ndarray, fixed: tuple, pushes: Pushes
) -> tuple[np.ndarray, np.ndarray]:
    """Return both outputs of a function of parameters and n pushes, with a leading axis n.

    Batches are padded by repetition to one of two sizes.
    """
    parts = []
    for first in range(0, len(pushes.path), _BATCH):
        count = min(len(pushes.path) - first, _BATCH)
        size = _SMALL_BATCH if count <= _SMALL_BATCH else _BATCH
        index = first + np.minimum(np.arange(size), count - 1)
        part = [jnp.asarray(np.asarray(y, float)[index]) for y in pushes]
        outputs = function(jnp.asarray(x), fixed, *part)
        parts.append([np.asarray(y, float)[:count] for y in outputs])
    first, second = map(np.concatenate, zip(*parts, strict=True))
    return first, second


def _scatter(
    pose: np.ndarray, slope: np.ndarray, start: np.ndarray, covariance: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the scatter (n,) of place [m] and turn [rad], of the model and the parameters."""
    moved = _distance(pose, start)
    spread = np.einsum("nip,pq,niq->ni", slope, covariance, slope)
    # The scatter of the model grows with the motion of the object.
    size = {"place": moved, "turn": np.abs(pose[:, 2] - start[:, 2])}
    variance = {"place": spread[:, :2].sum(axis=1), "turn": spread[:, 2]}
    return {
        name: np.sqrt((least + share * size[name]) ** 2 + variance[name])
        for name, (least, share) in _SCATTER.items()
    }


def _distance(pose: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the distance (n,) [m] between poses (n, 3)."""
    return np.linalg.norm(pose[:, :2] - end[:, :2], axis=1)


def errors_of(pose: np.ndarray, end: np.ndarray) -> dict[str, np.ndarray]:
    """Return the errors (n,) of poses (n, 3): `place` [m] and `turn` [rad]."""
    turn = np.abs(solid.wrap(pose[:, 2] - end[:, 2]))
    return {"place": _distance(pose, end), "turn": turn}


def _half_size(outline: np.ndarray) -> float:
    return float(np.ptp(outline, axis=0).max()) / 2


def _check(corners: np.ndarray, data: Pushes, radius: float, prior: Mapping) -> None:
    """Raise InputError for inputs of a fit that make no sense, before anything is compiled."""
    errors.check_finite("radius", radius, at_least=1e-4, at_most=0.5, unit="m")
    count = len(data.path)
    for name, pair in prior.items():
        errors.check_name("parameter of the prior", name, PRIOR)
        _, deviation = errors.check_array(f"prior {name}", pair, (2,))
        errors.check_finite(f"prior {name} deviation", deviation, above=0)
    if not 3 <= count <= _MAX_PUSHES:
        raise errors.not_allowed("pushes", count, f"give 3 to {_MAX_PUSHES}, better 5 or more")
    gaps = data.gaps(corners, radius)
    if gaps[i := int(gaps.argmin())] < -_INSIDE:
        rule = f"it starts {-1e3 * gaps[i]:.1f} mm inside the object; check outline and units"
        raise errors.not_allowed("pushes", f"push {i}", rule)
    turns = np.abs(data.end[:, 2] - data.start[:, 2])
    turns = np.where(turns < 2 * np.pi, np.abs(solid.wrap(turns)), turns) * _half_size(corners)
    moved = _distance(data.end, data.start)
    way = np.linalg.norm(np.diff(data.path, axis=1), axis=2).sum()
    for name, unit, motion in (("x and y", "m", moved), ("yaw", "rad", turns)):
        if (ratio := np.nansum(motion) / max(way, 1e-9)) > _CARRIED:
            rule = f"the finger carries an object at most {_CARRIED:g} times as far: give {unit}"
            raise errors.not_allowed(name, f"{ratio:.3g} times the way of the finger", rule)
    if (gap := np.median(np.nan_to_num(np.abs(data.gaps(corners, radius, at_end=True))))) > _AWAY:
        rule = f"the finger is {gap:.3g} m away: give x, y, tip_x, tip_y in m and yaw in rad"
        raise errors.not_allowed("pushes", "without a contact at the end", rule)


def _traits(outline: np.ndarray, pushes: Pushes) -> np.ndarray:
    """Return coordinates (n, 6) of pushes between which a Gaussian process interpolates."""
    yaw, way = -pushes.start[:, 2], pushes.path[:, -1] - pushes.path[:, 0]
    way = way / np.maximum(np.linalg.norm(way, axis=1), 1e-9)[:, None]
    at = (pushes.path[:, 0] - pushes.start[:, :2]) / _half_size(outline)
    turned = solid.rotate(yaw, at), solid.rotate(yaw, way), solid.unit(yaw)
    return np.concatenate([x / near for x, near in zip(turned, _NEAR, strict=True)], axis=1)


def _kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the correlation (n, m) of pushes (n, 6) and (m, 6)."""
    return np.exp(-np.sum((a[:, None] - b) ** 2, axis=2) / 2)


def _calibrated(fitted: ObjectFit, data: Pushes) -> ObjectFit:
    """Return a fit that also learns corrections and quantiles from the fitted pushes."""
    pose, slope = fitted._pose_and_slope(data)
    scatter = _scatter(pose, slope, data.start, fitted.data.covariance.values)
    rest = data.end - pose
    rest[:, 2] = solid.wrap(rest[:, 2])
    rest, traits = solid.rotate(-data.start[:, 2], rest), _traits(fitted.outline, data)
    limit, count = _CUT * 1.5 * np.median(np.abs(rest), axis=0), len(pose)
    inverse = np.linalg.inv(_kernel(traits, traits) + _NOISE * np.eye(count))
    cut = np.clip(rest, -limit, limit)
    weight = inverse @ cut
    # Each push predicted from the others.
    alone = rest - cut + weight / np.diag(inverse)[:, None]
    off = errors_of(alone, np.zeros_like(alone))
    free = count / max(1.0, count - len(PRIOR) / 3)  # parameters take a part of each error
    measured = {name: np.sqrt(free) * np.quantile(off[name] / scatter[name], 0.9) for name in off}
    share = count / (count + _PSEUDO)
    quantile = {name: (1 - share) * _QUANTILE[name] + share * measured[name] for name in measured}
    return replace(fitted, quantile=quantile, nearby=(traits, weight))


@dataclass(frozen=True)
class FitObject(Question[ObjectFit]):
    """Fit friction, pressure and offsets of sensors to five tracked pushes of one object.

    The finger is round and pushes slowly. The answer has the parameters with their standard
    deviations, predicts other pushes with intervals, and says how camera and markers are misplaced.

    Examples:
      >>> import numpy as np
      >>> import pandas as pd
      >>> import rps_jax
      >>> box = [(-0.05, -0.05), (0.05, -0.05), (0.05, 0.05), (-0.05, 0.05)]
      >>> rows = [(0, 0.0, 0.0, 0.0, 0.0, -0.055, 0.02), (0, 1.0, 0.04, 0.0, 0.0, -0.015, 0.02)]
      >>> names = ["push", "time", "x", "y", "yaw", "tip_x", "tip_y"]
      >>> table = pd.DataFrame(rows * 3, columns=names)
      >>> table["push"] = np.repeat([0, 1, 2], 2)
      >>> fitted = rps_jax.fit_object(box, table, 0.005)
      >>> dict(fitted.predict(table).pose.sizes)
      {'push': 3, 'axis': 3}
    """

    TITLE = "An object fitted to pushes"
    IGNORED_FIELDS = ("outline", "pushes")  # their values matter

    outline: str | Any = option("", positional=True)
    """Corners x, y [m] of a simple polygon in the object's frame: an array, or a table FILE.csv
    with the columns x and y."""
    pushes: PushesLike = option("", positional=True)
    """Table FILE.csv of pushes: push, time, x, y, yaw of the object, tip_x, tip_y of the finger's
    middle; in Python also a data frame."""
    radius: float = option(0.005, 1e-4, 0.5, unit="m")
    """Radius of the finger."""
    feet: Any = option(None, kw_only=True, hidden=True)
    """Known feet x, y [m] (S, 2) of the object, in Python; by default it has pressure under all of
    its outline."""
    prior: Mapping[str, Any] | None = option(None, kw_only=True, hidden=True)
    """Priors (mean, standard deviation) of parameters by name, in Python; by default `PRIOR`."""

    @functools.cached_property
    def _inputs(self) -> tuple[np.ndarray, Pushes]:
        """Outline and pushes, read from their tables."""
        outline = self.outline
        if isinstance(outline, str | Path):
            name = f"outline = {outline}"
            corners = table.read(Path(outline), name, {"x": "m", "y": "m"}.get)
            table.require(corners, name, ("x", "y"))
            outline = corners[["x", "y"]].to_numpy(float)
        return finger.check_outline(outline), read_pushes(self.pushes)

    @functools.cached_property
    def _pads(self) -> np.ndarray:
        """Pads (S, 4) under the object: at its feet, or under all of its outline."""
        corners = self._inputs[0]
        return finger.uniform_pads(corners) if self.feet is None else _pads_of(self.feet, corners)

    def check(self) -> None:
        super().check()
        _check(*self._inputs, self.radius, self.prior or PRIOR)
        _ = self._pads

    def fields_as_json(self) -> JsonObject:
        """Fields as JSON; outline and pushes by the digest of their values."""
        corners, data = self._inputs
        contents = b"".join(np.asarray(x, float).tobytes() for x in (corners, *data))
        return super().fields_as_json() | {"inputs": files.sha256(contents)}

    def answer(self, run: Run) -> ObjectFit:
        """Fit the object to the pushes."""
        corners, data = self._inputs
        mean, deviation = np.array([*{**PRIOR, **(self.prior or {})}.values()]).T
        fixed, size = _fixed(corners, self._pads, self.radius), _half_size(corners)
        turn = size * solid.wrap(data.end[:, 2] - data.start[:, 2])
        way = _distance(data.end, data.start)
        unit = _LOSS[0] + _LOSS[1] * np.nan_to_num(np.abs(np.stack([way, way, turn], axis=1)))

        def residuals(z: np.ndarray) -> np.ndarray:
            """Return robust residuals of poses and gaps, and those of the priors."""
            pose, gap = _batched(_simulate, mean + deviation * z, fixed, data)
            off = pose - data.end
            off[:, 2] = size * solid.wrap(off[:, 2])
            rows = np.append(off / unit, gap[:, :2].T / _GAP)
            return np.append(np.nan_to_num(np.sign(rows) * np.sqrt(np.log1p(rows**2))), z)

        def slopes(z: np.ndarray) -> np.ndarray:
            x, robust = mean + deviation * z, residuals(z)[: -len(z)]
            pose, gap = _batched(_derivatives, x, fixed, data)
            pose = pose / unit[:, :, None] * np.array([1, 1, size])[:, None]
            rows = np.concatenate([pose.reshape(-1, len(z)), *gap[:, :2].swapaxes(0, 1) / _GAP])
            # Derivative of Cauchy's root loss g = sqrt(log(1 + r^2)), with r^2 = exp(g^2) - 1.
            square = np.expm1(robust**2)
            ratio = np.where(square > 1e-12, np.sqrt(square) / np.maximum(abs(robust), 1e-9), 1.0)
            rows *= (ratio / (1 + square))[:, None]
            return np.concatenate([rows * deviation, np.eye(len(z))])

        derivatives: Any = slopes  # SciPy's types lack functions
        start = np.zeros(len(mean))
        best = least_squares(residuals, start, derivatives, max_nfev=40, ftol=1e-4, xtol=1e-3)
        x = mean + deviation * best.x
        gaps = _batched(_simulate, x, fixed, data)[1]
        touches, gaps = gaps[:, 2] < _APART, gaps[:, 1]
        if not touches.any():
            raise errors.not_allowed("pushes", "without a contact at the end", "push the object")
        gaps = np.where(touches, gaps, np.nan)
        if np.nanmedian(np.abs(gaps)) > _MOST_GAP:
            rule = (
                "after the fit it is at most 0.5 mm if outline, units, finger and pushes are of "
                "one object and the finger touches it at the end"
            )
            words = f"{1e3 * np.nanmedian(np.abs(gaps)):.2g} mm (median)"
            raise errors.not_allowed("gap at the end of the pushes", words, rule)
        j = slopes(best.x)
        covariance = np.linalg.inv(j.T @ j)
        covariance = deviation[:, None] * covariance * deviation
        columns = {
            "mean": ("parameter", x),
            "deviation": ("parameter", np.sqrt(np.diag(covariance))),
            "prior": (("parameter", "moment"), np.column_stack([mean, deviation])),
            "covariance": (("parameter", "other"), covariance),
            "gap": ("push", gaps),
        }
        data_set = xr.Dataset(columns, {"parameter": list(PRIOR)})
        fitted = ObjectFit(data_set, corners, self.radius, _QUANTILE, self._pads)
        return fitted if np.isnan(data.end).any() else _calibrated(fitted, data)

    def report(self, results: ObjectFit, run: Run) -> Sequence[Section]:
        data = results.data
        rows: Rows = [["parameter", "unit", "mean", "standard deviation"]]
        for name in PRIOR:
            row, unit = data.sel(parameter=name), _OFFSETS.get(name, "1")
            rows.append([name, unit, f"{float(row['mean']):.4g}", f"{float(row.deviation):.2g}"])
        gap, feet = 1e3 * float(abs(data.gap).median()), results.feet
        x, y = 1e3 * feet[:, 2] @ feet[:, :2]
        text = (
            f"The friction between object and finger is {results.friction:.2f}. The object's "
            f"weight acts at ({x:.1f}, {y:.1f}) mm: give its file this centre of mass. "
            f"{results.misplaced} The gap at the end of the pushes is {gap:.2f} mm (median). "
            "The parameters ring to quatrefoil_y shape the logarithm of the pressure."
        )
        return [Section("Parameters", text, rows)]


fit_object = call_of(FitObject)
