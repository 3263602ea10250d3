"""Proximal policy optimisation (Schulman et al. 2017) of a law that senses taxels.

Each update makes several passes over transitions from many worlds. The value function has inputs
that the law cannot observe (`Privileged`). The learning rate follows the KL divergence between the
acting policy and the updated one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from rps_jax.control.learned import features
from rps_jax.control.learned import network as networks
from rps_jax.control.learned.network import Network, NetworkKind, Weights
from rps_jax.control.learned.policy import read
from rps_jax.geometry.arrays import Array, Pair
from rps_jax.record.options import option

_LOG_STD = (-2.5, 0.5)  # bounds on the log standard deviation of an action
_CRITIC_RATE = 1e-3  # learning rate while the value function alone is learned
UpdateCarry = tuple[Weights, optax.OptState, Array]  # weights, optimiser, learning rate


class Privileged(NamedTuple):
    """Inputs of the value function that the law cannot observe; all are ()."""

    ahead: Array  # [m] of the object in the robot frame, within 3 m
    left: Array  # [m]
    radius: Array  # [0.3 m] circumradius of the object
    remaining: Array  # [1] share of the horizon
    lost: Array  # [1] time without contact, as a share of what the rules allow
    tilt_ahead: Array  # [1] of the object's axis, three times its component
    tilt_left: Array  # [1]
    height: Array  # [m] of the object's centre at the start
    room: Array  # [m] between base or object and the nearest wall, within 1 m


_MIRRORED = ("left", "tilt_left")  # they change their signs in the mirror image
PRIVILEGED_SIGNS = np.array([-1 if x in _MIRRORED else 1 for x in Privileged._fields], np.float32)


@dataclass(frozen=True, kw_only=True)
class PPO:
    """Options of learning: the network and the constants of PPO."""

    network: NetworkKind = "gru"
    """Network: mlp has two layers without memory; gru has a recurrent layer."""
    width: int = option(64, 1, 1024)
    """Number of pairs of units in a hidden layer, one unit for the world and one for its mirror
    image."""
    hold: float = option(0.2, above=0, at_most=1000, unit="s")
    """Time for which an action is held [s]."""
    num_envs: int = option(1024, 1, 1_000_000)
    """Number of worlds of each shape of object (and domain) that are stepped at once."""
    num_steps: int = option(32, 1, 1000)
    """Number of actions of each world in an update."""
    update_epochs: int = option(4, 1, 1000)
    """Number of passes over the transitions of an update."""
    num_minibatches: int = option(8, 1, 1000)
    """Number of minibatches of worlds in a pass, each of which is a step of the optimiser."""
    discount_time: float = option(30.0, above=0, at_most=1000, unit="s")
    """Time constant of the discount of rewards [s]; it gives gamma."""
    gae_time: float = option(5.0, above=0, at_most=1000, unit="s")
    """Time constant of generalised advantage estimation [s]; it gives lambda."""
    clip_eps: float = option(0.2, above=0, at_most=1)
    """Bound on the change of an action's probability [1]."""
    ent_coef: float = option(0.005, 0, 1)
    """Bonus for the entropy of the actions [1]."""
    learning_rate: float = option(1e-3, above=0, at_most=1)
    """Learning rate of the first step; it follows the KL divergence of the policies."""
    target_kl: float = option(0.01, above=0, at_most=1)
    """KL divergence of the updated policy from the acting one that the learning rate maintains."""
    initial_level: float = option(0.15, above=0, at_most=1)
    """Initial level of the curriculum: share of the domain's bearings and distances, up to 1. With
    an initial law it is 1."""
    success_threshold: float = option(0.7, 0, 1)
    """Success rate at which the level rises."""
    initial: str | None = None
    """Initial law: learned, learned_small or the file of a policy. By default random weights."""
    value_updates: int = option(30, 0, 10**6)
    """Number of first updates that change the value function alone; only with an initial law."""
    action_std: float = option(0.6, 0.09, 1.6)
    """Initial standard deviation of the actions [1]; of an initial law rather 0.25."""
    prioritised: float = option(0.0, 0, 1)
    """Share of trials whose worlds are drawn by prioritised sampling: most often those that
    sometimes fail."""
    anneal: float = option(0.0, 0, 1)
    """Share of the run, at its end, in which target_kl, ent_coef and the greatest learning rate
    fall to a twentieth."""
    ema_updates: int = option(20, 1, 100_000)
    """Number of updates over which the weights of the law are averaged, with exponential decay."""

    @property
    def gamma(self) -> float:
        """Discount of a reward at the next action [1]."""
        return math.exp(-self.hold / self.discount_time)

    @property
    def gae_lambda(self) -> float:
        """Lambda of generalised advantage estimation [1]."""
        return math.exp(-self.hold / self.gae_time)

    def schedule(self, progress: Array, updates: Array) -> Pair:
        """Return the factor () of annealed options, after a share of the run, and whether the
        policy is frozen () bool, after a number of updates."""
        factor = jnp.clip((1 - progress) / max(self.anneal, 1e-6), 0.05, 1)
        return factor, (updates < self.value_updates) & bool(self.initial)


class TrainState(NamedTuple):
    """Weights of the policy and the value function, and the state of their optimiser."""

    weights: Weights  # "actor", "critic", and "log_std" (A,) of the actions
    ema: Weights  # "actor" averaged over the last updates, which is the law
    optimiser: optax.OptState
    learning_rate: Array  # ()

    @classmethod
    def init(cls, ppo: PPO, network: Network, key: Array) -> TrainState:
        """State before the first update."""
        actor, critic = jax.random.split(key)
        inputs = features.feature_count(network.taxels) + PRIVILEGED_SIGNS.size
        weights: Weights = {
            "actor": read(ppo.initial).weights if ppo.initial else network.init(actor),
            "critic": networks.init_weights(networks.critic_shapes(inputs, ppo.width), critic),
            "log_std": jnp.full(network.actions, math.log(ppo.action_std)),
        }
        ema = jax.tree.map(jnp.copy, weights["actor"])
        return cls(weights, ema, _optimiser().init(weights), jnp.asarray(ppo.learning_rate, float))


class Transition(NamedTuple):
    """Transitions of N worlds in T actions; leaves (T, N, ...)."""

    obs: Array  # (F,) inputs of the network
    privileged: Array  # (P,) inputs of the value function alone
    first: Array  # () bool: first of its trial
    action: Array  # (A,) [1] unbounded
    log_prob: Array  # ()
    value: Array  # () before the action
    next_value: Array  # () after the action, before a restart of the world
    reward: Array  # ()
    done: Array  # () bool: terminated or truncated
    terminated: Array  # () bool: ended with no later reward, as after a success


# --- the algorithm -------------------------------------------------------------------------


def advantages(steps: Transition, gamma: float, gae_lambda: float) -> Array:
    """Return generalised advantage estimates (T, N) (Schulman et al. 2016, Eq. 16).

    A truncated trial, which reached a time limit, is continued by the value function.
    """
    next_value = jnp.where(steps.terminated, 0.0, steps.next_value)
    delta = steps.reward + gamma * next_value - steps.value

    def backward(later: Array, step: Pair) -> Pair:
        delta, done = step
        advantage = delta + gamma * gae_lambda * jnp.where(done, 0.0, later)
        return advantage, advantage

    return jax.lax.scan(backward, jnp.zeros_like(delta[0]), (delta, steps.done), reverse=True)[1]


def critic_inputs(obs: Array, privileged: Array) -> Array:
    """Return inputs (..., 2, F + P) of the value function, for the world and its mirror image."""
    signs = jnp.asarray(PRIVILEGED_SIGNS, privileged.dtype)
    both = jnp.stack([privileged, signs * privileged], axis=-2)
    return jnp.concatenate([networks.mirror_pairs(obs), both], axis=-1)


def log_prob(action: Array, mean: Array, log_std: Array) -> Array:
    """Return the log density (...) of actions (..., A) [1], independent and normal."""
    z = (action - mean) / jnp.exp(log_std)
    return jnp.sum(-0.5 * z * z - log_std - 0.5 * math.log(2 * math.pi), axis=-1)


def surrogate(ratio: Array, advantage: Array, clip_eps: float) -> Array:
    """Return the clipped surrogate objective (...) to maximise (Schulman et al. 2017, Eq. 7)."""
    bounded = jnp.clip(ratio, 1 - clip_eps, 1 + clip_eps)
    return jnp.minimum(ratio * advantage, bounded * advantage)


def means(network: Network, actor: Weights, hidden: Array, steps: Transition) -> Array:
    """Return mean actions (T, N, A), from the hidden state (N, 2, H) before the first action."""
    if network.kind == "mlp":
        return network.apply(actor, hidden[None], steps.obs)[1]

    def apply(hidden: Array, step: Pair) -> Pair:
        obs, first = step
        hidden = jnp.where(first[:, None, None], 0.0, hidden)
        return network.apply(actor, hidden, obs)

    return jax.lax.scan(apply, hidden, (steps.obs, steps.first))[1]


def loss(
    ppo: PPO,
    network: Network,
    weights: Weights,  # as in `TrainState`
    hidden: Array,  # (N, 2, H) of the network before the first transition
    steps: Transition,  # leaves (T, N, ...)
    advantage: Array,  # (T, N) [1], normalised
    target: Array,  # (T, N) [1] of the value function
    schedule: Array | float = 1.0,  # () factor of ent_coef
) -> Pair:
    """Return the loss of a minibatch of worlds, and the KL divergence from the acting policy."""
    mean = means(network, weights["actor"], hidden, steps)
    change = log_prob(steps.action, mean, weights["log_std"]) - steps.log_prob
    ratio = jnp.exp(change)
    gain = jnp.mean(surrogate(ratio, advantage, ppo.clip_eps))
    value = networks.critic(weights["critic"], critic_inputs(steps.obs, steps.privileged))
    value_loss = jnp.mean((value - target) ** 2)
    entropy = jnp.sum(weights["log_std"])
    kl = jnp.mean(ratio - 1 - change)  # always positive, with little variance
    return 0.5 * value_loss - gain - schedule * ppo.ent_coef * entropy, kl


def update_policy(
    ppo: PPO,
    network: Network,
    state: TrainState,
    key: Array,
    hidden: Array,
    steps: Transition,
    schedule: Array | float = 1.0,  # () factor of annealed options
    frozen: Array | bool = False,  # () bool: whether the policy does not change
) -> tuple[TrainState, Array]:
    """Update the weights by all passes over transitions; return the new state and the mean KL
    divergence of the steps."""
    advantage = advantages(steps, ppo.gamma, ppo.gae_lambda)
    target = advantage + steps.value
    advantage = (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-6)
    count = hidden.shape[0]
    size = count // ppo.num_minibatches
    keys = jax.random.split(key, ppo.update_epochs)
    orders = jax.vmap(lambda k: jax.random.permutation(k, count))(keys)
    batches = orders[:, : size * ppo.num_minibatches].reshape(-1, size)

    def step(carry: UpdateCarry, batch: Array) -> tuple[UpdateCarry, Array]:
        weights, optimiser, rate = carry
        data = jax.tree.map(lambda x: x[:, batch], (steps, advantage, target))
        loss_of = partial(loss, ppo, network)
        inputs = weights, hidden[batch], *data, schedule
        (_, kl), slope = jax.value_and_grad(loss_of, has_aux=True)(*inputs)
        change, optimiser = _optimiser().update(slope, optimiser)
        speed = jnp.where(frozen, _CRITIC_RATE, rate)
        moved = jax.tree.map(lambda w, x: w - speed * x, weights, change)
        moved["log_std"] = jnp.clip(moved["log_std"], *_LOG_STD)
        weights = jax.tree.map(partial(jnp.where, frozen), weights, moved)
        weights["critic"] = moved["critic"]
        target_kl = schedule * ppo.target_kl
        factor = jnp.where(kl > 2 * target_kl, 1 / 1.2, jnp.where(kl < target_kl / 2, 1.2, 1.0))
        bounded = jnp.clip(rate * factor, 2e-5 * schedule, 3e-3 * schedule)
        return (weights, optimiser, jnp.where(frozen, rate, bounded)), kl

    carry = state.weights, state.optimiser, state.learning_rate
    (weights, optimiser, rate), kl = jax.lax.scan(step, carry, batches)
    ema = jax.tree.map(lambda a, b: a + (b - a) / ppo.ema_updates, state.ema, weights["actor"])
    return TrainState(weights, ema, optimiser, rate), jnp.mean(kl)


def _optimiser() -> optax.GradientTransformation:
    """Return Adam without a learning rate, for gradients clipped to a norm of 1."""
    return optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam(eps=1e-5))
