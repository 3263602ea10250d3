"""RPS+: RPS that translates near its target, and searches for the object after a lost contact.

The tuned RPS fails in two ways that touch alone can prevent. Near the target Eq. 6 turns the base
towards the target while it moves; a wide object with a large contact offset, or a realignment, then
carries the base around the target. And after a loss the law acts as if the contact persisted: the
base moves on without the object. Also, RPS+ approaches at 0.03 m/s, where the paper uses 0.01 m/s
for objects that may slide away.

A holonomic base need not turn: translation can give the contact point any velocity. With C the
contact point (without contact, the last one), d from C to the target T, theta* its direction,
e = theta* - theta the heading error, and v* of Eq. 3 within v_max:

  P1  near = ||d|| < d_near, with a current or kept contact, realigning or not
  P2  v_x = v* max(cos e, press),  v_y = v* sin e,  omega = 0      where near

By P2, C moves straight to T while |e| < arccos(press) and the contact sticks. For larger |e| the
base keeps pressing with a share `press` of its speed, since a skin cannot pull.

After n_lost control steps without contact, with p from the base to the last C, in the robot frame,
and l the contact offset there:

  P3  omega = angle of p while |p| > reach, else 0
      v_x = v_max ahead while |angle of p| < facing, else 0,   v_y = v_max aside sgn(l)

The base faces the position of the last contact and moves there, with a sideways velocity towards
the side of the contact, in circles until it touches. Everything else is Eqs. 1-10 with the tuned
parameters. RPS+ has the observations of RPS. Its state adds the position of the last contact in the
world, and the number of control steps since.
"""

from typing import Annotated, NamedTuple

import jax.numpy as jnp

from rps_jax import spec
from rps_jax.control import soft
from rps_jax.control.base import LastContact, Law, bounds_of, nested_bounds
from rps_jax.control.laws import rps
from rps_jax.control.laws.rps import RPSParams, RPSState, Temperatures
from rps_jax.control.observation import Details, Observation, Twist, displacement
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Number, Parameter, Scalar
from rps_jax.spec import Spec, document, tunable

FACING = 0.3  # [rad] P3's facing
REACH = 0.45  # [m] P3's reach: the base's front is 0.36 m ahead of its centre
# Widths of the switches of the smooth law that are not lengths.
_FACING_WIDTH = 0.03  # [rad] P3's |angle of p| < facing
_LOST_WIDTH = 5.0  # [1] control steps, n_lost


@document
class RPSPlusParams(NamedTuple):
    """Parameters of RPS+: the tuned ones of RPS with a faster approach, and those of P1 to P3."""

    law: RPSParams = RPSParams.tuned()._replace(v_approach=0.03)  # of Eqs. 1-10
    d_near: Annotated[
        Parameter,
        tunable("m", "distance within which the base translates, P1", 0.05, 1, log=True),
    ] = 0.25
    press: Annotated[
        Parameter,
        tunable("1", "least share of the speed that is forward, P2", 0, 1, le=1),
    ] = 0.2
    n_lost: Annotated[
        Parameter,
        tunable("1", "control steps without contact before P3: 2 s", 10, 2000, log=True),
    ] = 100
    ahead: Annotated[
        Parameter,
        tunable("1", "share of v_max towards the last contact, P3", 0, 1, le=1),
    ] = 0.7
    aside: Annotated[Parameter, tunable("1", "share of v_max to the side, P3", 0, 1, le=1)] = 0.5

    @property
    def d_success(self) -> Number:
        """Distance at which the target is reached [m]."""
        return self.law.d_success

    @property
    def v_max(self) -> Parameter:
        """Bound on the speed [m/s]."""
        return self.law.v_max


class RPSPlusState(NamedTuple):
    """State of RPS+ between two control steps."""

    law: RPSState
    p_world_contact: LastContact
    steps_lost: Annotated[
        Array, Spec("1", "control steps since then; a float in the smooth law")
    ]  # () int32


BOUNDS = nested_bounds("law", rps.BOUNDS) | dict(bounds_of(RPSPlusParams))


def check(params: RPSPlusParams) -> RPSPlusParams:
    """Return the parameters if they are scalars in range; otherwise raise InputError."""
    rps.check(params.law)
    return spec.check(params, "rps_plus.")


def init(params: RPSPlusParams, temperatures: Temperatures | None = None) -> RPSPlusState:
    """Return the state before the first contact."""
    state = RPSState.init(params.law, temperatures)
    steps_lost = jnp.zeros((), jnp.int32 if temperatures is None else state.l_th.dtype)
    return RPSPlusState(state, jnp.zeros_like(state.p_robot_contact), steps_lost)


def translation(params: RPSPlusParams, d: Array, yaw: Scalar) -> Twist:
    """Compute P2: the twist that moves the contact straight along d (2,) [m] in the world."""
    error = planar.bearing(d, yaw)
    speed = params.law.K_v * planar.norm(d)
    forward = jnp.maximum(jnp.cos(error), params.press)
    omega = jnp.zeros_like(error)
    return rps.saturate(params.law, Twist(speed * forward, speed * jnp.sin(error), omega))


def search(
    params: RPSPlusParams,
    p_robot_last: Array,
    l: Array,  # noqa: E741
    temps: Temperatures = rps.HARD,
) -> Twist:
    """Compute P3: the twist back to the last contact, `p_robot_last` (2,) [m] in the robot frame.

    `l` () [m] is the contact offset there.
    """
    angle, v_max = planar.direction(p_robot_last), jnp.asarray(params.law.v_max)
    is_hard = temps.sgn is None
    faces = soft.greater(FACING, jnp.abs(angle), None if is_hard else _FACING_WIDTH)
    ahead = soft.where(faces, params.ahead * v_max, 0.0)
    far = soft.greater(planar.norm(p_robot_last), REACH, temps.d_th)
    side = jnp.sign(l) if is_hard else jnp.tanh(l / temps.sgn)
    turning = soft.where(far, angle, 0.0)
    return rps.saturate(params.law, Twist(ahead, params.aside * v_max * side, turning))


def step(
    params: RPSPlusParams,
    state: RPSPlusState,
    obs: Observation,
    temperatures: Temperatures | None = None,
) -> tuple[RPSPlusState, Twist, Details]:
    """Compute one control step: RPS, or near the target P2, or after a loss P3.

    With `temperatures` all switches are smooth and mix the twists.
    """
    temps = temperatures or rps.HARD
    law_state, twist, details = rps.step_with_details(params.law, state.law, obs, temperatures)
    contact, touching = law_state.p_robot_contact, jnp.asarray(obs.in_contact)
    if temperatures is not None:
        touching = touching.astype(law_state.l_th.dtype)
    p_world_contact = obs.p_world_robot + planar.rotate(obs.yaw, contact)
    p_world_last = soft.where(touching, p_world_contact, state.p_world_contact)
    idle = soft.or_(touching, soft.not_(law_state.touched))
    steps_lost = soft.where(idle, 0, state.steps_lost + 1)
    d = displacement(obs._replace(p_robot_contact=contact))

    is_kept = soft.and_(law_state.touched, jnp.asarray(params.law.keep_contact) > 0)
    pushing = soft.or_(touching, is_kept)
    near = soft.and_(pushing, soft.greater(params.d_near, details.distance, temps.d_th))  # P1
    is_away = soft.greater_equal(details.distance, params.law.d_success, temps.arrive)
    p_robot_last = planar.rotate(-obs.yaw, p_world_last - obs.p_world_robot)
    is_close, shift = soft.and_(near, is_away), translation(params, d, obs.yaw)
    is_lost = soft.greater(steps_lost, params.n_lost, temperatures and _LOST_WIDTH)
    sweep = search(params, p_robot_last, contact[1], temps)
    twist = soft.tree_where(is_lost, sweep, soft.tree_where(is_close, shift, twist))
    return RPSPlusState(law_state, p_world_last, steps_lost), twist, details


LAW = Law(init, step, check=check, bounds=BOUNDS, temperatures=Temperatures())
PRESETS = {"rps_plus": RPSPlusParams()}
