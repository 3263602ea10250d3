"""RPS+: the law of `law`, which translates near its target instead of turning.

The tuned law loses most worlds of `wide` within arm's length of the target: wide objects touch off
the middle of the base, Eq. 6 turns it to face the target while it drives on, and it circles the
target at 5 to 15 cm. A holonomic base need not turn: any velocity of the contact point can be had
by translation.

Equations of our own, with C the contact point, d from C to the target T, theta* its direction,
e = theta* - theta the heading error, and v* of Eq. 3 within v_max:

  P1  near = ||d|| < d_near, outside the Realignment State
  P2  v_x = v* max(cos e, press),  v_y = v* sin e,  omega = 0      where near

By P2 C moves straight to T while |e| < arccos(press), and as long as it sticks; farther round the
base keeps pressing with a share `press` of its speed, since a skin cannot pull. Everything else is
the law of Eqs. 1-10 with its own parameters. RPS+ senses what RPS senses, and remembers the same.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rps_jax import errors
from rps_jax.control import law
from rps_jax.control.bounds import Bound
from rps_jax.control.law import Details, Observation, RPSParams, RPSState, Twist
from rps_jax.geometry import planar


class RPSPlusParams(NamedTuple):
    """Parameters of RPS+; the defaults are the tuned ones."""

    law: RPSParams = RPSParams.tuned()
    d_near: float | jax.Array = 0.15  # [m] nearer than this it translates, P1
    press: float | jax.Array = 0.2  # [1] least share of the speed that goes forward, P2

    @property
    def d_success(self) -> float | jax.Array:
        """[m] Target reached."""
        return self.law.d_success


BOUNDS = {f"law.{name}": bound for name, bound in law.BOUNDS.items() if not bound.of} | {
    "law.l_mr": law.BOUNDS["l_mr"]._replace(of="law.l_cr"),
    "d_near": Bound(0.05, 1, log=True),  # [m]
    "press": Bound(0, 1),  # [1]
}


def check(params: RPSPlusParams) -> RPSPlusParams:
    """The same parameters, if scalars that mean something.

    Raises:
      InputError: as `law.check`, or for a length or share that is negative.
    """
    law.check(params.law)
    errors.check_finite("rps_plus.d_near", params.d_near, at_least=0)
    errors.check_finite("rps_plus.press", params.press, at_least=0, at_most=1)
    return params


def init(params: RPSPlusParams) -> RPSState:
    """As that of the law."""
    return RPSState.init(params.law)


def translation(params: RPSPlusParams, d: jax.Array, yaw: jax.Array) -> Twist:
    """P2: the twist that takes the contact straight along d (2,) [m] of the world."""
    error = planar.wrap(planar.direction(d) - yaw)
    speed = params.law.K_v * planar.norm(d)
    forward = jnp.maximum(jnp.cos(error), params.press)
    still = jnp.zeros_like(error)
    return law.saturate(params.law, Twist(speed * forward, speed * jnp.sin(error), still))


def step(
    params: RPSPlusParams, state: RPSState, seen: Observation
) -> tuple[RPSState, Twist, Details]:
    """One control step: the law's, or near the target P2."""
    state, twist, details = law.step_with_details(params.law, state, seen)
    d = law.displacement(seen._replace(p_robot_contact=state.p_robot_contact))
    pushing = jnp.asarray(seen.in_contact) | (state.touched & (params.law.keep_contact > 0))
    near = pushing & ~details.realigning & (details.distance < params.d_near)  # P1
    near &= details.distance >= params.law.d_success
    straight = translation(params, d, seen.yaw)
    twist = jax.tree.map(lambda a, b: jnp.where(near, a, b), straight, twist)
    return state, twist, details
