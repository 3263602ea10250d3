"""Graph and printer of CUDA, in which several threads of a warp compute a world.

A node of one number is computed by all threads of a world. Of an array, thread `t` stores the
elements `t`, `t + THREADS`, ... An array that a thread reads where another thread has written is
in shared memory.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Sequence

import numpy as np

from rps_jax.lowering.builder import INITIAL, SimdBuilder
from rps_jax.lowering.graph import (
    Array,
    Call,
    DynamicSlice,
    For,
    Gather,
    Input,
    LoopNode,
    Node,
    Params,
    Reduce,
    Result,
    Shape,
    TooLargeError,
    Typed,
    Value,
    Values,
    While,
    flat,
    gathered_scalar,
    size_of,
)
from rps_jax.lowering.operations import GPU_HEADER, TYPES, defined
from rps_jax.lowering.writer import STORED, SimdWriter, Writer

WARP = 32
_SUM = Call("add_over_threads_f")  # sum of the partial sums of all threads of a world


class GpuBuilder(SimdBuilder):
    """Target that builds the graph of a function for several threads per world."""

    operations = defined(GPU_HEADER)

    def stack(self, scalars: Values, kind: str, shape: Shape) -> Array:
        """Gather scalars from the sources of gathers."""
        return super().stack(tuple(map(gathered_scalar, scalars)), kind, shape)

    def apply(self, name: str, values: Values, params: Params, out: Typed) -> Value:
        """Apply a primitive; sums over threads are added before they are exchanged."""
        if name in ("add", "sub") and size_of(out.shape) == 1 and out.dtype == np.float32:
            lhs, rhs = (_node_of(x) for x in values)
            if lhs and rhs and rhs.op == _SUM:
                if lhs.op == _SUM:
                    return self._sum(name, lhs, rhs, out)
                if lhs.op == Call(f"{name}_f"):
                    last = _node_of(lhs.operands[1])
                    if last and last.op == _SUM:
                        both = self._sum("add", last, rhs, out)
                        return super().apply(name, [lhs.operands[0], both], params, out)
        result = super().apply(name, values, params, out)
        node = _node_of(result)
        if node is None or not isinstance(node.op, Reduce):
            return result
        op = Call(f"{node.op.binary}_over_threads_{node.kind}")
        return Array(self.node(op, [result], node.kind, 1), result.shape)

    def _sum(self, name: str, lhs: Node, rhs: Node, out: Typed) -> Array:
        partial = [x.operands[0]._replace(shape=out.shape) for x in (lhs, rhs)]
        total = super().apply(name, partial, {}, out)
        return Array(self.node(_SUM, [flat(total, 1)], "f", 1), out.shape)


def _node_of(value: Value) -> Node | None:
    """Return the node of a single number."""
    return value.node if isinstance(value, Array) and value.node.width == 1 else None


# --- printer -----------------------------------------------------------------------------------

_MAX_SHARED = 48 * 1024  # bytes of a block
_UNROLLED = 4  # iterations of a loop over the elements of a thread that are unrolled
_KERNEL = """\

{TABLES}
struct Arguments {{
  const void *inputs[{INPUTS}];
  void *outputs[{OUTPUTS}];
  long long worlds;
}};

extern __shared__ unsigned shared_of_block[];
extern "C" __global__ void __launch_bounds__(256) step(const __grid_constant__ Arguments a) {{
  const int thread = threadIdx.x % THREADS, world = threadIdx.x % 32 / THREADS;
  unsigned *const shared = shared_of_block + threadIdx.x / 32 * (SHARED * WORLDS);
  const long long number = ((long long)blockIdx.x * blockDim.x + threadIdx.x) / THREADS;
  if (number - world >= a.worlds) return;
  const bool exists = number < a.worlds;
  const long long index = exists ? number : a.worlds - 1, at = {WORLD};
  for (int count = 0; count < {LENGTH}; count++) {{
  if (count) __syncthreads(); /* so that the warps fetch the same instructions */
  const long long row = at * {LENGTH} + {STEP};
{LINES}
  }}
}}
"""
# Reductions over threads; `gpu.h` has the sum of reals.
_FOLDS = "\n".join(
    f"FOLD({name}, {kind}, {TYPES[kind]})" for name, kind in INITIAL if (name, kind) != ("add", "f")
)


def cross_thread_arrays(nodes: Iterable[Node], results: Iterable[Result]) -> set[Node]:
    """Return the arrays of which a thread reads elements that another thread computes."""
    reads: list[tuple[Sequence[Value], int]] = [([x.value], x.size) for x in results]
    waiting = list(nodes)
    while waiting:
        node = waiting.pop()
        if isinstance(node, LoopNode):
            waiting += node.body
            values = zip(node.operands, node.results, strict=True)
            reads += zip(values, [x.size for x in node.carried], strict=True)
            reads.append(([node.condition], 1))
        else:
            size = 0 if isinstance(node.op, Gather | DynamicSlice) else node.size
            reads.append((node.operands, size))
    shared: set[Node] = set()
    for values, size in reads:
        arrays = (a for a in values if isinstance(a, Array) and a.node.width > 1)
        shared |= {a.node.storage for a in arrays if not a.covers(size)}
    return shared


def shared_size(text: str) -> int:
    """Return the numbers of a world in shared memory [4 B] of a printed kernel."""
    return int(text.partition("#define SHARED ")[2].split()[0])


def _depth(node: Node) -> int:
    """Return the number of loops that are nested in a node, with itself."""
    inner = max(map(_depth, node.body), default=0) if isinstance(node, LoopNode) else 0
    return inner + isinstance(node.op, While | For)


class GpuWriter(SimdWriter):
    """Printer of nodes as CUDA for several threads per world."""

    table_type = "static __device__ const"
    function, inputs = _KERNEL, "a.inputs"
    builder = GpuBuilder
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

    def preamble(self) -> str:
        if 4 * self._shared_size * self._worlds > _MAX_SHARED:
            raise TooLargeError("the arrays of a world exceed the shared memory of a block.")
        sizes = f"#define THREADS {self._threads}\n#define SHARED {self._shared_size}\n"
        return f"{sizes}{GPU_HEADER}\n{_FOLDS}\n"

    def assign_storage(self, nodes: Iterable[Node], returned: Iterable[Result]) -> None:
        shared = cross_thread_arrays(nodes, returned)
        self._shared = {node for node in shared if node.width > self._threads}

    # --- where numbers are stored ---

    def _turns(self, size: int) -> int:
        """Return the number of elements of a thread."""
        return -(-size // self._threads)

    def _is_scalar(self, node: Node) -> bool:
        """Whether a thread stores one number of a node."""
        return node.width == 1 or self._turns(node.size) == 1

    def declare(self, node: Node) -> str:
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
        return f"{node.name}[i * WORLDS]" if node.storage in self._shared else f"{node.name}[s]"

    def item(self, node: Node, index: int | str) -> str:
        """Return an element that any thread may store."""
        if node.width == 1:
            return node.name
        if node.storage in self._shared:
            return f"{node.name}[({index}) * WORLDS]"
        assert self._is_scalar(node), f"{node.name} is not in shared memory"
        return f"of_thread_{node.kind}({node.name}, {index})"

    def read(self, a: Value, size: int, fused: Collection[Node] = ()) -> str:
        if isinstance(a, Array) and a.node.width > 1 and a.node not in fused:
            if not a.step or size == 1:  # an element in all threads
                text = self.item(a.node, a.first)
                if a.node.storage in self._shared:
                    return text
                key = a.node.id, a.first
                if key not in self._broadcasts:
                    name = self._broadcasts[key] = f"p{next(self._names)}"
                    self._pending.append(f"const {TYPES[a.node.kind]} {name} = {text};")
                return self._broadcasts[key]
            if a.covers(size):
                return self.element(a.node)
        return super().read(a, size, fused)

    # --- statements ---

    def choose_size(self, sizes: Collection[int]) -> int:
        return min(sizes)  # so that loops over many elements share more

    def is_fusible(self, node: Node) -> bool:
        """Whether a thread computes only its own elements of a node."""
        return node.is_fusible or (
            node.size > 1 and isinstance(node.op, Input | Gather | DynamicSlice)
        )

    def elements(self, size: int, lines: Sequence[str]) -> list[str]:
        """Return a loop over the elements `i` of a thread; `s` counts its iterations."""
        turns, index = self._turns(size), "s * THREADS + thread"
        head = f"  const int i = {f'min({index}, {size - 1})' if self._guard(size) else index};"
        if turns == 1:
            return ["{", "  const int s = 0;", head, *lines, "}"]
        unroll = "#pragma unroll" if turns <= _UNROLLED else "#pragma unroll 1"
        return [unroll, f"for (int s = 0; s < {turns}; s++) {{", head, *lines, "}"]

    def statement(self, lines: Sequence[str], written: Iterable[Node] = ()) -> list[str]:
        """Return statements after those that they need, with barriers around shared writes."""
        pending, self._pending = self._pending, []
        if any(node.storage in self._shared for node in written):
            return [*pending, "__syncwarp();", *lines, "__syncwarp();"]
        return [*pending, *lines]

    def _guard(self, size: int) -> str:
        """Return the condition that a thread has an element `i`; empty if it always has one."""
        return f"s * THREADS + thread < {size}" if size % self._threads else ""

    def reduce(self, node: Node, binary: str, text: str) -> list[str]:
        lines, guard = [], self._guard(node.size)
        if guard and "(" in text:  # all threads take part in a shuffle
            lines.append(f"  {self.declaration(node.kind, f'e{node.id}')} = {text};")
            text = f"e{node.id}"
        if guard:
            text = f"{guard} ? {text} : {self.initial(node)}"
        return [*lines, *super().reduce(node, binary, text)]

    def element_text(self, node: Node, fused: set[Node]) -> tuple[list[str], str]:
        op, size, at = node.op, node.size, "i" if node.size > 1 else "0"
        if isinstance(op, Input):
            world = "row" if op.index in self.rows.scanned else "at"
            source = f"a.inputs[{op.index}]"
            if op.index in self.rows.carried:
                source = f"(count ? a.outputs[{self.rows.carried.index(op.index)}] : {source})"
            stored = f"((const {STORED[node.kind]} *){source})[{world} * {size} + {at}]"
            return [], f"{stored} != 0" if node.kind == "b" else stored
        if isinstance(op, DynamicSlice):
            index, source = node.operands
            row, table = self.read(index, 1), self.table(np.array(op.windows))
            return [], self.item(source.node, f"{table}[{row} * {size} + {at}]")
        if isinstance(op, Gather) and size > 1:
            return self._gather(node)
        return super().element_text(node, fused)

    def _gather(self, node: Node) -> tuple[list[str], str]:
        """Return statements, and the expression of element `i` of a gather."""
        owners = [a.node if isinstance(a, Array) else None for a in node.operands]
        sources, texts = list(dict.fromkeys(owners)), []
        for source in sources:
            first = node.operands[owners.index(source)]  # elsewhere any valid index will do
            pairs = zip(node.operands, owners, strict=True)
            args = [a if owner is source else first for a, owner in pairs]
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
        source_of = self._integers([sources.index(owner) for owner in owners])
        return [*lines, f"  const int {choice} = {source_of};"], chosen

    def _integers(self, scalars: Sequence[int]) -> str:
        """Return an expression in `i` of these integers."""
        step = scalars[1] - scalars[0]
        if list(scalars) == [scalars[0] + step * i for i in range(len(scalars))]:
            return f"{step} * i + {scalars[0]}"
        if len(scalars) <= 8 and max(scalars) < 16:
            packed = sum(x << (4 * i) for i, x in enumerate(scalars))
            return f"(int)({packed:#x}u >> (4 * i) & 15)"
        return f"{self.table(np.array(scalars, np.int32))}[i]"

    def loop_head(self, loop: LoopNode) -> str:
        """Return the first line of a loop; the warps of a block meet after each control step.

        Then they fetch the same instructions, of which no cache holds a control step.
        """
        is_control = isinstance(loop.op, While) and _depth(loop) > 2
        return "for (;; __syncthreads()) {" if is_control else super().loop_head(loop)

    def loop(self, loop: LoopNode) -> list[str]:
        broadcasts, self._broadcasts = self._broadcasts, dict(self._broadcasts)
        stored = set(self._offsets)
        lines = super().loop(loop)
        self.release(set(self._offsets) - stored - set(loop.carried))
        self._broadcasts = broadcasts
        return lines

    def end(self, result: Result) -> list[str]:
        position, a, size, kind = result
        world = "row" if position in self.rows.stacked else "at"
        stored = f"(({STORED[kind]} *)a.outputs[{position}])[{world} * {size} + i]"
        guard = f" && {self._guard(size)}" if self._guard(size) else ""
        lines = [
            f"  {self.declaration(kind, 'e')} = {self.read(a, size)};",
            f"  if (exists{guard}) {stored} = e;",
        ]
        # Other threads may still read the last step's number.
        waits = ["__syncwarp();"] * (position < len(self.rows.carried))
        return self.statement([*waits, *self.elements(size, lines)])
