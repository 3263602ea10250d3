"""Contacts of the object with the ground and the base, and MuJoCo's soft constraint at each.

The corners of the lower face touch the ground; the side touches the base along two upright lines.
Vectors are in the world's axes; points are relative to the object's centre of mass unless stated
otherwise. The leading axis of an array is that of corners or contacts, the rest is the batch.
Reference: MuJoCo documentation, "Computation: Constraint model".
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rps_jax.geometry import vectors as sp
from rps_jax.geometry.arrays import Array, Entries, Number
from rps_jax.geometry.vectors import Point, Vec
from rps_jax.world.physics import Physics
from rps_jax.world.scene import WALL_HALF, WALL_TOP

_FAR = 1e9  # [m] distance of points that never touch
_PARALLEL = 1e-4  # [m] by which a face of the base is preferred to one of the object
AT_ONCE = 2  # walls that an object may touch at the same time
_UPRIGHT = 1e-6  # [rad] tilt below which all points of a cylinder's rim are equally low
# MuJoCo's default impedance of the skin contact: minimum, maximum, and the depth [m] between.
_D_MIN, _D_MAX, _WIDTH = 0.9, 0.95, 0.001


class Body(NamedTuple):
    """Constants of one world, from MuJoCo. Frame: principal axes at the centre of mass."""

    mass: Number  # () [kg]
    inertia: Entries  # (3,) [kg m^2] principal moments
    p_object_com: Entries  # (3,) [m] centre of mass in the object's frame
    q_object_body: Entries  # (4,) principal axes in the object's frame
    vertices: Entries  # (N, 3) [m] of the lower face, or a cylinder's centre; later `Corners`
    radius: Number  # () [m] of a cylinder; 0 of a prism
    height: Number  # () [m]
    up: Entries  # (3,) unit vector along the height
    friction_ground: Number  # () [1]
    friction_robot: Number  # () [1]
    invweight: Number  # () [1/kg] MuJoCo's inverse weight of the object in a contact
    base_invweight: Number  # () [1/kg] inverse weight of the base
    base_size: Entries  # (2,) [m] half length and width of the base, or (1,) its radius
    base_z: Entries  # (2,) [m] heights of the base's lower and upper edge
    feet: Entries = None  # (N, 3) [m] of a prism that does not stand on its vertices; later a `Vec`
    foot_weight: Entries = None  # (N, 1) [1] stiffness of a foot; 0 for an unused entry
    pads: Entries = None  # (N, 2) [1, m] factor of the friction at a foot, and radius of its pad
    gravity: Entries = None  # (3,) [m/s^2] of a floor that is not level
    # (4,) unit normal of a line, its distance [m], and the factor [1] of the friction beyond it
    boundary: Entries = None
    walls: Entries = None  # (W, 4) [m] x, y, x, y of both ends; later a list of `Wall`, or None
    friction_wall: Number | None = None  # () [1]


class Corners(NamedTuple):
    """The lower face of a prism."""

    at: Vec  # (N, ...) [m]
    ahead: Vec  # (N, ...) [m] the next corner
    real: Array  # (N, ...) bool, False for a corner that repeats the previous one

    @classmethod
    def of(cls, at: Vec) -> Corners:
        """Return the corners of points (N, ...), counter-clockwise seen from above."""
        back = sp.map_entries(lambda x: x - jnp.roll(x, 1, axis=0), at)
        ahead = sp.map_entries(lambda x: jnp.roll(x, -1, axis=0), at)
        return cls(at, ahead, sp.dot(back, back) > 1e-12)  # type: ignore[arg-type]


class State(NamedTuple):
    """State of a world."""

    base: Vec  # x, y [m], yaw [rad]
    p: Vec  # [m] centre of mass
    q: tuple[Number, Number, Number, Number]  # principal axes in the world, scalar first
    v: Vec  # [m/s] of the centre of mass
    w: Vec  # [rad/s] in principal axes
    a: Vec  # [m/s^2] last acceleration, the solver's first guess
    alpha: Vec  # [rad/s^2]
    driven: DrivenBase | None = None  # of a base with a limited force
    # [N, N, N m] of the object on the base, in the base's frame, summed over steps, if requested
    wrench_sum: Vec | None = None

    @property
    def accelerations(self) -> list[Vec]:
        """Last accelerations, also of a base with a limited force."""
        return [self.a, self.alpha, *([] if self.driven is None else [self.driven.a])]


class DrivenBase(NamedTuple):
    """State of a base that its drive pushes, in the world's axes: x, y and about the vertical."""

    v: Vec  # [m/s, m/s, rad/s]
    a: Vec  # [m/s^2, m/s^2, rad/s^2] last acceleration
    integral: Vec  # [N, N, N m] of the drive's servo, in the base's frame


class Contact(NamedTuple):
    """Contacts (C, ...). The rows of each are J a - a_ref along n, t and s."""

    r: Vec  # [m] from the centre of mass
    n: Vec  # unit normal, towards the object
    t: Vec  # unit tangents
    s: Vec
    bias: tuple[Number, ...]  # [m/s^2] -a_ref
    d: Number  # [kg] stiffness of the normal row; 0 without contact
    friction: Number  # [1]
    # [m] of a pad, which has a fourth row: the torque of friction about n over the radius
    radius: Number | None = None
    arm: Point | None = None  # [m] from the origin of a base that can be slowed


def _stiff(distance: Number, exists: Array | bool, impedance: Number, invweight: Number) -> Number:
    """Return the stiffness [kg] of a contact's normal row; 0 without contact."""
    return jnp.where(exists & (distance < 0), impedance / (invweight * (1 - impedance)), 0.0)


def _bias(k: Number, b: Number, impedance: Number, distance: Number, u: Vec) -> Vec:
    """Return minus the reference acceleration of a point of velocity u, along (n, t, s)."""
    return b * u[0] + k * impedance * distance, b * u[1], b * u[2]


def _stiffness(solref: tuple[float, float], d_max: float, timestep: float) -> tuple[float, float]:
    """Return MuJoCo's stiffness [1/s^2] and damping [1/s] of a contact."""
    time, ratio = max(solref[0], 2 * timestep), solref[1]
    return 1 / (d_max * time * ratio) ** 2, 2 / (d_max * time)


def _index(count: int, template: Number) -> Array:
    """Return 0, 1, ... along a new leading axis of the batch of `template`."""
    return jax.lax.broadcasted_iota(jnp.int32, (count, *jnp.shape(template)), 0)


def on_ground(body: Body, state: State, m: Sequence[Vec], physics: Physics) -> Contact:
    """Return the contacts of the lower face with the ground."""
    k, b = _stiffness(physics.ground_solref, physics.ground_impedance, physics.timestep)
    r, exists = _lower_face(body, m)
    distance = state.p[2] + r[2]
    at = (r[0], r[1], r[2] - 0.5 * distance)
    u = sp.add(state.v, sp.cross(sp.to_world(m, state.w), at))
    d = _stiff(distance, exists, physics.ground_impedance, body.invweight)
    bias = _bias(k, b, physics.ground_impedance, distance, (u[2], u[0], u[1]))
    friction, radius = body.friction_ground, None
    if body.pads is not None:
        factor, radius = body.pads
        d, friction = body.foot_weight[0] * d, factor * friction
        bias = *bias, radius * (b * sp.to_world(m, state.w)[2])
    if body.boundary is not None:
        x, y, border, factor = body.boundary
        beyond = x * (state.p[0] + r[0]) + y * (state.p[1] + r[1]) > border
        friction = jnp.where(beyond, factor * friction, friction)
    return Contact(at, sp.Z, sp.X, sp.Y, bias, d, friction, radius)


def _lower_face(body: Body, m: Sequence[Vec]) -> tuple[Vec, Array]:
    """Return points that may touch the ground, from the centre of mass, and whether they exist."""
    if body.feet is not None:
        return sp.to_world(m, body.feet), body.foot_weight[0] > 0
    if isinstance(body.vertices, Corners):
        return sp.to_world(m, body.vertices.at), body.vertices.real
    # Three points of a cylinder's rim, the lowest first; the fourth is padding.
    up = sp.to_world(m, body.up)
    tilt = sp.norm(up[:2])
    standing = tilt < _UPRIGHT
    divisor = jnp.maximum(tilt, _UPRIGHT)
    # Horizontal direction in which it leans; of an upright one, fixed to the object.
    lean = [jnp.where(standing, m[i][0], up[i] / divisor) for i in range(2)]
    across = (-lean[1], lean[0], 0.0)
    low = sp.cross(across, up)
    low = sp.scale(body.radius / sp.norm(low), low)
    side = sp.scale(body.radius * 0.75**0.5, across)
    i = _index(4, tilt)
    rim = sp.combine(
        (jnp.where(i == 0, 1.0, -0.5), jnp.where(i == 0, 0.0, jnp.where(i == 1, 1.0, -1.0))),
        (low, side),
    )
    return sp.add(sp.to_world(m, body.vertices), rim), i < 3


def on_base(body: Body, state: State, m: Sequence[Vec], twist: Vec, physics: Physics) -> Contact:
    """Return the contacts of the object's side with the base, at the lower and upper edge."""
    k, b = _stiffness(physics.base_solref, _D_MAX, physics.timestep)
    turn = sp.turn(state.base[2])
    z, normal, q, distance = side_contacts(body, state, m, turn)
    n = *sp.turned(turn, normal), 0.0
    t = (-n[1], n[0], 0.0)
    arm = sp.turned(turn, q)  # from the base's origin
    r = (*sp.sub(sp.add(state.base[:2], arm), state.p[:2]), z - state.p[2])
    velocity = sp.turned(turn, twist) if state.driven is None else state.driven.v
    of_base = (*sp.at_point(velocity, arm), 0.0)
    u = sp.sub(sp.add(state.v, sp.cross(sp.to_world(m, state.w), r)), of_base)
    x = jnp.minimum(jnp.abs(distance) / _WIDTH, 1.0)
    x = jnp.where(x < 0.5, 2 * x * x, 1 - 2 * (1 - x) * (1 - x))
    impedance = _D_MIN + x * (_D_MAX - _D_MIN)
    d = _stiff(distance, True, impedance, body.invweight + body.base_invweight)
    bias = _bias(k, b, impedance, distance, (sp.dot(n, u), sp.dot(t, u), u[2]))
    held = state.driven is None
    return Contact(r, n, t, sp.Z, bias, d, body.friction_robot, arm=None if held else arm)


class Wall(NamedTuple):
    """An upright wall."""

    pose: Vec  # x, y [m] of its middle, yaw [rad]
    half_length: Number  # [m]


def nearest_walls(ends: Entries, p: Vec, q: Sequence[Number], corners: Vec) -> list[Wall]:
    """Return the `AT_ONCE` walls nearest to an object.

    Args:
      ends: x, y, x, y (W, ...) [m] of both ends of at least as many walls.
      p: position [m] of a frame of the object.
      q: its quaternion, scalar first.
      corners: (N, ...) [m] of the object in this frame, or (1, ...) the middle of a cylinder.
    """
    x, y, end_x, end_y = ends
    along, away = (end_x - x, end_y - y), (p[0] - x, p[1] - y)
    share = jnp.clip(sp.dot(away, along) / sp.dot(along, along), 0.0, 1.0)
    away = sp.sub(away, sp.scale(share, along))
    gap = sp.norm(away)
    outline: Any = sp.to_world(sp.matrix(q), corners)[:2]
    inward = sp.least(sp.dot([c[:, None] for c in outline], [a[None] for a in away]))
    score: Any = -gap - inward / gap
    index = jax.lax.broadcasted_iota(jnp.int32, score.shape, 0)
    rows = (x + end_x) / 2, (y + end_y) / 2, *along, index
    walls = []
    for _ in range(AT_ONCE):
        _, (*middle, ahead, left, chosen) = _best(score, rows)
        walls.append(Wall((*middle, jnp.arctan2(left, ahead)), sp.norm((ahead, left)) / 2))
        score = jnp.where(index == chosen, -_FAR, score)
    return walls


def on_wall(body: Body, state: State, m: Sequence[Vec], wall: Wall, physics: Physics) -> Contact:
    """Return the contacts of the object's side with a wall, as with a base at rest."""
    box = {"base_size": (wall.half_length, WALL_HALF), "base_z": (0.0, WALL_TOP)}
    body = body._replace(base_invweight=0.0, friction_robot=body.friction_wall, **box)
    state = state._replace(base=wall.pose, driven=None)
    return on_base(body, state, m, (0.0, 0.0, 0.0), physics)


def side_contacts(
    body: Body, state: State, m: Sequence[Vec], turn: Point
) -> tuple[Number, Point, Point, Number]:
    """Return heights, normals, points and distances [m] of contacts (C, ...), in the base's frame.

    They are at the lower and upper edge of the base; if the object leans away, at its lower edge.
    """
    c, s = turn
    up = sp.to_world(m, body.up)
    slope = (up[0] / up[2], up[1] / up[2])
    slope = (c * slope[0] + s * slope[1], -s * slope[0] + c * slope[1])
    low, high = body.base_z[0], jnp.minimum(body.base_z[1], 0.98 * body.height)
    feet = body.vertices.at if isinstance(body.vertices, Corners) else body.vertices

    def in_base(point: Vec) -> Vec:
        """Return a point of the object in the base's frame, with its height in the world."""
        x, y, h = sp.sub(sp.add(sp.to_world(m, point), state.p), (*state.base[:2], 0.0))
        return c * x + s * y, -s * x + c * y, h

    def outline(foot: Vec, z: Number) -> Point:
        """Return points of the lower face, moved along the upright edges to the height z."""
        x, y, h = in_base(foot)
        rise = z - h
        return x + slope[0] * rise, y + slope[1] * rise

    def on_object(
        z: Number, normal: Point, point: Point, distance: Number, depth: Number
    ) -> tuple[Number, Point, Point, Number]:
        """Return contacts whose points below the lower face are moved up to it.

        The object's surface is `depth` [m] along the normal from the points.
        """
        middle, face = in_base((0.0, 0.0, 0.0)), sp.dot(body.up, feet)
        face = sp.greatest(face) if isinstance(body.vertices, Corners) else face
        away = sp.sub(sp.add(point, sp.scale(depth, normal)), middle[:2])
        above = up[2] * (sp.dot(slope, away) + z - middle[2]) - face
        rise = jnp.clip(-above * up[2], 0.0, high - z)
        return z + rise, normal, point, distance + sp.dot(slope, normal) * rise

    if not isinstance(body.vertices, Corners):
        z = jnp.where(_index(2, body.radius) == 0, low, high)
        centre = outline(body.vertices, z)
        normal, point, distance = circle_and_base(centre, body.radius, body.base_size)
        # A horizontal section of a leaning cylinder is an ellipse, wider along the normal.
        lean = sp.dot(slope, normal)
        wider = body.radius * (jnp.sqrt(1 + lean * lean) - 1)
        point = sp.sub(point, sp.scale(0.5 * wider, normal))
        distance = distance - wider
        return on_object(z, normal, point, distance, 0.5 * distance)
    middle = 0.5 * (low + high)
    corners, ahead = (outline(foot, middle) for foot in (body.vertices.at, body.vertices.ahead))
    normal, points, distances = polygon_and_base(corners, ahead, body.base_size)
    count = len(points)
    i = _index(2 * count, middle + 0 * normal[0])
    first = i % count == 0
    z = jnp.where(i < count, low, high)
    point = sp.map_entries(partial(jnp.where, first), points[0], points[-1])
    gap = jnp.where(first, distances[0], distances[-1])
    distance = gap + sp.dot(slope, normal) * (z - middle)
    # The point is midway at the middle height.
    return on_object(z, normal, point, distance, distance - 0.5 * gap)


def circle_and_base(
    centre: Point, radius: Number, size: Sequence[Number]
) -> tuple[Point, Point, Number]:
    """Return normal, point and distance [m] of a circle outside a centred base."""
    if len(size) == 1:
        normal, _, distance = circle_and_base(centre, radius, (0.0, 0.0))
        return _on_circle(size[0], normal, distance - size[0])
    nearest = sp.map_entries(lambda x, h: jnp.clip(x, -h, h), centre, size)
    offset = sp.sub(centre, nearest)
    gap = sp.norm(offset)
    outside = gap > 1e-6
    normal = (jnp.where(outside, offset[0] / gap, 1.0), jnp.where(outside, offset[1] / gap, 0.0))
    distance = jnp.where(outside, gap, centre[0] - size[0]) - radius
    return normal, sp.add(nearest, sp.scale(0.5 * distance, normal)), distance


def _on_circle(radius: Number, normal: Point, distance: Number) -> tuple[Point, Point, Number]:
    """Return normal, point and distance [m] of a contact of a round base."""
    return normal, sp.scale(radius + 0.5 * distance, normal), distance


def polygon_and_base(
    corners: Point, ahead: Point, size: Sequence[Number]
) -> tuple[Point, list[Point], list[Number]]:
    """Return the normal from a centred base to a convex polygon, points and distances [m].

    There are two points on a rectangle, one on a circle. The polygon has corners (N, ...), each
    with its next corner `ahead`. The face of maximum separation is the reference face. The most
    opposed face of the other outline is the incident face; it is clipped to the width of the
    reference face, as in MuJoCo's box-box collider.
    """
    x, y = corners
    along = sp.sub(ahead, corners)
    length = sp.norm(along)
    along = sp.map_entries(lambda x: x / length, along)
    n = (along[1], -along[0])
    real = length > 1e-6
    if len(size) == 1:
        edges: Any = n, along, length, real
        return _polygon_and_circle(corners, edges, size[0])
    a, b = size
    gaps = -(x * n[0] + y * n[1]) - (a * jnp.abs(n[0]) + b * jnp.abs(n[1]))
    faces = (n, corners, along, length)
    separation, chosen = _best(jnp.where(real, gaps, -_FAR), faces)

    unit, nil = jnp.ones_like(separation), jnp.zeros_like(separation)
    # Reference faces: separation, normal out of its owner, a point on it, along it, its length.
    sides = [
        (sp.least(x) - a, (unit, nil), (a, -b), (nil, unit), 2 * b),
        (-sp.greatest(x) - a, (-unit, nil), (-a, b), (nil, -unit), 2 * b),
        (sp.least(y) - b, (nil, unit), (a, b), (-unit, nil), 2 * a),
        (-sp.greatest(y) - b, (nil, -unit), (-a, -b), (unit, nil), 2 * a),
    ]

    def side(score: list[Number]) -> Entries:
        top, picked = score[0], sides[0]
        for row, value in zip(sides[1:], score[1:], strict=True):
            better = value > top
            top = jnp.where(better, value, top)
            picked = jax.tree.map(partial(jnp.where, better), row, picked)
        return picked

    of_base = side([s[0] for s in sides])
    by_base = of_base[0] + _PARALLEL > separation
    ref, start, direction, width = jax.tree.map(partial(jnp.where, by_base), of_base[1:], chosen)
    base_edge = side([-sp.dot(s[1], ref) for s in sides])[2:]
    _, object_edge = _best(jnp.where(real, -sp.dot(n, ref), -_FAR), faces)
    p, edge, extent = jax.tree.map(partial(jnp.where, by_base), object_edge[1:], base_edge)
    # Clip the incident edge p + t edge, t in [0, extent], to [0, width] of the reference face.
    offset = sp.dot(sp.sub(p, start), direction)
    pace = sp.dot(edge, direction)  # near -1
    pace = jnp.where(jnp.abs(pace) < 1e-3, -1e-3, pace)
    limits = [-offset / pace, (width - offset) / pace]
    low = jnp.clip(jnp.minimum(*limits), 0.0, extent)
    high = jnp.clip(jnp.maximum(*limits), 0.0, extent)
    normal = sp.map_entries(lambda x: jnp.where(by_base, x, -x), ref)
    points, distances = [], []
    for t in (low, high):
        q = sp.add(p, sp.scale(t, edge))
        distance = sp.dot(sp.sub(q, start), ref)
        points.append(sp.sub(q, sp.scale(0.5 * distance, ref)))
        distances.append(distance)
    return normal, points, distances


def _polygon_and_circle(
    corners: Point, edges: tuple[Point, Point, Array, Array], radius: Number
) -> tuple[Point, list[Point], list[Number]]:
    """Return `polygon_and_base` of a circle: the polygon's point nearest to the middle.

    In a polygon around the middle it is on the nearest edge. Edges (N, ...) have their outward
    normals, directions, lengths [m], and whether they are real.
    """
    n, along, length, real = edges
    s = jnp.clip(-sp.dot(corners, along), 0.0, length)
    q = sp.add(corners, sp.scale(s, along))
    level = -sp.dot(corners, n)  # of the middle above each edge, negative inside
    inside = sp.greatest(jnp.where(real, level, -_FAR)) < 0
    _, (q, n) = _best(jnp.where(real, -sp.dot(q, q), -_FAR), (q, n))
    gap = sp.norm(q)
    normal = sp.map_entries(lambda x, y: jnp.where(inside, -x, y / gap), n, q)
    normal, point, distance = _on_circle(radius, normal, jnp.where(inside, -gap, gap) - radius)
    return normal, [point], [distance]


def _best(score: Array, values: Entries) -> tuple[Number, Entries]:
    """Return the maximum score along the leading axis and its values; the first of equal ones."""
    top = sp.greatest(score)
    i = jax.lax.broadcasted_iota(jnp.int32, score.shape, 0)
    first = sp.least(jnp.where(score == top, i, score.shape[0]))
    is_first = i == first
    return top, jax.tree.map(lambda x: sp.total(jnp.where(is_first, x, 0.0)), values)
