"""Reproduction of the paper: its tables, figures and hardware experiments in one run folder.

`notebooks/03_paper` lists the details that the paper leaves open. `sweeps/ambiguities` measures the
effect of each reading, and `sweeps/paper_reading` infers the reading from all printed numbers.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import xarray as xr

from rps_jax import RPSParams
from rps_jax.analysis.figures import paper as figures
from rps_jax.physics import FRICTION
from rps_jax.questions import Picture, Run, Section, call_of
from rps_jax.record import files
from rps_jax.runs.push import Push
from rps_jax.runs.question import SimulationQuestion
from rps_jax.studies import table
from rps_jax.studies.hardware import Hardware
from rps_jax.studies.table import Table
from rps_jax.world import scene, video
from rps_jax.world.objects import PAPER_OBJECTS


@dataclass(frozen=True)
class Paper(SimulationQuestion[xr.DataTree]):
    """Reproduce the paper: Tables I and II, Figs. 3 to 7, and the hardware experiments.

    The result is a tree of `table` (law, object, friction, target), `trial` (time) and `hardware`,
    as returned by `rps_jax.table`, `rps_jax.push` and `rps_jax.hardware`. It takes some minutes.

    Examples:
      >>> import rps_jax
      >>> results = rps_jax.paper(quick=True)
      >>> results["table"].success.sel(law="rps").dims
      ('object', 'friction', 'target')
    """

    TITLE = "Pushing in the Dark, reproduced"

    @cached_property
    def parts(self) -> tuple[Table, Push, Hardware]:
        """Questions whose results make up the paper."""
        return (
            Table(setting=self.setting),
            Push(target=(-2.0, 0.0), setting=self.setting),
            Hardware(setting=self.setting, quick=self.quick).with_quick_values(),
        )

    def check(self) -> None:
        for part in self.parts:
            part.check()

    def num_trials(self) -> int | None:
        return sum(part.num_trials() or 0 for part in self.parts)

    def answer(self, run: Run) -> xr.DataTree:
        run, progress = run.in_parts()
        tables, push, hardware = self.parts
        results = {"table": tables.answer(run)}
        progress.finish(tables.num_trials() or 0)
        results["trial"] = run.checkpoint("trial", lambda: push.answer(run).data)
        progress.finish(1)
        results["hardware"] = hardware.answer(run)
        if run.folder is not None:
            for name, dataset in results.items():
                labelled = dataset.assign_attrs(self.attributes())
                files.write_results(run.folder / f"{name}.nc", labelled)
        return xr.DataTree.from_dict(results)

    def intro(self, results: xr.DataTree) -> str:
        return "The numbers of the paper *Pushing in the Dark* beside ours."

    def report(self, results: xr.DataTree, run: Run) -> Sequence[Section]:
        trial, (_, push, hardware) = results["trial"].to_dataset(), self.parts
        reached = "reached" if int(trial.outcome_success) else "not reached"
        text = f"The target is {reached} at {float(trial.outcome_time):.1f} s."
        fig_6 = Picture("trial", partial(figures.one_trial, trial, push.case.title))
        left_open = "`notebooks/03_paper` lists our readings; `sweeps/paper_reading` infers them."
        ground, robot = (map("{:g}".format, x) for x in zip(*FRICTION.values(), strict=True))
        rows = [["", *FRICTION], ["object-ground", *ground], ["object-robot", *robot]]
        profile = Picture("profile", partial(figures.profile, RPSParams.paper()))
        return [
            Section("Table I: friction", "As in the paper, by construction.", rows),
            Section("Fig. 3: the adaptive rate", "", (), profile),
            _objects(),
            *table.sections(results["table"].to_dataset()),
            Section("Fig. 6: the box to (-2, 0) under S1", text, (), fig_6),
            *hardware.report(results["hardware"].to_dataset(), run),
            Section("What the paper leaves open", left_open),
        ]


paper = call_of(Paper)


def _objects() -> Section:
    try:
        images = []
        for name in PAPER_OBJECTS:
            loaded = scene.load(name)
            qpos = scene.initial_qpos(loaded)
            images += video.images(loaded, [qpos], p_world_target=np.array([2, 0]))
    except video.VideoError as error:
        return Section("Fig. 4: the objects", f"Not drawn: {error}")
    picture = Picture("objects", partial(figures.stills, images, PAPER_OBJECTS))
    return Section("Fig. 4: the objects", "", (), picture)
