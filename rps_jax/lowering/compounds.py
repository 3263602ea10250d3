"""Meaning of compound operations: functions of JAX that use simpler operations.

An operation that a target does not spell is traced from here, so that it has one meaning in all
languages. As in JAX, NaN propagates, integer arithmetic wraps around, conversions saturate.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import Primitive

from rps_jax.lowering.graph import UnsupportedError

Function: TypeAlias = Callable[..., Any]  # of arrays
_BOUND = 2.0**31  # above all integers
_MAX_SORTED = 256  # numbers along an axis
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
_shift_up, _shift_down = map(_primitive, ("shift_up", "shift_down"))  # by less than all bits
_lt_to = _primitive("lt_to", np.dtype(np.bool_))  # in the total order of numbers


def _is_real(x: jax.Array) -> bool:
    return jnp.issubdtype(x.dtype, jnp.floating)


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


def _shift(shift: Function) -> Function:
    """Return the function that shifts integers; by all bits or more, the result is 0."""
    return lambda x, count: jnp.where((count >= 0) & (count < 32), shift(x, count & 31), 0)


def _shift_arithmetic(x: jax.Array, count: jax.Array) -> jax.Array:
    """Shift with the sign; bits of unsigned integers are read as of signed ones."""
    bits, count, shift = x.astype(np.int32), count.astype(np.int32), lax.shift_right_logical
    return jnp.where(bits < 0, ~shift(~bits, count), shift(bits, count)).astype(x.dtype)


def _integer(x: jax.Array, **_: object) -> jax.Array:
    """Convert reals to integers: NaN to 0."""
    whole = _truncation(jnp.where((x >= -_BOUND) & (x < _BOUND), x, 0))
    return jnp.where(x >= _BOUND, 2**31 - 1, jnp.where(x < -_BOUND, -(2**31), whole))


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
            if _is_real(x):
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


def _windows(
    shape: Sequence[int],
    sizes: Sequence[int],
    indices: jax.Array,
    mode: object,
    axes: Sequence[int],
    batching: Iterable[tuple[int, int]],
) -> Iterator[Any]:
    """Yield the position of each row of indices, the start of its window, and whether it counts.

    Args:
      shape: of the array.
      sizes: of a window.
      indices: rows of starts.
      mode: whether windows beyond the array count.
      axes: of the array, one for each column of `indices`.
      batching: pairs of an axis of the array and the axis of `indices` that has its index.
    """
    pairs = list(batching)
    for position in np.ndindex(indices.shape[:-1]):
        starts, inside = [np.int32(0)] * len(shape), np.True_
        for axis, at in pairs:
            starts[axis] = np.int32(position[at])
        for start, axis in zip(indices[position], axes, strict=True):
            starts[axis] = start
            if "FILL" in str(mode).upper():
                inside = inside & (start >= 0) & (start <= shape[axis] - sizes[axis])
        yield position, starts, inside


def fill_of(dtype: np.dtype, fill_value: object) -> np.ndarray:
    """Return what `gather` returns for an index out of bounds."""
    return np.asarray(_FILL[dtype.kind] if fill_value is None else fill_value, dtype)


def _gather(
    x: jax.Array,
    indices: jax.Array,
    dimension_numbers: lax.GatherDimensionNumbers,
    slice_sizes: Sequence[int],
    mode: object,
    fill_value: Any = None,
    **_: object,
) -> jax.Array:
    """Gather slices at indices that are known at run time."""
    axes, blocks = dimension_numbers, []
    single = axes.collapsed_slice_dims + axes.operand_batching_dims
    batching = zip(axes.operand_batching_dims, axes.start_indices_batching_dims, strict=True)
    windows = _windows(x.shape, slice_sizes, indices, mode, axes.start_index_map, batching)
    fill = fill_of(x.dtype, fill_value)
    for _, starts, inside in windows:
        block = lax.dynamic_slice(x, starts, slice_sizes)
        blocks.append(block if inside is np.True_ else jnp.where(inside, block, fill))
    stacked = jnp.squeeze(jnp.stack(blocks), tuple(1 + i for i in single))
    result = stacked.reshape(*indices.shape[:-1], *stacked.shape[1:])
    rest = [i for i in range(result.ndim) if i not in axes.offset_dims]
    return jnp.moveaxis(result, range(len(rest)), rest)


def _scatter(combine: Function | None) -> Function:
    """Return the function that combines windows of an array with updates; None replaces them."""

    def scatter(
        x: jax.Array,
        indices: jax.Array,
        updates: jax.Array,
        dimension_numbers: lax.ScatterDimensionNumbers,
        mode: object,
        **_: object,
    ) -> jax.Array:
        axes = dimension_numbers
        rest = [i for i in range(updates.ndim) if i not in axes.update_window_dims]
        single = (*axes.inserted_window_dims, *axes.operand_batching_dims)
        blocks = jnp.moveaxis(updates, rest, range(len(rest)))
        window = iter(blocks.shape[len(rest) :])
        sizes = [1 if i in single else next(window) for i in range(x.ndim)]
        batching = zip(axes.operand_batching_dims, axes.scatter_indices_batching_dims, strict=True)
        map_ = axes.scatter_dims_to_operand_dims
        for at, starts, inside in _windows(x.shape, sizes, indices, mode, map_, batching):
            previous = lax.dynamic_slice(x, starts, sizes)
            block = blocks[at].reshape(sizes)
            block = combine(previous, block) if combine else block
            x = lax.dynamic_update_slice(x, jnp.where(inside, block, previous), starts)
        return x

    return scatter


def _less(x: jax.Array, y: jax.Array) -> jax.Array:
    """Compare in ascending order, in which NaN is last."""
    return lax.lt(x, y) | ((x == x) & (y != y)) if _is_real(x) else lax.lt(x, y)


def _less_in_total_order(x: jax.Array, y: jax.Array) -> jax.Array:
    """Compare in total order, in which -0.0 is less than 0.0."""
    less = _less(x, y)
    return less | ((x == 0) & (y == 0) & (1 / x < 1 / y)) if _is_real(x) else less


def _sort(
    *operands: jax.Array,
    dimension: int,
    num_keys: int,
    less: Function = _less,
    **_: object,
) -> list[jax.Array]:
    """Sort operands by the first ones; equal keys stay in their order."""
    size = operands[0].shape[dimension]
    if size > _MAX_SORTED:
        raise UnsupportedError(f"sort of more than {_MAX_SORTED} numbers")
    columns = [jnp.moveaxis(x, dimension, -1) for x in operands]
    index = np.arange(size, dtype=np.int32)
    columns.append(jnp.broadcast_to(index, columns[0].shape))
    # Batcher's merge exchange: each round compares numbers at a distance.
    levels = [1 << k for k in reversed(range((size - 1).bit_length()))]
    for width in levels:
        rounds = [(width, 0), *((x - width, width) for x in levels if x > width)]
        for distance, rest in rounds:
            low = (index & width == rest) & (index < size - distance)
            high = np.roll(low, distance)
            pairs = [(x, jnp.roll(x, distance, -1), jnp.roll(x, -distance, -1)) for x in columns]
            partners = [jnp.where(low, up, jnp.where(high, down, x)) for x, down, up in pairs]
            swaps = partners[-1] < columns[-1]
            for x, y in reversed([*zip(columns[:num_keys], partners, strict=False)]):
                swaps = less(y, x) | (~less(x, y) & swaps)
            swaps ^= high
            columns = [jnp.where(swaps, y, x) for x, y in zip(columns, partners, strict=True)]
    return [jnp.moveaxis(x, -1, dimension) for x in columns[:-1]]


def _top_k(x: jax.Array, k: int, axis: int, **_: object) -> list[jax.Array]:
    """Return the largest numbers and their indices; equal ones keep their order."""
    index = lax.broadcasted_iota(np.int32, x.shape, axis)
    columns = _sort(x, index, dimension=axis, num_keys=1, less=lambda x, y: _lt_to(y, x))
    return [lax.slice_in_dim(column, 0, k, axis=axis) for column in columns]


def _update(x: jax.Array, update: jax.Array, *starts: jax.Array) -> jax.Array:
    """Replace a slice at an index that is known at run time, clamped to the array."""
    limits = [size - width for size, width in zip(x.shape, update.shape, strict=True)]
    pads = [(limit, limit) for limit in limits]
    at = [limit - jnp.clip(start, 0, limit) for start, limit in zip(starts, limits, strict=True)]
    is_here = lax.dynamic_slice(np.pad(np.ones(update.shape, bool), pads), at, x.shape)
    return jnp.where(is_here, lax.dynamic_slice(jnp.pad(update, pads), at, x.shape), x)


# Functions by the name of an operation (see `target.operation_of`), or of a primitive of any kind.
COMPOUNDS: dict[str, Function] = {
    "clamp": lambda low, x, high: jnp.minimum(jnp.maximum(x, low), high),
    "square": lambda x: x * x,
    "add_any": lambda x, y: x + y,
    "one_minus_square": lambda x: 1 - x * x,  # of versions of JAX from 0.11 on
    "ne": lambda x, y: ~(x == y),
    "lt_b": lambda x, y: ~x & y,
    "le_b": lambda x, y: ~x | y,
    "gt_b": lambda x, y: x & ~y,
    "ge_b": lambda x, y: x | ~y,
    "max_b": lambda x, y: x | y,
    "min_b": lambda x, y: x & y,
    "reduce_max_b": lambda x, axes, **_: jnp.any(x, axes),
    "reduce_min_b": lambda x, axes, **_: jnp.all(x, axes),
    "lt_to": _less_in_total_order,
    "le_to": lambda x, y: ~_lt_to(y, x),
    "abs_i": lambda x: jnp.maximum(x, -x),
    "sign": lambda x: jnp.where(x > 0, 1, jnp.where(x < 0, -1, x)),
    "sign_u": lambda x: jnp.minimum(x, 1),
    "neg_u": lambda x: 0 - x,
    "not_u": lambda x: x ^ np.uint32(2**32 - 1),
    "rsqrt": lambda x, **_: 1 / jnp.sqrt(x),
    "log2": lambda x, **_: jnp.log(x) / math.log(2),  # of versions of JAX from 0.11 on
    "exp2": lambda x, **_: lax.pow(jnp.full_like(x, 2), x),
    "logistic": lambda x, **_: 1 / (1 + jnp.exp(-x)),
    "is_finite": lambda x: jnp.abs(x) < jnp.inf,
    "round": _round,
    "atan2": _atan2,
    "integer_pow": _power,
    **dict.fromkeys(("pow_i", "pow_u"), lambda x, y: lax.pow(x, y.astype(x.dtype))),
    "div_i": _divide,
    "rem_i": _remainder,
    "div_u": lambda x, y: jnp.where(y == 0, np.uint32(2**32 - 1), _quotient(x, jnp.maximum(y, 1))),
    "rem_u": lambda x, y: x - _quotient(x, jnp.maximum(y, 1)) * y,
    "shift_left_i": _shift(_shift_up),
    "shift_right_logical_i": _shift(_shift_down),
    "shift_right_arithmetic": _shift_arithmetic,
    "i_of_f": _integer,
    "u_of_f": _unsigned,
    **dict.fromkeys(("b_of_f", "b_of_i", "b_of_u"), lambda x, **_: x != 0),
    **dict.fromkeys(
        ("f_of_b", "i_of_b", "u_of_b"),
        lambda x, new_dtype, **_: jnp.where(x, new_dtype.type(1), new_dtype.type(0)),
    ),
    **dict.fromkeys(("bits_i_of_u", "bits_u_of_i"), lambda x, new_dtype: x.astype(new_dtype)),
    "choose_b": lambda flag, no, yes: (flag & yes) | (~flag & no),
    "select_n": _select,
    "argmax": _argument(lax.gt),
    "argmin": _argument(lax.lt),
    "cumsum": _cumulative(lax.add),
    "cumprod": _cumulative(lax.mul),
    "cummax": _cumulative(lax.max),
    "cummin": _cumulative(lax.min),
    "gather": _gather,
    "scatter": _scatter(None),
    "scatter-add": _scatter(lax.add),
    "scatter-sub": _scatter(lax.sub),
    "scatter-mul": _scatter(lax.mul),
    "scatter-min": _scatter(lax.min),
    "scatter-max": _scatter(lax.max),
    "sort": _sort,
    "top_k": _top_k,
    "dynamic_update_slice": _update,
}
