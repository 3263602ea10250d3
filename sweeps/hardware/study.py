"""Study of worlds that reproduce all of the paper's hardware results together.

    rps sweeps/hardware

draws setups of the experiments: one skin and one robot, the friction of each object, and the start
of each push. A setup has sixteen pushes, of both objects to all eight targets. The paper reports
their success and the means of D and time. The setups nearest to these show which worlds may have
been the paper's (approximate Bayesian computation by rejection).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import xarray as xr
from scipy import stats

from rps_jax.analysis.figures import style
from rps_jax.control import registry
from rps_jax.control.registry import LawLike
from rps_jax.record.options import option
from rps_jax.runs.plan import Plan
from rps_jax.runs.question import Run, call_of
from rps_jax.trials.setting import Setting
from rps_jax.world import domain as domains
from rps_jax.world import paper, points
from rps_jax.world.domain import Domain
from sweeps.study_base import Rows, Table, TrialStudy, run_plans

RANGES = (
    "hardware,friction_ground=0.1:0.8,friction_robot=0.15:1.2,lateral=-0.05:0.05,yaw=-0.2:0.2,"
    "foam=0.002:0.02,time_constant=0.02:0.2,robot_lag=0:0.5,robot_slip=0:0.1,pose_latency=0:0.2,"
    "command_delay=0:0.2"
)
_BY_OBJECT = ("friction_ground", "friction_robot")  # quantities of an object
_BY_PUSH = ("lateral", "yaw", "key_0", "key_1")  # quantities of a push; the rest are of a setup
TOLERANCE = {"D": 0.005, "time": 5.0}  # [m, s] within which a setup's means are the paper's
_BOX, _CYLINDER = paper.HARDWARE_OBJECTS
_SHORT = {_BOX: "box", _CYLINDER: "cylinder"}
_MEANS = {"D": "mean_abs_l", "time": "time"}  # names in the results of trials and of the paper


@dataclass(frozen=True)
class Reproduce(TrialStudy[xr.Dataset]):
    """Search for frictions, skins and robots that reproduce the paper's hardware results together.

    The result has `success` and the means `D` [m] and `time` [s] over successes (setup, object),
    the quantities `drawn` (setup, quantity), and the distance `off` (setup) from the paper [1].
    """

    TITLE: ClassVar[str] = "Worlds that reproduce the paper's hardware runs"
    QUICK: ClassVar[Mapping[str, object]] = {"setups": 8}

    law: LawLike = "rps"
    """The law: its name, as rps or aps, or a file's; changes follow, as rps,K_h=0.3."""
    domain: domains.DomainLike = RANGES
    """Ranges from which setups are drawn; the targets are the paper's."""
    setups: int = option(160, 4, 1_000_000)
    """Number of setups, of sixteen pushes each."""
    setting: Setting = field(default=Setting("fused"), kw_only=True)

    @cached_property
    def ranges(self) -> Domain:
        """Domain with the paper's targets."""
        return replace(domains.parse_domain(self.domain), targets=paper.HARDWARE_LAYOUTS["circle"])

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of setups, objects and targets."""
        return self.setups, len(_SHORT), len(self.ranges.targets)

    @cached_property
    def plan(self) -> Plan:
        """Sweep of all pushes; those of a setup follow one another, targets fastest."""
        names, rng = points.names(self.ranges), np.random.default_rng(self.setting.seed)
        _, objects, targets = self.shape
        u = rng.random((*self.shape, len(names)))
        for i, name in enumerate(names):
            if name == "object":
                u[..., i] = (np.arange(objects)[:, None] + 0.5) / objects
            elif name == "target":
                u[..., i] = (np.arange(targets) + 0.5) / targets
            elif name not in _BY_PUSH:
                rows = slice(None) if name in _BY_OBJECT else slice(1)
                u[..., i] = u[:, rows, :1, i]
        label, params = registry.resolve_law(self.law)
        at = points.check_points(self.ranges, u.reshape(-1, len(names)))
        return Plan(self.ranges, len(at.u), {label: params}, self.setting, 256, at)

    def check(self) -> None:
        """Check the domain, and the engine on this machine."""
        self.plan.check_here()

    def num_trials(self) -> int | None:
        """Number of pushes."""
        return self.plan.worlds

    def answer(self, run: Run) -> xr.Dataset:
        """Push, and compute the means of each setup."""
        trials = run_plans(run, {"pushes": self.plan})["pushes"].isel(law=0)
        success = trials.success.values.reshape(self.shape) > 0
        count = np.where(success.any(2), success.sum(2), np.nan)
        dims, squares, means = ("setup", "object"), np.zeros(self.setups), {}
        for name, column in _MEANS.items():
            values = np.where(success, trials[column].values.reshape(self.shape), np.nan)
            means[name] = np.nansum(values, 2) / count
            in_paper = [getattr(paper.HARDWARE_RESULTS[key], column) for key in _SHORT]
            squares += np.sum(((means[name] - in_paper) / TOLERANCE[name]) ** 2, 1)
        drawn = {}
        for name in points.names(self.ranges, "range"):
            if name not in _BY_PUSH:
                values, words = self._drawn(name), style.quantity(name)
                by_object = {f"{words}, {o}": values[:, i] for i, o in enumerate(_SHORT.values())}
                drawn |= by_object if name in _BY_OBJECT else {words: values[:, 0]}
        off = np.where(success.all((1, 2)), np.sqrt(squares / 4), np.inf)
        columns = {
            "success": (dims, success.sum(2)),
            **{name: (dims, values) for name, values in means.items()},
            "off": ("setup", off),
            "drawn": (("setup", "quantity"), np.stack(list(drawn.values()), 1)),
        }
        return xr.Dataset(columns, {"object": list(_SHORT.values()), "quantity": list(drawn)})

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the results, and the quantities of the setups nearest to the paper."""
        return [
            Table(rows, name=f"hardware_{name}", title=name.capitalize())
            for name, rows in tables(results).items()
        ]

    def _drawn(self, name: str) -> np.ndarray:
        """Return a quantity (setup, object) in its unit."""
        assert self.plan.points is not None
        u = self.plan.points.u[:, points.names(self.ranges).index(name)]
        return getattr(self.ranges, name).at(u).reshape(self.shape)[..., 0]

    def intro(self, results: xr.Dataset) -> str:
        """Setups, and the distance from the paper."""
        return (
            f"{self.setups} setups of {len(self.ranges.targets)} targets and two objects each. A "
            "setup's distance is the root mean square difference of its four means from the "
            f"paper's, D in units of {1000 * TOLERANCE['D']:g} mm and times in units of "
            f"{TOLERANCE['time']:g} s; all sixteen pushes must succeed."
        )


reproduce = call_of(Reproduce)


def nearest(results: xr.Dataset) -> xr.Dataset:
    """Return the twentieth of the setups, at least four, that is nearest to the paper."""
    order = np.argsort(results.off.values, kind="stable")
    return results.isel(setup=order[: max(4, results.sizes["setup"] // 20)])


def tables(results: xr.Dataset) -> dict[str, Rows]:
    """Return header and rows of both tables of the page."""
    near = nearest(results)
    best = results.isel(setup=int(np.argmin(results.off.values)))
    pairs = list(itertools.product(_MEANS, results.object.values))
    formats = {"D": ("{:.3f}", "m"), "time": ("{:.0f}", "s")}
    rows = [["", "paper", "all setups: median, 5 to 95 %", "the nearest twentieth", "the nearest"]]
    for key, name in _SHORT.items():
        for mean, (form, unit) in formats.items():
            in_paper = form.format(getattr(paper.HARDWARE_RESULTS[key], _MEANS[mean]))
            cells = [_range(x[mean].sel(object=name).values, form, unit) for x in (results, near)]
            in_best = form.format(float(best[mean].sel(object=name)))
            rows.append([f"{mean}, {name}", f"{in_paper} {unit}", *cells, f"{in_best} {unit}"])
        shares = [_share(x.success.sel(object=name).values) for x in (results, near)]
        in_best = "yes" if int(best.success.sel(object=name)) == 8 else "no"
        rows.append([f"all 8 succeed, {name}", "yes", *shares, in_best])
    correlations = [f"rank correlation with {mean} of the {name}" for mean, name in pairs]
    header = ["quantity", "drawn from", "the nearest twentieth: median, 5 to 95 %", *correlations]
    quantities = [header]
    for quantity in map(str, results.quantity.values):
        values = results.drawn.sel(quantity=quantity).values
        ranks = [
            _correlation(values, results[mean].sel(object=name).values) for mean, name in pairs
        ]
        drawn_from = f"{values.min():.2g} to {values.max():.2g}"
        near_range = _range(near.drawn.sel(quantity=quantity).values, "{:.2g}")
        quantities.append([quantity, drawn_from, near_range, *ranks])
    return {"results": rows, "quantities": quantities}


def _range(values: np.ndarray, form: str, unit: str = "") -> str:
    low, middle, high = (form.format(x) for x in np.nanquantile(values, [0.05, 0.5, 0.95]))
    return f"{middle} {unit}".strip() + f" [{low}, {high}]"


def _share(successes: np.ndarray) -> str:
    return f"{100 * np.mean(successes == len(paper.HARDWARE_LAYOUTS['circle'])):.0f} %"


def _correlation(a: np.ndarray, b: np.ndarray) -> str:
    """Return the rank correlation of the finite pairs."""
    return f"{stats.spearmanr(a, b, nan_policy='omit').statistic:+.2f}"
