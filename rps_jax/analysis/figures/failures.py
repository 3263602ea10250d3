"""Where laws fail: Sobol indices, maps of interactions and of archives, levels of splitting."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axis import Axis
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure

from rps_jax.analysis import statistics
from rps_jax.analysis.figures.style import save, words

_BINS = 4  # of each range of a map of interactions


def _said(name: str) -> str:
    return statistics.DRAWN.get(name, words(name))


def sobol(
    found: xr.Dataset, order: Mapping[str, str], outputs: Mapping[str, str], path: Path
) -> Path:
    """Indices of first and total order with their intervals, the greatest on top.

    Args:
      found: what `sensitivity` returned.
      order: factors in words, by name, the greatest first.
      outputs: what is explained, in words.
      path: of the PNG.
    """
    order = dict(list(order.items())[::-1])
    figure = Figure(figsize=(11, 1.4 + 0.24 * len(order)), layout="constrained")
    axes = figure.subplots(1, len(outputs), sharey=True)
    place = np.arange(len(order))
    for ax, (output, said) in zip(axes, outputs.items(), strict=True):
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
    return save(figure, path)


def interactions(
    u: np.ndarray,
    failed: np.ndarray,
    names: Sequence[str],
    choices: Mapping[str, Sequence[str]],
    title: str,
    path: Path,
) -> Path:
    """Failures over each pair of quantities, their ranges in equal parts.

    Args:
      u: (n, k) coordinates of worlds in the unit cube.
      failed: (n,) 0 or 1.
      names: (k,) of the quantities, in words.
      choices: what is chosen from, of those that are no ranges, by their names in words.
      title: of the figure.
      path: of the PNG.
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
    return save(figure, path)


def _mark(axis: Axis, choices: Sequence[str]) -> None:
    """The choices at their cells; no marks of a range."""
    axis.set_ticks(range(len(choices)), choices, fontsize=7)


def archive(found: xr.Dataset, axes_: Sequence[str], title: str, path: Path) -> Path:
    """The margin by which a law failed: a row for each object, a column for each pair of axes.

    A cell shows the worst trial over the third axis; a cell with a dot has a failure.
    """
    pairs = list(combinations(axes_, 2))
    objects = [str(name) for name in found.object.values]
    figure = Figure(
        figsize=(1.5 + 3.4 * len(pairs), 1.2 + 2.7 * len(objects)), layout="constrained"
    )
    axes = figure.subplots(len(objects), len(pairs), squeeze=False)
    most = max(0.3, float(np.nanquantile(found.margin, 0.98)))
    norm, image = TwoSlopeNorm(0, -1, most), None
    for row, name in enumerate(objects):
        for ax, (x, y) in zip(axes[row], pairs, strict=True):
            other = next(one for one in axes_ if one not in (x, y))
            worst = found.margin.isel(object=row).max(other).transpose(y, x)
            image = ax.imshow(worst, origin="lower", norm=norm, cmap="RdBu_r", aspect="auto")
            ys, xs = np.nonzero(worst.values >= 0)
            ax.plot(xs, ys, "k.", ms=2)
            for axis, of in ((ax.xaxis, x), (ax.yaxis, y)):
                values = found[of].values
                some = np.linspace(0, values.size - 1, 4).round().astype(int)
                axis.set_ticks(some, [f"{values[i]:.2g}" for i in some], fontsize=7)
                unit = f" [{found[of].attrs['units']}]".removesuffix(" [1]")
                axis.set_label_text(f"{_said(of)}{unit}", fontsize=8)
            ax.set_facecolor("0.9")
            ax.set_title(words(name), fontsize=9)
    if image is not None:
        figure.colorbar(image, ax=axes, label="margin: severity - 1 [1; m beyond 0]", shrink=0.7)
    figure.suptitle(title, fontsize=10)
    return save(figure, path)


def search(found: xr.Dataset, drawn: float, path: Path) -> Path:
    """Failing cells over simulated time: of a search, and as many as `drawn` worlds would give.

    Args:
      found: what `attack` returned.
      drawn: failing cells of drawn worlds for each simulated hour.
      path: of the PNG.
    """
    figure = Figure(figsize=(5.5, 3.6), layout="constrained")
    ax = figure.subplots()
    hours = found.simulated.values / 3600
    ax.plot(hours, found.failing, "o-", ms=3, color="C3", label="search")
    ax.plot(hours, drawn * hours, "--", color="C0", label="drawn worlds, no cell twice")
    ax.set_xlabel("simulated time [h]")
    ax.set_ylabel("cells with a failure")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    return save(figure, path)


def splitting(found: xr.Dataset, brute: tuple[float, float, float] | None, path: Path) -> Path:
    """Estimates of every repetition with their intervals, and drawn worlds' behind them."""
    figure = Figure(figsize=(6.5, 3.4), layout="constrained")
    ax = figure.subplots()
    place = np.arange(found.sizes["repetition"])
    p = found.p.values
    errors = np.abs(np.stack([p - found.low.values, found.high.values - p]))
    ax.errorbar(place + 1, p, errors, fmt="o", ms=4, capsize=2, color="C3", label="splitting")
    if brute is not None:
        value, low, high = brute
        ax.axhspan(low, high, color="C0", alpha=0.2, lw=0)
        ax.axhline(value, color="C0", label="drawn worlds")
    if (p > 0).all():
        ax.set_yscale("log")
    ax.set_xlabel("repetition")
    ax.set_ylabel("probability of failure [1]")
    ax.grid(alpha=0.3, axis="y")
    ax.legend(fontsize=8)
    return save(figure, path)
