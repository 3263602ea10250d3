"""MJX-Warp: the scenes as MJX has them, stepped by MuJoCo's own kernels for NVIDIA GPUs.

Three things differ from MJX. A cylinder touches the base as the cylinder that it is. The worlds of
a batch share one list of contacts, of a length given beforehand: what finds no room is lost, which
is counted. And all worlds share the corners of a mesh, so that there are no random prisms.

What differs between worlds is batched field by field, as in MJX: all of `mjx.FIELDS` but the two
that Warp does not have a use for, since it sums the inertia up anew (`stat.meaninertia`, `dof_M0`).
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rps_jax.control.observation import Twist
from rps_jax.engines.base import Driven, Engine, Motion, taken
from rps_jax.engines.mjx import apply, solids_by_template, stack
from rps_jax.engines.mjx_colliders import mjx
from rps_jax.errors import InputError
from rps_jax.geometry.solid import Solid
from rps_jax.robot.robot import Robot
from rps_jax.world.physics import Physics
from rps_jax.world.scene import JOINTS, Friction, Scene

_CONTACTS = 4  # of a pair of geoms, at most
_ROWS = 4  # of a contact in the solver, at most: those of a pyramid
# Bits of Warp's `overflow` by which contacts or their constraints were lost. Not that its solver
# made all its iterations: `Physics` bounds them on purpose.
_LOST = ("NEFC", "NJMAX_NNZ", "BROADPHASE", "NARROWPHASE", "CCD", "EPA_HORIZON")


def on_nvidia() -> bool:
    """Whether JAX computes on an NVIDIA GPU."""
    try:
        return jax.devices()[0] in jax.devices("cuda")
    except RuntimeError:
        return False


def own_cylinder(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model with the base touched by the object, where a capsule stood in for its side."""
    model = copy.copy(model)
    names = [model.geom(i).name for i in range(model.ngeom)]
    if "object_side" in names:
        side = names.index("object_side")
        model.pair_geom2[model.pair_geom2 == side] = names.index("object")
    return model


def put(model: mujoco.MjModel) -> mjx.Model:
    """The model as Warp has it; neither it nor the compiler of its kernels prints anything."""
    warp = mjx.warp.warp
    warp.config.log_level = max(warp.config.log_level, warp.LOG_WARNING)
    # The lengths only serve to put objects to sleep, and as constants would bar stacking.
    changes: dict[str, Any] = {
        "opt._impl.warn_overflow": 0,
        "_impl.dof_length": np.ones(model.nv, np.float32),
    }
    there: Any = mjx.put_model(model, impl="warp").tree_replace(changes)
    return there


def blank(model: mujoco.MjModel, contacts: int | None = None) -> mjx.Data:
    """A state to be filled in, with room for the contacts of one world.

    `contacts` is how many; by default as many as there can be.
    """
    room = _CONTACTS * model.npair if contacts is None else contacts
    pairs = model.npair  # each of which is looked into once
    return mjx.make_data(model, impl="warp", naconmax=room, naccdmax=pairs, njmax=_ROWS * room)


class WarpStage(NamedTuple):
    """What all worlds of a batch that MJX-Warp steps share."""

    model: mjx.Model
    data: mjx.Data  # a blank, with room for the contacts of one world

    def drive(
        self,
        fields: dict[str, jax.Array],
        motion: Motion,
        twists: Twist,
        physics: Physics,
        robot: Robot | None = None,
        force: bool = False,
    ) -> Driven:
        """Step a batch for one control period, in float32 whatever the precision of its states."""
        narrow = jax.tree.map(lambda x: x.astype(jnp.float32), (fields, *motion[:3], twists))
        room = _for_worlds(self.data, len(motion.qpos))
        one = partial(_drive, self.model, room, substeps=physics.substeps)
        *after, lost = jax.vmap(one)(*narrow)
        wide = (x.astype(motion.qpos.dtype) for x in after)
        qpos, qvel, warmstart = wide
        return Driven(Motion(qpos, qvel, warmstart, motion.integral), overflowed=lost)


class Warp(Engine):
    """MuJoCo's own kernels on an NVIDIA GPU."""

    name = "warp"
    forces = False
    tells_force = False
    shapes = ("box", "cylinder")

    def check(self, families: Iterable[str] = ()) -> None:
        """Raises InputError unless this machine can step worlds of these shape families."""
        if set(families) - set(self.shapes):
            raise InputError(
                "engine = warp is not allowed for prisms, whose corners it has the same in all "
                "worlds: choose mjx, fused, mujoco or quasistatic, or boxes and cylinders alone."
            )
        missing = [] if mjx.warp.WARP_INSTALLED else ["no warp-lang"]
        if not on_nvidia():
            missing.append(f"no NVIDIA GPU, JAX runs on {jax.default_backend()}")
        if missing:
            raise InputError(
                f"engine = warp is not there ({' and '.join(missing)}): pip install "
                "'rps_jax[cuda,warp]' on a machine with an NVIDIA GPU, or choose mjx, fused, "
                "mujoco or quasistatic."
            )

    def stage_of_scenes(self, scenes: Sequence[Scene], which: np.ndarray) -> tuple[Any, Any]:
        """Stage and fields of worlds in scenes of one shape family."""
        self.check([s.family for s in scenes])
        models = [own_cylinder(s.physics) for s in scenes]
        model, fields = stack(models, put)
        return WarpStage(model, blank(models[0])), taken(jax.device_get(fields), which)

    def stage_of_solids(
        self,
        family: str,
        solids: Solid,
        friction: Friction,
        physics: Physics,
        robots: Robot = Robot(),
    ) -> tuple[Any, Any]:
        """Stage and fields of solids (n, ...); its bases follow every twist."""
        assert not robots.driven, "checked by check_robot"
        self.check([family])
        return solids_by_template(self, family, solids, friction, physics, robots)

    def contacts(self, stage: WarpStage, corners: int) -> int:
        """Points of contact for which there is room."""
        return stage.data._impl.naconmax  # pyright: ignore[reportAttributeAccessIssue]


def _for_worlds(data: mjx.Data, count: int) -> mjx.Data:
    """A blank with room for the contacts of that many worlds, which share it."""
    own: Any = data._impl
    room = {name: count * getattr(own, name) for name in ("naconmax", "naccdmax")}
    lists = {
        name: jnp.tile(leaf, (count,) + (1,) * (leaf.ndim - 1))
        for name, leaf in vars(own).items()
        if name.startswith("contact__")
    }
    return data.replace(_impl=own.replace(**room, **lists))


def _drive(
    model: mjx.Model,
    data: mjx.Data,
    fields: dict[str, jax.Array],
    qpos: jax.Array,
    qvel: jax.Array,
    warmstart: jax.Array,
    twist: Twist,
    *,
    substeps: int,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Positions, velocities and warm start of one world after steps at `twist`; what was lost."""
    model = apply(model, fields)
    data = data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart)

    def one(data, _):
        base = twist.in_world(data.qpos[2])
        data = data.replace(qvel=data.qvel.at[JOINTS.base].set(base))
        return mjx.step(model, data), None

    data, _ = jax.lax.scan(one, data, length=substeps)
    bits = sum(mjx.warp.mujoco_warp.OverflowType[name] for name in _LOST)
    return data.qpos, data.qvel, data.qacc_warmstart, data._impl.overflow & bits != 0


ENGINE = Warp()
