"""The emitter of C99: one header."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from rps_jax import __version__
from rps_jax.app.export.program import Field, Group, Program, Routine
from rps_jax.app.export.writer import FORMS, Writer

_KINDS = {"f": "{p}_real", "i": "int", "b": "int"}
# How an operation is written that is no function of math.h.
_FORMS = FORMS | {
    "abs": "{P}_F(fabs)({0})",
    "rem": "{P}_F(fmod)({0}, {1})",
    "max": "{p}_max({0}, {1})",
    "min": "{p}_min({0}, {1})",
    "sign": "{p}_sign({0})",
    "tanh": "{p}_tanh({0})",
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


# Placeholders in capitals are lines that are written for a law.
_HEADER = """\
/* The law {label} with the skin of the robot {robot}, written by rps_jax {version}: do not edit.

   C99 without allocation; it needs math.h alone. Numbers are float, or double if {P}_DOUBLE is
   defined. Frames: the world, and the robot (origin at the middle of the base, x forward, y left).

     {p}_params params = {P}_PARAMS;              the chosen parameters
     {p}_memory memory;
     {p}_init(&params, &memory);
     {p}_step(&params, &memory, &seen, &twist);   once in each control period

     {p}_skin_params skin_params = {P}_SKIN_PARAMS;
     {p}_skin skin;
     {p}_skin_init(&skin);
     {p}_skin_step(&skin_params, &skin, taxels, period, &contact);   once for each scan

   Taxels are in the order of the strip: left side from the rear, front from left to right, right
   side from the front. One whose `alive` is 0 is ignored, but must be finite. A step returns
   {P}_OK, or another code: then the twist is zero (there is no contact), and the memory is as it
   was. Do not compile with -ffast-math, which takes no number for infinite. */

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

{STRUCTS}
{INITIALISERS}
{HELPERS}
{TABLES}
/* The memory before the first step. */
static inline void {p}_init(const {p}_params *params, {p}_memory *memory) {{
  (void)params;
{INIT}
}}

/* One control step; returns a code. */
static inline int {p}_step(const {p}_params *params, {p}_memory *memory,
    const {p}_observation *seen, {p}_twist *twist) {{
  (void)params;
  twist->v_x = twist->v_y = twist->omega = 0;
{STEP_CHECKED}
  {p}_memory next;
  {p}_twist found;
{STEP}
{STEP_RESULT}
  *memory = next;
  *twist = found;
  return {P}_OK;
}}

/* The skin before it has felt anything, with all its taxels alive. */
static inline void {p}_skin_init({p}_skin *skin) {{
  for (int i = 0; i < {P}_TAXELS; i++) {{
    skin->signal[i] = 0;
    skin->alive[i] = 1;
  }}
}}

/* One scan of all taxels, `period` [s] after the last; returns a code. */
static inline int {p}_skin_step(const {p}_skin_params *params, {p}_skin *skin,
    const {p}_real taxels[{P}_TAXELS], {p}_real period, {p}_contact *contact) {{
{NO_CONTACT}
{SKIN_CHECKED}
  {p}_skin next = *skin;
  {p}_contact found;
{SKIN}
{SKIN_RESULT}
  *skin = next;
  *contact = found;
  return {P}_OK;
}}

#endif /* {P}_H */
"""

HELPERS = """\
/* As JAX has them: NaN goes on, and no whole number overflows. */
static inline {p}_real {p}_max({p}_real a, {p}_real b) {{ return a >= b || a != a ? a : b; }}
static inline {p}_real {p}_min({p}_real a, {p}_real b) {{ return a <= b || a != a ? a : b; }}
static inline {p}_real {p}_sign({p}_real x) {{
  return x > 0 ? ({p}_real)1 : x < 0 ? ({p}_real)-1 : x;
}}
static inline {p}_real {p}_logistic({p}_real x) {{ return 1 / (1 + {P}_F(exp)(-x)); }}
/* Lambert's fraction near zero, which is exact to a rounding there and spares a call of tanh. */
static inline {p}_real {p}_tanh({p}_real x) {{
  const {p}_real a = {P}_F(fabs)(x), s = x * x;
  if (a < ({p}_real)0.5)
    return x * (135135 + s * (17325 + s * (378 + s)))
         / (135135 + s * (62370 + s * (3150 + s * 28)));
  return {P}_F(copysign)(1 - 2 / (1 + {P}_F(exp)(2 * a)), x);
}}
static inline int {p}_int({p}_real x) {{
  return x != x ? 0 : x >= ({p}_real)2147483648.0 ? 2147483647
       : x <= ({p}_real)-2147483648.0 ? -2147483647 - 1 : (int)x;
}}
static inline int {p}_idiv(int a, int b) {{
  return b == 0 ? -1 : b == -1 ? (int)(0u - (unsigned)a) : a / b;
}}
static inline int {p}_irem(int a, int b) {{ return b == 0 ? a : b == -1 ? 0 : a % b; }}
"""


class _Writer(Writer):
    """One routine as statements of C."""

    compiler = "the C exporter"
    forms = _FORMS
    call = "{P}_F({0})({1})"
    heads = ("{kind} {sized}", "const {kind} {sized}")
    kinds = _KINDS
    index = "int"
    flag = "({} != 0)"  # C takes any other number than 0 for true
    zeros = "{{{{0}}}}"

    def literal(self, value: object, kind: str) -> str:
        """A constant."""
        return _literal(self.prefix, value, kind)

    def listed(self, texts: Iterable[str]) -> str:
        """An array of these elements, in lines of some width."""
        text = " ".join(", ".join(texts).split())
        lines = textwrap.wrap(text, 92, break_long_words=False, break_on_hyphens=False)
        return "{" + (text if len(lines) < 2 else "\n    " + "\n    ".join(lines)) + "}"

    def packed(self, name: str, array: np.ndarray) -> str:
        """The declaration of constants that stand before the functions."""
        kind = "f" if array.dtype.kind == "f" else "i"

        def text(value: np.ndarray) -> str:
            return self.listed(map(text, value)) if value.ndim else str(value.item())

        return f"static {self.declared(name, kind, array.shape)} = {text(array)};"


def _literal(prefix: str, value: object, kind: str) -> str:
    """A constant."""
    if kind != "f":
        small = int(value)  # pyright: ignore[reportArgumentType]
        return str(small) if small > -(2**31) else "-2147483647 - 1"
    number = float(value)  # pyright: ignore[reportArgumentType]
    text = "NAN" if math.isnan(number) else repr(number).replace("inf", "INFINITY")
    return f"({prefix}_real){text}"


def _sized(name: str, sizes: Iterable[int]) -> str:
    return name + "".join(f"[{size}]" for size in sizes)


def _struct(prefix: str, name: str, group: Group) -> str:
    lines = [
        f"  {_KINDS[one.kind].format(p=prefix)} {_sized(one.name, one.shape)};"
        + (f" /* {one.about} */" if one.about else "")
        for one in group
        if one.size
    ]
    empty = "  char nothing; /* it needs none */"
    return "\n".join(["typedef struct {", *(lines or [empty]), f"}} {prefix}_{name};", ""])


def _initialiser(prefix: str, name: str, group: Group) -> str:
    def text(value: np.ndarray) -> str:
        if value.ndim:
            return "{" + ", ".join(map(text, value)) + "}"
        return _literal(prefix, value.item(), "f")

    lines = [f"  {text(np.asarray(one.value))}, /* {one.name} */ \\" for one in group]
    head = f"#define {prefix.upper()}_{name} {{ \\"
    return "\n".join([head, *(lines or ["  0 \\"]), "}", ""])


def _each(fields: Sequence[Field], of: str, text: str, kinds: str = "f") -> str:
    """Lines with a statement about each number of these fields, real ones if not told otherwise."""
    found = []
    for one in fields:
        if one.kind in kinds and one.size:
            name, indent = f"{of}{one.name}", "  "
            for letter, size in zip("ijkl", one.shape, strict=False):
                found.append(f"{indent}for (int {letter} = 0; {letter} < {size}; {letter}++)")
                name, indent = f"{name}[{letter}]", indent + "  "
            found.append(indent + text.format(name))
    return "\n".join(found)


def _computed(
    routine: Routine, groups: Mapping[str, str], stores: Mapping[str, str],
    tables: dict[str, str], prefix: str,
) -> str:  # fmt: skip
    """Statements that compute the results of a routine and store them."""
    writer = _Writer(routine, groups, tables, prefix)
    lines = list(writer.body)
    for group, field, names in writer.results:
        for place, name in zip(np.ndindex(field.shape), names, strict=True):
            lines.append(f"  {stores[group]}{_sized(field.name, place)} = {name};")
    for group, fields in routine.found.items():
        if not any(one.size for one in fields):
            lines.append(f"  {stores[group]}nothing = 0;")
    return "\n".join(lines)


def header(program: Program, prefix: str) -> str:
    """The whole header."""
    p, upper, groups = prefix, prefix.upper(), program.groups
    bad_input, bad_result = f"return {upper}_BAD_INPUT;", f"return {upper}_BAD_RESULT;"
    odd, tables = "if (!isfinite({})) ", dict[str, str]()
    structs = ("params", "memory", "observation", "twist", "skin_params", "skin", "contact")
    law = {"params": "params->", "memory": "memory->", "observation": "seen->"}
    skin = {"skin_params": "params->", "skin": "skin->", "scan": ""}
    lines = {
        "INIT": _computed(program.init, law, {"memory": "memory->"}, tables, p),
        "STEP": _computed(program.step, law, {"memory": "next.", "twist": "found."}, tables, p),
        "SKIN": _computed(
            program.skin_step, skin, {"filtered": "next.", "contact": "found."}, tables, p
        ),
        "STEP_CHECKED": _each(groups["observation"], "seen->", odd + bad_input),
        "STEP_RESULT": "\n".join(
            [
                _each(groups["twist"], "found.", odd + bad_result),
                _each(groups["memory"], "next.", "if ({0} != {0}) " + bad_result),
            ]
        ),
        "NO_CONTACT": _each(groups["contact"], "contact->", "{} = 0;", "fib"),
        "SKIN_CHECKED": _each(groups["scan"], "", odd + bad_input),
        "SKIN_RESULT": _each(groups["skin"], "next.", odd + bad_result),
        "STRUCTS": "\n".join(_struct(p, name, groups[name]) for name in structs),
        "INITIALISERS": "\n".join(
            _initialiser(p, name.upper(), groups[name]) for name in ("params", "skin_params")
        ),
    }
    return _HEADER.format(
        **lines,
        HELPERS=HELPERS.format(p=p, P=upper),
        TABLES="\n".join([*tables.values(), ""] if tables else []),
        **{"label": program.label, "robot": program.robot, "version": __version__},
        **{"p": p, "P": upper, "taxels": program.taxels},
    )
