"""Vectors and rotations in 3D as tuples of scalars, for programs written out entry by entry.

An entry is a number or an array; all arrays have one shape. Literal zeros and ones are folded,
which halves programs with axis-aligned directions.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial, reduce
from typing import Any, TypeVar

import jax.numpy as jnp

from rps_jax.geometry.arrays import Number

Vec = tuple[Number, Number, Number]
Point = tuple[Number, Number]
V = TypeVar("V", bound=Sequence[Number])  # a vector of any length
X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def mul(a: Number, b: Number) -> Number:
    """Return a b."""
    for x, y in ((a, b), (b, a)):
        if isinstance(x, float) and x in (0.0, 1.0):
            return y if x else 0.0
    return a * b


def plus(a: Number, b: Number) -> Number:
    """Return a + b."""
    for x, y in ((a, b), (b, a)):
        if isinstance(x, float) and x == 0.0:
            return y
    return a + b


def minus(a: Number, b: Number) -> Number:
    """Return a - b."""
    return a if isinstance(b, float) and b == 0.0 else a - b


def map_entries(function: Callable[..., Number], a: V, *operands: Sequence[Number]) -> V:
    """Apply a function to the entries of vectors."""
    entries: Any = tuple(map(function, a, *operands))
    return entries


def add(a: V, b: V) -> V:
    """Return the sum of two vectors."""
    return map_entries(plus, a, b)


def sub(a: V, b: V) -> V:
    """Return the difference of two vectors."""
    return map_entries(minus, a, b)


def scale(s: Number, a: V) -> V:
    """Return a multiple of a vector."""
    return map_entries(partial(mul, s), a)


def dot(a: Sequence[Number], b: Sequence[Number]) -> Number:
    """Return the inner product of sequences of entries."""
    return reduce(plus, map(mul, a, b))


def cross(a: Sequence[Number], b: Sequence[Number]) -> Vec:
    """Return the cross product."""
    return (
        minus(mul(a[1], b[2]), mul(a[2], b[1])),
        minus(mul(a[2], b[0]), mul(a[0], b[2])),
        minus(mul(a[0], b[1]), mul(a[1], b[0])),
    )


def combine(weights: Sequence[Number], vectors: Sequence[Vec]) -> Vec:
    """Return the weighted sum of vectors."""
    return reduce(add, map(scale, weights, vectors))


def norm(a: Sequence[Number], least: float = 1e-12) -> Number:
    """Return the length, at least `least`."""
    return jnp.sqrt(jnp.maximum(dot(a, a), least * least))


def turned(rotation: Point, a: V) -> V:
    """Rotate x and y of a vector by an angle, given by its cosine and sine."""
    (c, s), (x, y, *rest) = rotation, a
    entries: Any = c * x - s * y, s * x + c * y, *rest
    return entries


def turned_back(rotation: Point, a: V) -> V:
    """Rotate x and y of a vector by minus an angle, given by its cosine and sine."""
    (c, s), (x, y, *rest) = rotation, a
    entries: Any = c * x + s * y, c * y - s * x, *rest
    return entries


def turn(yaw: Number) -> Point:
    """Return the cosine and sine of an angle [rad]."""
    return jnp.cos(yaw), jnp.sin(yaw)


def at_point(twist: Sequence[Number], arm: Sequence[Number]) -> Point:
    """Return the planar velocity of the point at an arm from the origin of a twist."""
    return twist[0] - twist[2] * arm[1], twist[1] + twist[2] * arm[0]


def wrench(arm: Point, force: Sequence[Number]) -> Vec:
    """Return a force at an arm from the origin as x, y and torque about the origin."""
    return force[0], force[1], minus(mul(arm[0], force[1]), mul(arm[1], force[0]))


def to_world(m: Sequence[Vec], a: Vec) -> Vec:
    """Rotate a vector by the matrix with rows m."""
    return dot(m[0], a), dot(m[1], a), dot(m[2], a)


def to_body(m: Sequence[Vec], a: Vec) -> Vec:
    """Rotate a vector by the transpose of the matrix with rows m."""
    x, y, z = (dot([row[j] for row in m], a) for j in range(3))
    return x, y, z


def matrix(q: Sequence[Number]) -> tuple[Vec, Vec, Vec]:
    """Return the rows of the rotation matrix of a unit quaternion."""
    w, x, y, z = q
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def times(p: Sequence[Number], q: Sequence[Number]) -> tuple[Number, Number, Number, Number]:
    """Return the product of quaternions, scalar first."""
    a, u = p[0], (p[1], p[2], p[3])
    b, v = q[0], (q[1], q[2], q[3])
    x, y, z = add(cross(u, v), add(scale(a, v), scale(b, u)))
    return a * b - dot(u, v), x, y, z


# --- reductions over the leading axis, of corners or contacts ----------------------------------

ONE_WORLD = ContextVar("rps_jax_traces_one_world", default=False)  # so nothing is nested


@contextmanager
def trace_one_world() -> Iterator[None]:
    """Trace a function of one world for `rps_jax.lowering`: each reduction is one operation.

    On a processor XLA turns such an operation into a loop over the leading axis for one world at a
    time, and sums of slices into vectors of worlds.
    """
    token = ONE_WORLD.set(True)
    try:
        yield
    finally:
        ONE_WORLD.reset(token)


def _over(
    x: Number, in_one: Callable[..., Number], two: Callable[[Number, Number], Number]
) -> Number:
    if isinstance(x, float | int):
        return x
    if ONE_WORLD.get():
        return in_one(x, axis=0)
    rows = [x[i] for i in range(x.shape[0])]
    while len(rows) > 1:  # in pairs, for a short chain of dependent operations
        over = rows[-1:] if len(rows) % 2 else []
        rows = [two(a, b) for a, b in zip(rows[::2], rows[1::2], strict=False)] + over
    return rows[0]


def total(x: Number) -> Number:
    """Return the sum over the leading axis; a literal number is returned unchanged."""
    return _over(x, jnp.sum, jnp.add)


def greatest(x: Number) -> Number:
    """Return the maximum along the leading axis."""
    return _over(x, jnp.max, jnp.maximum)


def least(x: Number) -> Number:
    """Return the minimum along the leading axis."""
    return _over(x, jnp.min, jnp.minimum)
