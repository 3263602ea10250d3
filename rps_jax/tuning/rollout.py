"""Rollouts for PPO: the policy pushes in many worlds, and worlds restart when their trials end.

One update is one program. Every world of every environment takes several actions, each of them
held for several control steps; then `ppo` updates the network.

Curriculum: at a low level targets are near and ahead. The level rises when enough trials succeed,
up to the targets of the domain. Tasks with a path have no curriculum.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from rps_jax import errors
from rps_jax.control import soft
from rps_jax.control.learned import features
from rps_jax.control.learned import network as networks
from rps_jax.control.learned.features import TouchState
from rps_jax.control.learned.network import Network, PolicyState, Weights
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import planar
from rps_jax.trials import trial
from rps_jax.trials.batch import rows
from rps_jax.trials.env import PushEnv, State
from rps_jax.trials.trial import World
from rps_jax.tuning import ppo as ppo_
from rps_jax.tuning.ppo import PPO, TrainState, Transition
from rps_jax.world.tasks.reach import Nothing

T = TypeVar("T")
ActCarry = tuple[State, TouchState, jax.Array]  # states, touch states, rewards (N,)


class EnvBatch(NamedTuple):
    """Running worlds of one environment; leaves (N, ...)."""

    states: State
    memory: PolicyState
    first: jax.Array  # (N,) bool: the trial has just started
    earned: jax.Array  # (N,) [1] rewards of the trial so far


Carry = tuple[tuple[EnvBatch, ...], jax.Array]  # batches and key, between two actions
Stats = dict[str, jax.Array]  # counts of ended trials, of worlds (N,) or sums over them, by name


class RunnerState(NamedTuple):
    """State of a learning run between two updates."""

    train: TrainState
    level: jax.Array  # () [1] of the curriculum
    ended: jax.Array  # () trials that ended, with exponentially decaying weights
    succeeded: jax.Array  # () successes, with the same weights
    key: jax.Array
    batches: tuple[EnvBatch, ...]


def network_of(ppo: PPO, envs: Sequence[PushEnv]) -> Network:
    """Return the network for these environments; their skins must have equally many taxels."""
    counts = {env.observation_size - 2 for env in envs}
    if len(counts) > 1:
        raise errors.not_allowed("taxels of the domains", sorted(counts), "learn in one domain")
    return Network(ppo.network, ppo.width, counts.pop(), ppo.hold).check()


def start(
    ppo: PPO, network: Network, envs: Sequence[PushEnv], tables: Sequence[World], *, seed: int = 0
) -> RunnerState:
    """Return the state before the first update, with every trial at a random time."""
    key, first, *keys = jax.random.split(jax.random.PRNGKey(seed), 2 + len(envs))
    level = jnp.asarray(ppo.level, float)
    batches = []
    for env, table, env_key in zip(envs, tables, keys, strict=True):
        env_key, time_key = jax.random.split(env_key)
        batch = _restart(network, env, table, level, env_key, ppo.num_envs)
        horizon_steps = int(float(env.setting.rules.horizon) / env.dt)
        steps = jax.random.randint(time_key, (ppo.num_envs,), 0, horizon_steps)
        states = batch.states.replace(data=batch.states.data._replace(steps=steps))
        batches.append(batch._replace(states=states))
    zero = jnp.zeros(())
    train = TrainState.init(ppo, network, first)
    return RunnerState(train, level, zero, zero, key, tuple(batches))


def ease(world: World, level: jax.Array) -> World:
    """Return a world with a nearer target, more ahead; unchanged at level 1, or with a path."""
    if not isinstance(world.task, Nothing):
        return world
    x, y = world.p_world_target
    distance, bearing = jnp.hypot(x, y), level * jnp.arctan2(y, x)
    near = jnp.minimum(distance, 0.8)  # [m] outside robot and object
    length = near + level * (distance - near)
    target = length * jnp.stack([jnp.cos(bearing), jnp.sin(bearing)])
    return world._replace(p_world_target=jnp.where(level < 1, target, world.p_world_target))


def _start(network: Network, env: PushEnv, worlds: World, index: jax.Array) -> EnvBatch:
    """Return worlds (N, ...) of these indices (N,) at their start, after the first observation."""

    def start_world(world: World, index: jax.Array) -> tuple[State, PolicyState]:
        state = env.begin(world, index)
        memory = PolicyState.init(network, state.obs.dtype)
        touch_state = memory.touch_state.update(state.info["observation"])
        return state, memory._replace(touch_state=touch_state)

    states, memory = jax.vmap(start_world)(worlds, index)
    return EnvBatch(states, memory, jnp.ones(index.size, bool), jnp.zeros(index.size))


def _restart(
    network: Network, env: PushEnv, table: World, level: jax.Array, key: jax.Array, count: int
) -> EnvBatch:
    """Return random worlds at their start; one in five has a random lower level, below level 1."""

    def draw_world(key: jax.Array) -> tuple[World, jax.Array]:
        index_key, noise_key, level_key = jax.random.split(key, 3)
        index = jax.random.randint(index_key, (), 0, env.worlds)
        u = jax.random.uniform(level_key)
        world_level = jnp.where((u < 0.2) & (level < 1), 5 * u, 1.0) * level
        world = ease(rows(table, index), world_level)
        return world._replace(key=jax.random.key_data(noise_key)), index

    return _start(network, env, *jax.vmap(draw_world)(jax.random.split(key, count)))


def _private(env: PushEnv, state: State) -> jax.Array:
    """Return the privileged inputs (P,): position and size of the object, remaining time."""
    data, world, rules = state.data, state.info["world"], env.setting.rules
    p_world_object, _ = trial.object_pose(data.qpos)
    p_robot_object = planar.rotate(-data.qpos[2], p_world_object - data.qpos[:2])
    remaining = 1 - data.steps * env.dt / rules.horizon
    lost = data.lost_steps * env.dt / jnp.maximum(rules.max_lost, 1.0)
    radius = fp.circumradius(world.footprint) / 0.3
    return jnp.stack([*jnp.clip(p_robot_object, -3, 3), radius, remaining, lost])


def _inputs(env: PushEnv, batch: EnvBatch) -> tuple[jax.Array, jax.Array]:
    """Return the inputs of the network (N, F) and the privileged inputs (N, P)."""
    memory, obs = batch.memory, batch.states.info["observation"]
    inputs = jax.vmap(features.compute_features)(memory.touch_state, memory.action, obs)
    return inputs, jax.vmap(partial(_private, env))(batch.states)


def act(
    env: PushEnv, network: Network, batch: EnvBatch, hidden: jax.Array, action: jax.Array,
    mapped: Callable[..., Any] = jax.vmap,
) -> tuple[EnvBatch, jax.Array]:  # fmt: skip
    """Execute an action (N, 3) in each world; return the batch and the rewards (N,).

    With `native.mapped` as `mapped`, derivatives are fastest.
    """
    bounded = features.clip_action(action)
    inputs = batch.memory.touch_state, batch.states.info["observation"]
    touch_state = jax.vmap(TouchState.mark_decision)(*inputs)

    def step(carry: ActCarry, _: None) -> tuple[ActCarry, None]:
        states, touch_state, reward = carry
        states = mapped(env.step, (0, 0))(states, bounded)
        touch_state = jax.vmap(TouchState.update)(touch_state, states.info["observation"])
        return (states, touch_state, reward + states.reward), None

    carry = batch.states, touch_state, jnp.zeros_like(batch.earned)
    steps = round(network.hold / env.dt)
    (states, touch_state, reward), _ = jax.lax.scan(step, carry, length=steps)
    memory = batch.memory._replace(touch_state=touch_state, hidden=hidden, action=bounded)
    earned = batch.earned + reward
    return EnvBatch(states, memory, jnp.zeros_like(batch.first), earned), reward


def _episode_stats(env: PushEnv, batch: EnvBatch) -> tuple[Stats, jax.Array]:
    """Return statistics of the trials that have ended, and whether each is terminated (N,).

    A trial that reached a time limit, with or without contact, is truncated and not terminated.
    """
    data = batch.states.data
    stats = {
        "ended": data.done,
        "succeeded": data.success,
        "tipped": data.tipped,
        "lost": data.done & (data.lost_steps * env.dt > env.setting.rules.max_lost),
        "earned": jnp.where(data.done, batch.earned, 0.0),  # [1] rewards
        "touching": batch.states.metrics["in_contact"],  # after an action
    }
    return stats, data.done & ~env.has_timed_out(data)


def _join(parts: Sequence[T]) -> T:
    """Concatenate the leaves of pytrees."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def update(
    ppo: PPO,
    network: Network,
    envs: Sequence[PushEnv],
    tables: Sequence[World],
    runner: RunnerState,
) -> tuple[RunnerState, dict[str, jax.Array]]:
    """Make one update; return the next state and the update's metrics () for the curve.

    Each of `envs` has one shape of object and one domain. Their worlds, `tables`, are inputs and
    not constants of the program.
    """

    def take_action(carry: Carry, _: None) -> tuple[Carry, tuple[Transition, Stats]]:
        """Take one action in all worlds; return its transition and statistics of ended trials."""
        batches, key = carry
        key, noise_key, *start_keys = jax.random.split(key, 2 + len(envs))
        weights, count = runner.train.weights, ppo.num_envs
        pairs = zip(envs, batches, strict=True)
        inputs = [(*_inputs(env, x), x.memory.hidden, x.first) for env, x in pairs]
        obs, private, previous_hidden, first = _join(inputs)
        hidden, mean = network.apply(weights["actor"], previous_hidden, obs)
        noise = jax.random.normal(noise_key, mean.shape, mean.dtype)
        action = mean + jnp.exp(weights["log_std"]) * noise
        restarted, results = [], []
        for i, (env, table, batch) in enumerate(zip(envs, tables, batches, strict=True)):
            worlds = slice(i * count, (i + 1) * count)
            batch, reward = act(env, network, batch, hidden[worlds], action[worlds])
            results.append((_inputs(env, batch), reward, *_episode_stats(env, batch)))
            start = _restart(network, env, table, runner.level, start_keys[i], count)
            restarted.append(jax.vmap(soft.tree_where)(batch.states.data.done, start, batch))
        next_inputs, reward, stats, terminated = _join(results)
        pairs = (ppo_.critic_inputs(*x) for x in ((obs, private), next_inputs))
        value, next_value = (networks.critic(weights["critic"], x) for x in pairs)
        log_prob = ppo_.log_prob(action, mean, weights["log_std"])
        decision = obs, private, first, action, log_prob, value
        steps = Transition(*decision, next_value, reward, stats["ended"], terminated)
        return (tuple(restarted), key), (steps, jax.tree.map(jnp.sum, stats))

    hidden = jnp.concatenate([batch.memory.hidden for batch in runner.batches])
    key, action_key, update_key = jax.random.split(runner.key, 3)
    carry = runner.batches, action_key
    (batches, _), (steps, step_stats) = jax.lax.scan(take_action, carry, length=ppo.num_steps)
    stats = jax.tree.map(jnp.sum, step_stats)
    train, kl = ppo_.update_policy(ppo, network, runner.train, update_key, hidden, steps)
    updated = runner._replace(train=train, key=key, batches=batches)
    metrics = stats | {
        "touching": stats["touching"] / steps.reward.size,
        "level": runner.level,
        "reward": jnp.mean(steps.reward),
        "value": jnp.mean(steps.value),
        "kl": kl,
        "learning_rate": runner.train.learning_rate,
        "spread": jnp.exp(jnp.mean(runner.train.weights["log_std"])),
    }
    return _raise_level(ppo, updated, stats), metrics


def _raise_level(ppo: PPO, runner: RunnerState, stats: Stats) -> RunnerState:
    """Raise the level of the curriculum if enough trials succeed, and then halve their counts."""
    ended = 0.9 * runner.ended + stats["ended"]
    succeeded = 0.9 * runner.succeeded + stats["succeeded"]
    worlds = ppo.num_envs * len(runner.batches)
    up = (ended > 0.2 * worlds) & (succeeded > ppo.enough * ended) & (runner.level < 1)
    level = jnp.where(up, jnp.minimum(runner.level + 0.05, 1.0), runner.level)
    ended, succeeded = (jnp.where(up, 0.5 * x, x) for x in (ended, succeeded))
    return runner._replace(level=level, ended=ended, succeeded=succeeded)


def rollout(network: Network, env: PushEnv, table: World, actor: Weights) -> State:
    """Push by the policy without noise in all worlds of an environment; return the last states."""
    batch = _start(network, env, table, jnp.arange(env.worlds))

    def step(batch: EnvBatch) -> EnvBatch:
        hidden, mean = network.apply(actor, batch.memory.hidden, _inputs(env, batch)[0])
        return act(env, network, batch, hidden, mean)[0]

    return jax.lax.while_loop(lambda batch: ~jnp.all(batch.states.data.done), step, batch).states


def evaluate_policy(
    network: Network, envs: Sequence[PushEnv], tables: Sequence[World], actor: Weights
) -> tuple[jax.Array, jax.Array]:
    """Return success (N,) bool and time (N,) [s] of the law in all worlds of all environments."""
    results = []
    for env, table in zip(envs, tables, strict=True):
        data = rollout(network, env, table, actor).data
        results.append((data.success, data.steps * env.dt))
    return _join(results)
