"""Bases that cannot move sideways: their drives in all engines, their presets, and their law."""

import json
import math
import shlex
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ROOT, observation, refusals, refusing, row, slow

from rps_jax import draw_worlds, engines, rollout
from rps_jax.app.cli import flags, names
from rps_jax.app.export.program import program
from rps_jax.control import registry
from rps_jax.control.base import Law
from rps_jax.control.laws import unicycle
from rps_jax.control.observation import Details, Twist
from rps_jax.record import files
from rps_jax.robot import base as robot_base
from rps_jax.robot.base import Tyres
from rps_jax.robot.robot import ROBOTS, Robot, parse_robot
from rps_jax.robot.skin import NONE
from rps_jax.runs.model_panel import model_plans
from rps_jax.runs.sweep import Sweep
from rps_jax.studies.attack import Attack
from rps_jax.trials import pushes
from rps_jax.trials.case import Case
from rps_jax.trials.env import PushEnv
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.world import domain as domains
from rps_jax.world import scene

PERIOD = 0.02
DIFFERENTIAL = Robot(drive="differential", axle=0.2, track=0.5)
CAR = Robot(drive="car", axle=0.3, turning_radius=0.5)
BASES = {
    "differential": DIFFERENTIAL,
    "differential with a limited force": replace(
        DIFFERENTIAL, force_max=300.0, lag=0.1, wheel_acceleration_max=0.5, slip=0.1, slip_yaw=0.3
    ),
    "car": replace(CAR, lag=0.2),
    "car with traction": replace(CAR, traction=0.5),
}
QUICK_AXLES = list(zip(BASES, ("quasistatic", "mujoco", None, "fused"), strict=True))
# A limited force is not for the planar engine.
AXLES = [x if x in QUICK_AXLES else slow(*x) for x in product(BASES, engines.names())]


class Weave(NamedTuple):
    """Parameters of a law that weaves, and commands a sideways velocity as well."""

    v: Any = 0.05  # [m/s]
    d_success: Any = 0.05


@pytest.fixture
def weave(registries):
    """Register the law for one test."""

    def step(params, state, obs):
        turn = 0.15 * jnp.sin(0.05 * state)
        return state + 1, Twist(params.v, 0.03, turn), Details.from_obs(obs)

    law = Law(lambda params: jnp.zeros(()), step, drives=("omni", "differential", "car"))
    registry.register_law("weave", law, Weave())


def motion_of_axle(qpos, axle):
    """Return the velocity (T, 2) [m/s] of the axle, ahead and to the left, and omega (T,)."""
    x, y, yaw = np.asarray(qpos, float)[:, :3].T
    point = np.stack([x - axle * np.cos(yaw), y - axle * np.sin(yaw)])
    v, middle = np.diff(point) / PERIOD, (yaw[1:] + yaw[:-1]) / 2
    ahead = np.cos(middle) * v[0] + np.sin(middle) * v[1]
    return ahead, np.cos(middle) * v[1] - np.sin(middle) * v[0], np.diff(yaw) / PERIOD


def trace(case, engine, seconds=2.0):
    """Return the positions of a push, one for each control period."""
    setting = Setting(engine, rules=Rules(horizon=seconds))
    batch = pushes.build([case], setting)
    return pushes.record_batch(batch, setting, interval=PERIOD)[0].snapshots.qpos


# --- the axle ------------------------------------------------------------------------------


@pytest.mark.usefixtures("weave")
@pytest.mark.parametrize(("name", "engine"), AXLES)
def test_the_axle_does_not_move_sideways(name, engine):
    robot = BASES[name]
    if robot.driven and not engines.get(engine).forces:
        return
    qpos = trace(Case(law="weave", robot=robot), engine)
    ahead, aside, omega = motion_of_axle(qpos, robot.axle)
    assert np.abs(aside).max() < 1e-4
    assert ahead.max() > 0.03
    assert np.abs(omega).max() > 0.03
    if robot.turning_radius is not None:
        assert np.abs(omega[20:] * 0.5).max() < np.abs(ahead[20:]).max() * 1.01


@pytest.mark.parametrize(
    "law",
    [
        x if x == "unicycle" else slow(x)
        for x, params in registry.LAWS.items()
        if "car" in registry.law_of(params).drives
    ],
)
def test_no_law_moves_the_axle_sideways(law):
    qpos = trace(Case(law=law, robot=DIFFERENTIAL, target=(0.5, 1.5)), "fused", 12.0)
    _, aside, omega = motion_of_axle(qpos, DIFFERENTIAL.axle)
    assert np.abs(aside).max() < 1e-4
    assert np.abs(omega).max() > 0.05


TWIST = jnp.array([0.4, 0.3, -1.0])


def test_the_twist_of_an_axle_keeps_speed_and_turn():
    aim = robot_base.aim(DIFFERENTIAL, jnp.zeros(3), TWIST, PERIOD)
    np.testing.assert_allclose(aim, [0.4, -0.2, -1.0], rtol=1e-6)
    aim = robot_base.aim(CAR, jnp.zeros(3), TWIST, PERIOD)
    np.testing.assert_allclose(aim, [0.4, -0.24, -0.8], rtol=1e-6)


LIMITS = {
    "wheel speed": ({"wheel_speed_max": 0.325}, 0.5),
    "speed": ({"v_max": 0.1}, 0.25),
    "turning rate": ({"omega_max": 0.2}, 0.2),
    "wheel acceleration": ({"wheel_acceleration_max": 3.25}, 0.1),
    "acceleration": ({"acceleration_max": (2.0, 10.0)}, 0.1),
    "lag": ({"lag": PERIOD / math.log(2)}, 0.5),
}


@pytest.mark.parametrize("name", LIMITS)
def test_a_limit_keeps_the_curvature(name):
    limits, share = LIMITS[name]
    robot = replace(DIFFERENTIAL, **limits)
    aim = jax.jit(robot_base.aim, static_argnums=3)(robot, jnp.zeros(3), TWIST, PERIOD)
    np.testing.assert_allclose(aim, share * np.array([0.4, -0.2, -1.0]), rtol=1e-5)


def test_errors_and_slip_are_those_of_wheels():
    twist = jnp.array([0.4, -0.2, -1.0])
    wrong = robot_base.apply_errors(DIFFERENTIAL, twist, jnp.array([0.1, 0.5, -0.1]))
    # The left wheel has 0.65 m/s, the right one 0.15 m/s.
    left, right = 0.65 * 1.1, 0.15 * 0.9
    omega = (right - left) / 0.5
    np.testing.assert_allclose(wrong, [(left + right) / 2, 0.2 * omega, omega], rtol=1e-5)
    np.testing.assert_allclose(robot_base.apply_errors(None, twist, jnp.zeros(3)), twist)
    slips = robot_base.apply_slip(replace(DIFFERENTIAL, slip=0.1, slip_yaw=0.4), twist)
    np.testing.assert_allclose(slips, [0.36, -0.12, -0.6], rtol=1e-6)


def test_the_motor_does_not_resist_a_sideways_velocity_and_the_tyres_stop_it():
    robot = replace(DIFFERENTIAL, force_max=300.0)
    still, turn = (0.0, 0.0, 0.0), (1.0, 0.0)
    force, _ = robot_base.push(robot, still, still, (0.0, 0.05, 0.0), turn, 0.01)
    assert force == (0.0, 0.0, 0.0)
    tyres = Tyres.of(robot, (0.0, 0.05, 0.0), turn, 0.01)
    inertia = np.diag([robot.mass, robot.mass, robot.inertia])
    held = inertia + tyres.mass * np.outer(tyres.sideways, tyres.sideways)
    velocity = np.array([0.0, 0.05, 0.0]) + 0.01 * np.linalg.solve(held, tyres.force)
    assert abs(velocity @ tyres.sideways) < 1e-4


def test_an_action_for_an_axle_is_two_numbers():
    env = PushEnv("random_cylinder", robot=DIFFERENTIAL, worlds=4)
    assert env.action_size == 2
    np.testing.assert_allclose(env.twist(jnp.array([0.5, -0.2])), [0.025, 0.0, -0.03], rtol=1e-6)
    with refusing("it must be 2 numbers: v_x and omega"):
        env.twist(jnp.zeros(3))


@pytest.mark.slow
def test_derivatives_of_a_driven_axle_are_central_differences():
    robot = replace(DIFFERENTIAL, force_max=300.0, lag=0.1)
    env = PushEnv("random_cylinder", robot=robot, setting=Setting("fused"), worlds=4)
    state = env.reset(jax.random.key(0))

    def end(speed):
        moved = state
        for _ in range(3):
            moved = env.step(moved, jnp.array([speed, 0.5]))
        return moved.data.qpos[:3]

    slope, delta = jax.jacfwd(end)(0.5), 0.05
    expected = (end(0.5 + delta) - end(0.5 - delta)) / (2 * delta)
    np.testing.assert_allclose(slope, expected, atol=1e-5)


# --- robots and refusals -------------------------------------------------------------------


def test_presets_and_files_of_robots_are_valid(tmp_path):
    for name, robot in ROBOTS.items():
        assert parse_robot(name) == robot
    mine = {"half_length": 0.3, "half_width": 0.2, "drive": "car", "turning_radius": 0.6}
    mine |= {"boards": [{"side": "front", "count": 2}]}
    path = tmp_path / "mine.json"
    page = (ROOT / "docs/my_robot.md").read_text()
    path.write_text(page.split("```json\n")[1].split("```")[0])
    assert parse_robot(str(path)).drive == "differential"
    path.write_text(json.dumps(mine))
    parsed = parse_robot(f"{path},axle=0.1")
    assert (parsed.drive, parsed.axle, parsed.turning_radius) == ("car", 0.1, 0.6)
    assert not parsed.ideal
    assert not ROBOTS["turtlebot4"].ideal


test_a_drive_is_refused = refusals(
    parse_robot,
    (("turtlebot4,axle=0.3",), "robot axle = 0.3 m is not allowed: it lies outside the base"),
    (("ideal,axle=0.1",), "robot axle = 0.1 is not allowed: .* choose drive"),
    (("ideal,turning_radius=0.5",), "robot turning_radius = 0.5 is not allowed"),
    (("jackal,turning_radius=0.5",), "robot turning_radius = 0.5 is not allowed: .* drive = car"),
    (("ideal,drive=car",), "robot turning_radius = None is not allowed: a car needs"),
    (("jackal,track=0",), "robot track = 0.0 is not allowed"),
    (("ideal,drive=tank",), "unknown robot drive 'tank': choose from omni, differential, car"),
    (("jackal,slip_sideways=0.1",), "robot slip_sideways = 0.1 is not allowed"),
)


@pytest.mark.parametrize("name", [k for k, x in ROBOTS.items() if x.drive != "omni"])
def test_the_skin_of_a_robot_with_an_axle_has_no_gap_at_its_corners(name):
    """A corner that feels nothing pushes objects away, as on the detours of `unicycle`."""
    shell = ROBOTS[name].shell
    lengths = [float(row.length) for row in shell.rows()]
    np.testing.assert_allclose(lengths, 2 * np.array(shell.half)[[0, 1, 0]], rtol=1e-6)


@pytest.mark.parametrize("name", ["turtlebot4", "jackal", "husky", "mir100", "f1tenth"])
def test_in_pictures_a_robot_has_its_size(name):
    robot = ROBOTS[name]
    model = scene.load("box", robot=robot).model
    geoms = np.flatnonzero(model.geom_bodyid == model.body("base").id)
    middle, half = np.split(model.geom_aabb[geoms], 2, axis=1)
    upright = np.abs(model.geom_quat[geoms][:, 0]) > 0.999  # wheels stick out a little
    reach = (np.abs(middle + model.geom_pos[geoms]) + half)[upright, :2].max(axis=0)
    np.testing.assert_allclose(reach, robot.sizes, atol=0.005)


def test_a_law_that_moves_sideways_is_refused_with_those_that_do_not():
    expected = r"law = rps_plus is not allowed: it moves sideways, .*differential.* unicycle"
    with refusing(expected):
        pushes.build([Case(law="rps_plus", robot="turtlebot4")], Setting())


test_a_task_without_room_for_detours_is_refused = refusals(
    lambda task: Case(law="unicycle", task=task),
    (("corridor,width=1.9",), "task = corridor with the law unicycle is not allowed: .* 1 m"),
)


# --- the law -------------------------------------------------------------------------------

SMALL = unicycle.Widths(1e-6, 1e-6, 1e-6)


def follow(robot_facts, temperatures=None, steps=6000):
    """Run the law without an object: a touch at the start, and none later; return its path."""
    params = unicycle.UnicycleParams()
    touch = jnp.asarray(True) if temperatures is None else jnp.ones(())
    away = jnp.logical_not(touch) if temperatures is None else jnp.zeros(())

    def body(carry, step):
        state, pose = carry
        obs = observation(pose[:2], pose[2], [0.3625, 0.1], True, [0.0, -2.0])
        obs = obs._replace(in_contact=jnp.where(step < 300, touch, away), **robot_facts)
        state, twist, _ = unicycle.step(params, state, obs, temperatures)
        pose = pose + PERIOD * twist.in_world(pose[2])
        return (state, pose), (pose, jnp.stack(twist), state.around, state.align)

    start = unicycle.init(params, temperatures), jnp.zeros(3)
    return jax.lax.scan(body, start, jnp.arange(steps))[1]


FACTS = {
    "differential": {"axle": 0.2},
    "car": {"axle": 0.2, "turning_radius": 0.5},
    "round": {"axle": 0.0, "base_radius": 0.29},
}


@pytest.mark.parametrize("name", FACTS)
def test_after_a_lost_contact_the_base_drives_behind_the_object_and_faces_the_target(name):
    facts = FACTS[name]
    poses, twists, around, align = map(np.asarray, jax.jit(lambda: follow(facts))())
    np.testing.assert_allclose(twists[:, 1], facts["axle"] * twists[:, 2], atol=1e-7)
    assert np.hypot(twists[:, 0], twists[:, 1]).max() < 0.05001
    assert np.abs(twists[:, 2]).max() < 0.15001
    if "turning_radius" in facts:
        assert (np.abs(twists[:, 2]) * 0.5 <= np.abs(twists[:, 0]) + 1e-6).all()
    first = int(np.flatnonzero(around)[0])
    end = int(np.flatnonzero(align[:-1] & ~align[1:])[0]) + 1  # it approaches the object
    yaw = poses[first, 2]
    middle = poses[first, :2] + 0.8 * np.array([math.cos(yaw), math.sin(yaw)])  # roughly
    to_target, behind = np.array([0.0, -2.0]) - middle, poses[end, :2] - middle
    error = math.remainder(poses[end, 2] - math.atan2(*to_target[::-1]), 2 * math.pi)
    assert abs(error) < 0.6
    assert to_target @ behind < -0.8 * np.linalg.norm(to_target) * np.linalg.norm(behind)


def test_the_smooth_law_tends_to_the_hard_one():
    hard, smooth = (follow(FACTS["differential"], x, 1200)[0] for x in (None, SMALL))
    np.testing.assert_allclose(smooth[:900], hard[:900], atol=1e-2)


def stepped(contact, in_contact, base=0.0, **state):
    """Return the state after one control step of a base on the x axis, with the target ahead."""
    params = unicycle.UnicycleParams()
    start = unicycle.init(params)._replace(**{k: jnp.asarray(x) for k, x in state.items()})
    obs = observation([base, 0.0], 0.0, contact, in_contact, [5.0, 0.0])
    return unicycle.step(params, start, obs._replace(axle=0.2))[0], params


WAY = {  # contact on the way around the object, and whether the base then retreats or goes on
    "middle of the front": ((0.3625, 0.1), False, False),
    "end of the front": ((0.3625, 0.28), True, False),
    "side near the front": ((0.3, 0.29), True, False),
    "side": ((0.0, 0.29), False, True),
}


@pytest.mark.parametrize("name", WAY)
def test_a_touch_on_the_way_is_a_push_a_retreat_or_moves_the_circle(name):
    contact, retreats, goes_on = WAY[name]
    state, _ = stepped(contact, True, touched=True, around=True, p_world_object=[-0.5, 0.8])
    assert (bool(state.retreat), bool(state.around)) == (retreats, goes_on)
    assert not state.align


def test_a_touch_on_the_way_moves_the_middle_less_than_one_in_a_push():
    contact, params = np.array([0.3625, -0.28]), unicycle.UnicycleParams()
    known = contact + np.array([0.0, params.r])
    steps = (
        stepped(contact, True, touched=True, p_world_object=known, **{k: True})[0]
        for k in ("around", "pushed")
    )
    angles = [np.arctan2(*(np.asarray(x.p_world_object) - contact)[::-1]) for x in steps]
    np.testing.assert_allclose(angles, [math.pi / 4, 0.0], atol=1e-5)


def test_the_base_turns_while_it_retreats():
    params = unicycle.UnicycleParams()
    start = unicycle.init(params)._replace(
        **{k: jnp.asarray(True) for k in ("touched", "retreat")},
        p_world_object=jnp.array([0.6, 0.0]),
        p_world_contact=jnp.array([0.37, 0.0]),
    )
    obs = observation([0.0, 0.0], 0.0, [0.0, 0.0], False, [0.6, 3.0])._replace(axle=0.0)
    state, twist, _ = unicycle.step(params, start, obs)
    assert state.retreat
    assert twist.v_x == -np.float32(params.v_max)
    assert abs(twist.omega) == np.float32(params.omega_max)


@pytest.mark.parametrize(
    ("misses", "offset", "expected"),
    [(0, 0.1, "contact"), (1, 0.1, "ahead"), (1, 0.28, "beside"), (2, 0.1, "beside")],
)
def test_after_approaches_that_miss_the_law_looks_where_an_object_is_not_felt(
    misses, offset, expected
):
    known = {"touched": True, "p_world_object": [1.0, 0.0], "p_world_contact": [0.8, 0.1]}
    state, params = stepped([0.0, 0.0], False, base=1.2, l=offset, misses=float(misses), **known)
    front = 1.2 + 0.3625
    guesses = {"contact": [0.8, 0.1], "ahead": [front + params.r, 0.0], "beside": [0.7, -0.75]}
    np.testing.assert_allclose(state.p_world_object, guesses[expected], atol=1e-6)
    assert state.retreat
    assert state.misses == misses + 1


def test_a_target_far_aside_ends_a_push_at_once():
    params = unicycle.UnicycleParams()
    for bearing in (0.9 * params.e_far, 1.1 * params.e_far):
        contact = np.array([0.3625, 0.0])
        target = contact + 3.0 * np.array([math.cos(bearing), math.sin(bearing)])
        obs = observation([0.0, 0.0], 0.0, contact, True, target)._replace(axle=0.0)
        state = unicycle.step(params, unicycle.init(params), obs)[0]
        assert bool(state.retreat) == (bearing > params.e_far)


def test_repositions_are_counted_with_their_time_and_way():
    """By hand, from the readings of each control step of a push that repositions."""
    setting = Setting(rules=Rules(horizon=30.0))
    batch = pushes.build([Case(law="unicycle", robot=DIFFERENTIAL, target=(0.5, 1.5))], setting)
    trajectory = pushes.record_batch(batch, setting, interval=PERIOD)[0]
    snapshots, outcome = trajectory.snapshots, trajectory.outcome
    touches = np.asarray(snapshots.reading.contact_type) != NONE
    lost = ~touches & (np.cumsum(touches) > 0)
    way = np.linalg.norm(np.diff(np.asarray(snapshots.qpos, float)[:, :2], axis=0), axis=1)
    lengths = [len(x) for x in "".join("ny"[int(x)] for x in ~lost).split("y")]
    assert outcome.repositions == sum(x * PERIOD >= 2 - 1e-9 for x in lengths) > 0
    assert outcome.contact_lost_time == pytest.approx(lost.sum() * PERIOD)
    assert outcome.contact_lost_path == pytest.approx(way[lost[:-1]].sum(), rel=1e-3)


# --- one file of a robot -------------------------------------------------------------------

COMMANDS = [
    name
    for name, command in names.known().items()
    if {"robot", "setting"} <= set(names.question_type(name).__dataclass_fields__)
]
WITH_PERIOD = {"drive": "differential", "axle": 0.2, "period": 0.1}


def with_robot_of(folder, name) -> Any:
    """Return a command with the file of a robot."""
    files.write_json(folder / "mine.json", WITH_PERIOD)
    words = ["--robot", str(folder / "mine.json"), *(["unicycle"] if name == "score" else [])]
    return flags.parse(names.question_type(name), name, words)[0]


@pytest.mark.parametrize("name", COMMANDS)
def test_the_file_of_a_robot_sets_the_control_period_of_a_command(name, tmp_path):
    question = with_robot_of(tmp_path, name)
    assert question.setting.physics.control_period == 0.1
    assert question.setting.fidelity == Setting().fidelity or name == "learn"


def test_another_period_than_that_of_the_robot_is_refused():
    robot = Robot(period=0.1)
    assert Setting(physics="default,control_period=0.1").with_robot(robot).physics.substeps == 10
    with refusing("control_period.* period of the robot"):
        Setting(physics="default,control_period=0.05").with_robot(robot)
    with refusing("control_period.* multiple of timestep"):
        Setting(fidelity="fast").with_robot(Robot(period=0.05))
    with refusing("with_robot"):
        Setting().check_here(robot)
    with refusing("period"):
        parse_robot("ideal,period=0")


def test_calls_of_the_library_take_the_period_of_the_robot():
    env = PushEnv(robot="ideal,period=0.1", worlds=2)
    assert env.dt == 0.1
    inputs = {"robot": "ideal,period=0.1", "setting": Setting("quasistatic")}
    batch = draw_worlds("wide,objects=random_cylinder", **inputs)
    options = registry.LAWS["rps"], batch.stage, inputs["setting"]
    run = lambda world: rollout(world, *options, horizon=0.5)  # noqa: E731
    assert jax.eval_shape(run, row(batch.worlds, 0)).time.shape == (5,)


def test_models_and_checks_keep_the_period_and_the_support_of_a_run():
    plans = model_plans(Sweep("rps", robot="ideal,period=0.1").plan).values()
    assert len(plans) > 5
    assert {x.setting.physics.control_period for x in plans} == {0.1}
    setting = Setting(physics="default,support=even")
    physics = Attack(robot="ideal,period=0.1", setting=setting).reference.physics
    assert (physics.control_period, physics.support, physics.timestep) == (0.1, "even", 0.001)


def test_the_time_constant_of_a_robot_is_that_of_its_skin_in_pushes_and_exports():
    robot = "ideal,time_constant=0.3"
    assert Case(robot=robot, skin="capacitive").sensor.time_constant == 0.3
    values = {x.name: x.value for x in program("rps", robot).groups["skin_params"]}
    assert values["time_constant"] == 0.3


def test_a_rollout_refuses_a_law_that_the_base_cannot_follow():
    batch = draw_worlds("wide,objects=random_cylinder", robot="turtlebot4")
    with refusing("law = rps is not allowed: it moves sideways"):
        jax.vmap(lambda world: rollout(world, registry.LAWS["rps"], batch.stage))(batch.worlds)


@pytest.mark.parametrize("following", ["sweep", "ladder"])
@pytest.mark.parametrize(
    "name", [x for x in COMMANDS if hasattr(names.question_type(x), "next_command")]
)
def test_a_command_that_is_printed_keeps_robot_domain_and_period(name, following, tmp_path):
    first, laws = with_robot_of(tmp_path, name), ["unicycle", "unicycle,r=0.2"]
    words = shlex.split(first.next_command(following, laws=laws, domain="wide,mass=3:9"))
    assert words[:2] == ["rps", following]
    second: Any = flags.parse(names.question_type(following), following, words[2:])[0]
    assert (second.robot, np.ravel(second.domain)) == (first.robot, ["wide,mass=3:9"])
    assert second.setting.physics.control_period == 0.1
    assert list(second.chosen) == laws


def test_the_file_of_a_domain_keeps_the_period_of_its_robot(tmp_path):
    path = tmp_path / "fitted.json"
    files.write_json(path, domains.to_json(domains.parse_domain("wide", WITH_PERIOD)))
    assert Sweep("unicycle", str(path)).setting.physics.control_period == 0.1
