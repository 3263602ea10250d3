"""Trials: rules that end them, independence of worlds, and a short push."""

from dataclasses import replace
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import advance

from rps_jax import errors
from rps_jax.control.laws.rps import RPSParams
from rps_jax.engines.base import Driven
from rps_jax.robot.robot import Robot
from rps_jax.robot.skin import CapacitiveSkin
from rps_jax.trials import batch, pushes, trial
from rps_jax.trials.pushes import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Rules, Shift
from rps_jax.world.physics import preset
from rps_jax.world.scene import FRICTION

NEAR = (0.7, 0.0)  # [m] 0.32 m ahead of the front face
AHEAD = (2.0, 0.0)
SLOTS = 4
FUSED = Setting(engine="fused")  # compiles fast; the rules are independent of the engine
SHORT = replace(FUSED, rules=Rules(horizon=24.0, max_lost=5.0))


def case(target=NEAR, name="box", friction="S1", **changes):
    world = {k: changes.pop(k) for k in list(changes) if k in Case.__dataclass_fields__}
    params = RPSParams.paper()._replace(**changes)
    return Case(name, FRICTION[friction], target, params, **world)


CASES = [
    case(),
    case(friction="S2"),
    case(AHEAD),
    case((0.7, 0.25), name="nonuniform_box"),
    case((0.55, -0.2), d_th=0.1),
    case(name="nonuniform_box", v_max=0.02),
    case((1.5, 1.5), reactive=0.0),
]


@pytest.fixture(scope="module")
def outcomes():
    """Seven trials through four slots: three slots are refilled while their neighbours run."""
    outcome, timing = pushes.run(CASES, SHORT, slots=SLOTS, workers=1)
    assert timing.run > 0
    return outcome


def test_a_short_push_reaches_a_near_target(outcomes):
    assert outcomes.success[:2].all()
    assert (outcomes.min_distance[:2] < 0.05).all()
    # 2 s of approach, then 0.32 m: at 0.05 m/s, slower below 0.5 m by K_v: some 10 ln(.32/.05) s.
    assert (outcomes.time[:2] > 15).all()
    assert (outcomes.time[:2] < 24).all()


def test_rare_termination_checks_on_a_gpu_do_not_change_results(monkeypatch):
    """Trace 40 steps for the GPU; some trials reach their horizon within them."""
    setting = Setting(engine="quasistatic")
    _, worlds, stage, params = pushes.build([case(), case(AHEAD)], setting)
    start = trial.start_all(worlds, params, np.ones(2, bool))

    def run(backend):
        monkeypatch.setattr(jax, "default_backend", lambda: backend)
        program = jax.jit(partial(advance.__wrapped__, steps=40))
        loops = [ControlLoop(setting.physics, Rules(horizon=t)) for t in (0.29, 300.0)]
        return [program(stage, worlds, params, start, loop) for loop in loops]

    ended, running = seldom = run("gpu")
    assert ended.done.all()
    assert not running.done.any()
    assert ended.steps.tolist() == [15, 15]
    assert running.steps.tolist() == [40, 40]
    chex.assert_trees_all_close(seldom, run("cpu"), atol=1e-6)


@pytest.mark.parametrize("limit", [1, 3, SLOTS])
def test_suspended_trials_end_alike_in_merged_batches(monkeypatch, limit):
    """Merged batches of a GPU: two shape families, and at most 1, 3 or all trials suspended."""
    rules = Rules(horizon=60.0)
    cases = [case((0.6 + 0.05 * k, 0.05 * k)) for k in range(6)] + [case(AHEAD)]
    cases += [case((0.6, 0.1 * k), name="cylinder") for k in range(3)]
    alone, _ = pushes.run(cases, replace(FUSED, rules=rules), slots=SLOTS, workers=1)
    ran, plain = [], batch._Program.compiled
    monkeypatch.setattr(batch, "_max_suspended", lambda: limit)
    monkeypatch.setattr(
        batch._Program, "compiled", lambda self: ran.append(self.slots) or plain(self)
    )
    results, _ = pushes.run(cases, replace(FUSED, rules=rules), slots=SLOTS, workers=2)
    assert len(ran[-1]) == 2
    assert alone.success.sum() > 0
    for name in ("success", "time"):
        np.testing.assert_array_equal(getattr(results, name), getattr(alone, name))
    np.testing.assert_allclose(results.object_pose, alone.object_pose, atol=1e-3)  # other shapes


def test_yaw_is_unbounded_and_position_is_bounded():
    part = pushes.build([case()], FUSED)
    state = trial.start(*jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], part[1::2]))
    for i, value, diverges in ((2, 500.0, False), (2, np.nan, True), (0, 101.0, True)):
        driven = Driven(trial.motion(state)._replace(qpos=state.qpos.at[i].set(value)))
        assert bool(trial.settle(state, state, driven).diverged) == diverges


def test_a_shove_happens_once_however_its_time_is_rounded():
    part = pushes.build([case()], FUSED)
    world, params = jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], part[1::2])
    start = trial.start(world, params)
    x = trial.JOINTS.object.start

    def moved(time, period, steps):
        shoved = world._replace(shift=Shift(time, jnp.array([0.1, 0.0])))
        result = trial.shifted(shoved, start._replace(steps=steps), period)
        return result.qpos[x] - start.qpos[x]

    moved_by_all = jax.jit(
        jax.vmap(jax.vmap(moved, (None, None, 0)), (0, None, None)), static_argnums=1
    )
    times = np.concatenate([np.arange(0, 10, 0.01), [np.inf]]).astype(np.float32)
    for period in (0.005, 0.02, 0.05):
        total = np.asarray(moved_by_all(times, period, np.arange(2100))).sum(axis=1)
        np.testing.assert_allclose(total[:-1], 0.1, atol=1e-4)
        assert total[-1] == 0


def test_a_far_target_is_not_reached_in_time(outcomes):
    assert not outcomes.success[2]
    assert outcomes.time[2] == pytest.approx(24.0)
    assert 0.05 < outcomes.min_distance[2] < 1.62


def test_a_trial_is_bit_identical_alone_or_among_others(outcomes):
    for index in (1, 3, 5):
        alone, _ = pushes.run([CASES[index]] * SLOTS, SHORT, slots=SLOTS, workers=1)
        for slot in range(SLOTS):
            for name in outcomes._fields:
                np.testing.assert_array_equal(
                    getattr(alone, name)[slot], getattr(outcomes, name)[index], err_msg=name
                )


def test_contact_lost_for_too_long_ends_a_trial(outcomes):
    # Without reaction the box slides off the turning base, which creeps ahead without it.
    lost = case((0.2, 2.0), reactive=0.0)
    rules = Rules(horizon=60.0, max_lost=5.0)
    outcome, _ = pushes.run([lost] * SLOTS, replace(FUSED, rules=rules), slots=SLOTS, workers=1)
    assert not outcome.success.any()
    assert outcome.contact_lost_time[0] == pytest.approx(5.0, abs=0.03)
    assert outcome.time[0] < 60.0


def world_batch(count):
    _, worlds, stage, params = pushes.build([case()] * count, FUSED)
    return stage, *jax.device_put((worlds, params))


@pytest.fixture(scope="module")
def advanced():
    """Trials after 0.4 s: four valid worlds, and the same with a NaN object in one."""
    stage, worlds, params = world_batch(SLOTS)
    broken = worlds._replace(qpos=worlds.qpos.at[1, 4].set(jnp.nan))
    live = jnp.ones(SLOTS, bool)

    def run(subset):
        trials = trial.start_all(subset, params, live)
        return advance(stage, subset, params, trials, ControlLoop(preset()), 20)

    return run(worlds), run(broken)


def test_a_diverged_world_freezes_and_others_are_unchanged_bit_for_bit(advanced):
    healthy, mixed = advanced
    np.testing.assert_array_equal(mixed.diverged, [False, True, False, False])
    assert mixed.steps[1] == 0
    assert mixed.done[1]
    for slot in (0, 2, 3):
        np.testing.assert_array_equal(mixed.qpos[slot], healthy.qpos[slot])
        np.testing.assert_array_equal(mixed.qvel[slot], healthy.qvel[slot])
    assert (np.asarray(healthy.steps) == 20).all()


def test_an_object_that_tilts_too_far_ends_its_trial():
    _, worlds, params = world_batch(SLOTS)
    half = np.radians([0.0, 44.0, 46.0, -120.0]) / 2  # about the object's x axis
    qpos = worlds.qpos.at[:, 6].set(np.cos(half)).at[:, 7].set(np.sin(half))
    worlds = worlds._replace(qpos=qpos)
    trials = trial.start_all(worlds, params, jnp.ones(SLOTS, bool))

    def observed(**rules):
        loop = trial.ControlLoop(preset(), **rules)
        return jax.vmap(lambda *arrays: trial.observe(*arrays, loop)[0])(worlds, params, trials)

    ended = observed()
    assert ended.tipped.tolist() == ended.done.tolist() == [False, False, True, True]
    np.testing.assert_array_equal(ended.tipped, ended.tilt > Rules().max_tilt)
    assert not ended.success.any()
    assert not observed(rules=Rules(max_tilt=3)).tipped.any()


def test_the_path_length_of_the_base_is_its_speed_times_time(outcomes, advanced):
    # 0.4 s at 1 cm/s before the first touch; then at no more than v_max.
    np.testing.assert_allclose(advanced[0].path_length, 0.004, rtol=1e-3)
    ahead = outcomes.base_pose[2, :2]
    assert outcomes.path_length[2] == pytest.approx(float(np.hypot(*ahead)), rel=0.01)
    assert (outcomes.path_length <= 0.05 * outcomes.time).all()


def test_padding_never_moves_and_a_finished_batch_stops_at_once():
    stage, worlds, params = world_batch(SLOTS)
    trials = trial.start_all(worlds, params, jnp.zeros(SLOTS, bool))
    stepped = advance(stage, worlds, params, trials, ControlLoop(preset()), 20)
    np.testing.assert_array_equal(stepped.qpos, worlds.qpos)
    assert (np.asarray(stepped.steps) == 0).all()


def test_before_the_first_touch_the_base_creeps_without_lost_contact(advanced):
    healthy, _ = advanced
    assert float(healthy.qpos[0, 0]) == pytest.approx(0.4 * 0.01, rel=1e-4)
    assert int(healthy.lost_steps[0]) == 0
    assert np.isinf(healthy.min_distance[0])


@pytest.mark.parametrize("engine", ["fused", "mujoco"])
def test_the_trace_of_a_trial_agrees_with_its_outcome(engine):
    setting = replace(FUSED, engine=engine, rules=Rules(horizon=24.0))
    (trace,) = pushes.record_cases([case(skin=CapacitiveSkin())], setting, interval=0.1)
    snapshots, outcome = trace.snapshots, trace.outcome
    assert outcome.success
    assert np.allclose(np.diff(snapshots.time), 0.1, atol=1e-4)
    assert outcome.time == pytest.approx(snapshots.time[-1], abs=0.1)
    touching = snapshots.reading.contact_type > 0
    assert snapshots.details.distance[touching].min() == pytest.approx(
        outcome.min_distance, abs=0.002
    )
    speed = np.hypot(snapshots.twist.v_x, snapshots.twist.v_y)
    assert speed.max() <= 0.05 * (1 + 1e-5)
    # The base is where its commanded twist takes it.
    travelled = np.trapezoid(snapshots.twist.v_x, snapshots.time)
    assert snapshots.qpos[-1, 0] == pytest.approx(travelled, abs=0.005)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"target": (float("nan"), 0.0)}, "target x"),
        ({"target": (0.1, 0.1)}, "outside the robot"),
        ({"name": "chair"}, "object"),
        ({"k": float("inf")}, "k"),
        ({"v_max": -0.05}, "v_max"),
        ({"gap": -0.1}, "gap"),
        ({"rear": "left"}, "rear"),
        ({"skin": CapacitiveSkin(noise=-1.0)}, "noise"),
        ({"robot": Robot(half_length=0.0)}, "half_length"),
        ({"bearing": float("nan")}, "bearing"),
        ({"shift": Shift(float("nan"))}, "shift time"),
        ({"shift": Shift(3.0, (0.0, float("inf")))}, "shift y"),
    ],
)
def test_an_invalid_case_is_refused(changes, field):
    with pytest.raises(errors.InputError, match=field):
        case(**changes)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Setting(rules=Rules(horizon=0.0), engine="mjx"), "horizon"),
        (lambda: Setting(rules=Rules(max_lost=float("nan")), engine="mjx"), "max_lost"),
        (lambda: Setting(engine="ode"), "engine"),
        (lambda: Setting(seed=-1, engine="mjx"), "seed"),
    ],
)
def test_invalid_settings_are_refused(make, field):
    with pytest.raises(errors.InputError, match=field):
        make()
