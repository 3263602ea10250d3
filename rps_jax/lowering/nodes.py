"""Graph of arrays that C and CUDA are printed from, and the target that builds it.

`Node` is an array and the operation that computes it, `LoopNode` a loop, `Array` a view of a node.
`SimdNodes` builds the graph of a pure function of one world. In C each number is a vector with a
lane for each of 8 or 16 worlds. A `while` loop runs until its condition fails in all lanes, and
masks the lanes that have finished, so the results of a world do not depend on other worlds.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jax.extend.core import ClosedJaxpr

from rps_jax.lowering.operations import SIMD_HEADER, defined
from rps_jax.lowering.target import (
    DTYPES,
    REDUCTIONS,
    Body,
    Params,
    Shape,
    Target,
    TooLargeError,
    Typed,
    UnsupportedError,
    Value,
    Values,
    is_constant,
    kind_of,
    operation_of,
    size_of,
)
from rps_jax.lowering.walk import walk

# Initial value of a reduction, by its operation and kind.
INITIAL = {
    **{("add", "f"): 0.0, ("add", "i"): 0, ("max", "f"): -np.inf, ("min", "f"): np.inf},
    **{("max", "i"): -(2**31), ("min", "i"): 2**31 - 1, ("and", "b"): True, ("or", "b"): False},
}
# Operations that are not computed in a loop over their numbers.
_SINGLE = ("move", "take", "while", "for", "if", "input", "part", "product")


@dataclass(eq=False)
class Node:
    """An array of numbers and the operation that computes it."""

    id: int
    op: str
    args: tuple[Value, ...]  # `Array` and constants
    kind: str
    size: int
    extra: Any = None  # static parameter of the operation
    free: tuple[Node, ...] = ()  # nodes that it needs beside its operands

    @property
    def name(self) -> str:
        """Variable in the printed code."""
        return f"v{self.stored.id}"

    @property
    def stored(self) -> Node:
        """Node that stores it: a part of a loop's results is stored in the loop's carry."""
        return self.extra if self.op == "part" else self

    @property
    def needed(self) -> Iterable[Node]:
        """Nodes that must be computed before it."""
        return itertools.chain((a.node for a in self.args if isinstance(a, Array)), self.free)

    @property
    def width(self) -> int:
        """Number of elements that it stores."""
        return 1 if self.op.startswith("fold") else self.size

    @property
    def is_single(self) -> bool:
        """Whether it is printed outside of the loops over elements."""
        return self.size < 2 or self.op in _SINGLE

    @functools.cached_property
    def whole(self) -> set[Node]:
        """Nodes of owners all elements must be computed before its first element."""
        arrays = [a for a in self.args if isinstance(a, Array)]
        in_step = set() if self.is_single else {a.node for a in arrays if self.is_in_step(a)}
        return {a.node for a in arrays} - in_step | set(self.free)

    def is_in_step(self, a: Array) -> bool:
        """Whether element `i` of this node reads element `i` of a node."""
        return a.step == 1 and a.first == 0 and a.node.width == self.size


@dataclass(eq=False)
class LoopNode(Node):
    """A loop, or a conditional block: its operands are the initial values of its carry."""

    carried: tuple[Node, ...] = ()
    results: tuple[Value, ...] = ()  # carry after one iteration
    condition: Value = None  # of a `while` loop or an `if`
    length: int | None = None  # iterations of a `for` loop
    inner: tuple[Node, ...] = ()  # nodes that it computes, in any order that suits


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


Factor: TypeAlias = tuple[Value, np.ndarray]  # a value and its flat indices (batch, rows, summed)


class SimdNodes(Target):
    """Target that builds the graph of a function of one world; equal nodes are shared."""

    kinds = "fibu"
    operations = defined(SIMD_HEADER)
    max_products = 256  # multiplications in one product of matrices

    def __init__(self) -> None:
        self._numbers = itertools.count()
        self._known: list[dict[Hashable, Node]] = [{}]  # of each loop that is being built

    def node(self, op: str, args: Values, kind: str, size: int, extra: Any = None) -> Node:
        """Return the node of an operation, a new one or an equal one."""
        key = (op, tuple(map(key_of, args)), kind, size, extra)
        for known in self._known:
            if key in known:
                return known[key]
        node = Node(next(self._numbers), op, tuple(args), kind, size, extra)
        self._known[-1][key] = node
        return node

    def kind(self, dtype: object, name: str) -> str:
        """Return the kind of a dtype of 4 bytes.

        Raises:
          UnsupportedError: the target has no such numbers.
        """
        kind = kind_of(dtype, name, self.kinds)
        if np.dtype(DTYPES[kind]).itemsize != getattr(dtype, "itemsize", 0):
            raise UnsupportedError(f"{name} of {dtype}")
        return kind

    def input(self, index: int, shape: Shape, dtype: object) -> Array:
        """Return an argument of the function."""
        kind, size = self.kind(dtype, "an argument"), size_of(shape)
        return Array(self.node("input", (), kind, size, index), 0, 1, shape)

    def source(self, value: Value, index: int) -> Value:
        """Return one number of a value."""
        return element(value, index)

    def moved(self, values: Values, indices: np.ndarray, template: Typed) -> Value:
        """Gather numbers at constant indices: a view of a node where that suffices."""
        starts = np.cumsum([0, *(size_of(np.shape(v)) for v in values)])
        flat_indices = indices.reshape(-1)
        if not flat_indices.size:
            return np.zeros(indices.shape, template.dtype)
        owners = np.searchsorted(starts, flat_indices, "right") - 1
        sources = [
            self.source(values[i], int(at - starts[i]))
            for i, at in zip(owners, flat_indices, strict=True)
        ]
        if all(not isinstance(x, Array) for x in sources):
            dtype = None if isinstance(template, Array) else template.dtype
            return np.asarray(sources, dtype).reshape(indices.shape)
        kind = self.kind(template.dtype, "move")
        return view_of(sources, indices.shape) or self.gathered(sources, kind, indices.shape)

    def gathered(self, scalars: Values, kind: str, shape: Shape) -> Array:
        """Return scalars of several nodes as an array."""
        return Array(self.node("move", scalars, kind, len(scalars)), 0, 1, shape)

    def apply(self, name: str, values: Values, params: Params, out: Typed) -> Value:
        """Apply a primitive element by element, or as a reduction, a product or a slice."""
        kind = self.kind(out.dtype, name)
        if name in REDUCTIONS:
            return self._reduced(REDUCTIONS[name], values[0], params["axes"], kind, out)
        if name == "dynamic_slice":
            return self._slice(values[0], values[1:], params["slice_sizes"], kind)
        if name == "dot_general":
            return self._product(values[0], values[1], params["dimension_numbers"], out)
        op = operation_of(name, values, params, out)
        if name == "select_n":
            values = [values[0], values[2], values[1]]
        if op not in self.operations:
            raise UnsupportedError(name)
        shape, size, args = out.shape, size_of(out.shape), []
        for value in values:
            own_shape = np.shape(value)
            if own_shape != shape and size_of(own_shape) > 1:
                indices = np.arange(size_of(own_shape)).reshape(own_shape)
                value = self.moved([value], np.broadcast_to(indices, shape), value)
            args.append(flat(value, size))
        return Array(self.node(op, args, kind, size), 0, 1, shape)

    def _reduced(
        self, binary: str, value: Value, axes: Sequence[int], kind: str, out: Typed
    ) -> Value:
        """Reduce all elements in one loop that other nodes share, or some axes row by row."""
        shape = np.shape(value)
        if len(axes) == len(shape) and size_of(shape) > 1 and (binary, kind) in INITIAL:
            size, op = size_of(shape), f"fold {binary}_{kind}"
            return Array(self.node(op, [flat(value, size)], kind, size), 0, 0, ())
        return self.reduced_by_rows(binary, value, axes, out)

    def _product(self, lhs: Value, rhs: Value, dimensions: Any, out: Typed) -> Value:
        """Multiply matrices."""
        (lhs_sum, rhs_sum), (lhs_batch, rhs_batch) = dimensions
        sides: list[Factor] = [
            (lhs, matrix_indices(lhs, lhs_batch, lhs_sum)),
            (rhs, matrix_indices(rhs, rhs_batch, rhs_sum)),
        ]
        rows = [indices.shape[1] for _, indices in sides]
        if size_of(out.shape) * sides[0][1].shape[2] > self.max_products:
            raise TooLargeError("XLA compiles large products of matrices to faster code.")
        # Elementwise over the constant matrix, else over the longer one.
        constant = [is_constant(value) for value, _ in sides]
        long = constant.index(True) if any(constant) else int(rows[1] > rows[0])
        parts = self.products(sides[long], sides[1 - long], out.dtype)
        indices = np.arange(size_of(out.shape)).reshape(-1, rows[1 - long], rows[long])
        if long == 0:  # the rows of the left factor come first
            indices = indices.swapaxes(1, 2)
        return self.moved(parts, indices.reshape(out.shape), out)

    def products(self, matrix: Factor, rows: Factor, dtype: np.dtype) -> list[Value]:
        """Return the product of a matrix with each row of another, elementwise over its rows."""
        (_, indices), (_, row_indices) = matrix, rows
        template, parts = np.empty(indices.shape[1], dtype), []
        for batch, row in np.ndindex(*row_indices.shape[:2]):
            total = None
            for k, index in enumerate(row_indices[batch, row]):
                at = indices[batch, :, k], np.full(template.shape, index)
                factors = zip((matrix, rows), at, strict=True)
                pair = [self.moved([factor[0]], i, template) for factor, i in factors]
                term = self.apply("mul", pair, {}, template)
                total = term if total is None else self.apply("add", [total, term], {}, template)
            parts.append(np.zeros_like(template) if total is None else total)
        return parts

    def _slice(self, value: Value, starts: Values, sizes: Sequence[int], kind: str) -> Any:
        """Slice an array at an index that is known at run time, clamped to the array."""
        shape = np.shape(value)
        index, table = self.windows(shape, starts, sizes)
        if is_constant(value):
            node = self.node("move", list(np.reshape(value, -1)), kind, value.size)
            value = Array(node, 0, 1, shape)
        if value.step != 1 or value.node.size == 1:
            return self.moved([value], table[0].reshape(sizes), template=value)
        extra = tuple(map(tuple, (table + value.first).tolist()))
        node = self.node("take", [flat(index, 1), value], kind, table.shape[1], extra)
        return Array(node, 0, 1, tuple(sizes))

    # --- loops ---

    def for_loop(self, body: Body, carry: Values, length: int) -> list[Value]:
        """Emit a loop of `length` iterations."""
        return self._loop(None, body, carry, length)

    def while_loop(self, condition: Body, body: Body, carry: Values) -> list[Value]:
        """Emit a loop that each lane leaves when its own condition fails."""
        return self._loop(condition, body, carry, None)

    def _loop(
        self, condition: Body | None, body: Body, carry: Values, length: int | None
    ) -> list[Value]:
        carried, current = list[Node](), list[Value]()
        for x in carry:
            kind, shape = self.kind(x.dtype, "a loop"), np.shape(x)
            node = Node(next(self._numbers), "carried", (), kind, size_of(shape))
            carried.append(node)
            current.append(Array(node, 0, 1, shape) if node.size else x)
        self._known.append({})
        (holds,) = condition(current) if condition else (None,)
        results = []
        for node, value in zip(carried, body(current), strict=True):
            value = flat(value, node.size) if node.size else value
            if isinstance(value, Array) and value.node in carried and value.node is not node:
                copies = [element(value, i) for i in range(node.size)]
                value = Array(self.node("move", copies, node.kind, node.size), 0, 1, value.shape)
            results.append(value)
        self._known.pop()
        holds = None if holds is None else flat(holds, 1)
        roots = [a.node for a in (*results, holds) if isinstance(a, Array)]
        inside, inner = set(carried), []
        for node in reached(roots):  # in the order of their creation
            if node in inside or any(x in inside for x in node.needed):
                inside.add(node)
                inner += [node] if node.op != "carried" else []
        free = {x for node in inner for x in node.needed} | set(roots)
        loop = LoopNode(
            next(self._numbers), "for" if length else "while",
            tuple(flat(x, size_of(np.shape(x))) for x in carry), "f", 0, None,
            tuple(free - inside), tuple(carried), tuple(results), holds, length, tuple(inner),
        )  # fmt: skip
        parts = []
        for node, x in zip(carried, carry, strict=True):
            part = Node(next(self._numbers), "part", (), node.kind, node.size, node, (loop,))
            parts.append(Array(part, 0, 1, np.shape(x)) if node.size else x)
        return parts


class Result(NamedTuple):
    """A result with at least one number, and its position among all results."""

    position: int
    value: Value  # `Array` or a constant
    size: int
    kind: str


def results(
    closed: ClosedJaxpr, shapes: Sequence[Typed], outs: Sequence[Typed], target: SimdNodes
) -> tuple[list[Result], list[Node]]:
    """Return the results of a closed jaxpr of arguments of these types, and their nodes."""
    inputs = [
        target.input(i, x.shape, x.dtype) if size_of(x.shape) else np.zeros(x.shape, x.dtype)
        for i, x in enumerate(shapes)
    ]
    returned = []
    for i, (value, template) in enumerate(zip(walk(closed, inputs, target), outs, strict=True)):
        if size := size_of(template.shape):
            kind = target.kind(template.dtype, "a result")
            returned.append(Result(i, flat(value, size), size, kind))
    return returned, [result.value.node for result in returned if isinstance(result.value, Array)]


def matrix_indices(value: Value, batch: Sequence[int], summed: Sequence[int]) -> np.ndarray:
    """Return the flat indices of a factor of a product: (batch, rows, summed)."""
    shape = np.shape(value)
    rows = [i for i in range(len(shape)) if i not in (*batch, *summed)]
    indices = np.arange(size_of(shape)).reshape(shape).transpose([*batch, *rows, *summed])
    return indices.reshape([size_of([shape[i] for i in axes]) for axes in (batch, rows, summed)])


def key_of(value: Value) -> Hashable:
    """Return what equal operands have in common."""
    if isinstance(value, Array):
        return (value.node.id, value.first, value.step)
    return np.asarray(value).tobytes(), np.asarray(value).dtype.str


def element(value: Value, index: int) -> Value:
    """Return one number of a value as an operand."""
    if isinstance(value, Array):
        return Array(value.node, value.first + value.step * index, 1, ())
    return np.asarray(value).reshape(-1)[index]


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


def reached(nodes: Iterable[Node]) -> list[Node]:
    """Return nodes and all nodes that they need, in the order of their creation."""
    visited: dict[int, Node] = {}
    waiting = list(nodes)
    while waiting:
        node = waiting.pop()
        if node.id not in visited:
            visited[node.id] = node
            waiting += node.needed
    return [visited[key] for key in sorted(visited)]
