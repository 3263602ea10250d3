"""Trade-offs of parameters: candidates along lines and between sets, and the Pareto front."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax.control.laws.rps import BOUNDS, RPSParams
from rps_jax.trials.setting import seed_of
from rps_jax.trials.trial import Outcome
from rps_jax.tuning.space import SUBSETS, Space
from sweeps.landscape import candidates, study
from sweeps.landscape.candidates import Aims
from sweeps.landscape.study import Landscape

FULL = SUBSETS["full"]
SETS = {"paper": RPSParams.paper(), "tuned": RPSParams.tuned()}


def outcomes(**known):
    """Return outcomes with the fields that the study reads."""
    return Outcome(**dict.fromkeys(Outcome._fields) | known)


def test_aims_by_hand():
    outcome = outcomes(
        success=np.array([[1, 1, 1, 0], [0, 0, 0, 0]], bool),
        time=np.array([[10.0, 30, 20, 300], [300, 300, 300, 300]], np.float32),
        path_length=np.array([[1.0, 2, 6, 9], [9, 9, 9, 9]], np.float32),
    )
    result = candidates.aims(outcome)
    assert result.success.tolist() == [0.75, 0.0]
    assert_array_equal(result.time, [20, np.nan])
    assert_array_equal(result.path, [2, np.nan])


def test_the_undominated_by_hand():
    result = Aims(
        success=np.array([0.9, 0.8, 0.9, 0.7, 0.95, 0.9]),
        time=np.array([60.0, 50.0, 61.0, 55.0, np.nan, 60.0]),
        path=np.array([3.0, 3.5, 3.0, 3.6, 1.0, 3.0]),
    )
    # The third is slower than the first, the fourth worse than the second in all, the fifth never
    # measured; the last equals the first, and neither beats the other.
    assert candidates.undominated(result).tolist() == [True, True, False, False, False, True]


def test_a_line_varies_one_parameter_within_its_bounds_and_no_other():
    base = RPSParams.tuned()
    grid = candidates.lines(base, FULL, 5)
    for i, name in enumerate(FULL):
        for second in RPSParams._fields:
            values = np.asarray(getattr(grid, second))[i]
            if second == name:
                assert (np.diff(values) > 0).all()
                bound = BOUNDS[name]
                owner = bound.relative_to
                scale = np.asarray(getattr(grid, owner))[i] if owner else 1.0
                assert (bound.low * scale < values).all()
                assert (values < bound.high * scale).all()
            elif (name, second) != ("l_cr", "l_mr"):  # l_mr must not pass a small l_cr
                assert_allclose(values, getattr(base, second), rtol=1e-5)
    assert (np.asarray(grid.l_mr) <= np.asarray(grid.l_cr)).all()


def test_candidates_start_with_the_sets_and_without_spread_interpolate_two_sets():
    result = candidates.cloud(list(SETS.values()), FULL, 30, 0.0, seed=3)
    space = Space(FULL)
    z = space.vector(result)
    for i, params in enumerate(SETS.values()):
        assert_allclose(z[i], space.vector(params), rtol=1e-4, atol=1e-4)
    way = z[1] - z[0]
    share = (z[2:] - z[0]) @ way / (way @ way)
    assert (share > -1e-3).all()
    assert (share < 1 + 1e-3).all()
    assert_allclose(z[2:], z[0] + share[:, None] * way, rtol=1e-3, atol=1e-3)
    # The switch that differs between the sets, from the nearer one.
    assert_array_equal(result.keep_contact[2:], share > 0.5)


@pytest.fixture
def pretended(monkeypatch):
    """Trials that succeed by the seed of their worlds, and take 100 s times L."""
    calls = []

    def run_all(asks, *_, **__):
        answers = []
        for ask in asks:
            calls.append(ask)
            L = np.asarray(ask.params.L)[:, None]
            success = np.broadcast_to((ask.seed + ask.worlds) % 4 > 0, (L.size, ask.worlds.size))
            time, path_length = 100 * L + 0 * success, 5 + 0 * success
            answers.append(outcomes(success=success, time=time, path_length=path_length))
        return answers, None

    monkeypatch.setattr(study, "outcomes", run_all)
    return calls


def test_each_parameter_alone_is_labelled_and_from_worlds_for_validation(pretended):
    result = Landscape(SETS, values=3, worlds=8).vary_each()
    assert dict(result.sizes) == {"set": 2, "parameter": len(FULL), "step": 3}
    assert [ask.seed for ask in pretended] == [seed_of(0, "validate")]
    first = result.sel(set="paper", parameter="L")
    assert_allclose(first.time, 100 * first.value, rtol=1e-5)
    second = result.sel(set="tuned", parameter="K_h")
    assert_allclose(second.time, 100 * RPSParams.tuned().L, rtol=1e-4)
    assert result.attrs["worlds"] == 8


def test_the_front_is_chosen_by_validation_and_measured_by_test_worlds(pretended):
    result = Landscape(SETS, candidates=6, worlds=8).select_front()
    assert [ask.seed for ask in pretended] == [seed_of(0, s) for s in ("validate", "test")]
    params = [jax.tree.map(np.asarray, ask.params) for ask in pretended]
    jax.tree.map(assert_array_equal, *params)
    # All succeed alike and drive as far: the quickest alone is undominated.
    assert result.front.values.sum() == 1
    assert np.argmax(result.front.values) == np.argmin(result.L.values)
    table = candidates.front_table(result)
    assert {row[0] for row in table[1:]} >= {"paper", "tuned"}
    assert sum(row[-1] == "yes" for row in table) == 1
