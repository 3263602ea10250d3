"""A ladder of laws: every law of the package in the same worlds, by what it senses.

On the first rungs a law senses only where its skin is touched, on the next also with which force,
then where the object is.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, ClassVar, get_args

import numpy as np
import xarray as xr

from rps_jax.analysis import statistics, tables
from rps_jax.analysis.figures.style import Figure
from rps_jax.analysis.report import Picture, Section
from rps_jax.control import registry
from rps_jax.control.base import Params, Senses
from rps_jax.control.registry import LawLike, LawsLike
from rps_jax.record.options import option
from rps_jax.runs.plan import Plan
from rps_jax.runs.question import Run, call_of, name_of, seed_of
from rps_jax.runs.sweep import Sweep

REFERENCE = "rps_tuned"  # what the others are compared with


def every_law() -> tuple[str, ...]:
    """Names of all laws that are known, by what they sense."""
    order, known = get_args(Senses), registry.LAWS
    return tuple(sorted(known, key=lambda name: order.index(_senses(known[name]))))


def _senses(params: Params) -> Senses:
    return registry.law_of(params).senses


@dataclass(frozen=True)
class Ladder(Sweep):
    """Push with every law of the package in the same worlds, and compare by what each law senses.

    The worlds are kept for testing: no tuner has seen them. The answer holds outcomes (law, world),
    and as coordinates what was drawn (world) and `senses` (law).

    Example:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> found = rps_jax.ladder(("rps", "pursuit"), drums, worlds=4, setting=setting)
      >>> dict(found.success.sizes), found.senses.values.tolist()
      ({'law': 2, 'world': 4}, ['touch', 'touch'])
    """

    TITLE: ClassVar[str] = "Laws in the same worlds"
    SMALL: ClassVar[Mapping[str, Any]] = {"worlds": 64, "domain": "wide,objects=random_box"}

    laws: LawsLike = ()
    """The laws, by default every law of the package: names, as rps, rps_tuned or rps_plus, or a
    file's, as my_law.py:MyParams or policy.npz; changes follow each, as rps,K_h=0.3 or
    rps,tuned.json."""

    @cached_property
    def chosen(self) -> dict[str, Params]:
        asked = self.laws
        return registry.laws_of(every_law() if isinstance(asked, tuple) and not asked else asked)

    @cached_property
    def plan(self) -> Plan:
        plan = super().plan
        seed = seed_of(self.setting.seed, "test")
        return dataclasses.replace(plan, setting=dataclasses.replace(plan.setting, seed=seed))

    def answer(self, run: Run) -> xr.Dataset:
        found = super().answer(run)
        if "row" in found.dims:  # but a share of it
            return found
        senses = [_senses(self.chosen[str(law)]) for law in found.law.values]
        return found.assign_coords(senses=("law", senses, {"long_name": "what the law senses"}))

    def report(self, found: xr.Dataset, run: Run) -> Sequence[Section]:
        usual = super().report(found, run)
        return usual if "row" in found.dims else [*usual[:1], *_rungs(found), *usual[1:]]


ladder = call_of(Ladder)


@dataclass(frozen=True)
class _Own:
    """A law of one's own."""

    law: LawLike = option("", positional=True)
    """The law: FILE.py, FILE.py:CLASS where the file registers several, policy.npz, or a law of the
    package; changes follow, as my_law.py,gain=0.2."""


@dataclass(frozen=True)
class Score(Ladder, _Own):
    """Score a law of one's own in the test worlds of the ladder, beside rps and rps_plus.

    The worlds depend on domain, number and seed alone, so scores of several people compare. The
    report has one line for a Markdown table; the answer is that of `rps_jax.ladder`.

    Example:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> found = rps_jax.score("pursuit", domain=drums, worlds=4, setting=setting)
      >>> found.law.values.tolist()
      ['pursuit', 'rps', 'rps_plus']
    """

    TITLE: ClassVar[str] = "Score of a law"

    laws: LawsLike = ("rps", "rps_plus")
    """The laws beside it; changes follow each, as rps,K_h=0.3 or rps,tuned.json."""

    @cached_property
    def chosen(self) -> dict[str, Params]:
        label, params = registry.read_law(self.law)
        others = registry.laws_of(self.laws)
        return {label: registry.checked(params)} | {k: v for k, v in others.items() if k != label}

    def report(self, found: xr.Dataset, run: Run) -> Sequence[Section]:
        usual = Sweep.report(self, found, run)
        if "row" in found.dims:
            return usual
        head, own = self.line(found)
        text = "To be pasted into a table in Markdown:\n\n"
        lines = (head, ["---"] * len(head), own)
        text += "\n".join(f"    | {' | '.join(row)} |" for row in lines)
        return [Section("Score", text), *usual]

    def line(self, found: xr.Dataset) -> list[list[str]]:
        """Header and the row of the law: success, its median time, the others, and the worlds."""
        won = found.success.values > 0
        rates = [tables.share(int(one.sum()), one.size) for one in won]
        own, *others = map(str, found.law.values)
        took = found.time.values[0][won[0]]
        median = f"{np.median(took):.1f} s" if took.size else "-"
        drawn = f"seed {self.setting.seed}" if self.points is None else "given points"
        worlds = f"{won.shape[1]:,} test worlds of {name_of(self.domain)}, {drawn}"
        header = ["law", "success", "median time", *others, "worlds"]
        return [header, [own, rates[0], median, *rates[1:], f"{worlds}, {self.setting.engine}"]]


score = call_of(Score)


def _rungs(found: xr.Dataset) -> list[Section]:
    """Success by what the laws sense, and against the reference."""
    text = (
        "Laws by what they sense: `touch` is where the skin is touched, `taxels` also what each "
        "taxel answers, `force` also the contact's force, and `pose` also where the object is and "
        "how large."
    )
    picture = Picture("ladder", partial(figure_of, found))
    sections = [Section("Information against success", text, (), picture)]
    if REFERENCE in found.law and found.sizes["law"] > 1:
        title = f"Against {REFERENCE}, world by world"
        rows = tables.against_table(found, REFERENCE)
        sections.append(Section(title, _shared(found), rows))
    return sections


def _shared(found: xr.Dataset) -> str:
    """How many failures of the reference any law of each kind wins, in a sentence."""
    failed = found.success.sel(law=REFERENCE).values == 0
    senses = dict(zip(map(str, found.law.values), map(str, found.senses.values), strict=True))
    parts = []
    for kind in dict.fromkeys(senses.values()):
        others = [name for name in senses if senses[name] == kind and name != REFERENCE]
        if others:
            won = (found.success.sel(law=others).values > 0).any(axis=0)
            count = int((won & failed).sum())
            parts.append(f"{count} are won by some other law that senses {kind}")
    won = (found.success.values > 0).any(axis=0)
    parts.append(f"{int((~won).sum())} by none")
    worlds = f"{failed.sum()} worlds" if failed.sum() != 1 else "one world"
    return f"Of the {worlds} that {REFERENCE} loses, {', '.join(parts)}."


def figure_of(found: xr.Dataset) -> Figure:
    """Draw the success of each law, grouped by what it senses, with Wilson's 95 % intervals."""
    senses = dict(zip(map(str, found.law.values), map(str, found.senses.values), strict=True))
    kinds = [kind for kind in get_args(Senses) if kind in senses.values()]
    colours = {kind: f"C{i}" for i, kind in enumerate(get_args(Senses))}
    rates = {law: float(found.success.sel(law=law).mean()) for law in senses}
    order = sorted(rates, key=lambda law: (-kinds.index(senses[law]), rates[law]))
    figure = Figure(figsize=(7, 1.2 + 0.34 * len(order)), layout="constrained")
    ax = figure.subplots()
    for at, law in enumerate(order):
        won = found.success.sel(law=law).values > 0
        low, high = statistics.wilson(int(won.sum()), won.size)
        ax.plot([100 * low, 100 * high], [at, at], color=colours[senses[law]], lw=3, alpha=0.4)
        ax.plot(100 * rates[law], at, "o", color=colours[senses[law]])
        ax.annotate(
            tables.percent(int(won.sum()), won.size), (100 * rates[law], at), (0, 6), fontsize=8,
            textcoords="offset points", ha="center",
        )  # fmt: skip
    for kind in kinds:
        ax.plot([], [], "o", color=colours[kind], label=f"senses {kind}")
    ax.set_yticks(range(len(order)), order)
    ax.set_ylim(-0.6, len(order) - 0.3)
    ax.set_xlim(-3, 103)
    ax.set_xlabel("success [%]")
    ax.set_title(f"{found.sizes['world']:,} equal worlds for every law", fontsize=10)
    ax.grid(axis="x", alpha=0.3)
    ax.legend(fontsize=8, loc="best")
    return figure
