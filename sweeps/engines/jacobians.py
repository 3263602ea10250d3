"""Do dense and sparse Jacobians give the same accelerations? In C MuJoCo alone, of any version.

A base on a velocity servo pushes boxes that stand and lie on each other, from the same state with
either Jacobian at each step.

    python sweeps/engines/jacobians.py
"""

import itertools

import mujoco
import numpy as np

SCENE = """<mujoco><option cone="{cone}" impratio="10" jacobian="{jacobian}" iterations="100"
tolerance="1e-12" timestep="0.005"><flag island="{island}"/></option><worldbody>
<geom type="plane" size="5 5 .1"/>{boxes}<body pos="-.6 .05 .2"><joint name="x" type="slide"
axis="1 0 0"/><joint type="slide" axis="0 1 0" damping="100"/><joint type="hinge" axis="0 0 1"
damping="50"/><geom type="box" size=".2 .4 .15" mass="50"/></body></worldbody>
<actuator><velocity joint="x" kv="5000"/></actuator></mujoco>"""
BOX = """<body pos="{x} {y} {z}"><freejoint/><geom type="box" size=".15 .14 .15" pos=".02 .01 0"
mass="{mass}"/></body>"""


def difference(cone: str, island: str, count: int) -> float:
    """Greatest relative difference of the accelerations in 3 s of pushing `count` boxes."""
    boxes = "".join(
        BOX.format(x=0.05 * k, y=0.13 * k - 0.05 * count, z=0.16 + 0.31 * (k % 3), mass=5 + k)
        for k in range(count)
    )
    texts = [
        SCENE.format(cone=cone, island=island, boxes=boxes, jacobian=jacobian)
        for jacobian in ("dense", "sparse")
    ]
    models = [mujoco.MjModel.from_xml_string(text) for text in texts]
    dense, sparse = (mujoco.MjData(model) for model in models)
    dense.ctrl[0] = sparse.ctrl[0] = 0.3
    worst = 0.0
    for _ in range(600):
        sparse.qpos[:], sparse.qvel[:] = dense.qpos, dense.qvel
        sparse.qacc_warmstart[:] = dense.qacc_warmstart
        mujoco.mj_step(models[0], dense)
        mujoco.mj_step(models[1], sparse)
        error = np.abs(dense.qacc - sparse.qacc).max() / (1 + np.abs(dense.qacc).max())
        worst = max(worst, float(error))
    return worst


if __name__ == "__main__":
    print(f"MuJoCo {mujoco.__version__}")
    for case in itertools.product(("elliptic", "pyramidal"), ("enable", "disable"), (1, 4, 12)):
        print(*case, f"{difference(*case):.1e}")
