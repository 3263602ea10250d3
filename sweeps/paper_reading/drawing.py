"""Figures of the inference: posterior, predictions of each number, and Fig. 6."""

from __future__ import annotations

import numpy as np
import xarray as xr

from rps_jax.analysis.figures.style import Figure, shade
from sweeps.paper_reading import evidence
from sweeps.paper_reading.printed import PRINTED
from sweeps.paper_reading.unknowns import NAMES, UNKNOWNS

_COLOURS = {"prior": "0.75", "posterior": "C0", "left out": "C1"}
_LABELS = {"prior": "prior", "posterior": "posterior", "left out": "predicted from the others"}
_BINS = 8


def posterior(results: xr.Dataset) -> Figure:
    """Draw the posterior of every unknown over its prior; a dashed line marks the closest draw."""
    weights, at = evidence.normalised(evidence.log_weights(results)), evidence.closest(results)
    figure = Figure(figsize=(13, 9.5), layout="constrained")
    axes = figure.subplots(5, 6).flat
    for ax in axes[len(NAMES) :]:
        ax.set_axis_off()
    for ax, name in zip(axes, NAMES, strict=False):
        unknown, u = UNKNOWNS[name], results.u.sel(unknown=name).values
        count = len(unknown.choices) or _BINS
        shares, edges = np.histogram(u, count, (0, 1), weights=weights)
        ax.bar(edges[:-1], count * shares, 1 / count, align="edge", color="C0", ec="w", lw=0.5)
        ax.axhline(1, color="0.4", lw=1)
        ax.axvline(u[at], color="C3", ls="--", lw=1.2)
        ticks = (np.arange(count) + 0.5) / count if unknown.choices else np.array([0.0, 0.5, 1.0])
        words = unknown.choices or [f"{unknown.range.at(np.array(x)):.2g}" for x in ticks]
        ax.set_xticks(ticks, words, fontsize=7)
        ax.set(xlim=(0, 1), yticks=[])
        unit = "" if unknown.choices or unknown.unit == "1" else f" [{unknown.unit}]"
        ax.set_title(f"{unknown.part}:\n{unknown.label}{unit}", fontsize=7)
    return figure


def predictions(results: xr.Dataset) -> Figure:
    """Draw the paper's numbers beside their predictions: medians, 5 to 95 %."""
    predicted, at = evidence.predictions(results), evidence.closest(results)
    groups = {
        "D [m]": [n for n, x in PRINTED.items() if x.unit == "m"],
        "time [s]": [n for n, x in PRINTED.items() if x.unit == "s"],
        "share of successes [%]": [n for n, x in PRINTED.items() if x.trials > 1],
    }
    figure = Figure(figsize=(11, 8), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.6))
    places = grid[0, 0], grid[1, 0], grid[:, 1]
    for place, (title, names) in zip(places, groups.items(), strict=True):
        ax = figure.add_subplot(place)
        for row, name in enumerate(names):
            scale = 100 / PRINTED[name].trials if PRINTED[name].trials else 1.0
            for shift, (key, (low, middle, high)) in enumerate(predicted[name].items()):
                y, label = row + 0.2 * (shift - 1), _LABELS[key] if row == 0 else None
                ax.plot([scale * low, scale * high], [y, y], color=_COLOURS[key], lw=3, label=label)
                ax.plot(scale * middle, y, "|", color="k", ms=6)
            ours = scale * evidence.scaled(results, name)[at]
            ax.plot(
                ours, row, "o", mfc="w", color="C3", ms=5, label=None if row else "the closest draw"
            )
            ax.plot(scale * PRINTED[name].value, row, "k*", ms=9, label=None if row else "paper")
        ax.set_yticks(range(len(names)), [name.replace("hardware, ", "") for name in names])
        ax.tick_params(labelsize=8)
        ax.set_xlabel(title)
        ax.invert_yaxis()
        ax.grid(alpha=0.3)
    handles, labels = figure.axes[-1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=8)
    return figure


def figure_6(results: xr.Dataset) -> Figure:
    """Draw the paper's Fig. 6 from the closest draw: path, velocities, contact and its type."""
    figure = Figure(figsize=(11, 6), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1, 1.5))
    path = figure.add_subplot(grid[:, 0])
    x, y = results.qpos.values[:, :2].T
    path.plot(x, y, color="0.5", lw=1.5)
    path.plot(*results.p_world_contact.values.T, ".", color="C0", ms=2, label="contact")
    path.plot(*results.p_world_target.values, "k*", ms=11)
    path.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="path of the base")
    time, realigning = results.time.values, results.realigning.values > 0
    above, middle, below = (figure.add_subplot(grid[i, 1]) for i in range(3))
    for name, unit in (("v_x", "m/s"), ("v_y", "m/s"), ("omega", "rad/s")):
        above.plot(time, results[name], lw=1, label=f"{name} [{unit}]")
    middle.plot(time, results.l, lw=1, label="l [m]")
    middle.plot(time, results.a_r / 50, lw=1, label="a_r / 50")
    below.plot(time, results.contact_type, lw=1, label="contact: 0 none, 1 point, 2 line")
    for ax in (above, middle, below):
        shade(ax, time, realigning, "0.85")
        ax.legend(fontsize=7, loc="upper right")
        ax.grid(alpha=0.3)
    below.set_xlabel("time [s]; shaded: Realignment State")
    return figure
