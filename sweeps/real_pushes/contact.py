"""Real pushes in C MuJoCo: the triangle on small spheres as feet, pushed by small spheres.

Dry friction has no length: an object four times as large that is pushed four times as far, slowly
enough, ends four times as far. The object is then as large as those that the project's base pushes,
and its ground is made for the speed of that base, so most kinds here are four times as large, at
50 mm/s. Poses that come back are of the true size.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import pandas as pd

from rps_jax.geometry.solid import rotate
from rps_jax.physics import Physics, preset
from rps_jax.world.physics import MUJOCO_GROUND
from sweeps.real_pushes import fingers, pushes

_FINE = 400  # parts of a way, between which fingers go straight
_SETTLE = 0.5  # [s] that the object stands before the push
_RISE = 0.1  # [s] in which fingers reach their speed
_BALL = 2.5e-4  # [m] radius of a finger at the true size
_SOFT = (0.9, 0.95)  # MuJoCo's default impedance


@dataclass(frozen=True)
class Condition:
    """Physics, scale and speed of pushes."""

    label: str
    physics: Physics
    scale: float = 4.0  # of all lengths
    speed: float = 0.05  # [m/s] of the faster finger, at this scale


_OURS = preset("default", "reference")  # converged, in steps of 1 ms
_MUJOCO_GROUND = replace(_OURS, **MUJOCO_GROUND)
_LIGHT = replace(_OURS, ground_solref=(0.1, 0.2), ground_impedance=0.3)
_DEFAULT = replace(_MUJOCO_GROUND, cone="pyramidal", impratio=1.0, base_solref=(0.02, 1.0))
_STIFF = {"base_solref": (0.005, 1.0)}
_TRUE_SIZE = {"scale": 1.0, "speed": 0.0025}
KINDS = {
    "mujoco_ours": Condition("C MuJoCo with feet, our ground", _OURS),
    "mujoco_ours_stiff": Condition("our ground, stiff fingers", replace(_OURS, **_STIFF)),
    "mujoco_ground": Condition("MuJoCo's ground, our cone and impratio", _MUJOCO_GROUND),
    "mujoco_default": Condition("MuJoCo's full default", _DEFAULT),
    "mujoco_light": Condition("ground of (0.1 s, 0.2), impedance 0.3", _LIGHT),
    "mujoco_light_stiff": Condition("that ground, stiff fingers", replace(_LIGHT, **_STIFF)),
    "mujoco_ours_true_size": Condition("our ground, true size, 2.5 mm/s", _OURS, **_TRUE_SIZE),
    "mujoco_light_true_size": Condition("that ground, true size, 2.5 mm/s", _LIGHT, **_TRUE_SIZE),
    "mujoco_ground_true_size": Condition(
        "MuJoCo's ground, true size, 2.5 mm/s", _MUJOCO_GROUND, **_TRUE_SIZE
    ),
}


def push(table: pd.DataFrame, friction: np.ndarray, condition: Condition) -> np.ndarray:
    """Return final poses (n, 3) [m, m, rad] at the true size; friction (n,) of the fingers."""
    paths, start = pushes.finger_paths(table, _FINE), pushes.initial_poses(table)
    surface = table.surface if "surface" in table else [""] * len(table)
    poses = []
    for i, (support, name) in enumerate(zip(table.support, surface, strict=True)):
        ground = pushes.GROUND.get(name, pushes.GROUND["hardboard"])
        model = _model(support, ground, float(friction[i]), condition)
        poses.append(_push_once(model, start[i], paths[:, i], condition))
    return np.array(poses)


def _push_once(
    model: mujoco.MjModel, start: np.ndarray, path: np.ndarray, condition: Condition
) -> np.ndarray:
    """Return the final pose (3,) of a push along finger paths (T + 1, 2, 2)."""
    data, k, dt = mujoco.MjData(model), condition.scale, condition.physics.timestep
    moves = np.linalg.norm(np.diff(path, axis=0), axis=-1).max(axis=1)
    along = k * np.concatenate([[0.0], np.cumsum(moves)])
    ball = _ball_offsets(start, path) * k
    # A missing finger is far away, but near enough for accurate floats.
    at = np.where(np.abs(path) > 100, 50.0, k * path + ball)
    half = start[2] / 2
    data.qpos[:4] = at[0].ravel()
    data.qpos[4:] = [*(k * start[:2]), 0.0, np.cos(half), 0.0, 0.0, np.sin(half)]
    for _ in range(round(_SETTLE / dt)):
        data.qvel[:4] = 0.0
        mujoco.mj_step(model, data)
    steps = int(np.ceil((along[-1] / condition.speed + _RISE / 2) / dt))
    time = dt * np.arange(1, steps + 1)
    rising = time * time / (2 * _RISE)
    travelled = condition.speed * np.where(time < _RISE, rising, time - _RISE / 2)
    coordinates = at.reshape(len(at), 4).T
    positions = np.stack([np.interp(travelled, along, x) for x in coordinates], axis=1)
    for goal in positions:
        data.qvel[:4] = (goal - data.qpos[:4]) / dt
        mujoco.mj_step(model, data)
    x, y = data.qpos[4:6] / k
    w, i, j, z = data.qpos[7:]
    yaw = np.arctan2(2 * (w * z + i * j), 1 - 2 * (j * j + z * z))
    return np.array([x, y, yaw])


def _ball_offsets(start: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Return offsets (2, 2) [m] of the balls so that they touch where the points of a path do."""
    yaw = start[2]
    path_in_body = rotate(np.full(path.shape[:2], -yaw), path - start[:2])
    gap, normal = fingers.nearest(pushes.OUTLINE, path_in_body)
    first = np.argmax(gap <= 0, axis=0)
    first = np.where((gap <= 0).any(axis=0), first, gap.argmin(axis=0))
    return _BALL * rotate(np.full(2, yaw), normal[first, [0, 1]])


@functools.lru_cache(maxsize=64)
def _model(support: str, ground: float, friction: float, condition: Condition) -> mujoco.MjModel:
    """Return the model of the triangle on its feet and two fingers with given velocities."""
    k, physics = condition.scale, condition.physics
    corners = [(*c, z) for z in (0.0, pushes.HEIGHT) for c in pushes.OUTLINE]
    mesh = " ".join(f"{k * x:.9g}" for corner in corners for x in corner)
    feet = [k * np.array([*foot, 0.0]) for foot in pushes.feet_of(support)]
    is_default = physics == _DEFAULT
    soft = f"{_SOFT[0]} {_SOFT[1]}" if is_default else ""
    touch = f'solref="{physics.base_solref[0]} {physics.base_solref[1]}"'
    touch += f' solimp="{soft}"' if is_default else ""
    impedance = soft if is_default else f"{physics.ground_impedance} {physics.ground_impedance}"
    floor = f'solref="{physics.ground_solref[0]} {physics.ground_solref[1]}" solimp="{impedance}"'
    spheres = "".join(
        f'<geom name="foot{i}" type="sphere" size="1e-6" mass="0" pos="{x:.9g} {y:.9g} {z:.9g}"/>'
        for i, (x, y, z) in enumerate(feet)
    )
    fingers = "".join(
        f'<body pos="0 0 {k * pushes.PUSHED_AT}"><joint type="slide" axis="1 0 0" armature="1e6"/>'
        f'<joint type="slide" axis="0 1 0" armature="1e6"/><geom name="finger{i}" type="sphere" '
        f'size="{k * _BALL}" mass="1"/></body>'
        for i in range(2)
    )
    pairs = "".join(
        f'<pair geom1="ground" geom2="foot{i}" condim="3" friction="{ground} {ground}" {floor}/>'
        for i in range(len(feet))
    ) + "".join(
        f'<pair geom1="finger{i}" geom2="object" condim="3" friction="{friction} {friction}" '
        f"{touch}/>"
        for i in range(2)
    )
    return mujoco.MjModel.from_xml_string(f"""
<mujoco>
  <option timestep="{physics.timestep}" cone="{physics.cone}" impratio="{physics.impratio}"
   iterations="{physics.iterations}" ls_iterations="{physics.ls_iterations}"
   tolerance="{physics.tolerance}"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <asset><mesh name="object" vertex="{mesh}"/></asset>
  <worldbody>
    <geom name="ground" type="plane" size="0 0 1"/>
    {fingers}
    <body name="object"><freejoint/>
      <geom name="object" type="mesh" mesh="object" mass="{pushes.MASS * k**3}"/>{spheres}</body>
  </worldbody>
  <contact>{pairs}</contact>
</mujoco>""")
