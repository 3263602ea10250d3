"""The rigid limit: how a rigid object slides that is pushed slowly, with dry friction alone.

An object of weight m g stands on a few points and is pushed by the flat front of the base, at some
height z. It moves so slowly that inertia does not count, and so everything depends on the way of
the base alone: velocities are per metre of this way, and forces are in units of m g.

The loads N_i of the points balance the weight and the moment z F of the push F. Three points leave
no choice. Of four, equal springs decide, so the load is linear in place: the limit of any ground,
however stiff, that is the same everywhere. A point that would have to pull lifts off. Given these
loads, and the sizes n_c of the forces at the contacts with the base, the object's twist V minimises

    sum over points of mu N_i |v_i| + sum over contacts of mu_r n_c |slip_c|,

the power that friction takes, among all twists with which no contact sinks into the base (maximum
dissipation, which is Coulomb's law). Loads and sizes follow from V in turn, so the convex problem
is solved again until they stay. Friction grows evenly up to a share `slip` of the base's speed and
is dry beyond, and a contact sinks in by `depth` under the whole weight; both are too small to show.

The same equations say what MuJoCo's cones add, if `slip` and `lift` are those of its ground.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rps_jax.geometry.solid import Solid
from rps_jax.robot.shell import HALF_WIDTH

_FAR = 1.0  # [m] gap of a contact that cannot be
_FACING = 0.5  # cosine of the angle to the base within which its corners may touch a side
_ALPHAS = 0.25 ** np.arange(5)  # steps of a line search
_NEAR = 0.1  # gap, over the step, below which a contact might close in it
ROUNDS = 200  # at most, in which loads and forces follow from the twist
_CLOSE = 1e-7  # [m g] by which the forces may still change
_BALANCED = 1e-8  # [m g] to which they balance


class Rounding(NamedTuple):
    """How dry friction and rigid contact are rounded off; the last is of no rigid object."""

    slip: float = 1e-4  # [1] share of the base's speed from which on the ground's friction is dry
    slip_base: float = 1e-4  # [1] likewise of the friction with the base
    depth: float = 1e-6  # [m] that a contact with the base sinks in under the weight m g
    lift: float = 0.0  # [1] share of its mean load that a point as fast as the base loses


class Pushed(NamedTuple):
    """Objects (B,) before the middle of the base's front face, which moves along x."""

    solids: Solid
    friction_ground: np.ndarray  # (B,) [1]
    friction_robot: np.ndarray  # (B,) [1]
    height: np.ndarray  # (B,) [m] above the ground at which the base pushes


class Contacts(NamedTuple):
    """Where the base may push objects (B,) at C places; axes of the base."""

    normal: np.ndarray  # (B, C, 2) unit, towards the object
    at: np.ndarray  # (B, C, 2) [m] from the centre of mass
    gap: np.ndarray  # (B, C) [m]


class Problem(NamedTuple):
    """What decides the twists of objects (B,) in one step, given all sizes of forces."""

    rows: np.ndarray  # (B, K, 2, 3) twist to sliding at K places: the points, then the contacts
    base: np.ndarray  # (B, K, 2) [1] what of the sliding is the base's own
    closing: np.ndarray  # (B, C, 3) twist to speed along the normals
    closed: np.ndarray  # (B, C) [1] what of it is the base's own
    gap: np.ndarray  # (B, C) [m]
    step: float  # [m] way of the base


class Solution(NamedTuple):
    """What one step is, for objects (B,)."""

    twist: np.ndarray  # (B, 3) [1, 1, rad/m] of the centre of mass, per metre of way
    force: np.ndarray  # (B, 2) [m g] of the base on the object
    loads: np.ndarray  # (B, S) [m g] of the points
    power: np.ndarray  # (B,) [m g] that friction takes, per metre of way
    rounds: int  # until the forces stayed


class Way(NamedTuple):
    """A push in T steps, of objects (B,)."""

    pose: np.ndarray  # (T + 1, B, 3) [m, m, rad] of the origins, before the base's front
    force: np.ndarray  # (T, B, 2) [m g]
    loads: np.ndarray  # (T, B, S) [m g]
    power: np.ndarray  # (T, B) [m g]
    rounds: int  # the most of any step; `ROUNDS` if its forces did not come to rest


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
    poses, found = [pose], []
    for _ in range(steps):
        one = solve(pushed, pose, u, step, twist, force, rounding)
        twist, force = one.twist, one.force
        # The centre of mass moves on a line, and the origin about it.
        com = _turned(pose[:, 2], pushed.solids.p_object_com[:, :2])
        yaw = pose[:, 2] + step * twist[:, 2]
        after = com - _turned(yaw, pushed.solids.p_object_com[:, :2])
        moved = pose[:, :2] + step * (twist[:, :2] - u) + after
        pose = np.column_stack([moved, yaw])
        poses.append(pose)
        found.append(one)
    return Way(
        pose=np.stack(poses),
        force=np.stack([one.force for one in found]),
        loads=np.stack([one.loads for one in found]),
        power=np.stack([one.power for one in found]),
        rounds=max(one.rounds for one in found),
    )


def solve(
    pushed: Pushed,
    pose: np.ndarray,
    u: np.ndarray,
    step: float,
    twist: np.ndarray,
    force: np.ndarray,
    rounding: Rounding = Rounding(),
) -> Solution:
    """The twists of objects (B,) at poses (B, 3), from a first guess of twists and forces."""
    here, mu = contacts(pushed.solids, pose), pushed.friction_ground[:, None]
    mu_robot = pushed.friction_robot[:, None]
    tangent = np.stack([-here.normal[..., 1], here.normal[..., 0]], axis=-1)
    pressed, loads, lifted = np.zeros(here.gap.shape), np.zeros((1, 1)), np.zeros((len(pose), 1))
    rounds = 0
    while True:
        pressure = pushed.height[:, None] * force
        feet = supports(pushed.solids, pose[:, 2], pressure)
        many = feet.shape[1]
        weight = 1.0 if pushed.solids.feet is None else pushed.solids.feet[..., 2]
        before, loads = loads, borne(feet, pressure, lifted, weight)
        problem = _problem(feet, here, u, step)
        weights = np.concatenate([mu * loads, mu_robot * pressed], axis=1)
        twist = minimise(problem, weights, twist, rounding, first=rounds == 0)
        slid, speed, slip = _slides(problem, twist, rounding)
        pushing = np.maximum(-_gaps(problem, twist), 0.0) / rounding.depth
        rubbing = -(weights / np.maximum(speed, slip))[..., None] * slid
        force = np.sum(pushing[..., None] * here.normal + rubbing[:, many:, :1] * tangent, axis=1)
        lifted = rounding.lift * speed[:, :many] / many
        changed = max(np.abs(pushing - pressed).max(), np.abs(loads - before).max())
        pressed, rounds = pushing, rounds + 1
        if changed < _CLOSE or rounds == ROUNDS:
            break
    power = np.sum(weights * speed, axis=1)
    return Solution(twist, force, loads, power, rounds)


# --- where an object stands and touches -----------------------------------------------------


def supports(solids: Solid, yaw: np.ndarray, pressure: np.ndarray) -> np.ndarray:
    """Points (B, S, 2) [m], from the centre of mass, on which engines stand solids.

    They are their feet, if they have some of their own; else the corners of a box or prism, and
    three points of a cylinder's rim, one of them where it leans to: where its centre of mass and
    the `pressure` (B, 2) [m], the moment of the push over the weight, move the load.
    """
    com = _turned(yaw, solids.p_object_com[:, :2])
    if solids.feet is not None:
        return _turned(yaw[:, None], solids.feet[..., :2]) - com[:, None]
    if solids.vertices.shape[1] > 1:
        return _turned(yaw[:, None], solids.vertices) - com[:, None]
    x, y = (com + pressure).T
    angle = np.arctan2(y, x)[:, None] + np.array([0, 2, 4]) * np.pi / 3
    rim = solids.radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return rim - com[:, None]


def borne(
    feet: np.ndarray, pressure: np.ndarray, lifted: np.ndarray, weight: np.ndarray | float = 1.0
) -> np.ndarray:
    """Loads (B, S) [m g] of springs that only push, their sum 1, their moment `pressure`.

    `lifted` (B, 1 or S) [m g] is taken from what each spring would bear. Their stiffnesses are in
    the ratio of `weight` (B, S), by default equal; a weight of 0 is no spring.
    """
    rows = np.concatenate([np.ones((*feet.shape[:2], 1)), feet], axis=-1)
    lifted = np.broadcast_to(lifted, feet.shape[:2])
    wanted = np.column_stack([np.ones(len(feet)), pressure])
    weight = np.broadcast_to(weight, feet.shape[:2])
    bears = weight > 0
    load = np.zeros(feet.shape[:2])
    for _ in range(feet.shape[1]):
        some = rows * bears[..., None]
        total = wanted + np.einsum("bsi,bs->bi", some, lifted)
        stiff = weight[..., None] * some
        plane = np.linalg.pinv(some.swapaxes(1, 2) @ stiff) @ total[..., None]
        load = bears * ((stiff @ plane)[..., 0] - lifted)
        if not np.any(load < 0):
            break
        bears &= load >= 0
    return load


def contacts(solids: Solid, pose: np.ndarray) -> Contacts:
    """Where the base's front face, x = 0, may touch solids at poses (B, 3).

    That is corners of the object on the face, and the two ends of the face on sides of the object.
    """
    place, yaw = pose[:, None, :2], pose[:, 2]
    centre = place + _turned(yaw, solids.p_object_com[:, :2])[:, None]
    if solids.vertices.shape[1] == 1:
        nearest = np.zeros_like(place)
        nearest[..., 1] = np.clip(place[..., 1], -HALF_WIDTH, HALF_WIDTH)
        away = place - nearest
        far = np.linalg.norm(away, axis=-1)
        return Contacts(away / far[..., None], nearest - centre, far - solids.radius[:, None])
    corners = place + _turned(yaw[:, None], solids.vertices)
    ahead = np.broadcast_to([1.0, 0.0], corners.shape)
    gap = np.where(np.abs(corners[..., 1]) <= HALF_WIDTH, corners[..., 0], _FAR)
    ends = np.array([[0.0, -HALF_WIDTH], [0.0, HALF_WIDTH]])
    along = np.roll(corners, -1, axis=1) - corners
    length = np.linalg.norm(along, axis=-1)
    unit = along / length[..., None]
    out = np.stack([unit[..., 1], -unit[..., 0]], axis=-1)  # (B, N, 2) of the sides
    apart = ends[:, None] - corners[:, None]  # (B, 2, N, 2)
    beyond = np.sum(apart * out[:, None], axis=-1)
    which = np.argmax(beyond, axis=2)
    of_side = np.take_along_axis
    place_on = of_side(np.sum(apart * unit[:, None], axis=-1), which[..., None], 2)[..., 0]
    side = of_side(out, which[..., None], 1)
    there = (place_on >= 0) & (place_on <= of_side(length, which, 1)) & (side[..., 0] < -_FACING)
    end_gap = np.where(there, of_side(beyond, which[..., None], 2)[..., 0], _FAR)
    return Contacts(
        np.concatenate([ahead, -side], axis=1),
        np.concatenate([corners, np.broadcast_to(ends, (len(pose), 2, 2))], axis=1) - centre,
        np.concatenate([gap, end_gap], axis=1),
    )


def _problem(feet: np.ndarray, here: Contacts, u: np.ndarray, step: float) -> Problem:
    """The kinematics of points and contacts for a base that moves at u (2,)."""
    normal = here.normal
    tangent = np.stack([-normal[..., 1], normal[..., 0]], axis=-1)
    along = _of_twist(tangent, here.at)
    zero = np.zeros((*feet.shape[:2], 1))
    one = zero + 1.0
    rows_x = np.concatenate([one, zero, -feet[..., 1:]], axis=-1)
    rows_y = np.concatenate([zero, one, feet[..., :1]], axis=-1)
    rows = np.concatenate(
        [np.stack([rows_x, rows_y], axis=2), np.stack([along, 0 * along], axis=2)], axis=1
    )
    base = np.zeros(rows.shape[:3])
    base[:, feet.shape[1] :, 0] = tangent @ u
    return Problem(rows, base, _of_twist(normal, here.at), normal @ u, here.gap, step)


# --- the convex problem ---------------------------------------------------------------------


def minimise(
    problem: Problem, weights: np.ndarray, twist: np.ndarray, rounding: Rounding, *, first: bool
) -> np.ndarray:
    """The twists (B, 3) of least power, by Newton's method with a line search.

    `weights` (B, K) [m g] are the most that each friction can be. At `first`, with a poor guess,
    friction begins well rounded.
    """
    for rounder in (100.0, 10.0, 1.0) if first else (1.0,):
        soft = rounding._replace(
            slip=rounder * rounding.slip, slip_base=rounder * rounding.slip_base
        )
        for _ in range(60):
            gradient, *hessians = _derivatives(problem, weights, twist, soft)
            if np.abs(gradient).max() < _BALANCED:
                break
            # Newton's step is fast at the end; where friction is nearly level along it, that of an
            # upper bound of the Hessian cannot overshoot.
            both = np.stack(hessians) + 1e-9 * np.eye(3)
            changes = -np.linalg.solve(both, np.stack([gradient] * 2)[..., None])[..., 0]
            tried = twist + (_ALPHAS[:, None, None, None] * changes).reshape(-1, *twist.shape)
            values = np.stack([_value(problem, weights, one, soft) for one in tried])
            values[0] -= 1e-14
            best = np.argmin(values, axis=0)
            worse = values.min(axis=0) > _value(problem, weights, twist, soft)
            twist = np.where(worse[:, None], twist, tried[best, np.arange(len(twist))])
    return twist


def _slides(
    problem: Problem, twist: np.ndarray, rounding: Rounding
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sliding (B, K, 2), its speed (B, K), and that (K,) from which on friction is dry."""
    slid = np.einsum("bkij,bj->bki", problem.rows, twist) - problem.base
    return slid, np.linalg.norm(slid, axis=-1), _slip(problem, rounding)


def _slip(problem: Problem, rounding: Rounding) -> np.ndarray:
    """From which sliding (K,) on friction is dry."""
    contacts = problem.gap.shape[1]
    points = problem.rows.shape[1] - contacts
    return np.repeat([rounding.slip, rounding.slip_base], [points, contacts])


def _gaps(problem: Problem, twist: np.ndarray) -> np.ndarray:
    """Gaps (B, C) [m] after the step."""
    pace = np.einsum("bci,bi->bc", problem.closing, twist) - problem.closed
    return problem.gap + problem.step * pace


def _value(
    problem: Problem, weights: np.ndarray, twist: np.ndarray, rounding: Rounding
) -> np.ndarray:
    inside = np.maximum(-_gaps(problem, twist), 0.0)
    held = np.sum(inside * inside, axis=1) / (2 * rounding.depth * problem.step)
    _, speed, slip = _slides(problem, twist, rounding)
    taken = np.where(speed > slip, speed - slip / 2, speed * speed / (2 * slip))
    return held + np.sum(weights * taken, axis=1)


def _derivatives(
    problem: Problem, weights: np.ndarray, twist: np.ndarray, rounding: Rounding
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gradient (B, 3), Hessian (B, 3, 3) and an upper bound of it nearby."""
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


def _turned(yaw: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors (..., 2) turned by yaw (...) [rad]."""
    c, s = np.cos(yaw)[..., None], np.sin(yaw)[..., None]
    x, y = vector[..., :1], vector[..., 1:]
    return np.concatenate([c * x - s * y, s * x + c * y], axis=-1)


def _of_twist(direction: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Rows (..., 3) that map a twist to the velocity at `at` along `direction` (..., 2)."""
    moment = at[..., 0] * direction[..., 1] - at[..., 1] * direction[..., 0]
    return np.concatenate([direction, moment[..., None]], axis=-1)
