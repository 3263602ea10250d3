"""The parameters that are tuned, as a vector without bounds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rps_jax import errors
from rps_jax.control.law import RPSParams


class Bound(NamedTuple):
    """The interval in which a parameter is tuned."""

    low: float
    high: float
    log: bool = False  # evenly in its logarithm
    of: str = ""  # as a share of this other parameter


# v_max, omega_max, v_approach and d_success belong to the robot and the task, not to the law.
BOUNDS = {
    "eta": Bound(1, 100, log=True),  # [1]
    "zeta": Bound(-2, 5),  # [1]
    "beta": Bound(0.01, 0.3),  # [m]
    "k": Bound(5, 500, log=True),  # [1/m]
    "K_h": Bound(0.1, 5, log=True),  # [1]
    "K_v": Bound(0.02, 2, log=True),  # [1/s]
    "L": Bound(0.03, 1.5, log=True),  # [m]
    "l_cr": Bound(0.1, 0.289),  # [m] the half width of the base is 0.29
    "l_mr": Bound(0.02, 0.98, of="l_cr"),  # [1]
    "a_r_max": Bound(1, 100, log=True),  # [1]
    "d_th": Bound(0.02, 2, log=True),  # [m]
    "gamma_max": Bound(0.5, 1.57),  # [rad]
    "v_lost": Bound(0.001, 0.05, log=True),  # [m/s]
}
SUBSETS = {"logistic": ("eta", "zeta", "beta", "k"), "full": tuple(BOUNDS)}


def expanded(names: Sequence[str]) -> tuple[str, ...]:
    """The same names, with the members of a subset in its place."""
    return tuple(name for text in names for name in SUBSETS.get(text, (text,)))


@dataclass(frozen=True)
class Space:
    """The parameters that are tuned, as vectors (p,) without bounds; the others stay.

    A coordinate is the logit of where the parameter, or its logarithm, lies between its bounds.
    """

    names: tuple[str, ...] = SUBSETS["logistic"]
    base: RPSParams = RPSParams()

    def __post_init__(self) -> None:
        """Raises InputError for unknown or repeated names, or a base outside the bounds."""
        if not self.names or len(set(self.names)) < len(self.names):
            raise errors.InputError(
                f"tuned = {self.names} is not allowed: name each parameter once, at least one."
            )
        for name in self.names:
            bound = BOUNDS[errors.check_name("tuned parameter", name, BOUNDS)]
            share = _share(bound, self.base, name)
            errors.check_finite(f"{name}, to be tuned", share, above=bound.low)
            if share >= bound.high:
                raise errors.InputError(
                    f"{name}, to be tuned = {share:g} is not allowed: it must be below "
                    f"{bound.high:g}."
                )

    def vector(self, params: RPSParams) -> jax.Array:
        """The vector (..., p) of parameters with leaves (...)."""
        return jnp.stack([self._coordinate(params, name) for name in self.names], axis=-1)

    def _coordinate(self, params: RPSParams, name: str) -> jax.Array:
        low, high, log, _ = bound = BOUNDS[name]
        value = jnp.asarray(_share(bound, params, name), float)
        if log:
            low, high, value = math.log(low), math.log(high), jnp.log(value)
        return jax.scipy.special.logit((value - low) / (high - low))

    def params(self, vector: Any) -> RPSParams:
        """The parameters of vectors (..., p): leaves (...)."""
        vector = jnp.asarray(vector, float)
        filled = {
            name: jnp.broadcast_to(jnp.asarray(value, vector.dtype), vector.shape[:-1])
            for name, value in self.base._asdict().items()
        }
        for name in sorted(self.names, key=lambda name: bool(BOUNDS[name].of)):
            low, high, log, of = BOUNDS[name]
            u = jax.nn.sigmoid(vector[..., self.names.index(name)])
            value = low * (high / low) ** u if log else low + (high - low) * u
            filled[name] = value * filled[of] if of else value
        # A share of a tuned parameter that is itself fixed must not pass it.
        filled["l_mr"] = jnp.minimum(filled["l_mr"], filled["l_cr"])
        return RPSParams(**filled)

    def named(self, vector: Any) -> dict[str, float]:
        """A vector's tuned parameters by name, and the others that differ from the paper's."""
        found, usual = (
            {name: float(f"{float(value):.7g}") for name, value in params._asdict().items()}
            for params in (self.params(vector), RPSParams.paper())
        )
        return {n: x for n, x in found.items() if n in self.names or x != usual[n]}


def _share(bound: Bound, params: RPSParams, name: str) -> Any:
    value = getattr(params, name)
    return value / getattr(params, bound.of) if bound.of else value
