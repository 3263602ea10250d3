"""Estimators of a gradient that only this study and notebook 05 compare.

`rps_jax.tuning.gradients` defines scores, `Estimate` and the reverse-mode estimator.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.control import registry
from rps_jax.control.base import LawParams
from rps_jax.trials import pushes, trial
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Snapshot
from rps_jax.tuning.gradients import Estimate, Scores, estimate, per_world, window


def forward(scores: Scores, theta: jax.Array, worlds: Any, *, clip: float = jnp.inf) -> Estimate:
    """By forward-mode differentiation in each world: p times the work of the scores.

    `clip` is that of `estimate`. It passes through the solvers of MJX (with a pyramidal cone) and
    of the fused engine.
    """
    thetas = per_world(theta, worlds)

    def along(direction: jax.Array) -> jax.Array:
        each = jnp.broadcast_to(direction, thetas.shape)
        return jax.jvp(lambda t: scores(t, worlds), (thetas,), (each,))[1]

    return estimate(jax.vmap(along, out_axes=1)(jnp.eye(theta.size, dtype=theta.dtype)), clip)


def differences(
    scores: Scores, theta: jax.Array, worlds: Any, *, step: float | jax.Array
) -> Estimate:
    """By central differences in each world: 2 p n scores.

    A `step` is () or (p,), in the units of theta.
    """
    n, p = per_world(theta, worlds).shape
    steps = jnp.repeat(jnp.diag(jnp.broadcast_to(jnp.asarray(step, theta.dtype), p)), n, axis=0)
    thetas = theta + jnp.concatenate([steps, -steps])
    found = scores(thetas, _repeated(worlds, 2 * p))
    rises = -jnp.diff(found.reshape(2, p, n, *found.shape[1:]), axis=0)[0]
    width = jnp.reshape(2 * jnp.asarray(step), (-1,) + (1,) * found.ndim)
    return estimate(jnp.swapaxes(rises / width, 0, 1))


def evolution(
    scores: Scores,
    theta: jax.Array,
    worlds: Any,
    key: jax.Array,
    *,
    sigma: float | jax.Array,
    pairs: int = 1,
) -> Estimate:
    """By differences between opposite random steps: of the mean score smoothed by `sigma`.

    Each world tries `pairs` normal directions of its own, each both ways, and both in the same
    world: 2 pairs n scores. Without bias it is the gradient of E[score(theta + sigma e)], which
    exists even where scores jump. `sigma`, () or (p,), is in the units of theta.

    Reference: Nesterov and Spokoiny, "Random gradient-free minimization of convex functions",
    Foundations of Computational Mathematics 17, 2017.
    """
    n, p = per_world(theta, worlds).shape
    directions = jax.random.normal(key, (pairs, n, p), theta.dtype)
    steps = jnp.concatenate([directions, -directions]) * sigma
    found = scores(theta + steps.reshape(-1, p), _repeated(worlds, 2 * pairs))
    rises = -jnp.diff(found.reshape(2, pairs, n, 1, *found.shape[1:]), axis=0)[0]
    along = directions / (2 * sigma)
    slopes = rises * along.reshape(*along.shape, *(1,) * (found.ndim - 1))
    return estimate(jnp.mean(slopes, axis=0))


def combine(one: Estimate, other: Estimate) -> Estimate:
    """Two independent estimates of one gradient, weighted by their inverse variances.

    Entry by entry. Of all weighted means this has the least variance, if the variances are right;
    an estimate that knows nothing (of infinite variance) has no weight.
    """
    total = one.variance + other.variance
    weight = jnp.where(total > 0, other.variance / jnp.where(total > 0, total, 1.0), 0.5)
    weight = jnp.where(jnp.isinf(other.variance), 1.0, weight)
    weight = jnp.where(jnp.isinf(one.variance), 0.0, weight)  # of `one`
    certain = jnp.minimum(one.variance, other.variance)
    return Estimate(
        weight * one.gradient + (1 - weight) * other.gradient,
        jnp.where(jnp.isinf(total), certain, weight * one.variance),
        weight * one.finite + (1 - weight) * other.finite,
    )


def distances(
    cases: Sequence[Case],
    params_of: Callable[[jax.Array], LawParams],
    horizons: Sequence[float],
    setting: Setting = Setting(engine="quasistatic"),
) -> tuple[Scores, Any]:
    """How far from their targets pushes are after some times, under the smooth law.

    Args:
      cases: pushes of one kind and one law, RPS or RPS+, with smooth skins.
      params_of: parameters from theta (p,), differentiable.
      horizons: the times (H,) [s], in order.
      setting: what the pushes share; its engine has derivatives.

    Returns:
      Scores (n, H) [m], compiled when first called, and the worlds that they take.

    Example:
      >>> from rps_jax import RPSParams
      >>> from rps_jax.robot.skin import SmoothSkin
      >>> from rps_jax.trials.case import Case
      >>> from rps_jax.tuning.space import Space
      >>> from sweeps.gradients import estimators
      >>> space = Space(("K_h", "L"))
      >>> ahead = Case("box", "S1", (1.0, 1.0), skin=SmoothSkin(), gap=0.0)
      >>> scores, worlds = estimators.distances([ahead], space.params, [0.2, 0.4])
      >>> found = estimators.forward(scores, space.vector(RPSParams.paper()), worlds)
      >>> found.gradient.shape
      (2, 2)
    """
    part = pushes.build(cases, setting)
    law = registry.smooth_law(registry.law_of(cases[0].params))
    at = np.round(np.asarray(horizons) / setting.physics.control_period).astype(int)

    def left(seen: Snapshot) -> jax.Array:
        return seen.details.distance[at]

    loop = ControlLoop(setting.physics, law=law)
    scores = jax.jit(window(part.stage, params_of, left, loop, int(at[-1]) + 1))
    start = trial.start_all(part.worlds, part.params, np.ones(len(cases), bool), law=law)
    return scores, (part.worlds, start)


def _repeated(worlds: Any, times: int) -> Any:
    """Repeat worlds (n, ...) several times, (times n, ...)."""
    return jax.tree.map(lambda x: jnp.concatenate([x] * times), worlds)
