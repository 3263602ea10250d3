"""Trials: rules that end them, independence of worlds, and a short push."""

from dataclasses import replace
from functools import partial
from itertools import pairwise

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from helpers import advance, case, jitted, slow
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax.analysis import statistics
from rps_jax.engines.base import Driven
from rps_jax.robot.skin import CapacitiveSkin
from rps_jax.trials import batch, law_check, pushes, trial
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Rules, Shift
from rps_jax.world.physics import preset

NEAR = (0.7, 0.0)  # [m] 0.32 m ahead of the front face
AHEAD = (2.0, 0.0)
SLOTS = 4
FUSED = Setting(engine="fused")  # compiles fast; the rules are independent of the engine
SHORT = replace(FUSED, rules=Rules(horizon=24.0, max_lost=5.0))


def run(cases, rules=SHORT.rules, **options):
    """Return the outcomes of cases in the fused engine, by default in few slots of one thread."""
    setting = replace(FUSED, rules=rules)
    options = {"slots": SLOTS, "workers": 1} | options
    outcome, timing = pushes.run(cases, setting, **options)
    assert timing.run > 0
    return outcome


CASES = [
    case(NEAR),
    case(NEAR, friction="S2"),
    case(AHEAD),
    case((0.7, 0.25), name="nonuniform_box"),
    case((0.55, -0.2), d_th=0.1),
    case(NEAR, name="nonuniform_box", v_max=0.02),
    case((1.5, 1.5), reactive=0.0),
]


@pytest.fixture(scope="module")
def outcomes():
    """Seven trials through four slots: three slots are refilled while their neighbours run."""
    return run(CASES)


def test_a_short_push_reaches_a_near_target_and_a_far_one_is_not_reached_in_time(outcomes):
    success, time, distance = outcomes.success, outcomes.time, outcomes.min_distance
    assert success[:3].tolist() == [True, True, False]
    assert (distance[:2] < 0.05).all()
    # 2 s of approach, then 0.32 m: at 0.05 m/s, slower below 0.5 m by K_v: some 10 ln(.32/.05) s.
    assert ((time[:2] > 15) & (time[:2] < 24)).all()
    assert time[2] == pytest.approx(24.0)
    assert 0.05 < distance[2] < 1.62


def test_rare_termination_checks_on_a_gpu_do_not_change_results(monkeypatch):
    """Trace 37 steps for the GPU, which runs more at once; some trials end within them."""
    setting = Setting(engine="quasistatic")
    _, worlds, stage, params = pushes.build([case(NEAR), case(AHEAD)], setting)
    start = trial.start_all(worlds, params, np.ones(2, bool))

    def run(backend):
        monkeypatch.setattr(jax, "default_backend", lambda: backend)
        program = jax.jit(partial(advance.__wrapped__, steps=37))
        loops = [ControlLoop(setting.physics, Rules(horizon=t)) for t in (0.29, 300.0)]
        return [program(stage, worlds, params, start, loop) for loop in loops]

    ended, running = seldom = run("gpu")
    assert ended.done.all()
    assert not running.done.any()
    assert ended.steps.tolist() == [15, 15]
    assert running.steps.tolist() == [37, 37]
    chex.assert_trees_all_equal(seldom, run("cpu"))


# Two shape families, side by side in a merged batch of a GPU.
FAMILIES = [case((0.6 + 0.05 * k, 0.05 * k)) for k in range(6)] + [case(AHEAD)]
FAMILIES += [case((0.6, 0.1 * k), name="cylinder") for k in range(3)]


@pytest.fixture(scope="module")
def sequential():
    """Outcomes of both families, one after the other."""
    return run(FAMILIES)


@pytest.mark.parametrize("tail_slots", [slow(1), 3, SLOTS])
def test_trials_end_alike_in_the_merged_batches_of_a_gpu(monkeypatch, sequential, tail_slots):
    """The last trials in 1, 3 or as many slots as before."""
    segments, ran, plain = [], [], batch._Program.compiled
    monkeypatch.setattr(batch, "_tail_slots", lambda: tail_slots)
    note = lambda self, device: ran.append(self.slots) or plain(self, device)  # noqa: E731
    monkeypatch.setattr(batch._Program, "compiled", note)
    results = run(FAMILIES, callback=lambda progress: segments.append(progress.segment))
    assert ran[0] == (SLOTS, 3)
    # None is left to a last slot alone.
    assert ran[1:] == ([(3, 3)] if tail_slots == 3 else [])
    segments = [x for x in segments if x is not None]
    assert all(x.start < x.end <= y.end and x.end <= y.start for x, y in pairwise(segments))
    assert segments[0].live == {0: SLOTS, 1: 3}
    assert sequential.success.sum() > 0
    for name in ("success", "time"):
        assert_array_equal(getattr(results, name), getattr(sequential, name))
    # Programs of other shapes round otherwise.
    assert_allclose(results.object_pose, sequential.object_pose, atol=1e-3)


@pytest.fixture(scope="module")
def single():
    """World and parameters of one trial."""
    part = pushes.build([case(NEAR)], FUSED)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), part[1::2])


def test_yaw_is_unbounded_and_position_is_bounded(single):
    state = trial.start(*single)
    for i, value, diverges in ((2, 500.0, False), (2, np.nan, True), (0, 101.0, True)):
        driven = Driven(trial.motion(state)._replace(qpos=state.qpos.at[i].set(value)))
        assert bool(trial.settle(single[0], state, state, driven).diverged) == diverges


def test_a_shove_happens_once_however_its_time_is_rounded(single):
    world, start, x = single[0], trial.start(*single), trial.JOINTS.object.start

    def moved(time, period, steps):
        shoved = world._replace(shift=Shift(time, jnp.array([0.1, 0.0])))
        result = trial.shifted(shoved, start._replace(steps=steps), period)
        return result.qpos[x] - start.qpos[x]

    moved_by_all = jax.vmap(jax.vmap(moved, (None, None, 0)), (0, None, None))
    moved_by_all = jax.jit(moved_by_all, static_argnums=1)
    times = np.concatenate([np.arange(0, 10, 0.01), [np.inf]]).astype(np.float32)
    for period in (0.005, 0.02, 0.05):
        total = np.asarray(moved_by_all(times, period, np.arange(2100))).sum(axis=1)
        assert_allclose(total[:-1], 0.1, atol=1e-4)
        assert total[-1] == 0


def test_a_trial_is_bit_identical_alone_or_among_others(outcomes):
    for index in (1, 3, 5):
        alone = run([CASES[index]] * SLOTS)
        expected = jax.tree.map(lambda leaf, index=index: np.stack([leaf[index]] * SLOTS), outcomes)
        jax.tree.map(assert_array_equal, alone, expected)


def test_a_law_of_the_package_is_not_compared_with_xla(outcomes, monkeypatch):
    monkeypatch.setattr(law_check, "warn_of_difference", None)
    assert run([CASES[0]] * SLOTS).success.all()


def test_contact_lost_for_too_long_ends_a_trial(outcomes):
    # Without reaction the box slides off the turning base, which creeps ahead without it.
    lost = case((0.2, 2.0), reactive=0.0)
    outcome = run([lost] * SLOTS, Rules(horizon=60.0, max_lost=5.0))
    assert not outcome.success.any()
    assert outcome.contact_lost_time[0] == pytest.approx(5.01, abs=0.05)  # after 5 s
    assert outcome.time[0] < 60.0


def test_a_contact_on_dead_taxels_is_no_lost_contact(outcomes):
    dead = replace(case((1.0, 0.0)), skin=CapacitiveSkin(dead_share=1.0))
    results = run([dead] * SLOTS, Rules(horizon=20.0))
    assert results.unfelt.all()
    assert np.isinf(results.min_distance).all()
    columns = {k: ("world", v) for k, v in results.columns().items() if np.ndim(v) == 1}
    modes = statistics.failure_modes(xr.Dataset(columns), 150.0)
    assert {statistics.modes()[mode] for mode in modes.tolist()} == {"contact not felt"}
    assert not outcomes.unfelt.any()
    # After 5 s without contact a trial ends, and the base stands against the object or not.
    _, worlds, params = world_batch(2)
    trials = jitted(trial.start_all)(worlds, params, np.ones(2, bool))
    counts = {"contact_steps": np.ones(2, int), "lost_steps": np.full(2, 251)}
    ahead = results.object_pose[0, 0] - results.base_pose[0, 0]  # [m] of an object that is pushed
    qpos = np.array(trials.qpos)
    qpos[:, 3] = qpos[:, 0] + ahead + np.array([0.0, 0.1])
    ended = trials._replace(done=np.ones(2, bool), qpos=qpos, **counts)
    loop = ControlLoop(FUSED.physics, Rules(max_lost=5.0))
    assert trial.compiled_outcome(ended, worlds, loop).unfelt.tolist() == [True, False]
    felt = ended._replace(lost_steps=np.full(2, 249))
    assert not np.any(trial.compiled_outcome(felt, worlds, loop).unfelt)


def world_batch(count):
    _, worlds, stage, params = pushes.build([case(NEAR)] * count, FUSED)
    return stage, *jax.device_put((worlds, params))


@pytest.fixture(scope="module")
def advanced():
    """Trials after 0.4 s: valid worlds, the same with a NaN object in one, and all padding."""
    stage, worlds, params = world_batch(SLOTS)
    broken = worlds._replace(qpos=worlds.qpos.at[1, 4].set(jnp.nan))

    def run(subset, live):
        trials = jax.jit(trial.start_all)(subset, params, np.full(SLOTS, live))
        return advance(stage, subset, params, trials, ControlLoop(preset()), 20)

    return run(worlds, True), run(broken, True), run(worlds, False)


def test_a_diverged_world_freezes_and_others_are_unchanged_bit_for_bit(advanced):
    healthy, mixed, _ = advanced
    assert_array_equal(mixed.diverged, [False, True, False, False])
    assert mixed.steps[1] == 0
    assert mixed.done[1]
    rest = np.array([0, 2, 3])
    assert_array_equal(mixed.qpos[rest], healthy.qpos[rest])
    assert_array_equal(mixed.qvel[rest], healthy.qvel[rest])
    assert (np.asarray(healthy.steps) == 20).all()


def test_an_object_that_tilts_too_far_ends_its_trial():
    _, worlds, params = world_batch(SLOTS)
    half = np.radians([0.0, 44.0, 46.0, -120.0]) / 2  # about the object's x axis
    qpos = np.array(worlds.qpos)
    qpos[:, 6], qpos[:, 7] = np.cos(half), np.sin(half)
    worlds = worlds._replace(qpos=qpos)
    trials = jitted(trial.start_all)(worlds, params, jnp.ones(SLOTS, bool))

    def observed(**rules):
        loop = ControlLoop(preset(), **rules)
        observe = jax.vmap(lambda *arrays: trial.observe(*arrays, loop)[0])
        return jitted(observe)(worlds, params, trials)

    ended = observed()
    assert ended.tipped.tolist() == ended.done.tolist() == [False, False, True, True]
    assert_array_equal(ended.tipped, ended.tilt > Rules().max_tilt)
    assert not ended.success.any()
    assert not observed(rules=Rules(max_tilt=3)).tipped.any()


def test_the_path_length_of_the_base_is_its_speed_times_time(outcomes):
    ahead = outcomes.base_pose[2, :2]
    assert outcomes.path_length[2] == pytest.approx(float(np.hypot(*ahead)), rel=0.01)
    assert (outcomes.path_length <= 0.05 * outcomes.time).all()


def test_padding_never_moves_and_a_finished_batch_stops_at_once(advanced):
    padded = advanced[2]
    assert_array_equal(padded.qpos, world_batch(SLOTS)[1].qpos)
    assert (np.asarray(padded.steps) == 0).all()


def test_before_the_first_touch_the_base_creeps_without_lost_contact(advanced):
    healthy, *_ = advanced  # 0.4 s at 1 cm/s
    assert_allclose(healthy.path_length, 0.004, rtol=1e-3)
    assert float(healthy.qpos[0, 0]) == pytest.approx(0.4 * 0.01, rel=1e-4)
    assert int(healthy.lost_steps[0]) == 0
    assert np.isinf(healthy.min_distance[0])


@pytest.mark.parametrize("engine", ["fused", slow("mujoco")])
def test_the_trace_of_a_trial_agrees_with_its_outcome(engine):
    setting = replace(FUSED, engine=engine, rules=Rules(horizon=24.0))
    worlds = pushes.build([case(NEAR, skin=CapacitiveSkin())], setting)
    (trace,) = pushes.record_batch(worlds, setting, interval=0.1)
    snapshots, outcome = trace.snapshots, trace.outcome
    assert outcome.success
    assert np.allclose(np.diff(snapshots.time), 0.1, atol=1e-4)
    assert outcome.time == pytest.approx(snapshots.time[-1], abs=0.2)
    touching = snapshots.reading.contact_type > 0
    nearest = snapshots.details.distance[touching].min()
    assert nearest == pytest.approx(outcome.min_distance, abs=0.002)
    speed = np.hypot(snapshots.twist.v_x, snapshots.twist.v_y)
    assert speed.max() <= 0.05 * (1 + 1e-5)
    # The base is where its commanded twist takes it.
    travelled = np.trapezoid(snapshots.twist.v_x, snapshots.time)
    assert snapshots.qpos[-1, 0] == pytest.approx(travelled, abs=0.005)
