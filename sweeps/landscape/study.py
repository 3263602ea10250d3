"""Effect of each parameter on success, time and path length, and their trade-offs.

    rps sweeps/landscape --worlds 510 --candidates 120

varies each of the law's parameters alone, and looks for the undominated among candidates between
and around sets of parameters. Both push with a few hundred candidates: for a GPU.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, ClassVar, Literal

import jax
import numpy as np
import xarray as xr

from rps_jax import Domain, RPSParams, errors
from rps_jax.analysis.figures.style import Figure, success_rates, tiles
from rps_jax.laws import law_of
from rps_jax.questions import MultiLawQuestion, Picture, Run, Section, call_of, option
from rps_jax.trials.batch import outcomes
from rps_jax.trials.progress import SequentialProgress
from rps_jax.trials.trial import Outcome
from rps_jax.trials.worlds import Candidates
from rps_jax.worlds import DomainLike, parse_domain
from sweeps.landscape.candidates import aims, cloud, front_table, lines, undominated

_NAMES = tuple(dict(law_of(RPSParams.paper()).bounds))  # of the varied parameters


@dataclass(frozen=True)
class Landscape(MultiLawQuestion[xr.DataTree]):
    """Vary each parameter of RPS alone, and find what success costs in time and way.

    The answer is a tree: `alone` with success, time and way (set, parameter, step), and `front`
    with those of candidates between the laws' parameters and around them (candidate).
    """

    TITLE = "Effect of each parameter"
    QUICK: ClassVar = {"worlds": 32, "values": 3, "candidates": 16}

    domain: Sequence[DomainLike] = ("wide",)
    """Domains: paper, hardware, wide, real, prisms or hostile, or JSON files of ranges; changes
    follow each, as wide,mass=3:10."""
    worlds: int = option(999, 2, 1_000_000)
    """Number of worlds of each candidate in each domain."""
    values: int = option(9, 2, 1000)
    """Number of values of each parameter."""
    candidates: int = option(256, 2, 1_000_000)
    """Number of candidates between and around the laws' parameters."""
    spread: float = option(0.5, 0, 10)
    """Standard deviation of the candidates, in units of the bounded map [1]."""

    @cached_property
    def domains(self) -> tuple[Domain, ...]:
        """Domains of all candidates."""
        return tuple(map(parse_domain, self.domain))

    def check(self) -> None:
        """Check that the laws are RPS with parameters."""
        for label, params in self.chosen.items():
            if not isinstance(params, RPSParams):
                raise errors.not_allowed("law", label, "give parameters of rps")

    @property
    def _sets(self) -> list[RPSParams]:
        """Parameters of all laws."""
        return [params for params in self.chosen.values() if isinstance(params, RPSParams)]

    @property
    def _shares(self) -> tuple[int, int]:
        """Numbers of trials of both parts."""
        per_candidate = len(self.domains) * self.worlds
        varied = len(self.chosen) * len(_NAMES) * self.values
        return varied * per_candidate, 2 * (self.candidates + len(self.chosen)) * per_candidate

    def num_trials(self) -> int | None:
        """Return the number of trials."""
        return sum(self._shares)

    def answer(self, run: Run) -> xr.DataTree:
        """Vary each parameter, then run the candidates."""
        progress, results = SequentialProgress(run.callback), {}
        options = run._replace(callback=progress).batch_options
        parts = (("alone", self.vary_each), ("front", self.select_front))
        for (name, compute), share in zip(parts, self._shares, strict=True):
            results[name] = run.checkpoint(name, partial(compute, **options))
            progress.finish(share)
        return xr.DataTree.from_dict(results)

    def _outcomes(
        self,
        params: RPSParams,
        *splits: Literal["validate", "test"],
        **options: Any,
    ) -> list[Outcome]:
        """Return the outcomes (P, D * W) of candidates (P,) in the worlds of each split."""
        seeds = [replace(self.setting, split=x).world_seed for x in splits]
        worlds = np.arange(self.worlds)
        requests = [Candidates(params, self.domains, seed, worlds) for seed in seeds]
        return outcomes(requests, self.setting, **options)[0]

    def vary_each(self, **options: Any) -> xr.Dataset:
        """Compute success, time and path length over each parameter alone, in validation worlds.

        Return labelled results (set, parameter, step), with the parameter's `value` at each step.
        """
        names, dims = _NAMES, ("set", "parameter", "step")
        by_set = [lines(base, names, self.values) for base in self._sets]
        grid = jax.tree.map(lambda *x: np.stack(x), *by_set)
        (outcome,) = self._outcomes(jax.tree.map(np.ravel, grid), "validate", **options)
        varied = [np.asarray(getattr(grid, name))[:, i] for i, name in enumerate(names)]
        shape = (len(by_set), len(names), self.values)
        columns = {k: (dims, v.reshape(shape)) for k, v in aims(outcome)._asdict().items()}
        return xr.Dataset(
            columns | {"value": (dims, np.stack(varied, axis=1))},
            {"set": list(self.chosen), "parameter": list(names)},
            {"worlds": outcome.success.shape[1]},
        )

    def select_front(self, **options: Any) -> xr.Dataset:
        """Run candidates between and around the sets, and select the Pareto-optimal ones.

        The selection uses validation worlds. The objectives (candidate,) are then measured in test
        worlds, so that the selection does not bias them.
        """
        names, sets = _NAMES, self._sets
        params = cloud(sets, names, self.candidates, self.spread, self.setting.seed)
        validated, tested = self._outcomes(params, "validate", "test", **options)
        columns = {
            **aims(tested)._asdict(),
            "front": undominated(aims(validated)),
            **{name: np.asarray(getattr(params, name)) for name in names},
        }
        return xr.Dataset(
            {name: ("candidate", values) for name, values in columns.items()},
            {"candidate": [*self.chosen, *map(str, range(self.candidates))]},
            {"worlds": tested.success.shape[1]},
        )

    def intro(self, results: xr.DataTree) -> str:
        """Return a description of the worlds."""
        return f"All candidates run in the same {self.worlds:,} worlds of each domain."

    def report(self, results: xr.DataTree, run: Run) -> Sequence[Section]:
        """Return sections with success over each parameter, and the Pareto front."""
        alone, front = (results[name].to_dataset() for name in ("alone", "front"))
        log = [name for name, bound in law_of(RPSParams).bounds.items() if bound.log]
        lines = Picture("landscape", partial(parameters_figure, alone, log))
        return [
            Section("Success against each parameter", "", (), lines),
            Section("Success, time and way", "", front_table(front)),
        ]


landscape = call_of(Landscape)


def parameters_figure(results: xr.Dataset, log: Collection[str]) -> Figure:
    """Plot success over each parameter alone, with logarithmic axes for those in `log`.

    Intervals are Wilson's, of 95 %.
    """
    names = results.parameter.values.tolist()
    figure, axes = tiles(len(names), 4, (3, 2.5), (0, 0), sharey=True)
    worlds = int(results.attrs["worlds"])
    for ax, name in zip(axes.ravel(), names, strict=False):
        for i, label in enumerate(map(str, results.set.values)):
            line = results.sel(set=label, parameter=name)
            successes = np.round(line.success.values * worlds).astype(int)
            counts = line.value.values, successes, np.full(successes.size, worlds)
            success_rates(ax, *counts, curve=i, color=f"C{i}", label=label)
        ax.set_xlabel(name, fontsize=9)
        ax.grid(alpha=0.3)
        if name in log:
            ax.set_xscale("log")
    for ax in axes[:, 0]:
        ax.set_ylabel("success [%]")
    axes[0, 0].legend(fontsize=8)
    return figure
