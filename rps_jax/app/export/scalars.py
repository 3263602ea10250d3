"""A jaxpr as single numbers, each computed once: what C and JavaScript are written from."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rps_jax.lowering.walk import (
    COMPARISONS,
    PAIRED,
    Target,
    UnsupportedError,
    is_constant,
    kind_of,
)

_MANY = 256  # weights from which on a product with a matrix is a loop
# Operations on real numbers that both languages have under these names, with their operands.
UNARY = (
    *("abs", "sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh"),
    *("tanh", "asinh", "acosh", "atanh", "log1p", "expm1", "cbrt", "floor", "ceil", "exp2", "erf"),
    *("neg", "sign", "logistic", "is_finite"),
)
BINARY = ("add", "sub", "mul", "div", "max", "min", "rem", "atan2", "pow")
_WHOLE = ("add", "sub", "mul", "div", "max", "min", "rem", "neg", "abs", "sign")
_LOGICAL = ("and", "or", "xor", "not")


class Node:
    """One number: a constant, an input, or what an operation makes of others."""

    __slots__ = ("args", "extra", "kind", "number", "op")

    def __init__(self, number: int, op: str, args: tuple[Node, ...], kind: str, extra: Any):
        """Take all that it is."""
        self.number, self.op, self.args, self.kind, self.extra = number, op, args, kind, extra


class Block(NamedTuple):
    """What is computed only if a condition holds (or does not), and the choices made of it."""

    condition: Node
    holds: bool
    nodes: list[Node]
    choices: list[Node]


class Loop(NamedTuple):
    """What is done again and again: numbers that are carried, and what becomes of them."""

    length: int
    carried: tuple[Node, ...]
    results: tuple[Node, ...]
    nodes: tuple[Node, ...]  # that depend on what is carried, in their order


class Scalars(Target):
    """The target of single numbers; equal ones are one node."""

    def __init__(self, compiler: str) -> None:
        """Begin without nodes; errors name the compiler."""
        self.compiler = compiler
        self._known: dict[Any, Node] = {}
        self._count = itertools.count()
        self.tables: dict[bytes, np.ndarray] = {}

    # --- nodes ---

    def node(self, op: str, args: Sequence[Node], kind: str, extra: Any = None) -> Node:
        """The node of an operation, new or known."""
        key = (op, tuple(arg.number for arg in args), kind, extra)
        if key not in self._known:
            self._known[key] = Node(next(self._count), op, tuple(args), kind, extra)
        return self._known[key]

    def constant(self, value: Any, kind: str) -> Node:
        """A number that is known."""
        made = {"f": float, "i": int, "b": bool}[kind](value)
        key = ("constant", repr(made), kind)
        if key not in self._known:
            self._known[key] = Node(next(self._count), "constant", (), kind, made)
        return self._known[key]

    def inputs(self, group: str, name: str, shape: tuple[int, ...], kind: str) -> np.ndarray:
        """Nodes of an input, in its shape."""
        found = np.empty(shape, object)
        flat = found.reshape(-1)
        for i, place in enumerate(np.ndindex(shape)):
            flat[i] = self.node("input", (), kind, (group, name, place))
        return found

    def array(self, value: Any) -> np.ndarray:
        """Nodes of a value."""
        if not is_constant(value):
            return np.asarray(value, object)
        found = np.empty(value.shape, object)
        kind = kind_of(value.dtype)
        found.reshape(-1)[:] = [self.constant(one, kind) for one in value.reshape(-1)]
        return found

    # --- what a target does ---

    def moved(self, values: Sequence[Any], places: np.ndarray, like: Any) -> np.ndarray:
        """Numbers at other places."""
        flat = np.concatenate([self.array(value).reshape(-1) for value in values])
        found = np.empty(places.shape, object)
        found.reshape(-1)[:] = flat[places.reshape(-1)]
        return found

    def emit(
        self, name: str, values: Sequence[Any], params: Mapping[str, Any], out: Any
    ) -> np.ndarray:
        """Apply a primitive number by number."""
        if name == "dot_general":
            return self._product(values, params, out)
        arrays = [self.array(value) for value in values]
        kind = kind_of(out.dtype, name)
        if name in PAIRED:
            return self._folded(PAIRED[name], arrays[0], params, kind)
        if name in ("argmax", "argmin"):
            return self._place_of(name, arrays[0], params["axes"][0])
        if name == "dynamic_slice":
            starts = [one.item() for one in arrays[1:]]
            return self._slice(arrays[0], starts, params["slice_sizes"])
        if name == "gather":
            return self._gathered(arrays[0], arrays[1], params, out)
        one = np.frompyfunc(lambda *args: self._one(name, args, params, kind), len(arrays), 1)
        return np.asarray(one(*(np.broadcast_to(array, out.shape) for array in arrays)), object)

    def repeated(
        self, once: Callable[[Sequence[Any]], list[Any]], carry: Sequence[Any], length: int
    ) -> list[Any]:
        """A loop as one node; what does not change in it is computed before it."""
        starts = [self.array(value) for value in carry]
        first, like = next(self._count), [one.reshape(-1) for one in starts]
        carried = [
            [self.node("carried", (), node.kind, (first, i, j)) for j, node in enumerate(nodes)]
            for i, nodes in enumerate(like)
        ]
        shaped = [_shaped(mine, one.shape) for mine, one in zip(carried, starts, strict=True)]
        found = [self.array(value).reshape(-1) for value in once(shaped)]
        own = [node for nodes in carried for node in nodes]
        results = [
            self.node("copy", (node,), node.kind) if node in own and node is not mine else node
            for node, mine in zip(itertools.chain(*found), own, strict=True)
        ]
        inside = {node.number for node in own}
        nodes = []
        for node in _needed(results):
            if any(arg.number in inside for arg in node.args):
                inside.add(node.number)
                nodes.append(node)
        free = [arg for node in nodes for arg in node.args] + results
        free = {node.number: node for node in free if node.number not in inside}
        args = [*itertools.chain(*like), *free.values()]
        extra = Loop(length, tuple(own), tuple(results), tuple(nodes))
        loop, place = self.node("loop", args, "array", extra), itertools.count()
        parts = [[self.node("part", (loop,), n.kind, next(place)) for n in row] for row in carried]
        return [_shaped(mine, one.shape) for mine, one in zip(parts, starts, strict=True)]

    def _one(self, name: str, args: Sequence[Node], params: Mapping[str, Any], kind: str) -> Node:
        """One number of an operation that works number by number."""
        first = args[0].kind
        if name == "convert_element_type":
            return args[0] if first == kind else self.node(f"{kind}_of_{first}", args, kind)
        if name == "select_n":
            return self._select(args, kind)
        if name == "clamp":
            low = self._one("max", (args[0], args[1]), params, kind)
            return self._one("min", (low, args[2]), params, kind)
        if name in COMPARISONS:
            return self.node(name, args, "b")
        if name in _LOGICAL:
            return self.node(name if first == "b" else f"i{name}", args, first)
        if name in ("integer_pow", "square"):
            return self._power(args[0], params.get("y", 2))
        if name == "rsqrt":
            one = self.constant(1, "f")
            return self.node("div", (one, self.node("sqrt", args, "f")), "f")
        if name == "round" and first == "f":
            even = int(params["rounding_method"]) == 1
            return self.node("rint" if even else "round", args, "f")
        if first == "i" and name in _WHOLE:
            return self.node(f"i{name}", args, "i")
        if first == "f" and (name in UNARY or name in BINARY):
            return self.node(name, args, kind)
        raise UnsupportedError(name)

    def _select(self, args: Sequence[Node], kind: str) -> Node:
        which, *cases = args
        found = cases[-1]
        for i in reversed(range(len(cases) - 1)):
            if which.kind == "b":
                condition, below = which, cases[0]
            else:
                condition = self.node("gt", (which, self.constant(i, "i")), "b")
                below = cases[i]
            if condition.op == "constant":
                found = found if condition.extra else below
            elif found is not below:
                found = self.node("select", (condition, below, found), kind)
        return found

    def _power(self, x: Node, y: int) -> Node:
        """A whole power by repeated squaring, as XLA takes it."""
        found, square, left = None, x, abs(y)
        while left:
            if left & 1:
                found = square if found is None else self._times(found, square)
            left >>= 1
            square = self._times(square, square) if left else square
        found = found or self.constant(1, x.kind)
        return self.node("div", (self.constant(1, "f"), found), "f") if y < 0 else found

    def _times(self, a: Node, b: Node) -> Node:
        return self.node("mul" if a.kind == "f" else "imul", (a, b), a.kind)

    def _folded(self, name: str, array: np.ndarray, params: Mapping[str, Any], kind: str) -> Any:
        """A reduction, or what it has come to at each place of an axis."""
        fold: Any = np.frompyfunc(lambda a, b: self._one(name, (a, b), {}, kind), 2, 1)
        if "axes" in params:
            kept = [i for i in range(array.ndim) if i not in params["axes"]]
            moved = np.transpose(array, [*kept, *params["axes"]])
            return np.asarray(fold.reduce(moved.reshape(*moved.shape[: len(kept)], -1), -1), object)
        axis = params["axis"]
        if params["reverse"]:
            return np.flip(fold.accumulate(np.flip(array, axis), axis), axis)
        return fold.accumulate(array, axis)

    def _place_of(self, name: str, array: np.ndarray, axis: int) -> np.ndarray:
        """Return the index of the first maximum or minimum, or of the first NaN."""
        rows = np.moveaxis(array, axis, -1)
        found = np.empty(rows.shape[:-1], object)
        for at in np.ndindex(found.shape):
            best, place = rows[at][0], self.constant(0, "i")
            for i, one in enumerate(rows[at][1:], 1):
                better = self.node("gt" if name == "argmax" else "lt", (one, best), "b")
                if one.kind == "f":
                    number = self.node("eq", (best, best), "b")
                    first_nan = self.node("and", (self.node("ne", (one, one), "b"), number), "b")
                    better = self.node("or", (better, first_nan), "b")
                place = self.node("select", (better, place, self.constant(i, "i")), "i")
                best = self.node("select", (better, best, one), one.kind)
            found[at] = place
        return found

    def _slice(self, array: np.ndarray, starts: Sequence[Node], sizes: Sequence[int]) -> np.ndarray:
        """A slice from a place that is known only when it runs, held within the array."""
        windows = np.lib.stride_tricks.sliding_window_view(array, tuple(sizes))
        place = None
        for start, room in zip(starts, windows.shape, strict=False):
            if room > 1:
                held = self.node("imax", (start, self.constant(0, "i")), "i")
                held = self.node("imin", (held, self.constant(room - 1, "i")), "i")
                before = place and self.node("imul", (place, self.constant(room, "i")), "i")
                place = self.node("iadd", (before, held), "i") if before else held
        if place is None:
            return array
        elements = windows.reshape(-1, int(np.prod(sizes, dtype=int))).T
        return _shaped([self.node("take", (place, *x), x[0].kind) for x in elements], sizes)

    def _gathered(
        self, array: np.ndarray, indices: np.ndarray, params: Mapping[str, Any], out: Any
    ) -> np.ndarray:
        """Rows at places that are known only when it runs; NaN outside where JAX fills so."""
        numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
        if numbers.operand_batching_dims:
            raise UnsupportedError("gather in a batch")
        kind, zero = kind_of(out.dtype, "gather"), self.constant(0, "i")
        fill = self.constant({"f": np.nan, "i": -(2**31), "b": True}[kind], kind)
        blocks = []
        for row in indices.reshape(-1, indices.shape[-1]):
            starts, inside = [zero] * array.ndim, []
            for start, dim in zip(row, numbers.start_index_map, strict=True):
                starts[dim] = start
                most = self.constant(array.shape[dim] - sizes[dim], "i")
                inside += [self.node("ge", (start, zero), "b"), self.node("le", (start, most), "b")]
            block = self._slice(array, starts, sizes)
            if "FILL" in str(params["mode"]).upper() and inside:
                within = functools.reduce(lambda a, b: self.node("and", (a, b), "b"), inside)
                chosen = [self.node("select", (within, fill, x), kind) for x in block.reshape(-1)]
                block = _shaped(chosen, block.shape)
            blocks.append(np.squeeze(block, tuple(numbers.collapsed_slice_dims)))
        whole = np.stack(blocks)
        whole = whole.reshape((*indices.shape[:-1], *whole.shape[1:]))
        rest = [i for i in range(len(out.shape)) if i not in numbers.offset_dims]
        return np.moveaxis(whole, range(len(rest)), rest)

    def _product(self, values: Sequence[Any], params: Mapping[str, Any], out: Any) -> np.ndarray:
        """A product of matrices: a loop if one of them is large and constant."""
        (left, right), (batch, _) = params["dimension_numbers"]
        if batch or kind_of(out.dtype, "dot_general") != "f":
            raise UnsupportedError("dot_general in a batch")
        a, b = (
            _with_last(value, axes) if i == 0 else _with_first(value, axes)
            for i, (value, axes) in enumerate(zip(values, (left, right), strict=True))
        )
        found = np.empty((a.shape[0], b.shape[1]), object)
        if is_constant(b) and b.size >= _MANY:
            found[:] = self._loops(self.array(a), b)
        elif is_constant(a) and a.size >= _MANY:
            found.T[:] = self._loops(self.array(b).T, a.T)
        else:
            times: Any = np.frompyfunc(self._times, 2, 1)
            terms = times(self.array(a)[:, :, None], self.array(b)[None])
            found[:] = self._folded("add", terms, {"axes": (1,)}, "f")
        return found.reshape(out.shape)

    def _loops(self, rows: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        """Rows times a matrix, all of them in one loop over it.

        Of a pair (a, b), (b, a), as the learned laws have them, sum and difference take half the
        arithmetic: (a + b) (P + Q) / 2 plus or minus (a - b) (P - Q) / 2 of the halves P and Q.
        """
        matrix = np.ascontiguousarray(matrix, float)
        half, odd = divmod(rows.shape[1], 2)
        if len(rows) == 2 and not odd and (rows[0] == np.roll(rows[1], half)).all():
            add: Any = np.frompyfunc(lambda x, y: self.node("add", (x, y), "f"), 2, 1)
            sub: Any = np.frompyfunc(lambda x, y: self.node("sub", (x, y), "f"), 2, 1)
            (a, b), (p, q) = rows[0].reshape(2, half), matrix.reshape(2, half, -1) / 2
            both, apart = add(a, b)[None], sub(a, b)[None]
            even, odd = self._loops(both, p + q), self._loops(apart, p - q)
            return np.concatenate([add(even, odd), sub(even, odd)])
        key = matrix.tobytes()
        self.tables.setdefault(key, matrix)
        product = self.node("product", tuple(rows.reshape(-1)), "array", key)
        places = np.ndindex(len(rows), matrix.shape[1])
        parts = [self.node("part", (product,), "f", at) for at in places]
        return _shaped(parts, (len(rows), matrix.shape[1]))


def _shaped(nodes: Sequence[Node], shape: Sequence[int]) -> np.ndarray:
    found = np.empty(tuple(shape), object)
    found.reshape(-1)[:] = nodes
    return found


def _needed(
    outputs: Iterable[Node], args_of: Callable[[Node], Sequence[Node]] = lambda node: node.args
) -> list[Node]:
    """Outputs and all that they need, each after what it needs."""
    needed: dict[int, Node] = {}
    waiting = list(outputs)
    while waiting:
        node = waiting.pop()
        if node.number not in needed:
            needed[node.number] = node
            waiting += args_of(node)
    return [needed[number] for number in sorted(needed)]


def _with_last(value: Any, axes: Sequence[int]) -> Any:
    kept = [i for i in range(value.ndim) if i not in axes]
    count = int(np.prod([value.shape[i] for i in axes]))
    return np.transpose(value, [*kept, *axes]).reshape(-1, count)


def _with_first(value: Any, axes: Sequence[int]) -> Any:
    return _with_last(value, axes).T


# --- in which order ------------------------------------------------------------------------


def ordered(outputs: Sequence[Node]) -> list[Node | Block]:
    """What the outputs need, each after what it needs.

    Where a product with a matrix only matters under a condition, all that only matters then is a
    `Block`: a learned law decides five times a second, and its network waits until then.
    """
    nodes = _needed(outputs)
    if not any(node.op == "product" for node in nodes):
        return list(nodes)
    conditions = {node.args[0].number: node.args[0] for node in nodes if node.op == "select"}
    for condition, side in itertools.product(conditions.values(), (2, 1)):
        found = _with_block(nodes, outputs, condition, side)
        if found is not None:
            return found
    return list(nodes)


def _with_block(
    nodes: list[Node], outputs: Sequence[Node], condition: Node, side: int
) -> list[Node | Block] | None:
    """Nodes with a block of all that only matters on one side of a condition, if one can be."""

    def other(node: Node) -> Sequence[Node]:
        """What matters of a node on the other side."""
        chosen = node.op == "select" and node.args[0] is condition
        return (condition, node.args[3 - side]) if chosen else node.args

    always = {node.number for node in _needed(outputs, other)}
    own = [n for n in nodes if n.number not in always and n.op not in ("constant", "input")]
    if not any(node.op == "product" for node in own):
        return None
    inside = {node.number for node in own}
    choices = [n for n in nodes if n.number in always and n.args and other(n) is not n.args
               and n.args[side].number in inside]  # fmt: skip
    block = inside | {node.number for node in choices}
    after: set[int] = set()
    for node in nodes:
        if node.number not in block and any(arg.number in block | after for arg in node.args):
            after.add(node.number)
    if any(arg.number in after for node in (*own, *choices) for arg in node.args):
        return None
    return [
        *(node for node in nodes if node.number not in block | after),
        Block(condition, side == 2, own, choices),
        *(node for node in nodes if node.number in after),
    ]
