"""What the figures have in common: colours, and parts of a panel."""

import io
from typing import Any

import numpy as np
from matplotlib import figure, patches, transforms
from matplotlib.axes import Axes

from rps_jax.analysis import statistics
from rps_jax.robot import shell
from rps_jax.world.domain import WORDS

OBJECT_COLOURS = {"box": "C0", "cylinder": "C1", "nonuniform_box": "C2"}
OBJECT_COLOURS |= {"hardware_box": "C0", "hardware_cylinder": "C1"}
SHADES = {"realigning": "#bcd7f2", "lost": "#f8e3a1"}


class Figure(figure.Figure):
    """A figure of matplotlib that Jupyter shows without `pyplot` and without its settings."""

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, dpi=100, metadata={"Software": None})
        return file.getvalue()


def words(name: str) -> str:
    """A name as words."""
    return name.replace("_", " ")


def quantity(name: str) -> str:
    """A drawn quantity in words."""
    return WORDS.get(name) or words(name)


def tiles(
    count: int, columns: int, size: tuple[float, float], margin: tuple[float, float], **shared: Any
) -> tuple[Figure, np.ndarray]:
    """A figure of panels (rows, columns) of one size [in], row by row; those left over are off."""
    columns = min(columns, count)
    shape = np.array([columns, -(-count // columns)])
    sheet = Figure(figsize=tuple(np.array(margin) + size * shape), layout="constrained")
    axes = sheet.subplots(*shape[::-1], squeeze=False, **shared)
    for ax in axes.ravel()[count:]:
        ax.axis("off")
    return sheet, axes


def base_patch(
    pose: np.ndarray,
    half: tuple[float, float] = (shell.HALF_LENGTH, shell.HALF_WIDTH),
    *,
    fill: bool,
) -> patches.Polygon:
    """Outline of a base of half length and width (2,) [m] at a pose (3,) [m, m, rad]."""
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half
    c, s = np.cos(pose[2]), np.sin(pose[2])
    world = corners @ np.array([[c, s], [-s, c]]) + pose[:2]
    return patches.Polygon(world, facecolor="0.35" if fill else "none", edgecolor="0.35")


def shade(ax: Axes, time: np.ndarray, active: np.ndarray, colour: str) -> None:
    """Colour the times (T,) at which a mask (T,) holds, over the whole height of a panel."""
    across = ax.get_xaxis_transform()
    ax.fill_between(time, 0, 1, where=active, transform=across, color=colour, lw=0, step="post")


def success_rates(
    ax: Axes, x: np.ndarray, won: np.ndarray, of: np.ndarray, *, beside: int = 0, **style
) -> None:
    """Draw success rates in percent with their Wilson 95 % intervals.

    The curve number `beside` has a mark of its own, 2.5 points beside the one before, so that
    curves which coincide are all seen.
    """
    rate = 100 * won / np.maximum(of, 1)
    ends = 100 * np.array([statistics.wilson(int(n), int(m)) for n, m in zip(won, of, strict=True)])
    errors = np.abs(np.stack([rate - ends[:, 0], ends[:, 1] - rate]))
    sheet = ax.get_figure(root=True)
    assert sheet is not None
    moved = transforms.ScaledTranslation(2.5 * beside / 72, 0, sheet.dpi_scale_trans)
    mark = "osD^v"[beside % 5]
    bars = ax.errorbar(x, rate, errors, capsize=2, marker=mark, ms=4, lw=1.2, **style)
    for drawn in bars.get_children():
        drawn.set_transform(drawn.get_transform() + moved)
