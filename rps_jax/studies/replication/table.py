"""The paper's Table II: every strategy pushes every object to every target, under each friction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import xarray as xr

from rps_jax import errors
from rps_jax.control.strategies import Params
from rps_jax.trials import pushes, results
from rps_jax.trials.conditions import Conditions, Which, arms_of, label_of
from rps_jax.trials.pushes import Case
from rps_jax.trials.setting import Report, unheard
from rps_jax.world import paper
from rps_jax.world.objects import PAPER_OBJECTS


def cases_of(
    arms: Mapping[str, Params],
    objects: Sequence[str],
    friction: Sequence[Which],
    targets: Sequence[tuple[float, float]],
    conditions: Conditions,
) -> list[Case]:
    """Every combination, in the nesting order of `results.outcome_dataset`.

    Raises:
      InputError: one is named twice, or is not possible.
    """
    for name, given in (("objects", objects), ("friction", friction)):
        errors.check_each_once(name, given)
    return [
        conditions.case(thing, contact, target, params)
        for params in arms.values()
        for thing in objects
        for contact in friction
        for target in targets
    ]


def table(
    objects: Sequence[str] = PAPER_OBJECTS,
    strategies: Sequence[str] | Mapping[str, Params] = paper.STRATEGIES,
    friction: Sequence[Which] = ("S1", "S2"),
    targets: Sequence[tuple[float, float]] = paper.TARGETS,
    engine: Any = "mjx",
    *,
    slots: int | None = None,
    workers: int | None = None,
    report: Report = unheard,
    **conditions: Any,
) -> xr.Dataset:
    """Outcomes of every combination, by default the paper's 432 trials.

    Args:
      objects: the objects, by name.
      strategies: what decides: names, or names with parameters.
      friction: friction sets of the paper's Table I, or coefficients ground, robot [1].
      targets: x, y [m] in the world, where the base starts at the origin.
      engine: what steps the worlds.
      slots: worlds stepped at once by a worker; by default as suits engine and device.
      workers: host threads; by default as suits engine and device.
      report: called after every segment of the run.
      conditions: further fields of `Conditions`, as `mass` or `skin`.

    Returns:
      Outcomes (strategy, object, friction, target).

    Raises:
      InputError: an argument is not allowed.

    Example:
      >>> import rps_jax
      >>> few = {"targets": [(1.0, 0.0), (1.0, 1.0)], "objects": ["cylinder"]}
      >>> found = rps_jax.table(**few, strategies=["rps"], engine="mujoco", horizon=2.0)
      >>> dict(found.success.sizes)
      {'strategy': 1, 'object': 1, 'friction': 2, 'target': 2}
    """
    chosen = Conditions.of({"engine": engine} | conditions)
    arms = arms_of(strategies)
    cases = cases_of(arms, objects, friction, targets, chosen)
    outcome, _ = pushes.run(cases, chosen.setting(), slots=slots, workers=workers, report=report)
    labels = [label_of(one) for one in friction]
    return results.outcome_dataset(outcome, list(arms), objects, labels, targets)
