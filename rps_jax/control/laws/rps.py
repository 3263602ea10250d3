"""The Reactive Pushing Strategy (RPS): Eqs. 1-10 and Algorithm 1 of Ozdamar, Sirintuna, Arbaud
and Ajoudani, "Pushing in the Dark" (IEEE RA-L 2024). This file does not use MuJoCo.

Frames: W is the world, R the robot (origin at the centre of the base, x forward, y left).
`p_robot_contact` is the paper's p^R_C; `l`, the contact offset, is its y component. On a round base
`l` is the arc length from the front, to the left, and the equations are the same (our choice: the
paper has a flat front). Functions take single worlds; `jax.vmap` batches any argument, parameters
included.

Order of saturation: the paper says that the computed velocities "were saturated at 0.05 m/s [...]
and 0.15 rad/s [...] prior to being commanded", and that "the change of omega as a function of v_x^R
in addition to gamma offers a key advantage". It leaves open whether v_x in Eq. 6 and v* in Eq. 9
are the saturated ones. The bicycle model of its reference bounds the speed before it computes the
yaw rate. So do we; otherwise omega is often at its bound, whatever v_x (see `unsaturated`), and the
paper's hardware results do not come out (`sweeps/paper_reading`).

The law has switches. With `Temperatures` each switch is a weight from 0 to 1 that mixes its two
alternatives (see `soft`), so that the law is smooth. Without them it is the paper's law.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from rps_jax import errors, spec
from rps_jax.control import soft
from rps_jax.control.base import Law, OmegaMax, bounds_of
from rps_jax.control.observation import Details, Observation, Twist, displacement
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Bools, Float, Floats, Parameter, PerWorld
from rps_jax.spec import Bound, Spec, document, tunable


@document
class RPSParams(NamedTuple):
    """Parameters of RPS: floats, the leaves of a pytree, any of which may be batched.

    The first block is given in the paper. The second is not; its defaults are ours.
    """

    eta: Annotated[
        Parameter,
        tunable("1", "upper asymptote of the adaptive rate, Eq. 5", 1, 100, log=True),
    ] = 10.0
    zeta: Annotated[Parameter, tunable("1", "lower asymptote, Eq. 5", -2, 5, ge=None)] = 0.0
    beta: Annotated[Parameter, tunable("m", "inflection point of |l|, Eq. 5", 0.01, 0.3)] = 0.12
    k: Annotated[Parameter, tunable("1/m", "steepness, Eq. 5", 5, 500, log=True)] = 60.0
    K_h: Annotated[Parameter, tunable("1", "heading gain, Eq. 7", 0.1, 5, log=True, gt=0)] = 1.0
    K_v: Annotated[Parameter, tunable("1/s", "velocity gain, Eq. 3", 0.02, 2, log=True, gt=0)] = 0.1
    L: Annotated[
        Parameter, tunable("m", "turning length, Eqs. 6 and 9", 0.03, 1.5, log=True, gt=0)
    ] = 0.2
    l_cr: Annotated[
        Parameter,
        tunable(
            "m",
            "start of the critical region; the half width of the base is 0.29",
            0.1,
            0.289,
            gt=0,
        ),
    ] = 0.24
    d_th: Annotated[
        Parameter,
        tunable("m", "no lateral motion nearer than this, Eq. 5", 0.02, 2, log=True),
    ] = 0.5
    v_max: Annotated[Parameter, Spec("m/s", "bound on the norm of (v_x, v_y)", gt=0)] = 0.05
    omega_max: OmegaMax = 0.15
    d_success: Annotated[Parameter, Spec("m", "target reached, Algorithm 1", gt=0)] = 0.05
    v_approach: Annotated[
        Parameter, Spec("m/s", "forward speed without contact (Sec. III-B)", 0)
    ] = 0.01

    l_mr: Annotated[
        Parameter,
        Spec(
            "m",
            "end of the middle region, where Realignment stops",
            0,
            tune=Bound(0.02, 0.98, relative_to="l_cr"),
        ),
    ] = 0.15
    a_r_max: Annotated[
        Parameter,
        tunable("1", "adaptive rate in Realignment; eta's value", 1, 100, log=True),
    ] = 10.0
    gamma_max: Annotated[
        Parameter,
        tunable(
            "rad", "bound on |gamma|; inf is the tangent as printed", 0.5, 1.57, gt=0, le=math.inf
        ),
    ] = 1.56
    v_lost: Annotated[
        Parameter,
        tunable("m/s", "forward speed after contact is lost", 0.001, 0.05, log=True),
    ] = 0.01
    sgn_0: Annotated[Parameter, Spec("1", "sgn(0), from 0 to 1", 0, 1)] = 0.0

    # Switches, each 0 or 1.
    reactive: Annotated[
        Parameter, Spec("1", "1: RPS; 0: NPS (a_r = 0 and no Realignment)", 0, 1)
    ] = 1.0
    keep_contact: Annotated[
        Parameter, Spec("1", "1: after a loss the last contact is used", 0, 1)
    ] = 0.0
    saturate_first: Annotated[
        Parameter, Spec("1", "1: omega from the saturated v_x; 0: the unsaturated", 0, 1)
    ] = 1.0
    clip_each: Annotated[
        Parameter, Spec("1", "1: v_x and v_y clipped one by one, not as a vector", 0, 1)
    ] = 0.0

    @classmethod
    def paper(cls) -> RPSParams:
        """Return the paper's values (Sec. III-A), with our defaults for those it does not give."""
        return cls()

    @classmethod
    def tuned(cls) -> RPSParams:
        """Return values tuned by evolution in random worlds of boxes and cylinders.

        See `sweeps/random_worlds`; some of the worlds had robots with limits. The base keeps full
        speed until the target. Within d_th it moves straight ahead or, beyond l_cr, almost purely
        sideways, and Eq. 5 acts only outside d_th. After a loss of contact the law acts as if the
        last contact persisted. These values were tuned with omega from the unsaturated v_x.
        """
        return cls(
            eta=7.434028,
            zeta=-1.237692,
            beta=0.1164115,
            k=21.5857,
            K_h=0.2141526,
            K_v=1.264902,
            L=0.2451354,
            l_cr=0.1781017,
            l_mr=0.1356963,
            a_r_max=60.049,
            d_th=1.525068,
            gamma_max=1.535043,
            v_lost=0.03196665,
            keep_contact=1.0,
            saturate_first=0.0,
        )

    @classmethod
    def nps(cls) -> RPSParams:
        """Return the non-reactive baseline: a_r = 0, and no Realignment State (Sec. III-B)."""
        return cls(reactive=0.0)

    @classmethod
    def unsaturated(cls) -> RPSParams:
        """Return the paper's values with omega from the unsaturated v_x, then clipped."""
        return cls(saturate_first=0.0)


# v_max, omega_max, v_approach and d_success belong to the robot and the task, not to the law.
BOUNDS = dict(bounds_of(RPSParams))
for _name in ("d_th", "gamma_max", "v_lost"):  # last, in the order of published tunings
    BOUNDS[_name] = BOUNDS.pop(_name)


class Temperatures(NamedTuple):
    """Widths of the switches of the smooth law, all [m].

    As the widths tend to zero, the law tends to the paper's, except at l = 0, where a smooth sgn
    is zero for any `sgn_0`. The Realignment State is hysteretic only for realign below
    (l_cr - l_mr) / 4; above this width l_th has one equilibrium for each l.
    """

    realign: Annotated[Parameter, Spec("m", "Algorithm 1's |l| > l_th", gt=0, le=1)] = 0.01
    d_th: Annotated[Parameter, Spec("m", "Eq. 5's ||d|| > d_th", gt=0, le=1)] = 0.02
    sgn: Annotated[Parameter, Spec("m", "sgn(l)", gt=0, le=1)] = 0.01
    arrive: Annotated[Parameter, Spec("m", "||d|| < d_success", gt=0, le=1)] = 0.002

    def check(self) -> None:
        """Raise InputError for a temperature that is not a positive length."""
        spec.check(self, "temperature ")


class RPSState(NamedTuple):
    """State of the law between two control steps."""

    l_th: Annotated[Floats, Spec("m", "dynamic threshold: l_cr normally, l_mr while realigning")]
    p_robot_contact: Annotated[
        Float[Array, "*B 2"], Spec("m", "the last contact, in the robot frame")
    ]
    touched: Annotated[
        Bools | Floats, Spec("1", "whether there was a contact; a weight in the smooth law")
    ]

    @classmethod
    def init(cls, params: RPSParams, temperatures: Temperatures | None = None) -> RPSState:
        """Return the initial state of Algorithm 1, l_th = l_cr."""
        l_th = jnp.asarray(params.l_cr, float)
        touched = jnp.zeros((), bool if temperatures is None else l_th.dtype)
        return cls(l_th, jnp.zeros(2, l_th.dtype), touched)


def check(params: RPSParams) -> RPSParams:
    """Return the parameters if they are scalars in range.

    Raises:
      InputError: a value is not a number, is out of range, or is infinite (only gamma_max may be,
        for the tangent as printed).
    """
    spec.check(params, "rps.")
    errors.check_finite("rps.l_mr", params.l_mr, at_most=params.l_cr)
    return params


HARD: Any = Temperatures._make([None] * len(Temperatures._fields))  # the paper's switches


def _sgn(params: RPSParams, x: Array, temperature: ArrayLike | None) -> Array:
    """Compute sgn(x) with the parameter sgn(0), by default 0: no lateral motion at l = 0."""
    if temperature is None:
        return jnp.where(x == 0, params.sgn_0, jnp.sign(x))
    return jnp.tanh(x / temperature)


def adaptive_rate(
    params: RPSParams,
    l: Floats,  # noqa: E741
    distance: Floats,
    temps: Temperatures = HARD,
) -> Floats:
    """Compute Eq. 5: the adaptive rate a_r [1] from contact offset l [m] and ||d|| [m]."""
    logistic = jax.nn.sigmoid((jnp.abs(l) - params.beta) * params.k)
    a_r = (params.zeta + (params.eta - params.zeta) * logistic) * _sgn(params, l, temps.sgn)
    far = soft.greater(distance, params.d_th, temps.d_th)
    return soft.where(far, a_r, 0.0) * params.reactive


def linear_velocity(v_star: PerWorld, a_r: PerWorld) -> tuple[Floats, Floats]:
    """Compute Eqs. 1-2: (v_x, v_y) [m/s] with norm v_star [m/s] and slope v_y / v_x = a_r [1]."""
    a_r = jnp.asarray(a_r) * 1.0  # convert to float, and keep the width
    length = planar.norm(jnp.stack([jnp.ones_like(a_r), a_r], axis=-1))
    return v_star / length, v_star * (a_r / length)


def steering_angle(params: RPSParams, d: Float[Array, "*B 2"], yaw: PerWorld) -> Floats:
    """Compute Eqs. 7-8: gamma = K_h (theta* - theta) [rad], with theta* the direction of d [m].

    The heading error is wrapped to [-pi, pi). The paper's tangent changes sign beyond pi / 2,
    where the robot would turn away from its target. Gamma is therefore clipped to +-gamma_max.
    """
    gamma = params.K_h * planar.bearing(d, yaw)
    return jnp.clip(gamma, -jnp.asarray(params.gamma_max), params.gamma_max)


def realignment_gain(params: RPSParams, l: Floats) -> Floats:  # noqa: E741
    """Compute Eq. 10: sigma = 1 - |l| / l_cr [1], zero in the critical region."""
    return 1.0 - jnp.minimum(jnp.abs(l), params.l_cr) / params.l_cr


def saturate(params: RPSParams, twist: Twist) -> Twist:
    """Scale (v_x, v_y) as a vector to norm v_max, and clip omega.

    With `clip_each`, v_x and v_y are clipped separately, which changes their direction.
    """
    scaled = twist.saturate(params.v_max, params.omega_max)
    v_max, clip_each = jnp.asarray(params.v_max), jnp.asarray(params.clip_each > 0)
    pairs = zip(twist[:2], scaled[:2], strict=True)
    v_x, v_y = (jnp.where(clip_each, jnp.clip(v, -v_max, v_max), x) for v, x in pairs)
    return Twist(v_x, v_y, scaled.omega)


def _push(
    params: RPSParams, l_th: Array, obs: Observation, temps: Temperatures
) -> tuple[Array, Twist, Details]:
    """Compute one pass of Algorithm 1's control loop, in contact."""
    l = obs.l  # noqa: E741
    d = displacement(obs)
    distance = planar.norm(d)
    v_star = params.K_v * distance  # Eq. 3
    gamma = steering_angle(params, d, obs.yaw)

    realigning = soft.and_(
        soft.greater(jnp.abs(l), l_th, temps.realign), jnp.asarray(params.reactive) > 0
    )  # Algorithm 1: enter or leave the Realignment State
    a_r_max = params.a_r_max * _sgn(params, l, temps.sgn)
    a_r = soft.where(realigning, a_r_max, adaptive_rate(params, l, distance, temps))
    v_x, v_y = linear_velocity(v_star, a_r)  # Eqs. 1-2
    bounded = saturate(params, Twist(v_x, v_y, jnp.zeros_like(v_x)))
    first = jnp.asarray(params.saturate_first) > 0
    forward = jnp.where(first, bounded.v_x, v_x)
    speed = jnp.where(first, jnp.minimum(v_star, params.v_max), v_star)
    turning_speed = soft.where(realigning, realignment_gain(params, l) * speed, forward)
    omega = turning_speed / params.L * jnp.tan(gamma)  # Eq. 9 or 6
    twist = saturate(params, Twist(v_x, v_y, omega))

    arrived = soft.greater(params.d_success, distance, temps.arrive)
    twist = jax.tree.map(lambda v: soft.where(arrived, 0.0, v), twist)
    l_th = soft.where(arrived, l_th, soft.where(realigning, params.l_mr, params.l_cr))
    realigning = soft.and_(realigning, soft.not_(arrived))
    return l_th, twist, Details(l, distance, a_r, gamma, realigning)


def step_with_details(
    params: RPSParams, state: RPSState, obs: Observation, temperatures: Temperatures | None = None
) -> tuple[RPSState, Twist, Details]:
    """Compute `step` and its details (without contact, those of the last contact)."""
    in_contact = jnp.asarray(obs.in_contact)
    if temperatures is not None:
        in_contact = in_contact.astype(state.l_th.dtype)
    temps = temperatures or HARD
    # Without contact the contact point is undefined; the last one keeps every branch finite.
    contact = soft.where(in_contact, obs.p_robot_contact, state.p_robot_contact)
    filled = obs._replace(p_robot_contact=contact)
    l_th, push, details = _push(params, state.l_th, filled, temps)
    is_kept = soft.and_(state.touched, jnp.asarray(params.keep_contact) > 0)
    # Only a current contact arrives: the last contact near the target must not stop the robot.
    is_away = soft.greater_equal(details.distance, params.d_success, temps.arrive)
    pushing = soft.or_(in_contact, soft.and_(is_kept, is_away))
    ahead = Twist(soft.where(state.touched, params.v_lost, params.v_approach), 0.0, 0.0)
    twist = soft.tree_where(pushing, push, ahead)
    state = RPSState(
        l_th=soft.where(pushing, l_th, state.l_th),
        p_robot_contact=contact,
        touched=soft.or_(state.touched, in_contact),
    )
    return state, twist, details._replace(realigning=soft.and_(details.realigning, pushing))


@jax.jit
def step(
    params: RPSParams, state: RPSState, obs: Observation, temperatures: Temperatures | None = None
) -> tuple[RPSState, Twist]:
    """Compute one control step of Algorithm 1: RPS, or NPS with `params.reactive` 0.

    In contact, the twist is that of Eqs. 1-10, saturated, and zero once ||d|| < d_success. Without
    contact the base moves straight ahead, at v_approach before the first contact and at v_lost
    after a loss, and l_th is unchanged. With `keep_contact`, a loss is ignored and the last contact
    is used. Algorithm 1's last line prints v_x twice; we read it as (v_x, v_y, omega).

    With `temperatures` the law is smooth. l_th moves continuously between l_mr and l_cr; a_r and
    the turning speed are mixed between their values in and out of the Realignment State. The
    contact's weight mixes pushing with moving straight ahead, and the current contact with the
    last one, so `p_robot_contact` must be finite. The state must be that of
    `RPSState.init(params, temperatures)`. Parameters that are 0 or 1 still switch. Bounds
    (saturation, gamma_max, sigma) are unchanged: they have kinks but no jumps. One jump remains: at
    a heading error of exactly pi the robot turns to one side.

    Examples:
      >>> import numpy as np
      >>> import rps_jax
      >>> params = rps_jax.RPSParams.paper()
      >>> obs = rps_jax.Observation(
      ...     p_world_robot=np.zeros(2),
      ...     yaw=0.0,
      ...     p_robot_contact=np.array([0.36, 0.0]),
      ...     in_contact=True,
      ...     p_world_target=np.array([2.0, 0.0]),
      ... )
      >>> state, twist = rps_jax.step(params, rps_jax.RPSState.init(params), obs)
      >>> f"{float(twist.v_x):.2f} m/s straight ahead"
      '0.05 m/s straight ahead'
    """
    state, twist, _ = step_with_details(params, state, obs, temperatures)
    return state, twist


LAW = Law(
    RPSState.init,
    step_with_details,
    check=check,
    bounds=BOUNDS,
    temperatures=Temperatures(),
)
PRESETS = {
    "rps": RPSParams.paper(),
    "rps_tuned": RPSParams.tuned(),
    "nps": RPSParams.nps(),
    "rps_unsaturated": RPSParams.unsaturated(),
}
