"""A search of a million states finds no counterexamples to the proofs about the law."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import refusing
from numpy.random import default_rng
from numpy.testing import assert_allclose

from rps_jax import Observation, RPSParams
from rps_jax.control.laws import rps
from rps_jax.control.laws.rps import RPSState
from sweeps.limits import margins

COUNT = 1_000_000


def states(seed, params):
    """Return random contacts in the critical region, on any object, with any targets."""
    random = default_rng(seed)
    side = random.choice([-1.0, 1.0], COUNT)
    l = side * random.uniform(float(params.l_cr) + 1e-4, 0.29, COUNT)  # noqa: E741
    contact = np.stack([np.full(COUNT, 0.36), l], axis=-1)
    length, bearing = random.uniform(0, 0.6, COUNT), random.uniform(-np.pi, np.pi, COUNT)
    arm = length[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    c, mu = random.uniform(0.02, 0.5, COUNT), random.uniform(0.0, 2.0, COUNT)
    target = random.uniform(-4, 4, (COUNT, 2))
    return margins.Touch(contact, arm, c, mu), target


def twists(params, touch, target):
    def step(contact, target):
        state = RPSState.init(params)
        observation = Observation(jnp.zeros(2), jnp.zeros(()), contact, jnp.ones((), bool), target)
        _, twist, details = rps.step_with_details(params, state, observation)
        return jnp.stack(twist), details.realigning, details.distance

    twists = jax.jit(jax.vmap(step))(touch.p_robot_contact, target)
    return [np.asarray(leaf, float) for leaf in twists]


@pytest.mark.parametrize("params", [RPSParams.paper(), RPSParams.tuned()], ids=["paper", "tuned"])
def test_a_contact_in_the_critical_region_moves_back_wherever_t4_holds(params):
    touch, target = states(0, params)
    twist, realigning, distance = twists(params, touch, target)
    far = distance > params.d_success
    assert realigning[far].all()
    assert np.abs(twist[far, 2]).max() < 1e-4  # [rad/s] Eq. 10, but for rounding
    arm = np.linalg.norm(touch.p_robot_arm, axis=-1) / touch.c
    holds = margins.stays(params, touch.mu, arm) & far
    assert 0.2 * COUNT < holds.sum() < far.sum()  # it is neither empty nor all
    outwards = margins.drift(twist, touch) * np.sign(touch.p_robot_contact[:, 1])
    assert (outwards[holds] < 0).all()


def test_without_t4_a_contact_may_move_outwards():
    """The condition fails with a slope of 1 instead of 10, and a search finds counterexamples."""
    params = RPSParams.paper()._replace(a_r_max=1.0)
    touch, target = states(1, params)
    twist, _, distance = twists(params, touch, target)
    far = distance > params.d_success
    arm = np.linalg.norm(touch.p_robot_arm, axis=-1) / touch.c
    below = np.arctan(touch.mu) + np.arcsin(arm**2 / (2 + arm**2)) < np.pi / 2
    outwards = margins.drift(twist, touch) * np.sign(touch.p_robot_contact[:, 1])
    holds = margins.stays(params, touch.mu, arm) & far
    assert (outwards[holds] < 1e-9).all()
    assert (outwards[below & ~holds] > 1e-4).sum() > 100
    # The bound is nearly reached: some of what breaks it does so by less than two degrees.
    slope = margins.steepest(touch.mu, arm)
    assert (np.degrees(np.arctan(slope[outwards > 1e-6])) < 47).any()


def test_the_drift_by_hand():
    """A point ahead of the centre of friction: A = 1 along x and 1 + r^2 / c^2 across."""

    def margin(v_x, v_y, mu):
        contact, arm = np.array([0.36, 0.1]), np.array([-0.3, 0.0])
        touch = margins.Touch(contact, arm, np.array(0.3), np.array(mu))
        return float(margins.drift(np.array([v_x, v_y, 0.0]), touch))

    # Sticking needs a force of slope (v_y / 2) / v_x: at mu = 0.5 up to v_y = v_x.
    assert margin(0.02, 0.019, 0.5) == 0.0
    # Beyond, it slips: w_y = 2 mu w_x = 0.02, and the base goes on at 0.05.
    assert_allclose(margin(0.02, 0.05, 0.5), 0.02 - 0.05)
    # Without friction the point is only pushed ahead.
    assert_allclose(margin(0.02, 0.05, 0.0), -0.05)
    assert np.isnan(margin(-0.02, 0.0, 0.5))


def test_the_cone_of_motions_by_hand():
    # r = 0: Coulomb's cone. mu = 0 and r^2 = 2 c^2: asin(2 / 4) = 30 degrees.
    assert_allclose(margins.steepest(0.75, 0.0), 0.75)
    assert_allclose(margins.steepest(0.0, np.sqrt(2)), np.tan(np.pi / 6))
    assert np.isinf(margins.steepest(1.0, 4.0))
    with refusing(r"mu = -0\.1"):
        margins.steepest(-0.1, 0.0)
