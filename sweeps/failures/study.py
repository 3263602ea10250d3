"""Effect of a drawn quantity on success.

    rps sweeps/failures --law rps_plus --worlds 65536

runs `rps sensitivity`, and compares success between the thirds of the range of a quantity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import xarray as xr

from rps_jax.analysis.report import Section
from rps_jax.runs.question import Run, call_of
from rps_jax.studies.sensitivity import MIN_FAILING_POINTS, Sensitivity, count_failing_points

_RESAMPLES = 1000
_SMALL_INDEX = 0.05  # [1] smaller total indices are not mentioned


@dataclass(frozen=True)
class Cost(Sensitivity):
    """Test whether a drawn quantity reduces success, in addition to `rps sensitivity`."""

    TITLE: ClassVar[str] = "What a quantity costs"

    quantity: str = "mass"
    """Drawn quantity to test."""

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Return sections with the effect of the quantity and the indices."""
        text = cost_sentence(results, self.quantity)
        section = Section(f"Does {self.quantity} cost anything", text)
        return [section, *super().report(results, run)]


cost = call_of(Cost)


def difference(results: xr.Dataset, name: str) -> tuple[float, float, float]:
    """Return success in the upper minus the lower third of a quantity's range, with 95 % interval.

    The interval resamples base points, because worlds of one base point differ in one factor only.
    """
    at = results.u.sel(quantity=name).values
    success = results.success.values
    high, low = at >= 2 / 3, at < 1 / 3
    blocks = np.arange(success.size) // (success.size // results.attrs["base"])
    counts = (high * success, high, low * success, low)
    sums = np.stack([np.bincount(blocks, x, results.attrs["base"]) for x in counts])
    rng = np.random.default_rng(0)
    drawn = rng.integers(0, sums.shape[1], (_RESAMPLES, sums.shape[1]))

    def rise(sums: np.ndarray) -> np.ndarray:
        won_high, in_high, won_low, in_low = sums
        return won_high / np.maximum(in_high, 1) - won_low / np.maximum(in_low, 1)

    interval = np.quantile(rise(sums[:, drawn].sum(axis=2)), [0.025, 0.975])
    return float(rise(sums.sum(axis=1))), float(interval[0]), float(interval[1])


def cost_sentence(results: xr.Dataset, name: str = "mass") -> str:
    """Return a sentence on the effect of a quantity on success."""
    if name not in results.factor.values:
        return f"The domain draws no {name}."
    change, low, high = (100 * value for value in difference(results, name))
    index = results.sel(output="success", factor=name)
    values = (
        f"between the lower and the upper third of its range success changes by {change:+.1f} "
        f"points [{low:+.1f}, {high:+.1f}], and its total index is {index.total:.2f} ± "
        f"{index.total_reach:.2f}"
    )
    if high < 0:
        return f"More {name} costs success: {values}."
    if low > 0:
        return f"More {name} helps: {values}."
    matters = float(index.total - index.total_reach) > _SMALL_INDEX
    if matters and count_failing_points(results) >= MIN_FAILING_POINTS:
        return f"On average {name} costs nothing, but together with others it matters: {values}."
    return f"No cost of {name} is seen in {results.sizes['world']:,} worlds: {values}."
