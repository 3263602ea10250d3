"""Figures of tuning runs."""

import xarray as xr

from rps_jax.analysis.figures.style import Figure


def search(results: xr.Dataset) -> Figure:
    """Draw a search by generation: objective of candidates, validation and parameters."""
    generation, names = results.generation.values, results.parameter.values

    columns = 4
    rows = 1 + -(-len(names) // columns)
    figure = Figure(figsize=(11, 2.6 + 1.7 * (rows - 1)), layout="constrained")
    grid = figure.add_gridspec(rows, columns, height_ratios=[1.6] + [1] * (rows - 1))
    ax = figure.add_subplot(grid[0, :2])
    mean, spread = results["mean"].values, results["spread"].values
    ax.fill_between(generation, mean - spread, mean + spread, alpha=0.2, lw=0)
    ax.plot(generation, mean, label="candidates: mean and spread")
    ax.plot(generation, results.best.values, label="best candidate")
    ax.plot(generation, results.base.values, "k--", lw=1, label="start, same worlds")
    ax.set(xlabel="generation", ylabel="objective [1]")
    ax.legend(fontsize=8)
    for column, values, label in (
        (2, results.validation.values, "mean on validation worlds [1]"),
        (3, 100 * results.validation_success.values, "success on validation worlds [%]"),
    ):
        ax = figure.add_subplot(grid[0, column])
        ax.plot(generation, values, "C2")
        ax.set(xlabel="generation", ylabel=label)
    for i, name in enumerate(names):
        ax = figure.add_subplot(grid[1 + i // columns, i % columns])
        ax.plot(generation, results.params.values[:, i])
        ax.set_title(str(name), fontsize=9)
        ax.tick_params(labelsize=7)
    return figure
