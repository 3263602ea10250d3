"""Bases that cannot move sideways: success and time by drive, axle and domain, in equal worlds.

rps sweeps/drives
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import xarray as xr

from rps_jax import Rules, Setting
from rps_jax.analysis import statistics, tables
from rps_jax.questions import Plan, Run, call_of, option
from sweeps.study_base import PlanStudy, Rows, Table, TrialStudy, plan_of, run_plans

OMNI = "holonomic, rps_plus"


class Base(NamedTuple):
    """Robot of a row of the table, and its law."""

    robot: str
    law: str
    rules: Rules | None = None  # by default the setting's


FRONT_SKIN = Path(__file__).with_name("front_skin.json")
DRIFT = f"{Path(__file__).with_name('drift.py')}:DriftParams"
PATIENT = Rules(horizon=900.0, max_lost=600.0)
CAR = "ideal,drive=car,turning_radius=0.5"
DIFFERENTIAL = "ideal,drive=differential"
BASES: dict[str, Base] = {
    OMNI: Base("ideal", "rps_plus"),
    "holonomic, rps_reposition": Base("ideal", "rps_reposition"),
    "differential": Base(DIFFERENTIAL, "unicycle"),
    "differential, axle 0.15 m behind": Base(f"{DIFFERENTIAL},axle=0.15", "unicycle"),
    "differential, axle 0.3 m behind": Base(f"{DIFFERENTIAL},axle=0.3", "unicycle"),
    "differential, drifting odometry": Base(DIFFERENTIAL, DRIFT),
    "car, R 0.5 m": Base(CAR, "unicycle_car"),
    "car, R 0.5 m, axle 0.3 m behind": Base(f"{CAR},axle=0.3", "unicycle_car"),
    "car, axle 0.3 m behind, 600 s": Base(f"{CAR},axle=0.3", "unicycle_car", PATIENT),
    "round, holonomic, rps_plus": Base("round", "rps_plus"),
    "round, holonomic, rps_reposition": Base("round", "rps_reposition_round"),
    "round, differential": Base("round,drive=differential", "unicycle_round"),
    "skin on the front only": Base(str(FRONT_SKIN), "unicycle_front"),
}
DOMAINS = ("wide", "real", "hostile")
TASKS = {  # in the worlds of `wide`
    "paths": "path",
    "corridors of 2 m": "corridor,width=2",
    "corridors of 2 m, lookahead 1 m": "corridor,width=2,lookahead=1",
}


@dataclass(frozen=True)
class Drives(PlanStudy[xr.Dataset], TrialStudy[xr.Dataset]):
    """Compare bases with an omnidirectional one, in equal worlds of several domains.

    The results hold the outcomes (row, world); a row is a domain and a base.
    """

    TITLE: ClassVar[str] = "Bases that cannot move sideways"
    QUICK: ClassVar[Mapping[str, object]] = {"worlds": 32}
    CHOICES: ClassVar = {"bases": BASES, "domains": (*DOMAINS, *TASKS)}

    bases: Sequence[str] = (OMNI, *(x for x in BASES if "holonomic" not in x))
    """Names of bases."""
    domains: Sequence[str] = DOMAINS
    """Names of domains, or of tasks in `wide`: paths, corridors of 2 m with a lookahead."""
    worlds: int = option(10000, 2, 10_000_000)
    """Number of worlds of each domain."""
    file: str = "drives"
    """Name of the data file."""
    setting: Setting = field(default=Setting("fused", seed=9241), kw_only=True)

    @cached_property
    def plans(self) -> dict[str, Plan]:
        """The sweep of each row."""
        plans = {}
        for domain, name in product(self.domains, self.bases):
            robot, law, rules = BASES[name]
            setting = replace(self.setting, rules=rules or self.setting.rules)
            world = ("wide" if domain in TASKS else domain), self.worlds, setting, robot
            plans[f"{domain} | {name}"] = plan_of(law, *world, TASKS.get(domain))
        return plans

    def answer(self, run: Run) -> xr.Dataset:
        """Sweep each row."""
        names = ["success", "time", "contact_lost_time", "repositions", "tipped", "stalled"]
        rows = {row: part[names].isel(law=0, drop=True) for row, part in self.results(run).items()}
        return xr.concat(rows.values(), xr.IndexVariable("row", list(rows)), join="override")

    def results(self, run: Run) -> dict[str, xr.Dataset]:
        """Run what the run folder lacks of all rows."""
        return run_plans(run, self.plans)

    def intro(self, results: xr.Dataset) -> str:
        """Describe the worlds."""
        return (
            f"{self.worlds:,} worlds of each domain, seed {self.setting.seed}, equal for all "
            "bases. Intervals: Wilson 95 %."
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return success and times of each row."""
        limit = float(self.setting.rules.max_lost)
        table = drive_table(results, limit)
        return [Table(table, name=self.file, merge="domain", title="Drives")]


drives = call_of(Drives)


def drive_table(results: xr.Dataset, max_lost: float) -> Rows:
    """Return a header and a row for each domain and base."""
    header = ["domain", "base", "success", "against holonomic", "median time", "95 %"]
    header += ["repositions", "median without contact"]
    rows = [[*header, f"more than {max_lost:g} s without contact"]]
    for row in map(str, results.row.values):
        domain, _, base = row.partition(" | ")
        trials, reference = results.sel(row=row), f"{domain} | {OMNI}"
        success, lost = trials.success.values > 0, trials.contact_lost_time.values
        change = ""
        if reference in results.row.values and row != reference:
            change = statistics.compare(results.sel(row=reference).success, trials.success).changes
        times = trials.time.values[success]
        quantiles = [f"{x:.0f} s" for x in np.quantile(times, (0.5, 0.95))] if times.size else "--"
        cells = [f"{float(trials.repositions.mean()):.1f}", f"{np.median(lost):.0f} s"]
        cells.append(str(int(np.count_nonzero(lost > max_lost))))
        rows.append([domain, base, tables.rate(success), change, *quantiles, *cells])
    return rows
