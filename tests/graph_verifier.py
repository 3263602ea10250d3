"""Rules of the graph of `rps_jax.lowering`, their check, and its text.

After `install`, each graph is checked when it is built, and after the pass of scalar code.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from rps_jax.lowering import scalar, writer
from rps_jax.lowering.graph import (
    Array,
    Call,
    Carried,
    DynamicSlice,
    For,
    Gather,
    LoopNode,
    LoopResult,
    MatrixProduct,
    Node,
    Reduce,
    Result,
    Value,
    is_unchanged,
    kind_of,
    live_nodes,
    nodes_of,
)

_COMPARISON = re.compile(r"(lt|le|eq|gt|ge|ne|lt_to)_\w")


class GraphError(Exception):
    """A graph that breaks a rule: a fault of a builder or of a pass."""


def install() -> None:
    """Check each graph that is built in this process."""
    for module in (writer, scalar):
        module.results = _checked(module.results, lambda built: check(built[0]))
    scalar.sink_products = _checked(scalar.sink_products, lambda nodes: check_nodes(nodes))


def _checked(function: Callable, check_result: Callable) -> Callable:
    """Return a function whose result is checked."""

    @functools.wraps(function)
    def call(*arguments):
        result = function(*arguments)
        check_result(result)
        return result

    return call


def check(results: Sequence[Result]) -> None:
    """Check the graph of results.

    Raises:
      GraphError: a node has operands of a wrong number, kind or size, an operand that is not
        computed before it, or no reader.
    """
    check_nodes(live_nodes(nodes_of(result.value for result in results)))
    for position, value, size, kind in results:
        _check_value(value, size, kind, f"result {position}")


def check_nodes(nodes: Iterable[Node]) -> None:
    """Check the nodes of a graph."""
    _check_region(nodes, set())


def signature(function: str) -> tuple[str, str]:
    """Return the kinds of a function's operands, the last of which may repeat, and its result's."""
    name, _, kind = function.rpartition("_")
    if name == "choose":
        return f"b{kind}{kind}", kind
    if name.endswith("_of"):
        return kind, name[-4]
    if name == "truncate":
        return kind, "i"
    return kind, "b" if _COMPARISON.fullmatch(function) else kind


def _types_of_operands(node: Node) -> list[tuple[str, int]]:
    """Return the kind and the size of each operand that an operation needs."""
    op, count = node.op, len(node.operands)
    if isinstance(node, LoopNode):
        return [(x.kind, x.size) for x in node.carried]
    if isinstance(op, Call):
        kinds = signature(op.function)[0]
        return [(kind, node.size) for kind in kinds.ljust(max(count, 1), kinds[-1])]
    if isinstance(op, DynamicSlice):
        return [("i", 1), (node.kind, 1)]
    if isinstance(op, MatrixProduct):
        rows = node.size // op.shape[1]
        return [("f", 1)] * rows * op.shape[0]
    if isinstance(op, Reduce):
        return [(node.kind, node.size)]
    return [(node.kind, 1)] * node.size if isinstance(op, Gather) else []


def _check_region(nodes: Iterable[Node], defined: set[Node]) -> None:
    """Check nodes, which read one another and the nodes that are `defined` outside."""
    waiting, defined = list(nodes), set(defined)
    while waiting:
        late = list[Node]()
        for node in waiting:
            if defined.issuperset(node.predecessors):
                _check_node(node)
                defined.add(node)
            else:
                late.append(node)
        unknown = ", ".join(sorted({x.name for x in waiting[0].predecessors if x not in defined}))
        fault = f"it reads {unknown} before the definition"
        _require(len(late) < len(waiting), waiting[0], fault)
        waiting = late


def _check_node(node: Node) -> None:
    op, types = node.op, _types_of_operands(node)
    _require(len(types) == len(node.operands), node, f"it needs {len(types)} operands")
    for a, (kind, size) in zip(node.operands, types, strict=True):
        _check_value(a, size, kind, node)
    if isinstance(node, LoopNode):
        _check_loop(node)
    elif isinstance(op, Call):
        kind = signature(op.function)[1]
        _require(node.kind == kind, node, f"its kind is {kind}")
    elif isinstance(op, DynamicSlice):
        windows, width = np.array(op.windows), node.operands[1].node.width
        is_inside = windows.min() >= 0 and windows.max() < width and windows.shape[1] == node.size
        _require(is_inside, node, "a window is not in its array")
    elif isinstance(op, LoopResult):
        carried = [x for loop in node.captured for x in getattr(loop, "carried", ())]
        _require(op.carried in carried, node, "no loop carries it")
        _require(op.carried.size == node.size, node, "its loop carries another size")
    _require(not isinstance(op, Carried), node, "it is not in its loop")


def _check_loop(loop: LoopNode) -> None:
    for value, node in zip(loop.results, loop.carried, strict=True):
        _check_value(value, node.size, node.kind, loop)
        is_alias = node.size and not {*loop.carried}.isdisjoint(nodes_of([value]))
        is_safe = not is_alias or is_unchanged(node, value)
        _require(is_safe, loop, "it assigns a carried node that it may have changed")
    if not isinstance(loop.op, For):
        _check_value(loop.condition, 1, "b", loop)
    visible = {*loop.carried, *loop.captured}
    _check_region(loop.body, visible)
    roots = nodes_of((*loop.results, loop.condition))
    _require(visible.union(loop.body).issuperset(roots), loop, "a result is not computed in it")
    for node in set(loop.body).difference(live_nodes(roots)):
        _require(False, node, "it has no reader")


def _check_value(a: Value, size: int, kind: str, reader: Node | str) -> None:
    """Check that a value has numbers of a kind for each of `size` elements."""
    if isinstance(a, Array):
        last = a.first + a.step * max(size - 1, 0)
        _require(0 <= a.first <= last < a.node.width or not size, reader, f"{_view(a)} is too long")
        value_kind = a.node.kind
    else:
        count, value_kind = np.size(a), kind_of(np.asarray(a).dtype)
        _require(count in (1, size), reader, f"a constant has {count} numbers, not {size}")
    _require(value_kind == kind, reader, f"an operand has the kind {value_kind}, not {kind}")


def _require(holds: bool, owner: Node | str, fault: str) -> None:
    if not holds:
        raise GraphError(f"{owner if isinstance(owner, str) else _text(owner)}: {fault}")


# --- text --------------------------------------------------------------------------------------


def dump(results: Sequence[Result]) -> str:
    """Return a graph as text, one line for each node, for example `v3: f[5] = add_f(v1, 2.0)`."""
    lines = _lines(live_nodes(nodes_of(result.value for result in results)))
    outputs = [f"result {x.position}: {x.kind}[{x.size}] = {_view(x.value)}" for x in results]
    return "\n".join([*lines, *outputs])


def _lines(nodes: Iterable[Node]) -> Iterator[str]:
    for node in nodes:
        yield _text(node)
        if isinstance(node, LoopNode):
            inside = [] if isinstance(node.op, For) else [f"condition {_view(node.condition)}"]
            inside += _lines(node.body)
            pairs = zip(node.carried, node.results, strict=True)
            inside += [f"next {x.name} = {_view(value)}" for x, value in pairs]
            yield from (f"  {line}" for line in inside)


def _text(node: Node) -> str:
    """Return a node as one line."""
    details = [str(x) for x in vars(node.op).values() if isinstance(x, str | int)]
    text = " ".join([type(node.op).__name__, *details])
    if isinstance(node, LoopNode):
        pairs = zip(node.carried, node.operands, strict=True)
        starts = (f"{x.name}: {x.kind}[{x.size}] = {_view(a)}" for x, a in pairs)
        return f"{text}({', '.join(starts)})"
    operands = ", ".join(map(_view, node.operands))
    return f"{node.name}: {node.kind}[{node.width}] = {text}({operands})"


def _view(a: Value) -> str:
    if not isinstance(a, Array):
        return np.array2string(np.asarray(a).reshape(-1), separator=", ", threshold=4)
    end = f":{a.first + a.shape[0]}" if a.step and a.shape else ""
    is_whole = not a.first and (a.node.width == 1 or end == f":{a.node.width}")
    return a.node.name if is_whole else f"{a.node.name}[{a.first}{end}]"
