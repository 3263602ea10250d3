"""Linear maps with given transposes: derivatives of functions that JAX does not differentiate.

`once_differentiable` refuses second derivatives where they would be wrong.

`jax.custom_jvp` alone cannot say how a tangent map is transposed, and `jax.custom_vjp` has no
forward mode. The primitive of this module has both, and `jax.vmap` maps it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

# Of residuals (on which the map depends) and of vectors: tuples of arrays.
Map: TypeAlias = Callable[[Sequence[Any], Sequence[Any]], Sequence[jax.Array]]
Maps: TypeAlias = tuple[Map, Map | None]


def linear_map(
    forward: Map,
    transpose: Map | None,
    residuals: Sequence[Any],
    vectors: Sequence[Any],
    like: Any,
    label: str = "",
) -> list[jax.Array]:
    """Return `forward(residuals, vectors)`, linear in the vectors, with a given transpose.

    Args:
      forward: the map.
      transpose: from residuals and vectors of the results to vectors of the arguments; None of a
        map without vectors, a function of the residuals.
      residuals: arrays that are not differentiated.
      vectors: arrays.
      like: results have the shapes and types of these arrays.
      label: name of the map in a jaxpr.
    """
    outs = tuple(jax.core.ShapedArray(x.shape, x.dtype) for x in like)
    static = {"maps": (forward, transpose), "count": len(residuals), "outs": outs}
    return _primitive.bind(*residuals, *vectors, **static, label=label)


def varied_indices(tangents: Sequence[Any]) -> list[int]:
    """Return the indices of the tangents that are not zero, in a rule with `symbolic_zeros`."""
    return [i for i, x in enumerate(tangents) if not isinstance(x, SymbolicZero)]


def restrict(
    function: Callable[[list[Any]], Any], values: Sequence[Any], indices: Sequence[int]
) -> tuple[Callable[[list[Any]], Any], list[Any]]:
    """Return a function of some entries of its list, the others constant, and these entries."""

    def restricted(entries: list[Any]) -> Any:
        replaced = dict(zip(indices, entries, strict=True))
        return function([replaced.get(i, x) for i, x in enumerate(values)])

    return restricted, [values[i] for i in indices]


def once_differentiable(x: Any) -> Any:
    """Return a leaf of a pytree by which JAX refuses second derivatives."""
    is_real = isinstance(x, jax.core.Tracer) and jnp.issubdtype(x.dtype, jnp.inexact)
    return _once.bind(x, derived=False) if is_real else x


_primitive = Primitive("linear_map")
_primitive.multiple_results = True


@_primitive.def_impl
def _run(*arrays: Any, maps: Maps, count: int, **_: Any) -> list[jax.Array]:
    return list(maps[0](arrays[:count], arrays[count:]))


_primitive.def_abstract_eval(lambda *_, outs, **__: outs)


def _transpose(cotangents: Any, *arrays: Any, maps: Maps, count: int, outs: Any, label: str) -> Any:
    vectors = [
        jnp.zeros(out.shape, out.dtype) if isinstance(x, ad.Zero) else x
        for x, out in zip(cotangents, outs, strict=True)
    ]
    like = [x.aval for x in arrays[count:]]
    forward, transpose = maps
    assert transpose is not None  # a map without vectors is not transposed
    moved = linear_map(transpose, forward, arrays[:count], vectors, like, label)
    return [None] * count + moved


def _batch(arrays: Any, axes: Any, *, maps: Maps, count: int, outs: Any, label: str) -> Any:
    size = next(x.shape[i] for x, i in zip(arrays, axes, strict=True) if i is not None)
    whole = [
        jnp.broadcast_to(x, (size, *x.shape)) if i is None else jnp.moveaxis(x, i, 0)
        for x, i in zip(arrays, axes, strict=True)
    ]
    like = [jax.ShapeDtypeStruct((size, *out.shape), out.dtype) for out in outs]
    forward, transpose = jax.vmap(maps[0]), maps[1] and jax.vmap(maps[1])
    results = linear_map(forward, transpose, whole[:count], whole[count:], like, label)
    return results, [0] * len(outs)


def _refuse(*_: Any, **__: Any) -> Any:
    raise NotImplementedError(
        "trials have no second derivatives: differentiate once, or take differences of gradients."
    )


ad.primitive_jvps[_primitive] = _refuse
ad.primitive_transposes[_primitive] = _transpose
batching.primitive_batchers[_primitive] = _batch
mlir.register_lowering(_primitive, mlir.lower_fun(_run, multiple_results=True))


def _jvp_once(primals: Any, tangents: Any, derived: bool) -> tuple[jax.Array, Any]:
    return _refuse() if derived else (_once.bind(*primals, derived=True), *tangents)


_once = Primitive("once_differentiable")
_once.def_impl(lambda x, **_: x)
_once.def_abstract_eval(lambda x, **_: x)
ad.primitive_jvps[_once] = _jvp_once
batching.defvectorized(_once)
mlir.register_lowering(_once, lambda _, x, **__: [x])
