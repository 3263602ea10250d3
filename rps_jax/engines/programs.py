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
import os
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
from jax import export

from rps_jax.control.base import Law
from rps_jax.engines import device, native


def compiled(
    function: Callable[..., Any],
    arguments: Sequence[Any],
    result: Any,
    *,
    donate: int,
    static: Sequence[Any],
) -> Callable[..., Any]:
    """Compile a function for arguments of these shapes, from what was kept of it if there is.

    Args:
      function: pure; it may depend on nothing but its arguments and `static`.
      arguments: pytrees of `jax.ShapeDtypeStruct`.
      result: a pytree with the structure of what the function returns.
      donate: position of the argument whose memory may be used again.
      static: what else it depends on; each with a `repr` that says all of it.

    Returns:
      The compiled function. It is the same program whether it was kept or not.
    """
    leaves, tree = jax.tree.flatten(tuple(arguments))
    sizes = [jax.tree.structure(one).num_leaves for one in arguments]
    first = sum(sizes[:donate])
    donated = tuple(range(first, first + sizes[donate]))

    def flat(*given: Any) -> list[Any]:
        return jax.tree.leaves(function(*jax.tree.unflatten(tree, given)))

    place = _place(repr((str(tree), [(x.shape, str(x.dtype)) for x in leaves], donated, static)))
    exported = None if place is None else _read(place, leaves)
    if exported is None:
        jitted = jax.jit(flat, donate_argnums=donated)
        jitted.trace(*leaves)  # in which functions are compiled that it calls
        safe = list(map(export.DisabledSafetyCheck.custom_call, native.known()))
        exported = export.export(jitted, disabled_checks=safe)(*leaves)
        with contextlib.suppress(ValueError):  # what cannot be kept
            device.keep(place, bytes(exported.serialize()))
    program = built(jax.jit(exported.call, donate_argnums=donated).lower(*leaves))
    outcome = jax.tree.structure(result)
    return lambda *given: jax.tree.unflatten(outcome, program(*jax.tree.leaves(given)))


def built(lowered: Any) -> Any:
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

    A law of this package whose functions stand at the top of their modules is said by their names;
    its source is a part of every key.
    """
    names = []
    for function in (law.init, law.step):
        module, name = getattr(function, "__module__", ""), getattr(function, "__qualname__", "<")
        if not module.startswith("rps_jax.") or "<" in name:
            return None
        names.append(f"{module}.{name}")
    return repr((names, law.senses, law.temperatures, law.smooth, law.cell))


@functools.cache
def _source() -> str:
    """Digest of this package's source and of the versions that make a program of it."""
    versions = [metadata.version(name) for name in ("jax", "jaxlib", "numpy")]
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


def _read(path: Path, leaves: Sequence[Any]) -> export.Exported | None:
    """A program that was kept, if it is whole and of these arguments."""

    def told(body: bytes) -> export.Exported:
        found = export.deserialize(bytearray(body))
        if [(x.shape, x.dtype) for x in found.in_avals] != [(x.shape, x.dtype) for x in leaves]:
            raise ValueError("it is of other shapes")
        if not all(map(native.load, native.needed(found.mlir_module_serialized))):
            raise ValueError("it needs a compiled function that is not there")
        return found

    return device.kept(path, "traced", told)
