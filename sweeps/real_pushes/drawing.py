"""The picture of the page: where pushes ended and should have, and how far off models are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from rps_jax.analysis.figures.style import Figure
from rps_jax.geometry.solid import rotate
from sweeps.real_pushes import pushes

_SHARES = (0.1, 0.3, 0.5, 0.7, 0.9, 0.97)  # of all pushes, that are predicted better than the drawn
_DRAWN = {
    "no_motion": "0.6",
    "with_pusher": "C1",
    "rigid_corners": "C4",
    "ellipsoid": "C2",
    "rigid_feet": "C3",
}
_FINGERS = ("point", "two-point")
_STEPS = 60
# Outlines of a push: before, measured, predicted.
_STYLES: Sequence[Mapping[str, Any]] = (
    {"color": "0.65", "lw": 1},
    {"color": "k", "lw": 2.2},
    {"color": "C3", "lw": 1.3, "ls": "--"},
)


def figure(results: xr.Dataset, table: pd.DataFrame, words: Mapping[str, str]) -> Figure:
    """Plot twelve pushes with measured and predicted poses, and the distribution of errors.

    Args:
      results: results of the study, with the model `rigid_feet`.
      table: the pushes.
      words: labels of the models.
    """
    picture = Figure(figsize=(12.5, 9.2), layout="constrained", dpi=100)
    halves: Any = picture.subfigures(2, 1, height_ratios=(1.45, 1))
    above, below = halves
    panels = above.subplots(2, len(_SHARES))
    judged = ~results.fits.values & results.group.str.contains(", three feet").values
    paths = pushes.finger_paths(table, _STEPS)
    best = results.sel(model="rigid_feet")
    for row, finger in zip(panels, _FINGERS, strict=True):
        mask = judged & (results.finger.values == finger) & np.isfinite(best.both.values)
        rows = np.flatnonzero(mask)
        order = rows[np.argsort(best.both.values[rows])]
        for ax, share in zip(row, _SHARES, strict=True):
            ax.set_axis_off()
            if order.size:
                i = order[int(share * (order.size - 1))]
                _push(ax, best.isel(push=i), table.iloc[i], paths[:, i])
                off = f"{finger} push, {1e3 * float(best.both[i]):.1f} mm off"
                rank = f"(better than {100 * (1 - share):.0f} % of all)"
                ax.set_title(f"{off}\n{rank}", fontsize=8)
    labels = ("before the push", "measured after it", "predicted: rigid body on its feet")
    lines = [
        *(Line2D([], [], label=x, **style) for x, style in zip(labels, _STYLES, strict=True)),
        Line2D([], [], color="C0", lw=1.5, marker=">", ms=4, label="path of the finger(s)"),
        Line2D([], [], color="0.4", marker="o", ls="none", ms=4, label="feet, before"),
    ]
    above.legend(handles=lines, loc="outside lower center", ncols=5, fontsize=9)
    for ax, finger in zip(below.subplots(1, 2), _FINGERS, strict=True):
        rows = judged & (results.finger.values == finger)
        lines = [
            (results.both.sel(model=name).values[rows], color, words[name])
            for name, color in _DRAWN.items()
            if name in results.model
        ]
        if finger == "two-point":
            off = pushes.repetitions(results)[0].both
            lines.append((off, "k", "a repetition of the push"))
        for values, color, label in lines:
            off = np.sort(1e3 * values[np.isfinite(values)])
            if off.size:
                share = 100 * (np.arange(off.size) + 1) / off.size
                ax.plot(off, share, color=color, lw=1.6, label=label)
        ax.set(xscale="log", xlim=(0.3, 60), ylim=(0, 100), ylabel="pushes that are nearer [%]")
        ax.set_xlabel("distance of the predicted from the measured end, over the whole body [mm]")
        ax.set_title(f"{finger} pushes on three feet")
        ax.set_xticks([0.3, 1, 3, 10, 30], ["0.3", "1", "3", "10", "30"])
        ax.grid(alpha=0.3)
    handles, labels = below.axes[-1].get_legend_handles_labels()
    below.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8)
    return picture


def _push(ax: Axes, push: xr.Dataset, row: pd.Series, path: np.ndarray) -> None:
    """Plot one push, rotated so that its path points up."""
    pre = np.array([row.pre_x, row.pre_y, row.pre_yaw], float)
    fingers = path[:, np.abs(path[0]).max(axis=1) < 100]
    middle = fingers.mean(axis=1)
    at = middle[-1] - middle[0]
    turn = np.pi / 2 - np.arctan2(at[1], at[0])
    origin = pre[:2] + rotate(pre[2], pushes.COM)

    def to_figure(points: np.ndarray) -> np.ndarray:
        return 1e3 * rotate(np.full(points.shape[:-1], turn), points - origin)

    def outline(pose: np.ndarray, corners: np.ndarray = pushes.OUTLINE) -> np.ndarray:
        return to_figure(pose[:2] + rotate(np.full(len(corners), pose[2]), corners))

    for pose, style in zip((pre, push.measured, push.predicted), _STYLES, strict=True):
        shape = outline(np.asarray(pose))
        ax.plot(*np.concatenate([shape, shape[:1]]).T, **style)
    if row.support != pushes.FLAT:
        ax.plot(*outline(pre, pushes.feet_of(row.support)).T, "o", color="0.4", ms=3.5)
    for finger in np.moveaxis(fingers, 1, 0):
        line = to_figure(finger)
        ax.plot(*line.T, color="C0", lw=1.5)
        arrow = {"arrowstyle": "-|>", "color": "C0", "lw": 1.5}
        ax.annotate("", line[-1], line[-6], arrowprops=arrow)
    ax.set_aspect("equal")
    ax.margins(0.03)
