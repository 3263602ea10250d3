"""Laws in worlds that are kept for testing, domain after domain."""

import functools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import xarray as xr

from rps_jax import errors
from rps_jax.analysis import tables
from rps_jax.analysis.report import Section
from rps_jax.record.options import option
from rps_jax.robot.robot import RobotLike
from rps_jax.runs import sweep as sweeps
from rps_jax.runs.question import OfLaws, Run, call_of, seed_of
from rps_jax.runs.sweep import Sweep
from rps_jax.trials.progress import InTurn
from rps_jax.world.domain import DomainLike


@dataclass(frozen=True)
class Compare(OfLaws[xr.DataTree]):
    """Compare laws in worlds kept for testing, which no tuner has seen, in several domains.

    The answer is a tree with the outcomes (law, world) of each domain, as of `rps_jax.sweep`.

    Example:
      >>> import rps_jax
      >>> brief = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=1.0))
      >>> drums = "wide,objects=random_cylinder"
      >>> found = rps_jax.compare("rps", (drums,), worlds=2, setting=brief)
      >>> dict(found["wide,objects=random_cylinder"].success.sizes)
      {'law': 1, 'world': 2}
    """

    TITLE: ClassVar[str] = "Laws in worlds kept for testing"
    SMALL: ClassVar[Mapping[str, Any]] = {"worlds": 64, "domain": ("wide",)}

    domain: Sequence[DomainLike] = ("paper", "wide", "hostile", "prisms")
    """Domains, each a run of its own: paper, hardware, wide, real, hostile, prisms, or JSON files
    of ranges; changes follow each, as wide,mass=3:10."""
    worlds: int = option(10_000, 1, 1_000_000_000)
    """Number of worlds of each domain; the paper's domain has its grid of 144."""
    robot: RobotLike | None = field(default=None, kw_only=True)
    """The robot: ideal, kairos (the paper's), ridgeback or mpo_500, or a JSON file. By default the
    domain's."""

    @functools.cached_property
    def parts(self) -> dict[str, Sweep]:
        """A sweep for each domain."""
        several = [self.domain] if isinstance(self.domain, str) else list(self.domain)
        labels = [name if isinstance(name, str) else f"own_{i}" for i, name in enumerate(several)]
        errors.check_each_once("domain", several, labels)
        seeded = replace(self.setting, seed=seed_of(self.setting.seed, "test"))
        found = {}
        for label, one in zip(labels, several, strict=True):
            sweep = Sweep(self.chosen, one, robot=self.robot, setting=seeded, part=4096)
            if not sweep.ranges.targets:
                sweep = replace(sweep, worlds=self.worlds)
            found[label.replace("/", "_")] = sweep
        return found

    def check(self) -> None:
        for part in self.parts.values():
            part.check()

    def trials(self) -> int | None:
        return sum(part.plan.trials for part in self.parts.values())

    def configuration(self) -> dict[str, Any]:
        return {"compare": {name: one.plan.configuration() for name, one in self.parts.items()}}

    def answer(self, run: Run) -> xr.DataTree:
        heard, found = InTurn(run.report), {}
        shape = run._replace(report=heard).shape
        for name, one in self.parts.items():
            out = run.folder and run.folder / re.sub(r"[^\w.=,-]", "_", name)
            found[name] = sweeps.whole(one.plan, out, **shape)
            heard.ended(one.plan.trials)
        return xr.DataTree.from_dict(found)

    def intro(self, found: xr.DataTree) -> str:
        return (
            f"Seed {self.setting.seed} of the worlds for testing, engine {self.setting.engine}; "
            "every law meets the same worlds. Intervals: Wilson 95 %."
        )

    def report(self, found: xr.DataTree, run: Run) -> Sequence[Section]:
        sections = []
        for name in self.parts:
            results = found[name].to_dataset()
            first = sweeps.rates(results, float(self.setting.rules.max_lost))
            sections.append(first._replace(title=f"Success in {name}"))
            if results.sizes["law"] > 1:
                rows = tables.difference_table(results)
                sections.append(Section(f"Differences in {name}, world by world", "", rows))
        return sections


compare = call_of(Compare)
