"""Exact derivatives of MJX in custom models, against central differences.

rps sweeps/gradients/mjx.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import ClassVar

import jax
import xarray as xr

from rps_jax.engines import mjx_gradients
from rps_jax.questions import Run, call_of, option
from sweeps.gradients import mjx_upstream
from sweeps.study_base import Parts, Study, Table


@dataclass(frozen=True)
class MJXGradients(Study[xr.Dataset]):
    """Compare the derivatives of `rps_jax.engines.mjx_gradients.step` with central differences.

    The answer has the largest `error` of the Jacobian of the state and the controls after some
    steps (case, steps), relative to its largest entry, in double precision; the share `forward` of
    finite entries of MJX's forward mode from rest; and the error `reverse` of its reverse mode.
    """

    TITLE = "Exact derivatives of MJX in custom models"
    DIMENSION = "case"
    CHOICES: ClassVar = {"models": mjx_upstream.MODELS}
    GROWS = ("models",)

    models: tuple[str, ...] = tuple(mjx_upstream.MODELS)
    """Models to step, each with both friction cones."""
    steps: int = option(100, 2, 10_000)
    """Number of steps of the longer path; the shorter has one."""

    def parts(self, run: Run) -> Parts:
        """Return the function that measures each model with each cone."""
        cases = product(self.models, mjx_upstream.CONES)
        return {f"{name}, {cone}": partial(self._measure, name, cone) for name, cone in cases}

    def _measure(self, name: str, cone: str) -> xr.Dataset:
        with jax.enable_x64(True):
            counts = (1, self.steps)
            step = mjx_gradients.step
            errors, finite = mjx_upstream.measure(step, name, cone, counts)
            failure = mjx_upstream.failure(name, cone)
        return xr.Dataset(
            {
                "error": ("steps", list(errors.values())),
                "forward": finite,
                "reverse": failure,
            },
            {"steps": list(errors)},
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the errors of each model and cone."""
        last = f"{results.steps.values[-1]} steps"
        columns = [
            {"name": "model", "merge": True},
            {"name": "cone"},
            *({"name": f"error, {name}", "format": "{:.1e}"} for name in ("1 step", last)),
            {"name": "forward mode of MJX from rest", "format": "{:.0%} finite"},
            {"name": "`jax.grad` of MJX"},
        ]
        rows = [
            [
                *str(case).rsplit(", ", 1),
                *row.error.values.tolist(),
                float(row.forward),
                str(row.reverse.item()).partition(":")[0],
            ]
            for case in results.case.values
            for row in [results.sel(case=case)]
        ]
        note = (
            "Error of the Jacobian of the state and the controls against central differences, "
            "relative to its largest entry, in double precision."
        )
        return [Table(rows, note, columns, name="gradients_mjx", title="Errors")]


mjx_gradients_study = call_of(MJXGradients)
