"""The load: what a force sensor between the base and its skin tells of the object's push.

The engines give the force of the object on the base; a real sensor's reading of it is noisy and
filtered, and nothing below a threshold is believed. The paper's robot has no such sensor; its
numbers here are ours, of the size that the data sheets of wrist sensors give.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rps_jax import errors

_NOISE = 11  # of a world's key; see `base` and `skin` for what else is drawn from it


class LoadCell(NamedTuple):
    """A sensor of the planar force on the base; static, and so plain numbers."""

    noise: float = 1.0  # [N] standard deviation of each raw reading, of both components
    # [s] of the low-pass filter, which is what Heins and Schoellig (2024) have
    time_constant: float = 0.05
    threshold: float = 2.0  # [N] of the filtered force, below which it tells none

    def check(self) -> None:
        """Raises InputError for noise, filter or threshold that no sensor can have."""
        errors.check_finite("load cell noise", self.noise, at_least=0, unit="N")
        errors.check_finite("load cell time_constant", self.time_constant, above=0, unit="s")
        errors.check_finite("load cell threshold", self.threshold, at_least=0, unit="N")

    def read(
        self, load: Load, key: jax.Array, steps: jax.Array, period: float
    ) -> tuple[Load, jax.Array]:
        """One reading of the force (2,) [N] of the object on the base, in the base's frame.

        Args:
          load: what was felt, as the engine has it, and the filter.
          key: of the world.
          steps: () control steps done.
          period: [s] since the last reading.
        """
        drawn = jax.random.fold_in(jax.random.fold_in(key, _NOISE), steps)
        like = load.signal
        raw = load.wrench[:2] + self.noise * jax.random.normal(drawn, (2,), like.dtype)
        signal = like + (1 - jnp.exp(-period / self.time_constant)) * (raw - like)
        told = jnp.sum(signal * signal) >= self.threshold**2
        return load._replace(signal=signal), jnp.where(told, signal, 0.0)


class Load(NamedTuple):
    """What a load cell carries from one reading to the next."""

    wrench: jax.Array  # (3,) [N, N, N m] of the object on the base in the last period, its frame
    signal: jax.Array  # (2,) [N] the filtered force


def start(like: jax.Array) -> Load:
    """Before anything was felt; numbers are of the type of `like`."""
    return Load(jnp.zeros(3, like.dtype), jnp.zeros(2, like.dtype))
