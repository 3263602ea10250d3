"""Tune a law by gradients: derivatives of windows of softened trials, or antithetic steps.

A softened trial has a smooth law and a smooth skin, and the base arrives by a weight instead of a
switch. A window is a part of such a trial; the distance that is left at its end counts as the time
to drive it. Validation runs the original law in the setting's engine, under the paper's rules.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax

from rps_jax.control import registry, soft
from rps_jax.control.base import LawParams
from rps_jax.engines.base import Stage
from rps_jax.record.options import option
from rps_jax.robot.skin import CapacitiveSkin
from rps_jax.runs.question import call_of
from rps_jax.trials.score import Objective
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Snapshot, Trial, World, control_step, start_all
from rps_jax.tuning import gradients
from rps_jax.tuning.gradients import Estimate
from rps_jax.tuning.run import Proposal, Results, ScoreCandidates, Search, Tuning
from rps_jax.world.physics import preset

Estimator = Literal["reverse", "evolution"]


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
    estimator: Estimator = "reverse"
    """reverse differentiates windows of trials on the quasi-static model; evolution takes
    antithetic steps in whole trials of the setting's engine."""
    learning_rate: float = option(0.1, above=0)
    """Learning rate of the first step, in units of the bounded map [1]; it decays to zero along a
    cosine."""
    clip: float = option(1.0, above=0)
    """Bound on the norm of a gradient [1]."""
    world_clip: float = option(2.0, above=0)
    """Bound on the norm of the gradient of one world, for reverse, as a multiple of the median
    norm [1]; without it a few chaotic worlds dominate."""
    steps: int = option(40, 1, 1_000_000)
    """Number of steps of each descent."""
    starts: int = option(4, 1, 1_000_000)
    """Number of concurrent descents: one from the start itself, the others from random vectors
    near it."""
    spread: float = option(0.5, 0, 10)
    """Standard deviation of these random vectors, in units of the bounded map [1]."""
    window: float = option(8.0, above=0, unit="s")
    """Length of a window of a softened trial, for reverse [s]."""
    within: float = option(100.0, 0, unit="s")
    """Windows start at random times up to this; with 0 they start with the trials [s]."""
    arrive: float = option(0.005, above=0, unit="m")
    """Temperature at which a softened trial arrives [m]."""
    sigma: float = option(0.15, above=0)
    """Standard deviation of the antithetic steps [1]."""
    pairs: int = option(8, 1, 1_000_000)
    """Number of antithetic pairs for each descent."""

    @property
    def num_generations(self) -> int:
        return self.steps + 1

    def check(self) -> None:
        """Check the common options, and that the law has derivatives if they are needed."""
        super().check()
        if self.estimator != "evolution":
            registry.smooth_law(registry.law_of(self.params))

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
        thetas, simulated, wall = jnp.asarray(vectors), 0.0, 0.0
        if self.estimator == "evolution":
            estimate = evolution_gradients(thetas, self, generation, score)
        else:
            start_time = time.perf_counter()
            estimate, simulated = jax.block_until_ready(window_gradients(thetas, self, generation))
            wall = time.perf_counter() - start_time
        return results | {
            "gradients": estimate.gradient,
            "gradient": jnp.linalg.norm(estimate.gradient, axis=1).mean(),
            "gradient_error": jnp.sqrt(jnp.sum(estimate.variance, axis=1)).mean(),
            "finite": estimate.finite.mean(),
            "simulated": simulated,
            "differentiate": wall,
        }

    @functools.cached_property
    def family_gradients(self) -> Callable[..., Estimate]:
        """Function of thetas (S, p), stage and worlds (n, ...) of one shape family.

        It returns estimates (S, p) from all these worlds; the worlds are pairs, as `window_scores`
        takes them.
        """

        def estimates(thetas: jax.Array, stage: Stage, worlds: tuple[World, jax.Array]) -> Estimate:
            scores = window_scores(self, stage)
            estimate = partial(gradients.reverse, scores, worlds=worlds, clip=self.world_clip)
            return jax.vmap(estimate)(thetas)

        return jax.jit(estimates)

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
    contact, distance = snapshots.reading.in_contact, snapshots.details.distance
    arrival = contact * jax.nn.sigmoid((params.d_success - distance) / arrive)
    under_way = jnp.cumprod(1 - arrival)
    touched = jax.lax.cummax(contact)
    time = period * jnp.sum(under_way) + under_way[-1] * distance[-1] / params.v_max
    lost = period * jnp.sum(under_way * touched * (1 - contact))
    return jnp.asarray(objective.score(1.0, time, lost, 0.0, setting.rules))


def soften_skins(worlds: World) -> World:
    """Return worlds (n, ...) with smooth skins."""
    sensor = worlds.skin
    temperature = 0.03 if isinstance(sensor, CapacitiveSkin) else 0.001
    temperatures = jnp.full(len(worlds.key), temperature)
    return worlds._replace(skin=sensor._replace(temperature=temperatures))


def window_scores(options: TuneGrad, stage: Stage) -> gradients.Scores:
    """Return the scores of windows of softened trials, a function as `gradients` defines it.

    A world is a pair (World, start), where `start` is the share of `within` at which its window
    starts. The same parameters drive the trial up to the window, without derivatives.
    """
    space, setting = options.space, options.setting
    law = registry.smooth_law(registry.law_of(space.base))
    loop = ControlLoop(preset(fidelity="fast"), law=law)

    def cost(snapshots: Snapshot) -> jax.Array:
        return soft_score(snapshots, space.base, setting, options.objective, options.arrive)

    period = setting.physics.control_period
    steps, first = round(options.window / period), round(options.within / period)
    score = gradients.window(stage, space.params, cost, loop, max(1, steps))

    def run_to_start(thetas: jax.Array, worlds: World, start: jax.Array) -> Trial:
        params = jax.vmap(space.params)(thetas)
        trials = start_all(worlds, params, jnp.ones(len(start), bool), law=law)

        def step(i: jax.Array, trials: Trial) -> Trial:
            next_trials, _ = control_step(stage, worlds, params, trials, loop)
            return jax.vmap(soft.tree_where)(i < start * first, next_trials, trials)

        return jax.lax.fori_loop(0, first, step, trials)

    def scores(thetas: jax.Array, worlds: tuple[World, jax.Array]) -> jax.Array:
        trials = run_to_start(jax.lax.stop_gradient(thetas), *worlds)
        return score(thetas, (worlds[0], jax.lax.stop_gradient(trials)))

    return scores


def window_gradients(thetas: jax.Array, options: TuneGrad, step: int) -> tuple[Estimate, float]:
    """Return estimates (S, p) from the windows of one step, and the simulated time [s].

    The time includes the trials up to each window, but not the steps in which a world waits for
    windows that start later.
    """
    setting = replace(options.setting, engine="quasistatic")
    candidates = options.candidates(options.space.params(thetas), step)
    random = np.random.default_rng((setting.seed, step))
    total, estimates = candidates.shape[1], []
    for batch in candidates.batches(setting):
        share = batch.indices.size / total
        worlds = soften_skins(batch.worlds), jnp.asarray(random.uniform(size=batch.indices.size))
        x = options.family_gradients(thetas, batch.stage, worlds)
        estimates.append(Estimate(share * x.gradient, share**2 * x.variance, share * x.finite))
    mean = jax.tree.map(lambda *leaves: sum(leaves), *estimates)
    return mean, len(thetas) * total * (options.window + options.within / 2)


def evolution_gradients(
    thetas: jax.Array, options: TuneGrad, step: int, score: ScoreCandidates
) -> Estimate:
    """Return estimates (S, p) from antithetic candidates of the original law in the same worlds."""
    key = jax.random.fold_in(jax.random.key(options.setting.seed), step)
    count, p = thetas.shape
    steps = jax.random.normal(key, (count, options.pairs, p), thetas.dtype)
    offsets = jnp.concatenate([steps, -steps], axis=1) * options.sigma
    params = options.space.params((thetas[:, None] + offsets).reshape(-1, p))
    (answer,) = score([options.candidates(params, step)])
    values = options.objective.value(answer.score).reshape(count, 2, options.pairs)
    slopes = (values[:, 0] - values[:, 1])[..., None] * steps / (2 * options.sigma)
    return jax.vmap(gradients.estimate)(slopes)
