"""Outcomes -> labelled results, and rates with honest intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from scipy import stats

from rps_jax.trials.pushes import Trace
from rps_jax.trials.trial import Outcome
from rps_jax.world import paper

DIMS = ("strategy", "object", "friction", "target")
UNITS = {
    "success": ("1", "target reached within the rules"),
    "time": ("s", "simulated time at which the trial ended"),
    "min_distance": ("m", "least distance of the contact point to the target"),
    "contact_lost_time": ("s", "time without contact after the first touch"),
    "path_length": ("m", "length of the base's way"),
    "mean_abs_l": ("m", "mean |l| while in contact, the paper's D"),
    "tipped": ("1", "the object fell over"),
    "diverged": ("1", "physics became NaN or ran away"),
    "overflows": ("1", "control steps in which the engine lost contacts for want of room"),
    "base_pose": ("m, m, rad", "x, y, yaw of the base in the world at the end"),
    "object_pose": ("m, m, rad", "x, y, yaw of the object in the world at the end"),
}


def wilson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson score interval of a success rate, each end in [0, 1]; all of it without trials."""
    if trials == 0:
        return 0.0, 1.0
    interval = stats.binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    return float(interval.low), float(interval.high)


def dataset(
    outcome: Outcome,
    strategies: Sequence[str],
    objects: Sequence[str],
    frictions: Sequence[str],
    targets: Sequence[tuple[float, float]],
) -> xr.Dataset:
    """Outcomes (S * O * F * T, ...) in this nesting order, as a Dataset labelled by `DIMS`."""
    shape = (len(strategies), len(objects), len(frictions), len(targets))
    variables = {}
    for name, values in outcome._asdict().items():
        values = _plain(values)
        dims = DIMS + ("pose",) * (values.ndim - 1)
        unit, meaning = UNITS[name]
        attrs = {"units": unit, "long_name": meaning}
        variables[name] = xr.Variable(dims, values.reshape(shape + values.shape[1:]), attrs)
    position = np.asarray(targets, float)
    return xr.Dataset(
        variables,
        coords={
            "strategy": list(strategies),
            "object": list(objects),
            "friction": list(frictions),
            "target": np.arange(len(targets)),
            "target_x": ("target", position[:, 0], {"units": "m"}),
            "target_y": ("target", position[:, 1], {"units": "m"}),
            "pose": ["x", "y", "yaw"],
        },
    )


def _plain(values: Any) -> np.ndarray:
    """As an array that NetCDF can hold, which has no booleans."""
    values = np.asarray(values)
    return values.astype(np.int8) if values.dtype == bool else values


def trace_dataset(trace: Trace) -> xr.Dataset:
    """One trial over time: variables (time, ...), its outcome as scalars."""
    seen = trace.snapshots

    def over_time(values: Any, unit: str, *dims: str) -> xr.Variable:
        return xr.Variable(("time", *dims), _plain(values), {"units": unit})

    variables = {
        "qpos": over_time(seen.qpos, "m, rad, 1", "joint"),
        "contact_type": over_time(seen.reading.contact_type, "1"),
        "p_robot_contact": over_time(seen.reading.p_robot_contact, "m", "axis"),
        "v_x": over_time(seen.twist.v_x, "m/s"),
        "v_y": over_time(seen.twist.v_y, "m/s"),
        "omega": over_time(seen.twist.omega, "rad/s"),
        "l": over_time(seen.details.l, "m"),
        "distance": over_time(seen.details.distance, "m"),
        "a_r": over_time(seen.details.a_r, "1"),
        "gamma": over_time(seen.details.gamma, "rad"),
        "realigning": over_time(seen.details.realigning, "1"),
    }
    for name, value in trace.outcome._asdict().items():
        value = _plain(value)
        attrs = {"units": UNITS[name][0], "long_name": UNITS[name][1]}
        variables[f"outcome_{name}"] = xr.Variable(("pose",) * value.ndim, value, attrs)
    return xr.Dataset(variables, coords={"time": ("time", seen.time, {"units": "s"})})


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A header and rows as a Markdown table whose columns line up."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = [
        "| " + " | ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) + " |"
        for row in rows
    ]
    rule = "|" + "|".join("-" * (w + 2) for w in widths) + "|"
    return "\n".join([lines[0], rule, *lines[1:]])


def table(results: xr.Dataset) -> list[list[str]]:
    """Header and rows of Table II: successes with Wilson 95 % intervals in percent, and the
    paper's beside them."""
    trials = results.sizes["target"]
    targets = np.stack([results.target_x, results.target_y], axis=-1)
    whole = np.array_equal(targets, paper.TARGETS)
    columns = [(str(o), str(f)) for o in results.object.values for f in results.friction.values]
    rows = [["", "", *(f"{o} {f}" for o, f in columns), "all"]]
    for strategy in map(str, results.strategy.values):
        success = results.success.sel(strategy=strategy)
        counts = [int(success.sel(object=o, friction=f).sum()) for o, f in columns]
        sizes = [trials] * len(columns)
        pairs = [*zip(counts, sizes, strict=True), (sum(counts), sum(sizes))]
        cells = [f"{n}/{of} {_percent(n, of)}" for n, of in pairs]
        rows.append([strategy.upper(), "ours", *cells])
        theirs = [paper.TABLE_II.get((strategy, o, f)) for o, f in columns]
        if whole and None not in theirs:
            theirs = [n for n in theirs if n is not None]
            pairs = [*zip(theirs, sizes, strict=True), (sum(theirs), sum(sizes))]
            rows.append(["", "paper", *(f"{n}/{of}" for n, of in pairs)])
    return rows


def _percent(successes: int, trials: int) -> str:
    low, high = wilson(successes, trials)
    return f"[{100 * low:.0f}, {100 * high:.0f}]"


def summary(results: xr.Dataset) -> str:
    """One line for each strategy: median time and D of the successes, losses, divergences."""
    lines = []
    for strategy in map(str, results.strategy.values):
        part = results.sel(strategy=strategy)
        won = part.success.values.astype(bool)
        line = f"{strategy.upper()}: {won.sum()} of {won.size} succeed"
        if won.any():
            time = part.time.values[won]
            line += (
                f", in a median of {np.median(time):.1f} s (longest {time.max():.1f} s), "
                f"D = {np.mean(part.mean_abs_l.values[won]):.3f} m"
            )
        lines.append(f"{line}; {int(part.diverged.sum())} diverged")
    return "\n".join(lines)
