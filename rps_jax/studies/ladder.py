"""A ladder of laws: every law of the package in the same worlds, by what it is told.

A rung is a law with its parameters: its authors' own, or tuned here. On the first rungs a law is
told only where its skin is touched, on the next also with which force, then where the object is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import xarray as xr

from rps_jax import errors
from rps_jax.analysis import figures, tables
from rps_jax.analysis.report import Section
from rps_jax.control import strategies
from rps_jax.control.law import RPSParams
from rps_jax.control.learned import policy
from rps_jax.control.rivals.aps import APSParams
from rps_jax.control.rivals.dipole import DipoleParams
from rps_jax.control.rivals.force_push import ForcePushParams
from rps_jax.control.rivals.force_push_published import PublishedForcePushParams
from rps_jax.control.rivals.pursuit import PursuitParams
from rps_jax.control.rps_plus import RPSPlusParams
from rps_jax.control.strategies import Params
from rps_jax.engines import EngineName
from rps_jax.record import files
from rps_jax.robot.robot import Robot
from rps_jax.runs import sweep
from rps_jax.runs.evaluate import seed_of
from rps_jax.runs.plan import Plan
from rps_jax.trials.setting import Report, Setting, unheard
from rps_jax.trials.trial import Rules
from rps_jax.world.domain import Domain, named
from rps_jax.world.physics import Fidelity, PhysicsName, preset

REFERENCE = "rps tuned"  # what the others are compared with
RUNGS: dict[str, Params] = {
    "nps": RPSParams.nps(),
    "rps paper": RPSParams.paper(),
    REFERENCE: RPSParams.tuned(),
    "rps_plus": RPSPlusParams(),
    "pursuit": PursuitParams(),
    "force_push": ForcePushParams(),
    "force_push_published": PublishedForcePushParams(),
    "aps": APSParams(),
    "dipole": DipoleParams(),
} | {name: strategies.PARAMS[name] for name in policy.SHIPPED}


def rungs(names: Sequence[str] = tuple(RUNGS)) -> dict[str, Params]:
    """Laws by their names in `RUNGS`, or of a file: `my_law.py:MyParams` or `policy.npz`.

    A law with other values is `pursuit=FILE`, where the file holds JSON, as `rps tune es` writes
    it, of what differs from that rung; it is called by the file's name without its ending.

    Raises:
      InputError: none is asked for, one twice, or one that is unknown or cannot be read.
    """
    errors.check_each_once("laws", names)
    found: dict[str, Params] = {}
    for name in names:
        own, params = _rung(name)
        if own in found:
            raise errors.InputError(f"laws = {' '.join(names)} are not allowed: two are {own}.")
        found[own] = params
    return found


def _rung(text: str) -> tuple[str, Params]:
    """The name and the parameters of one of them."""
    if ".py:" in text or text.endswith(".npz"):
        return strategies.named(text)
    name, other, file = text.partition("=")
    params = RUNGS[errors.check_name("law", name, RUNGS)]
    if not other:
        return name, params
    return Path(file).stem, strategies.with_values(params, files.read_json(Path(file)), file)


def senses(laws: Mapping[str, Params]) -> dict[str, str]:
    """What each law is told."""
    return {name: strategies.of(params).senses for name, params in laws.items()}


def ladder(
    domain: Domain | str = "wide",
    worlds: int = 1000,
    seed: int = 0,
    laws: Sequence[str] | Mapping[str, Params] = tuple(RUNGS),
    engine: EngineName = "fused",
    out: str | Path | None = None,
    *,
    physics: PhysicsName = "default",
    fidelity: Fidelity = "standard",
    rules: Rules = Rules(),
    robot: Robot | str | None = None,
    part: int = 1024,
    slots: int | None = None,
    workers: int | None = None,
    report: Report = unheard,
) -> xr.Dataset:
    """Every law in the same random worlds.

    Args:
      domain: ranges of what differs between worlds, or their name in `DOMAINS`.
      worlds: how many, of indices 0, 1, ...
      seed: whose worlds for testing are taken, which no tuner has seen.
      laws: names of `RUNGS`, or laws of files, as `rungs` reads them; or parameters by names of
        one's own.
      engine: what steps them.
      out: run folder, in which a run that was killed is continued; None keeps all in memory.
      physics: how friction is modelled.
      fidelity: how finely the physics is solved.
      rules: when a trial ends.
      robot: by its name in `ROBOTS`, or a JSON file's; None: the domain's.
      part: trials of a part at most, which is what a run that is killed loses.
      slots: worlds stepped at once by a worker; by default as suits engine and device.
      workers: host threads; by default as suits engine and device.
      report: called after every segment of the run.

    Returns:
      Outcomes (law, world); what was drawn (world), and `senses` (law), as coordinates.

    Raises:
      InputError: an argument is not allowed, or `out` holds another run.

    Example:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> found = rps_jax.ladder(drums, 4, laws=("rps paper", "pursuit"), rules=rules)
      >>> dict(found.success.sizes), found.senses.values.tolist()
      ({'law': 2, 'world': 4}, ['touch', 'touch'])
    """
    arms = dict(laws) if isinstance(laws, Mapping) else rungs(laws)
    setting = Setting(preset(physics, fidelity), rules, seed_of(seed, "test"), engine)
    plan = Plan(named(domain, robot), worlds, arms, setting, part)
    plan.check_here()
    shape = {"slots": slots, "workers": workers, "report": report}
    results = sweep.whole(plan, None if out is None else Path(out), **shape)
    return by_law(results, arms)


def by_law(results: xr.Dataset, laws: Mapping[str, Params]) -> xr.Dataset:
    """The results of a sweep with a dimension `law`, and what each is told."""
    told = senses(laws)
    named_ = results.rename(arm="law")
    return named_.assign_coords(senses=("law", [told[str(law)] for law in named_.law.values]))


def sections(folder: Path, plan: Plan, results: xr.Dataset) -> list[Section]:
    """What the report of a ladder says beyond that of a sweep, with its figure in the folder."""
    told = senses(plan.arms)
    picture = figures.ladder(results, told, folder / "ladder.png")
    text = (
        "Laws by what they are told: `touch` is where the skin is touched, `taxels` also what each "
        "taxel answers, `force` also the contact's force, and `pose` also where the object is and "
        "how large."
    )
    found = [Section("Information against success", text, (), picture)]
    if REFERENCE in plan.arms and len(plan.arms) > 1:
        found.append(
            Section(
                f"Against {REFERENCE}, world by world",
                _shared(results, told),
                tables.against_table(results, REFERENCE),
            )
        )
    return found


def _shared(results: xr.Dataset, told: Mapping[str, str]) -> str:
    """How many of the failures of the reference any law of each kind wins, in a sentence."""
    failed = results.success.sel(arm=REFERENCE).values == 0
    parts = []
    for kind in dict.fromkeys(told.values()):
        others = [name for name in told if told[name] == kind and name != REFERENCE]
        if others:
            won = (results.success.sel(arm=others).values > 0).any(axis=0)
            parts.append(
                f"{int((won & failed).sum())} are won by some other law that is told {kind}"
            )
    won = (results.success.values > 0).any(axis=0)
    parts.append(f"{int((~won).sum())} by none")
    return f"Of the {int(failed.sum())} worlds that {REFERENCE} loses, {', '.join(parts)}."
