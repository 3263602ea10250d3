"""Sobol indices: attribution of failures to the drawn quantities (SALib).

The first-order index of a quantity is the share of the outcome's variance that it explains alone.
The total index is the share that vanishes when this quantity no longer varies, with all its
interactions. Noise and the corners of prisms are one factor each. If the outcome is chaotic in a
quantity, its total index is large and its first-order index small.

The design of Saltelli has blocks of worlds at points of the unit cube, which run as a sweep.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import ClassVar

import numpy as np
import xarray as xr

from rps_jax import errors
from rps_jax.analysis import statistics
from rps_jax.analysis.figures.style import (
    WIDTH,
    Figure,
    Normalize,
    ScalarMappable,
    quantity,
    styled,
    tiles,
)
from rps_jax.questions import LawQuestion, Picture, Plan, Run, Section, call_of, option
from rps_jax.runs.question import DomainQuestion, Rows, count_true
from rps_jax.runs.sweep import PlanQuestion
from rps_jax.world import points

OUTPUTS = {
    "success": "success",
    "time": "time until the trial's end",
    "left": "least distance to the target",
}
# Name of the factor that joins all quantities of a kind; the quantity "noise" is that of the skin.
_JOINT_FACTORS = {"shape": "shape", "path": "path", "noise": "key"}
MIN_FAILING_POINTS = 30  # base points with a failure that reliable indices need
# SALib's names of the indices and of the half widths of their intervals.
_INDICES = {"first": "S1", "first_reach": "S1_conf", "total": "ST", "total_reach": "ST_conf"}


@dataclass(frozen=True)
class Sensitivity(PlanQuestion, DomainQuestion[xr.Dataset], LawQuestion[xr.Dataset]):
    """Attribute failures to the drawn quantities (Sobol indices; needs SALib).

    The result has the indices `first` and `total` with the half widths `first_reach` and
    `total_reach` of their intervals of 95 % (output, factor), the outcomes (world), and the points
    `u` (world, quantity).

    Examples:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=1.0)
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> results = rps_jax.sensitivity("rps", drums, 128, setting=setting)
      >>> results.total.dims
      ('output', 'factor')
    """

    TITLE = "Sensitivity of success"
    QUICK: ClassVar = {"worlds": 256}

    worlds: int = option(1024, 1, 100_000_000)
    """Maximum number of worlds: a power of two times the number of factors plus two."""

    @functools.cached_property
    def groups(self) -> tuple[str, ...]:
        """Factor of each quantity (q,)."""
        quantities = points.coordinates(self.ranges)
        return tuple(_JOINT_FACTORS.get(x.kind, x.name) for x in quantities)

    @property
    def factors(self) -> tuple[str, ...]:
        """Factors to which the variance is attributed."""
        return tuple(dict.fromkeys(self.groups))

    @property
    def base(self) -> int:
        """Number N of base points, a power of 2; Saltelli's design has N (factors + 2) worlds."""
        count = len(self.factors)
        if self.worlds < 4 * (count + 2):
            rule = f"{count} quantities need at least {4 * (count + 2)}"
            raise errors.not_allowed("worlds", self.worlds, rule)
        return 2 ** int(np.log2(self.worlds / (count + 2)))

    @property
    def problem(self) -> dict[str, object]:
        """Problem in the format of SALib."""
        names, groups = list(points.names(self.ranges)), list(self.groups)
        bounds = [[0.0, 1.0]] * len(names)
        return {"num_vars": len(names), "names": names, "bounds": bounds, "groups": groups}

    def u(self) -> np.ndarray:
        """Return the points (worlds, q) of the design, block by block of one base point."""
        sample = errors.require("SALib.sample.sobol", "failures").sample
        values = sample(
            self.problem, self.base, calc_second_order=False, seed=3 * self.setting.seed
        )
        return np.clip(values, 0, np.nextafter(1, 0))

    @functools.cached_property
    def plan(self) -> Plan:
        """Sweep over the points of the design."""
        at = points.check_points(self.ranges, self.u())
        return Plan(self.ranges, len(at.u), {"law": self.params}, self.setting, points=at)

    def labelled(self, outcomes: xr.Dataset, run: Run) -> xr.Dataset:
        return super().labelled(analyze(self, outcomes), run)

    def intro(self, results: xr.Dataset) -> str:
        design = f"{self.base} for each of {len(self.factors)} factors and two more"
        return (
            f"{self.label} in the domain {self.worlds_in_words}: {self.plan.worlds:,} "
            f"worlds, {design}; {count_true(results.success.values == 0)} fail."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        names = [x for x in rank_factors(results) if x in results.quantity.values]
        objects = [name.removeprefix("random_") for name in self.ranges.objects]
        text = (
            "The first-order index is the share of the variance that a factor explains alone; the "
            "total index includes all its interactions. Noise and the corners of prisms are one "
            "factor each. Intervals are bootstrapped, of 95 %. "
            f"{reliability(results)}"
        )
        indices = Picture("sobol", partial(indices_figure, results))
        maps = Picture("interactions", partial(interactions, results, names[:5], objects))
        return [
            Section("Sobol indices", text, index_table(results), indices),
            Section("Interactions of the first five", "", (), maps),
        ]


sensitivity = call_of(Sensitivity)


def analyze(options: Sensitivity, sweep: xr.Dataset) -> xr.Dataset:
    """Compute the indices from the outcomes (law, world) of a design."""
    compute = errors.require("SALib.analyze.sobol", "failures").analyze
    trials = sweep.sel(law="law")
    outputs = {
        "success": trials.success.values.astype(float),
        "time": trials.time.values.astype(float),
        "left": statistics.distance_left(trials),
    }
    settings = {
        "calc_second_order": False,
        "num_resamples": 200,
        "seed": 3 * options.setting.seed + 1,
    }
    constant = dict.fromkeys(_INDICES.values(), np.zeros(len(options.factors)))
    indices = [
        compute(options.problem, y, **settings) if np.ptp(y) > 0 else constant
        for y in outputs.values()
    ]
    dims = ("output", "factor")
    return xr.Dataset(
        {
            **{name: (dims, [x[key] for x in indices]) for name, key in _INDICES.items()},
            "u": (("world", "quantity"), options.u()),
            **{name: ("world", values) for name, values in outputs.items()},
        },
        {
            "output": list(OUTPUTS),
            "factor": list(options.factors),
            "quantity": list(points.names(options.ranges)),
        },
        {"base": options.base},
    )


def rank_factors(results: xr.Dataset) -> list[str]:
    """Return the factors by their total index for success, the greatest first."""
    total = results.total.sel(output="success").to_series()
    return total.sort_values(ascending=False, kind="stable").index.tolist()


def index_table(results: xr.Dataset) -> Rows:
    """Return a row for each factor, by the total index for success."""
    columns = [(output, order) for output in OUTPUTS for order in ("first", "total")]
    rows = [["", *map(": ".join, columns)]]
    for factor in rank_factors(results):
        cells = []
        for output, order in columns:
            index = results.sel(output=output, factor=factor)
            cells.append(f"{index[order]:.2f} ± {index[f'{order}_reach']:.2f}")
        rows.append([quantity(factor), *cells])
    return rows


def reliability(results: xr.Dataset) -> str:
    """Say in a sentence whether there are enough failures for reliable indices."""
    # Base points at which the trial of one of the two base samples fails.
    blocks = results.success.values.reshape(results.attrs["base"], -1)[:, [0, -1]]
    count = count_true((blocks == 0).any(axis=1))
    warning = ", too few for reliable indices of success: run more worlds"
    end = warning if count < MIN_FAILING_POINTS else ""
    return f"Trials fail at {count} of {results.attrs['base']} base points{end}."


# --- figures -------------------------------------------------------------------------------

_BINS = 4  # of each range of a map of interactions


@styled
def indices_figure(results: xr.Dataset) -> Figure:
    """Draw the indices of first and total order with their intervals, the greatest on top."""
    factors = rank_factors(results)[::-1]
    figure = Figure(figsize=(WIDTH, 0.9 + 0.2 * len(factors)), layout="constrained")
    axes = figure.subplots(1, len(OUTPUTS), sharey=True)
    y = np.arange(len(factors))
    for ax, (output, words) in zip(axes, OUTPUTS.items(), strict=True):
        indices = results.sel(output=output, factor=factors)
        for order, shift, mark in (("total", 0.15, "C3o"), ("first", -0.15, "C0s")):
            reach = indices[f"{order}_reach"]
            style = {"ms": 3, "capsize": 1.5, "lw": 1, "label": f"{order} order"}
            ax.errorbar(indices[order], y + shift, xerr=reach, fmt=mark, **style)
        ax.axvline(0, color="0.6", lw=0.8)
        ax.set_xlim(-0.35, 1.35)  # an interval beyond these limits says nothing
        ax.set_title(f"variance of\n{words}")
        ax.set_xlabel("share of the variance [1]")
        ax.grid(axis="x", alpha=0.3)
    axes[0].set_yticks(y, list(map(quantity, factors)))
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=2)
    figure.suptitle(f"Sobol indices with intervals of 95 %, {results.sizes['world']:,} worlds")
    return figure


@styled
def interactions(results: xr.Dataset, quantities: Sequence[str], objects: Sequence[str]) -> Figure:
    """Draw the failures over each pair of some quantities; ranges have equal bins."""
    failed, rates = results.success.values == 0, {}
    for names in combinations(quantities, 2):
        bins = [len(objects) if name == "object" else _BINS for name in names]
        u = results.u.sel(quantity=list(names)).values.T
        count = partial(np.histogram2d, *u, bins, [(0, 1)] * 2)
        rates[names] = 100 * count(weights=failed)[0] / np.maximum(count()[0], 1)
    norm = Normalize(0, max(float(rate.max()) for rate in rates.values()) or 1.0)
    figure, axes = tiles(len(rates), 4, (WIDTH / 4 - 0.2, 1.6), (0.8, 0.3))
    for ax, (names, rate) in zip(axes.ravel(), rates.items(), strict=False):
        ax.imshow(rate, origin="lower", norm=norm, cmap="magma_r", aspect="auto")
        for axis, name in zip((ax.yaxis, ax.xaxis), names, strict=True):
            ticks = objects if name == "object" else ()
            axis.set_ticks(range(len(ticks)), ticks)
            axis.set_label_text(quantity(name).replace(" of the ", "\nof the "))
    figure.colorbar(ScalarMappable(norm, "magma_r"), ax=axes, label="failures [%]", shrink=0.6)
    figure.suptitle("each range from its low end (left, bottom) to its high end")
    return figure
