"""Target that builds the graph of a CUDA kernel, in which several threads of a warp run a world."""

from __future__ import annotations

from collections.abc import Hashable

import numpy as np

from rps_jax.lowering.builder import SimdBuilder
from rps_jax.lowering.graph import (
    Array,
    Call,
    Node,
    Reduce,
    flat,
    gathered_scalar,
    view_of,
)
from rps_jax.lowering.operations import GPU_HEADER, defined
from rps_jax.lowering.target import Params, Shape, Typed, Value, Values, size_of

WARP = 32
_SUM = Call("add_over_threads_f")  # sum of the partial sums of all threads of a world


class GpuBuilder(SimdBuilder):
    """Target that builds the graph of a function for several threads per world."""

    operations = defined(GPU_HEADER)

    def __init__(self) -> None:
        super().__init__()
        self._gathers: dict[Hashable, Array] = {}

    def stack(self, scalars: Values, kind: str, shape: Shape) -> Array:
        """Gather scalars; many that the same operation computes become one array operation."""
        scalars = tuple(map(gathered_scalar, scalars))
        if len(scalars) <= WARP:
            return super().stack(scalars, kind, shape)
        return self._stacked(scalars, kind)._replace(shape=shape)

    def _stacked(self, scalars: tuple[Value, ...], kind: str) -> Value:
        """Return scalars as one operand."""
        size = len(scalars)
        if not any(isinstance(a, Array) for a in scalars):
            return flat(np.asarray(scalars), size)
        if view := view_of(scalars, (size,)):
            return view
        if not all(isinstance(a, Array) for a in scalars):
            return super().stack(scalars, kind, (size,))
        key = tuple((a.node.id, a.first) for a in scalars)
        if key not in self._gathers:
            self._gathers[key] = self._vectorised(scalars, kind)
        return self._gathers[key]

    def _vectorised(self, scalars: tuple[Array, ...], kind: str) -> Array:
        """Vectorise a gather of scalars: apply their common operation to gathered operands."""
        first, size, nodes = scalars[0].node, len(scalars), {a.node for a in scalars}
        operations = {(node.op, len(node.operands)) for node in nodes}
        op, are_elements = first.op, all(node.is_fusible for node in nodes)
        if len(operations) > 1 or not are_elements or not isinstance(op, Call):
            return super().stack(scalars, kind, (size,))
        operands = [
            self._stacked(
                tuple(_operand(a, j) for a in scalars), self.kind(template.dtype, "a gather")
            )
            for j, template in enumerate(first.operands)
        ]
        return Array(self.node(op, operands, kind, size), 0, 1, (size,))

    def apply(self, name: str, values: Values, params: Params, out: Typed) -> Value:
        """Apply a primitive; sums over threads are added before they are exchanged."""
        if name in ("add", "sub") and size_of(out.shape) == 1 and out.dtype == np.float32:
            lhs, rhs = (_node_of(x) for x in values)
            if lhs and rhs and rhs.op == _SUM:
                if lhs.op == _SUM:
                    return self._sum(name, lhs, rhs, out)
                if lhs.op == Call(f"{name}_f"):
                    last = _node_of(lhs.operands[1])
                    if last and last.op == _SUM:
                        both = self._sum("add", last, rhs, out)
                        return super().apply(name, [lhs.operands[0], both], params, out)
        result = super().apply(name, values, params, out)
        node = _node_of(result)
        if node is None or not isinstance(node.op, Reduce):
            return result
        op = Call(f"{node.op.binary}_over_threads_{node.kind}")
        return Array(self.node(op, [result], node.kind, 1), 0, 1, result.shape)

    def _sum(self, name: str, lhs: Node, rhs: Node, out: Typed) -> Array:
        partial = [x.operands[0]._replace(shape=out.shape) for x in (lhs, rhs)]
        total = super().apply(name, partial, {}, out)
        return Array(self.node(_SUM, [flat(total, 1)], "f", 1), 0, 1, out.shape)


def _operand(a: Array, j: int) -> Value:
    """Return operand `j` of the operation that computed a single number."""
    operand = a.node.operands[j]
    if not isinstance(operand, Array):
        return np.reshape(operand, -1)[a.first if np.size(operand) > 1 else 0]
    return gathered_scalar(Array(operand.node, operand.first + operand.step * a.first, 1, ()))


def _node_of(value: Value) -> Node | None:
    """Return the node of a single number."""
    return value.node if isinstance(value, Array) and value.node.width == 1 else None
