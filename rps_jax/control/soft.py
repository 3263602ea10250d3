"""Switches of laws: a bool, or in a smooth law a weight from 0 to 1, which mixes."""

import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def greater(
    x: jax.Array,
    threshold: Any,
    temperature: Any,
    compare: Callable[[Any, Any], jax.Array] = operator.gt,
) -> jax.Array:
    """The switch `compare(x, threshold)`; smooth if there is a temperature."""
    if temperature is None:
        return compare(x, threshold)
    return jax.nn.sigmoid((x - threshold) / temperature)


def less(x: jax.Array, threshold: Any, temperature: Any) -> jax.Array:
    """The switch x < threshold; smooth if there is a temperature."""
    if temperature is None:
        return x < threshold
    return jax.nn.sigmoid((threshold - x) / temperature)


def logical_not(switch: jax.Array) -> jax.Array:
    """The switch that is on where this one is off."""
    return ~switch if switch.dtype == bool else 1 - switch


def logical_and(a: jax.Array, b: jax.Array) -> jax.Array:
    """On where both are."""
    return a & b if a.dtype == b.dtype == bool else a * b


def logical_or(a: jax.Array, b: jax.Array) -> jax.Array:
    """On where one of them is."""
    return a | b if a.dtype == b.dtype == bool else jnp.maximum(a, b)


def where(switch: jax.Array, yes: Any, no: Any) -> jax.Array:
    """`yes` or `no`; of a weight, the mixture."""
    if switch.dtype == bool:
        return jnp.where(switch, yes, no)
    return switch * yes + (1 - switch) * no


def tree_where(switch: jax.Array, yes: Any, no: Any) -> Any:
    """`where` between the leaves of two pytrees."""
    return jax.tree.map(lambda a, b: where(switch, a, b), yes, no)
