"""Base class of all back ends: the meaning of compound primitives, and the errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, TypeAlias

import jax
import numpy as np

from rps_jax.errors import InputError

# A constant (`np.ndarray`) or whatever a target returns for an array of the jaxpr.
Value: TypeAlias = Any
Params: TypeAlias = Mapping[str, Any]  # static parameters of a primitive
Body: TypeAlias = Callable[[Sequence[Value]], list[Value]]  # of a loop, from its carry

# Binary operation that each reduction and each cumulative operation repeats.
_BINARY = {"sum": "add", "prod": "mul", "max": "max", "min": "min", "and": "and", "or": "or"}
REDUCTIONS = {f"reduce_{name}": binary for name, binary in _BINARY.items()}
CUMULATIVE = {f"cum{name}": binary for name, binary in _BINARY.items()}
_BOOL = np.dtype(bool)
# What `gather` returns for an index out of bounds.
_FILL = {"f": np.nan, "i": -(2**31), "u": 2**32 - 1, "b": True}


class Typed(Protocol):
    """Anything with a shape and a dtype, as an abstract value of JAX."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Sizes of the axes."""
        ...

    @property
    def dtype(self) -> Any:
        """Type of the numbers."""
        ...


class UnsupportedError(InputError):
    """A primitive that a target cannot express."""

    def __init__(self, operation: str, compiler: str = "the compiler") -> None:
        self.operation = operation
        super().__init__(
            f"operation `{operation}` is not supported by {compiler}; "
            "use arithmetic, comparisons, jnp.where and elementary functions."
        )


class TooLargeError(InputError):
    """A function that XLA compiles better than this package: its arrays are too large."""


class Target:
    """Back end of a jaxpr: subclasses implement `moved` and `apply`."""

    compiler = "the compiler"  # name in errors
    kinds = "fib"  # kinds of numbers that it supports, see `kind_of`

    # --- what each back end implements ---

    def moved(self, values: Sequence[Value], indices: np.ndarray, template: Typed) -> Value:
        """Gather numbers of the concatenated, flattened values at constant indices."""
        raise NotImplementedError

    def apply(self, name: str, values: Sequence[Value], params: Params, out: Typed) -> Value:
        """Apply a primitive that is not compound; `out` is the type of the result."""
        raise NotImplementedError

    def for_loop(self, body: Body, carry: Sequence[Value], length: int) -> list[Value] | None:
        """Emit a loop of `length` iterations; None: the loop is unrolled."""
        return None

    def while_loop(self, condition: Body, body: Body, carry: Sequence[Value]) -> list[Value]:
        """Emit a loop that runs while its condition holds."""
        raise UnsupportedError("while")

    # --- compound primitives ---

    def emit(self, name: str, values: Sequence[Value], params: Params, out: Typed) -> Value:
        """Apply a primitive; a compound one is written with simpler primitives."""
        if not size_of(out.shape):
            return np.zeros(out.shape, out.dtype)
        if name == "clamp":
            low, x, high = values
            return self.emit("min", [self.emit("max", [x, low], {}, out), high], {}, out)
        if name == "integer_pow":
            return self._power(values[0], params["y"], out)
        if name in ("argmax", "argmin"):
            return self._argument(name, values[0], params["axes"][0], out)
        if name in CUMULATIVE:
            return self._cumulative(CUMULATIVE[name], values[0], params, out)
        if name == "gather":
            return self._gathered(values[0], values[1], params, out)
        if name == "select_n" and (len(values) > 3 or kind_of(values[0].dtype) != "b"):
            return self._selected(values[0], values[1:], out)
        if name == "square" and kind_of(out.dtype) != "f":
            return self.emit("mul", [values[0], values[0]], {}, out)
        return self.apply(name, values, params, out)

    def _power(self, x: Value, exponent: int, out: Typed) -> Value:
        """Compute an integer power by repeated squaring, as XLA does."""
        result, square, remaining = None, x, abs(exponent)
        while remaining:
            if remaining & 1:
                result = square if result is None else self.emit("mul", [result, square], {}, out)
            remaining >>= 1
            square = self.emit("mul", [square, square], {}, out) if remaining else square
        unit = np.ones(out.shape, out.dtype)
        result = unit if result is None else result
        return self.emit("div", [unit, result], {}, out) if exponent < 0 else result

    def _argument(self, name: str, value: Value, axis: int, out: Typed) -> Value:
        """Compute the first index of the maximum or minimum along an axis, or of a NaN."""
        rows = np.moveaxis(_indices(value), axis, 0)
        template, flag = np.empty(out.shape, value.dtype), np.empty(out.shape, bool)
        best, index = self.moved([value], rows[0], value), np.zeros(out.shape, out.dtype)
        for k, row in enumerate(rows[1:], 1):
            x = self.moved([value], row, value)
            better = self.emit("gt" if name == "argmax" else "lt", [x, best], {}, flag)
            if kind_of(value.dtype) == "f":
                is_number = self.emit("eq", [best, best], {}, flag)
                nan = self.emit("and", [self.emit("ne", [x, x], {}, flag), is_number], {}, flag)
                better = self.emit("or", [better, nan], {}, flag)
            best = self.emit("select_n", [better, best, x], {}, template)
            at = np.full(out.shape, k, out.dtype)
            index = self.emit("select_n", [better, index, at], {}, out)
        return index

    def _cumulative(self, binary: str, value: Value, params: Params, out: Typed) -> Value:
        """Apply a binary operation cumulatively along an axis."""
        rows = np.moveaxis(_indices(value), params["axis"], 0)
        template = np.empty(rows.shape[1:], out.dtype)
        order = range(len(rows))
        totals: list[Value] = [None] * len(rows)
        total = None
        for k in reversed(order) if params["reverse"] else order:
            row = self.moved([value], rows[k], template)
            total = row if total is None else self.emit(binary, [total, row], {}, template)
            totals[k] = total
        return self.moved(totals, np.moveaxis(np.arange(rows.size).reshape(rows.shape), 0,
                                              params["axis"]), out)  # fmt: skip

    def _selected(self, index: Value, cases: Sequence[Value], out: Typed) -> Value:
        """Select one of several cases by an integer."""
        result, flag = cases[-1], np.empty(np.shape(index), bool)
        for k in reversed(range(len(cases) - 1)):
            below = self.emit("le", [index, np.asarray(k, index.dtype)], {}, flag)
            result = self.emit("select_n", [below, result, cases[k]], {}, out)
        return result

    def _gathered(self, value: Value, indices: Value, params: Params, out: Typed) -> Value:
        """Gather slices at indices that are known at run time."""
        axes, sizes = params["dimension_numbers"], params["slice_sizes"]
        if axes.operand_batching_dims:
            raise UnsupportedError("gather in a batch")
        shape, index = np.shape(value), jax.ShapeDtypeStruct((), indices.dtype)
        block, flag = np.empty(sizes, out.dtype), np.empty((), bool)
        zero, blocks = np.zeros((), indices.dtype), []
        for row in _indices(indices).reshape(-1, np.shape(indices)[-1]):
            starts, inside = [zero] * len(shape), []
            for at, axis in zip(row, axes.start_index_map, strict=True):
                starts[axis] = start = self.moved([indices], np.asarray(at), index)
                last = np.asarray(shape[axis] - sizes[axis], indices.dtype)
                inside += [self.emit("ge", [start, zero], {}, flag),
                           self.emit("le", [start, last], {}, flag)]  # fmt: skip
            part = self.emit("dynamic_slice", [value, *starts], {"slice_sizes": sizes}, block)
            if "FILL" in str(params["mode"]).upper() and inside:
                all_inside = inside[0]
                for condition in inside[1:]:
                    all_inside = self.emit("and", [all_inside, condition], {}, flag)
                fill = np.full(sizes, _FILL[kind_of(out.dtype)], out.dtype)
                part = self.emit("select_n", [all_inside, fill, part], {}, block)
            blocks.append(part)
        rest = [i for i in range(len(out.shape)) if i not in axes.offset_dims]
        positions = np.arange(len(blocks) * size_of(sizes)).reshape(len(blocks), *sizes)
        positions = np.squeeze(positions, tuple(1 + i for i in axes.collapsed_slice_dims))
        positions = positions.reshape((*np.shape(indices)[:-1], *positions.shape[1:]))
        return self.moved(blocks, np.moveaxis(positions, range(len(rest)), rest), out)

    def windows(
        self, shape: Sequence[int], starts: Sequence[Value], sizes: Sequence[int]
    ) -> tuple[Value, np.ndarray]:
        """Return the index of the window at a start, clamped, and the indices in each window."""
        positions = np.arange(size_of(shape)).reshape(shape)
        windows = np.lib.stride_tricks.sliding_window_view(positions, tuple(sizes))
        zero = np.zeros((), np.int32)
        index: Value = zero
        for start, count in zip(starts, windows.shape, strict=False):
            clamped: Value = zero
            if count > 1:
                clamped = self.emit("max", [start, zero], {}, zero)
                clamped = self.emit("min", [clamped, np.asarray(count - 1, np.int32)], {}, zero)
            index = self.emit("mul", [index, np.asarray(count, np.int32)], {}, zero)
            index = self.emit("add", [index, clamped], {}, zero)
        return index, windows.reshape(-1, size_of(sizes))


def size_of(shape: Sequence[int]) -> int:
    """Return the number of elements of a shape."""
    return int(np.prod(shape, dtype=int))


def is_constant(value: Value) -> bool:
    """Whether a value is known at compile time."""
    return isinstance(value, jax.Array) or (isinstance(value, np.ndarray) and value.dtype != object)


def kind_of(dtype: object, name: str = "", kinds: str = "fibu") -> str:
    """Return the kind of a dtype: `f` real, `i` signed, `u` unsigned, `b` bool.

    Raises:
      UnsupportedError: it is none of `kinds`; `name` is the operation in the message.
    """
    kind = dtype.kind if isinstance(dtype, np.dtype) else "?"
    if kind not in kinds:
        raise UnsupportedError(f"{name} of {dtype}".strip())
    return kind


def _indices(value: Value) -> np.ndarray:
    """Return the flat index of each number of a value, in its shape."""
    return np.arange(size_of(np.shape(value))).reshape(np.shape(value))
