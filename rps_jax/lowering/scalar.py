"""Graph and printer of scalar code, the base of C and JavaScript.

The graph leaves the precision to the printed code. A product with a large constant matrix is one
node.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from typing import ClassVar

import numpy as np

from rps_jax.lowering.builder import Factor, GraphBuilder, results
from rps_jax.lowering.graph import (
    Array,
    Call,
    Carried,
    DynamicSlice,
    For,
    If,
    Input,
    LoopNode,
    LoopResult,
    MatrixProduct,
    Node,
    Reduce,
    Value,
    flat,
    gathered_scalar,
    is_constant,
    key_of,
    live_nodes,
    nodes_of,
)
from rps_jax.lowering.routine import Routine
from rps_jax.lowering.walk import Rows
from rps_jax.lowering.writer import Writer

_LARGE = 256  # weights of a matrix from which on a product is a loop over its rows


class ScalarBuilder(GraphBuilder):
    """Target that builds the graph of a function for one thread, in float or double."""

    kinds = "fib"
    max_products = 100_000

    def __init__(self, operations: Collection[str]) -> None:
        """Build a graph of the `operations` that the language spells."""
        super().__init__()
        self.operations = frozenset(operations)

    def scalar(self, value: Value, index: int) -> Value:
        """Return one number of a value, from where it was gathered."""
        scalar = super().scalar(value, index)
        while (source := gathered_scalar(scalar)) is not scalar:
            scalar = source
        return scalar

    # The printed code may have a deadline, so the length of each loop must be known.
    loops = (For,)

    def products(self, matrix: Factor, rows: Factor, dtype: np.dtype) -> list[Value]:
        (weights, indices), (value, row_indices) = matrix, rows
        is_large = is_constant(weights) and len(indices) == 1 and indices.size >= _LARGE
        if not is_large or dtype.kind != "f":
            return super().products(matrix, rows, dtype)
        columns = np.reshape(weights, -1)[indices[0]].T
        return [self._times_matrix(self._rows(value, row_indices[0]), columns)]

    def _rows(self, value: Value, indices: np.ndarray) -> list[list[Value]]:
        return [[self.scalar(value, int(i)) for i in row] for row in indices]

    def _times_matrix(self, rows: list[list[Value]], matrix: np.ndarray) -> Value:
        """Multiply rows with a constant matrix, in one loop over the matrix.

        Networks with a mirror symmetry have pairs of rows (a, b), (b, a). Sum and difference halve
        their arithmetic: (a + b) (P + Q) / 2 plus or minus (a - b) (P - Q) / 2 of the halves P, Q.
        """
        matrix = np.ascontiguousarray(matrix, float)
        columns, (half, odd) = matrix.shape[1], divmod(matrix.shape[0], 2)
        keys = [list(map(key_of, row)) for row in rows]
        if len(rows) == 2 and not odd and keys[0] == keys[1][half:] + keys[1][:half]:
            template, indices = np.empty(half), np.arange(half)
            pair = [self.gather(x, indices, template) for x in (rows[0][:half], rows[0][half:])]
            p, q = matrix.reshape(2, half, columns) / 2
            products = []
            for name, part in (("add", p + q), ("sub", p - q)):
                row = self._rows(self.apply(name, pair, {}, template), indices[None])
                products.append(self._times_matrix(row, part))
            halves = [self.apply(x, products, {}, np.empty(columns)) for x in ("add", "sub")]
            return self.gather(halves, np.arange(2 * columns), np.empty(0))
        op = MatrixProduct(matrix.shape, matrix.tobytes())
        node = self.node(op, list(itertools.chain(*rows)), "f", len(rows) * columns)
        return Array(node, (node.size,))


# --- blocks ------------------------------------------------------------------------------------


def sink_products(roots: Sequence[Node]) -> list[Node]:
    """Return all live nodes, with a block for products that are not always used.

    A network is then evaluated only in the steps that use its result.
    """
    nodes = live_nodes(roots)
    if any(isinstance(node.op, MatrixProduct) for node in nodes):
        conditions = dict.fromkeys(filter(None, map(_condition, nodes)))
        for condition, side in itertools.product(conditions, (1, 2)):
            if _move_into_block(nodes, roots, condition, side):
                return live_nodes(roots)
    return nodes


def _condition(node: Node) -> Array | None:
    """Return the number by which a node chooses an operand, if it is one for all elements."""
    is_choice = isinstance(node.op, Call) and node.op.function.startswith("choose_")
    a = node.operands[0] if is_choice else None
    if isinstance(a, Array) and (not a.step or node.size == 1):
        return Array(a.node, (1,), a.first)
    return None


def _move_into_block(
    nodes: Sequence[Node], roots: Sequence[Node], condition: Array, side: int
) -> bool:
    """Move nodes that matter on one side of a condition into a block, if a product is there."""
    always: set[Node] = set()
    waiting = list(roots)
    while waiting:
        node = waiting.pop()
        if node not in always:
            always.add(node)
            is_choice = _condition(node) == condition
            operands = [node.operands[i] for i in (0, 3 - side)] if is_choice else node.operands
            waiting += nodes_of(operands) + list(node.captured)
    block = [node for node in nodes if node not in always and not isinstance(node.op, Input)]
    inside = set(block)
    if not any(isinstance(node.op, MatrixProduct) for node in block):
        return False
    choices = [
        node
        for node in nodes
        if node in always and _condition(node) == condition
        if not inside.isdisjoint(nodes_of([node.operands[side]]))
    ]
    starts = tuple(node.operands[3 - side] for node in choices)
    captured = {x for node in block for x in node.predecessors} - inside
    captured |= {condition.node, *nodes_of(starts)}
    if not set(live_nodes(captured)).isdisjoint(choices):
        return False
    ids = itertools.count(max(node.id for node in nodes) + 1)
    carried = tuple(Node(next(ids), Carried(), (), n.kind, n.size) for n in choices)
    loop = LoopNode(
        next(ids),
        If(side == 1),
        starts,
        kind="f",
        size=0,
        captured=tuple(captured),
        carried=carried,
        results=tuple(flat(node.operands[side], node.size) for node in choices),
        condition=condition,
        body=tuple(block),
    )
    for node, carry in zip(choices, carried, strict=True):
        node.op, node.operands, node.captured = LoopResult(carry), (), (loop,)
        node.__dict__.pop("fusion_barriers", None)
    return True


# --- printer -----------------------------------------------------------------------------------

_UNROLLED = 4  # elements of an array that is printed without a loop, at most
# Rows of a matrix that one iteration multiplies. Compilers vectorise the loop over the columns, and
# load and store a sum once for all rows.
_ROWS = 8


class ScalarWriter(Writer):
    """Printer of one routine; subclasses define the spelling of a language."""

    spelling: ClassVar[Mapping[str, str]]  # of operations
    flag: ClassVar[str]  # of an input that is a bool
    alias: ClassVar[str]  # declaration of a flattened input array
    zeros: ClassVar[str]  # array of zeros of a size
    pointer: ClassVar[str] = ""  # mark of a pointer in a declaration
    builder: ClassVar[type[ScalarBuilder]] = ScalarBuilder

    def __init__(
        self, routine: Routine, groups: Mapping[str, str], tables: dict[str, str], prefix: str = ""
    ) -> None:
        """Print the statements `body`; constants are added to the tables.

        Args:
          routine: the function.
          groups: text before the names of the fields of each input group, as `params->`.
          tables: declarations of constants, by name.
          prefix: of all names.
        """
        super().__init__()
        self.tables, self.prefix = tables, prefix
        fields = [(groups[group], x) for group, fields in routine.inputs.items() for x in fields]
        self._inputs = [(f"{text}{field.name}", field) for text, field in fields]
        outputs = [(group, x) for group, fields in routine.outputs.items() for x in fields]
        target = self.builder(self.spelling)
        types, outs = ([x.type for _, x in group] for group in (fields, outputs))
        values, roots = results(Rows(routine.jaxpr), types, outs, target)
        nodes = sink_products(roots)
        self.body = self.lines(nodes, roots)
        known = {result.position: result.value for result in values}
        # Group, field and value of each result.
        self.outputs = [(*x, known.get(i, ())) for i, x in enumerate(outputs)]

    # --- expressions ---

    def constant(self, text: str, kind: str) -> str:
        return f"({text})" if "-" in text.split("e")[0] else text

    def call(self, function: str, operands: Sequence[str]) -> str:
        return self.spelling[function].format(*operands, p=self.prefix, P=self.prefix.upper())

    def item(self, node: Node, index: int | str) -> str:
        if not isinstance(node.op, Input):
            return super().item(node, index)
        name, field = self._inputs[node.op.index]
        if node.size == 1:
            text = name + "[0]" * len(field.shape)
        else:
            text = f"{name if len(field.shape) == 1 else node.name}[{index}]"
        return self.flag.format(text) if node.kind == "b" else text

    # --- statements ---

    def fused(self, group: Sequence[Node], stored: set[Node]) -> list[str]:
        size = group[0].size
        if size > _UNROLLED:
            return super().fused(group, stored)
        lines = []
        for node in group:
            rows = [[self.operand(a, k) for a in node.operands] for k in range(size)]
            if isinstance(node.op, Call):
                function = node.op.function
                lines.append(self.array(node, [self.call(function, row) for row in rows]))
            elif isinstance(node.op, Reduce):
                function = f"{node.op.binary}_{node.kind}"
                (text,), *rest = rows
                for row in rest:
                    text = f"({self.call(function, [text, *row])})"
                lines.append(f"{self.declaration(node.kind, node.name)} = {text};")
        return lines

    def single(self, node: Node) -> list[str]:
        if isinstance(node.op, Input):
            name, field = self._inputs[node.op.index]
            if node.size == 1 or len(field.shape) == 1:
                return []
            corner = name + "[0]" * len(field.shape)
            head = self.declaration(node.kind, f"{self.pointer}{node.name}")
            return [self.alias.format(head=head, name=name, corner=corner)]
        if isinstance(node.op, MatrixProduct):
            return self._product(node, node.op)
        if isinstance(node.op, DynamicSlice):
            index, source = node.operands
            row, columns = self.operand(index, 0), np.array(node.op.windows).T
            items = [self.item(source.node, self._entry(column, row)) for column in columns]
            return [self.array(node, items)]
        return super().single(node)

    def _entry(self, column: np.ndarray, row: str) -> str:
        """Return the entry of a column of indices in a row."""
        first, step = column[0], column[1] - column[0] if len(column) > 1 else 0
        if (column == first + step * np.arange(len(column))).all():
            text = row if step == 1 else f"{step} * {row}"
            return f"{first} + {text}" if first else text
        return f"{self.table(column)}[{row}]"

    def loop_head(self, loop: LoopNode) -> str:
        if not isinstance(loop.op, If):
            return super().loop_head(loop)
        return f"if ({'!' * (not loop.op.expected)}{self.operand(loop.condition, 0)}) {{"

    def _product(self, node: Node, op: MatrixProduct) -> list[str]:
        """Return a product of rows with a matrix, which is padded with zeros."""
        n, (inputs, columns) = node.id, op.shape
        matrix = np.frombuffer(op.content).reshape(inputs, columns)
        padded = inputs + -inputs % _ROWS
        table = self.table(np.pad(matrix, ((0, padded - inputs), (0, 0))))
        items = [self.operand(a, 0) for a in node.operands]
        zeros = [self.literal(0.0, "f")] * (padded - inputs)
        rows = [[*items[i : i + inputs], *zeros] for i in range(0, len(items), inputs)]
        flat = [text for row in rows for text in row]
        lines = [
            f"{self.declaration('f', f'x{n}', len(flat))} = {self.array_literal(flat)};",
            f"{self.declaration('f', node.name, node.size, constant=False)} = "
            f"{self.zeros.format(node.size)};",
            f"for ({self.index} i = 0; i < {padded}; i += {_ROWS}) {{",
            f"  for ({self.index} j = 0; j < {columns}; j++) {{",
        ]
        for r in range(len(rows)):
            total = f"{node.name}[{r * columns} + j]" if r else f"{node.name}[j]"
            terms = [f"x{n}[i + {r * padded + k}] * {table}[i + {k}][j]" for k in range(_ROWS)]
            lines.append(f"    {total} = {' + '.join([total, *terms])};")
        return [*lines, "  }", "}"]
