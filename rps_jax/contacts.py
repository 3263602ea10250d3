"""Where the object of a scene touches: the ground with the corners of its lower face, the base
along two upright lines; and MuJoCo's soft constraint at each point. For `rps_jax.fused`.

Vectors are in the world's axes, points about the object's centre of mass unless said otherwise.
Reference: MuJoCo documentation, "Computation: Constraint model".
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rps_jax import spatial as sp
from rps_jax.physics import Physics
from rps_jax.spatial import Vec

_FAR = 1e9  # [m] of what can never touch
_PARALLEL = 1e-4  # [m] by which a face of the base is preferred to one of the object
_UPRIGHT = 1e-6  # [rad] tilt below which every point of a cylinder's rim is the lowest
# MuJoCo's own impedance of the skin contact: least, greatest, and the depth [m] between them.
_D_MIN, _D_MAX, _WIDTH = 0.9, 0.95, 0.001


class Body(NamedTuple):
    """What one world is made of, as MuJoCo compiled it. Frame: principal axes at the centre of
    mass."""

    mass: Any  # () [kg]
    inertia: Any  # (3,) [kg m^2] principal moments
    p_object_com: Any  # (3,) [m] centre of mass in the object's frame
    q_object_body: Any  # (4,) principal axes in the object's frame
    vertices: Any  # (N, 3) [m] of the lower face; of a cylinder its centre
    radius: Any  # () [m] of a cylinder; 0 of a prism
    height: Any  # () [m]
    up: Any  # (3,) unit vector along the height
    friction_ground: Any  # () [1]
    friction_robot: Any  # () [1]
    invweight: Any  # () [1/kg] MuJoCo's weight of the object in a contact
    base_invweight: Any  # () [1/kg] and of the base
    base_half: Any  # (2,) [m] half length and width of the base
    base_z: Any  # (2,) [m] its lower and upper edge


class State(NamedTuple):
    """A world in motion."""

    base: Vec  # x, y [m], yaw [rad]
    p: Vec  # [m] centre of mass
    q: tuple[Any, Any, Any, Any]  # principal axes in the world, scalar first
    v: Vec  # [m/s] of the centre of mass
    w: Vec  # [rad/s] in principal axes
    a: Vec  # [m/s^2] last acceleration, from which the solver starts
    alpha: Vec  # [rad/s^2]


class Contact(NamedTuple):
    """One point of contact. Its rows are J a - a_ref along n, t and s."""

    r: Vec  # [m] from the centre of mass
    n: Vec  # unit normal, towards the object
    t: Vec  # unit tangents
    s: Vec
    bias: Vec  # [m/s^2] -a_ref
    d: Any  # [kg] stiffness of the normal row, 0 without contact
    friction: Any  # [1]


def _stiff(distance: Any, there: Any, impedance: Any, invweight: Any) -> Any:
    """Stiffness [kg] of a contact's normal row; 0 if nothing touches."""
    return jnp.where(there & (distance < 0), impedance / (invweight * (1 - impedance)), 0.0)


def _bias(k: Any, b: Any, impedance: Any, distance: Any, u: Vec) -> Vec:
    """Minus the reference acceleration of a point of velocity u, along (n, t, s)."""
    return b * u[0] + k * impedance * distance, b * u[1], b * u[2]


def _stiffness(solref: tuple[float, float], d_max: float, timestep: float) -> tuple[float, float]:
    """MuJoCo's stiffness [1/s^2] and damping [1/s] of a contact."""
    time, ratio = max(solref[0], 2 * timestep), solref[1]
    return 1 / (d_max * time * ratio) ** 2, 2 / (d_max * time)


def on_ground(body: Body, state: State, m: Sequence[Vec], physics: Physics) -> list[Contact]:
    """Contacts of the lower face with the ground."""
    k, b = _stiffness(physics.ground_solref, physics.ground_impedance, physics.timestep)
    w = sp.to_world(m, state.w)
    contacts = []
    for r, there in _lower_face(body, m):
        distance = state.p[2] + r[2]
        at = (r[0], r[1], r[2] - 0.5 * distance)
        u = sp.add(state.v, sp.cross(w, at))
        d = _stiff(distance, there, physics.ground_impedance, body.invweight)
        bias = _bias(k, b, physics.ground_impedance, distance, (u[2], u[0], u[1]))
        contacts.append(Contact(at, sp.Z, sp.X, sp.Y, bias, d, body.friction_ground))
    return contacts


def _lower_face(body: Body, m: Sequence[Vec]) -> list[tuple[Vec, Any]]:
    """Points that may touch the ground, from the centre of mass, and whether they exist."""
    corners = [sp.to_world(m, v) for v in body.vertices]
    if len(corners) == 1:  # of a cylinder three points of the rim, the first the lowest
        up = sp.to_world(m, body.up)
        tilt = jnp.sqrt(up[0] * up[0] + up[1] * up[1])
        standing = tilt < _UPRIGHT
        least = jnp.maximum(tilt, _UPRIGHT)
        # Horizontal direction in which it leans; of a standing one, fixed to the object.
        lean = [jnp.where(standing, m[i][0], up[i] / least) for i in range(2)]
        across = (-lean[1], lean[0], 0.0)
        low = sp.cross(across, up)
        low = sp.scale(body.radius / sp.norm(low), low)
        side = sp.scale(body.radius * 0.75**0.5, across)
        rim = [low, sp.sub(side, sp.scale(0.5, low)), sp.sub(sp.scale(-0.5, low), side)]
        return [(sp.add(corners[0], point), True) for point in rim]
    points = []
    for i, corner in enumerate(corners):
        edge = sp.sub(corners[i - 1], corner)
        points.append((corner, sp.dot(edge, edge) > 1e-12))  # polygons are padded by repetition
    return points


def on_base(
    body: Body, state: State, m: Sequence[Vec], twist: Vec, physics: Physics
) -> list[Contact]:
    """Contacts of the object's side with the base, at the upper and lower edge of both."""
    k, b = _stiffness(physics.base_solref, _D_MAX, physics.timestep)
    c, s = jnp.cos(state.base[2]), jnp.sin(state.base[2])
    w = sp.to_world(m, state.w)
    contacts = []
    for z, normal, q, distance in meetings(body, state, m, (c, s)):
        n = (c * normal[0] - s * normal[1], s * normal[0] + c * normal[1], 0.0)
        t = (-n[1], n[0], 0.0)
        arm = (c * q[0] - s * q[1], s * q[0] + c * q[1])  # from the base's origin
        lever = (state.base[0] + arm[0] - state.p[0], state.base[1] + arm[1] - state.p[1])
        r = (*lever, z - state.p[2])
        of_base = (
            c * twist[0] - s * twist[1] - twist[2] * arm[1],
            s * twist[0] + c * twist[1] + twist[2] * arm[0],
            0.0,
        )
        u = sp.sub(sp.add(state.v, sp.cross(w, r)), of_base)
        x = jnp.minimum(jnp.abs(distance) / _WIDTH, 1.0)
        x = jnp.where(x < 0.5, 2 * x * x, 1 - 2 * (1 - x) * (1 - x))
        impedance = _D_MIN + x * (_D_MAX - _D_MIN)
        d = _stiff(distance, True, impedance, body.invweight + body.base_invweight)
        bias = _bias(k, b, impedance, distance, (sp.dot(n, u), sp.dot(t, u), u[2]))
        contacts.append(Contact(r, n, t, sp.Z, bias, d, body.friction_robot))
    return contacts


Point = tuple[Any, Any]


def meetings(
    body: Body, state: State, m: Sequence[Vec], turn: Point
) -> list[tuple[Any, Point, Point, Any]]:
    """Height, normal, point and distance [m] of each contact, in the base's frame."""
    c, s = turn
    up = sp.to_world(m, body.up)
    slope = (up[0] / up[2], up[1] / up[2])
    slope = (c * slope[0] + s * slope[1], -s * slope[0] + c * slope[1])
    low, high = body.base_z[0], jnp.minimum(body.base_z[1], 0.98 * body.height)
    foot = []  # vertices of the lower face, with z
    for vertex in body.vertices:
        x, y, z = sp.sub(sp.add(sp.to_world(m, vertex), state.p), (*state.base[:2], 0.0))
        foot.append((c * x + s * y, -s * x + c * y, z))

    def outline(z: Any) -> list[Point]:
        return [(x + slope[0] * (z - h), y + slope[1] * (z - h)) for x, y, h in foot]

    if len(foot) == 1:
        return [
            (z, *_circle_and_rectangle(outline(z)[0], body.radius, body.base_half))
            for z in (low, high)
        ]
    middle = 0.5 * (low + high)
    normal, found = _polygon_and_rectangle(outline(middle), body.base_half)
    lean = sp.dot(slope, normal)
    return [
        (z, normal, point, distance + lean * (z - middle))
        for z in (low, high)
        for point, distance in found
    ]


def _circle_and_rectangle(
    centre: Point, radius: Any, half: Sequence[Any]
) -> tuple[Point, Point, Any]:
    """Normal, point and distance [m] of a circle outside a centred rectangle."""
    nearest = tuple(jnp.clip(x, -h, h) for x, h in zip(centre, half, strict=True))
    apart = (centre[0] - nearest[0], centre[1] - nearest[1])
    gap = sp.norm(apart)
    outside = gap > 1e-6
    normal = (jnp.where(outside, apart[0] / gap, 1.0), jnp.where(outside, apart[1] / gap, 0.0))
    distance = jnp.where(outside, gap, centre[0] - half[0]) - radius
    point = (nearest[0] + 0.5 * distance * normal[0], nearest[1] + 0.5 * distance * normal[1])
    return normal, point, distance


def _polygon_and_rectangle(
    outline: list[Point], half: Sequence[Any]
) -> tuple[Point, list[tuple[Point, Any]]]:
    """Normal from a centred rectangle to a convex polygon, and two points with distances [m].

    The face that separates them best is the reference; the face of the other that looks most
    against it is clipped to its width (as in MuJoCo's box-box collider).
    """
    a, b = half
    count = len(outline)
    xs, ys = [p[0] for p in outline], [p[1] for p in outline]
    least, most = (lambda v: reduce(jnp.minimum, v)), (lambda v: reduce(jnp.maximum, v))
    one, nil = jnp.ones_like(xs[0]), jnp.zeros_like(xs[0])
    # Reference faces: separation, normal out of its owner, a point on it, along it, its length.
    faces = [
        (least(xs) - a, (one, nil), (a, -b), (nil, one), 2 * b),
        (-most(xs) - a, (-one, nil), (-a, b), (nil, -one), 2 * b),
        (least(ys) - b, (nil, one), (a, b), (-one, nil), 2 * a),
        (-most(ys) - b, (nil, -one), (-a, -b), (one, nil), 2 * a),
    ]
    own = []
    for i in range(count):
        (x, y), (x2, y2) = outline[i], outline[(i + 1) % count]
        length = sp.norm((x2 - x, y2 - y))
        along = ((x2 - x) / length, (y2 - y) / length)
        n = (along[1], -along[0])
        apart = -(x * n[0] + y * n[1]) - (a * jnp.abs(n[0]) + b * jnp.abs(n[1]))
        real = length > 1e-6
        own.append((jnp.where(real, apart, -_FAR), n, (x, y), along, length, real))

    def best(rows: list[Any], score: list[Any]) -> Any:
        top, chosen = score[0], rows[0]
        for row, value in zip(rows[1:], score[1:], strict=True):
            better = value > top
            top = jnp.where(better, value, top)
            chosen = jax.tree.map(lambda new, old, w=better: jnp.where(w, new, old), row, chosen)
        return chosen

    of_base, of_object = best(faces, [f[0] for f in faces]), best(own, [f[0] for f in own])[:5]
    by_base = of_base[0] + _PARALLEL > of_object[0]
    _, n, start, along, length = jax.tree.map(
        lambda x, y: jnp.where(by_base, x, y), of_base, of_object
    )
    against = [-sp.dot(f[1], n) for f in faces]
    base_edge = best(faces, against)
    against = [jnp.where(f[5], -sp.dot(f[1], n), -_FAR) for f in own]
    object_edge = best(own, against)[:5]
    _, _, p, edge, extent = jax.tree.map(
        lambda x, y: jnp.where(by_base, x, y), object_edge, base_edge
    )
    # Clip the incident edge p + x edge, x in [0, extent], to [0, length] of the reference face.
    offset = (p[0] - start[0]) * along[0] + (p[1] - start[1]) * along[1]
    pace = sp.dot(edge, along)  # near -1
    pace = jnp.where(jnp.abs(pace) < 1e-3, -1e-3, pace)
    ends = [-offset / pace, (length - offset) / pace]
    low = jnp.clip(jnp.minimum(*ends), 0.0, extent)
    high = jnp.clip(jnp.maximum(*ends), 0.0, extent)
    normal = (jnp.where(by_base, n[0], -n[0]), jnp.where(by_base, n[1], -n[1]))
    found = []
    for x in (low, high):
        q = (p[0] + x * edge[0], p[1] + x * edge[1])
        distance = (q[0] - start[0]) * n[0] + (q[1] - start[1]) * n[1]
        middle = (q[0] - 0.5 * distance * n[0], q[1] - 0.5 * distance * n[1])
        found.append((middle, distance))
    return normal, found
