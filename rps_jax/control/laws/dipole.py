"""Pushing in a dipole field: the law of Igarashi, Kamiyama and Inami.

"A Dipole Field for Object Delivery by Pushing on a Flat Surface" (ICRA 2010) sends a robot along
the field lines of a dipole in the object that points at its target. Behind the object the field
lines lead forward, and beside it they lead back, so that the robot circles the object without a
plan. With theta the angle at the object from the target to the robot, the robot moves at 2 theta
from the direction to the target (their Fig. 4). The law needs the object's position, which RPS
does not.

As in Heins and Schoellig (2024), the robot aims at a point of a path, `lookahead` ahead of the
object. Our choices: the path is the straight line from the object's first position through the
target, so that the contact point also passes the target; it is replaced when the object has passed
the target by `beyond` radii; the base turns to face the object.
"""

from functools import partial
from typing import Annotated, NamedTuple

import jax.numpy as jnp

from rps_jax import spec
from rps_jax.control.base import Law, OmegaMax, SuccessDistance, bounds_of
from rps_jax.control.observation import Details, PoseObservation, Twist
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Parameter
from rps_jax.spec import Spec, document, tunable


@document
class DipoleParams(NamedTuple):
    """Parameters of the dipole law; the lookahead is that of Heins and Schoellig."""

    K_h: Annotated[
        Parameter,
        tunable("1/s", "turning rate over heading error", 0.02, 5, log=True, gt=0),
    ] = 1.0
    lookahead: Annotated[
        Parameter,
        tunable("m", "distance along the path from object to aim", 0.05, 3, log=True, gt=0),
    ] = 1.0
    beyond: Annotated[
        Parameter, tunable("1", "object radii after which a target is passed", 0, 5)
    ] = 2.0
    v_max: Annotated[Parameter, Spec("m/s", "speed, the bound of RPS", gt=0)] = 0.05
    omega_max: OmegaMax = 0.15
    d_success: SuccessDistance = 0.05


class DipoleState(NamedTuple):
    """State of the law between two control steps."""

    p_world_start: Annotated[Array, Spec("m", "start of the path")]  # (2,)
    started: Annotated[Array, Spec("1", "whether there is a path")]  # () bool


check = partial(spec.check, prefix="dipole.")


def init(params: DipoleParams) -> DipoleState:
    """Return the state without a path."""
    return DipoleState(jnp.zeros(2, jnp.result_type(float)), jnp.zeros((), bool))


def step(
    params: DipoleParams, state: DipoleState, obs: PoseObservation
) -> tuple[DipoleState, Twist, Details]:
    """Compute one control step: along the field line through the robot, facing the object."""
    touch, p_world_object = obs.touch, obs.p_world_object

    def path_direction(start: Array) -> Array:
        return planar.unit(planar.direction(touch.p_world_target - start))

    past = jnp.sum((p_world_object - touch.p_world_target) * path_direction(state.p_world_start))
    is_new = ~state.started | (past > params.beyond * obs.r_object)
    start = jnp.where(is_new, p_world_object, state.p_world_start)
    along = path_direction(start)
    aim = start + (jnp.sum((p_world_object - start) * along) + params.lookahead) * along

    to_aim = planar.direction(aim - p_world_object)
    from_object = touch.p_world_robot - p_world_object
    theta = planar.bearing(from_object, to_aim)
    heading = to_aim + 2 * theta - touch.yaw
    error = planar.bearing(-from_object, touch.yaw)
    v_x, v_y = params.v_max * jnp.cos(heading), params.v_max * jnp.sin(heading)
    twist = Twist(v_x, v_y, params.K_h * error).saturate(params.v_max, params.omega_max)
    return DipoleState(start, jnp.ones_like(state.started)), twist, Details.from_obs(touch)


LAW = Law(init, step, "pose", check=check, bounds=bounds_of(DipoleParams))
PRESETS = {"dipole": DipoleParams()}
