"""The study of pushes of the MIT push dataset, on files in its format."""

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
