"""Cosine of derivatives of windows with the gradient of whole trials, before the first step.

rps sweeps/gradients/direction.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import Rules, Setting
from rps_jax.questions import Run, call_of, option
from rps_jax.runs import evaluate
from rps_jax.runs.question import SimulationQuestion
from rps_jax.tuning import gradients
from rps_jax.tuning.descent import TuneGrad
from rps_jax.tuning.evolution import TuneES
from sweeps.gradients.race import COUNTS, Lockstep, PacedGrad
from sweeps.study_base import Parts, Study, Table, mean_interval


@dataclass(frozen=True)
class Direction(Study[xr.Dataset], SimulationQuestion[xr.Dataset]):
    """Compare the direction of `rps tune grad` at the start with the slopes of whole trials.

    The answer has the `cosine` (count, estimate, seed) of derivatives and of slopes with slopes in
    many other worlds, the truth; its `reliability` (count), the cosine that an estimate without an
    error has with it; and the `simulated` time (count, estimate) [s].
    """

    TITLE: ClassVar[str] = "Directions of derivatives and slopes"
    CHOICES: ClassVar = {"counts": COUNTS}
    DIMENSION: ClassVar[str] = "count"
    GROWS: ClassVar[tuple[str, ...]] = ("counts",)
    REPORTS_TIMES: ClassVar[bool] = True

    counts: tuple[int, ...] = (6, 64)
    """Numbers of tuned parameters, as of `race.py`."""
    seeds: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 7)
    """Seeds of the estimates."""
    truth: int = option(4096, 8, 10_000_000)
    """Number of worlds of the truth."""
    setting: Setting = field(default=Setting(rules=Rules(horizon=150.0)), kw_only=True)

    def parts(self, run: Run) -> Parts:
        """Return the function that measures each count."""
        return {n: partial(self._measure, n) for n in self.counts}

    def _measure(self, count: int) -> xr.Dataset:
        options: Any = COUNTS[count]
        slopes = partial(TuneES, estimator="antithetic", **options)
        truth, error, _ = self._gradient(slopes(worlds=self.truth, setting=self._with_seed(0)))
        pool = Lockstep(1)  # with the programs of all seeds

        def derivatives(setting: Setting) -> TuneGrad:
            question = PacedGrad(checks=0, setting=setting, **options)
            object.__setattr__(question, "pool", pool)
            return question

        estimates = {
            "derivatives": derivatives,
            "slopes": partial(slopes, worlds=128),
        }
        cosines, times = [], []
        for ask in estimates.values():
            tried = [self._gradient(ask(setting=self._with_seed(x))) for x in self.seeds]
            cosines.append([float(gradients.cosine(x, truth)) for x, _, _ in tried])
            times.append(np.mean([time for _, _, time in tried]))
        noise = np.minimum(error / jnp.linalg.norm(truth), 1.0)
        return xr.Dataset(
            {
                "cosine": (("estimate", "seed"), cosines),
                "simulated": ("estimate", times),
                "reliability": float(np.sqrt(1 - noise**2)),
            },
            {"estimate": list(estimates), "seed": list(self.seeds)},
        )

    def _with_seed(self, seed: int) -> Setting:
        return replace(self.setting, seed=seed)

    def _gradient(self, question: Any) -> tuple[Any, float, float]:
        """Return gradient (p,), error and simulated time [s] of the first step of a tuning."""
        simulated = [0.0]

        def score(requests: list[Any]) -> list[Any]:
            scores, timing = evaluate.score_candidates(
                requests, question.setting, question.objective
            )
            simulated.append(timing.simulated)
            return scores

        results = question.judge(next(question.search()), 0, score)
        time = sum(simulated) + float(results.get("simulated", 0.0))
        gradient = jnp.asarray(np.asarray(results["gradients"])[0])
        return gradient, float(results["gradient_error"]), time

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the cosines."""
        columns = [
            {"name": "parameters", "merge": True},
            {"name": "estimate"},
            {"name": "cosine", "format": "{:.2f}", "rest": " [{:.2f}, {:.2f}]"},
            {"name": "without an error", "format": "{:.2f}"},
            {"name": "simulated", "format": "{:,.0f} s"},
        ]
        rows = [
            [
                str(count),
                estimate,
                mean_interval(at.cosine.values),
                float(at.reliability),
                float(at.simulated),
            ]
            for count in results["count"].values
            for estimate in map(str, results.estimate.values)
            for at in [results.sel(count=count, estimate=estimate)]
        ]
        text = (
            "Cosine with slopes of many other worlds, with 95 % intervals over the seeds by "
            "Student's t. An estimate without an error would have the cosine of the fourth column."
        )
        return [Table(rows, text, columns, name="gradients_direction", title="Cosines")]


direction = call_of(Direction)
