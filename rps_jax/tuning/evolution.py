"""Tuning the law by evolution: a distribution over candidates that moves to where they do well.

Every candidate of a generation meets the same worlds; the next generation meets others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Literal, get_args

import cmaes
import numpy as np

from rps_jax import errors
from rps_jax.tuning.run import Course, Told, TryOut, finite
from rps_jax.tuning.space import Space

Algorithm = Literal["cma", "lra_cma", "sep_cma", "xnes"]
_KINDS: dict[str, Callable[..., Any]] = {
    "cma": cmaes.CMA,
    "lra_cma": partial(cmaes.CMA, lr_adapt=True),
    "sep_cma": cmaes.SepCMA,
    "xnes": cmaes.XNES,
}


@dataclass(frozen=True)
class Evolution:
    """How evolution searches."""

    algorithm: Algorithm = "cma"
    """cma adapts a full covariance; lra_cma adapts its learning rates to noisy scores as well;
    sep_cma keeps to the axes; xnes follows the natural gradient."""
    population: int = 64
    """Number of candidates in a generation."""
    generations: int = 50
    """Number of generations, counted over all restarts."""
    spread: float = 0.5
    """[1] Standard deviation of the first generation about the parameters at the start."""
    prior: float = 0.002
    """[1] Price of a mean square of 1 between a candidate's coordinates and those at the start; it
    keeps the search where the bounded map is not flat."""
    patience: int = 0
    """Number of generations without a better validation after which the search begins again
    elsewhere; 0 stands for never."""
    budget: float = 0.0
    """[s] Simulated time after which no generation begins; 0 stands for no bound."""
    seed: int = 0
    """Seed of the proposals, and of the worlds for tuning and validation."""

    def __post_init__(self) -> None:
        """Raises InputError for an unknown algorithm or counts that mean nothing."""
        errors.check_name("algorithm", self.algorithm, get_args(Algorithm))
        errors.check_finite("population", self.population, at_least=4, at_most=1e5)
        errors.check_finite("generations", self.generations, at_least=1, at_most=1e6)
        errors.check_finite("spread", self.spread, above=0, at_most=10)
        errors.check_finite("prior", self.prior, at_least=0)
        errors.check_finite("patience", self.patience, at_least=0)
        errors.check_finite("budget", self.budget, at_least=0, unit="s")
        errors.check_finite("seed", self.seed, at_least=0, at_most=2**30)


class Search:
    """An evolution under way: a tuner that `rps_jax.tuning.run` drives."""

    def __init__(self, evolution: Evolution, space: Space, course: Course):
        """Raises InputError for an algorithm that cannot search so few parameters."""
        if len(space.names) < 2 and evolution.algorithm in ("sep_cma", "xnes"):
            raise errors.InputError(
                f"algorithm = {evolution.algorithm} is not allowed for one parameter: choose cma."
            )
        self.evolution, self.space, self.course = evolution, space, course
        self.options = {"evolution": asdict(replace(evolution, generations=1, budget=0.0))}
        self.generations, self.budget = evolution.generations, evolution.budget

    def begin(self) -> None:
        """Begin about the base parameters of the space."""
        self.base = self.best = np.asarray(self.space.vector(self.space.base), float)
        self.best_value = np.inf  # of `best` in the worlds for validation
        self.since = 0  # generations without a better one
        self.restarts = 0
        self._search = self._around(self.base)

    def _around(self, mean: np.ndarray) -> Any:
        seed = np.random.SeedSequence((self.evolution.seed, self.restarts)).generate_state(1)[0]
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

    def judge(
        self, vectors: np.ndarray, generation: int, try_out: TryOut
    ) -> tuple[Told, dict[str, Any]]:
        """The values of candidates, and that of the mean in the worlds for validation."""
        space, course, seed = self.space, self.course, self.evolution.seed
        mean = self.mean
        tried, base, check = try_out(
            [
                course.ask(space.params(vectors), seed, generation),
                course.ask(space.params(self.base[None]), seed, generation),
                course.validate(space.params(mean[None]), seed),
            ]
        )
        values = np.asarray(course.objective.value(tried.score))
        validation = float(course.objective.value(check.score)[0])
        away = np.mean((vectors - self.base) ** 2, axis=-1)
        told = {
            "values": values + self.evolution.prior * away,
            "mean": mean,
            "validation": np.array(validation),
        }
        return told, {
            "best": finite(np.nanmin(values)),
            "mean": finite(np.nanmean(values)),
            "spread": finite(np.nanstd(values)),
            "not_finite": int(np.isnan(values).sum()),
            "base": finite(course.objective.value(base.score)[0]),
            "validation": finite(validation),
            "validation_success": float(check.outcome.success.mean()),
            "restarts": self.restarts,
            "params": space.named(mean),
        }

    def learn(self, vectors: np.ndarray, told: Told) -> None:
        """Move towards the better candidates, those without a value ranking worst."""
        values = told["values"]
        worst = np.max(values[~np.isnan(values)], initial=-np.inf)
        ranked = np.where(np.isnan(values), worst + 1.0, values)
        self._search.tell([(x, float(value)) for x, value in zip(vectors, ranked, strict=True)])
        self.since += 1
        if told["validation"] < self.best_value:
            self.best, self.best_value, self.since = told["mean"], float(told["validation"]), 0
        if self.evolution.patience and self.since >= self.evolution.patience:
            self.restarts, self.since = self.restarts + 1, 0
            elsewhere = np.random.default_rng((self.evolution.seed + 1, self.restarts))
            self._search = self._around(elsewhere.standard_normal(self.base.size))
