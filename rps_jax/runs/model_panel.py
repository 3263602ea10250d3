"""Runs of one plan on a panel of physics models, for the option `models` of a sweep.

The models are grounds, supports, friction cones and time steps between which measurements do not
decide. A success rate has two errors: its statistical interval is the effect of other worlds, and
its range over the models is the effect of another simulation.
"""

import contextlib
from dataclasses import replace

import xarray as xr

from rps_jax.engines import EngineName
from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.runs.execution import run_plan
from rps_jax.runs.plan import Plan
from rps_jax.runs.run import Run
from rps_jax.world.physics import MUJOCO_GROUND, preset

_HALVED = replace(preset(), timestep=0.005)
# Short steps for MuJoCo's default ground, on which sliding objects hop.
_FINE = replace(preset(), timestep=0.002, **MUJOCO_GROUND)
REQUESTED = "as asked"  # label of the model that the sweep itself has

MODELS = {
    "this ground, 10 ms": preset(),
    "this ground, 5 ms": _HALVED,
    "MuJoCo's ground, 5 ms": replace(_HALVED, **MUJOCO_GROUND),
    "MuJoCo's ground, 2 ms": _FINE,
    "MuJoCo's ground, impratio 1, 2 ms": replace(_FINE, impratio=1.0),
    "even pressure": replace(preset(), support="even"),
    "pressure on the rim": replace(preset(), support="rim"),
    "quasi-static": preset(),
    "friction pyramid, 1 ms": preset("paper_gazebo"),
}
ENGINES: dict[str, EngineName] = {"quasi-static": "quasistatic"}  # the rest: the sweep's engine


def model_plans(plan: Plan) -> dict[str, Plan]:
    """Return a plan on every model that can step its worlds, its own model first."""
    plans, period = {REQUESTED: plan}, plan.setting.physics.control_period
    for name, physics in MODELS.items():
        engine = ENGINES.get(name, plan.setting.engine)
        with contextlib.suppress(InputError):  # the engine lacks such worlds, laws or physics
            physics = replace(physics, control_period=period)
            setting = replace(plan.setting, physics=physics, engine=engine)
            model_plan = replace(plan, setting=setting)
            model_plan.check_here()
            if setting != plan.setting:
                plans[name] = model_plan
    return plans


def add_models(results: xr.Dataset, plan: Plan, run: Run) -> xr.Dataset:
    """Run a plan on every other model, and add the success (model, law, world) to its results.

    The run on another model has its own folder in `models`. `models.nc` has all outcomes.
    """
    (run, progress), by_model = run.in_parts(), {REQUESTED: results}
    progress.finish(plan.num_trials)
    for name, model_plan in model_plans(plan).items():
        if name != REQUESTED:
            safe = "".join(letter if letter.isalnum() else "_" for letter in name)
            folder = run.inside(f"models/{safe}").folder
            by_model[name] = run_plan(model_plan, folder, **run.batch_options)
            progress.finish(model_plan.num_trials)
    joined = xr.concat(by_model.values(), "model", coords="minimal", compat="override")
    joined = joined.assign_coords(model=list(by_model))
    if run.folder is not None:
        files.write_results(run.folder / "models.nc", joined)
    success = joined.success.transpose("model", "law", "world").assign_attrs(results.success.attrs)
    return results.assign(model_success=success)
