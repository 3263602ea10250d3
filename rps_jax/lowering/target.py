"""Base class of all back ends, the names of operations, and the errors."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Protocol, TypeAlias

import jax
import numpy as np

from rps_jax.errors import InputError

# A constant (`np.ndarray`) or whatever a target returns for an array of the jaxpr.
Value: TypeAlias = Any
Shape: TypeAlias = tuple[int, ...]
Values: TypeAlias = Sequence[Value]
Params: TypeAlias = Mapping[str, Any]  # static parameters of a primitive
Body: TypeAlias = Callable[[Values], list[Value]]  # of a loop, from its carry

# Binary operation that each reduction repeats.
REDUCTIONS = {
    "reduce_sum": "add",
    "reduce_prod": "mul",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_and": "and",
    "reduce_or": "or",
    "reduce_xor": "xor",
}
DTYPES = {"f": "float32", "i": "int32", "u": "uint32", "b": "bool"}  # by kind


class Typed(Protocol):
    """Anything with a shape and a dtype, as an abstract value of JAX."""

    @property
    def shape(self) -> Shape:
        """Sizes of the axes."""
        ...

    @property
    def dtype(self) -> Any:
        """Type of the numbers."""
        ...


class UnsupportedError(InputError):
    """A primitive that a target cannot express."""

    def __init__(self, operation: str) -> None:
        super().__init__(
            f"operation `{operation}` cannot be translated; "
            "use arithmetic, comparisons, jnp.where and elementary functions."
        )


class CompilerError(Exception):
    """A C compiler or NVRTC that fails: its name, and its first message."""


class TooLargeError(InputError):
    """A function that XLA compiles better than this package: its arrays are too large."""


class Target:
    """Back end of a jaxpr: subclasses implement `gather` and `apply`."""

    operations: Collection[str] = ()  # that it spells; others are compounds
    kinds = "fib"  # kinds of numbers that it supports, see `kind_of`

    # --- what each back end implements ---

    def gather(self, values: Values, indices: np.ndarray, template: Typed) -> Value:
        """Gather numbers of the concatenated, flattened values at constant indices."""
        raise NotImplementedError

    def apply(self, name: str, values: Values, params: Params, out: Typed) -> Value:
        """Apply a primitive; `out` is the type of the result."""
        raise NotImplementedError

    def for_loop(self, body: Body, carry: Values, length: int) -> list[Value] | None:
        """Emit a loop of `length` iterations; None: the loop is unrolled."""
        return None

    def while_loop(self, condition: Body, body: Body, carry: Values) -> list[Value]:
        """Emit a loop that runs while its condition holds."""
        raise UnsupportedError("while")

    def reduced_by_rows(self, binary: str, value: Value, axes: Sequence[int], out: Typed) -> Value:
        """Reduce some axes by a binary operation for each row along them."""
        shape = np.shape(value)
        rest = [i for i in range(len(shape)) if i not in axes]
        indices = np.transpose(np.arange(size_of(shape)).reshape(shape), [*axes, *rest])
        first, *rows = indices.reshape(-1, *out.shape)
        result = self.gather([value], first, out)
        for row in rows:
            result = self.apply(binary, [result, self.gather([value], row, out)], {}, out)
        return result

    def windows(
        self, shape: Sequence[int], starts: Values, sizes: Sequence[int]
    ) -> tuple[Value, np.ndarray]:
        """Return the index of the window at a start, clamped, and the indices in each window."""
        positions = np.arange(size_of(shape)).reshape(shape)
        windows = np.lib.stride_tricks.sliding_window_view(positions, tuple(sizes))
        zero = np.zeros((), np.int32)
        index: Value = zero
        for start, count in zip(starts, windows.shape, strict=False):
            clamped: Value = zero
            if count > 1:
                clamped = self.apply("min", [start, np.asarray(count - 1, start.dtype)], {}, start)
                if kind_of(start.dtype) == "u":
                    clamped = self.apply("convert_element_type", [clamped], {}, zero)
                clamped = self.apply("max", [clamped, zero], {}, zero)
            index = self.apply("mul", [index, np.asarray(count, np.int32)], {}, zero)
            index = self.apply("add", [index, clamped], {}, zero)
        return index, windows.reshape(-1, size_of(sizes))


def size_of(shape: Sequence[int]) -> int:
    """Return the number of elements of a shape."""
    return int(np.prod(shape, dtype=int))


def first_array(types: Sequence[Typed]) -> tuple[int, int]:
    """Return the index and the size of the first array that has numbers."""
    sizes = [size_of(x.shape) for x in types]
    return next((i, size) for i, size in enumerate(sizes) if size)


def operation_of(name: str, operands: Sequence[Typed], params: Params, out: Typed) -> str:
    """Return the name of an operation: the primitive and the kind of its first operand."""
    kind, first = (kind_of(x.dtype, name) for x in (out, operands[0]))
    last = kind_of(operands[-1].dtype, name)
    if name == "dot_general" and (first + last != 2 * kind or kind == "b"):
        raise UnsupportedError("dot_general of bools or of different types")
    if name == "pow":
        return f"pow_{last}"
    if name == "select_n" and first == "b" and len(operands) == 3:
        return f"choose_{kind}"
    if name == "convert_element_type":
        return f"{kind}_of_{first}"
    if name == "bitcast_convert_type":
        return f"bits_{kind}_of_{first}"
    if name == "round" and int(params["rounding_method"]) == 1:
        return "rint_f"
    return f"{name}_{first}"


def is_constant(value: Value) -> bool:
    """Whether a value is known at compile time."""
    return isinstance(value, jax.Array) or (isinstance(value, np.ndarray) and value.dtype != object)


def kind_of(dtype: object, name: str = "", kinds: str = "fibu") -> str:
    """Return the kind of a dtype: `f` real, `i` signed, `u` unsigned, `b` bool.

    Raises:
      UnsupportedError: it is none of `kinds`, or has fewer than 4 bytes; `name` is the operation in
        the message.
    """
    kind = "?"
    if isinstance(dtype, np.dtype) and (dtype.kind == "b" or dtype.itemsize > 3):
        kind = dtype.kind
    if kind not in kinds:
        raise UnsupportedError(f"{name} of {dtype}".strip())
    return kind
