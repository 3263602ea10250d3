"""Worlds that were hard: what a new law wins and loses of them, in seconds.

`regression.nc` holds 200 points of the unit cube of the domain `wide`: worlds in which the paper's
law, the tuned one, RPS+ or the learned GRU fails, or almost does, found by drawing and by `attack`;
and how these laws did there. The worlds were picked because some law is bad in them. So a rate in
them says nothing about rates elsewhere, and only differences between laws count.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import xarray as xr

from rps_jax.analysis.report import Section
from rps_jax.control.registry import LawsLike
from rps_jax.record import files
from rps_jax.record.options import option
from rps_jax.runs.plan import Plan
from rps_jax.runs.question import MultiLawQuestion, Run, call_of
from rps_jax.runs.sweep import PlanQuestion
from rps_jax.trials.score import severity_of
from rps_jax.trials.trial import Rules
from rps_jax.world import points
from rps_jax.world.domain import DOMAINS

FILE = Path(__file__).with_name("regression.nc")
DOMAIN = "wide"
Known = Literal["rps", "rps_tuned", "rps_plus", "learned_gru"]


def worlds() -> xr.Dataset:
    """Read the points `u` (world, quantity), and `success` and `severity` (known, world)."""
    return files.read_dataset(FILE)


@dataclass(frozen=True)
class Regress(PlanQuestion, MultiLawQuestion[xr.Dataset]):
    """Try laws in 200 worlds that were hard for those before them, and compare.

    The answer holds outcomes (law, world), and as `known_success` and `known_severity` (known,
    world) those of the laws of the file.

    Example:
      >>> import rps_jax
      >>> brief = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=1.0))
      >>> found = rps_jax.regress({"mine": "rps,K_h=0.3"}, worlds=3, setting=brief)
      >>> dict(found.known_success.sizes)
      {'known': 4, 'world': 3}
    """

    TITLE: ClassVar[str] = "Worlds that were hard"

    laws: LawsLike = ("rps_tuned",)
    worlds: int | None = option(None, 1, 200)
    """Number of the worlds, of the first ones; by default all."""
    against: Known = "rps_tuned"
    """Law of the file against which changes are listed."""

    @functools.cached_property
    def plan(self) -> Plan:
        """What is run."""
        at = points.checked(DOMAINS[DOMAIN], worlds().u.values[: self.worlds])
        return Plan(DOMAINS[DOMAIN], len(at.u), self.chosen, self.setting, points=at)

    def answer(self, run: Run) -> xr.Dataset:
        found = super().answer(run)
        known = worlds().isel(world=slice(found.sizes["world"]))
        return found.assign(
            known_success=(("known", "world"), known.success.values),
            known_severity=(("known", "world"), known.severity.values),
        ).assign_coords(known=known.known.values)

    def intro(self, results: xr.Dataset) -> str:
        return (
            f"The first {results.sizes['world']} of 200 worlds in which some law failed, or almost "
            "did. A rate in them says nothing about rates elsewhere; only differences count."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        sections = [Section("Wins", "", table(results))]
        for law in self.chosen:
            rows = changes(results, law, self.against, self.setting.rules)
            if len(rows) > 1:
                sections.append(Section(f"{law} against {self.against}, world by world", "", rows))
        return sections


regress = call_of(Regress)


def table(found: xr.Dataset) -> list[list[str]]:
    """Header and a row for each law: what it gains and loses against each of the file's."""
    known = [str(law) for law in found.known.values]
    rows = [["", "wins", *(f"against {law}" for law in known), "wins what none of them does"]]
    for law in known:
        won = int((found.known_success.sel(known=law) > 0).sum())
        rows.append([f"{law} (file)", f"{won} of {found.sizes['world']}", *[""] * len(known), ""])
    best = (found.known_success.values > 0).any(axis=0)
    for law in map(str, found.law.values):
        won = found.success.sel(law=law).values > 0
        cells = []
        for other in known:
            before = found.known_success.sel(known=other).values > 0
            cells.append(f"+{int((won & ~before).sum())} -{int((~won & before).sum())}")
        rows.append([law, f"{int(won.sum())} of {won.size}", *cells, str(int((won & ~best).sum()))])
    return rows


def changes(found: xr.Dataset, law: str, against: str, rules: Rules = Rules()) -> list[list[str]]:
    """Header and a row for each world whose outcome a law changes, the worst losses first."""
    now = severity_of(found.sel(law=law), rules)
    before = found.known_severity.sel(known=against).values
    rows = [["world", "object", against, law]]
    names = [str(name) for name in found.object.values]
    for world in np.argsort(before - now, kind="stable"):
        if (now[world] < 1) != (before[world] < 1):
            thing = names[int(found.which_object[world])].replace("_", " ")
            rows.append([str(world), thing, _told(float(before[world])), _told(float(now[world]))])
    return rows


def _told(severity: float) -> str:
    return "wins" if severity < 1 else f"fails, {100 * (severity - 1):.0f} cm off"
