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
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp

from rps_jax import errors
from rps_jax.analysis.report import Section
from rps_jax.record.options import option
from rps_jax.runs.question import Run, call_of
from rps_jax.trials.progress import Progress
from sweeps import programs
from sweeps.programs import FAMILIES
from sweeps.study_base import Study

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
class Costs(Study[list[Profile]]):
    """Profile a control step by the functions of this package.

    The results hold a profile of each program.
    """

    TITLE: ClassVar[str] = "Time of a control step by function"

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

    def check(self) -> None:
        """Check the names of the programs and of the families."""
        for family in self.families:
            errors.check_name("families", family, FAMILIES)
        for name in self.names:
            errors.check_name("names", name, programs.BATCHED)

    def num_trials(self) -> int | None:
        """Return the number of programs."""
        return len(self.names) * len(self.families)

    def answer(self, run: Run) -> list[Profile]:
        """Profile each program."""
        profiles, compiler = [], os.environ.get("RPS_COMPILER")
        os.environ["RPS_COMPILER"] = "none"  # the profiler sees operations of XLA only
        try:
            for name in self.names:
                for family in self.families:
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
        return f"{programs.machine()}\n\n{lines}"

    def report(self, results: list[Profile], run: Run) -> Sequence[Section]:
        """Return a section with the most expensive functions of each program."""
        return [Section("Functions", "", table(results, self.most))]


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
    files, functions = _names(text, "FileNames"), _names(text, "FunctionNames")
    locations = {
        location: (int(file), int(function))
        for location, file, function in _rows(
            text, "FileLocations", r"file_name_id=(\d+) function_name_id=(\d+)"
        )
    }
    frames = {
        frame: int(location)
        for frame, location in _rows(text, "StackFrames", r"file_location_id=(\d+)")
    }
    functions_of = {}
    for name, opcode, frame in _INSTRUCTION.findall(text):
        if opcode in _HOLLOW:
            continue
        where = ELSEWHERE
        if int(frame) in frames:
            file, function = locations[frames[int(frame)]]
            short = _ABOVE.sub("", files[file])
            where = f"{short}: {functions[function].replace('.<locals>', '')}"
        functions_of[name] = where
    return functions_of


def _section(text: str, title: str) -> list[str]:
    lines = text.partition(f"\n{title}\n")[2].splitlines()
    return lines[: lines.index("")] if "" in lines else lines


def _names(text: str, title: str) -> dict[int, str]:
    rows = (line.partition(" ") for line in _section(text, title))
    return {int(i): name.strip('"') for i, _, name in rows}


def _rows(text: str, title: str, pattern: str) -> Iterator[tuple[int, ...]]:
    for line in _section(text, title):
        i, _, rest = line.partition(" ")
        if match := re.search(pattern, rest):
            yield int(i), *(int(group) for group in match.groups())


def table(profiles: Sequence[Profile], count: int = 12) -> list[list[str]]:
    """Return a header and the most expensive functions of each program."""
    rows = [["what", "family", "worlds", "where", "us a control step", "share", "operations"]]
    for p in profiles:
        for c in p.costs[:count]:
            rows.append(
                [p.name, p.family, f"{p.worlds:,}", c.where, f"{1e6 * c.time:.1f}",
                 f"{100 * c.share:.0f} %", f"{c.operations:.1f}"]
            )  # fmt: skip
    return rows
