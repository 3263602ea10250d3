"""Tune a law by derivatives of windows of softened trials.

A softened trial has a smooth law and a smooth skin, and the base arrives by a weight instead of a
switch. A window is a part of such a trial; the distance that is left at its end counts as the time
to drive it. Validation runs whole trials of the original law, under the paper's rules.

    rps sweeps/gradients/windows.py --quick
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Hashable
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
from rps_jax.questions import call_of, option
from rps_jax.runs.evaluate import Candidates, CandidateScores
from rps_jax.trials.trial import ControlLoop, Snapshot, Trial, World, advance, start_all
from rps_jax.trials.worlds import soften_skins
from rps_jax.tuning import gradients
from rps_jax.tuning.derivatives import soft_score
from rps_jax.tuning.descent import TuneGrad, gradient_results
from rps_jax.tuning.gradients import Estimate
from rps_jax.tuning.run import Results, ScoreCandidates
from sweeps.gradients import estimators

_START_TIMES = 10  # number of different times at which windows start


@dataclass(frozen=True)
class WindowTuning(TuneGrad):
    """Tune a law's parameters by derivatives of windows of softened trials.

    The answer is that of `rps tune grad`.
    """

    TITLE = "A law tuned by derivatives of windows"

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

    def slopes(
        self, thetas: jax.Array, step: int, check: Candidates, score: ScoreCandidates
    ) -> tuple[CandidateScores, Results]:
        """Return the scores of the candidates `check`, and gradients of windows at thetas (S, p).

        A derivative counts as the plain simulation of the same windows that takes as long.
        """
        (answer,) = score([check])
        start_time = time.perf_counter()
        estimate, simulated, compile_time = window_gradients(thetas, self, step)
        wall = time.perf_counter() - start_time - compile_time
        times = {"simulated": simulated, "compile": compile_time, "run": wall}
        return answer, gradient_results(estimate) | times

    @functools.cached_property
    def family_programs(self) -> tuple[Callable[..., Any], ...]:
        """Three functions for worlds (n, ...) of one shape family and their stage.

        `starts` returns the trials (S, n, ...) at the starts of windows, of thetas (S, p) and
        start times (n,). Of thetas, key and these, `evaluate` returns the scores (S, n), and
        `estimates` the gradients (S, p).
        """
        estimator = estimators.ESTIMATORS[self.estimator]
        options = gradients.Options(self.world_clip, self.sigma, self.pairs)

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
            samples = partial(estimator, window_scores(self, stage), options=options)
            at = jax.vmap(lambda x, first: gradients.estimate(samples(x, (worlds, first), key=key)))
            return at(thetas, trials)

        return jax.jit(starts), jax.jit(evaluate), jax.jit(estimates)

    @functools.cached_property
    def costs(self) -> dict[Hashable, float]:
        """Measured cost of an estimate in evaluations of its scores [1], by shape family."""
        return {}


window_tuning = call_of(WindowTuning)


def window_starts(
    options: WindowTuning, stage: Stage, theta: jax.Array, worlds: World, start: jax.Array
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


def window_scores(options: WindowTuning, stage: Stage) -> gradients.Scores:
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


def window_gradients(
    thetas: jax.Array, options: WindowTuning, step: int
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
