"""Speed and error of this project's and third-party engines on the same scene.

A base pushes a box straight ahead at a constant speed. Each engine runs in a separate process on
the same device. All processes compile at the same time; then they are timed in turn. The error of
an engine is the distance of its final poses from those of C MuJoCo with small steps.

    python sweeps/speed/peers.py peers
    rps sweeps/speed/arena.py --peers peers --machine "one NVIDIA H100"
"""

from __future__ import annotations

import json
import os
import queue
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, ClassVar

import mujoco
import numpy as np
import xarray as xr

from rps_jax import errors
from rps_jax.analysis.report import Section
from rps_jax.record.options import option
from rps_jax.runs.question import Run, call_of
from rps_jax.trials.progress import Progress
from rps_jax.world import scene
from rps_jax.world.physics import preset
from sweeps import programs
from sweeps.speed import racers
from sweeps.speed.racers import ON_CORES, RACERS
from sweeps.study_base import Study, Table

_FOLDER = Path(__file__).parent
_COLUMNS = (
    *("engine", "version", "worlds", "simulated s/s", "fused over it"),
    *("error, median", "error, largest", "turned, median", "ready after", "why not"),
)
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
class Arena(Study[xr.Dataset]):
    """Compare speed and error of engines on one scene with converged C MuJoCo.

    The results hold, by engine and number of worlds, simulated seconds per second of wall clock,
    `rate` [1], the errors `error` [m] and `turned` [rad] of the final poses, and `why` an engine
    has no rate.
    """

    TITLE: ClassVar[str] = "Engines on one scene"
    QUICK: ClassVar[Mapping[str, Any]] = {
        "names": ("C MuJoCo, rollout", "fused"),
        "worlds": (8,),
        "starts": 4,
        "seconds": 0.5,
        "step": 1e-3,
    }
    GROWS: ClassVar[tuple[str, ...]] = ("names", "worlds", "peers", "limit")

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
    """Folder of the third-party packages, which `peers.py` installs."""
    limit: float = option(300.0, 1, 3600)
    """Time limit for an engine to compile, and time limit for it to run [s]."""

    def check(self) -> None:
        """Check the names."""
        if not self.names:
            raise errors.InputError("names = () is not allowed: name at least one engine.")
        for name in self.names:
            errors.check_name("name", name, tuple(RACERS))

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
            missing = [
                race
                for race in self.races
                if run.checkpoints is None or run.checkpoints.get(_part(race)) is None
            ]
            new_rows = self._raced(missing, folder, truth)
            rows: list[xr.Dataset] = []
            results: Any = xr.Dataset()
            for i, race in enumerate(self.races):
                row = next(new_rows) if race in missing else run.checkpoint(_part(race), xr.Dataset)
                if race in missing and not row.why.item():  # failures are tried again
                    run.checkpoint(_part(race), partial(xr.Dataset.copy, row))
                rows.append(row)
                results = xr.concat(rows, "row")
                if self.machine and run.folder is not None:
                    self.publish(results, run.folder)
                run.callback(Progress(i + 1, 0.0))
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
        environment = _environment(self.peers)
        processes = [_Process(*race, folder, self.seconds, environment) for race in races]
        try:
            until = time.perf_counter() + self.limit
            for process in processes:
                process.prepare(until)
            for process in processes:
                yield process.row(time.perf_counter() + self.limit, truth)
        finally:
            for process in processes:
                process.end()

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return the rows, with the reasons for excluded engines."""
        excluded = (f"Not in the arena: {name}, because {why}." for name, why in EXCLUDED.items())
        return {"arena": Table([_COLUMNS, *table(results)], " ".join(excluded))}

    def intro(self, results: xr.Dataset) -> str:
        """Return the device of the measurement."""
        return programs.machine()

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Return a section with speeds and errors."""
        note = " ".join(f"{name} is not in the arena: {why}." for name, why in EXCLUDED.items())
        return [Section("Engines on one scene", note, [list(_COLUMNS), *table(results)])]


arena = call_of(Arena)


def _part(race: tuple[str, int]) -> str:
    return "_".join([re.sub(r"\W+", "_", race[0]), str(race[1])])


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
    pairs = "".join(
        f'<pair geom1="{model.geom(int(model.pair_geom1[i])).name}" '
        f'geom2="{model.geom(int(model.pair_geom2[i])).name}" condim="{model.pair_dim[i]}" '
        f'friction="{text(model.pair_friction[i])}" solref="{text(model.pair_solref[i])}" '
        f'solreffriction="{text(model.pair_solreffriction[i])}" '  # Newton has another default
        f'solimp="{text(model.pair_solimp[i])}"/>'
        for i in range(model.npair)
    )
    assert (o.integrator, o.solver, o.cone) == (
        mujoco.mjtIntegrator.mjINT_EULER,
        mujoco.mjtSolver.mjSOL_NEWTON,
        mujoco.mjtCone.mjCONE_ELLIPTIC,
    )
    return (
        '<mujoco model="arena"><compiler angle="radian" autolimits="true"/>'
        f'<option timestep="{o.timestep:g}" integrator="Euler" solver="Newton" cone="elliptic" '
        f'impratio="{o.impratio:g}" iterations="{o.iterations}" '
        f'ls_iterations="{o.ls_iterations}" tolerance="{o.tolerance:g}" jacobian="dense"/>'
        f"<worldbody>{geom('ground', 'plane')}"
        f'<body name="base">{joints}{inertial(base)}{geom("base", "box")}</body>'
        f'<body name="object" pos="{text(box.pos)}"><freejoint name="object"/>{inertial(box)}'
        f"{geom('object', 'box')}</body></worldbody><contact>{pairs}</contact></mujoco>"
    )


# --- the processes -------------------------------------------------------------------------


def _environment(peers: Path | None) -> dict[str, str]:
    """Return the environment of an engine's process, with the third-party packages last."""
    paths = [str(_FOLDER.parents[1]), os.environ.get("PYTHONPATH", ""), str(peers or "")]
    return os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, paths)),
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
    }


class _Process:
    """The process of an engine."""

    def __init__(
        self, name: str, count: int, folder: Path, seconds: float, environment: Mapping[str, str]
    ):
        """Start the process."""
        words = [name, str(folder), str(seconds), str(count)]
        self.name, self.count, self.failed, self.ready = name, count, "", np.nan
        self._errors = folder / f"{_part((name, count))}.txt"
        with self._errors.open("w") as file:
            self._child = subprocess.Popen(
                [sys.executable, str(_FOLDER / "racers.py"), *words], env=environment, text=True,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=file,
            )  # fmt: skip
        assert self._child.stdout is not None
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        threading.Thread(target=_read, args=(self._child.stdout, self._lines), daemon=True).start()

    def _next_message(self, until: float) -> dict[str, Any] | None:
        """Return the next message of the process, or None and set `failed`."""
        while True:
            try:
                line = self._lines.get(timeout=max(until - time.perf_counter(), 0.01))
            except queue.Empty:
                self.failed = "exceeded the time limit"
                return None
            if line is None:
                self._child.wait()
                last = self._errors.read_text().strip().splitlines()[-1:]
                self.failed = " ".join(last) or f"ended with {self._child.returncode}"
                return None
            if line.startswith("{"):
                return json.loads(line)

    def prepare(self, until: float) -> None:
        """Wait until the engine is ready."""
        if (message := self._next_message(until)) is not None:
            self.ready = message["ready"]
        else:
            self.end()

    def row(self, until: float, truth: np.ndarray) -> xr.Dataset:
        """Run the engine and return its row."""
        output = None
        if not self.failed:
            assert self._child.stdin is not None
            print("go", file=self._child.stdin, flush=True)
            output = self._next_message(until)
        self.end()
        return _row(self, output or {"poses": []}, truth)

    def end(self) -> None:
        """Kill the process if it is running."""
        self._child.kill()
        self._child.wait()


def _read(stream: IO[str], lines: queue.SimpleQueue[str | None]) -> None:
    for line in stream:
        lines.put(line)
    lines.put(None)


def _row(process: _Process, output: Mapping[str, Any], truth: np.ndarray) -> xr.Dataset:
    """Return a row: output of the process, and errors against the converged poses (n, 7)."""
    poses = np.array(output["poses"], float).reshape(-1, 7)
    error, turned = np.array([np.nan]), np.array([np.nan])
    if len(poses):
        true = truth[np.arange(len(poses)) % len(truth)]
        error = np.linalg.norm(poses[:, :2] - true[:, :2], axis=1)
        turned = np.abs((_yaw(poses) - _yaw(true) + np.pi) % (2 * np.pi) - np.pi)
    values = {
        "engine": process.name,
        "version": output.get("version", ""),
        "worlds": output.get("worlds", process.count),
        "rate": output.get("rate", np.nan),
        "error": np.median(error),
        "largest": np.max(error),
        "turned": np.median(turned),
        "ready": process.ready,
        "why": process.failed,
    }
    return xr.Dataset({name: ((), value) for name, value in values.items()})


def _yaw(poses: np.ndarray) -> np.ndarray:
    """Return headings (n,) [rad] of poses (n, 7)."""
    w, x, y, z = poses[:, 3:].T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


# --- the table -----------------------------------------------------------------------------


def _times(ratio: float) -> str:
    """Format a ratio with three digits, or as a whole number."""
    return "" if np.isnan(ratio) else f"{ratio:,.0f}" if ratio >= 100 else f"{ratio:.3g}"


def table(results: xr.Dataset) -> list[list[str]]:
    """Return one row per engine and number of worlds, the slowest first and failures last."""
    rows = [results.isel(row=i) for i in range(results.sizes["row"])]
    fused = {int(r.worlds): float(r.rate) for r in rows if r.engine.item() == "fused"}
    largest_rate = max(fused.values(), default=np.nan)

    def cell(value: xr.DataArray, form: str, times: float = 1.0) -> str:
        return "" if np.isnan(value) else form.format(times * float(value))

    return [
        [
            str(r.engine.item()),
            str(r.version.item()),
            f"{int(r.worlds):,}",
            cell(r.rate, "{:,.0f}"),
            _times(fused.get(int(r.worlds), largest_rate) / float(r.rate)),
            cell(r.error, "{:.2g} mm", 1000),
            cell(r.largest, "{:.2g} mm", 1000),
            cell(r.turned, "{:.2g}°", 180 / np.pi),
            cell(r.ready, "{:.0f} s"),
            str(r.why.item()),
        ]
        for r in sorted(rows, key=lambda r: np.nan_to_num(float(r.rate), nan=np.inf))
    ]
