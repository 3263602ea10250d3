"""Footprints: the planar outline of an object, as a rounded convex polygon.

A rectangle is four vertices and radius 0, a circle one vertex and its radius, a convex polygon
its vertices: one formula serves all, batches over sizes, and has finite derivatives everywhere.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Float, Floats, Number, Scalar, Vector

CORNERS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])  # of a square


class Footprint(NamedTuple):
    """Set of points within `radius` of the convex hull of `vertices`, in the object's frame."""

    vertices: Float[Array, "*B N 2"]  # [m] counter-clockwise; N is static
    radius: Floats  # [m]


@jax.jit
def rectangle(half_x: Scalar, half_y: Scalar) -> Footprint:
    """Return a rectangle of sides 2 half_x by 2 half_y [m] about the origin."""
    half = jnp.stack([jnp.asarray(half_x), jnp.asarray(half_y)])
    return Footprint(jnp.array(CORNERS) * half, jnp.zeros(()))


def circle(radius: Number) -> Footprint:
    """Return a circle of a radius [m] about the origin."""
    return Footprint(jnp.zeros((1, 2)), jnp.asarray(radius, float))


def polygon(vertices: ArrayLike) -> Footprint:
    """Return a convex polygon of vertices (N >= 3, 2) [m], counter-clockwise.

    Raises:
      InputError: the vertices are not finite, not convex or not counter-clockwise.

    Examples:
      >>> from rps_jax.geometry.footprint import polygon
      >>> polygon([(0.2, 0.0), (-0.1, 0.2), (-0.1, -0.2)]).vertices.shape
      (3, 2)
    """
    return Footprint(jnp.asarray(check_corners("vertices", vertices)), jnp.zeros(()))


def check_corners(name: str, vertices: ArrayLike) -> np.ndarray:
    """Return the corners (N, 2) [m] of a convex polygon, or raise InputError: see `polygon`."""
    points = errors.check_array(name, vertices, ("N", 2))
    edges = np.roll(points, -1, axis=0) - points
    following = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
    turning = np.arctan2(turns, np.sum(edges * following, axis=1)).sum()
    if not (turns > 0).all() or not np.isclose(turning, 2 * np.pi):
        rule = "give three corners or more, each as x, y [m]"
        if len(points) > 2:
            rule = (
                "the outline must be strictly convex and counter-clockwise from above, without "
                "repeated corners; of a concave object, as an L, give the convex hull"
            )
        raise errors.not_allowed(name, points.tolist(), rule)
    return points


def place(footprint: Footprint, position: Vector, yaw: Scalar) -> Footprint:
    """Return the footprint of an object at `position` [m] and `yaw` [rad] in another frame."""
    return footprint._replace(vertices=planar.rotate(yaw, footprint.vertices) + position)


def circumradius(footprint: Footprint) -> Float[Array, ""]:
    """Return the greatest distance [m] of the outline from the object's origin."""
    return jnp.max(planar.norm(footprint.vertices)) + footprint.radius


def _edges(
    footprint: Footprint,
) -> tuple[Float[Array, "N 2"], Float[Array, "N 2"], Float[Array, " N"]]:
    """Return start points, vectors and squared lengths of the edges; no length is zero."""
    start = footprint.vertices
    along = jnp.roll(start, -1, axis=0) - start
    length2 = jnp.sum(along * along, axis=-1)
    return start, along, jnp.where(length2 > 0, length2, 1.0)


def signed_distance(footprint: Footprint, point: Float[Array, "*P 2"]) -> Float[Array, "*P"]:
    """Return the distance [m] of `point` [m] to the outline, negative inside."""
    start, along, length2 = _edges(footprint)
    nearest, inside = jnp.asarray(jnp.inf), ~jnp.all(along == 0)
    # A loop over edges and coordinates: GPUs are slow at reducing such short axes. The root is most
    # of the work: it is taken once, of the smallest square.
    for i in range(footprint.vertices.shape[0]):
        x, y = point[..., 0] - start[i, 0], point[..., 1] - start[i, 1]
        ahead = along[i] / length2[i]
        # The first derivative of the distance by t is zero at the nearest point of an edge.
        t = jax.lax.stop_gradient(jnp.clip(x * ahead[0] + y * ahead[1], 0.0, 1.0))
        away_x, away_y = x - t * along[i, 0], y - t * along[i, 1]
        square = away_x * away_x + away_y * away_y
        # The derivative of `jnp.minimum` is zero if the compiler computes the operands twice with
        # different rounding, so that neither equals the minimum.
        nearest = jnp.where(nearest <= square, nearest, square)
        repeated = (along[i, 0] == 0) & (along[i, 1] == 0)
        inside &= repeated | (along[i, 0] * y - along[i, 1] * x > 0)
    nearest = planar.safe_sqrt(nearest)
    if footprint.vertices.shape[0] < 3:  # a point or a segment encloses nothing
        return nearest - footprint.radius
    return jnp.where(inside, -nearest, nearest) - footprint.radius


def crossing(
    footprint: Footprint, origin: Vector, along: Vector, tolerance: Scalar
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the interval of a line that lies within `tolerance` [m] of the footprint.

    The line is origin [m] + s * along, with `along` of unit length. The interval is (s_low, s_high)
    [m], or (+inf, -inf) if the line stays clear.

    The neighbourhood of a convex polygon is convex. Arcs about the vertices and shifted edges bound
    it; the line meets these at the two ends, in closed form.
    """
    reach = footprint.radius + tolerance
    normal = jnp.stack([-along[1], along[0]])
    start, edge, length2 = _edges(footprint)
    s_vertex, n_vertex = (start - origin) @ along, (start - origin) @ normal
    meets_arc = jnp.abs(n_vertex) <= reach
    half = planar.safe_sqrt(reach * reach - n_vertex * n_vertex)
    meetings = [(meets_arc, s_vertex - half), (meets_arc, s_vertex + half)]
    if footprint.vertices.shape[0] > 1:
        outward = jnp.stack([edge[:, 1], -edge[:, 0]], axis=-1) / jnp.sqrt(length2)[:, None]
        shifted = start + reach * outward
        n_start, n_edge = (shifted - origin) @ normal, edge @ normal
        parallel = n_edge == 0
        t = -n_start / jnp.where(parallel, 1.0, n_edge)
        meets_edge = ~parallel & (t >= 0) & (t <= 1)
        meetings.append((meets_edge, (shifted - origin) @ along + t * (edge @ along)))
    meets = jnp.concatenate([hit for hit, _ in meetings])
    s = jnp.concatenate([value for _, value in meetings])
    low, high = jnp.where(meets, -s, -jnp.inf), jnp.where(meets, s, -jnp.inf)
    return -planar.greatest(low), planar.greatest(high)
