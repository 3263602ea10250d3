"""Vectors of three and rotations as tuples of scalars, for programs written out entry by entry.

An entry is a number or an array; all arrays have one shape. Literal zeros and ones are folded away,
which halves a program that has axis-aligned directions in it.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import reduce
from typing import Any

import jax.numpy as jnp

Vec = tuple[Any, Any, Any]
X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def mul(a: Any, b: Any) -> Any:
    """A b."""
    for x, y in ((a, b), (b, a)):
        if isinstance(x, float) and x in (0.0, 1.0):
            return y if x else 0.0
    return a * b


def plus(a: Any, b: Any) -> Any:
    """A + b."""
    for x, y in ((a, b), (b, a)):
        if isinstance(x, float) and x == 0.0:
            return y
    return a + b


def minus(a: Any, b: Any) -> Any:
    """A - b."""
    return a if isinstance(b, float) and b == 0.0 else a - b


def add(a: Vec, b: Vec) -> Vec:
    """Sum of vectors."""
    return plus(a[0], b[0]), plus(a[1], b[1]), plus(a[2], b[2])


def sub(a: Vec, b: Vec) -> Vec:
    """Difference of vectors."""
    return minus(a[0], b[0]), minus(a[1], b[1]), minus(a[2], b[2])


def scale(s: Any, a: Vec) -> Vec:
    """Multiple of a vector."""
    return mul(s, a[0]), mul(s, a[1]), mul(s, a[2])


def dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    """Inner product of any number of entries."""
    return reduce(plus, map(mul, a, b))


def cross(a: Vec, b: Vec) -> Vec:
    """Cross product."""
    return (
        minus(mul(a[1], b[2]), mul(a[2], b[1])),
        minus(mul(a[2], b[0]), mul(a[0], b[2])),
        minus(mul(a[0], b[1]), mul(a[1], b[0])),
    )


def combine(weights: Sequence[Any], vectors: Sequence[Vec]) -> Vec:
    """Weighted sum of vectors."""
    return reduce(add, map(scale, weights, vectors))


def norm(a: Sequence[Any], least: float = 1e-12) -> Any:
    """Length, at least `least`."""
    return jnp.sqrt(jnp.maximum(dot(a, a), least * least))


def to_world(m: Sequence[Vec], a: Vec) -> Vec:
    """Rotate by the matrix of rows m."""
    return dot(m[0], a), dot(m[1], a), dot(m[2], a)


def to_body(m: Sequence[Vec], a: Vec) -> Vec:
    """Rotate by its transpose."""
    x, y, z = (dot([row[j] for row in m], a) for j in range(3))
    return x, y, z


def matrix(q: Sequence[Any]) -> tuple[Vec, Vec, Vec]:
    """Rows of the rotation matrix of a unit quaternion."""
    w, x, y, z = q
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def times(p: Sequence[Any], q: Sequence[Any]) -> tuple[Any, Any, Any, Any]:
    """Product of quaternions, scalar first."""
    a, u = p[0], (p[1], p[2], p[3])
    b, v = q[0], (q[1], q[2], q[3])
    x, y, z = add(cross(u, v), add(scale(a, v), scale(b, u)))
    return a * b - dot(u, v), x, y, z


# --- over the leading axis, which numbers corners or contacts ---------------------------------

_IN_ONE = ContextVar("rps_jax_reductions_in_one", default=False)


@contextmanager
def reductions_in_one() -> Iterator[None]:
    """While this is traced, reduce as one operation, of which `lowering` makes one loop.

    XLA makes on a processor a loop over the leading axis of it, one world at a time; of slices
    that are added it makes vectors of worlds.
    """
    token = _IN_ONE.set(True)
    try:
        yield
    finally:
        _IN_ONE.reset(token)


def _over(x: Any, in_one: Callable[..., Any], two: Callable[[Any, Any], Any]) -> Any:
    if isinstance(x, float):
        return x
    if _IN_ONE.get():
        return in_one(x, axis=0)
    rows = [x[i] for i in range(x.shape[0])]
    while len(rows) > 1:  # in pairs: fewer steps that wait for one another
        over = rows[-1:] if len(rows) % 2 else []
        rows = [two(a, b) for a, b in zip(rows[::2], rows[1::2], strict=False)] + over
    return rows[0]


def total(x: Any) -> Any:
    """Sum over the leading axis; a literal number is what all together have."""
    return _over(x, jnp.sum, jnp.add)


def greatest(x: Any) -> Any:
    """Greatest along the leading axis."""
    return _over(x, jnp.max, jnp.maximum)


def least(x: Any) -> Any:
    """Least along the leading axis."""
    return _over(x, jnp.min, jnp.minimum)
