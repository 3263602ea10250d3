"""What was tried to mend the law's losses, one mend at a time, in worlds for tuning.

    rps sweeps/mends --domain hostile --worlds 4096

pushes with the tuned law, with its first mend (translation near the target, but not while it
realigns) and with that and one more mend, all in the same worlds, and compares them world by world.
The mends stand in `mended`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import xarray as xr

from rps_jax import errors
from rps_jax.analysis import tables
from rps_jax.analysis.report import Section
from rps_jax.control.base import LawParams
from rps_jax.control.registry import LawsLike
from rps_jax.record.options import option
from rps_jax.runs import sweep as sweeps
from rps_jax.runs.plan import Plan
from rps_jax.runs.question import Run, call_of, seed_of
from rps_jax.runs.sweep import SweepQuestion
from rps_jax.trials.setting import Setting
from rps_jax.world.domain import DomainLike
from sweeps.mends.mended import FIRST, MENDS


@dataclass(frozen=True)
class Mends(SweepQuestion):
    """Push with one mend of the tuned law at a time, in worlds for tuning, and compare them.

    The answer holds outcomes (law, world), as of `rps_jax.sweep`.
    """

    TITLE: ClassVar[str] = "Mends of the tuned law"
    QUICK: ClassVar[Mapping[str, Any]] = {"worlds": 32}

    laws: LawsLike = ()
    """The mends, by their names in the table; by default all. The one that the others are compared
    with is always among them."""
    domain: DomainLike = "hostile"
    """Ranges from which worlds are drawn: paper, hardware, wide, real, prisms or hostile, or a JSON
    file of ranges; changes follow, as hostile,mass=3:10."""
    worlds: int | None = option(256, 1, 1_000_000_000)
    """Number of worlds."""
    setting: Setting = field(default=Setting(seed=80), kw_only=True)

    @cached_property
    def chosen(self) -> dict[str, LawParams]:
        """Parameters of the mends, by name."""
        asked = [self.laws] if isinstance(self.laws, str) else list(self.laws)
        for name in asked:
            errors.check_name("mend", name, MENDS)
        return {n: p for n, p in MENDS.items() if n in (asked or MENDS) or n == FIRST}

    @cached_property
    def plan(self) -> Plan:
        """What is run: in worlds for tuning."""
        plan = super().plan
        seed = seed_of(self.setting.seed, "tune")
        return dataclasses.replace(plan, setting=dataclasses.replace(plan.setting, seed=seed))

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Each mend against the first, world by world."""
        rows = tables.against_table(results, FIRST)
        against = Section(f"Against: {FIRST}", "World by world; p by Holm.", rows)
        return [against, sweeps.success_section(results, float(self.plan.setting.rules.max_lost))]


mends = call_of(Mends)
