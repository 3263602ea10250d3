"""Probe: outcomes of one law at points of a domain's unit cube, call after call."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr

from rps_jax import Domain, Setting, stack
from rps_jax.analysis import statistics
from rps_jax.laws import LawParams
from rps_jax.questions import Run
from rps_jax.record import files
from rps_jax.trials import score
from rps_jax.trials.batch import outcomes
from rps_jax.trials.progress import SequentialProgress, no_progress
from rps_jax.trials.worlds import Candidates
from rps_jax.world import points
from rps_jax.world.points import Points

_SLOTS = 64  # least size of a program, a power of four
_STORED = ("success", "time", "contact_lost_time", "tilt")


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
    run: Run = Run(None, no_progress)
    calls: int = 0
    trials: int = 0  # of all calls, loaded ones included
    simulated: float = 0.0  # [s] of all these trials
    _progress: SequentialProgress = field(init=False)

    def __post_init__(self) -> None:
        self.run, self._progress = self.run.in_parts()

    def __call__(self, u: np.ndarray) -> xr.Dataset:
        """Return outcomes and `severity` (world) at points `u` (n, q)."""
        at = points.check_points(self.domain, u)
        results = self.run.checkpoint(f"{self.calls:06d}", lambda: self._simulate(at))
        if not ("u" in results and np.array_equal(results.u, at.u)):
            reason = f"step {self.calls} is of another search, version or device"
            raise files.CorruptFileError(self.run.folder, reason)
        self.calls += 1
        self.trials += len(at.u)
        self.simulated += float(results.time.sum())
        self._progress.finish(len(at.u))
        return results

    def _simulate(self, at: Points) -> xr.Dataset:
        request = Candidates(stack([self.params]), [self.domain], 0, np.arange(len(at.u)), at)
        options: Any = self.run.batch_options
        # The size of a program is a power of four, so that few compile.
        options["capacity"] = lambda n: 4 ** math.ceil(math.log2(max(n, _SLOTS)) / 2)
        (outcome,), _ = outcomes([request], self.setting, **options)
        trials = {name: np.asarray(getattr(outcome, name)[0], float) for name in _STORED}
        trials["left"] = statistics.miss_distance(outcome.min_distance[0], request.distances)
        trials["severity"] = score.severity(trials, trials["left"], self.setting.rules)
        variables = {name: ("world", values) for name, values in trials.items()}
        return xr.Dataset({"u": (("world", "quantity"), at.u), **variables})
