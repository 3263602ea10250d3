"""Bases that cannot move sideways in another engine: outcomes that equal those in C MuJoCo.

rps sweeps/drives/engines.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import xarray as xr

from rps_jax.analysis import tables
from rps_jax.questions import Plan, call_of, option
from sweeps.drives.study import Drives
from sweeps.study_base import Table

ENGINES = ("fused", "mujoco")


@dataclass(frozen=True)
class DriveEngines(Drives):
    """Compare bases in the same worlds of the engines fused and mujoco."""

    TITLE: ClassVar[str] = "Drives in two engines"
    QUICK: ClassVar[Mapping[str, object]] = {"worlds": 4}

    bases: Sequence[str] = (
        "differential",
        "differential, axle 0.3 m behind",
        "car, R 0.5 m, axle 0.3 m behind",
        "round, differential",
        "skin on the front only",
    )
    """Names of bases."""
    domains: Sequence[str] = ("wide",)
    """Names of domains."""
    worlds: int = option(300, 2, 10_000_000)
    """Number of worlds of each domain."""

    @cached_property
    def plans(self) -> dict[str, Plan]:
        """The sweep of each row, in both engines."""
        plans = {}
        for row, plan in super().plans.items():
            for engine in ENGINES:
                setting = replace(plan.setting, engine=engine)
                plans[f"{engine} | {row}"] = replace(plan, setting=setting)
        return plans

    def num_trials(self) -> int | None:
        """Return the number of trials."""
        return 2 * (super().num_trials() or 0)

    def report_tables(self, results: xr.Dataset) -> list[Table]:
        """Return success in both engines, and the share of equal outcomes."""
        rows = [["domain", "base", "success, fused", "success, mujoco", "equal outcomes"]]
        for row in map(str, results.row.values):
            engine, _, name = row.partition(" | ")
            if engine == "fused":
                success = [results.success.sel(row=f"{x} | {name}").values > 0 for x in ENGINES]
                equal = tables.rate(success[0] == success[1])
                rows.append([*name.split(" | "), *map(tables.rate, success), equal])
        return [Table(rows, name="drives_engines", merge="domain", title="Equal outcomes")]


drive_engines = call_of(DriveEngines)
