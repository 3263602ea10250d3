"""Benchmarks: timed programs, profiles, and speeds relative to C MuJoCo in closed loop."""

import os
import subprocess
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from helpers import refusing
from numpy.testing import assert_allclose

from rps_jax import __version__
from rps_jax.control.observation import Twist
from rps_jax.engines import mjx_colliders
from rps_jax.engines.base import ControlPeriod
from rps_jax.engines.mjx_colliders import mjx
from rps_jax.engines.quasistatic import Quasistatic
from rps_jax.record import provenance
from rps_jax.runs.question import Run
from rps_jax.trials import pushes, trial
from rps_jax.trials.case import Case
from rps_jax.trials.progress import no_progress
from rps_jax.trials.setting import Setting
from rps_jax.world import scene
from rps_jax.world.physics import preset
from rps_jax.world.scene import FRICTION
from sweeps import programs
from sweeps.levers import study as levers
from sweeps.speed import commands, costs, gpus, kernel, robot
from sweeps.speed import study as speeds


def test_a_program_is_timed_and_compared_with_c_in_the_closed_loop():
    setting = programs.BATCHED["quasistatic"]
    program = programs.traced("quasistatic", setting, "cylinder", 2, simulated=0.1)()
    speed = speeds.batched(program)
    assert (speed.name, speed.family, speed.worlds) == ("quasistatic", "cylinder", 2)
    assert 0 < speed.rate < np.inf

    in_c = speed._replace(name="C in closed loop", rate=2.0)
    both = [xr.Dataset(row._asdict()) for row in (in_c, speed._replace(rate=5.0))]
    header, first, second = speeds.table(xr.concat(both, "measurement"))
    ratio = header.index("against C in closed loop")
    assert (first[ratio], second[ratio]) == ("1", "2.5")


def test_a_profile_assigns_time_to_the_calling_functions():
    profile = costs.measure("quasistatic", "cylinder", 2, steps=1)
    assert profile.step > 0
    assert sum(cost.share for cost in profile.costs) == pytest.approx(1.0)
    assert profile.timed == pytest.approx(sum(cost.time for cost in profile.costs))
    wheres = [cost.where for cost in profile.costs]
    assert len(set(wheres)) == len(wheres)
    for file in ("engines/quasistatic.py", "control/laws/rps.py", "trials/trial.py"):
        assert any(where.startswith(file) for where in wheres)
    assert len(costs.table([profile], count=3)) == 1 + 3


def test_nsight_counters_become_a_row():
    """The row is that of the last launch; output of the program before the table is skipped."""
    names = ["ID", *kernel._COUNTERS]
    units = ["", "ns", *[""] * (len(names) - 2)]
    waits = ["5.0", "1.6", "1.1", "0.5", "0.4", "0.0"]
    launches = [
        ["0", *["1"] * (len(names) - 1)],
        ["1", "67,000,000", "2,000,000,000", "2,000", "251", *waits],
    ]
    lines = [",".join(f'"{x}"' for x in row) for row in (names, units, *launches)]
    counts = kernel.counts("\n".join(["==PROF== Connected", "success", *lines]))
    whole = counts.expand_dims(family=["box"])
    (table,) = kernel.Kernel(families=("box",)).report_tables(whole)
    _, row = table.rows
    assert row == [
        "box",
        "16,384",
        "134 µs",
        "2,000",
        "251",
        "5.0",
        "1.6",
        "1.1",
        "0.5",
        "0.4",
        "0.0",
        "1.4",
    ]
    with refusing("profiled no launch: ==ERROR== No kernels"):
        kernel.counts("==ERROR== No kernels")


@pytest.mark.slow
def test_levers_are_timed_against_the_unchanged_program(monkeypatch):
    names = ("no physics: law, skin, rules", "four times the worlds", "state not donated")
    all_levers = levers.levers_of("quasistatic", "cylinder")
    monkeypatch.setattr(levers, "levers_of", lambda *_: {name: all_levers[name] for name in names})
    study = levers.Levers("quasistatic", "cylinder", 4, simulated=0.1, goes=1)
    gains = study()
    assert gains.lever.values.tolist() == [levers.BASELINE, *names]
    assert gains.worlds.values.tolist() == [4, 4, 16, 4]
    assert ((gains.times > 0) & (gains.times < np.inf)).all()
    (table,) = study.report_tables(gains)
    assert len(table.rows) == 1 + gains.sizes["lever"]


def test_without_physics_the_base_moves_and_the_object_stays():
    cases = [Case("box", FRICTION["S1"], (2.0, 0.0), gap=0)]
    _, worlds, _, params = pushes.build(cases, Setting(engine="mjx"))
    start = trial.motion(trial.start_all(worlds, params, np.ones(1, bool)))
    twists = Twist(*(np.full(1, x) for x in (0.05, 0.0, 0.0)))
    driven = levers.Unmoved().drive(worlds.fields, start, ControlPeriod(twists, preset()))
    moved = np.asarray(driven.motion.qpos - start.qpos)[0]
    assert_allclose(moved, [0.05 * 0.02, *[0] * 9], atol=1e-9)


def test_a_program_is_retraced_for_each_lever():
    """A lever may change global state of MJX, which no argument shows."""
    calls = []

    class RecordingStage(NamedTuple):
        native = False

        def drive(self, *args):
            calls.append(args)
            return Quasistatic().drive(*args)

    counts = []
    for _ in range(2):
        options = {"simulated": 0.1, "stage": lambda _: RecordingStage()}
        setting = programs.BATCHED["quasistatic"]
        programs.traced("quasistatic", setting, "cylinder", 2, **options)
        counts.append(len(calls))
    assert counts[1] == 2 * counts[0] > 0


def test_contacts_of_a_box_as_a_prism_equal_those_of_mjx():
    at = scene.load("box")
    model, blank = mjx.put_model(at.physics), mjx.make_data(at.physics)
    starts = [scene.initial_qpos(at, -0.001, yaw) for yaw in (0.0, 0.3)]

    def contacts_of(collide):
        @jax.jit
        @jax.vmap
        def contacts(qpos):
            return collide(model, mjx.kinematics(model, blank.replace(qpos=qpos)))

        return jax.device_get(contacts(jnp.asarray(starts, jnp.float32))._impl.contact)

    def deepest(contact):
        robot = contact.geom1[0] != at.physics.geom("ground").id
        least = np.argmin(contact.dist[:, robot], axis=1)
        both = np.arange(len(starts))
        return contact.dist[:, robot][both, least], contact.frame[:, robot][both, least, 0]

    ours, theirs = contacts_of(mjx_colliders.collision), contacts_of(mjx.collision)
    assert ours.dist.shape == theirs.dist.shape == (2, 8)
    for mine, reference in zip(deepest(ours), deepest(theirs), strict=True):
        assert_allclose(mine, reference, atol=1e-6)


def test_whole_commands_are_timed_twice_per_gpu_count(monkeypatch):
    provenance.git_commit()  # starts a process once
    launches = []

    class Process:
        pid, kill = 0, print

        def __init__(self, words, env, stdout, stderr):
            assert "JAX_PLATFORMS" not in env
            launches.append((words[2:6], env["RPS_CACHE"], env["CUDA_VISIBLE_DEVICES"]))
            stdout.write("compile 1.5 s, run 2.0 s (1234 simulated s per s)")

    used = SimpleNamespace(ru_maxrss=2**20)  # KiB
    monkeypatch.setattr(subprocess, "Popen", Process)
    monkeypatch.setattr(os, "wait4", lambda pid, options: (pid, 0, used))
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")  # of the process that times them
    study = commands.Commands(("push --seed 1",), (1, 2))
    results = study()
    names = [f"`rps push --seed 1`, {gpus}" for gpus in ("one GPU", "2 GPUs")]
    assert results.command.values.tolist() == names
    words, caches, gpus = zip(*launches, strict=True)
    assert gpus == ("0", "0", "0,1", "0,1")
    assert caches[0] == caches[1] != caches[2]  # an empty cache
    assert words[0] == ["rps_jax", "push", "--seed", "1"]
    (table,) = study.report_tables(results)
    assert table.rows[2][3:] == ["1.5 s", "2.0 s", "1,234", "1.1 GB", "1.1 GB"]


def test_sweeps_are_timed_on_the_gpus_of_the_host(monkeypatch):
    calls = []

    def printed(words, label, folder, limit, count, environment):
        calls.append((label, count))
        assert environment is None or environment["PYTHONPATH"].startswith("checkouts/0.4.0:")
        segments = [[0, 1.0, 2.0, 4000, 3000, 0], [0, 1.5, 2.0, 4, 0, 0], [1, 1.0, 4.0, 9, 0, 0]]
        segments = [x for x in segments if x[0] < count]
        traced = f"a line\n{segments}\n"
        return traced if words[0] == "-c" else "compile 0.2 s, run 3.0 s (900 simulated s per s)", 1

    monkeypatch.setattr(gpus, "printed", printed)
    sweeps = ("5:1", "20:1", "20:2", "10:2", "10:1", "10:2:checkouts/0.4.0")
    study = gpus.Gpus(sweeps=sweeps)
    (table,) = study.report_tables(study.answer(Run(None, no_progress)))
    own, other = __version__, "0.4.0"
    assert [row[:3] for row in table.rows[1:]] == [
        ["5", "1", own],
        ["20", "1", own],
        ["20", "2", own],
        ["10", "2", own],
        ["10", "1", own],
        ["10", "2", other],
    ]
    assert [row[-1] for row in table.rows[1:]] == ["", "", "", "50 %", "50 %", ""]
    assert [bool(row[4]) for row in table.rows[1:]] == [True, True, True, True, True, False]
    assert sorted(count for label, count in calls if "horizon" in label) == [1, 1, 1, 2, 2, 2]
    assert sum("segment" in label for label, _ in calls) == 2
    assert table.picture.png()
    for text in ("1000", "1000:0", "a:1", "1000:1:"):
        with refusing("write WORLDS:GPUS"):
            gpus.Gpus(sweeps=(text,)).validate()


def test_step_times_on_a_robot_are_parsed_from_the_examples_output(monkeypatch):
    printed = "500 steps: median 146 us, 99.9th percentile 2512 us, worst 9041 us; "
    printed += "0.60% took longer than 1 ms"
    ended = subprocess.CompletedProcess([], 0, printed, "")
    monkeypatch.setattr(subprocess, "run", lambda *_, **how: ended)
    (table,) = robot.OnARobot().report_tables(robot.on_a_robot(1))
    assert table.rows[1:] == [["1", "146 µs", "2.5 ms", "9.0 ms", "0.6 %"]]
