"""The quasi-static engine: planar, without inertia, with finite and correct derivatives.

A force f through the centre of friction and a torque m about it slide an object with a twist
V = (v_x, v_y, omega) normal to the limit surface of its friction with the ground. Here that is the
ellipsoid f^2 / f_max^2 + m^2 / m_max^2 = 1, so that V is proportional to L^-1 (f, m), with
L = diag(1, 1, c^2) and c = m_max / f_max (Goyal, Ruina and Papadopoulos 1991; Howe and Cutkosky
1996; Lynch and Mason 1996). The base, a velocity source, determines the speed of the object, so
that the results depend neither on the size of the force, nor on the mass, nor on the friction with
the ground. Of an object on pads, as with even pressure, the limit surface is that of their Coulomb
friction: D(V) = sum over pads of N_i |(v_i, r_i omega)|, with loads N_i, velocities v_i and radii
r_i, replaces the square root of V L V. In each step V minimises

    V L V / (2 S) + sum over contacts of P(gap + dt (v_n - mu |v_t|)),

with S the speed of the base, v the velocity of the object's point relative to the base's, and P the
potential of a stiff spring that only pushes. At the minimum the ground's friction balances contact
forces within Coulomb's cones. (The cones of Anitescu 2006 keep a sliding contact mu |v_t| dt apart:
below 0.4 mm here.) The problem is smooth and strictly convex in V. Newton's method solves it, and
the implicit function theorem gives its derivatives.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.engines.base import ControlPeriod, Driven, Engine, Motion
from rps_jax.engines.fused.contacts import Point, circle_and_base, polygon_and_base
from rps_jax.geometry import planar, solid
from rps_jax.geometry import vectors as sp
from rps_jax.geometry.arrays import Array, Entries, Number
from rps_jax.geometry.friction import ENTRIES, friction_of_pads, solved
from rps_jax.geometry.vectors import Vec
from rps_jax.world import scene
from rps_jax.world.scene import JOINTS, WorldInputs

_MIN_SPEED = 1e-5  # [m/s] speed of a base at rest
DEPTH = 1e-4  # [m] approximate penetration of a push
SLIP = 0.01  # [1] share of the base's speed at which friction is 0.7 of its maximum
_ITERATIONS = 10  # of Newton's method
_SHARP = 3  # final steps of Newton's method with the final slip; earlier ones have a wider slip
_LEAST_RADIUS = 0.05  # [1] of pads, of the arm: at a point, the limit surface is not smooth
_LEAST_PACE = 1e-3  # [1] share of the base's speed below which friction of pads is smooth


class Slider(NamedTuple):
    """Constants of one world."""

    p_object_com: Entries  # (2,) [m] centre of mass and of friction, in the object's frame
    arm: Number  # () [m] c = m_max / f_max of the friction with the ground
    friction_robot: Number  # () [1]
    base_size: Entries  # (2,) [m] half length and width of the base, or (1,) its radius
    vertices: Entries  # (N, 2) [m] of the outline, counter-clockwise, in the object's frame
    radius: Number  # () [m] of the outline
    # (S, 4) x, y [m] of pads from the centre of mass, share of the friction [1], radius [m]
    pads: Entries = None


class Contact(NamedTuple):
    """Candidate contact of base and object, in the base's frame."""

    normal: Point  # unit, towards the object
    r: Point  # [m] from the object's centre of mass
    v: Point  # [m/s] of the base there
    gap: Number  # [m] negative for penetration


class Problem(NamedTuple):
    """Optimisation problem for the object's twist in one step."""

    contacts: Sequence[Contact]
    speed: Number  # [m/s] of the base
    arm: Number  # [m]
    friction: Number  # [1]
    pads: tuple[Number, ...] | None = None  # rows of `Slider.pads`, in the base's axes


class Quasistatic(NamedTuple):
    """Stage of quasi-static worlds, which share nothing."""

    native = False
    engine = "quasistatic"

    def drive(self, fields: Slider, motion: Motion, period: ControlPeriod) -> Driven:
        """Step a batch for one control period, with constant height and tilt of the object.

        The resulting velocities are means over the period.
        """
        com, qpos, physics = fields.p_object_com, motion.qpos, period.physics
        free = qpos[:, JOINTS.object]
        yaw = planar.yaw_of_quaternion(free[:, 3:])
        p = free[:, :2] + planar.rotate(yaw, com)
        # The batch axis comes last, as in `contacts`.
        corners = jnp.moveaxis(fields.vertices - com[:, None], (0, 1), (2, 1))
        pads = None if fields.pads is None else tuple(jnp.moveaxis(fields.pads, (0, 1), (2, 1)))
        sliders = fields._replace(
            base_size=tuple(fields.base_size.T), vertices=tuple(corners), pads=pads
        )
        poses = (tuple(qpos[:, JOINTS.base].T), (*p.T, yaw))
        twist = (period.twists.v_x, period.twists.v_y, period.twists.omega)
        step = partial(_step, sliders, twist, physics.timestep)
        base, (x, y, angle) = jax.lax.fori_loop(0, physics.substeps, lambda _, s: step(s), poses)
        half = 0.5 * (angle - yaw)
        q = sp.times((jnp.cos(half), 0.0, 0.0, jnp.sin(half)), tuple(free[:, 3:].T))
        origin = jnp.stack([x, y], axis=-1) - planar.rotate(angle, com)
        end = jnp.concatenate(
            [jnp.stack(base, axis=-1), origin, free[:, 2:3], jnp.stack(q, axis=-1)], axis=-1
        )
        seconds = physics.control_period
        moved = (end - qpos)[:, :6] / seconds
        spin = jnp.zeros_like(moved[:, :3]).at[:, 2].set((angle - yaw) / seconds)
        velocity = jnp.concatenate([moved, spin], axis=-1)
        return Driven(Motion(end, velocity, motion.warmstart))


def _step(slider: Slider, twist: Vec, dt: float, poses: tuple[Vec, Vec]) -> tuple[Vec, Vec]:
    """Return the poses of base and object after dt [s] at `twist`.

    A pose is x, y [m], yaw [rad] in the world, for the object of its centre of mass.
    """
    base, pushed = poses
    turn = sp.turn(base[2])
    *p, yaw = sp.turned_back(turn, sp.sub(pushed, base))
    v_x, v_y, omega = twist
    reach, pads = sp.dot(slider.base_size, slider.base_size), slider.pads
    if pads is not None:
        pads = sp.turned(sp.turn(yaw), pads)
    problem = Problem(
        _contacts(slider, (p[0], p[1], yaw), twist),
        jnp.sqrt(v_x * v_x + v_y * v_y + reach * omega * omega + _MIN_SPEED**2),
        slider.arm,
        slider.friction_robot,
        pads,
    )
    v = solve(problem, (*sp.at_point(twist, p), omega), dt)

    def moved(x: Vec, u: Vec) -> Vec:
        return sp.add(x, sp.scale(dt, sp.turned(turn, u)))

    return moved(base, twist), moved(pushed, v)


def solve(problem: Problem, v: Vec, dt: float) -> Vec:
    """Return the object's twist, from a first guess v, both in the base's frame.

    Newton's method starts with a wide slip of friction, so that no step overshoots. Only its
    last step is differentiated, with a constant matrix: at the solution that gives the
    derivatives of the implicit function.
    """
    fixed, v = jax.lax.stop_gradient((problem, v))
    widening = _ITERATIONS - _SHARP

    def newton(i: Array, v: Vec) -> Vec:
        slip = SLIP ** jnp.minimum(i / widening, 1.0).astype(v[0].dtype)
        gradient, hessian = derivatives(fixed, v, slip, dt)
        return sp.sub(v, solved(gradient, hessian))

    v = jax.lax.stop_gradient(jax.lax.fori_loop(0, _ITERATIONS, newton, v))
    gradient, hessian = derivatives(problem, v, SLIP, dt)
    return sp.sub(v, solved(gradient, jax.lax.stop_gradient(hessian)))


def derivatives(problem: Problem, v: Vec, slip: Number, dt: float) -> tuple[Vec, list[Number]]:
    """Return the gradient and the upper entries of the Hessian of the cost."""
    tiny, friction = slip * problem.speed, problem.friction
    stiff = 1 / problem.speed
    if problem.pads is None:
        inertia = (stiff, stiff, stiff * problem.arm * problem.arm)
        gradient = sp.map_entries(sp.mul, inertia, v)
        hessian: list[Number] = [inertia[i] if i == j else 0.0 for i, j in ENTRIES]
    else:
        gradient, hessian = friction_of_pads(problem.pads, v, _LEAST_PACE * problem.speed)
        gradient, hessian = sp.scale(stiff, gradient), [stiff * entry for entry in hessian]
    for contact in problem.contacts:
        n, r = contact.normal, contact.r
        t = (-n[1], n[0])
        u = sp.sub(sp.at_point(v, r), contact.v)
        v_t = sp.dot(t, u)
        slide = jnp.sqrt(v_t * v_t + tiny * tiny)  # a smooth |v_t|
        inside = -contact.gap - dt * (sp.dot(n, u) - friction * (slide - tiny))
        force, stiffness = _spring(inside)
        along = sp.wrench(r, t)
        push = sp.sub(sp.wrench(r, n), sp.scale(friction * v_t / slide, along))
        gradient = sp.sub(gradient, sp.scale(force, push))
        bend = force * friction * tiny * tiny / (slide * slide * slide)
        hessian = [
            h + dt * stiffness * push[i] * push[j] + bend * along[i] * along[j]
            for h, (i, j) in zip(hessian, ENTRIES, strict=True)
        ]
    return gradient, hessian


def _contacts(slider: Slider, pose: Vec, twist: Vec) -> list[Contact]:
    """Return the candidate contacts of a base at `twist` with an object at `pose`."""
    p_x, p_y, yaw = pose
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    x, y = slider.vertices  # (N, ...) each, from the centre of mass
    corners = (p_x + c * x - s * y, p_y + s * x + c * y)
    radius, size = slider.radius, slider.base_size
    if x.shape[0] == 1:
        normal, point, gap = circle_and_base((corners[0][0], corners[1][0]), radius, size)
        points, gaps = [point], [gap]
    else:
        ahead = sp.map_entries(lambda x: jnp.roll(x, -1, axis=0), corners)
        normal, middles, gaps = polygon_and_base(corners, ahead, size)
        gaps = [gap - radius for gap in gaps]
        points = [sp.sub(q, sp.scale(0.5 * radius, normal)) for q in middles]
    return [
        Contact(
            normal,
            sp.sub(q, pose[:2]),
            sp.at_point(twist, q),
            gap,
        )
        for q, gap in zip(points, gaps, strict=True)
    ]


def _spring(inside: Number) -> tuple[Number, Number]:
    """Return force [1] and stiffness [1/m] of a contact `inside` [m] the base.

    The force is zero up to -DEPTH, a parabola up to DEPTH, and has the slope 1 / DEPTH beyond.
    """
    bent = jnp.clip(inside + DEPTH, 0.0, 2 * DEPTH)
    force = bent * bent / (4 * DEPTH) + jnp.maximum(inside - DEPTH, 0.0)
    return force / DEPTH, bent / (2 * DEPTH * DEPTH)


class QuasistaticEngine(Engine):
    """Planar engine without inertia, differentiable in both modes."""

    name = "quasistatic"
    cones = ("elliptic",)  # its friction is the same in all directions
    modes = ("forward", "reverse")
    forces = False
    surroundings = ()
    computes_force = False  # only the direction of the force is known, not its size

    def stage(self, inputs: WorldInputs) -> tuple[Quasistatic, Slider]:
        """Return the stage, and the sliders (n, ...) of the worlds; bases follow every twist."""
        solids, count = inputs.solids, inputs.num_worlds
        assert not inputs.robots.driven, "checked by check_robot"
        arm, pads = solid.friction_arm(solids), None
        if solids.feet is not None and solids.pads is not None:
            at, weight = (
                solids.feet[..., :2] - solids.p_object_com[:, None, :2],
                solids.feet[..., 2],
            )
            share = solid.supported_load(at, weight, np.zeros((count, 2))) * solids.pads[..., 0]
            share = share / share.sum(axis=1, keepdims=True)
            radius = np.maximum(solids.pads[..., 1], _LEAST_RADIUS * arm[:, None])
            pads = np.concatenate([at, np.stack([share, radius], axis=2)], axis=2)
        return Quasistatic(), Slider(
            p_object_com=solids.p_object_com[:, :2],
            arm=arm,
            friction_robot=np.broadcast_to(inputs.friction.robot, count),
            base_size=scene.base_size(inputs.robots, count),
            vertices=solids.vertices,
            radius=solids.radius,
            pads=pads,
        )


ENGINE = QuasistaticEngine()
