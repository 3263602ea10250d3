"""C MuJoCo, the engine that MJX is measured against: it steps worlds on the host, in double."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import jax
import mujoco
import numpy as np
from mujoco import rollout

from rps_jax.engines.base import Engine
from rps_jax.geometry.solid import Solid
from rps_jax.robot import drive as drives
from rps_jax.robot.robot import Robot
from rps_jax.world import scene
from rps_jax.world.physics import Physics
from rps_jax.world.scene import JOINTS, Friction

_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


def _as_it_goes(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model without MuJoCo's habit to put a world that runs away back to its start, unasked."""
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model


def _in_base(wrench: np.ndarray, turn: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Wrenches (n, 3) along the world's axes in the base's frame, of headings' (cos, sin) (n,)."""
    (x, y, torque), (c, s) = wrench.T, turn
    return np.stack([c * x + s * y, c * y - s * x, torque], axis=1)


class Batch:
    """Worlds stepped by C MuJoCo on a pool of threads: (time, qpos, qvel) of each, in double."""

    def __init__(
        self,
        models: Sequence[mujoco.MjModel],
        qpos: np.ndarray,
        threads: int,
        robots: Robot | None = None,
    ):
        """Start from positions (n, 10) at rest; the models are of one shape family.

        `robots` (n,) are of bases whose force is limited.
        """
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
        self._robots = robots
        self.integral = None if robots is None else np.zeros((len(models), 3))
        self.force = np.zeros((len(models), 3))
        self._inertia = np.array([model.dof_M0[JOINTS.base] for model in models])
        self._timestep = models[0].opt.timestep
        self._data = [mujoco.MjData(models[0]) for _ in range(threads)]
        self._pool = rollout.Rollout(nthread=threads)
        self._warning = mujoco.get_mju_user_warning()
        # What runs away is an outcome, not a file of lines.
        mujoco.set_mju_user_warning(lambda _: None)

    def drive(self, which: np.ndarray, twist: np.ndarray, substeps: int) -> None:
        """Step the worlds `which` (n,) with the base held at `twist` (n, 3) in its own frame.

        The velocity is written once, along the heading of mid-period. The other engines turn it at
        every step, along the heading of the step's beginning, half a step behind: less than
        0.001 rad.
        """
        if self._robots is not None:
            self._push(which, twist, substeps)
            return
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
        # Nothing but contact changes the velocity of the base, if by little: that is its force.
        gained = after[:, -1, 1 + nq :][:, JOINTS.base] - state[:, 1 + nq :][:, JOINTS.base]
        felt = self._inertia[which] * gained / (substeps * self._timestep)
        self.force[which] = _in_base(felt, (c, s))
        self.state[which], self.warmstart[which] = after[:, -1], difference / self._timestep

    def _push(self, which: np.ndarray, twist: np.ndarray, substeps: int) -> None:
        """Step the worlds `which` with their bases pushed by their drives towards `twist`."""
        models, dt = [self.models[i] for i in which], self._timestep
        robots = jax.tree.map(lambda leaf: np.asarray(leaf, float)[which], self._robots)
        assert self.integral is not None
        state, warmstart = self.state[which], self.warmstart[which]
        integral, nq = tuple(self.integral[which].T), self.qpos.shape[1]
        applied = np.zeros((len(which), 1, self.qvel.shape[1]))
        felt = np.zeros((len(which), 3))
        for _ in range(substeps):
            yaw, qvel = state[:, 1 + JOINTS.base.start + 2], state[:, 1 + nq :]
            turn, base = (np.cos(yaw), np.sin(yaw)), tuple(qvel[:, JOINTS.base].T)
            force, integral = drives.push(robots, integral, tuple(twist.T), base, turn, dt, np)
            applied[:, 0, JOINTS.base] = np.stack(force, axis=1)
            after, _ = self._pool.rollout(
                models,
                self._data,
                state,
                applied,
                control_spec=int(mujoco.mjtState.mjSTATE_QFRC_APPLIED),
                nstep=1,
                initial_warmstart=warmstart,
            )
            after = np.asarray(after)[:, -1]
            warmstart = (after[:, 1 + nq :] - qvel) / dt
            of_contact = self._inertia[which] * warmstart[:, JOINTS.base] - np.stack(force, axis=1)
            felt += _in_base(of_contact, turn) / substeps
            state = after
        self.state[which], self.warmstart[which] = state, warmstart
        self.integral[which] = np.stack(integral, axis=1)
        self.force[which] = felt

    def close(self) -> None:
        """End the threads, and let MuJoCo warn again."""
        mujoco.set_mju_user_warning(self._warning)
        self._pool.close()


class MuJoCo(Engine):
    """C MuJoCo on all cores; worlds share nothing, and their stage is a list of models."""

    name = "mujoco"
    traced = False

    def suits_processors(self, trials: int | None) -> bool:
        """It steps worlds on the host."""
        return True

    def stage(
        self,
        family: str,
        solids: Solid,
        friction: Friction,
        physics: Physics,
        robots: Robot = Robot(),
    ) -> tuple[list[mujoco.MjModel], dict[str, np.ndarray]]:
        """Return the models of the worlds; equal worlds share one."""
        count, models = solids.mass.size, dict[bytes, mujoco.MjModel]()
        robots = scene.repeat_robot(robots, count)
        leaves = [np.ascontiguousarray(x) for x in jax.tree.leaves((solids, friction, robots))]
        keys = [b"".join(leaf[i].tobytes() for leaf in leaves) for i in range(count)]
        for i, key in enumerate(keys):
            if key not in models:
                loaded = scene.compile_row(family, solids, friction, physics, i, robots)
                models[key] = loaded.physics
        return [models[key] for key in keys], {}

    def stepper(
        self, stage: Any, qpos: np.ndarray, threads: int, robots: Robot | None = None
    ) -> Batch:
        """Worlds on a pool of threads."""
        return Batch(stage, qpos, threads, robots)


ENGINE = MuJoCo()
