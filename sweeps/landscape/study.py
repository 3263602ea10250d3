"""Effect of each parameter on success, time and path length, and their trade-offs.

    rps sweeps/landscape --worlds 510 --candidates 120

varies each of the law's parameters alone, and looks for the undominated among candidates between
and around sets of parameters. Both push with a few hundred candidates: for a GPU.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from rps_jax import errors
from rps_jax.analysis.figures.style import Figure, success_rates
from rps_jax.analysis.report import Picture, Section
from rps_jax.control.laws.rps import BOUNDS, RPSParams
from rps_jax.record.options import option
from rps_jax.runs.question import MultiLawQuestion, Run, call_of
from rps_jax.trials.progress import SequentialProgress
from rps_jax.tuning.run import parse_domains
from rps_jax.tuning.space import SUBSETS
from rps_jax.world.domain import Domain, DomainLike
from sweeps.landscape import candidates


@dataclass(frozen=True)
class Landscape(MultiLawQuestion[xr.DataTree]):
    """Vary each parameter of RPS alone, and find what success costs in time and way.

    The answer is a tree: `alone` with success, time and way (set, parameter, step), and `front`
    with those of candidates between the laws' parameters and around them (candidate).
    """

    TITLE: ClassVar[str] = "Effect of each parameter"
    QUICK: ClassVar[Mapping[str, Any]] = {"worlds": 32, "values": 3, "candidates": 16}

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
        return parse_domains(self.domain)

    def check(self) -> None:
        """Check that the laws are RPS with parameters."""
        for label, params in self.chosen.items():
            if not isinstance(params, RPSParams):
                raise errors.InputError(f"law = {label} is not allowed: give parameters of rps.")

    @property
    def _shares(self) -> tuple[int, int]:
        """Numbers of trials of both parts."""
        per_candidate = len(self.domains) * self.worlds
        varied = len(self.chosen) * len(SUBSETS["full"]) * self.values
        return varied * per_candidate, 2 * (self.candidates + len(self.chosen)) * per_candidate

    def num_trials(self) -> int | None:
        """Return the number of trials."""
        return sum(self._shares)

    def answer(self, run: Run) -> xr.DataTree:
        """Vary each parameter, then run the candidates."""
        progress = SequentialProgress(run.callback)
        common = {"worlds": self.worlds, **run._replace(callback=progress).batch_options}
        worlds = self.chosen, self.domains, self.setting
        first, _ = self._shares
        alone = partial(candidates.alone, *worlds, count=self.values, **common)
        results = {"alone": run.checkpoint("alone", alone)}
        progress.finish(first)
        options = {"candidates": self.candidates, "spread": self.spread}
        front = partial(candidates.front, *worlds, **options, **common)
        results["front"] = run.checkpoint("front", front)
        return xr.DataTree.from_dict(results)

    def intro(self, results: xr.DataTree) -> str:
        """Return a description of the worlds."""
        return f"All candidates run in the same {self.worlds:,} worlds of each domain."

    def report(self, results: xr.DataTree, run: Run) -> Sequence[Section]:
        """Return sections with success over each parameter, and the Pareto front."""
        alone, front = (results[name].to_dataset() for name in ("alone", "front"))
        log = [name for name, bound in BOUNDS.items() if bound.log]
        lines = Picture("landscape", partial(parameters_figure, alone, log))
        trade = Picture("front", partial(front_figure, front))
        return [
            Section("Success against each parameter", "", (), lines),
            Section("Success, time and way", "", candidates.front_table(front), trade),
        ]


landscape = call_of(Landscape)


def front_figure(results: xr.Dataset) -> Figure:
    """Plot success over time and over path length, and mark Pareto-optimal candidates."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    labels = [str(label) for label in results.candidate.values]
    for ax, (field, label) in zip(
        figure.subplots(1, 2, sharey=True),
        {
            "time": "median time of a success [s]",
            "path": "median path length of the base [m]",
        }.items(),
        strict=True,
    ):
        x, y = results[field].values, 100 * results.success.values
        ax.plot(x, y, ".", color="0.75", label="candidates")
        chosen = results.front.values
        ax.plot(x[chosen], y[chosen], "o", ms=5, color="C0", label="Pareto-optimal")
        for i, name in enumerate(labels):
            if not name.isdigit():
                ax.plot(x[i], y[i], "*", ms=12, color="C3")
                ax.annotate(name, (x[i], y[i]), (6, -10), textcoords="offset points", fontsize=9)
        ax.set_xlabel(label)
        ax.grid(alpha=0.3)
    figure.axes[0].set_ylabel("success [%]")
    figure.axes[0].legend(fontsize=8, loc="lower right")
    return figure


def parameters_figure(results: xr.Dataset, log: Collection[str]) -> Figure:
    """Plot success over each parameter alone, with logarithmic axes for those in `log`.

    Intervals are Wilson's, of 95 %.
    """
    names = list(map(str, results.parameter.values))
    rows = -(-len(names) // 4)
    figure = Figure(figsize=(12, 2.5 * rows), layout="constrained")
    axes = figure.subplots(rows, 4, squeeze=False, sharey=True).ravel()
    for ax in axes[len(names) :]:
        ax.axis("off")
    worlds = int(results.attrs["worlds"])
    for ax, name in zip(axes, names, strict=False):
        for i, label in enumerate(map(str, results.set.values)):
            line = results.sel(set=label, parameter=name)
            successes = np.round(line.success.values * worlds).astype(int)
            success_rates(
                ax,
                line.value.values,
                successes,
                np.full(successes.size, worlds),
                curve=i,
                color=f"C{i}",
                label=label,
            )
        ax.set_xlabel(name, fontsize=9)
        ax.grid(alpha=0.3)
        if name in log:
            ax.set_xscale("log")
    for ax in axes[::4]:
        ax.set_ylabel("success [%]")
    axes[0].legend(fontsize=8)
    return figure
