"""Candidates along lines and between sets of parameters, and what each of them is worth."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import RPSParams
from rps_jax.analysis import tables
from rps_jax.laws import Space
from rps_jax.trials.trial import Outcome
from sweeps.study_base import records

_EDGE = 0.03  # distance of varied parameters from their bounds, as a share of the range


class Aims(NamedTuple):
    """Objectives of parameters (P,) in the worlds of all domains."""

    success: np.ndarray  # [1] share
    time: np.ndarray  # [s] median over the successes; NaN without any
    path: np.ndarray  # [m] median path length of the base over the successes


def aims(outcome: Outcome) -> Aims:
    """Return the objectives of candidates from their outcomes (P, W)."""
    success = np.asarray(outcome.success) > 0
    measured = np.asarray((outcome.time, outcome.path_length), float)
    with warnings.catch_warnings(action="ignore"):  # the median of no success is NaN
        medians = np.nanmedian(np.where(success, measured, np.nan), axis=2)
    return Aims(success.mean(axis=1), *medians)


# --- one parameter at a time ---------------------------------------------------------------


def lines(base: RPSParams, names: Sequence[str], count: int) -> RPSParams:
    """Return parameters with one of them varied between its bounds: leaves (names, count)."""
    u = jax.scipy.special.logit(jnp.linspace(_EDGE, 1 - _EDGE, count))
    varied = [Space((name,), base).params(u[:, None]) for name in names]
    return jax.tree.map(lambda *x: jnp.stack(x), *varied)


# --- several aims at once ------------------------------------------------------------------


def cloud(
    sets: Sequence[RPSParams], names: Sequence[str], count: int, spread: float, seed: int
) -> RPSParams:
    """Return candidates (len(sets) + count,): the sets, and points near the lines between them.

    Each point is uniformly distributed between two sets, plus a normal step of standard deviation
    `spread` in the coordinates of the bounded map. Fields outside `names`, such as switches, are
    those of the nearer set.
    """
    space = Space(tuple(names))
    corners = jnp.stack([space.vector(params) for params in sets])
    keys = jax.random.split(jax.random.key(seed), 4)
    first, second = (jax.random.randint(key, (count,), 0, len(sets)) for key in keys[:2])
    share = jax.random.uniform(keys[2], (count, 1))
    middle = corners[first] + share * (corners[second] - corners[first])
    steps = spread * jax.random.normal(keys[3], middle.shape, middle.dtype)
    varied = space.params(jnp.concatenate([corners, middle + steps]))
    nearer = jnp.where(share[:, 0] < 0.5, first, second)
    origin = jnp.concatenate([jnp.arange(len(sets)), nearer])
    stacked = jax.tree.map(
        lambda *leaves: jnp.stack([jnp.asarray(x, float) for x in leaves]), *sets
    )
    fixed = {name: getattr(stacked, name)[origin] for name in stacked._fields if name not in names}
    return varied._replace(**fixed)


def undominated(values: Aims) -> np.ndarray:
    """Return the mask (P,) of Pareto-optimal candidates."""
    costs = np.stack([-values.success, values.time, values.path], axis=1)
    known = np.isfinite(costs).all(axis=1)
    costs = np.where(np.isfinite(costs), costs, np.inf)
    no_worse = (costs[:, None] <= costs[None]).all(axis=2)
    better = (costs[:, None] < costs[None]).any(axis=2)
    return np.asarray(known & ~(no_worse & better).any(axis=0))


def front_table(results: xr.Dataset) -> list[list[str]]:
    """Return a header and one row per Pareto-optimal candidate and set, by success."""
    rows = [["", "success", "median time", "median way", "on the front"]]
    named = ~results.candidate.str.isdigit()
    shown = results.isel(candidate=np.flatnonzero(results.front | named))
    ordered = shown.isel(candidate=np.argsort(-shown.success.values, kind="stable"))
    for row in records(ordered, "candidate"):
        rows.append(
            [
                row["candidate"],
                f"{tables.percent(row['success'])} %",
                f"{row['time']:.1f} s",
                f"{row['path']:.2f} m",
                "yes" if row["front"] else "no",
            ]
        )
    return rows
