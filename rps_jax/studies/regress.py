"""Regression worlds: 200 hard worlds in which new laws are compared with earlier ones.

`regression.nc` holds points of the unit cube of the domain `wide`, and the outcomes of the paper's
law, the tuned one, RPS+ and the learned law of 0.3 at these points. Each world was picked because
one of these laws fails there, or nearly fails; drawing and `rps attack` supplied the candidates. A
success rate in these worlds therefore says nothing about other worlds: only differences between
laws count.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import xarray as xr

from rps_jax import Rules
from rps_jax.laws import LawsLike
from rps_jax.questions import MultiLawQuestion, Plan, Run, Section, call_of, option
from rps_jax.record import files
from rps_jax.runs.question import Rows
from rps_jax.runs.sweep import PlanQuestion
from rps_jax.trials.score import severity_of
from rps_jax.world import points
from rps_jax.world.domain import DOMAINS

FILE = Path(__file__).with_name("regression.nc")
DOMAIN = "wide"
Known = Literal["rps", "rps_tuned", "rps_plus", "learned_gru"]


def worlds() -> xr.Dataset:
    """Load the points `u` (world, quantity), and `success` and `severity` (known, world)."""
    return files.read_dataset(FILE)


@dataclass(frozen=True)
class Regress(PlanQuestion, MultiLawQuestion[xr.Dataset]):
    """Compare laws with earlier laws in 200 hard worlds.

    The result has the outcomes (law, world), and those of the earlier laws, `known_success` and
    `known_severity` (known, world).

    Examples:
      >>> import rps_jax
      >>> brief = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=1.0))
      >>> results = rps_jax.regress({"mine": "rps,K_h=0.3"}, worlds=3, setting=brief)
      >>> dict(results.known_success.sizes)
      {'known': 4, 'world': 3}
    """

    TITLE = "Hard worlds"
    QUICK: ClassVar = {"worlds": 20}

    laws: LawsLike = ("rps_tuned",)
    worlds: int | None = option(None, 1, 200)
    """Number of worlds, from the first on; by default all."""
    against: Known = "rps_tuned"
    """Earlier law with which each world is compared."""

    @functools.cached_property
    def plan(self) -> Plan:
        """Sweep over the points of the file."""
        at = points.check_points(DOMAINS[DOMAIN], worlds().u.values[: self.worlds])
        return Plan(DOMAINS[DOMAIN], len(at.u), self.chosen, self.setting, points=at)

    def attributes(self) -> dict[str, str | int]:
        return super().attributes() | {"domain": DOMAIN}

    def labelled(self, outcomes: xr.Dataset, run: Run) -> xr.Dataset:
        outcomes = super().labelled(outcomes, run)
        known = worlds()[["success", "severity"]].reset_coords(drop=True)
        known = known.isel(world=slice(outcomes.sizes["world"]))
        known.known.attrs["long_name"] = "earlier law"
        return outcomes.merge(known.rename({name: f"known_{name}" for name in known}))

    def intro(self, results: xr.Dataset) -> str:
        return (
            f"The first {results.sizes['world']} of 200 worlds in which some law fails, or nearly "
            "fails. A rate in them says nothing about other worlds; only differences count."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        sections = [Section("Successes", "", success_table(results))]
        for law in self.chosen:
            rows = changes(results, law, self.against, self.setting.rules)
            if len(rows) > 1:
                sections.append(Section(f"{law} against {self.against}, world by world", "", rows))
        return sections


regress = call_of(Regress)


def success_table(results: xr.Dataset) -> Rows:
    """Return a row for each law: its gains and losses against each law of the file."""
    known, laws = results.known_success > 0, results.success > 0
    against = (f"against {law}" for law in known.known.values)
    rows = [["", "successes", *against, "successes where all of them fail"]]
    for law, success in zip(known.known.values, known.values, strict=True):
        count = f"{success.sum()} of {success.size}"
        rows.append([f"{law} (file)", count, *[""] * (len(known) + 1)])
    for law, success in zip(laws.law.values, laws.values, strict=True):
        gains = [f"+{(success & ~x).sum()} -{(~success & x).sum()}" for x in known.values]
        unique = str((success & ~known.values.any(axis=0)).sum())
        rows.append([str(law), f"{success.sum()} of {success.size}", *gains, unique])
    return rows


def changes(results: xr.Dataset, law: str, against: str, rules: Rules = Rules()) -> Rows:
    """Return a row for each world whose outcome changes with a law, the worst losses first."""
    severity = severity_of(results.sel(law=law), rules)
    earlier = results.known_severity.sel(known=against).values
    rows = [["world", "object", against, law]]
    for world in np.argsort(earlier - severity, kind="stable"):
        if (severity[world] < 1) != (earlier[world] < 1):
            cells = [_outcome(float(values[world])) for values in (earlier, severity)]
            name = str(results.object.values[world]).replace("_", " ")
            rows.append([str(world), name, *cells])
    return rows


def _outcome(severity: float) -> str:
    return "succeeds" if severity < 1 else f"fails, {100 * (severity - 1):.0f} cm off"
