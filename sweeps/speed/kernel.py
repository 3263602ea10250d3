"""Stall reasons of the GPU kernel between two instructions of a warp.

Nsight Compute (`ncu` of the CUDA toolkit) profiles the second launch of a sweep, in the middle of
most pushes. The sweep runs in a separate process, once without the profiler to fill the cache.

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
# Counters: name of Nsight Compute, variable, description.
_COUNTERS = {
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
    """Profile the kernel of a GPU: instructions, registers and stall reasons of its warps.

    The results hold the counters of Nsight Compute for 10 simulated seconds, by shape family.
    """

    TITLE: ClassVar[str] = "Stall reasons of the kernel"
    GROWS: ClassVar[tuple[str, ...]] = ("families",)

    law: str = "rps_tuned"
    """Law to run."""
    families: tuple[Literal["box", "cylinder", "prism"], ...] = FAMILIES
    """Families of the objects: box, cylinder, prism."""
    worlds: int = option(16_384, 8193, 10_000_000)
    """Number of worlds of `wide`; it must exceed the number of suspended trials."""

    def check(self) -> None:
        """Check that the profiler is installed."""
        if shutil.which("ncu") is None:
            raise InputError("ncu is not installed: install NVIDIA's CUDA toolkit, which has it.")

    def num_trials(self) -> int | None:
        """Return the number of families."""
        return len(self.families)

    def answer(self, run: Run) -> xr.Dataset:
        """Profile the families that are missing."""
        parts = []
        for i, family in enumerate(self.families):
            parts.append(run.checkpoint(family, partial(self._profiled, family)))
            run.callback(Progress(i + 1, 0.0))
        results: Any = xr.concat(parts, "family").assign_coords(family=list(self.families))
        return results

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return the counts of each family."""
        return {"kernel": Table([_COLUMNS, *self.table(results)])}

    def intro(self, results: xr.Dataset) -> str:
        """Return the device of the measurement."""
        return programs.machine()

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Return a section with the stall reasons of each family."""
        return [Section("Waits", "", [list(_COLUMNS), *self.table(results)])]

    def table(self, results: xr.Dataset) -> list[list[str]]:
        """Return one row per family."""
        steps, rows = SEGMENT / Setting().physics.control_period, []
        for family in map(str, results.family.values):
            counts = {name: leaf.item() for name, leaf in results.sel(family=family).items()}
            waits = [counts[name] for name in _WAITS]
            rows.append([
                family, f"{self.worlds:,}", f"{counts['time'] / steps / 1e3:.0f} µs",
                f"{counts['instructions'] / counts['warps'] / steps:,.0f}",
                f"{counts['registers']:.0f}",
                f"{counts['between']:.1f}", *(f"{wait:.1f}" for wait in waits),
                f"{counts['between'] - sum(waits):.1f}",
            ])  # fmt: skip
        return rows

    def _profiled(self, family: str) -> xr.Dataset:
        """Profile one launch.

        Raises:
          InputError: the sweep or the profiler failed.
        """
        sweep = f"--laws {self.law} --domain wide,objects=random_{family} --worlds {self.worlds}"
        sweep = f"-m rps_jax sweep {sweep} --horizon {3 * SEGMENT:g} --device gpu"
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "counted.csv"
            ncu = (
                "ncu --clock-control none --kernel-name step --launch-skip 1 --launch-count 1 "
                f"--csv --page raw --print-units base --log-file {log} "
                f"--metrics {','.join(_COUNTERS)}"
            )
            for i, profiler in enumerate(("", ncu)):
                words = [sys.executable, *sweep.split(), "--out", f"{folder}/run_{i}"]
                process = subprocess.run(
                    [*profiler.split(), *words], capture_output=True, text=True
                )
                if process.returncode:
                    last = (process.stderr or process.stdout).strip().splitlines()[-1:]
                    raise InputError(f"families = {family} cannot be counted: {' '.join(last)}")
            return counts(log.read_text())


kernel = call_of(Kernel)


def counts(text: str) -> xr.Dataset:
    """Return the counters of the last launch in a table of Nsight Compute.

    Raises:
      InputError: the table has no launch.
    """
    rows = list(csv.reader(line for line in text.splitlines() if line.startswith('"')))
    if len(rows) < 3:  # names, units and one launch
        raise InputError(f"Nsight Compute profiled no launch: {' '.join(text.split()[-20:])}.")
    values = dict(zip(rows[0], rows[-1], strict=True))
    return xr.Dataset({
        ours: ((), float(values[name].replace(",", "")), {"long_name": meaning})
        for name, (ours, meaning) in _COUNTERS.items()
    })  # fmt: skip
