"""Checks of a custom law before anything compiles, with errors of one sentence.

`check_law` traces `init` and `step` with `jax.eval_shape`, which computes nothing, and compares
the results with the types that a trial needs. Without it, a mistake in a law ends in a traceback
through JAX.
"""

import functools
import inspect
import linecache
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.control.base import LawParams, Senses, named_leaves
from rps_jax.control.observation import (
    AnyObservation,
    Details,
    ForceObservation,
    Observation,
    PoseObservation,
    TaxelObservation,
    Twist,
)
from rps_jax.errors import InputError

Function = Callable[..., object]
_PACKAGE = str(Path(__file__).resolve().parent.parent)
_TAXELS = 42  # of the paper's skin
# Operations that JAX cannot trace, with what to write instead.
_TRACER_ERRORS: dict[type[Exception], str] = {
    jax.errors.TracerBoolConversionError: "branches on a traced value: write "
    "jnp.where(condition, x, y)",
    jax.errors.TracerArrayConversionError: "passes a traced value to NumPy: use jax.numpy",
    jax.errors.TracerIntegerConversionError: "uses a traced value as an index or a length: index "
    "with jnp.take or jnp.where",
    jax.errors.NonConcreteBooleanIndexError: "indexes with a traced condition: write jnp.where",
    jax.errors.ConcretizationTypeError: "converts a traced value to a Python number: keep it a "
    "jax.Array",
}


def observation_shapes(senses: Senses) -> AnyObservation:
    """Return the observation of a law as `jax.ShapeDtypeStruct` leaves."""
    dtype = jnp.result_type(float)
    shape: Callable[..., Any] = lambda *sizes: jax.ShapeDtypeStruct(sizes, dtype)  # noqa: E731
    flag: Any = jax.ShapeDtypeStruct((), bool)
    touch = Observation(shape(2), shape(), shape(2), flag, shape(2), shape())
    if senses == "taxels":
        return TaxelObservation(touch, shape(_TAXELS), flag)
    if senses == "force":
        return ForceObservation(touch, shape(2))
    if senses == "pose":
        return PoseObservation(touch, shape(2), shape())
    return touch


def check_law(init: Function, step: Function, senses: Senses, params: LawParams) -> None:
    """Raise InputError unless `init` and `step` return what a trial needs.

    Laws of this package are not checked. A custom law is traced once for each form of its
    parameters.
    """
    if (getattr(_unwrap(step), "__module__", None) or "").startswith("rps_jax."):
        return
    for name, value in named_leaves(params, is_leaf=lambda x: x is None).items():
        if fault := _leaf_fault(value):
            raise InputError(f"params.{name} = {value!r} is not allowed: it is {fault}.")
    leaves, tree = jax.tree.flatten(params)
    _check_traced(init, step, senses, tree, tuple(np.shape(leaf) for leaf in leaves))


def _leaf_fault(value: object) -> str:
    """Describe why a value is no parameter; empty if it is one."""
    try:
        kind = np.asarray(value).dtype.kind
    except ValueError:
        return "a ragged list, and must be numbers of one shape"
    if kind == "c":
        return "complex, and must be real"
    return "" if kind in "biuf" else "not a number"


@functools.lru_cache(maxsize=256)
def _check_traced(
    init: Function, step: Function, senses: Senses, tree: Any, shapes: Sequence[tuple[int, ...]]
) -> None:
    """Trace both functions of a law, and compare their results with what a trial needs."""
    dtype = jnp.result_type(float)
    params = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(shape, dtype) for shape in shapes])
    traced_init, traced_step = _Traced("init", init), _Traced("step", step)
    state = traced_init(params)
    if invalid := [leaf for leaf in jax.tree.leaves(state) if not _is_array(leaf)]:
        raise traced_init.error(_describe(invalid[0]), "a pytree of arrays, the law's state")
    results = traced_step(params, state, observation_shapes(senses))
    parts: list[object] = list(results) if isinstance(results, tuple) else []
    if not (
        len(parts) == 3
        and isinstance(parts[1], tuple)
        and len(parts[1]) == 3
        and isinstance(parts[2], Details)
    ):
        actual = ", ".join(map(_describe, parts)) or _describe(results)
        raise traced_step.error(actual, "state, Twist, Details, such as Details.from_obs(obs)")
    scalars = [("a Twist", "iuf", item) for item in Twist(*parts[1])._asdict().items()]
    scalars += [("Details", "biuf", item) for item in parts[2]._asdict().items()]
    for group, kinds, (name, leaf) in scalars:
        if fault := _scalar_fault(leaf, kinds):
            raise traced_step.error(f"{group} whose {name} is {fault}", "a real scalar")
    if difference := _difference(state, parts[0]):
        raise traced_step.error(f"a state {difference}", "the shapes and types that init returned")


class _Traced(NamedTuple):
    """Function of a law, called on abstract values."""

    name: str
    function: Function

    def __call__(self, *args: object) -> object:
        """Return the abstract results; those that JAX cannot hold are returned unchanged."""
        invalid: list[object] = []

        def run(*args: object) -> object:
            results = self.function(*args)
            if all(map(_is_array, jax.tree.leaves(results))):
                return results
            invalid.append(results)
            return None

        try:
            shapes = jax.eval_shape(run, *args)
        except InputError:
            raise
        except (Exception, SystemExit) as error:  # any error of the user's function
            fault = next((t for kind, t in _TRACER_ERRORS.items() if isinstance(error, kind)), "")
            if not fault:
                reason = " ".join(str(error).split())[:300].rstrip(".")
                fault = f"raises {type(error).__name__}" + (f" ({reason})" if reason else "")
            line = _line_of(error) or _definition(self.function)
            raise InputError(f"{self.name} of the law in {line} {fault}.") from error
        return invalid[0] if invalid else shapes

    def error(self, actual: str, expected: str) -> InputError:
        """Return the error of a wrong result."""
        line = _definition(self.function)
        return InputError(f"{self.name} of the law in {line} returns {actual}: return {expected}.")


def _is_array(leaf: object) -> bool:
    """Whether JAX can hold a value."""
    if isinstance(leaf, str | bytes | type):
        return False
    try:
        return np.dtype(jnp.result_type(leaf)).kind in "biufc"
    except (TypeError, ValueError):  # a key of jax.random, or no array
        dtype = getattr(leaf, "dtype", None)
        return dtype is not None and jnp.issubdtype(dtype, jax.dtypes.extended)


def _describe(value: Any) -> str:
    """Describe a value in a few words."""
    if value is None:
        return "None"
    if type(value) is tuple:
        return f"{len(value)} values"
    if hasattr(value, "shape") and _is_array(value):
        return f"an array {tuple(value.shape)}"
    name = type(value).__name__
    return f"{'an' if name[0].lower() in 'aeiou' else 'a'} {name}"


def _scalar_fault(leaf: Any, kinds: str) -> str:
    """Describe why a leaf is no scalar of these kinds of type; empty if it is one."""
    if leaf is None or not _is_array(leaf) or np.shape(leaf) != ():
        return _describe(leaf)
    dtype = jnp.result_type(leaf)
    return "" if getattr(dtype, "kind", "") in tuple(kinds) else f"of type {dtype}"


def _difference(state: object, next_state: object) -> str:
    """Describe how a state differs from the initial one; empty if it does not."""
    if jax.tree.structure(state) != jax.tree.structure(next_state):
        return "of another structure"
    initial: dict[str, Any] = dict(named_leaves(state))
    for (name, old), new in zip(initial.items(), jax.tree.leaves(next_state), strict=True):
        subject = f"whose {name}" if name else "that"
        if not _is_array(new):
            return f"{subject} is {_describe(new)}"
        shape, dtype = np.shape(new), jnp.result_type(new)
        if old.shape != shape:
            return f"{subject} has shape {shape}, and {old.shape} in init"
        if old.dtype != dtype:
            return f"{subject} is {dtype}, and {old.dtype} in init"
    return ""


def _unwrap(function: object) -> object:
    """Return the function inside nested `functools.partial` objects."""
    while isinstance(function, functools.partial):
        function = function.func
    return function


def _definition(function: Function) -> str:
    """Return the file and the first line of a function."""
    inner: Any = _unwrap(function)
    try:
        file, (_, line) = inspect.getsourcefile(inner), inspect.getsourcelines(inner)
    except (OSError, TypeError):
        return getattr(inner, "__module__", None) or repr(inner)
    return f"{file}, line {line},"


def _line_of(error: BaseException) -> str:
    """Return the line of the user's code that raised an error; empty if there is none."""
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        file = frame.f_code.co_filename
        if not (file.startswith((_PACKAGE, "<")) or "site-packages" in file):
            code = linecache.getline(file, line).strip()
            return f"{file}, line {line} (`{code}`)," if code else f"{file}, line {line},"
    return ""
