"""Tables that a data file makes of the answer of a command, where its report has none such."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from rps_jax.analysis import statistics, tables
from rps_jax.geometry.solid import GRAVITY
from rps_jax.robot.robot import Robot
from rps_jax.studies import rare, sensitivity
from rps_jax.studies.attack import yields
from rps_jax.trials.trial import Rules

Rows = list[list[str]]
_MAX_LOST = float(Rules().max_lost)  # of all commands that are published


def by_bearing(found: xr.Dataset) -> Rows:
    """Header and a row for each law of a ladder: success by the target's bearing."""
    ends, off = (0.0, 0.3, 0.8, 1.6, np.inf), np.abs(found.bearing.values)
    parts = [(off >= low) & (off < high) for low, high in itertools.pairwise(ends)]
    rows = [["law", "senses", "target within 0.3 rad of ahead", "0.3 to 0.8 rad", "0.8 to 1.6 rad",
             "beside and behind, above 1.6 rad"]]  # fmt: skip
    laws = sorted(map(str, found.law.values), key=lambda n: -float(found.success.sel(law=n).mean()))
    for law in laws:
        one = found.sel(law=law)
        rates = [f"{100 * (one.success.values[part] > 0).mean():.0f} %" for part in parts]
        rows.append([law, str(one.senses.item()), *rates])
    return rows


def searched(found: xr.Dataset) -> Rows:
    """Header and rows of an attack: its search, and the drawn worlds beside it."""
    gain, tried = yields(found), np.isfinite(found.again.values)
    bad = int((found.again.values == 1).sum())
    return [
        ["", "trials", "simulated [h]", "cells with a failure", "such cells for each simulated "
         "hour", "elites that fail again in converged C MuJoCo"],
        ["search", f"{int(found.trials[-1]):,}", f"{float(found.simulated[-1]) / 3600:.1f}",
         str(int(found.failing[-1])), f"{gain['search']:.2g}", f"{bad} of {int(tried.sum())}"],
        ["drawn worlds", f"{found.attrs['drawn_trials']:,}",
         f"{found.attrs['drawn_simulated'] / 3600:.1f}", str(found.attrs["drawn_failing"]),
         f"{gain['drawn']:.2g}", ""],
    ]  # fmt: skip


def cosines(found: xr.Dataset) -> Rows:
    """Header and a row for each estimator: its cosine to the truth, by the time simulated."""
    horizons = (0.5, 2.0, 8.0, 30.0, 100.0, 300.0)
    known = set(found.horizon.values.tolist())

    def cells(values: xr.DataArray) -> list[str]:
        return [f"{values.sel(horizon=t).item():.2f}" if t in known else "" for t in horizons]

    rows = [["estimator", *(f"{time:g} s" for time in horizons)]]
    rows += [[str(one), *cells(found.cosine.sel(estimator=one))] for one in found.estimator.values]
    if known == set(horizons):
        rows.append(["standard error of the truth, as a share of it", *cells(found.doubt)])
    return rows


def compared(found: xr.DataTree | Any) -> Rows:
    """Header and a row for each law in each domain of a comparison, world by world with the first;
    none of what a tuner found."""
    rows = [["test worlds", *_HEADER]]
    for domain, node in found.children.items() if isinstance(found, xr.DataTree) else ():
        one = node.to_dataset()
        what = f"`{domain}`, {one.sizes['world']:,}"
        rows += [[what, *_outcomes(one, i, 0)] for i in range(one.sizes["law"])]
    return rows if len(rows) > 1 else []


def mended(found: xr.Dataset) -> Rows:
    """Header and the rows of RPS+ and of the tuned law in a ladder, world by world."""
    names = list(map(str, found.law.values))
    base = names.index("rps_tuned")
    return [list(_HEADER), *(_outcomes(found, i, base) for i in (names.index("rps_plus"), base))]


_WAYS = ("fell over", "never touched", "lost contact", "timeout", "diverged", "stalled")
_HEADER = ("law", "success", "by object [%]", "median time", ", ".join(_WAYS), "gained, lost", "p")


def _outcomes(found: xr.Dataset, law: int, base: int) -> list[str]:
    """The row of a law: rates, median time, failures by kind, and against another of the laws."""
    one = found.isel(law=law)
    won, took = one.success.values > 0, one.time.values
    groups = statistics.worlds_by_object(found).values()
    kinds = statistics.failure_modes(one, _MAX_LOST)
    lost = [int((kinds == statistics.FAILURES.index(way)).sum()) for way in _WAYS]
    against = statistics.compare(found.success[base], found.success[law])
    beside = [f"+{against.gained} -{against.lost}", f"{against.p:.2g}"]
    return [
        _run_of(one.law.item()),
        tables.share(int(won.sum()), won.size),
        ", ".join(tables.percent(won[of].sum(), of.sum()) for of in groups),
        f"{np.median(took[won]):.1f} s" if won.any() else "-",
        ", ".join(map(str, lost)),
        *(["", ""] if law == base else beside),
    ]


def _run_of(law: Any) -> str:
    """The name of the run that tuned a law, or that of the law."""
    file = Path(str(law).partition(",")[2])
    return file.parent.name if file.suffix else str(law)


def tuned_beside(found: Any) -> Rows:
    """Header and a row for each law of a ladder: as it is, and as it was tuned; none of a tuner."""
    if not isinstance(found, xr.Dataset) or "success" not in found:
        return []
    rows = [["law", "its own values", "tuned with 400,000 s", "gained, lost", "p (Holm)"]]
    laws = [name for name in map(str, found.law.values) if "," not in name]
    pairs = [(found.success.sel(law=n), found.success.sel(law=f"{n},tuned")) for n in laws]
    against = [statistics.compare(*pair) for pair in pairs]
    adjusted = statistics.holm([one.p for one in against])
    for law, pair, one, p in zip(laws, pairs, against, adjusted, strict=True):
        rates = [tables.share(int(won.sum()), won.size) for won in pair]
        rows.append([law, *rates, f"+{one.gained} -{one.lost}", f"{p:.2g}"])
    return rows


def speeds(found: xr.Dataset) -> Rows:
    """Header and a row for each engine and batch: simulated seconds in a second, by object."""
    families = list(dict.fromkeys(map(str, found.family.values)))
    known = {
        (str(name), int(worlds), str(family)): float(rate)
        for name, worlds, family, rate in zip(
            found["name"].values, found.worlds.values, found.family.values, found.rate.values,
            strict=True,
        )
    }  # fmt: skip
    in_c = {of: rate for (name, _, of), rate in known.items() if name == "C in closed loop"}
    rows = [["engine", "worlds", *families, "against C in closed loop"]]
    for name, worlds in dict.fromkeys((name, worlds) for name, worlds, _ in known):
        rates = {of: known[name, worlds, of] for of in families if (name, worlds, of) in known}
        cells = [f"{rates[of]:,.0f}" if of in rates else "" for of in families]
        ratios = [f"{rate / in_c[of]:.3g}" for of, rate in rates.items() if of in in_c]
        ratios = [f"{float(ratio):,g}" for ratio in ratios]
        rows.append([name, f"{worlds:,}", *cells, ", ".join(ratios)])
    return rows


def blamed(found: xr.Dataset) -> Rows:
    """Header and a row for each of the five factors that explain most of success with all."""
    (_, *head), *body = sensitivity.index_table(found)
    kept = [i for i, name in enumerate(head, 1) if name in _INDICES]
    return [["quantity", *_INDICES], *([row[0], *(row[i] for i in kept)] for row in body[:5])]


_INDICES = ("success: first", "success: total", "time: total")


def rarely(found: xr.Dataset) -> Rows:
    """Header and rows of a rare failure: the median repetition, all together, and drawn worlds."""

    def told(name: str, of: xr.Dataset, prefix: str = "") -> list[str]:
        p, low, high, off, trials = (float(of[prefix + one]) for one in rare.Estimate._fields)
        return rare.estimate_row(name, rare.Estimate(p, low, high, off, round(trials)))

    head, *_, together = rare.estimate_table(found)
    middle = found[list(rare.Estimate._fields)].median("repetition")
    rows = [head, told(f"splitting, median of {found.sizes['repetition']}", middle), together]
    if "drawn_p" in found:
        rows.append(told("drawn worlds", found, "drawn_"))
    return [row[:-1] for row in rows]


_OF_A_ROBOT = (("robot_lag", "lag", "s"), ("robot_acceleration", "acceleration", "m/s²"))


def by_robot(found: xr.Dataset) -> Rows:
    """Header and rows of worlds with robots of their own: success by force, lag and acceleration.

    A robot's force is the lesser of its drive's and of its wheels' traction, over the friction of
    the object with the ground; it is enough above 1.5 times that.
    """
    force = np.minimum(found.robot_force, found.robot_traction * Robot().mass * GRAVITY)
    margin = (force / (found.friction_ground * found.mass * GRAVITY)).values
    rows = [["greatest force over the object's friction", "worlds", *map(str, found.law.values)]]

    def told(what: str, of: np.ndarray) -> None:
        won = found.success.values[:, of] > 0
        shares = [tables.share(int(one.sum()), one.size) for one in won]
        rows.append([what, f"{of.sum():,}", *shares])

    for low, high in itertools.pairwise((0.5, 0.8, 1, 1.25, 1.5, 2, 3, 5, 10)):
        told(f"{low:g} to {high:g}", (margin >= low) & (margin < high))
    told("above 10", margin >= 10)
    enough = margin >= 1.5
    for name, what, unit in _OF_A_ROBOT:
        drawn = found[name].values
        fifths = np.quantile(drawn[enough], np.linspace(0, 1, 6))
        for low, high in itertools.pairwise(fifths):
            last = high == fifths[-1]
            of = enough & (drawn >= low) & ((drawn <= high) if last else (drawn < high))
            told(f"{what} {low:.1f} to {high:.1f} {unit}, force enough", of)
    return rows
