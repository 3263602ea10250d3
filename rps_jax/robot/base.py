"""The base: where it believes it is, and how it does what it is told."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

_ODOMETRY = 7  # of a world's key; the skin splits it into fewer


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

    Args:
      odometry: what the base gets wrong.
      poses: (K, 3) [m, m, rad] of the last control steps, the latest first.
      now: (3,) where the base is.
      key: of the world.
      steps: () control steps done.
      period: [s] of the control loop.
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
