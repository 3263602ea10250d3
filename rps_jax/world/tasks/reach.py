"""The paper's task: the contact point reaches a target on an empty floor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from rps_jax.world.tasks.base import Aim, CourseInputs, Place, Task


class Nothing(NamedTuple):
    """Course and progress of the task: there is nothing but the target."""

    def start(self) -> Nothing:
        return self

    def step(self, progress: Nothing, place: Place) -> tuple[Nothing, Aim]:
        return progress, Aim(place.p_world_goal)

    def lines(self) -> dict[str, np.ndarray]:
        return {}

    def outcomes(self) -> dict[str, Any]:
        return {}


@dataclass(frozen=True)
class Reach(Task):
    """Reach a target, as in the paper."""

    kind: str = "reach"
    HAS_TARGET: ClassVar[bool] = True

    def courses(self, inputs: CourseInputs) -> tuple[np.ndarray, Nothing]:
        return inputs.p_world_target, Nothing()


TASK = Reach
