"""Deprecated name of `rps_jax.trials.gym`, the environments of Gymnasium."""

import warnings

from rps_jax.trials.gym import GymPush as Push
from rps_jax.trials.gym import GymPushVector as PushVector

__all__ = ["Push", "PushVector"]

warnings.warn(
    "rps_jax.tuning.gym is deprecated and will be removed: import rps_jax.trials.gym instead.",
    DeprecationWarning,
    stacklevel=2,
)
