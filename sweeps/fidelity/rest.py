"""Does what nobody touches stay where it is? Random objects at rest in C MuJoCo, in several steps.

rps sweeps/fidelity/rest.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from rps_jax import Domain
from rps_jax.engines.mujoco import Batch
from rps_jax.physics import PHYSICS, Physics, get_engine, preset
from rps_jax.questions import Run, call_of, option
from rps_jax.trials.progress import Progress
from rps_jax.trials.worlds import starts
from rps_jax.world import points
from rps_jax.worlds import parse_domain
from sweeps.study_base import QuickStudy, Rows, Table

DOMAINS = ("wide", "hostile", "hostile,friction_ground=0.05:0.1,com_offset=0.5:0.7")
_AWAY = 5.0  # [m] stands the base
_FAR = 0.01  # [m] that objects at rest do not move, except while settling
STEPS: Mapping[str, Physics] = {
    **{f"{ms} ms": replace(preset(), timestep=ms / 1000) for ms in (2, 5, 10)},
    "20 ms (`fast`)": preset(fidelity="fast"),
}


@dataclass(frozen=True)
class Rest(QuickStudy[xr.Dataset]):
    """Leave random objects alone, and tell how far they have moved (domain, step, world) [m]."""

    TITLE = "Do objects at rest stay?"
    QUICK: ClassVar = {"worlds": 9, "seconds": 1.0}
    PRESETS: ClassVar = PHYSICS["default"]

    worlds: int = option(150, 3, 100_000)
    """Number of worlds of each domain."""
    seconds: float = option(5.0, 0.1, 300, unit="s")
    """How long they are left alone [s]."""
    seed: int = option(1, 0, 2**32 - 1)
    """Seed of the worlds."""

    def num_trials(self) -> int | None:
        """Return the number of worlds."""
        return len(DOMAINS) * len(STEPS) * self.worlds

    def answer(self, run: Run) -> xr.Dataset:
        """Step the worlds that are missing."""
        parts = []
        for i, step in product(range(len(DOMAINS)), STEPS):
            compute = partial(self._moved, parse_domain(DOMAINS[i]), STEPS[step])
            part = run.checkpoint(f"{i}-{STEPS[step].timestep:g}", compute)
            parts.append(part.expand_dims(domain=[DOMAINS[i]], step=[step]))
            run.callback(
                Progress(len(parts) * self.worlds, len(parts) * self.worlds * self.seconds)
            )
        whole: Any = xr.combine_by_coords(parts, combine_attrs="drop")
        return whole.sel(domain=list(DOMAINS), step=list(STEPS))

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the counts of moved objects, by domain, step and shape."""
        return [Table(table(results), merge="domain", name="rest", title="Objects that wander off")]

    def _moved(self, ranges: Domain, physics: Physics) -> xr.Dataset:
        index, c = np.arange(self.worlds), get_engine("mujoco")
        moved, family = np.zeros(self.worlds), np.empty(self.worlds, object)
        for i in range(len(ranges.objects)):
            rows = index[ranges.object_of(index) == i]
            drawn = points.draw(ranges, self.seed, None, rows)
            family[rows] = ranges.families[i]
            stage, _ = c.stage(drawn.inputs(ranges, physics))
            qpos = starts(drawn)
            qpos[:, 0] -= _AWAY
            batch = Batch(stage, qpos, 1)
            still = np.zeros((rows.size, 3))
            batch.drive(np.arange(rows.size), still, round(self.seconds / physics.timestep))
            moved[rows] = np.linalg.norm(batch.qpos[:, 3:5] - qpos[:, 3:5], axis=1)
            batch.close()
        return xr.Dataset({"moved": ("world", moved)}, {"family": ("world", family.astype(str))})

    def intro(self, results: xr.Dataset) -> str:
        """Describe the worlds."""
        return (
            f"How many of {self.worlds} random objects that nothing touches are more than "
            f"{100 * _FAR:g} cm away after {self.seconds:g} s, in C MuJoCo on the package's ground."
        )


rest = call_of(Rest)


def table(results: xr.Dataset) -> Rows:
    """Return a header and one row per domain and step."""
    families = list(dict.fromkeys(map(str, results.family.values)))
    rows = [["domain", "step", *(f"moved, {name}" for name in families), "the farthest"]]
    for domain, step in product(map(str, results.domain.values), map(str, results.step.values)):
        moved = results.moved.sel(domain=domain, step=step)
        by_family = [moved.values[results.family.values == name] for name in families]
        counts = [f"{int((x > _FAR).sum())} of {x.size}" for x in by_family]
        rows.append([f"`{domain}`", step, *counts, f"{100 * float(moved.max()):.1f} cm"])
    return rows
