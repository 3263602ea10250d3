"""A law is tried on abstract values before anything runs, and what is wrong is said in a sentence.

Without this the first mistake in a law ends in a traceback through JAX. `check_law` traces `init`
and `step` once with `jax.eval_shape`, which computes nothing, and compares what they return with
what a trial needs.
"""

import functools
import inspect
import linecache
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.control.base import named_leaves
from rps_jax.control.observation import (
    Details,
    ForceObservation,
    Observation,
    PoseObservation,
    TaxelObservation,
    Twist,
)
from rps_jax.errors import InputError

_PACKAGE = str(Path(__file__).resolve().parent.parent)
_TAXELS = 42  # of the paper's skin
# What a law did that JAX cannot trace, and what to write instead.
_MENDS: dict[type[Exception], str] = {
    jax.errors.TracerBoolConversionError: "branches on a value that is not known while JAX traces: "
    "write jnp.where(condition, this, that)",
    jax.errors.TracerArrayConversionError: "hands NumPy a value that is not known while JAX "
    "traces: use jax.numpy",
    jax.errors.TracerIntegerConversionError: "uses a value as an index or a length that is not "
    "known while JAX traces: index with jnp.take or jnp.where",
    jax.errors.NonConcreteBooleanIndexError: "indexes by a condition that is not known while JAX "
    "traces: write jnp.where",
    jax.errors.ConcretizationTypeError: "needs a number that is not known while JAX traces: keep "
    "it a jax.Array",
}


def observation_shapes(senses: str) -> Any:
    """What a law observes that senses this, as shapes and types alone."""
    dtype = jnp.result_type(float)

    def number(*shape: int) -> Any:
        return jax.ShapeDtypeStruct(shape, dtype)

    flag: Any = jax.ShapeDtypeStruct((), bool)
    touch = Observation(number(2), number(), number(2), flag, number(2), number())
    if senses == "taxels":
        return TaxelObservation(touch, number(_TAXELS), flag)
    if senses == "force":
        return ForceObservation(touch, number(2))
    if senses == "pose":
        return PoseObservation(touch, number(2), number())
    return touch


@functools.lru_cache(maxsize=256)
def _tried(
    init: Callable[..., Any], step: Callable[..., Any], senses: str, tree: Any, leaves: Any
) -> None:
    params = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(*leaf) for leaf in leaves])
    memory = _called("init", init, params)
    if odd := [leaf for leaf in jax.tree.leaves(memory) if _is_odd(leaf)]:
        told = f"returns {_described(odd[0])}"
        raise _refused("init", init, told, "a pytree of arrays, the law's memory")
    found = _called("step", step, params, memory, observation_shapes(senses))
    wanted = "(memory, Twist, Details)"
    if not (isinstance(found, tuple) and len(found) == 3):
        raise _refused("step", step, f"returns {_described(found)}", wanted)
    after, twist, details = found
    if not (isinstance(twist, tuple) and len(twist) == 3):
        raise _refused("step", step, f"returns {_described(twist)} in the place of a twist", wanted)
    for name, leaf in zip(Twist._fields, twist, strict=True):
        if (what := _not_number(leaf)) is not None:
            raise _refused("step", step, f"returns a twist whose {name} is {what}", "a number ()")
    if not isinstance(details, Details):
        told = f"returns {_described(details)} in the place of details"
        raise _refused("step", step, told, "rps_jax.Details, as Details.from_obs(obs)")
    for name, leaf in details._asdict().items():
        if (what := _not_number(leaf, flags=True)) is not None:
            raise _refused("step", step, f"returns details whose {name} is {what}", "a number ()")
    if changed := _difference(memory, after):
        told = f"returns a memory {changed}"
        raise _refused("step", step, told, "the shapes and types that init returned")


def check_law(init: Callable[..., Any], step: Callable[..., Any], senses: str, params: Any) -> None:
    """Raises InputError unless `init` and `step` return what a trial needs, for these parameters.

    Laws of this package are not tried, and another one once for each form of its parameters.
    """
    if (getattr(_inner(step), "__module__", None) or "").startswith("rps_jax."):
        return
    for name, value in named_leaves(params, is_leaf=lambda x: x is None).items():
        if what := _no_leaf(value):
            raise InputError(f"params.{name} = {value!r} is not allowed: it is {what}.")
    leaves, tree = jax.tree.flatten(params)
    kinds = tuple((np.shape(leaf), jnp.result_type(float)) for leaf in leaves)
    _tried(init, step, senses, tree, kinds)


def _inner(function: Any) -> Any:
    """The function that partial ones call in the end."""
    while isinstance(function, functools.partial):
        function = function.func
    return function


def _no_leaf(value: Any) -> str:
    """What a value is that is no parameter; empty if it is one."""
    try:
        kind = np.asarray(value).dtype.kind
    except ValueError:
        return "a ragged list, and must be numbers of one shape"
    if kind in "biuf":
        return ""
    if kind == "c":
        return "complex, and must be real"
    return "no number"


def _called(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function of a law returns on abstract values, as it is if JAX cannot hold it."""
    odd: list[Any] = []

    def run(*given: Any) -> Any:
        found = function(*given)
        if any(map(_is_odd, jax.tree.leaves(found))):
            odd.append(found)
            return None
        return found

    try:
        shapes = jax.eval_shape(run, *arguments)
        return odd[0] if odd else shapes
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # whatever a user's file raises
        said = next((mend for kind, mend in _MENDS.items() if isinstance(error, kind)), None)
        if said is None:
            reason = " ".join(str(error).split())[:300].rstrip(".")
            said = f"raises {type(error).__name__}" + (f" ({reason})" if reason else "")
        where = _line_of(error, function)
        raise InputError(f"{name} of the law in {where} {said}.") from error


def _is_odd(leaf: Any) -> bool:
    """Whether JAX can't hold it."""
    if isinstance(leaf, str | bytes | type):
        return True
    try:
        return np.dtype(jnp.result_type(leaf)).kind not in "biufc"
    except (TypeError, ValueError):  # a key of jax.random, or something else
        dtype = getattr(leaf, "dtype", None)
        return dtype is None or not jnp.issubdtype(dtype, jax.dtypes.extended)


def _described(found: Any) -> str:
    """What something is, in a few words."""
    if found is None:
        return "None"
    if isinstance(found, tuple) and type(found) is tuple:
        return f"{len(found)} values"
    if hasattr(found, "shape") and np.dtype(found.dtype).kind in "biufc":
        return f"an array {tuple(found.shape)}"
    name = type(found).__name__
    return f"{'an' if name[0].lower() in 'aeiou' else 'a'} {name}"


def _not_number(leaf: Any, *, flags: bool = False) -> str | None:
    """What a leaf is that is no real number (), or None."""
    if not hasattr(leaf, "shape") or not hasattr(leaf, "dtype"):
        return _described(leaf)
    if leaf.shape != ():
        return f"an array {tuple(leaf.shape)}"
    kinds = "biuf" if flags else "iuf"
    return None if np.dtype(leaf.dtype).kind in kinds else f"{leaf.dtype}"


def _difference(before: Any, after: Any) -> str:
    """How the memory after a step differs from the one before; empty if it does not."""
    if jax.tree.structure(before) != jax.tree.structure(after):
        return "of another structure"
    for (name, a), b in zip(named_leaves(before).items(), jax.tree.leaves(after), strict=True):
        whose = f"whose {name}" if name else "that"
        if _is_odd(b):
            return f"{whose} is {_described(b)}"
        if a.shape != b.shape:
            return f"{whose} has the shape {tuple(b.shape)} after a step and {a.shape} before"
        if a.dtype != b.dtype:
            return f"{whose} is {b.dtype} after a step and {a.dtype} before"
    return ""


def _refused(name: str, function: Callable[..., Any], told: str, wanted: str) -> InputError:
    return InputError(f"{name} of the law in {_place(function)} {told}: return {wanted}.")


def _place(function: Callable[..., Any]) -> str:
    """The file and the first line of a function."""
    function = _inner(function)
    try:
        file, (_, line) = inspect.getsourcefile(function), inspect.getsourcelines(function)
    except (OSError, TypeError):
        return getattr(function, "__module__", None) or repr(function)
    return f"{file}, line {line},"


def _line_of(error: BaseException, function: Callable[..., Any]) -> str:
    """The line of the user's own code at which something was raised."""
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        file = frame.f_code.co_filename
        if not (file.startswith((_PACKAGE, "<")) or "site-packages" in file):
            code = linecache.getline(file, line).strip()
            return f"{file}, line {line} (`{code}`)," if code else f"{file}, line {line},"
    return _place(function)
