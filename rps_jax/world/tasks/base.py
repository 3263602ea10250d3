"""Types of a task: its declaration, the parameters of one world, and its verdict.

A task is one file of this folder. It has a frozen dataclass that extends `Task`, with the ranges of
all drawn quantities, and a pytree that is a `Course`, with the parameters of one world.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from rps_jax import errors
from rps_jax.control import registry
from rps_jax.control.base import LawParams
from rps_jax.geometry.arrays import Array, Bool, Entries, Float, Pytree, Scalar, Vector
from rps_jax.geometry.footprint import Footprint
from rps_jax.record.files import Arrays, JsonObject
from rps_jax.record.options import check_fields
from rps_jax.robot.shell import Shell
from rps_jax.spec import Spec
from rps_jax.world.quantity import Range, check_ranges


class Positions(NamedTuple):
    """Position of base, object and contact in the world, in one control step."""

    p_world_goal: Vector  # [m] where the trial ends
    p_world_contact: Vector  # [m]; ignored unless it touches
    touches: Bool[Array, ""]
    base: Float[Array, "3"]  # [m, m, rad] pose of the base
    outline: Footprint  # of the base, in its own frame
    p_world_object: Vector  # [m]
    object_yaw: Scalar  # [rad]
    footprint: Footprint  # of the object, in its own frame
    # Whether the law declares that it is done; None: it cannot.
    declared: Bool[Array, ""] | None = None


class Aim(NamedTuple):
    """Target of a law in one control step, and the verdict of the task."""

    p_world_target: Vector  # [m] of the law
    at_end: Bool[Array, ""] | bool = True  # whether the trial may succeed now
    failed: Bool[Array, ""] | bool = False
    yaw_target: Scalar | None = None  # [rad] heading of the goal; None: it has none
    relative: Scalar | None = None  # as `Observation.relative`
    # The task's own verdict; None: the contact point is within `d_success` of the target.
    success: Bool[Array, ""] | None = None


class Course(Protocol):
    """Parameters of a task in one world: a pytree."""

    def start(self) -> Pytree:
        """Return the progress before the first control step.

        It is a pytree, whose `outcomes()` are those of `Task.OUTCOMES`, batched or not.
        """
        ...

    def step(self, progress: Pytree, positions: Positions) -> tuple[Pytree, Aim]:
        """Return the progress after one control step, and the aim."""
        ...

    def remaining(self, progress: Pytree, p_world_goal: Array, point: Array) -> Array:
        """Return the way [m] from a point (2,) [m] to the end, for rewards."""
        ...

    def lines(self) -> Arrays:
        """Return what pictures show: polylines (..., N, 2) [m] by name, `path` and `walls`."""
        ...


def heading_of(course: Course | Task) -> Entries:
    """Return the heading of a course's goal [rad], or a task's range of it; None without one.

    It is the field `heading` of either, or of the goal of a course along a path.
    """
    course = getattr(course, "path", course)
    return getattr(getattr(course, "goal", None) or course, "heading", None)


def is_relative(course: Course) -> bool:
    """Return whether the heading of a course's goal is relative to a face that a trial feels."""
    return getattr(course, "relative", None) is not None


class CourseInputs(NamedTuple):
    """Numbers of n worlds on which a task's course depends."""

    u: Mapping[str, np.ndarray]  # (n,) random numbers in [0, 1) of the task's quantities
    p_world_target: np.ndarray  # (n, 2) [m] drawn target of `reach`
    front: np.ndarray  # (n,) [m] x of the base's front
    bearing: float = 0.0  # [rad] by which the trial is turned


@dataclass(frozen=True)
class Task:
    """Declaration of a task: its ranges are fields, its bounds are in their declarations."""

    kind: str = ""  # name of the task
    OUTCOMES: ClassVar[Mapping[str, Spec]] = {}  # those that it adds, by name
    HAS_TARGET: ClassVar[bool] = False  # whether trials end at the domain's targets
    ROOM_OPTIONS: ClassVar[tuple[str, ...]] = ()  # greater ones leave more `free_room`
    # Names of which one identifies a mapping without a kind; `read` turns them into fields.
    MARKS: ClassVar[tuple[str, ...]] = ()
    NUMBERS: ClassVar[tuple[str, ...]] = ()  # names of random numbers without a range
    # Outcomes that are not 0 in a trial that the task has failed, 1 by the base and 2 by the
    # object, with the failure in words.
    FAILURES: ClassVar[dict[str, str]] = {}

    @classmethod
    def read(cls, file: JsonObject, values: JsonObject) -> dict[str, Any]:
        """Return fields from those `MARKS` of a mapping that are no fields, and its `values`."""
        return {}

    def __str__(self) -> str:
        """Return the text that `parse_task` reads: the name and the fields that differ."""
        changes = []
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name != "kind" and value != item.default:
                items = np.ravel(value[:2] if isinstance(value, Range) else value).tolist()
                changes.append(f"{item.name}={':'.join(map(str, items))}")
        return ",".join([self.kind, *changes])

    @property
    def outcomes(self) -> Mapping[str, Spec]:
        """Outcomes that its trials have, by name."""
        return self.OUTCOMES

    @property
    def has_contact_walls(self) -> bool:
        """Whether the object touches walls by contact forces."""
        return False

    def law_fault(self, params: LawParams) -> str:
        """Return why a law does not suit the room around the object, or a moving target."""
        law, rule = registry.law_of(params), ""
        if not self.HAS_TARGET and law.heading and not law.follows:
            rule = "its target moves along a path, which the law does not follow; "
            rule += "choose path_pose, and heading=... for the path's end"
        elif law.room > self.free_room:
            rule = f"its detours need {law.room:g} m without walls around the object, "
            rule += f"not {self.free_room:g} m; choose another law"
            if wider := " or ".join(self.ROOM_OPTIONS):
                rule += f", or give the task a greater {wider}"
        return rule

    def check_law(self, params: LawParams) -> None:
        """Raise InputError unless a law suits the task."""
        if rule := self.law_fault(params):
            name = f"{self.kind} with the law {registry.name_of(params)}"
            raise errors.not_allowed("task", name, rule)

    @property
    def free_room(self) -> float:
        """Distance [m] from the object within which no wall ends the trial of a detour."""
        return math.inf

    @property
    def idle(self) -> frozenset[str]:
        """Names of its quantities that are not drawn."""
        return frozenset()

    def __post_init__(self) -> None:
        check_fields(self, "task ")
        check_ranges(self, "task ")
        self.check()

    @property
    def shape(self) -> Hashable:
        """Key of the shapes of a course; worlds with equal keys share a compiled program."""
        return self.kind

    def check(self) -> None:
        """Raise InputError for values that are not allowed."""

    def check_target(self, field: str, value: object, rule: str = "leave it out") -> None:
        """Raise InputError for a field that needs trials which end at a target."""
        if not self.HAS_TARGET:
            reason = f"the task {self.kind} has its own end; {rule}"
            raise errors.not_allowed(field, value, reason)

    def check_goal(
        self, target: Sequence[float], shell: Shell, object_width: Callable[[], float]
    ) -> None:
        """Raise InputError for a goal (x, y) [m] that an object in front of a base covers.

        `object_width` loads models.
        """

    def check_room(self, shell: Shell, object_width: Callable[[], float]) -> None:
        """Raise InputError unless a base with this shell and the widest object [m] have room.

        `object_width` loads models.
        """

    def measures(self, course: object) -> Arrays:
        """Return quantities (n,) of courses that the drawn numbers do not tell, by name."""
        return {}

    def courses(self, inputs: CourseInputs) -> tuple[np.ndarray, Pytree]:
        """Return the ends (n, 2) [m] of trials, and the `Course` (n, ...) of n worlds."""
        raise NotImplementedError
