"""APS, the adaptive pushing skill: the paper's baseline that knows the object's position.

Krivic and Piater, "Pushing corridors for delivering unknown objects with a mobile robot"
(Autonomous Robots 43, 2019). APS learns from which side to push while it orbits the object. It
needs the object's position, which RPS does not. (The other baseline, NPS, is RPS with
`reactive=0`.)

The published law brings the object's centre O to the target. The paper's criterion of success
uses the contact point, about one radius behind O. We therefore aim the same distance beyond the
target (`aim_beyond`); without this choice no trial succeeds by that criterion.

Symbols: O object, R robot, T target. alpha is the angle at O from T to R, so that at alpha = pi
the robot is behind the object, as seen from the target.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated, NamedTuple

import jax.numpy as jnp

from rps_jax import spec
from rps_jax.control.base import Law, OmegaMax, SpeedMax, SuccessDistance
from rps_jax.control.observation import Details, PoseObservation, Twist, displacement
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Pair, Parameter
from rps_jax.robot.shell import HALF_LENGTH
from rps_jax.spec import Spec, document


@document
class APSParams(NamedTuple):
    """Parameters of APS; those marked (ours) are ours, since the publication does not give them."""

    K1: Annotated[Parameter, Spec("1", "gain of the mean motion error", 0)] = 0.05
    K2: Annotated[Parameter, Spec("1", "gain of the motion error", 0)] = 0.1
    K_p: Annotated[Parameter, Spec("1/s", "heading gain", 0)] = 0.6
    K_d: Annotated[Parameter, Spec("1", "heading rate gain", 0)] = 0.4
    yaw_error_max: Annotated[
        Parameter, Spec("rad", "heading error above which the robot turns in place", 0)
    ] = 0.3
    margin: Annotated[Parameter, Spec("m", "gap above which the robot approaches straight", 0)] = (
        0.10
    )
    r_robot: Annotated[
        Parameter, Spec("m", "equivalent radius of a rectangular base (ours)", 0)
    ] = HALF_LENGTH
    gamma_drop: Annotated[
        Parameter, Spec("rad", "decrease of |gamma| after which alpha is good", 0)
    ] = 0.01
    alpha_mean: Annotated[Parameter, Spec("rad", "prior mean of good alphas", 0)] = jnp.pi
    alpha_variance: Annotated[Parameter, Spec("rad^2", "prior variance", gt=0)] = jnp.pi / 4
    alpha_count: Annotated[Parameter, Spec("1", "weight of the prior", gt=0)] = 100.0
    aim_beyond: Annotated[
        Parameter, Spec("1", "object radii beyond the target (ours); 0: as published", 0)
    ] = 1.0
    min_motion: Annotated[Parameter, Spec("m", "least motion of the object (ours)", 0)] = 0.001
    v_max: SpeedMax = 0.05
    v_min: Annotated[Parameter, Spec("m/s", "least speed (ours)", 0)] = 0.01
    omega_max: OmegaMax = 0.15
    d_success: SuccessDistance = 0.05


class APSState(NamedTuple):
    """State of APS between two control steps."""

    p_world_object: Annotated[Array, Spec("m", "O at its last motion")]  # (2,)
    a_OT: Annotated[Array, Spec("rad", "direction from there to T")]  # ()
    started: Annotated[Array, Spec("1", "whether the fields above are set")]  # () bool
    alpha: Annotated[Array, Spec("rad", "alpha of the last step")]  # ()
    gamma: Annotated[Array, Spec("rad", "the last motion error")]  # ()
    gamma_mean: Annotated[Array, Spec("rad", "m_gamma, mean motion error")]  # ()
    gamma_count: Annotated[Array, Spec("1", "number of motion errors in gamma_mean")]  # ()
    mean: Annotated[Array, Spec("rad", "m, running mean of good alphas")]  # ()
    variance: Annotated[Array, Spec("rad^2", "s2, running variance of good alphas")]  # ()
    weight: Annotated[Array, Spec("1", "number of alphas in mean and variance")]  # ()
    yaw_error: Annotated[Array, Spec("rad", "heading error of the last step")]  # ()

    @classmethod
    def init(cls, params: APSParams) -> APSState:
        """Return the state before the first observation, with the prior alone."""
        zero = jnp.zeros_like(jnp.asarray(params.K1, float))
        fresh = cls(*[zero] * len(cls._fields))
        return fresh._replace(
            p_world_object=jnp.zeros(2, zero.dtype),
            started=zero > 0,
            mean=zero + params.alpha_mean,
            variance=zero + params.alpha_variance,
            weight=zero + params.alpha_count,
        )


check = partial(spec.check, prefix="aps.")


def predictive(params: APSParams, state: APSState) -> Pair:
    """Return mean [rad] and variance [rad^2] of the next good alpha (Gaussian, unknown mean)."""
    precision = 1 / params.alpha_variance + state.weight / state.variance
    mean = params.alpha_mean / params.alpha_variance + state.weight * state.mean / state.variance
    return mean / precision, 1 / precision + state.variance


def activations(params: APSParams, state: APSState, alpha: Array, near: Array) -> Pair:
    """Return (psi_push, psi_relocate) [1] at alpha [rad]; the robot approaches unless `near`.

    Like the released controller, we divide by the predictive variance, not by its square root.
    """
    mean, variance = predictive(params, state)
    peak = jnp.exp(-0.5 * ((alpha - mean) / variance) ** 2)
    push = jnp.minimum(peak, jnp.abs(jnp.cos(alpha)))
    relocate = planar.safe_sqrt(1 - push * push)
    back_off = jnp.where(jnp.cos(alpha) > 0, -push, push)  # on the target's side
    return jnp.where(near, back_off, 1.0), jnp.where(near, relocate, 0.0)


def _learn(params: APSParams, state: APSState, p_world_object: Array, a_OT: Array) -> APSState:
    """Return the state after an observation of the object, which may have moved."""
    motion = p_world_object - state.p_world_object
    moved = state.started & (planar.norm(motion) > params.min_motion)
    gamma = planar.wrap(state.a_OT - planar.direction(motion))
    gamma_count = state.gamma_count + 1
    good = moved & (jnp.abs(gamma) < jnp.abs(state.gamma) - params.gamma_drop)
    good &= state.gamma_count > 0
    count = state.weight + 1
    offset = state.alpha - state.mean
    mean = state.mean + offset / count
    variance = state.variance + (offset * (state.alpha - mean) - state.variance) / count
    gamma_mean = state.gamma_mean + (gamma - state.gamma_mean) / gamma_count

    def where(condition: Array, **new: Array) -> dict[str, Array]:
        return {key: jnp.where(condition, x, getattr(state, key)) for key, x in new.items()}

    return state._replace(
        started=jnp.ones_like(state.started),
        **where(moved | ~state.started, p_world_object=p_world_object, a_OT=a_OT),
        **where(moved, gamma=gamma, gamma_mean=gamma_mean, gamma_count=gamma_count),
        **where(good, mean=mean, variance=variance, weight=count),
    )


def step(
    params: APSParams, state: APSState, obs: PoseObservation
) -> tuple[APSState, Twist, Details]:
    """Compute one control step of APS.

    Between the object and the target the robot backs off while it orbits, unless it is so far
    away that it approaches.
    """
    touch = obs.touch
    # The aim is beyond the target, on the line from the contact or the object.
    of_contact = planar.direction(displacement(touch))
    of_object = planar.direction(touch.p_world_target - obs.p_world_object)
    angle = jnp.where(touch.in_contact, of_contact, of_object)
    beyond = params.aim_beyond * obs.r_object
    to_target = touch.p_world_target + beyond * planar.unit(angle) - obs.p_world_object
    from_object = touch.p_world_robot - obs.p_world_object
    a_OT = planar.direction(to_target)
    first = ~state.started
    state = _learn(params, state, obs.p_world_object, a_OT)

    alpha = jnp.mod(planar.direction(from_object) - a_OT, 2 * jnp.pi)
    r_robot = params.r_robot if touch.base_radius is None else touch.base_radius
    near = planar.norm(from_object) <= r_robot + obs.r_object + params.margin
    push, relocate = activations(params, state, alpha, near)
    radial = -planar.unit(alpha)  # towards the object
    orbit = jnp.sign(jnp.sin(alpha)) * jnp.stack([-jnp.sin(alpha), jnp.cos(alpha)])  # to alpha = pi
    heading = planar.direction(push * radial + relocate * orbit)
    correction = params.K1 * state.gamma_mean + params.K2 * state.gamma
    heading = heading - jnp.where(near, correction, 0.0) + a_OT - touch.yaw

    yaw_error = planar.bearing(-from_object, touch.yaw)
    rate = jnp.where(first, 0.0, planar.wrap(yaw_error - state.yaw_error) / touch.period)
    omega = params.K_p * yaw_error + params.K_d * rate
    speed = jnp.maximum(params.v_max / (1 + jnp.abs(state.gamma_mean)), params.v_min)
    speed = jnp.where(jnp.abs(yaw_error) > params.yaw_error_max, 0.0, speed)
    twist = Twist(
        speed * jnp.cos(heading),
        speed * jnp.sin(heading),
        jnp.clip(omega, -params.omega_max, params.omega_max),
    )
    details = Details.from_obs(touch)._replace(gamma=state.gamma)
    return state._replace(alpha=alpha, yaw_error=yaw_error), twist, details


LAW = Law(APSState.init, step, "pose", check=check)
PRESETS = {"aps": APSParams()}
