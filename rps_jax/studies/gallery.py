"""What the losses of a law look like: maps of them by kind, and what each kind has in common."""

import functools
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from scipy import stats

from rps_jax.analysis import statistics
from rps_jax.analysis.figures.style import Figure, base_patch, tiles
from rps_jax.analysis.report import Picture, Section
from rps_jax.control import registry
from rps_jax.record import files
from rps_jax.record.options import option
from rps_jax.runs.plan import Plan, build_batch
from rps_jax.runs.push import another_engine, select_law
from rps_jax.runs.question import Question, Run, call_of
from rps_jax.trials import pushes, results
from rps_jax.trials.progress import SequentialProgress
from rps_jax.world.domain import WORDS

_COLUMNS = 6  # of maps
NEAR = 0.2  # [m] a trial that came nearer than this and ran out of time circles its target
# What is seen in the maps of each kind; a timeout is one of two.
MECHANISMS = {
    "never touched": "The skin never felt the object: it slid away on slippery ground before the "
    "base came, or creeps there by itself, which objects of low friction do in steps of 10 ms and "
    "not of 5 ms, or the taxels that it met are dead.",
    "lost contact": "The object slid off the base's front, and the base, which does not see it, "
    "went on without it.",
    "timeout near the target": "The base came within reach and circled: it realigned or turned "
    "round the contact point instead of bringing it in.",
    "timeout far from the target": "The base pushed to and fro at the ends of a wide face: each "
    "realignment slides along the whole face, and time runs out on the way.",
    "fell over": "A tall, narrow object on rough ground tipped over the edge that it was pushed "
    "against, often at the first push.",
    "stalled": "The push needed more force than the base has.",
    "diverged": "The physics became NaN or ran away: no loss of the law, but of the simulation.",
}


def kinds(one: xr.Dataset, max_lost: float) -> np.ndarray:
    """What kind of loss each world (world,) is, of `MECHANISMS`; empty for a success."""
    names = np.array([*statistics.FAILURES, ""], dtype=object)
    found = names[statistics.failure_modes(one, max_lost)]
    near = one.min_distance.values < NEAR
    timeout = found == "timeout"
    found[timeout & near] = "timeout near the target"
    found[timeout & ~near] = "timeout far from the target"
    return found.astype(str)


def in_common(one: xr.Dataset, mask: np.ndarray, most: int = 4) -> list[tuple[str, float, float]]:
    """Drawn quantities in which some worlds differ most from all: name, their median, and that.

    How much they differ is the probability that a world of theirs has more of it than another,
    away from one half (the statistic of Mann and Whitney); less than 0.1 away is not told.
    """
    found = []
    for name in statistics.varied_quantities(one):
        values = one[name].values.astype(float)
        mine = values[mask & np.isfinite(values)]
        if mine.size < 3:
            continue
        more = stats.mannwhitneyu(mine, np.nan_to_num(values, nan=np.inf)).statistic
        away = abs(more / (mine.size * values.size) - 0.5)
        found.append((away, name, float(np.median(mine)), float(np.nanmedian(values))))
    ranked = sorted(found, reverse=True)[:most]
    return [(name, mine, usual) for away, name, mine, usual in ranked if away >= 0.1]


@dataclass(frozen=True)
class Gallery(Question[xr.Dataset]):
    """Draw maps of what a law of a sweep lost, by kind, and say what each kind has in common.

    The answer holds, by world, `kind`, empty for a success, with the outcomes and what was drawn.

    Example:
      >>> import tempfile
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> with tempfile.TemporaryDirectory() as run:
      ...     made = rps_jax.sweep("rps", drums, worlds=2, setting=setting, out=run)
      ...     found = rps_jax.gallery(run)
      >>> found.kind.values.tolist()
      ['never touched', 'never touched']
    """

    run: str | Path = option("", positional=True)
    """Run folder of a sweep or a ladder."""
    law: str | None = None
    """Which of its laws; by default the first."""
    each: int = option(30, 1, 200)
    """Number of trials of each kind that are followed again and drawn, at most."""

    @property
    def title(self) -> str:
        return f"Losses of {select_law(Path(self.run), 0, self.law)[1]}"

    @property
    def default_folder(self) -> Path:
        return Path(self.run) / "gallery"

    def check(self) -> None:
        select_law(Path(self.run), 0, self.law)

    def note(self) -> str:
        return another_engine(Path(self.run))

    def answer(self, run: Run) -> xr.Dataset:
        plan, name = select_law(Path(self.run), 0, self.law)
        one = files.read_results(Path(self.run)).sel(law=name)
        found = kinds(one, float(plan.setting.rules.max_lost))
        return one.assign(kind=("world", found))

    def intro(self, results: xr.Dataset) -> str:
        return f"Run {self.run}; kinds and maps."

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        plan, name = select_law(Path(self.run), 0, self.law)
        kind_of = results.kind.values
        there = {k: np.flatnonzero(kind_of == k) for k in MECHANISMS if (kind_of == k).any()}
        some = np.array([i for worlds in there.values() for i in worlds[: self.each]], int)
        seen, sections = _followed(plan, name, some, SequentialProgress(run.callback)), []
        for kind, worlds in there.items():
            tracks = [seen[int(i)] for i in worlds[: self.each]]
            left = results.min_distance.values[worlds[: self.each]]
            labels = [
                f"world {i}, " + (f"{x:.2f} m left" if np.isfinite(x) else "untouched")
                for i, x in zip(worlds, left, strict=False)
            ]
            title = f"{name}: {kind}, {len(labels)} of {worlds.size} in {kind_of.size} worlds"
            drawn = functools.partial(figure_of, tracks, labels, title)
            picture = Picture(kind.replace(" ", "_"), drawn)
            heading = f"{kind}: {worlds.size} of {kind_of.size}"
            text = _told(self.run, name, results, kind_of == kind, kind)
            sections.append(Section(heading, text, (), picture))
        return sections


gallery = call_of(Gallery)


def _told(run: str | Path, law: str, one: xr.Dataset, mask: np.ndarray, kind: str) -> str:
    """What a kind of losses has in common, in sentences."""
    parts = []
    for name, mine, usual in in_common(one, mask):
        unit = one[name].attrs.get("units", "1").replace("1", "")
        what = f"{WORDS[name]} {mine:.2g} {unit}".rstrip()
        parts.append(f"{what} (all: {usual:.2g})")
    first = int(np.flatnonzero(mask)[0])
    common = f" In the median: {', '.join(parts)}." if parts else ""
    again = f" Watch one: `rps replay {shlex.quote(str(run))} {first} --law {shlex.quote(law)}`."
    return MECHANISMS[kind] + common + again


def _followed(
    plan: Plan, law: str, worlds: np.ndarray, heard: SequentialProgress
) -> Mapping[int, xr.Dataset]:
    """Trials of a law over time, by world; those of one object are stepped together."""
    found: dict[int, Any] = {}
    of_object = plan.domain.object_of(worlds)
    for thing in np.unique(of_object):
        rows = worlds[of_object == thing]
        part = build_batch(plan, list(plan.laws).index(law), rows)
        decides = registry.law_of(plan.laws[law])
        traces = pushes.record_batch(part, decides, plan.setting, interval=0.5, callback=heard)
        heard.finish(rows.size)
        for world, trace in zip(rows.tolist(), traces, strict=True):
            found[world] = results.trace_dataset(trace)
    return found


def figure_of(seen: Sequence[xr.Dataset], labels: Sequence[str], title: str) -> Figure:
    """Draw a map of each trial: the ways of base and object, and the base at ten moments."""
    figure, axes = tiles(len(seen), _COLUMNS, (2.3, 2.4), (0.4, 0.9))
    for ax, one, label in zip(axes.ravel(), seen, labels, strict=False):
        _map(ax, one)
        ax.set_title(label, fontsize=7)
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, fontsize=8, loc="outside lower center", ncols=len(names))
    figure.suptitle(title, fontsize=10)
    return figure


def _map(ax: Axes, one: xr.Dataset) -> None:
    qpos, touch = one.qpos.values, one.contact_type.values != 0
    base, thing = qpos[:, :3], qpos[:, 3:5]
    felt = np.where(touch[:, None], base[:, :2], np.nan)
    unfelt = np.where(touch[:, None], np.nan, base[:, :2])
    ax.plot(*felt.T, color="C0", lw=0.8, label="base, touching")
    ax.plot(*unfelt.T, color="C3", lw=0.8, label="base, without contact")
    ax.plot(*thing.T, color="C1", lw=1.2, label="object")
    half = (float(one.half_length), float(one.half_width))
    for i in np.linspace(0, len(base) - 1, 10).astype(int):
        patch = base_patch(base[i], half, fill=i == len(base) - 1)
        patch.set_alpha(0.5)
        ax.add_patch(patch)
    target = np.asarray(one.p_world_target.values, float)
    ax.plot(*target, "*", color="C2", ms=9, label="target")
    ax.set_aspect("equal", adjustable="datalim")
    ax.tick_params(labelsize=6)
