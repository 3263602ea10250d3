"""The arena's engines push the same boxes, and one that is not there says so."""

import mujoco
import numpy as np
import pytest

from rps_jax.world import scene
from sweeps.speed import arena


def test_the_file_of_the_scene_is_the_scene_that_the_engines_step():
    theirs, ours = mujoco.MjModel.from_xml_string(arena.mjcf()), scene.load("box").physics
    assert (theirs.nq, theirs.nv, theirs.ngeom, theirs.npair) == (10, 9, 3, 2)
    for kind in ("body", "geom", "jnt", "dof", "pair"):
        looks = ("geom_matid", "body_sameframe")
        for name in (n for n in dir(ours) if n.startswith(f"{kind}_") and n not in looks):
            np.testing.assert_allclose(getattr(theirs, name), getattr(ours, name), err_msg=name)
    for name in ("timestep", "cone", "impratio", "iterations", "ls_iterations", "tolerance"):
        assert getattr(theirs.opt, name) == getattr(ours.opt, name)


def test_starts_touch_the_base_and_no_more():
    starts = arena.initial_poses(20)
    model = scene.load("box").physics
    data = mujoco.MjData(model)
    for qpos in starts:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        near = mujoco.mj_geomDistance(model, data, 1, 2, 1.0, None)
        assert near == pytest.approx(0.0, abs=1e-5)
    assert np.ptp(starts[:, 4]) > 0.1  # they differ


def test_engines_are_right_and_what_is_not_installed_says_so(tmp_path):
    names = ("C MuJoCo, rollout", "one process a trial", "fused", "MuJoCo Warp")
    race = arena.Arena(names, (4,), seconds=0.5, starts=2, step=1e-3, out=tmp_path / "run")
    found = race()
    rows = {one.engine.item(): one for one in (found.isel(row=i) for i in range(len(names)))}
    for name in names[:3]:
        one = rows[name]
        assert one.rate > 0
        assert one.worlds == 4
        assert one.error <= one.largest < 4e-3  # [m], of 25 mm
        assert one.turned < 0.01
    absent = rows["MuJoCo Warp"]
    assert np.isnan(absent.rate)
    assert absent.why.item() == "mujoco_warp is not installed"
    assert arena.table(found)[-1][0] == "MuJoCo Warp"
    kept = {path.name.rpartition("-")[0] for path in (tmp_path / "run" / "parts").glob("*.nc")}
    assert kept == {"converged", "C_MuJoCo_rollout_4", "one_process_a_trial_4", "fused_4"}
