"""The shape checker of the tests reports a wrong shape at its call."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError

from rps_jax import Observation, RPSParams, Twist
from rps_jax.control.laws import rps
from rps_jax.control.laws.rps import RPSState
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import planar
from rps_jax.robot.skin import IdealSkin, SkinState
from rps_jax.trials import trial

PAPER = RPSParams.paper()
OBSERVATION = Observation(
    jnp.zeros(2), jnp.zeros(()), jnp.array([0.36, 0.0]), jnp.array(True), jnp.array([2.0, 0.0])
)
TWO_OF_THREE = SkinState(
    jax.random.key(0), jnp.zeros(3), jnp.zeros(2), jnp.ones(3, bool)
)  # the gain of one taxel is missing


def chain(error):
    """Return the texts of an error and of its causes."""
    return [str(error), *(chain(error.__context__) if error.__context__ else [])]


# Fields of an observation with values of another shape or type.
WRONG = {
    "p_world_robot": jnp.zeros(3),
    "yaw": jnp.zeros(1),
    "p_robot_contact": jnp.zeros((1, 2)),
    "in_contact": jnp.zeros((), int),
    "p_world_target": np.zeros(2, int),
    "period": jnp.zeros(2),
}


@pytest.mark.parametrize("field", WRONG)
def test_a_law_refuses_observations_of_another_shape_or_type(field):
    state = RPSState.init(PAPER)
    rps.step(PAPER, state, OBSERVATION)
    with pytest.raises(TypeCheckError, match="typechecking parameter 'obs'") as caught:
        rps.step(PAPER, state, OBSERVATION._replace(**{field: WRONG[field]}))
    assert f"Observation.{field} is " in " ".join(chain(caught.value))


def test_a_law_sees_batched_worlds_as_single_worlds():
    """`jax.vmap` hides the axis; without it the law refuses the batch."""
    batch = jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * 3), OBSERVATION)
    assert jax.vmap(rps.displacement)(batch).shape == (3, 2)
    with pytest.raises(TypeCheckError, match="typechecking parameter 'obs'"):
        rps.displacement(batch)


CALLS = [
    lambda: planar.rotate(jnp.zeros(2), jnp.zeros((3, 2))),
    lambda: fp.place(fp.circle(0.1), jnp.zeros(3), jnp.zeros(())),
    lambda: fp.circumradius(fp.Footprint(jnp.zeros((4, 3)), jnp.zeros(()))),
    lambda: rps.saturate(PAPER, Twist(jnp.zeros(2), jnp.zeros(3), jnp.zeros(2))),
    lambda: trial.object_pose(jnp.zeros(9)),
    lambda: IdealSkin().sense(TWO_OF_THREE, fp.circle(0.1), 0.02),
]


@pytest.mark.parametrize("call", CALLS)
def test_functions_refuse_arrays_that_do_not_go_together(call):
    with pytest.raises(TypeCheckError, match="whilst checking the parameters"):
        call()
