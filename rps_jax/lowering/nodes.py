"""A pure function of one world as C, in which 8 or 16 worlds are computed at once, a lane each.

Values are arrays of vectors, a lane for each world. What works number by number on arrays of one
size stands in one loop over their numbers; a loop that ends when a condition fails goes on until it
has failed in every lane, and a lane in which it has is left as it is. So a world's numbers do not
depend on the other lanes.
"""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rps_jax.lowering.walk import (
    PAIRED,
    Target,
    TooLargeError,
    UnsupportedError,
    is_constant,
    kind_of,
    walk,
)

_HERE = Path(__file__).parent
OPERATIONS = (_HERE / "operations.h").read_text()
PRELUDE = (_HERE / "xla_call.h").read_text()
HEADER = PRELUDE + (_HERE / "simd.h").read_text() + OPERATIONS
THREADS = (_HERE / "gpu.h").read_text() + OPERATIONS
# Kinds of numbers for which each macro of the header writes an operation.
_WRITTEN = {"INFIX": "fiu", "COMPARE": "fiub", "BITS": "iub", "EACH": "f", "EACH_OF_TWO": "f"}
_KNOWN = set(re.findall(r"^FUNCTION \w+ (\w+)\(", HEADER, re.M)) | {
    f"{name}_{kind}"
    for macro, kinds in _WRITTEN.items()
    for name in re.findall(rf"^{macro}\((\w+)", HEADER, re.M)
    for kind in kinds
}
# Where a reduction begins, by its operation and kind.
STARTS = {
    **{("add", "f"): 0.0, ("add", "i"): 0, ("max", "f"): -np.inf, ("min", "f"): np.inf},
    **{("max", "i"): -(2**31), ("min", "i"): 2**31 - 1, ("and", "b"): True, ("or", "b"): False},
}
_MOST_PRODUCTS = 256  # of numbers, in one product of matrices
_DTYPES = {"f": "float32", "i": "int32", "u": "uint32", "b": "bool"}


@dataclass(eq=False)
class Node:
    """An array of vectors, and how its numbers are made; or a loop, which makes several."""

    number: int
    op: str
    args: tuple[Any, ...]  # of `Array` and constants
    kind: str
    size: int
    extra: Any = None
    inner: tuple[Node, ...] = ()  # of a loop: what it computes, in any order that suits
    free: tuple[Node, ...] = ()  # of a loop: what it takes from outside

    @property
    def name(self) -> str:
        """In C."""
        return f"v{self.number}"

    @property
    def after(self) -> Iterable[Node]:
        """What must be there before it is."""
        return itertools.chain((a.node for a in self.args if isinstance(a, Array)), self.free)

    @property
    def width(self) -> int:
        """How many numbers it holds."""
        return 1 if self.op.startswith("fold") else self.size

    @property
    def alone(self) -> bool:
        """Whether it stands in no loop over its numbers."""
        return self.size < 2 or self.op in ("move", "take", "while", "for", "given", "part")

    @functools.cached_property
    def entire(self) -> set[Node]:
        """Of these what must be there with all its numbers, not only the one in turn."""
        arrays = [a for a in self.args if isinstance(a, Array)]
        in_turn = set() if self.alone else {a.node for a in arrays if self.in_turn(a)}
        return {a.node for a in arrays} - in_turn | set(self.free)

    def in_turn(self, a: Array) -> bool:
        """Whether it takes the numbers of an array one by one as it makes its own."""
        return a.step == 1 and a.first == 0 and a.node.width == self.size


class Array(NamedTuple):
    """Numbers of a node: from the `first` on, or that one again and again (`step` 0)."""

    node: Node
    first: int
    step: int
    shape: tuple[int, ...]

    @property
    def dtype(self) -> Any:
        """As JAX has it."""
        return np.dtype(_DTYPES[self.node.kind])


class Loop(NamedTuple):
    """What a loop carries."""

    carried: tuple[Node, ...]
    results: tuple[Any, ...]  # what they become in one turn
    holds: Any  # whether it goes on
    length: int | None  # how often, if that is known


def size_of(shape: Sequence[int]) -> int:
    """How many numbers."""
    return int(np.prod(shape, dtype=int))


class SimdNodes(Target):
    """The target of a jaxpr of one world: nodes, of which equal ones are one."""

    compiler = "the native compiler"
    kinds = "fibu"

    def __init__(self) -> None:
        """Begin without nodes."""
        self._count = itertools.count()
        self._known: list[dict[Any, Node]] = [{}]

    def node(self, op: str, args: Sequence[Any], kind: str, size: int, extra: Any = None) -> Node:
        """The node of an operation, new or known."""
        key = (op, tuple(map(_key, args)), kind, size, extra)
        for known in self._known:
            if key in known:
                return known[key]
        made = Node(next(self._count), op, tuple(args), kind, size, extra)
        self._known[-1][key] = made
        return made

    def given(self, place: int, shape: tuple[int, ...], dtype: Any) -> Array:
        """An argument."""
        kind, size = kind_in(dtype, "an argument"), size_of(shape)
        return Array(self.node("given", (), kind, size, place), 0, 1, shape)

    def moved(self, values: Sequence[Any], places: np.ndarray, like: Any) -> Any:
        """Numbers at other places: a view of a node where that is all."""
        starts = np.cumsum([0, *(size_of(np.shape(v)) for v in values)])
        flat = places.reshape(-1)
        if not flat.size:
            return np.zeros(places.shape, like.dtype)
        which = np.searchsorted(starts, flat, "right") - 1
        sources = [_pick(values[i], int(at - starts[i])) for i, at in zip(which, flat, strict=True)]
        if all(not isinstance(one, Array) for one in sources):
            return np.asarray(sources, like.dtype).reshape(places.shape)
        one, two = sources[0], sources[min(1, len(sources) - 1)]
        if all(isinstance(s, Array) and s.node is one.node for s in sources):
            firsts = np.array([s.first for s in sources])
            step = two.first - one.first
            if step in (0, 1) and (firsts == one.first + step * np.arange(len(firsts))).all():
                return Array(one.node, one.first, step if len(firsts) > 1 else 1, places.shape)
        made = self.node("move", sources, kind_in(like.dtype, "move"), flat.size)
        return Array(made, 0, 1, places.shape)

    def emit(self, name: str, values: Sequence[Any], params: Mapping[str, Any], out: Any) -> Any:
        """Apply a primitive."""
        kind, size = kind_in(out.dtype, name), size_of(out.shape)
        first = kind_in(values[0].dtype, name)
        if not size:
            return np.zeros(out.shape, out.dtype)
        if name in PAIRED and "axes" in params:
            return self._folded(PAIRED[name], values[0], params["axes"], kind, out)
        if name == "dynamic_slice":
            return self._slice(values[0], values[1:], params["slice_sizes"], kind)
        if name in ("argmax", "argmin"):
            return self._furthest(name, values[0], params["axes"][0], out)
        if name == "dot_general":
            return self._product(values[0], values[1], params["dimension_numbers"], out)
        if name == "clamp":
            return self.emit("min", [self.emit("max", values[1::-1], {}, out), values[2]], {}, out)
        if name == "integer_pow":
            return self._power(values[0], params["y"], out)
        if name == "select_n" and first == "b" and len(values) == 3:
            op, values = f"choose_{kind}", [values[0], values[2], values[1]]
        elif name == "convert_element_type":
            if first == kind:
                return values[0]
            op = f"{kind}_of_{first}"
        elif name == "bitcast_convert_type":
            op = f"bits_{kind}_of_{first}"
        elif name == "round" and int(params["rounding_method"]) == 1:
            op = "rint_f"
        else:
            op = f"{name}_{first}"
        if op not in _KNOWN:
            raise UnsupportedError(name)
        return self._made(op, values, kind, out.shape)

    def _made(self, op: str, values: Sequence[Any], kind: str, shape: tuple[int, ...]) -> Array:
        size, args = size_of(shape), []
        for value in values:
            mine = np.shape(value)
            if mine != shape and size_of(mine) > 1:
                places = np.broadcast_to(np.arange(size_of(mine)).reshape(mine), shape)
                value = self.moved([value], places, value)
            args.append(flat(value, size))
        return Array(self.node(op, args, kind, size), 0, 1, shape)

    def _power(self, x: Any, y: int, out: Any) -> Any:
        """A whole power by repeated squaring, as XLA takes it."""
        found, square, left = None, x, abs(y)
        while left:
            if left & 1:
                found = square if found is None else self.emit("mul", [found, square], {}, out)
            left >>= 1
            square = self.emit("mul", [square, square], {}, out) if left else square
        one = np.ones(out.shape, out.dtype)
        found = one if found is None else found
        return self.emit("div", [one, found], {}, out) if y < 0 else found

    def _folded(self, pair: str, value: Any, axes: Sequence[int], kind: str, out: Any) -> Any:
        """A reduction: of all numbers beside what else loops over them, else row by row."""
        shape = np.shape(value)
        if len(axes) == len(shape) and size_of(shape) > 1 and (pair, kind) in STARTS:
            size, op = size_of(shape), f"fold {pair}_{kind}"
            return Array(self.node(op, [flat(value, size)], kind, size), 0, 0, ())
        kept = [i for i in range(len(shape)) if i not in axes]
        places = np.transpose(np.arange(size_of(shape)).reshape(shape), [*axes, *kept])
        rows = places.reshape(-1, *out.shape)
        found = self.moved([value], rows[0], out)
        for row in rows[1:]:
            found = self.emit(pair, [found, self.moved([value], row, out)], {}, out)
        return found

    def _furthest(self, name: str, value: Any, axis: int, out: Any) -> Any:
        """The first place of the greatest or least of an axis, or of the first that is none."""
        shape = np.shape(value)
        rows = np.moveaxis(np.arange(size_of(shape)).reshape(shape), axis, 0)
        like, yes = np.empty(out.shape, value.dtype), np.empty(out.shape, bool)
        best, found = self.moved([value], rows[0], like), np.zeros(out.shape, out.dtype)
        for k, row in enumerate(rows[1:], 1):
            one = self.moved([value], row, like)
            better = self.emit("gt" if name == "argmax" else "lt", [one, best], {}, yes)
            if value.node.kind == "f":
                lost = self.emit("eq", [best, best], {}, yes)
                none = self.emit("and", [self.emit("ne", [one, one], {}, yes), lost], {}, yes)
                better = self.emit("or", [better, none], {}, yes)
            best = self.emit("select_n", [better, best, one], {}, like)
            at = np.full(out.shape, k, out.dtype)
            found = self.emit("select_n", [better, found, at], {}, out)
        return found

    def _product(self, left: Any, right: Any, dimensions: Any, out: Any) -> Any:
        """A product of matrices: of one, rows at a time, sums over the numbers of the other."""
        (of_left, of_right), (with_left, with_right) = dimensions
        sides = [
            (left, _rows(left, with_left, of_left)),
            (right, _rows(right, with_right, of_right)),
        ]
        sizes = [places.shape[1] for _, places in sides]
        if size_of(out.shape) * sides[0][1].shape[2] > _MOST_PRODUCTS:
            raise TooLargeError("XLA compiles large products of matrices to faster code.")
        # In one loop goes what is constant, else the longer.
        known = [is_constant(value) for value, _ in sides]
        long = known.index(True) if any(known) else int(sizes[1] > sizes[0])
        (many, ways), (few, single) = sides[long], sides[1 - long]
        like = np.empty(sizes[long], out.dtype)
        parts = []
        for batch, turn in np.ndindex(*single.shape[:2]):
            found = None
            for k in range(single.shape[2]):
                pair = [
                    self._at(many, ways[batch, :, k], like),
                    self._at(few, np.full(like.shape, single[batch, turn, k]), like),
                ]
                term = self.emit("mul", pair, {}, like)
                found = term if found is None else self.emit("add", [found, term], {}, like)
            parts.append(np.zeros_like(like) if found is None else found)
        places = np.arange(size_of(out.shape)).reshape(*single.shape[:2], sizes[long])
        if long == 0:  # of left, whose rows come before those of right
            places = places.swapaxes(1, 2)
        return self.moved(parts, places.reshape(out.shape), out)

    def _at(self, value: Any, places: np.ndarray, like: Any) -> Any:
        """Numbers of a value, at constant places."""
        if is_constant(value):
            return np.reshape(value, -1)[places]
        return self.moved([value], places, like)

    def _slice(self, value: Any, starts: Sequence[Any], sizes: Sequence[int], kind: str) -> Any:
        """A slice from a place that differs between worlds, held within the array."""
        shape = np.shape(value)
        numbers = np.arange(size_of(shape)).reshape(shape)
        windows = np.lib.stride_tricks.sliding_window_view(numbers, tuple(sizes))
        place: Any = np.zeros((), np.int32)
        like = place
        for start, room in zip(starts, windows.shape, strict=False):
            held = like
            if room > 1:
                held = self.emit("max", [start, like], {}, like)
                held = self.emit("min", [held, np.asarray(room - 1, np.int32)], {}, like)
            place = self.emit("mul", [place, np.asarray(room, np.int32)], {}, like)
            place = self.emit("add", [place, held], {}, like)
        table = windows.reshape(-1, size_of(sizes))
        if is_constant(value):
            made = self.node("move", list(np.reshape(value, -1)), kind, value.size)
            value = Array(made, 0, 1, shape)
        if value.step != 1 or value.node.size == 1:
            return self.moved([value], windows[(0,) * len(shape)], like)
        extra = tuple(map(tuple, (table + value.first).tolist()))
        made = self.node("take", [flat(place, 1), value], kind, table.shape[1], extra)
        return Array(made, 0, 1, tuple(sizes))

    # --- loops ---

    def repeated(
        self, once: Callable[[Sequence[Any]], list[Any]], carry: Sequence[Any], length: int
    ) -> list[Any]:
        """A loop of a known length."""
        return self._loop(None, once, carry, length)

    def repeated_while(
        self,
        holds: Callable[[Sequence[Any]], list[Any]],
        once: Callable[[Sequence[Any]], list[Any]],
        carry: Sequence[Any],
    ) -> list[Any]:
        """A loop that each lane leaves in its own turn."""
        return self._loop(holds, once, carry, None)

    def _loop(self, holds: Any, once: Any, carry: Sequence[Any], length: int | None) -> list[Any]:
        kinds = [kind_in(one.dtype, "a loop") for one in carry]
        carried = [
            Node(next(self._count), "carried", (), kind, size_of(np.shape(one)))
            for kind, one in zip(kinds, carry, strict=True)
        ]
        now: list[Any] = [
            Array(node, 0, 1, np.shape(one)) if node.size else one
            for node, one in zip(carried, carry, strict=True)
        ]
        self._known.append({})
        (goes,) = holds(now) if holds else (None,)
        results = []
        for node, value in zip(carried, once(now), strict=True):
            value = flat(value, node.size) if node.size else value
            if isinstance(value, Array) and value.node in carried and value.node is not node:
                kept = [_pick(value, i) for i in range(node.size)]
                value = Array(self.node("move", kept, node.kind, node.size), 0, 1, value.shape)
            results.append(value)
        self._known.pop()
        goes = None if goes is None else flat(goes, 1)
        made = [a.node for a in (*results, goes) if isinstance(a, Array)]
        inside, reach = set(carried), reached(made)
        inner = []
        for node in reach:  # in the order in which they were made
            if node in inside or any(one in inside for one in node.after):
                inside.add(node)
                inner += [node] if node.op != "carried" else []
        free = {one for node in inner for one in node.after} | set(made)
        starts = [flat(one, size_of(np.shape(one))) for one in carry]
        loop = Node(
            next(self._count), "for" if length else "while", tuple(starts), "f", 0,
            Loop(tuple(carried), tuple(results), goes, length), tuple(inner), tuple(free - inside),
        )  # fmt: skip
        found = []
        for node, one in zip(carried, carry, strict=True):
            part = Node(next(self._count), "part", (), node.kind, node.size, node, free=(loop,))
            found.append(Array(part, 0, 1, np.shape(one)) if node.size else one)
        return found


class Result(NamedTuple):
    """A result that has numbers, and its place among all results."""

    place: int
    value: Any  # `Array`, or a constant
    size: int
    kind: str


def results(
    closed: Any, shapes: Sequence[Any], outs: Sequence[Any], target: SimdNodes
) -> tuple[list[Result], list[Node]]:
    """Results of a closed jaxpr of arguments of these shapes and types, and the nodes of them."""
    given = [
        target.given(i, x.shape, x.dtype) if size_of(x.shape) else np.zeros(x.shape, x.dtype)
        for i, x in enumerate(shapes)
    ]
    found = []
    for i, (one, like) in enumerate(zip(walk(closed, given, target), outs, strict=True)):
        if size := size_of(like.shape):
            found.append(Result(i, flat(one, size), size, kind_in(like.dtype, "a result")))
    return found, [each.value.node for each in found if isinstance(each.value, Array)]


def kind_in(dtype: Any, name: str) -> str:
    """The kind of a type that has a vector; InputError names what has none."""
    kind = kind_of(np.dtype(dtype), name, SimdNodes.kinds)
    if np.dtype(dtype).itemsize != (1 if kind == "b" else 4):
        raise UnsupportedError(f"{name} of {dtype}")
    return kind


def _rows(value: Any, batch: Sequence[int], summed: Sequence[int]) -> np.ndarray:
    """Places of an operand of a product of matrices: (batch, rows, what is summed over)."""
    shape = np.shape(value)
    free = [i for i in range(len(shape)) if i not in (*batch, *summed)]
    places = np.arange(size_of(shape)).reshape(shape).transpose([*batch, *free, *summed])
    sizes = [size_of([shape[i] for i in some]) for some in (batch, free, summed)]
    return places.reshape(sizes)


def _key(value: Any) -> Any:
    if isinstance(value, Array):
        return (value.node.number, value.first, value.step)
    return np.asarray(value).tobytes(), np.asarray(value).dtype.str


def _pick(value: Any, at: int) -> Any:
    """One number of a value."""
    if isinstance(value, Array):
        return Array(value.node, value.first + value.step * at, 1, ())
    return np.asarray(value).reshape(-1)[at]


def flat(value: Any, size: int) -> Any:
    """A value as an operand of an operation on `size` numbers."""
    if isinstance(value, Array):
        many = size_of(value.shape)
        return value._replace(shape=(size,), step=value.step if many == size else 0)
    array = np.ascontiguousarray(value).reshape(-1)
    return array[:1] if len({x.tobytes() for x in array}) == 1 else array


def reached(nodes: Iterable[Node]) -> list[Node]:
    """Nodes and all that they need, as they were made."""
    found: dict[int, Node] = {}
    waiting = list(nodes)
    while waiting:
        node = waiting.pop()
        if node.number not in found:
            found[node.number] = node
            waiting += node.after
    return [found[number] for number in sorted(found)]
