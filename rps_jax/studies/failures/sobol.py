"""Which quantity is to blame? Sobol indices of first and total order (SALib).

The first-order index of a quantity is the share of the outcome's variance that it explains alone,
the total index the share that goes when it alone is no longer varied, with all its interactions.
Noise and the corners of prisms are one factor each: what they explain together. An outcome that is
chaotic in a quantity has a large total index of it and a small first one.

The blocks of Saltelli's design are worlds at points of the unit cube, and their trials a sweep.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from rps_jax import errors
from rps_jax.analysis import statistics
from rps_jax.control.strategies import Params
from rps_jax.errors import InputError
from rps_jax.runs import sweep
from rps_jax.runs.evaluate import seed_of
from rps_jax.runs.plan import Plan
from rps_jax.studies.failures.probe import need
from rps_jax.trials.setting import Report, Setting, unheard
from rps_jax.world import points
from rps_jax.world.domain import Domain

OUTPUTS = {
    "success": "success",
    "time": "time until the trial's end",
    "left": "least distance to the target",
}
# Kinds of quantities that are one factor each, and its name: "noise" is a quantity, of the skin.
_TOGETHER = {"shape": "shape", "noise": "key"}
_WORDS = {
    "shape": "corners of prisms",
    "key": "key of all noise",
    "com_bearing": "bearing of the centre of mass",
}
_ENOUGH = 30  # base points at which a trial fails, for indices that mean something
_RESAMPLES = 1000
_NOTHING = 0.05  # [1] a total index that is not worth a word


@dataclass(frozen=True)
class Design:
    """The worlds of Saltelli's design in a domain."""

    domain: Domain
    base: int  # number N of base points, a power of 2; there are N (factors + 2) worlds
    factors: tuple[str, ...]
    groups: tuple[str, ...]  # (q,) the factor of each quantity
    seed: int = 0

    @property
    def worlds(self) -> int:
        """How many worlds there are."""
        return self.base * (len(self.factors) + 2)

    def problem(self) -> dict[str, Any]:
        """The same as SALib has it."""
        names = list(points.names(self.domain))
        bounds = [[0.0, 1.0]] * len(names)
        return {
            "num_vars": len(names), "names": names, "bounds": bounds, "groups": list(self.groups)
        }  # fmt: skip

    def u(self) -> np.ndarray:
        """The points (worlds, q), block by block of one base point."""
        sample = need("SALib.sample.sobol", "SALib").sample
        values = sample(self.problem(), self.base, calc_second_order=False, seed=self.seed)
        return np.clip(values, 0, np.nextafter(1, 0))


def design(domain: Domain, worlds: int, seed: int = 0, apart: bool = False) -> Design:
    """The greatest design of at most so many worlds.

    Args:
      domain: ranges of what differs between worlds.
      worlds: at most.
      seed: of the scrambling, of points of its own.
      apart: whether each number of the noise and of a prism's corners is a factor of its own.

    Raises:
      InputError: so few worlds have no design.
    """
    every = points.quantities(domain)
    groups = tuple(one.name if apart else _TOGETHER.get(one.kind, one.name) for one in every)
    factors = tuple(dict.fromkeys(groups))
    errors.check_count("worlds", worlds, at_most=100_000_000)
    least = 4 * (len(factors) + 2)
    if worlds < least:
        raise InputError(
            f"worlds = {worlds} is not allowed: {len(factors)} quantities need at least {least}."
        )
    base = 2 ** int(np.log2(worlds / (len(factors) + 2)))
    return Design(domain, base, factors, groups, seed_of(seed, "tune"))


def sensitivity(
    params: Params,
    domain: Domain | str = "wide",
    worlds: int = 1024,
    seed: int = 0,
    out: str | Path | None = None,
    *,
    apart: bool = False,
    setting: Setting = Setting(engine="fused"),
    slots: int | None = None,
    workers: int | None = None,
    report: Report = unheard,
) -> xr.Dataset:
    """Sobol indices of all that a domain draws, for success, time and least distance.

    Args:
      params: of any strategy.
      domain: ranges of what differs between worlds, or their name in `DOMAINS`.
      worlds: at most; a power of two for each factor and two more.
      seed: of the points, which are of no split.
      out: run folder, in which a run that was killed is continued; None keeps all in memory.
      apart: whether each number of the noise and of a prism's corners is a factor of its own.
      setting: physics, engine and rules.
      slots: worlds stepped at once by a worker; by default as suits engine and device.
      workers: host threads; by default as suits engine and device.
      report: called after every segment of the run.

    Returns:
      `first`, `total` and the half widths `first_reach`, `total_reach` of their intervals of 95 %
      (output, factor); outcomes (world) with the points `u` (world, quantity).

    Raises:
      InputError: an argument is not allowed, SALib is missing, or `out` holds another run.

    Example:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=1.0)
      >>> setting = rps_jax.Setting(rules=rules, engine="fused")
      >>> found = rps_jax.sensitivity(rps_jax.RPSParams.paper(), drums, 128, setting=setting)
      >>> found.total.dims
      ('output', 'factor')
    """
    chosen = points.named(domain)
    blocks = design(chosen, worlds, seed, apart)
    plan = plan_of(blocks, params, setting)
    plan.check_here()
    shape = {"slots": slots, "workers": workers, "report": report}
    results = sweep.whole(plan, None if out is None else Path(out), **shape)
    return analysed(blocks, results)


def plan_of(blocks: Design, params: Params, setting: Setting) -> Plan:
    """The sweep of a design."""
    at = points.checked(blocks.domain, blocks.u())
    return Plan(blocks.domain, blocks.worlds, {"law": params}, setting, points=at)


def analysed(blocks: Design, results: xr.Dataset) -> xr.Dataset:
    """Indices of a design whose sweep is done."""
    analyze = need("SALib.analyze.sobol", "SALib").analyze
    one = results.sel(arm="law")
    values = {
        "success": one.success.values.astype(float),
        "time": one.time.values.astype(float),
        "left": statistics.left_over(one),
    }
    shape = (len(OUTPUTS), len(blocks.factors))
    columns = {name: np.zeros(shape) for name in ("first", "first_reach", "total", "total_reach")}
    for i, name in enumerate(OUTPUTS):
        if np.ptp(values[name]) == 0:
            continue  # nothing varies, and nothing explains it
        told = analyze(
            blocks.problem(), values[name], calc_second_order=False, seed=blocks.seed + 1,
            num_resamples=200,
        )  # fmt: skip
        for column, key in (("first", "S1"), ("total", "ST")):
            columns[column][i] = told[key]
            columns[f"{column}_reach"][i] = told[f"{key}_conf"]
    found: dict[str, Any] = {name: (("output", "factor"), v) for name, v in columns.items()}
    found["u"] = (("world", "quantity"), blocks.u())
    found |= {name: ("world", v) for name, v in values.items()}
    coordinates = {
        "output": list(OUTPUTS),
        "factor": list(blocks.factors),
        "quantity": list(points.names(blocks.domain)),
    }
    return xr.Dataset(found, coordinates, {"base": blocks.base})


def ranked(found: xr.Dataset, output: str = "success") -> list[str]:
    """The factors, by their total index for an output, the greatest first."""
    total = found.total.sel(output=output)
    return [str(name) for name in total.factor.values[np.argsort(-total.values, kind="stable")]]


def table(found: xr.Dataset) -> list[list[str]]:
    """Header and a row for each factor, by the total index of success."""
    header = ["", *(f"{what}: {order}" for what in OUTPUTS for order in ("first", "total"))]
    rows = [header]
    for name in ranked(found):
        cells = []
        for what in OUTPUTS:
            one = found.sel(output=what, factor=name)
            cells += [f"{one.first:.2f} ± {one.first_reach:.2f}"]
            cells += [f"{one.total:.2f} ± {one.total_reach:.2f}"]
        rows.append([in_words(name), *cells])
    return rows


def in_words(name: str) -> str:
    """What a factor is."""
    return statistics.DRAWN.get(name) or _WORDS.get(name, name.replace("_", " "))


def failing(found: xr.Dataset) -> int:
    """At how many base points the trial of either of the two base samples fails."""
    blocks = found.success.values.reshape(found.attrs["base"], -1)[:, [0, -1]]
    return int((blocks == 0).any(axis=1).sum())


def reliable(found: xr.Dataset) -> str:
    """Whether there are failures enough, in a sentence."""
    told = f"Trials fail at {failing(found)} of {found.attrs['base']} base points"
    if failing(found) < _ENOUGH:
        return f"{told}, too few for indices of success to mean anything: run more worlds."
    return f"{told}."


def cost(found: xr.Dataset, name: str) -> tuple[float, float, float]:
    """Success in the upper third of a quantity's range less that in its lower third, with 95 %.

    The interval resamples base points, since the worlds of one differ in one factor only.
    """
    at = found.u.sel(quantity=name).values
    won = found.success.values
    high, low = at >= 2 / 3, at < 1 / 3
    blocks = np.arange(won.size) // (won.size // found.attrs["base"])
    sums = np.stack(
        [np.bincount(blocks, w, found.attrs["base"]) for w in (high * won, high, low * won, low)]
    )
    rng = np.random.default_rng(0)
    drawn = rng.integers(0, sums.shape[1], (_RESAMPLES, sums.shape[1]))
    a, b, c, d = sums[:, drawn].sum(axis=2)
    spread = a / np.maximum(b, 1) - c / np.maximum(d, 1)
    a, b, c, d = sums.sum(axis=1)
    ends = np.quantile(spread, [0.025, 0.975])
    return float(a / max(b, 1) - c / max(d, 1)), float(ends[0]), float(ends[1])


def said(found: xr.Dataset, name: str = "mass") -> str:
    """Whether a quantity costs success, in a sentence."""
    if name not in found.factor.values:
        return f"The domain draws no {name}."
    difference, low, high = (100 * value for value in cost(found, name))
    one = found.sel(output="success", factor=name)
    numbers = (
        f"between the lower and the upper third of its range success changes by {difference:+.1f} "
        f"points [{low:+.1f}, {high:+.1f}], and its total index is {one.total:.2f} ± "
        f"{one.total_reach:.2f}"
    )
    if high < 0:
        return f"More {name} costs success: {numbers}."
    if low > 0:
        return f"More {name} helps: {numbers}."
    if float(one.total - one.total_reach) > _NOTHING and failing(found) >= _ENOUGH:
        return f"On average {name} costs nothing, but together with others it matters: {numbers}."
    return f"No cost of {name} is seen in {found.sizes['world']:,} worlds: {numbers}."
