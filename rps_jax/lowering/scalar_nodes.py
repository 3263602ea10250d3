"""Graph of arrays that scalar C and JavaScript are printed from.

`ScalarNodes` builds the graph. Unlike `SimdNodes` it leaves the precision to the printed code, and
a product with a large constant matrix is one node (`product`). `conditional` moves such products
into a block that runs only when its result is used.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence

import numpy as np

from rps_jax.lowering.nodes import (
    Array,
    Factor,
    LoopNode,
    Node,
    SimdNodes,
    element,
    flat,
    key_of,
    reached,
)
from rps_jax.lowering.target import (
    Target,
    Value,
    is_constant,
    kind_of,
)

_LARGE = 256  # weights of a matrix from which on a product is a loop over its rows


class ScalarNodes(SimdNodes):
    """Target that builds the graph of a function for one thread, in float or double."""

    kinds = "fib"
    max_products = 100_000

    def __init__(self, operations: Collection[str]) -> None:
        """Build a graph of the `operations` that the language spells."""
        super().__init__()
        self.operations = frozenset(operations)

    def kind(self, dtype: object, name: str) -> str:
        return kind_of(dtype, name, self.kinds)

    def source(self, value: Value, index: int) -> Value:
        """Return one number of a value, from where it was gathered."""
        scalar = element(value, index)
        while isinstance(scalar, Array) and scalar.node.op == "move":
            scalar = scalar.node.args[scalar.first]
        return scalar

    # A control step has a deadline, so the length of each loop must be known.
    while_loop = Target.while_loop

    def products(self, matrix: Factor, rows: Factor, dtype: np.dtype) -> list[Value]:
        (weights, indices), (value, row_indices) = matrix, rows
        is_large = is_constant(weights) and len(indices) == 1 and indices.size >= _LARGE
        if not is_large or dtype.kind != "f":
            return super().products(matrix, rows, dtype)
        columns = np.reshape(weights, -1)[indices[0]].T
        return [self._times_matrix(self._rows(value, row_indices[0]), columns)]

    def _rows(self, value: Value, indices: np.ndarray) -> list[list[Value]]:
        return [[self.source(value, int(i)) for i in row] for row in indices]

    def _times_matrix(self, rows: list[list[Value]], matrix: np.ndarray) -> Value:
        """Multiply rows with a constant matrix, in one loop over the matrix.

        The learned laws have pairs of rows (a, b), (b, a). Sum and difference halve their
        arithmetic: (a + b) (P + Q) / 2 plus or minus (a - b) (P - Q) / 2 of the halves P and Q.
        """
        matrix = np.ascontiguousarray(matrix, float)
        columns, (half, odd) = matrix.shape[1], divmod(matrix.shape[0], 2)
        keys = [list(map(key_of, row)) for row in rows]
        if len(rows) == 2 and not odd and keys[0] == keys[1][half:] + keys[1][:half]:
            template, at = np.empty(half), np.arange(half)
            pair = [self.moved(part, at, template) for part in (rows[0][:half], rows[0][half:])]
            p, q = matrix.reshape(2, half, columns) / 2
            products = []
            for name, part in (("add", p + q), ("sub", p - q)):
                row = self._rows(self.apply(name, pair, {}, template), at[None])
                products.append(self._times_matrix(row, part))
            halves = [self.apply(x, products, {}, np.empty(columns)) for x in ("add", "sub")]
            return self.moved(halves, np.arange(2 * columns), np.empty(0))
        size, extra = len(rows) * columns, (matrix.shape, matrix.tobytes())
        node = self.node("product", list(itertools.chain(*rows)), "f", size, extra)
        return Array(node, 0, 1, (size,))


def conditional(roots: Sequence[Node]) -> list[Node]:
    """Return all nodes that some nodes need, with a block for products that are not always used.

    A learned law decides five times a second. Its network is evaluated only in these steps.
    """
    nodes = reached(roots)
    if not any(node.op == "product" for node in nodes):
        return nodes
    conditions = dict.fromkeys(filter(None, map(_condition, nodes)))
    for condition, side in itertools.product(conditions, (1, 2)):
        if _move_into_block(nodes, roots, condition, side):
            return reached(roots)
    return nodes


def _condition(node: Node) -> tuple[Node, int] | None:
    """Return the node and the index of the number by which a node chooses an operand."""
    a = node.args[0] if node.op.startswith("choose") else None
    return (a.node, a.first) if isinstance(a, Array) and (not a.step or node.size == 1) else None


def _move_into_block(
    nodes: Sequence[Node], roots: Sequence[Node], condition: tuple[Node, int], side: int
) -> bool:
    """Move nodes that matter on one side of a condition into a block, if a product is there."""
    always: set[Node] = set()
    waiting = list(roots)
    while waiting:
        node = waiting.pop()
        if node not in always:
            always.add(node)
            is_choice = _condition(node) == condition
            args = (node.args[0], node.args[3 - side]) if is_choice else node.args
            waiting += [a.node for a in args if isinstance(a, Array)] + list(node.free)
    block = [node for node in nodes if node not in always and node.op != "input"]
    inside = set(block)
    if not any(node.op == "product" for node in block):
        return False
    choices = [
        node for node in nodes
        if node in always and _condition(node) == condition
        if isinstance(a := node.args[side], Array) and a.node in inside
    ]  # fmt: skip
    needed = {x for node in block for x in node.needed} - inside
    starts = tuple(node.args[3 - side] for node in choices)
    needed |= {condition[0], *(a.node for a in starts if isinstance(a, Array))}
    if set(reached(needed)) & set(choices):
        return False
    ids = itertools.count(max(node.id for node in nodes) + 1)
    carried = tuple(Node(next(ids), "carried", (), n.kind, n.size) for n in choices)
    results = tuple(flat(node.args[side], node.size) for node in choices)
    loop = LoopNode(
        next(ids), "if", starts, "f", 0, side == 1, tuple(needed), carried, results,
        condition=Array(*condition, 1, (1,)), inner=tuple(block),
    )  # fmt: skip
    for node, carry in zip(choices, carried, strict=True):
        node.op, node.args, node.extra, node.free = "part", (), carry, (loop,)
        node.__dict__.pop("whole", None)
    return True
