"""The base: what it senses of itself, the twist it aims at, and the force with which it pushes.

The base senses its pose by odometry, and the object's force by a load cell, and its commands are
delayed. The engines compute the force of the object on the base. A real load cell adds noise,
filters, and reports nothing below a threshold. The paper's robot has no load cell; these numbers
are ours, of the size that data sheets of wrist sensors give.

The aim is the commanded twist within the speed limits, followed with lag and limited acceleration.
A base with a force limit is a body. Its drive is a velocity servo with integral action in the
base's frame, with a bounded force and torque. Below the limit a load slows the base only briefly;
above the limit the base stalls.

The axle of a differential drive or a car does not move sideways. With the axle `a` behind the
origin, the base has two velocities, v and omega, and its twist is (v, a omega, omega). A car also
has |omega| <= |v| / R, with the least turning radius R of its axle. All commands, errors, limits,
slip and forces act on v and omega, or on the two wheels, whose speeds are v -+ omega track / 2.
Where a limit bounds a speed, v and omega are scaled together, so that the curvature stays. The
tyres hold the axle with any force.
"""

from __future__ import annotations

import math
from functools import reduce
from types import ModuleType
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from rps_jax import spec
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Number, Pair, Scalar
from rps_jax.geometry.vectors import Point, Vec, sub, turned, turned_back
from rps_jax.robot.robot import Robot
from rps_jax.spec import Spec

_ODOMETRY, _FORCE = 7, 11  # folded into a world's key; the skin splits it into fewer


class Odometry(NamedTuple):
    """Errors of the base: of the pose that the law observes, and of the executed twist.

    Latencies and delays are rounded to control steps. The length K of `past` is the number of
    remembered steps, more than the longest latency or delay; with K = 0 the base is perfect.
    """

    pose_noise: Annotated[Number, Spec("m", "standard deviation of each position reading", 0)] = (
        0.0  # ()
    )
    yaw_noise: Annotated[Number, Spec("rad", "standard deviation of each heading reading", 0)] = (
        0.0  # ()
    )
    pose_latency: Annotated[Number, Spec("s", "age of the pose that the law observes", 0)] = 0.0
    command_delay: Annotated[Number, Spec("s", "time between a command and its execution", 0)] = (
        0.0  # ()
    )
    velocity_error: Annotated[
        Number, Spec("1", "error of each component of the twist, or of two wheels")
    ] = 0.0  # (3,)
    past: np.ndarray | Array = np.zeros(0)  # (K,)


def observe_pose(
    odometry: Odometry,
    poses: Array,
    pose: Array,
    key: Array,
    steps: Array,
    period: float,
) -> Pair:
    """Return the latest poses (K, 3), the current `pose` (3,) first, and the observed pose (3,).

    Poses are [m, m, rad]. `steps` () control steps of `period` [s] are done.
    """
    if not poses.shape[0]:
        return poses, pose
    poses, late = delayed(poses, pose, odometry.pose_latency, period)
    noise = jax.random.fold_in(jax.random.fold_in(key, _ODOMETRY), steps)
    sigma = jnp.stack([odometry.pose_noise] * 2 + [odometry.yaw_noise])
    return poses, late + sigma * normal(noise, (3,), pose.dtype)


def low_pass(old: Array, new: Array, period: Scalar, time_constant: Number) -> Array:
    """Return the output of a filter of first order, after a `period` [s] at the input `new`."""
    return old + (1 - jnp.exp(-period / time_constant)) * (new - old)


def normal(key: Array, shape: tuple[int, ...], dtype: DTypeLike) -> Array:
    """Return normal numbers that are equal in single and double precision."""
    return jax.random.normal(key, shape, jnp.float32).astype(dtype)


def delayed(latest: Array, new: Array, delay: Number, period: float) -> Pair:
    """Return the latest values (K, n), `new` (n,) first, and the value (n,) a delay [s] before.

    There is a value for each control step of `period` [s].
    """
    latest = jnp.concatenate([new[None], latest[:-1]])
    return latest, latest[jnp.round(delay / period).astype(jnp.int32)]


# --- the load ------------------------------------------------------------------------------


class LoadCell(NamedTuple):
    """A sensor of the planar force on the base; static, and so plain numbers."""

    noise: Annotated[
        float, Spec("N", "standard deviation of each raw reading, of both components", 0)
    ] = 1.0
    # From Heins and Schoellig (2024).
    time_constant: Annotated[float, Spec("s", "time constant of the low-pass filter", gt=0)] = 0.05
    threshold: Annotated[float, Spec("N", "filtered force below which the reading is zero", 0)] = (
        2.0
    )

    def check(self) -> None:
        """Raise InputError for noise, filter or threshold that no sensor can have."""
        spec.check(self, "load cell ")

    def read(self, load: Load, key: Array, steps: Array, period: float) -> tuple[Load, Array]:
        """Read the force (2,) [N] of the object on the base, in the base's frame.

        The reading follows `steps` () control steps, `period` [s] after the previous one.
        """
        noise = jax.random.fold_in(jax.random.fold_in(key, _FORCE), steps)
        signal = load.signal
        raw = load.wrench[:2] + self.noise * normal(noise, (2,), signal.dtype)
        signal = low_pass(signal, raw, period, self.time_constant)
        above = jnp.sum(signal * signal) >= self.threshold**2
        return load._replace(signal=signal), jnp.where(above, signal, 0.0)


class Load(NamedTuple):
    """State of a load cell between two readings."""

    # In the base's frame.
    wrench: Annotated[
        Array, Spec("N, N, N m", "wrench of the object on the base in the last period")
    ]  # (3,)
    signal: Annotated[Array, Spec("N", "filtered force")]  # (2,)


def init_load(template: Array) -> Load:
    """Return the state before the first reading, in the precision of `template`."""
    return Load(jnp.zeros(3, template.dtype), jnp.zeros(2, template.dtype))


# --- the drive -----------------------------------------------------------------------------

STALLED = 0.1  # [1] share of the executed speed below which a base stands still
STALL = 1.0  # [s] of standing still after which a base has stalled
_MOVING = 1e-3  # [m/s] executed speed above which a base can stall
GRIP = 1e3  # [1] mass of a base sideways, over its own mass


class Drive(NamedTuple):
    """State of the drive of a base with limits."""

    aim: Array  # (3,) [m/s, m/s, rad/s] the aimed twist, in the base's frame
    integral: Array  # (3,) [N, N, N m] of the servo, in the base's frame
    stalled: Array  # () int32 consecutive control steps in which it stood still, pushing


def init_drive(template: Array) -> Drive:
    """Return the drive of a base at rest, in the precision of `template`."""
    still = jnp.zeros(3, template.dtype)
    return Drive(still, still, jnp.zeros((), jnp.int32))


def aim(robot: Robot, previous: Array, twist: Array, period: float) -> Array:
    """Return the aimed twist (3,), after the `previous` aim (3,) and a commanded `twist` (3,).

    Twists are in the base's frame [m/s, m/s, rad/s]; `period` [s] is the control period.
    """
    if robot.drive != "omni":
        return _aim_axle(robot, previous, twist, period)
    if robot.v_max is not None:
        v_max = jnp.asarray(robot.v_max)
        speed = planar.norm(twist[:2]) if v_max.ndim == 0 else jnp.abs(twist[:2])
        shares = v_max / jnp.maximum(speed, 1e-9)  # the direction is kept
        twist = twist.at[:2].set(twist[:2] * jnp.minimum(1.0, jnp.min(shares)))
    if robot.omega_max is not None:
        twist = twist.at[2].set(jnp.clip(twist[2], -robot.omega_max, robot.omega_max))
    if robot.lag is not None:
        twist = low_pass(previous, twist, period, jnp.maximum(robot.lag, 1e-9))
    if robot.acceleration_max is not None:
        linear, turning = jnp.asarray(robot.acceleration_max) * period
        change = twist - previous
        size = planar.norm(change[:2])
        limited = change[:2] * jnp.minimum(1.0, linear / jnp.maximum(size, 1e-12))
        turn = jnp.clip(change[2], -turning, turning)
        twist = previous + jnp.concatenate([limited, turn[None]])
    return twist


def _aim_axle(robot: Robot, previous: Array, twist: Array, period: float) -> Array:
    """Return the aim of a base whose axle cannot move sideways: see `aim`."""

    def scaled(motion: Array, *limits: Number | None) -> Array:
        """Return (v, omega) with bounded |v|, |omega| and speeds of both wheels."""
        v, omega = jnp.abs(motion)
        sizes = v, omega, v + robot.half_track * omega
        pairs = zip(sizes, limits, strict=True)
        shares = [x / jnp.maximum(size, 1e-9) for size, x in pairs if x is not None]
        return motion * reduce(jnp.minimum, shares, 1.0)

    v_max = None if robot.v_max is None else jnp.ravel(jnp.asarray(robot.v_max))[0]
    old, motion = jnp.stack([previous[0], previous[2]]), _steered(robot, twist[0], twist[2])
    motion = scaled(motion, v_max, robot.omega_max, robot.wheel_speed_max)
    if robot.lag is not None:
        motion = low_pass(old, motion, period, jnp.maximum(robot.lag, 1e-9))
    bounds = (None, None) if robot.acceleration_max is None else robot.acceleration_max
    limits = *bounds, robot.wheel_acceleration_max
    steps = (None if x is None else x * period for x in limits)
    v, omega = _steered(robot, *(old + scaled(motion - old, *steps)))
    return jnp.stack([v, robot.axle_behind * omega, omega])


def _steered(robot: Robot, v: Array, omega: Array) -> Array:
    """Return (v, omega) within the turning radius."""
    if robot.turning_radius is not None:
        bound = jnp.abs(v) / robot.turning_radius
        omega = jnp.clip(omega, -bound, bound)
    return jnp.stack([v, omega])


def apply_errors(robot: Robot | None, twist: Array, errors: Number) -> Array:
    """Return a commanded twist (3,) with the relative errors (3,) [1] of a drive.

    They are those of the twist's components, or of the two wheels of a differential drive.
    """
    if robot is None or robot.drive != "differential":
        return twist * (1 + errors)
    turn, (of_left, _, of_right) = robot.half_track * twist[2], jnp.asarray(errors)
    left, right = (twist[0] - turn) * (1 + of_left), (twist[0] + turn) * (1 + of_right)
    omega = (right - left) / (2 * robot.half_track)
    return jnp.stack([(left + right) / 2, robot.axle_behind * omega, omega])


def apply_slip(robot: Robot, aim: Array) -> Array:
    """Return the twist (3,) of wheels that slip, which the base's own sensors do not measure."""
    shares = [robot.slip if x is None else x for x in (None, robot.slip_sideways, robot.slip_yaw)]
    if all(share is None for share in shares):
        return aim
    slips = jnp.stack([v if s is None else v * (1 - s) for v, s in zip(aim, shares, strict=True)])
    return slips if robot.drive == "omni" else slips.at[1].set(robot.axle_behind * slips[2])


def push(
    robot: Robot,  # with a force limit
    integral: Vec,  # [N, N, N m] of the servo, in the base's frame
    twist: Vec,  # [m/s, m/s, rad/s] aimed, in the base's frame
    velocity: Vec,  # [m/s, m/s, rad/s] of the base, in the world's frame
    turn: Point,  # cosine and sine of the base's heading
    timestep: float,  # [s] of the physics
    xp: ModuleType = jnp,  # or numpy, for numbers on the host
) -> tuple[Vec, Vec]:
    """Compute one physics step of the servo.

    Returns:
      Force and torque [N, N, N m] of the drive on the base, in the world's frame; and the integral
      after the step.
    """
    errors = sub(twist, turned_back(turn, velocity))
    inertia = (robot.mass, robot.mass, robot.inertia)
    if robot.drive != "omni":
        errors = _axle_errors(robot, twist, errors, xp)
        inertia = (robot.mass, robot.mass, robot.inertia + robot.mass * robot.axle_behind**2)
    rate = 2 * math.pi * robot.bandwidth  # [rad/s], critically damped
    demand = [m * 2 * rate * e + i for m, e, i in zip(inertia, errors, integral, strict=True)]
    ahead, left, torque = demand
    if (limit := robot.push_max) is not None:
        square = ahead * ahead + left * left
        size = xp.sqrt(xp.maximum(square, 1e-18))  # the square root of 0 has no derivative
        share = xp.minimum(1.0, limit / size)
        ahead, left = ahead * share, left * share
    if (limit := robot.turn_max) is not None:
        torque = xp.minimum(xp.maximum(torque, -limit), limit)
    output = ahead, left, torque
    x, y, z = (
        i + timestep * (m * rate**2 * e + rate * (u - d))  # anti-windup: u - d is the cut-off part
        for i, m, e, u, d in zip(integral, inertia, errors, output, demand, strict=True)
    )
    return turned(turn, output), (x, y, z)


def _axle_errors(robot: Robot, twist: Vec, errors: Vec, xp: ModuleType) -> Vec:
    """Return the velocity errors that motors act on: none sideways, which is the tyres' task.

    A car that is slower than its aim turns less, with the same curvature.
    """
    ahead, left, turn = errors
    if robot.turning_radius is not None:
        speed = xp.where(xp.abs(twist[0]) < 1e-9, 1e-9, twist[0])
        share = xp.clip(1 - ahead / speed, 0.0, 1.0)
        turn = turn - (1 - share) * twist[2]
    return ahead, 0.0 * left, turn


class Tyres(NamedTuple):
    """Hold of an axle: sideways, the base has a very large mass, and an acceleration to rest."""

    mass: Number  # () [kg] that is added along `sideways`
    sideways: Vec  # [1, 1, m] of the axle at the end of the step: its product with a velocity
    rest: Number  # () [m/s^2] that leaves no sideways velocity after the step

    @classmethod
    def of(cls, robot: Robot, velocity: Vec, turn: Point, dt: float) -> Tyres:
        """Return the tyres of a base with a `velocity` in the world, for a step of `dt` [s].

        `turn` has the cosine and sine of the heading at the start of the step.
        """
        (c, s), angle = turn, velocity[2] * dt
        sideways = -(s + angle * c), c - angle * s, -robot.axle_behind
        speed = sum(a * b for a, b in zip(sideways, velocity, strict=True))
        return cls(GRIP * robot.mass, sideways, -speed / dt)

    @property
    def force(self) -> Vec:
        """Force and torque [N, N, N m] of the tyres on a base with their mass."""
        return self.along(self.mass * self.rest)

    def along(self, size: Number) -> Vec:
        """Return a force of a size [N] on the axle, sideways, as force and torque on the base."""
        x, y, z = (size * entry for entry in self.sideways)
        return x, y, z


def count_stalled_steps(robot: Robot, drive: Drive, qvel: Array) -> Drive:
    """Return the drive with the count of control steps in which the base stands still, pushing.

    `qvel` (9,) is that of a trial: the base's velocity [m/s, m/s, rad/s] in the world comes first.
    """
    speed = planar.norm(apply_slip(robot, drive.aim)[:2])
    stands = (planar.norm(qvel[:2]) < STALLED * speed) & (speed > _MOVING)
    return drive._replace(stalled=jnp.where(stands, drive.stalled + 1, 0))
