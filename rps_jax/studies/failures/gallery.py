"""What the losses of a law look like: maps of them by kind, and what each kind has in common."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from rps_jax import errors
from rps_jax.analysis import figures, statistics
from rps_jax.analysis.report import Section, write_report
from rps_jax.control import strategies
from rps_jax.record import files
from rps_jax.record import folder as run_folder
from rps_jax.runs.plan import Plan, world_part
from rps_jax.runs.push import chosen
from rps_jax.trials import pushes, results
from rps_jax.trials.setting import InTurn, Report, unheard

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
    found = names[statistics.failure(one, max_lost)]
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
    for name in statistics.drawn(one):
        values = one[name].values.astype(float)
        mine, every = values[mask], np.sort(values)
        mine = mine[np.isfinite(mine)]
        if mine.size < 3:
            continue
        below = np.searchsorted(every, mine, "left") + np.searchsorted(every, mine, "right")
        away = abs(below.mean() / (2 * every.size) - 0.5)
        found.append((away, name, float(np.median(mine)), float(np.nanmedian(values))))
    ranked = sorted(found, reverse=True)[:most]
    return [(name, mine, usual) for away, name, mine, usual in ranked if away >= 0.1]


def gallery(
    run: str | Path,
    arm: str | None = None,
    each: int = 30,
    out: str | Path | None = None,
    *,
    report: Report = unheard,
) -> xr.Dataset:
    """Maps of the losses of one arm of a sweep, by kind, as PNGs and a report.

    Args:
      run: the run folder of the sweep, with its results.
      arm: which of the sweep's arms; by default the first.
      each: trials of each kind that are followed again and drawn, at most.
      out: folder of what is made; by default RUN/gallery.
      report: called now and then.

    Returns:
      By world: `kind`, empty for a success; with the outcomes and what was drawn.

    Raises:
      InputError: the folder holds no sweep with results, or not this arm.

    Example:
      >>> import tempfile
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> arms = {"rps": rps_jax.RPSParams.paper()}
      >>> with tempfile.TemporaryDirectory() as run:
      ...     made = rps_jax.sweep(drums, arms, worlds=2, out=run, rules=rules)
      ...     found = rps_jax.gallery(run, each=1)
      >>> found.kind.values.tolist()
      ['never touched', 'never touched']
    """
    errors.check_count("each", each, at_most=200)
    plan, name = chosen(Path(run), 0, arm)
    one = files.read_results(Path(run)).sel(arm=name)
    found = kinds(one, float(plan.setting.rules.max_lost))
    folder = run_folder.writable(Path(out) if out else Path(run) / "gallery")
    there = {k: np.flatnonzero(found == k) for k in MECHANISMS if (found == k).any()}
    some = np.array([i for worlds in there.values() for i in worlds[:each]], int)
    seen, sections = _followed(plan, name, some, InTurn(report)), []
    for kind, worlds in there.items():
        labels = [f"world {i}, {_left(one, i)}" for i in worlds[:each]]
        title = f"{name}: {kind}, {len(labels)} of {worlds.size} in {one.sizes['world']} worlds"
        path = folder / f"{kind.replace(' ', '_')}.png"
        picture = figures.losses([seen[int(i)] for i in worlds[:each]], labels, title, path)
        heading = f"{kind}: {worlds.size} of {one.sizes['world']}"
        sections.append(Section(heading, _told(run, name, one, found == kind, kind), (), picture))
    write_report(folder, f"Losses of {name}", f"Run {run}; kinds and maps.", sections)
    return one.assign(kind=("world", found))


def _left(one: xr.Dataset, world: int) -> str:
    left = float(one.min_distance.values[world])
    return f"{left:.2f} m left" if np.isfinite(left) else "untouched"


def _told(run: str | Path, arm: str, one: xr.Dataset, mask: np.ndarray, kind: str) -> str:
    """What a kind of losses has in common, in sentences."""
    parts = []
    for name, mine, usual in in_common(one, mask):
        unit = one[name].attrs.get("units", "1").replace("1", "")
        what = f"{statistics.DRAWN[name]} {mine:.2g} {unit}".rstrip()
        parts.append(f"{what} (all: {usual:.2g})")
    first = int(np.flatnonzero(mask)[0])
    common = f" In the median: {', '.join(parts)}." if parts else ""
    again = f' Watch one: `rps replay {run} {first} --arm "{arm}" --video`.'
    return MECHANISMS[kind] + common + again


def _followed(plan: Plan, arm: str, worlds: np.ndarray, heard: InTurn) -> Mapping[int, xr.Dataset]:
    """Trials of an arm over time, by world; those of one object are stepped together."""
    found: dict[int, Any] = {}
    of_object = plan.domain.object_of(worlds)
    for thing in np.unique(of_object):
        rows = worlds[of_object == thing]
        part = world_part(plan, list(plan.arms).index(arm), rows)
        decides = strategies.of(plan.arms[arm])
        traces = pushes.follow_part(part, decides, plan.setting, interval=0.5, report=heard)
        heard.ended(rows.size)
        for world, trace in zip(rows.tolist(), traces, strict=True):
            found[world] = results.trace_dataset(trace)
    return found
