"""How fast is it? Simulated seconds in a second of wall clock, by engine, shape family and batch.

Every world is being pushed while it is timed, from the first step: the base begins at the object,
and no trial has ended.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np

from rps_jax import engines
from rps_jax.control import strategies
from rps_jax.control.law import RPSParams
from rps_jax.trials import host, pushes, trial
from rps_jax.trials.batch import Job, run
from rps_jax.trials.pushes import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules, Trial, World
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.world import draws, paper
from rps_jax.world.domain import DOMAINS, Range
from rps_jax.world.physics import MUJOCOS_GROUND, Physics, preset
from rps_jax.world.scene import FRICTION, JOINTS

FAMILIES = ("box", "cylinder", "prism")
_SPEED = 0.05  # [m/s] at which C MuJoCo alone pushes
_PRISMS = replace(
    DOMAINS["paper"], objects=("random_prism",), frictions=(FRICTION["S1"],), gap=Range(0.0, 0.0)
)
_MUJOCOS_OWN = Physics(
    timestep=0.002,
    cone="pyramidal",
    impratio=1.0,
    iterations=100,
    ls_iterations=50,
    tolerance=1e-8,
    **MUJOCOS_GROUND,
)
# What is timed: batched on JAX's device, and C MuJoCo on the processor.
BATCHED = {
    "fused standard": Setting(engine="fused"),
    "fused fast": Setting(engine="fused", physics=preset(fidelity="fast")),
    "warp standard": Setting(engine="warp"),
    "warp fast": Setting(engine="warp", physics=preset(fidelity="fast")),
    "quasistatic": Setting(engine="quasistatic"),
    "mjx standard": Setting(),
    "mjx fast": Setting(physics=preset(fidelity="fast")),
    "mjx, MuJoCo's defaults": Setting(physics=_MUJOCOS_OWN),
}
# The second steps by MuJoCo's `rollout`; the third is how trials are run one after the other.
IN_C = {
    "C in closed loop": "closed",
    "C, mj_step alone": "open",
    "C, one trial at a time": "serial",
}
NAMES = (*BATCHED, *IN_C)


def here() -> tuple[str, ...]:
    """Those of `NAMES` that this machine can run."""
    return tuple(n for n in NAMES if n in IN_C or engines.get(BATCHED[n].engine).works())


@dataclass(frozen=True)
class Speed:
    """One measurement."""

    name: str
    family: str
    worlds: int
    compile: float  # [s] tracing too
    rate: float  # simulated s per s of wall clock
    memory: float  # [bytes] of the program on its device; NaN for C
    contacts: int  # points of one world: those a program looks into, those C has found
    physics: Physics


def _worlds(family: str, count: int, setting: Setting) -> tuple[Any, World]:
    """Stage and worlds (count, ...): the paper's targets under S1, a box, a cylinder or prisms."""
    if family == "prism":
        drawn = draws.draw(_PRISMS, 0, np.arange(count))
        part = drawn_worlds(_PRISMS, drawn, RPSParams.paper(), setting)
        return part.stage, part.worlds
    targets = paper.TARGETS
    cases = [Case(family, FRICTION["S1"], targets[i % len(targets)], gap=0) for i in range(count)]
    return pushes.build(cases, setting)


def can(name: str, family: str) -> bool:
    """Whether this machine can run one of `NAMES` with a family."""
    return name in IN_C or engines.get(BATCHED[name].engine).works([family])


def _best(action: Callable[[], Any], goes: int = 4, enough: float = 5.0) -> float:
    """Least wall clock [s] of some goes; of fewer, once `enough` seconds have been spent."""
    times = []
    while len(times) < goes and sum(times) < enough:
        began = time.perf_counter()
        action()
        times.append(time.perf_counter() - began)
    return min(times)


def _contacts_in_c(model: mujoco.MjModel, qpos: np.ndarray, seconds: float = 2.0) -> int:
    """Most points that C MuJoCo finds while a base pushes straight on."""
    data, most = mujoco.MjData(model), 0
    data.qpos[:] = qpos
    for _ in range(round(seconds / model.opt.timestep)):
        data.qvel[JOINTS.base] = [_SPEED, 0.0, 0.0]
        mujoco.mj_step(model, data)
        most = max(most, data.ncon)
    return most


class Program(NamedTuple):
    """What is timed on JAX's device: a full batch, `simulated` [s] of each world at a go."""

    name: str
    family: str
    worlds: int
    simulated: float
    compile: float  # [s]
    memory: float  # [bytes] of its arguments, results and all in between
    contacts: int
    physics: Physics
    go: Callable[[Trial], Trial]
    start: Trial
    text: Callable[[], str | None]  # of the compiled program, if it has one


def traced(
    name: str,
    setting: Setting,
    family: str,
    worlds: int,
    *,
    simulated: float = 2.0,
    stage: Callable[[Any], Any] = lambda stage: stage,
    donated: bool = True,
    flags: dict[str, Any] | None = None,
) -> Callable[[], Program]:
    """What compiles a program that has been traced.

    Args:
      name: of the program, for tables.
      setting: physics and engine.
      family: of the worlds.
      worlds: how many.
      simulated: [s] of each world at a go.
      stage: changes the engine's stage.
      donated: whether the state of the worlds is overwritten at each go.
      flags: of XLA.
    """
    physics = setting.physics
    usual, few = _worlds(family, len(paper.TARGETS), setting)
    rows = np.arange(worlds) % len(paper.TARGETS)
    batch = jax.device_put(jax.tree.map(lambda leaf: leaf[rows], few))
    start = trial.start_all(batch, np.ones(worlds, bool))
    shared, steps = stage(usual), round(simulated / physics.control_period)
    began = time.perf_counter()
    # Not as it is jitted: that gives back what it has traced before for such arguments.
    advance = partial(trial.advance.__wrapped__, physics=physics, steps=steps)
    lowered = jax.jit(advance, donate_argnums=2 if donated else ()).lower(shared, batch, start)
    tracing = time.perf_counter() - began

    def compile_() -> Program:
        began = time.perf_counter()
        program = lowered.compile(compiler_options=flags)
        took = tracing + time.perf_counter() - began
        needs: Any = program.memory_analysis()
        parts = ("argument", "output", "temp")
        memory = sum(getattr(needs, f"{part}_size_in_bytes") for part in parts)
        corners = few.footprint.vertices.shape[-2]  # 1 of a cylinder
        contacts = engines.get(setting.engine).contacts(usual, corners)
        go = partial(program, shared, batch)
        return Program(
            name, family, worlds, simulated, took, memory, contacts, physics, go, start,
            program.as_text,
        )  # fmt: skip

    return compile_


def side_by_side(
    programs: Sequence[Callable[[], Callable[[], Program]]], at_once: int
) -> Iterator[Program]:
    """Programs in their order, `at_once` of them compiled side by side.

    Each call is of `traced`, and is made when its turn has come, one after the other. While the
    caller holds a program nothing is compiled, so that it can be timed.
    """
    with ThreadPoolExecutor(at_once) as pool:
        for first in range(0, len(programs), at_once):
            jobs = [pool.submit(trace()) for trace in programs[first : first + at_once]]
            wait(jobs)
            for job in jobs:
                yield job.result()


def batched(program: Program) -> Speed:
    """Time a program."""
    state = [program.start]

    def once() -> None:
        state[0] = jax.block_until_ready(program.go(state[0]))

    once()  # in which MJX-Warp builds its kernels
    rate = program.worlds * program.simulated / _best(once)
    name, family, worlds, _, took, memory, contacts, physics, *_ = program
    return Speed(name, family, worlds, took, rate, memory, contacts, physics)


def in_c(name: str, family: str, simulated: float = 2.0) -> Speed:
    """Time C MuJoCo: on all cores in the closed loop of the law or stepping alone, or one trial."""
    physics = preset()
    how = IN_C[name]
    threads = 1 if how == "serial" else os.cpu_count() or 1
    worlds = 1 if how == "serial" else 64 * threads
    setting, engine = Setting(engine="mujoco", physics=physics), engines.get("mujoco")
    stage, batch = _worlds(family, worlds, setting)
    if how != "open":
        options = {"strategy": strategies.RPS, "threads": threads, "report": lambda *_: True}
        rules = Rules(horizon=simulated)

        def once() -> None:
            host.run(engine, stage, batch, physics=physics, rules=rules, **options)

    else:
        stepper = engine.stepper(stage, np.asarray(batch.qpos, float), threads)
        twist = np.tile([_SPEED, 0.0, 0.0], (worlds, 1))
        once = partial(stepper.drive, np.arange(worlds), twist, round(simulated / physics.timestep))
    once()  # compiles the law
    rate = worlds * simulated / _best(once)
    contacts = _contacts_in_c(stage[0], np.asarray(batch.qpos[0]))
    return Speed(name, family, worlds, 0.0, rate, np.nan, contacts, physics)


class Refilling(NamedTuple):
    """What refilling the slots of trials that ended is worth."""

    refilled: float  # simulated s per s of wall clock
    waiting: float  # the same, of batches that wait for their slowest
    trials: float  # per s of wall clock, refilled


def refilling(slots: int, rounds: int = 4) -> Refilling:
    """Whole trials of RPS, with refilled slots and in batches that wait for their slowest.

    Both run the same random boxes of the domain `wide`, `rounds` times as many as there are slots.
    """
    setting = BATCHED["fused standard"]
    boxes = replace(DOMAINS["wide"], objects=("random_box",))
    count = (
        slots
        * engines.get(setting.engine).workers(jax.default_backend())
        * len(jax.local_devices())
    )

    def timed(groups: np.ndarray) -> tuple[float, float]:
        timings = []
        for group in groups:
            drawn = draws.draw(boxes, 0, group)
            part = drawn_worlds(boxes, drawn, RPSParams.paper(), setting)
            job = Job(strategies.RPS, group.size, [part])
            timings.append(run([job], setting, slots=slots, collect=lambda *_: None))
        wall = sum(t.run for t in timings)
        return sum(t.simulated for t in timings) / wall, groups.size / wall

    numbers = np.arange(rounds * count)
    timed(numbers[None, :count])  # compiles
    refilled, trials = timed(numbers[None])
    return Refilling(refilled, timed(numbers.reshape(rounds, count))[0], trials)


def machine() -> str:
    """What a table of speeds begins with."""
    return f"On {jax.devices()[0].device_kind}, {os.cpu_count()} processors.\n\n"


def table(speeds: list[Speed]) -> list[list[str]]:
    """Header and one row for each measurement, compared with C MuJoCo in closed loop."""
    base = {s.family: s.rate for s in speeds if s.name == "C in closed loop"}
    rows = [["what", "family", "worlds", "dt", "iterations", "contacts", "compile", "simulated s/s",
             "against C in closed loop", "memory"]]  # fmt: skip
    for s in speeds:
        memory = "" if np.isnan(s.memory) else f"{s.memory / 2**20:,.1f} MiB"
        ratio = f"{s.rate / base[s.family]:.3g}" if s.family in base else ""
        solver = f"{s.physics.iterations}/{s.physics.ls_iterations}"
        rows.append(
            [s.name, s.family, f"{s.worlds}", f"{1000 * s.physics.timestep:g} ms", solver,
             f"{s.contacts}", f"{s.compile:.1f} s", f"{s.rate:,.0f}", ratio, memory]
        )  # fmt: skip
    return rows
