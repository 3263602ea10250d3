"""Interface between the walk and the back ends, and the intermediate code of all but ONNX.

A `Target` is a back end. The intermediate code is a graph of arrays. A `Node` is an array and the
operation that computes it; equal nodes are one. A `LoopNode` is a loop or a conditional block,
whose body is a graph, too. An `Array` is a view of a node, the operand of others.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeAlias

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
    loops: Any = ()  # kinds of loops that it supports; a `For` is unrolled otherwise

    # --- what each back end implements ---

    def gather(self, values: Values, indices: np.ndarray, template: Typed) -> Value:
        """Gather numbers of the concatenated, flattened values at constant indices."""
        raise NotImplementedError

    def apply(self, name: str, values: Values, params: Params, out: Typed) -> Value:
        """Apply a primitive; `out` is the type of the result."""
        raise NotImplementedError

    def loop(
        self, op: For | While, condition: Body | None, body: Body, carry: Values
    ) -> list[Value]:
        """Emit a loop that it supports; a `While` runs while its condition holds."""
        raise NotImplementedError


def size_of(shape: Sequence[int]) -> int:
    """Return the number of elements of a shape."""
    return math.prod(shape)


def positions(shape: Sequence[int]) -> np.ndarray:
    """Return the flat index of each element of an array."""
    return np.arange(size_of(shape)).reshape(shape)


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


# --- operations --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Input:
    """Argument of the function."""

    index: int


@dataclass(frozen=True)
class Call:
    """Function of `operations.TABLE` or of a header, applied element by element."""

    function: str


@dataclass(frozen=True)
class Reduce:
    """Reduction of all elements of its operand by a binary operation."""

    binary: str


@dataclass(frozen=True)
class Gather:
    """Array with one operand for each element."""


@dataclass(frozen=True)
class DynamicSlice:
    """Window of the second operand; the first operand is the index of the window."""

    windows: tuple[tuple[int, ...], ...]  # indices of the elements of each window


@dataclass(frozen=True)
class MatrixProduct:
    """Product of rows, whose scalars are the operands, with a constant matrix."""

    shape: tuple[int, int]
    content: bytes  # float64


@dataclass(frozen=True)
class Carried:
    """Value that a loop carries from one iteration to the next."""


@dataclass(frozen=True, eq=False)
class LoopResult:
    """Last value that a loop carries; it is stored where the loop carries it."""

    carried: Node


@dataclass(frozen=True)
class For:
    """Loop of a constant number of iterations."""

    length: int


@dataclass(frozen=True)
class While:
    """Loop that ends when its condition fails."""


@dataclass(frozen=True)
class If:
    """Block that runs if its condition has a value."""

    expected: bool


Operation: TypeAlias = (
    Input | Call | Reduce | Gather | DynamicSlice | MatrixProduct | Carried | LoopResult
)

# --- nodes -------------------------------------------------------------------------------------


@dataclass(eq=False)
class Node:
    """An array of numbers and the operation that computes it."""

    id: int
    op: Operation | For | While | If
    operands: tuple[Value, ...]  # `Array` and constants
    kind: str  # of its numbers
    size: int  # number of elements that it computes, or that a reduction reads
    captured: tuple[Node, ...] = ()  # nodes that it needs beside its operands

    @property
    def name(self) -> str:
        """Variable in the printed code."""
        return f"v{self.storage.id}"

    @property
    def storage(self) -> Node:
        """Node whose variable stores it."""
        return self.op.carried if isinstance(self.op, LoopResult) else self

    @property
    def predecessors(self) -> Iterable[Node]:
        """Nodes that must be computed before it."""
        return itertools.chain(nodes_of(self.operands), self.captured)

    @property
    def width(self) -> int:
        """Number of elements that it stores."""
        return 1 if isinstance(self.op, Reduce) else self.size

    @property
    def is_fusible(self) -> bool:
        """Whether it is computed in a loop over elements, which other nodes may share."""
        return self.size > 1 and isinstance(self.op, Call | Reduce)

    @functools.cached_property
    def fusion_barriers(self) -> set[Node]:
        """Predecessors that cannot be computed in the same loop over elements."""
        if not self.is_fusible:
            return set(self.predecessors)
        arrays = (a for a in self.operands if isinstance(a, Array))
        return {a.node for a in arrays if not a.covers(self.size)}


@dataclass(eq=False)
class LoopNode(Node):
    """A loop or a conditional block: its operands are the initial values of its carry."""

    carried: tuple[Node, ...] = ()
    results: tuple[Value, ...] = ()  # carry after one iteration
    condition: Value = None  # unless it is a `For`
    body: tuple[Node, ...] = ()  # nodes that it computes


class Array(NamedTuple):
    """View of a node: elements from `first` on (`step` 1), or one element repeated (`step` 0)."""

    node: Node
    shape: Shape
    first: int = 0
    step: int = 1

    @property
    def dtype(self) -> np.dtype:
        """Type of the numbers in JAX."""
        return np.dtype(DTYPES[self.node.kind])

    def covers(self, size: int) -> bool:
        """Whether its elements are those of its node, which has `size` elements."""
        return self.step == 1 and self.first == 0 and self.node.width == size


class Result(NamedTuple):
    """A result with at least one number, and its position among all results."""

    position: int
    value: Value  # `Array` or a constant
    size: int
    kind: str


# --- values ------------------------------------------------------------------------------------


def nodes_of(values: Iterable[Value]) -> list[Node]:
    """Return the nodes of those values that are arrays."""
    return [a.node for a in values if isinstance(a, Array)]


def is_unchanged(carried: Node, value: Value) -> bool:
    """Whether a carried node has the same value after an iteration."""
    return isinstance(value, Array) and value.node is carried and value.covers(carried.size)


def key_of(value: Value) -> Hashable:
    """Return a key that equal operands share."""
    if isinstance(value, Array):
        return (value.node.id, value.first, value.step)
    return np.asarray(value).tobytes(), np.asarray(value).dtype.str


def element(value: Value, index: int) -> Value:
    """Return one number of a value as an operand."""
    if isinstance(value, Array):
        return Array(value.node, (), value.first + value.step * index)
    return np.asarray(value).reshape(-1)[index]


def gathered_scalar(scalar: Value) -> Value:
    """Return a single number from the operand that a gather copies."""
    if isinstance(scalar, Array) and isinstance(scalar.node.op, Gather):
        return scalar.node.operands[scalar.first]
    return scalar


def view_of(scalars: Values, shape: Shape) -> Array | None:
    """Return scalars as a view of their node if they are consecutive or equal there."""
    first = scalars[0]
    if all(isinstance(a, Array) and a.node is first.node for a in scalars):
        offsets = np.array([a.first - first.first for a in scalars])
        for step in (1, 0):
            if (offsets == step * np.arange(len(offsets))).all():
                return Array(first.node, shape, first.first, step)
    return None


def flat(value: Value, size: int) -> Value:
    """Return a value as an operand of an operation on `size` numbers."""
    if isinstance(value, Array):
        step = value.step if size_of(value.shape) == size else 0
        return value._replace(shape=(size,), step=step)
    array = np.ascontiguousarray(value).reshape(-1)
    return array[:1] if len({x.tobytes() for x in array}) == 1 else array


def live_nodes(roots: Iterable[Node]) -> list[Node]:
    """Return nodes and all nodes that they need, in the order of their creation."""
    visited: dict[int, Node] = {}
    waiting = list(roots)
    while waiting:
        node = waiting.pop()
        if node.id not in visited:
            visited[node.id] = node
            waiting += node.predecessors
    return [visited[key] for key in sorted(visited)]
