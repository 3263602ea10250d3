"""Success of laws in corridors by width, turn and object, and their errors on paths.

    rps sweeps/corridors --quick

1. In corridors of other worlds, each law gets the lookahead with which it succeeds most often.
2. Each law then pushes through corridors with turns of 0, 45 and 90 degrees, and through a door.
3. On paths without walls, the cross-track error is measured by turn and lookahead.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar, Literal

import numpy as np
import xarray as xr

from rps_jax import Range, Rules, Setting
from rps_jax.analysis import statistics, tables
from rps_jax.analysis.figures.style import Figure, success_rates, tiles
from rps_jax.laws import LawParams, LawsLike
from rps_jax.questions import MultiLawQuestion, Picture, Plan, Run, call_of, option
from rps_jax.world.tasks.corridor import BASE, OBJECT, Corridor
from rps_jax.worlds import DomainLike, parse_domain
from sweeps.corridors.widths import Curve, fit
from sweeps.study_base import Rows, Study, Table, run_together

WIDTHS = Range(1.1, 2.5)  # [m]
LENGTH = Range(10, 10)  # [m], long enough for three corners of the widest corridor
LOOKAHEADS = np.geomspace(0.3, 3, 6)  # [m] edges of the compared intervals
CENTRES = np.sqrt(LOOKAHEADS[:-1] * LOOKAHEADS[1:])  # [m]
LEVELS = (0.9, 0.99)  # [1] of success
TURNS = {"0°": 0.0, "45°": math.pi / 4, "90°": math.pi / 2}  # [rad]
DOOR = "0°, a door"
_DOOR_WIDTH = 0.7  # [1] of the corridor's width
_PATH_TURNS = (0, 30, 60, 90)  # [deg] edges of the classes of a path's turns
KINDS = (
    "base touched",
    "object touched",
    "lost contact",
    "never touched",
    "fell over",
    "out of time",
    "diverged",
)
_BORDERS = 0.1, 0.95  # [1] of the path, before and beyond which a failure is one of its ends
_IN_TIME = 300.0  # [s] default horizon of trials
_WHERE = ("in the first metre [%]", "in the last 0.5 m [%]")


@dataclass(frozen=True)
class Corridors(Study[xr.DataTree], MultiLawQuestion[xr.DataTree]):
    """Measure how wide a corridor each law needs, and how closely it follows a path.

    The answer is a tree of outcomes: `choice` (law, world) of corridors with drawn lookaheads,
    `corridors` (turn, law, world) with the lookahead of each law, and `paths` (law, world).
    """

    TITLE = "Pushing through corridors"
    QUICK: ClassVar = {
        "laws": ("rps", "rps_tuned"),
        "choice": 60,
        "worlds": 48,
        "paths": 60,
    }
    PRESETS: ClassVar = {
        **{"widths": list(WIDTHS), "length": list(LENGTH), "lookaheads": LOOKAHEADS.tolist()},
        **{"turns": list(TURNS.values()), "door": _DOOR_WIDTH},
    }

    laws: LawsLike = (
        "rps",
        "rps_tuned",
        "rps_plus",
        "learned",
        "force_push",
        "dipole",
        "aps",
    )
    domain: DomainLike = "wide"
    """Ranges from which worlds are drawn: paper, hardware, wide, real, prisms or hostile, or a JSON
    file of ranges; changes follow, as wide,mass=3:10."""
    choice: int = option(3000, 6, 10_000_000)
    """Number of corridors in which the lookaheads of the laws are chosen."""
    worlds: int = option(3000, 6, 10_000_000)
    """Number of corridors for each turn; turns have the same objects, widths and sensors."""
    paths: int = option(6000, 6, 10_000_000)
    """Number of paths."""
    setting: Setting = field(
        default=Setting("fused", seed=5207, rules=Rules(horizon=600.0)), kw_only=True
    )

    def check(self) -> None:
        """Check that the engine can step these worlds here."""
        super().check()
        self._plan(self._corridor(math.pi / 4), self.worlds, self.chosen).check_here()

    def num_trials(self) -> int | None:
        """Return the number of trials."""
        rows = len(TURNS) + 1
        return len(self.chosen) * (self.choice + rows * self.worlds + self.paths)

    def answer(self, run: Run) -> xr.DataTree:
        """Choose lookaheads, then run corridors and paths in other worlds."""
        drawn = Range(float(LOOKAHEADS[0]), float(LOOKAHEADS[-1]), log=True)
        any_turn = Range(0, math.pi / 2)
        corridor = replace(self._corridor(), lookahead=drawn, turn_angle=any_turn)
        choosing = self._plan(corridor, self.choice, self.chosen, "tune")
        choice = run.checkpoint("choice", lambda: run_together([choosing], run)[0])
        chosen = best_lookaheads(choice)
        corridors = run.checkpoint("corridors", partial(self._corridors, chosen, run))
        path: Any = {"kind": "path", "lookahead": drawn, "length": LENGTH, "turn_angle": any_turn}
        follow = self._plan(path, self.paths, self.chosen)
        paths = run.checkpoint("paths", lambda: run_together([follow], run)[0])
        parts = {"choice": choice, "corridors": corridors, "paths": paths}
        return xr.DataTree.from_dict(parts)

    def _corridor(self, turn: float = 0.0, door: float = 1.0) -> Corridor:
        """Return corridors with turns of an angle [rad], and a door as a share of the width.

        All corridors have a door, so that they share programs; one of the whole width is none. The
        narrowest place has one of `WIDTHS`.
        """
        angle, opening = Range(turn, turn), Range(door, door)
        width = Range(WIDTHS.low / door, WIDTHS.high / door)
        return Corridor(length=LENGTH, turn_angle=angle, width=width, doors=1, door_width=opening)

    def _plan(
        self,
        task: Any,
        worlds: int,
        laws: Mapping[str, LawParams],
        split: Literal["tune", "test"] = "test",
    ) -> Plan:
        """Return the plan of a task; worlds of one split depend on the seed alone."""
        setting = replace(self.setting, split=split)
        return Plan(parse_domain(self.domain, None, task), worlds, laws, setting)

    def _corridors(self, chosen: Mapping[str, float], run: Run) -> xr.Dataset:
        """Run corridors of all turns, each law with its lookahead."""
        rows = {name: self._corridor(turn) for name, turn in TURNS.items()}
        rows[DOOR] = self._corridor(door=_DOOR_WIDTH)
        plans: list[Plan] = []
        distances = sorted(set(chosen.values()))
        for corridor in rows.values():
            for distance in distances:
                laws = {law: x for law, x in self.chosen.items() if chosen[law] == distance}
                task = replace(corridor, lookahead=Range(distance, distance))
                plans.append(self._plan(task, self.worlds, laws))
        parts = run_together(plans, run)
        count = len(distances)
        by_row = [
            xr.concat(
                [part.drop_vars("lookahead") for part in parts[i * count : (i + 1) * count]], "law"
            ).drop_vars(["turn_angle", "width", "door_width"])
            for i in range(len(rows))
        ]
        together = xr.concat(by_row, xr.IndexVariable("row", list(rows)))
        lookahead = ("law", list(chosen.values()), {"units": "m"})
        together = together.sel(law=list(chosen))
        return together.assign_coords(lookahead=lookahead, width=parts[0].width)  # the narrowest

    def intro(self, results: xr.DataTree) -> str:
        """Describe the worlds."""
        return (
            f"{self.worlds:,} worlds for each turn, seed {self.setting.seed}, the same for all "
            f"laws; corridors of {WIDTHS.low:g} to {WIDTHS.high:g} m and {LENGTH.low:g} m length "
            f"with 1 to 3 turns. Lookaheads are chosen in {self.choice:,} other worlds. "
            "Intervals: Wilson 95 %; of widths and errors bootstrap 95 %. Gains and losses "
            "are those of McNemar's test, world by world; p is not adjusted."
        )

    def report_tables(self, results: xr.DataTree) -> Sequence[Table]:
        """Return widths, failures, lookaheads and errors."""
        choice, corridors, paths = (
            results[name].to_dataset() for name in ("choice", "corridors", "paths")
        )
        curves = fit_all(corridors)
        figure = Picture("corridors", partial(figure_of, corridors, curves))
        return [
            Table(
                width_table(corridors, curves),
                name="corridors_widths",
                merge="turn",
                title="Width that laws need",
                picture=figure,
            ),
            Table(
                object_table(corridors),
                name="corridors_objects",
                merge="turn",
                title="Width that 90 % need, by object",
            ),
            Table(
                failure_table(corridors), name="corridors_failures", merge="turn", title="Failures"
            ),
            Table(
                lookahead_table(choice),
                name="corridors_lookaheads",
                title="Success in corridors by lookahead",
            ),
            Table(
                lookahead_table(paths, _IN_TIME),
                name="corridors_open",
                title="Success on paths within 300 s, by lookahead",
            ),
            Table(
                error_table(paths),
                name="corridors_paths",
                merge="law",
                title="Cross-track error on paths",
            ),
        ]


corridors = call_of(Corridors)


# --- lookaheads ------------------------------------------------------------------------------


def _lookahead_index(results: xr.Dataset) -> np.ndarray:
    """Return the index (world,) of the interval that holds the lookahead of each world."""
    return np.clip(np.searchsorted(LOOKAHEADS, results.lookahead.values) - 1, 0, CENTRES.size - 1)


def _counts(success: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return successes (..., n) of worlds (..., world) and worlds (n,) in n lookahead intervals."""
    one_hot = (index[:, None] == np.arange(CENTRES.size)).astype(int)
    return success @ one_hot, one_hot.sum(axis=0)


def best_lookaheads(choice: xr.Dataset) -> dict[str, float]:
    """Return the lookahead [m] of each law, the middle of its best interval, rounded to 1 cm."""
    successes, worlds = _counts(
        _started(choice).success.values > 0, _lookahead_index(_started(choice))
    )
    best = np.argmax(successes / np.maximum(worlds, 1), axis=1)
    return {
        str(law): round(float(CENTRES[i]), 2)
        for law, i in zip(choice.law.values, best, strict=True)
    }


def lookahead_table(choice: xr.Dataset, horizon: float = math.inf) -> Rows:
    """Return a header and a row per law: its success within a time [s] by lookahead."""
    started = _started(choice)
    in_time = (started.success.values > 0) & (started.time.values <= horizon)
    successes, worlds = _counts(in_time, _lookahead_index(started))
    spans = [f"{a:.2g} to {b:.2g} m" for a, b in itertools.pairwise(LOOKAHEADS)]
    rows = [["law", *spans, "best"]]
    for law, by_lookahead in zip(map(str, choice.law.values), successes, strict=True):
        rates = [tables.share(int(k), int(n)) for k, n in zip(by_lookahead, worlds, strict=True)]
        best = CENTRES[np.argmax(by_lookahead / np.maximum(worlds, 1))]
        rows.append([law, *rates, f"{best:.2g} m"])
    return rows


# --- widths ----------------------------------------------------------------------------------


def _started(results: xr.Dataset) -> xr.Dataset:
    """Return the worlds that do not begin with the object in a wall; all if there are no walls."""
    if "wall_touch" not in results:
        return results
    dims = [dim for dim in results.success.dims if dim != "world"]
    inside = ((results.wall_touch > 0) & (results.time < 0.05)).any(dims)
    return results.isel(world=~inside.values)


def fit_all(results: xr.Dataset) -> dict[tuple[str, str], Curve]:
    """Return the fitted curve of each turn and law."""
    started = _started(results)
    width = started.width.values
    return {
        (str(row), str(law)): fit(
            width, started.success.sel(row=row, law=law).values > 0, WIDTHS.low, WIDTHS.high
        )
        for row in results.row.values
        for law in results.law.values
    }


def width_text(curve: Curve, level: float) -> str:
    """Return the width that a success rate needs, with its interval."""
    at, low, high = (_metres(width) for width in curve.needed(level))
    return at if low == high else f"{at} [{low}, {high}]"


def _metres(width: float) -> str:
    if math.isinf(width):
        return "not within the widths"
    return f"{width:.2f} m" if width > WIDTHS.low else f"at most {width:.2f} m"


def width_table(results: xr.Dataset, curves: Mapping[tuple[str, str], Curve]) -> Rows:
    """Return a header and a row per turn and law: success by width, and the widths it needs."""
    started = _started(results)
    edges = np.linspace(WIDTHS.low, WIDTHS.high, 4)
    width = started.width.values
    masks = [(width >= a) & (width <= b) for a, b in itertools.pairwise(edges)]
    spans = [f"{a:.2g} to {b:.2g} m" for a, b in itertools.pairwise(edges)]
    base = "rps_tuned" if "rps_tuned" in results.law else str(results.law.values[0])
    needs = [f"{100 * x:g} % need" for x in LEVELS]
    rows = [["turn", "law", "lookahead", *spans, *needs, f"against {base}"]]
    for row, law in curves:
        outcomes = started.sel(row=row, law=law)
        success = outcomes.success.values > 0
        rates = [tables.rate(success[mask]) for mask in masks]
        needed = [width_text(curves[row, law], level) for level in LEVELS]
        compared = statistics.compare(started.success.sel(row=row, law=base), outcomes.success)
        against = f"{compared.changes}, p = {compared.p:.2g}" if law != base else ""
        rows.append([row, law, f"{float(outcomes.lookahead):g} m", *rates, *needed, against])
    return rows


def object_table(results: xr.Dataset) -> Rows:
    """Return a header and a row per turn and law: the width that 90 % need, by object."""
    started = _started(results)
    objects = list(dict.fromkeys(map(str, started.object.values)))
    rows = [["turn", "law", *objects]]
    for row in map(str, results.row.values):
        for law in map(str, results.law.values):
            cells = []
            for name in objects:
                part = started.isel(world=started.object.values == name).sel(row=row, law=law)
                curve = fit(part.width.values, part.success.values > 0, WIDTHS.low, WIDTHS.high)
                cells.append(width_text(curve, LEVELS[0]))
            rows.append([row, law, *cells])
    return rows


def failure_kinds(results: xr.Dataset, rules: Rules = Rules(horizon=600.0)) -> np.ndarray:
    """Return indices (...) into `KINDS` of trials, -1 for a success."""
    conditions = {
        "diverged": results.diverged > 0,
        "base touched": results.wall_touch == BASE,
        "object touched": results.wall_touch == OBJECT,
        "fell over": results.tipped > 0,
        "never touched": ~np.isfinite(results.min_distance),
        "lost contact": results.contact_lost_time > float(rules.max_lost),
    }
    masks = [results.success.values > 0, *(mask.values for mask in conditions.values())]
    return np.select(masks, [-1, *map(KINDS.index, conditions)], KINDS.index("out of time"))


def failure_table(results: xr.Dataset) -> Rows:
    """Return a header and a row per turn and law: failures, and their shares by kind."""
    started = _started(results)
    rows = [["turn", "law", "failures", *(f"{kind} [%]" for kind in KINDS), *_WHERE]]
    for row in map(str, results.row.values):
        for law in map(str, results.law.values):
            trials = started.sel(row=row, law=law)
            kinds = failure_kinds(trials)
            failed = kinds >= 0
            shares = [
                100 * np.mean(kinds[failed] == i) if failed.any() else 0.0
                for i in range(len(KINDS))
            ]
            progress = trials.progress.values[failed]
            first, last = _BORDERS
            where = [100 * np.mean(m) for m in (progress < first, progress > last) if m.size]
            cells = [f"{x:.0f}" for x in (*shares, *(where or (0, 0)))]
            rows.append([row, law, f"{failed.sum():,}", *cells])
    return rows


# --- paths -----------------------------------------------------------------------------------


def error_table(results: xr.Dataset, resamples: int = 200, seed: int = 0) -> Rows:
    """Return a header and a row per law and class of turns: errors [cm] by lookahead.

    An error is the median over worlds of the 95 % quantile over time of the cross-track error, with
    its bootstrap 95 % interval. Trials that fail count, too. The last columns are the lookahead of
    the least error, and the success with it.
    """
    random = np.random.default_rng(seed)
    index, turn = _lookahead_index(results), np.degrees(results.turn_angle.values)
    rows = [["law", "turns", *(f"{x:.2g} m" for x in CENTRES), "best", "success at the best"]]
    for law in map(str, results.law.values):
        trials = results.sel(law=law)
        error, success = 100 * trials.error_95.values, trials.success.values > 0
        for low, high in itertools.pairwise(_PATH_TURNS):
            cells: list[str] = []
            medians: list[float] = []
            rates: list[str] = []
            for i in range(CENTRES.size):
                mask = (index == i) & (turn >= low) & (turn < high)
                values = error[mask & np.isfinite(error)]
                rates.append(tables.rate(success[mask]))
                if not values.size:
                    cells.append("-")
                    medians.append(math.inf)
                    continue
                again = np.median(random.choice(values, (resamples, values.size)), axis=1)
                medians.append(float(np.median(values)))
                a, b = np.quantile(again, [0.025, 0.975])
                cells.append(f"{medians[-1]:.1f} [{a:.1f}, {b:.1f}]")
            best = int(np.argmin(medians))
            rows.append([law, f"{low} to {high}°", *cells, f"{CENTRES[best]:.2g} m", rates[best]])
    return rows


# --- figure ----------------------------------------------------------------------------------


def figure_of(results: xr.Dataset, curves: Mapping[tuple[str, str], Curve]) -> Figure:
    """Draw success against width by law for each turn: bins with 95 % intervals, and the fits."""
    started = _started(results)
    names = results.row.values.tolist()
    figure, axes = tiles(len(names), 2, (5, 3.6), (0, 0.4), sharex=True, sharey=True)
    edges = np.linspace(WIDTHS.low, WIDTHS.high, 8)
    middle = (edges[:-1] + edges[1:]) / 2
    index = np.clip(np.searchsorted(edges, started.width.values) - 1, 0, middle.size - 1)
    fine = np.linspace(WIDTHS.low, WIDTHS.high, 200)
    one_hot = (index[:, None] == np.arange(middle.size)).astype(int)
    for ax, row in zip(axes.ravel(), names, strict=False):
        for i, law in enumerate(map(str, results.law.values)):
            successes = (started.success.sel(row=row, law=law).values > 0) @ one_hot
            trials, colour = one_hot.sum(axis=0), f"C{i}"
            line = "-" if i < 7 else "--"  # there are seven colours
            success_rates(
                ax, middle, successes, trials, curve=i, color=colour, ls="none", label=law
            )
            ax.plot(fine, 100 * curves[row, law].rates(fine), color=colour, ls=line, lw=1)
        ax.set_title(row, fontsize=9, loc="left")
        ax.grid(alpha=0.3)
    for ax in axes[-1]:
        ax.set_xlabel("narrowest width [m]")
    for ax in axes[:, 0]:
        ax.set_ylabel("success [%]")
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=7, fontsize=8
    )
    return figure
