"""Tune a law by evolution in whole trials: CMA-ES, or steps along antithetic random slopes.

CMA-ES moves a normal distribution of candidates towards better values. All candidates of a
generation meet the same worlds; every generation has other worlds.

The estimator `antithetic` tries a random step of the parameters and its opposite in each world,
under the original law and the paper's rules. The slope along these steps includes failures, at
which derivatives jump.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import cmaes
import jax
import jax.numpy as jnp
import numpy as np
import optax

from rps_jax import errors
from rps_jax.geometry.arrays import Array
from rps_jax.record.files import JsonObject
from rps_jax.record.options import option
from rps_jax.runs.evaluate import Candidates, CandidateScores
from rps_jax.runs.question import call_of
from rps_jax.tuning import gradients
from rps_jax.tuning.gradients import Estimate
from rps_jax.tuning.optimisers import optimiser
from rps_jax.tuning.run import Proposal, Results, ScoreCandidates, Search, Tuning


@dataclass(frozen=True)
class Descent(Tuning):
    """Base of tuners that move one vector along slopes of whole trials."""

    sigma: float = option(0.3, above=0)
    """Standard deviation of antithetic random steps, in units of the bounded map [1]."""
    pairs: int = option(1, 1, 1_000_000)
    """Number of antithetic pairs of random steps in each world."""

    def antithetic(
        self, vector: Array, generation: int, worlds: int
    ) -> tuple[Candidates, Callable[[CandidateScores], Estimate]]:
        """Return random steps from a vector (p,) as candidates, and the estimator of their slopes.

        Each world tries other steps and their opposites.
        """
        key = jax.random.fold_in(jax.random.key(self.setting.seed), generation)
        options, count = gradients.Options(sigma=self.sigma, pairs=self.pairs), worlds
        count *= len(self.domains)
        steps, thetas, _ = gradients.random_steps(vector, jnp.arange(count), key, options)
        tried = self.candidates(thetas.reshape(-1, count, vector.size), generation, worlds)

        def estimate(scores: CandidateScores) -> Estimate:
            values = jnp.ravel(jnp.asarray(scores.score))
            slopes = gradients.estimate(gradients.slopes_along(steps, values, options))
            if missing := int(jnp.isnan(slopes.gradient).sum()):
                warnings.warn(
                    f"{missing} of {vector.size} slopes have no finite sample: they are NaN, and "
                    "the step does without them.",
                    stacklevel=2,
                )
            return slopes

        return replace(tried, per_world=True), estimate

    def try_step(
        self, proposal: Proposal, generation: int, score: ScoreCandidates, steps: int
    ) -> Results:
        """Validate the vector (1, p), and estimate its slopes in the same batch.

        After the last of the steps the slopes are NaN.
        """
        vector = jnp.asarray(proposal["vectors"][0])
        check = self.validation_candidates(vector)
        if generation < steps:
            tried, estimate = self.antithetic(vector, generation, self.worlds)
            answer, checked = score([tried, check])
            slopes = estimate(answer)
        else:
            (checked,), none = score([check]), jnp.full_like(vector, jnp.nan)
            slopes = Estimate(none, none, none)
        return {**self.step_results(proposal, checked), **gradient_results(slopes)}

    def descend(
        self,
        rule: optax.GradientTransformation,
        windows: Proposal,
        refresh: int = 1,
        window_steps: int = 0,
    ) -> Search:
        """Search by steps of an optimiser along the `gradients` of the results.

        The arrays of `windows` are those of `TuneGrad`, and come back with the results. After
        `window_steps`, or once the results drop windows, slopes start at the vector with the best
        validation.
        """
        vector, state, base = self.base, rule.init(jnp.asarray(self.base)), np.array(np.nan)
        best, least = vector, np.inf
        for following in itertools.count(1):
            results = yield {"vectors": vector[None], "base": base, **windows}
            base, vector = results["base"], results["vectors"][0]
            if results["validation"] < least:
                best, least = vector, float(results["validation"])
            was_windows = bool(windows and windows["windows"])
            slopes = jnp.nan_to_num(jnp.asarray(results["gradients"][0]), posinf=0.0, neginf=0.0)
            change, state = rule.update(slopes, state, jnp.asarray(vector))
            vector = vector + np.asarray(change)
            windows = {name: results[name] for name in windows}
            if was_windows and (following == window_steps or not windows["windows"]):
                windows, vector = windows | {"windows": np.array(0.0)}, best
            if windows and following % refresh == 0:
                windows = windows | {"anchors": vector[None]}

    def step_results(self, proposal: Proposal, check: CandidateScores | None = None) -> Results:
        """Return the results of a step without its gradient; NaN without a validation."""
        value = success = np.nan
        if check is not None:
            (value,) = np.asarray(self.objective.value(check.score))
            success = check.outcome.success.mean()
        base = proposal["base"]
        return {
            "center": proposal["vectors"][0],
            "validation": value,
            "validation_success": success,
            **dict.fromkeys(("mean", "best"), value),
            "spread": 0.0,
            "base": value if np.isnan(base) else base,
        }


def gradient_results(estimate: Estimate) -> dict[str, Array]:
    """Return the results of a step for the gradient (p,) that it follows."""
    return {
        "gradients": estimate.gradient[None],
        "gradient": jnp.linalg.norm(estimate.gradient),
        "gradient_error": jnp.sqrt(jnp.sum(estimate.variance)),
        "finite": estimate.finite.mean(),
    }


@dataclass(frozen=True)
class TuneES(Descent):
    """Tune a law's parameters by evolution, in many worlds.

    Use it for the parameters of a law, and `rps tune grad` for tables and networks of some hundred
    numbers and more.

    The answer has, by generation, the objective of the candidates, the objective of the mean of
    their distribution in the worlds for validation, and the `params` (generation, parameter) of
    that mean. Its `tuned` (parameter) are the parameters with the best validation. Arrays have a
    parameter for each entry. With the estimator antithetic a generation is one step.

    Examples:
      >>> import rps_jax
      >>> drums = {"objects": ("random_cylinder",), "tuned": ("K_h", "K_v")}
      >>> brief = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=2.0))
      >>> small = {"worlds": 2, "validation": 2, "population": 4, "generations": 1}
      >>> results = rps_jax.tune_es("rps", **drums, **small, setting=brief)
      >>> dict(results.params.sizes)
      {'generation': 1, 'parameter': 2}
    """

    QUICK: ClassVar = dict(Tuning.QUICK) | {
        "worlds": 32, "population": 12, "generations": 8, "spread": 1.0,
    }  # fmt: skip
    # Options that the other estimator alone uses; the manifests of 0.4 lack those of cma.
    UNUSED: ClassVar = {
        "cma": ("estimator", "learning_rate", "sigma", "pairs"),
        "sep_cma": ("learning_rate", "sigma", "pairs"),
        "antithetic": ("population", "spread", "prior"),
    }

    estimator: Literal["cma", "sep_cma", "antithetic"] = "cma"
    """Method: cma (CMA-ES), sep_cma (with a diagonal covariance, for hundreds of parameters), or
    antithetic (steps along slopes of whole trials, by random steps of the parameters and their
    opposites)."""
    population: int = option(64, 4, 100_000)
    """Number of candidates in a generation of cma."""
    generations: int = option(50, 1, 1_000_000)
    """Number of generations, or of steps."""
    spread: float = option(0.5, above=0, at_most=10)
    """Standard deviation of the first generation about the start, in units of the bounded map
    [1]."""
    prior: float = option(0.002, 0)
    """Cost of a mean squared distance of 1 between the vectors of a candidate of cma and of the
    start [1]; it keeps the search where the bounded map is steep."""
    learning_rate: float = option(0.2, above=0)
    """Root mean square change of the parameters in the first step of antithetic, in units of the
    bounded map [1]; it decays to zero along a cosine."""

    def check(self) -> None:
        super().check()
        for name in self.UNUSED[self.estimator]:
            value, defaults = getattr(self, name), (getattr(TuneES, name), self.QUICK.get(name))
            if value not in defaults and name != "estimator":
                known = " or ".join(x for x, unused in self.UNUSED.items() if name not in unused)
                raise errors.not_allowed(name, value, f"only the estimator {known} has it")

    @property
    def num_generations(self) -> int:
        return self.generations + (self.estimator == "antithetic")

    def fields_as_json(self) -> JsonObject:
        fields, unused = super().fields_as_json(), self.UNUSED[self.estimator]
        if self.estimator == "antithetic":
            fields["steps"] = self.generations  # the schedule depends on them
        return {k: x for k, x in fields.items() if k not in unused}

    def search(self) -> Search:
        """Search by CMA-ES of the package cmaes, or by a descent; `center` is the mean."""
        if self.estimator == "antithetic":
            rate = self.learning_rate
            rule = optimiser("fixed_length", "cosine_decay", rate, self.generations)
            yield from self.descend(rule, {})
        seed = int(np.random.SeedSequence((self.setting.seed, 0)).generate_state(1)[0])
        kind = cmaes.SepCMA if self.estimator == "sep_cma" else cmaes.CMA
        strategy = kind(self.base, self.spread, population_size=self.population, seed=seed)
        while True:
            vectors = np.stack([strategy.ask() for _ in range(self.population)])
            results = yield {"vectors": vectors, "center": strategy.mean.copy()}
            vectors, values = results["vectors"], results["values"]
            worst = np.max(values[~np.isnan(values)], initial=-np.inf)
            ranked = np.where(np.isnan(values), worst + 1.0, values)
            strategy.tell([(x, float(value)) for x, value in zip(vectors, ranked, strict=True)])

    def judge(self, proposal: Proposal, generation: int, score: ScoreCandidates) -> Results:
        if self.estimator == "antithetic":
            return self.try_step(proposal, generation, score, self.generations)
        vectors, center = proposal["vectors"], proposal["center"]
        tried = self.candidates(np.vstack([vectors, self.base]), generation)
        candidates, check = score([tried, self.validation_candidates(center)])
        *values, base_value = np.asarray(self.objective.value(candidates.score))
        distances = np.mean((vectors - self.base) ** 2, axis=-1)
        start = {"vectors": center[None], "base": base_value}
        return {
            **self.step_results(start, check),
            "values": values + self.prior * distances,
            "best": np.nanmin(values),
            "mean": float(np.nanmean(values)),
            "spread": float(np.nanstd(values)),
            "not_finite": np.isnan(values).sum(),
        }


tune_es = call_of(TuneES)
