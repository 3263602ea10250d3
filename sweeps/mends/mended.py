"""The tuned law with candidate additions, each of which a zero or its default disables.

RPS+ has the accepted additions; the others are documented here.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rps_jax import Details, Law, Observation, RPSParams, RPSState, Twist, register_law
from rps_jax.control.laws import rps_plus
from rps_jax.control.observation import displacement
from rps_jax.geometry import planar
from rps_jax.laws import law_of, resolve_law

TUNED = RPSParams.tuned()


class Mended(NamedTuple):
    """Parameters of the tuned law with additions, each of which a zero or its default disables."""

    law: RPSParams = TUNED
    d_near: float = 0.15  # [m] P1
    press: float = 0.2  # [1] P2
    over: float = 0.0  # [m] P1 also while it realigns, if |l| is less
    flush: float = 0.0  # [1] share of omega_max with which the base turns flush while it realigns
    edge: float = 0.17  # [m] of |l| from where it does
    turn: float = 0.5  # [rad] at most
    agree: float = 0.0  # [1] 1: only towards the target
    forward: float = 0.2  # [1] share of v_max with which it presses meanwhile
    n_lost: float = 1e9  # [1] control steps without contact before P3
    ahead: float = 0.0  # [1] P3
    aside: float = 0.0  # [1] P3

    @property
    def d_success(self) -> Any:
        """[m] Target reached."""
        return self.law.d_success


class MendedState(NamedTuple):
    """State of the law."""

    law: RPSState
    yaw: Any  # () [rad] at the start of the last realignment
    realigning: Any  # () bool
    lost: Any  # () control steps without contact
    p_world_felt: Any  # (2,) [m]


def init(params: Mended) -> MendedState:
    """Return the state before the first touch."""
    zero = jnp.zeros(())
    return MendedState(RPSState.init(params.law), zero, zero > 0, zero, jnp.zeros(2))


def step(
    params: Mended, state: MendedState, obs: Observation
) -> tuple[MendedState, Twist, Details]:
    """Return state, twist and details of one control step."""
    rps_state, twist, details = law_of(params.law).step(params.law, state.law, obs)
    contact, l = rps_state.p_robot_contact, details.l  # noqa: E741
    touching, realigning = jnp.asarray(obs.in_contact), details.realigning
    d = displacement(obs._replace(p_robot_contact=contact))
    error = planar.wrap(planar.direction(d) - obs.yaw)
    yaw = jnp.where(realigning & ~state.realigning, obs.yaw, state.yaw)
    near = (touching | rps_state.touched) & (~realigning | (jnp.abs(l) < params.over))
    near &= (details.distance < params.d_near) & (details.distance >= params.law.d_success)
    flush = touching & realigning & (params.flush > 0) & (jnp.abs(l) >= params.edge) & ~near
    flush &= jnp.abs(planar.wrap(obs.yaw - yaw)) < params.turn
    flush &= (params.agree == 0) | (jnp.sign(l) * error > 0.05)
    omega = jnp.sign(l) * params.flush * params.law.omega_max
    pressing = jnp.array([1.0, 0.0]) * params.forward * params.law.v_max
    turning = Twist.from_point_velocity(contact, pressing, omega)
    turning = turning.saturate(params.law.v_max, params.law.omega_max)
    p_world = obs.p_world_robot + planar.rotate(obs.yaw, contact)
    felt = jnp.where(touching, p_world, state.p_world_felt)
    lost = jnp.where(touching, 0.0, state.lost + rps_state.touched)
    p_robot_felt = planar.rotate(-obs.yaw, felt - obs.p_world_robot)
    plus: Any = resolve_law("rps_plus")[1]
    plus = plus._replace(**{name: getattr(params, name) for name in plus._fields})
    for condition, replacement in (
        (flush, turning),
        (near, rps_plus.translation(plus, d, obs.yaw)),
        (lost > params.n_lost, rps_plus.search(plus, p_robot_felt, contact[1])),
    ):
        twist = jax.tree.map(lambda a, b, c=condition: jnp.where(c, a, b), replacement, twist)
    return MendedState(rps_state, yaw, realigning, lost, felt), twist, details


FIRST = "P1, P2 outside the Realignment State"
MENDS = {
    FIRST: Mended(),
    "the tuned law": Mended(d_near=0.0),
    "P1 to 0.25 m": Mended(d_near=0.25),
    "P1 to 0.4 m": Mended(d_near=0.4),
    "P1 while realigning, |l| < 0.2 m": Mended(over=0.2),
    "P1 while realigning, |l| < 0.25 m": Mended(over=0.25),
    "P1 while realigning": Mended(over=0.3),
    "P1 while realigning, |l| < 0.25 m, to 0.25 m": Mended(over=0.25, d_near=0.25),
    "turn flush, 0.3, to 0.3 rad": Mended(flush=0.3, turn=0.3),
    "turn flush, 0.3, to 0.8 rad": Mended(flush=0.3, turn=0.8),
    "turn flush, 0.6, to 0.3 rad": Mended(flush=0.6, turn=0.3),
    "turn flush, 0.6, to 0.8 rad": Mended(flush=0.6, turn=0.8),
    "turn flush from 0.2 m": Mended(flush=0.6, edge=0.2),
    "turn flush towards the target, 0.3": Mended(flush=0.3, agree=1.0, turn=3.0),
    "turn flush towards the target, 0.6": Mended(flush=0.6, agree=1.0, turn=3.0),
    "turn flush towards the target, 1": Mended(flush=1.0, agree=1.0, turn=3.0),
    "approach at 0.03 m/s": Mended(law=TUNED._replace(v_approach=0.03)),
    "approach at 0.05 m/s": Mended(law=TUNED._replace(v_approach=0.05)),
    "d_th 0.8 m": Mended(law=TUNED._replace(d_th=0.8)),
    "v_max 0.035 m/s": Mended(law=TUNED._replace(v_max=0.035)),
    "P3 straight back after 2 s": Mended(n_lost=100, ahead=1.0),
    "P3 straight back after 10 s": Mended(n_lost=500, ahead=1.0),
    "P3 back and aside after 2 s": Mended(n_lost=100, ahead=0.7, aside=0.5),
    "P1 while realigning to 0.25 m": Mended(over=0.3, d_near=0.25),
    "that, and P3 back and aside": Mended(over=0.3, d_near=0.25, n_lost=100, ahead=0.7, aside=0.5),
    "that, and approach at 0.03 m/s": Mended(
        TUNED._replace(v_approach=0.03), 0.25, over=0.3, n_lost=100, ahead=0.7, aside=0.5
    ),
}

register_law("_mended", Law(init, step), Mended())
