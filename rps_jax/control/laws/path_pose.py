"""Follow a path, and bring the object to the heading at its end.

  P1  the law `unicycle`, while the goal has no heading yet (NaN);  then `pose`, from its start

Both parts suit bases with and without an axle. `unicycle` drives around an object that it has lost.
The law needs a flat front, as `pose`, and ends each trial by the word of `pose`.
"""

from typing import NamedTuple

import jax.numpy as jnp

from rps_jax.control import soft
from rps_jax.control.base import Law, Memory, bounds_of, nested_bounds
from rps_jax.control.laws import pose, unicycle
from rps_jax.control.laws.pose import PoseParams, PoseState
from rps_jax.control.laws.unicycle import UnicycleParams, UnicycleState
from rps_jax.control.observation import Details, EndsObservation, Twist
from rps_jax.geometry.arrays import Array, Number
from rps_jax.spec import document


@document
class PathPoseParams(NamedTuple):
    """Parameters of both laws."""

    path: UnicycleParams = unicycle.PRESETS["unicycle"]
    pose: PoseParams = PoseParams()

    @property
    def d_success(self) -> Number:
        """Distance at which the target is reached [m]."""
        return self.pose.d_success


class PathPoseState(NamedTuple):
    """State of both laws."""

    path: UnicycleState
    pose: PoseState


def init(params: PathPoseParams) -> PathPoseState:
    """Return the state before the first contact."""
    return PathPoseState(unicycle.init(params.path), pose.init(params.pose))


def step(
    params: PathPoseParams, state: PathPoseState, obs: EndsObservation
) -> tuple[PathPoseState, Twist, Details]:
    """Compute one control step of the law of P1."""
    touch = obs.touch._replace(base_radius=None, half_length=obs.front)
    yaw = jnp.asarray(touch.yaw_target)
    on_path = jnp.isnan(yaw)
    path, way_twist, way_details = unicycle.step(params.path, state.path, touch)
    near = obs._replace(touch=touch._replace(yaw_target=jnp.where(on_path, 0.0, yaw)))
    ended, twist, details = pose.step(params.pose, state.pose, near)
    ended = soft.tree_where(on_path, state.pose, ended)
    twist = soft.tree_where(on_path, way_twist, twist)
    return PathPoseState(path, ended), twist, soft.tree_where(on_path, way_details, details)


def observe_sent(
    params: PathPoseParams, state: PathPoseState, obs: EndsObservation, sent: Twist
) -> PathPoseState:
    """Return the state with the twist that moved the base."""
    return state._replace(pose=pose.observe_sent(params.pose, state.pose, obs, sent))


def is_done(state: PathPoseState) -> Array:
    """Return whether the law is done."""
    return state.pose.done


def memory(state: PathPoseState) -> Memory:
    """Return the mode and the object's middle of the present law."""
    return pose.memory(state.pose) if state.pose.time > 0 else unicycle.memory(state.path)


LAW = Law(
    init,
    step,
    senses="ends",
    bounds=nested_bounds("pose", dict(bounds_of(PoseParams))),
    drives=pose.LAW.drives,
    room=pose.LAW.room,
    heading=True,
    follows=True,
    is_done=is_done,
    observe_sent=observe_sent,
    memory=memory,
)
PRESETS = {f"path_{name}": PathPoseParams(pose=params) for name, params in pose.PRESETS.items()}
