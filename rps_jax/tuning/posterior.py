"""A lean neural posterior over a unit cube: what simulated worlds say of those that were observed.

The density of each coordinate, given statistics and the coordinates before it, is a histogram whose
heights a small network gives, so that a flat one is the prior. Networks are trained on pairs of
coordinates and statistics by the logarithm of that density, until it no longer rises on pairs that
are kept apart, and several are averaged. (Papamakarios and Murray 2016; autoregressive in bins.)
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

BINS = 24  # of each coordinate
_WIDTH = 96
_MEMBERS = 3
_BATCH = 128
_EPOCHS = 60
_PATIENCE = 8  # epochs without a better density before training ends


class Posterior(NamedTuple):
    """Trained networks, (members, ...) each, with the scale of what they see."""

    mean: np.ndarray  # (F,)
    scale: np.ndarray  # (F,)
    params: Any

    def seen(self, statistics: np.ndarray) -> np.ndarray:
        """Statistics (n, F) as the networks see them; what is not known is 0."""
        return np.clip(np.nan_to_num((statistics - self.mean) / self.scale), -6, 6)


def _init(key: jax.Array, features: int, size: int) -> Any:
    def layer(key: jax.Array, *shape: int) -> jax.Array:
        return jax.random.normal(key, shape) / np.sqrt(shape[-2])

    keys, w = jax.random.split(key, 5), _WIDTH
    return {
        "trunk": [(layer(k, n, w), jnp.zeros(w)) for k, n in ((keys[0], features), (keys[1], w))],
        "head": [
            (layer(keys[2], size, w + size, w // 2), jnp.zeros((size, w // 2))),
            (0.01 * layer(keys[3], size, w // 2, BINS), jnp.zeros((size, BINS))),
        ],
    }


def _trunk(params: Any, x: jax.Array) -> jax.Array:
    for w, b in params["trunk"]:
        x = jax.nn.silu(x @ w + b)
    return x


def _head(params: Any, d: Any, x: jax.Array, u: jax.Array) -> jax.Array:
    """Log shares (..., BINS) of coordinate `d`, given those before it in `u` (..., D)."""
    known = jnp.where(jnp.arange(u.shape[-1]) < d, 2 * u - 1, 0.0)
    (w, b), (v, c) = params["head"]
    hidden = jax.nn.silu(jnp.concatenate([x, known], -1) @ w[d] + b[d])
    return jax.nn.log_softmax(hidden @ v[d] + c[d])


def _loss(params: Any, x: jax.Array, u: jax.Array, key: jax.Array | None = None) -> jax.Array:
    """Mean over (n) of minus the log density of u (n, D) against the prior's."""
    if key is not None:  # noise keeps the networks from learning worlds by heart
        key, other = jax.random.split(key)
        x = x + 0.1 * jax.random.normal(key, x.shape)
        x = x * jax.random.bernoulli(other, 0.9, x.shape) / 0.9
    every = jnp.arange(u.shape[-1])
    x = _trunk(params, x)
    shares = jax.vmap(_head, (None, 0, None, None), 1)(params, every, x, u)
    at = jnp.minimum((u * BINS).astype(int), BINS - 1)[..., None]
    return -jnp.mean(jnp.sum(jnp.take_along_axis(shares, at, -1)[..., 0] + jnp.log(BINS), -1))


def train(
    u: np.ndarray,
    statistics: np.ndarray,
    seed: int = 0,
    told: Callable[[int], object] = lambda epoch: None,
) -> Posterior:
    """Train on worlds at `u` (n, D) of the cube with statistics (n, m, F), each seen in m ways."""
    rng = np.random.default_rng(seed)
    flat = statistics.reshape(-1, statistics.shape[-1])
    mean, scale = np.nanmean(flat, 0), np.nanstd(flat, 0) + 1e-6
    empty = Posterior(np.nan_to_num(mean), np.nan_to_num(scale, nan=1.0), None)
    x = empty.seen(flat).reshape(statistics.shape).astype(np.float32)
    order, kept = rng.permutation(len(u)), max(2, len(u) // 10)
    ways = x.shape[1]
    apart = (
        jnp.asarray(x[order[:kept]].reshape(-1, x.shape[-1])),
        jnp.asarray(np.repeat(u[order[:kept]], ways, 0)),
    )
    own, uo = x[order[kept:]].reshape(-1, x.shape[-1]), np.repeat(u[order[kept:]], ways, 0)
    size, steps = len(own), max(1, len(own) // _BATCH)
    schedule = optax.cosine_decay_schedule(2e-3, _EPOCHS * steps, 0.02)
    optimiser = optax.adamw(schedule, weight_decay=1e-2)
    keys = jax.random.split(jax.random.PRNGKey(seed), _MEMBERS)
    params = jax.vmap(partial(_init, features=x.shape[-1], size=u.shape[-1]))(keys)
    state = jax.vmap(optimiser.init)(params)

    @jax.jit
    def epoch(params: Any, state: Any, keys: jax.Array, own: Any, uo: Any) -> Any:
        def member(params: Any, state: Any, key: jax.Array) -> Any:
            def one(carry: Any, step: Any) -> Any:
                params, state = carry
                rows, key = step
                grad = jax.grad(_loss)(params, own[rows], uo[rows], key)
                change, state = optimiser.update(grad, state, params)
                return (optax.apply_updates(params, change), state), None

            shuffled = jax.random.permutation(key, size)[: steps * _BATCH].reshape(steps, -1)
            (params, state), _ = jax.lax.scan(
                one, (params, state), (shuffled, jax.random.split(key, steps))
            )
            return params, state, _loss(params, *apart)

        return jax.vmap(member)(params, state, keys)

    best, best_loss, since = params, np.full(_MEMBERS, np.inf), 0
    own, uo = jnp.asarray(own), jnp.asarray(uo)
    for number in range(_EPOCHS):
        keys = jax.vmap(lambda key: jax.random.split(key)[0])(keys)
        params, state, loss = epoch(params, state, keys, own, uo)
        better, since = np.asarray(loss) < best_loss, since + 1
        if better.any():
            since, best_loss = 0, np.where(better, loss, best_loss)
            pick = jnp.asarray(better)
            best = jax.tree.map(
                lambda a, b, pick=pick: jnp.where(pick.reshape(-1, *[1] * (a.ndim - 1)), a, b),
                params, best,
            )  # fmt: skip
        told(number + 1)
        if since >= _PATIENCE:
            break
    return empty._replace(params=best)


def sample(posterior: Posterior, statistics: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    """Points (count, D) of the posterior, given all of several observations (m, F) of one world.

    The prior is flat, so that the densities of observations multiply. Each coordinate is drawn from
    the product over observations given those before it, and weighed by its sum.
    """
    x = jnp.asarray(posterior.seen(statistics), jnp.float32)
    return np.asarray(_drawn(posterior.params, x, jax.random.PRNGKey(seed), count))


@partial(jax.jit, static_argnames="count")
def _drawn(params: Any, x: jax.Array, key: jax.Array, count: int) -> jax.Array:
    seen = jax.vmap(_trunk, (0, None))(params, x)  # (members, m, W)
    size = params["head"][1][1].shape[1]

    def one(d: Any, carry: Any) -> Any:
        u, key = carry
        key, pick, within, again = jax.random.split(key, 4)

        def shares(params: Any, seen: jax.Array) -> jax.Array:  # (count, BINS) of one member
            every = jnp.broadcast_to(seen, (count, seen.shape[-1]))
            return _head(params, d, every, u)

        each = jax.vmap(jax.vmap(shares, (None, 0)))(params, seen)  # (members, m, count, BINS)
        log = jax.nn.logsumexp(each, 0) - jnp.log(len(each)) + jnp.log(BINS)
        product = jnp.sum(log, 0) - jnp.log(BINS)
        bins = jax.random.categorical(pick, product)
        value = (bins + jax.random.uniform(within, (count,))) / BINS
        weight = jax.nn.logsumexp(product, -1)
        u = u.at[:, d].set(jnp.clip(value, 0, 1 - 1e-6))
        chosen = jax.random.categorical(again, weight, shape=(count,))
        return jnp.where(x.shape[0] > 1, u[chosen], u), key

    return jax.lax.fori_loop(0, size, one, (jnp.zeros((count, size)), key))[0]
