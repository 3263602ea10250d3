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
        # Along and across the truth: cosines 1 and 0.
        "reverse": estimates([[4.0, 0.0], [0.0, 2.0]], variance=0.5, finite=0.75),
        "forward": estimates([[-1.0, 0.0], [-3.0, 0.0]]),
    }
    judged = gradients.compare(results, ("reverse", "forward")).isel(horizon=0)
    reverse, forward = (judged.sel(estimator=name) for name in ("reverse", "forward"))
    assert float(reverse.cosine) == 0.5
    assert float(forward.cosine) == -1
    assert float(judged.doubt) == pytest.approx(0.1)  # sqrt(0.02 + 0.02) / 2
    head, first, last = gradients.table(gradients.compare(results, ("reverse", "forward")))
    assert first[head.index("1 s")] == "0.50"
    assert last[:3] == ["forward", "", "-1.00"]


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
    assert (np.abs(results.cosine) <= 1 + 1e-6).all()
    assert (results.doubt > 0).all()
    with pytest.raises(InputError, match="seed = 0 there, 1 asked for"):
        replace(SMALL, seed=1, out=tmp_path)()
