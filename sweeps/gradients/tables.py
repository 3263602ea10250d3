"""Laws with a table: RPS or RPS+ whose eta and K_h are functions of the distance and of the offset.

    rps tune grad --law sweeps/gradients/tables.py:Table64

A table is bilinear in the logarithm of the distance from contact to target, between 0.05 and 3 m,
and in the offset |l| up to 0.3 m. Its values are factors, as logarithms. All are 0 at first.
`Table64` changes RPS with the paper's parameters, and `Plus64` changes RPS+.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import Law, RPSParams, register_law
from rps_jax.geometry import planar
from rps_jax.laws import Bound, law_of, resolve_law

_NEAR, _FAR, _WIDE = 0.05, 3.0, 0.3  # [m]
_SHAPES = {64: (8, 4), 512: (16, 16), 2048: (32, 32), 4097: (64, 32)}  # by the number of parameters
BOUNDS = {"eta": Bound(-2.0, 2.0), "K_h": Bound(-2.0, 2.0)}


class Tables(NamedTuple):
    """Parameters of RPS or RPS+, and tables (A, B) of factors by distance and offset."""

    rps: Any
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


def interpolate(table: jax.Array, u: jax.Array, v: jax.Array) -> jax.Array:
    """Return the bilinear value () of a table (A, B) at u and v from 0 to 1."""
    weights = []
    for size, share in zip(table.shape, (u, v), strict=True):
        at = jnp.clip(share, 0.0, 1.0) * (size - 1)
        weights.append(jnp.maximum(1 - jnp.abs(at - jnp.arange(size)), 0.0))
    return jnp.sum(table * weights[0][:, None] * weights[1][None, :])


def init(params: Tables, temperatures: Any = None) -> Any:
    """Return the initial state of RPS or RPS+."""
    law: Any = law_of(params.rps)
    return law.init(params.rps, temperatures)


def step(params: Tables, state: Any, obs: Any, temperatures: Any = None) -> Any:
    """Run RPS or RPS+ with eta and K_h of the tables at the last contact."""
    is_plus = hasattr(params.rps, "law")
    rps, last = (params.rps.law, state.law) if is_plus else (params.rps, state)
    contact = jnp.where(jnp.asarray(obs.in_contact) > 0, obs.p_robot_contact, last.p_robot_contact)
    way = obs.p_world_target - (obs.p_world_robot + planar.rotate(obs.yaw, contact))
    distance = jnp.maximum(planar.norm(way), _NEAR)
    u = jnp.log(distance / _NEAR) / jnp.log(_FAR / _NEAR)
    v = jnp.abs(obs._replace(p_robot_contact=contact).l) / _WIDE
    eta, gain = (jnp.exp(interpolate(x, u, v)) for x in (params.eta, params.K_h))
    changed = rps._replace(eta=rps.eta * eta, K_h=rps.K_h * gain)
    changed = params.rps._replace(law=changed) if is_plus else changed
    law: Any = law_of(params.rps)
    return law.step(changed, state, obs, temperatures)


def register(name: str, count: int, rps: Any, bounds: Mapping[str, Bound] = BOUNDS) -> type:
    """Register the law with tables of so many numbers; return the class of its parameters."""
    kind, zeros = type(name, (Tables,), {}), np.zeros(_SHAPES[count])
    law = Law(init, step, bounds=bounds, temperatures=law_of(rps).temperatures)
    register_law(name.lower(), law, kind(rps, zeros, zeros))
    return kind


PAPER, PLUS = RPSParams.paper(), resolve_law("rps_plus")[1]
K_V = {"rps.K_v": dict(law_of(PAPER).bounds)["K_v"]}
Table64, Table512, Table2048 = (register(f"Table{n}", n, PAPER) for n in (64, 512, 2048))
Table4097 = register("Table4097", 4097, PAPER, BOUNDS | K_V)
Plus64, Plus2048 = (register(f"Plus{n}", n, PLUS) for n in (64, 2048))
