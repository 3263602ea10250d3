"""Study of ambiguities: the paper's 144 trials of RPS under one reading of the paper at a time.

    rps sweeps/ambiguities --quick

`--gazebo` runs the ingredients of the paper's simulator instead. The readings are in `readings`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import xarray as xr

from rps_jax import errors
from rps_jax.laws import resolve_law
from rps_jax.questions import call_of
from rps_jax.world import paper
from sweeps.ambiguities import readings
from sweeps.conditions import Condition, ConditionStudy, Grid, condition_rows
from sweeps.study_base import Table


@dataclass(frozen=True)
class Ambiguities(ConditionStudy):
    """Run the paper's trials under one reading of its open details at a time.

    The result has the outcomes (condition, law, object, friction, target).
    """

    TITLE = "What the paper leaves open"
    QUICK: ClassVar = {"targets": paper.FEW_TARGETS}
    GROWS = ("readings", "gazebo")

    laws: tuple[str, ...] = ()
    """Names of laws; by default rps, and with --gazebo also nps and aps."""
    readings: tuple[str, ...] = ()
    """Names of the readings; by default all that the laws allow."""
    gazebo: bool = False
    """Whether to run the ingredients of the paper's simulator instead, with all three laws."""

    @property
    def known(self) -> dict[str, Condition]:
        """Readings by name."""
        return readings.GAZEBO if self.gazebo else readings.READINGS

    @property
    def chosen(self) -> dict[str, Condition]:
        """Selected readings, the defaults first."""
        names = self.readings or [
            name
            for name, reading in self.known.items()
            if name not in self.refused and not reading.is_default(self.grid.laws)
        ]
        return {name: self.known[name] for name in (readings.DEFAULT, *names)}

    @property
    def refused(self) -> tuple[str, ...]:
        """Readings whose parameters a law refuses; they run only on request."""
        laws = self.grid.laws
        return tuple(name for name, reading in self.known.items() if not reading.is_allowed(laws))

    @property
    def grid(self) -> Grid:
        """Trials of each reading."""
        laws = self.laws or (paper.LAWS if self.gazebo else ("rps",))
        return Grid(laws=laws, targets=self.targets)

    def check(self) -> None:
        """Check the names."""
        super().check()
        for name in self.readings:
            errors.check_name("reading", name, self.known)
        for name in self.grid.laws:
            resolve_law(name)

    def intro(self, results: xr.Dataset) -> str:
        """Trials, tests and left-out readings."""
        without = [self.known[name].what for name in self.refused if name not in self.chosen]
        left_out = (
            f" Left out, because the law refuses it: {', '.join(without)}." if without else ""
        )
        return (
            f"{self.grid.size} trials in every row, in the fused engine. Differences: McNemar's "
            f"exact test, false discoveries held at 5 %.{left_out}"
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return successes under each reading, and the cells of Table II."""
        names, laws = list(self.chosen), self.grid.laws
        tables = [
            Table(condition_rows(results, names[0], law), title=f"Readings, {law.upper()}")
            for law in laws
        ]
        if self.gazebo and "paper_gazebo" in names and set(laws) <= set(paper.LAWS):
            tables.append(Table(readings.cells(results), title="Cells of Table II"))
        return tables


ambiguities = call_of(Ambiguities)
