"""Programs whose speed is measured: every world is being pushed from the first step.

The base starts at the object, and no trial ends while a program is timed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from rps_jax import Range, RPSParams, Setting, draw_worlds
from rps_jax.laws import LawParams
from rps_jax.physics import FRICTION, preset
from rps_jax.trials import pushes, trial
from rps_jax.trials.trial import ControlLoop, Trial, World
from rps_jax.world import paper
from rps_jax.worlds import Case, parse_domain

FAMILIES = ("box", "cylinder", "prism")
_PRISMS = replace(
    parse_domain("paper"),
    objects=("random_prism",),
    frictions=(FRICTION["S1"],),
    gap=Range(0.0, 0.0),
)
# Timed programs, batched on JAX's device.
BATCHED = {
    "fused standard": Setting(engine="fused"),
    "fused fast": Setting(engine="fused", physics=preset(fidelity="fast")),
    "quasistatic": Setting(engine="quasistatic"),
    "mjx standard": Setting(engine="mjx"),
}


def timed_worlds(family: str, count: int, setting: Setting) -> Any:
    """Return worlds with boxes, cylinders or prisms at the paper's targets under S1."""
    if family == "prism":
        return draw_worlds(_PRISMS, count, setting=setting).with_params(RPSParams.paper())
    targets = paper.TARGETS
    cases = [Case(family, FRICTION["S1"], targets[i % len(targets)], gap=0) for i in range(count)]
    return pushes.build(cases, setting)


class Program(NamedTuple):
    """Compiled program for a batch of worlds, which simulates `simulated` seconds per call."""

    name: str
    family: str
    worlds: int
    simulated: float
    go: Callable[[Trial], Trial]
    start: Trial
    text: Callable[[], str | None]  # HLO of the compiled program, if available


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
    """Trace a program and return the function that compiles it.

    Args:
      name: name of the program in tables.
      setting: physics and engine.
      family: shape family of the objects.
      worlds: number of worlds.
      simulated: simulated time of each world per call [s].
      stage: function that changes the engine's stage.
      donated: whether a call overwrites the state of the worlds.
      flags: flags of XLA.
    """
    physics = setting.physics
    cases = timed_worlds(family, len(paper.TARGETS), setting)
    indices = np.arange(worlds) % len(paper.TARGETS)
    inputs = jax.tree.map(lambda x: x[indices], (cases.worlds, cases.params))
    batch, params = jax.device_put(inputs)
    start = trial.start_all(batch, params, np.ones(worlds, bool))
    shared, steps = stage(cases.stage), round(simulated / physics.control_period)

    # A new function for each call: jax.jit caches the trace of a function by its arguments.
    def advance(stage: Any, worlds: World, params: LawParams, trials: Trial) -> Trial:
        batch = stage, worlds, params, trials
        return trial.advance([batch], ControlLoop(physics), steps)[0]

    arguments = shared, batch, params, start
    lowered = jax.jit(advance, donate_argnums=3 if donated else ()).lower(*arguments)

    def compile_program() -> Program:
        program = lowered.compile(compiler_options=flags)
        go = partial(program, shared, batch, params)
        return Program(name, family, worlds, simulated, go, start, program.as_text)

    return compile_program


def side_by_side(
    programs: Sequence[Callable[[], Callable[[], Program]]], at_once: int
) -> Iterator[Program]:
    """Yield the programs of some calls of `traced`, compiling `at_once` of them in parallel.

    Nothing compiles while the caller has a program, so that the caller can time it.
    """
    with ThreadPoolExecutor(at_once) as pool:
        for i in range(0, len(programs), at_once):
            jobs = [pool.submit(trace()) for trace in programs[i : i + at_once]]
            wait(jobs)
            for job in jobs:
                yield job.result()
