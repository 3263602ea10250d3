"""Tune a law by exact derivatives of windows of trials, with an optimiser of optax.

Whole pushes are chaotic, and a push that fails has no derivative that says so. So the derivatives
are of windows of some seconds under the smooth law and skin. Windows start at states of trials of
the original law. A linear value function of their last states, fitted to the rest of these trials
with their failures, says what a window is worth. `TuneGrad` runs trials of the original law every
few steps: for new states, for the value function, to validate, and to measure the slope of whole
trials along the derivatives. Windows stall after some steps, and then slopes along random steps
replace them.

References: Xu et al., "Accelerated policy learning with parallel differentiable simulation", ICLR
2022 (windows with a value function); Suh et al., "Do differentiable simulators give better policy
gradients?", ICML 2022 (why derivatives of long, stiff trials mislead).
"""

from __future__ import annotations

import functools
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import PyTree

from rps_jax import errors
from rps_jax.control import registry
from rps_jax.control.base import LawParams
from rps_jax.engines import native
from rps_jax.engines.base import Stage
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Number
from rps_jax.record.options import option
from rps_jax.runs.question import call_of
from rps_jax.trials import trial
from rps_jax.trials.trajectory import control_loop
from rps_jax.trials.trial import ControlLoop, Snapshot, Trial, World
from rps_jax.trials.worlds import rows, soften_skins
from rps_jax.tuning import gradients
from rps_jax.tuning.derivatives import soft_times
from rps_jax.tuning.evolution import Descent, gradient_results
from rps_jax.tuning.gradients import Estimate
from rps_jax.tuning.optimisers import OptimiserLike, ScheduleName, optimiser
from rps_jax.tuning.run import TIMES, Proposal, Results, ScoreCandidates, Search, Tuning
from rps_jax.world.scene import JOINTS

_DERIVATIVE_COST = 4.0  # [1] simulated seconds for which a differentiated second counts
_ALIKE = (
    "All trials along the derivatives have equal scores, so slopes of whole trials replace them: "
    "raise checks, sigma or the horizon."
)


@dataclass(frozen=True)
class TuneGrad(Descent):
    """Tune a law by exact derivatives of the smooth trial, in mini-batches of random worlds.

    Use `rps tune es` for the parameters of a law, and this for tables and networks of some hundred
    numbers and more, with an engine that has derivatives.

    A step follows the derivatives of windows of some seconds, which start at states of trials of
    the original law; a value function, fitted to these trials, counts what follows a window. After
    `window_steps` steps, or once the score of whole trials does not fall along the derivatives, the
    run goes on from the best vector by slopes along random steps, as `rps tune es --estimator
    antithetic` does. The generation with the best validation in trials of the original law is the
    answer.

    The answer is that of `TuneES`, with a step as a generation. Its `slope` (generation) is the
    change of the score of whole trials for a unit step along the derivatives, with its
    `slope_error`; `windows` (generation) is 1 for steps by derivatives. Steps without a validation
    have NaN there. A differentiated second counts as four simulated ones.

    Examples:
      >>> import rps_jax
      >>> drums = {"objects": ("random_cylinder",), "tuned": ("K_h",)}
      >>> brief = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=2.0))
      >>> small = {"worlds": 2, "validation": 2, "steps": 1, "trials": 2, "windows": 2}
      >>> small |= {"window": 0.5, "checks": 2, "optimiser": "adam"}
      >>> results = rps_jax.tune_grad("rps", **drums, **small, setting=brief)
      >>> dict(results.params.sizes)
      {'generation': 2, 'parameter': 1}
    """

    QUICK: ClassVar = dict(Tuning.QUICK) | {
        "worlds": 64, "steps": 8, "learning_rate": 0.3, "windows": 64, "trials": 32,
        "window_steps": 4,
    }  # fmt: skip

    REMOVED: ClassVar = dict(Tuning.REMOVED) | dict.fromkeys(
        ("starts", "spread"),
        "rps tune grad follows derivatives; the former random steps, from one start, are "
        "`rps tune es --estimator antithetic`",
    )

    worlds: int = option(128, 1, 10_000_000)
    """Number of worlds of a step by slopes, in each domain; every step has other worlds."""
    validation: int = option(128, 1, 10_000_000)
    """Number of worlds for validation, in each domain."""
    optimiser: OptimiserLike = "fixed_length"
    """Optimiser: fixed_length (steps of a fixed root mean square along the momentum), or a function
    of optax with a learning rate, as adam, adamw or sgd; in Python any transformation of optax."""
    schedule: ScheduleName = "cosine_decay"
    """Schedule of the learning rate over all steps, of optax: constant, cosine_decay,
    exponential_decay (to a tenth), linear (to zero), warmup_cosine_decay (a tenth is warm-up)."""
    learning_rate: float = option(0.15, above=0)
    """Learning rate of the optimiser, in units of the bounded map [1]; of fixed_length the root
    mean square change of the parameters."""
    steps: int = option(50, 1, 1_000_000)
    """Number of steps."""
    window_steps: int = option(10, 0, 1_000_000)
    """Number of steps by derivatives, before those by slopes; windows stall after some ten
    steps."""
    windows: int = option(256, 1, 1_000_000)
    """Number of windows of a step, a mini-batch of the states of the trials."""
    window: float = option(5.0, above=0, unit="s")
    """Length of a window, and time between the states of a trial at which windows start [s]."""
    trials: int = option(64, 1, 1_000_000)
    """Number of trials of the original law, in each domain, whose states start windows."""
    refresh: int = option(3, 1, 1_000_000)
    """Number of steps between new trials, with which the validation comes."""
    checks: int = option(32, 0, 1_000_000)
    """Number of worlds in which a step of `sigma` along the derivatives and its opposite are tried,
    in each domain; 0: none, so that windows are not dropped."""
    clip: float = option(2.0, above=0)
    """Bound on the norm of the derivatives of one window, as a multiple of the median norm [1];
    without it a few chaotic windows dominate."""

    @property
    def num_generations(self) -> int:
        return self.steps + 1

    def check(self) -> None:
        super().check()
        self._optimiser()
        engine = self.setting.simulator
        engine.check_traced()
        engine.check_derivatives("reverse")
        longest = float(self.setting.rules.horizon)
        errors.check_finite("window", self.window, at_most=longest, unit="s")

    def note(self) -> str:
        return (
            "Derivatives first, then slopes; `rps tune es --estimator antithetic` has slopes alone."
        )

    def _optimiser(self) -> optax.GradientTransformation:
        return optimiser(self.optimiser, self.schedule, self.learning_rate, self.steps)

    def search(self) -> Search:
        """Search by steps of the optimiser, first by derivatives of windows and then by slopes."""
        windows = {
            "windows": np.array(float(self.window_steps > 0)),
            "anchors": self.base[None],
            "moments": np.zeros((_NUM_FEATURES + 2,) * 2),
        }
        return self.descend(self._optimiser(), windows, self.refresh, self.window_steps)

    def judge(self, proposal: Proposal, generation: int, score: ScoreCandidates) -> Results:
        """Validate and estimate slopes; or differentiate windows, with both every few steps."""
        none = {"slope": np.nan, "slope_error": np.nan}
        if not proposal["windows"] or generation == self.steps:
            slopes = self.try_step(proposal, generation, score, self.steps)
            return {**slopes, **none, "windows": 0.0}
        vector, moments = jnp.asarray(proposal["vectors"][0]), proposal["moments"]
        times: dict[str, float] = dict.fromkeys(TIMES, 0.0)
        anchor = generation - generation % self.refresh
        if anchor not in self._states:
            self._states.clear()
            self._states[anchor] = self._collect(proposal["anchors"], anchor, times)
        states = self._states[anchor]
        if anchor == generation:
            moments = _REMEMBERED * moments + sum(x.moments for x in states)
        followed = self._derivatives(vector, states, fit(moments), generation, times)
        windows, results, checked = 1.0, self.step_results(proposal), none
        if anchor == generation:
            results, checked = self._check(proposal, generation, score, followed.gradient)
            windows = float(not checked["slope"] <= 0)  # NaN without a check
        more = {"windows": windows, "moments": moments} | checked
        return {**results, **gradient_results(followed), **more, **times}

    def _check(
        self, proposal: Proposal, generation: int, score: ScoreCandidates, gradient: Array
    ) -> tuple[Results, dict[str, float]]:
        """Validate, and measure the slope of whole trials along a gradient (p,)."""
        vector, way = jnp.asarray(proposal["vectors"][0]), jnp.nan_to_num(gradient)
        way = way / jnp.maximum(jnp.sqrt(jnp.mean(way**2)), 1e-30)
        tried = [self.validation_candidates(vector)]
        if self.checks:
            pair = vector + self.sigma * jnp.stack([way, -way])
            fresh = self.candidates(pair, generation, self.checks)
            tried.append(replace(fresh, worlds=fresh.worlds + self.trials))
        validation, *pairs = score(tried)
        slope = variance = np.nan
        for answer in pairs:
            ahead, back = jnp.asarray(answer.score)
            slopes = gradients.estimate((ahead - back)[:, None] / (2 * self.sigma))
            slope, variance = slopes.gradient[0], slopes.variance[0]
            if (ahead == back).all():
                warnings.warn(_ALIKE, stacklevel=2)
        checked = {"slope": float(slope), "slope_error": float(np.sqrt(variance))}
        return self.step_results(proposal, validation), checked

    @functools.cached_property
    def _states(self) -> dict[int, list[_States]]:
        """States of the trials of a generation, by shape family."""
        return {}

    def _collect(
        self, vectors: np.ndarray, generation: int, times: dict[str, float]
    ) -> list[_States]:
        """Run trials of the original law with a vector (1, p)."""
        families, tried = [], self.candidates(vectors, generation, self.trials)
        for batch in tried.batches(self.setting):
            stage, soft = batch.stage, soften_skins(batch.worlds)
            inputs = jnp.asarray(vectors[0]), stage, batch.worlds, soft
            trials, table, live, seconds = self._call(_run_trials, times, *inputs)
            times["simulated"] += float(np.sum(seconds))
            live, table = np.asarray(live), np.asarray(table, float)
            touched = live & (table[..., 1] > 0.5)  # by the feature `contact`
            chosen = np.argwhere(touched if touched.any() else live)
            families.append(_States(stage, soft, trials, chosen, table[live].T @ table[live]))
        return families

    def _derivatives(
        self,
        vector: Array,
        states: list[_States],
        coefficients: np.ndarray,
        generation: int,
        times: dict[str, float],
    ) -> Estimate:
        """Return the clipped derivatives (p,) of windows from random states."""
        random = np.random.default_rng((self.setting.seed, generation))
        counts = np.array([x.worlds.qpos.shape[0] for x in states], float)
        shares = np.diff(np.rint(np.cumsum([0.0, *counts]) / counts.sum() * self.windows))
        samples = []
        for family, count in zip(states, shares.astype(int), strict=True):
            if count:
                at = random.choice(family.chosen, count, replace=len(family.chosen) < count)
                inputs = family.stage, family.worlds, family.trials, jnp.asarray(at)
                value = jnp.asarray(coefficients, float)
                samples.append(self._call(_differentiate, times, vector, value, *inputs))
        times["simulated"] += _DERIVATIVE_COST * self.windows * self.window
        return gradients.estimate(gradients.clip(jnp.concatenate(samples), self.clip))

    @functools.cached_property
    def _programs(self) -> dict[Callable[..., PyTree], Any]:
        """Functions that JAX compiles once for each shape family."""
        return {}

    def _call(
        self, function: Callable[..., PyTree], times: dict[str, float], *inputs: PyTree
    ) -> PyTree:
        """Call a function of the options and some arrays; add the wall clock to `times` [s]."""
        program = self._programs.setdefault(function, jax.jit(partial(function, self)))
        count, start_time = program._cache_size(), time.perf_counter()
        result = jax.block_until_ready(program(*inputs))
        # The first run of a program counts as its compilation.
        name = "run" if program._cache_size() == count else "compile"
        times[name] += time.perf_counter() - start_time
        return result


tune_grad = call_of(TuneGrad)


class _States(NamedTuple):
    """States of trials of the original law in worlds of one shape family."""

    stage: Stage
    worlds: World  # (n, ...) with smooth skins
    trials: Trial  # (K, n, ...) one state of each trial per length of a window
    chosen: np.ndarray  # (m, 2) indices of the states at which windows may start
    moments: np.ndarray  # (F + 2, F + 2) sums of products of 1, features and remaining score


def _run_trials(
    options: TuneGrad, vector: Array, stage: Stage, worlds: World, soft: World
) -> tuple[Trial, Array, Array, Array]:
    """Run trials of the original law.

    Returns:
      Their states (K, n, ...), one per length of a window; columns (K, n, F + 2) of these: 1,
      features and remaining score; whether the trial runs there (K, n); and the times (n,) [s] of
      the trials.
    """
    setting, objective = options.setting, options.objective
    loop = control_loop(options.params, setting, smooth=False)
    period, rules = setting.physics.control_period, setting.rules
    params = jax.vmap(options.space.params)(gradients.per_world(vector, worlds))

    def score(state: Trial, success: Number, missed: Number) -> Number:
        times = state.steps * period, state.lost_steps * period
        return objective.score(success, *times, missed, rules)

    def proceed(state: Trial, _: None) -> tuple[Trial, PyTree]:
        inputs = jax.vmap(features, (0, 0, 0, None))(soft, params, state, loop)
        batch = stage, worlds, params, state
        (moved,) = trial.advance([batch], loop, round(options.window / period))
        return moved, (state, inputs, score(state, 1.0, 0.0), ~state.done)

    first = trial.start_all(worlds, params, law=loop.law)
    count = max(1, round(float(rules.horizon) / options.window))
    last, (states, inputs, scores, live) = jax.lax.scan(proceed, first, length=count)
    rest = score(last, 1.0 * last.success, jnp.minimum(last.min_distance, _FAR)) - scores
    table = jnp.concatenate([jnp.ones_like(rest)[..., None], inputs, rest[..., None]], axis=-1)
    return states, table, live, last.steps * period


def _differentiate(
    options: TuneGrad, vector: Array, coefficients: Array, stage: Stage, worlds: World,
    trials: Trial, at: Array,
) -> Array:  # fmt: skip
    """Return the derivatives (m, p) of the scores of windows from the states `at` (m, 2)."""
    setting, objective = options.setting, options.objective
    # A law without a smooth form has the derivatives between its switches.
    smooth = registry.law_of(options.params).temperatures is not None
    loop = control_loop(options.params, setting, smooth=smooth)
    period, rules = setting.physics.control_period, setting.rules
    worlds, states = rows(worlds, at[:, 1]), rows(trials, (at[:, 0], at[:, 1]))
    thetas = gradients.per_world(vector, at)
    start = partial(trial.start, law=loop.law)
    fresh = jax.eval_shape(jax.vmap(start), worlds, jax.vmap(options.space.params)(thetas))
    states = jax.tree.map(lambda x, y: x.astype(y.dtype), states, fresh)

    def cost(
        snapshots: Snapshot, world: World, params: LawParams, first: Trial, last: Trial
    ) -> Array:
        weights = first.contact_steps > 0, 1 - snapshots.done
        under_way, lost = soft_times(snapshots, params.d_success, *weights)
        rest = jnp.dot(coefficients[1:], features(world, params, last, loop)) + coefficients[0]
        times = period * (first.steps + jnp.sum(under_way)), period * (first.lost_steps + lost)
        whole = objective.score(1.0, *times, 0.0, rules)
        return jnp.asarray(whole + under_way[-1] * jnp.where(last.done, 1.0 - last.success, rest))

    def total(thetas: Array) -> Array:
        params = jax.vmap(options.space.params)(thetas)
        steps = max(1, round(options.window / period))
        last, snapshots = trial.unroll(stage, worlds, params, states, loop, steps, native.mapped)
        scores = jax.vmap(cost, (1, 0, 0, 0, 0))(snapshots, worlds, params, states, last)
        return jnp.sum(scores)

    return jax.grad(total)(thetas)


# --- the value function --------------------------------------------------------------------

_FAR = 5.0  # [m] beyond which distances count equally
_NUM_FEATURES = 6
_REMEMBERED = 0.75  # [1] weight of former trials at each refresh


def features(world: World, params: LawParams, state: Trial, loop: ControlLoop) -> Array:
    """Return the physical features (F,) of a state, which are equal for mirrored worlds.

    The first is whether there is contact. The others are of the distance from contact to target,
    and of the bearing of the target from there in the robot frame.

    The offset of the contact and the pose of the object are none. They predict failures best, but
    with them the derivatives point against the slopes of whole trials. Probably they stand for the
    friction and the centre of mass of a world, which no law can change.
    """
    _, measured = trial.observe(world, params, state, loop)
    distance = _FAR * jnp.tanh(measured.distance / _FAR)
    contact, point = 1.0 * measured.reading.in_contact, measured.reading.p_robot_contact
    point = jnp.where(contact > 0, jnp.nan_to_num(point), 0.0)
    target = measured.observation.p_world_target
    way = planar.rotate(-state.qpos[JOINTS.base_yaw], target - trial.contact_of(state.qpos, point))
    cosine, sine = way / jnp.maximum(planar.norm(way), 1e-3)
    turned = 1 - cosine
    return jnp.stack([contact, distance, turned, distance**2, distance * turned, sine**2])


def fit(moments: np.ndarray, ridge: float = 1.0) -> np.ndarray:
    """Return the coefficients (F + 1,) of ridge regression, that of the constant first.

    `moments` are sums of products of 1, the features and the value. The weight `ridge` is that of
    standardised features; that of the constant is 0.
    """
    gram, product = moments[:-1, :-1], moments[:-1, -1]
    variance = np.diag(gram) / gram[0, 0] - (gram[0] / gram[0, 0]) ** 2
    weights = ridge * np.maximum(variance, 1e-9)
    weights[0] = 0.0
    return np.linalg.lstsq(gram + np.diag(weights), product, rcond=None)[0]
