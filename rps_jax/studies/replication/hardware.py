"""The paper's hardware experiments (Sec. III-C), simulated: two objects, eight targets, and the
shove of its video. Friction was never measured, so a plausible range is run.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from rps_jax.analysis import statistics
from rps_jax.robot.skin import SKINS
from rps_jax.trials import pushes
from rps_jax.trials.pushes import Case
from rps_jax.trials.results import outcome_dataset, trace_dataset
from rps_jax.trials.setting import Report, Setting, unheard
from rps_jax.trials.trial import Shift
from rps_jax.world.paper import (
    HARDWARE_GROUND,
    HARDWARE_LAYOUTS,
    HARDWARE_OBJECTS,
    HARDWARE_RESULTS,
    HARDWARE_ROBOT,
)
from rps_jax.world.scene import Friction

MIDDLE = Friction(0.35, 0.5)  # of which the paths are drawn
SKIN = SKINS["hardware"]
SHIFT_TIME = 30.0  # [s] when the object is shifted
SHIFTS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4)  # [m] to either side of the robot


def _label(friction: Friction) -> str:
    return f"{friction.ground:g},{friction.robot:g}"


def frictions() -> dict[str, Friction]:
    """The range of friction, labelled ground,robot."""
    return {_label(f): f for f in (Friction(g, r) for g in HARDWARE_GROUND for r in HARDWARE_ROBOT)}


def run(
    base: Case,
    setting: Setting,
    *,
    layout: str = "circle",
    report: Report = unheard,
    **shape: Any,
) -> xr.Dataset:
    """Outcomes (strategy, object, friction, target) over objects, friction and targets.

    `base` gives whatever else the cases have in common: skin, gap, parameters.
    """
    targets = HARDWARE_LAYOUTS[layout]
    cases = [
        replace(base, object=name, friction=friction, p_world_target=target)
        for name in HARDWARE_OBJECTS
        for friction in frictions().values()
        for target in targets
    ]
    outcome, _ = pushes.run(cases, setting, report=report, **shape)
    return outcome_dataset(outcome, ["rps"], HARDWARE_OBJECTS, tuple(frictions()), targets)


def paths(base: Case, setting: Setting, *, layout: str = "circle") -> dict[str, list[xr.Dataset]]:
    """Fig. 7: the traces of every object to every target, at the middle of the friction range."""
    return {
        name: [
            trace_dataset(trace)
            for trace in pushes.follow(
                [
                    replace(base, object=name, friction=MIDDLE, p_world_target=target)
                    for target in HARDWARE_LAYOUTS[layout]
                ],
                setting,
                interval=0.5,
            )
        ]
        for name in HARDWARE_OBJECTS
    }


def disturb(
    base: Case,
    setting: Setting,
    *,
    layout: str = "circle",
    shifts: tuple[float, ...] = SHIFTS,
    report: Report = unheard,
    **shape: Any,
) -> xr.Dataset:
    """Success (object, shift, side, target) when the object is moved along the front of the robot.

    It is moved at once, `SHIFT_TIME` after the start, to the left and to the right.
    """
    sides = (1.0, -1.0)
    targets = HARDWARE_LAYOUTS[layout]
    cases = [
        replace(
            base,
            object=name,
            friction=MIDDLE,
            p_world_target=target,
            shift=Shift(SHIFT_TIME, (0.0, side * size)),
        )
        for name in HARDWARE_OBJECTS
        for size in shifts
        for side in sides
        for target in targets
    ]
    outcome, _ = pushes.run(cases, setting, report=report, **shape)
    sizes = (len(HARDWARE_OBJECTS), len(shifts), len(sides), len(targets))
    dims = ("object", "shift", "side", "target")
    # A trial that had ended before the object was to be moved tells nothing.
    counted = outcome.time > SHIFT_TIME
    return xr.Dataset(
        {
            "success": (dims, outcome.success.astype(np.int8).reshape(sizes)),
            "counted": (dims, counted.astype(np.int8).reshape(sizes)),
            "time": (dims, outcome.time.reshape(sizes), {"units": "s"}),
        },
        coords={
            "object": list(HARDWARE_OBJECTS),
            "shift": ("shift", list(shifts), {"units": "m"}),
            "side": ["left", "right"],
        },
    )


def table(results: xr.Dataset) -> list[list[str]]:
    """Header and one row for each object: success, D and time beside the paper's."""
    rows = [["object", "success", "95 %", "paper", "D", "paper", "time", "paper"]]
    for name in map(str, results.object.values):
        one = results.sel(strategy="rps", object=name)
        won = one.success.values.astype(bool)
        low, high = statistics.wilson(int(won.sum()), won.size)
        theirs = HARDWARE_RESULTS[name]
        rows.append(
            [
                name,
                f"{won.sum()} of {won.size}",
                f"{100 * low:.0f}-{100 * high:.0f} %",
                f"{theirs.success} of 8",
                _spread(one.mean_abs_l.where(won), 3, "m"),
                f"{theirs.mean_abs_l:.3f} m",
                _spread(one.time.where(won), 0, "s"),
                f"{theirs.time:.0f} s",
            ]
        )
    return rows


def _spread(values: xr.DataArray, digits: int, unit: str) -> str:
    """Mean over targets of the successes: over all friction, then its least and greatest."""
    if not values.notnull().any():
        return "-"
    each = values.mean("target")
    low, high = float(each.min()), float(each.max())
    return (
        f"{float(values.mean()):.{digits}f} {unit} (by friction {low:.{digits}f}-{high:.{digits}f})"
    )


def shift_table(results: xr.Dataset) -> list[list[str]]:
    """Header and one row for each size of shift: successes of those still under way."""
    rows = [["shift", *(str(o) for o in results.object.values)]]
    found = recovered(results)
    for size in found["shift"].values:
        cells = []
        for name in found.object.values:
            one = found.sel(object=name, shift=size)
            won, of = int(one.won), int(one.of)
            low, high = statistics.wilson(won, of)
            cells.append(f"{won} of {of} ({100 * low:.0f}-{100 * high:.0f} %)")
        rows.append([f"{100 * float(size):g} cm", *cells])
    return rows


def recovered(results: xr.Dataset) -> xr.Dataset:
    """Trials under way when the object was shifted, (object, shift): those `won`, `of` all."""
    counted = results.counted > 0
    both = ("side", "target")
    return xr.Dataset({"won": (counted & (results.success > 0)).sum(both), "of": counted.sum(both)})
