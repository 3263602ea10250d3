"""Neural posterior of the coordinates of a world in the unit cube, given statistics of its log.

The density of each coordinate, given the statistics and the previous coordinates, is a histogram.
A small network returns the heights of its bins; a flat histogram is the prior. The networks are
trained on pairs of coordinates and statistics to maximise the log density, until it stops rising
on validation pairs. The densities of several networks are averaged. (Papamakarios and Murray 2016;
autoregressive in bins.)
"""

from functools import partial
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import PyTree

from rps_jax.geometry.arrays import Array, Pair

BINS = 24  # of each coordinate
_WIDTH = 96
_MEMBERS = 3
_BATCH = 256
_EPOCHS = 40
_NOISE = 0.03  # of the statistics' spread, added in training
# Weight of each observation after the first, below 1 because errors of the networks multiply;
# tuned in worlds for validation, see `sweeps/fit`.
_NEXT_WEIGHT = 0.6
_PATIENCE = 8  # epochs without a better density before training stops

Params = dict[str, PyTree]  # weights of a network: arrays, and tuples of arrays, by name
Carry = tuple[Params, optax.OptState]  # of training: weights, and state of their optimiser


class Posterior(NamedTuple):
    """Trained networks with leaves (members, ...), and the scale of their inputs."""

    mean: np.ndarray  # (F,)
    scale: np.ndarray  # (F,)
    params: Params

    def inputs(self, statistics: np.ndarray) -> np.ndarray:
        """Return the inputs (n, F) of the networks: scaled statistics, 0 where one is NaN."""
        return np.clip(np.nan_to_num((statistics - self.mean) / self.scale), -6, 6)


def _init(key: Array, features: int, size: int) -> Params:
    """Return random weights of a network for `size` coordinates."""

    def layer(key: Array, fan: int, *shape: int) -> Array:
        return jax.random.normal(key, shape) / np.sqrt(fan)

    keys, w, h = jax.random.split(key, 5), _WIDTH, _WIDTH // 2
    return {
        "trunk": [
            (layer(k, n, n, w), jnp.zeros(w)) for k, n in ((keys[0], features), (keys[1], w))
        ],
        "inputs": layer(keys[2], w, w, size, h),
        "previous": layer(keys[3], size, size, size, h),  # from coordinates to later ones
        "bias": jnp.zeros((size, h)),
        "out": (0.01 * layer(keys[4], h, size, h, BINS), jnp.zeros((size, BINS))),
    }


def _trunk(params: Params, x: Array) -> Array:
    """Return the hidden units (n, W) of inputs (n, F)."""
    for w, b in params["trunk"]:
        x = jax.nn.silu(x @ w + b)
    return x


def _mask(size: int) -> np.ndarray:
    """Return the mask (size, size, 1) of pairs whose first coordinate precedes the second."""
    return np.triu(np.ones((size, size), np.float32), 1)[..., None]


def _loss(params: Params, x: Array, u: Array, key: Array | None = None) -> Array:
    """Return the mean negative log density of u (n, D), relative to the prior."""
    if key is not None:  # noise against overfitting
        x = x + _NOISE * jax.random.normal(key, x.shape)
    size = u.shape[-1]
    previous = (params["previous"] * _mask(size)).reshape(size, -1)
    hidden = _trunk(params, x) @ params["inputs"].reshape(_WIDTH, -1) + (2 * u - 1) @ previous
    hidden = jax.nn.silu(hidden.reshape(-1, *params["bias"].shape) + params["bias"])
    out, bias = params["out"]
    shares = jax.nn.log_softmax(jnp.einsum("ndh,dhk->ndk", hidden, out) + bias)
    at = jnp.minimum((u * BINS).astype(int), BINS - 1)[..., None]
    return -jnp.mean(jnp.sum(jnp.take_along_axis(shares, at, -1)[..., 0] + jnp.log(BINS), -1))


def train(u: np.ndarray, statistics: np.ndarray, seed: int = 0) -> Posterior:
    """Train on worlds at `u` (n, D) in the cube, with m versions of their statistics (n, m, F)."""
    rng = np.random.default_rng(seed)
    count, ways, features = statistics.shape
    flat = statistics.reshape(-1, features)
    mean, scale = np.nanmean(flat, 0), np.nanstd(flat, 0) + 1e-6
    untrained = Posterior(np.nan_to_num(mean), np.nan_to_num(scale, nan=1.0), {})
    x = untrained.inputs(flat).reshape(count, ways, features).astype(np.float32)
    order, held_out = rng.permutation(count), max(2, count // 10)

    def pairs(rows: np.ndarray) -> Pair:
        targets = jnp.asarray(np.repeat(u[rows], ways, 0), jnp.float32)
        return jnp.asarray(x[rows].reshape(-1, features)), targets

    validation, (inputs, targets) = pairs(order[:held_out]), pairs(order[held_out:])
    size, steps = len(inputs), max(1, len(inputs) // _BATCH)
    schedule = optax.cosine_decay_schedule(2e-3, _EPOCHS * steps, 0.02)
    optimiser = optax.adamw(schedule, weight_decay=1e-2)
    init = partial(_init, features=features, size=u.shape[-1])

    @jax.jit
    def epoch(carry: Carry, key: Array) -> tuple[Carry, Array]:
        def update(carry: Carry, step: Pair) -> tuple[Carry, None]:
            (params, state), (rows, key) = carry, step
            grad = jax.grad(_loss)(params, inputs[rows], targets[rows], key)
            change, state = optimiser.update(grad, state, params)
            return (cast(Params, optax.apply_updates(params, change)), state), None

        shuffled = jax.random.permutation(key, size)[: steps * _BATCH].reshape(steps, -1)
        carry, _ = jax.lax.scan(update, carry, (shuffled, jax.random.split(key, steps)))
        return carry, _loss(carry[0], *validation)

    members = []
    for member in range(_MEMBERS):
        key = jax.random.PRNGKey(seed * _MEMBERS + member)
        best = init(key)
        carry, least, stalled = (best, optimiser.init(best)), np.inf, 0
        for index in range(_EPOCHS):
            carry, loss = epoch(carry, jax.random.fold_in(key, index))
            stalled += 1
            if float(loss) < least:
                best, least, stalled = carry[0], float(loss), 0
            if stalled >= _PATIENCE:
                break
        members.append(best)
    return untrained._replace(params=jax.tree.map(lambda *leaves: jnp.stack(leaves), *members))


def sample(posterior: Posterior, statistics: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    """Sample points (count, D) of the posterior, given several observations (m, F) of one world.

    The prior is flat, so the densities of the observations multiply. Each coordinate is drawn from
    this product, given the previous coordinates; the points are then resampled by its sum.
    """
    x = jnp.asarray(posterior.inputs(statistics), jnp.float32)
    return np.asarray(_draw(posterior.params, x, jax.random.PRNGKey(seed), count))


@partial(jax.jit, static_argnames="count")
def _draw(params: Params, x: Array, key: Array, count: int) -> Array:
    """Draw points (count, D) of the posterior of the inputs (m, F)."""
    units = jax.vmap(_trunk, (0, None))(params, x)  # (members, m, W)
    power = (1 + _NEXT_WEIGHT * (len(x) - 1)) / len(x)  # of each density in the product
    size = params["bias"].shape[1]
    previous = params["previous"] * _mask(size)

    def draw_coordinate(d: Array, carry: Pair) -> Pair:
        u, key = carry
        key, key_bin, key_value, key_rows = jax.random.split(key, 4)
        known = jnp.einsum("cj,ejh->ech", 2 * u - 1, previous[:, :, d]) + params["bias"][:, None, d]
        hidden = jnp.einsum("emw,ewh->emh", units, params["inputs"][:, :, d])
        hidden = jax.nn.silu(hidden[:, :, None] + known[:, None])  # (members, m, count, H)
        out, bias = (x[:, d] for x in params["out"])
        logits = jnp.einsum("emch,ehk->emck", hidden, out) + bias[:, None, None]
        shares = jax.nn.log_softmax(logits)
        log = jax.nn.logsumexp(shares, 0) - jnp.log(len(shares)) + jnp.log(BINS)
        product = power * jnp.sum(log, 0) - jnp.log(BINS)
        bins = jax.random.categorical(key_bin, product)
        value = (bins + jax.random.uniform(key_value, (count,))) / BINS
        weight = jax.nn.logsumexp(product, -1)
        u = u.at[:, d].set(jnp.clip(value, 0, 1 - 1e-6))
        rows = jax.random.categorical(key_rows, weight, shape=(count,))
        return jnp.where(x.shape[0] > 1, u[rows], u), key

    return jax.lax.fori_loop(0, size, draw_coordinate, (jnp.zeros((count, size)), key))[0]
