"""The study of gradients: its measures by hand, and a small one that is continued."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from rps_jax.errors import InputError
from sweeps.gradients import study as gradients
from sweeps.gradients.study import Gradients


def estimates(gradients, variance=0.0, finite=1.0):
    """Of two parameters at one horizon: gradients (R, 2)."""
    gradient = np.array(gradients, float)[:, :, None]
    dims = ("repeat", "parameter", "horizon")
    return xr.Dataset(
        {
            "gradient": (dims, gradient),
            "variance": (dims, np.full_like(gradient, variance)),
            "finite": (dims, np.full_like(gradient, finite)),
        },
        {"parameter": ["L", "K_h"], "horizon": [1.0]},
    )


def test_the_measures_by_hand():
    found = {
        "truth": estimates([[2.0, 0.0]], variance=0.02),
        # Along the truth, and across it: cosines 1 and 0, mean (2, 1), off by 1 of 2.
        "reverse": estimates([[4.0, 0.0], [0.0, 2.0]], variance=0.5, finite=0.75),
        "forward": estimates([[-1.0, 0.0], [-3.0, 0.0]]),
    }
    judged = gradients.judged(found, ("reverse", "forward")).isel(horizon=0)
    one, other = (judged.sel(estimator=name) for name in ("reverse", "forward"))
    assert (float(one.cosine), float(one.least_cosine), float(one.greatest_cosine)) == (0.5, 0, 1)
    assert float(one.bias) == pytest.approx(0.5)
    assert float(one.error) == pytest.approx(0.5)  # sqrt(0.5 + 0.5) / 2
    assert float(one.finite) == pytest.approx(0.75)
    assert float(other.cosine) == -1
    assert float(other.bias) == pytest.approx(2.0)
    assert float(judged.doubt) == pytest.approx(0.1)  # sqrt(0.02 + 0.02) / 2
    rows = gradients.table(gradients.judged(found, ("reverse", "forward")))
    assert rows[1][:3] == ["reverse", "cosine", "0.50"]
    assert len(rows) == 1 + 2 * 4 + 1


def test_a_study_without_sense_is_refused():
    for bad in (
        {"object": "box"},
        {"horizons": (2.0, 1.0)},
        {"horizons": ()},
        {"worlds": 1},
        {"delta": 0.0},
    ):
        with pytest.raises(InputError):
            Gradients(**bad).validate()


SMALL = Gradients(
    ("evolution",),
    object="random_cylinder",
    tuned=("K_h", "L"),
    horizons=(4.0, 8.0),
    worlds=2,
    repeats=2,
    truth=6,
    engine="quasistatic",
)


def test_a_study_is_continued_and_is_of_one_kind(tmp_path, monkeypatch):
    """On the quasi-static model, to compile little."""
    asked = []
    measured = gradients._measured

    def noted(study, name, found):
        asked.append(name)
        return measured(study, name, found)

    monkeypatch.setattr(gradients, "_measured", noted)
    results = replace(SMALL, out=tmp_path)()
    assert asked == ["truth", "evolution"]
    again = replace(SMALL, out=tmp_path)()
    assert asked == ["truth", "evolution"]
    xr.testing.assert_identical(results, again)
    assert (results.finite == 1).all()
    assert (np.abs(results.cosine) <= 1 + 1e-6).all()
    assert (results.doubt > 0).all()
    with pytest.raises(InputError, match="seed = 0 there, 1 asked for"):
        replace(SMALL, seed=1, out=tmp_path)()
