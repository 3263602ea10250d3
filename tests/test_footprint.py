"""Footprints: distances, derivatives and line crossings against brute force."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import SEEDS, extent, property_test, refusals
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import ConvexHull, cKDTree

from rps_jax.geometry import footprint as fp
from rps_jax.geometry import planar
from rps_jax.geometry.footprint import Footprint

BATCH, POINTS = 8, 128
# One program for each number of vertices: the shapes below are always (BATCH, ...).
distances = jax.jit(jax.vmap(fp.signed_distance))  # (B, P) [m]
slopes = jax.jit(jax.vmap(jax.vmap(jax.grad(fp.signed_distance, argnums=1), (None, 0))))
shape_slopes = jax.jit(jax.vmap(jax.vmap(jax.grad(fp.signed_distance), (None, 0))))
crossings = jax.jit(jax.vmap(fp.crossing))
place = jax.jit(jax.vmap(fp.place))
reaches = jax.jit(jax.vmap(extent))


def random_rectangles(rng) -> Footprint:
    half = rng.uniform(0.05, 0.5, (BATCH, 2)).astype(np.float32)
    return place_at_random(rng, jax.vmap(fp.rectangle)(*half.T))


def random_circles(rng) -> Footprint:
    radius = rng.uniform(0.05, 0.5, BATCH).astype(np.float32)
    return place_at_random(rng, jax.vmap(fp.circle)(radius))


def random_polygons(rng) -> Footprint:
    """Heptagons inscribed in ellipses, their corners at least 0.2 rad apart."""
    share = rng.dirichlet(np.ones(7), BATCH)
    angle = np.cumsum(0.2 + (2 * np.pi - 1.4) * share, axis=1)
    axes = rng.uniform(0.1, 0.5, (BATCH, 2))
    points = np.stack([np.cos(angle), np.sin(angle)], -1) * axes[:, None]
    return place_at_random(rng, jax.tree.map(lambda *v: jnp.stack(v), *map(fp.polygon, points)))


def place_at_random(rng, footprints: Footprint) -> Footprint:
    position = rng.uniform(-0.5, 0.5, (BATCH, 2)).astype(np.float32)
    yaw = rng.uniform(-4, 4, BATCH).astype(np.float32)
    return place(footprints, position, yaw)


KINDS = {"rectangle": random_rectangles, "circle": random_circles, "polygon": random_polygons}
every_kind = pytest.mark.parametrize("kind", KINDS)


def boundary(vertices: np.ndarray, per_edge: int = 4000) -> np.ndarray:
    """Dense samples (N * per_edge, 2) of the outline of a polygon."""
    t = np.linspace(0, 1, per_edge)[:, None]
    edges = zip(vertices, np.roll(vertices, -1, axis=0), strict=True)
    return np.concatenate([a + t * (b - a) for a, b in edges])


def brute_force_distance(vertices: np.ndarray, radius: float, points: np.ndarray) -> np.ndarray:
    """Signed distance of points by dense sampling (polygons) or by definition (circles)."""
    vertices = np.float64(vertices)
    if len(vertices) == 1:
        return np.linalg.norm(points - vertices[0], axis=1) - radius
    unsigned = cKDTree(boundary(vertices)).query(points)[0]
    equations = ConvexHull(vertices).equations
    inside = (points @ equations[:, :2].T + equations[:, 2] < 0).all(axis=1)
    return np.where(inside, -unsigned, unsigned) - radius


# Golden values


BOX, BALL = fp.rectangle(0.3, 0.2), fp.circle(0.25)
SQUARE = np.float32([[1, -1], [1, 1], [-1, 1], [-1, -1]])
DISTANCES = {
    "box with a radius": (
        BOX._replace(radius=jnp.float32(0.1)),
        {(0, 0): -0.3, (0.5, 0): 0.1, (0.6, 0.6): 0.4},
    ),
    "stadium": (
        Footprint(jnp.array([[-0.3, 0.0], [0.3, 0.0]]), jnp.float32(0.1)),
        {(0, 0): -0.1, (0.2, 0.3): 0.2, (0.6, 0.4): 0.4},
    ),
    # A prism and a circle are filled up to one number of corners by repeated ones.
    "square": (
        Footprint(jnp.array(0.2 * SQUARE[[0, 1, 2, 3, 3, 3, 3, 3]]), jnp.float32(0)),
        {(0, 0): -0.2, (0.19, 0): -0.01, (0.3, 0.1): 0.1, (-0.25, -0.25): 0.05 * 2**0.5},
    ),
    "point": (Footprint(jnp.zeros((4, 2)), jnp.float32(0.1)), {(0, 0): -0.1, (0.3, 0.4): 0.4}),
}


@pytest.mark.parametrize("shape", DISTANCES)
def test_the_distance_by_hand(shape):
    outline, expected = DISTANCES[shape]
    distance = fp.signed_distance(outline, jnp.array(list(expected), float))
    assert_allclose(distance, list(expected.values()), atol=1e-6)


def test_place_turns_and_then_moves():
    placed = fp.place(BOX, jnp.array([1.0, 2.0]), jnp.float32(math.pi / 2))
    expected = [[0.8, 2.3], [0.8, 1.7], [1.2, 1.7], [1.2, 2.3]]
    assert_allclose(placed.vertices, expected, atol=1e-6)
    assert fp.place(BALL, jnp.ones(2), 1.0).radius == 0.25


# Signed distance


@every_kind
def test_the_signed_distance_agrees_with_brute_force(kind):
    rng = default_rng(0)
    for _ in range(4):
        footprints = KINDS[kind](rng)
        points = rng.uniform(-1.2, 1.2, (BATCH, POINTS, 2)).astype(np.float32)
        got = distances(footprints, points)
        for b in range(BATCH):
            shape = jax.tree.map(lambda v, b=b: np.asarray(v)[b], footprints)
            assert_allclose(got[b], brute_force_distance(*shape, points[b]), rtol=1e-5, atol=2e-4)
        assert (got < -1e-3).any()
        assert (got > 1e-3).any()


@every_kind
@property_test(SEEDS)
def test_the_signed_distance_does_not_depend_on_the_frame(kind, seed):
    rng = default_rng(seed)
    footprints = KINDS[kind](rng)
    points = rng.uniform(-1, 1, (BATCH, POINTS, 2)).astype(np.float32)
    position = rng.uniform(-2, 2, (BATCH, 2)).astype(np.float32)
    yaw = rng.uniform(-4, 4, BATCH).astype(np.float32)
    moved = planar.rotate(yaw[:, None], points) + position[:, None]
    got = distances(place(footprints, position, yaw), moved)
    assert_allclose(got, distances(footprints, points), atol=3e-6)


@every_kind
def test_the_derivative_of_the_distance_is_the_unit_normal(kind):
    """It agrees with finite differences, except on the ridges inside, where there is none."""
    rng = default_rng(1)
    h = 1e-6
    with jax.enable_x64(True):
        footprints = jax.tree.map(lambda v: jnp.asarray(v, jnp.float64), KINDS[kind](rng))
        points = rng.uniform(-1, 1, (BATCH, POINTS, 2))
        gradient = np.asarray(slopes(footprints, points))
        distance = np.asarray(distances(footprints, points))[..., None]
        steps = h * np.eye(2)
        up, down = (
            np.stack([np.asarray(distances(footprints, points + a * e)) for e in steps], -1)
            for a in (1, -1)
        )
    smooth = (np.abs(up - 2 * distance + down) < 1e-3 * h).all(axis=-1)
    assert smooth.mean() > 0.98
    assert_allclose(gradient[smooth], ((up - down) / (2 * h))[smooth], atol=1e-4)
    assert_allclose(np.linalg.norm(gradient, axis=-1), 1, rtol=1e-6)


@every_kind
def test_derivatives_are_finite_on_vertices_edges_and_the_centre(kind):
    footprints = KINDS[kind](default_rng(2))
    vertices = np.asarray(footprints.vertices)  # (B, N, 2)
    middles = 0.5 * (vertices + np.roll(vertices, -1, axis=1))
    centre = vertices.mean(axis=1, keepdims=True)
    special = np.concatenate([vertices, middles, centre], axis=1)
    points = np.resize(special.swapaxes(0, 1), (POINTS, BATCH, 2)).swapaxes(0, 1)
    by_point = slopes(footprints, points)
    for gradient in (by_point, *shape_slopes(footprints, points)):
        assert np.isfinite(gradient).all()
        assert np.abs(gradient).max() < 4


def test_derivatives_are_finite_on_an_exact_corner_side_and_centre():
    box = fp.rectangle(0.25, 0.125)
    points = jnp.array([[0.25, 0.125], [0.25, 0.0], [0.0, 0.125], [0.0, 0.0], [-0.25, -0.125]])
    gradient = jax.vmap(jax.grad(fp.signed_distance, argnums=1), (None, 0))(box, points)
    assert np.isfinite(gradient).all()
    assert np.linalg.norm(gradient, axis=1).max() <= 1 + 1e-6


# Crossing

DIAGONAL = (math.sqrt(0.5), -math.sqrt(0.5))
PAST_THE_CORNER = (0.3 + 0.05 * math.sqrt(0.5), 0.2 + 0.05 * math.sqrt(0.5))
X_AXIS, NOTHING = (1.0, 0.0), (math.inf, -math.inf)


@pytest.mark.parametrize(
    ("shape", "origin", "along", "tolerance", "expected"),
    [
        # Beside the upper side by 0.03: the tolerance 0.05 rounds the corners, 3-4-5.
        (BOX, (0.0, 0.23), X_AXIS, 0.05, (-0.34, 0.34)),
        # Past the corner (0.3, 0.2) at 0.05: its arc, half a chord of sqrt(0.06^2 - 0.05^2).
        (BOX, PAST_THE_CORNER, DIAGONAL, 0.06, (-0.0331662, 0.0331662)),
        # The same at 0.13: the shifted sides, 0.13 sqrt(2) - 0.05 away.
        (BOX, PAST_THE_CORNER, DIAGONAL, 0.13, (-0.1338478, 0.1338478)),
        # Along a side it is the whole side.
        (fp.rectangle(0.25, 0.125), (0.0, 0.125), X_AXIS, 0.0, (-0.25, 0.25)),
        # A line that touches a circle crosses it in a point.
        (BALL, (-1.0, 0.375), X_AXIS, 0.125, (1.0, 1.0)),
        (DISTANCES["stadium"][0], (0.0, 0.06), X_AXIS, 0.0, (-0.38, 0.38)),  # 6-8-10 at each end
        # A line without a crossing has an empty interval.
        (BOX, (0.0, 0.26), X_AXIS, 0.05, NOTHING),
    ],
)
def test_the_crossing_by_hand(shape, origin, along, tolerance, expected):
    got = fp.crossing(shape, jnp.array(origin), jnp.array(along), tolerance)
    assert_allclose(got, expected, atol=1e-6)


def random_lines(rng, footprints: Footprint) -> tuple[np.ndarray, np.ndarray]:
    """Lines (B, 2), (B, 2): at random, or along and beside an edge where there is one."""
    angle = rng.uniform(-np.pi, np.pi, BATCH)
    origin = rng.uniform(-0.8, 0.8, (BATCH, 2))
    vertices = np.float64(footprints.vertices)
    if vertices.shape[1] > 1:
        edge = vertices[:, 1] - vertices[:, 0]
        is_beside = rng.random(BATCH) < 0.3
        angle = np.where(is_beside, np.arctan2(edge[:, 1], edge[:, 0]), angle)
        outward = np.stack([np.sin(angle), -np.cos(angle)], -1)
        shifted = vertices[:, 0] + outward * rng.uniform(-0.05, 0.15, (BATCH, 1))
        origin = np.where(is_beside[:, None], shifted, origin)
    along = np.stack([np.cos(angle), np.sin(angle)], -1)
    return origin.astype(np.float32), along.astype(np.float32)


@every_kind
@property_test(SEEDS)
def test_a_crossing_holds_exactly_the_points_within_the_tolerance(kind, seed):
    """Its ends are at the tolerance."""
    rng = default_rng(seed)
    footprints = KINDS[kind](rng)
    origin, along = random_lines(rng, footprints)
    tolerance = rng.choice([0.0, 0.006, 0.1], BATCH).astype(np.float32)
    low, high = (np.asarray(v)[:, None] for v in crossings(footprints, origin, along, tolerance))
    hit = low <= high
    # Samples along the line, its ends, and its points just within and just beyond them.
    s = np.linspace(-2.5, 2.5, POINTS - 6) * np.ones((BATCH, 1))
    edges = np.where(hit, np.concatenate([low, high], axis=1), 0)
    inward = np.array([2e-3, -2e-3])
    s = np.concatenate([s, edges, edges + inward, edges - inward], axis=1)
    points = np.float32(origin[:, None] + s[..., None] * along[:, None])
    margin = np.asarray(distances(footprints, points)) - tolerance[:, None]
    within = (low <= s) & (s <= high)
    assert margin[within].max(initial=-1) < 2e-6
    assert -margin[~within].min() < 2e-6
    assert_allclose(margin[hit[:, 0], -6:-4], 0, atol=2e-6)


def test_derivatives_of_a_crossing_are_finite_if_the_line_only_grazes():
    """Or misses."""

    def chord(shape, y):
        origin = jnp.stack([0.0 * y, y])
        low, high = fp.crossing(shape, origin, jnp.array([1.0, 0.0]), 0.0)
        return jnp.where(low <= high, high - low, 0.0)

    for shape in (fp.circle(0.25), fp.rectangle(0.5, 0.25)):
        y = jnp.array([0.0, 0.2, 0.25, -0.25, 0.3])
        gradients = jax.jit(jax.vmap(jax.grad(chord, argnums=(0, 1)), (None, 0)))
        by_shape, by_y = gradients(shape, y)
        for gradient in (*by_shape, by_y):
            assert np.isfinite(gradient).all()


# Extent


@every_kind
def test_the_extent_is_the_furthest_point_of_the_outline(kind):
    rng = default_rng(4)
    footprints = KINDS[kind](rng)
    angle = rng.uniform(-4, 4, BATCH)
    along = np.stack([np.cos(angle), np.sin(angle)], -1).astype(np.float32)
    got = reaches(footprints, along)
    for b in range(BATCH):
        vertices, radius = np.float64(footprints.vertices[b]), float(footprints.radius[b])
        outline = boundary(vertices, 100)
        if radius > 0:
            turn = np.linspace(0, 2 * np.pi, 4000)
            outline = outline + radius * np.stack([np.cos(turn), np.sin(turn)], -1)[:, None]
        assert got[b] == pytest.approx((outline @ along[b]).max(), abs=2e-6)


# Constructors


def test_outlines_are_counter_clockwise_and_of_the_given_size():
    x, y = np.asarray(BOX.vertices, float).T
    area = 0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum()
    assert area == pytest.approx(0.6 * 0.4)
    assert (BOX.radius, BALL.radius) == (0, 0.25)
    assert_array_equal(BALL.vertices, [[0, 0]])
    triangle = [[0.0, 0.0], [1.0, 0.0], [0.25, 0.5]]
    built = fp.polygon(triangle)
    assert_array_equal(built.vertices, triangle)
    assert built.radius == 0


STAR_ANGLES = 4 * math.pi * np.arange(5) / 5
STAR = np.stack([np.sin(STAR_ANGLES), -np.cos(STAR_ANGLES)], -1)


FAULTS = {
    "clockwise": SQUARE[::-1],
    "not convex": [[0, 0], [1, 0], [0.2, 0.2], [0, 1]],
    "crossing itself": [[0, 0], [1, 1], [1, 0], [0, 1]],
    "a star, always turning left but twice around": STAR,
    "a star the other way around": STAR[::-1],
    "twice around a square": np.tile(SQUARE, (2, 1)),
    "three in a line": [[0, 0], [0.5, 0], [1, 0], [1, 1]],
    "a repeated vertex": [[0, 0], [1, 0], [1, 0], [1, 1]],
    "all in a line": [[0, 0], [1, 0], [2, 0]],
    "NaN": [[0, 0], [1, 0], [math.nan, 1]],
    "infinite": [[0, 0], [math.inf, 0], [1, 1]],
    "two vertices": [[0, 0], [1, 0]],
    "three coordinates": [[0, 0, 0], [1, 0, 0], [1, 1, 0]],
    "flat": [0, 0, 1, 0, 1, 1],
    "empty": [],
}


test_polygon_rejects_outlines_that_are_not_convex_and_counter_clockwise = refusals(
    fp.polygon, *(((vertices,), "vertices = .* is not allowed: ") for vertices in FAULTS.values())
)
