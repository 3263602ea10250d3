"""Declarations of numbers: unit, meaning, limits and scale, on the field that holds the number.

A field of a dataclass or NamedTuple is declared as `Annotated[float, Spec("m", "width", gt=0)]`.
Checks and their sentences, help, bounds of tuners, ranges of domains, attributes of datasets,
comments of exported laws and reference pages derive from it. Limits may also be given by
`annotated_types`, as `Annotated[float, Interval(ge=0, le=1), Spec("1", "share")]`.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import re
import sys
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

from rps_jax import errors

T = TypeVar("T")
SPEC = "spec"  # key in the metadata of a field of a dataclass
LIMITS = ("ge", "gt", "le", "lt")  # at least, above, at most, below; names of `annotated_types`
# Symbols of units; a unit is a product or quotient of their powers, as kg m^2 or m/s^2.
SYMBOLS = frozenset(
    [
        "1",
        "%",
        "m",
        "mm",
        "km",
        "in",
        "rad",
        "deg",
        "s",
        "ms",
        "us",
        "ns",
        "min",
        "h",
        "d",
        "g",
        "kg",
        "t",
        "N",
        "J",
        "W",
        "Hz",
        "kHz",
        "GHz",
        "V",
        "F",
        "pF",
        "bytes",
        "kB",
        "MB",
        "GB",
        "px",
        "frame",
    ]
)
_FACTOR = re.compile(r"([A-Za-z%1]+)(\^-?\d+)?")


class Bound(NamedTuple):
    """Interval in which a parameter is tuned."""

    low: float
    high: float
    log: bool = False  # whether the scale is logarithmic
    relative_to: str = ""  # name of a parameter; the interval is then a fraction of its value


@dataclass(frozen=True)
class Spec:
    """Declaration of a number, or of each number of an array.

    Raises:
      InputError: the unit is unknown, or a limit lies beyond another.
    """

    unit: str = ""  # as m/s^2; of numbers of several units, as m, m, rad
    about: str = ""  # meaning, as in "width of the corridor"
    ge: float | None = None  # greater than or equal to
    le: float | None = None  # less than or equal to
    _: dataclasses.KW_ONLY
    gt: float | None = None
    lt: float | None = None
    log: bool = False  # whether the scale is logarithmic
    tune: Bound | None = None  # interval of tuners; None: not tuned

    def __post_init__(self) -> None:
        name = f"{type(self).__name__} of '{self.about}'"
        for unit in self.unit.split(", ") if self.unit else ():
            for factor in re.split(r"[ /]", unit):
                match = _FACTOR.fullmatch(factor)
                if match is None or match[1] not in SYMBOLS:
                    rule = f"write a product of {', '.join(sorted(SYMBOLS))}, as m/s^2"
                    raise errors.not_allowed(f"unit of {name}", repr(self.unit), rule)
        is_open = self.gt is not None or self.lt is not None
        intervals = {"limits": (self.low, self.high)}
        if self.tune is not None:
            intervals["tune"] = self.tune[:2]
        for part, (low, high) in intervals.items():
            if not low <= high or (part == "limits" and is_open and low == high):
                rule = "the lower limit must not exceed the upper one"
                raise errors.not_allowed(f"{part} of {name}", f"{low:g} to {high:g}", rule)
        if self.tune is not None and not self.tune.relative_to:
            low, high, log, _ = self.tune
            if low < self.low or high > self.high or (log and low <= 0):
                rule = f"it must lie within {self.low:g} to {self.high:g}" + ", above 0" * log
                raise errors.not_allowed(f"tune of {name}", f"{low:g} to {high:g}", rule)

    @property
    def low(self) -> float:
        """Lower limit, closed or open; minus infinity without one."""
        return max((x for x in (self.ge, self.gt) if x is not None), default=-math.inf)

    @property
    def high(self) -> float:
        """Upper limit, closed or open; infinity without one."""
        return min((x for x in (self.le, self.lt) if x is not None), default=math.inf)

    @property
    def bounds(self) -> dict[str, Any]:
        """Limits and unit, as `errors.check_number` takes them."""
        names = dict(zip(LIMITS, ("at_least", "above", "at_most", "below"), strict=True))
        limits = {names[k]: x for k in LIMITS if (x := getattr(self, k)) is not None}
        return limits | ({"unit": self.unit} if self.unit not in ("", "1") else {})

    @property
    def attributes(self) -> dict[str, str]:
        """Attributes of a variable of a dataset."""
        return {"units": self.unit or "1"} | ({"long_name": self.about} if self.about else {})

    def check(self, name: str, value: object) -> float:
        """Return a value as a float if it is within the limits, or raise InputError.

        It must be finite, unless infinity is a limit.
        """
        is_open = math.inf in (self.le, -(self.ge or 0))
        return (errors.check_number if is_open else errors.check_finite)(name, value, **self.bounds)

    def __str__(self) -> str:
        """Return unit and meaning, as a comment at the field."""
        unit = f"[{self.unit}]" if self.unit else ""
        return self.about if unit in self.about else f"{unit} {self.about}"


def tunable(
    unit: str, about: str, low: float, high: float, *, log: bool = False, **limits: float | None
) -> Spec:
    """Declare a parameter, by default not negative, and the interval in which it is tuned."""
    return Spec(
        unit, about, tune=Bound(low, high, log), **{"ge": None if "gt" in limits else 0, **limits}
    )


@dataclass(frozen=True)
class Named:
    """Names with which texts of a type begin, from a registry that programs extend."""

    names: Callable[[], Iterable[str]]
    closed: bool = False  # whether no other text is allowed


def annotation_in(hint: object, kind: type[T]) -> T | None:
    """Return the annotation of a kind of a type, of an alternative of it, or of its items."""
    metadata = getattr(hint, "__metadata__", ())
    inner = (annotation_in(x, kind) for x in typing.get_args(hint) if not metadata)
    return next((x for x in (*metadata, *inner) if isinstance(x, kind)), None)


def spec_of(annotation: object) -> Spec | None:
    """Return the declaration in an annotation, with the limits that stand beside it."""
    metadata = getattr(annotation, "__metadata__", ())
    spec = next((x for x in metadata if isinstance(x, Spec)), None)
    limits = {
        name: limit
        for item in metadata
        if not isinstance(item, Spec)
        for name in LIMITS
        if (limit := getattr(item, name, None)) is not None
    }
    if spec is None:
        return Spec(**limits) if limits else None
    return dataclasses.replace(spec, **limits) if limits else spec


def _texts_of(kind: type) -> Mapping[str, object]:
    if sys.version_info < (3, 14):
        return inspect.get_annotations(kind)
    import annotationlib  # pyright: ignore[reportMissingImports]

    return annotationlib.get_annotations(kind, format=annotationlib.Format.STRING)


@functools.cache
def _annotations_of(kind: type) -> dict[str, object]:
    """Return the annotations of a class.

    A class without declarations may have annotations of names that do not exist at run time.
    """
    try:
        return typing.get_type_hints(kind, include_extras=True)
    except (NameError, AttributeError, TypeError) as error:
        texts = [str(x) for base in kind.__mro__ for x in _texts_of(base).values()]
        if any("Annotated[" in text for text in texts):
            sentence = f"the annotations of {kind.__name__} cannot be evaluated: {error}."
            raise errors.InputError(sentence) from error
        return {}


@functools.cache
def specs_of(kind: type) -> Mapping[str, Spec]:
    """Return the declarations of the fields of a dataclass or NamedTuple, by name."""
    specs = {name: spec_of(hint) for name, hint in _annotations_of(kind).items()}
    if dataclasses.is_dataclass(kind):
        specs |= {x.name: x.metadata[SPEC] for x in dataclasses.fields(kind) if SPEC in x.metadata}
    return {name: spec for name, spec in specs.items() if spec is not None}


def spec_at(tree: object, path: str) -> Spec | None:
    """Return the declaration of a leaf of a pytree of records, by its path, as `law.K_v`."""
    *owners, name = path.split(".")
    for owner in owners:
        tree = getattr(tree, owner, None)
    return specs_of(type(tree)).get(name)


def check(record: T, prefix: str = "") -> T:
    """Return a record if all its declared numbers are within their limits.

    Raises:
      InputError: one is not, or is None without a type that allows it; the error has its name after
        the prefix.
    """
    kind = type(record)
    for name, spec in specs_of(kind).items():
        value = getattr(record, name)
        if value is not None or name not in _optional_fields(kind):
            spec.check(f"{prefix}{name}", value)
    return record


@functools.cache
def _optional_fields(kind: type) -> frozenset[str]:
    """Return the names of the fields of a class whose type allows None."""
    hints = typing.get_type_hints(kind).items()
    return frozenset(name for name, hint in hints if type(None) in typing.get_args(hint))


def document(kind: type[T]) -> type[T]:
    """Return a NamedTuple class whose fields have their declarations as docstrings.

    A field with a record has the first line of the record's docstring.
    """
    declared = specs_of(kind)
    for name, hint in _annotations_of(kind).items():
        text = str(declared.get(name) or inspect.getdoc(hint) or "")
        getattr(kind, name).__doc__ = text.partition("\n")[0]
    return kind
