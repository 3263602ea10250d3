"""Models of real robots: tracking of twists, pushes with limited force, and stalls."""

import json
import math
from dataclasses import asdict, replace
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    NEAR,
    SHORT,
    case,
    refusal,
    same,
    setting_of,
    slow,
)
from numpy.testing import assert_allclose, assert_array_equal
from staging import push_object, recompiled

import rps_jax
from rps_jax import engines
from rps_jax.control import registry
from rps_jax.control.base import Law
from rps_jax.control.observation import Details, Twist
from rps_jax.geometry.solid import GRAVITY
from rps_jax.robot import base as robot_base
from rps_jax.robot.robot import ROBOTS, Robot, parse_robot
from rps_jax.trials import pushes
from rps_jax.trials.case import Case
from rps_jax.trials.env import PushEnv
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.tuning import fit
from rps_jax.world import domain, draws, scene
from rps_jax.world.domain import DOMAINS, Range
from rps_jax.world.physics import preset
from rps_jax.world.scene import JOINTS, WorldInputs

PERIOD = 0.02
STANDARD = preset()
AHEAD = (0.05, 0.0, 0.0)


def reference_velocities(robot, twist, steps):
    """Return reference velocities (steps, 3) of the drive of a base at rest, at one twist."""
    aim, velocities = jnp.zeros(3), []
    for _ in range(steps):
        aim = robot_base.aim(robot, aim, jnp.asarray(twist, float), PERIOD)
        velocities.append(np.asarray(aim))
    return np.array(velocities)


# --- the aim -------------------------------------------------------------------------------


# Robot, twist, the twist within the robot's bounds, and the share of it that is reached in time.
RESPONSES = {
    "first-order lag": (Robot(lag=0.3), (0.05, -0.02, 0.1), None, lambda t: 1 - np.exp(-t / 0.3)),
    # A speed of 0.05 m/s takes 0.1 s, the turn as long.
    "acceleration": (
        Robot(acceleration_max=(0.5, 1.0)),
        (0.03, 0.04, -0.1),
        None,
        lambda t: np.minimum(t / 0.1, 1.0),
    ),
    "no lag": (Robot(lag=0.0), AHEAD, None, np.ones_like),
    "speed": (Robot(v_max=0.5, omega_max=0.2), (3.0, 4.0, -1.0), (0.3, 0.4, -0.2), np.ones_like),
    "speed sideways": (Robot(v_max=(0.5, 0.1)), (0.4, 0.2, 0.0), (0.2, 0.1, 0.0), np.ones_like),
}


@pytest.mark.parametrize("name", RESPONSES)
def test_the_twist_is_bounded_as_a_vector_and_reached_by_lag_and_acceleration(name):
    robot, twist, bounded, share = RESPONSES[name]
    velocities = reference_velocities(robot, twist, 60)
    expected = share(PERIOD * np.arange(1, 61)[:, None]) * (bounded or twist)
    assert_allclose(velocities, expected, atol=1e-7)


# Robot, and the shares of v_x, v_y and omega that its wheels lose.
SLIPS = {
    "of all": (Robot(slip=0.1), (0.1, 0.1, 0.1)),
    "in yaw": (Robot(slip_yaw=0.45), (0.0, 0.0, 0.45)),
    "sideways": (Robot(slip_sideways=0.3), (0.0, 0.3, 0.0)),
    "mixed": (Robot(slip=0.1, slip_yaw=0.45), (0.1, 0.1, 0.45)),
    "but not sideways": (Robot(slip=0.9, slip_sideways=0.0), (0.9, 0.0, 0.9)),
}
TWIST = jnp.array([0.05, 0.02, -0.15])


@pytest.mark.parametrize("name", SLIPS)
def test_wheels_that_slip_lose_their_share_of_each_axis(name):
    robot, shares = SLIPS[name]
    assert not robot.ideal
    expected = TWIST * (1 - np.array(shares))
    assert_allclose(robot_base.apply_slip(robot, TWIST), expected, rtol=1e-6)


def test_slip_alone_is_that_of_all_axes_and_none_costs_nothing():
    assert robot_base.apply_slip(Robot(lag=0.1), TWIST) is TWIST
    for share in (0.1, 0.45):
        robots = Robot(slip=share), Robot(slip=share, slip_sideways=share, slip_yaw=share)
        same(*(jax.jit(robot_base.apply_slip)(robot, TWIST) for robot in robots))


class Steady(NamedTuple):
    """Parameters of a law that commands one twist."""

    v_x: Any  # [m/s]
    v_y: Any  # [m/s]
    omega: Any  # [rad/s]
    d_success: Any = 0.05


@pytest.fixture
def steady(registries):
    """Register a law that commands one twist for one test."""

    def step(params, state, obs):
        return state, Twist(*params[:3]), Details.from_obs(obs)

    registry.register_law("steady", Law(lambda params: (), step), Steady(0.1, 0.0, 0.0))


def position_after(twist, seconds):
    """Return the pose (3,) [m, m, rad] of a base that executes a twist from the origin."""
    turn = twist[2] * seconds
    a, b = (seconds, 0.0)
    if twist[2]:
        a, b = np.sin(turn) / twist[2], (1 - np.cos(turn)) / twist[2]
    return np.array([a * twist[0] - b * twist[1], b * twist[0] + a * twist[1], turn])


@pytest.mark.usefixtures("steady")
@pytest.mark.parametrize("engine", ["fused", *map(slow, ("mjx", "mujoco", "quasistatic"))])
def test_a_base_turns_and_strafes_less_than_commanded_in_all_engines(engine):
    """Away from the object; the fused engine is compiled C."""
    commands = ((0.1, 0.0, 0.5), (0.1, 0.0, 0.0), (0.1, 0.05, 0.5))
    shares = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.45), (0.0, 0.45, 0.0), (0.1, 0.9, 0.45))
    pairs = list(product(commands, shares))
    bases = [Robot(slip=x, slip_sideways=y, slip_yaw=z) for _, (x, y, z) in pairs]
    cases = [
        Case("box", "S1", (2.0, 0.0), Steady(*command), gap=0.3, robot=base)
        for (command, _), base in zip(pairs, bases, strict=True)
    ]
    outcome, _ = pushes.run(cases, setting_of(0.4, engine))
    executed = [np.array(command) * (1 - np.array(share)) for command, share in pairs]
    expected = np.array([position_after(twist, outcome.time[0]) for twist in executed])
    assert_allclose(outcome.base_pose[:, 2], expected[:, 2], rtol=1e-4, atol=1e-6)
    assert_allclose(outcome.base_pose[:, :2], expected[:, :2], atol=4e-4)
    assert not outcome.stalled.any()


def test_the_environment_and_a_single_trial_turn_by_the_share_that_is_left():
    drums = replace(NEAR, objects=("random_cylinder",), robot=Robot(slip_yaw=0.45))
    push = PushEnv("random_cylinder", drums, setting=SHORT, worlds=2)
    state = jax.jit(push.reset)(jax.random.key(0))
    step = jax.jit(push.step)
    for _ in range(5):
        state = step(state, jnp.array([0.0, 0.5, 1.0]))
    turn = 0.55 * 0.15 * 5 * push.dt
    assert_allclose(state.data.qpos[2], turn, rtol=1e-4)
    assert_allclose(state.data.qpos[1], 0.5 * 0.05 * 5 * push.dt, rtol=1e-3)
    trace = rps_jax.push("box", target=(0.6, 0.3), setting=SHORT, robot="ideal,slip_yaw=0.45")
    steady = (trace.data.omega.values == np.float32(0.15))[:-1] & (np.diff(trace.data.omega) == 0)
    turned = np.diff(trace.data.qpos.values[:, 2])[steady]  # in 0.1 s
    assert steady.sum() > 20
    assert_allclose(turned, 0.55 * 0.15 * 0.1, atol=1e-6)


def test_a_base_with_slip_stalls_at_its_own_speed():
    """A base with 90 % slip that aims at 50 mm/s executes 5 mm/s."""
    state = robot_base.init_drive(TWIST)._replace(aim=jnp.array(AHEAD))
    for robot, speed, stands in (
        (Robot(slip=0.9), 0.005 * 0.99, 0),
        (Robot(slip=0.9), 0.0004, 1),
        (Robot(), 0.0049, 1),
        (Robot(), 0.0051, 0),
    ):
        qvel = jnp.zeros(9).at[0].set(speed)
        assert int(robot_base.count_stalled_steps(robot, state, qvel).stalled) == stands


# --- the drive -----------------------------------------------------------------------------


def test_the_force_is_bounded_in_its_direction_by_drive_traction_and_rolling():
    robot = Robot(mass=100.0, force_max=300.0, traction=0.25, resistance=0.05)
    assert robot.push_max == pytest.approx(0.20 * 100 * GRAVITY)  # traction less rolling
    assert replace(robot, traction=0.9).push_max == pytest.approx(300 - 0.05 * 100 * GRAVITY)
    assert robot.turn_max == pytest.approx(robot.push_max * math.hypot(0.3625, 0.29))
    assert replace(robot, torque_max=7.0).turn_max == 7.0
    still = (0.0, 0.0, 0.0)
    for turn in ((1.0, 0.0), (0.6, 0.8)):
        force, _ = robot_base.push(robot, still, (3.0, 4.0, 5.0), still, turn, 0.01, np)
        assert np.hypot(*force[:2]) == pytest.approx(robot.push_max)
        c, s = turn
        along = (c * force[0] + s * force[1], c * force[1] - s * force[0])
        assert_allclose(along, np.array([0.6, 0.8]) * robot.push_max)
        assert force[2] == pytest.approx(robot.turn_max)


def test_the_servo_overshoots_once_and_recovers_from_a_stall():
    """It is a double pole and a zero: it overshoots by exp(-2), and recovers after a stall."""
    robot, dt = Robot(mass=100.0, force_max=200.0), 0.01
    v, integral = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    velocities = []
    for _ in range(100):
        force, integral = robot_base.push(robot, integral, AHEAD, v, (1.0, 0.0), dt, np)
        v = (v[0] + dt * force[0] / 100, 0.0, 0.0)
        velocities.append(v[0])
    assert velocities[-1] == pytest.approx(0.05, rel=1e-4)
    assert max(velocities) == pytest.approx(0.05 * (1 + np.exp(-2)), rel=0.04)
    for _ in range(500):  # held by a wall
        force, integral = robot_base.push(robot, integral, AHEAD, (0.0,) * 3, (1.0, 0.0), dt, np)
    assert force[0] == pytest.approx(200.0)
    assert abs(integral[0]) < 2 * 200.0


WEIGHT = 0.3 * 20 * GRAVITY  # [N] that it takes to slide the box under S1: 58.9


@pytest.mark.parametrize("engine", ["fused", "mujoco"])
def test_a_base_stalls_if_its_force_cannot_slide_the_object(engine):
    strong, weak = (push_object(engine, Robot(force_max=f * WEIGHT), 4.0) for f in (1.1, 0.9))
    assert strong.qvel[-1, 0] == pytest.approx(0.05, rel=0.01)
    assert abs(weak.qvel[-1, 0]) < 6e-3  # MuJoCo's friction creeps
    assert strong.qpos[-1, JOINTS.object][0] - weak.qpos[-1, JOINTS.object][0] > 0.1


def test_a_base_has_no_droop_under_load_by_integral_action_and_pushes_as_far_if_larger():
    larger = Robot(half_length=0.48, half_width=0.3965, mass=100.0, force_max=400.0)
    assert larger.inertia == pytest.approx(100 * (0.48**2 + 0.3965**2) / 3)
    for robot, rel in ((Robot(force_max=400.0), 1e-3), (larger, 1e-2)):
        velocity = push_object("fused", robot, 4.0).qvel[-1, 0]
        assert velocity == pytest.approx(0.05, rel=rel)


@pytest.mark.slow
def test_engines_agree_on_a_small_base_that_contact_slows():
    push = partial(push_object, seconds=3.0, twist=(0.05, 0.01, 0.15))
    ideal = Robot(half_length=0.5, half_width=0.12)
    # Nearer to the 59 N of friction it almost stalls, and the time step matters, too.
    weak = replace(ideal, mass=60.0, force_max=70.0, torque_max=5.0)
    qpos = {name: push(name, weak).qpos[-1] for name in ("fused", "mujoco", "mjx")}
    for name in ("fused", "mjx"):
        assert_allclose(qpos[name], qpos["mujoco"], atol=1e-3, err_msg=name)
    assert np.abs(push("fused", ideal).qpos[-1] - qpos["fused"])[:6].max() > 0.01  # it did slow


def test_a_strong_base_is_as_good_as_a_velocity_source():
    push = partial(push_object, "fused", seconds=3.0, twist=(0.05, 0.02, 0.0))
    strong, source = push(Robot(mass=2000.0, force_max=1e5)), push(Robot())
    assert_allclose(strong.qpos[-1], source.qpos[-1], atol=4e-3)


TEMPLATES = [*product(("real", "wide"), ("fused", "mjx")), ("wide", "quasistatic")]


@pytest.mark.parametrize(("domain", "engine"), TEMPLATES)
def test_worlds_by_template_equal_recompiled_ones(domain, engine):
    """Bases differ in size, and those with a limited force in mass."""
    drawn = draws.draw(replace(DOMAINS[domain], objects=("random_box",)), 3, np.arange(3))
    bases = replace(
        drawn.robot, half_length=np.array([0.3, 0.4, 0.5]), half_width=np.array([0.2, 0.25, 0.4])
    )
    if bases.driven:
        bases = replace(bases, mass=np.array([60.0, 130.0, 200.0]))
    inputs = WorldInputs("box", drawn.solid, drawn.friction, STANDARD, bases)
    _, fields = engines.get(engine).stage(inputs)
    theirs = recompiled(engine, [scene.compile_row(inputs, i) for i in range(3)])
    for ours, compiled in zip(*map(jax.tree.leaves, (fields, theirs)), strict=True):
        assert_allclose(ours, compiled, rtol=2e-5, atol=2e-6)


# --- trials --------------------------------------------------------------------------------


def test_a_stalled_base_is_reported_in_the_outcome():
    weak, strong = (Robot(force_max=f * WEIGHT, lag=0.1) for f in (0.8, 3))
    setting = replace(SHORT, rules=Rules(horizon=20.0))
    outcome, _ = pushes.run([case((0.6, 0.0), robot=robot) for robot in (weak, strong)], setting)
    assert outcome.stalled.tolist() == [True, False]
    assert outcome.success.tolist() == [False, True]
    assert outcome.time[0] == pytest.approx(20.0)


def test_random_robots_are_drawn_last_and_change_no_other_draw():
    index = np.arange(0, 30, 3)
    wide, real = (draws.draw(DOMAINS[name], 5, index) for name in ("wide", "real"))
    limits = {x for x in domain.quantities_of("robot") if getattr(DOMAINS["real"], x) is not None}
    assert len(limits) == 4
    assert set(real.values) - set(wide.values) == limits
    rest = {name: values for name, values in real.values.items() if name not in limits}
    same(wide._replace(robot=None), real._replace(values=rest, robot=None))
    assert wide.robot.ideal
    assert real.robot.driven
    assert ((real.robot.force_max >= 150) & (real.robot.force_max <= 800)).all()
    assert real.robot.acceleration_max.shape == (10, 2)
    columns = draws.table(real)
    assert set(columns) - set(draws.table(wide)) == limits
    fixed = replace(DOMAINS["wide"], robot=ROBOTS["kairos"])
    again = draws.draw(fixed, 5, index).robot
    assert_array_equal(again.mass, 158.0)
    assert again.lag is None


def test_slips_are_drawn_apart_and_by_columns_of_their_own():
    index = np.arange(4)
    slip = Range(0, 0.9)
    yaw_alone = replace(DOMAINS["wide"], robot_slip_yaw=slip, objects=("random_box",))
    all_three = replace(yaw_alone, robot_slip=slip, robot_slip_sideways=slip)
    drawn = draws.draw(all_three, 5, index)
    names = ("robot_slip", "robot_slip_sideways", "robot_slip_yaw")
    columns = draws.table(drawn)
    assert len({columns[name][0].tobytes() for name in names}) == 3
    assert {columns[name][1] for name in names} == {"1"}
    turning = draws.draw(yaw_alone, 5, index)
    same(drawn.robot.slip_yaw, turning.robot.slip_yaw)
    assert set(draws.table(turning)) & set(names) == {"robot_slip_yaw"}
    assert len({domain.LABELS[name] for name in names}) == 3
    assert set(names) <= set(fit.coordinates(all_three))


def test_a_domain_with_robots_survives_a_json_round_trip():
    slip = Range(0.1, 0.45)
    slips = replace(DOMAINS["wide"], robot_slip=slip, robot_slip_sideways=slip, robot_slip_yaw=slip)
    rollers = Robot(slip=0.05, slip_sideways=0.2, slip_yaw=0.45)
    domains = DOMAINS["real"], replace(DOMAINS["wide"], robot=ROBOTS["mpo_500"]), slips
    for expected in (*domains, replace(slips, robot=rollers)):
        assert domain.from_json(json.loads(json.dumps(asdict(expected)))) == expected


def test_robots_are_named_in_the_library_and_in_files(tmp_path):
    assert parse_robot("kairos") == ROBOTS["kairos"]
    path = tmp_path / "mine.json"
    path.write_text('{"mass": 50, "force_max": 120, "acceleration_max": [0.5, 1]}')
    mine = parse_robot(str(path))
    assert mine == Robot(mass=50, force_max=120, acceleration_max=(0.5, 1))
    drums = replace(DOMAINS["real"], objects=("random_cylinder",), robot_force=None)
    setting = setting_of(1.0, "fused")
    rows = rps_jax.sweep("rps", drums, worlds=3, robot=mine, setting=setting)
    assert np.unique(rows.robot_force) == 120
    assert "stalled" in rows


def test_commands_refuse_unsupported_robots(capsys, tmp_path):
    assert "did you mean 'kairos'" in refusal(capsys, "push", "--robot", "kairo")
    for words in ("table --robot kairos", "sweep --domain real"):
        unsupported = (*words.split(), "--engine", "quasistatic", "--out", tmp_path / "run")
        message = refusal(capsys, *unsupported)
        assert "engine = quasistatic is not allowed: a robot with a limited force" in message


def test_an_ideal_robot_equals_the_default_base():
    setting = Setting(physics=SHORT.physics, rules=Rules(horizon=3.0), engine="fused")
    run = lambda **options: pushes.run([case((1.0, 0.5), **options)], setting)[0]  # noqa: E731
    same(run(), run(robot=ROBOTS["ideal"]))
    assert pushes.build([case((1.0, 0.5))], setting).worlds.robot is None
