"""Scenes: `mjcf/` -> a MuJoCo model for looking at, and one stripped to the physics for stepping.

The physics model holds the three geoms that touch and nothing else; it is what C MuJoCo and MJX
both step.
"""

import math
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rps_jax import errors
from rps_jax.geometry import solid
from rps_jax.geometry.footprint import Footprint
from rps_jax.geometry.solid import Solid
from rps_jax.robot.robot import Robot
from rps_jax.robot.shell import Shell
from rps_jax.world import objects
from rps_jax.world.objects import FAMILIES, OBJECTS, SHAPES, path_of
from rps_jax.world.physics import PHYSICS, Physics

Side = Literal["near", "far"]
SIDES = ("near", "far")
# An inertial frame off by this [m] keeps MuJoCo from compiling centred bodies to a structure of
# their own, which could not be batched with the others.
OFF_CENTRE = 1e-6


class Friction(NamedTuple):
    """Coulomb coefficients of the two contacts."""

    ground: Any  # [1] object-ground; a number, or (n,) of many worlds
    robot: Any  # [1] object-robot


FRICTION = {"S1": Friction(0.3, 0.35), "S2": Friction(0.2, 0.5)}  # Table I


class Scene(NamedTuple):
    """One object before the robot."""

    name: str
    family: str
    model: mujoco.MjModel  # everything, for pictures
    physics: mujoco.MjModel  # the three geoms that touch, for stepping
    solid: Solid  # of the object; leaves without a leading axis
    shell: Shell  # of the robot

    @property
    def footprint(self) -> Footprint:
        """Outline of the object, in JAX's precision."""
        return Footprint(
            jnp.asarray(self.solid.vertices, float), jnp.asarray(self.solid.radius, float)
        )

    @property
    def rounded_solid(self) -> Solid:
        """The solid with its outline in JAX's precision, that of the footprint."""
        return self.solid._replace(vertices=np.asarray(self.footprint.vertices, float))


class Joints(NamedTuple):
    """Where the joints are in qpos and qvel; the same in every scene and in both models."""

    base: slice = slice(0, 3)  # x, y [m], yaw [rad] in the world
    object: slice = slice(3, 10)  # position [m] and quaternion, scalar first


JOINTS = Joints()


def load(
    name: str,  # of an object, as `objects.OBJECTS` has them
    physics: Physics = PHYSICS["default"]["standard"],
    friction: Friction = FRICTION["S1"],
    *,
    rear: Side = "near",  # where the nonuniform box's load stands: "rear left corner", the paper
    mass: float | None = None,  # [kg], its inertia scaled along; None: the object's own
    robot: Robot = Robot(),  # contact can slow and stop it, if its force is limited
) -> Scene:
    """Compile a scene of an object.

    Raises:
      InputError: unknown name, or friction or mass that is not a positive finite number.
    """
    errors.check_name("object", name, OBJECTS)
    errors.check_name("rear", rear, SIDES)
    check(friction, mass)
    if name in objects.REGISTERED:
        return _load_registered(name, physics, friction, mass, robot)
    spec = objects.read(path_of(name))
    for geom in spec.geoms:
        if geom.name == "load" and rear == "far":
            geom.pos[0] = -geom.pos[0]
    if mass is not None:
        geoms = [geom for geom in spec.body("object").geoms if geom.mass > 0]
        total = sum(geom.mass for geom in geoms)
        for geom in geoms:
            geom.mass *= mass / total
    model, stripped = _compile(spec, physics, friction, robot)
    one = _solid_of_model(model, FAMILIES[name])
    return Scene(name, FAMILIES[name], model, stripped, one, robot.shell)


def _solid_of_model(model: mujoco.MjModel, family: str) -> Solid:
    """Return the solid of a compiled box or cylinder that stands on its corners or rim."""
    body, size = model.body("object"), model.geom("object").size
    box = family == "box"
    return Solid(
        vertices=solid.rectangles(size[:1], size[1:2])[0] if box else np.zeros((1, 2)),
        radius=np.asarray(0.0 if box else size[0]),
        height=2 * body.pos[2],
        mass=body.mass[0],
        p_object_com=body.ipos.copy(),
        inertia=body.inertia.copy(),
        q_object_body=body.iquat.copy(),
    )


def _load_registered(
    name: str,
    physics: Physics,
    friction: Friction,
    mass: float | None,
    robot: Robot,
) -> Scene:
    """The looks of a registered object, and the solid that stands for it in the physics."""
    one = objects.REGISTERED[name].solid
    if mass is not None:
        one = one._replace(mass=np.asarray(mass), inertia=one.inertia * mass / one.mass)
    spec = objects.read(path_of(name))
    _set_robot(spec, robot)
    upright = shaped(FAMILIES[name], one, physics, friction, robot=robot)
    return upright._replace(name=name, model=spec.compile())


def shaped(
    family: str,
    one: Solid,
    physics: Physics = PHYSICS["default"]["standard"],
    friction: Friction = FRICTION["S1"],
    *,
    robot: Robot = Robot(),
) -> Scene:
    """Compile a scene with one solid (its leaves without a leading axis) of a shape family."""
    errors.check_name("family", family, SHAPES)
    check(friction, float(one.mass))
    spec = objects.read(path_of(family))
    body = spec.body("object")
    body.pos[2] = one.height / 2
    for geom in list(body.geoms):
        if not geom.name:
            spec.delete(geom)  # the looks of the object that gave the family its file
    for name, size in geom_sizes(family, one).items():
        spec.geom(name).size[: size.size] = size
    if family == "prism":
        _set_corners(spec, one)
    if one.feet is not None and family == "cylinder":
        _add_feet(spec)
    if one.feet is not None or family == "prism":
        for i, foot in enumerate(feet(one)):
            spec.geom(f"foot_{i}").pos = foot
    body.explicitinertial = True
    body.mass, body.ipos = one.mass, one.p_object_com
    body.iquat, body.inertia = one.q_object_body, one.inertia
    models = _compile(spec, physics, friction, robot)
    return Scene(family, family, *models, one, robot.shell)


def of_solid(
    family: str,
    solids: Solid,
    friction: Friction,
    physics: Physics,
    i: int,
    robots: Robot | None = None,
) -> Scene:
    """Compile a scene with the i-th of solids (n, ...), friction and robots (n,) each.

    Without robots, before an ideal one.
    """
    one, pair, robot = jax.tree.map(lambda leaf: leaf[i], (solids, friction, robots))
    friction = Friction(float(pair.ground), float(pair.robot))
    return shaped(family, one, physics, friction, robot=robot or Robot())


def each(robots: Robot, count: int) -> Robot:
    """One robot, or robots (n,), as robots (count,)."""
    if np.ndim(robots.mass):
        return robots
    return jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf, float)[None], count, 0), robots)


def base_half(robots: Robot, count: int) -> np.ndarray:
    """Half length and half width (count, 2) [m] of the bases of robots."""
    half = np.stack([robots.half_length, robots.half_width], axis=-1)
    return np.broadcast_to(np.asarray(half, float), (count, 2))


def base_invweight(robots: Robot) -> np.ndarray:
    """MuJoCo's weight [1/kg] in a contact of bases that can be slowed.

    It is the mean over x, y and z of what a force of 1 N changes; along z the base does not move.
    """
    return 2 / (3 * np.asarray(robots.mass, float))


def geom_sizes(family: str, solids: Solid) -> dict[str, np.ndarray]:
    """Sizes (..., 3) [m], as MuJoCo means them, of the geoms of solids (...)."""
    half = solids.height / 2
    if family == "box":
        corner = solids.vertices[..., 0, :]
        return {"object": np.stack([corner[..., 0], corner[..., 1], half], axis=-1)}
    if family == "cylinder":
        size = np.stack([solids.radius, half, np.zeros_like(half)], axis=-1)
        return {"object": size, "object_side": size}
    return {}  # of a mesh and points


def _set_corners(spec: mujoco.MjSpec, one: Solid) -> None:
    """Give the mesh of a prism its corners."""
    real = np.any(one.vertices != np.roll(one.vertices, 1, axis=0), axis=1)
    half = one.height / 2
    spec.mesh("prism").uservert = np.concatenate(
        [np.column_stack([one.vertices[real], np.full(real.sum(), z)]) for z in (-half, half)]
    ).ravel()


def _add_feet(spec: mujoco.MjSpec) -> None:
    """Give a cylinder feet as a prism has them, and let these alone touch the ground."""
    usual = spec.find_default("ground_object")
    spec.delete(spec.pair("ground_object"))
    for i in range(solid.SIDES):
        spec.body("object").add_geom(
            name=f"foot_{i}", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-6, 0, 0], mass=0, group=3
        )
        pair = {"geomname1": "ground", "geomname2": f"foot_{i}"}
        spec.add_pair(usual, name=f"ground_object_{i}", **pair)


def feet(solids: Solid) -> np.ndarray:
    """Where solids (...) on corners or feet stand, (..., N, 3) [m]; what is no foot is at the top.

    Feet of their own count alike here, whatever their weight.
    """
    at = solids.vertices
    unused = np.all(at == np.roll(at, 1, axis=-2), axis=-1)
    if solids.feet is not None:
        at, unused = solids.feet[..., :2], solids.feet[..., 2] == 0
    half = np.expand_dims(solids.height / 2, -1)
    return np.concatenate([at, np.where(unused, half, -half)[..., None]], axis=-1)


def _compile(
    spec: mujoco.MjSpec,
    physics: Physics,
    friction: Friction,
    robot: Robot,
) -> tuple[mujoco.MjModel, mujoco.MjModel]:
    """The model for looking at, and the one stripped to the physics."""
    _set_robot(spec, robot)
    for pair in spec.pairs:
        if pair.name == "base_object":
            pair.solref[:] = physics.base_solref
        else:
            pair.solref[:] = physics.ground_solref
            pair.solimp[:2] = physics.ground_impedance
        pair.friction[:2] = friction.robot if pair.name == "base_object" else friction.ground
    spec.option.cone = getattr(mujoco.mjtCone, f"mjCONE_{physics.cone.upper()}")
    for name in ("timestep", "impratio", "iterations", "ls_iterations", "tolerance"):
        setattr(spec.option, name, getattr(physics, name))
    model = spec.compile()
    return model, _strip(spec, model)


def check(friction: Friction, mass: float | None) -> None:
    """Raises InputError unless friction and mass are positive and finite, as MuJoCo does not."""
    for side, value in friction._asdict().items():
        errors.check_finite(f"friction {side}", value, above=0, at_most=10)
    if mass is not None:
        errors.check_finite("mass", mass, at_least=1e-3, at_most=1e4, unit="kg")


def check_target(p_world_target: tuple[float, float], shell: Shell = Shell()) -> None:
    """Raises InputError for a target [m] that is under the robot, or out of the world."""
    x, y = (
        errors.check_finite(f"target {axis}", value, at_least=-50, at_most=50, unit="m")
        for axis, value in zip("xy", p_world_target, strict=True)
    )
    half_x, half_y = shell.half
    if abs(x) <= half_x and abs(y) <= half_y:
        raise errors.InputError(
            f"target = ({x:g}, {y:g}) m is not allowed: it must lie outside the robot, which "
            f"covers |x| <= {half_x:g} m and |y| <= {half_y:g} m."
        )


def _set_robot(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Give the base its size and, if its force is limited, a mass that contact can move."""
    x, y = (float(half) for half in robot.shell.half)
    spec.geom("base").size[:2] = x, y
    spec.geom("skin_front").pos[0] = x
    spec.geom("skin_front").size[1] = y
    for side, sign in (("left", 1), ("right", -1)):
        spec.geom(f"skin_{side}").size[0] = x
        spec.geom(f"skin_{side}").pos[1] = sign * y
    if not robot.driven:
        return
    base = spec.body("base")
    base.mass = float(robot.mass)
    base.inertia[:] = float(robot.inertia)  # about the other axes it never turns
    for joint in base.joints:
        joint.armature = 0.0


def _strip(spec: mujoco.MjSpec, full: mujoco.MjModel) -> mujoco.MjModel:
    """Only what touches: the geoms of the contact pairs, with each body's whole inertia."""
    spec = spec.copy()
    spec.modelname = "physics"
    spec.stat.meanmass, spec.stat.meansize = 1.0, 1.0  # unused, and so the same for all
    spec.delete(spec.body("target"))
    touching = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    touching.add("object")  # of which the solid is read, though it stand on feet
    for geom in list(spec.geoms):
        if geom.name not in touching:
            spec.delete(geom)
    for item in [*spec.lights, *spec.cameras]:
        spec.delete(item)
    for name in ("base", "object"):
        body, compiled = spec.body(name), full.body(name)
        body.explicitinertial = True
        body.mass = compiled.mass[0]
        body.ipos = compiled.ipos + OFF_CENTRE
        body.iquat = compiled.iquat
        body.inertia = compiled.inertia
    model = spec.compile()
    model.body_sameframe[:] = 0  # likewise: always the general formula for the inertial frame
    return model


def solid_of(scene: Scene) -> Solid:
    """Return the object of a scene as solids (1, ...), rounded as in published random worlds."""
    one = scene.rounded_solid
    one = one._replace(p_object_com=(one.p_object_com + OFF_CENTRE) - OFF_CENTRE)
    return jax.tree.map(lambda leaf: np.asarray(leaf, float)[None], one)


def initial_qpos(scene: Scene, gap: float = 0.02, yaw: float = 0.0) -> np.ndarray:
    """Base at the origin, object `gap` [m] in front of the middle of its front face: (10,).

    `yaw` [rad] turns the object.
    """
    x, y = np.asarray(scene.footprint.vertices).T
    reach = np.max(math.sin(yaw) * y - math.cos(yaw) * x) + float(scene.footprint.radius)
    qpos = scene.physics.qpos0.copy()
    qpos[JOINTS.base] = 0.0
    height = qpos[JOINTS.object][2]
    front = scene.physics.geom("base").size[0]
    position = [front + gap + reach, 0.0, height]
    qpos[JOINTS.object] = [*position, math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]
    return qpos
