"""Scenes of `mjcf/`: a full MuJoCo model for pictures, and a stripped one for stepping.

The stripped model holds only the three geoms that touch. C MuJoCo and MJX both step it.
"""

import math
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.geometry import solid
from rps_jax.geometry.arrays import Entries
from rps_jax.geometry.footprint import Footprint
from rps_jax.geometry.solid import Solid
from rps_jax.record.files import Arrays
from rps_jax.robot.base import GRIP
from rps_jax.robot.robot import Robot
from rps_jax.robot.shell import HALF_LENGTH, HALF_WIDTH, Shell
from rps_jax.world import objects
from rps_jax.world.objects import FAMILIES, OBJECTS, SHAPES, path_of
from rps_jax.world.opengl import mujoco
from rps_jax.world.physics import PHYSICS, Physics

Side = Literal["near", "far"]
# Offset [m] of inertial frames: without it MuJoCo compiles centred bodies to another structure,
# which cannot be batched with the rest.
OFF_CENTRE = 1e-6
WALL_HALF, WALL_TOP = 0.001, 2.5  # [m] half thickness and height of walls, which are sheets
_WALL_FOOT = -0.5  # [m] their lower edge
_LEAST_TORQUE = 1e-5  # [m] torsional friction of a point, the least in MuJoCo
_DECK, _DECK_MARGIN = 0.37, 0.03  # [m] height above which the arm is, and width of the rim


class Friction(NamedTuple):
    """Coulomb coefficients of the two contacts."""

    ground: Entries  # [1] object-ground; a number, or (n,) of n worlds
    robot: Entries  # [1] object-robot


FRICTION = {"S1": Friction(0.3, 0.35), "S2": Friction(0.2, 0.5)}  # Table I


class Surroundings(NamedTuple):
    """Surroundings of n worlds other than a level, uniform floor; None where absent."""

    slope: Entries = None  # (n, 3) [m/s^2] gravity in the frame of a floor that is not level
    # (n, 4) unit normal of a line on the floor, its distance from the origin [m], and the factor
    # [1] of the ground's friction beyond it
    boundary: Entries = None
    walls: Entries = None  # (n, W, 2, 2) [m] both ends of walls that the object may touch
    friction_wall: Entries = None  # (n,) [1] object-wall


class WorldInputs(NamedTuple):
    """Inputs from which MuJoCo compiles n worlds of one shape family."""

    family: str
    solids: Solid  # (n, ...)
    friction: Friction  # (n,) each
    physics: Physics
    robots: Robot = Robot()  # (n,), or one for all
    surroundings: Surroundings = Surroundings()  # (n,) each

    @property
    def supported(self) -> "WorldInputs":
        """Inputs whose solids without feet have the support of the physics."""
        solids, family, support = self.solids, self.family, self.physics.support
        if solids.feet is None and support != "corners":
            solids = solid.on_support(solids, np.full(self.num_worlds, solid.SUPPORTS[support]))
        if solids.feet is not None and family == "box":  # feet are those of a prism
            family = "prism"
        return self._replace(solids=solids, family=family)

    @property
    def num_worlds(self) -> int:
        """Number of worlds."""
        return self.solids.mass.size

    @property
    def columns(self) -> tuple[Solid, Friction, Robot, Surroundings]:
        """Fields that may differ between worlds, with leaves (n, ...)."""
        robots = repeat_robot(self.robots, self.num_worlds)
        return self.solids, self.friction, robots, self.surroundings


class Scene(NamedTuple):
    """Object in front of the robot: models, solid and shell."""

    name: str
    family: str
    model: mujoco.MjModel  # full, for pictures
    physics: mujoco.MjModel  # stripped to the three geoms that touch, for stepping
    solid: Solid  # of the object; leaves without a leading axis
    shell: Shell  # of the robot

    @property
    def footprint(self) -> Footprint:
        """Outline of the object, in JAX's precision."""
        outline = self.solid.vertices, self.solid.radius
        return Footprint(*(jnp.asarray(x, float) for x in outline))

    @property
    def rounded_solid(self) -> Solid:
        """The solid with its outline in JAX's precision, that of the footprint."""
        rounded = np.asarray(self.solid.vertices, jnp.result_type(float))
        return self.solid._replace(vertices=np.asarray(rounded, float))


class Joints(NamedTuple):
    """Slices of the joints in qpos and qvel, equal in all scenes and in both models."""

    base: slice = slice(0, 3)  # x, y [m], yaw [rad] in the world
    object: slice = slice(3, 10)  # position [m] and quaternion, scalar first
    # Of qpos alone:
    base_position: slice = slice(0, 2)
    base_yaw: int = 2
    object_height: int = 5
    object_quaternion: slice = slice(6, 10)


JOINTS = Joints()


def load(
    name: str,  # of an object in `objects.OBJECTS`
    physics: Physics = PHYSICS["default"]["standard"],
    friction: Friction = FRICTION["S1"],
    *,
    rear: Side = "near",  # side of the nonuniform box's load, the paper's "rear left corner"
    mass: float | None = None,  # [kg], scales the inertia too; None: the object's own mass
    robot: Robot = Robot(),  # a body if its force is limited
    drawn: Solid | None = None,  # of an object with guesses (leaves without a leading axis)
) -> Scene:
    """Compile a scene of an object.

    Raises:
      InputError: unknown name, or friction or mass that is not a positive finite number.
    """
    errors.check_name("object", name, OBJECTS)
    errors.check_name("rear", rear, get_args(Side))
    check_contact(friction, mass)
    spec = objects.read(path_of(name))
    if name in objects.REGISTERED or drawn is not None:  # its contacts are those of its solid
        single = objects.REGISTERED[name].solid if drawn is None else drawn
        if mass is not None:
            inertia = single.inertia * mass / single.mass
            single = single._replace(mass=np.asarray(mass), inertia=inertia)
        upright = compile_solid(FAMILIES[name], single, physics, friction, robot=robot)
        _set_robot(spec, robot)
        if drawn is not None:
            # Stretch the geoms, of which `object` is a box, to the drawn box.
            body, half = spec.body("object"), np.append(drawn.vertices[0], drawn.height / 2)
            ratio = half / spec.geom("object").size
            body.pos[2] = half[2]
            for geom in body.geoms:
                geom.pos, geom.size = geom.pos * ratio, geom.size * ratio
        return upright._replace(name=name, model=spec.compile())
    for geom in spec.geoms:
        if geom.name == "load" and rear == "far":
            geom.pos[0] = -geom.pos[0]
    if mass is not None:
        geoms = [geom for geom in spec.body("object").geoms if geom.mass > 0]
        total = sum(geom.mass for geom in geoms)
        for geom in geoms:
            geom.mass *= mass / total
    model, stripped = _compile(spec, physics, friction, robot, Surroundings())
    size, body = model.geom("object").size, model.body("object")
    is_box = FAMILIES[name] == "box"
    vertices = solid.rectangles(size[:1], size[1:2])[0] if is_box else np.zeros((1, 2))
    single = objects.solid_of_body(body, vertices, 0.0 if is_box else size[0], 2 * body.pos[2])
    return Scene(name, FAMILIES[name], model, stripped, single, robot.shell)


def compile_solid(
    family: str,
    single: Solid,
    physics: Physics = PHYSICS["default"]["standard"],
    friction: Friction = FRICTION["S1"],
    *,
    robot: Robot = Robot(),
    around: Surroundings = Surroundings(),  # of one world
) -> Scene:
    """Compile a scene with a single solid (leaves without a leading axis) of a shape family."""
    errors.check_name("family", family, SHAPES)
    check_contact(friction, float(single.mass))
    spec = objects.read(path_of(family))
    body = spec.body("object")
    body.pos[2] = single.height / 2
    for geom in list(body.geoms):
        if not geom.name:
            spec.delete(geom)  # visual geoms of the object that gave the family its file
    for name, size in geom_sizes(family, single).items():
        spec.geom(name).size[: size.size] = size
    if family == "prism":
        corners, half = single.vertices[solid.distinct(single.vertices)], single.height / 2
        faces = [np.column_stack([corners, np.full(len(corners), z)]) for z in (-half, half)]
        spec.mesh("prism").uservert = np.concatenate(faces).ravel()
    if single.feet is not None:
        _add_feet(spec, family, len(single.feet))
    if single.feet is not None or family == "prism":
        for i, foot in enumerate(foot_positions(single)):
            spec.geom(f"foot_{i}").pos = foot
    body.explicitinertial = True
    body.mass, body.ipos = single.mass, single.p_object_com
    body.iquat, body.inertia = single.q_object_body, single.inertia
    models = _compile(spec, physics, friction, robot, around, single)
    return Scene(family, family, *models, single, robot.shell)


def compile_row(inputs: WorldInputs, i: int) -> Scene:
    """Compile a scene of row i."""
    single, pair, robot, around = jax.tree.map(lambda leaf: leaf[i], inputs.columns)
    friction = Friction(float(pair.ground), float(pair.robot))
    columns = single, inputs.physics, friction
    return compile_solid(inputs.family, *columns, robot=robot, around=around)


def repeat_robot(robots: Robot, count: int) -> Robot:
    """Return one robot as robots (count,); robots (n,) are returned unchanged."""
    if np.ndim(robots.mass):
        return robots
    return jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf, float)[None], count, 0), robots)


def base_size(robots: Robot, count: int) -> np.ndarray:
    """Return half length and half width (count, 2) [m] of bases, or their radius (count, 1)."""
    sizes = np.stack(robots.sizes, axis=-1)
    return np.broadcast_to(np.asarray(sizes, float), (count, sizes.shape[-1]))


def geom_sizes(family: str, solids: Solid) -> Arrays:
    """Return MuJoCo's sizes (..., 3) [m] of the geoms of solids (...), by name."""
    half = solids.height / 2
    if family == "box":
        corner = solids.vertices[..., 0, :]
        return {"object": np.stack([corner[..., 0], corner[..., 1], half], axis=-1)}
    if family == "cylinder":
        size = np.stack([solids.radius, half, np.zeros_like(half)], axis=-1)
        return {"object": size, "object_side": size}
    return {}  # a prism is a mesh and points


def _add_feet(spec: mujoco.MjSpec, family: str, count: int) -> None:
    """Add feet to a cylinder, or more to a prism; only these touch the ground."""
    default = spec.find_default("ground_object")
    if family == "cylinder":
        spec.delete(spec.pair("ground_object"))
    point: dict[str, Any] = {
        "type": mujoco.mjtGeom.mjGEOM_SPHERE,
        "size": [1e-6, 0, 0],
        "mass": 0,
        "group": 3,
    }
    for i in range(0 if family == "cylinder" else solid.SIDES, count):
        spec.body("object").add_geom(name=f"foot_{i}", **point)
        pair = {"geomname1": "ground", "geomname2": f"foot_{i}"}
        spec.add_pair(default, name=f"ground_object_{i}", **pair)


def _add_walls(spec: mujoco.MjSpec, around: Surroundings, physics: Physics) -> None:
    """Add walls as geoms that touch the object."""
    default, side = spec.find_default("base_object"), spec.pair("base_object").geomname2
    box: dict[str, Any] = {"type": mujoco.mjtGeom.mjGEOM_BOX}
    for i, (start, end) in enumerate(around.walls):
        (x, y), name = end - start, f"wall_{i}"
        box["size"] = math.hypot(x, y) / 2, WALL_HALF, (WALL_TOP - _WALL_FOOT) / 2
        box["pos"] = *(start + end) / 2, (WALL_TOP + _WALL_FOOT) / 2
        half = math.atan2(y, x) / 2
        spec.worldbody.add_geom(name=name, quat=[math.cos(half), 0, 0, math.sin(half)], **box)
        pair = spec.add_pair(default, name=f"{name}_object", geomname1=name, geomname2=side)
        pair.friction[:2], pair.solref[:] = around.friction_wall, physics.base_solref


def foot_positions(solids: Solid) -> np.ndarray:
    """Return the support points (..., N, 3) [m] of solids (...); unused points are at the top."""
    at, weight = solid.support(solids)
    half = np.expand_dims(solids.height / 2, -1)
    return np.concatenate([at, np.where(weight == 0, half, -half)[..., None]], axis=-1)


def _set_pads(spec: mujoco.MjSpec, single: Solid, physics: Physics) -> None:
    """Set the stiffness of each foot by its weight, its friction, and its torque of friction."""
    impedance, (time, damping) = physics.ground_impedance, physics.ground_solref
    stiffness = impedance / (1 - impedance)
    weights = np.asarray(single.feet)[:, 2]
    for i, ((factor, radius), weight) in enumerate(
        zip(np.asarray(single.pads), weights, strict=True)
    ):
        pair = spec.pair(f"ground_object_{i}")
        # A contact's stiffness is its impedance over the rest; `solref` undoes its other effects.
        share = 1 - 1 / (1 + stiffness * weight) if weight > 0 else impedance
        pair.condim, pair.solimp[:2] = 4, share
        pair.solref[:] = time * impedance / share, damping * (share / impedance) ** 0.5
        slide = pair.friction[0] * factor
        pair.friction[:3] = slide, slide, max(slide * radius, _LEAST_TORQUE)


def _compile(
    spec: mujoco.MjSpec,
    physics: Physics,
    friction: Friction,
    robot: Robot,
    around: Surroundings,
    single: Solid | None = None,
) -> tuple[mujoco.MjModel, mujoco.MjModel]:
    """Compile the full model and the stripped one."""
    _set_robot(spec, robot)
    if robot.radius is not None:
        _touch_round(spec, float(robot.radius))
    for pair in spec.pairs:
        of_base = pair.name.startswith("base_object")
        if of_base:
            pair.solref[:] = physics.base_solref
        else:
            pair.solref[:] = physics.ground_solref
            pair.solimp[:2] = physics.ground_impedance
        pair.friction[:2] = friction.robot if of_base else friction.ground
    if single is not None and single.pads is not None:
        _set_pads(spec, single, physics)
    if around.walls is not None:
        _add_walls(spec, around, physics)
    if around.slope is not None:
        spec.option.gravity = around.slope
    spec.option.cone = getattr(mujoco.mjtCone, f"mjCONE_{physics.cone.upper()}")
    for name in ("timestep", "impratio", "iterations", "ls_iterations", "tolerance"):
        setattr(spec.option, name, getattr(physics, name))
    model = spec.compile()
    return model, _strip(spec, model)


def check_contact(friction: Friction, mass: float | None) -> None:
    """Raise InputError unless friction and mass are positive and finite."""
    for side, value in friction._asdict().items():
        errors.check_finite(f"friction {side}", value, above=0, at_most=10)
    if mass is not None:
        errors.check_finite("mass", mass, at_least=1e-3, at_most=1e4, unit="kg")


def check_target(p_world_target: tuple[float, float], shell: Shell = Shell()) -> None:
    """Raise InputError for a target [m] under the robot or more than 50 m away."""
    x, y = errors.check_vector("target", p_world_target, at_least=-50, at_most=50, unit="m")
    half_x, half_y = shell.half
    order = np.inf if shell.radius is None else 2
    if np.linalg.norm(np.array([x / half_x, y / half_y], float), order) <= 1:
        rule = (
            f"it must lie outside the robot, from its middle {half_x:g} m ahead, {half_y:g} m aside"
        )
        raise errors.not_allowed("target", f"({x:g}, {y:g}) m", rule)


def _set_robot(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Set the outline of the base and, if its force is limited, its mass."""
    x, y = (float(half) for half in robot.shell.half)
    if robot.radius is None:
        spec.geom("base").size[:2] = x, y
        spec.geom("skin_front").pos[0] = x
        spec.geom("skin_front").size[1] = y
        for side, sign in (("left", 1), ("right", -1)):
            spec.geom(f"skin_{side}").size[0] = x
            spec.geom(f"skin_{side}").pos[1] = sign * y
        if (x, y) != (HALF_LENGTH, HALF_WIDTH):
            _draw_deck(spec, x, y)
    else:
        _draw_round(spec, robot.shell, x)
    if robot.drive != "omni":
        _draw_axle(spec, robot)
    if not robot.driven:
        return
    base = spec.body("base")
    base.mass = float(robot.mass)
    base.inertia[:] = float(robot.inertia)  # about the other axes it never turns
    for joint in base.joints:
        joint.armature = 0.0
    if robot.drive != "omni":  # the engine sets the coefficients, the direction of `Tyres`
        tyres = spec.add_tendon(name="tyres", armature=GRIP * float(robot.mass))
        for joint, coefficient in zip(base.joints, (0.0, 1.0, 0.0), strict=True):
            tyres.wrap_joint(joint.name, coefficient)


def _draw_deck(spec: mujoco.MjSpec, x: float, y: float) -> None:
    """Draw a deck for a base of these half sizes [m], and no arm where it would not fit."""
    for item in list(spec.body("base").geoms):
        if item.material == "deck":
            item.size[:2] = x - _DECK_MARGIN, y - _DECK_MARGIN
        elif np.nanmax([item.pos[2], item.fromto[2]]) > _DECK and (x < 0.3 or y < 0.25):
            spec.delete(item)


def _draw_axle(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Draw the wheels of an axle in place of omnidirectional ones."""
    base, kind = spec.body("base"), mujoco.mjtGeom
    for item in list(base.geoms):
        if item.material in ("wheel", "hub") and item.type != kind.mjGEOM_CAPSULE:
            spec.delete(item)
    half = min(float(robot.half_track), float(robot.sizes[-1]))  # skid steer: wider than the base
    looks: dict[str, Any] = {"mass": 0, "group": 2, "type": kind.mjGEOM_CYLINDER}
    looks["quat"] = [math.sqrt(0.5), math.sqrt(0.5), 0, 0]  # along y
    parts = ((half, [0.1, 0.03, 0]), (-half, [0.1, 0.03, 0]), (0.0, [0.02, half, 0]))
    for y, size in parts:
        at = [-float(robot.axle_behind), y, 0.1]
        base.add_geom(pos=at, size=size, material="hub" if y == 0 else "wheel", **looks)


def _draw_round(spec: mujoco.MjSpec, shell: Shell, radius: float) -> None:
    """Draw the base as a cylinder of a radius [m], with its skin, and without wheels."""
    base, geom, kind = spec.body("base"), spec.geom("base"), mujoco.mjtGeom
    for item in list(base.geoms):
        if item.material in ("deck", "wheel", "hub", "skin") and item.type != kind.mjGEOM_CAPSULE:
            spec.delete(item)
    geom.type, geom.size[:2] = kind.mjGEOM_CYLINDER, (radius, geom.size[2])
    looks: dict[str, Any] = {"mass": 0, "group": 2}
    for name, share, z, half in (("deck", 0.9, 0.36, 0.02), ("wheel", 0.85, 0.03, 0.03)):
        disc = {"type": kind.mjGEOM_CYLINDER, "size": [share * radius, half, 0]}
        base.add_geom(pos=[0, 0, z], material=name, **disc, **looks)
    tile = {"type": kind.mjGEOM_CYLINDER, "size": [0.055 * radius, 0.05, 0], "material": "skin"}
    for x, y in 0.955 * np.asarray(shell.taxels()[:, 0], float):
        base.add_geom(pos=[x, y, 0.27], **tile, **looks)


def _touch_round(spec: mujoco.MjSpec, radius: float) -> None:
    """Let two spheres of a round base of a radius [m] touch the object in place of the base.

    They meet an upright side at the lower and upper edge of the base, or just below the top of a
    lower object. MuJoCo's contact of a cylinder is a single point, at any height.
    """
    geom, contact = spec.geom("base"), spec.pair("base_object")
    low, high = geom.pos[2] + geom.size[1] * np.array([-1.0, 1.0])
    sphere = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [radius, 0, 0], "mass": 0, "group": 3}
    for name, z in (("low", low), ("high", min(high, 1.96 * spec.body("object").pos[2]))):
        spec.body("base").add_geom(name=f"base_{name}", pos=[0, 0, z], **sphere)
    contact.geomname1 = "base_low"
    second = {"geomname1": "base_high", "geomname2": contact.geomname2}
    spec.add_pair(spec.find_default("base_object"), name="base_object_high", **second)


def _strip(spec: mujoco.MjSpec, full: mujoco.MjModel) -> mujoco.MjModel:
    """Compile a model of the geoms that touch, with the full inertia of each body."""
    spec = spec.copy()
    spec.modelname = "physics"
    spec.stat.meanmass, spec.stat.meansize = 1.0, 1.0  # unused, but must be equal in a batch
    spec.delete(spec.body("target"))
    touching = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    touching.add("object")  # also if the object stands on feet: engines read its size
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
    model.body_sameframe[:] = 0  # the general formula for the inertial frame, for all bodies
    return model


def solid_of(scene: Scene) -> Solid:
    """Return the object of a scene as solids (1, ...), rounded as in published random worlds."""
    single = scene.rounded_solid
    single = single._replace(p_object_com=(single.p_object_com + OFF_CENTRE) - OFF_CENTRE)
    return jax.tree.map(lambda leaf: np.asarray(leaf, float)[None], single)


def width_of(name: str) -> float:
    """Return the greatest width of an object of a scene along its axes [m]."""
    if (ranges := objects.guesses_of(name)) is not None:
        return float(ranges[:2].max())
    shape = solid_of(load(name))
    return 2 * float(np.abs(shape.vertices).max() + shape.radius.max())


def initial_qpos(scene: Scene, gap: float = 0.02, yaw: float = 0.0) -> np.ndarray:
    """Return positions (10,): base at the origin, object `gap` [m] before its front face.

    `yaw` [rad] is the heading of the object.
    """
    x, y = np.asarray(scene.footprint.vertices).T
    reach = np.max(math.sin(yaw) * y - math.cos(yaw) * x) + float(scene.footprint.radius)
    qpos = scene.physics.qpos0.copy()
    qpos[JOINTS.base] = 0.0
    position = [float(scene.shell.half[0]) + gap + reach, 0.0, qpos[JOINTS.object_height]]
    qpos[JOINTS.object] = [*position, math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]
    return qpos
