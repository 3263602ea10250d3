"""The exported C99 header of a law and a skin."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

import numpy as np

from rps_jax.app.export.program import Program
from rps_jax.lowering.c import HELPERS, literal, statements, struct
from rps_jax.lowering.routine import Field, Group, Routine


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


def _stack(text: str) -> int:
    """Return the size [B] of the local variables in statements, in float."""
    sizes = re.findall(r"^ +\w+ \w+(?:\[(\d+)\])?(?: =|;)", text, re.MULTILINE)
    return 4 * sum(int(size or 1) for size in sizes)


def header(program: Program, prefix: str) -> str:
    """Return the whole header, in whose template capitals are lines that are printed for a law."""
    p, upper, groups, tables = prefix, prefix.upper(), program.groups, dict[str, str]()
    law = {name: f"{name}->" for name in ("params", "memory", "observation")}
    skin = {"skin_params": "params->", "skin": "skin->", "scan": ""}
    structs = ("params", "memory", "observation", "twist", "skin_params", "skin", "contact")

    def body(routine: Routine, inputs: Mapping[str, str], **outputs: str) -> str:
        return statements(routine, inputs, outputs, tables, p)

    def checks(name: str, owner: str, code: str, fault: str = "!{p}_finite") -> str:
        statement = f"if ({fault.format(p=p)}({{}})) return {upper}_{code};"
        return _for_each(groups[name], owner, statement)

    lines = {
        "INIT": body(program.init, law, memory="memory->"),
        "STEP": body(program.step, law, memory="next.", twist="result."),
        "SKIN": body(program.skin_step, skin, filtered="next.", contact="result."),
        "STEP_CHECKED": checks("observation", "observation->", "BAD_INPUT"),
        "STEP_RESULT": checks("twist", "result.", "BAD_RESULT"),
        "STEP_MEMORY": checks("memory", "next.", "BAD_RESULT", "{p}_nan"),
        "NO_CONTACT": _for_each(groups["contact"], "contact->", "{} = 0;", "fib"),
        "SKIN_CHECKED": checks("scan", "", "BAD_INPUT"),
        "SKIN_RESULT": checks("skin", "next.", "BAD_RESULT"),
        "STRUCTS": "\n".join(struct(p, name, groups[name]) for name in structs),
        "INITIALISERS": _initialiser(p, "params", groups) + _initialiser(p, "skin_params", groups),
        "TABLES": "\n".join([*tables.values(), ""] if tables else []),
        "HELPERS": HELPERS.format(p=p, P=upper),
    }
    axle = program.about_axle(f"#define {upper}_AXLE {{}}")
    stack = max(map(_stack, (lines["STEP"], lines["SKIN"])))
    size = f"{math.ceil(stack / 1000)} kB"
    return program.fill("law.h.in", p, **lines, stack=size, axle=axle)
