"""Interpreter of jaxprs: enters nested calls, folds constants, and calls a target for the rest.

Values are NumPy arrays where they are constant, and otherwise what a `Target` returns. Operations
that only move numbers (slices, reshapes, stacks, gathers at constant indices) are one operation of
a target, `gather`: they are applied to flat indices, which gives the source of each number.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, jaxpr_as_fun

from rps_jax.lowering.compounds import COMPOUNDS, Function, fill_of
from rps_jax.lowering.graph import (
    Body,
    For,
    Params,
    Shape,
    Target,
    Typed,
    UnsupportedError,
    Value,
    Values,
    While,
    is_constant,
    kind_of,
    operation_of,
    positions,
    size_of,
)

_MAX_STEPS = 256  # of a scan that is unrolled
_MAX_UNROLLED = 500  # equations of the body of a scan that is unrolled
# Primitives that only move numbers, with the indices of the operands that have these numbers;
# empty: all operands.
_MOVES = {
    **dict.fromkeys(
        (
            "broadcast_in_dim",
            "reshape",
            "squeeze",
            "expand_dims",
            "slice",
            "rev",
            "transpose",
            "split",
            "unstack",
            "tile",
            "dynamic_slice",
            "gather",
        ),
        (0,),
    ),
    **dict.fromkeys(("pad", "dynamic_update_slice"), (0, 1)),
    **dict.fromkeys(("stack", "concatenate"), ()),
    "scatter": (0, 2),
}
# Random primitives, with the method of the key's implementation that expresses them.
_RANDOM = {
    "random_wrap": "",
    "random_unwrap": "",
    "random_bits": "random_bits",
    "random_split": "split",
    "random_fold_in": "fold_in",
}
# Operations of `operator` that NumPy does as JAX on whole numbers and bools.
_FOLDED = ("add", "sub", "mul", "neg", "lt", "le", "gt", "ge", "eq")
_IDENTITIES = (
    "stop_gradient",
    "copy",
    "copy_p",
    "optimization_barrier",
    "pvary",
    "name",
    "once_differentiable",
)


def traced(function: Function, *arguments: Any) -> tuple[ClosedJaxpr, Any]:
    """Return the jaxpr of a function in float64, and the shapes of its results.

    A target rounds constants to its own precision; in float32 they would be rounded twice.
    """
    with jax.enable_x64(True):
        return jax.make_jaxpr(function, return_shape=True)(*arguments)


def walk(closed: ClosedJaxpr, arguments: Values, target: Target) -> list[Value]:
    """Return the results of a closed jaxpr as values of a target."""
    with jax.enable_x64(True):
        return _walk(closed, arguments, target)


def _walk(closed: ClosedJaxpr | Jaxpr, arguments: Values, target: Target) -> list[Value]:
    jaxpr = closed.jaxpr if isinstance(closed, ClosedJaxpr) else closed
    consts = closed.consts if isinstance(closed, ClosedJaxpr) else ()
    values: dict[Any, Value] = dict(zip(jaxpr.constvars, map(np.asarray, consts), strict=True))
    values |= dict(zip(jaxpr.invars, arguments, strict=True))

    def read(atom: Any) -> Value:
        return np.asarray(atom.val, atom.aval.dtype) if isinstance(atom, Literal) else values[atom]

    for eqn in jaxpr.eqns:
        if not eqn.outvars:
            continue
        results = _results(eqn, [read(atom) for atom in eqn.invars], target)
        values |= dict(zip(eqn.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _results(eqn: JaxprEqn, values: list[Value], target: Target) -> Values:
    """Return the results of one equation."""
    name, params = eqn.primitive.name, eqn.params
    types, outs = _types(eqn.invars), _types(eqn.outvars)
    if name in _IDENTITIES:
        return values
    if all(map(is_constant, values)):
        return _fold(eqn, values)
    if name in _RANDOM and "u" in target.kinds:
        return _random(eqn, values, target)
    for out in outs:
        kind_of(out.dtype, name, target.kinds)
    if name == "cond":
        branches = [_walk(branch, values[1:], target) for branch in params["branches"]]
        count = len(branches)
        return [
            _apply("select_n", [values[0], *cases], [types[0], *[out] * count], {}, out, target)
            for *cases, out in zip(*branches, outs, strict=True)
        ]
    if name == "scan":
        return _scan(eqn, values, target)
    if name == "while":
        first = params["cond_nconsts"]
        second = first + params["body_nconsts"]
        condition = _with_consts(params["cond_jaxpr"], values[:first], target)
        body = _with_consts(params["body_jaxpr"], values[first:second], target)
        if While not in target.loops:
            raise UnsupportedError("while")
        return target.loop(While(), condition, body, values[second:])
    inner = params.get("call_jaxpr", params.get("jaxpr"))
    if inner is not None:
        return _walk(inner, values, target)
    if name == "call_hi_primitive":  # of versions of JAX from 0.12 on: it has its meaning itself
        expand = functools.partial(eqn.primitive.to_lojax, **params)
        return _expanded(expand, values, types, target)
    if name in _MOVES:
        sources = _MOVES[name] or range(len(values))
        if all(is_constant(v) for i, v in enumerate(values) if i not in sources):
            return _gather(eqn, values, sources, target)
    if name == "threefry2x32":  # one operation for each of its two results
        return [target.apply(f"{name}_{i}", values, params, out) for i, out in enumerate(outs)]
    if len(outs) == 1:
        return [_apply(name, values, types, params, outs[0], target)]
    if name not in COMPOUNDS:
        raise UnsupportedError(name)
    return _expanded(functools.partial(COMPOUNDS[name], **params), values, types, target)


def _types(atoms: Sequence[Any]) -> list[Typed]:
    """Return the types of atoms of a jaxpr."""
    return [atom.aval for atom in atoms]


def _apply(
    name: str,
    values: Values,
    types: Sequence[Typed],
    params: Params,
    out: Typed,
    target: Target,
) -> Value:
    """Apply a primitive: by the target if it spells the operation, else as a compound."""
    operation = operation_of(name, types, params, out)
    if not size_of(out.shape):
        return np.zeros(out.shape, out.dtype)
    is_same = (types[0].dtype.kind, types[0].shape) == (out.dtype.kind, out.shape)
    if is_same and name in ("convert_element_type", "bitcast_convert_type"):
        return values[0]
    if name == "reduce_precision" and params["exponent_bits"] > 7 and params["mantissa_bits"] > 22:
        return values[0]
    if operation not in target.operations and (operation in COMPOUNDS or name in COMPOUNDS):
        function = functools.partial(COMPOUNDS.get(operation) or COMPOUNDS[name], **params)
        return _expanded(function, values, types, target)[0]
    return target.apply(name, values, params, out)


def _expanded(function: Function, values: Values, types: Sequence[Typed], target: Target) -> Values:
    """Return the results of a function of JAX of values."""
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in types]
    return _walk(jax.make_jaxpr(function)(*shapes), values, target)


def _with_consts(closed: ClosedJaxpr, consts: Values, target: Target) -> Body:
    """Return a function from the carry of a loop to the results of a jaxpr."""
    return lambda carry: _walk(closed, [*consts, *carry], target)


def _is_key(value: Value) -> bool:
    return isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key)


def _random(eqn: JaxprEqn, values: list[Value], target: Target) -> Values:
    """Return the results of a random primitive, by the algorithm of its key."""
    name, params = eqn.primitive.name, dict(eqn.params)
    if not _RANDOM[name]:
        return values
    values = [np.asarray(jax.random.key_data(x)) if _is_key(x) else x for x in values]
    key: Any = eqn.invars[0].aval
    algorithm = getattr(key.dtype._impl, _RANDOM[name])
    return _expanded(functools.partial(algorithm, **params), values, values, target)


def _gather(
    eqn: JaxprEqn, values: list[Value], sources: Sequence[int], target: Target
) -> list[Value]:
    """Apply a primitive to flat indices, and gather the numbers of the values there."""
    start, indices = 0, list(values)
    for i in sources:
        shape = np.shape(values[i])
        indices[i] = start + positions(shape)
        start += size_of(shape)
    if eqn.primitive.name == "gather":  # its last source is the number for an index out of bounds
        values = [*values, fill_of(eqn.outvars[0].aval.dtype, eqn.params.get("fill_value"))]
        sources = [*sources, len(values) - 1]
        eqn = eqn.replace(params={**eqn.params, "fill_value": start})
    return [
        target.gather([values[i] for i in sources], x, out)
        for x, out in zip(_fold(eqn, indices), _types(eqn.outvars), strict=True)
    ]


def _fold(eqn: JaxprEqn, arrays: list[Value]) -> list[Value]:
    """Apply a primitive to constants: by NumPy, or if it is rare by JAX, which compiles it."""
    name, params, out = eqn.primitive.name, eqn.params, eqn.outvars[0].aval
    shape: Shape = out.shape
    if name == "broadcast_in_dim":
        added = [i for i in range(len(shape)) if i not in params["broadcast_dimensions"]]
        return [np.broadcast_to(np.expand_dims(arrays[0], added), shape)]
    if name in ("reshape", "squeeze", "expand_dims"):
        return [np.reshape(arrays[0], shape)]
    if name == "convert_element_type" and (arrays[0].dtype.kind, out.dtype.kind) != ("f", "i"):
        return [np.asarray(arrays[0]).astype(params["new_dtype"])]
    if name == "slice":
        limits = params["start_indices"], params["limit_indices"]
        return [arrays[0][tuple(map(slice, *limits, params["strides"] or [1] * len(shape)))]]
    if name in ("concatenate", "stack"):
        axis = params.get("dimension", params.get("axis"))
        return [getattr(np, name)(arrays, axis)]
    if name == "pad" and all(min(a, b) >= 0 == c for a, b, c in params["padding_config"]):
        widths = [(a, b) for a, b, _ in params["padding_config"]]
        return [np.pad(arrays[0], widths, constant_values=arrays[1])]
    if name == "split":
        return np.split(arrays[0], np.cumsum(params["sizes"])[:-1], params["axis"])
    if name == "unstack":
        return list(np.moveaxis(arrays[0], params["axis"], 0))
    if name == "transpose":
        return [np.transpose(arrays[0], params["permutation"])]
    if name == "rev":
        return [np.flip(arrays[0], params["dimensions"])]
    if name in _FOLDED and arrays[0].dtype.kind in "iub":
        with np.errstate(over="ignore"):
            return [np.asarray(getattr(operator, name)(*arrays))]
    result = eqn.primitive.bind(*map(jnp.asarray, arrays), **params)
    results = result if eqn.primitive.multiple_results else [result]
    return [x if _is_key(x) else np.asarray(x) for x in results]


class Rows(NamedTuple):
    """Function that is printed; of a scan, one step, which reads and writes rows of arrays."""

    body: ClosedJaxpr
    operands: Values | None = None  # of a step: indices of arguments, and constants
    carried: Values = ()  # arguments that are the first results of the last step
    scanned: Values = ()  # arguments that have a row for each step
    stacked: Sequence[int] = ()  # results that have one
    length: int = 1
    reverse: bool = False

    @classmethod
    def from_jaxpr(cls, closed: ClosedJaxpr) -> Rows:
        """Return the step of a function that is one scan of its arguments, else the function."""
        jaxpr, eqn = closed.jaxpr, closed.jaxpr.eqns[0] if len(closed.jaxpr.eqns) == 1 else None
        if eqn is None or eqn.primitive.name != "scan" or eqn.outvars != jaxpr.outvars:
            return cls(closed)
        known = dict(zip(jaxpr.constvars, map(np.asarray, closed.consts), strict=True))
        known |= {x: i for i, x in enumerate(jaxpr.invars)}
        operands = [np.asarray(x.val) if isinstance(x, Literal) else known[x] for x in eqn.invars]
        indices = [x for x in operands if isinstance(x, int)]
        fixed, carried = _counts(eqn)
        starts, scanned = operands[fixed : fixed + carried], operands[fixed + carried :]
        if len(set(indices)) < len(indices) or any(map(is_constant, starts + scanned)):
            return cls(closed)
        params, stacked = eqn.params, range(carried, len(eqn.outvars))
        steps = params["length"], params["reverse"]
        return cls(params["jaxpr"], operands, starts, scanned, stacked, *steps)


def _counts(eqn: JaxprEqn) -> tuple[int, int]:
    """Return the numbers of the constants and of the carried values of a scan.

    Versions of JAX differ in the names of these counts. Carried values have the same shape inside
    and outside of the body; scanned and stacked values have not.
    """
    body = eqn.params["jaxpr"]
    pairs = (_types(eqn.invars), body.in_avals), (_types(eqn.outvars), body.out_avals)
    equal, carried = (sum(x.shape == y.shape for x, y in zip(*z, strict=True)) for z in pairs)
    return equal - carried, carried


def _scan(eqn: JaxprEqn, values: list[Value], target: Target) -> list[Value]:
    """Emit a loop for a `fori_loop` or a large body, and unroll any other `scan`."""
    params = eqn.params
    length, body = params["length"], params["jaxpr"]
    if length > _MAX_STEPS:
        raise UnsupportedError(f"scan of more than {_MAX_STEPS} steps")
    fixed, carried = _counts(eqn)
    consts, carry = values[:fixed], values[fixed : fixed + carried]
    if len(values) == fixed + carried == fixed + len(body.out_avals):
        if For in target.loops:
            return target.loop(For(length), None, _with_consts(body, consts, target), carry)
    elif _count_equations(body) > _MAX_UNROLLED:
        counts = {"length": length, "fixed": fixed, "carried": carried}
        function = functools.partial(_scan_loop, jaxpr=body, reverse=params["reverse"], **counts)
        return list(_expanded(function, values, _types(eqn.invars), target))
    scanned = list(zip(values[fixed + carried :], body.in_avals[fixed + carried :], strict=True))
    rows: list[list[Value]] = [[]] * length
    order = range(length)
    for step in reversed(order) if params["reverse"] else order:
        row = [_row(value, step, out, target) for value, out in scanned]
        results = _walk(body, [*consts, *carry, *row], target)
        carry, rows[step] = results[:carried], results[carried:]
    stacked = []
    for i, inner in enumerate(body.out_avals[carried:]):
        out = jax.ShapeDtypeStruct((length, *inner.shape), inner.dtype)
        stacked.append(target.gather([row[i] for row in rows], positions(out.shape), out))
    return [*carry, *stacked]


def _row(value: Value, step: int, out: Any, target: Target) -> Value:
    """Return the slice of a scanned value in one step."""
    if is_constant(value):
        return np.asarray(value[step])
    return target.gather([value], step * size_of(out.shape) + positions(out.shape), out)


def _scan_loop(
    *values: jax.Array, jaxpr: ClosedJaxpr, length: int, reverse: bool, fixed: int, carried: int
) -> list[jax.Array]:
    """Compute a scan by a loop over its carry and its stacked results."""
    consts, scanned = values[:fixed], values[fixed + carried :]

    def turn(state: list[jax.Array], _: None) -> tuple[list[jax.Array], None]:
        step, *state = state
        rows = [lax.dynamic_index_in_dim(x, step, keepdims=False) for x in scanned]
        results = jaxpr_as_fun(jaxpr)(*consts, *state[:carried], *rows)
        stacked = zip(state[carried:], results[carried:], strict=True)
        rows = [lax.dynamic_update_index_in_dim(x, row, step, 0) for x, row in stacked]
        return [step + np.int32(-1 if reverse else 1), *results[:carried], *rows], None

    start = jnp.int32(length - 1 if reverse else 0), *values[fixed : fixed + carried]
    stacked = [jnp.zeros((length, *x.shape), x.dtype) for x in jaxpr.out_avals[carried:]]
    return lax.scan(turn, [*start, *stacked], length=length)[0][1:]


def _count_equations(jaxpr: ClosedJaxpr | Jaxpr) -> int:
    """Count the equations of a jaxpr and of those that it contains."""
    params = jax.tree.leaves([list(eqn.params.values()) for eqn in jaxpr.eqns])
    inner = [x for x in params if isinstance(x, ClosedJaxpr | Jaxpr)]
    return len(jaxpr.eqns) + sum(map(_count_equations, inner))


# --- operations of several targets, by others --------------------------------------------------


def reduced_by_rows(
    target: Target, binary: str, value: Value, axes: Sequence[int], out: Typed
) -> Value:
    """Reduce some axes by a binary operation for each row along them."""
    shape = np.shape(value)
    rest = [i for i in range(len(shape)) if i not in axes]
    indices = np.transpose(positions(shape), [*axes, *rest])
    first, *rows = indices.reshape(-1, *out.shape)
    result = target.gather([value], first, out)
    for row in rows:
        result = target.apply(binary, [result, target.gather([value], row, out)], {}, out)
    return result


def sliding_windows(
    target: Target, shape: Sequence[int], starts: Values, sizes: Sequence[int]
) -> tuple[Value, np.ndarray]:
    """Return the index of the window at a start, clamped, and the indices in each window."""
    windows = np.lib.stride_tricks.sliding_window_view(positions(shape), tuple(sizes))
    zero = np.zeros((), np.int32)
    index: Value = zero
    for start, count in zip(starts, windows.shape, strict=False):
        clamped: Value = zero
        if count > 1:
            clamped = target.apply("min", [start, np.asarray(count - 1, start.dtype)], {}, start)
            if kind_of(start.dtype) == "u":
                clamped = target.apply("convert_element_type", [clamped], {}, zero)
            clamped = target.apply("max", [clamped, zero], {}, zero)
        index = target.apply("mul", [index, np.asarray(count, np.int32)], {}, zero)
        index = target.apply("add", [index, clamped], {}, zero)
    return index, windows.reshape(-1, size_of(sizes))
