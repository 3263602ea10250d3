"""Law `learned` with changes of its weights as parameters, which tuners can move.

rps tune grad --law sweeps/learned/weights.py:Weights --tuned weights
"""

from __future__ import annotations

import json
import sys
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from rps_jax import Law, register_law
from rps_jax.control.learned import network, policy
from rps_jax.control.learned.network import LearnedParams
from rps_jax.laws import Bound

POLICY = policy.read("learned")
_TASK = LearnedParams()


class Weights(NamedTuple):
    """Changes of the weights, and limits."""

    weights: Any  # [1] by name
    d_success: Any = _TASK.d_success
    v_max: Any = _TASK.v_max
    omega_max: Any = _TASK.omega_max


def step(params: Any, state: Any, obs: Any) -> Any:
    """Run the learned law with changed weights."""
    weights = jax.tree.map(lambda x, change: x + change, POLICY.weights, params.weights)
    return network.step(POLICY.network, weights, params, state, obs)


LAW = Law(
    partial(network.init, POLICY.network),
    step,
    "taxels",
    bounds={f"weights.{name}": Bound(-0.1, 0.1) for name in POLICY.weights},
    observe_sent=network.observe_sent,
)
zeros = {name: np.zeros(x.shape) for name, x in POLICY.weights.items()}
register_law("learned_weights", LAW, Weights(zeros))


def tuned_policy(values: dict[str, Any]) -> policy.Policy:
    """Return the law with the changes of `tuned.json`."""
    weights = {
        name: np.float32(x + np.asarray(values[f"weights.{name}"]))
        for name, x in POLICY.weights.items()
    }
    return POLICY._replace(weights=weights)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    values = json.loads((folder / "tuned.json").read_text())
    (folder / "policy.npz").write_bytes(policy.encode(tuned_policy(values)))
