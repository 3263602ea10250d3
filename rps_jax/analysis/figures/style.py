"""Shared style of the figures: sizes of a paper, colours, panels and marks."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import cycler, figure, patches, rc_context, transforms
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable as ScalarMappable
from matplotlib.colors import Normalize as Normalize
from matplotlib.colors import TwoSlopeNorm as TwoSlopeNorm

from rps_jax.analysis import statistics
from rps_jax.geometry import solid
from rps_jax.geometry.footprint import CORNERS
from rps_jax.robot import shell
from rps_jax.world.domain import LABELS

SHADES = {"realigning": "#bcd7f2", "lost": "#f8e3a1"}
WIDTH, COLUMN = 7.2, 3.5  # [in] of a page and of one of its two columns
# Of Okabe and Ito (2008), which differ also for the colour-blind.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000")
# Decorator of a function that draws: letters of 8 points, and colours for all eyes.
styled = rc_context(
    {
        **dict.fromkeys(("font.size", "axes.titlesize", "figure.titlesize", "figure.labelsize"), 8),
        "axes.prop_cycle": cycler(color=COLOURS),
    }
)


class Figure(figure.Figure):
    """Figure of matplotlib that Jupyter shows without `pyplot` and its settings."""

    savefig = styled(figure.Figure.savefig)  # the labels of ticks are made there

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, dpi=150, metadata={"Software": None})
        return file.getvalue()


# Words for joint factors and for functions of drawn quantities.
_WORDS = {
    "shape": "corners of prisms",
    "key": "key of all noise",
    "com_bearing": "bearing of the centre of mass",
    "ground_force": "friction force of the ground",
    "loop_delay": "latency of the pose and delay of the command",
}


def words(name: str) -> str:
    """Return a name with spaces for underscores."""
    return name.replace("_", " ")


def quantity(name: str) -> str:
    """Return the words for a drawn quantity, a joint factor or a derived quantity."""
    return LABELS.get(name) or _WORDS.get(name) or words(name)


def axis_label(name: str, units: str) -> str:
    """Return the words for a drawn quantity with its unit."""
    return f"{quantity(name)} [{units}]".removesuffix(" [1]")


def tiles(
    count: int, columns: int, size: tuple[float, float], margin: tuple[float, float], **shared: bool
) -> tuple[Figure, np.ndarray]:
    """Return a figure and its panels (rows, columns) of one size [in]; unused panels are hidden."""
    columns = min(columns, count)
    shape = np.array([columns, -(-count // columns)])
    sheet = Figure(figsize=tuple(np.array(margin) + size * shape), layout="constrained")
    axes = sheet.subplots(*shape[::-1], squeeze=False, **shared)
    for ax in axes.ravel()[count:]:
        ax.axis("off")
    return sheet, axes


def panel(size: tuple[float, float], xlabel: str, ylabel: str) -> tuple[Figure, Axes]:
    """Return a figure with one panel and a grid."""
    sheet = Figure(figsize=size, layout="constrained")
    ax = sheet.subplots()
    ax.set(xlabel=xlabel, ylabel=ylabel)
    ax.grid(alpha=0.3)
    return sheet, ax


def legend_above(ax: Axes, columns: int = 0, **options: Any) -> None:
    """Add a legend above a panel, where it covers nothing; by default in one row."""
    columns = columns or len(options.get("handles") or ax.get_legend_handles_labels()[1])
    ax.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=columns, **options)


def base_patch(
    pose: np.ndarray,
    sizes: Sequence[float] = (shell.HALF_LENGTH, shell.HALF_WIDTH),
    *,
    fill: bool,
) -> patches.Polygon:
    """Return the outline of a base at a pose (3,) [m, m, rad].

    Its sizes are half length and width (2,) [m], or the radius (1,) [m]; a line shows the heading
    of a round base.
    """
    corners = CORNERS
    if len(sizes) == 1:
        corners = np.append(solid.unit(np.linspace(0, 2 * np.pi, 49)), [[0, 0]], axis=0)
    corners = corners * np.asarray(sizes)
    world = solid.rotate(pose[2], corners) + pose[:2]
    return patches.Polygon(world, facecolor="0.35" if fill else "none", edgecolor="0.35")


def shade(ax: Axes, time: np.ndarray, active: np.ndarray, colour: str) -> None:
    """Shade the times (T,) at which a mask (T,) is true, over the full height of a panel."""
    across = ax.get_xaxis_transform()
    ax.fill_between(time, 0, 1, where=active, transform=across, color=colour, lw=0, step="post")


def success_rates(
    ax: Axes,
    x: np.ndarray,
    successes: np.ndarray,
    trials: np.ndarray,
    *,
    curve: int = 0,
    **style: Any,
) -> None:
    """Draw success rates in percent with their Wilson 95 % intervals.

    The index of the curve chooses its mark and shifts it by 2.5 points, so that coinciding curves
    stay visible.
    """
    rate = 100 * successes / np.maximum(trials, 1)
    pairs = zip(successes, trials, strict=True)
    low, high = 100 * np.array([statistics.wilson(int(n), int(m)) for n, m in pairs]).T
    errors = np.abs(np.stack([rate - low, high - rate]))
    mark = "osD^v"[curve % 5]
    bars = ax.errorbar(x, rate, errors, capsize=2, marker=mark, ms=4, lw=1.2, **style)
    shift = {"fig": ax.get_figure(root=True), "x": 2.5 * curve, "units": "points"}
    for artist in bars.get_children():
        artist.set_transform(transforms.offset_copy(artist.get_transform(), **shift))
