"""Speed and error of this project's and third-party engines on the same scene.

A base pushes a box straight ahead at a constant speed. Each engine runs in a separate process on
the same device. All processes compile at the same time; then they are timed in turn. The error of
an engine is the distance of its final poses from those of C MuJoCo with small steps.

    pip install --no-deps --target peers \
        mujoco-warp==3.17.0 newton==1.8.0 warp-lang==1.18.0 absl-py etils
    rps sweeps/speed/arena.py --peers peers --machine "one NVIDIA H100"
"""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
import xarray as xr

from rps_jax.geometry import solid
from rps_jax.physics import preset
from rps_jax.questions import Run, call_of, option
from rps_jax.trials.progress import Progress
from rps_jax.world import scene
from sweeps.speed import racers
from sweeps.speed.racers import ON_CORES, RACERS
from sweeps.study_base import (
    QuickStudy,
    Rows,
    SpeedStudy,
    Table,
    part_name,
    records,
    stored_parts,
    text_table,
)

_COLUMNS = {
    "engine": "{engine}",
    "version": "{version}",
    "worlds": "{worlds:,}",
    "simulated s/s": "{rate:,.0f}",
    "fused over it": "{times}",
    "error, median": "{error:.2g} mm",
    "error, largest": "{largest:.2g} mm",
    "turned, median": "{turned:.2g}°",
    "ready after": "{ready:.0f} s",
    "why not": "{why}",
}
# Engines that are not in the arena, and why.
EXCLUDED = {
    "Brax 0.14.2": (
        "its `validate_model` refuses the scene for its own pipelines (`Only pyramidal cone "
        "friction is supported`, `Only impratio=1 is supported`), and its fourth pipeline is MJX"
    ),
    "Genesis 1.4.5": (
        "it reads no contact pairs, so that its contacts would not be these (each has the mean of "
        "what its two geoms say), and it needs thirty packages more, VTK and OpenCV among them"
    ),
}


@dataclass(frozen=True)
class Arena(SpeedStudy[xr.Dataset], QuickStudy[xr.Dataset]):
    """Compare speed and error of engines on one scene with converged C MuJoCo.

    The results hold, by engine and number of worlds, simulated seconds per second of wall clock,
    `rate` [1], the errors `error` [m] and `turned` [rad] of the final poses, and `why` an engine
    has no rate.
    """

    TITLE = "Engines on one scene"
    CHOICES: ClassVar = {"names": RACERS}
    QUICK: ClassVar = {
        "names": ("C MuJoCo, rollout", "fused"),
        "worlds": (8,),
        "starts": 4,
        "seconds": 0.5,
        "step": 1e-3,
    }
    GROWS = ("names", "worlds", "peers", "limit")

    names: tuple[str, ...] = tuple(RACERS)
    """Engines to run; by default all."""
    worlds: tuple[int, ...] = option((8192, 65536), 1, 10_000_000)
    """Numbers of worlds; engines on the processor run at most the largest number."""
    seconds: float = option(5.0, 0.1, 600, unit="s")
    """Duration of each push [s]."""
    starts: int = option(64, 1, 4096)
    """Number of different positions and headings of the box, which the worlds repeat."""
    step: float = option(1e-4, 1e-6, 1e-2, unit="s")
    """Time step of converged C MuJoCo [s]."""
    peers: Path | None = None
    """Folder of the third-party packages, which `pip install --target` fills."""
    limit: float = option(300.0, 1, 3600)
    """Time limit for an engine to compile, and time limit for it to run [s]."""

    @property
    def races(self) -> list[tuple[str, int]]:
        """Engine and number of worlds of each row."""
        counts = {name: (max(self.worlds),) for name in ON_CORES}
        return [(name, n) for name in self.names for n in counts.get(name, self.worlds)]

    def num_trials(self) -> int | None:
        """Return the number of rows."""
        return len(self.races)

    def answer(self, run: Run) -> xr.Dataset:
        """Run the engines that are missing."""
        with tempfile.TemporaryDirectory() as path:
            folder = Path(path)
            (folder / "scene.xml").write_text(mjcf())
            np.save(folder / "starts.npy", initial_poses(self.starts))
            truth = run.checkpoint("converged", partial(self._converged, folder)).pose.values
            stored = stored_parts(run)
            missing = [race for race in self.races if part_name(*race) not in stored]
            new_rows = self._raced(missing, folder, truth)
            rows: list[xr.Dataset] = []
            results: Any = xr.Dataset()
            for race in self.races:
                row = next(new_rows) if race in missing else xr.Dataset()
                if race not in missing or not row.why.item():  # failures are tried again
                    row = run.checkpoint(part_name(*race), partial(xr.Dataset.copy, row))
                rows.append(row)
                results = xr.concat(rows, "row")
                if self.machine and run.folder is not None:
                    self.publish(results, run.folder)
                run.callback(Progress(len(rows), 0.0))
            new_rows.close()
        return results

    def _converged(self, folder: Path) -> xr.Dataset:
        starts = np.load(folder / "starts.npy")
        poses = racers.converged(folder / "scene.xml", starts, self.seconds, self.step)
        return xr.Dataset({"pose": (("start", "coordinate"), poses)})

    def _raced(
        self, races: Sequence[tuple[str, int]], folder: Path, truth: np.ndarray
    ) -> Generator[xr.Dataset]:
        """Yield the rows: all engines are prepared first, and then timed in turn."""
        processes = [_Process(*race, folder, self.seconds, self.peers) for race in races]
        try:
            until = time.perf_counter() + self.limit
            for process in processes:
                process.prepare(until)
            for process in processes:
                yield process.row(time.perf_counter() + self.limit, truth)
        finally:
            for process in processes:
                process.end()

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return speeds and errors, with the reasons for excluded engines."""
        excluded = (f"Not in the arena: {name}, because {why}." for name, why in EXCLUDED.items())
        return [Table(table(results), " ".join(excluded), name="arena", title=self.TITLE)]


arena = call_of(Arena)


# --- the scene -----------------------------------------------------------------------------


def initial_poses(count: int) -> np.ndarray:
    """Return initial poses (count, 10): turned and shifted boxes that touch the base."""
    box, rng = scene.load("box"), np.random.default_rng(0)
    yaws, sides = rng.uniform(-0.3, 0.3, count), rng.uniform(-0.08, 0.08, count)
    qpos = np.array([scene.initial_qpos(box, 0.0, yaw) for yaw in yaws])
    qpos[:, scene.JOINTS.object.start + 1] = sides
    return qpos


def mjcf() -> str:
    """Return the scene of the project's engines in a format that all engines read."""
    model = scene.load("box", preset()).physics
    base, box, o = model.body("base"), model.body("object"), model.opt

    def text(values: Any) -> str:
        return " ".join(f"{v:.12g}" for v in np.ravel(values))

    def inertial(body: Any) -> str:
        return (
            f'<inertial pos="{text(body.ipos)}" quat="{text(body.iquat)}" mass="{text(body.mass)}" '
            f'diaginertia="{text(body.inertia)}"/>'
        )

    def geom(name: str, kind: str) -> str:
        g = model.geom(name)
        return (
            f'<geom name="{name}" type="{kind}" size="{text(g.size)}" pos="{text(g.pos)}" '
            'contype="0" conaffinity="0"/>'
        )

    joints = "".join(
        f'<joint name="base_{name}" type="{kind}" axis="{axis}" armature="{text(mass)}"/>'
        for (name, kind, axis), mass in zip(
            [("x", "slide", "1 0 0"), ("y", "slide", "0 1 0"), ("yaw", "hinge", "0 0 1")],
            model.dof_armature,
            strict=False,
        )
    )
    # Newton has another default of solreffriction.
    numbers = ("friction", "solref", "solreffriction", "solimp")
    pairs = "".join(
        f'<pair geom1="{model.geom(int(model.pair_geom1[i])).name}" '
        f'geom2="{model.geom(int(model.pair_geom2[i])).name}" condim="{model.pair_dim[i]}" '
        + " ".join(f'{x}="{text(getattr(model, f"pair_{x}")[i])}"' for x in numbers)
        + "/>"
        for i in range(model.npair)
    )
    names = ("timestep", "impratio", "iterations", "ls_iterations", "tolerance")
    options = " ".join(f'{name}="{text(getattr(o, name))}"' for name in names)
    assert (o.integrator, o.solver, o.cone) == (
        mujoco.mjtIntegrator.mjINT_EULER,
        mujoco.mjtSolver.mjSOL_NEWTON,
        mujoco.mjtCone.mjCONE_ELLIPTIC,
    )
    return (
        '<mujoco model="arena"><compiler angle="radian" autolimits="true"/>'
        f'<option integrator="Euler" solver="Newton" cone="elliptic" jacobian="dense" {options}/>'
        f"<worldbody>{geom('ground', 'plane')}"
        f'<body name="base">{joints}{inertial(base)}{geom("base", "box")}</body>'
        f'<body name="object" pos="{text(box.pos)}"><freejoint name="object"/>{inertial(box)}'
        f"{geom('object', 'box')}</body></worldbody><contact>{pairs}</contact></mujoco>"
    )


# --- the processes -------------------------------------------------------------------------


class _Process:
    """The process of an engine."""

    def __init__(self, name: str, count: int, folder: Path, seconds: float, peers: Path | None):
        """Start the process."""
        self.name, self.count, self.failed, self.ready = name, count, "", np.nan
        context = multiprocessing.get_context("spawn")
        self._pipe, pipe = context.Pipe()
        inputs = name, folder, seconds, count, peers, pipe
        self._child = context.Process(target=racers.race, args=inputs, daemon=True)
        self._child.start()
        pipe.close()

    def _message(self, until: float) -> dict[str, Any] | None:
        """Wait for a message of the process; return None and set `failed` if there is none."""
        try:
            in_time = self._pipe.poll(max(0.0, until - time.perf_counter()))
            message = self._pipe.recv() if in_time else "exceeded the time limit"
        except EOFError:
            self._child.join()
            message = f"ended with {self._child.exitcode}"
        if isinstance(message, str):
            self.failed = message
            return None
        return message

    def prepare(self, until: float) -> None:
        """Wait until the engine is ready."""
        if (message := self._message(until)) is not None:
            self.ready = message["ready"]
        else:
            self.end()

    def row(self, until: float, truth: np.ndarray) -> xr.Dataset:
        """Run the engine and return its row."""
        output: dict[str, Any] = {"version": "", "worlds": self.count, "rate": np.nan, "poses": []}
        if not self.failed:
            self._pipe.send("go")
            output |= self._message(until) or {}
        self.end()
        return _row(self, output, truth)

    def end(self) -> None:
        """Kill the process if it is running."""
        self._child.kill()
        self._child.join()


def _row(process: _Process, output: Mapping[str, Any], truth: np.ndarray) -> xr.Dataset:
    """Return a row: output of the process, and errors against the converged poses (n, 7)."""
    poses = np.array(output["poses"], float).reshape(-1, 7)
    error, turned = np.array([np.nan]), np.array([np.nan])
    if len(poses):
        true = truth[np.arange(len(poses)) % len(truth)]
        error = np.linalg.norm(poses[:, :2] - true[:, :2], axis=1)
        turned = np.abs(solid.wrap(_yaw(poses) - _yaw(true)))
    return xr.Dataset(
        {
            **{name: output[name] for name in ("version", "worlds", "rate")},
            "error": np.median(error),
            "largest": np.max(error),
            "turned": np.median(turned),
            "engine": process.name,
            "ready": process.ready,
            "why": process.failed,
        }
    )


def _yaw(poses: np.ndarray) -> np.ndarray:
    """Return headings (n,) [rad] of poses (n, 7)."""
    w, x, y, z = poses[:, 3:].T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


# --- the table -----------------------------------------------------------------------------


def _times(ratio: float) -> str:
    """Format a ratio with three digits, or as a whole number."""
    return "" if np.isnan(ratio) else f"{ratio:,.0f}" if ratio >= 100 else f"{ratio:.3g}"


def table(results: xr.Dataset) -> Rows:
    """Return a row per engine and number of worlds, the slowest first and failures last."""
    order = np.argsort(results.rate.fillna(np.inf), kind="stable")
    rows = list(records(results.isel(row=order), "row"))
    fused = {row["worlds"]: row["rate"] for row in rows if row["engine"] == "fused"}
    fastest = max(fused.values(), default=np.nan)
    for row in rows:
        row["times"] = _times(fused.get(row["worlds"], fastest) / row["rate"])
        row["error"], row["largest"] = 1000 * row["error"], 1000 * row["largest"]
        row["turned"] *= 180 / np.pi
    return text_table(_COLUMNS, rows)
