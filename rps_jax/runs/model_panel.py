"""Runs of one plan on a panel of physics models, for the option `models` of a sweep.

The models are grounds, friction cones and time steps between which measurements do not decide. A
success rate has two errors: its statistical interval is the effect of other worlds, and its range
over the models is the effect of another simulation.
"""

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import xarray as xr

from rps_jax.engines import EngineName
from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.runs.execution import run_plan
from rps_jax.runs.plan import Plan
from rps_jax.runs.question import Run
from rps_jax.trials.progress import ProgressCallback, SequentialProgress, no_progress
from rps_jax.world.physics import MUJOCO_GROUND, preset

_HALVED = replace(preset(), timestep=0.005)
# Fine enough for MuJoCo's own ground, on which sliding objects hop.
_FINE = replace(preset(), timestep=0.002, **MUJOCO_GROUND)
OWN = "as asked"  # the model of the sweep itself


# What can be defended, beside what a sweep was asked for.
MODELS = {
    "this ground, 10 ms": preset(),
    "this ground, 5 ms": _HALVED,
    "MuJoCo's ground, 5 ms": replace(_HALVED, **MUJOCO_GROUND),
    "MuJoCo's ground, 2 ms": _FINE,
    "MuJoCo's ground, impratio 1, 2 ms": replace(_FINE, impratio=1.0),
    "quasi-static": preset(),
    "friction pyramid, 1 ms": preset("paper_gazebo"),
}
ENGINES: dict[str, EngineName] = {"quasi-static": "quasistatic"}  # of the others that of the sweep


def model_plans(plan: Plan) -> dict[str, Plan]:
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


def with_models(found: xr.Dataset, every: xr.Dataset) -> xr.Dataset:
    """Outcomes (law, world) with the success of the same worlds on every model beside them."""
    success = every.success.assign_coords(model=every.model)
    return found.assign(model_success=success.transpose("model", "law", "world"))


def add_models(found: xr.Dataset, plan: Plan, run: Run) -> xr.Dataset:
    """Outcomes of a plan, and beside them the success of the same worlds on every other model."""
    every = run_models(plan, run.folder, found, **run.batch_options)
    if run.folder is not None:
        files.write_results(run.folder / "models.nc", every)
    return with_models(found, every)


def run_models(
    plan: Plan,
    out: Path | None,
    own: xr.Dataset | None = None,
    *,
    callback: ProgressCallback = no_progress,
    **shape: Any,
) -> xr.Dataset:
    """What a run folder lacks of a sweep on every model, and the whole as (model, law, world).

    The sweep as it was asked for stands in the folder itself, the others in folders of their own
    in it. Its `own` results are not run or read again, if they are at hand.
    """
    found, heard = {} if own is None else {OWN: own}, SequentialProgress(callback)
    for name, one in model_plans(plan).items():
        if name in found:
            continue
        plain = "".join(letter if letter.isalnum() else "_" for letter in name)
        folder = out if out is None or one is plan else out / "models" / plain
        found[name] = run_plan(one, folder, callback=heard, **shape)
        heard.finish(one.num_trials)
    joined = xr.concat(found.values(), "model", coords="minimal", compat="override")
    return joined.assign_coords(model=list(found))
