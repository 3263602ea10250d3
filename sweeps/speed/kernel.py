"""What does the kernel of a GPU wait for, between two instructions of a warp?

Nsight Compute (`ncu`, of the CUDA toolkit) counts what the second launch of a sweep does, which is
in the middle of most pushes. The sweep is a process of its own, run once before so that nothing is
compiled under the profiler.

    rps sweeps/speed/kernel.py --machine "one NVIDIA H200"
"""

from __future__ import annotations

import csv
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import xarray as xr

from rps_jax.analysis.report import Section
from rps_jax.errors import InputError
from rps_jax.record.options import option
from rps_jax.runs.question import Run, call_of
from rps_jax.trials.batch import SEGMENT
from rps_jax.trials.progress import Progress
from rps_jax.trials.setting import Setting
from sweeps import programs
from sweeps.programs import FAMILIES
from sweeps.study_base import Study, Table

_STALLED = "smsp__average_warps_issue_stalled_{}_per_issue_active.ratio"
# Of what is counted: Nsight's name, ours, and what it is.
_COUNTED = {
    "gpu__time_duration.sum": ("time", "time of the launch [ns]"),
    "smsp__inst_executed.sum": ("instructions", "instructions of all warps"),
    "smsp__warps_launched.sum": ("warps", "warps"),
    "launch__registers_per_thread": ("registers", "registers of a thread"),
    "smsp__average_warp_latency_per_inst_issued.ratio": ("between", "cycles of a warp between two"),
    _STALLED.format("no_instruction"): ("fetch", "of them until the instruction is there"),
    _STALLED.format("wait"): ("latency", "of them for as long as an instruction takes anyway"),
    _STALLED.format("short_scoreboard"): ("shared", "of them for shared memory, roots, quotients"),
    _STALLED.format("long_scoreboard"): ("memory", "of them for memory"),
    _STALLED.format("branch_resolving"): ("branch", "of them for a branch"),
}
_WAITS = ("fetch", "latency", "shared", "memory", "branch")
_COLUMNS = (
    *("family", "worlds", "control step", "instructions of a warp in it", "registers"),
    *("cycles between two", "for the instruction", "for its latency"),
    *("for shared memory and roots", "for memory", "for branches", "other"),
)


@dataclass(frozen=True)
class Kernel(Study[xr.Dataset]):
    """Count what the kernel of a GPU does, and what its warps wait for.

    The answer holds what Nsight Compute counts of 10 simulated seconds, by the family of objects.
    """

    TITLE: ClassVar[str] = "What the kernel waits for"
    GROWS: ClassVar[tuple[str, ...]] = ("families",)

    law: str = "rps_tuned"
    """What decides."""
    families: tuple[Literal["box", "cylinder", "prism"], ...] = FAMILIES
    """Families of the objects: box, cylinder, prism."""
    worlds: int = option(16_384, 8193, 10_000_000)
    """Number of worlds of `wide`; more than are set aside for the end."""

    def check(self) -> None:
        """Check that the profiler is there."""
        if shutil.which("ncu") is None:
            raise InputError("ncu is not here: it is a part of NVIDIA's CUDA toolkit.")

    def num_trials(self) -> int | None:
        """How many families there are."""
        return len(self.families)

    def answer(self, run: Run) -> xr.Dataset:
        """Count what was not counted before."""
        found = []
        for number, family in enumerate(self.families):
            found.append(run.checkpoint(family, partial(self._counted, family)))
            run.callback(Progress(number + 1, 0.0))
        whole: Any = xr.concat(found, "family").assign_coords(family=list(self.families))
        return whole

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return the counts of each family."""
        return {"kernel": Table([_COLUMNS, *self.table(results)])}

    def intro(self, results: xr.Dataset) -> str:
        """Where it was measured."""
        return programs.machine()

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """What the kernel of each family waits for."""
        return [Section("Waits", "", [list(_COLUMNS), *self.table(results)])]

    def table(self, found: xr.Dataset) -> list[list[str]]:
        """A row for each family."""
        steps, rows = SEGMENT / Setting().physics.control_period, []
        for family in map(str, found.family.values):
            one = {name: leaf.item() for name, leaf in found.sel(family=family).items()}
            waits = [one[name] for name in _WAITS]
            rows.append([
                family, f"{self.worlds:,}", f"{one['time'] / steps / 1e3:.0f} µs",
                f"{one['instructions'] / one['warps'] / steps:,.0f}", f"{one['registers']:.0f}",
                f"{one['between']:.1f}", *(f"{wait:.1f}" for wait in waits),
                f"{one['between'] - sum(waits):.1f}",
            ])  # fmt: skip
        return rows

    def _counted(self, family: str) -> xr.Dataset:
        """What is counted of a launch.

        Raises:
          InputError: the sweep or the profiler failed.
        """
        asked = f"--laws {self.law} --domain wide,objects=random_{family} --worlds {self.worlds}"
        asked = f"-m rps_jax sweep {asked} --horizon {3 * SEGMENT:g} --device gpu"
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "counted.csv"
            ncu = (
                "ncu --clock-control none --kernel-name step --launch-skip 1 --launch-count 1 "
                f"--csv --page raw --print-units base --log-file {log} "
                f"--metrics {','.join(_COUNTED)}"
            )
            for number, before in enumerate(("", ncu)):
                words = [sys.executable, *asked.split(), "--out", f"{folder}/run_{number}"]
                done = subprocess.run([*before.split(), *words], capture_output=True, text=True)
                if done.returncode:
                    last = (done.stderr or done.stdout).strip().splitlines()[-1:]
                    raise InputError(f"families = {family} cannot be counted: {' '.join(last)}")
            return counts(log.read_text())


kernel = call_of(Kernel)


def counts(text: str) -> xr.Dataset:
    """What a table of Nsight Compute holds of its last launch.

    Raises:
      InputError: it holds no launch.
    """
    rows = list(csv.reader(line for line in text.splitlines() if line.startswith('"')))
    if len(rows) < 3:  # names, units and one launch
        raise InputError(f"Nsight Compute counted nothing: {' '.join(text.split()[-20:])}.")
    values = dict(zip(rows[0], rows[-1], strict=True))
    return xr.Dataset({
        ours: ((), float(values[name].replace(",", "")), {"long_name": meaning})
        for name, (ours, meaning) in _COUNTED.items()
    })  # fmt: skip
