"""Collection of transitions for PPO in many worlds, which restart when their trials end.

One update is one program. Every world of every environment takes several actions, each of them
held for several control steps; then `ppo` updates the network. A GPU runs an action in all worlds
as one kernel of each environment.

Curriculum: at a low level targets are near and ahead. The level rises when enough trials succeed,
up to the targets of the domain. Tasks with a path have no curriculum.
"""

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from rps_jax import errors
from rps_jax.control import soft
from rps_jax.control.learned import features
from rps_jax.control.learned import network as networks
from rps_jax.control.learned.features import TouchState
from rps_jax.control.learned.network import Network, PolicyState, Weights
from rps_jax.engines import native
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Pair
from rps_jax.trials import trial
from rps_jax.trials.env import PushEnv, State
from rps_jax.trials.trial import World
from rps_jax.trials.worlds import rows
from rps_jax.tuning import ppo as ppo_
from rps_jax.tuning.ppo import PPO, Privileged, TrainState, Transition
from rps_jax.world.scene import JOINTS
from rps_jax.world.tasks.reach import Nothing

T = TypeVar("T")
ActCarry = tuple[State, TouchState, Array]  # state, touch state, reward ()
_RADIUS = 0.3  # [m] unit of the circumradius
_TILT_SCALE = 6.0  # of half of the components of the object's axis
_FAILURE_DECAY = 0.7  # of a world's failure rate, per trial in it
_UNSOLVED = 0.05  # [1] of the weight of a world that always fails, in prioritised draws


class EnvBatch(NamedTuple):
    """Running worlds of one environment; leaves (N, ...)."""

    states: State
    memory: PolicyState
    first: Array  # (N,) bool: the trial has just started
    earned: Array  # (N,) [1] rewards of the trial so far


Carry = tuple[tuple[EnvBatch, ...], Array]  # batches and key, between two actions
Stats = dict[str, Array]  # counts of ended trials, of worlds (N,) or sums over them, by name
# Transitions, inputs of the network after the action, statistics, and indices of the worlds.
StepResults = tuple[Transition, Pair, Stats, Array]


class RunnerState(NamedTuple):
    """State of a learning run between two updates."""

    train: TrainState
    progress: Array  # () [1] share of the run that is over
    updates: Array  # () number of updates
    failures: tuple[Array, ...]  # (worlds,) [1] recent failure rates of each table's worlds
    level: Array  # () [1] of the curriculum
    ended: Array  # () trials that ended, with exponentially decaying weights
    succeeded: Array  # () successes, with the same weights
    key: Array
    batches: tuple[EnvBatch, ...]


def network_of(ppo: PPO, envs: Sequence[PushEnv]) -> Network:
    """Return the network for these environments, whose skins have equally many taxels."""
    sizes = {(env.observation_size - 2, env.action_size) for env in envs}
    if len(sizes) > 1:
        rule = "learn in one domain"
        raise errors.not_allowed("taxels and actions of the domains", sorted(sizes), rule)
    taxels, actions = sizes.pop()
    return Network(ppo.network, ppo.width, taxels, ppo.hold, actions).check()


def start(
    ppo: PPO, network: Network, envs: Sequence[PushEnv], tables: Sequence[World], *, seed: int = 0
) -> RunnerState:
    """Return the state before the first update, with every trial at a random time."""
    key, first, *keys = jax.random.split(jax.random.PRNGKey(seed), 2 + len(envs))
    level = jnp.asarray(1.0 if ppo.initial else ppo.initial_level, float)
    failures = tuple(jnp.full(env.worlds, 0.5) for env in envs)
    indices = [draw_indices(ppo, *x, (ppo.num_envs,)) for x in zip(failures, keys, strict=True)]
    draws = list(map(_draw_worlds, tables, itertools.repeat(level), keys, indices))
    batches = list[EnvBatch]()
    for env, batch, env_key in zip(envs, _begin(network, envs, draws), keys, strict=True):
        horizon_steps = int(float(env.setting.rules.horizon) / env.dt)
        time_key = jax.random.fold_in(env_key, 1)
        steps = jax.random.randint(time_key, (ppo.num_envs,), 0, horizon_steps)
        states = batch.states.replace(data=batch.states.data._replace(steps=steps))
        batches.append(batch._replace(states=states))
    zero = jnp.zeros(())
    train = TrainState.init(ppo, network, first)
    inputs = train, zero, jnp.zeros((), int), failures, level, zero, zero, key
    return RunnerState(*inputs, tuple(batches))


def ease(world: World, level: Array) -> World:
    """Return a world with a nearer target, more ahead; unchanged at level 1, or with a path."""
    if not isinstance(world.task, Nothing):
        return world
    x, y = world.p_world_target
    distance, bearing = jnp.hypot(x, y), level * jnp.arctan2(y, x)
    near = jnp.minimum(distance, 0.8)  # [m] outside robot and object
    length = near + level * (distance - near)
    target = length * planar.unit(bearing)
    return world._replace(p_world_target=jnp.where(level < 1, target, world.p_world_target))


def _together(
    envs: Sequence[PushEnv],
    network: Network,
    function: Callable[..., T],
    inputs: Sequence[tuple[PyTree, ...]],
) -> list[T]:
    """Map `function(network, env, ...)` of one world over inputs (N, ...) of each environment."""
    functions = [
        native.Keyed((function, network, env.program), partial(function, network, env))
        for env in envs
    ]

    def in_xla(*inputs: tuple[PyTree, ...]) -> list[T]:
        return [jax.vmap(f)(*x) for f, x in zip(functions, inputs, strict=True)]

    run = native.concurrent(functions, in_xla) if all(env.is_native for env in envs) else in_xla
    return list(run(*inputs))


def _begin(
    network: Network, envs: Sequence[PushEnv], draws: Sequence[tuple[World, Array]]
) -> list[EnvBatch]:
    """Return worlds (N, ...) of indices (N,) at their start, after the first observation."""
    batches = _together(envs, network, _begin_world, draws)
    return [_with_info(x, world=draw[0]) for x, draw in zip(batches, draws, strict=True)]


def _begin_world(network: Network, env: PushEnv, world: World, index: Array) -> EnvBatch:
    """Return one world at its start, without the fields that do not change."""
    state = env.begin(world, index)
    memory = PolicyState.init(network, state.obs.dtype)
    touch_state = memory.touch_state.update(state.info["observation"])
    state = state.replace(info=state.info | {"world": None})
    memory = memory._replace(touch_state=touch_state)
    return EnvBatch(state, memory, jnp.ones((), bool), jnp.zeros(()))


def _with_info(batch: EnvBatch, **info: PyTree) -> EnvBatch:
    """Return a batch whose states have other information."""
    return batch._replace(states=batch.states.replace(info=batch.states.info | info))


def _draw_worlds(table: World, level: Array, key: Array, indices: Array) -> tuple[World, Array]:
    """Return the worlds of indices (N,), and these; one in five has a random lower level."""

    def draw_world(key: Array, index: Array) -> World:
        noise_key, level_key = jax.random.split(key)
        u = jax.random.uniform(level_key)
        world_level = jnp.where((u < 0.2) & (level < 1), 5 * u, 1.0) * level
        world = ease(rows(table, index), world_level)
        return world._replace(key=jax.random.key_data(noise_key))

    return jax.vmap(draw_world)(jax.random.split(key, indices.size), indices), indices


def draw_indices(ppo: PPO, failures: Array, key: Array, shape: tuple[int, ...]) -> Array:
    """Return random indices of worlds; a share of them, `ppo.prioritised`, by their failure rates.

    The weight of a world is greatest where it sometimes fails; it is small where it always does.
    """
    keys, worlds = jax.random.split(key, 3), failures.size
    indices = jax.random.randint(keys[0], shape, 0, worlds)
    if not ppo.prioritised:
        return indices
    total = jnp.cumsum(failures * (1 + _UNSOLVED - failures) + 1e-6)
    prioritised = jnp.searchsorted(total, jax.random.uniform(keys[1], shape) * total[-1])
    prioritised = jnp.minimum(prioritised, worlds - 1).astype(indices.dtype)
    chosen = jax.random.uniform(keys[2], shape) < ppo.prioritised
    return jnp.where(chosen, prioritised, indices)


def failure_rates(rates: Array, index: Array, ended: Array, succeeded: Array) -> Array:
    """Return the failure rates (worlds,) after trials (...), of which some have ended."""
    change = (1 - _FAILURE_DECAY) * ended * (1 - succeeded - rates[index])
    return jnp.clip(rates.at[index].add(change), 0, 1)


def _privileged(env: PushEnv, state: State) -> Privileged:
    """Return the privileged inputs of one world."""
    data, world, rules = state.data, state.info["world"], env.setting.rules
    p_world_base, yaw = data.qpos[JOINTS.base_position], data.qpos[JOINTS.base_yaw]
    p_world_object, _ = trial.object_pose(data.qpos)
    p_robot_object = planar.rotate(-yaw, p_world_object - p_world_base)
    w, x, y, z = data.qpos[JOINTS.object_quaternion]
    half_axis = planar.rotate(-yaw, jnp.stack([x * z + w * y, y * z - w * x]))
    ahead, left = jnp.clip(p_robot_object, -3, 3)
    tilt_ahead, tilt_left = _TILT_SCALE * half_axis
    return Privileged(
        ahead,
        left,
        fp.circumradius(world.footprint) / _RADIUS,
        1 - data.steps * env.dt / rules.horizon,
        data.lost_steps * env.dt / jnp.maximum(rules.max_lost, 1.0),
        tilt_ahead,
        tilt_left,
        world.qpos[JOINTS.object_height],
        jnp.minimum(getattr(data.task, "measured", 1.0), 1.0),
    )


def _inputs(env: PushEnv, batch: EnvBatch) -> Pair:
    """Return the inputs of the network (N, F) and the privileged inputs (N, P)."""
    memory, obs = batch.memory, batch.states.info["observation"]
    inputs = jax.vmap(features.compute_features)(memory.touch_state, memory.action, obs)
    privileged = jax.vmap(lambda state: jnp.stack(_privileged(env, state)))(batch.states)
    return inputs, privileged


def _act(
    network: Network, env: PushEnv, batch: EnvBatch, _: Array, action: Array
) -> tuple[EnvBatch, Array]:
    """Execute an action (A,) in one world; the kernel does not copy constant fields."""
    bounded = features.clip_action(action)
    command = bounded if network.actions == 3 else bounded[::2]  # v_x and omega
    touch_state = batch.memory.touch_state.mark_decision(batch.states.info["observation"])

    def step(carry: ActCarry, _: None) -> tuple[ActCarry, None]:
        state, touch_state, reward = carry
        state = env.step(state, command)
        touch_state = touch_state.update(state.info["observation"])
        return (state, touch_state, reward + state.reward), None

    carry = batch.states, touch_state, jnp.zeros_like(batch.earned)
    steps = round(network.hold / env.dt)
    state, touch_state, reward = jax.lax.scan(step, carry, length=steps)[0]
    memory = batch.memory._replace(touch_state=touch_state, hidden=jnp.zeros(()), action=bounded)
    moved = EnvBatch(state, memory, jnp.zeros_like(batch.first), batch.earned + reward)
    return _with_info(moved, world=None), reward


def _act_together(
    envs: Sequence[PushEnv],
    network: Network,
    batches: Sequence[EnvBatch],
    hidden: Array,
    action: Array,
) -> list[tuple[EnvBatch, Array]]:
    """Execute the joined actions (sum of N, A) in the worlds of all environments.

    Returns:
      The batch of each environment and the rewards (N,).
    """
    splits = np.cumsum([x.first.size for x in batches])[:-1]
    inputs = list(zip(batches, jnp.split(hidden, splits), jnp.split(action, splits), strict=True))
    results = []
    for (batch, reward), (old, new_hidden, _) in zip(
        _together(envs, network, _act, inputs), inputs, strict=True
    ):
        memory = batch.memory._replace(hidden=new_hidden)
        batch = _with_info(batch._replace(memory=memory), world=old.states.info["world"])
        results.append((batch, reward))
    return results


def _episode_stats(env: PushEnv, batch: EnvBatch) -> tuple[Stats, Array]:
    """Return statistics of the trials that have ended, and whether each is terminated (N,).

    A trial that reached a time limit, with or without contact, is truncated and not terminated,
    unless a failure has a cost.
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
    truncated = env.has_timed_out(data) & (env.weights.failure == 0)
    return stats, data.done & ~truncated


def _join(parts: Sequence[T]) -> T:
    """Concatenate the leaves of pytrees."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def update(
    ppo: PPO,
    network: Network,
    envs: Sequence[PushEnv],
    tables: Sequence[World],
    runner: RunnerState,
) -> tuple[RunnerState, dict[str, Array]]:
    """Make one update; return the next state and the update's metrics () for the curve.

    Each of `envs` has one shape of object and one domain. Their worlds, `tables`, are inputs and
    not constants of the program.
    """

    weights = runner.train.weights
    key, action_key, index_key, update_key = jax.random.split(runner.key, 4)
    shape = ppo.num_steps, ppo.num_envs
    index_keys = jax.random.split(index_key, len(envs))
    pairs = zip(runner.failures, index_keys, strict=True)
    indices = tuple(draw_indices(ppo, *pair, shape) for pair in pairs)

    def take_action(carry: Carry, fresh: tuple[Array, ...]) -> tuple[Carry, StepResults]:
        """Take one action in all worlds, and restart those whose trials end."""
        batches, key = carry
        key, noise_key, *start_keys = jax.random.split(key, 2 + len(envs))
        pairs = zip(envs, batches, strict=True)
        inputs = [(*_inputs(env, x), x.memory.hidden, x.first) for env, x in pairs]
        obs, privileged, previous_hidden, first = _join(inputs)
        hidden, mean = network.apply(weights["actor"], previous_hidden, obs)
        noise = jax.random.normal(noise_key, mean.shape, mean.dtype)
        action = mean + jnp.exp(weights["log_std"]) * noise
        moved = _act_together(envs, network, batches, hidden, action)
        results = [
            (_inputs(env, batch), reward, *_episode_stats(env, batch), batch.states.info["index"])
            for env, (batch, reward) in zip(envs, moved, strict=True)
        ]
        draws = map(_draw_worlds, tables, itertools.repeat(runner.level), start_keys, fresh)
        starts = _begin(network, envs, list(draws))
        restarted = tuple(
            jax.vmap(soft.tree_where)(batch.states.data.done, start, batch)
            for (batch, _), start in zip(moved, starts, strict=True)
        )
        next_inputs, reward, stats, terminated, index = _join(results)
        log_prob = ppo_.log_prob(action, mean, weights["log_std"])
        zero = jnp.zeros_like(reward)
        decision = obs, privileged, first, action, log_prob, zero
        steps = Transition(*decision, zero, reward, stats["ended"], terminated)
        return (restarted, key), (steps, next_inputs, stats, index)

    hidden = jnp.concatenate([batch.memory.hidden for batch in runner.batches])
    carry = runner.batches, action_key
    (batches, _), (steps, next_inputs, step_stats, index) = jax.lax.scan(
        take_action, carry, indices
    )
    pairs = (ppo_.critic_inputs(*x) for x in ((steps.obs, steps.privileged), next_inputs))
    value, next_value = (networks.critic(weights["critic"], x) for x in pairs)
    steps = steps._replace(value=value, next_value=next_value)
    stats = jax.tree.map(jnp.sum, step_stats)
    schedule = ppo.schedule(runner.progress, runner.updates)
    train, kl = ppo_.update_policy(ppo, network, runner.train, update_key, hidden, steps, *schedule)
    trials = (index, step_stats["ended"], step_stats["succeeded"])
    columns = (jnp.split(x, len(envs), axis=1) for x in trials)
    failures = map(failure_rates, runner.failures, *columns)
    updated = runner._replace(
        train=train, key=key, batches=batches, updates=runner.updates + 1, failures=tuple(failures)
    )
    metrics = stats | {
        "touching": stats["touching"] / steps.reward.size,
        "level": runner.level,
        "reward": jnp.mean(steps.reward),
        "value": jnp.mean(steps.value),
        "kl": kl,
        "learning_rate": runner.train.learning_rate,
        "spread": jnp.exp(jnp.mean(weights["log_std"])),
    }
    return _raise_level(ppo, updated, stats), metrics


def _raise_level(ppo: PPO, runner: RunnerState, stats: Stats) -> RunnerState:
    """Raise the level of the curriculum if enough trials succeed, and then halve their counts."""
    ended = 0.9 * runner.ended + stats["ended"]
    succeeded = 0.9 * runner.succeeded + stats["succeeded"]
    worlds = ppo.num_envs * len(runner.batches)
    up = (ended > 0.2 * worlds) & (succeeded > ppo.success_threshold * ended) & (runner.level < 1)
    level = jnp.where(up, jnp.minimum(runner.level + 0.05, 1.0), runner.level)
    ended, succeeded = (jnp.where(up, 0.5 * x, x) for x in (ended, succeeded))
    return runner._replace(level=level, ended=ended, succeeded=succeeded)


def run_policy(
    network: Network, envs: Sequence[PushEnv], tables: Sequence[World], actor: Weights
) -> list[State]:
    """Push without noise in all worlds of all environments; return the last states."""
    draws = [(table, jnp.arange(env.worlds)) for env, table in zip(envs, tables, strict=True)]

    def step(batches: list[EnvBatch]) -> list[EnvBatch]:
        inputs = [_inputs(env, x)[0] for env, x in zip(envs, batches, strict=True)]
        hidden = _join([x.memory.hidden for x in batches])
        actions = network.apply(actor, hidden, _join(inputs))
        return [x for x, _ in _act_together(envs, network, batches, *actions)]

    def is_running(batches: list[EnvBatch]) -> Array:
        return ~jnp.all(_join([x.states.data.done for x in batches]))

    batches = jax.lax.while_loop(is_running, step, _begin(network, envs, draws))
    return [batch.states for batch in batches]


def evaluate_policy(
    network: Network, envs: Sequence[PushEnv], tables: Sequence[World], actor: Weights
) -> Pair:
    """Return success (N,) bool and time (N,) [s] of the law in all worlds of all environments."""
    states = run_policy(network, envs, tables, actor)
    pairs = zip(envs, states, strict=True)
    return _join([(x.data.success, x.data.steps * env.dt) for env, x in pairs])
