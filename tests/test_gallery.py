"""The gallery of losses: their kinds, what they have in common, and their maps."""

import numpy as np
import xarray as xr
from helpers import refusal, rps

import rps_jax
from rps_jax.studies import gallery as galleries


def outcomes(**changed):
    """Four worlds: a success, two timeouts of which one came near, and one that was not touched."""
    usual = {
        "success": [1, 0, 0, 0], "diverged": [0] * 4, "tipped": [0] * 4, "stalled": [0] * 4,
        "min_distance": [0.04, 0.19, 0.21, np.inf], "contact_lost_time": [0.0] * 4,
    }  # fmt: skip
    return xr.Dataset({name: ("world", np.array(v)) for name, v in (usual | changed).items()})


def test_each_loss_is_of_one_kind():
    found = galleries.kinds(outcomes(), 150.0).tolist()
    far = "timeout far from the target"
    assert found == ["", "timeout near the target", far, "never touched"]
    # To fall over comes first; then a loss of contact; a success is a success whatever happened.
    fell = galleries.kinds(outcomes(tipped=[1, 1, 0, 0], contact_lost_time=[0, 200, 200, 0]), 150.0)
    assert fell.tolist() == ["", "fell over", "lost contact", "never touched"]
    assert set(found + fell.tolist()) - {""} <= set(galleries.MECHANISMS)


def test_what_losses_have_in_common_is_what_differs_from_all_worlds():
    random = np.random.default_rng(0)
    size, mass = random.uniform(size=400), random.uniform(size=400)
    one = xr.Dataset({"size": ("world", size), "mass": ("world", mass)})
    found = galleries.in_common(one, size > 0.8)
    assert [name for name, *_ in found] == ["size"]
    _, mine, usual = found[0]
    assert abs(mine - 0.9) < 0.03
    assert abs(usual - 0.5) < 0.1
    assert galleries.in_common(one, np.arange(400) < 2) == []  # too few to tell


def test_the_command_draws_each_kind_and_says_how_to_see_one_again(tmp_path, capsys):
    run = tmp_path / "run"
    brief = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=1.0))
    drums, laws = rps_jax.Domain(("random_cylinder",)), {"mine law": "rps"}
    rps_jax.sweep(laws, drums, 3, setting=brief, slots=3, out=run)
    assert rps("gallery", run, "--each", 2) == 0
    text = capsys.readouterr().out
    assert "never touched: 3 of 3" in text
    assert f"rps replay {run} 0 --law 'mine law'`" in text
    picture = run / "gallery" / "never_touched.png"
    assert picture.stat().st_size > 10_000
    assert "unknown law of the run 'yours'" in refusal(capsys, "gallery", run, "--law", "yours")
    assert "each = 0" in refusal(capsys, "gallery", run, "--each", 0)
