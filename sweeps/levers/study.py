"""The effect of single changes on the speed of a program.

A lever is a change of the physics, of what a step does, or of how the program is compiled. Some
change outcomes: which of them may be had is for the study of fidelity to say, not for a clock.

    rps sweeps/levers --program "fused standard" --worlds 64
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Literal, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import xarray as xr

from rps_jax.engines.base import Driven
from rps_jax.engines.mjx import MJXStage
from rps_jax.engines.mjx_colliders import COLLIDERS, mjx
from rps_jax.physics import ControlPeriod, Motion
from rps_jax.questions import Run, call_of, option
from rps_jax.trials.progress import Progress
from sweeps import programs
from sweeps.programs import Program
from sweeps.study_base import SpeedStudy, Table, records, text_table


class Lever(NamedTuple):
    """Change to a program of `programs.BATCHED`."""

    physics: Mapping[str, Any] = {}  # fields of `Physics` to change
    stage: Callable[[Any], Any] = lambda stage: stage
    donated: bool = True
    flags: dict[str, Any] | None = None  # of XLA
    worlds: float = 1.0  # times as many


class Unmoved(NamedTuple):
    """An engine without physics: the base goes, the object stays. What is left is the law's."""

    native = False

    def drive(self, fields: Any, motion: Motion, period: ControlPeriod) -> Driven:
        """Step a batch for one control period."""
        turn = jax.vmap(lambda twist, yaw: twist.in_world(yaw))
        ahead = period.physics.control_period * turn(period.twists, motion.qpos[:, 2])
        return Driven(motion._replace(qpos=motion.qpos.at[:, :3].add(ahead)))


_OF_ALL = {
    "no physics: law, skin, rules": Lever(stage=lambda _: Unmoved()),
    "steps of 5 ms": Lever({"timestep": 0.005}),
    "steps of 20 ms": Lever({"timestep": 0.02}),
    "a decision in 10 ms": Lever({"control_period": 0.01}),
    "a decision in 40 ms": Lever({"control_period": 0.04}),
    "a quarter of the worlds": Lever(worlds=0.25),
    "four times the worlds": Lever(worlds=4.0),
    "state not donated": Lever(donated=False),
}
_OF_SOLVERS = {
    "friction pyramid": Lever({"cone": "pyramidal"}),
    "4 solver iterations": Lever({"iterations": 4}),
    "16 solver iterations": Lever({"iterations": 16}),
    "5 line-search steps": Lever({"ls_iterations": 5}),
    "20 line-search steps": Lever({"ls_iterations": 20}),
}
_FLAGS = {
    "cpu": {
        "XLA: older emitters": {"xla_cpu_use_fusion_emitters": False},
        "XLA: vectors of 128 bits": {"xla_cpu_prefer_vector_width": 128},
        "XLA: LLVM's level 1": {"xla_backend_optimization_level": 1},
    },
    "gpu": {
        "XLA: no command buffers": {"xla_gpu_enable_command_buffer": ""},
        "XLA: loops double-buffered": {"xla_gpu_enable_while_loop_double_buffering": True},
        "XLA: no autotuning": {"xla_gpu_autotune_level": 0},
    },
}


def _sparse(stage: MJXStage) -> MJXStage:
    """Return the stage with a sparse inertia matrix."""
    model: Any = stage.model.tree_replace({"opt.jacobian": mjx.JacobianType.SPARSE})
    return stage._replace(model=model, data=mjx.make_data(model))


class _TheirBoxes(MJXStage):
    """A stage with MJX's collider of boxes."""

    def drive(self, fields: Any, motion: Motion, period: ControlPeriod) -> Driven:
        """Step a batch for one control period."""
        with mock.patch.dict(COLLIDERS):
            del COLLIDERS[mjx.GeomType.BOX, mjx.GeomType.BOX]
            return super().drive(fields, motion, period)


def levers_of(name: str, family: str) -> dict[str, Lever]:
    """Return the levers of a program of `programs.BATCHED` on this machine."""
    engine = programs.BATCHED[name].engine
    # The quasi-static engine has its own solver.
    levers = _OF_ALL | (_OF_SOLVERS if engine != "quasistatic" else {})
    if engine == "mjx":
        levers |= {"sparse inertia matrix": Lever(stage=_sparse)}
    if engine == "mjx" and family == "box":
        levers |= {"MJX's own box collider": Lever(stage=lambda stage: _TheirBoxes(*stage))}
    flags = _FLAGS.get(jax.default_backend(), {})
    return levers | {label: Lever(flags=values) for label, values in flags.items()}


@dataclass(frozen=True)
class Levers(SpeedStudy[xr.Dataset]):
    """Tell what each choice for speed is worth: one change at a time, timed beside the program.

    The answer holds, for each lever, how many times as fast the program is with it, `times` [1].
    """

    TITLE = "What each choice for speed is worth"
    CHOICES: ClassVar = {"program": programs.BATCHED}

    program: str = "mjx standard"
    """Engine and fidelity, as those of `rps sweeps/speed`."""
    family: Literal["box", "cylinder", "prism"] = "box"
    """Family of the objects: box, cylinder or prism."""
    worlds: int = option(24, 4, 10_000_000)
    """Number of worlds of the batch."""
    simulated: float = option(2.0, 0.04, 60, unit="s")
    """Time of each world that is stepped at a go [s]."""
    goes: int = option(5, 1, 1000)
    """Number of goes of each program."""
    at_once: int = option(1, 1, 1024)
    """Number of programs compiled at the same time."""

    def num_trials(self) -> int | None:
        """Return the number of programs."""
        return 1 + len(levers_of(self.program, self.family))

    def answer(self, run: Run) -> xr.Dataset:
        """Time the program without a lever, then with each lever.

        The baseline and the changed program alternate, `goes` times each, since the speed of a
        shared machine varies; the gain is the median of the ratios.
        """
        levers = {BASELINE: Lever()} | levers_of(self.program, self.family)
        calls = [partial(self._traced, lever) for lever in levers.values()]
        gains: list[xr.Dataset] = []
        baseline = None
        for label, program in zip(levers, programs.side_by_side(calls, self.at_once), strict=True):
            baseline = baseline or program
            gains.append(_gain(label, baseline, program, self.goes))
            run.callback(Progress(len(gains), 0.0))
        return xr.concat(gains, "lever")

    def _traced(self, lever: Lever) -> Callable[[], Program]:
        """Trace the program with a lever, and return the function that compiles it."""
        setting = programs.BATCHED[self.program]
        changed = replace(setting, physics=replace(setting.physics, **lever.physics))
        count = max(1, round(self.worlds * lever.worlds))
        how = {"stage": lever.stage, "donated": lever.donated, "flags": lever.flags}
        return programs.traced(
            self.program, changed, self.family, count, simulated=self.simulated, **how
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the gain of each lever."""
        rows = text_table(_COLUMNS, records(results, "lever"))
        return [Table(rows, title=f"{self.program}, {self.family}")]


levers = call_of(Levers)


BASELINE = "as it is"


def _rate(program: Program) -> float:
    """Return the simulated time per wall-clock time of one run from the start."""
    start = jax.block_until_ready(jax.tree.map(jnp.copy, program.start))
    start_time = time.perf_counter()
    jax.block_until_ready(program.go(start))
    return program.worlds * program.simulated / (time.perf_counter() - start_time)


def _gain(label: str, baseline: Program, p: Program, goes: int) -> xr.Dataset:
    """Return the gain of a program over the baseline, without the first run of each."""
    rates = [(_rate(baseline), _rate(p)) for _ in range(goes + 1)][1:]
    values = {
        "name": p.name,
        "worlds": p.worlds,
        "rate": statistics.median(rate for _, rate in rates),  # simulated s per s of wall clock
        "times": statistics.median(rate / base_rate for base_rate, rate in rates),
    }
    return xr.Dataset(values, {"lever": label})


_COLUMNS = {
    "what": "{name}",
    "lever": "{lever}",
    "worlds": "{worlds}",
    "simulated s/s": "{rate:,.0f}",
    "times": "{times:.2f}",
}
