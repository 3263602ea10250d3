"""The engine C MuJoCo, the reference of the others: it steps worlds on the host, in double."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import jax
import numpy as np

from rps_jax.engines import device
from rps_jax.engines.base import Driven, Engine, Motion
from rps_jax.geometry.vectors import turned, turned_back
from rps_jax.record.files import Arrays
from rps_jax.robot.base import Tyres, push
from rps_jax.robot.robot import Robot
from rps_jax.world import scene
from rps_jax.world.opengl import mujoco, rollout
from rps_jax.world.scene import JOINTS, WorldInputs

T = TypeVar("T")
_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


def _without_reset(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a model without MuJoCo's automatic reset of diverged worlds."""
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model


class Batch:
    """Worlds stepped by C MuJoCo on a pool of threads; the state is (time, qpos, qvel)."""

    def __init__(
        self,
        models: Sequence[mujoco.MjModel],
        qpos: np.ndarray,
        threads: int,
        robots: Robot | None = None,
        boundary: np.ndarray | None = None,
    ):
        """Start from positions (n, 10) at rest.

        Args:
          models: of one shape family.
          qpos: positions (n, 10).
          threads: of the pool.
          robots: (n,) with a limited force, if any.
          boundary: (n, 4) of the floors, if they have one: see `Surroundings`.
        """
        self.models = [_without_reset(model) for model in models]
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
        # [N, N, N m] of gravity on the bases along a sloping floor
        self._weight = np.array([[*m.body("base").mass * m.opt.gravity[:2], 0] for m in models])
        self._boundary = boundary
        self._ground = np.flatnonzero(models[0].pair_geom1 == models[0].geom("ground").id)
        self._friction = np.array([model.pair_friction[self._ground, :3] for model in models])
        self._timestep = models[0].opt.timestep
        self._data = [mujoco.MjData(models[0]) for _ in range(threads)]
        self._pool = rollout.Rollout(nthread=threads)
        self._warning = mujoco.get_mju_user_warning()
        # A diverged world is an outcome; MuJoCo would write its warnings to a file.
        mujoco.set_mju_user_warning(lambda _: None)

    @property
    def driven(self) -> Driven:
        """Motion and force of all worlds."""
        motion = Motion(self.qpos, self.qvel, self.warmstart, self.integral)
        return Driven(motion, force=self.force)

    def drive(self, rows: np.ndarray, twist: np.ndarray, substeps: int) -> None:
        """Step the worlds `rows` (n,) with their bases at `twist` (n, 3), in the base's frame.

        The velocity is written once, for the heading at half of the period. The other engines use
        the heading at the start of each step, half a step earlier: less than 0.001 rad.
        """
        if self._boundary is not None:
            self._set_friction(rows, np.asarray(self._boundary))
        if self._robots is not None:
            self._push(rows, twist, substeps)
            return
        state, warmstart, nq = self.state[rows], self.warmstart[rows], self.qpos.shape[1]
        yaw = state[:, 1 + JOINTS.base.start + 2] + twist[:, 2] * (substeps * self._timestep / 2)
        turn = np.cos(yaw), np.sin(yaw)
        velocity = np.stack(turned(turn, tuple(twist.T)), axis=1)
        state[:, 1 + nq :][:, JOINTS.base] = velocity
        states = self._rollout(rows, state, warmstart, nstep=substeps)
        previous = states[:, -2] if substeps > 1 else state
        # By Euler's rule, the last change of velocity is the acceleration: the next first guess.
        change = states[:, -1, 1 + nq :] - previous[:, 1 + nq :]
        # Only contact changes the velocity of the base, by a small amount: that gives its force.
        gained = states[:, -1, 1 + nq :][:, JOINTS.base] - state[:, 1 + nq :][:, JOINTS.base]
        wrench = self._inertia[rows] * gained / (substeps * self._timestep) - self._weight[rows]
        self.force[rows] = np.stack(turned_back(turn, tuple(wrench.T)), axis=1)
        self.state[rows], self.warmstart[rows] = states[:, -1], change / self._timestep

    def _push(self, rows: np.ndarray, twist: np.ndarray, substeps: int) -> None:
        """Step the worlds `rows` with their bases pushed by their drives towards `twist`."""
        dt = self._timestep
        robots = jax.tree.map(lambda leaf: np.asarray(leaf, float)[rows], self._robots)
        assert self.integral is not None
        state, warmstart = self.state[rows], self.warmstart[rows]
        integral, nq = tuple(self.integral[rows].T), self.qpos.shape[1]
        applied = np.zeros((len(rows), 1, self.qvel.shape[1]))
        wrench = np.zeros((len(rows), 3))
        for _ in range(substeps):
            yaw, qvel = state[:, 1 + JOINTS.base.start + 2], state[:, 1 + nq :]
            turn, base = (np.cos(yaw), np.sin(yaw)), tuple(qvel[:, JOINTS.base].T)
            force, integral = push(robots, integral, tuple(twist.T), base, turn, dt, np)
            applied[:, 0, JOINTS.base] = np.stack(force, axis=1)
            tyres = None
            if robots.drive != "omni":
                tyres = Tyres.of(robots, base, turn, dt)
                applied[:, 0, JOINTS.base] += np.stack(tyres.force, axis=1)
                for i, *sideways in zip(rows, *np.broadcast_arrays(*tyres.sideways), strict=True):
                    self.models[i].wrap_prm[:] = sideways
            following = self._rollout(rows, state, warmstart, control=applied, nstep=1)[:, -1]
            warmstart = (following[:, 1 + nq :] - qvel) / dt
            contact = self._inertia[rows] * warmstart[:, JOINTS.base] - np.stack(force, axis=1)
            if tyres is not None:  # what the tyres hold is not of the contact
                held = sum(a * b for a, b in zip(tyres.sideways, warmstart.T, strict=False))
                contact += np.stack(tyres.along(tyres.mass * (held - tyres.rest)), axis=1)
            on_base = turned_back(turn, tuple((contact - self._weight[rows]).T))
            wrench += np.stack(on_base, axis=1) / substeps
            state = following
        self.state[rows], self.warmstart[rows] = state, warmstart
        self.integral[rows] = np.stack(integral, axis=1)
        self.force[rows] = wrench

    def _set_friction(self, rows: np.ndarray, boundary: np.ndarray) -> None:
        """Set the friction of each foot of the worlds `rows` by its side of the boundary.

        It holds for one control period, in which a foot moves by a millimetre.
        """
        for i, (*normal, border, factor) in zip(rows, boundary[rows], strict=True):
            model, data = self.models[i], self._data[0]
            data.qpos[:] = self.qpos[i]
            mujoco.mj_kinematics(model, data)
            feet = data.geom_xpos[model.pair_geom2[self._ground], :2]
            factors = np.where(feet @ normal > border, factor, 1.0)[:, None]
            model.pair_friction[self._ground, :3] = self._friction[i] * factors

    def _rollout(
        self, rows: np.ndarray, state: np.ndarray, warmstart: np.ndarray, **options: Any
    ) -> np.ndarray:
        """Return the states (n, steps, ...) of the worlds `rows`; `control` are forces."""
        models, forces = [self.models[i] for i in rows], mujoco.mjtState.mjSTATE_QFRC_APPLIED
        options |= {"control_spec": int(forces), "initial_warmstart": warmstart}
        return np.asarray(self._pool.rollout(models, self._data, state, **options)[0])

    def close(self) -> None:
        """Stop the threads, and restore MuJoCo's warnings."""
        mujoco.set_mju_user_warning(self._warning)
        self._pool.close()


def compile_rows(
    inputs: WorldInputs, read: Callable[[mujoco.MjModel], T] = lambda model: model
) -> list[T]:
    """Compile the models of n worlds in parallel, and return what `read` takes of each.

    Equal worlds share one.
    """
    leaves = [np.ascontiguousarray(x) for x in jax.tree.leaves(inputs.columns)]
    keys = [b"".join(leaf[i].tobytes() for leaf in leaves) for i in range(inputs.num_worlds)]
    distinct = {key: i for i, key in enumerate(keys)}

    def compile_row(i: int) -> T:
        return read(scene.compile_row(inputs, i).physics)

    with ThreadPoolExecutor(device.count_processors()) as pool:
        rows = dict(zip(distinct, pool.map(compile_row, distinct.values()), strict=True))
    return [rows[key] for key in keys]


class MuJoCo(Engine):
    """C MuJoCo on all processors; the stage is a list of models."""

    name = "mujoco"
    traced = False

    def suits_processors(self, trials: int | None) -> bool:
        """Return True: it steps worlds on the host."""
        return True

    def stage(self, inputs: WorldInputs) -> tuple[list[mujoco.MjModel], Arrays]:
        """Return the models of the worlds; equal worlds share one."""
        boundary = inputs.surroundings.boundary
        return compile_rows(inputs), {} if boundary is None else {"boundary": boundary}

    def open_batch(
        self,
        stage: Sequence[mujoco.MjModel],
        qpos: np.ndarray,
        threads: int,
        robots: Robot | None,
        fields: Arrays,
    ) -> Batch:
        """Return a batch that a pool of threads steps."""
        return Batch(stage, qpos, threads, robots, **fields)


ENGINE = MuJoCo()
