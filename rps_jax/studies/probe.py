"""One law at points of a domain's unit cube, again and again, through the same programs."""

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

_SLOTS = 64  # of a program, at least
_KEPT = ("success", "time", "contact_lost_time", "tilt")
_ANSWERED = ("success", "time", "left", "severity")


@dataclass
class Probe:
    """Tries one law at points, and keeps what came of each call in a run folder, if it has one.

    Each shape family has a program of 64 slots, one of 256 and so on, for any number of points.
    Whoever asks for the same points in the same order after being killed is answered from the
    folder: a search then goes on as if it had never been stopped.
    """

    domain: Domain
    params: LawParams
    setting: Setting = Setting(engine="fused")
    folder: Path | None = None
    slots: int | None = None
    workers: int | None = None
    callback: ProgressCallback = no_progress
    calls: int = 0
    trials: int = 0  # of all calls, those answered from the folder too
    simulated: float = 0.0  # [s] of all these trials
    _heard: SequentialProgress = field(init=False)

    def __post_init__(self) -> None:
        self._heard = SequentialProgress(self.callback)

    def __call__(self, u: np.ndarray) -> xr.Dataset:
        """Outcomes and `severity` (world) at points `u` (n, q)."""
        at, name = points.checked(self.domain, u), f"{self.calls:06d}"
        if self.folder is not None:
            found = Checkpoints(self.folder).load_or_compute(name, lambda: self._try(at))
            sizes = {"world": len(at.u)}
            kept = {"u": ("world", "quantity")} | dict.fromkeys(_ANSWERED, ("world",))
            files.check_columns(found, self.folder, kept, sizes)
            if not np.array_equal(found.u.values, at.u):
                raise InputError(
                    f"run = {self.folder} was searched otherwise from step {self.calls} on: use "
                    "the version and the device that made it, or choose another folder."
                )
        else:
            found = self._try(at)
        self.calls += 1
        self.trials += len(at.u)
        self.simulated += float(found.time.sum())
        self._heard.finish(len(at.u))
        return found

    def _try(self, at: Points) -> xr.Dataset:
        which = self.domain.object_of(at.cases(self.domain, np.arange(len(at.u))))
        away = np.empty(len(at.u))
        jobs = [self._job(at, np.flatnonzero(which == one), away) for one in np.unique(which)]
        shape = {"slots": self.slots, "workers": self.workers, "callback": self._heard}
        began = time.perf_counter()
        outcome, _ = batch.run_all(jobs, self.setting, len(at.u), **shape)
        found = {name: np.asarray(getattr(outcome, name), float) for name in _KEPT}
        found["left"] = statistics.miss_distance(outcome.min_distance, away)
        told = [found[name] for name in ("success", "time", "left", "contact_lost_time", "tilt")]
        found["severity"] = score.severity(*told, rules=self.setting.rules)
        columns = {name: ("world", values) for name, values in found.items()}
        wall = time.perf_counter() - began
        return xr.Dataset({"u": (("world", "quantity"), at.u), **columns}, attrs={"wall": wall})

    def _job(self, at: Points, rows: np.ndarray, away: np.ndarray) -> Job:
        """Points of one object; `away` takes the targets' distances from the start."""
        drawn = at.draw(self.domain, rows)
        away[rows] = np.linalg.norm(drawn.p_world_target, axis=1)

        def made() -> Iterator[WorldBatch]:
            yield drawn_worlds(self.domain, drawn, self.setting).with_params(self.params)

        # Few different sizes, since each is a program of its own: powers of four.
        size = _SLOTS
        while size < rows.size:
            size *= 4
        return Job(registry.law_of(self.params), size, made())
