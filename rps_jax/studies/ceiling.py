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

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import errors
from rps_jax.analysis import statistics, tables
from rps_jax.analysis.report import Section
from rps_jax.control import registry
from rps_jax.control.laws.guided import KNOTS, GuidedParams
from rps_jax.control.laws.rps import RPSParams
from rps_jax.record import files
from rps_jax.record.options import option
from rps_jax.runs.plan import Plan, draw, load_plan
from rps_jax.runs.question import DomainQuestion, Run, call_of, count_true, seed_of
from rps_jax.trials import batch, score
from rps_jax.trials.batch import Job, WorldBatch
from rps_jax.trials.progress import SequentialProgress
from rps_jax.trials.trial import Outcome
from rps_jax.trials.worlds import drawn_worlds


@dataclass(frozen=True)
class Ceiling(DomainQuestion[xr.Dataset]):
    """Tell how many worlds can be won: a planner that knows them tries.

    Worlds are those of a domain, kept for testing, or of a run. The answer holds, by world,
    `solved` [1], `alone` [1] (by the law without a plan), `time` [s] of the best plan, `rounds` and
    `trials` that were spent, and the best plan, `offsets` (world, knot, axis) [1].

    Example:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> small = {"sample": 2, "samples": 4, "rounds": 1}
      >>> found = rps_jax.ceiling(drums, **small, setting=rps_jax.Setting(rules=rules))
      >>> found.trials.values.tolist()
      [4, 4]
    """

    TITLE: ClassVar[str] = "Ceiling"
    QUICK: ClassVar[Mapping[str, Any]] = {"sample": 2, "most": 2, "samples": 12, "rounds": 3}

    run: str | Path | None = option(None, positional=True)
    """Run folder of a sweep or a ladder, whose domain, worlds and setting are taken."""
    sample: int = option(300, 0, 10_000_000)
    """Number of worlds that are tried whoever won them: the first ones."""
    lost_by: tuple[str, ...] = ("rps_tuned",)
    """Laws of the run; worlds that they all lose are tried, too."""
    most: int | None = option(None, 0, 10_000_000)
    """Number of lost worlds that are tried: the first of them; by default all."""
    samples: int = option(64, 3, 100_000)
    """Number of trials of a world in each round: the best plan, M2's, and perturbations of the
    best."""
    rounds: int = option(12, 1, 10_000)
    """Number of rounds, after which a world counts as not solved."""
    window: float = option(30.0, above=0, unit="s")
    """Time that is perturbed at once [s]."""
    spread: float = option(0.6, above=0, at_most=10)
    """Standard deviation of a perturbation, in units of v_max, v_max and omega_max [1]."""
    temperature: float = option(0.2, above=0)
    """lambda of M1, in units of the standard deviation of the costs [1]."""
    hold: float = option(5.0, above=0, unit="s")
    """Time between two knots of a plan [s]."""

    @property
    def default_folder(self) -> Path:
        return super().default_folder if self.run is None else Path(self.run) / "ceiling"

    @functools.cached_property
    def results(self) -> xr.Dataset | None:
        """Outcomes (law, world) of the run."""
        return None if self.run is None else files.read_results(Path(self.run))

    @functools.cached_property
    def numbers(self) -> np.ndarray:
        """Indices of the worlds that are tried."""
        if self.results is None:
            return np.arange(self.sample)
        lost = failed_worlds(self.results, self.lost_by)
        first = np.arange(min(self.sample, self.results.sizes["world"]))
        return np.union1d(lost[: self.most], first).astype(int)

    @functools.cached_property
    def plan(self) -> Plan:
        """A plan that holds the worlds."""
        law = {"guided": GuidedParams()}
        count = int(self.numbers.max(initial=0)) + 1
        if self.run is None:
            seeded = replace(self.setting, seed=seed_of(self.setting.seed, "test"))
            return Plan(self.ranges, count, law, seeded)
        theirs = load_plan(Path(self.run))
        return Plan(theirs.domain, count, law, theirs.setting, points=theirs.points)

    def check(self) -> None:
        if not self.numbers.size:
            raise errors.InputError(
                f"sample = {self.sample} is not allowed: no world would be tried."
            )
        replace(self, domain=self.plan.domain, setting=self.plan.setting, run=None).check_engine()

    def num_trials(self) -> int | None:
        """How many trials there are, at most."""
        return self.numbers.size * self.samples * self.rounds

    def configuration(self) -> dict[str, Any]:
        own = {name: getattr(self, name) for name in _SEARCH}
        return {"ceiling": self.plan.configuration(), "worlds": self.numbers.tolist()} | own

    def answer(self, run: Run) -> xr.Dataset:
        """Search plans, round by round; finished rounds are not run again."""
        state = start = _start(self.numbers)
        heard = SequentialProgress(run.callback)
        run = run._replace(callback=heard)
        for r in range(self.rounds):
            open_ = np.flatnonzero(state.solved.values == 0)
            if not open_.size:
                break
            name = f"round-{r:04d}"
            state = run.checkpoint(name, functools.partial(self._round, state, open_, r, run))
            files.check_like(
                state, start, name if run.checkpoints is None else run.checkpoints.folder / name
            )
            heard.finish(open_.size * self.samples)
        return state

    def _round(self, state: xr.Dataset, open_: np.ndarray, r: int, run: Run) -> xr.Dataset:
        """The state after one more round in the worlds `open_`, which are not solved."""
        numbers, best = state.world.values[open_], state.offsets.values[open_]
        until = np.nan_to_num(state.time.values[open_], nan=float(self.plan.setting.rules.horizon))
        noise = self.perturbations(numbers, r, until)
        tried = best[:, None] + noise  # (W, K, J, 3)
        tried[:, 1] = state["mean"].values[open_]
        outcome = self._tried(numbers, tried, state.sizes["world"], run)
        cost = score.plan_costs(outcome, self.plan.setting.rules)
        cost = cost.reshape(open_.size, self.samples)
        weights = _weights(cost, self.temperature)
        own = np.arange(self.samples) != 1  # M2's plan is no perturbation of the best
        moved: Any = np.einsum("wk,wkji->wji", weights * own, noise)
        moved /= np.maximum((weights * own).sum(axis=1), 1e-12)[:, None, None]
        at = np.arange(open_.size), cost.argmin(axis=1)
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
        after.trials.values[open_] += self.samples
        return after

    def perturbations(self, worlds: np.ndarray, r: int, until: np.ndarray) -> np.ndarray:
        """The perturbations (W, K, J, 3) [1] of round r; those of samples 0 and 1 are zero.

        The window begins at r / `rounds` of the best plan's trials, which end at `until` (W,) [s].
        They depend on the seed, the world's index and the round alone.
        """
        knots = max(1, round(self.window / self.hold))
        found = np.zeros((worlds.size, self.samples, KNOTS, 3))
        for row, (world, end) in enumerate(zip(worlds.tolist(), until, strict=True)):
            first = min(int(end * r / self.rounds / self.hold), KNOTS - 1)
            width = min(knots, KNOTS - first)
            random = np.random.default_rng((self.plan.setting.seed, world, r))
            drawn = random.normal(scale=self.spread, size=(self.samples - 2, width, 3))
            found[row, 2:, first : first + width] = drawn
        return found

    def _tried(self, numbers: np.ndarray, offsets: np.ndarray, most: int, run: Run) -> Outcome:
        """How every world (W,) goes under each of its plans (W, K, J, 3); leaves (W * K, ...).

        There are as many slots as `most` worlds have use for, so that every round has one program.
        """
        flat = offsets.reshape(-1, *offsets.shape[2:]).astype(jnp.result_type(float))
        guided = registry.law_of(GuidedParams())
        which = self.plan.domain.object_of(numbers)
        of_objects = [np.flatnonzero(which == one) for one in np.unique(which)]
        slots = most * self.samples
        jobs = [Job(guided, slots, self._part(numbers, rows, flat)) for rows in of_objects]
        return batch.run_all(jobs, self.plan.setting, len(flat), **run.batch_options)[0]

    def _part(
        self, numbers: np.ndarray, rows: np.ndarray, flat: np.ndarray
    ) -> Iterator[WorldBatch]:
        """The trials of the worlds `rows`, which are of one object, made when they are needed."""
        plan = self.plan
        part = drawn_worlds(plan.domain, draw(plan, numbers[rows]), plan.setting)
        part = part.with_params(RPSParams.tuned())
        trials = (rows[:, None] * self.samples + np.arange(self.samples)).ravel()
        repeated = np.repeat(np.arange(rows.size), self.samples)
        worlds, params = batch.rows((part.worlds, part.params), repeated)
        steps = max(1, round(self.hold / plan.setting.physics.control_period))
        each: Any = np.full(trials.size, steps, flat.dtype)
        yield WorldBatch(trials, worlds, part.stage, GuidedParams(params, flat[trials], each))

    def intro(self, results: xr.Dataset) -> str:
        where = "the domain, kept for testing" if self.run is None else str(self.run)
        return f"{results.sizes['world']} worlds of {where}, {int(results.trials.sum()):,} trials."

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        text, table = _sampled_told(results), []
        if self.results is not None:
            lost = " and ".join(self.lost_by)
            text = f"In the worlds that {lost} lose, and in the first {self.sample}. {text}"
            table = won_table(results, self.results, self.lost_by)
        return [Section("A planner that knows the world", text, table)]


_SEARCH = ("samples", "rounds", "window", "spread", "temperature", "hold")  # fields of the search

ceiling = call_of(Ceiling)


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


def _weights(cost: np.ndarray, temperature: float) -> np.ndarray:
    """M1 (W, K) [1]; equal if all costs are."""
    lambda_ = temperature * cost.std(axis=1, keepdims=True)
    return np.exp(-(cost - cost.min(axis=1, keepdims=True)) / np.maximum(lambda_, 1e-9))


# --- beside a sweep or a ladder ------------------------------------------------------------


def failed_worlds(results: xr.Dataset, lost_by: Sequence[str]) -> np.ndarray:
    """Worlds of a sweep (law, world) that some laws all lose."""
    laws = results.law.values.tolist()
    for name in lost_by:
        errors.check_name("law of the run", name, laws)
    return np.flatnonzero((results.success.sel(law=list(lost_by)).values == 0).all(axis=0))


def won_table(found: xr.Dataset, results: xr.Dataset, lost_by: Sequence[str]) -> list[list[str]]:
    """Header and a row for each object: who wins the worlds of a sweep that some laws lose."""
    solved = dict(zip(found.world.values.tolist(), found.solved.values.tolist(), strict=True))
    lost = np.zeros(results.sizes["world"], bool)
    lost[np.intersect1d(failed_worlds(results, lost_by), found.world.values)] = True
    table = [["object", "worlds lost", "won by the planner", "by another law alone", "by nobody"]]
    any_law = (results.success.values > 0).any(axis=0)
    kinds = statistics.worlds_by_object(results) | {"all": np.ones_like(lost)}
    for name, mask in kinds.items():
        rows = np.flatnonzero(lost & mask)
        won = np.array([solved.get(int(i), 0) for i in rows], bool)
        nobody = ~won & ~any_law[rows]
        counts = rows.size, won.sum(), (any_law[rows] & ~won).sum(), nobody.sum()
        table.append([name, *(f"{int(n):,}" for n in counts)])
    return table


def _sampled_told(found: xr.Dataset) -> str:
    """How many of the first worlds were won, in sentences."""
    worlds = found.world.values
    sampled = np.flatnonzero(worlds == np.arange(worlds.size))  # those that follow one another
    wins, alone = (count_true(found[name].values[sampled] > 0) for name in ("solved", "alone"))
    return (
        f"MPPI around the tuned law, which knows each world, wins {wins} of the first "
        f"{sampled.size} worlds ({tables.share(wins, sampled.size)}); {alone} of them are won by "
        "the law without a plan. What the planner wins can be won; what it loses may be."
    )
