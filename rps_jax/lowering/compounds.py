"""Meaning of compound operations: functions of JAX that use simpler operations.

An operation that a target does not spell is traced from here, so that it has one meaning in all
languages. As in JAX, NaN propagates, integer arithmetic wraps around, conversions saturate.
"""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import Primitive

from rps_jax.lowering.target import UnsupportedError

Function: TypeAlias = Callable[..., jax.Array]
_BOUND = 2.0**31  # above all integers
# What `gather` returns for an index out of bounds.
_FILL = {"f": np.nan, "i": -(2**31), "u": 2**32 - 1, "b": True}


def _primitive(name: str, dtype: np.dtype | None = None) -> Function:
    """Return an operation that only targets implement."""

    def result(*types: jax.core.ShapedArray) -> jax.core.ShapedArray:
        shape = np.broadcast_shapes(*(x.shape for x in types))
        return jax.core.ShapedArray(shape, dtype or types[0].dtype)

    primitive = Primitive(name)
    primitive.def_abstract_eval(result)
    return primitive.bind


_quotient = _primitive("quotient")  # of integers, whose divisor is neither 0 nor -1
_truncation = _primitive("truncate", np.dtype(np.int32))  # of reals within the bounds of integers


def _sign(x: jax.Array) -> jax.Array:
    return jnp.where(x > 0, 1, jnp.where(x < 0, -1, x))


def _round(x: jax.Array, **_: object) -> jax.Array:
    """Round halves away from zero."""
    size = jnp.abs(x)
    whole = jnp.floor(size)
    return jnp.sign(x) * jnp.where(size - whole < 0.5, whole, whole + 1)


def _divide(x: jax.Array, y: jax.Array) -> jax.Array:
    """Divide integers: by 0 the quotient is -1."""
    by_zero, by_minus_one = y == 0, y == -1
    quotient = _quotient(x, jnp.where(by_zero | by_minus_one, 1, y))
    return jnp.where(by_zero, -1, jnp.where(by_minus_one, -x, quotient))


def _remainder(x: jax.Array, y: jax.Array) -> jax.Array:
    """Return the remainder of integers: by 0 it is the dividend."""
    divisor = jnp.where((y == 0) | (y == -1), 1, y)
    return jnp.where(y == 0, x, x - _quotient(x, divisor) * divisor)


def _integer(x: jax.Array, **_: object) -> jax.Array:
    """Convert reals to integers: NaN to 0."""
    whole = _truncation(jnp.where((x >= -_BOUND) & (x < _BOUND), x, 0))
    return jnp.where(x >= _BOUND, 2**31 - 1, jnp.where(x < -_BOUND, -(2**31), whole))


def _of_bool(x: jax.Array, new_dtype: np.dtype, **_: object) -> jax.Array:
    """Convert bools to numbers."""
    return jnp.where(x, new_dtype.type(1), new_dtype.type(0))


def _unsigned(x: jax.Array, **_: object) -> jax.Array:
    """Convert reals to unsigned integers: NaN to 0."""
    low = _integer(jnp.where(x >= _BOUND, x - _BOUND, jnp.maximum(x, 0))).astype(np.uint32)
    return jnp.where(x >= _BOUND, low + np.uint32(_BOUND), low)


def _atan2(y: jax.Array, x: jax.Array) -> jax.Array:
    """Return the angle of points by `atan`; of two infinities it is that of their signs."""
    infinite = (jnp.abs(y) == jnp.inf) & (jnp.abs(x) == jnp.inf)
    y, x = (jnp.where(infinite, jnp.sign(z), z) for z in (y, x))
    turn = jnp.where(x < 0, jnp.where(y < 0, -np.pi, np.pi), 0)
    return jnp.where(x == 0, jnp.sign(y) * (np.pi / 2), jnp.arctan(y / x) + turn)


def _power(x: jax.Array, y: int) -> jax.Array:
    """Compute an integer power by repeated squaring, as XLA does."""
    result, square, remaining = None, x, abs(y)
    while remaining:
        if remaining & 1:
            result = square if result is None else result * square
        remaining >>= 1
        square = square * square if remaining else square
    result = jnp.ones_like(x) if result is None else result
    return 1 / result if y < 0 else result


def _select(index: jax.Array, *cases: jax.Array) -> jax.Array:
    """Select one of several cases by an integer."""
    result = cases[-1]
    for k in reversed(range(len(cases) - 1)):
        result = lax.select_n(index <= k, result, cases[k])
    return result


def _argument(is_better: Function) -> Function:
    """Return the function of the first index of the best number along an axis, or of a NaN."""

    def argument(x: jax.Array, axes: Sequence[int], index_dtype: np.dtype) -> jax.Array:
        first, *rows = jnp.moveaxis(x, axes[0], 0)
        best, index = first, jnp.zeros(first.shape, index_dtype)
        for k, row in enumerate(rows, 1):
            better = is_better(row, best)
            if jnp.issubdtype(x.dtype, jnp.floating):
                better |= (row != row) & (best == best)
            best, index = jnp.where(better, row, best), jnp.where(better, k, index)
        return index

    return argument


def _cumulative(binary: Function) -> Function:
    """Return the function that applies a binary operation cumulatively along an axis."""

    def cumulative(x: jax.Array, axis: int, reverse: bool) -> jax.Array:
        order = slice(None, None, -1 if reverse else 1)
        totals = list(itertools.accumulate([*jnp.moveaxis(x, axis, 0)][order], binary))
        return jnp.stack(totals[order], axis)

    return cumulative


def _gather(
    x: jax.Array, indices: jax.Array, dimension_numbers: lax.GatherDimensionNumbers,
    slice_sizes: Sequence[int], mode: object, **_: object,
) -> jax.Array:  # fmt: skip
    """Gather slices at indices that are known at run time."""
    axes, blocks = dimension_numbers, []
    if axes.operand_batching_dims:
        raise UnsupportedError("gather in a batch")
    for row in indices.reshape(-1, indices.shape[-1]):
        starts, inside = [jnp.zeros((), indices.dtype)] * x.ndim, []
        for start, axis in zip(row, axes.start_index_map, strict=True):
            starts[axis] = start
            inside += [start >= 0, start <= x.shape[axis] - slice_sizes[axis]]
        block = lax.dynamic_slice_p.bind(x, *starts, slice_sizes=slice_sizes)
        if "FILL" in str(mode).upper() and inside:
            fill = _FILL[x.dtype.kind]
            block = jnp.where(functools.reduce(operator.and_, inside), block, fill)
        blocks.append(block)
    stacked = jnp.squeeze(jnp.stack(blocks), tuple(1 + i for i in axes.collapsed_slice_dims))
    result = stacked.reshape(*indices.shape[:-1], *stacked.shape[1:])
    rest = [i for i in range(result.ndim) if i not in axes.offset_dims]
    return jnp.moveaxis(result, range(len(rest)), rest)


def _scatter_add(
    x: jax.Array, indices: jax.Array, updates: jax.Array, unique_indices: bool, **params: object
) -> jax.Array:
    """Add updates at indices: the sum of the array and of updates or zeros."""
    if not unique_indices:
        raise UnsupportedError("scatter-add")
    params |= {"unique_indices": True, "update_jaxpr": None, "update_consts": ()}
    return x + lax.scatter_p.bind(jnp.zeros_like(x), indices, updates, **params)


def _update(x: jax.Array, update: jax.Array, *starts: jax.Array) -> jax.Array:
    """Replace a slice at an index that is known at run time, clamped to the array."""
    limits = [size - width for size, width in zip(x.shape, update.shape, strict=True)]
    result = x
    for at in np.ndindex(*(limit + 1 for limit in limits)):
        chosen = [
            jnp.clip(start, 0, limit) == k
            for start, k, limit in zip(starts, at, limits, strict=True)
            if limit
        ]
        replaced = lax.dynamic_update_slice_p.bind(x, update, *map(np.int32, at))
        is_here = functools.reduce(operator.and_, chosen, np.True_)
        result = jnp.where(is_here, replaced, result)
    return result


# Functions by the name of an operation (see `target.operation_of`), or of a primitive of any kind.
COMPOUNDS: dict[str, Function] = {
    "clamp": lambda low, x, high: jnp.minimum(jnp.maximum(x, low), high),
    "square": lambda x: x * x,
    "add_any": lambda x, y: x + y,
    "one_minus_square": lambda x: 1 - x * x,  # of versions of JAX from 0.11 on
    "ne": lambda x, y: ~(x == y),
    "abs_i": lambda x: jnp.maximum(x, -x),
    "sign": _sign,
    "rsqrt": lambda x, **_: 1 / jnp.sqrt(x),
    "exp2": lambda x, **_: lax.pow(jnp.full_like(x, 2), x),
    "logistic": lambda x, **_: 1 / (1 + jnp.exp(-x)),
    "is_finite": lambda x: jnp.abs(x) < jnp.inf,
    "round": _round,
    "atan2": _atan2,
    "integer_pow": _power,
    "div_i": _divide,
    "rem_i": _remainder,
    "i_of_f": _integer,
    "u_of_f": _unsigned,
    **dict.fromkeys(("b_of_f", "b_of_i"), lambda x, **_: x != 0),
    **dict.fromkeys(("f_of_b", "i_of_b", "u_of_b"), _of_bool),
    "choose_b": lambda flag, no, yes: (flag & yes) | (~flag & no),
    "select_n": _select,
    "argmax": _argument(lax.gt),
    "argmin": _argument(lax.lt),
    "cumsum": _cumulative(lax.add),
    "cumprod": _cumulative(lax.mul),
    "cummax": _cumulative(lax.max),
    "cummin": _cumulative(lax.min),
    "gather": _gather,
    "scatter-add": _scatter_add,
    "dynamic_update_slice": _update,
}  # fmt: skip
