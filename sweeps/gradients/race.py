"""Race derivatives, slopes and evolution: equal wall time and equal simulated time.

Each tuning is a run of `rps tune grad` or `rps tune es`, in a separate folder, and is killed after
some minutes; a second call continues it, up to these minutes. Runs with other seeds, methods or
problems share the folder, so that a race can be split. The generation with the best validation
within a budget is tested in worlds that no tuning has met.

    rps sweeps/gradients/race.py --lanes 2 --minutes 5 --seeds 1

The default race has 84 tunings of four minutes, and takes six to seven hours on two cores.
Several tunings run at once on one GPU and share it equally. Then a budget of wall time is that of a
loaded GPU.
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
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import xarray as xr

from rps_jax import InputError, RPSParams, Setting, errors, evaluate
from rps_jax.analysis import statistics
from rps_jax.control import registry
from rps_jax.questions import Run, call_of, option
from rps_jax.runs.question import SimulationQuestion
from sweeps.study_base import Parts, Rows, Study, Table, part_name

TABLES = Path(__file__).with_name("tables.py")
# Laws and tuned parameters by the number of these.
COUNTS = {
    6: "--tuned K_h K_v L beta l_cr d_th",
    13: "--tuned full",
    18: "--tuned full --law rps_plus --domain real --objects random_box",
    **{
        n: f"--tuned full --law {TABLES}:Table{n} --objects random_cylinder"
        for n in (64, 512, 2048)
    },
}
_COMMON = "--horizon 150 --validation 256"
_ES = f"rps tune es {_COMMON} --generations 1000 --worlds"
METHODS = {  # commands that are compared
    "derivatives": f"rps tune grad {_COMMON}",
    "slopes": f"rps tune es --estimator antithetic {_COMMON}",
    "evolution": f"{_ES} 64 --population 16",
}
QUICK_SIZES = (
    " --objects random_cylinder --engine quasistatic --horizon 20 --validation 4 --worlds 4"
)
BUDGETS = ("wall", "simulated")


@dataclass(frozen=True)
class Race(Study[xr.Dataset], SimulationQuestion[xr.Dataset]):
    """Race derivatives, slopes and evolution: equal wall time and equal simulated time.

    The answer has the `success` (tuning, budget, world) of the tuned laws in test worlds, and that
    of the law at the start, `start_success` (tuning, world). Budgets are `wall` or `simulated` with
    an amount [s].
    """

    TITLE: ClassVar[str] = "Derivatives against evolution"
    CHOICES: ClassVar = {"methods": METHODS}
    GROWS: ClassVar[tuple[str, ...]] = ("methods", "counts", "seeds")
    QUICK: ClassVar[Mapping[str, Any]] = {
        "worlds": 4,
        "counts": (64,),
        "seeds": (1,),
        "methods": ("derivatives",),
    }
    IGNORED_FIELDS: ClassVar[tuple[str, ...]] = ("minutes", "lanes", "gpus")
    DIMENSION: ClassVar[str] = "tuning"
    REPORTS_TIMES: ClassVar[bool] = True

    methods: tuple[str, ...] = tuple(METHODS)
    """derivatives (`rps tune grad`), slopes (antithetic steps in whole trials) or evolution."""
    counts: tuple[int, ...] = (6, 13, 64, 2048)
    """Numbers of tuned parameters: 6 and 13 of RPS, 18 of RPS+ in `real`, or the 64, 512 and
    2,048 entries of tables."""
    seeds: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 7)
    """Seeds of the tunings."""
    minutes: float = option(4.0, above=0, at_most=1e4, unit="min")
    """Wall clock after which a tuning is killed [min], with compilation."""
    wall: tuple[float, ...] = option((10.0, 30.0, 120.0), above=0, unit="s")
    """Budgets of wall time without compilation [s]."""
    simulated: tuple[float, ...] = option((6e4, 2e5, 6e5), above=0, unit="s")
    """Budgets of simulated time [s]; a differentiated second counts as four."""
    worlds: int = option(2000, 1, 1_000_000)
    """Number of test worlds of `wide`."""
    lanes: int = option(1, 1, 64)
    """Number of tunings that run at once."""
    gpus: int = option(0, 0, 8)
    """Number of GPUs for the tunings; 0 leaves the choice to them."""
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

    def tunings(self) -> dict[tuple[str, int, int], str]:
        """Return the commands of the tunings by method, count and seed."""
        labels = itertools.product(self.methods, self.counts, self.seeds)
        sizes = QUICK_SIZES if self.quick else ""
        return {(m, n, s): f"{METHODS[m]} {COUNTS[n]} --seed {s}{sizes}" for m, n, s in labels}

    def answer(self, run: Run) -> xr.Dataset:
        """Run the tunings that lack a test, and test all."""
        assert run.folder is not None
        stored = () if run.checkpoints is None else run.checkpoints.paths()
        commands = {
            run.folder / part_name(*label): command
            for label, command in self.tunings().items()
            if part_name(*label) not in stored
        }
        run_commands(commands, self.minutes, self.lanes, self.gpus)
        return super().answer(run)

    def parts(self, run: Run) -> Parts:
        """Return the test of each tuning, by its label."""
        folder = run.folder or Path(str(self.out))
        return {
            part_name(*label): partial(self._test, folder / part_name(*label), label)
            for label in self.tunings()
        }

    def _test(self, folder: Path, label: tuple[str, int, int]) -> xr.Dataset:
        """Return the success of the best law of a tuning within each budget."""
        if not (folder / "curve.csv").exists():
            reason = f"{folder.with_suffix('.log')} tells why; or raise minutes"
            raise InputError(f"{folder} has no generation: {reason}.")
        curve = pd.read_csv(folder / "curve.csv")
        budgets = [(name, amount) for name in BUDGETS for amount in getattr(self, name)]
        chosen = [best_within(curve, *budget) for budget in budgets]
        start, domain = problem(label[1])
        laws = [start, *(law_of(row, start) for row in chosen)]
        options = {"split": "test", "setting": self.setting, "progress": False}
        scores = evaluate(laws, domain, self.worlds, **options)
        start_success, *tuned = scores.success.values.astype(np.int8)
        columns = {"method": label[0], "count": label[1], "seed": label[2]}
        variables = {name: ((), value) for name, value in columns.items()}
        totals = {"generations": len(curve), "wall": spent(curve, "wall").iloc[-1]}
        totals |= {"simulated": spent(curve, "simulated").iloc[-1]}
        variables |= {name: ((), float(value)) for name, value in totals.items()}
        variables |= {"start_success": ("world", start_success)}
        return xr.Dataset(
            variables | {"success": (("budget", "world"), np.stack(tuned))},
            {"budget": [f"{name} {amount:g} s" for name, amount in budgets]},
        )

    def intro(self, results: xr.Dataset) -> str:
        """Return the budgets."""
        return (
            f"Tunings from the paper's parameters, with budgets of wall time without compilation "
            f"or of simulated time; success in {self.worlds:,} worlds that no tuning has met."
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the success of the tunings."""
        return [Table(table(results), merge="parameters", name="gradients_race", title="Success")]


race = call_of(Race)


def run_commands(commands: Mapping[Path, str], minutes: float, lanes: int, gpus: int) -> None:
    """Run or continue the command of each folder until it ends or its time is up.

    So many `lanes` run at once. They take turns at the GPUs; with 0 GPUs they choose themselves.
    Each writes to the folder and to a log beside it.
    """

    def run(index: int, folder: Path) -> None:
        environment = dict(os.environ, XLA_PYTHON_CLIENT_PREALLOCATE="false")
        if gpus:
            environment["CUDA_VISIBLE_DEVICES"] = str(index % gpus)
        words = shlex.split(commands[folder])[1:]
        program = [sys.executable, "-m", "rps_jax", *words, "--out", str(folder)]
        with open(folder.with_suffix(".log"), "a", encoding="utf-8") as log:
            process = subprocess.Popen(program, env=environment, stdout=log, stderr=log)
            try:
                process.wait(60 * minutes)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    with ThreadPoolExecutor(lanes) as pool:
        for future in [pool.submit(run, *item) for item in enumerate(commands)]:
            future.result()


def spent(curve: pd.DataFrame, budget: str) -> pd.Series:
    """Return what each generation of a log has used of a budget, with all before it [s]."""
    return pd.Series(curve["run" if budget == "wall" else "simulated"]).cumsum()


def best_within(curve: pd.DataFrame, budget: str, amount: float) -> pd.Series:
    """Return the generation with the best validation within a budget; at least the first."""
    within = curve[(spent(curve, budget) <= amount) | (curve.index == 0)]
    return within.loc[within.validation.idxmin()]


def problem(count: int) -> tuple[Any, str]:
    """Return the law at the start and the domain of the test worlds of a problem."""
    words = shlex.split(COUNTS[count])
    values = dict(itertools.pairwise(words))
    _, start = registry.parse_law(values.get("--law", "rps"))
    objects = f",objects={values['--objects']}" if "--objects" in values else ""
    return start, f"{values.get('--domain', 'wide')}{objects}"


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


def table(results: xr.Dataset) -> Rows:
    """Return a header and a row per number of parameters, budget and method."""
    head = ["parameters", "equal", "method", "success, mean", "by seed [%]", "gained, lost"]
    rows = [[*head, "generations"]]
    for count in sorted(set(results["count"].values.tolist())):
        of_count = results.isel(tuning=np.flatnonzero(results["count"] == count))
        start = of_count.start_success.isel(tuning=0)
        rows.append([str(count), "", "start", f"{100 * float(start.mean()):.1f} %", "", "", ""])
        for budget, method in itertools.product(results.budget.values, METHODS):
            chosen = of_count.isel(tuning=np.flatnonzero(of_count.method == method))
            if not chosen.sizes["tuning"]:
                continue
            success = chosen.success.sel(budget=budget)
            rates = 100 * success.mean("world").values
            compared = [statistics.compare(start, x) for x in success]
            gained, lost = (sum(getattr(c, name) for c in compared) for name in ("gained", "lost"))
            seeds = ", ".join(f"{x:.1f}" for x in rates)
            generations = f"{chosen.generations.values.mean():.0f}"
            label, mean = str(budget).replace(" ", " time, "), f"{rates.mean():.1f} %"
            counts = f"+{gained} -{lost}"
            rows.append([str(count), label, method, mean, seeds, counts, generations])
    return rows
