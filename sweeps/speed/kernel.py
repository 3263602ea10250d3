"""Stall reasons of the GPU kernel between two instructions of a warp.

Nsight Compute (`ncu` of the CUDA toolkit) profiles the second launch of a sweep, in the middle of
most pushes. The sweep runs in a separate process, once without the profiler to fill the cache.

    rps sweeps/speed/kernel.py --machine "one NVIDIA H200"
"""

from __future__ import annotations

import csv
import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import xarray as xr

from rps_jax import InputError, Setting
from rps_jax.questions import Run, call_of, option
from rps_jax.trials.batch import SEGMENT
from sweeps.programs import FAMILIES
from sweeps.study_base import Parts, SpeedStudy, Table, records, run_process, text_table

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
_COLUMNS = {
    "family": "{family}",
    "worlds": "{worlds:,}",
    "control step": "{step:.0f} µs",
    "instructions of a warp in it": "{executed:,.0f}",
    "registers": "{registers:.0f}",
    "cycles between two": "{between:.1f}",
    "for the instruction": "{fetch:.1f}",
    "for its latency": "{latency:.1f}",
    "for shared memory and roots": "{shared:.1f}",
    "for memory": "{memory:.1f}",
    "for branches": "{branch:.1f}",
    "other": "{rest:.1f}",
}


@dataclass(frozen=True)
class Kernel(SpeedStudy[xr.Dataset]):
    """Profile the kernel of a GPU: instructions, registers and stall reasons of its warps.

    The results hold the counters of Nsight Compute for 10 simulated seconds, by shape family.
    """

    TITLE = "Stall reasons of the kernel"
    DIMENSION = "family"
    GROWS = ("families",)

    law: str = "rps_tuned"
    """Law to run."""
    families: tuple[Literal["box", "cylinder", "prism"], ...] = FAMILIES
    """Families of the objects: box, cylinder, prism."""
    worlds: int = option(16_384, 8193, 10_000_000)
    """Number of worlds of `wide`."""

    def check(self) -> None:
        """Check that the profiler is installed."""
        if shutil.which("ncu") is None:
            raise InputError("ncu is not installed: install NVIDIA's CUDA toolkit, which has it.")

    def parts(self, run: Run) -> Parts:
        """Return the function that profiles each family."""
        return {family: partial(self._profiled, family) for family in self.families}

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the stall reasons of each family."""
        steps = SEGMENT / Setting().physics.control_period
        counts = results.assign(
            worlds=self.worlds,
            step=results.time / steps / 1e3,
            executed=results.instructions / results.warps / steps,
            rest=results.between - sum(results[name] for name in _WAITS),
        )
        return [Table(text_table(_COLUMNS, records(counts, "family")), name="kernel")]

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
                run_process([*profiler.split(), *words], f"families = {family} cannot be counted")
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
    return xr.Dataset(
        {
            ours: ((), float(values[name].replace(",", "")), {"long_name": meaning})
            for name, (ours, meaning) in _COUNTERS.items()
        }
    )
