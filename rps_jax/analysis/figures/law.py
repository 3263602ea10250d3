"""The law alone: a contact on the middle of the front, and the base at the origin."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.analysis.figures.style import SHADES, Figure, shade
from rps_jax.control.laws import rps
from rps_jax.control.laws.rps import RPSParams, RPSState
from rps_jax.control.observation import Details, Observation, Twist
from rps_jax.robot import shell


def profile(params: RPSParams) -> Figure:
    """The logistic profile of Eq. 5 (in the paper's Fig. 3): a_r over the contact location."""
    l = jnp.linspace(-shell.HALF_WIDTH, shell.HALF_WIDTH, 401)  # noqa: E741
    far = jnp.asarray(2 * params.d_th)
    a_r = jax.vmap(lambda l: rps.adaptive_rate(params, l, far))(l)  # noqa: E741
    figure = Figure(figsize=(5.5, 3.2), layout="constrained")
    ax = figure.subplots()
    ax.plot(l, a_r, color="C0")
    for side in (-1, 1):
        ax.axvspan(
            side * float(params.l_cr), side * shell.HALF_WIDTH, color=SHADES["realigning"], lw=0
        )
        ax.axvline(side * float(params.beta), color="0.6", lw=0.7, ls="--")
    ax.set(xlabel="contact location $l$ [m]", ylabel="adaptive rate $a_r$ [1]")
    ax.set_title("Eq. 5; dashed: $\\pm\\beta$; shaded: critical region", fontsize=9)
    return figure


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
