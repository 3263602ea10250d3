"""The paper's trials under changed conditions, compared trial by trial.

A study runs one `Grid` of trials under several `Condition`s. `run_conditions` runs the conditions
that its folder lacks, and `condition_rows` compares them with a baseline.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import numpy as np
import xarray as xr

from rps_jax import InputError, RPSParams, Setting
from rps_jax.analysis import statistics, tables
from rps_jax.laws import LawParams, law_of, resolve_law
from rps_jax.physics import FRICTION, PHYSICS
from rps_jax.questions import Run
from rps_jax.trials.batch import outcomes
from rps_jax.trials.progress import Progress, SequentialProgress
from rps_jax.trials.pushes import Cases
from rps_jax.trials.results import outcome_dataset
from rps_jax.world import paper
from rps_jax.worlds import Case, parse_domain
from sweeps.study_base import TrialStudy, part_of, stored_parts

# Number of trials per call: more keep the device busier, fewer are lost when the run is killed.
_TRIALS_AT_ONCE = {"cpu": 600, "gpu": 100_000}


class Grid(NamedTuple):
    """Trials of a study, in the nesting order of `outcome_dataset`."""

    laws: tuple[str, ...] = ("rps",)
    objects: tuple[str, ...] = parse_domain("paper").objects
    friction: Mapping[str, Any] = FRICTION
    targets: tuple[tuple[float, float], ...] = paper.TARGETS

    @property
    def size(self) -> int:
        """Number of trials."""
        return len(self.laws) * len(self.objects) * len(self.friction) * len(self.targets)


@dataclass(frozen=True)
class Condition:
    """Changes of one row to the setting, the law parameters and all cases."""

    what: str
    setting: Setting = Setting(engine="mjx")
    params: Mapping[str, float] = field(default_factory=dict)  # of RPS, or of RPS in another law
    case: Mapping[str, Any] = field(default_factory=dict)  # skin, gap, rear, bearing, ...

    def cases(self, grid: Grid) -> list[Case]:
        """Return the trials of a grid under this condition."""
        changed = {name: self._changed(resolve_law(name)[1]) for name in grid.laws}
        return [
            Case(name, friction, target, changed[law], **self.case)
            for law in grid.laws
            for name in grid.objects
            for friction in grid.friction.values()
            for target in grid.targets
        ]

    def is_allowed(self, laws: Sequence[str]) -> bool:
        """Return whether all laws accept the changed parameters."""
        try:
            for params in (self._changed(resolve_law(name)[1]) for name in laws):
                law_of(params).check(params)
        except InputError:
            return False
        return True

    def is_default(self, laws: Sequence[str]) -> bool:
        """Return whether it changes only parameters, to values that all laws have already."""
        unchanged = (self._changed(x) == x for _, x in map(resolve_law, laws))
        return bool(self.params) and not self.case and all(unchanged)

    def _changed(self, params: LawParams) -> LawParams:
        """Return changed parameters of RPS or of a law that contains RPS; others unchanged."""
        if isinstance(params, RPSParams):
            return params._replace(**self.params)
        inner = getattr(params, "law", None)
        if isinstance(inner, RPSParams):
            return params._replace(law=inner._replace(**self.params))
        return params


def run_conditions(conditions: Mapping[str, Condition], grid: Grid, run: Run) -> xr.Dataset:
    """Return outcomes (condition, law, object, friction, target).

    A finished condition is a part of the run folder; only missing conditions are run.
    """
    parts = {name: _part(name, condition, grid) for name, condition in conditions.items()}
    stored, done = stored_parts(run), dict[str, xr.Dataset]()
    missing = [name for name in conditions if parts[name] not in stored]
    progress = SequentialProgress(run.callback)
    progress.finish(grid.size * (len(conditions) - len(missing)))
    progress(Progress(0, 0.0))
    options = run._replace(callback=progress).batch_options

    def checkpoint(name: str) -> xr.Dataset:
        return run.checkpoint(parts[name], partial(done.__getitem__, name))

    for chunk in _chunks(missing, conditions, grid):
        requests = [Cases(conditions[name].cases(grid)) for name in chunk]
        by_condition, timing = outcomes(requests, conditions[chunk[0]].setting, **options)
        progress.finish(grid.size * len(chunk))
        share = 1 / len(chunk)  # of the time of the whole call
        for name, outcome in zip(chunk, by_condition, strict=True):
            results = outcome_dataset(
                outcome, grid.laws, grid.objects, tuple(grid.friction), grid.targets
            )
            costs = {"run_time": timing.run * share, "simulated": timing.simulated * share}
            done[name] = results.assign_coords(costs)
            checkpoint(name)
    index = xr.IndexVariable("condition", list(conditions))
    joined = xr.concat(map(checkpoint, conditions), index, coords=["run_time", "simulated"])
    return joined.assign_coords(what=("condition", [c.what for c in conditions.values()]))


def _part(name: str, condition: Condition, grid: Grid) -> str:
    """Return the name of a part by all that its outcomes depend on."""
    plain = replace(condition, what="", params=dict(condition.params), case=dict(condition.case))
    return part_of(name, plain, grid._replace(friction=dict(grid.friction)))


def _chunks(
    names: Sequence[str], conditions: Mapping[str, Condition], grid: Grid
) -> list[list[str]]:
    """Return groups of conditions that run in one call: one setting, bounded size."""
    groups: dict[Setting, list[str]] = {}
    for name in names:
        groups.setdefault(conditions[name].setting, []).append(name)
    at_once = max(1, _TRIALS_AT_ONCE.get(jax.default_backend(), 600) // grid.size)
    return [
        group[i : i + at_once] for group in groups.values() for i in range(0, len(group), at_once)
    ]


def condition_rows(results: xr.Dataset, baseline: str, law: str = "rps") -> list[list[str]]:
    """Return a header and one row per condition: counts, median time, difference.

    The last column compares with the baseline by McNemar's exact test. A star marks significant
    differences at a false discovery rate of 5 % over all rows (Benjamini-Hochberg).
    """
    part = results.sel(law=law)
    base = part.success.sel(condition=baseline)
    names = part.condition.values.tolist()
    comparisons = [statistics.compare(base, part.success.sel(condition=name)) for name in names]
    compared = [i for i, name in enumerate(names) if name != baseline]
    q = np.ones(len(names))
    q[compared] = statistics.false_discovery([comparisons[i].p for i in compared])
    objects = part.object.values.tolist()
    table = [["reading", *objects, "all", "median time", "against the first"]]
    for i, name in enumerate(names):
        trials = part.sel(condition=name)
        succeeded = trials.success.values.astype(bool)
        counts = trials.success.sum("target").transpose("object", "friction").values.astype(int)
        time = trials.time.values[succeeded]
        c, star = comparisons[i], " *" if q[i] < 0.05 else ""
        difference = f"{c.changes}, q = {q[i]:.2g}{star}" if name != baseline else ""
        table.append(
            [
                str(trials.what.values),
                *(" ".join(map(str, row)) for row in counts),
                f"{succeeded.sum()} of {succeeded.size}",
                tables.median(time),
                difference,
            ]
        )
    return table


@dataclass(frozen=True, kw_only=True)
class ConditionStudy(TrialStudy[xr.Dataset]):
    """Base class of studies that run the paper's trials under several conditions.

    The results hold outcomes (condition, law, object, friction, target).
    """

    PRESETS: ClassVar = {"physics": PHYSICS, "laws": paper.LAWS}

    targets: tuple[tuple[float, float], ...] = paper.TARGETS
    """Targets X Y [m], one pair after the other; by default the paper's 24."""

    @property
    def chosen(self) -> dict[str, Condition]:
        """Conditions by name."""
        raise NotImplementedError

    @property
    def grid(self) -> Grid:
        """Trials of each condition."""
        raise NotImplementedError

    def num_trials(self) -> int | None:
        """Return the number of trials."""
        return len(self.chosen) * self.grid.size

    def answer(self, run: Run) -> xr.Dataset:
        """Run the conditions that are missing."""
        return run_conditions(self.chosen, self.grid, run)
