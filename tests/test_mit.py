"""The study of pushes of the MIT push dataset, on files in its format."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from helpers import refusing
from numpy.testing import assert_allclose
from scipy.io import savemat

from rps_jax.engines.finger import check_outline
from sweeps.real_pushes.mit import study

COUNT = 7


@pytest.fixture
def clone(tmp_path):
    """A folder with one file of pushes and one of shapes, other than the dataset's."""
    logs = tmp_path / study.LOGS
    logs.mkdir(parents=True)
    poses = ("init_pose_gt", "final_pose_gt", "final_pose_sim")
    record = np.zeros(COUNT, [(x, object) for x in (*poses, "init_tip_pt", "final_tip_pt")])
    for i in range(COUNT):
        ends = [np.full(3, i + x) for x in (0.0, 0.1, 0.2)]
        record[i] = (*ends, np.ones(2), np.full(2, 2.0))
    savemat(logs / "abs_rect1_poly4_v10.mat", {"record_all": record})
    shapes = tmp_path / study.SHAPES
    shapes.parent.mkdir()
    angle = 2 * np.pi * np.arange(300) / 300
    rows = "; ".join(f"[{0.05 * np.cos(a):.6f}, {0.05 * np.sin(a):.6f}]" for a in angle)
    shapes.write_text(f"elseif strcmp(shape_id,'butter') shape = [{rows}];")
    return tmp_path


def test_pushes_are_read(clone, monkeypatch):
    monkeypatch.setattr(study, "checked", lambda folder, name: (folder / name).read_bytes())
    cell = study.read(clone, "abs rect1 10")
    assert cell.pushes.path.shape == (COUNT, 2, 2)
    assert_allclose(cell.pushes.end - cell.pushes.start, 0.1)
    assert_allclose(cell.published - cell.pushes.start, 0.2)
    for name in study.NAMES:
        check_outline(study.outline_of(name, clone))


def test_other_files_are_refused(clone):
    with refusing("another SHA-256"):
        study.read(clone, "abs rect1 10")
    with refusing("lacks"):
        study.Mit(data=clone / "elsewhere").validate()


def test_the_table_has_medians_and_coverage():
    dims = ("cell", "estimator", "draw", "push")
    shape = (1, len(study.METHODS), 1, 4)
    place = np.broadcast_to(np.array([1e-3, 2e-3, 3e-3, np.nan]), shape)
    columns = dict.fromkeys(("place", "turn"), (dims, place))
    columns |= {f"{x}_ratio": (dims, 500 * place) for x in ("place", "turn")}
    results = xr.Dataset(columns, {"cell": ["abs hex 10"], "estimator": list(study.METHODS)})
    table, by_cell = study.Mit().report_tables(results)
    assert table.rows[1][:4] == ["all", "best published", "3", "2.00 mm"]
    assert table.rows[1][-1] == "33 %"
    assert len(by_cell.rows) == 1 + len(study.METHODS)


def test_a_clean_split_trains_on_the_pushes_that_it_does_not_test(clone, monkeypatch):
    """Test pushes are the middle parts of pushes of the cell, in another order."""
    rng = np.random.default_rng(0)
    start, way = rng.uniform(0, 0.3, (8, 2)), rng.normal(size=(8, 2))
    way *= 0.05 / np.linalg.norm(way, axis=1)[:, None]
    path, pose = np.stack([start, start + way], axis=1), rng.normal(size=(8, 3))
    whole = study.Cell(np.eye(3, 2), study.Pushes(path, pose, pose), pose)
    chosen = np.array([6, 1, 3])
    inner = np.stack([start + 0.06 * way, start + 0.94 * way], axis=1)[chosen]
    test = study.Cell(np.eye(3, 2), study.Pushes(inner, pose[chosen], pose[chosen]), pose[chosen])
    monkeypatch.setattr(study, "_logs", lambda *_: test)
    assert study._clean_split(clone, "abs hex 10", whole)[1].tolist() == [0, 2, 4, 5, 7]


def test_the_triangle_stands_flat_or_on_its_feet():
    for name, count in (("triangle_flat", None), ("triangle_wide", 3)):
        cell = study.read(Path(), f"CMU-plywood {name} 2")
        assert cell.pushes.path.shape == (50, 2, 2)
        assert (cell.feet is None) if count is None else (len(cell.feet) == count)
        assert len(study._unbroken(cell, np.arange(50))) == 50


def test_intervals_are_scaled_by_the_errors_of_other_objects():
    dims, ratio = ("cell", "estimator", "draw", "push"), np.ones((3, 1, 1, 50))
    ratio[1] = 2.0
    columns = {"place_ratio": (dims, ratio), "turn_ratio": (dims, ratio)}
    labels = ["abs hex 10", "abs tri1 10", "plywood hex 10"]
    scaled = study._scaled(xr.Dataset(columns, {"cell": labels})).place_ratio
    assert_allclose(scaled[:, 0, 0, 0], [0.5, 2.0, 1.0])
