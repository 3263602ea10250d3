"""Types of arrays by kind and shape: `Float[Array, "B 2"]` is an array (B, 2) of floats.

A name is one length throughout a call and its records, and `*B` any number of axes of one shape;
with `#` an axis may also be 1, and `...` is any axes at all. Nothing is checked while the package
runs: the tests look into the calls of some modules, as `tests/shapes.py` says.
"""

from typing import TYPE_CHECKING, Any

from jaxtyping import Bool as Bool
from jaxtyping import Float as Float
from jaxtyping import Int as Int

if TYPE_CHECKING:
    from jax import Array as Array
else:
    Array = Any  # NumPy's, too, which JAX takes for its own

Scalar = float | Float[Array, ""]
