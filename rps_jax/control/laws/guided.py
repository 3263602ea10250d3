"""A law plus planned offsets of its twist, which `studies.ceiling` optimises for one known world.

If some offsets make a trial succeed, a controller can solve that world. With offsets of zero the
law is RPS, bit for bit, or `unicycle` for bases that cannot move sideways. The twist of the n-th
control step is

  G1  V = sat(V_law + (v_max o_x, v_max o_y, omega_max o_w)),  o = offsets[floor(n / hold)]

where sat is the saturation of Sec. III. After the last offset it is the law. Its state follows the
contacts that occur under the offsets.
"""

from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.control import soft
from rps_jax.control.base import Law, check_finite_leaves
from rps_jax.control.laws import rps, unicycle
from rps_jax.control.laws.rps import RPSParams, RPSState
from rps_jax.control.laws.unicycle import UnicycleParams, UnicycleState
from rps_jax.control.observation import Details, Observation, Twist
from rps_jax.geometry.arrays import Array, Number, Parameter
from rps_jax.robot.robot import DriveKind
from rps_jax.spec import Spec, document, specs_of

KNOTS = 60  # default number of offsets


@document
class GuidedParams(NamedTuple):
    """Parameters of a law, and the planned offsets of its twist."""

    law: Annotated[RPSParams | UnicycleParams, Spec(about="parameters of the law")] = (
        RPSParams.tuned()
    )
    offsets: Annotated[ArrayLike, Spec("1", "offsets of v_x, v_y, omega, in units of bounds")] = (
        np.zeros((KNOTS, 3))
    )  # (J, 3)
    hold: Annotated[
        Parameter, Spec("1", "control steps per offset: 5 s, so that 60 take 300 s", 1)
    ] = 250

    @property
    def d_success(self) -> Number:
        """Distance at which the target is reached [m]."""
        return self.law.d_success


def unplanned(drive: DriveKind) -> GuidedParams:
    """Return the parameters without a plan for bases with a drive."""
    if drive == "omni":
        return GuidedParams()
    return GuidedParams(unicycle.PRESETS[unicycle.PRESET_OF[drive]])


class GuidedState(NamedTuple):
    """State of the law, and the number of control steps."""

    law: RPSState | UnicycleState
    steps: Annotated[Array, Spec("1", "finished control steps")]  # () int32


_LAWS: dict[type, Any] = {  # checks, and functions of the laws that are guided
    RPSParams: (rps.check, RPSState.init, rps.step_with_details),
    UnicycleParams: (unicycle.check, unicycle.init, unicycle.step),
}


def check(params: GuidedParams) -> GuidedParams:
    """Return the parameters if they are in range; otherwise raise InputError."""
    _LAWS[type(params.law)][0](params.law)
    specs_of(GuidedParams)["hold"].check("guided.hold", params.hold)
    shape = np.shape(params.offsets)
    if len(shape) != 2 or shape[1] != 3 or not shape[0]:
        raise errors.not_allowed("shape of guided.offsets", shape, "pass (J, 3), J at least 1")
    check_finite_leaves({"guided.offsets": np.asarray(params.offsets)})
    return params


def init(params: GuidedParams) -> GuidedState:
    """Return the state before the first control step."""
    return GuidedState(_LAWS[type(params.law)][1](params.law), jnp.zeros((), jnp.int32))


def step(
    params: GuidedParams, state: GuidedState, obs: Observation
) -> tuple[GuidedState, Twist, Details]:
    """Compute one control step: the twist of the law with the offset of G1."""
    law_state, twist, details = _LAWS[type(params.law)][2](params.law, state.law, obs)
    offsets = jnp.asarray(params.offsets)
    index = jnp.floor(state.steps / params.hold).astype(jnp.int32)
    offset = offsets[jnp.minimum(index, offsets.shape[0] - 1)]
    offset = jnp.where(index < offsets.shape[0], offset, 0.0)
    v_max, omega_max = params.law.v_max, params.law.omega_max
    scaled = (v_max * offset[0], v_max * offset[1], omega_max * offset[2])
    guided = Twist(*(a + b for a, b in zip(twist, scaled, strict=True)))
    if isinstance(params.law, RPSParams):
        guided = rps.saturate(params.law, guided)
    else:
        guided = guided.saturate(v_max, omega_max)
    twist = soft.tree_where(jnp.all(offset == 0), twist, guided)
    return GuidedState(law_state, state.steps + 1), twist, details


LAW = Law(init, step, check=check, drives=unicycle.LAW.drives)
# Not listed: `rps ceiling` sets the offsets.
PRESETS = {"_guided": GuidedParams()}
