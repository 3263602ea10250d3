"""Laws with a table: RPS whose eta and K_h are functions of the distance and of the offset.

    rps tune grad --law sweeps/gradients/tables.py:Table64

A table is bilinear in the logarithm of the distance from contact to target, between 0.05 and 3 m,
and in the offset |l| up to 0.3 m. Its values are factors, as logarithms. All are 0 at first.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import Law, RPSParams, RPSState, register_law
from rps_jax.control.observation import displacement
from rps_jax.geometry import planar
from rps_jax.laws import Bound, law_of

_NEAR, _FAR, _WIDE = 0.05, 3.0, 0.3  # [m]
_RPS: Any = law_of(RPSParams.paper())


class Tables(NamedTuple):
    """Parameters of RPS, and tables (A, B) of factors by distance and offset."""

    rps: RPSParams
    eta: Any  # [1] logarithm of the factor
    K_h: Any  # [1] logarithm of the factor

    @property
    def d_success(self) -> Any:
        """Distance to the target at which a trial succeeds [m]."""
        return self.rps.d_success

    @property
    def v_max(self) -> Any:
        """Greatest speed [m/s]."""
        return self.rps.v_max

    @property
    def keep_contact(self) -> Any:
        """Whether a loss of the contact is ignored."""
        return self.rps.keep_contact


class Table64(Tables):
    """Two tables of 8 x 4 factors."""


class Table512(Tables):
    """Two tables of 16 x 16 factors."""


class Table2048(Tables):
    """Two tables of 32 x 32 factors."""


def interpolate(table: jax.Array, u: jax.Array, v: jax.Array) -> jax.Array:
    """Return the bilinear value () of a table (A, B) at u and v from 0 to 1."""
    weights = []
    for size, share in zip(table.shape, (u, v), strict=True):
        at = jnp.clip(share, 0.0, 1.0) * (size - 1)
        weights.append(jnp.maximum(1 - jnp.abs(at - jnp.arange(size)), 0.0))
    return jnp.sum(table * weights[0][:, None] * weights[1][None, :])


def init(params: Tables, temperatures: Any = None) -> RPSState:
    """Return the initial state of RPS."""
    return RPSState.init(params.rps, temperatures)


def step(params: Tables, state: RPSState, obs: Any, temperatures: Any = None) -> Any:
    """Run RPS with eta and K_h of the tables at the last contact."""
    contact = jnp.where(jnp.asarray(obs.in_contact) > 0, obs.p_robot_contact, state.p_robot_contact)
    filled = obs._replace(p_robot_contact=contact)
    distance = jnp.maximum(planar.norm(displacement(filled)), _NEAR)
    u = jnp.log(distance / _NEAR) / jnp.log(_FAR / _NEAR)
    v = jnp.abs(filled.l) / _WIDE
    eta, gain = (jnp.exp(interpolate(x, u, v)) for x in (params.eta, params.K_h))
    changed = params.rps._replace(eta=params.rps.eta * eta, K_h=params.rps.K_h * gain)
    return _RPS.step(changed, state, obs, temperatures)


LAW = Law(
    init,
    step,
    bounds={"eta": Bound(-2.0, 2.0), "K_h": Bound(-2.0, 2.0)},
    temperatures=_RPS.temperatures,
)
for kind, shape in ((Table64, (8, 4)), (Table512, (16, 16)), (Table2048, (32, 32))):
    zeros = np.zeros(shape)
    register_law(kind.__name__.lower(), LAW, kind(RPSParams.paper(), zeros, zeros))
