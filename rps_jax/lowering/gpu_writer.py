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
    view_of,
)
from rps_jax.lowering.operations import GPU_HEADER, TYPES, defined
from rps_jax.lowering.target import Params, Shape, TooLargeError, Typed, Value, Values, size_of
from rps_jax.lowering.writer import STORED, SimdWriter, Writer

WARP = 32
_INLINE = ("input", "move", "take")  # operations of which a thread computes only its own elements
_SUM = "add_over_threads_f"  # sum of the partial sums of all threads of a world
_MAX_SHARED = 48 * 1024  # bytes of a block
_UNROLLED = 4  # iterations of a loop over the elements of a thread that are unrolled
_KERNEL = """\

{TABLES}
struct Arguments {{
  const void *inputs[{INPUTS}];
  void *outputs[{OUTPUTS}];
  long long worlds;
}};

extern "C" __global__ void __launch_bounds__(32) step(const __grid_constant__ Arguments a) {{
  __shared__ unsigned shared[SHARED * WORLDS];
  const int thread = threadIdx.x % THREADS, world = threadIdx.x / THREADS;
  const long long number = (long long)blockIdx.x * WORLDS + world;
  const bool exists = number < a.worlds;
  const long long index = exists ? number : a.worlds - 1, at = {WORLD};
{LINES}
}}
"""
# Reductions over threads; `gpu.h` has that of `_SUM`.
_FOLDS = "\n".join(f"FOLD({name}, {kind}, {TYPES[kind]})" for name, kind in [*INITIAL][1:])


class GpuNodes(SimdNodes):
    """Target that builds the graph of a function for several threads per world."""

    operations = defined(GPU_HEADER)

    def __init__(self) -> None:
        super().__init__()
        self._gathers: dict[Hashable, Array] = {}

    def gathered(self, scalars: Values, kind: str, shape: Shape) -> Array:
        """Gather scalars; many that the same operation computes become one array operation."""
        scalars = tuple(map(_source, scalars))
        if len(scalars) <= WARP:
            return super().gathered(scalars, kind, shape)
        return self._gathered_numbers(scalars, kind)._replace(shape=shape)

    def _gathered_numbers(self, scalars: tuple[Value, ...], kind: str) -> Value:
        """Return scalars as one operand."""
        size = len(scalars)
        if not any(isinstance(a, Array) for a in scalars):
            return flat(np.asarray(scalars), size)
        if view := view_of(scalars, (size,)):
            return view
        if not all(isinstance(a, Array) for a in scalars):
            return super().gathered(scalars, kind, (size,))
        key = tuple((a.node.id, a.first) for a in scalars)
        if key not in self._gathers:
            self._gathers[key] = self._vectorised(scalars, kind)
        return self._gathers[key]

    def _vectorised(self, scalars: tuple[Array, ...], kind: str) -> Array:
        """Vectorise a gather of scalars: apply their common operation to gathered operands."""
        first, size, nodes = scalars[0].node, len(scalars), {a.node for a in scalars}
        operations = {(x.op, len(x.args), x.extra) for x in nodes}
        unique = any(x.is_single or not x.args or x.op.startswith("fold") for x in nodes)
        if len(operations) > 1 or unique:
            return super().gathered(scalars, kind, (size,))
        args = [
            self._gathered_numbers(
                tuple(_operand(a, j) for a in scalars), self.kind(template.dtype, "a move")
            )
            for j, template in enumerate(first.args)
        ]
        return Array(self.node(first.op, args, kind, size, first.extra), 0, 1, (size,))

    def apply(self, name: str, values: Values, params: Params, out: Typed) -> Value:
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
        if node is None or not node.op.startswith("fold"):
            return result
        op = f"{node.op[5:-2]}_over_threads_{node.kind}"
        return Array(self.node(op, [result], node.kind, 1), 0, 1, result.shape)

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
    header, function, inputs = f"{GPU_HEADER}\n{_FOLDS}\n", _KERNEL, "a.inputs"
    nodes = GpuNodes
    single = Writer.single  # a thread reads inputs as it needs them

    def __init__(self, threads: int) -> None:
        """Print the code of so many threads per world."""
        super().__init__()
        self._threads, self._worlds = threads, WARP // threads
        self._shared: set[Node] = set()  # arrays that a thread reads where another has written
        self._names = itertools.count()
        self._pending: list[str] = []  # statements that the next statement needs
        self._broadcasts: dict[tuple[int, int], str] = {}
        self._offsets: dict[Node, int] = {}  # in shared memory
        self._shared_size = 1  # numbers of a world in shared memory, at most

    def source(
        self, closed: ClosedJaxpr, shapes: Sequence[Typed], outs: Sequence[Typed],
        sorted_worlds: bool = False,
    ) -> str:  # fmt: skip
        text = super().source(closed, shapes, outs, sorted_worlds)
        if 4 * self._shared_size * self._worlds > _MAX_SHARED:
            raise TooLargeError("the arrays of a world exceed the shared memory of a block.")
        return f"#define THREADS {self._threads}\n#define SHARED {self._shared_size}\n{text}"

    def prepare(self, nodes: Iterable[Node], returned: Iterable[Result]) -> None:
        shared = _shared_arrays(nodes, returned)
        self._shared = {node for node in shared if node.width > self._threads}

    # --- where numbers are stored ---

    def _turns(self, size: int) -> int:
        """Return the number of elements of a thread."""
        return -(-size // self._threads)

    def _is_scalar(self, node: Node) -> bool:
        """Whether a thread stores one number of a node."""
        return node.width == 1 or self._turns(node.size) == 1

    def declared(self, node: Node) -> str:
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
        self._shared_size = max(self._shared_size, first + node.size)
        return f"{kind} *const {node.name} = ({kind} *)shared + {first * self._worlds} + world;"

    def release(self, nodes: Iterable[Node]) -> None:
        for node in nodes:
            self._offsets.pop(node, None)

    def element(self, node: Node) -> str:
        if self._is_scalar(node):
            return node.name
        return f"{node.name}[i * WORLDS]" if node.stored in self._shared else f"{node.name}[s]"

    def item(self, node: Node, index: int | str) -> str:
        """Return an element that any thread may store."""
        if node.width == 1:
            return node.name
        if node.stored in self._shared:
            return f"{node.name}[({index}) * WORLDS]"
        assert self._is_scalar(node), f"{node.name} is not in shared memory"
        return f"of_thread_{node.kind}({node.name}, {index})"

    def _broadcast(self, node: Node, index: int) -> str:
        """Return an element at a constant index, in all threads."""
        if node.width == 1 or node.stored in self._shared:
            return self.item(node, index)
        key = node.id, index
        if key not in self._broadcasts:
            name = self._broadcasts[key] = f"p{next(self._names)}"
            self._pending.append(f"const {TYPES[node.kind]} {name} = {self.item(node, index)};")
        return self._broadcasts[key]

    def read(self, a: Value, node: Node, fused: set[Node]) -> str:
        if isinstance(a, Array) and a.node.width > 1 and a.node not in fused:
            if not a.step or node.size == 1:
                return self._broadcast(a.node, a.first)
            if node.is_in_step(a):
                return self.element(a.node)
        return super().read(a, node, fused)

    # --- statements ---

    def first_size(self, sizes: Collection[int]) -> int:
        return min(sizes)  # so that loops over many elements share more

    def is_single(self, node: Node) -> bool:
        return node.is_single and not (node.size > 1 and node.op in _INLINE)

    def elements(self, size: int, lines: Sequence[str]) -> list[str]:
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
        if any(node.stored in self._shared for node in written):
            return [*pending, "__syncwarp();", *lines, "__syncwarp();"]
        return [*pending, *lines]

    def _guard(self, size: int) -> str:
        """Return the condition that a thread has an element `i`; empty if it always has."""
        return f"s * THREADS + thread < {size}" if size % self._threads else ""

    def fold(self, node: Node, text: str) -> list[str]:
        lines, guard = [], self._guard(node.size)
        if guard and "(" in text:  # all threads take part in a shuffle
            lines.append(f"  {self.declaration(node.kind, f'e{node.id}')} = {text};")
            text = f"e{node.id}"
        return [*lines, *super().fold(node, f"{guard} ? {text} : {self.initial(node)}"
                                      if guard else text)]  # fmt: skip

    def element_text(self, node: Node, fused: set[Node]) -> tuple[list[str], str]:
        size, at = node.size, "i" if node.size > 1 else "0"
        if node.op == "input":
            stored = f"((const {STORED[node.kind]} *)a.inputs[{node.extra}])[at * {size} + {at}]"
            return [], f"{stored} != 0" if node.kind == "b" else stored
        if node.op == "take":
            index, source = node.args
            row, table = self.value(index, "i", 1), self.table(np.array(node.extra))
            return [], self.item(source.node, f"{table}[{row} * {size} + {at}]")
        if node.op == "move" and size > 1:
            return self._gather(node)
        return super().element_text(node, fused)

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
                texts.append(self.operand(np.asarray(args), "i"))
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

    def loop(self, loop: LoopNode) -> list[str]:
        broadcasts, self._broadcasts = self._broadcasts, dict(self._broadcasts)
        stored = set(self._offsets)
        lines = super().loop(loop)
        self.release(set(self._offsets) - stored - set(loop.carried))
        self._broadcasts = broadcasts
        return lines

    def end(self, result: Result) -> list[str]:
        position, a, size, kind = result
        stored = f"(({STORED[kind]} *)a.outputs[{position}])[at * {size} + i]"
        guard = f" && {self._guard(size)}" if self._guard(size) else ""
        lines = [
            f"  {self.declaration(kind, 'e')} = {self.value(a, kind, size)};",
            f"  if (exists{guard}) {stored} = e;",
        ]
        return self.statement(self.elements(size, lines))


def _shared_arrays(nodes: Iterable[Node], roots: Iterable[Result]) -> set[Node]:
    """Return the arrays that a thread reads where another has written."""
    shared: set[Node] = set()

    def read(a: Value, size: int, in_step: bool = True) -> None:
        if not isinstance(a, Array) or a.node.width == 1:
            return
        if not (in_step and a.step == 1 and a.first == 0 and a.node.width == size):
            shared.add(a.node.stored)

    def visit(group: Iterable[Node]) -> None:
        for node in group:
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
    return shared
