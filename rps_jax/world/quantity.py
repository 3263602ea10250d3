"""Drawn quantities: their declarations, and their random numbers.

A quantity is a field of a domain or of a task. Its random numbers are one stream for each name,
addressed by (seed, name, index). The number of a name in world i depends on the seed, the name and
i alone: a name that is added changes no other number. Bits come from Philox, a counter-based
generator, keyed by the seed and a hash of the name. Names of version 0.4 and earlier have columns
of one table instead, which is frozen, so that published worlds stay unchanged.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from hashlib import blake2b
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

    def __str__(self) -> str:
        """Return the text of a domain, as 3:10."""
        return f"{self.low:g}:{self.high:g}"

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


def check_ranges(record: object, prefix: str) -> None:
    """Raise InputError unless the ranges of a dataclass are within the limits of its quantities."""
    for name, quantity in declared(type(record)).items():
        if (interval := getattr(record, name)) is not None:
            quantity.check_range(f"{prefix}{name}", interval)


def check_unused(
    record: object, prefix: str, unused: Mapping[str, str], *allowed: Mapping[str, Range]
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


# --- random numbers ------------------------------------------------------------------------------

_COUNT = 64  # columns of the frozen table
_TABLE = """
mass size aspect height com_offset com_bearing friction_ground friction_robot
lateral yaw gap distance bearing noise gain_spread dead_share
pose_noise yaw_noise pose_latency command_delay v_x_error v_y_error omega_error
key_0 key_1 sides turn
corner_0 corner_1 corner_2 corner_3 corner_4 corner_5 corner_6 corner_7
robot_force robot_traction robot_lag robot_acceleration boundary
foam time_constant robot_slip feet feet_number feet_turn load_size
robot_slip_sideways robot_slip_yaw lookahead length turns
turn_angle_0 turn_angle_1 turn_angle_2 turn_angle_3 turn_angle_4 turn_angle_5 turn_angle_6
width door_width slope slope_bearing boundary_factor
"""
_COLUMNS = re.findall(r"\w+", _TABLE)
# Tasks share columns: a world has one task.
_SHARED = {"route": "turn_angle_6", "scale": "width"}
_INDICES = {x: _COLUMNS.index(_SHARED.get(x, x)) for x in (*_COLUMNS, *_SHARED)}
# Columns of the frozen table by name, in their order.
COLUMNS: dict[str, int] = dict(sorted(_INDICES.items(), key=lambda item: item[1]))
_OWNERS: dict[str, str] = {}  # of all names that worlds use, in words


def claim(owner: str, *names: str) -> None:
    """Reserve names of random numbers, or of columns of results, for one owner.

    Raises:
      InputError: another owner has a name.
    """
    for name in names:
        if not name.isidentifier():
            raise errors.not_allowed(f"name of {owner}", repr(name), "write a name of Python")
        if (known := _OWNERS.get(name, owner)) != owner:
            rule = f"{known} has this name; choose another one"
            raise errors.not_allowed(f"name of {owner}", name, rule)
    _OWNERS.update(dict.fromkeys(names, owner))


def key_of(seed: int, name: str) -> int:
    """Return the key of Philox for a name: the seed below, a hash of the name above."""
    return int(seed) + (int.from_bytes(blake2b(name.encode(), digest_size=8).digest(), "big") << 64)


def stream(seed: int, name: str, index: np.ndarray) -> np.ndarray:
    """Return the numbers (n,) in [0, 1) of a name in the worlds `index` (n,)."""
    if name in COLUMNS:
        return random_numbers(seed, index)[:, COLUMNS[name]]
    return _rows(key_of(seed, name), index, 4)[:, 0]


def random_numbers(seed: int, index: np.ndarray) -> np.ndarray:
    """Return the frozen table (n, 64) in [0, 1) of the worlds `index` (n,): see `COLUMNS`."""
    return _rows(seed, index, _COUNT)


def _rows(key: int, index: np.ndarray, count: int) -> np.ndarray:
    """Return `count` numbers, a multiple of four, for each of the worlds `index` (n,)."""
    rows = np.empty((index.size, count))
    order = np.argsort(index)
    far = np.flatnonzero(np.diff(index[order]) > 100) + 1
    for near in np.split(order, far):
        first, last = int(index[near[0]]), int(index[near[-1]])
        # Philox counts in steps of four numbers.
        bits = np.random.Philox(key=key).advance(first * count // 4)
        block = np.random.Generator(bits).random((last - first + 1, count))
        rows[near] = block[index[near] - first]
    return rows
