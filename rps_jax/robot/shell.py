"""The shell: the outline of a base, and the positions of the boards of its skin.

The skin covers the front, left and right sides. Positions along the rim form one strip that starts
at the rear of the left side, runs forward, across the front from left to right, and back along the
right side. A field of None has the paper's value.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.errors import InputError
from rps_jax.geometry.arrays import Number

HALF_LENGTH = 0.3625  # [m] of the paper's base: 15 taxels of 48.3 mm make 0.725 m
HALF_WIDTH = 0.29  # [m] of the paper's base: l_cr + 5 cm, Sec. III-A
Side = Literal["left", "front", "right"]
SIDES: tuple[Side, ...] = ("left", "front", "right")  # in the order of the strip
_ALONG = {"left": (1.0, 0.0), "front": (0.0, -1.0), "right": (-1.0, 0.0)}
_ROUNDING = 1e-9  # [m]
_SPACING = 0.01  # [m] maximum, between two sample points of a taxel
_STATIC = {"static": True}  # metadata of a field that is no leaf of the pytree


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Boards:
    """A row of equal boards on one side, end to end; each taxel is an electrode of a board."""

    side: Side = field(metadata=_STATIC)
    count: int = field(metadata=_STATIC)  # boards
    pitch: Number | None = None  # () [m] of the taxels; None: the row covers the whole side
    middle: Number | None = None  # () [m] along the strip, from the middle of the side; None: 0
    electrodes: int = field(default=3, metadata=_STATIC)  # on each board

    @property
    def taxels(self) -> int:
        """Number of taxels."""
        return self.count * self.electrodes


BOARDS = (Boards("left", 5), Boards("front", 4), Boards("right", 5))  # 14 boards, Sec. II-B


class Row(NamedTuple):
    """Part of a side that a row of boards covers."""

    start: jax.Array  # (2,) [m] in the robot frame
    along: np.ndarray  # (2,) unit vector
    length: Number  # () [m]
    offset: Number  # () [m] of its start along the strip


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Shell:
    """Outline of a base, a rectangle about its origin, and its boards in the strip's order."""

    half_length: Number = HALF_LENGTH  # () [m]
    half_width: Number | None = None  # () [m]; None: the paper's, constant in compiled programs
    boards: tuple[Boards, ...] = BOARDS
    # Sample points of each taxel for the compression of foam; 1 cm apart they resolve a corner.
    samples: int = field(default=5, metadata=_STATIC)

    @classmethod
    def of(cls, half_length: Number, half_width: Number, boards: tuple[Boards, ...]) -> Shell:
        """Return the shell of a base, or of many bases if the sizes are (n,)."""
        x, y = (float(np.max(half)) for half in (half_length, half_width))
        sides = _lengths(x, y)
        pitches = [
            sides[row.side] / row.taxels if row.pitch is None else np.max(row.pitch)
            for row in boards
        ]
        is_default = np.all(np.asarray(half_width) == HALF_WIDTH)
        samples = math.ceil(float(max(pitches)) / _SPACING)
        return cls(half_length, None if is_default else half_width, boards, samples)

    @property
    def half(self) -> tuple[Number, Number]:
        """Half length and half width [m]."""
        return self.half_length, HALF_WIDTH if self.half_width is None else self.half_width

    @property
    def count(self) -> int:
        """Number of taxels."""
        return sum(row.taxels for row in self.boards)

    def rows(self) -> list[Row]:
        """Return the positions of the rows of boards."""
        x, y = self.half
        corners = {"left": (-x, y), "front": (x, y), "right": (x, -y)}
        offsets = {"left": 0.0, "front": 2 * x, "right": 2 * x + 2 * y}
        rows, sides = [], _lengths(x, y)
        for boards in self.boards:
            along, side = np.array(_ALONG[boards.side]), sides[boards.side]
            start, offset = jnp.stack(corners[boards.side]), offsets[boards.side]
            if boards.pitch is None:
                rows.append(Row(start, along, side, offset))
                continue
            length = boards.taxels * boards.pitch
            gap = (side - length) / 2 + (0.0 if boards.middle is None else boards.middle)
            rows.append(Row(start + gap * along, along, length, offset + gap))
        return rows

    def taxels(self, samples: int = 1) -> jax.Array:
        """Return sample points (T, samples, 2) [m] of the taxels in the robot frame."""
        points = []
        for boards, row in zip(self.boards, self.rows(), strict=True):
            count = boards.taxels * samples
            s = (np.arange(count) + 0.5) / count * row.length
            points.append((row.start + s[:, None] * row.along).reshape(-1, samples, 2))
        return jnp.concatenate(points)

    def on_strip(self, s: jax.Array) -> jax.Array:
        """Return points (..., 2) [m] in the robot frame at positions `s` (...) [m] of the strip."""
        x, y = self.half
        x = jnp.asarray(x, s.dtype)
        corners = jnp.cumsum(jnp.stack([0 * x, 2 * x, jnp.full_like(x, 2 * y), 2 * x]))
        at_x = jnp.interp(s, corners, jnp.stack([-x, x, x, -x]))
        y = y * np.array([1.0, 1.0, -1.0, -1.0])
        return jnp.stack([at_x, jnp.interp(s, corners, jnp.asarray(y, s.dtype))], axis=-1)

    def check(self) -> None:
        """Raise InputError for a base without size, or boards that overlap or leave it."""
        x, y = self.half
        for name, value in (("half_length", x), ("half_width", y)):
            errors.check_finite(f"robot {name}", value, at_least=0.1, at_most=2, unit="m")
        if not self.boards:
            raise InputError("robot boards = () is not allowed: name at least one row.")
        for row in self.boards:
            _check(row)
        used = [row.side for row in self.boards]
        if used != sorted(used, key=SIDES.index):
            raise InputError(
                f"robot boards on {', '.join(used)} are not allowed: name the rows in the order "
                "left, front, right."
            )
        sides = _lengths(x, y)
        for row in self.boards:
            first, last = _interval(row, sides[row.side])
            if first < -_ROUNDING or last > sides[row.side] + _ROUNDING:
                raise InputError(
                    f"robot boards from {first:g} to {last:g} m of the {row.side} side are not "
                    f"allowed: they leave the base, whose side ends at {sides[row.side]:g} m."
                )
        for row, follower in itertools.pairwise(self.boards):
            if row.side == follower.side:
                side = sides[row.side]
                last, first = _interval(row, side)[1], _interval(follower, side)[0]
                if first < last - _ROUNDING:
                    raise InputError(
                        f"robot boards on the {row.side} side are not allowed: a row ends at "
                        f"{last:g} m and the following begins at {first:g} m, so they overlap."
                    )


def _lengths(x: Number, y: Number) -> dict[Side, Number]:
    """Return the lengths [m] of the sides of a base of half length x and half width y [m]."""
    return {"left": 2 * x, "front": 2 * y, "right": 2 * x}


def _interval(row: Boards, side: Number) -> tuple[Number, Number]:
    """Return the start and end [m] of a row on its side of length `side` [m]."""
    if row.pitch is None:
        return 0.0, side
    length, middle = row.taxels * row.pitch, side / 2 + (row.middle or 0.0)
    return middle - length / 2, middle + length / 2


def _check(row: Boards) -> None:
    errors.check_name("robot boards' side", row.side, SIDES)
    for name in ("count", "electrodes"):
        errors.check_count(f"robot boards' {name}", getattr(row, name), at_most=100)
    if row.pitch is not None:
        errors.check_finite("robot boards' pitch", row.pitch, at_least=0.002, at_most=1, unit="m")
    if row.middle is not None:
        errors.check_finite("robot boards' middle", row.middle, unit="m")
        if row.pitch is None and row.middle != 0:
            raise InputError(
                f"robot boards' middle = {row.middle:g} m is not allowed without a pitch: such a "
                "row covers the whole side."
            )
