"""How long does a user wait for a whole command, from return to the report?

Each command is a process of its own, run with an empty cache and then once more with what the first
left in it. One that is about the GPU is run where there is one.

    rps sweeps/speed/commands.py --machine "2 cores of an AMD EPYC"
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import xarray as xr

from rps_jax.analysis.report import Section
from rps_jax.errors import InputError
from rps_jax.record import provenance
from rps_jax.record.options import option
from rps_jax.runs.question import Run, call_of
from rps_jax.trials.progress import Progress
from sweeps import shared
from sweeps.shared import Study

_TOLD = re.compile(r"compile ([\d.]+) s, run ([\d.]+) s \((\d+) simulated s per s\)")
_COLUMNS = (
    *("command", "empty cache", "once more", "of it compile", "run", "simulated s/s"),
    *("memory, empty cache", "memory, once more"),
)


@dataclass(frozen=True)
class Commands(Study[xr.Dataset]):
    """Time whole commands, with an empty cache and once more.

    The answer holds seconds from return to the end of the process, the most memory that it held,
    and what the second told of itself, for each command.
    """

    TITLE: ClassVar[str] = "How long a user waits for a whole command"
    GROWS: ClassVar[tuple[str, ...]] = ("commands", "machine")

    commands: tuple[str, ...] = (
        "push --object box --target -2 0 --no-video",
        "push --object box --target -2 0",
        "push --object box --target -2 0 --engine fused",
        "sweep --laws rps_tuned --domain wide --worlds 100",
        "sweep --laws rps_tuned --domain wide --worlds 1000",
        "table --engine fused",
        "sweep --laws rps --domain wide --worlds 1048576 --horizon 0.02 --slots 2048",
    )
    """What is asked of `rps`."""
    limit: float = option(1800.0, 1, 86400)
    """Time after which a command is stopped [s]."""
    machine: str = ""
    """What it runs on, in words; with these the table is published."""
    file: str = "commands"
    """Name of the data file."""

    def trials(self) -> int | None:
        """How many commands there are."""
        return len(self.commands)

    def answer(self, run: Run) -> xr.Dataset:
        """Time what was not timed before."""
        found = []
        for number, command in enumerate(self.commands):
            safe = re.sub(r"\W+", "_", command)
            found.append(run.part(safe, partial(timed, command, self.limit)))
            run.report(Progress(number + 1, 0.0))
        whole: Any = xr.concat(found, "command").assign_coords(command=list(self.commands))
        if self.machine and run.folder is not None:
            path = Path(__file__).parent / "results" / f"{self.file}.json"
            columns = [{"name": one} for one in _COLUMNS]
            made = [provenance.signed(run.folder)]
            shared.publish(path, made, self.machine, columns, table(whole))
        return whole

    def intro(self, found: xr.Dataset) -> str:
        """Where it was measured."""
        return shared.machine()

    def report(self, found: xr.Dataset, run: Run) -> Sequence[Section]:
        """Wall clocks of both processes."""
        return [Section("Whole commands", "", [list(_COLUMNS), *table(found)])]


commands = call_of(Commands)


def timed(command: str, limit: float) -> xr.Dataset:
    """Seconds and memory [GB] of a command with an empty cache and once more, and what it told.

    Raises:
      InputError: it failed, or took longer than the limit [s].
    """
    seconds, memory, output = [], [], ""
    with tempfile.TemporaryDirectory() as folder:
        kept = os.environ | {"RPS_CACHE": f"{folder}/cache"}
        for number in range(2):
            words = [sys.executable, "-m", "rps_jax", *shlex.split(command)]
            words += ["--out", f"{folder}/run_{number}"]
            said, wrong = Path(folder, "said"), Path(folder, "wrong")
            begun = time.perf_counter()
            with open(said, "w") as out, open(wrong, "w") as errors:
                process = subprocess.Popen(words, env=kept, stdout=out, stderr=errors)
                stop = threading.Timer(limit, process.kill)
                stop.start()
                _, process.returncode, used = os.wait4(process.pid, 0)
            seconds.append(time.perf_counter() - begun)
            if not stop.is_alive():
                raise InputError(f"commands = {command} took more than {limit:g} s.")
            stop.cancel()
            memory.append(used.ru_maxrss * 1024 / 1e9)  # Linux tells of KiB
            if process.returncode:
                last = wrong.read_text().strip().splitlines()[-1:]
                raise InputError(f"commands = {command} failed: {' '.join(last)}")
            output = said.read_text()
    told = _TOLD.search(output)
    compile_, run, rate = map(float, told.groups()) if told else (float("nan"),) * 3
    values = {"empty": seconds[0], "again": seconds[1], "compile": compile_, "run": run}
    values |= {"rate": rate, "memory_empty": memory[0], "memory_again": memory[1]}
    return xr.Dataset({name: ((), value) for name, value in values.items()})


def table(found: xr.Dataset) -> list[list[str]]:
    """A row for each command."""
    rows = []
    for command in map(str, found.command.values):
        one = found.sel(command=command)
        cells = [f"{one[name].item():.1f} s" for name in ("empty", "again", "compile", "run")]
        told = f"{one.rate.item():,.0f}"
        held = [f"{one[f'memory_{name}'].item():.1f} GB" for name in ("empty", "again")]
        shown = [cell.removeprefix("nan").removeprefix(" s") for cell in (*cells, told)]
        rows.append([f"`rps {command}`", *shown, *held])
    return rows
