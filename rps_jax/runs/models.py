"""How much does a success rate hang on the model? The same worlds on every physics that can be
defended: grounds, cones and steps between which measurements have not decided.

A rate has two errors. Its statistical interval says what other worlds would have given; the spread
over models says what another simulation would have.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import xarray as xr

from rps_jax.control.strategies import Params
from rps_jax.engines import EngineName
from rps_jax.robot.robot import Robot
from rps_jax.runs import sweep as sweeps
from rps_jax.runs.plan import Plan
from rps_jax.trials.setting import InTurn, Report, Setting, unheard
from rps_jax.trials.trial import Rules
from rps_jax.world.domain import Domain, named
from rps_jax.world.physics import MUJOCOS_GROUND, Physics, preset

_HALVED = replace(preset(), timestep=0.005)
# Fine enough for MuJoCo's own ground, on which sliding objects hop.
_FINE = replace(preset(), timestep=0.002, **MUJOCOS_GROUND)
OWN = "as asked"  # the model of the sweep itself


class Model(NamedTuple):
    """A physics that can be defended."""

    physics: Physics
    engine: EngineName | None = None  # None: that of the sweep


# What can be defended, beside what a sweep was asked for.
MODELS = {
    "this ground, 10 ms": Model(preset()),
    "this ground, 5 ms": Model(_HALVED),
    "MuJoCo's ground, 5 ms": Model(replace(_HALVED, **MUJOCOS_GROUND)),
    "MuJoCo's ground, 2 ms": Model(_FINE),
    "MuJoCo's ground, impratio 1, 2 ms": Model(replace(_FINE, impratio=1.0)),
    "quasi-static": Model(preset(), "quasistatic"),
    "friction pyramid, 1 ms": Model(preset("paper_gazebo")),
}


def plans(plan: Plan) -> dict[str, Plan]:
    """A sweep on every model that can step its worlds, its own first; the worlds are the same."""
    found = {OWN: plan}
    for name, (physics, engine) in MODELS.items():
        engine = engine or plan.setting.engine
        setting = replace(plan.setting, physics=physics, engine=engine)
        other = replace(plan, setting=setting)
        if setting != plan.setting and other.works:
            found[name] = other
    return found


def folder_of(out: Path, model: str) -> Path:
    """Where in a run folder the sweep on a model is kept."""
    name = "".join(letter if letter.isalnum() else "_" for letter in model)
    return out / "models" / name


def models(
    domain: Domain | str,
    arms: Mapping[str, Params],
    worlds: int = 1000,
    seed: int = 0,
    engine: EngineName = "fused",
    out: str | Path | None = None,
    *,
    rules: Rules = Rules(),
    robot: Robot | str | None = None,
    report: Report = unheard,
    **shape: Any,
) -> xr.Dataset:
    """Every arm in the same random worlds, on every model.

    Args:
      domain: ranges of what differs between worlds, or their name in `DOMAINS`.
      arms: names and parameters of any strategies.
      worlds: how many, of indices 0, 1, ...
      seed: of the worlds.
      engine: what steps them.
      out: run folder, in which a run that was killed is continued; None keeps all in memory.
      rules: when a trial ends.
      robot: by its name in `ROBOTS`, or a JSON file's; None: the domain's.
      report: called after every segment of the run.
      shape: `slots` and `workers` of `sweep`.

    Returns:
      Outcomes (model, arm, world), and what was drawn (world) as coordinates.

    Raises:
      InputError: an argument is not allowed, or `out` holds another run.

    Example:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=1.0)
      >>> arms = {"rps": rps_jax.RPSParams.paper()}
      >>> found = rps_jax.models(drums, arms, worlds=2, rules=rules)
      >>> found.sizes["model"]
      7
    """
    setting = Setting(preset(), rules, seed, engine)
    plan = Plan(named(domain, robot), worlds, arms, setting)
    plan.check_here()
    return complete(plan, None if out is None else Path(out), report=report, **shape)


def complete(
    plan: Plan,
    out: Path | None,
    own: xr.Dataset | None = None,
    *,
    report: Report = unheard,
    **shape: Any,
) -> xr.Dataset:
    """What a run folder lacks of a sweep on every model, and the whole as (model, arm, world).

    The sweep as it was asked for stands in the folder itself, the others in folders of their own
    in it. Its `own` results are not run or read again, if they are at hand.
    """
    found, heard = {} if own is None else {OWN: own}, InTurn(report)
    for name, one in plans(plan).items():
        if name in found:
            continue
        folder = out if out is None or one is plan else folder_of(out, name)
        found[name] = sweeps.whole(one, folder, report=heard, **shape)
        heard.ended(one.trials)
    joined = xr.concat(found.values(), "model", coords="minimal", compat="override")
    return joined.assign_coords(model=list(found))
