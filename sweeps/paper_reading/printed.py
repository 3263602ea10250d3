"""Printed numbers of the paper, and their likelihood given simulated numbers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy import stats

from rps_jax.world import paper

D, TIME = 0.004, 2.5  # [m], [s] standard deviation of what no draw can explain
WRONG = 0.1  # [1] probability that the text tells the opposite of an observation
SHORT = {"hardware_box": "box", "hardware_cylinder": "cylinder"}


class Printed(NamedTuple):
    """Number of the paper."""

    value: float
    trials: int = 0  # trials of a count; 1: an observation that the text tells; 0: a mean
    deviation: float = 0.0  # of a mean
    unit: str = ""

    def log_likelihood(self, simulated: np.ndarray, trials: int) -> np.ndarray:
        """Return the log likelihood (n,) of simulated values (n,), counts being out of `trials`.

        A count is beta-binomial: both counts have one unknown rate, with the prior of Jeffreys.
        """
        if self.trials == 1:
            return np.log(np.where(simulated == self.value, 1 - WRONG, WRONG))
        if self.trials:
            rates = simulated + 0.5, trials - simulated + 0.5
            return stats.betabinom.logpmf(self.value, self.trials, *rates)
        off = stats.norm.logpdf(simulated, self.value, self.deviation)
        return np.where(np.isfinite(off), off, -np.inf)


def _printed() -> dict[str, Printed]:
    by_name = {}
    for key, name in SHORT.items():
        printed = paper.HARDWARE_RESULTS[key]
        by_name[f"hardware, {name}: successes"] = Printed(printed.success, 8)
        by_name[f"hardware, {name}: D"] = Printed(printed.mean_abs_l, 0, D, "m")
        by_name[f"hardware, {name}: time"] = Printed(printed.time, 0, TIME, "s")
    for (law, name, friction), count in paper.TABLE_II.items():
        words = name.replace("_", " ")
        by_name[f"Table II, {law.upper()}, {words} {friction}"] = Printed(count, 24)
    by_name |= {
        "RPS, nonuniform box to (0, 1)": Printed(0, 2),
        "NPS, beside or behind": Printed(0, 84),
        "APS, not straight ahead": Printed(0, 132),
        "Fig. 6: success": Printed(1, 1),
        "Fig. 6: the right corner touches first": Printed(1, 1),
        "Fig. 6: a_r starts near its highest": Printed(1, 1),
        "Fig. 6: line contact before Realignment": Printed(1, 1),
        "Fig. 6: one Realignment State": Printed(1, 1),
    }
    return by_name


PRINTED = _printed()
PARTS = ("hardware", "Table II", "targets", "Fig. 6")


def part_of(name: str) -> str:
    """Return the part of the paper that a number is of."""
    return next((part for part in PARTS if name.startswith(part)), "targets")


def counts(success: xr.DataArray) -> dict[str, tuple[np.ndarray, int]]:
    """Return the simulated counts (draw,) of Table II and of some targets, and their trials.

    Args:
      success: (draw, law, object, friction, target), with target_x and target_y [m].
    """
    by_name = {}
    for law in success.law.values:
        of_law = success.sel(law=law)
        for name in success.object.values:
            for friction in success.friction.values:
                words = f"Table II, {str(law).upper()}, {name.replace('_', ' ')} {friction}"
                cell = of_law.sel(object=name, friction=friction)
                by_name[words] = cell.sum("target").values, cell.sizes["target"]
    x, y = success.target_x, success.target_y
    side = (x == 0) & (y == 1)
    chosen = {
        "RPS, nonuniform box to (0, 1)": success.sel(law="rps", object=["nonuniform_box"]).where(
            side, drop=True
        ),
        "NPS, beside or behind": success.sel(law="nps").where(x <= 0, drop=True),
        "APS, not straight ahead": success.sel(law="aps").where(~((y == 0) & (x > 0)), drop=True),
    }
    for name, trials in chosen.items():
        dims = ("object", "friction", "target")
        by_name[name] = trials.sum(dims).values, int(np.prod([trials.sizes[d] for d in dims]))
    return by_name


def log_likelihoods(simulated: xr.DataArray, trials: xr.DataArray) -> xr.DataArray:
    """Return the log likelihood (draw, number) of simulated numbers, counts out of `trials`."""
    columns = [
        PRINTED[name].log_likelihood(
            simulated.sel(number=name).values, int(trials.sel(number=name))
        )
        for name in map(str, simulated.number.values)
    ]
    return simulated.copy(data=np.stack(columns, 1))
