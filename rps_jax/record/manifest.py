"""Fields of dataclasses in the manifests of run folders; the type of a field says how.

    LawLike = Annotated[str | LawParams, Stored(write=lambda name, law: {name: ...})]

A type without `Stored` has a method `to_json`, or is written by `options.to_json`.
"""

import dataclasses
import functools
import typing
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from rps_jax.record import options
from rps_jax.record.files import JsonObject
from rps_jax.spec import annotation_in


@dataclasses.dataclass(frozen=True)
class Stored:
    """Annotation of a type: how manifests and results store values of it."""

    write: Callable[[str, Any], Mapping[str, object]]
    """Returns the entries, as JSON, of a field with this name and value."""
    read: Callable[[str, JsonObject, Path], Any] | None = None
    """Returns the value of a field with this name, from all entries and the run folder."""
    kinds: tuple[type, ...] = (object,)
    """Types of the values that `write` accepts; others are written without it."""
    label: Callable[[Any], str] | None = None
    """Returns a value as the text of an attribute of results."""


@functools.cache
def stored_types(kind: type) -> dict[str, Stored]:
    """Return the annotations of the fields of a dataclass that have one, by name."""
    hints = typing.get_type_hints(kind, include_extras=True)
    pairs = ((f.name, annotation_in(hints[f.name], Stored)) for f in dataclasses.fields(kind))
    return {name: stored for name, stored in pairs if stored is not None}


def fields_to_json(record: Any, ignored: Collection[str] = ()) -> JsonObject:
    """Return the fields of a dataclass as JSON."""
    entries: JsonObject = {}
    for field in dataclasses.fields(record):
        if field.name in ignored:
            continue
        value, stored = getattr(record, field.name), stored_types(type(record)).get(field.name)
        if stored is not None and isinstance(value, stored.kinds):
            entries |= stored.write(field.name, value)
        else:
            to_json = getattr(value, "to_json", None)
            entries[field.name] = to_json() if to_json else options.to_json(value)
    return entries


def fields_from_json(kind: type, entries: JsonObject, folder: Path) -> JsonObject:
    """Return the fields of a dataclass that `fields_to_json` wrote; a folder has more files."""
    stored, values = stored_types(kind), JsonObject()
    for field in dataclasses.fields(kind):
        if field.name in stored and (read := stored[field.name].read) is not None:
            values[field.name] = read(field.name, entries, folder)
        else:
            values[field.name] = entries[field.name]
    return values


def labels(record: object) -> dict[str, str]:
    """Return the fields of a dataclass that are attributes of results."""
    texts = {}
    for name, stored in stored_types(type(record)).items():
        if stored.label is not None and (value := getattr(record, name)) is not None:
            items = [value] if isinstance(value, stored.kinds) else value
            texts[name] = " ".join(map(stored.label, items))
    return texts
