"""How long does a user wait for a whole command, from return to the report?

Each command is a process of its own, run with an empty cache and then once more with what the first
left in it. With `--gpus` they see so many, and `JAX_PLATFORMS=cpu` is for the process that times
them alone, so that it leaves the GPUs to them.

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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import xarray as xr

from rps_jax.analysis.report import Section
from rps_jax.errors import InputError
from rps_jax.record.options import option
from rps_jax.runs.question import Run, call_of
from rps_jax.trials.progress import Progress
from sweeps import programs
from sweeps.study_base import Study, Table

TOLD = re.compile(r"compile ([\d.]+) s, run ([\d.]+) s \((\d+) simulated s per s\)")
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
    GROWS: ClassVar[tuple[str, ...]] = ("commands", "warm", "gpus")

    commands: tuple[str, ...] = (
        "push --object box --target -2 0 --no-video",
        "push --object box --target -2 0",
        "push --object box --target -2 0 --engine mujoco",
        "sweep --laws rps_tuned --domain wide --worlds 100",
        "sweep --laws rps_tuned --domain wide --worlds 1000",
        "table",
        "table --engine mjx",
        "sweep --laws rps --domain wide --worlds 1048576 --horizon 0.02 --slots 2048",
    )
    """What is asked of `rps`."""
    gpus: tuple[int, ...] = option((), 1, 64)
    """Numbers of GPUs with which each is timed; by default with what this process sees."""
    warm: tuple[int, ...] = ()
    """Numbers of worlds that are swept three times in one process: the first time with an empty
    cache, and the last."""
    limit: float = option(1800.0, 1, 86400)
    """Time after which a command is stopped [s]."""
    file: str = "commands"
    """Name of the data file."""

    def num_trials(self) -> int | None:
        """How many commands there are."""
        return len(self.wanted) + len(self.warm)

    @property
    def wanted(self) -> list[tuple[str, int | None]]:
        """Commands, each with the numbers of GPUs that it sees."""
        return [(command, count) for command in self.commands for count in self.gpus or (None,)]

    def answer(self, run: Run) -> xr.Dataset:
        """Time what was not timed before."""
        found = []
        for number, (command, gpus) in enumerate(self.wanted):
            safe = re.sub(r"\W+", "_", command) + ("" if gpus is None else f"_{gpus}")
            found.append(run.checkpoint(safe, partial(timed, command, self.limit, gpus)))
            run.callback(Progress(number + 1, 0.0))
        gpus = max(self.gpus, default=None)
        found += [
            run.checkpoint(f"warm_{n}", partial(_warm, n, self.limit, gpus)) for n in self.warm
        ]
        told = [*_labels(self.wanted), *(f"`{_call(n)}`, in one process" for n in self.warm)]
        whole: Any = xr.concat(found, "command").assign_coords(command=told)
        return whole

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return the times of the commands."""
        return {self.file: Table([_COLUMNS, *table(results)])}

    def intro(self, results: xr.Dataset) -> str:
        """Where it was measured."""
        return programs.machine()

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Wall clocks of both processes."""
        return [Section("Whole commands", "", [list(_COLUMNS), *table(results)])]


commands = call_of(Commands)


def _labels(wanted: Sequence[tuple[str, int | None]]) -> list[str]:
    """What the rows are of: commands, and GPUs where these are said."""
    said = {None: "", 1: ", one GPU"}
    return [f"`rps {one}`{said.get(gpus, f', {gpus} GPUs')}" for one, gpus in wanted]


def timed(command: str, limit: float, gpus: int | None = None) -> xr.Dataset:
    """Seconds and memory [GB] of a command with an empty cache and once more, and what it told.

    Raises:
      InputError: it failed, or took longer than the limit [s].
    """
    seconds, memory, output = [], [], ""
    with tempfile.TemporaryDirectory() as folder:
        for number in range(2):
            words = ["-m", "rps_jax", *shlex.split(command), "--out", f"{folder}/run_{number}"]
            begun = time.perf_counter()
            output, held = printed(words, command, folder, limit, gpus)
            seconds.append(time.perf_counter() - begun)
            memory.append(held)
    told = TOLD.search(output)
    compile_, run, rate = map(float, told.groups()) if told else (float("nan"),) * 3
    return _row(*seconds, compile_, run, rate, *memory)


def _call(worlds: int) -> str:
    """The call by which worlds are swept, as a row names it."""
    return f'rps_jax.sweep("rps_tuned", "wide", worlds={worlds})'


def _warm(worlds: int, limit: float, gpus: int | None = None) -> xr.Dataset:
    """Seconds of a sweep with an empty cache, and the third time in that process."""
    code = (
        "import time, rps_jax\n"
        "for _ in range(3):\n"
        "    begun = time.perf_counter()\n"
        f"    {_call(worlds)}\n"
        "    print(time.perf_counter() - begun)\n"
    )
    with tempfile.TemporaryDirectory() as folder:
        told, held = printed(["-c", code], _call(worlds), folder, limit, gpus)
    first, *_, last = map(float, told.split())
    return _row(first, last, *(float("nan"),) * 3, held)


def printed(
    words: Sequence[str],
    asked: str,
    folder: str,
    limit: float,
    gpus: int | None = None,
    environment: Mapping[str, str] | None = None,
) -> tuple[str, float]:
    """What Python prints, with its cache in a folder, and the most memory that it held [GB].

    Raises:
      InputError: it failed, or took longer than the limit [s].
    """
    kept = os.environ | {"RPS_CACHE": f"{folder}/cache"} | dict(environment or {})
    if gpus is not None:
        kept["CUDA_VISIBLE_DEVICES"] = ",".join(map(str, range(gpus)))
        kept.pop("JAX_PLATFORMS", None)
    said, wrong = Path(folder, "said"), Path(folder, "wrong")
    with open(said, "w") as out, open(wrong, "w") as errors:
        process = subprocess.Popen([sys.executable, *words], env=kept, stdout=out, stderr=errors)
        stop = threading.Timer(limit, process.kill)
        stop.start()
        _, process.returncode, used = os.wait4(process.pid, 0)
    if not stop.is_alive():
        raise InputError(f"commands = {asked} took more than {limit:g} s.")
    stop.cancel()
    if process.returncode:
        last = wrong.read_text().strip().splitlines()[-1:]
        raise InputError(f"commands = {asked} failed: {' '.join(last)}")
    return said.read_text(), used.ru_maxrss * 1024 / 1e9  # Linux tells of KiB


def _row(*told: float) -> xr.Dataset:
    """Seconds of both runs, what the second told (compile and run [s], rate [s/s]), and memory."""
    names = ("empty", "again", "compile", "run", "rate", "memory_empty", "memory_again")
    values = (*told, *(float("nan"),) * (len(names) - len(told)))
    return xr.Dataset({name: ((), value) for name, value in zip(names, values, strict=True)})


def table(found: xr.Dataset) -> list[list[str]]:
    """A row for each command."""
    rows = []
    for command in map(str, found.command.values):
        one = found.sel(command=command)
        cells = [f"{one[name].item():.1f} s" for name in ("empty", "again", "compile", "run")]
        told = f"{one.rate.item():,.0f}"
        held = [f"{one[f'memory_{name}'].item():.1f} GB" for name in ("empty", "again")]
        shown = [cell.removeprefix("nan").removeprefix(" s") for cell in (*cells, told)]
        rows.append([command, *shown, *(cell.replace("nan GB", "") for cell in held)])
    return rows
