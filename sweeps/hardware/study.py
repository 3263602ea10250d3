"""Which frictions, skins and robots give all of the paper's hardware results together?

    rps sweeps/hardware

draws setups of the experiments: one skin and one robot, the friction of each object, and how each
push begins. A setup is sixteen pushes, of both objects to all eight targets, of which the paper
reports success and the means of D and of the time. The setups nearest to these tell which worlds
may have been the paper's (approximate Bayesian computation by rejection).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from rps_jax.analysis.report import Section
from rps_jax.control import registry
from rps_jax.control.registry import LawLike
from rps_jax.record.options import option
from rps_jax.runs import execution
from rps_jax.runs.plan import Plan
from rps_jax.runs.question import Run, call_of
from rps_jax.trials.setting import Setting
from rps_jax.tuning import fit
from rps_jax.world import domain as domains
from rps_jax.world import paper, points
from rps_jax.world.domain import Domain
from sweeps.study_base import Table, TrialStudy

RANGES = (
    "hardware,friction_ground=0.1:0.8,friction_robot=0.15:1.2,lateral=-0.05:0.05,yaw=-0.2:0.2,"
    "foam=0.002:0.02,time_constant=0.02:0.2,robot_lag=0:0.5,robot_slip=0:0.1,pose_latency=0:0.2,"
    "command_delay=0:0.2"
)
_OWN = ("friction_ground", "friction_robot")  # of an object; all of the others are of a setup
_EACH = ("lateral", "yaw", "key_0", "key_1")  # of a push
TOLERANCE = {"D": 0.005, "time": 5.0}  # [m, s] within which a setup's means are the paper's
_BOX, _CYLINDER = paper.HARDWARE_OBJECTS
_SHORT = {_BOX: "box", _CYLINDER: "cylinder"}


@dataclass(frozen=True)
class Reproduce(TrialStudy[xr.Dataset]):
    """Look for frictions, skins and robots that give the paper's hardware results together.

    The answer holds the means `D` [m] and `time` [s] over the successes, and `success`, of each
    object (setup, object), what was drawn (setup, quantity), and how far each setup is off (setup).
    """

    TITLE: ClassVar[str] = "Which worlds reproduce the paper's hardware runs?"
    QUICK: ClassVar[Mapping[str, Any]] = {"setups": 8}

    law: LawLike = "rps"
    """The law: its name, as rps or aps, or a file's; changes follow, as rps,K_h=0.3."""
    domain: domains.DomainLike = RANGES
    """Ranges from which setups are drawn; the targets are the paper's."""
    setups: int = option(160, 4, 1_000_000)
    """Number of setups, of sixteen pushes each."""
    setting: Setting = field(default=Setting("fused"), kw_only=True)

    @cached_property
    def ranges(self) -> Domain:
        """The domain with the paper's targets."""
        return replace(domains.named(self.domain), targets=paper.HARDWARE_LAYOUTS["circle"])

    @cached_property
    def plan(self) -> Plan:
        """All pushes: a setup's sixteen follow one another, targets fastest."""
        names, rng = points.names(self.ranges), np.random.default_rng(self.setting.seed)
        shape = (self.setups, 2, len(self.ranges.targets))
        u = rng.random((*shape, len(names)))
        for i, name in enumerate(names):
            if name in ("object", "target"):
                which = np.arange(2)[:, None] if name == "object" else np.arange(shape[2])
                u[..., i] = (which + 0.5) / shape[1 if name == "object" else 2]
            elif name not in _EACH:
                rows = slice(None) if name in _OWN else slice(1)
                u[..., i] = u[:, rows, :1, i]
        label, params = registry.resolve_law(self.law)
        found = points.checked(self.ranges, u.reshape(-1, len(names)))
        return Plan(self.ranges, len(found.u), {label: params}, self.setting, 256, found)

    def check(self) -> None:
        """Check the domain and that the engine can step its worlds here."""
        self.plan.check_here()

    def num_trials(self) -> int | None:
        """How many pushes there are."""
        return self.plan.worlds

    def answer(self, run: Run) -> xr.Dataset:
        """Push, and take the means of each setup."""
        folder = None if run.folder is None else run.folder / "pushes"
        pushed = execution.run_plan(self.plan, folder, **run.batch_options).isel(law=0)
        shape = (self.setups, 2, len(self.ranges.targets))
        won = pushed.success.values.reshape(shape) > 0
        D, time = (
            np.where(won, pushed[name].values.reshape(shape), np.nan)
            for name in ("mean_abs_l", "time")
        )
        off = np.zeros(self.setups)
        found: dict[str, Any] = {"success": (("setup", "object"), won.sum(2))}
        for name, values in (("D", D), ("time", time)):
            told = [getattr(paper.HARDWARE_RESULTS[one], {"D": "mean_abs_l"}.get(name, name))
                    for one in paper.HARDWARE_OBJECTS]  # fmt: skip
            mean = np.nansum(values, 2) / np.where(won.any(2), won.sum(2), np.nan)
            off += np.sum(((mean - told) / TOLERANCE[name]) ** 2, 1)
            found[name] = ("setup", "object"), mean
        drawn = [name for name in points.names(self.ranges, "range") if name not in _EACH]
        columns = {}
        for name in drawn:
            values = self._drawn(name)
            for i, thing in enumerate(_SHORT.values()):
                if name in _OWN:
                    columns[f"{fit.words(name)}, {thing}"] = values[:, i]
                elif i == 0:
                    columns[fit.words(name)] = values[:, i]
        found["off"] = "setup", np.where(won.all((1, 2)), np.sqrt(off / 4), np.inf)
        found["drawn"] = ("setup", "quantity"), np.stack(list(columns.values()), 1)
        return xr.Dataset(found, {"object": list(_SHORT.values()), "quantity": list(columns)})

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return both tables."""
        return {f"hardware_{name}": Table(rows) for name, rows in tables(results).items()}

    def _drawn(self, name: str) -> np.ndarray:
        """A quantity (setup, object) in its unit."""
        assert self.plan.points is not None
        u = self.plan.points.u[:, points.names(self.ranges).index(name)]
        return getattr(self.ranges, name).at(u).reshape(self.setups, 2, -1)[..., 0]

    def intro(self, results: xr.Dataset) -> str:
        """What was asked."""
        return (
            f"{self.setups} setups of {len(self.ranges.targets)} targets and two objects each. A "
            "setup's distance is the root of the mean square of its four means off the paper's, D "
            f"in units of {1000 * TOLERANCE['D']:g} mm and times in units of "
            f"{TOLERANCE['time']:g} s; all sixteen pushes must succeed."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """The results, and what is drawn of the setups nearest to the paper."""
        made = tables(results)
        return [
            Section("Results", "", made["results"]),
            Section("Quantities", "", made["quantities"]),
        ]


reproduce = call_of(Reproduce)


def nearest(found: xr.Dataset) -> xr.Dataset:
    """The twentieth of the setups, at least four, that is nearest to the paper."""
    order = np.argsort(found.off.values, kind="stable")
    return found.isel(setup=order[: max(4, found.sizes["setup"] // 20)])


def tables(found: xr.Dataset) -> dict[str, list[list[str]]]:
    """Header and rows of each table of the page."""
    near, best = nearest(found), found.isel(setup=int(np.argmin(found.off.values)))
    head = ["", "paper", "all setups: median, 5 to 95 %", "the nearest twentieth", "the nearest"]
    results = [head]
    for thing, key in zip(found.object.values, paper.HARDWARE_OBJECTS, strict=True):
        told = paper.HARDWARE_RESULTS[key]
        for name, form, unit in (("D", "{:.3f}", "m"), ("time", "{:.0f}", "s")):
            of_paper = told.mean_abs_l if name == "D" else told.time
            cells = [_told(one[name].sel(object=thing).values, form, unit) for one in (found, near)]
            own = f"{form.format(float(best[name].sel(object=thing)))} {unit}"
            results.append([f"{name}, {thing}", f"{form.format(of_paper)} {unit}", *cells, own])
        each = [_share(one.success.sel(object=thing).values) for one in (found, near)]
        results.append([f"all 8 succeed, {thing}", "yes", *each,
                        "yes" if int(best.success.sel(object=thing)) == 8 else "no"])  # fmt: skip
    head = ["quantity", "drawn from", "the nearest twentieth: median, 5 to 95 %",
            *(f"rank correlation with {name} of the {thing}"
              for name in ("D", "time") for thing in found.object.values)]  # fmt: skip
    quantities = [head]
    for name in map(str, found.quantity.values):
        every = found.drawn.sel(quantity=name).values
        ranks = [_rank_correlation(every, found[one].sel(object=thing).values)
                 for one in ("D", "time") for thing in found.object.values]  # fmt: skip
        quantities.append(
            [name, f"{every.min():.2g} to {every.max():.2g}",
             _told(near.drawn.sel(quantity=name).values, "{:.2g}"), *ranks]
        )  # fmt: skip
    return {"results": results, "quantities": quantities}


def _told(values: np.ndarray, form: str, unit: str = "") -> str:
    low, middle, high = (form.format(x) for x in np.nanquantile(values, [0.05, 0.5, 0.95]))
    return f"{middle} {unit}".strip() + f" [{low}, {high}]"


def _share(successes: np.ndarray) -> str:
    return f"{100 * np.mean(successes == len(paper.HARDWARE_LAYOUTS['circle'])):.0f} %"


def _rank_correlation(a: np.ndarray, b: np.ndarray) -> str:
    there = np.isfinite(b)
    ranks = [np.argsort(np.argsort(one[there])) for one in (a, b)]
    return f"{float(np.asarray(np.corrcoef(ranks)).flat[1]):+.2f}"
