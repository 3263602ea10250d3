"""The engine MJX: MuJoCo's equations in JAX, for any scene.

All objects of one shape family compile to the same MJX structure, so that one program steps a
batch of them: `fields_of` returns the fields that differ, `apply` sets those of one world.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from operator import attrgetter
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.control.observation import Twist
from rps_jax.engines import mjx_gradients
from rps_jax.engines.base import ControlPeriod, Driven, Engine, Motion
from rps_jax.engines.fused.contacts import AT_ONCE, nearest_walls
from rps_jax.engines.mjx_colliders import (
    Extra,
    collision,
    constraint,
    corners_of,
    geoms,
    mjx,
    smooth,
    types,
)
from rps_jax.engines.mujoco import compile_rows
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Entries, Pytree
from rps_jax.record.files import Arrays
from rps_jax.robot.base import Tyres, push
from rps_jax.robot.robot import Robot
from rps_jax.world import scene
from rps_jax.world.opengl import mujoco
from rps_jax.world.scene import JOINTS, WorldInputs

# Fields that differ between objects of one shape family, as paths into an MJX model.
_FIELDS = """
.stat.meaninertia .body_pos .body_ipos .body_iquat .body_mass .body_subtreemass .body_inertia
.body_invweight0 .dof_invweight0 .dof_M0 .qpos0 .qpos_spring
.geom_pos .geom_size .geom_aabb .geom_rbound .pair_friction
"""
FIELDS = _FIELDS.split()

# The same of objects on pads.
PADS = [".pair_solref", ".pair_solimp"]
# Field of prisms on explicit feet: (N, 2) [m]; other prisms stand on their outline.
OUTLINE = "outline"
BOUNDARY = "boundary"  # field of floors with two frictions: (4,) as of `Surroundings`
# Field of worlds whose object may touch walls: (W, 4) [m] x, y, x, y of their ends.
WALLS = "walls"


class MJXStage(NamedTuple):
    """Stage of MJX: the parts that all worlds of a batch share."""

    model: mjx.Model
    data: mjx.Data  # a template for the state of each world
    native = False
    engine = "mjx"

    def drive(self, fields: dict[str, Array], motion: Motion, period: ControlPeriod) -> Driven:
        """Step a batch for one control period.

        Before each step, the twist is written into the base's joint velocities, in the world's
        frame. If the force is limited, the force of the drive is applied to its joints instead.
        """
        physics = period.physics
        if WALLS in fields:
            fields = jax.vmap(self._with_walls)(fields, motion.qpos)
        step = jax.vmap(partial(self._step, timestep=physics.timestep))
        # Derivatives compute each step again, without its solver.
        step = jax.checkpoint(step, prevent_cse=False, policy=mjx_gradients.SAVED)

        def body(state: Motion, _: None) -> tuple[Motion, Array | None]:
            # vmap inside of the loop: JAX would trace a batched loop again.
            state, wrench = step(fields, state, period.twists, period.robot)
            return state, wrench if period.force else None

        motion, wrenches = jax.lax.scan(body, motion, length=physics.substeps)
        return Driven(motion, force=None if wrenches is None else wrenches.mean(axis=0))

    def _with_walls(self, fields: dict[str, Array], qpos: Array) -> dict[str, Array]:
        """Return fields whose walls are those nearest to the object."""
        model, free = apply(self.model, fields), tuple(qpos[JOINTS.object])
        corners: Entries = tuple(corners_of(model, fields.get(OUTLINE)).T)
        near = nearest_walls(tuple(fields[WALLS].T), free[:3], free[3:], corners)
        position, size, turn = model.geom_pos, model.geom_size, model.geom_quat
        for geom, wall in zip(geoms(model, 0, types.GeomType.BOX), near, strict=True):
            (*middle, yaw), half = wall
            position = position.at[geom, :2].set(jnp.stack(middle))
            size = size.at[geom, 0].set(half)
            turn = turn.at[geom, 0].set(jnp.cos(yaw / 2)).at[geom, 3].set(jnp.sin(yaw / 2))
        return fields | {".geom_pos": position, ".geom_size": size, ".geom_quat": turn}

    def _step(
        self,
        fields: dict[str, Array],
        state: Motion,
        twist: Twist,
        robot: Robot | None,
        timestep: float,
    ) -> tuple[Motion, Array]:
        """Return a world after one step, and the wrench (3,) on its base, in the base's frame."""
        model, (qpos, qvel, warmstart, integral) = apply(self.model, fields), state
        data, sideways = self.data, None
        if robot is None:
            qvel = qvel.at[JOINTS.base].set(twist.in_world(qpos[JOINTS.base_yaw]))
        else:
            assert integral is not None  # of a base with a limited force
            turn, base = (
                (jnp.cos(qpos[JOINTS.base_yaw]), jnp.sin(qpos[JOINTS.base_yaw])),
                qvel[JOINTS.base],
            )
            servo: Entries = tuple(integral)
            force, servo = push(robot, servo, twist, tuple(base), turn, timestep)
            applied = jnp.stack(force)
            if robot.drive != "omni":
                tyres = Tyres.of(robot, tuple(base), turn, timestep)
                applied = applied + jnp.stack(tyres.force)
                direction = jnp.stack(tyres.sideways)
                sideways = jnp.asarray(tyres.mass) * jnp.outer(direction, direction)
            applied = data.qfrc_applied.at[JOINTS.base].set(applied)
            data, integral = data.replace(qfrc_applied=applied), jnp.stack(servo)
        data = data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart)
        with jax.default_matmul_precision("float32"):  # GPUs would round products to TF32
            data = step(model, data, fields.get(OUTLINE), fields.get(BOUNDARY), inertia=sideways)
        wrench = data.qfrc_constraint[JOINTS.base]  # of the contacts, without the drive
        wrench = wrench.at[:2].set(planar.rotate(-qpos[JOINTS.base_yaw], wrench[:2]))
        return Motion(data.qpos, data.qvel, data.qacc_warmstart, integral), wrench


def step(model: mjx.Model, data: mjx.Data, *extra: Extra, inertia: Array | None = None) -> mjx.Data:
    """Compute one step by functions of MJX and our colliders; `extra` is that of `collision`.

    An `inertia` (3, 3) of tyres is added to that of the base's joints. Unused features are left
    out: tendons, actuators, sensors, springs, dampers, cameras and lights. As in C MuJoCo, without
    dampers no velocity is integrated implicitly.
    """
    data = smooth.kinematics(model, data)
    data = smooth.com_pos(model, data)
    data = smooth.crb(model, data)
    if inertia is not None:
        mass = data._impl.M.at[JOINTS.base, JOINTS.base].add(inertia)  # dense
        held: Pytree = data.tree_replace({"_impl.M": mass})
        data = held
    data = smooth.factor_m(model, data)
    data = collision(model, data, *extra)
    data = constraint.make_constraint(model, data)
    data = smooth.com_vel(model, data)
    data = smooth.rne(model, data)
    force = data.qfrc_applied - data.qfrc_bias
    free = smooth.solve_m(model, data, force)
    data = mjx_gradients.solve(model, data.replace(qfrc_smooth=force, qacc_smooth=free))
    return mjx_gradients.forward._advance(model, data, data.act_dot, data.qacc)


class MJX(Engine):
    """Engine of the paper's tables."""

    name = "mjx"
    modes = ("forward", "reverse")

    def stage(self, inputs: WorldInputs) -> tuple[MJXStage, Arrays]:
        """Return the stage of the first of the worlds, and fields (n, ...) of all."""
        walls = inputs.surroundings.walls
        if walls is not None:  # the model has two, and they move
            slots = inputs.surroundings._replace(walls=walls[:, :AT_ONCE])
            inputs = inputs._replace(surroundings=slots)
        template = scene.compile_row(inputs, 0).physics
        names = FIELDS if inputs.solids.pads is None else FIELDS + PADS
        rows = compile_rows(inputs, partial(fields_of, names=names))
        fields = {name: np.stack([row[name] for row in rows]) for name in names}
        if inputs.solids.feet is not None:
            fields[OUTLINE] = inputs.solids.vertices
        around = {".opt.gravity": inputs.surroundings.slope, BOUNDARY: inputs.surroundings.boundary}
        around[WALLS] = None if walls is None else walls.reshape(inputs.num_worlds, -1, 4)
        fields |= {name: x for name, x in around.items() if x is not None}
        return MJXStage(put(template), mjx.make_data(template)), fields

    def slots(self, backend: str) -> int:
        """Return the number of worlds that one worker steps at once: few for small CPU caches."""
        return 24 if backend == "cpu" else 16384


def put(model: mujoco.MjModel) -> mjx.Model:
    """Return a model on the device."""
    # MJX holds a static copy of the bounding radii for height fields, which would prevent stacking.
    unused: Pytree = {"_impl.geom_rbound_hfield": np.zeros(model.ngeom)}
    return mjx.put_model(model).tree_replace(unused)  # pyright: ignore[reportReturnType]


def fields_of(model: mujoco.MjModel, names: Sequence[str] = FIELDS) -> Arrays:
    """Return fields of a model, which include all constants that MuJoCo derives from a mass.

    They are always the same fields, so that the numbers of a world do not depend on the batch.
    """
    return {name: np.array(attrgetter(name[1:])(model), float) for name in names}


def apply(model: mjx.Model, fields: dict[str, Array]) -> mjx.Model:
    """Return the model with the fields of one world, named as by `fields_of`."""
    return jax.tree_util.tree_map_with_path(
        lambda path, leaf: fields.get(jax.tree_util.keystr(path), leaf), model
    )


ENGINE = MJX()
