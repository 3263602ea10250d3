"""Push and reposition: a law for bases whose axle cannot move sideways.

A flush face sticks to the front only for omega <= mu v / x_o, with x_o from the axle to the
object's centre of friction. At a rolling contact l + k theta is constant, with k = 0.47 m/rad for
the paper's drum, whatever the base does: one pass over a front of 0.58 m turns the push by 1.2 rad
at most. So the law leaves the object when its contact is spent, drives around it, and pushes anew.

It remembers the last contact C and the object's middle M in the world. T is the target, theta the
heading, u(x) the unit vector at an angle x, and A the axle, a behind the base's middle.

  D1  M = C + r u(theta + n), with n the direction of the base's normal at the contact; for a touch
      outside of a push, u points along the sum of r u(theta + n) and the last M - C
  D2  psi = direction of T - M; the opposite if |T - M| < r and the base stands beyond M
  D3  e = angle of T - C minus theta;  x_C: of C ahead of the axle

Push at v_max until the contact is lost for t_lost, or spent: it leaves the front, |l| > l_edge, or
|e| > e_far; within d_near of T, |e| > e_near replaces the last two.

  D4  omega = K_e e + K_l (l - l_dead sgn l where |l| > l_dead, else 0)
  D5  omega = K_near v_max sin(e) / x_C   within d_near;  0 without contact

Retreat at v_max with the omega of D7, until C is `back` farther from the base's middle than its
front is: a front that turns while it retreats passes an even face. Drive around M in reverse, so
that the base need not turn away from the object and back. With phi the angle of A - M, and turn the
angle from phi to psi + pi, which decides the side:

  D6  W = M - (R_s + a) u(psi)  where turn < carrot,  else  M + (R + a) u(phi +- carrot)
  D7  omega = angle of A - W minus theta,  v = -v_max cos(omega)

Where this angle is large, the base turns on the spot, and a car in reverse. Align: at the last W,
turn to psi, a car in reverse. A touch of the middle of the front on the way is a push; one of a
corner is a retreat. Then approach M, which is a push without contact:

  D8  omega = angle of M - A minus theta

An approach that passes M without contact has missed. The base retreats and drives around a better
guess of M: first C; after more misses, in turn, a place where an object is not felt:

  D9  M = front + r u(theta), pushed along by dead taxels (first, if |l| was small),
      or beside and behind the base, on the inside of the last detour, pushed along by its rear

The twist is (v, a omega, omega), with |omega| <= |v| / R of a car. The law senses touch, odometry
and target; axle and turning radius R are static facts. The smooth law mixes the four modes.
"""

from functools import partial, reduce
from typing import Annotated, NamedTuple

import jax.numpy as jnp

from rps_jax import spec
from rps_jax.control import soft
from rps_jax.control.base import (
    ApproachSpeed,
    Law,
    Memory,
    OmegaMax,
    SuccessDistance,
    TimeLost,
    Touched,
    bounds_of,
)
from rps_jax.control.observation import Details, Observation, Twist, displacement
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Number, Parameter
from rps_jax.robot.shell import HALF_LENGTH
from rps_jax.spec import Spec, document, tunable

MODES = "backing off", "driving around the object", "turning towards the target"
_SIDE = 0.02  # [m] behind the front, where a contact is on a side
_ROUND_SIDE = 1.2  # [rad] from the front of a round base
_LARGE = 0.5  # [rad] heading error above which the base turns on the spot
_ARRIVED, _ALIGNED = 0.22, 0.26  # [m], [rad] errors at the staging point
_CLOSE, _BEARING = 0.2, 1.2  # [m], [rad] distance and bearing of a staging point that is passed
_MIDDLE = 0.25  # [m] offset up to which a touch on the way is a push
_CORNER = 0.12  # [m] behind the front, up to which other touches on the way stop the base
_BESIDE = 0.5, 0.75  # [m] behind and beside the middle of the base, D9
_PAST = 0.5  # [m] of the front beyond M at which an approach has failed
_OVERSHOOT = 1.5  # [rad] on the circle, after which the base drives back
_LEAST_ARM = 0.2  # [m] of x_C


@document
class UnicycleParams(NamedTuple):
    """Parameters of the law: bounds of robot and task, and those that are tuned."""

    v_max: Annotated[Parameter, Spec("m/s", "speed of the base's middle", gt=0)] = 0.05
    omega_max: OmegaMax = 0.15
    d_success: SuccessDistance = 0.05
    v_approach: ApproachSpeed = 0.03
    r: Annotated[
        Parameter,
        tunable("m", "from the contact to the object's middle, D1", 0.08, 0.4, gt=0),
    ] = 0.2501
    K_e: Annotated[Parameter, tunable("1/s", "turn to the target, D4", 0.1, 3, log=True)] = 2.558
    K_l: Annotated[Parameter, tunable("rad/s/m", "turn to the contact, D4", 0.2, 8, log=True)] = (
        7.61
    )
    l_dead: Annotated[Parameter, tunable("m", "offset up to which it does not, D4", 0, 0.28)] = (
        0.07387
    )
    l_edge: Annotated[Parameter, tunable("m", "offset of a spent contact", 0.1, 0.35)] = 0.3263
    e_far: Annotated[Parameter, tunable("rad", "error of a spent contact", 0.5, 3.4)] = 1.6
    d_near: Annotated[Parameter, tunable("m", "distance of D5", 0.05, 1)] = 0.5245
    e_near: Annotated[Parameter, tunable("rad", "error of a spent contact there", 0.5, 2.5)] = 1.461
    K_near: Annotated[Parameter, tunable("1", "gain of D5", 0.3, 3)] = 1.974
    t_lost: Annotated[
        Parameter,
        tunable("s", "without contact until it is lost", 0.2, 8, log=True, gt=0),
    ] = 0.3644
    back: Annotated[Parameter, tunable("m", "way of a retreat", 0.01, 0.6)] = 0.1
    carrot: Annotated[Parameter, tunable("rad", "aim ahead on the circle, D6", 0.4, 1.5, gt=0)] = (
        1.124
    )
    R: Annotated[Parameter, tunable("m", "radius of the circle around M, D6", 0.5, 1.4, gt=0)] = (
        0.95
    )
    R_s: Annotated[Parameter, tunable("m", "distance of the last W from M, D6", 0.4, 1.4, gt=0)] = (
        0.85
    )


class Widths(NamedTuple):
    """Widths of the switches of the smooth law; its choice of the side stays hard."""

    length: Annotated[Parameter, Spec("m", "of lengths", gt=0, le=1)] = 0.01
    angle: Annotated[Parameter, Spec("rad", "of angles", gt=0, le=1)] = 0.02
    time: Annotated[Parameter, Spec("s", "of times", gt=0, le=1)] = 0.1

    def check(self) -> None:
        """Raise InputError for a width that is not positive."""
        spec.check(self, "temperature ")


class UnicycleState(NamedTuple):
    """State of the law; the modes are bools, or weights of the smooth law, and no mode: push."""

    retreat: Annotated[Array, Spec("1", "whether the base retreats")]
    around: Annotated[Array, Spec("1", "whether it drives around the object")]
    align: Annotated[Array, Spec("1", "whether it turns at the staging point")]
    p_world_object: Annotated[Array, Spec("m", "M, middle of the object")]  # (2,)
    p_world_contact: Annotated[Array, Spec("m", "C, the last contact")]  # (2,)
    l: Annotated[Array, Spec("m", "contact offset at C")]  # noqa: E741
    touched: Touched
    t_lost: TimeLost
    pushed: Annotated[Array, Spec("1", "whether this push had a contact; 0 in an approach")]
    side: Annotated[Array, Spec("1", "1: counter-clockwise around M; -1: clockwise")]
    misses: Annotated[Array, Spec("1", "approaches since the last contact that missed")]


check = partial(spec.check, prefix="unicycle.")


def init(params: UnicycleParams, temperatures: Widths | None = None) -> UnicycleState:
    """Return the state before the first contact."""
    zero = jnp.zeros_like(jnp.asarray(params.r, float))
    no = zero > 0 if temperatures is None else zero
    point = jnp.zeros(2, zero.dtype)
    return UnicycleState(no, no, no, point, point, zero, no, zero, no, zero + 1, zero)


class Contact(NamedTuple):
    """Contact of one control step, or the last one."""

    touches: Array
    p_robot: Array  # (2,) [m]
    normal: Array  # [rad] direction of the base's normal there, in its frame
    on_front: Array  # bool or weight
    half_length: Number  # [m] from the base's middle to its front


def contact_of(p_world_last: Array, obs: Observation, widths: Widths | None = None) -> Contact:
    """Return the current contact, or the last one at `p_world_last` (2,) [m]."""
    touches = jnp.asarray(obs.in_contact)
    last = planar.rotate(-obs.yaw, p_world_last - obs.p_world_robot)
    point = soft.where(touches, obs.p_robot_contact, last)
    if obs.base_radius is not None:
        normal = planar.direction(point)
        on_front = soft.greater(_ROUND_SIDE, jnp.abs(normal), widths and widths.angle)
        return Contact(touches, point, normal, on_front, obs.base_radius)
    half_length = HALF_LENGTH if obs.half_length is None else obs.half_length
    on_front = soft.greater(point[0], half_length - _SIDE, widths and widths.length)
    normal = soft.where(on_front, 0.0, jnp.sign(point[1]) * jnp.pi / 2)
    return Contact(touches, point, normal, on_front, half_length)


def push_direction(middle: Array, base: Array, target: Array, r: Number) -> Array:
    """Compute D2 [rad] from the positions (2,) [m] of object, base and target in the world."""
    to_target = target - middle
    flips = (planar.norm(to_target) < r) & (jnp.sum(to_target * (base - middle)) > 0)
    return planar.direction(to_target) + jnp.where(flips, jnp.pi, 0.0)


class Way(NamedTuple):
    """Way around the object, D6."""

    side: Array  # [1] 1: counter-clockwise, or -1
    is_direct: Array  # bool or weight: whether W is the staging point
    staging: Array  # (2,) [m]
    aim: Array  # (2,) [m] W


def turn_around(
    psi: Array, offset: Array, side: Array, chooses: Array
) -> tuple[Array, Array, Array]:
    """Return phi and the turn from there to psi + pi [rad], and the side: see D6.

    The `offset` (2,) [m] is from M. Where it `chooses`, the side is that of the shorter turn.
    """
    phi = planar.direction(offset)
    turn = planar.wrap(psi + jnp.pi - phi)
    side = jnp.where(chooses, jnp.where(turn >= 0, 1.0, -1.0), side)
    turn = jnp.mod(side * turn, 2 * jnp.pi)
    return phi, jnp.where(turn > 2 * jnp.pi - _OVERSHOOT, turn - 2 * jnp.pi, turn), side


def way_around(
    middle: Array,  # (2,) [m] M
    psi: Array,  # [rad]
    offset: Array,  # (2,) [m] from M to the axle, or to the middle of the base
    side: Array,  # [1] the last choice
    chooses: Array,  # bool: whether the side is chosen anew
    radius: Number,  # [m] of the circle
    distance: Number,  # [m] of the staging point from M
    ahead: Number,  # [rad] of the aim on the circle
    width: Number | None = None,  # [rad] of the smooth switch
) -> Way:
    """Compute D6: the point that the base drives to, on its way to the staging point."""
    phi, turn, side = turn_around(psi, offset, side, chooses)
    is_direct = soft.greater(ahead, turn, width)
    staging = middle - distance * planar.unit(psi)
    carrot = middle + radius * planar.unit(phi + side * ahead)
    return Way(side, is_direct, staging, soft.where(is_direct, staging, carrot))


def _either(*conditions: Array) -> Array:
    """Return whether one of several conditions holds that exclude each other; a sum of weights."""
    return reduce(lambda a, b: a | b if a.dtype == b.dtype == bool else a + b, conditions)


def step(
    params: UnicycleParams,
    state: UnicycleState,
    obs: Observation,
    temperatures: Widths | None = None,
) -> tuple[UnicycleState, Twist, Details]:
    """Compute one control step; with `temperatures`, the modes and the contact are weights."""
    length, angle, time = temperatures or (None, None, None)
    above, and_, or_, not_, where = soft.greater, soft.and_, soft.or_, soft.not_, soft.where
    axle = jnp.asarray(0.0 if obs.axle is None else obs.axle)
    yaw = jnp.asarray(obs.yaw)
    u = planar.unit(yaw)
    p_world_axle = obs.p_world_robot - axle * u
    push = not_(_either(state.retreat, state.around, state.align))
    current = contact_of(state.p_world_contact, obs, temperatures)
    touches, contact, normal, on_front, half_length = current
    touched = or_(state.touched, touches)
    sensed = obs._replace(p_robot_contact=contact)
    l = where(touches, sensed.l, state.l)  # noqa: E741

    # D1, and the guess D9 after an approach that passes M without contact.
    p_world_contact = obs.p_world_robot + planar.rotate(yaw, contact)
    ahead, last = params.r * planar.unit(yaw + normal), state.p_world_object - p_world_contact
    is_steady = or_(state.pushed, not_(state.touched))
    ahead = planar.direction(where(is_steady, ahead, ahead + last))
    middle = p_world_contact + params.r * planar.unit(ahead)
    middle = where(touches, middle, state.p_world_object)
    t_lost = where(touches, 0.0, state.t_lost + obs.period)
    pushed, is_new = and_(push, or_(state.pushed, touches)), not_(state.pushed)
    front = obs.p_world_robot + half_length * u
    past = above(jnp.sum((front - middle) * u), _PAST, length)
    missed = and_(and_(and_(push, touched), and_(is_new, not_(touches))), past)
    small, is_odd = jnp.abs(state.l) < _MIDDLE, jnp.mod(state.misses, 2) > 0.5
    beside = jnp.stack([jnp.full_like(yaw, -_BESIDE[0]), -_BESIDE[1] * state.side])
    beside = obs.p_world_robot + planar.rotate(yaw, beside)
    guess = jnp.where(small ^ is_odd, beside, front + params.r * u)
    first = state.misses < 0.5
    middle = where(missed, jnp.where(first, p_world_contact, guess), middle)
    p_world_contact = where(missed, jnp.where(first, p_world_contact, front), p_world_contact)
    misses = where(touches, 0.0, where(missed, state.misses + 1, state.misses))

    # D2 and D3.
    d = displacement(sensed)
    distance, e = planar.norm(d), planar.bearing(d, yaw)
    psi = push_direction(middle, p_world_axle, obs.p_world_target, params.r)

    # The end of a push.
    near = above(params.d_near, distance, length)
    spent_near = above(jnp.abs(e), params.e_near, angle)
    spent = or_(above(jnp.abs(l), params.l_edge, length), above(jnp.abs(e), params.e_far, angle))
    spent = where(near, spent_near, spent)
    spent = or_(spent, not_(on_front))
    is_lost = and_(above(t_lost, params.t_lost, time), not_(is_new))
    is_finished = and_(and_(push, touched), or_(or_(and_(touches, spent), is_lost), missed))

    # D6: the side is chosen before the base leaves, and kept on the way.
    offset, chooses = p_world_axle - middle, or_(push, state.retreat)
    chooses = chooses if chooses.dtype == bool else chooses > 0.5
    radii = params.R + axle, params.R_s + axle
    circle = middle, psi, offset, state.side, chooses, *radii, params.carrot
    side, is_direct, staging, aim = way_around(*circle, angle)
    error = planar.wrap(planar.direction(aim - p_world_axle) + jnp.pi - yaw)
    remaining = planar.norm(staging - p_world_axle)
    passed = and_(above(_CLOSE, remaining, length), above(jnp.abs(error), _BEARING, angle))
    is_there = and_(is_direct, or_(above(_ARRIVED, remaining, length), passed))
    face = planar.wrap(psi - yaw)

    # The next modes. A touch of the middle of the front on the way is a push, unless it is spent.
    aligned, in_middle = above(_ALIGNED, jnp.abs(face), angle), above(_MIDDLE, jnp.abs(l), length)
    hits = and_(and_(touches, on_front), in_middle)
    is_corner = above(contact[0], half_length - _CORNER, length)
    stops = and_(and_(touches, is_corner), or_(not_(hits), spent))
    arrives = or_(hits, stops)
    clearance = planar.norm(p_world_contact - obs.p_world_robot) - half_length
    is_clear = above(clearance, params.back, length)
    stopped = and_(_either(state.around, state.align), stops)
    retreat = _either(is_finished, stopped, and_(state.retreat, not_(is_clear)))
    leaves = and_(state.retreat, is_clear)
    around = _either(leaves, and_(and_(state.around, not_(is_there)), not_(arrives)))
    align = _either(and_(state.around, is_there), and_(state.align, not_(aligned)))
    align = and_(align, not_(arrives))

    # D4, D5, D7 and D8.
    v_max, least = jnp.asarray(params.v_max), obs.turning_radius
    far = params.K_e * e + params.K_l * (l - jnp.clip(l, -params.l_dead, params.l_dead))
    arm = jnp.maximum(contact[0], _LEAST_ARM) + axle
    steer = where(near, params.K_near * v_max * jnp.sin(e) / arm, far)
    approach = planar.bearing(middle - p_world_axle, yaw)
    steer = where(touches, steer, where(and_(is_new, touched), approach, 0.0))
    on_spot = 0.0 if least is None else -v_max
    is_large = above(jnp.abs(error), _LARGE, angle)
    drive = where(is_large, on_spot, -v_max * jnp.cos(error))
    v = where(around, drive, where(touched, v_max, params.v_approach))
    v = where(align, on_spot, where(retreat, -v_max, v))
    omega = where(align, face, where(or_(around, retreat), error, steer))
    omega = jnp.clip(omega, -jnp.asarray(params.omega_max), params.omega_max)
    bound = planar.safe_sqrt(jnp.maximum(v_max**2 - (axle * omega) ** 2, 1e-8))
    v = jnp.clip(v, -bound, bound)
    if least is not None:
        omega = jnp.clip(omega, -jnp.abs(v) / least, jnp.abs(v) / least)
    memory = UnicycleState(
        retreat, around, align, middle, p_world_contact, l, touched, t_lost, pushed, side, misses
    )
    details = Details(l, distance, jnp.zeros_like(distance), e, _either(retreat, around, align))
    return memory, Twist(v, axle * omega, omega), details


def memory(state: UnicycleState) -> Memory:
    """Return the mode and the middle M of the object."""
    weights = state.retreat, state.around, state.align
    modes = zip(weights, MODES, strict=True)
    mode = next((words for weight, words in modes if weight > 0.5), "")
    return Memory(mode, state.p_world_object) if state.touched > 0.5 else Memory(mode)


LAW = Law(
    init,
    step,
    check=check,
    bounds=bounds_of(UnicycleParams),
    temperatures=Widths(),
    drives=("omni", "differential", "car"),
    room=1.0,
    memory=memory,
)
_TUNED = UnicycleParams()
# Names of the presets that are tuned for bases with a drive.
PRESET_OF: dict[str, str] = {"differential": "unicycle", "car": "unicycle_car"}
PRESETS = {
    "unicycle": _TUNED,
    "unicycle_car": _TUNED._replace(
        r=0.09525,
        K_e=1.304,
        K_l=7.918,
        l_dead=0.1664,
        l_edge=0.3328,
        e_far=3.054,
        d_near=0.2219,
        e_near=2.412,
        K_near=1.121,
        t_lost=0.2308,
        back=0.01371,
        carrot=1.155,
        R=1.082,
        R_s=0.988,
    ),
    "unicycle_round": _TUNED._replace(
        r=0.2154,
        K_e=0.698,
        K_l=4.354,
        l_dead=0.1978,
        l_edge=0.2193,
        e_far=3.122,
        d_near=0.4278,
        e_near=2.09,
        K_near=2.425,
        t_lost=2.194,
        back=0.15,
        carrot=1.385,
        R=0.9212,
        R_s=0.9204,
    ),
    "unicycle_front": _TUNED._replace(
        r=0.2494,
        K_e=1.542,
        K_l=4.546,
        l_dead=0.1136,
        l_edge=0.2288,
        d_near=0.6886,
        e_near=1.758,
        K_near=1.469,
        t_lost=1.179,
        back=0.103,
        carrot=0.8061,
        e_far=3.2,
        R=1.267,
        R_s=1.267,
    ),
}
