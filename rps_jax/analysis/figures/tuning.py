"""What a tuner did, and where it went."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from rps_jax.analysis.figures.style import Figure


def search(found: xr.Dataset) -> Figure:
    """Draw a search by generation: values of candidates, validation, and its parameters."""
    generation, names = found.generation.values, found.parameter.values

    columns = 4
    rows = 1 + -(-len(names) // columns)
    figure = Figure(figsize=(11, 2.6 + 1.7 * (rows - 1)), layout="constrained")
    grid = figure.add_gridspec(rows, columns, height_ratios=[1.6] + [1] * (rows - 1))
    ax = figure.add_subplot(grid[0, :2])
    mean, spread = found["mean"].values, found["spread"].values
    ax.fill_between(generation, mean - spread, mean + spread, alpha=0.2, lw=0)
    ax.plot(generation, mean, label="candidates: mean, and their spread")
    ax.plot(generation, found.best.values, label="best candidate")
    ax.plot(generation, found.base.values, "k--", lw=1, label="the start, in the same worlds")
    ax.set(xlabel="generation", ylabel="objective [1]")
    ax.legend(fontsize=8)
    ax = figure.add_subplot(grid[0, 2:])
    ax.plot(generation, found.validation.values, "C2", label="objective")
    ax.margins(y=0.3)  # room for the legends
    ax.set(xlabel="generation", ylabel="mean on validation worlds [1]")
    ax.legend(loc="upper left", fontsize=8)
    twin = ax.twinx()
    twin.plot(generation, 100 * found.validation_success.values, "C3", label="success")
    twin.margins(y=0.3)
    twin.set_ylabel("success [%]")
    twin.legend(loc="upper right", fontsize=8)
    for i, name in enumerate(names):
        ax = figure.add_subplot(grid[1 + i // columns, i % columns])
        ax.plot(generation, found.params.values[:, i])
        ax.set_title(str(name), fontsize=9)
        ax.tick_params(labelsize=7)
    return figure


def races(runs: Mapping[str, Sequence[Mapping]]) -> Figure:
    """Tuners' runs side by side: the best validation so far against what was simulated before it.

    A run that continues another is the sum of both logs.
    """
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    axes = figure.subplots(1, 2)
    for name, log in runs.items():
        simulated = np.cumsum([0.0] + [line["simulated"] for line in log[:-1]]) / 1e6
        value = np.array([line["validation"] for line in log], float)
        best = np.fmin.accumulate(value)
        success = np.array([line["validation_success"] for line in log], float)
        chosen = np.maximum.accumulate(np.where(value == best, np.arange(len(log)), 0))
        for ax, at in zip(axes, (best, 100 * success[chosen]), strict=True):
            ax.step(simulated, at, where="post", label=name)
    for ax, label in zip(axes, ("objective [1]", "success [%]"), strict=True):
        ax.set(xlabel="simulated [10$^6$ s]", ylabel=f"{label}, best mean so far")
    axes[0].legend(fontsize=8)
    return figure


def between_bounds(places: Mapping[str, np.ndarray], names: Sequence[str]) -> Figure:
    """Where sets of parameters (p,) lie between the bounds of tuning, from 0 to 1."""
    figure = Figure(figsize=(6, 0.8 + 0.27 * len(names)), layout="constrained")
    ax = figure.subplots()
    y = np.arange(len(names))[::-1]
    every = np.stack(list(places.values()))
    ax.hlines(y, every.min(axis=0), every.max(axis=0), color="0.7")
    for label, place in places.items():
        ax.plot(place, y, "o", label=label)
    ax.set_yticks(y, names)
    ax.set(xlim=(-0.02, 1.02), xlabel="place between the bounds of tuning [1]")
    ax.grid(alpha=0.3, axis="x")
    ax.legend(fontsize=8)
    return figure


def estimates(
    horizons: Sequence[float],
    found: Mapping[str, tuple[np.ndarray, np.ndarray]],
    names: Sequence[str],
) -> Figure:
    """Gradients (H, p) and their variances, by estimator, over horizons (H,) [s].

    Bars reach two standard errors to either side.
    """
    figure = Figure(figsize=(1 + 2.8 * len(names), 3.2), layout="constrained")
    axes = figure.subplots(1, len(names), squeeze=False)[0]
    for p, (ax, name) in enumerate(zip(axes, names, strict=True)):
        for i, (label, (gradient, variance)) in enumerate(found.items()):
            beside = np.asarray(horizons) * 1.06 ** (i - 1)
            errors = 2 * np.sqrt(variance[:, p])
            ax.errorbar(beside, gradient[:, p], errors, fmt="o", ms=4, capsize=2, label=label)
        ax.axhline(0, color="0.5", lw=0.8)
        ax.set(xscale="log", xlabel="horizon [s]", title=name)
        ax.set_xticks(horizons, [f"{h:g}" for h in horizons])
        ax.minorticks_off()
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("gradient [m]")
    axes[0].legend(fontsize=8)
    return figure
