"""The emitter of C99: one header, and beside it an example, a CMake file and a page."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rps_jax import __version__
from rps_jax.app.export.program import Field, Group, Program, Routine
from rps_jax.app.export.scalars import Node
from rps_jax.app.export.writer import FORMS, Writer, computed

_KINDS = {"f": "{p}_real", "i": "int", "b": "int"}
_NAMES = {"abs": "fabs", "rem": "fmod"}
# How an operation is written that is no function of math.h.
_FORMS = FORMS | {
    "max": "{p}_max({0}, {1})",
    "min": "{p}_min({0}, {1})",
    "sign": "{p}_sign({0})",
    "logistic": "{p}_logistic({0})",
    "is_finite": "isfinite({0}) != 0",
    "iadd": "(int)((unsigned)({0}) + (unsigned)({1}))",
    "isub": "(int)((unsigned)({0}) - (unsigned)({1}))",
    "imul": "(int)((unsigned)({0}) * (unsigned)({1}))",
    "idiv": "{p}_idiv({0}, {1})",
    "irem": "{p}_irem({0}, {1})",
    "ineg": "(int)(0u - (unsigned)({0}))",
    "iabs": "{0} < 0 ? (int)(0u - (unsigned)({0})) : {0}",
    "imax": "{0} > {1} ? {0} : {1}",
    "imin": "{0} < {1} ? {0} : {1}",
    "isign": "({0} > 0) - ({0} < 0)",
    "f_of_i": "({p}_real){0}",
    "f_of_b": "({p}_real){0}",
    "i_of_f": "{p}_int({0})",
    "i_of_b": "{0}",
}

_HELPERS = """\
/* As JAX has them: NaN goes on, and no whole number overflows. */
static inline {p}_real {p}_max({p}_real a, {p}_real b) {{ return a >= b || a != a ? a : b; }}
static inline {p}_real {p}_min({p}_real a, {p}_real b) {{ return a <= b || a != a ? a : b; }}
static inline {p}_real {p}_sign({p}_real x) {{
  return x > 0 ? ({p}_real)1 : x < 0 ? ({p}_real)-1 : x;
}}
static inline {p}_real {p}_logistic({p}_real x) {{ return 1 / (1 + {P}_F(exp)(-x)); }}
static inline int {p}_int({p}_real x) {{
  return x != x ? 0 : x >= ({p}_real)2147483647 ? 2147483647
       : x <= ({p}_real)-2147483647 ? -2147483647 - 1 : (int)x;
}}
static inline int {p}_idiv(int a, int b) {{
  return b == 0 ? -1 : b == -1 ? (int)(0u - (unsigned)a) : a / b;
}}
static inline int {p}_irem(int a, int b) {{ return b == 0 ? a : b == -1 ? 0 : a % b; }}
"""

_HEAD = """\
/* The law {label} with the skin of the robot {robot}, written by rps_jax {version}: do not edit.

   C99 without allocation; it needs math.h alone. Numbers are float, or double if {P}_DOUBLE is
   defined. Frames: the world, and the robot (origin at the middle of the base, x forward, y left).

     {p}_params params = {P}_PARAMS;              the chosen parameters
     {p}_memory memory;
     {p}_init(&params, &memory);
     {p}_step(&params, &memory, &seen, &twist);   once in each control period

   A step returns {P}_OK, or another code: then the twist is zero and the memory as it was. Do not
   compile with -ffast-math, which takes no number for infinite. */

#ifndef {P}_H
#define {P}_H

#include <math.h>

#ifdef {P}_DOUBLE
typedef double {p}_real;
#define {P}_F(name) name
#else
typedef float {p}_real;
#define {P}_F(name) name##f
#endif

#define {P}_TAXELS {taxels}

enum {{
  {P}_OK = 0,
  {P}_BAD_INPUT = 1, /* an input was NaN or infinite */
  {P}_BAD_RESULT = 2 /* the law has no finite twist for these numbers */
}};

"""


class _Writer(Writer):
    """One routine as lines of C."""

    forms = _FORMS
    index = "int"

    def __init__(self, *arguments: Any):
        """Begin without tables."""
        super().__init__(*arguments)
        self.tables: list[str] = []  # before the function
        self._named: dict[object, str] = {}

    def literal(self, value: object, kind: str) -> str:
        """A constant."""
        if kind != "f":
            small = int(value)  # pyright: ignore[reportArgumentType]
            return str(small) if small > -(2**31) else "-2147483647 - 1"
        number = float(value)  # pyright: ignore[reportArgumentType]
        text = "NAN" if math.isnan(number) else repr(number).replace("inf", "INFINITY")
        return f"({self.prefix}_real){text}"

    def flag(self, name: str) -> str:
        """An input that is a bool, of which C takes any other number than 0 for one."""
        return f"({name} != 0)"

    def declared(self, node: Node, constant: bool = True) -> str:
        """The left side of a declaration."""
        return f"{'const ' * constant}{self.kind(node.kind)} v{node.number}"

    def kind(self, kind: str) -> str:
        """The type of a kind of numbers."""
        return _KINDS[kind].format(p=self.prefix)

    def called(self, name: str, arguments: str) -> str:
        """A call of a function of math.h, of float or of double."""
        return f"{self.prefix.upper()}_F({_NAMES.get(name, name)})({arguments})"

    def product(self, node: Node, indent: str) -> list[str]:
        """Statements of a product with a matrix."""
        real, n, matrix = f"{self.prefix}_real", node.number, self.target.tables[node.extra]
        table = self.table(matrix, "weights")
        rows, columns = matrix.shape
        return [
            *_array(f"{indent}const {real} x{n}[{rows}] = ", map(self.name, node.args)),
            f"{indent}{real} v{n}[{columns}] = {{0}};",
            f"{indent}for (int i = 0; i < {rows}; i++) {{",
            f"{indent}  for (int j = 0; j < {columns}; j++) v{n}[j] += x{n}[i] * {table}[i][j];",
            f"{indent}}}",
        ]

    def taken(self, node: Node, indent: str) -> list[str]:
        """Statements that take an element at a place."""
        place, *elements = node.args
        if all(one.op == "constant" for one in elements):
            table, before = self.table(np.array([one.extra for one in elements]), "table"), []
        else:
            table = f"t{node.number}"
            declared = f"{indent}const {self.kind(node.kind)} {table}[{len(elements)}] = "
            before = _array(declared, map(self.name, elements))
        return [*before, f"{indent}{self.declared(node)} = {table}[{self.name(place)}];"]

    def table(self, array: np.ndarray, what: str) -> str:
        """The name of constants before the function."""
        key = (array.tobytes(), array.shape, array.dtype.str)
        if key not in self._named:
            self._named[key] = f"{self.prefix}_{self.own}_{what}_{len(self._named)}"
            sizes = "".join(f"[{size}]" for size in array.shape)
            kind = self.kind("f" if array.dtype.kind == "f" else "i")
            self.tables += _array(
                f"static const {kind} {self._named[key]}{sizes} = ", _texts(array)
            )
        return self._named[key]


def _texts(array: np.ndarray) -> list[str]:
    if array.ndim == 2:
        return [f"{{{', '.join(_texts(row))}}}" for row in array]
    return [repr(float(x)) if array.dtype.kind == "f" else str(int(x)) for x in array]


def _array(head: str, texts: Iterable[str]) -> list[str]:
    """An array with its elements, in lines of some width."""
    lines = textwrap.wrap(", ".join(texts), 96, break_long_words=False)
    return [head + "{", *(f"    {line}" for line in lines), "};"]


def _struct(prefix: str, name: str, group: Group) -> str:
    lines = []
    for one in filter(lambda one: one.size, group):
        sizes = "".join(f"[{size}]" for size in one.shape)
        about = f" /* {one.about} */" if one.about else ""
        lines.append(f"  {_KINDS[one.kind].format(p=prefix)} {one.name}{sizes};{about}")
    empty = "  char nothing; /* it needs none */"
    return "\n".join(["typedef struct {", *(lines or [empty]), f"}} {prefix}_{name};", ""])


def _initialiser(prefix: str, name: str, group: Group) -> str:
    writer, lines = _Writer({}, None, prefix), []

    def text(value: np.ndarray) -> str:
        if value.ndim:
            return "{" + ", ".join(map(text, value)) + "}"
        return writer.literal(value.item(), "f")

    for one in group:
        lines.append(f"  {text(np.asarray(one.value))}, /* {one.name} */ \\")
    lines = lines or ["  0 \\"]
    return "\n".join([f"#define {prefix.upper()}_{name} {{ \\", *lines, "}", ""])


def _each(fields: Sequence[Field], of: str, text: str, kinds: str = "fib") -> list[str]:
    """Lines with a statement about each number of these fields."""
    found = []
    for one in fields:
        if one.kind in kinds and one.size:
            name, indent = f"{of}{one.name}", "  "
            for letter, size in zip("ijkl", one.shape, strict=False):
                found.append(f"{indent}for (int {letter} = 0; {letter} < {size}; {letter}++)")
                name, indent = f"{name}[{letter}]", indent + "  "
            found.append(indent + text.format(name))
    return found


def _refusals(fields: Sequence[Field], of: str, test: str, code: str) -> list[str]:
    """Lines that return a code if a real number of these fields passes a test."""
    return _each(fields, of, f"if ({test}) return {code};", "f")


def _computed(
    prefix: str, routine: Routine, groups: Mapping[str, str], stores: Mapping[str, str]
) -> tuple[list[str], list[str]]:
    """The tables of a routine, and the statements that compute and store its results."""
    writer, lines, results = computed(_Writer, routine, groups, prefix)
    for group, field, names in results:
        for place, name in zip(np.ndindex(field.shape), names, strict=True):
            at = "".join(f"[{i}]" for i in place)
            lines.append(f"  {stores[group]}{field.name}{at} = {name};")
    for group, fields in routine.found.items():
        if not any(one.size for one in fields):
            lines.append(f"  {stores[group]}nothing = 0;")
    assert isinstance(writer, _Writer)
    return writer.tables, lines


def header(program: Program, prefix: str) -> str:
    """The whole header."""
    p, upper, groups = prefix, prefix.upper(), program.groups
    names = {"label": program.label, "robot": program.robot, "version": __version__}
    names |= {"p": p, "P": upper, "taxels": program.taxels}
    structs = ("params", "memory", "observation", "twist", "skin_params", "skin", "contact")
    parts = [
        _HEAD.format(**names),
        "\n".join(_struct(p, name, groups[name]) for name in structs),
        _initialiser(p, "PARAMS", groups["params"]),
        _initialiser(p, "SKIN_PARAMS", groups["skin_params"]),
        _HELPERS.format(**names),
        *(make(program, p) for make in (_init, _step, _skin)),
        f"#endif /* {upper}_H */\n",
    ]
    return "\n".join(parts)


def _function(head: str, about: str, tables: list[str], lines: list[str]) -> str:
    return "\n".join([*tables, f"/* {about} */", f"static inline {head} {{", *lines, "}", ""])


def _init(program: Program, p: str) -> str:
    tables, lines = _computed(p, program.init, {"params": "params->"}, {"memory": "memory->"})
    head = f"void {p}_init(const {p}_params *params, {p}_memory *memory)"
    return _function(head, "The memory before the first step.", tables, ["  (void)params;", *lines])


def _step(program: Program, p: str) -> str:
    groups = {"params": "params->", "memory": "memory->", "observation": "seen->"}
    tables, lines = _computed(p, program.step, groups, {"memory": "next.", "twist": "found."})
    upper = p.upper()
    bad = f"{upper}_BAD_RESULT"
    inner = [
        "  (void)params;",
        "  twist->v_x = twist->v_y = twist->omega = 0;",
        *_refusals(program.groups["observation"], "seen->", "!isfinite({})", f"{upper}_BAD_INPUT"),
        f"  {p}_memory next;",
        f"  {p}_twist found;",
        *lines,
        *_refusals(program.groups["twist"], "found.", "!isfinite({})", bad),
        *_refusals(program.groups["memory"], "next.", "{0} != {0}", bad),
        "  *memory = next;",
        "  *twist = found;",
        f"  return {upper}_OK;",
    ]
    head = (
        f"int {p}_step(const {p}_params *params, {p}_memory *memory,\n"
        f"    const {p}_observation *seen, {p}_twist *twist)"
    )
    return _function(head, "One control step; returns a code.", tables, inner)


def _skin(program: Program, p: str) -> str:
    groups = {"skin_params": "params->", "skin": "skin->", "taxels": "", "period": ""}
    stores, upper = {"signal": "next.", "contact": "found."}, p.upper()
    tables, lines = _computed(p, program.skin_step, groups, stores)
    group = program.groups
    start = _function(
        f"void {p}_skin_init({p}_skin *skin)",
        "The skin before it has felt anything, with all its taxels alive.",
        [],
        [
            f"  for (int i = 0; i < {upper}_TAXELS; i++) {{",
            "    skin->signal[i] = 0;",
            "    skin->alive[i] = 1;",
            "  }",
        ],
    )
    inner = [
        *_each(group["contact"], "contact->", "{} = 0;"),
        *_refusals((*group["taxels"], *group["period"]), "", "!isfinite({})", f"{upper}_BAD_INPUT"),
        f"  {p}_skin next = *skin;",
        f"  {p}_contact found;",
        *lines,
        *_refusals(group["skin"], "next.", "!isfinite({})", f"{upper}_BAD_RESULT"),
        "  *skin = next;",
        "  *contact = found;",
        f"  return {upper}_OK;",
    ]
    head = (
        f"int {p}_skin_step(const {p}_skin_params *params, {p}_skin *skin,\n"
        f"    const {p}_real taxels[{upper}_TAXELS], {p}_real period, {p}_contact *contact)"
    )
    about = "One scan of all taxels, `period` [s] after the last; returns a code."
    return start + "\n" + _function(head, about, tables, inner)
