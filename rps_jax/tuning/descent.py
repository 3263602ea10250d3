"""Tune a law by slopes of its objective in whole trials, along antithetic random steps.

Every world tries random steps of the parameters and their opposites, under the original law and
the paper's rules; so the gradient includes failures, at which derivatives jump. All worlds of a
step, and those for its validation, are one batch.
"""

from __future__ import annotations

import itertools
import math
import warnings
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.record.options import option
from rps_jax.runs.evaluate import Candidates, CandidateScores
from rps_jax.runs.question import call_of
from rps_jax.tuning import gradients
from rps_jax.tuning.gradients import Estimate
from rps_jax.tuning.run import Proposal, Results, ScoreCandidates, Search, Tuning

_MOMENTUM = 0.8  # [1] weight of earlier gradients in the direction of a step


@dataclass(frozen=True)
class TuneGrad(Tuning):
    """Tune a law by slopes of whole trials along random steps, without derivatives.

    The answer is that of `TuneES`, with a step as a generation.

    The gradients are slopes along random steps of the parameters, in whole trials. Derivatives
    (`value_and_grad`) do not serve here: they miss whether a push fails. They are the better choice
    for single pushes of some seconds: to plan one, or to fit a log.

    Examples:
      >>> import rps_jax
      >>> drums = {"objects": ("random_cylinder",), "tuned": ("K_h",)}
      >>> brief = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=2.0))
      >>> small = {"worlds": 2, "validation": 2, "steps": 1}
      >>> results = rps_jax.tune_grad("rps", **drums, **small, setting=brief)
      >>> dict(results.params.sizes)
      {'generation': 2, 'parameter': 1}
    """

    QUICK = Tuning.QUICK | {
        "worlds": 64,
        "steps": 8,
        "learning_rate": 0.3,
    }

    worlds: int = option(512, 1, 10_000_000)
    """Number of worlds of a step, in each domain; every step has other worlds."""
    learning_rate: float = option(0.2, above=0)
    """Root mean square change of the parameters in the first step, in units of the bounded map [1];
    it decays to zero along a cosine."""
    steps: int = option(50, 1, 1_000_000)
    """Number of steps of each descent."""
    starts: int = option(1, 1, 1_000_000)
    """Number of concurrent descents: one from the start itself, the others from random vectors
    near it."""
    spread: float = option(0.5, 0, 10)
    """Standard deviation of these random vectors, in units of the bounded map [1]."""
    sigma: float = option(0.3, above=0)
    """Standard deviation of random steps, in units of the bounded map [1]."""
    pairs: int = option(1, 1, 1_000_000)
    """Number of antithetic pairs of random steps in each world."""

    @property
    def num_generations(self) -> int:
        return self.steps + 1

    def search(self) -> Search:
        """Search by concurrent gradient descents, from the start and random vectors near it.

        A step has a given length along the mean of the last gradients. The value `base` is the
        validation of the start.
        """
        start, random = self.base, np.random.default_rng(self.setting.seed)
        offsets = random.normal(size=(self.starts, start.size))
        offsets[0] = 0.0
        thetas, mean, base = start + self.spread * offsets, 0.0, np.array(np.nan)  # (S, p)
        for step in itertools.count():
            results = yield {"vectors": thetas, "base": base}
            base = results["base"]
            slopes = results["gradients"]
            mean = _MOMENTUM * mean + (1 - _MOMENTUM) * np.where(np.isnan(slopes), 0.0, slopes)
            norm = np.linalg.norm(mean, axis=1, keepdims=True) / math.sqrt(start.size)
            rate = self.learning_rate * (1 + math.cos(math.pi * step / self.steps)) / 2
            thetas = results["vectors"] - rate * mean / np.where(norm > 0, norm, 1.0)

    def judge(self, proposal: Proposal, generation: int, score: ScoreCandidates) -> Results:
        """Validate all vectors (S, p) and estimate their gradients: NaN after the last step."""
        vectors = proposal["vectors"]
        check = self.validation_candidates(self.space.params(vectors))
        if generation < self.steps:
            answer, slopes = self.slopes(jnp.asarray(vectors), generation, check, score)
        else:
            (answer,) = score([check])
            names = ("gradient", "gradient_error", "finite")
            slopes = dict.fromkeys(names, np.nan) | {"gradients": 0 * vectors + np.nan}
        values = self.objective.value(answer.score)
        first = int(jnp.nanargmin(values))
        return {
            "validations": values,
            "center": vectors[first],
            "validation": values[first],
            "validation_success": answer.outcome.success[first].mean(),
            "mean": jnp.nanmean(values),
            "spread": jnp.nanstd(values),
            "best": values[first],
            "base": proposal["base"] if generation else values[0],
            **slopes,
        }

    def slopes(
        self, thetas: jax.Array, step: int, check: Candidates, score: ScoreCandidates
    ) -> tuple[CandidateScores, Results]:
        """Return the scores of the candidates `check`, and gradients at thetas (S, p)."""
        answers: list[CandidateScores] = []

        def score_all(steps: list[Candidates]) -> list[CandidateScores]:
            """Score the steps in one batch with the candidates `check`."""
            answers[:] = score([*steps, check])
            return answers[:-1]

        estimate = evolution_gradients(thetas, self, step, score_all)
        return answers[-1], gradient_results(estimate)


tune_grad = call_of(TuneGrad)


def gradient_results(estimate: Estimate) -> dict[str, jax.Array]:
    """Return the results of a step for estimates (S, p); warn of slopes without a finite sample."""
    if missing := int(jnp.isnan(estimate.gradient).sum()):
        warnings.warn(
            f"{missing} of {estimate.gradient.size} slopes have no finite sample: they are NaN, "
            "and the step does without them.",
            stacklevel=2,
        )
    return {
        "gradients": estimate.gradient,
        "gradient": jnp.linalg.norm(estimate.gradient, axis=1).mean(),
        "gradient_error": jnp.sqrt(jnp.sum(estimate.variance, axis=1)).mean(),
        "finite": estimate.finite.mean(),
    }


def evolution_gradients(
    thetas: jax.Array, options: TuneGrad, step: int, score: ScoreCandidates
) -> Estimate:
    """Return estimates (S, p) by evolution, in whole trials of the original law."""
    key = jax.random.fold_in(jax.random.key(options.setting.seed), step)
    shape = options.candidates(options.space.params(thetas), step).shape  # (S, W)

    def scores(thetas: jax.Array, worlds: jax.Array) -> jax.Array:
        params = options.space.params(thetas.reshape(-1, shape[1], thetas.shape[-1]))
        candidates = replace(options.candidates(params, step), per_world=True)
        values = jnp.asarray(score([candidates])[0].score).reshape(-1, *shape)
        by_start = jnp.swapaxes(values, 0, 1).reshape(shape[0], -1)
        by_start = options.objective.linearise(by_start).reshape(shape[0], -1, shape[1])
        return jnp.swapaxes(by_start, 0, 1).ravel()

    theta = jnp.repeat(thetas, shape[1], axis=0)
    worlds = jnp.arange(len(theta))
    settings = gradients.Options(sigma=options.sigma, pairs=options.pairs)
    slopes = gradients.evolution(scores, theta, worlds, key, settings)
    return jax.vmap(gradients.estimate)(slopes.reshape(*shape, -1))
