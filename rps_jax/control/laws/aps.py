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
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rps_jax.control.base import Law, check_signs, document_fields
from rps_jax.control.observation import Details, PoseObservation, Twist, displacement
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Pair, Parameter
from rps_jax.robot.shell import HALF_LENGTH


@document_fields
class APSParams(NamedTuple):
    """Parameters of APS; those marked * are ours, since the publication does not give them."""

    K1: Parameter = 0.05  # [1] gain of the mean motion error
    K2: Parameter = 0.1  # [1] gain of the motion error
    K_p: Parameter = 0.6  # [1/s] heading gain
    K_d: Parameter = 0.4  # [1] heading rate gain
    yaw_error_max: Parameter = 0.3  # [rad] above it the robot turns in place
    margin: Parameter = 0.10  # [m] gap above which the robot approaches straight
    r_robot: Parameter = HALF_LENGTH  # [m] * equivalent radius of a rectangular base
    gamma_drop: Parameter = 0.01  # [rad] decrease of |gamma| after which alpha is good
    alpha_mean: Parameter = jnp.pi  # [rad] prior mean of good alphas
    alpha_variance: Parameter = jnp.pi / 4  # [rad^2] prior variance
    alpha_count: Parameter = 100.0  # [1] weight of the prior
    aim_beyond: Parameter = 1.0  # [1] * object radii beyond the target; 0: as published
    min_motion: Parameter = 0.001  # [m] * least motion of the object
    v_max: Parameter = 0.05  # [m/s] bound on the speed
    v_min: Parameter = 0.01  # [m/s] * least speed
    omega_max: Parameter = 0.15  # [rad/s] bound on |omega|
    d_success: Parameter = 0.05  # [m] target reached


class APSState(NamedTuple):
    """State of APS between two control steps."""

    p_world_object: jax.Array  # (2,) [m] O at its last motion
    a_OT: jax.Array  # () [rad] direction from there to T
    started: jax.Array  # () bool: whether the fields above are set
    alpha: jax.Array  # () [rad] of the last step
    gamma: jax.Array  # () [rad] the last motion error
    gamma_mean: jax.Array  # () [rad] m_gamma
    gamma_count: jax.Array  # () [1]
    mean: jax.Array  # () [rad] m, running mean of good alphas
    variance: jax.Array  # () [rad^2] s2, running variance of good alphas
    weight: jax.Array  # () [1] number of alphas in mean and variance
    yaw_error: jax.Array  # () [rad] of the last step

    @classmethod
    def init(cls, params: APSParams) -> APSState:
        """Return the state before the first observation, with the prior alone."""
        zero = jnp.zeros_like(jnp.asarray(params.K1, float))
        return cls(
            jnp.zeros(2, zero.dtype),
            *(zero, jnp.zeros((), bool), zero, zero, zero, zero),
            *(zero + params.alpha_mean, zero + params.alpha_variance, zero + params.alpha_count),
            zero,
        )


_POSITIVE = ("alpha_variance", "alpha_count", "v_max", "omega_max", "d_success")
check = partial(check_signs, "aps", _POSITIVE)


def predictive(params: APSParams, state: APSState) -> Pair:
    """Return mean [rad] and variance [rad^2] of the next good alpha (Gaussian, unknown mean)."""
    precision = 1 / params.alpha_variance + state.weight / state.variance
    mean = params.alpha_mean / params.alpha_variance + state.weight * state.mean / state.variance
    return mean / precision, 1 / precision + state.variance


def activations(params: APSParams, state: APSState, alpha: jax.Array, near: jax.Array) -> Pair:
    """Return (psi_push, psi_relocate) [1] at alpha [rad]; the robot approaches unless `near`.

    Like the released controller, we divide by the predictive variance, not by its square root.
    """
    mean, variance = predictive(params, state)
    peak = jnp.exp(-0.5 * ((alpha - mean) / variance) ** 2)
    push = jnp.minimum(peak, jnp.abs(jnp.cos(alpha)))
    relocate = planar.safe_sqrt(1 - push * push)
    back_off = jnp.where(jnp.cos(alpha) > 0, -push, push)  # on the target's side
    return jnp.where(near, back_off, 1.0), jnp.where(near, relocate, 0.0)


def _learn(
    params: APSParams, state: APSState, p_world_object: jax.Array, a_OT: jax.Array
) -> APSState:
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

    def where(condition: jax.Array, **new: jax.Array) -> dict[str, jax.Array]:
        return {key: jnp.where(condition, x, getattr(state, key)) for key, x in new.items()}

    return state._replace(
        started=jnp.ones_like(state.started),
        **where(moved | ~state.started, p_world_object=p_world_object, a_OT=a_OT),
        **where(moved, gamma=gamma, gamma_mean=gamma_mean, gamma_count=gamma_count),
        **where(good, mean=mean, variance=variance, weight=count),
    )


def _aim(params: APSParams, obs: PoseObservation) -> jax.Array:
    """Return the aim (2,) [m] beyond the target, on the line from the contact or the object."""
    touch = obs.touch
    of_contact = planar.direction(displacement(touch))
    of_object = planar.direction(touch.p_world_target - obs.p_world_object)
    angle = jnp.where(touch.in_contact, of_contact, of_object)
    beyond = params.aim_beyond * obs.r_object
    return touch.p_world_target + beyond * planar.unit(angle)


def step(
    params: APSParams, state: APSState, obs: PoseObservation
) -> tuple[APSState, Twist, Details]:
    """Compute one control step of APS.

    Between the object and the target the robot backs off while it orbits, unless it is so far
    away that it approaches.
    """
    touch = obs.touch
    to_target = _aim(params, obs) - obs.p_world_object
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

    yaw_error = planar.wrap(planar.direction(-from_object) - touch.yaw)
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
