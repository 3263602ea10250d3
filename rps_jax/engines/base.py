"""What an engine is: how it checks, stages and drives worlds, and its abilities.

An engine's stage is what all worlds of a batch share; its fields are what each world has of its
own, rows of a pytree. Most engines are traced by JAX: their stage drives a batch inside a compiled
program. One that is not (`traced = False`) steps worlds on the host, by `stepper`.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np

from rps_jax import errors
from rps_jax.control.observation import Twist
from rps_jax.engines import device
from rps_jax.geometry.arrays import Float
from rps_jax.geometry.solid import Solid
from rps_jax.robot.robot import Robot
from rps_jax.world.physics import Physics
from rps_jax.world.scene import Friction

Mode = Literal["forward", "reverse"]  # of differentiation


class Motion(NamedTuple):
    """Where the bodies of a batch of worlds are, and how they move."""

    # In the world: base x, y [m], yaw [rad]; object position [m] and quaternion, scalar first.
    qpos: Float[Any, "*B 10"]
    # Of these [m/s, rad/s]; the object's angular velocity is in its own frame.
    qvel: Float[Any, "*B 9"]
    warmstart: Float[Any, "*B 9"]  # [m/s^2, rad/s^2] last accelerations, for a solver
    integral: Any = None  # (B, 3) [N, N, N m] of the drive of a base whose force is limited


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["twists", "robot"],
    meta_fields=["physics", "force"],
)
@dataclass(frozen=True)
class ControlPeriod:
    """Input of a stage for one control period; a pytree of twists and robots, the rest static."""

    twists: Twist  # (B,) [m/s, m/s, rad/s] of the bases, in their own frames
    physics: Physics
    robot: Robot | None = None  # (B,) whose force is limited; None: bases follow every twist
    force: bool = False  # whether `Driven.force` is computed


class Driven(NamedTuple):
    """A batch after one control period."""

    motion: Motion
    # (B, 3) [N, N, N m] what the object does to the base, about the base's origin and in its frame,
    # the mean over the physics steps of the period; None: nobody asked.
    force: Any = None


@runtime_checkable
class Stage(Protocol):
    """What all worlds of a batch share, and how they are stepped together."""

    def drive(self, fields: Any, motion: Motion, period: ControlPeriod) -> Driven:
        """Step a batch of worlds with these fields (B, ...) for one control period.

        A base is a velocity source at its twist. If its force is limited, it is a body that its
        drive pushes towards the twist: see `robot.drive.push`.
        """
        ...


class Stepper(Protocol):
    """Worlds that are stepped on the host; its arrays can be written to."""

    qpos: Float[np.ndarray, "n 10"]  # as in `Motion`
    qvel: Float[np.ndarray, "n 9"]
    warmstart: Float[np.ndarray, "n 9"]
    integral: Float[np.ndarray, "n 3"] | None
    force: Float[np.ndarray, "n 3"]  # of the last period, as in `Driven`

    def drive(self, which: np.ndarray, twist: np.ndarray, substeps: int) -> None:
        """Step the worlds `which` (m,) with the base held at `twist` (m, 3) in its own frame.

        Or pushed towards it, if there is a robot whose force is limited.
        """
        ...

    def close(self) -> None:
        """End the threads of the stepper."""
        ...


class Engine(abc.ABC):
    """A way to step worlds; its subclasses say what it knows and what suits it."""

    name: ClassVar[str]
    cones: ClassVar[tuple[str, ...]] = ("elliptic", "pyramidal")  # the friction that it knows
    traced: ClassVar[bool] = True  # JAX steps it: its trials can be viewed, and learned in
    side_by_side: ClassVar[bool] = False  # batches of several families fit one program of a GPU
    modes: ClassVar[tuple[Mode, ...]] = ()  # in which it can be differentiated
    newton: ClassVar[bool] = True  # it solves as `Physics` says: by so many iterations
    forces: ClassVar[bool] = True  # a contact can slow and stop the base
    computes_force: ClassVar[bool] = True  # it tells the force of a contact

    def check_physics(self, physics: Physics) -> None:
        """Raises InputError unless the engine knows such physics."""
        if physics.cone not in self.cones:
            raise errors.InputError(
                f"cone = {physics.cone} is not allowed with the engine {self.name}: it must be "
                f"{' or '.join(self.cones)}."
            )

    def check_robot(self, robot: Robot) -> None:
        """Raises InputError unless the engine can step such a base."""
        if robot.driven and not self.forces:
            raise errors.InputError(
                f"engine = {self.name} is not allowed for a robot with a limited force: its base "
                "follows every twist; choose fused, mjx or mujoco."
            )

    def check_senses(self, senses: str) -> None:
        """Raises InputError unless the engine tells what a law senses."""
        if senses == "force" and not self.computes_force:
            raise errors.InputError(
                f"engine = {self.name} is not allowed for a law that senses the contact's "
                "force, which it does not compute: choose fused, mjx or mujoco."
            )

    def check_traced(self) -> None:
        """Raises InputError unless JAX traces its steps."""
        if not self.traced:
            raise errors.InputError(
                f"engine = {self.name} is not allowed: JAX must trace it, as fused, mjx or "
                "quasistatic."
            )

    def check_derivatives(self, mode: Mode, physics: Physics) -> None:
        """Raises InputError unless a trial can be differentiated in this mode."""
        if mode not in self.modes:
            known = f"it knows {' and '.join(self.modes)} mode" if self.modes else "it knows none"
            raise errors.InputError(
                f"engine = {self.name} is not allowed in {mode}-mode differentiation: {known}."
            )

    @abc.abstractmethod
    def stage(
        self,
        family: str,
        solids: Solid,
        friction: Friction,
        physics: Physics,
        robots: Robot = Robot(),
    ) -> tuple[Any, Any]:
        """Return the stage, and fields (n, ...) on the host, of worlds of one shape family.

        Their solids are (n, ...), their friction and robots (n,). What MuJoCo would derive in
        compiling each of them is computed here, for all at once.
        """

    def slots(self, backend: str) -> int:
        """Worlds that one worker steps at once on a device of this kind."""
        return 64 if backend == "cpu" else 65536

    def workers(self, backend: str) -> int:
        """Host threads that each drive a batch of their own.

        A processor gets one for each core, since XLA steps a small batch on one core.
        """
        return device.count_processors() if backend == "cpu" else 1

    def suits_processors(self, trials: int | None) -> bool:
        """Whether processors end so many trials sooner than a GPU; None: nobody knows how many."""
        return False

    def levers(self, family: str) -> dict[str, Callable[[Any], Any]]:
        """Changes of the stage that are worth timing, by name: see `sweeps/levers`."""
        return {}

    def contacts(self, stage: Any, corners: int) -> int:
        """Points of contact that a program looks into, in a world of an object with `corners`."""
        return 3 + 2 if corners == 1 else corners + 4

    def stepper(
        self, stage: Any, qpos: np.ndarray, threads: int, robots: Robot | None = None
    ) -> Stepper:
        """Worlds on the host, at rest at positions (n, 10), of an engine that is not traced."""
        raise NotImplementedError(f"{self.name} is traced")
