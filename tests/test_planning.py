"""Plans of pushes to a pose, on the quasi-static model."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax.trials.setting import Setting
from sweeps.planning import plans, study
from sweeps.planning.plans import KNOTS, METHODS, Problem, Simulator

DRUMS = ("random_cylinder", 3, 0, "quasistatic")


@pytest.fixture(scope="module")
def problem():
    """Three short pushes of cylinders."""
    worlds, stage = study.worlds_of(study.TOUCHING, *DRUMS)
    simulator = Simulator(stage, Setting("quasistatic").physics, 2)
    start = study.still(worlds)
    target = study.reached(simulator, worlds.fields, start, 0)
    return Problem(simulator, worlds.fields, start, target)


def test_exact_derivatives_equal_differences(problem):
    theta = plans.straight(3) + 0.1
    errors, exact = problem.jacobian(theta)
    same, differences = problem.differences(theta)
    assert_allclose(errors, same, atol=1e-4)
    assert_allclose(exact, differences, atol=0.1 * np.abs(exact).max())
    cost, gradient = problem.gradient(theta)
    expected = np.einsum("ni,nik->nk", cost, exact).reshape(gradient.shape)
    assert_allclose(gradient, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())
    # Twists before the first knot have no effect.
    _, late = problem._replace(first=KNOTS - 1).jacobian(theta)
    late = late.reshape(3, 3, KNOTS, 3)
    assert not late[:, :, :-1].any()
    assert late[:, :, -1].any()


@pytest.mark.parametrize("name", METHODS)
def test_methods_yield_their_best_plans(name, problem):
    steps = list(itertools.islice(METHODS[name](problem, plans.straight(3)), 6))
    costs = np.array([np.sum(errors**2, axis=-1) for _, errors, _ in steps])
    assert (np.diff(costs, axis=0) <= 0).all()
    assert costs[-1].sum() < costs[0].sum()
    theta, errors, _ = steps[-1]
    assert_allclose(problem.samples(theta[:, None])[:, 0], errors, atol=1e-3)
    assert np.diff([count for _, _, count in steps]).min() > 0


@pytest.mark.slow
def test_gauss_newton_solves_pushes_and_replanning_corrects_the_model(problem):
    solved, _ = study.replan("gauss_newton", problem, problem.fields)
    assert solved.tolist() == [1, 1, 1]
    (solved, rollouts), theta = study.race(plans.gauss_newton, problem, 0.2)
    assert solved[-1] == 1
    assert (np.diff(rollouts) >= 0).all()
    assert study.path(problem, theta).shape == (KNOTS + 1, 3, 10)
    assert study.predicted(problem, problem.fields).tolist() == [1, 1, 1]


def test_a_model_knows_the_shape_alone():
    """Same objects and starts, with other friction and another centre of mass."""
    nominal = replace(study.TOUCHING, **study._NOMINAL)
    (model, _), (true, _) = (study.worlds_of(x, *DRUMS) for x in (nominal, study.TOUCHING))
    assert_array_equal(model.qpos, true.qpos)
    assert_array_equal(model.footprint.radius, true.footprint.radius)
    outlines = study.outlines(true)
    size = np.linalg.norm(outlines, axis=-1)
    assert_allclose(size, np.asarray(true.footprint.radius)[:, None] + 0 * size, rtol=1e-5)
