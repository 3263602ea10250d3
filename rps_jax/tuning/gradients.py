"""Gradients of scores of random worlds with respect to parameters, each with its variance.

Every estimator takes a function of many pairs of parameters and worlds at once,

    scores(thetas (n, p), worlds (n, ...)) -> (n, ...), score i depends on pair i alone,

and returns samples (n, p, ...), one for each world, of the gradient of the mean score at `theta`:
(p,), or (n, p) to have one for each world. `estimate` averages them. `ESTIMATORS` has all
estimators by name; one more is one entry. `jax.vmap` turns the score of one world into such a
function. A score is a scalar or an array, such as the scores after several times.

Derivatives of chaotic worlds may be finite and meaningless: then their variance is large. Scores
that are differentiated must be smooth: use `registry.smooth_law` with a skin with a temperature.
Derivatives miss all jumps of a score.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from rps_jax.control.base import LawParams
from rps_jax.engines import native
from rps_jax.engines.base import Stage
from rps_jax.trials import trial
from rps_jax.trials.trial import ControlLoop, Snapshot, Trial, World

Scores = Callable[[jax.Array, Any], jax.Array]


class Estimate(NamedTuple):
    """Gradient as the mean of independent samples, with its variance."""

    gradient: jax.Array  # (p, ...) 0 where no sample is finite
    variance: jax.Array  # (p, ...) of the mean; inf for fewer than two samples
    finite: jax.Array  # (p, ...) [1] share of the samples that are finite and used


class Options(NamedTuple):
    """Options of the estimators; each uses some of them."""

    clip: float = 2.0  # [1] bound on the norm of a sample, as a multiple of the median norm
    sigma: float | jax.Array = 0.15  # () or (p,) standard deviation of the steps, in theta's units
    pairs: int = 1  # antithetic pairs of steps in each world


class Estimator(Protocol):
    """Function that returns samples (n, p, ...) of a gradient."""

    def __call__(
        self,
        scores: Scores,
        theta: jax.Array,
        worlds: Any,
        key: jax.Array,
        options: Options = Options(),
    ) -> jax.Array: ...


def estimate(samples: jax.Array) -> Estimate:
    """Return the mean of the finite entries of samples (n, p, ...), with its variance."""
    is_finite = jnp.isfinite(samples)
    samples = jnp.where(is_finite, samples, 0.0)
    count = jnp.sum(is_finite, axis=0)
    mean = jnp.sum(samples, axis=0) / jnp.maximum(count, 1)
    squares = jnp.sum(jnp.where(is_finite, (samples - mean) ** 2, 0.0), axis=0)
    variance = squares / jnp.maximum(count - 1, 1) / jnp.maximum(count, 1)
    return Estimate(mean, jnp.where(count > 1, variance, jnp.inf), count / len(samples))


# --- estimators ----------------------------------------------------------------------------


def exact(
    scores: Scores,
    theta: jax.Array,
    worlds: Any,
    key: jax.Array | None = None,
    options: Options = Options(),
) -> jax.Array:
    """Return the derivatives in reverse mode; they cost a few evaluations of the scores."""
    del key, options
    jacobian = jax.jacrev(lambda thetas: jnp.sum(scores(thetas, worlds), axis=0))
    return jnp.moveaxis(jacobian(per_world(theta, worlds)), (-2, -1), (0, 1))


def clipped(
    scores: Scores, theta: jax.Array, worlds: Any, key: jax.Array, options: Options = Options()
) -> jax.Array:
    """Return the derivatives with a bound on their norms."""
    return clip(exact(scores, theta, worlds), options.clip)


def evolution(
    scores: Scores, theta: jax.Array, worlds: Any, key: jax.Array, options: Options = Options()
) -> jax.Array:
    """Return slopes of the smoothed score along antithetic random steps, without derivatives.

    Each world tries random normal directions and their opposites. The mean is unbiased for the
    gradient of E[score(theta + sigma e)], which exists even where scores jump.

    Reference: Nesterov and Spokoiny, "Random gradient-free minimization of convex functions",
    Foundations of Computational Mathematics 17, 2017.
    """
    directions, thetas, repeated = random_steps(theta, worlds, key, options)
    values = scores(thetas, repeated)
    values = values.reshape(2, options.pairs, -1, 1, *values.shape[1:])
    along = directions / (2 * options.sigma)
    along = along.reshape(*along.shape, *(1,) * (values.ndim - 4))
    return jnp.mean((values[0] - values[1]) * along, axis=0)


def mixed(
    scores: Scores, theta: jax.Array, worlds: Any, key: jax.Array, options: Options = Options()
) -> jax.Array:
    """Return mixtures of `exact` and `evolution` with the least mean squared error: see `mix`."""
    first = exact(scores, theta, worlds)
    return mix(first, evolution(scores, theta, worlds, key, options))


ESTIMATORS: dict[str, Estimator] = {
    "exact": exact,
    "clipped": clipped,
    "evolution": evolution,
    "mixed": mixed,
}


def clip(samples: jax.Array, bound: float) -> jax.Array:
    """Scale samples (n, p, ...) whose norm over p exceeds `bound` times the median norm down to it.

    This biases the mean but keeps a few samples from dominating it. Samples of norm 0 do not count.
    """
    scale = jnp.max(jnp.abs(samples), axis=1, keepdims=True)
    scaled = samples / jnp.where(scale > 0, scale, 1.0)  # whose squares do not overflow
    size = scale * jnp.sqrt(jnp.sum(scaled**2, axis=1, keepdims=True))
    # The median of the worlds with a gradient; trials that have ended have none.
    counted = jnp.where(jnp.isfinite(size) & (size > 0), size, jnp.nan)
    limit = bound * jnp.nan_to_num(jnp.nanmedian(counted, axis=0))
    return samples * jnp.minimum(1.0, limit / jnp.where(size == 0, 1.0, size))


def mix(first: jax.Array, zeroth: jax.Array) -> jax.Array:
    """Mix samples (n, p, ...) of derivatives and of slopes for the least mean squared error.

    The error of the derivatives has their measured variance and their measured bias: the distance
    of the means beyond two standard errors. A derivative that is not finite gets no weight. The
    variance of the mixed samples lacks that of the weight.

    Reference: Suh et al., "Do differentiable simulators give better policy gradients?", ICML 2022;
    there the weight keeps the error below a bound.
    """
    means = estimate(first), estimate(zeroth)
    noise_1, noise_0 = (jnp.sum(x.variance, axis=0) for x in means)
    distance = jnp.sum((means[0].gradient - means[1].gradient) ** 2, axis=0)
    bias = jnp.maximum(distance - 4 * (noise_1 + noise_0), 0.0)
    share = jnp.nan_to_num(noise_0 / (noise_0 + noise_1 + jnp.nan_to_num(bias)))
    return jnp.where(jnp.isfinite(first), share * first + (1 - share) * zeroth, zeroth)


def per_world(theta: jax.Array, worlds: Any) -> jax.Array:
    """Return theta, (p,) or (n, p), for each world, (n, p)."""
    count = jax.tree.leaves(worlds)[0].shape[0]
    return jnp.broadcast_to(theta, (count, theta.shape[-1]))


def random_steps(
    theta: jax.Array, worlds: Any, key: jax.Array, options: Options
) -> tuple[jax.Array, jax.Array, Any]:
    """Return normal directions (pairs, n, p), and thetas and worlds (2 pairs n, ...) along them.

    The first half of these are steps ahead, the second half the opposite ones.
    """
    thetas = per_world(theta, worlds)
    directions = jax.random.normal(key, (options.pairs, *thetas.shape), thetas.dtype)
    offsets = jnp.concatenate([directions, -directions]) * options.sigma
    return (
        directions,
        (thetas + offsets).reshape(-1, thetas.shape[-1]),
        repeat(worlds, 2 * options.pairs),
    )


def repeat(worlds: Any, times: int) -> Any:
    """Repeat worlds (n, ...) several times, (times n, ...)."""
    return jax.tree.map(lambda x: jnp.concatenate([x] * times), worlds)


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
        _, snapshots = trial.unroll(stage, worlds, params, trials, loop, steps, native.mapped)
        return jax.vmap(cost, in_axes=1)(snapshots)

    return scores
