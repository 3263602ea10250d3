"""Comparison of grounds with dry friction: single pushes beside those of a rigid object.

`rigid` solves for the motion of the rigid object, `pushes` runs one push in C MuJoCo or in the
rigid limit, and `grounds` runs them on many grounds and compares.

    rps sweeps/ground --quick
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
import xarray as xr
from matplotlib.lines import Line2D

from rps_jax.analysis.figures.style import Figure, words
from rps_jax.physics import PHYSICS
from rps_jax.questions import Picture, Run, call_of
from sweeps.ground import grounds
from sweeps.study_base import QuickStudy, Table


@dataclass(frozen=True)
class Ground(QuickStudy[xr.Dataset]):
    """Compare grounds with dry friction, by pushes beside those of a rigid object.

    The answer holds pushes (ground, object, offset, speed) in C MuJoCo, the end positions of rigid
    objects (object, offset, at_height), and their distance from each push, `error` [m].
    """

    TITLE = "Which ground is dry friction?"
    QUICK: ClassVar = {"grounds": grounds.QUICK}
    CHOICES: ClassVar = {"grounds": grounds.GROUNDS}
    GROWS = ("grounds",)
    PRESETS: ClassVar = PHYSICS["default"]

    grounds: tuple[str, ...] = tuple(grounds.GROUNDS)
    """Names of the grounds; by default all."""

    def num_trials(self) -> int | None:
        """Return the number of pushes."""
        return grounds.count(self.grounds)

    def answer(self, run: Run) -> xr.Dataset:
        """Push on the grounds that are missing."""
        return grounds.run(self.grounds, run)

    def intro(self, results: xr.Dataset) -> str:
        """Describe the pushes."""
        return (
            "Two boxes (40 and 60 cm) and the paper's cylinder, pushed by 0.5 m in C MuJoCo, 5, 8 "
            "and 12 cm off the middle of the base. The error is how far along the base's front an "
            "object ends from where a rigid one ends."
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return errors, forces and hops of each ground."""
        picture = Picture("ground", partial(figure_of, results, grounds.DRAWN))
        title = "Grounds beside a rigid object"
        return [Table(grounds.table(results), title=title, picture=picture)]


ground = call_of(Ground)


def figure_of(results: xr.Dataset, names: Collection[str]) -> Figure:
    """Draw where pushes on some grounds end beside a rigid object, errors, spreads and hops.

    `results` are by (ground, object, offset, speed), and where a rigid object ends,
    `limit_lateral` [m], by (object, offset, at_height, friction), of which the first is the own.
    """
    chosen = [name for name in map(str, results.ground.values) if name in names]
    figure = Figure(figsize=(11, 7), layout="constrained")
    above, below = figure.subplots(2, 3)
    speeds, marks = results.speed.values, "vos^D"
    for ax, target in zip(above, map(str, results.object.values), strict=False):
        dataset = results.sel(object=target)
        for offset in results.offset.values:
            line = 1000 * dataset.limit_lateral.sel(offset=offset)
            ax.plot(100 * results.at_height, line, "k-", lw=1)
        for i, name in enumerate(chosen):
            for speed, mark in zip(speeds, marks, strict=False):
                at = dataset.sel(ground=name, speed=speed)
                style = {"color": f"C{i}", "marker": mark, "ls": "none", "ms": 5, "mfc": "none"}
                ax.plot(100 * at.height, 1000 * at.lateral, **style)
        ax.set(title=words(target), xlabel="height of the push [cm]")
        ax.grid(alpha=0.3)
    above[0].set_ylabel("end, along the base's front [mm]")
    over = ("object", "offset")
    panels = {
        "from the rigid object's end [mm]": 1000 * np.sqrt((results.error**2).mean(over)),
        "spread of the push force [%]": 100 * results.spread.mean(over),
        "largest hop [mm]": 1000 * results.hop.max(over),
    }
    for ax, (ylabel, values) in zip(below, panels.items(), strict=True):
        for i, name in enumerate(chosen):
            at = values.sel(ground=name)
            ax.plot(100 * speeds, at, "o-", ms=4, color=f"C{i}", label=str(at.what.item()))
        ax.set(xscale="log", yscale="log", xlabel="speed of the base [cm/s]", ylabel=ylabel)
        ax.set_xticks(100 * speeds, [f"{100 * speed:g}" for speed in speeds])
        ax.minorticks_off()
        ax.grid(alpha=0.3)
    style: dict[str, Any] = {"color": "0.3", "ls": "none", "mfc": "none"}
    handles = [
        Line2D([], [], color="k", lw=1, label="rigid object, at three offsets"),
        *(
            Line2D([], [], marker=mark, label=f"{100 * speed:g} cm/s", **style)
            for mark, speed in zip(marks, speeds, strict=False)
        ),
        *below[0].get_legend_handles_labels()[0],
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8)
    return figure
