"""Success and time of four laws in the same random worlds, and over models of the physics.

    rps sweeps/random_worlds --machine "one NVIDIA H200"

The first worlds of each domain are also run with a panel of models and in C MuJoCo.
"""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, product
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from rps_jax import Setting
from rps_jax.analysis import statistics, tables
from rps_jax.laws import resolve_law
from rps_jax.questions import Plan, Run, call_of, option
from rps_jax.runs import model_panel
from rps_jax.worlds import parse_domain
from sweeps.study_base import Rows, Table, TrialStudy, run_plans, stored_parts

IN_C = "C MuJoCo, this ground, 10 ms"


@dataclass(frozen=True)
class RandomWorlds(TrialStudy[xr.Dataset]):
    """Test four laws in the same random worlds, and in fewer worlds with other physics models.

    The results hold `success` and `time` [s] (domain, model, law, world), with NaN for worlds that
    a model did not run.
    """

    TITLE = "Four laws in random worlds"
    QUICK: ClassVar = {"worlds": 24, "panel": 0, "in_c": 0}
    GROWS = (
        "against",
        "domains",
        "panel",
        "in_c",
        "only",
        "run_missing",
    )

    laws: tuple[str, ...] = ("rps", "rps_tuned", "rps_plus", "learned")
    """Laws to compare."""
    against: str = "rps_plus"
    """Law with which the others are compared world by world, if it is one of them."""
    domains: tuple[str, ...] = ("wide", "real", "hostile", "wide,task=path", "wide,task=corridor")
    """Domains from which worlds are drawn, with the tasks whose paths are drawn."""
    worlds: int = option(10_000, 2, 10_000_000)
    """Number of worlds of a domain."""
    panel: int = option(2_000, 0, 10_000_000)
    """Number of these worlds that are run with each model of the panel."""
    in_c: int = option(400, 0, 10_000_000)
    """Number of these worlds that are run in C MuJoCo."""
    only: tuple[str, ...] = ()
    """Models to run now, as "C MuJoCo*" or "quasi-static"; by default all. A GPU and processors can
    share a run in this way: afterwards copy the parts of both into one folder."""
    run_missing: bool = True
    """Whether to run the models that the run folder lacks; otherwise they are left out."""
    setting: Setting = field(default=Setting("fused", seed=6407), kw_only=True)

    def check(self) -> None:
        """Check that the laws and the domains exist."""
        _ = dict(map(resolve_law, self.laws))
        for name in self.domains:
            parse_domain(name)

    def answer(self, run: Run) -> xr.Dataset:
        """Run the models that are missing in each domain."""
        stored, parts = stored_parts(run), []
        for name in self.domains:
            for model, plan in self.plans(name).items():
                part_name = re.sub(r"[\W_]", "_", f"{name} {model}") + f"-{plan.worlds}"
                if self.run_missing or part_name in stored:
                    part = run.checkpoint(part_name, partial(_outcomes, plan, run))
                    parts.append(part.expand_dims(domain=[name], model=[model]))
        results: Any = xr.combine_by_coords(parts, join="outer", combine_attrs="drop")
        names = list(dict.fromkeys(str(part.model.item()) for part in parts))
        return results.sel(law=list(self.laws), domain=list(self.domains), model=names)

    def plans(self, name: str) -> dict[str, Plan]:
        """Return the plan of each model in a domain, the default model first."""
        laws = dict(map(resolve_law, self.laws))
        plan = Plan(parse_domain(name), self.worlds, laws, self.setting, 4096)
        plans = {model_panel.REQUESTED: plan}
        if self.panel:
            small = replace(plan, worlds=min(self.panel, self.worlds))
            plans = model_panel.model_plans(small) | plans
        if self.in_c:
            in_c = replace(plan.setting, engine="mujoco")
            plans[IN_C] = replace(plan, worlds=min(self.in_c, self.worlds), setting=in_c)
        selected = [fnmatch.filter(plans, pattern) for pattern in self.only or ("*",)]
        return {name: plan for name, plan in plans.items() if name in chain(*selected)}

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the rates, and the rates with each model of the panel."""
        text = (
            f"{self.worlds:,} worlds of seed {self.setting.seed}, the same for all laws. "
            "Intervals: Wilson 95 %."
        )
        if self.against in self.laws:
            text += (
                f" Against {self.against}: worlds in which only the law succeeds, worlds in which "
                f"only {self.against} does, and p of the exact McNemar test."
            )
        has_panel = results.sizes["model"] > 1
        tables = []
        if model_panel.REQUESTED in results.model:
            over = (
                " Over the models: least and greatest rate of a panel of grounds, friction cones, "
                "time steps and engines, each in the first of these worlds."
            )
            text += over * has_panel
            table = rate_table(results, self.against)
            tables.append(Table(table, name="headline", title="Success", text=text))
        if has_panel or not tables:
            tables.append(Table(panel_table(results), name="models", title="Models"))
        unpublished = {"name": ""} if self.only else {}
        return [table._replace(merge="domain", **unpublished) for table in tables]


random_worlds = call_of(RandomWorlds)


def _outcomes(plan: Plan, run: Run) -> xr.Dataset:
    """Return success (law, world) and the time of each trial [s]."""
    results = run_plans(run._replace(folder=None), {"": plan})[""]
    results = results[["success", "time"]].reset_coords(drop=True)
    return results.assign(success=results.success.astype(np.float32))


def rates(results: xr.Dataset, domain: str, law: str) -> dict[str, tuple[int, int]]:
    """Return the numbers of successes and trials, by the models that ran the domain."""
    by_model = {
        str(success.model.item()): success.values
        for success in results.success.sel(domain=domain, law=law).transpose("model", ...)
    }
    return {
        model: (int(np.nansum(success)), int(np.isfinite(success).sum()))
        for model, success in by_model.items()
        if np.isfinite(success).any()
    }


def rate_table(results: xr.Dataset, against: str) -> Rows:
    """Return a header and one row per domain and law, without columns that are empty."""
    rows = [_rate_row(results, *pair, against) for pair in _domains_and_laws(results)]
    names = [name for name in rows[0] if any(row[name] for row in rows)]
    return [names, *([row[name] for name in names] for row in rows)]


def _domains_and_laws(results: xr.Dataset) -> Iterator[tuple[str, str]]:
    return product(map(str, results.domain.values), map(str, results.law.values))


def _rate_row(results: xr.Dataset, domain: str, law: str, against: str) -> dict[str, str]:
    by_model = rates(results, domain, law)
    default = results.sel(domain=domain, law=law, model=model_panel.REQUESTED)
    median = float(default.time.where(default.success == 1).median())
    difference = ""
    if law != against and against in results.law:
        base = results.success.sel(domain=domain, law=against, model=model_panel.REQUESTED)
        compared = statistics.compare(base, default.success)
        p = f"p {compared.p:.1g}" if compared.p else "p < 1e-300"
        difference = f"{compared.changes}, {p}"
    return {
        "domain": domain,
        "law": law,
        "success": tables.share(*by_model[model_panel.REQUESTED]),
        f"against {against}": difference,
        "over the models": _rate_range(by_model) if len(by_model) > 1 else "",
        "in C MuJoCo": tables.share(*by_model[IN_C]) if IN_C in by_model else "",
        "median time of a success": f"{median:.1f} s" if np.isfinite(median) else "-",
    }


def _rate_range(by_model: Mapping[str, tuple[int, int]]) -> str:
    return tables.rate_range([successes / trials for successes, trials in by_model.values()])


def panel_table(results: xr.Dataset) -> Rows:
    """Return a header and one row per domain and law: its rate with each model, and their range."""
    names = results.model.values.tolist()
    rows = [["domain", "law", *names, "over these models"]]
    for domain, law in _domains_and_laws(results):
        by_model = rates(results, domain, law)
        cells = [tables.share(*by_model[name]) if name in by_model else "" for name in names]
        rows.append([domain, law, *cells, _rate_range(by_model)])
    return rows
