"""The emitter of JavaScript: one ES module without dependencies."""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Mapping

import numpy as np

from rps_jax import __version__
from rps_jax.app.export.program import Group, Program, Routine
from rps_jax.app.export.scalars import Node
from rps_jax.app.export.walk import unsupported
from rps_jax.app.export.writer import FORMS, Writer, computed

_FORMS = FORMS | {
    "rem": "{0} % {1}",
    "logistic": "1 / (1 + Math.exp(-{0}))",
    "is_finite": "Number.isFinite({0})",
    "exp2": "Math.pow(2, {0})",
    "round": "Math.sign({0}) * Math.floor(Math.abs({0}) + 0.5)",
    "rint": "rint({0})",
    "iadd": "({0} + {1}) | 0",
    "isub": "({0} - {1}) | 0",
    "imul": "Math.imul({0}, {1})",
    "idiv": "{1} === 0 ? -1 : ({0} / {1}) | 0",
    "irem": "{1} === 0 ? {0} : ({0} % {1}) | 0",
    "ineg": "-{0} | 0",
    "iabs": "Math.abs({0}) | 0",
    "imax": "Math.max({0}, {1})",
    "imin": "Math.min({0}, {1})",
    "isign": "Math.sign({0})",
    "f_of_i": "{0}",
    "f_of_b": "{0} ? 1 : 0",
    "i_of_f": "int({0})",
    "i_of_b": "{0} ? 1 : 0",
}

HELPERS = """\
const finite = (x) => (Array.isArray(x) ? x.every(finite) : Number.isFinite(Number(x)));
const nan = (x) => (Array.isArray(x) ? x.some(nan) : Number.isNaN(Number(x)));
const rint = (x) => (Math.abs(x % 1) === 0.5 ? 2 * Math.round(x / 2) : Math.round(x));
const held = (x) => Math.min(2147483647, Math.max(-2147483648, x));
const int = (x) => (Number.isNaN(x) ? 0 : Math.trunc(held(x)));
"""

_HEAD = """\
// The law {label} with the skin of the robot {robot}, written by rps_jax {version}: do not edit.
//
// import {{ params, init, step }} from "./{p}.mjs";
// let memory = init(params);
// const {{ code, twist, memory: next }} = step(params, memory, seen);
//
// A code that is not 0 (1: an input was not finite; 2: the law has no finite twist) comes with a
// zero twist and the memory as it was.

{helpers}
export const TAXELS = {taxels};
export const params = {params};
export const skinParams = {skin_params};
export const skinInit = () => (
  {{ signal: Array(TAXELS).fill(0), alive: Array(TAXELS).fill(true) }}
);
"""
_STILL = "{ v_x: 0, v_y: 0, omega: 0 }"


def module(program: Program, prefix: str) -> str:
    """The whole module."""
    groups, prefixes = program.groups, {"params": "params.", "memory": "memory."}
    head = _HEAD.format(
        label=program.label,
        robot=program.robot,
        version=__version__,
        helpers=HELPERS,
        p=prefix,
        taxels=program.taxels,
        params=_values(groups["params"]),
        skin_params=_values(groups["skin_params"]),
    )
    tables: dict[bytes, str] = {}
    init = [*_computed(program.init, prefixes, tables), f"  return {_object('memory', groups)};"]
    step = [
        "  if (!Object.values(seen).every(finite)) {",
        f"    return {{ code: 1, memory, twist: {_STILL} }};",
        "  }",
        *_computed(program.step, prefixes | {"observation": "seen."}, tables),
        f"  const next = {_object('memory', groups)};",
        f"  const twist = {_object('twist', groups)};",
        "  if (!Object.values(twist).every(finite) || Object.values(next).some(nan)) {",
        f"    return {{ code: 2, memory, twist: {_STILL} }};",
        "  }",
        "  return { code: 0, memory: next, twist };",
    ]
    own = {"skin_params": "params.", "skin": "skin.", "taxels": "", "period": ""}
    skin = [
        "  if (!finite(taxels) || !finite(period)) return { code: 1, skin, contact: null };",
        *_computed(program.skin_step, own, tables, "contact_"),
        "  const next = { ...skin, signal: contact_skin_signal };",
        f"  const contact = {_object('contact', groups, 'contact_contact_')};",
        "  return { code: 0, skin: next, contact };",
    ]
    parts = [
        head,
        weights(tables),
        *("export function init(params) {", *init, "}\n"),
        *("export function step(params, memory, seen) {", *step, "}\n"),
        *("export function skinStep(params, skin, taxels, period) {", *skin, "}\n"),
    ]
    return "\n".join(parts)


def function(name: str, routine: Routine, tables: dict[bytes, str]) -> str:
    """A routine as a function of its groups of fields; its weights join the tables."""
    prefixes = {group: f"{group}." for group in routine.given}
    found = ", ".join(f"{group}: {_object(group, routine.found)}" for group in routine.found)
    return "\n".join(
        [
            f"function {name}({', '.join(routine.given)}) {{",
            *_computed(routine, prefixes, tables, ""),
            f"  return {{ {found} }};",
            "}\n",
        ]
    )


_UNPACKED = """\
const unpacked = (text, Kind, columns) => {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const all = new Kind(bytes.buffer);
  return Array.from({ length: columns }, (_, j) => all.subarray(j * all.length / columns,
    (j + 1) * all.length / columns));
};
"""


def weights(tables: Mapping[bytes, str]) -> str:
    """The matrices of functions as constants, in so few bytes as lose nothing."""
    return "\n".join([_UNPACKED, *tables.values()]) if tables else ""


def _table(key: bytes) -> str:
    return f"w_{hashlib.sha256(key).hexdigest()[:8]}"


def _packed(name: str, matrix: np.ndarray) -> str:
    """The columns of a matrix as a constant."""
    narrow = matrix.astype("<f4")
    exact = bool(np.all(narrow == matrix))
    kept, kind = (narrow, "Float32Array") if exact else (matrix.astype("<f8"), "Float64Array")
    text = base64.b64encode(np.ascontiguousarray(kept.T).tobytes()).decode()
    return f'const {name} = unpacked("{text}", {kind}, {matrix.shape[1]});'


def _values(group: Group) -> str:
    lines = [f"  {one.name}: {text(np.asarray(one.value).tolist())}," for one in group]
    return "\n".join(["{", *lines, "}"])


def text(value: object) -> str:
    """A value of numbers, texts, lists and mappings as JavaScript."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{json.dumps(k)}: {text(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(text, value)) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return json.dumps(value)


def _object(group: str, groups: Mapping[str, Group], prefix: str = "") -> str:
    """Named values as an object."""
    prefix = prefix or f"{group}_"
    return "{ " + ", ".join(f"{one.name}: {prefix}{one.name}" for one in groups[group]) + " }"


class _Writer(Writer):
    """One routine as lines of JavaScript."""

    forms = _FORMS
    index = "let"

    def literal(self, value: object, kind: str) -> str:
        """A constant."""
        return text(value)

    def flag(self, name: str) -> str:
        """An input that is a bool."""
        return f"Boolean({name})"

    def declared(self, node: Node, constant: bool = True) -> str:
        """The left side of a declaration."""
        return f"{'const' if constant else 'let'} v{node.number}"

    def called(self, name: str, arguments: str) -> str:
        """A call of a function of Math."""
        if name == "erf":
            raise unsupported(name)
        return f"Math.{name}({arguments})"

    def taken(self, node: Node, indent: str) -> list[str]:
        """Statements that take an element at a place."""
        place, *elements = map(self.name, node.args)
        return [f"{indent}{self.declared(node)} = [{', '.join(elements)}][{place}];"]

    def product(self, node: Node, indent: str) -> list[str]:
        """Statements of a product with a matrix."""
        name = _table(node.extra)
        names = ", ".join(map(self.name, node.args))
        return [
            f"{indent}const x{node.number} = [{names}];",
            f"{indent}{self.declared(node)} = {name}.map(",
            f"{indent}  (w) => x{node.number}.reduce((s, x, i) => s + x * w[i], 0));",
        ]


def _computed(
    routine: Routine, groups: Mapping[str, str], tables: dict[bytes, str], prefix: str = ""
) -> list[str]:
    """The statements of a routine, and its results as named values."""
    writer, lines, results = computed(_Writer, routine, groups)
    for key, matrix in writer.target.tables.items():
        tables[key] = _packed(_table(key), matrix)
    for group, field, names in results:
        array = np.array(names, object).reshape(field.shape).tolist()
        group = "skin" if group == "signal" else group
        lines.append(f"  const {prefix}{group}_{field.name} = {_nested(array)};")
    return lines


def _nested(names: object) -> str:
    """Names in nested lists as text."""
    return "[" + ", ".join(map(_nested, names)) + "]" if isinstance(names, list) else str(names)
