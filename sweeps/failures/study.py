"""Does mass cost anything?

    rps sweeps/failures --law rps_plus --worlds 65536

asks what `rps sensitivity` asks, and compares success between the thirds of a quantity's range.
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
_NOTHING = 0.05  # [1] a total index that is not worth a word


@dataclass(frozen=True)
class Cost(Sensitivity):
    """Say whether a drawn quantity costs success, beside what `rps sensitivity` says."""

    TITLE: ClassVar[str] = "What a quantity costs"

    quantity: str = "mass"
    """Drawn quantity that is asked about."""

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Whether the quantity costs anything, and the indices."""
        section = Section(f"Does {self.quantity} cost anything", said(results, self.quantity))
        return [section, *super().report(results, run)]


cost = call_of(Cost)


def difference(found: xr.Dataset, name: str) -> tuple[float, float, float]:
    """Success in the upper third of a quantity's range less that in its lower third, with 95 %.

    The interval resamples base points, since the worlds of one differ in one factor only.
    """
    at = found.u.sel(quantity=name).values
    won = found.success.values
    high, low = at >= 2 / 3, at < 1 / 3
    blocks = np.arange(won.size) // (won.size // found.attrs["base"])
    sums = np.stack(
        [np.bincount(blocks, w, found.attrs["base"]) for w in (high * won, high, low * won, low)]
    )
    rng = np.random.default_rng(0)
    drawn = rng.integers(0, sums.shape[1], (_RESAMPLES, sums.shape[1]))
    a, b, c, d = sums[:, drawn].sum(axis=2)
    spread = a / np.maximum(b, 1) - c / np.maximum(d, 1)
    a, b, c, d = sums.sum(axis=1)
    ends = np.quantile(spread, [0.025, 0.975])
    return float(a / max(b, 1) - c / max(d, 1)), float(ends[0]), float(ends[1])


def said(found: xr.Dataset, name: str = "mass") -> str:
    """Whether a quantity costs success, in a sentence."""
    if name not in found.factor.values:
        return f"The domain draws no {name}."
    change, low, high = (100 * value for value in difference(found, name))
    one = found.sel(output="success", factor=name)
    numbers = (
        f"between the lower and the upper third of its range success changes by {change:+.1f} "
        f"points [{low:+.1f}, {high:+.1f}], and its total index is {one.total:.2f} ± "
        f"{one.total_reach:.2f}"
    )
    if high < 0:
        return f"More {name} costs success: {numbers}."
    if low > 0:
        return f"More {name} helps: {numbers}."
    if (
        float(one.total - one.total_reach) > _NOTHING
        and count_failing_points(found) >= MIN_FAILING_POINTS
    ):
        return f"On average {name} costs nothing, but together with others it matters: {numbers}."
    return f"No cost of {name} is seen in {found.sizes['world']:,} worlds: {numbers}."
