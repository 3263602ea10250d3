"""A strategy of one's own: a pure function from parameters, memory and observation to a twist.

    python notebooks/examples/new_strategy.py

Once registered, its name works wherever `rps` does: in cases by its parameters, and by name in
`rps_jax.app.cli.main(["table", "--strategies", "rps", "p_control"])`.
"""

from typing import NamedTuple

import jax.numpy as jnp

import rps_jax
from rps_jax import Details, Strategy, Twist
from rps_jax.control import law
from rps_jax.geometry import planar


class PParams(NamedTuple):
    v: float = 0.05  # [m/s] forward
    K_l: float = 0.2  # [1/s] sideways, towards the contact
    K_h: float = 0.1  # [1/s] turning, towards the target
    d_success: float = 0.05  # [m]


def step(params, memory, seen):
    error = planar.wrap(planar.direction(law.displacement(seen)) - seen.yaw)
    omega = jnp.clip(params.K_h * error, -0.15, 0.15)
    v_y = params.K_l * seen.p_robot_contact[1]
    twist = Twist(params.v, v_y, jnp.where(seen.in_contact, omega, 0.0))
    return memory, twist, Details.of(seen)


def main(horizon: float = 300.0, engine="fused"):
    """Success of the law and of this strategy at three targets, (2, 3)."""
    rps_jax.register_strategy("p_control", Strategy(lambda params: (), step), PParams())
    both = rps_jax.RPSParams.paper(), PParams()
    targets = (1.5, 0.0), (1.0, 1.0), (-1.0, 1.0)
    cases = [rps_jax.Case("box", rps_jax.FRICTION["S1"], t, p) for p in both for t in targets]
    setting = rps_jax.Setting(rules=rps_jax.Rules(horizon=horizon), engine=engine)
    outcome, _ = rps_jax.run(cases, setting)
    print(outcome.success.reshape(2, 3))
    return outcome


if __name__ == "__main__":
    main()
