"""Gradients of windows with a critic: a network that estimates what the rest of a trial will cost.

A window of a softened trial scores its time, its time without contact, and the critic at its end.
The critic is fitted to the remaining objective, failures included, of whole softened trials.

Reference: Xu et al., "Accelerated policy learning with parallel differentiable simulation", ICLR
2022.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
import optax

from rps_jax.control import registry
from rps_jax.engines import native
from rps_jax.engines.base import Stage
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import planar
from rps_jax.laws import LawParams, law_of
from rps_jax.trials import trial
from rps_jax.trials.trial import ControlLoop, Snapshot, Trial, World, advance, start_all
from rps_jax.trials.worlds import soften_skins
from rps_jax.tuning import gradients
from rps_jax.tuning.derivatives import soft_times
from rps_jax.tuning.gradients import Estimate
from sweeps.gradients import estimators
from sweeps.gradients.windows import Windows, window_starts

Layers = list[tuple[jax.Array, jax.Array]]  # weights and biases
Fit = tuple[Layers, optax.OptState]
Critic = Callable[[jax.Array], jax.Array]  # from features (..., F) to remaining scores (...) [1]
_INTERVAL = 4.0  # [s] between the states of a trial to which a critic is fitted
_UPDATES, _BATCH, _WIDTH = 3000, 512, 64  # of the fit; units of its two hidden layers


def critic_gradient(tuning: Windows, generations: int = 6) -> tuple[Estimate, float, float]:
    """Return the gradient (p,) at the start with a critic for each object.

    The critics are fitted to trials in the worlds of several generations, and tested in the worlds
    of the gradient.

    Returns:
      The gradient; the simulated time of trials and windows [s]; and the share of the variance of
      the remaining scores that the critics explain in the worlds of the gradient [1].
    """
    theta, setting = jnp.asarray(tuning.base), tuning.setting
    estimates, simulated, explained = list[Estimate](), 0.0, list[float]()
    count = tuning.worlds * len(tuning.domains)
    horizon, collect = float(setting.rules.horizon), jax.jit(partial(_collect, tuning))
    data: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    for generation in reversed(range(generations + 1)):  # the last has the gradient
        params = tuning.space.params(tuning.base[None])
        for index, batch in enumerate(tuning.candidates(params, generation).batches(setting)):
            worlds = soften_skins(batch.worlds, tuning.taxels)
            x, y, live, seconds = jax.device_get(collect(theta, batch.stage, worlds))
            simulated += float(np.sum(seconds))
            if generation:
                data.setdefault(index, []).append((x[live], y[live]))
                continue
            x_fit, y_fit = (np.concatenate(parts) for parts in zip(*data[index], strict=True))
            critic = fit(x_fit, y_fit)
            error = np.asarray(critic(jnp.asarray(x[live]))) - y[live]
            explained.append(1 - float(np.mean(error**2) / np.var(y[live])))
            share = batch.indices.size / count
            start = np.random.default_rng(setting.seed).uniform(size=batch.indices.size)
            trials = window_starts(tuning, batch.stage, theta, worlds, jnp.asarray(start))
            scores = window_scores(tuning, batch.stage, critic)
            samples = jax.jit(partial(estimators.exact, scores))(theta, (worlds, trials))
            x = gradients.estimate(gradients.clip(samples, tuning.world_clip))
            scale = share * horizon / tuning.window  # windows in a trial
            estimates.append(Estimate(scale * x.gradient, scale**2 * x.variance, share * x.finite))
            simulated += batch.indices.size * (tuning.window + tuning.within)
    mean = jax.tree.map(lambda *leaves: sum(leaves), *estimates)
    return mean, simulated, float(np.mean(explained))


def fit(x: np.ndarray, y: np.ndarray) -> Critic:
    """Return a network fitted to remaining scores (n,) by features (n, F)."""
    mean, scale = x.mean(axis=0), x.std(axis=0) + 1e-3
    sizes = (x.shape[1], _WIDTH, _WIDTH, 1)
    keys = jax.random.split(jax.random.key(0), len(sizes))
    layers = [
        (jax.random.normal(key, (a, b)) / np.sqrt(a), jnp.zeros(b))
        for key, a, b in zip(keys, sizes[:-1], sizes[1:], strict=False)
    ]
    rule = optax.adamw(optax.cosine_decay_schedule(2e-3, _UPDATES), weight_decay=1e-2)
    inputs, targets = jnp.asarray(x), jnp.asarray(y)

    def value(layers: Layers, x: jax.Array) -> jax.Array:
        hidden = (x - mean) / scale
        for weights, bias in layers[:-1]:
            hidden = jnp.tanh(hidden @ weights + bias)
        weights, bias = layers[-1]
        return (hidden @ weights + bias)[..., 0]

    def update(carry: Fit, key: jax.Array) -> tuple[Fit, None]:
        layers, state = carry
        chosen = jax.random.randint(key, (_BATCH,), 0, len(y))

        def loss(layers: Layers) -> jax.Array:
            return jnp.mean((value(layers, inputs[chosen]) - targets[chosen]) ** 2)

        change, state = rule.update(jax.grad(loss)(layers), state, layers)
        return (cast(Layers, optax.apply_updates(layers, change)), state), None

    @jax.jit
    def train(start: Fit, key: jax.Array) -> Fit:
        return jax.lax.scan(update, start, jax.random.split(key, _UPDATES))[0]

    layers, _ = train((layers, rule.init(layers)), keys[-1])
    return partial(value, layers)


def window_scores(tuning: Windows, stage: Stage, critic: Critic) -> gradients.Scores:
    """Return the scores of windows with a critic at their ends, as `windows.window_scores`."""
    space, setting, objective = tuning.space, tuning.setting, tuning.objective
    loop = _loop(tuning)
    period = setting.physics.control_period

    def cost(
        snapshots: Snapshot, world: World, params: LawParams, first: Trial, last: Trial
    ) -> jax.Array:
        weights = first.contact_steps > 0, 1 - snapshots.done, tuning.arrive
        under_way, lost = soft_times(snapshots, params.d_success, *weights)
        times = period * jnp.sum(under_way), period * lost
        score = objective.score(1.0, *times, 0.0, setting.rules)
        rest = critic(features(world, params, last, loop))
        return jnp.asarray(score + under_way[-1] * jnp.where(last.done, 0.0, rest))

    steps = max(1, round(tuning.window / period))

    def scores(thetas: jax.Array, pairs: tuple[World, Trial]) -> jax.Array:
        worlds, trials = pairs
        params = jax.vmap(space.params)(thetas)
        inputs = stage, worlds, params, trials, loop, steps
        last, snapshots = trial.unroll(*inputs, native.mapped)
        return jax.vmap(cost, (1, 0, 0, 0, 0))(snapshots, worlds, params, trials, last)

    return scores


def features(world: World, params: LawParams, state: Trial, loop: ControlLoop) -> jax.Array:
    """Return the inputs (F,) of a critic: contact, poses in the robot frame, velocities, times."""
    _, measured = trial.observe(world, params, state, loop)
    position, yaw = trial.object_pose(state.qpos)
    p_world_robot, heading = state.qpos[:2], state.qpos[2]
    p_robot_object = planar.rotate(-heading, position - p_world_robot)
    p_robot_target = planar.rotate(-heading, world.p_world_target - p_world_robot)
    angles = jnp.array([1.0, 2.0, 4.0]) * (yaw - heading)
    law, rules, period = state.law_state, loop.rules, loop.physics.control_period
    scalars = [
        1.0 * measured.reading.in_contact,
        measured.distance,
        law.l_th,
        1.0 * law.touched,
        jnp.abs(law.p_robot_contact[1]),
        fp.circumradius(world.footprint),
        state.steps * period / rules.horizon,
        state.lost_steps * period / rules.max_lost,
        jnp.minimum(state.min_distance, 5.0),
        5 * state.qvel[8],
    ]
    speed = 20 * planar.rotate(-heading, state.qvel[3:5])
    vectors = (p_robot_object, p_robot_target, law.p_robot_contact, speed)
    joined = [*vectors, jnp.cos(angles), jnp.sin(angles), jnp.stack(scalars)]
    return jnp.clip(jnp.concatenate(joined), -6, 6)


def _loop(tuning: Windows) -> ControlLoop:
    """Return the loop of softened trials under the rules of the setting."""
    law = registry.smooth_law(law_of(tuning.space.base))
    return ControlLoop(tuning.setting.physics, tuning.setting.rules, law)


def _collect(
    tuning: Windows, theta: jax.Array, stage: Stage, worlds: World
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Return features (K, n, F), remaining scores and liveness (K, n), and times (n,) of trials."""
    setting, objective, loop = tuning.setting, tuning.objective, _loop(tuning)
    period, rules = setting.physics.control_period, setting.rules
    params = jax.vmap(tuning.space.params)(gradients.per_world(theta, worlds))
    trials = start_all(worlds, params, jnp.ones(worlds.qpos.shape[0], bool), law=loop.law)

    def score(state: Trial, success: jax.Array | float, missed: jax.Array | float) -> jax.Array:
        times = state.steps * period, state.lost_steps * period
        return jnp.asarray(objective.score(success, *times, missed, rules))

    def proceed(state: Trial, _: None) -> tuple[Trial, tuple[jax.Array, ...]]:
        inputs = jax.vmap(features, (0, 0, 0, None))(worlds, params, state, loop)
        (moved,) = advance([(stage, worlds, params, state)], loop, round(_INTERVAL / period))
        return moved, (inputs, score(state, 1.0, 0.0), ~state.done)

    count = round(float(rules.horizon) / _INTERVAL)
    last, (inputs, scores, live) = jax.lax.scan(proceed, trials, length=count)
    whole = score(last, 1.0 * last.success, jnp.minimum(last.min_distance, 5.0))
    return inputs, whole - scores, live, last.steps * period
