"""Straight and curved paths of Force Push, under its law and under laws that sense touch.

    rps sweeps/force_push_grid/paths.py --quick

Heins and Schoellig (2024) push along the x axis, and along a path with a quarter of a circle of 2 m
radius 3 m ahead (`setup_corner_path` of their script `pyb_simulation_many.py`). This study adds
radii of 1 and 4 m. It compares

1. their law with their point, on their grid of 243 starts of each slider (`grid`);
2. laws of this package with its base, at its speed, pushing sliders of equal size, mass and
   friction, from starts that are drawn from the ranges of their grid.

The second has the contact at the base's middle at the start, even moments of inertia, and no
friction below 0.01. Its laws see a target, a lookahead ahead on the path.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import ClassVar

import numpy as np
import xarray as xr

from rps_jax import Robot, Rules, Setting
from rps_jax.analysis import tables
from rps_jax.analysis.figures.style import Figure, tiles
from rps_jax.laws import LawsLike
from rps_jax.questions import MultiLawQuestion, Picture, Plan, Run, call_of, option
from rps_jax.worlds import parse_domain
from sweeps.force_push_grid import grid
from sweeps.study_base import (
    PlanStudy,
    QuickStudy,
    Rows,
    Table,
    median_interval,
    part_name,
    run_plans,
)

POINT = "force_push, with a point"  # their law with their pusher
RADII = {"straight": math.inf, "4 m": 4.0, "2 m": 2.0, "1 m": 1.0}  # [m] of the turn
LENGTH = 12.0  # [m] of a path
LOOKAHEADS = (0.6, 1.6)  # [m], of which each law has the better
_OBJECTS: Mapping[grid.SliderName, str] = {"box": "random_box", "cylinder": "random_cylinder"}
_SLIDER = (
    "wide,mass=1,size=0.5,aspect=1,height=0.12,com_offset=0,friction_ground=0.25,"
    "friction_robot=0.01:1,lateral=-0.4:0.4,yaw=-0.3927:0.3927,gap=0.01:0.05,skin=ideal,"
    "pose_noise=0,yaw_noise=0,pose_latency=0,command_delay=0,velocity_error=0"
)


@dataclass(frozen=True)
class Paths(PlanStudy[xr.DataTree], QuickStudy[xr.DataTree], MultiLawQuestion[xr.DataTree]):
    """Follow the paths of Heins and Schoellig, by their law and by laws that sense touch.

    The answer is a tree: `success`, `error_mean` and `error_95` [m] of the contact (path, slider,
    world) for their law with a point, and (lookahead, path, slider, law, world) for other laws.
    """

    TITLE = "Paths of Force Push"
    QUICK: ClassVar = {"laws": ("force_push", "rps_tuned"), "worlds": 12}
    PRESETS: ClassVar = {
        **{"radii": list(RADII.values()), "length": LENGTH, "lookaheads": LOOKAHEADS},
        **{"slider": _SLIDER, "law": grid.PARAMS},
    }

    laws: LawsLike = (
        "force_push",
        "force_push_published",
        "rps",
        "rps_tuned",
        "rps_plus",
        "learned",
    )
    worlds: int = option(243, 2, 10_000_000)
    """Number of pushes of each law, slider and path."""
    setting: Setting = field(
        default=Setting("fused", seed=5209, rules=Rules(horizon=600.0)), kw_only=True
    )

    def num_trials(self) -> int | None:
        """Return the number of pushes."""
        count = sum(plan.num_trials for plan in self.plans.values())
        return count + len(RADII) * len(_OBJECTS) * grid.cells().angle.size

    @cached_property
    def plans(self) -> dict[str, Plan]:
        """Return the plans of laws with a base, by lookahead, path and slider."""
        plans: dict[str, Plan] = {}
        front = float(Robot().shell.half[0])
        for lookahead, (name, radius), slider in itertools.product(
            LOOKAHEADS, RADII.items(), _OBJECTS
        ):
            points = np.add(grid.curve(radius, LENGTH), (front, 0.0))
            task = {"kind": "path", "lookahead": lookahead, "waypoints": points.tolist()}
            domain = parse_domain(f"{_SLIDER},objects={_OBJECTS[slider]}", None, task)
            plans[f"{lookahead} {name} {slider}"] = Plan(
                domain, self.worlds, self.chosen, self.setting
            )
        return plans

    def answer(self, run: Run) -> xr.DataTree:
        """Push with a point, then with the base."""
        shapes = [len(RADII), len(_OBJECTS)]
        duration = LENGTH / float(grid.PARAMS.v_max)
        points = [
            run.checkpoint(
                part_name(POINT, name, slider),
                partial(grid.run_grid, "force_push", slider, duration=duration, radius=radius),
            )
            .stack(world=grid.DIMS)
            .reset_index("world", drop=True)
            for (name, radius), slider in itertools.product(RADII.items(), _OBJECTS)
        ]
        ours = list(run_plans(run, self.plans).values())
        trees = {"point": _arranged(points, shapes, ("path", "slider"))}
        shapes, dims = [len(LOOKAHEADS), *shapes], ("lookahead", "path", "slider")
        return xr.DataTree.from_dict(trees | {"base": _arranged(ours, shapes, dims)})

    def intro(self, results: xr.DataTree) -> str:
        """Describe the worlds."""
        return (
            f"Paths of {LENGTH:g} m: 3 m straight on, a quarter of a circle, straight on. "
            f"{self.worlds} starts of each slider, {grid.cells().angle.size} with a point. "
            "Intervals: Wilson 95 %; of errors bootstrap 95 %."
        )

    def report_tables(self, results: xr.DataTree) -> Sequence[Table]:
        """Return success and error by law, path and slider."""
        by_law = best_lookaheads(results)
        picture = Picture("paths", partial(figure_of, by_law))
        return [
            Table(
                table(by_law),
                name="force_push_paths",
                title="Success and error by path",
                merge="law",
                picture=picture,
            )
        ]


paths = call_of(Paths)


def _arranged(parts: Sequence[xr.Dataset], shape: Sequence[int], dims: Sequence[str]) -> xr.Dataset:
    """Return the outcomes of parts along some dimensions, the last one fastest."""
    names = ("success", "error_mean", "error_95")
    values = {name: np.stack([part[name].values for part in parts]) for name in names}
    rest = list(map(str, parts[0].success.dims))
    labels = {"lookahead": LOOKAHEADS, "path": list(RADII), "slider": list(_OBJECTS)}
    coords = {dim: list(labels[dim]) for dim in dims}
    if "law" in rest:
        coords["law"] = parts[0].law.values.tolist()
    return xr.Dataset(
        {name: ((*dims, *rest), x.reshape(*shape, *x.shape[1:])) for name, x in values.items()},
        coords,
    )


def best_lookaheads(results: xr.DataTree) -> dict[str, xr.Dataset]:
    """Return the outcomes (path, slider, world) by law, at the lookahead with more successes."""
    base = results["base"].to_dataset()
    rates = base.success.mean(["path", "slider", "world"])
    by_law = {POINT: results["point"].to_dataset()}
    for law in map(str, base.law.values):
        best = int(np.argmax(rates.sel(law=law).values))
        by_law[f"{law}, {LOOKAHEADS[best]:g} m"] = base.isel(lookahead=best).sel(law=law)
    return by_law


def median(values: np.ndarray) -> tuple[float, float, float]:
    """Return the median of finite values (n,), and its bootstrap 95 % interval."""
    values = values[np.isfinite(values)]
    if not values.size:
        return math.nan, math.nan, math.nan
    return median_interval(values, 500)


def table(by_law: Mapping[str, xr.Dataset]) -> Rows:
    """Return a header and a row per law and path: success, and errors [cm] by slider."""
    heads = [f"{slider}: {x}" for slider in _OBJECTS for x in ("success", "mean error [cm]")]
    rows = [["law", "turn", *heads]]
    for law, outcomes in by_law.items():
        for path in RADII:
            cells: list[str] = []
            for slider in _OBJECTS:
                trials = outcomes.sel(path=path, slider=slider)
                success = trials.success.values > 0
                cells.append(tables.rate(success))
                middle, low, high = median(100 * trials.error_mean.values)
                cells.append(f"{middle:.0f} [{low:.0f}, {high:.0f}]")
            rows.append([law, path, *cells])
    return rows


def figure_of(by_law: Mapping[str, xr.Dataset]) -> Figure:
    """Draw the error of each law against the curvature of the turn."""
    figure, axes = tiles(len(_OBJECTS), 2, (5, 3.6), (0, 0.4), sharex=True, sharey=True)
    curvature = [1 / radius for radius in RADII.values()]
    for ax, slider in zip(axes.ravel(), _OBJECTS, strict=True):
        for i, (law, outcomes) in enumerate(by_law.items()):
            errors = outcomes.error_mean.sel(slider=slider)
            middle, low, high = np.array([median(errors.sel(path=x).values) for x in RADII]).T
            ax.errorbar(
                np.add(curvature, 0.008 * i),
                middle,
                [middle - low, high - middle],
                color=f"C{i}",
                marker="o",
                ms=3,
                lw=1,
                label=law,
            )
        ax.set_title(slider, fontsize=9, loc="left")
        ax.set_xlabel("curvature of the turn [1/m]")
        ax.grid(alpha=0.3)
    axes.ravel()[0].set_ylabel("mean cross-track error [m]")
    figure.legend(
        *axes.ravel()[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=4,
        fontsize=8,
    )
    return figure
