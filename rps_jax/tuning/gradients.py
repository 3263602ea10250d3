"""Gradients of scores of random worlds with respect to parameters, each with its variance.

An estimator takes a function of many pairs of parameters and worlds at once,

    scores(thetas (n, p), worlds (n, ...)) -> (n, ...), score i depends on pair i alone,

and returns samples (n, p, ...), one for each world, of the gradient of the mean score at `theta`:
(p,), or (n, p) to have one for each world. `estimate` averages them. `jax.vmap` turns the score of
one world into such a function. A score is a scalar or an array, such as the scores after several
times.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from rps_jax.geometry.arrays import Array

Scores = Callable[[Array, PyTree], Array]


class Estimate(NamedTuple):
    """Gradient as the mean of independent samples, with its variance."""

    gradient: Array  # (p, ...) NaN where no sample is finite
    variance: Array  # (p, ...) of the mean; inf for fewer than two samples
    finite: Array  # (p, ...) [1] share of the samples that are finite and used


class Options(NamedTuple):
    """Options of `evolution`."""

    sigma: float | Array = 0.15  # () or (p,) standard deviation of the steps, in theta's units
    pairs: int = 1  # antithetic pairs of steps in each world


def estimate(samples: Array) -> Estimate:
    """Return the mean of the finite entries of samples (n, p, ...), with its variance."""
    is_finite = jnp.isfinite(samples)
    samples = jnp.where(is_finite, samples, 0.0)
    count = jnp.sum(is_finite, axis=0)
    mean = jnp.sum(samples, axis=0) / count
    squares = jnp.sum(jnp.where(is_finite, (samples - mean) ** 2, 0.0), axis=0)
    variance = squares / jnp.maximum(count - 1, 1) / jnp.maximum(count, 1)
    return Estimate(mean, jnp.where(count > 1, variance, jnp.inf), count / len(samples))


def clip(samples: Array, bound: float) -> Array:
    """Scale samples (n, p, ...) whose norm over p exceeds `bound` times the median norm down to it.

    This biases the mean but keeps a few samples from dominating it. Samples of norm 0 do not count.
    """
    scale = jnp.max(jnp.abs(samples), axis=1, keepdims=True)
    scaled = samples / jnp.where(scale > 0, scale, 1.0)  # whose squares do not overflow
    size = scale * jnp.sqrt(jnp.sum(scaled**2, axis=1, keepdims=True))
    # The median of the worlds with a gradient; trials that have ended have none.
    counted = jnp.where(jnp.isfinite(size) & (size > 0), size, jnp.nan)
    limit = bound * jnp.nan_to_num(jnp.nanmedian(counted, axis=0))
    return samples * jnp.where(size == 0, 1.0, jnp.minimum(1.0, limit / size))


def cosine(a: Array, b: Array) -> Array:
    """Return the cosine of the angle between two vectors (p,); NaN if one is zero."""
    return jnp.dot(a, b) / (jnp.linalg.norm(a) * jnp.linalg.norm(b))


def evolution(
    scores: Scores, theta: Array, worlds: PyTree, key: Array, options: Options = Options()
) -> Array:
    """Return slopes of the smoothed score along antithetic random steps, without derivatives.

    Each world tries random normal directions and their opposites. The mean is unbiased for the
    gradient of E[score(theta + sigma e)], which exists even where scores jump.

    Reference: Nesterov and Spokoiny, "Random gradient-free minimization of convex functions",
    Foundations of Computational Mathematics 17, 2017.
    """
    directions, thetas, repeated = random_steps(theta, worlds, key, options)
    return slopes_along(directions, scores(thetas, repeated), options)


def random_steps(
    theta: Array, worlds: PyTree, key: Array, options: Options
) -> tuple[Array, Array, PyTree]:
    """Return normal directions (pairs, n, p), and thetas and worlds (2 pairs n, ...) along them.

    The first half of these are steps ahead, the second half the opposite ones.
    """
    thetas = per_world(theta, worlds)
    directions = jax.random.normal(key, (options.pairs, *thetas.shape), thetas.dtype)
    offsets = jnp.concatenate([directions, -directions]) * options.sigma
    return (
        directions,
        (thetas + offsets).reshape(-1, thetas.shape[-1]),
        jax.tree.map(lambda x: jnp.concatenate([x] * (2 * options.pairs)), worlds),
    )


def slopes_along(directions: Array, values: Array, options: Options) -> Array:
    """Return the slopes (n, p, ...) of the scores (2 pairs n, ...) of `random_steps`."""
    values = values.reshape(2, options.pairs, -1, 1, *values.shape[1:])
    along = directions / (2 * options.sigma)
    along = along.reshape(*along.shape, *(1,) * (values.ndim - 4))
    return jnp.mean((values[0] - values[1]) * along, axis=0)


def per_world(theta: Array, worlds: PyTree) -> Array:
    """Return theta, (p,) or (n, p), for each world, (n, p)."""
    count = jax.tree.leaves(worlds)[0].shape[0]
    return jnp.broadcast_to(theta, (count, theta.shape[-1]))
