"""The exception for invalid input, and the checks that raise it."""

from __future__ import annotations

import difflib
import importlib
import itertools
import math
import numbers
import re
from collections.abc import Iterable, Sequence
from types import ModuleType
from typing import Any, cast

import numpy as np


class InputError(ValueError):
    """Invalid input: one sentence with the field, its value, the allowed values and the fix.

    A word of more than `_MAX_WORD` characters is shortened; unprintable characters are escaped.
    """

    def __init__(self, sentence: object) -> None:
        short = _LONG_WORD.sub(r"\1…\2", str(sentence))
        super().__init__("".join(c if c.isprintable() else ascii(c)[1:-1] for c in short))


class UnknownNameError(InputError):
    """An unknown name of a kind of things, some of which users can register."""

    def __init__(self, kind: str, name: str, allowed: str) -> None:
        super().__init__(f"unknown {kind} '{name}': choose from {allowed}.")
        self.kind, self.name = kind, name


_MAX_WORD = 200  # characters; most paths are shorter
_LONG_WORD = re.compile(rf"(\S{{60}})\S{{{_MAX_WORD - 60},}}?([^\w\s]{{0,3}})(?!\S)")


def one_line(error: object) -> str:
    """Return the text of an error in one line."""
    return " ".join(str(error).split())


def not_allowed(name: str, value: object, rule: str) -> InputError:
    """Return the error of a value that breaks a rule, which also says how to fix it."""
    return InputError(f"{name} = {value} is not allowed: {rule}.")


def check_number(
    name: str,
    value: Any,
    *,
    above: float = -math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    below: float = math.inf,
    unit: str = "",
    text: bool = False,
) -> float:
    """Return a value as a float if it is a number within bounds; it may be infinite.

    Args:
      name: of the field, for the error.
      value: any input.
      above: exclusive lower bound.
      at_least: lower bound.
      at_most: upper bound.
      below: exclusive upper bound.
      unit: of the value, for the error.
      text: whether a text with a number is allowed.

    Raises:
      InputError: the value is NaN, not a number, or out of bounds.
    """
    limits = {"above": above, "at least": at_least, "at most": at_most, "below": below}
    bounds = [f"{words} {limit:g}" for words, limit in limits.items() if math.isfinite(limit)]
    allowed = " and ".join(["a number", *bounds]) + (f" [{unit}]" if unit else "")
    try:
        refused = isinstance(value, bool) or "complex" in type(value).__name__
        refused = refused or (isinstance(value, str) and not text)
        scalar = math.nan if refused else float(value)
    except (TypeError, ValueError, OverflowError):
        scalar = math.nan
    is_inside = above < scalar and at_least <= scalar <= at_most
    if math.isnan(scalar) or not is_inside or scalar >= below < math.inf:
        raise not_allowed(name, value, f"it must be {allowed}")
    return scalar


def check_finite(name: str, value: Any, **bounds: Any) -> float:
    """Return a value as a float if it is a finite number within bounds: see `check_number`."""
    scalar = check_number(name, value, **bounds)
    if math.isinf(scalar):
        raise not_allowed(name, value, "it must be finite")
    return scalar


def check_angle(name: str, value: Any) -> float:
    """Return a finite angle [rad] within 2 pi of 0, beyond which it may be in degrees."""
    if abs(angle := check_finite(name, value)) > 6.3:
        rule = "it is beyond 2 pi: give radians, as 1.571 for 90 degrees"
        raise not_allowed(name, f"{angle:g}", rule)
    return angle


def check_vector(name: str, values: Iterable[object], **bounds: float | str) -> list[float]:
    """Return the finite numbers x and y within bounds: see `check_number`."""
    axes = zip("xy", values, strict=True)
    return [check_finite(f"{name} {axis}", value, **bounds) for axis, value in axes]


def check_array(
    name: str, values: object, *shapes: tuple[int | str, ...], dtype: type = float
) -> np.ndarray:
    """Return finite numbers as a new array of one of the shapes; a letter is any length above 0.

    Raises:
      InputError: the values are no numbers, not finite, or of another shape.
    """
    texts = (str(shape).replace("'", "") for shape in shapes)
    rule = f"it must be finite numbers of shape {' or '.join(texts)}"
    try:
        array = np.asarray(values)
        array = array.astype(dtype, casting="unsafe" if array.dtype == object else "same_kind")
    except (TypeError, ValueError) as error:
        raise not_allowed(name, repr(values), rule) from error
    pairs = (itertools.zip_longest(shape, array.shape) for shape in shapes)
    known = [tuple(m if isinstance(n, str) else n for n, m in pair) for pair in pairs]
    if array.shape not in known or not array.size:
        raise not_allowed(name, f"of shape {array.shape}" if array.ndim else values, rule)
    for index in np.argwhere(~np.isfinite(array))[:1].tolist():
        where = array.tolist() if array.size < 10 else f"{array[tuple(index)]} at index {index}"
        raise not_allowed(name, where, rule)
    return array


def check_count(name: str, value: object, *, at_least: int = 1, at_most: int) -> int:
    """Return a value if it is a whole number within bounds, or raise InputError."""
    is_whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    count = int(cast("int", value)) if is_whole else at_least - 1
    if not at_least <= count <= at_most:
        span = f" from {at_least} to {at_most}" if at_least > -(2**63) else ""
        raise not_allowed(name, value, f"it must be a whole number{span}")
    return count


def check_name(kind: str, name: str, known: Iterable[str], file: str = "") -> str:
    """Return a name if it is known, or raise an UnknownNameError with the known and nearest names.

    The error also names a `file` that is allowed instead, as FILE.json.
    """
    known = list(known)
    if name in known:
        return name
    hint, alternative = suggest(name, known), f", or give {file}" if file else ""
    raise UnknownNameError(kind, name, f"{', '.join(known)}{alternative}{hint}")


def suggest(name: object, known: Sequence[str]) -> str:
    """Return a hint at the known name that is most similar to an unknown one, if any is."""
    plain = {_plain(text): text for text in known}
    matches = difflib.get_close_matches(_plain(str(name)), plain, n=1)
    return f" (did you mean '{plain[matches[0]]}'?)" if matches else ""


def _plain(name: str) -> str:
    return name.lower().replace("_", "-")


def check_each_once(
    field: str, values: Sequence[object], labels: Sequence[object] | None = None
) -> None:
    """Raise InputError if there is no value, or if a value (or its label) is repeated."""
    if len({*map(str, values if labels is None else labels)}) < max(len(values), 1):
        raise not_allowed(field, values, "name each once, at least one")


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
