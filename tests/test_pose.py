"""Goals with a heading: the task, the sense of ends, and the law."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from helpers import jitted, refusing, rps, still
from numpy.testing import assert_allclose, assert_array_equal

import rps_jax
from rps_jax import Details, Law, Twist
from rps_jax.control import registry
from rps_jax.control.box import Box, feel
from rps_jax.control.laws.pose import PoseParams
from rps_jax.control.observation import EndsObservation, Observation, PoseObservation
from rps_jax.control.validation import check_law
from rps_jax.engines.base import ControlPeriod, Motion
from rps_jax.engines.quasistatic import Quasistatic, Slider
from rps_jax.geometry import footprint as fp
from rps_jax.robot import skin as skins
from rps_jax.robot.robot import ROBOTS, Robot
from rps_jax.robot.shell import Shell
from rps_jax.robot.skin import CapacitiveSkin
from rps_jax.trials import pushes
from rps_jax.trials.case import Case
from rps_jax.trials.live import Live
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.world import draws
from rps_jax.world.domain import parse_domain
from rps_jax.world.physics import Physics
from rps_jax.world.tasks import parse_task
from rps_jax.world.tasks.base import CourseInputs, Positions
from rps_jax.world.tasks.path import APPROACH, PathCourse
from rps_jax.world.tasks.pose import Pose, PoseCourse
from sweeps.pose.sight import SightParams, sight_table
from sweeps.pose.study import OUTCOMES, pose_table

GOAL, HEADING = np.array([1.0, 0.5]), 0.7
NO = jnp.zeros((), bool)
FAST = "pose,v_free=0.2,omega_free=0.5"
LAW = registry.law_of(PoseParams())


def course():
    return PoseCourse(*map(jnp.asarray, (GOAL, HEADING, 0.05, 0.1)))


def positions(footprint, place, yaw, contact, touches=True, declared=None):
    base = jnp.array([0.0, 0.0, HEADING])
    shell = Shell().outline
    inputs = jnp.asarray(GOAL), jnp.asarray(contact), jnp.asarray(touches), base, shell
    bodies = jnp.asarray(place), jnp.asarray(yaw), footprint
    return Positions(*inputs, *bodies, None if declared is None else jnp.asarray(declared))


def judged(at, progress=None):
    """Return progress and aim of one control step, from the start if no progress is given."""
    task = course()
    return jitted(PoseCourse.step)(task, task.start() if progress is None else progress, at)


def unit(angle):
    return np.array([math.cos(angle), math.sin(angle)])


@pytest.mark.parametrize("quarter", range(4))
@pytest.mark.parametrize("along", [-0.5, 0.0, 0.55])
def test_the_middle_of_the_true_face_is_judged_wherever_it_is_touched(quarter, along):
    """Each face of a box 0.6 m times 1.2 m, off the goal by (0.02, -0.03) m and 0.05 rad."""
    half, across = ((0.3, 0.6), (0.6, 0.3))[quarter % 2]
    along *= across / 0.6
    heading = HEADING + 0.05
    normal, left = unit(heading), unit(heading + math.pi / 2)
    face = GOAL + 0.02 * unit(HEADING) - 0.03 * unit(HEADING + math.pi / 2)
    yaw = heading - quarter * math.pi / 2
    contact = face + along * left - 0.004 * normal
    progress, aim = judged(positions(fp.rectangle(0.3, 0.6), face + half * normal, yaw, contact))
    results = {k: float(x) for k, x in progress.outcomes().items()}
    assert results["place_error"] == pytest.approx(math.hypot(0.02, 0.03), abs=2e-6)
    assert results["sideways_error"] == pytest.approx(0.03, abs=2e-6)
    assert results["heading_error"] == pytest.approx(0.05, abs=2e-6)
    assert aim.success
    assert float(aim.yaw_target) == pytest.approx(HEADING)


def test_the_pushed_face_is_the_last_that_was_touched():
    box, normal = fp.rectangle(0.3, 0.3), unit(HEADING)
    face = GOAL + 0.1 * normal
    touching = positions(box, face + 0.3 * normal, HEADING, face)
    progress, aim = judged(touching)
    assert not aim.success
    # It has come to the goal, and the base has left to another side.
    left = positions(box, GOAL + 0.3 * normal, HEADING, GOAL + 0.6 * normal, touches=False)
    progress, aim = judged(left, progress)
    assert aim.success
    assert float(progress.errors[0]) == pytest.approx(0, abs=2e-6)


def test_nothing_is_judged_before_the_first_touch():
    normal = unit(HEADING)
    inputs = fp.rectangle(0.3, 0.3), GOAL + 0.3 * normal, HEADING, GOAL
    progress, aim = judged(positions(*inputs, touches=False))
    assert not aim.success
    assert np.isnan(progress.errors).all()


@pytest.mark.parametrize("turn", [0.0, 0.4, -2.0])
def test_the_heading_of_a_cylinder_is_that_of_its_last_way(turn):
    drum, radius = fp.circle(0.25), 0.25
    end = GOAL + radius * unit(HEADING)
    corner, progress, aim = end - 0.5 * unit(HEADING + turn), course().start(), None
    steps = [corner + (0.5 - s) * unit(2.5) for s in np.arange(0.5, 0, -0.01)]
    steps += [corner + s * unit(HEADING + turn) for s in np.arange(0, 0.501, 0.01)]
    for middle in steps:
        at = positions(drum, middle, 0.3, middle - radius * unit(HEADING))
        progress, aim = judged(at, progress)
    place, sideways, heading = map(float, progress.errors)
    assert heading == pytest.approx(abs(turn), abs=2e-4)
    assert max(place, sideways) < 1e-5
    assert aim is not None
    assert bool(aim.success) == (abs(turn) < 0.1)


@pytest.mark.parametrize("declared", [True, False])
def test_a_law_that_can_declare_is_judged_by_its_word(declared):
    normal = unit(HEADING)
    box = fp.rectangle(0.3, 0.3), GOAL + 0.3 * normal, HEADING, GOAL
    progress, aim = judged(positions(*box, declared=declared))
    assert bool(aim.success) == declared == bool(progress.declared)


def test_the_reference_of_a_turn_is_the_first_flush_face():
    """The heading of the base counts, from the first step in which the face is flush."""
    turned = course()._replace(heading=jnp.asarray(1.5), relative=jnp.ones(()))
    box, progress = fp.rectangle(0.3, 0.3), turned.start()

    def step(tilt, base_yaw, progress, touches=True):
        normal = unit(base_yaw)
        at = positions(box, GOAL + 0.3 * normal, base_yaw + tilt, GOAL, touches)
        at = at._replace(base=jnp.array([0.0, 0.0, base_yaw]))
        return jitted(PoseCourse.step)(turned, progress, at)

    for tilt, touches in ((0.0, False), (0.3, True), (-0.12, True)):
        progress, aim = step(tilt, 0.4, progress, touches)
        assert np.isnan(progress.errors).all()
        assert not aim.success
    progress, aim = step(0.05, 0.4, progress)
    assert float(progress.first) == pytest.approx(0.4)
    assert float(progress.errors[2]) == pytest.approx(1.5 - 0.05, abs=2e-6)
    progress, aim = step(0.0, 1.9, progress)
    assert float(progress.first) == pytest.approx(0.4)
    assert float(progress.errors[2]) == pytest.approx(0, abs=2e-6)
    assert aim.success
    assert aim.relative


@pytest.mark.slow
def test_the_law_finds_a_relative_heading_by_a_flush_face():
    """Equal pushes: straight ahead until the face is flush, then as with the absolute heading."""
    case = {"task": "pose,turn=1.57", "law": FAST, "target": (1.2, 0.5)}
    trace = rps_jax.push(**case, setting=Setting(rules=Rules(horizon=250.0)))
    assert trace.outcome.success
    touches = trace.snapshots.reading.contact_type > 0
    assert_allclose(trace.snapshots.qpos[: touches.argmax() + 4, 2], 0, atol=1e-5)
    assert trace.outcome.task["heading_error"] < 0.02
    assert np.sin(float(trace.outcome.base_pose[2]) - 1.57) == pytest.approx(0, abs=0.03)


class WaitParams(NamedTuple):
    wait: float = 1.0  # [s]
    d_success: float = 0.05


def wait(params, state, obs):
    """Wait, turning at the rate of the goal's heading, then declare to be done."""
    later = state[0] + obs.period
    speed = 0.0 * later
    return (later, later > params.wait), Twist(speed, speed, obs.yaw_target), Details.from_obs(obs)


@pytest.mark.parametrize("task", ["pose,heading=0.3", "reach"])
def test_the_word_of_a_law_ends_a_trial(task, registries):
    """Without a heading of the goal the law gets the direction from the base's start."""

    def init(params):
        return jnp.zeros_like(jnp.asarray(params.wait, float)), NO

    law = Law(init, wait, is_done=lambda state: state[1], heading=True)
    rps_jax.register_law("wait", law, WaitParams())
    trace = rps_jax.push(
        law="wait", task=task, target=(2.0, 1.0), gap=0.5, setting=Setting("quasistatic")
    )
    heading = 0.3 if task != "reach" else math.atan2(1.0, 2.0)
    assert float(trace.outcome.time) == pytest.approx(1.02, abs=0.021)
    assert float(trace.outcome.base_pose[2]) == pytest.approx(
        heading * trace.outcome.time, rel=0.03
    )
    assert not trace.outcome.success
    assert trace.summary.endswith("never touched")  # and has no error of the face
    assert task == "reach" or trace.outcome.task["declared"]


@pytest.mark.parametrize(
    ("word", "result"), [(lambda x: x[0], r"float32 \(\)"), (lambda x: x[0] > np.ones(3), "bool")]
)
def test_the_word_of_a_law_is_one_bool(word, result):
    law = Law(lambda params: (jnp.zeros(()), NO), wait, is_done=word, heading=True)
    with refusing(f"is_done of the law in .* returns {result}.*: return one bool"):
        check_law(law, WaitParams())


CASES = {
    "push --task pose,heading=90": "task heading = 90 is not allowed: it is beyond 2 pi: give rad",
    "sweep --task pose,heading=0:7": "task heading = 7 is not allowed: it is beyond 2 pi",
    "push --task pose,turn=90": "task turn = 90.0 is not allowed: it must be a number and at",
    "push --task pose,turn=x": "task turn = x is not allowed",
    "sweep --task pose,turn=1,heading=1": "task heading = 1 to 1 is not allowed: its turn",
    "push --task pose,d_success=0": "task d_success = 0",
    "push --task pose,yaw_success=0": "task yaw_success = 0",
    "push --task pose --target 0.6 0.1": r"target = \(0.6, 0.1\) m is not allowed: the object st",
    "push --task pose,yaw=1": "unknown task quantity of pose 'yaw'",
    "push --task path,heading=1 --law pose": "task = path with the law pose is not allowed: its ta",
    "push --task corridor,heading=1": "task = corridor with the law path_pose is not allowed: its",
    "push --task rooms,goal=4:2:1": r"task goal = \[4.0, 2.0, 1.0\] is not allowed: write pairs",
    "push --law pose,v_free=0": "v_free = 0",
    "push --law pose --robot f1tenth": "law = pose is not allowed",
    "push --task pose --robot round": "no law for a round base brings objects to a heading; name",
}


@pytest.mark.parametrize("command", CASES)
def test_bad_goals_are_refused_in_one_sentence_before_anything_compiles(
    command, compiled, capsys, tmp_path
):
    assert rps(command, "--out", tmp_path / "run") == 2
    error = capsys.readouterr().err
    assert not compiled
    with refusing(CASES[command]):
        raise rps_jax.errors.InputError(error)


# --- the sense of ends ---------------------------------------------------------------------


def ends_at(half, y, tilt=0.0, dead=(), gains=1.0):
    """Return the ends of a box (0.2, half) at y, in front of the paper's base."""
    return _ends_at(half, y, tilt, ~np.isin(np.arange(42), dead), gains * np.ones(42))


@jitted
def _ends_at(half, y, tilt, alive, gains):
    skin, x = CapacitiveSkin(), 0.363 + 0.2 * jnp.cos(tilt) + half * abs(jnp.sin(tilt))
    box = fp.place(fp.rectangle(0.2, half), jnp.array([x, y]), tilt)
    raw = skin._scan(skin.init(jax.random.PRNGKey(0)), box)[1]
    return skins.ends_of(jnp.where(alive, gains * raw, 0.0), alive, Shell(), skin.threshold)


def test_the_ends_of_a_flush_face_are_within_a_third_of_a_taxel():
    for half in np.linspace(0.09, 0.16, 7):
        for y in np.linspace(-0.07, 0.07, 9):
            found = ends_at(half, y)
            assert found.seen.all()
            assert found.even
            assert_allclose(found.ends, [y + half, y - half], atol=0.016)


def test_a_contact_without_inner_taxels_is_not_even_however_high_the_threshold():
    signal = 10.0 * jnp.isin(jnp.arange(42), jnp.array([20, 21]))
    ends_of = jitted(
        lambda threshold: skins.ends_of(signal, jnp.ones(42, bool), Shell(), threshold)
    )
    for threshold in (0.5, 3.0, 9.0):
        found = ends_of(threshold)
        assert not found.even
        assert not found.seen.any()


def test_an_end_beyond_the_front_is_not_seen():
    for y, seen in ((0.0, [False, False]), (0.2, [False, True]), (-0.2, [True, False])):
        found = ends_at(0.4, y)
        assert found.even
        assert found.seen.tolist() == seen


def test_no_end_is_seen_in_an_uneven_contact():
    for tilt in (0.02, -0.05, 0.3):
        found = ends_at(0.15, 0.0, tilt)
        assert not found.even
        assert not found.seen.any()


def test_a_face_is_even_by_its_tilt_and_not_by_the_gains_of_single_taxels():
    for gains in 1 - 0.5 * np.eye(42)[15:27]:
        assert ends_at(0.4, 0.0, gains=gains).even
        assert not ends_at(0.4, 0.0, 0.01, gains=gains).even


def test_a_dead_taxel_hides_an_end():
    """The front has the taxels 15 to 26; the face covers the middle six of them."""
    covered = 3 * 2 * 0.29 / 12
    assert ends_at(covered, 0.0).seen.tolist() == [True, True]
    assert ends_at(covered, 0.0, dead=[17]).seen.tolist() == [False, True]
    assert ends_at(covered, 0.0, dead=[24]).seen.tolist() == [True, False]
    inner = ends_at(covered, 0.0, dead=[20])
    assert inner.even
    assert inner.seen.all()


def test_ends_mirror_with_the_object():
    for y, tilt in ((0.03, 0.0), (0.1, 0.004), (0.21, 0.0)):
        a, b = ends_at(0.17, y, tilt), ends_at(0.17, -y, -tilt)
        assert_allclose(a.ends, -b.ends[::-1], atol=1e-6)
        assert a.seen.tolist() == b.seen.tolist()[::-1]


def test_an_environment_has_the_heading_of_the_goal_and_the_ends():
    env = rps_jax.PushEnv(domain="wide,yaw_noise=0:0", task="pose", senses="ends", worlds=4)
    state = jax.jit(env.reset)(jax.random.key(0))
    assert state.obs.shape == (env.observation_size,) == (42 + 2 + 2 + 5 + 42,)
    world, obs = state.info["world"], np.asarray(state.obs)
    assert_allclose(obs[44:46], unit(float(world.task.heading)), atol=1e-6)
    assert_allclose(obs[51:], world.skin.init(world.key).alive)
    assert rps_jax.PushEnv(task="pose", worlds=4).observation_size == 46
    assert rps_jax.PushEnv(worlds=4).observation_size == 44


# --- the law -------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_law_delivers_boxes_to_poses_and_ends_each_trial():
    setting = Setting(rules=Rules(horizon=300.0), split="tune")
    domain = "wide,objects=random_box"
    results = rps_jax.sweep(FAST, domain, worlds=8, task="pose", setting=setting)
    assert int(results.success.sum()) >= 6
    assert (results.declared > 0).all()
    good = results.isel(world=results.success.values[0] > 0)
    assert (good.place_error < 0.05).all()
    assert (good.heading_error < 0.1).all()


def touching(x, left=0.0, target=(0.0, 0.0), truth=~NO):
    """Return an observation of a contact in the robot frame, with the base at the origin."""
    inputs = jnp.zeros(2), jnp.zeros(()), jnp.array([x, left]), truth, jnp.array(target)
    return Observation(*inputs, yaw_target=jnp.zeros(()))


def sensed(touch, *ends):
    """Return an observation with the ends of the contact: `Ends`."""
    return EndsObservation(touch, jnp.zeros(42), jnp.ones(42, bool), *ends)


def last_twist(*inputs):
    """Return the twist (3,) of `pushed`."""
    return pushed(*inputs)[1]


HARD, SMOOTH = (jax.jit(x.step) for x in (LAW, registry.smooth_law(LAW)))


def even_push(step, K_y, y, x=0.3625, truth=~NO):
    """Return parameters, the state after 29 steps with a face off the line by y, the observation.

    The contact is at x [m] ahead.
    """
    params = PoseParams(K_y=K_y)
    ends = jnp.array([0.15, -0.15]), jnp.ones(2, bool), ~NO, jnp.asarray(0.3625)
    obs = sensed(touching(x, 0.0, [2.0, y], truth), *ends)
    state = LAW.init(params)
    for _ in range(29):
        state, *_ = step(params, state, obs)
    return params, state, obs


def pushed(*inputs):
    """Return state and twist (3,) after a step more of `even_push`."""
    params, state, obs = even_push(HARD, *inputs)
    state, twist, _ = HARD(params, state, obs)
    return state, jnp.stack(twist)


def test_a_flush_face_turns_about_a_point_beside_the_middle_of_the_box():
    params = PoseParams()
    sharpest = params.turn * 0.15 / (0.15**2 + params.r**2)
    for y in (0.004, 0.02, -0.02, 0.2):
        v_x, v_y, omega = map(float, last_twist(0.0, jnp.asarray(y)))
        assert_allclose(v_y + omega * (0.3625 + params.r), 0, atol=1e-6)
        assert np.sign(omega) == np.sign(y)
        assert abs(omega / v_x) < sharpest + 1e-5
        assert math.hypot(v_x, v_y) < 0.05 + 1e-6
    assert omega / v_x == pytest.approx(sharpest, rel=1e-4)


@jax.jit
def drive(slider, twist, motion):
    """Return the motion of sliders after a push of 5 s."""
    period = ControlPeriod(twist, Physics())
    step = lambda _, m: Quasistatic().drive(slider, m, period).motion  # noqa: E731
    return jax.lax.fori_loop(0, round(5 / Physics().control_period), step, motion)


def relative_turn(a, b, curvature, friction):
    """Return the turn (n,) [rad] of boxes (a, b) on their corners from a front on a curve.

    They start flush, and the base turns about a point beside the middle of the box.
    """
    count, front, speed = b.size, 0.3625, 0.05
    corners = np.array([[-a, a, a, -a], [-b, -b, b, b]]).T
    slider = Slider(
        np.zeros((count, 2)),
        np.hypot(a, b),
        np.full(count, friction),
        np.tile([front, 0.29], (count, 1)),
        corners,
        np.zeros(count),
    )
    qpos = np.zeros((count, 10))
    qpos[:, 3], qpos[:, 6] = front + a, 1
    omega = speed * curvature
    twist = Twist(jnp.full(count, speed), -omega * (front + a), omega)
    start = Motion(jnp.asarray(qpos), *[jnp.zeros((count, 9))] * 2)

    end = drive(*jax.tree.map(jnp.asarray, (slider, twist)), start).qpos
    return np.asarray(2 * jnp.arctan2(end[:, 9], end[:, 6]) - end[:, 2])


def test_a_face_stays_flush_up_to_the_limit_of_the_curvature_and_not_beyond():
    """Q10 in drawn boxes; friction at the front does not raise it."""
    rng = np.random.default_rng(5)
    half_depth, half_width = rng.uniform(0.07, 0.5, 64), rng.uniform(0.07, 0.29, 64)
    limit = half_width / (half_width**2 + half_depth**2) * rng.choice([-1, 1], 64)
    for friction in (0.0, 0.4):
        below, beyond = (
            relative_turn(half_depth, half_width, share * limit, friction) * np.sign(limit)
            for share in (0.9, 1.1)
        )
        assert_allclose(below, 0, atol=4e-3)
        assert (beyond < -4e-3).all()


def felt(box, lateral, ends, seen):
    """Return the supports of a box (4,) after an even contact on its face."""
    obs = sensed(touching(0.0), jnp.array(ends), jnp.array(seen), ~NO, jnp.asarray(0.36))
    return feel(0.2346, box, jnp.asarray(-0.5), jnp.asarray(lateral), obs, jnp.ones(()))


def test_a_side_reaches_as_far_as_it_was_felt_until_its_end_is_seen():
    box = Box(jnp.array([0.3, 0.5, 0.5, 0.5]), jnp.zeros(4, bool), jnp.zeros(2, bool))
    for lateral, right in ((0.0, 0.29), (-0.3, 0.59), (0.1, 0.59)):
        box = felt(box, lateral, (0.29, -0.29), (False, False))
        assert box.h[3] == pytest.approx(right)
        assert not box.known[3]
    box = felt(box, -0.6, (0.29, -0.1), (False, True))
    assert box.h[3] == pytest.approx(0.7)
    assert box.known.tolist() == [False, False, True, True]


def test_an_uneven_contact_forgets_the_sides_and_if_it_is_narrow_the_size_of_the_box():
    """Afterwards the side of the base alone feels the object, which is then sought there."""
    for end, half in ((0.27, 0.27), (0.1, 0.2346)):
        params, state, obs = even_push(HARD, 0.2, 0.0)
        uneven = obs._replace(even=NO, ends=jnp.array([end, -end]))
        for _ in range(90):
            state, _, _ = HARD(params, state, uneven)
        assert not state.known.any()
        assert_allclose(state.h[1::2], half, atol=1e-6)
    beside = uneven._replace(touch=touching(0.34, 0.29, [2.0, 0.0]))
    state, _, _ = HARD(params, state, beside)
    assert state.h[1] - state.h[3] > 0.6


def test_a_relative_heading_is_that_of_the_base_at_a_flush_face():
    """Until then the law pushes straight ahead."""
    params, state, obs = even_push(HARD, 0.2, 0.01)
    turn = {"yaw": jnp.asarray(0.3), "yaw_target": jnp.asarray(0.7), "relative": jnp.ones(())}
    obs, state = obs._replace(touch=obs.touch._replace(**turn)), LAW.init(params)
    for even, steps, heading in ((NO, 10, 0.3 - math.pi), (~NO, 40, 1.0)):
        for _ in range(steps):
            state, twist, _ = HARD(params, state, obs._replace(even=even))
        assert state.oriented == even
        assert float(state.goal[2]) == pytest.approx(heading)
        assert even or twist.v_y == twist.omega == 0


def test_a_contact_around_both_corners_of_the_front_is_a_push():
    state, _ = pushed(0.2, 0.01, 0.3399)
    assert int(state.mode) == 0


def test_the_smooth_law_mixes_its_pushes_by_the_weight_of_the_contact():
    inputs = 0.2, jnp.asarray(0.01)
    expected = last_twist(*inputs)
    assert expected[0] > 0
    slide = expected[1] + expected[2] * (0.3625 + PoseParams().r)
    assert_allclose(slide, 0.2 * 0.01, rtol=0.2)
    params, state, obs = even_push(SMOOTH, *inputs, truth=jnp.ones(()))

    def twist(weight, K_y):
        touch = obs.touch._replace(in_contact=weight)
        step = SMOOTH(params._replace(K_y=K_y), state, obs._replace(touch=touch))
        return [jnp.stack(step[1])] * 2

    weigh = jitted(lambda w: jax.jacfwd(twist, (0, 1), has_aux=True)(w, 0.2))
    assert_allclose(weigh(1.0)[1], expected, atol=1e-7)
    (by_weight, by_gain), _ = weigh(0.9)
    numeric = (weigh(0.91)[1] - weigh(0.89)[1]) / 0.02
    assert_allclose(by_weight, numeric, atol=2e-4)
    assert by_gain[1] > 1e-3


def test_a_trial_without_a_touch_leaves_no_nan_in_the_table():
    """A law may give up before its first touch; its errors are NaN then."""
    errors = {"place_error": 0.01, "sideways_error": 0.02, "heading_error": 0.03}
    values = dict.fromkeys(OUTCOMES, 1.0) | errors
    trials = xr.Dataset({x: (("row", "world"), np.full((1, 4), v)) for x, v in values.items()})
    for name in errors:
        trials[name].values[0, 3] = np.nan
    rows = pose_table(trials.assign_coords(row=["wide | omni | fast"]))
    assert rows[1][3].startswith("75")
    assert rows[1][-2:] == ["20 mm / 20 mm", "0.0300 rad / 0.0300 rad"]


def test_a_planner_solves_what_the_law_or_one_of_its_tries_solves():
    """Sight is no part of it."""
    laws = ["touch", "sight", "try 0", "try 1"]
    place = np.array([[0.01, 0.2, 0.2, 0.2], [0.01, 0.01, 0.2, 0.2], [0.2, 0.2, 0.04, 0.2]])
    place = np.concatenate([place, np.full((1, 4), np.nan)])[None]
    names = ("row", "law", "world")
    trials = {"place_error": (names, place), "heading_error": (names, 0 * place)}
    trials["declared"] = (names, np.ones(place.shape))
    rows = sight_table(xr.Dataset(trials, {"row": ["wide | omni | fast"], "law": laws}))
    shares = [[cell.split(" %")[0] for cell in row[2:]] for row in rows[1:]]
    assert shares[0] == ["5 cm", "25.0", "50.0", "1", "0", "50.0"]
    assert shares[1] == ["2 cm", "25.0", "50.0", "1", "0", "25.0"]


def test_a_law_that_sees_knows_the_box_and_its_ends():
    """It never looks for an end, and it forgets nothing."""
    params = SightParams(PoseParams())
    law = registry.law_of(params)
    corners = np.array([[0.36, -0.2], [0.96, -0.2], [0.96, 0.6], [0.36, 0.6]])
    obs = PoseObservation(touching(0.3625, 0.1), jnp.zeros(2), jnp.zeros(()), jnp.asarray(corners))
    state = law.init(params)
    run = jax.jit(lambda s: law.step(params, s, obs)[0])
    for _ in range(100):
        state = run(state)
    assert_allclose(state.h, [0.96, 0.6, -0.36, 0.2], atol=4e-3)
    assert state.known.all()
    assert int(state.looks) == 0


def test_tolerances_are_options_of_the_task():
    task = parse_task("pose,heading=1.2,d_success=0.02,yaw_success=0.05")
    case = Case(task=task, target=(1.5, 0.5), law="pose")
    assert case.challenge == task
    assert str(task) == "pose,heading=1.2:1.2,d_success=0.02,yaw_success=0.05"


def test_a_heading_relative_to_a_face_has_no_arrow_in_the_world_and_no_environment(monkeypatch):
    monkeypatch.setattr("rps_jax.trials.live.stepper", still)
    setting = Setting("fused")
    live = Live(pushes.build([Case(task="pose,turn=1.5")], setting), setting)
    live.set_target((1.0, 0.5), 0.3)
    assert live.yaw_target is None
    assert "goal" not in live.lines
    assert float(live._worlds.task.heading[0]) == pytest.approx(1.5)
    with refusing("environments know only headings in the world"):
        rps_jax.PushEnv(task="pose,turn=1.5", worlds=2)


# --- at the end of a path ------------------------------------------------------------------


@pytest.fixture
def ending():
    """Course of a path 4 m long ahead, which ends in a heading of 1 rad."""
    zero = np.zeros(1)
    inputs = CourseInputs({"heading": zero, "lookahead": zero}, np.zeros((1, 2)), zero)
    task = parse_task("path,waypoints=0:0:4:0,heading=1")
    return jax.tree.map(lambda x: jnp.asarray(x[0]), task.courses(inputs)[1])


def along(course, progress, x, **changes):
    """Return progress and aim after a touch of a box x [m] along the path."""
    box, end = fp.rectangle(0.3, 0.3), jnp.array([4.0, 0.0])
    at = positions(box, np.array([x, 0.0]) + 0.3 * unit(1.0), 1.0, np.array([x, 0.0]), **changes)
    at = at._replace(p_world_goal=end, base=jnp.array([0.0, 0.0, 1.0]))
    return jitted(PathCourse.step)(course, progress, at)


def test_a_path_ends_in_a_pose_from_its_last_part_on(ending):
    """The law gets the end once it is near, and keeps it where a detour takes the object back."""
    progress, aim = along(ending, ending.start(), 1.0)
    assert np.isnan(aim.yaw_target)
    assert_allclose(aim.p_world_target, [2.6, 0.0], atol=1e-5)
    error = float(progress.max_error)
    progress, aim = along(ending, progress, 2.0)
    for x in (3.0, 2.1, 3.0, 4.03):
        progress, aim = along(ending, progress, x)
        assert float(aim.yaw_target) == pytest.approx(1.0)
        assert_allclose(aim.p_world_target, [4.0, 0.0], atol=1e-6)
        assert bool(aim.success) == (x > 4)
    outcomes = progress.outcomes()
    assert float(outcomes["place_error"]) == pytest.approx(0.03, abs=2e-6)
    assert float(outcomes["error_max"]) == pytest.approx(error, abs=1e-6)
    assert float(outcomes["progress"]) == pytest.approx(1)


def test_a_path_without_a_heading_has_neither_its_number_nor_its_outcomes():
    plain, posed = (parse_task(f"path,length=5{x}") for x in ("", ",heading=0.2"))
    assert "heading" in plain.idle - posed.idle
    assert set(posed.outcomes) - set(plain.outcomes) == set(Pose.OUTCOMES)
    assert plain.shape != posed.shape


@pytest.mark.slow
def test_the_law_of_paths_delivers_boxes_to_the_pose_at_the_end():
    free = "pose.v_free=0.2,pose.omega_free=0.5"
    setting = Setting(rules=Rules(horizon=500.0), split="tune")
    inputs = {"worlds": 8, "task": "path,heading=-3.14:3.14", "setting": setting}
    results = rps_jax.sweep(f"path_pose,{free}", "wide,objects=random_box", **inputs)
    assert int(results.success.sum()) >= 7
    assert (results.declared > 0).all()
    assert (results.error_95 < 1).all()
    assert "heading" in results


def test_before_the_end_of_the_path_its_law_runs_alone():
    """Bit for bit `unicycle`, and then `pose` from its start."""
    params = registry.LAWS["path_pose"]
    law = registry.law_of(params)
    touch = touching(0.3625, 0.1, GOAL)
    ends = jnp.zeros(2), jnp.zeros(2, bool), NO, jnp.asarray(0.3625)
    obs = sensed(touch._replace(yaw_target=jnp.asarray(jnp.nan)), *ends)
    state, twist, _ = jax.jit(law.step)(params, law.init(params), obs)
    alone = registry.law_of(params.path)
    expected = jax.jit(alone.step)(params.path, alone.init(params.path), touch)[1]
    assert_array_equal(jnp.stack(twist), jnp.stack(expected))
    assert float(state.pose.time) == 0
    obs = obs._replace(touch=touch)
    state, twist, _ = jax.jit(law.step)(params, state, obs)
    pose = registry.law_of(params.pose)
    expected = jax.jit(pose.step)(params.pose, pose.init(params.pose), obs)[1]
    assert_allclose(jnp.stack(twist), jnp.stack(expected), atol=1e-8)


def test_rooms_end_in_a_straight_line_along_the_heading_of_the_map():
    """The heading is one of the map, which the start turns."""
    hall = {"outline": [[0, 0], [9, 0], [9, 9], [0, 9]], "start": [2, 2, 0.5], "goal": [6, 6]}
    task = parse_task(hall | {"heading": 1.2, "base_radius": 1.2})
    drawn = draws.draw(parse_domain("wide", task=task), 0, np.arange(1))
    last = np.diff(drawn.course.lines()["path"][0], axis=0)[-1]
    assert_allclose(last, APPROACH * unit(0.7), atol=1e-6)
    assert float(drawn.course.path.goal.heading[0]) == pytest.approx(0.7)
    assert task.free_room == pytest.approx(1.45)
    with refusing("task heading = -1.57 is not allowed: the last 1.6 m to a goal"):
        parse_task(hall | {"heading": -1.57, "base_radius": 1.2})
    with refusing("give one heading in the map"):
        parse_task(hall | {"heading": [0, 1]})


@pytest.mark.parametrize("robot", ROBOTS)
def test_every_robot_gets_a_law_for_poses_that_suits_its_drive_and_its_front(robot):
    """The law backs off from a flush or a tilted contact that is still on the front.

    If no law suits the base, the sentence says why.
    """
    base = Robot.parse(robot)
    for task in ("pose", "path,heading=1"):
        if base.drive == "car" or base.radius is not None:
            with refusing("brings objects to a heading; name a custom law"):
                _ = Case(robot=robot, task=task)
            continue
        name = Case(robot=robot, task=task).named_law
        params: Any = registry.LAWS[str(name)]
        assert base.drive in registry.law_of(params).drives
        law = getattr(params, "pose", params)
        assert min(law.l_edge, law.l_turn) < base.half_width
