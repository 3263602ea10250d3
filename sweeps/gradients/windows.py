"""Derivatives of windows of softened trials, with the remaining distance as value at the end.

A softened trial has a smooth law and a smooth skin, and the base arrives by a weight instead of a
switch. A window is a part of such a trial; the distance that is left at its end counts as the time
to drive it. `score.py` compares their gradients with those of whole trials; the windows of
`rps tune grad` have another value and start at states of original trials.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.control import registry
from rps_jax.engines.base import Stage
from rps_jax.laws import law_of
from rps_jax.physics import get_engine
from rps_jax.questions import option
from rps_jax.trials.trial import ControlLoop, Snapshot, Trial, World, advance, start_all
from rps_jax.trials.worlds import soften_skins
from rps_jax.tuning import gradients
from rps_jax.tuning.derivatives import soft_score
from rps_jax.tuning.evolution import Descent
from rps_jax.tuning.gradients import Estimate
from sweeps.gradients import estimators

_START_TIMES = 10  # number of different times at which windows start


@dataclass(frozen=True)
class Windows(Descent):
    """Worlds, parameters and windows of a gradient."""

    estimator: str = "clipped"
    """Estimator of the gradient: exact, clipped (exact with a bound in each world), bundled,
    evolution or mixed (exact and evolution)."""
    world_clip: float = option(2.0, above=0)
    """Bound on the norm of the gradient of one world, for clipped, as a multiple of the median
    norm [1]; without it a few chaotic worlds dominate."""
    window: float = option(8.0, above=0, unit="s")
    """Length of a window of a softened trial [s]."""
    within: float = option(100.0, 0, unit="s")
    """Windows start at one of ten random times up to this; with 0 they start with the trials
    [s]."""
    arrive: float = option(0.005, above=0, unit="m")
    """Temperature at which a softened trial arrives [m]."""
    taxels: float = option(0.03, above=0, at_most=1)
    """Temperature of the taxels of a softened trial [1]."""

    def check(self) -> None:
        """Check the common options, and that law and engine have derivatives."""
        super().check()
        errors.check_name("estimator", self.estimator, estimators.ESTIMATORS)
        registry.smooth_law(law_of(self.params))
        get_engine(self.setting.engine).check_derivatives("reverse")


def window_starts(
    options: Windows, stage: Stage, theta: jax.Array, worlds: World, start: jax.Array
) -> Trial:
    """Return softened trials (n, ...) at the starts of their windows.

    `start` (n,) is the share of `within` at which a window starts, rounded up to tenths.
    """
    setting = options.setting
    law = registry.smooth_law(law_of(options.space.base))
    loop = ControlLoop(setting.physics, setting.rules, law)
    params = jax.vmap(options.space.params)(gradients.per_world(theta, worlds))
    trials = start_all(worlds, params, jnp.ones(len(start), bool), law=law)
    steps = round(options.within / setting.physics.control_period / _START_TIMES)

    def proceed(i: jax.Array, trials: tuple[Trial, Trial]) -> tuple[Trial, Trial]:
        running, chosen = trials
        (running,) = advance([(stage, worlds, params, running)], loop, steps)
        select = jax.vmap(lambda mask, x, y: jax.tree.map(partial(jnp.where, mask), x, y))
        return running, select(i < start * _START_TIMES, running, chosen)

    return jax.lax.fori_loop(0, _START_TIMES if steps else 0, proceed, (trials, trials))[1]


def window_scores(options: Windows, stage: Stage) -> gradients.Scores:
    """Return the scores of windows of softened trials, a function as `gradients` defines it.

    The worlds are pairs of a World and the Trial at which its window starts.
    """
    space, setting = options.space, options.setting
    law = registry.smooth_law(law_of(space.base))
    loop = ControlLoop(setting.physics, law=law)

    def cost(snapshots: Snapshot) -> jax.Array:
        return soft_score(snapshots, space.base, setting, options.objective, options.arrive)

    steps = max(1, round(options.window / setting.physics.control_period))
    score = estimators.window(stage, space.params, cost, loop, steps)

    def scores(thetas: jax.Array, worlds: tuple[World, Trial]) -> jax.Array:
        return options.objective.linearise(score(thetas, worlds))

    return scores


def window_gradient(options: Windows) -> tuple[Estimate, float]:
    """Return the gradient (p,) of windows at the start, and its cost in simulated time [s].

    The cost has the trials up to the last window. A derivative counts as the plain simulation of
    the same windows that takes as long.
    """
    setting, theta = options.setting, jnp.asarray(options.base)
    candidates = options.candidates(options.space.params(theta[None]), 0)
    random, key = np.random.default_rng((setting.seed, 0)), jax.random.key(setting.seed)
    settings = gradients.Options(options.world_clip, options.sigma, options.pairs)
    estimator = partial(estimators.ESTIMATORS[options.estimator], options=settings)
    total, cost, estimates = candidates.shape[1], 0.0, []

    @jax.jit
    def starts(stage: Stage, worlds: World, start: jax.Array) -> Trial:
        return window_starts(options, stage, theta, worlds, start)

    @jax.jit
    def evaluate(key: jax.Array, stage: Stage, worlds: World, trials: Trial) -> jax.Array:
        scores = window_scores(options, stage)
        return scores(gradients.per_world(theta, worlds), (worlds, trials))

    @jax.jit
    def estimate(key: jax.Array, stage: Stage, worlds: World, trials: Trial) -> Estimate:
        scores = window_scores(options, stage)
        return gradients.estimate(estimator(scores, theta, (worlds, trials), key=key))

    for index, batch in enumerate(candidates.batches(setting)):
        share = batch.indices.size / total
        worlds = soften_skins(batch.worlds, options.taxels)
        start = jnp.asarray(random.uniform(size=batch.indices.size))
        trials = jax.block_until_ready(starts(batch.stage, worlds, start))
        inputs = jax.random.fold_in(key, index), batch.stage, worlds, trials
        forward, backward = (_seconds(program, *inputs) for program in (evaluate, estimate))
        x = estimate(*inputs)
        estimates.append(Estimate(share * x.gradient, share**2 * x.variance, share * x.finite))
        cost += share * (backward / forward * options.window + options.within)
    mean = jax.tree.map(lambda *leaves: sum(leaves), *estimates)
    return mean, total * cost


def _seconds(program: Callable[..., Any], *inputs: Any) -> float:
    """Return the wall clock [s] of a compiled program: the second of two calls."""
    jax.block_until_ready(program(*inputs))
    start_time = time.perf_counter()
    jax.block_until_ready(program(*inputs))
    return time.perf_counter() - start_time
