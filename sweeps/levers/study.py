"""The effect of single changes on the speed of a program.

A lever is a change of the physics, of what a step does, or of how the program is compiled. Some
change outcomes: which of them may be had is for the study of fidelity to say, not for a clock.

    rps sweeps/levers --program "fused standard" --worlds 64
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import engines, errors
from rps_jax.analysis.figures.style import Figure
from rps_jax.analysis.report import Picture, Section
from rps_jax.engines.base import ControlPeriod, Driven, Motion
from rps_jax.record.options import option
from rps_jax.runs.question import Run, call_of
from rps_jax.trials.progress import Progress
from sweeps import programs
from sweeps.programs import Program
from sweeps.study_base import Study


class Lever(NamedTuple):
    """Change to a program of `programs.BATCHED`."""

    physics: Mapping[str, Any] = {}  # fields of `Physics` to change
    stage: Callable[[Any], Any] = lambda stage: stage
    donated: bool = True
    flags: dict[str, Any] | None = None  # of XLA
    worlds: float = 1.0  # times as many


class Unmoved(NamedTuple):
    """An engine without physics: the base goes, the object stays. What is left is the law's."""

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


def levers_of(name: str, family: str) -> dict[str, Lever]:
    """Return the levers of a program of `programs.BATCHED` on this machine."""
    engine = engines.get(programs.BATCHED[name].engine)
    levers = _OF_ALL | (_OF_SOLVERS if engine.newton else {})
    levers |= {label: Lever(stage=change) for label, change in engine.levers(family).items()}
    flags = _FLAGS.get(jax.default_backend(), {})
    return levers | {label: Lever(flags=values) for label, values in flags.items()}


class Gain(NamedTuple):
    """Effect of a lever on a program."""

    name: str
    family: str
    lever: str
    worlds: int
    compile: float  # [s] tracing too
    memory: float  # [bytes]
    rate: float  # simulated s per s of wall clock
    times: float  # as fast as the program without it, timed beside it


@dataclass(frozen=True)
class Levers(Study[xr.Dataset]):
    """Tell what each choice for speed is worth: one change at a time, timed beside the program.

    The answer holds, for each lever, how many times as fast the program is with it, `times` [1].
    """

    TITLE: ClassVar[str] = "What each choice for speed is worth"

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
    """Programs compiled side by side; what compiling takes is that of a program alone only if 1."""

    def check(self) -> None:
        """Check the name of the program."""
        errors.check_name("program", self.program, programs.BATCHED)

    def num_trials(self) -> int | None:
        """Return the number of programs."""
        return 1 + len(levers_of(self.program, self.family))

    def answer(self, run: Run) -> xr.Dataset:
        """Pull every lever."""
        how = {"simulated": self.simulated, "goes": self.goes, "at_once": self.at_once}
        gains: list[Gain] = []
        for gain in measure(self.program, self.family, self.worlds, **how):
            gains.append(gain)
            run.callback(Progress(len(gains), 0.0))
        columns: dict[str, Any] = {
            name: ("lever", [getattr(gain, name) for gain in gains])
            for name in ("worlds", "compile", "memory", "rate", "times")
        }
        return xr.Dataset(columns, {"lever": [gain.lever for gain in gains]})

    def intro(self, results: xr.Dataset) -> str:
        """Describe the machine."""
        return programs.machine()

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Return the gain of each lever."""
        title = f"{self.program}, {self.family}"
        times = dict(zip(map(str, results.lever.values), map(float, results.times), strict=True))
        gains = [
            Gain(
                self.program,
                self.family,
                str(row.lever.item()),
                *(row[name].item() for name in ("worlds", "compile", "memory", "rate", "times")),
            )
            for row in (results.sel(lever=name) for name in results.lever.values)
        ]
        picture = Picture("levers", partial(levers_figure, times, title))
        return [Section(title, "", table(gains), picture)]


levers = call_of(Levers)


BASELINE = "as it is"


def measure(
    name: str,
    family: str,
    worlds: int,
    *,
    simulated: float = 2.0,
    goes: int = 5,
    at_once: int = 1,
) -> Iterator[Gain]:
    """Time a program of `programs.BATCHED` without a lever, then with each lever.

    The baseline and the changed program alternate, `goes` times each, since the speed of a shared
    machine varies; the gain is the median of the ratios.

    Args:
      name: of `programs.BATCHED`.
      family: of its worlds.
      worlds: their number, unless a lever changes it.
      simulated: [s] of each run.
      goes: runs of each program.
      at_once: concurrent compilations; compile times are exact only if 1.
    """
    levers = {BASELINE: Lever()} | levers_of(name, family)
    calls = [partial(_traced, name, family, worlds, lever, simulated) for lever in levers.values()]
    baseline = None
    for label, program in zip(levers, programs.side_by_side(calls, at_once), strict=True):
        baseline = baseline or program
        yield _gain(label, baseline, program, goes)


def _traced(
    name: str, family: str, worlds: int, lever: Lever, simulated: float
) -> Callable[[], Program]:
    setting = programs.BATCHED[name]
    changed = replace(setting, physics=replace(setting.physics, **lever.physics))
    count = max(1, round(worlds * lever.worlds))
    how = {"stage": lever.stage, "donated": lever.donated, "flags": lever.flags}
    return programs.traced(name, changed, family, count, simulated=simulated, **how)


def _rate(program: Program) -> float:
    """Return the simulated time per wall-clock time of one run from the start."""
    start = jax.block_until_ready(jax.tree.map(jnp.copy, program.start))
    start_time = time.perf_counter()
    jax.block_until_ready(program.go(start))
    return program.worlds * program.simulated / (time.perf_counter() - start_time)


def _gain(label: str, baseline: Program, p: Program, goes: int) -> Gain:
    """Return the gain of a program over the baseline, without the first run of each."""
    rates = [(_rate(baseline), _rate(p)) for _ in range(goes + 1)][1:]
    rate = statistics.median(new_rate for _, new_rate in rates)
    times = statistics.median(new_rate / base_rate for base_rate, new_rate in rates)
    return Gain(p.name, p.family, label, p.worlds, p.compile, p.memory, rate, times)


def table(gains: Sequence[Gain]) -> list[list[str]]:
    """Header, and one row for each lever."""
    rows = [["what", "family", "lever", "worlds", "simulated s/s", "times", "compile", "memory"]]
    for g in gains:
        rows.append(
            [g.name, g.family, g.lever, f"{g.worlds}", f"{g.rate:,.0f}", f"{g.times:.2f}",
             f"{g.compile:.1f} s", f"{g.memory / 2**20:,.1f} MiB"]
        )  # fmt: skip
    return rows


def levers_figure(gains: Mapping[str, float], title: str) -> Figure:
    """Draw the gain of each lever as bars from 1."""
    figure = Figure(figsize=(7.0, 1.2 + 0.28 * len(gains)), layout="constrained")
    ax = figure.subplots()
    times = np.array(list(gains.values()))
    rows = np.arange(len(gains))
    ax.barh(rows, times - 1, left=1, color=np.where(times >= 1, "C0", "C1"))
    for row, t in zip(rows, times, strict=True):
        ax.annotate(
            f"{t:.2f}", (t, row), (3 if t >= 1 else -3, 0), textcoords="offset points",
            va="center", ha="left" if t >= 1 else "right", fontsize=8,
        )  # fmt: skip
    ax.axvline(1, color="k", lw=0.8)
    ax.set_yticks(rows, list(gains))
    ax.invert_yaxis()
    ax.set(xscale="log", xlabel="times as fast", title=title)
    ax.margins(x=0.15)
    low, high = ax.get_xlim()
    ticks = [t for t in (0.1, 0.2, 0.3, 0.5, 0.7, 1, 1.5, 2, 3, 5, 7, 10, 20) if low <= t <= high]
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    ax.minorticks_off()
    ax.grid(alpha=0.3, axis="x")
    ax.set_axisbelow(True)
    return figure
