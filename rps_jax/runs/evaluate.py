"""Scores of candidates, parameters of one law, in random worlds: all candidates in one batch.

Worlds for tuning, validation and testing have different seeds.
"""

import math
from collections.abc import Sequence, Set
from dataclasses import replace
from typing import Any, NamedTuple, Unpack

import jax
import numpy as np
import xarray as xr

from rps_jax import errors
from rps_jax.control import registry
from rps_jax.control.base import LawParams
from rps_jax.control.registry import LawLike
from rps_jax.engines import device
from rps_jax.errors import InputError
from rps_jax.record import cache, provenance
from rps_jax.record import options as options_
from rps_jax.robot.robot import RobotLike
from rps_jax.trials import batch
from rps_jax.trials.batch import outcomes
from rps_jax.trials.progress import Bar, ProgressCallback, Timing, is_interactive
from rps_jax.trials.results import POSE, WORLD, labelled, variable
from rps_jax.trials.score import Objective
from rps_jax.trials.setting import Setting, Split, seed_of
from rps_jax.trials.trial import Outcome
from rps_jax.trials.worlds import BatchOptions, Candidates
from rps_jax.world import points as points_
from rps_jax.world.domain import DomainLike, name_or_custom, parse_domain, task_attribute
from rps_jax.world.tasks import TaskLike


@device.standard_jax()
def evaluate(
    law: LawLike | Sequence[LawLike],
    domain: DomainLike = "wide",
    worlds: int = 256,
    *,
    points: xr.Dataset | np.ndarray | None = None,
    split: Split = "tune",
    objective: Objective = Objective(),
    robot: RobotLike | None = None,
    task: TaskLike | None = None,
    setting: Setting = Setting(),
    slots: int | None = None,
    workers: int | None = None,
    progress: bool | None = None,
    report_to: ProgressCallback | None = None,
) -> xr.Dataset:
    """Score candidates, parameters of one law, in the same random worlds.

    All candidates run through one compiled program for each shape family of the objects. A later
    call with as many candidates and worlds, of whatever values and seed, compiles nothing.

    Args:
      law: the candidates: parameters of a law, a pytree whose leaves are all (P, ...), one entry
        for each of P candidates (`stack` makes one of several); or several laws of one class; or
        one alone.
      domain: ranges from which worlds are drawn: a name, or a file of ranges.
      worlds: number of worlds for each candidate, of indices 0, 1, ...
      points: points of the unit cube at which the worlds lie instead, as `worlds_at` returns.
      split: use of the worlds; no sweep of any seed has worlds for tuning or validation.
      objective: score of a trial.
      robot: its name, as kairos, or a JSON file; None: the domain's.
      task: its name, as path, with changes; None: the domain's.
      setting: engine, physics, fidelity, rules, and the seed of the worlds.
      slots: worlds that one worker steps at once; by default as suits engine and device.
      workers: host threads; by default as suits engine and device.
      progress: whether a bar shows the progress; by default in a terminal and in a notebook.
      report_to: callback that receives the progress instead of a bar.

    Returns:
      Scores and outcomes (candidate, world). Coordinates are the drawn quantities (world) and the
      scalar parameters (candidate) by name. A lower score is better.

    Raises:
      InputError: an argument is not allowed.

    Examples:
      >>> import numpy as np
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> four = rps_jax.stack([f"rps,L={length}" for length in (0.1, 0.2, 0.5, 1.0)])
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> results = rps_jax.evaluate(four, drums, 2, setting=setting)
      >>> results.score.mean("world").shape
      (4,)
    """
    device.check_eager("evaluate", locals())
    options_.check_arguments(evaluate, locals())
    device.check_process()
    ranges, params = parse_domain(domain, robot, task), candidates(law)
    setting = setting.with_robot(ranges.robot)
    at = None if points is None else points_.check_points(ranges, points)
    count = worlds if at is None else len(at.u)
    errors.check_count("worlds", count, at_most=10_000_000)
    params, seed = _checked(params), seed_of(setting.seed, split)
    setting.check_domain(ranges, [batch.rows(params, 0)])
    request = Candidates(params, [ranges], seed, np.arange(count), at)
    cache.use_cache_if_requested()
    is_shown = is_interactive() if progress is None else progress
    with Bar("evaluate", math.prod(request.shape), shown=is_shown and report_to is None) as bar:
        options = BatchOptions(callback=report_to or bar, slots=slots, workers=workers)
        (scored,), _ = score_candidates([request], setting, objective, **options)
    dims = "candidate", "world"
    variables = labelled(score=(dims, scored.score, "1", "objective"))
    for name, values in scored.outcome.columns().items():
        variables[name] = variable(name, dims, values)
    drawn = points_.drawn_columns(ranges, seed, at, request.worlds)
    tried = _parameters(params, {*variables, *drawn, "pose", "world", "candidate"})
    indices = {
        "candidate": ("candidate", np.arange(scored.score.shape[0]), {"long_name": "candidate"}),
        "world": ("world", request.worlds, {"long_name": WORLD}),
    }
    attrs = provenance.attributes() | replace(setting, split=split).attributes
    attrs |= {"domain": name_or_custom(domain), "law": type(params).__name__}
    attrs |= task_attribute(ranges)
    return xr.Dataset(variables, {"pose": POSE} | indices | tried | drawn, attrs)


def _parameters(params: LawParams, reserved: Set[str]) -> dict[str, xr.Variable]:
    """Return the scalar parameters (candidate) by name, or as `params.NAME` if that is reserved."""
    columns = {}
    for name, values in registry.named_leaves(params).items():
        if values.ndim == 1:
            attrs = {"long_name": f"parameter {name} of the law"}
            label = f"params.{name}" if name in reserved else name
            columns[label] = xr.Variable("candidate", values, attrs)
    return columns


def stack(laws: Sequence[LawLike]) -> LawParams:
    """Stack parameters of one law: candidates with leaves (P, ...), one entry for each.

    Args:
      laws: texts or parameters, all of one class.

    Raises:
      InputError: there is none, or they are of different classes or shapes.

    Examples:
      >>> import rps_jax
      >>> rps_jax.stack(["rps", "rps,K_h=0.3"]).K_h.tolist()
      [1.0, 0.3]
    """
    options_.check_arguments(stack, {"laws": laws})
    several = [registry.resolve_law(law)[1] for law in laws]
    kinds = {type(params).__name__ for params in several}
    if len(kinds) != 1:
        raise InputError(
            f"laws of {len(kinds)} classes ({', '.join(sorted(kinds))}) are not allowed: stack "
            "parameters of one law."
        )
    shapes = {tuple(map(np.shape, jax.tree.leaves(params))) for params in several}
    if len(shapes) != 1:
        raise InputError(f"laws of {len(shapes)} different shapes are not allowed: give one.")
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *several)


def candidates(law: Any) -> LawParams:
    """Return parameters with leaves (P, ...) of one law, several laws, or stacked parameters."""
    if isinstance(law, str):
        return stack([law])
    if isinstance(law, list) or type(law) is tuple:
        return stack(law)
    example = registry.preset_of(law)
    leaves = zip(*map(jax.tree.leaves, (law, example)), strict=True)
    is_single = example is not None and all(np.ndim(x) == np.ndim(y) for x, y in leaves)
    return stack([law]) if is_single else law


def _checked(params: LawParams) -> LawParams:
    """Return parameters of candidates on the host, or raise InputError if they are not valid."""
    law, name = registry.law_of(params), type(params).__name__
    sizes = {}
    for path, leaf in registry.named_leaves(params).items():
        field, values = f"{name}.{path}", np.asarray(leaf)
        if values.dtype.kind not in "biuf" or not values.ndim or not len(values):
            rule = "give an array of numbers, one for each candidate"
            raise errors.not_allowed(field, leaf, rule)
        if np.isnan(values).any():
            raise InputError(f"{field} of a candidate = nan is not allowed: it must be a number.")
        sizes[field] = len(values)
    (first, count), *_ = sizes.items()
    for field, size in sizes.items():
        if size != count:
            raise InputError(
                f"{first} of {count} candidates and {field} of {size} are not allowed: give "
                "equal numbers."
            )
    params = jax.tree.map(np.asarray, params)
    for p in range(count):
        try:
            law.check(batch.rows(params, p))
        except InputError as error:
            raise InputError(f"candidate {p}: {error}") from error
    return params


# --- several requests at once --------------------------------------------------------------


class CandidateScores(NamedTuple):
    """Outcomes and scores of all candidates of a request."""

    outcome: Outcome  # leaves (P, D * W, ...), on the host
    score: np.ndarray  # (P, D * W) [1]


def score_candidates(
    requests: Sequence[Candidates],
    setting: Setting,
    objective: Objective,
    **options: Unpack[BatchOptions],
) -> tuple[list[CandidateScores], Timing]:
    """Score every candidate in every world of its request, as `outcomes` runs them."""
    results, timing = outcomes(requests, setting, **options)
    pairs = zip(requests, results, strict=True)
    scores = [objective.scores(x, request.distances, setting.rules) for request, x in pairs]
    return list(map(CandidateScores, results, scores)), timing
