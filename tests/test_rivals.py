"""The rival laws: values worked out by hand, symmetry, and what they can push."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rps_jax.control import registry
from rps_jax.control.laws import (
    dipole,
    force_push,
    force_push_published,
    pursuit,
    rps,
    rps_plus,
)
from rps_jax.control.laws.aps import APSParams
from rps_jax.control.laws.dipole import DipoleParams
from rps_jax.control.laws.force_push import ForcePushParams
from rps_jax.control.laws.force_push_published import PublishedForcePushParams
from rps_jax.control.laws.guided import GuidedParams
from rps_jax.control.laws.pursuit import PursuitParams
from rps_jax.control.laws.rps import RPSParams, RPSState
from rps_jax.control.laws.rps_plus import RPSPlusParams
from rps_jax.control.observation import (
    ForceObservation,
    Observation,
    PoseObservation,
    TaxelObservation,
    Twist,
)
from rps_jax.errors import InputError
from rps_jax.trials import pushes
from rps_jax.trials.pushes import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.world.scene import FRICTION

# Parameters of the laws that are not the paper's.
RIVALS = {"guided": GuidedParams()} | {
    name: registry.LAWS[name]
    for name in registry.PACKAGE_LAWS
    if not isinstance(registry.LAWS[name], RPSParams | APSParams)
}


def seen(contact=(0.36, 0.0), target=(2.36, 0.0), robot=(0.0, 0.0), yaw=0.0, touching=True):
    return Observation(
        jnp.array(robot), jnp.asarray(yaw), jnp.array(contact), jnp.asarray(touching),
        jnp.array(target), 0.02,
    )  # fmt: skip


def tracked(observation, thing=(1.0, 0.0), radius=0.2):
    return PoseObservation(observation, jnp.array(thing), jnp.asarray(radius))


def loaded(observation, force=(-20.0, 0.0)):
    """The force is that of the object on the base, in the base's frame."""
    return ForceObservation(observation, jnp.array(force))


def test_a_twist_moves_a_point_of_the_base_as_asked():
    twist = Twist.from_point_velocity(
        jnp.array([0.36, 0.1]), jnp.array([0.01, 0.05]), jnp.asarray(0.15)
    )
    np.testing.assert_allclose(twist, [0.01 + 0.015, 0.05 - 0.054, 0.15], rtol=1e-5)
    bounded = Twist(*map(jnp.asarray, (0.06, -0.08, -0.3))).saturate(0.05, 0.15)
    np.testing.assert_allclose(bounded, [0.03, -0.04, -0.15], rtol=1e-6)


@pytest.mark.parametrize(
    ("observation", "expected"),
    [
        (seen((0.36, 0.1), (2.36, 0.1)), (0.05, 0.0, 0.0)),
        (seen((0.36, 0.1), (0.42, 0.1)), (0.03, 0.0, 0.0)),  # K_v d of 6 cm
        # Sideways: 0.05 (press, 1), less what turning at the bound moves the contact by.
        (seen((0.36, 0.1), (0.36, 1.1)), (0.01 + 0.015, 0.05 - 0.054, 0.15)),
        (seen(touching=False), (0.01, 0.0, 0.0)),
    ],
)
def test_pursuit_moves_the_contact_straight_to_the_target(observation, expected):
    _, twist, _ = pursuit.step(PursuitParams(), (), observation)
    np.testing.assert_allclose(twist, expected, atol=1e-7)


def test_force_push_steers_by_where_the_contact_has_drifted():
    params = ForcePushParams()
    start = force_push.init(params)
    _, twist, _ = force_push.step(params, start, seen(touching=False))
    np.testing.assert_allclose(twist, (0.01, 0.0, 0.0), atol=1e-7)

    # The path is laid from the first contact: no offset, no drift, and the base faces along it.
    state, twist, details = force_push.step(params, start, seen((0.36, 0.12), (2.36, 0.12)))
    assert float(details.gamma) == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(twist, (0.05, 0.0, 0.0), atol=1e-6)

    # A drift of 10 cm over lambda = 10 cm is 45 degrees; 10 cm to the left of the path the push
    # goes farther out, which turns the object back in.
    state, _, details = force_push.step(params, state, seen((0.36, 0.22), (2.36, 0.12)))
    angle = 1.3 * math.pi / 4 + 0.5 * 0.1
    assert float(details.gamma) == pytest.approx(angle, abs=1e-6)

    # A contact that is lost: back towards the path, 0.1 rad a step.
    lost = seen((0.36, 0.22), (2.36, 0.12), touching=False)
    state, _, details = force_push.step(params, state, lost)
    assert float(details.gamma) == pytest.approx(angle - 0.1, abs=1e-6)
    for _ in range(20):
        state, _, details = force_push.step(params, state, lost)
    assert float(details.gamma) == pytest.approx(-0.5 * 0.1, abs=1e-6)


def test_force_push_forgets_a_drift_over_its_length_of_way():
    params = ForcePushParams(k_y=0.0)
    state, _, _ = force_push.step(params, force_push.init(params), seen((0.36, 0.0)))
    _, _, details = force_push.step(params, state, seen((0.36, 0.1), robot=(0.1, 0.0)))
    left = 0.1 * math.exp(-1)  # of the drift, after one lambda
    assert float(details.gamma) == pytest.approx(1.3 * math.atan2(left, 0.1), abs=1e-6)
    # A base that faces 0.2 rad to the left of the path feels its force there.
    _, _, details = force_push.step(params, state, seen((0.36, 0.0), yaw=0.2))
    assert float(details.gamma) == pytest.approx(1.3 * 0.2, abs=1e-6)


def test_force_push_lays_its_path_anew_when_it_has_passed_the_target():
    params = ForcePushParams()
    state, _, _ = force_push.step(params, force_push.init(params), seen())
    assert float(state.path.theta_d) == 0
    state, _, _ = force_push.step(params, state, seen(robot=(1.9, 0.0)))
    assert float(state.path.theta_d) == 0  # 10 cm before it
    state, _, _ = force_push.step(params, state, seen(robot=(2.1, 0.0)))
    assert abs(float(state.path.theta_d)) == pytest.approx(math.pi)
    np.testing.assert_allclose(state.path.p_world_start, (2.46, 0.0), atol=1e-6)


def test_the_published_force_push_steers_by_the_angle_of_the_force():
    """theta_p = 1.3 theta_f + 0.5 Delta, and the contact moves at 0.05 m/s along it."""
    params, step = PublishedForcePushParams(), force_push_published.step
    start = force_push_published.init(params)
    _, twist, _ = step(params, start, loaded(seen(touching=False)))
    np.testing.assert_allclose(twist, (0.01, 0.0, 0.0), atol=1e-7)

    # Touched, but no force: along the path.
    at = seen((0.36, 0.12), (2.36, 0.12))
    state, twist, _ = step(params, start, loaded(at, (0.0, 0.9)))
    np.testing.assert_allclose(twist, (0.05, 0.0, 0.0), atol=1e-7)

    # The object pushes back along (-4, -3): the base pushes it 36.87 degrees to the left.
    state, twist, details = step(params, state, loaded(at, (-16.0, -12.0)))
    angle = 1.3 * math.atan2(3, 4)
    assert float(details.gamma) == pytest.approx(angle, abs=1e-6)
    np.testing.assert_allclose(
        twist, (0.05 * math.cos(angle), 0.05 * math.sin(angle), 0.0), atol=1e-6
    )

    # 10 cm to the left of the path the push goes farther out.
    left = seen((0.36, 0.22), (2.36, 0.12))
    state, _, details = step(params, state, loaded(left, (-16.0, -12.0)))
    assert float(details.gamma) == pytest.approx(angle + 0.05, abs=1e-6)

    # No force any more: back to -0.5 Delta, by 10 rad/s in each 0.02 s.
    state, _, details = step(params, state, loaded(left, (0.0, 0.0)))
    assert float(details.gamma) == pytest.approx(angle + 0.05 - 0.2, abs=1e-6)
    for _ in range(10):
        state, _, details = step(params, state, loaded(left, (-0.6, 0.6)))
    assert float(details.gamma) == pytest.approx(-0.05, abs=1e-6)


def test_the_published_force_push_gives_way_to_a_large_force():
    """Of 70 N it gives way to 20: 0.0015 * 20 = 0.03 m/s. Of 90 N it goes back at 0.01 m/s."""
    params, step = PublishedForcePushParams(), force_push_published.step
    state, _, _ = step(params, force_push_published.init(params), loaded(seen()))
    for force, speed in ((50.0, 0.05), (70.0, 0.02), (90.0, -0.01), (1e4, -0.05)):
        _, twist, _ = step(params, state, loaded(seen(), (-force, 0.0)))
        np.testing.assert_allclose(twist, (speed, 0.0, 0.0), atol=1e-6)
    v = force_push_published.yielding(params, jnp.array([0.03, 0.0]), jnp.array([0.0, 70.0]))
    np.testing.assert_allclose(v, (0.03, -0.03), atol=1e-6)


def test_the_published_force_push_turns_to_face_along_its_path():
    # It yields by 0.01 m/s of its 0.2, so that its turn stays within its bound.
    params = PublishedForcePushParams(v_max=0.2, f_max=0.0, k_f=0.0005)
    step = force_push_published.step
    state, _, _ = step(params, force_push_published.init(params), loaded(seen()))
    turned = seen((0.36, 0.0), (2.36, 0.0), yaw=0.1)
    _, twist, details = step(params, state, loaded(turned, (-20.0, 0.0)))
    # The force on the object is along the base's heading: 0.1 rad; the contact has moved with it.
    offset = 0.36 * math.sin(0.1)
    angle = 1.3 * 0.1 + 0.5 * offset
    assert float(details.gamma) == pytest.approx(angle, abs=1e-6)
    forward, aside = 0.2 * math.cos(angle - 0.1) - 0.01, 0.2 * math.sin(angle - 0.1)
    np.testing.assert_allclose(twist, (forward, aside + 0.1 * 0.36, -0.1), atol=1e-6)
    # 10 cm past the target the path is laid anew, back.
    past = seen((0.36, 0.0), (0.26, 0.0))
    state, _, _ = step(params, state, loaded(past))
    assert abs(float(state.path.theta_d)) == pytest.approx(math.pi)


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        ((0.46, 0.05), (0.03, 0.0)),  # 10 cm ahead: K_v d
        ((0.36, 0.15), (0.2 * 0.03, 0.03)),  # sideways, pressing
        ((0.26, 0.05), (0.2 * 0.03, 0.0)),  # straight back: a skin cannot pull
        ((0.36 + 0.06, 0.05 + 0.08), (0.018, 0.024)),  # to the left, 3-4-5
    ],
)
def test_rps_plus_translates_near_its_target(target, expected):
    own = RPSParams.tuned()._replace(K_v=0.3)
    params = RPSPlusParams(own)
    _, twist, _ = rps_plus.step(params, rps_plus.init(params), seen((0.36, 0.05), target))
    np.testing.assert_allclose(twist, (*expected, 0.0), atol=1e-6)


def test_rps_plus_is_the_law_elsewhere():
    params = RPSPlusParams()
    outside = [
        seen((0.36, 0.05), (0.36 + 0.26, 0.05)),  # farther than d_near
        seen((0.36, 0.05), (0.36 + 0.04, 0.05)),  # arrived
        seen((0.36, 0.28), (2.46, 0.3)),  # realigning
        seen(touching=False),
    ]
    for observation in outside:
        mine = rps_plus.step(params, rps_plus.init(params), observation)
        theirs = rps.step_with_details(params.law, RPSState.init(params.law), observation)
        for a, b in zip(
            jax.tree.leaves((mine[0].law, *mine[1:])), jax.tree.leaves(theirs), strict=True
        ):
            np.testing.assert_array_equal(a, b)
    never = params._replace(d_near=0.0)
    near = seen((0.36, 0.05), (0.46, 0.1))
    own = rps.step_with_details(params.law, RPSState.init(params.law), near)
    np.testing.assert_array_equal(
        jnp.stack(rps_plus.step(never, rps_plus.init(never), near)[1]), jnp.stack(own[1])
    )


def test_rps_plus_translates_near_its_target_even_while_it_realigns():
    params = RPSPlusParams(RPSParams.tuned()._replace(K_v=0.3))
    _, twist, details = rps_plus.step(
        params, rps_plus.init(params), seen((0.36, 0.28), (0.46, 0.28))
    )
    assert bool(details.realigning)
    np.testing.assert_allclose(twist, (0.03, 0.0, 0.0), atol=1e-6)


def test_rps_plus_searches_where_it_lost_the_object():
    """P3 with v_max = 0.05 m/s: ahead 0.035 and aside 0.025, or turning at 0.15 rad/s at most."""
    params = RPSPlusParams(n_lost=3)
    state = rps_plus.init(params)
    state, _, _ = rps_plus.step(params, state, seen((0.36, -0.2), (3.0, 0.0)))
    np.testing.assert_allclose(state.p_world_felt, (0.36, -0.2), atol=1e-6)
    gone = seen(target=(3.0, 0.0), touching=False)
    for n in (1, 2, 3):
        before = rps.step_with_details(params.law, state.law, gone)[1]
        state, twist, _ = rps_plus.step(params, state, gone)
        assert int(state.lost) == n
        np.testing.assert_array_equal(jnp.stack(twist), jnp.stack(before))
    # The place bears atan2(-0.2, 0.36), off the front, 0.41 m away: it only goes to the right.
    state, twist, _ = rps_plus.step(params, state, gone)
    np.testing.assert_allclose(twist, (0.0, -0.025, 0.0), atol=1e-6)
    # From 0.5 m behind, it bears -0.23 rad: ahead, to the right, and turning right.
    behind = seen(robot=(-0.5, 0.0), target=(3.0, 0.0), touching=False)
    state, twist, _ = rps_plus.step(params, state, behind)
    np.testing.assert_allclose(twist, (0.035, -0.025, -0.15), atol=1e-6)
    # Felt again, the search has ended.
    state, _, _ = rps_plus.step(params, state, seen((0.36, 0.0), (3.0, 0.0)))
    assert int(state.lost) == 0


def test_rps_plus_does_not_search_what_it_never_felt():
    params = RPSPlusParams(n_lost=0)
    state = rps_plus.init(params)
    for _ in range(3):
        state, twist, _ = rps_plus.step(params, state, seen(touching=False))
    assert int(state.lost) == 0
    np.testing.assert_allclose(twist, (params.law.v_approach, 0.0, 0.0), atol=1e-7)


@pytest.mark.parametrize(
    ("robot", "yaw", "expected"),
    [
        ((0.0, 0.0), 0.0, (0.05, 0.0, 0.0)),  # behind the object: straight on
        ((1.0, -1.0), math.pi / 2, (0.0, 0.05, 0.0)),  # beside it: back, to the robot's left
        ((2.0, 0.0), math.pi, (-0.05, 0.0, 0.0)),  # before it: away from it, with the field
        ((0.0, 0.0), 0.4, (0.05 * math.cos(0.4), -0.05 * math.sin(0.4), -0.15)),
    ],
)
def test_the_dipole_leads_round_the_object(robot, yaw, expected):
    observation = tracked(seen(target=(3.0, 0.0), robot=robot, yaw=yaw, touching=False))
    params = DipoleParams()
    _, twist, _ = dipole.step(params, dipole.init(params), observation)
    np.testing.assert_allclose(twist, expected, atol=1e-6)


def test_the_dipole_looks_along_the_path_and_lays_it_anew():
    params = DipoleParams()
    state, _, _ = dipole.step(params, dipole.init(params), tracked(seen(target=(3.0, 0.0))))
    np.testing.assert_allclose(state.p_world_start, (1.0, 0.0))
    # An object 1 m to the left of the path: 1 m ahead of its foot, 45 degrees to the right. The
    # robot behind it on that line drives along it.
    aside = tracked(seen(target=(3.0, 0.0), robot=(0.5, 1.5), yaw=-math.pi / 4), (1.0, 1.0))
    state, twist, _ = dipole.step(params, state, aside)
    np.testing.assert_allclose(twist, (0.05, 0.0, 0.0), atol=1e-6)
    np.testing.assert_allclose(state.p_world_start, (1.0, 0.0))
    for x, start in ((3.39, 1.0), (3.41, 3.41)):  # two radii of 0.2 m past the target
        state, _, _ = dipole.step(params, state, tracked(seen(target=(3.0, 0.0)), (x, 0.0)))
        assert float(state.p_world_start[0]) == pytest.approx(start)


def answered(observation):
    """With what 42 taxels in a row answer to a touch at its place."""
    along = jnp.linspace(-0.5, 0.5, 42)
    signal = 0.3 * jnp.exp(-(((along - observation.p_robot_contact[1]) / 0.05) ** 2))
    return TaxelObservation(observation, signal, jnp.asarray(False))


def twist_of(name, observation, thing, force=(-20.0, 5.0)):
    params = RIVALS[name]
    law = registry.law_of(params)
    state = law.init(params)
    tellings = {
        "touch": observation,
        "force": loaded(observation, force),
        "pose": tracked(observation, thing),
        "taxels": answered(observation),
    }
    told = tellings[law.senses]
    for _ in range(2):  # the second step remembers the first
        state, twist, _ = law.step(params, state, told)
    return np.asarray(jnp.stack(twist))


@pytest.mark.parametrize("name", RIVALS)
def test_a_law_is_the_same_in_a_mirror_and_in_any_frame(name):
    rng = np.random.default_rng(3)
    for _ in range(8):
        contact, robot, target, thing = rng.uniform(-1, 1, (4, 2))
        contact = np.array([0.36, 0.3 * contact[1]])
        yaw, turn = rng.uniform(-3, 3, 2)
        plain = twist_of(name, seen(contact, 2 * target, robot, yaw), thing)
        flip = np.array([1.0, -1.0])
        mirrored = twist_of(
            name,
            seen(contact * flip, 2 * target * flip, robot * flip, -yaw),
            thing * flip,
            (-20.0, -5.0),
        )
        np.testing.assert_allclose(mirrored, plain * [1, -1, -1], atol=1e-5)
        c, s = math.cos(turn), math.sin(turn)

        def moved(point, c=c, s=s):
            return np.array([[c, -s], [s, c]]) @ point + [0.3, -0.7]

        elsewhere = seen(contact, moved(2 * target), moved(robot), yaw + turn)
        np.testing.assert_allclose(twist_of(name, elsewhere, moved(thing)), plain, atol=1e-5)


@pytest.mark.parametrize("name", RIVALS)
def test_a_law_keeps_within_the_bounds_of_the_base(name):
    params = RIVALS[name]
    rng = np.random.default_rng(4)
    for x, y, far in rng.uniform(-1, 1, (16, 3)):
        for touching in (True, False):
            told = seen((0.36, 0.3 * y), (3 * x, 3 * far), (y, far), 3 * x, touching)
            v_x, v_y, omega = twist_of(name, told, (far, x))
            bounds = getattr(params, "law", params)
            assert math.hypot(v_x, v_y) <= bounds.v_max * (1 + 1e-6)
            assert abs(omega) <= bounds.omega_max * (1 + 1e-6)


@pytest.mark.parametrize("name", RIVALS)
def test_a_law_refuses_bounds_that_mean_nothing(name):
    params = RIVALS[name]
    law = registry.law_of(params)
    assert law.check(params) is params
    wrong = registry.replace_leaves(params, {list(registry.named_leaves(params))[-1]: -0.05})
    with pytest.raises(InputError, match=r"= -0\.05 is not allowed"):
        law.check(wrong)
    found = registry.params_from_json(registry.params_to_json(params))
    for mine, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(params), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert type(found) is type(params)


@pytest.mark.parametrize("name", [x for x in RIVALS if x != "force_push_published"])
def test_a_law_pushes_a_box_straight_on(name):
    params = RIVALS[name]
    setting = Setting(engine="quasistatic", rules=Rules(horizon=60.0))
    box = Case("box", FRICTION["S1"], (1.6, 0.0), params)
    outcome, _ = pushes.run([box], setting, slots=1, workers=1)
    assert outcome.success[0]
    assert 10 < outcome.time[0] < 40


def test_before_a_box_on_its_flat_skin_the_published_force_push_amplifies_what_it_feels():
    """The box cannot turn about a line of contact, and slides as it is pushed: against the force.

    So theta_f is the last theta_p, which (1 + k_theta) makes larger, up to the cone of the skin's
    friction: 1.3 atan(0.35) = 0.44 rad. With k_theta = -1 the same base goes straight on.
    """
    setting = Setting(engine="fused", rules=Rules(horizon=20.0))
    ends = []
    for k_theta in (0.3, -1.0):
        params = PublishedForcePushParams(k_theta=k_theta, k_y=0.0)
        box = Case("box", FRICTION["S1"], (1.6, 0.0), params, mass=10.0)
        outcome, _ = pushes.run([box], setting, slots=1, workers=1)
        x, y, yaw = outcome.base_pose[0]
        ends.append(abs(math.atan2(y, x)))
        assert abs(yaw) < 0.01
    assert 0.3 < ends[0] < 0.45
    assert ends[1] < 0.02
