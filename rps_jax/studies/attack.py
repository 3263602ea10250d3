"""A search for failures of many kinds, by quality and diversity (pyribs).

An archive has a cell for each small range of three quantities, and of each object of the domain;
in a cell stands the severest trial that was met there. Emitters propose worlds: some follow
CMA-ME or CMA-MAE (Fontaine and Nikolaidis, 2020 and 2023) towards where the archive improves, some
mix elites along lines between them (Vassiliades and Mouret, 2018). Into their archives only near
misses and failures are let, and failures alone when there are enough of these. They move in the
normal quantiles of what the domain draws from ranges; of the others, noise and corners of prisms,
every world has its own, by chance.
"""

import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import xarray as xr
from matplotlib.colors import TwoSlopeNorm
from scipy import stats

from rps_jax import errors
from rps_jax.analysis import statistics, tables
from rps_jax.analysis.figures.style import Figure, quantity, words
from rps_jax.analysis.report import Picture, Section
from rps_jax.errors import InputError
from rps_jax.record import files, provenance
from rps_jax.record.options import option
from rps_jax.runs import sweep as sweeps
from rps_jax.runs.plan import Plan
from rps_jax.runs.question import (
    InDomain,
    OfLaw,
    Run,
    call_of,
    count_of,
    labelled,
    name_of,
    seed_of,
)
from rps_jax.studies.probe import Probe
from rps_jax.trials.progress import Bar, phase
from rps_jax.world import points
from rps_jax.world.domain import Domain

Algorithm = Literal["cma_me", "cma_mae", "line", "mixed"]
_SEARCH, _CHECK = 0.6, 0.8  # [1] of the time, when the search ends, and the check of elites

_EDGE = 1e-6  # least distance of a coordinate to the ends of its range
_RATE = 0.1  # [1] learning rate of the archive's thresholds, of CMA-MAE
_ISO, _LINE, _SPREAD = 0.2, 0.1, 0.3  # [1] steps of the emitters, in normal quantiles
_FAR = 4.0  # [1] how much farther than the others the archive's axes move
_NEAR = 0.1  # [1] share of the first worlds whose severity lets a world into an archive
_ENOUGH = 12  # failing cells of an object, from which on only failures are let in


@dataclass(frozen=True)
class Attack(InDomain[xr.Dataset], OfLaw[xr.Dataset]):
    """Search for failures of many kinds: an archive over three quantities (needs pyribs).

    The answer holds the margin, severity less 1, by cell (object, and three axes), NaN where no
    world was tried; elites that fail, worst first, `u` (elite, quantity) with `severity`, `time`
    and `left`, and whether they fail again in converged C MuJoCo, `again` (elite), NaN of those not
    tried; and (generation) `failing` cells, `trials` and `simulated` seconds so far. Attributes
    say the same of drawn worlds.

    Example:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=1.0)
      >>> small = {"cells": 2, "algorithm": "line", "batch": 8, "generations": 1, "drawn": 8}
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> found = rps_jax.attack("rps", drums, **small, check_again=0, setting=setting)
      >>> found.margin.dims
      ('object', 'size', 'com_offset', 'friction_robot')
    """

    TITLE: ClassVar[str] = "A search for failures"
    LEFT_OUT: ClassVar[tuple[str, ...]] = ("minutes", "generations", "check_again", "worst")
    SMALL: ClassVar[Mapping[str, Any]] = {"minutes": 2.0, "drawn": 128, "check_again": 4}

    axes: tuple[str, ...] = ("size", "com_offset", "friction_robot")
    """Three quantities of the domain, whose ranges the archive's cells divide."""
    cells: int = option(10, 2, 100)
    """Number of cells along each axis, for each object."""
    aim: Literal["distance", "time"] = "distance"
    """What is worst: most distance left (failures), or most time (slow successes, too)."""
    algorithm: Algorithm = "mixed"
    """How worlds are proposed: cma_me, cma_mae, line (mixtures of elites), or half of each line
    and cma_mae."""
    batch: int = option(96, 8, 1_000_000)
    """Number of worlds of a generation, for each object."""
    generations: int = option(1000, 1, 1_000_000)
    """Number of generations, at most."""
    minutes: float = option(5.0, above=0, at_most=1e5, unit="min")
    """Wall clock from the call to the report [min]. The first generation is made whatever it takes;
    what is left of the time after the search goes into trying elites again."""
    repeats: int = option(2, 1, 100)
    """Number of trials that differ in noise alone, in all of which a world must fail; the least
    severe one counts. Only worlds that failed are tried again."""
    drawn: int = option(512, 1, 10_000_000)
    """Number of drawn worlds beside it, with which it is compared."""
    check_again: int = option(32, 0, 100_000)
    """Number of elites, at most, that are tried again in converged C MuJoCo."""
    worst: int = option(48, 1, 100_000)
    """Number of elites, at most, that are kept as a sweep to be replayed and filmed."""
    film: bool = field(default=False, kw_only=True)
    """Whether the command films the worst twelve."""

    def check(self) -> None:
        if len(self.axes) != 3:
            raise InputError(f"axes = {self.axes} is not allowed: name three quantities.")
        errors.check_each_once("axes", self.axes)
        for name in self.axes:
            points.check_drawn("axes", name, self.ranges)
        errors.check_count("seed", self.setting.seed, at_least=0, at_most=2**30)
        self.check_engine([self.params])
        errors.require("ribs", "failures")

    def bar(self) -> Bar:
        return Bar(self.name, 60 * self.minutes, "clock", shown=self.shown)

    def answer(self, run: Run) -> xr.Dataset:
        """Search, then try what was found again, until the time is over."""
        began = time.perf_counter()

        def left(share: float) -> bool:
            return time.perf_counter() - began < share * 60 * self.minutes

        probe = Probe(self.ranges, self.params, self.setting, run.folder, **run.shape)
        found = _Search(probe, self, seed_of(self.setting.seed, "tune")).run(partial(left, _SEARCH))
        found = self._again(found, run, partial(left, _CHECK))
        if run.folder is not None:
            self._keep_worst(found, run)
        return found

    def _again(self, found: xr.Dataset, run: Run, left: Callable[[], bool]) -> xr.Dataset:
        """Try elites once more in converged C MuJoCo, evenly from the worst to the least bad."""
        total = found.sizes["elite"]
        failed = np.full(total, np.nan)
        order = _spread_out(total, min(self.check_again, total))
        phase(run.report, "check in C MuJoCo")
        fine = replace(self.setting, engine="mujoco", physics="default", fidelity="reference")
        folder = None if run.folder is None else run.folder / "check"
        probe = Probe(self.ranges, self.params, fine, folder, **run.shape)
        some = max(1, run.workers or provenance.count_processors())
        for first in range(0, len(order), some):
            if not left():
                break
            rows = order[first : first + some]
            failed[rows] = probe(found.u.values[rows]).success.values == 0
        return found.assign(again=("elite", failed, {"units": "1"}))

    def _keep_worst(self, found: xr.Dataset, run: Run) -> None:
        """Keep the worst elites as a sweep in the folder's `worlds`."""
        if found.sizes["elite"]:
            phase(run.report, "worst worlds")
            at = points.checked(self.ranges, found.u.values[: self.worst])
            plan = Plan(self.ranges, len(at.u), {self.label: self.params}, self.setting, points=at)
            assert run.folder is not None
            sweeps.complete(run.folder / "worlds", plan, **run.shape)

    def intro(self, found: xr.Dataset) -> str:
        return (
            f"{self.label} in the domain {name_of(self.domain)}: axes {', '.join(self.axes)}, "
            f"{self.repeats} noises each."
        )

    def report(self, found: xr.Dataset, run: Run) -> Sequence[Section]:
        gain, cells = yields(found), found.margin.size
        text = (
            f"{int(found.failing[-1])} of {cells} cells hold a failure, after "
            f"{int(found.trials[-1]):,} trials and {float(found.simulated[-1]):,.0f} s of time: "
            f"{gain['search']:.2f} an hour. {found.attrs['drawn_trials']:,} trials of drawn worlds "
            f"found {found.attrs['drawn_failing']}: {gain['drawn']:.2f} an hour. "
        )
        times = f"{gain['times']:.1f} times as many, " if found.attrs["drawn_failing"] else ""
        text += f"The search finds {times}at least {gain['times_low']:.1f} times (95 %)."
        title = f"{self.label}, {name_of(self.domain)}: worst trial of each cell"
        rise = Picture("search", partial(search_figure, found, gain["drawn"]))
        maps = Picture("archive", partial(archive_figure, found, self.axes, title))
        margin = "Severity less 1: above 0 a failure, by so many metres; below 0 a success."
        sections = [Section("Failing cells", text, (), rise), Section("Margins", margin, (), maps)]
        tried = np.isfinite(found.again.values)
        if tried.any():
            bad, of = count_of(found.again.values == 1), count_of(tried)
            low, high = statistics.clopper_pearson(bad, of)
            text = (
                f"{bad} of {of} elites, evenly from the worst to the least bad, fail again in "
                f"converged C MuJoCo: {100 * bad / of:.0f} % [{100 * low:.0f}, {100 * high:.0f}]."
            )
            sections.append(Section("Do they fail elsewhere, too", text))
        if run.folder is not None and found.sizes["elite"]:
            sections.append(self._worst(run.folder / "worlds"))
        return sections

    def _worst(self, folder: Path) -> Section:
        """The worst worlds, with the commands that show them."""
        results = labelled(files.read_results(folder))
        failed = count_of(results.success.values == 0)
        text = (
            f"{failed} of {results.sizes['world']} fail again in the same engine. `rps film "
            f"{shlex.quote(str(folder))} --which hardest --grid 3x4` films the worst."
        )
        return Section("The worst", text, tables.hardest_table(results, str(folder), self.worst))


attack = call_of(Attack)


def _spread_out(total: int, count: int) -> np.ndarray:
    """So many indices evenly from 0 to total - 1, coarse ones first."""
    if not count:
        return np.zeros(0, int)
    even = np.unique(np.linspace(0, total - 1, count).round().astype(int))
    strides = [even[:: 2**k] for k in range(int(np.log2(len(even))), -1, -1)]
    return np.array(list(dict.fromkeys(int(i) for stride in strides for i in stride)))


class _Archive:
    """The worst trial of every cell, and when it was met."""

    def __init__(self, domain: Domain, hunt: Attack):
        self.names = points.names(domain)
        self.axes = [self.names.index(name) for name in hunt.axes]
        self.shape = (len(domain.objects), *(hunt.cells,) * 3)
        self.worst = np.full(self.shape, -np.inf)
        self.u = np.zeros((*self.shape, len(self.names)))
        self.told = {name: np.full(self.shape, np.nan) for name in ("success", "time", "left")}
        self.cells = hunt.cells

    def add(self, which: np.ndarray, found: xr.Dataset, worth: np.ndarray) -> None:
        """Trials (n,) of objects `which`."""
        u = found.u.values
        at = np.minimum((u[:, self.axes] * self.cells).astype(int), self.cells - 1)
        for i in np.argsort(worth, kind="stable"):
            cell = (int(which[i]), *map(int, at[i]))
            if worth[i] > self.worst[cell]:
                self.worst[cell], self.u[cell] = worth[i], u[i]
                for name, values in self.told.items():
                    values[cell] = float(found[name][i])

    @property
    def failing(self) -> np.ndarray:
        """Which cells hold a failure."""
        return self.told["success"] == 0


class _Search:
    """The search of one law's failures."""

    def __init__(self, probe: Probe, hunt: Attack, seed: int):
        self.probe, self.hunt, self.seed = probe, hunt, seed
        self.domain = probe.domain
        every = points.quantities(self.domain)
        self.q, self.objects = len(every), len(self.domain.objects)
        # Moved are ranges and choices but the object, of which each has emitters of its own.
        self.moved = [
            i for i, one in enumerate(every)
            if one.kind == "range" or (one.kind == "choice" and one.name != "object")
        ]  # fmt: skip
        self.noise = np.array([i for i, one in enumerate(every) if one.kind == "noise"])
        self.object_at = next((i for i, one in enumerate(every) if one.name == "object"), None)
        self.rng = np.random.Generator(np.random.Philox(key=seed))

    def run(self, left: Callable[[], bool]) -> xr.Dataset:
        """Drawn worlds, a first generation of them, and then the emitters' while time is `left`."""
        hunt = self.hunt
        phase(self.probe.report, "drawn worlds")
        by_chance = _Archive(self.domain, hunt)
        for first in range(0, hunt.drawn, 4096):
            count = -(-min(4096, hunt.drawn - first) // self.objects)
            self._try(self.rng.random((self.objects, count, len(self.moved))), by_chance)
        chance = {
            "drawn_trials": self.probe.trials,
            "drawn_failing": int(by_chance.failing.sum()),
            "drawn_simulated": self.probe.simulated,
        }
        archive, history = _Archive(self.domain, hunt), []
        schedulers: list[Any] = []
        bars: list[float] = []  # severities from which on trials enter the emitters' archives
        before = self.probe.trials, self.probe.simulated
        phase(self.probe.report, "search")
        for generation in range(hunt.generations):
            if generation and not left():
                break
            if generation == 0:
                v = self.rng.random((self.objects, hunt.batch, len(self.moved)))
            else:
                v = stats.norm.cdf(self._reach * np.stack([one.ask() for one in schedulers]))
            _, worth = self._try(v, archive)
            rows = worth.reshape(self.objects, hunt.batch)
            for k in range(self.objects):
                if generation:
                    schedulers[k].tell(rows[k], v[k][:, self._axes])
                # From near misses, as soon as there are enough failures from these alone.
                many = archive.failing[k].sum() >= _ENOUGH
                bar = 1.0 if many else min(1.0, float(np.quantile(rows[k], 1 - _NEAR)))
                if generation == 0:
                    schedulers.append(self._scheduler(k, archive, bar))
                    bars.append(bar)
                elif many and bars[k] < 1:
                    schedulers[k], bars[k] = self._scheduler(k, archive, bar), bar
            spent = self.probe.trials - before[0], self.probe.simulated - before[1]
            history.append((int(archive.failing.sum()), *spent))
        return self._labelled(archive, history, chance)

    @property
    def _axes(self) -> list[int]:
        """Where the archive's axes stand among what is moved."""
        names = [points.names(self.domain)[i] for i in self.moved]
        return [names.index(name) for name in self.hunt.axes]

    @property
    def _reach(self) -> np.ndarray:
        """How far (moved,) the emitters' steps go, by what is moved."""
        reach = np.ones(len(self.moved))
        reach[self._axes] = _FAR
        return reach

    def _try(self, v: np.ndarray, archive: _Archive) -> tuple[xr.Dataset, np.ndarray]:
        """Worlds of all objects at what is moved, v (objects, n, moved), into an archive."""
        count = v.shape[0] * v.shape[1]
        u = self.rng.random((count, self.q))
        u[:, self.moved] = np.clip(v.reshape(count, -1), _EDGE, 1 - _EDGE)
        which = np.repeat(np.arange(self.objects), v.shape[1])
        if self.object_at is not None:
            u[:, self.object_at] = (which + 0.5) / self.objects
        found = self.probe(u)
        # One other noise sorts out most failures by chance; the rest are tried all at once.
        for times in (min(1, self.hunt.repeats - 1), self.hunt.repeats - 2):
            rows = np.flatnonzero(found.success.values == 0)
            if rows.size and times > 0:
                self._repeat(found, rows, times)
        worth = found.severity.values
        if self.hunt.aim == "time":
            failed = found.success.values == 0
            worth = found.time.values / float(self.probe.setting.rules.horizon) + failed
        archive.add(which, found, worth)
        return found, worth

    def _repeat(self, found: xr.Dataset, rows: np.ndarray, times: int) -> None:
        """Try some worlds with other noises; the least severe trial is what was found of each."""
        u = np.tile(found.u.values[rows], (times, 1))
        u[:, self.noise] = self.rng.random((len(u), self.noise.size))
        other = self.probe(u)
        for i in range(times):
            part = other.isel(world=slice(i * rows.size, (i + 1) * rows.size))
            milder = part.severity.values < found.severity.values[rows]
            for name, values in found.items():
                values.values[rows[milder]] = part[name].values[milder]

    def _scheduler(self, which: int, archive: _Archive, bar: float) -> Any:
        """New emitters for one object, whose archive holds the elites from a severity on."""
        archives, emitters = (
            errors.require("ribs.archives", "failures"),
            errors.require("ribs.emitters", "failures"),
        )
        hunt, kept = self.hunt, archive.worst[which] >= bar
        v, worth = archive.u[which][kept][:, self.moved], archive.worst[which][kept]
        z = stats.norm.ppf(np.clip(v, _EDGE, 1 - _EDGE)) / self._reach
        mae = hunt.algorithm != "cma_me"
        rate: dict[str, Any] = {"learning_rate": _RATE, "threshold_min": bar} if mae else {}
        own = archives.GridArchive(
            solution_dim=len(self.moved), dims=[hunt.cells] * 3, ranges=[(0, 1)] * 3,
            seed=self.seed + which, **rate,
        )  # fmt: skip
        own.add(z, worth, v[:, self._axes])
        made: list[Any] = []
        for i, (kind, size) in enumerate(_sizes(hunt.batch, hunt.algorithm)):
            seed = int(self.rng.integers(2**31))
            start = {"x0": z[np.argsort(-worth, kind="stable")[i % len(z)]], "seed": seed}
            if kind == "line":
                line = {"iso_sigma": _ISO, "line_sigma": _LINE, "batch_size": size}
                made.append(emitters.IsoLineEmitter(own, **line, **start))
                continue
            ranked = {"ranker": "imp" if mae else "2imp", "sigma0": _SPREAD, "batch_size": size}
            rules = {"selection_rule": "mu" if mae else "filter"}
            rules |= {"restart_rule": "basic" if mae else "no_improvement"}
            made.append(emitters.EvolutionStrategyEmitter(own, **ranked, **rules, **start))
        return errors.require("ribs.schedulers", "failures").Scheduler(own, made)

    def _labelled(
        self, archive: _Archive, history: Sequence[tuple[int, int, float]], chance: dict[str, Any]
    ) -> xr.Dataset:
        hunt, every = self.hunt, points.quantities(self.domain)
        margin = np.where(np.isfinite(archive.worst), archive.worst - 1, np.nan)
        cells = np.argwhere(archive.failing)
        cells = cells[np.argsort(-archive.worst[tuple(cells.T)], kind="stable")]
        at = tuple(cells.T)
        failing, trials, simulated = (list(column) for column in zip(*history, strict=True))
        middles = {}
        for name in hunt.axes:
            one = next(one for one in every if one.name == name)
            middle = one.range.at((np.arange(hunt.cells) + 0.5) / hunt.cells)
            middles[name] = (name, middle, {"units": one.unit})
        return xr.Dataset(
            {
                "margin": (("object", *hunt.axes), margin),
                "u": (("elite", "quantity"), archive.u[at]),
                "severity": ("elite", archive.worst[at]),
                "time": ("elite", archive.told["time"][at]),
                "left": ("elite", archive.told["left"][at]),
                "which_object": ("elite", cells[:, 0]),
                "failing": ("generation", failing),
                "trials": ("generation", trials),
                "simulated": ("generation", simulated),
            },
            {"object": list(self.domain.objects), "quantity": list(archive.names), **middles},
            chance,
        )


def _sizes(batch: int, algorithm: Algorithm) -> list[tuple[str, int]]:
    """Kinds and batch sizes of emitters that make up a batch; CMA's have about 24 worlds each."""
    lines = {"line": batch, "mixed": batch // 2}.get(algorithm, 0)
    rest = batch - lines
    count = max(1, round(rest / 24)) if rest else 0
    each = [rest // count + (i < rest % count) for i in range(count)]
    return [("line", lines)] * bool(lines) + [("cma", size) for size in each]


def yields(found: xr.Dataset) -> dict[str, float]:
    """Failing cells for each hour of simulated time, of the search and of drawn worlds.

    `times` is their ratio and `times_low` its lower end, with the exact upper end of the drawn
    worlds' count (Poisson, 95 %). Drawn worlds are taken to hit no cell twice, in their favour.
    """
    hours, drawn = float(found.simulated[-1]) / 3600, found.attrs["drawn_simulated"] / 3600
    count = found.attrs["drawn_failing"]
    own, chance = float(found.failing[-1]) / hours, count / drawn
    most = float(stats.chi2.ppf(0.975, 2 * count + 2)) / 2 / drawn
    return {
        "search": own,
        "drawn": chance,
        "times": own / chance if chance else float("inf"),
        "times_low": own / most,
    }


# --- figures -------------------------------------------------------------------------------


def archive_figure(found: xr.Dataset, axes_: Sequence[str], title: str) -> Figure:
    """The margin by which a law failed: a row for each object, a column for each pair of axes.

    A cell shows the worst trial over the third axis; a cell with a dot has a failure.
    """
    pairs = list(combinations(axes_, 2))
    objects = [str(name) for name in found.object.values]
    size = 1.5 + 3.4 * len(pairs), 1.2 + 2.7 * len(objects)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(objects), len(pairs), squeeze=False)
    most = max(0.3, float(np.nanquantile(found.margin, 0.98)))
    norm, image = TwoSlopeNorm(0, -1, most), None
    for row, name in enumerate(objects):
        for ax, (x, y) in zip(axes[row], pairs, strict=True):
            other = next(one for one in axes_ if one not in (x, y))
            worst = found.margin.isel(object=row).max(other).transpose(y, x)
            image = ax.imshow(worst, origin="lower", norm=norm, cmap="RdBu_r", aspect="auto")
            ys, xs = np.nonzero(worst.values >= 0)
            ax.plot(xs, ys, "k.", ms=2)
            for axis, of in ((ax.xaxis, x), (ax.yaxis, y)):
                values = found[of].values
                some = np.linspace(0, values.size - 1, 4).round().astype(int)
                axis.set_ticks(some, [f"{values[i]:.2g}" for i in some], fontsize=7)
                unit = f" [{found[of].attrs['units']}]".removesuffix(" [1]")
                axis.set_label_text(f"{quantity(of)}{unit}", fontsize=8)
            ax.set_facecolor("0.9")
            ax.set_title(words(name), fontsize=9)
    if image is not None:
        figure.colorbar(image, ax=axes, label="margin: severity - 1 [1; m beyond 0]", shrink=0.7)
    figure.suptitle(title, fontsize=10)
    return figure


def search_figure(found: xr.Dataset, drawn: float) -> Figure:
    """Failing cells over simulated time: of a search, and of `drawn` cells each hour."""
    figure = Figure(figsize=(5.5, 3.6), layout="constrained")
    ax = figure.subplots()
    hours = found.simulated.values / 3600
    ax.plot(hours, found.failing, "o-", ms=3, color="C3", label="search")
    ax.plot(hours, drawn * hours, "--", color="C0", label="drawn worlds, no cell twice")
    ax.set_xlabel("simulated time [h]")
    ax.set_ylabel("cells with a failure")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    return figure
