"""Is a fitted posterior honest, and what is it worth? Logs whose truth is known.

    rps sweeps/fit

fits logs of worlds of the domain that were not learned from, once for each of several kinds of log,
and counts how often the 90 % interval of a quantity holds the truth. All logs are judged by one
bank of simulated worlds. Then it predicts, from the whole domain and from the fitted one, how often
and how fast two laws succeed in some of these worlds, whose truth is tried.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import xarray as xr

import rps_jax
from rps_jax.analysis.figures.style import Figure
from rps_jax.analysis.report import Picture, Section, save
from rps_jax.control import registry
from rps_jax.control.registry import LawLike
from rps_jax.record.options import option
from rps_jax.runs.question import DomainQuestion, LawQuestion, Run, call_of, seed_of
from rps_jax.trials.progress import Progress, no_progress, set_phase
from rps_jax.tuning import fit, posterior
from rps_jax.world import domain as domains
from rps_jax.world import draws, points
from sweeps.study_base import Study, Table

KINDS: dict[str, tuple[str, ...]] = {  # of logs: what they have beside touch, odometry and commands
    "touch": (),
    "touch, taxels": ("signal",),
    "touch, object": ("object_pose",),
    "touch, force": ("f_robot",),
    "everything": ("signal", "object_pose", "f_robot"),
}
FOUR = "touch, four logs"  # of one world, to four targets
_LAWS = ("rps", "rps_plus")
_TASK = (*domains.quantities_of("task"), "key_0", "key_1")


@dataclass(frozen=True)
class Coverage(Study[xr.Dataset], DomainQuestion[xr.Dataset], LawQuestion[xr.Dataset]):
    """Count how often the intervals of fitted worlds hold the truth, and what fitting is worth."""

    TITLE: ClassVar[str] = "Worlds fitted to logs"
    QUICK: ClassVar[Mapping[str, Any]] = {
        "worlds": 960, "logs": 48, "window": 20.0, "worth": 2, "tasks": 8,
    }  # fmt: skip

    domain: domains.DomainLike = (
        "wide,robot_lag=0:0.4,robot_slip=0:0.1,foam=0.005:0.02,time_constant=0.02:0.15"
    )
    """Ranges from which worlds are drawn, by name or as a JSON file; changes follow."""
    law: LawLike = "rps"
    worlds: int = option(8064, 192, 1_000_000, kw_only=True)
    """Number of worlds that are learned from."""
    logs: int = option(240, 24, 10_000, kw_only=True)
    """Number of worlds whose logs are fitted."""
    window: float = option(30.0, 5, 300, unit="s", kw_only=True)
    """Length of a log [s]."""
    worth: int = option(16, 0, 1000, kw_only=True)
    """Number of worlds in which success and time are predicted."""
    tasks: int = option(32, 8, 1000, kw_only=True)
    """Number of pushes behind each of these."""
    setting: rps_jax.Setting = field(default=rps_jax.Setting("fused"), kw_only=True)

    @cached_property
    def bank(self) -> fit.Bank:
        """Simulated worlds, with a row of the log in each control step."""
        law, period = registry.law_of(self.params), self.setting.physics.control_period
        return fit.Bank(self.ranges, law, self.params, self.setting, self.window, period)

    @cached_property
    def _networks(self) -> dict[tuple[str, ...], posterior.Posterior]:
        """Trained networks, by the statistics that they see."""
        return {}

    def check(self) -> None:
        """Check the law and the engine."""
        self.check_engine([self.params])
        fit.check_law(self.label, registry.law_of(self.params), self.setting)

    def num_trials(self) -> int | None:
        """How many logs are simulated."""
        return self.worlds + 5 * self.logs

    def answer(self, run: Run) -> xr.Dataset:
        """Learn once for each kind of log, and fit the logs."""
        learned = self.bank.worlds(self.worlds, run)
        held = self.bank.worlds(self.logs, run._replace(callback=no_progress), "test")
        found = [
            run.checkpoint(f"fit-{i}", partial(self._fitted, kind, learned, held, run))
            for i, kind in enumerate((*KINDS, FOUR))
        ]
        whole = xr.concat(found, "kind").assign_coords(kind=[*KINDS, FOUR])
        worth = run.checkpoint("worth", partial(self._worth, learned, held, run))
        whole = xr.merge([whole, worth])
        return whole

    def _learned(self, kind: str, learned: xr.Dataset, run: Run) -> tuple[Any, list[str]]:
        names = fit.statistic_names(learned, KINDS.get(kind, ()))
        if tuple(names) not in self._networks:
            set_phase(run.callback, f"learn from {kind}")
            one = learned.sel(statistic=names)
            made = posterior.train(one.u.values, one.statistics.values, self.setting.seed)
            self._networks[tuple(names)] = made
        return self._networks[tuple(names)], names

    def _fitted(self, kind: str, learned: xr.Dataset, held: xr.Dataset, run: Run) -> xr.Dataset:
        """Of each log and quantity: the rank of the truth, the width, and whether it is told."""
        networks, names = self._learned(kind, learned, run)
        x = held.sel(statistic=names).statistics.values[:, :1]
        if kind == FOUR:
            x = np.concatenate([x, self._again(names, run)], 1)
        found = []
        for log in range(self.logs):
            found.append(judged(self.ranges, networks, x[log], held, log))
            run.callback(Progress(self.worlds, 0.0))
        return xr.concat(found, "log").drop_vars("unit")

    def _again(self, names: list[str], run: Run) -> np.ndarray:
        """Statistics (log, 3, F) of three more pushes in each world that is held out."""

        def make() -> xr.Dataset:
            index, seed = np.arange(self.logs), seed_of(self.setting.seed, "test")
            which, found = self.ranges.object_of(index), np.empty((self.logs, 3, len(names)))
            fresh = [draws.USES[name] for name in _TASK]
            for more in range(3):
                for thing in np.unique(which):
                    rows = index[which == thing]
                    numbers = draws.random_numbers(seed, rows)
                    other = draws.random_numbers(seed, rows + (more + 1) * 1_000_000)
                    numbers[:, fresh] = other[:, fresh]
                    seen, _ = self.bank.statistics(draws.draw_at(self.ranges, rows, numbers))
                    found[rows, more] = fit.matrix(seen, names)
            return xr.Dataset({"statistics": (("log", "more", "statistic"), found)})

        return run.checkpoint("again", make).statistics.values

    # --- what it is worth ---

    def _worth(self, learned: xr.Dataset, held: xr.Dataset, run: Run) -> xr.Dataset:
        """Success and mean time in worlds: true, predicted from the domain, and from the fit."""
        if not self.worth:
            return xr.Dataset()
        networks, names = self._learned("touch, object", learned, run)
        x = held.sel(statistic=names).statistics.values[:, :1]
        every = points.names(self.ranges)
        task = [every.index(name) for name in _TASK if name in every]
        index, seed = np.arange(self.worth), seed_of(self.setting.seed, "test")
        at = points.points_of(self.ranges, index, seed)
        free = np.random.default_rng(self.setting.seed).random((self.tasks, len(task)))
        asked = {"setting": self.setting, "progress": False, "slots": 8}
        set_phase(run.callback, "predict")

        def of(found: xr.Dataset) -> np.ndarray:
            """Success and mean time of the successes (law, 2) [1, s]."""
            won = found.success.astype(bool)
            return np.stack([won.mean("world"), found.time.where(won).mean("world")], -1)

        usual = of(rps_jax.sweep(_LAWS, self.ranges, 4 * self.tasks, **asked))
        found = []
        for world in index:
            u = np.repeat(at[world : world + 1], self.tasks, 0)
            u[:, task] = free
            told = fit.summary(
                self.ranges, posterior.sample(networks, x[world], fit.SAMPLES, int(world))
            )
            fitted = fit.fitted_domain(self.ranges, told)
            found.append(
                [
                    of(rps_jax.sweep(_LAWS, self.ranges, points=u, **asked)),
                    usual,
                    of(rps_jax.sweep(_LAWS, fitted, self.tasks, **asked)),
                ]
            )
            run.callback(Progress(self.worlds + int(world), 0.0))
        names_ = {"source": ["truth", "domain", "fit"], "law": list(_LAWS)}
        shape = ("world", "source", "law")
        values = np.array(found)
        return xr.Dataset({"won": (shape, values[..., 0]), "duration": (shape, values[..., 1])},
                          names_)  # fmt: skip

    # --- how it is told ---

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return all tables."""
        return {f"fit_{name}": Table(rows) for name, rows in tables(results).items()}

    def publish(self, results: xr.Dataset, run_folder: Path) -> None:
        """Write the data files and the figure."""
        super().publish(results, run_folder)
        save(figure(results), self.folder / "coverage.png")

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Coverage by kind of log, by quantity, and what fitting is worth."""
        told = tables(results)
        return [
            Section(
                "Coverage", "", told["coverage"], Picture("coverage", partial(figure, results))
            ),
            Section("By quantity", "Coverage, and share of logs that tell it.", told["quantities"]),
            Section("Worth", "Mean error of the prediction.", told["worth"]),
        ]


coverage = call_of(Coverage)


def judged(
    ranges: domains.Domain, networks: posterior.Posterior, x: np.ndarray, held: xr.Dataset, log: int
) -> xr.Dataset:
    """What is fitted to statistics (N, F) of one of the worlds held, beside its truth."""
    told = fit.summary(ranges, posterior.sample(networks, x, fit.SAMPLES, log))
    truth = fit.values_of(ranges, held.u.values[log : log + 1])
    own = np.array([truth[str(name)][0] for name in told.quantity.values])
    right = told.probability.isel(object=ranges.object_of(np.array(log)))
    return xr.Dataset(
        {
            "truth": ("quantity", own),
            "rank": ("quantity", (told["sample"].values < own).mean(0)),
            "shrinkage": told.shrinkage, "undetermined": told.undetermined,
            "low": told.low, "high": told.high,
            "object_told": right.drop_vars("object"),
        }
    )  # fmt: skip


def tables(found: xr.Dataset) -> dict[str, list[list[str]]]:
    """Header and rows of each table of the page."""
    first = ["log", "90 % intervals hold the truth", "those of told quantities",
             "least, greatest of a quantity", "told", "right object's probability"]  # fmt: skip
    worth = ["law", "success, from the domain", "success, from the fit", "time, from the domain",
             "time, from the fit"]  # fmt: skip
    return {
        "coverage": [first, *coverage_rows(found)],
        "quantities": [["quantity", *map(str, found.kind.values)], *quantity_rows(found)],
        "worth": [worth, *worth_rows(found)],
    }


def within(one: xr.Dataset) -> xr.DataArray:
    """Whether the truth is within the 5 and 95 % quantiles."""
    return (one["rank"] >= 0.05) & (one["rank"] <= 0.95)


def coverage_rows(found: xr.Dataset) -> list[list[str]]:
    """One row for each kind of log."""
    rows = []
    for kind in map(str, found.kind.values):
        one = found.sel(kind=kind)
        holds, told = within(one), one.undetermined == 0
        each = holds.mean("log")
        shares = (holds.mean(), holds.where(told).mean(), each.min(), each.max())
        cells = [f"{100 * float(share):.1f} %" for share in shares]
        right = f"{float(one.object_told.mean()):.2f}"
        told_ = f"{100 * float(told.mean()):.0f} %"
        rows.append([kind, *cells[:2], ", ".join(cells[2:]), told_, right])
    return rows


def quantity_rows(found: xr.Dataset) -> list[list[str]]:
    """One row for each quantity: coverage and share of logs that tell it, by kind of log."""
    rows = []
    for name in map(str, found.quantity.values):
        one = found.sel(quantity=name)
        holds, told = within(one).mean("log"), (one.undetermined == 0).mean("log")
        cells = [f"{100 * float(h):.0f} %, {100 * float(t):.0f} %"
                 for h, t in zip(holds, told, strict=True)]  # fmt: skip
        rows.append([fit.words(name), *cells])
    return rows


def worth_rows(found: xr.Dataset) -> list[list[str]]:
    """One row for each law: mean absolute error of the predictions."""
    if "won" not in found:
        return []
    off = abs(found.drop_sel(source="truth") - found.sel(source="truth")).mean("world")
    return [
        [str(law), *(f"{100 * float(v):.1f} points" for v in off.won.sel(law=law)),
         *(f"{float(v):.1f} s" for v in off.duration.sel(law=law))]
        for law in found.law.values
    ]  # fmt: skip


def figure(found: xr.Dataset) -> Figure:
    """Draw coverage against the interval's level, and how much narrower each quantity becomes."""
    drawn = Figure(figsize=(11, 5.2), layout="constrained", dpi=100)
    left, right = drawn.subplots(1, 2, width_ratios=(1, 1.7))
    level = np.linspace(0, 1, 41)
    off = 2 * np.abs(found["rank"].values - 0.5)  # (kind, log, quantity)
    left.fill_between(100 * level, 100 * level - 5, 100 * level + 5, color="0.9")
    for i, kind in enumerate(map(str, found.kind.values)):
        share = [(off[i] <= one).mean() for one in level]
        left.plot(100 * level, 100 * np.array(share), label=kind, lw=1.3)
    left.set(xlabel="level of the interval [%]", ylabel="it holds the truth [%]", title="Honest")
    left.legend(fontsize=8)
    names = list(map(str, found.quantity.values))
    shrink = found.shrinkage.mean("log").values
    for i, kind in enumerate(map(str, found.kind.values)):
        right.plot(100 * shrink[i], np.arange(len(names)) + 0.1 * (i - 2.5), "o", ms=4, label=kind)
    right.axvline(100 * (1 - fit.UNDETERMINED), color="0.6", lw=1, ls=":")
    right.set_yticks(range(len(names)), [fit.words(name) for name in names], fontsize=8)
    right.set(xlabel="how much narrower than the prior's [%], mean over logs",
              title="What logs tell")  # fmt: skip
    right.grid(axis="y", alpha=0.3)
    right.invert_yaxis()
    return drawn
