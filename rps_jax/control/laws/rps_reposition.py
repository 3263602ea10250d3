"""RPS+ that repositions: where a push makes no progress, the base drives around and pushes anew.

RPS+ keeps the contact that it has. On a round front, or with an object that it cannot turn, it may
circle until the time is over. With the last contact C, the object's middle M, the direction psi of
its push and the notation of `unicycle` (D1, D2):

  G1  stuck: the distance of C to the target has not fallen by `progress` for t_stuck
  G2  M = C + r u(theta + n);  phi the angle from M to the base, turn that from phi to psi + pi
  G3  W = M - R u(psi) where turn < ahead,  else M + R u(phi +- ahead)

While stuck, the base moves at v_max towards W, straight away from M where it is nearer than R, and
from the last W to M. It always turns to face M, omega = angle of M - P minus theta. The next touch
on the way to M starts RPS+ afresh. After an approach that passes M without a touch, M is a point
ahead and aside, since dead taxels may have pushed the object along. It senses what RPS+ senses.
"""

from typing import Annotated, NamedTuple

import jax.numpy as jnp

from rps_jax import spec
from rps_jax.control import soft
from rps_jax.control.base import Law, Memory, bounds_of, nested_bounds
from rps_jax.control.laws import rps_plus, unicycle
from rps_jax.control.laws.rps_plus import RPSPlusParams, RPSPlusState
from rps_jax.control.observation import Details, Observation, Twist
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Number, Parameter
from rps_jax.spec import Spec, document, tunable

_AHEAD = 1.26  # [rad] by which the base aims ahead on the circle
_SEARCH_ANGLE = 0.5  # [rad] of the next guess of M beside the heading of an approach that missed
_ARRIVED, _CLEAR = 0.1, 0.1  # [m] errors at the staging point, and of the circle


@document
class RPSRepositionParams(NamedTuple):
    """Parameters of RPS+, and those of G1 to G3."""

    law: RPSPlusParams = RPSPlusParams()  # of RPS+
    t_stuck: Annotated[
        Parameter,
        tunable("s", "without progress until it repositions, G1", 3, 100, log=True, gt=0),
    ] = 48.7
    progress: Annotated[Parameter, tunable("m", "progress of G1", 0.005, 0.3, log=True, gt=0)] = (
        0.04189
    )
    r: Annotated[Parameter, tunable("m", "from the contact to M, G2", 0.08, 0.4, gt=0)] = 0.3235
    R: Annotated[Parameter, tunable("m", "radius of the circle around M, G3", 0.5, 1.4, gt=0)] = (
        0.7371
    )

    @property
    def d_success(self) -> Number:
        """Distance at which the target is reached [m]."""
        return self.law.d_success


class RPSRepositionState(NamedTuple):
    """State of the law between two control steps."""

    law: RPSPlusState
    p_world_object: Annotated[Array, Spec("m", "M, middle of the object")]  # (2,)
    best: Annotated[Array, Spec("m", "distance of C to the target at the last progress")]
    t_stuck: Annotated[Array, Spec("s", "time since the last progress")]
    away: Annotated[Array, Spec("1", "whether the base repositions")]  # () bool
    approach: Annotated[Array, Spec("1", "whether it moves from the last W to M")]  # () bool
    side: Annotated[Array, Spec("1", "1: counter-clockwise around M; -1: clockwise")]


def check(params: RPSRepositionParams) -> RPSRepositionParams:
    """Return the parameters if they are scalars in range; otherwise raise InputError."""
    rps_plus.check(params.law)
    return spec.check(params, "rps_reposition.")


def init(params: RPSRepositionParams) -> RPSRepositionState:
    """Return the state before the first contact."""
    state = rps_plus.init(params.law)
    zero = jnp.zeros_like(state.law.l_th)
    no = zero > 0
    point = jnp.zeros_like(state.p_world_contact)
    return RPSRepositionState(state, point, zero + jnp.inf, zero, no, no, zero + 1)


def step(
    params: RPSRepositionParams, state: RPSRepositionState, obs: Observation
) -> tuple[RPSRepositionState, Twist, Details]:
    """Compute one control step: RPS+, or a part of a reposition."""
    law, twist, details = rps_plus.step(params.law, state.law, obs)
    touches, base, yaw = obs.in_contact, obs.p_world_robot, jnp.asarray(obs.yaw)
    _, _, normal, _, half_length = unicycle.contact_of(law.p_world_contact, obs)
    middle = law.p_world_contact + params.r * planar.unit(yaw + normal)
    middle = jnp.where(touches, middle, state.p_world_object)

    # G1; the time counts from the first touch.
    distance = planar.norm(obs.p_world_target - law.p_world_contact)
    gains = touches & (distance < state.best - params.progress)
    waits = ~gains & law.law.touched & ~state.away
    t_stuck = jnp.where(waits, state.t_stuck + obs.period, 0.0)
    starts = waits & (t_stuck > params.t_stuck)
    best = jnp.where(gains, distance, state.best)

    # G2 and G3.
    psi = unicycle.push_direction(middle, base, obs.p_world_target, params.r)
    offset = base - middle
    circle = middle, psi, offset, state.side, ~state.away, params.R, params.R, _AHEAD
    way = unicycle.way_around(*circle)
    away = state.away | starts
    clear = planar.norm(offset) > params.R - _CLEAR
    at_staging = away & clear & way.is_direct & (planar.norm(way.staging - base) < _ARRIVED)
    approach = away & (state.approach | at_staging)
    is_finished = approach & touches
    front = base + half_length * planar.unit(yaw)
    missed = approach & (jnp.sum((front - middle) * planar.unit(yaw)) > params.r)
    ahead = front + params.r * planar.unit(yaw + _SEARCH_ANGLE * way.side)
    middle = jnp.where(missed, ahead, middle)
    approach, away = approach & ~is_finished & ~missed, away & ~is_finished

    heading = planar.direction(jnp.where(approach, middle, way.aim) - base)
    heading = jnp.where(clear | approach, heading, planar.direction(offset)) - yaw
    face = planar.bearing(-offset, yaw)
    limits = params.law.law
    v_max, omega_max = jnp.asarray(limits.v_max), jnp.asarray(limits.omega_max)
    v = v_max * planar.unit(heading)
    drive = Twist(v[0], v[1], jnp.clip(face, -omega_max, omega_max))
    fresh = rps_plus.init(params.law)
    fresh = fresh._replace(p_world_contact=law.p_world_contact)
    law = soft.tree_where(is_finished, fresh, law)
    best = jnp.where(is_finished, distance, best)
    twist = soft.tree_where(away, drive, Twist(*map(jnp.asarray, twist)))
    details = details._replace(realigning=details.realigning | away)
    memory = RPSRepositionState(law, middle, best, t_stuck, away, approach, way.side)
    return memory, twist, details


def memory(state: RPSRepositionState) -> Memory:
    """Return whether the base repositions, and the middle M of the object."""
    mode = "repositioning" * bool(state.away)
    return Memory(mode, state.p_world_object) if state.law.law.touched else Memory(mode)


BOUNDS = nested_bounds("law", rps_plus.BOUNDS) | dict(bounds_of(RPSRepositionParams))
LAW = Law(init, step, check=check, bounds=BOUNDS, room=1.5, memory=memory)
PRESETS = {
    "rps_reposition": RPSRepositionParams(),  # tuned in `hostile`
    "rps_reposition_round": RPSRepositionParams(  # tuned in `wide` with a round base
        t_stuck=7.537, progress=0.08164, r=0.1897, R=0.576
    ),
}
