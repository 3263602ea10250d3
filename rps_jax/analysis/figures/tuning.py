"""What a tuner did, and where it went."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rps_jax.analysis.figures.style import save


def tuning_log(log: Sequence[Mapping], names: Sequence[str], path: Path) -> Path:
    """Evolution, generation by generation: values, validation, and the mean's parameters."""
    generation = [line["generation"] for line in log]

    def of(key: str) -> np.ndarray:
        return np.array([np.nan if line[key] is None else line[key] for line in log], float)

    columns = 4
    rows = 1 + -(-len(names) // columns)
    figure = Figure(figsize=(11, 2.6 + 1.7 * (rows - 1)), layout="constrained")
    grid = figure.add_gridspec(rows, columns, height_ratios=[1.6] + [1] * (rows - 1))
    ax = figure.add_subplot(grid[0, :2])
    mean, spread = of("mean"), of("spread")
    ax.fill_between(generation, mean - spread, mean + spread, alpha=0.2, lw=0)
    ax.plot(generation, mean, label="candidates: mean, and their spread")
    ax.plot(generation, of("best"), label="best candidate")
    ax.plot(generation, of("base"), "k--", lw=1, label="parameters at the start, same worlds")
    ax.set(xlabel="generation", ylabel="objective [1]")
    ax.legend(fontsize=8)
    ax = figure.add_subplot(grid[0, 2:])
    ax.plot(generation, of("validation"), "C2", label="objective")
    ax.margins(y=0.3)  # room for the legends
    ax.set(xlabel="generation", ylabel="mean on validation worlds [1]")
    ax.legend(loc="upper left", fontsize=8)
    twin = ax.twinx()
    twin.plot(generation, 100 * of("validation_success"), "C3", label="success")
    twin.margins(y=0.3)
    twin.set_ylabel("success [%]")
    twin.legend(loc="upper right", fontsize=8)
    for i, name in enumerate(names):
        ax = figure.add_subplot(grid[1 + i // columns, i % columns])
        ax.plot(generation, [line["params"][name] for line in log])
        ax.set_title(name, fontsize=9)
        ax.tick_params(labelsize=7)
    return save(figure, path)


def races(runs: Mapping[str, Sequence[Mapping]], path: Path) -> Path:
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
    return save(figure, path)


def between_bounds(places: Mapping[str, np.ndarray], names: Sequence[str], path: Path) -> Path:
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
    return save(figure, path)


def estimates(
    horizons: Sequence[float],
    found: Mapping[str, tuple[np.ndarray, np.ndarray]],
    names: Sequence[str],
    path: Path,
) -> Path:
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
    return save(figure, path)


def learning_curve(curve: xr.Dataset, path: Path) -> Path:
    """How a law was learned: successes and rewards against both clocks, and the algorithm's state.

    The curves of single updates are drawn thin; thick ones are means over 1/40 of the run.
    """
    figure = Figure(figsize=(10, 5.6), layout="constrained")
    axes = figure.subplots(2, 2)
    minutes, simulated = curve.time.values / 60, curve.simulated.values / 3600
    width = max(1, curve.sizes["update"] // 40)

    def draw(ax: Axes, x: np.ndarray, name: str, scale: float, colour: str, label: str) -> None:
        values = scale * curve[name].values
        mean = curve[name].rolling(update=width, min_periods=1, center=True).mean().values
        ax.plot(x, values, color=colour, lw=0.6, alpha=0.35)
        ax.plot(x, scale * mean, color=colour, lw=1.6, label=label)

    judged = np.isfinite(curve.validation.values)
    clocks = (
        (minutes, "wall clock, with compilation [min]"),
        (simulated, "simulated time, summed over worlds [h]"),
    )
    for ax, (x, label) in zip(axes[0], clocks, strict=True):
        draw(ax, x, "success", 100, "C0", "trials that ended, with noise, at the level below")
        ax.plot(x, 100 * curve.level, "k:", lw=1, label="level of the curriculum")
        ax.plot(
            x[judged], 100 * curve.validation.values[judged], "C3o-", ms=4,
            label="validation: the domain itself, no noise",
        )  # fmt: skip
        ax.set(xlabel=label, ylabel="success, level [%]", ylim=(-3, 103))
        ax.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=7, loc="lower right")
    draw(axes[1, 0], minutes, "earned", 1, "C2", "rewards of a trial")
    axes[1, 0].set(xlabel=clocks[0][1], ylabel="rewards of a trial that ended [1]")
    axes[1, 0].grid(alpha=0.3)
    ax = axes[1, 1]
    ax.plot(simulated, curve.spread, label="standard deviation of the actions")
    ax.plot(simulated, 100 * curve.learning_rate, label="100 learning rates")
    ax.plot(simulated, curve.touching, label="share of decisions in contact")
    ax.set(xlabel=clocks[1][1], ylabel="[1]")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=7)
    return save(figure, path)
