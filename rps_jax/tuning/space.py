"""Map between the tuned parameters of a law, which have bounds, and vectors without bounds."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.control import registry
from rps_jax.control.base import Bound, LawParams, Leaf
from rps_jax.control.laws.rps import BOUNDS, RPSParams

SUBSETS = {"logistic": ("eta", "zeta", "beta", "k"), "full": tuple(BOUNDS)}  # of RPS


def expand_subsets(names: Sequence[str], base: LawParams = RPSParams()) -> tuple[str, ...]:
    """Replace the names of subsets by their members; `full` means all parameters with bounds."""
    subsets = {"full": tuple(dict(registry.law_of(base).bounds))}
    if isinstance(base, RPSParams):
        subsets |= SUBSETS
    return tuple(name for text in names for name in subsets.get(text, (text,)))


@dataclass(frozen=True)
class Space:
    """Tuned parameters as vectors (p,) without bounds; all other parameters are fixed.

    A coordinate is the logit of the relative position of a parameter, or of its logarithm, between
    its bounds.
    """

    names: tuple[str, ...] = SUBSETS["logistic"]
    base: LawParams = RPSParams()  # parameters of any law that has bounds

    def __post_init__(self) -> None:
        errors.check_each_once("tuned", self.names)
        values = registry.named_leaves(self.base)
        for name in self.names:
            bound = self._bounds[errors.check_name("tuned parameter", name, self._bounds)]
            share = _share(bound, values, name)
            below = math.nextafter(bound.high, -math.inf)
            errors.check_finite(f"{name}, to be tuned", share, above=bound.low, at_most=below)

    @property
    def _bounds(self) -> dict[str, Bound]:
        return dict(registry.law_of(self.base).bounds)

    def vector(self, params: LawParams) -> jax.Array:
        """Return the vector (..., p) of parameters with leaves (...)."""
        values = registry.named_leaves(params)
        return jnp.stack([self._coordinate(values, name) for name in self.names], axis=-1)

    def _coordinate(self, values: Mapping[str, Leaf], name: str) -> jax.Array:
        low, high, log, _ = bound = self._bounds[name]
        value = jnp.asarray(_share(bound, values, name), float)
        if log:
            low, high, value = math.log(low), math.log(high), jnp.log(value)
        return jax.scipy.special.logit((value - low) / (high - low))

    def params(self, vector: ArrayLike) -> LawParams:
        """Return the parameters, leaves (...), of vectors (..., p)."""
        vector, bounds = jnp.asarray(vector, float), self._bounds
        base, shape = registry.named_leaves(self.base), vector.shape[:-1]
        values = {k: jnp.broadcast_to(jnp.asarray(x, vector.dtype), shape) for k, x in base.items()}
        for name in sorted(self.names, key=lambda name: bool(bounds[name].relative_to)):
            low, high, log, whole = bounds[name]
            u = jax.nn.sigmoid(vector[..., self.names.index(name)])
            value = low * (high / low) ** u if log else low + (high - low) * u
            values[name] = value * values[whole] if whole else value
        for name, bound in bounds.items():
            if bound.relative_to:  # a fixed parameter must not exceed the tuned one that bounds it
                values[name] = jnp.minimum(values[name], values[bound.relative_to])
        return registry.replace_leaves(self.base, values)

    def changed_values(self, vector: ArrayLike) -> dict[str, float]:
        """Return the tuned parameters of a vector (p,), and all others that differ from the preset.

        The preset is the first of the law; that of RPS has the paper's parameters. Parameters whose
        default has changed between versions are included.
        """
        preset = next(p for p in registry.LAWS.values() if type(p) is type(self.base))
        both = map(registry.named_leaves, (self.params(vector), preset))
        rounded = ({k: float(f"{float(x):.7g}") for k, x in leaves.items()} for leaves in both)
        values, defaults = rounded
        names = (*self.names, *dict(registry.law_of(self.base).earlier))
        return {n: x for n, x in values.items() if n in names or x != defaults[n]}


def _share(bound: Bound, values: Mapping[str, Leaf], name: str) -> Leaf:
    """Return a parameter, or its ratio to the parameter that bounds it."""
    value = values[name]
    return value / values[bound.relative_to] if bound.relative_to else value
