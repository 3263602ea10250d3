"""Simulated seconds per second of wall clock, by engine, shape family and batch size.

    rps sweeps/speed --worlds 64 512

`rps sweeps/speed/costs.py` profiles a control step.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import numpy as np
import xarray as xr

from rps_jax import Rules, Setting
from rps_jax.analysis.figures.style import Figure, words
from rps_jax.engines.mujoco import Batch
from rps_jax.physics import preset
from rps_jax.questions import Picture, Run, call_of, option
from rps_jax.trials import trial
from rps_jax.trials.trial import ControlLoop
from sweeps import programs
from sweeps.programs import BATCHED, FAMILIES, Program
from sweeps.study_base import (
    QuickStudy,
    Rows,
    SpeedStudy,
    Table,
    part_name,
    records,
    run_parts,
    stored_parts,
)

_SPEED = 0.05  # [m/s] of a push in C MuJoCo without a law
# C MuJoCo on the processor: in the closed loop of a law, by MuJoCo's `rollout`, and one trial at a
# time.
IN_C = ("C in closed loop", "C, mj_step alone")
NAMES = (*BATCHED, *IN_C)


class Measurement(NamedTuple):
    """Speed of one program."""

    name: str
    family: str
    worlds: int
    rate: float  # simulated s per s of wall clock


@dataclass(frozen=True)
class Speed(SpeedStudy[xr.Dataset], QuickStudy[xr.Dataset]):
    """Measure the speed of each engine on this machine, by shape family and batch size.

    The results hold simulated seconds per second of wall clock, `rate` [1], of each measurement.
    """

    TITLE = "Speed"
    CHOICES: ClassVar = {"names": NAMES, "families": FAMILIES}
    QUICK: ClassVar = {
        "names": ("C in closed loop", "fused standard", "quasistatic"),
        "families": ("box",),
        "worlds": (64,),
    }
    GROWS = ("names", "families", "worlds", "at_once")

    names: tuple[str, ...] = ()
    """Engines and fidelities; by default all."""
    families: tuple[Literal["box", "cylinder", "prism"], ...] = FAMILIES
    """Families of the objects: box, cylinder, prism."""
    worlds: tuple[int, ...] = option((64, 512), 1, 10_000_000)
    """Numbers of worlds of a batch."""
    at_once: int = option(1, 1, 1024)
    """Number of programs compiled at the same time."""

    @cached_property
    def entries(self) -> Sequence[tuple[str, str, int]]:
        """Name, family and number of worlds (0 in C, which chooses it) of all measurements."""
        named = list(product(self.names or NAMES, self.families))
        in_c = [(*pair, 0) for pair in named if pair[0] in IN_C]
        return in_c + [(*pair, n) for pair in named if pair[0] in BATCHED for n in self.worlds]

    def num_trials(self) -> int | None:
        """Return the number of measurements."""
        return len(self.entries)

    def answer(self, run: Run) -> xr.Dataset:
        """Make the measurements that are missing."""
        stored, by_part = stored_parts(run), {part_name(*entry): entry for entry in self.entries}
        missing = [entry for name, entry in by_part.items() if name not in stored]
        measurements = _measured(missing, self.at_once)
        parts = dict.fromkeys(by_part, lambda: xr.Dataset(next(measurements)._asdict()))
        return run_parts(run, "measurement", parts)

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return speeds beside C MuJoCo."""
        fields = ("family", "name", "worlds", "rate")
        points: list[Any] = [tuple(map(row.get, fields)) for row in records(results, "measurement")]
        picture = Picture("throughput", partial(throughput, points, IN_C))
        return [Table(table(results), title="Simulated seconds in a second", picture=picture)]


speed = call_of(Speed)


def _measured(entries: Sequence[tuple[str, str, int]], at_once: int) -> Iterator[Measurement]:
    """Yield the measurements in order, C first."""
    for name, family, _ in (entry for entry in entries if entry[0] in IN_C):
        yield in_c(name, family)
    batched_ = [entry for entry in entries if entry[0] in BATCHED]
    calls = [partial(programs.traced, n, BATCHED[n], *rest) for n, *rest in batched_]
    for program in programs.side_by_side(calls, at_once):
        yield batched(program)


def best(action: Callable[[], Any], goes: int = 4, limit: float = 5.0) -> float:
    """Return the shortest wall clock [s] of several runs; no run starts after `limit` seconds."""
    times = []
    while len(times) < goes and sum(times) < limit:
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return min(times)


def batched(program: Program) -> Measurement:
    """Time a program."""
    state = [program.start]

    def once() -> None:
        state[0] = jax.block_until_ready(program.go(state[0]))

    once()
    rate = program.worlds * program.simulated / best(once)
    return Measurement(program.name, program.family, program.worlds, rate)


def in_c(name: str, family: str, simulated: float = 2.0) -> Measurement:
    """Time C MuJoCo on all cores with or without the law."""
    physics, threads = preset(), len(os.sched_getaffinity(0))
    worlds = 64 * threads
    setting = Setting(engine="mujoco", physics=physics)
    part = programs.timed_worlds(family, worlds, setting)
    stage, batch = part.stage, part.worlds
    if name == IN_C[0]:
        loop = ControlLoop(physics, Rules(horizon=simulated))

        def once() -> None:
            steps = trial.run_on_host(setting.simulator, stage, batch, part.params, loop, threads)
            deque(steps, maxlen=0)

    else:
        stepper = Batch(stage, np.asarray(batch.qpos, float), threads)
        twist = np.tile([_SPEED, 0.0, 0.0], (worlds, 1))
        once = partial(stepper.drive, np.arange(worlds), twist, round(simulated / physics.timestep))
    once()  # compiles the law
    rate = worlds * simulated / best(once)
    return Measurement(name, family, worlds, rate)


def table(results: xr.Dataset) -> Rows:
    """Return a header and one row per engine and batch: simulated s per wall-clock s, by object."""
    families = list(dict.fromkeys(map(str, results.family.values)))
    rate_of = {
        (row["name"], row["worlds"], row["family"]): row["rate"]
        for row in records(results, "measurement")
    }
    in_c = {f: rate for (name, _, f), rate in rate_of.items() if name == "C in closed loop"}
    rows = [["engine", "worlds", *families, "against C in closed loop"]]
    for name, worlds in dict.fromkeys((name, worlds) for name, worlds, _ in rate_of):
        rates = {f: rate_of[name, worlds, f] for f in families if (name, worlds, f) in rate_of}
        cells = [f"{rates[f]:,.0f}" if f in rates else "" for f in families]
        ratios = [f"{rate / in_c[f]:.3g}" for f, rate in rates.items() if f in in_c]
        rows.append(
            [name, f"{worlds:,}", *cells, ", ".join(f"{float(ratio):,g}" for ratio in ratios)]
        )
    return rows


def throughput(speeds: Iterable[tuple[str, str, int, float]], steady: Collection[str]) -> Figure:
    """Plot simulated seconds per second over the batch size, one panel per shape family.

    `speeds` has rows (family, program, worlds, speed). The speed of a program in `steady` does not
    depend on the batch size and is drawn as a horizontal line.
    """
    speeds_of: dict[str, dict[str, list[tuple[int, float]]]] = {}
    for family, name, worlds, rate in speeds:
        speeds_of.setdefault(family, {}).setdefault(name, []).append((worlds, rate))
    figure = Figure(figsize=(4.5 * len(speeds_of), 4.0), layout="constrained")
    axes = figure.subplots(1, len(speeds_of), squeeze=False, sharey=True)[0]
    for ax, (family, by_name) in zip(axes, speeds_of.items(), strict=True):
        for i, (name, points) in enumerate(by_name.items()):
            if name in steady:
                ax.axhline(points[0][1], color=f"C{i}", ls="--", label=name)
            else:
                ax.plot(*zip(*points, strict=True), marker="o", color=f"C{i}", label=name)
        ax.set(xscale="log", yscale="log", xlabel="worlds in the batch", title=words(family))
        ax.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("simulated s per s")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure
