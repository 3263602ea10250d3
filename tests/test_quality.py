"""The race of tuners: its measures by hand."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from helpers import observation
from numpy.testing import assert_allclose

from rps_jax import InputError
from rps_jax.laws import law_of, resolve_law
from rps_jax.questions import Run
from rps_jax.trials.progress import no_progress
from sweeps import study_base
from sweeps.gradients import race


def test_the_best_validation_within_a_budget_is_tested():
    columns = {"validation": [0.4, 0.3, 0.2, 0.1], "simulated": [10.0, 10.0, 20.0, 20.0]}
    columns |= {"run": [1.0, 10.0, 1.0, 1.0], "params.L": [1, 2, 3, 4]}
    curve = pd.DataFrame(columns)
    for budget, L, wall in ((40.0, 4, 12.0), (25.0, 3, 11.0), (1.0, 1, 0.0)):
        best = race.best_within(curve, budget)
        assert (race.law_of(best).L, best.wall) == (L, wall)
    law = race.law_of(pd.Series({"params.l_cr": 0.12}))
    assert law.l_mr == law.l_cr == 0.12  # a fixed l_mr follows a tuned l_cr


def test_the_table_has_intervals_over_the_seeds():
    """Derivatives succeed in 3 and 4 of 4 worlds, slopes in 2 and 3, the start in 2."""
    success = np.array([[[1, 1, 1, 0], [1, 1, 0, 0]], [[1, 1, 1, 1], [1, 1, 1, 0]]], np.int8)
    dims, methods = ("count", "seed", "method"), ["derivatives", "slopes"]
    variables = {
        "success": ((*dims, "budget", "world"), success[None, :, :, None]),
        "score": ((*dims, "budget", "world"), 1.0 - success[None, :, :, None]),
        "start_success": (("count", "world"), [[1, 1, 0, 0]]),
        "start_score": (("count", "world"), [[0.0, 0.0, 1.0, 1.0]]),
        "wall": ((*dims, "budget"), [[[[5.0], [8.0]], [[7.0], [8.0]]]]),
    }
    coords = {"count": [64], "seed": [1, 2], "method": methods, "budget": [1e5]}
    start, first, second = race.table(xr.Dataset(variables, coords))
    assert start[:6] == ["64", "", "start", 50.0, None, 0.5]
    assert first[1:3] == ["100,000 s", "derivatives"]
    half = 12.7062 * 12.5  # of Student's t with 1 degree of freedom
    assert_allclose(first[3], [87.5, 87.5 - half, 87.5 + half], rtol=1e-4)
    assert first[5:] == [0.125, None, "75.0, 100.0", 6.0]
    assert_allclose(second[4:7:2], [[25.0] * 3, [0.25] * 3])


def test_runs_of_other_budgets_are_not_joined(monkeypatch):
    parts = {"a": 1e5, "b": 2e5}
    monkeypatch.setattr(study_base, "load", lambda x: xr.Dataset(coords={"budget": [parts[x]]}))
    with pytest.raises(InputError, match=r"runs = .* options differ"):
        race.Race(runs=("a", "b")).answer(Run(None, no_progress))


@pytest.mark.parametrize(("name", "law"), [("Table64", "rps"), ("Plus64", "rps_plus")])
def test_a_constant_table_multiplies_the_parameters(name, law):
    table, params = (resolve_law(x)[1] for x in (f"sweeps/gradients/tables.py:{name}", law))
    rps = getattr(params, "law", params)
    changed = rps._replace(eta=2 * rps.eta, K_h=0.5 * rps.K_h)
    expected = params._replace(law=changed) if rps is not params else changed
    table = table._replace(eta=table.eta + np.log(2.0), K_h=table.K_h - np.log(2.0))
    obs, twists = observation((0.5, 0.1), 0.4, (0.36, 0.12), True, (2.0, 1.0)), []
    for law_params in (table, expected):
        functions = law_of(law_params)
        twists.append(functions.step(law_params, functions.init(law_params), obs)[1])
    assert_allclose(*twists, rtol=1e-5)
