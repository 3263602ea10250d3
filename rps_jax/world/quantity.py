"""Declarations of drawn quantities: fields of a domain or of a task."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from rps_jax import errors
from rps_jax.spec import Spec, specs_of


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


# Of a quantity; one of the skin, the base or the robot sets their field of the same name.
Owner = Literal["object", "floor", "task", "course", "skin", "base", "robot"]


@dataclass(frozen=True, kw_only=True)
class Quantity(Spec):
    """Declaration of a drawn quantity, at the field with its range; the limits are of the range."""

    owner: Owner = "object"
    jumps: bool = False  # whether a world changes in steps with it, so that it has no derivative
    numbers: tuple[str, ...] | None = None  # its random numbers; None: one, of its own name
    reported: bool = True  # whether reports have it
    # Of a registered quantity: sets its values (n,) in the `draws.Draw` of n worlds.
    apply: Callable[[Any, np.ndarray], Any] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        errors.check_name(f"owner of '{self.about}'", self.owner, get_args(Owner))
        if not math.isfinite(self.high - self.low):
            rule = "a drawn quantity has two finite limits"
            raise errors.not_allowed(
                f"limits of '{self.about}'", f"{self.low:g} to {self.high:g}", rule
            )

    def check_range(self, name: str, interval: Range) -> None:
        """Raise InputError unless a range of this quantity is within its limits."""
        low, high, log = interval
        for side, value in (("low", low), ("high", high)):
            self.check(f"{name} ({side})", value)
        if low > high or (log and low <= 0):
            rule = "low must not exceed high" + (", and be above 0" if log else "")
            raise errors.not_allowed(name, f"{low:g} to {high:g}", rule)


def declared(kind: type) -> dict[str, Quantity]:
    """Return the quantities that a dataclass declares, by name."""
    return {name: x for name, x in specs_of(kind).items() if isinstance(x, Quantity)}


def numbers_of(quantities: Mapping[str, Quantity]) -> tuple[str, ...]:
    """Return the names of the random numbers from which quantities are drawn."""
    items = quantities.items()
    return tuple(x for k, q in items for x in ((k,) if q.numbers is None else q.numbers))


def check_ranges(record: Any, prefix: str) -> None:
    """Raise InputError unless the ranges of a dataclass are within the limits of its quantities."""
    for name, quantity in declared(type(record)).items():
        if (interval := getattr(record, name)) is not None:
            quantity.check_range(f"{prefix}{name}", interval)


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
