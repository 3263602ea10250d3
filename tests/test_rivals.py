"""Laws other than the paper's: values by hand, symmetry, bounds, and pushes of a box."""

import math
from functools import partial

import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import moved, refusing, same, setting_of, slow
from numpy.random import default_rng
from numpy.testing import assert_allclose

from rps_jax.control import registry
from rps_jax.control.laws import dipole, force_push, force_push_published, pursuit, rps, rps_plus
from rps_jax.control.laws.aps import APSParams
from rps_jax.control.laws.dipole import DipoleParams
from rps_jax.control.laws.force_push import ForcePushParams
from rps_jax.control.laws.force_push_published import PublishedForcePushParams
from rps_jax.control.laws.guided import GuidedParams
from rps_jax.control.laws.pursuit import PursuitParams
from rps_jax.control.laws.rps import RPSParams, RPSState
from rps_jax.control.laws.rps_plus import RPSPlusParams
from rps_jax.control.observation import (
    EndsObservation,
    ForceObservation,
    PoseObservation,
    TaxelObservation,
    Twist,
)
from rps_jax.geometry import planar
from rps_jax.trials import pushes
from rps_jax.trials.pushes import Case
from rps_jax.world.scene import FRICTION

# Parameters of the laws that are not the paper's.
RIVALS = {"guided": GuidedParams()} | {
    name: registry.LAWS[name]
    for name in registry.PACKAGE_LAWS
    if not isinstance(registry.LAWS[name], RPSParams | APSParams)
}


def follow(law, params, *script, state=None):
    """Step a law through observations, and return its last state.

    Each row of the script is an observation, the expected twist, and the expected angle gamma
    [rad] of the push; both may be left out.
    """
    state = law.init(params) if state is None else state
    for observation, *expected in script:
        twist, gamma = (*expected, None, None)[:2]
        state, *outputs = law.step(params, state, observation)
        if twist is not None:
            assert_allclose(outputs[0], twist, atol=1e-6)
        if gamma is not None:
            assert float(outputs[1].gamma) == pytest.approx(gamma, abs=3e-6)
    return state


def step_once(law, params, observation):
    """Return state, twist and details after a law's first step."""
    return law.step(params, law.init(params), observation)


def observe(contact=(0.36, 0.0), target=(2.36, 0.0), robot=(0.0, 0.0), yaw=0.0, touching=True):
    return helpers.observation(robot, yaw, contact, touching, target)


def with_pose(observation, p_object=(1.0, 0.0), radius=0.2):
    return PoseObservation(observation, jnp.array(p_object), jnp.asarray(radius))


def with_force(observation, force=(-20.0, 0.0)):
    """Return an observation with the force of the object on the base, in the base's frame."""
    return ForceObservation(observation, jnp.array(force))


def test_a_twist_from_the_velocity_of_a_point_of_the_base():
    p, v = jnp.array([0.36, 0.1]), jnp.array([0.01, 0.05])
    twist = Twist.from_point_velocity(p, v, jnp.asarray(0.15))
    assert_allclose(twist, [0.01 + 0.015, 0.05 - 0.054, 0.15], rtol=1e-5)
    bounded = Twist(*map(jnp.asarray, (0.06, -0.08, -0.3))).saturate(0.05, 0.15)
    assert_allclose(bounded, [0.03, -0.04, -0.15], rtol=1e-6)


@pytest.mark.parametrize(
    ("observation", "expected"),
    [
        (observe((0.36, 0.1), (2.36, 0.1)), (0.05, 0.0, 0.0)),
        (observe((0.36, 0.1), (0.42, 0.1)), (0.03, 0.0, 0.0)),  # K_v d of 6 cm
        # Sideways: 0.05 (press, 1), less the contact's velocity of turning at the bound.
        (observe((0.36, 0.1), (0.36, 1.1)), (0.01 + 0.015, 0.05 - 0.054, 0.15)),
        (observe(touching=False), (0.01, 0.0, 0.0)),
    ],
)
def test_pursuit_moves_the_contact_straight_to_the_target(observation, expected):
    follow(pursuit, PursuitParams(), (observation, expected))


AT_PATH = observe((0.36, 0.12), (2.36, 0.12))
OUTSIDE = observe((0.36, 0.22), (2.36, 0.12))  # 10 cm to the left of the path


def test_force_push_steers_by_the_drift_of_the_contact():
    # A drift of 10 cm over lambda = 10 cm is 45 degrees. To the left of the path the push points
    # farther out, which turns the object back in.
    angle = 1.3 * math.pi / 4 + 0.5 * 0.1
    lost = observe((0.36, 0.22), (2.36, 0.12), touching=False)
    follow(
        force_push,
        ForcePushParams(),
        (observe(touching=False), (0.01, 0.0, 0.0)),
        # The path starts at the first contact: no offset, no drift, and the base faces along it.
        (AT_PATH, (0.05, 0.0, 0.0), 0.0),
        (OUTSIDE, None, angle),
        # After a loss of contact: back towards the path, 0.1 rad per step.
        (lost, None, angle - 0.1),
        *19 * [(lost,)],
        (lost, None, -0.5 * 0.1),
    )


def test_force_push_forgets_a_drift_over_the_length_lambda():
    params = ForcePushParams(k_y=0.0)
    state = follow(force_push, params, (observe((0.36, 0.0)),))
    drift = 1.3 * math.atan2(0.1 * math.exp(-1), 0.1)  # after one lambda
    follow(force_push, params, (observe((0.36, 0.1), robot=(0.1, 0.0)), None, drift), state=state)
    # A base that faces 0.2 rad to the left of the path feels the force in this direction.
    follow(force_push, params, (observe((0.36, 0.0), yaw=0.2), None, 1.3 * 0.2), state=state)


def test_force_push_plans_a_new_path_behind_the_target():
    params, state = ForcePushParams(), None
    for x, angle in ((0.0, 0.0), (1.9, 0.0), (2.1, math.pi)):  # the last is behind it
        state = follow(force_push, params, (observe(robot=(x, 0.0)),), state=state)
        assert abs(float(state.path.theta_d)) == pytest.approx(angle)
    assert_allclose(state.path.p_world_start, (2.46, 0.0), atol=1e-6)


@pytest.mark.parametrize(
    ("law", "params", "sense"),
    [
        (force_push, ForcePushParams(), lambda obs: obs),
        (force_push_published, PublishedForcePushParams(), lambda obs: with_force(obs)),
    ],
)
def test_force_push_follows_a_target_that_moves_along_a_path(law, params, sense):
    # The contact is on the x axis. The target moves ahead, then to the left, then jumps backwards.
    targets = [(1.0, 0.0), (2.0, 0.0), (2.0, 0.005), (2.0, 0.02), (1.5, 1.0), (-2.0, 0.0)]
    angles = [0.0, 0.0, 0.0, math.atan2(0.02, 1.64), math.atan2(1, 1.14), math.pi]
    state = None
    for target, angle in zip(targets, angles, strict=True):
        state = follow(law, params, (sense(observe((0.36, 0.0), target)),), state=state)
        assert float(state.path.theta_d) == pytest.approx(angle, abs=1e-6)
    # Without contact there is no line to a target.
    state = follow(
        law, params, (sense(observe((0.36, 0.0), (0.0, 3.0), touching=False)),), state=state
    )
    assert float(state.path.theta_d) == pytest.approx(math.pi)


def test_the_published_force_push_steers_by_the_angle_of_the_force():
    """theta_p = 1.3 theta_f + 0.5 Delta, and the contact moves at 0.05 m/s along it."""
    angle = 1.3 * math.atan2(3, 4)
    along = (0.05 * math.cos(angle), 0.05 * math.sin(angle), 0.0)
    follow(
        force_push_published,
        PublishedForcePushParams(),
        (with_force(observe(touching=False)), (0.01, 0.0, 0.0)),
        # Contact without force: along the path.
        (with_force(AT_PATH, (0.0, 0.9)), (0.05, 0.0, 0.0)),
        # The object pushes back along (-4, -3): the base pushes it 36.87 degrees to the left.
        (with_force(AT_PATH, (-16.0, -12.0)), along, angle),
        (with_force(OUTSIDE, (-16.0, -12.0)), None, angle + 0.05),
        # Without force: back to -0.5 Delta, at 10 rad/s.
        (with_force(OUTSIDE, (0.0, 0.0)), None, angle + 0.05 - 0.2),
        *9 * [(with_force(OUTSIDE, (-0.6, 0.6)),)],
        (with_force(OUTSIDE, (-0.6, 0.6)), None, -0.05),
    )


def test_the_published_force_push_yields_to_a_large_force():
    """It yields to 20 of 70 N: 0.0015 * 20 = 0.03 m/s. At 90 N it moves back at 0.01 m/s."""
    params = PublishedForcePushParams()
    state = follow(force_push_published, params, (with_force(observe()),))
    for force, speed in ((50.0, 0.05), (70.0, 0.02), (90.0, -0.01), (1e4, -0.05)):
        pressed = with_force(observe(), (-force, 0.0))
        follow(force_push_published, params, (pressed, (speed, 0.0, 0.0)), state=state)
    v = force_push_published.yield_to_force(params, jnp.array([0.03, 0.0]), jnp.array([0.0, 70.0]))
    assert_allclose(v, (0.03, -0.03), atol=1e-6)


def test_the_published_force_push_turns_to_face_along_its_path():
    # It yields by 0.01 m/s of its 0.2, so that its angular velocity stays within the bound.
    params = PublishedForcePushParams(v_max=0.2, f_max=0.0, k_f=0.0005)
    turned = observe((0.36, 0.0), (2.36, 0.0), yaw=0.1)
    # The force on the object has the base's heading, 0.1 rad; the contact has moved with it.
    angle = 1.3 * 0.1 + 0.5 * 0.36 * math.sin(0.1)
    forward, sideways = 0.2 * math.cos(angle - 0.1) - 0.01, 0.2 * math.sin(angle - 0.1)
    state = follow(
        force_push_published,
        params,
        (with_force(observe()),),
        (with_force(turned, (-20.0, 0.0)), (forward, sideways + 0.1 * 0.36, -0.1), angle),
        # 10 cm past the target a new path leads back.
        (with_force(observe((0.36, 0.0), (0.26, 0.0))),),
    )
    assert abs(float(state.path.theta_d)) == pytest.approx(math.pi)


def step_rps(params, observation):
    """Return the first step of the law within RPS+."""
    return rps.step_with_details(params.law, RPSState.init(params.law), observation)


@pytest.mark.parametrize(
    ("contact", "target", "expected"),
    [
        ((0.36, 0.05), (0.46, 0.05), (0.03, 0.0, 0.0)),  # 10 cm ahead: K_v d
        ((0.36, 0.05), (0.36, 0.15), (0.2 * 0.03, 0.03, 0.0)),  # sideways, pressing
        ((0.36, 0.05), (0.26, 0.05), (0.2 * 0.03, 0.0, 0.0)),  # back, where a skin cannot pull
        ((0.36, 0.05), (0.42, 0.13), (0.018, 0.024, 0.0)),  # to the left, 3-4-5
        ((0.36, 0.28), (0.46, 0.28), (0.03, 0.0, 0.0)),  # even while it realigns
    ],
)
def test_rps_plus_translates_near_its_target(contact, target, expected):
    params = RPSPlusParams(RPSParams.tuned()._replace(K_v=0.3))
    _, twist, details = step_once(rps_plus, params, observe(contact, target))
    assert_allclose(twist, expected, atol=1e-6)
    assert bool(details.realigning) == (contact[1] > 0.24)


def test_rps_plus_equals_the_tuned_law_elsewhere():
    params = RPSPlusParams()
    outside = [
        observe((0.36, 0.05), (0.36 + 0.26, 0.05)),  # farther than d_near
        observe((0.36, 0.05), (0.36 + 0.04, 0.05)),  # arrived
        observe((0.36, 0.28), (2.46, 0.3)),  # realigning
        observe(touching=False),
    ]
    for observation in outside:
        state, *outputs = step_once(rps_plus, params, observation)
        same((state.law, *outputs), step_rps(params, observation))
    never = params._replace(d_near=0.0)
    near = observe((0.36, 0.05), (0.46, 0.1))
    same(step_once(rps_plus, never, near)[1], step_rps(params, near)[1])


def test_rps_plus_searches_at_its_last_contact():
    """P3 with v_max = 0.05 m/s: ahead 0.035, sideways 0.025, and at most 0.15 rad/s."""
    params = RPSPlusParams(n_lost=3)
    state = follow(rps_plus, params, (observe((0.36, -0.2), (3.0, 0.0)),))
    assert_allclose(state.p_world_contact, (0.36, -0.2), atol=1e-6)
    lost = observe(target=(3.0, 0.0), touching=False)
    for n in (1, 2, 3):
        _, expected, _ = rps.step_with_details(params.law, state.law, lost)
        state, twist, _ = rps_plus.step(params, state, lost)
        assert int(state.steps_lost) == n
        same(twist, expected)
    behind = observe(robot=(-0.5, 0.0), target=(3.0, 0.0), touching=False)
    state = follow(
        rps_plus,
        params,
        # The bearing atan2(-0.2, 0.36), 0.41 m away, is off the front: it moves only to the right.
        (lost, (0.0, -0.025, 0.0)),
        # From 0.5 m behind, the bearing is -0.23 rad: ahead, to the right, and turning right.
        (behind, (0.035, -0.025, -0.15)),
        (observe((0.36, 0.0), (3.0, 0.0)),),  # a new contact ends the search
        state=state,
    )
    assert int(state.steps_lost) == 0


def test_rps_plus_does_not_search_before_its_first_contact():
    params = RPSPlusParams(n_lost=0)
    ahead = observe(touching=False), (params.law.v_approach, 0.0, 0.0)
    assert int(follow(rps_plus, params, *3 * [ahead]).steps_lost) == 0


@pytest.mark.parametrize(
    ("robot", "yaw", "expected"),
    [
        ((0.0, 0.0), 0.0, (0.05, 0.0, 0.0)),  # behind the object: straight ahead
        ((1.0, -1.0), math.pi / 2, (0.0, 0.05, 0.0)),  # beside it: to the robot's left
        ((2.0, 0.0), math.pi, (-0.05, 0.0, 0.0)),  # in front of it: away from it, with the field
        ((0.0, 0.0), 0.4, (0.05 * math.cos(0.4), -0.05 * math.sin(0.4), -0.15)),
    ],
)
def test_the_dipole_leads_around_the_object(robot, yaw, expected):
    observation = observe(target=(3.0, 0.0), robot=robot, yaw=yaw, touching=False)
    follow(dipole, DipoleParams(), (with_pose(observation), expected))


def test_the_dipole_aims_along_its_path_and_plans_a_new_one_behind_the_target():
    # An object 1 m to the left of the path: the aim is 1 m ahead of its foot, 45 degrees to the
    # right. The robot behind it on this line drives along it.
    off_path = with_pose(observe(target=(3.0, 0.0), robot=(0.5, 1.5), yaw=-math.pi / 4), (1.0, 1.0))
    params, state = DipoleParams(), None
    for observation, twist, start in (
        (with_pose(observe(target=(3.0, 0.0))), None, 1.0),
        (off_path, (0.05, 0.0, 0.0), 1.0),
        (with_pose(observe(target=(3.0, 0.0)), (3.39, 0.0)), None, 1.0),
        (with_pose(observe(target=(3.0, 0.0)), (3.41, 0.0)), None, 3.41),  # two radii past it
    ):
        state = follow(dipole, params, (observation, twist), state=state)
        assert_allclose(state.p_world_start, (start, 0.0), atol=1e-6)


def with_taxels(observation):
    """Return an observation with the signal of 42 taxels in a row, at the contact point."""
    along = jnp.linspace(-0.5, 0.5, 42)
    signal = 0.3 * jnp.exp(-(((along - observation.p_robot_contact[1]) / 0.05) ** 2))
    return TaxelObservation(observation, signal, jnp.asarray(False))


def with_ends(observation):
    """Return an observation with a goal's heading, and an even contact within the front."""
    heading = planar.direction(jnp.asarray(observation.p_world_target - observation.p_world_robot))
    observation = observation._replace(yaw_target=heading)
    y = jnp.asarray(observation.p_robot_contact[1])
    ends = jnp.clip(y + jnp.array([0.15, -0.15]), -0.29, 0.29)
    alive, seen = jnp.ones(42, bool), jnp.abs(ends) < 0.29
    even, front = jnp.ones((), bool), jnp.asarray(0.3625)
    return EndsObservation(observation, jnp.zeros(42), alive, ends, seen, even, front)


@partial(jax.jit, static_argnums=0)
def second_twist(law, params, observation):
    """Return the twist (3,) of a law's second step."""
    state, _, _ = step_once(law, params, observation)
    return jnp.stack(law.step(params, state, observation)[1])


def twist_of(name, touch, p_object, force=(-20.0, 5.0)):
    """Return the twist (3,) of a law's second step."""
    params = RIVALS[name]
    law = registry.law_of(params)
    observation = {
        "touch": touch,
        "force": with_force(touch, force),
        "pose": with_pose(touch, p_object),
        "taxels": with_taxels(touch),
        "ends": with_ends(touch),
    }[law.senses]
    return np.asarray(second_twist(law, params, observation))


@pytest.mark.parametrize("name", [slow(x) if x.startswith("path_pose") else x for x in RIVALS])
def test_a_law_is_symmetric_and_does_not_depend_on_the_frame(name):
    rng, flip = default_rng(3), np.array([1.0, -1.0])
    for _ in range(8):
        contact, robot, target, p_object = rng.uniform(-1, 1, (4, 2))
        contact = np.array([0.36, 0.3 * contact[1]])
        yaw, turn = rng.uniform(-3, 3, 2)
        touch = observe(contact, 2 * target, robot, yaw)
        plain = twist_of(name, touch, p_object)
        mirrored = twist_of(name, moved(touch, mirror=True), p_object * flip, (-20.0, -5.0))
        assert_allclose(mirrored, plain * [1, -1, -1], atol=1e-5)
        shift = jnp.array([0.3, -0.7])
        p_object = planar.rotate(jnp.asarray(turn), jnp.asarray(p_object)) + shift
        elsewhere = twist_of(name, moved(touch, turn, shift), p_object)
        assert_allclose(elsewhere, plain, atol=1e-5)


@pytest.mark.parametrize("name", RIVALS)
def test_a_twist_is_within_the_speed_limits(name):
    limits = RIVALS[name]
    while hasattr(limits, "law"):
        limits = limits.law
    limits = getattr(limits, "pose", limits)
    v_max, omega_max = (  # a law may move faster on the way to and from the object
        max(getattr(limits, f"{x}_max"), getattr(limits, f"{x}_free", 0)) for x in ("v", "omega")
    )
    for x, y, z in default_rng(4).uniform(-1, 1, (16, 3)):
        for touching in (True, False):
            touch = observe((0.36, 0.3 * y), (3 * x, 3 * z), (y, z), 3 * x, touching)
            v_x, v_y, omega = twist_of(name, touch, (z, x))
            assert math.hypot(v_x, v_y) <= v_max * (1 + 1e-6)
            assert abs(omega) <= omega_max * (1 + 1e-6)


@pytest.mark.parametrize("name", RIVALS)
def test_a_law_refuses_invalid_parameters_and_restores_valid_ones(name):
    params = RIVALS[name]
    law = registry.law_of(params)
    assert law.check(params) is params
    invalid = registry.replace_leaves(params, {list(registry.named_leaves(params))[-1]: -0.05})
    with refusing(r"= -0\.05 is not allowed"):
        law.check(invalid)
    restored = registry.params_from_json(registry.params_to_json(params))
    same(restored, params)
    assert type(restored) is type(params)


@pytest.mark.parametrize(
    "name",
    [
        x if x == "pursuit" else slow(x)
        for x in sorted(RIVALS.keys() - {"force_push_published", "learned_mlp"})
    ],
)
def test_a_law_pushes_a_box_straight_ahead(name):
    setting = setting_of(60.0)
    way = 0.62 + getattr(RIVALS[name], "s_min", 0.98)  # [m]; `pose` pushes back for a shorter one
    box = Case("box", FRICTION["S1"], (way, 0.0), RIVALS[name])
    outcome, _ = pushes.run([box], setting, slots=1, workers=1)
    assert outcome.success[0]
    assert 10 < outcome.time[0] < 25 * way


def test_the_published_force_push_diverges_with_a_box_on_its_flat_skin():
    """The box cannot turn about a line of contact, and slides in the direction of the push.

    So theta_f is the last theta_p, which (1 + k_theta) amplifies up to the friction cone of the
    skin: 1.3 atan(0.35) = 0.44 rad. With k_theta = -1 the base drives straight ahead.
    """
    setting = setting_of(20.0, "fused")
    bearings = []
    for k_theta in (0.3, -1.0):
        params = PublishedForcePushParams(k_theta=k_theta, k_y=0.0)
        box = Case("box", FRICTION["S1"], (1.6, 0.0), params, mass=10.0)
        outcome, _ = pushes.run([box], setting, slots=1, workers=1)
        x, y, yaw = outcome.base_pose[0]
        bearings.append(abs(math.atan2(y, x)))
        assert abs(yaw) < 0.01
    assert 0.3 < bearings[0] < 0.45
    assert bearings[1] < 0.02
