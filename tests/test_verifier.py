"""The verifier of the compiler's graph finds faults that are made by hand."""

import re

import graph_verifier
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from graph_verifier import GraphError
from jax import lax

from rps_jax.app.export import c, js
from rps_jax.app.export import program as programs
from rps_jax.control import registry
from rps_jax.lowering.builder import SimdBuilder, results
from rps_jax.lowering.graph import (
    Array,
    Call,
    DynamicSlice,
    LoopNode,
    LoopResult,
    Node,
    live_nodes,
    nodes_of,
)
from rps_jax.lowering.walk import Rows


def function(x, i):
    """Return results with a node of each kind but a product."""
    y = jnp.where(x > 0, 2 * x, x[::-1])
    last = lax.while_loop(lambda s: s[0] < i[1], lambda s: (s[0] + 1, s[1] + y[s[0]]), (0, y))[1]
    return last, lax.fori_loop(0, 3, lambda _, z: 0.5 * z + i[0], y).sum()


def graph():
    """Return the results of the function."""
    shapes = [jax.ShapeDtypeStruct((5,), np.float32), jax.ShapeDtypeStruct((2,), np.int32)]
    closed, outs = jax.make_jaxpr(function, return_shape=True)(*shapes)
    return results(Rows(closed), shapes, outs, SimdBuilder())[0]


def nodes(outputs):
    """Return all nodes of results, also those in loops."""
    outer = live_nodes(nodes_of(x.value for x in outputs))
    return [*outer, *(x for loop in outer if isinstance(loop, LoopNode) for x in loop.body)]


def first(outputs, op, function=None):
    """Return the first node of an operation."""
    matches = (x for x in nodes(outputs) if isinstance(x, op) or isinstance(x.op, op))
    return next(x for x in matches if function in (None, getattr(x.op, "function", None)))


def shifted(value):
    return value._replace(first=value.first + 1)


def rename(outputs):
    first(outputs, Call, "mul_f").op = Call("lt_f")


def drop_operand(outputs):
    node = first(outputs, Call, "choose_f")
    node.operands = node.operands[:2]


def shift_operand(outputs):
    node = first(outputs, Call, "mul_f")
    node.operands = tuple(shifted(a) if isinstance(a, Array) else a for a in node.operands)


def wrong_constant(outputs):
    node = first(outputs, Call, "mul_f")
    node.operands = (np.ones(4), node.operands[1])


def shift_window(outputs):
    node = first(outputs, DynamicSlice)
    node.op = DynamicSlice(tuple((x + 1,) for (x,) in node.op.windows))


def read_itself(outputs):
    node = first(outputs, Call, "choose_f")
    node.operands = (*node.operands[:2], Array(node, (5,)))


def undefined_in_loop(outputs):
    loop = first(outputs, LoopNode)
    loop.captured = ()


def dangling_in_loop(outputs):
    loop = first(outputs, LoopNode)
    loop.body = (*loop.body, Node(999, Call("neg_f"), (np.ones(1),), "f", 1))


def without_loop(outputs):
    first(outputs, LoopResult).captured = ()


def wrong_condition(outputs):
    loop = first(outputs, LoopNode)
    loop.condition = np.ones(1, np.int32)


def alias_carried(outputs):
    loop = first(outputs, LoopNode)
    loop.results = (loop.results[0], Array(loop.carried[1], (5,), 2, 0))


def wrong_result(outputs):
    outputs[0] = outputs[0]._replace(kind="i")


FAULTS = {
    rename: "its kind is b",
    drop_operand: "it needs 3 operands",
    shift_operand: "v0[1:6] is too long",
    wrong_constant: "a constant has 4 numbers, not 5",
    shift_window: "a window is not in its array",
    read_itself: "before the definition",
    undefined_in_loop: "before the definition",
    dangling_in_loop: "v999: f[1] = Call neg_f([1.]): it has no reader",
    without_loop: "no loop carries it",
    wrong_condition: "an operand has the kind i, not b",
    alias_carried: "it assigns a carried node that it may have changed",
    wrong_result: "result 0: an operand has the kind f, not i",
}


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.__name__)
def test_a_fault_is_found(fault):
    outputs = graph()
    graph_verifier.check(outputs)
    fault(outputs)
    with pytest.raises(GraphError, match=re.escape(FAULTS[fault])):
        graph_verifier.check(outputs)


def test_a_graph_is_printed_one_line_for_each_node():
    text = graph_verifier.dump(graph())
    lines = text.splitlines()
    assert lines[0] == "v0: f[5] = Input 0()"
    assert re.search(r"^v\d+: f\[5\] = Call choose_f\(v\d+, v\d+, v\d+\)$", text, re.M)
    assert re.search(r"^For 3\(v\d+: i\[1\] = \[0\], v\d+: f\[5\] = v\d+\)\n  v\d+: ", text, re.M)
    assert lines[-1].startswith("result 1: f[1] = v")


@pytest.mark.parametrize("law", registry.PACKAGE_LAWS)
def test_the_graphs_of_a_law_are_valid(law, monkeypatch):
    """Each header and module has three routines, and a block for the network of a learned law."""
    checked, check = [], graph_verifier._check_region
    monkeypatch.setattr(
        graph_verifier, "check_nodes", lambda nodes: checked.append(check(nodes, set()))
    )
    program = programs.program(law)
    c.header(program, "law")
    js.module(program, "law")
    assert len(checked) == 12
