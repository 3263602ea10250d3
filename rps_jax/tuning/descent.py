"""Tune a law by gradients: derivatives of windows of softened trials, or antithetic steps.

A softened trial has a smooth law and a smooth skin, and the base arrives by a weight instead of a
switch. A window is a part of such a trial; the distance that is left at its end counts as the time
to drive it. Evolution and validation run whole trials of the original law, under the paper's rules.
All trials run in the setting's engine.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax

from rps_jax import engines, errors
from rps_jax.control import registry, soft
from rps_jax.control.base import LawParams
from rps_jax.engines.base import Stage
from rps_jax.record.options import option
from rps_jax.runs.question import call_of
from rps_jax.trials.score import Objective
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Snapshot, Trial, World, advance, start_all
from rps_jax.trials.worlds import soften_skins
from rps_jax.tuning import gradients
from rps_jax.tuning.gradients import Estimate
from rps_jax.tuning.run import Proposal, Results, ScoreCandidates, Search, Tuning

_START_TIMES = 10  # number of different times at which windows start


@dataclass(frozen=True)
class TuneGrad(Tuning):
    """Tune a law's parameters by gradients, in many worlds.

    The answer is that of `TuneES`, with a step as a generation.

    Example:
      >>> import rps_jax
      >>> drums = {"objects": ("random_cylinder",), "tuned": ("K_h",)}
      >>> brief = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=2.0))
      >>> small = {"worlds": 2, "validation": 2, "steps": 1, "starts": 1, "pairs": 1}
      >>> results = rps_jax.tune_grad("rps", **drums, **small, estimator="evolution", setting=brief)
      >>> dict(results.params.sizes)
      {'generation': 2, 'parameter': 1}
    """

    QUICK: ClassVar[dict[str, Any]] = Tuning.QUICK | {
        "steps": 8, "starts": 1, "learning_rate": 0.3,
    }  # fmt: skip

    worlds: int = option(64, 1, 10_000_000)
    """Number of worlds of a step, in each domain; every step has other worlds."""
    validation: int = option(128, 1, 10_000_000)
    estimator: str = "clipped"
    """Estimator of the gradient: exact, clipped (exact with a bound in each world) or mixed
    (exact and evolution) in windows of softened trials; or evolution, antithetic steps in whole
    trials, without derivatives."""
    learning_rate: float = option(0.1, above=0)
    """Learning rate of the first step, in units of the bounded map [1]; it decays to zero along a
    cosine."""
    clip: float = option(1.0, above=0)
    """Bound on the norm of a gradient [1]."""
    world_clip: float = option(2.0, above=0)
    """Bound on the norm of the gradient of one world, for clipped, as a multiple of the median
    norm [1]; without it a few chaotic worlds dominate."""
    steps: int = option(40, 1, 1_000_000)
    """Number of steps of each descent."""
    starts: int = option(4, 1, 1_000_000)
    """Number of concurrent descents: one from the start itself, the others from random vectors
    near it."""
    spread: float = option(0.5, 0, 10)
    """Standard deviation of these random vectors, in units of the bounded map [1]."""
    window: float = option(8.0, above=0, unit="s")
    """Length of a window of a softened trial [s]."""
    within: float = option(100.0, 0, unit="s")
    """Windows start at one of ten random times up to this; with 0 they start with the trials
    [s]."""
    arrive: float = option(0.005, above=0, unit="m")
    """Temperature at which a softened trial arrives [m]."""
    taxels: float = option(0.03, above=0, at_most=1)
    """Temperature of the taxels of a softened trial [1]."""
    sigma: float = option(0.15, above=0)
    """Standard deviation of random steps, in units of the bounded map [1]."""
    pairs: int = option(1, 1, 1_000_000)
    """Number of antithetic pairs of random steps in each world."""

    @property
    def num_generations(self) -> int:
        return self.steps + 1

    @property
    def differentiates(self) -> bool:
        """Whether the estimator needs derivatives of the scores."""
        return self.estimator != "evolution"

    def check(self) -> None:
        """Check the common options, and that law and engine have derivatives if they are needed."""
        super().check()
        errors.check_name("estimator", self.estimator, gradients.ESTIMATORS)
        if self.differentiates:
            registry.smooth_law(registry.law_of(self.params))
            engine = engines.get(self.setting.engine)
            engine.check_derivatives("reverse", self.setting.physics)

    def search(self) -> Search:
        """Search by concurrent gradient descents, from the start and random vectors near it.

        The value `base` is the validation of the start.
        """
        start, key = self.space.vector(self.space.base), jax.random.key(self.setting.seed)
        offsets = jax.random.normal(key, (self.starts, start.size), start.dtype).at[0].set(0.0)
        thetas = start + self.spread * offsets  # (S, p)
        state, base = jax.vmap(self.rule.init)(thetas), np.array(np.nan)
        while True:
            results = yield {"vectors": np.asarray(thetas), "base": base}
            base, gradient = results["base"], jnp.asarray(results["gradients"])
            thetas = jnp.asarray(results["vectors"])
            changes, state = jax.vmap(self.rule.update)(gradient, state, thetas)
            thetas = jnp.asarray(optax.apply_updates(thetas, changes))

    def judge(self, proposal: Proposal, generation: int, score: ScoreCandidates) -> Results:
        """Validate all vectors (S, p) and estimate their gradients: NaN after the last step."""
        vectors = proposal["vectors"]
        (answer,) = score([self.validation_candidates(self.space.params(vectors))])
        values = self.objective.value(answer.score)
        first = int(jnp.nanargmin(values))
        results = {
            "validations": values,
            "center": vectors[first],
            "validation": values[first],
            "validation_success": answer.outcome.success[first].mean(),
            "mean": jnp.nanmean(values),
            "spread": jnp.nanstd(values),
            "best": values[first],
            "base": proposal["base"] if generation else values[0],
        }
        if generation == self.steps:
            names = ("gradient", "gradient_error", "finite", "differentiate")
            return results | dict.fromkeys(names, np.nan) | {"gradients": 0 * vectors + np.nan}
        thetas, start_time = jnp.asarray(vectors), time.perf_counter()
        if self.differentiates:
            estimate, simulated, compile_time = window_gradients(thetas, self, generation)
            wall = time.perf_counter() - start_time - compile_time
        else:
            estimate = evolution_gradients(thetas, self, generation, score)
            simulated = compile_time = wall = 0.0  # of windows
        return results | {
            "gradients": estimate.gradient,
            "gradient": jnp.linalg.norm(estimate.gradient, axis=1).mean(),
            "gradient_error": jnp.sqrt(jnp.sum(estimate.variance, axis=1)).mean(),
            "finite": estimate.finite.mean(),
            "simulated": simulated,
            "compile": compile_time,
            "differentiate": wall,
        }

    @property
    def estimator_options(self) -> gradients.Options:
        """Options of the estimator."""
        return gradients.Options(self.world_clip, self.sigma, self.pairs)

    @functools.cached_property
    def family_programs(self) -> tuple[Callable[..., Any], ...]:
        """Three functions for worlds (n, ...) of one shape family and their stage.

        `starts` returns the trials (S, n, ...) at the starts of windows, of thetas (S, p) and
        start times (n,). Of thetas, key and these, `evaluate` returns the scores (S, n), and
        `estimates` the gradients (S, p).
        """
        estimator = gradients.ESTIMATORS[self.estimator]

        def starts(thetas: jax.Array, stage: Stage, worlds: World, start: jax.Array) -> Trial:
            return jax.vmap(lambda x: window_starts(self, stage, x, worlds, start))(thetas)

        def evaluate(
            thetas: jax.Array, key: jax.Array, stage: Stage, worlds: World, trials: Trial
        ) -> jax.Array:
            scores = window_scores(self, stage)
            at = jax.vmap(lambda x, first: scores(gradients.per_world(x, worlds), (worlds, first)))
            return at(thetas, trials)

        def estimates(
            thetas: jax.Array, key: jax.Array, stage: Stage, worlds: World, trials: Trial
        ) -> Estimate:
            samples = partial(estimator, window_scores(self, stage), options=self.estimator_options)
            at = jax.vmap(lambda x, first: gradients.estimate(samples(x, (worlds, first), key=key)))
            return at(thetas, trials)

        return jax.jit(starts), jax.jit(evaluate), jax.jit(estimates)

    @functools.cached_property
    def costs(self) -> dict[Hashable, float]:
        """Measured cost of an estimate in evaluations of its scores [1], by shape family."""
        return {}

    @functools.cached_property
    def rule(self) -> optax.GradientTransformation:
        """Update rule of optax: clipped gradients, Adam, and a decaying learning rate."""
        rate = optax.cosine_decay_schedule(self.learning_rate, self.steps)
        return optax.chain(optax.clip_by_global_norm(self.clip), optax.adam(rate))


tune_grad = call_of(TuneGrad)


# --- estimators ----------------------------------------------------------------------------


def soft_score(
    snapshots: Snapshot, params: LawParams, setting: Setting, objective: Objective, arrive: float
) -> jax.Array:
    """Return the objective's score () of the snapshots (T, ...) of a softened window.

    The base arrives at a step by a weight: in contact, and nearer than d_success within the
    temperature `arrive` [m]. Later steps count by the weight of not having arrived. At the end
    the remaining distance costs the time to drive it at v_max, because no window is long enough to
    detect a failure.
    """
    period = setting.physics.control_period
    contact, distance = 1.0 * snapshots.reading.in_contact, snapshots.details.distance
    arrival = contact * jax.nn.sigmoid((params.d_success - distance) / arrive)
    under_way = jnp.cumprod(1 - arrival)
    touched = jax.lax.cummax(contact)
    time = period * jnp.sum(under_way) + under_way[-1] * distance[-1] / params.v_max
    lost = period * jnp.sum(under_way * touched * (1 - contact))
    return jnp.asarray(objective.score(1.0, time, lost, 0.0, setting.rules))


def window_starts(
    options: TuneGrad, stage: Stage, theta: jax.Array, worlds: World, start: jax.Array
) -> Trial:
    """Return softened trials (n, ...) at the starts of their windows.

    `start` (n,) is the share of `within` at which a window starts, rounded up to tenths.
    """
    setting = options.setting
    law = registry.smooth_law(registry.law_of(options.space.base))
    loop = ControlLoop(setting.physics, setting.rules, law)
    params = jax.vmap(options.space.params)(gradients.per_world(theta, worlds))
    trials = start_all(worlds, params, jnp.ones(len(start), bool), law=law)
    steps = round(options.within / setting.physics.control_period / _START_TIMES)

    def proceed(i: jax.Array, trials: tuple[Trial, Trial]) -> tuple[Trial, Trial]:
        running, chosen = trials
        (running,) = advance([(stage, worlds, params, running)], loop, steps)
        return running, jax.vmap(soft.tree_where)(i < start * _START_TIMES, running, chosen)

    return jax.lax.fori_loop(0, _START_TIMES if steps else 0, proceed, (trials, trials))[1]


def window_scores(options: TuneGrad, stage: Stage) -> gradients.Scores:
    """Return the scores of windows of softened trials, a function as `gradients` defines it.

    The worlds are pairs of a World and the Trial at which its window starts.
    """
    space, setting = options.space, options.setting
    law = registry.smooth_law(registry.law_of(space.base))
    loop = ControlLoop(setting.physics, law=law)

    def cost(snapshots: Snapshot) -> jax.Array:
        return soft_score(snapshots, space.base, setting, options.objective, options.arrive)

    steps = max(1, round(options.window / setting.physics.control_period))
    score = gradients.window(stage, space.params, cost, loop, steps)

    def scores(thetas: jax.Array, worlds: tuple[World, Trial]) -> jax.Array:
        return options.objective.linearise(score(thetas, worlds))

    return scores


def window_gradients(
    thetas: jax.Array, options: TuneGrad, step: int
) -> tuple[Estimate, float, float]:
    """Return estimates (S, p) from the windows of one step, their cost, and the compile time [s].

    The cost is in simulated time [s], with the trials up to the last window. A derivative counts
    as the plain simulation of the same windows that takes as long.
    """
    setting = options.setting
    candidates = options.candidates(options.space.params(thetas), step)
    random = np.random.default_rng((setting.seed, step))
    key = jax.random.fold_in(jax.random.key(setting.seed), step)
    total, cost, compile_time, estimates = candidates.shape[1], 0.0, 0.0, []
    starts, *programs = options.family_programs
    for index, batch in enumerate(candidates.batches(setting)):
        share = batch.indices.size / total
        worlds, start = (
            soften_skins(batch.worlds, options.taxels),
            random.uniform(size=batch.indices.size),
        )
        compile_start = time.perf_counter()
        trials = jax.block_until_ready(starts(thetas, batch.stage, worlds, jnp.asarray(start)))
        inputs = thetas, jax.random.fold_in(key, index), batch.stage, worlds, trials
        if index not in options.costs:
            forward, backward = (_seconds(program, *inputs) for program in programs)
            options.costs[index] = backward / forward
            compile_time += time.perf_counter() - compile_start
        x = programs[1](*inputs)
        estimates.append(Estimate(share * x.gradient, share**2 * x.variance, share * x.finite))
        cost += share * (options.costs[index] * options.window + options.within)
    mean = jax.block_until_ready(jax.tree.map(lambda *leaves: sum(leaves), *estimates))
    return mean, len(thetas) * total * cost, compile_time


def _seconds(program: Callable[..., Any], *inputs: Any) -> float:
    """Return the wall clock [s] of a compiled program: the second of two calls."""
    jax.block_until_ready(program(*inputs))
    start_time = time.perf_counter()
    jax.block_until_ready(program(*inputs))
    return time.perf_counter() - start_time


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
    slopes = gradients.evolution(scores, theta, worlds, key, options.estimator_options)
    return jax.vmap(gradients.estimate)(slopes.reshape(*shape, -1))
