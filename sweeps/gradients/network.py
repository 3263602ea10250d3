"""Race three ways to learn a network: PPO, gradients of short windows, and evolution.

Each racer is a run of `rps learn` or `learner.py` in a separate folder. It ends after some minutes
of wall clock, with compilation, and is killed if it takes half a minute more; then its row has what
it wrote. A second call continues the racers.

    rps sweeps/gradients/network.py --lanes 6 --gpus 3 --minutes 5

Several racers run at once. They share a GPU equally if each has equally many.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import xarray as xr

from rps_jax import load
from rps_jax.analysis import tables
from rps_jax.analysis.figures.style import Figure, tiles
from rps_jax.physics import PHYSICS
from rps_jax.questions import Picture, Run, call_of, option
from sweeps.gradients.race import run_commands
from sweeps.study_base import QuickStudy, Rows, Table, part_name, text_table

TIMES = (1.0, 2.0, 3.0, 4.0, 5.0)  # [min] of wall clock, with compilation and validation
WORLDS = 3 * 128  # for validation, and as many for the test: of each object of `wide`
_COLUMNS = "level", "simulated", "touching"
_NETWORK = "--network mlp --width 23 --validation 128 --every 0.25"
METHODS = {  # commands that are compared
    "ppo": f"rps learn {_NETWORK}",
    "windows": f"rps sweeps/gradients/learner.py {_NETWORK}",
    "evolution": f"rps sweeps/gradients/learner.py {_NETWORK} --estimator evolution",
}
QUICK_SIZES = (
    " --domain wide,objects=random_cylinder --num-envs 4 --num-steps 2 --num-minibatches 1"
    " --drawn 4 --validation 2 --engine quasistatic --horizon 4 --updates 3"
)


@dataclass(frozen=True)
class Networks(QuickStudy[xr.Dataset]):
    """Race three ways to learn a network: PPO, gradients of short windows, and evolution.

    The answer has the best `validation` [1] up to each time (run, time), and the `test` (run).
    """

    TITLE = "Networks learned by several methods"
    CHOICES: ClassVar = {"methods": METHODS}
    QUICK: ClassVar = {"seeds": (1,)}
    PRESETS: ClassVar = {"physics": PHYSICS["default"], "domains": ("wide",)}
    IGNORED_FIELDS = ("minutes", "lanes", "gpus")

    methods: tuple[str, ...] = tuple(METHODS)
    """ppo, windows (derivatives of windows with a value function at their ends) or evolution
    (slopes of the same windows along antithetic random steps of the weights)."""
    seeds: tuple[int, ...] = (1, 2)
    """Seeds of the racers."""
    minutes: float = option(5.0, above=0, at_most=1e4, unit="min")
    """Wall clock of each racer [min], with compilation, validation and test."""
    lanes: int = option(1, 1, 64)
    """Number of racers that run at once."""
    gpus: int = option(0, 0, 8)
    """Number of GPUs for the racers; 0 leaves the choice to them."""
    out: Path | str | None = "runs/networks"
    """Run folder; the racers have folders there."""

    def configuration(self) -> dict[str, Any]:
        """Return all inputs of the answer, with the commands of the racers."""
        commands = {name: METHODS[name] for name in self.methods}
        return super().configuration() | {"commands": commands}

    def answer(self, run: Run) -> xr.Dataset:
        """Run the racers, and read their learning curves."""
        assert run.folder is not None
        labels = list(itertools.product(self.methods, self.seeds))
        folders = {label: run.folder / part_name(*label) for label in labels}
        sizes = f"{QUICK_SIZES if self.quick else ''} --minutes {self.minutes:g}"
        # The racers of a method share a GPU, if there is one for each method.
        commands = {
            folders[m, s]: f"{METHODS[m]}{sizes} --seed {s}"
            for s, m in itertools.product(self.seeds, self.methods)
        }
        run_commands(commands, self.minutes + 0.5, self.lanes, self.gpus)
        rows = [
            summary(read_curve(folder)).assign(method=method, seed=seed)
            for (method, seed), folder in folders.items()
        ]
        names = xr.IndexVariable("run", [folder.name for folder in folders.values()])
        return xr.concat(rows, names, join="outer").assign_coords(time=list(TIMES))

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the success by time."""
        picture = Picture("networks", partial(figure_of, results))
        rows = table(results, tested=not self.quick)
        return [
            Table(rows, merge="method", name="gradients_network", title="Success", picture=picture)
        ]


networks = call_of(Networks)


def read_curve(folder: Path) -> xr.Dataset:
    """Return the learning curve of a run folder; of a killed run, that of its last checkpoint."""
    if (folder / "results.nc").exists():
        return load(folder)
    if (folder / "curve.csv").exists():
        return pd.read_csv(folder / "curve.csv", index_col="update").to_xarray()
    columns = dict.fromkeys(("time", "validation", *_COLUMNS), np.zeros(0))
    return pd.DataFrame(columns, pd.RangeIndex(0, name="update")).to_xarray()


def summary(curve: xr.Dataset) -> xr.Dataset:
    """Return the best validation up to each time, the validations, and the numbers of a curve."""
    minutes, validation = curve.time.values / 60, curve.validation.values
    known = np.isfinite(validation)
    best = [np.max(validation[known & (minutes <= t)], initial=-np.inf) for t in TIMES]
    best = [
        x if t <= np.max(minutes, initial=0) * 1.05 and x >= 0 else np.nan
        for t, x in zip(TIMES, best, strict=True)
    ]
    scalars: Mapping[str, Any] = {
        "test": curve.attrs.get("test_success", np.nan),
        "updates": float(curve.sizes["update"]),
        "first": minutes[0] if minutes.size else np.nan,
        "simulated": np.max(curve.simulated.values, initial=0),
        "touching": float(curve.touching[-10:].mean()),
    }
    return xr.Dataset(
        {
            "validation": ("time", best),
            "at": ("check", minutes[known]),
            "success": ("check", validation[known]),
            "minutes": ("update", minutes),
            "level": ("update", curve.level.values),
            **{name: ((), value) for name, value in scalars.items()},
        },
        {"check": np.arange(known.sum()), "update": np.arange(len(minutes))},
    )


def table(results: xr.Dataset, tested: bool = True) -> Rows:
    """Return a header and a row per racer; intervals of tests, unless they had few worlds."""
    columns = {"method": "{method}", "seed": "{seed:.0f}"}
    columns |= {f"{t:g} min": f"{{v{t:g}:.1f}} %" for t in TIMES}
    columns |= {"test": "{share}", "curriculum": "{level:.0f} %", "first update": "{first:.1f} min"}
    columns |= {"updates": "{updates:,.0f}", "time of an update": "{pace:.2f} s"}
    columns |= {"simulated": "{hours:,.0f} h", "actions in contact": "{contact:.0f} %"}
    rows: list[dict[str, Any]] = []
    for name in results.run.values:
        row = results.sel(run=name)
        scalars = {key: row[key].item() for key in ("method", "seed", "first", "updates", "test")}
        validation = {f"v{t:g}": 100 * float(x) for t, x in row.validation.to_series().items()}
        counts = round(np.nan_to_num(scalars["test"]) * WORLDS), WORLDS if tested else 0
        share = tables.share(*counts) if np.isfinite(scalars["test"]) else ""
        hours, level = float(row.simulated) / 3600, 100 * float(row.level.max())
        pace, contact = 60 * float(row.minutes.diff("update").mean()), 100 * float(row.touching)
        scalars |= {"share": share, "hours": hours, "level": level, "pace": pace}
        rows.append(scalars | validation | {"contact": contact})
    return text_table(columns, rows)


def figure_of(results: xr.Dataset) -> Figure:
    """Draw the success in validation and the level of the curriculum against the wall clock."""
    figure, axes = tiles(2, 2, (4.5, 3.2), (0, 0))
    methods = [str(x) for x in results.method.values]
    for i, method in enumerate(methods):
        row = results.isel(run=i)
        label = None if method in methods[:i] else method
        style = {"color": f"C{list(METHODS).index(method)}", "label": label}
        axes[0, 0].plot(row.at, 100 * row.success, "o-", ms=3, **style)
        axes[0, 1].plot(row.minutes, 100 * row.level, **style)
    labels = "success in validation [%]", "level of the curriculum [%]"
    for ax, label in zip(axes[0], labels, strict=True):
        ax.set(xlabel="wall clock, with compilation [min]", ylabel=label, ylim=(-3, 103))
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8)
    return figure
