"""The ladder of laws: all laws in the same test worlds, ordered by senses.

The order of the senses is `touch` (where the skin is touched), `taxels` (each taxel's signal),
`force` (the contact force) and `pose` (where the object is). The worlds are test worlds: their
seed is one that no tuner uses.
"""

import contextlib
import dataclasses
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, ClassVar, get_args

import xarray as xr

from rps_jax import Domain, InputError, errors
from rps_jax.analysis import statistics, tables
from rps_jax.analysis.figures.style import WIDTH, Figure, panel, styled
from rps_jax.control import registry
from rps_jax.control.base import Senses
from rps_jax.control.registry import LawLike
from rps_jax.laws import LawParams, LawsLike, law_of, resolve_law
from rps_jax.questions import MultiLawQuestion, Picture, Run, Section, call_of, option
from rps_jax.record.files import JsonObject
from rps_jax.runs.question import Rows, TaskOption
from rps_jax.runs.sweep import Sweep, SweepOptions, describe_plan
from rps_jax.trials.case import suited_laws
from rps_jax.trials.progress import ProgressCallback
from rps_jax.worlds import DomainLike

REFERENCE = "rps_tuned"  # the law that all others are compared with
_MARKS = "osvD^"  # of the senses in the figure


def all_laws() -> tuple[str, ...]:
    """Return the names of all registered laws, ordered by their senses."""
    order, laws = get_args(Senses), registry.LAWS
    return tuple(sorted(laws, key=lambda name: order.index(law_of(laws[name]).senses)))


@dataclass(frozen=True)
class _TestSweep(Sweep):
    """Sweep over the test worlds of one domain, labelled with what each law senses."""

    def labelled(self, outcomes: xr.Dataset, run: Run) -> xr.Dataset:
        outcomes = super().labelled(outcomes, run)
        laws = [law_of(self.chosen[str(law)]) for law in outcomes.law.values]
        senses = "law", [x.senses for x in laws], {"long_name": "what the law senses"}
        drives = "law", [" ".join(x.drives) for x in laws], {"long_name": "bases it can move"}
        return outcomes.assign_coords(senses=senses, drives=drives)

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        first, *rest = super().report(results, run)
        return [first, *rest] if "row" in results.dims else [first, *_comparison(results), *rest]


@dataclass(frozen=True)
class Ladder(SweepOptions, TaskOption, MultiLawQuestion[xr.Dataset | xr.DataTree]):
    """Compare laws in the same test worlds, ordered by senses.

    No tuner sees test worlds. The result for one domain has the outcomes (law, world), and as
    coordinates the drawn quantities (world) and `senses` (law). The result for several domains is
    a tree with one such dataset for each domain.

    Examples:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> results = rps_jax.ladder(("rps", "pursuit"), drums, worlds=4, setting=setting)
      >>> dict(results.success.sizes), results.senses.values.tolist()
      ({'law': 2, 'world': 4}, ['touch', 'touch'])
    """

    TITLE = "Laws in the same worlds"
    QUICK: ClassVar = {"worlds": 64, "domain": ("wide,objects=random_box",)}

    laws: LawsLike = ()
    """The laws, by default all laws of the package that the robot can follow: names, as rps,
    rps_tuned or rps_plus, or a file's, as my_law.py:MyParams or policy.npz; changes follow each, as
    rps,K_h=0.3 or rps,tuned.json."""
    domain: DomainLike | Sequence[DomainLike] = ("wide",)
    """Domains: their names, or JSON files of ranges. Changes follow each, as wide,mass=3:10."""
    worlds: int | None = option(None, 1, 1_000_000_000)
    """Number of worlds of each domain; by default 1000, or the grid of a domain with listed targets
    (paper: 144). With several domains it is at most that grid."""

    @cached_property
    def chosen(self) -> dict[str, LawParams]:
        if not isinstance(self.laws, tuple) or self.laws:
            return registry.resolve_laws(self.laws)
        return registry.resolve_laws(suited_laws(*self._robot_and_task, all_laws()))

    @cached_property
    def sweeps(self) -> dict[str, _TestSweep]:
        """Sweep of each domain, by the name of the domain."""
        domains = [self.domain] if isinstance(self.domain, str | Domain) else list(self.domain)
        labels = [x if isinstance(x, str) else f"domain_{i}" for i, x in enumerate(domains)]
        errors.check_each_once("domain", domains, labels)
        names, of_sweep = ({f.name for f in dataclasses.fields(x)} for x in (self, _TestSweep))
        names = (names & of_sweep) - {"laws", "domain"}
        shared: dict[str, Any] = {name: getattr(self, name) for name in names}
        shared["setting"] = replace(self.setting, split="test")
        sweeps = {}
        for label, domain in zip(labels, domains, strict=True):
            sweep = _TestSweep(self.chosen, domain, **shared)
            if len(domains) > 1 and self.worlds is not None and sweep.ranges.targets:
                sweep = replace(sweep, worlds=min(self.worlds, sweep.ranges.combinations))
            sweeps[label.replace("/", "_")] = sweep
        return sweeps

    @property
    def single(self) -> _TestSweep | None:
        """Sweep of the domain, if there is only one."""
        first, *rest = self.sweeps.values()
        return None if rest else first

    def check(self) -> None:
        for name in () if self.single else ("points", "ray", "shard"):
            if getattr(self, name) not in (None, "1/1"):
                raise InputError(f"{name} is not allowed with several domains: name one domain.")
        for sweep in self.sweeps.values():
            sweep.check()

    def num_trials(self) -> int | None:
        return sum(sweep.num_trials() or 0 for sweep in self.sweeps.values())

    def configuration(self) -> JsonObject:
        if self.single:
            return self.single.configuration()
        return {"ladder": {name: sweep.configuration() for name, sweep in self.sweeps.items()}}

    def execute(self, callback: ProgressCallback) -> xr.Dataset | xr.DataTree:
        return self.single.execute(callback) if self.single else super().execute(callback)

    def answer(self, run: Run) -> xr.DataTree:
        run, progress = run.in_parts()
        results = {}
        for name, sweep in self.sweeps.items():
            results[name] = sweep.answer(run.inside(_file_name(name)))
            progress.finish(sweep.plan.num_trials)
        return xr.DataTree.from_dict(results)

    def intro(self, results: xr.Dataset | xr.DataTree) -> str:
        return "\n\n".join(describe_plan(sweep.plan) for sweep in self.sweeps.values())

    def report(self, results: xr.Dataset | xr.DataTree, run: Run) -> Sequence[Section]:
        if self.single and isinstance(results, xr.Dataset):
            return self.sections(self.single, results, run)
        sections = []
        for name, sweep in self.sweeps.items():
            inner, of_domain = run.inside(_file_name(name)), results[name].to_dataset()
            for section in self.sections(sweep, of_domain, inner):
                if picture := section.picture:  # pictures of all domains are in one folder
                    picture = picture._replace(name=f"{picture.name}_{_file_name(name)}")
                sections.append(section._replace(title=f"{section.title}, {name}", picture=picture))
        return sections

    def sections(self, sweep: Sweep, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Return the sections of the report about one domain."""
        return sweep.report(results, run)


ladder = call_of(Ladder)


def _file_name(domain: str) -> str:
    return re.sub(r"[^\w.=,-]", "_", domain)


@dataclass(frozen=True)
class _ScoredLaw:
    """Option of the scored law, which comes before all others."""

    law: LawLike = option("", positional=True)
    """The law: FILE.py, FILE.py:CLASS where the file registers several, policy.npz, or a law of the
    package; changes follow, as my_law.py,gain=0.2."""


@dataclass(frozen=True)
class Score(Ladder, _ScoredLaw):
    """Score a custom law in the test worlds of the ladder, beside rps and rps_plus.

    The worlds depend only on domain, number and seed, so scores of several people compare. The
    report has one line for a Markdown table. The result is that of `rps_jax.ladder`.

    Examples:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> results = rps_jax.score("pursuit", domain=drums, worlds=4, setting=setting)
      >>> results.law.values.tolist()
      ['pursuit', 'rps', 'rps_plus']
    """

    TITLE = "Score of a law"

    laws: LawsLike = ()
    """The laws beside it, by default rps and rps_plus, or the first law for a base that cannot move
    sideways; changes follow each, as rps,K_h=0.3 or rps,tuned.json."""

    @cached_property
    def chosen(self) -> dict[str, LawParams]:
        label, params = resolve_law(self.law)
        scored = {label: registry.check_params(params)}
        rivals, where = self.laws, self._robot_and_task
        with contextlib.suppress(InputError):  # no law of the package suits robot and task
            rivals = rivals or suited_laws(*where, ("rps", "rps_plus"))
        return scored | (registry.resolve_laws(rivals) if rivals else {}) | scored

    def sections(self, sweep: Sweep, results: xr.Dataset, run: Run) -> Sequence[Section]:
        sections = super().sections(sweep, results, run)
        if "row" in results.dims:
            return sections
        rows = score_row(sweep, results, self.setting.seed)
        table = textwrap.indent(tables.markdown(rows), "    ")
        return [Section("Score", f"For a Markdown table:\n\n{table}"), *sections]


score = call_of(Score)


def score_row(sweep: Sweep, results: xr.Dataset, seed: int) -> Rows:
    """Return a header and the row of the first law: rates of all laws, median time and worlds."""
    successes = results.success.values > 0
    first, *rates = map(tables.rate, successes)
    law, *rest = map(str, results.law.values)
    median = tables.median(results.time.values[0][successes[0]])
    source = f"seed {seed}" if sweep.points is None else "given points"
    worlds = f"{successes.shape[1]:,} test worlds of {sweep.worlds_in_words}, {source}"
    header = ["law", "success", "median time", *rest, "worlds"]
    return [header, [law, first, median, *rates, f"{worlds}, {sweep.setting.engine}"]]


def _comparison(results: xr.Dataset) -> list[Section]:
    """Return the sections about success by senses, and about differences from the reference."""
    text = (
        "Senses of the laws: `touch` is where the skin is touched, `taxels` adds the signal "
        "of each taxel, `force` adds the contact force, and `pose` adds the object's position and "
        "size. Bases that cannot move sideways can follow the laws with open marks."
    )
    picture = Picture("ladder", partial(draw_ladder, results))
    sections = [Section("Information against success", text, (), picture)]
    if REFERENCE in results.law and results.sizes["law"] > 1:
        rows = tables.against_table(results, REFERENCE)
        sections.append(Section(f"Against {REFERENCE}, world by world", "", rows))
    return sections


@styled
def draw_ladder(results: xr.Dataset) -> Figure:
    """Draw the success of each law, grouped by senses, with Wilson's 95 % intervals."""
    senses = results.senses.to_series().to_dict()
    drives = results.get("drives", results.senses).to_series()
    kinds, total = get_args(Senses), results.sizes["world"]
    counts = (results.success > 0).sum("world").to_series().to_dict()
    order = sorted(senses, key=lambda law: (-kinds.index(senses[law]), counts[law]))
    above = {"xytext": (0, 6), "textcoords": "offset points", "ha": "center"}
    figure, ax = panel((WIDTH, 0.8 + 0.3 * len(order)), "success [%]", "")
    ax.grid(visible=False, axis="y")
    for y, law in enumerate(order):
        index, rate = kinds.index(senses[law]), 100 * counts[law] / total
        low, high = statistics.wilson(counts[law], total)
        ax.plot([100 * low, 100 * high], [y, y], color=f"C{index}", lw=3, alpha=0.4)
        fill = "none" if " " in str(drives[law]) else "full"
        ax.plot(rate, y, _MARKS[index], color=f"C{index}", fillstyle=fill)
        ax.annotate(tables.percent(counts[law], total), (rate, y), **above)
    for kind in sorted(set(senses.values()), key=kinds.index):
        index = kinds.index(kind)
        ax.plot([], [], _MARKS[index], color=f"C{index}", label=f"senses {kind}")
    ax.set_yticks(range(len(order)), order)
    ax.set(xlim=(-3, 103), ylim=(-0.6, len(order) - 0.3))
    ax.set_title(f"{total:,} worlds, the same for all laws")
    ax.legend()
    return figure
