"""Time of a step of the law on a robot, from 42 taxels to a twist, a thousand times per second.

A separate process runs `notebooks/examples/on_a_robot.py`, which prints its measurements.

    rps sweeps/speed/robot.py --core 1 --machine "one of 2 cores of an AMD EPYC"
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import xarray as xr

from rps_jax.analysis.report import Section
from rps_jax.errors import InputError
from rps_jax.record.options import option
from rps_jax.runs.question import Run, call_of
from rps_jax.trials.progress import Progress
from sweeps.study_base import Study, Table

_ROOT = Path(__file__).parents[2]
_EXAMPLE = "notebooks/examples/on_a_robot.py"
PRINTED = re.compile(r"median (\d+) us, 99.9th percentile (\d+) us, worst (\d+) us; ([\d.]+)%")
_VARIABLES = {
    "median": ("us", "median time of a step"),
    "slow": ("us", "99.9th percentile of the times"),
    "worst": ("us", "longest time of a step"),
    "late": ("%", "share of the steps that were longer than their period"),
}
_COLUMNS = ("run", "median", "99.9th percentile", "worst", "steps of more than 1 ms")


@dataclass(frozen=True)
class OnARobot(Study[xr.Dataset]):
    """Time the steps of the law at the rate of a robot, in several runs.

    The results hold `median`, `slow`, `worst` [us] and `late` [%] by run.
    """

    TITLE: ClassVar[str] = "Time of a step on a robot"
    GROWS: ClassVar[tuple[str, ...]] = ("runs", "core")
    RESULTS: ClassVar[str] = "../results"

    runs: int = option(2, 1, 100)
    """Number of runs."""
    seconds: float = option(12.0, above=0, at_most=3600, unit="s")
    """Length of a run [s]."""
    core: int = option(0, 0, 4095)
    """Processor core of the process."""

    def num_trials(self) -> int | None:
        """Return the number of runs."""
        return self.runs

    def answer(self, run: Run) -> xr.Dataset:
        """Time the runs that are missing."""
        parts = []
        for i in range(self.runs):
            parts.append(run.checkpoint(f"run_{i}", self._timed))
            run.callback(Progress(i + 1, 0.0))
        results: Any = xr.concat(parts, "run")
        return results

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return the times of each run."""
        return {"robot": Table([_COLUMNS, *table(results)])}

    def _timed(self) -> xr.Dataset:
        """Return the times that one run prints.

        Raises:
          InputError: the run failed.
        """
        arguments = [_EXAMPLE, "--seconds", f"{self.seconds:g}", "--core", str(self.core)]
        process = subprocess.run(
            [sys.executable, *arguments], cwd=_ROOT, capture_output=True, text=True, check=False
        )
        match = PRINTED.search(process.stdout)
        if process.returncode or not match:
            last = process.stderr.strip().splitlines()[-1:]
            raise InputError(f"core = {self.core} is not allowed here: {' '.join(last)}")
        values = zip(_VARIABLES.items(), match.groups(), strict=True)
        return xr.Dataset(
            {
                name: ((), float(value), {"units": unit, "long_name": arguments})
                for (name, (unit, arguments)), value in values
            }
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Return a section with the times of each run."""
        return [Section("Steps", "", [list(_COLUMNS), *table(results)])]


on_a_robot = call_of(OnARobot)


def table(results: xr.Dataset) -> list[list[str]]:
    """Return one row per run."""
    rows = []
    for i in range(results.sizes["run"]):
        times = {name: float(results[name][i]) for name in _VARIABLES}
        slow, worst = (f"{times[name] / 1000:.1f} ms" for name in ("slow", "worst"))
        rows.append([str(i + 1), f"{times['median']:.0f} µs", slow, worst, f"{times['late']} %"])
    return rows
