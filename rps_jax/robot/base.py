"""Sensors of the base: its pose from odometry, the delay of its commands, and its load cell.

The engines compute the force of the object on the base. A real load cell adds noise, filters, and
reports nothing below a threshold. The paper's robot has no load cell; these numbers are ours, of
the size that data sheets of wrist sensors give.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import spec
from rps_jax.geometry.arrays import Number, Pair
from rps_jax.spec import Spec

_ODOMETRY, _FORCE = 7, 11  # folded into a world's key; the skin splits it into fewer


class Odometry(NamedTuple):
    """Errors of the base: of the pose that the law observes, and of the executed twist.

    Latencies and delays are rounded to control steps. The length K of `past` is the number of
    remembered steps, more than the longest latency or delay; with K = 0 the base is perfect.
    """

    pose_noise: Annotated[
        Number, Spec("m", "standard deviation of each position reading", ge=0)
    ] = 0.0  # ()
    yaw_noise: Annotated[
        Number, Spec("rad", "standard deviation of each heading reading", ge=0)
    ] = 0.0  # ()
    pose_latency: Annotated[Number, Spec("s", "age of the pose that the law observes", ge=0)] = 0.0
    command_delay: Annotated[
        Number, Spec("s", "time between a command and its execution", ge=0)
    ] = 0.0  # ()
    velocity_error: Annotated[
        Number, Spec("1", "error of each component of the twist, or of two wheels")
    ] = 0.0  # (3,)
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
    return poses, delayed + sigma * normal(noise, (3,), pose.dtype)


def normal(key: jax.Array, shape: tuple[int, ...], dtype: Any) -> jax.Array:
    """Return normal numbers that are equal in single and double precision."""
    return jax.random.normal(key, shape, jnp.float32).astype(dtype)


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

    noise: Annotated[
        float, Spec("N", "standard deviation of each raw reading, of both components", ge=0)
    ] = 1.0
    # From Heins and Schoellig (2024).
    time_constant: Annotated[float, Spec("s", "time constant of the low-pass filter", gt=0)] = 0.05
    threshold: Annotated[
        float, Spec("N", "filtered force below which the reading is zero", ge=0)
    ] = 2.0

    def check(self) -> None:
        """Raise InputError for noise, filter or threshold that no sensor can have."""
        spec.check(self, "load cell ")

    def read(
        self, load: Load, key: jax.Array, steps: jax.Array, period: float
    ) -> tuple[Load, jax.Array]:
        """Read the force (2,) [N] of the object on the base, in the base's frame.

        The reading follows `steps` () control steps, `period` [s] after the previous one.
        """
        noise = jax.random.fold_in(jax.random.fold_in(key, _FORCE), steps)
        signal = load.signal
        raw = load.wrench[:2] + self.noise * normal(noise, (2,), signal.dtype)
        signal = signal + (1 - jnp.exp(-period / self.time_constant)) * (raw - signal)
        above = jnp.sum(signal * signal) >= self.threshold**2
        return load._replace(signal=signal), jnp.where(above, signal, 0.0)


class Load(NamedTuple):
    """State of a load cell between two readings."""

    # In the base's frame.
    wrench: Annotated[
        jax.Array, Spec("N, N, N m", "wrench of the object on the base in the last period")
    ]  # (3,)
    signal: Annotated[jax.Array, Spec("N", "filtered force")]  # (2,)


def init_load(template: jax.Array) -> Load:
    """Return the state before the first reading, in the precision of `template`."""
    return Load(jnp.zeros(3, template.dtype), jnp.zeros(2, template.dtype))
