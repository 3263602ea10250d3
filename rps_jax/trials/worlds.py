"""Builders of worlds: of any solids, of draws, and their scenes for pictures."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.geometry import solid
from rps_jax.geometry.footprint import Footprint
from rps_jax.robot.base import Odometry
from rps_jax.robot.skin import CapacitiveSkin, IdealSkin, Skin
from rps_jax.trials.jobs import WorldBatch
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Shift, World
from rps_jax.world import scene
from rps_jax.world.domain import RANDOM, Domain, Owner, Range, quantities_of
from rps_jax.world.draws import Draw
from rps_jax.world.physics import Physics
from rps_jax.world.scene import JOINTS, Friction, Scene, WorldInputs


def build(indices: np.ndarray, inputs: WorldInputs, setting: Setting, **fields: Any) -> WorldBatch:
    """Return worlds of one shape family, staged for the engine: on the host, without parameters.

    Args:
      indices: (n,) of the trials.
      inputs: of all engines.
      setting: engine and physics.
      fields: of `World`, (n, ...) each, beside those that follow from solids and robots.

    Raises:
      InputError: the engine cannot step such a robot, or such surroundings.
    """
    engine, dtype = setting.simulator, jnp.result_type(float)
    engine.check_robot(inputs.robots)
    inputs = inputs.supported
    engine.check_pads(inputs.solids, setting.physics)
    added = getattr(fields.get("task"), "surroundings", None) or {}
    inputs = inputs._replace(surroundings=inputs.surroundings._replace(**added))
    engine.check_surroundings(inputs.surroundings)
    friction = inputs.surroundings.friction_wall
    if friction is not None and setting.physics.cone == "pyramidal" and min(friction) < 0.01:
        rule = "a friction pyramid needs at least 0.01; choose physics=default"
        raise errors.not_allowed("task friction_wall", f"{min(friction):g}", rule)
    stage, staged = engine.stage(inputs)
    outline: Any = inputs.solids.vertices, inputs.solids.radius
    robot = None if inputs.robots.ideal else inputs.robots
    world = World(fields=staged, footprint=Footprint(*outline), robot=robot, **fields)
    narrow = jax.tree.map(lambda x: x if x.dtype == np.uint32 else x.astype(dtype), world)
    return WorldBatch(indices, narrow, stage)


def drawn_worlds(
    domain: Domain, drawn: Draw, setting: Setting, remembered: int | None = None
) -> WorldBatch:
    """Return the worlds of a draw, on the host, without law parameters.

    Their odometry remembers as many control steps as the domain needs, or `remembered`.
    """
    count = drawn.indices.size
    if remembered is None:
        remembered = remembered_steps(domain, setting.physics.control_period)
    odometry = _drawn(drawn, "base") | {"velocity_error": drawn.velocity_error}
    return build(
        drawn.indices,
        drawn.inputs(domain, setting.physics),
        setting,
        skin=_skin(domain, drawn),
        p_world_target=drawn.p_world_target,
        task=drawn.course,
        shift=Shift(np.full(count, np.inf), np.zeros((count, 2))),
        qpos=starts(drawn),
        key=drawn.key,
        odometry=Odometry(**odometry, past=np.zeros((count, remembered))),
    )


def _drawn(drawn: Draw, owner: Owner) -> dict[str, Any]:
    """Return the drawn quantities of an owner by name."""
    return {name: drawn.values[name] for name in quantities_of(owner) if name in drawn.values}


def _skin(domain: Domain, drawn: Draw) -> Skin:
    sensor = IdealSkin() if domain.skin == "ideal" else CapacitiveSkin()
    repeated: Any = jax.tree.map(lambda x: np.full(drawn.indices.size, x, float), sensor)
    quantities = {} if domain.skin == "ideal" else _drawn(drawn, "skin")
    return repeated._replace(shell=drawn.robot.shell, **quantities)


def soften_skins(worlds: World) -> World:
    """Return worlds, or one, with smooth skins, unless these have a temperature."""
    skin, shape = worlds.skin, jnp.shape(worlds.p_world_target)[:-1]
    if skin.temperature is not None:
        return worlds
    return worlds._replace(skin=skin._replace(temperature=jnp.full(shape, skin.SMOOTH)))


def starts(drawn: Draw) -> np.ndarray:
    """Return start positions (n, 10): the base at the origin, the object in front of it."""
    qpos, yaw = np.zeros((drawn.indices.size, 10)), drawn.values["yaw"]
    front = drawn.robot.sizes[0] + drawn.values["gap"] + solid.extent(drawn.solid, yaw)
    position = np.stack([front, drawn.values["lateral"], drawn.solid.height / 2], axis=-1)
    qpos[:, JOINTS.object] = np.concatenate([position, solid.quaternion(yaw)], axis=-1)
    return qpos


def remembered_steps(domain: Domain, period: float) -> int:
    """Return the number of control steps of `period` [s] that the odometry remembers."""
    if all(domain.range_of(name) in (None, Range(0, 0)) for name in quantities_of("base")):
        return 0
    return 1 + round(max(domain.pose_latency.high, domain.command_delay.high) / period)


def drawn_scene(domain: Domain, drawn: Draw, physics: Physics, i: int) -> Scene:
    """Compile the scene of row i of a draw, for pictures; named objects keep their visual geoms."""
    case = int(drawn.cases[i])
    name = domain.objects[int(domain.object_of(case))]
    if name in RANDOM:
        return scene.compile_row(drawn.inputs(domain, physics), i)
    ground, robot = (float(leaf[i]) for leaf in drawn.friction)
    return scene.load(name, physics, Friction(ground, robot), robot=domain.robot)
