"""Writes the nodes of a function of one world as CUDA, in which some threads hold a world.

A number that stands alone is computed by all threads of a world; of an array, each thread holds
every so-many-th number. Arrays that a thread reads where another has written are in shared memory.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rps_jax.lowering.nodes import (
    STARTS,
    THREADS,
    Array,
    Loop,
    Node,
    Result,
    SimdNodes,
    flat,
    kind_in,
    reached,
    results,
    size_of,
)
from rps_jax.lowering.walk import TooLargeError
from rps_jax.lowering.writer import STORED, TYPES, SimdWriter, constant, literal

WARP = 32
_INLINE = ("given", "move", "take")  # what a thread makes as any other number in turn
_SUM = "sum_over_threads_f"  # of what each thread of a world has summed up
_MOST_SHARED = 48 * 1024  # bytes of a block
_UNROLLED = 4  # turns of a loop over the numbers of a thread, at most
_BODY = """\

FOLD(max, f, V)
FOLD(min, f, V)
FOLD(add, i, I)
FOLD(max, i, I)
FOLD(min, i, I)
FOLD(and, b, I)
FOLD(or, b, I)

{TABLES}
struct Arguments {{
  const void *given[{COUNT}];
  void *found[{FOUND}];
  long long worlds;
}};

extern "C" __global__ void __launch_bounds__(32) step(const __grid_constant__ Arguments a) {{
  __shared__ unsigned shared[{SHARED} * WORLDS];
  const int thread = threadIdx.x % THREADS, world = threadIdx.x / THREADS;
  const long long mine = (long long)blockIdx.x * WORLDS + world;
  const bool there = mine < a.worlds;
  const long long at = {PLACE};
{LINES}
}}
"""


class GpuNodes(SimdNodes):
    """Nodes as they suit threads that hold a world together."""

    def __init__(self) -> None:
        """Begin without nodes."""
        super().__init__()
        self._there: dict[Any, Array] = {}

    def moved(self, values: Sequence[Any], places: np.ndarray, like: Any) -> Any:
        """Of many numbers that are made one by one, make them where they shall be."""
        found = super().moved(values, places, like)
        if not isinstance(found, Array) or found.node.op != "move":
            return found
        node, taken = found.node, tuple(map(_before_it_moved, found.node.args))
        if node.size > WARP:
            return self._gathered(taken, node.kind)._replace(shape=found.shape)
        return found._replace(node=self.node("move", taken, node.kind, node.size))

    def _gathered(self, taken: tuple[Any, ...], kind: str) -> Any:
        """Single numbers as an operand."""
        one, size = taken[0], len(taken)
        if not any(isinstance(a, Array) for a in taken):
            return flat(np.asarray(taken), size)
        if not all(isinstance(a, Array) for a in taken):
            return Array(self.node("move", taken, kind, size), 0, 1, (size,))
        if all(a.node is one.node for a in taken):
            for step in (0, 1):
                if all(a.first == one.first + step * i for i, a in enumerate(taken)):
                    return Array(one.node, one.first, step, (size,))
        key = tuple((a.node.number, a.first) for a in taken)
        if key not in self._there:
            self._there[key] = self._made_there(taken, kind)
        return self._there[key]

    def _made_there(self, taken: tuple[Array, ...], kind: str) -> Array:
        """What is made number by number, by the same operation, of what its operands gather."""
        one, size, sources = taken[0].node, len(taken), {a.node for a in taken}
        ways = {(x.op, len(x.args), x.extra) for x in sources}
        if len(ways) > 1 or any(x.alone or x.op.startswith("fold") for x in sources):
            return Array(self.node("move", taken, kind, size), 0, 1, (size,))
        args = [
            self._gathered(tuple(_operand(a, j) for a in taken), kind_in(like.dtype, "a move"))
            for j, like in enumerate(one.args)
        ]
        return Array(self.node(one.op, args, kind, size, one.extra), 0, 1, (size,))

    def emit(self, name: str, values: Sequence[Any], params: Mapping[str, Any], out: Any) -> Any:
        """Apply a primitive; threads add up what they have summed once, and not for each sum."""
        sums = (_SUM, f"{name}_f")
        if name in ("add", "sub") and size_of(out.shape) == 1 and out.dtype == np.float32:
            one, other = (_made_by(x) for x in values)
            if one and other and other.op == _SUM and one.op in sums:
                if one.op == _SUM:
                    return self._sum(name, one, other, out)
                if (last := _made_by(one.args[1])) and last.op == _SUM:
                    both = self._sum("add", last, other, out)
                    return super().emit(name, [one.args[0], both], params, out)
        found = super().emit(name, values, params, out)
        node = _made_by(found)
        if node is None or node.op != "fold add_f":
            return found
        return Array(self.node(_SUM, [found], "f", 1), 0, 1, found.shape)

    def _sum(self, name: str, one: Node, other: Node, out: Any) -> Array:
        parts = [x.args[0]._replace(shape=out.shape) for x in (one, other)]
        own = super().emit(name, parts, {}, out)
        return Array(self.node(_SUM, [flat(own, 1)], "f", 1), 0, 1, out.shape)


def _operand(a: Array, j: int) -> Any:
    """The operand of which a single number was made."""
    taken = a.node.args[j]
    if not isinstance(taken, Array):
        return np.reshape(taken, -1)[a.first if np.size(taken) > 1 else 0]
    return _before_it_moved(Array(taken.node, taken.first + taken.step * a.first, 1, ()))


def _before_it_moved(a: Any) -> Any:
    """A single number where it was made."""
    return a.node.args[a.first] if isinstance(a, Array) and a.node.op == "move" else a


def _made_by(value: Any) -> Node | None:
    """The node of a single number."""
    return value.node if isinstance(value, Array) and value.node.width == 1 else None


class GpuWriter(SimdWriter):
    """Statements of nodes for some threads of a warp that hold a world together."""

    table_of = "static __device__ const"

    def __init__(self, threads: int, crossed: set[Node]) -> None:
        """`crossed` are arrays that are read by other threads than wrote them."""
        super().__init__()
        self._threads, self._worlds = threads, WARP // threads
        self._crossed = {node for node in crossed if node.width > threads}
        self._names = itertools.count()
        self._before: list[str] = []  # statements that those to come need
        self._picked: dict[tuple[int, int], str] = {}
        self._room: dict[Node, int] = {}  # places in shared memory
        self.shared = 1  # numbers of a world there, at most

    # --- where numbers are ---

    def _turns(self, size: int) -> int:
        """Of a loop in which each thread makes its numbers."""
        return -(-size // self._threads)

    def _single(self, node: Node) -> bool:
        """Whether a thread holds one number of a node."""
        return node.width == 1 or self._turns(node.size) == 1

    def _declared(self, node: Node) -> str:
        """Declaration of a node that is to be written."""
        kind = TYPES[node.kind]
        if self._single(node):
            return f"{kind} {node.name};"
        if node not in self._crossed:
            return f"{kind} {node.name}[{self._turns(node.size)}];"
        first = 0
        for other, place in sorted(self._room.items(), key=lambda item: item[1]):
            if place - first >= node.size:
                break
            first = place + other.size
        self._room[node] = first
        self.shared = max(self.shared, first + node.size)
        return f"{kind} *const {node.name} = ({kind} *)shared + {first * self._worlds} + world;"

    def done(self, nodes: Iterable[Node]) -> None:
        for node in nodes:
            self._room.pop(node, None)

    def _own(self, node: Node) -> str:
        """The number in turn of an array that a thread holds."""
        if self._single(node):
            return node.name
        return f"{node.name}[i * WORLDS]" if node in self._crossed else f"{node.name}[s]"

    def _other(self, node: Node, place: str) -> str:
        """A number of an array that any thread may hold."""
        if node.width == 1:
            return node.name
        if node in self._crossed:
            return f"{node.name}[({place}) * WORLDS]"
        if not self._single(node):
            raise AssertionError(f"{node.name} is not where other threads find it")
        return f"of_thread_{node.kind}({node.name}, {place})"

    def _one(self, node: Node, place: int) -> str:
        """A number of an array at a constant place, in all threads."""
        if node.width == 1 or node in self._crossed:
            return self._other(node, str(place))
        key = node.number, place
        if key not in self._picked:
            name = self._picked[key] = f"p{next(self._names)}"
            text = self._other(node, str(place))
            self._before.append(f"const {TYPES[node.kind]} {name} = {text};")
        return self._picked[key]

    def read(self, a: Any, node: Node, mine: set[Node]) -> str:
        if not isinstance(a, Array):
            return constant(a, self)
        if a.node in mine and node.in_turn(a):
            return f"e{a.node.number}"
        if a.node.width == 1:
            return a.node.name
        if not a.step or node.size == 1:
            return self._one(a.node, a.first)
        if node.in_turn(a):
            return self._own(a.node)
        return self._other(a.node, f"{a.step} * i + {a.first}")

    # --- statements ---

    def first_of(self, sizes: Iterable[int]) -> int:
        return min(sizes)  # so that more is done in one loop over many numbers

    def apart(self, node: Node) -> bool:
        return node.alone and not (node.size > 1 and node.op in _INLINE)

    def _each(self, size: int, lines: Sequence[str]) -> list[str]:
        """A loop in which each thread makes its numbers `i` of so many; `s` counts its turns."""
        turns, place = self._turns(size), "s * THREADS + thread"
        whole = size % self._threads == 0
        own = f"  const int i = {place if whole else f'min({place}, {size - 1})'};"
        if turns == 1:
            return ["{", "  const int s = 0;", own, *lines, "}"]
        head = "#pragma unroll" if turns <= _UNROLLED else "#pragma unroll 1"
        return [head, f"for (int s = 0; s < {turns}; s++) {{", own, *lines, "}"]

    def statement(self, lines: Sequence[str], written: Iterable[Node] = ()) -> list[str]:
        """Statements after those that they need; what is written then is there for all threads."""
        before, self._before = self._before, []
        if any(node in self._crossed for node in written):
            return [*before, "__syncwarp();", *lines, "__syncwarp();"]
        return [*before, *lines]

    def _together(self, group: Sequence[Node], kept: set[Node]) -> list[str]:
        before, lines, after, mine = [], [], [], set(group)
        size = group[0].size
        inside = "" if size % self._threads == 0 else f"s * THREADS + thread < {size} ? "
        for node in group:
            kind, name = TYPES[node.kind], node.name
            needed, text = self._number(node, mine)
            if node.op.startswith("fold"):
                op, start = node.op[5:], literal(STARTS[node.op[5:-2], node.kind], node.kind)
                before.append(f"{kind} {name} = {start};")
                text = f"{inside}{text} : {start}" if inside else text
                lines.append(f"  {name} = {op}({name}, {text});")
                if op != "add_f":  # for which there is a node
                    after.append(f"{name} = {op[:-2]}_over_threads_{node.kind}({name});")
                continue
            lines += [*needed, f"  const {kind} e{node.number} = {text};"]
            if node in kept:
                before.append(self._declared(node))
                lines.append(f"  {self._own(node)} = e{node.number};")
        return self.statement([*before, *self._each(size, lines), *after], kept)

    def _number(self, node: Node, mine: set[Node]) -> tuple[list[str], str]:
        """The number in turn of a node, after statements that it needs."""
        size, at = node.size, "i" if node.size > 1 else "0"
        if node.op == "given":
            stored = f"((const {STORED[node.kind]} *)a.given[{node.extra}])[at * {size} + {at}]"
            return [], f"{stored} != 0" if node.kind == "b" else stored
        if node.op == "take":
            place, source = node.args
            row = self.read(place, Node(0, "row", (), "i", 1), set())
            where = f"{self.table(np.array(node.extra))}[{row} * {size} + {at}]"
            return [], self._other(source.node, where)
        if node.op == "move" and size > 1:
            return self._moved(node)
        if node.op == "move":
            return [], self.read(node.args[0], node, set())
        return [], self._expression(node, mine)

    def _moved(self, node: Node) -> tuple[list[str], str]:
        """The number in turn of what is gathered at constant places, likewise."""
        sources: dict[Node | None, list[int]] = {}
        for i, a in enumerate(node.args):
            sources.setdefault(a.node if isinstance(a, Array) else None, []).append(i)
        texts, which = [], [0] * node.size
        for number, (source, places) in enumerate(sources.items()):
            for i in places:
                which[i] = number
            there = set(places)  # elsewhere any of these places will do
            taken = [node.args[i if i in there else places[0]] for i in range(node.size)]
            if source is None:
                texts.append(constant(np.asarray(taken), self))
            else:
                texts.append(self._other(source, self._numbers([a.first for a in taken])))
        if len(texts) == 1:
            return [], texts[0]
        names, way = [f"p{next(self._names)}" for _ in texts], f"w{next(self._names)}"
        chosen = names[0]
        for number, name in enumerate(names[1:], 1):
            chosen = f"{way} == {number} ? {name} : {chosen}"
        kind = TYPES[node.kind]
        # All threads take part in each shuffle.
        made = [f"  const {kind} {n} = {t};" for n, t in zip(names, texts, strict=True)]
        return [*made, f"  const int {way} = {self._numbers(which)};"], chosen

    def _numbers(self, numbers: Sequence[int]) -> str:
        """An expression in `i` of these whole numbers."""
        step = numbers[1] - numbers[0]
        if list(numbers) == [numbers[0] + step * i for i in range(len(numbers))]:
            return f"{step} * i + {numbers[0]}"
        if len(numbers) <= 8 and max(numbers) < 16:
            packed = sum(x << (4 * i) for i, x in enumerate(numbers))
            return f"(int)({packed:#x}u >> (4 * i) & 15)"
        return f"{self.table(np.array(numbers, np.int32))}[i]"

    def _alone(self, node: Node) -> list[str]:
        kind, name = TYPES[node.kind], node.name
        if isinstance(node.extra, Loop):
            return self._loop(node, node.extra)
        if node.op == "part":
            star = "" if self._single(node) else "*const "
            return [f"{kind} {star}{name} = {node.extra.name};"]
        return self.statement([f"const {kind} {name} = {self._number(node, set())[1]};"])

    def _loop(self, node: Node, loop: Loop) -> list[str]:
        picked, self._picked = self._picked, dict(self._picked)
        there = set(self._room)
        lines = super()._loop(node, loop)
        self.done(set(self._room) - there - set(loop.carried))
        self._picked = picked
        return lines

    def _set(self, own: Node, to: Any, head: str, node: Node, masked: bool = False) -> list[str]:
        text = self.read(to, Node(0, "set", (to,), own.kind, own.size), set())
        text = f"choose_{own.kind}(goes, {text}, {self._own(own)})" if masked else text
        line = f"{self._own(own)} = {text};"
        lines = [line] if own.size == 1 else self._each(own.size, [f"  {line}"])
        return self.statement([*([self._declared(own)] if head else []), *lines], [own])

    def end(self, result: Result) -> list[str]:
        """Statements that store a result."""
        place, a, size, kind = result
        text = self.read(a, Node(0, "end", (a,), kind, size), set())
        stored = f"(({STORED[kind]} *)a.found[{place}])[at * {size} + i]"
        lines = [
            f"  const {TYPES[kind]} e = {text};",
            f"  if (there && s * THREADS + thread < {size}) {stored} = e;",
        ]
        return self.statement(self._each(size, lines))


def _crossed(nodes: Iterable[Node], ends: Iterable[Result]) -> set[Node]:
    """Arrays of which a thread reads what another has written."""
    found: set[Node] = set()
    parts: list[tuple[Node, Node]] = []

    def read(a: Any, size: int, in_turn: bool = True) -> None:
        if not isinstance(a, Array) or a.node.width == 1:
            return
        if not (in_turn and a.step == 1 and a.first == 0 and a.node.width == size):
            found.add(a.node)

    def see(some: Iterable[Node]) -> None:
        for node in some:
            if node.op == "part":
                parts.append((node, node.extra))
            if isinstance(node.extra, Loop):
                loop = node.extra
                for own, *every in zip(loop.carried, node.args, loop.results, strict=True):
                    for a in every:
                        read(a, own.size)
                read(loop.holds, 1)
                see(node.inner)
                continue
            for a in node.args:
                read(a, node.size, node.op not in ("move", "take"))

    see(nodes)
    for each in ends:
        read(each.value, each.size)
    for part, own in parts:
        if part in found or own in found:
            found |= {part, own}
    return found


def source(
    closed: Any, shapes: Sequence[Any], outs: Sequence[Any], ordered: bool, threads: int
) -> str:
    """CUDA of a closed jaxpr of arguments of these shapes and types: the kernel `step`.

    Of `ordered` worlds one more argument tells which come first; so many `threads` hold a world.

    Raises:
      InputError: it has an operation that is not known here, or needs too much shared memory.
    """
    found, ends = results(closed, shapes, outs, GpuNodes())
    nodes = reached(ends)
    writer = GpuWriter(threads, _crossed(nodes, found))
    lines = writer.lines(nodes, ends, set())
    for each in found:
        lines += writer.end(each)
    if 4 * writer.shared * (WARP // threads) > _MOST_SHARED:
        raise TooLargeError("the arrays of a world exceed the shared memory of a block.")
    last = "there ? mine : a.worlds - 1"
    fill = {
        "TABLES": "\n".join(writer.tables.values()),
        "LINES": "\n".join(f"  {line}" for line in lines),
        "COUNT": len(shapes) + ordered,
        "FOUND": len(outs),
        "SHARED": writer.shared,
        "PLACE": f"((const int *)a.given[{len(shapes)}])[{last}]" if ordered else last,
    }
    return f"#define THREADS {threads}\n{THREADS}{_BODY.format(**fill)}"
