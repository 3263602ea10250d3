"""Programs whose speed is measured: every world is being pushed from the first step.

The base starts at the object, and no trial ends while a program is timed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from rps_jax import engines
from rps_jax.control.base import LawParams
from rps_jax.control.laws.rps import RPSParams
from rps_jax.engines import device
from rps_jax.trials import pushes, trial
from rps_jax.trials.batch import WorldBatch, rows
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Trial, World
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.world import draws, paper
from rps_jax.world.domain import DOMAINS, Range
from rps_jax.world.physics import MUJOCOS_GROUND, Physics, preset
from rps_jax.world.scene import FRICTION

FAMILIES = ("box", "cylinder", "prism")
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
# What is timed, batched on JAX's device.
BATCHED = {
    "fused standard": Setting(engine="fused"),
    "fused fast": Setting(engine="fused", physics=preset(fidelity="fast")),
    "quasistatic": Setting(engine="quasistatic"),
    "mjx standard": Setting(engine="mjx"),
    "mjx fast": Setting(physics=preset(fidelity="fast"), engine="mjx"),
    "mjx, MuJoCo's defaults": Setting(physics=_MUJOCOS_OWN, engine="mjx"),
}


def timed_worlds(family: str, count: int, setting: Setting) -> WorldBatch:
    """Return worlds with the paper's targets under S1: of a box, of a cylinder or of prisms."""
    if family == "prism":
        drawn = draws.draw(_PRISMS, 0, np.arange(count))
        return drawn_worlds(_PRISMS, drawn, setting).with_params(RPSParams.paper())
    targets = paper.TARGETS
    cases = [Case(family, FRICTION["S1"], targets[i % len(targets)], gap=0) for i in range(count)]
    return pushes.build(cases, setting)


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
    few = timed_worlds(family, len(paper.TARGETS), setting)
    usual, which = few.stage, np.arange(worlds) % len(paper.TARGETS)
    batch, params = jax.device_put(rows((few.worlds, few.params), which))
    start = trial.start_all(batch, params, np.ones(worlds, bool))
    shared, steps = stage(usual), round(simulated / physics.control_period)
    began = time.perf_counter()

    # A new one: what was jitted before gives back what it has traced for such arguments.
    def advance(stage: Any, worlds: World, params: LawParams, trials: Trial) -> Trial:
        batches = (stage,), (worlds,), (params,), (trials,)
        return trial.advance(*batches, ControlLoop(physics), steps)[0]

    given = shared, batch, params, start
    lowered = jax.jit(advance, donate_argnums=3 if donated else ()).lower(*given)
    tracing = time.perf_counter() - began

    def compile_() -> Program:
        began = time.perf_counter()
        program = lowered.compile(compiler_options=flags)
        took = tracing + time.perf_counter() - began
        needs: Any = program.memory_analysis()
        parts = ("argument", "output", "temp")
        memory = sum(getattr(needs, f"{part}_size_in_bytes") for part in parts)
        corners = few.worlds.footprint.vertices.shape[-2]  # 1 of a cylinder
        contacts = engines.get(setting.engine).contacts(usual, corners)
        go = partial(program, shared, batch, params)
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


def machine() -> str:
    """Where speeds were measured, in a sentence."""
    return f"On {jax.devices()[0].device_kind}, {device.count_processors()} processors."
