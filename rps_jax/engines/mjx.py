"""MuJoCo MJX: MuJoCo's own equations, written in JAX, for any scene.

All objects of one shape family compile to the same MJX structure, so that they can be batched in
one program: `stack` collects the fields in which they differ, `apply` puts one world's in place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rps_jax import errors
from rps_jax.control.observation import Twist
from rps_jax.engines.base import ControlPeriod, Driven, Engine, Mode, Motion
from rps_jax.engines.mjx_colliders import (
    BASE_PRISM,
    OWN,
    GeomType,
    Pair,
    collision,
    constraint,
    forward,
    mjx,
    smooth,
    solver,
)
from rps_jax.geometry import planar, solid
from rps_jax.geometry.solid import Solid
from rps_jax.robot import drive as drives
from rps_jax.robot.robot import Robot
from rps_jax.world import scene
from rps_jax.world.physics import Physics
from rps_jax.world.scene import JOINTS, OFF_CENTRE, Friction, Scene

# All that differs between objects of one shape family, as paths into an MJX model.
FIELDS = (
    ".stat.meaninertia",
    *(f".body_{name}" for name in ("pos", "ipos", "iquat", "mass", "subtreemass", "inertia")),
    *(".body_invweight0", ".dof_invweight0", ".dof_M0", ".qpos0", ".qpos_spring"),
    *(".geom_pos", ".geom_size", ".geom_aabb", ".geom_rbound", ".pair_friction"),
)

# Beside these, of prisms on feet of their own: (N, 2) [m], which else are their feet.
OUTLINE = "outline"


@jax.tree_util.register_static
@dataclass(frozen=True)
class Colliders:
    """Which colliders are ours; of the others MJX's own are taken."""

    pairs: frozenset[Pair] = frozenset(OWN)


class MJXStage(NamedTuple):
    """What all worlds of a batch that MJX steps share."""

    model: mjx.Model
    data: mjx.Data  # a blank to be filled with each world's state
    colliders: Colliders = Colliders()

    def drive(self, fields: dict[str, jax.Array], motion: Motion, period: ControlPeriod) -> Driven:
        """Step a batch for one control period.

        Before each step the commanded twist is written into the base's joint velocities, turned
        into the world; or the force of its drive is applied to its joints.
        """
        physics = period.physics
        step = jax.vmap(partial(self._step, timestep=physics.timestep))

        def one(state: Motion, _: None) -> tuple[Motion, jax.Array | None]:
            # Batched inside of the loop: a loop that is batched is traced anew.
            after, felt = step(fields, state, period.twists, period.robot)
            return after, felt if period.force else None

        after, felt = jax.lax.scan(one, motion, length=physics.substeps)
        return Driven(after, force=None if felt is None else felt.mean(axis=0))

    def _step(
        self,
        fields: dict[str, jax.Array],
        state: Motion,
        twist: Twist,
        robot: Robot | None,
        timestep: float,
    ) -> tuple[Motion, jax.Array]:
        """A world after one step, and the wrench (3,) of its object on its base, in its frame."""
        model, (qpos, qvel, warmstart, integral) = apply(self.model, fields), state
        data = self.data
        if robot is None:
            qvel = qvel.at[JOINTS.base].set(twist.in_world(qpos[2]))
        else:
            turn, base = (jnp.cos(qpos[2]), jnp.sin(qpos[2])), qvel[JOINTS.base]
            force, after = drives.push(robot, tuple(integral), twist, tuple(base), turn, timestep)
            applied = data.qfrc_applied.at[JOINTS.base].set(jnp.stack(force))
            data, integral = data.replace(qfrc_applied=applied), jnp.stack(after)
        data = data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart)
        with jax.default_matmul_precision("float32"):  # GPUs would round products to TF32
            data = step(model, data, self.colliders, fields.get(OUTLINE))
        felt = data.qfrc_constraint[JOINTS.base]  # of the contacts alone: the drive is applied
        felt = felt.at[:2].set(planar.rotate(-qpos[2], felt[:2]))
        return Motion(data.qpos, data.qvel, data.qacc_warmstart, integral), felt


def step(
    model: mjx.Model, data: mjx.Data, colliders: Colliders = Colliders(), outline: Any = None
) -> mjx.Data:
    """One step of MJX by MJX's own stages, and our colliders, of a prism of this outline (N, 2).

    Left out is what these scenes have not: tendons, actuators, sensors, springs, dampers, cameras
    and lights. As in C MuJoCo, without dampers nothing is integrated implicitly.
    """
    data = smooth.kinematics(model, data)
    data = smooth.com_pos(model, data)
    data = smooth.crb(model, data)
    data = smooth.factor_m(model, data)
    own = {pair: OWN[pair] for pair in colliders.pairs}
    if outline is not None:
        own[BASE_PRISM] = partial(own[BASE_PRISM], outline=outline)
    data = collision(model, data, own)
    data = constraint.make_constraint(model, data)
    data = smooth.com_vel(model, data)
    data = smooth.rne(model, data)
    force = data.qfrc_applied - data.qfrc_bias
    free = smooth.solve_m(model, data, force)
    data = solver.solve(model, data.replace(qfrc_smooth=force, qacc_smooth=free))
    return forward._advance(model, data, data.act_dot, data.qacc)


class MJX(Engine):
    """The engine of the paper's tables."""

    name = "mjx"
    modes = ("forward",)

    def check_derivatives(self, mode: Mode, physics: Physics) -> None:
        """Raises InputError unless a trial can be differentiated in this mode."""
        super().check_derivatives(mode, physics)
        if physics.cone == "elliptic":
            raise errors.InputError(
                "cone = elliptic is not allowed: MJX's elliptic cone has no finite derivatives, so "
                "it must be pyramidal (or the engine fused)."
            )

    def stage(
        self,
        family: str,
        solids: Solid,
        friction: Friction,
        physics: Physics,
        robots: Robot = Robot(),
    ) -> tuple[MJXStage, dict[str, np.ndarray]]:
        """Return the stage of the first of the worlds, and fields (n, ...) of all."""
        robots = scene.repeat_robot(robots, solids.mass.size)
        template = scene.compile_row(family, solids, friction, physics, 0, robots)
        model, fields = stack([template.physics])
        fields = mjx_fields(family, solids, friction, template, jax.device_get(fields))
        _size_bases(fields, template.physics, robots)
        if robots.driven:
            _weigh_bases(fields, template.physics, robots)
        return MJXStage(model, mjx.make_data(template.physics)), fields

    def slots(self, backend: str) -> int:
        """Worlds that one worker steps at once: few on a processor, whose caches are small."""
        return 24 if backend == "cpu" else 16384

    def levers(self, family: str) -> dict[str, Callable[[MJXStage], MJXStage]]:
        """Other options of the model, and MJX's own box collider."""
        found = {"sparse inertia matrix": _sparse}
        boxes = GeomType.BOX, GeomType.BOX
        if family == "box":
            usual = Colliders(frozenset(OWN) - {boxes})
            found["MJX's own box collider"] = lambda stage: stage._replace(colliders=usual)
        return found

    def contacts(self, stage: MJXStage, corners: int) -> int:
        """Points of contact that the program looks into."""
        return stage.data._impl.contact.dist.size  # pyright: ignore[reportAttributeAccessIssue]


def _sparse(stage: MJXStage) -> MJXStage:
    """The stage with a sparse inertia matrix."""
    model: Any = stage.model.tree_replace({"opt.jacobian": mjx.JacobianType.SPARSE})
    return stage._replace(model=model, data=mjx.make_data(model))


def put(model: mujoco.MjModel) -> mjx.Model:
    """The model as MJX's own engine has it."""
    # A static copy of the bounding radii, which only height fields use, would bar stacking.
    unused: dict[str, Any] = {"_impl.geom_rbound_hfield": np.zeros(model.ngeom)}
    there: Any = mjx.put_model(model).tree_replace(unused)
    return there


def stack(models: Sequence[mujoco.MjModel]) -> tuple[mjx.Model, dict[str, jax.Array]]:
    """One MJX model for all, on the device, and the fields that vary: name -> (n, ...).

    The fields are always the same ones, so that a world's numbers depend neither on what it is
    batched with nor on a program of its own. They are copied from compiled models, so nothing
    that MuJoCo derives from a mass, a size or a friction is forgotten.

    Raises:
      ValueError: the models differ in anything but `FIELDS`.
    """
    trees: list[Any] = [put(m) for m in models]
    leaves, structures = zip(*map(jax.tree_util.tree_flatten_with_path, trees), strict=True)
    if any(s != structures[0] for s in structures):
        raise ValueError("models of different structure cannot be stacked")
    fields = {}
    for columns in zip(*leaves, strict=True):
        name = jax.tree_util.keystr(columns[0][0])
        values = [np.asarray(leaf) for _, leaf in columns]
        if name in FIELDS:
            fields[name] = jnp.stack(values)
        elif any(not np.array_equal(v, values[0]) for v in values):
            raise ValueError(f"models that differ in {name} cannot be stacked")
    return trees[0], fields


def apply(model: mjx.Model, fields: dict[str, jax.Array]) -> mjx.Model:
    """The model with one world's fields, as named by `stack`, put in place."""
    return jax.tree_util.tree_map_with_path(
        lambda path, leaf: fields.get(jax.tree_util.keystr(path), leaf), model
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
    if solids.feet is not None:
        new[OUTLINE] = solids.vertices
    robot = np.array([model.pair(i).name == "base_object" for i in range(model.npair)])
    new[".pair_friction"][:, :, :2] = np.where(
        robot[:, None], friction.robot[:, None, None], friction.ground[:, None, None]
    )
    return new


def _size_bases(fields: dict[str, np.ndarray], model: mujoco.MjModel, robots: Robot) -> None:
    """Size, bounding box and radius of the bases of robots (n,)."""
    geom = model.geom("base").id
    size = fields[".geom_size"][:, geom]
    size[:, :2] = scene.base_half(robots, len(size))
    box = np.concatenate([0 * size, size], axis=-1)
    fields[".geom_aabb"][:, geom] = box.reshape(fields[".geom_aabb"][:, geom].shape)
    fields[".geom_rbound"][:, geom] = np.linalg.norm(size, axis=1)


def _weigh_bases(fields: dict[str, np.ndarray], model: mujoco.MjModel, robots: Robot) -> None:
    """The masses of bases (n,) that can be slowed, and what MuJoCo derives from them."""
    base = model.body("base").id
    mass, inertia = np.asarray(robots.mass, float), np.asarray(robots.inertia, float)
    fields[".body_mass"][:, base] = fields[".body_subtreemass"][:, base] = mass
    fields[".body_subtreemass"][:, 0] = fields[".body_mass"].sum(axis=1)
    fields[".body_inertia"][:, base] = inertia[:, None]
    fields[".body_invweight0"][:, base] = np.stack(
        [scene.base_invweight(robots), 1 / (3 * inertia)], axis=-1
    )
    weights = np.stack([mass, mass, inertia], axis=-1)
    fields[".dof_M0"][:, :3], fields[".dof_invweight0"][:, :3] = weights, 1 / weights
    fields[".stat.meaninertia"] = fields[".dof_M0"].mean(axis=1)


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
    if family == "prism" or solids.feet is not None:
        for i, at in enumerate(scene.foot_positions(solids).swapaxes(0, 1)):
            new[".geom_pos"][:, model.geom(f"foot_{i}").id] = at


def _skew(v: np.ndarray) -> np.ndarray:
    """Matrices (n, 3, 3) of the cross products with v (n, 3)."""
    x, y, z = v.T
    zero = np.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return np.stack(rows, axis=-1).reshape(-1, 3, 3)


ENGINE = MJX()
