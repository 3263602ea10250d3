"""Comparisons, logical operators and `where` for conditions that are bools or weights.

A condition of a law is a bool. In the smooth form of a law it is a weight from 0 to 1, and the
operators here mix the alternatives by this weight, so that the law is differentiable.
"""

from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from rps_jax.geometry.arrays import Array

T = TypeVar("T")


def greater(x: ArrayLike, threshold: ArrayLike, temperature: ArrayLike | None) -> Array:
    """Return `x > threshold`, or its sigmoid of width `temperature`."""
    if temperature is None:
        return jnp.greater(x, threshold)
    return jax.nn.sigmoid(jnp.subtract(x, threshold) / temperature)


def greater_equal(x: Array, threshold: ArrayLike, temperature: ArrayLike | None) -> Array:
    """Return `x >= threshold`, or its sigmoid of width `temperature`."""
    return x >= threshold if temperature is None else greater(x, threshold, temperature)


def not_(condition: Array) -> Array:
    """Return the negated condition."""
    return ~condition if condition.dtype == bool else 1 - condition


def and_(a: Array, b: Array) -> Array:
    """Return the conjunction; the product of weights."""
    return a & b if a.dtype == b.dtype == bool else a * b


def or_(a: Array, b: Array) -> Array:
    """Return the disjunction; the maximum of weights."""
    return a | b if a.dtype == b.dtype == bool else jnp.maximum(a, b)


def where(condition: Array, x: ArrayLike, y: ArrayLike) -> Array:
    """Return `x` where the condition holds and `y` elsewhere; the mixture for a weight."""
    if condition.dtype == bool:
        return jnp.where(condition, x, y)
    return condition * x + (1 - condition) * y


def tree_where(condition: Array, x: T, y: T) -> T:
    """Apply `where` to the leaves of two pytrees."""
    return jax.tree.map(partial(where, condition), x, y)
