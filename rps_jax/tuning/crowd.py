"""The worlds in which a law is learned: many of them, pushed by it, beginning anew as they end.

One update is one program: every world of every environment takes some decisions, each of which is
carried out for several control steps; then `ppo` improves the network.

Curriculum: targets come from nearer and from more ahead, until the share of successes at a level
is reached; then the level rises, up to the domain's own targets.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rps_jax import errors
from rps_jax.control import switches
from rps_jax.control.learned import network as networks
from rps_jax.control.learned import observation
from rps_jax.control.learned.network import Memory, Network, Weights
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import planar
from rps_jax.trials import trial
from rps_jax.trials.batch import rows
from rps_jax.trials.env import PushEnv, State
from rps_jax.trials.trial import World
from rps_jax.tuning import ppo as ppo_
from rps_jax.tuning.ppo import PPO, Student, Took


class Crowd(NamedTuple):
    """The worlds of one environment while they are pushed; leaves lead with their number."""

    states: State
    memory: Memory
    fresh: jax.Array  # (N,) bool: the trial has just begun
    earned: jax.Array  # (N,) [1] rewards of the trial so far


class Tally(NamedTuple):
    """How trials ended, and the time in contact: of worlds (N,), or sums over them."""

    ended: jax.Array  # () trials
    won: jax.Array  # () of these
    tipped: jax.Array  # () of these: the object fell over
    lost: jax.Array  # () of these: without contact for too long
    earned: jax.Array  # () [1] rewards of these
    touching: jax.Array  # () decisions that ended in contact


class Learner(NamedTuple):
    """All of a learning run that changes."""

    student: Student
    level: jax.Array  # () [1] of the curriculum
    ended: jax.Array  # () recent trials, of late ones more
    won: jax.Array  # () recent successes
    key: jax.Array
    crowds: tuple[Crowd, ...]


def network_of(ppo: PPO, envs: Sequence[PushEnv]) -> Network:
    """The network for these environments.

    Raises:
      InputError: their skins have different numbers of taxels.
    """
    counts = {env.observation_size - 2 for env in envs}
    if len(counts) > 1:
        raise errors.InputError(
            f"domains with skins of {sorted(counts)} taxels are not allowed: learn in one of them."
        )
    return Network(ppo.network, ppo.width, counts.pop(), ppo.hold).check()


def begin(ppo: PPO, network: Network, envs: Sequence[PushEnv], tables: Sequence[World]) -> Learner:
    """A learner that has learned nothing, with every trial at a moment of its own."""
    key, first, *own = jax.random.split(jax.random.PRNGKey(ppo.seed), 2 + len(envs))
    level = jnp.asarray(ppo.level, float)
    crowds = []
    for env, table, one in zip(envs, tables, own, strict=True):
        one, late = jax.random.split(one)
        crowd = _anew(network, env, table, level, one, ppo.worlds)
        most = int(float(env.setting.rules.horizon) / env.dt)
        steps = jax.random.randint(late, (ppo.worlds,), 0, most)
        states = crowd.states.replace(data=crowd.states.data._replace(steps=steps))
        crowds.append(crowd._replace(states=states))
    zero = jnp.zeros(())
    student = Student.init(ppo, network, first)
    return Learner(student, level, zero, zero, key, tuple(crowds))


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
) -> Crowd:
    """Worlds by chance at their start: one in five of a lower level, while there is a lower one."""

    def one(key: jax.Array) -> tuple[State, Memory]:
        which, noise, lower = jax.random.split(key, 3)
        index = jax.random.randint(which, (), 0, env.worlds)
        u = jax.random.uniform(lower)
        own = jnp.where((u < 0.2) & (level < 1), 5 * u, 1.0) * level
        world = eased(rows(table, index), own)
        state = env.begin(world._replace(key=jax.random.key_data(noise)), index)
        return state, _first_felt(network, state)

    states, memory = jax.vmap(one)(jax.random.split(key, count))
    return Crowd(states, memory, jnp.ones(count, bool), jnp.zeros(count))


def _first_felt(network: Network, state: State) -> Memory:
    """What the law remembers at a start, which it has sensed."""
    memory = Memory.init(network, state.obs.dtype)
    return memory._replace(felt=memory.felt.follow(state.info["told"]))


def _private(env: PushEnv, state: State) -> jax.Array:
    """What the value function is told beside (P,): the object's place and size, the time left."""
    data, world, rules = state.data, state.info["world"], env.setting.rules
    place, _ = trial.object_pose(data.qpos)
    p_robot_object = planar.rotate(-data.qpos[2], place - data.qpos[:2])
    left = 1 - data.steps * env.dt / rules.horizon
    lost = data.lost_steps * env.dt / jnp.maximum(rules.max_lost, 1.0)
    numbers = [*jnp.clip(p_robot_object, -3, 3), fp.circumradius(world.footprint) / 0.3, left, lost]
    return jnp.stack(numbers)


def _seen(env: PushEnv, crowd: Crowd) -> tuple[jax.Array, jax.Array]:
    """What the network sees (N, F), and what the value function is told beside (N, P)."""
    memory, told = crowd.memory, crowd.states.info["told"]
    numbers = jax.vmap(observation.features)(memory.felt, memory.action, told)
    return numbers, jax.vmap(partial(_private, env))(crowd.states)


def carry_out(
    env: PushEnv, network: Network, crowd: Crowd, hidden: jax.Array, action: jax.Array
) -> tuple[Crowd, jax.Array]:
    """A crowd after an action (N, 3) of each world was carried out, and what that earned (N,)."""
    bounded = observation.executed(action)
    felt = jax.vmap(type(crowd.memory.felt).decided)(crowd.memory.felt, crowd.states.info["told"])
    follow = jax.vmap(type(felt).follow)

    def one(carry: Any, _: None) -> tuple[Any, None]:
        states, felt, reward = carry
        states = jax.vmap(env.step)(states, bounded)
        return (states, follow(felt, states.info["told"]), reward + states.reward), None

    begun = crowd.states, felt, jnp.zeros_like(crowd.earned)
    steps = round(network.hold / env.dt)
    (states, felt, reward), _ = jax.lax.scan(one, begun, length=steps)
    memory = crowd.memory._replace(felt=felt, hidden=hidden, action=bounded)
    earned = crowd.earned + reward
    return Crowd(states, memory, jnp.zeros_like(crowd.fresh), earned), reward


def _verdict(env: PushEnv, crowd: Crowd) -> tuple[Tally, jax.Array]:
    """How the trials that have ended did, and which of them can earn nothing more (N,) bool.

    A trial that ran out of time, or of time without contact, could have gone on.
    """
    data = crowd.states.data
    tally = Tally(
        ended=data.done,
        won=data.success,
        tipped=data.tipped,
        lost=data.done & (data.lost_steps * env.dt > env.setting.rules.max_lost),
        earned=jnp.where(data.done, crowd.earned, 0.0),
        touching=crowd.states.metrics["in_contact"],
    )
    return tally, data.done & (data.success | data.tipped | data.diverged)


def _decision(
    ppo: PPO,
    network: Network,
    envs: Sequence[PushEnv],
    tables: Sequence[World],
    learner: Learner,
    carry: tuple[tuple[Crowd, ...], jax.Array],
    _: None,
) -> tuple[tuple[tuple[Crowd, ...], jax.Array], tuple[Took, Tally]]:
    """One decision of all worlds; what happened, and what has ended."""
    crowds, key = carry
    key, noise, *starts = jax.random.split(key, 2 + len(envs))
    weights, count = learner.student.weights, ppo.worlds

    def together(parts: Sequence[jax.Array]) -> jax.Array:
        return jnp.concatenate(list(parts))

    seen = [_seen(env, crowd) for env, crowd in zip(envs, crowds, strict=True)]
    numbers, private = (together(parts) for parts in zip(*seen, strict=True))
    before = together([crowd.memory.hidden for crowd in crowds])
    fresh = together([crowd.fresh for crowd in crowds])
    hidden, mean = network.apply(weights["actor"], before, numbers)
    noise = jax.random.normal(noise, mean.shape, mean.dtype)
    action = mean + jnp.exp(weights["log_std"]) * noise
    went, told, rewards = [], [], []
    for i, (env, crowd) in enumerate(zip(envs, crowds, strict=True)):
        own = slice(i * count, (i + 1) * count)
        crowd, reward = carry_out(env, network, crowd, hidden[own], action[own])
        went.append(crowd)
        told.append(_seen(env, crowd))
        rewards.append(reward)
    pairs = ppo_.pair(*(together(parts) for parts in zip(*told, strict=True)))
    verdicts = [_verdict(env, crowd) for env, crowd in zip(envs, went, strict=True)]
    tally, final = jax.tree.map(lambda *parts: together(parts), *verdicts)
    pick = jax.vmap(switches.select)
    begun = tuple(
        pick(crowd.states.data.done, _anew(network, env, table, learner.level, at, count), crowd)
        for env, table, at, crowd in zip(envs, tables, starts, went, strict=True)
    )
    took = Took(
        numbers,
        private,
        fresh,
        action,
        ppo_.log_prob(action, mean, weights["log_std"]),
        networks.critic(weights["critic"], ppo_.pair(numbers, private)),
        networks.critic(weights["critic"], pairs),
        together(rewards),
        tally.ended,
        final,
    )
    return (begun, key), (took, jax.tree.map(jnp.sum, tally))


def update(
    ppo: PPO,
    network: Network,
    envs: Sequence[PushEnv],
    tables: Sequence[World],
    learner: Learner,
) -> tuple[Learner, dict[str, jax.Array]]:
    """The learner after one update, and the update's numbers () for the curve.

    Args:
      ppo: the algorithm's numbers. Static.
      network: of the law. Static.
      envs: one for each shape of object and domain. Static.
      tables: their worlds, `PushEnv.table`, which are data and no constants of the program.
      learner: before the update.
    """
    hidden = jnp.concatenate([crowd.memory.hidden for crowd in learner.crowds])
    key, own, passes = jax.random.split(learner.key, 3)
    decide = partial(_decision, ppo, network, envs, tables, learner)
    (crowds, _), (took, tallies) = jax.lax.scan(decide, (learner.crowds, own), length=ppo.decisions)
    tally = jax.tree.map(jnp.sum, tallies)
    student, divergence = ppo_.improve(ppo, network, learner.student, passes, hidden, took)
    learned = learner._replace(student=student, key=key, crowds=crowds)
    told = tally._asdict() | {
        "touching": tally.touching / took.reward.size,
        "level": learner.level,
        "reward": jnp.mean(took.reward),
        "value": jnp.mean(took.value),
        "divergence": divergence,
        "learning_rate": learner.student.learning_rate,
        "spread": jnp.exp(jnp.mean(learner.student.weights["log_std"])),
    }
    return _graded(ppo, learned, tally.ended, tally.won), told


def _graded(ppo: PPO, learner: Learner, ended: jax.Array, won: jax.Array) -> Learner:
    """The learner at a higher level of the curriculum, if it wins enough; then it counts anew."""
    ended, won = 0.9 * learner.ended + ended, 0.9 * learner.won + won
    worlds = ppo.worlds * len(learner.crowds)
    up = (ended > 0.2 * worlds) & (won > ppo.enough * ended) & (learner.level < 1)
    level = jnp.where(up, jnp.minimum(learner.level + 0.05, 1.0), learner.level)
    ended, won = (jnp.where(up, 0.5 * x, x) for x in (ended, won))
    return learner._replace(level=level, ended=ended, won=won)


def pushed(network: Network, env: PushEnv, table: World, actor: Weights) -> State:
    """The states (N,) in which the law, without noise, leaves all worlds of an environment."""

    def one(index: jax.Array) -> tuple[State, Memory]:
        state = env.begin(rows(table, index), index)
        return state, _first_felt(network, state)

    states, memory = jax.vmap(one)(jnp.arange(env.worlds))
    crowd = Crowd(states, memory, jnp.ones(env.worlds, bool), jnp.zeros(env.worlds))

    def on(crowd: Crowd) -> Crowd:
        numbers, _ = _seen(env, crowd)
        hidden, mean = network.apply(actor, crowd.memory.hidden, numbers)
        return carry_out(env, network, crowd, hidden, mean)[0]

    def some_run(crowd: Crowd) -> jax.Array:
        return ~jnp.all(crowd.states.data.done)

    return jax.lax.while_loop(some_run, on, crowd).states


def examine(
    network: Network, envs: Sequence[PushEnv], tables: Sequence[World], actor: Weights
) -> tuple[jax.Array, jax.Array]:
    """Success (N,) bool and time (N,) [s] of the law in all worlds, one environment by one."""
    each = [
        pushed(network, env, table, actor).data for env, table in zip(envs, tables, strict=True)
    ]
    took = [data.steps * env.dt for data, env in zip(each, envs, strict=True)]
    return jnp.concatenate([data.success for data in each]), jnp.concatenate(took)
