"""A cache of traced programs between processes, beside XLA's cache of compiled ones.

XLA's cache saves compilation, but not tracing and lowering in Python. This cache stores programs as
StableHLO, written by `jax.export`, under a key of all inputs: versions, source of this package,
device, shapes and static settings. An entry is verified before use. A damaged one is deleted with a
warning, and the program is traced again.
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
from typing import TYPE_CHECKING

import jax
import numpy as np
from jax import export
from jax.sharding import SingleDeviceSharding

from rps_jax.control.base import Law
from rps_jax.engines import native
from rps_jax.geometry.arrays import Pytree
from rps_jax.record import cache

if TYPE_CHECKING:
    from jaxlib._jax import Device, pytree  # pyright rejects the aliases of both


def trace_function(
    function: Callable[..., Pytree],
    arguments: Sequence[Pytree],
    *,
    law: Law,
    donate: int,
    static: Sequence[object],
) -> Callable[[Device | None], Callable[..., Pytree]]:
    """Trace a function for arguments of some shapes, or load its program from the cache.

    Args:
      function: pure; it depends only on its arguments, the law and `static`.
      arguments: pytrees of arrays or `jax.ShapeDtypeStruct`.
      law: called by the function; without an `identity`, the program is not cached.
      donate: index of the argument whose memory may be reused.
      static: further inputs of the function; the `repr` of each identifies it.

    Returns:
      A function that compiles the program for a device (None: the default one), once for each. It
      is the same program with and without the cache.
    """
    leaves, tree = jax.tree.flatten(jax.eval_shape(lambda *inputs: inputs, *arguments))
    donated = tuple(jax.tree.leaves(jax.tree.unflatten(tree, range(len(leaves)))[donate]))
    structures: list[pytree.PyTreeDef] = []  # of the results, once traced

    def flat(*inputs: object) -> list[object]:
        results, structure = jax.tree.flatten(function(*jax.tree.unflatten(tree, inputs)))
        structures[:] = [structure]
        return results

    shapes, law_name = [(x.shape, str(x.dtype)) for x in leaves], identity(law)
    inputs = function.__qualname__, _describe(tree), shapes, donated, law_name, static
    path = _path_of(repr(inputs)) if law_name else None
    jitted = jax.jit(flat, donate_argnums=donated)
    if path and (stored := _read(path, leaves)):
        structures[:], exported = stored[:1], stored[1]
        jitted = jax.jit(exported.call, donate_argnums=donated)
    elif law_name:
        calls = export.DisabledSafetyCheck.custom_call("ALL")  # of native functions
        exported = export.export(jitted, disabled_checks=[calls])(*leaves)
        with contextlib.suppress(ValueError, TypeError, AttributeError):  # cannot be serialised
            example = structures[0].unflatten([0] * structures[0].num_leaves)
            text = json.dumps(_to_json(example)).encode()
            if _decode(text) == structures[0]:
                cache.write(path, text + b"\n" + bytes(exported.serialize()))
        jitted = jax.jit(exported.call, donate_argnums=donated)

    @functools.cache
    def compiled(device: Device | None) -> Callable[..., object]:
        sharding = None if device is None else SingleDeviceSharding(device)
        placed = (x.update(sharding=sharding) for x in leaves)
        program = _compile_lowered(jitted.lower(*placed))
        return lambda *inputs: jax.tree.unflatten(structures[0], program(*jax.tree.leaves(inputs)))

    return compiled


def _describe(structure: pytree.PyTreeDef) -> object:
    """Return the content of the structure of a pytree, with a digest of each static array."""
    data = structure.node_data()
    node = data and (data[0], _digests(data[1]))
    return node, structure.num_leaves, [_describe(child) for child in structure.children()]


def _digests(data: object) -> object:
    """Return static data with a digest in place of each array."""
    if isinstance(data, tuple):
        return tuple(map(_digests, data))
    if isinstance(data, Mapping):
        return {name: _digests(value) for name, value in data.items()}
    array = getattr(data, "array", data)  # MJX wraps static arrays of a model
    if isinstance(array, np.ndarray):
        return array.shape, str(array.dtype), hashlib.sha256(array.tobytes()).hexdigest()
    return data


def _decode(text: bytes) -> pytree.PyTreeDef:
    return jax.tree.structure(_from_json(json.loads(text)))


def _to_json(tree: object) -> object:
    if isinstance(tree, dict):
        return {key: _to_json(child) for key, child in tree.items()}
    if isinstance(tree, tuple):
        return [f"{type(tree).__module__}:{type(tree).__name__}", *map(_to_json, tree)]
    return tree


def _from_json(content: object) -> object:
    if isinstance(content, dict):
        return {key: _from_json(child) for key, child in content.items()}
    if isinstance(content, list):
        module, _, name = content[0].partition(":")
        kind, children = getattr(importlib.import_module(module), name), content[1:]
        return getattr(kind, "_make", kind)(map(_from_json, children))
    return content


def _compile_lowered(lowered: jax.stages.Lowered) -> jax.stages.Compiled:
    """Compile a lowered program; on a GPU, independent operations run concurrently."""
    if jax.default_backend() == "gpu":
        with contextlib.suppress(Exception):  # an XLA without this option
            return lowered.compile({"xla_gpu_command_buffer_scheduling_mode": "CONCURRENT"})
    program = lowered.compile()
    with contextlib.suppress(AttributeError, OSError, TypeError):  # a system without glibc
        ctypes.CDLL(None).malloc_trim(0)  # frees memory of the compiler, 0.8 GB
    return program


def identity(law: Law) -> str | None:
    """Return a text that identifies a law in all processes; None if there is none.

    It holds the names of the law's functions, at the top of modules of this package, and digests of
    bound arguments, as the weights of a network. The source of the package is a part of every key.
    """
    functions = law.init, law.step, *((law.is_done,) if law.is_done else ())
    names = list(map(_name_of, functions))
    if None in names:
        return None
    return repr((names, law.senses, law.heading, law.temperatures, law.smooth, law.cell))


def _name_of(function: object) -> object:
    if isinstance(function, functools.partial):
        name = _name_of(function.func)
        return name and (name, _digests(function.args), _digests(function.keywords))
    module, name = getattr(function, "__module__", ""), getattr(function, "__qualname__", "<")
    return f"{module}.{name}" if module.startswith("rps_jax.") and "<" not in name else None


@functools.cache
def _source_digest() -> str:
    """Return a digest of the source of this package and of the versions it depends on."""
    names = ("jax", "jaxlib", "numpy", "mujoco", "mujoco-mjx")
    versions = [metadata.version(name) for name in names]
    digest = hashlib.sha256(repr(versions).encode())
    root = Path(__file__).parents[1]
    for path in sorted([*root.rglob("*.py"), *root.rglob("*.[ch]")]):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _path_of(inputs: str) -> Path | None:
    """Return the file of a program by the text of its inputs; None if it cannot be cached.

    A text with an address in memory, or with a shortened array, does not identify its inputs.
    """
    folder = jax.config.jax_compilation_cache_dir
    if not folder or " at 0x" in inputs or "..." in inputs:
        return None
    device = jax.devices()[0]
    flags = [jax.config.jax_enable_x64, jax.config.jax_default_matmul_precision, native.target()]
    platform = [device.platform, device.device_kind, os.environ.get("XLA_FLAGS", ""), flags]
    key = hashlib.sha256(repr((_source_digest(), platform, inputs)).encode()).hexdigest()
    return Path(folder) / "traced" / key


def _read(path: Path, leaves: Sequence[Pytree]) -> tuple[pytree.PyTreeDef, export.Exported] | None:
    """Return a cached program and the structure of its results, if it fits these arguments."""

    def parse(body: bytes) -> tuple[pytree.PyTreeDef, export.Exported]:
        head, _, program = body.partition(b"\n")
        exported = export.deserialize(bytearray(program))
        if [(x.shape, x.dtype) for x in exported.in_avals] != [(x.shape, x.dtype) for x in leaves]:
            raise ValueError("it has other shapes")
        if not all(map(native.load, native.called_names(exported.mlir_module_serialized))):
            raise ValueError("it needs a compiled function that is missing")
        return _decode(head), exported

    return cache.read(path, "traced", parse)
