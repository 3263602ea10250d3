"""What a robot's limits cost a law: force, lag, acceleration, the base's size, the skin's pitch.

Every robot meets the same worlds as the ideal base, so that a loss is a paired difference. Force,
lag and acceleration are drawn, a different one for each world; sizes and pitches are taken in turn.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from scipy import optimize

from rps_jax import errors
from rps_jax.analysis import tables
from rps_jax.control.strategies import Params
from rps_jax.geometry.solid import GRAVITY
from rps_jax.robot.robot import Robot
from rps_jax.robot.shell import BOARDS, HALF_WIDTH
from rps_jax.runs import sweep as sweeps
from rps_jax.trials import pushes
from rps_jax.trials.conditions import Conditions
from rps_jax.trials.setting import InTurn, Report, unheard
from rps_jax.trials.trial import Rules
from rps_jax.world.domain import Domain, Range, named

LOSSES = (0.01, 0.10)  # [1] of success, whose limits are looked for
_RESAMPLES = 200  # of a bootstrap
_IDEAL = "ideal"  # name of the part of a run folder that holds the ideal base


@dataclass(frozen=True)
class Limit:
    """One quantity that is varied."""

    what: str  # with its unit
    drawn: Mapping[str, Range] = field(default_factory=dict)  # ranges of a domain
    robots: Mapping[float, Robot] = field(default_factory=dict)  # or each value's robot
    value: Callable[[xr.Dataset], np.ndarray] = lambda found: np.zeros(0)  # (n,) of drawn worlds
    harms: int = 0  # 1: the more the worse, -1: the less the worse, 0: neither
    log: bool = False


def _with_front(count: int) -> Robot:
    """The paper's base with so many boards across its front, and as many for its sides."""
    return Robot(
        boards=tuple(replace(row, count=math.ceil(row.count * count / 4)) for row in BOARDS)
    )


LIMITS = {
    "force": Limit(
        "greatest force over the object's friction with the ground [1]",
        {"robot_force": Range(10, 1000, log=True)},
        value=lambda f: (f.robot_force / (f.friction_ground * f.mass * GRAVITY)).values,
        harms=-1,
        log=True,
    ),
    "lag": Limit(
        "lag [s]", {"robot_lag": Range(0, 2)}, value=lambda f: f.robot_lag.values, harms=1
    ),
    "acceleration": Limit(
        "greatest acceleration [m/s²]",
        {"robot_acceleration": Range(0.005, 1, log=True)},
        value=lambda f: f.robot_acceleration.values,
        harms=-1,
        log=True,
    ),
    "half_width": Limit(
        "half width of the base [m]",
        robots={half: Robot(half_width=half) for half in (0.15, 0.2, 0.25, HALF_WIDTH, 0.35, 0.45)},
    ),
    "pitch": Limit(
        "pitch of the taxels of the front [mm]",
        robots={1e3 * 2 * HALF_WIDTH / (3 * n): _with_front(n) for n in (8, 4, 3, 2, 1)},
        harms=1,
    ),
}


def count(names: Sequence[str], arms: int, worlds: int) -> int:
    """How many trials `run` runs."""
    return arms * worlds * (1 + sum(max(1, len(LIMITS[name].robots)) for name in names))


def run(
    names: Sequence[str],
    arms: Mapping[str, Params],
    worlds: int = 1000,
    seed: int = 0,
    out: Path | None = None,
    *,
    domain: Domain | str = "wide",
    rules: Rules = Rules(),
    report: Report = unheard,
    **shape: Any,
) -> dict[str, xr.Dataset]:
    """Each limit by its name: success with it and with the ideal base, `usual`, (arm, case).

    Args:
      names: of `LIMITS`.
      arms: names and parameters of any strategies.
      worlds: how many.
      seed: of the worlds.
      out: run folder, in which a study that was killed is continued; None keeps all in memory.
      domain: the worlds, by name.
      rules: when a trial ends.
      report: called after every segment of the run.
      shape: `slots` and `workers` of `sweep`.

    Returns:
      For each limit its `value` and the `world` (case), `success` and `usual` (arm, case).

    Raises:
      InputError: an argument is not allowed, or `out` holds another run.
    """
    for name in names:
        errors.check_name("limit", name, LIMITS)
    base, heard = named(domain), InTurn(report)

    def sweep(part: str, of: Domain, robot: Robot | None = None) -> xr.Dataset:
        folder = None if out is None else out / part
        found = sweeps.sweep(
            of, arms, worlds, seed, out=folder, rules=rules, robot=robot, report=heard, **shape
        )
        heard.ended(len(arms) * worlds)
        return found

    ideal, found = sweep(_IDEAL, base), {}
    for name in names:
        limit = LIMITS[name]
        parts = (
            [sweep(name, replace(base, **limit.drawn))]
            if limit.drawn
            else [sweep(f"{name}_{i}", base, one) for i, one in enumerate(limit.robots.values())]
        )
        values = (
            limit.value(parts[0])
            if limit.drawn
            else np.repeat([float(value) for value in limit.robots], worlds)
        )
        found[name] = xr.Dataset(
            {
                "success": (
                    ("arm", "case"),
                    np.concatenate([p.success.values for p in parts], axis=1),
                ),
                "usual": (("arm", "case"), np.tile(ideal.success.values, (1, len(parts)))),
            },
            {
                "arm": list(arms),
                "value": ("case", values, {"long_name": limit.what}),
                "world": ("case", np.tile(np.arange(worlds), len(parts))),
            },
            {"harms": limit.harms, "log": int(limit.log)},
        )
    return found


def crossing(value: np.ndarray, lost: np.ndarray, level: float, harms: int) -> float:
    """The value at which a law has lost `level` [1] of its success; NaN if it never has.

    The losses (n,) of cases, each -1, 0 or 1, at values (n,) are made monotone by least squares:
    rising with the value if `harms` is 1, falling if it is -1. At the harmless end, where the base
    is ideal, nothing is lost: this is put in with the weight of a twentieth of the cases.
    """
    order = np.argsort(harms * value, kind="stable")
    ideal = np.zeros(value.size // 20)
    fitted = optimize.isotonic_regression(np.concatenate([ideal, lost[order]])).x[ideal.size :]
    over = np.flatnonzero(fitted >= level)
    return float(value[order][over[0]]) if over.size else math.nan


def crossings(found: xr.Dataset, level: float, seed: int = 0) -> dict[str, tuple[float, ...]]:
    """For each arm `crossing` and its bootstrap 95 % interval; cases are drawn again."""
    random, value = np.random.default_rng(seed), found.value.values
    told = {}
    for arm in map(str, found.arm.values):
        lost = found.usual.sel(arm=arm).values - found.success.sel(arm=arm).values
        again = []
        for _ in range(_RESAMPLES):
            some = random.integers(0, value.size, value.size)
            again.append(crossing(value[some], lost[some], level, found.harms))
        # A resample that never loses so much says that the limit may lie beyond what was tried.
        beyond = float(value.max() if found.harms > 0 else value.min())
        ends = np.percentile(np.nan_to_num(again, nan=beyond), [2.5, 97.5])
        told[arm] = (crossing(value, lost, level, found.harms), *map(float, ends))
    return told


def losses(found: Mapping[str, xr.Dataset]) -> list[list[str]]:
    """Header and a row for each drawn limit and arm: where it has lost each of `LOSSES`."""
    rows = [["limit", "parameters", "ideal base", *(f"{100 * x:g} points lost at" for x in LOSSES)]]
    for name in (name for name in found if LIMITS[name].drawn):
        one, at = found[name], [crossings(found[name], level) for level in LOSSES]
        for arm in map(str, one.arm.values):
            usual = f"{100 * float(one.usual.sel(arm=arm).mean()):.1f} %"
            rows.append([LIMITS[name].what, arm, usual, *(_place(*each[arm]) for each in at)])
    return rows


def _place(at: float, low: float, high: float) -> str:
    return "nowhere" if math.isnan(at) else f"{at:.2g} [{low:.2g}, {high:.2g}]"


def successes(found: Mapping[str, xr.Dataset]) -> list[list[str]]:
    """Header and a row for each value of the sizes and pitches: every arm's success there."""
    arms = [str(arm) for one in list(found.values())[:1] for arm in one.arm.values]
    rows = [["quantity", "value", *arms]]
    for name in (name for name in found if LIMITS[name].robots):
        for value in np.unique(found[name].value.values):
            here = found[name].success.values[:, found[name].value.values == value] > 0
            rates = [tables.share(int(won.sum()), won.size) for won in here]
            rows.append([LIMITS[name].what, f"{value:.3g}", *rates])
    return rows


def turning(
    robots: Mapping[str, Robot],
    params: Params,
    seconds: float = 10.0,
    *,
    object: str = "box",
    target: tuple[float, float] = (-2.0, 0.0),
) -> xr.Dataset:
    """What robots make of the turns that a law asks for in the first seconds of one push.

    Args:
      robots: by name.
      params: of the law.
      seconds: from the start.
      object: what is pushed, by name.
      target: where to [m].

    Returns:
      `asked` and `done` (robot, time) [rad/s]: the law's twist, and the base's own.
    """
    rows = []
    for robot in robots.values():
        chosen = Conditions(engine="fused", robot=robot, horizon=seconds)
        case, setting = chosen.case(object, "S1", target, params), chosen.setting()
        period = setting.physics.control_period
        (trace,) = pushes.follow([case], setting, interval=period)
        seen = trace.snapshots
        turns = np.diff(np.asarray(seen.qpos)[:, 2]) / period
        rows.append([np.asarray(seen.twist.omega)[:-1], turns, np.asarray(seen.time)[:-1]])
    asked, done, time = (np.stack(columns) for columns in zip(*rows, strict=True))
    return xr.Dataset(
        {"asked": (("robot", "time"), asked), "done": (("robot", "time"), done)},
        {"robot": list(robots), "time": time[0]},
    )
