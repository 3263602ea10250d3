"""Cost of a simulated second of each task, relative to `reach`.

    rps sweeps/corridors/costs.py

Worlds of all tasks have the same objects and a straight way, and no trial ends early. The cost is
the wall clock on a GPU, and the time of processors otherwise, which depends less on other programs.
A new row is one entry of `TASKS`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import jax
import numpy as np
import xarray as xr

from rps_jax import Domain, Rules, Setting
from rps_jax.laws import resolve_law
from rps_jax.questions import Run, call_of, option
from rps_jax.trials.batch import outcomes
from rps_jax.trials.progress import Progress
from rps_jax.trials.worlds import Candidates
from rps_jax.worlds import parse_domain
from sweeps.study_base import SpeedStudy, Table

_BOXES = "wide,objects=random_box"
DOMAIN = f"{_BOXES},distance=19:20,bearing=0"  # of tasks with a target
_STRAIGHT = "turns=0,length=20,lookahead=1"
TASKS = {  # the first is the one to compare with; paths have 8 segments, corridors 16 walls
    "reach": "reach",
    "path": f"path,{_STRAIGHT}",
    "corridor": f"corridor,width=3,{_STRAIGHT}",
    "corridor, two doors": f"corridor,width=3,doors=2,{_STRAIGHT}",
    "walls that objects touch": f"corridor,touch=object,width=3,{_STRAIGHT}",
}


@dataclass(frozen=True)
class Costs(SpeedStudy[xr.Dataset]):
    """Measure the cost of a simulated second of each task.

    The answer has `cost` (task, round), in seconds per simulated second.
    """

    TITLE = "Cost of tasks"
    CHOICES: ClassVar = {"tasks": TASKS}
    GROWS = ("tasks",)
    PRESETS: ClassVar = {"tasks": TASKS, "domain": DOMAIN}

    tasks: tuple[str, ...] = tuple(TASKS)
    """Tasks: reach first, then those to compare with it."""
    worlds: int = option(512, 1, 10_000_000)
    """Number of worlds."""
    horizon: float = option(20.0, above=0, at_most=600, unit="s")
    """Simulated time of each world [s]."""
    rounds: int = option(5, 1, 1000)
    """Number of measurements; the first, with compilation, does not count."""
    workers: int = option(1, 1, 1024)
    """Number of threads."""

    def num_trials(self) -> int | None:
        """Return the number of trials."""
        return len(self.tasks) * self.worlds * (self.rounds + 1)

    def answer(self, run: Run) -> xr.Dataset:
        """Measure all tasks in turn, round by round."""
        setting = Setting("fused", rules=Rules(horizon=self.horizon, max_lost=1e4))
        costs = np.zeros((len(self.tasks), self.rounds + 1))
        for i in range(self.rounds + 1):
            for j, name in enumerate(self.tasks):
                inputs = domain_of(TASKS[name]), setting, self.worlds
                costs[j, i] = cost_of(*inputs, self.workers)
                done = (i * len(self.tasks) + j + 1) * self.worlds
                run.callback(Progress(done, done * self.horizon))
        cost = (("task", "round"), costs[:, 1:], {"units": "1"})
        return xr.Dataset({"cost": cost}, {"task": list(self.tasks)})

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the least cost of each task, and its ratio to the first."""
        least = results.cost.min("round").values
        ratios = (results.cost / results.cost.isel(task=0)).values
        rows = [["task", "per simulated second", "relative to reach", "by round"]]
        for name, cost, of_task in zip(self.tasks, least, ratios, strict=True):
            spread = f"{of_task.min():.2f} to {of_task.max():.2f}"
            rows.append([name, f"{1e6 * cost:.1f} µs", f"{cost / least[0]:.3f}", spread])
        return [Table(rows, name=f"tasks_cost_{kind_of_device()}", title="Cost of tasks")]


costs = call_of(Costs)


def cost_of(domain: Domain, setting: Setting, worlds: int, workers: int = 1) -> float:
    """Return the time [s] of a simulated second of `rps` in worlds of a domain."""
    params = jax.tree.map(lambda x: np.asarray(x)[None], resolve_law("rps")[1])
    start = time.process_time()
    inputs = [Candidates(params, [domain], 0, np.arange(worlds))]
    _, timing = outcomes(inputs, setting, workers=workers)
    used = time.process_time() - start if kind_of_device() == "cpu" else timing.run
    return used / timing.simulated


def domain_of(task: str) -> Domain:
    """Return boxes on a task of 20 m, which no trial ends in time."""
    has_target = parse_domain(_BOXES, None, task).task.HAS_TARGET
    return parse_domain(DOMAIN if has_target else _BOXES, None, task)


def kind_of_device() -> str:
    """Return cpu or gpu."""
    return "cpu" if jax.default_backend() == "cpu" else "gpu"
