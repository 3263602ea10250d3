"""Figures of the notebooks, from labelled data or law parameters."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import Details, Observation, Robot, RPSParams, RPSState, Twist, step
from rps_jax.analysis import statistics
from rps_jax.analysis.figures.style import SHADES, Figure, shade
from rps_jax.analysis.figures.style import quantity as quantity
from rps_jax.analysis.figures.style import words as words
from rps_jax.laws import law_of


def listed(names: Iterable[str]) -> str:
    """Return names in words, sorted: "a, b and c", or "none"."""
    *rest, last = sorted(names) or ["none"]
    return f"{', '.join(rest)} and {last}" if rest else last


# --- the law: contacts on the front of a base at the origin -----------------------------------


def _in_front(l: Any, error: Any, distance: Any) -> Observation:  # noqa: E741
    """Return observations (n,) of contact offsets `l` [m] on the front and heading errors [rad]."""
    offset, angle = jnp.asarray(l), jnp.asarray(error)
    contact = jnp.stack([jnp.full_like(offset, Robot().half_length), offset], axis=-1)
    d = distance * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    in_contact = jnp.ones(offset.shape, bool)
    yaw, period = jnp.zeros_like(offset), jnp.full(offset.shape, 0.02)
    return Observation(jnp.zeros_like(contact), yaw, contact, in_contact, contact + d, period)


@jax.jit
def _twists(params: RPSParams, state: RPSState, observations: Observation) -> Twist:
    """Return the law's twists (n,) for one state and observations (n, ...)."""
    return jax.vmap(lambda obs: step(params, state, obs)[1])(observations)


def twist_field(sets: Mapping[str, RPSParams], distance: float) -> Figure:
    """Plot the twist over contact offset and heading error, one column per set of parameters.

    Arrows are (v_x, v_y), forward upwards; the colour is omega. The upper row starts outside the
    Realignment State, which |l| > l_cr enters; the lower row inside, which |l| <= l_mr leaves.
    """
    half_width = float(Robot().half_width)
    l = np.linspace(-half_width, half_width, 117)  # noqa: E741
    error = np.radians(np.linspace(-180, 180, 120, endpoint=False) + 1.5)
    offsets, angles = (axis.ravel() for axis in np.meshgrid(l, error))
    observations = _in_front(offsets, angles, distance)
    figure = Figure(figsize=(1 + 4.2 * len(sets), 7), layout="constrained")
    axes = figure.subplots(2, len(sets), squeeze=False, sharex=True, sharey=True)
    image = None
    for column, (name, params) in zip(axes.T, sets.items(), strict=True):
        for ax, threshold in zip(column, (params.l_cr, params.l_mr), strict=True):
            state = RPSState.init(params)._replace(l_th=jnp.asarray(threshold, float))
            twist = _twists(params, state, observations)
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
            rows = np.s_[10::20, 4::12]
            ax.quiver(
                *np.meshgrid(l[rows[1]], np.degrees(error[rows[0]])),
                -v_y[rows],
                v_x[rows],
                scale=0.7,
                width=0.006,
            )
            for side in (-1, 1):
                ax.axvline(side * float(threshold), color="0.3", lw=0.8, ls="--")
        column[0].set_title(f"{name}: $l_{{th}} = l_{{cr}}$", fontsize=9)
        column[1].set_title(f"{name}: $l_{{th}} = l_{{mr}}$", fontsize=9)
        column[1].set_xlabel("contact offset $l$ [m], left is left")
    axes[0, 0].invert_xaxis()  # shared by all panels
    for ax in axes[:, 0]:
        ax.set_ylabel("heading error [deg]")
    assert image is not None
    figure.colorbar(image, ax=axes, shrink=0.7).set_label(r"$\omega$ [rad/s]")
    return figure


def hysteresis(sets: Mapping[str, RPSParams], ripple: float) -> Figure:
    """Plot a contact that moves to the edge and back, one column per set of parameters.

    Upper row: contact offset over time, with a ripple [m]; blue: Realignment State. Lower row:
    adaptive rate over contact offset, without the ripple.
    """
    time = np.linspace(0, 60, 3001)  # [s]
    offset = 0.28 * (1 - np.abs(time / 30 - 1))
    rippled = offset + ripple * np.sin(2 * np.pi * time)
    figure = Figure(figsize=(1 + 3.6 * len(sets), 5), layout="constrained")
    axes = figure.subplots(2, len(sets), squeeze=False, sharey="row")
    for (upper, lower), (name, params) in zip(axes.T, sets.items(), strict=True):
        realigning = np.asarray(_swept(params, jnp.asarray(rippled)).realigning)
        entries = int(np.sum(np.diff(realigning.astype(int)) > 0))
        upper.plot(time, rippled, color="C0", lw=1)
        shade(upper, time, realigning, SHADES["realigning"])
        for threshold in (params.l_mr, params.l_cr):
            upper.axhline(float(threshold), color="0.5", lw=0.8, ls="--")
        upper.set_title(f"{name}: entries into Realignment: {entries}", fontsize=9)
        upper.set_xlabel("time [s]")
        a_r, half = np.asarray(_swept(params, jnp.asarray(offset)).a_r), time.size // 2
        lower.plot(offset[:half], a_r[:half], color="C3", label="outwards")
        lower.plot(offset[half:], a_r[half:], color="C0", ls="--", label="back")
        lower.set_xlabel("contact offset $l$ [m]")
    axes[0, 0].set_ylabel("$l$ [m]")
    axes[1, 0].set_ylabel("adaptive rate $a_r$ [1]")
    axes[1, 0].legend(fontsize=8)
    return figure


@jax.jit
def _swept(params: RPSParams, l: jax.Array) -> Details:  # noqa: E741
    """Return the details (n,) of consecutive steps, far from a target straight ahead."""

    def step(state: RPSState, obs: Observation) -> tuple[RPSState, Details]:
        state, _, details = law.step(params, state, obs)
        return state, details

    law, observations = (
        law_of(params),
        _in_front(l, jnp.zeros_like(l), 2 * jnp.asarray(params.d_th)),
    )
    return jax.lax.scan(step, RPSState.init(params), observations)[1]


# --- trials and worlds -----------------------------------------------------------------------


def time_to_success(results: xr.Dataset, law: str) -> Figure:
    """Plot the time of successes over the target's distance, coloured by its angle."""
    distance = np.hypot(results.target_x.values, results.target_y.values)
    angle = np.degrees(np.abs(np.arctan2(results.target_y.values, results.target_x.values)))
    objects = list(map(str, results.object.values))
    figure = Figure(figsize=(1 + 3.2 * len(objects), 3.4), layout="constrained")
    axes = figure.subplots(1, len(objects), squeeze=False, sharey=True)[0]
    image = None
    for ax, name in zip(axes, objects, strict=True):
        part = results.sel(law=law, object=name)
        for marker, friction in zip("osv^", map(str, part.friction.values), strict=False):
            trials = part.sel(friction=friction)
            time = trials.time.where(trials.success == 1).values
            image = ax.scatter(
                distance, time, c=angle, marker=marker, vmin=0, vmax=180, s=26, label=friction
            )
        ax.set(xlabel="distance of the target [m]", title=words(name))
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("time to success [s]")
    axes[0].legend(fontsize=8)
    assert image is not None
    figure.colorbar(image, ax=axes).set_label("angle of the target from straight ahead [deg]")
    return figure


def failures(results: xr.Dataset, max_lost: float) -> Figure:
    """Plot failures by failure mode, one column per object.

    Upper row: share of failed worlds of each law. Lower row: smallest distance to the target over
    the object's width.
    """
    groups = statistics.worlds_by_object(results)
    laws = {str(name): results.sel(law=name) for name in results.law.values}
    modes = {name: statistics.failure_modes(part, max_lost) for name, part in laws.items()}
    figure = Figure(figsize=(1 + 2.8 * len(groups), 5.2), layout="constrained")
    axes = figure.subplots(2, len(groups), squeeze=False, sharey="row")
    highest = 1.0
    for (upper, lower), (name, mask) in zip(axes.T, groups.items(), strict=True):
        bottom = np.zeros(len(laws))
        for i, kind in enumerate(statistics.FAILURES):
            share = np.array([100 * np.mean(mode[mask] == i) for mode in modes.values()])
            upper.bar(list(laws), share, bottom=bottom, color=f"C{i}", label=kind)
            bottom += share
            highest = max(highest, bottom.max())
            for marker, (law, part) in zip("ox+s", laws.items(), strict=False):
                rows = mask & (modes[law] == i)
                width, left_m = results["size"].values[rows], statistics.distance_left(part)[rows]
                lower.semilogy(width, left_m, marker, ms=4, color=f"C{i}")
        upper.set_title(f"{words(name)}, {mask.sum()} worlds", fontsize=9)
        upper.grid(alpha=0.3, axis="y")
        lower.set_xlabel("half width of the object [m]")
        lower.grid(alpha=0.3)
    axes[0, 0].set(ylabel="failed worlds [%]", ylim=(0, 1.08 * highest))
    axes[0, -1].legend(fontsize=8)
    axes[1, 0].set_ylabel("smallest distance to the target [m]")
    marks = [f"{law}: {mark}" for mark, law in zip(("dot", "cross", "plus"), laws, strict=False)]
    axes[1, 0].set_title(", ".join(marks), fontsize=8)
    return figure


def paired(results: xr.Dataset) -> Figure:
    """Plot the time of the second law over that of the first, one point per world.

    Worlds in which only one law succeeds are on the margin of the other, beyond the dashed line.
    """
    first, second = map(str, results.law.values)
    a, b = (results.sel(law=law) for law in (first, second))
    success_a, success_b = a.success.values > 0, b.success.values > 0
    edge = 1.02 * float(results.time.max())
    x, y = np.where(success_a, a.time, 1.03 * edge), np.where(success_b, b.time, 1.03 * edge)
    figure = Figure(figsize=(5.4, 5.2), layout="constrained")
    ax = figure.subplots()
    for label, mask, colour in (
        ("both", success_a & success_b, "C0"),
        (f"{first} only", success_a & ~success_b, "C3"),
        (f"{second} only", ~success_a & success_b, "C2"),
    ):
        ax.plot(
            x[mask], y[mask], ".", ms=4, color=colour, label=f"success of {label}: {mask.sum()}"
        )
    ax.plot([0, edge], [0, edge], color="0.5", lw=0.8)
    ax.axvline(edge, color="0.5", lw=0.8, ls="--")
    ax.axhline(edge, color="0.5", lw=0.8, ls="--")
    both_fail = int(np.sum(~success_a & ~success_b))
    ax.set(xlabel=f"{first}: time to success [s]", ylabel=f"{second}: time to success [s]")
    ax.set_title(f"{success_a.size} worlds; both fail: {both_fail}", fontsize=9)
    figure.legend(fontsize=8, loc="outside lower center", ncols=3)
    return figure


# --- tuning ----------------------------------------------------------------------------------


def between_bounds(fractions: Mapping[str, np.ndarray], names: Sequence[str]) -> Figure:
    """Plot sets of parameters (p,) as fractions between the bounds of tuning, from 0 to 1."""
    figure = Figure(figsize=(6, 0.8 + 0.27 * len(names)), layout="constrained")
    ax = figure.subplots()
    y = np.arange(len(names))[::-1]
    stacked = np.stack(list(fractions.values()))
    ax.hlines(y, stacked.min(axis=0), stacked.max(axis=0), color="0.7")
    for label, values in fractions.items():
        ax.plot(values, y, "o", label=label)
    ax.set_yticks(y, names)
    ax.set(xlim=(-0.02, 1.02), xlabel="position between the bounds of tuning [1]")
    ax.grid(alpha=0.3, axis="x")
    ax.legend(fontsize=8)
    return figure
