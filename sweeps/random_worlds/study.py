"""How often and how fast do the four laws push random objects home, and on which models?

One sample a row: all laws meet the same worlds, and a panel of models the first of these.

rps sweeps/random_worlds --machine "one NVIDIA H200"
"""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from rps_jax.analysis import tables
from rps_jax.analysis.report import Section
from rps_jax.control import registry
from rps_jax.record.options import option
from rps_jax.runs import execution, model_panel
from rps_jax.runs.plan import Plan
from rps_jax.runs.question import Run, call_of, setting_as_json
from rps_jax.trials.setting import Setting
from rps_jax.world import domain as domains
from sweeps.study_base import Table, TrialStudy

C = "C MuJoCo, this ground, 10 ms"


@dataclass(frozen=True)
class RandomWorlds(TrialStudy[xr.Dataset]):
    """Push with four laws in worlds that nobody looked at, and in fewer on a panel of models."""

    TITLE: ClassVar[str] = "Four laws in random worlds"
    QUICK: ClassVar[dict[str, Any]] = {"worlds": 24, "panel": 0, "in_c": 0}
    GROWS: ClassVar[tuple[str, ...]] = (*("domains", "panel", "in_c", "only", "run_missing"),)

    laws: tuple[str, ...] = ("rps", "rps_tuned", "rps_plus", "learned_gru")
    """Laws that are compared."""
    domains: tuple[str, ...] = ("wide", "real", "hostile")
    """Domains from which worlds are drawn."""
    worlds: int = option(10_000, 2, 10_000_000)
    """Number of worlds of a domain."""
    panel: int = option(2_000, 0, 10_000_000)
    """How many of them are tried on each model of the panel; 0: none."""
    in_c: int = option(2_000, 0, 10_000_000)
    """How many of them are tried in C MuJoCo; 0: none."""
    only: tuple[str, ...] = ()
    """Models that are run now, as "C MuJoCo*" or "quasi-static"; by default all. So a run can be
    shared by a GPU and processors; its parts are then put together in one folder."""
    run_missing: bool = True
    """Whether models that a run folder lacks in a domain are run; else they are left out."""
    setting: Setting = field(default=Setting("fused", seed=3119), kw_only=True)

    def check(self) -> None:
        """Check that the laws and the domains are known."""
        registry.resolve_laws(self.laws)
        for name in self.domains:
            domains.named(name)

    def configuration(self) -> dict[str, Any]:
        """All that the parts depend on, as JSON; a part has its domain, model and size besides."""
        return {**super().configuration(), "setting": setting_as_json(self.setting)}

    def answer(self, run: Run) -> xr.Dataset:
        """Outcomes (domain, model, law, world); a world that a model did not meet is NaN."""
        found = []
        for name in self.domains:
            for model, plan in self.plans(name).items():
                safe = "".join(c if c.isalnum() else "_" for c in f"{name} {model}")
                named = f"{safe}-{plan.worlds}"
                if (
                    not self.run_missing
                    and run.checkpoints is not None
                    and not run.checkpoints.get(named)
                ):
                    continue
                part = run.checkpoint(named, partial(_outcomes, plan, run))
                found.append(part.expand_dims(domain=[name], model=[model]))
        whole = xr.combine_by_coords(found, join="outer", combine_attrs="drop")
        assert isinstance(whole, xr.Dataset)
        names = list(dict.fromkeys(str(one.model.item()) for one in found))
        whole = whole.sel(law=list(self.laws), domain=list(self.domains), model=names)
        return whole

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return the rates, and those on each model of the panel."""
        if self.only:
            return {}
        tables = {"headline": Table(table(results), merge="domain")}
        if results.sizes["model"] > 1:
            tables["models"] = Table(panel_table(results), merge="domain")
        return tables

    def plans(self, name: str) -> dict[str, Plan]:
        """What is run in a domain: on each model, the default's worlds first."""
        laws = registry.resolve_laws(self.laws)
        plan = Plan(domains.named(name), self.worlds, laws, self.setting, 4096)
        found = {model_panel.OWN: plan}
        if self.panel:
            small = replace(plan, worlds=min(self.panel, self.worlds))
            found |= {
                k: v for k, v in model_panel.model_plans(small).items() if k != model_panel.OWN
            }
        if self.in_c:
            in_c = replace(plan.setting, engine="mujoco")
            found[C] = replace(plan, worlds=min(self.in_c, self.worlds), setting=in_c)
        return {k: v for k, v in found.items() if not self.only or _meets(k, self.only)}

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Rates with their intervals, their range over the models, and times."""
        text = (
            f"{self.worlds:,} worlds of seed {self.setting.seed}; every law meets the same ones. "
            "Intervals: Wilson 95 %."
        )
        if model_panel.OWN not in results.model:
            return [Section("Models", text, panel_table(results))]
        if results.sizes["model"] == 1:
            return [Section("Success", text, table(results))]
        text += (
            " Over the models: least and greatest rate of a panel of grounds, cones, steps and "
            "engines, each in the first of these worlds."
        )
        return [
            Section("Success", text, table(results)),
            Section("Models", "", panel_table(results)),
        ]


random_worlds = call_of(RandomWorlds)


def _meets(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch.fnmatch(name, one) for one in patterns)


def _outcomes(plan: Plan, run: Run) -> xr.Dataset:
    """Success (law, world), and the time of each trial [s]."""
    found = execution.run_plan(
        plan, None, callback=run.callback, slots=run.slots, workers=run.workers
    )
    found = found[["success", "time"]].reset_coords(drop=True)
    return found.assign(success=found.success.astype(np.float32))


def rates(found: xr.Dataset, domain: str, law: str) -> dict[str, tuple[int, int]]:
    """Successes and trials on each model that a domain knows."""
    won = found.success.sel(domain=domain, law=law)
    every = {str(m): won.sel(model=m).values for m in won.model.values}
    return {
        model: (int(np.nansum(one)), int(np.isfinite(one).sum()))
        for model, one in every.items()
        if np.isfinite(one).any()
    }


def table(found: xr.Dataset) -> list[list[Any]]:
    """Header and rows: a law in a domain; what no model of the panel told has no column."""
    rows = [_row(found, str(domain), str(law)) for domain in found.domain.values
            for law in found.law.values]  # fmt: skip
    names = [name for name in rows[0] if any(row[name] for row in rows)]
    return [names, *([row[name] for name in names] for row in rows)]


def _row(found: xr.Dataset, domain: str, law: str) -> dict[str, str]:
    by_model = rates(found, domain, law)
    own = found.sel(domain=domain, law=law, model=model_panel.OWN)
    shares = [won / of for won, of in by_model.values()]
    median = float(own.time.where(own.success == 1).median())
    return {
        "domain": domain,
        "law": law,
        "success": tables.share(*by_model[model_panel.OWN]),
        "over the models": tables.rate_range(shares) if len(shares) > 1 else "",
        "in C MuJoCo": tables.share(*by_model[C]) if C in by_model else "",
        "median time of a success": f"{median:.1f} s" if np.isfinite(median) else "-",
    }


def panel_table(found: xr.Dataset) -> list[list[str]]:
    """Header and rows: the rate of a law in a domain on each model, and their range."""
    names = [str(name) for name in found.model.values]
    rows = [["domain", "law", *names, "over these models"]]
    for domain in found.domain.values:
        for law in found.law.values:
            by_model = rates(found, domain, law)
            told = [tables.share(*by_model[name]) if name in by_model else "" for name in names]
            spread = tables.rate_range([won / of for won, of in by_model.values()])
            rows.append([str(domain), str(law), *told, spread])
    return rows
