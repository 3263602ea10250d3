"""Race derivatives, slopes and evolution: equal simulated time and equal wall time.

Each tuning is a run of `rps tune grad` or `rps tune es`, in a separate folder, and is killed after
some minutes; a second call continues it, up to these minutes. Runs with other seeds, methods or
problems share the folder, so that a race can be split. The generation with the best validation
within a budget is tested in worlds that no tuning has met.

    rps sweeps/gradients/race.py --lanes 15 --minutes 1

Several tunings run at once, each on one processor core, or share GPUs equally. Budgets of wall time
are those of such a tuning. Seeds come first, so that the first tunings compile for all others.
"""

from __future__ import annotations

import itertools
import os
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import scipy
import xarray as xr

from rps_jax import InputError, RPSParams, Setting, errors, evaluate
from rps_jax.analysis import statistics
from rps_jax.analysis.figures.style import Figure, tiles
from rps_jax.control import registry
from rps_jax.questions import Picture, Run, call_of, option
from rps_jax.runs.question import SimulationQuestion
from sweeps.study_base import Parts, Study, Table, part_name

TABLES = "sweeps/gradients/tables.py"  # from the root of the repository
# Options of tunings by the number of tuned parameters: those of RPS, or the entries of tables.
COUNTS: dict[int, dict[str, tuple[str, ...]]] = {
    6: {"tuned": ("K_h", "K_v", "L", "beta", "l_cr", "d_th")},
    13: {"tuned": ("full",)},
    **{
        n: {"law": (f"{TABLES}:Table{n}",), "objects": ("random_cylinder",)}
        for n in (64, 512, 2048)
    },
}
_COMMON = "--horizon 150 --validation 96"
_SLOPES = f"rps tune es --estimator antithetic {_COMMON} --worlds 128 --generations 16"
_EVOLUTION = f"rps tune es {_COMMON} --worlds 32 --population 16 --generations 1000"
METHODS = {  # commands that are compared
    "derivatives": f"rps tune grad {_COMMON} --steps 20",
    "slopes": _SLOPES,
    "evolution": _EVOLUTION,
}
FIRST = "derivatives"  # method with which the others are compared
_LARGE = 500  # parameters from which evolution has a diagonal covariance
QUICK_SIZES = (
    " --objects random_cylinder --engine quasistatic --horizon 20 --validation 4 --worlds 4"
)
BUDGETS = ("wall", "simulated")


@dataclass(frozen=True)
class Race(Study[xr.Dataset], SimulationQuestion[xr.Dataset]):
    """Race derivatives, slopes and evolution: equal wall time and equal simulated time.

    The answer has the `success` (count, seed, method, budget, world) of the tuned laws in test
    worlds, and that of the law at the start, `start_success` (count, world). Budgets are `wall` or
    `simulated` with an amount [s].
    """

    TITLE: ClassVar[str] = "Derivatives against evolution"
    CHOICES: ClassVar = {"methods": METHODS}
    GROWS: ClassVar[tuple[str, ...]] = ("counts",)
    QUICK: ClassVar[Mapping[str, Any]] = {
        "worlds": 4,
        "counts": (64,),
        "seeds": (1,),
        "methods": ("derivatives",),
    }
    IGNORED_FIELDS: ClassVar[tuple[str, ...]] = ("minutes", "lanes", "gpus")
    DIMENSION: ClassVar[str] = "count"
    REPORTS_TIMES: ClassVar[bool] = True

    methods: tuple[str, ...] = tuple(METHODS)
    """derivatives (`rps tune grad`), slopes (antithetic steps in whole trials) or evolution."""
    counts: tuple[int, ...] = (6, 13, 64, 512, 2048)
    """Numbers of tuned parameters: 6 and 13 of RPS, or the 64, 512 and 2,048 entries of tables."""
    seeds: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 7)
    """Seeds of the tunings."""
    minutes: float = option(4.0, above=0, at_most=1e4, unit="min")
    """Wall clock after which a tuning is killed [min], with compilation."""
    wall: tuple[float, ...] = option((10.0, 30.0), above=0, unit="s")
    """Budgets of wall time without compilation [s]."""
    simulated: tuple[float, ...] = option((1e5, 4e5), above=0, unit="s")
    """Budgets of simulated time [s]; a differentiated second counts as four."""
    worlds: int = option(1000, 1, 1_000_000)
    """Number of test worlds of `wide`."""
    lanes: int = option(1, 1, 64)
    """Number of tunings that run at once."""
    gpus: int = option(0, 0, 8)
    """Number of GPUs for the tunings; with 0 each has a processor core."""
    setting: Setting = field(default=Setting(), kw_only=True)
    out: Path | str | None = field(default="runs/race", kw_only=True)
    """Run folder; the tunings have folders there."""

    def check(self) -> None:
        super().check()
        for count in self.counts:
            errors.check_name("count", str(count), [str(x) for x in COUNTS])

    def configuration(self) -> dict[str, Any]:
        """Return all inputs of the answer, with the commands of the tunings."""
        commands = {name: METHODS[name] for name in self.methods}
        return super().configuration() | {"commands": commands}

    def tunings(self) -> dict[tuple[int, int, str], str]:
        """Return the commands of the tunings by seed, count and method."""
        labels = itertools.product(self.seeds, self.counts, self.methods)
        sizes = QUICK_SIZES if self.quick else ""
        return {(s, n, m): f"{command(m, n)} --seed {s}{sizes}" for s, n, m in labels}

    def answer(self, run: Run) -> xr.Dataset:
        """Run the tunings of the counts that lack a test, and test all."""
        assert run.folder is not None
        stored = () if run.checkpoints is None else run.checkpoints.paths()
        commands = {
            run.folder / part_name(*label): command
            for label, command in self.tunings().items()
            if part_name(label[1]) not in stored
        }
        run_commands(commands, self.minutes, self.lanes, self.gpus)
        return super().answer(run)

    def parts(self, run: Run) -> Parts:
        """Return the test of the tunings of each count."""
        folder = run.folder or Path(str(self.out))
        return {n: partial(self._test, folder, n) for n in self.counts}

    def _test(self, folder: Path, count: int) -> xr.Dataset:
        """Return the success of the best laws of all tunings of a count within each budget."""
        labels = itertools.product(self.seeds, (count,), self.methods)
        curves = [read_curve(folder / part_name(*label)) for label in labels]
        budgets = [(name, amount) for name in BUDGETS for amount in getattr(self, name)]
        start, domain = problem(count)
        chosen = [law_of(best_within(x, *y), start) for x in curves for y in budgets]
        options = {"split": "test", "setting": self.setting, "progress": False}
        scores = evaluate([start, *chosen], domain, self.worlds, **options)
        start_success, *tuned = scores.success.values.astype(np.int8)
        dims, shape = ("seed", "method"), (len(self.seeds), len(self.methods))
        by_tuning = {
            "generations": [len(curve) for curve in curves],
            "windows": [curve.get("windows", pd.Series([0.0])).sum() for curve in curves],
            **{name: [float(spent(x, name).iloc[-1]) for x in curves] for name in BUDGETS},
        }
        variables = {name: (dims, np.reshape(x, shape)) for name, x in by_tuning.items()}
        success = np.reshape(tuned, (*shape, len(budgets), -1))
        names = [f"{name} {amount:g} s" for name, amount in budgets]
        return xr.Dataset(
            variables
            | {
                "start_success": ("world", start_success),
                "success": ((*dims, "budget", "world"), success),
            },
            {"seed": list(self.seeds), "method": list(self.methods), "budget": names},
        )

    def intro(self, results: xr.Dataset) -> str:
        """Return the budgets."""
        return (
            f"Tunings from the paper's parameters, with budgets of wall time without compilation "
            f"or of simulated time; success in {self.worlds:,} worlds that no tuning has met."
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the success of the tunings."""
        picture = Picture("race", partial(draw, results))
        columns = [
            {"name": "parameters", "merge": True},
            {"name": "equal", "merge": True},
            {"name": "method"},
            {"name": "success", "format": "{:.1%}", "rest": "{:.1%}"},
            {"name": "derivatives ahead by", "format": "{:+.1%}", "rest": "{:+.1%}"},
            {"name": "by seed"},
            {"name": "gained, lost"},
            {"name": "generations"},
        ]
        text = "Square brackets: 95 % intervals over the seeds, by Student's t."
        named = {"name": "gradients_race", "title": "Success", "picture": picture}
        return [Table(table(results), text, columns, **named)]


race = call_of(Race)


def command(method: str, count: int) -> str:
    """Return the command of a method for a number of parameters."""
    diagonal = " --estimator sep_cma" if method == "evolution" and count >= _LARGE else ""
    flags = (f"--{name} {' '.join(values)}" for name, values in COUNTS[count].items())
    return " ".join([f"{METHODS[method]}{diagonal}", *flags])


def run_commands(commands: Mapping[Path, str], minutes: float, lanes: int, gpus: int) -> None:
    """Run or continue the command of each folder until it ends or its time is up.

    So many `lanes` run at once. They share the GPUs; with 0 GPUs each has a processor core.
    Each writes to the folder and to a log beside it.
    """
    free, cores = SimpleQueue[int](), sorted(os.sched_getaffinity(0))
    for lane in range(lanes):
        free.put(lane)

    def run(folder: Path) -> None:
        lane, environment = free.get(), dict(os.environ, XLA_PYTHON_CLIENT_PREALLOCATE="false")
        pinned = [] if gpus else ["taskset", "--cpu-list", str(cores[lane % len(cores)])]
        environment |= (
            {"CUDA_VISIBLE_DEVICES": str(lane % gpus)} if gpus else {"JAX_PLATFORMS": "cpu"}
        )
        words = shlex.split(commands[folder])[1:]
        program = [*pinned, sys.executable, "-m", "rps_jax", *words, "--out", str(folder)]
        with open(folder.with_suffix(".log"), "a", encoding="utf-8") as log:
            process = subprocess.Popen(program, env=environment, stdout=log, stderr=log)
            try:
                process.wait(60 * minutes)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        free.put(lane)

    with ThreadPoolExecutor(lanes) as pool:
        for future in [pool.submit(run, folder) for folder in commands]:
            future.result()


def read_curve(folder: Path) -> pd.DataFrame:
    """Return the generations of a tuning, or raise InputError."""
    if not (folder / "curve.csv").exists():
        reason = f"{folder.with_suffix('.log')} tells why; or raise minutes"
        raise InputError(f"{folder} has no generation: {reason}.")
    return pd.read_csv(folder / "curve.csv")


def spent(curve: pd.DataFrame, budget: str) -> pd.Series:
    """Return what each generation of a log has used of a budget, with all before it [s]."""
    return pd.Series(curve["run" if budget == "wall" else "simulated"]).cumsum()


def best_within(curve: pd.DataFrame, budget: str, amount: float) -> pd.Series:
    """Return the generation with the best validation within a budget; at least the first."""
    within = curve[(spent(curve, budget) <= amount) | (curve.index == 0)]
    return within.loc[within.validation.idxmin()]


def problem(count: int) -> tuple[Any, str]:
    """Return the law at the start and the domain of the test worlds of a problem."""
    _, start = registry.parse_law(tuning(count).get("law", "rps"))
    objects = COUNTS[count].get("objects", ())
    return start, ",".join(["wide", *(f"objects={name}" for name in objects)])


def tuning(count: int) -> dict[str, Any]:
    """Return the options of a tuning in Python."""
    return {k: values[0] if k == "law" else values for k, values in COUNTS[count].items()}


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


def interval(values: np.ndarray) -> list[float]:
    """Return the mean of independent values (n,) and the limits of its 95 % interval."""
    mean, count = float(values.mean()), values.size
    if count < 2:
        return [mean]
    half = values.std(ddof=1) / np.sqrt(count) * float(scipy.special.stdtrit(count - 1, 0.975))
    return [mean, mean - half, mean + half]


def table(results: xr.Dataset) -> list[list[Any]]:
    """Return a row per number of parameters, budget and method."""
    rows: list[list[Any]] = []
    for count, budget in itertools.product(results["count"].values, results.budget.values):
        of_count = results.sel(count=count)
        start = of_count.start_success
        if budget == results.budget.values[0]:
            rows.append([str(count), "", "start", float(start.mean()), None, "", "", ""])
        means = of_count.success.sel(budget=budget).mean("world")
        for method in map(str, results.method.values):
            chosen = of_count.sel(method=method)
            values, ahead = means.sel(method=method).values, None
            if method != FIRST and FIRST in means.method:
                ahead = interval(means.sel(method=FIRST).values - values)
            compared = [statistics.compare(start, x) for x in chosen.success.sel(budget=budget)]
            gained, lost = (sum(getattr(c, x) for c in compared) for x in ("gained", "lost"))
            seeds = ", ".join(f"{100 * x:.1f}" for x in values)
            counts = f"+{gained} -{lost}", f"{float(chosen.generations.mean()):.0f}"
            label = str(budget).replace(" ", " time, ")
            rows.append([str(count), label, method, interval(values), ahead, seeds, *counts])
    return rows


def draw(results: xr.Dataset) -> Figure:
    """Return the success against the number of parameters, with a panel for each budget."""
    sheet, axes = tiles(
        results.sizes["budget"], 2, (3.5, 2.2), (0.0, 0.0), sharex=True, sharey=True
    )
    counts, means = results["count"].values, results.success.mean("world")
    for ax, budget in zip(axes.ravel(), results.budget.values, strict=False):
        ax.plot(counts, results.start_success.mean("world"), "k:", label="start")
        for at, method in enumerate(results.method.values):
            values = means.sel(budget=budget, method=method)
            mean, *limits = np.transpose([interval(x) for x in values.values])
            error = np.abs(np.array(limits) - mean) if limits else None
            marks = {"marker": "o", "markersize": 3, "capsize": 2}
            ax.errorbar(counts * 1.08**at, mean, error, label=method, **marks)
        ax.set(xscale="log", xlabel="tuned parameters", ylabel="success", title=f"equal {budget}")
        ax.grid(alpha=0.3)
    axes[0, 0].legend()
    return sheet
