"""Printers of a graph as statements: the base of all languages but ONNX, and SIMD C."""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

import numpy as np
from jax.extend.core import ClosedJaxpr

from rps_jax.lowering.builder import INITIAL, GraphBuilder, SimdBuilder, results
from rps_jax.lowering.graph import (
    Array,
    Call,
    DynamicSlice,
    For,
    Gather,
    Input,
    LoopNode,
    LoopResult,
    Node,
    Reduce,
    Result,
    Typed,
    Value,
    While,
    first_array,
    is_unchanged,
    kind_of,
    live_nodes,
    nodes_of,
)
from rps_jax.lowering.operations import SIMD_HEADER, TYPES
from rps_jax.lowering.walk import Rows


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
        for group, stored, released in self.schedule(nodes, set(live_out), set(computed)):
            if self.is_fusible(group[0]):
                lines += self.fused(group, stored)
            else:
                for node in group:
                    lines += self.loop(node) if isinstance(node, LoopNode) else self.single(node)
            self.release(released)
        return lines

    def schedule(
        self, nodes: Iterable[Node], live_out: Collection[Node], computed: set[Node]
    ) -> Iterator[tuple[list[Node], set[Node], list[Node]]]:
        """Yield groups of nodes in an order in which few loops over elements are needed.

        A group is one loop over elements, a loop node, or single nodes. With it are those of its
        nodes that later groups read, and the nodes that no later group reads.

        Args:
          nodes: to be computed.
          live_out: nodes that are read after all groups.
          computed: nodes that are computed before.
        """
        waiting = {node: {*node.predecessors} - computed for node in nodes}
        order = list[list[Node]]()
        while waiting:
            order.append(self._next_group(waiting))
            for node in order[-1]:
                del waiting[node]
            for needed in waiting.values():
                needed.difference_update(order[-1])
        # Index of the last group that reads a node.
        last = {x: i for i, group in enumerate(order) for n in group for x in (n, *n.predecessors)}
        released: dict[int, list[Node]] = {}
        for node in itertools.chain(*order):
            if node not in live_out:
                released.setdefault(last[node], []).append(node)
        for i, group in enumerate(order):
            stored = {node for node in group if node in live_out or last[node] > i}
            yield group, stored, released.get(i, [])

    def _next_group(self, waiting: Mapping[Node, set[Node]]) -> list[Node]:
        """Return all single nodes that are ready, else one loop over elements, else a loop node.

        Args:
          waiting: nodes, each with those that must be computed before it.
        """
        for kind in ("single", "fused", "loop"):
            groups: dict[int, list[Node]] = {}
            ready = set[Node]()
            for node, needed in waiting.items():
                is_loop, is_fused = isinstance(node, LoopNode), self.is_fusible(node)
                node_kind = "loop" if is_loop else "fused" if is_fused else "single"
                if node_kind != kind or not needed <= ready:
                    continue
                if is_fused and needed & node.fusion_barriers:
                    continue
                if kind == "loop":
                    return [node]
                groups.setdefault(node.size if kind == "fused" else 0, []).append(node)
                ready.add(node)
            if groups:
                return groups[self.choose_size(groups)]
        raise AssertionError("nodes wait for one another")

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


HANDLER = "rps_native"  # placeholder of the name by which XLA calls the function
STORED = {"f": "float", "i": "int", "u": "unsigned", "b": "unsigned char"}  # of a number of a world
# Placeholders in capitals are lines that are printed for a function.
_FUNCTION = """\

{TABLES}
static void run_lanes(void **inputs, void **outputs, int64_t first, int64_t worlds, int step) {{
  int64_t at[LANES], row[LANES];
  for (int l = 0; l < LANES; l++) {{
    const int64_t index = first + l < worlds ? first + l : worlds - 1;
    at[l] = {WORLD};
    row[l] = at[l] * {LENGTH} + step;
  }}
{LINES}
}}

XLA_FFI_Error *{NAME}(XLA_FFI_CallFrame *frame) {{
  if (answers_version(frame)) return 0;
  void *inputs[{INPUTS}], *outputs[{OUTPUTS}];
  for (int i = 0; i < {INPUTS}; i++) inputs[i] = ((XLA_FFI_Buffer *)frame->args.args[i])->data;
  for (int i = 0; i < {OUTPUTS}; i++) outputs[i] = ((XLA_FFI_Buffer *)frame->rets.rets[i])->data;
  const int64_t worlds = count_worlds(frame->args.args[{SIZED}], {SIZE});
  for (int count = 0; count < {LENGTH}; count++) {{
    for (int64_t first = 0; first < worlds; first += LANES)
      run_lanes(inputs, outputs, first, worlds, {STEP});
    {NEXT}
  }}
  return 0;
}}
"""


class SimdWriter(Writer):
    """Printer of nodes as C with a vector lane for each world."""

    table_type = "static const"
    function, inputs = _FUNCTION, "inputs"
    builder: type[GraphBuilder] = SimdBuilder
    rows: Rows

    def constant(self, text: str, kind: str) -> str:
        return f"all_{kind}({text})"

    def table_declaration(self, name: str, array: np.ndarray) -> str:
        kind = kind_of(array.dtype)
        texts = self.array_literal(literal(x, kind) for x in array.reshape(-1))
        stored = "int" if kind == "b" else STORED[kind]
        return f"{self.table_type} {stored} {name}[{array.size}] = {texts};"

    def single(self, node: Node) -> list[str]:
        offset = f"* {node.size} + i]"
        if isinstance(node.op, Input):
            index = node.op.index
            world = "row" if index in self.rows.scanned else "at"
            text = f"((const {STORED[node.kind]} *)inputs[{index}])[{world}[l] {offset}"
            text = f"-(int){text}" if node.kind == "b" else text
        elif isinstance(node.op, DynamicSlice):
            index, source = node.operands
            row, table = self.read(index, 1), self.table(np.array(node.op.windows))
            text = f"{source.node.name}[{table}[{row}[l] {offset}][l]"
        else:
            return super().single(node)
        line = f"  for (int l = 0; l < LANES; l++) {self.element(node)}[l] = {text};"
        return [self.declare(node), *self.elements(node.size, [line])]

    def end(self, result: Result) -> list[str]:
        """Return the statements that store a result."""
        position, a, size, kind = result
        stored, truth = STORED[kind], " != 0" * (kind == "b")
        world = "row" if position in self.rows.stacked else "at"
        lines = [
            f"  {self.declaration(kind, 'e')} = {self.read(a, size)};",
            "  for (int l = 0; l < LANES && first + l < worlds; l++)",
            f"    (({stored} *)outputs[{position}])[{world}[l] * {size} + i] = e[l]{truth};",
        ]
        return self.elements(size, lines)

    def source(
        self,
        closed: ClosedJaxpr,
        shapes: Sequence[Typed],
        outs: Sequence[Typed],
        sorted_worlds: bool = False,
    ) -> str:
        """Return the function of a closed jaxpr that runs all worlds: `HANDLER`, or `step` of CUDA.

        Args:
          closed: the function of one world.
          shapes: types of its arguments.
          outs: types of its results.
          sorted_worlds: whether one more argument has the order of the worlds.

        Raises:
          UnsupportedError: it has an operation that is not in the headers.
          TooLargeError: a kernel needs too much shared memory.
        """
        self.rows = rows = Rows.from_jaxpr(closed)
        returned, roots = results(rows, shapes, outs, self.builder())
        nodes, (sized, size) = live_nodes(roots), first_array(shapes)
        self.assign_storage(nodes, returned)
        lines = self.lines(nodes, roots)
        for result in returned:
            lines += self.end(result)
        order = f"((const int *){self.inputs}[{len(shapes)}])[index]"
        return self.preamble() + self.function.format(
            TABLES="\n".join(self.tables.values()),
            LINES="\n".join(f"  {line}" for line in lines),
            WORLD=order if sorted_worlds else "index",
            INPUTS=len(shapes) + sorted_worlds,
            OUTPUTS=len(outs),
            NAME=HANDLER,
            SIZED=sized,
            SIZE=size,
            LENGTH=rows.length,
            STEP=f"{rows.length - 1} - count" if rows.reverse else "count",
            NEXT=" ".join(f"inputs[{x}] = outputs[{i}];" for i, x in enumerate(rows.carried)),
        )

    def assign_storage(self, nodes: Iterable[Node], returned: Iterable[Result]) -> None:
        """Choose where arrays are stored."""

    def preamble(self) -> str:
        """Return the text before the function, after its statements are printed."""
        return SIMD_HEADER
