"""What is written for the threads of a GPU is what JAX says, on an emulated warp."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_native import OPERATIONS, advanced, close, in_a_push, same

from rps_jax.engines.base import ControlPeriod
from rps_jax.errors import InputError
from rps_jax.geometry import vectors
from rps_jax.lowering import gpu_writer
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
extern "C" void run(const Arguments *given, int blocks) {
  now = *given;
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
    """A function of one world, for some threads of a warp."""

    def __init__(self, function, like, folder, each):
        """`like` are the arguments of one world."""
        leaves, self.tree = jax.tree.flatten(like)
        with vectors.reductions_in_one():
            closed, found = jax.make_jaxpr(function, return_shape=True)(*like)
        self.outs, self.structure = jax.tree.flatten(found)
        self.each, shapes = each, [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves]
        self.text = gpu_writer.source(closed, shapes, self.outs, True, each)
        source, binary = folder / "step.cpp", folder / "step.so"
        source.write_text(f'#include "{Path(__file__).with_name("warp.h")}"\n{self.text}{_RUN}')
        flags = ["-O1", "-march=native", "-w", "-shared", "-fPIC", "-Wl,-Bsymbolic"]
        subprocess.run([COMPILER, *flags, str(source), "-o", str(binary)], check=True)
        self.run = ctypes.CDLL(str(binary)).run

    def __call__(self, *arguments, order=None):
        """Results of a batch; `order` says which worlds come first."""
        leaves = [np.ascontiguousarray(x) for x in jax.tree.leaves(arguments)]
        count = len(leaves[0])
        leaves.append(np.arange(count, dtype=np.int32) if order is None else np.int32(order))
        found = [np.full((count, *x.shape), 77, x.dtype) for x in self.outs]
        places = [x.ctypes.data for x in (*leaves, *found)]
        self.run((ctypes.c_int64 * (len(places) + 1))(*places, count), -(-count * self.each // 32))
        return jax.tree.unflatten(self.structure, found)


@pytest.mark.parametrize("each", [1, 4, 32])
def test_operations_are_what_jax_says(each, tmp_path):
    def all_of(x):
        return [function(x) for function in OPERATIONS.values()]

    x = jnp.arange(19.0)
    run = Emulated(all_of, (x[0],), tmp_path, each)
    found, expected = run(x), jax.jit(jax.vmap(all_of))(x)
    for name, a, b in zip(OPERATIONS, found, expected, strict=True):
        for one, other in zip(*map(jax.tree.leaves, (a, b)), strict=True):
            assert one.dtype == other.dtype
            np.testing.assert_allclose(one, other, rtol=3e-6, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("skin", ["capacitive", "ideal"])
@pytest.mark.parametrize("shape", ["box", "cylinder", "prism"])
def test_a_control_step_is_the_processors(shape, skin, tmp_path):
    """Whichever worlds a warp has side by side."""
    stage, inputs, loop, pushing = in_a_push(shape, skin)

    def one(world, params, now):
        return trial.control_step(stage, world, params, now, loop, lambda f, *_: f)[0]

    like = jax.tree.map(lambda x: jnp.asarray(x)[0], (*inputs, pushing))
    run = Emulated(one, like, tmp_path, 4)
    found = run(*inputs, pushing)
    expected = advanced(stage, inputs, pushing, loop, 1)
    close(found, expected, warm=4e-3, rest=1e-4)
    same(found, run(*inputs, pushing, order=np.roll(np.arange(21)[::-1], 5)))


def test_a_control_period_is_the_processors(tmp_path):
    """Of bases whose force is limited, before objects on feet; and what they feel."""
    stage, (worlds, _), loop, trials = in_a_push("prism", domain="real", feet=Range(0.3, 1.0))
    pushing = trial.motion(trials)
    twists = trial.Twist(*(np.full(21, x, np.float32) for x in (0.05, 0.01, 0.05)))

    def one(fields, motion, twist, robot):
        return stage.drive(fields, motion, ControlPeriod(twist, loop.physics, robot, True))

    given = worlds.fields, pushing, twists, trial.pushing(worlds)
    run = Emulated(one, jax.tree.map(lambda x: jnp.asarray(x)[0], given), tmp_path, 4)
    found, expected = run(*given), jax.jit(one)(*given)
    assert np.mean(np.linalg.norm(expected.force[:, :2], axis=1) > 1) > 0.5  # [N]
    np.testing.assert_allclose(found.force, expected.force, rtol=1e-3, atol=2e-2)
    np.testing.assert_allclose(found.motion.qpos, expected.motion.qpos, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found.motion.qvel, expected.motion.qvel, rtol=1e-3, atol=1e-4)


def test_what_threads_share_has_an_end(tmp_path):
    """48 KiB of a block: more is refused, and XLA compiles."""

    def one(x):
        return jax.lax.dynamic_slice(x * jnp.arange(3000.0), (x.astype(int),), (2,))

    with pytest.raises(InputError, match="exceed the shared memory"):
        Emulated(one, (jnp.float32(1.0),), tmp_path, 4)
