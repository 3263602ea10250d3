"""Compare three methods of fitting worlds to logs of test worlds, whose true values are known.

    rps sweeps/fit/methods.py

fits the same logs by networks that learn from simulated worlds, by least squares on replayed
windows, and by CMA-ES of the same cost, and compares errors, the coverage of 90 % intervals, time
and simulated trials.
"""

from __future__ import annotations

import functools
import itertools
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, ClassVar

import cmaes
import jax
import numpy as np
import xarray as xr

from rps_jax.analysis.figures.style import quantity
from rps_jax.questions import Run, call_of, option
from rps_jax.trials.progress import no_progress, set_phase
from rps_jax.tuning import fit, posterior
from rps_jax.world import points
from rps_jax.worlds import DomainLike
from sweeps.fit import least_squares
from sweeps.fit.least_squares import Replay, Track
from sweeps.fit.study import FitStudy, within
from sweeps.study_base import Rows, Table, use_processors

KINDS = {"touch, object": ("object_pose",), "touch, object, force": ("object_pose", "f_robot")}
METHODS = ("neural", "gradient", "evolution")
_PART = 25  # logs that one process fits
_POPULATION, _GENERATIONS = 24, 64  # of CMA-ES: about as many seconds as the derivatives
_SPREAD = 0.2  # standard deviation of its first generation, in units of the cube
_QUANTITIES = (
    "friction_robot",
    "friction_ground",
    "mass",
    "ground_force",
    "size",
    "aspect",
    "height",
    "com_offset",
    "pose_latency",
)


@dataclass(frozen=True)
class Methods(FitStudy):
    """Compare methods of fitting worlds to logs, in worlds whose true values are known."""

    TITLE = "Methods of fitting worlds to logs"
    GROWS = ("evolution_logs",)
    ROW: ClassVar = 2
    QUICK: ClassVar = {"worlds": 192, "logs": 2, "window": 12.0}

    domain: DomainLike = "wide,objects=random_box"
    """Ranges from which worlds are drawn, by name or as a JSON file; changes follow."""
    worlds: int = option(4096, 96, 1_000_000, kw_only=True)
    """Number of worlds from which the networks learn."""
    logs: int = option(200, 2, 10_000, kw_only=True)
    """Number of worlds whose logs are fitted."""
    evolution_logs: int = option(100, 1, 10_000, kw_only=True)
    """Number of logs, those with the fewest windows, that CMA-ES fits; in whole parts of 25."""
    starts: int = option(48, 6, 1000, kw_only=True)
    """Number of worlds from which least squares and CMA-ES start."""

    def answer(self, run: Run) -> xr.Dataset:
        """Fit the logs by each method and from each kind of log.

        Processes fit windows, because Python runs most of the splines and of the tracing. Each part
        has some logs and does not need the others. Networks learn meanwhile.
        """
        quiet = run._replace(callback=no_progress)
        context = multiprocessing.get_context("spawn")
        with context.Pool(len(os.sched_getaffinity(0)), use_processors) as pool:
            jobs = [
                pool.starmap_async(_fit_part, [(self, quiet, method, i) for i in parts], 1)
                for method, parts in self._parts.items()
            ]
            start = time.process_time()
            training = self.bank.worlds(self.worlds, run)
            seconds = time.process_time() - start  # checkpoint: a resumed run simulates less
            simulation = run.checkpoint("simulation", lambda: xr.Dataset({"simulation": seconds}))
            test = self.bank.worlds(self.logs, quiet, "test")
            networks = [
                run.checkpoint(f"neural-{i}", partial(self._by_networks, kind, training, test, run))
                for i, kind in enumerate(KINDS)
            ]
            set_phase(run.callback, "replay windows")
            index = np.arange(self.logs)
            by_method = {"neural": [fits.assign_coords(log=index) for fits in networks]}
            for method, job in zip(self._parts, jobs, strict=True):
                by_kind = zip(*job.get(), strict=True)
                by_method[method] = [xr.concat(fits, "log").sortby("log") for fits in by_kind]
        kinds = [
            xr.concat(by_method[method], xr.IndexVariable("kind", list(KINDS)))
            for method in METHODS
        ]
        result = xr.concat(kinds, xr.IndexVariable("estimator", list(METHODS)), join="outer")
        return xr.merge([result, simulation]).drop_encoding()  # integers of parts, now with NaN

    @property
    def _parts(self) -> dict[str, range]:
        """Parts of the logs that each method fits, the slowest method first."""
        counts = {"evolution": min(self.evolution_logs, self.logs), "gradient": self.logs}
        return {method: range(-(-count // _PART)) for method, count in counts.items()}

    def _by_networks(
        self, kind: str, training: xr.Dataset, test: xr.Dataset, run: Run
    ) -> xr.Dataset:
        """Return the fits of the networks."""
        set_phase(run.callback, f"learn from {kind}")
        start, names = time.process_time(), fit.statistic_names(training, KINDS[kind])
        networks = self.train(training, names)
        x = test.sel(statistic=names).statistics.values[:, :1]
        samples = [posterior.sample(networks, row, fit.SAMPLES, i) for i, row in enumerate(x)]
        seconds = (time.process_time() - start) / self.logs
        return self.compare_samples(samples, test.u.values).assign(
            seconds=("log", np.full(self.logs, seconds)), windows=("log", np.zeros(self.logs))
        )

    @cached_property
    def test_logs(self) -> list[Any]:
        """Logs of the test worlds."""
        logs = dict[int, Any]()
        index = np.arange(self.logs)
        for at, drawn in points.draw_by_object(self.ranges, self.test_seed, None, index):
            batch = self.bank.logs(drawn)
            for row, i in enumerate(at.tolist()):
                logs[i] = jax.tree.map(lambda x, row=row: x[row : row + 1], batch)
        return [logs[i] for i in range(self.logs)]

    def tracks(self, part: int) -> tuple[np.ndarray, list[Track], float]:
        """Return the logs of a part, their smooth paths, and the mean seconds of smoothing.

        The numbers of windows of its logs, and hence their programs, differ little.
        """
        interval, logs = self.bank.interval, self.test_logs
        counts = [Track.of(log, interval, True, True).first.size for log in logs]
        index = np.argsort(counts, kind="stable")[part * _PART : (part + 1) * _PART]
        start = time.process_time()
        tracks = [Track.of(logs[i], interval, False, True) for i in index]
        return index, tracks, (time.process_time() - start) / len(index)

    def by_windows(
        self, method: str, kind: str, inputs: Callable[[], tuple[np.ndarray, list[Track], float]]
    ) -> xr.Dataset:
        """Return the fits of replayed windows; logs with too few windows keep the prior."""
        minimise = {"gradient": Replay.minima, "evolution": evolved}[method]
        names = points.names(self.ranges)
        columns = [names.index(name) for name in fit.coordinates(self.ranges)]
        starts = points.points_of(self.ranges, np.arange(self.starts), 0)
        results, counts, (index, tracks, smoothing) = list[np.ndarray](), list[float](), inputs()
        start = time.process_time()
        for log, track in zip(index.tolist(), tracks, strict=True):
            track = track if "f_robot" in KINDS[kind] else track._replace(force=None)
            replay = Replay(self.ranges, [track], self.setting, False)
            u = np.random.default_rng(log).random((fit.SAMPLES, len(names)))
            if replay.num_windows >= least_squares.LEAST_WINDOWS:
                u, r, j = minimise(replay, starts)
                u, _ = least_squares.sample(replay, u, r, j, fit.SAMPLES, log)
            results.append(u[:, columns])
            counts.append(replay.num_windows)
        seconds = (time.process_time() - start) / len(index) + smoothing
        truth = points.points_of(self.ranges, index, self.test_seed)[:, columns]
        fits = self.compare_samples(results, truth, index).assign_coords(log=index)
        return fits.assign(seconds=("log", np.full(len(index), seconds)), windows=("log", counts))

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the comparison of the methods, over all quantities and by quantity."""
        return [
            Table(method_rows(results, self), name="fit_methods", title="Methods"),
            Table(quantity_rows(results), name="fit_methods_quantities", title="By quantity"),
        ]


methods = call_of(Methods)


def _fit_part(study: Methods, run: Run, method: str, part: int) -> list[xr.Dataset]:
    """Return the fits of a part of the logs, from each kind of log."""
    inputs = functools.cache(partial(study.tracks, part))
    return [
        run.checkpoint(f"{method}-{i}-{part:03d}", partial(study.by_windows, method, kind, inputs))
        for i, kind in enumerate(KINDS)
    ]


class _Values(Replay):
    """Least-squares problem without derivatives."""

    @property
    def active(self) -> list[int]:
        """No columns, so that `derivatives` returns the residuals alone."""
        return []


def evolved(replay: Replay, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the best point (1, q) of CMA-ES from the best of the points (n, q).

    The cost is that of `Replay.minima`, without derivatives. Also returns the residuals (1, B, C)
    at this point, and their derivatives (1, B, C, p) for its interval.
    """
    values = _Values(*replay)
    batches = np.resize(u, (-(-len(u) // _POPULATION), _POPULATION, u.shape[1]))
    costs = [least_squares.cost(values.derivatives(batch)[0]) for batch in batches]
    best = batches.reshape(-1, u.shape[1])[np.argmin(costs)]
    *_, best = itertools.islice(evolve(replay, best, np.min(costs), len(batches)), _GENERATIONS)
    u = np.tile(best, (least_squares.STARTS, 1))  # the number that `minima` compiles for
    r, j = replay.derivatives(u)
    return u[:1], r[:1], j[:1]


def evolve(replay: Replay, best: np.ndarray, least: float, seed: int) -> Iterator[np.ndarray]:
    """Yield the best point (q,) after each generation of CMA-ES, from one with the cost `least`."""
    values, active = _Values(*replay), replay.active
    u = np.tile(best, (_POPULATION, 1))
    bounds = np.where(replay.periodic[:, None], [-np.inf, np.inf], [0.0, 1 - 1e-6])
    strategy = cmaes.CMA(
        best[active], _SPREAD, bounds=bounds, population_size=_POPULATION, seed=seed
    )
    while True:
        candidates = np.stack([strategy.ask() for _ in range(_POPULATION)])
        u[:, active] = np.where(replay.periodic, candidates % 1, candidates)
        costs = least_squares.cost(values.derivatives(u)[0])
        strategy.tell(list(zip(candidates, costs, strict=True)))
        if costs.min() < least:
            best, least = u[costs.argmin()].copy(), costs.min()
        yield best


def method_rows(results: xr.Dataset, study: Methods) -> Rows:
    """Return a header and rows for each kind of log and method: all logs, and those of CMA-ES."""
    rows = [
        [
            "log",
            "method",
            "logs",
            "90 % intervals hold the truth",
            "those of determined quantities",
            "determined",
            "error of determined quantities",
            "processor seconds a log",
            "simulated",
        ]
    ]
    replays = {
        "gradient": (study.starts // 6 + 16) * 6,
        "evolution": study.starts + _POPULATION * _GENERATIONS,
    }
    for kind in map(str, results.kind.values):
        common = _fits(results, kind, METHODS[-1]).log
        all_fits = [(method, _fits(results, kind, method)) for method in METHODS]
        more = [(method, fits) for method, fits in all_fits if fits.sizes["log"] > common.size]
        for method, fits in more + [(method, fits.sel(log=common)) for method, fits in all_fits]:
            covered, determined = within(fits), fits.undetermined == 0
            shares = covered.mean(), covered.where(determined).mean(), determined.mean()
            cells = [f"{100 * float(share):.1f} %" for share in shares]
            error = f"{100 * float(_error(fits).where(determined).median()):.1f} %"
            seconds, windows = float(fits.seconds.median()), float(fits.windows.mean())
            trials = f"{replays.get(method, 0) * windows * least_squares.WINDOW:,.0f} s a log"
            if method == "gradient":
                trials = trials.replace(" s ", " s and derivatives ")
            if method == "neural":
                trials = f"{study.worlds * study.window:,.0f} s for all logs"
                seconds += float(results.simulation) / study.logs
            count = str(fits.sizes["log"])
            rows.append([kind, method, count, *cells, error, f"{seconds:.1f}", trials])
    return rows


def quantity_rows(results: xr.Dataset) -> Rows:
    """Return a header and one row for each quantity; errors are shares of the prior's interval.

    The logs are those that all methods fit.
    """
    pairs = [(kind, method) for kind in map(str, results.kind.values) for method in METHODS]
    rows = [["quantity", *(f"{kind}: {method}" for kind, method in pairs)]]
    for name in _QUANTITIES:
        cells = []
        for kind, method in pairs:
            fits = _fits(results, kind, method).sel(quantity=name)
            fits = fits.sel(log=_fits(results, kind, METHODS[-1]).log)
            error, covered = float(_error(fits).median()), float(within(fits).mean())
            cells.append(f"{100 * error:.1f} %, {100 * covered:.0f} %")
        rows.append([quantity(name), *cells])
    return rows


def _fits(results: xr.Dataset, kind: str, method: str) -> xr.Dataset:
    """Return the fits of one method to the logs that it fits."""
    return results.sel(kind=kind, estimator=method).dropna("log", how="all", subset=["rank"])


def _error(fits: xr.Dataset) -> xr.DataArray:
    """Return errors of the median, as shares of the prior's 90 % interval."""
    return abs(fits["median"] - fits.truth) / (fits.prior_high - fits.prior_low)
