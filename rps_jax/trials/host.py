"""Trials with an engine that JAX does not trace, such as C MuJoCo: it steps worlds on the host.

Sensing, laws and rules run in JAX, as in `trial`. The engine gets positions in the precision of
JAX and steps them in its own precision.
"""

import contextlib
from collections.abc import Iterator, Sequence

import jax
import numpy as np

from rps_jax.control.base import LawParams
from rps_jax.engines.base import Driven, Motion
from rps_jax.engines.mujoco import Batch
from rps_jax.trials import trial
from rps_jax.trials.trial import ControlLoop, Trial, World
from rps_jax.world.opengl import mujoco

_decide = jax.jit(jax.vmap(trial.decide, (0, 0, 0, None)))
_settle = jax.jit(jax.vmap(trial.settle))
outcome = jax.jit(trial.outcome)


def run(
    models: Sequence[mujoco.MjModel],
    worlds: World,
    params: LawParams,
    loop: ControlLoop,
    threads: int,
) -> Iterator[Trial]:
    """Run a batch of worlds to their ends; yield trials at the start and after each control step.

    Args:
      models: of the worlds, the stage of the engine.
      worlds: with leaves (n, ...).
      params: law parameters, with leaves (n, ...).
      loop: physics, rules and law.
      threads: number of threads of the engine.
    """
    worlds, params = jax.device_put((worlds, params), jax.devices("cpu")[0])
    trials = trial.start_all(worlds, params, np.ones(len(worlds.qpos), bool), law=loop.law)
    dtype, robot = trials.qpos.dtype, trial.pushing(worlds)
    start = np.asarray(trials.qpos, float)
    yield trials
    with contextlib.closing(Batch(models, start, threads, robot, **worlds.fields)) as batch:
        while not np.asarray(trials.done).all():
            decided, twist, _ = _decide(worlds, params, trials, loop)
            qpos = np.asarray(decided.qpos)
            running = np.flatnonzero(~np.asarray(decided.done))
            # Only a scripted shift moves the object outside of the engine.
            shifted = np.flatnonzero(np.any(qpos != np.asarray(trials.qpos), axis=1))
            batch.qpos[shifted] = qpos[shifted]
            if running.size:
                twists = np.stack(twist, axis=1)[running].astype(float)
                batch.drive(running, twists, loop.physics.substeps)
            state = Motion(batch.qpos, batch.qvel, batch.warmstart, batch.integral)
            motion = jax.tree.map(lambda x: x.astype(dtype), state)
            force = batch.force.astype(dtype) if loop.law.senses == "force" else None
            trials = _settle(worlds, trials, decided, Driven(motion, force=force))
            yield trials
