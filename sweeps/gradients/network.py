"""Compare learned networks: PPO, gradients of short windows, and evolution.

The runs are those of `rps learn` and `learner.py`; the name of a row is that of its folder.

    rps learn --network mlp --width 23 --minutes 10 --out runs/ppo
    rps sweeps/gradients/learner.py --network mlp --width 23 --minutes 5 --out runs/windows
    rps sweeps/gradients/network.py --folders runs/ppo runs/windows
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from rps_jax.analysis.figures.style import Figure, panel
from rps_jax.analysis.report import Picture
from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.runs.question import Run, call_of
from sweeps.study_base import Rows, Study, Table

TIMES = (1.0, 2.5, 5.0, 10.0)  # [min] of wall clock, with compilation and validation


@dataclass(frozen=True)
class Networks(Study[xr.Dataset]):
    """Compare learned networks: PPO, gradients of short windows, and evolution.

    The answer has the best `validation` [1] up to each time (run, time), and the `test` (run).
    """

    TITLE: ClassVar[str] = "Networks learned by several methods"

    folders: tuple[str, ...] = ("runs/ppo", "runs/windows", "runs/evolution")
    """Folders of finished runs."""

    def check(self) -> None:
        super().check()
        if not self.folders:
            raise InputError("folders = () is not allowed: name a run.")

    def answer(self, run: Run) -> xr.Dataset:
        """Read the runs."""
        curves = {Path(folder).name: files.read_results(Path(folder)) for folder in self.folders}
        columns = [summary(curve) for curve in curves.values()]
        results = xr.concat(columns, xr.IndexVariable("run", list(curves)), join="outer")
        return results.assign_coords(time=list(TIMES))

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the success by time."""
        picture = Picture("networks", partial(figure_of, results))
        return [
            Table(table(results), name="gradients_network", title="Success", picture=picture),
        ]


networks = call_of(Networks)


def summary(curve: xr.Dataset) -> xr.Dataset:
    """Return the best validation up to each time, the validations, and the numbers of a curve."""
    minutes, validation = curve.time.values / 60, curve.validation.values
    known = np.isfinite(validation)
    best = [np.max(validation[known & (minutes <= t)], initial=-np.inf) for t in TIMES]
    best = [
        x if t <= minutes[-1] * 1.05 and x >= 0 else np.nan
        for t, x in zip(TIMES, best, strict=True)
    ]
    scalars: Mapping[str, Any] = {
        "test": curve.attrs.get("test_success", np.nan),
        "level": float(curve.level[-1]),
        "updates": float(curve.sizes["update"]),
        "minutes": float(minutes[-1]),
        "simulated": float(curve.simulated[-1]),
    }
    return xr.Dataset(
        {
            "validation": ("time", best),
            "at": ("check", minutes[known]),
            "success": ("check", validation[known]),
            **{name: ((), value) for name, value in scalars.items()},
        },
        {"check": np.arange(known.sum())},
    )


def table(results: xr.Dataset) -> Rows:
    """Return a header and a row per run."""
    times = [f"validation, {t:g} min" for t in TIMES]
    rows = [["run", *times, "test", "curriculum", "minutes", "updates", "simulated"]]

    def rate(x: float) -> str:
        return "" if np.isnan(x) else f"{100 * x:.1f} %"

    for name in map(str, results.run.values):
        row = results.sel(run=name)
        rows.append(
            [
                name,
                *map(rate, row.validation.values),
                rate(float(row.test)),
                f"{100 * float(row.level):.0f} %",
                f"{float(row.minutes):.1f}",
                f"{float(row.updates):,.0f}",
                f"{float(row.simulated) / 3600:,.0f} h",
            ]
        )
    return rows


def figure_of(results: xr.Dataset) -> Figure:
    """Draw the success in validation against the wall clock."""
    figure, ax = panel((6, 3.5), "wall clock, with compilation [min]", "success in validation [%]")
    for name in map(str, results.run.values):
        row = results.sel(run=name)
        ax.plot(row.at, 100 * row.success, "o-", ms=3, label=name)
    ax.legend(fontsize=8)
    return figure
