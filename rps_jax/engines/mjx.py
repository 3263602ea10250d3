"""The engine MJX: MuJoCo's equations in JAX, for any scene.

All objects of one shape family compile to the same MJX structure, so that one program steps a
batch of them: `fields_of` returns the fields that differ, `apply` sets those of one world.
"""

from __future__ import annotations

from collections.abc import Callable
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
    COLLIDERS,
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
from rps_jax.world.scene import JOINTS, OFF_CENTRE, Friction

# Fields that differ between objects of one shape family, as paths into an MJX model.
FIELDS = (
    ".stat.meaninertia",
    *(f".body_{name}" for name in ("pos", "ipos", "iquat", "mass", "subtreemass", "inertia")),
    *(".body_invweight0", ".dof_invweight0", ".dof_M0", ".qpos0", ".qpos_spring"),
    *(".geom_pos", ".geom_size", ".geom_aabb", ".geom_rbound", ".pair_friction"),
)

# Field of prisms on explicit feet: (N, 2) [m]; other prisms stand on their outline.
OUTLINE = "outline"


@jax.tree_util.register_static
@dataclass(frozen=True)
class Colliders:
    """Pairs of geoms with our colliders; other pairs have MJX's."""

    pairs: frozenset[Pair] = frozenset(COLLIDERS)


class MJXStage(NamedTuple):
    """Stage of MJX: the parts that all worlds of a batch share."""

    model: mjx.Model
    data: mjx.Data  # a template for the state of each world
    colliders: Colliders = Colliders()

    def drive(self, fields: dict[str, jax.Array], motion: Motion, period: ControlPeriod) -> Driven:
        """Step a batch for one control period.

        Before each step, the twist is written into the base's joint velocities, in the world's
        frame. If the force is limited, the force of the drive is applied to its joints instead.
        """
        physics = period.physics
        step = jax.vmap(partial(self._step, timestep=physics.timestep))

        def body(state: Motion, _: None) -> tuple[Motion, jax.Array | None]:
            # vmap inside of the loop: JAX would trace a batched loop again.
            state, wrench = step(fields, state, period.twists, period.robot)
            return state, wrench if period.force else None

        motion, wrenches = jax.lax.scan(body, motion, length=physics.substeps)
        return Driven(motion, force=None if wrenches is None else wrenches.mean(axis=0))

    def _step(
        self,
        fields: dict[str, jax.Array],
        state: Motion,
        twist: Twist,
        robot: Robot | None,
        timestep: float,
    ) -> tuple[Motion, jax.Array]:
        """Return a world after one step, and the wrench (3,) on its base, in the base's frame."""
        model, (qpos, qvel, warmstart, integral) = apply(self.model, fields), state
        data = self.data
        if robot is None:
            qvel = qvel.at[JOINTS.base].set(twist.in_world(qpos[2]))
        else:
            assert integral is not None  # of a base with a limited force
            turn, base = (jnp.cos(qpos[2]), jnp.sin(qpos[2])), qvel[JOINTS.base]
            servo: Any = tuple(integral)
            force, servo = drives.push(robot, servo, twist, tuple(base), turn, timestep)
            applied = data.qfrc_applied.at[JOINTS.base].set(jnp.stack(force))
            data, integral = data.replace(qfrc_applied=applied), jnp.stack(servo)
        data = data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart)
        with jax.default_matmul_precision("float32"):  # GPUs would round products to TF32
            data = step(model, data, self.colliders, fields.get(OUTLINE))
        wrench = data.qfrc_constraint[JOINTS.base]  # of the contacts, without the drive
        wrench = wrench.at[:2].set(planar.rotate(-qpos[2], wrench[:2]))
        return Motion(data.qpos, data.qvel, data.qacc_warmstart, integral), wrench


def step(
    model: mjx.Model, data: mjx.Data, colliders: Colliders = Colliders(), outline: Any = None
) -> mjx.Data:
    """Compute one step by functions of MJX and our colliders, with a prism's outline (N, 2).

    Unused features are left out: tendons, actuators, sensors, springs, dampers, cameras and lights.
    As in C MuJoCo, without dampers no velocity is integrated implicitly.
    """
    data = smooth.kinematics(model, data)
    data = smooth.com_pos(model, data)
    data = smooth.crb(model, data)
    data = smooth.factor_m(model, data)
    ours = {pair: COLLIDERS[pair] for pair in colliders.pairs}
    if outline is not None:
        ours[BASE_PRISM] = partial(ours[BASE_PRISM], outline=outline)
    data = collision(model, data, ours)
    data = constraint.make_constraint(model, data)
    data = smooth.com_vel(model, data)
    data = smooth.rne(model, data)
    force = data.qfrc_applied - data.qfrc_bias
    free = smooth.solve_m(model, data, force)
    data = solver.solve(model, data.replace(qfrc_smooth=force, qacc_smooth=free))
    return forward._advance(model, data, data.act_dot, data.qacc)


class MJX(Engine):
    """Engine of the paper's tables."""

    name = "mjx"
    modes = ("forward",)

    def check_derivatives(self, mode: Mode, physics: Physics) -> None:
        """Raise InputError unless a trial can be differentiated in this mode."""
        super().check_derivatives(mode, physics)
        if physics.cone == "elliptic":
            rule = "MJX has no finite derivatives for it; choose pyramidal, or the engine fused"
            raise errors.not_allowed("cone", physics.cone, rule)

    def stage(
        self, family: str, solids: Solid, friction: Friction, physics: Physics, robots: Robot
    ) -> tuple[MJXStage, dict[str, np.ndarray]]:
        """Return the stage of the first of the worlds, and fields (n, ...) of all."""
        robots = scene.repeat_robot(robots, solids.mass.size)
        template = scene.compile_row(family, solids, friction, physics, 0, robots).physics
        model = put(template)
        fields = mjx_fields(family, solids, friction, robots, template, fields_of(model))
        return MJXStage(model, mjx.make_data(template)), fields

    def slots(self, backend: str) -> int:
        """Return the number of worlds that one worker steps at once: few for small CPU caches."""
        return 24 if backend == "cpu" else 16384

    def levers(self, family: str) -> dict[str, Callable[[MJXStage], MJXStage]]:
        """Return other options of the model, and MJX's box collider."""
        levers = {"sparse inertia matrix": _sparse}
        boxes = GeomType.BOX, GeomType.BOX
        if family == "box":
            default = Colliders(frozenset(COLLIDERS) - {boxes})
            levers["MJX's own box collider"] = lambda stage: stage._replace(colliders=default)
        return levers


def _sparse(stage: MJXStage) -> MJXStage:
    """Return the stage with a sparse inertia matrix."""
    model: Any = stage.model.tree_replace({"opt.jacobian": mjx.JacobianType.SPARSE})
    return stage._replace(model=model, data=mjx.make_data(model))


def put(model: mujoco.MjModel) -> mjx.Model:
    """Return a model on the device."""
    # MJX holds a static copy of the bounding radii for height fields, which would prevent stacking.
    unused: dict[str, Any] = {"_impl.geom_rbound_hfield": np.zeros(model.ngeom)}
    on_device: Any = mjx.put_model(model).tree_replace(unused)
    return on_device


def fields_of(model: mjx.Model) -> dict[str, np.ndarray]:
    """Return `FIELDS` of a model, which include all constants that MuJoCo derives from a mass.

    They are always the same fields, so that the numbers of a world do not depend on the batch.
    """
    leaves = jax.tree_util.tree_flatten_with_path(model)[0]
    named = ((jax.tree_util.keystr(path), leaf) for path, leaf in leaves)
    return {name: np.asarray(leaf) for name, leaf in named if name in FIELDS}


def apply(model: mjx.Model, fields: dict[str, jax.Array]) -> mjx.Model:
    """Return the model with the fields of one world, named as by `fields_of`."""
    return jax.tree_util.tree_map_with_path(
        lambda path, leaf: fields.get(jax.tree_util.keystr(path), leaf), model
    )


def mjx_fields(
    family: str, solids: Solid, friction: Friction, robots: Robot, model: mujoco.MjModel,
    fields: dict[str, np.ndarray],
) -> dict[str, np.ndarray]:  # fmt: skip
    """Return fields (n, ...) of worlds, from those (...) of a model of the first."""
    count = solids.mass.size
    new = {name: np.repeat(np.asarray(x, float)[None], count, axis=0) for name, x in fields.items()}
    body, mass = model.body("object").id, solids.mass
    com = solids.p_object_com + OFF_CENTRE
    turn = solid.axes(solids)
    moments = np.einsum("nij,nj,nkj->nik", turn, solids.inertia, turn)
    inverse = np.einsum("nij,nj,nkj->nik", turn, 1 / solids.inertia, turn)
    z = JOINTS.object.start + 2
    new[".body_pos"][:, body, 2] = solids.height / 2
    new[".qpos0"][:, z] = new[".qpos_spring"][:, z] = solids.height / 2
    new[".body_ipos"][:, body], new[".body_iquat"][:, body] = com, solids.q_object_body
    new[".body_mass"][:, body] = new[".body_subtreemass"][:, body] = mass
    new[".body_inertia"][:, body] = solids.inertia
    spin = np.mean(1 / solids.inertia, axis=1)
    new[".body_invweight0"][:, body] = np.stack([1 / mass, spin], axis=-1)
    # The free joint moves the object's origin; the spin moves it by the arm of the centre of mass.
    arm = _skew(com)
    shift = 1 / mass + np.trace(arm @ inverse @ arm.swapaxes(1, 2), axis1=1, axis2=2) / 3
    new[".dof_invweight0"][:, 3:6], new[".dof_invweight0"][:, 6:9] = shift[:, None], spin[:, None]
    about = moments - mass[:, None, None] * (arm @ arm)
    new[".dof_M0"][:, 3:6] = mass[:, None]
    new[".dof_M0"][:, 6:9] = np.diagonal(about, axis1=1, axis2=2)
    if robots.driven:
        _weigh_bases(new, model, robots)
    new[".body_subtreemass"][:, 0] = new[".body_mass"].sum(axis=1)
    new[".stat.meaninertia"] = new[".dof_M0"].mean(axis=1)
    _size_geoms(family, solids, robots, model, new)
    if solids.feet is not None:
        new[OUTLINE] = solids.vertices
    robot = np.array([model.pair(i).name == "base_object" for i in range(model.npair)])
    new[".pair_friction"][:, :, :2] = np.where(
        robot[:, None], friction.robot[:, None, None], friction.ground[:, None, None]
    )
    return new


def _weigh_bases(new: dict[str, np.ndarray], model: mujoco.MjModel, robots: Robot) -> None:
    """Set the masses of bases (n,) with a limited force, and the derived constants."""
    base = model.body("base").id
    mass, inertia = np.asarray(robots.mass, float), np.asarray(robots.inertia, float)
    new[".body_mass"][:, base] = new[".body_subtreemass"][:, base] = mass
    new[".body_inertia"][:, base] = inertia[:, None]
    invweight = np.stack([scene.base_invweight(robots), 1 / (3 * inertia)], axis=-1)
    new[".body_invweight0"][:, base] = invweight
    weights = np.stack([mass, mass, inertia], axis=-1)
    new[".dof_M0"][:, :3], new[".dof_invweight0"][:, :3] = weights, 1 / weights


def _size_geoms(
    family: str, solids: Solid, robots: Robot, model: mujoco.MjModel, new: dict[str, np.ndarray]
) -> None:
    """Set sizes, bounding boxes and radii of the geoms of bases and objects."""
    half, base = solids.height / 2, new[".geom_size"][:, model.geom("base").id].copy()
    base[:, :2] = scene.base_half(robots, len(base))
    for name, size in {"base": base, **scene.geom_sizes(family, solids)}.items():
        geom, is_box = model.geom(name).id, name == "base" or family == "box"
        box = size if is_box else size[:, [0, 0, 1]]
        bound = np.linalg.norm(size[:, :3] if is_box else size[:, :2], axis=1)
        if name == "object_side":  # a capsule reaches farther up by its radius
            box, bound = box + [0, 0, 1] * size[:, :1], half + solids.radius
        new[".geom_size"][:, geom], new[".geom_rbound"][:, geom] = size, bound
        aabb = new[".geom_aabb"][:, geom]
        aabb[:] = np.concatenate([0 * box, box], axis=-1).reshape(aabb.shape)
    if family == "prism" or solids.feet is not None:
        for i, at in enumerate(scene.foot_positions(solids).swapaxes(0, 1)):
            new[".geom_pos"][:, model.geom(f"foot_{i}").id] = at


def _skew(v: np.ndarray) -> np.ndarray:
    """Return matrices (n, 3, 3) of the cross products with v (n, 3)."""
    x, y, z = v.T
    zero = np.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return np.stack(rows, axis=-1).reshape(-1, 3, 3)


ENGINE = MJX()
