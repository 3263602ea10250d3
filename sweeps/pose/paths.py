"""Paths and rooms that end in a heading.

rps sweeps/pose/paths.py --worlds 300
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import pi
from typing import Any, ClassVar

import xarray as xr

from rps_jax import Setting
from rps_jax.questions import call_of, option
from rps_jax.trials.trial import Rules
from sweeps.pose.study import DIFFERENTIAL, OMNI, Case, Poses, pose_table
from sweeps.study_base import Table

_FREE = ",pose.v_free=0.2,pose.omega_free=0.5"
_BASES = {
    "omnidirectional": (OMNI, f"path_pose{_FREE}"),
    "differential": (DIFFERENTIAL, f"path_pose_drive{_FREE}"),
}
# A corridor 4 m wide that turns to the left; the goal looks along its second part.
_ROOM: dict[str, Any] = {
    "kind": "rooms",
    "outline": [[0, 0], [8, 0], [8, 9], [4, 9], [4, 4], [0, 4]],
    "start": [[2, 2, 0]],
    "goal": [[6, 7]],
    "heading": pi / 2,
    "base_radius": 1.3,
}
_WORLDS = {
    "paths, boxes": ("box", f"path,heading={-pi}:{pi}"),
    "paths, prisms": ("prism", f"path,heading={-pi}:{pi}"),
    "rooms, boxes": ("box", _ROOM),
}
CASES: dict[str, Case] = {
    f"{worlds} | {base} | 0.2 m/s": Case(f"wide,objects=random_{kind}", robot, law, task)
    for worlds, (kind, task) in _WORLDS.items()
    for base, (robot, law) in _BASES.items()
}


@dataclass(frozen=True)
class Paths(Poses):
    """Push objects along paths and through rooms to poses."""

    TITLE: ClassVar[str] = "Paths that end in a heading"
    ROWS: ClassVar = CASES
    CHOICES: ClassVar = {"cases": ROWS}

    cases: Sequence[str] = tuple(CASES)
    worlds: int = option(300, 2, 10_000_000)
    setting: Setting = field(
        default=Setting("fused", seed=718091, rules=Rules(horizon=600.0)), kw_only=True
    )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return success, times and errors of each row."""
        return [Table(pose_table(results), name="pose_paths", merge="worlds", title="Paths")]


paths = call_of(Paths)
