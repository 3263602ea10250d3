"""Tuning the law by gradients: of a softened trial, of randomised smoothing, or of both.

The objective is that of `tune`. What is differentiated is a window of a softened trial: smooth law
and skin, and a base that has arrived by a weight instead of by a switch; what is left of the way
after it counts as the time of driving there. What is validated, in the course's engine, is the hard
law under the paper's rules.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from rps_jax import errors
from rps_jax.control.law import RPSParams
from rps_jax.control.strategies import smooth_rps
from rps_jax.record import files
from rps_jax.record import folder as run_folder
from rps_jax.robot.skin import CapacitiveSkin, SmoothSkin
from rps_jax.trials.setting import Progress, Setting
from rps_jax.trials.trial import Snapshot, Trial, World, control_step, select, start_all
from rps_jax.tuning import evolution as tune
from rps_jax.tuning import gradients
from rps_jax.tuning.evolution import Course, Objective, Space
from rps_jax.tuning.gradients import Estimate
from rps_jax.world.physics import preset

ESTIMATORS = ("reverse", "forward", "evolution", "combined")
_ENGINE = {"reverse": "quasistatic", "forward": "fused", "combined": "quasistatic"}


@dataclass(frozen=True)
class Descent:
    """How gradients are followed."""

    estimator: str = "reverse"
    """reverse, windows through the quasi-static model; forward, windows through the fused engine;
    evolution, antithetic steps in whole trials of the course's engine; combined, reverse and
    evolution by their variances, as if they were independent; that of the windows is mostly much
    the smaller."""
    optimiser: str = "adam"
    """An optimiser of optax, by name."""
    learning_rate: float = 0.1
    """[1] At first, falling to zero along a cosine."""
    clip: float = 1.0
    """[1] Bound on the norm of a gradient."""
    world_clip: float = 2.0
    """[1] Bound on that of a single world, of reverse and forward, as a multiple of their median: a
    few chaotic worlds would outweigh all others."""
    steps: int = 40
    """In all."""
    starts: int = 4
    """Descents side by side: one from the base parameters, others from random places near it."""
    spread: float = 0.5
    """[1] Standard deviation of these places, in units of the bounded map."""
    window: float = 8.0
    """[s] Length of a window of a softened trial, that of reverse and forward."""
    within: float = 100.0
    """[s] Windows begin at random times up to this; with 0 at the start of the trials."""
    arrive: float = 0.005
    """[m] Temperature at which a softened trial arrives."""
    sigma: float = 0.15
    """[1] Standard deviation of the steps of the evolution gradient."""
    pairs: int = 8
    """Antithetic pairs of these steps."""
    budget: float = 0.0
    """[s] Simulated time after which no step begins; 0: no bound."""
    seed: int = 0
    """Of the starts, the steps and the worlds."""

    def __post_init__(self) -> None:
        """Raises InputError for unknown names or numbers that mean nothing."""
        errors.check_name("estimator", self.estimator, ESTIMATORS)
        for name in ("learning_rate", "clip", "world_clip", "window", "arrive", "sigma"):
            errors.check_finite(name, getattr(self, name), above=0)
        for name in ("steps", "starts", "pairs"):
            errors.check_finite(name, getattr(self, name), at_least=1, at_most=1e6)
        for name in ("within", "budget"):
            errors.check_finite(name, getattr(self, name), at_least=0, unit="s")
        errors.check_finite("spread", self.spread, at_least=0, at_most=10)
        try:  # as `descend` will
            jax.eval_shape(lambda x: self.rule().update(x, self.rule().init(x), x), jnp.zeros(1))
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
    seen: Snapshot, params: RPSParams, setting: Setting, objective: Objective, arrive: float
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
        for part, column, _ in tune.parts(ask, course.domains, setting)
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
    setting, strategy, physics = course.setting, smooth_rps(), preset(fidelity="fast")

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
            return jax.vmap(select)(i < late * steps(descent.within), after, trials)

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
    thetas: jax.Array, space: Space, course: Course, descent: Descent, step: int, **shape: Any
) -> tuple[Estimate, float]:
    """Evolution gradients (S, p) of the hard law, and the time it simulated [s].

    Antithetic candidates, all of them in the same worlds.
    """
    key = jax.random.fold_in(jax.random.key(descent.seed), step)
    count, p = thetas.shape
    steps = jax.random.normal(key, (count, descent.pairs, p), thetas.dtype)
    both = jnp.concatenate([steps, -steps], axis=1) * descent.sigma
    params = space.params((thetas[:, None] + both).reshape(-1, p))
    ask = course.ask(params, descent.seed, step)
    tried = tune.try_out([ask], course.domains, course.setting, course.objective, **shape)
    (answer,), timing = tried
    values = course.objective.value(answer.score).reshape(count, 2, descent.pairs)
    slopes = (values[:, 0] - values[:, 1])[..., None] * steps / (2 * descent.sigma)
    return jax.vmap(gradients.estimate)(slopes), timing.simulated


def estimated(
    thetas: jax.Array, space: Space, course: Course, descent: Descent, step: int, **shape: Any
) -> tuple[Estimate, float]:
    """Estimates (S, p) by the estimator that the descent names, and the time simulated [s]."""
    if descent.estimator == "evolution":
        return smoothed(thetas, space, course, descent, step, **shape)
    one, seconds = differentiated(thetas, space, course, descent, step)
    if descent.estimator != "combined":
        return one, seconds
    other, more = smoothed(thetas, space, course, descent, step, **shape)
    return jax.vmap(gradients.combine)(one, other), seconds + more


# --- runs that can be continued ------------------------------------------------------------


class Search(NamedTuple):
    """The state of all descents."""

    thetas: jax.Array  # (S, p)
    rule: Any  # state of the optimiser, (S, ...)
    step: jax.Array  # () int32: how many are done
    best: jax.Array  # (p,) that validated best
    best_value: jax.Array  # ()


def begin(space: Space, descent: Descent) -> Search:
    """The state before the first step."""
    base = space.vector(space.base)
    key = jax.random.key(descent.seed)
    away = jax.random.normal(key, (descent.starts, base.size), base.dtype).at[0].set(0.0)
    thetas = base + descent.spread * away
    rule = jax.vmap(descent.rule().init)(thetas)
    return Search(thetas, rule, jnp.zeros((), jnp.int32), base, jnp.asarray(jnp.inf))


def open_run(folder: Path, space: Space, course: Course, descent: Descent) -> Path:
    """The run folder; one that holds a run must hold this one, but for its budget.

    Raises:
      InputError: it cannot be written, or holds another run.
    """
    own = asdict(replace(descent, budget=0.0))
    return run_folder.claim(folder, tune.configuration(space, course) | {"descent": own})


def descend(
    folder: Path,
    space: Space,
    course: Course,
    descent: Descent,
    *,
    report: Callable[[int, Progress], Any] = lambda step, progress: None,
    **shape: Any,
) -> RPSParams:
    """Tune by gradients, in a run folder; one that was killed goes on where it was.

    Before every step all descents are tried on the worlds for validation. Every step is a line of
    `log.jsonl`: `compile` and `run` are the trials' times [s], `differentiate` the gradients' (in
    a first step with their compilation), `simulated` all simulated time [s]. Returns what
    validated best, as `tuned.json` holds it.
    """
    search, log = tune.resume(folder, begin(space, descent), "step")
    rule = descent.rule()
    while int(search.step) <= descent.steps and not tune.spent(log, descent.budget):
        step = int(search.step)
        check = course.validate(space.params(search.thetas), descent.seed)
        (tried,), timing = tune.try_out(
            [check],
            course.domains,
            course.setting,
            course.objective,
            report=lambda progress, step=step: report(step, progress),
            **shape,
        )
        values = course.objective.value(tried.score)
        first = int(jnp.nanargmin(values))
        if float(values[first]) < float(search.best_value):
            search = search._replace(best=search.thetas[first], best_value=values[first])
        line = {
            "generation": step,
            "validation": tune.finite(values[first]),
            "validation_success": float(tried.success[first].mean()),
            "mean": tune.finite(jnp.nanmean(values)),
            "spread": tune.finite(jnp.nanstd(values)),
            "best": tune.finite(values[first]),
            "base": log[0]["base"] if log else tune.finite(values[0]),
            "simulated": timing.simulated,
            "compile": timing.compile,
            "run": timing.run,
            "params": tune.named(space, search.thetas[first]),
        }
        if step < descent.steps:
            began = time.perf_counter()
            found, seconds = jax.block_until_ready(
                estimated(search.thetas, space, course, descent, step, **shape)
            )
            changes, state = jax.vmap(rule.update)(found.gradient, search.rule, search.thetas)
            thetas = optax.apply_updates(search.thetas, changes)
            search = search._replace(thetas=thetas, rule=state)
            norm = jnp.linalg.norm(found.gradient, axis=1)
            error = jnp.sqrt(jnp.sum(found.variance, axis=1))
            line |= {
                "gradient": tune.finite(norm.mean()),
                "gradient_error": tune.finite(error.mean()),
                "finite": float(found.finite.mean()),
                "simulated": line["simulated"] + seconds,
                "differentiate": time.perf_counter() - began,
            }
        search = search._replace(step=search.step + 1)
        log.append(line)
        files.write_json(folder / "tuned.json", tune.named(space, search.best))
        tune.save(folder, search, log)
    return space.params(search.best)
