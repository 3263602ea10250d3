"""Check derivatives of whole trials against central differences in each world.

Both are of the softened score of `study.py`, in double precision.

    rps sweeps/gradients/check.py --quick
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import xarray as xr

from rps_jax.questions import call_of, option
from rps_jax.tuning.gradients import Options
from sweeps.gradients.study import Gradients, label_of, norms
from sweeps.study_base import Rows, Table

_BOUND = 0.01  # [1] relative error of a derivative that counts as right


@dataclass(frozen=True)
class Check(Gradients):
    """Check derivatives of whole trials against central differences in each world.

    The answer has the relative `error` (object, world, horizon) of the derivatives.
    """

    TITLE = "Derivatives against central differences"
    QUICK: ClassVar = {"horizons": (0.5, 2.0), "worlds": 4, "engine": "quasistatic"}
    DOUBLE: ClassVar = True

    worlds: int = option(32, 2, 1_000_000)
    """Number of worlds of each object."""
    delta: float = option(1e-6, above=0, at_most=5)
    """Step of the central differences, in units of the bounded map [1]."""

    @property
    def measurements(self) -> tuple[str, ...]:
        """Names of all measurements."""
        return ("exact", "differences")

    def options_of(self, measurement: str) -> Options:
        """Return the options of the estimator of a measurement."""
        return Options(sigma=self.delta)

    def combine(self, samples: xr.Dataset) -> xr.Dataset:
        """Return the gradients in each world with their errors."""
        size = norms(samples.differences)
        error = norms(samples.exact - samples.differences) / size.where(size > 0)
        return samples.assign(error=error)

    def intro(self, results: xr.Dataset) -> str:
        """Return the options in a sentence."""
        return (
            f"Derivatives of the remaining distance by {', '.join(self.space.names)} in "
            f"{self.worlds} worlds of each object, in the engine {self.engine} and in double "
            f"precision; differences with steps of {self.delta:g}."
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the errors by object and time."""
        title = "Errors in single worlds"
        return [Table(table(results), merge="object", name="gradients_check", title=title)]


check = call_of(Check)


def table(results: xr.Dataset) -> Rows:
    """Return a header and one row per object and quantity, by time."""
    rows = [["object", "quantity", *(f"{x:g} s" for x in results.horizon.values)]]
    for name in map(str, results.object.values):
        of_object = results.sel(object=name)
        known = of_object.error.notnull().sum("world")
        right = (of_object.error < _BOUND).sum("world") / known
        size = norms(of_object.exact)
        quantities = {
            "median error": (of_object.error.median("world"), ".1e"),
            f"share of worlds with an error below {100 * _BOUND:g} %": (right, ".2f"),
            "median norm [m]": (size.median("world"), ".1e"),
            "largest norm [m]": (size.max("world"), ".1e"),
        }
        for text, (values, form) in quantities.items():
            rows.append([label_of(name), text, *(format(x, form) for x in values.values)])
    return rows
