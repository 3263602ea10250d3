"""Statistics of outcomes: rates with intervals, differences, failure modes and hardest worlds.

This module uses only the special functions of SciPy, because importing `scipy.stats` takes a second
of each command. A test compares it with `scipy.stats`.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import scipy
import xarray as xr
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.world import tasks
from rps_jax.world.domain import LABELS

FAILURES = (
    "never touched",
    "lost contact",
    "timeout",
    "fell over",
    "diverged",
    "stalled",
    "contact not felt",
)
_TAIL = 0.05  # share of the worlds in the tail of the CVaR
# Limits of all intervals of a report.
NOT_PROMISED = (
    "Every interval here is about worlds drawn as these were. It promises nothing about one given "
    "world, about worlds from elsewhere, or about worlds that a search has picked."
)


class Comparison(NamedTuple):
    """Outcomes of the same trials under two conditions, trial by trial."""

    gained: int  # trials that fail under the first and succeed under the second
    lost: int  # trials that succeed under the first and fail under the second
    p: float  # [1] of McNemar's exact test that gains and losses are equally likely

    def interval(self, trials: int) -> tuple[float, float]:
        """Return the interval (95 %) of the difference of the rates [1], of paired trials.

        Half a trial is added to each of the four outcomes of a pair (Agresti and Min, 2005); bounds
        are cut at -1 and 1.
        """
        gained, lost, total = self.gained + 0.5, self.lost + 0.5, trials + 2
        middle = (gained - lost) / total
        half_width = 1.96 * math.sqrt(((gained + lost) / total - middle**2) / total)
        return max(-1.0, middle - half_width), min(1.0, middle + half_width)

    @property
    def changes(self) -> str:
        """Gains and losses, for tables."""
        return f"+{self.gained} -{self.lost}"


class Bins(NamedTuple):
    """Success by bins of one quantity."""

    middle: np.ndarray  # (n,) median of the quantity over the worlds of each bin
    successes: np.ndarray  # (..., n)
    trials: np.ndarray  # (n,)


class Influence(NamedTuple):
    """Dependence of success on one quantity."""

    name: str  # of `LABELS`
    variance: float  # [1] of the success rate over its bins, as of `excess_variance`
    q: float  # [1] false discovery rate of the test that all bins have the same rate


def wilson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the Wilson score interval of a success rate; [0, 1] without trials."""
    if trials == 0:
        return 0.0, 1.0
    z = float(scipy.special.ndtri((1 + confidence) / 2))
    rate, ratio = successes / trials, z * z / trials
    middle = (rate + ratio / 2) / (1 + ratio)
    half_width = z / (1 + ratio) * math.sqrt(rate * (1 - rate) / trials + ratio / trials / 4)
    low = 0.0 if successes == 0 else middle - half_width
    return low, 1.0 if successes == trials else middle + half_width


def clopper_pearson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the exact interval of a rate, whose coverage is at least the confidence.

    Each end alone is a bound of confidence (1 + `confidence`) / 2 (Clopper and Pearson, 1934).
    """
    k, n, tail = successes, trials, (1 - confidence) / 2
    low = float(scipy.special.betaincinv(k, n - k + 1, tail)) if k else 0.0
    return low, float(scipy.special.betaincinv(k + 1, n - k, 1 - tail)) if k < n else 1.0


def fails_at_most(failures: int, trials: int, picked_of: int = 1) -> float:
    """Return the upper bound (95 %) of a failure rate [1], also of the least of several rates.

    The best of N candidates on the same worlds looks better than it is. Its bound holds if the
    bounds of all N hold, so each has confidence 1 - 0.05 / N; this needs no independence.
    """
    confidence = 1 - (1 - 0.95) / picked_of
    return clopper_pearson(failures, trials, 2 * confidence - 1)[1]


def compare(first: xr.DataArray, second: xr.DataArray) -> Comparison:
    """Compare outcomes (any equal shape) of the same trials."""
    a, b = first.values.astype(bool).ravel(), second.values.astype(bool).ravel()
    gained, lost = int(np.sum(~a & b)), int(np.sum(a & ~b))
    p = min(1.0, 2 * float(scipy.special.bdtr(min(gained, lost), gained + lost, 0.5)))
    return Comparison(gained, lost, p)


def worlds_by_object(results: xr.Dataset) -> dict[str, np.ndarray]:
    """Return a mask (world,) of the worlds with each object."""
    objects = results.object.values
    return {str(name): objects == name for name in dict.fromkeys(objects.tolist())}


def varied_quantities(results: xr.Dataset) -> list[str]:
    """Return the names of the quantities of `LABELS` that differ between worlds."""

    def differs(values: np.ndarray) -> bool:
        values = values[np.isfinite(values)]
        return bool(values.size and values.min() < values.max())

    return [name for name in LABELS if name in results and differs(results[name].values)]


def cvar(values: np.ndarray) -> float:
    """Compute the conditional value at risk: the mean of the greatest 5 % of the values."""
    count = max(1, round(_TAIL * values.size))
    return float(np.sort(values)[-count:].mean())


def cvar_interval(values: np.ndarray) -> tuple[float, float]:
    """Return the approximate interval (95 %) of `cvar`.

    With q the quantile, the mean of q + max(x - q, 0) / tail has the variance of the CVaR (Trindade
    et al., 2007). The interval is symmetric in the logarithm. It uses a t-distribution whose
    degrees of freedom are the values in the tail, less one. For skewed values with 10 and more in
    the tail it covers in 87 to 95 % of samples (see its test).
    """
    count = max(1, round(_TAIL * values.size))
    if count < 2:
        return 0.0, float("inf")
    mean, quantile = cvar(values), np.partition(values, -count)[-count]
    terms = quantile + np.maximum(values - quantile, 0) / _TAIL
    error = float(np.std(terms, ddof=1)) / np.sqrt(values.size)
    error *= float(scipy.special.stdtrit(count - 1, 0.975))
    if mean <= 0:
        return mean - error, mean + error
    return float(mean * np.exp(-error / mean)), float(mean * np.exp(error / mean))


def miss_distance(min_distance: ArrayLike, start_distance: ArrayLike) -> np.ndarray:
    """Return the distances (...) [m] by which trials miss their targets.

    This is the least distance of the contact point. It is infinite in a trial that never touches
    its object; such a trial misses by the `start_distance` of the target.
    """
    nearest = np.asarray(min_distance, float)
    return np.where(np.isfinite(nearest), nearest, start_distance)


def distance_left(trials: xr.Dataset) -> np.ndarray:
    """Return the distances (..., world) [m] by which trials miss their targets."""
    return miss_distance(trials.min_distance.values, trials.distance.values)


def modes() -> tuple[str, ...]:
    """Return the failure modes, also those of tasks."""
    return (*FAILURES, *tasks.FAILURES.values())


def failure_modes(trials: xr.Dataset, max_lost: float) -> np.ndarray:
    """Return indices (world,) into `modes()` of the trials of one law, -1 for a success."""
    outcomes = {"diverged": "diverged", "tipped": "fell over", "stalled": "stalled"}
    outcomes = tasks.FAILURES | outcomes | {"unfelt": "contact not felt"}
    none = xr.zeros_like(trials.success)
    masks = {mode: trials.get(name, none).values > 0 for name, mode in outcomes.items()}
    masks["never touched"] = ~np.isfinite(trials.min_distance.values)
    masks["lost contact"] = trials.contact_lost_time.values > max_lost
    # The first failure mode that holds.
    failed = np.select([*masks.values()], [*map(modes().index, masks)], modes().index("timeout"))
    return np.where(trials.success.values > 0, -1, failed)


def hardest(results: xr.Dataset, count: int = 10) -> np.ndarray:
    """Return the worlds (count,) in which most laws fail, ties by the mean distance left."""
    failures = (results.success.values == 0).sum(axis=0)
    distance = distance_left(results).mean(axis=0)
    order = np.lexsort((-distance, -failures))
    return order[: min(count, int((failures > 0).sum()))]


def bins(values: np.ndarray, success: np.ndarray, count: int = 8) -> Bins:
    """Count successes by bins of a quantity, with equal numbers of worlds or one for each value.

    The outcomes `success` (..., worlds) may be those of several laws.
    """
    if not (finite := np.isfinite(values)).all():
        values, success = values[finite], success[..., finite]
    order = np.argsort(values, kind="stable")
    changes = np.flatnonzero(np.diff(values[order])) + 1
    parts = changes if changes.size < count else count
    groups = [group for group in np.array_split(order, parts) if group.size]
    successes = np.array([success[..., g].sum(axis=-1) for g in groups], int)
    return Bins(
        np.array([np.median(values[g]) for g in groups]),
        np.moveaxis(successes.reshape(len(groups), *success.shape[:-1]), 0, -1),
        np.array([g.size for g in groups]),
    )


def equal_rates_p(binned: Bins) -> float:
    """Compute the p of a chi-squared test that all bins have the same success rate."""
    counts = np.stack([binned.successes, binned.trials - binned.successes])
    if len(binned.trials) < 2 or not counts.sum(axis=1).all():
        return 1.0
    expected = np.outer(counts.sum(axis=1), counts.sum(axis=0)) / counts.sum()
    off = np.abs(counts - expected)
    if len(binned.trials) == 2:  # Yates
        off = np.maximum(off - 0.5, 0.0)
    return float(scipy.special.chdtrc(len(binned.trials) - 1, np.sum(off**2 / expected)))


def false_discovery(p: Sequence[float]) -> np.ndarray:
    """Compute the false discovery rates q (n,) of tests by their p (Benjamini and Hochberg)."""
    values = np.asarray(p, float)
    order = np.argsort(values)[::-1]  # the greatest first
    rank = np.arange(values.size, 0, -1)
    q = np.empty_like(values)
    q[order] = np.minimum(np.minimum.accumulate(values[order] * values.size / rank), 1.0)
    return q


def holm(p: Sequence[float]) -> np.ndarray:
    """Adjust the p (n,) of n tests so that they bound the chance of any false finding (Holm)."""
    values = np.asarray(p, float)
    order = np.argsort(values, kind="stable")
    factors = values.size - np.arange(values.size)
    adjusted = np.empty_like(values)
    adjusted[order] = np.minimum(np.maximum.accumulate(factors * values[order]), 1.0)
    return adjusted


def excess_variance(binned: Bins) -> float:
    """Compute the variance [1] of the success rate over bins, less that of binomial noise.

    It is negative where bins differ less than the noise of one rate lets them differ on average.
    """
    trials, mean = binned.trials.sum(), binned.successes.sum() / binned.trials.sum()
    noise = (len(binned.trials) - 1) * mean * (1 - mean) / max(trials - 1, 1)
    squares = binned.trials * (binned.successes / binned.trials - mean) ** 2
    return float(np.sum(squares) / trials - noise)


def influences(results: xr.Dataset) -> list[Influence]:
    """Return the influence of each of `varied_quantities`, the greatest variance first.

    An influence has the greatest variance, and the least q, among the laws.

    Raises:
      InputError: the laws ran in different worlds.
    """

    def bins_of(name: str) -> list[Bins]:
        middle, successes, trials = bins(results[name].values, results.success.values > 0)
        return [Bins(middle, by_bin, trials) for by_bin in successes]

    names, laws = varied_quantities(results), results.law.values
    if different := [name for name in names if results[name].dims != ("world",)]:
        rule = "it differs between the laws: join runs of the same domain, seed and worlds"
        raise errors.not_allowed("results", different[0], rule)
    with ThreadPoolExecutor() as pool:  # sorting a million numbers takes long
        binned = dict(zip(names, pool.map(bins_of, names), strict=True))
    q = false_discovery([equal_rates_p(b) for by_law in binned.values() for b in by_law])
    q = q.reshape(len(binned), len(laws))
    unsorted = [
        Influence(name, max(map(excess_variance, by_law)), float(least))
        for (name, by_law), least in zip(binned.items(), q.min(axis=1), strict=True)
    ]
    return sorted(unsorted, key=lambda influence: -influence.variance)
