"""Table of the operations of all languages: SIMD C and CUDA, scalar C, JavaScript and ONNX.

An operation is named by the primitive of JAX and the kind of its first operand. A language that
does not spell an operation uses its compound, see `compounds`. SIMD C and CUDA share the functions
of `operations.h`, on the types of `simd.h` and `gpu.h`; the other languages are in `TABLE`.
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


def _function(name: str, onnx: str = "") -> Operation:
    """Return a function of a real that math.h and JavaScript have by the same name."""
    return Operation(f"{{P}}_F({name})({{0}})", f"Math.{name}({{0}})", onnx)


def _both(text: str, onnx: str = "") -> Operation:
    """Return an operation that C and JavaScript spell alike."""
    return Operation(text, text, onnx)


def _wrapping(sign: str, js: str, onnx: str) -> Operation:
    """Return an operation on integers that wraps around."""
    return Operation(f"(int)((unsigned)({{0}}) {sign} (unsigned)({{1}}))", js, onnx)


# Functions of a real that all languages have.
_FUNCTIONS = "sqrt exp log sin cos tan asin acos atan sinh cosh asinh acosh atanh floor ceil"
_COMPARISONS = {
    "lt": ("<", "Less"),
    "le": ("<=", "LessOrEqual"),
    "eq": ("==", "Equal"),
    "gt": (">", "Greater"),
    "ge": (">=", "GreaterOrEqual"),
    "ne": ("!=", ""),
}
TABLE = {
    **{f"{x}_f": _function(x, x.capitalize()) for x in _FUNCTIONS.split()},
    **{
        f"{x}_{kind}": _both(f"{{0}} {sign} {{1}}", onnx)
        for x, (sign, onnx) in _COMPARISONS.items()
        for kind in "fi"
    },
    "log1p_f": _function("log1p"),
    "expm1_f": _function("expm1"),
    "cbrt_f": _function("cbrt"),
    "tanh_f": Operation("{p}_tanh({0})", "Math.tanh({0})", "Tanh"),
    "erf_f": Operation("{P}_F(erf)({0})", "", "Erf"),
    "erfc_f": Operation("{P}_F(erfc)({0})"),
    "exp2_f": Operation("{P}_F(exp2)({0})"),
    "round_f": Operation("{P}_F(round)({0})"),
    "rint_f": Operation("{P}_F(rint)({0})", "rint({0})", "Round"),
    "logistic_f": Operation(onnx="Sigmoid"),
    "atan2_f": Operation("{P}_F(atan2)({0}, {1})", "Math.atan2({0}, {1})"),
    "pow_f": Operation("{P}_F(pow)({0}, {1})", "Math.pow({0}, {1})", "Pow"),
    "rem_f": Operation("{P}_F(fmod)({0}, {1})", "{0} % {1}", "Mod"),
    "add_f": _both("{0} + {1}", "Add"),
    "sub_f": _both("{0} - {1}", "Sub"),
    "mul_f": _both("{0} * {1}", "Mul"),
    "div_f": _both("{0} / {1}", "Div"),
    "neg_f": _both("-{0}", "Neg"),
    "abs_f": Operation("{P}_F(fabs)({0})", "Math.abs({0})", "Abs"),
    "sign_f": Operation(onnx="Sign"),
    "max_f": Operation("{p}_max({0}, {1})", "Math.max({0}, {1})", "Max"),
    "min_f": Operation("{p}_min({0}, {1})", "Math.min({0}, {1})", "Min"),
    "add_i": _wrapping("+", "({0} + {1}) | 0", "Add"),
    "sub_i": _wrapping("-", "({0} - {1}) | 0", "Sub"),
    "mul_i": _wrapping("*", "Math.imul({0}, {1})", "Mul"),
    "quotient_i": Operation("{0} / {1}", "({0} / {1}) | 0", "Div"),
    "neg_i": Operation("(int)(0u - (unsigned)({0}))", "-{0} | 0", "Neg"),
    "max_i": Operation("{0} > {1} ? {0} : {1}", "Math.max({0}, {1})", "Max"),
    "min_i": Operation("{0} < {1} ? {0} : {1}", "Math.min({0}, {1})", "Min"),
    "and_i": _both("{0} & {1}", "BitwiseAnd"),
    "or_i": _both("{0} | {1}", "BitwiseOr"),
    "xor_i": _both("{0} ^ {1}", "BitwiseXor"),
    "not_i": _both("~{0}", "BitwiseNot"),
    "shift_up_i": Operation("(int)((unsigned)({0}) << {1})", "{0} << {1}", "BitShift"),
    "shift_down_i": Operation("(int)((unsigned)({0}) >> {1})", "{0} >>> {1} | 0", "BitShift"),
    "eq_b": _both("{0} == {1}", "Equal"),
    "and_b": _both("{0} && {1}", "And"),
    "or_b": _both("{0} || {1}", "Or"),
    "xor_b": _both("{0} != {1}", "Xor"),
    "not_b": _both("!{0}", "Not"),
    "choose_f": _both("{0} ? {1} : {2}", "Where"),
    "choose_i": _both("{0} ? {1} : {2}", "Where"),
    "choose_b": _both("{0} ? {1} : {2}"),
    "f_of_i": Operation("({p}_real){0}", "{0}", "Cast"),
    "f_of_b": Operation("({p}_real){0}", "{0} ? 1 : 0", "Cast"),
    "i_of_b": Operation("{0}", "{0} ? 1 : 0", "Cast"),
    "truncate_f": Operation("(int){0}", "Math.trunc({0})", "Cast"),
}

_FOLDER = Path(__file__).parent
_OPERATIONS = (_FOLDER / "operations.h").read_text()
XLA_CALL = (_FOLDER / "xla_call.h").read_text()
SIMD_HEADER = XLA_CALL + (_FOLDER / "simd.h").read_text() + _OPERATIONS
GPU_HEADER = (_FOLDER / "gpu.h").read_text() + _OPERATIONS


def spelled(language: str) -> dict[str, str]:
    """Return the spelling of each operation of a language (`c`, `js` or `onnx`)."""
    return {name: text for name, row in TABLE.items() if (text := getattr(row, language))}


def defined(header: str) -> frozenset[str]:
    """Return the operations that a header of SIMD C or CUDA defines."""
    functions = re.findall(r"^FUNCTION \w+ (\w+)\(", header, re.M)
    reals = re.findall(r"^EACH(?:_OF_TWO)?\((\w+)", header, re.M)
    return frozenset([*functions, *(f"{name}_f" for name in reals)])
