"""Proximal policy optimisation (Schulman et al. 2017) of a law that senses taxels.

The network is improved by several passes over what happened in many worlds. The value function is
told more than the law, which a law in use cannot be: where the object is, how large it is, and how
much time is left. The learning rate follows the divergence between the policies before and after a
step, and not the clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
import optax

from rps_jax import errors
from rps_jax.control.learned import network as networks
from rps_jax.control.learned import observation
from rps_jax.control.learned.network import Kind, Network, Weights

PRIVATE_SIGNS = np.array([1, -1, 1, 1, 1], np.float32)  # of what is `private`, under the mirror
_LOG_STD = (-2.5, 0.5)  # bounds on the logarithm of the standard deviation of an action


@dataclass(frozen=True)
class PPO:
    """How a law is learned."""

    network: Kind = "gru"
    """The network: mlp, two layers without a memory; or gru, with a recurrent layer."""
    width: int = 64
    """Pairs of units in a hidden layer; each pair stands for a world and its mirror image."""
    hold: float = 0.2
    """Time for which an action is carried out [s]."""
    worlds: int = 1024
    """Number of worlds of each shape of object (and domain) that are stepped at once."""
    decisions: int = 32
    """Number of decisions of each world in an update."""
    epochs: int = 4
    """Number of passes over the decisions of an update."""
    batches: int = 8
    """Number of batches of worlds in a pass, each of which is a step of the optimiser."""
    foresight: float = 30.0
    """Time after which a reward counts 1/e of what it counts at once [s]."""
    credit: float = 5.0
    """Time over which what was earned is summed before the value function stands for the rest
    [s]: that of generalised advantage estimation."""
    clip: float = 0.2
    """Bound on the change of an action's probability [1]."""
    entropy: float = 0.005
    """Bonus for the entropy of the actions [1]."""
    learning_rate: float = 1e-3
    """Learning rate of the first step."""
    divergence: float = 0.01
    """Divergence of a step's policy from the one that acted, which the learning rate keeps to."""
    level: float = 0.15
    """Share of the domain's bearings and distances with which the curriculum begins, up to 1."""
    enough: float = 0.7
    """Share of successes with which the level rises."""
    seed: int = 0
    """Seed of the weights and the actions, and of the worlds for tuning and validation."""

    def __post_init__(self) -> None:
        """Raises InputError for values that mean nothing."""
        errors.check_name("network", self.network, get_args(Kind))
        for name, most in (("width", 1024), ("worlds", 10**6), ("decisions", 1000)):
            errors.check_count(name, getattr(self, name), at_most=most)
        for name in ("epochs", "batches"):
            errors.check_count(name, getattr(self, name), at_most=1000)
        for name in ("hold", "foresight", "credit"):
            errors.check_finite(name, getattr(self, name), above=0, at_most=1000, unit="s")
        for name in ("clip", "learning_rate", "divergence", "level"):
            errors.check_finite(name, getattr(self, name), above=0, at_most=1)
        errors.check_finite("entropy", self.entropy, at_least=0, at_most=1)
        errors.check_finite("enough", self.enough, at_least=0, at_most=1)
        errors.check_count("seed", self.seed, at_least=0, at_most=2**30)

    @property
    def discount(self) -> float:
        """What a reward at the next decision counts [1]."""
        return math.exp(-self.hold / self.foresight)

    @property
    def decay(self) -> float:
        """Lambda of generalised advantage estimation [1]."""
        return math.exp(-self.hold / self.credit)


class Student(NamedTuple):
    """A policy that is learned, with what its optimiser keeps."""

    weights: Weights  # "actor", "critic", and "log_std" (3,) of the actions
    smoothed: Weights  # "actor" averaged over the last updates, which is the law
    optimiser: Any
    learning_rate: jax.Array  # ()

    @classmethod
    def init(cls, ppo: PPO, network: Network, key: jax.Array) -> Student:
        """One that has learned nothing."""
        actor, critic = jax.random.split(key)
        inputs = observation.size(network.taxels) + PRIVATE_SIGNS.size
        weights: Weights = {
            "actor": network.init(actor),
            "critic": networks.start(networks.critic_shapes(inputs, ppo.width), critic),
            "log_std": jnp.full(3, math.log(0.6)),
        }
        smoothed = jax.tree.map(jnp.copy, weights["actor"])
        return cls(
            weights, smoothed, _optimiser().init(weights), jnp.asarray(ppo.learning_rate, float)
        )


class Took(NamedTuple):
    """What happened at decisions; leaves (U, N, ...)."""

    numbers: jax.Array  # (F,) what the network saw
    private: jax.Array  # (P,) what the value function was told beside
    fresh: jax.Array  # () bool: the network had remembered nothing
    action: jax.Array  # (3,) [1] before it was bounded
    log_prob: jax.Array  # ()
    value: jax.Array  # () before
    after: jax.Array  # () value after, and before a world begins anew
    reward: jax.Array  # ()
    ended: jax.Array  # () bool
    final: jax.Array  # () bool: nothing can be earned afterwards, as after a success


# --- the algorithm -------------------------------------------------------------------------


def advantages(took: Took, discount: float, decay: float) -> jax.Array:
    """Generalised advantage estimates (U, N) (Schulman et al. 2016, Eq. 16).

    A trial that ran out of time goes on by the value function; one that is final earns no more.
    """
    delta = took.reward + discount * jnp.where(took.final, 0.0, took.after) - took.value

    def back(later: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        delta, ended = now
        found = delta + discount * decay * jnp.where(ended, 0.0, later)
        return found, found

    return jax.lax.scan(back, jnp.zeros_like(delta[0]), (delta, took.ended), reverse=True)[1]


def pair(numbers: jax.Array, private: jax.Array) -> jax.Array:
    """What the value function is told (..., 2, F + P), of the world and of its mirror image."""
    signs = jnp.asarray(PRIVATE_SIGNS, private.dtype)
    both = jnp.stack([private, signs * private], axis=-2)
    return jnp.concatenate([networks.paired(numbers), both], axis=-1)


def log_prob(action: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """Logarithm (...) of the density of actions (..., 3) [1]: normal, independent."""
    z = (action - mean) / jnp.exp(log_std)
    return jnp.sum(-0.5 * z * z - log_std - 0.5 * math.log(2 * math.pi), axis=-1)


def surrogate(
    ratio: jax.Array, advantage: jax.Array, clip: float
) -> jax.Array:  # Schulman et al. 2017, Eq. 7
    """The clipped objective (...), which is to be great."""
    bounded = jnp.clip(ratio, 1 - clip, 1 + clip)
    return jnp.minimum(ratio * advantage, bounded * advantage)


def means(network: Network, actor: Weights, hidden: jax.Array, took: Took) -> jax.Array:
    """Mean actions (U, N, 3) of what the network saw, from what it remembered (N, 2, H) before."""
    if network.kind == "mlp":
        return network.apply(actor, hidden[None], took.numbers)[1]

    def one(hidden: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        numbers, fresh = now
        kept = jnp.where(fresh[:, None, None], 0.0, hidden)
        return network.apply(actor, kept, numbers)

    return jax.lax.scan(one, hidden, (took.numbers, took.fresh))[1]


def loss(
    ppo: PPO,
    network: Network,
    weights: Weights,
    hidden: jax.Array,
    took: Took,
    advantage: jax.Array,
    target: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """The loss of a batch of worlds, and the divergence from the policy that acted.

    Args:
      ppo: the algorithm's numbers.
      network: of the law.
      weights: as in `Student`.
      hidden: (N, 2, H) what the network remembered before the first decision.
      took: what happened.
      advantage: (U, N) [1] of the decisions, normalised.
      target: (U, N) [1] what the value function should have said.
    """
    mean = means(network, weights["actor"], hidden, took)
    change = log_prob(took.action, mean, weights["log_std"]) - took.log_prob
    ratio = jnp.exp(change)
    gain = jnp.mean(surrogate(ratio, advantage, ppo.clip))
    value = networks.critic(weights["critic"], pair(took.numbers, took.private))
    wrong = jnp.mean((value - target) ** 2)
    entropy = jnp.sum(weights["log_std"])
    divergence = jnp.mean(ratio - 1 - change)
    return 0.5 * wrong - gain - ppo.entropy * entropy, divergence


def improve(
    ppo: PPO, network: Network, student: Student, key: jax.Array, hidden: jax.Array, took: Took
) -> tuple[Student, jax.Array]:
    """The student after all passes over what happened, and the mean divergence of their steps."""
    advantage = advantages(took, ppo.discount, ppo.decay)
    target = advantage + took.value
    advantage = (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-6)
    count = hidden.shape[0]
    size = count // ppo.batches
    orders = jax.vmap(lambda k: jax.random.permutation(k, count))(jax.random.split(key, ppo.epochs))
    batches = orders[:, : size * ppo.batches].reshape(-1, size)

    def step(carry: Any, batch: jax.Array) -> tuple[Any, jax.Array]:
        weights, optimiser, rate = carry
        some = jax.tree.map(lambda x: x[:, batch], (took, advantage, target))
        to = partial(loss, ppo, network)
        (_, divergence), slope = jax.value_and_grad(to, has_aux=True)(weights, hidden[batch], *some)
        way, optimiser = _optimiser().update(slope, optimiser)
        weights = jax.tree.map(lambda w, x: w - rate * x, weights, way)
        weights["log_std"] = jnp.clip(weights["log_std"], *_LOG_STD)
        rate = jnp.where(divergence > 2 * ppo.divergence, rate / 1.2, rate)
        rate = jnp.where(divergence < 0.5 * ppo.divergence, rate * 1.2, rate)
        return (weights, optimiser, jnp.clip(rate, 2e-5, 3e-3)), divergence

    begun = student.weights, student.optimiser, student.learning_rate
    (weights, optimiser, rate), divergence = jax.lax.scan(step, begun, batches)
    smoothed = jax.tree.map(lambda a, b: 0.95 * a + 0.05 * b, student.smoothed, weights["actor"])
    return Student(weights, smoothed, optimiser, rate), jnp.mean(divergence)


def _optimiser() -> optax.GradientTransformation:
    """Adam without a rate, of gradients of a norm of 1 at most."""
    return optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam(eps=1e-5))
