"""RPS led by somebody who knows the future: the law's twist plus offsets that were planned.

No law of its own: `studies.ceiling` searches offsets under which a world is won, and so learns
whether it can be. With offsets of zero it is RPS, bit for bit. The twist is

  G1  V = sat(V_RPS + (v_max o_x, v_max o_y, omega_max o_w)),  o = offsets[floor(n / hold)]

in the n-th control step, sat being the saturation of Sec. III; after the last offset RPS goes on
alone. What the law felt under the offsets it remembers.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.control.base import Law, document_fields
from rps_jax.control.laws import rps
from rps_jax.control.laws.rps import RPSParams, RPSState
from rps_jax.control.observation import Details, Observation, Twist

KNOTS = 60  # offsets of a plan, by default


@document_fields
class GuidedParams(NamedTuple):
    """The parameters of the law, and the plan."""

    law: RPSParams = RPSParams.tuned()
    offsets: ArrayLike = np.zeros((KNOTS, 3))  # (J, 3) [1] of v_x, v_y, omega, in units of bounds
    hold: float | jax.Array = 250  # [1] control steps of each offset: 5 s, so that 60 take 300 s

    @property
    def d_success(self) -> float | jax.Array:
        """[m] Target reached."""
        return self.law.d_success


class GuidedState(NamedTuple):
    """What the law remembers, and how far the plan is."""

    law: RPSState
    steps: jax.Array  # () int32 control steps done


def check(params: GuidedParams) -> GuidedParams:
    """Return the parameters if they mean something, or raise InputError."""
    rps.check(params.law)
    errors.check_finite("guided.hold", params.hold, at_least=1)
    shape = np.shape(params.offsets)
    if len(shape) != 2 or shape[1] != 3 or not shape[0]:
        raise errors.InputError(
            f"guided.offsets of shape {shape} are not allowed: give (J, 3) numbers, J at least 1."
        )
    if not np.isfinite(np.asarray(params.offsets)).all():
        raise errors.InputError("guided.offsets are not allowed: each must be a finite number.")
    return params


def init(params: GuidedParams) -> GuidedState:
    """Before the first control step."""
    return GuidedState(RPSState.init(params.law), jnp.zeros((), jnp.int32))


def step(
    params: GuidedParams, state: GuidedState, obs: Observation
) -> tuple[GuidedState, Twist, Details]:
    """One control step: the law's twist and G1."""
    memory, twist, details = rps.step_with_details(params.law, state.law, obs)
    offsets = jnp.asarray(params.offsets)
    which = jnp.floor(state.steps / params.hold).astype(jnp.int32)
    now = offsets[jnp.minimum(which, offsets.shape[0] - 1)]
    now = jnp.where(which < offsets.shape[0], now, 0.0)
    v_max, omega_max = params.law.v_max, params.law.omega_max
    by = Twist(v_max * now[0], v_max * now[1], omega_max * now[2])
    led = rps.saturate(params.law, Twist(*(a + b for a, b in zip(twist, by, strict=True))))
    alone = jnp.all(now == 0)
    twist = jax.tree.map(lambda a, b: jnp.where(alone, a, b), twist, led)
    return GuidedState(memory, state.steps + 1), twist, details


LAW = Law(init, step, check=check)
PRESETS = {"_guided": GuidedParams()}  # not offered: `rps ceiling` makes its plans
