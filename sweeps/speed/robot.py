"""Time of a step of the law on a robot, from 42 taxels to a twist, a thousand times per second.

A separate process runs `notebooks/examples/on_a_robot.py`, which prints its measurements.

    rps sweeps/speed/robot.py --core 1 --machine "one of 2 cores of an AMD EPYC"
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import xarray as xr

from rps_jax.questions import Run, call_of, option
from sweeps.study_base import Parts, Study, Table, records, run_process, text_table

_ROOT = Path(__file__).parents[2]
_EXAMPLE = "notebooks/examples/on_a_robot.py"
PRINTED = re.compile(r"median (\d+) us, 99.9th percentile (\d+) us, worst (\d+) us; ([\d.]+)%")
_VARIABLES = {
    "median": {"units": "us", "long_name": "median time of a step"},
    "slow": {"units": "us", "long_name": "99.9th percentile of the times"},
    "worst": {"units": "us", "long_name": "longest time of a step"},
    "late": {"units": "%", "long_name": "share of the steps that were longer than their period"},
}
_COLUMNS = {
    "run": "{number}",
    "median": "{median:.0f} µs",
    "99.9th percentile": "{slow:.1f} ms",
    "worst": "{worst:.1f} ms",
    "steps of more than 1 ms": "{late} %",
}


@dataclass(frozen=True)
class OnARobot(Study[xr.Dataset]):
    """Time the steps of the law at the rate of a robot, in several runs.

    The results hold `median`, `slow`, `worst` [us] and `late` [%] by run.
    """

    TITLE = "Time of a step on a robot"
    DIMENSION = "run"
    GROWS = ("runs", "core")
    RESULTS = "../results"

    runs: int = option(2, 1, 100)
    """Number of runs."""
    seconds: float = option(12.0, above=0, at_most=3600, unit="s")
    """Length of a run [s]."""
    core: int = option(0, 0, 4095)
    """Processor core of the process."""

    def parts(self, run: Run) -> Parts:
        """Return the function that times each run."""
        return dict.fromkeys(range(self.runs), self._timed)

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the times of each run."""
        shown = results.assign(
            number=results.run + 1, slow=results.slow / 1000, worst=results.worst / 1000
        )
        return [Table(text_table(_COLUMNS, records(shown, "run")), name="robot", title="Steps")]

    def _timed(self) -> xr.Dataset:
        """Return the times that one run prints.

        Raises:
          InputError: the run failed.
        """
        arguments = [_EXAMPLE, "--seconds", f"{self.seconds:g}", "--core", str(self.core)]
        problem = f"core = {self.core} is not allowed here"
        output = run_process([sys.executable, *arguments], problem, _ROOT)
        match = PRINTED.search(output)
        assert match is not None
        values = zip(_VARIABLES.items(), match.groups(), strict=True)
        return xr.Dataset({name: ((), float(value), about) for (name, about), value in values})


on_a_robot = call_of(OnARobot)
