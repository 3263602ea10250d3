"""Figures of tuning runs."""

import xarray as xr

from rps_jax.analysis.figures.style import WIDTH, Figure, legend_above, styled


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
