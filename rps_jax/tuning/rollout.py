"""Rollouts for PPO: many worlds in which the policy pushes, beginning anew as their trials end.

One update is one program: every world of every environment takes some actions, each of which is
carried out for several control steps; then `ppo` updates the network.

Curriculum: targets come from nearer and from more ahead, until the share of successes at a level
is reached; then the level rises, up to the domain's own targets.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rps_jax import errors
from rps_jax.control import soft
from rps_jax.control.learned import features
from rps_jax.control.learned import network as networks
from rps_jax.control.learned.network import Network, PolicyState, Weights
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import planar
from rps_jax.trials import trial
from rps_jax.trials.batch import rows
from rps_jax.trials.env import PushEnv, State
from rps_jax.trials.trial import World
from rps_jax.tuning import ppo as ppo_
from rps_jax.tuning.ppo import PPO, TrainState, Transition


class EnvBatch(NamedTuple):
    """Worlds of one environment under way; leaves (N, ...)."""

    states: State
    memory: PolicyState
    first: jax.Array  # (N,) bool: the trial has just begun
    earned: jax.Array  # (N,) [1] rewards of the trial so far


class EpisodeStats(NamedTuple):
    """How trials ended, and the time in contact: of worlds (N,), or sums over them."""

    ended: jax.Array  # () trials
    won: jax.Array  # () of these
    tipped: jax.Array  # () of these: the object fell over
    lost: jax.Array  # () of these: without contact for too long
    earned: jax.Array  # () [1] rewards of these
    touching: jax.Array  # () actions that ended in contact


class RunnerState(NamedTuple):
    """All of a learning run that changes from update to update."""

    train: TrainState
    level: jax.Array  # () [1] of the curriculum
    ended: jax.Array  # () recent trials, of late ones more
    won: jax.Array  # () recent successes
    key: jax.Array
    batches: tuple[EnvBatch, ...]


def network_of(ppo: PPO, envs: Sequence[PushEnv]) -> Network:
    """The network for these environments, whose skins must have as many taxels."""
    counts = {env.observation_size - 2 for env in envs}
    if len(counts) > 1:
        raise errors.InputError(
            f"domains with skins of {sorted(counts)} taxels are not allowed: learn in one of them."
        )
    return Network(ppo.network, ppo.width, counts.pop(), ppo.hold).check()


def begin(
    ppo: PPO, network: Network, envs: Sequence[PushEnv], tables: Sequence[World], *, seed: int = 0
) -> RunnerState:
    """State before the first update, with every trial at a moment of its own."""
    key, first, *own = jax.random.split(jax.random.PRNGKey(seed), 2 + len(envs))
    level = jnp.asarray(ppo.level, float)
    batches = []
    for env, table, one in zip(envs, tables, own, strict=True):
        one, late = jax.random.split(one)
        batch = _anew(network, env, table, level, one, ppo.num_envs)
        most = int(float(env.setting.rules.horizon) / env.dt)
        steps = jax.random.randint(late, (ppo.num_envs,), 0, most)
        states = batch.states.replace(data=batch.states.data._replace(steps=steps))
        batches.append(batch._replace(states=states))
    zero = jnp.zeros(())
    train = TrainState.init(ppo, network, first)
    return RunnerState(train, level, zero, zero, key, tuple(batches))


def eased(world: World, level: jax.Array) -> World:
    """The world with its target nearer and more ahead: at a level of 1 it is its own."""
    x, y = world.p_world_target
    distance, bearing = jnp.hypot(x, y), level * jnp.arctan2(y, x)
    near = jnp.minimum(distance, 0.8)  # [m] outside robot and object
    length = near + level * (distance - near)
    target = length * jnp.stack([jnp.cos(bearing), jnp.sin(bearing)])
    return world._replace(p_world_target=jnp.where(level < 1, target, world.p_world_target))


def _anew(
    network: Network, env: PushEnv, table: World, level: jax.Array, key: jax.Array, count: int
) -> EnvBatch:
    """Random worlds at their start: one in five of a lower level, while there is a lower one."""

    def one(key: jax.Array) -> tuple[State, PolicyState]:
        which, noise, lower = jax.random.split(key, 3)
        index = jax.random.randint(which, (), 0, env.worlds)
        u = jax.random.uniform(lower)
        own = jnp.where((u < 0.2) & (level < 1), 5 * u, 1.0) * level
        world = eased(rows(table, index), own)
        state = env.begin(world._replace(key=jax.random.key_data(noise)), index)
        return state, _first_felt(network, state)

    states, memory = jax.vmap(one)(jax.random.split(key, count))
    return EnvBatch(states, memory, jnp.ones(count, bool), jnp.zeros(count))


def _first_felt(network: Network, state: State) -> PolicyState:
    """State of the law after its first observation."""
    memory = PolicyState.init(network, state.obs.dtype)
    return memory._replace(touch_state=memory.touch_state.update(state.info["observation"]))


def _private(env: PushEnv, state: State) -> jax.Array:
    """Inputs (P,) of the value function alone: the object's place and size, the time left."""
    data, world, rules = state.data, state.info["world"], env.setting.rules
    place, _ = trial.object_pose(data.qpos)
    p_robot_object = planar.rotate(-data.qpos[2], place - data.qpos[:2])
    left = 1 - data.steps * env.dt / rules.horizon
    lost = data.lost_steps * env.dt / jnp.maximum(rules.max_lost, 1.0)
    numbers = [*jnp.clip(p_robot_object, -3, 3), fp.circumradius(world.footprint) / 0.3, left, lost]
    return jnp.stack(numbers)


def _seen(env: PushEnv, batch: EnvBatch) -> tuple[jax.Array, jax.Array]:
    """Inputs of the network (N, F), and those of the value function alone (N, P)."""
    memory, seen = batch.memory, batch.states.info["observation"]
    obs = jax.vmap(features.compute_features)(memory.touch_state, memory.action, seen)
    return obs, jax.vmap(partial(_private, env))(batch.states)


def carry_out(
    env: PushEnv, network: Network, batch: EnvBatch, hidden: jax.Array, action: jax.Array
) -> tuple[EnvBatch, jax.Array]:
    """Carry out an action (N, 3) of each world; returns the batch and the rewards (N,)."""
    bounded = features.clip_action(action)
    felt = jax.vmap(type(batch.memory.touch_state).mark_decision)(
        batch.memory.touch_state, batch.states.info["observation"]
    )
    update = jax.vmap(type(felt).update)

    def one(carry: Any, _: None) -> tuple[Any, None]:
        states, felt, reward = carry
        states = jax.vmap(env.step)(states, bounded)
        return (states, update(felt, states.info["observation"]), reward + states.reward), None

    begun = batch.states, felt, jnp.zeros_like(batch.earned)
    steps = round(network.hold / env.dt)
    (states, felt, reward), _ = jax.lax.scan(one, begun, length=steps)
    memory = batch.memory._replace(touch_state=felt, hidden=hidden, action=bounded)
    earned = batch.earned + reward
    return EnvBatch(states, memory, jnp.zeros_like(batch.first), earned), reward


def _verdict(env: PushEnv, batch: EnvBatch) -> tuple[EpisodeStats, jax.Array]:
    """Statistics of the trials that have ended, and which of them are terminated (N,) bool.

    A trial that ran out of time, or of time without contact, is truncated: it could have gone on.
    """
    data = batch.states.data
    stats = EpisodeStats(
        ended=data.done,
        won=data.success,
        tipped=data.tipped,
        lost=data.done & (data.lost_steps * env.dt > env.setting.rules.max_lost),
        earned=jnp.where(data.done, batch.earned, 0.0),
        touching=batch.states.metrics["in_contact"],
    )
    return stats, data.done & (data.success | data.tipped | data.diverged)


def _act(
    ppo: PPO,
    network: Network,
    envs: Sequence[PushEnv],
    tables: Sequence[World],
    runner: RunnerState,
    carry: tuple[tuple[EnvBatch, ...], jax.Array],
    _: None,
) -> tuple[tuple[tuple[EnvBatch, ...], jax.Array], tuple[Transition, EpisodeStats]]:
    """Take one action in all worlds; returns its transition, and statistics of ended trials."""
    batches, key = carry
    key, noise, *starts = jax.random.split(key, 2 + len(envs))
    weights, count = runner.train.weights, ppo.num_envs

    def together(parts: Sequence[jax.Array]) -> jax.Array:
        return jnp.concatenate(list(parts))

    seen = [_seen(env, batch) for env, batch in zip(envs, batches, strict=True)]
    obs, private = (together(parts) for parts in zip(*seen, strict=True))
    before = together([batch.memory.hidden for batch in batches])
    first = together([batch.first for batch in batches])
    hidden, mean = network.apply(weights["actor"], before, obs)
    noise = jax.random.normal(noise, mean.shape, mean.dtype)
    action = mean + jnp.exp(weights["log_std"]) * noise
    went, after, rewards = [], [], []
    for i, (env, batch) in enumerate(zip(envs, batches, strict=True)):
        own = slice(i * count, (i + 1) * count)
        batch, reward = carry_out(env, network, batch, hidden[own], action[own])
        went.append(batch)
        after.append(_seen(env, batch))
        rewards.append(reward)
    pairs = ppo_.critic_inputs(*(together(parts) for parts in zip(*after, strict=True)))
    verdicts = [_verdict(env, batch) for env, batch in zip(envs, went, strict=True)]
    stats, terminated = jax.tree.map(lambda *parts: together(parts), *verdicts)
    pick = jax.vmap(soft.tree_where)
    begun = tuple(
        pick(batch.states.data.done, _anew(network, env, table, runner.level, at, count), batch)
        for env, table, at, batch in zip(envs, tables, starts, went, strict=True)
    )
    steps = Transition(
        obs,
        private,
        first,
        action,
        ppo_.log_prob(action, mean, weights["log_std"]),
        networks.critic(weights["critic"], ppo_.critic_inputs(obs, private)),
        networks.critic(weights["critic"], pairs),
        together(rewards),
        stats.ended,
        terminated,
    )
    return (begun, key), (steps, jax.tree.map(jnp.sum, stats))


def update(
    ppo: PPO,
    network: Network,
    envs: Sequence[PushEnv],
    tables: Sequence[World],
    runner: RunnerState,
) -> tuple[RunnerState, dict[str, jax.Array]]:
    """Make one update; returns the state after it, and the update's metrics () for the curve.

    Each of `envs` is of one shape of object and domain. Their worlds, `tables`, are data and no
    constants of the program.
    """
    hidden = jnp.concatenate([batch.memory.hidden for batch in runner.batches])
    key, own, passes = jax.random.split(runner.key, 3)
    act = partial(_act, ppo, network, envs, tables, runner)
    carry = runner.batches, own
    (batches, _), (steps, every) = jax.lax.scan(act, carry, length=ppo.num_steps)
    stats = jax.tree.map(jnp.sum, every)
    train, kl = ppo_.update_policy(ppo, network, runner.train, passes, hidden, steps)
    learned = runner._replace(train=train, key=key, batches=batches)
    metrics = stats._asdict() | {
        "touching": stats.touching / steps.reward.size,
        "level": runner.level,
        "reward": jnp.mean(steps.reward),
        "value": jnp.mean(steps.value),
        "kl": kl,
        "learning_rate": runner.train.learning_rate,
        "spread": jnp.exp(jnp.mean(runner.train.weights["log_std"])),
    }
    return _graded(ppo, learned, stats.ended, stats.won), metrics


def _graded(ppo: PPO, runner: RunnerState, ended: jax.Array, won: jax.Array) -> RunnerState:
    """Raise the level of the curriculum, if enough trials succeed; they are then counted anew."""
    ended, won = 0.9 * runner.ended + ended, 0.9 * runner.won + won
    worlds = ppo.num_envs * len(runner.batches)
    up = (ended > 0.2 * worlds) & (won > ppo.enough * ended) & (runner.level < 1)
    level = jnp.where(up, jnp.minimum(runner.level + 0.05, 1.0), runner.level)
    ended, won = (jnp.where(up, 0.5 * x, x) for x in (ended, won))
    return runner._replace(level=level, ended=ended, won=won)


def rollout(network: Network, env: PushEnv, table: World, actor: Weights) -> State:
    """Push in the worlds of an environment by the policy, noiseless; return their last states."""

    def one(index: jax.Array) -> tuple[State, PolicyState]:
        state = env.begin(rows(table, index), index)
        return state, _first_felt(network, state)

    states, memory = jax.vmap(one)(jnp.arange(env.worlds))
    batch = EnvBatch(states, memory, jnp.ones(env.worlds, bool), jnp.zeros(env.worlds))

    def on(batch: EnvBatch) -> EnvBatch:
        obs, _ = _seen(env, batch)
        hidden, mean = network.apply(actor, batch.memory.hidden, obs)
        return carry_out(env, network, batch, hidden, mean)[0]

    def some_run(batch: EnvBatch) -> jax.Array:
        return ~jnp.all(batch.states.data.done)

    return jax.lax.while_loop(some_run, on, batch).states


def evaluate_policy(
    network: Network, envs: Sequence[PushEnv], tables: Sequence[World], actor: Weights
) -> tuple[jax.Array, jax.Array]:
    """Success (N,) bool and time (N,) [s] of the law in all worlds, one environment by one."""
    each = [
        rollout(network, env, table, actor).data for env, table in zip(envs, tables, strict=True)
    ]
    steps = [data.steps * env.dt for data, env in zip(each, envs, strict=True)]
    return jnp.concatenate([data.success for data in each]), jnp.concatenate(steps)
