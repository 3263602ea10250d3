"""A search for failures of many kinds, by quality and diversity (pyribs).

An archive has a cell for each small range of three quantities, and of each object of the domain;
in a cell stands the severest trial that was met there. Emitters propose worlds: some follow
CMA-ME or CMA-MAE (Fontaine and Nikolaidis, 2020 and 2023) towards where the archive improves, some
mix elites along lines between them (Vassiliades and Mouret, 2018). Into their archives only near
misses and failures are let, and failures alone when there are enough of these. They move in the
normal quantiles of what the domain draws from ranges; of the others, noise and corners of prisms,
every world has its own, by chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import xarray as xr
from scipy import stats

from rps_jax import errors
from rps_jax.control.strategies import Params
from rps_jax.errors import InputError
from rps_jax.record import folder as run_folder
from rps_jax.runs.evaluate import seed_of
from rps_jax.studies.failures.probe import Probe, need
from rps_jax.trials.setting import Report, Setting, unheard
from rps_jax.world import points
from rps_jax.world.domain import Domain

Algorithm = Literal["cma_me", "cma_mae", "line", "mixed"]
Aim = Literal["distance", "time"]
AXES = ("size", "com_offset", "friction_robot")
_EDGE = 1e-6  # least distance of a coordinate to the ends of its range
_RATE = 0.1  # [1] learning rate of the archive's thresholds, of CMA-MAE
_ISO, _LINE, _SPREAD = 0.2, 0.1, 0.3  # [1] steps of the emitters, in normal quantiles
_FAR = 4.0  # [1] how much farther than the others the archive's axes move
_NEAR = 0.1  # [1] share of the first worlds whose severity lets a world into an archive
_ENOUGH = 12  # failing cells of an object, from which on only failures are let in


@dataclass(frozen=True)
class Hunt:
    """How failures are looked for."""

    axes: tuple[str, ...] = AXES
    """Three quantities of the domain, whose ranges the archive's cells divide."""
    cells: int = 10
    """Number of cells along each axis."""
    aim: Aim = "distance"
    """What is worst: most distance left (failures), or most time (slow successes, too)."""
    algorithm: Algorithm = "mixed"
    """How worlds are proposed: cma_me, cma_mae, line (mixtures of elites), or half of each line
    and cma_mae."""
    batch: int = 96
    """Number of worlds of a generation, for each object."""
    generations: int = 1000
    """Number of generations, at most."""
    minutes: float = 5.0
    """Wall-clock time of the search after which no generation begins [min]."""
    repeats: int = 2
    """Number of trials that differ in noise alone, in all of which a world must fail; the least
    severe one counts. Only worlds that failed are tried again."""
    drawn: int = 512
    """Number of drawn worlds beside it, with which it is compared."""

    def check(self, domain: Domain) -> None:
        """Raises InputError for what means nothing, axes that the domain lacks, or no pyribs."""
        if len(self.axes) != 3:
            raise InputError(f"axes = {self.axes} is not allowed: name three quantities.")
        errors.check_each_once("axes", self.axes)
        for name in self.axes:
            points.check_drawn("axes", name, domain)
        errors.check_count("cells", self.cells, at_least=2, at_most=100)
        errors.check_name("aim", self.aim, get_args(Aim))
        errors.check_name("algorithm", self.algorithm, get_args(Algorithm))
        errors.check_count("batch", self.batch, at_least=8, at_most=1_000_000)
        errors.check_count("generations", self.generations, at_most=1_000_000)
        errors.check_finite("minutes", self.minutes, above=0, at_most=1e5)
        errors.check_count("repeats", self.repeats, at_most=100)
        errors.check_count("drawn", self.drawn, at_most=10_000_000)
        need("ribs", "ribs")


class _Archive:
    """The worst trial of every cell, and when it was met."""

    def __init__(self, domain: Domain, hunt: Hunt):
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


def attack(
    params: Params,
    domain: Domain | str = "wide",
    seed: int = 0,
    hunt: Hunt = Hunt(),
    out: str | Path | None = None,
    *,
    setting: Setting = Setting(engine="fused"),
    slots: int | None = None,
    workers: int | None = None,
    report: Report = unheard,
) -> xr.Dataset:
    """Worlds in which a law fails, one for every cell of three quantities where one was found.

    Args:
      params: of any strategy.
      domain: ranges of what differs between worlds, or their name in `DOMAINS`.
      seed: of the search; its worlds are points of its own, of no split.
      hunt: what is looked for, and how.
      out: run folder, in which a search that was killed is continued; None keeps all in memory.
      setting: physics, engine and rules.
      slots: worlds stepped at once by a worker, in each shape family.
      workers: host threads; by default as suits engine and device.
      report: called after every segment of the run.

    Returns:
      The margin `severity - 1` by cell (object, and three axes), NaN where no world was tried;
      elites that fail, worst first, `u` (elite, quantity) with `severity`, `time` and `left`; and
      (generation) `failing` cells, `trials` and `simulated` seconds so far. Of drawn worlds: the
      attributes `drawn_failing` cells and `drawn_simulated` seconds.

    Raises:
      InputError: an argument is not allowed, pyribs is missing, or `out` holds another run.

    Example:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=1.0)
      >>> brief = rps_jax.Hunt(cells=2, algorithm="line", batch=8, generations=1, drawn=8)
      >>> setting = rps_jax.Setting(rules=rules, engine="fused")
      >>> found = rps_jax.attack(rps_jax.RPSParams.paper(), drums, hunt=brief, setting=setting)
      >>> found.margin.dims
      ('object', 'size', 'com_offset', 'friction_robot')
    """
    domain = points.named(domain)
    hunt.check(domain)
    errors.check_count("seed", seed, at_least=0, at_most=2**30)
    probe = Probe(
        domain, params, setting, None if out is None else Path(out), slots, workers, report
    )
    if probe.folder is not None:
        how = {k: v for k, v in asdict(hunt).items() if k not in ("minutes", "generations")}
        asked = {"study": "attack", "seed": seed, "hunt": how}
        run_folder.claim(probe.folder, asked | probe.configuration())
    return _Search(probe, hunt, seed_of(seed, "tune")).run()


class _Search:
    """The search of one law's failures."""

    def __init__(self, probe: Probe, hunt: Hunt, seed: int):
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

    def run(self) -> xr.Dataset:
        """Drawn worlds, a first generation of them, and then the emitters'."""
        hunt = self.hunt
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
        spent, before = 0.0, (self.probe.trials, self.probe.simulated)
        for generation in range(hunt.generations):
            if spent >= 60 * hunt.minutes:
                break
            if generation == 0:
                v = self.rng.random((self.objects, hunt.batch, len(self.moved)))
            else:
                v = stats.norm.cdf(self._reach * np.stack([one.ask() for one in schedulers]))
            found, worth = self._try(v, archive)
            spent += float(found.attrs["wall"])
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
            history.append(
                (
                    int(archive.failing.sum()),
                    self.probe.trials - before[0],
                    self.probe.simulated - before[1],
                )
            )
        return self._labelled(archive, history, chance | {"seconds": spent})

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
        found.attrs["wall"] = float(found.attrs["wall"]) + float(other.attrs["wall"])
        for i in range(times):
            part = other.isel(world=slice(i * rows.size, (i + 1) * rows.size))
            milder = part.severity.values < found.severity.values[rows]
            for name, values in found.items():
                values.values[rows[milder]] = part[name].values[milder]

    def _scheduler(self, which: int, archive: _Archive, bar: float) -> Any:
        """New emitters for one object, whose archive holds the elites from a severity on."""
        archives, emitters = need("ribs.archives", "ribs"), need("ribs.emitters", "ribs")
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
        return need("ribs.schedulers", "ribs").Scheduler(own, made)

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
            {
                "object": list(self.domain.objects),
                "quantity": [one.name for one in every],
                **middles,
            },
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


def again(
    found: xr.Dataset,
    probe: Probe,
    count: int,
) -> xr.Dataset:
    """Some of the elites once more, evenly from worst to least bad, by another engine or setting.

    Returns:
      Outcomes (world), whose `elite` says which they are of.
    """
    total = found.sizes["elite"]
    some = np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int))
    return probe(found.u.values[some]).assign_coords(elite=("world", some))
