"""A draw becomes worlds, for every engine and for pictures."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rps_jax import engines
from rps_jax.control import strategies
from rps_jax.control.strategies import Params
from rps_jax.engines.mjx import apply
from rps_jax.engines.mjx_colliders import mjx
from rps_jax.geometry import solid
from rps_jax.geometry.footprint import Footprint
from rps_jax.robot.base import Odometry
from rps_jax.robot.skin import CapacitiveSkin, IdealSkin, Skin
from rps_jax.trials.batch import Part
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Shift, World
from rps_jax.world import draws, scene
from rps_jax.world.domain import DOMAINS, OF_THE_BASE, PERFECT, RANDOM, Domain
from rps_jax.world.draws import Draw
from rps_jax.world.physics import Physics
from rps_jax.world.scene import JOINTS, Friction, Scene


def domain_randomize(
    model: mjx.Model, rng: jax.Array, domain: Domain = DOMAINS["wide"]
) -> tuple[mjx.Model, mjx.Model]:
    """Models of random objects for a loop of one's own, as mujoco_playground has them.

    Args:
      model: of a random object's scene, as `mjx.put_model(scene.shaped(...).physics)` gives it.
      rng: keys (n, 2), one a world.
      domain: ranges of the object's mass, size, centre of mass and friction.

    Returns:
      The model with its fields batched, (n, ...), and which of them are: 0, the others None, for
      `jax.vmap(..., in_axes=(in_axes, ...))`. Not to be traced: it works on the host.
    """
    family = _family_of(model)
    (name,) = [name for name, of in RANDOM.items() if of == family]
    keys = np.asarray(rng, np.uint32).astype(object)
    numbers = np.stack(
        [draws.numbers_of(int(a) << 32 | int(b), np.zeros(1, int))[0] for a, b in keys]
    )
    alone = replace(domain, objects=(name,), frictions=(), targets=())
    drawn = draws.drawn_at(alone, np.zeros(len(keys), int), numbers)
    _, own = engines.get("mjx").stage_of_solids(family, drawn.solid, drawn.friction, Physics())
    dtype = model.body_mass.dtype
    batched = apply(model, {k: jnp.asarray(v, dtype) for k, v in own.items()})
    in_axes = jax.tree_util.tree_map_with_path(
        lambda path, _: 0 if jax.tree_util.keystr(path) in own else None, model
    )
    return batched, in_axes


def _family_of(model: mjx.Model) -> str:
    """The shape family of an MJX model's object."""
    kinds = {int(kind) for kind in model.geom_type}
    if int(mujoco.mjtGeom.mjGEOM_MESH) in kinds:
        return "prism"
    return "cylinder" if int(mujoco.mjtGeom.mjGEOM_CYLINDER) in kinds else "box"


def drawn_worlds(domain: Domain, drawn: Draw, params: Params, setting: Setting) -> Part:
    """The worlds of a draw as a part of a job, all with the same parameters."""
    family = domain.family_of(drawn.case[0])
    count, dtype = drawn.number.size, jnp.zeros(()).dtype
    engine, robots = engines.get(setting.engine), drawn.robot
    engine.check_robot(robots)
    engine.check_senses(strategies.of(params).senses)
    stage, own = engine.stage_of_solids(
        family, drawn.solid, drawn.friction, setting.physics, robots
    )
    world: Any = {
        "fields": own,
        "footprint": Footprint(*_any(drawn.solid.vertices, drawn.solid.radius)),
        "skin": _skin(domain, drawn),
        "params": jax.tree.map(lambda x: np.full((count, *np.shape(x)), x), params),
        "p_world_target": drawn.p_world_target,
        "shift": Shift(*_any(np.full(count, np.inf), np.zeros((count, 2)))),
        "qpos": _starts(drawn),
        "key": drawn.key,
        "odometry": _odometry(domain, drawn, setting.physics.control_period),
        "robot": None if robots.ideal else robots,
    }
    narrow = jax.tree.map(lambda x: x if x.dtype == np.uint32 else x.astype(dtype), world)
    return Part(drawn.number, World(**narrow), stage)


def _any(*arrays: Any) -> tuple[Any, ...]:
    """Host arrays where a type asks for those of the device."""
    return arrays


def _skin(domain: Domain, drawn: Draw) -> Skin:
    count = drawn.number.size
    plain = IdealSkin() if domain.skin == "ideal" else CapacitiveSkin()
    full: Any = jax.tree.map(lambda value: np.full(count, value, float), plain)
    if isinstance(full, IdealSkin):
        return full.on(drawn.robot.shell)
    return full.on(drawn.robot.shell)._replace(
        noise=drawn.noise, gain_spread=drawn.gain_spread, dead_share=drawn.dead_share
    )


def _starts(drawn: Draw) -> np.ndarray:
    """Positions (n, 10) at the start: the base at the origin, the object before it."""
    qpos = np.zeros((drawn.number.size, 10))
    front = drawn.robot.half_length + drawn.gap + solid.extent(drawn.solid, drawn.yaw)
    half = drawn.yaw / 2
    zero = np.zeros_like(half)
    place = [front, drawn.lateral, drawn.solid.height / 2, np.cos(half), zero, zero, np.sin(half)]
    qpos[:, JOINTS.object] = np.stack(place, axis=-1)
    return qpos


def remembered_steps(domain: Domain, period: float) -> int:
    """How many control steps of `period` [s] the odometry of the domain's worlds looks back."""
    if all(getattr(domain, name) == PERFECT[name] for name in OF_THE_BASE):
        return 0
    return 1 + round(max(domain.pose_latency.high, domain.command_delay.high) / period)


def _odometry(domain: Domain, drawn: Draw, period: float) -> Odometry:
    past = np.zeros((drawn.number.size, remembered_steps(domain, period)))
    return Odometry(*_any(*(getattr(drawn, name) for name in OF_THE_BASE), past))


def drawn_scene(domain: Domain, drawn: Draw, physics: Physics, i: int) -> Scene:
    """The compiled scene of the i-th world of a draw, for pictures: with its looks, if it has."""
    case = int(drawn.case[i])
    name = domain.objects[int(domain.object_of(drawn.case[i]))]
    if name in RANDOM:
        robots = drawn.robot
        return scene.of_solid(
            domain.family_of(case), drawn.solid, drawn.friction, physics, i, robots
        )
    ground, robot = (float(leaf[i]) for leaf in drawn.friction)
    return scene.load(name, physics, Friction(ground, robot), robot=domain.robot)
