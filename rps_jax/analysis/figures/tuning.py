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
    ax = figure.add_subplot(grid[0, 2:])
    ax.plot(generation, results.validation.values, "C2", label="objective")
    ax.margins(y=0.3)  # room for the legends
    ax.set(xlabel="generation", ylabel="mean on validation worlds [1]")
    ax.legend(loc="upper left", fontsize=8)
    twin = ax.twinx()
    twin.plot(generation, 100 * results.validation_success.values, "C3", label="success")
    twin.margins(y=0.3)
    twin.set_ylabel("success [%]")
    twin.legend(loc="upper right", fontsize=8)
    for i, name in enumerate(names):
        ax = figure.add_subplot(grid[1 + i // columns, i % columns])
        ax.plot(generation, results.params.values[:, i])
        ax.set_title(str(name), fontsize=9)
        ax.tick_params(labelsize=7)
    return figure
