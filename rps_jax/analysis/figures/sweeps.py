"""Random worlds: what success depends on, how the law fails, and one law against another."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np
import xarray as xr

from rps_jax.analysis import statistics
from rps_jax.analysis.figures.style import Figure, success_rates, words
from rps_jax.world.domain import WORDS


def success_curves(results: xr.Dataset, count: int = 6) -> Figure:
    """Success against the drawn quantities that matter first, one line a law.

    Of all quantities these have the greatest standard deviation of the success rate over their
    bins beyond what binomial noise explains, in the law in which it is greatest; one that is flat
    within the noise has no panel, unless all are. Below, the others are named: those whose bins
    differ nevertheless by a chi-squared test (q < 0.05, as of `statistics.influences`), and those
    that are flat. Intervals are Wilson's, of 95 %.
    """
    found = statistics.influences(results)
    shown = [one for one in found[:count] if one.variance > 0 and not _is_flat(one)] or found[:1]
    others = [one for one in found if one not in shown]
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    figure = Figure(figsize=(1 + 3.5 * columns, 1.6 + 2.5 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for ax in axes.ravel()[len(shown) :]:
        ax.axis("off")
    for ax, one in zip(axes.ravel(), shown, strict=False):
        for i, law in enumerate(map(str, results.law.values)):
            won = results.success.sel(law=law).values > 0
            bins = statistics.bins(results[one.name].values, won)
            success_rates(ax, bins.middle, bins.won, bins.of, color=f"C{i}", label=law, beside=i)
        unit = f" [{results[one.name].attrs['units']}]".removesuffix(" [1]")
        ax.set_xlabel(f"{WORDS[one.name]}{unit}", fontsize=9)
        chance = " (may be chance)" * _is_flat(one)
        ax.set_title(f"spread {_spread(one)}, q = {one.q:.1g}{chance}", fontsize=8)
        ax.grid(alpha=0.3)
    for ax in axes[:, 0]:
        ax.set_ylabel("success [%]")
    axes[0, 0].set_ylim(top=103)
    axes[0, 0].legend(fontsize=8)
    which = f"{len(shown)} of {len(found)} drawn quantities, those that matter first"
    title = f"Success against {which}: {_names(shown)}"
    figure.suptitle(_filled(title, 42 * columns), fontsize=10)
    parts = {
        "Chosen for their spread": "the greatest standard deviation of success over the bins "
        "beyond binomial noise, in the law in which it is greatest",
        "Weaker": _names([o for o in others if not _is_flat(o)], spread=True),
        "Flat within the noise": _names([o for o in others if _is_flat(o)]),
    }
    lines = (_filled(f"{k}: {v}.", 60 * columns) for k, v in parts.items() if v)
    figure.supxlabel("\n".join(lines), fontsize=8, x=0.01, ha="left")
    return figure


def _filled(text: str, width: int) -> str:
    return textwrap.fill(text, width, break_on_hyphens=False)


def _is_flat(one: statistics.Influence) -> bool:
    return one.q >= 0.05


def _spread(one: statistics.Influence) -> str:
    return f"{100 * max(one.variance, 0) ** 0.5:.1f} %"


def _names(found: Sequence[statistics.Influence], *, spread: bool = False) -> str:
    """Quantities in words, which no line break separates."""
    names = (WORDS[one.name] + f" ({_spread(one)})" * spread for one in found)
    return ", ".join(name.replace(" ", "\N{NO-BREAK SPACE}") for name in names)


def failures(results: xr.Dataset, max_lost: float) -> Figure:
    """Failures by their kind, a column for each object.

    Above, the share of its worlds that each law loses; below, how far from the target they end,
    over the object's width.
    """
    groups = statistics.worlds_by_object(results)
    laws = {str(name): results.sel(law=name) for name in results.law.values}
    kinds = {name: statistics.failure(one, max_lost) for name, one in laws.items()}
    figure = Figure(figsize=(1 + 2.8 * len(groups), 5.2), layout="constrained")
    axes = figure.subplots(2, len(groups), squeeze=False, sharey="row")
    most = 1.0
    for (above, below), (name, mask) in zip(axes.T, groups.items(), strict=True):
        under = np.zeros(len(laws))
        for i, kind in enumerate(statistics.FAILURES):
            share = np.array([100 * np.mean(found[mask] == i) for found in kinds.values()])
            above.bar(list(laws), share, bottom=under, color=f"C{i}", label=kind)
            under += share
            most = max(most, under.max())
            for marker, (law, one) in zip("ox+s", laws.items(), strict=False):
                here = mask & (kinds[law] == i)
                width, left = results["size"].values[here], statistics.left_over(one)[here]
                below.semilogy(width, left, marker, ms=4, color=f"C{i}")
        above.set_title(f"{words(name)}, {mask.sum()} worlds", fontsize=9)
        above.grid(alpha=0.3, axis="y")
        below.set_xlabel("half width of the object [m]")
        below.grid(alpha=0.3)
    axes[0, 0].set(ylabel="worlds lost [%]", ylim=(0, 1.08 * most))
    axes[0, -1].legend(fontsize=8)
    axes[1, 0].set_ylabel("least distance to the target [m]")
    marks = [f"{law}: {mark}" for mark, law in zip(("dot", "cross", "plus"), laws, strict=False)]
    axes[1, 0].set_title(", ".join(marks), fontsize=8)
    return figure


def paired(results: xr.Dataset) -> Figure:
    """Time of the second law over that of the first, world by world.

    Worlds that one law alone wins stand on the margin of the other, beyond the dashed line.
    """
    first, second = map(str, results.law.values)
    a, b = (results.sel(law=law) for law in (first, second))
    won_a, won_b = a.success.values > 0, b.success.values > 0
    edge = 1.02 * float(results.time.max())
    x, y = np.where(won_a, a.time, 1.03 * edge), np.where(won_b, b.time, 1.03 * edge)
    figure = Figure(figsize=(5.4, 5.2), layout="constrained")
    ax = figure.subplots()
    for label, mask, colour in (
        ("both", won_a & won_b, "C0"),
        (f"{first} alone", won_a & ~won_b, "C3"),
        (f"{second} alone", ~won_a & won_b, "C2"),
    ):
        ax.plot(x[mask], y[mask], ".", ms=4, color=colour, label=f"won by {label}: {mask.sum()}")
    ax.plot([0, edge], [0, edge], color="0.5", lw=0.8)
    ax.axvline(edge, color="0.5", lw=0.8, ls="--")
    ax.axhline(edge, color="0.5", lw=0.8, ls="--")
    neither = int(np.sum(~won_a & ~won_b))
    ax.set(xlabel=f"{first}: time to success [s]", ylabel=f"{second}: time to success [s]")
    ax.set_title(f"{won_a.size} worlds; won by neither: {neither}", fontsize=9)
    figure.legend(fontsize=8, loc="outside lower center", ncols=3)
    return figure
