"""The smooth law and skin converge to the hard ones and share their properties."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import test_law
from helpers import (
    FRONT,
    PAPER,
    SEEDS,
    SETTLED,
    SIDE,
    case,
    central_differences,
    flatten,
    jitted,
    moved,
    property_test,
    refusing,
    setting_of,
    slow,
)
from helpers import box as box_at
from jax.flatten_util import ravel_pytree
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from test_skin import BATCH, mirrored, random_shapes, sense_all

from rps_jax.control import registry
from rps_jax.control.laws import rps, rps_plus
from rps_jax.control.laws.pursuit import PursuitParams
from rps_jax.control.laws.rps import RPSParams, RPSState, Temperatures
from rps_jax.control.laws.rps_plus import RPSPlusParams
from rps_jax.control.observation import Observation
from rps_jax.geometry.footprint import Footprint
from rps_jax.robot.skin import NONE, CapacitiveSkin
from rps_jax.trials import pushes, trial
from rps_jax.trials.pushes import Case
from rps_jax.trials.trial import ControlLoop

WARM = Temperatures()
COLD = Temperatures(1e-6, 1e-6, 1e-6, 1e-6)
WORLDS = 256


any_seed = property_test(SEEDS)


# The law


def observe(d, l=0.0, in_contact=1.0) -> Observation:  # noqa: E741
    """Return an observation: robot at the origin, contact at offset `l`, `d` to the target."""
    return test_law.observe(d, l)._replace(in_contact=jnp.asarray(in_contact, float))


def state_with(l_th: float = 0.24, touched: float = 1.0) -> RPSState:
    first = RPSState.init(PAPER, WARM)
    return first._replace(l_th=first.l_th * 0 + l_th, touched=first.touched + touched)


@jax.jit
def one_step(state, observation):
    return rps.step_with_details(PAPER, state, observation, WARM)


def random_worlds(seed: int, dtype=np.float32):
    """Plausible (params, state, observation), batched; contacts are 0 or 1, or in between."""
    rng, n = default_rng(seed), WORLDS
    cast = lambda x: jnp.asarray(x, dtype)  # noqa: E731
    params = test_law.random_params(seed, n, dtype)
    params = params._replace(keep_contact=cast(rng.choice([0.0, 1.0], n)), sgn_0=0 * params.sgn_0)
    last = np.stack([np.full(n, FRONT), rng.uniform(-SIDE, SIDE, n)], -1)
    values = rng.uniform(0.15, 0.24, n), last, rng.choice([0.0, 1.0], n)
    weight = cast(rng.choice([0.0, 1.0], n, p=[0.2, 0.8]))
    _, observation = test_law.random_worlds(seed, n, dtype)
    return params, RPSState(*map(cast, values)), observation._replace(in_contact=weight)


@jitted
def hard(params, state, observation):
    state = state._replace(touched=state.touched > 0.5)
    observation = observation._replace(in_contact=observation.in_contact > 0.5)
    return jax.vmap(rps.step_with_details)(params, state, observation)


@jitted
def smooth(params, state, observation, temperatures):
    step = jax.vmap(rps.step_with_details, in_axes=(0, 0, 0, None))
    return step(params, state, observation, temperatures)


def clear(params, state, observation, details) -> np.ndarray:
    """Return (n,) whether every switch is farther from its surface than 0.1 mm."""
    l, distance = np.abs(details.l), details.distance  # noqa: E741
    near = [l - state.l_th, l, distance - params.d_th, distance - params.d_success]
    sure = np.min(np.abs(near), axis=0) > 1e-4
    assert sure.mean() > 0.9
    return sure


def flat_numbers(results) -> np.ndarray:
    """Return all results of a step as (n, ...), with bools as 0 and 1."""
    return flatten(results).astype(float)


@any_seed
def test_without_heat_the_smooth_law_is_the_law_away_from_its_switches(seed):
    worlds = random_worlds(seed)
    exact, cold = hard(*worlds), smooth(*worlds, COLD)
    sure = clear(*worlds, exact[2])
    soft, plain = (flat_numbers(outputs)[sure] for outputs in (cold, exact))
    assert_allclose(soft, plain, rtol=1e-4, atol=1e-5)


@any_seed
def test_each_switch_converges_to_the_laws_with_its_temperature(seed):
    params, state, observation = random_worlds(seed)
    params = params._replace(zeta=0 * params.zeta, k=0 * params.k)  # a_r is eta / 2, but for them
    observation = observation._replace(in_contact=jnp.ones(WORLDS))
    worlds = (params, state, observation)
    exact = hard(*worlds)[2]
    sure = clear(*worlds, exact)  # a cold switch at its very edge hides what a warm one does
    for name, value in WARM._asdict().items():
        temperatures = (COLD._replace(**{name: factor * value}) for factor in (1.0, 0.3, 0.1))
        warmer = [smooth(*worlds, warm)[2] for warm in temperatures]
        gaps = [abs(x.a_r - exact.a_r) + abs(x.realigning - exact.realigning) for x in warmer]
        assert (np.diff(gaps, axis=0) <= 1e-4)[:, sure].all(), name


@any_seed
def test_the_whole_law_converges_as_all_temperatures_fall(seed):
    worlds = random_worlds(seed)
    exact = flat_numbers(hard(*worlds)[:2])
    gaps = []
    for factor in (4.0, 1.0, 0.25, 0.06, 0.015):
        warm = smooth(*worlds, Temperatures(*factor * np.array(WARM)))[:2]
        gaps.append(np.abs(flat_numbers(warm) - exact).mean())
    assert (np.diff(gaps) < 0).all()
    assert gaps[-1] < 0.2 * gaps[0]


def test_on_its_surface_a_switch_is_half_on():
    for d, rate in ((0.5, 2.5), (9.0, 5.0)):  # at d_th eta / 2 / 2, beyond eta / 2
        adaptive = rps.adaptive_rate(PAPER, jnp.float32(0.12), jnp.float32(d), WARM)
        assert adaptive == pytest.approx(rate, rel=1e-4)
    assert one_step(state_with(0.2), observe((1.0, 0.0), l=0.2))[2].realigning == pytest.approx(0.5)
    # At d_success, half of K_v d_success.
    _, twist, _ = one_step(state_with(), observe((0.05, 0.0)))
    assert twist.v_x == pytest.approx(0.0025, rel=1e-4)


def test_the_threshold_lies_between_its_values_by_the_realignments_weight():
    # |l| is one temperature beyond l_th: 1 / (1 + 1/e) = 0.7310586 of l_mr, the rest of l_cr.
    state, _, details = one_step(state_with(0.2), observe((1.0, 0.0), l=-0.21))
    assert details.realigning == pytest.approx(0.7310586, rel=1e-4)
    assert state.l_th == pytest.approx(0.7310586 * 0.15 + 0.2689414 * 0.24, rel=1e-4)


@pytest.mark.parametrize("side", [1, -1])
def test_the_realignment_state_keeps_its_memory(side):
    """Between l_mr and l_cr the law realigns only on the way in, as the hard law does."""
    out, into = np.linspace(0.0, 0.29, 300), np.linspace(0.29, 0.0, 300)

    def step(state, l):  # noqa: E741
        contact = jnp.stack([jnp.float32(FRONT), side * l])
        observation = observe((1.0, 0.3))._replace(p_robot_contact=contact)
        state, _, details = rps.step_with_details(PAPER, state, observation, WARM)
        return state, details.realigning

    ls = jnp.asarray(np.concatenate([out, into]), jnp.float32)
    _, weight = jax.jit(lambda ls: jax.lax.scan(step, state_with(), ls))(ls)
    going, coming = np.asarray(weight[:300]), np.asarray(weight[300:])[::-1]
    middle = out.searchsorted(0.195)
    assert going[middle] < 0.1
    assert coming[middle] > 0.9
    for way in (going, coming):
        assert (np.diff(way) > -1e-6).all()
        assert way[0] < 1e-3
        assert way[-1] > 0.99


def test_the_smooth_sgn_has_the_derivative_of_a_tanh_at_zero():
    # Beside l = 0, a_r = 10 / (1 + e^7.2) tanh(l / 0.01) and e^7.2 = 1339.43: 0.746 per metre.
    slope = jax.jit(jax.grad(rps.adaptive_rate, argnums=1))
    assert slope(PAPER, 0.0, 1.0, WARM) == pytest.approx(0.746027, rel=1e-3)
    # v* = 0.1 is scaled to 0.05, and v_y = 0.05 a_r for a small a_r.
    x, _ = ravel_pytree((PAPER, state_with(), observe((1.0, 0.0)), WARM))
    of_v_y = unravel(reverse(np.tile(x, (WORLDS, 1)))[0, 1])
    assert of_v_y[2].p_robot_contact[1] == pytest.approx(0.05 * 0.746027, rel=1e-3)


@any_seed
def test_the_smooth_speed_is_still_v_star_split_by_the_slope(seed):
    params, state, observation = random_worlds(seed)
    params = params._replace(v_max=0 * params.v_max + 1e3, clip_each=0 * params.clip_each)
    observation = observation._replace(in_contact=jnp.ones(WORLDS))
    _, twist, details = smooth(params, state, observation, WARM)
    away = details.distance > 0.12
    speed, v_star = np.hypot(twist.v_x, twist.v_y), params.K_v * details.distance
    assert_allclose(speed[away], v_star[away], rtol=1e-4)
    expected = details.a_r * twist.v_x
    assert_allclose(twist.v_y[away], expected[away], rtol=1e-3, atol=1e-6)


def test_the_weight_of_a_contact_mixes_pushing_with_going_ahead():
    """The weight also mixes the current contact point with the last one."""
    start = state_with()._replace(p_robot_contact=jnp.array([FRONT, -0.10]))
    observation = observe((2.0, 0.0), l=0.10, in_contact=0.25)
    state, twist, details = one_step(start, observation)
    assert details.l == pytest.approx(0.25 * 0.10 - 0.75 * 0.10)
    felt = observation._replace(p_robot_contact=jnp.array([FRONT, -0.05]), in_contact=jnp.ones(()))
    pushed, push, _ = one_step(start, felt)
    expected = 0.25 * np.stack(push) + 0.75 * np.array([0.01, 0.0, 0.0])
    assert_allclose(np.stack(twist), expected, rtol=1e-5)
    assert_allclose(state.l_th, 0.25 * pushed.l_th + 0.75 * start.l_th, rtol=1e-5)
    assert state.touched == 1.0


def test_the_largest_contact_weight_is_remembered():
    state = RPSState.init(PAPER, WARM)
    for weight in (0.2, 0.7, 0.1):
        state, _, _ = one_step(state, observe((1.0, 0.0), in_contact=weight))
    assert state.touched == pytest.approx(0.7)


@any_seed
def test_a_mirrored_world_gives_the_mirrored_smooth_twist(seed):
    params, state, observation = random_worlds(seed)
    flip = jnp.array([1.0, -1.0])
    mirrored = moved(observation, mirror=True)
    mirrored_state = state._replace(p_robot_contact=state.p_robot_contact * flip)
    next_state, twist, details = smooth(params, state, observation, WARM)
    next_state_m, twist_m, details_m = smooth(params, mirrored_state, mirrored, WARM)
    behind = np.abs(np.abs(details.gamma) - params.gamma_max) < 1e-6  # at +-pi it chooses a side
    assert_allclose(next_state_m.l_th, next_state.l_th, rtol=1e-5)
    assert_allclose(details_m.a_r, -details.a_r, rtol=1e-4, atol=1e-5)
    assert_allclose(twist_m.v_x, twist.v_x, rtol=1e-4, atol=1e-6)
    assert_allclose(twist_m.v_y, -twist.v_y, rtol=1e-4, atol=1e-6)
    omega, omega_m = (np.asarray(x.omega)[~behind] for x in (twist, twist_m))
    assert_allclose(omega_m, -omega, atol=2e-4)


_, unravel = ravel_pytree((PAPER, state_with(), observe((1.0, 0.0)), WARM))


def after_one_step(x):
    """The twist and the state (7,) of flattened parameters, state, observation, temperatures."""
    state, twist, _ = rps.step_with_details(*unravel(x))
    return jnp.concatenate([jnp.stack(twist), ravel_pytree(state)[0]])


batch_step = jax.jit(jax.vmap(after_one_step))
forward = jax.jit(jax.vmap(jax.jacfwd(after_one_step)))
reverse = jax.jit(jax.vmap(jax.jacrev(after_one_step)))


def test_derivatives_are_finite_on_surfaces_and_at_singular_points():
    distances = ((0.0, 0.0), (1e-30, 0.0), (0.05, 0.0), (0.5, 0.0), (-1.0, 0.0), (0.0, 1.0))
    offsets, weights = (0.0, 0.12, 0.15, -0.24, 0.29, -1e6), (0.0, 0.5, 1.0)
    rows = []
    for point in itertools.product(distances, offsets, weights):
        for state, heat in ((state_with(0.15), WARM), (RPSState.init(PAPER, COLD), COLD)):
            rows.append(ravel_pytree((PAPER, state, observe(*point), heat))[0])
    assert len(rows) <= WORLDS
    x = np.resize(np.stack(rows), (WORLDS, rows[0].size)).astype(np.float32)
    chex.assert_tree_all_finite(reverse(x))


@any_seed
def test_derivatives_are_finite_in_float32_whatever_the_temperature(seed):
    worlds = random_worlds(seed)
    for temperatures in (WARM, COLD):
        heat = jax.tree.map(partial(np.full, WORLDS), temperatures)
        chex.assert_tree_all_finite(reverse(flatten((*worlds, heat)).astype(np.float32)))


def test_derivatives_agree_with_finite_differences():
    h = 1e-7
    with jax.enable_x64(True):
        params, state, observation = random_worlds(1, np.float64)
        touched, weight = default_rng(2).uniform(0.05, 0.95, (2, WORLDS))
        state = state._replace(touched=touched)
        heat = jax.tree.map(partial(np.full, WORLDS), WARM)
        x = flatten((params, state, observation._replace(in_contact=weight), heat))
        derivatives = np.asarray(forward(x))
        differences, bend = central_differences(batch_step, x, h)
    scale = 1 + np.abs(differences)
    kink = bend > 1e-4 * scale
    assert kink.mean() < 0.05  # of the bounds, and of the 0-or-1 parameters
    assert (np.abs(differences - derivatives) / scale)[~kink].max() < 1e-4


# The skin

NEAR = (-0.001, 0.02)  # [m] gaps
IMPERFECT = CapacitiveSkin(gain_spread=0.2, dead_share=0.2)
SMOOTH = CapacitiveSkin(temperature=0.03)


def box(pose) -> Footprint:
    """Return a box of half width 0.2 m at (x, y, yaw)."""
    return box_at(pose[0], pose[1], yaw=pose[2])


def read(skin, poses):
    """Return readings of boxes at up to 128 poses (n, 3)."""
    n = len(poses)
    shapes = jax.vmap(box)(jnp.asarray(np.resize(poses, (BATCH, 3)), jnp.float32))
    return jax.tree.map(lambda x: np.asarray(x)[:n], sense_all(skin, shapes, jax.random.key(0)))


def flush(gap=0.0, y=0.0, yaw=0.0) -> tuple[float, float, float]:
    return (FRONT + 0.2 + gap, y, yaw)


@any_seed
def test_without_heat_the_smooth_skin_is_the_skin(seed):
    """This includes corners, and dead taxels within a contact."""
    # A slightly duller and a slightly keener skin: where these agree nothing is at an edge.
    sensor, dull, keen = (IMPERFECT._replace(threshold=0.25 + x) for x in (0, 1e-3, -1e-3))
    shapes, key = random_shapes(seed, NEAR), jax.random.key(seed % 2**31)
    exact, less, more = (sense_all(s, shapes, key) for s in (sensor, dull, keen))
    cold = sense_all(sensor._replace(temperature=1e-6), shapes, key)
    sure = np.asarray(less.in_contact == more.in_contact)
    assert sure.mean() > 0.7
    assert_allclose(cold.in_contact[sure], exact.in_contact[sure], atol=1e-6)
    assert ((cold.contact_type == NONE) == (exact.contact_type == NONE))[sure].all()
    # Of a slanted edge the end moves by many times the change of tolerance.
    moved = np.abs(less.p_robot_contact - more.p_robot_contact).max(axis=1)
    felt = sure & np.asarray(exact.in_contact) & (moved < 1e-3)
    assert felt.sum() > 8
    assert_allclose(cold.p_robot_contact[felt], exact.p_robot_contact[felt], atol=4e-4)


@any_seed
def test_the_skin_converges_as_its_temperature_falls(seed):
    sensor, warm = IMPERFECT, 0.03
    shapes, key = random_shapes(seed, NEAR), jax.random.key(seed % 2**31)
    exact = sense_all(sensor, shapes, key)
    felt = np.asarray(exact.in_contact)
    far, weight = [], []
    for factor in (2.0, 0.5, 0.125):
        got = sense_all(sensor._replace(temperature=factor * warm), shapes, key)
        far.append(np.abs(got.p_robot_contact - exact.p_robot_contact)[felt].mean())
        weight.append(np.abs(got.in_contact - exact.in_contact).mean())
    assert (np.diff(weight) < 0).all()
    assert far[1] < far[0]
    assert far[2] < 0.5 * far[0]


def test_a_contact_grows_as_the_object_nears_and_is_half_at_the_threshold():
    skin, threshold = SMOOTH, 0.008  # where foam of 10 mm has 1.25 times its capacitance
    gaps = np.append(np.linspace(0.03, -0.001, 63), threshold)
    reading = read(skin, [flush(gap, 0.05) for gap in gaps])
    weight = reading.in_contact[:-1]
    assert (np.diff(weight) >= -1e-6).all()
    assert weight[0] < 1e-3
    assert weight[-1] > 0.99
    assert reading.in_contact[-1] == pytest.approx(0.5, abs=0.01)
    assert_array_equal(reading.contact_type != NONE, reading.in_contact > 0.5)


def differences(skin, poses, step, h: float) -> np.ndarray:
    """Derivatives (n, 2) of contact locations as poses (n, 3) move along `step` (3,)."""
    up, down = (np.asarray(poses) + side * h * np.asarray(step) for side in (1, -1))
    contacts = read(skin, np.concatenate([up, down])).p_robot_contact
    return (contacts[: len(up)] - contacts[len(up) :]) / (2 * h)


@any_seed
def test_a_mirrored_object_gives_the_mirrored_smooth_reading(seed):
    shapes, key = random_shapes(seed, NEAR), jax.random.key(0)
    reading, mirrored_reading = (sense_all(SMOOTH, x, key) for x in (shapes, mirrored(shapes)))
    assert_allclose(mirrored_reading.in_contact, reading.in_contact, atol=1e-3)
    expected = reading.p_robot_contact * np.array([1, -1])
    assert_allclose(mirrored_reading.p_robot_contact, expected, atol=2e-3)


POSES = [
    *(flush(gap, 0.05) for gap in (-0.05, -0.001, 0.0, 0.006, 0.02, 0.3)),
    (FRONT + 0.2 * math.sqrt(2), 0.0, math.pi / 4),
    flush(0.0, SIDE + 0.2),  # corner to corner
    (0.0, SIDE + 0.2, 0.0),
    (-FRONT - 0.2, 0.0, 0.0),
    (0.0, 0.0, 0.0),
    (9.0, -9.0, 1.0),
    flush(0.0016, 0.05, 0.003),
    flush(0.04, -0.1, 0.2),
]


def numbers_read(pose, skin):
    reading = skin.sense(skin.init(jax.random.key(0)), box(pose), SETTLED)[1]
    return jnp.append(reading.p_robot_contact, reading.in_contact)


@jax.jit
@partial(jax.vmap, in_axes=(0, None))
def read_and_slope(pose, skin):
    return numbers_read(pose, skin), jax.jacfwd(numbers_read)(pose, skin)


def test_the_derivatives_of_a_smooth_reading_are_finite_everywhere():
    for colder in (SMOOTH, SMOOTH._replace(temperature=1e-6)):
        chex.assert_tree_all_finite(read_and_slope(np.array(POSES, np.float32), colder))


def test_the_derivatives_of_a_smooth_reading_agree_with_finite_differences():
    skin = SMOOTH
    poses = np.resize(np.array(POSES[-2:], np.float32), (len(POSES), 3))
    slopes = np.asarray(read_and_slope(poses, skin)[1])[:2]
    assert np.abs(slopes).max() > 0.1
    for axis, step in enumerate(np.eye(3)):
        expected = differences(skin, poses[:2], step, 3e-5)
        assert_allclose(slopes[:, :2, axis], expected, rtol=0.02, atol=0.02)


# Whole trials in C MuJoCo, without compilation


def push(case: Case, law, horizon: float):
    """Return the trial of a case after `horizon` [s], or at its end."""
    setting = setting_of(horizon, "mujoco")
    _, worlds, models, params = pushes.build([case], setting)
    loop = ControlLoop(setting.physics, setting.rules, law)
    engine = setting.simulator
    *_, trials = trial.run_on_host(engine, models, worlds, params, loop, threads=1)
    return jax.tree.map(lambda x: np.asarray(x)[0], trials)


@pytest.mark.parametrize("name", [slow("box"), "cylinder"])
def test_without_heat_a_smooth_trial_is_the_hard_one(name):
    """The push starts before the first touch and turns towards a target at the side."""
    start = case((1.0, -1.5), name, gap=0.005)
    cold = replace(start, skin=CapacitiveSkin(temperature=1e-6))
    exact = push(replace(start, skin=CapacitiveSkin()), rps.LAW, 5.0)
    got = push(cold, registry.smooth_law(rps.LAW, COLD), 5.0)
    assert abs(exact.qpos[2]) > 0.2  # it turned
    assert_allclose(got.qpos, exact.qpos, atol=2e-3)
    assert got.contact_steps == pytest.approx(exact.contact_steps, abs=1)
    assert got.sum_abs_l == pytest.approx(exact.sum_abs_l, rel=0.02)
    assert got.min_distance == pytest.approx(exact.min_distance, abs=2e-3)


@pytest.mark.parametrize(
    "law", [slow(rps.LAW), registry.smooth_law(rps.LAW)], ids=["hard", "smooth"]
)
def test_with_a_warm_skin_a_push_arrives(law):
    """Both laws succeed; the hard law reads the binary contact."""
    ended = push(case((0.7, 0.05), skin=SMOOTH), law, 30.0)
    assert ended.success
    assert ended.lost_steps == 0


# --- RPS+ ----------------------------------------------------------------------------------


def plus_moments(count=40):
    """Random observations for RPS+, with and without contact; every tenth starts a push."""
    rng = default_rng(8)
    for i in range(count):
        x, y, far, side = rng.uniform(-1, 1, 4)
        contact, target = jnp.array([0.36, 0.3 * y]), jnp.array([0.5 + 0.3 * far, 0.3 * side])
        robot, yaw, touching = 0.1 * jnp.array([x, y]), jnp.asarray(2 * side), i % 10 < 4
        hard = Observation(robot, yaw, contact, jnp.asarray(touching), target)
        yield i % 10 == 0, hard, hard._replace(in_contact=jnp.asarray(float(touching)))


def test_without_heat_smooth_rps_plus_is_the_hard_one(monkeypatch):
    for name in ("_FACING_WIDTH", "_LOST_WIDTH"):
        monkeypatch.setattr(rps_plus, name, 1e-6)
    params = RPSPlusParams(n_lost=2.5)  # a count meets no threshold that is a count
    hard, cold = registry.law_of(params), registry.smooth_law(rps_plus.LAW, COLD)
    for is_start, observation, weight in plus_moments():
        if is_start:
            states = [hard.init(params), cold.init(params)]
        (states[0], twist, _) = hard.step(params, states[0], observation)
        (states[1], mixed, _) = cold.step(params, states[1], weight)
        assert_allclose(jnp.stack(mixed), jnp.stack(twist), atol=1e-5)
        assert float(states[1].steps_lost) == pytest.approx(float(states[0].steps_lost))


def test_a_smooth_rps_plus_can_be_differentiated_by_its_own_parameters():
    law, names = registry.smooth_law(rps_plus.LAW), ("d_near", "press", "n_lost", "ahead", "aside")
    start = RPSPlusParams(n_lost=2.0)
    with jax.enable_x64(True):
        moments = jax.tree.map(lambda *x: jnp.stack(x), *[x for *_, x in plus_moments(10)])

        @jax.jit
        def driven(values):
            params = start._replace(**dict(zip(names, values, strict=True)))
            step = lambda state, obs: law.step(params, state, obs)[:2]  # noqa: E731
            twist = jax.lax.scan(step, law.init(params), moments)[1]
            return jnp.sum(twist.v_x + 0.7 * twist.v_y + 0.1 * twist.omega)

        base = jnp.array([getattr(start, name) for name in names], float)
        slope, steps = jax.grad(driven)(base), 1e-5 * jnp.eye(len(names))
        expected = [(driven(base + step) - driven(base - step)) / 2e-5 for step in steps]
    assert (abs(slope) > 1e-4).all()
    assert_allclose(slope, expected, rtol=1e-3)


def test_rps_and_rps_plus_alone_have_a_smooth_form_one_for_equal_temperatures():
    for params, law in ((RPSParams.tuned(), rps.LAW), (RPSPlusParams(), rps_plus.LAW)):
        smooth_law = registry.smooth_law(law, Temperatures())
        assert registry.law_of(params) is law
        assert smooth_law.smooth
        assert registry.smooth_law(law, Temperatures(realign=0.01)) is smooth_law
        assert registry.smooth_law(law) is smooth_law
        assert registry.smooth_law(law, COLD) is not smooth_law
    assert registry.smooth_law(rps.LAW) != registry.smooth_law(rps_plus.LAW)
    words = "this law has no smooth form.* choose .*rps, rps_tuned, nps, rps_unsaturated, rps_plus"
    with refusing(words):
        registry.smooth_law(registry.law_of(PursuitParams()))
