"""APS: activations by hand, symmetry, orbits, and pushes of a box."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import moved, observation, refusals, setting_of
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax.control.laws import aps
from rps_jax.control.laws.aps import APSParams, APSState
from rps_jax.control.observation import PoseObservation
from rps_jax.trials import pushes
from rps_jax.trials.case import Case

APS = APSParams()
PLAIN = APS._replace(aim_beyond=0.0)  # as published: the object's centre to the target
START = APSState.init(APS)
aps_step = jax.jit(aps.step)


def observe(robot, yaw=0.0, obj=(0.0, 0.0), target=(2.0, 0.0), r_object=0.2):
    touch = observation(robot, yaw, (0.0, 0.0), False, target)
    return PoseObservation(touch, jnp.array(obj), jnp.array(r_object))


def twist_at(angle, distance=0.6, params=PLAIN, state=START, **world):
    """Return the twist of a robot at an angle [rad] about the object, facing it; target along x."""
    position = distance * np.array([np.cos(angle), np.sin(angle)])
    return aps_step(params, state, observe(position, angle + np.pi, **world))[1]


def world_velocity(twist, yaw):
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([c * twist.v_x - s * twist.v_y, s * twist.v_x + c * twist.v_y])


def test_the_prior_predictive_has_mean_pi_and_variance_0_793():
    # 1 / (1 / (pi/4) + 100 / (pi/4)) + pi/4 = (pi/4) (1 / 101 + 1) = 0.79317.
    mean, variance = aps.predictive(APS, START)
    assert float(mean) == pytest.approx(np.pi, rel=1e-6)
    assert float(variance) == pytest.approx(np.pi / 4 * (1 + 1 / 101), rel=1e-6)


@pytest.mark.parametrize(
    ("alpha", "near", "expected"),
    [
        (np.pi, True, (1.0, 0.0)),
        # 2.5 rad: exp(-0.5 (0.641593 / 0.793174)^2) = 0.72097, below |cos| = 0.801144.
        (2.5, True, (0.72097, 0.69297)),
        # 2 rad: exp(-0.5 (1.141593 / 0.793174)^2) = 0.35496, below |cos| = 0.416147.
        (2.0, True, (0.35496, 0.93488)),
        # 1.6 rad: the bell gives 0.15120, but |cos 1.6| = 0.0291995 caps it.
        (1.6, True, (0.0291995, 0.99957)),
        # 1 rad, the target's side: exp(-0.5 (2.141593 / 0.793174)^2) = 0.02612, backwards.
        (1.0, True, (-0.02612, 0.99966)),
        (1.0, False, (1.0, 0.0)),  # far away: approach
    ],
)
def test_activations_by_hand(alpha, near, expected):
    push, relocate = aps.activations(APS, START, jnp.array(alpha), jnp.array(near))
    assert (float(push), float(relocate)) == pytest.approx(expected, abs=5e-5)


def test_behind_the_object_it_pushes_straight_at_the_target():
    twist = twist_at(np.pi)
    assert (twist.v_x, twist.v_y, twist.omega) == pytest.approx((0.05, 0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("angle", [0.3, 1.2, 2.0, 2.9, -0.3, -1.2, -2.0, -2.9])
def test_it_orbits_to_the_far_side_of_the_object_on_the_shorter_arc(angle):
    v = world_velocity(twist_at(angle), angle + np.pi)
    around = v @ [-np.sin(angle), np.cos(angle)]  # counter-clockwise about the object
    assert np.sign(around) == np.sign(angle)
    towards = -v @ [np.cos(angle), np.sin(angle)]
    assert (towards > 0) == (np.cos(angle) < 0)  # on the target's side it moves away


@pytest.mark.parametrize("angle", [0.0, 0.5, 2.0, 3.0, -1.0])
def test_from_afar_it_drives_straight_at_the_object(angle):
    twist = twist_at(angle, distance=1.0)
    assert (twist.v_x, twist.v_y) == pytest.approx((0.05, 0.0), abs=1e-6)


def in_world(observation, **changes):
    """Return an observation in a mirrored, turned or shifted world."""
    touch = observation.touch._replace(p_world_target=observation.p_world_object)
    p_world_object = moved(touch, **changes).p_world_target
    return PoseObservation(moved(observation.touch, **changes), p_world_object, observation[2])


def test_the_law_depends_on_neither_the_side_nor_the_frame():
    """Compare twists over several steps, of which it learns."""
    rng = default_rng(0)
    frame = {"turn": 0.8, "shift": np.array([3.0, -2.0])}
    states = [START] * 3
    for _ in range(5):
        robot, obj = rng.normal(size=2), 0.3 * rng.normal(size=2)
        facing = np.arctan2(*(obj - robot)[::-1])
        at = observe(robot, facing + 0.1 * rng.normal(), obj, (1.5, 0.7))
        worlds = at, in_world(at, mirror=True), in_world(at, **frame)
        steps = [aps_step(APS, state, world) for state, world in zip(states, worlds, strict=True)]
        states = [state for state, *_ in steps]
        plain, mirrored, elsewhere = (np.stack(twist) for _, twist, _ in steps)
        assert np.hypot(*plain[:2]) > 0.005
        assert_allclose(mirrored, plain * [1, -1, -1], atol=1e-4)
        assert_allclose(elsewhere, plain, atol=1e-4)


def test_a_motion_error_is_learned_and_compensated():
    first = observe((-0.6, 0.0))
    state, _, _ = aps_step(PLAIN, START, first)
    # The object moved 2 cm at -0.3 rad from the line to the target: gamma = 0 - (-0.3) = 0.3.
    at = (0.02 * np.cos(0.3), -0.02 * np.sin(0.3))
    state, _, _ = aps_step(PLAIN, state, observe((-0.58, 0.0), obj=at))
    assert (state.gamma, state.gamma_mean) == pytest.approx((0.3, 0.3), abs=1e-5)
    # V = v_max / (1 + 0.3); heading turned right by K1 0.3 + K2 0.3 = 0.045.
    behind = np.array([-0.6, 0.0]) + at
    still = observe(behind, obj=at, target=(10.0 + at[0], at[1]))
    _, twist, _ = aps_step(PLAIN, state._replace(yaw_error=jnp.zeros(())), still)
    assert np.hypot(twist.v_x, twist.v_y) == pytest.approx(0.05 / 1.3, rel=1e-4)
    assert np.arctan2(twist.v_y, twist.v_x) == pytest.approx(-0.045, abs=1e-4)


def test_alpha_is_learned_only_when_the_error_decreases():
    values = {"started": True, "alpha": 3.0, "gamma": 0.4, "gamma_count": 5.0}
    learnt = START._replace(**jax.tree.map(jnp.array, values))
    better, _, _ = aps_step(PLAIN, learnt, observe((-0.6, 0.0), obj=(0.02, 0.0)))  # gamma = 0
    # m = pi + (3 - pi) / 101; the variance's update by hand.
    mean = np.pi + (3.0 - np.pi) / 101
    variance = np.pi / 4 + ((3.0 - np.pi) * (3.0 - mean) - np.pi / 4) / 101
    assert (better.weight, better.mean, better.variance) == pytest.approx(
        (101.0, mean, variance), rel=1e-5
    )
    worse, _, _ = aps_step(PLAIN, learnt, observe((-0.6, 0.0), obj=(0.0, 0.02)))  # gamma = -pi / 2
    assert worse.weight == 100.0
    resting, _, _ = aps_step(PLAIN, learnt, observe((-0.6, 0.0), obj=(0.0005, 0.0)))
    assert (resting.weight, resting.gamma_count) == (100.0, 5.0)


def test_it_turns_on_the_spot_until_it_faces_the_object():
    _, twist, _ = aps_step(PLAIN, START, observe((-0.6, 0.0), yaw=0.5))
    assert (twist.v_x, twist.v_y) == (0.0, 0.0)
    assert twist.omega == pytest.approx(-0.15)  # 0.6 * 0.5, clipped


def test_it_reaches_targets_ahead_only_if_it_aims_beyond_them():
    cases = [Case("box", "S1", (1.0, 0.0), params) for params in (APS, PLAIN)]
    outcome, _ = pushes.run(cases, setting_of(30.0, "mujoco"))
    assert_array_equal(outcome.success, [True, False])
    # As published, the object's centre stays near the target, half a side (0.2 m) from the contact.
    assert_allclose(outcome.object_pose[1, :2], (1.0, 0.0), atol=0.04)
    assert outcome.min_distance[1] == pytest.approx(0.2, abs=0.04)


BAD = [float("nan"), -0.1, float("inf")]
test_invalid_parameters_are_refused_by_name = refusals(
    aps.check,
    *(((APS._replace(**{n: x}),), rf"aps\.{n} = ") for n in APSParams._fields for x in BAD),
)
