"""`unicycle` with odometry that drifts, by errors of the way and of turns that are drawn per world.

What the law remembers drifts. The target does not: a robot that localises it publishes it anew.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

from rps_jax import Law, Observation, register_law
from rps_jax.geometry import planar
from rps_jax.laws import law_of, resolve_law

WAY, TURN = 0.02, 2 / 360  # [1] greatest errors: 2 % of the way, and 2 degrees in a turn
_, PARAMS = resolve_law("unicycle")
UNICYCLE = law_of(PARAMS)


class DriftParams(NamedTuple):
    """Parameters of the law."""

    law: Any = PARAMS

    @property
    def d_success(self) -> Any:
        """Distance at which the target is reached [m]."""
        return self.law.d_success


class DriftState(NamedTuple):
    """State of the law, and poses (3,) [m, m, rad] by odometry without and with drift."""

    law: Any
    pose: Any
    drifted: Any
    has_started: Any  # () bool
    target: Any  # (2,) [m] the first one, of whose digits the errors are


def init(params: DriftParams) -> DriftState:
    """Return the state before the first step."""
    zero = jnp.zeros(3)
    return DriftState(UNICYCLE.init(params.law), zero, zero, jnp.zeros((), bool), zero[:2])


def step(params: DriftParams, state: DriftState, obs: Observation) -> tuple[Any, Any, Any]:
    """Compute one control step with the drifted pose."""
    pose = jnp.append(obs.p_world_robot, obs.yaw)
    target = jnp.where(state.has_started, state.target, obs.p_world_target)
    way, turn = 2 * jnp.mod(1e3 * target, 1) - 1  # uniform from -1 to 1
    last = jnp.where(state.has_started, state.pose, pose)
    old = jnp.where(state.has_started, state.drifted, pose)
    moved = (1 + WAY * way) * planar.rotate(-last[2], pose[:2] - last[:2])
    yaw = old[2] + (1 + TURN * turn) * (pose[2] - last[2])
    drifted = jnp.append(old[:2] + planar.rotate(old[2], moved), yaw)
    p_robot_target = planar.rotate(-pose[2], obs.p_world_target - pose[:2])
    aim = drifted[:2] + planar.rotate(yaw, p_robot_target)
    seen = obs._replace(p_world_robot=drifted[:2], yaw=yaw, p_world_target=aim)
    law, twist, details = UNICYCLE.step(params.law, state.law, seen)
    return DriftState(law, pose, drifted, state.has_started | True, target), twist, details


register_law("drift", Law(init, step, drives=UNICYCLE.drives, room=UNICYCLE.room), DriftParams())
