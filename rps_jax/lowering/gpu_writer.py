"""Printer of a graph of arrays as CUDA, in which several threads of a warp compute a world.

A node of one number is computed by all threads of a world. Of an array, thread `t` stores the
elements `t`, `t + THREADS`, ... An array that a thread reads where another thread has written is
in shared memory. `GpuNodes` builds the graph, `GpuWriter` prints it.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Hashable, Iterable, Sequence

import numpy as np
from jax.extend.core import ClosedJaxpr

from rps_jax.lowering.nodes import (
    INITIAL,
    Array,
    LoopNode,
    Node,
    Result,
    SimdNodes,
    flat,
    reached,
    results,
)
from rps_jax.lowering.operations import GPU_HEADER, TYPES, defined
from rps_jax.lowering.target import Params, TooLargeError, Typed, Value, size_of
from rps_jax.lowering.writer import STORED, SimdWriter, literal

WARP = 32
_INLINE = ("input", "move", "take")  # operations of which a thread computes only its own elements
_SUM = "sum_over_threads_f"  # sum of the partial sums of all threads of a world
_MAX_SHARED = 48 * 1024  # bytes of a block
_UNROLLED = 4  # iterations of a loop over the elements of a thread that are unrolled
_KERNEL = """\

FOLD(max, f, V)
FOLD(min, f, V)
FOLD(add, i, I)
FOLD(max, i, I)
FOLD(min, i, I)
FOLD(and, b, I)
FOLD(or, b, I)

{TABLES}
struct Arguments {{
  const void *inputs[{INPUTS}];
  void *outputs[{OUTPUTS}];
  long long worlds;
}};

extern "C" __global__ void __launch_bounds__(32) step(const __grid_constant__ Arguments a) {{
  __shared__ unsigned shared[{SHARED} * WORLDS];
  const int thread = threadIdx.x % THREADS, world = threadIdx.x / THREADS;
  const long long index = (long long)blockIdx.x * WORLDS + world;
  const bool exists = index < a.worlds;
  const long long at = {WORLD};
{LINES}
}}
"""


class GpuNodes(SimdNodes):
    """Target that builds the graph of a function for several threads per world."""

    operations = defined(GPU_HEADER)

    def __init__(self) -> None:
        super().__init__()
        self._gathers: dict[Hashable, Array] = {}

    def moved(self, values: Sequence[Value], indices: np.ndarray, template: Typed) -> Value:
        """Gather scalars; scalars that the same operation computes become one array operation."""
        gathered = super().moved(values, indices, template)
        if not isinstance(gathered, Array) or gathered.node.op != "move":
            return gathered
        node, scalars = gathered.node, tuple(map(_source, gathered.node.args))
        if node.size > WARP:
            return self._gathered_numbers(scalars, node.kind)._replace(shape=gathered.shape)
        return gathered._replace(node=self.node("move", scalars, node.kind, node.size))

    def _gathered_numbers(self, scalars: tuple[Value, ...], kind: str) -> Value:
        """Return scalars as one operand."""
        first, size = scalars[0], len(scalars)
        if not any(isinstance(a, Array) for a in scalars):
            return flat(np.asarray(scalars), size)
        if not all(isinstance(a, Array) for a in scalars):
            return Array(self.node("move", scalars, kind, size), 0, 1, (size,))
        if all(a.node is first.node for a in scalars):
            for step in (0, 1):
                if all(a.first == first.first + step * i for i, a in enumerate(scalars)):
                    return Array(first.node, first.first, step, (size,))
        key = tuple((a.node.id, a.first) for a in scalars)
        if key not in self._gathers:
            self._gathers[key] = self._vectorised(scalars, kind)
        return self._gathers[key]

    def _vectorised(self, scalars: tuple[Array, ...], kind: str) -> Array:
        """Vectorise a gather of scalars: apply their common operation to gathered operands."""
        first, size, nodes = scalars[0].node, len(scalars), {a.node for a in scalars}
        operations = {(x.op, len(x.args), x.extra) for x in nodes}
        if len(operations) > 1 or any(x.is_single or x.op.startswith("fold") for x in nodes):
            return Array(self.node("move", scalars, kind, size), 0, 1, (size,))
        args = [
            self._gathered_numbers(
                tuple(_operand(a, j) for a in scalars), self.kind(template.dtype, "a move")
            )
            for j, template in enumerate(first.args)
        ]
        return Array(self.node(first.op, args, kind, size, first.extra), 0, 1, (size,))

    def apply(self, name: str, values: Sequence[Value], params: Params, out: Typed) -> Value:
        """Apply a primitive; sums over threads are added before they are exchanged."""
        sums = (_SUM, f"{name}_f")
        if name in ("add", "sub") and size_of(out.shape) == 1 and out.dtype == np.float32:
            lhs, rhs = (_node_of(x) for x in values)
            if lhs and rhs and rhs.op == _SUM and lhs.op in sums:
                if lhs.op == _SUM:
                    return self._sum(name, lhs, rhs, out)
                if (last := _node_of(lhs.args[1])) and last.op == _SUM:
                    both = self._sum("add", last, rhs, out)
                    return super().apply(name, [lhs.args[0], both], params, out)
        result = super().apply(name, values, params, out)
        node = _node_of(result)
        if node is None or node.op != "fold add_f":
            return result
        return Array(self.node(_SUM, [result], "f", 1), 0, 1, result.shape)

    def _sum(self, name: str, lhs: Node, rhs: Node, out: Typed) -> Array:
        partial = [x.args[0]._replace(shape=out.shape) for x in (lhs, rhs)]
        total = super().apply(name, partial, {}, out)
        return Array(self.node(_SUM, [flat(total, 1)], "f", 1), 0, 1, out.shape)


def _operand(a: Array, j: int) -> Value:
    """Return operand `j` of the operation that computed a single number."""
    operand = a.node.args[j]
    if not isinstance(operand, Array):
        return np.reshape(operand, -1)[a.first if np.size(operand) > 1 else 0]
    return _source(Array(operand.node, operand.first + operand.step * a.first, 1, ()))


def _source(a: Value) -> Value:
    """Return a single number from where it was gathered."""
    return a.node.args[a.first] if isinstance(a, Array) and a.node.op == "move" else a


def _node_of(value: Value) -> Node | None:
    """Return the node of a single number."""
    return value.node if isinstance(value, Array) and value.node.width == 1 else None


class GpuWriter(SimdWriter):
    """Printer of nodes as CUDA for several threads per world."""

    table_type = "static __device__ const"

    def __init__(self, threads: int, shared: set[Node]) -> None:
        """`shared` are arrays that a thread reads where another has written."""
        super().__init__()
        self._threads, self._worlds = threads, WARP // threads
        self._shared = {node for node in shared if node.width > threads}
        self._names = itertools.count()
        self._pending: list[str] = []  # statements that the next statement needs
        self._broadcasts: dict[tuple[int, int], str] = {}
        self._offsets: dict[Node, int] = {}  # in shared memory
        self.shared_size = 1  # numbers of a world in shared memory, at most

    # --- where numbers are stored ---

    def _turns(self, size: int) -> int:
        """Return the number of elements of a thread."""
        return -(-size // self._threads)

    def _is_scalar(self, node: Node) -> bool:
        """Whether a thread stores one number of a node."""
        return node.width == 1 or self._turns(node.size) == 1

    def _declared(self, node: Node) -> str:
        """Return the declaration of a node that is assigned later."""
        kind = TYPES[node.kind]
        if self._is_scalar(node):
            return f"{kind} {node.name};"
        if node not in self._shared:
            return f"{kind} {node.name}[{self._turns(node.size)}];"
        first = 0
        for neighbour, offset in sorted(self._offsets.items(), key=lambda item: item[1]):
            if offset - first >= node.size:
                break
            first = offset + neighbour.size
        self._offsets[node] = first
        self.shared_size = max(self.shared_size, first + node.size)
        return f"{kind} *const {node.name} = ({kind} *)shared + {first * self._worlds} + world;"

    def release(self, nodes: Iterable[Node]) -> None:
        for node in nodes:
            self._offsets.pop(node, None)

    def _element(self, node: Node) -> str:
        """Return the element `i` of an array, which the thread stores."""
        if self._is_scalar(node):
            return node.name
        return f"{node.name}[i * WORLDS]" if node in self._shared else f"{node.name}[s]"

    def item(self, node: Node, index: int | str) -> str:
        """Return an element that any thread may store."""
        if node.width == 1:
            return node.name
        if node in self._shared:
            return f"{node.name}[({index}) * WORLDS]"
        if not self._is_scalar(node):
            raise AssertionError(f"{node.name} is not in shared memory")
        return f"of_thread_{node.kind}({node.name}, {index})"

    def _broadcast(self, node: Node, index: int) -> str:
        """Return an element at a constant index, in all threads."""
        if node.width == 1 or node in self._shared:
            return self.item(node, index)
        key = node.id, index
        if key not in self._broadcasts:
            name = self._broadcasts[key] = f"p{next(self._names)}"
            self._pending.append(f"const {TYPES[node.kind]} {name} = {self.item(node, index)};")
        return self._broadcasts[key]

    def read(self, a: Value, node: Node, fused: set[Node]) -> str:
        if not isinstance(a, Array):
            return self.constant(a)
        if a.node in fused and node.is_in_step(a):
            return f"e{a.node.id}"
        if a.node.width == 1:
            return a.node.name
        if not a.step or node.size == 1:
            return self._broadcast(a.node, a.first)
        if node.is_in_step(a):
            return self._element(a.node)
        return self.item(a.node, f"{a.step} * i + {a.first}")

    # --- statements ---

    def first_size(self, sizes: Collection[int]) -> int:
        return min(sizes)  # so that loops over many elements share more

    def is_single(self, node: Node) -> bool:
        return node.is_single and not (node.size > 1 and node.op in _INLINE)

    def _element_loop(self, size: int, lines: Sequence[str]) -> list[str]:
        """Return a loop over the elements `i` of a thread; `s` counts its iterations."""
        turns, index = self._turns(size), "s * THREADS + thread"
        divisible = size % self._threads == 0
        head = f"  const int i = {index if divisible else f'min({index}, {size - 1})'};"
        if turns == 1:
            return ["{", "  const int s = 0;", head, *lines, "}"]
        unroll = "#pragma unroll" if turns <= _UNROLLED else "#pragma unroll 1"
        return [unroll, f"for (int s = 0; s < {turns}; s++) {{", head, *lines, "}"]

    def statement(self, lines: Sequence[str], written: Iterable[Node] = ()) -> list[str]:
        """Return statements after those that they need, with barriers around shared writes."""
        pending, self._pending = self._pending, []
        if any(node in self._shared for node in written):
            return [*pending, "__syncwarp();", *lines, "__syncwarp();"]
        return [*pending, *lines]

    def together(self, group: Sequence[Node], stored: set[Node]) -> list[str]:
        head, lines, tail, fused = [], [], [], set(group)
        size = group[0].size
        inside = "" if size % self._threads == 0 else f"s * THREADS + thread < {size} ? "
        for node in group:
            kind, name = TYPES[node.kind], node.name
            needed, text = self._element_text(node, fused)
            if node.op.startswith("fold"):
                op, start = node.op[5:], literal(INITIAL[node.op[5:-2], node.kind], node.kind)
                head.append(f"{kind} {name} = {start};")
                if inside and "(" in text:  # all threads take part in a shuffle
                    lines.append(f"  const {kind} e{node.id} = {text};")
                    text = f"e{node.id}"
                text = f"{inside}{text} : {start}" if inside else text
                lines.append(f"  {name} = {op}({name}, {text});")
                if op != "add_f":  # which has a separate node, `_SUM`
                    tail.append(f"{name} = {op[:-2]}_over_threads_{node.kind}({name});")
                continue
            lines += [*needed, f"  const {kind} e{node.id} = {text};"]
            if node in stored:
                head.append(self._declared(node))
                lines.append(f"  {self._element(node)} = e{node.id};")
        return self.statement([*head, *self._element_loop(size, lines), *tail], stored)

    def _element_text(self, node: Node, fused: set[Node]) -> tuple[list[str], str]:
        """Return statements, and the expression of element `i` of a node."""
        size, at = node.size, "i" if node.size > 1 else "0"
        if node.op == "input":
            stored = f"((const {STORED[node.kind]} *)a.inputs[{node.extra}])[at * {size} + {at}]"
            return [], f"{stored} != 0" if node.kind == "b" else stored
        if node.op == "take":
            index, source = node.args
            row = self.read(index, Node(0, "row", (), "i", 1), set())
            at = f"{self.table(np.array(node.extra))}[{row} * {size} + {at}]"
            return [], self.item(source.node, at)
        if node.op == "move" and size > 1:
            return self._gather(node)
        if node.op == "move":
            return [], self.read(node.args[0], node, set())
        return [], self._expression(node, fused)

    def _gather(self, node: Node) -> tuple[list[str], str]:
        """Return statements, and the expression of element `i` of a gather."""
        sources: dict[Node | None, list[int]] = {}
        for i, a in enumerate(node.args):
            sources.setdefault(a.node if isinstance(a, Array) else None, []).append(i)
        texts, source_of = [], [0] * node.size
        for k, (source, indices) in enumerate(sources.items()):
            for i in indices:
                source_of[i] = k
            inside = set(indices)  # elsewhere any valid index will do
            args = [node.args[i if i in inside else indices[0]] for i in range(node.size)]
            if source is None:
                texts.append(self.constant(np.asarray(args)))
            else:
                texts.append(self.item(source, self._integers([a.first for a in args])))
        if len(texts) == 1:
            return [], texts[0]
        names, choice = [f"p{next(self._names)}" for _ in texts], f"w{next(self._names)}"
        chosen = names[0]
        for k, name in enumerate(names[1:], 1):
            chosen = f"{choice} == {k} ? {name} : {chosen}"
        kind = TYPES[node.kind]
        # All threads take part in each shuffle.
        lines = [f"  const {kind} {n} = {t};" for n, t in zip(names, texts, strict=True)]
        return [*lines, f"  const int {choice} = {self._integers(source_of)};"], chosen

    def _integers(self, scalars: Sequence[int]) -> str:
        """Return an expression in `i` of these integers."""
        step = scalars[1] - scalars[0]
        if list(scalars) == [scalars[0] + step * i for i in range(len(scalars))]:
            return f"{step} * i + {scalars[0]}"
        if len(scalars) <= 8 and max(scalars) < 16:
            packed = sum(x << (4 * i) for i, x in enumerate(scalars))
            return f"(int)({packed:#x}u >> (4 * i) & 15)"
        return f"{self.table(np.array(scalars, np.int32))}[i]"

    def single(self, node: Node) -> list[str]:
        kind, name = TYPES[node.kind], node.name
        if node.op == "part":
            star = "" if self._is_scalar(node) else "*const "
            return [f"{kind} {star}{name} = {node.extra.name};"]
        return self.statement([f"const {kind} {name} = {self._element_text(node, set())[1]};"])

    def loop(self, loop: LoopNode) -> list[str]:
        broadcasts, self._broadcasts = self._broadcasts, dict(self._broadcasts)
        stored = set(self._offsets)
        lines = super().loop(loop)
        self.release(set(self._offsets) - stored - set(loop.carried))
        self._broadcasts = broadcasts
        return lines

    def assign(
        self, node: Node, value: Value, declare: bool = False, masked: bool = False
    ) -> list[str]:
        text = self.read(value, Node(0, "set", (value,), node.kind, node.size), set())
        text = f"choose_{node.kind}(goes, {text}, {self._element(node)})" if masked else text
        line = f"{self._element(node)} = {text};"
        lines = [line] if node.size == 1 else self._element_loop(node.size, [f"  {line}"])
        return self.statement([*([self._declared(node)] if declare else []), *lines], [node])

    def end(self, result: Result) -> list[str]:
        """Return the statements that store a result."""
        index, a, size, kind = result
        text = self.read(a, Node(0, "end", (a,), kind, size), set())
        stored = f"(({STORED[kind]} *)a.outputs[{index}])[at * {size} + i]"
        lines = [
            f"  const {TYPES[kind]} e = {text};",
            f"  if (exists && s * THREADS + thread < {size}) {stored} = e;",
        ]
        return self.statement(self._element_loop(size, lines))


def _shared_arrays(nodes: Iterable[Node], roots: Iterable[Result]) -> set[Node]:
    """Return the arrays that a thread reads where another has written."""
    shared: set[Node] = set()
    parts: list[tuple[Node, Node]] = []

    def read(a: Value, size: int, in_step: bool = True) -> None:
        if not isinstance(a, Array) or a.node.width == 1:
            return
        if not (in_step and a.step == 1 and a.first == 0 and a.node.width == size):
            shared.add(a.node)

    def visit(group: Iterable[Node]) -> None:
        for node in group:
            if node.op == "part":
                parts.append((node, node.extra))
            if isinstance(node, LoopNode):
                for carried, *values in zip(node.carried, node.args, node.results, strict=True):
                    for a in values:
                        read(a, carried.size)
                read(node.condition, 1)
                visit(node.inner)
                continue
            for a in node.args:
                read(a, node.size, node.op not in ("move", "take"))

    visit(nodes)
    for result in roots:
        read(result.value, result.size)
    for part, carried in parts:
        if part in shared or carried in shared:
            shared |= {part, carried}
    return shared


def source(
    closed: ClosedJaxpr,
    shapes: Sequence[Typed],
    outs: Sequence[Typed],
    sorted_worlds: bool,
    threads: int,
) -> str:
    """Return the CUDA of a closed jaxpr: the kernel `step`.

    Args:
      closed: the function of one world.
      shapes: types of its arguments.
      outs: types of its results.
      sorted_worlds: whether one more argument has the order of the worlds.
      threads: that compute a world.

    Raises:
      UnsupportedError: it has an operation that is not in the headers.
      TooLargeError: it needs too much shared memory.
    """
    returned, roots = results(closed, shapes, outs, GpuNodes())
    nodes = reached(roots)
    writer = GpuWriter(threads, _shared_arrays(nodes, returned))
    lines = writer.lines(nodes, roots, set())
    for result in returned:
        lines += writer.end(result)
    if 4 * writer.shared_size * (WARP // threads) > _MAX_SHARED:
        raise TooLargeError("the arrays of a world exceed the shared memory of a block.")
    last = "exists ? index : a.worlds - 1"
    fill = {
        "TABLES": "\n".join(writer.tables.values()),
        "LINES": "\n".join(f"  {line}" for line in lines),
        "INPUTS": len(shapes) + sorted_worlds,
        "OUTPUTS": len(outs),
        "SHARED": writer.shared_size,
        "WORLD": f"((const int *)a.inputs[{len(shapes)}])[{last}]" if sorted_worlds else last,
    }
    return f"#define THREADS {threads}\n{GPU_HEADER}{_KERNEL.format(**fill)}"
