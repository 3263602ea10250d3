"""Options: fields of a dataclass that say once what they mean, what is allowed, and in what unit.

A field's annotation is its type, the string below it is its help, and `option` holds its bounds.
The command line, the checks and the manifests of runs are made from these declarations.
"""

import dataclasses
import functools
import numbers
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np

from rps_jax import errors

_KEY = "option"


def option(
    default: Any = dataclasses.MISSING,
    at_least: float | None = None,
    at_most: float | None = None,
    *,
    above: float | None = None,
    unit: str = "",
    kw_only: Any = dataclasses.MISSING,
    hidden: bool = False,
    positional: bool = False,
) -> Any:
    """Declare a field with bounds: of a number, or of each number of a tuple.

    The command line has a `positional` field without a flag, and does not offer a `hidden` one.
    """
    bounds = {"at_least": at_least, "at_most": at_most, "above": above, "unit": unit}
    given = {name: bound for name, bound in bounds.items() if bound is not None}
    metadata = {_KEY: given, "hidden": hidden, "positional": positional}
    return dataclasses.field(default=default, metadata=metadata, kw_only=kw_only)


def check_fields(asked: Any) -> None:
    """Check the fields of a dataclass by their types and bounds.

    Whole numbers are `int`, finite numbers `float`, closed choices `Literal`; each may be `None`
    where the type says so. Fields of other types are left to their owner.
    """
    types_ = field_types(type(asked))
    for one in dataclasses.fields(asked):
        _check(one.name, getattr(asked, one.name), types_[one.name], one.metadata.get(_KEY))


def is_hidden(field: Any) -> bool:
    """Whether the command line does not offer a field."""
    return field.metadata.get("hidden", False)


def is_positional(field: Any) -> bool:
    """Whether the command line has a field without a flag."""
    return field.metadata.get("positional", False)


@functools.cache
def field_types(kind: type) -> dict[str, Any]:
    """Types of a dataclass's fields, by name."""
    return typing.get_type_hints(kind)


def _check(name: str, value: Any, kind: Any, bounds: dict[str, Any] | None) -> None:
    if get_origin(kind) in (typing.Union, types.UnionType):
        if value is None and type(None) in get_args(kind):
            return
        inner = [one for one in get_args(kind) if one is not type(None)]
        if len(inner) != 1:
            return
        (kind,) = inner
    if get_origin(kind) is Literal:
        errors.check_name(name, str(value), get_args(kind))
    elif kind is int:
        given = {"at_least": -(2**63), "at_most": 2**63} | (bounds or {})
        low, high = int(given["at_least"]), int(given["at_most"])
        errors.check_count(name, value, at_least=low, at_most=high)
    elif kind is float:
        errors.check_finite(name, value, **(bounds or {}))
    elif get_origin(kind) is tuple and bounds is not None:
        for one in value if isinstance(value, tuple | list) else (value,):
            _check(name, one, get_args(kind)[0], bounds)


def to_json(value: Any) -> Any:
    """JSON of a value: dataclasses and named tuples by their fields, arrays as lists."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if hasattr(value, "_asdict"):
        return {name: to_json(one) for name, one in value._asdict().items()}
    if isinstance(value, Mapping):
        return {str(name): to_json(one) for name, one in value.items()}
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, str | bool | None):
        return value
    if isinstance(value, numbers.Integral):
        return int(value)
    number: Any = value
    if isinstance(value, numbers.Real) or getattr(value, "ndim", None) == 0:
        return float(number)
    if isinstance(value, tuple | list):
        return [to_json(one) for one in value]
    if hasattr(value, "tolist"):
        return to_json(np.asarray(value).tolist())
    raise TypeError(f"{type(value).__name__} cannot be described as JSON")


# --- texts with changes --------------------------------------------------------------------


def parse_changes(kind: str, text: str) -> tuple[str, dict[str, Any]]:
    """Split a text `NAME,FIELD=VALUE,...` into its name and its changes.

    A value is a number, several of them with colons between, as 3:10, or a text. `kind` is what is
    named, for the error.
    """
    head, *changes = text.split(",")
    found = {}
    for change in changes:
        name, equals, value = change.partition("=")
        if not (name and equals):
            raise errors.InputError(f"{kind} = {text} is not allowed: write changes as name=value.")
        parts = [_read(part) for part in value.split(":")]
        found[name] = parts if len(parts) > 1 else parts[0]
    return head, found


def _read(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
