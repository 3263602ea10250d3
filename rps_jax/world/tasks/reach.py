"""The paper's task: the contact point reaches a target on an empty floor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array
from rps_jax.record.files import Arrays
from rps_jax.world.tasks.base import Aim, CourseInputs, Positions, Task


class Nothing(NamedTuple):
    """Course and progress of the task: there is nothing but the target."""

    def start(self) -> Nothing:
        """Return the progress, which is nothing."""
        return self

    def step(self, progress: Nothing, positions: Positions) -> tuple[Nothing, Aim]:
        """Return the target as the aim."""
        return progress, Aim(positions.p_world_goal)

    def lines(self) -> Arrays:
        """Return no lines."""
        return {}

    def remaining(self, progress: Nothing, p_world_goal: Array, point: Array) -> Array:
        """Return the distance to the target."""
        return planar.norm(p_world_goal - point)

    def outcomes(self) -> dict[str, Array]:
        """Return no outcomes."""
        return {}


@dataclass(frozen=True)
class Reach(Task):
    """Reach a target, as in the paper."""

    kind: str = "reach"
    HAS_TARGET = True

    def courses(self, inputs: CourseInputs) -> tuple[np.ndarray, Nothing]:
        """Return the targets, and nothing else."""
        return inputs.p_world_target, Nothing()


TASK = Reach
