"""Posterior of the coordinates of a world by least squares on replayed windows of its logs.

A window of some seconds starts from the measured poses of base and object, and its base follows the
measured path. Residuals compare the simulated and the measured object. Windows are short because
contact amplifies errors. The Levenberg-Marquardt method, with exact derivatives of the engine,
minimises the residuals from several worlds of the domain. The posterior is Laplace's approximation
at all minima.

The residuals of a channel have Student's t distribution, whose scale is estimated, and a part that
is common to all windows.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.special import softmax

from rps_jax import Domain, Setting, Twist
from rps_jax.geometry import planar
from rps_jax.geometry.solid import rotate
from rps_jax.physics import ControlPeriod, Motion, Physics, get_engine
from rps_jax.trials.trial import object_pose
from rps_jax.world import points
from rps_jax.world.domain import quantities_of
from rps_jax.world.points import Points

WINDOW, _SETTLING = 2.0, 0.4  # [s] of a window, and of its start, in which contacts settle
LEAST_WINDOWS = 5  # of a fit
STARTS, _ITERATIONS = 6, 15  # of the minimisation, for each object
_STEP = 1e-3  # of the central differences of constants on the host
_FREEDOM = 4.0  # degrees of freedom of Student's t distribution
_SMALL = np.array([1e-4, 1e-4, 3e-4, 1e-4, 1e-4, 3e-4, 0.1, 0.1])  # least scale of each channel
# Share of the information of independent residuals that a fit uses. Measured inputs have errors, so
# that minima are rough; chosen in worlds for validation, see `sweeps/fit`.
_INFORMATION = 0.07
_PRIOR = 3.0  # precision of a nearly flat density around the middle of the cube
_PROPOSALS = 100_000  # of the sampler, for each minimum
_MAX_COORDINATE = 1 - 1e-6  # greatest coordinate
_LIMITS = (  # of a robot, without which the base follows its measured path
    "v_max",
    "omega_max",
    "lag",
    "acceleration_max",
    "force_max",
    "torque_max",
    "traction",
    "slip",
    "slip_sideways",
    "slip_yaw",
)


def _rows(interval: float) -> tuple[int, int]:
    """Return the number of rows of a window, and of its start."""
    return (rows := round(WINDOW / interval)), round(rows * _SETTLING / WINDOW)


class Windows(NamedTuple):
    """Windows (B,) of logs, in the frame of the base at their start."""

    twists: np.ndarray  # (B, T, 3) [m/s, m/s, rad/s] of the base, in its own frame
    pose: np.ndarray  # (B, 3) [m, m, rad] of the object at the start
    velocity: np.ndarray  # (B, 3)
    # (B, C): the object's pose [m, m, rad] after settling, its change until the end, and, if known,
    # the mean force [N, N]
    result: np.ndarray


class Track(NamedTuple):
    """Paths (T, ...) of one log."""

    base: np.ndarray  # (T, 3) [m, m, rad]
    object: np.ndarray  # (T, 3) [m, m, rad]
    force: np.ndarray | None  # (T, 2) [N] of the object on the base, in its frame
    first: np.ndarray  # (B,) first rows of the windows that are mostly in contact
    interval: float  # [s]

    @classmethod
    def of(cls, log: Any, interval: float, exact: bool, force: bool) -> Track:
        """Return the paths of a log (1, T, ...), smooth ones unless its poses are exact."""
        rows, settling = _rows(interval)
        count = int(log.valid[0].sum())
        fields = log.pose, log.twist, log.object_pose, log.f_robot
        pose, twist, measured, felt = (np.zeros(0) if x is None else x[0, :count] for x in fields)
        touch, starts = log.contact_type[0] > 0, range(0, count - rows, rows - settling)
        first = np.array([i for i in starts if touch[i + settling : i + rows].mean() > 0.5], int)
        if not exact and first.size:

            def corrected(values: np.ndarray, rates: np.ndarray) -> np.ndarray:
                """Return measured values (T, k): the integral of rates, and smooth deviations."""
                path = np.insert(np.cumsum(rates[:-1] * interval, axis=0), 0, 0.0, axis=0)
                time = interval * np.arange(count)
                smooth = [make_smoothing_spline(time, x)(time) for x in (values - path).T]
                return path + np.column_stack(smooth)

            yaw = corrected(pose[:, 2:], twist[:, 2:])
            middle = yaw[:, 0] + np.diff(yaw[:, 0], append=yaw[-1, 0]) / 2
            pose = np.column_stack([corrected(pose[:, :2], rotate(middle, twist[:, :2])), yaw])
            measured = corrected(measured, 0 * measured)
        return cls(pose, measured, felt if force else None, first, interval)

    def windows(self, latency: float) -> Windows:
        """Return the windows if poses of the base are late by `latency` [s]."""
        rows, settling = _rows(self.interval)
        at = self.first[:, None] + np.arange(rows + 1)
        late = np.clip(at + latency / self.interval, 0, len(self.base) - 1.001)
        low, part = late.astype(int), (late % 1)[..., None]
        path = (1 - part) * self.base[low] + part * self.base[low + 1]
        start, middle = path[:, 0], (path[:, 1:, 2] + path[:, :-1, 2]) / 2
        twists = rotate(-middle, np.diff(path, axis=1)) / self.interval
        frames = [rotate(-start[:, 2], self.object[at[:, i]] - start) for i in (0, 1, settling, -1)]
        result = [frames[2], frames[3] - frames[2]]
        if self.force is not None:
            result.append(self.force[at[:, settling + 1 :]].mean(axis=1))
        velocity = (frames[1] - frames[0]) / self.interval
        return Windows(twists, frames[0], velocity, np.concatenate(result, axis=-1))


class Replay(NamedTuple):
    """Least-squares problem of the logs of one world."""

    domain: Domain
    tracks: Sequence[Track]
    setting: Setting
    exact: bool  # poses of the base are not late

    @property
    def num_windows(self) -> int:
        """Number of windows B."""
        return sum(track.first.size for track in self.tracks)

    @property
    def active(self) -> list[int]:
        """Columns (p,) of the cube on which the windows depend."""
        names = {*quantities_of("object"), "com_bearing", *["pose_latency"] * (not self.exact)}
        names |= {*points.names(self.domain, "shape")} - {"sides", "feet_number"}
        return [i for i, name in enumerate(points.names(self.domain)) if name in names]

    @property
    def periodic(self) -> np.ndarray:
        """Whether each active coordinate (p,) is an angle."""
        return np.array(points.names(self.domain))[self.active] == "com_bearing"

    def minima(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return minima (m, q) from the best of the points (n, q) of each object.

        Also returns their residuals (m, B, C), and the derivatives (m, B, C, p) of these.
        """
        objects = self.domain.object_of(points.cases(self.domain, Points(u), np.arange(len(u))))
        parts = [self._minimise(u[objects == i]) for i in np.unique(objects)]
        u, r, j = map(np.concatenate, zip(*parts, strict=True))
        return u, r, j

    def _minimise(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the minima from the best of the points (n, q) of one object."""
        chunks = np.resize(u, (-(-len(u) // STARTS), STARTS, u.shape[1]))
        costs = np.concatenate([cost(self.derivatives(chunk)[0]) for chunk in chunks])
        u = chunks.reshape(-1, u.shape[1])[np.argsort(costs)[:STARTS]]
        *_, last = itertools.islice(self.descend(u), _ITERATIONS + 1)
        return last

    def descend(self, u: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield the points (n, q) of iterations, their residuals, and the derivatives of these."""
        u, (r, j) = u.copy(), self.derivatives(u)
        damping = np.full((len(u), 1), 1e-2)
        while True:
            yield u, r, j
            at, (g, h) = u[:, self.active], _expansion(r, j)
            fixed = ~self.periodic & (((at <= 0) & (g > 0)) | ((at >= _MAX_COORDINATE) & (g < 0)))
            diagonal = damping * (1 + np.diagonal(h, axis1=1, axis2=2)) + 1e12 * fixed
            step = np.linalg.solve(h + diagonal[..., None] * np.eye(len(self.active)), g[..., None])
            at, new = at - np.clip(step[..., 0], -0.3, 0.3), u.copy()
            new[:, self.active] = np.where(self.periodic, at % 1, np.clip(at, 0, _MAX_COORDINATE))
            r_new, j_new = self.derivatives(new)
            better = cost(r_new) < cost(r)
            for old, changed in ((u, new), (r, r_new), (j, j_new)):
                old[better] = changed[better]
            damping *= np.where(better, 0.2, 4.0)[:, None]

    def derivatives(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals (n, B, C) at points of one object, and derivatives (n, B, C, p).

        Residuals have a part that is common to all windows, as large as the rest of one window; a
        linear map makes them independent.
        """
        steps = np.zeros((1 + 2 * len(self.active), 1, u.shape[1]))
        for i, column in enumerate(self.active):
            steps[1 + 2 * i : 3 + 2 * i, 0, column] = _STEP, -_STEP
        moved = (u + steps).reshape(-1, u.shape[1])
        drawn = points.draw(self.domain, 0, Points(moved), np.arange(len(moved)))
        robots = dataclasses.replace(drawn.robot, **dict.fromkeys(_LIMITS))
        inputs = drawn.inputs(self.domain, self.setting.physics)._replace(robots=robots)
        stage, fields = get_engine(self.setting.engine).stage(inputs)
        latency = np.zeros(len(moved)) if self.exact else drawn.values["pose_latency"]
        windows = [track.windows(x) for x in latency for track in self.tracks]
        constants = fields, drawn.solid.height
        constants = jax.tree.map(lambda x: np.repeat(x, self.num_windows, axis=0), constants)
        inputs = (*constants, jax.tree.map(lambda *x: np.concatenate(x), *windows))
        inputs = jax.tree.map(lambda x: x.reshape(len(steps), -1, *x.shape[1:]), inputs)
        middle = jax.tree.map(lambda x: np.float32(x[0]), inputs)
        slopes = jax.tree.map(lambda x: np.float32((x[1::2] - x[2::2]) / (2 * _STEP)), inputs)
        r, j = _linearised(stage, middle, slopes, self.setting.physics)
        both = np.concatenate([r[None], j]).reshape(len(j) + 1, len(u), self.num_windows, -1)
        both = np.nan_to_num(np.asarray(both, float), nan=1.0)
        both -= (1 - (1 + self.num_windows) ** -0.5) * both.mean(axis=2, keepdims=True)
        return both[0], np.moveaxis(both[1:], 0, -1)


@partial(jax.jit, static_argnames="physics")
def _linearised(
    stage: Any, inputs: Any, slopes: Any, physics: Physics
) -> tuple[jax.Array, jax.Array]:
    """Return residuals (n, C), and their derivatives (p, n, C) along slopes (p, n, ...)."""
    replay = partial(_replay, stage, physics=physics)
    return replay(inputs), jax.vmap(lambda x: jax.jvp(replay, (inputs,), (x,))[1])(slopes)


def _replay(stage: Any, inputs: Any, physics: Physics) -> jax.Array:
    """Return the residuals (n, C) of windows, of worlds with these fields and heights."""
    fields, height, windows = inputs
    zero, force = jnp.zeros_like(height), windows.result.shape[-1] > 6
    (x, y, yaw), (v_x, v_y, w) = windows.pose.T, windows.velocity.T
    turn = jnp.cos(yaw / 2), zero, zero, jnp.sin(yaw / 2)
    qpos = jnp.stack([zero, zero, zero, x, y, height / 2, *turn], axis=-1)
    qvel = [*windows.twists[:, 0].T, v_x, v_y, zero, zero, zero, w]
    start = Motion(qpos, jnp.stack(qvel, axis=-1), jnp.zeros_like(qpos[:, :9]))
    rows = windows.twists.shape[1]
    repeats = round(WINDOW / physics.control_period / rows)

    def control_step(motion: Motion, twist: jax.Array) -> tuple[Motion, Any]:
        driven = stage.drive(fields, motion, ControlPeriod(Twist(*twist.T), physics, None, force))
        position, yaw = jax.vmap(object_pose)(driven.motion.qpos)
        pose = jnp.concatenate([position, yaw[:, None]], axis=-1)
        return driven.motion, (pose, driven.force)

    twists = jnp.repeat(jnp.swapaxes(windows.twists, 0, 1), repeats, axis=0)
    poses, forces = jax.lax.scan(control_step, start, twists)[1]
    settled = repeats * round(rows * _SETTLING / WINDOW)
    result = [poses[settled - 1], poses[-1] - poses[settled - 1]]
    if force:
        result.append(forces[settled:, :, :2].mean(axis=0))
    r = jnp.concatenate(result, axis=-1) - windows.result
    return jnp.where(np.isin(np.arange(r.shape[-1]), (2, 5)), planar.wrap(r), r)


def _scale(r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return squared scales (m, 1, C) of residuals (m, B, C), and the weights of these."""
    scale, weight = np.zeros(1), np.ones_like(r)
    for _ in range(20):
        scale = np.mean(weight * r * r, axis=1, keepdims=True) + _SMALL[: r.shape[-1]] ** 2
        weight = (_FREEDOM + 1) / (_FREEDOM + r * r / scale)
    return scale, weight


def cost(r: np.ndarray) -> np.ndarray:
    """Return minus the logarithms of the likelihood (m,) of residuals (m, B, C)."""
    scale, _ = _scale(r)
    tails = (_FREEDOM + 1) / 2 * np.log1p(r * r / scale / _FREEDOM)
    return np.nan_to_num(np.sum(np.log(scale) / 2 + tails, axis=(1, 2)), nan=np.inf)


def _expansion(r: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return gradients (m, p) and Gauss-Newton matrices (m, p, p) of the cost."""
    scale, weight = _scale(r)
    weighted = j * (weight / scale)[..., None]
    return np.einsum("mbcp,mbc->mp", weighted, r), np.einsum("mbcp,mbcq->mpq", weighted, j)


def sample(
    replay: Replay, u: np.ndarray, r: np.ndarray, j: np.ndarray, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sample points (count, q) from Laplace's approximation at all minima, inside the cube.

    Coordinates on which the windows do not depend are uniform.

    Returns:
      Points, and the eigenvalues (p,) of the information of the windows at the least minimum.
    """
    rng, active = np.random.default_rng(seed), replay.active
    information = _INFORMATION * np.nan_to_num(_expansion(r, j)[1])
    precision = information + _PRIOR * np.eye(len(active))
    weight = softmax(-_INFORMATION * cost(r) - np.linalg.slogdet(precision)[1] / 2)
    samples = []
    for at, h, size in zip(u, precision, rng.multinomial(count, weight), strict=True):
        free = rng.random((size, len(at)))
        choices = [i for i, x in enumerate(points.coordinates(replay.domain)) if x.kind == "choice"]
        free[:, choices] = at[choices]
        mean = at[active] + np.linalg.solve(h, _PRIOR * (0.5 - at[active]))
        values, vectors = np.linalg.eigh(h)
        normal = rng.standard_normal((_PROPOSALS * (size > 0), len(h)))
        x = mean + (normal / np.sqrt(np.maximum(values, _PRIOR))) @ vectors.T
        inside = x[(replay.periodic | ((x >= 0) & (x < 1))).all(axis=1)]
        inside = inside if len(inside) else np.clip(x, 0, _MAX_COORDINATE)
        free[:, active] = inside[rng.integers(max(1, len(inside)), size=size)] % 1
        samples.append(free)
    least = int(np.argmin(cost(r)))
    return np.concatenate(samples), np.linalg.eigvalsh(information[least])[::-1]
