"""The commands `sweep` and `merge`: all laws in the same random worlds, and the report about them.

The design is paired: every law meets the same worlds. `execution` runs the plan of a sweep.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
import xarray as xr

from rps_jax.analysis import statistics, tables
from rps_jax.analysis.report import Picture, Section
from rps_jax.control.registry import LawsLike
from rps_jax.errors import InputError
from rps_jax.record import files, provenance
from rps_jax.record import folder as run_folder
from rps_jax.record.files import JsonObject
from rps_jax.record.options import option
from rps_jax.runs import cluster, model_panel
from rps_jax.runs.execution import run_missing, run_trials, write_dataset
from rps_jax.runs.plan import Plan, Shard, attributes_of, load_plan, open_run, shard_chunks
from rps_jax.runs.question import (
    DefaultLaws,
    DomainQuestion,
    MultiLawQuestion,
    Question,
    Run,
    call_of,
    count_true,
)
from rps_jax.runs.results import Results
from rps_jax.world import points
from rps_jax.world.domain import task_in_words


class PlanQuestion(Question[xr.Dataset]):
    """Base class of questions whose trials are those of a `plan`, the manifest of the run folder.

    The answer has the outcomes (law, world), and the drawn quantities (world) as coordinates.
    """

    STORES_ITSELF = True  # chunk by chunk, see `execution`
    plan: Plan | functools.cached_property[Plan]

    def configuration(self) -> JsonObject:
        return self.plan.configuration()

    def intro(self, results: xr.Dataset) -> str:
        return describe_plan(self.plan)

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        return plan_sections(self.plan, results, run.folder)

    def check(self) -> None:
        self.plan.check_here()

    def num_trials(self) -> int | None:
        return self.plan.num_trials

    def answer(self, run: Run) -> xr.Dataset:
        outcomes = run_trials(self.plan, run.folder, **run.batch_options)
        return write_dataset(self.labelled(outcomes, run), run.folder)

    def labelled(self, outcomes: xr.Dataset, run: Run) -> xr.Dataset:
        """Return the outcomes of all trials with the attributes of the results."""
        return outcomes.assign_attrs(self.attributes())


def describe_plan(plan: Plan) -> str:
    """Return the number and source of the worlds and the engine, in words."""
    source = f"seed {plan.setting.seed}" if plan.points is None else "points of the unit cube"
    if plan.setting.split:
        source += f", split {plan.setting.split}"
    return (
        f"{plan.worlds:,} worlds{task_in_words(plan.domain)}, {source}, "
        f"engine {plan.setting.engine}, steps of {1000 * plan.setting.physics.timestep:g} ms; "
        "every law meets the same worlds. Intervals: Wilson 95 %; bounds of failures: "
        "Clopper-Pearson 95 %."
    )


def plan_sections(plan: Plan, results: xr.Dataset, folder: Path | None) -> list[Section]:
    """Return sections on rates, differences, what success depends on, and the hardest worlds."""
    text = (
        "CVaR: mean over the worst 5 % of worlds of the least distance between contact point "
        "and target; of an object that was never touched, the whole distance. "
        f"{statistics.NOT_PROMISED}"
    )
    rows = tables.success_table(results, float(plan.setting.rules.max_lost))
    sections = [Section("Success", text, rows)]
    if results.sizes["law"] > 1:
        rows = tables.difference_table(results)
        text = "Differences of success, with 95 % intervals for paired worlds."
        sections.append(Section("Differences, world by world", text, rows))
    if rows := tables.task_table(results):
        text = "Medians and ranges of 90 % of the worlds; of failures the number of trials by kind."
        if at_once := count_true(results.time.values == 0):
            text += f" {at_once} trials fail at once: a wall crosses base or object at the start."
        sections.append(Section("Outcomes of the task", text, rows))
    if statistics.varied_quantities(results):
        # Imported late: matplotlib takes half a second.
        from rps_jax.analysis.figures.sweeps import success_curves

        picture = Picture("success", partial(success_curves, results))
        sections.append(Section("Success against the drawn quantities", "", (), picture))
    text = "Worlds in which most laws fail, and the contact point stays farthest from the target."
    hardest = statistics.hardest(results)
    rows = tables.worlds_table(results, "RUN" if folder is None else str(folder), hardest)
    return [*sections, Section("The hardest worlds", text, rows)]


@dataclass(frozen=True, kw_only=True)
class SweepOptions:
    """Options of a sweep besides its laws and worlds."""

    part: int | None = option(None, 1, 1_000_000)
    """Checkpoint interval: at most this many trials per law and object are repeated after a kill.
    By default 1024, and with many worlds a 16th of them, up to 16384."""
    points: str | Path | xr.Dataset | np.ndarray | None = None
    """Points of the domain's unit cube at which the worlds lie, instead of drawn ones: what
    world.points.worlds_at returned, or a NetCDF file of it, as points.nc of a run folder."""
    models: bool = False
    """Whether to run the same worlds also on other grounds, cones and steps and in the quasi-static
    model, and to report how much the rates depend on these."""
    shard: str = "1/1"
    """Shard K/N of the run: the N shards are run separately, and joined by `rps merge`."""
    ray: str | None = None
    """Run on the workers of a Ray cluster: auto, its HOST:PORT, or local (all of this host). Each
    worker claims a GPU, or else as many processors as workers, one by default."""

    REMOVED: ClassVar = {
        "table": "write it by `rps_jax.load(RUN).drop_dims('pose').to_dataframe().to_csv(FILE)`",
        "ray_device": "workers use GPUs unless `ray start --num-gpus 0` hides those of a host",
    }


@dataclass(frozen=True)
class Sweep(SweepOptions, PlanQuestion, DomainQuestion[xr.Dataset], MultiLawQuestion[xr.Dataset]):
    """Run every law in the same random worlds; the run can be killed and continued.

    Examples:
      >>> import rps_jax
      >>> setting = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=2.0))
      >>> laws = ("rps", "rps,v_max=0.03")
      >>> results = rps_jax.sweep(laws, "wide,objects=random_box", worlds=4, setting=setting)
      >>> dict(results.success.sizes), results.mass.dims
      ({'law': 2, 'world': 4}, ('world',))
    """

    TITLE = "Sweep over random worlds"
    QUICK: ClassVar = {"worlds": 64}

    laws: LawsLike = DefaultLaws(("rps", "nps", "aps"))
    worlds: int | None = option(None, 1, 1_000_000_000)
    """Number of worlds, of indices 0, 1, ...; by default 1000, or the whole grid of a domain with
    listed targets."""

    @functools.cached_property
    def plan(self) -> Plan:
        """Trials to run."""
        source, at = self.points, None
        count = self.worlds or (self.ranges.combinations if self.ranges.targets else 1000)
        if source is not None:
            source = files.read_dataset(Path(source)) if isinstance(source, str | Path) else source
            at = points.check_points(self.ranges, source)
            count = len(at.u)
        # A file takes longer to write than many of its trials take to run.
        chunk_size = self.part or min(max(count // 16, 1024), 16384)
        return Plan(self.ranges, count, self.chosen, self.setting, chunk_size, at)

    @property
    def parsed_shard(self) -> Shard:
        """Shard of the plan that is run."""
        return Shard.parse(self.shard)

    def check(self) -> None:
        sharded = self.parsed_shard.count > 1
        if self.points is not None and self.worlds is not None and not self.quick:
            raise InputError("worlds is not allowed with points: there is one world at each point.")
        if self.models and (self.ray or sharded):
            raise InputError("models is not allowed with ray or a shard: run it in one process.")
        if self.out is None and (self.ray or sharded):
            raise InputError("out = None is not allowed with ray or a shard: name a run folder.")
        if self.ray:
            cluster.check_registered(self.plan)
        super().check()

    def num_trials(self) -> int | None:
        """Return the number of trials of the shard, or on all models."""
        if self.models:
            return self.plan.num_trials * len(model_panel.model_plans(self.plan))
        return sum(trials.size for trials in shard_chunks(self.plan, self.parsed_shard).values())

    def answer(self, run: Run) -> xr.Dataset:
        """Run the plan; of a single shard, return its own trials (row)."""
        execute = cluster.on_cluster(self.ray) if self.ray else run_missing
        inputs = self.plan, run.folder, self.parsed_shard
        outcomes = run_trials(*inputs, execute=execute, **run.batch_options)
        if "row" in outcomes.dims:
            return outcomes
        return write_dataset(self.labelled(outcomes, run), run.folder)

    def labelled(self, outcomes: xr.Dataset, run: Run) -> xr.Dataset:
        outcomes = super().labelled(outcomes, run)
        return model_panel.add_models(outcomes, self.plan, run) if self.models else outcomes

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        if "row" in results.dims:
            text = f"When all shards are done: `{provenance.shell('merge', self.out)} --out ...`, "
            return [Section(f"Shard {self.shard}", text + "with the run folder of each shard.")]
        sections = list(super().report(results, run))
        if "model_success" in results:
            text = (
                "The same worlds with other ground stiffness, friction cones and timesteps that "
                "agree with measurements. The interval of a rate is the effect of other worlds; "
                "its range over the models is the effect of another simulation."
            )
            sections.insert(1, Section("Models", text, tables.models_table(results)))
        return sections


sweep = call_of(Sweep)


@dataclass(frozen=True)
class Merge(PlanQuestion):
    """Merge the shards of a sweep into one run folder, with its results and its report."""

    TITLE = Sweep.TITLE

    folders: tuple[Path, ...] = option((), positional=True)
    """Run folders of the shards; one, if they share it."""
    out: Path | str | None = option(None, kw_only=True)
    """Run folder for the merged sweep."""

    @property
    def sources(self) -> Sequence[Path]:
        return self.folders

    @property
    def default_folder(self) -> Path:
        return Path("runs") / self.name

    @functools.cached_property
    def plan(self) -> Plan:
        """Plan of the first shard."""
        return load_plan(Path(self.folders[0]))

    def check(self) -> None:
        if not self.folders:
            raise InputError("folders = () is not allowed: give the run folders of the shards.")
        if self.out is None:
            raise InputError("out = None is not allowed: name the run folder of the merged sweep.")

    def num_trials(self) -> int | None:
        return None

    def answer(self, run: Run) -> xr.Dataset:
        first, *rest = folders = [Path(folder) for folder in self.folders]
        out = run_folder.ensure_writable(Path(str(self.out)))
        manifest = run_folder.read_manifest(first)
        for folder in rest:
            if (shard := run_folder.read_manifest(folder)) != manifest:
                raise InputError(
                    f"run = {folder} has another plan than {first} "
                    f"({run_folder.describe_difference(manifest, shard)}): merge shards of one run."
                )
        attrs = self.attributes() | attributes_of(self.plan)
        merged = Results(self.plan).read_all(folders).assign_attrs(attrs)
        environments = [*map(provenance.read_environment, folders)]
        open_run(out, self.plan)
        for environment in environments:
            provenance.write_environment(out, environment)
        return write_dataset(merged, out)


merge = call_of(Merge)
