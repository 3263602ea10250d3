"""Pushing in a dipole field: the law of Igarashi, Kamiyama and Inami.

"A Dipole Field for Object Delivery by Pushing on a Flat Surface" (ICRA 2010) sends a robot along
the field lines of a dipole that lies in the object and points at its target: seen from behind the
object they lead straight on, beside it they lead back, so that the robot goes round without a
plan. With theta the angle at the object from the target to the robot, the robot moves at 2 theta
from the direction to the target (their Fig. 4). It needs what RPS does not: the object's place.

Our choices, since their robot is round and the paper's rule asks for the contact point at the
target: the base turns to face the object, and aims beyond the target as our APS does.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rps_jax import errors
from rps_jax.control import aps
from rps_jax.control.aps import TrackedObservation
from rps_jax.control.bounds import Bound
from rps_jax.control.law import Details, Twist
from rps_jax.geometry import planar


class DipoleParams(NamedTuple):
    """Parameters of the dipole field, which has none itself: all are ours."""

    K_h: float | jax.Array = 1.0  # [1/s] turning rate over heading error
    aim_beyond: float | jax.Array = 1.0  # [1] object radii beyond the target; 0: as published
    v_max: float | jax.Array = 0.05  # [m/s] speed, the bound of RPS
    omega_max: float | jax.Array = 0.15  # [rad/s] bound on |omega|
    d_success: float | jax.Array = 0.05  # [m] target reached


BOUNDS = {
    "K_h": Bound(0.02, 5, log=True),  # [1/s]
    "aim_beyond": Bound(0, 2),  # [1]
}


def check(params: DipoleParams) -> DipoleParams:
    """The same parameters, if scalars that mean something.

    Raises:
      InputError: a value is not a finite number, or is out of bounds.
    """
    for name in params._fields:
        bounds = {"at_least": 0} if name == "aim_beyond" else {"above": 0}
        errors.check_finite(f"dipole.{name}", getattr(params, name), **bounds)
    return params


def init(params: DipoleParams) -> tuple[()]:
    """It remembers nothing."""
    return ()


def step(
    params: DipoleParams, state: tuple[()], observation: TrackedObservation
) -> tuple[tuple[()], Twist, Details]:
    """One control step: along the field line through the robot, facing the object."""
    seen = observation.touch
    aim = aps.aim(params.aim_beyond, observation)
    to_target = planar.direction(aim - observation.p_world_object)
    from_object = seen.p_world_robot - observation.p_world_object
    theta = planar.wrap(planar.direction(from_object) - to_target)
    heading = to_target + 2 * theta - seen.yaw
    error = planar.wrap(planar.direction(-from_object) - seen.yaw)
    twist = Twist(
        params.v_max * jnp.cos(heading), params.v_max * jnp.sin(heading), params.K_h * error
    ).within(params.v_max, params.omega_max)
    return state, twist, Details.of(seen)
