"""Figures that the notebooks alone draw, each of labelled data or of parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax.analysis import statistics
from rps_jax.analysis.figures.style import SHADES, Figure, shade, words
from rps_jax.control.laws import rps
from rps_jax.control.laws.rps import RPSParams, RPSState
from rps_jax.control.observation import Details, Observation, Twist
from rps_jax.robot import shell

# --- the law alone: a contact on the middle of the front, the base at the origin --------------


def _in_front(l: Any, error: Any, distance: Any) -> Observation:  # noqa: E741
    """Contacts (n,) [m] on the front, with targets at heading errors (n,) [rad] from them."""
    place, angle = jnp.asarray(l), jnp.asarray(error)
    contact = jnp.stack([jnp.full_like(place, shell.HALF_LENGTH), place], axis=-1)
    way = distance * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    touched = jnp.ones(place.shape, bool)
    still, period = jnp.zeros_like(place), jnp.full(place.shape, 0.02)
    return Observation(jnp.zeros_like(contact), still, contact, touched, contact + way, period)


@jax.jit
def _twists(params: RPSParams, state: RPSState, seen: Observation) -> Twist:
    """The law's twists (n,), of one state, at observations (n, ...)."""
    return jax.vmap(lambda one: rps.step(params, state, one)[1])(seen)


def twist_field(sets: Mapping[str, RPSParams], distance: float) -> Figure:
    """The twist over contact location and heading error, a column for each set of parameters.

    Arrows are (v_x, v_y), forward upwards; the colour is omega. Above from outside the Realignment
    State, which |l| > l_cr enters; below from within it, which |l| <= l_mr leaves.
    """
    l = np.linspace(-shell.HALF_WIDTH, shell.HALF_WIDTH, 117)  # noqa: E741
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
    return figure


def hysteresis(sets: Mapping[str, RPSParams], ripple: float) -> Figure:
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
        shade(above, time, realigning, SHADES["realigning"])
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
    return figure


@jax.jit
def _swept(params: RPSParams, l: jax.Array) -> Details:  # noqa: E741
    """The law, one step after the other, far from a target straight ahead: details (n,)."""

    def one(state: RPSState, seen: Observation) -> tuple[RPSState, Details]:
        state, _, details = rps.step_with_details(params, state, seen)
        return state, details

    seen = _in_front(l, jnp.zeros_like(l), 2 * jnp.asarray(params.d_th))
    return jax.lax.scan(one, RPSState.init(params), seen)[1]


# --- trials and worlds -----------------------------------------------------------------------


def time_to_success(results: xr.Dataset, law: str) -> Figure:
    """Time of the successes over the target's distance, coloured by how far it lies off ahead."""
    distance = np.hypot(results.target_x.values, results.target_y.values)
    off = np.degrees(np.abs(np.arctan2(results.target_y.values, results.target_x.values)))
    objects = list(map(str, results.object.values))
    figure = Figure(figsize=(1 + 3.2 * len(objects), 3.4), layout="constrained")
    axes = figure.subplots(1, len(objects), squeeze=False, sharey=True)[0]
    image = None
    for ax, name in zip(axes, objects, strict=True):
        part = results.sel(law=law, object=name)
        for marker, friction in zip("osv^", map(str, part.friction.values), strict=False):
            one = part.sel(friction=friction)
            time = one.time.where(one.success == 1).values
            image = ax.scatter(
                distance, time, c=off, marker=marker, vmin=0, vmax=180, s=26, label=friction
            )
        ax.set(xlabel="distance of the target [m]", title=words(name))
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("time to success [s]")
    axes[0].legend(fontsize=8)
    assert image is not None
    figure.colorbar(image, ax=axes).set_label("target off straight ahead [deg]")
    return figure


def failures(results: xr.Dataset, max_lost: float) -> Figure:
    """Failures by their kind, a column for each object.

    Above, the share of its worlds that each law loses; below, how far from the target they end,
    over the object's width.
    """
    groups = statistics.worlds_by_object(results)
    laws = {str(name): results.sel(law=name) for name in results.law.values}
    kinds = {name: statistics.failure_modes(one, max_lost) for name, one in laws.items()}
    figure = Figure(figsize=(1 + 2.8 * len(groups), 5.2), layout="constrained")
    axes = figure.subplots(2, len(groups), squeeze=False, sharey="row")
    most = 1.0
    for (above, below), (name, mask) in zip(axes.T, groups.items(), strict=True):
        under = np.zeros(len(laws))
        for i, kind in enumerate(statistics.FAILURES):
            share = np.array([100 * np.mean(found[mask] == i) for found in kinds.values()])
            above.bar(list(laws), share, bottom=under, color=f"C{i}", label=kind)
            under += share
            most = max(most, under.max())
            for marker, (law, one) in zip("ox+s", laws.items(), strict=False):
                here = mask & (kinds[law] == i)
                width, left = results["size"].values[here], statistics.distance_left(one)[here]
                below.semilogy(width, left, marker, ms=4, color=f"C{i}")
        above.set_title(f"{words(name)}, {mask.sum()} worlds", fontsize=9)
        above.grid(alpha=0.3, axis="y")
        below.set_xlabel("half width of the object [m]")
        below.grid(alpha=0.3)
    axes[0, 0].set(ylabel="worlds lost [%]", ylim=(0, 1.08 * most))
    axes[0, -1].legend(fontsize=8)
    axes[1, 0].set_ylabel("least distance to the target [m]")
    marks = [f"{law}: {mark}" for mark, law in zip(("dot", "cross", "plus"), laws, strict=False)]
    axes[1, 0].set_title(", ".join(marks), fontsize=8)
    return figure


def paired(results: xr.Dataset) -> Figure:
    """Time of the second law over that of the first, world by world.

    Worlds that one law alone wins stand on the margin of the other, beyond the dashed line.
    """
    first, second = map(str, results.law.values)
    a, b = (results.sel(law=law) for law in (first, second))
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
    return figure


# --- tuning ----------------------------------------------------------------------------------


def races(runs: Mapping[str, Sequence[Mapping]]) -> Figure:
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
    return figure


def between_bounds(places: Mapping[str, np.ndarray], names: Sequence[str]) -> Figure:
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
    return figure


def estimates(
    horizons: Sequence[float],
    found: Mapping[str, tuple[np.ndarray, np.ndarray]],
    names: Sequence[str],
) -> Figure:
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
    return figure
