"""Outcomes and speed of the loop with the native compiler and with XLA.

Two processes sweep the same worlds: one with the loop compiled natively (`cc`, or NVRTC on a GPU),
the other with the loop compiled by XLA, as on machines without a compiler; or on a GPU and on
processors.

    rps sweeps/speed/compilers.py --machine "2 cores of an AMD EPYC"
    rps sweeps/speed/compilers.py --against cpu --worlds 4000 --machine "one NVIDIA H100"
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import xarray as xr

import rps_jax
from rps_jax.analysis.report import Section
from rps_jax.errors import InputError
from rps_jax.record.options import option
from rps_jax.runs.question import Run, call_of
from rps_jax.trials.progress import Progress
from sweeps import programs
from sweeps.speed.commands import TIMING, printed
from sweeps.study_base import Study, Table

_LIMIT = 3600.0  # [s] of a sweep
# Comparisons: names of both, and environment and options of the second.
_PAIRS: dict[str, tuple[tuple[str, str], dict[str, str], str]] = {
    "xla": (("compiled here", "by XLA"), {"RPS_COMPILER": "none"}, ""),
    "cpu": (("on the GPU", "on processors"), {}, " --device cpu"),
}


@dataclass(frozen=True)
class Compilers(Study[xr.Dataset]):
    """Compare sweeps with the native loop with sweeps by XLA, or on processors.

    The results hold, by skin, the share of equal outcomes, and the success rates and simulated
    seconds per second of both.
    """

    TITLE: ClassVar[str] = "The loop compiled here, and by XLA"
    GROWS: ClassVar[tuple[str, ...]] = ("skins", "file")

    law: str = "rps_tuned"
    """Law to run."""
    skins: tuple[str, ...] = ("capacitive", "ideal")
    """Skins of the domain."""
    worlds: int = option(1000, 1, 1_000_000)
    """Number of worlds of `wide`."""
    against: Literal["xla", "cpu"] = "xla"
    """Sweep of comparison: by XLA, or on processors."""
    file: str = "compilers"
    """Name of the data file."""

    def num_trials(self) -> int | None:
        """Return the number of skins."""
        return len(self.skins)

    def answer(self, run: Run) -> xr.Dataset:
        """Run the sweeps that are missing."""
        parts = []
        for i, skin in enumerate(self.skins):
            parts.append(run.checkpoint(skin, partial(self._compared, skin)))
            run.callback(Progress(i + 1, 0.0))
        results: Any = xr.concat(parts, "skin").assign_coords(skin=list(self.skins))
        return results

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return the comparison."""
        return {self.file: Table([self._columns, *self.table(results)])}

    def intro(self, results: xr.Dataset) -> str:
        """Return the device of the comparison."""
        return programs.machine()

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Return a section with outcomes and speeds of both."""
        return [Section("Outcomes and speeds", "", [self._columns, *self.table(results)])]

    @property
    def _columns(self) -> list[str]:
        names, *_ = _PAIRS[self.against]
        return ["law", "skin", "worlds", "equal outcomes", *names, "simulated s/s"]

    def table(self, results: xr.Dataset) -> list[list[str]]:
        """Return one row per skin."""
        rows = []
        for skin in map(str, results.skin.values):
            comparison = {name: leaf.item() for name, leaf in results.sel(skin=skin).items()}
            rates = f"{comparison['rate_here']:,.0f} and {comparison['rate_other']:,.0f}"
            rows.append([
                self.law, skin, f"{self.worlds:,}", f"{100 * comparison['equal']:.1f} %",
                f"{100 * comparison['here']:.1f} %", f"{100 * comparison['other']:.1f} %", rates,
            ])  # fmt: skip
        return rows

    def _compared(self, skin: str) -> xr.Dataset:
        """Return the comparison of both sweeps."""
        _, environment, options = _PAIRS[self.against]
        command = f"sweep --laws {self.law} --domain wide,skin={skin} --worlds {self.worlds}"
        with tempfile.TemporaryDirectory() as folder:
            first, rate_here = _swept(command, Path(folder), "here", {})
            second, rate_other = _swept(command + options, Path(folder), "other", environment)
        values = {
            "equal": float((first == second).mean()),
            "here": float(first.mean()),
            "other": float(second.mean()),
            "rate_here": rate_here,
            "rate_other": rate_other,
        }
        return xr.Dataset({name: ((), value) for name, value in values.items()})


compilers = call_of(Compilers)


def _swept(
    command: str, folder: Path, name: str, environment: Mapping[str, str]
) -> tuple[Any, float]:
    """Return success (world) and simulated seconds per second of a sweep without compilation.

    Raises:
      InputError: the sweep failed.
    """
    output, out = "", folder
    for i in range(2):  # the first run compiles
        out = folder / f"run_{name}_{i}"
        words = ["-m", "rps_jax", *command.split(), "--out", str(out)]
        output, _ = printed(words, command, str(folder), _LIMIT, environment=environment)
    if (match := TIMING.search(output)) is None:
        raise InputError(f"{command} printed no time of its run.")
    return rps_jax.load(out).success.values, float(match.group(3))
