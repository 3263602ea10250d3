"""Paths: the contact point follows a polyline or a spline to its end.

The law's target is the point of the path a lookahead ahead of the nearest point (pure pursuit), and
laws do not change. A trial succeeds at the path's end.

With a heading, the path ends in a pose, as in the task `pose`. From the last `APPROACH` on, the law
observes the end and its heading. Before, the heading is NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from rps_jax import errors
from rps_jax.geometry import polyline, solid
from rps_jax.geometry.arrays import Array, Entries, Floats, Int, Pytree, namespace_of
from rps_jax.geometry.polyline import Polyline
from rps_jax.record.files import Arrays
from rps_jax.robot.shell import Shell
from rps_jax.spec import Spec
from rps_jax.world.quantity import Quantity, Range, check_unused
from rps_jax.world.tasks.base import Aim, CourseInputs, Positions
from rps_jax.world.tasks.pose import PoseCourse, Posed, PoseProgress

LOOKAHEAD = Quantity("m", "lookahead on the path", 0.05, 5, owner="course")
_SEGMENTS = 8  # of a drawn path
_PER_SPAN = 6  # segments of a spline between two waypoints
_REACH = 1.0  # [m] along the path, either way, in which the nearest point is sought
APPROACH = 1.6  # [m] before the end, from which on the law gets the heading there
_END = 0.5  # [m] before the end, from which on a trial may succeed
_LEAD = 1.5  # [m] of a drawn path before its first turn, at least
_MIN_SPACING = "consecutive waypoints must be at least 1 cm apart"
NEAR = 0.5  # [m] between the base's front and the first waypoint, at most
# [m] upper ends of the classes of a histogram of errors; the last is open.
_EDGES = np.append(0.0025 * 1.5 ** np.arange(15), np.inf)


class PathProgress(NamedTuple):
    """Progress of a trial along its path, and its cross-track errors."""

    arc: Floats  # [m] of the nearest point so far
    share: Floats  # [1] of the path's length
    sum_error: Floats  # [m] over steps in contact
    max_error: Floats  # [m]
    counts: Int[Array, "*B 16"]  # steps in contact by the class of their error
    pose: PoseProgress | None = None  # of a path that ends in a pose

    def outcomes(self) -> dict[str, Array]:
        """Return progress and cross-track errors; of a trial without contact they are NaN."""
        below = jnp.cumsum(self.counts, axis=-1)
        steps = below[..., -1]
        rank = 0.95 * steps[..., None]
        # Linear within a class; the last class ends at the largest error.
        edges = jnp.asarray(np.append(0.0, _EDGES[:-1]), self.arc.dtype)
        tops = jnp.minimum(jnp.append(edges[1:], jnp.inf), self.max_error[..., None])
        is_there = (below >= rank) & (below - self.counts < rank)
        inner = (rank - (below - self.counts)) / jnp.maximum(self.counts, 1)
        quantile = jnp.sum(jnp.where(is_there, edges + inner * (tops - edges), 0.0), axis=-1)
        nan = jnp.where(steps > 0, 0.0, jnp.nan)
        return {
            "progress": self.share,
            "error_mean": self.sum_error / jnp.maximum(steps, 1) + nan,
            "error_95": quantile + nan,
            "error_max": self.max_error + nan,
            **(self.pose.outcomes() if self.pose else {}),
        }


class PathCourse(NamedTuple):
    """Path of a world."""

    line: Polyline
    lookahead: Floats  # [m]
    goal: PoseCourse | None = None  # pose at its end

    def start(self) -> PathProgress:
        """Return the progress at the start of the path."""
        zero = jnp.zeros_like(self.lookahead)
        counts, pose = jnp.zeros(len(_EDGES), jnp.int32), self.goal and self.goal.start()
        return PathProgress(zero, zero, zero, zero, counts, pose)

    def step(self, progress: PathProgress, positions: Positions) -> tuple[PathProgress, Aim]:
        """Follow the path, and judge the pose at its end."""
        moved, aim = self.follow(progress, positions.p_world_contact, positions.touches)
        if self.goal is None or progress.pose is None:
            return moved, aim
        pose, end = self.goal.step(progress.pose, positions)
        length = self.line.arcs[-1]
        is_near = moved.share * length > length - APPROACH
        # The last pushes to the pose are no errors of the path.
        passed = progress._replace(arc=moved.arc, share=moved.share)
        moved = jax.tree.map(partial(jnp.where, is_near), passed, moved)
        target = jnp.where(is_near, end.p_world_target, aim.p_world_target)
        yaw = jnp.where(is_near, self.goal.heading, jnp.nan)
        success = is_near & jnp.asarray(end.success)
        return moved._replace(pose=pose), Aim(target, yaw_target=yaw, success=success)

    def follow(
        self, progress: PathProgress, p_world_contact: Array, touches: Array
    ) -> tuple[PathProgress, Aim]:
        """Advance to the point nearest to the contact; its distance is the cross-track error."""
        length = self.line.arcs[-1]
        reach = progress.arc - _REACH, progress.arc + _REACH
        arc, error = polyline.nearest(self.line, p_world_contact, *reach)
        arc = jnp.where(touches, arc, progress.arc)
        error = jnp.where(touches, error, 0.0)
        edges = jnp.asarray(_EDGES, error.dtype)
        lower = jnp.asarray(np.append(-1.0, _EDGES[:-1]), error.dtype)
        counted = touches & (error > lower) & (error <= edges)
        moved = PathProgress(
            arc,
            jnp.maximum(progress.share, arc / length),
            progress.sum_error + error,
            jnp.maximum(progress.max_error, error),
            progress.counts + counted,
            progress.pose,
        )
        target = polyline.at_arc(self.line, arc + self.lookahead)
        return moved, Aim(target, at_end=arc > length - _END)

    def remaining(self, progress: PathProgress, p_world_goal: Array, point: Array) -> Array:
        """Return the way from a point to the path and along it, near the contact's arc length."""
        reach = progress.arc - _REACH, progress.arc + _REACH
        arc, away = polyline.nearest(self.line, point, *reach)
        return self.line.arcs[-1] - arc + away

    def lines(self) -> Arrays:
        """Return the path, and the arrow at its end."""
        return {"path": np.asarray(self.line.vertices), **(self.goal.lines() if self.goal else {})}


@dataclass(frozen=True)
class Following(Posed):
    """Tasks that follow a path; their courses are a `PathCourse`, or have it as `path`."""

    OUTCOMES: ClassVar[Mapping[str, Spec]] = {
        "progress": Spec("1", "share of the path that the contact point has passed"),
        "error_mean": Spec("m", "mean cross-track error of the contact point"),
        "error_95": Spec("m", "95 % quantile over time of the cross-track error"),
        "error_max": Spec("m", "largest cross-track error"),
    }

    # Along the path, from its nearest point to the law's target.
    lookahead: Annotated[Range, LOOKAHEAD] = Range(1.6, 1.6)

    def measures(self, course: Pytree) -> Arrays:
        """Return length, number of turns and their mean angle."""
        line: Pytree = getattr(course, "path", course).line
        angles = np.abs(turns_of(np.asarray(line.vertices)))
        count = (angles > 1e-9).sum(axis=1)
        angle = angles.sum(axis=1) / np.maximum(count, 1)
        return {"length": line.arcs[:, -1], "turns": count, "turn_angle": angle}


@dataclass(frozen=True)
class Path(Following):
    """Follow a path, given by its waypoints or drawn."""

    kind: str = "path"
    MARKS = ("waypoints",)
    NUMBERS = tuple(f"turn_angle_{i}" for i in range(_SEGMENTS - 1))

    length: Annotated[Range, Quantity("m", "length of the path", 0.5, 40, owner="course")] = Range(
        4, 8
    )
    turns: Annotated[
        Range,
        Quantity("1", "number of turns", 0, _SEGMENTS - 1, owner="course", jumps=True),
    ] = Range(1, 3)
    turn_angle: Annotated[
        Range, Quantity("rad", "angle of the turns", 0, 1.6, owner="course", numbers=NUMBERS)
    ] = Range(0.3, 0.8)
    # [m] in the world, where the base starts at the origin; then nothing but the lookahead is drawn
    waypoints: tuple[tuple[float, float], ...] = ()
    spline: bool = False  # whether a cubic spline joins the waypoints, instead of straight lines

    @property
    def idle(self) -> frozenset[str]:
        """Names of the quantities that are not drawn; each turn draws its angle."""
        unused = ("length", "turns", *self.NUMBERS) if self.waypoints else ()
        return super().idle | {"turn_angle", *unused}

    @property
    def shape(self) -> Hashable:
        """Shape of a goal, and number of the vertices."""
        return super().shape, len(self.waypoints), self.spline

    def check(self) -> None:
        """Raise InputError for waypoints that are no path."""
        if self.spline and not self.waypoints:
            raise errors.not_allowed("task spline", True, "give waypoints, which it joins")
        if not float(self.turns.low).is_integer() or not float(self.turns.high).is_integer():
            raise errors.not_allowed("task turns", self.turns[:2], "give whole numbers")
        ranges = ("length", "turns", "turn_angle") if self.waypoints else ("turn_angle",)
        if self.waypoints or not self.turns.high:
            check_unused(self, "task ", dict.fromkeys(ranges, "its waypoints or turns leave"))
        if not self.waypoints:
            return
        points = errors.check_array("task waypoints", self.waypoints, ("N", 2))
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        for is_bad, bad, rule in (
            (len(points) < 2, points, "a path has two points or more, each as x, y [m]"),
            (len(points) > 100, points[100:101], "a path has at most 100 waypoints"),
            *((abs(x).max() > 50, x, "give coordinates from -50 to 50, in metres") for x in points),
            *((d < 0.01, points[i : i + 2], _MIN_SPACING) for i, d in enumerate(steps)),
        ):
            if is_bad:
                raise errors.not_allowed("task waypoints", bad.tolist(), rule)

    def courses(self, inputs: CourseInputs) -> tuple[np.ndarray, Pytree]:
        """Return the ends and the paths of worlds."""
        vertices = self.vertices(inputs)
        lookahead: Entries = self.lookahead.at(inputs.u["lookahead"])
        targets, line = vertices[:, -1], Polyline.through(vertices)
        return targets, PathCourse(line, lookahead, self.goals(inputs, targets))

    def check_room(self, shell: Shell, object_width: Callable[[], float]) -> None:
        """Raise InputError for waypoints that start away from the base's front."""
        front = float(shell.half[0])
        x, y = self.waypoints[0] if self.waypoints else (front, 0.0)
        if np.hypot(x - front, y) > NEAR:
            rule = f"they must start within {NEAR} m of the base's front, ({front:.2f}, 0) m"
            raise errors.not_allowed("task waypoints", (x, y), rule)

    def route(self) -> np.ndarray:
        """Return the vertices (N, 2) [m] of the path through the waypoints."""
        points = np.array(self.waypoints, float)
        if not self.spline or len(points) < 3:
            return points
        arcs = Polyline.through(points).arcs
        at = np.arange((len(points) - 1) * _PER_SPAN + 1) / _PER_SPAN
        return scipy.interpolate.CubicSpline(arcs, points)(
            np.interp(at, np.arange(len(points)), arcs)
        )

    def vertices(self, inputs: CourseInputs) -> np.ndarray:
        """Return the vertices (n, N, 2) [m] of paths, which start at the base's front."""
        front, u = inputs.front, inputs.u
        if self.waypoints:
            points = self.route()
            return np.broadcast_to(points, (front.size, *points.shape))
        low, high, _ = self.turns
        count = np.minimum(np.floor(low + (high + 1 - low) * u["turns"]), high)[:, None]
        # A half of each random number is the sign of a turn. Beyond 90 degrees it turns back.
        heading, headings = np.zeros(front.size), [np.zeros(front.size)]
        for name in self.NUMBERS:
            angle = self.turn_angle.at((2 * u[name]) % 1) * np.where(u[name] < 0.5, -1, 1)
            angle = np.where(np.abs(heading + angle) > np.pi / 2 + 1e-9, -angle, angle)
            heading = heading + angle
            headings.append(heading)
        # Segments after the last part have no length.
        k = np.arange(_SEGMENTS)[None]
        part = self.length.at(u["length"])[:, None] / (count + 1)
        lengths = np.where(k <= count, part, 0.0)
        lengths[:, :1] = np.maximum(lengths[:, :1], _LEAD)
        at = np.take_along_axis(np.stack(headings, 1), np.minimum(k, count).astype(int), 1)
        steps = lengths[..., None] * solid.unit(at)
        start = np.stack([front, 0 * front], axis=-1)[:, None]
        return np.concatenate([start, start + np.cumsum(steps, axis=1)], axis=1)


def units_of(vertices: Entries) -> Entries:
    """Return the directions (n, N - 1, 2) of paths (n, N, 2); of no length, the one before."""
    xp = namespace_of(vertices)
    steps = xp.diff(vertices, axis=1)
    lengths = xp.linalg.norm(steps, axis=-1)
    last = xp.where(lengths > 0, np.arange(steps.shape[1]), 0)
    last = xp.maximum.accumulate(last, axis=1)
    units = steps / xp.where(lengths > 0, lengths, 1.0)[..., None]
    return units[np.arange(len(units))[:, None], last]


def turns_of(vertices: Entries) -> Entries:
    """Return the angles (n, N - 2) [rad] by which paths (n, N, 2) turn, positive to the left."""
    units, xp = units_of(vertices), namespace_of(vertices)
    x, y = xp.moveaxis(units[:, :-1], -1, 0), xp.moveaxis(units[:, 1:], -1, 0)
    return xp.arctan2(x[0] * y[1] - x[1] * y[0], x[0] * y[0] + x[1] * y[1])


TASK = Path
