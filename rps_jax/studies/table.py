"""The paper's Table II: every law pushes every object to every target, under each friction."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar

import xarray as xr

from rps_jax import errors
from rps_jax.analysis import figures, tables
from rps_jax.analysis.report import Picture, Section
from rps_jax.control import registry
from rps_jax.control.registry import LawsLike
from rps_jax.record import files
from rps_jax.record import folder as run_folder
from rps_jax.runs.plan import setting_of
from rps_jax.runs.push import case_options
from rps_jax.runs.question import MultiLawQuestion, Run, call_of
from rps_jax.trials import pushes, results
from rps_jax.trials.case import Case, FrictionLike, TrialOptions, label_of
from rps_jax.world import paper
from rps_jax.world.objects import PAPER_OBJECTS


@dataclass(frozen=True)
class Table(TrialOptions, MultiLawQuestion[xr.Dataset]):
    """Run the paper's trials: by default its 432, with Table II beside the paper's.

    The answer holds outcomes (law, object, friction, target).

    Example:
      >>> import rps_jax
      >>> brief = rps_jax.Setting("mujoco", rules=rps_jax.Rules(horizon=2.0))
      >>> few = {"targets": [(1.0, 0.0), (1.0, 1.0)], "objects": ["cylinder"]}
      >>> found = rps_jax.table("rps", **few, setting=brief)
      >>> dict(found.success.sizes)
      {'law': 1, 'object': 1, 'friction': 2, 'target': 2}
    """

    TITLE: ClassVar[str] = "Table II: successes"
    QUICK: ClassVar[Mapping[str, Any]] = {"targets": paper.FEW_TARGETS}

    laws: LawsLike = paper.LAWS
    objects: Sequence[str] = PAPER_OBJECTS
    """Objects to push: their names, or MJCF files of one's own, FILE.xml."""
    friction: Sequence[FrictionLike] = ("S1", "S2")
    """Frictions: sets of the paper's Table I (S1, S2), or coefficients GROUND,ROBOT."""
    targets: Sequence[tuple[float, float]] = paper.TARGETS
    """Targets X Y [m], one pair after the other, in the world, where the base starts at the
    origin; by default the paper's 24."""

    @cached_property
    def cases(self) -> list[Case]:
        """Every combination, in the nesting order of `results.outcome_dataset`."""
        for name in ("objects", "friction"):
            errors.check_each_once(name, getattr(self, name))
        given = case_options(self, self.setting)
        return [
            Case(thing, contact, target, params, **given)
            for params in self.chosen.values()
            for thing in self.objects
            for contact in self.friction
            for target in self.targets
        ]

    def check(self) -> None:
        if not self.cases:
            raise errors.InputError("targets = () is not allowed: name at least one.")
        self.setting.check_here(self.cases[0].base, self.chosen.values())

    def num_trials(self) -> int | None:
        return len(self.cases)

    def answer(self, run: Run) -> xr.Dataset:
        return run.checkpoint("table", partial(self._run, run))

    def _run(self, run: Run) -> xr.Dataset:
        outcome, _ = pushes.run(self.cases, self.setting, **run.batch_options)
        labels = [label_of(one) for one in self.friction]
        names = (
            list(self.chosen),
            [Path(one).stem if one.endswith(".xml") else one for one in self.objects],
        )
        return results.outcome_dataset(outcome, *names, labels, self.targets)

    def intro(self, results: xr.Dataset) -> str:
        return (
            f"{results.success.size} trials, engine {self.setting.engine}, steps of "
            f"{1000 * self.setting.physics.timestep:g} ms. Intervals: Wilson 95 %, in percent."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        return sections(results)


table = call_of(Table)


def sections(found: xr.Dataset) -> list[Section]:
    """Table II beside the paper's, and Fig. 5."""
    text = "  \n".join(tables.summary(found).splitlines())
    picture = Picture("min_distance", partial(figures.min_distance, found))
    return [
        Section("Table II: successes", text, tables.table_ii(found)),
        Section("Fig. 5: least distance of contact to target", "", (), picture),
    ]


def table_of(folder: Path) -> Table:
    """Read the question of a run folder of `rps table`.

    Raises:
      InputError: it holds none, or one with a robot or skin of one's own.
    """
    try:
        found = run_folder.read_manifest(folder)
        setting = setting_of(found["setting"])
        laws = {name: registry.params_from_json(law) for name, law in found["laws"].items()}
        pairs = {name: _tuples(found[name]) for name in ("objects", "friction", "targets")}
        given = {one.name: found[one.name] for one in dataclasses.fields(TrialOptions)}
        if found["question"] != "table":
            raise KeyError("question")
    except (LookupError, TypeError, AttributeError, ValueError) as error:
        raise files.CorruptFileError(folder / run_folder.MANIFEST, error) from error
    if any(isinstance(given[name], dict) for name in ("robot", "skin")):
        raise errors.InputError(
            f"run = {folder} has a robot or skin of one's own: film it from Python."
        )
    return Table(laws, **pairs, **given, setting=setting)


def _tuples(value: Any) -> Any:
    """JSON's lists as tuples."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
