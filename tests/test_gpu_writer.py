"""CUDA gives the results of JAX, on an emulated warp."""

import ctypes
import functools
import re
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import output_of, refusing, row, slow
from numpy.testing import assert_allclose
from test_native import OPERATIONS, advanced, build_push, close, same

from rps_jax.geometry import vectors
from rps_jax.lowering import nvrtc
from rps_jax.lowering.gpu import GPU_HEADER, GpuWriter
from rps_jax.trials import trial
from rps_jax.world.domain import Range

COMPILER = shutil.which("g++")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no g++: apt install g++")
_RUN = """
static Arguments now;
static void one() {
  step(now);
  const int next = (threadIdx.x + 1) % 32;
  if (++ended == 32) setcontext(&caller);
  threadIdx.x = next;
  setcontext(&fibers[next]);
}
extern "C" void run(const Arguments *arguments, int blocks) {
  now = *arguments;
  for (blockIdx.x = 0; blockIdx.x < blocks; blockIdx.x++) {
    ended = 0;
    for (int i = 0; i < 32; i++) {
      getcontext(&fibers[i]);
      fibers[i].uc_stack.ss_sp = stacks[i];
      fibers[i].uc_stack.ss_size = sizeof stacks[i];
      makecontext(&fibers[i], one, 0);
      turns[i] = 0;
    }
    threadIdx.x = 0;
    swapcontext(&caller, &fibers[0]);
  }
}
"""


class Emulated:
    """A function of one world, compiled for the threads of an emulated warp."""

    def __init__(self, function, example, folder, threads):
        """Compile it; `example` are the arguments of one world."""
        leaves, self.tree = jax.tree.flatten(example)
        with vectors.trace_one_world():
            closed, computed = jax.make_jaxpr(function, return_shape=True)(*example)
        self.outs, self.structure = jax.tree.flatten(computed)
        self.threads, shapes = threads, [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves]
        self.text = GpuWriter(threads).source(closed, shapes, self.outs, True)
        source, binary = folder / "step.cpp", folder / "step.so"
        source.write_text(f'#include "{Path(__file__).with_name("warp.h")}"\n{self.text}{_RUN}')
        flags = ["-O0", "-march=native", "-w", "-shared", "-fPIC", "-Wl,-Bsymbolic"]
        output_of(COMPILER, *flags, source, "-o", binary)
        self.run = ctypes.CDLL(str(binary)).run

    def __call__(self, *arguments, order=None):
        """Return the results of a batch, whose worlds are computed in an order."""
        leaves = [np.ascontiguousarray(x) for x in jax.tree.leaves(arguments)]
        count = len(leaves[0])
        leaves.append(np.arange(count, dtype=np.int32) if order is None else np.int32(order))
        computed = [np.full((count, *x.shape), 77, x.dtype) for x in self.outs]
        pointers = [x.ctypes.data for x in (*leaves, *computed)]
        self.run(
            (ctypes.c_int64 * (len(pointers) + 1))(*pointers, count), -(-count * self.threads // 32)
        )
        return jax.tree.unflatten(self.structure, computed)


@pytest.mark.parametrize("threads", [1, 4, 32])
def test_operations_agree_with_jax(threads, tmp_path):
    def all_of(x):
        return [function(x) for function in OPERATIONS.values()]

    x = jnp.arange(19.0)
    run = Emulated(all_of, (x[0],), tmp_path, threads)
    computed, expected = run(x), jax.jit(jax.vmap(all_of))(x)
    for name, a, b in zip(OPERATIONS, computed, expected, strict=True):
        for actual, desired in zip(*map(jax.tree.leaves, (a, b)), strict=True):
            assert actual.dtype == desired.dtype
            assert_allclose(actual, desired, rtol=3e-6, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("reverse", [False, True])
def test_a_function_that_is_a_scan_is_a_loop_over_rows(reverse, tmp_path):
    def step(carry, row):
        x, count = carry
        return (row * jnp.cumsum(x)[::-1], count + 1), (x, count * row)

    scan = functools.partial(jax.lax.scan, step, reverse=reverse)
    x = jnp.linspace(-1, 1, 63).reshape(9, 7)
    inputs = (x, jnp.arange(9)), x[:, :3]
    run = Emulated(scan, jax.tree.map(lambda a: a[0], inputs), tmp_path, 4)
    assert "count < 3" in run.text
    jax.tree.map(assert_allclose, run(*inputs), jax.vmap(scan)(*inputs))


def test_tables_hold_numbers_that_are_not_finite(monkeypatch):
    """CUDA's compiler computes no function for a table, and its 0.0f / 0.0f is negative there."""
    words = dict(re.findall(r"#define (INFINITY|NAN) (.*?)(?: /\*|$)", GPU_HEADER, re.M))
    cast = "__builtin_bit_cast(float, 0x7fc00000)"
    assert words == {"INFINITY": "(1.0f / 0.0f)", "NAN": cast}
    if nvrtc._library() is None:
        pytest.skip("there is no NVRTC: pip install 'jax[cuda12]'")
    monkeypatch.setattr(nvrtc, "target", lambda: "sm_90")
    table = jnp.array([1.0, jnp.inf, -jnp.inf, jnp.nan])
    closed = jax.make_jaxpr(lambda i: table[i])(0)
    index = jax.ShapeDtypeStruct((), jnp.int32)
    text = GpuWriter(4).source(closed, [index], closed.out_avals, True)
    assert nvrtc.images([text])


PAIRS = [
    ("cylinder", "capacitive"),
    slow("box", "capacitive"),
    slow("cylinder", "ideal"),
    slow("prism", "ideal"),
]


@pytest.mark.parametrize(("shape", "skin"), PAIRS)
def test_a_control_step_is_the_processors(shape, skin, tmp_path):
    """This holds for any combination of worlds in a warp. Wheels slip, by axis.

    Bases have a limited force, objects have feet, and the law senses the contact force.
    """
    drawn = {"robot_slip_sideways": Range(0, 0.3), "robot_slip_yaw": Range(0, 0.5)}
    drawn |= {"domain": "real", "feet": Range(0.3, 1.0), "law": "force_push_published"}
    stage, inputs, loop, pushing = build_push(shape, skin, **drawn)
    force = np.linalg.norm(pushing.load.wrench[:, :2], axis=1)  # [N]
    assert np.mean(force > 1) > 0.5

    def world_step(world, params, state):
        return trial.control_step(stage, world, params, state, loop, lambda f, *_: f)[0]

    example = row(jax.tree.map(jnp.asarray, (*inputs, pushing)), 0)
    run = Emulated(world_step, example, tmp_path, 4)
    computed = run(*inputs, pushing)
    expected = advanced(stage, inputs, pushing, loop, 1)
    close(computed, expected, warm=4e-3, rest=1e-4)
    same(computed, run(*inputs, pushing, order=np.roll(np.arange(21)[::-1], 5)))


def test_shared_memory_is_bounded(tmp_path):
    """A block has 48 KiB: larger functions are refused, and XLA compiles them."""

    def world_step(x):
        return jax.lax.dynamic_slice(x * jnp.arange(3000.0), (x.astype(int),), (2,))

    with refusing("exceed the shared memory"):
        Emulated(world_step, (jnp.float32(1.0),), tmp_path, 4)
