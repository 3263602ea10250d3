"""Gradient estimators of this study and of notebook 05 beside those of the package.

They have the interface of `rps_jax.tuning.gradients`, whose `estimate` averages their samples.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.control import registry
from rps_jax.control.base import Law, LawParams
from rps_jax.trials import pushes, trial
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Snapshot
from rps_jax.tuning import gradients
from rps_jax.tuning.gradients import (
    Estimator,
    Options,
    Scores,
    per_world,
    random_steps,
    repeat,
    window,
)
from rps_jax.world.physics import Physics


def forward(
    scores: Scores,
    theta: jax.Array,
    worlds: Any,
    key: jax.Array | None = None,
    options: Options = Options(),
) -> jax.Array:
    """Return the derivatives in forward mode, at the cost of p evaluations of the scores.

    Forward mode passes through the solver loop of MJX with a pyramidal cone.
    """
    del key, options
    thetas = per_world(theta, worlds)

    def along(direction: jax.Array) -> jax.Array:
        tangents = jnp.broadcast_to(direction, thetas.shape)
        return jax.jvp(lambda t: scores(t, worlds), (thetas,), (tangents,))[1]

    return jax.vmap(along, out_axes=1)(jnp.eye(theta.size, dtype=theta.dtype))


def differences(
    scores: Scores,
    theta: jax.Array,
    worlds: Any,
    key: jax.Array | None = None,
    options: Options = Options(),
) -> jax.Array:
    """Return central differences with steps of sigma, from 2 p n scores."""
    n, p = per_world(theta, worlds).shape
    sigma = jnp.broadcast_to(jnp.asarray(options.sigma, theta.dtype), p)
    steps = jnp.repeat(jnp.diag(sigma), n, axis=0)
    thetas = theta + jnp.concatenate([steps, -steps])
    values = scores(thetas, repeat(worlds, 2 * p))
    rises = -jnp.diff(values.reshape(2, p, n, *values.shape[1:]), axis=0)[0]
    return jnp.swapaxes(rises / jnp.reshape(2 * sigma, (-1,) + (1,) * values.ndim), 0, 1)


def bundled(
    scores: Scores, theta: jax.Array, worlds: Any, key: jax.Array, options: Options = Options()
) -> jax.Array:
    """Return the derivatives of the smoothed score: means over antithetic random steps."""
    _, thetas, repeated = random_steps(theta, worlds, key, options)
    samples = gradients.exact(scores, thetas, repeated)
    return jnp.mean(samples.reshape(2 * options.pairs, -1, *samples.shape[1:]), axis=0)


# All estimators of the study by name.
ESTIMATORS: dict[str, Estimator] = {
    **gradients.ESTIMATORS,
    "bundled": bundled,
    "warm": gradients.exact,  # of trials with wider switches of the taxels
    "forward": forward,
    "differences": differences,
}


def distances(
    cases: Sequence[Case],
    params_of: Callable[[jax.Array], LawParams],
    horizons: Sequence[float],
    setting: Setting = Setting(engine="quasistatic"),
) -> tuple[Scores, Any]:
    """Return the distances of pushes from their targets after several times, under the smooth law.

    Args:
      cases: pushes of one shape family and one law, RPS or RPS+, with smooth skins.
      params_of: parameters from theta (p,), differentiable.
      horizons: the times (H,) [s], in order.
      setting: setting of the pushes; its engine has derivatives.

    Returns:
      Scores (n, H) [m], compiled at the first call, and their worlds.

    Example:
      >>> from rps_jax import RPSParams
      >>> from rps_jax.robot.skin import IdealSkin
      >>> from rps_jax.trials.case import Case
      >>> from rps_jax.tuning.space import Space
      >>> from sweeps.gradients import estimators
      >>> space = Space(("K_h", "L"))
      >>> ahead = Case("box", "S1", (1.0, 1.0), skin=IdealSkin(temperature=0.001), gap=0.0)
      >>> scores, worlds = estimators.distances([ahead], space.params, [0.2, 0.4])
      >>> estimators.forward(scores, space.vector(RPSParams.paper()), worlds).shape
      (1, 2, 2)
    """
    part = pushes.build(cases, setting)
    law = registry.smooth_law(registry.law_of(cases[0].params))
    at = np.round(np.asarray(horizons) / setting.physics.control_period).astype(int)
    scores = jax.jit(distances_at(at, part.stage, params_of, setting.physics, law))
    start = trial.start_all(part.worlds, part.params, np.ones(len(cases), bool), law=law)
    return scores, (part.worlds, start)


def distances_at(
    steps: np.ndarray,
    stage: Any,
    params_of: Callable[[jax.Array], LawParams],
    physics: Physics,
    law: Law,
) -> Scores:
    """Return the scores (n, H) [m] of started trials: distances after the control steps (H,)."""

    def remaining(snapshots: Snapshot) -> jax.Array:
        return snapshots.details.distance[steps]

    return window(stage, params_of, remaining, ControlLoop(physics, law=law), int(steps[-1]) + 1)
