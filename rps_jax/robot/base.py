"""Sensors of the base: its pose from odometry, the delay of its commands, and its load cell.

The engines compute the force of the object on the base. A real load cell adds noise, filters, and
reports nothing below a threshold. The paper's robot has no load cell; these numbers are ours, of
the size that data sheets of wrist sensors give.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.geometry.arrays import Number, Pair

_ODOMETRY, _FORCE = 7, 11  # folded into a world's key; the skin splits it into fewer


class Odometry(NamedTuple):
    """Errors of the base: of the pose that the law observes, and of the executed twist.

    Latencies and delays are rounded to control steps. The length K of `past` is the number of
    remembered steps, more than the longest latency or delay; with K = 0 the base is perfect.
    """

    pose_noise: Number = 0.0  # () [m] standard deviation of each position reading
    yaw_noise: Number = 0.0  # () [rad] standard deviation of each heading reading
    pose_latency: Number = 0.0  # () [s] age of the pose that the law observes
    command_delay: Number = 0.0  # () [s] between a command and its execution
    # (3,) [1] of each component of the twist; of a differential drive, the first and the last are
    # those of the left and the right wheel
    velocity_error: Number = 0.0
    past: np.ndarray | jax.Array = np.zeros(0)  # (K,)


def observe_pose(
    odometry: Odometry,
    poses: jax.Array,
    pose: jax.Array,
    key: jax.Array,
    steps: jax.Array,
    period: float,
) -> Pair:
    """Return the latest poses (K, 3), the current `pose` (3,) first, and the observed pose (3,).

    Poses are [m, m, rad]. `steps` () control steps of `period` [s] are done.
    """
    if not poses.shape[0]:
        return poses, pose
    poses = jnp.concatenate([pose[None], poses[:-1]])
    delayed = poses[_steps_of(odometry.pose_latency, period)]
    noise = jax.random.fold_in(jax.random.fold_in(key, _ODOMETRY), steps)
    sigma = jnp.stack([odometry.pose_noise] * 2 + [odometry.yaw_noise])
    return poses, delayed + sigma * jax.random.normal(noise, (3,), pose.dtype)


def delay_twist(odometry: Odometry, twists: jax.Array, twist: jax.Array, period: float) -> Pair:
    """Return the latest commanded twists (K, 3), `twist` (3,) first, and the delayed one (3,)."""
    twists = jnp.concatenate([twist[None], twists[:-1]])
    delayed = twists[_steps_of(odometry.command_delay, period)]
    return twists, delayed


def _steps_of(time: Number, period: float) -> jax.Array:
    return jnp.round(time / period).astype(jnp.int32)


# --- the load ------------------------------------------------------------------------------


class LoadCell(NamedTuple):
    """A sensor of the planar force on the base; static, and so plain numbers."""

    noise: float = 1.0  # [N] standard deviation of each raw reading, of both components
    # [s] of the low-pass filter, from Heins and Schoellig (2024)
    time_constant: float = 0.05
    threshold: float = 2.0  # [N] of the filtered force, below which the reading is zero

    def check(self) -> None:
        """Raise InputError for noise, filter or threshold that no sensor can have."""
        errors.check_finite("load cell noise", self.noise, at_least=0, unit="N")
        errors.check_finite("load cell time_constant", self.time_constant, above=0, unit="s")
        errors.check_finite("load cell threshold", self.threshold, at_least=0, unit="N")

    def read(
        self, load: Load, key: jax.Array, steps: jax.Array, period: float
    ) -> tuple[Load, jax.Array]:
        """Read the force (2,) [N] of the object on the base, in the base's frame.

        The reading follows `steps` () control steps, `period` [s] after the previous one.
        """
        noise = jax.random.fold_in(jax.random.fold_in(key, _FORCE), steps)
        signal = load.signal
        raw = load.wrench[:2] + self.noise * jax.random.normal(noise, (2,), signal.dtype)
        signal = signal + (1 - jnp.exp(-period / self.time_constant)) * (raw - signal)
        above = jnp.sum(signal * signal) >= self.threshold**2
        return load._replace(signal=signal), jnp.where(above, signal, 0.0)


class Load(NamedTuple):
    """State of a load cell between two readings."""

    wrench: jax.Array  # (3,) [N, N, N m] of the object on the base in the last period, its frame
    signal: jax.Array  # (2,) [N] the filtered force


def init_load(template: jax.Array) -> Load:
    """Return the state before the first reading, in the precision of `template`."""
    return Load(jnp.zeros(3, template.dtype), jnp.zeros(2, template.dtype))
