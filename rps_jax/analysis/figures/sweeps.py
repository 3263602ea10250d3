"""Figures of sweeps, by the drawn quantities, and of tuning runs, by generation."""

import textwrap
from collections.abc import Sequence
from functools import partial

import numpy as np
import xarray as xr
from matplotlib.artist import setp

from rps_jax.analysis import statistics
from rps_jax.analysis.figures.style import (
    WIDTH,
    Figure,
    axis_label,
    legend_above,
    styled,
    success_rates,
    tiles,
)
from rps_jax.analysis.statistics import Influence
from rps_jax.world.domain import LABELS

_LETTERS = 16  # in an inch of text


@styled
def success_curves(results: xr.Dataset, count: int = 6) -> Figure:
    """Draw success against the most influential drawn quantities, with a curve for each law.

    Quantities are in the order of the standard deviation of the success rate over their bins beyond
    binomial noise, in the law in which it is greatest. A quantity that is flat within the noise has
    no panel, unless all are flat. The text below names the other quantities: those whose bins
    differ nevertheless by a chi-squared test (q < 0.05, as of `statistics.influences`), and those
    that are flat. Intervals are Wilson's, of 95 %.
    """
    influences = statistics.influences(results)
    shown = [x for x in influences[:count] if x.variance > 0 and not _is_flat(x)]
    shown = shown or influences[:1]
    rest = [x for x in influences if x not in shown]
    columns = min(3, len(shown))
    width = WIDTH / max(columns, 2)  # [in] of a panel
    title = f"Success against {len(shown)} of {len(influences)} drawn quantities"
    parts = {
        "Order": "standard deviation of success over the bins beyond binomial noise, in the law in "
        "which it is greatest",
        "Less influential": _names([x for x in rest if not _is_flat(x)], spread=True),
        "Flat within the noise": _names([x for x in rest if _is_flat(x)]),
    }
    fill = partial(textwrap.fill, width=int(_LETTERS * columns * width), break_on_hyphens=False)
    caption = "\n".join(fill(f"{k}: {v}.") for k, v in parts.items() if v)
    laws = results.law.values.tolist()
    lines = len(caption.splitlines()) + len(laws) / columns + 4
    figure, axes = tiles(len(shown), columns, (width, 1.9), (0, 0.14 * lines), sharey=True)
    for ax, influence in zip(axes.ravel(), shown, strict=False):
        values = results[influence.name]
        # A cylinder has no corners; a line to triangles would cross shapes that do not exist.
        unordered = influence.name == "corners"
        for i, law in enumerate(laws):
            bins = statistics.bins(values.values, results.success.sel(law=law).values > 0)
            style = {"color": f"C{i}", "label": law, "ls": "none" if unordered else "-"}
            success_rates(ax, *bins, curve=i, **style)
        if unordered:
            counts = np.unique(values)
            ax.set_xticks(counts, [f"{n:g}" if n else "round" for n in counts])
        else:
            ax.locator_params(axis="x", nbins=5)
        ax.set_xlabel(axis_label(influence.name, values.attrs["units"]))
        chance = " (may be chance)" * _is_flat(influence)
        ax.set_title(f"spread {_spread(influence)}, q = {influence.q:.1g}{chance}")
        ax.grid(alpha=0.3)
    setp(axes[:, 0].tolist(), ylabel="success [%]")
    axes[0, 0].set_ylim(top=103)
    handles, names = axes[0, 0].get_legend_handles_labels()
    legend = {"ncols": columns, "frameon": False, "alignment": "left"}
    figure.legend(handles, names, title=title, loc="outside upper left", **legend)
    figure.supxlabel(caption, x=0.01, ha="left")
    return figure


def _is_flat(influence: Influence) -> bool:
    return influence.q >= 0.05


def _spread(influence: Influence) -> str:
    return f"{100 * max(influence.variance, 0) ** 0.5:.1f} %"


def _names(influences: Sequence[Influence], *, spread: bool = False) -> str:
    """Return the quantities in words without line breaks."""
    names = (LABELS[x.name] + f" ({_spread(x)})" * spread for x in influences)
    return ", ".join(name.replace(" ", "\N{NO-BREAK SPACE}") for name in names)


@styled
def search(results: xr.Dataset) -> Figure:
    """Draw a search by generation: objective of candidates, validation and 24 parameters."""
    generation, names = results.generation.values, results.parameter.values.tolist()[:24]
    units = results.unit.values.tolist() if "unit" in results.coords else [""] * len(names)

    columns = 4
    rows = 1 + -(-len(names) // columns)
    figure = Figure(figsize=(WIDTH, 2.2 + 1.25 * (rows - 1)), layout="constrained")
    grid = figure.add_gridspec(rows, columns, height_ratios=[1.6] + [1] * (rows - 1))
    ax = figure.add_subplot(grid[0, :2])
    mean, spread = results["mean"].values, results["spread"].values
    ax.fill_between(generation, mean - spread, mean + spread, alpha=0.2, lw=0)
    ax.plot(generation, mean, label="candidates: mean and spread")
    ax.plot(generation, results.best.values, label="best candidate")
    ax.plot(generation, results.base.values, "k--", lw=1, label="start, same worlds")
    ax.set(xlabel="generation", ylabel="objective [1]")
    legend_above(ax, columns=1)
    for column, values, label in (
        (2, results.validation.values, "objective [1]"),
        (3, 100 * results.validation_success.values, "success [%]"),
    ):
        ax = figure.add_subplot(grid[0, column])
        ax.plot(generation, values, "C2")
        ax.set(xlabel="generation", ylabel=label, title="validation")
    for i, (name, unit) in enumerate(zip(names, units, strict=False)):
        ax = figure.add_subplot(grid[1 + i // columns, i % columns])
        ax.plot(generation, results.params.values[:, i])
        ax.set_title(f"{name} [{unit}]" if unit else name)
        if i + columns >= len(names):
            ax.set_xlabel("generation")
    for ax in figure.axes:
        ax.locator_params("x", integer=True)
    return figure
