"""Gradients of scores of random worlds with respect to parameters, each with its variance.

Every estimator takes a function of many pairs of parameters and worlds at once,

    scores(thetas (n, p), worlds (n, ...)) -> (n, ...), score i depends on pair i alone,

and returns the gradient of the mean score at one `theta` (p,) as an `Estimate`. `jax.vmap` turns
the score of one world into such a function. A score is a scalar or an array, such as the scores
after several times. Derivatives of chaotic worlds may be finite and meaningless: then their
variance is large.

`reverse` differentiates the scores, so they must be smooth: use `registry.smooth_law` with a
a skin with a temperature. Derivatives miss all jumps of a score.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rps_jax.control.base import LawParams
from rps_jax.engines.base import Stage
from rps_jax.geometry import planar
from rps_jax.trials import trial
from rps_jax.trials.trial import ControlLoop, Snapshot, Trial, World

Scores = Callable[[jax.Array, Any], jax.Array]


class Estimate(NamedTuple):
    """Gradient as the mean of independent samples, with its variance."""

    gradient: jax.Array  # (p, ...) 0 where no sample is finite
    variance: jax.Array  # (p, ...) of the mean; inf for fewer than two samples
    finite: jax.Array  # (p, ...) [1] share of the samples that are finite and used


def estimate(samples: jax.Array, clip: float = jnp.inf) -> Estimate:
    """Return the mean of the finite entries of samples (n, p, ...), with its variance.

    A sample whose norm over p exceeds `clip` times the median norm is scaled down to that bound.
    This biases the mean but keeps a few samples from dominating it.
    """
    is_finite = jnp.isfinite(samples)
    samples = jnp.where(is_finite, samples, 0.0)
    if clip < jnp.inf:
        size = planar.norm(jnp.moveaxis(samples, 1, -1))[:, None]
        # The median of the worlds with a gradient; trials that have ended have none.
        bound = clip * jnp.nan_to_num(jnp.nanmedian(jnp.where(size > 0, size, jnp.nan), axis=0))
        samples = samples * jnp.minimum(1.0, bound / jnp.where(size > 0, size, 1.0))
    count = jnp.sum(is_finite, axis=0)
    mean = jnp.sum(samples, axis=0) / jnp.maximum(count, 1)
    squares = jnp.sum(jnp.where(is_finite, (samples - mean) ** 2, 0.0), axis=0)
    variance = squares / jnp.maximum(count - 1, 1) / jnp.maximum(count, 1)
    return Estimate(mean, jnp.where(count > 1, variance, jnp.inf), count / len(samples))


def reverse(scores: Scores, theta: jax.Array, worlds: Any, *, clip: float = jnp.inf) -> Estimate:
    """Estimate the gradient by reverse-mode differentiation in each world.

    The cost is a few evaluations of the scores. `clip` is that of `estimate`. The worlds must step
    without a solver loop, as on the quasi-static model.
    """
    return estimate(slopes(scores, theta, worlds), clip)


def slopes(scores: Scores, theta: jax.Array, worlds: Any) -> jax.Array:
    """Return the gradient in each world (n, p, ...) by reverse-mode differentiation."""
    jacobian = jax.jacrev(lambda thetas: jnp.sum(scores(thetas, worlds), axis=0))
    return jnp.moveaxis(jacobian(per_world(theta, worlds)), (-2, -1), (0, 1))


def per_world(theta: jax.Array, worlds: Any) -> jax.Array:
    """Return theta for each world, (n, p)."""
    count = jax.tree.leaves(worlds)[0].shape[0]
    return jnp.broadcast_to(theta, (count, theta.size))


def window(
    stage: Stage,  # of an engine with derivatives: see `Engine.check_derivatives`
    params_of: Callable[[jax.Array], LawParams],  # from theta (p,), differentiable
    cost: Callable[[Snapshot], jax.Array],  # () or (...) of snapshots (steps, ...) of one trial
    loop: ControlLoop,  # with the smooth law that the parameters belong to
    steps: int,
) -> Scores:
    """Return scores of windows of trials, of `steps` control steps each.

    The worlds of these scores are batched pairs (World, Trial); a window starts at its trial.
    """

    def scores(thetas: jax.Array, starts: tuple[World, Trial]) -> jax.Array:
        worlds, trials = starts
        params = jax.vmap(params_of)(thetas)

        @partial(jax.checkpoint, prevent_cse=False)  # in reverse, memory of one state a step
        def step(trials: Trial, _: None) -> tuple[Trial, Snapshot]:
            return trial.control_step(stage, worlds, params, trials, loop)

        _, snapshots = jax.lax.scan(step, trials, length=steps)
        return jax.vmap(cost, in_axes=1)(snapshots)

    return scores
