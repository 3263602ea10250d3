"""Polylines: paths to follow, and walls not to touch."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.geometry import footprint as fp
from rps_jax.geometry import planar
from rps_jax.geometry import vectors as sp
from rps_jax.geometry.arrays import (
    Array,
    Entries,
    Float,
    Int,
    Number,
    Pair,
    Scalar,
    Vector,
    namespace_of,
)
from rps_jax.geometry.footprint import Footprint


class Polyline(NamedTuple):
    """Vertices, and the arc length from the first vertex to each."""

    vertices: Float[Array, "*B K 2"]  # [m]
    arcs: Float[Array, "*B K"]  # [m]

    @classmethod
    def through(cls, vertices: Entries) -> Polyline:
        """Return polylines through vertices (..., K, 2) [m], as arrays of the same library."""
        xp = namespace_of(vertices)
        lengths = xp.linalg.norm(xp.diff(vertices, axis=-2), axis=-1)
        zero = xp.zeros_like(lengths[..., :1])
        arcs = xp.concatenate([zero, xp.cumsum(lengths, axis=-1)], axis=-1)
        return cls(vertices, arcs)


class _Segments(NamedTuple):
    """Segments of one polyline, each a number per segment (K - 1,)."""

    # Coordinates are separate arrays: on a GPU, each thread then keeps those of its segments.
    x: Array  # [m] of the start
    y: Array  # [m]
    unit_x: Array  # [1] direction; 0 without a length
    unit_y: Array  # [1]
    first: Array  # [m] arc length at the start
    length: Array  # [m]

    @classmethod
    def from_line(cls, line: Polyline) -> _Segments:
        """Return the segments of a polyline."""
        x, y = line.vertices[:, 0], line.vertices[:, 1]
        length = jnp.diff(line.arcs)
        scale = 1 / jnp.where(length > 0, length, 1.0)
        return cls(x[:-1], y[:-1], jnp.diff(x) * scale, jnp.diff(y) * scale, line.arcs[:-1], length)


def at_arc(line: Polyline, arc: Scalar) -> Vector:
    """Return the point [m] of one polyline at an arc length [m], at most its whole length."""
    segments = _Segments.from_line(line)
    passed = jnp.clip(arc - segments.first, 0.0, segments.length)
    away = [jnp.sum(passed * unit) for unit in (segments.unit_x, segments.unit_y)]
    return line.vertices[0] + jnp.stack(away)


def nearest(
    line: Polyline, point: Vector, low: Scalar, high: Scalar
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the arc length [m] of the nearest point of one polyline, and its distance [m].

    Only arc lengths from `low` to `high` [m] count, so that a path may return to itself.
    """
    segments = _Segments.from_line(line)
    x, y = point[0] - segments.x, point[1] - segments.y
    ahead = x * segments.unit_x + y * segments.unit_y
    ahead = jnp.clip(
        ahead,
        jnp.maximum(low - segments.first, 0.0),
        jnp.minimum(high - segments.first, segments.length),
    )
    away_x, away_y = x - ahead * segments.unit_x, y - ahead * segments.unit_y
    counts = (segments.first <= high) & (segments.first + segments.length >= low)
    squares = jnp.where(counts, away_x * away_x + away_y * away_y, jnp.inf)
    chosen = jnp.argmin(squares)
    return segments.first[chosen] + ahead[chosen], planar.safe_sqrt(squares[chosen])


def clearance(
    outline: Footprint, walls: Float[Array, "W 2 2"]
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """Return the signed distance [m] of an outline from walls, and the index of the nearest wall.

    A wall is a segment between two points [m]. The distance is exact; where the outline crosses a
    wall, it is minus the shortest way out of it.
    """
    corners = outline.vertices
    ahead = jnp.roll(corners, -1, axis=0)
    # Coordinates are separate arrays: see `_Segments`.
    start = walls[:, 0, 0], walls[:, 0, 1]
    along = _Vectors.from_components(walls[:, 1, 0] - start[0], walls[:, 1, 1] - start[1])
    normal = along.normal

    def include(i: Array, least: tuple[Array, ...]) -> tuple[Array, ...]:
        """Include corner i and the edge that follows it."""
        square, low, high, gap = least
        corner = corners[i, 0], corners[i, 1]
        edge = _Vectors.from_components(ahead[i, 0] - corner[0], ahead[i, 1] - corner[1])
        to_corner = sp.sub(corner, start)
        to_start = -to_corner[0], -to_corner[1]
        to_end = sp.add(to_start, along[:2])
        for way, segment in ((to_corner, along), (to_start, edge), (to_end, edge)):
            square = jnp.minimum(square, _square(way, segment))
        height = sp.dot(to_corner, normal)
        # The normal of an edge points into the outline, whose corners turn to the left.
        inside = jnp.maximum(sp.dot(to_start, edge.normal), sp.dot(to_end, edge.normal))
        gap = jnp.maximum(gap, jnp.where(edge.inverse > 0, -inside, -jnp.inf))
        return square, jnp.minimum(low, height), jnp.maximum(high, height), gap

    infinite = jnp.full(walls.shape[:1], jnp.inf, walls.dtype)
    # A loop in compiled programs: a GPU would store the arrays of all corners at once.
    square, low, high, gap = jax.lax.fori_loop(
        0, len(corners), include, (infinite, infinite, -infinite, -infinite)
    )
    gap = jnp.maximum(gap, jnp.where(along.inverse > 0, jnp.maximum(low, -high), -jnp.inf))
    distance = planar.safe_sqrt(square)
    if len(corners) > 1:  # a point has no inside
        distance = jnp.where(gap > 0, distance, gap)
    chosen = jnp.argmin(distance)
    return distance[chosen] - outline.radius, chosen


def nearest_on_wall(outline: Footprint, wall: Float[Array, "2 2"]) -> Vector:
    """Return the point [m] of one wall that is nearest to an outline."""
    along, way = wall[1] - wall[0], outline.vertices - wall[0]
    pair = (way[:, 0], way[:, 1]), _Vectors.from_components(along[0], along[1])
    points = jnp.concatenate([wall[0] + _share(*pair)[:, None] * along, wall])
    to_ends = fp.signed_distance(outline, wall) + outline.radius
    squares = jnp.concatenate([_square(*pair), to_ends**2])
    return points[jnp.argmin(squares)]


class _Vectors(NamedTuple):
    """Vectors from the start to the end of segments, with the inverse of their squared lengths."""

    x: Array  # [m]
    y: Array  # [m]
    inverse: Array  # [1/m^2] 0 without a length

    @classmethod
    def from_components(cls, x: Array, y: Array) -> _Vectors:
        """Return vectors by their coordinates."""
        square = x * x + y * y
        return cls(x, y, jnp.where(square > 0, 1 / jnp.where(square > 0, square, 1.0), 0.0))

    @property
    def normal(self) -> Pair:
        """Unit vectors to the left [1]."""
        scale = planar.safe_sqrt(self.inverse)
        return -self.y * scale, self.x * scale


def _share(way: Pair, along: _Vectors) -> Array:
    """Return the point of segments nearest to a point, as a share of a segment's length.

    `way` [m] is from a segment's start to the point.
    """
    return jnp.clip(sp.dot(way, along[:2]) * along.inverse, 0.0, 1.0)


def _square(way: Pair, along: _Vectors) -> Number:
    """Return the squared distance [m^2] of points from segments: see `_share`."""
    share = _share(way, along)
    away = sp.sub(way, sp.scale(share, along[:2]))
    return sp.dot(away, away)


# --- segments between complex numbers, in NumPy --------------------------------------------------


def distances(p: Entries, q: Entries, a: Entries, b: Entries) -> np.ndarray:
    """Return the distances [m] between segments from p to q, or points, and those from a to b."""
    pairs = (p, a, b), (q, a, b), (a, p, q), (b, p, q)
    sides, lengths = ([f(*pair) for pair in pairs] for f in (_side, to_segment))
    crosses = (sides[0] * sides[1] < 0) & (sides[2] * sides[3] < 0)
    return np.where(crosses, 0.0, functools.reduce(np.minimum, lengths))


def is_inside(point: Entries, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return whether rays from points (..., 1) cross an odd number of segments from a to b (N,)."""
    passed = (a.imag > np.imag(point)) != (b.imag > np.imag(point))
    return np.sum(passed & ((_side(point, a, b) > 0) == (b.imag > a.imag)), axis=-1) % 2 == 1


def to_segment(point: Entries, a: Entries, b: Entries) -> np.ndarray:
    """Return the distances [m] of points from segments from a to b."""
    along, away = b - a, point - a
    share = np.real(np.conj(along) * away) / np.maximum(abs(along) ** 2, 1e-30)
    return abs(away - np.clip(share, 0, 1) * along)


def _side(point: Entries, a: Entries, b: Entries) -> np.ndarray:
    """Return a number above 0 for points on the left of lines from a to b."""
    return np.imag(np.conj(b - a) * (point - a))
