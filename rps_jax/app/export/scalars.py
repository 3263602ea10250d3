"""A jaxpr as single numbers, each computed once: what C and JavaScript are written from."""

from __future__ import annotations

import functools
import heapq
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rps_jax.app.export.walk import (
    COMPARISONS,
    CUMULATIVE,
    REDUCTIONS,
    is_constant,
    kind_of,
    unsupported,
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


class Scalars:
    """The target of single numbers; equal ones are one node."""

    def __init__(self) -> None:
        """Begin without nodes."""
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
        if name in REDUCTIONS:
            return self._reduced(REDUCTIONS[name], arrays[0], params["axes"], kind)
        if name in CUMULATIVE:
            return self._running(CUMULATIVE[name], arrays[0], params, kind)
        if name in ("argmax", "argmin"):
            return self._place_of(name, arrays[0], params["axes"][0])
        if name == "dynamic_slice":
            return self._slice(arrays[0], arrays[1:], params["slice_sizes"])
        if name == "gather":
            return self._gathered(arrays[0], arrays[1], params, out)
        found = np.empty(out.shape, object)
        spread = [np.broadcast_to(array, out.shape).reshape(-1) for array in arrays]
        for i, args in enumerate(zip(*spread, strict=True)):
            found.reshape(-1)[i] = self._one(name, args, params, kind)
        return found

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
        raise unsupported(name)

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

    def _reduced(self, name: str, array: np.ndarray, axes: Any, kind: str) -> np.ndarray:
        kept = [i for i in range(array.ndim) if i not in axes]
        moved = np.transpose(array, [*kept, *axes]).reshape(*(array.shape[i] for i in kept), -1)
        found = np.empty(moved.shape[:-1], object)
        for at in np.ndindex(found.shape):
            found[at] = functools.reduce(lambda a, b: self._one(name, (a, b), {}, kind), moved[at])
        return found

    def _running(
        self, name: str, array: np.ndarray, params: Mapping[str, Any], kind: str
    ) -> np.ndarray:
        found = np.moveaxis(array.copy(), params["axis"], 0)
        order = range(1, len(found))
        step = -1 if params["reverse"] else 1
        found = found[::step]
        for i in order:
            for at in np.ndindex(found.shape[1:]):
                found[(i, *at)] = self._one(name, (found[(i - 1, *at)], found[(i, *at)]), {}, kind)
        return np.moveaxis(found[::step], 0, params["axis"])

    def _place_of(self, name: str, array: np.ndarray, axis: int) -> np.ndarray:
        """Where the greatest or the least number is, the first of equal ones."""
        rows = np.moveaxis(array, axis, -1)
        found = np.empty(rows.shape[:-1], object)
        for at in np.ndindex(found.shape):
            best, place = rows[at][0], self.constant(0, "i")
            for i, one in enumerate(rows[at][1:], 1):
                better = self.node("gt" if name == "argmax" else "lt", (one, best), "b")
                place = self.node("select", (better, place, self.constant(i, "i")), "i")
                best = self.node("select", (better, best, one), one.kind)
            found[at] = place
        return found

    def _taken(self, elements: Sequence[Node], place: Node) -> Node:
        """The element at a place that is within them."""
        return self.node("take", (place, *elements), elements[0].kind)

    def _slice(
        self, array: np.ndarray, starts: Sequence[np.ndarray], sizes: Sequence[int]
    ) -> np.ndarray:
        """A slice from a place that is known only when it runs, held within the array."""
        if tuple(sizes) == array.shape:
            return array
        zero = self.constant(0, "i")
        strides = [int(np.prod(array.shape[i + 1 :])) for i in range(array.ndim)]
        most = [length - size for length, size in zip(array.shape, sizes, strict=True)]
        free = [i for i, room in enumerate(most) if room]
        held = {}
        for i in free:
            start = self.node("imax", (starts[i].item(), zero), "i")
            held[i] = self.node("imin", (start, self.constant(most[i], "i")), "i")
        flat, found = array.reshape(-1), np.empty(tuple(sizes), object)
        for at in np.ndindex(found.shape):
            offset = sum(i * stride for i, stride in zip(at, strides, strict=True))
            # The elements that each free place can mean, the last of them varying fastest.
            reach = [offset + strides[i] * np.arange(most[i] + 1) for i in free]
            meant = functools.reduce(lambda a, b: np.add.outer(a, b - offset), reach).reshape(-1)
            place = held[free[0]]
            for i in free[1:]:
                count = self.constant(most[i] + 1, "i")
                place = self.node("iadd", (self.node("imul", (place, count), "i"), held[i]), "i")
            found[at] = self._taken(list(flat[meant]), place)
        return found

    def _gathered(
        self, array: np.ndarray, indices: np.ndarray, params: Mapping[str, Any], out: Any
    ) -> np.ndarray:
        """Rows at places that are known only when it runs; NaN outside where JAX fills so."""
        numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
        mode = str(params["mode"]).rsplit(".", maxsplit=1)[-1].upper()
        if numbers.operand_batching_dims:
            raise unsupported("gather in a batch")
        rest = [i for i in range(len(out.shape)) if i not in numbers.offset_dims]
        found = np.empty(out.shape, object)
        for batch in np.ndindex(indices.shape[:-1]):
            zero = np.array(self.constant(0, "i"), object)
            starts = [zero] * array.ndim
            inside = None
            for i, dim in enumerate(numbers.start_index_map):
                start = indices[(*batch, i)]
                starts[dim] = np.array(start, object)
                most = self.constant(array.shape[dim] - sizes[dim], "i")
                low = self.node("ge", (start, self.constant(0, "i")), "b")
                ok = self.node("and", (low, self.node("le", (start, most), "b")), "b")
                inside = ok if inside is None else self.node("and", (inside, ok), "b")
            block = self._slice(array, starts, sizes)
            block = np.squeeze(block, tuple(numbers.collapsed_slice_dims))
            if "FILL" in mode and inside is not None:
                kind = kind_of(out.dtype, "gather")
                fill = self.constant({"f": np.nan, "i": -(2**31), "b": True}[kind], kind)
                outside = [self.node("select", (inside, fill, x), kind) for x in block.reshape(-1)]
                filled = np.empty(block.size, object)
                filled[:] = outside
                block = filled.reshape(block.shape)
            place: list[Any] = [slice(None)] * len(out.shape)
            for axis, at in zip(rest, batch, strict=True):
                place[axis] = at
            found[tuple(place)] = block if block.ndim else block.item()
        return found

    def _product(self, values: Sequence[Any], params: Mapping[str, Any], out: Any) -> np.ndarray:
        """A product of matrices: a loop if one of them is large and constant."""
        (left, right), (batch, _) = params["dimension_numbers"]
        if batch or kind_of(out.dtype, "dot_general") != "f":
            raise unsupported("dot_general in a batch")
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
            a, b = self.array(a), self.array(b)
            for i, j in np.ndindex(found.shape):
                terms = [self._times(x, y) for x, y in zip(a[i], b[:, j], strict=True)]
                found[i, j] = functools.reduce(lambda x, y: self.node("add", (x, y), "f"), terms)
        return found.reshape(out.shape)

    def _loops(self, rows: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        """Rows times a matrix, all of them in one loop over it."""
        matrix = np.ascontiguousarray(matrix, float)
        key = matrix.tobytes()
        self.tables.setdefault(key, matrix)
        product = self.node("product", tuple(rows.reshape(-1)), "array", key)
        places = np.ndindex(len(rows), matrix.shape[1])
        parts = [self.node("part", (product,), "f", at) for at in places]
        return _shaped(parts, (len(rows), matrix.shape[1]))


def _shaped(nodes: Sequence[Node], shape: tuple[int, ...]) -> np.ndarray:
    found = np.empty(shape, object)
    found.reshape(-1)[:] = nodes
    return found


def _needed(outputs: Iterable[Node]) -> list[Node]:
    """Outputs and all that they need, each after what it needs."""
    needed: dict[int, Node] = {}
    waiting = list(outputs)
    while waiting:
        node = waiting.pop()
        if node.number not in needed:
            needed[node.number] = node
            waiting += node.args
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
    block = _conditional(nodes, {node.number for node in outputs})
    if block is None:
        return list(nodes)
    return _sorted(nodes, block) or list(nodes)


def _conditional(nodes: list[Node], outputs: set[int]) -> Block | None:
    """The block of a condition, if there is one with a product of a matrix."""
    if not any(node.op == "product" for node in nodes):
        return None
    users: dict[int, list[Node]] = {}
    for node in nodes:
        for arg in node.args:
            users.setdefault(arg.number, []).append(node)
    conditions = {node.args[0].number: node.args[0] for node in nodes if node.op == "select"}
    for condition, side in itertools.product(conditions.values(), (2, 1)):
        inside: set[int] = set()

        def only_then(
            node: Node, condition: Node = condition, side: int = side, inside: set[int] = inside
        ) -> bool:
            return all(
                user.number in inside
                or (
                    user.op == "select"
                    and user.args[0] is condition
                    and user.args[side] is node
                    and user.args[3 - side] is not node
                )
                for user in users[node.number]
            )

        for node in reversed(nodes):
            movable = node.op not in ("constant", "input") and node.number not in outputs
            if movable and users.get(node.number) and only_then(node):
                inside.add(node.number)
        if any(node.op == "product" and node.number in inside for node in nodes):
            chosen = [
                n
                for n in nodes
                if n.op == "select"
                and n.args[0] is condition
                and n.args[side].number in inside
                and n.number not in inside
            ]
            return Block(condition, side == 2, [n for n in nodes if n.number in inside], chosen)
    return None


def _sorted(nodes: list[Node], block: Block) -> list[Node | Block]:
    """Nodes and the block, each after what it needs; nothing if they need each other."""
    within = {node.number for node in (*block.nodes, *block.choices)}
    alone = -1  # the block's number
    needs: dict[int, set[int]] = {alone: set()}
    for node in nodes:
        mine = needs.setdefault(alone if node.number in within else node.number, set())
        mine |= {alone if arg.number in within else arg.number for arg in node.args}
    needs[alone].discard(alone)
    of, users = {node.number: node for node in nodes}, {}
    for number, theirs in needs.items():
        for other in theirs:
            users.setdefault(other, []).append(number)
    ready = [number for number, theirs in needs.items() if not theirs]
    heapq.heapify(ready)
    found: list[Node | Block] = []
    while ready:
        number = heapq.heappop(ready)
        found.append(block if number == alone else of[number])
        for user in users.get(number, ()):
            needs[user].discard(number)
            if not needs[user]:
                heapq.heappush(ready, user)
    return found if len(found) == len(needs) else []
