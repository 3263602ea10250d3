"""The paper's figures, drawn from results and traces. Every function writes one PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from matplotlib import patches
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rps_jax.analysis import statistics, tables
from rps_jax.control import law
from rps_jax.control.law import Details, Observation, RPSParams, RPSState, Twist
from rps_jax.record import files
from rps_jax.robot import skin
from rps_jax.robot.skin import NONE
from rps_jax.studies import ambiguity, benchmark, hardware
from rps_jax.studies.ablation import Gain
from rps_jax.studies.benchmark import Speed
from rps_jax.trials import trial
from rps_jax.trials.pushes import Case, Trace
from rps_jax.tuning import evolution as tune

_OBJECT_COLOURS = {"box": "C0", "cylinder": "C1", "nonuniform_box": "C2"}
_OBJECT_COLOURS |= {"hardware_box": "C0", "hardware_cylinder": "C1"}
_SHADES = {"realigning": "#bcd7f2", "lost": "#f8e3a1"}


def _title(name: str) -> str:
    """An object's name as words."""
    return name.replace("_", " ")


def save(figure: Figure, path: Path) -> Path:
    """Write the figure, atomically and without a date, so equal figures are equal files."""
    return files.atomic(
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
            name = "all objects" if column == "all" else _title(column)
            ax.set_title(f"{strategy.upper()}, {name}: {won}/{of}", fontsize=9)
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


def title_of(case: Case) -> str:
    """What a case is, in words."""
    return (
        f"{_title(case.object)}, $\\mu$ ground {case.friction.ground:g}, "
        f"robot {case.friction.robot:g}"
    )


def one_trial(trace: Trace, title: str, path: Path) -> Path:
    """Fig. 6: the path with contact points; velocities; l and a_r; contact type.

    Blue shade: Realignment State. Yellow: no contact.
    """
    seen = jax.tree.map(np.asarray, trace.snapshots)
    touching = seen.reading.contact_type != NONE
    figure = Figure(figsize=(11, 6), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.1, 1))
    _path(figure.add_subplot(grid[:, 0]), trace)

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
    for sign in (-1, 1) if isinstance(trace.params, RPSParams) else ():
        place.axhline(sign * float(trace.params.l_cr), color="0.6", lw=0.7, ls="--")
    rate = place.twinx()
    rate.plot(seen.time, np.where(touching, seen.details.a_r, np.nan), color="C3", lw=0.9)
    rate.set_ylabel("$a_r$ [1]", color="C3")

    kind = figure.add_subplot(grid[2, 1], sharex=velocity)
    kind.step(seen.time, seen.reading.contact_type, where="post", color="0.2", lw=0.9)
    kind.set_yticks((0, 1, 2), ("none", "point", "line"))
    kind.set_ylim(-0.2, 2.2)
    kind.set(ylabel="c) contact", xlabel="time [s]")
    for ax in (velocity, place, kind):
        _shade(ax, seen.time, seen.details.realigning > 0.5, _SHADES["realigning"])
        _shade(ax, seen.time, ~touching, _SHADES["lost"])
    result = "reached" if trace.outcome.success else "not reached"
    x, y = trace.p_world_target
    figure.suptitle(
        f"{title}, target ({x:.3g}, {y:.3g}) m: {result} at {float(trace.outcome.time):.1f} s"
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


def stills(images: Sequence[np.ndarray], titles: Sequence[str], path: Path) -> Path:
    """Figs. 1 and 4: pictures (height, width, 3), three in a row, with their titles."""
    rows = -(-len(images) // 3)
    figure = Figure(figsize=(12, 2.3 * rows), layout="constrained")
    axes = figure.subplots(rows, 3, squeeze=False).ravel()
    for ax in axes:
        ax.axis("off")
    for ax, image, title in zip(axes, images, titles, strict=False):
        ax.imshow(image)
        ax.set_title(_title(title), fontsize=9)
    return save(figure, path)


def _path(ax: Axes, trace: Trace) -> None:
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
    ax.plot(*trace.p_world_target, "*", ms=14, color="C3", label="target")
    circle = patches.Circle(
        trace.p_world_target, float(trace.params.d_success), fill=False, color="C3"
    )
    ax.add_patch(circle)
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)


def profile(params: RPSParams, path: Path) -> Path:
    """The logistic profile of Eq. 5 (in the paper's Fig. 3): a_r over the contact location."""
    l = jnp.linspace(-skin.HALF_WIDTH, skin.HALF_WIDTH, 401)  # noqa: E741
    far = jnp.asarray(2 * params.d_th)
    a_r = jax.vmap(lambda l: law.adaptive_rate(params, l, far))(l)  # noqa: E741
    figure = Figure(figsize=(5.5, 3.2), layout="constrained")
    ax = figure.subplots()
    ax.plot(l, a_r, color="C0")
    for side in (-1, 1):
        ax.axvspan(
            side * float(params.l_cr), side * skin.HALF_WIDTH, color=_SHADES["realigning"], lw=0
        )
        ax.axvline(side * float(params.beta), color="0.6", lw=0.7, ls="--")
    ax.set(xlabel="contact location $l$ [m]", ylabel="adaptive rate $a_r$ [1]")
    ax.set_title("Eq. 5; dashed: $\\pm\\beta$; shaded: critical region", fontsize=9)
    return save(figure, path)


# The law alone is shown for a contact on the middle of the front, and the base at the origin.


def _in_front(l: Any, error: Any, distance: Any) -> Observation:  # noqa: E741
    """Contacts (n,) [m] on the front, with targets at heading errors (n,) [rad] from them."""
    place, angle = jnp.asarray(l), jnp.asarray(error)
    contact = jnp.stack([jnp.full_like(place, skin.HALF_LENGTH), place], axis=-1)
    way = distance * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    touched = jnp.ones(place.shape, bool)
    return Observation(
        jnp.zeros_like(contact), jnp.zeros_like(place), contact, touched, contact + way
    )


@jax.jit
def _twists(params: RPSParams, state: RPSState, seen: Observation) -> Twist:
    """The law's twists (n,), of one state, at observations (n, ...)."""
    return jax.vmap(lambda one: law.step(params, state, one)[1])(seen)


def twist_field(sets: Mapping[str, RPSParams], distance: float, path: Path) -> Path:
    """The twist over contact location and heading error, a column for each set of parameters.

    Arrows are (v_x, v_y), forward upwards; the colour is omega. Above from outside the Realignment
    State, which |l| > l_cr enters; below from within it, which |l| <= l_mr leaves.
    """
    l = np.linspace(-skin.HALF_WIDTH, skin.HALF_WIDTH, 117)  # noqa: E741
    error = np.radians(np.linspace(-180, 180, 120, endpoint=False) + 1.5)
    places, angles = (axis.ravel() for axis in np.meshgrid(l, error))
    seen = _in_front(places, angles, distance)
    figure = Figure(figsize=(1 + 4.2 * len(sets), 7), layout="constrained")
    axes = figure.subplots(2, len(sets), squeeze=False, sharex=True, sharey=True)
    image = None
    for column, (name, params) in zip(axes.T, sets.items(), strict=True):
        for ax, threshold in zip(column, (params.l_cr, params.l_mr), strict=True):
            state = RPSState.init(params)._replace(l_th=jnp.asarray(threshold, float))
            twist = _twists(params, state, seen)
            v_x, v_y, omega = (np.asarray(part).reshape(error.size, l.size) for part in twist)
            limit = float(params.omega_max)
            image = ax.imshow(
                omega,
                extent=(l[0], l[-1], -180, 180),
                origin="lower",
                aspect="auto",
                alpha=0.6,
                cmap="RdBu",
                vmin=-limit,
                vmax=limit,
            )
            some = np.s_[10::20, 4::12]
            ax.quiver(*np.meshgrid(l[some[1]], np.degrees(error[some[0]])), -v_y[some], v_x[some],
                      scale=0.7, width=0.006)  # fmt: skip
            for side in (-1, 1):
                ax.axvline(side * float(threshold), color="0.3", lw=0.8, ls="--")
        column[0].set_title(f"{name}: $l_{{th}} = l_{{cr}}$", fontsize=9)
        column[1].set_title(f"{name}: $l_{{th}} = l_{{mr}}$", fontsize=9)
        column[1].set_xlabel("contact location $l$ [m], left is left")
    axes[0, 0].invert_xaxis()  # which all panels share
    for ax in axes[:, 0]:
        ax.set_ylabel("heading error [deg]")
    assert image is not None
    figure.colorbar(image, ax=axes, shrink=0.7).set_label(r"$\omega$ [rad/s]")
    return save(figure, path)


def hysteresis(sets: Mapping[str, RPSParams], ripple: float, path: Path) -> Path:
    """A contact that wanders out to the edge and back, a column for each set of parameters.

    Above, over time, with a ripple [m] on its way; blue: Realignment State. Below, without one,
    the adaptive rate over the contact's location.
    """
    time = np.linspace(0, 60, 3001)  # [s]
    there = 0.28 * (1 - np.abs(time / 30 - 1))
    rippled = there + ripple * np.sin(2 * np.pi * time)
    figure = Figure(figsize=(1 + 3.6 * len(sets), 5), layout="constrained")
    axes = figure.subplots(2, len(sets), squeeze=False, sharey="row")
    for (above, below), (name, params) in zip(axes.T, sets.items(), strict=True):
        realigning = np.asarray(_swept(params, jnp.asarray(rippled)).realigning)
        entries = int(np.sum(np.diff(realigning.astype(int)) > 0))
        above.plot(time, rippled, color="C0", lw=1)
        _shade(above, time, realigning, _SHADES["realigning"])
        for threshold in (params.l_mr, params.l_cr):
            above.axhline(float(threshold), color="0.5", lw=0.8, ls="--")
        above.set_title(f"{name}: entries into Realignment: {entries}", fontsize=9)
        above.set_xlabel("time [s]")
        a_r, half = np.asarray(_swept(params, jnp.asarray(there)).a_r), time.size // 2
        below.plot(there[:half], a_r[:half], color="C3", label="outwards")
        below.plot(there[half:], a_r[half:], color="C0", ls="--", label="back")
        below.set_xlabel("contact location $l$ [m]")
    axes[0, 0].set_ylabel("$l$ [m]")
    axes[1, 0].set_ylabel("adaptive rate $a_r$ [1]")
    axes[1, 0].legend(fontsize=8)
    return save(figure, path)


@jax.jit
def _swept(params: RPSParams, l: jax.Array) -> Details:  # noqa: E741
    """The law, one step after the other, far from a target straight ahead: details (n,)."""

    def one(state: RPSState, seen: Observation) -> tuple[RPSState, Details]:
        state, _, details = law.step_with_details(params, state, seen)
        return state, details

    seen = _in_front(l, jnp.zeros_like(l), 2 * jnp.asarray(params.d_th))
    return jax.lax.scan(one, RPSState.init(params), seen)[1]


def paths(traces: Mapping[str, Sequence[Trace]], targets: Sequence, path: Path) -> Path:
    """Fig. 7: the ways of the base to every target, and the contact points at the end."""
    figure = Figure(figsize=(5.2 * len(traces), 5), layout="constrained")
    axes = figure.subplots(1, len(traces), squeeze=False, sharey=True)[0]
    for ax, (name, rows) in zip(axes, traces.items(), strict=True):
        ax.add_patch(_base_patch(np.zeros(3), fill=True))
        for target, trace in zip(targets, rows, strict=True):
            (line,) = ax.plot(*np.asarray(trace.snapshots.qpos[:, :2]).T, lw=1.2)
            ax.plot(*target, "*", ms=12, color=line.get_color())
            contacts = np.asarray(trial.p_world_contact(trace.snapshots))
            touching = contacts[np.isfinite(contacts[:, 0])]
            if len(touching):
                ax.plot(*touching[-1], "o", ms=5, mfc="white", color=line.get_color())
        won = sum(bool(trace.outcome.success) for trace in rows)
        ax.set(xlabel="x [m]", aspect="equal")
        ax.set_title(f"{_title(name)}: {won} of {len(rows)}", fontsize=10)
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("y [m]")
    figure.suptitle("lines: base; stars: targets; circles: last contact point", fontsize=9)
    return save(figure, path)


def time_to_success(results: xr.Dataset, strategy: str, path: Path) -> Path:
    """Time of the successes over the target's distance, coloured by how far it lies off ahead."""
    distance = np.hypot(results.target_x.values, results.target_y.values)
    off = np.degrees(np.abs(np.arctan2(results.target_y.values, results.target_x.values)))
    objects = list(map(str, results.object.values))
    figure = Figure(figsize=(1 + 3.2 * len(objects), 3.4), layout="constrained")
    axes = figure.subplots(1, len(objects), squeeze=False, sharey=True)[0]
    image = None
    for ax, name in zip(axes, objects, strict=True):
        part = results.sel(strategy=strategy, object=name)
        for marker, friction in zip("osv^", map(str, part.friction.values), strict=False):
            one = part.sel(friction=friction)
            time = one.time.where(one.success == 1).values
            image = ax.scatter(
                distance, time, c=off, marker=marker, vmin=0, vmax=180, s=26, label=friction
            )
        ax.set(xlabel="distance of the target [m]", title=_title(name))
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("time to success [s]")
    axes[0].legend(fontsize=8)
    assert image is not None
    figure.colorbar(image, ax=axes).set_label("target off straight ahead [deg]")
    return save(figure, path)


def _rates(ax: Axes, x: np.ndarray, won: np.ndarray, of: np.ndarray, **style) -> None:
    """Success rates in percent with their Wilson 95 % intervals."""
    rate = 100 * won / np.maximum(of, 1)
    ends = np.array([tables.wilson(int(n), int(m)) for n, m in zip(won, of, strict=True)]) * 100
    errors = np.abs(np.stack([rate - ends[:, 0], ends[:, 1] - rate]))
    ax.errorbar(x, rate, errors, capsize=2, marker="o", ms=4, lw=1.2, **style)


def tolerance_curve(curve: xr.Dataset, trials: int, path: Path) -> Path:
    """Success of RPS, and time without contact, over skin tolerance.

    A column for each behaviour on loss of contact; `curve` is what `ambiguity.by_tolerance` gives,
    successes out of `trials`.
    """
    columns = curve.sizes["loss"]
    figure = Figure(figsize=(4 * columns, 5), layout="constrained")
    axes = figure.subplots(2, columns, squeeze=False, sharex=True, sharey="row")
    x = curve.tolerance.values
    for (above, below), loss in zip(axes.T, map(str, curve.loss.values), strict=True):
        for i, name in enumerate(map(str, curve.object.values)):
            one = curve.sel(loss=loss, object=name)
            style = {"color": _OBJECT_COLOURS[name], "label": _title(name)}
            beside = x + 0.15 * (i - 1)  # where curves coincide
            _rates(above, beside, one.won.values, np.full(len(x), trials), **style)
            below.plot(beside, one.lost.values, "o-", ms=4, lw=1.2, **style)
        above.set_title(f"on loss: {ambiguity.ON_LOSS[loss][0]}", fontsize=9)
        above.set_ylim(-3, 103)
        below.set_xlabel("skin tolerance [mm]")
        for ax in (above, below):
            ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("success [%]")
    axes[1, 0].set_ylabel("mean time without contact [s]")
    axes[0, -1].legend(fontsize=8)
    return save(figure, path)


def shift_curve(results: xr.Dataset, path: Path) -> Path:
    """Success over the size of the shove, with Wilson 95 % intervals."""
    figure = Figure(figsize=(5.5, 3.4), layout="constrained")
    ax = figure.subplots()
    sizes = results["shift"].values
    for name in map(str, results.object.values):
        pairs = np.array([hardware.recovered(results, name, float(size)) for size in sizes])
        _rates(
            ax,
            100 * sizes,
            pairs[:, 0],
            pairs[:, 1],
            color=_OBJECT_COLOURS[name],
            label=_title(name),
        )
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


def throughput(speeds: Sequence[Speed], path: Path) -> Path:
    """Simulated seconds per second over the batch, a panel for each family; C as a line."""
    families = list(dict.fromkeys(s.family for s in speeds))
    figure = Figure(figsize=(4.5 * len(families), 4.0), layout="constrained")
    axes = figure.subplots(1, len(families), squeeze=False, sharey=True)[0]
    for ax, family in zip(axes, families, strict=True):
        mine = [s for s in speeds if s.family == family]
        for i, name in enumerate(dict.fromkeys(s.name for s in mine)):
            points = [(s.worlds, s.rate) for s in mine if s.name == name]
            if name in benchmark.IN_C:
                ax.axhline(points[0][1], color=f"C{i}", ls="--", label=name)
            else:
                ax.plot(*zip(*points, strict=True), marker="o", color=f"C{i}", label=name)
        ax.set(xscale="log", yscale="log", xlabel="worlds in the batch", title=_title(family))
        ax.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("simulated s per s")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return save(figure, path)


def levers(gains: Sequence[Gain], path: Path) -> Path:
    """How many times as fast each lever makes a program, as bars from 1."""
    pulled = gains[::-1]
    figure = Figure(figsize=(7.0, 1.2 + 0.28 * len(pulled)), layout="constrained")
    ax = figure.subplots()
    times = np.array([g.times for g in pulled])
    colours = ["C0" if t >= 1 else "C1" for t in times]
    ax.barh([g.lever for g in pulled], times - 1, left=1, color=colours)
    for row, t in enumerate(times):
        ax.annotate(
            f"{t:.2f}", (t, row), (3 if t >= 1 else -3, 0), textcoords="offset points",
            va="center", ha="left" if t >= 1 else "right", fontsize=8,
        )  # fmt: skip
    ax.axvline(1, color="k", lw=0.8)
    ax.set(
        xscale="log", xlabel="times as fast", title=f"{gains[0].name}, {_title(gains[0].family)}"
    )
    ax.margins(x=0.15)
    ax.grid(alpha=0.3, axis="x", which="both")
    ax.set_axisbelow(True)
    return save(figure, path)


def success_curves(results: xr.Dataset, path: Path) -> Path:
    """Success against every quantity that was drawn, one line an arm, Wilson 95 % intervals."""
    drawn = statistics.drawn(results)
    rows = -(-len(drawn) // 4)
    figure = Figure(figsize=(13, 2.6 * rows), layout="constrained")
    axes = figure.subplots(rows, 4, squeeze=False, sharey=True)
    for ax in axes.ravel()[len(drawn) :]:
        ax.axis("off")
    least = 1.0
    for ax, name in zip(axes.ravel(), drawn, strict=False):
        for i, arm in enumerate(map(str, results.arm.values)):
            won = results.success.sel(arm=arm).values > 0
            found = statistics.bins(results[name].values, won)
            _rates(ax, found.middle, found.won, found.of, color=f"C{i}", label=arm)
            least = min(least, (found.won / found.of).min())
        ax.set_xlabel(f"{statistics.DRAWN[name]} [{results[name].attrs['units']}]", fontsize=8)
        ax.grid(alpha=0.3)
    for ax in axes[:, 0]:
        ax.set(ylabel="success [%]", ylim=(max(-3.0, 100 * least - 10), 103))
    axes[0, 0].legend(fontsize=8)
    return save(figure, path)


def tuning(log: Sequence[Mapping], names: Sequence[str], path: Path) -> Path:
    """Evolution, generation by generation: values, validation, and the mean's parameters."""
    generation = [line["generation"] for line in log]

    def of(key: str) -> np.ndarray:
        return np.array([np.nan if line[key] is None else line[key] for line in log], float)

    columns = 4
    rows = 1 + -(-len(names) // columns)
    figure = Figure(figsize=(11, 2.6 + 1.7 * (rows - 1)), layout="constrained")
    grid = figure.add_gridspec(rows, columns, height_ratios=[1.6] + [1] * (rows - 1))
    ax = figure.add_subplot(grid[0, :2])
    mean, spread = of("mean"), of("spread")
    ax.fill_between(generation, mean - spread, mean + spread, alpha=0.2, lw=0)
    ax.plot(generation, mean, label="candidates: mean, and their spread")
    ax.plot(generation, of("best"), label="best candidate")
    ax.plot(generation, of("base"), "k--", lw=1, label="parameters at the start, same worlds")
    ax.set(xlabel="generation", ylabel="objective [1]")
    ax.legend(fontsize=8)
    ax = figure.add_subplot(grid[0, 2:])
    ax.plot(generation, of("validation"), "C2", label="objective")
    ax.margins(y=0.3)  # room for the legends
    ax.set(xlabel="generation", ylabel="mean on validation worlds [1]")
    ax.legend(loc="upper left", fontsize=8)
    twin = ax.twinx()
    twin.plot(generation, 100 * of("validation_success"), "C3", label="success")
    twin.margins(y=0.3)
    twin.set_ylabel("success [%]")
    twin.legend(loc="upper right", fontsize=8)
    for i, name in enumerate(names):
        ax = figure.add_subplot(grid[1 + i // columns, i % columns])
        ax.plot(generation, [line["params"][name] for line in log])
        ax.set_title(name, fontsize=9)
        ax.tick_params(labelsize=7)
    return save(figure, path)


def races(runs: Mapping[str, Sequence[Mapping]], path: Path) -> Path:
    """Tuners' runs side by side: the best validation so far against what was simulated before it.

    A run that continues another is the sum of both logs.
    """
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    axes = figure.subplots(1, 2)
    for name, log in runs.items():
        simulated = np.cumsum([0.0] + [line["simulated"] for line in log[:-1]]) / 1e6
        value = np.array([line["validation"] for line in log], float)
        best = np.fmin.accumulate(value)
        success = np.array([line["validation_success"] for line in log], float)
        chosen = np.maximum.accumulate(np.where(value == best, np.arange(len(log)), 0))
        for ax, at in zip(axes, (best, 100 * success[chosen]), strict=True):
            ax.step(simulated, at, where="post", label=name)
    for ax, label in zip(axes, ("objective [1]", "success [%]"), strict=True):
        ax.set(xlabel="simulated [10$^6$ s]", ylabel=f"{label}, best mean so far")
    axes[0].legend(fontsize=8)
    return save(figure, path)


def failures(results: xr.Dataset, max_lost: float, path: Path) -> Path:
    """Failures by their kind, a column for each object.

    Above, the share of its worlds that each arm loses; below, how far from the target they end,
    over the object's width.
    """
    groups = statistics.worlds_by_object(results)
    arms = {str(name): results.sel(arm=name) for name in results.arm.values}
    kinds = {name: statistics.failure(one, max_lost) for name, one in arms.items()}
    figure = Figure(figsize=(1 + 2.8 * len(groups), 5.2), layout="constrained")
    axes = figure.subplots(2, len(groups), squeeze=False, sharey="row")
    most = 1.0
    for (above, below), (name, mask) in zip(axes.T, groups.items(), strict=True):
        under = np.zeros(len(arms))
        for i, kind in enumerate(statistics.FAILURES):
            share = np.array([100 * np.mean(found[mask] == i) for found in kinds.values()])
            above.bar(list(arms), share, bottom=under, color=f"C{i}", label=kind)
            under += share
            most = max(most, under.max())
            for marker, (arm, one) in zip("ox+s", arms.items(), strict=False):
                here = mask & (kinds[arm] == i)
                width, left = results["size"].values[here], statistics.left_over(one)[here]
                below.semilogy(width, left, marker, ms=4, color=f"C{i}")
        above.set_title(f"{_title(name)}, {mask.sum()} worlds", fontsize=9)
        above.grid(alpha=0.3, axis="y")
        below.set_xlabel("half width of the object [m]")
        below.grid(alpha=0.3)
    axes[0, 0].set(ylabel="worlds lost [%]", ylim=(0, 1.08 * most))
    axes[0, -1].legend(fontsize=8)
    axes[1, 0].set_ylabel("least distance to the target [m]")
    marks = [f"{arm}: {mark}" for mark, arm in zip(("dot", "cross", "plus"), arms, strict=False)]
    axes[1, 0].set_title(", ".join(marks), fontsize=8)
    return save(figure, path)


def paired(results: xr.Dataset, path: Path) -> Path:
    """Time of the second arm over that of the first, world by world.

    Worlds that one arm alone wins stand on the margin of the other, beyond the dashed line.
    """
    first, second = map(str, results.arm.values)
    a, b = (results.sel(arm=arm) for arm in (first, second))
    won_a, won_b = a.success.values > 0, b.success.values > 0
    edge = 1.02 * float(results.time.max())
    x, y = np.where(won_a, a.time, 1.03 * edge), np.where(won_b, b.time, 1.03 * edge)
    figure = Figure(figsize=(5.4, 5.2), layout="constrained")
    ax = figure.subplots()
    for label, mask, colour in (
        ("both", won_a & won_b, "C0"),
        (f"{first} alone", won_a & ~won_b, "C3"),
        (f"{second} alone", ~won_a & won_b, "C2"),
    ):
        ax.plot(x[mask], y[mask], ".", ms=4, color=colour, label=f"won by {label}: {mask.sum()}")
    ax.plot([0, edge], [0, edge], color="0.5", lw=0.8)
    ax.axvline(edge, color="0.5", lw=0.8, ls="--")
    ax.axhline(edge, color="0.5", lw=0.8, ls="--")
    neither = int(np.sum(~won_a & ~won_b))
    ax.set(xlabel=f"{first}: time to success [s]", ylabel=f"{second}: time to success [s]")
    ax.set_title(f"{won_a.size} worlds; won by neither: {neither}", fontsize=9)
    figure.legend(fontsize=8, loc="outside lower center", ncols=3)
    return save(figure, path)


def between_bounds(places: Mapping[str, np.ndarray], names: Sequence[str], path: Path) -> Path:
    """Where sets of parameters (p,) lie between the bounds of tuning, from 0 to 1."""
    figure = Figure(figsize=(6, 0.8 + 0.27 * len(names)), layout="constrained")
    ax = figure.subplots()
    y = np.arange(len(names))[::-1]
    every = np.stack(list(places.values()))
    ax.hlines(y, every.min(axis=0), every.max(axis=0), color="0.7")
    for label, place in places.items():
        ax.plot(place, y, "o", label=label)
    ax.set_yticks(y, names)
    ax.set(xlim=(-0.02, 1.02), xlabel="place between the bounds of tuning [1]")
    ax.grid(alpha=0.3, axis="x")
    ax.legend(fontsize=8)
    return save(figure, path)


def estimates(
    horizons: Sequence[float],
    found: Mapping[str, tuple[np.ndarray, np.ndarray]],
    names: Sequence[str],
    path: Path,
) -> Path:
    """Gradients (H, p) and their variances, by estimator, over horizons (H,) [s].

    Bars reach two standard errors to either side.
    """
    figure = Figure(figsize=(1 + 2.8 * len(names), 3.2), layout="constrained")
    axes = figure.subplots(1, len(names), squeeze=False)[0]
    for p, (ax, name) in enumerate(zip(axes, names, strict=True)):
        for i, (label, (gradient, variance)) in enumerate(found.items()):
            beside = np.asarray(horizons) * 1.06 ** (i - 1)
            errors = 2 * np.sqrt(variance[:, p])
            ax.errorbar(beside, gradient[:, p], errors, fmt="o", ms=4, capsize=2, label=label)
        ax.axhline(0, color="0.5", lw=0.8)
        ax.set(xscale="log", xlabel="horizon [s]", title=name)
        ax.set_xticks(horizons, [f"{h:g}" for h in horizons])
        ax.minorticks_off()
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("gradient [m]")
    axes[0].legend(fontsize=8)
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


def sensitivity(results: xr.Dataset, path: Path) -> Path:
    """Success against each parameter alone, with Wilson 95 % intervals."""
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
            _rates(ax, one.value.values, won, np.full(won.size, of), color=f"C{i}", label=which)
        ax.set_xlabel(name, fontsize=9)
        ax.grid(alpha=0.3)
        if tune.BOUNDS[name].log:
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
