"""Worlds that were hard: what a new law wins and loses of them, in seconds.

`regression.nc` holds 200 points of the unit cube of the domain `wide`: worlds in which the paper's
law, the tuned one, RPS+ or the learned GRU fails, or almost does, found by drawing and by `attack`;
and how these laws did there. The worlds were picked because some law is bad in them. So a rate in
them says nothing about rates elsewhere, and only differences between laws count.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr

from rps_jax import errors
from rps_jax.control.strategies import Params
from rps_jax.record import files
from rps_jax.runs import sweep
from rps_jax.runs.plan import Plan
from rps_jax.studies.failures.probe import severity_of
from rps_jax.trials.setting import Report, Setting, unheard
from rps_jax.trials.trial import Rules
from rps_jax.world import points
from rps_jax.world.domain import DOMAINS, Domain

FILE = Path(__file__).with_name("regression.nc")
DOMAIN = "wide"


def worlds() -> xr.Dataset:
    """The points `u` (world, quantity), and the `success` and `severity` (law, world) of each law.

    Raises:
      InputError: the file is damaged.
    """
    return files.read(FILE)


def plan_of(
    arms: Mapping[str, Params], setting: Setting = Setting(engine="fused"), count: int | None = None
) -> Plan:
    """The sweep of laws in the first `count` of these worlds, by default in all."""
    domain, known = DOMAINS[DOMAIN], worlds()
    total = known.sizes["world"]
    if count is not None:
        errors.check_count("worlds", count, at_most=total)
    at = points.checked(domain, known.u.values[:count])
    return Plan(domain, len(at.u), arms, setting, points=at)


def regress(
    laws: Mapping[str, Params],
    out: str | Path | None = None,
    *,
    worlds: int | None = None,
    setting: Setting = Setting(engine="fused"),
    slots: int | None = None,
    workers: int | None = None,
    report: Report = unheard,
) -> xr.Dataset:
    """Laws in the worlds that were hard for those before them.

    Args:
      laws: parameters of any strategies, by names of one's own.
      out: run folder, in which a run that was killed is continued; None keeps all in memory.
      worlds: how many of them, by default all 200.
      setting: physics, engine and rules.
      slots: worlds stepped at once by a worker; by default as suits engine and device.
      workers: host threads; by default as suits engine and device.
      report: called after every segment of the run.

    Returns:
      Outcomes (arm, world), and as `known_success` and `known_severity` (law, world) those of the
      laws of the file.

    Raises:
      InputError: an argument is not allowed, or `out` holds another run.

    Example:
      >>> import rps_jax
      >>> brief = rps_jax.Setting(rules=rps_jax.Rules(horizon=1.0), engine="quasistatic")
      >>> mine = {"mine": rps_jax.RPSParams.paper()}
      >>> found = rps_jax.regress(mine, worlds=3, setting=brief)
      >>> dict(found.known_success.sizes)
      {'law': 4, 'world': 3}
    """
    plan = plan_of(laws, setting, worlds)
    plan.check_here()
    shape = {"slots": slots, "workers": workers, "report": report}
    return beside(sweep.whole(plan, None if out is None else Path(out), **shape))


def beside(results: xr.Dataset) -> xr.Dataset:
    """Results with those of the laws of the file."""
    known = worlds().isel(world=slice(results.sizes["world"]))
    return results.assign(
        known_success=(("law", "world"), known.success.values),
        known_severity=(("law", "world"), known.severity.values),
    ).assign_coords(law=known.law.values)


def table(found: xr.Dataset) -> list[list[str]]:
    """Header and a row for each new law: what it gains and loses against each of the file's."""
    known = [str(law) for law in found.law.values]
    rows = [["", "wins", *(f"against {law}" for law in known), "wins what none of them does"]]
    for law in known:
        won = int((found.known_success.sel(law=law) > 0).sum())
        rows.append([f"{law} (file)", f"{won} of {found.sizes['world']}", *[""] * len(known), ""])
    best = (found.known_success.values > 0).any(axis=0)
    for arm in map(str, found.arm.values):
        won = found.success.sel(arm=arm).values > 0
        cells = []
        for law in known:
            before = found.known_success.sel(law=law).values > 0
            cells.append(f"+{int((won & ~before).sum())} -{int((~won & before).sum())}")
        rows.append([arm, f"{int(won.sum())} of {won.size}", *cells, str(int((won & ~best).sum()))])
    return rows


def changes(found: xr.Dataset, arm: str, law: str, rules: Rules = Rules()) -> list[list[str]]:
    """Header and a row for each world whose outcome an arm changes, the worst losses first."""
    now = severity_of(found.sel(arm=arm), rules)
    before = found.known_severity.sel(law=law).values
    rows = [["world", "object", law, arm]]
    names = [str(name) for name in found.object.values]
    for world in np.argsort(before - now, kind="stable"):
        if (now[world] < 1) != (before[world] < 1):
            thing = names[int(found.which_object[world])].replace("_", " ")
            rows.append([str(world), thing, _told(float(before[world])), _told(float(now[world]))])
    return rows


def _told(severity: float) -> str:
    return "wins" if severity < 1 else f"fails, {100 * (severity - 1):.0f} cm off"


def chosen(
    domain: Domain, u: np.ndarray, severity: np.ndarray, count: int, first: np.ndarray
) -> np.ndarray:
    """Indices (count,) of instructive and different worlds.

    All of `first` come in; then, again and again, the world that is farthest from those that are
    in. A distance is that of the ranges' coordinates, and of the laws' severities, up to 2.

    Args:
      domain: whose points they are.
      u: points (n, q).
      severity: (laws, n) of each law.
      count: how many.
      first: indices that come in anyway.
    """
    kinds = np.array([one.kind for one in points.quantities(domain)])
    features = np.concatenate(
        [u[:, (kinds == "range") | (kinds == "choice")], 2 * np.minimum(severity, 2).T], axis=1
    )
    taken = list(map(int, first[:count])) or [int(severity.max(axis=0).argmax())]
    near = np.min([np.linalg.norm(features - features[i], axis=1) for i in taken], axis=0)
    while len(taken) < min(count, len(u)):
        far = int(np.where(np.isin(np.arange(len(u)), taken), -1, near).argmax())
        taken.append(far)
        near = np.minimum(near, np.linalg.norm(features - features[far], axis=1))
    return np.array(taken)


def made(
    domain: Domain, u: np.ndarray, found: xr.Dataset, laws: list[str], rules: Rules = Rules()
) -> xr.Dataset:
    """The content of the file, from points and their outcomes (arm, world)."""
    severity = np.stack([severity_of(found.sel(arm=law), rules) for law in laws])
    success = np.stack([found.success.sel(arm=law).values for law in laws]).astype(np.int8)
    return (
        points.worlds_at(domain, u)[["u"]]
        .assign(success=(("law", "world"), success), severity=(("law", "world"), severity))
        .assign_coords(law=laws)
    )
