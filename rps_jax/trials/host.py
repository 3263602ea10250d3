"""Trials with an engine that JAX does not trace, such as C MuJoCo: it steps worlds on the host.

Sensing, laws and rules run in JAX, as in `trial`. The engine gets positions in the precision of
JAX and steps them in its own precision.
"""

from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from rps_jax.control.base import LawParams
from rps_jax.engines.base import Driven, Engine, Motion
from rps_jax.trials import trial
from rps_jax.trials.trial import ControlLoop, Snapshot, Trial, World

_decide = jax.jit(jax.vmap(trial.decide, (0, 0, 0, None)))
_settle = jax.jit(jax.vmap(trial.settle))


def run(
    engine: Engine, stage: Any, worlds: World, params: LawParams, loop: ControlLoop, threads: int
) -> Iterator[tuple[Trial, Snapshot]]:
    """Run a batch of worlds to their ends; yield trials and snapshots of each control step.

    Args:
      engine: an engine that JAX does not trace.
      stage: argument of the engine's `stepper`.
      worlds: with leaves (n, ...).
      params: law parameters, likewise.
      loop: physics, rules and law.
      threads: number of threads of the engine.
    """
    worlds, params = jax.device_put((worlds, params), jax.devices("cpu")[0])
    trials = trial.start_all(worlds, params, np.ones(len(worlds.qpos), bool), law=loop.law)
    dtype, robot = trials.qpos.dtype, trial.pushing(worlds)
    stepper = engine.stepper(stage, np.asarray(trials.qpos, float), threads, robot)
    try:
        while not np.asarray(trials.done).all():
            decided, twist, snapshot = _decide(worlds, params, trials, loop)
            qpos = np.asarray(decided.qpos)
            running = np.flatnonzero(~np.asarray(decided.done))
            # Only a scripted shift moves the object outside of the engine.
            shifted = np.flatnonzero(np.any(qpos != np.asarray(trials.qpos), axis=1))
            stepper.qpos[shifted] = qpos[shifted]
            if running.size:
                twists = np.stack(twist, axis=1)[running].astype(float)
                stepper.drive(running, twists, loop.physics.substeps)
            after = Motion(stepper.qpos, stepper.qvel, stepper.warmstart, stepper.integral)
            motion = jax.tree.map(lambda x: x.astype(dtype), after)
            force = stepper.force.astype(dtype) if loop.law.senses == "force" else None
            trials = _settle(trials, decided, Driven(motion, force=force))
            yield trials, snapshot
    finally:
        stepper.close()
