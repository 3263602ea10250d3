"""Intermediate code: a graph of arrays, from which all languages but ONNX are printed.

A `Node` is an array and the operation that computes it; equal nodes are one. A `LoopNode` is a loop
or a conditional block, whose body is a graph, too. An `Array` is a view of a node, the operand of
others. `verifier` states and checks the rules of the graph, and prints it.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from rps_jax.lowering.target import DTYPES, Shape, Value, Values, size_of

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

_FUSIBLE = (Call, Reduce)

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
        return self.size > 1 and isinstance(self.op, _FUSIBLE)

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
    first: int
    step: int
    shape: Shape

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
        return Array(value.node, value.first + value.step * index, 1, ())
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
                return Array(first.node, first.first, step, shape)
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
