"""How many worlds can be won at all? A planner that knows each world answers, from above.

It is model predictive path integral control (MPPI; Williams et al. 2017) around the tuned law. A
plan is offsets to the law's twist, a knot every few seconds (`control.guided`, G1). In round r a
window of the plan is perturbed K times; each sample is stepped from the start of the trial to its
end by the engine itself, noise of the skin included, so that the cost to go after the window is
known and need not be guessed. With the costs S_k and the perturbations e_k (window, 3)

  M1  w_k = exp(-(S_k - min S) / lambda),  lambda = `temperature` times the spread of S
  M2  plan' = plan + sum_k w_k e_k / sum_k w_k

and the window moves on through the trial. M2 is tried in the next round beside the best plan that
was seen, which is perturbed next. A world is solved as soon as one sample wins it: that proves that
the world can be won, and no number of rounds proves that it cannot.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import errors
from rps_jax.analysis import statistics
from rps_jax.analysis.report import Section
from rps_jax.control import strategies
from rps_jax.control.guided import KNOTS, GuidedParams
from rps_jax.control.law import RPSParams
from rps_jax.engines import EngineName
from rps_jax.record import files
from rps_jax.record import folder as run_folder
from rps_jax.record.checkpoint import Parts
from rps_jax.robot.robot import Robot
from rps_jax.runs.evaluate import Split, seed_of
from rps_jax.runs.plan import Plan, draw
from rps_jax.trials import batch
from rps_jax.trials.batch import Job, Part
from rps_jax.trials.setting import InTurn, Report, Setting, unheard
from rps_jax.trials.trial import Outcome, Rules
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.world.domain import Domain, named
from rps_jax.world.physics import Fidelity, PhysicsName, preset


@dataclass(frozen=True)
class Search:
    """How plans are searched."""

    samples: int = 64
    """Trials of a world in each round: the best plan, M2's, and perturbations of the best."""
    rounds: int = 12
    """Rounds, after which a world counts as not solved."""
    window: float = 30.0
    """Time that is perturbed at once [s]."""
    spread: float = 0.6
    """Standard deviation of a perturbation, in units of v_max, v_max and omega_max [1]."""
    temperature: float = 0.2
    """lambda of M1, in units of the standard deviation of the costs [1]."""
    hold: float = 5.0
    """Time between two knots of a plan [s]."""

    def __post_init__(self) -> None:
        """Raises InputError for a number that means nothing."""
        errors.check_count("samples", self.samples, at_least=3, at_most=100_000)
        errors.check_count("rounds", self.rounds, at_most=10_000)
        errors.check_finite("window", self.window, above=0, unit="s")
        errors.check_finite("spread", self.spread, above=0, at_most=10)
        errors.check_finite("temperature", self.temperature, above=0)
        errors.check_finite("hold", self.hold, above=0, unit="s")


def ceiling(
    domain: Domain | str = "wide",
    worlds: int | Sequence[int] = 64,
    seed: int = 0,
    search: Search = Search(),
    split: Split = "test",
    engine: EngineName = "fused",
    out: str | Path | None = None,
    *,
    physics: PhysicsName = "default",
    fidelity: Fidelity = "standard",
    rules: Rules = Rules(),
    robot: Robot | str | None = None,
    slots: int | None = None,
    workers: int | None = None,
    report: Report = unheard,
) -> xr.Dataset:
    """Which worlds a planner wins that knows them.

    Args:
      domain: ranges of what differs between worlds, or their name in `DOMAINS`.
      worlds: how many, of indices 0, 1, ..., or their indices.
      seed: of the worlds.
      search: how plans are searched.
      split: what the worlds are for, as in `evaluate`.
      engine: what steps them, and with what the planner looks ahead.
      out: run folder, in which a run that was killed is continued; None keeps all in memory.
      physics: how friction is modelled.
      fidelity: how finely the physics is solved.
      rules: when a trial ends.
      robot: by its name in `ROBOTS`, or a JSON file's; None: the domain's.
      slots: worlds stepped at once by a worker; by default as suits engine and device.
      workers: host threads; by default as suits engine and device.
      report: called after every segment of the run.

    Returns:
      By world: `solved` [1], `alone` [1] (by the law without a plan), `time` [s] of the best plan,
      `rounds` and `trials` that were spent, and the best plan, `offsets` (world, knot, axis) [1].

    Raises:
      InputError: an argument is not allowed, or `out` holds another run.

    Example:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> short = rps_jax.Search(samples=4, rounds=1)
      >>> found = rps_jax.ceiling(drums, 2, search=short, rules=rules)
      >>> found.trials.values.tolist()
      [4, 4]
    """
    setting = Setting(preset(physics, fidelity), rules, seed_of(seed, split), engine)
    numbers = np.arange(worlds) if isinstance(worlds, int) else np.asarray(worlds, int)
    plan = planned(named(domain, robot), numbers, setting)
    shape = {"slots": slots, "workers": workers, "report": report}
    return complete(None if out is None else Path(out), plan, numbers, search, **shape)


def planned(domain: Domain, numbers: np.ndarray, setting: Setting) -> Plan:
    """A plan that holds these worlds of a domain, checked for this machine.

    Raises:
      InputError: there is none, one is negative, or the machine cannot step them.
    """
    if not numbers.size or numbers.min() < 0 or np.unique(numbers).size < numbers.size:
        raise errors.InputError(
            f"worlds = {numbers.tolist()[:5]} are not allowed: give indices from 0, each once, at "
            "least one."
        )
    plan = Plan(domain, int(numbers.max()) + 1, {"guided": GuidedParams()}, setting)
    plan.check_here()
    return plan


def complete(
    folder: Path | None,
    plan: Plan,
    numbers: np.ndarray,
    search: Search,
    *,
    report: Report = unheard,
    **shape: Any,
) -> xr.Dataset:
    """Run what a folder lacks of a search in worlds of a plan, round by round; all of it.

    Raises:
      InputError: the folder cannot be written, is in use, or holds another run.
    """
    if folder is None:
        return _rounds(None, plan, numbers, search, report=report, **shape)
    settings = {"search": dataclasses.asdict(search), "worlds": numbers.tolist()}
    run_folder.claim(folder, {"ceiling": plan.configuration()} | settings)
    with run_folder.hold(folder):
        found = _rounds(Parts(folder), plan, numbers, search, report=report, **shape)
        files.write_results(folder / "ceiling.nc", found)
    return found


def _rounds(
    parts: Parts | None,
    plan: Plan,
    numbers: np.ndarray,
    search: Search,
    *,
    report: Report,
    **shape: Any,
) -> xr.Dataset:
    """All rounds, those that are kept not run again."""
    heard = InTurn(report)
    state = _start(numbers)
    for r in range(search.rounds):
        open_ = np.flatnonzero(state.solved.values == 0)
        if not open_.size:
            break
        content = None if parts is None else parts.get(f"round-{r:04d}")
        if content is None:
            state = _round(state, plan, search, r, heard, **shape)
            if parts is not None:
                parts.put(f"round-{r:04d}", files.encoded(state))
        else:
            assert parts is not None
            state = files.decoded(content, parts.folder)
        heard.ended(open_.size * search.samples)
    return state


def _start(numbers: np.ndarray) -> xr.Dataset:
    """Before the first round: the law alone, of unknown cost."""
    count = numbers.size
    what = {
        "solved": (np.zeros(count, np.int8), "1", "a plan was found that wins"),
        "alone": (np.zeros(count, np.int8), "1", "the law wins without a plan"),
        "time": (np.full(count, np.nan), "s", "time of the best plan"),
        "cost": (np.full(count, np.inf), "1", "S of the best plan"),
        "rounds": (np.zeros(count, int), "1", "rounds that were spent"),
        "trials": (np.zeros(count, int), "1", "trials that were spent"),
    }
    variables: dict[str, Any] = {
        name: ("world", values, {"units": unit, "long_name": meaning})
        for name, (values, unit, meaning) in what.items()
    }
    for name, meaning in (("offsets", "best plan, G1"), ("mean", "plan of M2")):
        at = ("world", "knot", "axis"), np.zeros((count, KNOTS, 3))
        variables[name] = (*at, {"units": "1", "long_name": meaning})
    return xr.Dataset(variables, {"world": numbers, "axis": ["v_x", "v_y", "omega"]})


def _round(
    state: xr.Dataset, plan: Plan, search: Search, r: int, report: Report, **shape: Any
) -> xr.Dataset:
    """The state after one more round in the worlds that are not solved."""
    open_ = np.flatnonzero(state.solved.values == 0)
    numbers, best = state.world.values[open_], state.offsets.values[open_]
    until = np.nan_to_num(state.time.values[open_], nan=float(plan.setting.rules.horizon))
    noise = perturbations(search, plan.setting.seed, numbers, r, until)
    tried = best[:, None] + noise  # (W, K, J, 3)
    tried[:, 1] = state["mean"].values[open_]
    outcome = _tried(plan, numbers, tried, search, report, state.sizes["world"], **shape)
    cost = costs(outcome, plan.setting.rules).reshape(open_.size, search.samples)
    weights = _weights(cost, search.temperature)
    own = np.arange(search.samples) != 1  # M2's plan is no perturbation of the best
    moved: Any = np.einsum("wk,wkji->wji", weights * own, noise)
    moved /= np.maximum((weights * own).sum(axis=1), 1e-12)[:, None, None]
    pick = cost.argmin(axis=1)
    rows = np.arange(open_.size)
    at = rows, pick
    won = outcome.success.reshape(cost.shape)
    after = state.copy(deep=True)
    after.offsets.values[open_] = tried[at]
    after["mean"].values[open_] = best + moved
    after.cost.values[open_] = cost[at]
    after.time.values[open_] = np.asarray(outcome.time, float).reshape(cost.shape)[at]
    after.solved.values[open_] = won[at]
    if r == 0:
        after.alone.values[open_] = won[:, 0]
    after.rounds.values[open_] += 1
    after.trials.values[open_] += search.samples
    return after


def perturbations(
    search: Search, seed: int, worlds: np.ndarray, r: int, until: np.ndarray
) -> np.ndarray:
    """The perturbations (W, K, J, 3) [1] of round r; those of samples 0 and 1 are zero.

    The window begins at r / `rounds` of the best plan's trials, which end at `until` (W,) [s].
    They depend on the seed, the world's index and the round alone.
    """
    knots = max(1, round(search.window / search.hold))
    found = np.zeros((worlds.size, search.samples, KNOTS, 3))
    for row, (world, end) in enumerate(zip(worlds.tolist(), until, strict=True)):
        first = min(int(end * r / search.rounds / search.hold), KNOTS - 1)
        width = min(knots, KNOTS - first)
        random = np.random.default_rng((seed, world, r))
        drawn = random.normal(scale=search.spread, size=(search.samples - 2, width, 3))
        found[row, 2:, first : first + width] = drawn
    return found


def costs(outcome: Outcome, rules: Rules) -> np.ndarray:
    """S (n,) [1] of trials: below 1 the time of a success, in horizons; above, how far it failed.

    A failure costs 1, the least distance of the contact point to the target [m], 5 m if nothing
    was touched, a tenth of the distance that is left between base and object [m], and if the object
    fell over as much of the horizon as it fell early.
    """
    near = np.asarray(outcome.min_distance, float)
    time = np.asarray(outcome.time, float) / float(rules.horizon)
    apart = np.asarray(outcome.object_pose, float)[:, :2] - np.asarray(outcome.base_pose)[:, :2]
    apart = np.minimum(np.nan_to_num(np.linalg.norm(apart, axis=1), nan=5.0), 5.0)
    ended = np.asarray(outcome.tipped) | np.asarray(outcome.diverged)
    missed = np.where(np.isfinite(near), np.minimum(near, 5.0), 5.0)
    failed = 1 + missed + 0.1 * apart + ended * (1 - time)
    return np.where(np.asarray(outcome.success), np.minimum(time, 1.0), failed)


def _weights(cost: np.ndarray, temperature: float) -> np.ndarray:
    """M1 (W, K) [1]; equal if all costs are."""
    lambda_ = temperature * cost.std(axis=1, keepdims=True)
    return np.exp(-(cost - cost.min(axis=1, keepdims=True)) / np.maximum(lambda_, 1e-9))


def _tried(
    plan: Plan,
    numbers: np.ndarray,
    offsets: np.ndarray,
    search: Search,
    report: Report,
    most: int,
    **shape: Any,
) -> Outcome:
    """How every world (W,) goes under each of its plans (W, K, J, 3); leaves (W * K, ...).

    There are as many slots as `most` worlds have use for, so that every round has one program.
    """
    samples = offsets.shape[1]
    flat = offsets.reshape(-1, *offsets.shape[2:]).astype(jnp.zeros(()).dtype)
    found: dict[str, np.ndarray] = {}

    def collect(which: np.ndarray, outcome: Outcome) -> None:
        for name, leaf in outcome._asdict().items():
            if name not in found:
                found[name] = np.empty((len(flat), *leaf.shape[1:]), leaf.dtype)
            found[name][which] = leaf

    guided = strategies.STRATEGIES[GuidedParams]
    jobs = [
        Job(guided, most * samples, parts)
        for parts in _parts(plan, numbers, flat, samples, search.hold)
    ]
    batch.run(jobs, plan.setting, collect=collect, report=report, **shape)
    return Outcome(**found)  # pyright: ignore[reportArgumentType]


def _parts(
    plan: Plan, numbers: np.ndarray, flat: np.ndarray, samples: int, hold: float
) -> Iterator[list[Part]]:
    """The trials of each object of the domain."""
    which = plan.domain.object_of(numbers)
    steps = max(1, round(hold / plan.setting.physics.control_period))
    for thing in np.unique(which):
        rows = np.flatnonzero(which == thing)
        part = drawn_worlds(plan.domain, draw(plan, numbers[rows]), RPSParams.tuned(), plan.setting)
        many = np.repeat(np.arange(rows.size), samples)
        trials = (rows[:, None] * samples + np.arange(samples)).ravel()
        worlds = batch.rows(part.worlds, many)
        each: Any = np.full(trials.size, steps, flat.dtype)
        params = GuidedParams(worlds.params, flat[trials], each)
        yield [Part(trials, worlds._replace(params=params), part.stage)]


# --- the report of a ladder ------------------------------------------------------------------


def chosen(
    results: xr.Dataset, lost_by: Sequence[str], sample: int, most: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Worlds of a sweep (arm, world): the first `sample`, and those that some arms all lose.

    Of the latter the first `most`, or all; they are returned alone, too.

    Raises:
      InputError: an arm is unknown.
    """
    arms = results.arm.values.tolist()
    for name in lost_by:
        errors.check_name("law", name, arms)
    lost = (results.success.sel(arm=list(lost_by)).values == 0).all(axis=0)
    found = np.flatnonzero(lost)[:most]
    return np.union1d(found, np.arange(min(sample, lost.size))).astype(int), found


def sections(found: xr.Dataset, results: xr.Dataset, lost_by: Sequence[str]) -> list[Section]:
    """What a report says of a search in worlds of a sweep (arm, world)."""
    solved = dict(zip(found.world.values.tolist(), found.solved.values.tolist(), strict=True))
    lost = (results.success.sel(arm=list(lost_by)).values == 0).all(axis=0)
    lost &= np.isin(np.arange(lost.size), found.world.values)  # those that were tried
    table = [["object", "worlds lost", "won by the planner", "by another law alone", "by nobody"]]
    any_law = (results.success.values > 0).any(axis=0)
    kinds = statistics.worlds_by_object(results) | {"all": np.ones_like(lost)}
    for name, mask in kinds.items():
        rows = np.flatnonzero(lost & mask)
        won = np.array([solved.get(int(i), 0) for i in rows], bool)
        nobody = ~won & ~any_law[rows]
        counts = rows.size, won.sum(), (any_law[rows] & ~won).sum(), nobody.sum()
        table.append([name, *(f"{int(n):,}" for n in counts)])
    sampled = _sampled(found)
    wins = int(found.solved.values[sampled].sum())
    low, high = statistics.wilson(wins, sampled.size) if sampled.size else (0.0, 1.0)
    text = (
        f"MPPI around the tuned law, which knows each world, in the worlds that "
        f"{' and '.join(lost_by)} lose, and in the first {sampled.size} worlds, of which it wins "
        f"{wins} ({100 * wins / max(1, sampled.size):.1f} % [{100 * low:.1f}, {100 * high:.1f}]). "
        "What it wins can be won; what it loses may be."
    )
    return [Section("Ceiling: a planner that knows the world", text, table)]


def _sampled(found: xr.Dataset) -> np.ndarray:
    """Rows of the worlds 0, 1, ... that follow one another."""
    worlds = found.world.values
    return np.flatnonzero(worlds == np.arange(worlds.size))


def told(found: xr.Dataset) -> Mapping[str, float]:
    """A search in numbers, for a line on the screen."""
    return {
        "worlds": found.sizes["world"],
        "solved": int(found.solved.sum()),
        "by the law alone": int(found.alone.sum()),
        "trials": int(found.trials.sum()),
    }
