"""The shell: the outline of a base, and the positions of the boards of its skin.

The skin covers the front, left and right sides. Positions along the rim form one strip that starts
at the rear of the left side, runs forward, across the front from left to right, and back along the
right side. A field of None has the paper's value.

The skin of a round base covers its front 270 degrees. The sides are parts of this arc, as long as
5, 4 and 5 boards of the paper's skin, so that its 42 taxels are spaced evenly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Number
from rps_jax.geometry.footprint import Footprint
from rps_jax.record.options import check_fields
from rps_jax.spec import Spec

HALF_LENGTH = 0.3625  # [m] of the paper's base: 15 taxels of 48.3 mm make 0.725 m
HALF_WIDTH = 0.29  # [m] of the paper's base: l_cr + 5 cm, Sec. III-A
Side = Literal["left", "front", "right"]
SIDES: tuple[Side, ...] = ("left", "front", "right")  # in the order of the strip
_ARC = 1.5 * math.pi  # [rad] of a round base that its skin may cover, about the front
_SHARES: dict[Side, float] = {"left": 5 / 14, "front": 4 / 14, "right": 5 / 14}  # of the arc
_ALONG = {"left": (1.0, 0.0), "front": (0.0, -1.0), "right": (-1.0, 0.0)}
_ROUNDING = 1e-9  # [m]
_SPACING = 0.01  # [m] maximum, between two sample points of a taxel


@dataclass(frozen=True)
class Boards:
    """A row of equal boards on one side, end to end; each taxel is an electrode of a board."""

    side: Side
    count: Annotated[int, Spec("1", "number of boards", 1, 100)]
    # None: the row covers the whole side.
    pitch: Annotated[Number | None, Spec("m", "pitch of the taxels", 0.002, 1)] = None  # ()
    # None: 0.
    middle: Annotated[
        Number | None, Spec("m", "middle along the strip, from that of the side", -4, 4)
    ] = None  # ()
    electrodes: Annotated[int, Spec("1", "number of electrodes of a board", 1, 100)] = 3

    @property
    def taxels(self) -> int:
        """Number of taxels."""
        return self.count * self.electrodes


jax.tree_util.register_dataclass(
    Boards, data_fields=["pitch", "middle"], meta_fields=["side", "count", "electrodes"]
)
BOARDS = (Boards("left", 5), Boards("front", 4), Boards("right", 5))  # 14 boards, Sec. II-B


class Row(NamedTuple):
    """Part of a side that a row of boards covers."""

    start: Array  # (2,) [m] in the robot frame
    along: np.ndarray  # (2,) unit vector; of a round base not used
    length: Number  # () [m]
    offset: Number  # () [m] of its start along the strip


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Shell:
    """Outline of a base about its origin, and its boards in the strip's order."""

    half_length: Annotated[Number, Spec("m", "half length of the base", 0.1, 2)] = HALF_LENGTH
    # None: the paper's, constant in compiled programs.
    half_width: Annotated[Number | None, Spec("m", "half width", 0.1, 2)] = None  # ()
    boards: tuple[Boards, ...] = BOARDS
    # Sample points of each taxel for the compression of foam; 1 cm apart they resolve a corner.
    samples: int = field(default=5, metadata={"static": True})
    # Its half sizes are unused then; None: a rectangle.
    radius: Annotated[Number | None, Spec("m", "radius of a round base", 0.1, 2)] = None  # ()

    @classmethod
    def of(cls, boards: tuple[Boards, ...], *sizes: Number) -> Shell:
        """Return the shell of a base, or of many bases if the `sizes` are (n,)."""
        sides = side_lengths(*(float(np.max(size)) for size in sizes))
        pitches = [sides[x.side] / x.taxels if x.pitch is None else np.max(x.pitch) for x in boards]
        samples = math.ceil(float(max(pitches)) / _SPACING)
        if len(sizes) == 1:
            return cls(sizes[0], boards=boards, samples=samples, radius=sizes[0])
        is_default = np.all(np.asarray(sizes[1]) == HALF_WIDTH)
        return cls(sizes[0], None if is_default else sizes[1], boards, samples)

    @property
    def half(self) -> tuple[Number, Number]:
        """Half length and half width [m]; of a round base its radius, twice."""
        x, y = (2 * self.sizes)[:2]
        return x, y

    @property
    def sizes(self) -> tuple[Number, ...]:
        """Half length and half width [m] of a rectangle, or the radius of a circle."""
        if self.radius is not None:
            return (self.radius,)
        return self.half_length, HALF_WIDTH if self.half_width is None else self.half_width

    @property
    def outline(self) -> Footprint:
        """Outline in the robot frame."""
        return fp.circle(*self.sizes) if self.radius is not None else fp.rectangle(*self.half)

    @property
    def count(self) -> int:
        """Number of taxels."""
        return sum(row.taxels for row in self.boards)

    def rows(self) -> list[Row]:
        """Return the positions of the rows of boards."""
        x, y = self.half
        corners = {"left": (-x, y), "front": (x, y), "right": (x, -y)}
        rows, sides = [], side_lengths(*self.sizes)
        offsets = {"left": 0.0, "front": sides["left"], "right": sides["left"] + sides["front"]}
        for boards in self.boards:
            along, side = np.array(_ALONG[boards.side]), sides[boards.side]
            start, offset = jnp.stack(corners[boards.side]), offsets[boards.side]
            gap, length = _span(boards, side)
            shifted = start if boards.pitch is None else start + gap * along
            rows.append(Row(shifted, along, length, offset + gap))
        return rows

    def taxels(self, samples: int = 1) -> Array:
        """Return sample points (T, samples, 2) [m] of the taxels in the robot frame."""
        points = []
        for boards, row in zip(self.boards, self.rows(), strict=True):
            count = boards.taxels * samples
            s = (np.arange(count) + 0.5) / count * row.length
            line = row.start + s[:, None] * row.along
            line = line if self.radius is None else self.on_strip(jnp.asarray(row.offset + s))
            points.append(line.reshape(-1, samples, 2))
        return jnp.concatenate(points)

    def on_strip(self, s: Array) -> Array:
        """Return points (..., 2) [m] in the robot frame at positions `s` (...) [m] of the strip."""
        if self.radius is not None:
            radius = jnp.asarray(self.radius, s.dtype)
            return radius * planar.unit(_ARC / 2 - s / radius)
        x, y = (jnp.asarray(half, s.dtype) for half in self.half)
        along = jnp.clip(s, 0, 2 * x) - jnp.clip(s - 2 * (x + y), 0, 2 * x)  # left and right side
        return jnp.stack([along - x, y - jnp.clip(s - 2 * x, 0, 2 * y)], axis=-1)

    def on_arc(self, bearing: Array) -> Array:
        """Return positions [m] of a round base's strip at bearings [rad] in the robot frame."""
        return jnp.asarray(self.sizes[0], bearing.dtype) * (_ARC / 2 - bearing)

    def check(self) -> None:
        """Raise InputError for a base without size, or boards that overlap or leave it."""
        check_fields(self, "robot ")
        if not self.boards:
            raise errors.not_allowed("robot boards", (), "name at least one row")
        for boards in self.boards:
            check_fields(boards, "robot boards' ")
            if boards.pitch is None and boards.middle:
                rule = "without a pitch a row covers the whole side"
                raise errors.not_allowed("robot boards' middle", boards.middle, rule)
        sides, previous = side_lengths(*self.sizes), (0, 0.0)  # side and end [m] of the row before
        for boards in self.boards:
            first, length = _span(boards, sides[boards.side])
            last, end, rule = first + length, sides[boards.side], ""
            side = SIDES.index(boards.side)
            if first < -_ROUNDING or last > end + _ROUNDING:
                rule = f"they leave the base, whose side ends at {end:g} m"
            elif (side, first + _ROUNDING) < previous:
                rule = "write the rows in the order left, front, right"
                if side == previous[0]:
                    rule = f"they overlap the previous row, which ends at {previous[1]:g} m"
            if rule:
                field = f"robot boards on the {boards.side} side"
                raise errors.not_allowed(field, f"{first:g} to {last:g} m", rule)
            previous = side, last


def _span(row: Boards, side: Number) -> tuple[Number, Number]:
    """Return the start of a row on its side of length `side` [m], and its length [m]."""
    if row.pitch is None:
        return 0.0, side
    length = row.taxels * row.pitch
    return (side - length) / 2 + (0.0 if row.middle is None else row.middle), length


def side_lengths(*sizes: Number) -> dict[Side, Number]:
    """Return the lengths [m] of the sides of a base, by side: see `Shell.sizes`."""
    if len(sizes) == 1:
        return {side: share * _ARC * sizes[0] for side, share in _SHARES.items()}
    x, y = sizes
    return {"left": 2 * x, "front": 2 * y, "right": 2 * x}
