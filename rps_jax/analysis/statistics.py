"""What outcomes say: rates and their intervals, differences, kinds of failure, hard worlds.

Of SciPy only its special functions are used here: to import `scipy.stats` takes a second of every
command. A test holds these to it.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
import xarray as xr
from numpy.typing import ArrayLike

from rps_jax.world.domain import WORDS

FAILURES = ("never touched", "lost contact", "timeout", "fell over", "diverged", "stalled")
_FIRST = ("diverged", "fell over", "stalled", "never touched", "lost contact")  # what counts first
_TAIL = 0.05  # of the worlds are the worst
# What no interval of a report promises.
NOT_PROMISED = (
    "Every interval here is about worlds drawn as these were. It promises nothing about one given "
    "world, about worlds from elsewhere, or about worlds that a search has picked."
)


class Comparison(NamedTuple):
    """Outcomes of the same trials under two conditions, trial by trial."""

    equal: float  # [1] share of trials with the same outcome
    equal_interval: tuple[float, float]  # Wilson, 95 %
    gained: int  # trials that fail under the first and succeed under the second
    lost: int  # trials that succeed under the first and fail under the second
    p: float  # [1] of McNemar's exact test that gains and losses are equally likely


class Bins(NamedTuple):
    """Success of one law against one quantity."""

    middle: np.ndarray  # (n,) of each bin: the median of its worlds
    successes: np.ndarray  # (n,)
    trials: np.ndarray  # (n,)


class Influence(NamedTuple):
    """How far success hangs on one quantity."""

    name: str  # of `WORDS`
    variance: float  # [1] of the success rate over its bins, as of `excess_variance`
    q: float  # [1] false discovery rate of the test that all bins have one rate


def wilson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson score interval of a success rate, each end in [0, 1]; all of it without trials."""
    if trials == 0:
        return 0.0, 1.0
    z = float(scipy.special.ndtri((1 + confidence) / 2))
    rate, room = successes / trials, z * z / trials
    middle = (rate + room / 2) / (1 + room)
    reach = z / (1 + room) * math.sqrt(rate * (1 - rate) / trials + room / trials / 4)
    low = 0.0 if successes == 0 else middle - reach
    return low, 1.0 if successes == trials else middle + reach


def clopper_pearson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Exact interval of a rate, which covers it at least as often as it says, however small it is.

    Each end by itself is a bound of confidence (1 + `confidence`) / 2 (Clopper and Pearson, 1934).
    """
    k, n, tail = successes, trials, (1 - confidence) / 2
    low = float(scipy.special.betaincinv(k, n - k + 1, tail)) if k else 0.0
    return low, float(scipy.special.betaincinv(k + 1, n - k, 1 - tail)) if k < n else 1.0


def fails_at_most(failures: int, trials: int, picked_of: int = 1) -> float:
    """Upper bound (95 %) of a failure rate [1], also of one that was the least of several.

    The best of N candidates on the same worlds looks better than it is. Its bound holds if those
    of all N hold, so each is asked for 1 - 0.05 / N; this needs no independence.
    """
    least = 1 - (1 - 0.95) / picked_of
    return clopper_pearson(failures, trials, 2 * least - 1)[1]


def compare(first: xr.DataArray, second: xr.DataArray) -> Comparison:
    """Compare outcomes (any equal shape) of the same trials."""
    a, b = first.values.astype(bool).ravel(), second.values.astype(bool).ravel()
    gained, lost = int(np.sum(~a & b)), int(np.sum(a & ~b))
    equal = a.size - gained - lost
    p = min(1.0, 2 * float(scipy.special.bdtr(min(gained, lost), gained + lost, 0.5)))
    return Comparison(equal / a.size, wilson(equal, a.size), gained, lost, p)


def worlds_by_object(results: xr.Dataset) -> dict[str, np.ndarray]:
    """Which worlds, a mask, have each object."""
    which = results.which_object.values
    return {str(name): which == i for i, name in enumerate(results.object.values)}


def varied_quantities(results: xr.Dataset) -> list[str]:
    """Names of those quantities of `WORDS` that differ between worlds."""

    def differs(values: np.ndarray) -> bool:
        return np.unique(values[np.isfinite(values)]).size > 1

    return [name for name in WORDS if name in results and differs(results[name].values)]


def cvar(values: np.ndarray) -> float:
    """Mean of the worst, greatest 5 % of the values: their conditional value at risk."""
    worst = max(1, round(_TAIL * values.size))
    return float(np.sort(values)[-worst:].mean())


def cvar_interval(values: np.ndarray) -> tuple[float, float]:
    """Approximate interval (95 %) of `cvar`, from the spread of the values beyond their quantile.

    With q the quantile, the mean of q + max(x - q, 0) / tail has the variance of the CVaR (Trindade
    et al., 2007). The interval is even in the logarithm, and has a t-distribution with as many
    degrees of freedom as there are values in the tail, less one: for skewed values of which 10 and
    more are in the tail it covers in 87 to 95 % of samples (see its test).
    """
    worst = max(1, round(_TAIL * values.size))
    if worst < 2:
        return 0.0, float("inf")
    mean, quantile = cvar(values), np.partition(values, -worst)[-worst]
    terms = quantile + np.maximum(values - quantile, 0) / _TAIL
    error = float(np.std(terms, ddof=1)) / np.sqrt(values.size)
    error *= float(scipy.special.stdtrit(worst - 1, 0.975))
    if mean <= 0:
        return mean - error, mean + error
    return float(mean * np.exp(-error / mean)), float(mean * np.exp(error / mean))


def miss_distance(min_distance: ArrayLike, way: ArrayLike) -> np.ndarray:
    """How far (...) [m] trials missed their targets, by `min_distance` of the contact point.

    A trial whose distance is infinite never touched its object, and missed by the whole `way`.
    """
    near = np.asarray(min_distance, float)
    return np.where(np.isfinite(near), near, way)


def distance_left(one: xr.Dataset) -> np.ndarray:
    """How far (world,) [m] the trials of one law missed their targets."""
    return miss_distance(one.min_distance.values, one.distance.values)


def failure_modes(one: xr.Dataset, max_lost: float) -> np.ndarray:
    """Index into `FAILURES` (worlds,), -1 for a success."""
    kinds = np.select(
        [
            one.success.values > 0,
            one.diverged.values > 0,
            one.tipped.values > 0,
            one.stalled.values > 0 if "stalled" in one else np.zeros(one.sizes["world"], bool),
            ~np.isfinite(one.min_distance.values),
            one.contact_lost_time.values > max_lost,
        ],
        [-1, *map(FAILURES.index, _FIRST)],
        FAILURES.index("timeout"),
    )
    return kinds


def hardest(results: xr.Dataset, count: int = 10) -> np.ndarray:
    """Worlds (count,) in which most laws fail, and among these the most distance is left."""
    laws = [results.sel(law=law) for law in results.law.values]
    failed = sum((one.success.values == 0).astype(float) for one in laws)
    left = np.mean([distance_left(one) for one in laws], axis=0)
    order = np.lexsort((-left, -np.asarray(failed)))
    return order[: min(count, int((np.asarray(failed) > 0).sum()))]


def bins(values: np.ndarray, won: np.ndarray, count: int = 8) -> Bins:
    """Success against a quantity, in bins of equal numbers of worlds, or one for each value."""
    known = np.isfinite(values)
    values, won = values[known], won[known]
    different = np.unique(values)
    if different.size <= count:
        groups: Sequence[np.ndarray] = [np.flatnonzero(values == v) for v in different]
    else:
        groups = [g for g in np.array_split(ascending_order(values), count) if g.size]
    return Bins(
        np.array([np.median(values[g]) for g in groups]),
        np.array([int(won[g].sum()) for g in groups]),
        np.array([g.size for g in groups]),
    )


def ascending_order(values: np.ndarray) -> np.ndarray:
    """Places (n,) of numbers in ascending order, of equal ones the first first; none is NaN.

    As NumPy's stable `argsort`; of float32 in a fifth of its time.
    """
    if values.dtype != np.float32:
        return np.argsort(values, kind="stable")
    bits = (values + np.float32(0)).view(np.int32).astype(np.int64)  # a zero without a sign
    bits = np.where(bits < 0, bits ^ 0x7FFFFFFF, bits)  # which are in the order of the numbers
    return np.sort((bits << 32) | np.arange(values.size)) & 0xFFFFFFFF


def equal_rates_p(found: Bins) -> float:
    """The p of a chi-squared test that all bins have one success rate."""
    counts = np.stack([found.successes, found.trials - found.successes])
    if len(found.trials) < 2 or not counts.sum(axis=1).all():
        return 1.0
    expected = np.outer(counts.sum(axis=1), counts.sum(axis=0)) / counts.sum()
    off = np.abs(counts - expected)
    if len(found.trials) == 2:  # Yates
        off = np.maximum(off - 0.5, 0.0)
    return float(scipy.special.chdtrc(len(found.trials) - 1, np.sum(off**2 / expected)))


def false_discovery(p: Sequence[float]) -> np.ndarray:
    """The false discovery rates q (n,) of tests with these p, by Benjamini and Hochberg."""
    values = np.asarray(p, float)
    order = np.argsort(values)[::-1]  # the greatest first
    rank = np.arange(values.size, 0, -1)
    found = np.empty_like(values)
    found[order] = np.minimum(np.minimum.accumulate(values[order] * values.size / rank), 1.0)
    return found


def holm(p: Sequence[float]) -> np.ndarray:
    """P-values (n,) of n tests adjusted so that the chance of any false finding is held (Holm)."""
    values = np.asarray(p, float)
    order = np.argsort(values, kind="stable")
    factors = values.size - np.arange(values.size)
    adjusted = np.empty_like(values)
    adjusted[order] = np.minimum(np.maximum.accumulate(factors * values[order]), 1.0)
    return adjusted


def excess_variance(found: Bins) -> float:
    """Variance [1] of the success rate over bins, less what binomial noise puts there.

    It is negative where bins differ less than the noise of one rate lets them differ on average.
    """
    trials, mean = found.trials.sum(), found.successes.sum() / found.trials.sum()
    noise = (len(found.trials) - 1) * mean * (1 - mean) / max(trials - 1, 1)
    return float(
        np.sum(found.trials * (found.successes / found.trials - mean) ** 2) / trials - noise
    )


def influences(results: xr.Dataset) -> list[Influence]:
    """How far success hangs on each of `varied_quantities`, the greatest spread first.

    Each has the spread of the law in which it is greatest, and the least q of all laws.
    """
    laws = results.law.values
    binned = {
        name: [bins(results[name].values, results.success.sel(law=law).values > 0) for law in laws]
        for name in varied_quantities(results)
    }
    q = false_discovery([equal_rates_p(found) for each in binned.values() for found in each])
    q = q.reshape(len(binned), len(laws))
    found = [
        Influence(name, max(map(excess_variance, each)), float(least))
        for (name, each), least in zip(binned.items(), q.min(axis=1), strict=True)
    ]
    return sorted(found, key=lambda one: -one.variance)
