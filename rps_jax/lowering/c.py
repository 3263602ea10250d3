"""Printer of scalar C99: the statements of a routine, its structs and its helper functions."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping

import numpy as np

from rps_jax.lowering.graph import kind_of
from rps_jax.lowering.operations import spelled
from rps_jax.lowering.routine import Group, Routine
from rps_jax.lowering.scalar import ScalarWriter
from rps_jax.lowering.writer import literal as literal_of

# `{p}` is the prefix of all names, `{P}` the same in capitals.
HELPERS = """\
/* As in JAX, NaN propagates. */
static inline {p}_real {p}_max({p}_real a, {p}_real b) {{ return a >= b || a != a ? a : b; }}
static inline {p}_real {p}_min({p}_real a, {p}_real b) {{ return a <= b || a != a ? a : b; }}
/* Lambert's fraction near zero, which is exact to a rounding and avoids a call of tanh. */
static inline {p}_real {p}_tanh({p}_real x) {{
  const {p}_real a = {P}_F(fabs)(x), s = x * x;
  if (a < ({p}_real)0.5)
    return x * (135135 + s * (17325 + s * (378 + s)))
         / (135135 + s * (62370 + s * (3150 + s * 28)));
  return {P}_F(copysign)(1 - 2 / (1 + {P}_F(exp)(2 * a)), x);
}}
"""


class CWriter(ScalarWriter):
    """Printer of one routine as statements of C99."""

    spelling = spelled("c")
    flag = "({} != 0)"  # C takes any number but 0 for true
    alias = "const {head} = &{corner};"
    pointer = "*"
    zeros = "{{0}}"

    def type_of(self, kind: str) -> str:
        return type_of(kind, self.prefix)

    def declaration(self, kind: str, name: str, size: int = 1, constant: bool = True) -> str:
        # Clang expands each constant in the initialisers of others, in exponential time.
        return super().declaration(kind, name, size, constant=False)

    def literal(self, value: float, kind: str) -> str:
        return literal(self.prefix, value, kind)

    def array_literal(self, texts: Iterable[str]) -> str:
        text = " ".join(", ".join(texts).split())
        lines = textwrap.wrap(text, 92, break_long_words=False, break_on_hyphens=False)
        return "{" + (text if len(lines) < 2 else "\n    " + "\n    ".join(lines)) + "}"

    def table_declaration(self, name: str, array: np.ndarray) -> str:
        kind = kind_of(array.dtype)

        def text(value: np.ndarray) -> str:
            if value.ndim:
                return self.array_literal(map(text, value))
            # A float in its shortest form, if it is one, also for double.
            short = np.float32(value)
            exact = kind == "f" and np.isfinite(short) and float(short) == float(value)
            return f"{short!s}f" if exact else self.literal(value.item(), kind)

        sized = sized_name(name, array.shape)
        return f"static const {self.declaration(kind, sized)} = {text(array)};"


def type_of(kind: str, prefix: str) -> str:
    """Return the type of a number."""
    return f"{prefix}_real" if kind == "f" else "int"


def literal(prefix: str, value: float, kind: str) -> str:
    """Return a constant of C."""
    if kind == "b":
        return str(int(bool(value)))
    text = literal_of(value, kind, suffix="")
    return f"({prefix}_real){text}" if kind == "f" else text


def sized_name(name: str, sizes: Iterable[int]) -> str:
    """Return the declarator of an array, or one of its elements."""
    return name + "".join(f"[{size}]" for size in sizes)


def struct(prefix: str, name: str, group: Group) -> str:
    """Return the type of a group."""
    lines = [
        f"  {type_of(field.kind, prefix)} {sized_name(field.name, field.shape)};"
        + (f" /* {field.about} */" if field.about else "")
        for field in group
        if field.size
    ]
    empty = "  char nothing; /* it has no fields */"
    return "\n".join(["typedef struct {", *(lines or [empty]), f"}} {prefix}_{name};", ""])


def statements(
    routine: Routine,
    inputs: Mapping[str, str],
    outputs: Mapping[str, str],
    tables: dict[str, str],
    prefix: str,
) -> str:
    """Return the statements that compute and store the results of a routine.

    Args:
      routine: the function.
      inputs: text before the names of the fields of each input group, as `params->`.
      outputs: the same of each output group.
      tables: declarations of constants, to which those of the routine are added.
      prefix: of all names.
    """
    writer = CWriter(routine, inputs, tables, prefix)
    lines = list(writer.body)
    for group, field, value in writer.outputs:
        name = f"{outputs[group]}{field.name}"
        if len(field.shape) == 1 and field.size > 1:
            line = f"  {name}[i] = {writer.read(value, field.size)};"
            lines += writer.elements(field.size, [line])
        else:
            lines += [
                f"{sized_name(name, index)} = {writer.operand(value, i)};"
                for i, index in enumerate(np.ndindex(field.shape))
            ]
    for group, fields in routine.outputs.items():
        if not any(field.size for field in fields):
            lines.append(f"{outputs[group]}nothing = 0;")
    return "\n".join(f"  {line}" for line in lines)
