"""The study of gradients: its measures by hand, and a small study that resumes."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from helpers import refusing
from numpy.random import default_rng
from numpy.testing import assert_allclose

from rps_jax.trials.setting import Setting
from sweeps.gradients import check, network, race
from sweeps.gradients import study as gradients
from sweeps.gradients.learner import WindowLearner
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


def rows(results):
    """Return the table of one object."""
    return gradients.table(results.expand_dims(object=["random_box"]))


def test_the_measures_by_hand():
    measured = samples(
        truth=[[2.0, 0.1], [2.0, -0.1]],
        # The bound on a world is 4, twice the median of the norms 1, 2, 2 and 90.
        exact=[[0.0, 1.0], [2.0, 0.0], [-2.0, 0.0], [0.0, -90.0]],
        forward=1e25 * np.array([[-1.0, 0.0], [-3.0, 0.0], [-1.0, 0.0], [-3.0, 0.0]]),
        evolution=[[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 1.0]],
    )
    names = ("exact", "clipped", "forward", "evolution", "mixed")
    judged = compare(measured, *names).isel(horizon=0)
    cosine = dict(zip(names, judged.cosine.values, strict=True))
    assert cosine["exact"] == pytest.approx(0, abs=1e-6)  # mean (0, -89 / 4)
    assert cosine["clipped"] == pytest.approx(0, abs=1e-6)  # mean (0, -3 / 4)
    assert cosine["forward"] == pytest.approx(-1)
    assert cosine["evolution"] == pytest.approx(np.sqrt(0.5))  # mean (1 / 2, 1 / 2)
    # The variances are 2 / 3 + 507.2 and 2 / 12; the means are no two standard errors apart.
    weight = (1 / 6) / (1 / 6 + 2 / 3 + 507.2)
    mean = weight * np.array([0, -22.25]) + (1 - weight) * 0.5
    assert cosine["mixed"] == pytest.approx(mean[0] / np.hypot(*mean), rel=1e-3)
    assert judged.error.sel(estimator="clipped") == pytest.approx(np.hypot(2, 0.75) / 2)
    assert judged.error.sel(estimator="forward") == pytest.approx(1e25)
    assert float(judged.doubt) == pytest.approx(0.05)  # sqrt(0 + 0.01) / 2
    assert judged.low.sel(estimator="forward") == pytest.approx(-1)
    head, first, *_, last, _ = rows(compare(measured, "evolution", "exact", "forward"))
    assert first[:2] == ["boxes", "evolution"]
    assert first[head.index("1 s")].startswith("0.71 [0.00, 1.00]")
    assert last == ["boxes", "forward", "-1.00 [-1.00, -1.00]"]


def test_derivatives_are_compared_in_each_world():
    slopes = [[0.0, 1.0], [2.0, 0.0], [-2.0, 0.0], [0.0, -90.0], [0.0, 0.0]]
    truth = [[0.0, 1.0], [2.0, 0.0], [-2.0, 0.0], [0.0, -100.0], [0.0, 0.0]]
    results = check.Check().combine(samples(exact=slopes, differences=truth))
    assert_allclose(results.error[:, 0], [0.0, 0.0, 0.0, 0.1, np.nan])
    _, median, right, *_, largest = check.table(results.expand_dims(object=["random_box"]))
    assert median == ["boxes", "median error", "0.0e+00"]
    assert right == ["boxes", "share of worlds with an error below 1 %", "0.75"]
    assert largest[-1] == "9.0e+01"


def test_the_best_validation_within_a_budget_is_tested():
    columns = {"validation": [0.4, 0.3, 0.2, 0.1], "simulated": [10.0, 10.0, 20.0, 20.0]}
    columns |= {"run": [1.0, 10.0, 1.0, 1.0], "params.L": [1, 2, 3, 4]}
    curve = pd.DataFrame(columns)
    choices = {("simulated", 40.0): 3, ("simulated", 25.0): 2, ("wall", 11.5): 2, ("wall", 0.1): 1}
    for (budget, amount), L in choices.items():
        assert race.law_of(race.best_within(curve, budget, amount)).L == L
    law = race.law_of(pd.Series({"params.l_cr": 0.12}))
    assert law.l_mr == law.l_cr == 0.12  # a fixed l_mr follows a tuned l_cr


def test_a_learner_by_gradients_needs_derivatives():
    for options, message in (
        ({"estimator": "none"}, "unknown estimator 'none'"),
        ({"setting": Setting("mujoco")}, "engine = mujoco is not allowed"),
    ):
        with refusing(message):
            WindowLearner(**options).validate()


def test_learning_curves_are_summed_up_by_hand(tmp_path):
    """The second racer was killed before its first checkpoint."""
    columns = {"time": [30.0, 90.0, 180.0], "validation": [0.1, np.nan, 0.375], "level": [0.2] * 3}
    columns |= {"simulated": [1.0, 2.0, 3600.0], "touching": [0.5] * 3}
    curve = xr.Dataset({k: ("update", x) for k, x in columns.items()}, attrs={"test_success": 0.25})
    curves = {"ppo": curve, "windows": network.read_curve(tmp_path)}
    rows = [network.summary(x).assign(method=k, seed=1) for k, x in curves.items()]
    results = xr.concat(rows, xr.IndexVariable("run", ["a", "b"]), join="outer")
    results = results.assign_coords(time=list(network.TIMES))
    assert network.table(results)[1:] == [
        [
            "ppo",
            "1",
            "10.0 %",
            "10.0 %",
            "37.5 %",
            "",
            "",
            "25.0 % [20.9, 29.6]",
            "20 %",
            "0.5 min",
            "3",
            "75.00 s",
            "1 h",
            "50 %",
        ],
        ["windows", "1", *[""] * 8, "0", "", "0 h", ""],
    ]
    network.figure_of(results)


def test_a_cosine_without_a_sign_is_undecided():
    random = default_rng(2)
    noise, drift = random.normal(size=(2, 64, 2))
    results = compare(
        samples(truth=drift + np.array([3, 0]), exact=noise, forward=noise + 1), "exact", "forward"
    )
    head, noisy, decided, _ = rows(results)
    column = head.index("1 s")
    assert noisy[column].endswith("], undecided")
    assert re.fullmatch(r"0\.\d\d \[0\.\d\d, 0\.\d\d\]", decided[column])


def test_a_cosine_of_one_dominant_world_is_undecided():
    """Its interval is narrow, since every resample without that world has the next in line."""
    random = default_rng(4)
    true, drawn = random.normal(size=(2, 64, 2)) + np.array([3, 0])
    heavy = drawn * 2.0 ** np.arange(64)[:, None]
    results = compare(
        samples(truth=true, exact=heavy, forward=drawn), "exact", "forward", "clipped"
    )
    assert (results.low > 0).all()
    assert results.decided.values[:, 0].tolist() == [False, True, True]


def test_the_interval_of_a_cosine_holds_the_true_one():
    """The mean directions are 60 degrees apart; both have noise."""
    random, inside = default_rng(3), []
    ways = np.array([[0.8, 0], [0.4, 0.4 * 3**0.5]])
    for _ in range(60):
        true, drawn = random.normal(size=(2, 100, 2))
        results = compare(samples(truth=true + ways[0], forward=drawn + ways[1]), "forward")
        inside.append(results.low.item() <= 0.5 <= results.high.item())
    assert 0.8 <= np.mean(inside) <= 0.99


SIZES = {"worlds": 2, "truth": 6, "tuned": ("K_h", "L"), "horizons": (4.0, 8.0)}
SMALL = Gradients(("evolution",), objects=("random_cylinder",), engine="quasistatic", **SIZES)


def test_a_study_resumes_and_refuses_other_options(tmp_path, monkeypatch):
    """The quasi-static model compiles fastest."""
    names, measured = [], gradients._measure
    recorded = lambda *args: names.append(args[2]) or measured(*args)  # noqa: E731
    monkeypatch.setattr(gradients, "_measure", recorded)
    results = replace(SMALL, out=tmp_path)()
    xr.testing.assert_identical(results, replace(SMALL, out=tmp_path)())
    assert names == ["truth", "evolution"]  # each ran once
    more = replace(SMALL, estimators=("evolution", "forward"), out=tmp_path)
    assert more.measurements == ("truth", "evolution", "forward")
    assert results.evolution.sizes == {"object": 1, "world": 2, "parameter": 2, "horizon": 2}
    assert results.truth.sizes["truth_world"] == 6
    assert (np.abs(results.cosine) <= 1 + 1e-6).all()
    assert (results.doubt > 0).all()
    with refusing("seed = 0 there, 1 asked for"):
        replace(SMALL, seed=1, out=tmp_path)()
