"""Colliders of MJX: of a plane and a cylinder, mended for float32; of a base and a prism.

MJX 3.17.0 finds the lowest point of the rim from `axis * (axis . n) - n`. Of a standing cylinder,
all but rounding cancels in that difference: a tilt of 1e-5 rad puts the contact points 12 mm off,
none at all up to 25 cm, and the cylinder gains energy. Here the direction comes from a cross
product, which is exact for any tilt.

The corners of a mesh are constants of a compiled program. Those of a prism are read from the feet
that it stands on, and so may differ from world to world.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.engines.fused.contacts import Corners, meetings
from rps_jax.geometry import vectors

with contextlib.redirect_stdout(io.StringIO()):  # MJX reports on the console that warp is absent
    from mujoco import mjx as mjx
    from mujoco.mjx._src import collision_driver, collision_primitive, math
    from mujoco.mjx._src.collision_types import Collision, GeomInfo
    from mujoco.mjx._src.types import Data, GeomType, Model

_UPRIGHT = 1e-6  # [rad] below this tilt every point of the rim is the lowest


@collision_primitive.collider(ncon=3)
def plane_cylinder(plane: GeomInfo, cylinder: GeomInfo) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Distances (3,), points (3, 3) and frames (3, 3, 3) [m] of a standing cylinder's contacts.

    The three points lie on the lower rim, a third of a turn apart, the first one lowest.
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


def box_prism(model: Model, data: Data, key: Any, geom: jax.Array) -> Collision:
    """Distances (4,), points (4, 3) and frames (4, 3, 3) [m] of a base and an upright prism.

    As in the fused engine: two points each at the lower and the upper edge. Any other mesh, one
    without feet, is left to MJX.
    """
    boxes, meshes, feet = (
        np.flatnonzero(model.geom_type == kind)
        for kind in (GeomType.BOX, GeomType.MESH, GeomType.SPHERE)
    )
    if (boxes.size, meshes.size) != (1, 1) or not feet.size:
        return _BOX_MESH(model, data, key, geom)
    return upright(model, data, boxes[0], meshes[0], model.geom_pos[feet])


def upright(model: Model, data: Data, base: int, thing: int, corners: jax.Array) -> Collision:
    """Distances (4,), points (4, 3) and frames (4, 3, 3) [m] of a box and an upright prism.

    `base` and `thing` are their geoms; `corners` (N, 3) [m] are the prism's feet, in its body.
    """
    body, half = model.geom_bodyid[thing], model.geom_size[base]
    lower = -jnp.abs(corners[:, 2])
    turn = data.geom_xmat[base][:2, 0]
    middle = data.geom_xpos[base]
    solid: Any = SimpleNamespace(
        vertices=Corners.of((corners[:, 0], corners[:, 1], lower)),
        height=-2 * lower[0],
        up=vectors.Z,
        base_half=half[:2],
        base_z=middle[2] + jnp.array([-1.0, 1.0]) * half[2],
    )
    state: Any = SimpleNamespace(base=middle, p=data.xpos[body])
    m: Any = [tuple(row) for row in data.xmat[body]]
    z, normal, point, distance = meetings(solid, state, m, (turn[0], turn[1]))
    back = jnp.array([[turn[0], turn[1]], [-turn[1], turn[0]]])
    n = jnp.stack(normal) @ back
    place = middle[:2] + jnp.stack(point, axis=-1) @ back
    zero, one = jnp.zeros_like(n[0]), jnp.ones_like(n[0])
    frame = jnp.stack([n[0], n[1], zero, -n[1], n[0], zero, zero, zero, one]).reshape(3, 3)
    return distance, jnp.concatenate([place, z[:, None]], axis=-1), jnp.stack([frame] * 4)


box_prism.ncon = 4  # pyright: ignore[reportFunctionMemberAccess]
_FUNCTIONS = collision_driver._COLLISION_FUNC
_BOX_MESH = _FUNCTIONS[GeomType.BOX, GeomType.MESH]


def register() -> None:
    """Have MJX use them; doing so twice does no harm."""
    for pair, function in _FUNCTIONS.items():
        if function is collision_primitive.plane_cylinder:
            _FUNCTIONS[pair] = plane_cylinder
    _FUNCTIONS[GeomType.BOX, GeomType.MESH] = box_prism


@contextlib.contextmanager
def box_as_prism(points: int) -> Iterator[None]:
    """While it lasts, MJX finds where a box meets the base as it does for a prism.

    `points` is 4, or 2 for the lower edge alone.
    """

    def collide(model: Model, data: Data, key: Any, geom: jax.Array) -> Collision:
        base, thing = map(int, np.flatnonzero(model.geom_type == GeomType.BOX))
        signs = np.array([[1, 1, -1], [-1, 1, -1], [-1, -1, -1], [1, -1, -1]])
        found = upright(model, data, base, thing, model.geom_size[thing] * signs)
        return tuple(x[:points] for x in found)  # pyright: ignore[reportReturnType]

    collide.ncon = points  # pyright: ignore[reportFunctionMemberAccess]
    pair = GeomType.BOX, GeomType.BOX
    usual = _FUNCTIONS[pair]
    _FUNCTIONS[pair] = collide
    try:
        yield
    finally:
        _FUNCTIONS[pair] = usual


register()
