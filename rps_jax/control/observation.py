"""Observations of a law, its command, and the details it reports.

Frames: W is the world, R the robot (origin at the centre of the base, x forward, y left).
"""

from __future__ import annotations

from typing import Annotated, NamedTuple, TypeVar, cast

import jax.numpy as jnp

from rps_jax.geometry import planar
from rps_jax.geometry.arrays import (
    Array,
    Bool,
    Bools,
    Float,
    Floats,
    Number,
    PerWorld,
    Scalar,
    Vector,
)
from rps_jax.robot.robot import Robot
from rps_jax.spec import Spec

# Displacements are clipped to this distance [m], so that no finite float32 overflows.
_WORLD_SIZE = 1e9


class Observation(NamedTuple):
    """Observation of a law that senses touch: odometry, the contact and the target."""

    p_world_robot: Annotated[Vector, Spec("m", "position of the robot in the world")]
    yaw: Annotated[Scalar, Spec("rad", "heading of the robot in the world")]
    p_robot_contact: Annotated[
        Vector, Spec("m", "contact point in the robot frame; ignored unless in_contact")
    ]
    in_contact: Annotated[
        Bool[Array, ""] | Float[Array, ""],
        Spec("1", "whether there is a contact; for a smooth law also a weight from 0 to 1"),
    ]
    p_world_target: Annotated[Vector, Spec("m", "target in the world")]
    period: Annotated[Scalar, Spec("s", "time since the last control step")] = 0.02
    base_radius: Annotated[
        Number | None, Spec("m", "radius of a round base; None: a rectangle")
    ] = None
    axle: Annotated[
        Number | None,
        Spec("m", "axle that cannot move sideways, behind the base's middle; None: there is none"),
    ] = None
    turning_radius: Annotated[
        Number | None, Spec("m", "least turning radius of a car's axle; None: it may be 0")
    ] = None
    half_length: Annotated[
        Number | None, Spec("m", "half length of a rectangle with such an axle")
    ] = None
    yaw_target: Annotated[
        Scalar | None, Spec("rad", "heading of the goal, the direction of the last push; or None")
    ] = None
    relative: Annotated[
        Scalar | None,
        Spec("1", "1: yaw_target is relative to the face that is first felt flush; or None"),
    ] = None

    def with_base(self, radius: Number | None, robot: Robot | None = None) -> Observation:
        """Return it with the static facts of a base.

        They are the `radius` [m] of a round base, None for a rectangle, and the drive of the robot.
        """
        facts = {"base_radius": radius}
        if robot is not None and robot.drive != "omni":
            facts |= {"axle": robot.axle_behind, "turning_radius": robot.turning_radius}
            facts |= {"half_length": robot.half_length}
        return self._replace(**facts)

    def with_ends(self, signal: Array, alive: Array, ends: tuple[Array, ...]) -> EndsObservation:
        """Return it with the signals (T,) of taxels, whether these work, and the ends."""
        return EndsObservation(self, signal, alive, *ends)

    @property
    def l(self) -> Floats:  # noqa: E743
        """Contact offset [m] to the left: p^R_C,y, or the arc length from a round base's front."""
        if self.base_radius is None:
            return self.p_robot_contact[..., 1]
        bearing = planar.direction(self.p_robot_contact)
        return jnp.asarray(self.base_radius, bearing.dtype) * bearing


class TaxelObservation(NamedTuple):
    """Observation of a law that also senses the signal of each taxel."""

    touch: Observation  # `in_contact` is a bool
    signal: Annotated[
        Float[Array, " T"], Spec("1", "filtered relative change of capacitance; 0 for a dead taxel")
    ]
    line: Annotated[
        Bool[Array, ""], Spec("1", "whether the contact is a line, longer than a point")
    ]


class EndsObservation(NamedTuple):
    """Observation of a law that also senses the ends of the contact on the front."""

    touch: Observation
    signal: Annotated[
        Float[Array, " T"], Spec("1", "filtered relative change of capacitance; 0 for a dead taxel")
    ]
    alive: Annotated[Bool[Array, " T"], Spec("1", "whether each taxel works")]
    ends: Annotated[
        Float[Array, "2"], Spec("m", "offsets of the contact's left and right end; 0 without one")
    ]
    seen: Annotated[
        Bool[Array, "2"], Spec("1", "whether the object ends there, not the front or its taxels")
    ]
    even: Annotated[
        Bool[Array, ""], Spec("1", "whether a face lies flush on the front, over 3 taxels or more")
    ]
    front: Annotated[Scalar, Spec("m", "distance of the front from the base's middle")]


class ForceObservation(NamedTuple):
    """Observation of a law that also senses the contact force."""

    touch: Observation
    f_robot: Annotated[
        Vector, Spec("N", "force of the object on the base, in the robot frame: see `LoadCell`")
    ]


class PoseObservation(NamedTuple):
    """Observation of a law that also senses the object's position and size."""

    touch: Observation
    p_world_object: Annotated[Vector, Spec("m", "position of the object in the world")]
    r_object: Annotated[Scalar, Spec("m", "radius of the object's outline")]
    corners: Annotated[
        Float[Array, "N 2"] | None,
        Spec("m", "corners of this outline in the robot frame; None unless the law has a heading"),
    ] = None


AnyObservation = (
    Observation | TaxelObservation | EndsObservation | ForceObservation | PoseObservation
)


Observed = TypeVar("Observed", bound=AnyObservation)


def with_base(obs: Observed, radius: Number | None, robot: Robot | None = None) -> Observed:
    """Return an observation with the static facts of a base: see `Observation.with_base`."""
    if isinstance(obs, Observation):
        return cast(Observed, obs.with_base(radius, robot))
    return obs._replace(touch=obs.touch.with_base(radius, robot))


class Twist(NamedTuple):
    """Commanded velocity of the base, in the robot frame."""

    v_x: Annotated[PerWorld, Spec("m/s", "forward velocity")]
    v_y: Annotated[PerWorld, Spec("m/s", "velocity to the left")]
    omega: Annotated[PerWorld, Spec("rad/s", "turning rate, counter-clockwise")]

    @classmethod
    def from_point_velocity(cls, p_robot: Vector, v_robot: Vector, omega: Scalar) -> Twist:
        """Return the twist that moves the base's point `p_robot` [m] at `v_robot` [m/s]."""
        return cls(v_robot[0] + omega * p_robot[1], v_robot[1] - omega * p_robot[0], omega)

    def saturate(
        self, v_max: float | Float[Array, "..."], omega_max: float | Float[Array, "..."]
    ) -> Twist:
        """Scale (v_x, v_y) as a vector to norm v_max [m/s], and clip omega to omega_max [rad/s]."""
        v, limit = jnp.stack([self.v_x, self.v_y], axis=-1), jnp.asarray(v_max)
        v = v * (limit / jnp.maximum(planar.norm(v), limit))[..., None]
        omega = jnp.clip(self.omega, -jnp.asarray(omega_max), omega_max)
        return Twist(v[..., 0], v[..., 1], omega)

    def in_world(self, yaw: Scalar) -> Float[Array, "3"]:
        """Return the velocity [m/s, m/s, rad/s] in the world of a base with heading `yaw`."""
        v_world = planar.rotate(yaw, jnp.stack([self.v_x, self.v_y]))
        return jnp.stack([*v_world, jnp.asarray(self.omega)])


class Details(NamedTuple):
    """Intermediate quantities of one control step, for plots and tests."""

    l: Annotated[Floats, Spec("m", "contact offset, the paper's symbol")]  # noqa: E741
    distance: Annotated[Floats, Spec("m", "||d||, contact point to target")]
    a_r: Annotated[Floats, Spec("1", "adaptive rate")]
    gamma: Annotated[Floats, Spec("rad", "steering angle")]
    realigning: Annotated[
        Bools | Floats, Spec("1", "whether the law is in the Realignment State; or a weight")
    ]

    @classmethod
    def from_obs(cls, obs: Observation) -> Details:
        """Return the details of a law without adaptive rate and steering angle (both are 0)."""
        distance = planar.norm(displacement(obs))
        zero = jnp.zeros_like(distance)
        return cls(obs.l, distance, zero, zero, zero > 0)


def displacement(obs: Observation) -> Vector:
    """Compute Eq. 4, d = p^W_T - (p^W_R + R^W_R p^R_C) [m]: from contact to target, in W."""
    p_world_contact = obs.p_world_robot + planar.rotate(obs.yaw, obs.p_robot_contact)
    return jnp.clip(obs.p_world_target - p_world_contact, -_WORLD_SIZE, _WORLD_SIZE)
