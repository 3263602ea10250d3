"""The arena: its scene, its initial poses, and runs of several engines."""

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from rps_jax.world import scene
from sweeps.speed import arena


def test_the_exported_scene_equals_that_of_the_engines():
    theirs, ours = mujoco.MjModel.from_xml_string(arena.mjcf()), scene.load("box").physics
    assert (theirs.nq, theirs.nv, theirs.ngeom, theirs.npair) == (10, 9, 3, 2)
    for kind in ("body", "geom", "jnt", "dof", "pair"):
        looks = ("geom_matid", "body_sameframe")
        for name in (n for n in dir(ours) if n.startswith(f"{kind}_") and n not in looks):
            assert_allclose(getattr(theirs, name), getattr(ours, name), err_msg=name)
    for name in ("timestep", "cone", "impratio", "iterations", "ls_iterations", "tolerance"):
        assert getattr(theirs.opt, name) == getattr(ours.opt, name)


def test_initial_poses_touch_the_base_without_overlap():
    starts = arena.initial_poses(20)
    model = scene.load("box").physics
    data = mujoco.MjData(model)
    for qpos in starts:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        near = mujoco.mj_geomDistance(model, data, 1, 2, 1.0, None)
        assert near == pytest.approx(0.0, abs=1e-5)
    assert np.ptp(starts[:, 4]) > 0.1  # they differ


@pytest.mark.slow
def test_engines_are_accurate_and_missing_ones_give_a_reason(tmp_path):
    names = ("C MuJoCo, rollout", "one process a trial", "fused", "MuJoCo Warp")
    race = arena.Arena(names, (4,), seconds=0.5, starts=2, step=1e-3, out=tmp_path / "run")
    results = race()
    rows = {row.engine.item(): row for row in (results.isel(row=i) for i in range(len(names)))}
    for name in names[:3]:
        row = rows[name]
        assert row.rate > 0
        assert row.worlds == 4
        assert row.error <= row.largest < 4e-3  # [m], of 25 mm
        assert row.turned < 0.01
    absent = rows["MuJoCo Warp"]
    assert np.isnan(absent.rate)
    assert absent.why.item() == "mujoco_warp is not installed"
    assert arena.table(results)[-1][0] == "MuJoCo Warp"
    stored = {path.name.rpartition("-")[0] for path in (tmp_path / "run" / "parts").glob("*.nc")}
    assert stored == {"converged", "C_MuJoCo_rollout_4", "one_process_a_trial_4", "fused_4"}
