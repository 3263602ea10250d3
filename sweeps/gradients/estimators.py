"""Gradient estimators of this study and of notebook 05, for comparison with reverse mode.

Each returns the gradient in each world (n, p, ...), as `rps_jax.tuning.gradients.slopes` does in
reverse mode; `rps_jax.tuning.gradients.estimate` averages them.
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
from rps_jax.tuning.gradients import Estimate, Scores, per_world, window
from rps_jax.world.physics import Physics


def forward(scores: Scores, theta: jax.Array, worlds: Any) -> jax.Array:
    """Return the gradients by forward-mode differentiation.

    The cost is p evaluations of the scores. Forward mode passes through the solver loops of the
    fused engine and of MJX (with a pyramidal cone).
    """
    thetas = per_world(theta, worlds)

    def along(direction: jax.Array) -> jax.Array:
        tangents = jnp.broadcast_to(direction, thetas.shape)
        return jax.jvp(lambda t: scores(t, worlds), (thetas,), (tangents,))[1]

    return jax.vmap(along, out_axes=1)(jnp.eye(theta.size, dtype=theta.dtype))


def differences(
    scores: Scores, theta: jax.Array, worlds: Any, *, step: float | jax.Array
) -> jax.Array:
    """Return the gradients by central differences, from 2 p n scores.

    The `step` is () or (p,), in the units of theta.
    """
    n, p = per_world(theta, worlds).shape
    steps = jnp.repeat(jnp.diag(jnp.broadcast_to(jnp.asarray(step, theta.dtype), p)), n, axis=0)
    thetas = theta + jnp.concatenate([steps, -steps])
    values = scores(thetas, _repeat(worlds, 2 * p))
    rises = -jnp.diff(values.reshape(2, p, n, *values.shape[1:]), axis=0)[0]
    width = jnp.reshape(2 * jnp.asarray(step), (-1,) + (1,) * values.ndim)
    return jnp.swapaxes(rises / width, 0, 1)


def evolution(
    scores: Scores,
    theta: jax.Array,
    worlds: Any,
    key: jax.Array,
    *,
    sigma: float | jax.Array,
    pairs: int = 1,
) -> jax.Array:
    """Return the gradients of the score, smoothed by `sigma`, by antithetic random steps.

    Each world tries `pairs` random normal directions and their opposites: 2 pairs n scores. Their
    mean is unbiased for the gradient of E[score(theta + sigma e)], which exists even where scores
    jump. `sigma`, () or (p,), is in the units of theta.

    Reference: Nesterov and Spokoiny, "Random gradient-free minimization of convex functions",
    Foundations of Computational Mathematics 17, 2017.
    """
    n, p = per_world(theta, worlds).shape
    directions = jax.random.normal(key, (pairs, n, p), theta.dtype)
    steps = jnp.concatenate([directions, -directions]) * sigma
    values = scores(theta + steps.reshape(-1, p), _repeat(worlds, 2 * pairs))
    rises = -jnp.diff(values.reshape(2, pairs, n, 1, *values.shape[1:]), axis=0)[0]
    along = directions / (2 * sigma)
    slopes = rises * along.reshape(*along.shape, *(1,) * (values.ndim - 1))
    return jnp.mean(slopes, axis=0)


def combine(a: Estimate, b: Estimate) -> Estimate:
    """Return the mean of two independent estimates, weighted by their inverse variances.

    Each entry is weighted separately. This mean has the least variance of all weighted means, if
    the variances are correct. An estimate with infinite variance has no weight.
    """
    total = a.variance + b.variance
    weight = jnp.where(total > 0, b.variance / jnp.where(total > 0, total, 1.0), 0.5)  # of a
    weight = jnp.where(jnp.isinf(b.variance), 1.0, weight)
    weight = jnp.where(jnp.isinf(a.variance), 0.0, weight)
    least = jnp.minimum(a.variance, b.variance)
    return Estimate(
        weight * a.gradient + (1 - weight) * b.gradient,
        jnp.where(jnp.isinf(total), least, weight * a.variance),
        weight * a.finite + (1 - weight) * b.finite,
    )


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


def _repeat(worlds: Any, times: int) -> Any:
    """Repeat worlds (n, ...) several times, (times n, ...)."""
    return jax.tree.map(lambda x: jnp.concatenate([x] * times), worlds)
