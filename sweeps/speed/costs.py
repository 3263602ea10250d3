"""Where does the time of a control step go? By the function of this package that asked for it.

XLA's profiler times every operation that a device carries out; the compiled program says which
line of source each operation comes from. An operation that XLA has fused from several is counted
where its result is computed, so neighbours may be charged for one another.

On a processor these are the operations of XLA, without a C compiler.

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

_ABOVE = re.compile(r".*(?:rps_jax|site-packages)/")  # of a file, what says not which it is
_INSTRUCTION = re.compile(r"^\s*(?:ROOT )?%([\w.\-]+) = .* ([\w\-]+)\(.*stack_frame_id=(\d+)", re.M)
_HOLLOW = ("while", "call", "conditional")  # what is within them is timed by itself
ELSEWHERE = "moved by XLA"


class Cost(NamedTuple):
    """What one function costs."""

    where: str  # file: function
    time: float  # [s] of a control step of the whole batch
    share: float  # [1] of all that was timed
    operations: float  # carried out in a control step


class Profile(NamedTuple):
    """Where the time of a program goes."""

    name: str  # of `programs.BATCHED`
    family: str
    worlds: int
    step: float  # [s] of wall clock in a control step, without the profiler
    timed: float  # [s] in operations, as the profiler timed them
    costs: tuple[Cost, ...]  # the most expensive first


@dataclass(frozen=True)
class Costs(Study[list[Profile]]):
    """Tell where the time of a control step goes, by the function that asked for it.

    The answer holds a profile of each program.
    """

    TITLE: ClassVar[str] = "Where the time of a control step goes"

    names: tuple[str, ...] = ("fused standard",)
    """Engines and fidelities, as those of `rps sweeps/speed`."""
    families: tuple[Literal["box", "cylinder", "prism"], ...] = FAMILIES
    """Families of the objects: box, cylinder, prism."""
    worlds: int = option(64, 1, 10_000_000)
    """Number of worlds of the batch."""
    steps: int = option(20, 1, 1000)
    """Control steps that are timed."""
    most: int = option(12, 1, 1000)
    """Functions of each program in the table."""

    def check(self) -> None:
        """Check the names of the programs and of the families."""
        for family in self.families:
            errors.check_name("families", family, FAMILIES)
        for name in self.names:
            errors.check_name("names", name, programs.BATCHED)

    def num_trials(self) -> int | None:
        """How many programs there are."""
        return len(self.names) * len(self.families)

    def answer(self, run: Run) -> list[Profile]:
        """Profile each program."""
        found, compiler = [], os.environ.get("RPS_COMPILER")
        os.environ["RPS_COMPILER"] = "none"  # the profiler sees the operations of XLA alone
        try:
            for name in self.names:
                for family in self.families:
                    found.append(measure(name, family, self.worlds, steps=self.steps))
                    run.callback(Progress(len(found), 0.0))
        finally:
            os.environ.pop("RPS_COMPILER")
            os.environ.update({} if compiler is None else {"RPS_COMPILER": compiler})
        return found

    def intro(self, results: list[Profile]) -> str:
        """Where it was measured, and how long a control step takes."""
        whole = "\n".join(
            f"{p.name}, {p.family}: {1e6 * p.step:,.0f} us a control step of {p.worlds:,} worlds, "
            f"{1e6 * p.timed:,.0f} us in operations while the profiler ran."
            for p in results
        )
        return f"{programs.machine()}\n\n{whole}"

    def report(self, results: list[Profile], run: Run) -> Sequence[Section]:
        """The most expensive functions of each program."""
        return [Section("Functions", "", table(results, self.most))]


costs = call_of(Costs)


def measure(name: str, family: str, worlds: int, *, steps: int = 20) -> Profile:
    """Profile one of `programs.BATCHED`, every world being pushed.

    Args:
      name: of `programs.BATCHED`.
      family: of its worlds.
      worlds: how many.
      steps: control steps that are timed.
    """
    setting = programs.BATCHED[name]
    simulated = steps * setting.physics.control_period
    program = programs.traced(name, setting, family, worlds, simulated=simulated)()
    state = jax.block_until_ready(program.go(jax.tree.map(jnp.copy, program.start)))
    began = time.perf_counter()
    state = jax.block_until_ready(program.go(state))
    took = time.perf_counter() - began
    options = jax.profiler.ProfileOptions()
    options.host_tracer_level = 3  # of a processor: every operation
    options.python_tracer_level = 0
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder, profiler_options=options):
            jax.block_until_ready(program.go(state))
        (found,) = Path(folder).rglob("*.xplane.pb")
        events = list(_events(jax.profiler.ProfileData.from_file(str(found))))
    source = sources(program.text() or "")
    times: dict[str, float] = defaultdict(float)
    counts: Counter[str] = Counter()
    for operation, seconds in events:
        if (where := source.get(operation)) is not None:
            times[where] += seconds
            counts[where] += 1
    whole = sum(times.values())
    costs = [
        Cost(where, seconds / steps, seconds / whole, counts[where] / steps)
        for where, seconds in sorted(times.items(), key=lambda pair: -pair[1])
    ]
    return Profile(name, family, worlds, took / steps, whole / steps, tuple(costs))


def _events(data: Any) -> Iterator[tuple[str, float]]:
    """Names of operations, and their durations [s]."""
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
    """The file and function of each instruction of a compiled program's text.

    Of functions that call one another it is the innermost; an instruction without a place of its
    own comes from `ELSEWHERE`.
    """
    files, functions = _names(text, "FileNames"), _names(text, "FunctionNames")
    places = {
        place: (int(file), int(function))
        for place, file, function in _rows(
            text, "FileLocations", r"file_name_id=(\d+) function_name_id=(\d+)"
        )
    }
    frames = {
        frame: int(place) for frame, place in _rows(text, "StackFrames", r"file_location_id=(\d+)")
    }
    found = {}
    for name, opcode, frame in _INSTRUCTION.findall(text):
        if opcode in _HOLLOW:
            continue
        where = ELSEWHERE
        if int(frame) in frames:
            file, function = places[frames[int(frame)]]
            short = _ABOVE.sub("", files[file])
            where = f"{short}: {functions[function].replace('.<locals>', '')}"
        found[name] = where
    return found


def _section(text: str, title: str) -> list[str]:
    lines = text.partition(f"\n{title}\n")[2].splitlines()
    return lines[: lines.index("")] if "" in lines else lines


def _names(text: str, title: str) -> dict[int, str]:
    rows = (line.partition(" ") for line in _section(text, title))
    return {int(number): name.strip('"') for number, _, name in rows}


def _rows(text: str, title: str, pattern: str) -> Iterator[tuple[int, ...]]:
    for line in _section(text, title):
        number, _, rest = line.partition(" ")
        if found := re.search(pattern, rest):
            yield int(number), *(int(group) for group in found.groups())


def table(profiles: Sequence[Profile], most: int = 12) -> list[list[str]]:
    """Header, and the `most` expensive functions of each program."""
    rows = [["what", "family", "worlds", "where", "us a control step", "share", "operations"]]
    for p in profiles:
        for c in p.costs[:most]:
            rows.append(
                [p.name, p.family, f"{p.worlds:,}", c.where, f"{1e6 * c.time:.1f}",
                 f"{100 * c.share:.0f} %", f"{c.operations:.1f}"]
            )  # fmt: skip
    return rows
