"""Batches of solids: outlines, mass properties and feet, in NumPy.

A solid is an upright prism or cylinder of uniform density with a load inside. The origin of its
frame is at half its height above the centroid of its outline; z is up. Arrays are in double
precision, and their leading axis is n, the number of solids.
"""

from collections.abc import Sequence
from functools import partial
from typing import Literal, NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.geometry import vectors
from rps_jax.geometry.footprint import CORNERS

GRAVITY = 9.81  # [m/s^2]
SIDES = 8  # vertices of a prism at most; those of fewer sides repeat some
# Distribution of the pressure under an object without explicit feet: at the corners of a prism or
# at three points of a rim; uniform over the outline; or uniform along it.
Support = Literal["corners", "even", "rim"]
SUPPORTS: dict[str, float] = {"even": 0.0, "rim": 1.0, "corners": 2.0}  # kinds of `on_support`
_OUTER, _INNER = 12, 4  # cells of an outline, beyond and within half of the way to it
PADS = _OUTER + _INNER
_NODES = 8  # of the quadrature in an outer cell
_PAD = 0.82  # [1] radius of a pad over the root mean square distance of its cell's points
LOAD = 4.0  # [1] sum of the weights of pads: that of the corners of a box


class Solid(NamedTuple):
    """Outline, height and mass properties of solids of one shape family."""

    # (n, N, 2) [m] counter-clockwise, padded by repetition; (n, 1, 2) if round
    vertices: np.ndarray
    radius: np.ndarray  # (n,) [m] of a cylinder; 0 of a prism
    height: np.ndarray  # (n,) [m]
    mass: np.ndarray  # (n,) [kg]
    p_object_com: np.ndarray  # (n, 3) [m]
    inertia: np.ndarray  # (n, 3) [kg m^2] principal moments about the centre of mass
    q_object_body: np.ndarray  # (n, 4) principal axes in the object's frame, scalar first
    # (n, S, 3) [m, m, 1] positions of feet and their weights, as of springs; an entry of weight
    # 0 is unused. None: prisms stand on their corners, cylinders on their rims.
    feet: np.ndarray | None = None
    # (n, S, 2) [1, m] factor of the ground's friction under each foot, and the radius of a pad
    # there, the arm of its greatest torque of friction. None: points of equal weight and friction.
    pads: np.ndarray | None = None


def build(
    vertices: np.ndarray,
    radius: np.ndarray,
    height: np.ndarray,
    mass: np.ndarray,
    com_offset: np.ndarray,
    com_bearing: np.ndarray,
    load_size: np.ndarray,
) -> Solid:
    """Return solids whose centre of mass a load moves off the middle.

    The load is a copy of the solid of equal height, whose outline is scaled by `load_size` (n,) [1]
    about the point of the solid's outline in the direction `com_bearing` (n,) [rad]. Its mass moves
    the centre of mass by `com_offset` (n,) [1], at most 1 - `load_size`, of the way to that point.
    The rest of the mass fills the solid uniformly.
    """
    direction = unit(com_bearing)
    at = ((1 - load_size) * reach(vertices, radius, direction))[:, None] * direction
    share = com_offset / (1 - load_size)
    xx, yy, xy = _moments(vertices, radius)
    scale, pair = 1 - share + share * load_size**2, share * (1 - share)
    xx = scale * xx + pair * at[:, 0] ** 2
    yy = scale * yy + pair * at[:, 1] ** 2
    xy = scale * xy + pair * at[:, 0] * at[:, 1]
    zz = height**2 / 12
    middle, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    turn = 0.5 * np.arctan2(2 * xy, xx - yy)  # of the axis with the largest second moment of area
    inertia = mass[:, None] * np.stack([middle - half + zz, middle + half + zz, xx + yy], axis=-1)
    zero = np.zeros_like(mass)
    return Solid(
        vertices,
        radius,
        height,
        mass,
        np.concatenate([share[:, None] * at, zero[:, None]], axis=-1),
        inertia,
        quaternion(turn),
    )


def on_feet(solid: Solid, share: np.ndarray, count: np.ndarray, turn: np.ndarray) -> Solid:
    """Return solids on `count` (n,) feet, at most 4, evenly about the centre of mass.

    Each foot is `share` (n,) [1] of the way from there to the outline, the first one in the
    direction `turn` (n,) [turns].
    """
    com, at = solid.p_object_com[:, :2], []
    for i in range(SIDES):
        toward = unit(2 * np.pi * (turn + np.minimum(i, count - 1) / count))
        along = np.sum(com * toward, axis=1)
        if solid.vertices.shape[1] == 1:
            far = np.sqrt(along**2 + solid.radius**2 - np.sum(com**2, axis=1)) - along
        else:
            far = reach(solid.vertices - com[:, None], solid.radius, toward)
        at.append(np.column_stack([com + (share * far)[:, None] * toward, i < count]))
    return solid._replace(vertices=padded(solid.vertices), feet=np.stack(at, axis=1))


def on_support(solid: Solid, kind: np.ndarray) -> Solid:
    """Return solids on pads with the moments of a distribution of pressure.

    The `kind` (n,) [1] is 0 for even pressure, 1 for the rim, 2 for the corners of a prism, and
    between for mixtures. A pad has load, centroid and size of the distribution in one cell of the
    outline. Under any force, the twist of an object on even pressure or its rim is that of the
    distribution within 3 % (4 % for rectangles of 1 to 2, 7 % for mixtures of rim and corners).
    """
    is_round, vertices = solid.vertices.shape[1] == 1, padded(solid.vertices)
    kind = np.minimum(kind, 1.0) if is_round else kind
    edges = 2 * np.pi * (np.arange(_OUTER * _NODES + 1) / _NODES - 0.5) / _OUTER
    ends, nodes = (
        unit(x) * np.stack([reach(vertices, solid.radius, unit(a)[None]) for a in x], 1)[..., None]
        for x in (edges, (edges[1:] + edges[:-1]) / 2)
    )
    # Cells of the nodes, beyond and within half of the way; Gauss's rule along the way.
    outer = np.arange(_OUTER).repeat(_NODES)
    inner = _OUTER + (outer + 1) // (_OUTER // _INNER) % _INNER
    steps = np.array([0.25, 0.25, 0.75, 0.75]) + 0.25 / 3**0.5 * np.array([-1, 1, -1, 1])
    area = np.sum(nodes**2, axis=2)
    # By distribution: shares, points (n, P, 2), their loads (n, P) and cells (n or 1, P).
    parts = [
        (
            np.maximum(1 - kind, 0),
            np.concatenate([s * nodes for s in steps], axis=1),
            np.concatenate([s * area for s in steps], axis=1),
            np.concatenate([inner, inner, outer, outer])[None],
        ),
        (
            1 - abs(kind - 1),
            (ends[:, 1:] + ends[:, :-1]) / 2,
            np.linalg.norm(np.diff(ends, axis=1), axis=2),
            outer[None],
        ),
    ]
    if not is_round:
        angle = np.arctan2(vertices[..., 1], vertices[..., 0]) / (2 * np.pi)
        cell = np.floor(_OUTER * angle + 0.5).astype(int) % _OUTER
        real = distinct(vertices).astype(float)
        parts.append((np.maximum(kind - 1, 0), vertices, real, cell))
    moments = np.zeros((len(kind), PADS, 4))
    for share, points, load, cell in parts:
        load = load * (share / load.sum(axis=1))[:, None]
        columns = np.stack([np.ones(load.shape), *points.T.swapaxes(1, 2), (points**2).sum(2)], 2)
        is_in = (cell[..., None] == np.arange(PADS)).astype(float)
        moments += is_in.swapaxes(1, 2) @ (load[..., None] * columns)
    mass = moments[..., :1]
    mean = moments[..., 1:] / np.where(mass > 0, mass, 1)
    spread = np.maximum(mean[..., 2] - np.sum(mean[..., :2] ** 2, axis=2), 0)
    pads = np.stack([np.ones(spread.shape), _PAD * np.sqrt(spread)], axis=2)
    feet = np.concatenate([mean[..., :2], LOAD * mass], axis=2)
    return solid._replace(vertices=vertices, feet=feet, pads=pads)


def unit(angle: np.ndarray) -> np.ndarray:
    """Return the unit vectors (..., 2) in the directions `angle` (...) [rad]."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def wrap(angle: np.ndarray) -> np.ndarray:
    """Return angles in [-pi, pi) [rad]."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def quaternion(yaw: ArrayLike) -> np.ndarray:
    """Return the quaternions (..., 4), scalar first, of turns by `yaw` (...) [rad]."""
    half = np.asarray(yaw) / 2
    return np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)


def padded(vertices: np.ndarray) -> np.ndarray:
    """Return outlines (..., N, 2) [m] with SIDES corners, the last repeated; circles unchanged."""
    if vertices.shape[-2] == 1:
        return vertices
    missing = SIDES - vertices.shape[-2]
    return np.concatenate([vertices, np.repeat(vertices[..., -1:, :], missing, axis=-2)], axis=-2)


def distinct(vertices: np.ndarray) -> np.ndarray:
    """Return which corners (..., N) of outlines (..., N, 2) do not repeat the one before."""
    return np.any(vertices != np.roll(vertices, 1, axis=-2), axis=-1)


def rectangles(half_x: np.ndarray, half_y: np.ndarray) -> np.ndarray:
    """Return outlines (n, 4, 2) [m] of boxes, in the order of `footprint.rectangle`."""
    return CORNERS * np.stack([half_x, half_y], axis=-1)[:, None, :]


def centred(vertices: np.ndarray) -> np.ndarray:
    """Return polygons (n, N, 2) [m] moved so that their centroids are at the origin."""
    cross, ahead = _triangles(vertices)
    area = cross.sum(axis=1) / 2
    third = (vertices + ahead) * cross[..., None] / 6
    return vertices - (third.sum(axis=1) / area[:, None])[:, None, :]


def reach(vertices: np.ndarray, radius: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the distance (n,) [m] from the origin to the outline in the directions (n, 2)."""
    if vertices.shape[1] == 1:
        return radius
    edge = np.roll(vertices, -1, axis=1) - vertices
    outward = np.stack([edge[..., 1], -edge[..., 0]], axis=-1)
    away = np.sum(outward * vertices, axis=-1)
    pace = np.sum(outward * direction[:, None, :], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(pace > 1e-12, away / pace, np.inf)
    return distance.min(axis=1)


def area(solid: Solid) -> np.ndarray:
    """Return the areas (n,) [m^2] of the outlines."""
    if solid.vertices.shape[1] == 1:
        return np.pi * solid.radius**2
    return _triangles(solid.vertices)[0].sum(axis=1) / 2


def corners(solid: Solid) -> np.ndarray:
    """Count the corners (n,) of the outlines, repeated ones once; 0 for a cylinder."""
    if solid.vertices.shape[1] == 1:
        return np.zeros(solid.mass.size)
    return distinct(solid.vertices).sum(axis=1).astype(float)


def extent(solid: Solid, yaw: np.ndarray) -> np.ndarray:
    """Return the reach (n,) [m] towards -x of solids turned by `yaw` (n,) [rad]."""
    return solid.radius - rotate(yaw[:, None], solid.vertices)[..., 0].min(axis=1)


def rotate(yaw: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Turn the first two entries of vectors (..., k) by yaw (...) [rad]: see `planar.rotate`."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y = c * vector[..., 0] - s * vector[..., 1], s * vector[..., 0] + c * vector[..., 1]
    return np.stack([x, y, *np.moveaxis(vector[..., 2:], -1, 0)], axis=-1)


def axes(solid: Solid) -> np.ndarray:
    """Return rotation matrices (n, 3, 3) from principal axes to the object's frame."""
    return np.moveaxis(np.array(vectors.matrix(list(solid.q_object_body.T))), -1, 0)


def friction_arm(solid: Solid) -> np.ndarray:
    """Return arms m_max / f_max (n,) [m] of the ground's friction about the centres of mass.

    The arm is the mean distance of the load from its centre. Equal springs that only push bear the
    load, under the points on which engines stand solids: the corners of a prism, or three points
    of a cylinder's rim, the first in the direction of the centre of mass.
    """
    at, share = support(solid)
    return mean_arm(at - solid.p_object_com[:, None, :2], share)


def mean_arm(at: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the mean distance (n,) [m] of the load from its centre: see `supported_load`."""
    load = supported_load(at, weight, np.zeros((len(at), 2)))
    return np.sum(load * np.linalg.norm(at, axis=-1), axis=1)


def supported_load(at: np.ndarray, weight: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return loads (n, S) [1] of springs at (n, S, 2) [m] that only push.

    Springs of stiffness `weight` (n, S) share the load, whose sum is 1 and whose centre is at (n,
    2) [m]. If this is impossible, as for an object that tips over, their centre is the nearest
    possible one in the least-squares sense.
    """
    scale = np.maximum(np.abs(at).max(axis=(1, 2), keepdims=True), 1e-9)
    rows = np.concatenate([np.ones((*weight.shape, 1)), at / scale], axis=-1)
    required = np.concatenate([np.ones((len(at), 1, 1)), centre[:, None] / scale], axis=-1)
    bears, load = weight > 0, weight
    for _ in range(at.shape[1]):
        weighted = rows * (weight * bears)[..., None]
        # Pressure is linear in position.
        inverse = np.linalg.pinv(weighted.swapaxes(1, 2) @ rows, rcond=1e-9)
        load = (weighted @ inverse @ required.swapaxes(1, 2))[..., 0]
        if not np.any(load < 0):
            break
        bears &= load >= 0
    load = np.maximum(load, 0)
    return load / load.sum(axis=1, keepdims=True)


def support(solid: Solid) -> tuple[np.ndarray, np.ndarray]:
    """Return the support points (..., N, 2) [m] of solids, and the weight (..., N) of each.

    The solids (...) may be a single one, unless it is a cylinder without feet.
    """
    if solid.feet is not None:
        return solid.feet[..., :2], solid.feet[..., 2]
    at = solid.vertices
    if at.shape[-2] > 1:
        return at, distinct(at).astype(float)
    x, y, _ = solid.p_object_com.T
    lean = np.arctan2(y, x)[:, None] + np.array([0, 2, 4]) * np.pi / 3
    rim = solid.radius[:, None, None] * unit(lean)
    return rim, np.ones(lean.shape)


def check_feet(name: str, feet: ArrayLike, com: np.ndarray, at_most: int = 10_000) -> np.ndarray:
    """Return feet (S, 5) [m, m, 1, 1, m]: x, y, weight, factor of friction and radius of a pad.

    By default weight and factor are 1, and the radius is 0. The centre of mass is at `com` (2,)
    [m]. Of pads with a radius, up to 16 are allowed.

    Raises:
      InputError: there are too few or too many, a weight or a factor is not positive, or the object
        tips over.
    """
    points = errors.check_array(name, feet, *(("S", columns) for columns in range(2, 6)))
    at_most = max(at_most, PADS) if points.shape[1] == 5 else at_most
    refuse = partial(errors.not_allowed, name, points.tolist())
    if not 3 <= len(points) <= at_most:
        rule = "x, y [m] and, if you like, a weight and a factor of friction"
        raise refuse(f"give 3 to {at_most} rows of {rule}")
    defaults = np.tile([0.0, 0.0, 1.0, 1.0, 0.0], (len(points), 1))
    points = np.column_stack([points, defaults[:, points.shape[1] :]])
    if (points[:, 2:4] <= 0).any() or (points[:, 4] < 0).any():
        raise refuse("weights and factors of friction must be positive, and radii at least 0")
    in_line = np.linalg.matrix_rank(points[:, :2] - com) < 2
    if in_line or not np.all(encloses(points[:, :2], com)):
        raise refuse("the centre of mass must be between them, or it tips over")
    return points


def encloses(points: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return whether the hull of points (S, 2) encloses each of other points (..., 2)."""
    axes = unit(np.linspace(0, 2 * np.pi, 360)).T
    return ((points @ axes).max(axis=0) > at @ axes).all(axis=-1)


def standing(solid: Solid) -> Solid:
    """Return solids with explicit feet: without any, at their corners, or SIDES on a rim."""
    if solid.feet is not None:
        return solid
    solid = solid._replace(vertices=padded(solid.vertices))
    at, share = support(solid)
    if solid.vertices.shape[-2] == 1:
        rim = solid.radius[..., None] * np.exp(2j * np.pi * np.arange(SIDES) / SIDES)
        at, share = np.stack([rim.real, rim.imag], axis=-1), np.ones(rim.shape)
    return solid._replace(feet=np.concatenate([at, share[..., None]], axis=-1))


def stack(solids: Sequence[Solid], support: Support = "corners") -> Solid:
    """Return single solids of one shape family as solids (n, ...), with a support without feet.

    If one has feet, the feet of a prism without any are its corners.
    """
    rows = [jax.tree.map(lambda leaf: np.asarray(leaf, float)[None], row) for row in solids]
    if support != "corners":
        kind = np.full(1, SUPPORTS[support])
        rows = [on_support(row, kind) if row.feet is None else row for row in rows]
    if any(row.feet is not None for row in rows):
        rows = [standing(row) for row in rows]
    if any(row.pads is not None for row in rows):
        count = max(len(row.feet[0]) for row in rows if row.feet is not None)
        rows = [_with_pads(row, count) for row in rows]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *rows)


def _with_pads(solid: Solid, count: int) -> Solid:
    """Return solids with pads and this number of feet; the added ones are unused."""
    assert solid.feet is not None
    pads = solid.pads if solid.pads is not None else solid.feet[..., :2] * 0 + [1, 0]
    missing = (0, 0), (0, count - pads.shape[1]), (0, 0)
    return solid._replace(feet=np.pad(solid.feet, missing), pads=np.pad(pads, missing))


def _triangles(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return cross products (n, N) [m^2] of consecutive vertices, and the next vertices."""
    ahead = np.roll(vertices, -1, axis=1)
    return vertices[..., 0] * ahead[..., 1] - vertices[..., 1] * ahead[..., 0], ahead


def _moments(vertices: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean of x^2, y^2 and x y [m^2] over outlines centred at the origin."""
    if vertices.shape[1] == 1:
        quarter = radius**2 / 4
        return quarter, quarter, np.zeros_like(quarter)
    cross, ahead = _triangles(vertices)
    x, y, x2, y2 = vertices[..., 0], vertices[..., 1], ahead[..., 0], ahead[..., 1]
    area = cross.sum(axis=1) / 2
    xx = (cross * (x * x + x * x2 + x2 * x2)).sum(axis=1) / 12
    yy = (cross * (y * y + y * y2 + y2 * y2)).sum(axis=1) / 12
    xy = (cross * (x * y2 + 2 * x * y + 2 * x2 * y2 + x2 * y)).sum(axis=1) / 24
    return xx / area, yy / area, xy / area
