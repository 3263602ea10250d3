"""Fit five quantities of one object to one push: exact derivatives against CMA-ES.

Both minimise the cost of `least_squares` from the same starts, in equal wall time, and predict
another push of the object to another target.

    rps sweeps/fit/one_push.py
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, ClassVar

import jax
import numpy as np
import xarray as xr

from rps_jax import Setting
from rps_jax.laws import resolve_law
from rps_jax.questions import Run, call_of, option
from rps_jax.runs.question import SimulationQuestion
from rps_jax.tuning.fit import Bank
from rps_jax.world import points
from rps_jax.world.domain import quantities_of
from rps_jax.world.points import Points
from rps_jax.worlds import parse_domain
from sweeps.fit import least_squares, methods
from sweeps.fit.least_squares import STARTS, Replay, Track
from sweeps.study_base import Parts, Study, Table, mean_interval

FITTED = ("friction_robot", "friction_ground", "mass", "com_offset", "com_bearing")
_WINDOWS = 8  # of each log; a log with fewer is skipped
_KEYS = "key_0", "key_1"


class FiveQuantities(Replay):
    """Least-squares problem whose shape and noise are known."""

    @property
    def active(self) -> list[int]:
        """Columns of the cube that are fitted."""
        return [points.names(self.domain).index(name) for name in FITTED]


@dataclass(frozen=True)
class OnePush(Study[xr.Dataset], SimulationQuestion[xr.Dataset]):
    """Fit five quantities of one object to one push by exact derivatives and by CMA-ES.

    The answer has the error of the predicted motion in 2 s of another push, `prediction` [m], and
    that of the `friction` with the robot as a share of its range (object, method, budget); those of
    the best start, `start_prediction` and `start_friction` (object); and the number of
    `iterations` (object, method).
    """

    TITLE: ClassVar[str] = "An object from one push"
    DIMENSION: ClassVar[str] = "object"

    objects: int = option(48, 2, 10_000)
    """Number of objects, with two pushes each; one without enough contact is skipped."""
    length: float = option(20.0, 15, 300, unit="s")
    """Length of the log of a push [s]."""
    wall: tuple[float, ...] = option((0.5, 2.0, 8.0), above=0, unit="s")
    """Budgets of wall time without compilation [s]."""
    setting: Setting = field(default=Setting("fused"), kw_only=True)

    @cached_property
    def _bank(self) -> Bank:
        domain = parse_domain("wide,objects=random_box,pose_latency=0:0")
        _, law = resolve_law("rps")
        period = self.setting.physics.control_period
        return Bank(domain, law, self.setting, self.length, 2 * period)

    @cached_property
    def _problems(self) -> list[tuple[np.ndarray, Replay, Replay]]:
        """True point (q,), and the least-squares problem of each of two pushes, by object."""
        domain, interval = self._bank.domain, self._bank.interval
        seed, index = replace(self.setting, split="test").world_seed, np.arange(self.objects)
        first, other = np.split(points.points_of(domain, np.arange(2 * self.objects), seed), 2)
        task = [name in (*quantities_of("task"), *_KEYS) for name in points.names(domain)]
        pairs = []
        for u in (first, np.where(task, other, first)):
            logs = self._bank.logs(points.draw(domain, seed, Points(u), index))
            rows = [jax.tree.map(lambda x, i=i: x[i : i + 1], logs) for i in index]
            pairs.append([Track.of(log, interval, False, True) for log in rows])
        problems = []
        for u, *tracks in zip(first, *pairs, strict=True):
            if min(track.first.size for track in tracks) >= _WINDOWS:
                short = [track._replace(first=track.first[:_WINDOWS]) for track in tracks]
                replays = [FiveQuantities(domain, [x], self.setting, False) for x in short]
                problems.append((u, *replays))
        return problems

    def parts(self, run: Run) -> Parts:
        """Return the function that fits each object."""
        return {i: partial(self._fit, i) for i in range(len(self._problems))}

    def num_trials(self) -> int | None:
        """Return the number of pushes."""
        return 2 * self.objects

    def _fit(self, index: int) -> xr.Dataset:
        """Fit an object by both methods."""
        truth, replay, other = self._problems[index]
        starts = np.tile(truth, (STARTS, 1))
        random = np.random.default_rng(index)
        starts[:, replay.active] = random.random((STARTS, len(replay.active)))
        costs = least_squares.cost(replay.derivatives(starts)[0])
        best, least = starts[np.argmin(costs)], float(np.min(costs))
        fits = {
            "derivatives": partial(_descend, replay, starts),
            "evolution": partial(methods.evolve, replay, best, least, index),
        }
        for begin in fits.values():
            next(begin())  # compiles
        column = points.names(replay.domain).index("friction_robot")

        def measure(u: np.ndarray) -> list[float]:
            """Return the error of a prediction [m], and that of the friction."""
            r, _ = other.derivatives(np.tile(u, (STARTS, 1)))
            moved = np.sqrt(np.mean(np.sum(r[0, :, 3:5] ** 2, axis=-1)))
            return [float(moved), float(abs(u - truth)[column])]

        results, counts = [], []
        for begin in fits.values():
            steps, history, start = begin(), [(0.0, best)], time.perf_counter()
            while history[-1][0] < max(self.wall):
                u = next(steps)
                history.append((time.perf_counter() - start, u))
            within = [[u for spent, u in history if spent <= wall][-1] for wall in self.wall]
            results.append([measure(u) for u in within])
            counts.append(len(history) - 1)
        values, dims = np.array(results), ("method", "budget")
        prediction, friction = measure(best)
        return xr.Dataset(
            {
                "prediction": (dims, values[..., 0]),
                "friction": (dims, values[..., 1]),
                "start_prediction": prediction,
                "start_friction": friction,
                "iterations": ("method", counts),
            },
            {"method": list(fits), "budget": list(self.wall)},
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the errors by budget and method."""
        rest = {"rest": " [{:.1f}, {:.1f}]"}
        columns = [
            {"name": "wall time", "merge": True},
            {"name": "method"},
            {"name": "error in another push", "format": "{:.1f} mm", **rest},
            {
                "name": "of derivatives less by",
                "format": "{:+.1f} mm",
                "rest": " [{:+.1f}, {:+.1f}]",
            },
            {"name": "error of the friction with the robot", "format": "{:.1f} %", **rest},
            {"name": "iterations a second", "format": "{:.1f}"},
        ]
        start = [mean_interval(k * results[f"start_{x}"].values) for k, x in _SHOWN]
        rows: list[list[Any]] = [["", "best start", start[0], None, start[1], None]]
        for budget, method in np.ndindex(results.sizes["budget"], results.sizes["method"]):
            both = results.isel(budget=budget)
            chosen = both.isel({"method": method})
            error, friction = (k * chosen[x].values for k, x in _SHOWN)
            more = error - 1e3 * both.prediction.values[:, 0]
            cells = mean_interval(error), mean_interval(more) if method else None
            rate = float(chosen.iterations.mean()) / max(self.wall)
            label = f"{float(both.budget):g} s", str(chosen.method.values)
            rows.append([*label, *cells, mean_interval(friction), rate])
        text = (
            f"{results.sizes['object']} boxes. Errors of the predicted motion in 2 s, and of the "
            "friction as a share of its range. Square brackets: 95 % intervals by Student's t."
        )
        return [Table(rows, text, columns, name="fit_one_push", title="Errors")]


def _descend(replay: Replay, starts: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the best point (q,) after each iteration with derivatives."""
    for points_, r, _ in replay.descend(starts):
        yield points_[np.argmin(least_squares.cost(r))].copy()


_SHOWN = ((1e3, "prediction"), (100.0, "friction"))
one_push = call_of(OnePush)
