"""NVIDIA's run-time compiler of CUDA (NVRTC), and the C that launches its kernels from XLA."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib.util
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax

from rps_jax.lowering.graph import CompilerError
from rps_jax.lowering.operations import XLA_CALL

# Quotients and square roots within two roundings, and zero for numbers below 1e-38.
FLAGS = ("--prec-div=false", "--prec-sqrt=false", "--ftz=true")
LAUNCH = XLA_CALL + Path(__file__).with_name("launch.c").read_text()


@functools.cache
def _library() -> ctypes.CDLL | None:
    """Load NVRTC, which JAX for CUDA installs; None if it is missing."""
    package = importlib.util.find_spec("nvidia")
    folders = list(package.submodule_search_locations or ()) if package else []
    paths = [str(x) for path in folders for x in sorted(Path(path).glob("*/lib/libnvrtc.so.*"))]
    for path in (*paths, "libnvrtc.so.13", "libnvrtc.so.12"):
        with contextlib.suppress(OSError):
            return ctypes.CDLL(path)
    return None


@functools.cache
def target() -> str | None:
    """Return NVRTC's version and the GPU's architecture; None without NVRTC or GPU."""
    device = jax.devices()[0]
    if (library := _library()) is None or not hasattr(device, "compute_capability"):
        return None
    major, minor = ctypes.c_int(), ctypes.c_int()
    library.nvrtcVersion(ctypes.byref(major), ctypes.byref(minor))
    return f"{major.value}.{minor.value} sm_{device.compute_capability.replace('.', '')}"


def images(texts: Sequence[str]) -> list[bytes]:
    """Compile kernels in parallel, each text once, and return their machine code.

    Raises:
      CompilerError: NVRTC fails.
    """
    with ThreadPoolExecutor() as pool:
        compiled = {text: pool.submit(_image, text) for text in dict.fromkeys(texts)}
    return [compiled[text].result() for text in texts]


def _image(text: str) -> bytes:
    library, program = _library(), ctypes.c_void_p()
    if library is None:
        raise CompilerError("NVRTC", "it is not installed")
    flags = [*FLAGS, f"--gpu-architecture={str(target()).split()[-1]}"]
    options = (ctypes.c_char_p * len(flags))(*(x.encode() for x in flags))

    def output(name: str) -> bytes:
        size = ctypes.c_size_t()
        getattr(library, f"nvrtcGet{name}Size")(program, ctypes.byref(size))
        buffer = ctypes.create_string_buffer(size.value)
        getattr(library, f"nvrtcGet{name}")(program, buffer)
        return buffer.raw

    library.nvrtcCreateProgram(ctypes.byref(program), text.encode(), b"step.cu", 0, None, None)
    try:
        if library.nvrtcCompileProgram(program, len(flags), options):
            lines = [x for x in output("ProgramLog").decode().splitlines() if "error" in x]
            raise CompilerError("NVRTC", (lines or ["no message"])[0])
        return output("CUBIN")
    finally:
        library.nvrtcDestroyProgram(ctypes.byref(program))


def launcher(
    name: str, images: Sequence[Path], shapes: Sequence[tuple[int, ...]], worlds: int
) -> str:
    """Return the C of the function by which XLA launches kernels.

    Args:
      name: of the function.
      images: files of the kernels' machine code.
      shapes: for each kernel the number of its arguments and of its results, the index of an
        argument that has numbers, how many it has per world, and the bytes of shared memory
        of a warp.
      worlds: number of worlds of a warp.
    """
    counts = [", ".join(map(str, column)) for column in zip(*shapes, strict=True)]
    macros = {
        "NAME": name,
        "KERNELS": len(images),
        "IMAGES": ", ".join(f"image_{k}" for k in range(len(images))),
        **dict(zip(("INPUTS", "OUTPUTS", "SIZED", "SIZE", "SHARED"), counts, strict=True)),
        "MAX_POINTERS": max(a + b for a, b, *_ in shapes) + 1,
        "WORLDS": worlds,
    }
    lines = [f"#define {key} {value}" for key, value in macros.items()]
    for k, image in enumerate(images):
        section = f'.section .rodata\\n.balign 64\\nimage_{k}: .incbin \\"{image}\\"\\n.text'
        lines += [f'__asm__("{section}");', f"extern const char image_{k}[];"]
    return "\n".join([*lines, LAUNCH])
