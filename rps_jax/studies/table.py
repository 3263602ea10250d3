"""The paper's Table II: all laws push all objects to all targets, under each friction."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Annotated, ClassVar

import xarray as xr

from rps_jax import InputError, errors
from rps_jax.analysis import tables
from rps_jax.analysis.figures.paper import min_distance
from rps_jax.laws import LawsLike
from rps_jax.questions import MultiLawQuestion, Picture, Run, Section, call_of
from rps_jax.record import files
from rps_jax.runs.push import case_options
from rps_jax.runs.question import DefaultLaws
from rps_jax.trials import pushes
from rps_jax.trials.case import FrictionLike, TrialOptions
from rps_jax.trials.results import outcome_dataset
from rps_jax.world import paper
from rps_jax.world.objects import PAPER_OBJECTS, STORED
from rps_jax.worlds import Case


@dataclass(frozen=True)
class Table(TrialOptions, MultiLawQuestion[xr.Dataset]):
    """Run the paper's trials (by default all 432), and compare with its Table II.

    The result has the outcomes (law, object, friction, target).

    Examples:
      >>> import rps_jax
      >>> brief = rps_jax.Setting("mujoco", rules=rps_jax.Rules(horizon=2.0))
      >>> few = {"targets": [(1.0, 0.0), (1.0, 1.0)], "objects": ["cylinder"]}
      >>> results = rps_jax.table("rps", **few, setting=brief)
      >>> dict(results.success.sizes)
      {'law': 1, 'object': 1, 'friction': 2, 'target': 2}
    """

    TITLE = "Table II: successes"
    QUICK: ClassVar = {"targets": paper.FEW_TARGETS}

    laws: LawsLike = DefaultLaws(paper.LAWS)
    objects: Annotated[Sequence[str], STORED] = PAPER_OBJECTS
    """Objects to push: their names, or custom MJCF files, FILE.xml, as of `rps push --object`."""
    friction: Sequence[FrictionLike] = ("S1", "S2")
    """Frictions: sets of the paper's Table I (S1, S2), or coefficients GROUND,ROBOT."""
    targets: Sequence[tuple[float, float]] = paper.TARGETS
    """Targets X Y [m] in the world, one pair after the other; the base starts at the origin. By
    default the paper's 24."""

    @cached_property
    def cases(self) -> list[Case]:
        """Cases of all combinations, in the nesting order of `results.outcome_dataset`."""
        for name in ("objects", "friction"):
            errors.check_each_once(name, getattr(self, name))
        sensing = case_options(self, self.setting)
        grid = product(self.chosen.values(), self.objects, self.friction, self.targets)
        return [Case(name, friction, xy, law, **sensing) for law, name, friction, xy in grid]

    def check(self) -> None:
        if not self.cases:
            raise InputError("targets = () is not allowed: name at least one.")
        self.setting.check_here(self.cases[0].base, self.chosen.values())

    def num_trials(self) -> int | None:
        return len(self.cases)

    def answer(self, run: Run) -> xr.Dataset:
        return run.checkpoint("table", partial(self.run_cases, run))

    def run_cases(self, run: Run) -> xr.Dataset:
        """Run all cases, and return their outcomes."""
        outcome, _ = pushes.run(self.cases, self.setting, **run.batch_options)
        objects = [Path(x).stem if files.suffix_of(x) == ".xml" else x for x in self.objects]
        frictions = [
            x if isinstance(x, str) else ",".join(map("{:g}".format, x)) for x in self.friction
        ]
        return outcome_dataset(outcome, list(self.chosen), objects, frictions, self.targets)

    def intro(self, results: xr.Dataset) -> str:
        return (
            f"{results.success.size} trials, engine {self.setting.engine}, steps of "
            f"{1000 * self.setting.physics.timestep:g} ms."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        return sections(results)


table = call_of(Table)


def sections(outcomes: xr.Dataset) -> list[Section]:
    """Return the sections with Table II beside the paper's, and Fig. 5."""
    text = "  \n".join([*tables.summary(outcomes).splitlines(), tables.grid_note(outcomes)])
    picture = Picture("min_distance", partial(min_distance, outcomes))
    return [
        Section("Table II: successes", text, tables.table_ii(outcomes)),
        Section("Fig. 5: least distance of contact to target", "", (), picture),
    ]
