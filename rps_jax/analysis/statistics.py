"""What a sweep over random worlds says: rates, differences, kinds of failure, hard worlds."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy import stats

from rps_jax.analysis import tables
from rps_jax.studies import study

# Of a sweep's results, what was drawn, and its name in words.
DRAWN = {
    "mass": "mass of the object",
    "size": "half width of the object",
    "height": "height of the object",
    "corners": "corners of the object",
    "com_offset": "centre of mass off the middle",
    "friction_ground": "friction object-ground",
    "friction_robot": "friction object-robot",
    "distance": "distance of the target",
    "bearing": "bearing of the target",
    "lateral": "lateral offset",
    "yaw": "yaw of the object",
    "gap": "gap at the start",
    "noise": "noise of the skin",
    "gain_spread": "spread of the taxels' gains",
    "dead_share": "dead taxels",
    "pose_noise": "noise of the position",
    "yaw_noise": "noise of the heading",
    "pose_latency": "latency of the pose",
    "command_delay": "delay of the command",
    "v_x_error": "error of v_x",
    "v_y_error": "error of v_y",
    "omega_error": "error of omega",
}
FAILURES = ("never touched", "lost contact", "timeout", "fell over", "diverged")
_TAIL = 0.05  # of the worlds are the worst


class Bins(NamedTuple):
    """Success of one arm against one quantity."""

    middle: np.ndarray  # (n,) of each bin: the median of its worlds
    won: np.ndarray  # (n,)
    of: np.ndarray  # (n,)


def worlds_by_object(results: xr.Dataset) -> dict[str, np.ndarray]:
    """Which worlds, a mask, have each object."""
    which = results.which_object.values
    return {str(name): which == i for i, name in enumerate(results.object.values)}


def drawn(results: xr.Dataset) -> list[str]:
    """Names of those of `DRAWN` that differ between worlds."""

    def differs(values: np.ndarray) -> bool:
        return np.unique(values[np.isfinite(values)]).size > 1

    return [name for name in DRAWN if differs(results[name].values)]


def cvar(values: np.ndarray, tail: float = _TAIL) -> float:
    """Mean of the worst, greatest `tail` of the values: their conditional value at risk."""
    worst = max(1, round(tail * values.size))
    return float(np.sort(values)[-worst:].mean())


def left_over(one: xr.Dataset) -> np.ndarray:
    """Least distance (worlds,) [m] of the contact to the target; never touched: the whole way."""
    distance = one.min_distance.values.astype(float)
    return np.where(np.isfinite(distance), distance, one.distance.values)


def failure(one: xr.Dataset, max_lost: float) -> np.ndarray:
    """Index into `FAILURES` (worlds,), -1 for a success."""
    kinds = np.select(
        [
            one.success.values > 0,
            one.diverged.values > 0,
            one.tipped.values > 0,
            ~np.isfinite(one.min_distance.values),
            one.contact_lost_time.values > max_lost,
        ],
        [-1, *map(FAILURES.index, ("diverged", "fell over", "never touched", "lost contact"))],
        FAILURES.index("timeout"),
    )
    return kinds


def rates(results: xr.Dataset, max_lost: float) -> list[list[str]]:
    """Header and one row for each arm: success by object, distance left, time, failures."""
    groups = worlds_by_object(results)
    header = ["", *groups, "all", "CVaR 5 % of distance", "median time", *FAILURES]
    rows = [header]
    for arm in map(str, results.arm.values):
        one = results.sel(arm=arm)
        won = one.success.values > 0
        kinds = failure(one, max_lost)
        rows.append(
            [
                arm,
                *(_rate(won[mask]) for mask in groups.values()),
                _rate(won),
                f"{cvar(left_over(one)):.2f} m",
                f"{np.median(one.time.values[won]):.1f} s" if won.any() else "-",
                *(str(int((kinds == i).sum())) for i in range(len(FAILURES))),
            ]
        )
    return rows


def _rate(won: np.ndarray) -> str:
    return _share(int(won.sum()), won.size)


def _share(won: int, of: int) -> str:
    if not of:
        return "-"
    low, high = tables.wilson(won, of)
    return f"{100 * won / of:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


def differences(results: xr.Dataset) -> list[list[str]]:
    """Header and one row for each pair of arms, world by world, with McNemar's exact test."""
    rows = [["second against first", "gained", "lost", "difference", "McNemar p"]]
    for first, second in combinations(map(str, results.arm.values), 2):
        a, b = results.success.sel(arm=first), results.success.sel(arm=second)
        c = study.compare(a, b)
        share = 100 * (c.gained - c.lost) / a.size
        rows.append(
            [
                f"{second} against {first}",
                str(c.gained),
                str(c.lost),
                f"{share:+.2f} %",
                f"{c.p:.2g}",
            ]
        )
    return rows


def hardest(results: xr.Dataset, count: int = 10) -> np.ndarray:
    """Worlds (count,) in which most arms fail, and among these the most distance is left."""
    arms = [results.sel(arm=arm) for arm in results.arm.values]
    failed = sum((one.success.values == 0).astype(float) for one in arms)
    left = np.mean([left_over(one) for one in arms], axis=0)
    order = np.lexsort((-left, -np.asarray(failed)))
    return order[: min(count, int((np.asarray(failed) > 0).sum()))]


def hardest_table(results: xr.Dataset, run: str, count: int = 10) -> list[list[str]]:
    """Header and one row for each of the hardest worlds, with the command that replays it."""
    names = [str(name) for name in results.object.values]
    arms = [str(arm) for arm in results.arm.values]
    rows = [["world", "object", *arms, "mass", "friction", "target", "replay"]]
    for world in hardest(results, count):
        one = results.isel(world=world)
        x = float(one.distance), float(np.degrees(one.bearing))
        fails = next(arm for arm in arms if not int(one.success.sel(arm=arm)))
        rows.append(
            [
                str(int(world)),
                names[int(one.which_object)],
                *(_told(one.sel(arm=arm)) for arm in arms),
                f"{float(one.mass):.1f} kg",
                f"{float(one.friction_ground):.2f}, {float(one.friction_robot):.2f}",
                f"{x[0]:.1f} m at {x[1]:.0f} deg",
                f"`rps replay {shlex.quote(run)} {int(world)} --arm {fails!r} --video`",
            ]
        )
    return rows


def _told(trial: xr.Dataset) -> str:
    if int(trial.success):
        return f"{float(trial.time):.0f} s"
    distance = float(trial.min_distance)
    return f"fails, {100 * distance:.0f} cm off" if np.isfinite(distance) else "never touches"


def bins(values: np.ndarray, won: np.ndarray, count: int = 8) -> Bins:
    """Success against a quantity, in bins of equal numbers of worlds, or one for each value."""
    known = np.isfinite(values)
    values, won = values[known], won[known]
    different = np.unique(values)
    if different.size <= count:
        groups: Sequence[np.ndarray] = [np.flatnonzero(values == v) for v in different]
    else:
        groups = [g for g in np.array_split(np.argsort(values, kind="stable"), count) if g.size]
    return Bins(
        np.array([np.median(values[g]) for g in groups]),
        np.array([int(won[g].sum()) for g in groups]),
        np.array([g.size for g in groups]),
    )


def influences(results: xr.Dataset, arm: str) -> list[list[str]]:
    """Header and one row for each quantity that was drawn: the arm's worst and best bin.

    Those whose bins differ most come first: by a chi-squared test that all bins have one rate,
    false discoveries among the quantities held at 5 % (Benjamini-Hochberg) where q < 0.05.
    """
    won = results.success.sel(arm=arm).values > 0
    binned = {name: bins(results[name].values, won) for name in drawn(results)}
    p = [_one_rate(found) for found in binned.values()]
    q = stats.false_discovery_control(p) if p else []
    rows = [["", "worst bin, about", "success", "best bin, about", "success", "q"]]
    for i in np.argsort(q, kind="stable"):
        name, found = list(binned.items())[i]
        order, unit = np.argsort(found.won / found.of, kind="stable"), results[name].attrs["units"]
        told = [f"{value:.3g} {unit}".removesuffix(" 1") for value in found.middle]
        ends = [
            cell
            for n in (order[0], order[-1])
            for cell in (told[n], _share(int(found.won[n]), int(found.of[n])))
        ]
        rows.append([DRAWN[name], *ends, f"{q[i]:.2g}"])
    return rows


def _one_rate(found: Bins) -> float:
    """The p of a chi-squared test that all bins have one success rate."""
    counts = np.stack([found.won, found.of - found.won])
    if len(found.of) < 2 or not counts.sum(axis=1).all():
        return 1.0
    return float(stats.chi2_contingency(counts).pvalue)


def agreement(found: Mapping[str, xr.Dataset]) -> list[list[str]]:
    """Header and one row for each engine: success, and outcomes equal to the first's, by object.

    The results are those of one arm in the same worlds.
    """
    base = next(iter(found.values()))
    groups = worlds_by_object(base)
    rows = [["engine", *groups, "equal outcomes", "95 %", *(f"equal, {g}" for g in groups), "+/-"]]
    for name, one in found.items():
        won = one.success.values > 0
        same = won == (base.success.values > 0)
        c = study.compare(base.success, one.success)
        low, high = c.equal_interval
        rows.append(
            [
                name,
                *(f"{won[mask].sum()} of {mask.sum()}" for mask in groups.values()),
                f"{100 * c.equal:.1f} %",
                f"{100 * low:.0f}-{100 * high:.0f} %",
                *(f"{same[mask].sum()} of {mask.sum()}" for mask in groups.values()),
                f"+{c.gained} -{c.lost}",
            ]
        )
    return rows
