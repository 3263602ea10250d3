"""Readings of what the paper leaves open, and ingredients of the paper's simulator.

All conditions run on the fused engine. The readings use steps of 5 ms with a converged solver, so
that no difference comes from the solver.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import xarray as xr
from scipy import stats

from rps_jax import Robot, Setting
from rps_jax.analysis import statistics
from rps_jax.physics import PHYSICS, Physics
from rps_jax.world import paper
from rps_jax.worlds import CapacitiveSkin
from sweeps.conditions import Condition

DEFAULT = "default"
_CONVERGED = replace(PHYSICS["default"]["standard"], timestep=0.005, iterations=30)
_GAZEBO = PHYSICS["paper_gazebo"]["standard"]
_CONE = replace(_GAZEBO, cone="elliptic")


def _setting(physics: Physics = _CONVERGED, **changes: Any) -> Setting:
    return Setting(physics=replace(physics, **changes), engine="fused")


def _params(label: str, **params: float) -> Condition:
    return Condition(label, _setting(), params=params)


def _case(label: str, **case: Any) -> Condition:
    return Condition(label, _setting(), case=case)


READINGS = {
    DEFAULT: Condition("the defaults", _setting()),
    "tangent_as_printed": _params("tangent as printed (gamma_max = inf)", gamma_max=math.inf),
    "gamma_max_1.4": _params("gamma_max 1.4 rad instead of 1.56", gamma_max=1.4),
    "gamma_max_1": _params("gamma_max 1 rad", gamma_max=1.0),
    "l_mr_5cm": _params("l_mr 0.05 m instead of 0.15", l_mr=0.05),
    "l_mr_10cm": _params("l_mr 0.10 m", l_mr=0.10),
    "l_mr_20cm": _params("l_mr 0.20 m", l_mr=0.20),
    "a_r_max_5": _params("a_r_max 5 instead of 10", a_r_max=5.0),
    "a_r_max_20": _params("a_r_max 20", a_r_max=20.0),
    "unsaturated": _params("omega from the unsaturated velocity", saturate_first=0.0),
    "saturate_first": _params("omega from the saturated velocity", saturate_first=1.0),
    "clip_each": _params("v_x and v_y clipped one by one", clip_each=1.0),
    "period_5ms": Condition("control period 5 ms instead of 20", _setting(control_period=0.005)),
    "period_10ms": Condition("control period 10 ms", _setting(control_period=0.01)),
    "period_50ms": Condition("control period 50 ms", _setting(control_period=0.05)),
    "period_100ms": Condition("control period 100 ms", _setting(control_period=0.1)),
    "drive_on_loss": _params("0.05 m/s instead of 0.01 after a loss", v_lost=0.05),
    "keep_on_loss": _params("last contact used after a loss", keep_contact=1.0),
    "base_98cm": _case("base 0.978 m long instead of 0.725", robot=Robot(half_length=0.489)),
    "base_58cm": _case("base 0.58 m long (square)", robot=Robot(half_length=0.29)),
    "capacitive": _case("capacitive skin of 42 taxels", skin=CapacitiveSkin()),
    "tolerance_10mm": _case("skin tolerance 10 mm instead of 6", skin="ideal,tolerance=0.01"),
    "tolerance_3mm": _case("skin tolerance 3 mm", skin="ideal,tolerance=0.003"),
    "tolerance_1mm": _case("skin tolerance 1 mm", skin="ideal,tolerance=0.001"),
    "rear_far": _case("load on the far left corner", rear="far"),
    "gap_0": _case("initial gap 0 instead of 2 cm", gap=0.0),
    "gap_10cm": _case("initial gap 10 cm", gap=0.10),
    "sgn_0": _params("sgn(0) = 1 instead of 0", sgn_0=1.0),
}

_THIN = {"skin": "ideal,tolerance=0.001"}


# Ingredients of Gazebo: all together, then one by one.
GAZEBO = {
    DEFAULT: Condition("the defaults at 1 ms", _setting(_CONE)),
    "paper_gazebo": Condition("`paper_gazebo`: pyramid, skin 1 mm", _setting(_GAZEBO), case=_THIN),
    "pyramid": Condition(
        "pyramid alone, skin 6 mm", _setting(_GAZEBO), case={"skin": "ideal,tolerance=0.006"}
    ),
    "thin": Condition("skin 1 mm alone, isotropic", _setting(_CONE), case=_THIN),
}


def cells(results: xr.Dataset) -> list[list[str]]:
    """Return a row for each cell of Table II: ours beside the paper's with its Wilson interval.

    The last column is the p of Fisher's exact test that both have the same rate.
    """
    success = results.sel(condition="paper_gazebo").success
    trials, in_paper = success.sizes["target"], len(paper.TARGETS)
    rows = [["cell", "ours", "paper", "95 % of the paper's", "inside", "Fisher p"]]
    coordinates = (success[dim].values for dim in ("law", "object", "friction"))
    for law, name, friction in itertools.product(*coordinates):
        ours = int(success.sel(law=law, object=name, friction=friction).sum())
        theirs = paper.TABLE_II[str(law), str(name), str(friction)]
        low, high = statistics.wilson(theirs, in_paper)
        table = [[ours, trials - ours], [theirs, in_paper - theirs]]
        rows.append(
            [
                f"{str(law).upper()} {name} {friction}",
                f"{ours} of {trials}",
                f"{theirs} of {in_paper}",
                f"{in_paper * low:.1f}-{in_paper * high:.1f}",
                "yes" if low <= ours / trials <= high else "no",
                f"{stats.fisher_exact(table).pvalue:.2g}",
            ]
        )
    return rows
