"""Comparison of a custom law as the native compiler and as XLA compile it.

The tests compare the laws of the package. A custom law may use any operation of JAX, so a run
compares it once, before it starts, with the observations of bases that drive into the object.
"""

from __future__ import annotations

import functools
import itertools
import warnings
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.engines import native
from rps_jax.geometry.arrays import Pytree
from rps_jax.trials import trial
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Trial
from rps_jax.world.scene import JOINTS

if TYPE_CHECKING:
    from rps_jax.trials.worlds import WorldBatch

_WORLDS, _STEPS = 2, 150
_TOLERANCE = 1e-3  # of the largest number
_RARE = 0.02  # share of steps that may differ, since rounding can change a decision


def warn_of_difference(batch: WorldBatch, setting: Setting) -> None:
    """Warn if a custom law differs between the native compiler and XLA.

    It runs in the first worlds of a batch. The result is cached with the compiled law.
    """
    law, period = batch.law, setting.physics.control_period
    if not native.compiles(batch.stage):
        return
    worlds, params = jax.tree.map(lambda x: jnp.asarray(x[:_WORLDS]), batch.inputs)
    loop = ControlLoop(setting.physics, law=law)

    def step(*arguments: Pytree) -> Pytree:
        return law.step(*arguments)[:2]

    def turn(trials: Trial, _: None) -> tuple[Trial, Pytree]:
        """Run the law once, and move the bases on a curve, without physics."""
        axes = (0, 0, 0, None)
        judged, _measured, obs = jax.vmap(trial.perceive, axes)(worlds, params, trials, loop)
        arguments = params, judged.law_state, obs
        states, twists = jax.vmap(step)(*arguments)
        time = judged.steps * period
        curve = jnp.stack([0.05 + 0 * time, 0.02 * jnp.sin(3 * time), 0.1 * jnp.cos(2 * time)], -1)
        qpos = judged.qpos.at[:, JOINTS.base].add(period * curve)
        trials = judged._replace(qpos=qpos, steps=judged.steps + 1, law_state=states)
        return trials, (arguments, (states, twists))

    def run() -> Pytree:
        """Return arguments and results of the law in each control step (steps * worlds, ...)."""
        start = jax.vmap(functools.partial(trial.start, law=law))(worlds, params)
        records = jax.lax.scan(turn, start, length=_STEPS)[1]
        return jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), records)

    def compare() -> str:
        arguments, expected = jax.jit(run)()
        computed = jax.jit(native.batched(step, jax.vmap(step)))(*arguments)
        pairs = zip(*map(jax.tree.leaves, jax.device_get((computed, expected))), strict=True)
        share = np.mean(np.any([*itertools.starmap(_differs, pairs)], axis=0))
        return f"{share:.0%}" if share > _RARE else ""

    if share := native.compared(step, jax.eval_shape(run)[0], compare):
        warnings.warn(
            f"the law of {type(batch.params).__name__} gives other results as compiled code than "
            f"in JAX in {share} of control steps: set RPS_COMPILER=none, so that XLA compiles it, "
            "and report this law",
            stacklevel=2,
        )


def _differs(computed: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return in which control steps (B,) two results differ."""
    size = np.max(np.abs(expected), initial=0, where=np.isfinite(expected))
    equal = np.isclose(computed, expected, rtol=0, atol=_TOLERANCE * size, equal_nan=True)
    return np.any(~equal.reshape(len(equal), -1), axis=1)
