"""The paper's figures, drawn from results and traces. Every function writes one PNG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
import xarray as xr
from matplotlib import patches
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rps_jax import record, skin, trial
from rps_jax.skin import NONE
from rps_jax.sweep import Case, Trace

_TITLES = {
    "rps": "RPS",
    "nps": "NPS",
    "aps": "APS",
    "box": "box",
    "cylinder": "cylinder",
    "nonuniform_box": "nonuniform box",
    "hardware_box": "hardware box",
    "hardware_cylinder": "hardware cylinder",
}
_SHADES = {"realigning": "#bcd7f2", "lost": "#f8e3a1"}


def save(figure: Figure, path: Path) -> Path:
    """Write the figure, atomically and without a date, so equal figures are equal files."""
    return record.atomic(
        path, lambda partial: figure.savefig(partial, dpi=150, metadata={"Software": None})
    )


def min_distance(results: xr.Dataset, path: Path) -> Path:
    """Fig. 5: least distance of contact to target, over the targets, mean of the friction sets.

    Rows are strategies, columns objects; the number at a target counts the successes of its
    trials, and the last column sums them over objects.
    """
    strategies, objects = map(str, results.strategy.values), list(map(str, results.object.values))
    strategies = list(strategies)
    columns = [*objects, "all"] if len(objects) > 1 else objects
    figure = Figure(
        figsize=(0.9 + 2.6 * len(columns), 0.9 + 2.5 * len(strategies)), layout="constrained"
    )
    axes = figure.subplots(len(strategies), len(columns), squeeze=False, sharex=True, sharey=True)
    image = None
    for row, strategy in zip(axes, strategies, strict=True):
        for ax, column in zip(row, columns, strict=True):
            part = results.sel(strategy=strategy)
            part = part if column == "all" else part.sel(object=[column])
            image = _map(ax, part)
            won, of = int(part.success.sum()), part.success.size
            name = "all objects" if column == "all" else _TITLES.get(column, column)
            ax.set_title(f"{_TITLES[strategy]}, {name}: {won}/{of}", fontsize=9)
    for ax in axes[-1]:
        ax.set_xlabel("x [m]")
    for ax in axes[:, 0]:
        ax.set_ylabel("y [m]")
    assert image is not None
    bar = figure.colorbar(image, ax=axes, shrink=0.8, extend="max")
    bar.set_label("least distance of contact to target [m]")
    return save(figure, path)


def _map(ax: Axes, part: xr.Dataset):
    """One panel: a coloured square and the count of successes at each target."""
    # A trial that never touched has no least distance; it is drawn as the far end of the scale.
    distance = part.min_distance.where(np.isfinite(part.min_distance), 3.0)
    distance = distance.mean(("object", "friction")).values
    count = part.success.sum(("object", "friction")).values
    x, y = part.target_x.values, part.target_y.values
    image = ax.scatter(
        x, y, c=distance, s=420, marker="s", cmap="viridis_r", vmin=0.0, vmax=2.0, linewidths=0
    )
    for point in zip(x, y, distance, count, strict=True):
        colour = "white" if point[2] > 1.0 else "black"
        ax.annotate(
            str(int(point[3])), point[:2], ha="center", va="center", fontsize=8, color=colour
        )
    ax.add_patch(_base_patch(np.zeros(3), fill=True))
    margin = 0.6
    ax.set(
        xlim=(x.min() - margin, x.max() + margin),
        ylim=(y.min() - margin, y.max() + margin),
        aspect="equal",
    )
    return image


def _base_patch(pose: np.ndarray, *, fill: bool) -> patches.Polygon:
    """Outline of the base at a pose (3,) [m, m, rad] in the world."""
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [skin.HALF_LENGTH, skin.HALF_WIDTH]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    world = corners @ np.array([[c, s], [-s, c]]) + pose[:2]
    return patches.Polygon(
        world, closed=True, facecolor="0.35" if fill else "none", edgecolor="0.35"
    )


def one_trial(case: Case, trace: Trace, path: Path) -> Path:
    """Fig. 6: the path with contact points; velocities; l and a_r; contact type.

    Blue shade: Realignment State. Yellow: no contact.
    """
    seen = jax.tree.map(np.asarray, trace.snapshots)
    touching = seen.reading.contact_type != NONE
    figure = Figure(figsize=(11, 6), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.1, 1))
    _path(figure.add_subplot(grid[:, 0]), case, trace)

    velocity = figure.add_subplot(grid[0, 1])
    velocity.plot(seen.time, seen.twist.v_x, label="$v_x$ [m/s]", color="C0")
    velocity.plot(seen.time, seen.twist.v_y, label="$v_y$ [m/s]", color="C1")
    velocity.plot(seen.time, seen.twist.omega, label=r"$\omega$ [rad/s]", color="C2")
    velocity.legend(ncols=3, fontsize=8, loc="upper right")
    velocity.set_ylabel("a) twist")

    place = figure.add_subplot(grid[1, 1], sharex=velocity)
    place.plot(seen.time, np.where(touching, seen.details.l, np.nan), color="C0")
    place.set_ylabel("b) $l$ [m]", color="C0")
    place.set_ylim(-skin.HALF_WIDTH, skin.HALF_WIDTH)
    for sign in (-1, 1):
        place.axhline(sign * float(case.params.l_cr), color="0.6", lw=0.7, ls="--")
    rate = place.twinx()
    rate.plot(seen.time, np.where(touching, seen.details.a_r, np.nan), color="C3", lw=0.9)
    rate.set_ylabel("$a_r$ [1]", color="C3")

    kind = figure.add_subplot(grid[2, 1], sharex=velocity)
    kind.step(seen.time, seen.reading.contact_type, where="post", color="0.2", lw=0.9)
    kind.set_yticks((0, 1, 2), ("none", "point", "line"))
    kind.set_ylim(-0.2, 2.2)
    kind.set(ylabel="c) contact", xlabel="time [s]")
    for ax in (velocity, place, kind):
        _shade(ax, seen.time, seen.details.realigning, _SHADES["realigning"])
        _shade(ax, seen.time, ~touching, _SHADES["lost"])
    result = "reached" if trace.outcome.success else "not reached"
    x, y = case.p_world_target
    figure.suptitle(
        f"{_TITLES[case.object]}, target ({x:g}, {y:g}) m, "
        f"$\\mu$ ground {case.friction.ground:g}, robot {case.friction.robot:g}: "
        f"{result} at {float(trace.outcome.time):.1f} s"
    )
    return save(figure, path)


def _shade(ax: Axes, time: np.ndarray, active: np.ndarray, colour: str) -> None:
    ax.fill_between(
        time,
        0,
        1,
        where=active,
        transform=ax.get_xaxis_transform(),
        color=colour,
        lw=0,
        step="post",
    )


def stills(images: Sequence[np.ndarray], times: np.ndarray, path: Path) -> Path:
    """Fig. 1: pictures (height, width, 3) of a push, three in a row, with their times [s]."""
    rows = -(-len(images) // 3)
    figure = Figure(figsize=(12, 2.3 * rows), layout="constrained")
    axes = figure.subplots(rows, 3, squeeze=False).ravel()
    for ax in axes:
        ax.axis("off")
    for ax, image, time in zip(axes, images, times, strict=False):
        ax.imshow(image)
        ax.set_title(f"{time:.0f} s", fontsize=9)
    return save(figure, path)


def _path(ax: Axes, case: Case, trace: Trace) -> None:
    """Left column of Fig. 6: the way of the base and of the contact point."""
    pose = np.asarray(trace.snapshots.qpos[:, :3])
    ax.plot(*pose[:, :2].T, color="0.35", label="base")
    ax.plot(
        *np.asarray(trial.p_world_contact(trace.snapshots)).T,
        ".",
        ms=1.5,
        color="C0",
        label="contact point",
    )
    for index in np.linspace(0, len(pose) - 1, 7).astype(int):
        ax.add_patch(_base_patch(pose[index], fill=False))
    ax.plot(*case.p_world_target, "*", ms=14, color="C3", label="target")
    circle = patches.Circle(
        case.p_world_target, float(case.params.d_success), fill=False, color="C3"
    )
    ax.add_patch(circle)
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
