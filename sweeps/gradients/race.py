"""Race derivatives, slopes and evolution at equal simulated time.

All tunings of a problem run in lockstep: their trials form one batch. Each has a separate folder
with its generations, so a killed race resumes. The generation with the best validation within a
budget is tested in worlds that no tuning has met.

    rps sweeps/gradients/race.py

Problems may run side by side, each in a separate run folder, which a last command collects:

    rps sweeps/gradients/race.py --counts 64 --out runs/race_64
    rps sweeps/gradients/race.py --counts 2048 --out runs/race_2048
    rps sweeps/gradients/race.py runs/race_64 runs/race_2048 --machine "one GPU"
"""

from __future__ import annotations

import functools
import itertools
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import xarray as xr

from rps_jax import RPSParams, Rules, Setting, errors, evaluate
from rps_jax.analysis.figures.style import Figure, tiles
from rps_jax.control import registry
from rps_jax.laws import resolve_law
from rps_jax.questions import Picture, Run, call_of, option
from rps_jax.runs.evaluate import score_candidates
from rps_jax.runs.question import SimulationQuestion
from rps_jax.trials.progress import Timing, no_progress
from rps_jax.tuning.descent import TuneGrad
from rps_jax.tuning.evolution import TuneES
from rps_jax.tuning.run import Tuning
from sweeps.study_base import CollectedStudy, Parts, Table, mean_interval, part_name

FOLDER, DRUMS = "sweeps/gradients", ("random_cylinder",)  # from the root of the repository
# Options of tunings by the number of tuned parameters: those of RPS, those of RPS+ for one robot
# and one family of objects, or entries of tables.
COUNTS: dict[int, dict[str, Any]] = {
    6: {"tuned": ("K_h", "K_v", "L", "beta", "l_cr", "d_th")},
    13: {"tuned": ("full",)},
    18: {"law": "rps_plus", "domain": ("hostile",), "robot": "kairos", "objects": ("random_box",)},
    **{n: {"law": f"{FOLDER}/tables.py:Table{n}", "objects": DRUMS} for n in (64, 512, 2048, 4097)},
}
SCORES = "success", "score"  # of a trial in a test world
FIRST = "derivatives"  # method with which the others are compared
_LARGE = 500  # parameters from which evolution has a diagonal covariance
_QUICK = {"worlds": 4, "validation": 4, "objects": ("random_cylinder",)}


class Lockstep:
    """Batch of the trials of several tunings, each in a thread."""

    def __init__(self, count: int) -> None:
        """Wait for `count` tunings before each batch."""
        self.count = count
        self.device = threading.Lock()  # one tuning differentiates at a time
        self.programs: dict[Callable[..., Any], Any] = {}  # of all tunings
        self._waiting: list[tuple[Tuning, list[Any], Future[Any]]] = []
        self._lock = threading.Lock()

    def score(self, question: Tuning, tried: list[Any]) -> tuple[Any, Timing]:
        """Return the scores of candidates, once all tunings ask for some.

        A tuning has the share of the wall clock that its trials have of the simulated time.
        """
        answer = Future[Any]()
        with self._lock:
            self._waiting.append((question, tried, answer))
            self._run()
        return answer.result()

    def leave(self) -> None:
        """Wait for a tuning less."""
        with self._lock:
            self.count -= 1
            self._run()

    def _run(self) -> None:
        if len(self._waiting) < max(self.count, 1):
            return
        waiting, self._waiting = self._waiting, []
        requests, (question, *_) = [x for _, tried, _ in waiting for x in tried], waiting[0]
        try:
            # Batches of similar sizes run in one program.
            options: Any = {"capacity": lambda trials: 1 << (trials - 1).bit_length()}
            scores, timing = score_candidates(
                requests, question.setting, question.objective, **options
            )
        except BaseException as error:
            for *_, answer in waiting:
                answer.set_exception(error)
            return
        for _, tried, answer in waiting:
            own, scores = scores[: len(tried)], scores[len(tried) :]
            time = sum(float(np.sum(x.outcome.time)) for x in own)
            share = time / max(timing.simulated, 1e-9)
            answer.set_result((own, Timing(timing.compile * share, timing.run * share, time)))


class _Paced(Tuning):
    """Tuning in lockstep with others."""

    pool: ClassVar[Lockstep]

    def _score(self, tried: list[Any], run: Run) -> tuple[list[Any], Timing]:
        return self.pool.score(self, tried)

    def _test(self, best: np.ndarray, run: Run) -> xr.Dataset:
        return xr.Dataset()


class PacedGrad(_Paced, TuneGrad):
    """`rps tune grad` that shares its programs with others."""

    @functools.cached_property
    def _programs(self) -> dict[Callable[..., Any], Any]:
        return self.pool.programs

    def _call(self, function: Callable[..., Any], times: dict[str, float], *inputs: Any) -> Any:
        with self.pool.device:
            return super()._call(function, times, *inputs)


class _ES(_Paced, TuneES):
    pass


METHODS: dict[str, tuple[type[Tuning], dict[str, Any]]] = {
    "derivatives": (PacedGrad, {"steps": 16}),
    "slopes": (_ES, {"estimator": "antithetic", "worlds": 128, "generations": 10}),
    "evolution": (_ES, {"worlds": 32, "population": 16, "generations": 1000}),
}


@dataclass(frozen=True)
class Race(CollectedStudy, SimulationQuestion[xr.Dataset]):
    """Race derivatives, slopes and evolution at equal simulated time.

    The answer has `success` and `score` (count, seed, method, budget, world) of the tuned laws in
    test worlds, the `wall` time [s] of their tunings (count, seed, method, budget), and success and
    score of the law at the start, `start_success` and `start_score` (count, world).
    """

    TITLE: ClassVar[str] = "Derivatives against evolution"
    CHOICES: ClassVar = {"methods": METHODS, "counts": COUNTS}
    GROWS: ClassVar[tuple[str, ...]] = ("counts",)
    QUICK: ClassVar[Mapping[str, Any]] = {
        "worlds": 4,
        "counts": (64,),
        "seeds": (1,),
        "methods": ("derivatives",),
        "simulated": (100.0,),
        "setting.engine": "quasistatic",
        "setting.rules": Rules(horizon=20.0),
    }
    DIMENSION: ClassVar[str] = "count"
    REPORTS_TIMES: ClassVar[bool] = True

    methods: tuple[str, ...] = (FIRST, "slopes", "evolution")
    """derivatives (`rps tune grad`), slopes (antithetic steps in whole trials), or evolution."""
    counts: tuple[int, ...] = tuple(n for n in COUNTS if n != 18)
    """Numbers of tuned parameters: 6 and 13 of RPS, 64, 512, 2048 and 4097 of laws with tables, or
    18 of RPS+ for one robot. A run with one number has a separate data file."""
    seeds: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 7)
    """Seeds of the tunings."""
    simulated: tuple[float, ...] = option((1e5, 3e5), above=0, unit="s")
    """Budgets of simulated time [s]; a differentiated second counts as four. After the largest no
    generation starts."""
    worlds: int = option(400, 1, 1_000_000)
    """Number of test worlds."""
    setting: Setting = field(default=Setting(rules=Rules(horizon=150.0)), kw_only=True)
    out: Path | str | None = field(default="runs/race", kw_only=True)
    """Run folder; the tunings have folders there."""

    def check(self) -> None:
        super().check()
        errors.check_each_once("simulated", self.simulated)
        for label in itertools.product(self.seeds[:1], self.counts, self.methods):
            self.tuning(*label).validate()

    def parts(self, run: Run) -> Parts:
        """Return the function that runs and tests the tunings of each count."""
        folder = run.folder or Path(str(self.out))
        return {n: partial(self._compete, folder, n) for n in self.counts if not self.runs}

    def tuning(self, seed: int, count: int, method: str) -> Tuning:
        """Return a tuning of the race."""
        kind, options = METHODS[method]
        setting = replace(self.setting, seed=seed)
        diagonal = {"estimator": "sep_cma"} if method == "evolution" and count >= _LARGE else {}
        sizes = _QUICK if self.quick else {}
        limits = {"validation": 64, "budget": max(self.simulated)}
        return kind(**{**COUNTS[count], **limits, **options, **diagonal, **sizes}, setting=setting)

    def _compete(self, folder: Path, count: int) -> xr.Dataset:
        """Run the tunings of a count, and test their best laws within each budget."""
        labels = list(itertools.product(self.seeds, (count,), self.methods))
        folders = [folder / part_name(*label) for label in labels]
        questions = [self.tuning(*label) for label in labels]
        pool = Lockstep(len(labels))

        def run(question: Tuning, at: Path) -> pd.DataFrame:
            at.mkdir(exist_ok=True)
            try:
                object.__setattr__(question, "pool", pool)
                question.answer(Run(at, no_progress))
                return pd.read_csv(at / "curve.csv")
            finally:
                pool.leave()

        with ThreadPoolExecutor(len(labels)) as threads:
            curves = list(threads.map(run, questions, folders))
        start, domain = problem(count)
        best = [best_within(x, budget) for x in curves for budget in self.simulated]
        columns = [x for x in best[0].index if x.startswith("params.")]
        values = np.array([row[columns] for row in best], float)
        _, firsts, inverse = np.unique(values, axis=0, return_index=True, return_inverse=True)
        chosen = [law_of(best[at], start) for at in firsts]
        options = {"split": "test", "setting": self.setting, "progress": False}
        robot = COUNTS[count].get("robot")
        scores = evaluate([start, *chosen], domain, self.worlds, robot=robot, **options)
        coords = {"seed": self.seeds, "method": self.methods, "budget": self.simulated}
        dims, shape = (*coords,), (*map(len, coords.values()),)
        wall = np.reshape([row.wall for row in best], shape)
        variables: dict[str, Any] = {"wall": (dims, wall)}
        for name in SCORES:
            first, *tuned = scores[name].values.astype(np.float32)
            by_budget = np.array(tuned)[inverse.ravel()].reshape(*shape, -1)
            variables[f"start_{name}"] = ("world", first)
            variables[name] = ((*dims, "world"), by_budget)
        return xr.Dataset(variables, {name: list(x) for name, x in coords.items()})

    def intro(self, results: xr.Dataset) -> str:
        """Return the budgets."""
        return (
            "Tunings from the paper's parameters, or those of RPS+ (18), with budgets of simulated "
            f"time; success in {self.worlds:,} worlds that no tuning has met."
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the success of the tunings."""
        rows = table(results)
        several = results.sizes["count"] > 1
        picture = Picture("race", partial(draw, rows)) if several else None
        columns = [
            {"name": "parameters", "merge": True},
            {"name": "simulated", "merge": True},
            {"name": "method"},
            {"name": "success", "format": "{:.1f} %", "rest": " [{:.1f}, {:.1f}]"},
            {
                "name": "derivatives ahead by",
                "format": "{:+.1f} points",
                "rest": " [{:+.1f}, {:+.1f}]",
            },
            {"name": "objective", "format": "{:.3f}"},
            {
                "name": "derivatives lower by",
                "format": "{:+.3f}",
                "rest": " [{:+.3f}, {:+.3f}]",
            },
            {"name": "by seed"},
            {"name": "wall time", "format": "{:.0f} s"},
        ]
        text = (
            "Square brackets: 95 % intervals over the seeds, by Student's t. Wall time is without "
            "compilation."
        )
        name = "gradients_race" if several else f"gradients_race_{results['count'].item()}"
        named = {"name": name, "title": "Success", "picture": picture}
        return [Table(rows, text, columns, **named)]


race = call_of(Race)


def best_within(curve: pd.DataFrame, budget: float) -> pd.Series:
    """Return the generation with the best validation within a budget of simulated time [s].

    Its vector has cost all generations before it; its own trials are for the next vector, except
    for its validation. `wall` is the wall time of the generations within the budget [s].
    """
    spent = curve[["simulated", "run"]].cumsum().shift(fill_value=0)
    within = spent.simulated <= budget
    best = curve[within].iloc[int(np.nanargmin(curve[within].validation))].copy()
    best["wall"] = spent.run[within].max()
    return best


def problem(count: int) -> tuple[Any, str]:
    """Return the law at the start and the domain of the test worlds of a problem."""
    _, start = resolve_law(COUNTS[count].get("law", "rps"))
    names = [f"objects={x}" for x in COUNTS[count].get("objects", ())]
    return start, ",".join([*COUNTS[count].get("domain", ("wide",)), *names])


def law_of(row: pd.Series, start: Any = RPSParams.paper()) -> Any:
    """Return the parameters of a generation: those of the start with its columns."""
    leaves = {k: np.array(x, float) for k, x in registry.named_leaves(start).items()}
    for column in (x for x in row.index if x.startswith("params.")):
        name, _, at = column.removeprefix("params.").partition("[")
        leaves[name][tuple(map(int, at.rstrip("]").split(","))) if at else ()] = np.asarray(
            row[column], float
        )
    if "l_mr" in leaves:
        leaves["l_mr"] = np.minimum(leaves["l_mr"], leaves["l_cr"])  # as in the tuning: see `Space`
    single = {k: x if x.ndim else float(x) for k, x in leaves.items()}
    return registry.replace_leaves(start, single)


def table(results: xr.Dataset) -> list[list[Any]]:
    """Return a row per number of parameters, budget and method."""
    rows: list[list[Any]] = []
    for count, budget in itertools.product(results["count"].values, results.budget.values):
        of_count = results.sel(count=count)
        if budget == results.budget.values[0]:
            success, score = (float(of_count[f"start_{x}"].mean()) for x in SCORES)
            rows.append([str(count), "", "start", 100 * success, None, score, None, "", None])
        means = of_count[[*SCORES, "wall"]].sel(budget=budget).mean("world")
        methods = {str(x): means.sel({"method": x}) for x in means.method.values}
        for method, chosen in methods.items():
            success, ahead, lower = 100 * chosen.success.values, None, None
            if method != FIRST and FIRST in methods:
                ahead = mean_interval(100 * methods[FIRST].success.values - success)
                lower = mean_interval((chosen.score - methods[FIRST].score).values)
            cells = [mean_interval(success), ahead, float(chosen.score.mean()), lower]
            seeds = ", ".join(f"{x:.1f}" for x in success)
            wall = float(chosen.wall.mean())
            rows.append([str(count), f"{budget:,g} s", method, *cells, seeds, wall])
    return rows


def draw(rows: Sequence[Sequence[Any]]) -> Figure:
    """Return the success against the number of parameters, with a panel for each budget."""
    budgets = list(dict.fromkeys(row[1] for row in rows if row[1]))
    sheet, axes = tiles(len(budgets), 2, (3.5, 2.2), (0.0, 0.0), sharex=True, sharey=True)
    starts = [(int(row[0]), row[3]) for row in rows if not row[1]]
    for ax, budget in zip(axes.ravel(), budgets, strict=False):
        ax.plot(*np.transpose(starts), "k:", label="start")
        for at, method in enumerate(dict.fromkeys(row[2] for row in rows if row[1])):
            cells = [(int(row[0]), *row[3]) for row in rows if [*row[1:3]] == [budget, method]]
            counts, mean, *limits = np.transpose(cells)
            error = np.abs(np.array(limits) - mean) if limits else None
            marks = {"marker": "o", "markersize": 3, "capsize": 2}
            ax.errorbar(counts * 1.08**at, mean, error, label=method, **marks)
        ax.set(
            xscale="log",
            xlabel="tuned parameters",
            ylabel="success [%]",
            title=f"{budget} simulated",
        )
        ax.grid(alpha=0.3)
    handles = axes[0, 0].get_legend_handles_labels()
    sheet.legend(*handles, loc="outside lower center", ncols=4)
    return sheet
