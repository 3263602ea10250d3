"""Tune a law by CMA-ES: a normal distribution of candidates moves towards better values.

All candidates of a generation meet the same worlds; every generation has other worlds.
"""

from __future__ import annotations

from dataclasses import dataclass

import cmaes
import numpy as np

from rps_jax.record.options import option
from rps_jax.runs.question import call_of
from rps_jax.tuning.run import Proposal, Results, ScoreCandidates, Search, Tuning


@dataclass(frozen=True)
class TuneES(Tuning):
    """Tune a law's parameters by evolution, in many worlds.

    The answer has, by generation, the objective of the candidates, the objective of the mean of
    their distribution in the worlds for validation, and the `params` (generation, parameter) of
    that mean. Its `tuned` (parameter) are the parameters with the best validation.

    Examples:
      >>> import rps_jax
      >>> drums = {"objects": ("random_cylinder",), "tuned": ("K_h", "K_v")}
      >>> brief = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=2.0))
      >>> small = {"worlds": 2, "validation": 2, "population": 4, "generations": 1}
      >>> results = rps_jax.tune_es("rps", **drums, **small, setting=brief)
      >>> dict(results.params.sizes)
      {'generation': 1, 'parameter': 2}
    """

    QUICK = Tuning.QUICK | {
        "worlds": 32,
        "population": 12,
        "generations": 8,
        "spread": 1.0,
    }

    population: int = option(64, 4, 100_000)
    """Number of candidates in a generation."""
    generations: int = option(50, 1, 1_000_000)
    """Number of generations."""
    spread: float = option(0.5, above=0, at_most=10)
    """Standard deviation of the first generation about the start, in units of the bounded map
    [1]."""
    prior: float = option(0.002, 0)
    """Cost of a mean squared distance of 1 between the vectors of a candidate and of the start
    [1]; it keeps the search where the bounded map is steep."""

    @property
    def num_generations(self) -> int:
        return self.generations

    def search(self) -> Search:
        """Search by CMA-ES of the package cmaes; `center` is the mean of the candidates."""
        seed = int(np.random.SeedSequence((self.setting.seed, 0)).generate_state(1)[0])
        strategy = cmaes.CMA(self.base, self.spread, population_size=self.population, seed=seed)
        while True:
            vectors = np.stack([strategy.ask() for _ in range(self.population)])
            results = yield {"vectors": vectors, "center": strategy.mean.copy()}
            vectors, values = results["vectors"], results["values"]
            worst = np.max(values[~np.isnan(values)], initial=-np.inf)
            ranked = np.where(np.isnan(values), worst + 1.0, values)
            strategy.tell([(x, float(value)) for x, value in zip(vectors, ranked, strict=True)])

    def judge(self, proposal: Proposal, generation: int, score: ScoreCandidates) -> Results:
        vectors, space = proposal["vectors"], self.space
        tried = self.candidates(space.params(np.vstack([vectors, self.base])), generation)
        center = self.validation_candidates(space.params(proposal["center"][None]))
        candidates, check = score([tried, center])
        *values, base_value = np.asarray(self.objective.value(candidates.score))
        (validation,) = np.asarray(self.objective.value(check.score))
        distances = np.mean((vectors - self.base) ** 2, axis=-1)
        return {
            "values": values + self.prior * distances,
            "best": np.nanmin(values),
            "mean": float(np.nanmean(values)),
            "spread": float(np.nanstd(values)),
            "not_finite": np.isnan(values).sum(),
            "base": base_value,
            "validation": validation,
            "validation_success": check.outcome.success.mean(),
        }


tune_es = call_of(TuneES)
