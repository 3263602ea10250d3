"""Measure the coverage of fitted posteriors, and the value of a fit for predictions.

    rps sweeps/fit

fits logs of test worlds of the domain, once for each kind of log, and counts how often the 90 %
interval of a quantity contains the true value. One bank of simulated worlds serves all logs. Then
it predicts success rate and time of two laws in some test worlds, from the whole domain and from
the fitted domain, and compares both with trials in the true worlds.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np
import xarray as xr

import rps_jax
from rps_jax.analysis.figures.style import Figure, quantity
from rps_jax.control.registry import LawLike
from rps_jax.laws import law_of
from rps_jax.questions import LawQuestion, Picture, Run, call_of, option
from rps_jax.runs.question import DomainQuestion
from rps_jax.trials.progress import Progress, no_progress, set_phase
from rps_jax.tuning import fit, posterior
from rps_jax.world import domain as domains
from rps_jax.world import draws, points
from rps_jax.worlds import DomainLike
from sweeps.study_base import Rows, Study, Table

KINDS: dict[str, tuple[str, ...]] = {  # optional fields of each kind of log
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
class FitStudy(Study[xr.Dataset], DomainQuestion[xr.Dataset], LawQuestion[xr.Dataset]):
    """Base class of studies that fit logs of test worlds, whose true values are known."""

    ROW: ClassVar = 1  # control steps of a row of a log

    worlds: int = option(8064, 192, 1_000_000, kw_only=True)
    """Number of worlds for training."""
    logs: int = option(240, 24, 10_000, kw_only=True)
    """Number of worlds whose logs are fitted."""
    window: float = option(30.0, 5, 300, unit="s", kw_only=True)
    """Length of a log [s]."""
    setting: rps_jax.Setting = field(default=rps_jax.Setting("fused"), kw_only=True)

    @cached_property
    def bank(self) -> fit.Bank:
        """Simulated worlds."""
        interval = self.ROW * self.setting.physics.control_period
        return fit.Bank(self.ranges, self.params, self.setting, self.window, interval)

    @property
    def test_seed(self) -> int:
        """Seed of the test worlds."""
        return replace(self.setting, split="test").world_seed

    def check(self) -> None:
        """Check the law and the engine."""
        self.check_engine([self.params])
        fit.check_law(self.label, law_of(self.params), self.setting)

    def train(self, training: xr.Dataset, names: Sequence[str]) -> Any:
        """Return networks for some statistics of the logs."""
        bank = training.sel(statistic=names)
        return posterior.train(bank.u.values, bank.statistics.values, self.setting.seed)

    def compare(self, networks: Any, statistics: np.ndarray, test: xr.Dataset) -> xr.Dataset:
        """Return the fits to statistics (log, N, F) of the test worlds, with the true values."""
        samples = (
            posterior.sample(networks, x, fit.SAMPLES, log) for log, x in enumerate(statistics)
        )
        return self.compare_samples(samples, test.u.values)

    def compare_samples(
        self, samples: Iterable[np.ndarray], u: np.ndarray, index: np.ndarray | None = None
    ) -> xr.Dataset:
        """Return the summaries of samples (n, q) of each test world, with the true values.

        The test worlds have the points `u` (log, q) and an index (log,), by default 0, 1, ...
        """
        fits, index = list[xr.Dataset](), np.arange(len(u)) if index is None else index
        for points_, true_u, log in zip(samples, u, index, strict=True):
            fitted = fit.summary(self.ranges, points_)
            values = fit.values_of(self.ranges, true_u[None])
            truth = np.array([values[str(name)][0] for name in fitted.quantity.values])
            probability = fitted.probability.isel(object=self.ranges.object_of(log))
            columns = {
                "truth": ("quantity", truth),
                "rank": ("quantity", (fitted["sample"].values < truth).mean(0)),
                **fitted[["shrinkage", "undetermined", "low", "median", "high"]],
                **fitted[["prior_low", "prior_high"]],
                "object_told": probability.drop_vars("object"),
            }
            fits.append(xr.Dataset(columns))
        return xr.concat(fits, "log").drop_vars("unit")


@dataclass(frozen=True)
class Coverage(FitStudy):
    """Measure the coverage of fitted intervals, and the value of a fit for predictions."""

    TITLE = "Worlds fitted to logs"
    QUICK: ClassVar = {
        "worlds": 960,
        "logs": 48,
        "window": 20.0,
        "worth": 2,
        "tasks": 8,
    }

    domain: DomainLike = (
        "wide,robot_lag=0:0.4,robot_slip=0:0.1,foam=0.005:0.02,time_constant=0.02:0.15"
    )
    """Ranges from which worlds are drawn, by name or as a JSON file; changes follow."""
    law: LawLike = "rps"
    worth: int = option(16, 1, 1000, kw_only=True)
    """Number of worlds in which success and time are predicted."""
    tasks: int = option(32, 8, 1000, kw_only=True)
    """Number of pushes in each of these worlds."""

    @cached_property
    def _networks(self) -> dict[tuple[str, ...], Any]:
        """Trained networks, by the names of their statistics."""
        return {}

    def num_trials(self) -> int | None:
        """Number of simulated logs."""
        return self.worlds + 5 * self.logs

    def answer(self, run: Run) -> xr.Dataset:
        """Train once for each kind of log, and fit the logs."""
        training = self.bank.worlds(self.worlds, run)
        test = self.bank.worlds(self.logs, run._replace(callback=no_progress), "test")
        fits = [
            run.checkpoint(f"fit-{i}", partial(self._fit_logs, kind, training, test, run))
            for i, kind in enumerate((*KINDS, FOUR))
        ]
        coverage = xr.concat(fits, "kind").assign_coords(kind=[*KINDS, FOUR])
        worth = run.checkpoint("worth", partial(self._predict, training, test, run))
        return xr.merge([coverage, worth])

    def _train(self, kind: str, training: xr.Dataset, run: Run) -> tuple[Any, list[str]]:
        """Return networks for a kind of log, and the names of their statistics."""
        names = fit.statistic_names(training, KINDS.get(kind, ()))
        if tuple(names) not in self._networks:
            set_phase(run.callback, f"learn from {kind}")
            self._networks[tuple(names)] = self.train(training, names)
        return self._networks[tuple(names)], names

    def _fit_logs(self, kind: str, training: xr.Dataset, test: xr.Dataset, run: Run) -> xr.Dataset:
        """Return rank of the truth, width and determination of each log and quantity."""
        networks, names = self._train(kind, training, run)
        x = test.sel(statistic=names).statistics.values[:, :1]
        if kind == FOUR:
            x = np.concatenate([x, self._more_pushes(names, run)], 1)
        run.callback(Progress(self.worlds, 0.0))
        return self.compare(networks, x, test)

    def _more_pushes(self, names: list[str], run: Run) -> np.ndarray:
        """Return statistics (log, 3, F) of three more pushes in each test world."""

        def compute() -> xr.Dataset:
            index, seed = np.arange(self.logs), self.test_seed
            objects, values = self.ranges.object_of(index), np.empty((self.logs, 3, len(names)))
            for push in range(3):
                for i in np.unique(objects):
                    rows = index[objects == i]
                    new = draws.numbers(seed, rows + (push + 1) * 1_000_000)
                    u = draws.numbers(seed, rows) | {name: new[name] for name in _TASK}
                    draw = draws.draw_at(self.ranges, rows, u)
                    values[rows, push] = self.bank.statistics(draw)[0][names]
            return xr.Dataset({"statistics": (("log", "more", "statistic"), values)})

        return run.checkpoint("again", compute).statistics.values

    # --- predictions ---

    def _predict(self, training: xr.Dataset, test: xr.Dataset, run: Run) -> xr.Dataset:
        """Return success rate and mean time: true, predicted from the domain, and from the fit."""
        networks, names = self._train("touch, object", training, run)
        x = test.sel(statistic=names).statistics.values[:, :1]
        columns = points.names(self.ranges)
        task = [columns.index(name) for name in _TASK if name in columns]
        index, seed = np.arange(self.worth), self.test_seed
        cube = points.points_of(self.ranges, index, seed)
        free = np.random.default_rng(self.setting.seed).random((self.tasks, len(task)))
        options = {"setting": self.setting, "progress": False, "slots": 8}
        set_phase(run.callback, "predict")

        def summarise(trials: xr.Dataset) -> np.ndarray:
            """Return success rate and mean time of the successes (law, 2) [1, s]."""
            success = trials.success.astype(bool)
            return np.stack([success.mean("world"), trials.time.where(success).mean("world")], -1)

        prior = summarise(rps_jax.sweep(_LAWS, self.ranges, 4 * self.tasks, **options))
        predictions = []
        for world in index:
            u = np.repeat(cube[world : world + 1], self.tasks, 0)
            u[:, task] = free
            samples = posterior.sample(networks, x[world], fit.SAMPLES, int(world))
            fitted = fit.fitted_domain(self.ranges, fit.summary(self.ranges, samples))
            truth = summarise(rps_jax.sweep(_LAWS, self.ranges, points=u, **options))
            prediction = summarise(rps_jax.sweep(_LAWS, fitted, self.tasks, **options))
            predictions.append([truth, prior, prediction])
            run.callback(Progress(self.worlds + int(world), 0.0))
        labels = {"source": ["truth", "domain", "fit"], "law": list(_LAWS)}
        shape = ("world", "source", "law")
        values = np.array(predictions)
        return xr.Dataset(
            {"won": (shape, values[..., 0]), "duration": (shape, values[..., 1])}, labels
        )

    # --- report ---

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return coverage by kind of log and by quantity, and the errors of predictions."""
        picture = Picture("coverage", partial(figure, results))
        text = "Coverage, and share of logs that determine it."
        error = "Mean error of the prediction."
        return [
            Table(coverage_rows(results), name="fit_coverage", title="Coverage", picture=picture),
            Table(quantity_rows(results), name="fit_quantities", title="By quantity", text=text),
            Table(worth_rows(results), name="fit_worth", title="Worth", text=error),
        ]


coverage = call_of(Coverage)


def within(fits: xr.Dataset) -> xr.DataArray:
    """Whether the truth is within the 5 and 95 % quantiles."""
    return (fits["rank"] >= 0.05) & (fits["rank"] <= 0.95)


def coverage_rows(results: xr.Dataset) -> Rows:
    """Return a header and one row for each kind of log."""
    rows = [
        [
            "log",
            "90 % intervals hold the truth",
            "those of told quantities",
            "least, greatest of a quantity",
            "told",
            "right object's probability",
        ]
    ]
    for kind in map(str, results.kind.values):
        fits = results.sel(kind=kind)
        covered, determined = within(fits), fits.undetermined == 0
        coverage = covered.mean("log")
        shares = (covered.mean(), covered.where(determined).mean(), coverage.min(), coverage.max())
        cells = [f"{100 * float(share):.1f} %" for share in shares]
        probability = f"{float(fits.object_told.mean()):.2f}"
        share = f"{100 * float(determined.mean()):.0f} %"
        rows.append([kind, *cells[:2], ", ".join(cells[2:]), share, probability])
    return rows


def quantity_rows(results: xr.Dataset) -> Rows:
    """Return a header and one row for each quantity.

    A cell has the coverage and the share of determined logs of a kind of log.
    """
    rows = [["quantity", *map(str, results.kind.values)]]
    for name in map(str, results.quantity.values):
        fits = results.sel(quantity=name)
        covered, determined = within(fits).mean("log"), (fits.undetermined == 0).mean("log")
        pairs = zip(covered, determined, strict=True)
        cells = [f"{100 * float(c):.0f} %, {100 * float(d):.0f} %" for c, d in pairs]
        rows.append([quantity(name), *cells])
    return rows


def worth_rows(results: xr.Dataset) -> Rows:
    """Return a header and one row for each law: mean absolute error of the predictions."""
    rows = [
        [
            "law",
            "success, from the domain",
            "success, from the fit",
            "time, from the domain",
            "time, from the fit",
        ]
    ]
    truth = results.sel(source="truth")
    error = abs(results.drop_sel(source="truth") - truth).mean("world")
    for law in results.law.values:
        success = [f"{100 * float(v):.1f} points" for v in error.won.sel(law=law)]
        time = [f"{float(v):.1f} s" for v in error.duration.sel(law=law)]
        rows.append([str(law), *success, *time])
    return rows


def figure(results: xr.Dataset) -> Figure:
    """Draw coverage against the level of the interval, and the narrowing of each quantity."""
    drawn = Figure(figsize=(11, 5.2), layout="constrained", dpi=100)
    left, right = drawn.subplots(1, 2, width_ratios=(1, 1.7))
    level = np.linspace(0, 1, 41)
    distance = 2 * np.abs(results["rank"].values - 0.5)  # (kind, log, quantity)
    left.fill_between(100 * level, 100 * level - 5, 100 * level + 5, color="0.9")
    for i, kind in enumerate(map(str, results.kind.values)):
        share = [(distance[i] <= bound).mean() for bound in level]
        left.plot(100 * level, 100 * np.array(share), label=kind, lw=1.3)
    left.set(xlabel="level of the interval [%]", ylabel="it holds the truth [%]", title="Honest")
    left.legend(fontsize=8)
    names = results.quantity.values.tolist()
    shrink = results.shrinkage.mean("log").values
    for i, kind in enumerate(map(str, results.kind.values)):
        right.plot(100 * shrink[i], np.arange(len(names)) + 0.1 * (i - 2.5), "o", ms=4, label=kind)
    right.axvline(100 * (1 - fit.UNDETERMINED), color="0.6", lw=1, ls=":")
    right.set_yticks(range(len(names)), [quantity(name) for name in names], fontsize=8)
    right.set(
        xlabel="how much narrower than the prior's [%], mean over logs", title="What logs tell"
    )
    right.grid(axis="y", alpha=0.3)
    right.invert_yaxis()
    return drawn
