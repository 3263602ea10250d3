"""Colliders for MJX: plane and cylinder; base or wall, and box or prism.

MJX 3.17.0 computes the lowest point of the rim from `axis * (axis . n) - n`. For an upright
cylinder this difference is rounding error: a tilt of 1e-5 rad shifts the contact points by 12 mm,
no tilt by up to 25 cm, and the cylinder gains energy. Here the direction is a cross product, which
is exact for any tilt.

The corners of a mesh are constants of a compiled program. The corners of a prism are read from its
feet, or from an outline, and so may differ between worlds. A box has the same collider, with four
points as in the fused engine: MJX's box collider finds the same points more slowly.

MJX's table of colliders is only read, so that other models in the process are unaffected.
"""

from __future__ import annotations

import contextlib
import io
from functools import partial
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.engines.fused.contacts import Corners, side_contacts
from rps_jax.geometry import vectors
from rps_jax.geometry.arrays import Array, Entries, Pytree
from rps_jax.geometry.footprint import CORNERS
from rps_jax.world import opengl as opengl  # imports MuJoCo

with contextlib.redirect_stdout(io.StringIO()):  # MJX reports on the console that warp is absent
    from mujoco import mjx as mjx
    from mujoco.mjx._src import collision_driver, collision_primitive
    from mujoco.mjx._src import constraint as constraint
    from mujoco.mjx._src import forward as forward
    from mujoco.mjx._src import math as math
    from mujoco.mjx._src import sensor as sensor
    from mujoco.mjx._src import smooth as smooth
    from mujoco.mjx._src import solver as solver
    from mujoco.mjx._src import types as types
    from mujoco.mjx._src.collision_types import Collision, GeomInfo
    from mujoco.mjx._src.types import Data, GeomType, Model

_BASE, _OBJECT = 1, 2  # bodies of the stripped models
_UPRIGHT = 1e-6  # [rad] tilt below which all points of the rim are equally low


@collision_primitive.collider(ncon=3)
def plane_cylinder(plane: GeomInfo, cylinder: GeomInfo) -> tuple[Array, Array, Array]:
    """Return distances (3,), points (3, 3) and frames (3, 3, 3) [m] of an upright cylinder.

    The three points are on the lower rim, a third of a turn apart, the lowest first.
    """
    n, axis = plane.mat[:, 2], cylinder.mat[:, 2]
    axis = -jnp.where(jnp.dot(n, axis) < 0, -1.0, 1.0) * axis  # towards the plane
    radius, half_height = cylinder.size[0], cylinder.size[1]
    across = jnp.cross(n, axis)
    tilt = math.norm(across)
    across = jnp.where(tilt < _UPRIGHT, cylinder.mat[:, 1], across / jnp.maximum(tilt, _UPRIGHT))
    lowest = math.normalize(jnp.cross(across, axis)) * radius
    lowest = jnp.where(jnp.dot(lowest, n) > 0, -lowest, lowest)
    sideways = math.normalize(jnp.cross(lowest, axis)) * radius * (0.5 * jnp.sqrt(3.0))
    rim = jnp.stack([lowest, sideways - 0.5 * lowest, -sideways - 0.5 * lowest])
    points = cylinder.pos + half_height * axis + rim
    distance = (points - plane.pos) @ n
    frames = jnp.stack([math.make_frame(n)] * 3)
    return distance, points - 0.5 * distance[:, None] * n, frames


def geoms(model: Model, body: int, kind: GeomType) -> np.ndarray:
    """Return the geoms of a kind of a body."""
    return np.flatnonzero((model.geom_bodyid == body) & (model.geom_type == kind))


def corners_of(model: Model, outline: Array | None = None) -> Array:
    """Return the corners (N, 3) [m] of box or prism in its body, or the middle of a cylinder."""
    boxes = geoms(model, _OBJECT, GeomType.BOX)
    if boxes.size:
        return model.geom_size[boxes[0]] * np.insert(CORNERS, 2, -1.0, axis=1)
    if not geoms(model, _OBJECT, GeomType.MESH).size:
        return jnp.zeros((1, 3))
    corners = model.geom_pos[geoms(model, _OBJECT, GeomType.SPHERE)]
    if outline is not None:
        corners = jnp.concatenate([outline, corners[: len(outline), 2:]], axis=1)
    return corners


def _with_upright(
    model: Model, data: Data, key: Any, geom: object, outline: Array | None = None
) -> Collision:
    """Return distances (C,), points (C, 3) and frames (C, 3, 3) [m] of an upright box or prism."""
    pairs = collision_driver._geom_groups(model)[key]
    if key.types[0] == GeomType.SPHERE:  # two of one round base
        pairs = pairs[:1]
    corners = corners_of(model, outline)
    contacts = [upright(model, data, base, prism, corners) for base, prism, _ in pairs]
    return jax.tree.map(lambda *x: jnp.concatenate(x), *contacts)


def upright(model: Model, data: Data, base: int, prism: int, corners: Array) -> Collision:
    """Return distances (C,), points (C, 3) and frames (C, 3, 3) [m] of base and upright prism.

    `base` and `prism` are geoms; `corners` (N, 3) [m] are those of the prism in its body. The base
    is a box or a wall, with four points, or the two spheres of a round base.
    """
    body, half = model.geom_bodyid[prism], model.geom_size[base]
    is_round = model.geom_type[base] == GeomType.SPHERE
    lower = -jnp.abs(corners[:, 2])
    turn = data.geom_xmat[base][:2, 0]
    middle = data.geom_xpos[base]
    solid: Any = SimpleNamespace(
        vertices=Corners.of((corners[:, 0], corners[:, 1], lower)),
        height=-2 * lower[0],
        up=vectors.Z,
        base_size=half[:1] if is_round else half[:2],
        base_z=data.geom_xpos[geoms(model, _BASE, GeomType.SPHERE), 2]
        if is_round
        else jnp.maximum(middle[2] + jnp.array([-1.0, 1.0]) * half[2], 0.0),
    )
    state: Any = SimpleNamespace(base=middle, p=data.xpos[body])
    m: Entries = [tuple(row) for row in data.xmat[body]]
    contacts: Pytree = side_contacts(solid, state, m, (turn[0], turn[1]))
    z, normal, point, distance = contacts
    back = jnp.array([[turn[0], turn[1]], [-turn[1], turn[0]]])
    n = jnp.stack(normal) @ back
    position = middle[:2] + jnp.stack(point, axis=-1) @ back
    zero, unit = jnp.zeros_like(n[0]), jnp.ones_like(n[0])
    frame = jnp.stack([n[0], n[1], zero, -n[1], n[0], zero, zero, zero, unit]).reshape(3, 3)
    points = jnp.concatenate([position, z[:, None]], axis=-1)
    return distance, points, jnp.stack([frame] * len(distance))


Extra = Array | None  # numbers of a world that a model lacks
Pair = tuple[GeomType, GeomType]
# Each has the number of points of MJX's collider of the pair, for which `Data` has space.
COLLIDERS: dict[Pair, Any] = {
    (GeomType.PLANE, GeomType.CYLINDER): plane_cylinder,
    (GeomType.BOX, GeomType.BOX): _with_upright,
    (GeomType.BOX, GeomType.MESH): _with_upright,
    (GeomType.SPHERE, GeomType.BOX): _with_upright,
    (GeomType.SPHERE, GeomType.MESH): _with_upright,
}


def collision(model: Model, data: Data, outline: Extra = None, boundary: Extra = None) -> Data:
    """Compute the contacts of a world as `mjx.collision` does, with our colliders first.

    The `outline` (N, 2) [m] is that of a prism; by default it has that of its feet. A `boundary`
    (4,) of the floor, as of `Surroundings`, changes the friction of contacts beyond it.
    """
    contacts = []
    for key, contact in collision_driver._contact_groups(model, data).items():
        pair: Any = key.types
        default = collision_driver._COLLISION_FUNC[pair]
        collide = COLLIDERS.get(pair, default)
        if collide is _with_upright:
            collide = partial(_with_upright, outline=outline)
        distance, point, frame = collide(model, data, key, contact.geom)
        count = default.ncon
        contact = jax.tree.map(lambda x, n=count: jnp.repeat(x, n, axis=0), contact)
        if boundary is not None and pair[0] == GeomType.PLANE:
            beyond = (point[..., :2] @ boundary[:2] > boundary[2]).reshape(-1, 1)
            slide = contact.friction.at[:, :3].multiply(jnp.where(beyond, boundary[3], 1.0))
            contact = contact.replace(friction=slide)
        contacts.append(contact.replace(dist=distance, pos=point, frame=frame))
    whole = jax.tree.map(lambda *x: jnp.concatenate(x), *contacts)
    return data.tree_replace({"_impl.contact": whole})  # pyright: ignore[reportReturnType]
