"""Options: dataclass fields with a type, the declaration of their number, and help.

The command line, the checks and the manifests of runs are derived from these declarations.
"""

import dataclasses
import functools
import numbers
import os
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args, get_origin

import numpy as np
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.record import files
from rps_jax.record.files import JsonObject
from rps_jax.spec import SPEC, Named, Spec, annotation_in, specs_of

HIDDEN, POSITIONAL, FLAG = "hidden", "positional", "flag"  # metadata of fields
Hint: TypeAlias = Any  # an annotation: a type, or a form of `typing`
_MAX_SHOWN = 200  # characters of a value in an error
_NOUNS: dict[Hint, str] = {  # of types, for errors
    str: "a text", Path: "a path", bool: "True or False", float: "a number", int: "a whole number",
    np.ndarray: "an array", Mapping: "a mapping of names", Callable: "a function",
}  # fmt: skip


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
    flag: str = "",
) -> Any:  # any type of field, as of `dataclasses.field`
    """Declare a field with bounds for its number, or for each number of its tuple.

    The command line has a `positional` field without a flag, and does not offer a `hidden` one. A
    field with a `flag` has a tuple of texts, one for each time that the flag of this name is given.

    Examples:
      >>> option(0.05, above=0, at_most=1, unit="m/s").metadata["spec"].bounds
      {'above': 0, 'at_most': 1, 'unit': 'm/s'}
    """
    metadata = {HIDDEN: hidden, POSITIONAL: positional, FLAG: flag}
    if unit or not at_least is at_most is above is None:
        metadata[SPEC] = Spec(unit, ge=at_least, le=at_most, gt=above)
    return dataclasses.field(default=default, metadata=metadata, kw_only=kw_only)


def field_types(kind: Hint) -> dict[str, Hint]:
    """Return the types of a dataclass's fields, or of a function's arguments, by name."""
    types_, closed = _types_of(kind)
    return types_ | {name: Literal[tuple(named.names())] for name, named in closed.items()}


@functools.cache
def _types_of(kind: Hint) -> tuple[dict[str, Hint], dict[str, Named]]:
    """Return types by name, and the texts of those of which a registry has all."""
    hints = typing.get_type_hints(kind, include_extras=True).items()
    named = {name: annotation_in(hint, Named) for name, hint in hints}
    return typing.get_type_hints(kind), {k: x for k, x in named.items() if x and x.closed}


@functools.cache  # tyro parses the source of a class for each of its fields
def help_of(kind: type, name: str) -> str:
    """Return the help of a field: its declaration or docstring, and names that a text may have."""
    from tyro import _docstrings

    if (spec := specs_of(kind).get(name)) is not None and spec.about:
        has_unit = spec.unit in ("", "1") or f"[{spec.unit}]" in spec.about
        return spec.about if has_unit else str(spec)
    named = annotation_in(typing.get_type_hints(kind, include_extras=True)[name], Named)
    names = f" Names: {', '.join(named.names())}." if named and not named.closed else ""
    return (_docstrings.get_field_docstring(kind, name, ()) or "") + names


def check_fields(record: object, prefix: str = "") -> None:
    """Check the fields of a dataclass by their types and bounds; errors name them after a prefix.

    Integers are `int`, finite numbers `float`, and closed choices `Literal`, or one of these and
    `None`. Fields of other types are checked by their types, and by their bounds, if these are
    declared, number by number; their default is always allowed.
    """
    types_, specs = field_types(type(record)), specs_of(type(record))
    for field in dataclasses.fields(typing.cast(Any, record)):
        # As the user gave it: a property may convert it.
        if (value := vars(record)[field.name]) is not field.default:
            _check(f"{prefix}{field.name}", value, types_[field.name], specs.get(field.name))


def check_arguments(function: Callable[..., object], values: Mapping[str, object]) -> None:
    """Check the arguments of a function by their types, as `check_fields` checks fields."""
    for name, value in values.items():
        _check(name, value, field_types(function)[name], None)


def _check(name: str, value: object, kind: Hint, spec: Spec | None) -> None:
    """Check a value by its type, and by the limits of its declaration."""
    kinds = _alternatives(kind)
    if value is None and type(None) in kinds:
        return
    kinds = [inner for inner in kinds if inner is not type(None)]
    bounds = None if spec is None else spec.bounds
    kind = kinds[0] if len(kinds) == 1 else None
    if get_origin(kind) is Literal:
        errors.check_name(name, str(value), get_args(kind))
    elif kind is int:
        limits = {"at_least": -(2**63), "at_most": 2**63} | (bounds or {})
        low, high = int(limits["at_least"]), int(limits["at_most"])
        errors.check_count(name, value, at_least=low, at_most=high)
    elif kind is float:
        errors.check_finite(name, value, **(bounds or {}))
    elif get_origin(kind) is tuple and bounds is not None:
        items = value if isinstance(value, tuple | list) else (value,)
        if Ellipsis not in get_args(kind) and len(items) != len(get_args(kind)):
            raise errors.not_allowed(name, value, f"give {len(get_args(kind))} numbers")
        for item in items:
            _check(name, item, get_args(kind)[0], spec)
    elif not any(_is_of(value, inner) for inner in kinds):
        nouns = list(dict.fromkeys(map(_noun, kinds)))
        example = f", as [{value!r}]" if isinstance(value, str) and "several" in nouns[0] else ""
        shown = text if len(text := repr(value)) <= _MAX_SHOWN else _noun(type(value))
        raise errors.not_allowed(name, shown, f"give {' or '.join(nouns)}{example}")
    elif bounds and not hasattr(value, "_fields"):  # a record checks itself
        for number in np.ravel(np.asarray(value, object)):
            errors.check_finite(name, number, **bounds)


def _alternatives(kind: Hint) -> Sequence[Hint]:
    """Return the types of a union, or the type itself."""
    return get_args(kind) if get_origin(kind) in (typing.Union, types.UnionType) else (kind,)


def _is_of(value: Any, kind: Hint) -> bool:
    """Return whether a value has a declared type; a tuple of numbers may be a list or an array."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return any(_is_of(value, alternative) for alternative in inner)
    if origin in (tuple, Sequence):
        if isinstance(value, str | bytes | Mapping) or not _has_items(value):
            return False
        items = list(value)
        if origin is tuple and Ellipsis not in inner and len(items) != len(inner):
            return False
        inner = inner[:1] * len(items) if origin is Sequence or Ellipsis in inner else inner
        return all(map(_is_of, items, inner))
    if kind is float or kind is int:
        base: Any = numbers.Real if kind is float else numbers.Integral
        is_scalar = np.ndim(value) == 0 and hasattr(value, "dtype") and value.dtype.kind in "iuf"
        return isinstance(value, base) or is_scalar
    if kind is bool:
        return isinstance(value, bool | np.bool_)
    if kind is np.ndarray:
        return _has_items(value) and not isinstance(value, str | bytes)
    if kind is Path:
        return isinstance(value, str | os.PathLike)
    bare: Hint = origin or kind
    if bare is Any or not isinstance(bare, type) or hasattr(bare, "__get__"):
        return True
    return isinstance(value, bare)


def _has_items(value: ArrayLike) -> bool:
    return isinstance(value, Sequence) or (hasattr(value, "__iter__") and np.ndim(value) > 0)


def _noun(kind: Hint) -> str:
    """Return the noun of a type, for errors."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (tuple, Sequence):
        count = "several" if origin is Sequence or Ellipsis in inner else str(len(inner))
        items = dict.fromkeys(_noun(item).partition(" ")[2] for item in _alternatives(inner[0]))
        return f"{count} {' or '.join(item.removesuffix('s') + 's' for item in items)}"
    kind = origin or kind
    name = getattr(kind, "__name__", str(kind))
    example = f", as {kind.EXAMPLE}" if hasattr(kind, "EXAMPLE") else ""
    return _NOUNS.get(kind) or f"{'an' if name[0] in 'AEIOU' else 'a'} {name}{example}"


def to_json(value: Any) -> Any:
    """Return a value as JSON: dataclasses and named tuples by their fields, arrays as lists."""
    if dataclasses.is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    elif hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {str(name): to_json(item) for name, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_json(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, str | None):
        return value
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{type(value).__name__} cannot be written as JSON")
    return array.tolist()


# --- texts with changes --------------------------------------------------------------------


def parse_changes(kind: str, text: str) -> tuple[str, JsonObject]:
    """Return the name and the changes of a text `NAME,FIELD=VALUE,FILE.json,...`.

    A value is a number, a text, or several of these between colons, as 3:10. A file holds fields
    with values. Errors name the `kind` of the text.
    """
    name, *assignments = text.split(",")
    changes: JsonObject = {}
    for assignment in assignments:
        field, equals, value = assignment.partition("=")
        if not equals and files.suffix_of(field) in files.FIELD_FILES:
            changes |= files.read_fields(Path(field))
            continue
        if not (field and equals):
            raise errors.not_allowed(kind, text, "write changes as name=value or file.json")
        if sum(x.startswith(f"{field}=") for x in assignments) > 1:
            raise errors.not_allowed(kind, text, f"give {field} once")
        values = [_number_or_text(word) for word in value.split(":")]
        changes[field] = values if len(values) > 1 else values[0]
    return name, changes


def parse_names(field: str, value: str | Mapping[str, str]) -> dict[str, str]:
    """Return names by names, from a mapping or a text `NAME=OTHER,NAME=OTHER`."""
    if isinstance(value, str):
        pairs = [pair.partition("=") for pair in value.split(",") if pair.strip()]
    elif isinstance(value, Mapping):
        pairs = [(str(name), "=", str(alias)) for name, alias in value.items()]
    else:
        raise errors.not_allowed(field, repr(value), 'give {"name": "other"} or "name=other"')
    if not all(name.strip() and alias.strip() for name, _, alias in pairs):
        raise errors.not_allowed(field, value, "write name=other, separated by commas")
    if pairs:
        errors.check_each_once(field, [name.strip() for name, _, _ in pairs])
    return {name.strip(): alias.strip() for name, _, alias in pairs}


def _number_or_text(word: str) -> float | str:
    try:
        return float(word)
    except ValueError:
        return word
