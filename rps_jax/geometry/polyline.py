"""Polylines: paths to follow, and walls not to touch."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rps_jax.geometry import footprint as fp
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Float, Scalar, namespace_of
from rps_jax.geometry.footprint import Footprint


class Polyline(NamedTuple):
    """Vertices, and the arc length from the first vertex to each."""

    vertices: Float[Array, "*B K 2"]  # [m]
    arcs: Float[Array, "*B K"]  # [m]

    @classmethod
    def through(cls, vertices: Any) -> Polyline:
        """Return polylines through vertices (..., K, 2) [m], as arrays of the same library."""
        xp = namespace_of(vertices)
        lengths = xp.linalg.norm(xp.diff(vertices, axis=-2), axis=-1)
        zero = xp.zeros_like(lengths[..., :1])
        arcs = xp.concatenate([zero, xp.cumsum(lengths, axis=-1)], axis=-1)
        return cls(vertices, arcs)


def at_arc(line: Polyline, arc: Scalar) -> Float[Array, "2"]:
    """Return the point [m] of one polyline at an arc length [m], at most its whole length."""
    lengths = jnp.diff(line.arcs)
    units = jnp.diff(line.vertices, axis=0) / jnp.where(lengths > 0, lengths, 1.0)[:, None]
    passed = jnp.clip(arc - line.arcs[:-1], 0.0, lengths)
    return line.vertices[0] + jnp.sum(passed[:, None] * units, axis=0)


def nearest(
    line: Polyline, point: Float[Array, "2"], low: Scalar, high: Scalar
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the arc length [m] of the nearest point of one polyline, and its distance [m].

    Only arc lengths from `low` to `high` [m] count, so that a path may return to itself.
    """
    start, first, last = line.vertices[:-1], line.arcs[:-1], line.arcs[1:]
    lengths = last - first
    units = jnp.diff(line.vertices, axis=0) / jnp.where(lengths > 0, lengths, 1.0)[:, None]
    x, y = point[0] - start[:, 0], point[1] - start[:, 1]
    ahead = x * units[:, 0] + y * units[:, 1]
    ahead = jnp.clip(ahead, jnp.maximum(low - first, 0.0), jnp.minimum(high - first, lengths))
    away_x, away_y = x - ahead * units[:, 0], y - ahead * units[:, 1]
    counts = (first <= high) & (last >= low)
    squares = jnp.where(counts, away_x * away_x + away_y * away_y, jnp.inf)
    chosen = jnp.argmin(squares)
    return first[chosen] + ahead[chosen], planar.safe_sqrt(squares[chosen])


def clearance(
    outline: Footprint, walls: Float[Array, "W 2 2"]
) -> tuple[Float[Array, ""], Float[Array, "2"]]:
    """Return the signed distance [m] of an outline from walls, and the nearest point [m] of these.

    A wall is a segment between two points [m]. The distance is exact; where the outline crosses a
    wall, it is minus the shortest way out of it.
    """
    corners, (start, end) = outline.vertices, (walls[:, 0], walls[:, 1])
    along = end - start
    length = planar.norm(along)[:, None]
    normal = planar.rotate(jnp.pi / 2, along) / jnp.where(length > 0, length, 1.0)
    ahead = jnp.roll(corners, -1, axis=0)

    def include(i: Array, least: tuple[Array, ...]) -> tuple[Array, ...]:
        """Include corner i and the edge that follows it."""
        square, low, high, gap = least
        corner = corners[i]
        height = _dot(corner - start, normal)
        edge = ahead[i] - corner
        size = planar.norm(edge)
        out = jnp.stack([edge[1], -edge[0]]) / jnp.where(size > 0, size, 1.0)
        for distance2 in (
            _square(start, along, corner), _square(corner, edge, start), _square(corner, edge, end)
        ):  # fmt: skip
            square = jnp.minimum(square, distance2)
        beyond = jnp.minimum(_dot(start - corner, out), _dot(end - corner, out))
        gap = jnp.maximum(gap, jnp.where(size > 0, beyond, -jnp.inf))
        return square, jnp.minimum(low, height), jnp.maximum(high, height), gap

    infinite = jnp.full(walls.shape[:1], jnp.inf)
    # A loop in compiled programs: a GPU would store the arrays of all corners at once.
    square, low, high, gap = jax.lax.fori_loop(
        0, len(corners), include, (infinite, infinite, -infinite, -infinite)
    )
    gap = jnp.maximum(gap, jnp.where(length[:, 0] > 0, jnp.maximum(low, -high), -jnp.inf))
    distance = planar.safe_sqrt(square)
    if len(corners) > 1:  # a point has no inside
        distance = jnp.where(gap > 0, distance, gap)
    chosen = jnp.argmin(distance)
    return distance[chosen] - outline.radius, _nearest_on_wall(outline, walls[chosen])


def _nearest_on_wall(outline: Footprint, wall: Float[Array, "2 2"]) -> Float[Array, "2"]:
    """Return the point [m] of one wall that is nearest to an outline."""
    along, corners = wall[1] - wall[0], outline.vertices
    points = jnp.concatenate([wall[0] + _share(wall[0], along, corners)[:, None] * along, wall])
    to_ends = fp.signed_distance(outline, wall) + outline.radius
    squares = jnp.concatenate([_square(wall[0], along, corners), to_ends**2])
    return points[jnp.argmin(squares)]


def _dot(a: Float[Array, "... 2"], b: Float[Array, "... 2"]) -> Float[Array, "..."]:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]


def _share(
    start: Float[Array, "... 2"], along: Float[Array, "... 2"], point: Float[Array, "... 2"]
) -> Float[Array, "..."]:
    """Return the point of segments nearest to points, as a share of the segment's length."""
    length2 = _dot(along, along)
    return jnp.clip(_dot(point - start, along) / jnp.where(length2 > 0, length2, 1.0), 0.0, 1.0)


def _square(
    start: Float[Array, "... 2"], along: Float[Array, "... 2"], point: Float[Array, "... 2"]
) -> Float[Array, "..."]:
    """Return the squared distance [m^2] of points from segments."""
    away = point - start - _share(start, along, point)[..., None] * along
    return _dot(away, away)
