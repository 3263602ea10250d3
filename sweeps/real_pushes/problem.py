"""Real pushes of one object as a least-squares problem, with exact derivatives.

The object is a rigid body on its feet, pushed quasi-statically by `rps_jax.engines.fingers`. Each
step of a push solves a convex problem. Its derivative is that of the implicit function theorem, and
a scan carries it from step to step.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from rps_jax.geometry import planar
from rps_jax.geometry.solid import GRAVITY, rotate, supported_load, wrap
from sweeps.real_pushes import fingers, pushes
from sweeps.real_pushes.fingers import Ground, Pushed
from sweeps.real_pushes.pushes import COM, OUTLINE

QUANTITIES = ("friction object-finger", "friction object-ground", "pressure x", "pressure y")
# Prior: uniform between [1, 1, m, m]. The last two move the centre of pressure off the centroid.
LOW, HIGH = np.array([[0.05, 0.15, -0.01, -0.01], [1.0, 0.60, 0.01, 0.01]])
_SCALE = np.array([1e-3, 1e-3, np.deg2rad(1.0), 0.3, 0.3])  # [m, m, rad, N, N] of the residuals
_STEPS = 30  # of the path of a push


class Cell(NamedTuple):
    """Pushes (n,) on one support."""

    table: pd.DataFrame
    feet: np.ndarray  # (S, 2) [m] body frame
    paths: np.ndarray  # (T + 1, n, F, 2) [m] of the fingers, world
    measured: np.ndarray  # (n, 5) centroid [m, m], heading [rad], force [N, N] or NaN

    @classmethod
    def of(cls, table: pd.DataFrame) -> Cell:
        """Return the pushes of a table with one support."""
        force = table.reindex(columns=["force_wx", "force_wy"]).to_numpy(float)
        outcome = np.column_stack([_centred(pushes.measured(table)), force])
        feet = pushes.feet_of(str(table.support.iloc[0]))
        return cls(table, feet, pushes.finger_paths(table, _STEPS), outcome)

    def simulate(self, theta: np.ndarray) -> tuple[np.ndarray, Pushed]:
        """Return outcomes (k, n, 5) of worlds (k, 4), and the motions of all k n pushes."""
        worlds, count = len(theta), len(self.table)
        rows = np.repeat(theta, count, axis=0)
        com = COM + rows[:, 2:]
        at, zero = self.feet - com[:, None], np.zeros(len(rows))
        ground = Ground(at, np.ones(at.shape[:2]), zero, rows[:, 1] * pushes.PUSHED_AT)
        start = np.tile(pushes.initial_poses(self.table), (worlds, 1))
        paths = np.tile(self.paths, (1, worlds, 1, 1))
        motion = fingers.push(OUTLINE, com, ground, paths, start, rows[:, 0])
        force = rows[:, 1:2] * pushes.MASS * GRAVITY * motion.force[_STEPS // 2 :].mean(axis=0)
        outcome = np.column_stack([_centred(motion.pose[-1]), force])
        return outcome.reshape(worlds, count, 5), motion

    def residuals(self, outcome: np.ndarray) -> np.ndarray:
        """Return scaled residuals (..., n, 5) of outcomes; 0 where nothing was measured."""
        r = outcome - self.measured
        r[..., 2] = wrap(r[..., 2])
        return np.nan_to_num(r / _SCALE)

    def derivatives(self, theta: np.ndarray, motion: Pushed | None = None) -> np.ndarray:
        """Return derivatives (n, 5, 4) of the scaled residuals in one world (4,)."""
        pose, forces = motion or self.simulate(theta[None])[1]
        com, yaw, start = COM + theta[2:], pose[..., 2:], self.paths[:-1]
        at, unit = self.feet - com, np.linalg.norm(OUTLINE - com, axis=-1).mean() / 2
        centre = pose[..., :2] + rotate(yaw[..., 0], com)
        moved = np.linalg.norm(np.diff(self.paths, axis=0), axis=-1)
        length = np.maximum(moved.max(axis=-1), 1e-8 * unit)[..., None]
        twist = np.diff(np.concatenate([centre, unit * yaw], axis=-1), axis=0) / length
        yaw, force = yaw[:-1, ..., 0], np.concatenate([0 * forces[:1], forces[:-1]])
        point = rotate(-yaw[..., None], start - pose[:-1, :, None, :2])
        gap, outward = fingers.nearest(OUTLINE, point)
        nearest = point - gap[..., None] * outward
        to_corner = np.linalg.norm(nearest[..., None, :] - OUTLINE, axis=-1).min(axis=-1)
        shift = theta[1] * pushes.PUSHED_AT * rotate(-yaw, force).reshape(-1, 2)
        all_at = np.broadcast_to(at, (len(shift), *at.shape))
        load = supported_load(all_at, np.ones(all_at.shape[:2]), shift).reshape(*yaw.shape, -1)
        steps = (
            start,
            self.paths[1:],
            twist,
            length[..., 0],
            nearest,
            outward,
            (gap > 1e-9) & (to_corner < 1e-9),
            load > 0,
        )
        with jax.enable_x64(True):
            by_push = [np.swapaxes(x, 0, 1) for x in steps]
            j = np.array(_jacobians(theta, self.feet, pose[0], by_push))
        return np.where(np.isfinite(self.measured)[..., None], j / _SCALE[:, None], 0.0)


def _centred(pose: np.ndarray) -> np.ndarray:
    """Return poses (n, 3) with the position of the centroid instead of the corner's."""
    return np.column_stack([pose[:, :2] + rotate(pose[:, 2], COM), pose[:, 2]])


@jax.jit
def _jacobians(
    theta: jax.Array, feet: jax.Array, pose: jax.Array, steps: list[jax.Array]
) -> jax.Array:
    """Return derivatives (n, 5, 4) of the outcomes of pushes (n,): see `_outcome`."""
    return jax.vmap(jax.jacfwd(_outcome), (None, None, 0, 0))(theta, feet, pose, steps)


def _outcome(
    theta: jax.Array, feet: jax.Array, pose: jax.Array, steps: list[jax.Array]
) -> jax.Array:
    """Return the outcome (5,) of one push with the motion of `steps`.

    Each step adds a Newton step of zero value to its twist, which has the twist's derivative.
    """
    com = COM + theta[2:]
    unit = jax.lax.stop_gradient(jnp.linalg.norm(OUTLINE - com, axis=-1).mean() / 2)
    scale = jnp.abs(feet - com).max()

    def step(
        state: tuple[jax.Array, jax.Array, jax.Array], inputs: list[jax.Array]
    ) -> tuple[tuple[jax.Array, jax.Array, jax.Array], jax.Array]:
        centre, yaw, force = state
        start, end, twist, length, nearest, outward, corner, bears = inputs
        at = feet - com
        away = planar.rotate(-yaw, start - centre) + com - nearest
        outward = jnp.where(corner[:, None], away, outward)
        outward /= jnp.linalg.norm(outward, axis=-1, keepdims=True)
        gap, normal = jnp.sum(away * outward, axis=-1), -planar.rotate(yaw, outward)
        tangent = jnp.stack([-normal[:, 1], normal[:, 0]], axis=-1)
        r, slide = (start + gap[:, None] * normal - centre) / unit, planar.rotate(yaw, at) / unit
        # the loads of equal springs that only push
        rows = jnp.column_stack([jnp.ones(len(at)), at / scale]) * bears[:, None]
        shift = planar.rotate(-yaw, theta[1] * pushes.PUSHED_AT * force) / scale
        load = rows @ jnp.linalg.pinv(rows.T @ rows) @ jnp.append(1.0, shift)
        load = load / load.sum()

        def velocity(twist: jax.Array, arm: jax.Array) -> jax.Array:
            return twist[:2] + twist[2] * jnp.stack([-arm[:, 1], arm[:, 0]], axis=-1)

        def contact(twist: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            v = velocity(twist, r) - (end - start) / length
            v_n, v_t = jnp.sum(v * normal, axis=-1), jnp.sum(v * tangent, axis=-1)
            size = jnp.sqrt(v_t * v_t + fingers.SLIP**2)
            inside = theta[0] * (size - fingers.SLIP) - v_n - gap / length
            return jnp.maximum(inside, 0.0) / fingers.SINK, v_t, size

        def power(twist: jax.Array) -> jax.Array:
            slid = jnp.sqrt(jnp.sum(velocity(twist, slide) ** 2, axis=-1) + fingers.SLIP**2)
            pushing = contact(twist)[0]
            return load @ slid + fingers.SINK * pushing @ pushing / 2

        hessian = jax.lax.stop_gradient(jax.hessian(power)(twist)) + 1e-7 * jnp.eye(3)
        change = -jnp.linalg.solve(hessian, jax.grad(power)(twist))
        twist = twist + change - jax.lax.stop_gradient(change)
        pushing, v_t, size = contact(twist)
        force = pushing @ normal - (theta[0] * pushing * v_t / size) @ tangent
        return (centre + length * twist[:2], yaw + length * twist[2] / unit, force), force

    first = pose[:2] + planar.rotate(pose[2], jnp.asarray(com)), pose[2], jnp.zeros(2)
    (centre, yaw, _), force = jax.lax.scan(step, first, steps)
    force = theta[1] * pushes.MASS * GRAVITY * force[_STEPS // 2 :].mean(axis=0)
    position = centre + planar.rotate(yaw, jnp.asarray(COM - com))
    return jnp.concatenate([position, yaw[None], force])
