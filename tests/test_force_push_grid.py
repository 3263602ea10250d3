"""Force Push in the experiment of its authors: their grid and the results of their law."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers import refusals

from rps_jax.control.base import check_finite_leaves
from rps_jax.errors import InputError
from sweeps.force_push_grid import grid
from sweeps.force_push_grid.study import ForcePushGrid


def test_the_grid_equals_that_of_the_authors_script():
    cells = grid.cells()
    assert cells.angle.size == 3**5 == 243
    assert len(set(zip(*cells, strict=True))) == 243
    assert check_finite_leaves(grid.PARAMS) is grid.PARAMS


def test_the_moments_of_inertia_by_hand():
    """A uniform plate of 1 kg and 1 m has 1/6 and 1/8 kg m^2; at the edge 1/2 and 1/4."""
    box, drum = grid.moments("box"), grid.moments("cylinder")
    np.testing.assert_allclose(box[:, 2], (1 / 12, 1 / 6, 1 / 2))
    np.testing.assert_allclose(drum[:, 2], (1 / 16, 1 / 8, 1 / 4))
    np.testing.assert_allclose(box[1, :2], (1 + 0.12**2) / 12)
    np.testing.assert_allclose(drum[1, :2], (3 * 0.5**2 + 0.12**2) / 12)
    np.testing.assert_allclose(drum[2, :2], (6 * 0.5**2 + 0.12**2) / 12)


def test_the_pusher_starts_behind_its_contact_point():
    cells = grid.cells()
    for slider in grid.SLIDERS:
        qpos = grid.starts(slider, cells)
        away = qpos[:, :2] + (0.5, 0.0) - qpos[:, 3:5]  # from the middle to the point of contact
        if slider == "cylinder":
            np.testing.assert_allclose(np.hypot(*away.T), 0.5)
            continue
        c, s = np.cos(cells.angle), np.sin(cells.angle)
        np.testing.assert_allclose(c * away[:, 0] + s * away[:, 1], -0.5)
        np.testing.assert_allclose(-s * away[:, 0] + c * away[:, 1], cells.contact, atol=1e-12)
    yaw = 2 * np.arctan2(qpos[:, 9], qpos[:, 6])
    np.testing.assert_allclose(np.unique(yaw.round(9)), np.round((-math.pi / 8, 0, math.pi / 8), 9))


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
    np.testing.assert_array_equal(again.completion, results.completion)
    with pytest.raises(InputError, match=r"duration = 60\.0 there, 50\.0 asked for"):
        replace(question, duration=50.0)()


test_invalid_options_of_the_grid_are_refused = refusals(
    lambda **options: ForcePushGrid(**options)(),
    ({"laws": ("none",)}, "unknown laws 'none'"),
    ({"sliders": ("prism",)}, "unknown sliders 'prism'"),
    ({"duration": 0.0}, "duration"),
    ({"engine": "quasistatic"}, "computes no contact force"),
    ({"engine": "mujoco"}, "JAX must trace it"),
)
