"""The same trials in C MuJoCo, the engine that MJX is measured against.

Sensing, deciding and the rules are those of `trials.trial`, called through JAX on the host; the
engine is the only difference. Positions are handed over in JAX's precision and stepped in double.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import mujoco
import numpy as np
from mujoco import rollout

from rps_jax.control.strategies import Strategy
from rps_jax.trials import trial
from rps_jax.trials.trial import Driven, Rules, Trial, World
from rps_jax.world.physics import Physics
from rps_jax.world.scene import JOINTS

_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
_LOOK = 500  # control steps between two reports


@partial(jax.jit, static_argnames=("physics", "strategy"))
def _decide(worlds: World, trials: Trial, **options: Any):
    return jax.vmap(partial(trial.decide, **options))(worlds, trials)[:2]


_settle = jax.jit(jax.vmap(trial.settle))


def _as_it_goes(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model without MuJoCo's habit to put a world that runs away back to its start, unasked."""
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model


class Batch:
    """Worlds stepped by C MuJoCo on a pool of threads: (time, qpos, qvel) of each, in double."""

    def __init__(self, models: Sequence[mujoco.MjModel], qpos: np.ndarray, threads: int):
        """Start from positions (n, 10) at rest; the models are of one shape family."""
        self.models = [_as_it_goes(model) for model in models]
        nq, nv = models[0].nq, models[0].nv
        size = mujoco.mj_stateSize(models[0], _STATE)
        assert size == 1 + nq + nv, "the scenes have neither actuators nor plugins"
        assert all((m.geom_type == models[0].geom_type).all() for m in models), "one family"
        self.state = np.zeros((len(models), size))
        self.qpos = self.state[:, 1 : 1 + nq]
        self.qvel = self.state[:, 1 + nq :]
        self.qpos[:] = qpos
        self.warmstart = np.zeros((len(models), nv))
        self._timestep = models[0].opt.timestep
        self._data = [mujoco.MjData(models[0]) for _ in range(threads)]
        self._pool = rollout.Rollout(nthread=threads)

    def drive(self, which: np.ndarray, twist: np.ndarray, substeps: int) -> None:
        """Step the worlds `which` (n,) with the base held at `twist` (n, 3) in its own frame.

        The velocity is written once, along the heading of mid-period. `trial.drive` turns it at
        every step, along the heading of the step's beginning, half a step behind: less than
        0.001 rad.
        """
        models = [self.models[i] for i in which]
        state = self.state[which]
        nq = self.qpos.shape[1]
        v_x, v_y, omega = twist.T
        yaw = state[:, 1 + JOINTS.base.start + 2] + omega * (substeps * self._timestep / 2)
        c, s = np.cos(yaw), np.sin(yaw)
        state[:, 1 + nq :][:, JOINTS.base] = np.stack(
            [c * v_x - s * v_y, s * v_x + c * v_y, omega], axis=1
        )
        warmstart = self.warmstart[which]
        after, _ = self._pool.rollout(
            models, self._data, state, nstep=substeps, initial_warmstart=warmstart
        )
        after = np.asarray(after)
        before_last = after[:, -2] if substeps > 1 else state
        # Euler's rule gives back the acceleration, with which the next step starts.
        difference = after[:, -1, 1 + nq :] - before_last[:, 1 + nq :]
        self.state[which], self.warmstart[which] = after[:, -1], difference / self._timestep

    def close(self) -> None:
        """Ends the threads."""
        self._pool.close()


def run(
    models: Sequence[mujoco.MjModel],
    worlds: World,
    *,
    physics: Physics,
    rules: Rules,
    strategy: Strategy,
    threads: int,
    report: Callable[[np.ndarray, Trial, float], bool],
) -> None:
    """Run a batch of worlds to their ends.

    `report(ended, trials, simulated)` is told now and then which trials (n,) have ended since, and
    how many seconds were simulated, summed over all; it answers whether to go on.
    """
    options = {"physics": physics, "rules": rules, "strategy": strategy}
    host = jax.devices("cpu")[0]  # where the engine is
    worlds = jax.device_put(worlds, host)
    trials = trial.start_all(worlds, np.ones(len(models), bool), strategy=strategy)
    batch = Batch(models, np.asarray(trials.qpos, float), threads)
    warning = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)  # what runs away is an outcome, not a file of lines
    try:
        told_of = np.zeros(len(models), bool)
        before, count = 0, 0
        while not told_of.all():
            told, twist = _decide(worlds, trials, **options)
            going = np.flatnonzero(~np.asarray(told.done))
            # Only a hand that shifts the object moves it outside the engine.
            shifted = np.flatnonzero(np.any(np.asarray(told.qpos != trials.qpos), axis=1))
            batch.qpos[shifted] = np.asarray(told.qpos)[shifted]
            if going.size:
                batch.drive(going, np.stack(twist, axis=1)[going].astype(float), physics.substeps)
            dtype = trials.qpos.dtype
            after = (batch.qpos, batch.qvel, batch.warmstart)
            trials = _settle(trials, told, Driven(*(x.astype(dtype) for x in after)))
            count += 1
            if count % _LOOK == 0 or not going.size:
                done, steps = np.asarray(trials.done), int(np.asarray(trials.steps).sum())
                simulated = (steps - before) * physics.control_period
                if not report(np.flatnonzero(done & ~told_of), trials, simulated):
                    return
                told_of, before = done, steps
    finally:
        mujoco.set_mju_user_warning(warning)
        batch.close()
