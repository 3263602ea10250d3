"""Compare fits to bags with fits to the logs of the same worlds, whose true values are known.

    rps sweeps/fit/bags.py

pushes in test worlds of the domain, records each trial as a bag with `rps replay --bag`, loads the
bags as `rps fit` does, and counts how often the 90 % interval of a quantity contains the true
value. It does the same with the simulated logs of these worlds.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
import xarray as xr

import rps_jax
from rps_jax.control.registry import LawLike
from rps_jax.questions import Run, call_of, option
from rps_jax.record import bag
from rps_jax.tuning import fit, logs
from rps_jax.worlds import DomainLike
from sweeps.fit.study import FitStudy, within
from sweeps.study_base import Rows, Table

_SOURCES = ("bag", "the log itself")
_FIELDS = ("signal",)  # optional fields of bags
_TOLERANCE = 0.02  # [1] of the interval's width, within which two limits are equal


@dataclass(frozen=True)
class Bagged(FitStudy):
    """Compare the coverage of intervals fitted to bags with that of fits to logs."""

    TITLE = "Worlds fitted to bags"
    QUICK: ClassVar = {"worlds": 192, "logs": 2, "window": 6.0}

    domain: DomainLike = "real"
    """Ranges from which worlds are drawn, by name or as a JSON file; changes follow."""
    law: LawLike = "rps_plus"
    worlds: int = option(3072, 96, 1_000_000, kw_only=True)
    """Number of worlds for training."""
    logs: int = option(16, 1, 1000, kw_only=True)
    """Number of worlds that are recorded and fitted."""
    window: float = option(20.0, 5, 300, unit="s", kw_only=True)
    """Length of a log [s]."""

    def check(self) -> None:
        """Check the law and the engine, and that bags can be written."""
        bag.check()
        super().check()

    def answer(self, run: Run) -> xr.Dataset:
        """Train on the worlds, and fit the bags and the logs (source, log)."""
        training = self.bank.worlds(self.worlds, run)
        names = fit.statistic_names(training, _FIELDS)
        test = self.bank.worlds(self.logs, run, "test")
        bags = run.checkpoint("bags", partial(self._bags, names))
        networks = self.train(training, names)
        logs = test.sel(statistic=names).statistics.values[:, 0]
        fits = [self.compare(networks, x[:, None], test) for x in (bags.statistics.values, logs)]
        return xr.concat(fits, xr.IndexVariable("source", list(_SOURCES)))

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the coverage of bags and logs."""
        return [Table(table(results), name="fit_bags", title="Coverage of bags")]

    def _bags(self, names: Sequence[str]) -> xr.Dataset:
        """Return statistics (log, F) of the bags of the test worlds."""
        rules = self.setting.rules._replace(horizon=self.window)
        setting = replace(self.setting, rules=rules, split="test")
        rows = []
        with tempfile.TemporaryDirectory() as folder:
            run = Path(folder) / "sweep"
            laws = {self.label: self.params}
            rps_jax.sweep(laws, self.ranges, self.logs, setting=setting, out=run, progress=False)
            for world in range(self.logs):
                path = Path(folder) / f"{world}.mcap"
                rps_jax.replay(run=run, world=world, bag=path)
                raw = logs.read(path, self.ranges.robot.shell)
                log = logs.resample(raw, self.bank.interval, self.window)
                rows.append(logs.statistics(log, self.bank.interval)[names].values[0])
        return xr.Dataset({"statistics": (("log", "statistic"), np.stack(rows))})


bagged = call_of(Bagged)


def table(results: xr.Dataset) -> Rows:
    """Return header and rows of the table of the page."""
    of_logs = results.sel(source=_SOURCES[1])
    width = of_logs.high - of_logs.low
    errors = [abs(results[k] - of_logs[k]) / width for k in ("low", "high")]
    is_near = np.maximum(*errors) <= _TOLERANCE
    rows = [
        [
            "log",
            "logs",
            "90 % intervals hold the truth",
            "those of told quantities",
            "as the log itself holds it",
            "ends within 2 % of its width",
        ]
    ]

    def share(mask: xr.DataArray, where: xr.DataArray | None = None) -> str:
        values = mask if where is None else mask.where(where)
        count, total = int(values.sum()), int(values.count())
        return f"{count} of {total}, {100 * count / max(1, total):.1f} %"

    for source in _SOURCES:
        fits = results.sel(source=source)
        covered = within(fits)
        agreement = ["", ""]
        if source != _SOURCES[1]:
            agreement = [share(covered == within(of_logs)), share(is_near.sel(source=source))]
        determined = share(covered.astype(float), fits.undetermined == 0)
        rows.append([source, str(results.sizes["log"]), share(covered), determined, *agreement])
    return rows
