"""Probe: outcomes of one law at points of a domain's unit cube, call after call."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import xarray as xr

from rps_jax.analysis import statistics
from rps_jax.control import registry
from rps_jax.control.base import LawParams
from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.record.checkpoint import Checkpoints
from rps_jax.trials import batch, score
from rps_jax.trials.batch import Job, WorldBatch
from rps_jax.trials.progress import ProgressCallback, SequentialProgress, no_progress
from rps_jax.trials.setting import Setting
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.world import points
from rps_jax.world.domain import Domain
from rps_jax.world.points import Points

_SLOTS = 64  # least size of a program
_STORED = ("success", "time", "contact_lost_time", "tilt")
_RESULTS = ("success", "time", "left", "severity")


@dataclass
class Probe:
    """Simulator of one law at given points, with a checkpoint for each call in a run folder.

    Each shape family has a program of 64 slots, one of 256 and so on, for any number of points.
    After a kill, the same calls in the same order load their checkpoints, so a search resumes as
    if it had never stopped.
    """

    domain: Domain
    params: LawParams
    setting: Setting = Setting(engine="fused")
    folder: Path | None = None
    slots: int | None = None
    workers: int | None = None
    callback: ProgressCallback = no_progress
    calls: int = 0
    trials: int = 0  # of all calls, loaded ones included
    simulated: float = 0.0  # [s] of all these trials
    _progress: SequentialProgress = field(init=False)

    def __post_init__(self) -> None:
        self._progress = SequentialProgress(self.callback)

    def __call__(self, u: np.ndarray) -> xr.Dataset:
        """Return outcomes and `severity` (world) at points `u` (n, q)."""
        at = points.check_points(self.domain, u)
        results = self._simulate(at) if self.folder is None else self._load_or_simulate(at)
        self.calls += 1
        self.trials += len(at.u)
        self.simulated += float(results.time.sum())
        self._progress.finish(len(at.u))
        return results

    def _load_or_simulate(self, at: Points) -> xr.Dataset:
        """Return the trials of the checkpoint of this call, or simulate and store them."""
        assert self.folder is not None
        checkpoints, name = Checkpoints(self.folder), f"{self.calls:06d}"
        results = checkpoints.load_or_compute(name, lambda: self._simulate(at))
        columns = {"u": ("world", "quantity")} | dict.fromkeys(_RESULTS, ("world",))
        files.check_columns(results, self.folder, columns, {"world": len(at.u)})
        if not np.array_equal(results.u.values, at.u):
            raise InputError(
                f"run = {self.folder} differs from this search from step {self.calls} on: use "
                "the version and the device that created it, or choose another folder."
            )
        return results

    def _simulate(self, at: Points) -> xr.Dataset:
        start_time, count = time.perf_counter(), len(at.u)
        objects = self.domain.object_of(at.cases(self.domain, np.arange(count)))
        distance = np.empty(count)  # [m] of the target from the start
        jobs = [self._job(at, np.flatnonzero(objects == k), distance) for k in np.unique(objects)]
        outcome, _ = batch.run_all(
            jobs,
            self.setting,
            count,
            slots=self.slots,
            workers=self.workers,
            callback=self._progress,
        )
        columns = {name: np.asarray(getattr(outcome, name), float) for name in _STORED}
        columns["left"] = statistics.miss_distance(outcome.min_distance, distance)
        columns["severity"] = score.severity(
            columns["success"],
            columns["time"],
            columns["left"],
            columns["contact_lost_time"],
            columns["tilt"],
            self.setting.rules,
        )
        variables = {name: ("world", values) for name, values in columns.items()}
        wall = time.perf_counter() - start_time
        return xr.Dataset({"u": (("world", "quantity"), at.u), **variables}, attrs={"wall": wall})

    def _job(self, at: Points, rows: np.ndarray, distance: np.ndarray) -> Job:
        """Return the job of points of one object, and fill in the distances of their targets."""
        drawn = at.draw(self.domain, rows)
        distance[rows] = np.linalg.norm(drawn.p_world_target, axis=1)

        def worlds() -> Iterator[WorldBatch]:
            yield drawn_worlds(self.domain, drawn, self.setting).with_params(self.params)

        # Each size is a program of its own, so there are few: powers of four.
        size = _SLOTS
        while size < rows.size:
            size *= 4
        return Job(registry.law_of(self.params), size, worlds())
