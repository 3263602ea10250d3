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

import xarray as xr

from rps_jax import InputError
from rps_jax.questions import Run, call_of, option
from sweeps.study_base import Parts, SpeedStudy, Table, records, text_table

TIMING = re.compile(r"compile ([\d.]+) s, run ([\d.]+) s \((\d+) simulated s per s\)")
_COLUMNS = {
    "command": "{command}",
    "empty cache": "{empty:.1f} s",
    "once more": "{again:.1f} s",
    "of it compile": "{compile:.1f} s",
    "run": "{run:.1f} s",
    "simulated s/s": "{rate:,.0f}",
    "memory, empty cache": "{memory_empty:.1f} GB",
    "memory, once more": "{memory_again:.1f} GB",
}


@dataclass(frozen=True)
class Commands(SpeedStudy[xr.Dataset]):
    """Time whole commands, with an empty and with a filled cache.

    The results hold, by command, the duration of both processes, their peak memory, and the times
    that the second one prints.
    """

    TITLE = "Duration of whole commands"
    DIMENSION = "command"
    GROWS = ("commands", "warm", "gpus")

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

    def parts(self, run: Run) -> Parts:
        """Return the function that times each command with each number of GPUs."""
        suffix = {None: "", 1: ", one GPU"} | {n: f", {n} GPUs" for n in self.gpus if n > 1}
        parts = {
            f"`rps {command}`{suffix[gpus]}": partial(timed, command, self.limit, gpus)
            for command in self.commands
            for gpus in self.gpus or (None,)
        }
        gpus = max(self.gpus, default=None)
        return parts | {
            f"`{_call(n)}`, in one process": partial(_warm, n, self.limit, gpus) for n in self.warm
        }

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the times of the commands."""
        rows = text_table(_COLUMNS, records(results, "command"))
        return [Table(rows, name=self.file, title="Whole commands")]


commands = call_of(Commands)


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
    compile_, run, rate = map(float, match.groups() if match else ("nan",) * 3)
    return xr.Dataset(
        {
            "empty": seconds[0],
            "again": seconds[1],
            "compile": compile_,
            "run": run,
            "rate": rate,
            "memory_empty": memory[0],
            "memory_again": memory[1],
        }
    )


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
    return xr.Dataset({"empty": first, "again": last, "memory_empty": peak})


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
    variables.pop("PYTHONDONTWRITEBYTECODE", None)  # compiling modules takes half of a start
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
