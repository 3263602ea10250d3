"""Pursuit: the simplest law with the observations of RPS.

It moves the contact point straight to the target, and turns to face it. It neither steers nor
realigns, so its failures show what RPS adds. The law and its parameters are ours.

Symbols are those of `rps`: C contact point, T target, d from C to T, e the heading error.
"""

from functools import partial
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp

from rps_jax import spec
from rps_jax.control.base import Law, OmegaMax, SpeedMax, SuccessDistance, bounds_of
from rps_jax.control.observation import Details, Observation, Twist, displacement
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Parameter
from rps_jax.spec import Spec, document, tunable


@document
class PursuitParams(NamedTuple):
    """Parameters of pursuit; the bounds are those of RPS."""

    K_v: Annotated[Parameter, tunable("1/s", "speed over distance", 0.02, 2, log=True, gt=0)] = 0.5
    K_h: Annotated[
        Parameter,
        tunable("1/s", "turning rate over heading error", 0.005, 2, log=True, gt=0),
    ] = 1.0
    press: Annotated[Parameter, tunable("1", "least share of the speed that is forward", 0, 2)] = (
        0.2
    )
    v_max: SpeedMax = 0.05
    omega_max: OmegaMax = 0.15
    v_approach: Annotated[Parameter, Spec("m/s", "forward speed without contact", 0)] = 0.01
    d_success: SuccessDistance = 0.05


check = partial(spec.check, prefix="pursuit.")


def init(params: PursuitParams) -> tuple[()]:
    """Return the empty state."""
    return ()


def step(
    params: PursuitParams, state: tuple[()], obs: Observation
) -> tuple[tuple[()], Twist, Details]:
    """Compute one control step: C moves to T at min(K_v ||d||, v_max); the base turns to T.

    In the robot frame C moves by (max(cos e, press), sin e) times that speed, so that the base
    keeps pressing on the object while it turns. Without contact the base moves straight ahead.
    """
    contact = jnp.where(obs.in_contact, obs.p_robot_contact, 0.0)
    d = displacement(obs._replace(p_robot_contact=contact))
    error = planar.bearing(d, obs.yaw)
    speed = jnp.minimum(params.K_v * planar.norm(d), params.v_max)
    v_contact = speed * jnp.stack([jnp.maximum(jnp.cos(error), params.press), jnp.sin(error)])
    omega = jnp.clip(params.K_h * error, -params.omega_max, params.omega_max)
    push = Twist.from_point_velocity(contact, v_contact, omega)
    push = push.saturate(params.v_max, params.omega_max)
    ahead = Twist(params.v_approach, 0.0, 0.0)
    twist = jax.tree.map(partial(jnp.where, obs.in_contact), push, ahead)
    details = Details.from_obs(obs._replace(p_robot_contact=contact))
    return state, twist, details._replace(gamma=error)


LAW = Law(init, step, check=check, bounds=bounds_of(PursuitParams))
PRESETS = {"pursuit": PursuitParams()}
