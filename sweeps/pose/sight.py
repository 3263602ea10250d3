"""Success with sight beside touch, and the share of worlds that a planner solves.

rps sweeps/pose/sight.py --worlds 1000

Three controllers try the same worlds. `pose` feels. `sight` is the same law, but it sees the
outline of the object: it knows the box of Q1 to Q3 and the ends of each contact. The planner knows
the world: it tries the law with other parameters in it, and counts where any of these tries
succeeds. This share is a lower bound of that which any controller can solve.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import Robot, Setting, register_law
from rps_jax.analysis import tables
from rps_jax.laws import law_of, resolve_law
from rps_jax.questions import Plan, Run, call_of, option
from sweeps.pose.study import CASES, FRONT, LOOSE, TIGHT, YAW
from sweeps.study_base import PlanStudy, Rows, Table, TrialStudy, plan_of, run_plans

_ROWS = (
    "wide, boxes | omnidirectional | 0.2 m/s",
    "wide, prisms | omnidirectional | 0.2 m/s",
    "wide, boxes | differential | 0.2 m/s",
    "hostile, boxes | omnidirectional | 0.2 m/s",
)
_AHEAD = Robot().shell.half[0]  # [m] the paper's front, from the middle of its base
_FLUSH = 0.01  # [rad] between a flush face and the front
_SPREAD = 0.3  # share of the interval of a tuned parameter by which a try changes it, at most


# --- the law -------------------------------------------------------------------------------


class SightParams(NamedTuple):
    """Parameters of the law that sees the outline."""

    law: Any  # of `pose`

    @property
    def d_success(self) -> Any:
        """Distance to the target at which a trial succeeds [m]."""
        return self.law.d_success


def init(params: SightParams) -> Any:
    """Return the state of `pose`."""
    return law_of(params.law).init(params.law)


def step(params: SightParams, state: Any, obs: Any) -> Any:
    """Run `pose` with the true box, and with the true ends of the contact."""
    touch, corners = obs.touch, jnp.asarray(obs.corners)  # (N, 2)
    front = jnp.asarray(_AHEAD if touch.half_length is None else touch.half_length)
    theta = jnp.asarray(touch.yaw_target)
    grid = _unit(theta + jnp.arange(4) * (jnp.pi / 2))
    axes = _unit(touch.yaw + jnp.array([0.0, jnp.pi / 2]))
    away = touch.p_world_robot + corners @ axes - touch.p_world_target
    # The faces of this and of the last leg: a prism's outline may reach beyond their ends.
    met, last = (
        away[_face(corners, theta + leg * (jnp.pi / 2) - touch.yaw)[0]] for leg in (state.leg, 0)
    )
    ends = jnp.where(state.leg == 2, met, last) @ grid[1]
    h = jnp.max(away @ grid.T, axis=0)
    way = jnp.max(met @ grid[::2].T, axis=0)  # ahead and behind
    ahead, behind = jnp.where(state.leg % 2 == 1, way, h[::2])
    h = jnp.stack([ahead, jnp.max(ends), behind, -jnp.min(ends)])
    known = jnp.ones(4, bool)
    # Above the bound at which an uneven contact forgets the box.
    t_even = jnp.maximum(state.t_even, -0.5)
    state = state._replace(h=h, known=known, centred=known[:2], t_even=t_even)
    face, tilt = _face(corners, 0.0)
    sides, half = corners[face, 1], FRONT / 2
    ends = jnp.stack([jnp.max(sides), jnp.min(sides)])
    even = touch.in_contact & (tilt < _FLUSH)
    felt: Any = jnp.clip(ends, -half, half), (jnp.abs(ends) < half) & even, even, front
    observed = touch.with_ends(jnp.zeros(1, front.dtype), jnp.ones(1, bool), felt)
    return law_of(params.law).step(params.law, state, observed)


def _unit(angle: jax.Array) -> jax.Array:
    """Return unit vectors (..., 2) at angles [rad]."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def _face(corners: jax.Array, heading: Any) -> tuple[jax.Array, jax.Array]:
    """Return the two corners of the face that a push along a heading meets, and its tilt [rad]."""
    after = jnp.roll(jnp.arange(corners.shape[0]), -1)
    x, y = (corners[after] - corners).T
    tilt = jnp.abs((jnp.arctan2(x, -y) - heading + jnp.pi) % (2 * jnp.pi) - jnp.pi)
    tilt = jnp.where(x**2 + y**2 > 1e-8, tilt, jnp.inf)
    index = jnp.argmin(tilt)
    return jnp.stack([index, after[index]]), tilt[index]


_PARAMS = resolve_law("pose")[1]
_LAW: Any = law_of(_PARAMS)
_FORM = {"init": init, "step": step, "senses": "pose", "check": lambda params: params, "bounds": ()}
register_law(
    "_pose_sight",
    replace(_LAW, temperatures=None, observe_sent=None, **_FORM),
    SightParams(_PARAMS),
)


# --- the study -----------------------------------------------------------------------------


def changed(law: Any, count: int) -> dict[str, Any]:
    """Return laws with other values of the tuned parameters, by name."""
    random, tries = np.random.default_rng(72), {}
    for index in range(count):
        values = {}
        for name, (low, high, log, _) in law_of(law).bounds:
            scale, inverse = (np.log, np.exp) if log else (np.float64, float)
            value, share = max(getattr(law, name), 1e-6), _SPREAD * random.uniform()
            drawn = random.uniform(scale(low), scale(high))
            values[name] = float(inverse((1 - share) * scale(value) + share * drawn))
        tries[f"try {index}"] = law._replace(**values)
    return tries


@dataclass(frozen=True)
class Sight(PlanStudy[xr.Dataset], TrialStudy[xr.Dataset]):
    """Compare touch, sight and a planner in equal worlds.

    The results hold the outcomes (row, law, world).
    """

    TITLE: ClassVar[str] = "Poses by touch, by sight, and by a planner"
    QUICK: ClassVar[Mapping[str, object]] = {"worlds": 8, "tries": 2}
    CHOICES: ClassVar = {"cases": CASES}

    cases: Sequence[str] = _ROWS
    """Names of rows."""
    worlds: int = option(1000, 2, 1_000_000)
    """Number of worlds of each row."""
    tries: int = option(16, 1, 1000)
    """Number of laws that the planner tries in each world, beside `pose`."""
    setting: Setting = field(default=Setting("fused", seed=530417), kw_only=True)

    @cached_property
    def plans(self) -> dict[str, Plan]:
        """The sweep of each row."""
        plans = {}
        for name in self.cases:
            case = CASES[name]
            plan = plan_of(case.law, case.domain, self.worlds, self.setting, case.robot, "pose")
            (law,) = plan.laws.values()
            laws = {"touch": law, "sight": SightParams(law)} | changed(law, self.tries)
            plans[name] = replace(plan, laws=laws)
        return plans

    def answer(self, run: Run) -> xr.Dataset:
        """Sweep each row."""
        parts = run_plans(run, self.plans)
        names = ["place_error", "heading_error", "declared"]
        rows = [part[names] for part in parts.values()]
        return xr.concat(rows, xr.IndexVariable("row", list(parts)), join="override")

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return success of the controllers by row."""
        return [Table(sight_table(results), name="pose_sight", merge="worlds", title="Sight")]


sight = call_of(Sight)


def sight_table(results: xr.Dataset) -> Rows:
    """Return a header and a row for each case and tolerance: success of the controllers."""
    rows = [["worlds", "base", "within", "touch", "sight", "only sight", "only touch", "planner"]]
    done = (results.declared > 0) & (results.heading_error < YAW)
    for row in map(str, results.row.values):
        for limit in (LOOSE, TIGHT):
            good = (done & (results.place_error < limit)).sel(row=row)
            touch, seen = (good.sel(law=x).values for x in ("touch", "sight"))
            solved = good.drop_sel(law="sight").values.any(axis=0)
            touched, saw, planned = (
                tables.share(int(x.sum()), x.size) for x in (touch, seen, solved)
            )
            pair = f"{int((seen & ~touch).sum())}", f"{int((touch & ~seen).sum())}"
            base = row.split(" | ")[:2]
            rows.append([*base, f"{100 * limit:.0f} cm", touched, saw, *pair, planned])
    return rows
