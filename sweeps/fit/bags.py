"""Compare fits to bags with fits to the logs of the same worlds, whose true values are known.

    rps sweeps/fit/bags.py

pushes in test worlds of the domain, records each trial as a bag with `rps replay --bag`, loads the
bags as `rps fit` does, and counts how often the 90 % interval of a quantity contains the true
value. It does the same with the simulated logs of these worlds.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import xarray as xr

import rps_jax
from rps_jax.analysis.report import Section
from rps_jax.control import registry
from rps_jax.control.registry import LawLike
from rps_jax.record import bag
from rps_jax.record.options import option
from rps_jax.runs.question import DomainQuestion, LawQuestion, Run, call_of, seed_of
from rps_jax.tuning import fit, logs, posterior
from rps_jax.world import domain as domains
from sweeps.fit.study import compare_with_truth, within
from sweeps.study_base import Study, Table

_SOURCES = ("bag", "the log itself")
_FIELDS = ("signal",)  # optional fields of bags
_TOLERANCE = 0.02  # [1] of the interval's width, within which two limits are equal


@dataclass(frozen=True)
class Bagged(Study[xr.Dataset], DomainQuestion[xr.Dataset], LawQuestion[xr.Dataset]):
    """Compare the coverage of intervals fitted to bags with that of fits to logs."""

    TITLE: ClassVar[str] = "Worlds fitted to bags"
    QUICK: ClassVar[Mapping[str, Any]] = {"worlds": 192, "logs": 2, "window": 6.0}

    domain: domains.DomainLike = "real"
    """Ranges from which worlds are drawn, by name or as a JSON file; changes follow."""
    law: LawLike = "rps_plus"
    worlds: int = option(3072, 96, 1_000_000, kw_only=True)
    """Number of worlds for training."""
    logs: int = option(16, 1, 1000, kw_only=True)
    """Number of worlds that are recorded and fitted."""
    window: float = option(20.0, 5, 300, unit="s", kw_only=True)
    """Length of a log [s]."""
    setting: rps_jax.Setting = field(default=rps_jax.Setting("fused"), kw_only=True)

    def check(self) -> None:
        """Check the law and the engine, and that bags can be written."""
        bag.check()
        self.check_engine([self.params])
        fit.check_law(self.label, registry.law_of(self.params), self.setting)

    def answer(self, run: Run) -> xr.Dataset:
        """Train on the worlds, and fit the bags and the logs (source, log)."""
        period = self.setting.physics.control_period
        bank = fit.Bank(self.ranges, self.params, self.setting, self.window, period)
        training = bank.worlds(self.worlds, run)
        names = fit.statistic_names(training, _FIELDS)
        test = bank.worlds(self.logs, run, "test")
        bags = run.checkpoint("bags", partial(self._bags, bank, names))
        inputs = training.sel(statistic=names)
        networks = posterior.train(inputs.u.values, inputs.statistics.values, self.setting.seed)
        logs_x = test.sel(statistic=names).statistics.values[:, 0]
        fits = [
            xr.concat(
                [
                    compare_with_truth(self.ranges, networks, x[i : i + 1], test, i)
                    for i in range(self.logs)
                ],
                "log",
            )
            for x in (bags.statistics.values, logs_x)
        ]
        return xr.concat(fits, "source").drop_vars("unit").assign_coords(source=list(_SOURCES))

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return the coverage of bags and logs."""
        return {"fit_bags": Table(table(results))}

    def _bags(self, bank: fit.Bank, names: Sequence[str]) -> xr.Dataset:
        """Return statistics (log, F) of the bags of the test worlds."""
        setting = rps_jax.Setting(
            self.setting.engine, self.setting.physics, self.setting.fidelity,
            self.setting.rules._replace(horizon=self.window), seed_of(self.setting.seed, "test"),
        )  # fmt: skip
        rows = []
        with tempfile.TemporaryDirectory() as folder:
            run = Path(folder) / "sweep"
            laws = {self.label: self.params}
            rps_jax.sweep(laws, self.ranges, self.logs, setting=setting, out=run, progress=False)
            for world in range(self.logs):
                path = Path(folder) / f"{world}.mcap"
                rps_jax.replay(run=run, world=world, bag=path)
                raw = logs.read(path, self.ranges.robot.shell)
                log = logs.resample(raw, bank.interval, bank.window)
                rows.append(logs.statistics(log, bank.interval)[names].values[0])
        return xr.Dataset({"statistics": (("log", "statistic"), np.stack(rows))})

    def report(self, results: Any, run: Run) -> Sequence[Section]:
        """Return one row for bags, and one for the logs."""
        return [Section("Coverage of bags", "", table(results))]


bagged = call_of(Bagged)


def table(results: xr.Dataset) -> list[list[str]]:
    """Return header and rows of the table of the page."""
    logs = results.sel(source=_SOURCES[1])
    errors = [abs(results[k] - logs[k]) / (logs.high - logs.low) for k in ("low", "high")]
    is_near = np.maximum(*errors) <= _TOLERANCE
    rows = [["log", "logs", "90 % intervals hold the truth", "those of told quantities",
             "as the log itself holds it", "ends within 2 % of its width"]]  # fmt: skip

    def share(mask: xr.DataArray, where: xr.DataArray | None = None) -> str:
        values = mask if where is None else mask.where(where)
        count, total = int(values.sum()), int(values.count())
        return f"{count} of {total}, {100 * count / max(1, total):.1f} %"

    for source in _SOURCES:
        fits = results.sel(source=source)
        covered = within(fits)
        agreement = ["", ""]
        if source != _SOURCES[1]:
            agreement = [share(covered == within(logs)), share(is_near.sel(source=source))]
        determined = share(covered.astype(float), fits.undetermined == 0)
        rows.append([source, str(results.sizes["log"]), share(covered), determined, *agreement])
    return rows
