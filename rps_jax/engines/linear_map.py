"""Linear maps with given transposes: derivatives of functions that JAX does not differentiate.

`jax.custom_jvp` alone cannot say how a tangent map is transposed, and `jax.custom_vjp` has no
forward mode. The primitive of this module has both, and `jax.vmap` maps it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

# Of residuals (on which the map depends) and of vectors: tuples of arrays.
Map: TypeAlias = Callable[[Sequence[Any], Sequence[Any]], Sequence[jax.Array]]


def linear_map(
    forward: Map, transpose: Map, residuals: Sequence[Any], vectors: Sequence[Any], like: Any
) -> list[jax.Array]:
    """Return `forward(residuals, vectors)`, linear in the vectors, with a given transpose.

    Args:
      forward: the map.
      transpose: from residuals and vectors of the results to vectors of the arguments.
      residuals: arrays that are not differentiated.
      vectors: arrays.
      like: results have the shapes and types of these arrays.
    """
    outs = tuple(jax.core.ShapedArray(x.shape, x.dtype) for x in like)
    return _primitive.bind(
        *residuals, *vectors, maps=(forward, transpose), count=len(residuals), outs=outs
    )


_primitive = Primitive("linear_map")
_primitive.multiple_results = True


@_primitive.def_impl
def _run(*arrays: Any, maps: tuple[Map, Map], count: int, outs: Any) -> list[jax.Array]:
    del outs
    return list(maps[0](arrays[:count], arrays[count:]))


_primitive.def_abstract_eval(lambda *_, outs, **__: outs)


def _transpose(cotangents: Any, *arrays: Any, maps: tuple[Map, Map], count: int, outs: Any) -> Any:
    vectors = [
        jnp.zeros(out.shape, out.dtype) if isinstance(x, ad.Zero) else x
        for x, out in zip(cotangents, outs, strict=True)
    ]
    like = [x.aval for x in arrays[count:]]
    forward, transpose = maps
    return [None] * count + linear_map(transpose, forward, arrays[:count], vectors, like)


def _batch(arrays: Any, axes: Any, *, maps: tuple[Map, Map], count: int, outs: Any) -> Any:
    size = next(x.shape[i] for x, i in zip(arrays, axes, strict=True) if i is not None)
    whole = [
        jnp.broadcast_to(x, (size, *x.shape)) if i is None else jnp.moveaxis(x, i, 0)
        for x, i in zip(arrays, axes, strict=True)
    ]
    like = [jax.ShapeDtypeStruct((size, *out.shape), out.dtype) for out in outs]
    forward, transpose = map(jax.vmap, maps)
    return linear_map(forward, transpose, whole[:count], whole[count:], like), [0] * len(outs)


def _refuse(*_: Any, **__: Any) -> Any:
    raise NotImplementedError(
        "native functions have no second derivatives; with the environment variable "
        "RPS_COMPILER=none XLA compiles them, and they have."
    )


ad.primitive_jvps[_primitive] = _refuse
ad.primitive_transposes[_primitive] = _transpose
batching.primitive_batchers[_primitive] = _batch
mlir.register_lowering(_primitive, mlir.lower_fun(_run, multiple_results=True))
