"""Comparison of grounds with dry friction: single pushes beside those of a rigid object.

`rigid` solves for the motion of the rigid object, `pushes` runs one push in C MuJoCo or in the
rigid limit, and `grounds` runs them on many grounds and compares.

    rps sweeps/ground --quick
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
import xarray as xr
from matplotlib.lines import Line2D

from rps_jax import errors
from rps_jax.analysis.figures.style import Figure, words
from rps_jax.analysis.report import Picture, Section
from rps_jax.record.options import option
from rps_jax.runs.question import Run, call_of
from sweeps.ground import grounds
from sweeps.study_base import Study


@dataclass(frozen=True)
class Ground(Study[xr.Dataset]):
    """Compare grounds with dry friction, by pushes beside those of a rigid object.

    The answer holds pushes (ground, object, offset, speed) in C MuJoCo, the end positions of rigid
    objects (object, offset, at_height, friction), and their distance from each push, `error` [m].
    """

    TITLE: ClassVar[str] = "Which ground is dry friction?"
    QUICK: ClassVar[Mapping[str, Any]] = {"grounds": grounds.QUICK}
    GROWS: ClassVar[tuple[str, ...]] = ("grounds",)

    grounds: tuple[str, ...] = tuple(grounds.GROUNDS)
    """Names of the grounds; by default all."""
    worlds: int | None = option(None, 1, 10_000)
    """Number of pushes on each ground: the first of all objects, offsets and speeds; by default
    all."""
    quick: bool = False
    """Whether to run only three of the grounds."""

    def check(self) -> None:
        """Check the names."""
        errors.check_each_once("grounds", self.grounds)
        for name in self.grounds:
            errors.check_name("ground", name, grounds.GROUNDS)

    def num_trials(self) -> int | None:
        """Return the number of pushes."""
        return grounds.count(self.grounds, self.worlds)

    def answer(self, run: Run) -> xr.Dataset:
        """Push on the grounds that are missing."""
        return grounds.run(self.grounds, run.folder, worlds=self.worlds, callback=run.callback)

    def intro(self, results: xr.Dataset) -> str:
        """Describe the pushes."""
        return (
            "Two boxes (40 and 60 cm) and the paper's cylinder, pushed by 0.5 m in C MuJoCo, 5, 8 "
            "and 12 cm off the middle of the base. The error is how far along the base's front an "
            "object ends from where a rigid one ends."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Errors, forces and hops of each ground."""
        picture = Picture("ground", partial(figure_of, results, grounds.DRAWN))
        return [Section("Grounds beside a rigid object", "", grounds.table(results), picture)]


ground = call_of(Ground)


def figure_of(results: xr.Dataset, names: Collection[str]) -> Figure:
    """Draw where pushes on some grounds end beside a rigid object, errors, spreads and hops.

    `results` are by (ground, object, offset, speed), and where a rigid object ends,
    `limit_lateral` [m], by (object, offset, at_height, friction), of which the first is the own.
    """
    chosen = [name for name in map(str, results.ground.values) if name in names]
    objects = list(map(str, results.object.values))
    figure = Figure(figsize=(11, 7), layout="constrained")
    above, below = figure.subplots(2, 3)
    speeds = results.speed.values
    for ax, target in zip(above, objects, strict=False):
        dataset = results.sel(object=target)
        for offset in results.offset.values:
            line = 1000 * dataset.limit_lateral.sel(offset=offset).isel(friction=0)
            ax.plot(100 * results.at_height, line, "k-", lw=1)
        for i, name in enumerate(chosen):
            for speed, marker in zip(speeds, "vos^D", strict=False):
                at = dataset.sel(ground=name, speed=speed)
                style = {"color": f"C{i}", "marker": marker, "ls": "none", "ms": 5}
                ax.plot(100 * at.height, 1000 * at.lateral, mfc="none", **style)
        ax.set(title=words(target), xlabel="height of the push [cm]")
        ax.grid(alpha=0.3)
    above[0].set_ylabel("end, along the base's front [mm]")
    panels = {
        "error": "from the rigid object's end [mm]",
        "spread": "spread of the push force [%]",
        "hop": "largest hop [mm]",
    }
    for ax, (field, label) in zip(below, panels.items(), strict=True):
        for i, name in enumerate(chosen):
            dataset, over = results[field].sel(ground=name), ("object", "offset")
            value = dataset.max(over) if field == "hop" else dataset.mean(over)
            if field == "error":
                value = np.sqrt((dataset**2).mean(over))
            factor = 100 if field == "spread" else 1000
            label = str(results.what.sel(ground=name).values)
            ax.plot(100 * speeds, factor * value, "o-", ms=4, color=f"C{i}", label=label)
        ax.set(xscale="log", yscale="log", xlabel="speed of the base [cm/s]", ylabel=label)
        ax.set_xticks(100 * speeds, [f"{100 * speed:g}" for speed in speeds])
        ax.minorticks_off()
        ax.grid(alpha=0.3)
    marks = [
        Line2D([], [], color="0.3", marker=marker, ls="none", mfc="none", label=f"{100 * v:g} cm/s")
        for v, marker in zip(speeds, "vos^D", strict=False)
    ]
    rigid = Line2D([], [], color="k", lw=1, label="rigid object, at three offsets")
    handles = [rigid, *marks, *below[0].get_legend_handles_labels()[0]]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8)
    return figure
