"""Time of a control step, by the function of this package that requests each operation.

XLA's profiler times every operation on the device, and the compiled program has the source line of
each operation. A fused operation counts for the line that computes its result, so neighbouring
functions may get the time of each other. On a processor the loop is compiled by XLA, not by the C
compiler.

    rps sweeps/speed/costs.py --families box prism
"""

from __future__ import annotations

import os
import re
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp

from rps_jax.questions import Run, call_of, option
from rps_jax.trials.progress import Progress
from sweeps import programs
from sweeps.programs import FAMILIES
from sweeps.study_base import Rows, SpeedStudy, Table

_ABOVE = re.compile(r".*(?:rps_jax|site-packages)/")  # prefix of a file name
_INSTRUCTION = re.compile(r"^\s*(?:ROOT )?%([\w.\-]+) = .* ([\w\-]+)\(.*stack_frame_id=(\d+)", re.M)
_HOLLOW = ("while", "call", "conditional")  # their operations are timed separately
ELSEWHERE = "moved by XLA"


class Cost(NamedTuple):
    """Cost of one function."""

    where: str  # file: function
    time: float  # [s] per control step of the whole batch
    share: float  # [1] of the timed operations
    operations: float  # per control step


class Profile(NamedTuple):
    """Profile of a program."""

    name: str  # in `programs.BATCHED`
    family: str
    worlds: int
    step: float  # [s] wall clock of a control step, without the profiler
    timed: float  # [s] in operations, with the profiler
    costs: tuple[Cost, ...]  # the most expensive first


@dataclass(frozen=True)
class Costs(SpeedStudy[list[Profile]]):
    """Profile a control step by the functions of this package.

    The results hold a profile of each program.
    """

    TITLE = "Time of a control step by function"
    CHOICES: ClassVar = {"families": FAMILIES, "names": programs.BATCHED}

    names: tuple[str, ...] = ("fused standard",)
    """Engines and fidelities, as those of `rps sweeps/speed`."""
    families: tuple[Literal["box", "cylinder", "prism"], ...] = FAMILIES
    """Families of the objects: box, cylinder, prism."""
    worlds: int = option(64, 1, 10_000_000)
    """Number of worlds of the batch."""
    steps: int = option(20, 1, 1000)
    """Number of timed control steps."""
    most: int = option(12, 1, 1000)
    """Number of functions of each program in the table."""

    def num_trials(self) -> int | None:
        """Return the number of programs."""
        return len(self.names) * len(self.families)

    def answer(self, run: Run) -> list[Profile]:
        """Profile each program."""
        profiles, compiler = [], os.environ.get("RPS_COMPILER")
        os.environ["RPS_COMPILER"] = "none"  # the profiler sees operations of XLA only
        try:
            for name, family in product(self.names, self.families):
                profiles.append(measure(name, family, self.worlds, steps=self.steps))
                run.callback(Progress(len(profiles), 0.0))
        finally:
            os.environ.pop("RPS_COMPILER")
            os.environ.update({} if compiler is None else {"RPS_COMPILER": compiler})
        return profiles

    def intro(self, results: list[Profile]) -> str:
        """Return the device, and the time of a control step of each program."""
        lines = "\n".join(
            f"{p.name}, {p.family}: {1e6 * p.step:,.0f} us a control step of {p.worlds:,} worlds, "
            f"{1e6 * p.timed:,.0f} us in operations while the profiler ran."
            for p in results
        )
        return f"{super().intro(results)}\n\n{lines}"

    def report_tables(self, results: list[Profile]) -> Sequence[Table]:
        """Return the most expensive functions of each program."""
        return [Table(table(results, self.most), title="Functions")]


costs = call_of(Costs)


def measure(name: str, family: str, worlds: int, *, steps: int = 20) -> Profile:
    """Profile a program of `programs.BATCHED`, with a push in every world.

    Args:
      name: name in `programs.BATCHED`.
      family: shape family of the objects.
      worlds: number of worlds.
      steps: number of timed control steps.
    """
    setting = programs.BATCHED[name]
    simulated = steps * setting.physics.control_period
    program = programs.traced(name, setting, family, worlds, simulated=simulated)()
    state = jax.block_until_ready(program.go(jax.tree.map(jnp.copy, program.start)))
    start = time.perf_counter()
    state = jax.block_until_ready(program.go(state))
    duration = time.perf_counter() - start
    options = jax.profiler.ProfileOptions()
    options.host_tracer_level = 3  # every operation of a processor
    options.python_tracer_level = 0
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder, profiler_options=options):
            jax.block_until_ready(program.go(state))
        (trace_file,) = Path(folder).rglob("*.xplane.pb")
        events = list(_events(jax.profiler.ProfileData.from_file(str(trace_file))))
    source = sources(program.text() or "")
    times: dict[str, float] = defaultdict(float)
    counts: Counter[str] = Counter()
    for operation, seconds in events:
        if (where := source.get(operation)) is not None:
            times[where] += seconds
            counts[where] += 1
    total = sum(times.values())
    costs = [
        Cost(where, seconds / steps, seconds / total, counts[where] / steps)
        for where, seconds in sorted(times.items(), key=lambda pair: -pair[1])
    ]
    return Profile(name, family, worlds, duration / steps, total / steps, tuple(costs))


def _events(data: Any) -> Iterator[tuple[str, float]]:
    """Yield the names of operations and their durations [s]."""
    for plane in data.planes:
        device = plane.name.startswith("/device:")
        for line in plane.lines:
            if device and not line.name.startswith("Stream"):
                continue
            for event in line.events:
                name = event.name
                if device:
                    name = next((str(v) for k, v in event.stats if k == "hlo_op"), name)
                yield name, 1e-9 * event.duration_ns


def sources(text: str) -> dict[str, str]:
    """Return file and function of each instruction in the text of a compiled program.

    Nested calls count for the innermost function, instructions without a source for `ELSEWHERE`.
    """
    files, functions = _rows(text, "FileNames", '"(.*)"'), _rows(text, "FunctionNames", '"(.*)"')
    locations = _rows(text, "FileLocations", r"file_name_id=(\d+) function_name_id=(\d+)")
    frames = _rows(text, "StackFrames", r"file_location_id=(\d+)")
    functions_of = {}
    for name, opcode, frame in _INSTRUCTION.findall(text):
        if opcode in _HOLLOW:
            continue
        functions_of[name] = ELSEWHERE
        if frame in frames:
            file, function = locations[frames[frame][0]]
            short, scope = _ABOVE.sub("", files[file][0]), functions[function][0]
            functions_of[name] = f"{short}: {scope.replace('.<locals>', '')}"
    return functions_of


def _rows(text: str, title: str, pattern: str) -> dict[str, list[str]]:
    """Return the groups of a pattern in each row of a section, by the number of the row."""
    section = text.partition(f"\n{title}\n")[2].partition("\n\n")[0]
    rows = re.findall(rf"^(\d+) .*?{pattern}", section, re.MULTILINE)
    return {number: groups for number, *groups in rows}


def table(profiles: Sequence[Profile], count: int = 12) -> Rows:
    """Return a header and the most expensive functions of each program."""
    rows = [["what", "family", "worlds", "where", "us a control step", "share", "operations"]]
    return rows + [
        [
            p.name,
            p.family,
            f"{p.worlds:,}",
            c.where,
            f"{1e6 * c.time:.1f}",
            f"{100 * c.share:.0f} %",
            f"{c.operations:.1f}",
        ]
        for p in profiles
        for c in p.costs[:count]
    ]
