"""Force Push as published, with a force sensor: the law of Heins and Schoellig.

"Force Push: Robust Single-Point Pushing with Force Feedback" (IEEE RA-L 9, 2024) pushes an object
with one point along a path. With theta_d the direction of the path, theta_f the angle of the
contact force on the object from it and Delta the offset of the contact to the left of the path,
the point moves at the angle

    theta_p = (1 + k_theta) theta_f + k_y Delta        (`force_push.steer`)

from the path. A force below f_min counts as no contact; then theta_p tends to -k_y Delta, back to
the path, at a bounded rate. An admittance reduces the velocity by k_f times the force above f_max
(`yield_to_force`). We wrote this from the paper's equations and compared it with its authors' code.

Our base is not a point, so we made these choices. The moving point is the contact reported by the
skin. The path is the straight line from the first contact to the target, and is replaced when the
contact has passed the target or the target has left it. Before the first contact the base moves
straight ahead; after it, until it senses a force, along the path, as theirs. As in their
experiments, the base turns to face along the path with gain k_omega; their controller trades this
against speed in a quadratic program. The speed bound is that of RPS, half of theirs, and so is k_f.
One step of ours is two of theirs, so `converge` is a rate. We omit their first second of
acceleration.
"""

from functools import partial
from typing import Annotated, NamedTuple

import jax.numpy as jnp

from rps_jax import spec
from rps_jax.control.base import ApproachSpeed, Law, OmegaMax, SuccessDistance, bounds_of
from rps_jax.control.laws import force_push
from rps_jax.control.laws.force_push import AngleGain, ContactSpeed, HeadingGain, Path
from rps_jax.control.observation import Details, ForceObservation, Twist
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Parameter
from rps_jax.spec import Spec, document, tunable


@document
class PublishedForcePushParams(NamedTuple):
    """Parameters of Force Push, as in its authors' experiments; f_min as in their simulations."""

    k_theta: AngleGain = 0.3
    k_y: Annotated[
        Parameter, tunable("rad/m", "gain of the path; 0.1 in their simulations", -2, 2, ge=None)
    ] = 0.5
    k_omega: HeadingGain = 1.0
    converge: Annotated[
        Parameter,
        tunable("rad/s", "largest rate of theta_p without a force", 0.1, 100, log=True),
    ] = 10.0
    f_min: Annotated[
        Parameter,
        tunable("N", "least force of a contact; 5 N in their experiments", 0.1, 20, log=True),
    ] = 1.0
    f_max: Annotated[
        Parameter,
        tunable("N", "force above which the base yields", 10, 1000, log=True),
    ] = 50.0
    k_f: Annotated[
        Parameter,
        tunable("m/s/N", "admittance; 0.003 at their speed of 0.1 m/s", 1e-5, 0.02, log=True),
    ] = 0.0015
    v_max: ContactSpeed = 0.05
    omega_max: OmegaMax = 0.15
    v_approach: ApproachSpeed = 0.01
    d_success: SuccessDistance = 0.05


class PublishedForcePushState(NamedTuple):
    """State of the law between two control steps."""

    path: Path
    theta_p: Annotated[Array, Spec("rad", "angle of the last push from the path")]  # ()
    pushed: Annotated[Array, Spec("1", "whether a contact and a force were sensed")]  # () bool


check = partial(spec.check, prefix="force_push_published.")


def init(params: PublishedForcePushParams) -> PublishedForcePushState:
    """Return the state before any contact."""
    zero = jnp.zeros_like(jnp.asarray(params.v_max, float))
    return PublishedForcePushState(Path.initial(zero.dtype), zero, jnp.zeros((), bool))


def yield_to_force(params: PublishedForcePushParams, v_world: Array, f_world: Array) -> Array:
    """Return the contact's velocity (2,) [m/s], reduced where the force (2,) [N] is too large."""
    size = planar.norm(f_world)
    over = jnp.maximum(size - params.f_max, 0.0)
    v_world = v_world - params.k_f * over * f_world / jnp.maximum(size, 1e-9)
    return v_world * jnp.minimum(1.0, params.v_max / jnp.maximum(planar.norm(v_world), 1e-9))


def step(
    params: PublishedForcePushParams, state: PublishedForcePushState, obs: ForceObservation
) -> tuple[PublishedForcePushState, Twist, Details]:
    """Compute one control step; before the first contact the base moves straight ahead."""
    touch = obs.touch
    path, filled, offset = state.path.update(touch)
    f_world = -planar.rotate(touch.yaw, obs.f_robot)  # on the object
    in_contact = planar.norm(f_world) >= params.f_min
    pushed = path.touched & (state.pushed | in_contact)
    theta_f = planar.bearing(f_world, path.theta_d)
    limit = params.converge * touch.period
    theta_p = force_push.steer(params, state.theta_p, theta_f, offset, limit, in_contact)
    theta_p = jnp.where(pushed, theta_p, 0.0)
    v_world = params.v_max * planar.unit(path.theta_d + theta_p)
    v_robot = planar.rotate(-touch.yaw, yield_to_force(params, v_world, f_world))
    twist = path.twist(params, v_robot, touch.yaw)
    details = Details.from_obs(filled)._replace(gamma=theta_p)
    return PublishedForcePushState(path, theta_p, pushed), twist, details


LAW = Law(init, step, "force", check=check, bounds=bounds_of(PublishedForcePushParams))
PRESETS = {"force_push_published": PublishedForcePushParams()}
