"""Goals with a heading: the share of worlds in which touch alone delivers an object to a pose.

rps sweeps/pose --worlds 10000
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
import xarray as xr

from rps_jax import Setting
from rps_jax.analysis import tables
from rps_jax.questions import Plan, Run, call_of, option
from sweeps.study_base import PlanStudy, Rows, Table, TrialStudy, plan_of, run_plans

YAW, TIGHT, LOOSE = 0.1, 0.02, 0.05  # [rad], [m] tolerances of the table
FREE = ",v_free=0.2,omega_free=0.5"
OMNI, DIFFERENTIAL = "ideal", "ideal,drive=differential"
NOISE = "pose_noise=0.02:0.02,yaw_noise=0.03:0.03,velocity_error=-0.1:0.1"


_FAST = "omnidirectional | 0.2 m/s"
_POOL = (f"wide, boxes | {_FAST}", f"wide, prisms | {_FAST}")


class Case(NamedTuple):
    """Worlds, base, law and task of a row."""

    domain: str
    robot: str | None
    law: str
    task: str | Mapping[str, Any] = f"pose,d_success={LOOSE},yaw_success={YAW}"


CASES: dict[str, Case] = {
    "wide, boxes | omnidirectional | 0.2 m/s": Case("wide,objects=random_box", OMNI, f"pose{FREE}"),
    "wide, prisms | omnidirectional | 0.2 m/s": Case(
        "wide,objects=random_prism", OMNI, f"pose{FREE}"
    ),
    "wide, cylinders | omnidirectional | 0.2 m/s": Case(
        "wide,objects=random_cylinder", OMNI, f"pose{FREE}"
    ),
    "wide, boxes | omnidirectional | 0.05 m/s": Case("wide,objects=random_box", OMNI, "pose"),
    "wide, boxes | differential | 0.2 m/s": Case(
        "wide,objects=random_box", DIFFERENTIAL, f"pose_drive{FREE}"
    ),
    "real, boxes | omnidirectional | 0.2 m/s": Case("real,objects=random_box", None, f"pose{FREE}"),
    "hostile, boxes | omnidirectional | 0.2 m/s": Case(
        "hostile,objects=random_box", None, f"pose{FREE}"
    ),
    "wide, boxes, noise | omnidirectional | 0.2 m/s": Case(
        f"wide,objects=random_box,{NOISE}", OMNI, f"pose{FREE}"
    ),
}
OUTCOMES = (
    "time",
    "contact_lost_time",
    "place_error",
    "sideways_error",
    "heading_error",
    "face_width",
    "declared",
)
FRONT = 0.58  # [m] width of the base


@dataclass(frozen=True)
class Poses(PlanStudy[xr.Dataset], TrialStudy[xr.Dataset]):
    """Deliver objects of several domains to poses, with two bases and two free speeds.

    The results hold the outcomes (row, world).
    """

    TITLE: ClassVar[str] = "Goals with a heading"
    QUICK: ClassVar[Mapping[str, object]] = {"worlds": 32}
    ROWS: ClassVar[Mapping[str, Case]] = CASES
    CHOICES: ClassVar = {"cases": ROWS}

    cases: Sequence[str] = tuple(CASES)
    """Names of rows."""
    worlds: int = option(10000, 2, 10_000_000)
    """Number of worlds of each row."""
    setting: Setting = field(default=Setting("fused", seed=530417), kw_only=True)

    @cached_property
    def plans(self) -> dict[str, Plan]:
        """The sweep of each row."""
        cases = {name: self.ROWS[name] for name in self.cases}
        return {
            name: plan_of(x.law, x.domain, self.worlds, self.setting, x.robot, x.task)
            for name, x in cases.items()
        }

    def answer(self, run: Run) -> xr.Dataset:
        """Sweep each row."""
        parts = run_plans(run, self.plans)
        rows = [part[list(OUTCOMES)].isel(law=0, drop=True) for part in parts.values()]
        return xr.concat(rows, xr.IndexVariable("row", list(parts)), join="override")

    def intro(self, results: xr.Dataset) -> str:
        """Describe the worlds."""
        return (
            f"{self.worlds:,} worlds of each row, seed {self.setting.seed}; true face within {YAW} "
            "rad, judged when the law declares to be done. Intervals: Wilson 95 %."
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return success, times and errors of each row, and its failures by mechanism."""
        lost = float(self.setting.rules.max_lost)
        return [
            Table(pose_table(results), name="pose", merge="worlds", title="Poses"),
            Table(failure_table(results, lost), name="pose_failures", merge="worlds"),
        ]


poses = call_of(Poses)


def pose_table(results: xr.Dataset) -> Rows:
    """Return a header and a row for each case: success by tolerance, time and errors."""
    header = ["worlds", "base", "free speed", "5 cm", "2 cm", "narrow, 5 cm", "wide, 5 cm"]
    header = [*header, "median time", "without contact"]
    rows = [[*header, "sideways, median, 95 %", "heading, median, 95 %"]]
    parts = {row: results.sel(row=row) for row in map(str, results.row.values)}
    if set(_POOL) <= parts.keys():
        pool = xr.concat([parts[x] for x in _POOL], "world", coords="minimal", compat="override")
        parts = {f"wide, boxes and prisms | {_FAST}": pool} | parts
    for row, trials in parts.items():
        done, good = trials.declared.values > 0, trials.heading_error.values < YAW
        ends = [done & good & (trials.place_error.values < x) for x in (LOOSE, TIGHT)]
        is_wide, everywhere = trials.face_width.values > FRONT, np.ones(done.shape, bool)
        masks = [(ends[0], everywhere), (ends[1], everywhere)]
        masks += [(ends[0], ~is_wide), (ends[0], is_wide)]
        shares = [
            tables.share(int((x & m).sum()), int(m.sum())) if m.any() else "" for x, m in masks
        ]
        rows.append([*row.split(" | "), *shares, *_spreads(trials, done)])
    return rows


def _spreads(trials: xr.Dataset, done: np.ndarray) -> list[str]:
    """Return times and errors of the trials that the law has ended."""
    if not done.any():
        return ["--"] * 4
    times = [f"{np.median(trials[x].values[done]):.0f} s" for x in ("time", "contact_lost_time")]
    # A law may give up before its first touch.
    sideways = np.nanquantile(trials.sideways_error.values[done], (0.5, 0.95))
    heading = np.nanquantile(trials.heading_error.values[done], (0.5, 0.95))
    return [
        *times,
        " / ".join(f"{1e3 * x:.0f} mm" for x in sideways),
        " / ".join(f"{x:.4f} rad" for x in heading),
    ]


def failure_table(results: xr.Dataset, max_lost: float) -> Rows:
    """Return a header and a row for each case: failures at 5 cm by mechanism, in percent."""
    header = ["worlds", "base", "free speed", f"{max_lost:g} s without contact", "time is over"]
    rows = [[*header, "heading", "sideways", "along"]]
    for row in map(str, results.row.values):
        trials = results.sel(row=row)
        done, place = trials.declared.values > 0, trials.place_error.values
        lost = ~done & (trials.contact_lost_time.values > max_lost - 1)
        turned = done & ~(trials.heading_error.values < YAW)
        misses = done & ~turned & ~(place < LOOSE)
        sideways = misses & (trials.sideways_error.values > 0.7 * place)
        masks = (lost, ~done & ~lost, turned, sideways, misses & ~sideways)
        shares = (f"{100 * np.count_nonzero(x) / done.size:.2f} %" for x in masks)
        rows.append([*row.split(" | "), *shares])
    return rows
