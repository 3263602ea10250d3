"""The fused engine: MuJoCo's equations, specialised to these scenes and written out in scalars.

`contacts` finds the contacts, `newton` solves for the accelerations, `step` integrates.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from rps_jax.engines import device
from rps_jax.engines.base import ControlPeriod, Driven, Engine, Motion
from rps_jax.engines.fused import step
from rps_jax.engines.fused.contacts import Body
from rps_jax.geometry import solid
from rps_jax.geometry.solid import Solid
from rps_jax.robot.robot import Robot
from rps_jax.world import scene
from rps_jax.world.physics import Physics
from rps_jax.world.scene import OFF_CENTRE, Friction

_MAX_ON_PROCESSORS = 500  # trials that processors finish sooner than a GPU


class FusedStage(NamedTuple):
    """Stage of the fused engine, whose worlds share nothing."""

    native = True

    def drive(self, fields: Body, motion: Motion, period: ControlPeriod) -> Driven:
        """Step a batch for one control period."""
        return step.drive(fields, motion, period)


class Fused(Engine):
    """MJX's equations, specialised to these scenes: the fastest engine on every device."""

    name = "fused"
    side_by_side = True
    modes = ("forward",)

    def stage(
        self,
        family: str,
        solids: Solid,
        friction: Friction,
        physics: Physics,
        robots: Robot = Robot(),
    ) -> tuple[FusedStage, Body]:
        """Return the stage, and the bodies (n, ...) of the worlds."""
        bodies = bodies_of(solids, friction, _template(physics))
        bodies = bodies._replace(base_half=scene.base_half(robots, solids.mass.size))
        if robots.driven:
            bodies = bodies._replace(base_invweight=scene.base_invweight(robots))
        return FusedStage(), bodies

    def slots(self, backend: str) -> int:
        """Return the number of worlds that one worker steps at once."""
        return 64 if backend == "cpu" else 16384

    def workers(self, backend: str) -> int:
        """Return 2 for a GPU, which steps the worlds of one while the host serves the other."""
        return super().workers(backend) if backend == "cpu" else 2

    def suits_processors(self, trials: int | None) -> bool:
        """Whether there are few trials and a C compiler: a GPU takes some 5 s to start."""
        few = trials is not None and trials <= _MAX_ON_PROCESSORS
        return few and device.find_compiler() is not None


@functools.cache
def _template(physics: Physics) -> Body:
    """Return a body whose constants of the base are used."""
    box = scene.load("box", physics)
    return step.body(box.physics, box.solid.vertices)


def _on_feet(bodies: Body, solids: Solid) -> Body:
    """Return bodies (n, ...) that stand on the feet of solids, if these have feet."""
    if solids.feet is None:
        return bodies
    low = np.broadcast_to(-solids.height[:, None, None] / 2, (*solids.feet.shape[:2], 1))
    feet = np.concatenate([solids.feet[..., :2], low], axis=-1)
    feet = (feet - bodies.p_object_com[:, None, :]) @ solid.axes(solids)
    return bodies._replace(feet=feet, bears=np.sign(solids.feet[..., 2:]))


def bodies_of(solids: Solid, friction: Friction, template: Body) -> Body:
    """Return the bodies of solids, with the base of `template`."""
    com = solids.p_object_com + OFF_CENTRE
    corners = np.concatenate(
        [
            solids.vertices,
            np.broadcast_to(-solids.height[:, None, None] / 2, (*solids.vertices.shape[:2], 1)),
        ],
        axis=-1,
    )
    axes = solid.axes(solids)
    invweight, half, z = (
        np.broadcast_to(x, (solids.mass.size, *np.shape(x)))
        for x in (template.base_invweight, template.base_half, template.base_z)
    )
    bodies = Body(
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
        base_invweight=invweight,
        base_half=half,
        base_z=z,
    )
    return _on_feet(bodies, solids)


ENGINE = Fused()
