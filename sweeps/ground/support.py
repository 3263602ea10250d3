"""How much do results depend on the pressure under objects?

rps sweeps/ground/support.py --machine "2 cores of an AMD EPYC"
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np
import xarray as xr

import rps_jax
from rps_jax import Range, Setting
from rps_jax.analysis import statistics
from rps_jax.questions import Run, call_of, option
from rps_jax.world import paper
from rps_jax.worlds import parse_domain
from sweeps.study_base import Parts, QuickStudy, Table, records, text_table

SUPPORTS = ("corners", "even", "rim")
LAWS = ("rps", "rps_tuned", "rps_plus")
# Shares of v_x, v_y and omega that the base loses: those of the robot `slipping`, and one for all.
SLIPS = {"as shipped": None, "13 % of each": 0.13}
FRICTIONS = (0.35, 0.5, 0.9, 1.2)  # object-robot
_SLIPS = ("slip", "slip_sideways", "slip_yaw")


@dataclass(frozen=True)
class Support(QuickStudy[xr.Dataset]):
    """Run laws in random worlds, and the hardware's objects, on each support.

    The answer has `success` (part, law) [1] with `low` and `high` of `wide`, and `D` [m] and `time`
    [s] (part, object) of the hardware's objects.
    """

    TITLE = "Pressure under objects"
    QUICK: ClassVar = {"worlds": 6, "hardware": 16}

    worlds: int = option(200, 3, 100_000)
    """Number of random worlds."""
    hardware: int = option(32, 16, 1024)
    """Number of pushes of the hardware's objects for each support, slip and friction."""

    def parts(self, run: Run) -> Parts:
        """Return the functions that run each part."""
        wide = {f"wide {kind}": partial(self._wide, kind) for kind in SUPPORTS}
        pairs = [(k, s, mu) for k in SUPPORTS[:2] for s in SLIPS for mu in FRICTIONS]
        return wide | {f"{k}, {s}, {mu}": partial(self._hardware, k, s, mu) for k, s, mu in pairs}

    DIMENSION = "part"

    def _wide(self, kind: str) -> xr.Dataset:
        setting = Setting(physics=f"default,support={kind}")
        results = rps_jax.sweep(list(LAWS), "wide", self.worlds, setting=setting)
        won = results.success.sum("world").values
        low, high = np.array([statistics.wilson(int(x), self.worlds) for x in won]).T
        columns = {"success": won / self.worlds, "low": low, "high": high}
        return _padded({k: ("law", x) for k, x in columns.items()}, kind)

    def _hardware(self, kind: str, slip: str, mu: float) -> xr.Dataset:
        lost = SLIPS[slip]
        setting = Setting(physics=f"default,support={kind}")
        domain = replace(
            parse_domain("hardware"),
            targets=paper.HARDWARE_LAYOUTS["circle"],
            friction_robot=Range(mu, mu),
            lateral=Range(-0.03, 0.03),  # by hand, within 3 cm and 3 degrees
            yaw=Range(-0.0524, 0.0524),
        )
        robot = "slipping" if lost is None else f"ideal,{','.join(f'{x}={lost}' for x in _SLIPS)}"
        results = rps_jax.sweep("rps", domain, self.hardware, robot=robot, setting=setting)
        results = results.isel(law=0).where(results.success.isel(law=0))
        # Worlds cycle through the eight targets, then the objects.
        objects = np.arange(self.hardware) // len(domain.targets) % 2
        by = {
            name: ("object", [float(results[column][objects == i].mean()) for i in (0, 1)])
            for name, column in (("D", "mean_abs_l"), ("time", "time"))
        }
        return _padded(by, kind).assign(slip=slip, friction=mu)

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return success in random worlds, and the hardware's numbers."""
        wide = results.isel(part=[str(x).startswith("wide") for x in results.part.values])
        rest = results.isel(part=[not str(x).startswith("wide") for x in results.part.values])
        return [
            Table(
                text_table(_WIDE, records(wide, "part", "law")), merge="pressure", name="support"
            ),
            Table(
                text_table(_HARDWARE, records(rest, "part", "object")),
                merge="pressure",
                name="support_hardware",
            ),
        ]


support = call_of(Support)

_WIDE = {
    "pressure": "{kind}",
    "law": "{law}",
    "success": "{success:.1%}",
    "95 % interval": "[{low:.1%}, {high:.1%}]",
}
_HARDWARE = {
    "pressure": "{kind}",
    "slip": "{slip}",
    "friction object-robot": "{friction}",
    "object": "{object}",
    "D": "{D:.3f} m",
    "time": "{time:.0f} s",
}


def _table(name: str, columns: dict[str, str], results: xr.Dataset, dim: str) -> Table:
    return Table(text_table(columns, records(results, "part", dim)), merge="pressure", name=name)


def _padded(columns: dict, kind: str) -> xr.Dataset:
    """Return one part, with empty columns of the other kind of part."""
    empty = {
        **{x: ("law", np.full(len(LAWS), np.nan)) for x in ("success", "low", "high")},
        **{x: ("object", np.full(2, np.nan)) for x in ("D", "time")},
        "slip": "",
        "friction": np.nan,
    }
    coords = {"law": list(LAWS), "object": ["box", "cylinder"]}
    return xr.Dataset(empty | columns | {"kind": kind}, coords)
