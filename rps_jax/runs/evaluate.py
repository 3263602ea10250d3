"""Candidates in random worlds: each set of parameters meets the same ones, all in one batch.

Worlds for tuning, validation and testing come from seeds that never meet.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import engines, errors
from rps_jax.control import strategies
from rps_jax.control.law import RPSParams
from rps_jax.control.strategies import Params
from rps_jax.engines import EngineName
from rps_jax.errors import InputError
from rps_jax.robot.robot import Robot
from rps_jax.runs.objective import Objective
from rps_jax.trials import batch
from rps_jax.trials.batch import Job, Part
from rps_jax.trials.results import UNITS
from rps_jax.trials.setting import Report, Setting, Timing, unheard
from rps_jax.trials.trial import Outcome, Rules
from rps_jax.trials.worlds import drawn_worlds, remembered_steps
from rps_jax.world import points
from rps_jax.world.domain import Domain, named
from rps_jax.world.draws import Draw, table
from rps_jax.world.physics import Fidelity, PhysicsName, preset
from rps_jax.world.points import Points

Split = Literal["tune", "validate", "test"]


def seed_of(seed: int, split: Split) -> int:
    """The seed of the worlds of one split: no two splits of any seeds share a world.

    The worlds of a domain that draws little, such as `paper`, hardly depend on the seed.
    """
    splits = get_args(Split)
    return len(splits) * seed + splits.index(errors.check_name("split", split, splits))


def evaluate(
    params: Params,
    domain: Domain | str = "wide",
    worlds: int | xr.Dataset | np.ndarray = 256,
    seed: int = 0,
    split: Split = "tune",
    *,
    engine: EngineName = "fused",
    physics: PhysicsName = "default",
    fidelity: Fidelity = "standard",
    rules: Rules = Rules(),
    robot: Robot | str | None = None,
    objective: Objective = Objective(),
    slots: int | None = None,
    workers: int | None = None,
    report: Report = unheard,
) -> xr.Dataset:
    """How candidates do in random worlds, all of them in the same ones.

    All candidates run through one compiled program for each shape family of the objects. A later
    call with as many candidates and worlds, of whatever values and seed, compiles nothing.

    Args:
      params: parameters of any registered strategy, a pytree whose leaves are all (P, ...): one
        entry for each of P candidates.
      domain: ranges of what differs between worlds, or their name in `DOMAINS`.
      worlds: how many each candidate meets, of indices 0, 1, ...; or points of the unit cube, as
        `worlds_at` has them.
      seed: of the worlds, unless they are points.
      split: what the worlds are for; those of two splits differ, whatever the seeds.
      engine: what steps them.
      physics: how friction is modelled.
      fidelity: how finely the physics is solved.
      rules: when a trial ends.
      robot: by its name in `ROBOTS`, or a JSON file's; None: the domain's.
      objective: what scores a trial.
      slots: worlds stepped at once by a worker; by default as suits engine and device.
      workers: host threads; by default as suits engine and device.
      report: called after every segment of the run.

    Returns:
      Scores, of which less is better, and outcomes (candidate, world), and what was drawn (world)
      as coordinates.

    Raises:
      InputError: an argument is not allowed.

    Example:
      >>> import jax
      >>> import numpy as np
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> same = jax.tree.map(lambda value: np.full(4, value), rps_jax.RPSParams.paper())
      >>> four = same._replace(L=np.geomspace(0.1, 1, 4))
      >>> found = rps_jax.evaluate(four, drums, worlds=2, rules=rules)
      >>> found.score.mean("world").shape
      (4,)
    """
    domain = named(domain, robot)
    count, at = points.asked(domain, worlds)
    errors.check_count("worlds", count, at_most=10_000_000)
    errors.check_count("seed", seed, at_least=0, at_most=2**30)
    setting = Setting(preset(physics, fidelity), rules, engine=engine)
    engines.get(engine).check(domain.families)
    engines.get(engine).check_senses(strategies.of(params).senses)
    batch.check_shape(slots, workers)
    ask = Ask(_checked(params), seed_of(seed, split), np.arange(count), at)
    shape = {"slots": slots, "workers": workers}
    (answer,), _ = try_out([ask], [domain], setting, objective, report=report, **shape)
    variables: dict[str, Any] = {
        "score": (("candidate", "world"), answer.score, {"units": "1", "long_name": "objective"})
    }
    for name, values in answer.outcome._asdict().items():
        unit, meaning = UNITS[name]
        dims = ("candidate", "world", "pose")[: values.ndim]
        plain = values.astype(np.int8) if values.dtype == bool else values
        variables[name] = (dims, plain, {"units": unit, "long_name": meaning})
    return xr.Dataset(variables, {"pose": ["x", "y", "yaw"]} | _drawn(domain, ask))


def _checked(params: Params) -> Params:
    """The same parameters on the host.

    Raises:
      InputError: they are not of several candidates of one strategy, or mean nothing.
    """
    strategy, name = strategies.of(params), type(params).__name__
    sizes = {}
    for place, leaf in strategies.numbers(params).items():
        field, values = f"{name}.{place}", np.asarray(leaf)
        if values.dtype.kind not in "biuf" or not values.ndim or not len(values):
            raise InputError(
                f"{field} = {leaf} is not allowed: give an array of numbers, one for each "
                "candidate."
            )
        if np.isnan(values).any():
            raise InputError(f"{field} of a candidate = nan is not allowed: it must be a number.")
        sizes[field] = len(values)
    (first, count), *_ = sizes.items()
    for field, other in sizes.items():
        if other != count:
            raise InputError(
                f"{first} of {count} candidates and {field} of {other} are not allowed: give as "
                "many of each."
            )
    params = jax.tree.map(np.asarray, params)
    for p in range(count):
        try:
            strategy.check(batch.rows(params, p))
        except InputError as error:
            raise InputError(f"candidate {p}: {error}") from error
    return params


def _drawn(domain: Domain, ask: Ask) -> dict[str, Any]:
    """Coordinates of the worlds of an ask: their indices, objects, and what was drawn."""
    which = ask.object_of(domain)
    columns: dict[str, Any] = {
        "world": ask.worlds,
        "object": ("world", np.array(domain.objects)[which]),
    }
    for thing in np.unique(which):
        rows = np.flatnonzero(which == thing)
        drawn = ask.draw(domain, rows)
        for name, (values, unit) in table(drawn).items():
            empty = ("world", np.empty(which.size), {"units": unit})
            columns.setdefault(name, empty)[1][rows] = values
    return columns


# --- several asks at once ------------------------------------------------------------------


class Ask(NamedTuple):
    """Candidates and the worlds that each of them meets."""

    params: Params  # leaves (P, ...)
    seed: int  # of the worlds
    worlds: np.ndarray  # (W,) their indices, in each of the D domains
    points: Points | None = None  # of the unit cube at which the worlds lie; None: drawn ones

    @property
    def candidates(self) -> int:
        """How many candidates there are, P."""
        return jax.tree.leaves(self.params)[0].shape[0]

    def object_of(self, domain: Domain) -> np.ndarray:
        """Which of a domain's objects each of the worlds (W,) has."""
        return domain.object_of(points.cases(domain, self.points, self.worlds))

    def draw(self, domain: Domain, rows: np.ndarray) -> Draw:
        """Some of the worlds (W,), all of one object."""
        return points.draw(domain, self.seed, self.points, self.worlds[rows])


class Answer(NamedTuple):
    """How an `Ask` went."""

    outcome: Outcome  # leaves (P, D * W, ...), on the host
    score: np.ndarray  # (P, D * W) [1]


class _Group(NamedTuple):
    """Worlds of an ask that can be batched: those of one object of one domain."""

    ask: Ask  # whose parameters are on the host
    part: Part  # the worlds, but with the parameters (P, ...) of all candidates
    first: int  # number of the ask's first trial
    width: int  # trials of each candidate
    column: np.ndarray  # (n,) of the worlds among those


def try_out(
    asks: Sequence[Ask],
    domains: Sequence[Domain],
    setting: Setting,
    objective: Objective,
    *,
    report: Report = unheard,
    **shape: Any,
) -> tuple[list[Answer], Timing]:
    """Every candidate in every world of its ask, all asks in one batch for each shape family."""
    widths = [len(domains) * ask.worlds.size for ask in asks]
    counts = [ask.candidates for ask in asks]
    ends = np.cumsum(np.multiply(widths, counts))
    longest = max(remembered_steps(one, setting.physics.control_period) for one in domains)
    away = np.empty(ends[-1])  # [m] of the target from the start
    jobs: dict[Any, list[_Group]] = {}
    for ask, width, count, end in zip(asks, widths, counts, ends, strict=True):
        first = int(end) - count * width
        ask = ask._replace(params=_narrow(jax.device_get(ask.params)))
        for part, column, distance in parts(ask, domains, setting):
            away[first:end].reshape(count, width)[:, column] = distance
            part = _prepared(part, longest, ask.params)
            leaves, tree = jax.tree.flatten(part.worlds)
            kind = (tree, *(leaf.shape[1:] for leaf in leaves))
            jobs.setdefault(kind, []).append(_Group(ask, part, first, width, column))
    found: dict[str, np.ndarray] = {}

    def collect(numbers: np.ndarray, outcome: Outcome) -> None:
        for name, leaf in outcome._asdict().items():
            if name not in found:
                found[name] = np.empty((away.size, *leaf.shape[1:]), leaf.dtype)
            found[name][numbers] = leaf

    timing = batch.run(
        [_job(groups) for groups in jobs.values()], setting, collect=collect, report=report, **shape
    )
    every = Outcome(**found)  # pyright: ignore[reportArgumentType]
    score = objective.scores(every, away, setting.rules)
    answers = []
    for width, count, end in zip(widths, counts, ends, strict=True):
        own = np.arange(end - count * width, end).reshape(count, width)
        answers.append(Answer(batch.rows(every, own), score[own]))
    return answers, timing


def parts(
    ask: Ask, domains: Sequence[Domain], setting: Setting
) -> Iterator[tuple[Part, np.ndarray, np.ndarray]]:
    """Worlds of an ask by domain and object, their columns, and the targets' distances [m]."""
    for d, one in enumerate(domains):
        which = ask.object_of(one)
        for thing in np.unique(which):
            rows = np.flatnonzero(which == thing)
            drawn = ask.draw(one, rows)
            part = drawn_worlds(one, drawn, RPSParams(), setting)
            yield part, d * ask.worlds.size + rows, np.linalg.norm(drawn.p_world_target, axis=1)


def _narrow(params: Params) -> Params:
    dtype = jnp.zeros(()).dtype
    return jax.tree.map(lambda leaf: np.asarray(leaf, dtype), params)


def _prepared(part: Part, steps: int, params: Params) -> Part:
    """The part with the parameters (P, ...) of all candidates, and with so many steps of odometry.

    As many steps in all domains let their worlds share a batch.
    """
    odometry = part.worlds.odometry
    past = np.zeros((part.numbers.size, steps), odometry.past.dtype)
    worlds = part.worlds._replace(odometry=odometry._replace(past=past), params=params)
    return part._replace(worlds=worlds)


def _job(groups: Sequence[_Group]) -> Job:
    """The job of groups of one shape family, candidate after candidate."""

    def filled() -> Iterator[Part]:
        for ask, part, first, width, column in groups:
            for p in range(ask.candidates):
                same = np.full(column.size, p)
                worlds = part.worlds._replace(params=batch.rows(ask.params, same))
                yield Part(first + p * width + column, worlds, part.stage)

    trials = sum(group.ask.candidates * group.column.size for group in groups)
    return Job(strategies.of(groups[0].ask.params), trials, filled())
