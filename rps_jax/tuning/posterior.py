"""A lean neural posterior over a unit cube: what simulated worlds say of those that were observed.

The density of each coordinate, given statistics and the coordinates before it, is a histogram whose
heights a small network gives, so that a flat one is the prior. Networks are trained on pairs of
coordinates and statistics by the logarithm of that density, until it no longer rises on pairs that
are kept apart, and several are averaged. (Papamakarios and Murray 2016; autoregressive in bins.)
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

BINS = 24  # of each coordinate
_WIDTH = 96
_MEMBERS = 3
_BATCH = 256
_EPOCHS = 40
_NOISE = 0.03  # of the statistics' spread, added in training
# What each observation after the first counts, since the networks' own errors multiply, too: found
# in worlds for validation, see `sweeps/fit`.
_FURTHER = 0.6
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
    def layer(key: jax.Array, fan: int, *shape: int) -> jax.Array:
        return jax.random.normal(key, shape) / np.sqrt(fan)

    keys, w, h = jax.random.split(key, 5), _WIDTH, _WIDTH // 2
    return {
        "trunk": [
            (layer(k, n, n, w), jnp.zeros(w)) for k, n in ((keys[0], features), (keys[1], w))
        ],
        "seen": layer(keys[2], w, w, size, h),
        "before": layer(keys[3], size, size, size, h),  # of coordinates, on later ones
        "bias": jnp.zeros((size, h)),
        "out": (0.01 * layer(keys[4], h, size, h, BINS), jnp.zeros((size, BINS))),
    }


def _trunk(params: Any, x: jax.Array) -> jax.Array:
    for w, b in params["trunk"]:
        x = jax.nn.silu(x @ w + b)
    return x


def _mask(size: int) -> np.ndarray:
    """Which coordinates (size, size, 1) come before which."""
    return np.triu(np.ones((size, size), np.float32), 1)[..., None]


def _loss(params: Any, x: jax.Array, u: jax.Array, key: jax.Array | None = None) -> jax.Array:
    """Mean over (n) of minus the log density of u (n, D) against the prior's."""
    if key is not None:  # noise keeps the networks from learning worlds by heart
        x = x + _NOISE * jax.random.normal(key, x.shape)
    size = u.shape[-1]
    before = (params["before"] * _mask(size)).reshape(size, -1)
    hidden = _trunk(params, x) @ params["seen"].reshape(_WIDTH, -1) + (2 * u - 1) @ before
    hidden = jax.nn.silu(hidden.reshape(-1, *params["bias"].shape) + params["bias"])
    out, bias = params["out"]
    shares = jax.nn.log_softmax(jnp.einsum("ndh,dhk->ndk", hidden, out) + bias)
    at = jnp.minimum((u * BINS).astype(int), BINS - 1)[..., None]
    return -jnp.mean(jnp.sum(jnp.take_along_axis(shares, at, -1)[..., 0] + jnp.log(BINS), -1))


def train(u: np.ndarray, statistics: np.ndarray, seed: int = 0) -> Posterior:
    """Train on worlds at `u` (n, D) of the cube with statistics (n, m, F), each seen in m ways."""
    rng = np.random.default_rng(seed)
    count, ways, features = statistics.shape
    flat = statistics.reshape(-1, features)
    mean, scale = np.nanmean(flat, 0), np.nanstd(flat, 0) + 1e-6
    empty = Posterior(np.nan_to_num(mean), np.nan_to_num(scale, nan=1.0), None)
    x = empty.seen(flat).reshape(count, ways, features).astype(np.float32)
    order, kept = rng.permutation(count), max(2, count // 10)
    apart = (
        jnp.asarray(x[order[:kept]].reshape(-1, features)),
        jnp.asarray(np.repeat(u[order[:kept]], ways, 0)),
    )
    own, uo = x[order[kept:]].reshape(-1, features), np.repeat(u[order[kept:]], ways, 0)
    size, steps = len(own), max(1, len(own) // _BATCH)
    schedule = optax.cosine_decay_schedule(2e-3, _EPOCHS * steps, 0.02)
    optimiser = optax.adamw(schedule, weight_decay=1e-2)
    init = partial(_init, features=features, size=u.shape[-1])
    own, uo = jnp.asarray(own), jnp.asarray(uo, jnp.float32)

    @jax.jit
    def epoch(params: Any, state: Any, key: jax.Array) -> Any:
        def one(carry: Any, step: Any) -> Any:
            params, state = carry
            rows, key = step
            grad = jax.grad(_loss)(params, own[rows], uo[rows], key)
            change, state = optimiser.update(grad, state, params)
            return (optax.apply_updates(params, change), state), None

        shuffled = jax.random.permutation(key, size)[: steps * _BATCH].reshape(steps, -1)
        keys = jax.random.split(key, steps)
        (params, state), _ = jax.lax.scan(one, (params, state), (shuffled, keys))
        return params, state, _loss(params, *apart)

    members = []
    for member in range(_MEMBERS):
        key = jax.random.PRNGKey(seed * _MEMBERS + member)
        params = best = init(key)
        state, least, since = optimiser.init(params), np.inf, 0
        for number in range(_EPOCHS):
            params, state, loss = epoch(params, state, jax.random.fold_in(key, number))
            since += 1
            if float(loss) < least:
                best, least, since = params, float(loss), 0
            if since >= _PATIENCE:
                break
        members.append(best)
    return empty._replace(params=jax.tree.map(lambda *leaves: jnp.stack(leaves), *members))


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
    power = (1 + _FURTHER * (len(x) - 1)) / len(x)  # of each density in the product
    size = params["bias"].shape[1]
    before = params["before"] * _mask(size)

    def one(d: Any, carry: Any) -> Any:
        u, key = carry
        key, pick, within, again = jax.random.split(key, 4)
        known = jnp.einsum("cj,ejh->ech", 2 * u - 1, before[:, :, d]) + params["bias"][:, None, d]
        hidden = jnp.einsum("emw,ewh->emh", seen, params["seen"][:, :, d])
        hidden = jax.nn.silu(hidden[:, :, None] + known[:, None])  # (members, m, count, H)
        out, bias = (x[:, d] for x in params["out"])
        each = jnp.einsum("emch,ehk->emck", hidden, out) + bias[:, None, None]
        each = jax.nn.log_softmax(each)
        log = jax.nn.logsumexp(each, 0) - jnp.log(len(each)) + jnp.log(BINS)
        product = power * jnp.sum(log, 0) - jnp.log(BINS)
        bins = jax.random.categorical(pick, product)
        value = (bins + jax.random.uniform(within, (count,))) / BINS
        weight = jax.nn.logsumexp(product, -1)
        u = u.at[:, d].set(jnp.clip(value, 0, 1 - 1e-6))
        chosen = jax.random.categorical(again, weight, shape=(count,))
        return jnp.where(x.shape[0] > 1, u[chosen], u), key

    return jax.lax.fori_loop(0, size, one, (jnp.zeros((count, size)), key))[0]
