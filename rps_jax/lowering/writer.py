"""Printer of a graph as statements, the base of the printers of all languages but ONNX."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection, Iterable, Sequence

import numpy as np

from rps_jax.lowering.builder import INITIAL
from rps_jax.lowering.graph import (
    Array,
    Call,
    For,
    Gather,
    LoopNode,
    LoopResult,
    Node,
    Reduce,
    While,
    is_unchanged,
    live_nodes,
    nodes_of,
)
from rps_jax.lowering.operations import TYPES
from rps_jax.lowering.passes import schedule
from rps_jax.lowering.target import Value, kind_of


class Writer:
    """Printer of nodes; subclasses define a language."""

    index = "int"  # type of a loop's index
    leave = "if (!any(goes)) break;"  # of a loop, when no lane continues
    prefix = ""  # of all names

    def __init__(self) -> None:
        self.tables: dict[str, str] = {}  # declarations of constants before the function, by name

    # --- what a language defines ---

    def type_of(self, kind: str) -> str:
        """Return the type of a variable."""
        return TYPES[kind]

    def declaration(self, kind: str, name: str, size: int = 1, constant: bool = True) -> str:
        """Return the left side of a declaration."""
        return f"{'const ' * constant}{self.type_of(kind)} {name}{'' if size == 1 else f'[{size}]'}"

    def declare(self, node: Node) -> str:
        """Return the declaration of a node that is assigned later."""
        return f"{self.declaration(node.kind, node.name, node.size, constant=False)};"

    def literal(self, value: float, kind: str) -> str:
        """Return a constant."""
        return literal(value, kind)

    def constant(self, text: str, kind: str) -> str:
        """Return a constant, or an element of a table, as an operand."""
        raise NotImplementedError

    def table_declaration(self, name: str, array: np.ndarray) -> str:
        """Return the declaration of a table of constants."""
        raise NotImplementedError

    def table(self, array: np.ndarray) -> str:
        """Return the name of a table of constants."""
        digest = hashlib.sha256(array.dtype.str.encode() + array.tobytes()).hexdigest()[:8]
        name = f"{self.prefix}_w_{digest}"
        if name not in self.tables:
            self.tables[name] = self.table_declaration(name, array)
        return name

    def array_literal(self, texts: Iterable[str]) -> str:
        """Return an array of these elements."""
        return "{" + ", ".join(texts) + "}"

    def call(self, function: str, operands: Sequence[str]) -> str:
        """Return the expression of an operation."""
        return f"{function}({', '.join(operands)})"

    # --- order ---

    def lines(
        self, nodes: Iterable[Node], live_out: Collection[Node], computed: Iterable[Node] = ()
    ) -> list[str]:
        """Return the statements of nodes; `live_out` are read by later statements."""
        lines = list[str]()
        for group in schedule(nodes, set(live_out), computed, self.is_fusible, self.choose_size):
            if self.is_fusible(group.nodes[0]):
                lines += self.fused(group.nodes, group.stored)
            else:
                for node in group.nodes:
                    lines += self.loop(node) if isinstance(node, LoopNode) else self.single(node)
            self.release(group.released)
        return lines

    def is_fusible(self, node: Node) -> bool:
        """Whether a node is printed in a loop over elements."""
        return node.is_fusible

    def choose_size(self, sizes: Collection[int]) -> int:
        """Return the size of the first of several loops over elements."""
        return next(iter(sizes))

    def release(self, nodes: Iterable[Node]) -> None:
        """Free the storage of nodes that no later statement reads."""

    def statement(self, lines: Sequence[str], written: Iterable[Node] = ()) -> list[str]:
        """Return statements that write nodes, after those that their operands need."""
        return list(lines)

    # --- statements ---

    def single(self, node: Node) -> list[str]:
        """Return the statements of a node that is not computed in a loop over its elements."""
        if isinstance(node.op, LoopResult):
            return []
        if isinstance(node.op, Gather) and node.size > 1:
            return [self.array(node, [self.operand(a, 0) for a in node.operands])]
        return self.statement([self.array(node, [self.element_text(node, set())[1]])])

    def array(self, node: Node, elements: Sequence[str]) -> str:
        """Return the declaration of a node with its elements."""
        text = elements[0] if node.size == 1 else self.array_literal(elements)
        return f"{self.declaration(node.kind, node.name, node.size)} = {text};"

    def fused(self, group: Sequence[Node], stored: set[Node]) -> list[str]:
        """Return one loop over the elements of nodes."""
        head, lines, fused = [], [], set(group)
        for node in group:
            statements, text = self.element_text(node, fused)
            lines += statements
            if isinstance(node.op, Reduce):
                lines += self.reduce(node, node.op.binary, text)
                declared = self.declaration(node.kind, node.name, constant=False)
                head.append(f"{declared} = {self.initial(node)};")
                continue
            lines.append(f"  {self.declaration(node.kind, f'e{node.id}')} = {text};")
            if node in stored:
                head.append(self.declare(node))
                lines.append(f"  {self.element(node)} = e{node.id};")
        return self.statement([*head, *self.elements(group[0].size, lines)], stored)

    def elements(self, size: int, lines: Sequence[str]) -> list[str]:
        """Return a loop over elements `i`."""
        return [f"for ({self.index} i = 0; i < {size}; i++) {{", *lines, "}"]

    def initial(self, node: Node) -> str:
        """Return the initial value of a reduction."""
        assert isinstance(node.op, Reduce)
        return self.operand(np.asarray(INITIAL[node.op.binary, node.kind]), 0)

    def reduce(self, node: Node, binary: str, text: str) -> list[str]:
        """Return the statements that add the element `i` to a reduction."""
        return [f"  {node.name} = {self.call(f'{binary}_{node.kind}', [node.name, text])};"]

    def loop(self, loop: LoopNode) -> list[str]:
        """Return the statements of a loop, or of a block that runs under a condition."""
        lines, body = [], []
        for node, start in zip(loop.carried, loop.operands, strict=True):
            if node.size:
                lines += self.assign(node, start, declare=True)
        results, rest = nodes_of((*loop.results, loop.condition)), list(loop.body)
        computed = {*loop.captured, *loop.carried, *(n for n in results if n not in loop.body)}
        is_masked = isinstance(loop.op, While)
        if is_masked:
            condition = [n for n in live_nodes([loop.condition.node]) if n in loop.body]
            body += self.lines(condition, loop.body, computed)
            holds = f"{self.declaration('b', 'goes')} = {self.read(loop.condition, 1)};"
            body += self.statement([holds, self.leave])
            computed |= set(condition)
            rest = [n for n in loop.body if n not in set(condition)]
        body += self.lines(rest, results, computed)
        for node, result in zip(loop.carried, loop.results, strict=True):
            if node.size and not is_unchanged(node, result):
                body += self.assign(node, result, masked=is_masked)
        return [*lines, self.loop_head(loop), *(f"  {line}" for line in body), "}"]

    def loop_head(self, loop: LoopNode) -> str:
        """Return the first line of a loop node."""
        if isinstance(loop.op, For):
            return f"for ({self.index} turn = 0; turn < {loop.op.length}; turn++) {{"
        return "for (;;) {"

    def assign(
        self, node: Node, value: Value, declare: bool = False, masked: bool = False
    ) -> list[str]:
        """Return the assignment of a carried node, if masked only in the lanes that continue."""
        text = self.read(value, node.size)
        if masked:
            text = self.call(f"choose_{node.kind}", ["goes", text, self.element(node)])
        line = f"{self.element(node)} = {text};"
        lines = [line] if node.size == 1 else self.elements(node.size, [f"  {line}"])
        return self.statement([*([self.declare(node)] if declare else []), *lines], [node])

    # --- expressions ---

    def item(self, node: Node, index: int | str) -> str:
        """Return an element of a node."""
        return node.name if node.width == 1 else f"{node.name}[{index}]"

    def element(self, node: Node) -> str:
        """Return the element of a node that a loop over elements stores."""
        return self.item(node, "i")

    def operand(self, a: Value, index: int | str) -> str:
        """Return an element of an operand, at a constant index or at the index `i` of a loop."""
        if isinstance(a, Array):
            if not a.step:
                return self.item(a.node, a.first)
            if isinstance(index, int):
                return self.item(a.node, a.first + index)
            return self.item(a.node, f"i + {a.first}" if a.first else "i")
        array = np.asarray(a).reshape(-1)
        kind, index = kind_of(array.dtype), index if array.size > 1 else 0
        is_literal = isinstance(index, int)
        text = self.literal(array[index], kind) if is_literal else f"{self.table(array)}[i]"
        return self.constant(text, kind)

    def read(self, a: Value, size: int, fused: Collection[Node] = ()) -> str:
        """Return a value, or its element `i`; nodes in `fused` are computed in the same loop."""
        if isinstance(a, Array) and a.node in fused and a.covers(size):
            return f"e{a.node.id}"
        return self.operand(a, 0 if size == 1 else "i")

    def element_text(self, node: Node, fused: set[Node]) -> tuple[list[str], str]:
        """Return statements, and the expression of element `i` of a node."""
        operands = [self.read(a, node.size, fused) for a in node.operands]
        is_call = isinstance(node.op, Call)
        return [], self.call(node.op.function, operands) if is_call else operands[0]


def literal(value: float, kind: str, suffix: str = "f") -> str:
    """Return a number in C."""
    if kind == "f":
        real = float(value)
        if math.isnan(real):
            return "NAN"
        finite = math.isfinite(real)
        return f"{real!r}{suffix}" if finite else repr(real).replace("inf", "INFINITY")
    integer = int(value)
    if kind == "b":
        return str(-integer)
    if kind == "u":
        return f"{integer}u"
    return str(integer) if integer > -(2**31) else "-2147483647 - 1"
