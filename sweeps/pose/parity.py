"""Poses in two engines: the share of worlds whose outcomes are equal in C MuJoCo.

rps sweeps/pose/parity.py --worlds 300
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import xarray as xr

from rps_jax import Setting
from rps_jax.analysis import tables
from rps_jax.questions import Plan, Run, call_of, option
from sweeps.pose.study import CASES, LOOSE, TIGHT, YAW
from sweeps.study_base import PlanStudy, Rows, Table, TrialStudy, plan_of, run_plans

ENGINES = ("fused", "mujoco")
_CASE = "wide, boxes | omnidirectional | 0.2 m/s"


@dataclass(frozen=True)
class Parity(PlanStudy[xr.Dataset], TrialStudy[xr.Dataset]):
    """Compare the outcomes of poses in two engines, in equal worlds."""

    TITLE: ClassVar[str] = "Poses in two engines"
    QUICK: ClassVar[Mapping[str, object]] = {"worlds": 4}

    worlds: int = option(300, 1, 100_000)
    """Number of worlds."""
    setting: Setting = field(default=Setting("fused", seed=811203), kw_only=True)

    @cached_property
    def plans(self) -> dict[str, Plan]:
        """The sweep of each engine."""
        case = CASES[_CASE]
        plan = plan_of(case.law, case.domain, self.worlds, self.setting, case.robot, "pose")
        settings = {name: replace(self.setting, engine=name) for name in ENGINES}
        return {name: replace(plan, setting=setting) for name, setting in settings.items()}

    def answer(self, run: Run) -> xr.Dataset:
        """Sweep each engine."""
        names = ["place_error", "heading_error", "declared"]
        parts = [x[names].isel(law=0, drop=True) for x in run_plans(run, self.plans).values()]
        return xr.concat(parts, xr.IndexVariable("engine", list(ENGINES)), join="override")

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return success by engine, and the share of equal outcomes."""
        return [Table(parity_table(results), name="pose_parity", title="Engines")]


parity = call_of(Parity)


def parity_table(results: xr.Dataset) -> Rows:
    """Return a header and a row for each engine."""
    rows = [["engine", "5 cm", "2 cm", "equal outcomes, 5 cm", "heading, 95 %"]]
    good = (results.declared > 0) & (results.heading_error < YAW)
    first = (good & (results.place_error < LOOSE)).sel(engine=ENGINES[0])
    for engine in ENGINES:
        part, is_good = results.sel(engine=engine), good.sel(engine=engine)
        shares = [
            tables.share(int((is_good & (part.place_error < x)).sum()), is_good.size)
            for x in (LOOSE, TIGHT)
        ]
        equal = int((first == (is_good & (part.place_error < LOOSE))).sum())
        heading = part.heading_error.values[part.declared.values > 0]
        spread = f"{np.quantile(heading, 0.95):.4f} rad" if heading.size else "--"
        rows.append([engine, *shares, tables.share(equal, is_good.size), spread])
    return rows
