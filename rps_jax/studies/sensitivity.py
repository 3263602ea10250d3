"""Which quantity is to blame? Sobol indices of first and total order (SALib).

The first-order index of a quantity is the share of the outcome's variance that it explains alone,
the total index the share that goes when it alone is no longer varied, with all its interactions.
Noise and the corners of prisms are one factor each: what they explain together. An outcome that is
chaotic in a quantity has a large total index of it and a small first one.

The blocks of Saltelli's design are worlds at points of the unit cube, and their trials a sweep.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Any, ClassVar

import numpy as np
import xarray as xr
from matplotlib.axis import Axis

from rps_jax import errors
from rps_jax.analysis import statistics
from rps_jax.analysis.figures.style import Figure
from rps_jax.analysis.report import Picture, Section
from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.record.options import option
from rps_jax.runs.plan import Plan
from rps_jax.runs.question import (
    DomainQuestion,
    LawQuestion,
    Run,
    call_of,
    count_true,
    name_or_custom,
    seed_of,
)
from rps_jax.runs.sweep import PlanQuestion
from rps_jax.world import points
from rps_jax.world.domain import WORDS

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
MIN_FAILING_POINTS = 30  # base points at which a trial fails, for indices that mean something


@dataclass(frozen=True)
class Sensitivity(PlanQuestion, DomainQuestion[xr.Dataset], LawQuestion[xr.Dataset]):
    """Share the blame for failures among all quantities that are drawn, by Sobol indices.

    The answer holds `first`, `total` and the half widths `first_reach`, `total_reach` of their
    intervals of 95 % (output, factor), and outcomes (world) with the points `u` (world, quantity).

    Example:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=1.0)
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> found = rps_jax.sensitivity("rps", drums, 128, setting=setting)
      >>> found.total.dims
      ('output', 'factor')
    """

    TITLE: ClassVar[str] = "Sensitivity of success"
    QUICK: ClassVar[Mapping[str, Any]] = {"worlds": 256}

    worlds: int = option(1024, 1, 100_000_000)
    """Number of worlds, at most: a power of two for each quantity and two more."""
    apart: bool = False
    """Whether each number of the noise and of a prism's corners is a quantity of its own."""

    @functools.cached_property
    def groups(self) -> tuple[str, ...]:
        """The factor of each quantity (q,)."""
        every = points.quantities(self.ranges)
        return tuple(x.name if self.apart else _TOGETHER.get(x.kind, x.name) for x in every)

    @property
    def factors(self) -> tuple[str, ...]:
        """What shares the blame."""
        return tuple(dict.fromkeys(self.groups))

    @property
    def base(self) -> int:
        """Number N of base points, a power of 2; Saltelli's design has N (factors + 2) worlds."""
        count = len(self.factors)
        if self.worlds < 4 * (count + 2):
            raise InputError(
                f"worlds = {self.worlds} is not allowed: {count} quantities need at least "
                f"{4 * (count + 2)}."
            )
        return 2 ** int(np.log2(self.worlds / (count + 2)))

    @property
    def seeded(self) -> int:
        """Seed of the design, and one less than that of the intervals."""
        return seed_of(self.setting.seed, "tune")

    @property
    def problem(self) -> dict[str, Any]:
        """The problem as SALib has it."""
        names = list(points.names(self.ranges))
        bounds = [[0.0, 1.0]] * len(names)
        return {
            "num_vars": len(names), "names": names, "bounds": bounds, "groups": list(self.groups)
        }  # fmt: skip

    def u(self) -> np.ndarray:
        """The points (worlds, q) of the design, block by block of one base point."""
        sample = errors.require("SALib.sample.sobol", "failures").sample
        values = sample(self.problem, self.base, calc_second_order=False, seed=self.seeded)
        return np.clip(values, 0, np.nextafter(1, 0))

    @functools.cached_property
    def plan(self) -> Plan:
        """The sweep of the design."""
        at = points.checked(self.ranges, self.u())
        return Plan(self.ranges, len(at.u), {"law": self.params}, self.setting, points=at)

    def answer(self, run: Run) -> xr.Dataset:
        found = analyze(self, super().answer(run))
        if run.folder is not None:
            files.write_results(run.folder / "sobol.nc", found)
        return found

    def intro(self, results: xr.Dataset) -> str:
        each = f"{self.base} for each of {len(self.factors)} quantities and two more"
        return (
            f"{self.label} in the domain {name_or_custom(self.domain)}: {self.plan.worlds:,} "
            f"worlds, {each}; {count_true(results.success.values == 0)} fail."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        order = rank_factors(results)
        said = {one: factor_words(one) for one in order}
        drawn = [one for one in order if one in results.quantity.values][:5]
        failed = results.success.values == 0
        where = f"{self.label}, {name_or_custom(self.domain)}"
        title = f"{where}: failures over pairs, {failed.size:,} worlds"
        kinds = [one.removeprefix("random_") for one in self.ranges.objects]
        u, names = results.u.sel(quantity=drawn).values, [said[one] for one in drawn]
        pairs = partial(interactions, u, failed, names, {factor_words("object"): kinds}, title)
        text = (
            "The first index is the share of the variance that a quantity explains alone, the "
            "total one what goes with it and all its interactions; noise and the corners of "
            "prisms are one quantity each. Intervals are bootstrapped, of 95 %. "
            f"{reliability(results)}"
        )
        indices = Picture("sobol", partial(indices_figure, results, said))
        maps = Picture("interactions", pairs)
        return [
            Section("Which quantity is to blame", text, index_table(results), indices),
            Section("Interactions of the first five", "", (), maps),
        ]


sensitivity = call_of(Sensitivity)


def analyze(asked: Sensitivity, results: xr.Dataset) -> xr.Dataset:
    """Indices of a design whose sweep is done."""
    analyze = errors.require("SALib.analyze.sobol", "failures").analyze
    one = results.sel(law="law")
    values = {
        "success": one.success.values.astype(float),
        "time": one.time.values.astype(float),
        "left": statistics.distance_left(one),
    }
    shape = (len(OUTPUTS), len(asked.factors))
    columns = {name: np.zeros(shape) for name in ("first", "first_reach", "total", "total_reach")}
    for i, name in enumerate(OUTPUTS):
        if np.ptp(values[name]) == 0:
            continue  # nothing varies, and nothing explains it
        told = analyze(
            asked.problem, values[name], calc_second_order=False, seed=asked.seeded + 1,
            num_resamples=200,
        )  # fmt: skip
        for column, key in zip(columns, ("S1", "S1_conf", "ST", "ST_conf"), strict=True):
            columns[column][i] = told[key]
    found: dict[str, Any] = {name: (("output", "factor"), v) for name, v in columns.items()}
    found["u"] = (("world", "quantity"), asked.u())
    found |= {name: ("world", v) for name, v in values.items()}
    coordinates = {
        "output": list(OUTPUTS),
        "factor": list(asked.factors),
        "quantity": list(points.names(asked.ranges)),
    }
    return xr.Dataset(found, coordinates, {"base": asked.base})


def rank_factors(found: xr.Dataset, output: str = "success") -> list[str]:
    """The factors, by their total index for an output, the greatest first."""
    total = found.total.sel(output=output)
    return [str(name) for name in total.factor.values[np.argsort(-total.values, kind="stable")]]


def index_table(found: xr.Dataset) -> list[list[str]]:
    """Header and a row for each factor, by the total index of success."""
    header = ["", *(f"{what}: {order}" for what in OUTPUTS for order in ("first", "total"))]
    rows = [header]
    for name in rank_factors(found):
        cells = []
        for what in OUTPUTS:
            one = found.sel(output=what, factor=name)
            cells += [f"{one.first:.2f} ± {one.first_reach:.2f}"]
            cells += [f"{one.total:.2f} ± {one.total_reach:.2f}"]
        rows.append([factor_words(name), *cells])
    return rows


def factor_words(name: str) -> str:
    """What a factor is."""
    return WORDS.get(name) or _WORDS.get(name, name.replace("_", " "))


def count_failing_points(found: xr.Dataset) -> int:
    """At how many base points the trial of either of the two base samples fails."""
    blocks = found.success.values.reshape(found.attrs["base"], -1)[:, [0, -1]]
    return int((blocks == 0).any(axis=1).sum())


def reliability(found: xr.Dataset) -> str:
    """Whether there are failures enough, in a sentence."""
    told = f"Trials fail at {count_failing_points(found)} of {found.attrs['base']} base points"
    if count_failing_points(found) < MIN_FAILING_POINTS:
        return f"{told}, too few for indices of success to mean anything: run more worlds."
    return f"{told}."


# --- figures -------------------------------------------------------------------------------

_BINS = 4  # of each range of a map of interactions


def indices_figure(found: xr.Dataset, order: Mapping[str, str]) -> Figure:
    """Indices of first and total order with their intervals, the greatest on top."""
    order = dict(list(order.items())[::-1])
    figure = Figure(figsize=(11, 1.4 + 0.24 * len(order)), layout="constrained")
    axes = figure.subplots(1, len(OUTPUTS), sharey=True)
    place = np.arange(len(order))
    for ax, (output, said) in zip(axes, OUTPUTS.items(), strict=True):
        one = found.sel(output=output, factor=list(order))
        for which, shift, colour in (("total", 0.15, "C3"), ("first", -0.15, "C0")):
            ax.errorbar(
                one[which], place + shift, xerr=one[f"{which}_reach"], fmt="o", ms=4,
                capsize=2, lw=1.2, color=colour, label=f"{which} order",
            )  # fmt: skip
        ax.axvline(0, color="0.6", lw=0.8)
        ax.set_xlim(-0.35, 1.35)  # what reaches beyond is not known at all
        ax.set_title(f"variance of {said}", fontsize=10)
        ax.set_xlabel("share of the variance [1]")
        ax.grid(axis="x", alpha=0.3)
    axes[0].set_yticks(place, list(order.values()), fontsize=8)
    axes[-1].legend(fontsize=8, loc="lower right")
    figure.suptitle(f"Sobol indices with intervals of 95 %, {found.sizes['world']:,} worlds")
    return figure


def interactions(
    u: np.ndarray,
    failed: np.ndarray,
    names: Sequence[str],
    choices: Mapping[str, Sequence[str]],
    title: str,
) -> Figure:
    """Failures (n,) at points `u` (n, k) over each pair of quantities, ranges in equal parts.

    `choices` has what is chosen from, of those that are no ranges, by their names in words.
    """
    count = len(names)
    figure = Figure(figsize=(1.5 + 2 * (count - 1), 1.6 + 1.8 * (count - 1)), layout="constrained")
    axes = figure.subplots(count - 1, count - 1, squeeze=False)
    bins = [len(choices[name]) if name in choices else _BINS for name in names]
    at = np.minimum((u * bins).astype(int), np.asarray(bins) - 1)
    rates, image = {}, None
    for i, j in combinations(range(count), 2):
        cell, shape = at[:, j] * bins[i] + at[:, i], (bins[j], bins[i])
        of = np.bincount(cell, minlength=bins[i] * bins[j])
        bad = np.bincount(cell, failed, minlength=bins[i] * bins[j])
        rates[i, j] = (100 * bad / np.maximum(of, 1)).reshape(shape)
    most = max(float(rate.max()) for rate in rates.values()) or 1.0
    for row in range(count - 1):
        for column in range(count - 1):
            ax = axes[row, column]
            if column > row:
                ax.axis("off")
                continue
            rate = rates[column, row + 1]
            image = ax.imshow(
                rate, origin="lower", vmin=0, vmax=most, cmap="magma_r", aspect="auto"
            )
            for (y, x), value in np.ndenumerate(rate):
                ink = "white" if value > 0.55 * most else "black"
                ax.text(x, y, f"{value:.0f}", ha="center", va="center", fontsize=7, color=ink)
            across, up = names[column], names[row + 1]
            below, left = row == count - 2, column == 0
            _mark(ax.xaxis, choices.get(across, ()) if below else ())
            _mark(ax.yaxis, choices.get(up, ()) if left else ())
            if below:
                ax.set_xlabel(across.replace(" of the ", "\nof the "), fontsize=8)
            if left:
                ax.set_ylabel(up.replace(" of the ", "\nof the "), fontsize=8)
    if image is not None:
        figure.colorbar(image, ax=axes, label="failures [%]", shrink=0.6)
    figure.suptitle(f"{title}\neach range from its low (left, below) to its high end", fontsize=10)
    return figure


def _mark(axis: Axis, choices: Sequence[str]) -> None:
    """The choices at their cells; no marks of a range."""
    axis.set_ticks(range(len(choices)), choices, fontsize=7)
