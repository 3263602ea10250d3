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

An ellipsoid limit surface is one point of the ground more, whose "sliding" is (v_x, v_y, c omega).
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

_ARM = 0.05  # [m] length scale of rotations
_SLIP = 1e-3  # slip, as a share of a step, above which friction is dry
_SINK = 1e-4  # penetration of a finger under mu m g, as a share of a step
_BALANCED = 1e-5  # [mu m g] tolerance of the force balance
_MAX_ITERATIONS = 60  # of Newton's method
_STEP_SIZES = 0.3 ** np.arange(6)  # of the line search
_NEAR = 0.1  # gap, in steps, below which a contact may close
_SLIP_FACTORS = (100.0, 10.0, 1.0)  # factors of the slip for a start with smoother friction


class Ground(NamedTuple):
    """Support of objects (B,): S points, or an ellipsoid at the centre of mass."""

    at: np.ndarray  # (B, S, 2) [m] body frame, from the centre of mass
    weight: np.ndarray  # (B, S) [1] stiffness of the points, which share the load like springs
    arm: np.ndarray  # (B,) [m] c of an ellipsoid; 0 of points
    shift: np.ndarray  # (B,) [m] shift of the load by a push of mu m g: mu times its height


class Slid(NamedTuple):
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
    ways: np.ndarray,
    pose: np.ndarray,
    friction: np.ndarray,
) -> Slid:
    """Push objects of one outline along paths of fingers.

    Args:
      outline: corners (N, 2) [m] of a convex polygon, counter-clockwise, body frame.
      com: centre of mass (2,) [m], body frame.
      ground: support of the objects.
      ways: paths of F fingers (T + 1, B, F, 2) [m], world; a missing finger is far away.
      pose: of the body frame at the start (B, 3) [m, m, rad], world.
      friction: between object and fingers (B,) [1].
    """
    pose = np.array(pose, float)
    twist, force = np.zeros_like(pose), np.zeros((len(pose), 2))
    poses, forces = [pose], []
    for start, end in itertools.pairwise(ways):
        displacement = end - start
        length = np.maximum(np.linalg.norm(displacement, axis=-1).max(axis=1), 1e-9)
        fingers = start, displacement, length
        step, normal, tangent = _step(outline, com, ground, fingers, pose, force, friction)
        twist = _solve(step, twist)
        pushing, rubbing = _forces(step, twist)
        force = np.sum(pushing[..., None] * normal + rubbing[..., None] * tangent, axis=1)
        middle = pose[:, :2] + turned(pose[:, 2], com) + length[:, None] * twist[:, :2]
        yaw = pose[:, 2] + length * twist[:, 2] / _ARM
        pose = np.column_stack([middle - turned(yaw, com), yaw])
        poses.append(pose)
        forces.append(force)
    return Slid(np.stack(poses), np.stack(forces))


def turned(yaw: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return vectors (..., 2) rotated by yaw (...) [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y = vector[..., 0], vector[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def nearest(outline: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return signed distances (...) [m] of points (..., 2) from a convex polygon, and normals.

    Distances are negative inside; the normals (..., 2) point outward.
    """
    along = np.roll(outline, -1, axis=0) - outline
    length = np.linalg.norm(along, axis=1)
    unit = along / length[:, None]
    out = np.stack([unit[:, 1], -unit[:, 0]], axis=1)
    from_corner = point[..., None, :] - outline  # (..., N, 2)
    beyond = np.sum(from_corner * out, axis=-1)
    side = np.argmax(beyond, axis=-1)
    far = np.take_along_axis(beyond, side[..., None], -1)[..., 0]
    position = np.clip(np.sum(from_corner * unit, axis=-1), 0, length)
    off = from_corner - position[..., None] * unit
    distance = np.linalg.norm(off, axis=-1)
    index = np.argmin(distance, axis=-1)[..., None]
    close = np.take_along_axis(distance, index, -1)[..., 0]
    direction = np.take_along_axis(off, index[..., None], -2)[..., 0, :]
    corner = (far > 0) & (close > far * (1 + 1e-9)) & (close > 1e-9)
    normal = np.where(corner[..., None], direction / np.maximum(close, 1e-12)[..., None], out[side])
    return np.where(corner, close, far), normal


def supported_load(at: np.ndarray, weight: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return loads (B, S) [1] of springs at (B, S, 2) that only push.

    Their sum is 1 and their centre is at (B, 2) [m]. If this is impossible, as for an object that
    tips over, their centre is the nearest possible one in the least-squares sense.
    """
    rows = np.concatenate([np.ones((*at.shape[:2], 1)), at / _ARM], axis=-1)
    required = np.column_stack([np.ones(len(at)), centre / _ARM])
    bears = weight > 0
    load = weight / weight.sum(axis=1, keepdims=True)
    for _ in range(at.shape[1]):
        weighted = rows * (weight * bears)[..., None]
        plane = np.linalg.pinv(weighted.swapaxes(1, 2) @ rows, rcond=1e-9) @ required[..., None]
        load = (weighted @ plane)[..., 0]
        if not np.any(load < 0):
            break
        bears &= load >= 0
    load = np.maximum(load, 0)
    return load / load.sum(axis=1, keepdims=True)


def _step(
    outline: np.ndarray,
    com: np.ndarray,
    ground: Ground,
    fingers: tuple[np.ndarray, np.ndarray, np.ndarray],
    pose: np.ndarray,
    force: np.ndarray,
    friction: np.ndarray,
) -> tuple[_Step, np.ndarray, np.ndarray]:
    """Return the problem of one step, and normals (B, F, 2) towards the objects and tangents."""
    finger, displacement, length = fingers
    yaw, scale = pose[:, 2], length[:, None]
    at = turned(yaw[:, None], ground.at)
    zero, ones = np.zeros(at.shape[:2]), np.ones(at.shape[:2])
    arm = np.broadcast_to(ground.arm[:, None], at.shape[:2])
    rows = [
        [ones, zero, -at[..., 1] / _ARM], [zero, ones, at[..., 0] / _ARM], [zero, zero, arm / _ARM]
    ]  # fmt: skip
    slide = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    finger_in_body = turned(-yaw[:, None], finger - pose[:, None, :2])
    gap, outward = nearest(outline, finger_in_body)
    normal = -turned(yaw[:, None], outward)
    tangent = np.stack([-normal[..., 1], normal[..., 0]], axis=-1)
    r = finger + gap[..., None] * normal - pose[:, None, :2] - turned(yaw, com)[:, None]

    def row(direction: np.ndarray) -> np.ndarray:
        moment = r[..., 0] * direction[..., 1] - r[..., 1] * direction[..., 0]
        return np.concatenate([direction, moment[..., None] / _ARM], axis=-1)

    centre = ground.shift[:, None] * force
    step = _Step(
        slide,
        supported_load(at, ground.weight, centre) if at.shape[1] > 1 else ones,
        row(normal),
        row(tangent),
        np.sum(displacement * normal, axis=-1) / scale,
        np.sum(displacement * tangent, axis=-1) / scale,
        gap / scale,
        friction[:, None],
    )
    return step, normal, tangent


# --- the convex problem ---------------------------------------------------------------------


def _contact(step: _Step, twist: np.ndarray, slip: float) -> tuple[np.ndarray, ...]:
    """Return gap, slip and smoothed slip (B, F), in units of the step length."""
    v_t = np.einsum("bfi,bi->bf", step.a_t, twist) - step.d_t
    size = np.sqrt(v_t * v_t + slip * slip)
    v_n = np.einsum("bfi,bi->bf", step.a_n, twist) - step.d_n
    return step.gap + v_n - step.friction * (size - slip), v_t, size


def _forces(step: _Step, twist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return normal and friction forces (B, F) [mu m g] of the fingers on the objects."""
    room, v_t, size = _contact(step, twist, _SLIP)
    pushing = np.maximum(-room, 0.0) / _SINK
    return pushing, -step.friction * pushing * v_t / size


def _value(step: _Step, twist: np.ndarray, slip: float) -> np.ndarray:
    slid = np.einsum("bsij,bj->bsi", step.slide, twist)
    size = np.sqrt(np.sum(slid * slid, axis=-1) + slip * slip)
    inside = np.maximum(-_contact(step, twist, slip)[0], 0.0)
    return np.sum(step.load * (size - slip), 1) + np.sum(inside * inside, 1) / (2 * _SINK)


def _derivatives(
    step: _Step, twist: np.ndarray, slip: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return gradient (B, 3), Hessian (B, 3, 3), and the addition for an upper bound of it."""
    slid = np.einsum("bsij,bj->bsi", step.slide, twist)
    size = np.sqrt(np.sum(slid * slid, axis=-1) + slip * slip)
    per = step.load / size
    pull = np.einsum("bsi,bsij->bsj", slid / size[..., None], step.slide)
    gradient = np.einsum("bs,bsj->bj", step.load, pull)
    turning = (np.sqrt(per)[..., None, None] * step.slide).reshape(len(twist), -1, 3)
    along = np.sqrt(per)[..., None] * pull
    less = along.swapaxes(1, 2) @ along
    hessian = turning.swapaxes(1, 2) @ turning - less
    room, v_t, round_ = _contact(step, twist, slip)
    pushing = np.maximum(-room, 0.0) / _SINK
    b = step.a_n - (step.friction * v_t / round_)[..., None] * step.a_t
    gradient -= np.einsum("bf,bfj->bj", pushing, b)
    wall = b[..., :, None] * b[..., None, :] / _SINK
    hessian += np.sum((room < 0)[..., None, None] * wall, axis=1)
    # contacts that may close in the step
    addition = less + np.sum(((room >= 0) & (room < _NEAR))[..., None, None] * wall, axis=1)
    bend = pushing * step.friction * slip**2 / round_**3
    bent = bend[..., None, None] * step.a_t[..., :, None] * step.a_t[..., None, :]
    hessian += np.sum(bent, axis=1)
    return gradient, hessian + 1e-7 * np.eye(3), addition


def _solve(step: _Step, twist: np.ndarray) -> np.ndarray:
    """Return the twists (B, 3) of least power, by Newton's method with a line search."""
    rest = _value(step, 0 * twist, _SLIP) <= _value(step, twist, _SLIP)
    twists = np.where(rest[:, None], 0.0, twist)
    rows = np.arange(len(twist))
    for wide in (1.0, *_SLIP_FACTORS):  # the first suffices with a good guess
        rows = _newton(step, twists, rows, wide * _SLIP)
        if not rows.size:
            break
    return twists


def _newton(step: _Step, twists: np.ndarray, rows: np.ndarray, slip: float) -> np.ndarray:
    """Improve the twists of some rows in place; return the unsolved rows."""
    for _ in range(_MAX_ITERATIONS if slip == _SLIP else 10):
        part, twist = step.select(rows), twists[rows]
        gradient, hessian, addition = _derivatives(part, twist, slip)
        if slip == _SLIP:
            unsolved = np.abs(gradient).max(axis=1) > _BALANCED
            rows = rows[unsolved]
            if not rows.size:
                return rows
            part, twist = part.select(unsolved), twist[unsolved]
            gradient, hessian, addition = gradient[unsolved], hessian[unsolved], addition[unsolved]
        # Newton's step is fast near the solution. Where friction is nearly constant along it, the
        # step of an upper bound of the Hessian is safe.
        current, best = _value(part, twist, slip), twist
        least = current.copy()
        changes = [-np.linalg.solve(one, gradient[..., None])[..., 0]
                   for one in (hessian, hessian + addition)]  # fmt: skip
        for size in _STEP_SIZES:
            for change in changes:
                tried = twist + size * change
                value = _value(part, tried, slip)
                better = value < least
                best = np.where(better[:, None], tried, best)
                least = np.where(better, value, least)
            if (least < current).all():
                break
        twists[rows] = best
        if (least >= current).all():
            break
    return rows
