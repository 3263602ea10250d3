"""Random worlds: what success depends on, how the law fails, and one law against another."""

import textwrap
from collections.abc import Sequence

import xarray as xr

from rps_jax.analysis import statistics
from rps_jax.analysis.figures.style import Figure, success_rates, tiles
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
    figure, axes = tiles(len(shown), 3, (3.5, 2.5), (1, 1.6), sharey=True)
    columns = axes.shape[1]
    for ax, one in zip(axes.ravel(), shown, strict=False):
        for i, law in enumerate(map(str, results.law.values)):
            won = results.success.sel(law=law).values > 0
            bins = statistics.bins(results[one.name].values, won)
            success_rates(
                ax, bins.middle, bins.successes, bins.trials, color=f"C{i}", label=law, beside=i
            )
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
