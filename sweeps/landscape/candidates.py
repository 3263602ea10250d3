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
from rps_jax.runs import evaluate
from rps_jax.runs.evaluate import Candidates
from rps_jax.runs.question import Split, seed_of
from rps_jax.trials.progress import ProgressCallback, no_progress
from rps_jax.trials.trial import Outcome
from rps_jax.tuning.run import Problem
from rps_jax.tuning.space import SUBSETS, Space

_EDGE = 0.03  # how near to a parameter's bounds it is varied, as a share of the range


class Aims(NamedTuple):
    """What is wanted of parameters, (P,) each; worlds are those of all domains."""

    success: np.ndarray  # [1] share
    time: np.ndarray  # [s] median over the successes; NaN without any
    path: np.ndarray  # [m] of the base, likewise


def aims(outcome: Outcome) -> Aims:
    """The aims of candidates by their outcomes (P, W)."""
    won = np.asarray(outcome.success) > 0
    with np.errstate(all="ignore"):
        medians = [
            np.array(
                [np.median(x[w]) if w.any() else np.nan for x, w in zip(rows, won, strict=True)]
            )
            for rows in np.asarray((outcome.time, outcome.path_length), float)
        ]
    return Aims(won.mean(axis=1), *medians)


def _try(
    params: Any, problem: Problem, splits: Sequence[Split], seed: int, count: int, **run: Any
) -> list[Outcome]:
    """The outcomes (P, D * W) of candidates in the worlds of each split."""
    asks = [Candidates(params, seed_of(seed, split), np.arange(count)) for split in splits]
    answers, _ = evaluate.score_candidates(
        asks, problem.domains, problem.setting, problem.objective, **run
    )
    return [answer.outcome for answer in answers]


# --- one parameter at a time ---------------------------------------------------------------


def lines(base: RPSParams, names: Sequence[str], count: int) -> RPSParams:
    """Each parameter varied between its bounds, the others as in `base`: leaves (names, count)."""
    u = jax.scipy.special.logit(jnp.linspace(_EDGE, 1 - _EDGE, count))
    every = [Space((name,), base).params(u[:, None]) for name in names]
    return jax.tree.map(lambda *x: jnp.stack(x), *every)


def alone(
    sets: dict[str, RPSParams],
    problem: Problem,
    *,
    names: Sequence[str] = SUBSETS["full"],
    count: int = 9,
    worlds: int = 1000,
    seed: int = 0,
    callback: ProgressCallback = no_progress,
    **shape: Any,
) -> xr.Dataset:
    """Success, time and way against each parameter alone, in worlds for validation.

    Returns labelled results (set, parameter, step), with the parameter's `value` at each step.
    """
    shape_of = (len(sets), len(names), count)
    grid = jax.tree.map(
        lambda *x: jnp.stack(x), *(lines(one, names, count) for one in sets.values())
    )
    params = jax.tree.map(lambda leaf: leaf.reshape(-1), grid)
    (found,) = _try(params, problem, ("validate",), seed, worlds, callback=callback, **shape)
    dims = ("set", "parameter", "step")
    columns: dict[str, Any] = {
        name: (dims, values.reshape(shape_of)) for name, values in aims(found)._asdict().items()
    }
    varied = [np.asarray(getattr(grid, name))[:, i] for i, name in enumerate(names)]
    columns["value"] = (dims, np.stack(varied, axis=1))
    return xr.Dataset(
        columns,
        {"set": list(sets), "parameter": list(names)},
        {"worlds": found.success.shape[1]},
    )


# --- several aims at once ------------------------------------------------------------------


def cloud(
    sets: Sequence[RPSParams], names: Sequence[str], count: int, spread: float, seed: int
) -> RPSParams:
    """Candidates (len(sets) + count,): the sets, and others on the lines between them, and beside.

    Each of these lies evenly somewhere between two of the sets, plus a normal step of standard
    deviation `spread` in the coordinates of the bounded map. What is not among `names`, such as
    switches, it has from the nearer of the two.
    """
    space = Space(tuple(names))
    corners = jnp.stack([space.vector(params) for params in sets])
    keys = jax.random.split(jax.random.key(seed), 4)
    one, other = (jax.random.randint(key, (count,), 0, len(sets)) for key in keys[:2])
    share = jax.random.uniform(keys[2], (count, 1))
    middle = corners[one] + share * (corners[other] - corners[one])
    steps = spread * jax.random.normal(keys[3], middle.shape, middle.dtype)
    varied = space.params(jnp.concatenate([corners, middle + steps]))
    nearer = jnp.where(share[:, 0] < 0.5, one, other)
    whose = jnp.concatenate([jnp.arange(len(sets)), nearer])
    taken = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(x, float) for x in leaves]), *sets)
    own = {name: getattr(taken, name)[whose] for name in taken._fields if name not in names}
    return varied._replace(**own)


def undominated(found: Aims) -> np.ndarray:
    """Which candidates, a mask (P,), no other one beats in one aim without losing in another."""
    costs = np.stack([-found.success, found.time, found.path], axis=1)
    known = np.isfinite(costs).all(axis=1)
    costs = np.where(np.isfinite(costs), costs, np.inf)
    no_worse = (costs[:, None] <= costs[None]).all(axis=2)
    better = (costs[:, None] < costs[None]).any(axis=2)
    return np.asarray(known & ~(no_worse & better).any(axis=0))


def front(
    sets: dict[str, RPSParams],
    problem: Problem,
    *,
    names: Sequence[str] = SUBSETS["full"],
    candidates: int = 256,
    spread: float = 0.5,
    worlds: int = 1000,
    seed: int = 0,
    callback: ProgressCallback = no_progress,
    **shape: Any,
) -> xr.Dataset:
    """Candidates between and around sets of parameters, and which of them are undominated.

    Who is on the front is decided in worlds for validation; its aims, (candidate,), are then
    measured in worlds for testing, so that luck in the choice does not count.
    """
    params = cloud(list(sets.values()), names, candidates, spread, seed)
    found, again = _try(
        params, problem, ("validate", "test"), seed, worlds, callback=callback, **shape
    )
    chosen = undominated(aims(found))
    labels = [*sets, *(f"{i}" for i in range(candidates))]
    columns: dict[str, Any] = {k: ("candidate", v) for k, v in aims(again)._asdict().items()}
    columns["front"] = ("candidate", chosen)
    columns |= {name: ("candidate", np.asarray(getattr(params, name))) for name in names}
    return xr.Dataset(columns, {"candidate": labels}, {"worlds": again.success.shape[1]})


def front_table(results: xr.Dataset) -> list[list[str]]:
    """Header and a row for each candidate of the front and each set of parameters, by success."""
    rows = [["", "success", "median time", "median way", "on the front"]]
    labels = [str(label) for label in results.candidate.values]
    named = np.array([not label.isdigit() for label in labels])
    keep = np.flatnonzero(results.front.values | named)
    for i in keep[np.argsort(-results.success.values[keep], kind="stable")]:
        one = results.isel(candidate=int(i))
        rows.append(
            [
                labels[i],
                f"{tables.percent(float(one.success))} %",
                f"{float(one.time):.1f} s",
                f"{float(one.path):.2f} m",
                "yes" if bool(one.front) else "no",
            ]
        )
    return rows
