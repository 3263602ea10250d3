"""Fit a domain to logs by least squares on replayed windows, whatever law drove the base.

    rps sweeps/fit/windows.py push.csv --domain wide

replays short windows of the logs from measured poses of the object (`least_squares`), with exact
derivatives of the engine. It needs the object's pose, and neither the law nor simulated trials of
it. `rps fit`, whose intervals are better calibrated, needs both. `methods` compares them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from rps_jax import errors
from rps_jax.physics import get_engine
from rps_jax.questions import Run, Section, call_of, option
from rps_jax.trials.progress import set_phase
from rps_jax.tuning.fit import SAMPLES, Fit, coordinates, summary
from rps_jax.world import points
from sweeps.fit import least_squares
from sweeps.fit.least_squares import LEAST_WINDOWS, Replay, Track

_LARGE = np.array([0.02, 0.02, 0.05])  # [m, m, rad] errors of a window in an invalid fit
_DETERMINED = 12  # eigenvalue of the information from which on the windows determine a direction


@dataclass(frozen=True)
class FitWindows(Fit):
    """Fit a domain's ranges to logs by least squares on replayed windows.

    The answer is that of `rps_jax.fit`, with the eigenvalues of the scaled J^T J (direction). The
    law has no influence.
    """

    TITLE = "A domain fitted to windows of logs"
    QUICK: ClassVar = {"worlds": 12, "window": 20.0}

    worlds: int = option(96, 6, 1_000_000)
    """Number of worlds of the domain from which the minimisation starts; at least 6 of each object
    are used."""

    @cached_property
    def replay(self) -> Replay:
        """Least-squares problem of the logs."""
        logs, fields = self.observed
        force = "f_robot" in fields and get_engine(self.setting.engine).computes_force
        exact, interval = self.bank.exact, self.bank.interval
        tracks = [Track.of(log, interval, exact, force) for log in logs]
        return Replay(self.ranges, tracks, self.setting, exact)

    def check_method(self) -> None:
        """Raise InputError unless the logs can be replayed and differentiated."""
        get_engine(self.setting.engine).check_derivatives("forward")
        if any(self.ranges.surroundings):
            rule = "windows are replayed on a level, uniform floor: draw no other, or use rps fit"
            raise errors.not_allowed("domain", self.domain, rule)
        rule = "they lack object_x, object_y and object_yaw: log them, or use rps fit"
        if "object_pose" in self.observed[1]:
            count = self.replay.num_windows
            if count >= LEAST_WINDOWS:
                return
            rule = f"they have {count} windows of {least_squares.WINDOW:g} s that are mostly in "
            rule += f"contact, and {LEAST_WINDOWS} are needed: give longer logs"
        raise errors.not_allowed("logs", self.logs, rule)

    def num_trials(self) -> int | None:
        """Return the number of worlds from which the minimisation starts."""
        return max(least_squares.STARTS * len(self.ranges.objects), self.worlds)

    def sample_posterior(self, run: Run) -> xr.Dataset:
        """Minimise the residuals of the replayed windows, and sample the posterior."""
        set_phase(run.callback, "replay")
        seed, names = self.setting.seed, points.names(self.ranges)
        index = np.arange(self.num_trials() or 0)
        start = points.points_of(self.ranges, index, seed)
        minima = self.replay.minima(start)
        u, eigenvalues = least_squares.sample(self.replay, *minima, SAMPLES, seed)
        data = summary(self.ranges, u[:, [names.index(x) for x in coordinates(self.ranges)]])
        words = {"units": "1", "long_name": "eigenvalue of the scaled J^T J, in units of the cube"}
        data["eigenvalue"] = ("direction", eigenvalues, words)
        r = minima[1][np.argmin(least_squares.cost(minima[1])), :, 3:6]
        coords = {"statistic": [f"object_pose/{name}" for name in ("x", "y", "yaw")]}
        words = {"long_name": "share of windows with an error above 20 mm or 0.05 rad"}
        data["outside"] = xr.DataArray(np.mean(abs(r) > _LARGE, axis=0), coords, attrs=words)
        return data

    @property
    def use_of_worlds(self) -> str:
        """Use of the worlds, for reports."""
        return f"in which {self.replay.num_windows} windows of the logs are replayed"

    def report(self, results: Any, run: Run) -> Sequence[Section]:
        """Add to the report of `rps fit` what the windows determine."""
        data, (first, *rest) = results.data, super().report(results, run)
        text = (
            f"{first.text} The windows determine {(data.eigenvalue > _DETERMINED).sum():d} of "
            f"{data.eigenvalue.size} combinations of quantities (eigenvalues of J^T J)."
        )
        if "mass" in data.quantity and "f_robot" not in self.observed[1]:
            text += (
                " The mass has almost no influence, because the base follows its measured path "
                "with any force: log force_x and force_y."
            )
        return [first._replace(text=text), *rest]


fit_windows = call_of(FitWindows)
