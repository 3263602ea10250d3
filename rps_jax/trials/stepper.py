"""One trial, live: stepped by hand, disturbed as it goes, its past kept to be gone back to.

live = Live.of_case(case, setting)
moment = live.step()
live.set_target((1.0, 2.0))
live.shove((0.0, 0.2))
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import engines, errors
from rps_jax.control import registry
from rps_jax.control.base import Law, LawParams
from rps_jax.geometry.footprint import Footprint
from rps_jax.robot.skin import CapacitiveSkin
from rps_jax.trials import pushes, trial
from rps_jax.trials.batch import WorldBatch, rows
from rps_jax.trials.pushes import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Outcome, Shift, Snapshot, Trial, World

CHUNK = 25  # steps, at most, that one call of the compiled program takes


class Moment(NamedTuple):
    """One control step, on the host: where everything was, and what was seen and done."""

    worlds: World  # of this moment, (1, ...): its target and its shove
    before: Trial  # as the step found it
    seen: Snapshot
    p_world_contact: np.ndarray  # (2,) [m], NaN without contact
    compression: np.ndarray  # (T,) [1] of the foam under each taxel, in strip order


class Live:
    """One world, stepped a control period at a time.

    What is changed takes hold with the next step. A trial that has arrived goes on when its target
    moves or its object is shoved; one whose time is over, or whose physics ran away, does not.

    Raises:
      InputError: an engine that cannot be followed.
    """

    def __init__(self, part: WorldBatch, law: Law, setting: Setting) -> None:
        engines.get(setting.engine).check_traced()
        self._stage, self._loop = part.stage, ControlLoop(setting.physics, setting.rules, law)
        self._first: World = rows(part.worlds, slice(1))
        self._params = rows(part.params, slice(1))
        self.past: list[Moment] = []
        self.reset()

    @classmethod
    def of_case(cls, case: Case, setting: Setting) -> Live:
        """The trial of a case."""
        return cls(pushes.build([case], setting), registry.law_of(case.params), setting)

    # --- what it is now ---

    @property
    def period(self) -> float:
        """Between two steps [s]."""
        return self._loop.physics.control_period

    @property
    def done(self) -> bool:
        """Whether the trial has ended."""
        return bool(self._now.done[0])

    @property
    def outcome(self) -> Outcome:
        """The result so far, without a batch axis."""
        return rows(jax.device_get(trial.outcome(self._now, self.period)), 0)

    @property
    def p_world_target(self) -> np.ndarray:
        """(2,) [m]."""
        return np.asarray(self._worlds.p_world_target[0])

    # --- what can be done with it ---

    def reset(self) -> None:
        """Back to the start, and the target with it."""
        self._worlds = self._first
        started = trial.start_all(self._worlds, self._params, np.ones(1, bool), law=self._loop.law)
        self._now: Trial = jax.device_get(started)
        self.past.clear()

    def step(self, count: int = 1) -> None:
        """Some control periods, fewer if the trial ends before."""
        while count > 0 and not self.done:
            some = min(count, CHUNK)
            made = _steps(self._stage, self._worlds, self._params, self._now, some, self._loop)
            self._now, kept = jax.device_get(made)
            some -= int(kept[0].done[:some].sum())  # it ended before these
            self.past += [Moment(self._worlds, *rows(kept, i)) for i in range(some)]
            # Done: an ended trial's clock stands, and would meet the moment of the shove again.
            self._worlds = self._worlds._replace(shift=self._first.shift)
            count -= CHUNK

    def rewind(self, index: int) -> None:
        """Forget what came after the moment `index`, and go on from there."""
        after = index + 1
        if after < len(self.past):
            self._worlds = self.past[index].worlds
            self._now = rows(self.past[after].before, None)
            del self.past[after:]

    def set_target(self, p_world_target: tuple[float, float]) -> None:
        """Push towards another place [m] from now on.

        Raises:
          InputError: it is not finite, or out of the world.
        """
        target = [
            errors.check_finite(f"target {axis}", value, at_least=-50, at_most=50, unit="m")
            for axis, value in zip("xy", p_world_target, strict=True)
        ]
        like = self._worlds.p_world_target
        self._worlds = self._worlds._replace(p_world_target=np.array([target], like.dtype))
        self._go_on(min_distance=np.full_like(self._now.min_distance, np.inf))

    def shove(self, p_robot: tuple[float, float]) -> None:
        """Move the object by this much [m] in the robot's frame, at once.

        Raises:
          InputError: it is not finite, or more than 5 m.
        """
        by = [
            errors.check_finite(f"shove {axis}", value, at_least=-5, at_most=5, unit="m")
            for axis, value in zip("xy", p_robot, strict=True)
        ]
        time = self._now.steps * self.period
        dtype = self._worlds.qpos.dtype
        shift = Shift(jnp.asarray(time, dtype), jnp.array([by], dtype))
        self._worlds = self._worlds._replace(shift=shift)
        self._go_on()

    def _go_on(self, **changes: Any) -> None:
        """Go on after an arrival."""
        arrived = np.zeros_like(self._now.success)
        ended = np.array(self._now.diverged)
        self._now = self._now._replace(done=ended, success=arrived, **changes)


@jax.jit
def _steps(
    stage: Any, worlds: World, params: LawParams, trials: Trial, count: int, loop: ControlLoop
) -> tuple[Trial, tuple[Trial, Snapshot, jax.Array, jax.Array]]:
    """Up to CHUNK control steps of a world (1, ...), and what each was: rows (CHUNK, ...)."""

    def one(trials: Trial) -> tuple[Trial, Any]:
        after, seen = trial.control_step(stage, worlds, params, trials, loop)
        placed = jax.vmap(trial.outline)(worlds, seen.qpos)
        compression = jax.vmap(_compression)(worlds.skin, placed)
        contact = trial.p_world_contact(seen)
        return after, rows((trials, seen, contact, compression), 0)

    def body(i: jax.Array, carry: tuple[Trial, Any]) -> tuple[Trial, Any]:
        after, moment = one(carry[0])
        return after, jax.tree.map(lambda every, x: every.at[i].set(x), carry[1], moment)

    like = jax.eval_shape(one, trials)[1]
    blank = jax.tree.map(lambda x: jnp.zeros((CHUNK, *x.shape), x.dtype), like)
    return jax.lax.fori_loop(0, count, body, (trials, blank))


def _compression(sensor: Any, placed: Footprint) -> jax.Array:
    """Greatest compression (T,) [1] under each taxel; an ideal sensor's tolerance is its foam."""
    thickness = sensor.foam if isinstance(sensor, CapacitiveSkin) else sensor.tolerance
    foam = jnp.maximum(thickness, 1e-6)
    felt = CapacitiveSkin(foam=foam, shell=sensor.shell).compression(placed)
    return jnp.max(felt, axis=-1) / foam
