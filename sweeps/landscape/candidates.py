"""Candidates along lines and between sets of parameters, and what each of them is worth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax.analysis import tables
from rps_jax.control.laws.rps import RPSParams
from rps_jax.runs.question import Split, seed_of
from rps_jax.trials.progress import ProgressCallback, no_progress
from rps_jax.trials.rollout import Candidates, outcomes
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Outcome
from rps_jax.tuning.space import SUBSETS, Space
from rps_jax.world.domain import Domain

_EDGE = 0.03  # distance of varied parameters from their bounds, as a share of the range


class Aims(NamedTuple):
    """Objectives of parameters (P,) in the worlds of all domains."""

    success: np.ndarray  # [1] share
    time: np.ndarray  # [s] median over the successes; NaN without any
    path: np.ndarray  # [m] median path length of the base over the successes


def aims(outcome: Outcome) -> Aims:
    """Return the objectives of candidates from their outcomes (P, W)."""
    success = np.asarray(outcome.success) > 0
    with np.errstate(all="ignore"):
        medians = [
            np.array(
                [
                    np.median(x[mask]) if mask.any() else np.nan
                    for x, mask in zip(rows, success, strict=True)
                ]
            )
            for rows in np.asarray((outcome.time, outcome.path_length), float)
        ]
    return Aims(success.mean(axis=1), *medians)


def _run_candidates(
    params: Any,
    domains: Sequence[Domain],
    setting: Setting,
    splits: Sequence[Split],
    count: int,
    **run: Any,
) -> list[Outcome]:
    """Return the outcomes (P, D * W) of candidates in the worlds of each split."""
    seeds = [seed_of(setting.seed, split) for split in splits]
    requests = [Candidates(params, domains, seed, np.arange(count)) for seed in seeds]
    return outcomes(requests, setting, **run)[0]


# --- one parameter at a time ---------------------------------------------------------------


def lines(base: RPSParams, names: Sequence[str], count: int) -> RPSParams:
    """Return parameters with one of them varied between its bounds: leaves (names, count)."""
    u = jax.scipy.special.logit(jnp.linspace(_EDGE, 1 - _EDGE, count))
    varied = [Space((name,), base).params(u[:, None]) for name in names]
    return jax.tree.map(lambda *x: jnp.stack(x), *varied)


def alone(
    sets: dict[str, RPSParams],
    domains: Sequence[Domain],
    setting: Setting,
    *,
    names: Sequence[str] = SUBSETS["full"],
    count: int = 9,
    worlds: int = 1000,
    callback: ProgressCallback = no_progress,
    **shape: Any,
) -> xr.Dataset:
    """Compute success, time and path length over each parameter alone, in validation worlds.

    Return labelled results (set, parameter, step), with the parameter's `value` at each step.
    """
    shape_of = (len(sets), len(names), count)
    grid = jax.tree.map(
        lambda *x: jnp.stack(x), *(lines(base, names, count) for base in sets.values())
    )
    params = jax.tree.map(lambda leaf: leaf.reshape(-1), grid)
    (outcome,) = _run_candidates(
        params, domains, setting, ("validate",), worlds, callback=callback, **shape
    )
    dims = ("set", "parameter", "step")
    columns: dict[str, Any] = {
        name: (dims, values.reshape(shape_of)) for name, values in aims(outcome)._asdict().items()
    }
    varied = [np.asarray(getattr(grid, name))[:, i] for i, name in enumerate(names)]
    columns["value"] = (dims, np.stack(varied, axis=1))
    return xr.Dataset(
        columns,
        {"set": list(sets), "parameter": list(names)},
        {"worlds": outcome.success.shape[1]},
    )


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


def front(
    sets: dict[str, RPSParams],
    domains: Sequence[Domain],
    setting: Setting,
    *,
    names: Sequence[str] = SUBSETS["full"],
    candidates: int = 256,
    spread: float = 0.5,
    worlds: int = 1000,
    callback: ProgressCallback = no_progress,
    **shape: Any,
) -> xr.Dataset:
    """Run candidates between and around sets of parameters, and select the Pareto-optimal ones.

    The selection uses validation worlds. The objectives (candidate,) are then measured in test
    worlds, so that the selection does not bias them.
    """
    params = cloud(list(sets.values()), names, candidates, spread, setting.seed)
    validated, tested = _run_candidates(
        params, domains, setting, ("validate", "test"), worlds, callback=callback, **shape
    )
    chosen = undominated(aims(validated))
    labels = [*sets, *(f"{i}" for i in range(candidates))]
    columns: dict[str, Any] = {k: ("candidate", v) for k, v in aims(tested)._asdict().items()}
    columns["front"] = ("candidate", chosen)
    columns |= {name: ("candidate", np.asarray(getattr(params, name))) for name in names}
    return xr.Dataset(columns, {"candidate": labels}, {"worlds": tested.success.shape[1]})


def front_table(results: xr.Dataset) -> list[list[str]]:
    """Return a header and one row per Pareto-optimal candidate and set, by success."""
    rows = [["", "success", "median time", "median way", "on the front"]]
    labels = [str(label) for label in results.candidate.values]
    named = np.array([not label.isdigit() for label in labels])
    shown = np.flatnonzero(results.front.values | named)
    for i in shown[np.argsort(-results.success.values[shown], kind="stable")]:
        row = results.isel(candidate=int(i))
        rows.append(
            [
                labels[i],
                f"{tables.percent(float(row.success))} %",
                f"{float(row.time):.1f} s",
                f"{float(row.path):.2f} m",
                "yes" if bool(row.front) else "no",
            ]
        )
    return rows
