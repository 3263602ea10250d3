"""Figures of studies: success over tolerances and parameters, speeds, and what they gain."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from rps_jax.analysis.figures.style import OBJECT_COLOURS, Figure, success_rates, words


def tolerance_curve(curve: xr.Dataset, trials: int) -> Figure:
    """Success of RPS, and time without contact, over skin tolerance.

    A column for each behaviour on loss of contact, which `what` puts into words; `curve` has, by
    (loss, tolerance, object), the mean time `lost`, and how many of `trials` were `won`.
    """
    columns = curve.sizes["loss"]
    figure = Figure(figsize=(4 * columns, 5), layout="constrained")
    axes = figure.subplots(2, columns, squeeze=False, sharex=True, sharey="row")
    x = curve.tolerance.values
    for (above, below), loss in zip(axes.T, map(str, curve.loss.values), strict=True):
        for i, name in enumerate(map(str, curve.object.values)):
            one = curve.sel(loss=loss, object=name)
            style: dict[str, Any] = {"color": OBJECT_COLOURS[name], "label": words(name)}
            beside = x + 0.15 * (i - 1)  # where curves coincide
            success_rates(above, beside, one.won.values, np.full(len(x), trials), **style)
            below.plot(beside, one.lost.values, "o-", ms=4, lw=1.2, **style)
        above.set_title(f"on loss: {curve.what.sel(loss=loss).item()}", fontsize=9)
        above.set_ylim(-3, 103)
        below.set_xlabel("skin tolerance [mm]")
        for ax in (above, below):
            ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("success [%]")
    axes[1, 0].set_ylabel("mean time without contact [s]")
    axes[0, -1].legend(fontsize=8)
    return figure


def throughput(speeds: Iterable[tuple[str, str, int, float]], steady: Collection[str]) -> Figure:
    """Simulated seconds per second over the batch, a panel for each family.

    `speeds` has rows of a family, a program, its worlds, and its speed; a program of `steady` has
    one speed whatever the batch, and is drawn as a level line.
    """
    found: dict[str, dict[str, list[tuple[int, float]]]] = {}
    for family, name, worlds, rate in speeds:
        found.setdefault(family, {}).setdefault(name, []).append((worlds, rate))
    figure = Figure(figsize=(4.5 * len(found), 4.0), layout="constrained")
    axes = figure.subplots(1, len(found), squeeze=False, sharey=True)[0]
    for ax, (family, programs) in zip(axes, found.items(), strict=True):
        for i, (name, points) in enumerate(programs.items()):
            if name in steady:
                ax.axhline(points[0][1], color=f"C{i}", ls="--", label=name)
            else:
                ax.plot(*zip(*points, strict=True), marker="o", color=f"C{i}", label=name)
        ax.set(xscale="log", yscale="log", xlabel="worlds in the batch", title=words(family))
        ax.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("simulated s per s")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def levers(gains: Mapping[str, float], title: str) -> Figure:
    """How many times as fast each lever makes a program, as bars from 1."""
    figure = Figure(figsize=(7.0, 1.2 + 0.28 * len(gains)), layout="constrained")
    ax = figure.subplots()
    times = np.array(list(gains.values()))
    rows = np.arange(len(gains))
    ax.barh(rows, times - 1, left=1, color=np.where(times >= 1, "C0", "C1"))
    for row, t in zip(rows, times, strict=True):
        ax.annotate(
            f"{t:.2f}", (t, row), (3 if t >= 1 else -3, 0), textcoords="offset points",
            va="center", ha="left" if t >= 1 else "right", fontsize=8,
        )  # fmt: skip
    ax.axvline(1, color="k", lw=0.8)
    ax.set_yticks(rows, list(gains))
    ax.invert_yaxis()
    ax.set(xscale="log", xlabel="times as fast", title=title)
    ax.margins(x=0.15)
    low, high = ax.get_xlim()
    ticks = [t for t in (0.1, 0.2, 0.3, 0.5, 0.7, 1, 1.5, 2, 3, 5, 7, 10, 20) if low <= t <= high]
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    ax.minorticks_off()
    ax.grid(alpha=0.3, axis="x")
    ax.set_axisbelow(True)
    return figure


def sensitivity(results: xr.Dataset, log: Collection[str]) -> Figure:
    """Success against each parameter alone, those of `log` on a logarithmic axis.

    Intervals are Wilson's, of 95 %.
    """
    names = list(map(str, results.parameter.values))
    rows = -(-len(names) // 4)
    figure = Figure(figsize=(12, 2.5 * rows), layout="constrained")
    axes = figure.subplots(rows, 4, squeeze=False, sharey=True).ravel()
    for ax in axes[len(names) :]:
        ax.axis("off")
    of = int(results.attrs["worlds"])
    for ax, name in zip(axes, names, strict=False):
        for i, which in enumerate(map(str, results.set.values)):
            one = results.sel(set=which, parameter=name)
            won = np.round(one.success.values * of).astype(int)
            success_rates(
                ax,
                one.value.values,
                won,
                np.full(won.size, of),
                beside=i,
                color=f"C{i}",
                label=which,
            )
        ax.set_xlabel(name, fontsize=9)
        ax.grid(alpha=0.3)
        if name in log:
            ax.set_xscale("log")
    for ax in axes[::4]:
        ax.set_ylabel("success [%]")
    axes[0].legend(fontsize=8)
    return figure
