"""A law is tried on abstract values before anything runs, and what is wrong is said in a sentence.

Without this the first mistake in a law ends in a traceback through JAX. `check_law` traces `init`
and `step` once with `jax.eval_shape`, which computes nothing, and compares what they return with
what a trial needs.
"""

from __future__ import annotations

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
_MENDS: tuple[tuple[type[Exception], str], ...] = (
    (
        jax.errors.TracerBoolConversionError,
        "branches on a value that is not known while JAX traces: write "
        "jnp.where(condition, this, that)",
    ),
    (
        jax.errors.TracerArrayConversionError,
        "hands NumPy a value that is not known while JAX traces: use jax.numpy",
    ),
    (
        jax.errors.TracerIntegerConversionError,
        "uses a value as an index or a length that is not known while JAX traces: index with "
        "jnp.take or jnp.where",
    ),
    (
        jax.errors.NonConcreteBooleanIndexError,
        "indexes by a condition that is not known while JAX traces: write jnp.where",
    ),
    (
        jax.errors.ConcretizationTypeError,
        "needs a number that is not known while JAX traces: keep it a jax.Array",
    ),
)


def observation_of(senses: str) -> Any:
    """What a law observes that senses this, as shapes and types alone."""
    dtype = jnp.zeros(()).dtype

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
    wrong = _not_arrays(memory)
    if wrong:
        raise _refused("init", init, f"returns {wrong}", "a pytree of arrays, the law's memory")
    found = _called("step", step, params, memory, observation_of(senses))
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
        raise _refused("step", step, told, "rps_jax.Details, as Details.of(observation)")
    for name, leaf in details._asdict().items():
        if (what := _not_number(leaf, flags=True)) is not None:
            raise _refused("step", step, f"returns details whose {name} is {what}", "a number ()")
    changed = _difference(memory, after)
    if changed:
        raise _refused(
            "step", step, f"returns a memory {changed}", "the shapes and types that init returned"
        )


def check_law(init: Callable[..., Any], step: Callable[..., Any], senses: str, params: Any) -> None:
    """Raises InputError unless `init` and `step` return what a trial needs, for these parameters.

    Laws of this package are not tried, and another one once for each form of its parameters.
    """
    if _own(step):
        return
    for name, value in _fields(params):
        what = _no_leaf(value)
        if what:
            raise InputError(f"params.{name} = {value!r} is not allowed: it is {what}.")
    leaves, tree = jax.tree.flatten(params)
    kinds = tuple((np.shape(leaf), jnp.result_type(float)) for leaf in leaves)
    _tried(init, step, senses, tree, kinds)


def _own(step: Callable[..., Any]) -> bool:
    while isinstance(step, functools.partial):
        step = step.func
    return (getattr(step, "__module__", None) or "").startswith("rps_jax.")


def _fields(params: Any) -> list[tuple[str, Any]]:
    """Values of parameters by their place, None among them."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(params, is_leaf=lambda x: x is None)
    return [(jax.tree_util.keystr(at, simple=True, separator="."), leaf) for at, leaf in leaves]


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
    """What a function of a law returns on abstract values."""
    try:
        return jax.eval_shape(lambda *given: _Box(function(*given)).opened, *arguments)
    except _OddResultError as error:
        return error.found
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # whatever a user's file raises
        said = next((mend for kind, mend in _MENDS if isinstance(error, kind)), None)
        if said is None:
            reason = " ".join(str(error).split())[:300].rstrip(".")
            said = f"raises {type(error).__name__}" + (f" ({reason})" if reason else "")
        where = _line_of(error, function)
        raise InputError(f"{name} of the law in {where} {said}.") from error


class _OddResultError(Exception):
    """A function returned what JAX cannot hold."""

    def __init__(self, found: Any):
        super().__init__()
        self.found = found


class _Box:
    """What a function returned: handed on if JAX can hold it, else carried out by an exception."""

    def __init__(self, found: Any):
        self._found = found

    @property
    def opened(self) -> Any:
        """Return it."""
        if any(map(_is_odd, jax.tree.leaves(self._found))):
            raise _OddResultError(self._found)
        return self._found


def _is_odd(leaf: Any) -> bool:
    """Whether JAX can't hold it."""
    if isinstance(leaf, str | bytes | type):
        return True
    try:
        return np.dtype(jnp.result_type(leaf)).kind not in "biufc"
    except (TypeError, ValueError):  # a key of jax.random, or something else
        dtype = getattr(leaf, "dtype", None)
        return dtype is None or not jnp.issubdtype(dtype, jax.dtypes.extended)


def _not_arrays(tree: Any) -> str:
    odd = next(filter(_is_odd, jax.tree.leaves(tree)), None)
    return "" if odd is None else _described(odd)


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
    old, new = (jax.tree_util.tree_flatten_with_path(tree) for tree in (before, after))
    if old[1] != new[1]:
        return "of another structure"
    for (at, a), (_, b) in zip(old[0], new[0], strict=True):
        name = jax.tree_util.keystr(at, simple=True, separator=".")
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
    while isinstance(function, functools.partial):
        function = function.func
    try:
        file, (_, line) = inspect.getsourcefile(function), inspect.getsourcelines(function)
    except (OSError, TypeError):
        return getattr(function, "__module__", None) or repr(function)
    return f"{file}, line {line},"


def _line_of(error: BaseException, function: Callable[..., Any]) -> str:
    """The line of the user's own code at which something was raised."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    lines = [line for _, line in traceback.walk_tb(error.__traceback__)]
    for frame, line in reversed(list(zip(frames, lines, strict=True))):
        file = frame.f_code.co_filename
        if not (file.startswith((_PACKAGE, "<")) or "site-packages" in file):
            code = linecache.getline(file, line).strip()
            return f"{file}, line {line} (`{code}`)," if code else f"{file}, line {line},"
    return _place(function)
