"""Transformations of JAX: those of a rollout, for all tasks and engines with derivatives."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slow

import rps_jax
from rps_jax import engines
from rps_jax.control.laws.rps import RPSParams
from rps_jax.engines import native
from rps_jax.trials.setting import Setting
from rps_jax.world.tasks import TASKS, corridor

SETTINGS = {name: Setting(name) for name in engines.names() if engines.get(name).modes}
LAW = RPSParams.tuned()
DOMAIN = "wide,objects=random_box,gap=0:0.01"
ROOM = {"kind": "rooms", "outline": [[-1, -1], [4, -1], [4, 2], [-1, 2]], "goal": [2, 1]}
EXAMPLES = {"rooms": ROOM}  # of tasks that need more than their name


def final_distances(engine, task):
    """Return the distance [m] after 0.2 s as a function of law and worlds, and two worlds."""
    setting = SETTINGS[engine]
    batch = rps_jax.draw_worlds(DOMAIN, 2, task=EXAMPLES.get(task, task), setting=setting)

    def distance(law, world):
        trajectory = rps_jax.rollout(world, law, batch.stage, setting, horizon=0.2)
        return trajectory.details.distance[-1]

    return distance, batch.worlds


def over_worlds(transformed):
    return jax.jit(jax.vmap(transformed, in_axes=(None, 0)))


@pytest.fixture
def traced(monkeypatch):
    """Trace functions without a compiler of C."""
    monkeypatch.setattr(native, "load", lambda name: True)


MODES = {"reverse": lambda f: jax.grad(jax.checkpoint(f)), "forward": jax.jacfwd}
# In reverse mode JAX refuses loops of unknown length.
QUICK = ("quasistatic", "corridor", "forward"), ("fused", "corridor", "reverse")


@pytest.mark.usefixtures("traced")
@pytest.mark.parametrize(
    ("engine", "task", "mode"),
    [row if row in QUICK else slow(*row) for row in itertools.product(SETTINGS, TASKS, MODES)],
)
def test_rollouts_of_all_tasks_and_engines_have_all_transformations(engine, task, mode):
    """Trace them."""
    distance, worlds = final_distances(engine, task)
    shapes = jax.eval_shape(over_worlds(MODES[mode](distance)), LAW, worlds)
    assert {x.shape for x in jax.tree.leaves(shapes)} == {(2,)}


@pytest.mark.usefixtures("traced")
@pytest.mark.parametrize("engine", SETTINGS)
@pytest.mark.parametrize("first", [jax.grad, jax.jacfwd])
def test_second_derivatives_of_rollouts_are_refused_with_and_without_a_compiler(
    engine, first, monkeypatch
):
    distance, worlds = final_distances(engine, "reach")
    for is_available in (native.is_available, lambda: False):
        monkeypatch.setattr(native, "is_available", is_available)
        with pytest.raises(NotImplementedError, match="trials have no second derivatives"):
            jax.eval_shape(over_worlds(jax.jacfwd(first(distance))), LAW, worlds)


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_both_modes_agree_in_all_tasks(task):
    distance, worlds = final_distances("quasistatic", task)
    expected = over_worlds(jax.jacfwd(distance))(LAW, worlds)
    result = over_worlds(jax.grad(jax.checkpoint(distance)))(LAW, worlds)
    largest = max(np.abs(x).max() for x in jax.tree.leaves(expected))
    assert largest > 0
    jax.tree.map(
        partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-4 * largest), result, expected
    )


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["fused", "quasistatic"])
@pytest.mark.parametrize("task", TASKS)
def test_value_and_grad_differentiates_scores_of_all_tasks(engine, task):
    """Compare with the gradient of the rollouts."""
    distance, worlds = final_distances(engine, task)
    expected = over_worlds(jax.grad(distance))(LAW, worlds)
    results = rps_jax.value_and_grad(
        lambda trajectory: trajectory.details.distance[-1],
        {"law": LAW},
        DOMAIN,
        2,
        "v_approach",
        horizon=0.2,
        smooth=False,
        task=EXAMPLES.get(task, task),
        setting=SETTINGS[engine],
    )
    slopes = results.gradient[0, :, 0]
    assert np.abs(slopes).max() > 0
    np.testing.assert_allclose(slopes, expected.v_approach, rtol=1e-3)


@pytest.mark.parametrize("due", [True, False])
def test_a_measurement_that_may_not_be_due_has_derivatives(due):
    def measure(factor, poses, last):
        def function(poses, last):
            return {"value": last["value"] * factor * poses, "index": last["index"] + 1}

        return corridor._where_due(jnp.array(due), function, poses, last)["value"]

    inputs = 3.0, jnp.array(5.0), {"value": jnp.array(7.0), "index": jnp.array(1)}
    expected = (35.0, 21.0, 15.0) if due else (0.0, 0.0, 1.0)
    by = lambda *x: measure(x[0], x[1], inputs[2] | {"value": x[2]})  # noqa: E731
    floats = inputs[0], inputs[1], inputs[2]["value"]
    for transform in (jax.grad, jax.jacfwd):
        assert jax.jit(transform(by, argnums=(0, 1, 2)))(*floats) == expected
    assert by(*floats) == (105.0 if due else 7.0)
