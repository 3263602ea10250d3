"""Targets that build the graph of a function: the base of all, and the one of SIMD C.

In SIMD C each number is a vector with a lane for each of 8 or 16 worlds. A `while` loop runs until
its condition fails in all lanes, and masks the lanes that have finished, so that the results of a
world do not depend on other worlds.
"""

from __future__ import annotations

import itertools
from collections.abc import Hashable, Sequence
from typing import Any, TypeAlias

import numpy as np

from rps_jax.lowering.graph import (
    DTYPES,
    REDUCTIONS,
    Array,
    Body,
    Call,
    Carried,
    DynamicSlice,
    For,
    Gather,
    Input,
    LoopNode,
    LoopResult,
    Node,
    Operation,
    Params,
    Reduce,
    Result,
    Shape,
    Target,
    TooLargeError,
    Typed,
    UnsupportedError,
    Value,
    Values,
    While,
    element,
    flat,
    is_constant,
    is_unchanged,
    key_of,
    kind_of,
    live_nodes,
    nodes_of,
    operation_of,
    positions,
    size_of,
    view_of,
)
from rps_jax.lowering.operations import SIMD_HEADER, defined
from rps_jax.lowering.walk import Rows, reduced_by_rows, sliding_windows, walk

# Initial value of a reduction, by its operation and kind.
INITIAL = {
    ("add", "f"): 0.0,
    ("add", "i"): 0,
    ("max", "f"): -np.inf,
    ("min", "f"): np.inf,
    ("max", "i"): -(2**31),
    ("min", "i"): 2**31 - 1,
    ("and", "b"): True,
    ("or", "b"): False,
}
Factor: TypeAlias = tuple[Value, np.ndarray]  # a value and its flat indices (batch, rows, summed)


class GraphBuilder(Target):
    """Target that builds the graph of a function; equal nodes are shared."""

    max_products: int  # multiplications in one product of matrices
    loops = For, While

    def __init__(self) -> None:
        self._ids = itertools.count()
        self._scopes: list[dict[Hashable, Node]] = [{}]  # of each loop that is being built

    def node(self, op: Operation, operands: Values, kind: str, size: int) -> Node:
        """Return the node of an operation, a new one or an equal one."""
        key = (op, tuple(map(key_of, operands)), kind, size)
        for scope in self._scopes:
            if key in scope:
                return scope[key]
        node = Node(next(self._ids), op, tuple(operands), kind, size)
        self._scopes[-1][key] = node
        return node

    def kind(self, dtype: object, name: str) -> str:
        """Return the kind of a dtype.

        Raises:
          UnsupportedError: the target has no such numbers.
        """
        return kind_of(dtype, name, self.kinds)

    def input(self, index: int, shape: Shape, dtype: object) -> Array:
        """Return an argument of the function."""
        kind, size = self.kind(dtype, "an argument"), size_of(shape)
        return Array(self.node(Input(index), (), kind, size), shape)

    def scalar(self, value: Value, index: int) -> Value:
        """Return one number of a value."""
        return element(value, index)

    def gather(self, values: Values, indices: np.ndarray, template: Typed) -> Value:
        starts = np.cumsum([0, *(size_of(np.shape(v)) for v in values)])
        flat_indices = indices.reshape(-1)
        if not flat_indices.size:
            return np.zeros(indices.shape, template.dtype)
        owners = np.searchsorted(starts, flat_indices, "right") - 1
        scalars = [
            self.scalar(values[i], int(index - starts[i]))
            for i, index in zip(owners, flat_indices, strict=True)
        ]
        if not nodes_of(scalars):
            dtype = None if isinstance(template, Array) else template.dtype
            return np.asarray(scalars, dtype).reshape(indices.shape)
        kind = self.kind(template.dtype, "gather")
        return view_of(scalars, indices.shape) or self.stack(scalars, kind, indices.shape)

    def stack(self, scalars: Values, kind: str, shape: Shape) -> Array:
        """Return scalars of several nodes as an array."""
        return Array(self.node(Gather(), scalars, kind, len(scalars)), shape)

    def apply(self, name: str, values: Values, params: Params, out: Typed) -> Value:
        kind = self.kind(out.dtype, name)
        if name in REDUCTIONS:
            return self._reduced(REDUCTIONS[name], values[0], params["axes"], kind, out)
        if name == "dynamic_slice":
            return self._slice(values[0], values[1:], params["slice_sizes"], kind)
        if name == "dot_general":
            return self._product(values[0], values[1], params["dimension_numbers"], out)
        function = operation_of(name, values, params, out)
        if name == "select_n":
            values = [values[0], values[2], values[1]]
        if function not in self.operations:
            raise UnsupportedError(name)
        shape, size, operands = out.shape, size_of(out.shape), []
        for value in values:
            value_shape = np.shape(value)
            if value_shape != shape and size_of(value_shape) > 1:
                indices = np.broadcast_to(positions(value_shape), shape)
                value = self.gather([value], indices, value)
            operands.append(flat(value, size))
        return Array(self.node(Call(function), operands, kind, size), shape)

    def _reduced(
        self, binary: str, value: Value, axes: Sequence[int], kind: str, out: Typed
    ) -> Value:
        """Reduce all elements in one loop that other nodes share, or some axes row by row."""
        shape, size = np.shape(value), size_of(np.shape(value))
        if len(axes) == len(shape) and size > 1 and (binary, kind) in INITIAL:
            return Array(self.node(Reduce(binary), [flat(value, size)], kind, size), (), step=0)
        return reduced_by_rows(self, binary, value, axes, out)

    def _product(self, lhs: Value, rhs: Value, dimensions: Any, out: Typed) -> Value:
        """Multiply matrices."""
        (lhs_sum, rhs_sum), (lhs_batch, rhs_batch) = dimensions
        sides: list[Factor] = [
            (lhs, _matrix_indices(lhs, lhs_batch, lhs_sum)),
            (rhs, _matrix_indices(rhs, rhs_batch, rhs_sum)),
        ]
        rows = [indices.shape[1] for _, indices in sides]
        if size_of(out.shape) * sides[0][1].shape[2] > self.max_products:
            raise TooLargeError("XLA compiles large products of matrices to faster code.")
        # Elementwise over the constant matrix, else over the longer one.
        constant = [is_constant(value) for value, _ in sides]
        long = constant.index(True) if any(constant) else int(rows[1] > rows[0])
        products = self.products(sides[long], sides[1 - long], out.dtype)
        indices = positions(out.shape).reshape(-1, rows[1 - long], rows[long])
        if long == 0:  # the rows of the left factor come first
            indices = indices.swapaxes(1, 2)
        return self.gather(products, indices.reshape(out.shape), out)

    def products(self, matrix: Factor, rows: Factor, dtype: np.dtype) -> list[Value]:
        """Return the product of a matrix with each row of another, elementwise over its rows."""
        (weights, indices), (value, row_indices) = matrix, rows
        template, totals = np.empty(indices.shape[1], dtype), []
        for batch, row in np.ndindex(*row_indices.shape[:2]):
            total = None
            for k, index in enumerate(row_indices[batch, row]):
                pair = [
                    self.gather([weights], indices[batch, :, k], template),
                    self.gather([value], np.full(template.shape, index), template),
                ]
                term = self.apply("mul", pair, {}, template)
                total = term if total is None else self.apply("add", [total, term], {}, template)
            totals.append(np.zeros_like(template) if total is None else total)
        return totals

    def _slice(self, value: Value, starts: Values, sizes: Sequence[int], kind: str) -> Value:
        """Slice an array at an index that is known at run time, clamped to the array."""
        shape = np.shape(value)
        index, windows = sliding_windows(self, shape, starts, sizes)
        if is_constant(value):
            value = GraphBuilder.stack(self, list(np.reshape(value, -1)), kind, shape)
        if value.step != 1 or value.node.size == 1:
            return self.gather([value], windows[0].reshape(sizes), template=value)
        op = DynamicSlice(tuple(map(tuple, (windows + value.first).tolist())))
        node = self.node(op, [flat(index, 1), value], kind, windows.shape[1])
        return Array(node, tuple(sizes))

    # --- loops ---

    def loop(
        self, op: For | While, condition: Body | None, body: Body, carry: Values
    ) -> list[Value]:
        carried, current = list[Node](), list[Value]()
        for x in carry:
            kind, shape = self.kind(x.dtype, "a loop"), np.shape(x)
            node = Node(next(self._ids), Carried(), (), kind, size_of(shape))
            carried.append(node)
            current.append(Array(node, shape) if node.size else x)
        self._scopes.append({})
        (holds,) = condition(current) if condition else (None,)
        results = []
        for node, value in zip(carried, body(current), strict=True):
            value = flat(value, node.size) if node.size else value
            if isinstance(value, Array) and value.node in carried and not is_unchanged(node, value):
                copies = [element(value, i) for i in range(node.size)]
                value = Array(self.node(Gather(), copies, node.kind, node.size), value.shape)
            results.append(value)
        self._scopes.pop()
        holds = None if holds is None else flat(holds, 1)
        roots = nodes_of((*results, holds))
        inside, inner = set(carried), []
        for node in live_nodes(roots):
            if node in inside or not inside.isdisjoint(node.predecessors):
                inside.add(node)
                inner += [node] if node not in carried else []
        captured = {x for node in inner for x in node.predecessors} | set(roots)
        loop = LoopNode(
            next(self._ids),
            op,
            tuple(flat(x, size_of(np.shape(x))) for x in carry),
            kind="f",
            size=0,
            captured=tuple(captured - inside),
            carried=tuple(carried),
            results=tuple(results),
            condition=holds,
            body=tuple(inner),
        )
        last = []
        for node, x in zip(carried, carry, strict=True):
            result = Node(next(self._ids), LoopResult(node), (), node.kind, node.size, (loop,))
            last.append(Array(result, np.shape(x)) if node.size else x)
        return last


class SimdBuilder(GraphBuilder):
    """Target of SIMD C: numbers of 4 bytes."""

    kinds = "fibu"
    operations = defined(SIMD_HEADER)
    max_products = 256

    def kind(self, dtype: object, name: str) -> str:
        kind = super().kind(dtype, name)
        if np.dtype(DTYPES[kind]).itemsize != getattr(dtype, "itemsize", 0):
            raise UnsupportedError(f"{name} of {dtype}")
        return kind


def results(
    rows: Rows, shapes: Sequence[Typed], outs: Sequence[Typed], target: GraphBuilder
) -> tuple[list[Result], list[Node]]:
    """Return the results of a function of arguments of these types, and their nodes."""
    inputs = []
    for i, x in enumerate(shapes):
        shape = x.shape[i in rows.scanned :]
        is_empty = not size_of(shape)
        inputs.append(np.zeros(shape, x.dtype) if is_empty else target.input(i, shape, x.dtype))
    if rows.operands is not None:
        inputs = [inputs[x] if isinstance(x, int) else x for x in rows.operands]
    returned = []
    for i, (value, x) in enumerate(zip(walk(rows.body, inputs, target), outs, strict=True)):
        if size := size_of(x.shape[i in rows.stacked :]):
            returned.append(Result(i, flat(value, size), size, target.kind(x.dtype, "a result")))
    return returned, nodes_of([result.value for result in returned])


def _matrix_indices(value: Value, batch: Sequence[int], summed: Sequence[int]) -> np.ndarray:
    """Return the flat indices of a factor of a product: (batch, rows, summed)."""
    shape = np.shape(value)
    rows = [i for i in range(len(shape)) if i not in (*batch, *summed)]
    indices = positions(shape).transpose([*batch, *rows, *summed])
    return indices.reshape([size_of([shape[i] for i in axes]) for axes in (batch, rows, summed)])
