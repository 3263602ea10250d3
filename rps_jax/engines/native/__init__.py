"""Functions of one world, compiled by the C compiler of this machine for the lanes of a processor.

XLA begins every operation on a few worlds anew, which takes longer than the operation. Here the
same source, as a jaxpr, is one function of C: see `nodes`. It is kept in the program cache, under a
key of its text, the compiler and the processor, and verified before it is used. Where there is no
compiler, in double precision, and where a function is differentiated, XLA compiles it, as it does
with the device `xla`.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import re
import subprocess
import tempfile
import threading
import warnings
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from rps_jax.engines import device
from rps_jax.engines.native import writer
from rps_jax.errors import InputError
from rps_jax.geometry import vectors
from rps_jax.record import provenance

# A sum is fused with the product before it, as XLA does; nothing else is taken for something else.
_FLAGS = ("-O2", "-march=native", "-fno-math-errno", "-ffp-contract=fast", "-w")
_NAME = "rps_lanes_"
_OF_ONE: ContextVar[bool] = ContextVar("rps_jax_of_one_world", default=False)
_loaded: dict[str, Any] = {}
_locks: defaultdict[str, threading.RLock] = defaultdict(threading.RLock)


def usable() -> bool:
    """Whether functions are compiled here, and not within one that is."""
    return not jax.config.jax_enable_x64 and not _OF_ONE.get() and target() is not None


@functools.cache
def _macros(compiler: str) -> str | None:
    """Digest of all that a compiler says of itself and of this processor; None: it does not."""
    words = [compiler, *_FLAGS, "-dM", "-E", "-x", "c", os.devnull]
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        said = subprocess.run(words, capture_output=True, check=True, timeout=60).stdout
        return hashlib.sha256(said).hexdigest()
    return None


def target() -> str | None:
    """What tells compilers and processors apart that functions are compiled by and for, if any."""
    compiler = provenance.compiler() if jax.default_backend() == "cpu" else None
    return None if compiler is None else _macros(compiler)


def mapped(one: Callable[..., Any], whole: Callable[..., Any]) -> Callable[..., Any]:
    """A function of a batch of worlds (B, ...), world by world.

    Args:
      one: the function of one world; pure.
      whole: the same of a batch, which XLA compiles where `one` is not compiled here.
    """
    if not usable():
        return whole

    @jax.custom_jvp
    def run(*arguments: Any) -> Any:
        leaves, tree = jax.tree.flatten(jax.tree.map(jnp.asarray, arguments))
        given = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in leaves]
        token = _OF_ONE.set(True)
        try:
            with vectors.reductions_in_one():
                closed, out = jax.make_jaxpr(one, return_shape=True)(
                    *jax.tree.unflatten(tree, given)
                )
        finally:
            _OF_ONE.reset(token)
        results, structure = jax.tree.flatten(out)
        name = _made(closed, given, results)
        if name is None:
            return whole(*arguments)
        shapes = [jax.ShapeDtypeStruct((len(leaves[0]), *x.shape), x.dtype) for x in results]
        found = jax.ffi.ffi_call(name, shapes, vmap_method="broadcast_all")(*leaves)
        return jax.tree.unflatten(structure, found)

    run.defjvp(lambda primals, tangents: jax.jvp(whole, primals, tangents))
    return run


def _made(closed: Any, given: Sequence[Any], found: Sequence[Any]) -> str | None:
    """The name under which XLA knows a function; None if it cannot be compiled here."""
    try:
        with jax.ensure_compile_time_eval():
            text = writer.source(closed, given, found)
    except (InputError, jax.errors.TracerArrayConversionError):
        return None  # a law has an operation without a form in C, or holds what is being traced
    except Exception as error:  # of a version of JAX that writes its operations otherwise
        said = f"{type(error).__name__}: {error}"
        warnings.warn(f"no C can be written, so XLA compiles: {said}", stacklevel=2)
        return None
    key = repr((text, target(), jax.__version__))
    name = _NAME + hashlib.sha256(key.encode()).hexdigest()[:32]
    with _locks[name]:
        if load(name):
            return name
        with tempfile.TemporaryDirectory() as folder:
            source, binary = Path(folder) / f"{name}.c", Path(folder) / f"{name}.so"
            source.write_text(text.replace(writer.HANDLER, name))
            words = [str(provenance.compiler()), *_FLAGS, "-shared", "-fPIC"]
            words += [f"-I{jax.ffi.include_dir()}", str(source), "-o", str(binary), "-lm"]
            done = subprocess.run(words, capture_output=True, text=True)
            if done.returncode:
                said = [*done.stderr.splitlines(), "it does not say why"]
                warnings.warn(f"{words[0]} fails, so XLA compiles: {said[0]}", stacklevel=2)
                return None
            body = binary.read_bytes()
        device.keep(_place(name), body)
        _register(name, body)
    return name


def known() -> list[str]:
    """Names of all functions that XLA knows by now."""
    return list(_loaded)


def needed(program: bytes) -> list[str]:
    """Names of the functions that a program calls."""
    return sorted({x.decode() for x in re.findall(rf"{_NAME}[0-9a-f]{{32}}".encode(), program)})


def load(name: str) -> bool:
    """Have XLA know a function that was kept, if it is whole."""
    with _locks[name]:
        place = _place(name)
        if name in _loaded or place is None:
            return name in _loaded
        return bool(device.kept(place, "compiled", functools.partial(_register, name)))


def _place(name: str) -> Path | None:
    """Where a compiled function is kept; None if nowhere."""
    folder = jax.config.jax_compilation_cache_dir
    return Path(folder) / "native" / name if folder else None


def _register(name: str, body: bytes) -> bool:
    with tempfile.TemporaryDirectory() as folder:
        binary = Path(folder) / f"{name}.so"
        binary.write_bytes(body)
        library = ctypes.CDLL(str(binary))
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(getattr(library, name)), platform="cpu")
    _loaded[name] = library
    return True
