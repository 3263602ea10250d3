"""The gallery of failures: failure modes, common quantities, and maps."""

import numpy as np
import xarray as xr
from helpers import results_of, rps

import rps_jax
from rps_jax.studies import gallery


def outcomes(**changes):
    """Four worlds: a success, a timeout near the target, one far from it, and no contact."""
    columns = dict.fromkeys(("diverged", "tipped", "stalled", "contact_lost_time"), [0] * 4)
    columns |= {"success": [1, 0, 0, 0], "min_distance": [0.04, 0.19, 0.21, np.inf]}
    return results_of(**columns | changes)


def test_each_failure_has_one_mode():
    modes = gallery.failure_modes(outcomes(), 150.0).tolist()
    far = "timeout far from the target"
    assert modes == ["", "timeout near the target", far, "never touched"]
    # A fall has precedence over lost contact, and a success over all failure modes.
    changes = {"tipped": [1, 1, 0, 0], "contact_lost_time": [0, 200, 200, 0]}
    fallen = gallery.failure_modes(outcomes(**changes), 150.0).tolist()
    assert fallen == ["", "fell over", "lost contact", "never touched"]


def test_common_quantities_differ_from_all_worlds():
    random = np.random.default_rng(0)
    size, mass = random.uniform(size=400), random.uniform(size=400)
    trials = xr.Dataset({"size": ("world", size), "mass": ("world", mass)})
    ((name, masked, overall),) = gallery.common_quantities(trials, size > 0.8)
    assert name == "size"
    assert abs(masked - 0.9) < 0.03
    assert abs(overall - 0.5) < 0.1
    assert gallery.common_quantities(trials, np.arange(400) < 2) == []  # too few worlds


def test_the_command_plots_each_mode_and_prints_a_replay_command(tmp_path, capsys):
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
