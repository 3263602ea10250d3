"""RPS+: the law of `rps`, which translates near its target, and searches a contact that it lost.

The tuned law loses worlds in two ways that touch alone can mend. Within arm's length of the target
Eq. 6 turns the base to face the target while it drives on, and a wide object that touches off the
middle, or a realignment, carries it round the target. And a contact that is lost it takes for felt:
it drives on as if the object were there. A third mend is a number: RPS+ approaches at 0.03 m/s,
where the paper creeps at 0.01 m/s after objects that may slide away.

A holonomic base need not turn: any velocity of the contact point can be had by translation. With C
the contact point (while none is felt, where the skin was touched last), d from C to the target T,
theta* its direction, e = theta* - theta the heading error, and v* of Eq. 3 within v_max:

  P1  near = ||d|| < d_near, touching or lately so, realigning or not
  P2  v_x = v* max(cos e, press),  v_y = v* sin e,  omega = 0      where near

By P2 C moves straight to T while |e| < arccos(press), and as long as it sticks; farther round the
base keeps pressing with a share `press` of its speed, since a skin cannot pull.

After n_lost control steps without contact, with p from the base to where C was felt last, in the
robot frame, and l the place on the skin where it was felt:

  P3  omega = angle of p while |p| > reach, else 0
      v_x = v_max ahead while |angle of p| < facing, else 0,   v_y = v_max aside sgn(l)

So the base faces the place where it lost the object, and goes there with a drift to the side to
which the contact went, round and round until it touches. Everything else is the law of Eqs. 1-10
with its own parameters. RPS+ senses what RPS senses; beyond what RPS remembers it remembers where
in the world it felt the object last, and for how many steps it has not.
"""

import operator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rps_jax import errors
from rps_jax.control import soft
from rps_jax.control.base import Bound, Law, document_fields
from rps_jax.control.laws import rps
from rps_jax.control.laws.rps import RPSParams, RPSState, Temperatures
from rps_jax.control.observation import Details, Observation, Twist, displacement
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Scalar

FACING = 0.3  # [rad] P3's facing
REACH = 0.45  # [m] P3's reach: the base's front is 0.36 m before its middle
# How far switches of the smooth law reach that are not of lengths.
_WARM_FACING = 0.03  # [rad] P3's |angle of p| < facing
_WARM_LOST = 5.0  # [1] control steps, n_lost


@document_fields
class RPSPlusParams(NamedTuple):
    """Parameters of RPS+; those of the law are the tuned ones, but for a faster approach."""

    law: RPSParams = RPSParams.tuned()._replace(v_approach=0.03)  # of Eqs. 1-10
    d_near: float | jax.Array = 0.25  # [m] nearer than this it translates, P1
    press: float | jax.Array = 0.2  # [1] least share of the speed that goes forward, P2
    n_lost: float | jax.Array = 100  # [1] control steps without contact before P3: 2 s
    ahead: float | jax.Array = 0.7  # [1] share of v_max with which it goes back, P3
    aside: float | jax.Array = 0.5  # [1] share of v_max with which it searches to the side, P3

    @property
    def d_success(self) -> Any:
        """[m] Target reached."""
        return self.law.d_success

    @property
    def v_max(self) -> Any:
        """[m/s] Bound on the speed."""
        return self.law.v_max


class RPSPlusState(NamedTuple):
    """What RPS+ remembers between two control steps."""

    law: RPSState
    p_world_felt: jax.Array  # (2,) [m] where the object was felt last
    lost: jax.Array  # () int32 control steps since then; of the smooth law a float


BOUNDS = {f"law.{name}": bound for name, bound in rps.BOUNDS.items() if not bound.of} | {
    "law.l_mr": rps.BOUNDS["l_mr"]._replace(of="law.l_cr"),
    "d_near": Bound(0.05, 1, log=True),  # [m]
    "press": Bound(0, 1),  # [1]
    "n_lost": Bound(10, 2000, log=True),  # [1]
    "ahead": Bound(0, 1),  # [1]
    "aside": Bound(0, 1),  # [1]
}


def check(params: RPSPlusParams) -> RPSPlusParams:
    """Return the parameters if they are scalars that mean something, or raise InputError."""
    rps.check(params.law)
    errors.check_finite("rps_plus.d_near", params.d_near, at_least=0)
    errors.check_finite("rps_plus.n_lost", params.n_lost, at_least=0)
    for name in ("press", "ahead", "aside"):
        errors.check_finite(f"rps_plus.{name}", getattr(params, name), at_least=0, at_most=1)
    return params


def init(params: RPSPlusParams, temperatures: Temperatures | None = None) -> RPSPlusState:
    """Before the first touch."""
    state = RPSState.init(params.law, temperatures)
    lost = jnp.zeros((), jnp.int32 if temperatures is None else state.l_th.dtype)
    return RPSPlusState(state, jnp.zeros_like(state.p_robot_contact), lost)


def translation(params: RPSPlusParams, d: jax.Array, yaw: Scalar) -> Twist:
    """P2: the twist that takes the contact straight along d (2,) [m] of the world."""
    error = planar.wrap(planar.direction(d) - yaw)
    speed = params.law.K_v * planar.norm(d)
    forward = jnp.maximum(jnp.cos(error), params.press)
    still = jnp.zeros_like(error)
    return rps.saturate(params.law, Twist(speed * forward, speed * jnp.sin(error), still))


def search(
    params: RPSPlusParams,
    p_robot_felt: jax.Array,
    l: jax.Array,  # noqa: E741
    temperatures: Temperatures | None = None,
) -> Twist:
    """P3: the twist back to where the object was felt, (2,) [m] from the base in its frame.

    `l` () [m] is the place on the skin where it was felt.
    """
    temps = temperatures or rps.HARD
    angle, v_max = planar.direction(p_robot_felt), jnp.asarray(params.law.v_max)
    faces = soft.less(jnp.abs(angle), FACING, temperatures and _WARM_FACING)
    ahead = soft.where(faces, params.ahead * v_max, 0.0)
    far = soft.greater(planar.norm(p_robot_felt), REACH, temps.d_th)
    side = jnp.sign(l) if temperatures is None else jnp.tanh(l / temps.sgn)
    turning = soft.where(far, angle, 0.0)
    return rps.saturate(params.law, Twist(ahead, params.aside * v_max * side, turning))


def step(
    params: RPSPlusParams,
    state: RPSPlusState,
    obs: Observation,
    temperatures: Temperatures | None = None,
) -> tuple[RPSPlusState, Twist, Details]:
    """One control step: the law's, or near the target P2, or after a loss P3.

    With `temperatures` all switches are smooth, as those of the law are, and the twists mix.
    """
    temps = temperatures or rps.HARD
    memory, twist, details = rps.step_with_details(params.law, state.law, obs, temperatures)
    contact, touching = memory.p_robot_contact, jnp.asarray(obs.in_contact)
    if temperatures is not None:
        touching = touching.astype(memory.l_th.dtype)
    p_world_contact = obs.p_world_robot + planar.rotate(obs.yaw, contact)
    p_world_felt = soft.where(touching, p_world_contact, state.p_world_felt)
    idle = soft.logical_or(touching, soft.logical_not(memory.touched))
    lost = soft.where(idle, 0, state.lost + 1)
    d = displacement(obs._replace(p_robot_contact=contact))

    kept = soft.logical_and(memory.touched, jnp.asarray(params.law.keep_contact) > 0)
    pushing = soft.logical_or(touching, kept)
    near = soft.logical_and(pushing, soft.less(details.distance, params.d_near, temps.d_th))  # P1
    away = soft.greater(details.distance, params.law.d_success, temps.arrive, operator.ge)
    p_robot_felt = planar.rotate(-obs.yaw, p_world_felt - obs.p_world_robot)
    for condition, other in (
        (soft.logical_and(near, away), translation(params, d, obs.yaw)),
        (
            soft.greater(lost, params.n_lost, temperatures and _WARM_LOST),
            search(params, p_robot_felt, contact[1], temperatures),
        ),
    ):
        twist = soft.tree_where(condition, other, twist)
    return RPSPlusState(memory, p_world_felt, lost), twist, details


LAW = Law(init, step, check=check, bounds=tuple(BOUNDS.items()), temperatures=Temperatures())
PRESETS = {"rps_plus": RPSPlusParams()}
