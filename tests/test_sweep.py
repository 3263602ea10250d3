"""Sweeps over random worlds: a world's result is its own, and nothing that is done is lost."""

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
from itertools import product
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

from rps_jax.analysis import statistics, tables
from rps_jax.app import cli
from rps_jax.control import strategies
from rps_jax.control.law import RPSParams
from rps_jax.errors import InputError
from rps_jax.geometry import planar
from rps_jax.record import files
from rps_jax.runs import sweep
from rps_jax.runs.sweep import Plan, Shard
from rps_jax.trials import batch, trial
from rps_jax.trials.batch import Job
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Outcome, Rules
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.world import domain, paper
from rps_jax.world.domain import DOMAINS, Range
from rps_jax.world.physics import preset

SLOTS = 8
SHORT = Setting(preset(fidelity="fast"), Rules(horizon=20.0), engine="fused")
BOXES = replace(
    DOMAINS["wide"],
    objects=("random_box",),
    distance=Range(0.7, 0.8),
    bearing=Range(-0.5, 0.5),
    gap=Range(0, 0.01),
)
ROUND = replace(BOXES, objects=("random_cylinder",))
PLAN = Plan(BOXES, 20, {"rps": paper.PARAMS["rps"], "nps": paper.PARAMS["nps"]}, SHORT, part=7)


@pytest.fixture(autouse=True, scope="module")
def cache(tmp_path_factory):
    """The programs of this file are compiled once, also those of other processes."""
    folder = os.environ.get("RPS_CACHE") or str(tmp_path_factory.mktemp("cache"))
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", folder)
    yield folder
    jax.config.update("jax_compilation_cache_dir", before)


def outcomes(parts, setting=SHORT):
    found = {}

    def collect(numbers, rows):
        for i, number in enumerate(numbers):
            found[int(number)] = [leaf[i] for leaf in rows]

    job = Job(strategies.RPS, sum(p.numbers.size for p in parts), parts)
    batch.run([job], setting, slots=SLOTS, workers=1, collect=collect)
    return found


def made(index):
    return drawn_worlds(BOXES, domain.draw(BOXES, 0, index), paper.PARAMS["rps"], SHORT)


def swept(folder, plan=PLAN, **options):
    sweep.open_run(folder, plan)
    sweep.run(folder, plan, slots=SLOTS, **options)
    return folder


def payload(folder):
    return {path.name: path.read_bytes() for path in (folder / "parts").iterdir()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory, cache):
    """A run that nothing disturbed."""
    return swept(tmp_path_factory.mktemp("whole"))


def test_a_world_in_a_refilled_slot_ends_as_it_does_alone():
    """Bit by bit, for one number of slots: whatever shares the batch, whenever it began."""
    together = outcomes([made(np.arange(13)), made(np.arange(13, 20))])
    assert len(together) == 20
    assert len({float(row[1]) for row in together.values()}) > 3  # they end at different times
    for index in (0, 9, 19):
        padded = made(np.full(SLOTS, index))  # a batch of one program, of this world alone
        alone = outcomes([padded._replace(numbers=np.arange(SLOTS))])
        for a, b in zip(alone[0], together[index], strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("error", ["pose_latency", "command_delay"])
def test_late_poses_and_late_commands_are_late_by_as_much(error):
    """Of a base that is told to turn: what is believed, and done, is what was n steps before."""
    steps, period = 3, SHORT.physics.control_period
    still = replace(BOXES, **{name: Range(0, 0) for name in domain.OF_THE_BASE})
    late = replace(still, **{error: Range(steps * period, steps * period)})
    part = drawn_worlds(late, domain.draw(late, 0, [0]), paper.PARAMS["rps"], SHORT)
    world = jax.tree.map(lambda leaf: leaf[0], part.worlds)
    now = jax.tree.map(jnp.asarray, trial.start(world))
    told, done = [], []
    for step in range(8):
        now = now._replace(qpos=now.qpos.at[2].set(0.01 * step))  # turned by hand
        now, twist, seen = trial.decide(world, now, physics=SHORT.physics)
        now = now._replace(steps=now.steps + 1)
        told.append([float(x) for x in seen.twist])
        done.append([float(x) for x in twist])
    if error == "command_delay":
        np.testing.assert_allclose(done[steps:], told[:-steps], rtol=1e-6)
        np.testing.assert_array_equal(done[:steps], 0.0)
    else:
        np.testing.assert_allclose(done, told)
        assert np.abs(np.array(told[: steps + 1]) - told[0]).max() == 0  # nothing seen yet
        assert np.abs(np.array(told[steps + 1]) - told[0]).max() > 0


@pytest.mark.slow
def test_a_base_that_errs_by_nothing_is_perfect():
    nothing = {name: Range(0, 0) for name in domain.OF_THE_BASE}
    perfect = replace(ROUND, **nothing)
    assert made(np.arange(2)).worlds.odometry.past.shape[1] > 1
    drawn = domain.draw(perfect, 0, np.arange(6))
    part = drawn_worlds(perfect, drawn, paper.PARAMS["rps"], SHORT)
    assert part.worlds.odometry.past.shape == (6, 0)
    remembered = part.worlds._replace(
        odometry=part.worlds.odometry._replace(past=np.zeros((6, 4), np.float32))
    )
    brief = replace(SHORT, rules=Rules(horizon=1.0))
    a, b = (outcomes([p], brief) for p in (part, part._replace(worlds=remembered)))
    for i in range(6):
        for mine, theirs in zip(a[i], b[i], strict=True):
            np.testing.assert_allclose(mine, theirs, atol=1e-4)


def test_flat_boxes_that_nothing_touches_stay_where_they_are():
    """Even in the long steps of `fast`, in which stiffer ground would shake them away."""
    flat = replace(BOXES, size=Range(0.25, 0.35), height=Range(0.3, 0.4), gap=Range(0.05, 0.05))
    still = RPSParams.paper()._replace(v_approach=0.0)
    part = drawn_worlds(flat, domain.draw(flat, 0, np.arange(SLOTS)), still, SHORT)
    found = outcomes([part])
    pose = np.array([found[i][Outcome._fields.index("object_pose")] for i in range(SLOTS)])
    assert np.abs(pose[:, :2] - part.worlds.qpos[:, 3:5]).max() < 2e-3  # in 20 s
    assert np.abs(pose[:, 2] - planar.yaw_of_quaternion(part.worlds.qpos[:, 6:])).max() < 0.01


@pytest.mark.slow
def test_a_faster_base_arrives_earlier():
    quick = replace(ROUND, **{n: Range(0, 0) for n in domain.OF_THE_BASE}, gap=Range(0.05, 0.05))
    times = []
    for error in (-0.5, 0.0):
        chosen = replace(quick, velocity_error=Range(error, error))
        part = drawn_worlds(chosen, domain.draw(chosen, 0, [1]), paper.PARAMS["rps"], SHORT)
        times.append(outcomes([part])[1][-2][0])  # x of the base at the end
    assert times[0] < 0.7 * times[1]


_ON_TWO_DEVICES = """
import sys, jax, tests.test_sweep as t
from pathlib import Path
jax.config.update("jax_compilation_cache_dir", sys.argv[2])
assert jax.device_count() == 2
t.swept(Path(sys.argv[1]), workers=1)
queue = t.slots._Queue(t.Job(t.strategies.RPS, 20, [t.made(range(20))]), t.SHORT, t.SLOTS)
text = queue.program().as_text()
print(queue.slots, *(w for w in ("all-reduce", "all-gather", "all-to-all", "permute") if w in text))
"""


def test_two_devices_find_what_one_finds_and_never_talk(whole, tmp_path, cache):
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    done = subprocess.run(
        [sys.executable, "-c", _ON_TWO_DEVICES, str(tmp_path / "run"), cache],
        cwd=Path(__file__).parent.parent,
        env=os.environ | flags,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == ["16"]  # slots, and no collective
    results = []
    for folder in (tmp_path / "run", whole):
        sweep.merge([folder], tmp_path)
        results.append(files.read_results(tmp_path))
    # Another program rounds otherwise, and contact amplifies it.
    two, one = results
    np.testing.assert_array_equal(two.success, one.success)
    np.testing.assert_allclose(two.min_distance, one.min_distance, atol=0.02)
    assert np.median(np.abs(two.time - one.time)) < 0.1


def test_results_hold_every_world_with_what_was_drawn(whole, tmp_path):
    sweep.merge([whole], tmp_path)
    results = files.read_results(tmp_path)
    assert dict(results.sizes) == {"arm": 2, "world": 20, "pose": 3, "object": 1}
    columns = domain.table(domain.draw(BOXES, 0, np.arange(20)))
    for name, (values, unit) in columns.items():
        np.testing.assert_allclose(results[name], values, rtol=1e-6)
        assert results[name].attrs["units"] == unit
    assert set(statistics.DRAWN) == set(columns)
    again = outcomes([made(np.arange(20))])
    for i, row in again.items():
        assert float(results.time.sel(arm="rps")[i]) == row[1]
        assert int(results.success.sel(arm="rps")[i]) == int(row[0])
    json.dumps(sweep.load_plan(whole).configuration())
    assert sweep.load_plan(whole) == PLAN


# C MuJoCo compiles little, so that a process is soon at work.
KILLED = replace(
    PLAN,
    domain=replace(ROUND, skin="ideal"),
    worlds=60,
    setting=replace(SHORT, engine="mujoco", rules=Rules(horizon=3.0)),
    part=5,
)


def sweep_in_a_process(folder, cache):
    jax.config.update("jax_compilation_cache_dir", cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    swept(folder, KILLED)


def test_a_run_killed_twenty_times_ends_as_one_that_was_not(tmp_path, cache):
    """SIGKILL at random moments, in turn of a start and of the work; then one may end."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["rps_jax.runs.sweep"])
    folder, dice, interrupted = tmp_path / "run", random.Random(0), 0

    def done():
        return len(list(folder.glob("parts/*.nc")))

    for kill in range(21):
        before = done()
        process = context.Process(target=sweep_in_a_process, args=(folder, cache))
        process.start()
        if kill < 20:
            while kill % 2 and process.is_alive() and done() == before:
                time.sleep(0.01)  # until it is at work, however slow the machine
            process.join(dice.uniform(0.0, 0.5 if kill % 2 else 3.0))
            process.kill()
        process.join()
        interrupted += 0 < done() < len(KILLED.parts)
    assert process.exitcode == 0
    assert interrupted > 2
    assert payload(folder) == payload(swept(tmp_path / "whole", KILLED))


def ends_in_one_sentence_and_is_continued(folder, whole, capsys, monkeypatch, *words):
    """What was done stays, alone, and is not run again; then all is as if nothing had happened."""
    assert cli.guarded(lambda: swept(folder)) == 2
    error = capsys.readouterr().err
    assert error.startswith("rps: error: ")
    assert error.count("\n") == 1
    assert all(word in error for word in words)
    monkeypatch.undo()
    kept = payload(folder)
    assert 0 < len(kept) < len(PLAN.parts)
    assert kept.items() <= payload(whole).items()
    finished = []
    swept(folder, report=lambda progress: finished.append(progress.finished))
    assert finished[0] == sum(PLAN.parts[int(name[:7])].size for name in kept)
    assert payload(folder) == payload(whole)


def test_a_full_disk_loses_nothing(whole, tmp_path, capsys, monkeypatch):
    fsync = os.fsync

    def full(file):
        if len(list(tmp_path.glob("parts/[0-9]*"))) == 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(file)

    monkeypatch.setattr(os, "fsync", full)
    words = (str(tmp_path), "No space left on device", "same command again", "is kept")
    ends_in_one_sentence_and_is_continued(tmp_path, whole, capsys, monkeypatch, *words)


def test_a_device_out_of_memory_loses_nothing(whole, tmp_path, capsys, monkeypatch):
    compiled = batch._Queue.program

    def starved(queue):
        def program(*arguments):
            if list(tmp_path.glob("parts/[0-9]*")):
                raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory.")
            return compiled(queue)(*arguments)

        return program

    monkeypatch.setattr(batch._Queue, "program", starved)
    words = ("out of memory", "--slots", "is kept")
    ends_in_one_sentence_and_is_continued(tmp_path, whole, capsys, monkeypatch, *words)


def test_a_corrupt_part_is_set_aside_and_done_again_alone(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run")
    victim = sorted(folder.glob("parts/*.nc"))[2]
    others = {path: path.stat().st_mtime_ns for path in folder.glob("parts/*.nc") if path != victim}
    content = bytearray(victim.read_bytes())
    content[len(content) // 2] ^= 1
    victim.write_bytes(content)
    finished = []
    swept(folder, report=lambda progress: finished.append(progress.finished))
    assert finished[0] == PLAN.trials - PLAN.parts[2].size
    assert {path: path.stat().st_mtime_ns for path in others} == others
    aside = victim.with_suffix(".nc.corrupt")
    assert aside.read_bytes() == bytes(content)
    aside.unlink()
    assert payload(folder) == payload(whole)


def test_a_part_of_an_older_version_is_named(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run")
    victim = sorted(folder.glob("parts/*.nc"))[0]
    older = files.encoded(files.read(victim).drop_vars("overflows"))
    victim.unlink()
    sweep.store(folder, 0, older)
    with pytest.raises(InputError, match=r"part 0 .* another version .it lacks overflows"):
        sweep.merge([folder], folder)


def test_the_report_of_one_world_tells_what_was_lost_and_how_to_see_it(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "a run")
    sweep.merge([folder], folder)
    one = files.read_results(folder).isel(world=[0])
    one.success[:], one.overflows[:] = [[1], [0]], [[0], [3]]
    files.write_results(folder / "results.nc", one)
    text = sweep.write_report(folder).read_text()
    assert "1 trials lost contacts for want of room: they are not to be trusted" in text
    assert f"`rps replay '{folder}' 0 --arm 'nps' --video`" in text  # the arm that fails
    assert not (folder / "success.png").exists()  # nothing was drawn but once
    assert tables.influence_table(one, "rps")[1:] == []


def test_shards_merge_to_the_whole(whole, tmp_path):
    folders = [swept(tmp_path / f"{k}", shard=Shard(k, 3)) for k in (1, 2, 3)]
    with pytest.raises(InputError, match="lacks 2 of 6 parts"):
        sweep.merge(folders[:2], tmp_path)
    sweep.merge(folders, tmp_path)
    (tmp_path / "direct").mkdir()
    sweep.merge([whole], tmp_path / "direct")
    together = [files.read_results(f) for f in (tmp_path, tmp_path / "direct")]
    xr.testing.assert_identical(*together)
    other = replace(PLAN, setting=replace(SHORT, seed=5))
    sweep.open_run(tmp_path / "other", other)
    with pytest.raises(InputError, match="seed = 0 there, 5 asked for"):
        sweep.merge([folders[0], tmp_path / "other"], tmp_path)


def test_another_configuration_is_refused_with_what_differs(whole):
    other = replace(PLAN, worlds=30, domain=replace(BOXES, mass=Range(1, 2)))
    with pytest.raises(InputError, match=r"domain.mass = .*there, .* asked for; worlds = 20 there"):
        sweep.open_run(whole, other)


def test_sweep_merge_and_replay_on_the_command_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cli, "use_cache", lambda: None)
    tuned = tmp_path / "tuned.json"
    tuned.write_text(json.dumps({"L": 0.3}))
    run = str(tmp_path / "run")
    drums = tmp_path / "drums.json"
    drums.write_text(json.dumps({"objects": ["random_cylinder"], "distance": [1, 2]}))
    command = ["sweep", "--domain", str(drums), "--engine", "fused", "--fidelity", "fast",
               "--worlds", "12", "--strategies", "rps", "--params", "paper", str(tuned),
               "--horizon", "6", "--part", "5", "--slots", str(SLOTS), "--out", run]  # fmt: skip
    assert cli.main([*command, "--shard", "1/2"]) == 0
    assert cli.main([*command, "--shard", "2/2"]) == 0
    assert cli.main(["merge", run, "--out", run]) == 0
    text = capsys.readouterr().out
    assert "rps tuned against rps paper" in text
    results = files.read_results(Path(run))
    assert results.arm.values.tolist() == ["rps paper", "rps tuned"]
    assert cli.main(["merge", run, "--out", str(tmp_path / "there")]) == 0
    for folder, name in product(("run", "there"), ("report.html", "report.md", "success.png")):
        assert (tmp_path / folder / name).exists()
    assert sweep.load_plan(tmp_path / "there") == sweep.load_plan(Path(run))
    other = sweep.open_run(tmp_path / "other", PLAN)
    assert cli.main(["merge", run, "--out", str(other)]) == 2
    assert "other holds another run (domain.objects = " in capsys.readouterr().err
    assert not (other / "results.nc").exists()
    assert cli.main(["replay", run, "4", "--arm", "rps tuned"]) == 0
    seen = files.read(Path(run) / "replay-4" / "results.nc")
    # Followed alone, in another batch than in the sweep.
    assert float(seen.outcome_time) == pytest.approx(float(results.time[1, 4]), abs=0.5)
