"""The study of real pushes: laws that its models obey, and its data."""

import json

import numpy as np
import pytest
import xarray as xr
from helpers import ROOT

from rps_jax.errors import InputError
from sweeps.real_pushes import contact, pushes, sliding, study
from sweeps.real_pushes.pushes import COM, OUTLINE, turned
from sweeps.real_pushes.sliding import Ground
from sweeps.real_pushes.study import predict

FEET = np.array([[0.03, 0.03], [0.09, 0.03], [0.03, 0.09]])
GROUND = Ground((FEET - COM)[None], np.ones((1, 3)), np.zeros(1), np.zeros(1))
STEPS = 30
FOLDER = ROOT / "sweeps" / "real_pushes"


@pytest.fixture(scope="module")
def sample():
    """Ten pushes of each kind."""
    whole = pushes.read()
    return whole.groupby("kind").head(10).reset_index(drop=True)


def pushed(ways, pose=(0.0, 0.0, 0.0), friction=0.5):
    """Return pose and force of one push by fingers (F, 2) [m] along a vector (2,) [m].

    Fingers and vector are in the body's frame at the start.
    """
    start, way, pose = (np.array(x, float) for x in (*ways, pose))
    if len(start) == 1:
        start = np.concatenate([start, start + 100.0])
    share = np.linspace(0, 1, STEPS + 1)[:, None, None]
    path = turned(np.full((STEPS + 1, 2), pose[2]), start + share * way) + pose[:2]
    result = sliding.push(OUTLINE, COM, GROUND, path[:, None], pose[None], np.array([friction]))
    return result.pose[:, 0], result.force[:, 0]


UPWARDS = ([[0.025, -0.001], [0.075, -0.001]], (0.0, 0.02))  # two fingers about the centroid's x


@pytest.mark.parametrize("friction", [0.05, 0.5])
def test_two_fingers_through_the_centre_of_friction_translate(friction):
    """The feet bear a third each, and fingers at equal distances hold it straight."""
    pose, force = pushed(UPWARDS, friction=friction)
    assert pose[-1] == pytest.approx([0.0, 0.019, 0.0], abs=2e-5)
    assert force[-1] == pytest.approx([0.0, 1.0], abs=2e-3)  # the friction mu m g


def test_an_off_centre_finger_turns_the_object_with_less_than_its_weight():
    pose, force = pushed(([[0.1, -0.001]], (0.0, 0.02)))
    assert pose[-1, 2] > 0.05
    assert 0.1 < np.linalg.norm(force[-1]) < 0.95


def test_a_finger_stays_in_its_cone_and_outside():
    mu, way = 0.3, ([[0.07, -0.002]], (0.02, 0.02))
    pose, force = pushed(way, friction=mu)
    along, across = (
        np.sum(force * turned(pose[:-1, 2], np.array(axis)), 1) for axis in ([0.0, 1.0], [1.0, 0.0])
    )
    touching = along > 1e-6
    assert touching.sum() > STEPS / 2
    assert (np.abs(across[touching]) <= mu * along[touching] * (1 + 1e-6)).all()
    assert across[touching][-1] == pytest.approx(mu * along[touching][-1], rel=0.01)  # it slides
    p_object_finger = turned(-pose[-1, 2], np.array([0.09, 0.018]) - pose[-1, :2])
    gap, _ = sliding.nearest(OUTLINE, p_object_finger)
    assert abs(gap) < 3e-4


SIDEWAYS = ([[0.1, -0.001]], (0.004, 0.02))


def test_feet_move_with_the_pose():
    """Moving and turning a push moves and turns its result."""
    pose = (0.3, -0.2, 2.0)
    first, second = (pushed(SIDEWAYS, pose=x)[0] for x in ((0, 0, 0), pose))
    expected = turned(np.full(len(first), 2.0), first[:, :2]) + pose[:2]
    np.testing.assert_allclose(second[:, :2], expected, atol=1e-6)
    np.testing.assert_allclose(second[:, 2], first[:, 2] + 2.0, atol=1e-5)


def test_feet_bear_the_weight_about_its_centre():
    at = np.array([[[0.1, 0.0], [-0.1, 0.1], [-0.1, -0.1], [0.0, 0.02]]])
    weight, centre = np.array([[1.0, 2.0, 1.0, 0.5]]), np.array([[0.01, 0.02]])
    load = sliding.supported_load(at, weight, centre)
    assert load.sum() == pytest.approx(1)
    assert (load >= 0).all()
    np.testing.assert_allclose(np.einsum("bs,bsi->bi", load, at), centre, atol=1e-12)


def test_nearest_is_the_edge_or_the_corner():
    points = np.array([[0.05, -0.01], [-0.03, -0.04], [0.1, 0.1], [0.05, 0.05]])
    gap, normal = sliding.nearest(OUTLINE, points)
    root = np.sqrt(0.5)
    np.testing.assert_allclose(gap, [0.01, 0.05, 0.05 * root, -0.05 * root], atol=1e-12)
    np.testing.assert_allclose(normal, [[0, -1], [-0.6, -0.8], [root, root], [root, root]],
                               atol=1e-12)  # fmt: skip


def test_the_data_agree_with_their_page():
    table = pushes.read()
    assert len(table) == 1271
    assert table.id.is_unique
    assert table.kind.value_counts().to_dict() == {
        "two_point_rotation": 683, "point": 548, "two_point_translation": 40,
    }  # fmt: skip
    assert np.isfinite(pushes.measured(table)).all()
    assert "Apache License" in (FOLDER / "data" / "LICENSE-MLab_EXP.txt").read_text()
    assert sum(path.stat().st_size for path in (FOLDER / "data").iterdir()) < 1.5e6
    with np.load(FOLDER / "data" / "force.npz") as force:
        assert force["force"].dtype == np.float32
        assert np.isin(force["id"], table.id).all()
        assert force["force"].shape == (force["id"].size, force["share_of_time"].size, 2)
        # The table's means are those of the second half of the way.
        late = force["force"][:, force["share_of_time"] >= 0.5].mean(axis=1)
        table_mean = table.set_index("id").loc[force["id"], ["force_wx", "force_wy"]].to_numpy()
        assert np.median(np.linalg.norm(late - table_mean, axis=1)) < 0.1


def test_fingers_start_outside_and_end_at_the_pushed_object(sample):
    way = pushes.finger_paths(sample, STEPS)
    pre, post = pushes.initial_poses(sample), pushes.measured(sample)
    for pose, finger, low, high in ((pre, way[0], 2e-4, 5e-3), (post, way[-1], -2e-3, 6e-3)):
        p_object_finger = turned(-pose[:, None, 2], finger - pose[:, None, :2])
        gap = sliding.nearest(OUTLINE, p_object_finger)[0].min(axis=1)
        assert (gap > low).all()
        assert (gap < high).all()


def test_a_rigid_body_on_its_feet_is_nearest(sample):
    actual = pushes.measured(sample)

    def median(model):
        prediction = predict(sample, model, steps=STEPS)
        pose = np.stack([prediction[f"post_{name}"].values for name in pushes.POSE], axis=1)
        return float(np.median(pushes.errors_of(pose, actual).both))

    feet = median("rigid_feet")
    assert feet < 2.5e-3
    assert 1.5 * feet < median("rigid_corners") < median("no_motion")
    assert 3 * feet < median("with_pusher") < median("no_motion")


def test_mujoco_with_stiff_fingers_comes_near_the_rigid_body(sample):
    subset = sample[sample.support != pushes.FLAT].groupby("kind").head(2).reset_index(drop=True)
    rigid = predict(subset, "rigid_feet")
    soft = predict(subset, "mujoco_ours_stiff")
    for name, near in (("x", 2e-3), ("y", 2e-3), ("yaw", 0.03)):
        off = np.abs(rigid[f"post_{name}"] - soft[f"post_{name}"])
        assert float(off.median()) < near
    assert contact.KINDS["mujoco_ours"].scale == 4


def test_a_prediction_accepts_files_and_datasets_without_final_poses(sample, tmp_path):
    names = [name for name in sample if name.startswith(("post_", "gap", "force"))]
    inputs, path = sample.drop(columns=names), tmp_path / "kept.csv"
    inputs.to_csv(path, index=False)
    first = predict(sample, "ellipsoid", steps=10)
    for table in (path, str(path), inputs, inputs.to_xarray()):
        again = predict(table, "ellipsoid", steps=10)
        np.testing.assert_allclose(again.post_yaw, first.post_yaw, rtol=1e-12)
    assert list(first.id.values) == list(sample.id)


def test_an_invalid_table_is_refused(sample):
    for table, model, message in (
        (sample.drop(columns="edge"), "rigid_feet", "lack the column edge, which kind = two_point"),
        (sample.assign(pre_yaw=np.nan), "rigid_feet", "pre_yaw = nan in row 0 is not allowed"),
        (sample.assign(support="round"), "rigid_feet", "support = round is not allowed"),
        (sample.assign(usable=0), "rigid_feet", "without a usable row"),
        (sample, "rigid", "unknown model 'rigid'"),
    ):
        with pytest.raises(InputError, match=message):
            predict(table, model)


def test_errors_by_hand():
    measured = np.array([0.0, 0.0, 0.0])
    about = np.array([*(COM - turned(np.array(0.2), COM)), 0.2])  # turned about the centroid
    off = pushes.errors_of(np.stack([about, np.array([0.003, 0.004, 0.0])]), measured)
    np.testing.assert_allclose(off.place, [0, 5e-3], atol=1e-12)
    np.testing.assert_allclose(off.turn, [0.2, 0], atol=1e-12)
    # Over the area of the triangle, root of the mean square.
    grid = np.random.default_rng(0).random((200_000, 2))
    grid = 0.15 * grid[grid.sum(axis=1) < 1]
    moved = turned(np.full(len(grid), 0.2), grid) + about[:2]
    truth = np.sqrt(np.mean(np.sum((moved - grid) ** 2, axis=1)))
    assert off.both[0] == pytest.approx(truth, rel=0.01)
    assert off.both[1] == pytest.approx(5e-3)


def test_a_small_study_resumes_and_lists_every_model(tmp_path):
    models = ("no_motion", "rigid_feet", "mujoco_ours")
    options = {"out": tmp_path / "run", "progress": False}
    question = study.RealPushes(models=models, few=10, mujoco=1, **options)
    results = question()
    again = question()
    assert results.drop_attrs().identical(again.drop_attrs())
    assert set(study.tables(results)) == {"models", "mujoco", "friction", "layouts", "forces"}
    ran = np.isfinite(results.predicted.sel(model="mujoco_ours")).all("pose")
    assert ran.any()
    assert not (results.fits & ran).any()
    lines = (tmp_path / "run" / "predictions.csv").read_text().splitlines()
    assert lines[0] == "id,model,post_x,post_y,post_yaw"
    assert len(lines) == 1 + int(np.isfinite(results.both).sum())


def test_a_layout_is_judged_with_the_friction_of_the_others():
    """Layout a fits best with 0.2, layout b with 0.4; each is evaluated with both values."""
    both = np.repeat([[1.0, 4.0], [3.0, 2.0]], 3, axis=1) / 1e3  # [m] at 0.2 and 0.4
    off = (("fitted", "tried", "few"), both[None])
    labels = {"fitted": ["rigid_feet"], "tried": [0.2, 0.4], "few_support": ("few", list("aaabbb")),
              "few_finger": ("few", ["point"] * 6)}  # fmt: skip
    results = xr.Dataset({"few_both": off, "few_place": off, "few_turn": off}, labels)
    judged = [(row[1], row[4], row[7][0], row[8]) for row in study._layout_rows(results)]
    assert judged == [("a", 0.4, 3.0, 1.0), ("b", 0.2, 4.0, 2.0)]


def test_the_published_friction_is_that_of_predictions():
    data = json.loads((FOLDER / "results" / "real_pushes_friction.json").read_text())
    fitted = {row[0]: row[2] for row in data["rows"] if row[1] == study.WORDS["rigid_feet"]}
    assert fitted == study.FRICTION
    assert "Apache-2.0" in (FOLDER / "data" / "README.md").read_text()
