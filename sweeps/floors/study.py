"""Success and time of laws on slopes and beyond changes of the floor, and a push against a step.

    rps sweeps/floors --quick

All floors have the same worlds: objects, targets, sensors and directions of the slope are equal.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

import mujoco
import numpy as np
import xarray as xr

from rps_jax import Setting
from rps_jax.analysis import statistics, tables
from rps_jax.laws import LawsLike
from rps_jax.physics import Physics
from rps_jax.questions import MultiLawQuestion, Plan, Run, call_of, option
from rps_jax.world.physics import MUJOCO_GROUND
from rps_jax.worlds import DomainLike, parse_domain
from sweeps.study_base import QuickStudy, Rows, Table, run_together

SLOPES = (0, 2, 4, 6)  # [deg]
FACTORS = (0.3, 0.5, 1, 2, 3)  # [1] of the friction beyond the boundary
# By name: greatest angle [deg] between the way to the target and the direction uphill.
DIRECTIONS = {"uphill": (0, 60), "across": (60, 120), "downhill": (120, 180)}
STEPS = (0.002, 0.005)  # [m]
EDGES = (0.0, 0.001, 0.004, 0.01)  # [m] radii of the feet; 0 is a box with sharp edges
GROUNDS = {"ground of this package": {}, "MuJoCo's ground": MUJOCO_GROUND}


@dataclass(frozen=True)
class Floors(QuickStudy[xr.DataTree], MultiLawQuestion[xr.DataTree]):
    """Measure what slopes and changes of the floor cost each law.

    The answer is a tree of outcomes: `slopes` (floor, law, world) and `boundaries` (floor, law,
    world), in the same worlds.
    """

    TITLE = "Pushing on slopes and over changes of the floor"
    QUICK: ClassVar = {"laws": ("rps", "rps_tuned"), "worlds": 12}
    PRESETS: ClassVar = {"slopes": list(SLOPES), "factors": list(FACTORS)}

    laws: LawsLike = ("rps", "rps_tuned", "rps_plus", "learned")
    domain: DomainLike = "wide"
    """Ranges from which worlds are drawn: paper, hardware, wide, real, prisms or hostile, or a JSON
    file of ranges; changes follow, as wide,mass=3:10."""
    worlds: int = option(3000, 2, 10_000_000)
    """Number of worlds of each floor."""
    setting: Setting = field(default=Setting("fused", seed=5207), kw_only=True)

    def check(self) -> None:
        """Check that the engine can step these worlds here."""
        super().check()
        self._plan("slope=0.1,boundary_factor=1").check_here()

    def num_trials(self) -> int | None:
        """Return the number of trials."""
        return len(self.chosen) * self.worlds * (len(SLOPES) + len(FACTORS))

    def answer(self, run: Run) -> xr.DataTree:
        """Run slopes, then boundaries half way to the target."""
        slopes = {f"{x}°": f"slope={math.radians(x)}" for x in SLOPES}
        factors = {f"{x:g}": f"boundary=0.5,boundary_factor={x}" for x in FACTORS}
        parts = {"slopes": slopes, "boundaries": factors}
        return xr.DataTree.from_dict(
            {
                name: run.checkpoint(name, partial(self._rows, floors, run))
                for name, floors in parts.items()
            }
        )

    def _plan(self, changes: str) -> Plan:
        """Return the plan of a floor, with changes of the domain."""
        domain = parse_domain(f"{self.domain},{changes}")
        return Plan(domain, self.worlds, self.chosen, self.setting)

    def _rows(self, floors: Mapping[str, str], run: Run) -> xr.Dataset:
        """Run several floors together."""
        parts = run_together([self._plan(changes) for changes in floors.values()], run)
        drawn = ["slope", "boundary", "boundary_factor"]
        parts = [part.drop_vars(drawn, errors="ignore") for part in parts]
        return xr.concat(parts, xr.IndexVariable("floor", list(floors)))

    def intro(self, results: xr.DataTree) -> str:
        """Describe the worlds."""
        return (
            f"{self.worlds:,} worlds, the same on all floors and for all laws. Intervals: Wilson "
            "95 %. Gains and losses are those of McNemar's test, world by world; p is not adjusted."
        )

    def report_tables(self, results: xr.DataTree) -> Sequence[Table]:
        """Return the costs of slopes and boundaries, and the pushes against steps."""
        slopes, boundaries = (results[name].to_dataset() for name in ("slopes", "boundaries"))
        angle = np.degrees(np.abs((slopes.slope_bearing - slopes.bearing).values))
        downhill = np.minimum(angle, 360 - angle)  # between the way and the direction of the fall
        masks = {
            name: (180 - downhill >= low) & (180 - downhill < high)
            for name, (low, high) in DIRECTIONS.items()
        }
        return [
            Table(
                cost_table(slopes, "0°", masks), name="floors_slopes", merge="floor", title="Slopes"
            ),
            Table(
                cost_table(boundaries, "1", {}),
                name="floors_boundaries",
                merge="floor",
                title="Changes of the floor half way to the target, by the factor of friction",
            ),
            Table(step_table(), name="floors_steps", merge="step", title="A push against a step"),
        ]


floors = call_of(Floors)


def cost_table(results: xr.Dataset, base: str, masks: Mapping[str, np.ndarray]) -> Rows:
    """Return a header and a row per floor and law: success, also of masked worlds, and times.

    The last columns compare with the floor `base`, world by world: gained and lost successes, and
    the median of the ratio of times in worlds with success on both.
    """
    against = f"against {base}"
    rows = [["floor", "law", "success", *masks, "median time", against, "time ratio"]]
    for floor in map(str, results.floor.values):
        for law in map(str, results.law.values):
            trials, level = (results.sel(law=law, floor=x) for x in (floor, base))
            success = trials.success.values > 0
            rates = [tables.rate(success[mask]) for mask in (success >= 0, *masks.values())]
            time = tables.median(trials.time.values[success], "{:.0f} s")
            compared = statistics.compare(level.success, trials.success)
            both = success & (level.success.values > 0)
            ratio = tables.median(trials.time.values[both] / level.time.values[both], "{:.2f}")
            change = f"{compared.changes}, p = {compared.p:.2g}"
            cells = ["", ""] if floor == base else [change, ratio]
            rows.append([floor, law, *rates, time, *cells])
    return rows


# --- steps -----------------------------------------------------------------------------------


def push_against_step(height: float, radius: float, physics: Physics) -> tuple[str, float]:
    """Push a box of 20 kg against a step in C MuJoCo at 5 cm/s for 10 s.

    Args:
      height: of the step [m].
      radius: of four feet [m]; 0 for a box with sharp edges.
      physics: softness of the contacts with ground and step.

    Returns:
      What happens, and the greatest force of the base [N].
    """
    low = radius - 0.4
    at = 0.2 - radius
    touching = [f"foot_{i}" for i in range(4)] if radius else ["object"]
    feet = [
        f'<geom name="foot_{i}" type="sphere" size="{radius or 1e-6}" mass="0" '
        f'pos="{x * at} {y * at} {low}"/>'
        for i, (x, y) in enumerate([(1, 1), (1, -1), (-1, 1), (-1, -1)])
    ]
    solref, impedance = " ".join(map(str, physics.ground_solref)), physics.ground_impedance
    pairs = [
        f'<pair geom1="{other}" geom2="{name}" condim="3" friction="0.3 0.3 0.005 0.0001 0.0001" '
        f'solref="{solref}" solimp="{impedance} {impedance}"/>'
        for other in ("ground", "step")
        for name in touching
    ]
    model = mujoco.MjModel.from_xml_string(f"""
    <mujoco>
      <option timestep="0.001" cone="elliptic" impratio="10" iterations="100" tolerance="1e-15"/>
      <default><geom contype="0" conaffinity="0"/></default>
      <worldbody>
        <geom name="ground" type="plane" size="9 9 1"/>
        <geom name="step" type="box" size="2 2 0.05" pos="2.85 0 {height - 0.05}"/>
        <body name="base" pos="0 0 0.2">
          <joint type="slide" axis="1 0 0" armature="1e6"/>
          <geom name="base" type="box" size="0.3625 0.29 0.14" mass="130"/>
        </body>
        <body name="object" pos="0.5625 0 0.4">
          <freejoint/>
          <geom name="object" type="box" size="0.2 0.2 0.4" mass="20"/>
          {"".join(feet)}
        </body>
      </worldbody>
      <contact>
        <pair geom1="base" geom2="object" condim="3" friction="0.35 0.35 0.005 0.0001 0.0001"/>
        {"".join(pairs)}
      </contact>
    </mujoco>""")
    data, force = mujoco.MjData(model), 0.0
    for _ in range(10_000):
        data.qvel[0] = 0.05
        mujoco.mj_step(model, data)
        force = max(force, -float(data.qfrc_constraint[0]))
        if data.body("object").xmat[8] < math.cos(math.pi / 4):
            return "falls over", force
    rise = data.body("object").xpos[2] - 0.4
    return ("climbs" if rise > height / 2 else "sinks into the step"), force


def step_table() -> Rows:
    """Return a header and a row per step and edge: what happens, and the greatest force."""
    rows = [["step", "edge of the box", *GROUNDS]]
    for height in STEPS:
        for radius in EDGES:
            edge = f"rounded, {1000 * radius:g} mm" if radius else "sharp"
            pushes = [
                push_against_step(height, radius, Physics(**ground)) for ground in GROUNDS.values()
            ]
            cells = [f"{text}, {force:.0f} N" for text, force in pushes]
            rows.append([f"{1000 * height:g} mm", edge, *cells])
    return rows
