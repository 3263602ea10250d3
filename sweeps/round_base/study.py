"""Flat against round bases of equal width: success and time of laws in equal worlds.

rps sweeps/round_base --worlds 10000
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np
import xarray as xr

from rps_jax import Setting
from rps_jax.analysis import statistics, tables
from rps_jax.laws import LawsLike
from rps_jax.questions import MultiLawQuestion, Plan, Run, Section, call_of, option
from rps_jax.worlds import DomainLike, parse_domain
from sweeps.study_base import PlanStudy, Rows, run_plans

BASES = {"flat": "ideal", "round": "round"}  # robots, 0.58 m wide


@dataclass(frozen=True)
class RoundBase(PlanStudy[xr.Dataset], MultiLawQuestion[xr.Dataset]):
    """Compare a flat and a round base of equal width, in equal worlds.

    The results hold `success` and `time` (base, law, world).
    """

    TITLE = "Flat and round bases"
    QUICK: ClassVar = {"worlds": 32}

    laws: LawsLike = ("rps", "rps_tuned", "aps", "dipole", "force_push")
    domain: DomainLike = "wide"
    """Ranges from which worlds are drawn: paper, hardware, wide, prisms or hostile, or a JSON file
    of ranges; changes follow, as wide,mass=3:10."""
    worlds: int = option(10000, 1, 10_000_000)
    """Number of worlds."""
    setting: Setting = field(default=Setting(seed=11), kw_only=True)

    @cached_property
    def plans(self) -> dict[str, Plan]:
        """The sweep of each base."""
        return {
            base: Plan(parse_domain(self.domain, robot), self.worlds, self.chosen, self.setting)
            for base, robot in BASES.items()
        }

    def answer(self, run: Run) -> xr.Dataset:
        """Sweep with both bases."""
        parts = run_plans(run, self.plans)
        trials = [parts[base][["success", "time"]] for base in BASES]
        return xr.concat(trials, xr.IndexVariable("base", list(BASES)))

    def intro(self, results: xr.Dataset) -> str:
        """Describe the worlds."""
        return (
            f"{self.worlds:,} worlds, seed {self.setting.seed}, equal for both bases; square "
            "brackets: 95 % intervals, of rates Wilson, of differences world by world."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Return success and time of each law on both bases."""
        return [Section("Flat against round", "", compared(results))]


round_base = call_of(RoundBase)


def compared(results: xr.Dataset) -> Rows:
    """Return a header and a row for each law: success, time, and their differences."""
    pair = "round - flat"
    times = "median time, flat", "median time, round", f"time, {pair}, where both succeed"
    rows = [["law", "success, flat", "success, round", pair, "gained", "lost", *times]]
    for law in map(str, results.law.values):
        trials = results.sel(law=law)
        flat, curved = (trials.success.sel(base=base) for base in BASES)
        comparison = statistics.compare(flat, curved)
        rates = (tables.rate(x.values) for x in (flat, curved))
        points = 100 * (curved.values.astype(float) - flat.values)
        times = [trials.time.sel(base=base).values for base in BASES]
        medians = (
            tables.median(time[x.values > 0], "{:.0f} s")
            for time, x in zip(times, (flat, curved), strict=True)
        )
        both = (flat.values > 0) & (curved.values > 0)
        longer = _mean((times[1] - times[0])[both], "s")
        counts = str(comparison.gained), str(comparison.lost)
        rows.append([law, *rates, _mean(points, "points"), *counts, *medians, longer])
    return rows


def _mean(values: np.ndarray, unit: str) -> str:
    """Format the mean of differences with its 95 % interval."""
    if values.size < 2:
        return "-"
    mean, half = values.mean(), 1.96 * values.std(ddof=1) / np.sqrt(values.size)
    return f"{mean:+.1f} {unit} [{mean - half:+.1f}, {mean + half:+.1f}]"
