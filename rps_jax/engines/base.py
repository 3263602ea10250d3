"""What each engine steps: scenes as MuJoCo compiled them, or many solids at once.

An engine's stage is what all worlds of a batch share, its fields are what each has of its own,
rows of a pytree. C MuJoCo shares nothing: its stage is a list of models, its fields are empty.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Literal, get_args

import jax
import numpy as np

from rps_jax import errors
from rps_jax.engines import quasistatic, warp
from rps_jax.engines.fused import step as fused
from rps_jax.engines.fused.contacts import Body
from rps_jax.engines.quasistatic import Quasistatic
from rps_jax.engines.warp import Warp
from rps_jax.geometry import solid
from rps_jax.geometry.solid import Solid
from rps_jax.trials.trial import Fused, Stage
from rps_jax.world import scene
from rps_jax.world.physics import Physics
from rps_jax.world.scene import JOINTS, OFF_CENTRE, Friction, Scene, mjx

Engine = Literal["mjx", "fused", "warp", "mujoco", "quasistatic"]
ENGINES = get_args(Engine)


def check(engine: str, families: Iterable[str] = ()) -> None:
    """Raises InputError unless an engine can step worlds of these families on this machine."""
    errors.check_name("engine", engine, ENGINES)
    if engine == "warp":
        warp.check(families)


def works(engine: str, families: Iterable[str] = ()) -> bool:
    """Whether `check` has nothing against it."""
    try:
        check(engine, families)
    except errors.InputError:
        return False
    return True


def stage_of_scenes(scenes: Sequence[Scene], engine: Engine) -> tuple[Any, Any]:
    """Stage, and fields (len(scenes), ...), of scenes of one shape family.

    Raises:
      InputError: the engine cannot step them on this machine.
    """
    check(engine, [s.family for s in scenes])
    if engine == "mujoco":
        return [s.physics for s in scenes], {}
    if engine == "fused":
        bodies = [fused.body(s.physics, np.asarray(s.footprint.vertices)) for s in scenes]
        return Fused(), jax.tree.map(lambda *leaves: np.stack(leaves), *bodies)
    if engine == "quasistatic":
        solids = jax.tree.map(lambda *x: np.concatenate(x), *map(scene.solid_of, scenes))
        friction = np.array([s.physics.pair("base_object").friction[0] for s in scenes])
        half = np.array([s.physics.geom("base").size[:2] for s in scenes])
        return Quasistatic(), quasistatic.sliders(solids, friction, half)
    models = [s.physics for s in scenes]
    if engine == "warp":
        models = [warp.own_cylinder(model) for model in models]
        model, fields = scene.stack(models, warp.put)
        return Warp(model, warp.blank(models[0])), jax.device_get(fields)
    model, fields = scene.stack(models)
    return Stage(model, mjx.make_data(models[0])), jax.device_get(fields)


def stage_of_solids(
    family: str, solids: Solid, friction: Friction, engine: Engine, physics: Physics
) -> tuple[Any, Any]:
    """Stage, and fields (n, ...), of solids (n, ...) of a family, friction (n,) each.

    What MuJoCo would derive in compiling each of them is computed here, for all at once.

    Raises:
      InputError: the engine cannot step them on this machine.
    """
    check(engine, [family])
    count = solids.mass.size
    if engine == "mujoco":
        return [
            scene_of_solid(family, solids, friction, physics, i).physics for i in range(count)
        ], {}
    if engine == "fused":
        known = scene.load("box", physics)  # of which only the base matters
        one = fused.body(known.physics, np.asarray(known.footprint.vertices))
        return Fused(), bodies(solids, friction, one)
    template = scene_of_solid(family, solids, friction, physics, 0)
    if engine == "quasistatic":
        half = template.physics.geom("base").size[:2]
        return Quasistatic(), quasistatic.sliders(solids, friction.robot, half)
    stage, fields = stage_of_scenes([template], engine)
    return stage, mjx_fields(family, solids, friction, template, fields)


def scene_of_solid(
    family: str, solids: Solid, friction: Friction, physics: Physics, i: int
) -> Scene:
    """The compiled scene of one of the solids."""
    one, pair = jax.tree.map(lambda leaf: leaf[i], (solids, friction))
    return scene.shaped(family, one, physics, Friction(float(pair.ground), float(pair.robot)))


def bodies(solids: Solid, friction: Friction, template: Body) -> Body:
    """Solids as the fused engine has them, before the base of `template`."""
    com = solids.p_object_com + OFF_CENTRE
    corners = np.concatenate(
        [
            solids.vertices,
            np.broadcast_to(-solids.height[:, None, None] / 2, (*solids.vertices.shape[:2], 1)),
        ],
        axis=-1,
    )
    count, axes = solids.mass.size, solid.axes(solids)
    own = Body(
        mass=solids.mass,
        inertia=solids.inertia,
        p_object_com=com,
        q_object_body=solids.q_object_body,
        vertices=(corners - com[:, None, :]) @ axes,
        radius=solids.radius,
        height=solids.height,
        up=axes[:, 2],
        friction_ground=friction.ground,
        friction_robot=friction.robot,
        invweight=1 / solids.mass,
        base_invweight=None,
        base_half=None,
        base_z=None,
    )
    shared = [np.broadcast_to(np.asarray(x), (count, *np.shape(x))) for x in template]
    return Body(
        *(theirs if mine is None else mine for mine, theirs in zip(own, shared, strict=True))
    )


def mjx_fields(
    family: str, solids: Solid, friction: Friction, template: Scene, fields: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Fields of an MJX model for solids, from those (1, ...) of a scene with another solid."""
    count = solids.mass.size
    new = {name: np.repeat(np.asarray(row, float), count, axis=0) for name, row in fields.items()}
    model = template.physics
    thing, mass = model.body("object").id, solids.mass
    com = solids.p_object_com + OFF_CENTRE
    turn = solid.axes(solids)
    moments = np.einsum("nij,nj,nkj->nik", turn, solids.inertia, turn)
    inverse = np.einsum("nij,nj,nkj->nik", turn, 1 / solids.inertia, turn)
    z = JOINTS.object.start + 2
    new[".body_pos"][:, thing, 2] = solids.height / 2
    new[".qpos0"][:, z] = new[".qpos_spring"][:, z] = solids.height / 2
    new[".body_ipos"][:, thing], new[".body_iquat"][:, thing] = com, solids.q_object_body
    new[".body_mass"][:, thing] = new[".body_subtreemass"][:, thing] = mass
    new[".body_subtreemass"][:, 0] = new[".body_mass"].sum(axis=1)
    new[".body_inertia"][:, thing] = solids.inertia
    spin = np.mean(1 / solids.inertia, axis=1)
    new[".body_invweight0"][:, thing] = np.stack([1 / mass, spin], axis=-1)
    # The free joint moves the object's origin, which feels the spin through the arm of the centre.
    arm = _skew(com)
    shift = 1 / mass + np.trace(arm @ inverse @ arm.swapaxes(1, 2), axis1=1, axis2=2) / 3
    new[".dof_invweight0"][:, 3:6], new[".dof_invweight0"][:, 6:9] = shift[:, None], spin[:, None]
    about = moments - mass[:, None, None] * (arm @ arm)
    new[".dof_M0"][:, 3:6] = mass[:, None]
    new[".dof_M0"][:, 6:9] = np.diagonal(about, axis1=1, axis2=2)
    new[".stat.meaninertia"] = new[".dof_M0"].mean(axis=1)
    _size_geoms(family, solids, template, new)
    robot = np.array([model.pair(i).name == "base_object" for i in range(model.npair)])
    new[".pair_friction"][:, :, :2] = np.where(
        robot[:, None], friction.robot[:, None, None], friction.ground[:, None, None]
    )
    return new


def _size_geoms(family: str, solids: Solid, template: Scene, new: dict[str, np.ndarray]) -> None:
    """Sizes, bounding boxes and radii of the object's geoms."""
    model, half = template.physics, solids.height / 2
    for name, size in scene.geom_sizes(family, solids).items():
        geom = model.geom(name).id
        new[".geom_size"][:, geom] = size
        box = size if family == "box" else size[:, [0, 0, 1]]
        bound = np.linalg.norm(size[:, :3] if family == "box" else size[:, :2], axis=1)
        if name == "object_side":  # a capsule reaches farther up by its radius
            box, bound = box + [0, 0, 1] * size[:, :1], half + solids.radius
        new[".geom_aabb"][:, geom] = np.concatenate([0 * box, box], axis=-1).reshape(
            new[".geom_aabb"][:, geom].shape
        )
        new[".geom_rbound"][:, geom] = bound
    if family == "prism":
        for i, at in enumerate(scene.feet(solids).swapaxes(0, 1)):
            new[".geom_pos"][:, model.geom(f"foot_{i}").id] = at


def _skew(v: np.ndarray) -> np.ndarray:
    """Matrices (n, 3, 3) of the cross products with v (n, 3)."""
    x, y, z = v.T
    zero = np.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return np.stack(rows, axis=-1).reshape(-1, 3, 3)
