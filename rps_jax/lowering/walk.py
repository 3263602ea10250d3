"""Walks a jaxpr: nested calls are entered, constants are computed, and the rest is handed on.

Values are NumPy arrays where they are constants, and otherwise what a `Target` makes of them. All
that only moves numbers (slices, reshapes, stacks, gathers at constant places) is one operation of a
target, `moved`: JAX itself moves the places of the numbers, and tells so where each one comes from.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.errors import InputError

_MOST_STEPS = 256  # of a scan, which is unrolled
# What only moves numbers, with how many operands are moved; those behind them are places.
_MOVES = {
    "broadcast_in_dim": 1,
    "reshape": 1,
    "squeeze": 1,
    "expand_dims": 1,
    "slice": 1,
    "rev": 1,
    "transpose": 1,
    "split": 1,
    "unstack": 1,
    "pad": 2,
    "stack": None,
    "concatenate": None,
    "dynamic_slice": 1,
    "dynamic_update_slice": 2,
    "gather": 1,
    "scatter": 1,  # its updates, the third operand, are moved as well
}
# What draws by a key, and the function of its algorithm that does so.
_OF_KEYS = {
    **dict.fromkeys(("random_wrap", "random_unwrap")),
    **{"random_bits": "random_bits", "random_split": "split", "random_fold_in": "fold_in"},
}
_SAME = ("stop_gradient", "copy", "copy_p", "optimization_barrier", "pvary", "reduce_precision")


class Target(Protocol):
    """What a jaxpr is written for; one that has no loops has them unrolled, or refused."""

    compiler = "the compiler"  # its name in errors
    kinds = "fib"  # of numbers that it knows, as `kind_of` names them

    def moved(self, values: Sequence[Any], places: np.ndarray, like: Any) -> Any:
        """Take numbers of the values, laid end to end, at constant places."""
        ...

    def emit(self, name: str, values: Sequence[Any], params: Mapping[str, Any], out: Any) -> Any:
        """Apply a primitive; `out` has the shape and the dtype of the result."""
        ...

    def repeated(
        self, once: Callable[[Sequence[Any]], list[Any]], carry: Sequence[Any], length: int
    ) -> list[Any] | None:
        """What `carry` is after a function of it was applied so often; None: unroll it."""
        return None

    def repeated_while(
        self,
        holds: Callable[[Sequence[Any]], list[Any]],
        once: Callable[[Sequence[Any]], list[Any]],
        carry: Sequence[Any],
    ) -> list[Any]:
        """What `carry` is after a function of it was applied as long as a condition held."""
        raise UnsupportedError("while")


class UnsupportedError(InputError):
    """A primitive that a target cannot express."""

    def __init__(self, operation: str, compiler: str = "the compiler") -> None:
        self.operation = operation
        super().__init__(
            f"operation `{operation}` is not supported by {compiler}; "
            "use arithmetic, comparisons, jnp.where and elementary functions."
        )


class TooLargeError(InputError):
    """A function that XLA compiles better than this package: its arrays are too large."""


def traced(function: Callable[..., Any], *arguments: Any) -> tuple[Any, Any]:
    """The jaxpr of a function in float64, and what it returns as shapes.

    A target rounds to the numbers that it has; traced in float32, constants would be rounded twice.
    """
    with jax.enable_x64(True):
        return jax.make_jaxpr(function, return_shape=True)(*arguments)


def walk(closed: Any, arguments: Sequence[Any], target: Target) -> list[Any]:
    """The results of a closed jaxpr of some arguments, as a target has them."""
    try:
        with jax.enable_x64(True):
            return _walk(closed.jaxpr, closed.consts, arguments, target)
    except UnsupportedError as error:
        raise UnsupportedError(error.operation, target.compiler) from None


def is_constant(value: Any) -> bool:
    """Whether a value is known already."""
    return isinstance(value, jax.Array) or (isinstance(value, np.ndarray) and value.dtype != object)


def _is_key(value: Any) -> bool:
    return isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key)


def _walk(jaxpr: Any, consts: Sequence[Any], arguments: Sequence[Any], target: Target) -> list[Any]:
    known: dict[Any, Any] = dict(zip(jaxpr.constvars, map(np.asarray, consts), strict=True))
    known |= dict(zip(jaxpr.invars, arguments, strict=True))

    def read(atom: Any) -> Any:
        return np.asarray(atom.val, atom.aval.dtype) if hasattr(atom, "val") else known[atom]

    for eqn in jaxpr.eqns:
        found = _results(eqn, [read(atom) for atom in eqn.invars], target)
        known |= dict(zip(eqn.outvars, found, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _results(eqn: Any, values: list[Any], target: Target) -> Sequence[Any]:
    """Results of one equation."""
    name, params, outs = eqn.primitive.name, eqn.params, [one.aval for one in eqn.outvars]
    if name in _SAME:
        return values
    if all(map(is_constant, values)):
        if (several := _simply(eqn, values)) is not None:
            return several
        found = eqn.primitive.bind(*map(jnp.asarray, values), **params)
        several = found if eqn.primitive.multiple_results else [found]
        return [one if _is_key(one) else np.asarray(one) for one in several]
    if name in _OF_KEYS and "u" in target.kinds:
        return _drawn(eqn, values, target)
    for one in outs:
        kind_of(one.dtype, name, target.kinds)
    if name == "cond":
        return _chosen(values[0], params["branches"], values[1:], target)
    if name == "scan":
        return _unrolled(eqn, values, target)
    if name == "while":
        first, second = params["cond_nconsts"], params["body_nconsts"]
        ways = zip(("cond", "body"), (values[:first], values[first : first + second]), strict=True)
        holds, once = (
            functools.partial(_entered, params[f"{way}_jaxpr"], consts, target=target)
            for way, consts in ways
        )
        return target.repeated_while(holds, once, values[first + second :])
    inner = params.get("call_jaxpr", params.get("jaxpr"))
    if inner is not None:
        closed = hasattr(inner, "consts")
        consts = inner.consts if closed else ()
        return _walk(inner.jaxpr if closed else inner, consts, values, target)
    if name in _MOVES:
        count = len(values) if _MOVES[name] is None else _MOVES[name]
        which = (0, 2) if name == "scatter" else range(count)
        if all(is_constant(v) for i, v in enumerate(values) if i not in which):
            return _moved(eqn, values, list(which), target)
    if name == "scatter-add" and is_constant(values[1]) and params["unique_indices"]:
        return [_added(eqn, values, target)]
    if name == "threefry2x32":  # of which the two results are told apart
        return [target.emit(f"{name}_{i}", values, params, out) for i, out in enumerate(outs)]
    if len(outs) != 1:
        raise UnsupportedError(name)
    return [target.emit(name, values, params, outs[0])]


def _entered(closed: Any, consts: Sequence[Any], carry: Sequence[Any], target: Target) -> list[Any]:
    return _walk(closed.jaxpr, closed.consts, [*consts, *carry], target)


def _drawn(eqn: Any, values: list[Any], target: Target) -> Sequence[Any]:
    """What is drawn by a key, of which the whole numbers are known: as its algorithm does it."""
    name, params = eqn.primitive.name, dict(eqn.params)
    if name in ("random_wrap", "random_unwrap"):
        return values
    values = [np.asarray(jax.random.key_data(x)) if _is_key(x) else x for x in values]
    how = getattr(eqn.invars[0].aval.dtype._impl, _OF_KEYS[name])
    shapes = [jax.ShapeDtypeStruct(np.shape(x), x.dtype) for x in values]
    closed = jax.make_jaxpr(functools.partial(how, **params))(*shapes)
    return _walk(closed.jaxpr, closed.consts, values, target)


def _moved(eqn: Any, values: list[Any], which: list[int], target: Target) -> list[Any]:
    """What a primitive makes of places, taken from the values."""
    start, places = 0, list(values)
    for i in which:
        size = int(np.prod(np.shape(values[i])))
        places[i] = np.arange(start, start + size).reshape(np.shape(values[i]))
        start += size
    several = _simply(eqn, places)
    if several is None:
        found = eqn.primitive.bind(*map(jnp.asarray, places), **eqn.params)
        several = found if eqn.primitive.multiple_results else [found]
    sources = [values[i] for i in which]
    return [
        target.moved(sources, np.asarray(one), out.aval)
        for one, out in zip(several, eqn.outvars, strict=True)
    ]


def _simply(eqn: Any, places: list[Any]) -> list[Any] | None:
    """Move places or constants by NumPy, if it knows how: JAX would compile each move."""
    name, params, out = eqn.primitive.name, eqn.params, eqn.outvars[0].aval.shape
    if name == "broadcast_in_dim":
        sizes = iter(np.shape(places[0]))
        kept = [next(sizes) if i in params["broadcast_dimensions"] else 1 for i in range(len(out))]
        return [np.broadcast_to(np.reshape(places[0], kept), out)]
    if name in ("reshape", "squeeze", "expand_dims"):
        return [np.reshape(places[0], out)]
    if name == "convert_element_type":
        return [np.asarray(places[0]).astype(params["new_dtype"])]
    if name == "slice":
        limits = zip(params["start_indices"], params["limit_indices"], strict=True)
        steps = params["strides"] or (1,) * len(out)
        return [places[0][tuple(slice(*ab, c) for ab, c in zip(limits, steps, strict=True))]]
    if name in ("concatenate", "stack"):
        axis = params.get("dimension", params.get("axis"))
        return [getattr(np, name)(places, axis)]
    if name == "transpose":
        return [np.transpose(places[0], params["permutation"])]
    if name == "split":
        return np.split(places[0], np.cumsum(params["sizes"])[:-1], params["axis"])
    return None


def _added(eqn: Any, values: list[Any], target: Target) -> Any:
    """What `.at[].add` makes at constant places: the array, and updates or zeros."""
    array, at, updates = values
    out, size = eqn.outvars[0].aval, int(np.prod(np.shape(updates)))
    numbers = jnp.asarray(1 + np.arange(size).reshape(np.shape(updates)), out.dtype)
    nothing = jnp.zeros(np.shape(array), out.dtype)
    places = eqn.primitive.bind(nothing, jnp.asarray(at), numbers, **eqn.params)
    more = target.moved([np.zeros(1, out.dtype), updates], np.asarray(places, int), out)
    return target.emit("add", [array, more], {}, out)


def _chosen(index: Any, branches: Sequence[Any], values: list[Any], target: Target) -> list[Any]:
    """All branches of a `cond`, and of their results that of the index."""
    every = [_walk(b.jaxpr, b.consts, values, target) for b in branches]
    found = every[-1]
    flag = jax.ShapeDtypeStruct((), np.dtype(bool))
    for i in reversed(range(len(branches) - 1)):
        low = target.emit("le", [index, np.asarray(i)], {}, flag)
        outs = [branch.aval for branch in branches[i].jaxpr.outvars]
        found = [
            target.emit("select_n", [low, b, a], {}, out)
            for a, b, out in zip(every[i], found, outs, strict=True)
        ]
    return found


def _unrolled(eqn: Any, values: list[Any], target: Target) -> list[Any]:
    """A `scan`, step by step."""
    params = eqn.params
    if params["length"] > _MOST_STEPS:
        raise UnsupportedError(f"scan of more than {_MOST_STEPS} steps")
    body = params["jaxpr"]
    # What is carried has one shape inside and outside; what is scanned or stacked has not. Versions
    # of JAX differ in the names under which they count it.
    ends = zip(eqn.outvars, body.jaxpr.outvars, strict=True)
    carried = sum(out.aval.shape == one.aval.shape for out, one in ends)
    starts = zip(values, body.jaxpr.invars, strict=True)
    fixed = sum(np.shape(value) == one.aval.shape for value, one in starts) - carried
    consts, carry = values[:fixed], values[fixed : fixed + carried]
    if len(values) == fixed + carried == fixed + len(body.jaxpr.outvars):  # as of `fori_loop`
        once = functools.partial(_walk, body.jaxpr, body.consts, target=target)
        repeated = target.repeated(lambda now: once([*consts, *now]), carry, params["length"])
        if repeated is not None:
            return repeated
    columns = body.jaxpr.invars[fixed + carried :]
    rows: list[Any] = [None] * params["length"]
    order = range(params["length"])
    for step in reversed(order) if params["reverse"] else order:
        now = []
        for values_of, var in zip(values[fixed + carried :], columns, strict=True):
            size = int(np.prod(var.aval.shape))
            places = (step * size + np.arange(size)).reshape(var.aval.shape)
            constant = is_constant(values_of)
            now.append(values_of[step] if constant else target.moved([values_of], places, var.aval))
        found = _walk(body.jaxpr, body.consts, [*consts, *carry, *map(_array, now)], target)
        carry, rows[step] = found[:carried], found[carried:]
    stacked = []
    for i, var in enumerate(body.jaxpr.outvars[carried:]):
        shape = (params["length"], *var.aval.shape)
        out = jax.ShapeDtypeStruct(shape, var.aval.dtype)
        places = np.arange(np.prod(shape, dtype=int)).reshape(shape)
        stacked.append(target.moved([row[i] for row in rows], places, out))
    return [*carry, *stacked]


def _array(value: Any) -> Any:
    return np.asarray(value) if isinstance(value, np.generic) else value


def kind_of(dtype: Any, name: str = "", kinds: str = "fib") -> str:
    """`f`, `i`, `b` or `u`: a real number, a whole one, a bool, or one without a sign.

    Raises:
      InputError: it is none of `kinds`.
    """
    kind = np.dtype(dtype).kind if isinstance(dtype, np.dtype) else "?"
    if kind not in kinds:
        raise UnsupportedError(f"{name} of {dtype}".strip())
    return kind


# Reductions and running ones, by the operation on two numbers that they repeat.
_OF_PAIRS = {"sum": "add", "prod": "mul", "max": "max", "min": "min", "and": "and", "or": "or"}
PAIRED = {f"{way}{name}": pair for name, pair in _OF_PAIRS.items() for way in ("reduce_", "cum")}
COMPARISONS = ("lt", "le", "gt", "ge", "eq", "ne")
