"""Writes the nodes of a function of one world as C, which XLA calls with a batch of worlds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from rps_jax.lowering.nodes import (
    HEADER,
    STARTS,
    Array,
    Loop,
    Node,
    SimdNodes,
    reached,
    results,
    size_of,
)
from rps_jax.lowering.walk import kind_of

HANDLER = "rps_native"  # what its name is replaced by is known to XLA
TYPES = {"f": "V", "i": "I", "u": "U", "b": "I"}  # of a vector
STORED = {"f": "float", "i": "int", "u": "unsigned", "b": "unsigned char"}  # of a world's number
# Placeholders in capitals are lines that are written for a function.
_BODY = """\

{TABLES}
static void some(void **given, void **found, int64_t first, int64_t worlds) {{
  int64_t at[LANES];
  for (int l = 0; l < LANES; l++) {{
    const int64_t mine = first + l < worlds ? first + l : worlds - 1;
    at[l] = {PLACE};
  }}
{LINES}
}}

XLA_FFI_Error *{NAME}(XLA_FFI_CallFrame *frame) {{
  if (is_told(frame)) return 0;
  void *given[{COUNT}], *found[{FOUND}];
  for (int i = 0; i < {COUNT}; i++) given[i] = ((XLA_FFI_Buffer *)frame->args.args[i])->data;
  for (int i = 0; i < {FOUND}; i++) found[i] = ((XLA_FFI_Buffer *)frame->rets.rets[i])->data;
  const int64_t worlds = worlds_of(frame->args.args[{ONE}], {SIZE});
  for (int64_t first = 0; first < worlds; first += LANES) some(given, found, first, worlds);
  return 0;
}}
"""


class SimdWriter:
    """Statements of nodes, in an order in which few loops are needed."""

    table_of = "static const"

    def __init__(self) -> None:
        """Begin without statements."""
        self.tables: dict[bytes, str] = {}  # of constants, which stand before the function

    def lines(self, nodes: Iterable[Node], wanted: Iterable[Node], there: set[Node]) -> list[str]:
        """Statements that make nodes, where some are there; `wanted` are used afterwards."""
        waiting, there, groups = list(nodes), set(there), []
        while waiting:
            group = self._next(waiting, there)
            there |= set(group)
            waiting = [node for node in waiting if node not in there]
            groups.append(group)
        lines, wanted = [], set(wanted)
        users: dict[Node, set[int]] = {}
        for i, group in enumerate(groups):
            for node in group:
                for one in node.after:
                    users.setdefault(one, set()).add(i)
        last: dict[int, list[Node]] = {}
        for i, group in enumerate(groups):
            for node in group:
                if node not in wanted:
                    last.setdefault(max(users.get(node, {i})), []).append(node)
        for i, group in enumerate(groups):
            if self.apart(group[0]):
                for node in group:
                    lines += self._alone(node)
            else:
                whole = set().union(*(node.entire for node in group))
                kept = {n for n in group if n in wanted or n in whole or users.get(n, set()) - {i}}
                lines += self._together(group, kept)
            self.done(last.get(i, ()))
        return lines

    def apart(self, node: Node) -> bool:
        """Whether a node stands in no loop over its numbers."""
        return node.alone

    def first_of(self, sizes: Iterable[int]) -> int:
        """Of which size the first of several loops over numbers is."""
        return next(iter(sizes))

    def done(self, nodes: Iterable[Node]) -> None:
        """Hear of nodes that no statement to come reads."""

    def statement(self, lines: Sequence[str]) -> list[str]:
        """Statements, after those that they need."""
        return list(lines)

    def _next(self, waiting: Sequence[Node], there: set[Node]) -> list[Node]:
        """What can be made next: all that stands alone, else one loop, else one of JAX's loops."""
        for wanted in ("alone", "together", "loop"):
            groups: dict[int, list[Node]] = {}
            have = set(there)
            for node in waiting:
                kind = "alone" if self.apart(node) else "together"
                kind = "loop" if isinstance(node.extra, Loop) else kind
                if kind != wanted:
                    continue
                whole = there if kind == "together" else have
                if node.entire <= whole and set(node.after) <= have:
                    groups.setdefault(node.size if kind == "together" else 0, []).append(node)
                    have.add(node)
                    if kind == "loop":
                        break
            if groups:
                return groups[self.first_of(groups)]
        raise AssertionError("nodes wait for one another")

    def _together(self, group: Sequence[Node], kept: set[Node]) -> list[str]:
        """One loop over the numbers of nodes."""
        before, lines, mine = [], [], set(group)
        for node in group:
            kind, name = TYPES[node.kind], node.name
            text = self._expression(node, mine)
            if node.op.startswith("fold"):
                op = node.op[5:]
                start = STARTS[op[:-2], node.kind]
                before.append(f"{kind} {name} = {_all(node.kind, start)};")
                lines.append(f"  {name} = {op}({name}, {text});")
                continue
            lines.append(f"  const {kind} e{node.number} = {text};")
            if node in kept:
                before.append(f"{kind} {name}[{node.size}];")
                lines.append(f"  {name}[i] = e{node.number};")
        return [*before, f"for (int i = 0; i < {group[0].size}; i++) {{", *lines, "}"]

    def _alone(self, node: Node) -> list[str]:
        kind, name, size = TYPES[node.kind], node.name, node.size
        if isinstance(node.extra, Loop):
            return self._loop(node, node.extra)
        if node.op == "part":
            if size == 1:
                return [f"const {kind} {name} = {node.extra.name};"]
            return [f"const {kind} *const {name} = {node.extra.name};"]
        declared = f"{kind} {name}" + ("" if size == 1 else f"[{size}]")
        at = "" if size == 1 else "[i]"
        if node.op == "given":
            stored = f"((const {STORED[node.kind]} *)given[{node.extra}])[at[l] * {size} + i]"
            stored = f"-(int){stored}" if node.kind == "b" else stored
            return [
                f"{declared};",
                f"for (int i = 0; i < {size}; i++)",
                f"  for (int l = 0; l < LANES; l++) {name}{at}[l] = {stored};",
            ]
        if node.op == "take":
            place, source = node.args
            row, table = self.read(place, node, set()), self.table(np.array(node.extra))
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

    def _loop(self, node: Node, loop: Loop) -> list[str]:
        lines, body = [], []
        for own, start in zip(loop.carried, node.args, strict=True):
            if own.size:
                lines += self._set(own, start, f"{TYPES[own.kind]} ", node)
        results = [a.node for a in (*loop.results, loop.holds) if isinstance(a, Array)]
        there = {*node.free, *loop.carried, *(n for n in results if n not in node.inner)}
        if loop.holds is not None:
            before = [n for n in reached([loop.holds.node]) if n in node.inner]
            body += self.lines(before, node.inner, there)
            goes = self.read(loop.holds, Node(0, "goes", (), "b", 1), set())
            body += self.statement([f"const I goes = {goes};", "if (!any(goes)) break;"])
            there |= set(before)
            rest = [n for n in node.inner if n not in set(before)]
        else:
            rest = list(node.inner)
        body += self.lines(rest, results, there)
        for own, result in zip(loop.carried, loop.results, strict=True):
            if own.size and not (isinstance(result, Array) and result.node is own):
                body += self._set(own, result, "", node, masked=loop.holds is not None)
        often = f"int turn = 0; turn < {loop.length}; turn++" if loop.length else ";;"
        return [*lines, f"for ({often}) {{", *(f"  {line}" for line in body), "}"]

    def _set(self, own: Node, to: Any, head: str, node: Node, masked: bool = False) -> list[str]:
        """Statements that give a carried node its numbers, in the lanes that go on."""
        each = Node(0, "set", (to,), own.kind, own.size)
        text, at = self.read(to, each, set()), "" if own.size == 1 else "[i]"
        text = f"choose_{own.kind}(goes, {text}, {own.name}{at})" if masked else text
        if own.size == 1:
            return [f"{head}{own.name} = {text};"]
        declared = [f"{head}{own.name}[{own.size}];"] if head else []
        return [*declared, f"for (int i = 0; i < {own.size}; i++) {own.name}[i] = {text};"]

    def read(self, a: Any, node: Node, mine: set[Node]) -> str:
        """How a node reads an operand."""
        if not isinstance(a, Array):
            return constant(a, self)
        if a.node.width == 1:
            return a.node.name
        if a.node in mine and node.in_turn(a):
            return f"e{a.node.number}"
        if not a.step or node.size == 1 or node.op in ("move", "take"):
            return f"{a.node.name}[{a.first}]"
        return f"{a.node.name}[i + {a.first}]" if a.first else f"{a.node.name}[i]"

    def _expression(self, node: Node, mine: set[Node]) -> str:
        reads = [self.read(a, node, mine) for a in node.args]
        return reads[0] if node.op.startswith("fold") else f"{node.op}({', '.join(reads)})"

    def table(self, array: np.ndarray) -> str:
        """The name of constants that stand before the function."""
        key = array.tobytes() + array.dtype.str.encode()
        kind = kind_of(array.dtype, "", SimdNodes.kinds)
        if key not in self.tables:
            texts = ", ".join(literal(x, kind) for x in array.reshape(-1))
            stored = "int" if kind == "b" else STORED[kind]
            name = f"t{len(self.tables)}"
            self.tables[key] = f"{self.table_of} {stored} {name}[{array.size}] = {{{texts}}};"
        return self.tables[key].split("[")[0].split()[-1]


def constant(a: Any, writer: SimdWriter) -> str:
    """A constant, or the one in turn of several."""
    array = np.asarray(a).reshape(-1)
    kind = kind_of(array.dtype, "", SimdNodes.kinds)
    if array.size == 1:
        return _all(kind, array[0])
    return f"all_{kind}({writer.table(array)}[i])"


def _all(kind: str, value: Any) -> str:
    """A constant in every lane."""
    return f"all_{kind}({literal(value, kind)})"


def literal(value: Any, kind: str) -> str:
    """A number in C."""
    if kind == "f":
        number = float(value)
        text = f"{number!r}f" if math.isfinite(number) else repr(number).replace("inf", "INFINITY")
        return "NAN" if math.isnan(number) else text
    if kind == "b":
        return str(-int(value))
    whole = int(value)
    return f"{whole}u" if kind == "u" else str(whole) if whole > -(2**31) else "-2147483647 - 1"


def source(closed: Any, shapes: Sequence[Any], outs: Sequence[Any], ordered: bool = False) -> str:
    """C of a closed jaxpr of arguments of these shapes and types: the handler `HANDLER` of XLA's.

    Of `ordered` worlds one more argument tells which come first.

    Raises:
      InputError: it has an operation that is not known here.
    """
    (found, ends), writer = results(closed, shapes, outs, SimdNodes()), SimdWriter()
    lines = writer.lines(reached(ends), ends, set())
    for place, a, size, kind in found:
        read = writer.read(a, Node(0, "end", (a,), kind, size), set())
        stored, truth = STORED[kind], " != 0" * (kind == "b")
        lines += [
            f"for (int i = 0; i < {size}; i++) {{",
            f"  const {TYPES[kind]} e = {read};",
            "  for (int l = 0; l < LANES && first + l < worlds; l++)",
            f"    (({stored} *)found[{place}])[at[l] * {size} + i] = e[l]{truth};",
            "}",
        ]
    one = next(i for i, x in enumerate(shapes) if size_of(x.shape))
    fill = {
        "TABLES": "\n".join(writer.tables.values()),
        "LINES": "\n".join(f"  {line}" for line in lines),
        "NAME": HANDLER,
        "COUNT": len(shapes) + ordered,
        "FOUND": len(outs),
        "PLACE": f"((const int *)given[{len(shapes)}])[mine]" if ordered else "mine",
        "ONE": one,
        "SIZE": size_of(shapes[one].shape),
    }
    return HEADER + _BODY.format(**fill)
