"""The one exception for input that cannot be used, and the checks that raise it."""

from __future__ import annotations

import difflib
import importlib
import math
import numbers
import re
from collections.abc import Iterable, Sequence
from types import ModuleType
from typing import Any


class InputError(ValueError):
    """Bad input: one sentence that names the field, its value and what is allowed.

    Of a word of more than `_LONGEST` characters, as a value may be one, only its beginning stands
    there; what cannot be printed is escaped.
    """

    def __init__(self, sentence: object) -> None:
        """Say it."""
        super().__init__(_readable(str(sentence)))


_LONGEST = 200  # characters of a word; most paths are shorter
_ENDLESS = re.compile(rf"(\S{{60}})\S{{{_LONGEST - 60},}}?([^\w\s]{{0,3}})(?!\S)")


def _readable(sentence: str) -> str:
    """A sentence without endless words, and without characters that a terminal would obey."""
    short = _ENDLESS.sub(r"\1…\2", sentence)
    plain = (c if c.isprintable() else ascii(c)[1:-1] for c in short)
    return "".join(plain)


def check_number(
    name: str,
    value: Any,
    *,
    above: float = -math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    unit: str = "",
    text: bool = False,
) -> float:
    """`value` as a float if it is a number within bounds; infinite only where `at_most` says so.

    A text is no number, unless one that says a number is allowed by `text`.

    Raises:
      InputError: it is NaN, not a number, or out of bounds.
    """
    bounds = []
    if above > -math.inf:
        bounds.append(f"above {above:g}")
    if at_least > -math.inf:
        bounds.append(f"at least {at_least:g}")
    if at_most < math.inf:
        bounds.append(f"at most {at_most:g}")
    allowed = " and ".join(["a number", *bounds]) + (f" [{unit}]" if unit else "")
    try:
        odd = (isinstance(value, str) and not text) or "complex" in type(value).__name__
        number = math.nan if odd else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if math.isnan(number) or not (above < number and at_least <= number <= at_most):
        raise InputError(f"{name} = {value} is not allowed: it must be {allowed}.")
    return number


def check_finite(name: str, value: Any, **bounds: Any) -> float:
    """`check_number`, and finite."""
    number = check_number(name, value, **bounds)
    if math.isinf(number):
        raise InputError(f"{name} = {value} is not allowed: it must be finite.")
    return number


def check_count(name: str, value: Any, *, at_least: int = 1, at_most: int) -> int:
    """`value` if it is a whole number within bounds.

    Raises:
      InputError: it is not.
    """
    if not (isinstance(value, numbers.Integral) and at_least <= int(value) <= at_most):
        raise InputError(
            f"{name} = {value} is not allowed: it must be a whole number from {at_least} to "
            f"{at_most}."
        )
    return int(value)


def check_name(kind: str, name: str, known: Iterable[str]) -> str:
    """`name` if it is one of `known`; otherwise an InputError lists them and the nearest."""
    known = list(known)
    if name in known:
        return name
    near = difflib.get_close_matches(str(name), known, n=1)
    hint = f" (did you mean '{near[0]}'?)" if near else ""
    raise InputError(f"unknown {kind} '{name}': choose from {', '.join(known)}{hint}.")


def check_each_once(field: str, given: Sequence[Any], labels: Sequence[Any] | None = None) -> None:
    """Raises InputError if nothing is given, or one twice, by its label if it has one."""
    if not given or len(set(given if labels is None else labels)) < len(given):
        raise InputError(f"{field} = {given} is not allowed: name each once, at least one.")


def require(module: str, extra: str) -> ModuleType:
    """Import a module of an optional dependency.

    Raises:
      InputError: it is not installed; the sentence names the extra of `rps_jax` that has it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise not_installed(error.name or module, extra) from error


def not_installed(module: str, extra: str) -> InputError:
    """Return the error of a missing optional dependency, with the command that installs it."""
    package = module.partition(".")[0]
    return InputError(f"{package} is not installed: run pip install 'rps_jax[{extra}]'.")
