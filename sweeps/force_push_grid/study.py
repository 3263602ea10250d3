"""Does our Force Push do on its authors' own ground what theirs did? 243 pushes of each slider.

    rps sweeps/force_push_grid

pushes the box and the cylinder of Heins and Schoellig (2024) along a straight path, by their law
and in their open loop, from every start of their grid, which is in `grid`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import xarray as xr

from rps_jax.physics import EngineName, get_engine
from rps_jax.questions import Run, call_of, option
from rps_jax.trials.progress import SequentialProgress
from sweeps.force_push_grid import grid
from sweeps.study_base import QuickStudy, Table


@dataclass(frozen=True)
class ForcePushGrid(QuickStudy[xr.Dataset]):
    """Push the sliders of Heins and Schoellig from every start of their grid, by their law.

    The results hold, over (law, slider, inertia, friction, lateral, angle, contact), `success` by
    their criterion, `silent` [s], `apart` [m], `deviation` [m] and `completion` [1].
    """

    TITLE = "Force Push on its authors' ground"
    QUICK: ClassVar = {"duration": 60.0, "sliders": ("box",)}
    CHOICES: ClassVar = {"laws": grid.LAWS, "sliders": grid.SLIDERS}
    GROWS = ("laws", "sliders")
    PRESETS: ClassVar = {"physics": grid.PHYSICS, "law": grid.PARAMS}

    laws: tuple[grid.LawName, ...] = grid.LAWS
    """Laws: force_push, and open_loop, which only returns to the path."""
    sliders: tuple[grid.SliderName, ...] = grid.SLIDERS
    """Sliders: box, cylinder."""
    duration: float = option(grid.DURATION, above=0, at_most=800, unit="s")  # 80 m of world
    """Length of a push after its first contact [s]."""
    engine: EngineName = "fused"
    """Engine; it must give the contact force to a compiled program."""

    def check(self) -> None:
        """Check the names, and that the engine supports these pushes."""
        super().check()
        engine = get_engine(self.engine)
        engine.check_senses("force")
        engine.check_traced()
        engine.check_physics(grid.PHYSICS)

    def num_trials(self) -> int | None:
        """Return the number of pushes."""
        return len(self.laws) * len(self.sliders) * grid.cells().angle.size

    def answer(self, run: Run) -> xr.Dataset:
        """Run the laws and sliders that are missing."""
        progress = SequentialProgress(run.callback)
        by_law: list[xr.Dataset] = []
        for law in self.laws:
            of_law: list[xr.Dataset] = []
            for slider in self.sliders:
                inputs = law, slider, self.engine, self.duration
                push = partial(grid.run_grid, *inputs, callback=progress)
                of_law.append(run.checkpoint(f"{law}_{slider}", push))
                progress.finish(of_law[-1].success.size)
            by_law.append(xr.concat(of_law, xr.IndexVariable("slider", list(self.sliders))))
        return xr.concat(by_law, xr.IndexVariable("law", list(self.laws)))

    def intro(self, results: xr.Dataset) -> str:
        """Return a description of the grid."""
        return (
            f"The grid of Heins and Schoellig (2024), {self.duration:g} s from the first contact "
            f"on, engine {self.engine}."
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the successes by the authors' criterion."""
        return [Table(grid.table(results), title="Pushes that succeed")]


force_push_grid = call_of(ForcePushGrid)
