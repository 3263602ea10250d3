"""A policy for `PushEnv`, found by evolution strategies: forward simulation and optax, no more.

    python notebooks/examples/train_policy.py

Each iteration tries random changes of the weights, each with its opposite in the same world, and
moves the weights towards what earned more (Salimans et al., "Evolution strategies as a scalable
alternative to reinforcement learning", 2017). Prints the mean return after each iteration.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import optax
import tyro
from jax.flatten_util import ravel_pytree

import rps_jax


@dataclass(frozen=True)
class Options:
    """What to try, and how often."""

    iterations: int = 60
    pairs: int = 64
    """Changes tried in an iteration, each with its opposite."""
    seconds: float = 10.0
    """Length of a try [s]."""
    sigma: float = 0.3
    """Standard deviation of the changes."""
    learning_rate: float = 0.1
    seed: int = 0


def policy(weights: dict, obs: jax.Array) -> jax.Array:
    """The action (3,) for an observation (44,): linear in what is felt and where the target is."""
    taxels, p_robot_target = jnp.tanh(obs[:42]), obs[42:]
    direction = p_robot_target / jnp.linalg.norm(p_robot_target)
    return jnp.tanh(weights["w"] @ jnp.concatenate([taxels, direction]) + weights["b"])


def total(env: rps_jax.PushEnv, steps: int, weights: dict, key: jax.Array) -> jax.Array:
    """Sum of the rewards () of one try."""

    def one(state, _):
        state = env.step(state, policy(weights, state.obs))
        return state, state.reward

    return jax.lax.scan(one, env.reset(key), length=steps)[1].sum()


def main(options: Options) -> list[float]:
    """Train; returns the mean return of each iteration."""
    env = rps_jax.PushEnv("random_box", setting=rps_jax.Setting("fused", fidelity="fast"))
    steps = round(options.seconds / env.dt)
    start = {"w": jnp.zeros((3, 44)), "b": jnp.zeros(3)}
    weights, unravel = ravel_pytree(start)
    optimizer = optax.adam(options.learning_rate)
    attempt = jax.vmap(lambda flat, key: total(env, steps, unravel(flat), key))

    @jax.jit
    def iterate(weights, memory, key):
        key_change, key_world = jax.random.split(key)
        change = jax.random.normal(key_change, (options.pairs, weights.size))
        tries = weights + options.sigma * jnp.concatenate([change, -change])
        worlds = jnp.tile(jax.random.split(key_world, options.pairs), 2)
        earned = attempt(tries, worlds)
        better = earned[: options.pairs] - earned[options.pairs :]
        gradient = -(better / (earned.std() + 1e-6)) @ change / options.pairs
        update, memory = optimizer.update(gradient, memory)
        return optax.apply_updates(weights, update), memory, earned.mean()

    memory, returns = optimizer.init(weights), []
    for i, key in enumerate(jax.random.split(jax.random.key(options.seed), options.iterations)):
        weights, memory, mean = iterate(weights, memory, key)
        returns.append(float(mean))
        print(f"iteration {i}: mean return {returns[-1]:.3f}")
    return returns


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
