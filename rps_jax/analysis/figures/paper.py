"""Figures of the paper, from its grid of trials and from traces over time."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from matplotlib import patches
from matplotlib.artist import setp
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from rps_jax.analysis.figures.style import (
    COLUMN,
    SHADES,
    WIDTH,
    Figure,
    base_patch,
    legend_above,
    panel,
    shade,
    styled,
    tiles,
    words,
)
from rps_jax.control.laws import rps
from rps_jax.control.laws.rps import RPSParams
from rps_jax.geometry import solid
from rps_jax.robot import shell, skin

_BASE, _OBJECT = "0.35", "#8a5a2b"
_SCALE, _COLOURS = Normalize(0, 2), "viridis_r"  # of the distance to the target [m], in Fig. 5


@styled
def profile(params: RPSParams) -> Figure:
    """Draw the logistic profile of Eq. 5 (the paper's Fig. 3): a_r over the contact offset."""
    l = jnp.linspace(-shell.HALF_WIDTH, shell.HALF_WIDTH, 401)  # noqa: E741
    far = jnp.asarray(2 * params.d_th)
    a_r = jax.vmap(lambda l: rps.adaptive_rate(params, l, far))(l)  # noqa: E741
    figure, ax = panel((COLUMN, 2.4), "contact offset $l$ [m]", "adaptive rate $a_r$ [1]")
    ax.plot(l, a_r, color="C0")
    for side in (-1, 1):
        critical = side * float(params.l_cr), side * shell.HALF_WIDTH
        ax.axvspan(*critical, color=SHADES["realigning"], lw=0)
        ax.axvline(side * float(params.beta), color="0.6", lw=0.7, ls="--")
    ax.set_title("Eq. 5; dashed: $\\pm\\beta$; shaded: critical region")
    return figure


@styled
def one_trial(trace: xr.Dataset, title: str) -> Figure:
    """Draw Fig. 6: the path with contact points; velocities; l and a_r; contact type.

    Blue shade: Realignment State, or a reposition. Yellow shade: no contact. Dashed line: `l_cr`,
    if the law has it.
    The trace is of one trial over time; it holds the contact point `p_world_contact`, the target
    and the radius `d_success`.
    """
    time, touching = trace.time.values, trace.contact_type.values != skin.NONE
    figure = Figure(figsize=(WIDTH, 4.6), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.1, 1))
    path = figure.add_subplot(grid[:, 0], xlabel="x [m]", ylabel="y [m]")
    draw_path(path, trace)
    legend_above(path, columns=3)

    velocity = figure.add_subplot(grid[0, 1])
    velocity.plot(time, trace.v_x, label="$v_x$ [m/s]", color="C0")
    velocity.plot(time, trace.v_y, label="$v_y$ [m/s]", color="C1")
    velocity.plot(time, trace.omega, label=r"$\omega$ [rad/s]", color="C2")
    legend_above(velocity)
    velocity.set_ylabel("a) twist")

    offset = figure.add_subplot(grid[1, 1], sharex=velocity)
    offset.plot(time, np.where(touching, trace.l, np.nan), color="C0")
    offset.set_ylabel("b) $l$ [m]", color="C0")
    offset.set_ylim(-1.1 * trace.half_width, 1.1 * trace.half_width)  # the sides are inside
    for sign in (-1, 1) if "l_cr" in trace else ():
        offset.axhline(sign * float(trace.l_cr), color="0.6", lw=0.7, ls="--")
    rate = offset.twinx()
    rate.plot(time, np.where(touching, trace.a_r, np.nan), color="C3", lw=0.9)
    rate.set_ylabel("$a_r$ [1]", color="C3")
    rate.margins(y=0.2)  # beside l where both are at their limits

    kind = figure.add_subplot(grid[2, 1], sharex=velocity)
    kind.step(time, trace.contact_type, where="post", color="0.2", lw=0.9)
    kind.set_yticks((0, 1, 2), ("none", "point", "line"))
    kind.set_ylim(-0.2, 2.2)
    kind.set(ylabel="c) contact", xlabel="time [s]")
    for ax in (velocity, offset):
        ax.tick_params(labelbottom=False)
    for ax in (velocity, offset, kind):
        shade(ax, time, trace.realigning.values > 0.5, SHADES["realigning"])
        shade(ax, time, ~touching, SHADES["lost"])
    bands = (("realigning or repositioning", SHADES["realigning"]), ("no contact", SHADES["lost"]))
    marks = [patches.Patch(color=colour, label=name) for name, colour in bands]
    legend_above(kind, handles=marks)
    result = "reached" if trace.outcome_success else "not reached"
    (x, y), end = trace.p_world_target.values, f"{float(trace.outcome_time):.1f} s"
    figure.suptitle(f"{title}, target ({x:.3g}, {y:.3g}) m: {result} at {end}")
    return figure


def _object(trace: xr.Dataset, index: int) -> np.ndarray:
    """Return the outline (N, 2) [m] of the object in the world at one time step."""
    x, y, w, _, _, z = trace.qpos.values[index, [3, 4, 6, 7, 8, 9]]
    return np.array([x, y]) + solid.rotate(2 * np.arctan2(z, w), trace.outline.values)


def draw_path(ax: Axes, trace: xr.Dataset, snapshots: int = 7) -> None:
    """Draw a trial as a map: base, object and contact point, and snapshots from start to end."""
    pose, target = trace.qpos.values[:, :3], trace.p_world_target.values
    names = ["base_radius"] if "base_radius" in trace else ["half_length", "half_width"]
    sizes = [float(trace[name]) for name in names]
    ax.plot(*pose[:, :2].T, color=_BASE, label="base", zorder=3)
    ax.plot(*trace.p_world_contact.values.T, ".", ms=2, color="C0", label="contact point")
    ax.plot(*trace.qpos.values[:, 3:5].T, "--", lw=1, color=_OBJECT, label="object")
    for index in np.linspace(0, len(pose) - 1, snapshots).astype(int):
        alpha = 0.9 if index == len(pose) - 1 else 0.35
        ax.fill(*_object(trace, index).T, fc="#e8c39e", ec=_OBJECT, alpha=alpha)
        ax.add_patch(base_patch(pose[index], sizes, fill=False)).set_alpha(alpha)
    if "path" in trace:
        ax.plot(*trace.path.values.T, "-", lw=1, color="0.6", label="path", zorder=0)
    for wall in trace.walls.values if "walls" in trace else ():
        ax.plot(*wall.T, "-", lw=2, color="0.2")
    if "goal" in trace:
        tail, tip = trace.goal.values
        ax.annotate("", tip, tail, arrowprops={"arrowstyle": "->", "color": "C3", "lw": 1.5})
    ax.plot(*target, "*", ms=10, color="C3", label="target")
    ax.add_patch(patches.Circle(target, float(trace.d_success), fill=False, color="C3"))
    ax.set_aspect("equal", adjustable="datalim")
    ax.grid(alpha=0.3)


@styled
def stills(images: Sequence[np.ndarray], titles: Sequence[str]) -> Figure:
    """Draw Figs. 1 and 4: images (height, width, 3) with their titles, three in a row."""
    figure, axes = tiles(len(images), 3, (WIDTH / 3, 1.5), (0, 0))
    for ax, image, title in zip(axes.ravel(), images, titles, strict=False):
        ax.axis("off")
        ax.imshow(image)
        ax.set_title(words(title))
    return figure


@styled
def min_distance(results: xr.Dataset) -> Figure:
    """Draw Fig. 5: least distance of contact to target over targets, mean over friction sets.

    Rows are laws, columns are objects. The number at a target counts the successes of its trials;
    the last column sums them over objects.
    """
    laws, objects = (list(map(str, results[dim].values)) for dim in ("law", "object"))
    columns = [*objects, "all"] if len(objects) > 1 else objects
    count, size = len(laws) * len(columns), (1.55, 1.75)
    figure, axes = tiles(count, len(columns), size, (1.0, 0.3), sharex=True, sharey=True)
    for row, law in zip(axes, laws, strict=True):
        for ax, column in zip(row, columns, strict=True):
            part = results.sel(law=law)
            part = part if column == "all" else part.sel(object=[column])
            _map(ax, part)
            successes, trials = int(part.success.sum()), part.success.size
            name = "all objects" if column == "all" else words(column)
            ax.set_title(f"{law.upper()}, {name}\n{successes}/{trials}")
    setp(axes[-1].tolist(), xlabel="x [m]")
    setp(axes[:, 0].tolist(), ylabel="y [m]")
    colours, label = ScalarMappable(_SCALE, _COLOURS), "least distance of contact to target [m]"
    figure.colorbar(colours, ax=axes, label=label, shrink=0.8, extend="max")
    return figure


def _map(ax: Axes, part: xr.Dataset) -> None:
    """Draw a coloured square and the count of successes at each target."""
    # A trial without contact has no least distance; it has the colour of the scale's far end.
    distance = part.min_distance.where(np.isfinite(part.min_distance), 3.0)
    distance = distance.mean(("object", "friction")).values
    count = part.success.sum(("object", "friction")).values
    x, y = part.target_x.values, part.target_y.values
    ax.scatter(x, y, c=distance, s=140, marker="s", cmap=_COLOURS, norm=_SCALE, linewidths=0)
    for i, successes in enumerate(count):
        colour = "white" if distance[i] > 1.0 else "black"
        ax.annotate(str(int(successes)), (x[i], y[i]), ha="center", va="center", color=colour)
    ax.add_patch(base_patch(np.zeros(3), fill=True))
    ax.margins(0.15)
    ax.set_aspect("equal")
