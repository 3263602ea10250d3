"""Spelling of each operation in scalar C and JavaScript.

An operation is named as in `operations.h`, which defines it for SIMD C and CUDA: by the primitive
of JAX and the kind of its first operand. In a spelling, `{0}` is the first operand, `{p}` the
prefix of names in C, and `{P}_F(name)` the function of math.h in the precision of the header.
"""

from __future__ import annotations

_FUNCTIONS = (
    *("sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "asinh"),
    *("acosh", "atanh", "log1p", "expm1", "cbrt", "floor", "ceil"),
)
_COMPARISONS = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
# Operations that both languages spell alike.
_COMMON = {
    **{f"{op}_f": f"{{0}} {sign} {{1}}"
       for op, sign in (("add", "+"), ("sub", "-"), ("mul", "*"), ("div", "/"))},
    **{f"{op}_{kind}": f"{{0}} {sign} {{1}}"
       for op, sign in _COMPARISONS.items() for kind in "fib"},
    **{f"choose_{kind}": "{0} ? {1} : {2}" for kind in "fib"},
    **{"and_b": "{0} && {1}", "or_b": "{0} || {1}", "xor_b": "{0} != {1}", "not_b": "!{0}"},
    **{"and_i": "{0} & {1}", "or_i": "{0} | {1}", "xor_i": "{0} ^ {1}", "not_i": "~{0}"},
    **{"neg_f": "-{0}", "square_f": "{0} * {0}", "b_of_f": "{0} != 0", "b_of_i": "{0} != 0"},
}  # fmt: skip
C = _COMMON | {
    **{f"{name}_f": f"{{P}}_F({name})({{0}})" for name in (*_FUNCTIONS, "exp2", "erf")},
    **{f"{name}_f": f"{{P}}_F({name})({{0}}, {{1}})" for name in ("atan2", "pow")},
    "abs_f": "{P}_F(fabs)({0})",
    "rem_f": "{P}_F(fmod)({0}, {1})",
    "max_f": "{p}_max({0}, {1})",
    "min_f": "{p}_min({0}, {1})",
    "sign_f": "{p}_sign({0})",
    "tanh_f": "{p}_tanh({0})",
    "logistic_f": "{p}_logistic({0})",
    "is_finite_f": "isfinite({0}) != 0",
    "rsqrt_f": "1 / {P}_F(sqrt)({0})",
    "round_f": "{P}_F(round)({0})",
    "rint_f": "{P}_F(rint)({0})",
    "add_i": "(int)((unsigned)({0}) + (unsigned)({1}))",
    "sub_i": "(int)((unsigned)({0}) - (unsigned)({1}))",
    "mul_i": "(int)((unsigned)({0}) * (unsigned)({1}))",
    "div_i": "{p}_idiv({0}, {1})",
    "rem_i": "{p}_irem({0}, {1})",
    "neg_i": "(int)(0u - (unsigned)({0}))",
    "abs_i": "{0} < 0 ? (int)(0u - (unsigned)({0})) : {0}",
    "max_i": "{0} > {1} ? {0} : {1}",
    "min_i": "{0} < {1} ? {0} : {1}",
    "sign_i": "({0} > 0) - ({0} < 0)",
    "f_of_i": "({p}_real){0}",
    "f_of_b": "({p}_real){0}",
    "i_of_f": "{p}_int({0})",
    "i_of_b": "{0}",
}
JAVASCRIPT = _COMMON | {
    **{f"{name}_f": f"Math.{name}({{0}})" for name in (*_FUNCTIONS, "abs", "sign", "tanh")},
    **{f"{name}_f": f"Math.{name}({{0}}, {{1}})" for name in ("atan2", "pow", "max", "min")},
    "rem_f": "{0} % {1}",
    "logistic_f": "1 / (1 + Math.exp(-{0}))",
    "is_finite_f": "Number.isFinite({0})",
    "exp2_f": "Math.pow(2, {0})",
    "rsqrt_f": "1 / Math.sqrt({0})",
    "round_f": "Math.sign({0}) * Math.floor(Math.abs({0}) + 0.5)",
    "rint_f": "rint({0})",
    "add_i": "({0} + {1}) | 0",
    "sub_i": "({0} - {1}) | 0",
    "mul_i": "Math.imul({0}, {1})",
    "div_i": "{1} === 0 ? -1 : ({0} / {1}) | 0",
    "rem_i": "{1} === 0 ? {0} : ({0} % {1}) | 0",
    "neg_i": "-{0} | 0",
    "abs_i": "Math.abs({0}) | 0",
    "max_i": "Math.max({0}, {1})",
    "min_i": "Math.min({0}, {1})",
    "sign_i": "Math.sign({0})",
    "f_of_i": "{0}",
    "f_of_b": "{0} ? 1 : 0",
    "i_of_f": "int({0})",
    "i_of_b": "{0} ? 1 : 0",
}
