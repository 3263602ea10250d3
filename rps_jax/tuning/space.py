"""The parameters that are tuned, as a vector without bounds."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from rps_jax import errors
from rps_jax.control import registry
from rps_jax.control.base import Bound, LawParams
from rps_jax.control.laws.rps import BOUNDS, RPSParams

SUBSETS = {"logistic": ("eta", "zeta", "beta", "k"), "full": tuple(BOUNDS)}  # of RPS


def expanded(names: Sequence[str], base: LawParams = RPSParams()) -> tuple[str, ...]:
    """Put the members of a subset in its place among names: of `full`, all of the law's."""
    own = isinstance(base, RPSParams)
    subsets = SUBSETS if own else {"full": tuple(dict(registry.law_of(base).bounds))}
    return tuple(name for text in names for name in subsets.get(text, (text,)))


@dataclass(frozen=True)
class Space:
    """The parameters that are tuned, as vectors (p,) without bounds; the others stay.

    A coordinate is the logit of where the parameter, or its logarithm, lies between its bounds.
    """

    names: tuple[str, ...] = SUBSETS["logistic"]
    base: Any = RPSParams()  # parameters of any law that has bounds

    def __post_init__(self) -> None:
        errors.check_each_once("tuned", self.names)
        base = registry.named_leaves(self.base)
        for name in self.names:
            bound = self._bounds[errors.check_name("tuned parameter", name, self._bounds)]
            share = _share(bound, base, name)
            errors.check_finite(f"{name}, to be tuned", share, above=bound.low)
            if share >= bound.high:
                raise errors.InputError(
                    f"{name}, to be tuned = {share:g} is not allowed: it must be below "
                    f"{bound.high:g}."
                )

    @property
    def _bounds(self) -> dict[str, Bound]:
        return dict(registry.law_of(self.base).bounds)

    def vector(self, params: LawParams) -> jax.Array:
        """The vector (..., p) of parameters with leaves (...)."""
        numbers = registry.named_leaves(params)
        return jnp.stack([self._coordinate(numbers, name) for name in self.names], axis=-1)

    def _coordinate(self, numbers: Mapping[str, Any], name: str) -> jax.Array:
        low, high, log, _ = bound = self._bounds[name]
        value = jnp.asarray(_share(bound, numbers, name), float)
        if log:
            low, high, value = math.log(low), math.log(high), jnp.log(value)
        return jax.scipy.special.logit((value - low) / (high - low))

    def params(self, vector: Any) -> Any:
        """The parameters of vectors (..., p): leaves (...)."""
        vector, bounds = jnp.asarray(vector, float), self._bounds
        filled = {
            name: jnp.broadcast_to(jnp.asarray(value, vector.dtype), vector.shape[:-1])
            for name, value in registry.named_leaves(self.base).items()
        }
        for name in sorted(self.names, key=lambda name: bool(bounds[name].relative_to)):
            low, high, log, of = bounds[name]
            u = jax.nn.sigmoid(vector[..., self.names.index(name)])
            value = low * (high / low) ** u if log else low + (high - low) * u
            filled[name] = value * filled[of] if of else value
        for name, bound in bounds.items():
            if bound.relative_to:  # must not exceed the other parameter, which may be fixed
                filled[name] = jnp.minimum(filled[name], filled[bound.relative_to])
        return registry.replace_leaves(self.base, filled)

    def named(self, vector: Any) -> dict[str, float]:
        """A vector's tuned parameters by name, and the others that differ from the usual ones."""
        kind = type(self.base)  # the law is known by the first parameters; RPS by the paper's
        known = next(known for known in registry.LAWS.values() if type(known) is kind)
        found, usual = (
            {name: float(f"{float(value):.7g}") for name, value in numbers.items()}
            for numbers in map(registry.named_leaves, (self.params(vector), known))
        )
        return {n: x for n, x in found.items() if n in self.names or x != usual[n]}


def _share(bound: Bound, numbers: Mapping[str, Any], name: str) -> Any:
    return numbers[name] / numbers[bound.relative_to] if bound.relative_to else numbers[name]
