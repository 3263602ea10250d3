"""What a base with limits makes of a commanded twist: first where it aims, then how it pushes.

The aim is the twist within the base's speed, followed with its lag and its acceleration. A base
whose force is limited is a body: its drive is a velocity servo with integral action, in the base's
own frame, that pushes with a force and a torque up to their limits. Without a load or with one
below the limit it loses no speed for long; beyond the limit it stalls.
"""

import math
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rps_jax.geometry import planar
from rps_jax.robot.robot import Robot

STALLED = 0.1  # [1] of the speed aimed at, below which a base stands still
_STALL = 1.0  # [s] for which a base has stood still that is said to have stalled
_MOVING = 1e-3  # [m/s] below which nothing is aimed at
Triple = tuple[Any, Any, Any]


class Drive(NamedTuple):
    """What a base with limits remembers."""

    aim: jax.Array  # (3,) [m/s, m/s, rad/s] the twist it is to have, in its own frame
    integral: jax.Array  # (3,) [N, N, N m] of the servo, likewise
    stalled: jax.Array  # () int32 control steps in a row in which it stood still, pushing


def start(like: jax.Array) -> Drive:
    """A base at rest; numbers are of the type of `like`."""
    still = jnp.zeros(3, like.dtype)
    return Drive(still, still, jnp.zeros((), jnp.int32))


def aim(robot: Robot, before: jax.Array, twist: jax.Array, period: float) -> jax.Array:
    """The twist (3,) that the base is to have, after `before` (3,) and commanded `twist` (3,).

    All in the base's frame [m/s, m/s, rad/s]; `period` [s] is that of the control loop.
    """
    if robot.v_max is not None:
        most = jnp.asarray(robot.v_max)
        speed = planar.norm(twist[:2]) if most.ndim == 0 else jnp.abs(twist[:2])
        shares = most / jnp.maximum(speed, 1e-9)  # the direction is kept
        twist = twist.at[:2].multiply(jnp.minimum(1.0, jnp.min(shares)))
    if robot.omega_max is not None:
        twist = twist.at[2].set(jnp.clip(twist[2], -robot.omega_max, robot.omega_max))
    if robot.lag is not None:
        share = 1 - jnp.exp(-period / jnp.maximum(robot.lag, 1e-9))
        twist = before + share * (twist - before)
    if robot.acceleration_max is not None:
        linear, turning = jnp.asarray(robot.acceleration_max) * period
        change = twist - before
        size = planar.norm(change[:2])
        limited = change[:2] * jnp.minimum(1.0, linear / jnp.maximum(size, 1e-12))
        turn = jnp.clip(change[2], -turning, turning)
        twist = before + jnp.concatenate([limited, turn[None]])
    return twist


def carried_out(robot: Robot, aim: jax.Array) -> jax.Array:
    """The twist (3,) of wheels that slip, which the base's own sensors do not see."""
    return aim if robot.slip is None else aim * (1 - robot.slip)


def push(
    robot: Robot,  # whose force is limited
    integral: Triple,  # [N, N, N m] of the servo, in the base's frame
    twist: Triple,  # [m/s, m/s, rad/s] wanted, in the base's frame
    velocity: Triple,  # [m/s, m/s, rad/s] of the base in the world
    turn: tuple[Any, Any],  # cosine and sine of the base's heading
    timestep: float,  # [s] of the physics
    xp: ModuleType = jnp,  # or numpy, whichever the numbers are of
) -> tuple[Triple, Triple]:
    """Force and torque of the drive [N, N, N m] on the base in one physics step, in the world.

    Returns them, and the servo's integral after the step.
    """
    c, s = turn
    errors = (
        twist[0] - (c * velocity[0] + s * velocity[1]),
        twist[1] - (c * velocity[1] - s * velocity[0]),
        twist[2] - velocity[2],
    )
    inertia = (robot.mass, robot.mass, robot.inertia)
    rate = 2 * math.pi * robot.bandwidth  # [rad/s], critically damped
    wanted = [m * 2 * rate * e + i for m, e, i in zip(inertia, errors, integral, strict=True)]
    given = list(wanted)
    if (most := robot.push_max) is not None:
        size = xp.sqrt(wanted[0] * wanted[0] + wanted[1] * wanted[1])
        share = xp.minimum(1.0, most / xp.maximum(size, 1e-9))
        given[:2] = wanted[0] * share, wanted[1] * share
    if (most := robot.turn_max) is not None:
        given[2] = xp.minimum(xp.maximum(wanted[2], -most), most)
    after = tuple(
        i + timestep * (m * rate**2 * e + rate * (g - w))  # the integral forgets what is cut off
        for i, m, e, g, w in zip(integral, inertia, errors, given, wanted, strict=True)
    )
    force = (c * given[0] - s * given[1], s * given[0] + c * given[1], given[2])
    return force, after  # type: ignore[return-value]


def stalled(drive: Drive, qvel: jax.Array) -> Drive:
    """The drive with the control steps counted in which the base stands still, pushing.

    `qvel` (9,) is as of a trial: of the base [m/s, m/s, rad/s] in the world first.
    """
    wanted = planar.norm(drive.aim[:2])
    stands = (planar.norm(qvel[:2]) < STALLED * wanted) & (wanted > _MOVING)
    return drive._replace(stalled=jnp.where(stands, drive.stalled + 1, 0))


def has_stalled(drive: Drive | None, period: float) -> Any:
    """Whether () a base has stood still for a while by now; `period` [s] is of the control loop."""
    return False if drive is None else drive.stalled * period >= _STALL
