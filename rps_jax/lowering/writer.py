"""Printer of a graph of arrays as C, and the SIMD function that XLA calls with a batch of worlds.

`Writer` orders the nodes so that few loops are needed, and prints each as a statement. `SimdWriter`
prints vectors with a lane for each world; `gpu_writer` and `scalar_writer` have the other printers.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Collection, Iterable, Sequence

import numpy as np
from jax.extend.core import ClosedJaxpr

from rps_jax.lowering.nodes import (
    INITIAL,
    Array,
    LoopNode,
    Node,
    Result,
    SimdNodes,
    reached,
    results,
)
from rps_jax.lowering.operations import SIMD_HEADER, TYPES
from rps_jax.lowering.target import Typed, Value, first_array, kind_of

HANDLER = "rps_native"  # placeholder of the name by which XLA calls the function
STORED = {"f": "float", "i": "int", "u": "unsigned", "b": "unsigned char"}  # of a number of a world
# Placeholders in capitals are lines that are printed for a function.
_FUNCTION = """\

{TABLES}
static void run_lanes(void **inputs, void **outputs, int64_t first, int64_t worlds) {{
  int64_t at[LANES];
  for (int l = 0; l < LANES; l++) {{
    const int64_t index = first + l < worlds ? first + l : worlds - 1;
    at[l] = {WORLD};
  }}
{LINES}
}}

XLA_FFI_Error *{NAME}(XLA_FFI_CallFrame *frame) {{
  if (answers_version(frame)) return 0;
  void *inputs[{INPUTS}], *outputs[{OUTPUTS}];
  for (int i = 0; i < {INPUTS}; i++) inputs[i] = ((XLA_FFI_Buffer *)frame->args.args[i])->data;
  for (int i = 0; i < {OUTPUTS}; i++) outputs[i] = ((XLA_FFI_Buffer *)frame->rets.rets[i])->data;
  const int64_t worlds = count_worlds(frame->args.args[{SIZED}], {SIZE});
  for (int64_t first = 0; first < worlds; first += LANES) run_lanes(inputs, outputs, first, worlds);
  return 0;
}}
"""


class Writer:
    """Printer of nodes as statements, in an order in which few loops are needed."""

    index = "int"  # type of a loop's index
    leave = "if (!any(goes)) break;"  # of a loop, when no lane goes on
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

    def declared(self, node: Node) -> str:
        """Return the declaration of a node that is assigned later."""
        return f"{self.declaration(node.kind, node.name, node.size, constant=False)};"

    def literal(self, value: float, kind: str) -> str:
        """Return a constant."""
        return literal(value, kind)

    def constant(self, text: str, kind: str) -> str:
        """Return a constant, or an element of a table, as an operand."""
        raise NotImplementedError

    def packed(self, name: str, array: np.ndarray) -> str:
        """Return the declaration of a table of constants."""
        raise NotImplementedError

    def table(self, array: np.ndarray) -> str:
        """Return the name of a table of constants."""
        digest = hashlib.sha256(array.dtype.str.encode() + array.tobytes()).hexdigest()[:8]
        name = f"{self.prefix}_w_{digest}"
        if name not in self.tables:
            self.tables[name] = self.packed(name, array)
        return name

    def listed(self, texts: Iterable[str]) -> str:
        """Return an array of these elements."""
        return "{" + ", ".join(texts) + "}"

    def call(self, op: str, operands: Sequence[str]) -> str:
        """Return the expression of an operation."""
        return f"{op}({', '.join(operands)})"

    # --- order ---

    def lines(
        self, nodes: Iterable[Node], used_after: Iterable[Node], computed: set[Node]
    ) -> list[str]:
        """Return the statements of nodes; `used_after` are read by later statements."""
        waiting, computed, groups = list(nodes), set(computed), []
        used_after, lines = set(used_after), list[str]()
        while waiting:
            groups.append(self._next(waiting, computed))
            computed |= set(groups[-1])
            waiting = [node for node in waiting if node not in computed]
        # The last group that reads a node.
        last = {x: i for i, group in enumerate(groups) for n in group for x in (n, *n.needed)}
        unused: dict[int, list[Node]] = {}
        for node in itertools.chain(*groups):
            if node not in used_after:
                unused.setdefault(last[node], []).append(node)
        for i, group in enumerate(groups):
            if self.is_single(group[0]):
                for node in group:
                    lines += self.loop(node) if isinstance(node, LoopNode) else self.single(node)
            else:
                stored = used_after.union(*(node.whole for node in group))
                lines += self.together(group, {n for n in group if n in stored or last[n] > i})
            self.release(unused.get(i, ()))
        return lines

    def is_single(self, node: Node) -> bool:
        """Whether a node is printed outside of the loops over elements."""
        return node.is_single

    def first_size(self, sizes: Collection[int]) -> int:
        """Return the size of the first of several loops over elements."""
        return next(iter(sizes))

    def release(self, nodes: Iterable[Node]) -> None:
        """Note that no later statement reads these nodes."""

    def statement(self, lines: Sequence[str], written: Iterable[Node] = ()) -> list[str]:
        """Return statements that write nodes, after those that their operands need."""
        return list(lines)

    def _next(self, waiting: Sequence[Node], computed: set[Node]) -> list[Node]:
        """Return the next nodes: all single ones, else one loop over elements, else a loop node."""
        for kind in ("single", "together", "loop"):
            groups: dict[int, list[Node]] = {}
            ready = set(computed)
            for node in waiting:
                group = "single" if self.is_single(node) else "together"
                group = "loop" if isinstance(node, LoopNode) else group
                whole = computed if group == "together" else ready
                if group == kind and node.whole <= whole and set(node.needed) <= ready:
                    if kind == "loop":
                        return [node]
                    groups.setdefault(node.size if kind == "together" else 0, []).append(node)
                    ready.add(node)
            if groups:
                return groups[self.first_size(groups)]
        raise AssertionError("nodes wait for one another")

    # --- statements ---

    def single(self, node: Node) -> list[str]:
        """Return the statements of a node that is not computed in a loop over its elements."""
        if node.op == "part":  # a name of a carried node
            return []
        if node.op == "move" and node.size > 1:
            return [self.array(node, [self.operand(a, 0) for a in node.args])]
        return self.statement([self.array(node, [self.element_text(node, set())[1]])])

    def array(self, node: Node, elements: Sequence[str]) -> str:
        """Return the declaration of a node with its elements."""
        text = elements[0] if node.size == 1 else self.listed(elements)
        return f"{self.declaration(node.kind, node.name, node.size)} = {text};"

    def together(self, group: Sequence[Node], stored: set[Node]) -> list[str]:
        """Return one loop over the elements of nodes."""
        head, lines, fused = [], [], set(group)
        for node in group:
            needed, text = self.element_text(node, fused)
            lines += needed
            if node.op.startswith("fold"):
                lines += self.fold(node, text)
                declared = self.declaration(node.kind, node.name, constant=False)
                head.append(f"{declared} = {self.initial(node)};")
                continue
            lines.append(f"  {self.declaration(node.kind, f'e{node.id}')} = {text};")
            if node in stored:
                head.append(self.declared(node))
                lines.append(f"  {self.element(node)} = e{node.id};")
        return self.statement([*head, *self.elements(group[0].size, lines)], stored)

    def elements(self, size: int, lines: Sequence[str]) -> list[str]:
        """Return a loop over elements `i`."""
        return [f"for ({self.index} i = 0; i < {size}; i++) {{", *lines, "}"]

    def initial(self, node: Node) -> str:
        """Return the initial value of a reduction."""
        return self.operand(np.asarray(INITIAL[node.op[5:-2], node.kind]), 0)

    def fold(self, node: Node, text: str) -> list[str]:
        """Return the statements that add the element `i` to a reduction."""
        return [f"  {node.name} = {self.call(node.op[5:], [node.name, text])};"]

    def loop(self, loop: LoopNode) -> list[str]:
        """Return the statements of a loop, or of a block that runs under a condition."""
        lines, body = [], []
        for node, start in zip(loop.carried, loop.args, strict=True):
            if node.size:
                lines += self.assign(node, start, declare=True)
        results = [a.node for a in (*loop.results, loop.condition) if isinstance(a, Array)]
        computed = {*loop.free, *loop.carried, *(n for n in results if n not in loop.inner)}
        rest = list(loop.inner)
        if loop.op == "while":
            condition = [n for n in reached([loop.condition.node]) if n in loop.inner]
            body += self.lines(condition, loop.inner, computed)
            holds = f"{self.declaration('b', 'goes')} = {self.value(loop.condition, 'b', 1)};"
            body += self.statement([holds, self.leave])
            computed |= set(condition)
            rest = [n for n in loop.inner if n not in set(condition)]
        body += self.lines(rest, results, computed)
        for node, result in zip(loop.carried, loop.results, strict=True):
            if node.size and not (isinstance(result, Array) and result.node is node):
                body += self.assign(node, result, masked=loop.op == "while")
        return [*lines, self.head(loop), *(f"  {line}" for line in body), "}"]

    def head(self, loop: LoopNode) -> str:
        """Return the first line of a loop node."""
        if not loop.length:
            return "for (;;) {"
        return f"for ({self.index} turn = 0; turn < {loop.length}; turn++) {{"

    def assign(
        self, node: Node, value: Value, declare: bool = False, masked: bool = False
    ) -> list[str]:
        """Return the statements that assign a carried node, in the lanes that go on if masked."""
        text = self.value(value, node.kind, node.size)
        if masked:
            text = self.call(f"choose_{node.kind}", ["goes", text, self.element(node)])
        line = f"{self.element(node)} = {text};"
        lines = [line] if node.size == 1 else self.elements(node.size, [f"  {line}"])
        return self.statement([*([self.declared(node)] if declare else []), *lines], [node])

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
        kind, at = kind_of(array.dtype), index if array.size > 1 else 0
        text = self.literal(array[at], kind) if isinstance(at, int) else f"{self.table(array)}[i]"
        return self.constant(text, kind)

    def read(self, a: Value, node: Node, fused: set[Node]) -> str:
        """Return an operand of a node; nodes in `fused` are computed in the same loop."""
        if isinstance(a, Array) and a.node in fused and node.is_in_step(a):
            return f"e{a.node.id}"
        return self.operand(a, 0 if node.size == 1 or node.op in ("move", "take") else "i")

    def value(self, a: Value, kind: str, size: int) -> str:
        """Return a value, or its element `i`, where it is assigned."""
        return self.read(a, Node(0, "set", (a,), kind, size), set())

    def element_text(self, node: Node, fused: set[Node]) -> tuple[list[str], str]:
        """Return statements, and the expression of element `i` of a node."""
        operands = [self.read(a, node, fused) for a in node.args]
        is_copy = node.op == "move" or node.op.startswith("fold")
        return [], operands[0] if is_copy else self.call(node.op, operands)


class SimdWriter(Writer):
    """Printer of nodes as C with a vector lane for each world."""

    table_type = "static const"
    header, function, inputs = SIMD_HEADER, _FUNCTION, "inputs"
    nodes = SimdNodes

    def constant(self, text: str, kind: str) -> str:
        return f"all_{kind}({text})"

    def packed(self, name: str, array: np.ndarray) -> str:
        kind = kind_of(array.dtype)
        texts = self.listed(literal(x, kind) for x in array.reshape(-1))
        stored = "int" if kind == "b" else STORED[kind]
        return f"{self.table_type} {stored} {name}[{array.size}] = {texts};"

    def single(self, node: Node) -> list[str]:
        at = f"* {node.size} + i]"
        if node.op == "input":
            text = f"((const {STORED[node.kind]} *)inputs[{node.extra}])[at[l] {at}"
            text = f"-(int){text}" if node.kind == "b" else text
        elif node.op == "take":
            index, source = node.args
            row, table = self.value(index, "i", 1), self.table(np.array(node.extra))
            text = f"{source.node.name}[{table}[{row}[l] {at}][l]"
        else:
            return super().single(node)
        line = f"  for (int l = 0; l < LANES; l++) {self.element(node)}[l] = {text};"
        return [self.declared(node), *self.elements(node.size, [line])]

    def end(self, result: Result) -> list[str]:
        """Return the statements that store a result."""
        position, a, size, kind = result
        stored, truth = STORED[kind], " != 0" * (kind == "b")
        return self.elements(size, [
            f"  {self.declaration(kind, 'e')} = {self.value(a, kind, size)};",
            "  for (int l = 0; l < LANES && first + l < worlds; l++)",
            f"    (({stored} *)outputs[{position}])[at[l] * {size} + i] = e[l]{truth};",
        ])  # fmt: skip

    def source(
        self, closed: ClosedJaxpr, shapes: Sequence[Typed], outs: Sequence[Typed],
        sorted_worlds: bool = False,
    ) -> str:  # fmt: skip
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
        returned, roots = results(closed, shapes, outs, self.nodes())
        nodes, (sized, size) = reached(roots), first_array(shapes)
        self.prepare(nodes, returned)
        lines = self.lines(nodes, roots, set())
        for result in returned:
            lines += self.end(result)
        order = f"((const int *){self.inputs}[{len(shapes)}])[index]"
        return self.header + self.function.format(
            TABLES="\n".join(self.tables.values()),
            LINES="\n".join(f"  {line}" for line in lines),
            WORLD=order if sorted_worlds else "index",
            INPUTS=len(shapes) + sorted_worlds,
            **{"OUTPUTS": len(outs), "NAME": HANDLER, "SIZED": sized, "SIZE": size},
        )

    def prepare(self, nodes: Iterable[Node], returned: Iterable[Result]) -> None:
        """Choose where arrays are stored."""


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
