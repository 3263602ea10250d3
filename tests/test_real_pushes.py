"""The study of real pushes: its data, its models and its tables."""

import json

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from helpers import ROOT, refusing
from numpy.random import default_rng
from numpy.testing import assert_allclose

from rps_jax.geometry.solid import rotate
from sweeps.real_pushes import contact, fingers, pushes, study
from sweeps.real_pushes.pushes import COM, OUTLINE

STEPS = 30
FOLDER = ROOT / "sweeps" / "real_pushes"


@pytest.fixture(scope="module")
def sample():
    """Ten pushes of each kind."""
    whole = pushes.read()
    return whole.groupby("kind").head(10).reset_index(drop=True)


def test_the_data_agree_with_their_page():
    table = pushes.read()
    assert len(table) == 1271
    assert table.id.is_unique
    assert table.kind.value_counts().to_dict() == {
        "two_point_rotation": 683,
        "point": 548,
        "two_point_translation": 40,
    }
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
        p_object_finger = rotate(-pose[:, None, 2], finger - pose[:, None, :2])
        gap = fingers.nearest(OUTLINE, p_object_finger)[0].min(axis=1)
        assert (gap > low).all()
        assert (gap < high).all()


def test_a_rigid_body_on_its_feet_is_nearest(sample):
    actual = pushes.measured(sample)

    def median(model):
        pose = study.predict_all(sample, model, steps=STEPS).pose
        return float(np.median(pushes.errors_of(pose, actual).both))

    feet = median("rigid_feet")
    assert feet < 4.2e-3
    assert 1.5 * feet < median("rigid_corners") < median("no_motion")
    assert 3 * feet < median("with_pusher") < median("no_motion")


def test_mujoco_with_stiff_fingers_comes_near_the_rigid_body(sample):
    subset = sample[sample.support != pushes.FLAT].groupby("kind").head(2).reset_index(drop=True)
    rigid, soft = (study.predict_all(subset, x).pose for x in ("rigid_feet", "mujoco_ours_stiff"))
    median = np.median(np.abs(rigid - soft), axis=0)
    assert_allclose(median / [2e-3, 2e-3, 0.03], 0, atol=1)
    assert contact.KINDS["mujoco_ours"].scale == 4


def test_a_table_may_be_a_file_or_a_dataset_without_final_poses(sample, tmp_path):
    names = [name for name in sample if name.startswith(("post_", "gap", "force"))]
    inputs, path = sample.drop(columns=names), tmp_path / "pushes.csv"
    inputs.to_csv(path, index=False)
    first = study.predict_all(sample, "ellipsoid", steps=10).pose
    for table in (path, str(path), inputs, inputs.to_xarray()):
        again = study.predict_all(pushes.read(table), "ellipsoid", steps=10).pose
        assert_allclose(again, first, rtol=1e-12)
    assert np.isnan(pushes.measured(pushes.read(path))).all()


def test_an_invalid_table_is_refused(sample):
    for table, message in (
        (sample.drop(columns="edge"), "lack the column edge, which kind = two_point"),
        (sample.assign(pre_yaw=np.nan), "pre_yaw = nan in row 0 is not allowed"),
        (sample.assign(support="round"), "support = round is not allowed"),
        (sample.assign(usable=0), "without a usable row"),
    ):
        with refusing(message):
            pushes.read(table)


def test_errors_by_hand():
    measured = np.array([0.0, 0.0, 0.0])
    about = np.array([*(COM - rotate(np.array(0.2), COM)), 0.2])  # turned about the centroid
    off = pushes.errors_of(np.stack([about, np.array([0.003, 0.004, 0.0])]), measured)
    assert_allclose(off.place, [0, 5e-3], atol=1e-12)
    assert_allclose(off.turn, [0.2, 0], atol=1e-12)
    # Over the area of the triangle, root of the mean square.
    grid = default_rng(0).random((200_000, 2))
    grid = 0.15 * grid[grid.sum(axis=1) < 1]
    moved = rotate(np.full(len(grid), 0.2), grid) + about[:2]
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
    assert set(study.tables(results)) == {
        "models",
        "mujoco",
        "friction",
        "layouts",
        "series",
        "heading",
        "forces",
    }
    ran = np.isfinite(results.predicted.sel(model="mujoco_ours")).all("pose")
    assert ran.any()
    assert not (results.fits & ran).any()
    lines = (tmp_path / "run" / "predictions.csv").read_text().splitlines()
    assert lines[0] == "id,model,post_x,post_y,post_yaw"
    assert len(lines) == 1 + int(np.isfinite(results.both).sum())


def validated(values, tried, layouts, series):
    """Return errors of samples (tried, sample) [m] with the friction of other layouts."""
    off = (("fitted", "tried", "sample"), np.asarray(values)[None])
    count = len(layouts)
    labels = {
        "support": list(layouts),
        "series": list(series),
        "finger": ["point"] * count,
        "group": [study.GROUPS[0]] * count,
    }
    coordinates = {f"sample_{name}": ("sample", x) for name, x in labels.items()}
    coordinates |= {"fitted": ["rigid_feet"], "tried": tried}
    names = ("sample_place", "sample_turn", "sample_both")
    return study._validated(xr.Dataset(dict.fromkeys(names, off), coordinates))


def test_a_layout_is_judged_with_the_friction_of_the_others():
    """Layout a fits best with 0.2, layout b with 0.4; each is evaluated with both values."""
    both = np.repeat([[1.0, 4.0], [3.0, 2.0]], 3, axis=1) / 1e3  # [m] at 0.2 and 0.4
    rows = list(study._layout_rows(validated(both, [0.2, 0.4], "aaabbb", "aaabbb")))
    assert [(row[1], row[4], row[5][0], row[-1]) for row in rows] == [
        ("a", 0.4, 3.0, 1.0),
        ("b", 0.2, 4.0, 2.0),
    ]


def test_a_new_series_lies_in_its_interval():
    """Seven series with lognormal medians predict the eighth in 95 % of the draws."""
    rng = default_rng(0)
    inside = []
    for _ in range(400):
        *known, new = np.exp(rng.normal(0.3, 0.5, (8, 4)))
        low, high = np.transpose(study.new_interval(known))
        inside.append((low < new) & (new < high))
    assert 0.93 < np.mean(inside) < 0.97
    assert study.new_interval(np.ones((2, 4))) == [None] * 4


def test_the_interval_over_layouts_is_wider_than_that_over_pushes():
    """Layouts whose errors differ more than those of their pushes."""
    rng = default_rng(0)
    off = np.exp(rng.normal(0, 0.1, 400) + np.repeat([0.0, 0.5, 0.1, 0.9], 100)) / 1e3
    rows = validated(off[None], [0.4], np.repeat(list("abcd"), 100), np.repeat(list("efgh"), 100))
    series = [[study._errors_in(x)] for _, x in rows.groupby("layout")]
    drawn = [study._summary(x)[0] for x in study._resampled(series)]
    low, high = np.quantile(drawn, [0.025, 0.975])
    _, near_low, near_high = study.median_interval(rows.place.to_numpy())
    assert high - low > 3 * (near_high - near_low)
    assert low < rows.place.median() < high


def test_repetitions_are_pushes_with_the_same_command(sample):
    table = pushes.read()
    action = pushes.actions(table)
    assert (action >= 0).sum() == 119
    assert set(table.kind[action >= 0]) == {"two_point_rotation"}
    counts = pd.Series(action[action >= 0]).value_counts()
    assert set(counts) == {2, 3}
    rows = pushes.chosen(table, action == counts.index[0])
    # The same motion from elsewhere is the same push.
    initial = pushes.initial_poses(rows)
    moved = np.column_stack([rotate(initial[:, 2], np.full((len(rows), 2), 0.01)), initial[:, 2]])
    measured = np.column_stack([initial[:, :2], np.zeros(len(rows))]) + moved
    results = xr.Dataset(
        {
            "initial": (("push", "pose"), initial),
            "measured": (("push", "pose"), measured),
            "action": ("push", np.zeros(len(rows), int)),
        }
    )
    off, repeated = pushes.repetitions(results)
    assert_allclose(off, 0, atol=1e-12)
    assert list(repeated) == list(range(len(rows)))


INTERVALS = {
    "point, three feet": {"place": 0.85, "turn": 0.35},
    "two-point, three feet": {"place": 1.62, "turn": 0.74, "both, 90 %": 5.65},
}  # [mm, degrees] errors of pushes that are not in the data


def test_the_published_intervals_cover_pushes_outside_of_the_data():
    data = json.loads((FOLDER / "results" / "real_pushes_series.json").read_text())
    names = [column["name"] for column in data["columns"]]
    rows = {row[0]: row for row in data["rows"] if row[1] == study.WORDS["rigid_feet"]}
    for group, values in INTERVALS.items():
        for name, value in values.items():
            low, high = rows[group][names.index(name) + 1]
            assert low < value < high


def test_the_published_friction_is_that_of_predictions():
    data = json.loads((FOLDER / "results" / "real_pushes_friction.json").read_text())
    fitted = {row[0]: row[2] for row in data["rows"] if row[1] == study.WORDS["rigid_feet"]}
    assert fitted == study.FRICTION
    assert "Apache-2.0" in (FOLDER / "data" / "README.md").read_text()
