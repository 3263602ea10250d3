"""The study of gradients: its measures by hand, and a small study that resumes."""

import re
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from rps_jax.errors import InputError
from sweeps.gradients import study as gradients
from sweeps.gradients.study import Gradients


def samples(**gradients):
    """Gradients (n, 2) of two parameters in n worlds at one horizon, by measurement."""
    dims = {"truth": "truth_world"}
    variables = {
        name: (
            (dims.get(name, "world"), "parameter", "horizon"),
            np.array(values, float)[..., None],
        )
        for name, values in gradients.items()
    }
    return xr.Dataset(variables, {"parameter": ["L", "K_h"], "horizon": [1.0]})


def compare(measured, *names, clip=2.0):
    compared = gradients.compare(measured, names, clip)
    xr.testing.assert_identical(compared[list(measured)], measured)
    return compared


def test_the_measures_by_hand():
    measured = samples(
        truth=[[2.0, 0.1], [2.0, -0.1]],
        # The bound on a world is 4, twice the median of the norms 1, 2, 2 and 90.
        reverse=[[0.0, 1.0], [2.0, 0.0], [-2.0, 0.0], [0.0, -90.0]],
        forward=1e25 * np.array([[-1.0, 0.0], [-3.0, 0.0], [-1.0, 0.0], [-3.0, 0.0]]),
        evolution=[[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 1.0]],
    )
    names = ("reverse", "clipped", "forward", "evolution", "combined")
    judged = compare(measured, *names).isel(horizon=0)
    cosine = dict(zip(names, judged.cosine.values, strict=True))
    assert cosine["reverse"] == pytest.approx(0, abs=1e-6)  # mean (0, -89 / 4)
    assert cosine["clipped"] == pytest.approx(0, abs=1e-6)  # mean (0, -3 / 4)
    assert cosine["forward"] == pytest.approx(-1)
    assert cosine["evolution"] == pytest.approx(np.sqrt(0.5))  # mean (1 / 2, 1 / 2)
    # Entry by entry, reverse has the variances 2 / 3 and 507.2, evolution 1 / 12 in both.
    weight = np.array([1 / (1 + 8), 1 / (1 + 12 * 507.2)])
    mean = weight * [0, -22.25] + (1 - weight) * 0.5
    assert cosine["combined"] == pytest.approx(mean[0] / np.hypot(*mean), rel=1e-3)
    assert float(judged.doubt) == pytest.approx(0.05)  # sqrt(0 + 0.01) / 2
    assert judged.low.sel(estimator="forward") == pytest.approx(-1)
    head, first, *_, last = gradients.table(compare(measured, "evolution", "reverse", "forward"))
    assert first[:2] == ["evolution", ""]
    assert first[head.index("1 s")].startswith("0.71 [0.00, 1.00]")
    assert last[:3] == ["forward", "", "-1.00 [-1.00, -1.00]"]


def test_a_cosine_without_a_sign_is_undecided():
    random = np.random.default_rng(2)
    noise, drift = random.normal(size=(2, 64, 2))
    results = compare(samples(truth=drift + np.array([3, 0]), reverse=noise, forward=noise + 1),
                      "reverse", "forward")  # fmt: skip
    head, noisy, decided = gradients.table(results)
    column = head.index("1 s")
    assert noisy[column].endswith("], undecided")
    assert re.fullmatch(r"0\.\d\d \[0\.\d\d, 0\.\d\d\]", decided[column])


def test_a_cosine_of_one_dominant_world_is_undecided():
    """Its interval is narrow, since every resample without that world has the next in line."""
    random = np.random.default_rng(4)
    true, drawn = random.normal(size=(2, 64, 2)) + np.array([3, 0])
    heavy = drawn * 2.0 ** np.arange(64)[:, None]
    results = compare(
        samples(truth=true, reverse=heavy, forward=drawn), "reverse", "forward", "clipped"
    )
    assert (results.low > 0).all()
    assert results.decided.values[:, 0].tolist() == [False, True, True]


def test_the_interval_of_a_cosine_holds_the_true_one():
    """The mean directions are 60 degrees apart; both have noise."""
    random, inside = np.random.default_rng(3), []
    ways = np.array([[0.8, 0], [0.4, 0.4 * 3**0.5]])
    for _ in range(60):
        true, drawn = random.normal(size=(2, 100, 2))
        results = compare(samples(truth=true + ways[0], forward=drawn + ways[1]),
                          "forward")  # fmt: skip
        inside.append(results.low.item() <= 0.5 <= results.high.item())
    assert 0.8 <= np.mean(inside) <= 0.99


SIZES = {"worlds": 2, "truth": 6, "tuned": ("K_h", "L"), "horizons": (4.0, 8.0)}
SMALL = Gradients(("evolution",), object="random_cylinder", engine="quasistatic", **SIZES)


def test_a_study_resumes_and_refuses_other_options(tmp_path, monkeypatch):
    """The quasi-static model compiles fastest."""
    names, measured = [], gradients._measure
    recorded = lambda *args: names.append(args[1]) or measured(*args)  # noqa: E731
    monkeypatch.setattr(gradients, "_measure", recorded)
    results = replace(SMALL, out=tmp_path)()
    xr.testing.assert_identical(results, replace(SMALL, out=tmp_path)())
    assert names == ["truth", "evolution"]  # each ran once
    more = replace(SMALL, estimators=("evolution", "forward"), out=tmp_path)
    assert more.measurements == ("truth", "evolution", "forward")
    assert results.evolution.sizes == {"world": 2, "parameter": 2, "horizon": 2}
    assert results.truth.sizes["truth_world"] == 6
    assert (np.abs(results.cosine) <= 1 + 1e-6).all()
    assert (results.doubt > 0).all()
    with pytest.raises(InputError, match="seed = 0 there, 1 asked for"):
        replace(SMALL, seed=1, out=tmp_path)()
