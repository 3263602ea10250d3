"""Gradients of a score with respect to parameters, each with its variance.

What is scored is random: worlds differ. So every estimator takes scores of many pairs at once,

    scores(thetas (n, p), worlds (n, ...)) -> (n, ...), each of its own pair alone,

and returns the gradient at one `theta` (p,) of their mean over the worlds as an `Estimate`, by
which two can be compared or combined. A score of one world becomes such a function by `jax.vmap`.
It is a number, or an array of them, such as scores after different times.
Derivatives of chaotic worlds may be finite and yet say nothing: their variance shows it.

`forward` and `reverse` differentiate every world. What they differentiate must be smooth:
`registry.smooth_law` with a `skin.SmoothSkin`; and it misses what jumps all the same. `evolution`
and `differences` need no derivative.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.control import registry
from rps_jax.control.base import Params
from rps_jax.geometry import planar
from rps_jax.trials import pushes, trial
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Loop, Snapshot, Trial

Scores = Callable[[jax.Array, Any], jax.Array]


class Estimate(NamedTuple):
    """A gradient as the mean of independent samples."""

    gradient: jax.Array  # (p, ...) 0 where no sample is finite
    variance: jax.Array  # (p, ...) of the gradient, not of a sample; inf of fewer than two samples
    finite: jax.Array  # (p, ...) [1] share of the samples that are finite; the others were dropped


def estimate(samples: jax.Array, clip: float = jnp.inf) -> Estimate:
    """The mean of samples (n, p, ...), entry by entry without those that are not finite.

    A sample whose norm (over p) is more than `clip` times their median is scaled down to it: a
    bias, and the end of the few samples that would outweigh all others.
    """
    there = jnp.isfinite(samples)
    samples = jnp.where(there, samples, 0.0)
    if clip < jnp.inf:
        size = planar.norm(jnp.moveaxis(samples, 1, -1))[:, None]
        # Of the worlds that have a gradient at all: some trials have ended.
        most = clip * jnp.nan_to_num(jnp.nanmedian(jnp.where(size > 0, size, jnp.nan), axis=0))
        samples = samples * jnp.minimum(1.0, most / jnp.where(size > 0, size, 1.0))
    count = jnp.sum(there, axis=0)
    mean = jnp.sum(samples, axis=0) / jnp.maximum(count, 1)
    squares = jnp.sum(jnp.where(there, (samples - mean) ** 2, 0.0), axis=0)
    variance = squares / jnp.maximum(count - 1, 1) / jnp.maximum(count, 1)
    return Estimate(
        mean, jnp.where(count > 1, variance, jnp.inf), jnp.mean(there, axis=0, dtype=mean.dtype)
    )


def forward(scores: Scores, theta: jax.Array, worlds: Any, *, clip: float = jnp.inf) -> Estimate:
    """By forward-mode differentiation in each world: p times the work of the scores.

    `clip` is that of `estimate`. It passes through the solvers of MJX (with a pyramidal cone) and
    of the fused engine.
    """
    thetas = _for_each(theta, worlds)

    def along(direction: jax.Array) -> jax.Array:
        each = jnp.broadcast_to(direction, thetas.shape)
        return jax.jvp(lambda t: scores(t, worlds), (thetas,), (each,))[1]

    return estimate(jax.vmap(along, out_axes=1)(jnp.eye(theta.size, dtype=theta.dtype)), clip)


def reverse(scores: Scores, theta: jax.Array, worlds: Any, *, clip: float = jnp.inf) -> Estimate:
    """By reverse-mode differentiation in each world: the work of the scores, a few times.

    `clip` is that of `estimate`. For models without a solver's loop.
    """
    thetas = _for_each(theta, worlds)
    slopes = jax.jacrev(lambda t: jnp.sum(scores(t, worlds), axis=0))(thetas)
    return estimate(jnp.moveaxis(slopes, (-2, -1), (0, 1)), clip)


def differences(
    scores: Scores, theta: jax.Array, worlds: Any, *, step: float | jax.Array
) -> Estimate:
    """By central differences in each world: 2 p n scores.

    A `step` is () or (p,), in the units of theta.
    """
    n, p = _for_each(theta, worlds).shape
    steps = jnp.repeat(jnp.diag(jnp.broadcast_to(jnp.asarray(step, theta.dtype), p)), n, axis=0)
    thetas = theta + jnp.concatenate([steps, -steps])
    found = scores(thetas, _repeated(worlds, 2 * p))
    rises = -jnp.diff(found.reshape(2, p, n, *found.shape[1:]), axis=0)[0]
    width = jnp.reshape(2 * jnp.asarray(step), (-1,) + (1,) * found.ndim)
    return estimate(jnp.swapaxes(rises / width, 0, 1))


def evolution(
    scores: Scores,
    theta: jax.Array,
    worlds: Any,
    key: jax.Array,
    *,
    sigma: float | jax.Array,
    pairs: int = 1,
) -> Estimate:
    """By differences between opposite random steps: of the mean score smoothed by `sigma`.

    Each world tries `pairs` normal directions of its own, each both ways, and both in the same
    world: 2 pairs n scores. Without bias it is the gradient of E[score(theta + sigma e)], which
    exists even where scores jump. `sigma`, () or (p,), is in the units of theta.

    Reference: Nesterov and Spokoiny, "Random gradient-free minimization of convex functions",
    Foundations of Computational Mathematics 17, 2017.
    """
    n, p = _for_each(theta, worlds).shape
    directions = jax.random.normal(key, (pairs, n, p), theta.dtype)
    steps = jnp.concatenate([directions, -directions]) * sigma
    found = scores(theta + steps.reshape(-1, p), _repeated(worlds, 2 * pairs))
    rises = -jnp.diff(found.reshape(2, pairs, n, 1, *found.shape[1:]), axis=0)[0]
    along = directions / (2 * sigma)
    slopes = rises * along.reshape(*along.shape, *(1,) * (found.ndim - 1))
    return estimate(jnp.mean(slopes, axis=0))


def combine(one: Estimate, other: Estimate) -> Estimate:
    """Two independent estimates of one gradient, weighted by their inverse variances.

    Entry by entry. Of all weighted means this has the least variance, if the variances are right;
    an estimate that knows nothing (of infinite variance) has no weight.
    """
    total = one.variance + other.variance
    weight = jnp.where(total > 0, other.variance / jnp.where(total > 0, total, 1.0), 0.5)
    weight = jnp.where(jnp.isinf(other.variance), 1.0, weight)
    weight = jnp.where(jnp.isinf(one.variance), 0.0, weight)  # of `one`
    certain = jnp.minimum(one.variance, other.variance)
    return Estimate(
        weight * one.gradient + (1 - weight) * other.gradient,
        jnp.where(jnp.isinf(total), certain, weight * one.variance),
        weight * one.finite + (1 - weight) * other.finite,
    )


def _for_each(theta: jax.Array, worlds: Any) -> jax.Array:
    """Repeat theta in each world, (n, p)."""
    count = jax.tree.leaves(worlds)[0].shape[0]
    return jnp.broadcast_to(theta, (count, theta.size))


def _repeated(worlds: Any, times: int) -> Any:
    """Repeat worlds (n, ...) several times, (times n, ...)."""
    return jax.tree.map(lambda x: jnp.concatenate([x] * times), worlds)


def window(
    stage: Any,  # of an engine with derivatives: see `Engine.check_derivatives`
    params_of: Callable[[jax.Array], Params],  # from theta (p,), differentiable
    cost: Callable[[Snapshot], jax.Array],  # () or (...) of snapshots (steps, ...) of one trial
    loop: Loop,  # with the smooth law that the parameters belong to
    steps: int,
) -> Scores:
    """Scores of trials driven on for some control steps from where they are.

    Their worlds are pairs (World, Trial), batched: the trials say where to start.
    """

    def scores(thetas: jax.Array, starts: Any) -> jax.Array:
        worlds, trials = starts
        worlds = worlds._replace(params=jax.vmap(params_of)(thetas))

        @partial(jax.checkpoint, prevent_cse=False)  # in reverse, memory of one state a step
        def one(trials: Trial, _: None) -> tuple[Trial, Snapshot]:
            return trial.control_step(stage, worlds, trials, loop)

        _, seen = jax.lax.scan(one, trials, length=steps)
        return jax.vmap(cost, in_axes=1)(seen)

    return scores


def distances(
    cases: Sequence[Case],
    params_of: Callable[[jax.Array], Params],
    horizons: Sequence[float],
    setting: Setting = Setting(engine="quasistatic"),
) -> tuple[Scores, Any]:
    """How far from their targets pushes are after some times, under the smooth law.

    Args:
      cases: pushes of one kind and one law, RPS or RPS+, with smooth skins.
      params_of: parameters from theta (p,), differentiable.
      horizons: the times (H,) [s], in order.
      setting: what the pushes share; its engine has derivatives.

    Returns:
      Scores (n, H) [m], compiled when first called, and the worlds that they take.

    Example:
      >>> from rps_jax import RPSParams
      >>> from rps_jax.robot.skin import SmoothSkin
      >>> from rps_jax.trials.case import Case
      >>> from rps_jax.tuning import gradients
      >>> from rps_jax.tuning.space import Space
      >>> space = Space(("K_h", "L"))
      >>> ahead = Case("box", "S1", (1.0, 1.0), skin=SmoothSkin(), gap=0.0)
      >>> scores, worlds = gradients.distances([ahead], space.params, [0.2, 0.4])
      >>> found = gradients.forward(scores, space.vector(RPSParams.paper()), worlds)
      >>> found.gradient.shape
      (2, 2)
    """
    stage, worlds = pushes.build(cases, setting)
    law = registry.smooth_law(registry.law_of(cases[0].params))
    at = np.round(np.asarray(horizons) / setting.physics.control_period).astype(int)

    def left(seen: Snapshot) -> jax.Array:
        return seen.details.distance[at]

    loop = Loop(setting.physics, law=law)
    scores = jax.jit(window(stage, params_of, left, loop, int(at[-1]) + 1))
    return scores, (worlds, trial.start_all(worlds, np.ones(len(cases), bool), law=law))
