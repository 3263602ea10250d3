"""Functions of one world, compiled for the lanes of a processor or the threads of a GPU.

XLA begins every operation on a few worlds anew, which takes longer than the operation. Here the
same source, as a jaxpr, is one function: see `nodes`; `writer` writes it in C, `threads` in CUDA,
which `cuda` has compiled. It is kept in the program cache, under a key of its text, the compiler
and the device, and verified before it is used. Where there is no compiler, in double precision, and
where a function is differentiated, XLA compiles it, as it does with the device `xla`.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import math
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
from rps_jax.geometry import vectors
from rps_jax.lowering import gpu_writer, nvrtc, writer
from rps_jax.lowering.walk import TooLargeError, UnsupportedError
from rps_jax.record import cache

# A sum is fused with the product before it, as XLA does; nothing else is taken for something else.
_FLAGS = ("-O2", "-march=native", "-fno-math-errno", "-ffp-contract=fast", "-w")
_NAME = "rps_native_"
_THREADS = 4  # of a GPU that hold a world
_LACKING = "a C compiler (apt install gcc) or NVRTC (pip install nvidia-cuda-nvrtc) is not here"
_PLATFORMS = {"cpu": "cpu", "gpu": "CUDA"}
_OF_ONE: ContextVar[bool] = ContextVar("rps_jax_of_one_world", default=False)
_warned: set[str] = set()
_loaded: dict[str, Any] = {}
_locks: defaultdict[str, threading.RLock] = defaultdict(threading.RLock)


def is_available() -> bool:
    """Whether functions are compiled here, and not within one that is.

    Warns if a GPU does without, which nobody has asked for.
    """
    if jax.config.jax_enable_x64 or _OF_ONE.get():
        return False
    found, asked = target(), os.environ.get("RPS_COMPILER")
    if found is None and asked != "none" and jax.default_backend() == "gpu":
        warnings.warn(f"{_LACKING}, so XLA compiles, which is much slower", stacklevel=2)
    return found is not None


@functools.cache
def _macros(compiler: str) -> str | None:
    """Digest of all that a compiler says of itself and of this processor; None: it does not."""
    words = [compiler, *_FLAGS, "-dM", "-E", "-x", "c", os.devnull]
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        said = subprocess.run(words, capture_output=True, check=True, timeout=60).stdout
        return hashlib.sha256(said).hexdigest()
    return None


def target() -> str | None:
    """What tells compilers and devices apart that functions are compiled by and for, if any."""
    if (compiler := device.find_compiler()) is None or (macros := _macros(compiler)) is None:
        return None
    if jax.default_backend() == "cpu":
        return macros
    return (found := nvrtc.target()) and f"{macros} {found}"


def batched(one: Callable[..., Any], whole: Callable[..., Any]) -> Callable[..., Any]:
    """A function of a batch of worlds (B, ...), world by world.

    Args:
      one: the function of one world; pure.
      whole: the same of a batch, which XLA compiles where `one` is not compiled here.
    """
    run = concurrent([one], lambda given: [whole(*given)])
    return lambda *arguments: run(arguments)[0]


def concurrent(
    ones: Sequence[Callable[..., Any]],
    whole: Callable[..., Any],
    sort_by: Callable[..., Any] | None = None,
) -> Any:
    """Functions of batches of worlds, one of each, which a GPU runs at the same time.

    Args:
      ones: the functions of one world; pure.
      whole: of a tuple of arguments for each of them, all their results; XLA compiles it where
        `ones` are not compiled here.
      sort_by: of a batch's arguments, numbers (B,) by which worlds are sorted, so that alike ones
        are computed side by side. No result depends on it, only how long they take.
    """
    if not is_available():
        return whole

    @jax.custom_jvp
    def run(*arguments: Any) -> list[Any]:
        every = [_Function(*each, sort_by) for each in zip(ones, arguments, strict=True)]
        calls = [every] if jax.default_backend() == "gpu" else [[each] for each in every]
        names = [_made(call) for call in calls]
        if None in names:
            return list(whole(*arguments))
        found: list[Any] = []
        for call, name in zip(calls, names, strict=True):
            shapes = [x for each in call for x in each.shapes]
            given = [x for each in call for x in each.leaves]
            called = jax.ffi.ffi_call(str(name), shapes, vmap_method="broadcast_all")
            results = iter(called(*given))
            found += [
                jax.tree.unflatten(each.structure, [next(results) for _ in each.results])
                for each in call
            ]
        return found

    run.defjvp(lambda primals, tangents: jax.jvp(lambda *x: list(whole(*x)), primals, tangents))
    return run


class _Function:
    """A function of one world as a jaxpr, and what a batch of worlds gives it."""

    def __init__(self, one: Callable[..., Any], arguments: Any, sort_by: Any) -> None:
        self.leaves, tree = jax.tree.flatten(jax.tree.map(jnp.asarray, arguments))
        self.given = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in self.leaves]
        token = _OF_ONE.set(True)
        try:
            with vectors.reductions_in_one():
                self.jaxpr, out = jax.make_jaxpr(one, return_shape=True)(
                    *jax.tree.unflatten(tree, self.given)
                )
        finally:
            _OF_ONE.reset(token)
        self.results, self.structure = jax.tree.flatten(out)
        count, self.ordered = len(self.leaves[0]), sort_by is not None
        if sort_by is not None:
            self.leaves.append(jnp.argsort(sort_by(*arguments)).astype(jnp.int32))
        self.shapes = [jax.ShapeDtypeStruct((count, *x.shape), x.dtype) for x in self.results]


def _made(functions: Sequence[_Function]) -> str | None:
    """The name under which XLA knows functions; None if they cannot be compiled here."""
    on_gpu = jax.default_backend() == "gpu"
    write = functools.partial(gpu_writer.source, threads=_THREADS) if on_gpu else writer.source
    try:
        with jax.ensure_compile_time_eval():
            texts = [write(x.jaxpr, x.given, x.results, x.ordered) for x in functions]
    except UnsupportedError as error:
        _warn_once(
            f"{str(error).rstrip('.')}. XLA compiles this law, which is some ten times slower"
        )
        return None
    except (TooLargeError, jax.errors.TracerArrayConversionError):
        return None  # XLA is faster, or the law holds a value that is being traced
    except Exception as error:  # of a version of JAX that writes its operations otherwise
        said = f"{type(error).__name__}: {error}"
        warnings.warn(f"no C can be written, so XLA compiles: {said}", stacklevel=2)
        return None
    key = repr((texts, on_gpu and (nvrtc.LAUNCH, nvrtc.FLAGS), target(), jax.__version__))
    name = _NAME + hashlib.sha256(key.encode()).hexdigest()[:32]
    with _locks[name]:
        if load(name):
            return name
        try:
            body = _launching(name, texts, functions) if on_gpu else _binary(
                texts[0].replace(writer.HANDLER, name), name)  # fmt: skip
        except RuntimeError as error:
            what, why = error.args
            warnings.warn(f"{what} fails, so XLA compiles: {why}", stacklevel=2)
            return None
        cache.write(_place(name), body)
        _register(name, body)
    return name


def _warn_once(message: str) -> None:
    """Warn of a slow program, once in a process."""
    if message not in _warned:
        _warned.add(message)
        warnings.warn(message, stacklevel=2)


def _binary(text: str, name: str) -> bytes:
    """A library of a text of C.

    Raises:
      RuntimeError: the compiler, which fails, and why.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, binary = Path(folder) / f"{name}.c", Path(folder) / f"{name}.so"
        source.write_text(text)
        words = [str(device.find_compiler()), *_FLAGS, "-shared", "-fPIC"]
        words += [f"-I{jax.ffi.include_dir()}", str(source), "-o", str(binary), "-lm", "-ldl"]
        done = subprocess.run(words, capture_output=True, text=True)
        if done.returncode:
            said = [*done.stderr.splitlines(), "it does not say why"]
            raise RuntimeError(words[0], said[0])
        return binary.read_bytes()


def _launching(name: str, texts: Sequence[str], functions: Sequence[_Function]) -> bytes:
    """A library of kernels and of the function that launches them.

    Raises:
      RuntimeError: the compiler that fails, and why.
    """
    shapes = []
    for each in functions:
        one, size = next((i, n) for i, x in enumerate(each.given) if (n := math.prod(x.shape)))
        shapes.append((len(each.leaves), len(each.results), one, size))
    with tempfile.TemporaryDirectory() as folder:
        codes = [Path(folder) / f"{k}.cubin" for k in range(len(texts))]
        for code, image in zip(codes, nvrtc.images(texts), strict=True):
            code.write_bytes(image)
        return _binary(nvrtc.launcher(name, codes, shapes, gpu_writer.WARP // _THREADS), name)


def loaded_names() -> list[str]:
    """Names of all functions that XLA knows by now."""
    return list(_loaded)


def called_names(program: bytes) -> list[str]:
    """Names of the functions that a program calls."""
    return sorted({x.decode() for x in re.findall(rf"{_NAME}[0-9a-f]{{32}}".encode(), program)})


def load(name: str) -> bool:
    """Have XLA know a function that was kept, if it is whole."""
    with _locks[name]:
        place = _place(name)
        if name in _loaded or place is None:
            return name in _loaded
        return bool(cache.read(place, "compiled", functools.partial(_register, name)))


def _place(name: str) -> Path | None:
    """Where a compiled function is kept; None if nowhere."""
    folder = jax.config.jax_compilation_cache_dir
    return Path(folder) / "native" / name if folder else None


def _register(name: str, body: bytes) -> bool:
    with tempfile.TemporaryDirectory() as folder:
        binary = Path(folder) / f"{name}.so"
        binary.write_bytes(body)
        library = ctypes.CDLL(str(binary))
    function = jax.ffi.pycapsule(getattr(library, name))
    jax.ffi.register_ffi_target(name, function, platform=_PLATFORMS[jax.default_backend()])
    _loaded[name] = library
    return True
