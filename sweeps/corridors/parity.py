"""Outcomes of tasks in the fused engine, compared with those of converged C MuJoCo.

    rps sweeps/corridors/parity.py --rows path --worlds 30

A new row is one entry of `ROWS`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import xarray as xr

from rps_jax import Setting
from rps_jax.analysis import statistics, tables
from rps_jax.laws import resolve_law
from rps_jax.physics import PHYSICS, EngineName, preset
from rps_jax.questions import Plan, Run, call_of, option
from rps_jax.worlds import DomainLike, parse_domain
from sweeps.study_base import PlanStudy, Study, Table, run_plans


class Row(NamedTuple):
    """Worlds of one row of the table, and the law in them."""

    task: str
    domain: DomainLike = "wide"
    law: str = "rps_tuned"
    robot: str | None = None
    fidelity: Any = "standard"  # of the fused engine


_TOUCHED = "corridor,touch=object,width=1.2:1.6"
ROWS = {
    "path": Row("path"),
    "corridor": Row("corridor"),
    "slope": Row("reach", "wide,slope=0:0.105"),
    "slope, limited base": Row("reach", "real,slope=0:0.105"),
    "boundary": Row("reach", "wide,boundary_factor=0.3:3,boundary=0.5"),
    "walls that objects touch": Row(_TOUCHED),
    "walls that objects touch, fine steps": Row(_TOUCHED, fidelity="reference"),
    "round base": Row("corridor", robot="round"),
    "round base, fine steps": Row("corridor", robot="round", fidelity="reference"),
}
ENGINES: dict[str, EngineName] = {"reference": "mujoco", "fused": "fused"}


@dataclass(frozen=True)
class Parity(PlanStudy[xr.DataTree], Study[xr.DataTree]):
    """Compare the outcomes of tasks in the fused engine with those of converged C MuJoCo.

    The answer is a tree with the outcomes (law, world) of each row in both engines.
    """

    TITLE = "Tasks in the fused engine and in converged C MuJoCo"
    CHOICES: ClassVar = {"rows": ROWS}
    GROWS = ("rows",)
    PRESETS: ClassVar = PHYSICS["default"]

    rows: tuple[str, ...] = tuple(ROWS)
    """Rows of the table: path, corridor, slope, boundary, round base and others."""
    worlds: int = option(300, 1, 10_000_000)
    """Number of worlds of each row."""
    seed: int = option(77, 0, 2**32 - 1)
    """Seed of the worlds."""
    part: int = option(60, 1, 1_000_000)
    """Number of trials in a part, the maximum that a kill loses."""

    @cached_property
    def plans(self) -> dict[str, Plan]:
        """Plans by row and engine."""
        return {
            f"{row} {engine}": self._plan(ROWS[row], engine)
            for row in self.rows
            for engine in ENGINES
        }

    def _plan(self, row: Row, engine: str) -> Plan:
        """Return the plan of a row in an engine."""
        label, params = resolve_law(row.law)
        fidelity = row.fidelity if engine == "fused" else "reference"
        setting = Setting(ENGINES[engine], physics=preset(fidelity=fidelity), seed=self.seed)
        domain = parse_domain(row.domain, row.robot, row.task)
        return Plan(domain, self.worlds, {label: params}, setting, self.part)

    def answer(self, run: Run) -> xr.DataTree:
        """Run the missing trials."""
        return xr.DataTree.from_dict(dict(run_plans(run, self.plans)))

    def intro(self, results: xr.DataTree) -> str:
        """Describe the worlds."""
        return f"{self.worlds} worlds, equal in both engines. Intervals: Wilson 95 %."

    def report_tables(self, results: xr.DataTree) -> Sequence[Table]:
        """Return a row per task: success in both engines, and equal outcomes."""
        heads = ("", "task", "worlds", "law", "success in C MuJoCo", "fused", "equal outcomes")
        rows = [[*heads, "+/-"]]
        for name in self.rows:
            reference, fused = (results[f"{name} {x}"].success > 0 for x in ENGINES)
            rates = (tables.rate(x.values) for x in (reference, fused, reference == fused))
            changes, row = statistics.compare(reference, fused).changes, ROWS[name]
            worlds = f"`{row.domain}`, {fused.size:,}"
            rows.append([name, f"`{row.task}`", worlds, row.law, *rates, changes])
        return [Table(rows, name="tasks_parity", title="Equal outcomes")]


parity = call_of(Parity)
