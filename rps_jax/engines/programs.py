"""Traced programs, kept between processes beside XLA's compiled ones, so that none is traced twice.

XLA's cache spares a process the compilation; tracing and lowering, which are Python, it does not
spare. So a program is also kept as StableHLO, as `jax.export` writes it, under a key of all that it
depends on: versions, this package's source, the device, shapes and static settings. An entry is
verified before it is used; one that is damaged is dropped with one line, and traced again.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import importlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import export

from rps_jax.control.base import Law
from rps_jax.engines import native
from rps_jax.record import cache


def compile_function(
    function: Callable[..., Any],
    arguments: Sequence[Any],
    *,
    law: Law,
    donate: int,
    static: Sequence[Any],
) -> Callable[..., Any]:
    """Compile a function for arguments of these shapes, from what was kept of it if there is.

    Args:
      function: pure; it may depend on nothing but its arguments, the law and `static`.
      arguments: pytrees of arrays or `jax.ShapeDtypeStruct`.
      law: which it calls; of one that no name says (see `identity`), nothing is kept.
      donate: position of the argument whose memory may be used again.
      static: what else it depends on; each with a `repr` that says all of it.

    Returns:
      The compiled function. It is the same program whether it was kept or not.
    """
    if (who := identity(law)) is None:
        return compile_lowered(jax.jit(function, donate_argnums=donate).lower(*arguments))
    leaves, tree = jax.tree.flatten(jax.eval_shape(lambda *given: given, *arguments))
    sizes = [jax.tree.structure(one).num_leaves for one in arguments]
    first = sum(sizes[:donate])
    donated = tuple(range(first, first + sizes[donate]))
    shapes: list[Any] = []  # of what it returns

    def flat(*given: Any) -> list[Any]:
        found, structure = jax.tree.flatten(function(*jax.tree.unflatten(tree, given)))
        shapes[:] = [structure]
        return found

    shown = [(x.shape, str(x.dtype)) for x in leaves]
    place = _place(repr((function.__qualname__, _said(tree), shown, donated, who, static)))
    found = None if place is None else _read(place, leaves)
    if found is None:
        jitted = jax.jit(flat, donate_argnums=donated)
        jitted.trace(*leaves)  # in which functions are compiled that it calls
        safe = list(map(export.DisabledSafetyCheck.custom_call, native.loaded_names()))
        exported = export.export(jitted, disabled_checks=safe)(*leaves)
        (structure,) = shapes
        with contextlib.suppress(ValueError, TypeError, AttributeError):  # what cannot be kept
            cache.write(place, _head(structure) + b"\n" + bytes(exported.serialize()))
    else:
        structure, exported = found
    program = compile_lowered(jax.jit(exported.call, donate_argnums=donated).lower(*leaves))
    return lambda *given: jax.tree.unflatten(structure, program(*jax.tree.leaves(given)))


def _said(structure: Any) -> Any:
    """All that the structure of a pytree holds, with a digest of every static array."""
    data = structure.node_data()
    held = data and (data[0], _digests(data[1]))
    return held, structure.num_leaves, [_said(child) for child in structure.children()]


def _digests(data: Any) -> Any:
    """Static data with a digest in the place of every array."""
    if isinstance(data, tuple):
        return tuple(map(_digests, data))
    if isinstance(data, Mapping):
        return {name: _digests(one) for name, one in data.items()}
    array = getattr(data, "array", data)  # so MJX wraps what a model has of fixed numbers
    if isinstance(array, np.ndarray):
        return array.shape, str(array.dtype), hashlib.sha256(array.tobytes()).hexdigest()
    return data


def _head(structure: Any) -> bytes:
    """The structure of a pytree as JSON has it, from which `_tree` makes it again.

    Raises:
      ValueError, TypeError, AttributeError: it has nodes that are made otherwise.
    """
    head = json.dumps(_words(structure.unflatten([0] * structure.num_leaves)))
    if jax.tree.structure(_tree(json.loads(head))) != structure:
        raise ValueError(f"{structure} is not kept")
    return head.encode()


def _words(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _words(one) for key, one in tree.items()}
    if isinstance(tree, tuple):
        return [f"{type(tree).__module__}:{type(tree).__name__}", *map(_words, tree)]
    return tree


def _tree(words: Any) -> Any:
    """The pytree of which these are the words."""
    if isinstance(words, dict):
        return {key: _tree(one) for key, one in words.items()}
    if isinstance(words, list):
        module, _, name = words[0].partition(":")
        kind, leaves = getattr(importlib.import_module(module), name), map(_tree, words[1:])
        return tuple(leaves) if kind is tuple else kind(*leaves)
    return words


def compile_lowered(lowered: Any) -> Any:
    """Compile a program; on a GPU so that what does not wait for one another runs side by side."""
    if jax.default_backend() == "gpu":
        with contextlib.suppress(Exception):  # an XLA that does not know of it
            return lowered.compile({"xla_gpu_command_buffer_scheduling_mode": "CONCURRENT"})
    program = lowered.compile()
    with contextlib.suppress(AttributeError, OSError, TypeError):  # a system without glibc
        ctypes.CDLL(None).malloc_trim(0)  # gives back the compiler's memory, 0.8 GB
    return program


def identity(law: Law) -> str | None:
    """What says in any process which law this is; None if nothing does.

    A law of this package whose functions stand at the top of their modules is said by their names,
    and by what is bound to them, as the weights of a network; its source is a part of every key.
    """
    names = list(map(_named, (law.init, law.step)))
    if None in names:
        return None
    return repr((names, law.senses, law.temperatures, law.smooth, law.cell))


def _named(function: Any) -> Any:
    if isinstance(function, functools.partial):
        own = _named(function.func)
        return own and (own, _digests(function.args), _digests(function.keywords))
    module, name = getattr(function, "__module__", ""), getattr(function, "__qualname__", "<")
    return f"{module}.{name}" if module.startswith("rps_jax.") and "<" not in name else None


@functools.cache
def _source() -> str:
    """Digest of this package's source and of the versions that make a program of it."""
    names = ("jax", "jaxlib", "numpy", "mujoco", "mujoco-mjx")
    versions = [metadata.version(name) for name in names]
    told = hashlib.sha256(repr(versions).encode())
    root = Path(__file__).parents[1]
    for path in sorted([*root.rglob("*.py"), *root.rglob("*.[ch]")]):
        told.update(path.read_bytes())
    return told.hexdigest()


def _place(told: str) -> Path | None:
    """Where a program is kept of which this says all; None if nowhere.

    An address in memory, or what was left out of a long array, says nothing.
    """
    folder = jax.config.jax_compilation_cache_dir
    if not folder or " at 0x" in told or "..." in told:
        return None
    found = jax.devices()[0]
    flags = [jax.config.jax_enable_x64, jax.config.jax_default_matmul_precision, native.target()]
    where = [found.platform, found.device_kind, os.environ.get("XLA_FLAGS", ""), flags]
    key = hashlib.sha256(repr((_source(), where, told)).encode()).hexdigest()
    return Path(folder) / "traced" / key


def _read(path: Path, leaves: Sequence[Any]) -> tuple[Any, export.Exported] | None:
    """A program that was kept and the structure of its results, if it is of these arguments."""

    def told(body: bytes) -> tuple[Any, export.Exported]:
        head, _, program = body.partition(b"\n")
        found = export.deserialize(bytearray(program))
        if [(x.shape, x.dtype) for x in found.in_avals] != [(x.shape, x.dtype) for x in leaves]:
            raise ValueError("it is of other shapes")
        if not all(map(native.load, native.called_names(found.mlir_module_serialized))):
            raise ValueError("it needs a compiled function that is not there")
        return jax.tree.structure(_tree(json.loads(head))), found

    return cache.read(path, "traced", told)
