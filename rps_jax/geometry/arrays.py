"""Types of arrays by kind and shape: `Float[Array, "B 2"]` is an array (B, 2) of floats.

A name has one length in a call and its records; `*B` is any number of axes of one shape. With `#`
an axis may also be 1; `...` is any axes. Nothing is checked while the package runs: the tests check
the calls of some modules, see `tests/shapes.py`.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool as Bool
from jaxtyping import Float as Float
from jaxtyping import Int as Int

if TYPE_CHECKING:
    from jax import Array as Array
else:
    Array = Any  # NumPy's, too, which JAX takes for its own

Scalar = float | Float[Array, ""]
# A number of each world of a batch; () of one world.
Floats = Float[Array, "*B"]
PerWorld = float | Floats  # or one for all worlds
Ints = Int[Array, "*B"]
Bools = Bool[Array, "*B"]
Vector = Float[Array, "2"]  # in the plane: x and y
Number = float | Array | np.ndarray  # of one world, or of a batch, of any shape
Pair = tuple[Array, Array]
Parameter = float | Array  # of a law or a sensor; an array in a batch
Pytree = Any  # of arrays
Entries = Any  # an array, or a tuple of numbers: one for each index of its last axis


def namespace_of(array: Any) -> Any:
    """Return NumPy or `jax.numpy`, to which an array belongs."""
    return array.__array_namespace__()
