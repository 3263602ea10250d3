"""The exported C99 header of a law and a skin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rps_jax import __version__
from rps_jax.app.export.program import Program
from rps_jax.lowering.c import HELPERS, literal, statements, struct
from rps_jax.lowering.routine import Field, Group, Routine

# Placeholders in capitals are lines that are printed for a law.
_HEADER = """\
/* The law {label} with the skin of the robot {robot}, written by rps_jax {version}: do not edit.

   C99 without allocation; it needs math.h alone. Numbers are float, or double if {P}_DOUBLE is
   defined. Frames: the world, and the robot (origin at the middle of the base, x forward, y left).
   Call {p}_init once and {p}_step in each control period, and {p}_skin_init once and
   {p}_skin_step for each scan of the taxels, as the example main.c does.

   Taxels are in the order of the strip: left side from the rear, front from left to right, right
   side from the front. One whose `alive` is 0 is ignored, but must be finite. A step returns
   {P}_OK, or another code: then the twist is zero (there is no contact), and the memory is
   unchanged. Do not compile with -ffast-math: it assumes that all numbers are finite. */

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
    const {p}_observation *observation, {p}_twist *twist) {{
  (void)params;
  twist->v_x = twist->v_y = twist->omega = 0;
{STEP_CHECKED}
  {p}_memory next;
  {p}_twist result;
{STEP}
{STEP_RESULT}
{STEP_MEMORY}
  *memory = next;
  *twist = result;
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
  {p}_contact result;
{SKIN}
{SKIN_RESULT}
  *skin = next;
  *contact = result;
  return {P}_OK;
}}

#endif /* {P}_H */
"""


def _initialiser(prefix: str, name: str, groups: Mapping[str, Group]) -> str:
    """Return the macro of the initial values of a group."""

    def text(value: np.ndarray) -> str:
        if value.ndim:
            return "{" + ", ".join(map(text, value)) + "}"
        return literal(prefix, value.item(), "f")

    lines = [f"  {text(np.asarray(field.value))}, /* {field.name} */ \\" for field in groups[name]]
    head = f"#define {prefix.upper()}_{name.upper()} {{ \\"
    return "\n".join([head, *(lines or ["  0 \\"]), "}\n"])


def _for_each(fields: Sequence[Field], prefix: str, statement: str, kinds: str = "f") -> str:
    """Return a statement about each number of the fields of some kinds."""
    lines = []
    for field in fields:
        if field.kind in kinds and field.size:
            name, indent = f"{prefix}{field.name}", "  "
            for letter, size in zip("ijkl", field.shape, strict=False):
                lines.append(f"{indent}for (int {letter} = 0; {letter} < {size}; {letter}++)")
                name, indent = f"{name}[{letter}]", indent + "  "
            lines.append(indent + statement.format(name))
    return "\n".join(lines)


def header(program: Program, prefix: str) -> str:
    """Return the whole header."""
    p, upper, groups, tables = prefix, prefix.upper(), program.groups, dict[str, str]()
    law = {name: f"{name}->" for name in ("params", "memory", "observation")}
    skin = {"skin_params": "params->", "skin": "skin->", "scan": ""}
    structs = ("params", "memory", "observation", "twist", "skin_params", "skin", "contact")

    def body(routine: Routine, inputs: Mapping[str, str], **outputs: str) -> str:
        return statements(routine, inputs, outputs, tables, p)

    def checks(name: str, owner: str, code: str, condition: str = "!isfinite({0})") -> str:
        return _for_each(groups[name], owner, f"if ({condition}) return {upper}_{code};")

    lines = {
        "INIT": body(program.init, law, memory="memory->"),
        "STEP": body(program.step, law, memory="next.", twist="result."),
        "SKIN": body(program.skin_step, skin, filtered="next.", contact="result."),
        "STEP_CHECKED": checks("observation", "observation->", "BAD_INPUT"),
        "STEP_RESULT": checks("twist", "result.", "BAD_RESULT"),
        "STEP_MEMORY": checks("memory", "next.", "BAD_RESULT", "{0} != {0}"),
        "NO_CONTACT": _for_each(groups["contact"], "contact->", "{} = 0;", "fib"),
        "SKIN_CHECKED": checks("scan", "", "BAD_INPUT"),
        "SKIN_RESULT": checks("skin", "next.", "BAD_RESULT"),
        "STRUCTS": "\n".join(struct(p, name, groups[name]) for name in structs),
        "INITIALISERS": _initialiser(p, "params", groups) + _initialiser(p, "skin_params", groups),
        "TABLES": "\n".join([*tables.values(), ""] if tables else []),
        "HELPERS": HELPERS.format(p=p, P=upper),
    }
    about = {"label": program.label, "robot": program.robot, "version": __version__}
    return _HEADER.format(**lines, **about, p=p, P=upper, taxels=program.taxels)
