"""Table of the operations of all languages: SIMD C and CUDA, scalar C, JavaScript and ONNX.

An operation is named by the primitive of JAX and the kind of its first operand. A language that
does not spell an operation uses its compound, see `compounds`. SIMD C and CUDA share the functions
of this table and of `operations.h`, on the types of `simd.h` and `gpu.h`.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

TYPES = {"f": "V", "i": "I", "u": "U", "b": "I"}  # of a vector, or of a number of a thread


class Operation(NamedTuple):
    """Spelling of an operation in each language; an empty text: the language does not spell it.

    In a spelling, `{0}` is the first operand, `{p}` the prefix of names in C, and `{P}_F(name)` the
    function of math.h in the precision of the exported header.
    """

    c: str = ""
    js: str = ""
    onnx: str = ""  # operator
    simd: str = ""  # definition in SIMD C and CUDA, if it is not in a header


def _function(name: str, onnx: str = "") -> Operation:
    """Return a function of a real that math.h and JavaScript have by the same name."""
    return Operation(f"{{P}}_F({name})({{0}})", f"Math.{name}({{0}})", onnx, f"EACH({name})")


def _infix(name: str, kind: str, sign: str, onnx: str = "", js: str = "") -> Operation:
    """Return a binary operation that C writes with a sign; integers wrap around."""
    type_, text, simd = TYPES[kind], f"{{0}} {sign} {{1}}", f"a {sign} b"
    if kind == "i" and js:
        text, simd = f"(int)((unsigned)({{0}}) {sign} (unsigned)({{1}}))", f"(I)((U)a {sign} (U)b)"
    result = "I" if name in _COMPARISONS else type_
    line = f"FUNCTION {result} {name}_{kind}({type_} a, {type_} b) {{ return {simd}; }}"
    return Operation(text, js or text, onnx, line)


# Functions that the three languages have, and those that ONNX lacks.
_FUNCTIONS = (
    "sqrt",
    "exp",
    "log",
    "sin",
    "cos",
    "tan",
    "asin",
    "acos",
    "atan",
    "sinh",
    "cosh",
    "asinh",
    "acosh",
    "atanh",
    "floor",
    "ceil",
)
_BEYOND_ONNX = ("log1p", "expm1", "cbrt")
# Signs and operators of ONNX; the integer arithmetic of JavaScript.
_COMPARISONS = {
    **{"lt": ("<", "Less"), "le": ("<=", "LessOrEqual"), "eq": ("==", "Equal")},
    **{"gt": (">", "Greater"), "ge": (">=", "GreaterOrEqual"), "ne": ("!=", "")},
}
_ARITHMETIC = {
    "add": ("+", "({0} + {1}) | 0"),
    "sub": ("-", "({0} - {1}) | 0"),
    "mul": ("*", "Math.imul({0}, {1})"),
}
_BITS = {"and": "&", "or": "|", "xor": "^"}
_CHOICE = "{0} ? {1} : {2}"
TABLE = {
    **{f"{x}_f": _function(x, x.capitalize()) for x in _FUNCTIONS},
    **{f"{x}_f": _function(x) for x in _BEYOND_ONNX},
    **{
        f"{x}_{kind}": _infix(x, kind, sign, x.capitalize(), js if kind == "i" else "")
        for x, (sign, js) in _ARITHMETIC.items()
        for kind in "fiu"
    },
    **{
        f"{x}_{kind}": _infix(x, kind, *spelling)
        for x, spelling in _COMPARISONS.items()
        for kind in "fiu"
    },
    "eq_b": _infix("eq", "b", *_COMPARISONS["eq"]),
    **{
        f"{x}_{kind}": _infix(x, kind, sign, f"Bitwise{x.capitalize()}")
        for x, sign in _BITS.items()
        for kind in "iu"
    },
    "and_b": _infix("and", "b", "&", "And")._replace(c="{0} && {1}", js="{0} && {1}"),
    "or_b": _infix("or", "b", "|", "Or")._replace(c="{0} || {1}", js="{0} || {1}"),
    "xor_b": _infix("xor", "b", "^", "Xor")._replace(c="{0} != {1}", js="{0} != {1}"),
    "not_b": Operation("!{0}", "!{0}", "Not"),
    "not_i": Operation("~{0}", "~{0}", "BitwiseNot"),
    "choose_f": Operation(_CHOICE, _CHOICE, "Where"),
    "choose_i": Operation(_CHOICE, _CHOICE, "Where"),
    "choose_b": Operation(_CHOICE, _CHOICE),
    "div_f": Operation("{0} / {1}", "{0} / {1}", "Div"),
    "rem_f": Operation("{P}_F(fmod)({0}, {1})", "{0} % {1}", "Mod", "EACH_OF_TWO(rem, fmodf)"),
    "quotient_i": Operation("{0} / {1}", "({0} / {1}) | 0", "Div"),
    "shift_up_i": Operation("(int)((unsigned)({0}) << {1})", "{0} << {1}", "BitShift"),
    "shift_down_i": Operation("(int)((unsigned)({0}) >> {1})", "{0} >>> {1} | 0", "BitShift"),
    "neg_f": Operation("-{0}", "-{0}", "Neg"),
    "neg_i": Operation("(int)(0u - (unsigned)({0}))", "-{0} | 0", "Neg"),
    "abs_f": Operation("{P}_F(fabs)({0})", "Math.abs({0})", "Abs"),
    "sign_f": Operation(onnx="Sign"),
    "max_f": Operation("{p}_max({0}, {1})", "Math.max({0}, {1})", "Max"),
    "min_f": Operation("{p}_min({0}, {1})", "Math.min({0}, {1})", "Min"),
    "max_i": Operation("{0} > {1} ? {0} : {1}", "Math.max({0}, {1})", "Max"),
    "min_i": Operation("{0} < {1} ? {0} : {1}", "Math.min({0}, {1})", "Min"),
    "tanh_f": _function("tanh", "Tanh")._replace(c="{p}_tanh({0})"),
    "erf_f": _function("erf", "Erf")._replace(js=""),
    "erfc_f": _function("erfc")._replace(js=""),
    "exp2_f": _function("exp2")._replace(js=""),
    "round_f": _function("round")._replace(js=""),
    "rint_f": _function("rint", "Round")._replace(js="rint({0})"),
    "logistic_f": Operation(onnx="Sigmoid"),
    "atan2_f": Operation(
        "{P}_F(atan2)({0}, {1})", "Math.atan2({0}, {1})", "", "EACH_OF_TWO(atan2, atan2f)"
    ),
    "pow_f": Operation(
        "{P}_F(pow)({0}, {1})", "Math.pow({0}, {1})", "Pow", "EACH_OF_TWO(pow, powf)"
    ),
    "f_of_i": Operation("({p}_real){0}", "{0}", "Cast"),
    "f_of_b": Operation("({p}_real){0}", "{0} ? 1 : 0", "Cast"),
    "i_of_b": Operation("{0}", "{0} ? 1 : 0", "Cast"),
    "truncate_f": Operation("(int){0}", "Math.trunc({0})", "Cast"),
}

_FOLDER = Path(__file__).parent
_COMMON = "\n".join(
    [*(row.simd for row in TABLE.values() if row.simd), (_FOLDER / "operations.h").read_text()]
)
XLA_CALL = (_FOLDER / "xla_call.h").read_text()
SIMD_HEADER = XLA_CALL + (_FOLDER / "simd.h").read_text() + _COMMON
GPU_HEADER = (_FOLDER / "gpu.h").read_text() + _COMMON


def spelled(language: str) -> dict[str, str]:
    """Return the spelling of each operation of a language (`c`, `js` or `onnx`)."""
    return {name: text for name, row in TABLE.items() if (text := getattr(row, language))}


def defined(header: str) -> frozenset[str]:
    """Return the operations that a header of SIMD C or CUDA defines."""
    functions = re.findall(r"^FUNCTION \w+ (\w+)\(", header, re.M)
    reals = re.findall(r"^EACH(?:_OF_TWO)?\((\w+)", header, re.M)
    return frozenset([*functions, *(f"{name}_f" for name in reals)])
