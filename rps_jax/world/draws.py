"""Random worlds: draws from the ranges of a domain, addressed by (domain, seed, index).

An address gives the same world in any batch and on any device: the bits come from a counter-based
generator, and the quantities are computed from them on the host in double precision.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike

from rps_jax.geometry import solid
from rps_jax.geometry.solid import GRAVITY, SIDES, Solid
from rps_jax.record.files import Arrays
from rps_jax.robot.robot import Robot
from rps_jax.world import objects, scene
from rps_jax.world.domain import (
    QUANTITIES,
    RANDOM,
    VELOCITY_ERRORS,
    Domain,
    number_names,
    quantities_of,
    robot_field,
    unit_of,
)
from rps_jax.world.physics import Physics
from rps_jax.world.quantity import COLUMNS, random_numbers, stream
from rps_jax.world.scene import Friction, Surroundings, WorldInputs
from rps_jax.world.tasks.base import Course, CourseInputs


class Draw(NamedTuple):
    """Drawn worlds of one object or shape family; the leading axis of leaves is n."""

    indices: np.ndarray  # (n,) of the worlds
    cases: np.ndarray  # (n,) indices with the same object, friction and target of the lists
    solid: Solid
    friction: Friction  # (n,) each
    values: Arrays  # (n,) of each quantity of the domain, in its unit
    p_world_target: np.ndarray  # (n, 2) [m] end of the trial
    course: Course  # (n, ...) of the task
    velocity_error: np.ndarray  # (n, 3) [1]
    robot: Robot  # (n,) each
    key: np.ndarray  # (n, 2) uint32, of the noise of sensors and odometry
    surroundings: Surroundings = Surroundings()  # (n,) each

    def inputs(self, domain: Domain, physics: Physics) -> WorldInputs:
        """Return the inputs of engines for these worlds of a domain."""
        columns = self.solid, self.friction, physics, self.robot, self.surroundings
        return WorldInputs(domain.family_of(self.cases[0]), *columns)


def draw(
    domain: Domain, seed: int, index: ArrayLike, moves: Mapping[str, np.ndarray] | None = None
) -> Draw:
    """Return the worlds `index` (n,), all of one object of the domain: see `draw_at`."""
    index = np.asarray(index, np.int64)
    return draw_at(domain, index, numbers(seed, index), moves)


def numbers(seed: int, index: np.ndarray) -> Arrays:
    """Return the random numbers (n,) in [0, 1) of the worlds `index` (n,), by name."""
    names, table = number_names(), random_numbers(seed, index)
    return {x: table[:, COLUMNS[x]] if x in COLUMNS else stream(seed, x, index) for x in names}


def draw_at(
    domain: Domain, index: np.ndarray, u: Arrays, moves: Mapping[str, np.ndarray] | None = None
) -> Draw:
    """Return worlds of one object from their random numbers (n,) in [0, 1) by name.

    Numbers (n,) of `moves`, by name, are added to drawn quantities.

    Raises:
      ValueError: the worlds are of several objects.
    """
    chosen = domain.object_of(index)
    if (chosen != chosen[0]).any():
        raise ValueError("worlds of several objects cannot be batched")
    name = domain.objects[int(chosen[0])]
    ranges = {name: domain.range_of(name) for name in QUANTITIES if name in u}
    at = {name: item.at(u[name]) for name, item in ranges.items() if item is not None}
    at["com_bearing"] = 2 * np.pi * u["com_bearing"]
    at |= {name: domain.velocity_error.at(u[name]) for name in VELOCITY_ERRORS}
    if domain.skin == "ideal":
        at |= {name: np.zeros(index.size) for name in quantities_of("skin") if name in at}
    if name not in RANDOM:
        at["load_size"] = np.zeros(index.size)
    if domain.frictions:
        listed = np.array(domain.frictions)[domain.choices(index)[1]].T
        at |= dict(zip(("friction_ground", "friction_robot"), listed, strict=True))
    at |= {name: at[name] + move for name, move in (moves or {}).items()}
    robot = _robots(domain.robot, at, index.size)
    front = np.broadcast_to(np.asarray(robot.sizes[0], float), index.shape)
    inputs = CourseInputs(u, _targets(domain, index, at), front)
    targets, course = domain.task.courses(inputs)
    key = [np.floor(u[name] * 2**32).astype(np.uint32) for name in ("key_0", "key_1")]
    solids, surroundings = _solid(name, at, u), _surroundings(at, targets)
    if "support" in at and solids.feet is None:
        solids = solid.on_support(solids, at["support"])
    if surroundings.boundary is not None:  # each foot has the friction of its side
        solids = solid.standing(solids)
    drawn = Draw(
        indices=index,
        cases=index,
        solid=solids,
        friction=Friction(at["friction_ground"], at["friction_robot"]),
        values={name: values for name, values in at.items() if name in ranges}
        | domain.task.measures(course),
        p_world_target=targets,
        course=course,
        velocity_error=np.stack([at[name] for name in VELOCITY_ERRORS], axis=-1),
        robot=robot,
        key=np.stack(key, axis=-1),
        surroundings=surroundings,
    )
    for name, values in at.items():
        if name in QUANTITIES and (apply := QUANTITIES[name].apply) is not None:
            drawn = apply(drawn, values)
    return drawn


def _solid(name: str, at: Arrays, u: Arrays) -> Solid:
    """Return the solids of an object of a scene, or random ones of a shape family."""
    count = u["mass"].size
    if name not in RANDOM:
        if (guessed := objects.draw_guesses(name, u)) is not None:
            return guessed
        single = scene.solid_of(scene.load(name))
        return jax.tree.map(lambda leaf: np.repeat(leaf, count, axis=0), single)
    depth, breadth = at["size"] / np.sqrt(at["aspect"]), at["size"] * np.sqrt(at["aspect"])
    radius = np.zeros(count)
    if name == "random_cylinder":
        vertices, radius = np.zeros((count, 1, 2)), at["size"]
    elif name == "random_box":
        vertices = solid.rectangles(depth, breadth)
    else:
        vertices = _polygons(depth, breadth, u)
    load = at["com_offset"], at["com_bearing"], at["load_size"]
    solids = solid.build(vertices, radius, at["height"], at["mass"], *load)
    if "feet" not in at:
        return solids
    return solid.on_feet(solids, at["feet"], 3 + np.floor(2 * u["feet_number"]), u["feet_turn"])


def _polygons(depth: np.ndarray, breadth: np.ndarray, u: Arrays) -> np.ndarray:
    """Return convex polygons (n, SIDES, 2) of 3 to SIDES corners on ellipses of these half axes."""
    sides = 3 + np.floor((SIDES - 2) * u["sides"]).astype(int)[:, None]
    corner = np.minimum(np.arange(SIDES), sides - 1)  # the last one repeated
    jitter = np.stack([u[f"corner_{i}"] for i in range(SIDES)], axis=-1) - 0.5
    jitter = np.take_along_axis(jitter, corner, axis=1)
    angle = 2 * np.pi * (u["turn"][:, None] + (corner + 0.5 * jitter) / sides)
    half = np.stack([depth, breadth], axis=-1)[:, None, :]
    return solid.centred(half * solid.unit(angle))


def _robots(robot: Robot, at: Arrays, count: int) -> Robot:
    """Return the robots (count,) of worlds, with their drawn limits."""
    limits = {robot_field(name): at[name] for name in quantities_of("robot") if name in at}
    if (linear := limits.get("acceleration_max")) is not None:
        limits["acceleration_max"] = np.stack([linear, linear / robot.arm], axis=-1)

    bounds = {name: getattr(robot, name) for name in ("v_max", "acceleration_max")}
    several = {name: np.asarray(x, float) for name, x in bounds.items() if x is not None}
    return replace(scene.repeat_robot(replace(robot, **several), count), **limits)


def _surroundings(at: Arrays, targets: np.ndarray) -> Surroundings:
    """Return slopes and boundaries of worlds with these quantities and targets (n, 2) [m]."""
    slope = boundary = None
    if "slope" in at:
        along = np.sin(at["slope"]) * np.exp(1j * at["slope_bearing"])
        slope = GRAVITY * np.column_stack([along.real, along.imag, -np.cos(at["slope"])])
    if "boundary_factor" in at:
        way = np.linalg.norm(targets, axis=1)
        normal = targets.T / np.maximum(way, 1e-9)
        boundary = np.column_stack([*normal, at["boundary"] * way, at["boundary_factor"]])
    return Surroundings(slope, boundary)


def _targets(domain: Domain, index: np.ndarray, at: Arrays) -> np.ndarray:
    if domain.targets:
        return np.array(domain.targets)[domain.choices(index)[2]]
    return at["distance"][:, None] * solid.unit(at["bearing"])


def table(drawn: Draw) -> dict[str, tuple[np.ndarray, str]]:
    """Return the drawn quantities: a column (n,) and its unit for each."""
    shape = drawn.solid
    away = np.linalg.norm(shape.p_object_com, axis=1)
    toward = shape.p_object_com[:, :2] / np.maximum(away, 1e-12)[:, None]
    x, y = drawn.p_world_target.T
    derived = {
        "mass": shape.mass,
        "size": np.sqrt(solid.area(shape)) / 2,
        "height": shape.height,
        "com_offset": away / solid.reach(shape.vertices, shape.radius, toward),
        "friction_ground": drawn.friction.ground,
        "friction_robot": drawn.friction.robot,
        "distance": np.hypot(x, y),
        "bearing": np.arctan2(y, x),
    }
    columns = {}
    for name, quantity in QUANTITIES.items():
        values = derived.get(name, drawn.values.get(name))
        if quantity.owner == "robot" and hasattr(Domain, name):
            values = getattr(drawn.robot, robot_field(name))
        if quantity.reported and values is not None:  # the first number of a limit with several
            columns[name] = values.reshape(len(values), -1)[:, 0]
    columns["corners"] = solid.corners(shape)
    columns |= dict(zip(VELOCITY_ERRORS, drawn.velocity_error.T, strict=True))
    return {name: (values, unit_of(name)) for name, values in columns.items()}
