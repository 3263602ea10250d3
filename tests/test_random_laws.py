"""Random programs give the same results as compiled C, in XLA and in a trial.

`RPS_SEEDS=2000 pytest -m slow tests/test_random_laws.py` compares programs of as many seeds.
"""

import functools
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from numpy.random import default_rng

from rps_jax.engines import native

pytestmark = pytest.mark.skipif(native.target() is None, reason="there is no C compiler")
SEEDS = 20  # of one compilation
FEW = 3  # in all runs of the tests
COUNT = 4  # numbers of a vector
SPECIAL = [0.0, -0.0, np.nan, np.inf, -np.inf]
BOUNDS = [2**31 - 1, -(2**31), -1, 0, 31, 32]


def exact(x):
    """Return multiples of 1/8 below 64, on which the operations of both compilers are exact."""
    x = jnp.clip(jnp.floor(8 * x) / 8, -64, 64)
    return jnp.where(x == 0, 0.0, jnp.where(x != x, jnp.nan, x))  # without signs of zero and NaN


def indices(i):
    return i % COUNT


# Operations by the kinds of their operands and of their result: f, i and b are vectors of reals,
# integers and bools, and F, I and B are scalars.
OPERATIONS = {
    "ff f": [
        jnp.add,
        jnp.subtract,
        jnp.maximum,
        jnp.minimum,
        jnp.remainder,
        jnp.floor_divide,
        lambda x, y: x * y,
        lambda x, y: jnp.where(y == 0, x, x / 2),
        lambda x, y: x[::-1] + y,
        lambda x, y: (x + y) - (x + y)[2],
        lambda x, y: jnp.interp(x, jnp.arange(4.0), y),
    ],
    "f f": [
        jnp.abs,
        jnp.sign,
        jnp.floor,
        jnp.ceil,
        jnp.round,
        jnp.negative,
        jnp.sort,
        jnp.cumsum,
        lambda x: lax.top_k(x, COUNT)[0],
        lax.cummax,
        lambda x: jnp.sort(x, descending=True),
        lambda x: lax.scan(lambda s, y: (jnp.where(y > s, y, s - 1), s + y), x[0], x)[1],
    ],
    "f F": [jnp.median, jnp.max, jnp.min, jnp.sum, lambda x: x[0], lambda x: lax.top_k(x, 2)[0][1]],
    "f I": [jnp.argmax, jnp.argmin, lambda x: jnp.searchsorted(jnp.sort(x), 0.5).astype(jnp.int32)],
    "f i": [
        jnp.argsort,
        lambda x: x.astype(jnp.int32),
        lambda x: lax.top_k(x, COUNT)[1],
        lambda x: jnp.searchsorted(jnp.sort(x), x, side="right").astype(jnp.int32),
    ],
    "ff b": [jnp.less, jnp.less_equal, jnp.greater, jnp.greater_equal, jnp.equal, jnp.not_equal],
    "fi f": [
        lambda x, i: x[indices(i)],
        lambda x, i: x.at[i].get(mode="fill", fill_value=1.5),
        lambda x, i: x.at[indices(i)].add(0.5),
        lambda x, i: x.at[i].set(2.5),
        lambda x, i: jnp.take_along_axis(x, indices(i), 0),
    ],
    "fI f": [
        lambda x, k: jnp.roll(x, indices(k)),
        lambda x, k: x.at[indices(k)].set(-1.5),
        lambda x, k: lax.dynamic_update_slice(x, x[:2], (k,)),
        lambda x, k: lax.fori_loop(0, 3, lambda n, y: jnp.where(n < k, y[::-1] + 0.5, y), x),
        lambda x, k: lax.fori_loop(
            0, 2, lambda _, y: (jnp.broadcast_to(y[0][1], (COUNT,)), y[1] + k), (x, x)
        )[0],
        lambda x, k: lax.while_loop(
            lambda c: (c[0] < k & 7) & (c[1][0] < 9), lambda c: (c[0] + 1, c[1] + 1.25), (0, x)
        )[1],
        lambda x, k: lax.switch(k, [lambda: x, lambda: x[::-1], lambda: x / 2]),
    ],
    "bff f": [jnp.where, lambda b, x, y: jnp.select([b, x > y], [y, x], 0.5)],
    "Bff f": [lambda b, x, y: lax.cond(b, lambda: x + y, lambda: jnp.sort(y))],
    "ii i": [
        jnp.add,
        jnp.subtract,
        jnp.multiply,
        jnp.maximum,
        jnp.minimum,
        # A program of XLA ends the process where it divides by a constant 0.
        lambda i, j: jnp.floor_divide(i, j | 1),
        lambda i, j: jnp.remainder(i, j | 1),
        lambda i, j: lax.div(i, j | 1),
        lambda i, j: lax.rem(i, j | 1),
        jnp.bitwise_and,
        jnp.bitwise_or,
        jnp.bitwise_xor,
        lax.shift_left,
        lax.shift_right_logical,
        lax.shift_right_arithmetic,
    ],
    "i i": [
        jnp.abs,
        jnp.negative,
        jnp.invert,
        jnp.sign,
        jnp.cumsum,
        jnp.sort,
        jnp.argsort,
        lambda i: i.astype(jnp.uint32).astype(jnp.int32) >> 3,
        lambda i: (i.astype(jnp.uint32) // 7).astype(jnp.int32),
        lambda i: jnp.sort(i.astype(jnp.uint32)).astype(jnp.int32),
    ],
    "i f": [lambda i: (i & 63).astype(jnp.float32)],
    "i I": [
        jnp.max,
        jnp.min,
        jnp.sum,
        jnp.argmax,
        lambda i: i[1],
        lambda i: lax.reduce_xor(i, (0,)),
    ],
    "ii b": [jnp.less, jnp.less_equal, jnp.greater, jnp.greater_equal, jnp.equal, jnp.not_equal],
    "bii i": [jnp.where, lambda b, i, j: lax.sort((b, i, j), num_keys=2)[1]],
    "bb b": [
        lax.lt,
        lax.le,
        lax.gt,
        lax.ge,
        jnp.equal,
        jnp.not_equal,
        jnp.maximum,
        jnp.minimum,
        jnp.logical_and,
        jnp.logical_or,
        jnp.logical_xor,
    ],
    # XLA itself orders bools wrongly in a clamp of vectors.
    "b b": [jnp.logical_not, jnp.sort, lambda b: b[::-1]],
    "b B": [jnp.any, jnp.all, jnp.max, jnp.min, lambda b: b[2], lambda b: lax.reduce_xor(b, (0,))],
    "b I": [jnp.argmax, jnp.argmin, lambda b: b.sum(dtype=jnp.int32)],
    "b i": [lambda b: b.astype(jnp.int32), lambda b: jnp.argsort(b)],
    "bbb b": [jnp.where],
    "F f": [lambda x: jnp.stack([x, x + 1, -x, 0 * x])],
    "I i": [lambda i: i + jnp.arange(COUNT)],
    "B b": [lambda b: jnp.stack([b, ~b, b, ~b])],
    "F B": [lambda x: x > 1],
}


def program(seed, x, i, length=16):
    """Return all values that a random program of `length` operations computes."""
    rng = default_rng(seed)
    values = {"f": [x], "i": [i], "b": [x > 0], "F": [x[1]], "I": [i[0]], "B": [i[1] > 0]}
    for _ in range(length):
        kinds = [*OPERATIONS][rng.integers(len(OPERATIONS))]
        functions = OPERATIONS[kinds]
        function = functions[rng.integers(len(functions))]
        operands, kind = kinds.split()
        # Later values are chosen more often, so that programs are deep.
        chosen = [
            values[k][-1 - int(rng.integers(len(values[k])) * rng.random())] for k in operands
        ]
        result = function(*chosen)
        values[kind].append(exact(result) if kind in "fF" else result)
    return values


def batch(seed, count=32):
    """Return reals (count, 4) and integers (count, 4)."""
    rng = default_rng(seed)
    x = rng.integers(-40, 40, (count, COUNT)) / 8
    x[rng.random(x.shape) < 0.05] = rng.choice(SPECIAL)
    i = rng.integers(-9, 9, (count, COUNT))
    bounds = rng.random(i.shape) < 0.15
    i[bounds] = rng.choice(BOUNDS, bounds.sum())
    return x.astype(np.float32), i.astype(np.int32)


def wrong_seeds(seeds):
    """Return the seeds of programs whose compiled results differ from XLA's."""
    run = lambda x, i: [program(seed, x, i) for seed in seeds]  # noqa: E731
    compiled = native.batched(run, lambda *_: pytest.fail("it was not compiled"))
    x, i = batch(seeds[0])
    computed, expected = (jax.device_get(jax.jit(f)(x, i)) for f in (compiled, jax.vmap(run)))
    equal = functools.partial(np.array_equal, equal_nan=True)
    rows = zip(seeds, computed, expected, strict=True)
    return [seed for seed, *x in rows if not all(map(equal, *map(jax.tree.leaves, x)))]


@pytest.mark.parity
def test_random_programs_are_those_of_xla():
    assert wrong_seeds(range(FEW)) == []


@pytest.mark.slow
def test_many_random_programs_are_those_of_xla():
    count = int(os.environ.get("RPS_SEEDS", "400"))
    groups = [range(first, first + SEEDS) for first in range(FEW, FEW + count, SEEDS)]
    assert [seed for group in groups for seed in wrong_seeds(group)] == []
