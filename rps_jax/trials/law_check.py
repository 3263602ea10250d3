"""Comparison of a custom law as the native compiler and as XLA compile it.

The tests compare the laws of the package. A custom law may use any operation of JAX, so a run
compares it once, before it starts, with the observations of a base that drives into the object.
"""

from __future__ import annotations

import functools
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.control.base import Law, LawParams
from rps_jax.control.laws import rps
from rps_jax.engines import native, programs
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Float
from rps_jax.trials import trial
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Trial, World
from rps_jax.world.scene import JOINTS

_WORLDS, _STEPS = 2, 150
_TOLERANCE = 1e-3  # of the largest number
_RARE = 0.02  # share of steps that may differ, since rounding can change a decision


def warn_of_difference(
    stage: Any, worlds: World, params: LawParams, law: Law, setting: Setting
) -> None:
    """Warn if a custom law differs between the native compiler and XLA.

    It runs in the first worlds of a batch.
    """
    is_native = getattr(stage, "native", False) and native.is_available()
    if not is_native or programs.identity(law) is not None:
        return
    # Laws with equal observations share one program.
    sensing = Law(_no_state, rps.LAW.step, law.senses, smooth=law.smooth, cell=law.cell)
    loop = ControlLoop(setting.physics, setting.rules, sensing)
    few, params = jax.tree.map(lambda x: jnp.asarray(x[:_WORLDS]), (worlds, params))
    observed = functools.partial(_observe, few, params, loop)
    run = functools.partial(_run, law, params)
    types, _ = jax.eval_shape(lambda: run(observed()))

    def step(*arguments: Any) -> Any:
        return law.step(*arguments)[:2]

    def compare() -> str:
        arguments, expected = jax.jit(run)(observed())
        computed = jax.jit(native.batched(step, jax.vmap(step)))(*arguments)
        pairs = zip(*map(jax.tree.leaves, jax.device_get((computed, expected))), strict=True)
        differs = functools.reduce(np.logical_or, (_differs(a, b) for a, b in pairs))
        return f"{differs.sum()} of {differs.size}" if differs.mean() > _RARE else ""

    if count := native.compared(step, types, compare):
        warnings.warn(
            f"the law of {type(params).__name__} gives other results in compiled C than in JAX, in "
            f"{count} control steps: set RPS_COMPILER=none, so that XLA compiles it, and report "
            "this law",
            stacklevel=2,
        )


def _no_state(_: LawParams) -> tuple[()]:
    return ()


@jax.jit
def _observe(worlds: World, params: LawParams, loop: ControlLoop) -> Any:
    """Return the observations (steps, B, ...) of bases that move on a curve, without physics."""

    def move(qpos: Float[Array, "10"], time: Array) -> Array:
        """Move a base by one control period."""
        forward = planar.rotate(qpos[2], jnp.stack([0.05, 0.02 * jnp.sin(3 * time)]))
        velocity = jnp.stack([*forward, 0.1 * jnp.cos(2 * time)])
        return qpos.at[JOINTS.base].add(loop.physics.control_period * velocity)

    def turn(trials: Trial, _: None) -> tuple[Trial, Any]:
        judged, _, obs = jax.vmap(trial.perceive, (0, 0, 0, None))(worlds, params, trials, loop)
        time = trials.steps * loop.physics.control_period
        moved = judged._replace(qpos=jax.vmap(move)(judged.qpos, time), steps=judged.steps + 1)
        return moved, obs

    start = jax.vmap(functools.partial(trial.start, law=loop.law))(worlds, params)
    return jax.lax.scan(turn, start, length=_STEPS)[1]


def _run(law: Law, params: LawParams, obs: Any) -> tuple[Any, Any]:
    """Return arguments and results of a law in each control step (steps * B, ...)."""

    def turn(states: Any, obs: Any) -> tuple[Any, Any]:
        arguments = params, states, obs
        states, twists, _ = jax.vmap(law.step)(*arguments)
        return states, (arguments, (states, twists))

    records = jax.lax.scan(turn, jax.vmap(law.init)(params), obs)[1]
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), records)


def _differs(computed: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return in which control steps (B,) two results differ."""
    size = np.max(np.abs(expected), initial=0, where=np.isfinite(expected))
    equal = np.isclose(computed, expected, rtol=0, atol=_TOLERANCE * size, equal_nan=True)
    return ~equal.reshape(len(equal), -1).all(1)
