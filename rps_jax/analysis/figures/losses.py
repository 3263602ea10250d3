"""Trials that were lost, side by side: where base and object went."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rps_jax.analysis.figures.style import base_patch, save

_COLUMNS = 6


def losses(seen: Sequence[xr.Dataset], labels: Sequence[str], title: str, path: Path) -> Path:
    """A map of each trial: the ways of base and object, and the base at ten moments.

    Args:
      seen: trials over time, as of `Push.data`, variables (time, ...).
      labels: of their panels.
      title: of the figure.
      path: of the PNG.
    """
    columns = min(_COLUMNS, len(seen))
    rows = -(-len(seen) // columns)
    figure = Figure(figsize=(0.4 + 2.3 * columns, 0.9 + 2.4 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for ax in axes.ravel()[len(seen) :]:
        ax.axis("off")
    for ax, one, label in zip(axes.ravel(), seen, labels, strict=False):
        _map(ax, one)
        ax.set_title(label, fontsize=7)
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, fontsize=8, loc="outside lower center", ncols=len(names))
    figure.suptitle(title, fontsize=10)
    return save(figure, path)


def _map(ax: Axes, one: xr.Dataset) -> None:
    qpos, touch = one.qpos.values, one.contact_type.values != 0
    base, thing = qpos[:, :3], qpos[:, 3:5]
    felt = np.where(touch[:, None], base[:, :2], np.nan)
    unfelt = np.where(touch[:, None], np.nan, base[:, :2])
    ax.plot(*felt.T, color="C0", lw=0.8, label="base, touching")
    ax.plot(*unfelt.T, color="C3", lw=0.8, label="base, without contact")
    ax.plot(*thing.T, color="C1", lw=1.2, label="object")
    half = (float(one.half_length), float(one.half_width))
    for i in np.linspace(0, len(base) - 1, 10).astype(int):
        patch = base_patch(base[i], half, fill=i == len(base) - 1)
        patch.set_alpha(0.5)
        ax.add_patch(patch)
    target = np.asarray(one.p_world_target.values, float)
    ax.plot(*target, "*", color="C2", ms=9, label="target")
    ax.set_aspect("equal", adjustable="datalim")
    ax.tick_params(labelsize=6)
