"""The emitter of JavaScript: one ES module without dependencies."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterable, Mapping

import numpy as np

from rps_jax import __version__
from rps_jax.app.export.program import Group, Program, Routine
from rps_jax.app.export.writer import FORMS, FUNCTIONS, Writer

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
const zeros = (rows, columns) => Array.from({ length: rows }, () => Array(columns).fill(0));
const unpacked = (text, Kind, rows) => {
  const all = new Kind(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  const columns = all.length / rows;
  return Array.from({ length: rows }, (_, i) => all.subarray(i * columns, (i + 1) * columns));
};
"""

# Placeholders in capitals are lines that are written for a law.
_MODULE = """\
// The law {label} with the skin of the robot {robot}, written by rps_jax {version}: do not edit.
//
// import {{ params, init, step }} from "./{p}.mjs";
// let memory = init(params);
// const {{ code, twist, memory: next }} = step(params, memory, seen);
//
// A code that is not 0 (1: an input was not finite; 2: the law has no finite twist) comes with a
// zero twist and the memory as it was.

{HELPERS}
{TABLES}
const still = {{ v_x: 0, v_y: 0, omega: 0 }};
export const TAXELS = {taxels};
export const params = {PARAMS};
export const skinParams = {SKIN_PARAMS};
export const skinInit = () => (
  {{ signal: Array(TAXELS).fill(0), alive: Array(TAXELS).fill(true) }}
);

export function init(params) {{
{INIT}
  return {MEMORY};
}}

export function step(params, memory, seen) {{
  if (!Object.values(seen).every(finite)) return {{ code: 1, memory, twist: {{ ...still }} }};
{STEP}
  const next = {MEMORY};
  const twist = {TWIST};
  if (!Object.values(twist).every(finite) || Object.values(next).some(nan)) {{
    return {{ code: 2, memory, twist: {{ ...still }} }};
  }}
  return {{ code: 0, memory: next, twist }};
}}

export function skinStep(params, skin, taxels, period) {{
  if (!finite(taxels) || !finite(period)) return {{ code: 1, skin, contact: null }};
{SKIN}
  const next = {{ ...skin, signal: found_filtered_signal }};
  return {{ code: 0, skin: next, contact: {CONTACT} }};
}}
"""


class _Writer(Writer):
    """One routine as statements of JavaScript."""

    compiler = "the JavaScript exporter"
    forms = _FORMS
    functions = FUNCTIONS - {"erf"}
    call = "Math.{0}({1})"
    heads = ("let {name}", "const {name}")
    index = "let"
    flag = "Boolean({})"
    zeros = "zeros({}, {})"

    def literal(self, value: object, kind: str) -> str:
        """A constant."""
        return text(value)

    def listed(self, texts: Iterable[str]) -> str:
        """An array of these elements."""
        return f"[{', '.join(texts)}]"

    def packed(self, name: str, array: np.ndarray) -> str:
        """Constants before the functions; of a matrix in so few bytes as lose nothing."""
        if array.ndim < 2:
            return f"const {name} = {text(array.tolist())};"
        exact = bool(np.all(array.astype("<f4") == array))
        kind, dtype = ("Float32Array", "<f4") if exact else ("Float64Array", "<f8")
        packed = base64.b64encode(array.astype(dtype).tobytes()).decode()
        return f'const {name} = unpacked("{packed}", {kind}, {len(array)});'


def module(program: Program, prefix: str) -> str:
    """The whole module."""
    groups, tables = program.groups, dict[str, str]()
    law = {"params": "params.", "memory": "memory.", "observation": "seen."}
    skin = {"skin_params": "params.", "skin": "skin.", "scan": ""}
    lines = {
        "HELPERS": HELPERS,
        "PARAMS": _values(groups["params"]),
        "SKIN_PARAMS": _values(groups["skin_params"]),
        "INIT": _computed(program.init, law, tables),
        "STEP": _computed(program.step, law, tables),
        "SKIN": _computed(program.skin_step, skin, tables),
        **{name.upper(): _object(name, groups) for name in ("memory", "twist", "contact")},
    }
    return _MODULE.format(
        **lines,
        TABLES="\n".join(tables.values()),
        **{"label": program.label, "robot": program.robot, "version": __version__},
        **{"p": prefix, "taxels": program.taxels},
    )


def function(name: str, routine: Routine, tables: dict[str, str]) -> str:
    """A routine as a function of its groups of fields; its weights join the tables."""
    lines = _computed(routine, {group: f"{group}." for group in routine.given}, tables)
    found = ", ".join(f"{group}: {_object(group, routine.found)}" for group in routine.found)
    head = f"function {name}({', '.join(routine.given)}) {{"
    return f"{head}\n{lines}\n  return {{ {found} }};\n}}\n"


def text(value: object) -> str:
    """A value of numbers, texts, lists and mappings as JavaScript."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{json.dumps(k)}: {text(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(text, value)) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return json.dumps(value)


def _values(group: Group) -> str:
    lines = [f"  {one.name}: {text(np.asarray(one.value).tolist())}," for one in group]
    return "\n".join(["{", *lines, "}"])


def _object(group: str, groups: Mapping[str, Group]) -> str:
    """Results of a routine as an object."""
    return "{ " + ", ".join(f"{x.name}: found_{group}_{x.name}" for x in groups[group]) + " }"


def _computed(routine: Routine, groups: Mapping[str, str], tables: dict[str, str]) -> str:
    """Statements that compute the results of a routine, as named values."""
    writer = _Writer(routine, groups, tables)
    lines = list(writer.body)
    for group, field, names in writer.results:
        array = np.array(names, object).reshape(field.shape).tolist()
        lines.append(f"  const found_{group}_{field.name} = {_nested(array)};")
    return "\n".join(lines)


def _nested(names: object) -> str:
    """Names in nested lists as text."""
    return "[" + ", ".join(map(_nested, names)) + "]" if isinstance(names, list) else str(names)
