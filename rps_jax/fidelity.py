"""Is the physics right? The paper's trials at many settings of the solver, against C MuJoCo.

The reference is C MuJoCo run to convergence. Every row runs the same trials; what is compared is
the outcome, trial by trial, and the object's place after the first 5 s.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xarray as xr

from rps_jax import paper, study, sweep, trial
from rps_jax.scene import Physics, physics
from rps_jax.study import Condition, Grid
from rps_jax.sweep import Case, Progress, Setting
from rps_jax.trial import Rules

REFERENCE = "reference"
_EARLY = 5.0  # [s] after which the object's place is compared

_STANDARD = physics()
_FINE = replace(physics(fidelity="reference"), timestep=0.005)


def _c(what: str, **changes: Any) -> Condition:
    return Condition(what, Setting(physics=replace(_FINE, **changes), engine="mujoco"))


def _mjx(what: str, **changes: Any) -> Condition:
    return Condition(what, Setting(physics=replace(_STANDARD, **changes)))


def _fused(what: str, physics: Physics) -> Condition:
    return Condition(what, Setting(physics=physics, engine="fused"))


# C MuJoCo, converged: what the physics does to the outcome.
IN_C = {
    REFERENCE: _c("reference: C, 1 ms, elliptic", timestep=0.001),
    "c_2ms": _c("C, 2 ms", timestep=0.002),
    "c_5ms": _c("C, 5 ms"),
    "c_10ms": _c("C, 10 ms", timestep=0.01),
    "c_20ms": _c("C, 20 ms", timestep=0.02),
    "c_impratio_1": _c("C, 5 ms, impratio 1", impratio=1.0),
    "c_impratio_100": _c("C, 5 ms, impratio 100", impratio=100.0),
    "c_pyramidal": _c("C, 5 ms, pyramidal", cone="pyramidal"),
    "c_mujocos_ground": _c(
        "C, 5 ms, MuJoCo's own ground contact", ground_solref=(0.02, 1.0), ground_impedance=0.9
    ),
    # MuJoCo keeps time constants above two timesteps.
    "c_stiff": _c("C, 2 ms, skin contact 5 ms (solref)", timestep=0.002, base_solref=(0.005, 1.0)),
    "c_soft": _c("C, 5 ms, skin contact 60 ms (solref)", base_solref=(0.06, 1.0)),
    "c_period_5ms": _c("C, 5 ms, control period 5 ms", control_period=0.005),
    "c_period_50ms": _c("C, 5 ms, control period 50 ms", control_period=0.05),
    "c_drive_on_loss": replace(_c("C, 5 ms, 0.05 m/s after a loss"), params={"v_lost": 0.05}),
    "c_keep_on_loss": replace(
        _c("C, 5 ms, last contact kept on loss"), params={"keep_contact": 1.0}
    ),
}
# MJX in float32: what is lost by fewer iterations and longer steps.
IN_MJX = {
    "standard": Condition("MJX `standard`", Setting(physics=_STANDARD)),
    "fast": Condition("MJX `fast`", Setting(physics=physics(fidelity="fast"))),
    "mjx_5ms": _mjx("MJX, 5 ms, 8/10", timestep=0.005),
    "mjx_6_8": _mjx("MJX, 10 ms, 6/8", iterations=6, ls_iterations=8),
    "mjx_4_6": _mjx("MJX, 10 ms, 4/6", iterations=4, ls_iterations=6),
    "mjx_loose": _mjx("MJX, 10 ms, MuJoCo's own tolerance 1e-8", tolerance=1e-8),
    "mjx_mujocos_ground": _mjx(
        "MJX, 10 ms, MuJoCo's own ground contact", ground_solref=(0.02, 1.0), ground_impedance=0.9
    ),
    "mjx_pyramidal": Condition(
        "MJX `paper_gazebo`, its pyramid", Setting(physics=physics("paper_gazebo"))
    ),
}
# The same equations in `rps_jax.fused`, float32.
IN_FUSED = {
    "fused_standard": _fused("fused, `standard`", _STANDARD),
    "fused_fast": _fused("fused, `fast`", physics(fidelity="fast")),
    "fused_5ms": _fused("fused, 5 ms", replace(_STANDARD, timestep=0.005)),
    "fused_pyramidal": _fused(
        "fused, 5 ms, pyramidal", replace(_STANDARD, timestep=0.005, cone="pyramidal")
    ),
}
CONDITIONS = IN_C | IN_MJX | IN_FUSED
QUICK = (REFERENCE, "standard", "fused_standard", "fused_fast")


def run(
    names: tuple[str, ...],
    grid: Grid,
    folder: Path,
    *,
    report: Callable[[Progress], Any] = lambda progress: None,
    **shape: Any,
) -> xr.Dataset:
    """Outcomes under the named conditions, and `early_error` [m] (condition, object, ...).

    The early error is how far the object is, 5 s after the start, from where it is in the
    reference: for RPS alone.
    """
    chosen = {name: CONDITIONS[name] for name in names}
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


def table(results: xr.Dataset, costs: Mapping[str, float] | None = None) -> list[list[str]]:
    """Header and one row for each condition.

    `costs` [s] of wall clock for a simulated second of one world, by condition, on an idle
    device; without it, the cost while the trials ran is given.
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
        c = study.compare(base, one.success)
        low, high = c.equal_interval
        median, worst = np.quantile(one.early_error.values, (0.5, 0.95))
        cost = (costs or {}).get(name, float(one.run_time) / float(one.simulated))
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
            c = study.compare(base.sel(strategy=s), one.sel(strategy=s))
            low, high = c.equal_interval
            shares.append(f"{100 * c.equal:.1f} % ({100 * low:.0f}-{100 * high:.0f})")
        rows.append([str(results.what.sel(condition=name).values), *shares])
    return rows


def cost(setting: Setting, worlds: int, *, simulated: float = 2.0) -> dict[str, float]:
    """Wall clock [s] for a simulated second of one world, by family, on this device.

    A full batch of worlds is stepped in MJX while the boxes and cylinders are being pushed; the
    fastest of three goes.
    """
    costs = {}
    for name in ("box", "cylinder"):
        cases = [
            Case(name, study.FRICTION["S1"], paper.TARGETS[i % len(paper.TARGETS)])
            for i in range(worlds)
        ]
        stage, batch = sweep.build(cases, setting)
        batch = jax.device_put(batch)
        steps = round(simulated / setting.physics.control_period)
        go = partial(trial.advance, stage, batch, physics=setting.physics, steps=steps)
        state = go(trial.start_all(batch, np.ones(worlds, bool)))
        best = np.inf
        for _ in range(3):
            jax.block_until_ready(state)
            began = time.perf_counter()
            state = jax.block_until_ready(go(state))
            best = min(best, time.perf_counter() - began)
        costs[name] = best / (worlds * simulated)
    return costs
