"""Do bags tell what the logs themselves tell? Worlds whose truth is known, recorded as bags.

    rps sweeps/fit/bags.py

pushes in worlds of the domain that were not learned from, records each as a bag as `rps replay
--bag` does, reads the bags as `rps fit` does, and counts how often its 90 % interval of a quantity
holds the truth. Beside them stand the logs of the same worlds that never were a bag.
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
from sweeps.fit.study import judged, within
from sweeps.study_base import Study, Table

_SOURCES = ("bag", "the log itself")
_HAS = ("signal",)  # that bags have beside touch, odometry and commands
_NEAR = 0.02  # [1] of the interval's width, within which two of its ends are the same


@dataclass(frozen=True)
class Bagged(Study[xr.Dataset], DomainQuestion[xr.Dataset], LawQuestion[xr.Dataset]):
    """Count how often intervals fitted to bags hold the truth, beside those of the logs."""

    TITLE: ClassVar[str] = "Worlds fitted to bags"
    QUICK: ClassVar[Mapping[str, Any]] = {"worlds": 192, "logs": 2, "window": 6.0}

    domain: domains.DomainLike = "real"
    """Ranges from which worlds are drawn, by name or as a JSON file; changes follow."""
    law: LawLike = "rps_plus"
    worlds: int = option(3072, 96, 1_000_000, kw_only=True)
    """Number of worlds that are learned from."""
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
        """Learn from the worlds, and fit the bags and the logs (source, log)."""
        law, period = registry.law_of(self.params), self.setting.physics.control_period
        bank = fit.Bank(self.ranges, law, self.params, self.setting, self.window, period)
        learned = bank.worlds(self.worlds, run)
        names = fit.statistic_names(learned, _HAS)
        held = bank.worlds(self.logs, run, "test")
        bags = run.checkpoint("bags", partial(self._bags, bank, names))
        seen = learned.sel(statistic=names)
        networks = posterior.train(seen.u.values, seen.statistics.values, self.setting.seed)
        own = held.sel(statistic=names).statistics.values[:, 0]
        found = [
            xr.concat(
                [judged(self.ranges, networks, x[i : i + 1], held, i) for i in range(self.logs)],
                "log",
            )
            for x in (bags.statistics.values, own)
        ]
        whole = xr.concat(found, "source").drop_vars("unit").assign_coords(source=list(_SOURCES))
        return whole

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return the coverage of bags and logs."""
        return {"fit_bags": Table(table(results))}

    def _bags(self, bank: fit.Bank, names: Sequence[str]) -> xr.Dataset:
        """Statistics (log, F) of the bags of the worlds that are held out."""
        setting = rps_jax.Setting(
            self.setting.engine, self.setting.physics, self.setting.fidelity,
            self.setting.rules._replace(horizon=self.window), seed_of(self.setting.seed, "test"),
        )  # fmt: skip
        found = []
        with tempfile.TemporaryDirectory() as folder:
            swept = Path(folder) / "sweep"
            laws = {self.label: self.params}
            rps_jax.sweep(laws, self.ranges, self.logs, setting=setting, out=swept, progress=False)
            for world in range(self.logs):
                path = Path(folder) / f"{world}.mcap"
                rps_jax.replay(run=swept, world=world, bag=path)
                given = logs.read(path, self.ranges.robot.shell)
                log = logs.resample(given, bank.interval, bank.window)
                found.append(fit.matrix(logs.statistics(log, bank.interval), names)[0])
        return xr.Dataset({"statistics": (("log", "statistic"), np.stack(found))})

    def report(self, results: Any, run: Run) -> Sequence[Section]:
        """One row for bags, and one for the logs."""
        return [Section("Coverage of bags", "", table(results))]


bagged = call_of(Bagged)


def table(found: xr.Dataset) -> list[list[str]]:
    """Header and rows of the table of the page."""
    itself = found.sel(source=_SOURCES[1])
    off = [abs(found[end] - itself[end]) / (itself.high - itself.low) for end in ("low", "high")]
    near = np.maximum(*off) <= _NEAR
    rows = [["log", "logs", "90 % intervals hold the truth", "those of told quantities",
             "as the log itself holds it", "ends within 2 % of its width"]]  # fmt: skip

    def share(of: xr.DataArray, where: Any = None) -> str:
        kept = of if where is None else of.where(where)
        part, whole = int(kept.sum()), int(kept.count())
        return f"{part} of {whole}, {100 * part / max(1, whole):.1f} %"

    for source in _SOURCES:
        one = found.sel(source=source)
        holds = within(one)
        beside = ["", ""]
        if source != _SOURCES[1]:
            beside = [share(holds == within(itself)), share(near.sel(source=source))]
        told = share(holds.astype(float), one.undetermined == 0)
        rows.append([source, str(found.sizes["log"]), share(holds), told, *beside])
    return rows
