"""Printer of JavaScript: the statements of a routine, literals and helper functions."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from rps_jax.lowering.graph import Node
from rps_jax.lowering.operations import spelled
from rps_jax.lowering.routine import Group, Routine
from rps_jax.lowering.scalar import ScalarWriter

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

    def declare(self, node: Node) -> str:
        return f"const {node.name} = Array({node.size});" if node.size > 1 else f"let {node.name};"

    def literal(self, value: float, kind: str) -> str:
        return json.dumps(np.asarray(value).item())

    def array_literal(self, texts: Iterable[str]) -> str:
        return f"[{', '.join(texts)}]"

    def table_declaration(self, name: str, array: np.ndarray) -> str:
        """Return a table; a matrix is packed in as few bytes as are exact."""
        if array.ndim < 2:
            return f"const {name} = {json.dumps(array.tolist())};"
        exact = bool(np.all(array.astype("<f4") == array))
        kind, dtype = ("Float32Array", "<f4") if exact else ("Float64Array", "<f8")
        packed = base64.b64encode(array.astype(dtype).tobytes()).decode()
        return f'const {name} = unpacked("{packed}", {kind}, {len(array)});'


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
        text = str(np.array(names, object).reshape(field.shape).tolist()).replace("'", "")
        lines.append(f"const result_{group}_{field.name} = {text};")
    return "\n".join(f"  {line}" for line in lines)


def object_of(group: str, groups: Mapping[str, Group]) -> str:
    """Return the results of a routine as an object."""
    fields = ", ".join(f"{field.name}: result_{group}_{field.name}" for field in groups[group])
    return f"{{ {fields} }}"
