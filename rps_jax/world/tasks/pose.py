"""Poses: the face that a base pushes arrives at a place with a heading.

The heading of the goal is the direction of the last push: the outward normal of the pushed face is
opposite to it. The true face is judged, not the contact, which says nothing of where a face wider
than the base is sideways. The pushed face is the face nearest to the last contact point. A cylinder
has no face: its place is the point of its rim that faces the base, its heading the direction of its
last 0.3 m of way.

With `turn` the goal's heading is relative to the face that is first felt flush: it is the heading
of the base at that moment plus the turn. A cylinder counts as flush at its first touch.

A law that declares that it is done (`Law.is_done`) is judged then and only then, so that the
simulation does not stop it at a lucky moment. Another law is judged in each control step.

A task that extends `Posed` has a goal with a heading, if the user gives one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import planar, solid
from rps_jax.geometry.arrays import Array, Float, Floats
from rps_jax.record.files import Arrays
from rps_jax.robot.shell import Shell
from rps_jax.spec import Spec
from rps_jax.world.quantity import Quantity, Range, check_unused
from rps_jax.world.tasks.base import Aim, CourseInputs, Positions, Task

_SPACING = 0.15  # [m] of way between the stored positions of a cylinder; the heading spans two
_TURN = 2 * math.pi  # [rad]
_ARROW = 0.4  # [m] length of the goal's arrow in pictures


class PoseProgress(NamedTuple):
    """Pushed face of a trial, and its errors."""

    # [m, m, rad, m] middle and inward normal in the object's frame, and width
    face: Float[Array, "*B 4"]
    way: Float[Array, "*B 3 2"]  # [m] earlier positions of a cylinder, the latest first
    errors: Float[Array, "*B 3"]  # [m, m, rad] as `outcomes`; NaN before the first touch
    declared: Floats  # [1] whether the law has declared that it is done
    first: Floats | None = None  # [rad] heading of the face first felt flush; NaN before

    def outcomes(self) -> dict[str, Array]:
        """Return the errors of the pushed face, and whether the law ended the trial."""
        place, sideways, heading = jnp.moveaxis(self.errors, -1, 0)
        named = {"place_error": place, "sideways_error": sideways, "heading_error": heading}
        return named | {"face_width": self.face[..., 3], "declared": self.declared}


class PoseCourse(NamedTuple):
    """Goal of a world, and its tolerances."""

    p_world_goal: Float[Array, "*B 2"]  # [m]
    heading: Floats  # [rad]
    d_success: Floats  # [m]
    yaw_success: Floats  # [rad]
    relative: Floats | None = None  # [1] 1: `heading` is relative to the face first felt flush

    def start(self) -> PoseProgress:
        """Return the progress before the first touch."""
        zero = jnp.zeros_like(self.heading)
        way, errors = jnp.full((3, 2), jnp.inf, zero.dtype), jnp.full(3, jnp.nan, zero.dtype)
        first = None if self.relative is None else errors[0]
        return PoseProgress(jnp.zeros(4, zero.dtype), way, errors, zero, first)

    def step(self, progress: PoseProgress, positions: Positions) -> tuple[PoseProgress, Aim]:
        """Judge the pushed face against the goal."""
        goal, footprint = positions.p_world_goal, positions.footprint
        middle, yaw, touches = positions.p_world_object, positions.object_yaw, positions.touches
        face, way, first = progress.face, progress.way, progress.first
        heading, is_round = self.heading, footprint.vertices.shape[0] < 3
        if is_round:
            way = jnp.where(jnp.isfinite(way), way, middle)
            far = planar.norm(middle - way[0]) > _SPACING
            way = jnp.where(far, jnp.concatenate([middle[None], way[:2]]), way)
            direction = planar.direction(middle - way[2])
        else:
            contact = planar.rotate(-yaw, positions.p_world_contact - middle)
            pushed = _pushed_face(footprint, contact, positions.base[2] - yaw)
            face = jnp.where(touches, pushed, face)
            direction = yaw + face[2]
        if first is not None:
            tilt = jnp.abs(planar.wrap(direction - positions.base[2]))
            is_flush = touches & (is_round | (tilt < self.yaw_success))
            first = jnp.where(jnp.isnan(first) & is_flush, positions.base[2], first)
            heading = first + heading
        rim = -footprint.radius * planar.unit(heading)
        place = middle + (rim if is_round else planar.rotate(yaw, face[:2]))
        away = planar.rotate(-heading, place - goal)
        turn = planar.wrap(direction - heading)
        values = jnp.stack([planar.norm(away), jnp.abs(away[1]), jnp.abs(turn)])
        touched = touches | ~jnp.isnan(progress.errors[0])
        values = jnp.where(touched, values, jnp.nan)
        declared = positions.declared
        is_there = touched & (values[0] < self.d_success) & (values[2] < self.yaw_success)
        success = is_there if declared is None else is_there & declared
        ended = progress.declared if declared is None else declared.astype(values.dtype)
        aim = Aim(goal, yaw_target=self.heading, relative=self.relative, success=success)
        return PoseProgress(face, way, values, ended, first), aim

    def remaining(self, progress: PoseProgress, p_world_goal: Array, point: Array) -> Array:
        """Return the distance to the goal."""
        return planar.norm(p_world_goal - point)

    def lines(self) -> Arrays:
        """Return the goal's arrow, which ends at its place; none if its heading is relative."""
        if self.relative is not None:
            return {}
        tip = np.asarray(self.p_world_goal, float)
        tail = tip - _ARROW * solid.unit(np.asarray(self.heading, float))
        return {"goal": np.stack([tail, tip], axis=-2)}


def _pushed_face(
    footprint: fp.Footprint, contact: Float[Array, "2"], base_yaw: Floats
) -> Float[Array, "4"]:
    """Return middle, inward normal and width of the face nearest to a contact point.

    All are in the object's frame. Near a corner the face that the base looks at is preferred.
    """
    start = footprint.vertices
    along = jnp.roll(start, -1, axis=0) - start
    length = planar.norm(along)
    share = jnp.sum((contact - start) * along, axis=-1) / jnp.maximum(length**2, 1e-12)
    nearest = start + jnp.clip(share, 0, 1)[:, None] * along
    inward = planar.direction(jnp.stack([-along[:, 1], along[:, 0]], axis=-1))
    away = planar.norm(contact - nearest) - 0.02 * jnp.cos(inward - base_yaw)
    away = jnp.where(length > 0, away, jnp.inf)
    faces = jnp.concatenate([start + along / 2, inward[:, None], length[:, None]], axis=-1)
    return faces[jnp.argmin(away)]


_HEADING = Quantity("rad", "heading of the last push", -_TURN, _TURN, owner="course")


@dataclass(frozen=True)
class Posed(Task):
    """Tasks whose goal may have a heading."""

    heading: Annotated[Range | None, _HEADING] = None

    def __post_init__(self) -> None:
        for angle in self.heading[:2] if self.heading else ():
            errors.check_angle("task heading", angle)
        super().__post_init__()

    @property
    def shape(self) -> Hashable:
        """Kind, and whether there is a heading."""
        return self.kind, self.heading is None

    @property
    def outcomes(self) -> Mapping[str, Spec]:
        return {**self.OUTCOMES, **(Pose.OUTCOMES if self.heading else {})}

    @property
    def idle(self) -> frozenset[str]:
        """Names of the numbers that are not drawn."""
        return frozenset(() if self.heading else ("heading",))

    def goals(self, inputs: CourseInputs, targets: np.ndarray) -> PoseCourse | None:
        """Return the goals at the targets (n, 2) [m] of worlds; None without a heading."""
        if self.heading is None:
            return None
        heading = self.heading.at(inputs.u["heading"]) + inputs.bearing
        task = self if isinstance(self, Pose) else Pose
        limits = (0 * heading + x for x in (task.d_success, task.yaw_success))
        leaves: Any = (targets, heading, *limits)
        return PoseCourse(*leaves)


@dataclass(frozen=True)
class Pose(Posed):
    """Push a face of the object to a place with a heading."""

    kind: str = "pose"
    HAS_TARGET = True
    OUTCOMES: ClassVar[dict[str, Spec]] = {
        "place_error": Spec("m", "distance of the pushed face's middle from the goal at the end"),
        "sideways_error": Spec("m", "part of it across the goal's heading"),
        "heading_error": Spec("rad", "angle between the pushed face's normal and the goal's"),
        "face_width": Spec("m", "width of the pushed face; 0 for a cylinder"),
        "declared": Spec("1", "whether the law declared that it was done"),
    }

    heading: Annotated[Range, _HEADING] = Range(-math.pi, math.pi)
    turn: Annotated[
        float | None,
        Spec("rad", "heading relative to the face that is first felt flush", -_TURN, _TURN),
    ] = None
    d_success: Annotated[float, Spec("m", "greatest error of the place", gt=0, le=1)] = 0.05
    yaw_success: Annotated[float, Spec("rad", "greatest error of the heading", gt=0, le=3.2)] = 0.1

    def check(self) -> None:
        """Raise InputError for a heading beside a turn."""
        check_unused(self, "task ", dict.fromkeys(self.idle, "its turn leaves"))

    @property
    def shape(self) -> Hashable:
        """Shape of a goal, and whether its heading is relative."""
        return super().shape, self.turn is None

    @property
    def idle(self) -> frozenset[str]:
        """Names of the numbers that are not drawn."""
        return frozenset(() if self.turn is None else ("heading",))

    def check_goal(
        self, target: Sequence[float], shell: Shell, object_width: Callable[[], float]
    ) -> None:
        """Raise InputError for a goal (x, y) [m] in the object's start."""
        (x, y), width = target, object_width()
        reach = float(shell.half[0]) + width
        if 0 <= x <= reach and abs(y) <= width / 2:
            rule = f"the object starts there, up to {reach:.2f} m ahead; choose a target beyond it"
            raise errors.not_allowed("target", f"({x:g}, {y:g}) m", rule)

    def courses(self, inputs: CourseInputs) -> tuple[np.ndarray, PoseCourse]:
        """Return the goals."""
        goals: Any = self.goals(inputs, inputs.p_world_target)
        if self.turn is not None:
            turn = np.full_like(goals.heading, self.turn)
            goals = goals._replace(heading=turn, relative=np.ones_like(turn))
        return inputs.p_world_target, goals


TASK = Pose
