"""Printer of JavaScript: the statements of a routine, literals and helper functions."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from rps_jax.lowering.nodes import Array, Node, SimdNodes
from rps_jax.lowering.operations import spelled
from rps_jax.lowering.routine import Group, Routine
from rps_jax.lowering.scalar_nodes import ScalarNodes
from rps_jax.lowering.scalar_writer import ScalarWriter

_LISTED = 12  # elements of an array that is printed as a list, at most
HELPERS = Path(__file__).with_name("helpers.js").read_text("utf-8")


class JsWriter(ScalarWriter):
    """Printer of one routine as statements of JavaScript."""

    spelling = spelled("js")
    index = "let"
    flag = "Boolean({})"
    alias = "{head} = {name}.flat(Infinity);"
    zeros = "Array({}).fill(0)"

    def declaration(self, kind: str, name: str, size: int = 1, constant: bool = True) -> str:
        return f"{'const' if constant or size > 1 else 'let'} {name}"

    def declared(self, node: Node) -> str:
        return f"const {node.name} = Array({node.size});" if node.size > 1 else f"let {node.name};"

    def literal(self, value: float, kind: str) -> str:
        return text_of(np.asarray(value).item())

    def listed(self, texts: Iterable[str]) -> str:
        return f"[{', '.join(texts)}]"

    def packed(self, name: str, array: np.ndarray) -> str:
        """Return a table; a matrix is packed in as few bytes as are exact."""
        if array.ndim < 2:
            return f"const {name} = {text_of(array.tolist())};"
        exact = bool(np.all(array.astype("<f4") == array))
        kind, dtype = ("Float32Array", "<f4") if exact else ("Float64Array", "<f8")
        packed = base64.b64encode(array.astype(dtype).tobytes()).decode()
        return f'const {name} = unpacked("{packed}", {kind}, {len(array)});'


class _LoopNodes(ScalarNodes):
    """Target whose loops may run until a condition fails: a page has no deadline."""

    while_loop = SimdNodes.while_loop


class PageWriter(JsWriter):
    """Printer of a routine of a page."""

    nodes = _LoopNodes
    leave = "if (!goes) break;"

    def single(self, node: Node) -> list[str]:
        """Return the statements of a node; many numbers of one array are picked by a table."""
        views = [a for a in node.args if isinstance(a, Array)]
        sources = {view.node for view in views}
        if node.op != "move" or not _LISTED < node.size == len(views) or len(sources) > 1:
            return super().single(node)
        first = min(view.first for view in views)
        table = self.table(np.array([view.first - first for view in views]))
        item = self.item(views[0].node, f"k + {first}" if first else "k")
        return [f"const {node.name} = {table}.map((k) => {item});"]


def statements(
    routine: Routine,
    groups: Mapping[str, str],
    tables: dict[str, str],
    printer: type[JsWriter] = JsWriter,
) -> str:
    """Return the statements that compute the results of a routine, as named constants.

    Args:
      routine: the function.
      groups: text before the names of the fields of each input group, as `params.`.
      tables: declarations of constants, to which those of the routine are added.
      printer: class that prints the routine.
    """
    writer = printer(routine, groups, tables)
    lines = list(writer.body)
    for group, field, value in writer.outputs:
        names = [writer.operand(value, i) for i in range(field.size)]
        array = np.array(names, object).reshape(field.shape).tolist()
        lines.append(f"const result_{group}_{field.name} = {_nested(array)};")
    return "\n".join(f"  {line}" for line in lines)


def function(name: str, routine: Routine, tables: dict[str, str]) -> str:
    """Return a routine of a page as a function of its groups of fields."""
    groups = {group: f"{group}." for group in routine.inputs}
    lines = statements(routine, groups, tables, PageWriter)
    results = ", ".join(f"{group}: {object_of(group, routine.outputs)}"
                        for group in routine.outputs)  # fmt: skip
    head = f"function {name}({', '.join(routine.inputs)}) {{"
    return f"{head}\n{lines}\n  return {{ {results} }};\n}}\n"


def object_of(group: str, groups: Mapping[str, Group]) -> str:
    """Return the results of a routine as an object."""
    fields = ", ".join(f"{field.name}: result_{group}_{field.name}" for field in groups[group])
    return f"{{ {fields} }}"


def text_of(value: object) -> str:
    """Return numbers, texts, lists and mappings as a literal of JavaScript."""
    if isinstance(value, Mapping):
        items = (f"{json.dumps(k)}: {text_of(v)}" for k, v in value.items())
        return "{" + ", ".join(items) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(text_of, value)) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return json.dumps(value)


def _nested(names: object) -> str:
    """Return names in nested lists as text."""
    return "[" + ", ".join(map(_nested, names)) + "]" if isinstance(names, list) else str(names)
