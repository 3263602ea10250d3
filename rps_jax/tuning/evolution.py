"""Tuning a law by evolution: a distribution over candidates that moves to where they do well.

Every candidate of a generation meets the same worlds; the next generation meets others.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal

import cmaes
import numpy as np

from rps_jax import errors
from rps_jax.record.options import option
from rps_jax.runs.question import call_of
from rps_jax.tuning.run import Metrics, ScoreCandidates, Tuning, finite

Algorithm = Literal["cma", "lra_cma", "sep_cma", "xnes"]
_KINDS: dict[str, Callable[..., Any]] = {
    "cma": cmaes.CMA,
    "lra_cma": partial(cmaes.CMA, lr_adapt=True),
    "sep_cma": cmaes.SepCMA,
    "xnes": cmaes.XNES,
}


@dataclass(frozen=True)
class TuneES(Tuning):
    """Tune a law's parameters by evolution, in many worlds.

    The answer holds, by generation, the objective of candidates and of the middle of their
    distribution in the worlds for validation, and `params` (generation, parameter) of the latter;
    and `tuned` (parameter), which validated best.

    Example:
      >>> import rps_jax
      >>> drums = {"objects": ("random_cylinder",), "tuned": ("K_h", "K_v")}
      >>> brief = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=2.0))
      >>> small = {"worlds": 2, "validation": 2, "population": 4, "generations": 1}
      >>> found = rps_jax.tune_es("rps", **drums, **small, setting=brief)
      >>> dict(found.params.sizes)
      {'generation': 1, 'parameter': 2}
    """

    QUICK: ClassVar[dict[str, Any]] = Tuning.QUICK | {
        "worlds": 32, "population": 12, "generations": 8, "spread": 1.0,
    }  # fmt: skip

    algorithm: Algorithm = "cma"
    """cma adapts a full covariance; lra_cma adapts its learning rates to noisy scores as well;
    sep_cma keeps to the axes; xnes follows the natural gradient."""
    population: int = option(64, 4, 100_000)
    """Number of candidates in a generation."""
    generations: int = option(50, 1, 1_000_000)
    """Number of generations, counted over all restarts."""
    spread: float = option(0.5, above=0, at_most=10)
    """Standard deviation of the first generation about the start, in units of the bounded map
    [1]."""
    prior: float = option(0.002, 0)
    """Price of a mean square of 1 between a candidate's coordinates and those of the start [1]; it
    keeps the search where the bounded map is not flat."""
    patience: int = option(0, 0, 1_000_000)
    """Number of generations without a better validation after which the search begins again
    elsewhere; 0 stands for never."""

    @functools.cached_property
    def tuner(self) -> EvolutionState:
        return EvolutionState(self)


tune_es = call_of(TuneES)


class EvolutionState:
    """An evolution under way."""

    def __init__(self, evolution: TuneES):
        """Raises InputError for an algorithm that cannot search so few parameters."""
        if len(evolution.space.names) < 2 and evolution.algorithm in ("sep_cma", "xnes"):
            raise errors.InputError(
                f"algorithm = {evolution.algorithm} is not allowed for one parameter: choose cma."
            )
        self.evolution, self.seed = evolution, evolution.setting.seed
        self.space, self.problem = evolution.space, evolution.problem
        self.generations, self.budget = evolution.generations, evolution.budget

    def begin(self) -> None:
        """Begin about the base parameters of the space."""
        self.base = self.best = np.asarray(self.space.vector(self.space.base), float)
        self.best_value = np.inf  # of `best` in the worlds for validation
        self.since = 0  # generations without a better one
        self.restarts = 0
        self._search = self._around(self.base)

    def _around(self, mean: np.ndarray) -> Any:
        seed = np.random.SeedSequence((self.seed, self.restarts)).generate_state(1)[0]
        return _KINDS[self.evolution.algorithm](
            mean.copy(),
            self.evolution.spread,
            population_size=self.evolution.population,
            seed=int(seed),
        )

    @property
    def mean(self) -> np.ndarray:
        """The middle (p,) of the distribution from which candidates are drawn."""
        return self._search._mean.copy()  # XNES has no public name for it

    def propose(self) -> np.ndarray:
        """Candidates (P, p) drawn from the distribution."""
        return np.stack([self._search.ask() for _ in range(self.evolution.population)])

    def shapes(self, vectors: np.ndarray, generation: int) -> dict[str, tuple[int, ...]]:
        """Shapes of the values of candidates, the mean that was validated, and how it did."""
        return {"values": vectors.shape[:1], "mean": vectors.shape[1:], "validation": ()}

    def judge(
        self, vectors: np.ndarray, generation: int, score_candidates: ScoreCandidates
    ) -> tuple[Metrics, dict[str, Any]]:
        """The values of candidates, and that of the mean in the worlds for validation."""
        space, problem, seed = self.space, self.problem, self.seed
        mean = self.mean
        tried, base, check = score_candidates(
            [
                problem.ask(space.params(vectors), seed, generation),
                problem.ask(space.params(self.base[None]), seed, generation),
                problem.validate(space.params(mean[None]), seed),
            ]
        )
        values = np.asarray(problem.objective.value(tried.score))
        validation = float(problem.objective.value(check.score)[0])
        away = np.mean((vectors - self.base) ** 2, axis=-1)
        metrics = {
            "values": values + self.evolution.prior * away,
            "mean": mean,
            "validation": np.array(validation),
        }
        return metrics, {
            "best": finite(np.nanmin(values)),
            "mean": finite(np.nanmean(values)),
            "spread": finite(np.nanstd(values)),
            "not_finite": int(np.isnan(values).sum()),
            "base": finite(problem.objective.value(base.score)[0]),
            "validation": finite(validation),
            "validation_success": float(check.outcome.success.mean()),
            "restarts": self.restarts,
            "params": space.named(mean),
        }

    def update(self, vectors: np.ndarray, metrics: Metrics) -> None:
        """Move towards the better candidates, those without a value ranking worst."""
        values = metrics["values"]
        worst = np.max(values[~np.isnan(values)], initial=-np.inf)
        ranked = np.where(np.isnan(values), worst + 1.0, values)
        self._search.tell([(x, float(value)) for x, value in zip(vectors, ranked, strict=True)])
        self.since += 1
        if metrics["validation"] < self.best_value:
            self.best, self.best_value, self.since = (
                metrics["mean"],
                float(metrics["validation"]),
                0,
            )
        if self.evolution.patience and self.since >= self.evolution.patience:
            self.restarts, self.since = self.restarts + 1, 0
            elsewhere = np.random.default_rng((self.seed + 1, self.restarts))
            self._search = self._around(elsewhere.standard_normal(self.base.size))
