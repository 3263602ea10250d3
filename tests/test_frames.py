"""Planar geometry: correct values without overflow, and finite derivatives without NaN."""

from __future__ import annotations

import math

import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import SEEDS, property_test
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from rps_jax.geometry import planar

PI = np.float32(np.pi)  # a little above pi

finite32 = st.floats(allow_nan=False, allow_infinity=False, width=32)

wrap = jax.jit(planar.wrap)
yaw_of_quaternion = jax.jit(planar.yaw_of_quaternion)
norm_and_gradient = jax.jit(jax.vmap(jax.value_and_grad(planar.norm)))
direction_and_gradient = jax.jit(jax.vmap(jax.value_and_grad(planar.direction)))
sqrt_and_gradient = jax.jit(jax.vmap(jax.value_and_grad(planar.safe_sqrt)))


def ordinary(v: np.ndarray) -> np.ndarray:
    """Exclude subnormal numbers and reciprocals, which XLA on the CPU flushes to zero."""
    return np.clip(np.where(np.abs(v) < 1e-37, 0, v), -8e37, 8e37)


# rotate


def test_a_rotation_by_a_quarter_turn_takes_x_to_y_and_y_to_minus_x():
    got = planar.rotate(jnp.float32(math.pi / 2), jnp.array([[2.0, 0.0], [0.0, 3.0], [1.0, 1.0]]))
    assert_allclose(got, [[0, 2], [-3, 0], [-1, 1]], atol=1e-6)


def test_rotations_compose_by_adding_their_angles_and_keep_lengths():
    rng = default_rng(0)
    a, b = rng.uniform(-4, 4, (2, 100)).astype(np.float32)
    v = rng.normal(size=(100, 2)).astype(np.float32)
    twice = planar.rotate(a, planar.rotate(b, v))
    assert_allclose(twice, planar.rotate(a + b, v), atol=3e-6)
    assert_allclose(np.hypot(*np.asarray(twice).T), np.hypot(*v.T), rtol=1e-6)


# wrap


def check_range(wrapped):
    assert (wrapped >= -PI).all()
    assert (wrapped < PI).all()


@property_test(hnp.arrays(np.float32, 256, elements=finite32))
def test_wrap_stays_in_minus_pi_to_pi_exclusive_for_every_finite_angle(angle):
    check_range(np.asarray(wrap(angle)))


def test_wrap_excludes_pi_whatever_the_rounding_near_its_odd_multiples():
    near = [np.float32(np.arange(-41, 42, 2, dtype=np.float64) * np.pi)]
    for end in (-np.inf, np.inf):
        for _ in range(4):
            near.append(np.nextafter(near[-1], np.float32(end)))
        near.append(near[0])
    tiny = np.float32([1e-8, -1e-8, 1e-38, -1e-38, 0.0, -0.0])
    angle = np.resize(np.concatenate([*near, tiny, -PI + tiny, PI + tiny]), 512)
    wrapped = np.asarray(wrap(angle))
    check_range(wrapped)
    assert_allclose(np.cos(np.float64(wrapped)), np.cos(np.float64(angle)), atol=1e-4)


def test_wrap_excludes_pi_in_float64_where_the_modulus_rounds_up_to_a_turn():
    # 2 pi - 4.4e-16 is halfway between two float64, of which 2 pi is the even one.
    with jax.enable_x64(True):
        below = np.nextafter(-np.pi, -np.inf)
        assert -np.pi <= planar.wrap(jnp.asarray(below)) < np.pi


@property_test(hnp.arrays(np.float32, 256, elements=st.floats(-1e4, 1e4, width=32)))
def test_wrap_changes_no_angle_beyond_rounding(angle):
    # float32's 2 pi is off by 1.7e-7 in every turn, and a large angle is itself that coarse.
    difference = np.float64(wrap(angle)) - np.float64(angle)
    off = np.abs(np.remainder(difference + np.pi, 2 * np.pi) - np.pi)
    assert (off <= 1e-6 + 2e-7 * np.abs(angle)).all()


def test_the_derivative_of_wrap_is_one_even_at_the_jump():
    angle = jnp.array([0.0, 1.0, PI, -PI, 100.0, -3.0])
    assert_array_equal(jax.vmap(jax.grad(planar.wrap))(angle), np.ones(6))


# norm


@pytest.mark.parametrize(
    ("scale", "lengths"), [*((s, 5) for s in (1.0, 1e-36, 1e-30, 1e-20, 1e20, 1e30, 6e37)), (0, 0)]
)
def test_norm_and_its_derivative_are_right_if_squares_overflow_or_vanish(scale, lengths):
    """The largest has a reciprocal below 2^-126, which XLA flushes to zero; zero has no slope."""
    v = np.float32(scale) * np.float32([[3, 4], [-4, 3], [0, -5]])
    value, gradient = norm_and_gradient(v)
    assert_allclose(value, np.full(3, lengths * np.float32(scale)), rtol=1e-6)
    slope = np.float32([[0.6, 0.8], [-0.8, 0.6], [0, -1]]) * (scale > 0)
    assert_allclose(gradient, slope, rtol=1e-6)


@property_test(hnp.arrays(np.float32, (64, 2), elements=finite32))
def test_norm_agrees_with_hypot_and_its_derivative_is_a_unit_vector(v):
    v = ordinary(v)
    value, gradient = norm_and_gradient(v)
    assert_allclose(value, np.hypot(*np.float64(v).T), rtol=1e-6)
    lengths = np.hypot(*np.float64(gradient).T)
    assert_allclose(lengths, v.any(axis=1), atol=1e-6)


def test_norm_is_over_the_last_axis_and_hides_no_nan():
    v = default_rng(0).normal(size=(4, 3, 5))
    assert_allclose(planar.norm(jnp.asarray(v)), np.linalg.norm(v, axis=-1), rtol=1e-6)
    assert np.isnan(planar.norm(jnp.array([jnp.nan, 1.0])))


# direction


def test_the_derivative_of_direction_is_across_and_inverse_to_the_length():
    # d atan2(y, x) = (-y, x) / (x^2 + y^2)
    for scale in (1.0, 1e-30, 1e-20, 1e20, 1e30):
        v = np.float32(scale) * np.float32([[3, 4], [-4, 3], [-5, 0], [0, -5]])
        gradient = np.float64(direction_and_gradient(v)[1]) * scale
        expected = [[-0.16, 0.12], [-0.12, -0.16], [0, -0.2], [0.2, 0]]
        assert_allclose(gradient, expected, rtol=1e-5, atol=1e-9)


def test_direction_is_zero_with_zero_derivative_at_zero():
    value, gradient = direction_and_gradient(jnp.zeros((4, 2)))
    assert_array_equal(value, np.zeros(4))
    assert_array_equal(gradient, np.zeros((4, 2)))


@property_test(hnp.arrays(np.float32, (64, 2), elements=finite32))
def test_direction_agrees_with_atan2_for_every_finite_vector(v):
    v = ordinary(v)
    value, gradient = direction_and_gradient(v)
    expected = np.where(v.any(axis=1), np.arctan2(*np.float64(v).T[::-1]), 0)
    # Beside the cut, float32 may round to its other end.
    off = np.abs(np.remainder(np.float64(value) - expected + np.pi, 2 * np.pi) - np.pi)
    assert off.max() < 1e-6
    assert np.isfinite(gradient).all()


# safe_sqrt


def test_safe_sqrt_is_the_root_or_zero_with_zero_derivative():
    value, gradient = sqrt_and_gradient(jnp.array([4.0, 0.25, 1e-30, 0.0, -1.0, -1e30]))
    assert_allclose(value, [2, 0.5, 1e-15, 0, 0, 0], rtol=1e-6)
    assert_allclose(gradient, [0.25, 1, 5e14, 0, 0, 0], rtol=1e-6)


# greatest


def test_the_greatest_has_the_derivative_of_one_entry_also_of_equal_ones():
    for x, expected in (([1.0, 3.0, 2.0], [0, 1, 0]), ([2.0, 2.0, 1.0], [1, 0, 0])):
        value, gradient = jax.value_and_grad(planar.greatest)(jnp.array(x))
        assert value == max(x)
        assert_array_equal(gradient, expected)


# yaw_of_quaternion


@property_test(SEEDS)
def test_yaw_of_quaternion_is_where_the_tilted_body_heads(seed):
    rng = default_rng(seed)
    yaw = rng.uniform(-3.14, 3.14, 256)
    tilt = rng.uniform(-1.4, 1.4, (256, 2))
    rotation = Rotation.from_euler("ZYX", np.column_stack([yaw, tilt]))
    quaternion = np.float32(rotation.as_quat(scalar_first=True))
    heading = rotation.apply([1.0, 0.0, 0.0])
    assert_allclose(np.arctan2(heading[:, 1], heading[:, 0]), yaw, atol=1e-9)
    for q in (quaternion, -quaternion):  # both are the same rotation
        # The heading's shadow is cos(tilt) >= 0.17 long, which magnifies rounding.
        assert_allclose(yaw_of_quaternion(q), yaw, atol=3e-6)


def test_the_yaw_of_a_body_on_its_nose_is_finite_with_finite_derivatives():
    upright = jnp.array([1.0, 0.0, 1.0, 0.0]) * jnp.sqrt(0.5)
    value, gradient = jax.value_and_grad(planar.yaw_of_quaternion)(upright)
    assert abs(value) <= PI
    assert np.isfinite(gradient).all()


def test_tilt_is_the_angle_to_the_vertical_and_differentiable_at_zero():
    half = np.float32(0.3)
    lean = np.array([np.cos(half), np.sin(half) * 0.6, np.sin(half) * 0.8, 0.0], np.float32)
    turned = np.array([np.cos(half), 0.0, 0.0, np.sin(half)], np.float32)
    tilts = planar.tilt(jnp.stack([lean, turned, np.array([0.0, 1.0, 0.0, 0.0])]))
    assert_allclose(tilts, [0.6, 0.0, math.pi], atol=1e-3)
    tiny = jnp.array([1.0, 5e-6, 0.0, 0.0])
    assert float(planar.tilt(tiny)) == pytest.approx(1e-5, rel=1e-4)
    assert np.isfinite(jax.grad(lambda q: planar.tilt(q))(jnp.array([1.0, 0.0, 0.0, 0.0]))).all()
