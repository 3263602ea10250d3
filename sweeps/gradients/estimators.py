"""Gradient estimators of the studies and of notebook 05, and the scores that they differentiate.

They have the interface of `rps_jax.tuning.gradients`, whose `estimate` averages their samples.
`ESTIMATORS` has all by name; one more is one entry.

Derivatives of chaotic worlds may be finite and meaningless: then their variance is large. Scores
that are differentiated must be smooth: use `registry.smooth_law` with a skin with a temperature.
Derivatives miss all jumps of a score.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import Law, Setting
from rps_jax.control import registry
from rps_jax.engines import native
from rps_jax.engines.base import Stage
from rps_jax.laws import LawParams, law_of
from rps_jax.physics import Physics
from rps_jax.trials import pushes, trial
from rps_jax.trials.trial import ControlLoop, Snapshot, Trial, World
from rps_jax.tuning import gradients
from rps_jax.tuning.gradients import Options, Scores, clip, per_world, random_steps, repeat
from rps_jax.worlds import Case


class Estimator(Protocol):
    """Function that returns samples (n, p, ...) of a gradient."""

    def __call__(
        self,
        scores: Scores,
        theta: jax.Array,
        worlds: Any,
        key: jax.Array,
        options: Options = Options(),
    ) -> jax.Array: ...


def exact(
    scores: Scores,
    theta: jax.Array,
    worlds: Any,
    key: jax.Array | None = None,
    options: Options = Options(),
) -> jax.Array:
    """Return the derivatives in reverse mode; they cost a few evaluations of the scores."""
    del key, options
    jacobian = jax.jacrev(lambda thetas: jnp.sum(scores(thetas, worlds), axis=0))
    return jnp.moveaxis(jacobian(per_world(theta, worlds)), (-2, -1), (0, 1))


def clipped(
    scores: Scores, theta: jax.Array, worlds: Any, key: jax.Array, options: Options = Options()
) -> jax.Array:
    """Return the derivatives with a bound on their norms."""
    return clip(exact(scores, theta, worlds), options.clip)


def mixed(
    scores: Scores, theta: jax.Array, worlds: Any, key: jax.Array, options: Options = Options()
) -> jax.Array:
    """Return mixtures of `exact` and `evolution` with the least mean squared error: see `mix`."""
    first = exact(scores, theta, worlds)
    return mix(first, gradients.evolution(scores, theta, worlds, key, options))


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
    samples = exact(scores, thetas, repeated)
    return jnp.mean(samples.reshape(2 * options.pairs, -1, *samples.shape[1:]), axis=0)


# All estimators of the study by name.
ESTIMATORS: dict[str, Estimator] = {
    "exact": exact,
    "clipped": clipped,
    "evolution": gradients.evolution,
    "mixed": mixed,
    "bundled": bundled,
    "warm": exact,  # of trials with wider switches of the taxels
    "forward": forward,
    "differences": differences,
}


def mix(first: jax.Array, zeroth: jax.Array) -> jax.Array:
    """Mix samples (n, p, ...) of derivatives and of slopes for the least mean squared error.

    The error of the derivatives has their measured variance and their measured bias: the distance
    of the means beyond two standard errors. A derivative that is not finite gets no weight. The
    variance of the mixed samples lacks that of the weight.

    Reference: Suh et al., "Do differentiable simulators give better policy gradients?", ICML 2022;
    there the weight keeps the error below a bound.
    """
    means = gradients.estimate(first), gradients.estimate(zeroth)
    noise_1, noise_0 = (jnp.sum(x.variance, axis=0) for x in means)
    distance = jnp.sum((means[0].gradient - means[1].gradient) ** 2, axis=0)
    bias = jnp.maximum(distance - 4 * (noise_1 + noise_0), 0.0)
    share = jnp.nan_to_num(noise_0 / (noise_0 + noise_1 + jnp.nan_to_num(bias)))
    return jnp.where(jnp.isfinite(first), share * first + (1 - share) * zeroth, zeroth)


def window(
    stage: Stage,  # of an engine with derivatives: see `Engine.check_derivatives`
    params_of: Callable[[jax.Array], LawParams],  # from theta (p,), differentiable
    cost: Callable[[Snapshot], jax.Array],  # () or (...) of snapshots (steps, ...) of one trial
    loop: ControlLoop,  # with the smooth law that the parameters belong to
    steps: int,
) -> Scores:
    """Return scores of windows of trials, of `steps` control steps each.

    The worlds of these scores are batched pairs (World, Trial); a window starts at its trial.
    """

    def scores(thetas: jax.Array, starts: tuple[World, Trial]) -> jax.Array:
        worlds, trials = starts
        params = jax.vmap(params_of)(thetas)
        _, snapshots = trial.unroll(stage, worlds, params, trials, loop, steps, native.mapped)
        return jax.vmap(cost, in_axes=1)(snapshots)

    return scores


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
    law = registry.smooth_law(law_of(cases[0].params))
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
