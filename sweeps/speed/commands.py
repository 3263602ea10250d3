"""Time that a user waits for a whole command, from the return key to the report.

Each command runs twice in a new process: first with an empty cache, then with the cache of the
first run. With `--gpus` the processes see that number of GPUs; set `JAX_PLATFORMS=cpu` for the
timing process, so that it leaves the GPUs to them.

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

TIMING = re.compile(r"compile ([\d.]+) s, run ([\d.]+) s \((\d+) simulated s per s\)")
_COLUMNS = (
    *("command", "empty cache", "once more", "of it compile", "run", "simulated s/s"),
    *("memory, empty cache", "memory, once more"),
)


@dataclass(frozen=True)
class Commands(Study[xr.Dataset]):
    """Time whole commands, with an empty and with a filled cache.

    The results hold, by command, the duration of both processes, their peak memory, and the times
    that the second one prints.
    """

    TITLE: ClassVar[str] = "Duration of whole commands"
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
    """Arguments of `rps`."""
    gpus: tuple[int, ...] = option((), 1, 64)
    """Numbers of GPUs with which each command is timed; by default those of this process."""
    warm: tuple[int, ...] = ()
    """Numbers of worlds of sweeps that run three times in one process; the first, with an empty
    cache, and the last are timed."""
    limit: float = option(1800.0, 1, 86400)
    """Time limit of a command [s]."""
    file: str = "commands"
    """Name of the data file."""

    def num_trials(self) -> int | None:
        """Return the number of commands."""
        return len(self.rows) + len(self.warm)

    @property
    def rows(self) -> list[tuple[str, int | None]]:
        """Commands, each with its number of GPUs."""
        return [(command, count) for command in self.commands for count in self.gpus or (None,)]

    def answer(self, run: Run) -> xr.Dataset:
        """Time the commands that are missing."""
        parts = []
        for i, (command, gpus) in enumerate(self.rows):
            safe = re.sub(r"\W+", "_", command) + ("" if gpus is None else f"_{gpus}")
            parts.append(run.checkpoint(safe, partial(timed, command, self.limit, gpus)))
            run.callback(Progress(i + 1, 0.0))
        gpus = max(self.gpus, default=None)
        parts += [
            run.checkpoint(f"warm_{n}", partial(_warm, n, self.limit, gpus)) for n in self.warm
        ]
        labels = [*_labels(self.rows), *(f"`{_call(n)}`, in one process" for n in self.warm)]
        results: Any = xr.concat(parts, "command").assign_coords(command=labels)
        return results

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return the times of the commands."""
        return {self.file: Table([_COLUMNS, *table(results)])}

    def intro(self, results: xr.Dataset) -> str:
        """Return the device of the measurement."""
        return programs.machine()

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Return a section with the durations of both processes."""
        return [Section("Whole commands", "", [list(_COLUMNS), *table(results)])]


commands = call_of(Commands)


def _labels(rows: Sequence[tuple[str, int | None]]) -> list[str]:
    """Return the labels of the rows: command and number of GPUs."""
    suffix = {None: "", 1: ", one GPU"}
    return [f"`rps {command}`{suffix.get(gpus, f', {gpus} GPUs')}" for command, gpus in rows]


def timed(command: str, limit: float, gpus: int | None = None) -> xr.Dataset:
    """Return duration [s] and peak memory [GB] of both runs of a command, and its printed times.

    Raises:
      InputError: the command failed or exceeded the time limit [s].
    """
    seconds, memory, output = [], [], ""
    with tempfile.TemporaryDirectory() as folder:
        for i in range(2):
            words = ["-m", "rps_jax", *shlex.split(command), "--out", f"{folder}/run_{i}"]
            start = time.perf_counter()
            output, peak = printed(words, command, folder, limit, gpus)
            seconds.append(time.perf_counter() - start)
            memory.append(peak)
    match = TIMING.search(output)
    compile_, run, rate = map(float, match.groups()) if match else (float("nan"),) * 3
    return _row(*seconds, compile_, run, rate, *memory)


def _call(worlds: int) -> str:
    """Return the call of a sweep, as its row names it."""
    return f'rps_jax.sweep("rps_tuned", "wide", worlds={worlds})'


def _warm(worlds: int, limit: float, gpus: int | None = None) -> xr.Dataset:
    """Return the durations of the first and the third sweep of one process [s]."""
    code = (
        "import time, rps_jax\n"
        "for _ in range(3):\n"
        "    begun = time.perf_counter()\n"
        f"    {_call(worlds)}\n"
        "    print(time.perf_counter() - begun)\n"
    )
    with tempfile.TemporaryDirectory() as folder:
        output, peak = printed(["-c", code], _call(worlds), folder, limit, gpus)
    first, *_, last = map(float, output.split())
    return _row(first, last, *(float("nan"),) * 3, peak)


def printed(
    words: Sequence[str],
    label: str,
    folder: str,
    limit: float,
    gpus: int | None = None,
    environment: Mapping[str, str] | None = None,
) -> tuple[str, float]:
    """Run Python with a cache in a folder; return its output and its peak memory [GB].

    Raises:
      InputError: the command failed or exceeded the time limit [s].
    """
    variables = os.environ | {"RPS_CACHE": f"{folder}/cache"} | dict(environment or {})
    if gpus is not None:
        variables["CUDA_VISIBLE_DEVICES"] = ",".join(map(str, range(gpus)))
        variables.pop("JAX_PLATFORMS", None)
    output, error_output = Path(folder, "output"), Path(folder, "errors")
    with open(output, "w") as out, open(error_output, "w") as errors:
        process = subprocess.Popen(
            [sys.executable, *words], env=variables, stdout=out, stderr=errors
        )
        timer = threading.Timer(limit, process.kill)
        timer.start()
        _, process.returncode, usage = os.wait4(process.pid, 0)
    if not timer.is_alive():
        raise InputError(f"commands = {label} exceeded the limit of {limit:g} s: raise --limit.")
    timer.cancel()
    if process.returncode:
        last = error_output.read_text().strip().splitlines()[-1:]
        raise InputError(f"commands = {label} failed: {' '.join(last)}")
    return output.read_text(), usage.ru_maxrss * 1024 / 1e9  # Linux reports KiB


def _row(*values: float) -> xr.Dataset:
    """Label durations of both runs, printed times (compile, run [s], rate) and peak memory."""
    names = ("empty", "again", "compile", "run", "rate", "memory_empty", "memory_again")
    padded = (*values, *(float("nan"),) * (len(names) - len(values)))
    return xr.Dataset({name: ((), value) for name, value in zip(names, padded, strict=True)})


def table(results: xr.Dataset) -> list[list[str]]:
    """Return one row per command."""
    rows = []
    for command in map(str, results.command.values):
        timing = results.sel(command=command)
        cells = [f"{timing[name].item():.1f} s" for name in ("empty", "again", "compile", "run")]
        rate = f"{timing.rate.item():,.0f}"
        peaks = [f"{timing[f'memory_{name}'].item():.1f} GB" for name in ("empty", "again")]
        shown = [cell.removeprefix("nan").removeprefix(" s") for cell in (*cells, rate)]
        rows.append([command, *shown, *(cell.replace("nan GB", "") for cell in peaks)])
    return rows
