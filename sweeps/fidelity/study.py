"""Is the physics right? The paper's trials at many settings of the solver, against C MuJoCo.

The reference is converged C MuJoCo. All rows run the same trials. Outcomes are compared trial by
trial, and positions of the object after the first 5 s.

    rps sweeps/fidelity --quick
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from rps_jax import Rules, Setting
from rps_jax.analysis import statistics
from rps_jax.physics import EngineName, Physics, preset
from rps_jax.questions import Run, call_of
from rps_jax.trials.progress import no_progress
from rps_jax.world import paper
from rps_jax.world.physics import MUJOCO_GROUND
from sweeps.conditions import Condition, ConditionStudy, Grid, run_conditions
from sweeps.study_base import Rows, Table

REFERENCE = "reference"
_EARLY = 5.0  # [s] after which the object's place is compared


def _condition(
    engine: EngineName, base: Physics, label: str, params: Mapping[str, float] = {}, **changes: Any
) -> Condition:
    return Condition(label, Setting(physics=replace(base, **changes), engine=engine), params)


_FAST = preset(fidelity="fast")
_c = partial(_condition, "mujoco", preset(fidelity="reference"))
_mjx = partial(_condition, "mjx", preset())
_fused = partial(_condition, "fused", preset())

# C MuJoCo, converged, at several steps.
IN_C = {
    REFERENCE: _c("reference: C, 1 ms, elliptic"),
    "c_2ms": _c("C, 2 ms", timestep=0.002),
    "c_5ms": _c("C, 5 ms", timestep=0.005),
    "c_10ms": _c("C, 10 ms", timestep=0.01),
    "c_20ms": _c("C, 20 ms", timestep=0.02),
}
# MJX in float32, whose cost grows with its iterations.
IN_MJX = {
    "standard": _mjx("MJX `standard`"),
    "fast": _condition("mjx", _FAST, "MJX `fast`"),
    "mjx_20ms_4_6": _mjx("MJX, 20 ms, 4/6", timestep=0.02, iterations=4, ls_iterations=6),
}
# The fused engine, in float32: first the defaults, then changes of the physics.
IN_FUSED = {
    "fused_standard": _fused("fused, `standard`"),
    "fused_fast": _condition("fused", _FAST, "fused, `fast`"),
    "fused_20ms_4_6": _fused("fused, 20 ms, 4/6", timestep=0.02, iterations=4, ls_iterations=6),
    "fused_5ms": _fused("fused, 5 ms", timestep=0.005),
    "impratio_1": _fused("fused, impratio 1", impratio=1.0),
    "impratio_100": _fused("fused, impratio 100", impratio=100.0),
    "mujocos_ground": _fused("fused, MuJoCo's own ground contact", **MUJOCO_GROUND),
    "soft": _fused("fused, skin contact 60 ms (solref)", base_solref=(0.06, 1.0)),
    "pyramid": _condition("fused", preset("paper_gazebo"), "fused, friction pyramid, 1 ms"),
    "period_5ms": _fused("fused, control period 5 ms", control_period=0.005, timestep=0.005),
    "period_10ms": _fused("fused, control period 10 ms", control_period=0.01),
    "period_50ms": _fused("fused, control period 50 ms", control_period=0.05),
    "drive_on_loss": _fused("fused, 0.05 m/s after a loss", {"v_lost": 0.05}),
    "keep_on_loss": _fused("fused, last contact kept on loss", {"keep_contact": 1.0}),
}
# Without inertia, in the plane.
QUASISTATIC = {
    "quasistatic": _condition("quasistatic", preset(), "quasi-static, 10 ms"),
    "quasistatic_20ms": _condition("quasistatic", preset(), "quasi-static, 20 ms", timestep=0.02),
}
CONDITIONS = IN_C | IN_MJX | IN_FUSED | QUASISTATIC
QUICK = (REFERENCE, "fused_standard", "fused_fast")


@dataclass(frozen=True)
class Fidelity(ConditionStudy):
    """Tell how finely the physics must be solved: the paper's trials against converged C MuJoCo.

    The answer holds outcomes (condition, law, object, friction, target), and `early_error` [m]: how
    far the object is, 5 s after the start, from where it is in the reference, for RPS alone.
    """

    TITLE = "Is the physics converged?"
    QUICK: ClassVar = {"conditions": QUICK, "targets": paper.FEW_TARGETS}
    CHOICES: ClassVar = {"conditions": CONDITIONS}
    GROWS = ("conditions",)

    conditions: tuple[str, ...] = tuple(CONDITIONS)
    """Names of the settings, the reference always among them; by default all."""

    @property
    def chosen(self) -> dict[str, Condition]:
        """Settings by name, the reference first."""
        return {name: CONDITIONS[name] for name in (REFERENCE, *self.conditions)}

    @property
    def grid(self) -> Grid:
        """Grid of the trials."""
        return Grid(laws=paper.LAWS, targets=self.targets)

    def answer(self, run: Run) -> xr.Dataset:
        """Run the settings that are missing, and the first seconds of RPS with each of them."""
        results = super().answer(run)
        short = {name: _early(condition) for name, condition in self.chosen.items()}
        of_rps = self.grid._replace(laws=("rps",))
        quiet = run._replace(folder=run.folder and run.folder / "early", callback=no_progress)
        early = run_conditions(short, of_rps, quiet)
        position = early.object_pose.sel(law="rps", pose=["x", "y"])
        squares = ((position - position.sel(condition=REFERENCE)) ** 2).sum("pose")
        results["early_error"] = np.sqrt(squares).drop_vars("law")
        return results

    def intro(self, results: xr.Dataset) -> str:
        """Describe the comparison."""
        return (
            f"{self.grid.size} trials in every row, compared one by one with those of C MuJoCo in "
            "steps of 1 ms."
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return equal outcomes, errors and costs of each setting."""
        return [Table(table(results), title="Settings of the solver against C MuJoCo")]


fidelity = call_of(Fidelity)


def _early(condition: Condition) -> Condition:
    setting = replace(condition.setting, rules=Rules(horizon=_EARLY))
    return replace(condition, setting=setting)


def table(results: xr.Dataset) -> Rows:
    """Return a header and one row per condition.

    The cost is wall clock for a simulated second of one world while the trials ran.
    """
    base = results.success.sel(condition=REFERENCE)
    rows = [
        ["setting", "equal outcomes", "95 %", "+/-", "McNemar p", "5 s error: median, 95 %", "cost"]
    ]
    for name in map(str, results.condition.values):
        condition = results.sel(condition=name)
        c = statistics.compare(base, condition.success)
        total = base.size
        equal = total - c.gained - c.lost
        low, high = statistics.wilson(equal, total)
        median, worst = 1000 * np.quantile(condition.early_error.values, (0.5, 0.95))
        cost = float(condition.run_time) / float(condition.simulated)
        rows.append(
            [
                str(condition.what.values),
                f"{100 * (equal / total):.1f} %",
                f"{100 * low:.0f}-{100 * high:.0f} %",
                c.changes,
                f"{c.p:.2g}",
                f"{median:.1f}, {worst:.1f} mm",
                f"{1000 * cost:.3g} ms",
            ]
        )
    return rows
