"""Checks of a custom law before anything compiles, with errors of one sentence.

`check_law` traces each function twice, which computes nothing. It compares the results with the
types that a trial needs, and both traces with each other. Without it, a mistake in a law ends in a
traceback through JAX, or a law that is not pure in results that depend on the compiler.
"""

import functools
import inspect
import linecache
import re
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.control.base import Law, LawParams, Senses, named_leaves
from rps_jax.control.observation import (
    AnyObservation,
    Details,
    EndsObservation,
    ForceObservation,
    Observation,
    PoseObservation,
    TaxelObservation,
    Twist,
)
from rps_jax.errors import InputError, not_allowed, one_line
from rps_jax.geometry.arrays import Pytree

Function = Callable[..., object]
_PACKAGE = str(Path(__file__).resolve().parent.parent)
_TAXELS = 42  # of the paper's skin
# Operations that JAX cannot trace, with what to write instead.
_TRACER_ERRORS: dict[type[Exception], str] = {
    jax.errors.TracerBoolConversionError: "branches on a traced value: write jnp.where(c, x, y)",
    jax.errors.TracerArrayConversionError: "passes a traced value to NumPy: use jax.numpy",
    jax.errors.TracerIntegerConversionError: "uses a traced index or length: write jnp.take",
    jax.errors.NonConcreteBooleanIndexError: "indexes with a traced condition: write jnp.where",
    jax.errors.ConcretizationTypeError: "converts a traced value to a number: keep a jax.Array",
    jax.errors.UnexpectedTracerError: "reads a value of an earlier call: keep it in the state",
}


def observation_shapes(
    senses: Senses, taxels: int = _TAXELS, heading: bool = False
) -> AnyObservation:
    """Return the observation of a law as `jax.ShapeDtypeStruct` leaves.

    That of a law with a `heading` has the heading of the goal.
    """
    dtype = jnp.result_type(float)
    shape: Callable[..., Any] = lambda *sizes: jax.ShapeDtypeStruct(sizes, dtype)  # noqa: E731
    flags: Callable[..., Any] = lambda *sizes: jax.ShapeDtypeStruct(sizes, bool)  # noqa: E731
    flag = flags()
    touch = Observation(shape(2), shape(), shape(2), flag, shape(2), shape())
    touch = touch._replace(yaw_target=shape()) if heading else touch
    signal = shape(taxels)
    observations: dict[Senses, AnyObservation] = {
        "touch": touch,
        "taxels": TaxelObservation(touch, signal, flag),
        "ends": EndsObservation(touch, signal, flags(taxels), shape(2), flags(2), flag, shape()),
        "force": ForceObservation(touch, shape(2)),
        "pose": PoseObservation(touch, shape(2), shape(), shape(4, 2) if heading else None),
    }
    return observations[senses]


def check_law(law: Law, params: LawParams, taxels: int | None = None) -> None:
    """Raise InputError unless the functions of a law return what a trial needs on a robot.

    Laws of this package are checked only for other `taxels` than the paper's, and learned ones for
    those of any robot. A law is traced once for each form of its parameters.
    """
    module = getattr(_unwrap(law.step), "__module__", None) or ""
    trusted = "rps_jax." if taxels is None else "rps_jax.control.laws."
    if taxels in (None, _TAXELS) and module.startswith(trusted):
        return
    for name, value in named_leaves(params, is_leaf=lambda x: x is None).items():
        try:
            kind = np.asarray(value).dtype.kind
        except ValueError:  # a ragged list
            kind = ""
        if kind not in tuple("biuf"):
            rule = "it must be a real number, or an array of these"
            raise not_allowed(f"params.{name}", repr(value), rule)
    leaves, tree = jax.tree.flatten(params)
    shapes = tuple(np.shape(leaf) for leaf in leaves)
    _check_traced(law, tree, shapes, taxels or _TAXELS)


@functools.lru_cache(maxsize=256)
def _check_traced(law: Law, tree: Pytree, shapes: Sequence[tuple[int, ...]], taxels: int) -> None:
    """Trace the functions of a law, and compare their results with what a trial needs."""
    dtype, step = jnp.result_type(float), law.step
    params = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(shape, dtype) for shape in shapes])
    state = _trace("init", law.init, params)
    name = "step" if taxels == _TAXELS else f"step, for a robot with {taxels} taxels,"
    observation = observation_shapes(law.senses, taxels, law.heading)
    results: Pytree = _trace(name, step, params, state, observation)

    def check(fault: str, expected: str) -> None:
        if fault:
            law = f"step of the law in {_definition(step)}"
            raise InputError(f"{law} returns {fault}: return {expected}.")

    is_triple = isinstance(results, tuple) and len(results) == 3
    next_state, twist, details = results if is_triple else (None, None, None)
    is_valid = isinstance(twist, tuple) and len(twist) == 3 and isinstance(details, Details)
    values = ", ".join(map(_describe, results if is_triple else [results]))
    check("" if is_valid else values, "state, Twist, Details, such as Details.from_obs(obs)")
    assert twist is not None
    assert details is not None
    for group, kinds, fields in (("a Twist", "iuf", Twist(*twist)), ("Details", "biuf", details)):
        for name, leaf in fields._asdict().items():
            dtype = getattr(leaf, "dtype", None)
            is_scalar = np.shape(leaf) == () and getattr(dtype, "kind", "") in tuple(kinds)
            fault = "" if is_scalar else f"{group} whose {name} is {_describe(leaf)}"
            check(fault, "a real scalar")
    check(_difference(state, next_state), "the shapes and types that init returned")
    if law.is_done is not None:
        done = _describe(_trace("is_done", law.is_done, state))
        if done != "bool ()":
            function = f"is_done of the law in {_definition(law.is_done)}"
            raise InputError(f"{function} returns {done}: return one bool, as state.phase > 2.")


def _trace(name: str, function: Function, *args: object) -> object:
    """Return the abstract results of a function of a law, which must be pure."""
    try:
        programs, results = zip(*(_program(function, args) for _ in range(2)), strict=True)
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # any error of the user's function
        line = _line_of(error) or _definition(function)
        raise InputError(f"{name} of the law in {line} {fault_of(error)}.") from error
    if programs[0] != programs[1]:
        raise InputError(
            f"{name} of the law in {_definition(function)} is not pure, since a second call "
            "computes something else: keep what changes in the state, and a key of jax.random."
        )
    return results[0]


def fault_of(error: BaseException) -> str:
    """Return the verb phrase of a function whose trace fails with an error."""
    reason = one_line(error)[:300].rstrip(".")
    raised = f"raises {type(error).__name__}" + (f" ({reason})" if reason else "")
    return next((t for kind, t in _TRACER_ERRORS.items() if isinstance(error, kind)), raised)


def _program(function: Function, args: Sequence[object]) -> tuple[object, object]:
    """Trace a function, and return its program without addresses, and its abstract results."""
    # A new function, since JAX caches traces by the function.
    traced, results = jax.make_jaxpr(lambda *x: function(*x), return_shape=True)(*args)
    if any(isinstance(x, jax.core.Tracer) for x in traced.consts):
        raise jax.errors.UnexpectedTracerError("a constant is traced")
    constants = [(np.shape(x), np.asarray(x).tobytes()) for x in traced.consts]
    return (re.sub("0x[0-9a-f]+", "", str(traced.jaxpr)), constants), results


def _describe(value: object) -> str:
    """Describe a value in a few words."""
    if isinstance(value, jax.ShapeDtypeStruct):
        return f"{value.dtype} {value.shape}"
    return "None" if value is None else f"a {type(value).__name__}"


def _difference(state: object, next_state: object) -> str:
    """Describe how a state differs from the initial one; empty if it does not."""
    if jax.tree.structure(state) != jax.tree.structure(next_state):
        return "a state of another structure"
    leaves = zip(named_leaves(state).items(), jax.tree.leaves(next_state), strict=True)
    for (name, old), new in leaves:
        if _describe(old) != _describe(new):
            return (
                f"a state whose {name or 'array'} is {_describe(new)}, and {_describe(old)} in init"
            )
    return ""


def _unwrap(function: Callable[..., object]) -> Any:
    """Return the function inside nested `functools.partial` objects and decorators."""
    while isinstance(function, functools.partial):
        function = function.func
    return inspect.unwrap(function)


def _definition(function: Function) -> str:
    """Return the file and the first line of a function."""
    code = getattr(_unwrap(function), "__code__", None)
    return f"{code.co_filename}, line {code.co_firstlineno}," if code else repr(function)


def _line_of(error: BaseException) -> str:
    """Return the line of the user's code that raised an error; empty if there is none."""
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        file = frame.f_code.co_filename
        if not (file.startswith((_PACKAGE, "<")) or "site-packages" in file):
            code = linecache.getline(file, line).strip()
            return f"{file}, line {line} (`{code}`)," if code else f"{file}, line {line},"
    return ""
