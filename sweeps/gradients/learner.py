"""Learn a law by gradients of short windows with a value function at their ends, as SHAC does.

The worlds, the network, the rewards, the curriculum and the fit of the value function are those of
`rps learn`; contact is a weight. Its policy step is replaced: the discounted rewards of a window,
with the value of its last state, are the score of an estimator of `rps_jax.tuning.gradients`, by
the weights of the policy in each world. So evolution can be compared at equal scores.

    rps sweeps/gradients/learner.py --network mlp --width 23 --minutes 5 --out runs/windows

Reference: Xu et al., "Accelerated policy learning with parallel differentiable simulation", ICLR
2022.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from rps_jax import PushEnv, errors
from rps_jax.control.learned import network as networks
from rps_jax.control.learned.network import Network, Weights
from rps_jax.engines import native
from rps_jax.physics import get_engine
from rps_jax.questions import call_of, option
from rps_jax.trials.trial import World
from rps_jax.tuning import collection, gradients, ppo
from rps_jax.tuning.collection import EnvBatch, RunnerState
from rps_jax.tuning.gradients import Options
from rps_jax.tuning.learn import Learn
from sweeps.gradients import estimators


@dataclass(frozen=True)
class WindowLearner(Learn):
    """Learn a law by gradients of short windows, in random worlds for tuning.

    The answer and the run folder are those of `rps learn`.
    """

    TITLE = "A law learned by gradients of short windows"
    QUICK: ClassVar = {**Learn.QUICK, "setting.engine": "quasistatic"}

    estimator: str = field(default="clipped", kw_only=True)
    """Estimator of the gradient: exact, clipped, bundled, evolution or mixed."""
    num_steps: int = option(16, 1, 1000, kw_only=True)
    """Number of actions of a window."""
    actor_rate: float = option(1e-3, above=0, at_most=1, kw_only=True)
    """Learning rate of the policy."""
    approach: float = option(0.5, 0, kw_only=True)
    """Cost of the distance between base and object at the end of a window [1/m]. Without it a
    policy that has lost the object does not return: derivatives do not see a contact to come."""
    world_clip: float = option(2.0, above=0, kw_only=True)
    """Bound on the norm of the gradient of one world, for clipped, as a multiple of the median
    norm [1]."""
    sigma: float = option(0.02, above=0, kw_only=True)
    """Standard deviation of random steps of a weight [1]."""
    noise: float = option(0.2, above=0, at_most=2, kw_only=True)
    """Standard deviation of the actions in the worlds that are stepped [1]; those of windows have
    none."""
    out: Path | str | None = field(default="runs/window_learner", kw_only=True)
    """Run folder, with `policy.npz`; a killed run resumes there."""

    def check(self) -> None:
        super().check()
        errors.check_name("estimator", self.estimator, estimators.ESTIMATORS)
        if self.estimator != "evolution":
            engine = get_engine(self.setting.engine)
            engine.check_derivatives("reverse")

    def environments(self, split: Literal["test", "tune", "validate"] = "tune") -> list[PushEnv]:
        """Return the environments of a split; those to learn in have a smooth contact."""
        envs = super().environments(split)
        return [replace(env, smooth=True) for env in envs] if split == "tune" else envs

    @staticmethod
    def start(options: WindowLearner, *inputs: Any, seed: int = 0) -> RunnerState:
        """Return the state of `collection.start` with a second optimiser, of the policy."""
        runner = collection.start(options, *inputs, seed=seed)
        weights = runner.train.weights | {"log_std": jnp.full(3, math.log(options.noise))}
        optimiser = runner.train.optimiser, _rule(options).init(weights["actor"])
        return runner._replace(train=runner.train._replace(weights=weights, optimiser=optimiser))

    @staticmethod
    def update(
        options: WindowLearner,
        network: Network,
        envs: Sequence[PushEnv],
        tables: Sequence[World],
        runner: RunnerState,
    ) -> tuple[RunnerState, dict[str, jax.Array]]:
        """Make one update: a step of the policy; then `collection.update` for all else."""
        train = runner.train
        states: Any = train.optimiser
        inner, outer = states
        theta, unravel = ravel_pytree(train.weights["actor"])
        estimate = estimators.ESTIMATORS[options.estimator]
        settings = Options(options.world_clip, options.sigma)
        key, slopes = jax.random.fold_in(runner.key, 1), list[jax.Array]()
        for index, (env, batch) in enumerate(zip(envs, runner.batches, strict=True)):
            scores = window_scores(options, network, env, unravel, train.weights["critic"])
            worlds, env_key = jax.lax.stop_gradient(batch), jax.random.fold_in(key, index)
            samples = estimate(scores, theta, worlds, env_key, settings)
            slopes.append(gradients.estimate(samples).gradient)
        gradient = unravel(jnp.mean(jnp.stack(slopes), axis=0))
        change, outer = _rule(options).update(gradient, outer)
        actor = optax.apply_updates(train.weights["actor"], change)
        plain = runner._replace(train=train._replace(optimiser=inner))
        moved, metrics = collection.update(options, network, envs, tables, plain)
        fixed = {"actor": actor, "log_std": train.weights["log_std"]}
        ema = jax.tree.map(lambda a, b: 0.9 * a + 0.1 * b, train.ema, actor)
        next_train = moved.train._replace(
            weights=moved.train.weights | fixed, ema=ema, optimiser=(moved.train.optimiser, outer)
        )
        return moved._replace(train=next_train), metrics


window_learner = call_of(WindowLearner)


def _rule(options: WindowLearner) -> optax.GradientTransformation:
    """Return Adam with the momenta of SHAC, for gradients clipped to a norm of 1."""
    adam = optax.adam(options.actor_rate, b1=0.7, b2=0.95)
    return optax.chain(optax.clip_by_global_norm(1.0), adam)


def window_scores(
    options: WindowLearner,
    network: Network,
    env: PushEnv,
    unravel: Callable[[jax.Array], Weights],
    critic: Weights,
) -> gradients.Scores:
    """Return scores of policies with weights (n, p) in running worlds (n, ...) of an environment.

    A score is the negative sum of the discounted rewards of a window, and of the value at its end.
    """

    def scores(thetas: jax.Array, worlds: EnvBatch) -> jax.Array:
        weights = jax.vmap(unravel)(thetas)

        @partial(jax.checkpoint, prevent_cse=False)
        def step(batch: EnvBatch, _: None) -> tuple[EnvBatch, jax.Array]:
            inputs = collection._inputs(env, batch)[0]
            hidden, mean = jax.vmap(network.apply)(weights, batch.memory.hidden, inputs)
            return collection.act(env, network, batch, hidden, mean, mapped=native.mapped)

        last, rewards = jax.lax.scan(step, worlds, length=options.num_steps)
        _, terminated = collection._episode_stats(env, last)
        qpos = last.states.data.qpos
        distance = jnp.linalg.norm(qpos[:, 3:5] - qpos[:, :2], axis=1)
        value = networks.critic(critic, ppo.critic_inputs(*collection._inputs(env, last)))
        value -= options.approach * distance
        discounts = options.gamma ** jnp.arange(options.num_steps)
        end = options.gamma**options.num_steps * jnp.where(terminated, 0.0, value)
        return -(discounts @ rewards + end)

    return scores
