"""Search for diverse failures with quality-diversity optimisation (pyribs).

An archive divides the ranges of three drawn quantities into cells, separately for each object of
the domain, and keeps the severest trial of each cell. Emitters propose worlds: CMA-MAE (Fontaine
and Nikolaidis, 2023) moves towards improvements of the archive, and the line operator (Vassiliades
and Mouret, 2018) mixes elites. The archives of the emitters accept near
misses and failures, and failures alone as soon as there are enough. Emitters vary the normal
quantiles of ranges and choices. Noise and corners of prisms are random in every world.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any, ClassVar, TypeAlias

import numpy as np
import pandas as pd
import xarray as xr
from scipy import stats

from rps_jax import InputError, Setting, errors, load
from rps_jax.analysis import statistics, tables
from rps_jax.analysis.figures.style import (
    WIDTH,
    Figure,
    ScalarMappable,
    TwoSlopeNorm,
    axis_label,
    styled,
    tiles,
    words,
)
from rps_jax.engines import device
from rps_jax.physics import preset
from rps_jax.questions import LawQuestion, Picture, Plan, Run, Section, call_of, option
from rps_jax.record import files, provenance
from rps_jax.record import folder as run_folder
from rps_jax.record.files import Arrays
from rps_jax.runs import execution
from rps_jax.runs.question import DomainQuestion, count_true
from rps_jax.studies.probe import Probe
from rps_jax.trials.progress import Bar, set_phase
from rps_jax.trials.setting import seed_of
from rps_jax.world import points

# [1] shares of the time after which the search ends, and the check of elites.
_SEARCH_UNTIL, _CHECK_UNTIL = 0.6, 0.8
_EDGE = 1e-6  # least distance of a coordinate to the ends of its range
_LEARNING_RATE = 0.1  # [1] of the thresholds of CMA-MAE's archive
_ISO_SIGMA, _LINE_SIGMA, _CMA_SIGMA = 0.2, 0.1, 0.3  # [1] step sizes in normal quantiles
_CMA_BATCH = 24  # worlds of an emitter of CMA-MAE, about
_AXIS_SCALE = 4.0  # [1] step size along the archive's axes over that along other quantities
_NEAR_MISSES = 0.1  # [1] share of the first worlds that the emitters' archives accept
_MIN_FAILURES = 12  # failing cells of an object from which on only failures are accepted
_DRAWN_AT_ONCE = 4096
Archive: TypeAlias = Any  # of pyribs, which is optional
_FIELDS = dict.fromkeys(("success", "time", "left"), ((), float))  # of an archive's elites


@dataclass(frozen=True)
class Attack(DomainQuestion[xr.Dataset], LawQuestion[xr.Dataset]):
    """Search for diverse failures (quality-diversity archive; needs pyribs).

    The result has, by cell (object, and three axes), `margin`: severity less 1, NaN where no world
    was tried. Elites that fail come worst first, with `u` (elite, quantity), `severity`, `time`,
    `left` and `again`: whether they fail in converged C MuJoCo, NaN where this was not tried. By
    generation it has `failing` cells, and the sums `trials` and `simulated` [s]. Attributes hold
    the same sums of drawn worlds.

    Examples:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=1.0)
      >>> small = {"cells": 2, "batch": 8, "generations": 1, "drawn": 8}
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> results = rps_jax.attack("rps", drums, **small, check_again=0, setting=setting)
      >>> results.margin.dims
      ('object', 'size', 'com_offset', 'friction_robot')
    """

    TITLE = "Search for failures"
    IGNORED_FIELDS = ("minutes", "generations", "check_again", "worst")
    QUICK: ClassVar = {"minutes": 2.0, "drawn": 128, "check_again": 4}

    axes: tuple[str, ...] = ("size", "com_offset", "friction_robot")
    """Three drawn quantities whose ranges the cells of the archive divide."""
    cells: int = option(10, 2, 100)
    """Number of cells along each axis, for each object."""
    batch: int = option(96, 8, 1_000_000)
    """Number of worlds of a generation, for each object."""
    generations: int = option(1000, 1, 1_000_000)
    """Maximum number of generations."""
    minutes: float = option(5.0, above=0, at_most=1e5, unit="min")
    """Wall clock from the call to the report [min]. The first generation always runs. The time
    after the search is for trying elites again."""
    repeats: int = option(2, 1, 100)
    """Number of trials that differ only in noise. A world that fails once is tried again, and its
    least severe trial counts."""
    drawn: int = option(512, 1, 10_000_000)
    """Number of drawn worlds for comparison."""
    check_again: int = option(32, 0, 100_000)
    """Maximum number of elites to try again in converged C MuJoCo."""
    worst: int = option(48, 1, 100_000)
    """Maximum number of elites to store as a sweep that can be replayed and filmed."""
    film: bool = option(False, kw_only=True)
    """Whether the command films the worst twelve."""

    def check(self) -> None:
        if len(self.axes) != 3:
            raise InputError(f"axes = {self.axes} is not allowed: name three quantities.")
        errors.check_each_once("axes", self.axes)
        for name in self.axes:
            points.check_drawn(name, self.ranges)
        self.check_engine([self.params])
        errors.require("ribs", "failures")

    def progress_bar(self) -> Bar:
        return Bar(self.name, 60 * self.minutes, "clock", shown=self.shows_progress)

    def answer(self, run: Run) -> xr.Dataset:
        """Search, then try elites again until the time is over."""
        start_time, total = time.perf_counter(), 60 * self.minutes
        probe = Probe(self.ranges, self.params, self.setting, run)
        search = _Search(probe, self, seed_of(self.setting.seed, "tune"))
        results = search.run(start_time + _SEARCH_UNTIL * total)
        results = self._check_elites(results, run, start_time + _CHECK_UNTIL * total)
        self._store_worst(results, run)
        return results

    @property
    def reference(self) -> Setting:
        """Setting of converged C MuJoCo, with the support and the control period of the search."""
        period, support = self.setting.physics.control_period, self.setting.physics.support
        physics = replace(preset(fidelity="reference"), control_period=period, support=support)
        return replace(self.setting, engine="mujoco", physics=physics)

    def _check_elites(self, results: xr.Dataset, run: Run, deadline: float) -> xr.Dataset:
        """Try elites again in converged C MuJoCo, evenly from the worst to the least severe."""
        count = results.sizes["elite"]
        failed = np.full(count, np.nan)
        even = np.linspace(0, count - 1, min(self.check_again, count)).round().astype(int)
        # In a random order, so that those before the deadline are even, too.
        order = np.random.default_rng(0).permutation(even)
        set_phase(run.callback, "check in C MuJoCo")
        # A search that continues for longer has other elites.
        name = f"check-{files.sha256(results.u.values.tobytes())[:8]}"
        probe = Probe(self.ranges, self.params, self.reference, run.inside(name))
        batch = max(1, run.workers or device.count_processors())
        for first in range(0, len(order), batch):
            if time.perf_counter() >= deadline:
                break
            rows = order[first : first + batch]
            failed[rows] = probe(results.u.values[rows]).success.values == 0
        return results.assign(again=("elite", failed, {"units": "1"}))

    def _store_worst(self, results: xr.Dataset, run: Run) -> None:
        """Store the worst elites as a sweep in the subfolder `worlds` of a run folder."""
        if run.folder is not None and results.sizes["elite"]:
            set_phase(run.callback, "worst worlds")
            at = points.check_points(self.ranges, results.u.values[: self.worst])
            plan = Plan(self.ranges, len(at.u), {self.label: self.params}, self.setting, points=at)
            worst = run.folder / "worlds"
            if run_folder.difference(worst, plan.configuration()):  # the worst of a shorter search
                run_folder.remove_run(worst)
            execution.run_plan(plan, worst, **run.batch_options)

    def intro(self, results: xr.Dataset) -> str:
        return (
            f"{self.label} in the domain {self.worlds_in_words}: axes "
            f"{', '.join(self.axes)}, {self.repeats} noises each."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        rates, attrs = yields(results), results.attrs
        ratio = f"{rates['times']:.1f} times as many, " if attrs["drawn_failing"] else ""
        text = (
            f"{int(results.failing[-1])} of {results.margin.size} cells hold a failure after "
            f"{int(results.trials[-1]):,} trials and {float(results.simulated[-1]):,.0f} s of "
            f"simulated time: {rates['search']:.2f} cells per hour. {attrs['drawn_trials']:,} "
            f"trials of drawn worlds fill {attrs['drawn_failing']}: {rates['drawn']:.2f} per hour. "
            f"The search finds {ratio}at least {rates['times_low']:.1f} times (95 %)."
        )
        maps = Picture("archive", partial(archive_figure, results, self.axes))
        margin = "Severity less 1: above 0 a failure, by this many metres; below 0 a success."
        sections = [Section("Failing cells", text), Section("Margins", margin, (), maps)]
        checked = np.isfinite(results.again.values)
        if checked.any():
            failures, trials = count_true(results.again.values == 1), count_true(checked)
            low, high = (100 * p for p in statistics.clopper_pearson(failures, trials))
            text = (
                f"{failures} of {trials} elites, evenly from the worst to the least severe, fail "
                f"in converged C MuJoCo, too: {100 * failures / trials:.0f} % "
                f"[{low:.0f}, {high:.0f}]."
            )
            sections.append(Section("Failures in another engine", text))
        if run.folder is not None and results.sizes["elite"]:
            folder = str(run.folder / "worlds")
            worst = load(folder)
            film = provenance.shell("film", folder, "--which", "hardest", "--grid", "3x4")
            text = (
                f"{count_true(worst.success.values == 0)} of {worst.sizes['world']} fail again in "
                f"the same engine. `{film}` films the worst."
            )
            rows = tables.worlds_table(worst, folder, statistics.hardest(worst, self.worst))
            sections.append(Section("The worst", text, rows))
        return sections


attack = call_of(Attack)


def _grid_archive(dimensions: int, dims: Sequence[int], **options: object) -> Archive:
    """Return a pyribs archive with axes from 0 to 1."""
    archives = errors.require("ribs.archives", "failures")
    ranges = [(0, 1)] * len(dims)
    return archives.GridArchive(solution_dim=dimensions, dims=dims, ranges=ranges, **options)


class _Search:
    """Search for the failures of one law.

    Its archives hold the severest trial of each cell of objects and axes, over points `u`.
    """

    def __init__(self, probe: Probe, options: Attack, seed: int):
        self.probe, self.options, self.seed = probe, options, seed
        self.domain = probe.domain
        quantities = points.coordinates(self.domain)
        names = [x.name for x in quantities]
        self.q, self.objects = len(quantities), len(self.domain.objects)
        self.cells = (options.cells,) * 3
        self.axes = [names.index(name) for name in options.axes]
        # Emitters vary ranges and choices, except the object: each object has its own emitters.
        varied = [x.kind in ("range", "choice") and x.name != "object" for x in quantities]
        self.varied = np.flatnonzero(varied).tolist()
        self.varied_axes = [self.varied.index(axis) for axis in self.axes]
        # [1] of the emitters' steps, by quantity
        self.scale = np.where(np.isin(self.varied, self.axes), _AXIS_SCALE, 1.0)
        self.noise = np.array([i for i, x in enumerate(quantities) if x.kind == "noise"])
        self.object_column = names.index("object") if "object" in names else None
        self.rng = np.random.Generator(np.random.Philox(key=seed))

    def run(self, deadline: float) -> xr.Dataset:
        """Try drawn worlds, then generations of emitters until the deadline [s]."""
        options, probe = self.options, self.probe
        set_phase(probe.run.callback, "drawn worlds")
        create = partial(_grid_archive, self.q, (self.objects, *self.cells), extra_fields=_FIELDS)
        drawn, archive = create(), create()
        for first in range(0, options.drawn, _DRAWN_AT_ONCE):
            count = -(-min(_DRAWN_AT_ONCE, options.drawn - first) // self.objects)
            self._try(self.rng.random((self.objects, count, len(self.varied))), drawn)
        attributes = {
            "drawn_trials": probe.trials,
            "drawn_failing": int(self._count_failing(drawn).sum()),
            "drawn_simulated": probe.simulated,
        }
        history = list[dict[str, float]]()
        schedulers: list[Any] = [None] * self.objects
        # Severities from which on the emitters accept a world.
        thresholds = np.zeros(self.objects)
        set_phase(probe.run.callback, "search")
        for generation in range(options.generations):
            if generation and time.perf_counter() >= deadline:
                break
            if generation == 0:
                v = self.rng.random((self.objects, options.batch, len(self.varied)))
            else:
                v = stats.norm.cdf(self.scale * np.stack([x.ask() for x in schedulers]))
            objective = self._try(v, archive).reshape(self.objects, options.batch)
            failing = self._count_failing(archive)
            for k, enough in enumerate(failing >= _MIN_FAILURES):
                if generation:
                    schedulers[k].tell(objective[k], v[k][:, self.varied_axes])
                if generation == 0 or (enough and thresholds[k] < 1):
                    near = np.quantile(objective[k], 1 - _NEAR_MISSES)
                    thresholds[k] = 1.0 if enough else min(1.0, near)
                    schedulers[k] = self._scheduler(k, archive, float(thresholds[k]))
            trials = probe.trials - attributes["drawn_trials"]
            simulated = probe.simulated - attributes["drawn_simulated"]
            sums = {"failing": int(failing.sum()), "trials": trials, "simulated": simulated}
            history.append(sums)
        return self._labelled(archive, history).assign_attrs(attributes)

    def _elites(self, archive: Archive) -> Arrays:
        """Return the elites (n,) in the order of their cells, with the index of their object."""
        elites = archive.data()
        order = np.argsort(elites["index"])
        objects = elites["index"] // np.prod(self.cells)
        return {name: x[order] for name, x in (elites | {"which_object": objects}).items()}

    def _count_failing(self, archive: Archive) -> np.ndarray:
        """Return the number of the cells that hold a failure, by object (objects,)."""
        elites = self._elites(archive)
        return np.bincount(elites["which_object"], elites["success"] == 0, self.objects)

    def _try(self, v: np.ndarray, archive: Archive) -> np.ndarray:
        """Try worlds at varied quantities `v` (objects, n, varied), and add them to an archive.

        Returns:
          The objective (objects * n,) [1], which the search maximises.
        """
        count = v.shape[0] * v.shape[1]
        u = self.rng.random((count, self.q))
        u[:, self.varied] = np.clip(v.reshape(count, -1), _EDGE, 1 - _EDGE)
        objects = (np.repeat(np.arange(self.objects), v.shape[1]) + 0.5) / self.objects
        if self.object_column is not None:
            u[:, self.object_column] = objects
        trials = self.probe(u)
        # The first repetition removes most accidental failures; the others run together.
        for times in (min(1, self.options.repeats - 1), self.options.repeats - 2):
            rows = np.flatnonzero(trials.success.values == 0)
            if rows.size and times > 0:
                self._repeat(trials, rows, times)
        objective = trials.severity.values
        fields = {name: trials[name].values for name in _FIELDS}
        u = trials.u.values
        archive.add(u, objective, np.column_stack([objects, u[:, self.axes]]), **fields)
        return objective

    def _repeat(self, trials: xr.Dataset, rows: np.ndarray, times: int) -> None:
        """Try the worlds `rows` with other noise, and keep the least severe trial of each."""
        u = np.tile(trials.u.values[rows], (times, 1))
        u[:, self.noise] = self.rng.random((len(u), self.noise.size))
        repeated = self.probe(u)
        for i in range(times):
            trial = repeated.isel(world=slice(i * rows.size, (i + 1) * rows.size))
            milder = trial.severity.values < trials.severity.values[rows]
            for name, values in trials.items():
                values.values[rows[milder]] = trial[name].values[milder]

    def _scheduler(self, k: int, archive: Archive, threshold: float) -> Any:
        """Return pyribs' scheduler of new emitters for object `k`.

        Their archive starts with the elites whose severity reaches the threshold.
        """
        emitters = errors.require("ribs.emitters", "failures")
        options, elites = self.options, self._elites(archive)
        accepted = (elites["which_object"] == k) & (elites["objective"] >= threshold)
        v, objective = elites["solution"][accepted][:, self.varied], elites["objective"][accepted]
        z = stats.norm.ppf(np.clip(v, _EDGE, 1 - _EDGE)) / self.scale
        annealing = {"learning_rate": _LEARNING_RATE, "threshold_min": threshold}
        grid = _grid_archive(len(self.varied), self.cells, seed=self.seed + k, **annealing)
        grid.add(z, objective, v[:, self.varied_axes])
        order = np.argsort(-objective, kind="stable")
        rules = {"ranker": "imp", "selection_rule": "mu", "restart_rule": "basic"}
        cma = partial(emitters.EvolutionStrategyEmitter, sigma0=_CMA_SIGMA, **rules)
        line = partial(emitters.IsoLineEmitter, iso_sigma=_ISO_SIGMA, line_sigma=_LINE_SIGMA)
        rest = np.arange(options.batch // 2, options.batch)
        parts = np.array_split(rest, max(1, round(rest.size / _CMA_BATCH)))
        kinds = [(line, options.batch // 2), *((cma, part.size) for part in parts)]
        sources = [
            kind(grid, x0=z[order[i % len(z)]], seed=int(self.rng.integers(2**31)), batch_size=size)
            for i, (kind, size) in enumerate(kinds)
        ]
        return errors.require("ribs.schedulers", "failures").Scheduler(grid, sources)

    def _labelled(self, archive: Archive, history: Sequence[Mapping[str, float]]) -> xr.Dataset:
        """Return the archive and the history of the search with names and units."""
        axes, quantities = self.options.axes, {x.name: x for x in points.coordinates(self.domain)}
        elites = self._elites(archive)
        margin = np.full((self.objects, *self.cells), np.nan)
        margin.flat[elites["index"]] = elites["objective"] - 1
        failed = np.flatnonzero(elites["success"] == 0)
        failed = failed[np.argsort(-elites["objective"][failed], kind="stable")]
        worst = {name: x[failed] for name, x in elites.items()}
        ranges = [quantities[name] for name in axes]
        objects = np.array(self.domain.objects)
        middles = (np.arange(self.options.cells) + 0.5) / self.options.cells
        return xr.Dataset(
            {
                "margin": (("object", *axes), margin),
                "u": (("elite", "quantity"), worst["solution"]),
                "severity": ("elite", worst["objective"]),
                **{name: ("elite", worst[name]) for name in ("time", "left")},
                "elite_object": ("elite", objects[worst["which_object"]]),
                **{name: ("generation", x) for name, x in pd.DataFrame(history).items()},
            },
            {
                "object": objects,
                "quantity": list(quantities),
                **{x.name: (x.name, x.range.at(middles), {"units": x.unit}) for x in ranges},
            },
        )


def yields(results: xr.Dataset) -> dict[str, float]:
    """Compute the failing cells per hour of simulated time, of the search and of drawn worlds.

    `times` is their ratio. `times_low` is its lower end, from the exact upper end of the drawn
    worlds' count (Poisson, 95 %). It assumes that drawn worlds fill no cell twice, in their favour.
    """
    hours, drawn = float(results.simulated[-1]) / 3600, results.attrs["drawn_simulated"] / 3600
    count = results.attrs["drawn_failing"]
    search_rate, drawn_rate = float(results.failing[-1]) / hours, count / drawn
    highest = float(stats.chi2.ppf(0.975, 2 * count + 2)) / 2 / drawn
    return {
        "search": search_rate,
        "drawn": drawn_rate,
        "times": search_rate / drawn_rate if drawn_rate else float("inf"),
        "times_low": search_rate / highest,
    }


# --- figures -------------------------------------------------------------------------------


@styled
def archive_figure(results: xr.Dataset, quantities: Sequence[str]) -> Figure:
    """Draw the margin of failures: a row for each object, a column for each pair of quantities.

    A cell shows the severest trial over the third quantity; a dot marks a failure.
    """
    pairs, objects = list(combinations(quantities, 2)), results.object.values.tolist()
    figure, axes = tiles(
        len(objects) * len(pairs), len(pairs), (WIDTH / 3 - 0.25, 2.1), (0.75, 0.3)
    )
    norm = TwoSlopeNorm(0, -1, max(0.3, float(np.nanquantile(results.margin, 0.98))))
    for row, name in enumerate(objects):
        for ax, (x, y) in zip(axes[row], pairs, strict=True):
            (third,) = set(quantities) - {x, y}
            worst = results.margin.isel(object=row).max(third).transpose(y, x)
            ax.imshow(worst, origin="lower", norm=norm, cmap="RdBu_r", aspect="auto")
            ys, xs = np.nonzero(worst.values >= 0)
            ax.plot(xs, ys, "k.", ms=2)
            for axis, label in ((ax.xaxis, x), (ax.yaxis, y)):
                values = results[label].values
                ticks = np.linspace(0, values.size - 1, 4).round().astype(int)
                axis.set_ticks(ticks, [f"{values[i]:.2g}" for i in ticks])
                axis.set_label_text(axis_label(label, results[label].attrs["units"]))
            ax.set_facecolor("0.9")
            ax.set_title(words(name))
    colours, label = ScalarMappable(norm, "RdBu_r"), "margin: severity - 1 [1; m beyond 0]"
    figure.colorbar(colours, ax=axes, label=label, shrink=0.7)
    figure.suptitle("severest trial of each cell; a dot marks a failure")
    return figure
