"""Sweeps over random worlds: worlds are independent, and finished work is never lost."""

import errno
import gc
import json
import multiprocessing
import os
import random
import shutil
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from helpers import (
    BOXES,
    CYLINDERS,
    PAPER,
    PLAN,
    SHORT,
    SLOTS,
    one_sentence,
    parts_of,
    printed,
    refusal,
    refusing,
    row,
    rps,
    same,
    swept,
)
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax.analysis import statistics
from rps_jax.app.cli import running
from rps_jax.geometry import planar
from rps_jax.record import cache, files
from rps_jax.runs import sweep
from rps_jax.runs.plan import Shard, load_plan, open_run
from rps_jax.runs.results import PlanRequest, Results, store_chunk
from rps_jax.runs.sweep import merge
from rps_jax.trials import batch, trial
from rps_jax.trials.trial import Rules
from rps_jax.trials.worlds import Job, drawn_worlds
from rps_jax.world import domain, draws
from rps_jax.world.domain import LABELS, QUANTITIES, Range


def outcomes(parts, setting=SHORT):
    """Return the outcomes of trials by their indices."""
    by_index = {}

    def collect(indices, ended):
        for i, index in enumerate(indices):
            by_index[int(index)] = row(ended, i)

    job = Job("rps", sum(p.indices.size for p in parts), parts)
    batch.run([job], setting, slots=SLOTS, workers=1, collect=collect)
    return by_index


def worlds_of(index, domain=BOXES, params=PAPER):
    """Return worlds of a domain with the parameters of a law."""
    return drawn_worlds(domain, draws.draw(domain, 0, index), SHORT).with_params(params)


# Ranges of a base without errors.
PERFECT = {name: Range(0, 0) for name in domain.quantities_of("base")}


def merged(folders, out):
    """Return the results that the merge of some run folders writes."""
    merge(folders, out=out)
    return files.read_results(out)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An undisturbed run."""
    return swept(tmp_path_factory.mktemp("whole"))


def test_a_world_in_a_refilled_slot_ends_as_alone():
    """Bit for bit with a fixed number of slots, whatever shares the batch."""
    together = outcomes([worlds_of(np.arange(13)), worlds_of(np.arange(13, 20))])
    assert len(together) == 20
    assert len({float(x.time) for x in together.values()}) > 3  # they end at different times
    for index in (0, 9, 19):
        padded = worlds_of(np.full(SLOTS, index))  # a batch of one program, of this world alone
        alone = outcomes([padded._replace(indices=np.arange(SLOTS))])
        same(alone[0], together[index])


@pytest.mark.parametrize("error", ["pose_latency", "command_delay"])
def test_latency_of_poses_and_commands_is_exact(error):
    """While the base turns, sensed poses or applied commands lag n steps behind."""
    steps, period = 3, SHORT.physics.control_period
    late = replace(BOXES, **PERFECT | {error: Range(steps * period, steps * period)})
    part = worlds_of([0], late)
    inputs = row((part.worlds, part.params), 0)
    state = jax.tree.map(jnp.asarray, trial.start(*inputs))
    decide = jax.jit(partial(trial.decide, loop=trial.ControlLoop(SHORT.physics)))
    commanded, applied = [], []
    for step in range(8):
        state = state._replace(qpos=state.qpos.at[2].set(0.01 * step))  # turned by hand
        state, twist, snapshot = decide(*inputs, state)
        state = state._replace(steps=state.steps + 1)
        commanded.append([float(x) for x in snapshot.twist])
        applied.append([float(x) for x in twist])
    if error == "command_delay":
        assert_allclose(applied[steps:], commanded[:-steps], rtol=1e-6)
        assert_array_equal(applied[:steps], 0.0)
    else:
        assert_allclose(applied, commanded)
        change = np.abs(np.array(commanded) - commanded[0]).max(axis=1)
        assert not change[: steps + 1].any()  # nothing seen yet
        assert change[steps + 1] > 0


@pytest.mark.slow
def test_a_base_without_errors_is_perfect():
    perfect = replace(CYLINDERS, **PERFECT)
    assert worlds_of(np.arange(2)).worlds.odometry.past.shape[1] > 1
    part = worlds_of(np.arange(6), perfect)
    odometry = part.worlds.odometry
    assert odometry.past.shape == (6, 0)
    past = odometry._replace(past=np.zeros((6, 4), np.float32))
    remembered = part.worlds._replace(odometry=past)
    brief = replace(SHORT, rules=Rules(horizon=1.0))
    a, b = (outcomes([p], brief) for p in (part, part._replace(worlds=remembered)))
    for i in range(6):
        mine, theirs = a[i].columns(), b[i].columns()
        for name in mine:
            assert_allclose(mine[name], theirs[name], atol=1e-4, err_msg=name)


def test_flat_boxes_without_contact_do_not_move():
    """This holds for the long steps of `fast`; stiffer ground would shake the boxes away."""
    flat = replace(BOXES, size=Range(0.25, 0.35), height=Range(0.3, 0.4), gap=Range(0.05, 0.05))
    part = worlds_of(np.arange(SLOTS), flat, PAPER._replace(v_approach=0.0))
    ended = outcomes([part])
    pose = np.array([ended[i].object_pose for i in range(SLOTS)])
    assert np.abs(pose[:, :2] - part.worlds.qpos[:, 3:5]).max() < 2e-3  # in 20 s
    assert np.abs(pose[:, 2] - planar.yaw_of_quaternion(part.worlds.qpos[:, 6:])).max() < 0.01


@pytest.mark.slow
def test_a_faster_base_arrives_earlier():
    quick = replace(CYLINDERS, **PERFECT, gap=Range(0.05, 0.05))
    times = []
    for error in (-0.5, 0.0):
        part = worlds_of([1], replace(quick, velocity_error=Range(error, error)))
        times.append(outcomes([part])[1].base_pose[0])  # x at the end
    assert times[0] < 0.7 * times[1]


def runs_on_devices(folder, counts):
    """Sweep on some devices; return the number of programs not in the cache, and the segments.

    The first device waits until the others have run all trials but those in its slots. In the last
    run the others fail.
    """
    cache.use_cache(folder / "cache")
    devices, plain = jax.local_devices(), batch._SlotData.inputs.fget
    missing, segments, fails, rest_ended = [], {}, [], threading.Event()
    jax.monitoring.register_event_listener(lambda name, **_: missing.append(name))

    def inputs(self):
        if self._device is devices[0]:
            assert rest_ended.wait(60)
        elif fails:
            raise OSError("no memory")
        return plain(self)

    batch._SlotData.inputs = property(inputs)
    for count in counts:
        if count == "as on GPUs":  # which run a segment while the host reads another
            batch._tail_slots, count = lambda: SLOTS, 3
        batch._devices = lambda count=count: devices[:count]
        noted = segments.setdefault(count, [])

        def callback(progress, noted=noted):
            noted.append(progress.segment)
            if progress.finished >= PLAN.num_trials - SLOTS:
                rest_ended.set()

        rest_ended.clear() if count > 1 else rest_ended.set()
        swept(folder / str(count), workers=1, callback=callback)
    batch._devices = lambda: devices
    fails.append(True)
    with pytest.raises(OSError, match="no memory"):
        swept(folder / "failed", workers=1, callback=segments.setdefault("failed", []).append)
    shutil.rmtree(folder / "failed")
    return missing.count("/jax/compilation_cache/cache_misses"), segments


def test_several_devices_share_trials_and_programs(whole, tmp_path, monkeypatch):
    (tmp_path / "cache").mkdir()  # without programs of XLA
    (tmp_path / "cache" / "native").symlink_to(cache.default_folder() / "native")
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=3"
    monkeypatch.setenv("XLA_FLAGS", flags)
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for counts in ((2, 1, "as on GPUs"), (2,)):
            missing, segments = pool.apply(runs_on_devices, [tmp_path, counts])
            assert bool(missing) == (len(counts) > 1)  # the second process compiles nothing
            assert len(segments.pop("failed")) < 10  # the other devices stop, too
            assert len(list(tmp_path.glob("cache/traced/*"))) == 1
            for count, noted in segments.items():
                assert parts_of(tmp_path / str(count)) == parts_of(whole)
                assert len({segment.device for segment in noted if segment is not None}) == count
                shutil.rmtree(tmp_path / str(count))


def test_results_hold_every_world_with_its_drawn_quantities(whole, tmp_path):
    results = merged([whole], tmp_path)
    assert dict(results.sizes) == {"law": 2, "world": 20, "pose": 3}
    columns = draws.table(draws.draw(BOXES, 0, np.arange(20)))
    for name, (values, unit) in columns.items():
        assert_allclose(results[name], values, rtol=1e-6)
        assert results[name].attrs["units"] == unit
    undrawn = {name for name in QUANTITIES if BOXES.range_of(name) is None}
    floors = {"slope", "slope_bearing", "boundary_factor", "boundary"}
    unused = {"foam", "time_constant", "feet", "support"} | floors
    assert undrawn == {*domain.quantities_of("robot", "course")} | unused
    assert set(LABELS) == {*columns, *undrawn}
    again = outcomes([worlds_of(np.arange(20))])
    for i, outcome in again.items():
        assert float(results.time.sel(law="rps")[i]) == outcome.time
        assert int(results.success.sel(law="rps")[i]) == int(outcome.success)
    json.dumps(load_plan(whole).configuration())
    assert load_plan(whole) == PLAN


# C MuJoCo compiles little, so that a process is soon at work.
BRIEF = replace(SHORT, engine="mujoco", rules=Rules(horizon=3.0))
KILLED = replace(PLAN, domain=replace(CYLINDERS, skin="ideal"), worlds=20, setting=BRIEF, part=5)


def sweep_in_a_process(folder):
    cache.use_cache()
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    swept(folder, KILLED)


def test_a_run_killed_twice_equals_an_undisturbed_one(tmp_path, monkeypatch):
    """SIGKILL hits start and work alternately at random moments; the last process ends."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # or the server finds no tests
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["test_sweep"])
    folder, dice, interrupted = tmp_path / "run", random.Random(0), 0

    def done():
        return len(list(folder.glob("parts/*.npz")))

    for kill in range(3):
        previous = done()
        process = context.Process(target=sweep_in_a_process, args=(folder,))
        process.start()
        if kill < 2:
            while kill % 2 and process.is_alive() and done() == previous:
                time.sleep(0.01)  # until it is at work, however slow the machine
            process.join(dice.uniform(0.0, 0.5 if kill % 2 else 2.0))
            process.kill()
        process.join()
        interrupted += 0 < done() < len(KILLED.chunks)
    assert process.exitcode == 0
    assert interrupted > 0
    assert parts_of(folder) == parts_of(swept(tmp_path / "whole", KILLED))


def continued(folder, whole):
    """Return the finished trials at the start of a continued sweep; its results are the same."""
    finished = []
    swept(folder, callback=lambda progress: finished.append(progress.finished))
    parts = parts_of(folder)
    assert {name: parts[name] for name in parts if name.endswith(".npz")} == parts_of(whole)
    return finished[0]


def full_disk(folder, monkeypatch):
    fsync = os.fsync

    def full(file):
        if len(list(folder.glob("parts/[0-9]*"))) == 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(file)

    monkeypatch.setattr(os, "fsync", full)
    return str(folder), "No space left on device", "same command again", "are stored"


def device_out_of_memory(folder, monkeypatch):
    program = jax.stages.Compiled.__call__

    def starved(*args, **options):
        if list(folder.glob("parts/[0-9]*")):
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory.")
        return program(*args, **options)

    monkeypatch.setattr(jax.stages.Compiled, "__call__", starved)
    return "out of memory", "--slots", "are stored"


@pytest.mark.parametrize("fault", [full_disk, device_out_of_memory])
def test_a_fault_loses_nothing(fault, whole, tmp_path, capsys, monkeypatch):
    """The sweep ends in one sentence; finished parts are kept and not repeated."""
    words = fault(tmp_path, monkeypatch)
    assert running.exit_code(lambda: swept(tmp_path)) == 2
    error = one_sentence(capsys.readouterr().err)
    assert all(word in error for word in words)
    monkeypatch.undo()
    stored = parts_of(tmp_path)
    assert 0 < len(stored) < len(PLAN.chunks)
    assert stored.items() <= parts_of(whole).items()
    sizes = [PLAN.chunks[int(name[:7])].size for name in stored]
    assert continued(tmp_path, whole) == sum(sizes)


def test_programs_load_while_most_worlds_are_built():
    plan = replace(PLAN, worlds=100, part=70)
    (job,) = PlanRequest(plan, list(plan.chunks), Results(plan)).jobs(SHORT)
    assert [batch.indices.size for batch in job.batches] == [64, 6, 30, 70, 30]  # of two laws


def test_only_a_corrupt_part_is_set_aside_and_repeated(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run")
    victim = sorted(folder.glob("parts/*.npz"))[2]
    times = {path: path.stat().st_mtime_ns for path in folder.glob("parts/*.npz") if path != victim}
    content = bytearray(victim.read_bytes())
    content[len(content) // 2] ^= 1
    victim.write_bytes(content)
    assert continued(folder, whole) == PLAN.num_trials - PLAN.chunks[2].size
    assert {path: path.stat().st_mtime_ns for path in times} == times
    assert victim.with_suffix(".npz.corrupt").read_bytes() == bytes(content)


def test_a_part_of_an_older_version_is_named(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run")
    victim = sorted(folder.glob("parts/*.npz"))[0]
    columns = files.decode_arrays(victim.read_bytes())
    del columns["tipped"]
    victim.unlink()
    store_chunk(folder, 0, files.encode_arrays(**columns))
    with refusing(r"part 0 .* another version .it lacks tipped"):
        merge([folder], out=folder)


def test_the_report_of_one_world_has_the_command_that_replays_its_failure(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "a run")
    results = merge([folder], out=folder)
    world = results.isel(world=[0])
    world.success[:] = [[1], [0]]
    text = str(sweep.plan_sections(load_plan(folder), world, folder))
    assert f"rps replay '{folder}' 0 --law nps" in text  # the law that fails
    assert statistics.influences(world) == []


def test_shards_merge_to_the_whole(whole, tmp_path):
    shards = Shard(1, 3), Shard(2, 3), Shard(3, 3), Shard(7, 7)  # the last has none of the 6 parts
    folders = [swept(tmp_path / f"{k}", shard=shard) for k, shard in enumerate(shards)]
    with refusing("lacks 2 of 6 parts"):
        merge(folders[:2], out=tmp_path)
    (tmp_path / "direct").mkdir()
    direct = merged([whole], tmp_path / "direct")
    xr.testing.assert_identical(merged(folders, tmp_path), direct)
    (folders[1] / "environment.json").write_text("{")
    with refusing("environment.json"):
        merge(folders, out=tmp_path / "failed")
    assert not any((tmp_path / "failed").iterdir())
    open_run(tmp_path / "other", replace(PLAN, setting=replace(SHORT, seed=5)))
    with refusing("seed = 0 there, 5 asked for"):
        merge([folders[0], tmp_path / "other"], out=tmp_path)


def test_another_configuration_is_refused_with_its_differences(whole):
    changed_plan = replace(PLAN, worlds=30, domain=replace(BOXES, mass=Range(1, 2)))
    with refusing(r"domain.mass = .*there, .* asked for; worlds = 20 there"):
        open_run(whole, changed_plan)


def test_a_run_of_version_0_4_is_replayed(whole, tmp_path):
    """Its manifest has no drive of the robot."""
    folder = shutil.copytree(whole, tmp_path / "old")
    record = json.loads((folder / "manifest.json").read_text())
    assert record["domain"]["robot"].pop("drive") == "omni"
    files.write_json(folder / "manifest.json", record, checked=True)
    assert load_plan(folder) == PLAN
    record["domain"]["robot"]["drive"] = "differential"
    files.write_json(folder / "manifest.json", record, checked=True)
    assert load_plan(folder) != PLAN


def test_sweep_merge_and_replay_on_the_command_line(tmp_path, capsys):
    tuned, drums, run = (tmp_path / name for name in ("tuned.json", "drums.json", "run"))
    tuned.write_text(json.dumps({"L": 0.3, "saturate_first": 0}))
    drums.write_text(json.dumps({"objects": ["random_cylinder"], "distance": [1, 2]}))
    command = f"sweep --fidelity fast --worlds 16 --horizon 6 --part 8 --slots {SLOTS}"
    command += f" --domain {drums} --out {run} --laws rps rps,{tuned}"
    gc.disable()  # as a process starts
    assert [rps(command, "--shard", f"{k}/2") for k in (1, 2)] == [0, 0]
    assert gc.isenabled()
    gc.unfreeze()
    text = printed(capsys, "merge", run, "--out", run)
    assert "rps,tuned against rps" in text
    results = files.read_results(run)
    assert results.law.values.tolist() == ["rps", "rps,tuned"]
    assert rps("merge", run, "--out", tmp_path / "there") == 0
    for folder, name in product(("run", "there"), ("report.html", "report.md", "success.png")):
        assert (tmp_path / folder / name).exists()
    assert load_plan(tmp_path / "there") == load_plan(run)
    other_run = open_run(tmp_path / "other", PLAN)
    error = refusal(capsys, "merge", run, "--out", other_run)
    assert "other holds another run (domain.objects = " in error
    assert not (other_run / "results.nc").exists()
    assert rps("replay", run, 4, "--law", "rps,tuned", "--no-video") == 0
    replayed = files.read_dataset(run / "replay-4" / "results.nc")
    # Followed alone, in another batch than in the sweep.
    assert float(replayed.outcome_time) == pytest.approx(float(results.time[1, 4]), abs=0.5)
