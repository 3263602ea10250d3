"""Gradient estimates: unbiased, with correct variances, and without values that are not finite."""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax.control import registry
from rps_jax.control.laws import rps
from rps_jax.control.laws.rps import RPSParams
from rps_jax.robot.skin import IdealSkin
from rps_jax.trials import pushes, trial
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.tuning import gradients
from rps_jax.tuning.gradients import Estimate, Options
from sweeps.gradients import critic, estimators

THETA = jnp.array([0.5, -1.0, 2.0])
STIFF = jnp.array([1.0, 2.0, 0.5])
SPREAD = 0.3
REPEATS = 400


def bowls(thetas, worlds):
    """Return quadratic scores with a random minimum; their mean gradient is STIFF THETA."""
    return 0.5 * jnp.sum(STIFF * (thetas - worlds) ** 2, axis=-1)


def some_worlds(key, n=32):
    return SPREAD * jax.random.normal(key, (n, 3))


OPTIONS = Options(clip=math.inf, sigma=0.1, pairs=2)
ESTIMATORS = estimators.ESTIMATORS
UNBIASED = tuple(ESTIMATORS)  # for quadratic scores; without a bound on the norms
DERIVATIVES = ("exact", "clipped", "forward", "differences")


def sampled(name, scores, theta, worlds, key, options=OPTIONS):
    return ESTIMATORS[name](scores, theta, worlds, key, options)


every_estimator = pytest.mark.parametrize("name", ESTIMATORS)


@functools.partial(jax.jit, static_argnums=(0, 1))
def found_by(name, scores, key, worlds) -> Estimate:
    return gradients.estimate(sampled(name, scores, THETA, worlds, key))


@functools.cache
def repeat(name, n, seed=1) -> Estimate:
    """Independent estimates, (REPEATS, ...), each in n fresh worlds."""

    def a(key):
        key_worlds, key = jax.random.split(key)
        return gradients.estimate(sampled(name, bowls, THETA, some_worlds(key_worlds, n), key))

    keys = jax.random.split(jax.random.key(seed), REPEATS)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(a))(keys))


@every_estimator
def test_the_gradient_of_a_quadratic_is_unbiased_and_within_its_interval(name):
    """The variance is that of repeated estimates, and falls as one over n."""
    for n in (32, 512):
        estimate = repeat(name, n)
        error = estimate.gradient - STIFF * THETA
        of_the_mean = error.std(axis=0) / math.sqrt(REPEATS)
        assert (np.abs(error.mean(axis=0)) < 3.5 * of_the_mean).all()
        assert (estimate.finite == 1).all()
        change, share_change = (
            (1.7, 1.7) if name == "mixed" else (0.6, 0.25)
        )  # without its weight's
        ratio = estimate.variance.mean(0) / estimate.gradient.var(0)
        assert_allclose(np.log(ratio), 0, atol=change)
    within = np.abs(error) < 1.96 * np.sqrt(estimate.variance)
    assert np.abs(within.mean(axis=0) - 0.95).max() < 0.08 or name == "mixed"
    share = repeat(name, 32).variance.mean(0) / estimate.variance.mean(0)
    assert_allclose(np.log(share / 16), 0, atol=share_change)


def test_derivatives_are_those_in_each_world():
    worlds = some_worlds(jax.random.key(2))
    slopes = STIFF * (THETA - worlds)  # (32, 3)
    for name in DERIVATIVES:
        samples = jax.jit(functools.partial(sampled, name, bowls))(THETA, worlds, None)
        assert_allclose(samples, slopes, rtol=1e-4, atol=1e-5)
        estimate = found_by(name, bowls, None, worlds)
        assert_allclose(estimate.gradient, slopes.mean(axis=0), rtol=1e-5)
        assert_allclose(estimate.variance, slopes.var(axis=0, ddof=1) / 32, rtol=1e-4)


def test_random_steps_give_the_gradient_of_the_smoothed_score():
    # E[(theta + sigma e)^3] = theta^3 + 3 sigma^2 theta.
    def cubes(thetas, worlds):
        return jnp.sum(thetas**3, axis=-1) + worlds

    sigma = jnp.array([0.5, 0.1, 0.3])
    worlds, key = jnp.zeros(200_000), jax.random.key(3)
    expected, variances = 3 * THETA**2 + 3 * sigma**2, {}
    for name in ("evolution", "bundled"):
        samples = sampled(name, cubes, THETA, worlds, key, Options(sigma=sigma))
        estimate = gradients.estimate(samples)
        assert (np.abs(estimate.gradient - expected) < 4 * np.sqrt(estimate.variance)).all()
        variances[name] = estimate.variance
    assert (variances["evolution"] < 0.05**2 * 9).all()
    assert (variances["bundled"] < 0.1 * variances["evolution"]).all()


def test_only_evolution_estimates_gradients_across_jumps():
    """A trial succeeds if the first parameter, 0.5, exceeds a threshold uniform on [-1, 2]."""

    def wins(thetas, hurdles):
        return (thetas[:, 0] > hurdles).astype(thetas.dtype)

    hurdles = jax.random.uniform(jax.random.key(4), (20_000,), minval=-1, maxval=2)
    for name in ("forward", "exact", "clipped", "bundled"):
        estimate = found_by(name, wins, jax.random.key(5), hurdles)
        assert_array_equal(estimate.gradient, np.zeros(3))
    for name in ("evolution", "mixed"):  # the mixture gives the biased derivative no weight
        estimate = found_by(name, wins, jax.random.key(5), hurdles)
        assert estimate.gradient[0] > 0.2
        error = np.abs(estimate.gradient - np.array([1 / 3, 0, 0]))
        assert (error < 5 * np.sqrt(estimate.variance)).all()


def test_the_mixture_takes_derivatives_of_a_smooth_score():
    worlds, key = some_worlds(jax.random.key(10), 2000), jax.random.key(11)
    mixed, exact, evolution = (
        found_by(name, bowls, key, worlds) for name in ("mixed", "exact", "evolution")
    )
    assert_allclose(mixed.gradient, exact.gradient, atol=0.02)
    assert mixed.variance.sum() < 1.1 * exact.variance.sum()
    assert (exact.variance < 0.1 * evolution.variance).all()


def test_a_chaotic_score_has_a_large_derivative_and_a_small_smoothed_slope():
    """The mean over 40 steps of x -> r x (1 - x), whose Lyapunov exponent is about 0.5."""

    def chaos(thetas, starts):
        rates = 3.9 + 0.01 * thetas[:, 0]

        def step(x, _):
            return rates * x * (1 - x), x

        return jnp.mean(jax.lax.scan(step, starts, length=40)[1], axis=0)

    starts = jax.random.uniform(jax.random.key(12), (4000,), minval=0.1, maxval=0.9)
    start, key = jnp.zeros(1), jax.random.key(13)
    samples = {
        name: jax.jit(lambda w, name=name: sampled(name, chaos, start, w, key, Options(sigma=1.0)))(
            starts
        )
        for name in ("exact", "clipped", "bundled", "evolution", "mixed")
    }
    estimates = {name: gradients.estimate(x) for name, x in samples.items()}
    means = [chaos(jnp.full((4000, 1), float(side)), starts).mean() for side in (2, -2)]
    truth = float(means[0] - means[1]) / 4
    assert np.abs(samples["exact"]).max() > 1e4
    for name in ("evolution", "mixed"):
        assert np.sqrt(estimates[name].variance[0]) < 0.01
        assert abs(estimates[name].gradient[0] - truth) < 0.02
    for name in ("exact", "bundled"):
        assert np.sqrt(estimates[name].variance[0]) > 1
    assert np.sqrt(estimates["clipped"].variance[0]) < 0.1 * np.sqrt(estimates["exact"].variance[0])


def test_common_worlds_cancel_what_does_not_depend_on_the_parameters():
    def shifted(thetas, worlds):
        return bowls(thetas, worlds) + 1e3 * worlds[:, 0]

    worlds, key = some_worlds(jax.random.key(6)), jax.random.key(7)
    plain, noisy = (found_by("evolution", scores, key, worlds) for scores in (bowls, shifted))
    assert_allclose(noisy.gradient, plain.gradient, atol=2e-3)


@every_estimator
def test_worlds_that_are_not_finite_are_dropped_and_counted(name):
    worlds = some_worlds(jax.random.key(8))
    broken = worlds.at[::8].set(jnp.nan).at[4::8].set(jnp.inf)
    rest = jnp.delete(worlds, np.arange(0, 32, 4), axis=0)
    estimate = found_by(name, bowls, jax.random.key(9), broken)
    assert_allclose(estimate.finite, 0.75)
    assert np.isfinite(estimate.gradient).all()
    if name in DERIVATIVES:  # others try other directions in another number of worlds
        expected = found_by(name, bowls, None, rest)
        assert_allclose(estimate.gradient, expected.gradient, rtol=1e-5)
        assert_allclose(estimate.variance, expected.variance, rtol=1e-5)


def test_entries_are_dropped_one_by_one():
    samples = jnp.array([[1.0, jnp.nan], [3.0, 2.0], [jnp.inf, 4.0], [5.0, 6.0]])
    estimate = gradients.estimate(samples)
    assert_allclose(estimate.gradient, [3.0, 4.0])
    assert_allclose(estimate.variance, [4 / 3, 4 / 3])  # of 1 3 5 and 2 4 6: 4 in 3
    assert_allclose(estimate.finite, [0.75, 0.75])


def test_a_sample_beyond_the_bound_is_scaled_down_to_it_by_hand():
    # Norms 5, 0.5, 1e30 and none: of those that are, the median is 5, and twice that 10.
    samples = jnp.array([[3.0, 4.0], [0.3, 0.4], [0.0, -1e30], [0.0, 0.0]])
    bounded = gradients.clip(samples, 2.0)
    np.testing.assert_allclose(bounded, [[3, 4], [0.3, 0.4], [0, -10], [0, 0]], rtol=1e-5)
    # Each score of a world has a separate bound.
    two = jnp.stack([samples, samples[::-1] / 10], axis=-1)
    both = gradients.clip(two, 2.0)
    np.testing.assert_allclose(both[..., 1], bounded[::-1] / 10, rtol=1e-5)
    broken = gradients.clip(samples.at[1, 0].set(jnp.nan), 2.0)
    np.testing.assert_allclose(gradients.estimate(broken).finite, 0.75)
    np.testing.assert_array_equal(gradients.clip(jnp.zeros((3, 2)), 2.0), np.zeros((3, 2)))


def test_a_mean_of_no_samples_is_nan_with_infinite_variance():
    estimate = gradients.estimate(jnp.array([[jnp.nan, 1.0], [jnp.nan, jnp.nan]]))
    assert_array_equal(estimate.gradient, [np.nan, 1.0])
    assert_array_equal(estimate.variance, [np.inf, np.inf])
    assert_array_equal(estimate.finite, [0.0, 0.5])


@pytest.mark.slow
def test_a_critic_is_fitted_to_remaining_scores(monkeypatch):
    monkeypatch.setattr(critic, "_UPDATES", 500)
    monkeypatch.setattr(critic, "_BATCH", 64)
    monkeypatch.setattr(critic, "_WIDTH", 16)
    x = default_rng(0).normal(size=(500, 3)).astype(np.float32)
    y = np.tanh(x[:, 0]) + 0.5 * x[:, 1]
    error = np.asarray(critic.fit(x, y)(jnp.asarray(x))) - y
    assert np.std(error) < 0.2 * np.std(y)


# Windows of trials


def params_of(theta) -> RPSParams:
    # Once saturated, a velocity does not depend on K_v, nor does omega that follows from it.
    return RPSParams.unsaturated()._replace(L=theta[0], K_h=theta[1], beta=theta[2], K_v=theta[3])


def final_distance(snapshots):
    return snapshots.details.distance[-1]


@pytest.mark.slow
def test_the_derivative_of_a_window_of_fused_trials_is_its_finite_difference():
    """A cylinder rolls along the base, in float32; one program gives scores and derivatives."""
    targets = ((1.0, -1.5), (2.0, 0.5), (-1.5, 1.0))
    skin, setting = IdealSkin(temperature=0.001), Setting(engine="fused")
    cases = [Case("cylinder", "S1", t, skin=skin, gap=0.004) for t in targets]
    _, worlds, stage, params = pushes.build(cases, setting)
    law = registry.smooth_law(rps.LAW)
    starts = (worlds, trial.start_all(worlds, params, np.ones(3, bool), law=law))
    loop = trial.ControlLoop(setting.physics, law=law)
    scores = estimators.window(stage, params_of, final_distance, loop, 50)
    along = jax.jit(lambda thetas, way: jax.jvp(lambda x: scores(x, starts), (thetas,), (way,)))
    theta, h = np.array([0.2, 1.0, 0.12, 0.04], np.float32), 0.01
    slopes, differences = [], []
    for direction in np.diag(theta):
        thetas, way = np.tile(theta, (3, 1)), np.tile(direction, (3, 1))
        slopes.append(along(thetas, way)[1])
        up, down = (along(thetas + side * h * way, way)[0] for side in (1, -1))
        differences.append((up - down) / (2 * h))
    slopes, differences = np.array(slopes), np.array(differences)
    assert np.isfinite(slopes).all()
    assert (np.abs(slopes).max(axis=1) > 1e-3).all()  # each parameter matters somewhere
    assert_allclose(slopes, differences, rtol=0.02, atol=2e-4)
