"""The contact's force in the engines, and the readings of a load cell."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import refusals, setting_of, slow
from numpy.testing import assert_allclose, assert_array_equal
from staging import push_object, staged

from rps_jax.control import registry
from rps_jax.control.laws.force_push_published import PublishedForcePushParams
from rps_jax.control.observation import Twist
from rps_jax.engines.base import ControlPeriod, Motion
from rps_jax.geometry.solid import GRAVITY
from rps_jax.robot.base import LoadCell, init_load
from rps_jax.robot.robot import Robot
from rps_jax.trials import pushes, trial
from rps_jax.trials.pushes import Case
from rps_jax.trials.setting import Setting
from rps_jax.world import scene
from rps_jax.world.physics import Physics
from rps_jax.world.scene import FRICTION, JOINTS, Friction

STANDARD = Physics()
TURNING = (0.05, 0.01, 0.05)  # [m/s, m/s, rad/s]
WEIGHT = 20 * GRAVITY  # [N] of the box
S1, SLIPPERY = FRICTION["S1"], Friction(1e-4, 0.35)


@pytest.mark.parametrize("engine", ["fused", slow("mjx"), "mujoco"])
def test_a_box_pushed_straight_ahead_pushes_back_with_the_friction_of_its_weight(engine):
    """They agree within some per cent: MuJoCo's soft friction lifts a sliding object."""
    steady = push_object(engine).force[50:].mean(axis=0)
    assert_allclose(steady, (-0.3 * WEIGHT, 0.0, 0.0), atol=0.08 * 0.3 * WEIGHT)


def test_a_base_of_limited_force_feels_the_object_and_not_its_own_drive():
    strong = Robot(force_max=400.0)
    for engine in ("fused", "mujoco"):
        force = push_object(engine, strong).force
        assert_allclose(force[50:].mean(axis=0)[0], -0.3 * WEIGHT, rtol=0.08)


@pytest.mark.parametrize("engine", ["fused", "mujoco"])
def test_on_ground_without_friction_a_push_is_the_momentum_that_the_box_gains(engine):
    """Newton's third law: the impulse on the base is minus m v; at constant speed, nothing.

    What friction there is, of 1e-4, takes 2 % of it.
    """
    _, qvel, force = push_object(engine, friction=SLIPPERY)
    impulse = force.sum(axis=0) * STANDARD.control_period
    gained = 20.0 * qvel[-1][JOINTS.object.start]
    assert gained > 0.9 * 20 * 0.05
    expected = gained + 1e-4 * WEIGHT * 2.0
    assert_allclose(impulse[:2], (-expected, 0.0), atol=0.003 * gained)
    assert_allclose(force[-20:], 0.0, atol=1e-3)


def test_the_fused_engine_tells_the_force_of_c_mujoco():
    """Over a push of a corner that turns, step by step and in the mean."""
    start = {"yaw": 0.3, "lateral": 0.05}
    fused, mujoco = (push_object(x, twist=TURNING, **start) for x in ("fused", "mujoco"))
    assert_allclose(fused.qpos[-1], mujoco.qpos[-1], atol=2e-3)
    force, expected = (recording.force[25:].mean(axis=0) for recording in (fused, mujoco))
    size = np.hypot(*expected[:2])
    assert size > 20
    assert_allclose(force, expected, atol=0.1 * size)


def test_force_is_computed_only_on_request():
    at = scene.load("box", STANDARD, S1)
    stage, fields = staged("fused", [at], STANDARD)
    still = jnp.zeros((1, 9))
    motion = Motion(jnp.asarray(scene.initial_qpos(at)[None], float), still, still)
    fields = jax.tree.map(lambda x: jnp.asarray(x, float), fields)
    twists = Twist(*(jnp.zeros(1),) * 3)

    def program(force):
        period = ControlPeriod(twists, STANDARD, force=force)
        return jax.make_jaxpr(lambda m: stage.drive(fields, m, period))(motion)

    assert len(program(False).out_avals) == 3
    assert len(program(True).out_avals) == 4


def read_cell(cell, forces, period=0.02):
    key, load = jnp.array([1, 2], jnp.uint32), init_load(jnp.zeros(1))
    readings = []
    for i, force in enumerate(forces):
        load = load._replace(wrench=jnp.array([*force, 0.0]))
        load, reading = cell.read(load, key, jnp.asarray(i), period)
        readings.append(reading)
    return np.array(readings)


def test_a_load_cell_follows_a_step_and_reads_zero_below_its_threshold():
    readings = read_cell(LoadCell(noise=0.0, threshold=0.0), [(-30.0, 10.0)] * 5)
    share = 1 - np.exp(-0.02 * np.arange(1, 21) / 0.05)[:, None]
    assert_allclose(readings, share[:5] * (-30.0, 10.0), rtol=1e-5)
    readings = read_cell(LoadCell(noise=0.0, threshold=5.0), [(-3.0, 4.2)] * 20)
    size = np.hypot(*(share * (-3.0, 4.2)).T)
    assert_array_equal(np.hypot(*readings.T) > 0, size >= 5)
    assert 0 < np.count_nonzero(readings[:, 0]) < 20


def test_the_noise_of_a_load_cell_is_filtered_too():
    """A low-pass filter of share a reduces white noise of 1 N to sqrt(a / (2 - a)) N."""
    cell = LoadCell(noise=1.0, threshold=0.0)
    period, count = 0.02, 400
    readings = read_cell(cell, [(0.0, 0.0)] * count, period)[20:]
    share = 1 - np.exp(-period / cell.time_constant)
    assert_allclose(readings.std(axis=0), np.sqrt(share / (2 - share)), rtol=0.2)
    assert abs(np.corrcoef(readings.T)[0, 1]) < 0.6  # five standard errors


test_a_load_cell_refuses_invalid_parameters = refusals(
    lambda **changes: LoadCell(**changes).check(),
    *(({name: -1.0}, name) for name in ("noise", "time_constant", "threshold")),
)


@pytest.mark.parametrize("engine", ["fused", slow("mujoco")])
def test_a_law_observes_the_force_of_its_push(engine):
    """Straight ahead, the law reads the force that slides a box of 10 kg."""
    gains = PublishedForcePushParams(k_theta=-1.0, k_y=0.0)
    case = Case("box", FRICTION["S1"], (1.6, 0.0), gains, gap=0.0, mass=10.0)
    setting = setting_of(4.0, engine)
    if engine == "mujoco":
        outcome, _ = pushes.run([case], setting, workers=1)
        assert outcome.base_pose[0][0] == pytest.approx(0.2, rel=0.1)  # 0.05 m/s: it was felt
        return
    _, worlds, stage, params = pushes.build([case], setting)
    law = registry.law_of(gains)
    trials = trial.start_all(worlds, params, np.ones(1, bool), law=law)
    loop = trial.ControlLoop(setting.physics, law=law)
    trials, _ = jax.jit(trial.unroll, static_argnames="steps")(
        stage, worlds, params, trials, loop, steps=200
    )
    assert_allclose(trials.load.wrench[0, 0], -0.3 * 10 * GRAVITY, rtol=0.1)
    assert_allclose(trials.load.signal[0, 0], -0.3 * 10 * GRAVITY, rtol=0.1)


test_engines_that_tell_no_force_refuse_laws_that_ask_for_it = refusals(
    lambda params: pushes.build([Case("box", S1, (2.0, 0.0), params)], Setting("quasistatic")),
    ((PublishedForcePushParams(),), "engine = quasistatic is not allowed: it computes no"),
)
