"""Tuning the law by gradients: of a softened trial, of randomised smoothing, or of both.

The objective is that of `tune`. What is differentiated is a window of a softened trial: smooth law
and skin, and a base that has arrived by a weight instead of by a switch; what is left of the way
after it counts as the time of driving there. What is validated, in the course's engine, is the hard
law under the paper's rules.
"""

from __future__ import annotations

import functools
import time
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
import optax

from rps_jax import errors
from rps_jax.control import switches
from rps_jax.control.law import RPSParams
from rps_jax.control.strategies import Params, smooth_of
from rps_jax.robot.skin import CapacitiveSkin, SmoothSkin
from rps_jax.runs import evaluate
from rps_jax.runs.objective import Objective
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Snapshot, Trial, World, control_step, start_all
from rps_jax.tuning import gradients
from rps_jax.tuning.gradients import Estimate
from rps_jax.tuning.run import Course, Told, TryOut, finite
from rps_jax.tuning.space import Space
from rps_jax.world.physics import preset

Estimator = Literal["reverse", "forward", "evolution", "combined"]
_ENGINE = {"reverse": "quasistatic", "forward": "fused", "combined": "quasistatic"}


@dataclass(frozen=True)
class Descent:
    """How gradients are followed."""

    estimator: Estimator = "reverse"
    """reverse differentiates windows through the quasi-static model, forward through the fused
    engine; evolution takes antithetic steps in whole trials of the course's engine; combined weighs
    reverse and evolution by their variances, of which that of the windows is mostly much the
    smaller, as if they were independent."""
    optimiser: str = "adam"
    """Name of an optimiser of optax that needs gradients alone."""
    learning_rate: float = 0.1
    """[1] Learning rate of the first step, which falls to zero along a cosine."""
    clip: float = 1.0
    """[1] Bound on the norm of a gradient."""
    world_clip: float = 2.0
    """[1] Bound on the norm of a single world's gradient, for reverse and forward, as a multiple of
    their median; a few chaotic worlds would outweigh all others."""
    steps: int = 40
    """Number of steps of each descent."""
    starts: int = 4
    """Number of descents side by side: one from the base parameters, others from random places
    near them."""
    spread: float = 0.5
    """[1] Standard deviation of these places, in units of the bounded map."""
    window: float = 8.0
    """[s] Length of a window of a softened trial, for reverse and forward."""
    within: float = 100.0
    """[s] Windows begin at random times up to this; with 0 they begin with the trials."""
    arrive: float = 0.005
    """[m] Temperature at which a softened trial arrives."""
    sigma: float = 0.15
    """[1] Standard deviation of the antithetic steps."""
    pairs: int = 8
    """Number of antithetic pairs for each descent."""
    budget: float = 0.0
    """[s] Simulated time after which no step begins; 0 stands for no bound."""
    seed: int = 0
    """Seed of the starts, the steps and the worlds."""

    def __post_init__(self) -> None:
        """Raises InputError for unknown names or numbers that mean nothing."""
        errors.check_name("estimator", self.estimator, get_args(Estimator))
        for name in ("learning_rate", "clip", "world_clip", "window", "arrive", "sigma"):
            errors.check_finite(name, getattr(self, name), above=0)
        for name in ("steps", "starts", "pairs"):
            errors.check_finite(name, getattr(self, name), at_least=1, at_most=1e6)
        for name in ("within", "budget"):
            errors.check_finite(name, getattr(self, name), at_least=0, unit="s")
        errors.check_finite("spread", self.spread, at_least=0, at_most=10)
        try:  # as `descend` will
            one = jax.ShapeDtypeStruct((1,), float)
            jax.eval_shape(lambda x: self.rule().update(x, self.rule().init(x), x), one)
        except (AttributeError, TypeError, ValueError) as error:
            raise errors.InputError(
                f"optimiser = {self.optimiser} is not allowed: name one of optax that needs "
                "gradients alone, as adam or sgd."
            ) from error
        errors.check_finite("seed", self.seed, at_least=0, at_most=2**30)

    def rule(self) -> optax.GradientTransformation:
        """The rule of optax by which parameters follow their gradients."""
        rate = optax.cosine_decay_schedule(self.learning_rate, self.steps)
        return optax.chain(
            optax.clip_by_global_norm(self.clip), getattr(optax, self.optimiser)(rate)
        )


def soft_score(
    seen: Snapshot, params: Params, setting: Setting, objective: Objective, arrive: float
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


class Batch(NamedTuple):
    """Softened worlds of one shape family."""

    stage: Any
    worlds: World  # (n, ...), with smooth skins
    late: jax.Array  # (n,) [1] when a window begins, as a share of the latest time


def softened(course: Course, engine: Any, seed: int, step: int) -> list[Batch]:
    """The worlds of one step of a course as smooth ones, by domain and object."""
    setting = replace(course.setting, engine=engine)
    ask = course.ask(jax.tree.map(lambda x: np.array([x]), RPSParams()), seed, step)
    random = np.random.default_rng((seed, step))
    return [
        Batch(part.stage, soften(part.worlds), jnp.asarray(random.uniform(size=column.size)))
        for part, column, _ in evaluate.parts(ask, course.domains, setting)
    ]


def soften(worlds: World) -> World:
    """The same worlds (n, ...) with smooth skins."""
    sensor: Any = worlds.skin
    warm = 0.03 if isinstance(sensor, CapacitiveSkin) else 0.001
    return worlds._replace(skin=SmoothSkin(sensor, jnp.full(len(worlds.key), warm)))


def scores_of(space: Space, course: Course, descent: Descent, stage: Any) -> gradients.Scores:
    """Scores of windows of softened trials, as `gradients` takes them.

    A world is a pair (World, share of `within` after which its window begins). What leads to that
    is driven by the same parameters, and not differentiated.
    """
    strategy = smooth_of(space.base)
    setting, physics = course.setting, preset(fidelity="fast")

    def cost(seen: Snapshot) -> jax.Array:
        return soft_score(seen, space.base, setting, course.objective, descent.arrive)

    def steps(seconds: float) -> int:
        return round(seconds / setting.physics.control_period)

    score = gradients.window(
        stage,
        space.params,
        cost,
        physics=physics,
        strategy=strategy,
        steps=max(1, steps(descent.window)),
    )

    def begun(thetas: jax.Array, worlds: World, late: jax.Array) -> Trial:
        worlds = worlds._replace(params=jax.vmap(space.params)(thetas))
        first = start_all(worlds, jnp.ones(len(late), bool), strategy=strategy)
        if not descent.within:
            return first

        def one(i: jax.Array, trials: Trial) -> Trial:
            after, _ = control_step(stage, worlds, trials, physics=physics, strategy=strategy)
            return jax.vmap(switches.select)(i < late * steps(descent.within), after, trials)

        return jax.lax.fori_loop(0, steps(descent.within), one, first)

    def scores(thetas: jax.Array, worlds: tuple[World, jax.Array]) -> jax.Array:
        begin = begun(jax.lax.stop_gradient(thetas), *worlds)
        return score(thetas, (worlds[0], jax.lax.stop_gradient(begin)))

    return scores


@functools.partial(jax.jit, static_argnames=("space", "course", "descent"))
def _differentiated(
    thetas: jax.Array, batch: Batch, *, space: Space, course: Course, descent: Descent
) -> Estimate:
    """Estimates (S, p) at thetas (S, p), each from all the worlds of a batch."""
    scores = scores_of(space, course, descent, batch.stage)
    mode = gradients.forward if descent.estimator == "forward" else gradients.reverse
    worlds = (batch.worlds, batch.late)
    return jax.vmap(lambda theta: mode(scores, theta, worlds, clip=descent.world_clip))(thetas)


def differentiated(
    thetas: jax.Array, space: Space, course: Course, descent: Descent, step: int
) -> tuple[Estimate, float]:
    """Estimates (S, p) through windows of one step's softened trials, and the time simulated [s].

    Counted is what leads to a window, too, but not that worlds wait there for the latest to begin.
    """
    batches = softened(course, _ENGINE[descent.estimator], descent.seed, step)
    found = [
        (_differentiated(thetas, b, space=space, course=course, descent=descent), len(b.worlds.key))
        for b in batches
    ]
    total = sum(n for _, n in found)
    return Estimate(
        sum(e.gradient * (n / total) for e, n in found),  # type: ignore[arg-type]
        sum(e.variance * (n / total) ** 2 for e, n in found),  # type: ignore[arg-type]
        sum(e.finite * (n / total) for e, n in found),  # type: ignore[arg-type]
    ), len(thetas) * total * (descent.window + descent.within / 2)


def smoothed(
    thetas: jax.Array, space: Space, course: Course, descent: Descent, step: int, try_out: TryOut
) -> Estimate:
    """Evolution gradients (S, p) of the hard law, of antithetic candidates in the same worlds."""
    key = jax.random.fold_in(jax.random.key(descent.seed), step)
    count, p = thetas.shape
    steps = jax.random.normal(key, (count, descent.pairs, p), thetas.dtype)
    both = jnp.concatenate([steps, -steps], axis=1) * descent.sigma
    params = space.params((thetas[:, None] + both).reshape(-1, p))
    (answer,) = try_out([course.ask(params, descent.seed, step)])
    values = course.objective.value(answer.score).reshape(count, 2, descent.pairs)
    slopes = (values[:, 0] - values[:, 1])[..., None] * steps / (2 * descent.sigma)
    return jax.vmap(gradients.estimate)(slopes)


# --- the descent ---------------------------------------------------------------------------


class Search:
    """Descents under way, all together: a tuner that `rps_jax.tuning.run` drives.

    Before every step all descents are tried in the worlds for validation.
    """

    def __init__(self, descent: Descent, space: Space, course: Course):
        """Begin nothing yet.

        Raises:
          InputError: the law has no smooth form, and its derivatives are asked for.
        """
        if descent.estimator != "evolution":
            smooth_of(space.base)
        self.descent, self.space, self.course = descent, space, course
        self.options = {"descent": asdict(replace(descent, budget=0.0))}
        self.generations, self.budget = descent.steps + 1, descent.budget

    def begin(self) -> None:
        """Begin at the base parameters of the space, and at random places near them."""
        descent, base = self.descent, self.space.vector(self.space.base)
        key = jax.random.key(descent.seed)
        away = jax.random.normal(key, (descent.starts, base.size), base.dtype).at[0].set(0.0)
        self.thetas = base + descent.spread * away  # (S, p)
        self.best, self.best_value = np.asarray(base), np.inf
        self._base_value: float | None = None  # of the base parameters in the worlds for validation
        self._rule = descent.rule()
        self._state = jax.vmap(self._rule.init)(self.thetas)

    def propose(self) -> np.ndarray:
        """Where the descents (S, p) are."""
        return np.asarray(self.thetas)

    def judge(self, vectors: np.ndarray, generation: int, try_out: TryOut) -> tuple[Told, Any]:
        """Values (S,) in the worlds for validation, and, except after the last step, gradients."""
        check = self.course.validate(self.space.params(vectors), self.descent.seed)
        (tried,) = try_out([check])
        values = self.course.objective.value(tried.score)
        first = int(jnp.nanargmin(values))
        base = self._base_value if generation else float(values[0])
        told = {"validation": np.asarray(values)}
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
            return told, line
        found, more = self._estimated(jnp.asarray(vectors), generation, try_out)
        told["gradient"] = np.asarray(found.gradient)
        return told, line | more | {
            "gradient": finite(jnp.linalg.norm(found.gradient, axis=1).mean()),
            "gradient_error": finite(jnp.sqrt(jnp.sum(found.variance, axis=1)).mean()),
            "finite": float(found.finite.mean()),
        }

    def _estimated(
        self, thetas: jax.Array, step: int, try_out: TryOut
    ) -> tuple[Estimate, dict[str, float]]:
        """Estimates (S, p), and the times simulated and taken [s] by windows."""
        how = self.space, self.course, self.descent, step
        if self.descent.estimator == "evolution":
            return smoothed(thetas, *how, try_out), {"simulated": 0.0, "differentiate": 0.0}
        began = time.perf_counter()
        found, seconds = jax.block_until_ready(differentiated(thetas, *how))
        more = {"simulated": seconds, "differentiate": time.perf_counter() - began}
        if self.descent.estimator == "combined":
            found = jax.vmap(gradients.combine)(found, smoothed(thetas, *how, try_out))
        return found, more

    def learn(self, vectors: np.ndarray, told: Told) -> None:
        """Follow the gradients by one step."""
        values = told["validation"]
        first = int(jnp.nanargmin(values))
        if self._base_value is None:
            self._base_value = float(values[0])
        if values[first] < self.best_value:
            self.best, self.best_value = vectors[first], float(values[first])
        if "gradient" in told:
            thetas = jnp.asarray(vectors)
            gradient = jnp.asarray(told["gradient"])
            changes, self._state = jax.vmap(self._rule.update)(gradient, self._state, thetas)
            self.thetas = jnp.asarray(optax.apply_updates(thetas, changes))
