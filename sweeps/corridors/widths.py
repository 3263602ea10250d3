"""Success of a law over the width of a corridor: a fitted monotone curve, and its levels.

The curve is a / (1 + exp(-(w - m) / s)) of the width w [m], with the plateau a, the middle m [m]
and the spread s [m]. A maximum-likelihood fit over a grid has no local optima, and it
serves all resamples of a bootstrap at once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

_BINS = 40  # of the widths
_RESAMPLES = 200  # of a bootstrap
_RATE_MIN, _RATE_MAX = 1e-9, 1 - 1e-9  # success of a curve, for its logarithm


class Curve(NamedTuple):
    """Fitted curve, and curves of resampled worlds."""

    params: np.ndarray  # (3,) plateau [1], middle [m], spread [m]
    resampled: np.ndarray  # (R, 3)
    low: float  # [m] least and greatest width of the worlds
    high: float

    def rates(self, width: np.ndarray) -> np.ndarray:
        """Return success rates (n,) [1] at widths (n,) [m]."""
        return _rates(self.params[None], width)[0]

    def needed(self, level: float) -> tuple[float, float, float]:
        """Return the width [m] that a success rate needs, and its bootstrap 95 % interval.

        It is infinite where no width of the worlds suffices, and at least their least width.
        """
        widths = [self._needed(params, level) for params in (self.params, *self.resampled)]
        # Ranks, since a difference of infinite widths is undefined.
        low, high = np.quantile(widths[1:], [0.025, 0.975], method="nearest")
        return widths[0], float(low), float(high)

    def _needed(self, params: np.ndarray, level: float) -> float:
        plateau, middle, spread = params
        if plateau <= level:
            return math.inf
        width = float(middle + spread * np.log(level / (plateau - level)))
        return max(width, self.low) if width <= self.high else math.inf


def _rates(params: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Return success rates (k, n) [1] of curves (k, 3) at widths (n,) [m]."""
    plateau, middle, spread = params.T[..., None]
    return np.clip(plateau / (1 + np.exp(-(width - middle) / spread)), _RATE_MIN, _RATE_MAX)


def _grid(low: float, high: float) -> np.ndarray:
    """Return the curves (k, 3) of the grid for widths from `low` to `high` [m]."""
    plateaus = np.append(1.0, 1 - np.geomspace(1e-3, 0.99, 30))
    middles = np.linspace(low - 0.3 * (high - low), high + 0.3 * (high - low), 101)
    spreads = (high - low) * np.geomspace(0.01, 0.6, 12)
    return np.stack(np.meshgrid(plateaus, middles, spreads), axis=-1).reshape(-1, 3)


def fit(width: np.ndarray, success: np.ndarray, low: float, high: float, seed: int = 0) -> Curve:
    """Fit the curve to the success (n,) of worlds of widths (n,) from `low` to `high` [m]."""
    edges = np.linspace(low, high, _BINS + 1)
    index = np.clip(np.searchsorted(edges, width, side="right") - 1, 0, _BINS - 1)
    random, count = np.random.default_rng(seed), width.size
    picks = random.multinomial(count, np.full(count, 1 / count), size=_RESAMPLES)
    weights = np.concatenate([np.ones((1, count)), picks])
    one_hot = index[:, None] == np.arange(_BINS)
    trials, successes = weights @ one_hot, (weights * success) @ one_hot
    curves = _grid(low, high)
    rates = _rates(curves, (edges[:-1] + edges[1:]) / 2)
    likelihood = np.log(rates) @ successes.T + np.log1p(-rates) @ (trials - successes).T
    best = curves[np.argmax(likelihood, axis=0)]
    return Curve(best[0], best[1:], low, high)
