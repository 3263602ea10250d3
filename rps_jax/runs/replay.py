"""One world of a sweep again, followed."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from rps_jax import engines, errors
from rps_jax.control import strategies
from rps_jax.runs.plan import Plan, load_plan, scene_of, title_of, world_part
from rps_jax.trials import pushes
from rps_jax.trials.push import Push
from rps_jax.trials.setting import Report, unheard


def chosen(run: Path, world: int, arm: str | None = None) -> tuple[Plan, str]:
    """The plan of a sweep, one of whose worlds can be followed, and the arm that is meant.

    An engine whose trials cannot be followed is replaced by the fused one.

    Raises:
      InputError: the folder holds no sweep, or not this world or arm.
    """
    plan = load_plan(run)
    name = errors.check_name("arm", arm or next(iter(plan.arms)), plan.arms)
    errors.check_count("index", world, at_least=0, at_most=plan.worlds - 1)
    if not engines.get(plan.setting.engine).traced:
        plan = dataclasses.replace(plan, setting=dataclasses.replace(plan.setting, engine="fused"))
    engines.get(plan.setting.engine).check_followed()
    return plan, name


def replay(
    run: str | Path, world: int, arm: str | None = None, *, report: Report = unheard
) -> Push:
    """One world of a sweep again, followed from its start to its end.

    Args:
      run: the run folder of the sweep.
      world: index of the world.
      arm: which of the sweep's arms; by default the first.
      report: called now and then.

    Raises:
      InputError: the folder holds no sweep, or not this world or arm.

    Example:
      >>> import tempfile, rps_jax
      >>> arms, rules = {"rps": rps_jax.RPSParams.paper()}, rps_jax.Rules(horizon=1.0)
      >>> with tempfile.TemporaryDirectory() as run:
      ...     found = rps_jax.sweep("wide", arms, worlds=3, out=run, rules=rules)
      ...     again = rps_jax.replay(run, 2)
      >>> bool(again.outcome.success) == bool(found.success.sel(arm="rps", world=2))
      True
    """
    plan, name = chosen(Path(run), world, arm)
    part = world_part(plan, list(plan.arms).index(name), [world])
    strategy = strategies.of(plan.arms[name])
    (trace,) = pushes.follow_part(part, strategy, plan.setting, report=report)
    return Push(trace, scene_of(plan, world), title_of(plan, world))
