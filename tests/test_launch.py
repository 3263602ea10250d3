"""Kernels are launched concurrently on separate streams, with a fake driver that logs its calls."""

import ctypes
import json
import os
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers import output_of
from numpy.testing import assert_array_equal

from rps_jax.engines import device, native
from rps_jax.lowering import nvrtc

COMPILER = device.find_compiler()
pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler: apt install gcc")
NAME = "rps_native_launched"
# A separate process has no other driver. One kernel has two worlds, the other has twenty.
RUN = """
import ctypes, json, sys
import numpy as np
folder, fails, library = sys.argv[1:]
driver = ctypes.CDLL(f"{folder}/libcuda.so.1")
launcher = ctypes.CDLL(f"{folder}/{library}.so")
worlds = np.array([2, 20])
arrays = [x for n in worlds for x in (np.arange(n, dtype=np.float32), np.arange(n),
                                      np.zeros(n, np.float32))]
pointers = (ctypes.c_void_p * 6)(*(x.ctypes.data for x in arrays))
driver.call.restype = driver.said.restype = ctypes.c_char_p
handler = getattr(launcher, "rps_native_launched")
calls = []
for _ in range(2):
    error = driver.call(handler, pointers, ctypes.c_void_p(worlds.ctypes.data), fails.encode())
    calls.append([error.decode(), driver.said().decode().splitlines()])
print(json.dumps([calls, arrays[2].tolist(), arrays[5].tolist(), driver.traits_of(handler)]))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The driver, and the launcher of kernels that are single digits."""
    folder = tmp_path_factory.mktemp("launch")
    codes = []
    for digit in "35":
        codes.append(folder / f"{digit}.cubin")
        codes[-1].write_text(digit)
    for library, count in (("launcher", 2), ("single", 1)):
        text = nvrtc.launcher(
            NAME, codes[:count], [(2, 1, 0, 1, 100), (2, 1, 0, 1, 200)][:count], worlds=8
        )
        (folder / f"{library}.so").write_bytes(native._library(text, NAME))
    words = [str(COMPILER), "-O1", "-w", "-shared", "-fPIC", "-Wl,-soname,libcuda.so.1"]
    words += [f"-I{jax.ffi.include_dir()}", str(Path(__file__).with_name("launch.c"))]
    output_of(*words, "-o", folder / "libcuda.so.1")
    return folder


def launched(folder, fails="nothing", library="launcher"):
    """Return errors and driver logs of two calls, the results of both kernels, and the traits."""
    environment = os.environ | {"LD_LIBRARY_PATH": str(folder)}
    words = sys.executable, "-c", RUN, folder, fails, library
    return json.loads(output_of(*words, env=environment))


def test_kernels_run_concurrently_and_later_work_waits_for_all(folder):
    ((error, first), (_, second)), *results, traits = launched(folder)
    assert (error, traits) == ("", 0)
    assert_array_equal(results[0], 3 * np.arange(2))
    assert_array_equal(results[1], 5 * np.arange(20))
    loaded = ["mode 2", "load 3", "kernel step", *["shared 400 of 3"] * 2]
    loaded += ["load 5", "kernel step", *["shared 400 of 5"] * 2, "mode 1"]
    assert first == [
        *loaded,
        "context",
        "push 7",
        "mode 2",
        "event 201",
        "record 201 on 7",
        "launch 3 on 7: 1 of 32, 100",  # 8 worlds in a warp of 32 threads
        # Earlier work of XLA's stream comes first.
        "stream 101",
        "event 202",
        "await 201 on 101",
        "launch 5 on 101: 2 of 64, 400",  # 20 worlds in 3 warps, of which 2 share a block
        "record 202 on 101",
        "await 202 on 7",
        "end event 202",
        "end stream 101",
        "end event 201",
        "mode 1",
        "pop",
    ]
    assert [line.split()[0] for line in second] == [line.split()[0] for line in first[10:]]


def test_a_single_kernel_can_be_captured_in_a_cuda_graph(folder):
    """Its call is one launch; the driver also loads kernels while a stream is captured."""
    ((error, first), (_, second)), result, _, traits = launched(folder, library="single")
    assert (error, traits) == ("", 1)
    assert_array_equal(result, 3 * np.arange(2))
    call = ["context", "push 7", "mode 2", "launch 3 on 7: 1 of 32, 100", "mode 1", "pop"]
    loaded = ["mode 2", "load 3", "kernel step", *["shared 400 of 3"] * 2, "mode 1"]
    assert first == [*loaded, *call]
    assert second == call


@pytest.mark.parametrize(
    ("fails", "error"),
    [
        ("load", "the GPU's driver cannot load a kernel"),
        ("context", "no GPU is available"),
        ("stream", "a kernel could not be launched"),
        ("event", "a kernel could not be launched"),
        ("launch", "a kernel could not be launched"),
    ],
)
def test_a_failure_is_reported_and_releases_resources(fails, error, folder):
    for message, notes in launched(folder, fails)[0]:
        assert message == error
        for kind in ("stream", "event"):
            created = sum(line.startswith(f"{kind} ") for line in notes)
            ended = sum(line.startswith(f"end {kind} ") for line in notes)
            assert created - ended == (fails == kind)  # a failed creation needs no release
        assert ("pop" in notes) == any(line.startswith("push") for line in notes)


def test_xla_accepts_the_version_of_the_interface(folder):
    """XLA refuses to register a function with another version."""
    function = getattr(ctypes.CDLL(str(folder / "launcher.so")), NAME)
    jax.ffi.register_ffi_target(NAME, jax.ffi.pycapsule(function), platform="cpu")
