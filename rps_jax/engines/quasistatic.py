"""Quasi-static planar pushing: no inertia, no height, and derivatives that are finite and right.

An object that a force f through its centre of friction and a torque m about it make slide has a
twist V = (v_x, v_y, omega) normal to the limit surface of its friction with the ground, here the
ellipsoid f^2 / f_max^2 + m^2 / m_max^2 = 1: V goes as L^-1 (f, m), with L = diag(1, 1, c^2) and
c = m_max / f_max (Goyal, Ruina and Papadopoulos 1991; Howe and Cutkosky 1996; Lynch and Mason
1996). The base, a velocity source, sets how fast the object moves, and so the size of the force
does not matter, nor do the mass and the friction with the ground. In each step V minimises

    V L V / (2 S) + sum over contacts of P(gap + dt (v_n - mu |v_t|)),

S the speed of the base, v the velocity of the object's point relative to the base's, P the
potential of a stiff spring that only pushes. Where its derivative is zero, the ground's friction
balances contact forces within Coulomb's cones (Anitescu 2006, whose cones keep a contact that
slides mu |v_t| dt apart: below 0.4 mm here). All of it is smooth and strictly convex in V, solved
by Newton's method, and has the derivatives that the implicit function theorem gives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.engines.base import ControlPeriod, Driven, Engine, Motion
from rps_jax.engines.fused.contacts import Point, circle_and_rectangle, polygon_and_rectangle
from rps_jax.geometry import planar, solid
from rps_jax.geometry import vectors as sp
from rps_jax.geometry.solid import Solid
from rps_jax.geometry.vectors import Vec
from rps_jax.robot.robot import Robot
from rps_jax.world import scene
from rps_jax.world.physics import Physics
from rps_jax.world.scene import JOINTS, Friction

_LEAST_SPEED = 1e-5  # [m/s] taken for that of a base at rest
_SHARP = 3  # last steps of Newton's method, on the problem itself; those before widen its slip
_ENTRIES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of a symmetric matrix


class Slider(NamedTuple):
    """What one world is made of."""

    p_object_com: Any  # (2,) [m] centre of mass, and so of friction, in the object's frame
    arm: Any  # () [m] c = m_max / f_max of the friction with the ground
    friction_robot: Any  # () [1]
    base_half: Any  # (2,) [m] half length and width of the base
    vertices: Any  # (N, 2) [m] of the outline, counter-clockwise, in the object's frame
    radius: Any  # () [m] of the outline


def sliders(solids: Solid, friction_robot: np.ndarray, base_half: np.ndarray) -> Slider:
    """Solids (n,) on the points on which the other engines stand them.

    Their friction (n,) is that with a base of half length and width (2,) [m].
    """
    count = solids.mass.size
    return Slider(
        p_object_com=solids.p_object_com[:, :2],
        arm=solid.friction_arm(solids),
        friction_robot=np.broadcast_to(friction_robot, count),
        base_half=np.broadcast_to(base_half, (count, 2)),
        vertices=solids.vertices,
        radius=solids.radius,
    )


class Contact(NamedTuple):
    """A point where the base may push the object; in the base's frame."""

    normal: Point  # unit, towards the object
    r: Point  # [m] from the object's centre of mass
    v: Point  # [m/s] of the base there
    gap: Any  # [m] below zero inside


class Problem(NamedTuple):
    """What decides the object's twist in one step."""

    contacts: Sequence[Contact]
    speed: Any  # [m/s] of the base
    arm: Any  # [m]
    friction: Any  # [1]


@jax.tree_util.register_static
@dataclass(frozen=True)
class Quasistatic:
    """Stage of quasi-static worlds: how contact is smoothed and the problem solved."""

    depth: float = 1e-4  # [m] how far, about, a push sinks the object into the base
    slip: float = 0.01  # [1] share of the base's speed at which friction is 0.7 of its most
    iterations: int = 10  # of Newton's method

    def __post_init__(self) -> None:
        """Raises InputError for values with which there is nothing to solve."""
        errors.check_finite("depth", self.depth, above=0, at_most=0.01, unit="m")
        errors.check_finite("slip", self.slip, above=0, at_most=1)
        errors.check_finite("iterations", self.iterations, at_least=_SHARP + 1)

    def drive(self, fields: Slider, motion: Motion, period: ControlPeriod) -> Driven:
        """Step a batch for one control period; height and tilt of the object stay.

        The velocities that come back are means over the period.
        """
        com, qpos, physics = fields.p_object_com, motion.qpos, period.physics
        free = qpos[:, JOINTS.object]
        yaw = planar.yaw_of_quaternion(free[:, 3:])
        p = free[:, :2] + planar.rotate(yaw, com)
        # The batch comes last, as `contacts` has it.
        corners = jnp.moveaxis(fields.vertices - com[:, None], (0, 1), (2, 1))
        sliders = fields._replace(base_half=tuple(fields.base_half.T), vertices=tuple(corners))
        before = (tuple(qpos[:, JOINTS.base].T), (*p.T, yaw))
        twist = tuple(period.twists)
        step = partial(self._step, sliders, twist, physics.timestep)
        base, (x, y, angle) = jax.lax.fori_loop(0, physics.substeps, lambda _, s: step(s), before)
        half = 0.5 * (angle - yaw)
        q = sp.times((jnp.cos(half), 0.0, 0.0, jnp.sin(half)), tuple(free[:, 3:].T))
        origin = jnp.stack([x, y], axis=-1) - planar.rotate(angle, com)
        after = jnp.concatenate(
            [jnp.stack(base, axis=-1), origin, free[:, 2:3], jnp.stack(q, axis=-1)], axis=-1
        )
        seconds = physics.control_period
        moved = (after - qpos)[:, :6] / seconds
        spin = jnp.zeros_like(moved[:, :3]).at[:, 2].set((angle - yaw) / seconds)
        velocity = jnp.concatenate([moved, spin], axis=-1)
        return Driven(Motion(after, velocity, motion.warmstart))

    def _step(
        self, slider: Slider, twist: Vec, dt: float, poses: tuple[Vec, Vec]
    ) -> tuple[Vec, Vec]:
        """Poses of the base and of the object, about its centre of mass, after dt [s] at `twist`.

        Each is x, y [m], yaw [rad] in the world.
        """
        base, thing = poses
        c, s = jnp.cos(base[2]), jnp.sin(base[2])
        apart = (thing[0] - base[0], thing[1] - base[1])
        p = (c * apart[0] + s * apart[1], c * apart[1] - s * apart[0])
        v_x, v_y, omega = twist
        reach = sp.dot(slider.base_half, slider.base_half)
        problem = Problem(
            _contacts(slider, (*p, thing[2] - base[2]), twist),
            jnp.sqrt(v_x * v_x + v_y * v_y + reach * omega * omega + _LEAST_SPEED**2),
            slider.arm,
            slider.friction_robot,
        )
        v = self.solve(problem, (v_x - omega * p[1], v_y + omega * p[0], omega), dt)

        def turned(u: Vec) -> Vec:
            return c * u[0] - s * u[1], s * u[0] + c * u[1], u[2]

        return sp.add(base, sp.scale(dt, turned(twist))), sp.add(thing, sp.scale(dt, turned(v)))

    def solve(self, problem: Problem, v: Vec, dt: float) -> Vec:
        """The object's twist, from a first guess v, both in the base's frame.

        Newton's method starts with friction that sets in slowly, so that no step overshoots. Its
        last step alone is differentiated, with its matrix held: at the solution that gives the
        derivatives of the implicit function.
        """
        held, v = jax.lax.stop_gradient((problem, v))
        widening = self.iterations - _SHARP

        def newton(i: jax.Array, v: Vec) -> Vec:
            slip = self.slip ** jnp.minimum(i / widening, 1.0).astype(v[0].dtype)
            gradient, hessian = self.derivatives(held, v, slip, dt)
            return sp.sub(v, solved(gradient, hessian))

        v = jax.lax.stop_gradient(jax.lax.fori_loop(0, self.iterations, newton, v))
        gradient, hessian = self.derivatives(problem, v, self.slip, dt)
        return sp.sub(v, solved(gradient, jax.lax.stop_gradient(hessian)))

    def derivatives(self, problem: Problem, v: Vec, slip: Any, dt: float) -> tuple[Vec, list[Any]]:
        """Gradient, and the upper entries of the Hessian, of what the object's twist minimises."""
        tiny, friction = slip * problem.speed, problem.friction
        stiff = 1 / problem.speed
        inertia = (stiff, stiff, stiff * problem.arm * problem.arm)
        gradient: Vec = (inertia[0] * v[0], inertia[1] * v[1], inertia[2] * v[2])
        hessian: list[Any] = [inertia[i] if i == j else 0.0 for i, j in _ENTRIES]
        for contact in problem.contacts:
            n, r = contact.normal, contact.r
            t = (-n[1], n[0])
            u = (v[0] - v[2] * r[1] - contact.v[0], v[1] + v[2] * r[0] - contact.v[1])
            v_t = sp.dot(t, u)
            slide = jnp.sqrt(v_t * v_t + tiny * tiny)  # a smooth |v_t|
            inside = -contact.gap - dt * (sp.dot(n, u) - friction * (slide - tiny))
            force, stiffness = _spring(inside, self.depth)
            along = _with_moment(t, r)
            push = sp.sub(_with_moment(n, r), sp.scale(friction * v_t / slide, along))
            gradient = sp.sub(gradient, sp.scale(force, push))
            bend = force * friction * tiny * tiny / (slide * slide * slide)
            hessian = [
                h + dt * stiffness * push[i] * push[j] + bend * along[i] * along[j]
                for h, (i, j) in zip(hessian, _ENTRIES, strict=True)
            ]
        return gradient, hessian


def _contacts(slider: Slider, pose: Vec, twist: Vec) -> list[Contact]:
    """Where a base at `twist` may push the object, at `pose`; all in the base's frame."""
    p_x, p_y, yaw = pose
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    x, y = slider.vertices  # (N, ...) each, from the centre of mass
    here = (p_x + c * x - s * y, p_y + s * x + c * y)
    radius, half = slider.radius, slider.base_half
    if x.shape[0] == 1:
        normal, point, gap = circle_and_rectangle((here[0][0], here[1][0]), radius, half)
        points, gaps = [point], [gap]
    else:
        ahead = (jnp.roll(here[0], -1, axis=0), jnp.roll(here[1], -1, axis=0))
        normal, middles, gaps = polygon_and_rectangle(here, ahead, half)
        gaps = [gap - radius for gap in gaps]
        off = 0.5 * radius
        points = [(q[0] - off * normal[0], q[1] - off * normal[1]) for q in middles]
    return [
        Contact(
            normal,
            (q[0] - p_x, q[1] - p_y),
            (twist[0] - twist[2] * q[1], twist[1] + twist[2] * q[0]),
            gap,
        )
        for q, gap in zip(points, gaps, strict=True)
    ]


def _with_moment(direction: Point, r: Point) -> Vec:
    """A unit force at r and its moment."""
    return (*direction, r[0] * direction[1] - r[1] * direction[0])


def _spring(inside: Any, depth: float) -> tuple[Any, Any]:
    """Force [1] and stiffness [1/m] of a contact `inside` [m] the base.

    Zero up to -depth, of slope 1 / depth from depth on, a parabola between.
    """
    bent = jnp.clip(inside + depth, 0.0, 2 * depth)
    force = bent * bent / (4 * depth) + jnp.maximum(inside - depth, 0.0)
    return force / depth, bent / (2 * depth * depth)


def solved(g: Vec, h: Sequence[Any]) -> Vec:
    """The vector that the symmetric matrix of upper entries h maps to g."""
    a, b, c, d, e, f = h
    l_1, l_2 = b / a, c / a
    d, e = d - l_1 * b, e - l_1 * c
    y = g[1] - l_1 * g[0]
    z = (g[2] - l_2 * g[0] - e / d * y) / (f - l_2 * c - e * e / d)
    y = (y - e * z) / d
    return (g[0] - b * y - c * z) / a, y, z


class QuasistaticEngine(Engine):
    """Planar, without inertia: the fastest, and differentiable in both modes."""

    name = "quasistatic"
    cones = ("elliptic",)  # its friction is the same in all directions
    modes = ("forward", "reverse")
    newton = False  # but by its own rule
    forces = False
    computes_force = False  # only its direction is known, and not the weight that it slides

    def stage(
        self,
        family: str,
        solids: Solid,
        friction: Friction,
        physics: Physics,
        robots: Robot = Robot(),
    ) -> tuple[Quasistatic, Slider]:
        """Return the stage, and the sliders (n, ...) of the worlds; bases follow every twist."""
        assert not robots.driven, "checked by check_robot"
        half = scene.base_half(robots, solids.mass.size)
        return Quasistatic(), sliders(solids, friction.robot, half)

    def contacts(self, stage: Any, corners: int) -> int:
        """Points of contact that the program looks into."""
        return min(corners, 2)


ENGINE = QuasistaticEngine()
