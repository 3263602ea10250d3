"""Compare scores of windows: which one has the gradient of whole trials?

`windows.py` differentiates the score of a window of a softened trial. Here its gradients are
compared, for several lengths of the window and temperatures, with the gradient of the objective of
whole trials under the original law, by central differences in other worlds.

    rps sweeps/gradients/score.py --quick
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import Rules, Setting
from rps_jax.questions import Run, call_of, option
from rps_jax.runs import evaluate
from rps_jax.runs.evaluate import Candidates, CandidateScores
from rps_jax.runs.question import SimulationQuestion
from rps_jax.trials.setting import seed_of
from rps_jax.tuning.gradients import Estimate, estimate
from sweeps.gradients import critic
from sweeps.gradients.windows import Windows, window_gradient
from sweeps.study_base import Parts, QuickStudy, Rows, Table

_DRAWS = 4000  # of the errors of both gradients


@dataclass(frozen=True)
class ScoreStudy(QuickStudy[xr.Dataset], SimulationQuestion[xr.Dataset]):
    """Compare scores of windows: which one has the gradient of whole trials?

    The answer has, by score (score), the gradient (parameter) with its `error`, the `cosine` to
    that of whole trials with the interval `low` to `high`, and the `cost` [s] in simulated time.
    """

    TITLE = "Scores of windows against whole trials"
    QUICK: ClassVar = {
        "windows": (2.0,),
        "critics": (2.0,),
        "taxels": (0.03,),
        "worlds": 4,
        "truth": 8,
        "tuned": ("K_h", "L"),
        "setting.engine": "quasistatic",
        "setting.rules": Rules(horizon=20.0),
    }

    windows: tuple[float, ...] = option((2.0, 8.0, 30.0), 0.1, 300, unit="s")
    """Lengths of windows [s]."""
    critics: tuple[float, ...] = option((8.0,), 0.1, 300, unit="s")
    """Lengths of windows with a critic at their ends [s]."""
    arrivals: tuple[float, ...] = option((0.005,), above=0, unit="m")
    """Temperatures at which a softened trial arrives [m]."""
    taxels: tuple[float, ...] = option((0.03, 0.1), above=0, at_most=1)
    """Temperatures of the taxels of a softened trial [1]."""
    estimators: tuple[str, ...] = ("clipped",)
    """Estimators of the gradients of windows."""
    tuned: tuple[str, ...] = ("full",)
    """Parameters to differentiate by: names, or logistic, or full."""
    worlds: int = option(512, 2, 1_000_000)
    """Number of worlds of an estimate."""
    truth: int = option(2048, 2, 1_000_000)
    """Number of worlds of the central differences of whole trials."""
    delta: float = option(0.1, above=0, at_most=5)
    """Step of the central differences, in units of the bounded map [1]."""
    setting: Setting = field(default=Setting(rules=Rules(horizon=150.0)), kw_only=True)

    def tuning(
        self,
        estimator: str,
        window: float = 8.0,
        arrive: float = 0.005,
        taxels: float = 0.03,
        within: float = 100.0,
    ) -> Windows:
        """Return the tuning whose gradient is estimated."""
        return Windows(
            "rps",
            tuned=self.tuned,
            worlds=self.worlds,
            estimator=estimator,
            window=window,
            arrive=arrive,
            taxels=taxels,
            within=within,
            setting=self.setting,
        )

    def check(self) -> None:
        super().check()
        for name in self.estimators:
            self.tuning(name).validate()

    def parts(self, run: Run) -> Parts:
        """Return the function of each gradient by its label."""
        parts = {"truth": partial(self._truth, run)}
        parts["evolution, whole trials"] = partial(self._evolution, run)
        axes = self.estimators, self.windows, self.arrivals, self.taxels
        for name, window, arrive, taxels in itertools.product(*axes):
            label = f"{name}, window {window:g} s, arrival {1000 * arrive:g} mm, taxels {taxels:g}"
            tuning = self.tuning(name, window, arrive, taxels)
            parts[label] = partial(self._window, tuning)
        horizon = float(self.setting.rules.horizon)
        for window, taxels in itertools.product(self.critics, self.taxels):
            tuning = self.tuning("clipped", window, taxels=taxels, within=horizon)
            label = f"clipped, window {window:g} s, critic, taxels {taxels:g}"
            parts[label] = partial(self._critic, tuning)
        return parts

    DIMENSION = "score"

    def answer(self, run: Run) -> xr.Dataset:
        """Compute the gradients that are missing, and compare them with the truth."""
        results = super().answer(run)
        random, (count,) = np.random.default_rng(0), results.parameter.shape
        drawn = [
            x.gradient.values + x.error.values * random.normal(size=(_DRAWS, count))
            for _, x in results.groupby("score", squeeze=False)
        ]
        labels = [str(label) for label, _ in results.groupby("score", squeeze=False)]
        draws = dict(zip(labels, drawn, strict=True))
        pairs = {x: _cosine(draws[x], draws["truth"]) for x in map(str, results.score.values)}
        low, high = np.array([np.quantile(x, (0.05, 0.95)) for x in pairs.values()]).T
        truth = results.gradient.sel(score="truth").values
        cosine = _cosine(results.gradient.values, truth)
        columns = {"cosine": cosine, "low": low, "high": high}
        return results.assign({name: ("score", x) for name, x in columns.items()})

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the cosine of each score."""
        return [Table(table(results), name="gradients_score", title="Scores of windows")]

    def _scores(self, run: Run, request: Candidates) -> tuple[CandidateScores, float]:
        """Return the scores of candidates in whole trials, and the simulated time [s]."""
        objective = self.tuning("evolution").objective
        (scores,), timing = evaluate.score_candidates(
            [request], self.setting, objective, **run.batch_options
        )
        return scores, timing.simulated

    def _truth(self, run: Run) -> xr.Dataset:
        """Return the gradient of the objective by central differences."""
        tuning = self.tuning("evolution")
        steps = self.delta * np.eye(len(tuning.space.names))
        params = tuning.space.params(tuning.base + np.concatenate([steps, -steps]))
        worlds, seed = np.arange(self.truth), seed_of(self.setting.seed, "test")
        scores, simulated = self._scores(run, Candidates(params, tuning.domains, seed, worlds))
        up, down = np.split(scores.score, 2)  # (p, W) each
        return self._row(estimate(jnp.asarray((up - down).T / (2 * self.delta))), simulated)

    def _evolution(self, run: Run) -> xr.Dataset:
        """Return the gradient by evolution in whole trials."""
        tuning = self.tuning("evolution")
        tried, slopes = tuning.antithetic(jnp.asarray(tuning.base), 0, tuning.worlds)
        scores, simulated = self._scores(run, tried)
        return self._row(slopes(scores), simulated)

    def _window(self, tuning: Windows) -> xr.Dataset:
        """Return the gradient of windows."""
        return self._row(*window_gradient(tuning))

    def _critic(self, tuning: Windows) -> xr.Dataset:
        """Return the gradient of windows with a critic."""
        gradient, cost, explained = critic.critic_gradient(tuning)
        return self._row(gradient, cost, explained=explained)

    def _row(self, x: Estimate, cost: float, explained: float = np.nan) -> xr.Dataset:
        """Return a gradient (p,) with its standard error and its cost.

        `explained` is the share of the variance of remaining scores that a critic explains [1].
        """
        gradient = np.asarray(x.gradient, float)
        error = np.sqrt(np.asarray(x.variance, float))
        names = list(self.tuning("evolution").space.names)
        variables = {"gradient": ("parameter", gradient), "error": ("parameter", error)}
        variables |= {"cost": ((), cost, {"units": "s"}), "explained": ((), explained)}
        return xr.Dataset(variables, {"parameter": names})


score_study = call_of(ScoreStudy)


def _cosine(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return cosines (...) of vectors (..., p)."""
    norms = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    return np.sum(a * b, -1) / np.maximum(norms, np.finfo(float).tiny)


def table(results: xr.Dataset) -> Rows:
    """Return a header and a row per score."""
    head = ["score", "cosine to whole trials", "error, relative", "critic explains"]
    rows = [[*head, "simulated time"]]
    for label in map(str, results.score.values):
        row = results.sel(score=label)
        size = max(np.linalg.norm(row.gradient), np.finfo(float).tiny)
        error = np.linalg.norm(row.error) / size
        cosine = f"{float(row.cosine):.2f} [{float(row.low):.2f}, {float(row.high):.2f}]"
        explained = float(row.explained)
        share = "" if np.isnan(explained) else f"{100 * explained:.0f} %"
        rows.append([label, cosine, f"{error:.2f}", share, f"{float(row.cost):,.0f} s"])
    return rows
