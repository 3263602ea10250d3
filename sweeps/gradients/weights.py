"""Learned law whose parameters are changes of its weights, which tuners can move.

rps tune grad --law sweeps/gradients/weights.py:Weights
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax
import numpy as np

from rps_jax import Law, register_law
from rps_jax.control.learned import network, policy
from rps_jax.laws import Bound

_POLICY = policy.read("learned_small")
_CHANGE = 0.1  # [1] bound on the change of a weight


class Weights(NamedTuple):
    """Changes of the weights, and limits."""

    weights: Any  # [1] by name
    d_success: float = 0.05
    v_max: float = 0.05
    omega_max: float = 0.15


def changes_of(path: Path) -> dict[str, np.ndarray]:
    """Return the changes of the weights [1] of the file of a policy."""
    weights = policy.read(str(path)).weights
    return {name: weights[name] - x for name, x in _POLICY.weights.items()}


def step(params: Any, state: Any, obs: Any) -> Any:
    """Run the learned law with changed weights."""
    weights = jax.tree.map(lambda x, change: x + change, _POLICY.weights, params.weights)
    return network.step(_POLICY.network, weights, params, state, obs)


LAW = Law(
    cast(Any, partial(network.init, _POLICY.network)),
    step,
    "taxels",
    bounds={f"weights.{name}": Bound(-_CHANGE, _CHANGE) for name in _POLICY.weights},
    observe_sent=network.observe_sent,
)
zeros = {name: np.zeros(x.shape) for name, x in _POLICY.weights.items()}
register_law("learned_weights", LAW, Weights(zeros))
