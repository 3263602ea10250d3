"""A law of one's own in random worlds: a pure function from memory and touch to a twist.

python notebooks/examples/own_law.py
rps sweep --strategies rps notebooks/examples/own_law.py:PParams --worlds 1000
"""

from typing import NamedTuple

import jax.numpy as jnp

import rps_jax
from rps_jax import Details, Twist, law, planar


class Gains(NamedTuple):
    l: float = 0.2  # [1/s] sideways, towards the contact  # noqa: E741
    heading: float = 0.1  # [1/s] turning, towards the target


class PParams(NamedTuple):
    v: float = 0.05  # [m/s] forward
    gains: Gains = Gains()  # parameters may be nested
    d_success: float = 0.05  # [m]


def step(params, memory, seen):
    """The twist of one control step; memory is not needed here."""
    details = Details.of(seen)  # with the contact's lateral place l
    error = planar.wrap(planar.direction(law.displacement(seen)) - seen.yaw)
    turn = jnp.clip(params.gains.heading * error, -0.15, 0.15)
    omega = jnp.where(seen.in_contact, turn, 0.0)
    return memory, Twist(params.v, params.gains.l * details.l, omega), details


rps_jax.register_strategy("p_control", rps_jax.Strategy(lambda params: (), step), PParams())


def main(worlds: int = 300, horizon: float = 300.0):
    """Success of the law and of this one in the same random worlds."""
    arms = {"rps": rps_jax.RPSParams.paper(), "mine": PParams()}
    rules = rps_jax.Rules(horizon=horizon)
    found = rps_jax.sweep("wide", arms, worlds=worlds, rules=rules)
    print(found.success.mean("world").to_series())
    return found


if __name__ == "__main__":
    main()
