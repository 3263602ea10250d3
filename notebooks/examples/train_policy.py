"""Train a policy for `PushEnv` by evolution strategies, with forward simulation and optax alone.

    python notebooks/examples/train_policy.py

Each iteration evaluates random perturbations of the weights, each with its opposite in the same
world, and moves the weights towards higher returns (Salimans et al., "Evolution strategies as a
scalable alternative to reinforcement learning", 2017). It prints the mean return of each iteration.
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
    """Options of the training."""

    iterations: int = 60
    pairs: int = 64
    """Perturbations per iteration, each with its opposite."""
    seconds: float = 10.0
    """Length of an episode [s]."""
    sigma: float = 0.3
    """Standard deviation of the perturbations."""
    learning_rate: float = 0.1
    seed: int = 0


def policy(weights: dict, obs: jax.Array) -> jax.Array:
    """Compute the action (3,) of an observation (44,), linear in taxels and target direction."""
    taxels, p_robot_target = jnp.tanh(obs[:42]), obs[42:]
    direction = p_robot_target / jnp.linalg.norm(p_robot_target)
    return jnp.tanh(weights["w"] @ jnp.concatenate([taxels, direction]) + weights["b"])


def episode_return(env: rps_jax.PushEnv, steps: int, weights: dict, key: jax.Array) -> jax.Array:
    """Compute the return () of one episode."""

    def step(state, _):
        state = env.step(state, policy(weights, state.obs))
        return state, state.reward

    return jax.lax.scan(step, env.reset(key), length=steps)[1].sum()


def main(options: Options) -> list[float]:
    """Train, and return the mean return of each iteration."""
    env = rps_jax.PushEnv(
        "random_box", setting=rps_jax.Setting("fused", fidelity="fast", split="tune")
    )
    steps = round(options.seconds / env.dt)
    start = {"w": jnp.zeros((3, 44)), "b": jnp.zeros(3)}
    weights, unravel = ravel_pytree(start)
    optimizer = optax.adam(options.learning_rate)
    returns_of = jax.vmap(lambda flat, key: episode_return(env, steps, unravel(flat), key))

    @jax.jit
    def iterate(weights, state, key):
        key_noise, key_world = jax.random.split(key)
        noise = jax.random.normal(key_noise, (options.pairs, weights.size))
        candidates = weights + options.sigma * jnp.concatenate([noise, -noise])
        worlds = jnp.tile(jax.random.split(key_world, options.pairs), 2)
        returns = returns_of(candidates, worlds)
        difference = returns[: options.pairs] - returns[options.pairs :]
        gradient = -(difference / (returns.std() + 1e-6)) @ noise / options.pairs
        update, state = optimizer.update(gradient, state)
        return optax.apply_updates(weights, update), state, returns.mean()

    state, returns = optimizer.init(weights), []
    for i, key in enumerate(jax.random.split(jax.random.key(options.seed), options.iterations)):
        weights, state, mean = iterate(weights, state, key)
        returns.append(float(mean))
        print(f"iteration {i}: mean return {returns[-1]:.3f}")
    return returns


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
