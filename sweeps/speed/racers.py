"""Process of the arena for a single engine, which steps all worlds as fast as possible.

`race` is its function. `FOLDER` holds `scene.xml` and `starts.npy`.

    python racers.py FOLDER SECONDS INDEX

runs one trial in C MuJoCo and prints the final pose of the object.
"""

from __future__ import annotations

import argparse
import functools
import importlib.metadata
import json
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

SPEED = 0.05  # [m/s] of the base, straight on
BASE = slice(0, 3)  # of qpos and qvel: x, y, yaw
OBJECT = slice(3, 10)  # of qpos: position and quaternion, scalar first
# Room for a world's points of contact (four of each of two pairs), and for their rows.
CONTACTS, ROWS = 8, 24
_GRAPH = 50  # steps in one CUDA graph
_ENOUGH = 6.0  # [s] total time after which no further run starts
_GOES = 4


class Task(NamedTuple):
    """Task of an engine."""

    scene: Path  # MJCF
    qpos: np.ndarray  # (worlds, 10) start, at rest
    seconds: float  # [s] duration of each world


class Racer(NamedTuple):
    """An engine that is ready to run."""

    go: Callable[[], np.ndarray]  # runs all steps; poses (n, 7) of the first objects
    warm: Callable[[], Any]  # compiles what `go` needs
    worlds: int


# --- MuJoCo on the processor ---------------------------------------------------------------


def _model(task: Task) -> Any:
    import mujoco

    return mujoco.MjModel.from_xml_path(str(task.scene))


def rollout(task: Task) -> Racer:
    """MuJoCo's `rollout` on all cores, with the base velocity set once per control period."""
    import mujoco
    from mujoco.rollout import Rollout

    cores = len(os.sched_getaffinity(0))
    model, substeps = _model(task), 2
    worlds = min(len(task.qpos), 64 * cores)
    datas, pool = [mujoco.MjData(model) for _ in range(cores)], Rollout(nthread=cores)
    nq, periods = model.nq, round(task.seconds / model.opt.timestep / substeps)

    def go(periods: int = periods) -> np.ndarray:
        state = np.zeros((worlds, 1 + nq + model.nv))
        state[:, 1 : 1 + nq] = task.qpos[:worlds]
        warmstart = np.zeros((worlds, model.nv))
        for _ in range(periods):
            state[:, 1 + nq :][:, BASE] = [SPEED, 0.0, 0.0]
            how = {"nstep": substeps, "initial_warmstart": warmstart}
            states = np.asarray(pool.rollout(model, datas, state, **how)[0])
            velocity_change = states[:, -1, 1 + nq :] - states[:, -2, 1 + nq :]
            state, warmstart = states[:, -1], velocity_change / model.opt.timestep
        return state[:, 1:][:, OBJECT]

    return Racer(go, functools.partial(go, 1), worlds)


def in_c(model: Any, qpos: np.ndarray, seconds: float) -> np.ndarray:
    """Return the pose (7,) of the object after `mj_step` has stepped one world."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    for _ in range(round(seconds / model.opt.timestep)):
        data.qvel[BASE] = [SPEED, 0.0, 0.0]
        mujoco.mj_step(model, data)
    return data.qpos[OBJECT].copy()


def single(task: Task) -> Racer:
    """Start a process per trial, with one trial per core at a time."""
    cores = len(os.sched_getaffinity(0))
    worlds = min(len(task.qpos), 8 * cores)
    words = [sys.executable, __file__, str(task.scene.parent), str(task.seconds)]

    def trial(index: int) -> list[float]:
        return json.loads(subprocess.check_output([*words, str(index)], text=True))

    def go() -> np.ndarray:
        from multiprocessing.pool import ThreadPool

        with ThreadPool(cores) as pool:
            return np.array(pool.map(trial, range(worlds), chunksize=1))

    return Racer(go, functools.partial(trial, 0), worlds)


def converged(scene: Path, starts: np.ndarray, seconds: float, step: float) -> np.ndarray:
    """Return poses (n, 7) of the objects by C MuJoCo with small steps and a converged solver."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(scene))
    model.opt.timestep, model.opt.tolerance = step, 1e-15
    model.opt.iterations, model.opt.ls_iterations = 100, 50
    with multiprocessing.get_context("spawn").Pool(len(os.sched_getaffinity(0))) as pool:
        return np.array(pool.starmap(in_c, [(model, qpos, seconds) for qpos in starts]))


# --- this project's engines, through JAX ---------------------------------------------------


def jax_engine(task: Task, name: str) -> Racer:
    """An engine of this project, with a whole run as one program."""
    import jax
    import jax.numpy as jnp

    from rps_jax import Twist
    from rps_jax.geometry import solid
    from rps_jax.physics import FRICTION, ControlPeriod, Motion, get_engine, preset
    from rps_jax.world import scene

    physics = preset()
    worlds, periods = len(task.qpos), round(task.seconds / physics.control_period)
    box = solid.stack([scene.load("box", physics).solid])
    boxes = jax.tree.map(lambda leaf: np.repeat(leaf, worlds, axis=0), box)
    friction = jax.tree.map(lambda x: np.full(worlds, x), FRICTION["S1"])
    stage, fields = get_engine(name).stage(scene.WorldInputs("box", boxes, friction, physics))
    fields, qpos = jax.device_put((fields, task.qpos.astype(np.float32)))
    twists = Twist(*(jnp.full(worlds, v, jnp.float32) for v in (SPEED, 0.0, 0.0)))

    @jax.jit
    def run(fields: Any, qpos: jax.Array, periods: int) -> jax.Array:
        still = jnp.zeros((worlds, 9), qpos.dtype)

        def drive(_: int, motion: Motion) -> Motion:
            return stage.drive(fields, motion, ControlPeriod(twists, physics)).motion

        return jax.lax.fori_loop(0, periods, drive, Motion(qpos, still, still)).qpos

    def go(periods: int = periods) -> np.ndarray:
        return np.asarray(jax.block_until_ready(run(fields, qpos, periods))[:, OBJECT])

    return Racer(go, functools.partial(go, 1), worlds)


def with_law(task: Task) -> Racer:
    """The fused engine with the law RPS, its skin and the rules of a trial around it."""
    import jax

    from sweeps import programs

    setting, count = programs.BATCHED["fused standard"], len(task.qpos)
    trace = functools.partial(programs.traced, simulated=task.seconds, donated=False)
    program = trace("fused", setting, "box", count)()

    def go() -> np.ndarray:
        jax.block_until_ready(program.go(program.start))
        return np.full((1, 7), np.nan)  # the law pushes elsewhere

    return Racer(go, go, program.worlds)


# --- engines of others ---------------------------------------------------------------------


def _captured(warp: Any, step: Callable[[], None], count: int) -> Callable[[], None]:
    """Return a function that makes `count` steps, by launches of a CUDA graph on a GPU."""
    if not warp.get_device().is_cuda:

        def steps() -> None:
            for _ in range(count):
                step()

        return steps
    graph_steps = next(n for n in range(min(_GRAPH, count), 0, -1) if count % n == 0)
    step()  # builds the kernels
    with warp.ScopedCapture() as capture:
        for _ in range(graph_steps):
            step()

    def launch() -> None:
        for _ in range(count // graph_steps):
            warp.capture_launch(capture.graph)

    return launch


@functools.cache
def _commanded() -> Any:
    """Return a kernel that sets the velocity of every base."""
    import warp  # pyright: ignore[reportMissingImports]

    @warp.kernel
    def command(qvel: warp.array2d(dtype=float), speed: float):  # pyright: ignore
        world = warp.tid()
        qvel[world, 0] = speed
        qvel[world, 1] = 0.0
        qvel[world, 2] = 0.0

    return command


def mujoco_warp(task: Task) -> Racer:
    """MuJoCo Warp, with its steps captured as a CUDA graph."""
    import mujoco
    import mujoco_warp as mjw  # pyright: ignore[reportMissingImports]
    import warp as wp  # pyright: ignore[reportMissingImports]

    wp.config.log_level = wp.LOG_WARNING
    host, worlds = _model(task), len(task.qpos)
    model = mjw.put_model(host)
    model.opt.warn_overflow = False
    sizes = {"nworld": worlds, "nconmax": CONTACTS, "njmax": ROWS}
    data = mjw.put_data(host, mujoco.MjData(host), **sizes)
    command = _commanded()
    start = wp.array(task.qpos.astype(np.float32), dtype=float)

    def step() -> None:
        wp.launch(command, dim=worlds, inputs=[data.qvel, SPEED])
        mjw.step(model, data)

    launch = _captured(wp, step, round(task.seconds / host.opt.timestep))

    def go() -> np.ndarray:
        wp.copy(data.qpos, start)
        for array in (data.qvel, data.qacc_warmstart, data.time):
            array.zero_()
        launch()
        wp.synchronize()
        return data.qpos.numpy()[:, OBJECT]

    return Racer(go, step, worlds)


def newton(task: Task) -> Racer:
    """Newton's solver based on MuJoCo Warp, set up like Newton's examples."""
    import newton  # pyright: ignore[reportMissingImports]
    import warp as wp  # pyright: ignore[reportMissingImports]
    from newton.solvers import SolverMuJoCo  # pyright: ignore[reportMissingImports]

    wp.config.log_level = wp.LOG_WARNING
    worlds, option = len(task.qpos), _model(task).opt
    single_world = newton.ModelBuilder()
    SolverMuJoCo.register_custom_attributes(single_world)
    single_world.add_mjcf(str(task.scene))
    all_worlds = newton.ModelBuilder()
    all_worlds.replicate(single_world, worlds)
    model = all_worlds.finalize()
    solver = SolverMuJoCo(
        model,
        nconmax=CONTACTS,
        njmax=ROWS,
        iterations=option.iterations,
        ls_iterations=option.ls_iterations,
        cone="elliptic",
        impratio=option.impratio,
        tolerance=option.tolerance,
        integrator="euler",
        solver="newton",
        kinematic_switchable_roots=False,  # otherwise each body has an unused weld
    )
    solver.mjw_model.opt.warn_overflow = False
    states, control = [model.state(), model.state()], model.control()
    q = task.qpos.copy()
    q[:, OBJECT] = q[:, OBJECT][:, [0, 1, 2, 4, 5, 6, 3]]  # scalar last
    start = wp.array(q.astype(np.float32).ravel(), dtype=float)
    command = _commanded()
    shape = (worlds, 9)

    def step() -> None:  # two steps, which swap the states twice
        for _ in range(2):
            state, next_state = states
            state.clear_forces()
            wp.launch(command, dim=worlds, inputs=[state.joint_qd.reshape(shape), SPEED])
            solver.step(state, next_state, control, None, option.timestep)
            states.reverse()

    launch = _captured(wp, step, round(task.seconds / option.timestep / 2))

    def go() -> np.ndarray:
        wp.copy(states[0].joint_q, start)
        states[0].joint_qd.zero_()
        newton.eval_fk(model, states[0].joint_q, states[0].joint_qd, states[0])
        launch()
        wp.synchronize()
        poses = states[0].joint_q.numpy().reshape(worlds, -1)[:, OBJECT]
        return poses[:, [0, 1, 2, 6, 3, 4, 5]]

    return Racer(go, step, worlds)


# Engines by name: function that prepares the engine, and its package.
RACERS: dict[str, tuple[Callable[[Task], Racer], str]] = {
    "one process a trial": (single, "mujoco"),
    "C MuJoCo, rollout": (rollout, "mujoco"),
    "MJX": (functools.partial(jax_engine, name="mjx"), "mujoco-mjx"),
    "MuJoCo Warp": (mujoco_warp, "mujoco-warp"),
    "Newton, SolverMuJoCo": (newton, "newton"),
    "fused": (functools.partial(jax_engine, name="fused"), "rps_jax"),
    "fused, law and skin": (with_law, "rps_jax"),
}
ON_CORES = ("one process a trial", "C MuJoCo, rollout")  # these choose the number of worlds


def _version(package: str) -> str:
    """Return the version of a package, or "" if it runs from its sources."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def race(
    name: str, folder: Path, seconds: float, count: int, peers: Path | None, pipe: Connection
) -> None:
    """Prepare an engine for a number of worlds, wait for a message, and time the engine.

    The process sends a message when the engine is ready, and a message with the results. If the
    engine fails, it sends the reason.
    """
    sys.path += [str(peers)] if peers else []
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    try:
        start, starts = time.perf_counter(), np.load(folder / "starts.npy")
        qpos = starts[np.arange(count) % len(starts)]
        prepare, package = RACERS[name]
        racer = prepare(Task(folder / "scene.xml", qpos, seconds))
        racer.warm()
        pipe.send({"ready": time.perf_counter() - start})
        pipe.recv()
        times, poses = [], np.empty(0)
        while len(times) < _GOES and sum(times) < _ENOUGH:
            start = time.perf_counter()
            poses = racer.go()
            times.append(time.perf_counter() - start)
        rate, final = racer.worlds * seconds / min(times), poses[: min(len(starts), racer.worlds)]
        version = _version(package)
        pipe.send({"worlds": racer.worlds, "rate": rate, "version": version, "poses": final})
    except ModuleNotFoundError as error:
        pipe.send(f"{error.name} is not installed")
    except Exception as error:  # the failure of one engine must not stop the others
        pipe.send(f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    for argument, kind in {"folder": Path, "seconds": float, "index": int}.items():
        parser.add_argument(argument, type=kind)
    words = parser.parse_args()
    task = Task(words.folder / "scene.xml", np.load(words.folder / "starts.npy"), words.seconds)
    pose = in_c(_model(task), task.qpos[words.index % len(task.qpos)], task.seconds)
    print(json.dumps(pose.tolist()))
