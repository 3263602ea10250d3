"""Studies: readings of the paper, its hardware, the physics, speed, gradients, parameters."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from rps_jax.analysis import statistics
from rps_jax.analysis.figures.style import OBJECT_COLOURS, save, success_rates, words


def tolerance_curve(curve: xr.Dataset, trials: int, path: Path) -> Path:
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
            style = {"color": OBJECT_COLOURS[name], "label": words(name)}
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
    return save(figure, path)


def shift_curve(recovered: xr.Dataset, path: Path) -> Path:
    """Success over the size of the shove, with Wilson 95 % intervals.

    `recovered` has, by (object, shift [m]), how many trials were `won`, and `of` how many.
    """
    figure = Figure(figsize=(5.5, 3.4), layout="constrained")
    ax = figure.subplots()
    for name in map(str, recovered.object.values):
        one, style = recovered.sel(object=name), {"color": OBJECT_COLOURS[name]}
        size = 100 * one["shift"].values
        success_rates(ax, size, one.won.values, one.of.values, label=words(name), **style)
    ax.set(xlabel="the object is moved sideways by [cm]", ylabel="success [%]", ylim=(-3, 103))
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    return save(figure, path)


def agreement(names: Sequence[str], equal: np.ndarray, ends: np.ndarray, path: Path) -> Path:
    """Share of outcomes (N,) equal to the reference's, with the ends (N, 2) of its intervals."""
    figure = Figure(figsize=(7.5, 0.6 + 0.24 * len(names)), layout="constrained")
    ax = figure.subplots()
    y = np.arange(len(names))[::-1]
    errors = np.abs(np.stack([equal - ends[:, 0], ends[:, 1] - equal]))
    ax.errorbar(100 * equal, y, xerr=100 * errors, fmt="o", ms=4, capsize=2)
    for goal in (90, 95):
        ax.axvline(goal, color="0.6", lw=0.7, ls="--")
    ax.set_yticks(y, names, fontsize=8)
    ax.set_xlabel("outcomes equal to the reference's [%]")
    ax.grid(alpha=0.3, axis="x")
    return save(figure, path)


def throughput(
    speeds: Iterable[tuple[str, str, int, float]], steady: Collection[str], path: Path
) -> Path:
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
    return save(figure, path)


def levers(gains: Mapping[str, float], title: str, path: Path) -> Path:
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
    return save(figure, path)


def gradient_quality(results: xr.Dataset, path: Path) -> Path:
    """Estimators against the truth over the horizon: cosine, bias, error, share that is finite."""
    panels = {
        "cosine": "cosine to the truth [1]",
        "bias": "bias / norm of the truth [1]",
        "error": "standard error / norm of the truth [1]",
        "finite": "share of finite derivatives [1]",
    }
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    x = results.horizon.values
    for ax, (field, label) in zip(
        figure.subplots(2, 2, sharex=True).ravel(), panels.items(), strict=True
    ):
        for i, name in enumerate(map(str, results.estimator.values)):
            one = results.sel(estimator=name)
            ax.plot(x, one[field], "o-", ms=4, color=f"C{i}", label=name)
            if field == "cosine":
                ax.fill_between(
                    x, one.least_cosine, one.greatest_cosine, color=f"C{i}", alpha=0.12, lw=0
                )
        if field in ("bias", "error"):
            ax.plot(x, results.doubt, "k--", lw=1, label="standard error of the truth")
            ax.set_yscale("log")
        if field == "finite":
            ax.set_ylim(-0.04, 1.04)
        ax.set(xscale="log", ylabel=label, xticks=x, xticklabels=[f"{t:g}" for t in x])
        ax.minorticks_off()
        ax.grid(alpha=0.3)
        if field in ("cosine", "bias"):
            ax.legend(fontsize=8)
    figure.supxlabel("horizon [s]", fontsize=10)
    return save(figure, path)


def sensitivity(results: xr.Dataset, log: Collection[str], path: Path) -> Path:
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
                ax, one.value.values, won, np.full(won.size, of), color=f"C{i}", label=which
            )
        ax.set_xlabel(name, fontsize=9)
        ax.grid(alpha=0.3)
        if name in log:
            ax.set_xscale("log")
    for ax in axes[::4]:
        ax.set_ylabel("success [%]")
    axes[0].legend(fontsize=8)
    return save(figure, path)


def front(results: xr.Dataset, path: Path) -> Path:
    """Success against time and against the way driven; the undominated candidates are marked."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    labels = [str(label) for label in results.candidate.values]
    for ax, (field, label) in zip(
        figure.subplots(1, 2, sharey=True),
        {"time": "median time of a success [s]", "path": "median way of the base [m]"}.items(),
        strict=True,
    ):
        x, y = results[field].values, 100 * results.success.values
        ax.plot(x, y, ".", color="0.75", label="candidates")
        chosen = results.front.values
        ax.plot(x[chosen], y[chosen], "o", ms=5, color="C0", label="undominated")
        for i, name in enumerate(labels):
            if not name.isdigit():
                ax.plot(x[i], y[i], "*", ms=12, color="C3")
                ax.annotate(name, (x[i], y[i]), (6, -10), textcoords="offset points", fontsize=9)
        ax.set_xlabel(label)
        ax.grid(alpha=0.3)
    figure.axes[0].set_ylabel("success [%]")
    figure.axes[0].legend(fontsize=8, loc="lower right")
    return save(figure, path)


def grounds(results: xr.Dataset, names: Collection[str], path: Path) -> Path:
    """Where pushes on some grounds end beside those of a rigid object; errors, spreads and hops.

    `results` are by (ground, object, offset, speed), and where a rigid object ends,
    `limit_lateral` [m], by (object, offset, at_height, friction), of which the first is the own.
    """
    chosen = [name for name in map(str, results.ground.values) if name in names]
    things = list(map(str, results.object.values))
    figure = Figure(figsize=(11, 7), layout="constrained")
    above, below = figure.subplots(2, 3)
    speeds = results.speed.values
    for ax, thing in zip(above, things, strict=False):
        one = results.sel(object=thing)
        for offset in results.offset.values:
            line = 1000 * one.limit_lateral.sel(offset=offset).isel(friction=0)
            ax.plot(100 * results.at_height, line, "k-", lw=1)
        for i, name in enumerate(chosen):
            for speed, marker in zip(speeds, "vos^D", strict=False):
                at = one.sel(ground=name, speed=speed)
                style = {"color": f"C{i}", "marker": marker, "ls": "none", "ms": 5}
                ax.plot(100 * at.height, 1000 * at.lateral, mfc="none", **style)
        ax.set(title=words(thing), xlabel="height of the push [cm]")
        ax.grid(alpha=0.3)
    above[0].set_ylabel("end, along the base's front [mm]")
    panels = {
        "error": "from the rigid object's end [mm]",
        "spread": "spread of the push force [%]",
        "hop": "largest hop [mm]",
    }
    for ax, (field, label) in zip(below, panels.items(), strict=True):
        for i, name in enumerate(chosen):
            one, over = results[field].sel(ground=name), ("object", "offset")
            value = one.max(over) if field == "hop" else one.mean(over)
            if field == "error":
                value = np.sqrt((one**2).mean(over))
            factor = 100 if field == "spread" else 1000
            what = str(results.what.sel(ground=name).values)
            ax.plot(100 * speeds, factor * value, "o-", ms=4, color=f"C{i}", label=what)
        ax.set(xscale="log", yscale="log", xlabel="speed of the base [cm/s]", ylabel=label)
        ax.set_xticks(100 * speeds, [f"{100 * speed:g}" for speed in speeds])
        ax.minorticks_off()
        ax.grid(alpha=0.3)
    marks = [
        Line2D([], [], color="0.3", marker=marker, ls="none", mfc="none", label=f"{100 * v:g} cm/s")
        for v, marker in zip(speeds, "vos^D", strict=False)
    ]
    rigid = Line2D([], [], color="k", lw=1, label="rigid object, at three offsets")
    handles = [rigid, *marks, *below[0].get_legend_handles_labels()[0]]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8)
    return save(figure, path)


def limits(found: Mapping[str, xr.Dataset], path: Path) -> Path:
    """Success over each limit of a robot, with Wilson 95 % intervals; dashed: the ideal base."""
    columns = min(3, len(found))
    rows = -(-len(found) // columns)
    figure = Figure(figsize=(4 * columns, 3.2 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for ax in axes[len(found) :]:
        ax.axis("off")
    for ax, one in zip(axes, found.values(), strict=False):
        for i, arm in enumerate(map(str, one.arm.values)):
            seen = statistics.bins(one.value.values, one.success.sel(arm=arm).values > 0, 12)
            success_rates(ax, seen.middle, seen.won, seen.of, color=f"C{i}", label=arm)
            usual = 100 * float(one.usual.sel(arm=arm).mean())
            ax.axhline(usual, color=f"C{i}", lw=0.8, ls="--")
        ax.set_xlabel(one.value.attrs["long_name"], fontsize=9)
        ax.set_xscale("log" if one.attrs["log"] else "linear")
        ax.grid(alpha=0.3)
    for ax in axes[::columns]:
        ax.set_ylabel("success [%]")
    axes[0].legend(fontsize=8)
    return save(figure, path)


def turning(found: xr.Dataset, path: Path) -> Path:
    """The turning rate that a law asks for, and what each robot makes of it, over time."""
    names = list(map(str, found.robot.values))
    figure = Figure(figsize=(8, 1.7 * len(names)), layout="constrained")
    axes = figure.subplots(len(names), 1, squeeze=False, sharex=True, sharey=True)[:, 0]
    for ax, name in zip(axes, names, strict=True):
        one = found.sel(robot=name)
        ax.step(one.time, one.asked, color="0.7", lw=1, where="post", label="asked by the law")
        ax.plot(one.time, one.done, color="C0", lw=1.2, label="of the base")
        ax.set_title(name, fontsize=9, loc="left")
        ax.set_ylabel(r"$\omega$ [rad/s]")
        ax.grid(alpha=0.3)
    axes[-1].set_xlabel("time [s]")
    axes[0].legend(fontsize=8, loc="lower right")
    return save(figure, path)
