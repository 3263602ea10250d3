"""Deliver an object to a pose by touch: the law of the task `pose`.

The goal is a point T with a heading theta. A box that a flat front pushes straight becomes flush by
way alone. Once flush it stays in the grid of the goal if the base pushes only along theta + k pi/2,
k = 0 to 3. So the law pushes in legs: back (k = 2) where too little way is left, sideways (k = 1
or 3) onto the goal's line, and along theta (k = 0) onto T.

The law remembers the box that it feels, in the grid. With u(x) the unit vector at the angle x and
d_j = u(theta + j pi/2), the box has the supports h_j = max (p - T) . d_j over its points p. Each is
known or not. In a leg along d_k, with the middle F of the front, the base's middle P, and the
offsets e_left and e_right of the ends of an even contact:

  Q1  h_(k+2) = -(F - T) . d_k,  the pushed face
  Q2  h_(k+1) = (P - T) . d_(k+1) + e_left  and  h_(k+3) = -(P - T) . d_(k+1) - e_right,  if seen
  Q3  the box moves with the front that touches it; a known side follows its end, up to 3 cm; an
      unknown side reaches as far as any contact; the first touch of another face keeps the middle
      of its axis, if that was felt

After a second of uneven contact no side is known. If the contact is narrow, another face may be
there: then the box is a square of half width r behind the contact. A wide contact is only tilted a
little, and the supports stay. Where no side is known, a push that the side of the base feels puts
the square beside it. Let g = h_2 be the way that is left, and m the middle of the box, left of the
goal's line by y.

  Q4  leg: k = 2 if g < s_min, or s_flush where a side is known;  else k = 1 or 3 towards y = 0 if
      |y| > y_tol + cap g + reach kappa (g - s_line)^2 / 4;  else k = 0
  Q5  its end: k = 2 at g > s_min + s_back;  k = 1 and 3 at y = 0;  k = 0 at g < stop

The law is done where the last leg ends, unless the contact is uneven or |y| > y_miss. Then it
chooses again, up to `tries` times. It is also done at the time t_end. With the offset c to the left
of the base of m, or of the goal's line in a last leg that touches:

  Q6  push: v_x = v_max, slower near the end;  v_y = K_y c within slope v_x;  omega towards the leg
  Q7  back off by `back`: contact lost or off the front, |c| > l_edge (l_turn where uneven) before
      the last 0.2 m, or a new leg
  Q8  around m on a circle R beyond the box to a point `gap` behind its face, turned to d_k; push
  Q9  look: where a leg with k = 0 or 2 does not know an end of its face, c is that of the point
      `beyond` the farthest contact there; a base that stays in front of the face shifts sideways

A flush face is steered like a car in a last leg whose ends are known. The base turns about points
beside the box's middle, a half depth r ahead of the face, so that this moves straight ahead. Then
the pressure moves along the face until its moment turns the box, and needs no friction. A box of
the half width w on its corners follows up to the curvature w / (w^2 + depth^2), hence

  Q10 kappa = turn w / (w^2 + r^2);  with the middle c_G left of the goal's line, and the heading
      theta - K_h c_G within h_max:  omega = v clip(K_e (heading - yaw), +-kappa),
      v_y = -omega (r + the distance of the front)

A goal with a relative heading has no grid before a face is flush. Until then the law pushes
straight ahead; then theta is the heading of the base plus the turn, and the law starts anew.

Without contact v_free and omega_free are the bounds; the base nears the box at its distance times
1 / s. A base that cannot move sideways steers in Q6: omega towards the leg + K_h c, within h_max;
in Q8 it drives forwards or in reverse. The law needs a flat front. In its smooth form the contact
is a weight that mixes the twists of Q6; modes and legs switch.
"""

from functools import partial
from typing import Annotated, NamedTuple

import jax.numpy as jnp
import numpy as np

from rps_jax import spec
from rps_jax.control import soft
from rps_jax.control.base import (
    ApproachSpeed,
    LastContact,
    Law,
    Memory,
    OmegaMax,
    SpeedMax,
    SuccessDistance,
    TimeLost,
    Touched,
    bounds_of,
)
from rps_jax.control.box import FLUSH, Box, extents, feel, turned
from rps_jax.control.laws.unicycle import MODES, contact_of, turn_around
from rps_jax.control.observation import Details, EndsObservation, Observation, Twist
from rps_jax.geometry import planar, solid
from rps_jax.geometry.arrays import Array, Parameter
from rps_jax.robot.robot import Robot
from rps_jax.spec import Spec, document, tunable

PUSH, BACK, AROUND = 0, 1, 2  # modes
_QUARTER = np.pi / 2  # [rad]
_UNEVEN = -1.0  # [s] of uneven contact, after which no side is known
_NARROW = 0.25  # [m] up to which an uneven contact may be one of another face
_DRUM = 40.0  # [s] of a push, after which an object has no face
_CARROT, _AHEAD = 0.5, 1.0  # [rad] of the aim on the circle: omnidirectional or not
_PAST = 0.35  # [m] of the front beyond the face, at which an approach has failed
_HALF_FRONT = 0.29  # [m]
_AROUND, _CENTRAL = 0.08, 0.2  # [m] behind the front, and from its middle
_TURNS = 0.8  # [rad] between base and leg, up to which it feels the box and turns while it touches


@document
class PoseParams(NamedTuple):
    """Parameters of the law."""

    v_max: SpeedMax = 0.05
    omega_max: OmegaMax = 0.15
    d_success: SuccessDistance = 0.05
    v_approach: ApproachSpeed = 0.03
    v_free: Annotated[Parameter, Spec("m/s", "bound on the speed without contact", gt=0)] = 0.05
    omega_free: Annotated[Parameter, Spec("rad/s", "bound on |omega| without contact", gt=0)] = 0.15
    r: Annotated[Parameter, tunable("m", "half width of an unknown object", 0.1, 0.4, gt=0)] = (
        0.2346
    )
    s_min: Annotated[Parameter, tunable("m", "least way of the last leg, Q4", 0.1, 2)] = 1.381
    s_flush: Annotated[Parameter, tunable("m", "the same, once the box was flush, Q4", 0.02, 2)] = (
        1.187
    )
    s_back: Annotated[Parameter, tunable("m", "more way, Q5", 0, 0.5)] = 0.08447
    y_tol: Annotated[Parameter, tunable("m", "error of a last leg, Q4", 0, 0.1)] = 0.01493
    cap: Annotated[Parameter, tunable("1", "error that the last leg corrects, Q4", 0, 0.5)] = 0.05
    y_miss: Annotated[Parameter, tunable("m", "error of a last leg that is repeated", 0, 0.1)] = (
        0.025
    )
    stop: Annotated[Parameter, Spec("m", "way left at the end, Q5", -0.1)] = 0.004
    tries: Annotated[Parameter, Spec("1", "number of repetitions", 0)] = 3.0
    slope: Annotated[Parameter, tunable("1", "sideways over forward speed, Q6", 0.02, 0.6)] = 0.2135
    K_y: Annotated[
        Parameter,
        tunable("1/s", "gain of the sideways speed, Q6", 0.02, 2, log=True),
    ] = 0.2
    K_h: Annotated[
        Parameter,
        tunable("rad/m", "gain of the heading, Q6 and Q10", 0.1, 6, log=True),
    ] = 1.798
    h_max: Annotated[Parameter, tunable("rad", "bound of this heading", 0.01, 0.8)] = 0.7169
    turn: Annotated[Parameter, tunable("1", "share of the sharpest turn, Q10", 0.3, 1.2)] = 0.5994
    reach: Annotated[
        Parameter,
        tunable("1", "share of a turn that the last leg may use, Q4", 0, 1.5),
    ] = 0.7677
    s_line: Annotated[Parameter, tunable("m", "straight end of the last leg, Q4", 0, 0.8)] = 0.3371
    K_e: Annotated[
        Parameter,
        tunable("1/m", "curvature for an error of the heading, Q10", 1, 20, log=True),
    ] = 9.391
    omega_push: Annotated[
        Parameter,
        tunable("rad/s", "bound on |omega| in contact", 0.005, 0.15, log=True, gt=0),
    ] = 0.03
    l_edge: Annotated[Parameter, tunable("m", "offset of a bad contact, Q7", 0.05, 0.3)] = 0.1418
    l_turn: Annotated[Parameter, tunable("m", "the same, of an uneven contact, Q7", 0.1, 0.3)] = (
        0.2511
    )
    back: Annotated[Parameter, tunable("m", "retreat, Q7", 0.02, 0.6)] = 0.09401
    R: Annotated[
        Parameter, tunable("m", "radius of the circle beyond the box, Q8", 0.4, 1, gt=0)
    ] = 0.5324
    gap: Annotated[Parameter, tunable("m", "gap at the staging point, Q8", 0.03, 0.6, gt=0)] = (
        0.05946
    )
    beyond: Annotated[
        Parameter, tunable("m", "of the base beyond the felt end, Q9", -0.1, 0.2, ge=-0.2)
    ] = 0.02732
    looks: Annotated[Parameter, Spec("1", "number of looks in a leg, Q9", 0)] = 3.0
    tau: Annotated[Parameter, tunable("s", "time constant of the filter of the pose", 0, 2)] = 0.5
    t_end: Annotated[Parameter, Spec("s", "time at which the law gives up", gt=0)] = 290.0


class PoseState(NamedTuple):
    """State of the law between two control steps."""

    mode: Annotated[Array, Spec("1", "0 push or approach, 1 back off, 2 drive around")]
    leg: Annotated[Array, Spec("1", "k, direction of the push in quarter turns from theta")]
    h: Annotated[Array, Spec("m", "supports of the box in the grid, Q1 to Q3")]  # (4,)
    known: Annotated[Array, Spec("1", "whether each is known")]  # (4,) bool
    centred: Annotated[Array, Spec("1", "whether the middle of each axis was felt")]  # (2,)
    p_world_contact: LastContact
    p_world_front: Annotated[Array, Spec("m", "middle of the front, a step before")]  # (2,)
    p_world_base: Annotated[Array, Spec("m", "filtered position of the base")]  # (2,)
    yaw: Annotated[Array, Spec("rad", "filtered heading of the base")]
    twist: Annotated[Array, Spec("m/s, m/s, rad/s", "last command")]  # (3,)
    touched: Touched
    time: Annotated[Array, Spec("s", "time since the start")]
    t_lost: TimeLost
    t_push: Annotated[Array, Spec("s", "time in contact of this push; 0 in an approach")]
    t_even: Annotated[Array, Spec("s", "time of even contact; negative: of uneven contact")]
    look: Annotated[Array, Spec("m", "Q9, position of the base to the left, in the leg")]
    looking: Annotated[Array, Spec("1", "whether the base looks for an end")]
    looks: Annotated[Array, Spec("1", "number of looks in this leg")]
    tries: Annotated[Array, Spec("1", "number of repetitions")]
    goal: Annotated[Array, Spec("m, m, rad", "pose of the goal in the world")]  # (3,)
    oriented: Annotated[Array, Spec("1", "whether a goal's relative heading is known")]
    side: Annotated[Array, Spec("1", "1: counter-clockwise around the object; -1: clockwise")]
    gear: Annotated[Array, Spec("1", "1: forwards around the object; -1: in reverse")]
    done: Annotated[Array, Spec("1", "whether the law is done")]


check = partial(spec.check, prefix="pose.")


class Smooth(NamedTuple):
    """Options of the smooth form: none."""

    def check(self) -> None:
        """Do nothing."""


def init(params: PoseParams, temperatures: Smooth | None = None) -> PoseState:
    """Return the state before the first contact."""
    del temperatures
    zero = jnp.zeros_like(jnp.asarray(params.r, float))
    count, no, point = jnp.zeros((), jnp.int32), zero > 0, jnp.zeros(2, zero.dtype)
    sides = jnp.zeros(4, zero.dtype)
    return PoseState(*[zero] * len(PoseState._fields))._replace(
        mode=count,
        leg=count,
        h=sides,
        known=sides > 0,
        centred=point > 0,
        twist=sides[:3],
        goal=sides[:3],
        **dict.fromkeys(("p_world_contact", "p_world_front", "p_world_base"), point),
        **dict.fromkeys(("touched", "looking", "done", "oriented"), no),
        **dict.fromkeys(("side", "gear"), zero + 1),
    )


def filtered_pose(params: PoseParams, state: PoseState, obs: Observation) -> tuple[Array, Array]:
    """Return position (2,) [m] and yaw [rad] of the base, filtered by its last command."""
    v, omega = state.twist[:2], state.twist[2]
    guess = state.p_world_base + obs.period * planar.rotate(state.yaw, v)
    yaw = state.yaw + obs.period * omega
    share = jnp.where(state.time > 0, obs.period / (params.tau + obs.period), 1.0)
    error = planar.wrap(jnp.asarray(obs.yaw) - yaw)
    return guess + share * (obs.p_world_robot - guess), planar.wrap(yaw + share * error)


def observe_sent(
    params: PoseParams, state: PoseState, obs: EndsObservation, sent: Twist
) -> PoseState:
    """Return the state with the twist that moved the base."""
    del params, obs
    return state._replace(twist=jnp.stack([jnp.asarray(x, state.twist.dtype) for x in sent]))


def step(
    params: PoseParams,
    state: PoseState,
    obs: EndsObservation,
    temperatures: Smooth | None = None,
) -> tuple[PoseState, Twist, Details]:
    """Compute one control step; in the smooth form the contact is a weight."""
    del temperatures
    touch, omni = obs.touch, obs.touch.axle is None
    axle = jnp.asarray(0.0 if touch.axle is None else touch.axle)
    half_length = obs.front
    base, yaw, goal = *filtered_pose(params, state, touch), touch.p_world_target
    theta = yaw_target = jnp.asarray(touch.yaw_target)
    weight = jnp.asarray(touch.in_contact)
    leg, oriented, is_relative = state.leg, state.oriented, touch.relative is not None
    if is_relative:  # a leg straight ahead until a face is flush
        theta = jnp.where(oriented | state.touched, state.goal[2], planar.wrap(yaw - jnp.pi))
        leg = jnp.where(oriented, leg, 2)
    touches = weight > 0.5
    u = planar.unit(yaw)
    grid = planar.unit(theta + jnp.arange(4) * _QUARTER)  # (4, 2) d_j
    p_world_front = base + half_length * u
    flat = touch._replace(
        p_world_robot=base, yaw=yaw, in_contact=touches, base_radius=None, half_length=half_length
    )
    _, contact, normal, on_front, _ = contact_of(state.p_world_contact, flat)
    # The middle of a contact that reaches around both corners is a little behind the front.
    on_front |= (contact[0] > half_length - _AROUND) & (jnp.abs(contact[1]) < _CENTRAL)
    p_world_contact = base + planar.rotate(yaw, contact)
    first, touched = touches & ~state.touched, state.touched | touches
    time, t_lost = state.time + touch.period, jnp.where(touches, 0.0, state.t_lost + touch.period)
    psi = theta + leg * _QUARTER
    pushing = state.mode == PUSH
    is_facing = jnp.abs(planar.wrap(psi - yaw)) < _TURNS
    feels = pushing & touches & on_front & is_facing & state.touched

    # The box. It moves with the front while this touches.
    change = jnp.where(obs.even, 1.0, jnp.where(state.t_even > 0, -2.0, -1.0)) * touch.period
    t_even = jnp.where(feels, jnp.clip(state.t_even + change, _UNEVEN - 0.1, 1.5), state.t_even)
    is_uneven = feels & (t_even <= _UNEVEN)
    h = state.h + jnp.where(
        feels & (state.t_lost < 0.1), grid @ (p_world_front - state.p_world_front), 0.0
    )
    fronts, bases = grid @ (p_world_front - goal), grid @ (base - goal)
    along, across = turned(fronts, leg)[:2]
    box = Box(h, state.known & ~is_uneven, state.centred)
    felt = feel(params.r, box.turned(leg), along, across, obs, t_even).turned(-leg % 4)
    middle = p_world_contact + params.r * planar.unit(yaw + normal)
    # Where the end of the front is dead, only the side feels the object.
    forgets = (first | (pushing & touches & ~on_front)) & ~jnp.any(state.known)
    forgets |= is_uneven & (obs.ends[0] - obs.ends[1] < _NARROW)
    no = jnp.zeros(4, bool)
    square = Box(grid @ (middle - goal) + params.r, no, no[:2])
    h, known, centred = soft.tree_where(forgets, square, soft.tree_where(feels, felt, box))

    h = jnp.where(touches & ~known, jnp.maximum(h, grid @ (p_world_contact - goal)), h)

    # Q4 and Q5.
    (_, y), (_, width) = extents(h)
    way, way_left = h[2], -fronts[0]
    both = known[1] & known[3]
    last_leg = leg == 0
    s_min = jnp.where(jnp.any(known), params.s_flush, params.s_min)
    # Q10: the sharpest turn.
    kappa = params.turn * jnp.minimum(width, _HALF_FRONT) / (width**2 + params.r**2)
    bend = params.reach * kappa / 4 if omni else 0.0

    def room_of(way: Array) -> Array:
        """Return the error that a last leg of this way corrects [m]."""
        way = jnp.maximum(way, 0.0)
        return params.y_tol + params.cap * way + bend * jnp.maximum(way - params.s_line, 0.0) ** 2

    may_try = state.tries < params.tries
    is_back = (leg == 2) & feels & (way > s_min + params.s_back)
    beyond_line = jnp.where(leg == 1, y, -y)  # positive beyond the line
    is_beside = (leg % 2 == 1) & feels & (beyond_line > -0.004)
    has_looked = both | (state.looks >= params.looks)
    is_off = last_leg & feels & may_try & has_looked & (state.t_push > 2)
    is_off &= (t_even > 1) | (state.t_push > 6)
    is_off &= (jnp.abs(y) > room_of(way_left) + 0.01) & (way_left > s_min - 0.1)
    at_end = last_leg & feels & (way_left < params.stop)
    # A drum is never flush: a long push and a repetition are enough.
    is_early = (state.tries < 1) | (state.t_push < 20)
    is_unsure = jnp.where(t_even < 0.3, is_early, ~has_looked)
    misses = at_end & may_try & (is_unsure | (both & (jnp.abs(y) > params.y_miss)))
    repeats = is_off | misses
    done = state.done | (at_end & ~misses) | (time > params.t_end)
    chooses = first | is_back | is_beside | repeats
    if is_relative:
        chooses &= oriented
    sideways = jnp.where(jnp.abs(y) > room_of(way), jnp.where(y > 0, 3, 1), 0)
    leg_next = jnp.where((way < s_min) & ~is_off, 2, sideways)
    leg_next = jnp.where(is_beside, 0, leg_next)
    leg = jnp.where(chooses, leg_next, leg)
    tries = state.tries + repeats
    psi = theta + leg * _QUARTER
    face = planar.wrap(psi - yaw)
    turns = chooses & (jnp.abs(face) > (_TURNS if omni else 0.3))
    last_leg = leg == 0

    # The box from the leg, and Q9.
    _, box_left, behind, box_right = turned(h, leg)
    along, across = turned(fronts, leg)[0], turned(bases, leg)[1]
    (middle_along, middle_across), half = extents(turned(h, leg))
    wants = (leg % 2 == 0) & feels & ~chooses & (t_even > 0.6) & ~has_looked
    wants &= (~last_leg | (way_left > 0.03)) & (state.t_push > 0.6)
    knows_left = turned(known, leg)[1]
    target = jnp.where(knows_left, -box_right - params.beyond, box_left + params.beyond)
    look = jnp.where(wants, target, state.look)
    looking = (state.looking & ~(feels & (state.t_push > 0.5)) & ~turns) | wants
    looks = jnp.where(turns, 0.0, state.looks) + wants
    aim_across = jnp.where(looking, look, middle_across)
    offset = aim_across - across  # [m] to the left of the base

    # Q7: the end of a push.
    edge = jnp.where(t_even > 0, params.l_edge, params.l_turn)
    is_bad = ~on_front | ((jnp.abs(offset) > edge) & (~last_leg | (way_left > 0.2)))
    t_push = state.t_push + touches * touch.period
    is_lost = (t_lost > 0.6) & (state.t_push > 0)
    failed = pushing & touched & (state.t_push == 0) & ~touches & (along > _PAST - behind)
    # Nothing is felt there: the object lies ahead, perhaps at a dead taxel.
    h = jnp.where(failed, grid @ (p_world_front + params.r * u - goal) + params.r, h)
    p_world_contact = jnp.where(failed, p_world_front, p_world_contact)
    known, looking = known & ~failed, looking & ~failed
    patience = jnp.where(looks > 0, 0.1, 0.4)
    leaves = (touches & is_bad & (t_push > patience)) | is_lost | failed | turns | wants
    leaves &= pushing & touched
    around, near_face = state.mode == AROUND, omni & (jnp.abs(face) < 0.1)
    hits = around & touches
    lands = hits & ~is_bad & is_facing & ~turns
    stops = hits & ~lands & (on_front | omni)
    gap = jnp.sum((p_world_contact - p_world_front) * u)
    at_side = omni & (jnp.abs(contact[1]) > 0.26)
    back = jnp.where(near_face, 0.04, params.back)
    is_clear = (state.mode == BACK) & ((gap > back) | (at_side & (t_lost > 2)))

    # Q8, of the base's middle or of its axle.
    ahead_u, left_u = planar.unit(psi), planar.unit(psi + _QUARTER)
    m = goal + middle_along * ahead_u + aim_across * left_u
    p_world_axle = base - axle * u
    away = p_world_axle - m
    is_short = jnp.abs(planar.wrap(psi - planar.direction(-away))) < 2.4
    may_choose = ~around | (omni & is_short)
    phi, turn, side = turn_around(psi, away, state.side, may_choose)
    carrot = _CARROT if omni else _AHEAD
    behind_face = near_face & (along < -behind - 0.02) & (jnp.abs(offset) < 0.7)
    is_direct = (jnp.abs(turn) < carrot) | behind_face if omni else turn < carrot
    R_s = half[0] + half_length + params.gap + axle
    R = params.R + jnp.hypot(*half) + axle
    staging = m - jnp.where(behind_face, -jnp.sum(away * ahead_u), R_s) * ahead_u
    aim = jnp.where(is_direct, staging, m + R * planar.unit(phi + side * carrot))
    to_aim = aim - p_world_axle
    remaining = planar.norm(staging - p_world_axle)
    heading = planar.direction(to_aim)
    if omni:
        near = (remaining < 0.02) | ((remaining < 0.3) & (jnp.abs(offset) < 0.02))
        gear, error = state.gear, face
    else:
        half_turns = jnp.array([0.0, jnp.pi])  # forwards and in reverse
        errors = planar.wrap(heading + half_turns - yaw)
        ends = jnp.abs(planar.wrap(psi - heading - half_turns))
        costs = jnp.abs(errors) + jnp.where(is_direct, ends, _QUARTER)
        gear = jnp.where(costs[1] < costs[0] + 1.3, -1.0, 1.0)
        gear = jnp.where(around, state.gear, gear)
        error = jnp.where(gear > 0, *errors)
        near = (remaining < 0.04) | ((remaining < 0.2) & (jnp.abs(error) > 1.2))
    arrives = around & is_direct & near
    aligned = arrives & (jnp.abs(face) < 0.03)

    mode = jnp.where(is_clear, AROUND, state.mode)
    mode = jnp.where(aligned | lands, PUSH, mode)
    mode = jnp.where(leaves | stops, BACK, mode)
    t_push = jnp.where(mode == PUSH, t_push, 0.0)
    t_even = jnp.where(turns, 0.0, t_even)

    # Q6 and Q10.
    follows = omni & last_leg & feels & (t_even > 0.3) & has_looked & ~leaves
    d = params.r * jnp.sin(yaw - theta)
    lateral = soft.where(
        weight, jnp.where(last_leg, -(y + jnp.where(follows, d, 0.0)), 0.0), offset
    )
    steer = jnp.clip(params.K_h * lateral, -params.h_max, params.h_max)
    steer = jnp.where(follows, steer, 0.0) if omni else steer
    nears = touched & ~touches & (state.t_push == 0)
    fast = jnp.where(nears, jnp.clip(-behind - along, params.v_max, params.v_free), params.v_max)
    v = jnp.where(touched, fast, params.v_approach)
    v_last = jnp.clip(0.5 * way_left, 0.01, params.v_max)
    v_side = jnp.clip(-0.5 * beyond_line, 0.015, params.v_max)
    slow = jnp.where(last_leg, v_last, jnp.where(leg % 2 == 1, v_side, v))
    v = soft.where(weight, slow, v)
    turn_left = planar.wrap(psi + steer - yaw)
    arm = half_length + params.r
    curve = jnp.clip(params.K_e * turn_left, -kappa, kappa)
    v = jnp.minimum(v, jnp.where(follows, params.v_max / jnp.hypot(1.0, curve * arm), v))
    bound = soft.where(weight, params.omega_push, params.omega_max)
    omega = jnp.where(
        follows, curve * v, jnp.where(touched, jnp.clip(turn_left, -bound, bound), 0.0)
    )
    bound = soft.where(weight, params.slope * v, 0.4 * params.v_max)
    gain = soft.where(weight, params.K_y, 0.5)
    may_slide = omni & touched & (touches | (t_push == 0))
    v_y = jnp.where(may_slide, jnp.clip(gain * lateral, -bound, bound), 0.0)
    v_y -= jnp.where(follows, omega * arm, 0.0)
    # Q7 and Q8.
    if omni:
        speed = jnp.minimum(params.v_free, 2.2 * planar.norm(to_aim))
        drive = planar.rotate(-yaw, planar.unit(heading) * speed)
        spin = 2 * face
    else:
        is_large = jnp.abs(error) > 0.6
        v_drive = jnp.where(is_large | arrives, 0.0, gear * params.v_free * jnp.cos(error))
        drive = jnp.stack([v_drive, jnp.zeros_like(v_drive)])
        spin = jnp.where(arrives, 2 * face, jnp.where(is_large, jnp.sign(error) * jnp.pi, error))
    spin = jnp.clip(spin, -params.omega_free, params.omega_free)
    flee = Twist(-params.v_free, 0.0, 0.0)
    free = soft.tree_where(mode == BACK, flee, Twist(drive[0], drive[1], spin))
    free = free, params.v_free, params.omega_free
    push = Twist(v, v_y, omega), fast, params.omega_max
    twist, v_max, omega_max = soft.tree_where(mode == PUSH, push, free)
    v, v_y, omega = (jnp.where(done, 0.0, x) for x in twist)
    v_y = v_y if omni else v_y + axle * omega
    twist = Twist(v, v_y, omega).saturate(v_max, omega_max)
    if is_relative:
        orients = feels & ~oriented & ((t_even > FLUSH) | (state.t_push > _DRUM))
        theta = jnp.where(orients, planar.wrap(yaw + yaw_target), theta)
        oriented, touched, known = oriented | orients, touched & ~orients, known & ~orients
    distance = planar.norm(jnp.stack([way_left, y]))
    details = Details(offset, distance, jnp.zeros_like(distance), face, mode != PUSH)
    memory = PoseState(
        mode,
        leg,
        h,
        known,
        centred,
        p_world_contact,
        p_world_front,
        base,
        yaw,
        jnp.stack(twist),
        touched,
        time,
        t_lost,
        t_push,
        t_even,
        look,
        looking,
        looks,
        tries,
        jnp.stack([*goal, theta]),
        oriented,
        side,
        gear,
        done,
    )
    return memory, twist, details


def is_done(state: PoseState) -> Array:
    """Return whether the law is done."""
    return state.done


def memory(state: PoseState) -> Memory:
    """Return the mode and the middle of the box."""
    mode = ("", *MODES[:2])[int(state.mode)]
    if not state.touched:
        return Memory(mode)
    goal = np.asarray(state.goal)
    return Memory(mode, goal[:2] + solid.rotate(goal[2], np.asarray(extents(state.h)[0])))


LAW = Law(
    init,
    step,
    senses="ends",
    check=check,
    bounds=bounds_of(PoseParams),
    drives=("omni", "differential"),
    room=1.5,
    heading=True,
    temperatures=Smooth(),
    is_done=is_done,
    observe_sent=observe_sent,
    memory=memory,
)
_DRIVE = PoseParams(  # tuned in `wide` with boxes and a differential base
    r=0.2459,
    s_min=0.9729,
    s_flush=0.6344,
    s_back=0.1811,
    y_tol=0.02185,
    cap=0.08421,
    y_miss=0.02424,
    K_h=1.7,
    h_max=0.3127,
    omega_push=0.01651,
    l_edge=0.2626,
    l_turn=0.252,
    back=0.2116,
    R=0.6854,
    gap=0.3875,
    beyond=0.05025,
    looks=1.0,
    tau=0.5982,
    # Our choice: at the paper's speeds most of its manoeuvres take longer than 150 s.
    v_free=0.2,
    omega_free=0.5,
)
PRESETS = {
    "pose": PoseParams(),
    "pose_drive": _DRIVE,  # for bases that cannot move sideways
    # The same with a front of 0.36 to 0.52 m: tuned in `wide` with boxes and `jackal`.
    "pose_medium": _DRIVE._replace(
        r=0.238,
        s_min=1.837,
        s_flush=0.2764,
        s_back=0.4071,
        y_tol=0.02423,
        cap=0.01608,
        y_miss=0.05899,
        K_h=0.2278,
        h_max=0.4703,
        omega_push=0.005412,
        l_edge=0.2404,
        l_turn=0.128,
        back=0.02862,
        R=0.9323,
        gap=0.5199,
        beyond=0.06,
        tau=0.2838,
    ),
    # The same with a narrower front: tuned in `wide` with boxes and `turtlebot4`.
    "pose_narrow": _DRIVE._replace(
        r=0.2526,
        s_min=1.453,
        s_flush=0.8082,
        s_back=0.4195,
        y_tol=0.05361,
        cap=0.06263,
        y_miss=0.07793,
        K_h=1.582,
        h_max=0.5253,
        omega_push=0.01411,
        l_edge=0.1395,
        l_turn=0.112,
        back=0.553,
        R=0.4382,
        gap=0.2347,
        beyond=0.09194,
        tau=0.03871,
    ),
}
_HALF_FRONTS = {"pose_drive": 0.26, "pose_medium": 0.18, "pose_narrow": 0.0}  # [m] from which on


def preset_of(robot: Robot) -> str | None:
    """Return the name of the preset for a base; None: none suits its drive or its front."""
    if robot.radius is not None or robot.drive not in LAW.drives:
        return None
    if robot.drive == "omni":
        return "pose"
    return next(name for name, half in _HALF_FRONTS.items() if robot.half_width >= half)
