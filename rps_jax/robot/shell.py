"""The shell: the outline of a base, and where along it the boards of its skin are.

The skin covers the front, left and right sides. Positions along the rim form one strip that starts
at the rear of the left side, runs forward, across the front from left to right, and back along the
right side. What is None is as the paper has it.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.errors import InputError

HALF_LENGTH = 0.3625  # [m] of the paper's base: 15 taxels of 48.3 mm make 0.725 m
HALF_WIDTH = 0.29  # [m] of the paper's base: l_cr + 5 cm, Sec. III-A
Side = Literal["left", "front", "right"]
SIDES: tuple[Side, ...] = ("left", "front", "right")  # in the order of the strip
_ALONG = {"left": (1.0, 0.0), "front": (0.0, -1.0), "right": (-1.0, 0.0)}
_ROUNDING = 1e-9  # [m]
_APART = 0.01  # [m] between two points of a taxel, at most
_STATIC = {"static": True}  # of a pytree's field: no leaf


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Boards:
    """A row of equal boards on one side, end to end; each taxel is an electrode of a board."""

    side: Side = field(metadata=_STATIC)
    count: int = field(metadata=_STATIC)  # boards
    pitch: Any = None  # () [m] of the taxels; None: so that the row covers the whole side
    middle: Any = None  # () [m] of the row along the strip, from the middle of the side; None: 0
    electrodes: int = field(default=3, metadata=_STATIC)  # on each board

    @property
    def taxels(self) -> int:
        """How many."""
        return self.count * self.electrodes


BOARDS = (Boards("left", 5), Boards("front", 4), Boards("right", 5))  # 14 boards, Sec. II-B


class Row(NamedTuple):
    """The part of a side that a row of boards covers."""

    start: jax.Array  # (2,) [m] in the robot frame
    along: np.ndarray  # (2,) unit vector
    length: Any  # () [m]
    begins: Any  # () [m] where on the strip


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Shell:
    """A base's outline, a rectangle about its origin, and its boards, in the strip's order."""

    half_length: Any = HALF_LENGTH  # () [m]
    half_width: Any = None  # () [m]; None: the paper's, which a compiled program then knows
    boards: tuple[Boards, ...] = BOARDS
    # Points of each taxel at which it feels foam; 1 cm apart they feel a corner.
    samples: int = field(default=5, metadata=_STATIC)

    @classmethod
    def of(cls, half_length: Any, half_width: Any, boards: tuple[Boards, ...]) -> Shell:
        """The shell of a base or, if these are (n,), of many."""
        x, y = (float(np.max(half)) for half in (half_length, half_width))
        sides = _lengths(x, y)
        pitches = [
            sides[one.side] / one.taxels if one.pitch is None else np.max(one.pitch)
            for one in boards
        ]
        usual = np.all(np.asarray(half_width) == HALF_WIDTH)
        samples = math.ceil(float(max(pitches)) / _APART)
        return cls(half_length, None if usual else half_width, boards, samples)

    @property
    def half(self) -> tuple[Any, Any]:
        """Half length and half width [m]."""
        return self.half_length, HALF_WIDTH if self.half_width is None else self.half_width

    @property
    def count(self) -> int:
        """How many taxels."""
        return sum(row.taxels for row in self.boards)

    def rows(self) -> list[Row]:
        """Where the rows of boards are."""
        x, y = self.half
        corners = {"left": (-x, y), "front": (x, y), "right": (x, -y)}
        begins = {"left": 0.0, "front": 2 * x, "right": 2 * x + 2 * y}
        found, sides = [], _lengths(x, y)
        for one in self.boards:
            along, side = np.array(_ALONG[one.side]), sides[one.side]
            start, begin = jnp.stack(corners[one.side]), begins[one.side]
            if one.pitch is None:
                found.append(Row(start, along, side, begin))
                continue
            length = one.taxels * one.pitch
            ahead = (side - length) / 2 + (0.0 if one.middle is None else one.middle)
            found.append(Row(start + ahead * along, along, length, begin + ahead))
        return found

    def taxels(self, samples: int = 1) -> jax.Array:
        """Sample points (T, samples, 2) [m] of the taxels in the robot frame."""
        found = []
        for one, row in zip(self.boards, self.rows(), strict=True):
            count = one.taxels * samples
            s = (np.arange(count) + 0.5) / count * row.length
            found.append((row.start + s[:, None] * row.along).reshape(-1, samples, 2))
        return jnp.concatenate(found)

    def on_strip(self, s: jax.Array) -> jax.Array:
        """Points (..., 2) [m] of the strip in the robot frame, `s` (...) [m] from its start."""
        x, y = self.half
        x = jnp.asarray(x, s.dtype)
        corners = jnp.cumsum(jnp.stack([0 * x, 2 * x, jnp.full_like(x, 2 * y), 2 * x]))
        at_x = jnp.interp(s, corners, jnp.stack([-x, x, x, -x]))
        y = y * np.array([1.0, 1.0, -1.0, -1.0])
        return jnp.stack([at_x, jnp.interp(s, corners, jnp.asarray(y, s.dtype))], axis=-1)

    def check(self) -> None:
        """Raises InputError for a base of no size, and boards that overlap or leave it."""
        x, y = self.half
        for name, value in (("half_length", x), ("half_width", y)):
            errors.check_finite(f"robot {name}", value, at_least=0.1, at_most=2, unit="m")
        if not self.boards:
            raise InputError("robot boards = () is not allowed: name at least one row.")
        for one in self.boards:
            _check(one)
        if [one.side for one in self.boards] != sorted(
            (one.side for one in self.boards), key=SIDES.index
        ):
            raise InputError(
                f"robot boards on {', '.join(one.side for one in self.boards)} are not allowed: "
                "name the rows in the order left, front, right."
            )
        sides = _lengths(x, y)
        for one in self.boards:
            first, last = _ends(one, sides[one.side])
            if first < -_ROUNDING or last > sides[one.side] + _ROUNDING:
                raise InputError(
                    f"robot boards from {first:g} to {last:g} m of the {one.side} side are not "
                    f"allowed: they leave the base, whose side ends at {sides[one.side]:g} m."
                )
        for one, after in itertools.pairwise(self.boards):
            if one.side == after.side:
                last, first = _ends(one, sides[one.side])[1], _ends(after, sides[one.side])[0]
                if first < last - _ROUNDING:
                    raise InputError(
                        f"robot boards on the {one.side} side are not allowed: a row ends at "
                        f"{last:g} m and the following begins at {first:g} m, so they overlap."
                    )


def _lengths(x: Any, y: Any) -> dict[Side, Any]:
    """Lengths [m] of the sides of a base of half length x and half width y [m]."""
    return {"left": 2 * x, "front": 2 * y, "right": 2 * x}


def _ends(one: Boards, side: float) -> tuple[float, float]:
    """Where on its side, of length `side` [m], a row begins and ends [m]."""
    if one.pitch is None:
        return 0.0, side
    length, middle = one.taxels * one.pitch, side / 2 + (one.middle or 0.0)
    return middle - length / 2, middle + length / 2


def _check(one: Boards) -> None:
    errors.check_name("robot boards' side", one.side, SIDES)
    for name in ("count", "electrodes"):
        errors.check_count(f"robot boards' {name}", getattr(one, name), at_most=100)
    if one.pitch is not None:
        errors.check_finite("robot boards' pitch", one.pitch, at_least=0.002, at_most=1, unit="m")
    if one.middle is not None:
        errors.check_finite("robot boards' middle", one.middle, unit="m")
        if one.pitch is None and one.middle != 0:
            raise InputError(
                f"robot boards' middle = {one.middle:g} m is not allowed without a pitch: such a "
                "row covers the whole side."
            )
