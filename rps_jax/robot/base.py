"""The base: where it believes it is, how it does what it is told, and what load it feels.

The engines give the force of the object on the base; a real sensor's reading of it is noisy and
filtered, and nothing below a threshold is believed. The paper's robot has no such sensor; its
numbers here are ours, of the size that the data sheets of wrist sensors give.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors

_ODOMETRY, _FORCE = 7, 11  # of a world's key; the skin splits it into fewer


class Odometry(NamedTuple):
    """What a base gets wrong: where it believes it is, and how it does what it is told.

    Ages are rounded to control steps. `past` only gives, by its shape, how many steps are
    remembered, at least one more than the greatest age; without any the base is perfect.
    """

    pose_noise: float | jax.Array = 0.0  # () [m] standard deviation of each position reading
    yaw_noise: float | jax.Array = 0.0  # () [rad] and of each heading reading
    pose_latency: float | jax.Array = 0.0  # () [s] age of the pose that the law observes
    command_delay: float | jax.Array = 0.0  # () [s] until a twist is acted upon
    velocity_error: float | jax.Array = 0.0  # (3,) [1] of each component of the twist
    past: Any = np.zeros(0)  # (K,)


def believed(
    odometry: Odometry,
    poses: jax.Array,
    now: jax.Array,
    key: jax.Array,
    steps: jax.Array,
    period: float,
) -> tuple[jax.Array, jax.Array]:
    """The last poses (K, 3) with `now` (3,) first, and the pose (3,) that the law observes.

    All are [m, m, rad]. So many `steps` () of the control loop, of this `period` [s], are done.
    """
    if not poses.shape[0]:
        return poses, now
    poses = jnp.concatenate([now[None], poses[:-1]])
    told = poses[_age(odometry.pose_latency, period)]
    noise = jax.random.fold_in(jax.random.fold_in(key, _ODOMETRY), steps)
    sigma = jnp.stack([odometry.pose_noise] * 2 + [odometry.yaw_noise])
    return poses, told + sigma * jax.random.normal(noise, (3,), now.dtype)


def executed(
    odometry: Odometry, twists: jax.Array, twist: jax.Array, period: float
) -> tuple[jax.Array, jax.Array]:
    """The last commanded twists (K, 3) with `twist` (3,) first, and the one (3,) carried out."""
    twists = jnp.concatenate([twist[None], twists[:-1]])
    done = twists[_age(odometry.command_delay, period)]
    return twists, done * (1 + odometry.velocity_error)


def _age(time: Any, period: float) -> jax.Array:
    return jnp.round(time / period).astype(jnp.int32)


# --- the load ------------------------------------------------------------------------------


class LoadCell(NamedTuple):
    """A sensor of the planar force on the base; static, and so plain numbers."""

    noise: float = 1.0  # [N] standard deviation of each raw reading, of both components
    # [s] of the low-pass filter, which is what Heins and Schoellig (2024) have
    time_constant: float = 0.05
    threshold: float = 2.0  # [N] of the filtered force, below which it tells none

    def check(self) -> None:
        """Raises InputError for noise, filter or threshold that no sensor can have."""
        errors.check_finite("load cell noise", self.noise, at_least=0, unit="N")
        errors.check_finite("load cell time_constant", self.time_constant, above=0, unit="s")
        errors.check_finite("load cell threshold", self.threshold, at_least=0, unit="N")

    def read(
        self, load: Load, key: jax.Array, steps: jax.Array, period: float
    ) -> tuple[Load, jax.Array]:
        """One reading of the force (2,) [N] of the object on the base, in the base's frame.

        It is the one after `steps` () control steps, `period` [s] after the last.
        """
        drawn = jax.random.fold_in(jax.random.fold_in(key, _FORCE), steps)
        like = load.signal
        raw = load.wrench[:2] + self.noise * jax.random.normal(drawn, (2,), like.dtype)
        signal = like + (1 - jnp.exp(-period / self.time_constant)) * (raw - like)
        told = jnp.sum(signal * signal) >= self.threshold**2
        return load._replace(signal=signal), jnp.where(told, signal, 0.0)


class Load(NamedTuple):
    """What a load cell carries from one reading to the next."""

    wrench: jax.Array  # (3,) [N, N, N m] of the object on the base in the last period, its frame
    signal: jax.Array  # (2,) [N] the filtered force


def unloaded(like: jax.Array) -> Load:
    """Before anything was felt; numbers are of the type of `like`."""
    return Load(jnp.zeros(3, like.dtype), jnp.zeros(2, like.dtype))
