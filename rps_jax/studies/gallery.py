"""Gallery of failures: maps of failed trials by failure mode, and what each mode has in common."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xarray as xr
from matplotlib.artist import setp

from rps_jax import errors
from rps_jax.analysis import statistics, tables
from rps_jax.analysis.figures.paper import draw_path
from rps_jax.analysis.figures.style import WIDTH, Figure, styled, tiles
from rps_jax.questions import Picture, Plan, Run, Section, call_of, option
from rps_jax.record import files, provenance
from rps_jax.runs.plan import build_batch
from rps_jax.runs.push import find_differences, program_slots, select_law
from rps_jax.runs.question import Question, Rows
from rps_jax.trials import pushes
from rps_jax.trials.progress import SequentialProgress
from rps_jax.trials.results import trace_dataset

_COLUMNS = 4  # of maps, at most
_PASSED = 0.8  # [1] share of a path before which its end is not near
NEAR = 0.2  # [m] least distance below which a timeout is near the target


def failure_modes(trials: xr.Dataset, max_lost: float) -> np.ndarray:
    """Return the failure mode (world,) of the trials of one law; "" for a success."""
    modes = np.array([*statistics.modes(), ""])[statistics.failure_modes(trials, max_lost)]
    near = (trials.min_distance < NEAR) & (trials.get("progress", 1.0) > _PASSED)
    timeouts = np.where(near, "timeout near the target", "timeout far from the target")
    return np.where(modes == "timeout", timeouts, modes)


@dataclass(frozen=True)
class Gallery(Question[xr.Dataset]):
    """Plot failed worlds of a sweep by failure mode.

    The result has, by world, the failure mode `kind`, empty for a success, beside the outcomes and
    the drawn quantities.

    Examples:
      >>> import tempfile
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> with tempfile.TemporaryDirectory() as run:
      ...     sweep = rps_jax.sweep("rps", drums, worlds=2, setting=setting, out=run)
      ...     results = rps_jax.gallery(run)
      >>> results.kind.values.tolist()
      ['never touched', 'never touched']
    """

    run: str | Path = option("", positional=True)
    """Run folder of a sweep or a ladder."""
    law: str | None = None
    """Law of the run; by default its first."""
    against: str | None = None
    """Another law of the run: only worlds in which it succeeds are plotted, and all are listed."""
    each: int = option(30, 1, 200)
    """Maximum number of trials of each failure mode to simulate again and plot."""

    @property
    def sources(self) -> Sequence[str | Path]:
        return (self.run,)

    @property
    def title(self) -> str:
        only = f" where {self.against} succeeds" if self.against else ""
        return f"Failures of {self.plan_and_law[1]}{only}"

    @property
    def plan_and_law(self) -> tuple[Plan, str]:
        """Plan of the run, and name of the law."""
        return select_law(Path(self.run), 0, self.law)

    def check(self) -> None:
        _, law = self.plan_and_law
        if self.against == law:
            raise errors.not_allowed("against", self.against, "name another law than law")
        select_law(Path(self.run), 0, self.against)

    def answer(self, run: Run) -> xr.Dataset:
        plan, law = self.plan_and_law
        results = files.read_results(Path(self.run))
        trials = results.sel(law=law)
        modes = failure_modes(trials, float(plan.setting.rules.max_lost))
        if self.against:
            modes[results.success.sel(law=self.against) == 0] = ""
        return trials.assign(kind=("world", modes))

    def intro(self, results: xr.Dataset) -> str:
        maps = "The maps show the outlines of base and object at the start (pale) and at the end."
        return f"Run {self.run}: failure modes. {maps}"

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        plan, law = self.plan_and_law
        kinds, size, sections = results.kind.values, results.sizes["world"], []
        worlds = {mode: np.flatnonzero(kinds == mode) for mode in sorted({*kinds.tolist()} - {""})}
        all_plotted = [np.zeros(0, int), *(indices[: self.each] for indices in worlds.values())]
        progress = SequentialProgress(run.callback)
        traces = _simulate(Path(self.run), plan, law, np.concatenate(all_plotted), progress)
        if self.against:
            pair = files.read_results(Path(self.run)).sel(law=[law, self.against])
            rows = tables.worlds_table(pair, str(self.run), np.flatnonzero(kinds != ""))
            sections.append(Section(f"Worlds in which only {law} fails", "", rows))
        for mode, indices in worlds.items():
            plotted = {i: traces[i] for i in indices[: self.each].tolist()}
            title = f"{law}: {mode}, {len(plotted)} of {indices.size} in {size} worlds"
            command = provenance.shell("replay", self.run, indices[0], "--law", law)
            text = f"Example: `{command}`."
            picture = Picture(mode.replace(" ", "_"), partial(maps_figure, plotted, title))
            rows = trials_table(plotted)
            sections.append(Section(f"{mode}: {indices.size} of {size}", text, rows, picture))
        return sections


gallery = call_of(Gallery)


def _simulate(
    run: Path, plan: Plan, law: str, worlds: np.ndarray, progress: SequentialProgress
) -> Mapping[int, xr.Dataset]:
    """Return traces of trials of a law over time, by world; one batch for each object.

    The attribute `differs` says whether a trial ends otherwise than in the sweep.
    """
    traces: dict[int, xr.Dataset] = {}
    objects = plan.object_of(worlds)
    for k in np.unique(objects):
        rows = worlds[objects == k]
        batch, slots = build_batch(plan, law, rows), program_slots(run, plan, law, int(rows[0]))
        options: Any = {"interval": 0.5, "slots": slots, "callback": progress}
        trajectories = pushes.record_batch(batch, plan.setting, **options)
        progress.finish(rows.size)
        outcomes = jax.tree.map(lambda *x: np.stack(x), *(x.outcome for x in trajectories))
        differ = find_differences(run, law, rows.tolist(), outcomes)
        for i, trajectory, differs in zip(rows.tolist(), trajectories, differ, strict=True):
            traces[i] = trace_dataset(trajectory).assign_attrs(differs=bool(differs))
    return traces


def trials_table(traces: Mapping[int, xr.Dataset]) -> Rows:
    """Return a row for the trace of each world: its end, and the path of the base."""
    rows = [["world", "end", "least distance", "path of the base"]]
    for world, trace in traces.items():
        end, path = f"{float(trace.outcome_time):.0f} s", float(trace.outcome_path_length)
        end += ", ends otherwise than in the sweep" * trace.attrs.get("differs", False)
        rows.append([str(world), end, _miss(trace), f"{path:.1f} m"])
    return rows


def _miss(trace: xr.Dataset) -> str:
    """Return the least distance of contact point and target in words."""
    distance = float(trace.outcome_min_distance)
    return f"{distance:.2f} m left" if np.isfinite(distance) else "untouched"


@styled
def maps_figure(traces: Mapping[int, xr.Dataset], title: str) -> Figure:
    """Draw a map of the trial of each world."""
    columns = min(_COLUMNS, len(traces))
    width = WIDTH / max(2, columns)
    figure, axes = tiles(len(traces), columns, (width, width + 0.1), (0, 0.8))
    for ax, (world, trace) in zip(axes.ravel(), traces.items(), strict=False):
        draw_path(ax, trace, snapshots=2)
        ax.set_title(f"world {world}, {_miss(trace)}")
    setp(axes[-1].tolist(), xlabel="x [m]")
    setp(axes[:, 0].tolist(), ylabel="y [m]")
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3 * min(2, columns))
    characters = int(15 * figure.get_figwidth())
    figure.suptitle(textwrap.fill(title, characters, break_on_hyphens=False))
    return figure
