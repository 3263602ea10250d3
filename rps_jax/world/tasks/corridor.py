"""Corridors: a path between two walls that the base may not touch, nor the object by default.

Walls are at half the width on either side of the path, with mitred corners. They begin behind the
base and continue beyond the end of the path. Doors are narrower places. A trial fails at the first
touch, by the exact outlines of base and object. With `touch=object`, the object slides along walls
by contact forces, and a trial fails where the base presses it into one.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated, ClassVar, Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import planar, polyline
from rps_jax.geometry.arrays import Array, Entries, Float, Floats, Ints, Pytree, namespace_of
from rps_jax.geometry.footprint import Footprint
from rps_jax.geometry.polyline import Polyline, distances
from rps_jax.record.files import Arrays
from rps_jax.record.options import option
from rps_jax.robot.shell import Shell
from rps_jax.spec import Spec
from rps_jax.world.quantity import Quantity, Range, check_unused
from rps_jax.world.tasks.base import Aim, CourseInputs, Positions
from rps_jax.world.tasks.path import LOOKAHEAD, Path, PathCourse, PathProgress, turns_of, units_of

_BEHIND = 1.5  # [m] of the walls before the base's front
_BEYOND = 1.5  # [m] of the walls after the end of the path
_PRESSED = 0.01  # [m] beyond a wall, at which the object has failed where it may touch
# [m] by which walls overlap in a corner that holds the object, and end before one that juts out, so
# that an object that slides along a wall never meets the end of the next one.
_JOINT = 0.01
_NOWHERE = ((1e4, 1e4), (1e4 + 1, 1e4))  # [m] wall that nothing touches
_STEPS = 8  # control steps between two measurements of the walls, unless one may be touched
NOTHING, BASE, OBJECT = 0, 1, 2  # what touched a wall
_T = TypeVar("_T")  # a pytree


class CorridorProgress(NamedTuple):
    """Progress along the path, and the first touch of a wall."""

    path: PathProgress
    clearance: Floats  # [m] least of base and object so far
    wall_touch: Floats  # 0 nothing, 1 the base, 2 the object
    p_world_touch: Float[Array, "*B 2"]  # [m] NaN before a touch
    measured: Floats  # [m] last measured distance from the walls
    measured_at: Float[Array, "*B 2 3"]  # [m, m, rad] poses of base and object then
    steps: Ints

    def outcomes(self) -> dict[str, Array]:
        """Return the outcomes of the path, and of the walls."""
        return self.path.outcomes() | {
            "clearance": self.clearance,
            "wall_touch": self.wall_touch,
            "touch_x": self.p_world_touch[..., 0],
            "touch_y": self.p_world_touch[..., 1],
        }


class CorridorCourse(NamedTuple):
    """Path and walls of a world."""

    path: PathCourse
    walls: Float[Array, "*B W 2 2"]  # [m] both ends of each
    # Of an object that may touch walls: fields of `scene.Surroundings`.
    surroundings: dict[str, Entries] | None = None
    # [m] from the path, within which there are no other walls; what gets beyond it touches one.
    reach: Floats | None = None

    @classmethod
    def around(
        cls, path: PathCourse, half: Entries, opening: Entries, doors: int
    ) -> CorridorCourse:
        """Return corridors (n, ...) of a half width [m], with doors of half width `opening`."""
        xp = namespace_of(path.line.vertices)
        shares = [(i + 1) / (doors + 1) for i in range(doors)]
        walls = [_door(path.line, share, opening, 1.5 * half) for share in shares]
        return cls(path, xp.concatenate([_walls(path.line.vertices, half), *walls], axis=1))

    def start(self) -> CorridorProgress:
        """Return the progress at the start."""
        inner = self.path.start()
        zero, nan = inner.arc, jnp.full((2,), jnp.nan, inner.arc.dtype)
        poses = jnp.zeros((2, 3), zero.dtype)
        count = jnp.zeros((), jnp.int32)
        return CorridorProgress(inner, jnp.inf + zero, zero, nan, zero, poses, count)

    def step(
        self, progress: CorridorProgress, positions: Positions
    ) -> tuple[CorridorProgress, Aim]:
        """Advance along the path, and fail at a touch.

        Walls are measured in every eighth step, and in each in which one may be touched.
        """
        inner, aim = self.path.step(progress.path, positions)
        poses = jnp.stack(
            [positions.base, jnp.append(positions.p_world_object, positions.object_yaw)]
        )
        outlines = positions.outline, positions.footprint
        radii = jnp.stack([fp.circumradius(outline) for outline in outlines])
        away = jnp.abs(poses - progress.measured_at)
        travel = planar.norm(away[:, :2]) + radii * away[:, 2]
        may_touch = progress.measured <= jnp.max(travel)
        due = may_touch | (progress.steps % _STEPS == 0)

        def outlines_at(poses: Array) -> list[Footprint]:
            """Return both outlines, with the base at the origin."""
            origin = poses[0, :2]
            pairs = zip(outlines, poses, strict=True)
            return [fp.place(outline, pose[:2] - origin, pose[2]) for outline, pose in pairs]

        def measure(poses: Array, last: _Measured) -> _Measured:
            walls = self.walls - poses[0, :2]
            (of_base, at_base), (of_object, at_object) = (
                polyline.clearance(x, walls) for x in outlines_at(poses)
            )
            if self.reach is not None:
                bounds = (-jnp.inf, jnp.inf)
                away = [polyline.nearest(self.path.line, pose[:2], *bounds)[1] for pose in poses]
                of_base, of_object = jnp.minimum(
                    jnp.stack([of_base, of_object]), self.reach - jnp.stack(away) - radii
                )
            room = of_object if self.surroundings is None else of_object + _PRESSED
            by_base = of_base <= room
            least = jnp.where(by_base, of_base, room)
            touched = jnp.where(least > 0, NOTHING, jnp.where(by_base, BASE, OBJECT))
            clearance = jnp.minimum(last.clearance, jnp.minimum(of_base, of_object))
            wall = jnp.where(by_base, at_base, at_object).astype(jnp.int32)
            return _Measured(clearance, touched.astype(least.dtype), wall, least, poses)

        def locate(poses: Array, last: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            touch, wall, _ = last
            of_wall = self.walls[wall] - poses[0, :2]
            points = [polyline.nearest_on_wall(x, of_wall) for x in outlines_at(poses)]
            return touch, wall, poses[0, :2] + jnp.where(touch == BASE, *points)

        last = _Measured(
            progress.clearance, progress.wall_touch, jnp.zeros((), jnp.int32), progress.measured,
            progress.measured_at,
        )  # fmt: skip
        current = _where_due(due, measure, poses, last)
        touch = current.wall_touch, current.wall, progress.p_world_touch
        *_, point = _where_due(current.wall_touch > NOTHING, locate, poses, touch)
        moved = CorridorProgress(
            inner,
            current.clearance,
            current.wall_touch,
            point,
            current.measured,
            current.measured_at,
            progress.steps + 1,
        )
        return moved, aim._replace(failed=moved.wall_touch > NOTHING)

    def remaining(self, progress: CorridorProgress, p_world_goal: Array, point: Array) -> Array:
        """Return the way along the path."""
        return self.path.remaining(progress.path, p_world_goal, point)

    def lines(self) -> Arrays:
        """Return path and walls."""
        return self.path.lines() | {"walls": np.asarray(self.walls)}


class _Measured(NamedTuple):
    """Last measurement of the walls; fields as in `CorridorProgress`."""

    clearance: Array
    wall_touch: Array
    wall: Array  # () index of the nearest wall
    measured: Array
    measured_at: Array


def _where_due(due: Array, function: Callable[[Array, _T], _T], poses: Array, last: _T) -> _T:
    """Return `function(poses, last)` if it is due, else `last`."""
    function, inputs = jax.closure_convert(function, poses, last)
    return _if_due(function, due, poses, last, inputs)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _if_due(function: Callable[..., _T], due: Array, poses: Array, last: _T, inputs: Pytree) -> _T:
    """Return `function(poses, last, *inputs)` if it is due, else `last`.

    It is a loop of at most one pass: a program for many worlds skips the pass if no world needs it.
    Reverse mode does not support such loops, so the derivatives are those of a selection.
    """

    def once(carry: tuple[Array, Array, _T]) -> tuple[Array, Array, _T]:
        _, poses, last = carry  # changed by the pass: what does not change is computed before
        return jnp.zeros((), bool), jnp.zeros_like(poses), function(poses, last, *inputs)

    return jax.lax.while_loop(lambda carry: carry[0], once, (due, poses, last))[-1]


@_if_due.defjvp
def _(function: Callable[..., _T], primals: Pytree, tangents: Pytree) -> tuple[_T, _T]:
    def select(due: Array, poses: Array, last: _T, inputs: Pytree) -> _T:
        result = function(poses, last, *inputs)
        return jax.tree.map(partial(jnp.where, due), result, last)

    return _if_due(function, *primals), jax.jvp(select, primals, tangents)[1]


@dataclass(frozen=True)
class Corridor(Path):
    """Follow a path between walls."""

    kind: str = "corridor"
    ROOM_OPTIONS = ("width",)
    OUTCOMES: ClassVar[Mapping[str, Spec]] = {
        **Path.OUTCOMES,
        "clearance": Spec(
            "m", "least distance of base and object from the walls, every eighth control step"
        ),
        "wall_touch": Spec(
            "1", "what touched a wall and ended the trial: 1 the base, 2 the object"
        ),
        "touch_x": Spec("m", "x of the touch in the world"),
        "touch_y": Spec("m", "y of the touch in the world"),
    }

    MARKS = ()
    FAILURES: ClassVar[dict[str, str]] = {"wall_touch": "touched a wall"}

    # Short, since long ones cut corners.
    lookahead: Annotated[Range, LOOKAHEAD] = Range(0.6, 0.6)
    width: Annotated[Range, Quantity("m", "width of the corridor", 0.3, 20, owner="course")] = (
        Range(1.4, 2.2)
    )
    doors: int = option(0, 0, 4)  # narrower places along the path
    door_width: Annotated[Range, Quantity("1", "doors, of the width", 0.1, 1, owner="course")] = (
        Range(0.8, 0.8)
    )
    touch: Literal["nothing", "object"] = "nothing"  # what may touch walls
    friction_wall: float = option(0.3, 0, 10)  # [1] of an object that may touch them

    @property
    def shape(self) -> Hashable:
        """Kind, numbers of vertices and doors, and what may touch walls."""
        return super().shape, self.doors, self.touch

    def check(self) -> None:
        """Raise InputError for corners or parts of which the walls would cross."""
        super().check()
        if not self.doors:
            check_unused(self, "task ", {"door_width": "a corridor without doors leaves"})
        if self.touch == "nothing" and self.friction_wall != type(self).friction_wall:
            rule = "without touch=object, nothing may touch a wall"
            raise errors.not_allowed("task friction_wall", self.friction_wall, rule)
        need = self.width.high * np.tan(self.turn_angle.high / 2) if self.turns.high else 0.0
        part = self.length.low / (self.turns.high + 1)
        if self.waypoints:
            need, part = 0.0, float(spare(self.route()[None], self.width.high / 2)[0])
        if part < need:
            rule = "it must leave room for its corners: give fewer or smaller turns, longer parts"
            raise errors.not_allowed("task width (high)", f"{self.width.high:g} m", rule)
        if self.waypoints:
            half: Entries = np.array([self.width.high / 2])
            route = self.route()
            path = PathCourse(Polyline.through(route[None]), half)
            walls: Entries = CorridorCourse.around(path, half, half, self.doors).walls
            (a, b), line = (walls[0] @ (1, 1j)).T[..., None], route @ (1, 1j)
            away = distances(a, b, line[:-1], line[1:]).min(axis=0)
            if away.min() < 0.999 * half:
                rule = (
                    f"walls of another part of the corridor are {away.min():.2f} m from the path "
                    f"there, less than half of its width ({half[0]:g} m): lead the path elsewhere; "
                    f"walls begin {_BEHIND} m before it, and end {_BEYOND} m beyond it"
                )
                raise errors.not_allowed("task waypoints", route[away.argmin()].tolist(), rule)

    @property
    def free_room(self) -> float:
        return self.width.low / 2 * (self.door_width.low if self.doors else 1)

    @property
    def has_contact_walls(self) -> bool:
        """Whether the object may touch walls."""
        return self.touch == "object"

    @property
    def idle(self) -> frozenset[str]:
        """Names of the ranges that are not drawn."""
        return super().idle | (frozenset() if self.doors else {"door_width"})

    def check_room(self, shell: Shell, object_width: Callable[[], float]) -> None:
        """Raise InputError for a corridor narrower than base or objects, or a wall at the base."""
        super().check_room(shell, object_width)
        narrowest = 2 * self.free_room
        for name, size in (("base", 2 * float(shell.half[1])), ("widest object", object_width())):
            if narrowest <= size:
                rule = f"the {name} is {size:.2f} m wide, and the narrowest place must be wider"
                raise errors.not_allowed("task width (low)", f"{self.width.low:g} m", rule)
        if self.waypoints:
            (walls,) = _walls(self.route()[None], np.array([self.width.low / 2]))
            if polyline.clearance(shell.outline, jnp.asarray(walls))[0] <= 0:
                rule = "a wall beside them crosses the base at its start; start them ahead"
                raise errors.not_allowed("task waypoints", self.waypoints[:2], rule)

    def courses(self, inputs: CourseInputs) -> tuple[np.ndarray, Pytree]:
        """Return the ends, paths and walls of worlds."""
        targets, inner = super().courses(inputs)
        half = self.width.at(inputs.u["width"]) / 2
        opening = half * self.door_width.at(inputs.u["door_width"])
        course = CorridorCourse.around(inner, half, opening, self.doors)
        if self.has_contact_walls:
            friction = np.full(len(half), max(self.friction_wall, 1e-5))  # MuJoCo's least
            vertices = np.asarray(inner.line.vertices)
            walls, doors = np.split(course.walls, [2 * vertices.shape[1] - 2], axis=1)
            smooth = _without_edges(walls, vertices)
            around = {"walls": np.concatenate([smooth, doors], axis=1), "friction_wall": friction}
            course = course._replace(surroundings=around)
        return targets, course


def spare(vertices: Entries, half: Entries) -> Entries:
    """Return the least length (n,) [m] of paths (n, N, 2) that corners of a half width leave."""
    xp = namespace_of(vertices)
    room = half * xp.tan(xp.abs(turns_of(vertices)) / 2)
    lengths = xp.linalg.norm(xp.diff(vertices, axis=1), axis=-1)
    before, after = (xp.pad(room, ((0, 0), ends)) for ends in ((1, 0), (0, 1)))
    return xp.min(lengths - before - after, axis=1)


def _walls(vertices: Entries, half: Entries) -> Entries:
    """Return the walls (n, W, 2, 2) [m] beside paths (n, N, 2) at a half width (n,) [m]."""
    units, xp = units_of(vertices), namespace_of(vertices)
    first = vertices[:, :1] - _BEHIND * units[:, :1]
    last = vertices[:, -1:] + _BEYOND * units[:, -1:]
    points = xp.concatenate([first, vertices[:, 1:-1], last], axis=1)
    normals = xp.stack([-units[..., 1], units[..., 0]], axis=-1)
    previous = xp.concatenate([normals[:, :1], normals], axis=1)
    following = xp.concatenate([normals, normals[:, -1:]], axis=1)
    mitre = (previous + following) / (1 + xp.sum(previous * following, axis=-1, keepdims=True))
    sides = [points + sign * half[:, None, None] * mitre for sign in (1, -1)]
    return xp.concatenate([xp.stack([s[:, :-1], s[:, 1:]], axis=2) for s in sides], axis=1)


def _without_edges(walls: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return walls (n, W, 2, 2) [m] of paths (n, N, 2) whose inner ends an object cannot meet.

    Walls in one line are joined; unused ones are far away.
    """
    angles = turns_of(vertices)
    sides = walls.reshape(len(walls), 2, -1, 2, 2).copy()  # left and right
    steps = np.diff(sides, axis=3)[:, :, :, 0]
    lengths = np.linalg.norm(steps, axis=-1, keepdims=True)
    shifts = steps * np.minimum(_JOINT / np.maximum(lengths, 1e-9), 0.25)
    out = np.sign(angles)[:, None, :, None] * np.array([-1, 1])[:, None, None]
    sides[:, :, :-1, 1] += out * shifts[:, :, :-1]
    sides[:, :, 1:, 0] -= out * shifts[:, :, 1:]
    for i in reversed(range(angles.shape[1])):
        straight = np.abs(angles[:, i]) < 1e-6
        sides[straight, :, i, 1] = sides[straight, :, i + 1, 1]
        sides[straight, :, i + 1] = _NOWHERE
    return sides.reshape(walls.shape)


def _door(line: Polyline, share: float, inner: Entries, outer: Entries) -> Entries:
    """Return two walls (n, 2, 2, 2) [m] across paths, in the middle of the segment at a share.

    They leave an opening of half width `inner` (n,) [m], and end at `outer` (n,) [m].
    """
    vertices, arcs, xp = line.vertices, line.arcs, namespace_of(line.vertices)
    passed = arcs[:, 1:] <= share * arcs[:, -1:]
    rows, first = np.arange(len(passed)), xp.minimum(passed.sum(axis=1), passed.shape[1] - 1)
    a, b = vertices[rows, first], vertices[rows, first + 1]
    unit = units_of(vertices)[rows, first]
    normal = xp.stack([-unit[:, 1], unit[:, 0]], axis=-1)
    jambs = [(a + b) / 2 + s * x[:, None] * normal for s in (1, -1) for x in (inner, outer)]
    return xp.stack([xp.stack(jambs[:2], axis=1), xp.stack(jambs[2:], axis=1)], axis=1)


TASK = Corridor
