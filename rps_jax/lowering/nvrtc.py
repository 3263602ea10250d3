"""Kernels for a GPU: compiled by NVIDIA's library, which JAX brings, and launched from C."""

from __future__ import annotations

import ctypes
import functools
import importlib.util
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax

from rps_jax.lowering.nodes import PRELUDE

# Quotients and roots to two roundings, and zero for what is less than 1e-38.
FLAGS = ("--prec-div=false", "--prec-sqrt=false", "--ftz=true")
LAUNCH = PRELUDE + Path(__file__).with_name("launch.c").read_text()


@functools.cache
def _library() -> Any:
    """NVIDIA's compiler as a library, which comes with JAX for CUDA; None if it is not there."""
    found = importlib.util.find_spec("nvidia")
    folders = list(found.submodule_search_locations or ()) if found else []
    places = [str(x) for one in folders for x in sorted(Path(one).glob("*/lib/libnvrtc.so.*"))]
    for place in (*places, "libnvrtc.so.13", "libnvrtc.so.12"):
        try:
            return ctypes.CDLL(place)
        except OSError:
            continue
    return None


@functools.cache
def target() -> str | None:
    """The compiler's version and the GPU it compiles for; None if there is no such compiler."""
    device = jax.devices()[0]
    if (library := _library()) is None or not hasattr(device, "compute_capability"):
        return None
    numbers = ctypes.c_int(), ctypes.c_int()
    library.nvrtcVersion(*map(ctypes.byref, numbers))
    major, minor = (x.value for x in numbers)
    return f"{major}.{minor} sm_{device.compute_capability.replace('.', '')}"


def images(texts: Sequence[str]) -> list[bytes]:
    """Machine code of kernels, each of its own text.

    Raises:
      RuntimeError: the compiler, which fails, and why.
    """
    with ThreadPoolExecutor(len(texts)) as pool:
        return list(pool.map(_image, texts))


def _image(text: str) -> bytes:
    library, program = _library(), ctypes.c_void_p()
    flags = [*FLAGS, f"--gpu-architecture={str(target()).split()[-1]}"]
    given = (ctypes.c_char_p * len(flags))(*(x.encode() for x in flags))

    def said(name: str) -> bytes:
        size = ctypes.c_size_t()
        getattr(library, f"nvrtcGet{name}Size")(program, ctypes.byref(size))
        room = ctypes.create_string_buffer(size.value)
        getattr(library, f"nvrtcGet{name}")(program, room)
        return room.raw

    library.nvrtcCreateProgram(ctypes.byref(program), text.encode(), b"step.cu", 0, None, None)
    try:
        if library.nvrtcCompileProgram(program, len(flags), given):
            lines = [x for x in said("ProgramLog").decode().splitlines() if "error" in x]
            raise RuntimeError("NVRTC", (lines or ["it does not say why"])[0])
        return said("CUBIN")
    finally:
        library.nvrtcDestroyProgram(ctypes.byref(program))


def launcher(
    name: str, codes: Sequence[Path], shapes: Sequence[tuple[int, int, int, int]], worlds: int
) -> str:
    """C of the function by which XLA launches kernels.

    Args:
      name: of the function.
      codes: files of the kernels' machine code.
      shapes: of each kernel the number of its arguments and results, and which argument tells the
        number of worlds, by how many numbers it has of each.
      worlds: that a block of threads holds.
    """
    counts = [", ".join(map(str, column)) for column in zip(*shapes, strict=True)]
    told = {
        "NAME": name,
        "KERNELS": len(codes),
        "IMAGES": ", ".join(f"image_{k}" for k in range(len(codes))),
        **dict(zip(("GIVEN", "FOUND", "ONE", "SIZE"), counts, strict=True)),
        "MOST": max(a + b for a, b, *_ in shapes) + 1,
        "WORLDS": worlds,
    }
    lines = [f"#define {key} {value}" for key, value in told.items()]
    for k, code in enumerate(codes):
        place = f'.section .rodata\\n.balign 64\\nimage_{k}: .incbin \\"{code}\\"\\n.text'
        lines += [f'__asm__("{place}");', f"extern const char image_{k}[];"]
    return "\n".join([*lines, LAUNCH])
