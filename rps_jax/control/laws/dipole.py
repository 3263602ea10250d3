"""Pushing in a dipole field: the law of Igarashi, Kamiyama and Inami.

"A Dipole Field for Object Delivery by Pushing on a Flat Surface" (ICRA 2010) sends a robot along
the field lines of a dipole that lies in the object and points at its target: seen from behind the
object they lead straight on, beside it they lead back, so that the robot goes round without a
plan. With theta the angle at the object from the target to the robot, the robot moves at 2 theta
from the direction to the target (their Fig. 4). It needs what RPS does not: the object's place.

As Heins and Schoellig (2024) use it, the robot aims at a point of a path that lies `lookahead`
before the object. Our choices: the path is the straight line from where the object was first to the
target and on, so that the contact point, too, passes the target; it is laid anew when the object
has passed it by `beyond` radii; the base turns to face the object.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rps_jax.control.base import Bound, Law, check_signs, document_fields
from rps_jax.control.observation import Details, PoseObservation, Twist
from rps_jax.geometry import planar


@document_fields
class DipoleParams(NamedTuple):
    """Parameters about the dipole field, which has none itself; the lookahead is H. and S.'s."""

    K_h: float | jax.Array = 1.0  # [1/s] turning rate over heading error
    lookahead: float | jax.Array = 1.0  # [m] of the path before the object, to be aimed at
    beyond: float | jax.Array = 2.0  # [1] object radii after which a target is passed
    v_max: float | jax.Array = 0.05  # [m/s] speed, the bound of RPS
    omega_max: float | jax.Array = 0.15  # [rad/s] bound on |omega|
    d_success: float | jax.Array = 0.05  # [m] target reached


BOUNDS = {
    "K_h": Bound(0.02, 5, log=True),  # [1/s]
    "lookahead": Bound(0.05, 3, log=True),  # [m]
    "beyond": Bound(0, 5),  # [1]
}


class DipoleState(NamedTuple):
    """What the law remembers between two control steps."""

    p_world_start: jax.Array  # (2,) [m] where the path begins
    started: jax.Array  # () bool


_POSITIVE = ("K_h", "lookahead", "v_max", "omega_max", "d_success")
check = partial(check_signs, "dipole", _POSITIVE)


def init(params: DipoleParams) -> DipoleState:
    """Return a state without a path."""
    return DipoleState(jnp.zeros(2, jnp.result_type(float)), jnp.zeros((), bool))


def step(
    params: DipoleParams, state: DipoleState, obs: PoseObservation
) -> tuple[DipoleState, Twist, Details]:
    """One control step: along the field line through the robot, facing the object."""
    touch, p_world_object = obs.touch, obs.p_world_object

    def along(start: jax.Array) -> jax.Array:
        angle = planar.direction(touch.p_world_target - start)
        return jnp.stack([jnp.cos(angle), jnp.sin(angle)])

    past = jnp.sum((p_world_object - touch.p_world_target) * along(state.p_world_start))
    anew = ~state.started | (past > params.beyond * obs.r_object)
    start = jnp.where(anew, p_world_object, state.p_world_start)
    way = along(start)
    aim = start + (jnp.sum((p_world_object - start) * way) + params.lookahead) * way

    to_aim = planar.direction(aim - p_world_object)
    from_object = touch.p_world_robot - p_world_object
    theta = planar.wrap(planar.direction(from_object) - to_aim)
    heading = to_aim + 2 * theta - touch.yaw
    error = planar.wrap(planar.direction(-from_object) - touch.yaw)
    twist = Twist(
        params.v_max * jnp.cos(heading), params.v_max * jnp.sin(heading), params.K_h * error
    ).saturate(params.v_max, params.omega_max)
    return DipoleState(start, jnp.ones_like(state.started)), twist, Details.from_obs(touch)


LAW = Law(init, step, "pose", check=check, bounds=tuple(BOUNDS.items()))
PRESETS = {"dipole": DipoleParams()}
