"""Live trials: one world that is stepped on demand, disturbed and rewound, as in the viewer.

live = Live(pushes.build([case], setting), setting)
moment = live.step()
live.set_target((1.0, 2.0))
live.shove((0.0, 0.2))
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import engines, errors
from rps_jax.control.base import LawParams, Memory
from rps_jax.geometry.arrays import Array
from rps_jax.robot.skin import CapacitiveSkin
from rps_jax.trials import trial
from rps_jax.trials.batch import stepper
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Outcome, Shift, Snapshot, Trial, World
from rps_jax.trials.worlds import WorldBatch, memory_of, rows
from rps_jax.world.tasks.base import heading_of, is_relative

CHUNK = 25  # steps, at most, between two checks of the clock


class Moment(NamedTuple):
    """State and snapshot of one control step, on the host."""

    worlds: World  # (1, ...) with the target and the shove of this step
    trial: Trial  # before the step
    snapshot: Snapshot
    p_world_contact: np.ndarray  # (2,) [m], NaN without contact
    compression: np.ndarray  # (T,) [1] of the foam under each taxel, in strip order


class Live:
    """World that is stepped a control period at a time.

    Changes take effect with the next step. A trial that has succeeded continues when its target
    moves or its object is shoved; one that has failed or diverged does not.

    Raises:
      InputError: an engine that JAX does not trace.
    """

    def __init__(self, part: WorldBatch, setting: Setting, slots: int = 1) -> None:
        """Start the first of some worlds, with the bits of a run with so many slots."""
        engines.get(setting.engine).check_traced()
        self._loop = ControlLoop(setting.physics, setting.rules, part.law)
        self._advance = stepper(part, setting, slots)
        self._first: World = rows(part.worlds, slice(1))
        self._params = rows(part.params, slice(1))
        self.past: list[Moment] = []
        self.reset()

    # --- state ---

    @property
    def period(self) -> float:
        """Control period [s]."""
        return self._loop.physics.control_period

    @property
    def done(self) -> bool:
        """Whether the trial has ended."""
        return bool(self._trial.done[0])

    @property
    def outcome(self) -> Outcome:
        """Outcome so far, without a batch axis."""
        return rows(
            jax.device_get(trial.compiled_outcome(self._trial, self._worlds, self._loop)), 0
        )

    @property
    def p_world_target(self) -> np.ndarray:
        """Target (2,) [m] in the world."""
        return np.asarray(self._worlds.p_world_target[0])

    @property
    def yaw_target(self) -> float | None:
        """Heading of the goal [rad]; None if it has none."""
        return yaw_target(self._worlds)

    @property
    def lines(self) -> dict[str, np.ndarray]:
        """Lines of the task for pictures: see `Course.lines`."""
        return rows(self._worlds.task, 0).lines()

    @property
    def has_own_end(self) -> bool:
        """Whether the task has its own end, so that the target cannot be moved."""
        return "path" in self.lines

    def memory_at(self, index: int) -> Memory:
        """Return what the law remembers before a step of `past`."""
        return memory_of(rows(self._params, 0), self.past[index].trial.law_state)

    # --- control ---

    def reset(self) -> None:
        """Return to the start, with the first target."""
        self._worlds = self._first
        self._trial: Trial = self._advance((self._worlds, self._params), None, 0)[0]
        self.past.clear()

    def step(self, count: int = 1) -> None:
        """Run up to `count` control steps; fewer if the trial ends."""
        while count > 0 and not self.done:
            inputs, trials = (self._worlds, self._params), list[Trial]()
            while len(trials) < min(count, CHUNK) and not self.done:
                trials.append(self._trial)
                self._trial = self._advance(inputs, self._trial, 1)[0]
            # As many rows in each call: one program.
            padded = [*trials, *[trials[-1]] * (CHUNK - len(trials))]
            stacked = jax.tree.map(lambda *leaves: np.concatenate(leaves), *padded)
            records = jax.device_get(_observe(*rows(inputs, 0), stacked, self._loop))
            pairs = enumerate(trials)
            self.past += [Moment(self._worlds, rows(x, 0), *rows(records, i)) for i, x in pairs]
            # Reset: the clock of an ended trial stands still, and would repeat the shift.
            self._worlds = self._worlds._replace(shift=self._first.shift)
            count -= CHUNK

    def rewind(self, index: int) -> None:
        """Remove the moments after the moment `index`, and continue from there."""
        if index + 1 < len(self.past):
            self._worlds = self.past[index].worlds
            self._trial = rows(self.past[index + 1].trial, None)
            del self.past[index + 1 :]

    def set_target(self, p_world_target: tuple[float, float], yaw: float | None = None) -> None:
        """Move the target [m], and turn its heading to `yaw` [rad] if it has one in the world.

        Raises:
          InputError: it is not finite, or out of bounds, or the task has its own end.
        """
        if self.has_own_end:
            raise errors.not_allowed("target", p_world_target, "the task has its own end")
        target = errors.check_vector("target", p_world_target, at_least=-50, at_most=50, unit="m")
        dtype = self._worlds.p_world_target.dtype
        goal, task = np.array([target], dtype), self._worlds.task
        if (heading := heading_of(task)) is not None:
            is_kept = yaw is None or is_relative(task)
            heading = heading if is_kept else np.array([yaw], dtype)
            task = task._replace(p_world_goal=goal, heading=heading)
        self._worlds = self._worlds._replace(p_world_target=goal, task=task)
        self._continue(min_distance=np.full_like(self._trial.min_distance, np.inf))

    def shove(self, p_robot: tuple[float, float]) -> None:
        """Move the object by this much [m] in the robot's frame, at once.

        Raises:
          InputError: it is not finite, or more than 5 m.
        """
        offset = errors.check_vector("shove", p_robot, at_least=-5, at_most=5, unit="m")
        time = self._trial.steps * self.period
        dtype = self._worlds.qpos.dtype
        shift = Shift(jnp.asarray(time, dtype), jnp.array([offset], dtype))
        self._worlds = self._worlds._replace(shift=shift)
        self._continue()

    def _continue(self, **changes: object) -> None:
        """Continue a trial that has succeeded, with changes of its state."""
        success = np.zeros_like(self._trial.success)
        done = np.array(self._trial.diverged)
        self._trial = self._trial._replace(done=done, success=success, **changes)


def yaw_target(worlds: World) -> float | None:
    """Return the heading of the goal of the first world [rad]; None if the world has none."""
    heading = heading_of(worlds.task)
    return None if heading is None or is_relative(worlds.task) else float(heading[0])


@jax.jit
@partial(jax.vmap, in_axes=(None, None, 0, None))
def _observe(
    world: World, params: LawParams, trials: Trial, loop: ControlLoop
) -> tuple[Snapshot, Array, Array]:
    """Return snapshot, contact point and compression of a world in several states."""
    snapshot = trial.decide(world, params, trials, loop)[2]
    contact = trial.p_world_contact(rows(snapshot, None))[0]
    skin = world.skin
    # The tolerance of an ideal sensor counts as its foam.
    thickness = skin.foam if isinstance(skin, CapacitiveSkin) else skin.tolerance
    foam = jnp.maximum(thickness, 1e-6)
    taxels = CapacitiveSkin(foam=foam, shell=skin.shell)
    compression = taxels.compression(trial.outline(world, snapshot.qpos))
    return snapshot, contact, jnp.max(jnp.stack(compression), axis=0) / foam
