"""Tuning by gradients: steps, slopes of whole trials, and windows of softened trials."""

import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import read_curve, refusal, refusing, rps
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax.control.laws.rps import RPSParams
from rps_jax.runs.evaluate import CandidateScores
from rps_jax.trials.score import Objective
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.tuning import derivatives, descent, gradients
from rps_jax.tuning.descent import TuneGrad
from sweeps.gradients import windows
from sweeps.gradients.windows import WindowTuning

SETTING = Setting("quasistatic", rules=Rules(horizon=20.0, max_lost=10.0))
OBJECTIVE = Objective(time=0.3, lost=0.1, miss=0.5)


def snapshots(distance, contact):
    """Return snapshots with the fields that the score reads."""
    return SimpleNamespace(
        details=SimpleNamespace(distance=jnp.asarray(distance)),
        reading=SimpleNamespace(in_contact=jnp.asarray(contact)),
    )


def score(distance, contact, arrive=1e-5):
    shots = snapshots(distance, contact)
    return float(derivatives.soft_score(shots, RPSParams(), SETTING, OBJECTIVE, arrive))


def test_at_low_temperature_the_score_is_the_hard_score():
    # 1 m at 0.1 m/s in steps of 20 ms: nearer than d_success = 5 cm after 9.5 s = 475 steps.
    distance = 1.0 - 0.1 * 0.02 * np.arange(600)
    expected = OBJECTIVE.score(1.0, 9.5, 0.0, 0.0, SETTING.rules)
    assert score(distance, np.ones(600)) == pytest.approx(float(expected), abs=1e-3)


@pytest.mark.parametrize(("contact", "lost"), [((1.0, 0.0), 5.0), ((0.0, 1.0), 0.0)])
def test_the_way_that_is_left_costs_the_time_of_driving_it(contact, lost):
    """Time before the first touch is not lost."""
    # 5 s in contact, then 5 s without; the last 30 cm take 6 s at v_max = 0.05 m/s.
    expected = OBJECTIVE.score(1.0, 10.0 + 6.0, lost, 0.0, SETTING.rules)
    actual = score(np.full(500, 0.3), np.repeat(contact, 250))
    assert actual == pytest.approx(float(expected), rel=1e-5)


def test_the_soft_score_has_a_slope_where_the_hard_score_jumps():
    def at(d):
        question = snapshots(d * jnp.ones(5), jnp.ones(5))
        return derivatives.soft_score(question, RPSParams(), SETTING, OBJECTIVE, 0.005)

    slope = float(jax.grad(at)(0.05))
    assert slope > 10 * OBJECTIVE.time / SETTING.rules.horizon  # [1/m] more than a way's own


def test_the_first_start_is_the_base():
    question = TuneGrad("rps", starts=3)
    thetas = next(question.search())["vectors"]
    assert_array_equal(thetas[0], question.space.vector(question.space.base))
    assert (np.abs(thetas[1:] - thetas[0]).max(axis=1) > 0.1).all()


def test_windows_need_a_law_with_a_smooth_form():
    with refusing("no smooth form"):
        WindowTuning("pursuit", tuned=("K_v",)).validate()
    TuneGrad("pursuit", tuned=("K_v",)).validate()


def test_windows_need_an_estimator_and_an_engine_with_derivatives():
    with refusing("unknown estimator 'reverse': choose from exact, clipped"):
        WindowTuning("rps", estimator="reverse").validate()
    mujoco = Setting("mujoco")
    with refusing("engine = mujoco is not allowed: it has no reverse-mode"):
        WindowTuning("rps", setting=mujoco).validate()
    TuneGrad("rps", setting=mujoco).validate()


def test_steps_go_downhill_and_shrink_to_zero():
    """The first step follows the gradient; the second the mean of 0.2 x (3, 4) x 0.8 and (0, 1)."""
    search = TuneGrad("rps", tuned=("L", "K_h"), learning_rate=0.5, steps=2).search()
    start = next(search)["vectors"]
    length = 0.5 * np.sqrt(2)  # of a step, and half of it in the middle of the cosine
    for gradient, change in (([30, 40], [0.6, 0.8]), ([0, 10], [4.8, 8.4])):
        results = {"vectors": start, "base": np.array(0.5), "gradients": np.array([gradient])}
        moved = search.send(results)["vectors"]
        change = -length * np.array([change]) / np.linalg.norm(change)
        assert_allclose(moved - start, change, rtol=1e-6)
        start, length = moved, length / 2
    flat = {"vectors": start, "base": np.array(0.5), "gradients": np.zeros((1, 2))}
    assert_allclose(search.send(flat)["vectors"], start)


def test_antithetic_steps_find_the_slope_of_the_objective():
    # value = 2 z_0 - z_1 in the coordinates of the map, the same in all worlds.
    question = TuneGrad("rps", tuned=("L", "K_h"), worlds=3, pairs=4000, setting=SETTING)

    def pretend(asks):
        z = question.space.vector(asks[0].params)  # (P, 3, 2): each world has other steps
        return [CandidateScores(None, np.asarray(2 * z[..., 0] - z[..., 1]) + np.arange(3))]

    estimate = descent.evolution_gradients(jnp.zeros((2, 2)), question, 0, pretend)
    assert_allclose(estimate.gradient, [[2, -1], [2, -1]], atol=0.2)
    errors = np.abs(estimate.gradient - jnp.array([2.0, -1.0])) / jnp.sqrt(estimate.variance)
    assert (errors < 4).all()


def test_a_descent_names_slopes_without_a_sample_and_steps_without_them():
    question = TuneGrad("rps", tuned=("L", "K_h"), steps=3, setting=SETTING)
    empty = gradients.estimate(jnp.array([[[jnp.nan], [2.0]], [[jnp.nan], [4.0]]])[..., 0])
    estimate = jax.tree.map(lambda x: x[None], empty)
    with pytest.warns(UserWarning, match="1 of 2 slopes have no finite sample"):
        results = descent.gradient_results(estimate)
    assert_array_equal(results["gradients"], [[np.nan, 3.0]])
    search = question.search()
    start = next(search)["vectors"]
    results = {"vectors": start, "base": np.array(1.0), "gradients": results["gradients"]}
    moved = search.send(results)["vectors"] - start
    assert moved[0, 0] == 0
    assert moved[0, 1] < 0


def test_the_tail_alone_counts_for_a_risk_averse_objective():
    """The score of ten worlds is a multiple of the parameter; two are the worst fifth."""
    objective = Objective(risk="cvar", tail=0.2)
    slopes = jnp.arange(10.0)

    def by_world(theta):
        return objective.linearise(theta * slopes)

    assert jax.jacrev(lambda t: by_world(t).mean())(1.0) == pytest.approx(8.5)
    step = 1e-3
    values = [objective.value((1.0 + side * step) * slopes) for side in (1, -1)]
    assert (values[0] - values[1]) / (2 * step) == pytest.approx(8.5, rel=1e-3)
    assert_array_equal(Objective().linearise(slopes), slopes)


def test_windows_start_at_the_states_of_their_trials(monkeypatch):
    """Trials are replaced by counts of their steps of 20 ms."""

    monkeypatch.setattr(windows, "start_all", lambda *arguments, law: jnp.zeros(arguments[-1].size))
    monkeypatch.setattr(windows, "advance", lambda batches, loop, steps: [batches[0][-1] + steps])
    late = jnp.array([0.0, 0.5, 1.0])
    for within, steps in ((10.0, [0, 250, 500]), (0.0, [0, 0, 0])):
        question = WindowTuning("rps", tuned=("L", "K_h"), within=within, setting=SETTING)
        trials = windows.window_starts(question, None, jnp.zeros(2), late, late)
        assert_array_equal(trials, steps)


# Cylinders on the quasi-static model, to compile few programs.
RUN = "--engine quasistatic --objects random_cylinder --worlds 2 --validation 2 --starts 2 "
RUN += "--horizon 5 --tuned L K_h v_lost --slots 8 --steps"
WINDOWS = "sweeps/gradients/windows.py --window 1 --within 2 --arrive 0.01"


@pytest.mark.slow
@pytest.mark.parametrize("command", ["tune grad", WINDOWS])
def test_the_command_line_and_a_run_of_another_kind(tmp_path, capsys, command):
    assert rps(f"{command} {RUN} 2 --out", tmp_path) == 0
    curve = read_curve(tmp_path).reset_index()
    assert len(curve) == 3
    assert (curve.finite[:2] == 1.0).all()
    assert np.isfinite(curve[["gradient", "gradient_error"]][:2]).all(axis=None)
    assert curve["params.L"][1] != curve["params.L"][0] or curve.gradient[0] == 0
    assert set(json.loads((tmp_path / "tuned.json").read_text())) == {
        "L",
        "K_h",
        "v_lost",
        "saturate_first",
    }
    assert "steps = 2 there, 3 asked for" in refusal(capsys, f"{command} {RUN} 3 --out", tmp_path)
