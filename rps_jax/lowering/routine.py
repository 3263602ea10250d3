"""Pure functions of named pytrees as jaxprs: the input of the exporters."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from rps_jax import errors
from rps_jax.lowering.graph import Shape, kind_of, size_of
from rps_jax.lowering.walk import traced
from rps_jax.spec import spec_at

Pytree: TypeAlias = Any  # of arrays or of `jax.ShapeDtypeStruct`
_DTYPES = {"f": np.float64, "i": np.int64, "b": np.bool_}


class Field(NamedTuple):
    """A named number or array of a group."""

    name: str
    shape: Shape
    kind: str  # f, i or b
    about: str = ""  # unit and meaning
    value: np.ndarray | None = None  # initial value

    @property
    def size(self) -> int:
        """Number of elements."""
        return size_of(self.shape)

    @property
    def type(self) -> jax.ShapeDtypeStruct:
        """Shape and dtype in the jaxpr."""
        return jax.ShapeDtypeStruct(self.shape, _DTYPES[self.kind])


Group: TypeAlias = tuple[Field, ...]


class Routine(NamedTuple):
    """A pure function of groups of fields, as a jaxpr over all their fields."""

    name: str
    jaxpr: ClosedJaxpr
    inputs: Mapping[str, Group]
    outputs: Mapping[str, Group]


def routine(
    name: str, function: Callable[..., Pytree], inputs: Mapping[str, Pytree], outputs: Sequence[str]
) -> Routine:
    """Trace a function of named pytrees that returns a tuple of the named pytrees."""
    jaxpr, out = traced(function, *inputs.values())
    return Routine(
        name,
        jaxpr,
        {key: fields_of(tree) for key, tree in inputs.items()},
        {key: fields_of(tree) for key, tree in zip(outputs, out, strict=True)},
    )


def fields_of(tree: Pytree, values: Pytree = None) -> Group:
    """Return the leaves of a pytree as fields, named by their paths."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    starts = jax.tree.leaves(values) if values is not None else [None] * len(leaves)
    fields = []
    for (at, leaf), value in zip(leaves, starts, strict=True):
        path = jax.tree_util.keystr(at, simple=True, separator=".")
        name = identifier(path.removeprefix("touch.")) or "value"
        dtype = np.dtype(getattr(leaf, "dtype", np.asarray(leaf).dtype))
        value = None if value is None else np.asarray(value)
        kind, about = kind_of(dtype, kinds="fib"), str(spec_at(tree, path) or "")
        fields.append(Field(name, np.shape(leaf), kind, about.replace("*/", ""), value))
    names = [field.name for field in fields]
    errors.check_each_once("names of the law's numbers", names) if names else None
    return tuple(fields)


def identifier(text: str) -> str:
    """Return a text as a name of C and JavaScript."""
    name = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_")
    return f"law_{name}" if name[:1].isdigit() else name
