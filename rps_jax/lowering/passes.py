"""Passes over the graph: blocks for products, the schedule, and arrays that threads share."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import NamedTuple

from rps_jax.lowering.graph import (
    Array,
    Call,
    Carried,
    DynamicSlice,
    Gather,
    If,
    Input,
    LoopNode,
    LoopResult,
    MatrixProduct,
    Node,
    Result,
    flat,
    live_nodes,
    nodes_of,
)
from rps_jax.lowering.target import Value

# --- schedule ----------------------------------------------------------------------------------


class Group(NamedTuple):
    """Consecutive statements: nodes of one loop over elements, a loop node, or single nodes."""

    nodes: list[Node]
    stored: set[Node]  # nodes of a loop over elements that later statements read
    released: list[Node]  # nodes that no later group reads


def schedule(
    nodes: Iterable[Node],
    live_out: Collection[Node],
    computed: Iterable[Node],
    is_fusible: Callable[[Node], bool],
    choose_size: Callable[[Collection[int]], int],
) -> list[Group]:
    """Return nodes in an order in which few loops over elements are needed.

    Args:
      nodes: to be computed.
      live_out: nodes that are read after all groups.
      computed: nodes that are computed before.
      is_fusible: whether a node is computed in a loop over elements.
      choose_size: returns the size of the next loop, from the sizes of all that are ready.
    """
    waiting, computed, order = list(nodes), set(computed), list[list[Node]]()
    while waiting:
        order.append(_next_group(waiting, computed, is_fusible, choose_size))
        computed |= set(order[-1])
        waiting = [node for node in waiting if node not in computed]
    # Index of the last group that reads a node.
    last = {x: i for i, group in enumerate(order) for n in group for x in (n, *n.predecessors)}
    released: dict[int, list[Node]] = {}
    for node in itertools.chain(*order):
        if node not in live_out:
            released.setdefault(last[node], []).append(node)
    groups = []
    for i, group in enumerate(order):
        stored = {node for node in group if node in live_out or last[node] > i}
        groups.append(Group(group, stored, released.get(i, [])))
    return groups


def _next_group(
    waiting: Sequence[Node],
    computed: set[Node],
    is_fusible: Callable[[Node], bool],
    choose_size: Callable[[Collection[int]], int],
) -> list[Node]:
    """Return all single nodes that are ready, else one loop over elements, else a loop node."""
    for kind in ("single", "fused", "loop"):
        groups: dict[int, list[Node]] = {}
        ready = set(computed)
        for node in waiting:
            node_kind = "fused" if is_fusible(node) else "single"
            node_kind = "loop" if isinstance(node, LoopNode) else node_kind
            if node_kind != kind or not ready.issuperset(node.predecessors):
                continue
            if kind == "fused" and not node.fusion_barriers <= computed:
                continue
            if kind == "loop":
                return [node]
            groups.setdefault(node.size if kind == "fused" else 0, []).append(node)
            ready.add(node)
        if groups:
            return groups[choose_size(groups)]
    raise AssertionError("nodes wait for one another")


# --- blocks ------------------------------------------------------------------------------------


def sink_products(roots: Sequence[Node]) -> list[Node]:
    """Return all live nodes, with a block for products that are not always used.

    A network is then evaluated only in the steps that use its result.
    """
    nodes = live_nodes(roots)
    if any(isinstance(node.op, MatrixProduct) for node in nodes):
        conditions = dict.fromkeys(filter(None, map(_condition, nodes)))
        for condition, side in itertools.product(conditions, (1, 2)):
            if _move_into_block(nodes, roots, condition, side):
                return live_nodes(roots)
    return nodes


def _condition(node: Node) -> tuple[Node, int] | None:
    """Return the node and the index of the number by which a node chooses an operand."""
    is_choice = isinstance(node.op, Call) and node.op.function.startswith("choose_")
    a = node.operands[0] if is_choice else None
    return (a.node, a.first) if isinstance(a, Array) and (not a.step or node.size == 1) else None


def _move_into_block(
    nodes: Sequence[Node], roots: Sequence[Node], condition: tuple[Node, int], side: int
) -> bool:
    """Move nodes that matter on one side of a condition into a block, if a product is there."""
    always: set[Node] = set()
    waiting = list(roots)
    while waiting:
        node = waiting.pop()
        if node not in always:
            always.add(node)
            is_choice = _condition(node) == condition
            operands = [node.operands[i] for i in (0, 3 - side)] if is_choice else node.operands
            waiting += nodes_of(operands) + list(node.captured)
    block = [node for node in nodes if node not in always and not isinstance(node.op, Input)]
    inside = set(block)
    if not any(isinstance(node.op, MatrixProduct) for node in block):
        return False
    choices = [
        node
        for node in nodes
        if node in always and _condition(node) == condition
        if not inside.isdisjoint(nodes_of([node.operands[side]]))
    ]
    starts = tuple(node.operands[3 - side] for node in choices)
    captured = {x for node in block for x in node.predecessors} - inside
    captured |= {condition[0], *nodes_of(starts)}
    if not set(live_nodes(captured)).isdisjoint(choices):
        return False
    ids = itertools.count(max(node.id for node in nodes) + 1)
    carried = tuple(Node(next(ids), Carried(), (), n.kind, n.size) for n in choices)
    loop = LoopNode(
        next(ids),
        If(side == 1),
        starts,
        kind="f",
        size=0,
        captured=tuple(captured),
        carried=carried,
        results=tuple(flat(node.operands[side], node.size) for node in choices),
        condition=Array(*condition, 1, (1,)),
        body=tuple(block),
    )
    for node, carry in zip(choices, carried, strict=True):
        node.op, node.operands, node.captured = LoopResult(carry), (), (loop,)
        node.__dict__.pop("fusion_barriers", None)
    return True


# --- storage -----------------------------------------------------------------------------------


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
