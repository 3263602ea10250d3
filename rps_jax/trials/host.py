"""Trials with an engine that JAX does not trace, such as C MuJoCo: it steps worlds on the host.

Sensing, laws and rules run in JAX, as in `trial`. The engine gets positions in the precision of
JAX and steps them in its own precision.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from rps_jax.control.base import LawParams
from rps_jax.engines.base import Driven, Engine, Motion
from rps_jax.trials import trial
from rps_jax.trials.trial import ControlLoop, Snapshot, Trial, World

_REPORT_STEPS = 500  # control steps between two reports


_decide = jax.jit(jax.vmap(trial.decide, (0, 0, 0, None)))
_settle = jax.jit(jax.vmap(trial.settle))


def run(
    engine: Engine,
    stage: Any,
    worlds: World,
    params: LawParams,
    loop: ControlLoop,
    *,
    threads: int,
    callback: Callable[[np.ndarray, Trial, float], bool],
    watch: Callable[[int, Snapshot], object] = lambda step, snapshot: None,
) -> Trial:
    """Run a batch of worlds to their ends, and return the trials.

    Args:
      engine: an engine that JAX does not trace.
      stage: argument of the engine's `stepper`.
      worlds: with leaves (n, ...).
      params: law parameters, likewise.
      loop: physics, rules and law.
      threads: number of threads of the engine.
      callback: called at times as `callback(ended, trials, simulated)` with the indices of the
        trials that have ended since the last call and the simulated time [s] summed over trials;
        returns whether to go on.
      watch: called in every control step with its index and the snapshot of all trials.
    """
    physics, law = loop.physics, loop.law
    count = len(worlds.qpos)
    host = jax.devices("cpu")[0]
    worlds, params = jax.device_put((worlds, params), host)
    trials = trial.start_all(worlds, params, np.ones(count, bool), law=law)
    robot = trial.pushing(worlds)
    stepper = engine.stepper(stage, np.asarray(trials.qpos, float), threads, robot)
    try:
        reported = np.zeros(count, bool)
        steps_reported, step, dtype = 0, 0, trials.qpos.dtype
        while not reported.all():
            decided, twist, snapshot = _decide(worlds, params, trials, loop)
            qpos = np.asarray(decided.qpos)
            watch(step, snapshot)
            running = np.flatnonzero(~np.asarray(decided.done))
            # Only a scripted shift moves the object outside of the engine.
            shifted = np.flatnonzero(np.any(qpos != np.asarray(trials.qpos), axis=1))
            stepper.qpos[shifted] = qpos[shifted]
            if running.size:
                twists = np.stack(twist, axis=1)[running].astype(float)
                stepper.drive(running, twists, physics.substeps)
            after = Motion(stepper.qpos, stepper.qvel, stepper.warmstart, stepper.integral)
            motion = jax.tree.map(lambda x: x.astype(dtype), after)
            force = stepper.force.astype(dtype) if law.senses == "force" else None
            trials = _settle(trials, decided, Driven(motion, force=force))
            step += 1
            if step % _REPORT_STEPS == 0 or not running.size:
                done, steps = np.asarray(trials.done), int(np.asarray(trials.steps).sum())
                simulated = (steps - steps_reported) * physics.control_period
                if not callback(np.flatnonzero(done & ~reported), trials, simulated):
                    return trials
                reported, steps_reported = done, steps
        return trials
    finally:
        stepper.close()
