"""The effect of a robot's limits on a law: force, lag, acceleration, size, pitch of the skin.

Every robot meets the same worlds as the ideal base, so that a loss is a paired difference. Force,
lag and acceleration are drawn, a different one for each world; sizes and pitches are taken in turn.

    rps sweeps/limits --worlds 2000
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import ClassVar

import numpy as np
import xarray as xr
from scipy import optimize

from rps_jax import Domain, Range, Robot, Rules, Setting, errors
from rps_jax.analysis import statistics, tables
from rps_jax.analysis.figures.style import Figure, success_rates, tiles
from rps_jax.geometry.solid import GRAVITY
from rps_jax.laws import LawParams
from rps_jax.questions import MultiLawQuestion, Picture, Plan, Run, Section, call_of, option
from rps_jax.trials import pushes
from rps_jax.worlds import Case, DomainLike, parse_domain
from sweeps.study_base import PlanStudy, Rows, run_plans

LOSSES = (0.01, 0.10)  # [1] of success, whose limits are looked for
_RESAMPLES = 200  # of a bootstrap
# Of whose turns a figure is drawn.
TURNING = {
    "no limit": Robot(),
    "1 rad/s² (1 m/s²)": Robot(acceleration_max=(1.0, 1.0)),
    "0.2 rad/s² (0.1 m/s²)": Robot(acceleration_max=(0.1, 0.2)),
    "lag 0.3 s": Robot(lag=0.3),
}


@dataclass(frozen=True)
class Limit:
    """Varied quantity."""

    label: str  # with its unit
    drawn: Mapping[str, Range] = field(default_factory=dict)  # ranges of a domain
    robots: Mapping[float, Robot] = field(default_factory=dict)  # or each value's robot
    value: Callable[[xr.Dataset], xr.DataArray] | None = (
        None  # of drawn worlds; by default as drawn
    )
    harms: int = 0  # 1: the more the worse, -1: the less the worse, 0: neither

    @property
    def log(self) -> bool:
        """Whether the values are drawn on a logarithmic scale."""
        return any(interval.log for interval in self.drawn.values())

    def values(self, results: xr.Dataset) -> np.ndarray:
        """Return the values (n,) in drawn worlds."""
        return np.asarray(self.value(results) if self.value else results[next(iter(self.drawn))])


def _with_front(count: int) -> Robot:
    """Return the paper's base with `count` boards across its front, and sides in proportion."""
    return Robot(
        boards=tuple(replace(row, count=math.ceil(row.count * count / 4)) for row in Robot().boards)
    )


_HALF_WIDTH = Robot().half_width
LIMITS = {
    "force": Limit(
        "greatest force over the object's friction with the ground [1]",
        {"robot_force": Range(10, 1000, log=True)},
        value=lambda drawn: drawn.robot_force / (drawn.friction_ground * drawn.mass * GRAVITY),
        harms=-1,
    ),
    "lag": Limit("lag [s]", {"robot_lag": Range(0, 2)}, harms=1),
    "acceleration": Limit(
        "greatest acceleration [m/s²]", {"robot_acceleration": Range(0.005, 1, log=True)}, harms=-1
    ),
    "half_width": Limit(
        "half width of the base [m]",
        robots={
            half: Robot(half_width=half) for half in (0.15, 0.2, 0.25, _HALF_WIDTH, 0.35, 0.45)
        },
    ),
    "pitch": Limit(
        "pitch of the taxels of the front [mm]",
        robots={1e3 * 2 * _HALF_WIDTH / (3 * n): _with_front(n) for n in (8, 4, 3, 2, 1)},
        harms=1,
    ),
}


@dataclass(frozen=True)
class Limits(PlanStudy[xr.DataTree], MultiLawQuestion[xr.DataTree]):
    """Tell what each limit of a robot costs a law: force, lag, acceleration, size, skin.

    Every robot meets the worlds that the ideal base meets. The answer is a tree: for each limit its
    `value` and the `world` (case), `success` with it and with the ideal base, `usual` (law, case).
    """

    TITLE = "What each limit costs"
    IGNORED_FIELDS = ("limits",)  # later calls may add limits
    QUICK: ClassVar = {"worlds": 64}

    domain: DomainLike = "wide"
    """The worlds: paper, hardware, wide, prisms or hostile, or a JSON file of ranges; changes
    follow, as wide,mass=3:10."""
    limits: tuple[str, ...] = ("force", "lag", "acceleration", "half_width", "pitch")
    """Names of the limits; by default all."""
    worlds: int = option(2000, 1, 10_000_000)
    """Number of worlds that every robot meets."""
    setting: Setting = field(default=Setting(seed=11), kw_only=True)

    def check(self) -> None:
        """Check the names, and that the engine can step these worlds here."""
        errors.check_each_once("limits", self.limits)
        for name in self.limits:
            errors.check_name("limit", name, LIMITS)
        self._plan(parse_domain(self.domain)).check_here()

    def _plan(self, ranges: Domain, robot: Robot | None = None) -> Plan:
        """Return the sweep of a robot."""
        return Plan(parse_domain(ranges, robot), self.worlds, self.chosen, self.setting)

    @cached_property
    def plans(self) -> dict[str, Plan]:
        """Sweep with the ideal base, and the sweeps of each limit: LIMIT, or LIMIT_INDEX."""
        base = parse_domain(self.domain)
        plans = {"ideal": self._plan(base)}
        for name in self.limits:
            limit = LIMITS[name]
            if limit.drawn:
                plans[name] = self._plan(replace(base, **limit.drawn))
            for i, robot in enumerate(limit.robots.values()):
                plans[f"{name}_{i}"] = self._plan(base, robot)
        return plans

    def answer(self, run: Run) -> xr.DataTree:
        """Sweep with the ideal base and with every robot."""
        by_part = run_plans(run, self.plans)
        results, ideal = {}, by_part["ideal"].success.values
        for name in self.limits:
            limit = LIMITS[name]
            keys = [name] if limit.drawn else [f"{name}_{i}" for i in range(len(limit.robots))]
            parts = [by_part[key] for key in keys]
            values = (
                limit.values(parts[0]) if limit.drawn else np.repeat([*limit.robots], self.worlds)
            )
            success = np.concatenate([part.success.values for part in parts], axis=1)
            results[name] = xr.Dataset(
                {
                    "success": (("law", "case"), success),
                    "usual": (("law", "case"), np.tile(ideal, (1, len(parts)))),
                },
                {
                    "law": list(self.chosen),
                    "value": ("case", values, {"long_name": limit.label}),
                    "world": ("case", np.tile(np.arange(self.worlds), len(parts))),
                },
                {"harms": limit.harms, "log": int(limit.log)},
            )
        return xr.DataTree.from_dict(results)

    def intro(self, results: xr.DataTree) -> str:
        """Describe the worlds."""
        return (
            f"{self.worlds:,} worlds, seed {self.setting.seed}, equal for all robots. "
            "Intervals: of rates Wilson 95 %, of limits bootstrap 95 %."
        )

    def report(self, results: xr.DataTree, run: Run) -> Sequence[Section]:
        """Return losses of each law, its success at each size, and the executed turns."""
        by_limit = {name: results[name].to_dataset() for name in self.limits}
        picture = Picture("limits", partial(figure_of, by_limit))
        sections = [Section("Success over each limit", "", losses(by_limit), picture)]
        if len(sizes := successes(by_limit)) > 1:
            sections.append(Section("Success at each size", "", sizes))
        params = next(iter(self.chosen.values()))
        turns = Picture("turning", lambda: turning_figure(turning(TURNING, params)))
        sections.append(Section("What becomes of the law's turns", "", (), turns))
        return sections


limits = call_of(Limits)


def crossing(value: np.ndarray, lost: np.ndarray, level: float, harms: int) -> float:
    """Return the value at which a law has lost `level` [1] of its success, or NaN.

    The losses (n,) of cases, each -1, 0 or 1, at values (n,) are made monotone by least squares:
    rising with the value if `harms` is 1, falling if it is -1. At the harmless end, the base is
    ideal and the loss is zero, with the weight of a twentieth of the cases.
    """
    order = np.argsort(harms * value, kind="stable")
    ideal = np.zeros(value.size // 20)
    fitted = optimize.isotonic_regression(np.concatenate([ideal, lost[order]])).x[ideal.size :]
    over = np.flatnonzero(fitted >= level)
    return float(value[order][over[0]]) if over.size else math.nan


def crossings(results: xr.Dataset, level: float, seed: int = 0) -> dict[str, tuple[float, ...]]:
    """Return `crossing` of each law, and its bootstrap 95 % interval over cases."""
    random, value = np.random.default_rng(seed), results.value.values
    intervals = {}
    for law in map(str, results.law.values):
        lost = results.usual.sel(law=law).values - results.success.sel(law=law).values
        again = []
        for _ in range(_RESAMPLES):
            rows = random.integers(0, value.size, value.size)
            again.append(crossing(value[rows], lost[rows], level, results.harms))
        # In a resample without such a loss, the limit may be beyond the tried values.
        beyond = float(value.max() if results.harms > 0 else value.min())
        interval = np.percentile(np.nan_to_num(again, nan=beyond), [2.5, 97.5])
        intervals[law] = (crossing(value, lost, level, results.harms), *map(float, interval))
    return intervals


def losses(results: Mapping[str, xr.Dataset]) -> Rows:
    """Return a header and a row for each drawn limit and law: its limits for `LOSSES`."""
    rows = [["limit", "law", "ideal base", *(f"{100 * x:g} points lost at" for x in LOSSES)]]
    for name, dataset in results.items():
        at = [crossings(dataset, level) for level in LOSSES] if LIMITS[name].drawn else []
        for law in at[0] if at else ():
            ideal = f"{tables.percent(float(dataset.usual.sel(law=law).mean()))} %"
            limits = [_interval_text(*by_law[law]) for by_law in at]
            rows.append([LIMITS[name].label, law, ideal, *limits])
    return rows


def _interval_text(at: float, low: float, high: float) -> str:
    return "nowhere" if math.isnan(at) else f"{at:.2g} [{low:.2g}, {high:.2g}]"


def successes(results: Mapping[str, xr.Dataset]) -> Rows:
    """Return a header and a row for each size and pitch, with the success of each law."""
    laws = [str(law) for dataset in list(results.values())[:1] for law in dataset.law.values]
    rows = [["quantity", "value", *laws]]
    for name in (name for name in results if LIMITS[name].robots):
        for value in np.unique(results[name].value.values):
            success = results[name].success.values[:, results[name].value.values == value] > 0
            rows.append([LIMITS[name].label, f"{value:.3g}", *map(tables.rate, success)])
    return rows


def turning(robots: Mapping[str, Robot], params: LawParams, seconds: float = 10.0) -> xr.Dataset:
    """Return commanded and executed turning rates of robots in the first seconds of one push.

    Args:
      robots: by name.
      params: of the law.
      seconds: from the start.

    Returns:
      `asked` and `done` (robot, time) [rad/s]: the law's twist, and the base's own.
    """
    rows: list[xr.Dataset] = []
    setting = Setting("fused", rules=Rules(horizon=seconds))
    period = setting.physics.control_period
    for robot in robots.values():
        case = Case("box", "S1", (-2.0, 0.0), params, robot=robot)
        (trace,) = pushes.record_batch(pushes.build([case], setting), setting, interval=period)
        snapshots, time = trace.snapshots, np.asarray(trace.snapshots.time)[:-1]
        turns = np.diff(np.asarray(snapshots.qpos)[:, 2]) / period
        values = {"asked": np.asarray(snapshots.twist.omega)[:-1], "done": turns}
        rows.append(xr.Dataset({k: ("time", v) for k, v in values.items()}, {"time": time}))
    return xr.concat(rows, xr.IndexVariable("robot", list(robots)))


def figure_of(results: Mapping[str, xr.Dataset]) -> Figure:
    """Draw success over each limit of a robot, with 95 % intervals; dashed: the ideal base."""
    figure, axes = tiles(len(results), 3, (4, 3.2), (0, 0), sharey=True)
    for ax, dataset in zip(axes.ravel(), results.values(), strict=False):
        for i, law in enumerate(map(str, dataset.law.values)):
            success = dataset.success.sel(law=law).values > 0
            binned = statistics.bins(dataset.value.values, success, 12)
            success_rates(ax, *binned, curve=i, color=f"C{i}", label=law)
            ideal = 100 * float(dataset.usual.sel(law=law).mean())
            ax.axhline(ideal, color=f"C{i}", lw=0.8, ls="--")
        ax.set_xlabel(dataset.value.attrs["long_name"], fontsize=9)
        ax.set_xscale("log" if dataset.attrs["log"] else "linear")
        ax.grid(alpha=0.3)
    for ax in axes[:, 0]:
        ax.set_ylabel("success [%]")
    axes[0, 0].legend(fontsize=8)
    return figure


def turning_figure(results: xr.Dataset) -> Figure:
    """Draw the turning rate that a law asks for, and what each robot makes of it, over time."""
    names = results.robot.values.tolist()
    figure, axes = tiles(len(names), 1, (8, 1.7), (0, 0), sharex=True, sharey=True)
    for ax, name in zip(axes[:, 0], names, strict=True):
        rates, label = results.sel(robot=name), "asked by the law"
        ax.step(rates.time, rates.asked, color="0.7", lw=1, where="post", label=label)
        ax.plot(rates.time, rates.done, color="C0", lw=1.2, label="of the base")
        ax.set_title(name, fontsize=9, loc="left")
        ax.set_ylabel(r"$\omega$ [rad/s]")
        ax.grid(alpha=0.3)
    axes[-1, 0].set_xlabel("time [s]")
    axes[0, 0].legend(fontsize=8, loc="lower right")
    return figure
