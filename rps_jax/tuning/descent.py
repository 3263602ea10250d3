"""Tuning a law by gradients: of a softened trial, of randomised smoothing, or of both.

What is differentiated is a window of a softened trial: smooth law and skin, and a base that has
arrived by a weight instead of by a switch; what is left of the way after it counts as the time of
driving there. What is validated, in the setting's engine, is the hard law under the paper's rules.
"""

from __future__ import annotations

import functools
import time
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from rps_jax import errors
from rps_jax.control import registry, soft
from rps_jax.control.base import LawParams
from rps_jax.record.options import option
from rps_jax.robot.skin import CapacitiveSkin, SmoothSkin
from rps_jax.runs.question import call_of
from rps_jax.trials import rollout
from rps_jax.trials.score import Objective
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Snapshot, Trial, World, control_step, start_all
from rps_jax.tuning import gradients
from rps_jax.tuning.gradients import Estimate
from rps_jax.tuning.run import Metrics, Problem, ScoreCandidates, Tuning, finite
from rps_jax.tuning.space import Space
from rps_jax.world.physics import preset

Estimator = Literal["reverse", "evolution"]


@dataclass(frozen=True)
class TuneGrad(Tuning):
    """Tune a law's parameters by gradients, in many worlds.

    The answer is like that of `TuneES`, a step being a generation.

    Example:
      >>> import rps_jax
      >>> drums = {"objects": ("random_cylinder",), "tuned": ("K_h",)}
      >>> brief = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=2.0))
      >>> small = {"worlds": 2, "validation": 2, "steps": 1, "starts": 1, "pairs": 1}
      >>> found = rps_jax.tune_grad("rps", **drums, **small, estimator="evolution", setting=brief)
      >>> dict(found.params.sizes)
      {'generation': 2, 'parameter': 1}
    """

    QUICK: ClassVar[dict[str, Any]] = Tuning.QUICK | {
        "steps": 8, "starts": 1, "learning_rate": 0.3,
    }  # fmt: skip

    worlds: int = option(64, 1, 10_000_000)
    """Number of worlds of a step, in each domain; every step has its own."""
    validation: int = option(128, 1, 10_000_000)
    estimator: Estimator = "reverse"
    """reverse differentiates windows of trials on the quasi-static model; evolution takes
    antithetic steps in whole trials of the setting's engine."""
    optimiser: str = "adam"
    """Name of an optimiser of optax that needs gradients alone."""
    learning_rate: float = option(0.1, above=0)
    """Learning rate of the first step, in units of the bounded map [1]; it falls to zero along a
    cosine."""
    clip: float = option(1.0, above=0)
    """Bound on the norm of a gradient [1]."""
    world_clip: float = option(2.0, above=0)
    """Bound on the norm of a single world's gradient, for reverse, as a multiple of
    their median [1]; a few chaotic worlds would outweigh all others."""
    steps: int = option(40, 1, 1_000_000)
    """Number of steps of each descent."""
    starts: int = option(4, 1, 1_000_000)
    """Number of descents side by side: one from the start itself, others from random places near
    it."""
    spread: float = option(0.5, 0, 10)
    """Standard deviation of these places, in units of the bounded map [1]."""
    window: float = option(8.0, above=0, unit="s")
    """Length of a window of a softened trial, for reverse [s]."""
    within: float = option(100.0, 0, unit="s")
    """Windows begin at random times up to this; with 0 they begin with the trials [s]."""
    arrive: float = option(0.005, above=0, unit="m")
    """Temperature at which a softened trial arrives [m]."""
    sigma: float = option(0.15, above=0)
    """Standard deviation of the antithetic steps [1]."""
    pairs: int = option(8, 1, 1_000_000)
    """Number of antithetic pairs for each descent."""

    def check(self) -> None:
        """Check the optimiser, too."""
        super().check()
        try:  # as the descent will
            one = jax.ShapeDtypeStruct((1,), float)
            jax.eval_shape(lambda x: self.rule().update(x, self.rule().init(x), x), one)
        except (AttributeError, TypeError, ValueError) as error:
            raise errors.InputError(
                f"optimiser = {self.optimiser} is not allowed: name one of optax that needs "
                "gradients alone, as adam or sgd."
            ) from error

    @functools.cached_property
    def tuner(self) -> DescentState:
        return DescentState(self)

    @property
    def how(self) -> Windows:
        """Which windows are differentiated, and how."""
        own = self.world_clip, self.window, self.within, self.arrive
        return Windows(self.space, self.problem, *own)

    def rule(self) -> optax.GradientTransformation:
        """The rule of optax by which parameters follow their gradients."""
        rate = optax.cosine_decay_schedule(self.learning_rate, self.steps)
        return optax.chain(
            optax.clip_by_global_norm(self.clip), getattr(optax, self.optimiser)(rate)
        )


tune_grad = call_of(TuneGrad)


def soft_score(
    seen: Snapshot, params: LawParams, setting: Setting, objective: Objective, arrive: float
) -> jax.Array:
    """The objective's score () of a softened window's snapshots (T, ...), differentiable.

    At each step the base arrives by a weight, in contact and nearer than d_success within the
    temperature `arrive` [m]; what comes after counts only as far as it has not arrived before. So
    far as it never arrives, the distance that is left costs the time of driving it at v_max: no
    window is long enough to tell a failure.
    """
    period = setting.physics.control_period
    contact, distance = seen.reading.in_contact, seen.details.distance
    arriving = contact * jax.nn.sigmoid((params.d_success - distance) / arrive)
    under_way = jnp.cumprod(1 - arriving)
    touched = jax.lax.cummax(contact)
    return objective.score(
        1.0,
        period * jnp.sum(under_way) + under_way[-1] * distance[-1] / params.v_max,
        period * jnp.sum(under_way * touched * (1 - contact)),
        0.0,
        setting.rules,
    )


class Windows(NamedTuple):
    """Which windows of softened trials are differentiated, and how; static."""

    space: Space
    problem: Problem
    world_clip: float  # [1]
    window: float  # [s]
    within: float  # [s]
    arrive: float  # [m]


def soften(worlds: World) -> World:
    """Give worlds (n, ...) smooth skins."""
    sensor: Any = worlds.skin
    warm = 0.03 if isinstance(sensor, CapacitiveSkin) else 0.001
    return worlds._replace(skin=SmoothSkin(sensor, jnp.full(len(worlds.key), warm)))


def scores_of(how: Windows, stage: Any) -> gradients.Scores:
    """Scores of windows of softened trials, as `gradients` takes them.

    A world is a pair (World, share of `within` after which its window begins). What leads to that
    is driven by the same parameters, and not differentiated.
    """
    space, problem = how.space, how.problem
    law = registry.smooth_law(registry.law_of(space.base))
    setting, loop = problem.setting, ControlLoop(preset(fidelity="fast"), law=law)

    def cost(seen: Snapshot) -> jax.Array:
        return soft_score(seen, space.base, setting, problem.objective, how.arrive)

    def steps(seconds: float) -> int:
        return round(seconds / setting.physics.control_period)

    score = gradients.window(stage, space.params, cost, loop, max(1, steps(how.window)))

    def begun(thetas: jax.Array, worlds: World, late: jax.Array) -> Trial:
        params = jax.vmap(space.params)(thetas)
        first = start_all(worlds, params, jnp.ones(len(late), bool), law=law)
        if not how.within:
            return first

        def one(i: jax.Array, trials: Trial) -> Trial:
            after, _ = control_step(stage, worlds, params, trials, loop)
            return jax.vmap(soft.tree_where)(i < late * steps(how.within), after, trials)

        return jax.lax.fori_loop(0, steps(how.within), one, first)

    def scores(thetas: jax.Array, worlds: tuple[World, jax.Array]) -> jax.Array:
        begin = begun(jax.lax.stop_gradient(thetas), *worlds)
        return score(thetas, (worlds[0], jax.lax.stop_gradient(begin)))

    return scores


@functools.partial(jax.jit, static_argnames="how")
def _differentiated(
    thetas: jax.Array, stage: Any, worlds: tuple[World, jax.Array], *, how: Windows
) -> Estimate:
    """Estimates (S, p) at thetas (S, p), each from all the worlds (n, ...) of one shape family."""
    scores = scores_of(how, stage)
    return jax.vmap(lambda theta: gradients.reverse(scores, theta, worlds, clip=how.world_clip))(
        thetas
    )


def differentiated(thetas: jax.Array, how: Windows, seed: int, step: int) -> tuple[Estimate, float]:
    """Estimates (S, p) through windows of one step's softened trials, and the time simulated [s].

    Counted is what leads to a window, too, but not that worlds wait there for the latest to begin.
    """
    problem, found = how.problem, []
    setting = replace(problem.setting, engine="quasistatic")
    ask = problem.ask(how.space.base, seed, step)
    random = np.random.default_rng((seed, step))
    for part, column, _ in rollout.world_batches(ask, problem.domains, setting):
        worlds = soften(part.worlds), jnp.asarray(random.uniform(size=column.size))
        found.append((_differentiated(thetas, part.stage, worlds, how=how), column.size))
    total = sum(n for _, n in found)
    return Estimate(
        sum(e.gradient * (n / total) for e, n in found),  # type: ignore[arg-type]
        sum(e.variance * (n / total) ** 2 for e, n in found),  # type: ignore[arg-type]
        sum(e.finite * (n / total) for e, n in found),  # type: ignore[arg-type]
    ), len(thetas) * total * (how.window + how.within / 2)


def smoothed(
    thetas: jax.Array, descent: TuneGrad, step: int, score_candidates: ScoreCandidates
) -> Estimate:
    """Evolution gradients (S, p) of the hard law, of antithetic candidates in the same worlds."""
    problem = descent.problem
    key = jax.random.fold_in(jax.random.key(descent.setting.seed), step)
    count, p = thetas.shape
    steps = jax.random.normal(key, (count, descent.pairs, p), thetas.dtype)
    both = jnp.concatenate([steps, -steps], axis=1) * descent.sigma
    params = descent.space.params((thetas[:, None] + both).reshape(-1, p))
    (answer,) = score_candidates([problem.ask(params, descent.setting.seed, step)])
    values = problem.objective.value(answer.score).reshape(count, 2, descent.pairs)
    slopes = (values[:, 0] - values[:, 1])[..., None] * steps / (2 * descent.sigma)
    return jax.vmap(gradients.estimate)(slopes)


# --- the descent ---------------------------------------------------------------------------


class DescentState:
    """Descents under way, all together.

    Before every step all descents are tried in the worlds for validation.
    """

    def __init__(self, descent: TuneGrad):
        """Begin nothing yet; InputError if the law has no derivatives that are asked for."""
        self.descent, self.space, self.problem = descent, descent.space, descent.problem
        if descent.estimator != "evolution":
            registry.smooth_law(registry.law_of(self.space.base))
        self.generations, self.budget = descent.steps + 1, descent.budget

    def begin(self) -> None:
        """Begin at the base parameters of the space, and at random places near them."""
        descent, base = self.descent, self.space.vector(self.space.base)
        key = jax.random.key(descent.setting.seed)
        away = jax.random.normal(key, (descent.starts, base.size), base.dtype).at[0].set(0.0)
        self.thetas = base + descent.spread * away  # (S, p)
        self.best, self.best_value = np.asarray(base), np.inf
        self._base_value: float | None = None  # of the base parameters in the worlds for validation
        self._rule = descent.rule()
        self._state = jax.vmap(self._rule.init)(self.thetas)

    def propose(self) -> np.ndarray:
        """Where the descents (S, p) are."""
        return np.asarray(self.thetas)

    def shapes(self, vectors: np.ndarray, generation: int) -> dict[str, tuple[int, ...]]:
        """Shapes of the values of descents, and of their gradients but after the last step."""
        shapes = {"validation": vectors.shape[:1]}
        return shapes | ({"gradient": vectors.shape} if generation < self.descent.steps else {})

    def judge(
        self, vectors: np.ndarray, generation: int, score_candidates: ScoreCandidates
    ) -> tuple[Metrics, Any]:
        """Values (S,) in the worlds for validation, and, except after the last step, gradients."""
        check = self.problem.validate(self.space.params(vectors), self.descent.setting.seed)
        (tried,) = score_candidates([check])
        values = self.problem.objective.value(tried.score)
        first = int(jnp.nanargmin(values))
        base = self._base_value if generation else float(values[0])
        metrics = {"validation": np.asarray(values)}
        line = {
            "validation": finite(values[first]),
            "validation_success": float(tried.outcome.success[first].mean()),
            "mean": finite(jnp.nanmean(values)),
            "spread": finite(jnp.nanstd(values)),
            "best": finite(values[first]),
            "base": finite(base),
            "params": self.space.named(vectors[first]),
        }
        if generation == self.descent.steps:
            return metrics, line
        found, more = self._estimated(jnp.asarray(vectors), generation, score_candidates)
        metrics["gradient"] = np.asarray(found.gradient)
        return metrics, line | more | {
            "gradient": finite(jnp.linalg.norm(found.gradient, axis=1).mean()),
            "gradient_error": finite(jnp.sqrt(jnp.sum(found.variance, axis=1)).mean()),
            "finite": float(found.finite.mean()),
        }

    def _estimated(
        self, thetas: jax.Array, step: int, score_candidates: ScoreCandidates
    ) -> tuple[Estimate, dict[str, float]]:
        """Estimates (S, p), and the times simulated and taken [s] by windows."""
        descent = self.descent
        if descent.estimator == "evolution":
            return smoothed(thetas, descent, step, score_candidates), {
                "simulated": 0.0,
                "differentiate": 0.0,
            }
        began = time.perf_counter()
        found, seconds = jax.block_until_ready(
            differentiated(thetas, descent.how, descent.setting.seed, step)
        )
        return found, {"simulated": seconds, "differentiate": time.perf_counter() - began}

    def update(self, vectors: np.ndarray, metrics: Metrics) -> None:
        """Follow the gradients by one step."""
        values = metrics["validation"]
        first = int(jnp.nanargmin(values))
        if self._base_value is None:
            self._base_value = float(values[0])
        if values[first] < self.best_value:
            self.best, self.best_value = vectors[first], float(values[first])
        if "gradient" in metrics:
            thetas = jnp.asarray(vectors)
            gradient = jnp.asarray(metrics["gradient"])
            changes, self._state = jax.vmap(self._rule.update)(gradient, self._state, thetas)
            self.thetas = jnp.asarray(optax.apply_updates(thetas, changes))
