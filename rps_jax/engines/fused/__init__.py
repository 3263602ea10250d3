"""The fused engine: MuJoCo's equations, specialised to these scenes and written out in scalars.

`contacts` finds the contacts, `newton` solves for the accelerations, `step` integrates.
"""

from __future__ import annotations

import functools

import numpy as np

from rps_jax.engines import device
from rps_jax.engines.base import Engine
from rps_jax.engines.fused.contacts import Body
from rps_jax.engines.fused.step import FusedStage
from rps_jax.geometry import solid
from rps_jax.world import scene
from rps_jax.world.physics import Physics
from rps_jax.world.scene import OFF_CENTRE, WorldInputs

_MAX_ON_PROCESSORS = 500  # trials that processors finish sooner than a GPU


class Fused(Engine):
    """MJX's equations, specialised to these scenes: the fastest engine on every device."""

    name = "fused"
    side_by_side = True
    modes = ("forward", "reverse")

    def stage(self, inputs: WorldInputs) -> tuple[FusedStage, Body]:
        """Return the stage, and the bodies (n, ...) of the worlds."""
        solids, (friction, physics, robots) = inputs.solids, inputs[2:5]
        com, axes = solids.p_object_com + OFF_CENTRE, solid.axes(solids)
        base_invweight, base_z = _base(physics)
        if robots.driven:
            base_invweight = scene.base_invweight(robots)

        def lower(points: np.ndarray) -> np.ndarray:
            """Return points (n, N, 2) of the lower face in the body's frame."""
            z = np.broadcast_to(-solids.height[:, None, None] / 2, (*points.shape[:2], 1))
            return (np.concatenate([points, z], axis=-1) - com[:, None]) @ axes

        bodies = Body(
            mass=solids.mass,
            inertia=solids.inertia,
            p_object_com=com,
            q_object_body=solids.q_object_body,
            vertices=lower(solids.vertices),
            radius=solids.radius,
            height=solids.height,
            up=axes[:, 2],
            friction_ground=friction.ground,
            friction_robot=friction.robot,
            invweight=1 / solids.mass,
            base_invweight=np.broadcast_to(base_invweight, solids.mass.size),
            base_size=scene.base_size(robots, solids.mass.size),
            base_z=np.broadcast_to(base_z, (solids.mass.size, 2)),
            gravity=inputs.surroundings.slope,
            boundary=inputs.surroundings.boundary,
        )
        if solids.feet is not None:
            feet = lower(solids.feet[..., :2])
            weights = solids.feet[..., 2:]
            weights = np.sign(weights) if solids.pads is None else weights
            bodies = bodies._replace(feet=feet, foot_weight=weights, pads=solids.pads)
        around = inputs.surroundings
        if around.walls is not None:
            ends = around.walls.reshape(inputs.num_worlds, -1, 4)
            bodies = bodies._replace(walls=ends, friction_wall=around.friction_wall)
        return FusedStage(), bodies

    def slots(self, backend: str) -> int:
        """Return the number of worlds that one worker steps at once."""
        return 64 if backend == "cpu" else 32768

    def suits_processors(self, trials: int | None) -> bool:
        """Whether there are few trials and a C compiler: a GPU takes some 5 s to start."""
        few = trials is not None and trials <= _MAX_ON_PROCESSORS
        return few and device.find_compiler() is not None


@functools.cache
def _base(physics: Physics) -> tuple[float, np.ndarray]:
    """Return the inverse weight [1/kg] of the base, and the heights (2,) [m] of its edges."""
    model = scene.load("box", physics).physics
    body, geom = model.body("base"), model.geom("base")
    z = geom.pos[2] + geom.size[2] * np.array([-1.0, 1.0])
    return model.body_invweight0[body.id, 0], z


ENGINE = Fused()
