"""Force Push in the experiment of its authors: their grid and the results of their law."""

import math
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from helpers import refusals, refusing
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax.control.base import check_finite_leaves
from sweeps.force_push_grid import grid, paths
from sweeps.force_push_grid.study import ForcePushGrid


def test_the_grid_equals_that_of_the_authors_script():
    cells = grid.cells()
    assert cells.angle.size == 3**5 == 243
    assert len(set(zip(*cells, strict=True))) == 243
    assert check_finite_leaves(grid.PARAMS) is grid.PARAMS


def test_the_moments_of_inertia_by_hand():
    """A uniform plate of 1 kg and 1 m has 1/6 and 1/8 kg m^2; at the edge 1/2 and 1/4."""
    box, drum = grid.moments("box"), grid.moments("cylinder")
    assert_allclose(box[:, 2], (1 / 12, 1 / 6, 1 / 2))
    assert_allclose(drum[:, 2], (1 / 16, 1 / 8, 1 / 4))
    assert_allclose(box[1, :2], (1 + 0.12**2) / 12)
    assert_allclose(drum[1, :2], (3 * 0.5**2 + 0.12**2) / 12)
    assert_allclose(drum[2, :2], (6 * 0.5**2 + 0.12**2) / 12)


def test_the_pusher_starts_behind_its_contact_point():
    cells = grid.cells()
    for slider in grid.SLIDERS:
        qpos = grid.starts(slider, cells)
        away = qpos[:, :2] + (0.5, 0.0) - qpos[:, 3:5]  # from the middle to the point of contact
        if slider == "cylinder":
            assert_allclose(np.hypot(*away.T), 0.5)
            continue
        c, s = np.cos(cells.angle), np.sin(cells.angle)
        assert_allclose(c * away[:, 0] + s * away[:, 1], -0.5)
        assert_allclose(-s * away[:, 0] + c * away[:, 1], cells.contact, atol=1e-12)
    yaw = 2 * np.arctan2(qpos[:, 9], qpos[:, 6])
    assert_allclose(np.unique(yaw.round(9)), np.round((-math.pi / 8, 0, math.pi / 8), 9))


@pytest.mark.slow
def test_the_law_returns_all_boxes_to_the_path_and_open_loop_loses_most(tmp_path, monkeypatch):
    """Boxes start up to 0.4 m off the path and follow it for 6 m in 60 s."""
    question = ForcePushGrid(sliders=("box",), duration=60.0, out=tmp_path)
    results = question()
    theirs, alone = (results.sel(law=law, slider="box") for law in grid.LAWS)
    assert int(theirs.success.sum()) == 243
    assert int(alone.success.sum()) < 30
    assert float(theirs.completion.min()) > 0.75
    assert float(abs(theirs.deviation).max()) < 1.0 < float(theirs.apart.max()) < 1.2
    assert float(alone.completion.median()) < 0.3
    _, row, _ = grid.table(results)
    assert row[:4] == ["force_push", "box", "243 of 243", "81, 81, 81"]
    monkeypatch.setattr(grid, "run_grid", lambda *_, **__: pytest.fail("run again"))
    again = question()  # read, not run
    assert_array_equal(again.completion, results.completion)
    with refusing(r"duration = 60\.0 there, 50\.0 asked for"):
        replace(question, duration=50.0)()


test_invalid_options_of_the_grid_are_refused = refusals(
    lambda **options: ForcePushGrid(**options)(),
    ({"laws": ("none",)}, "unknown laws 'none'"),
    ({"sliders": ("prism",)}, "unknown sliders 'prism'"),
    ({"duration": 0.0}, "duration"),
    ({"engine": "quasistatic"}, "computes no contact force"),
    ({"engine": "mujoco"}, "JAX must trace it"),
)


def test_a_curve_is_that_of_the_authors_script():
    """Their corner leads from (3, 0) by a quarter of a circle about (3, 2) to (5, 2)."""
    points = grid.curve(2.0, 12.0)
    lengths = np.hypot(*np.diff(points, axis=0).T)
    assert lengths.sum() == pytest.approx(12.0, abs=1e-3)
    assert_allclose(points[[0, 1, -2]], [(0, 0), (3, 0), (5, 2)], atol=1e-12)
    assert_allclose(np.hypot(*(points[1:-1] - (3, 2)).T), 2.0)
    assert points[-1] == pytest.approx((5.0, 2 + 9 - math.pi))
    assert_array_equal(grid.curve(math.inf, 12.0), [(0, 0), (12, 0)])


def test_each_law_has_its_better_lookahead():
    shape = (len(paths.LOOKAHEADS), len(paths.RADII), 2, 2, 9)
    success, error = np.zeros(shape, int), np.full(shape, 0.3)
    success[0, :, :, 0, :6] = success[1, :, :, 1, :3] = 1
    error[:, 0] = np.nan  # no contact
    dims = ("lookahead", "path", "slider", "law", "world")
    coords = {"path": list(paths.RADII), "slider": list(grid.SLIDERS), "law": ["a", "b"]}
    columns = {"success": (dims, success), "error_mean": (dims, error)}
    base = xr.Dataset(columns, coords)
    point = base.isel(lookahead=0, law=0, drop=True)
    by_law = paths.best_lookaheads(xr.DataTree.from_dict({"point": point, "base": base}))
    assert list(by_law) == [paths.POINT, "a, 0.6 m", "b, 1.6 m"]
    header, *rows = paths.table(by_law)
    assert len(rows) == 3 * len(paths.RADII)
    assert len(header) == len(rows[0])
    assert rows[1][2].startswith("66.7 %")
    assert rows[1][3] == "30 [30, 30]"
    assert rows[0][3] == "nan [nan, nan]"


@pytest.mark.slow
def test_the_law_follows_a_curve_with_a_point():
    """The point follows a turn of 2 m radius; none of the boxes is lost."""
    results = grid.run_grid("force_push", "box", duration=90.0, radius=2.0)
    assert int(results.success.sum()) == 243
    assert 0.5 < float(results.completion.mean()) < 0.9
    assert float(results.error_mean.median()) < float(results.error_95.median()) < 3.0
