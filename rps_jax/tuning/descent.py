"""Tune a law by exact derivatives of windows of trials, with an optimiser of optax.

Whole pushes are chaotic, and a push that fails has no derivative that says so. So the derivatives
are of windows of some seconds under the smooth law and skin. Windows start at states of trials of
the original law. A linear value function of their last states, fitted to the rest of these trials
with their failures, says what a window is worth. `TuneGrad` runs trials of the original law every
few steps: for new states, for the value function, to validate, and to compare the derivatives with
slopes of whole trials. Windows stall after some steps, and slopes then replace them.

References: Xu et al., "Accelerated policy learning with parallel differentiable simulation", ICLR
2022 (windows with a value function); Suh et al., "Do differentiable simulators give better policy
gradients?", ICML 2022 (why derivatives of long, stiff trials mislead).
"""

from __future__ import annotations

import functools
import itertools
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.control import registry
from rps_jax.control.base import Law, LawParams
from rps_jax.engines import native
from rps_jax.engines.base import Stage
from rps_jax.geometry import planar
from rps_jax.record.options import option
from rps_jax.runs.question import call_of
from rps_jax.trials import trial
from rps_jax.trials.jobs import rows
from rps_jax.trials.trial import ControlLoop, Snapshot, Trial, World
from rps_jax.trials.worlds import soften_skins
from rps_jax.tuning import gradients
from rps_jax.tuning.derivatives import soft_times
from rps_jax.tuning.evolution import Descent, gradient_results
from rps_jax.tuning.gradients import Estimate
from rps_jax.tuning.optimisers import OptimiserLike, optimiser
from rps_jax.tuning.run import Proposal, Results, ScoreCandidates, Search, Tuning

_DERIVATIVE_COST = 4.0  # [1] simulated seconds for which a differentiated second counts


@dataclass(frozen=True)
class TuneGrad(Descent):
    """Tune a law by exact derivatives of the smooth trial, in mini-batches of random worlds.

    A step follows the derivatives of windows of some seconds, which start at states of trials of
    the original law; a value function, fitted to these trials, counts what follows a window. After
    `window_steps` steps, or once the derivatives do not agree with slopes of whole trials, a step
    follows these slopes, as `rps tune es --estimator antithetic` does. The generation with the best
    validation in trials of the original law is the answer.

    The answer is that of `TuneES`, with a step as a generation. Its `cosine` (generation) is that
    of the derivatives and the slopes; `windows` (generation) is 1 for steps by derivatives. Steps
    without a validation have NaN there. A differentiated second counts as four simulated ones.

    The defaults are those of a study with 6 to 2,048 parameters. With windows of 1, 2 and 5 s the
    cosine of the derivatives with the true slope was 0.01, 0.40 and 0.64. A network as value, or
    the distance that is left, had negative ones.

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

    QUICK = Tuning.QUICK | {
        "worlds": 64, "steps": 8, "learning_rate": 0.3, "windows": 64, "trials": 32,
        "window_steps": 4,
    }  # fmt: skip

    MOVED: ClassVar = dict.fromkeys(
        ("--starts", "--spread"),
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
    schedule: str = "cosine_decay"
    """Schedule of the learning rate, of optax: constant, cosine_decay, exponential_decay, linear,
    polynomial, warmup_cosine_decay, ... over all steps."""
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
    checks: int = option(32, 1, 1_000_000)
    """Number of worlds of the slopes that are compared with the derivatives, in each domain."""
    clip: float = option(2.0, above=0)
    """Bound on the norm of the derivatives of one window, as a multiple of the median norm [1];
    without it a few chaotic windows dominate."""
    ridge: float = option(1.0, 0)
    """Weight of the squared coefficients of the value function, of standardised features [1]."""
    history: int = option(4, 1, 1000)
    """Number of the last batches of trials to which the value function is fitted."""
    taxels: float = option(0.03, above=0, at_most=1)
    """Temperature of the taxels of a smooth skin [1]."""

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

    def _field_as_json(self, name: str) -> object:
        is_custom = name == "optimiser" and not isinstance(self.optimiser, str)
        return "custom" if is_custom else super()._field_as_json(name)

    def _optimiser(self) -> Any:
        return optimiser(self.optimiser, self.schedule, self.learning_rate, self.steps)

    def search(self) -> Search:
        """Search by steps of the optimiser, first by derivatives of windows and then by slopes.

        If the steps by derivatives end at a worse validation than an earlier one, the search goes
        back to the best vector.
        """
        step, start = self._optimiser(), jnp.asarray(self.base)
        vector, state, base = self.base, step.init(start), np.array(np.nan)
        best, least, cosines = vector, np.inf, list[float]()
        uses_windows, anchor, size = self.window_steps > 0, 0, len(FEATURES) + 2
        moments, coefficients, anchored = list[np.ndarray](), np.zeros(size - 1), vector
        for generation in itertools.count():
            returns = uses_windows and generation == self.window_steps
            uses_windows &= not returns
            if uses_windows and (generation - anchor) % self.refresh == 0:
                anchor, anchored = generation, vector
            results = yield {
                "vectors": vector[None],
                "base": base,
                "windows": np.array(float(uses_windows)),
                "anchor": np.array(float(anchor)),
                "anchors": anchored[None],
                "moments": sum(moments, np.zeros((size, size))),
                "coefficients": coefficients,
            }
            base, vector, value = results["base"], results["vectors"][0], results["validation"]
            slopes = results["gradients"][0]
            if uses_windows and generation == anchor:
                moments = [*moments, results["new_moments"]][1 - self.history :]
                moments = moments if self.history > 1 else []
                coefficients, anchored = results["coefficients"], results["anchors"][0]
                cosines.append(float(results["cosine"]))
                if not np.mean(cosines) > 0:
                    uses_windows, slopes = False, results["slopes"][0]
            if value < least:
                best, least = vector, float(value)
            elif returns and value > least:
                vector = best
                continue
            finite = jnp.nan_to_num(jnp.asarray(slopes), posinf=0.0, neginf=0.0)
            value = jnp.nan_to_num(jnp.asarray(value), nan=least)
            change, state = step.update(
                finite, state, jnp.asarray(vector), value=value, grad=finite
            )
            vector = vector + np.asarray(change)

    def judge(self, proposal: Proposal, generation: int, score: ScoreCandidates) -> Results:
        """Validate and estimate slopes; or differentiate windows, with both every few steps."""
        vector, size = jnp.asarray(proposal["vectors"][0]), len(FEATURES) + 2
        nothing: Results = {
            "cosine": np.nan,
            "slopes": 0 * proposal["vectors"] + np.nan,
            "new_moments": np.zeros((size, size)),
        }
        if not proposal["windows"] or generation == self.steps:
            worlds = self.worlds if generation < self.steps else 0
            results, slopes = self.try_step(proposal, generation, score, worlds)
            return {**nothing, **results, **gradient_results(slopes)}
        times: dict[str, float] = dict.fromkeys(("compile", "run", "simulated"), 0.0)
        anchor = int(proposal["anchor"])
        states = self._states(anchor, jnp.asarray(proposal["anchors"][0]), times)
        coefficients, extra = proposal["coefficients"], dict[str, Any]()
        if anchor == generation:
            new = sum(x.moments for x in states)
            coefficients = fit(proposal["moments"] + new, self.ridge)
            extra = {"new_moments": new, "coefficients": coefficients}
        estimate = self._derivatives(vector, states, coefficients, generation, times)
        times["simulated"] += _DERIVATIVE_COST * self.windows * self.window
        results: Results = self.step_results(proposal)
        if anchor == generation:
            results, slopes = self.try_step(proposal, generation, score, self.checks)
            cosine = gradients.cosine(estimate.gradient, slopes.gradient)
            extra |= {"slopes": slopes.gradient[None], "cosine": cosine}
        return {**nothing, **results, **extra, **gradient_results(estimate), **times}

    @functools.cached_property
    def _cache(self) -> dict[int, list[_States]]:
        """States of the trials of a generation."""
        return {}

    def _states(self, generation: int, vector: jax.Array, times: dict[str, float]) -> list[_States]:
        """Return states of trials of the original law with a vector (p,), by shape family."""
        if generation not in self._cache:
            self._cache.clear()
            tried = self.tried(vector[None], generation, self.trials)
            self._cache[generation] = [
                self._collect(vector, x.stage, x.worlds, times) for x in tried.batches(self.setting)
            ]
        return self._cache[generation]

    def _collect(
        self, vector: jax.Array, stage: Stage, worlds: World, times: dict[str, float]
    ) -> _States:
        soft = soften_skins(worlds, self.taxels)
        results = self._call(_run_trials, times, vector, stage, worlds, soft)
        trials, inputs, scores, live, seconds = results
        times["simulated"] += float(np.sum(seconds))
        live, contact = np.asarray(live), np.asarray(inputs)[..., _CONTACT] > 0
        columns = np.ones((*live.shape, 1)), np.asarray(inputs), np.asarray(scores)[..., None]
        data = np.concatenate(columns, axis=-1, dtype=float)[live]
        chosen = np.argwhere(live & contact) if (live & contact).any() else np.argwhere(live)
        return _States(stage, soft, trials, chosen, data.T @ data)

    def _derivatives(
        self,
        vector: jax.Array,
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
        return gradients.estimate(gradients.clip(jnp.concatenate(samples), self.clip))

    @functools.cached_property
    def _programs(self) -> dict[Hashable, Callable[..., Any]]:
        """Compiled functions of the shape families."""
        return {}

    def _call(self, function: Callable[..., Any], times: dict[str, float], *inputs: Any) -> Any:
        """Call a function of the options and some arrays; add the wall clock to `times` [s]."""
        leaves, structure = jax.tree.flatten(inputs)
        key, start_time = (function, structure, *map(jnp.shape, leaves)), time.perf_counter()
        if key not in self._programs:
            lowered = jax.jit(partial(function, self)).lower(*inputs)
            self._programs[key] = lowered.compile()
            times["compile"] += time.perf_counter() - start_time
            start_time = time.perf_counter()
        result = jax.block_until_ready(self._programs[key](*inputs))
        times["run"] += time.perf_counter() - start_time
        return result

    @property
    def smooth(self) -> Law:
        """Smooth form of the law; a law without one has the derivatives between its switches."""
        law = registry.law_of(self.params)
        return law if law.temperatures is None else registry.smooth_law(law)


tune_grad = call_of(TuneGrad)


class _States(NamedTuple):
    """States of trials of the original law in worlds of one shape family."""

    stage: Stage
    worlds: World  # (n, ...) with smooth skins
    trials: Trial  # (K, n, ...) one state of each trial per length of a window
    chosen: np.ndarray  # (m, 2) indices of the states at which windows may start
    moments: np.ndarray  # (F + 2, F + 2) sums of products of 1, features and remaining score


def _run_trials(
    options: TuneGrad, vector: jax.Array, stage: Stage, worlds: World, soft: World
) -> tuple[Trial, jax.Array, jax.Array, jax.Array, jax.Array]:
    """Run trials of the original law.

    Returns:
      Their states (K, n, ...), one per length of a window; features (K, n, F) and remaining scores
      (K, n) of these; whether the trial runs there (K, n); and the times (n,) [s] of the trials.
    """
    setting, objective, law = options.setting, options.objective, registry.law_of(options.params)
    loop = ControlLoop(setting.physics, setting.rules, law)
    period, rules = setting.physics.control_period, setting.rules
    thetas = gradients.per_world(vector, worlds)
    params = jax.vmap(options.space.params)(thetas)
    live = jnp.ones(worlds.qpos.shape[0], bool)

    def score(state: Trial, success: Any, missed: Any) -> Any:
        times = state.steps * period, state.lost_steps * period
        return objective.score(success, *times, missed, rules)

    def proceed(state: Trial, _: None) -> tuple[Trial, Any]:
        inputs = jax.vmap(features, (0, 0, 0, None))(soft, params, state, loop)
        batch = stage, worlds, params, state
        (moved,) = trial.advance([batch], loop, round(options.window / period))
        return moved, (state, inputs, score(state, 1.0, 0.0), ~state.done)

    first = trial.start_all(worlds, params, live, law=law)
    count = max(1, round(float(rules.horizon) / options.window))
    last, (states, inputs, scores, live) = jax.lax.scan(proceed, first, length=count)
    missed = jnp.where(jnp.isfinite(last.min_distance), last.min_distance, _FAR)
    whole = score(last, 1.0 * last.success, missed)
    return states, inputs, whole - scores, live, last.steps * period


def _differentiate(
    options: TuneGrad, vector: jax.Array, coefficients: jax.Array, stage: Stage, worlds: World,
    trials: Trial, at: jax.Array,
) -> jax.Array:  # fmt: skip
    """Return the derivatives (m, p) of the scores of windows from the states `at` (m, 2)."""
    setting, law, objective = options.setting, options.smooth, options.objective
    period, rules = setting.physics.control_period, setting.rules
    loop = ControlLoop(setting.physics, rules, law)
    worlds, states = rows(worlds, at[:, 1]), rows(trials, (at[:, 0], at[:, 1]))
    thetas = gradients.per_world(vector, at)
    start = partial(trial.start, law=law)
    fresh = jax.eval_shape(jax.vmap(start), worlds, jax.vmap(options.space.params)(thetas))
    states = jax.tree.map(lambda x, y: x.astype(y.dtype), states, fresh)

    def cost(
        snapshots: Snapshot, world: World, params: LawParams, first: Trial, last: Trial
    ) -> jax.Array:
        weights = first.contact_steps > 0, 1 - snapshots.done
        under_way, lost = soft_times(snapshots, params.d_success, *weights)
        rest = jnp.dot(coefficients[1:], features(world, params, last, loop)) + coefficients[0]
        times = period * (first.steps + jnp.sum(under_way)), period * (first.lost_steps + lost)
        whole = objective.score(1.0, *times, 0.0, rules)
        return jnp.asarray(whole + under_way[-1] * jnp.where(last.done, 1.0 - last.success, rest))

    def total(thetas: jax.Array) -> jax.Array:
        params = jax.vmap(options.space.params)(thetas)
        steps = max(1, round(options.window / period))
        last, snapshots = trial.unroll(stage, worlds, params, states, loop, steps, native.mapped)
        scores = jax.vmap(cost, (1, 0, 0, 0, 0))(snapshots, worlds, params, states, last)
        return jnp.sum(objective.linearise(scores))

    return jax.grad(total)(thetas)


# --- the value function --------------------------------------------------------------------

_FAR = 5.0  # [m] beyond which distances count equally
FEATURES = (
    "contact", "distance", "distance^2", "contact distance", "aside", "aside^2", "distance aside",
    "offset^2", "offset turn", "ahead", "centre^2", "centre turn", "centre offset", "speed",
    "time", "time lost",
)  # fmt: skip
_CONTACT = FEATURES.index("contact")


def features(world: World, params: LawParams, state: Trial, loop: ControlLoop) -> jax.Array:
    """Return the physical features (F,) of a state, which are equal for mirrored worlds.

    They are products of the contact's weight and offset, its distance and bearing from the target,
    the object's centre and velocity, all in the robot frame, and of the times of the trial.
    """
    _, measured = trial.observe(world, params, state, loop)
    contact, distance = 1.0 * measured.reading.in_contact, measured.distance
    distance = _FAR * jnp.tanh(distance / _FAR)
    point, yaw = measured.reading.p_robot_contact, state.qpos[2]
    point = jnp.where(contact > 0, jnp.nan_to_num(point), 0.0)
    target = measured.observation.p_world_target
    way = planar.rotate(-yaw, target - trial.contact_of(state.qpos, point))
    cosine, turn = way / jnp.maximum(planar.norm(way), 1e-3)
    position, _ = trial.object_pose(state.qpos)
    ahead, centre = planar.rotate(-yaw, position - state.qpos[:2])
    offset = contact * point[1]
    period, rules = loop.physics.control_period, loop.rules
    return jnp.stack(
        [
            contact, distance, distance**2, contact * distance,
            1 - cosine, turn**2, distance * (1 - cosine),
            offset**2, offset * turn, jnp.clip(ahead, 0.0, _FAR),
            jnp.clip(centre, -1.0, 1.0) ** 2, jnp.clip(centre, -1.0, 1.0) * turn,
            jnp.clip(centre, -1.0, 1.0) * offset, jnp.clip(state.qvel[8], -1.0, 1.0) ** 2,
            state.steps * period / rules.horizon,
            state.lost_steps * period / max(float(rules.max_lost), 1e-6),
        ]
    )  # fmt: skip


def fit(moments: np.ndarray, ridge: float) -> np.ndarray:
    """Return the coefficients (F + 1,) of ridge regression, that of the constant first.

    `moments` are sums of products of 1, the features and the value. The weight `ridge` is that of
    standardised features; that of the constant is 0.
    """
    gram, product = moments[:-1, :-1], moments[:-1, -1]
    count = max(gram[0, 0], 1.0)
    variance = np.diag(gram) / count - (gram[0] / count) ** 2
    weights = ridge * np.maximum(variance, 1e-9)
    weights[0] = 0.0
    return np.linalg.lstsq(gram + np.diag(weights), product, rcond=None)[0]
