"""Tables of results: a header and rows of texts, and how they read in Markdown."""

import shlex
from collections.abc import Sequence
from itertools import combinations

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from rps_jax.analysis import statistics
from rps_jax.world import paper
from rps_jax.world.domain import WORDS


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A header and rows as a Markdown table whose columns line up."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = [
        "| " + " | ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) + " |"
        for row in rows
    ]
    rule = "|" + "|".join("-" * (w + 2) for w in widths) + "|"
    return "\n".join([lines[0], rule, *lines[1:]])


def table_ii(results: xr.Dataset) -> list[list[str]]:
    """Header and rows of Table II: successes with Wilson 95 % intervals in percent, and the
    paper's beside them."""
    trials = results.sizes["target"]
    targets = np.stack([results.target_x, results.target_y], axis=-1)
    whole = np.array_equal(targets, paper.TARGETS)
    columns = [(str(o), str(f)) for o in results.object.values for f in results.friction.values]
    rows = [["", "", *(f"{o} {f}" for o, f in columns), "all"]]
    for law in map(str, results.law.values):
        success = results.success.sel(law=law)
        counts = [int(success.sel(object=o, friction=f).sum()) for o, f in columns]
        sizes = [trials] * len(columns)
        pairs = [*zip(counts, sizes, strict=True), (sum(counts), sum(sizes))]
        cells = [f"{n}/{of} {_percent(n, of)}" for n, of in pairs]
        rows.append([law.upper(), "ours", *cells])
        theirs = [paper.TABLE_II.get((law, o, f)) for o, f in columns]
        if whole and None not in theirs:
            theirs = [n for n in theirs if n is not None]
            pairs = [*zip(theirs, sizes, strict=True), (sum(theirs), sum(sizes))]
            rows.append(["", "paper", *(f"{n}/{of}" for n, of in pairs)])
    return rows


def _percent(successes: int, trials: int) -> str:
    low, high = statistics.wilson(successes, trials)
    return f"[{100 * low:.0f}, {100 * high:.0f}]"


def summary(results: xr.Dataset) -> str:
    """One line for each law: median time and D of the successes, losses, divergences."""
    lines = []
    for law in map(str, results.law.values):
        part = results.sel(law=law)
        won = part.success.values.astype(bool)
        line = f"{law.upper()}: {won.sum()} of {won.size} succeed"
        if won.any():
            time = part.time.values[won]
            line += (
                f", in a median of {np.median(time):.1f} s (longest {time.max():.1f} s), "
                f"D = {np.mean(part.mean_abs_l.values[won]):.3f} m"
            )
        lines.append(f"{line}; {int(part.diverged.sum())} diverged")
    return "\n".join(lines)


def success_table(results: xr.Dataset, max_lost: float) -> list[list[str]]:
    """Header and one row for each law: success by object, distance left, time, path, failures.

    The bound of the failures is exact; with several laws it holds for whichever is picked here.
    """
    groups = statistics.worlds_by_object(results)
    ways = [way for way in statistics.FAILURES if way != "stalled" or "stalled" in results]
    laws = results.sizes["law"]
    bound = "fails at most" + f" (best of {laws})" * (laws > 1)
    header = ["", *groups, "all", bound, "CVaR 5 % of distance"]
    header += ["median time", "median path", *ways]
    rows = [header]
    for law in map(str, results.law.values):
        one = results.sel(law=law)
        won = one.success.values > 0
        kinds = statistics.failure_modes(one, max_lost)
        rows.append(
            [
                law,
                *(_rate(won[mask]) for mask in groups.values()),
                _rate(won),
                _at_most(statistics.fails_at_most(int((~won).sum()), won.size, laws)),
                _cvar(statistics.distance_left(one)),
                f"{np.median(one.time.values[won]):.1f} s" if won.any() else "-",
                f"{np.median(one.path_length.values[won]):.2f} m" if won.any() else "-",
                *(str(int((kinds == i).sum())) for i in range(len(ways))),
            ]
        )
    return rows


def _cvar(left: np.ndarray) -> str:
    low, high = statistics.cvar_interval(left)
    ends = f"[{low:.2f}, {high:.2f}]" if np.isfinite(high) else "(too few worlds for an interval)"
    return f"{statistics.cvar(left):.2f} m {ends}"


def _at_most(bound: float) -> str:
    """An upper bound of a rate, with two digits where it is small."""
    return f"{100 * bound:.{0 if bound > 0.1 else 2 if bound > 0.001 else 4}f} %"


def models_table(results: xr.Dataset) -> list[list[str]]:
    """Header and one row for each law: its rate on every model, and from the least to the most.

    `model_success` is (model, law, world). The last column is the share of outcomes that are equal
    to the first model's, at the least.
    """
    success = results.model_success
    names = list(map(str, success.model.values))
    rows = [["", *names, "over all models", "outcomes equal to the first"]]
    for law in map(str, success.law.values):
        won = success.sel(law=law).values > 0
        rates = won.mean(axis=1)
        equal = 100 * (won == won[0]).mean(axis=1)[1:]
        least = f"{equal.min():.1f} % and more" if equal.size else "-"
        rows.append([law, *map(_rate, won), rate_range(rates), least])
    return rows


def _rate(won: np.ndarray) -> str:
    return share(int(won.sum()), won.size)


def percent(won: float, of: int = 1) -> str:
    """A rate in percent without its sign: all reports print rates by this, or by `share`."""
    return f"{100 * won / of:.{_digits(won, of)}f}"


def _digits(won: float, of: int) -> int:
    """Two above 99 %, and at both ends where a thousand trials and more can tell, else one."""
    return 2 if 0.99 < won / of < 1 or (of >= 1000 and not 0.01 < won / of < 0.99) else 1


def share(won: int, of: int) -> str:
    """A success rate with its Wilson 95 % interval."""
    if not of:
        return "-"
    ends = (f"{100 * end:.{_digits(won, of)}f}" for end in statistics.wilson(won, of))
    return f"{percent(won, of)} % [{', '.join(ends)}]"


def rate_range(rates: ArrayLike) -> str:
    """The least and the greatest of some rates, as models of the physics give them."""
    least, most = float(np.min(rates)), float(np.max(rates))
    digits = max(_digits(least, 1), _digits(most, 1))
    return f"{100 * least:.{digits}f} to {100 * most:.{digits}f} %"


def _p(value: float) -> str:
    """A p-value; one below the smallest number is not zero."""
    return f"{value:.2g}" if value > 0 else "< 1e-300"


def difference_table(results: xr.Dataset) -> list[list[str]]:
    """Header and one row for each pair of laws, world by world, with McNemar's exact test."""
    rows = [["second against first", "gained", "lost", "difference", "McNemar p"]]
    for first, second in combinations(map(str, results.law.values), 2):
        a, b = results.success.sel(law=first), results.success.sel(law=second)
        c = statistics.compare(a, b)
        share = f"{100 * (c.gained - c.lost) / a.size:+.2f} %"
        counts = str(c.gained), str(c.lost)
        rows.append([f"{second} against {first}", *counts, share, _p(c.p)])
    return rows


def against_table(results: xr.Dataset, reference: str) -> list[list[str]]:
    """Header and one row for each law: world by world against one of them, best first.

    The p-values of McNemar's exact test are adjusted for as many tests as there are laws (Holm).
    """
    base = results.success.sel(law=reference)
    names = [str(law) for law in results.law.values]
    names.sort(key=lambda law: -float(results.success.sel(law=law).mean()))
    others = [law for law in names if law != reference]
    found = {law: statistics.compare(base, results.success.sel(law=law)) for law in others}
    adjusted = dict(zip(others, statistics.holm([found[a].p for a in others]), strict=True))
    failed = int((base.values == 0).sum())
    wins = f"wins of the {failed} that {reference} loses"
    rows = [["", "success", f"against {reference}", "p (Holm)", wins]]
    for law in names:
        cells = ["", "", ""]
        if law != reference:
            c = found[law]
            share = 100 * (c.gained - c.lost) / base.size
            cells = [f"{share:+.2f} % (+{c.gained} -{c.lost})", _p(adjusted[law])]
            cells.append(str(c.gained))
        rows.append([law, _rate(results.success.sel(law=law).values > 0), *cells])
    return rows


def hardest_table(results: xr.Dataset, run: str, count: int = 10) -> list[list[str]]:
    """Header and one row for each of the hardest worlds, with the command that replays it."""
    names = [str(name) for name in results.object.values]
    laws = [str(law) for law in results.law.values]
    rows = [["world", "object", *laws, "mass", "friction", "target", "replay"]]
    for world in statistics.hardest(results, count):
        one = results.isel(world=world)
        x = float(one.distance), float(np.degrees(one.bearing))
        fails = next(law for law in laws if not int(one.success.sel(law=law)))
        rows.append(
            [
                str(int(world)),
                names[int(one.which_object)],
                *(_told(one.sel(law=law)) for law in laws),
                f"{float(one.mass):.1f} kg",
                f"{float(one.friction_ground):.2f}, {float(one.friction_robot):.2f}",
                f"{x[0]:.1f} m at {x[1]:.0f} deg",
                f"`rps replay {shlex.quote(run)} {int(world)} --law {shlex.quote(fails)}`",
            ]
        )
    return rows


def _told(trial: xr.Dataset) -> str:
    if int(trial.success):
        return f"{float(trial.time):.0f} s"
    distance = float(trial.min_distance)
    return f"fails, {100 * distance:.0f} cm off" if np.isfinite(distance) else "never touches"


def influence_table(results: xr.Dataset, law: str) -> list[list[str]]:
    """Header and one row for each quantity that was drawn: the law's worst and best bin.

    Those whose bins differ most come first: by a chi-squared test that all bins have one rate,
    false discoveries among the quantities held at 5 % (Benjamini-Hochberg) where q < 0.05.
    """
    won = results.success.sel(law=law).values > 0
    binned = {
        name: statistics.bins(results[name].values, won)
        for name in statistics.varied_quantities(results)
    }
    q = statistics.false_discovery([statistics.equal_rates_p(found) for found in binned.values()])
    rows = [["", "worst bin, about", "success", "best bin, about", "success", "q"]]
    for i in np.argsort(q, kind="stable"):
        name, found = list(binned.items())[i]
        order, unit = (
            np.argsort(found.successes / found.trials, kind="stable"),
            results[name].attrs["units"],
        )
        told = [f"{value:.3g} {unit}".removesuffix(" 1") for value in found.middle]
        ends = []
        for n in (order[0], order[-1]):
            ends += [told[n], share(int(found.successes[n]), int(found.trials[n]))]
        rows.append([WORDS[name], *ends, f"{q[i]:.2g}"])
    return rows
