"""Printer of a graph of arrays as scalar code, the base of the printers of C and JavaScript."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from rps_jax.lowering import verifier
from rps_jax.lowering.builder import results
from rps_jax.lowering.graph import (
    Call,
    DynamicSlice,
    If,
    Input,
    LoopNode,
    MatrixProduct,
    Node,
    Reduce,
)
from rps_jax.lowering.passes import sink_products
from rps_jax.lowering.routine import Routine
from rps_jax.lowering.scalar_builder import ScalarBuilder
from rps_jax.lowering.writer import Writer

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
        values, roots = results(
            routine.jaxpr, [x.type for _, x in fields], [x.type for _, x in outputs], target
        )
        nodes = sink_products(roots)
        verifier.check(values)
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
