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
from typing import Literal

import numpy as np
import xarray as xr

import rps_jax
from rps_jax import InputError
from rps_jax.questions import Run, call_of, option
from sweeps.speed.commands import TIMING, printed
from sweeps.study_base import Parts, SpeedStudy, Table, records, text_table

_LIMIT = 3600.0  # [s] of a sweep
# Comparisons: names of both, and environment and options of the second.
_PAIRS: dict[str, tuple[tuple[str, str], dict[str, str], str]] = {
    "xla": (("compiled here", "by XLA"), {"RPS_COMPILER": "none"}, ""),
    "cpu": (("on the GPU", "on processors"), {}, " --device cpu"),
}


@dataclass(frozen=True)
class Compilers(SpeedStudy[xr.Dataset]):
    """Compare sweeps with the native loop with sweeps by XLA, or on processors.

    The results hold, by skin, the share of equal outcomes, and the success rates and simulated
    seconds per second of both.
    """

    TITLE = "The loop compiled here, and by XLA"
    DIMENSION = "skin"
    GROWS = ("skins", "file")

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

    def parts(self, run: Run) -> Parts:
        """Return the function that compares both sweeps with each skin."""
        return {skin: partial(self._compared, skin) for skin in self.skins}

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return outcomes and speeds of both."""
        (first, second), *_ = _PAIRS[self.against]
        columns = {
            "law": self.law,
            "skin": "{skin}",
            "worlds": f"{self.worlds:,}",
            "equal outcomes": "{equal:.1f} %",
            first: "{here:.1f} %",
            second: "{other:.1f} %",
            "simulated s/s": "{rate_here:,.0f} and {rate_other:,.0f}",
        }
        percent = results.assign({name: 100 * results[name] for name in ("equal", "here", "other")})
        rows = text_table(columns, records(percent, "skin"))
        return [Table(rows, name=self.file, title="Outcomes and speeds")]

    def _compared(self, skin: str) -> xr.Dataset:
        """Return the comparison of both sweeps."""
        _, environment, options = _PAIRS[self.against]
        command = f"sweep --laws {self.law} --domain wide,skin={skin} --worlds {self.worlds}"
        with tempfile.TemporaryDirectory() as folder:
            first, rate_here = _swept(command, Path(folder), "here", {})
            second, rate_other = _swept(command + options, Path(folder), "other", environment)
        return xr.Dataset(
            {
                "equal": np.mean(first == second),
                "here": np.mean(first),
                "other": np.mean(second),
                "rate_here": rate_here,
                "rate_other": rate_other,
            }
        )


compilers = call_of(Compilers)


def _swept(
    command: str, folder: Path, name: str, environment: Mapping[str, str]
) -> tuple[np.ndarray, float]:
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
