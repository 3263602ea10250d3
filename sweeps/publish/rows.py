"""Tables that are computed from the results of a command when its report has no such table."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr

from rps_jax import Robot, Rules
from rps_jax.analysis import statistics, tables
from rps_jax.geometry.solid import GRAVITY
from rps_jax.studies import rare, sensitivity
from rps_jax.studies.attack import yields
from sweeps.study_base import Rows

_MAX_LOST = float(Rules().max_lost)  # [s] in all published commands


def by_bearing(results: xr.Dataset) -> Rows:
    """Return a header and one row per law of a ladder: success by the bearing of the target."""
    limits, bearing = (0.0, 0.3, 0.8, 1.6, np.inf), np.abs(results.bearing.values)
    masks = [(bearing >= low) & (bearing < high) for low, high in itertools.pairwise(limits)]
    rows = [
        [
            "law",
            "senses",
            "target within 0.3 rad of ahead",
            "0.3 to 0.8 rad",
            "0.8 to 1.6 rad",
            "beside and behind, above 1.6 rad",
        ]
    ]
    mean = results.success.mean("world")
    for law in sorted(map(str, results.law.values), key=lambda name: -float(mean.sel(law=name))):
        outcomes = results.sel(law=law)
        rates = [f"{100 * (outcomes.success.values[mask] > 0).mean():.0f} %" for mask in masks]
        rows.append([law, str(outcomes.senses.item()), *rates])
    return rows


def attack_table(results: xr.Dataset) -> Rows:
    """Return a header and two rows: the search of an attack, and drawn worlds."""
    per_hour, repeated = yields(results), np.isfinite(results.again.values)
    failed_again = int((results.again.values == 1).sum())
    return [
        [
            "",
            "trials",
            "simulated [h]",
            "cells with a failure",
            "such cells for each simulated hour",
            "elites that fail again in converged C MuJoCo",
        ],
        [
            "search",
            f"{int(results.trials[-1]):,}",
            f"{float(results.simulated[-1]) / 3600:.1f}",
            str(int(results.failing[-1])),
            f"{per_hour['search']:.2g}",
            f"{failed_again} of {int(repeated.sum())}",
        ],
        [
            "drawn worlds",
            f"{results.attrs['drawn_trials']:,}",
            f"{results.attrs['drawn_simulated'] / 3600:.1f}",
            str(results.attrs["drawn_failing"]),
            f"{per_hour['drawn']:.2g}",
            "",
        ],
    ]


def comparison(results: object) -> Rows:
    """Return a header and one row per domain and law, compared world by world with the first law.

    The results of a tuner have no rows.
    """
    rows = [["test worlds", *_HEADER]]
    for domain, node in results.children.items() if isinstance(results, xr.DataTree) else ():
        outcomes = node.to_dataset()
        worlds = f"`{domain}`, {outcomes.sizes['world']:,}"
        rows += [[worlds, *_outcome_row(outcomes, i, 0)] for i in range(outcomes.sizes["law"])]
    return rows if len(rows) > 1 else []


def plus_beside_tuned(results: xr.Dataset) -> Rows:
    """Return a header and the rows of RPS+ and the tuned law in a ladder, world by world."""
    return _beside(results, ("rps_plus", "rps_tuned"), "rps_tuned")


def beside_first(results: xr.Dataset) -> Rows:
    """Return a header and the rows of all laws of a sweep, world by world against the first."""
    names = results.law.values.tolist()
    return _beside(results, names, names[0])


def _beside(results: xr.Dataset, laws: Sequence[str], base: str) -> Rows:
    names = results.law.values.tolist()
    rows = (_outcome_row(results, names.index(law), names.index(base)) for law in laws)
    return [list(_HEADER), *rows]


_FAILURES = (
    "fell over",
    "never touched",
    "lost contact",
    "timeout",
    "diverged",
    "stalled",
    "contact not felt",
)
_HEADER = (
    "law",
    "success",
    "by object [%]",
    "median time",
    ", ".join(_FAILURES),
    "gained, lost",
    "p",
)


def _outcome_row(results: xr.Dataset, law: int, base: int) -> list[str]:
    """Return rates, median time, failures by kind, and the comparison with law `base`."""
    outcomes = results.isel(law=law)
    succeeded, time = outcomes.success.values > 0, outcomes.time.values
    masks = statistics.worlds_by_object(results).values()
    kinds = statistics.failure_modes(outcomes, _MAX_LOST)
    counts = [int((kinds == statistics.FAILURES.index(kind)).sum()) for kind in _FAILURES]
    compared = statistics.compare(results.success[base], results.success[law])
    difference = [compared.changes, f"{compared.p:.2g}"]
    return [
        _run_or_law(str(outcomes.law.item())),
        tables.rate(succeeded),
        ", ".join(tables.percent(succeeded[mask].sum(), mask.sum()) for mask in masks),
        tables.median(time[succeeded]),
        ", ".join(map(str, counts)),
        *(difference if law != base else ["", ""]),
    ]


def _run_or_law(label: str) -> str:
    """Return the name of the run that tuned a law, or the label of a law without a file."""
    file = Path(label.partition(",")[2])
    return file.parent.name if file.suffix else label


def default_beside_tuned(results: object) -> Rows:
    """Return a header and one row per law of a ladder: with its default and with tuned parameters.

    The results of a tuner have no rows.
    """
    if not isinstance(results, xr.Dataset) or "success" not in results:
        return []
    rows = [["law", "its own values", "tuned with 400,000 s", "gained, lost", "p (Holm)"]]
    laws = [name for name in map(str, results.law.values) if "," not in name]
    success = results.success
    pairs = [(success.sel(law=law), success.sel(law=f"{law},tuned")) for law in laws]
    comparisons = [statistics.compare(*pair) for pair in pairs]
    adjusted = statistics.holm([compared.p for compared in comparisons])
    for law, pair, compared, p in zip(laws, pairs, comparisons, adjusted, strict=True):
        rates = (tables.rate(success.values) for success in pair)
        rows.append([law, *rates, compared.changes, f"{p:.2g}"])
    return rows


def largest_indices(results: xr.Dataset) -> Rows:
    """Return a header and the five quantities of the largest total index of success."""
    (_, *head), *body = sensitivity.index_table(results)
    columns = [i for i, name in enumerate(head, 1) if name in _INDICES]
    return [["quantity", *_INDICES], *([row[0], *(row[i] for i in columns)] for row in body[:5])]


_INDICES = ("success: first", "success: total", "time: total")


def rare_failures(results: xr.Dataset) -> Rows:
    """Return a header and the rows of the median repetition, all repetitions and drawn worlds."""

    def row(name: str, estimate: xr.Dataset, prefix: str = "") -> list[str]:
        p, low, high, deviation, trials = (
            float(estimate[prefix + field]) for field in rare.Estimate._fields
        )
        return rare.estimate_row(name, rare.Estimate(p, low, high, deviation, round(trials)))

    header, *_, together = rare.estimate_table(results)
    median = results[list(rare.Estimate._fields)].median("repetition")
    rows = [header, row(f"splitting, median of {results.sizes['repetition']}", median), together]
    if "drawn_p" in results:
        rows.append(row("drawn worlds", results, "drawn_"))
    return [cells[:-1] for cells in rows]


_ROBOT_QUANTITIES = (("robot_lag", "lag", "s"), ("robot_acceleration", "acceleration", "m/s²"))


def by_robot(results: xr.Dataset) -> Rows:
    """Return a header and the success of drawn robots by their force, lag and acceleration.

    The force of a robot is the smaller of its drive's force and its wheels' traction, divided by
    the friction of the object with the ground. Above 1.5 the force suffices.
    """
    force = np.minimum(results.robot_force, results.robot_traction * Robot().mass * GRAVITY)
    margin = (force / (results.friction_ground * results.mass * GRAVITY)).values
    rows = [["greatest force over the object's friction", "worlds", *map(str, results.law.values)]]

    def add_row(label: str, mask: np.ndarray) -> None:
        succeeded = results.success.values[:, mask] > 0
        rows.append([label, f"{mask.sum():,}", *map(tables.rate, succeeded)])

    for low, high in itertools.pairwise((0.5, 0.8, 1, 1.25, 1.5, 2, 3, 5, 10)):
        add_row(f"{low:g} to {high:g}", (margin >= low) & (margin < high))
    add_row("above 10", margin >= 10)
    suffices = margin >= 1.5
    for name, label, unit in _ROBOT_QUANTITIES:
        drawn = results[name].values
        fifths = np.quantile(drawn[suffices], np.linspace(0, 1, 6))
        for low, high in itertools.pairwise(fifths):
            below = (drawn <= high) if high == fifths[-1] else (drawn < high)
            mask = suffices & (drawn >= low) & below
            add_row(f"{label} {low:.1f} to {high:.1f} {unit}, force enough", mask)
    return rows
