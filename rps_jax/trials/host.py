"""Trials of an engine that JAX does not trace: stepped on the host, decided through JAX.

Sensing, deciding and the rules are those of `trial`; the engine is the only difference. Positions
are handed over in JAX's precision and stepped in the engine's own.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from rps_jax.control.base import LawParams
from rps_jax.engines.base import Driven, Engine, Motion
from rps_jax.trials import trial
from rps_jax.trials.trial import ControlLoop, Snapshot, Trial, World

_LOOK = 500  # control steps between two reports


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
    watch: Callable[[int, Snapshot], Any] = lambda step, seen: None,
) -> Trial:
    """Run a batch of worlds to their ends, and return the trials.

    `report(ended, trials, simulated)` hears now and then which trials (n,) have ended since, and
    how many seconds were simulated, summed over all; it answers whether to go on. `watch` is handed
    every control step, with what all trials looked like at its beginning.
    """
    physics, law = loop.physics, loop.law
    count = len(worlds.qpos)
    host = jax.devices("cpu")[0]  # where the engine is
    worlds, params = jax.device_put((worlds, params), host)
    trials = trial.start_all(worlds, params, np.ones(count, bool), law=law)
    batch = engine.stepper(stage, np.asarray(trials.qpos, float), threads, trial.pushing(worlds))
    try:
        told_of = np.zeros(count, bool)
        before, passes, dtype = 0, 0, trials.qpos.dtype
        while not told_of.all():
            told, twist, seen = _decide(worlds, params, trials, loop)
            now = np.asarray(told.qpos)
            watch(passes, seen)
            going = np.flatnonzero(~np.asarray(told.done))
            # Only a hand that shifts the object moves it outside the engine.
            shifted = np.flatnonzero(np.any(now != np.asarray(trials.qpos), axis=1))
            batch.qpos[shifted] = now[shifted]
            if going.size:
                batch.drive(going, np.stack(twist, axis=1)[going].astype(float), physics.substeps)
            after = Motion(batch.qpos, batch.qvel, batch.warmstart, batch.integral)
            motion = jax.tree.map(lambda x: x.astype(dtype), after)
            felt = batch.force.astype(dtype) if law.senses == "force" else None
            trials = _settle(trials, told, Driven(motion, force=felt))
            passes += 1
            if passes % _LOOK == 0 or not going.size:
                done, steps = np.asarray(trials.done), int(np.asarray(trials.steps).sum())
                simulated = (steps - before) * physics.control_period
                if not callback(np.flatnonzero(done & ~told_of), trials, simulated):
                    return trials
                told_of, before = done, steps
        return trials
    finally:
        batch.close()
