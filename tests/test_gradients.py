"""Gradient estimates: unbiased, with correct variances, and without values that are not finite."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax.tuning import gradients
from rps_jax.tuning.gradients import Options

THETA = jnp.array([0.5, -1.0, 2.0])
STIFF = jnp.array([1.0, 2.0, 0.5])
SPREAD = 0.3
REPEATS = 400
OPTIONS = Options(sigma=0.1, pairs=2)
estimate_of, clip = jax.jit(gradients.estimate), jax.jit(gradients.clip)


def bowls(thetas, worlds):
    """Return quadratic scores with a random minimum; their mean gradient is STIFF THETA."""
    return 0.5 * jnp.sum(STIFF * (thetas - worlds) ** 2, axis=-1)


def some_worlds(key, n=32):
    return SPREAD * jax.random.normal(key, (n, 3))


@jax.jit
def slopes(key, worlds):
    return gradients.estimate(gradients.evolution(bowls, THETA, worlds, key, OPTIONS))


def test_the_gradient_of_a_quadratic_is_unbiased_and_within_its_interval():
    """The variance is that of repeated estimates, and falls as one over n."""
    variances = {}
    for n in (32, 512):

        def repeat(key, n=n):
            key_worlds, key = jax.random.split(key)
            return slopes(key, some_worlds(key_worlds, n))

        keys = jax.random.split(jax.random.key(1), REPEATS)
        estimate = jax.tree.map(np.asarray, jax.jit(jax.vmap(repeat))(keys))
        error = estimate.gradient - STIFF * THETA
        of_the_mean = error.std(axis=0) / math.sqrt(REPEATS)
        assert (np.abs(error.mean(axis=0)) < 3.5 * of_the_mean).all()
        assert (estimate.finite == 1).all()
        variances[n] = estimate.variance.mean(0)
        assert_allclose(np.log(variances[n] / estimate.gradient.var(0)), 0, atol=0.6)
    within = np.abs(error) < 1.96 * np.sqrt(estimate.variance)
    assert np.abs(within.mean(axis=0) - 0.95).max() < 0.08
    assert_allclose(np.log(variances[32] / variances[512] / 16), 0, atol=0.25)


def test_random_steps_give_the_gradient_of_the_smoothed_score():
    # E[(theta + sigma e)^3] = theta^3 + 3 sigma^2 theta.
    def cubes(thetas, worlds):
        return jnp.sum(thetas**3, axis=-1) + worlds

    sigma = jnp.array([0.5, 0.1, 0.3])
    inputs = THETA, jnp.zeros(200_000), jax.random.key(3), Options(sigma=sigma)
    estimate = gradients.estimate(gradients.evolution(cubes, *inputs))
    expected = 3 * THETA**2 + 3 * sigma**2
    assert (np.abs(estimate.gradient - expected) < 4 * np.sqrt(estimate.variance)).all()
    assert (estimate.variance < 0.05**2 * 9).all()


def test_evolution_estimates_gradients_across_jumps():
    """A trial succeeds if the first parameter, 0.5, exceeds a threshold uniform on [-1, 2]."""

    def wins(thetas, hurdles):
        return (thetas[:, 0] > hurdles).astype(thetas.dtype)

    hurdles = jax.random.uniform(jax.random.key(4), (20_000,), minval=-1, maxval=2)
    samples = gradients.evolution(wins, THETA, hurdles, jax.random.key(5), OPTIONS)
    estimate = gradients.estimate(samples)
    assert estimate.gradient[0] > 0.2
    error = np.abs(estimate.gradient - np.array([1 / 3, 0, 0]))
    assert (error < 5 * np.sqrt(estimate.variance)).all()


def test_common_worlds_cancel_what_does_not_depend_on_the_parameters():
    def shifted(thetas, worlds):
        return bowls(thetas, worlds) + 1e3 * worlds[:, 0]

    worlds, key = some_worlds(jax.random.key(6)), jax.random.key(7)
    noisy = gradients.evolution(shifted, THETA, worlds, key, OPTIONS).mean(axis=0)
    assert_allclose(noisy, slopes(key, worlds).gradient, atol=2e-3)


def test_worlds_that_are_not_finite_are_dropped_and_counted():
    worlds = some_worlds(jax.random.key(8))
    broken = worlds.at[::8].set(jnp.nan).at[4::8].set(jnp.inf)
    estimate = slopes(jax.random.key(9), broken)
    assert_allclose(estimate.finite, 0.75)
    assert np.isfinite(estimate.gradient).all()


def test_entries_are_dropped_one_by_one():
    samples = jnp.array([[1.0, jnp.nan], [3.0, 2.0], [jnp.inf, 4.0], [5.0, 6.0]])
    estimate = estimate_of(samples)
    assert_allclose(estimate.gradient, [3.0, 4.0])
    assert_allclose(estimate.variance, [4 / 3, 4 / 3])  # of 1 3 5 and 2 4 6: 4 in 3
    assert_allclose(estimate.finite, [0.75, 0.75])


def test_a_sample_beyond_the_bound_is_scaled_down_to_it_by_hand():
    # Norms 5, 0.5, 1e30 and none: of those that are, the median is 5, and twice that 10.
    samples = jnp.array([[3.0, 4.0], [0.3, 0.4], [0.0, -1e30], [0.0, 0.0]])
    bounded = clip(samples, 2.0)
    np.testing.assert_allclose(bounded, [[3, 4], [0.3, 0.4], [0, -10], [0, 0]], rtol=1e-5)
    # Each score of a world has a separate bound.
    two = jnp.stack([samples, samples[::-1] / 10], axis=-1)
    both = clip(two, 2.0)
    np.testing.assert_allclose(both[..., 1], bounded[::-1] / 10, rtol=1e-5)
    broken = clip(samples.at[1, 0].set(jnp.nan), 2.0)
    np.testing.assert_allclose(estimate_of(broken).finite, 0.75)
    np.testing.assert_array_equal(clip(jnp.zeros((3, 2)), 2.0), np.zeros((3, 2)))


def test_a_mean_of_no_samples_is_nan_with_infinite_variance():
    estimate = estimate_of(jnp.array([[jnp.nan, 1.0], [jnp.nan, jnp.nan]]))
    assert_array_equal(estimate.gradient, [np.nan, 1.0])
    assert_array_equal(estimate.variance, [np.inf, np.inf])
    assert_array_equal(estimate.finite, [0.0, 0.5])
