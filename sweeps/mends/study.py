"""Candidate additions to the tuned law, one at a time, in tuning worlds.

    rps sweeps/mends --domain hostile --worlds 4096

runs the tuned law, the first addition (translation near the target, but not while the law
realigns), and the first with one more addition, in the same worlds, and compares the outcomes.
`mended` has the additions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import xarray as xr

from rps_jax import Setting, errors
from rps_jax.analysis import tables
from rps_jax.laws import LawParams, LawsLike
from rps_jax.questions import Plan, Run, Section, call_of, option
from rps_jax.runs.sweep import SweepQuestion
from rps_jax.worlds import DomainLike
from sweeps.mends.mended import FIRST, MENDS


@dataclass(frozen=True)
class Mends(SweepQuestion):
    """Compare candidate additions to the tuned law, one at a time, in tuning worlds.

    The results hold outcomes (law, world), like those of `rps_jax.sweep`.
    """

    TITLE = "Mends of the tuned law"
    QUICK: ClassVar = {"worlds": 32}

    laws: LawsLike = ()
    """Additions, by their names in the table; by default all. The addition of comparison is always
    included."""
    domain: DomainLike = "hostile"
    """Ranges from which worlds are drawn: paper, hardware, wide, real, prisms or hostile, or a JSON
    file of ranges; changes follow, as hostile,mass=3:10."""
    worlds: int | None = option(256, 1, 1_000_000_000)
    """Number of worlds."""
    setting: Setting = field(default=Setting(seed=80), kw_only=True)

    @cached_property
    def chosen(self) -> dict[str, LawParams]:
        """Parameters of the laws, by the name of the addition."""
        names = [self.laws] if isinstance(self.laws, str) else list(self.laws)
        for name in names:
            errors.check_name("mend", name, MENDS)
        return {n: p for n, p in MENDS.items() if n in (names or MENDS) or n == FIRST}

    @cached_property
    def plan(self) -> Plan:
        """Plan of the sweep, in tuning worlds."""
        plan = super().plan
        setting = dataclasses.replace(plan.setting, split="tune")
        return dataclasses.replace(plan, setting=setting)

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Return sections that compare each addition with the first, world by world."""
        rows = tables.against_table(results, FIRST)
        compared = Section(f"Against: {FIRST}", "World by world; p by Holm.", rows)
        return [compared, super().report(results, run)[0]]


mends = call_of(Mends)
