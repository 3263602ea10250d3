"""Worlds of test scenes: staged and stepped by an engine, and compiled by MuJoCo."""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from numpy.testing import assert_array_equal

from rps_jax import engines
from rps_jax.control.observation import Twist
from rps_jax.engines import mjx as mjx_engine
from rps_jax.engines.base import ControlPeriod, Motion
from rps_jax.engines.fused.contacts import Body
from rps_jax.engines.mujoco import Batch
from rps_jax.engines.quasistatic import Slider
from rps_jax.geometry import solid
from rps_jax.geometry import vectors as sp
from rps_jax.robot.robot import Robot
from rps_jax.world import scene
from rps_jax.world.physics import Physics, preset
from rps_jax.world.scene import FRICTION, Friction, Scene, Surroundings, WorldInputs


def staged(
    engine: str,
    scenes: Sequence[Scene],
    physics: Physics,
    robot: Robot = Robot(),
    surroundings: Surroundings = Surroundings(),
) -> tuple[Any, Any]:
    """Return stage and fields of worlds in scenes of one shape family."""
    pairs = [[loaded.physics.pair(i) for i in range(loaded.physics.npair)] for loaded in scenes]
    slide = [{pair.name.partition("_")[0]: pair.friction[0] for pair in world} for world in pairs]
    friction = Friction(
        *(np.array([world[name] for world in slide]) for name in ("ground", "base"))
    )
    solids = solid.stack([loaded.solid for loaded in scenes])
    columns = solids, friction, physics, robot, surroundings
    return engines.get(engine).stage(WorldInputs(scenes[0].family, *columns))


def recompiled(engine: str, scenes: Sequence[Scene]) -> Any:
    """Return the fields of worlds compiled by MuJoCo, to compare with those of a stage."""
    models = [loaded.physics for loaded in scenes]
    if engine == "mjx":
        return stack(models)[1]
    if engine == "quasistatic":
        half = np.array([model.geom("base").size[:2] for model in models])
        friction = np.array([model.pair("base_object").friction[0] for model in models])
        solids = solid.stack([loaded.solid for loaded in scenes])
        arm = solid.friction_arm(solids)
        com, outline = solids.p_object_com[:, :2], (solids.vertices, solids.radius)
        return Slider(com, arm, friction, half, *outline)
    bodies = [body(loaded.physics, loaded.solid.vertices) for loaded in scenes]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *bodies)


def stack(models: Sequence[mujoco.MjModel]) -> tuple[Any, dict[str, np.ndarray]]:
    """Return an MJX model and the fields (n, ...) of models that differ in nothing else."""
    trees = [mjx_engine.put(model) for model in models]
    fields = [mjx_engine.fields_of(model) for model in models]
    rows = [{k: np.asarray(v, np.float32) for k, v in row.items()} for row in fields]
    for tree in trees:
        jax.tree.map(assert_array_equal, mjx_engine.apply(tree, rows[0]), trees[0])
    return trees[0], {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def body(model: mujoco.MjModel, vertices: np.ndarray) -> Body:
    """Return the body of a physics model and the vertices (N, 2) [m] of its footprint."""
    object_body, base = model.body("object"), model.body("base")
    geom, front = model.geom("object"), model.geom("base")
    frame = sp.matrix(object_body.iquat)
    round_ = len(vertices) == 1
    half = object_body.pos[2]  # a scene starts with its object on the ground
    bottom = np.column_stack([vertices, np.full(len(vertices), -half)])
    pairs = [model.pair(i) for i in range(model.npair)]
    friction = {pair.name.partition("_")[0]: pair.friction[0] for pair in pairs}
    return Body(
        mass=object_body.mass[0],
        inertia=object_body.inertia.copy(),
        p_object_com=object_body.ipos.copy(),
        q_object_body=object_body.iquat.copy(),
        vertices=np.array([sp.to_body(frame, v) for v in bottom - object_body.ipos]),
        radius=geom.size[0] if round_ else 0.0,
        height=2 * half,
        up=np.array(sp.to_body(frame, (0.0, 0.0, 1.0))),
        friction_ground=friction["ground"],
        friction_robot=friction["base"],
        invweight=model.body_invweight0[object_body.id, 0],
        base_invweight=model.body_invweight0[base.id, 0],
        base_size=front.size[:2].copy(),
        base_z=front.pos[2] + front.size[2] * np.array([-1.0, 1.0]),
    )


class Recording(NamedTuple):
    """States of n worlds at the start and after each of T control periods."""

    qpos: Any  # (T + 1, n, 10)
    qvel: Any  # (T + 1, n, 9)
    force: Any = None  # [N, N, N m] (T, n, 3) on the base, where the engine computes it


def drive(
    stage: Any,
    fields: Any,
    motion: Motion,
    twists: Any,
    physics: Physics,
    robots: Robot | None = None,
    force: bool = False,
) -> Recording:
    """Step worlds with twists (T, n, 3) of their bases; JAX can trace this."""

    def step(motion: Motion, twist: Any) -> tuple[Motion, Any]:
        period = ControlPeriod(Twist(*twist.T), physics, robots, force)
        driven = stage.drive(fields, motion, period)
        return driven.motion, (driven.motion.qpos, driven.motion.qvel, driven.force)

    qpos, qvel, wrench = jax.lax.scan(step, motion, twists)[1]
    join = lambda first, rest: jnp.concatenate([first[None], rest])  # noqa: E731
    return Recording(join(motion.qpos, qpos), join(motion.qvel, qvel), wrench)


# Compiled once for worlds of one family in one physics.
_drive = jax.jit(drive, static_argnames=("physics", "force"))


def simulate(
    engine: str,
    stage: Any,
    fields: Any,
    qpos: np.ndarray,
    twist: Any,
    physics: Physics,
    periods: int,
    robots: Robot | None = None,
    qvel: np.ndarray | None = None,
) -> Recording:
    """Step worlds from positions (n, 10) and velocities (n, 9) with a constant twist (n, 3)."""
    count = len(qpos)
    qvel = np.zeros((count, 9)) if qvel is None else qvel
    twist = np.broadcast_to(np.asarray(twist, float), (count, 3))
    if not engines.get(engine).traced:
        batch = Batch(stage, qpos, 2, robots, **fields)
        batch.qvel[:] = qvel
        states = [(batch.qpos.copy(), batch.qvel.copy(), batch.force.copy())]
        for _ in range(periods):
            batch.drive(np.arange(count), twist, physics.substeps)
            states.append((batch.qpos.copy(), batch.qvel.copy(), batch.force.copy()))
        batch.close()
        positions, velocities, force = map(np.stack, zip(*states, strict=True))
        return Recording(positions, velocities, force[1:])
    fields, robots, qpos, qvel = jax.tree.map(
        lambda x: jnp.asarray(x, float), (fields, robots, qpos, qvel)
    )
    motion = Motion(qpos, qvel, 0 * qvel, None if robots is None else jnp.zeros((count, 3)))
    twists = jnp.broadcast_to(jnp.asarray(twist), (periods, count, 3))
    force = engines.get(engine).computes_force
    recording = _drive(stage, fields, motion, twists, physics, robots, force)
    return jax.tree.map(lambda x: np.asarray(x, float), recording)


# Physics in which engines agree within fractions of a millimetre.
FINE = Physics(timestep=0.01, control_period=0.01, iterations=30, ls_iterations=20)


def step_in_c(model: Any, qpos: np.ndarray, twist: Sequence[float], steps: int) -> Any:
    """Return the data of C MuJoCo after steps from rest, with a constant twist of the base."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    for _ in range(steps):
        heading = data.qpos[2] + twist[2] * model.opt.timestep / 2  # half way through the step
        c, s = np.cos(heading), np.sin(heading)
        data.qvel[:3] = c * twist[0] - s * twist[1], s * twist[0] + c * twist[1], twist[2]
        mujoco.mj_step(model, data)
    return data


@cache
def push_object(
    engine: str,
    robot: Robot = Robot(),
    seconds: float = 2.0,
    twist: tuple[float, float, float] = (0.05, 0.0, 0.0),
    friction: Friction = FRICTION["S1"],
    yaw: float = 0.0,
    lateral: float = 0.0,
) -> Recording:
    """Push the box at a constant twist from contact, in one world of standard physics."""
    physics = preset()
    loaded = scene.load("box", physics, friction, robot=robot)
    start = scene.initial_qpos(loaded, gap=0.0, yaw=yaw)[None]
    start[0, 4] += lateral
    stage, fields = staged(engine, [loaded], physics, robot)
    robots = jax.tree.map(lambda x: np.asarray(x, float)[None], robot) if robot.driven else None
    periods = round(seconds / physics.control_period)
    recording = simulate(engine, stage, fields, start, twist, physics, periods, robots)
    return Recording(*(x if x is None else x[:, 0] for x in recording))
