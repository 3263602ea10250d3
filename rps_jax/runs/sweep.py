"""Many random worlds, in memory or in a run folder that can be killed and continued, and split.

The design is paired: every law meets the same worlds. Trials are kept in parts: a part is one file,
written whole as soon as its last trial has ended, named by the hash of its content. A part that is
there is not run again.
"""

import functools
import shlex
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from rps_jax.analysis import figures, statistics, tables
from rps_jax.analysis.report import Picture, Section
from rps_jax.control import registry
from rps_jax.control.registry import LawsLike
from rps_jax.engines.device import Device
from rps_jax.errors import InputError
from rps_jax.record import files, provenance
from rps_jax.record import folder as run_folder
from rps_jax.record.checkpoint import Checkpoints
from rps_jax.record.options import option
from rps_jax.runs import results
from rps_jax.runs.plan import Kind, Plan, Shard, draw, load_plan, made, open_run, share
from rps_jax.runs.question import InDomain, OfLaws, Pushes, Question, Run, call_of, labelled
from rps_jax.trials import batch
from rps_jax.trials.batch import Job, Part
from rps_jax.trials.progress import Progress, Report, unheard
from rps_jax.world import points
from rps_jax.world.draws import table

_AHEAD = 16384  # worlds of a kind that are made before they are asked for, about


class Planned(Pushes[xr.Dataset]):
    """A question whose trials are those of a `plan`, which holds the run folder."""

    plan: Plan | functools.cached_property[Plan]  # what is run

    def check(self) -> None:
        self.plan.check_here()

    def trials(self) -> int | None:
        return self.plan.trials

    def configuration(self) -> dict[str, Any]:
        return self.plan.configuration()

    def answered(self, report: Report) -> xr.Dataset:
        """Outcomes (law, world), and what was drawn (world) as coordinates."""
        return self.answer(self.run_in(None if self.out is None else Path(self.out), report))

    def answer(self, run: Run) -> xr.Dataset:
        return whole(self.plan, run.folder, **run.shape)


@dataclass(frozen=True)
class OfPlan(Planned, InDomain[xr.Dataset], OfLaws[xr.Dataset]):
    """A question that pushes with every law in the same worlds of a plan."""

    worlds: int | None = option(None, 1, 1_000_000_000)
    """Number of worlds, of indices 0, 1, ...; by default 1000, or the whole grid of a domain with
    listed targets."""
    part: int | None = option(None, 1, 1_000_000, kw_only=True)
    """Number of trials in a part: what is lost of each law and object when killed, at most; by
    default 1024, and of many worlds a 16th, up to 16384."""

    @functools.cached_property
    def plan(self) -> Plan:
        """What is run."""
        usual = self.ranges.combinations if self.ranges.targets else 1000
        count = usual if self.worlds is None else self.worlds
        return Plan(self.ranges, count, self.chosen, self.setting, self.part or _part_of(count))

    def intro(self, found: xr.Dataset) -> str:
        return intro_of(self.plan)

    def report(self, found: xr.Dataset, run: Run) -> Sequence[Section]:
        return report_of(self.plan, found, run.folder)


def _part_of(worlds: int) -> int:
    """How many trials a part has: a file costs more than the trials in it."""
    return min(max(worlds // 16, 1024), 16384)


def intro_of(plan: Plan) -> str:
    """What a plan is, in words."""
    source = f"seed {plan.setting.seed}" if plan.points is None else "points of the unit cube"
    return (
        f"{plan.worlds:,} worlds, {source}, engine {plan.setting.engine}, steps of "
        f"{1000 * plan.setting.physics.timestep:g} ms; every law meets the same worlds. "
        "Intervals: Wilson 95 %; bounds of failures: Clopper-Pearson 95 %."
    )


def report_of(plan: Plan, found: xr.Dataset, folder: Path | None) -> list[Section]:
    """Rates, differences, what success depends on, and the hardest worlds of a plan."""
    told = [rates(found, float(plan.setting.rules.max_lost))]
    if found.sizes["law"] > 1:
        rows = tables.difference_table(found)
        told.append(Section("Differences, world by world", "", rows))
    if statistics.varied_quantities(found):
        picture = Picture("success", lambda: figures.success_curves(found))
        told.append(Section("Success against what was drawn", "", (), picture))
    text = "Worlds in which most laws fail, and most distance is left."
    rows = tables.hardest_table(found, "RUN" if folder is None else str(folder))
    return [*told, Section("The hardest worlds", text, rows)]


def rates(found: xr.Dataset, max_lost: float) -> Section:
    """Success of each law."""
    text = (
        "CVaR: mean over the worst 5 % of worlds of the least distance between contact point "
        "and target; of an object that was never touched, the whole way. "
        f"{statistics.NOT_PROMISED}"
    )
    return Section("Success", text, tables.success_table(found, max_lost))


@dataclass(frozen=True)
class SweepOptions:
    """Options of a sweep besides its laws and worlds."""

    points: str | Path | xr.Dataset | np.ndarray | None = field(default=None, kw_only=True)
    """Points of the domain's unit cube at which the worlds lie, instead of drawn ones: what
    world.points.worlds_at returned, or a NetCDF file of it, as points.nc of a run folder."""
    models: bool = field(default=False, kw_only=True)
    """Whether to run the same worlds on other grounds, cones and steps and in the quasi-static
    model, too, and to report how much the rates hang on these."""
    shard: str = field(default="1/1", kw_only=True)
    """Share K/N of the run: the N shares are run apart, and joined by `rps merge`."""
    ray: str | None = field(default=None, kw_only=True)
    """Run on the workers of a Ray cluster: auto, its HOST:PORT, or local (all of this host). Each
    worker claims a GPU, or else as many processors as workers, one by default."""
    ray_device: Device = field(default="auto", kw_only=True)
    """Device of the cluster's workers."""
    table: Path | str | None = field(default=None, kw_only=True)
    """File for a table with one row for each law and world: NAME.csv, or NAME.parquet (needs
    pyarrow). NAME.columns.csv beside it tells units and meanings of the columns."""


@dataclass(frozen=True)
class Sweep(SweepOptions, OfPlan):
    """Push in many random worlds, every law in the same ones; the run can be continued.

    Example:
      >>> import rps_jax
      >>> setting = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=2.0))
      >>> laws = ("rps", "rps,v_max=0.03")
      >>> found = rps_jax.sweep(laws, "wide,objects=random_box", worlds=4, setting=setting)
      >>> dict(found.success.sizes), found.mass.dims
      ({'law': 2, 'world': 4}, ('world',))
    """

    TITLE: ClassVar[str] = "Sweep over random worlds"
    SMALL: ClassVar[Mapping[str, Any]] = {"worlds": 64}

    laws: LawsLike = ("rps", "nps", "aps")

    @functools.cached_property
    def plan(self) -> Plan:
        plan = super().plan
        if self.points is None:
            return plan
        given = self.points
        if isinstance(given, str | Path):
            given = files.read_dataset(Path(given))
        at = points.checked(self.ranges, given)
        part = self.part or _part_of(len(at.u))
        return Plan(self.ranges, len(at.u), self.chosen, self.setting, part, at)

    @property
    def share(self) -> Shard:
        """The share of the plan that is run."""
        return Shard.named(self.shard)

    def check(self) -> None:
        if self.points is not None and self.worlds is not None:
            raise InputError("worlds is not allowed with points: these say how many.")
        if self.table is not None:
            if self.share.of > 1:
                raise InputError("table is not allowed with a shard: it is of all worlds.")
            results.check_table(Path(self.table))
        if self.models and (self.ray or self.share.of > 1):
            raise InputError("models is not allowed with ray or a shard: run it in one process.")
        if self.out is None and (self.ray or self.share.of > 1):
            raise InputError("out = None is not allowed with ray or a shard: name a run folder.")
        if not self.ray:
            super().check()

    def trials(self) -> int | None:
        """How many trials its share has."""
        return sum(numbers.size for numbers in share(self.plan, self.share).values())

    def answered(self, report: Report) -> xr.Dataset:
        found = super().answered(report)
        if self.table is not None:
            results.write_table(found, Path(self.table))
        return found

    def answer(self, run: Run) -> xr.Dataset:
        """Run what is missing; of a share alone, return its own trials (row)."""
        if run.folder is None or (not self.ray and self.share.of == 1):
            found = whole(self.plan, run.folder, **run.shape)
        else:
            by = run_missing
            if self.ray:
                from rps_jax.runs import cluster

                by = cluster.on_cluster(self.ray, self.ray_device)
            joined = complete(run.folder, self.plan, self.share, by=by, **run.shape)
            if joined is None:
                return own_trials(run.folder, self.plan, self.share)
            found = labelled(joined)
        if self.models:
            from rps_jax.runs import models

            found = models.added(found, self.plan, run)
        return found

    def report(self, found: xr.Dataset, run: Run) -> Sequence[Section]:
        if "row" in found.dims:
            text = f"When all shards are done: `rps merge {shlex.quote(str(self.out))} --out ...`."
            return [Section(f"Share {self.shard}", text)]
        first, *others = super().report(found, run)
        return [first, *spread(found), *others]


def spread(found: xr.Dataset) -> list[Section]:
    """How much the rates hang on the model, if it was asked for."""
    if "model_success" not in found:
        return []
    text = (
        "The same worlds on other grounds, cones and steps that can be defended. A rate's interval "
        "says what other worlds would have given; its range over the models says what another "
        "simulation would have."
    )
    return [Section("Models", text, tables.models_table(found))]


sweep = call_of(Sweep)


@dataclass(frozen=True)
class Merge(Question[xr.Dataset]):
    """Merge the shards of a sweep into one run folder, with its results and its report."""

    TITLE: ClassVar[str] = Sweep.TITLE

    folders: tuple[Path, ...] = option((), positional=True)
    """Run folders of the shards; one, if they share it."""
    out: Path | str | None = option(None, kw_only=True)
    """Run folder of the whole."""

    def check(self) -> None:
        if not self.folders:
            raise InputError("folders = () is not allowed: give the run folders of the shards.")
        if self.out is None:
            raise InputError("out = None is not allowed: name the run folder of the whole.")

    def answered(self, report: Report) -> xr.Dataset:
        folders = [Path(one) for one in self.folders]
        out = run_folder.ensure_writable(Path(str(self.out)))
        manifest = run_folder.read_manifest(folders[0])
        for other in folders[1:]:
            if (theirs := run_folder.read_manifest(other)) != manifest:
                raise InputError(
                    f"run = {other} is of another plan than {folders[0]} "
                    f"({run_folder.describe_difference(manifest, theirs)}): merge shards of one "
                    "run."
                )
        plan = load_plan(folders[0])
        found = results.gather(plan, folders, open_run(out, plan))
        for one in folders:
            provenance.write_environment(out, provenance.read_environment(one))
        return labelled(found)

    def intro(self, found: xr.Dataset) -> str:
        return intro_of(load_plan(Path(str(self.out))))

    def report(self, found: xr.Dataset, run: Run) -> Sequence[Section]:
        return report_of(load_plan(Path(str(self.out))), found, run.folder)


merge = call_of(Merge)


def whole(plan: Plan, out: Path | None, *, report: Report = unheard, **shape: Any) -> xr.Dataset:
    """All results of a plan, in a run folder, in which it can be continued, or in memory alone."""
    if out is not None:
        found = complete(out, plan, report=report, **shape)
        assert found is not None
        return labelled(found)
    made: dict[int, results.Part] = {}
    every: dict[Kind, list[int]] = {}
    for number in plan.parts:
        every.setdefault(plan.kind(number), []).append(number)
    work(plan, every, made.__setitem__, report=report, **shape)
    return labelled(results.dataset(plan, made.items()))


def own_trials(folder: Path, plan: Plan, shard: Shard) -> xr.Dataset:
    """Outcomes (row) of a shard's own trials, with the law and the world of each."""
    own = share(plan, shard)
    kept = Checkpoints(folder).items([results.name_of(number) for number in own])
    parts = ((int(name), results.decoded(int(name), content)) for name, content in kept)
    found = results.dataset(plan, parts)
    law, world = np.divmod(np.concatenate(list(own.values())), plan.worlds)
    at = {"law": xr.DataArray(law, dims="row"), "world": xr.DataArray(world, dims="row")}
    return found[list(results.UNITS)].isel(at)


def run_missing(
    folder: Path,
    plan: Plan,
    *,
    shard: Shard = Shard(),
    report: Report = unheard,
    **shape: Any,
) -> dict[int, results.Part]:
    """Run what is missing of a plan, or of one shard of it, in a folder that `open_run` opened.

    Returns the parts that were made, of a whole plan.
    """
    made = {}
    missing, before = remaining(folder, plan, shard)
    report(Progress(before, 0.0))
    if missing:
        provenance.write_environment(folder)

    def tell(progress: Progress) -> None:
        report(replace(progress, finished=before + progress.finished))

    def keep(number: int, part: results.Part) -> None:
        store(folder, number, results.encoded(part))
        if shard.of == 1:
            made[number] = part

    work(plan, missing, keep, report=tell, **shape)
    return made


def complete(
    folder: Path,
    plan: Plan,
    shard: Shard = Shard(),
    *,
    by: Callable[..., Any] = run_missing,
    **options: Any,
) -> xr.Dataset | None:
    """Run what a folder lacks of a plan, and gather the whole in `results.nc`; or run one shard.

    `by` runs it with its `options`, as `run_missing` or `cluster.run_on_cluster`.
    """
    open_run(folder, plan)
    with run_folder.lock(folder, shard.number, shard.of):
        made = by(folder, plan, shard=shard, **options) or {}
        return results.gather(plan, [folder], folder, made) if shard.of == 1 else None


def work(
    plan: Plan,
    numbers: Mapping[Kind, Iterable[int]],
    keep: results.Keep,
    *,
    report: Callable[[Progress], Any],
    **shape: Any,
) -> None:
    """Run some parts of a plan: of each kind those with these numbers, asked for one by one.

    There are as many slots as the whole plan has use for, whatever parts are run, so that a part
    has the same bits whoever runs it, and with whatever other parts.
    """
    jobs, collector = [], results.Collector(plan, keep)
    for kind, some in numbers.items():
        parts = _made(plan, some, collector)
        if isinstance(some, Sequence):  # what is asked for elsewhere is asked for when it is needed
            parts = _ahead(parts, max(1, _AHEAD // plan.part))
        jobs.append(Job(registry.law_of(kind[1]), plan.sizes[kind], parts))
    batch.run(jobs, plan.setting, collect=collector.collect, report=report, **shape)


def remaining(folder: Path, plan: Plan, shard: Shard) -> tuple[dict[Kind, list[int]], int]:
    """Parts of a shard that a run folder lacks, by kind, and how many trials it has."""
    done = Checkpoints(folder).paths()
    missing: dict[Kind, list[int]] = {}
    before = 0
    for number, trials in share(plan, shard).items():
        if results.name_of(number) in done:
            before += trials.size
        else:
            missing.setdefault(plan.kind(number), []).append(number)
    return missing, before


def _made(plan: Plan, numbers: Iterable[int], collector: results.Collector) -> Iterator[Part]:
    """The worlds of parts, made one part at a time; the first law's keep what was drawn."""
    for number in numbers:
        trials, (law, _) = plan.parts[number], plan.law_and_object(number)
        drawn = draw(plan, trials % plan.worlds)
        if law == 0:
            collector.drawn[number] = table(drawn)
        yield made(plan, law, drawn)._replace(numbers=trials)


def _ahead(parts: Iterator[Part], count: int) -> Iterator[Part]:
    """Prefetch worlds: make `count` parts ahead while the ones before them run."""
    with ThreadPoolExecutor(1) as maker:
        coming = deque(maker.submit(next, parts, None) for _ in range(count))
        while (part := coming.popleft().result()) is not None:
            coming.append(maker.submit(next, parts, None))
            yield part


def store(folder: Path, part: int, content: bytes) -> Path:
    """Write the file of a part into a run folder, whole or not at all."""
    return Checkpoints(folder).put(results.name_of(part), content, ".npz", new=True)
