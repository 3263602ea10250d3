"""A pure function of one world as C, in which 8 or 16 worlds are computed at once, a lane each.

Values are arrays of vectors, a lane for each world. What works number by number on arrays of one
size stands in one loop over their numbers; a loop that ends when a condition fails goes on until it
has failed in every lane, and a lane in which it has is left as it is. So a world's numbers do not
depend on the other lanes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from rps_jax.engines.walk import PAIRED, is_constant, kind_of, unsupported, walk

HANDLER = "rps_lanes"  # what its name is replaced by is known to XLA
_TYPES = {"f": "V", "i": "I", "u": "U", "b": "I"}  # of a vector
_STORED = {"f": "float", "i": "int", "u": "unsigned", "b": "unsigned char"}  # of a world's number
_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "and": "&", "or": "|", "xor": "^"}
_INFIX |= {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
# Operations on real numbers that C has for one number, by its name for them.
_EACH = {
    **{name: name for name in ("exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh")},
    **{name: name for name in ("cosh", "asinh", "acosh", "atanh", "tanh", "log1p", "expm1")},
    **{name: name for name in ("cbrt", "floor", "ceil", "exp2", "erf", "erf_inv", "sqrt")},
    **{"atan2": "atan2", "pow": "pow", "rem": "fmod"},
}
# Forms of what is neither, by its name and the kind of its first operand.
_FORMS = {
    **{"neg f": "-{0}", "neg i": "-{0}", "neg u": "-{0}", "not b": "~{0}", "not i": "~{0}"},
    **{"abs f": "abs_f({0})", "abs i": "max_i({0}, -{0})", "rsqrt f": "1.0f / each_sqrt({0})"},
    **{"max f": "max_f({0}, {1})", "min f": "min_f({0}, {1})", "sign f": "sign_f({0})"},
    **{"max i": "max_i({0}, {1})", "min i": "min_i({0}, {1})", "square f": "{0} * {0}"},
    **{"div i": "div_i({0}, {1})", "rem i": "rem_i({0}, {1})", "is_finite f": "finite_f({0})"},
    **{"logistic f": "1.0f / (1.0f + each_exp(-{0}))", "f of i": "__builtin_convertvector({0}, V)"},
    **{"f of u": "__builtin_convertvector({0}, V)", "i of f": "i_of_f({0})", "i of b": "-{0}"},
    **{"f of b": "(V)({0} & (I)all_f(1.0f))", "b of f": "{0} != 0.0f", "b of i": "{0} != 0"},
    **{"u of i": "(U){0}", "i of u": "(I){0}", "u of b": "(U)-{0}"},
    **{"shift_right_logical u": "right_u({0}, {1})", "shift_left u": "left_u({0}, {1})"},
    **{f"threefry2x32_{i} u": f"threefry({{0}}, {{1}}, {{2}}, {{3}}, {i})" for i in (0, 1)},
}
_START = {"add": {"f": "0.0f", "i": "0", "u": "0u"}, "mul": {"f": "1.0f", "i": "1", "u": "1u"},
          "max": {"f": "-INFINITY", "i": "-2147483647 - 1"}, "and": {"b": "-1"},
          "min": {"f": "INFINITY", "i": "2147483647"}, "or": {"b": "0"}}  # fmt: skip

_HEAD = """\
#include <math.h>
#include <stdint.h>
#include "xla/ffi/api/c_api.h"

#ifdef __AVX512F__
#define LANES 16
#else
#define LANES 8
#endif
#define FUNCTION static inline __attribute__((always_inline))
typedef float V __attribute__((vector_size(4 * LANES)));
typedef int32_t I __attribute__((vector_size(4 * LANES)));
typedef uint32_t U __attribute__((vector_size(4 * LANES)));

FUNCTION V all_f(float x) { return x - (V){0}; }
FUNCTION I all_i(int32_t x) { return x - (I){0}; }
FUNCTION U all_u(uint32_t x) { return x - (U){0}; }
FUNCTION I any(I m) {
  int32_t found = 0;
  for (int l = 0; l < LANES; l++) found |= m[l];
  return all_i(found);
}
FUNCTION V choose_f(I m, V a, V b) { return (V)((m & (I)a) | (~m & (I)b)); }
FUNCTION I choose_i(I m, I a, I b) { return (m & a) | (~m & b); }
FUNCTION U choose_u(I m, U a, U b) { return ((U)m & a) | (~(U)m & b); }
#define choose_b choose_i
#define EACH(name, of) \\
  FUNCTION V each_##name(V x) { \\
    V found; \\
    for (int l = 0; l < LANES; l++) found[l] = of(x[l]); \\
    return found; \\
  }
#define EACH_OF_TWO(name, of) \\
  FUNCTION V each_##name(V x, V y) { \\
    V found; \\
    for (int l = 0; l < LANES; l++) found[l] = of(x[l], y[l]); \\
    return found; \\
  }
FUNCTION V abs_f(V x) { return (V)((I)x & 0x7fffffff); }
/* As JAX has them: NaN goes on, and no whole number overflows. */
FUNCTION V max_f(V a, V b) { return choose_f((a >= b) | (a != a), a, b); }
FUNCTION V min_f(V a, V b) { return choose_f((a <= b) | (a != a), a, b); }
FUNCTION V sign_f(V x) {
  return choose_f(x > 0.0f, all_f(1.0f), choose_f(x < 0.0f, all_f(-1.0f), x));
}
FUNCTION I finite_f(V x) { return abs_f(x) < INFINITY; }
FUNCTION I max_i(I a, I b) { return choose_i(a > b, a, b); }
FUNCTION I min_i(I a, I b) { return choose_i(a < b, a, b); }
FUNCTION I div_i(I a, I b) {
  I none = b == 0, minus = b == -1;
  return choose_i(none, all_i(-1), choose_i(minus, -a, a / choose_i(none | minus, all_i(1), b)));
}
FUNCTION I rem_i(I a, I b) {
  return choose_i(b == 0, a, a % choose_i((b == 0) | (b == -1), all_i(1), b));
}
FUNCTION I i_of_f(V x) {
  V held = min_f(max_f(choose_f(x == x, x, all_f(0.0f)), all_f(-2147483648.0f)),
      all_f(2147483520.0f));
  return choose_i(x >= 2147483648.0f, all_i(2147483647), __builtin_convertvector(held, I));
}
FUNCTION U right_u(U x, U by) { return choose_u((I)(by < 32u), x >> (by & 31u), all_u(0u)); }
FUNCTION U left_u(U x, U by) { return choose_u((I)(by < 32u), x << (by & 31u), all_u(0u)); }
FUNCTION U turned(U x, int by) { return (x << by) | (x >> (32 - by)); }
/* One of the two words of the block cipher Threefry, by which JAX draws. */
FUNCTION U threefry(U key, U other, U x, U y, int which) {
  static const int turns[8] = {13, 15, 26, 6, 17, 29, 16, 24};
  const U keys[3] = {key, other, key ^ other ^ 0x1BD11BDAu};
  x += keys[0];
  y += keys[1];
  for (int i = 0; i < 5; i++) {
    for (int j = 0; j < 4; j++) {
      x += y;
      y = turned(y, turns[4 * (i & 1) + j]) ^ x;
    }
    x += keys[(i + 1) % 3];
    y += keys[(i + 2) % 3] + (uint32_t)(i + 1);
  }
  return which ? y : x;
}
/* Giles's approximation, as XLA has it. */
FUNCTION float erf_inv(float x) {
  static const float near[9] = {2.81022636e-08f, 3.43273939e-07f, -3.5233877e-06f,
      -4.39150654e-06f, 0.00021858087f, -0.00125372503f, -0.00417768164f, 0.246640727f,
      1.50140941f};
  static const float far[9] = {-0.000200214257f, 0.000100950558f, 0.00134934322f,
      -0.00367342844f, 0.00573950773f, -0.0076224613f, 0.00943887047f, 1.00167406f, 2.83297682f};
  float w = -log1pf(-x * x);
  const float *terms = w < 5.0f ? near : far;
  w = w < 5.0f ? w - 2.5f : sqrtf(w) - 3.0f;
  float found = terms[0];
  for (int i = 1; i < 9; i++) found = terms[i] + found * w;
  return fabsf(x) == 1.0f ? x * INFINITY : found * x;
}
"""

# Placeholders in capitals are lines that are written for a function.
_BODY = """\
{EACH}
{TABLES}
static void some(void **given, void **found, int64_t first, int64_t worlds) {{
  int64_t at[LANES];
  for (int l = 0; l < LANES; l++) at[l] = first + l < worlds ? first + l : worlds - 1;
{LINES}
}}

XLA_FFI_Error *{NAME}(XLA_FFI_CallFrame *frame) {{
  XLA_FFI_Extension_Base *asks = frame->extension_start;
  if (asks && asks->type == XLA_FFI_Extension_Metadata) {{
    XLA_FFI_Metadata *metadata = ((XLA_FFI_Metadata_Extension *)asks)->metadata;
    metadata->api_version.major_version = XLA_FFI_API_MAJOR;
    metadata->api_version.minor_version = XLA_FFI_API_MINOR;
    return 0;
  }}
  void *given[{COUNT}], *found[{FOUND}];
  for (int i = 0; i < {COUNT}; i++) given[i] = ((XLA_FFI_Buffer *)frame->args.args[i])->data;
  for (int i = 0; i < {FOUND}; i++) found[i] = ((XLA_FFI_Buffer *)frame->rets.rets[i])->data;
  XLA_FFI_Buffer *one = frame->args.args[{ONE}];
  int64_t worlds = 1;
  for (int i = 0; i < one->rank; i++) worlds *= one->dims[i];
  worlds /= {SIZE};
  for (int64_t first = 0; first < worlds; first += LANES) some(given, found, first, worlds);
  return 0;
}}
"""


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
    free: tuple[Node, ...] = field(default=())  # of a loop: what it takes from outside

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

    @property
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
        return np.dtype({"f": "float32", "i": "int32", "u": "uint32", "b": "bool"}[self.node.kind])


class Loop(NamedTuple):
    """What a loop carries."""

    carried: tuple[Node, ...]
    results: tuple[Any, ...]  # what they become in one turn
    holds: Any  # whether it goes on
    length: int | None  # how often, if that is known


def _size(shape: Sequence[int]) -> int:
    return int(np.prod(shape, dtype=int))


class Lanes:
    """The target of a jaxpr of one world: nodes, of which equal ones are one."""

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
        kind, size = _kind(dtype, "an argument"), _size(shape)
        return Array(self.node("given", (), kind, size, place), 0, 1, shape)

    def moved(self, values: Sequence[Any], places: np.ndarray, like: Any) -> Any:
        """Numbers at other places: a view of a node where that is all."""
        starts = np.cumsum([0, *(_size(np.shape(v)) for v in values)])
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
        made = self.node("move", sources, _kind(like.dtype, "move"), flat.size)
        return Array(made, 0, 1, places.shape)

    def emit(self, name: str, values: Sequence[Any], params: Mapping[str, Any], out: Any) -> Any:
        """Apply a primitive."""
        kind, size = _kind(out.dtype, name), _size(out.shape)
        first = _kind(values[0].dtype, name)
        if not size:
            return np.zeros(out.shape, out.dtype)
        if name in PAIRED and "axes" in params:
            return self._folded(PAIRED[name], values[0], params["axes"], kind, out)
        if name == "dynamic_slice":
            return self._slice(values[0], values[1:], params["slice_sizes"], kind)
        if name == "clamp":
            return self.emit("min", [self.emit("max", values[1::-1], {}, out), values[2]], {}, out)
        if name == "integer_pow":
            return self._power(values[0], params["y"], out)
        if name == "select_n" and first == "b" and len(values) == 3:
            op, values = f"choose {kind}", [values[0], values[2], values[1]]
        elif name == "convert_element_type":
            if first == kind:
                return values[0]
            op = f"{kind} of {first}"
        elif name == "bitcast_convert_type":
            op = f"bits {kind}"
        elif name == "round":
            op = "each rint" if int(params["rounding_method"]) == 1 else "each round"
        elif name in _INFIX and (first != "b" or name in ("and", "or", "xor", "eq", "ne")) and (
            name != "div" or first == "f"):
            op = f"infix {name}"
        elif first == "f" and name in _EACH:
            op = f"each {name}"
        elif f"{name} {first}" in _FORMS:
            op = f"{name} {first}"
        else:
            raise unsupported(f"{name} of {values[0].dtype}")
        return self._made(op, values, kind, out.shape)

    def _made(self, op: str, values: Sequence[Any], kind: str, shape: tuple[int, ...]) -> Array:
        size, args = _size(shape), []
        for value in values:
            mine = np.shape(value)
            if mine != shape and _size(mine) > 1:
                places = np.broadcast_to(np.arange(_size(mine)).reshape(mine), shape)
                value = self.moved([value], places, value)
            args.append(_flat(value, size))
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
        if len(axes) == len(shape) and _size(shape) > 1 and kind in _START[pair]:
            made = self.node(f"fold {pair}", [_flat(value, _size(shape))], kind, _size(shape))
            return Array(made, 0, 0, ())
        kept = [i for i in range(len(shape)) if i not in axes]
        places = np.transpose(np.arange(_size(shape)).reshape(shape), [*axes, *kept])
        rows = places.reshape(-1, *out.shape)
        found = self.moved([value], rows[0], out)
        for row in rows[1:]:
            found = self.emit(pair, [found, self.moved([value], row, out)], {}, out)
        return found

    def _slice(self, value: Any, starts: Sequence[Any], sizes: Sequence[int], kind: str) -> Any:
        """A slice from a place that differs between worlds, held within the array."""
        shape = np.shape(value)
        windows = np.lib.stride_tricks.sliding_window_view(
            np.arange(_size(shape)).reshape(shape), tuple(sizes)
        )
        place: Any = np.zeros((), np.int32)
        like = np.zeros((), np.int32)
        for start, room in zip(starts, windows.shape, strict=False):
            held = like
            if room > 1:
                held = self.emit("max", [start, like], {}, like)
                held = self.emit("min", [held, np.asarray(room - 1, np.int32)], {}, like)
            place = self.emit("mul", [place, np.asarray(room, np.int32)], {}, like)
            place = self.emit("add", [place, held], {}, like)
        table = windows.reshape(-1, _size(sizes))
        if is_constant(value):
            value = Array(self.node("move", list(np.reshape(value, -1)), kind, value.size), 0, 1, shape)
        if value.step != 1 or value.node.size == 1:
            return self.moved([value], windows[(0,) * len(shape)], like)
        extra = tuple(map(tuple, (table + value.first).tolist()))
        made = self.node("take", [_flat(place, 1), value], kind, table.shape[1], extra)
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
        kinds = [_kind(one.dtype, "a loop") for one in carry]
        carried = [
            Node(next(self._count), "carried", (), kind, _size(np.shape(one)))
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
            value = _flat(value, node.size) if node.size else value
            if isinstance(value, Array) and value.node in carried and value.node is not node:
                kept = [_pick(value, i) for i in range(node.size)]
                value = Array(self.node("move", kept, node.kind, node.size), 0, 1, value.shape)
            results.append(value)
        self._known.pop()
        goes = None if goes is None else _flat(goes, 1)
        made = [a.node for a in (*results, goes) if isinstance(a, Array)]
        inside, reach = set(carried), _reached(made)
        inner = []
        for node in reach:  # in the order in which they were made
            if node in inside or any(one in inside for one in node.after):
                inside.add(node)
                inner += [node] if node.op != "carried" else []
        free = {one for node in (*inner,) for one in node.after if one not in inside}
        free |= {one for one in made if one not in inside}
        starts = [_flat(one, _size(np.shape(one))) for one in carry]
        loop = Node(
            next(self._count), "for" if length else "while", tuple(starts), "f", 0,
            Loop(tuple(carried), tuple(results), goes, length), tuple(inner), tuple(free),
        )  # fmt: skip
        found = []
        for node, one in zip(carried, carry, strict=True):
            part = Node(next(self._count), "part", (), node.kind, node.size, node, free=(loop,))
            found.append(Array(part, 0, 1, np.shape(one)) if node.size else one)
        return found


def _kind(dtype: Any, name: str) -> str:
    kind = kind_of(np.dtype(dtype), name, Lanes.kinds)
    if np.dtype(dtype).itemsize != (1 if kind == "b" else 4):
        raise unsupported(f"{name} of {dtype}")
    return kind


def _key(value: Any) -> Any:
    if isinstance(value, Array):
        return (value.node.number, value.first, value.step)
    return np.asarray(value).tobytes(), np.asarray(value).dtype.str


def _pick(value: Any, at: int) -> Any:
    """One number of a value."""
    if isinstance(value, Array):
        return Array(value.node, value.first + value.step * at, 1, ())
    return np.asarray(value).reshape(-1)[at]


def _flat(value: Any, size: int) -> Any:
    """A value as an operand of an operation on `size` numbers."""
    if isinstance(value, Array):
        many = _size(value.shape)
        return value._replace(shape=(size,), step=value.step if many == size else 0)
    array = np.ascontiguousarray(value).reshape(-1)
    return array[:1] if len({x.tobytes() for x in array}) == 1 else array


def _reached(nodes: Iterable[Node]) -> list[Node]:
    """Nodes and all that they need, as they were made."""
    found: dict[int, Node] = {}
    waiting = list(nodes)
    while waiting:
        node = waiting.pop()
        if node.number not in found:
            found[node.number] = node
            waiting += node.after
    return [found[number] for number in sorted(found)]


# --- as C ------------------------------------------------------------------------------------


class _Writer:
    """Statements of nodes, in an order in which few loops are needed."""

    def __init__(self) -> None:
        self.tables: dict[bytes, str] = {}
        self.each: set[str] = set()

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
        for i, group in enumerate(groups):
            if group[0].alone:
                for node in group:
                    lines += self._alone(node)
                continue
            kept = [n for n in group if n in wanted or users.get(n, set()) - {i}
                    or any(n in other.entire for other in group)]  # fmt: skip
            lines += self._together(group, set(kept))
        return lines

    def _next(self, waiting: Sequence[Node], there: set[Node]) -> list[Node]:
        """What can be made next: all that stands alone, else one loop, else what loops by itself."""
        for wanted in ("alone", "together", "loop"):
            group: list[Node] = []
            have, size = set(there), 0
            for node in waiting:
                kind = "loop" if node.op in ("while", "for") else "alone" if node.alone else "together"
                if kind != wanted or (size and node.size != size):
                    continue
                whole = there if kind == "together" else have
                if node.entire <= whole and set(node.after) <= have:
                    size = node.size if kind == "together" else 0
                    group.append(node)
                    have.add(node)
                    if kind == "loop":
                        break
            if group:
                return group
        raise AssertionError("nodes wait for one another")

    def _together(self, group: Sequence[Node], kept: set[Node]) -> list[str]:
        """One loop over the numbers of nodes."""
        before, lines, mine = [], [], set(group)
        for node in group:
            kind, name = _TYPES[node.kind], node.name
            text = self._expression(node, mine)
            if node.op.startswith("fold"):
                before.append(f"{kind} {name} = {_all(node.kind, _START[node.op[5:]][node.kind])};")
                lines.append(f"  {name} = {text};")
                continue
            lines.append(f"  const {kind} e{node.number} = {text};")
            if node in kept:
                before.append(f"{kind} {name}[{node.size}];")
                lines.append(f"  {name}[i] = e{node.number};")
        return [*before, f"for (int i = 0; i < {group[0].size}; i++) {{", *lines, "}"]

    def _alone(self, node: Node) -> list[str]:
        kind, name, size = _TYPES[node.kind], node.name, node.size
        if isinstance(node.extra, Loop):
            return self._loop(node, node.extra)
        if node.op == "part":
            if size == 1:
                return [f"const {kind} {name} = {node.extra.name};"]
            return [f"const {kind} *const {name} = {node.extra.name};"]
        declared = f"{kind} {name}" + ("" if size == 1 else f"[{size}]")
        at = "" if size == 1 else "[i]"
        if node.op == "given":
            stored = f"((const {_STORED[node.kind]} *)given[{node.extra}])[at[l] * {size} + i]"
            stored = f"-(int){stored}" if node.kind == "b" else stored
            return [
                f"{declared};",
                f"for (int i = 0; i < {size}; i++)",
                f"  for (int l = 0; l < LANES; l++) {name}{at}[l] = {stored};",
            ]
        if node.op == "take":
            place, source = node.args
            table = self._table(np.array(node.extra))
            return [
                f"{declared};",
                f"for (int i = 0; i < {size}; i++)",
                f"  for (int l = 0; l < LANES; l++)",
                f"    {name}{at}[l] = {source.node.name}[{table}[{self._read(place, node, set())}[l]"
                f" * {size} + i]][l];",
            ]
        if node.op == "move":
            reads = [self._read(a, node, set()) for a in node.args]
            if size == 1:
                return [f"const {declared} = {reads[0]};"]
            return [f"{declared};", *(f"{name}[{i}] = {x};" for i, x in enumerate(reads))]
        return [f"const {declared} = {self._expression(node, set())};"]

    def _loop(self, node: Node, loop: Loop) -> list[str]:
        lines, body = [], []
        for own, start in zip(loop.carried, node.args, strict=True):
            if own.size:
                lines += self._set(own, start, f"{_TYPES[own.kind]} ", node)
        results = [a.node for a in (*loop.results, loop.holds) if isinstance(a, Array)]
        there = {*node.free, *loop.carried, *(n for n in results if n not in node.inner)}
        if loop.holds is not None:
            before = [n for n in _reached([loop.holds.node]) if n in node.inner]
            body += self.lines(before, node.inner, there)
            body += [f"const I goes = {self._read(loop.holds, node, set())};", "if (!any(goes)[0]) break;"]
            there |= set(before)
            rest = [n for n in node.inner if n not in set(before)]
        else:
            rest = list(node.inner)
        body += self.lines(rest, results, there)
        for own, result in zip(loop.carried, loop.results, strict=True):
            if own.size and not (isinstance(result, Array) and result.node is own):
                body += self._set(own, result, "", node, masked=loop.holds is not None)
        head = f"for (int turn = 0; turn < {loop.length}; turn++) {{" if loop.length else "for (;;) {"
        return [*lines, head, *(f"  {line}" for line in body), "}"]

    def _set(self, own: Node, to: Any, head: str, node: Node, masked: bool = False) -> list[str]:
        """Statements that give a carried node its numbers, in the lanes that go on."""
        each = Node(0, "set", (to,), own.kind, own.size)
        text, at = self._read(to, each, set()), "" if own.size == 1 else "[i]"
        text = f"choose_{own.kind}(goes, {text}, {own.name}{at})" if masked else text
        if own.size == 1:
            return [f"{head}{own.name} = {text};"]
        declared = [f"{head}{own.name}[{own.size}];"] if head else []
        return [*declared, f"for (int i = 0; i < {own.size}; i++) {own.name}[i] = {text};"]

    def _read(self, a: Any, node: Node, mine: set[Node]) -> str:
        """How a node reads an operand."""
        if not isinstance(a, Array):
            array = np.asarray(a).reshape(-1)
            kind = kind_of(array.dtype, "", Lanes.kinds)
            if array.size == 1:
                return _all(kind, _literal(array[0], kind))
            return _all(kind, f"{self._table(array)}[i]")
        if a.node.width == 1:
            return a.node.name
        if a.node in mine and node.in_turn(a):
            return f"e{a.node.number}"
        if not a.step or node.size == 1 or node.op in ("move", "take"):
            return f"{a.node.name}[{a.first}]"
        return f"{a.node.name}[i + {a.first}]" if a.first else f"{a.node.name}[i]"

    def _expression(self, node: Node, mine: set[Node]) -> str:
        reads = [self._read(a, node, mine) for a in node.args]
        op, _, rest = node.op.partition(" ")
        if op == "fold":
            reads, op, rest = [node.name, *reads], "infix", rest
            if rest in ("max", "min"):
                return f"{rest}_{node.kind}({reads[0]}, {reads[1]})"
        if op == "infix":
            return f"{reads[0]} {_INFIX[rest]} {reads[1]}"
        if op == "choose":
            return f"choose_{rest}({', '.join(reads)})"
        if op == "bits":
            return f"({_TYPES[rest]}){reads[0]}"
        if op == "each":
            self.each.add(f"EACH{'_OF_TWO' * (len(reads) == 2)}({rest}, {_c_name(rest)})")
            return f"each_{rest}({', '.join(reads)})"
        if node.op == "logistic f":
            self.each.add("EACH(exp, expf)")
        if node.op == "rsqrt f":
            self.each.add("EACH(sqrt, sqrtf)")
        return _FORMS[node.op].format(*reads)

    def _table(self, array: np.ndarray) -> str:
        """The name of constants that stand before the function."""
        key = array.tobytes() + array.dtype.str.encode()
        kind = kind_of(array.dtype, "", Lanes.kinds)
        if key not in self.tables:
            texts = ", ".join(_literal(x, kind) for x in array.reshape(-1))
            stored = "int" if kind == "b" else _STORED[kind]
            name = f"t{len(self.tables)}"
            self.tables[key] = f"static const {stored} {name}[{array.size}] = {{{texts}}};"
        return self.tables[key].split("[")[0].split()[-1]


def _c_name(name: str) -> str:
    return "erf_inv" if name == "erf_inv" else f"{_EACH.get(name, name)}f"


def _all(kind: str, text: str) -> str:
    return f"all_{'i' if kind == 'b' else kind}({text})"


def _literal(value: Any, kind: str) -> str:
    if kind == "f":
        number = float(value)
        if math.isnan(number):
            return "NAN"
        return "-INFINITY" if number == -math.inf else "INFINITY" if number == math.inf else f"{number!r}f"
    if kind == "b":
        return str(-int(value))
    if kind == "u":
        return f"{int(value)}u"
    return str(int(value)) if value > -(2**31) else "-2147483647 - 1"


def source(closed: Any, shapes: Sequence[Any], outs: Sequence[Any]) -> str:
    """C of a closed jaxpr of arguments of these shapes and types, as the handler `HANDLER` of XLA's.

    Raises:
      InputError: it has an operation that is not known here.
    """
    target, writer = Lanes(), _Writer()
    given = [
        target.given(i, x.shape, x.dtype) if _size(x.shape) else np.zeros(x.shape, x.dtype)
        for i, x in enumerate(shapes)
    ]
    found = [
        _flat(one, _size(like.shape)) for one, like in zip(walk(closed, given, target), outs, strict=True)
    ]
    ends = [a.node for a in found if isinstance(a, Array)]
    lines = writer.lines(_reached(ends), ends, set())
    for i, (a, like) in enumerate(zip(found, outs, strict=True)):
        size, kind = _size(like.shape), _kind(like.dtype, "a result")
        if not size:
            continue
        end = Node(0, "end", (a,), kind, size)
        read = writer._read(a, end, set())
        stored = _STORED[kind]
        lines += [
            f"for (int i = 0; i < {size}; i++) {{",
            f"  const {_TYPES[kind]} e = {read};",
            f"  for (int l = 0; l < LANES && first + l < worlds; l++)",
            f"    (({stored} *)found[{i}])[at[l] * {size} + i] = e[l]{' != 0' * (kind == 'b')};",
            "}",
        ]
    one = next(i for i, x in enumerate(shapes) if _size(x.shape))
    fill = {
        "EACH": "\n".join(sorted(writer.each)),
        "TABLES": "\n".join(writer.tables.values()),
        "LINES": "\n".join(f"  {line}" for line in lines),
        "NAME": HANDLER, "COUNT": len(shapes), "FOUND": len(outs), "ONE": one,
        "SIZE": _size(shapes[one].shape),
    }
    return _HEAD + _BODY.format(**fill)
