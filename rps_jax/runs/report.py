"""The report of a sweep: rates, differences, what success depends on, and the hardest worlds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import xarray as xr

from rps_jax.analysis import figures, statistics, tables
from rps_jax.analysis.report import Section
from rps_jax.analysis.report import write_report as _write
from rps_jax.record import provenance
from rps_jax.runs.plan import Plan


def write_report(
    folder: Path,
    plan: Plan,
    results: xr.Dataset,
    models: xr.Dataset | None = None,
    more: Sequence[Section] = (),
) -> Path:
    """Write `report.md`, `report.html` and the figure of a sweep; returns the path of the first.

    `models` are outcomes of the same worlds on several models, (model, arm, world). What a study
    has to say beyond that is `more`, which then stands for the differences of all pairs.
    """
    source = f"seed {plan.setting.seed}" if plan.points is None else "points of the unit cube"
    intro = (
        f"{plan.worlds} worlds, {source}, engine {plan.setting.engine}, "
        f"{1000 * plan.setting.physics.timestep:g} ms steps; every arm meets the same worlds. "
        f"Intervals: Wilson 95 %; bounds of failures: Clopper-Pearson 95 %.\n\n"
        f"{provenance.told(folder)}"
    )
    rates = tables.success_table(results, float(plan.setting.rules.max_lost))
    failures = (
        "CVaR: mean over the worst 5 % of worlds of the least distance between contact point and "
        "target; of an object that was never touched, the whole way. "
        f"{statistics.NOT_PROMISED}"
    )
    if lost := int((results.overflows.values > 0).sum()):
        failures += f" {lost} trials lost contacts for want of room: they are not to be trusted."
    hard = "Worlds in which most arms fail, and most distance is left."
    sections = [Section("Success", failures, rates), *more]
    if models is not None:
        text = (
            "The same worlds on other grounds, cones and steps that can be defended. A rate's "
            "interval says what other worlds would have given; its range over the models says "
            "what another simulation would have."
        )
        sections.append(Section("Models", text, tables.models_table(models)))
    if len(plan.arms) > 1 and not more:
        sections.append(
            Section("Differences, world by world", "", tables.difference_table(results))
        )
    if statistics.drawn(results):
        picture = figures.success_curves(results, folder / "success.png")
        sections.append(Section("Success against what was drawn", "", (), picture))
    hardest = tables.hardest_table(results, str(folder))
    sections.append(Section("The hardest worlds", hard, hardest))
    _write(folder, "Sweep over random worlds", intro, sections)
    return folder / "report.md"
