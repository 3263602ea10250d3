"""Proximal policy optimisation (Schulman et al. 2017) of a law that senses taxels.

The network is updated by several passes over transitions in many worlds. The value function is
given more than the law can observe: where the object is, how large it is, and how much time is
left. The learning rate follows the KL divergence between the policies before and after a
step, and not the clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from rps_jax.control.learned import features
from rps_jax.control.learned import network as networks
from rps_jax.control.learned.network import Network, NetworkKind, Weights
from rps_jax.record.options import option

PRIVATE_SIGNS = np.array([1, -1, 1, 1, 1], np.float32)  # of what is `private`, under the mirror
_LOG_STD = (-2.5, 0.5)  # bounds on the logarithm of the standard deviation of an action


@dataclass(frozen=True, kw_only=True)
class PPO:
    """How a law is learned: the network, and the numbers of the algorithm."""

    network: NetworkKind = "gru"
    """The network: mlp, two layers without a memory; or gru, with a recurrent layer."""
    width: int = option(64, 1, 1024)
    """Pairs of units in a hidden layer; each pair stands for a world and its mirror image."""
    hold: float = option(0.2, above=0, at_most=1000, unit="s")
    """Time for which an action is carried out [s]."""
    num_envs: int = option(1024, 1, 1_000_000)
    """Number of worlds of each shape of object (and domain) that are stepped at once."""
    num_steps: int = option(32, 1, 1000)
    """Number of actions of each world in an update."""
    update_epochs: int = option(4, 1, 1000)
    """Number of passes over the transitions of an update."""
    num_minibatches: int = option(8, 1, 1000)
    """Number of minibatches of worlds in a pass, each of which is a step of the optimiser."""
    discount_time: float = option(30.0, above=0, at_most=1000, unit="s")
    """Time after which a reward counts 1/e of what it counts at once [s]; it gives gamma."""
    gae_time: float = option(5.0, above=0, at_most=1000, unit="s")
    """Time over which rewards are summed before the value function stands for the rest [s]; it
    gives lambda of generalised advantage estimation."""
    clip_eps: float = option(0.2, above=0, at_most=1)
    """Bound on the change of an action's probability [1]."""
    ent_coef: float = option(0.005, 0, 1)
    """Bonus for the entropy of the actions [1]."""
    learning_rate: float = option(1e-3, above=0, at_most=1)
    """Learning rate of the first step; it follows the KL divergence of the policies."""
    target_kl: float = option(0.01, above=0, at_most=1)
    """KL divergence of a step's policy from the one that acted, which the learning rate keeps
    to."""
    level: float = option(0.15, above=0, at_most=1)
    """Share of the domain's bearings and distances with which the curriculum begins, up to 1."""
    enough: float = option(0.7, 0, 1)
    """Share of successes with which the level rises."""

    @property
    def gamma(self) -> float:
        """Discount of a reward at the next action [1]."""
        return math.exp(-self.hold / self.discount_time)

    @property
    def gae_lambda(self) -> float:
        """Lambda of generalised advantage estimation [1]."""
        return math.exp(-self.hold / self.gae_time)


class TrainState(NamedTuple):
    """Weights of the policy and the value function, and the state of their optimiser."""

    weights: Weights  # "actor", "critic", and "log_std" (3,) of the actions
    ema: Weights  # "actor" averaged over the last updates, which is the law
    optimiser: Any
    learning_rate: jax.Array  # ()

    @classmethod
    def init(cls, ppo: PPO, network: Network, key: jax.Array) -> TrainState:
        """State before the first update."""
        actor, critic = jax.random.split(key)
        inputs = features.feature_count(network.taxels) + PRIVATE_SIGNS.size
        weights: Weights = {
            "actor": network.init(actor),
            "critic": networks.init_weights(networks.critic_shapes(inputs, ppo.width), critic),
            "log_std": jnp.full(3, math.log(0.6)),
        }
        ema = jax.tree.map(jnp.copy, weights["actor"])
        return cls(weights, ema, _optimiser().init(weights), jnp.asarray(ppo.learning_rate, float))


class Transition(NamedTuple):
    """Transitions of worlds; leaves (T, N, ...)."""

    obs: jax.Array  # (F,) inputs of the network
    private: jax.Array  # (P,) inputs of the value function alone
    first: jax.Array  # () bool: of its trial
    action: jax.Array  # (3,) [1] before it was bounded
    log_prob: jax.Array  # ()
    value: jax.Array  # () before
    next_value: jax.Array  # () after, and before a world begins anew
    reward: jax.Array  # ()
    done: jax.Array  # () bool: terminated or truncated
    terminated: jax.Array  # () bool: nothing can be earned afterwards, as after a success


# --- the algorithm -------------------------------------------------------------------------


def advantages(steps: Transition, gamma: float, gae_lambda: float) -> jax.Array:
    """Generalised advantage estimates (T, N) (Schulman et al. 2016, Eq. 16).

    A truncated trial, which ran out of time, goes on by the value function.
    """
    next_value = jnp.where(steps.terminated, 0.0, steps.next_value)
    delta = steps.reward + gamma * next_value - steps.value

    def back(later: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        delta, done = now
        found = delta + gamma * gae_lambda * jnp.where(done, 0.0, later)
        return found, found

    return jax.lax.scan(back, jnp.zeros_like(delta[0]), (delta, steps.done), reverse=True)[1]


def critic_inputs(obs: jax.Array, private: jax.Array) -> jax.Array:
    """Inputs (..., 2, F + P) of the value function, of the world and of its mirror image."""
    signs = jnp.asarray(PRIVATE_SIGNS, private.dtype)
    both = jnp.stack([private, signs * private], axis=-2)
    return jnp.concatenate([networks.mirror_pairs(obs), both], axis=-1)


def log_prob(action: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """Logarithm (...) of the density of actions (..., 3) [1]: normal, independent."""
    z = (action - mean) / jnp.exp(log_std)
    return jnp.sum(-0.5 * z * z - log_std - 0.5 * math.log(2 * math.pi), axis=-1)


def surrogate(ratio: jax.Array, advantage: jax.Array, clip_eps: float) -> jax.Array:
    """Clipped surrogate objective (...), to be maximised (Schulman et al. 2017, Eq. 7)."""
    bounded = jnp.clip(ratio, 1 - clip_eps, 1 + clip_eps)
    return jnp.minimum(ratio * advantage, bounded * advantage)


def means(network: Network, actor: Weights, hidden: jax.Array, steps: Transition) -> jax.Array:
    """Mean actions (T, N, 3), from the hidden state (N, 2, H) before the first of them."""
    if network.kind == "mlp":
        return network.apply(actor, hidden[None], steps.obs)[1]

    def one(hidden: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        obs, first = now
        kept = jnp.where(first[:, None, None], 0.0, hidden)
        return network.apply(actor, kept, obs)

    return jax.lax.scan(one, hidden, (steps.obs, steps.first))[1]


def loss(
    ppo: PPO,
    network: Network,
    weights: Weights,  # as in `TrainState`
    hidden: jax.Array,  # (N, 2, H) of the network before the first transition
    steps: Transition,  # leaves (T, N, ...)
    advantage: jax.Array,  # (T, N) [1], normalised
    target: jax.Array,  # (T, N) [1] of the value function
) -> tuple[jax.Array, jax.Array]:
    """Loss of a minibatch of worlds, and the KL divergence from the policy that acted."""
    mean = means(network, weights["actor"], hidden, steps)
    change = log_prob(steps.action, mean, weights["log_std"]) - steps.log_prob
    ratio = jnp.exp(change)
    gain = jnp.mean(surrogate(ratio, advantage, ppo.clip_eps))
    value = networks.critic(weights["critic"], critic_inputs(steps.obs, steps.private))
    wrong = jnp.mean((value - target) ** 2)
    entropy = jnp.sum(weights["log_std"])
    kl = jnp.mean(ratio - 1 - change)  # always positive, with little variance
    return 0.5 * wrong - gain - ppo.ent_coef * entropy, kl


def update_policy(
    ppo: PPO,
    network: Network,
    state: TrainState,
    key: jax.Array,
    hidden: jax.Array,
    steps: Transition,
) -> tuple[TrainState, jax.Array]:
    """Update weights by all passes over transitions; returns the mean KL divergence of the steps,
    too."""
    advantage = advantages(steps, ppo.gamma, ppo.gae_lambda)
    target = advantage + steps.value
    advantage = (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-6)
    count = hidden.shape[0]
    size = count // ppo.num_minibatches
    keys = jax.random.split(key, ppo.update_epochs)
    orders = jax.vmap(lambda k: jax.random.permutation(k, count))(keys)
    batches = orders[:, : size * ppo.num_minibatches].reshape(-1, size)

    def step(carry: Any, batch: jax.Array) -> tuple[Any, jax.Array]:
        weights, optimiser, rate = carry
        some = jax.tree.map(lambda x: x[:, batch], (steps, advantage, target))
        to = partial(loss, ppo, network)
        (_, kl), slope = jax.value_and_grad(to, has_aux=True)(weights, hidden[batch], *some)
        way, optimiser = _optimiser().update(slope, optimiser)
        weights = jax.tree.map(lambda w, x: w - rate * x, weights, way)
        weights["log_std"] = jnp.clip(weights["log_std"], *_LOG_STD)
        rate = jnp.where(kl > 2 * ppo.target_kl, rate / 1.2, rate)
        rate = jnp.where(kl < 0.5 * ppo.target_kl, rate * 1.2, rate)
        return (weights, optimiser, jnp.clip(rate, 2e-5, 3e-3)), kl

    begun = state.weights, state.optimiser, state.learning_rate
    (weights, optimiser, rate), kl = jax.lax.scan(step, begun, batches)
    ema = jax.tree.map(lambda a, b: 0.95 * a + 0.05 * b, state.ema, weights["actor"])
    return TrainState(weights, ema, optimiser, rate), jnp.mean(kl)


def _optimiser() -> optax.GradientTransformation:
    """Adam without a rate, of gradients of a norm of 1 at most."""
    return optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam(eps=1e-5))
