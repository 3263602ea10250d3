"""What a law observes, and what it commands.

Frames: W is the world, R the robot (origin at the middle of the base, x forward, y left).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Bool, Float, Scalar

# Displacements are held within this distance [m], so that no finite float32 overflows on the way.
_WORLD_SIZE = 1e9


class Observation(NamedTuple):
    """What a law that senses touch may know: odometry, touch and the target."""

    p_world_robot: Float[Array, "2"]  # [m]
    yaw: Scalar  # [rad] heading of the robot in the world
    p_robot_contact: Float[Array, "2"]  # [m] contact location; ignored unless in_contact
    in_contact: Bool[Array, ""] | Float[Array, ""]  # for a smooth law also a weight from 0 to 1
    p_world_target: Float[Array, "2"]  # [m]
    period: Scalar = 0.02  # [s] since the last control step


class TaxelObservation(NamedTuple):
    """What a law that senses taxels may know besides: what each taxel answers."""

    touch: Observation  # `in_contact` is a bool
    signal: Float[Array, " T"]  # [1] filtered relative change of capacitance; 0 of a dead taxel
    line: Bool[Array, ""]  # the contact is a line, longer than a point


class ForceObservation(NamedTuple):
    """What a law that senses the contact's force may know besides."""

    touch: Observation
    f_robot: Float[Array, "2"]  # [N] of the object on the base, in its frame: see `LoadCell`


class PoseObservation(NamedTuple):
    """What a law that senses the object's pose may know besides: where and how large it is."""

    touch: Observation
    p_world_object: Float[Array, "2"]  # [m]
    r_object: Scalar  # [m] radius of the object's outline


class Twist(NamedTuple):
    """Commanded velocity of the base, in the robot frame."""

    v_x: float | Float[Array, "*B"]  # [m/s] forward
    v_y: float | Float[Array, "*B"]  # [m/s] left
    omega: float | Float[Array, "*B"]  # [rad/s] counter-clockwise

    @classmethod
    def from_point_velocity(
        cls, p_robot: Float[Array, "2"], v_robot: Float[Array, "2"], omega: Scalar
    ) -> Twist:
        """What moves the base's point `p_robot` [m] at `v_robot` [m/s], and turns it."""
        return cls(v_robot[0] + omega * p_robot[1], v_robot[1] - omega * p_robot[0], omega)

    def saturate(
        self, v_max: float | Float[Array, "..."], omega_max: float | Float[Array, "..."]
    ) -> Twist:
        """(v_x, v_y) scaled as a vector to norm v_max [m/s], omega clipped to omega_max [rad/s]."""
        v, most = jnp.stack([self.v_x, self.v_y], axis=-1), jnp.asarray(v_max)
        v = v * (most / jnp.maximum(planar.norm(v), most))[..., None]
        omega = jnp.clip(self.omega, -jnp.asarray(omega_max), omega_max)
        return Twist(v[..., 0], v[..., 1], omega)

    def in_world(self, yaw: Scalar) -> Float[Array, "3"]:
        """Velocities [m/s, m/s, rad/s] in the world, of a base with the heading `yaw`."""
        v_world = planar.rotate(yaw, jnp.stack([self.v_x, self.v_y]))
        return jnp.stack([*v_world, jnp.asarray(self.omega)])


class Details(NamedTuple):
    """The quantities behind one twist, for plots and tests."""

    l: Float[Array, "*B"]  # noqa: E741  [m] lateral contact location, the paper's symbol
    distance: Float[Array, "*B"]  # [m] ||d||, contact point to target
    a_r: Float[Array, "*B"]  # [1] adaptive rate
    gamma: Float[Array, "*B"]  # [rad] steering angle
    realigning: Bool[Array, "*B"] | Float[Array, "*B"]  # in the Realignment State; or a weight

    @classmethod
    def from_obs(cls, obs: Observation) -> Details:
        """Details of a law that has neither an adaptive rate nor a steering angle: both are 0."""
        distance = planar.norm(displacement(obs))
        zero = jnp.zeros_like(distance)
        l = obs.p_robot_contact[..., 1]  # noqa: E741
        return cls(l, distance, zero, zero, zero > 0)


def displacement(obs: Observation) -> Float[Array, "2"]:
    """Eq. 4: d = p^W_T - (p^W_R + R^W_R p^R_C), from contact to target, [m] in the world."""
    p_world_contact = obs.p_world_robot + planar.rotate(obs.yaw, obs.p_robot_contact)
    d = obs.p_world_target - p_world_contact
    return jnp.clip(d, -_WORLD_SIZE, _WORLD_SIZE)
