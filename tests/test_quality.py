"""The study of gradients: its measures by hand, and a small study that resumes."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from rps_jax.errors import InputError
from sweeps.gradients import study as gradients
from sweeps.gradients.study import Gradients


def estimates(gradients, variance=0.0, finite=1.0):
    """Estimates of gradients (R, 2) of two parameters at one horizon."""
    gradient = np.array(gradients, float)[:, :, None]
    fields = {"gradient": gradient, "variance": 0 * gradient + variance,
              "finite": 0 * gradient + finite}  # fmt: skip
    dims = ("repeat", "parameter", "horizon")
    labels = {"parameter": ["L", "K_h"], "horizon": [1.0]}
    return xr.Dataset({name: (dims, field) for name, field in fields.items()}, labels)


def test_the_measures_by_hand():
    results = {
        "truth": estimates([[2.0, 0.0]], variance=0.02),
        # Along and across the truth: cosines 1 and 0, mean (2, 1), an error of 1 of 2.
        "reverse": estimates([[4.0, 0.0], [0.0, 2.0]], variance=0.5, finite=0.75),
        "forward": estimates([[-1.0, 0.0], [-3.0, 0.0]]),
    }
    judged = gradients.compare(results, ("reverse", "forward")).isel(horizon=0)
    reverse, forward = (judged.sel(estimator=name) for name in ("reverse", "forward"))
    assert float(reverse.cosine) == 0.5
    assert float(reverse.bias) == pytest.approx(0.5)
    assert float(reverse.error) == pytest.approx(0.5)  # sqrt(0.5 + 0.5) / 2
    assert float(reverse.finite) == pytest.approx(0.75)
    assert float(forward.cosine) == -1
    assert float(forward.bias) == pytest.approx(2.0)
    assert float(judged.doubt) == pytest.approx(0.1)  # sqrt(0.02 + 0.02) / 2
    rows = gradients.table(gradients.compare(results, ("reverse", "forward")))
    assert rows[1][:3] == ["reverse", "cosine", "0.50"]
    assert len(rows) == 1 + 2 * 4 + 1


SIZES = {"worlds": 2, "repeats": 2, "truth": 6, "tuned": ("K_h", "L"), "horizons": (4.0, 8.0)}
SMALL = Gradients(("evolution",), object="random_cylinder", engine="quasistatic", **SIZES)


def test_a_study_resumes_and_refuses_other_options(tmp_path, monkeypatch):
    """The quasi-static model compiles fastest."""
    names, measured = [], gradients._measure
    recorded = lambda *args: names.append(args[1]) or measured(*args)  # noqa: E731
    monkeypatch.setattr(gradients, "_measure", recorded)
    results = replace(SMALL, out=tmp_path)()
    xr.testing.assert_identical(results, replace(SMALL, out=tmp_path)())
    assert names == ["truth", "evolution"]  # each ran once
    assert (results.finite == 1).all()
    assert (np.abs(results.cosine) <= 1 + 1e-6).all()
    assert (results.doubt > 0).all()
    with pytest.raises(InputError, match="seed = 0 there, 1 asked for"):
        replace(SMALL, seed=1, out=tmp_path)()
