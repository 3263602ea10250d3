"""Tables of results: a header and rows of text cells, and their Markdown."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from rps_jax.analysis import statistics
from rps_jax.analysis.statistics import Comparison
from rps_jax.record import provenance
from rps_jax.world import paper, tasks


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """Format a header and rows as a Markdown table with aligned columns."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = [
        "| " + " | ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) + " |"
        for row in rows
    ]
    rule = "|" + "|".join("-" * (w + 2) for w in widths) + "|"
    return "\n".join([lines[0], rule, *lines[1:]])


def table_ii(results: xr.Dataset) -> list[list[str]]:
    """Return Table II: successes of a grid of targets, beside the paper's."""
    trials = results.sizes["target"]
    targets = np.stack([results.target_x, results.target_y], axis=-1)
    has_all_targets = np.array_equal(targets, paper.TARGETS)
    columns = [(str(o), str(f)) for o in results.object.values for f in results.friction.values]
    rows = [["", "", *(f"{o} {f}" for o, f in columns), "all"]]
    for law in map(str, results.law.values):
        success = results.success.sel(law=law)
        counts = [int(success.sel(object=o, friction=f).sum()) for o, f in columns]
        cells = [f"{n}/{size}" for n, size in _with_sum(counts, trials)]
        rows.append([law.upper(), "ours", *cells])
        in_paper = [paper.TABLE_II.get((law, o, f)) for o, f in columns]
        counts = [n for n in in_paper if n is not None]
        if has_all_targets and len(counts) == len(columns):
            rows.append(["", "paper", *(f"{n}/{size}" for n, size in _with_sum(counts, trials))])
    return rows


def grid_note(results: xr.Dataset) -> str:
    """Return a sentence on the independent trials of a grid of targets."""
    count = len(set(zip(results.target_x.values, abs(results.target_y).values, strict=True)))
    return (
        "The targets are a grid and no sample, so counts have no interval. With box and cylinder, "
        "targets to the left and to the right are mirror images: "
        f"{count} of {results.sizes['target']} are independent."
    )


def _with_sum(counts: Sequence[int], trials: int) -> list[tuple[int, int]]:
    """Return successes and trials of each cell, and their sums."""
    return [*((n, trials) for n in counts), (sum(counts), trials * len(counts))]


def interval(successes: int, trials: int) -> str:
    """Format the Wilson 95 % interval of a success rate, in percent."""
    low, high = statistics.wilson(successes, trials)
    return f"[{100 * low:.0f}, {100 * high:.0f}]"


def summary(results: xr.Dataset) -> str:
    """Return a line for each law: successes, their median time and D, and divergences."""
    lines = []
    for law in map(str, results.law.values):
        trials = results.sel(law=law)
        success = trials.success.values.astype(bool)
        line = f"{law.upper()}: {success.sum()} of {success.size} succeed"
        if success.any():
            time = trials.time.values[success]
            line += (
                f", in a median of {np.median(time):.1f} s (longest {time.max():.1f} s), "
                f"D = {np.mean(trials.mean_abs_l.values[success]):.3f} m"
            )
        lines.append(f"{line}; {int(trials.diverged.sum())} diverged")
    return "\n".join(lines)


def success_table(results: xr.Dataset, max_lost: float) -> list[list[str]]:
    """Return a row for each law: success by object, distance left, time, path and failures.

    The bound of the failure rate is exact. With several laws it holds for any one of them.
    """
    groups = statistics.worlds_by_object(results)
    recorded = {"stalled": "stalled", "contact not felt": "unfelt"}
    recorded |= {text: name for name, text in tasks.FAILURES.items()}
    modes = [mode for mode in statistics.modes() if recorded.get(mode, "success") in results]
    laws = results.sizes["law"]
    bound = "fails at most" + f" (best of {laws})" * (laws > 1)
    header = ["", *groups, "all", bound, "CVaR 5 % of distance"]
    medians = {"time": ("time", "{:.1f} s"), "path": ("path_length", "{:.2f} m")}
    if "repositions" in results and results.repositions.values.any():
        lost = {"time": "contact_lost_time", "path": "contact_lost_path"}
        medians |= {f"{x} without contact": (lost[x], medians[x][1]) for x in lost}
        medians["repositions"] = "repositions", "{:g}"
    header += [*(f"median {text}" for text in medians), *modes]
    rows = [header]
    for law in map(str, results.law.values):
        trials = results.sel(law=law)
        success = trials.success.values > 0
        mode_index = statistics.failure_modes(trials, max_lost)
        distance = statistics.distance_left(trials)
        low, high = statistics.cvar_interval(distance)
        known = high < np.inf
        interval = f"[{low:.2f}, {high:.2f}]" if known else "(too few worlds for an interval)"
        bound = statistics.fails_at_most(int((~success).sum()), success.size, laws)
        rows.append(
            [
                law,
                *(rate(success[mask]) for mask in groups.values()),
                rate(success),
                f"{100 * bound:.{0 if bound > 0.1 else 2 if bound > 0.001 else 4}f} %",
                f"{statistics.cvar(distance):.2f} m {interval}",
                *(median(trials[name].values[success], text) for name, text in medians.values()),
                *(str(int((mode_index == statistics.modes().index(mode)).sum())) for mode in modes),
            ]
        )
    return rows


def task_table(results: xr.Dataset) -> list[list[str]]:
    """Return a row for each outcome that the task adds: its values by law, and its meaning."""
    rows = [["", *map(str, results.law.values), "meaning"]]
    for name in (x for x in tasks.OUTCOMES if x in results and not x.endswith(("_x", "_y"))):
        spec = tasks.OUTCOMES[name]
        values = results[name].transpose("world", "law").to_pandas()  # whose quantiles skip NaN
        low, *middle, high = values.quantile([0.05, 0.5, 0.95]).round(3).to_numpy()
        spreads = zip(*middle, low, high, strict=True)
        cells = [
            f"{m:g}{f' {spec.unit}' * (spec.unit != '1')} [{a:g}, {b:g}]" for m, a, b in spreads
        ]
        if name in tasks.FAILURES:
            counts = [values[law][values[law] > 0].value_counts() for law in values]
            cells = [", ".join(f"{k:g}: {n}" for k, n in x.items()) or "none" for x in counts]
        rows.append([name.replace("_", " "), *cells, spec.about])
    return rows if len(rows) > 1 else []


def nan_table(results: xr.Dataset | xr.DataTree) -> list[list[str]]:
    """Return a row for each law that returned NaN or infinity, of results of trials by any axes."""
    rows = [["law", "trials that it ended", "first at"]]
    tree = xr.DataTree(results) if isinstance(results, xr.Dataset) else results
    for node in tree.subtree:
        if "nan_twist" not in node or not node.nan_twist.any():
            continue
        laws = node.get("law", xr.DataArray("the law"))
        is_nan, laws, time = (x.values for x in xr.broadcast(node.nan_twist > 0, laws, node.time))
        for law in np.unique(laws[is_nan]):
            mask = is_nan & (laws == law)
            count = f"{mask.sum()} of {(laws == law).sum()}"
            rows.append([str(law), count, f"{time[mask].min():.2f} s"])
    return rows


def models_table(results: xr.Dataset) -> list[list[str]]:
    """Return a row for each law: its success rate on every model, and the range of the rates.

    `model_success` is (model, law, world). The last column is the least share of outcomes that
    equal those on the first model.
    """
    success = results.model_success
    names = success.model.values.tolist()
    rows = [["", *names, "over all models", "outcomes equal to the first"]]
    for law in map(str, success.law.values):
        by_model = success.sel(law=law).values > 0
        rates = by_model.mean(axis=1)
        equal = 100 * (by_model == by_model[0]).mean(axis=1)[1:]
        least = f"{equal.min():.1f} % and more" if equal.size else "-"
        rows.append([law, *map(rate, by_model), rate_range(rates), least])
    return rows


def rate(success: np.ndarray) -> str:
    """Format the success rate of trials (...) bool with its Wilson 95 % interval."""
    return share(int(success.sum()), success.size)


def median(values: np.ndarray, form: str = "{:.1f} s") -> str:
    """Format the median of values (n,); "-" without any."""
    return form.format(np.median(values)) if values.size else "-"


def percent(successes: float, trials: int = 1) -> str:
    """Format a rate in percent without its sign; all reports use this or `share`."""
    return f"{100 * successes / trials:.{_digits(successes, trials)}f}"


def _digits(successes: float, trials: int) -> int:
    """Return 2 above 99 %, and at both ends with a thousand trials and more, else 1."""
    rate = successes / trials
    return 2 if 0.99 < rate < 1 or (trials >= 1000 and not 0.01 < rate < 0.99) else 1


def share(successes: int, trials: int) -> str:
    """Format a success rate with its Wilson 95 % interval."""
    if not trials:
        return "-"
    digits = _digits(successes, trials)
    low, high = (f"{100 * p:.{digits}f}" for p in statistics.wilson(successes, trials))
    return f"{percent(successes, trials)} % [{low}, {high}]"


def rate_range(rates: ArrayLike) -> str:
    """Format the least and the greatest of several rates, as from models of the physics."""
    least, greatest = float(np.min(rates)), float(np.max(rates))
    digits = max(_digits(least, 1), _digits(greatest, 1))
    return f"{100 * least:.{digits}f} to {100 * greatest:.{digits}f} %"


def _p(value: float) -> str:
    """Format a p-value; one that underflows is not zero."""
    return f"{value:.2g}" if value > 0 else "< 1e-300"


def _difference(comparison: Comparison, trials: int) -> str:
    """Format a difference of paired rates with its 95 % interval."""
    low, high = (100 * x for x in comparison.interval(trials))
    value = 100 * (comparison.gained - comparison.lost) / trials
    return f"{value:+.2f} % [{low:+.2f}, {high:+.2f}]"


def difference_table(results: xr.Dataset) -> list[list[str]]:
    """Return a row for each pair of laws, world by world, with McNemar's exact test."""
    rows = [["second against first", "gained", "lost", "difference", "McNemar p"]]
    for first, second in combinations(map(str, results.law.values), 2):
        a, b = results.success.sel(law=first), results.success.sel(law=second)
        c, pair = statistics.compare(a, b), f"{second} against {first}"
        rows.append([pair, str(c.gained), str(c.lost), _difference(c, a.size), _p(c.p)])
    return rows


def against_table(results: xr.Dataset, reference: str) -> list[list[str]]:
    """Return a row for each law, the best first: world by world against the reference law.

    The p-values of McNemar's exact test are adjusted for the number of tests (Holm).
    """
    by_law = {str(law): results.success.sel(law=law) for law in results.law.values}
    base = by_law[reference]
    tests = {law: statistics.compare(base, x) for law, x in by_law.items() if law != reference}
    adjusted = statistics.holm([test.p for test in tests.values()])
    p = dict(zip(tests, map(_p, adjusted), strict=True))
    gained = f"successes in the {int((base.values == 0).sum())} failures of {reference}"
    rows = [["", "success", f"against {reference}", "p (Holm)", gained]]
    for law, success in sorted(by_law.items(), key=lambda item: -float(item[1].mean())):
        cells = ["", "", ""]
        if c := tests.get(law):
            difference = f"{_difference(c, base.size)} ({c.changes})"
            cells = [difference, p[law], str(c.gained)]
        rows.append([law, rate(success.values > 0), *cells])
    return rows


def worlds_table(results: xr.Dataset, run: str, worlds: np.ndarray) -> list[list[str]]:
    """Return a row for each of some failed worlds, with the command that replays it."""
    laws = results.law.values.tolist()
    rows = [["world", "object", *laws, "mass", "friction", "target", "replay"]]
    for world in worlds.tolist():
        trials = results.isel(world=world)
        fails = next(law for law in laws if not int(trials.success.sel(law=law)))
        rows.append(
            [
                str(world),
                str(trials.object.values),
                *(_outcome(trials.sel(law=law)) for law in laws),
                f"{float(trials.mass):.1f} kg",
                f"{float(trials.friction_ground):.2f}, {float(trials.friction_robot):.2f}",
                f"{float(trials.distance):.1f} m at {np.degrees(float(trials.bearing)):.0f} deg",
                f"`{provenance.shell('replay', run, world, '--law', fails)}`",
            ]
        )
    return rows


def _outcome(trial: xr.Dataset) -> str:
    if int(trial.success):
        return f"{float(trial.time):.0f} s"
    distance = float(trial.min_distance)
    if "progress" in trial:
        return f"fails, {100 * float(trial.progress):.0f} % of the path"
    return f"fails, {100 * distance:.0f} cm off" if np.isfinite(distance) else "never touches"
