"""Planar geometry whose values and derivatives are finite everywhere.

This module alone guards the singularities: the norm at zero, the direction of a zero vector, the
wrap at pi, and the maximum of several numbers.
"""

import functools

import jax
import jax.numpy as jnp

from rps_jax.geometry.arrays import Array, Float, Floats, PerWorld, Scalar


def rotate(
    yaw: Scalar | Float[Array, "*#B"], vector: Float[Array, "*#B 2"]
) -> Float[Array, "... 2"]:
    """Turn planar vectors (..., 2) by `yaw` (...) [rad], counter-clockwise."""
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    x, y = vector[..., 0], vector[..., 1]
    return jnp.stack([c * x - s * y, s * x + c * y], axis=-1)


def unit(angle: Floats) -> Float[Array, "*B 2"]:
    """Return the unit vectors (..., 2) in the directions `angle` (...) [rad]."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def _components(vector: Array) -> list[Array]:
    """Return the components (...) of vectors (..., n) for a small n: see `footprint`."""
    return [vector[..., i] for i in range(vector.shape[-1])]


def _scale(vector: Array) -> Array:
    """Return the largest component (...) of vectors (..., n); zero only for a zero vector.

    It is bounded, since the reciprocal of a larger float32 is subnormal, which XLA takes for zero.
    """
    largest = functools.reduce(jnp.maximum, (jnp.abs(x) for x in _components(vector)))
    return jax.lax.stop_gradient(jnp.minimum(largest, 1e37))


def norm(vector: Float[Array, "*B n"]) -> Floats:
    """Return the Euclidean norm over the last axis: (..., n) -> (...).

    The vector is scaled by the largest component, so squares neither overflow nor vanish in
    float32. The derivative at zero is zero, where `jnp.linalg.norm` gives NaN.
    """
    scale = _scale(vector)
    is_zero = scale == 0
    safe = jnp.where(is_zero, 1.0, scale)
    squares = [jnp.where(is_zero, 1.0, x / safe) ** 2 for x in _components(vector)]
    return jnp.where(is_zero, 0.0, scale * jnp.sqrt(functools.reduce(jnp.add, squares)))


def direction(vector: Float[Array, "*B 2"]) -> Floats:
    """Return the angle [rad] of planar vectors (..., 2) in [-pi, pi]; 0 with zero slope at zero."""
    scale = _scale(vector)
    is_zero = scale == 0
    # Scaling changes no angle and keeps x*x + y*y, which the derivative divides by, in range.
    unit = vector / jnp.where(is_zero, 1.0, scale)[..., None]
    x = jnp.where(is_zero, 1.0, unit[..., 0])
    return jnp.arctan2(jnp.where(is_zero, 0.0, unit[..., 1]), x)


def wrap(angle: Floats) -> Floats:
    """Wrap an angle into [-pi, pi) [rad], the paper's unit circle S."""
    wrapped = jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi
    # Rounding can return the excluded end.
    return jnp.where(wrapped >= jnp.pi, wrapped - 2 * jnp.pi, wrapped)


def bearing(vector: Float[Array, "*B 2"], heading: PerWorld) -> Floats:
    """Return the angle (...) [rad] from a heading to planar vectors (..., 2), in [-pi, pi)."""
    return wrap(direction(vector) - heading)


def safe_sqrt(x: Floats) -> Floats:
    """Return the square root of max(x, 0), with zero derivative where x <= 0."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def greatest(x: Float[Array, " n"]) -> Float[Array, ""]:
    """Return the greatest () of x (n,), with the derivative of one entry.

    `jnp.max` divides its derivative among equal entries. It is NaN if the compiler computes the
    entries twice with different rounding, so that none equals the maximum.
    """
    return x[jnp.argmax(x)]


def yaw_of_quaternion(quaternion: Float[Array, "*B 4"]) -> Floats:
    """Return the heading (...) [rad] of unit quaternions (..., 4), scalar first."""
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    return direction(jnp.stack([1 - 2 * (y * y + z * z), 2 * (w * z + x * y)], axis=-1))


def tilt(quaternion: Float[Array, "*B 4"]) -> Floats:
    """Return the tilt (...) [rad] of the vertical under unit quaternions (..., 4)."""
    _, x, y, _ = jnp.moveaxis(quaternion, -1, 0)
    return 2 * jnp.arcsin(jnp.minimum(norm(jnp.stack([x, y], axis=-1)), 1.0))
