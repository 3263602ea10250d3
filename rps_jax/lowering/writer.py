"""Printer of a graph of arrays as C, and the SIMD function that XLA calls with a batch of worlds.

`Writer` orders the nodes so that few loops are needed, and prints each as a statement. `SimdWriter`
prints vectors with a lane for each world; `gpu_writer` and `scalar_writer` have the other printers.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence

import numpy as np
from jax.extend.core import ClosedJaxpr

from rps_jax.lowering.nodes import (
    INITIAL,
    Array,
    LoopNode,
    Node,
    SimdNodes,
    reached,
    results,
)
from rps_jax.lowering.operations import SIMD_HEADER, TYPES
from rps_jax.lowering.target import Typed, Value, kind_of, size_of

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

    def __init__(self) -> None:
        self.tables: dict[str, str] = {}  # declarations of constants before the function

    # --- what a language defines ---

    def declaration(self, kind: str, name: str, size: int = 1, constant: bool = True) -> str:
        """Return the left side of a declaration."""
        raise NotImplementedError

    def empty(self, kind: str, name: str, size: int) -> str:
        """Return the declaration of an array without values."""
        return f"{self.declaration(kind, name, size, constant=False)};"

    def constant(self, value: Value) -> str:
        """Return a constant, or element `i` of a table of constants."""
        raise NotImplementedError

    def initial(self, node: Node) -> str:
        """Return the initial value of a reduction."""
        return self.constant(np.asarray(INITIAL[node.op[5:-2], node.kind]))

    def call(self, op: str, operands: Sequence[str]) -> str:
        """Return the expression of an operation."""
        return f"{op}({', '.join(operands)})"

    def single(self, node: Node) -> list[str]:
        """Return the statements of a node that is not computed in a loop over its elements."""
        raise NotImplementedError

    # --- order ---

    def lines(
        self, nodes: Iterable[Node], used_after: Iterable[Node], computed: set[Node]
    ) -> list[str]:
        """Return the statements of nodes; `used_after` are read by later statements."""
        waiting, computed, groups = list(nodes), set(computed), []
        while waiting:
            group = self._next(waiting, computed)
            computed |= set(group)
            waiting = [node for node in waiting if node not in computed]
            groups.append(group)
        lines, used_after = [], set(used_after)
        users: dict[Node, set[int]] = {}
        for i, group in enumerate(groups):
            for node in group:
                for operand in node.needed:
                    users.setdefault(operand, set()).add(i)
        last: dict[int, list[Node]] = {}
        for i, group in enumerate(groups):
            for node in group:
                if node not in used_after:
                    last.setdefault(max(users.get(node, {i})), []).append(node)
        for i, group in enumerate(groups):
            if self.is_single(group[0]):
                for node in group:
                    lines += self.loop(node) if isinstance(node, LoopNode) else self.single(node)
            else:
                whole = set().union(*(node.whole for node in group))
                stored = {
                    node
                    for node in group
                    if node in used_after or node in whole or users.get(node, set()) - {i}
                }
                lines += self.together(group, stored)
            self.release(last.get(i, ()))
        return lines

    def is_single(self, node: Node) -> bool:
        """Whether a node is printed outside of the loops over elements."""
        return node.is_single

    def first_size(self, sizes: Collection[int]) -> int:
        """Return the size of the first of several loops over elements."""
        return next(iter(sizes))

    def release(self, nodes: Iterable[Node]) -> None:
        """Note that no later statement reads these nodes."""

    def statement(self, lines: Sequence[str]) -> list[str]:
        """Return statements, after those that their operands need."""
        return list(lines)

    def _next(self, waiting: Sequence[Node], computed: set[Node]) -> list[Node]:
        """Return the next nodes: all single ones, else one loop over elements, else a loop node."""
        for kind in ("single", "together", "loop"):
            groups: dict[int, list[Node]] = {}
            ready = set(computed)
            for node in waiting:
                group = "single" if self.is_single(node) else "together"
                group = "loop" if isinstance(node, LoopNode) else group
                if group != kind:
                    continue
                whole = computed if group == "together" else ready
                if node.whole <= whole and set(node.needed) <= ready:
                    groups.setdefault(node.size if group == "together" else 0, []).append(node)
                    ready.add(node)
                    if group == "loop":
                        break
            if groups:
                return groups[self.first_size(groups)]
        raise AssertionError("nodes wait for one another")

    # --- statements ---

    def together(self, group: Sequence[Node], stored: set[Node]) -> list[str]:
        """Return one loop over the elements of nodes."""
        head, lines, fused = [], [], set(group)
        for node in group:
            text = self._expression(node, fused)
            if node.op.startswith("fold"):
                declared = self.declaration(node.kind, node.name, constant=False)
                head.append(f"{declared} = {self.initial(node)};")
                lines.append(f"  {node.name} = {self.call(node.op[5:], [node.name, text])};")
                continue
            lines.append(f"  {self.declaration(node.kind, f'e{node.id}')} = {text};")
            if node in stored:
                head.append(self.empty(node.kind, node.name, node.size))
                lines.append(f"  {node.name}[i] = e{node.id};")
        return [*head, self.loop_head(group[0].size), *lines, "}"]

    def loop_head(self, size: int) -> str:
        """Return the first line of a loop over elements."""
        return f"for ({self.index} i = 0; i < {size}; i++) {{"

    def loop(self, loop: LoopNode) -> list[str]:
        """Return the statements of a loop, or of a block that runs under a condition."""
        lines, body = [], []
        for node, start in zip(loop.carried, loop.args, strict=True):
            if node.size:
                lines += self.assign(node, start, declare=True)
        results = [a.node for a in (*loop.results, loop.condition) if isinstance(a, Array)]
        computed = {*loop.free, *loop.carried, *(n for n in results if n not in loop.inner)}
        if loop.op == "while":
            condition = [n for n in reached([loop.condition.node]) if n in loop.inner]
            body += self.lines(condition, loop.inner, computed)
            body += self.leave(loop)
            computed |= set(condition)
            rest = [n for n in loop.inner if n not in set(condition)]
        else:
            rest = list(loop.inner)
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

    def leave(self, loop: LoopNode) -> list[str]:
        """Return the statements that leave a `while` loop."""
        raise NotImplementedError

    def assign(
        self, node: Node, value: Value, declare: bool = False, masked: bool = False
    ) -> list[str]:
        """Return the statements that assign a carried node, in the lanes that go on if masked."""
        text = self.read(value, Node(0, "set", (value,), node.kind, node.size), set())
        at = "" if node.size == 1 else "[i]"
        text = f"choose_{node.kind}(goes, {text}, {node.name}{at})" if masked else text
        if node.size == 1:
            declared = self.declaration(node.kind, node.name, constant=False)
            return [f"{declared if declare else node.name} = {text};"]
        head = [self.empty(node.kind, node.name, node.size)] if declare else []
        return [*head, f"{self.loop_head(node.size)[:-2]} {node.name}[i] = {text};"]

    # --- expressions ---

    def item(self, node: Node, index: int | str) -> str:
        """Return an element of a node."""
        return node.name if node.width == 1 else f"{node.name}[{index}]"

    def read(self, a: Value, node: Node, fused: set[Node]) -> str:
        """Return an operand of a node; nodes in `fused` are computed in the same loop."""
        if not isinstance(a, Array):
            return self.constant(a)
        if a.node.width == 1:
            return self.item(a.node, 0)
        if a.node in fused and node.is_in_step(a):
            return f"e{a.node.id}"
        if not a.step or node.size == 1 or node.op in ("move", "take"):
            return self.item(a.node, a.first)
        return self.item(a.node, f"i + {a.first}" if a.first else "i")

    def _expression(self, node: Node, fused: set[Node]) -> str:
        operands = [self.read(a, node, fused) for a in node.args]
        return operands[0] if node.op.startswith("fold") else self.call(node.op, operands)


class SimdWriter(Writer):
    """Printer of nodes as C with a vector lane for each world."""

    table_type = "static const"

    def declaration(self, kind: str, name: str, size: int = 1, constant: bool = True) -> str:
        return f"{'const ' * constant}{TYPES[kind]} {name}{'' if size == 1 else f'[{size}]'}"

    def constant(self, value: Value) -> str:
        array = np.asarray(value).reshape(-1)
        kind = kind_of(array.dtype)
        if array.size == 1:
            return f"all_{kind}({literal(array[0], kind)})"
        return f"all_{kind}({self.table(array)}[i])"

    def table(self, array: np.ndarray) -> str:
        """Return the name of a table of constants."""
        key = f"{array.dtype.str}{array.tobytes()}"
        kind = kind_of(array.dtype)
        if key not in self.tables:
            texts = ", ".join(literal(x, kind) for x in array.reshape(-1))
            stored = "int" if kind == "b" else STORED[kind]
            name = f"t{len(self.tables)}"
            self.tables[key] = f"{self.table_type} {stored} {name}[{array.size}] = {{{texts}}};"
        return self.tables[key].split("[")[0].split()[-1]

    def leave(self, loop: LoopNode) -> list[str]:
        holds = self.read(loop.condition, Node(0, "goes", (), "b", 1), set())
        return self.statement([f"const I goes = {holds};", "if (!any(goes)) break;"])

    def single(self, node: Node) -> list[str]:
        kind, name, size = TYPES[node.kind], node.name, node.size
        if node.op == "part":
            if size == 1:
                return [f"const {kind} {name} = {node.extra.name};"]
            return [f"const {kind} *const {name} = {node.extra.name};"]
        declared = self.declaration(node.kind, name, size, constant=False)
        at = "" if size == 1 else "[i]"
        if node.op == "input":
            stored = f"((const {STORED[node.kind]} *)inputs[{node.extra}])[at[l] * {size} + i]"
            stored = f"-(int){stored}" if node.kind == "b" else stored
            return [
                f"{declared};",
                f"for (int i = 0; i < {size}; i++)",
                f"  for (int l = 0; l < LANES; l++) {name}{at}[l] = {stored};",
            ]
        if node.op == "take":
            index, source = node.args
            row, table = self.read(index, node, set()), self.table(np.array(node.extra))
            return [
                f"{declared};",
                f"for (int i = 0; i < {size}; i++)",
                "  for (int l = 0; l < LANES; l++)",
                f"    {name}{at}[l] = {source.node.name}[{table}[{row}[l] * {size} + i]][l];",
            ]
        if node.op == "move":
            reads = [self.read(a, node, set()) for a in node.args]
            if size == 1:
                return [f"const {declared} = {reads[0]};"]
            return [f"{declared};", *(f"{name}[{i}] = {x};" for i, x in enumerate(reads))]
        return [f"const {declared} = {self._expression(node, set())};"]


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


def source(
    closed: ClosedJaxpr, shapes: Sequence[Typed], outs: Sequence[Typed], sorted_worlds: bool = False
) -> str:
    """Return the C of a closed jaxpr: the function `HANDLER` that XLA calls.

    Args:
      closed: the function of one world.
      shapes: types of its arguments.
      outs: types of its results.
      sorted_worlds: whether one more argument has the order of the worlds.

    Raises:
      UnsupportedError: it has an operation that is not in the headers.
    """
    (returned, roots), writer = results(closed, shapes, outs, SimdNodes()), SimdWriter()
    lines = writer.lines(reached(roots), roots, set())
    for index, a, size, kind in returned:
        text = writer.read(a, Node(0, "end", (a,), kind, size), set())
        stored, truth = STORED[kind], " != 0" * (kind == "b")
        lines += [
            f"for (int i = 0; i < {size}; i++) {{",
            f"  const {TYPES[kind]} e = {text};",
            "  for (int l = 0; l < LANES && first + l < worlds; l++)",
            f"    (({stored} *)outputs[{index}])[at[l] * {size} + i] = e[l]{truth};",
            "}",
        ]
    sized = next(i for i, x in enumerate(shapes) if size_of(x.shape))
    fill = {
        "TABLES": "\n".join(writer.tables.values()),
        "LINES": "\n".join(f"  {line}" for line in lines),
        "NAME": HANDLER,
        "INPUTS": len(shapes) + sorted_worlds,
        "OUTPUTS": len(outs),
        "WORLD": f"((const int *)inputs[{len(shapes)}])[index]" if sorted_worlds else "index",
        "SIZED": sized,
        "SIZE": size_of(shapes[sized].shape),
    }
    return SIMD_HEADER + _FUNCTION.format(**fill)
