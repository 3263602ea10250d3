"""Single straight pushes in C MuJoCo on many grounds, beside those of the rigid limit.

An object stands before the base, off its middle. A box stands askew: the base drives 0.5 m straight
ahead, and the box turns until its side lies on the base's front. Before a cylinder the base drives
askew, and the cylinder rolls along its front. Where on the front the object ends depends on
friction alone, and so a ground can be judged by it.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
import numpy.typing as npt

from rps_jax import Robot
from rps_jax.geometry import solid
from rps_jax.geometry.solid import GRAVITY, Solid
from rps_jax.physics import FRICTION, Physics
from rps_jax.world import scene
from rps_jax.world.scene import JOINTS
from sweeps.ground import rigid
from sweeps.ground.rigid import Pushed, Rounding

DISTANCE = 0.5  # [m] that the base drives
GAP = 0.001  # [m] between base and object at the start
OFFSETS = (0.05, 0.08, 0.12)  # [m] of the object from the base's middle, to its left
ASKEW = 0.3  # [rad] by which a box is turned at the start, and the way before a cylinder
SPEEDS = (0.01, 0.05, 0.2)  # [m/s] of the base
STEPS = 500  # of the rigid limit in a push: half of them change the end by 0.1 mm
CONTACT_HEIGHT = 0.2  # [m] of the middle of the base's front
_RISE = 0.5  # [m/s^2] at which the base reaches its speed
_SETTLE = 1.0  # [s] that the object stands before the push
_SAMPLE = 0.01  # [s] between two looks at the contacts


class Target(NamedTuple):
    """Object to push."""

    family: str
    solid: Solid  # leaves (1, ...)
    yaw: float = 0.0  # [rad] at the start
    bearing: float = 0.0  # [rad] of the base's way, to its left

    @property
    def direction(self) -> tuple[float, float]:
        """Direction of the base, a unit vector in its axes."""
        return math.cos(self.bearing), math.sin(self.bearing)


class Pushes(NamedTuple):
    """Results of pushes (...); NaN for quantities that a rigid object lacks."""

    lateral: np.ndarray  # [m] of the object's middle to the left of the base's, at the end
    force: np.ndarray  # [1] push along the base's way over mu m g, mean of the second half
    spread: np.ndarray  # [1] its standard deviation from step to step over its mean
    height: np.ndarray  # [m] above the ground at which the base pushes, mean over the turn
    borne: np.ndarray  # [1] share of the weight that the base's friction bears, mean
    aloft: np.ndarray  # [1] share of the time with less than a tenth of the weight on the ground
    hop: np.ndarray  # [m] highest rise of the object's middle from where it stood


NOTHING = Pushes(*np.full(len(Pushes._fields), np.nan))  # of a push that diverged, or did not run


def targets() -> dict[str, Target]:
    """Return the paper's box (40 cm) and cylinder, and a box of 60 cm of equal height and mass."""
    box, cylinder = (scene.solid_of(scene.load(name)) for name in ("box", "cylinder"))
    half = np.array([0.3])
    mass = (half * 0 + 20.0, *np.zeros((3, 1)))
    wide = solid.build(solid.rectangles(half, half), 0 * half, box.height, *mass)
    return {
        "box": Target("box", box, yaw=ASKEW),
        "box_60": Target("box", wide, yaw=ASKEW),
        "cylinder": Target("cylinder", cylinder, bearing=ASKEW),
    }


def scene_of(target: Target, physics: Physics) -> Any:
    """Compile the scene of pushes of an object."""
    single = jax.tree.map(lambda leaf: leaf[0], target.solid)
    return scene.compile_solid(target.family, single, physics)


def start_of(target: Target, offset: float) -> np.ndarray:
    """Return the pose (3,) [m, m, rad] of the object's origin before the base's front."""
    reach = float(solid.extent(target.solid, np.array([target.yaw]))[0])
    return np.array([GAP + reach, offset, target.yaw])


# --- in C MuJoCo ----------------------------------------------------------------------------


@contextlib.contextmanager
def _unwarned() -> Iterator[None]:
    """Suppress MuJoCo's warnings: a diverged push is an outcome."""
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)


@_unwarned()
def in_mujoco(target: Target, offset: float, speed: float, physics: Physics) -> Pushes:
    """Run one push in C MuJoCo at a speed [m/s] of a settled object; NaN if it diverges.

    The base accelerates at 0.5 m/s^2 and keeps its speed at any force.
    """
    chosen = scene_of(target, physics)
    model, dt = chosen.physics, physics.timestep
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # it may diverge
    data = mujoco.MjData(model)
    height, friction = float(target.solid.height[0]), FRICTION["S1"].ground
    x, y, yaw = start_of(target, offset)
    free = JOINTS.object
    data.qpos[:] = scene.initial_qpos(chosen)
    quaternion = [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]
    data.qpos[free] = [x + Robot().half_length, y, height / 2, *quaternion]
    for _ in range(round(_SETTLE / dt)):
        data.qvel[JOINTS.base] = 0.0
        mujoco.mj_step(model, data)
    stood = data.qpos[free][2].copy()
    rising = speed / _RISE
    steps = round((DISTANCE / speed + rising / 2) / dt)
    force, way = np.zeros(steps), np.zeros(steps)
    rise = np.zeros(steps)
    interval = max(1, round(_SAMPLE / dt))
    samples = []
    qpos, qvel, constraint = data.qpos, data.qvel, data.qfrc_constraint
    c, s = target.direction
    for i in range(steps):
        pace = speed * min(1.0, (i + 0.5) * dt / rising)
        qvel[0], qvel[1], qvel[2] = c * pace, s * pace, 0.0
        mujoco.mj_step(model, data)
        force[i] = -c * constraint[0] - s * constraint[1]
        way[i] = c * qpos[0] + s * qpos[1]
        rise[i] = qpos[5]
        if i % interval == 0:
            samples.append((*_contact_forces(model, data), 2 * math.atan2(qpos[9], qpos[6])))
            if not abs(qpos[5]) < height:
                return NOTHING  # it diverged
    weight = float(target.solid.mass[0]) * GRAVITY
    late = force[way > DISTANCE / 2] / (friction * weight)
    ground, pushing, moment, carried, turned = np.array(samples).T
    turning = np.abs(np.diff(turned, append=turned[-1]))
    result = Pushes(
        lateral=qpos[4] - qpos[1],
        force=late.mean(),
        spread=late.std() / late.mean(),
        height=np.sum(turning * moment) / max(np.sum(turning * pushing), 1e-9),
        borne=carried.mean() / weight,
        aloft=np.mean(ground < 0.1 * weight),
        hop=rise.max() - stood,
    )
    return Pushes(*(np.asarray(value, float) for value in result))


def _contact_forces(
    model: mujoco.MjModel, data: mujoco.MjData
) -> tuple[float, float, float, float]:
    """Return load on the ground and push [N], moment of the push [N m], lift of the base [N]."""
    plane = model.geom("ground").id
    ground = pushing = moment = carried = 0.0
    out = np.zeros(6)
    for i in range(data.ncon):
        contact = data.contact[i]
        if contact.efc_address < 0:
            continue
        mujoco.mj_contactForce(model, data, i, out)
        if plane in (contact.geom1, contact.geom2):
            ground += out[0]
            continue
        frame = contact.frame.reshape(3, 3)
        total = frame.T @ out[:3]
        sign = 1.0 if frame[0, 0] > 0 else -1.0  # on the object, before the base
        pushing += out[0]
        moment += out[0] * contact.pos[2]
        carried += sign * total[2]
    return ground, pushing, moment, carried


# --- in the rigid limit ---------------------------------------------------------------------


def in_the_limit(
    target: Target,
    offset: npt.ArrayLike = OFFSETS,
    height: npt.ArrayLike = CONTACT_HEIGHT,
    friction_robot: npt.ArrayLike = FRICTION["S1"].robot,
    *,
    steps: int = STEPS,
    rounding: Rounding = Rounding(),
) -> Pushes:
    """Push a rigid object in the same ways (B,), at offsets [m], heights [m] and frictions [1]."""
    offset, height, robot = np.broadcast_arrays(offset, height, friction_robot)
    count = offset.size
    solids = jax.tree.map(lambda leaf: np.repeat(leaf, count, axis=0), target.solid)
    ground = np.full(count, FRICTION["S1"].ground)
    pushed = Pushed(solids, ground, robot, height)
    pose = np.array([start_of(target, float(x)) for x in offset])
    way = rigid.push(pushed, pose, DISTANCE, steps, direction=target.direction, rounding=rounding)
    push = way.force @ np.array(target.direction) / ground
    late = push[steps // 2 :]
    none = dict.fromkeys(("borne", "aloft", "hop"), np.zeros(count))
    return Pushes(
        lateral=way.pose[-1, :, 1],
        force=late.mean(axis=0),
        spread=late.std(axis=0) / late.mean(axis=0),
        height=height,
        **none,
    )
