"""Map between the tuned parameters of a law, which have bounds, and vectors without bounds."""

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.control import registry
from rps_jax.control.base import Bound, LawParams, Leaf, entries
from rps_jax.control.laws.rps import BOUNDS, RPSParams
from rps_jax.geometry.arrays import Array
from rps_jax.record.files import JsonObject

SUBSETS = {"logistic": ("eta", "zeta", "beta", "k"), "full": tuple(BOUNDS)}  # of RPS


def expand_subsets(names: Sequence[str], base: LawParams) -> tuple[str, ...]:
    """Replace the names of subsets by their members; `full` means all parameters with bounds.

    The name of a pytree in the parameters, as `weights`, means all of its leaves with bounds.
    """
    bounded = tuple(dict(registry.law_of(base).bounds))
    subsets = {"full": bounded} | (SUBSETS if isinstance(base, RPSParams) else {})
    return tuple(
        x
        for text in names
        for x in subsets.get(text) or [x for x in bounded if x.startswith(f"{text}.")] or [text]
    )


@dataclass(frozen=True)
class Space:
    """Tuned parameters as vectors (p,) without bounds; all other parameters are fixed.

    A coordinate is the logit of the relative position of a parameter, or of its logarithm, between
    its bounds. Each entry of an array is a coordinate, and all have the bounds of the array.
    """

    names: tuple[str, ...] = SUBSETS["logistic"]
    base: LawParams = RPSParams()  # parameters of any law that has bounds

    def __post_init__(self) -> None:
        errors.check_each_once("tuned", self.names)
        values = registry.named_leaves(self.base)
        for name in self.names:
            bound = self._bounds[errors.check_name("tuned parameter", name, self._bounds)]
            below = math.nextafter(bound.high, -math.inf)
            for share in np.ravel(_share(bound, values, name)):
                errors.check_finite(f"{name}, to be tuned", share, above=bound.low, at_most=below)

    @property
    def _bounds(self) -> dict[str, Bound]:
        return dict(registry.law_of(self.base).bounds)

    @property
    def parameters(self) -> dict[str, str]:
        """Name of the parameter of each coordinate by label, such as `L` or `table[0,1]`."""
        leaves = registry.named_leaves(self.base)
        return {label: name for name in self.names for label, _ in entries(name, leaves[name])}

    def vector(self, params: LawParams) -> Array:
        """Return the vector (..., p) of parameters with leaves (...)."""
        values, base = registry.named_leaves(params), registry.named_leaves(self.base)
        columns = []
        for name in self.names:
            low, high, log, _ = bound = self._bounds[name]
            value = jnp.asarray(_share(bound, values, name), float)
            if log:
                low, high, value = math.log(low), math.log(high), jnp.log(value)
            x = jax.scipy.special.logit((value - low) / (high - low))
            columns.append(x.reshape(*x.shape[: x.ndim - np.ndim(base[name])], -1))
        return jnp.concatenate(columns, axis=-1)

    def params(self, vector: ArrayLike) -> LawParams:
        """Return the parameters, leaves (..., *shape), of vectors (..., p)."""
        vector, bounds = jnp.asarray(vector, float), self._bounds
        base, batch = registry.named_leaves(self.base), vector.shape[:-1]
        values = {
            k: jnp.broadcast_to(jnp.asarray(x, vector.dtype), (*batch, *np.shape(x)))
            for k, x in base.items()
        }
        cuts = np.cumsum([np.size(base[name]) for name in self.names])[:-1]
        coordinates = dict(zip(self.names, jnp.split(vector, cuts, axis=-1), strict=True))
        for name in sorted(self.names, key=lambda name: bool(bounds[name].relative_to)):
            low, high, log, whole = bounds[name]
            u = jax.nn.sigmoid(coordinates[name]).reshape(values[name].shape)
            value = low * (high / low) ** u if log else low + (high - low) * u
            values[name] = _aligned(jnp.multiply, value, values[whole]) if whole else value
        for name, bound in bounds.items():
            if whole := bound.relative_to:  # a fixed parameter must not exceed the tuned bound
                values[name] = _aligned(jnp.minimum, values[name], values[whole])
        return registry.replace_leaves(self.base, values)

    def changed_values(self, vector: ArrayLike) -> JsonObject:
        """Return the tuned parameters of a vector (p,), and all others that differ from the preset.

        The preset is the first of the law, which is the paper's for RPS. Arrays are lists.
        """
        preset = registry.preset_of(self.base)
        both = map(registry.named_leaves, (self.params(vector), preset))
        values, defaults = ({k: _rounded(x) for k, x in leaves.items()} for leaves in both)
        return {n: x for n, x in values.items() if n in self.names or x != defaults[n]}

    def values(self, vector: ArrayLike) -> np.ndarray:
        """Return the rounded parameters (p,) of a vector (p,)."""
        changed = self.changed_values(vector)
        return np.concatenate([np.ravel(changed[name]) for name in self.names])


def _share(bound: Bound, values: Mapping[str, Leaf], name: str) -> Leaf:
    """Return a parameter, or its ratio to the parameter that bounds it."""
    whole = bound.relative_to
    return _aligned(operator.truediv, values[name], values[whole]) if whole else values[name]


def _aligned(function: Callable[..., PyTree], value: Leaf, whole: Leaf) -> PyTree:
    """Apply a function to entries (..., *shape) and numbers (...)."""
    return np.transpose(function(np.transpose(value), np.transpose(whole)))


def _rounded(leaf: Leaf) -> PyTree:
    """Return a number, or nested lists of numbers, with seven digits."""
    rounded = [float(f"{float(x):.7g}") for x in np.ravel(leaf)]
    return np.reshape(rounded, np.shape(leaf)).tolist()
