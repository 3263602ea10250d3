"""Force Push without a force sensor: the law of Heins and Schoellig, from the contact point alone.

"Force Push: Robust Single-Point Pushing with Force Feedback" (IEEE RA-L 9, 2024) pushes with one
point along a path. The point moves at the angle theta_p = (1 + k_theta) theta_f + k_y Delta from
the path, where theta_f is the angle of the contact force and Delta the offset of the contact from
the path. A larger offset turns the object back to the path. Without contact, theta_p tends to
-k_y Delta, which leads back to the path, by a bounded amount each step.

On a flat skin the force is normal to the skin, plus friction towards the side to which the contact
drifts. Here theta_f is therefore estimated as the base's heading plus the angle of the contact's
drift over the skin: that of (lambda, l - l_mean), with l_mean the mean of l over the last length
lambda of the base's path. As in their experiments, the base turns to face along the path, with gain
k_omega. Our choices: the path is the straight line from the first contact to the target, and is
replaced when the contact has passed the target or the target has left the line, as targets do that
move along a path; since a skin cannot pull, the push stays within angle_max of the heading; the
speed bound is that of RPS.

The line to a target at the lookahead L on a straight path is at the angle -Delta / L from this
path. From the path, the push is then at (1 + k_theta) theta_f + k_theta Delta / L, which is the law
of the paper with k_y = k_theta / L.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp

from rps_jax import spec
from rps_jax.control import soft
from rps_jax.control.base import (
    ApproachSpeed,
    LastContact,
    Law,
    OmegaMax,
    SuccessDistance,
    Touched,
    bounds_of,
)
from rps_jax.control.observation import Details, Observation, Twist, displacement
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Parameter, Pytree, Scalar
from rps_jax.spec import Spec, document, tunable

# Parameters of both forms of Force Push.
AngleGain = Annotated[
    Parameter, tunable("1", "gain of the force's angle, beyond 1", -2, 4, ge=None)
]
HeadingGain = Annotated[Parameter, tunable("1/s", "gain of the heading", 0.005, 2, log=True)]
ContactSpeed = Annotated[
    Parameter, Spec("m/s", "speed of the contact, and bound for the base", gt=0)
]
_TOLERANCE = 0.01  # [m] beside a path, beyond which a target has left it


@document
class ForcePushParams(NamedTuple):
    """Parameters of Force Push; the gains are those of its authors' experiments."""

    k_theta: AngleGain = 0.3
    k_y: Annotated[Parameter, tunable("rad/m", "gain of the path", -2, 2, ge=None)] = 0.5
    k_omega: HeadingGain = 1.0
    converge: Annotated[
        Parameter,
        tunable("rad", "largest change of theta_p in a step without contact", 0.001, 1, log=True),
    ] = 0.1
    drift: Annotated[
        Parameter,
        tunable(
            "m", "lambda, length of motion over which drift is estimated", 0.01, 1, log=True, gt=0
        ),
    ] = 0.1
    angle_max: Annotated[
        Parameter,
        tunable("rad", "largest angle between push and heading", 0.2, 1.57, gt=0),
    ] = 1.2
    v_max: ContactSpeed = 0.05
    omega_max: OmegaMax = 0.15
    v_approach: ApproachSpeed = 0.01
    d_success: SuccessDistance = 0.05


class Path(NamedTuple):
    """Path of the contact: a straight line from a contact through the target."""

    p_world_start: Annotated[Array, Spec("m", "start of the path")]  # (2,)
    theta_d: Annotated[Array, Spec("rad", "direction of the path in the world")]  # ()
    p_robot_contact: LastContact
    touched: Touched

    @classmethod
    def initial(cls, dtype: jax.typing.DTypeLike) -> Path:
        """Return the path before any contact."""
        two = jnp.zeros(2, dtype)
        return cls(two, jnp.zeros((), dtype), two, jnp.zeros((), bool))

    def update(self, obs: Observation) -> tuple[Path, Observation, Array]:
        """Return path, observation with the last contact, and its offset () [m] to the left.

        A new path starts when the contact has passed the target, or the target has left the path.
        """
        touching = jnp.asarray(obs.in_contact)
        contact = jnp.where(touching, obs.p_robot_contact, self.p_robot_contact)
        filled = obs._replace(p_robot_contact=contact)
        d = displacement(filled)
        p_world_contact = obs.p_world_target - d
        along = planar.unit(self.theta_d)
        passed = self.touched & touching & (jnp.sum(d * along) < 0)
        way = obs.p_world_target - self.p_world_start
        has_left = jnp.abs(along[0] * way[1] - along[1] * way[0]) > _TOLERANCE
        is_new = (touching & (~self.touched | has_left)) | passed
        p_world_start = jnp.where(is_new, p_world_contact, self.p_world_start)
        theta_d = jnp.where(is_new, planar.direction(d), self.theta_d)
        normal = jnp.stack([-jnp.sin(theta_d), jnp.cos(theta_d)])
        offset = jnp.sum((p_world_contact - p_world_start) * normal)
        return Path(p_world_start, theta_d, contact, self.touched | touching), filled, offset

    def twist(self, params: Pytree, v_robot: Array, yaw: Scalar) -> Twist:
        """Return the twist that moves the contact at `v_robot` (2,) [m/s] and faces along the path.

        Before the first contact the base moves straight ahead.
        """
        turn = params.k_omega * planar.wrap(self.theta_d - yaw)
        omega = jnp.clip(turn, -params.omega_max, params.omega_max)
        push = Twist.from_point_velocity(self.p_robot_contact, v_robot, omega)
        push = push.saturate(params.v_max, params.omega_max)
        ahead = Twist(params.v_approach, 0.0, 0.0)
        return soft.tree_where(self.touched, push, ahead)


class ForcePushState(NamedTuple):
    """State of the law between two control steps."""

    path: Path
    theta_p: Annotated[Array, Spec("rad", "angle of the last push from the path")]  # ()
    l_mean: Annotated[Array, Spec("m", "mean of l over the last motion")]  # ()
    p_world_robot: Annotated[Array, Spec("m", "position of the base at the last step")]  # (2,)


check = partial(spec.check, prefix="force_push.")


def init(params: ForcePushParams) -> ForcePushState:
    """Return the state before any contact."""
    zero = jnp.zeros_like(jnp.asarray(params.v_max, float))
    return ForcePushState(Path.initial(zero.dtype), zero, zero, jnp.zeros(2, zero.dtype))


def steer(
    params: Pytree,  # of either law
    theta_p: Array,  # () [rad] at the last step
    theta_f: Array,  # () [rad] angle of the force from the path
    offset: Array,  # () [m] of the contact, to the path's left
    limit: Scalar,  # () [rad] bound on the change of theta_p without contact
    in_contact: Array,
) -> Array:
    """Return the angle () [rad] of the push from the path."""
    pushed = (1 + params.k_theta) * theta_f + params.k_y * offset
    back = theta_p + jnp.clip(planar.wrap(-params.k_y * offset - theta_p), -limit, limit)
    return planar.wrap(jnp.where(in_contact, pushed, back))


def step(
    params: ForcePushParams, state: ForcePushState, obs: Observation
) -> tuple[ForcePushState, Twist, Details]:
    """Compute one control step; before the first contact the base moves straight ahead."""
    path, filled, offset = state.path.update(obs)
    l, theta_d = filled.l, path.theta_d  # noqa: E741
    motion = planar.norm(obs.p_world_robot - state.p_world_robot)
    weight = jnp.exp(-motion / params.drift)
    l_mean = l + weight * (state.l_mean - l)
    l_mean = jnp.where(state.path.touched, l_mean, l)
    drifted = jnp.stack([jnp.asarray(params.drift, l.dtype), l - l_mean])
    theta_f = planar.wrap(obs.yaw - theta_d) + planar.direction(drifted)
    theta_p = steer(params, state.theta_p, theta_f, offset, params.converge, obs.in_contact)
    angle = planar.wrap(theta_d + theta_p - obs.yaw)
    angle = jnp.clip(angle, -jnp.asarray(params.angle_max), params.angle_max)
    v_contact = params.v_max * planar.unit(angle)
    twist = path.twist(params, v_contact, obs.yaw)
    theta_p = jnp.where(path.touched, theta_p, 0.0)
    state = ForcePushState(path, theta_p, l_mean, obs.p_world_robot)
    return state, twist, Details.from_obs(filled)._replace(gamma=theta_p)


LAW = Law(init, step, check=check, bounds=bounds_of(ForcePushParams))
PRESETS = {"force_push": ForcePushParams()}
