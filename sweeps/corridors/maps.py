"""Maps of real buildings: size, time to load and to plan, cost of a control step, and success.

    rps sweeps/corridors/maps.py --data maps --machine "2 cores of an AMD EPYC"

The folder has maps of ROS, each an image with a YAML file, as navigation2 and turtlebot3 publish
them. In each map the base starts where walls are farthest away and pushes to the farthest point
within `REACH` that it reaches with a clearance. Maps with less room are scaled.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import scipy
import xarray as xr

from rps_jax import InputError, Rules, Setting, errors, evaluate
from rps_jax.analysis import statistics
from rps_jax.questions import Run, call_of, option
from rps_jax.record.files import read_fields
from rps_jax.world.tasks.rooms import shades_of
from rps_jax.worlds import parse_domain
from sweeps.corridors.costs import cost_of, domain_of
from sweeps.study_base import Parts, SpeedStudy, Table, records, text_table

REACH = 10.0  # [m] between start and goal, at most
_ROOM = 0.85  # [m] from walls at the start and at the goal; paths keep 0.75 m
_SCALES = (1, 2, 3, 4)
_COLUMNS = {
    "map": "{map}",
    "cells": "{cells:,.0f}",
    "scale": "{scale:.0f}",
    "walls": "{walls:,.0f}",
    "load and plan": "{load:.2f} s",
    "plan": "{plan:.2f} s",
    "push": "{way:.1f} m",
    "control step, relative to reach": "{cost:.2f}",
    "success": "{success}",
}


@dataclass(frozen=True)
class Maps(SpeedStudy[xr.Dataset]):
    """Measure what maps of a folder cost, and how often a law pushes along a route in them.

    The results hold numbers of each map (map,).
    """

    TITLE = "Maps of real buildings"
    DIMENSION = "map"
    PRESETS: ClassVar = {"reach": REACH, "room": _ROOM, "scales": _SCALES}

    data: Path | str = ""
    """Folder of the maps, each an image with its YAML file."""
    law: str = "rps_tuned,sweeps/corridors/tuned.json"
    """Law that pushes."""
    domain: str = "wide"
    """Ranges of the other quantities."""
    worlds: int = option(200, 1, 1_000_000)
    """Number of worlds of each map."""
    rounds: int = option(3, 1, 1000)
    """Number of measurements of the cost; the first, with compilation, does not count."""

    def check(self) -> None:
        """Check that there are maps."""
        super().check()
        if not self.data or not sorted(Path(self.data).glob("*.yaml")):
            raise InputError(f"data = {self.data} has no maps: give a folder of YAML files.")

    def parts(self, run: Run) -> Parts:
        """Return the function that measures each map."""
        paths = sorted(Path(self.data).glob("*.yaml"))
        return {path.stem: partial(self._measured, path) for path in paths}

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the row of each map."""
        rows = []
        for row in records(results, "map"):
            rate, low, high = (
                100 * x for x in (row["rate"], *statistics.wilson(row["successes"], self.worlds))
            )
            rows.append(row | {"success": f"{rate:.1f} % [{low:.1f}, {high:.1f}]"})
        return [Table(text_table(_COLUMNS, rows), name="maps", title=self.TITLE)]

    def _measured(self, path: Path) -> xr.Dataset:
        """Return the numbers of a map."""
        scale, start, goal, cells = push_of(path)
        places = f"start={':'.join(map(str, start))},goal={':'.join(map(str, goal))}"
        begin = time.perf_counter()
        task = parse_domain("wide", None, f"rooms,{path},{places},scale={scale}:{scale}").task
        load = time.perf_counter() - begin
        begin = time.perf_counter()
        replace(task, goal=((goal[0] + 1e-3, goal[1]),))  # plans again, with the walls it has
        plan = time.perf_counter() - begin
        setting = Setting("fused", rules=Rules(horizon=600.0))
        scores = evaluate(
            self.law, self.domain, self.worlds, task=task, setting=setting, progress=False
        )
        successes = int((scores.success.values[0] > 0).sum())
        values = {
            "cells": cells,
            "scale": scale,
            "walls": len(getattr(task, "walls", ())) / 2,
            "load": load,
            "plan": plan,
            "way": scale * math.dist(start[:2], goal),
            "cost": self._cost(task),
            "rate": successes / self.worlds,
            "successes": successes,
        }
        return xr.Dataset({name: ((), float(x)) for name, x in values.items()})

    def _cost(self, task: Any) -> float:
        """Return the cost of a simulated second in a map, relative to `reach`."""
        boxes = "wide,objects=random_box"
        domains = domain_of("reach"), parse_domain(boxes, None, task)
        setting = Setting("fused", rules=Rules(horizon=10.0, max_lost=1e4))
        costs = [[cost_of(x, setting, self.worlds) for x in domains] for _ in range(self.rounds)]
        reach, rooms = np.min(costs[1:] or costs, axis=0)
        return rooms / reach


maps = call_of(Maps)


def push_of(path: Path) -> tuple[int, tuple[float, float, float], tuple[float, float], int]:
    """Return scale, start [m, m, rad] and goal [m] of a push in a map, and its number of cells."""
    fields, check = read_fields(path), errors.check_finite
    shades = shades_of(fields)
    occupied = shades if fields.get("negate") else 1 - shades
    # With the threshold of most maps, unknown cells are walls.
    free = occupied < min(check("free_thresh", fields.get("free_thresh", 0.196)), 0.196)
    resolution = check("resolution", fields.get("resolution"), at_least=1e-3, unit="m")
    origin = errors.check_array("origin", fields.get("origin", (0, 0, 0)), (3,))[:2]
    away = scipy.ndimage.distance_transform_edt(np.pad(free, 1))
    away = resolution * np.asarray(away)[1:-1, 1:-1]
    for scale in _SCALES:
        start = np.array(np.unravel_index(away.argmax(), away.shape))
        labels = np.asarray(scipy.ndimage.label(scale * away > _ROOM)[0])  # pyright: ignore
        same = np.argwhere((labels == labels[tuple(start)]) & (labels > 0))
        lengths = scale * resolution * np.linalg.norm(same - start, axis=1)
        lengths[lengths > REACH] = 0
        if lengths.max(initial=0) > REACH / 3:
            route = [(start + 0.5)[::-1], (same[lengths.argmax()] + 0.5)[::-1]]
            (x, y), (to_x, to_y) = (
                np.round(origin + resolution * end, 3).tolist() for end in route
            )
            return scale, (x, y, round(math.atan2(to_y - y, to_x - x), 3)), (to_x, to_y), free.size
    raise InputError(f"{path} has no room of {_ROOM} m around a way of {REACH / 3:.1f} m.")
