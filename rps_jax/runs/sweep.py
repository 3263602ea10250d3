"""The commands `sweep` and `merge`: all laws in the same random worlds, and the report about them.

The design is paired: every law meets the same worlds. `execution` runs the plan of a sweep.
"""

import functools
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from rps_jax.analysis import figures, statistics, tables
from rps_jax.analysis.report import Picture, Section
from rps_jax.control.registry import LawsLike
from rps_jax.engines.device import Device
from rps_jax.errors import InputError
from rps_jax.record import files, provenance
from rps_jax.record import folder as run_folder
from rps_jax.record.options import option
from rps_jax.runs import cluster, model_panel, results
from rps_jax.runs.execution import run_in_folder, run_missing, run_plan, shard_results
from rps_jax.runs.plan import Plan, Shard, load_plan, open_run, shard_chunks
from rps_jax.runs.question import (
    DomainQuestion,
    MultiLawQuestion,
    Question,
    Run,
    SimulationQuestion,
    call_of,
    with_coordinates,
)
from rps_jax.trials.progress import ProgressCallback
from rps_jax.world import points


class PlanQuestion(SimulationQuestion[xr.Dataset]):
    """A question whose trials are those of a `plan`, which holds the run folder."""

    plan: Plan | functools.cached_property[Plan]  # what is run

    def check(self) -> None:
        self.plan.check_here()

    def num_trials(self) -> int | None:
        return self.plan.num_trials

    def configuration(self) -> dict[str, Any]:
        return self.plan.configuration()

    def execute(self, callback: ProgressCallback) -> xr.Dataset:
        """Outcomes (law, world), and what was drawn (world) as coordinates."""
        return self.answer(self.create_run(None if self.out is None else Path(self.out), callback))

    def answer(self, run: Run) -> xr.Dataset:
        return run_plan(self.plan, run.folder, **run.batch_options)


@dataclass(frozen=True)
class SweepQuestion(PlanQuestion, DomainQuestion[xr.Dataset], MultiLawQuestion[xr.Dataset]):
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

    def intro(self, results: xr.Dataset) -> str:
        return intro_of(self.plan)

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        return report_of(self.plan, results, run.folder)


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
    told = [success_section(found, float(plan.setting.rules.max_lost))]
    if found.sizes["law"] > 1:
        rows = tables.difference_table(found)
        told.append(Section("Differences, world by world", "", rows))
    if statistics.varied_quantities(found):
        picture = Picture("success", lambda: figures.success_curves(found))
        told.append(Section("Success against what was drawn", "", (), picture))
    text = "Worlds in which most laws fail, and most distance is left."
    rows = tables.hardest_table(found, "RUN" if folder is None else str(folder))
    return [*told, Section("The hardest worlds", text, rows)]


def success_section(found: xr.Dataset, max_lost: float) -> Section:
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
class Sweep(SweepOptions, SweepQuestion):
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
    QUICK: ClassVar[Mapping[str, Any]] = {"worlds": 64}

    laws: LawsLike = ("rps", "nps", "aps")

    @functools.cached_property
    def plan(self) -> Plan:
        plan = super().plan
        if self.points is None:
            return plan
        given = self.points
        if isinstance(given, str | Path):
            given = files.read_dataset(Path(given))
        at = points.check_points(self.ranges, given)
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

    def num_trials(self) -> int | None:
        """How many trials its share has."""
        return sum(numbers.size for numbers in shard_chunks(self.plan, self.share).values())

    def execute(self, callback: ProgressCallback) -> xr.Dataset:
        found = super().execute(callback)
        if self.table is not None:
            results.write_table(found, Path(self.table))
        return found

    def answer(self, run: Run) -> xr.Dataset:
        """Run what is missing; of a share alone, return its own trials (row)."""
        if run.folder is None or (not self.ray and self.share.of == 1):
            found = run_plan(self.plan, run.folder, **run.batch_options)
        else:
            by = run_missing
            if self.ray:
                by = cluster.on_cluster(self.ray, self.ray_device)
            joined = run_in_folder(run.folder, self.plan, self.share, by=by, **run.batch_options)
            if joined is None:
                return shard_results(run.folder, self.plan, self.share)
            found = with_coordinates(joined)
        if self.models:
            found = model_panel.add_models(found, self.plan, run)
        return found

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        if "row" in results.dims:
            text = f"When all shards are done: `rps merge {shlex.quote(str(self.out))} --out ...`."
            return [Section(f"Share {self.shard}", text)]
        first, *others = super().report(results, run)
        return [first, *models_section(results), *others]


def models_section(found: xr.Dataset) -> list[Section]:
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

    def execute(self, callback: ProgressCallback) -> xr.Dataset:
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
        return with_coordinates(found)

    def intro(self, results: xr.Dataset) -> str:
        return intro_of(load_plan(Path(str(self.out))))

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        return report_of(load_plan(Path(str(self.out))), results, run.folder)


merge = call_of(Merge)
