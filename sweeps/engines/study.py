"""Do the engines agree in random worlds?

    rps sweeps/engines --worlds 90

runs the same worlds in every engine and compares the outcomes with those of converged C MuJoCo.
`rps sweep` runs one engine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import xarray as xr

from rps_jax import Range, Setting
from rps_jax.analysis import statistics
from rps_jax.control.registry import LawLike
from rps_jax.laws import resolve_law
from rps_jax.physics import PHYSICS, preset
from rps_jax.questions import Plan, Run, call_of, option
from rps_jax.worlds import DomainLike, parse_domain
from sweeps.study_base import PlanStudy, Rows, Table, TrialStudy, run_plans

_CONVERGED = Setting(physics=preset(fidelity="reference"), engine="mujoco")
_MOVED = 1e-6  # [m]
# The first is the reference of the others. In those named "moved", objects start a micrometre
# farther away: they show how many outcomes are chaotic.
ENGINES = {
    "C, reference": _CONVERGED,
    "C, reference, moved": _CONVERGED,
    "C, standard": Setting(physics=preset(), engine="mujoco"),
    "fused, standard": Setting(physics=preset(), engine="fused"),
    "fused, 5 ms": Setting(physics=replace(preset(), timestep=0.005)),
    "fused, fast": Setting(physics=preset(fidelity="fast"), engine="fused"),
    "quasistatic": Setting(physics=preset(), engine="quasistatic"),
    "MJX, standard": Setting(physics=preset(), engine="mjx"),
}


@dataclass(frozen=True)
class Engines(PlanStudy[xr.DataTree], TrialStudy[xr.DataTree]):
    """Compare the outcomes of engines in random worlds.

    The answer is a tree with the outcomes (world) of each engine.
    """

    TITLE = "Do the engines agree in random worlds?"
    QUICK: ClassVar = {
        "worlds": 16,
        "objects": ("random_cylinder",),
        "engines": ("C, standard", "fused, standard"),
    }
    CHOICES: ClassVar = {"engines": ENGINES}
    GROWS = ("engines",)
    PRESETS: ClassVar = PHYSICS["default"]

    law: LawLike = "rps"
    """The law: its name, as rps or aps, or a file's; changes follow, as rps,K_h=0.3."""
    domain: DomainLike = "wide"
    """Ranges from which worlds are drawn: paper, hardware, wide, real, prisms or hostile, or a JSON
    file of ranges; changes follow, as wide,mass=3:10."""
    worlds: int = option(90, 1, 10_000_000)
    """Number of worlds."""
    objects: tuple[str, ...] = ()
    """Objects to push, as random_box random_cylinder; by default the domain's."""
    engines: tuple[str, ...] = ()
    """Engines and physics by name, the first to be compared with; by default all."""
    part: int = option(256, 1, 1_000_000)
    """Number of trials in a part, the maximum that a kill loses. C waits for the slowest trial of
    each part."""

    @cached_property
    def plans(self) -> dict[str, Plan]:
        """Plans by name of the engine."""
        ranges = parse_domain(self.domain)
        ranges = replace(ranges, objects=self.objects or ranges.objects)
        label, params = resolve_law(self.law)
        low, high, log = ranges.gap
        moved = replace(ranges, gap=Range(low + _MOVED, high + _MOVED, log))
        plan = Plan(ranges, self.worlds, {label: params}, _CONVERGED, self.part)
        return {
            name: replace(
                plan, domain=moved if name.endswith("moved") else ranges, setting=ENGINES[name]
            )
            for name in self.engines or ENGINES
        }

    def answer(self, run: Run) -> xr.DataTree:
        """Run the missing trials of each engine."""
        results = run_plans(run, self.plans)
        return xr.DataTree.from_dict({name: part.isel(law=0) for name, part in results.items()})

    def intro(self, results: xr.DataTree) -> str:
        """Describe the worlds."""
        return f"{self.worlds} worlds, equal in all engines. Intervals: Wilson 95 %."

    def report_tables(self, results: xr.DataTree) -> Sequence[Table]:
        """Return the outcomes equal to those of the first engine."""
        by_engine = {name: results[name].to_dataset() for name in self.plans}
        return [Table(agreement_table(by_engine), title="Equal outcomes")]


engines = call_of(Engines)


def agreement_table(results: Mapping[str, xr.Dataset]) -> Rows:
    """Return a header and a row per engine: success, and outcomes equal to the first's, by object.

    The results are those of one law in the same worlds.
    """
    base = next(iter(results.values()))
    groups = statistics.worlds_by_object(base)
    rows = [["engine", *groups, "equal outcomes", "95 %", *(f"equal, {g}" for g in groups), "+/-"]]
    for name, dataset in results.items():
        succeeded = dataset.success.values > 0
        same = succeeded == (base.success.values > 0)
        c = statistics.compare(base.success, dataset.success)
        low, high = statistics.wilson(int(same.sum()), same.size)
        counts, equal = (
            [f"{mask[group].sum()} of {group.sum()}" for group in groups.values()]
            for mask in (succeeded, same)
        )
        share, interval = f"{100 * same.mean():.1f} %", f"{100 * low:.0f}-{100 * high:.0f} %"
        rows.append([name, *counts, share, interval, *equal, c.changes])
    return rows
