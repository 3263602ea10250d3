"""Ceiling: the share of worlds that any controller can solve, estimated by a planner.

The planner knows each world. It is model predictive path integral control (MPPI; Williams et al.
2017) around the tuned law. A plan is a sequence of offsets to the law's twist, with a knot every
few seconds (`control.guided`, G1). In round r, K perturbations change one window of the plan. The
engine steps each sample from the start of the trial to its end, with the noise of the skin, so the
cost to go after the window is exact. With the costs S_k and the perturbations e_k (window, 3)

  M1  w_k = exp(-(S_k - min S) / lambda),  lambda = `temperature` times the spread of S
  M2  plan' = plan + sum_k w_k e_k / sum_k w_k

and the window moves through the trial from round to round. The next round tries M2, and perturbs
the best plan so far. A world is solved as soon as one sample succeeds. This proves that the world
can be solved; a failure after all rounds proves nothing.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import jax
import numpy as np
import xarray as xr

from rps_jax import errors
from rps_jax.analysis import statistics, tables
from rps_jax.control.laws.guided import KNOTS, unplanned
from rps_jax.questions import Plan, Run, Section, call_of, option
from rps_jax.record import files
from rps_jax.record.files import JsonObject
from rps_jax.runs.plan import attributes_of, load_plan
from rps_jax.runs.question import DomainQuestion, Rows, count_true
from rps_jax.studies.gallery import failure_modes
from rps_jax.trials import score
from rps_jax.trials.batch import outcomes
from rps_jax.trials.results import labelled
from rps_jax.trials.trial import Outcome
from rps_jax.trials.worlds import Candidates


@dataclass(frozen=True)
class Ceiling(DomainQuestion[xr.Dataset]):
    """Estimate the share of worlds that any controller can solve, with a planner that knows them.

    The worlds are test worlds of a domain, or those of a run. The result has, by world, `solved`
    [1], `alone` [1] (solved by the law without a plan), `time` [s] of the best plan, `rounds` and
    `trials` of the search, and the best plan, `offsets` (world, knot, axis) [1].

    Examples:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> small = {"sample": 2, "samples": 4, "rounds": 1}
      >>> results = rps_jax.ceiling(drums, **small, setting=rps_jax.Setting(rules=rules))
      >>> results.trials.values.tolist()
      [4, 4]
    """

    TITLE = "Ceiling"
    QUICK: ClassVar = {"sample": 2, "most": 2, "samples": 12, "rounds": 3}

    run: str | Path | None = option(None, positional=True)
    """Run folder of a sweep or a ladder that gives domain, worlds and setting."""
    sample: int = option(300, 0, 10_000_000)
    """Number of worlds, from the first on, that are tried whichever law succeeds in them."""
    lost_by: tuple[str, ...] = ()
    """Laws of the run; worlds in which they all fail are tried, too. By default rps_tuned if the
    run has it, else the first law of the run."""
    most: int | None = option(None, 0, 10_000_000)
    """Maximum number of these failed worlds; by default all."""
    samples: int = option(64, 3, 100_000)
    """Number of trials of a world in each round: the best plan, the plan of M2, and perturbations
    of the best plan."""
    rounds: int = option(12, 1, 10_000)
    """Maximum number of rounds; a world without success by then is not solved."""
    window: float = option(30.0, above=0, unit="s")
    """Length of the perturbed window [s]."""
    spread: float = option(0.6, above=0, at_most=10)
    """Standard deviation of a perturbation, in units of v_max, v_max and omega_max [1]."""
    temperature: float = option(0.2, above=0)
    """lambda of M1, in units of the standard deviation of the costs [1]."""
    hold: float = option(5.0, above=0, unit="s")
    """Time between two knots of a plan [s]."""

    @property
    def sources(self) -> Sequence[str | Path]:
        return () if self.run is None else (self.run,)

    @functools.cached_property
    def results(self) -> xr.Dataset | None:
        """Outcomes (law, world) of the run, if there is one."""
        return None if self.run is None else files.read_results(Path(self.run))

    @property
    def failing_laws(self) -> tuple[str, ...]:
        """Laws of the run whose failed worlds are tried."""
        laws = [] if self.results is None else self.results.law.values.tolist()
        return self.lost_by or tuple(["rps_tuned"] if "rps_tuned" in laws else laws[:1])

    @functools.cached_property
    def world_indices(self) -> np.ndarray:
        """Indices (W,) of the worlds that are tried."""
        if self.results is None:
            return np.arange(self.sample)
        failed = failed_worlds(self.results, self.failing_laws)
        first = np.arange(min(self.sample, self.results.sizes["world"]))
        return np.union1d(failed[: self.most], first).astype(int)

    @functools.cached_property
    def plan(self) -> Plan:
        """Plan of a sweep that has the worlds."""
        count = int(self.world_indices.max(initial=0)) + 1
        if self.run is None:
            setting = replace(self.setting, split="test")
            return Plan(self.ranges, count, {"guided": unplanned(self.ranges.robot.drive)}, setting)
        sweep = load_plan(Path(self.run))
        law = {"guided": unplanned(sweep.domain.robot.drive)}
        return Plan(sweep.domain, count, law, sweep.setting, points=sweep.points)

    def check(self) -> None:
        if self.run is not None:
            load_plan(Path(self.run))  # refuses other runs than sweeps
            self.refuse_options(("domain", "robot", "task"))
        elif self.lost_by:
            raise errors.not_allowed("lost_by", self.lost_by, "only a run has laws; give RUN")
        if not self.world_indices.size:
            raise errors.not_allowed("sample", self.sample, "no world would be tried")
        replace(self, domain=self.plan.domain, setting=self.plan.setting, run=None).check_engine()

    def num_trials(self) -> int | None:
        """Maximum number of trials."""
        return self.world_indices.size * self.samples * self.rounds

    def configuration(self) -> JsonObject:
        search = {name: getattr(self, name) for name in _SEARCH_OPTIONS}
        worlds = self.world_indices.tolist()
        return {"ceiling": self.plan.configuration(), "worlds": worlds} | search

    def attributes(self) -> dict[str, str | int]:
        return super().attributes() | ({} if self.run is None else attributes_of(self.plan))

    def answer(self, run: Run) -> xr.Dataset:
        """Search plans round by round; a resumed run loads its finished rounds."""
        state = start = _initial_state(self.world_indices)
        run, progress = run.in_parts()

        def unsolved() -> np.ndarray:
            return np.flatnonzero(state.solved.values == 0)

        rounds = run.steps(
            lambda r: self._round(state, unsolved(), r, run),
            lambda r: r < self.rounds and unsolved().size > 0,
            name="round-{:04d}",
        )
        for result in rounds:
            dims = {str(name): tuple(map(str, start[name].dims)) for name in start}
            files.check_columns(result, run.folder or "round", dims, start.sizes)
            progress.finish(unsolved().size * self.samples)
            state = result
        return state

    def _round(self, state: xr.Dataset, unsolved: np.ndarray, r: int, run: Run) -> xr.Dataset:
        """Return the state after round r, which tries the worlds at the indices `unsolved`."""
        worlds, best = state.world.values[unsolved], state.offsets.values[unsolved]
        horizon = float(self.plan.setting.rules.horizon)
        end = np.nan_to_num(state.time.values[unsolved], nan=horizon)
        noise = self.perturbations(worlds, r, end)
        plans = best[:, None] + noise  # (W, K, J, 3)
        plans[:, 1] = state["mean"].values[unsolved]
        outcome = self._simulate(worlds, plans, run)
        shape = unsolved.size, self.samples
        cost = score.plan_costs(outcome, self.plan.setting.rules).reshape(shape)
        weights = _weights(cost, self.temperature)
        weights = weights * (np.arange(self.samples) != 1)  # sample 1 is no perturbation of `best`
        total = np.maximum(weights.sum(axis=1), 1e-12)[:, None, None]
        mean = best + np.einsum("wk,wkji->wji", weights, noise) / total
        success = np.asarray(outcome.success).reshape(shape)
        cheapest = np.arange(unsolved.size), cost.argmin(axis=1)
        state = state.copy(deep=True)
        changed = {
            "offsets": plans[cheapest],
            "mean": mean,
            "cost": cost[cheapest],
            "time": np.asarray(outcome.time, float).reshape(shape)[cheapest],
            "solved": success[cheapest],
        }
        if r == 0:
            changed["alone"] = success[:, 0]
        for name, values in changed.items():
            state[name].values[unsolved] = values
        state.rounds.values[unsolved] += 1
        state.trials.values[unsolved] += self.samples
        return state

    def perturbations(self, worlds: np.ndarray, r: int, end: np.ndarray) -> np.ndarray:
        """Return the perturbations (W, K, J, 3) [1] of round r; those of samples 0 and 1 are zero.

        The window starts at r / `rounds` of the trials of the best plans, whose times are `end`
        (W,) [s]. Perturbations depend only on the seed, the index of the world and the round.
        """
        window = max(1, round(self.window / self.hold))
        noise = np.zeros((worlds.size, self.samples, KNOTS, 3))
        for row, (world, time) in enumerate(zip(worlds.tolist(), end, strict=True)):
            first = min(int(time * r / self.rounds / self.hold), KNOTS - 1)
            size = self.samples - 2, min(window, KNOTS - first), 3
            random = np.random.default_rng((self.plan.setting.world_seed, world, r))
            noise[row, 2:, first : first + size[1]] = random.normal(scale=self.spread, size=size)
        if self.plan.domain.robot.drive != "omni":
            noise[..., 1] = 0.0
        return noise

    def _simulate(self, worlds: np.ndarray, plans: np.ndarray, run: Run) -> Outcome:
        """Return the outcomes, leaves (W * K, ...), of worlds (W,) under plans (W, K, J, 3).

        The number of slots is that of all worlds, so all rounds share one program.
        """
        plan, slots = self.plan, self.world_indices.size * self.samples
        offsets = np.swapaxes(plans, 0, 1)  # (K, W, J, 3)
        steps = max(1, round(self.hold / plan.setting.physics.control_period))
        known = plan.laws["guided"]
        law, hold = jax.tree.map(partial(np.full, offsets.shape[:2]), (known.law, float(steps)))
        params = known._replace(law=law, offsets=offsets, hold=hold)
        seed, domains = plan.setting.world_seed, [plan.domain]
        request = Candidates(params, domains, seed, worlds, plan.points, per_world=True)
        options = run.batch_options
        (outcome,), _ = outcomes([request], plan.setting, capacity=lambda _: slots, **options)
        return jax.tree.map(lambda x: np.swapaxes(x, 0, 1).reshape(-1, *x.shape[2:]), outcome)

    def intro(self, results: xr.Dataset) -> str:
        source = "test worlds of the domain" if self.run is None else str(self.run)
        return f"{results.sizes['world']} worlds of {source}, {int(results.trials.sum()):,} trials."

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        worlds, table = results.world.values, []
        sampled = np.flatnonzero(worlds == np.arange(worlds.size))  # consecutive from 0 on
        solved, alone = (count_true(results[x].values[sampled] > 0) for x in ("solved", "alone"))
        text = (
            f"MPPI around a tuned law, which knows each world, solves {solved} of the first "
            f"{sampled.size} worlds ({tables.share(solved, sampled.size)}); the law without a plan "
            f"solves {alone} of them. This share is a lower bound: a world that the planner does "
            "not solve may still be solvable."
        )
        if self.results is not None:
            laws = " and ".join(self.failing_laws)
            text = f"Worlds in which {laws} fail, and the first {self.sample} worlds. {text}"
            max_lost = float(self.plan.setting.rules.max_lost)
            table = solved_table(results, self.results, self.failing_laws, max_lost)
        return [Section("A planner that knows the world", text, table)]


_SEARCH_OPTIONS = ("samples", "rounds", "window", "spread", "temperature", "hold")

ceiling = call_of(Ceiling)


def _initial_state(worlds: np.ndarray) -> xr.Dataset:
    """Return the state of the search before its first round: no plan, of unknown cost."""
    count, dims = worlds.size, ("world", "knot", "axis")
    plans = np.zeros((2, count, KNOTS, 3))
    variables = labelled(
        solved=("world", np.zeros(count, np.int8), "1", "a plan succeeds"),
        alone=("world", np.zeros(count, np.int8), "1", "the law succeeds without a plan"),
        time=("world", np.full(count, np.nan), "s", "time of the best plan"),
        cost=("world", np.full(count, np.inf), "1", "S of the best plan"),
        rounds=("world", np.zeros(count, int), "1", "number of rounds"),
        trials=("world", np.zeros(count, int), "1", "number of trials"),
        offsets=(dims, plans[0], "1", "best plan, G1"),
        mean=(dims, plans[1], "1", "plan of M2"),
    )
    return xr.Dataset(variables, {"world": worlds, "axis": ["v_x", "v_y", "omega"]})


def _weights(cost: np.ndarray, temperature: float) -> np.ndarray:
    """Return the weights (W, K) [1] of M1; equal costs have equal weights."""
    lambda_ = temperature * cost.std(axis=1, keepdims=True)
    return np.exp(-(cost - cost.min(axis=1, keepdims=True)) / np.maximum(lambda_, 1e-9))


# --- worlds of a sweep or a ladder ---------------------------------------------------------


def failed_worlds(results: xr.Dataset, laws: Sequence[str]) -> np.ndarray:
    """Return the worlds of a sweep (law, world) in which all of some laws fail."""
    for name in laws:
        errors.check_name("law of the run", name, results.law.values.tolist())
    return np.flatnonzero((results.success.sel(law=list(laws)).values == 0).all(axis=0))


def solved_table(
    ceiling: xr.Dataset, sweep: xr.Dataset, laws: Sequence[str], max_lost: float
) -> Rows:
    """Return who solves the worlds of a sweep in which some laws fail.

    There is a row for each object, and one for each failure mode of the first law.
    """
    count, worlds = sweep.sizes["world"], ceiling.world.values
    failed = np.isin(np.arange(count), np.intersect1d(failed_worlds(sweep, laws), worlds))
    planner = np.isin(np.arange(count), worlds[ceiling.solved.values > 0])
    law = (sweep.success.values > 0).any(axis=0)
    masks = (failed, failed & planner, failed & law & ~planner, failed & ~law & ~planner)
    modes = failure_modes(sweep.sel(law=laws[0]), max_lost)
    groups = statistics.worlds_by_object(sweep)
    groups |= {str(mode): modes == mode for mode in np.unique(modes) if mode}
    table = [["object", "failed worlds", "solved by the planner", "only by another law", "by none"]]
    for name, group in (groups | {"all": True}).items():
        table.append([name, *(f"{count_true(mask & group):,}" for mask in masks)])
    return table
