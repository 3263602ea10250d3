"""The package does not change MJX for other code in the process."""

import sys

import pytest
from helpers import output_of

PROGRAM = """
import contextlib, io
with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx
    from mujoco.mjx._src import collision_driver
import jax, mujoco, numpy as np

CYLINDER = '<mujoco><worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 .499">'\\
    '<freejoint/><geom type="cylinder" size=".3 .5"/></body></worldbody></mujoco>'

def others():
    jax.clear_caches()
    model = mujoco.MjModel.from_xml_string(CYLINDER)
    data = jax.jit(mjx.step)(mjx.put_model(model), mjx.make_data(model))
    return np.concatenate([data.qpos, data.qvel]).tobytes().hex()

functions, alone = dict(collision_driver._COLLISION_FUNC), others()
import rps_jax
few = {"targets": [(1.0, 0.0)], "objects": ["cylinder"], "friction": ["S1"]}
setting = rps_jax.Setting("mjx", rules=rps_jax.Rules(horizon=0.1))
rps_jax.table("rps", **few, setting=setting)
assert collision_driver._COLLISION_FUNC == functions
assert others() == alone
"""


@pytest.mark.slow
def test_a_cylinder_of_another_program_falls_unchanged():
    """Bit for bit, after this package stepped a cylinder with MJX in the same process."""
    output_of(sys.executable, "-c", PROGRAM)
