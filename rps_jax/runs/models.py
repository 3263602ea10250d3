"""How much does a success rate hang on the model? The same worlds on every physics that can be
defended: grounds, cones and steps between which measurements have not decided.

A rate has two errors. Its statistical interval says what other worlds would have given; the spread
over models says what another simulation would have.
"""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import xarray as xr

from rps_jax.analysis.report import Section
from rps_jax.engines import EngineName
from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.runs import sweep as sweeps
from rps_jax.runs.plan import Plan
from rps_jax.runs.question import Run, call_of
from rps_jax.runs.sweep import OfPlan
from rps_jax.trials.progress import InTurn, Report, unheard
from rps_jax.world.physics import MUJOCOS_GROUND, preset

_HALVED = replace(preset(), timestep=0.005)
# Fine enough for MuJoCo's own ground, on which sliding objects hop.
_FINE = replace(preset(), timestep=0.002, **MUJOCOS_GROUND)
OWN = "as asked"  # the model of the sweep itself


# What can be defended, beside what a sweep was asked for.
MODELS = {
    "this ground, 10 ms": preset(),
    "this ground, 5 ms": _HALVED,
    "MuJoCo's ground, 5 ms": replace(_HALVED, **MUJOCOS_GROUND),
    "MuJoCo's ground, 2 ms": _FINE,
    "MuJoCo's ground, impratio 1, 2 ms": replace(_FINE, impratio=1.0),
    "quasi-static": preset(),
    "friction pyramid, 1 ms": preset("paper_gazebo"),
}
ENGINES: dict[str, EngineName] = {"quasi-static": "quasistatic"}  # of the others that of the sweep


def plans(plan: Plan) -> dict[str, Plan]:
    """A sweep on every model that can step its worlds, its own first; the worlds are the same."""
    found = {OWN: plan}
    for name, physics in MODELS.items():
        engine = ENGINES.get(name, plan.setting.engine)
        with contextlib.suppress(InputError):  # the engine knows no such worlds, laws or physics
            setting = replace(plan.setting, physics=physics, engine=engine)
            other = replace(plan, setting=setting)
            other.check_here()
            if setting != plan.setting:
                found[name] = other
    return found


@dataclass(frozen=True)
class Models(OfPlan):
    """Push with every law in the same random worlds on every model of the physics.

    Example:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=1.0)
      >>> found = rps_jax.models("rps", drums, worlds=2, setting=rps_jax.Setting(rules=rules))
      >>> found.sizes["model"]
      7
    """

    TITLE: ClassVar[str] = "Random worlds on several models of the physics"
    SMALL: ClassVar[Mapping[str, Any]] = {"worlds": 24}

    def trials(self) -> int | None:
        return self.plan.trials * len(plans(self.plan))

    def answer(self, run: Run) -> xr.Dataset:
        """Outcomes (model, law, world), and what was drawn (world) as coordinates."""
        return complete(self.plan, run.folder, **run.shape)

    def report(self, found: xr.Dataset, run: Run) -> Sequence[Section]:
        return sweeps.spread(with_models(found.isel(model=0), found))


models = call_of(Models)


def with_models(found: xr.Dataset, every: xr.Dataset) -> xr.Dataset:
    """Outcomes (law, world) with the success of the same worlds on every model beside them."""
    success = every.success.assign_coords(model=every.model)
    return found.assign(model_success=success.transpose("model", "law", "world"))


def added(found: xr.Dataset, plan: Plan, run: Run) -> xr.Dataset:
    """Outcomes of a plan, and beside them the success of the same worlds on every other model."""
    every = complete(plan, run.folder, found, **run.shape)
    if run.folder is not None:
        files.write_results(run.folder / "models.nc", every)
    return with_models(found, every)


def complete(
    plan: Plan,
    out: Path | None,
    own: xr.Dataset | None = None,
    *,
    report: Report = unheard,
    **shape: Any,
) -> xr.Dataset:
    """What a run folder lacks of a sweep on every model, and the whole as (model, law, world).

    The sweep as it was asked for stands in the folder itself, the others in folders of their own
    in it. Its `own` results are not run or read again, if they are at hand.
    """
    found, heard = {} if own is None else {OWN: own}, InTurn(report)
    for name, one in plans(plan).items():
        if name in found:
            continue
        plain = "".join(letter if letter.isalnum() else "_" for letter in name)
        folder = out if out is None or one is plan else out / "models" / plain
        found[name] = sweeps.whole(one, folder, report=heard, **shape)
        heard.ended(one.trials)
    joined = xr.concat(found.values(), "model", coords="minimal", compat="override")
    return joined.assign_coords(model=list(found))
