"""What random worlds are: a draw from the ranges of a domain, addressed by (domain, seed, index).

Whatever the batch, whatever the device, the same address gives the same world: the bits come from
a counter-based generator, and everything after them is computed on the host in double precision.
"""

from dataclasses import fields, replace
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike

from rps_jax.geometry import solid
from rps_jax.geometry.solid import SIDES, Solid
from rps_jax.robot.robot import Robot
from rps_jax.world import scene
from rps_jax.world.domain import ERRORS, QUANTITIES, RANDOM, Domain, of, unit_of
from rps_jax.world.scene import Friction

COLUMNS = 64  # random numbers of a world, more than are used, so that new ones change no old ones


class Draw(NamedTuple):
    """Worlds of one object or shape family, as drawn; leaves lead with their number, n."""

    number: np.ndarray  # (n,) their indices
    case: np.ndarray  # (n,) indices that have their object, and their friction and target of a list
    solid: Solid
    friction: Friction  # (n,) each
    at: dict[str, np.ndarray]  # (n,) of each quantity of the domain, in its unit
    p_world_target: np.ndarray  # (n, 2) [m]
    velocity_error: np.ndarray  # (n, 3) [1]
    robot: Robot  # (n,) each
    key: np.ndarray  # (n, 2) uint32, of all that is drawn while the world runs


# Random numbers of a world that are drawn from no range of their own.
_OTHERS = {
    "com_bearing": 5,
    **{name: 20 + i for i, name in enumerate(ERRORS)},
    **{"key_0": 23, "key_1": 24, "sides": 25, "turn": 26},
    **{f"corner_{i}": 27 + i for i in range(SIDES)},
    **{"feet_number": 44, "feet_turn": 45},
}
_OWN = {name: one.column for name, one in QUANTITIES.items() if name != "velocity_error"}
# Which random number of a world is what, in the order of the columns.
USES: dict[str, int] = dict(sorted((_OWN | _OTHERS).items(), key=lambda item: item[1]))


def draw(domain: Domain, seed: int, index: ArrayLike) -> Draw:
    """The worlds `index` (n,), all of one object of the domain."""
    index = np.asarray(index, np.int64)
    return drawn_at(domain, index, numbers_of(seed, index))


def drawn_at(domain: Domain, index: np.ndarray, numbers: np.ndarray) -> Draw:
    """Worlds from their random numbers (n, columns); ValueError if they are of several objects."""
    which = domain.object_of(index)
    if (which != which[0]).any():
        raise ValueError("worlds of several objects cannot be batched")
    u = {name: numbers[:, column] for name, column in USES.items()}
    name = domain.objects[int(which[0])]
    ranges = {name: getattr(domain, name) for name in QUANTITIES if name in u}
    at = {name: one.at(u[name]) for name, one in ranges.items() if one is not None}
    if domain.skin == "ideal":
        at |= {name: np.zeros(index.size) for name in of("skin") if name in at}
    error = [domain.velocity_error.at(u[name]) for name in ERRORS]
    key = [np.floor(u[name] * 2**32).astype(np.uint32) for name in ("key_0", "key_1")]
    return Draw(
        number=index,
        case=index,
        solid=_solid(name, at, u),
        friction=_friction(domain, index, at),
        at=at,
        p_world_target=_targets(domain, index, at),
        velocity_error=np.stack(error, axis=-1),
        robot=_robots(domain.robot, at, index.size),
        key=np.stack(key, axis=-1),
    )


def numbers_of(seed: int, index: np.ndarray) -> np.ndarray:
    """Random numbers (n, COLUMNS) in [0, 1): those of each index, however it is asked for."""
    rows = np.empty((index.size, COLUMNS))
    order = np.argsort(index)
    far = np.flatnonzero(np.diff(index[order]) > 100) + 1
    for near in np.split(order, far):
        first, last = int(index[near[0]]), int(index[near[-1]])
        # Philox counts in steps of four numbers.
        bits = np.random.Philox(key=seed).advance(first * COLUMNS // 4)
        block = np.random.Generator(bits).random((last - first + 1, COLUMNS))
        rows[near] = block[index[near] - first]
    return rows


def _solid(name: str, at: dict[str, np.ndarray], u: dict[str, np.ndarray]) -> Solid:
    """The objects called `name`: a scene's, or random ones."""
    count = u["mass"].size
    if name not in RANDOM:
        one = scene.solid_of(scene.load(name))
        return jax.tree.map(lambda leaf: np.repeat(leaf, count, axis=0), one)
    depth, breadth = at["size"] / np.sqrt(at["aspect"]), at["size"] * np.sqrt(at["aspect"])
    radius = np.zeros(count)
    if name == "random_cylinder":
        vertices, radius = np.zeros((count, 1, 2)), at["size"]
    elif name == "random_box":
        vertices = solid.rectangles(depth, breadth)
    else:
        vertices = _polygons(depth, breadth, u)
    found = solid.build(
        vertices, radius, at["height"], at["mass"], at["com_offset"], 2 * np.pi * u["com_bearing"]
    )
    if "feet" not in at:
        return found
    return solid.on_feet(found, at["feet"], 3 + np.floor(2 * u["feet_number"]), u["feet_turn"])


def _polygons(depth: np.ndarray, breadth: np.ndarray, u: dict[str, np.ndarray]) -> np.ndarray:
    """Convex polygons (n, SIDES, 2) of 3 to SIDES corners on ellipses of these half axes."""
    sides = 3 + np.floor((SIDES - 2) * u["sides"]).astype(int)[:, None]
    corner = np.minimum(np.arange(SIDES), sides - 1)  # the last one repeated
    jitter = np.stack([u[f"corner_{i}"] for i in range(SIDES)], axis=-1) - 0.5
    jitter = np.take_along_axis(jitter, corner, axis=1)
    angle = 2 * np.pi * (u["turn"][:, None] + (corner + 0.5 * jitter) / sides)
    half = np.stack([depth, breadth], axis=-1)[:, None, :]
    return solid.centred(half * np.stack([np.cos(angle), np.sin(angle)], axis=-1))


def _robots(robot: Robot, at: dict[str, np.ndarray], count: int) -> Robot:
    """The robots (count,) of worlds, with what was drawn of them."""
    own = {QUANTITIES[name].sets: at[name] for name in of("robot") if name in at}
    if (linear := own.get("acceleration_max")) is not None:
        own["acceleration_max"] = np.stack([linear, linear / robot.arm], axis=-1)

    def spread(value: Any) -> np.ndarray:
        return np.repeat(np.asarray(value, float)[None], count, axis=0)

    full = {
        f.name: spread(value)
        for f in fields(robot)
        if f.name not in (*own, "boards") and (value := getattr(robot, f.name)) is not None
    }
    return replace(robot, boards=jax.tree.map(spread, robot.boards), **full, **own)


def _friction(domain: Domain, index: np.ndarray, at: dict[str, np.ndarray]) -> Friction:
    if not domain.frictions:
        return Friction(at["friction_ground"], at["friction_robot"])
    which = index // max(1, len(domain.targets)) % len(domain.frictions)
    return Friction(*np.array(domain.frictions)[which].T)


def _targets(domain: Domain, index: np.ndarray, at: dict[str, np.ndarray]) -> np.ndarray:
    if domain.targets:
        return np.array(domain.targets)[index % len(domain.targets)]
    along = np.stack([np.cos(at["bearing"]), np.sin(at["bearing"])], axis=-1)
    return at["distance"][:, None] * along


def table(drawn: Draw) -> dict[str, tuple[np.ndarray, str]]:
    """What was drawn, one column (n,) and its unit a quantity."""
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
    found = {}
    for name, about in QUANTITIES.items():
        if about.of == "robot":
            values = _limit(drawn.robot, about.sets)
        else:
            values = derived.get(name, drawn.at.get(name))
        if about.words and values is not None:
            found[name] = values
    found["corners"] = solid.corners(shape)
    for name, values in zip(ERRORS, drawn.velocity_error.T, strict=True):
        found[name] = values
    return {name: (values, unit_of(name)) for name, values in found.items()}


def _limit(robots: Robot, name: str) -> np.ndarray | None:
    """A limit of robots (n,), of one that has it; of several numbers the first."""
    values = getattr(robots, name)
    return None if values is None else values.reshape(len(values), -1)[:, 0]
