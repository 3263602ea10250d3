"""The rigid limit: slow pushes of a rigid object with dry friction.

An object of weight m g stands on a few points. The flat front of the base pushes it at a height z.
The motion is so slow that inertia is negligible. All results then depend only on the way of the
base: velocities are per metre of this way, and forces are in units of m g.

The loads N_i of the points balance the weight and the moment z F of the push F. Three points
determine them. With four, equal springs do, so that the load is linear in position: the limit of
uniform ground of any stiffness. A point that would have to pull lifts off. Given these loads and
the forces n_c at the contacts with the base, the object's twist V minimises

    sum over points of mu N_i |v_i| + sum over contacts of mu_r n_c |slip_c|,

the power of friction, among all twists without penetration of the base (maximum dissipation, which
is Coulomb's law). Loads and forces depend on V, so the convex problem is solved again until they
converge. Friction is linear up to a share `slip` of the base's speed and dry beyond. A contact
penetrates by `depth` under the whole weight. Both regularisations are negligible.

With the `slip` and `lift` of MuJoCo's ground, these equations describe the effect of its cones.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rps_jax import Robot
from rps_jax.geometry.solid import Solid, rotate

_FAR = 1.0  # [m] gap of an impossible contact
_HALF_WIDTH = Robot().half_width  # [m]
_FACING = 0.5  # cosine of the angle to the base within which its corners may touch a side
_ALPHAS = 0.25 ** np.arange(5)  # steps of a line search
_NEAR = 0.1  # gap, over the step, below which a contact might close in it
ROUNDS = 200  # maximum, of updates of loads and forces
_CLOSE = 1e-7  # [m g] change of the forces at convergence
_BALANCED = 1e-8  # [m g] gradient at convergence


class Rounding(NamedTuple):
    """Regularisation of dry friction and rigid contact; a rigid object has no `lift`."""

    slip: float = 1e-4  # [1] share of the base's speed from which on the ground's friction is dry
    slip_base: float = 1e-4  # [1] the share for the friction with the base
    depth: float = 1e-6  # [m] penetration of a contact with the base under the weight m g
    lift: float = 0.0  # [1] share of its mean load that a point at the base's speed loses


class Pushed(NamedTuple):
    """Objects (B,) before the middle of the base's front face, which moves along x."""

    solids: Solid
    friction_ground: np.ndarray  # (B,) [1]
    friction_robot: np.ndarray  # (B,) [1]
    height: np.ndarray  # (B,) [m] above the ground at which the base pushes


class Contacts(NamedTuple):
    """Candidate contacts C of the base with objects (B,), in the axes of the base."""

    normal: np.ndarray  # (B, C, 2) unit, towards the object
    at: np.ndarray  # (B, C, 2) [m] from the centre of mass
    gap: np.ndarray  # (B, C) [m]


class Problem(NamedTuple):
    """Optimisation problem for the twists of objects (B,) in one step, at given forces."""

    rows: np.ndarray  # (B, K, 2, 3) twist to sliding at K places: the points, then the contacts
    base: np.ndarray  # (B, K, 2) [1] part of the sliding that is the base's motion
    closing: np.ndarray  # (B, C, 3) twist to speed along the normals
    closed: np.ndarray  # (B, C) [1] part of this speed that is the base's motion
    gap: np.ndarray  # (B, C) [m]
    step: float  # [m] way of the base


class Solution(NamedTuple):
    """Solution of one step for objects (B,)."""

    twist: np.ndarray  # (B, 3) [1, 1, rad/m] of the centre of mass, per metre of way
    force: np.ndarray  # (B, 2) [m g] of the base on the object
    loads: np.ndarray  # (B, S) [m g] of the points
    power: np.ndarray  # (B,) [m g] of friction, per metre of way
    rounds: int  # until the forces converged


class Way(NamedTuple):
    """A push in T steps, of objects (B,)."""

    pose: np.ndarray  # (T + 1, B, 3) [m, m, rad] of the origins, before the base's front
    force: np.ndarray  # (T, B, 2) [m g]
    loads: np.ndarray  # (T, B, S) [m g]
    power: np.ndarray  # (T, B) [m g]
    rounds: int  # maximum of the steps; `ROUNDS` if a step did not converge


def push(
    pushed: Pushed,
    pose: np.ndarray,
    distance: float,
    steps: int,
    *,
    direction: tuple[float, float] = (1.0, 0.0),
    rounding: Rounding = Rounding(),
) -> Way:
    """Push objects (B,) from poses (B, 3) [m, m, rad] by a way of the base [m] in equal steps.

    The base moves in a `direction` of length 1 in its own axes, and does not turn.
    """
    step, u = distance / steps, np.asarray(direction, float)
    pose = np.array(pose, float)
    twist, force = 0.0 * pose, 0.0 * pose[:, :2]
    poses, solutions = [pose], []
    for _ in range(steps):
        solution = solve(pushed, pose, u, step, twist, force, rounding)
        twist, force = solution.twist, solution.force
        # The centre of mass moves on a line, and the origin about it.
        p_object_com, yaw = pushed.solids.p_object_com[:, :2], pose[:, 2] + step * twist[:, 2]
        arm = rotate(pose[:, 2], p_object_com) - rotate(yaw, p_object_com)
        pose = np.column_stack([pose[:, :2] + step * (twist[:, :2] - u) + arm, yaw])
        poses.append(pose)
        solutions.append(solution)
    _, force, loads, power, rounds = map(np.stack, zip(*solutions, strict=True))
    return Way(np.stack(poses), force, loads, power, int(rounds.max()))


def solve(
    pushed: Pushed,
    pose: np.ndarray,
    u: np.ndarray,
    step: float,
    twist: np.ndarray,
    force: np.ndarray,
    rounding: Rounding = Rounding(),
) -> Solution:
    """Return the solution for objects (B,) at poses (B, 3), from a first guess."""
    touching, mu = contacts(pushed.solids, pose), pushed.friction_ground[:, None]
    mu_robot, tangent = pushed.friction_robot[:, None], _across(touching.normal)
    stiffness = 1.0 if pushed.solids.feet is None else pushed.solids.feet[..., 2]
    pressed, loads, lifted = np.zeros(touching.gap.shape), np.zeros((1, 1)), np.zeros((1, 1))
    rounds = 0
    while True:
        rounds += 1
        pressure = pushed.height[:, None] * force
        feet = supports(pushed.solids, pose[:, 2], pressure)
        count = feet.shape[1]
        previous, loads = loads, supported_load(feet, pressure, lifted, stiffness)
        problem = _problem(feet, touching, u, step)
        weights = np.concatenate([mu * loads, mu_robot * pressed], axis=1)
        twist = minimise(problem, weights, twist, rounding, first=rounds == 1)
        slid, speed, slip = _slides(problem, twist, rounding)
        pushing = np.maximum(-_gaps(problem, twist), 0.0) / rounding.depth
        rubbing = (-(weights / np.maximum(speed, slip))[..., None] * slid)[:, count:, :1]
        force = np.sum(pushing[..., None] * touching.normal + rubbing * tangent, axis=1)
        lifted = rounding.lift * speed[:, :count] / count
        changed = max(np.abs(pushing - pressed).max(), np.abs(loads - previous).max())
        pressed = pushing
        if changed < _CLOSE or rounds == ROUNDS:
            power = np.sum(weights * speed, axis=1)
            return Solution(twist, force, loads, power, rounds)


# --- support points and contacts -------------------------------------------------------------


def supports(solids: Solid, yaw: np.ndarray, pressure: np.ndarray) -> np.ndarray:
    """Return the support points (B, S, 2) [m] of solids, from the centre of mass.

    They are the feet, or the corners of a box or prism, or three points of a cylinder's rim. The
    first of these is in the direction to which the centre of mass and the `pressure` (B, 2) [m],
    the moment of the push over the weight, move the load.
    """
    com = rotate(yaw, solids.p_object_com[:, :2])
    if solids.feet is not None:
        return rotate(yaw[:, None], solids.feet[..., :2]) - com[:, None]
    if solids.vertices.shape[1] > 1:
        return rotate(yaw[:, None], solids.vertices) - com[:, None]
    x, y = (com + pressure).T
    angle = np.arctan2(y, x)[:, None] + np.array([0, 2, 4]) * np.pi / 3
    rim = solids.radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return rim - com[:, None]


def supported_load(
    feet: np.ndarray, pressure: np.ndarray, lifted: np.ndarray, weight: np.ndarray | float = 1.0
) -> np.ndarray:
    """Return loads (B, S) [m g] of springs that only push, with sum 1 and moment `pressure`.

    `lifted` (B, 1 or S) [m g] is subtracted from the load of each spring. Stiffnesses are
    proportional to `weight` (B, S), by default equal; a weight of 0 is no spring.
    """
    rows = np.concatenate([np.ones((*feet.shape[:2], 1)), feet], axis=-1)
    lifted = np.broadcast_to(lifted, feet.shape[:2])
    target = np.column_stack([np.ones(len(feet)), pressure])
    weight = np.broadcast_to(weight, feet.shape[:2])
    bears = weight > 0
    load = np.zeros(feet.shape[:2])
    for _ in range(feet.shape[1]):
        springs = rows * bears[..., None]
        total = target + np.einsum("bsi,bs->bi", springs, lifted)
        stiff = weight[..., None] * springs
        plane = np.linalg.pinv(springs.swapaxes(1, 2) @ stiff) @ total[..., None]
        load = bears * ((stiff @ plane)[..., 0] - lifted)
        if not np.any(load < 0):
            break
        bears &= load >= 0
    return load


def contacts(solids: Solid, pose: np.ndarray) -> Contacts:
    """Return candidate contacts of the base's front face, x = 0, with solids at poses (B, 3).

    They are corners of the object on the face, and the two ends of the face on sides of the object.
    """
    position, yaw = pose[:, None, :2], pose[:, 2]
    centre = position + rotate(yaw, solids.p_object_com[:, :2])[:, None]
    if solids.vertices.shape[1] == 1:
        nearest = np.zeros_like(position)
        nearest[..., 1] = np.clip(position[..., 1], -_HALF_WIDTH, _HALF_WIDTH)
        away = position - nearest
        far = np.linalg.norm(away, axis=-1)
        return Contacts(away / far[..., None], nearest - centre, far - solids.radius[:, None])
    corners = position + rotate(yaw[:, None], solids.vertices)
    ahead = np.broadcast_to([1.0, 0.0], corners.shape)
    gap = np.where(np.abs(corners[..., 1]) <= _HALF_WIDTH, corners[..., 0], _FAR)
    edges = np.array([[0.0, -_HALF_WIDTH], [0.0, _HALF_WIDTH]])
    along = np.roll(corners, -1, axis=1) - corners
    length = np.linalg.norm(along, axis=-1)
    unit = along / length[..., None]
    out = np.stack([unit[..., 1], -unit[..., 0]], axis=-1)  # (B, N, 2) of the sides
    offset = edges[:, None] - corners[:, None]  # (B, 2, N, 2)
    beyond = np.sum(offset * out[:, None], axis=-1)
    nearest_side = np.argmax(beyond, axis=2)
    of_side, at_ends = np.take_along_axis, nearest_side[..., None]
    along_side = of_side(np.sum(offset * unit[:, None], axis=-1), at_ends, 2)[..., 0]
    side = of_side(out, at_ends, 1)
    exists = (along_side >= 0) & (along_side <= of_side(length, nearest_side, 1))
    exists &= side[..., 0] < -_FACING
    end_gap = np.where(exists, of_side(beyond, at_ends, 2)[..., 0], _FAR)
    return Contacts(
        np.concatenate([ahead, -side], axis=1),
        np.concatenate([corners, np.broadcast_to(edges, (len(pose), 2, 2))], axis=1) - centre,
        np.concatenate([gap, end_gap], axis=1),
    )


def _problem(feet: np.ndarray, touching: Contacts, u: np.ndarray, step: float) -> Problem:
    """Return the kinematics of points and contacts for a base that moves at u (2,)."""
    normal = touching.normal
    tangent = _across(normal)
    along = _of_twist(tangent, touching.at)
    zero = np.zeros((*feet.shape[:2], 1))
    rows_x = np.concatenate([zero + 1, zero, -feet[..., 1:]], axis=-1)
    rows_y = np.concatenate([zero, zero + 1, feet[..., :1]], axis=-1)
    of_feet, of_contacts = np.stack([rows_x, rows_y], axis=2), np.stack([along, 0 * along], axis=2)
    rows = np.concatenate([of_feet, of_contacts], axis=1)
    base = np.zeros(rows.shape[:3])
    base[:, feet.shape[1] :, 0] = tangent @ u
    return Problem(rows, base, _of_twist(normal, touching.at), normal @ u, touching.gap, step)


# --- the convex problem ---------------------------------------------------------------------


def minimise(
    problem: Problem, weights: np.ndarray, twist: np.ndarray, rounding: Rounding, *, first: bool
) -> np.ndarray:
    """Return the twists (B, 3) of minimum power, by Newton's method with a line search.

    `weights` (B, K) [m g] are the maximum of each friction. At `first`, with a poor guess, friction
    starts with a wide slip.
    """
    for rounder in (100.0, 10.0, 1.0) if first else (1.0,):
        slip, slip_base = rounder * rounding.slip, rounder * rounding.slip_base
        soft = rounding._replace(slip=slip, slip_base=slip_base)
        for _ in range(60):
            gradient, *hessians = _derivatives(problem, weights, twist, soft)
            if np.abs(gradient).max() < _BALANCED:
                break
            # Newton's step converges fast. If friction is nearly constant along it, a step with an
            # upper bound of the Hessian cannot overshoot.
            both = np.stack(hessians) + 1e-9 * np.eye(3)
            changes = -np.linalg.solve(both, np.stack([gradient] * 2)[..., None])[..., 0]
            tried = twist + (_ALPHAS[:, None, None, None] * changes).reshape(-1, *twist.shape)
            values = np.stack([_value(problem, weights, candidate, soft) for candidate in tried])
            values[0] -= 1e-14
            best = np.argmin(values, axis=0)
            worse = values.min(axis=0) > _value(problem, weights, twist, soft)
            twist = np.where(worse[:, None], twist, tried[best, np.arange(len(twist))])
    return twist


def _slides(
    problem: Problem, twist: np.ndarray, rounding: Rounding
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return sliding (B, K, 2), its speed (B, K), and the speed (K,) of dry friction."""
    slid = np.einsum("bkij,bj->bki", problem.rows, twist) - problem.base
    contacts = problem.gap.shape[1]
    counts = [slid.shape[1] - contacts, contacts]
    slip = np.repeat([rounding.slip, rounding.slip_base], counts)
    return slid, np.linalg.norm(slid, axis=-1), slip


def _gaps(problem: Problem, twist: np.ndarray) -> np.ndarray:
    """Return the gaps (B, C) [m] after the step."""
    pace = np.einsum("bci,bi->bc", problem.closing, twist) - problem.closed
    return problem.gap + problem.step * pace


def _value(
    problem: Problem, weights: np.ndarray, twist: np.ndarray, rounding: Rounding
) -> np.ndarray:
    inside = np.maximum(-_gaps(problem, twist), 0.0)
    penalty = np.sum(inside * inside, axis=1) / (2 * rounding.depth * problem.step)
    _, speed, slip = _slides(problem, twist, rounding)
    dissipated = np.where(speed > slip, speed - slip / 2, speed * speed / (2 * slip))
    return penalty + np.sum(weights * dissipated, axis=1)


def _derivatives(
    problem: Problem, weights: np.ndarray, twist: np.ndarray, rounding: Rounding
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return gradient (B, 3), Hessian (B, 3, 3) and an upper bound of it nearby."""
    slid, speed, slip = _slides(problem, twist, rounding)
    size = np.maximum(speed, slip)
    gap = _gaps(problem, twist)
    inside = np.maximum(-gap, 0.0)
    pull = np.einsum("bki,bkij->bkj", slid / size[..., None], problem.rows)
    gradient = np.einsum("bk,bkj->bj", weights, pull)
    gradient -= np.einsum("bc,bcj->bj", inside / rounding.depth, problem.closing)
    per = weights / size
    upper = np.einsum("bk,bkij,bkil->bjl", per, problem.rows, problem.rows)
    bend = np.einsum("bk,bkj,bkl->bjl", per * (speed > slip), pull, pull)
    stiff = problem.step / rounding.depth
    held, near = (
        stiff * np.einsum("bc,bcj,bcl->bjl", close, problem.closing, problem.closing)
        for close in (gap < 0, gap < _NEAR * problem.step)
    )
    return gradient, upper + held - bend, upper + near


def _across(vector: np.ndarray) -> np.ndarray:
    """Return vectors (..., 2) turned by a right angle, counter-clockwise."""
    return np.stack([-vector[..., 1], vector[..., 0]], axis=-1)


def _of_twist(direction: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return rows (..., 3) that map a twist to the velocity at `at` along `direction` (..., 2)."""
    moment = at[..., 0] * direction[..., 1] - at[..., 1] * direction[..., 0]
    return np.concatenate([direction, moment[..., None]], axis=-1)
