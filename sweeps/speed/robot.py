"""How long does the law take on a robot, from 42 taxels to a twist, a thousand times a second?

`notebooks/examples/on_a_robot.py` is run as a process of its own, and says what it measured.

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
TOLD = re.compile(r"median (\d+) us, 99.9th percentile (\d+) us, worst (\d+) us; ([\d.]+)%")
_FOUND = {
    "median": ("us", "median time of a step"),
    "slow": ("us", "99.9th percentile of the times"),
    "worst": ("us", "longest time of a step"),
    "late": ("%", "share of the steps that took longer than their period"),
}
_COLUMNS = ("run", "median", "99.9th percentile", "worst", "steps of more than 1 ms")


@dataclass(frozen=True)
class OnARobot(Study[xr.Dataset]):
    """Time the steps of the law as a robot makes them, in several runs.

    The answer holds `median`, `slow`, `worst` [us] and `late` [%] by run.
    """

    TITLE: ClassVar[str] = "How long a step takes on a robot"
    GROWS: ClassVar[tuple[str, ...]] = ("runs", "core")
    RESULTS: ClassVar[str] = "../results"

    runs: int = option(2, 1, 100)
    """Number of runs."""
    seconds: float = option(12.0, above=0, at_most=3600, unit="s")
    """Length of a run [s]."""
    core: int = option(0, 0, 4095)
    """Core to stay on."""

    def num_trials(self) -> int | None:
        """How many runs there are."""
        return self.runs

    def answer(self, run: Run) -> xr.Dataset:
        """Make the runs that are missing."""
        found = []
        for number in range(self.runs):
            found.append(run.checkpoint(f"run_{number}", self._timed))
            run.callback(Progress(number + 1, 0.0))
        whole: Any = xr.concat(found, "run")
        return whole

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return the times of each run."""
        return {"robot": Table([_COLUMNS, *table(results)])}

    def _timed(self) -> xr.Dataset:
        """What one run told.

        Raises:
          InputError: it failed.
        """
        words = [_EXAMPLE, "--seconds", f"{self.seconds:g}", "--core", str(self.core)]
        ended = subprocess.run(
            [sys.executable, *words], cwd=_ROOT, capture_output=True, text=True, check=False
        )
        told = TOLD.search(ended.stdout)
        if ended.returncode or not told:
            last = ended.stderr.strip().splitlines()[-1:]
            raise InputError(f"core = {self.core} is not allowed here: {' '.join(last)}")
        values = zip(_FOUND.items(), told.groups(), strict=True)
        return xr.Dataset(
            {
                name: ((), float(value), {"units": unit, "long_name": words})
                for (name, (unit, words)), value in values
            }
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Times of each run."""
        return [Section("Steps", "", [list(_COLUMNS), *table(results)])]


on_a_robot = call_of(OnARobot)


def table(found: xr.Dataset) -> list[list[str]]:
    """A row for each run."""
    rows = []
    for number in range(found.sizes["run"]):
        one = {name: float(found[name][number]) for name in _FOUND}
        slow, worst = (f"{one[name] / 1000:.1f} ms" for name in ("slow", "worst"))
        rows.append([str(number + 1), f"{one['median']:.0f} µs", slow, worst, f"{one['late']} %"])
    return rows
