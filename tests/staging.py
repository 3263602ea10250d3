"""Worlds of test scenes: staged by an engine, and as MuJoCo compiles each of them."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from rps_jax import engines
from rps_jax.engines import mjx as mjx_engine
from rps_jax.engines.fused.step import body
from rps_jax.engines.quasistatic import sliders
from rps_jax.geometry import solid
from rps_jax.robot.robot import Robot
from rps_jax.world.physics import Physics
from rps_jax.world.scene import Friction, Scene


def staged(
    engine: str, scenes: Sequence[Scene], physics: Physics, robot: Robot = Robot()
) -> tuple[Any, Any]:
    """Stage and fields of worlds in scenes of one shape family."""
    pairs = [[one.physics.pair(i) for i in range(one.physics.npair)] for one in scenes]
    slide = [{pair.name.partition("_")[0]: pair.friction[0] for pair in some} for some in pairs]
    friction = Friction(*(np.array([one[name] for one in slide]) for name in ("ground", "base")))
    solids = solid.stack([one.solid for one in scenes])
    return engines.get(engine).stage(scenes[0].family, solids, friction, physics, robot)


def recompiled(engine: str, scenes: Sequence[Scene]) -> Any:
    """Fields of worlds by what MuJoCo compiled for each, to compare with those of a stage."""
    models = [one.physics for one in scenes]
    if engine == "mjx":
        return jax.device_get(mjx_engine.stack(models)[1])
    if engine == "quasistatic":
        half = np.array([model.geom("base").size[:2] for model in models])
        friction = np.array([model.pair("base_object").friction[0] for model in models])
        return sliders(solid.stack([one.solid for one in scenes]), friction, half)
    bodies = [body(one.physics, one.solid.vertices) for one in scenes]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *bodies)
