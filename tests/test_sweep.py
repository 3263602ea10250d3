"""Sweeps over random worlds: worlds are independent, and finished work is never lost."""

import errno
import json
import multiprocessing
import os
import random
import shutil
import subprocess
import sys
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
    refusal,
    row,
    rps,
    same,
    swept,
)

from rps_jax.analysis import tables
from rps_jax.app.cli import running
from rps_jax.errors import InputError
from rps_jax.geometry import planar
from rps_jax.record import cache, files
from rps_jax.runs import execution, sweep
from rps_jax.runs.plan import Shard, load_plan, open_run
from rps_jax.runs.sweep import merge
from rps_jax.trials import batch, trial
from rps_jax.trials.batch import Job
from rps_jax.trials.trial import Rules
from rps_jax.trials.worlds import drawn_worlds
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


def box_worlds(index):
    """Return worlds of the domain of boxes."""
    return drawn_worlds(BOXES, draws.draw(BOXES, 0, index), SHORT).with_params(PAPER)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An undisturbed run."""
    return swept(tmp_path_factory.mktemp("whole"))


def test_a_world_in_a_refilled_slot_ends_as_alone():
    """Bit for bit with a fixed number of slots, whatever shares the batch."""
    together = outcomes([box_worlds(np.arange(13)), box_worlds(np.arange(13, 20))])
    assert len(together) == 20
    assert (
        len({float(outcome.time) for outcome in together.values()}) > 3
    )  # they end at different times
    for index in (0, 9, 19):
        padded = box_worlds(np.full(SLOTS, index))  # a batch of one program, of this world alone
        alone = outcomes([padded._replace(indices=np.arange(SLOTS))])
        same(alone[0], together[index])


@pytest.mark.parametrize("error", ["pose_latency", "command_delay"])
def test_latency_of_poses_and_commands_is_exact(error):
    """While the base turns, sensed poses or applied commands lag n steps behind."""
    steps, period = 3, SHORT.physics.control_period
    still = replace(BOXES, **{name: Range(0, 0) for name in domain.quantities_of("base")})
    late = replace(still, **{error: Range(steps * period, steps * period)})
    part = drawn_worlds(late, draws.draw(late, 0, [0]), SHORT).with_params(PAPER)
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
        np.testing.assert_allclose(applied[steps:], commanded[:-steps], rtol=1e-6)
        np.testing.assert_array_equal(applied[:steps], 0.0)
    else:
        np.testing.assert_allclose(applied, commanded)
        assert (
            np.abs(np.array(commanded[: steps + 1]) - commanded[0]).max() == 0
        )  # nothing seen yet
        assert np.abs(np.array(commanded[steps + 1]) - commanded[0]).max() > 0


@pytest.mark.slow
def test_a_base_without_errors_is_perfect():
    nothing = {name: Range(0, 0) for name in domain.quantities_of("base")}
    perfect = replace(CYLINDERS, **nothing)
    assert box_worlds(np.arange(2)).worlds.odometry.past.shape[1] > 1
    drawn = draws.draw(perfect, 0, np.arange(6))
    part = drawn_worlds(perfect, drawn, SHORT).with_params(PAPER)
    assert part.worlds.odometry.past.shape == (6, 0)
    remembered = part.worlds._replace(
        odometry=part.worlds.odometry._replace(past=np.zeros((6, 4), np.float32))
    )
    brief = replace(SHORT, rules=Rules(horizon=1.0))
    a, b = (outcomes([p], brief) for p in (part, part._replace(worlds=remembered)))
    for i in range(6):
        for mine, theirs in zip(a[i], b[i], strict=True):
            np.testing.assert_allclose(mine, theirs, atol=1e-4)


def test_flat_boxes_without_contact_do_not_move():
    """This holds for the long steps of `fast`; stiffer ground would shake the boxes away."""
    flat = replace(BOXES, size=Range(0.25, 0.35), height=Range(0.3, 0.4), gap=Range(0.05, 0.05))
    still = PAPER._replace(v_approach=0.0)
    part = drawn_worlds(flat, draws.draw(flat, 0, np.arange(SLOTS)), SHORT).with_params(still)
    ended = outcomes([part])
    pose = np.array([ended[i].object_pose for i in range(SLOTS)])
    assert np.abs(pose[:, :2] - part.worlds.qpos[:, 3:5]).max() < 2e-3  # in 20 s
    assert np.abs(pose[:, 2] - planar.yaw_of_quaternion(part.worlds.qpos[:, 6:])).max() < 0.01


@pytest.mark.slow
def test_a_faster_base_arrives_earlier():
    perfect = {name: Range(0, 0) for name in domain.quantities_of("base")}
    quick = replace(CYLINDERS, **perfect, gap=Range(0.05, 0.05))
    times = []
    for error in (-0.5, 0.0):
        chosen = replace(quick, velocity_error=Range(error, error))
        part = drawn_worlds(chosen, draws.draw(chosen, 0, [1]), SHORT).with_params(PAPER)
        times.append(outcomes([part])[1].base_pose[0])  # x at the end
    assert times[0] < 0.7 * times[1]


_ON_TWO_DEVICES = """
import sys, jax
from pathlib import Path
from helpers import swept
from rps_jax.record import cache
from rps_jax.control.laws.rps import LAW

cache.use_cache()
assert jax.device_count() == 2
programs, plain = [], jax.stages.Lowered.compile
def noted(*given, **options):
    programs.append(plain(*given, **options))
    return programs[-1]
jax.stages.Lowered.compile = noted
swept(Path(sys.argv[1]), workers=1)
for program in programs:
    (_, worlds, *_), _ = program.args_info
    slots = {leaf.shape[0] for leaf in jax.tree.leaves(worlds)}
    talk = ("all-reduce", "all-gather", "all-to-all", "permute")
    print(*slots, *(word for word in talk if word in program.as_text()))
"""


def test_two_devices_agree_with_one_and_never_communicate(whole, tmp_path):
    environment = os.environ | {
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2",
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    done = subprocess.run(
        [sys.executable, "-c", _ON_TWO_DEVICES, str(tmp_path / "run")],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == ["16"]  # slots, and no collective
    results = []
    for folder in (tmp_path / "run", whole):
        merge([folder], out=tmp_path)
        results.append(files.read_results(tmp_path))
    # Another program rounds otherwise, and contact amplifies it.
    double, single = results
    np.testing.assert_array_equal(double.success, single.success)
    np.testing.assert_allclose(double.min_distance, single.min_distance, atol=0.02)
    assert np.median(np.abs(double.time - single.time)) < 0.1


def test_results_hold_every_world_with_its_drawn_quantities(whole, tmp_path):
    merge([whole], out=tmp_path)
    results = files.read_results(tmp_path)
    assert dict(results.sizes) == {"law": 2, "world": 20, "pose": 3, "object": 1}
    columns = draws.table(draws.draw(BOXES, 0, np.arange(20)))
    for name, (values, unit) in columns.items():
        np.testing.assert_allclose(results[name], values, rtol=1e-6)
        assert results[name].attrs["units"] == unit
    undrawn = {name for name in QUANTITIES if getattr(BOXES, name) is None}
    assert undrawn == {*domain.quantities_of("robot"), "foam", "time_constant", "feet"}
    assert set(LABELS) == {*columns, *undrawn}
    again = outcomes([box_worlds(np.arange(20))])
    for i, outcome in again.items():
        assert float(results.time.sel(law="rps")[i]) == outcome.time
        assert int(results.success.sel(law="rps")[i]) == int(outcome.success)
    json.dumps(load_plan(whole).configuration())
    assert load_plan(whole) == PLAN


# C MuJoCo compiles little, so that a process is soon at work.
KILLED = replace(
    PLAN,
    domain=replace(CYLINDERS, skin="ideal"),
    worlds=40,
    setting=replace(SHORT, engine="mujoco", rules=Rules(horizon=3.0)),
    part=5,
)


def sweep_in_a_process(folder):
    cache.use_cache()
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    swept(folder, KILLED)


def test_a_run_killed_six_times_equals_an_undisturbed_one(tmp_path, monkeypatch):
    """SIGKILL hits start and work alternately at random moments; the last process ends."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # or the server finds no tests
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["test_sweep"])
    folder, dice, interrupted = tmp_path / "run", random.Random(0), 0

    def done():
        return len(list(folder.glob("parts/*.npz")))

    for kill in range(7):
        previous = done()
        process = context.Process(target=sweep_in_a_process, args=(folder,))
        process.start()
        if kill < 6:
            while kill % 2 and process.is_alive() and done() == previous:
                time.sleep(0.01)  # until it is at work, however slow the machine
            process.join(dice.uniform(0.0, 0.5 if kill % 2 else 2.0))
            process.kill()
        process.join()
        interrupted += 0 < done() < len(KILLED.chunks)
    assert process.exitcode == 0
    assert interrupted > 1
    assert parts_of(folder) == parts_of(swept(tmp_path / "whole", KILLED))


def ends_in_one_sentence_and_is_continued(folder, whole, capsys, monkeypatch, *words):
    """Check the error, that finished parts are kept and not repeated, and the final results."""
    assert running.exit_code(lambda: swept(folder)) == 2
    error = one_sentence(capsys.readouterr().err)
    assert all(word in error for word in words)
    monkeypatch.undo()
    stored = parts_of(folder)
    assert 0 < len(stored) < len(PLAN.chunks)
    assert stored.items() <= parts_of(whole).items()
    finished = []
    swept(folder, callback=lambda progress: finished.append(progress.finished))
    assert finished[0] == sum(PLAN.chunks[int(name[:7])].size for name in stored)
    assert parts_of(folder) == parts_of(whole)


def test_a_full_disk_loses_nothing(whole, tmp_path, capsys, monkeypatch):
    fsync = os.fsync

    def full(file):
        if len(list(tmp_path.glob("parts/[0-9]*"))) == 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(file)

    monkeypatch.setattr(os, "fsync", full)
    words = (str(tmp_path), "No space left on device", "same command again", "are stored")
    ends_in_one_sentence_and_is_continued(tmp_path, whole, capsys, monkeypatch, *words)


def test_a_device_out_of_memory_loses_nothing(whole, tmp_path, capsys, monkeypatch):
    program = jax.stages.Compiled.__call__

    def starved(*args, **options):
        if list(tmp_path.glob("parts/[0-9]*")):
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory.")
        return program(*args, **options)

    monkeypatch.setattr(jax.stages.Compiled, "__call__", starved)
    words = ("out of memory", "--slots", "are stored")
    ends_in_one_sentence_and_is_continued(tmp_path, whole, capsys, monkeypatch, *words)


def test_only_a_corrupt_part_is_set_aside_and_repeated(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run")
    victim = sorted(folder.glob("parts/*.npz"))[2]
    times = {path: path.stat().st_mtime_ns for path in folder.glob("parts/*.npz") if path != victim}
    content = bytearray(victim.read_bytes())
    content[len(content) // 2] ^= 1
    victim.write_bytes(content)
    finished = []
    swept(folder, callback=lambda progress: finished.append(progress.finished))
    assert finished[0] == PLAN.num_trials - PLAN.chunks[2].size
    assert {path: path.stat().st_mtime_ns for path in times} == times
    corrupt = victim.with_suffix(".npz.corrupt")
    assert corrupt.read_bytes() == bytes(content)
    corrupt.unlink()
    assert parts_of(folder) == parts_of(whole)


def test_a_part_of_an_older_version_is_named(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run")
    victim = sorted(folder.glob("parts/*.npz"))[0]
    columns = files.decode_arrays(victim.read_bytes())
    del columns["tipped"]
    older = files.encode_results(xr.Dataset({name: xr.Variable((), 0) for name in columns}))
    for content, lacks in (
        (files.encode_arrays(**columns), "lacks tipped"),
        (older, "is a NetCDF file"),
    ):
        victim.unlink()
        victim = execution.store_chunk(folder, 0, content)
        with pytest.raises(InputError, match=f"part 0 .* another version .it {lacks}"):
            merge([folder], out=folder)


def test_a_run_with_the_removed_column_overflows_is_read(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run")
    expected = merge([folder], out=folder)
    for index, chunk in enumerate(sorted(folder.glob("parts/*.npz"))):
        columns = files.decode_arrays(chunk.read_bytes())
        chunk.unlink()
        older = columns | {"overflows": np.zeros(columns["trial"].size, np.int32)}
        execution.store_chunk(folder, index, files.encode_arrays(**older))
    xr.testing.assert_identical(merge([folder], out=folder), expected)


def test_the_report_of_one_world_has_the_command_that_replays_its_failure(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "a run")
    results = merge([folder], out=folder)
    world = results.isel(world=[0])
    world.success[:] = [[1], [0]]
    text = str(sweep.plan_sections(load_plan(folder), world, folder))
    assert f"rps replay '{folder}' 0 --law nps" in text  # the law that fails
    assert tables.influence_table(world, "rps")[1:] == []


def test_shards_merge_to_the_whole(whole, tmp_path):
    folders = [swept(tmp_path / f"{k}", shard=Shard(k, 3)) for k in (1, 2, 3)]
    with pytest.raises(InputError, match="lacks 2 of 6 parts"):
        merge(folders[:2], out=tmp_path)
    merge(folders, out=tmp_path)
    (tmp_path / "direct").mkdir()
    merge([whole], out=tmp_path / "direct")
    together = [files.read_results(f) for f in (tmp_path, tmp_path / "direct")]
    xr.testing.assert_identical(*together)
    other_plan = replace(PLAN, setting=replace(SHORT, seed=5))
    open_run(tmp_path / "other", other_plan)
    with pytest.raises(InputError, match="seed = 0 there, 5 asked for"):
        merge([folders[0], tmp_path / "other"], out=tmp_path)


def test_another_configuration_is_refused_with_its_differences(whole):
    changed_plan = replace(PLAN, worlds=30, domain=replace(BOXES, mass=Range(1, 2)))
    with pytest.raises(InputError, match=r"domain.mass = .*there, .* asked for; worlds = 20 there"):
        open_run(whole, changed_plan)


def test_sweep_merge_and_replay_on_the_command_line(tmp_path, capsys):
    tuned, drums, run = (tmp_path / name for name in ("tuned.json", "drums.json", "run"))
    tuned.write_text(json.dumps({"L": 0.3}))
    drums.write_text(json.dumps({"objects": ["random_cylinder"], "distance": [1, 2]}))
    command = ["sweep", "--domain", drums, "--fidelity", "fast", "--worlds", 12, "--horizon", 6,
               "--laws", "rps", f"rps,{tuned}", "--part", 5, "--slots", SLOTS,
               "--out", run]  # fmt: skip
    assert rps(*command, "--shard", "1/2") == 0
    assert rps(*command, "--shard", "2/2") == 0
    assert rps("merge", run, "--out", run) == 0
    text = capsys.readouterr().out
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
    assert rps("replay", run, 4, "--law", "rps,tuned", "--film-length", 0.1) == 0
    replayed = files.read_dataset(run / "replay-4" / "results.nc")
    # Followed alone, in another batch than in the sweep.
    assert float(replayed.outcome_time) == pytest.approx(float(results.time[1, 4]), abs=0.5)
