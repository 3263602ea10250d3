"""Colliders for our models in MJX: of a plane and a cylinder, of a base and a box or a prism.

MJX 3.17.0 finds the lowest point of the rim from `axis * (axis . n) - n`. Of a standing cylinder,
all but rounding cancels in that difference: a tilt of 1e-5 rad puts the contact points 12 mm off,
none at all up to 25 cm, and the cylinder gains energy. Here the direction comes from a cross
product, which is exact for any tilt.

The corners of a mesh are constants of a compiled program. Those of a prism are read from the feet
that it stands on, or from an outline beside them, and so may differ from world to world. A box is
found in the same way, with four points as in the fused engine: MJX's own box collider finds the
same ones more slowly.

MJX's table of colliders is read and never written: other models in the process are not concerned.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping
from types import MappingProxyType, SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.engines.fused.contacts import Corners, meetings
from rps_jax.geometry import vectors

with contextlib.redirect_stdout(io.StringIO()):  # MJX reports on the console that warp is absent
    from mujoco import mjx as mjx
    from mujoco.mjx._src import collision_driver, collision_primitive, math
    from mujoco.mjx._src import constraint as constraint
    from mujoco.mjx._src import forward as forward
    from mujoco.mjx._src import smooth as smooth
    from mujoco.mjx._src import solver as solver
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


def _box_box(model: Model, data: Data, *_: Any) -> Collision:
    """Distances (4,), points (4, 3) and frames (4, 3, 3) [m] of a base and an upright box."""
    base, thing = map(int, np.flatnonzero(model.geom_type == GeomType.BOX))
    signs = np.array([[1, 1, -1], [-1, 1, -1], [-1, -1, -1], [1, -1, -1]])
    return upright(model, data, base, thing, model.geom_size[thing] * signs)


def _box_prism(model: Model, data: Data, key: Any, geom: Any, outline: Any = None) -> Collision:
    """Distances (4,), points (4, 3) and frames (4, 3, 3) [m] of a base and an upright prism."""
    base, thing, feet = (
        np.flatnonzero(model.geom_type == kind)
        for kind in (GeomType.BOX, GeomType.MESH, GeomType.SPHERE)
    )
    corners = model.geom_pos[feet]
    if outline is not None:
        corners = jnp.concatenate([outline, corners[:, 2:]], axis=1)
    return upright(model, data, base[0], thing[0], corners)


def upright(model: Model, data: Data, base: int, thing: int, corners: jax.Array) -> Collision:
    """Distances (4,), points (4, 3) and frames (4, 3, 3) [m] of a box and an upright prism.

    `base` and `thing` are their geoms; `corners` (N, 3) [m] are the prism's, in its body.
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


Pair = tuple[GeomType, GeomType]
# Each has as many points as MJX's own collider of the pair, for which a `Data` has room.
BASE_PRISM = (GeomType.BOX, GeomType.MESH)
OWN: dict[Pair, Any] = {
    (GeomType.PLANE, GeomType.CYLINDER): plane_cylinder,
    (GeomType.BOX, GeomType.BOX): _box_box,
    BASE_PRISM: _box_prism,
}


def collision(model: Model, data: Data, own: Mapping[Pair, Any] = MappingProxyType(OWN)) -> Data:
    """The contacts of a world as `mjx.collision` has them, by our colliders where there are any."""
    contacts = []
    for key, contact in collision_driver._contact_groups(model, data).items():
        pair: Any = key.types
        usual = collision_driver._COLLISION_FUNC[pair]
        distance, point, frame = own.get(pair, usual)(model, data, key, contact.geom)
        count = usual.ncon
        contact = jax.tree.map(lambda x, n=count: jnp.repeat(x, n, axis=0), contact)
        contacts.append(contact.replace(dist=distance, pos=point, frame=frame))
    whole = jax.tree.map(lambda *x: jnp.concatenate(x), *contacts)
    return data.tree_replace({"_impl.contact": whole})  # pyright: ignore[reportReturnType]
