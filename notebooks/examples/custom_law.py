"""Run a custom law in random worlds: a pure function from state and observation to a twist.

python notebooks/examples/custom_law.py
rps sweep --laws rps notebooks/examples/custom_law.py:PParams --worlds 1000
"""

from typing import NamedTuple

import jax.numpy as jnp
import tyro

import rps_jax
from rps_jax import Details, Twist


class Gains(NamedTuple):
    l: float = 0.2  # [1/s] sideways, towards the contact  # noqa: E741
    heading: float = 0.1  # [1/s] turning, towards the target


class PParams(NamedTuple):
    v: float = 0.05  # [m/s] forward
    gains: Gains = Gains()  # parameters may be nested
    d_success: float = 0.05  # [m]


def step(params, state, obs):
    """Return the state, the twist of one control step, and details; this law has no state."""
    details = Details.from_obs(obs)  # with the contact's lateral place l
    cos, sin = jnp.cos(obs.yaw), jnp.sin(obs.yaw)
    to_robot = jnp.array([[cos, sin], [-sin, cos]])
    p_robot_target = to_robot @ (obs.p_world_target - obs.p_world_robot)
    x, y = p_robot_target - obs.p_robot_contact
    error = jnp.arctan2(y, x)
    turn = jnp.clip(params.gains.heading * error, -0.15, 0.15)
    omega = jnp.where(obs.in_contact, turn, 0.0)
    return state, Twist(params.v, params.gains.l * details.l, omega), details


rps_jax.register_law("p_control", rps_jax.Law(lambda params: (), step), PParams())


def main(worlds: int = 300, horizon: float = 300.0):
    """Print success of RPS and of this law in the same random worlds."""
    laws = {"rps": rps_jax.RPSParams.paper(), "mine": PParams()}
    setting = rps_jax.Setting(rules=rps_jax.Rules(horizon=horizon))
    results = rps_jax.sweep(laws, "wide", worlds=worlds, setting=setting)
    print(results.success.mean("world").to_series())
    return results


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
