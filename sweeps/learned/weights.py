"""Law `learned` with changes of its weights as parameters, which tuners can move.

rps tune grad --law sweeps/learned/weights.py:Weights --tuned weights
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from rps_jax import register_law
from rps_jax.control.learned import policy
from rps_jax.laws import Bound, law_of, resolve_law

POLICY = policy.read("learned")
_TASK = resolve_law("learned")[1]
_LAW: Any = law_of(_TASK)  # its step is a function of network and weights, with both given


class Weights(NamedTuple):
    """Changes of the weights, and limits."""

    weights: Any  # [1] by name
    d_success: Any = _TASK.d_success
    v_max: Any = _TASK.v_max
    omega_max: Any = _TASK.omega_max


def step(params: Any, state: Any, obs: Any) -> Any:
    """Run the learned law with changed weights."""
    weights = jax.tree.map(lambda x, change: x + change, POLICY.weights, params.weights)
    return _LAW.step.func(POLICY.network, weights, params, state, obs)


BOUNDS = {f"weights.{name}": Bound(-0.1, 0.1) for name in POLICY.weights}
LAW = replace(_LAW, step=step, bounds=BOUNDS)
zeros = {name: np.zeros(x.shape) for name, x in POLICY.weights.items()}
register_law("learned_weights", LAW, Weights(zeros))


def tuned_policy(values: dict[str, Any]) -> Any:
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
