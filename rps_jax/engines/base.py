"""Base class of engines: checks, staging and driving of worlds, and abilities.

All worlds of a batch share the engine's stage; each world has a row of its fields, a pytree. JAX
traces most engines: their stage drives a batch in a compiled program. An engine that JAX does not
trace (`traced = False`) steps worlds on the host: see `HostBatch`.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass, field
from typing import (
    Any,
    ClassVar,
    Literal,
    NamedTuple,
    Protocol,
    TypeVar,
    get_args,
    runtime_checkable,
)

import jax
import numpy as np

from rps_jax import engines, errors
from rps_jax.control.observation import Twist
from rps_jax.engines import device
from rps_jax.engines.native import once_differentiable
from rps_jax.geometry.arrays import Float, Pytree
from rps_jax.robot.robot import Robot
from rps_jax.world.physics import Physics
from rps_jax.world.scene import Surroundings, WorldInputs

Mode = Literal["forward", "reverse"]  # of differentiation
T = TypeVar("T")  # a pytree


class Motion(NamedTuple):
    """Positions and velocities of the bodies of a batch of worlds."""

    # In the world: base x, y [m], yaw [rad]; object position [m] and quaternion, scalar first.
    qpos: Float[Any, "*B 10"]
    # Of these [m/s, rad/s]; the object's angular velocity is in its own frame.
    qvel: Float[Any, "*B 9"]
    warmstart: Float[Any, "*B 9"]  # [m/s^2, rad/s^2] last accelerations, for a solver
    integral: Float[Any, "*B 3"] | None = None  # [N, N, N m] of the drive, if its force is limited


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ControlPeriod:
    """Input of a stage for one control period; a pytree of twists and robots, the rest static."""

    twists: Twist  # (B,) [m/s, m/s, rad/s] of the bases, in their own frames
    physics: Physics = field(metadata={"static": True})
    robot: Robot | None = None  # (B,) whose force is limited; None: bases follow every twist
    # Whether `Driven.force` is computed.
    force: bool = field(default=False, metadata={"static": True})
    # Accelerations of each physics step: () to return them, or those of an equal period, from which
    # its derivatives are computed without a solver; None: neither.
    solutions: Pytree = None


class Driven(NamedTuple):
    """A batch after one control period."""

    motion: Motion
    # [N, N, N m] wrench of the object on the base, about the base's origin and in its frame; mean
    # over the physics steps of the period; None: not requested.
    force: Float[Any, "*B 3"] | None = None
    solutions: Pytree = None  # of `ControlPeriod`, where it requests them


@runtime_checkable
class Stage(Protocol):
    """Shared part of all worlds of a batch, with the function that steps them."""

    native: ClassVar[bool]  # whether `engines.native` can compile the step of one world

    def drive(self, fields: Pytree, motion: Motion, period: ControlPeriod) -> Driven:
        """Step a batch of worlds with these fields (B, ...) for one control period.

        A base is a velocity source at its twist. If its force is limited, it is a body that its
        drive pushes towards the twist: see `robot.base.push`.
        """
        ...


class HostBatch(Protocol):
    """Worlds that an engine steps on the host, in double precision."""

    qpos: np.ndarray  # (n, 10) positions; a shift writes them

    def drive(self, rows: np.ndarray, twist: np.ndarray, substeps: int) -> None:
        """Step the worlds `rows` (n,) with their bases at `twist` (n, 3), in the base's frame."""
        ...

    @property
    def driven(self) -> Driven:
        """Motion and force of all worlds, as arrays of NumPy."""
        ...

    def close(self) -> None:
        """Release what the batch uses."""
        ...


class Engine(abc.ABC):
    """Base class of engines; class variables declare their abilities."""

    name: ClassVar[str]
    cones: ClassVar[tuple[str, ...]] = ("elliptic", "pyramidal")  # supported friction cones
    traced: ClassVar[bool] = True  # JAX traces its steps: trials can be viewed and learned in
    side_by_side: ClassVar[bool] = False  # batches of several families fit one program of a GPU
    modes: ClassVar[tuple[Mode, ...]] = ()  # supported modes of differentiation
    forces: ClassVar[bool] = True  # contact can slow and stop a base with a limited force
    computes_force: ClassVar[bool] = True  # it computes the force of a contact
    surroundings: ClassVar[tuple[str, ...]] = Surroundings._fields  # those that it supports

    def _refused(self, rule: str) -> errors.InputError:
        return errors.not_allowed("engine", self.name, rule)

    def check_stage(self, stage: Stage) -> None:
        """Raise InputError unless the stage is of this engine, or of one that it extends."""
        owner = getattr(stage, "engine", self.name)
        if owner not in [getattr(kind, "name", "") for kind in type(self).__mro__]:
            raise self._refused(f"the worlds were drawn for {owner}; give their setting")

    def check_physics(self, physics: Physics) -> None:
        """Raise InputError unless the engine supports the physics."""
        if physics.cone not in self.cones:
            rule = f"with the engine {self.name} it must be {' or '.join(self.cones)}"
            raise errors.not_allowed("cone", physics.cone, rule)

    def check_robot(self, robot: Robot) -> None:
        """Raise InputError unless the engine can step the base of the robot."""
        if robot.driven and not self.forces:
            raise self._refused("a robot with a limited force needs fused, mjx or mujoco")

    def check_pads(self, has_pads: bool, physics: Physics) -> None:
        """Raise InputError unless the cone can be that of solids, which may have pads."""
        if has_pads and physics.cone == "pyramidal":
            rule = "objects with weights of feet or a distributed support need elliptic"
            raise errors.not_allowed("cone", physics.cone, rule)

    def check_surroundings(self, surroundings: Surroundings) -> None:
        """Raise InputError unless the engine can step worlds with these surroundings."""
        for name, value in surroundings._asdict().items():
            if value is not None and name not in self.surroundings:
                known = [x for x in engines.names() if name in engines.get(x).surroundings]
                raise self._refused(f"it has no {name}; choose {' or '.join(known)}")

    def check_senses(self, senses: str) -> None:
        """Raise InputError unless the engine computes the quantities that a law senses."""
        if senses == "force" and not self.computes_force:
            raise self._refused("it computes no contact force; choose fused, mjx or mujoco")

    def check_traced(self) -> None:
        """Raise InputError unless JAX traces the steps."""
        if not self.traced:
            raise self._refused("JAX must trace it; choose fused, mjx or quasistatic")

    def check_derivatives(self, mode: Mode) -> None:
        """Raise InputError unless a trial can be differentiated in this mode."""
        if mode not in self.modes:
            known = [name for name in engines.names() if mode in engines.get(name).modes]
            raise self._refused(f"it has no {mode}-mode derivatives; choose {' or '.join(known)}")

    def guard_derivatives(self, tree: T) -> T:
        """Return a pytree unchanged, of which missing modes and second derivatives are refused."""
        try:
            for mode in get_args(Mode):
                self.check_derivatives(mode)
        except errors.InputError as error:
            refusal = str(error)
        else:
            return jax.tree.map(once_differentiable, tree)

        def refuse(primals: Pytree, tangents: Pytree) -> Pytree:
            raise errors.InputError(refusal)

        guarded = jax.custom_jvp(lambda tree: tree)
        guarded.defjvp(refuse)
        return guarded(tree)

    @abc.abstractmethod
    def stage(self, inputs: WorldInputs) -> tuple[Pytree, Pytree]:
        """Return the stage, and fields (n, ...) on the host, of worlds of one shape family.

        The constants that MuJoCo derives when it compiles a model are computed for all worlds at
        once.
        """

    def open_batch(
        self, stage: Pytree, qpos: np.ndarray, threads: int, robots: Robot | None, fields: Pytree
    ) -> HostBatch:
        """Return worlds at rest at `qpos` (n, 10), of an engine that JAX does not trace.

        `robots` (n,) have a limited force; `stage` and `fields` (n, ...) are those of `stage()`.
        """
        raise NotImplementedError

    def slots(self, backend: str) -> int:
        """Return the number of worlds that one worker steps at once on a backend."""
        return 64 if backend == "cpu" else 65536

    def workers(self, backend: str) -> int:
        """Return the number of host threads for each device, each of which drives one batch.

        There is one for each processor, since XLA steps a small batch on one processor.
        """
        return device.count_processors() if backend == "cpu" else 1

    def suits_processors(self, trials: int | None) -> bool:
        """Whether processors finish this number of trials sooner than a GPU; None: unknown."""
        return False
