"""Tests of the paper's law, Eqs. 1-10 and Algorithm 1, by golden values and by symmetries.

Golden values are computed by hand from the printed equations. The recurring displacements are
Pythagorean, so that norms and tangents are rational: (0.384, 0.112) has norm 0.4 and tangent 7/24,
(1.2, -0.5) norm 1.3 and tangent -5/12.
"""

from __future__ import annotations

import math

import chex
import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    SEEDS,
    central_differences,
    flatten,
    moved,
    observation,
    property_test,
    refusing,
    row,
)
from hypothesis import strategies as st
from jax.flatten_util import ravel_pytree
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax.control.laws import rps
from rps_jax.control.laws.rps import RPSParams, RPSState, Temperatures
from rps_jax.control.observation import Observation, Twist, displacement

PAPER = RPSParams.paper()
FRONT = 0.3625  # [m] x of a contact on the front face
PERIOD = 0.02  # [s] of the control loop
FREE = {"v_max": 1e6, "omega_max": 1e6}  # shows the equations before saturation
UNBOUNDED = PAPER._replace(**FREE)
UNSATURATED, CLIPPED = {"saturate_first": 0.0}, {"clip_each": 1.0}
SIGNED, LOST = {"zeta": 3.0, "sgn_0": 1.0}, {"v_lost": 0.05, "keep_contact": 1.0}

details_of = jax.jit(rps.step_with_details)
batch_details = jax.jit(jax.vmap(rps.step_with_details))


def observe(d, l=0.0, robot=(0.0, 0.0), yaw=0.0, in_contact=True) -> Observation:  # noqa: E741
    """Return a contact with offset `l` and displacement `d` to the target, by Eq. 4."""
    c, s = math.cos(yaw), math.sin(yaw)
    contact = (robot[0] + c * FRONT - s * l, robot[1] + s * FRONT + c * l)
    target = (contact[0] + d[0], contact[1] + d[1])
    return observation(robot, yaw, (FRONT, l), in_contact, target)


def state_with(l_th: float) -> RPSState:
    return RPSState.init(PAPER)._replace(l_th=jnp.asarray(l_th, float))


def floats(twist) -> tuple[float, ...]:
    return tuple(map(float, twist))


def twist_of(params, observation, l_th=0.24) -> tuple[float, ...]:
    return floats(rps.step(params, state_with(l_th), observation)[1])


def random_worlds(seed: int, n: int = 256, dtype=np.float32):
    """Return random worlds in contact: (state, observation), every leaf batched."""
    rng = default_rng(seed)
    l_th = rng.choice([0.15, 0.24], n)
    contact = np.stack([np.full(n, FRONT), rng.uniform(-0.29, 0.29, n)], -1)
    state = RPSState(l_th.astype(dtype), np.zeros((n, 2), dtype), np.ones(n, bool))
    observation = Observation(
        rng.uniform(-3, 3, (n, 2)).astype(dtype),
        rng.uniform(-math.pi, math.pi, n).astype(dtype),
        contact.astype(dtype),
        np.ones(n, bool),
        rng.uniform(-3, 3, (n, 2)).astype(dtype),
        np.full(n, PERIOD, dtype),
    )
    return jax.tree.map(jnp.asarray, (state, observation))


def random_params(seed: int, n: int, dtype=np.float32) -> RPSParams:
    """Return random parameters near the paper's, every leaf batched."""
    rng = default_rng(seed)
    factor = rng.uniform(0.7, 1.3, (len(PAPER), n))
    params = RPSParams(*(np.asarray(value * f) for value, f in zip(PAPER, factor, strict=True)))
    zeta, gamma_max = rng.uniform(0, 1, n), rng.uniform(1.0, 1.56, n)
    reactive = np.resize([1.0, 0.0, 1.0], n)
    params = params._replace(zeta=zeta, gamma_max=gamma_max, reactive=reactive)
    return jax.tree.map(lambda v: jnp.asarray(v, dtype), params)


# The parameters


def test_the_defaults_are_the_papers_values_of_section_iii_a():
    values = {"eta": 10, "zeta": 0, "beta": 0.12, "k": 60, "K_h": 1, "K_v": 0.1, "L": 0.2}
    values |= {"l_cr": 0.24, "d_th": 0.5, "v_max": 0.05, "omega_max": 0.15, "d_success": 0.05}
    values |= {"v_approach": 0.01, "reactive": 1}
    assert {name: getattr(PAPER, name) for name in values} == values
    assert 0 < PAPER.l_mr < PAPER.l_cr
    assert PAPER.a_r_max == PAPER.eta
    assert 1.5 < PAPER.gamma_max < math.pi / 2
    assert RPSParams.nps() == PAPER._replace(reactive=0.0)
    assert RPSParams.unsaturated() == PAPER._replace(**UNSATURATED)
    state = RPSState.init(PAPER._replace(l_cr=0.2))
    assert (state.l_th, state.touched) == (jnp.float32(0.2), False)


BAD = [math.nan, -0.1, -math.inf, math.inf, "much", None, (1.0, 2.0)]
MUST_BE_POSITIVE = ("K_h", "K_v", "L", "l_cr", "v_max", "omega_max", "d_success", "gamma_max")


@pytest.mark.parametrize("name", RPSParams._fields)
def test_check_names_the_parameter_that_is_not_allowed(name):
    """Allowed are zeros of some parameters, and an infinite gamma_max, the tangent as printed."""
    allowed = {("zeta", -0.1), ("gamma_max", math.inf)}
    values = [value for value in BAD if (name, value) not in allowed]
    values += [0.0] if name in MUST_BE_POSITIVE else []
    values += [1.5] if name == "reactive" else []
    for value in values:
        with refusing(rf"\b{name} = "):
            rps.check(PAPER._replace(**{name: value}))
    unchanged = [PAPER, RPSParams.nps(), PAPER._replace(gamma_max=math.inf)]
    unchanged += [PAPER._replace(**{name: 0.0})] if name not in MUST_BE_POSITIVE else []
    for params in unchanged:
        assert rps.check(params) is params


# The equations, one by one


@pytest.mark.parametrize(
    ("l", "distance", "expected"),
    [
        (0.12, 1.0, 5.0),  # the inflection: 10 / (1 + e^0)
        (-0.12, 1.0, -5.0),  # sgn(l)
        (0.18, 1.0, 9.734030),  # 10 / (1 + e^-3.6), e^-3.6 = 0.02732372
        (0.06, 1.0, 0.265970),  # 10 / (1 + e^3.6), e^3.6 = 36.59823
        (0.24, 1.0, 9.992540),  # 10 / (1 + e^-7.2), e^-7.2 = 7.465858e-4
        (-0.01, 1.0, -0.013585),  # -10 / (1 + e^6.6), e^6.6 = 735.0952
        (1e-6, 1.0, 0.007461),  # 10 / (1 + e^7.2): not zero beside the centre
        (0.0, 1.0, 0.0),  # sgn(0) = 0
        (2.0, 1.0, 10.0),  # eta, the upper asymptote
        (0.12, 0.49, 0.0),
        (0.12, 0.5, 0.0),  # it switches off at d_th
        (0.12, np.nextafter(np.float32(0.5), np.float32(1)), 5.0),
    ],
)
def test_eq_5_gives_the_adaptive_rate_by_hand(l, distance, expected):  # noqa: E741
    # The slope of the curve, at most eta k / 4 = 150 per metre, amplifies float32's rounding of l.
    a_r = rps.adaptive_rate(PAPER, jnp.float32(l), jnp.float32(distance))
    assert a_r == pytest.approx(expected, rel=5e-5, abs=1e-6)


def test_eq_5_has_the_lower_asymptote_zeta_and_the_upper_asymptote_eta():
    params = PAPER._replace(zeta=2.0, beta=0.5, k=200.0)
    a_r = rps.adaptive_rate(params, jnp.array([0.01, 0.5, -0.99]), jnp.ones(3))
    assert_allclose(a_r, [2.0, 6.0, -10.0], rtol=1e-5)


@pytest.mark.parametrize(
    ("v_star", "a_r", "expected"),
    [
        (0.05, 0.0, (0.05, 0.0)),
        (0.05, 0.75, (0.04, 0.03)),  # sqrt(1 + 9/16) = 5/4
        (0.13, -2.4, (0.05, -0.12)),  # sqrt(1 + 144/25) = 13/5
        (1.0, 10.0, (0.0995037, 0.995037)),  # 1 / sqrt(101)
        (0.0, 10.0, (0.0, 0.0)),
        (1.0, 1e30, (1e-30, 1.0)),  # a_r^2 is beyond float32
    ],
)
def test_eqs_1_and_2_split_the_speed_by_the_slope(v_star, a_r, expected):
    assert_allclose(rps.linear_velocity(v_star, a_r), expected, rtol=1e-6)


def test_eq_4_points_from_the_contact_to_the_target_in_the_world():
    # At yaw 90 degrees the robot's x is the world's y, and its y the world's -x:
    # the contact (0.3, 0.1) of a robot at (2, -1) is at (2 - 0.1, -1 + 0.3).
    obs = observation((2.0, -1.0), math.pi / 2, (0.3, 0.1), True, (3.0, 3.0))
    assert_allclose(displacement(obs), [1.1, 3.7], rtol=1e-6)


@pytest.mark.parametrize(
    ("d", "yaw", "K_h", "expected"),
    [
        ((1.0, 1.0), 0.0, 1.0, math.pi / 4),
        ((1.0, 1.0), math.pi / 2, 1.0, -math.pi / 4),
        ((0.0, 2.0), 0.5, 0.5, 0.5 * (math.pi / 2 - 0.5)),
        # 3 - (-3) = 6 rad wraps to 6 - 2 pi, and only then meets the gain.
        ((math.cos(3), math.sin(3)), -3.0, 0.5, 0.5 * (6 - 2 * math.pi)),
        ((0.0, 0.0), 0.25, 1.0, -0.25),  # no direction: 0
    ],
)
def test_eq_7_is_the_gain_times_the_wrapped_heading_error(d, yaw, K_h, expected):
    gamma = rps.steering_angle(PAPER._replace(K_h=K_h), jnp.array(d), jnp.float32(yaw))
    assert gamma == pytest.approx(expected, abs=2e-6)


def test_gamma_is_clipped_to_gamma_max():
    errors_ = jnp.array([1.5, 1.57, 3.0, -1.57, -3.0])
    d = jnp.stack([jnp.cos(errors_), jnp.sin(errors_)], -1)
    gamma = rps.steering_angle(PAPER, d, jnp.zeros(5))
    assert_allclose(gamma, [1.5, 1.56, 1.56, -1.56, -1.56], rtol=1e-6)
    as_printed = rps.steering_angle(PAPER._replace(gamma_max=math.inf), d, jnp.zeros(5))
    assert_allclose(as_printed, errors_, rtol=1e-6)


def test_eq_9_falls_linearly_from_the_centre_to_the_critical_region():
    sigma = rps.realignment_gain(PAPER, jnp.array([0.0, 0.06, -0.12, 0.24, -0.24, 0.29, 9.0]))
    assert_allclose(sigma, [1.0, 0.75, 0.5, 0.0, 0.0, 0.0, 0.0], atol=1e-6)


# Whole steps by hand


# The contact at l, and a displacement d: 3 rad to the side, or a norm of 0.4 or 1.3.
NEAR, FAR, BEHIND = (0.384, 0.112), (1.2, -0.5), (math.cos(3), math.sin(3))
UNREACHABLE = [
    observe((0.0, 0.0))._replace(p_world_robot=-jnp.array(p), p_world_target=jnp.array(p))
    for p in np.float32([[3.4e38, 0.0], [1e30, 0.0], [3.4e38, 3.4e38]])
]
SATURATED = (0.00980581, 0.0490290)  # v = (0.05, 0.25) / sqrt(26)
REALIGNING = (0.00497519, -0.0497519, -0.0260417)  # v = (0.05, -0.5) / sqrt(101)


@pytest.mark.parametrize(
    ("case", "changes", "observation", "l_th", "expected"),
    [
        # v* = 0.1 is scaled to 0.05.
        ("straight ahead, far", {}, observe((1.0, 0.0)), 0.24, (0.05, 0.0, 0.0)),
        # ||d|| = 0.4 < d_th: a_r = 0. omega = 0.04 / 0.2 * 7/24.
        ("near, to the left", {}, observe(NEAR, l=0.1), 0.24, (0.04, 0.0, 0.0583333)),
        # v* = 0.13, a_r = 5, v_x = 0.13 / sqrt(26); omega = v_x / 0.2 * (-5/12), Eq. 6.
        ("no limits", FREE, observe(FAR, l=0.12), 0.24, (0.0254951, 0.1274755, -0.0531148)),
        # v* = 0.13, |l| = 0.18: sigma = 1/4; omega = 0.25 * 0.13 / 0.2 * (-5/12), Eq. 8.
        ("no limits", FREE, observe(FAR, l=-0.18), 0.15, (0.0129355, -0.1293548, -0.0677083)),
        # (0.0255, 0.1275) is scaled to norm 0.05.
        # omega has the saturated v_x: 0.00980581 / 0.2 * -5/12; the unsaturated is 0.0254951.
        ("v saturates", {}, observe(FAR, l=0.12), 0.24, (*SATURATED, -0.0204288)),
        ("unsaturated", UNSATURATED, observe(FAR, l=0.12), 0.24, (*SATURATED, -0.0531148)),
        ("clipped", CLIPPED, observe(FAR, l=0.12), 0.24, (0.0254951, 0.05, -0.0531148)),
        # omega = 0.25 * 0.05 / 0.2 * -5/12, and with 0.13 instead of 0.05 -0.0677.
        ("realigning", {}, observe(FAR, l=-0.18), 0.15, REALIGNING),
        ("unsaturated", UNSATURATED, observe(FAR, -0.18), 0.15, (*REALIGNING[:2], -0.0677083)),
        # As above with tangent -12/5: -0.11767; with the unsaturated v_x -0.30594 is clipped.
        ("steep", {}, observe((0.5, -1.2), l=0.12), 0.24, (*SATURATED, -0.1176697)),
        ("both", UNSATURATED, observe((0.5, -1.2), l=0.12), 0.24, (*SATURATED, -0.15)),
        # |l| > l_cr: a_r = 10, sigma = 0. v* = 0.13 scaled to 0.05.
        ("critical region", {}, observe(FAR, l=0.25), 0.24, (0.00497519, 0.0497519, 0.0)),
        # v* = 0.04, a_r = -10 although ||d|| < d_th; omega = 1/4 * 0.04 / 0.2 * 7/24.
        ("realigning, near", {}, observe(NEAR, -0.18), 0.15, (0.00398015, -0.0398015, 0.0145833)),
        # Equal l and d, not realigning: a_r = 0.
        ("normal, near", {}, observe(NEAR, l=-0.18), 0.24, (0.04, 0.0, 0.0583333)),
        # Heading error 3 rad, gamma = 1.56, tan = 92.6: 0.05 / 0.2 * 92.6 is clipped.
        ("behind", {}, observe(BEHIND), 0.24, (0.05, 0.0, 0.15)),
        # A centred contact has no sign; else a_r = 3 + 7 / (1 + e^7.2) = 3.00522.
        ("centred", {"zeta": 3.0}, observe((2.0, 0.0)), 0.24, (0.05, 0.0, 0.0)),
        ("sign", SIGNED, observe((2.0, 0.0)), 0.24, (0.0157867, 0.0474424, 0.0)),
        # The farthest targets are reached at full speed.
        ("farthest", {}, UNREACHABLE[0], 0.24, (0.05, 0.0, 0.0)),
        ("far away", {}, UNREACHABLE[1], 0.24, (0.05, 0.0, 0.0)),
        ("far aside", {}, UNREACHABLE[2], 0.24, (0.05, 0.0, 0.15)),
        # Before the first contact the speed is v_approach, independent of v_lost.
        ("no contact", LOST, observe((1.0, 0.0), in_contact=False), 0.24, (0.01, 0.0, 0.0)),
        ("on the target", {}, observe((0.0, 0.0), in_contact=False), 0.24, (0.01, 0.0, 0.0)),
    ],
)
def test_one_step_by_hand(case, changes, observation, l_th, expected):
    twist = twist_of(PAPER._replace(**changes), observation, l_th)
    assert twist == pytest.approx(expected, rel=1e-4, abs=2e-7), case


def test_the_tangent_as_printed_turns_away_from_a_target_behind():
    # v_x = 0.05, omega = 0.05 / 0.2 * tan(error): tan is positive at 1.5 and negative at 1.7.
    as_printed = PAPER._replace(gamma_max=math.inf, omega_max=100.0)
    for error in (1.5, 1.7, 3.0, -1.5, -1.7, -3.0):
        observation = observe((math.cos(error), math.sin(error)))
        omega = twist_of(as_printed, observation)[2]
        assert omega == pytest.approx(0.25 * math.tan(error), rel=1e-3)
        assert (omega * error > 0) == (abs(error) < math.pi / 2)
        assert twist_of(PAPER, observation)[2] * error > 0


def after_a_loss(d=FAR, **changes):
    """Return twists one step after a contact at l = 0.12, and in contact."""
    params = PAPER._replace(**changes)
    state, touching = rps.step(params, RPSState.init(params), observe(d, l=0.12))
    _, twist = rps.step(params, state, observe(d, l=0.12, in_contact=False))
    return np.stack(twist), np.stack(touching)


def test_after_a_loss_the_robot_moves_ahead_or_uses_the_last_contact():
    assert_allclose(after_a_loss()[0], [0.01, 0.0, 0.0])
    assert_allclose(after_a_loss(v_lost=0.05)[0], [0.05, 0.0, 0.0])
    # The robot has not moved, so the last contact gives an equal twist.
    assert_allclose(*after_a_loss(keep_contact=1.0), rtol=1e-6)
    # The last contact on the target does not stop the robot.
    on_target, _ = after_a_loss((0.02, 0.0), keep_contact=1.0)
    assert_allclose(on_target, [0.01, 0.0, 0.0])


# Algorithm 1


@pytest.mark.parametrize("side", [1, -1])
def test_realignment_starts_above_l_cr_and_lasts_until_l_mr(side):
    #      far   l_cr  above  moving inwards    l_mr  as before
    ls = [0.20, 0.24, 0.241, 0.23, 0.20, 0.151, 0.15, 0.20, 0.24]
    realigns = [False, False, True, True, True, True, False, False, False]
    state = RPSState.init(PAPER)
    thresholds, states = [], []
    for l in ls:  # noqa: E741
        state, _, details = details_of(PAPER, state, observe((1.0, 0.3), side * l))
        thresholds.append(float(state.l_th))
        states.append(bool(details.realigning))
        assert details.l == pytest.approx(side * l)
        if details.realigning:
            assert details.a_r == side * 10
    assert states == realigns
    assert thresholds == pytest.approx([0.15 if r else 0.24 for r in realigns])


@pytest.mark.parametrize(("l", "l_th"), [(0.2, 0.15), (0.1, 0.15), (0.28, 0.24), (0.0, 0.24)])
def test_at_the_target_the_robot_stops_and_the_threshold_is_unchanged(l, l_th):  # noqa: E741
    state, twist, details = details_of(PAPER, state_with(l_th), observe((0.03, -0.039), l))
    assert floats(twist) == (0.0, 0.0, 0.0)
    assert state.l_th == jnp.float32(l_th)
    assert not details.realigning


def test_the_target_is_reached_strictly_within_d_success():
    def at(distance):  # exactly representable: the contact is at the origin
        return observation((0.0, 0.0), 0.0, (0.0, 0.0), True, (distance, 0.0))

    d_success = np.float32(0.05)
    assert twist_of(PAPER, at(d_success))[0] == pytest.approx(0.005)
    assert twist_of(PAPER, at(np.nextafter(d_success, np.float32(0))))[0] == 0.0


@pytest.mark.parametrize("l_th", [0.24, 0.15])
def test_without_contact_the_robot_moves_ahead_and_the_threshold_is_unchanged(l_th):
    """The contact location may be NaN."""
    for params, location in ((PAPER, (FRONT, 0.2)), (RPSParams.nps(), (np.nan, np.nan))):
        start = state_with(l_th)._replace(p_robot_contact=jnp.array([FRONT, 0.27]))
        observation = observe((1.0, 2.0), in_contact=False)
        observation = observation._replace(p_robot_contact=jnp.array(location))
        state, twist, details = details_of(params, start, observation)
        assert floats(twist) == (pytest.approx(0.01), 0.0, 0.0)
        assert state.l_th == jnp.float32(l_th)
        assert not details.realigning
        chex.assert_tree_all_finite((state, details))


def test_the_state_has_the_last_contact_and_whether_there_was_one():
    state = RPSState.init(PAPER)
    state, _ = rps.step(PAPER, state, observe((1.0, 0.0), l=0.27, in_contact=False))
    assert not state.touched
    state, _ = rps.step(PAPER, state, observe((1.0, 0.0), l=0.1))
    state, _ = rps.step(PAPER, state, observe((1.0, 0.0), l=0.27, in_contact=False))
    assert state.touched
    assert_allclose(state.p_robot_contact, [FRONT, 0.1], rtol=1e-6)


# Laws


@property_test(SEEDS)
def test_nps_never_moves_laterally_and_never_realigns(seed):
    state, observation = random_worlds(seed)
    nps = random_params(seed, 256)._replace(reactive=jnp.zeros(256))
    new, twist, details = batch_details(nps, state, observation)
    assert (twist.v_y == 0).all()
    assert not details.realigning.any()
    arrived = details.distance < nps.d_success
    assert_array_equal(new.l_th, np.where(arrived, state.l_th, nps.l_cr))


@property_test(SEEDS)
def test_a_mirrored_world_gives_the_mirrored_twist(seed):
    state, observation = random_worlds(seed)
    params = random_params(seed, 256)
    mirrored = moved(observation, mirror=True)
    new, twist, details = batch_details(params, state, observation)
    new_m, twist_m, details_m = batch_details(params, state, mirrored)
    d = jax.vmap(displacement)(observation)
    error = np.arctan2(d[:, 1], d[:, 0]) - observation.yaw
    regular = np.abs(np.cos(error / 2)) > 1e-4  # at +-pi the law chooses a side
    assert regular.mean() > 0.9
    assert_allclose(twist_m.v_x, twist.v_x, rtol=1e-5)
    assert_allclose(twist_m.v_y, -twist.v_y, rtol=1e-5)
    assert_allclose(twist_m.omega[regular], -twist.omega[regular], atol=1e-4)
    assert_array_equal(details_m.realigning, details.realigning)
    assert_array_equal(new_m.l_th, new.l_th)


@property_test(SEEDS, st.floats(-10, 10), st.floats(-50, 50))
def test_the_twist_does_not_depend_on_the_worlds_origin_and_axes(seed, turn, shift):
    with jax.enable_x64(True):
        state, observation = random_worlds(seed, dtype=np.float64)
        params = random_params(seed, 256, np.float64)
        expected = batch_details(params, state, observation)
        got = batch_details(params, state, moved(observation, turn, shift))
        chex.assert_trees_all_close(got, expected, atol=1e-8)


def any_finite_floats(rng, shape) -> np.ndarray:
    """Return random bit patterns, with all magnitudes equally likely, and many large values."""
    x = rng.integers(0, 2**32, shape, dtype=np.uint32).view(np.float32)
    largest = np.finfo(np.float32).max
    special = rng.choice(np.float32([largest, -largest, 0, -0.0, 1e38, -1e38, 1, 1e-45]), shape)
    return np.where(np.isfinite(x) & (rng.random(shape) < 0.7), x, special)


@property_test(SEEDS)
def test_for_any_finite_input_the_twist_is_finite_and_within_bounds(seed):
    rng = default_rng(seed)
    x = any_finite_floats(rng, (256, 9))
    params = random_params(seed, 256)
    params = params._replace(gamma_max=jnp.asarray(rng.choice([1.56, np.inf], 256), jnp.float32))
    l_th = jnp.asarray(rng.choice([0.15, 0.24], 256), jnp.float32)
    state = RPSState(l_th, x[:, :2], rng.random(256) < 0.5)
    touching, period = rng.random(256) < 0.8, np.full(256, PERIOD, np.float32)
    observation = Observation(x[:, 2:4], x[:, 4], x[:, 5:7], touching, x[:, 7:9], period)
    new, twist, details = batch_details(params, state, observation)
    chex.assert_tree_all_finite((new, twist, details))
    speed = np.hypot(np.float64(twist.v_x), np.float64(twist.v_y))
    assert (speed <= np.maximum(params.v_max, params.v_approach) * (1 + 1e-6)).all()
    assert (np.abs(twist.omega) <= params.omega_max).all()
    assert (twist.v_x >= 0).all()


@property_test(st.floats(-100, 100), st.floats(-100, 100), st.floats(-100, 100))
def test_saturation_keeps_the_direction_and_allowed_twists(v_x, v_y, omega):
    v_x, v_y, omega = map(np.float32, (v_x, v_y, omega))
    out = rps.saturate(PAPER, Twist(v_x, v_y, omega))
    speed = math.hypot(v_x, v_y)
    scale = min(1.0, 0.05 / speed) if speed > 0 else 1.0
    assert out.v_x == pytest.approx(v_x * scale, rel=1e-5, abs=1e-30)
    assert out.v_y == pytest.approx(v_y * scale, rel=1e-5, abs=1e-30)
    assert out.omega == pytest.approx(min(max(omega, -0.15), 0.15))


# Derivatives with respect to all parameters and observations

_, unravel = ravel_pytree((PAPER, observe((1.0, 0.0))[:3], jnp.zeros(2)))


def twist_vector(x, l_th):
    """Return the twist (3,) of flattened parameters and observation x, in contact."""
    params, (p_world_robot, yaw, contact), target = unravel(x)
    observation = Observation(p_world_robot, yaw, contact, jnp.array(True), target)
    state = RPSState(l_th, jnp.zeros(2, x.dtype), jnp.array(True))
    return jnp.stack(rps.step_with_details(params, state, observation)[1])


batch_twist = jax.jit(jax.vmap(twist_vector))
forward = jax.jit(jax.vmap(jax.jacfwd(twist_vector)))
reverse = jax.jit(jax.vmap(jax.jacrev(twist_vector)))


def singular_worlds() -> list[tuple[RPSParams, Observation]]:
    """Return worlds where a careless derivative is 0/0 or infinite."""
    as_printed = PAPER._replace(gamma_max=math.inf)
    worlds = [
        (as_printed, observe((math.cos(error), math.sin(error)), l))
        for error in (0.0, 1.0, -1.5, 1.7, -3.0)
        for l in (0.0, 0.1, -0.25)  # noqa: E741
    ]
    for params in (PAPER, RPSParams.nps(), PAPER._replace(zeta=1.0)):
        for l in (0.0, 0.12, 0.15, -0.24, 0.29, 5.0, -1e6):  # noqa: E741
            worlds += [
                (params, observe((0.0, 0.0), l)),  # the target on the contact
                (params, observe((-1.0, 0.0), l)),  # heading error exactly pi
                (params, observe((-1.0, -0.0), l)),
                (params, observe((1e-30, 1e-30), l)),
                (params, observe((0.05, 0.0), l)),
                (params, observe((0.5, 0.0), l)),
                (params, observe((0.0, 1.0), l)),
                (params, observe((1e6, -1e6), l, robot=(-1e6, 1e6), yaw=1e6)),
            ]
    for yaw in (0.0, math.pi, -math.pi):  # exactly, at the origin
        for target in ((0.0, 0.0), (1.0, 0.0)):
            worlds += [(PAPER, observation((0.0, 0.0), yaw, (0.0, 0.0), True, target))]
    return worlds


def test_derivatives_are_finite_at_every_singular_point():
    worlds = singular_worlds()
    params, observation = jax.tree.map(lambda *v: np.stack([np.float32(u) for u in v]), *worlds)
    x = flatten((params, observation[:3], observation.p_world_target)).astype(np.float32)
    assert len(x) <= 256
    x = np.resize(x, (256, x.shape[1]))  # the shape of the other tests
    for l_th in (0.24, 0.15):
        for jacobian in (forward, reverse):
            chex.assert_tree_all_finite(jacobian(x, np.full(256, l_th, np.float32)))


@property_test(hnp.arrays(np.float32, (256, 7), elements=st.floats(-1e6, 1e6, width=32)), SEEDS)
def test_derivatives_are_finite_for_any_sensible_input(x, seed):
    params = np.stack(random_params(seed, 256), axis=1)
    x = np.concatenate([params, x], axis=1)
    l_th = np.resize(np.float32([0.24, 0.15]), 256)
    ahead, back = forward(x, l_th), reverse(x, l_th)
    chex.assert_tree_all_finite((ahead, back))


def test_derivatives_agree_with_each_other_and_with_finite_differences():
    n, h = 256, 1e-6
    with jax.enable_x64(True):
        state, observation = random_worlds(1, n, np.float64)
        params = random_params(2, n, np.float64)
        x = flatten((params, observation[:3], observation.p_world_target))
        l_th = np.asarray(state.l_th)
        ahead, back = np.asarray(forward(x, l_th)), np.asarray(reverse(x, l_th))
        differences, bend = central_differences(lambda x: batch_twist(x, l_th), x, h)
    kink = bend > 1e-2
    assert kink.mean() < 0.1
    assert_allclose(ahead, back, rtol=1e-8, atol=1e-10)
    scale = 1 + np.abs(differences)
    assert (np.abs(differences - ahead) / scale)[~kink].max() < 1e-4


def test_without_contact_a_nan_location_keeps_derivatives_finite():
    observation = observe((1.0, 0.0), in_contact=False)
    observation = observation._replace(p_robot_contact=jnp.full(2, jnp.nan))

    def forward_speed(params):
        return sum(rps.step(params, RPSState.init(PAPER), observation)[1])

    gradient = jax.grad(forward_speed)(jax.tree.map(jnp.float32, PAPER))
    expected = jax.tree.map(jnp.zeros_like, gradient)._replace(v_approach=jnp.float32(1.0))
    chex.assert_trees_all_close(gradient, expected)


# As a JAX program


def test_a_batch_over_every_leaf_equals_a_loop_over_worlds():
    n = 24
    params = random_params(3, n)
    state, observation = random_worlds(4, n)
    observation = observation._replace(in_contact=jnp.arange(n) % 5 > 0)
    batch = jax.jit(jax.vmap(rps.step))(params, state, observation)
    one_by_one = [rps.step(*row((params, state, observation), i)) for i in range(n)]
    loop = jax.tree.map(lambda *v: jnp.stack(v), *one_by_one)
    chex.assert_trees_all_close(batch, loop, rtol=1e-5, atol=1e-5)


def test_float64_agrees_with_float32():
    state, observation = random_worlds(6)
    params = random_params(7, 256)
    single = batch_details(params, state, observation)
    with jax.enable_x64(True):
        wide = jax.tree.map(
            lambda v: v.astype(np.float64) if v.dtype == np.float32 else v,
            jax.tree.map(np.asarray, (params, state, observation)),
        )
        double = batch_details(*wide)
        assert {v.dtype for v in double[1]} == {np.dtype(np.float64)}
    assert_array_equal(single[2].realigning, double[2].realigning)
    chex.assert_trees_all_close(
        jax.tree.map(np.float64, single), jax.tree.map(np.float64, double), atol=1e-4
    )


@pytest.mark.parametrize("x64", [False, True])
@pytest.mark.parametrize(
    ("in_contact", "heat"), [(False, ()), (True, ()), (1.0, (Temperatures(),))]
)
def test_a_step_preserves_the_dtypes_of_the_state(x64, in_contact, heat):
    with jax.enable_x64(x64):
        start = RPSState.init(PAPER, *heat)
        new, twist = rps.step(PAPER, start, observe((1.0, 0.2), 0.1, in_contact=in_contact), *heat)
        kinds = [jax.tree.map(lambda v: (v.dtype, v.weak_type), s) for s in (start, new)]
        assert kinds[0] == kinds[1]
        assert {v.dtype for v in twist} == {jnp.zeros(()).dtype}


def test_float32_stays_float32_where_float64_is_enabled():
    params, (start, observation) = row((random_params(8, 1), random_worlds(8, 1)), 0)
    with jax.enable_x64(True):
        new, twist = rps.step(params, start, observation)
        assert new.l_th.dtype == new.p_robot_contact.dtype == jnp.float32
        assert {v.dtype for v in twist} == {np.dtype(np.float32)}


def test_tuned_laws_keep_the_order_of_saturation_of_their_tuning(tmp_path):
    """A file of parameters that omits it is unambiguous for these alone."""
    from rps_jax.control import registry

    everywhere = registry._HIDDEN | registry.LAWS
    names = ("_guided", *registry.PACKAGE_LAWS)  # without those of other tests
    leaves = {name: registry.named_leaves(everywhere[name]) for name in names}
    orders = {
        name: value
        for name, values in leaves.items()
        for path, value in values.items()
        if path.endswith("saturate_first")
    }
    tuned = ("rps_tuned", "rps_unsaturated", "rps_plus", "_guided")
    repositions = ("rps_reposition", "rps_reposition_round")
    unsaturated = dict.fromkeys((*tuned, *repositions), 0.0)
    assert orders == {"rps": 1.0, "nps": 1.0} | unsaturated
    path = tmp_path / "tuned.json"
    path.write_text('{"K_h": 0.3}')
    assert registry.parse_law("rps,K_h=0.3")[1] == PAPER._replace(K_h=0.3)
    for name, changes in (("rps_tuned", ""), ("rps_unsaturated", ""), ("rps", ",saturate_first=0")):
        _, params = registry.parse_law(f"{name},{path}{changes}")
        assert params == registry.LAWS[name]._replace(K_h=0.3, saturate_first=0.0)


def test_help_has_the_units_and_equations_of_every_parameter():
    from rps_jax.control import registry

    for params in set(map(type, registry.LAWS.values())):
        for name in params._fields if params.__module__.startswith("rps_jax.control.laws") else ():
            assert "Alias for field" not in getattr(params, name).__doc__, (params, name)
    assert RPSParams.K_h.__doc__ == "[1] heading gain, Eq. 7"
