"""Declarations of drawn quantities: fields of a domain or of a task."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, fields
from typing import Any, Literal, NamedTuple

import numpy as np

from rps_jax import errors

KEY = "quantity"  # in the metadata of a field


class Range(NamedTuple):
    """Interval of a drawn quantity, uniform in the quantity or in its logarithm."""

    low: float
    high: float
    log: bool = False

    EXAMPLE = "Range(3, 10)"  # for errors

    def at(self, u: np.ndarray) -> np.ndarray:
        """Return the quantity at u in [0, 1)."""
        if self.log:
            return self.low * (self.high / self.low) ** u
        return self.low + u * (self.high - self.low)


Owner = Literal["object", "floor", "task", "course", "skin", "base", "robot"]  # of a quantity


class Quantity(NamedTuple):
    """Declaration of a drawn quantity, without its range."""

    column: int  # of a world's random numbers; a new quantity takes the next free one
    unit: str
    low: float  # bounds of its range
    high: float
    label: str  # in reports; empty: not reported
    owner: Owner = "object"
    jumps: bool = False  # whether a world changes in steps with it, so that it has no derivative


def drawn(default: Range | None, *declaration: Any) -> Any:
    """Declare a drawn quantity by its default range, and the values of a `Quantity`."""
    return field(default=default, metadata={KEY: Quantity(*declaration)})


def declared(kind: type) -> dict[str, Quantity]:
    """Return the quantities that a dataclass declares, by name."""
    return {x.name: x.metadata[KEY] for x in fields(kind) if KEY in x.metadata}


def check_ranges(record: Any, prefix: str) -> None:
    """Raise InputError unless the ranges of a dataclass are within the bounds of its quantities."""
    for name, quantity in declared(type(record)).items():
        if (interval := getattr(record, name)) is None:
            continue
        low, high, log = interval
        bounds = {"at_least": quantity.low, "at_most": quantity.high, "unit": quantity.unit}
        for side, value in (("low", low), ("high", high)):
            errors.check_finite(f"{prefix}{name} ({side})", value, **bounds)
        if low > high or (log and low <= 0):
            rule = "low must not exceed high" + (", and be above 0" if log else "")
            raise errors.not_allowed(f"{prefix}{name}", f"{low:g} to {high:g}", rule)


def check_unused(
    record: Any, prefix: str, unused: Mapping[str, str], *allowed: Mapping[str, Range]
) -> None:
    """Raise InputError if a dataclass gives a range from which no world draws.

    The range may be the default, or one of `allowed`.

    Args:
      record: the dataclass.
      prefix: of the names in messages.
      unused: what determines the quantity of each unused range, as "its targets leave".
      allowed: ranges of named records, by the name of the quantity.
    """
    for name, cause in unused.items():
        value = getattr(record, name)
        if value not in (getattr(type(record), name), *(ranges.get(name) for ranges in allowed)):
            low, high, _ = value
            rule = f"{cause} no {name} to draw; leave it out"
            raise errors.not_allowed(f"{prefix}{name}", f"{low:g} to {high:g}", rule)


def range_of(default: Range | None, values: Any) -> Range:
    """Return the range of a number, of low and high, or of these and whether it is logarithmic.

    A range without a scale has that of the default.

    Raises:
      TypeError: values that are no numbers.
      ValueError: more values.
    """
    low, high, *flags = values if isinstance(values, list | tuple) else (values, values)
    if len(flags) > 1 or not all(isinstance(flag, bool) for flag in flags):
        raise ValueError("more than low, high, and whether uniform in the logarithm")
    if isinstance(low, str | bool) or isinstance(high, str | bool):
        raise TypeError("no numbers")
    log = bool(flags[0]) if flags else default is not None and default.log
    return Range(float(low), float(high), log)
