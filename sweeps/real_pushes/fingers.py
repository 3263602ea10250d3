"""Quasi-static pushes of a rigid object by fingers over dry ground, many pushes at once.

The push is slow enough to neglect inertia, so the motion depends only on the paths of the fingers,
which are points. In each step the twist V of the object minimises

    sum over points of the ground of N_i |v_i| + sum over fingers of P(gap + v_n - mu_c |v_t|),

the power that friction with the ground takes (N_i: the loads, their sum 1; v_i: the sliding) under
contacts that only push: P is the potential of a very stiff spring, v_n and v_t the velocities of
the object's point relative to the finger. Where the derivative is zero, friction balances contact
forces within Coulomb's cones (Anitescu 2006, whose cones hold a contact that slides mu_c |v_t| of a
step apart, here below 0.1 mm). Forces are in units of mu m g, so neither mass nor friction with the
ground matter, but that a push at a height z moves the load: by mu z in the direction of the push.

An ellipsoid limit surface is a single point whose "sliding" is (v_x, v_y, c omega). The engine
`quasistatic` has this limit surface alone: its potential is quadratic, and differentiable.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from rps_jax import InputError
from rps_jax.geometry.solid import mean_arm, rotate, supported_load

SLIP = 1e-3  # slip, as a share of a step, above which friction is dry
SINK = 1e-4  # penetration of a finger under mu m g, as a share of a step
_BALANCED = 1e-5  # [mu m g] tolerance of the force balance
_MAX_ITERATIONS = 500  # of Newton's method; a few suffice for most steps
_STEP_SIZES = 0.1 ** np.arange(10)  # of the line search
_NEAR = 0.1  # gap, in steps, below which a contact may close


class Ground(NamedTuple):
    """Support of objects (B,): S points, or an ellipsoid at the centre of mass."""

    at: np.ndarray  # (B, S, 2) [m] body frame, from the centre of mass
    weight: np.ndarray  # (B, S) [1] stiffness of the points, which share the load like springs
    arm: np.ndarray  # (B,) [m] c of an ellipsoid; 0 of points
    shift: np.ndarray  # (B,) [m] shift of the load by a push of mu m g: mu times its height

    def ellipsoid(self) -> Ground:
        """Return the ellipsoid whose c is the mean distance of the load from its centre."""
        zero, arm = np.zeros_like(self.at[:, :1]), mean_arm(self.at, self.weight)
        return Ground(zero, zero[..., 0] + 1, arm, 0 * arm)


class Pushed(NamedTuple):
    """Pushes (B,) in T steps."""

    pose: np.ndarray  # (T + 1, B, 3) [m, m, rad] of the body frame
    force: np.ndarray  # (T, B, 2) [mu m g] of the fingers on the object, world axes


class _Step(NamedTuple):
    """Problem for the twists of objects in one step, in units of the step length."""

    slide: np.ndarray  # (B, S, 3, 3) twist to sliding
    load: np.ndarray  # (B, S)
    a_n: np.ndarray  # (B, F, 3) twist to speed along the normals
    a_t: np.ndarray  # (B, F, 3)
    d_n: np.ndarray  # (B, F) displacement of the fingers along the normals
    d_t: np.ndarray  # (B, F)
    gap: np.ndarray  # (B, F)
    friction: np.ndarray  # (B, 1)

    def select(self, rows: np.ndarray) -> _Step:
        """Return the rows of some objects."""
        return _Step(*(leaf[rows] for leaf in self))


def push(
    outline: np.ndarray,
    com: np.ndarray,
    ground: Ground,
    paths: np.ndarray,
    pose: np.ndarray,
    friction: np.ndarray,
) -> Pushed:
    """Push objects of one outline along paths of fingers.

    Args:
      outline: corners (N, 2) [m] of a convex polygon, counter-clockwise, body frame.
      com: centre of mass (2,) or (B, 2) [m], body frame.
      ground: support of the objects.
      paths: paths of F fingers (T + 1, B, F, 2) [m], world; a missing finger is far away.
      pose: of the body frame at the start (B, 3) [m, m, rad], world.
      friction: between object and fingers (B,) [1].
    """
    pose = np.array(pose, float)
    unit = np.linalg.norm(outline - com[..., None, :], axis=-1).mean() / 2  # [m] of rotations
    twist, force = np.zeros_like(pose), np.zeros((len(pose), 2))
    poses, forces = [pose], []
    for start, end in itertools.pairwise(paths):
        displacement = end - start
        length = np.maximum(np.linalg.norm(displacement, axis=-1).max(axis=1), 1e-8 * unit)
        yaw, centre = pose[:, 2], pose[:, :2] + rotate(pose[:, 2], com)
        at = rotate(yaw[:, None], ground.at) / unit
        slide = np.zeros((*at.shape[:2], 3, 3))
        slide[..., 0, 0] = slide[..., 1, 1] = 1.0
        slide[..., 0, 2], slide[..., 1, 2] = -at[..., 1], at[..., 0]
        slide[..., 2, 2] = ground.arm[:, None] / unit
        gap, outward = nearest(outline, rotate(-yaw[:, None], start - pose[:, None, :2]))
        normal = -rotate(yaw[:, None], outward)
        tangent = np.stack([-normal[..., 1], normal[..., 0]], axis=-1)
        r = (start + gap[..., None] * normal - centre[:, None]) / unit
        moved = displacement / length[:, None, None]
        step = _Step(
            slide,
            supported_load(ground.at, ground.weight, rotate(-yaw, ground.shift[:, None] * force)),
            _with_moment(normal, r),
            _with_moment(tangent, r),
            np.sum(moved * normal, axis=-1),
            np.sum(moved * tangent, axis=-1),
            gap / length[:, None],
            friction[:, None],
        )
        twist = _solve(step, twist)
        pushing, rubbing = _forces(step, twist)
        force = np.sum(pushing[..., None] * normal + rubbing[..., None] * tangent, axis=1)
        yaw = yaw + length * twist[:, 2] / unit
        centre = centre + length[:, None] * twist[:, :2]
        pose = np.column_stack([centre - rotate(yaw, com), yaw])
        poses.append(pose)
        forces.append(force)
    return Pushed(np.stack(poses), np.stack(forces))


def nearest(outline: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return signed distances (...) [m] of points (..., 2) from a convex polygon, and normals.

    Distances are negative inside; the normals (..., 2) point outward.
    """
    along = np.roll(outline, -1, axis=0) - outline
    length = np.linalg.norm(along, axis=1)
    unit = along / length[:, None]
    outward = np.stack([unit[:, 1], -unit[:, 0]], axis=1)
    offset = point[..., None, :] - outline  # (..., N, 2)
    position = np.sum(offset * unit, axis=-1)
    away = offset - np.clip(position, 0, length)[..., None] * unit
    distance = np.linalg.norm(away, axis=-1)
    side = np.argmin(distance, axis=-1)[..., None]
    gap, position = (np.take_along_axis(x, side, -1)[..., 0] for x in (distance, position))
    outside = np.any(np.sum(offset * outward, axis=-1) > 0, axis=-1)
    at_corner = outside & (gap > 1e-9) & ((position < 0) | (position > length[side[..., 0]]))
    from_corner = np.take_along_axis(away, side[..., None], -2)[..., 0, :]
    from_corner = from_corner / np.maximum(gap, 1e-9)[..., None]
    normal = np.where(at_corner[..., None], from_corner, outward[side[..., 0]])
    return np.where(outside, gap, -gap), normal


def _with_moment(direction: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return directions (..., 2) and their moments about r, (..., 3)."""
    moment = r[..., 0] * direction[..., 1] - r[..., 1] * direction[..., 0]
    return np.concatenate([direction, moment[..., None]], axis=-1)


# --- the convex problem ---------------------------------------------------------------------


def _slide(step: _Step, twist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return sliding (..., B, S, 3) on the ground, and its smoothed size."""
    slid = np.einsum("bsij,...bj->...bsi", step.slide, twist)
    return slid, np.sqrt(np.sum(slid * slid, axis=-1) + SLIP * SLIP)


def _contact(step: _Step, twist: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return gap, slip and smoothed slip (..., B, F), in units of the step length."""
    v_t = np.einsum("bfi,...bi->...bf", step.a_t, twist) - step.d_t
    size = np.sqrt(v_t * v_t + SLIP * SLIP)
    v_n = np.einsum("bfi,...bi->...bf", step.a_n, twist) - step.d_n
    return step.gap + v_n - step.friction * (size - SLIP), v_t, size


def _forces(step: _Step, twist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return normal and friction forces (B, F) [mu m g] of the fingers on the objects."""
    gap, v_t, size = _contact(step, twist)
    pushing = np.maximum(-gap, 0.0) / SINK
    return pushing, -step.friction * pushing * v_t / size


def _power(step: _Step, twist: np.ndarray) -> np.ndarray:
    """Return the power (..., B) [mu m g] of friction and penetration."""
    inside = np.maximum(-_contact(step, twist)[0], 0.0)
    dissipated = np.sum(step.load * (_slide(step, twist)[1] - SLIP), axis=-1)
    return dissipated + np.sum(inside * inside, axis=-1) / (2 * SINK)


def _derivatives(step: _Step, twist: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return gradient (B, 3), Hessian (B, 3, 3), and the addition for an upper bound of it."""
    slid, size = _slide(step, twist)
    per, rows = step.load / size, step.slide.reshape(len(twist), -1, 3)
    pull = np.einsum("bsi,bsij->bsj", slid / size[..., None], step.slide)
    less = _squares(per, pull)
    gap, v_t, size = _contact(step, twist)
    pushing = np.maximum(-gap, 0.0) / SINK
    push = step.a_n - (step.friction * v_t / size)[..., None] * step.a_t
    gradient = np.einsum("bs,bsj->bj", step.load, pull) - np.einsum("bf,bfj->bj", pushing, push)
    hessian = _squares(np.repeat(per, 3, axis=1), rows) - less + 1e-7 * np.eye(3)
    hessian += _squares((gap < 0) / SINK, push)
    hessian += _squares(pushing * step.friction * SLIP**2 / size**3, step.a_t)
    # contacts that may close in the step
    return gradient, hessian, less + _squares(((gap >= 0) & (gap < _NEAR)) / SINK, push)


def _squares(weight: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return sums (B, 3, 3) of weighted outer squares of rows (B, K, 3)."""
    return (weight[..., None] * rows).swapaxes(1, 2) @ rows


def _solve(step: _Step, twist: np.ndarray) -> np.ndarray:
    """Return the twists (B, 3) of least power, by Newton's method with a line search."""
    twists, rows = twist.copy(), np.arange(len(twist))
    for _ in range(_MAX_ITERATIONS):
        derivatives = _derivatives(step.select(rows), twists[rows])
        unsolved = np.abs(derivatives[0]).max(axis=1) > _BALANCED
        rows = rows[unsolved]
        if not rows.size:
            return twists
        # Newton's step is fast near the solution. Where friction is nearly constant along it, the
        # step of an upper bound of the Hessian is safe.
        gradient, hessian, addition = (leaf[unsolved] for leaf in derivatives)
        matrices = np.stack([hessian, hessian + addition])
        changes = -np.linalg.solve(matrices, gradient[..., None])[..., 0]
        part, twist = step.select(rows), twists[rows]
        tried = twist + (_STEP_SIZES[:, None, None, None] * changes).reshape(-1, *twist.shape)
        power = _power(part, tried)
        best = power.argmin(axis=0), np.arange(len(rows))
        better = power[best] <= _power(part, twist)
        twists[rows] = np.where(better[:, None], tried[best], twist)
    raise InputError(
        f"{rows.size} of {len(twists)} pushes have a step whose forces do not balance, as between "
        "fingers that squeeze the object: change the path, or a friction slightly."
    )
