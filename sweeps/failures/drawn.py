"""Comparison of rare-failure estimates with the rate in drawn worlds.

    rps sweeps/failures/drawn.py --law rps --repetitions 20 --brute 100000

runs `rps rare`, and compares its estimates with the rate in drawn worlds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from rps_jax.analysis import statistics
from rps_jax.questions import Plan, Run, Section, call_of, option
from rps_jax.studies.rare import Estimate, Rare, estimate_row, estimate_table
from rps_jax.trials.progress import set_phase
from rps_jax.trials.score import severity_of
from sweeps.study_base import run_plans


@dataclass(frozen=True)
class Drawn(Rare):
    """Compare subset simulation with the rate in drawn worlds.

    The results are those of `rps_jax.rare`, with the estimate from drawn worlds as `drawn_p`.
    """

    TITLE = "Rare failures, and drawn worlds"
    IGNORED_FIELDS = ("brute",)

    brute: int = option(1000, 1, 1_000_000_000)
    """Number of drawn worlds for the comparison."""

    def configuration(self) -> dict[str, Any]:
        """Return everything that the estimates depend on, without the drawn worlds."""
        return super().configuration() | {"question": "rare"}

    def answer(self, run: Run) -> xr.Dataset:
        """Estimate, and sweep the drawn worlds in the subfolder `drawn`."""
        estimates = super().answer(run)
        plan = Plan(self.ranges, self.brute, {"law": self.params}, self.setting, 4096)
        set_phase(run.callback, "drawn worlds")
        results = run_plans(run, {"drawn": plan})["drawn"]
        failed = severity_of(results.sel(law="law"), self.setting.rules) >= self.level
        estimate = of_drawn(int(failed.sum()), failed.size)._asdict()
        return estimates.assign({f"drawn_{name}": value for name, value in estimate.items()})

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Return a section that compares the estimates with drawn worlds."""
        (section,) = super().report(results, run)
        values = (float(results[f"drawn_{name}"]) for name in Estimate._fields)
        against = Estimate._make(values)._replace(trials=int(results.drawn_trials))
        text = f"{section.text} Those of drawn worlds are by Clopper and Pearson."
        if against.p:
            off = 100 * (float(results.p.mean()) / against.p - 1)
            held = int(((results.low <= against.p) & (against.p <= results.high)).sum())
            text += (
                f" {held} of {self.repetitions} intervals hold the rate of the drawn worlds, and "
                f"the mean of all is {off:+.1f} % off it."
            )
        else:
            text += " None of the drawn worlds fails."
        rows = [*estimate_table(results), [*estimate_row("drawn worlds", against)[:-1], ""]]
        return [section._replace(text=text, table=rows)]


drawn = call_of(Drawn)


def of_drawn(failures: int, trials: int) -> Estimate:
    """Estimate the probability from drawn worlds, with the interval of Clopper and Pearson."""
    p = failures / trials
    low, high = statistics.clopper_pearson(failures, trials)
    variation = np.sqrt((1 - p) / (p * trials)) if failures else float("inf")
    return Estimate(p, low, high, float(variation), trials)
