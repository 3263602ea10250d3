"""Is the physics right? The paper's trials at many settings of the solver, against C MuJoCo.

The reference is C MuJoCo run to convergence. Every row runs the same trials; what is compared is
the outcome, trial by trial, and the object's place after the first 5 s.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from rps_jax.analysis import statistics
from rps_jax.engines import EngineName
from rps_jax.studies import study
from rps_jax.studies.study import Condition, Grid
from rps_jax.trials.setting import Report, Setting, unheard
from rps_jax.trials.trial import Rules
from rps_jax.world.physics import MUJOCOS_GROUND, Physics, preset

REFERENCE = "reference"
_EARLY = 5.0  # [s] after which the object's place is compared


def _condition(engine: EngineName, base: Physics, what: str, **changes: Any) -> Condition:
    return Condition(what, Setting(physics=replace(base, **changes), engine=engine))


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
    "fast": Condition("MJX `fast`", Setting(physics=preset(fidelity="fast"))),
    "mjx_20ms_4_6": _mjx("MJX, 20 ms, 4/6", timestep=0.02, iterations=4, ls_iterations=6),
}
# The same equations in the fused engine, float32: first as they are, then what the physics does.
IN_FUSED = {
    "fused_standard": _fused("fused, `standard`"),
    "fused_fast": Condition(
        "fused, `fast`", Setting(physics=preset(fidelity="fast"), engine="fused")
    ),
    "fused_20ms_4_6": _fused("fused, 20 ms, 4/6", timestep=0.02, iterations=4, ls_iterations=6),
    "fused_5ms": _fused("fused, 5 ms", timestep=0.005),
    "impratio_1": _fused("fused, impratio 1", impratio=1.0),
    "impratio_100": _fused("fused, impratio 100", impratio=100.0),
    "mujocos_ground": _fused("fused, MuJoCo's own ground contact", **MUJOCOS_GROUND),
    "soft": _fused("fused, skin contact 60 ms (solref)", base_solref=(0.06, 1.0)),
    "pyramid": _condition("fused", preset("paper_gazebo"), "fused, friction pyramid, 1 ms"),
    "period_5ms": _fused("fused, control period 5 ms", control_period=0.005, timestep=0.005),
    "period_10ms": _fused("fused, control period 10 ms", control_period=0.01),
    "period_50ms": _fused("fused, control period 50 ms", control_period=0.05),
    "drive_on_loss": replace(_fused("fused, 0.05 m/s after a loss"), params={"v_lost": 0.05}),
    "keep_on_loss": replace(
        _fused("fused, last contact kept on loss"), params={"keep_contact": 1.0}
    ),
}
# Without inertia, in the plane.
QUASISTATIC = {
    "quasistatic": _condition("quasistatic", preset(), "quasi-static, 10 ms"),
    "quasistatic_20ms": _condition("quasistatic", preset(), "quasi-static, 20 ms", timestep=0.02),
}
CONDITIONS = IN_C | IN_MJX | IN_FUSED | QUASISTATIC  # which every machine can run
# On an NVIDIA GPU alone; a cylinder touches the base itself, not through a capsule.
IN_WARP = {
    "warp_standard": _condition("warp", preset(), "MJX-Warp `standard`"),
    "warp_fast": _condition("warp", preset(fidelity="fast"), "MJX-Warp `fast`"),
}
QUICK = (REFERENCE, "fused_standard", "fused_fast")


def run(
    names: tuple[str, ...],
    grid: Grid,
    folder: Path,
    *,
    report: Report = unheard,
    **shape: Any,
) -> xr.Dataset:
    """Outcomes under the named conditions, and `early_error` [m] (condition, object, ...).

    The early error is how far the object is, 5 s after the start, from where it is in the
    reference: for RPS alone.
    """
    chosen = {name: (CONDITIONS | IN_WARP)[name] for name in names}
    results = study.run(chosen, grid, folder, **shape, report=report)
    early_folder = folder / "early"
    early_folder.mkdir(exist_ok=True)
    early = study.run(
        {name: _early(condition) for name, condition in chosen.items()},
        grid._replace(strategies=("rps",)),
        early_folder,
        **shape,
    )
    place = early.object_pose.sel(strategy="rps", pose=["x", "y"])
    results["early_error"] = np.sqrt(
        ((place - place.sel(condition=REFERENCE)) ** 2).sum("pose")
    ).drop_vars("strategy")
    return results


def _early(condition: Condition) -> Condition:
    setting = replace(condition.setting, rules=Rules(horizon=_EARLY))
    return replace(condition, setting=setting)


def table(results: xr.Dataset) -> list[list[str]]:
    """Header and one row for each condition.

    The cost is wall clock for a simulated second of one world while the trials ran.
    """
    base = results.success.sel(condition=REFERENCE)
    objects = [str(o) for o in results.object.values]
    strategies = [str(s) for s in results.strategy.values]
    header = ["setting", *(f"{s.upper()} {o}" for s in strategies for o in objects)]
    header += ["equal outcomes", "95 %", "+/-", "McNemar p", "5 s error: median, 95 %", "cost"]
    rows = [header]
    for name in map(str, results.condition.values):
        one = results.sel(condition=name)
        counts = one.success.sum(("friction", "target"))
        c = statistics.compare(base, one.success)
        low, high = c.equal_interval
        median, worst = np.quantile(one.early_error.values, (0.5, 0.95))
        cost = float(one.run_time) / float(one.simulated)
        rows.append(
            [
                str(one.what.values),
                *(str(int(counts.sel(strategy=s, object=o))) for s in strategies for o in objects),
                f"{100 * c.equal:.1f} %",
                f"{100 * low:.0f}-{100 * high:.0f} %",
                f"+{c.gained} -{c.lost}",
                f"{c.p:.2g}",
                f"{1000 * median:.1f}, {1000 * worst:.1f} mm",
                f"{1000 * cost:.3g} ms",
            ]
        )
    return rows


def by_strategy(results: xr.Dataset) -> list[list[str]]:
    """Header and one row for each condition: share of equal outcomes for each strategy."""
    base = results.success.sel(condition=REFERENCE)
    strategies = [str(s) for s in results.strategy.values]
    rows = [["setting", *(s.upper() for s in strategies)]]
    for name in map(str, results.condition.values):
        one = results.success.sel(condition=name)
        shares = []
        for s in strategies:
            c = statistics.compare(base.sel(strategy=s), one.sel(strategy=s))
            low, high = c.equal_interval
            shares.append(f"{100 * c.equal:.1f} % ({100 * low:.0f}-{100 * high:.0f})")
        rows.append([str(results.what.sel(condition=name).values), *shares])
    return rows
