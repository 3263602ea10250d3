"""The package does not change MJX for other code in the process."""

import subprocess
import sys

NEIGHBOUR = """
import contextlib, io
with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx
    from mujoco.mjx._src import collision_driver
import jax, mujoco, numpy as np

CYLINDER = '<mujoco><worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 .499">'\
    '<freejoint/><geom type="cylinder" size=".3 .5"/></body></worldbody></mujoco>'

def others():
    model = mujoco.MjModel.from_xml_string(CYLINDER)
    data = jax.jit(mjx.step)(mjx.put_model(model), mjx.make_data(model))
    return np.concatenate([data.qpos, data.qvel]).tobytes().hex()
"""
ALONE = NEIGHBOUR + "print(others())"
TOGETHER = (
    NEIGHBOUR
    + """
before = dict(collision_driver._COLLISION_FUNC)
import rps_jax
few = {"targets": [(1.0, 0.0)], "objects": ["cylinder"], "friction": ["S1"]}
setting = rps_jax.Setting("mjx", rules=rps_jax.Rules(horizon=0.1))
rps_jax.table("rps", **few, setting=setting)
assert collision_driver._COLLISION_FUNC == before
print(others())
"""
)


def test_a_cylinder_of_another_program_falls_unchanged():
    """Bit for bit, after this package stepped a cylinder with MJX in the same process."""

    def output_of(code):
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.split()[-1]

    assert output_of(TOGETHER) == output_of(ALONE)
