"""Tuning by gradients: steps, slopes of whole trials, and windows of softened trials."""

import json
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import read_curve, refusal, refusals, refusing, rps

from rps_jax.control import registry
from rps_jax.control.base import Bound, Law
from rps_jax.control.laws import rps as rps_law
from rps_jax.control.laws.rps import RPSParams, RPSState
from rps_jax.control.observation import Twist
from rps_jax.runs.evaluate import CandidateScores, evaluate
from rps_jax.trials import trial
from rps_jax.trials.score import Objective
from rps_jax.trials.setting import Setting
from rps_jax.trials.trajectory import control_loop, draw_worlds
from rps_jax.trials.trial import Rules
from rps_jax.trials.worlds import rows, soften_skins
from rps_jax.tuning import derivatives, descent, optimisers
from rps_jax.tuning.descent import TuneGrad
from rps_jax.tuning.evolution import TuneES
from rps_jax.tuning.gradients import Estimate

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
        return derivatives.soft_score(question, RPSParams(), SETTING, OBJECTIVE)

    slope = float(jax.grad(at)(0.05))
    assert slope > 10 * OBJECTIVE.time / SETTING.rules.horizon  # [1/m] more than a way's own


def by_slopes(**options):
    return TuneES("rps", tuned=("L", "K_h"), estimator="antithetic", setting=SETTING, **options)


def test_steps_go_downhill_and_shrink_to_zero():
    """The first step follows the gradient; the second the mean of 0.2 x (3, 4) x 0.8 and (0, 1)."""
    search = by_slopes(learning_rate=0.5, generations=2).search()
    start = next(search)["vectors"]
    length = 0.5 * np.sqrt(2)  # of a step, and half of it in the middle of the cosine
    for gradient, change in (([30, 40], [0.6, 0.8]), ([0, 10], [4.8, 8.4])):
        results = {"vectors": start, "base": np.array(0.5), "validation": np.array(0.5)}
        results["gradients"] = np.array([gradient])
        moved = search.send(results)["vectors"]
        change = -length * np.array([change]) / np.linalg.norm(change)
        np.testing.assert_allclose(moved - start, change, rtol=1e-5)
        start, length = moved, length / 2


def test_antithetic_steps_find_the_slope_of_the_objective():
    # value = 2 z_0 - z_1 in the coordinates of the map, the same in all worlds.
    question = by_slopes(worlds=3, pairs=4000)
    tried, estimate = question.antithetic(jnp.zeros(2), 0, 3)
    z = question.space.vector(tried.params)  # (P, 3, 2): each world has other steps
    scores = np.asarray(2 * z[..., 0] - z[..., 1]) + np.arange(3)
    slopes = estimate(CandidateScores(None, scores))
    np.testing.assert_allclose(slopes.gradient, [2, -1], atol=0.2)
    errors = np.abs(slopes.gradient - jnp.array([2.0, -1.0])) / jnp.sqrt(slopes.variance)
    assert (errors < 4).all()


def test_a_descent_names_slopes_without_a_sample_and_steps_without_them():
    question = by_slopes(generations=3, worlds=3, pairs=4000)
    _, estimate = question.antithetic(jnp.zeros(2), 0, 3)
    with pytest.warns(UserWarning, match="2 of 2 slopes have no finite sample"):
        slopes = estimate(CandidateScores(None, np.full((8000, 3), np.nan)))
    assert np.isnan(slopes.gradient).all()
    search = question.search()
    start = next(search)["vectors"]
    results = {"vectors": start, "base": np.array(1.0), "validation": np.array(1.0)}
    results["gradients"] = np.array([[np.nan, 3.0]])
    moved = search.send(results)["vectors"] - start
    assert moved[0, 0] == 0
    assert moved[0, 1] < 0


# --- derivatives of windows ----------------------------------------------------------------


class Throttled(NamedTuple):
    """Parameters of RPS at a share of its speed."""

    rps: RPSParams
    share: Any = 0.3

    @property
    def d_success(self):
        return self.rps.d_success


@pytest.fixture
def throttled():
    def step(params, state, obs):
        state, twist, details = rps_law.step_with_details(params.rps, state, obs)
        return state, Twist(*(params.share * x for x in twist)), details

    init = lambda params: RPSState.init(params.rps)  # noqa: E731
    law = Law(init, step, bounds={"share": Bound(0.05, 1.0)})
    params = Throttled(RPSParams.paper())
    registry.register_law("throttled", law, params)
    yield params
    registry.LAWS.pop("throttled")
    del registry._LAWS_BY_CLASS[Throttled]


@pytest.mark.slow
def test_20_steps_of_adam_lower_the_loss_beyond_its_interval_in_fresh_worlds(throttled):
    """The law starts at 30 % of the speed of RPS, and all steps follow derivatives."""
    domain = "wide,distance=0.7:0.8,bearing=-0.4:0.4,objects=random_cylinder"
    setting = Setting("quasistatic", rules=Rules(150.0, 150.0))
    options = {"worlds": 8, "validation": 8, "windows": 16, "trials": 8, "slots": 16}
    options |= {"optimiser": "adam", "steps": 20, "window_steps": 20, "refresh": 10, "checks": 0}
    options |= {"domain": domain, "objects": ("random_cylinder",), "setting": setting}
    results = TuneGrad("throttled", **options)()
    assert results.windows.sum() == 20
    laws = [throttled, throttled._replace(share=float(results.tuned[0]))]
    scores = evaluate(laws, domain, 128, split="test", setting=setting, slots=16).score.values
    gain = scores[0] - scores[1]
    assert gain.mean() > 2 * gain.std(ddof=1) / np.sqrt(gain.size)


SMALL = {"tuned": ("L", "K_h"), "steps": 9}


def fake_results(question, validations, dropped=None):
    """Return the vectors and kinds of the steps of a search with fixed results.

    The result of the step `dropped` drops windows.
    """
    search, kinds, vectors = question.search(), [], []
    proposal = next(search)
    for value in validations:
        kinds.append(int(proposal["windows"]))
        vectors.append(proposal["vectors"][0].copy())
        results = proposal | {"base": np.array(1.0), "validation": np.array(value)}
        if len(kinds) - 1 == dropped:
            results["windows"] = np.array(0.0)
        proposal = search.send(results | {"gradients": np.ones((1, 2))})
    return kinds, vectors, proposal


@pytest.mark.parametrize("optimiser", ["adam", "fixed_length", optax.sgd(0.3)])
def test_five_steps_lower_a_loss(optimiser):
    """The loss is the squared distance from a vector, and windows have its derivatives."""
    search = TuneGrad("rps", **SMALL, optimiser=optimiser, window_steps=9).search()
    proposal, losses = next(search), []
    target = proposal["vectors"][0] + np.array([1.0, -2.0])
    for _ in range(5):
        away = proposal["vectors"] - target
        losses.append(0.5 * np.sum(away**2))
        results = {"validation": np.array(losses[-1]), "gradients": away}
        proposal = search.send(proposal | results)
    assert (np.diff(losses) < 0).all()


def test_steps_by_derivatives_end_and_return_to_the_best_vector():
    question = TuneGrad("rps", **SMALL, window_steps=4, refresh=3)
    nan = np.nan
    kinds, vectors, following = fake_results(question, [1.0, nan, nan, 0.5, 0.8, 0.9])
    assert kinds == [1, 1, 1, 1, 0, 0]
    np.testing.assert_array_equal(vectors[4], vectors[3])
    assert (following["vectors"][0] < vectors[3]).all()


def test_a_search_that_drops_windows_goes_on_from_the_best_vector():
    question = TuneGrad("rps", **SMALL, window_steps=8, refresh=3)
    nan = np.nan
    kinds, vectors, _ = fake_results(question, [0.5, nan, nan, 0.8, 0.6], dropped=3)
    assert kinds == [1, 1, 1, 1, 0]
    np.testing.assert_array_equal(vectors[4], vectors[0])


@pytest.fixture
def checked(monkeypatch):
    """Return the results of the first step, whose derivatives are ones, for a rise along them.

    The score of whole trials rises by a number for a unit step of the parameters along (1, 1).
    """
    ones = Estimate(*jnp.ones((3, 2)))

    def judge(rise, checks):
        question = TuneGrad("rps", **SMALL, checks=checks, sigma=0.5)
        proposal = next(question.search())
        states = SimpleNamespace(moments=np.eye(len(proposal["moments"])))
        monkeypatch.setattr(TuneGrad, "_collect", lambda *_: [states])
        monkeypatch.setattr(TuneGrad, "_derivatives", lambda *_: ones)

        def score(requests):
            answers = []
            for request in requests:
                moved = np.asarray(question.space.vector(request.params)) - proposal["vectors"]
                scores = rise * moved.mean(axis=1)[:, None] + np.arange(request.shape[1])
                outcome = SimpleNamespace(success=np.ones(1))
                answers.append(CandidateScores(outcome, scores))
            return answers

        return question.judge(proposal, 0, score)

    return judge


@pytest.mark.parametrize(("rise", "checks", "windows"), [(3.0, 4, 1), (-3.0, 4, 0), (-3.0, 0, 1)])
def test_derivatives_along_which_no_score_falls_are_dropped(checked, rise, checks, windows):
    """A step goes against the derivatives. With checks=0 they are used without a check."""
    results = checked(rise, checks)
    assert results["windows"] == windows
    np.testing.assert_array_equal(results["gradients"][0], np.ones(2))
    np.testing.assert_allclose(results["slope"], rise if checks else np.nan, rtol=1e-4)
    np.testing.assert_allclose(results["slope_error"], 0.0 if checks else np.nan, atol=1e-4)


def test_derivatives_are_dropped_with_a_warning_where_all_scores_are_alike(checked):
    with pytest.warns(UserWarning, match="All trials along the derivatives have equal scores"):
        assert checked(0.0, 4)["windows"] == 0


def test_features_have_the_target_and_not_the_pose_of_the_object():
    """With pose and offset, derivatives point against the slopes of whole trials."""
    batch = draw_worlds("wide,objects=random_box,gap=0.3:0.3", setting=SETTING)
    world = jax.tree.map(jnp.asarray, soften_skins(rows(batch.worlds, 0)))
    params = RPSParams.paper()
    loop = control_loop(params, SETTING, smooth=True)
    first = jax.jit(trial.start, static_argnums=2)(world, params, loop.law)

    @jax.jit
    def features(world, qpos):
        return descent.features(world, params, first._replace(qpos=qpos), loop)

    def change(*inputs):
        return np.abs(np.subtract(features(*inputs), features(world, first.qpos))).max()

    assert change(world, first.qpos.at[3:5].add(0.1)) < 1e-6
    assert change(world._replace(p_world_target=world.p_world_target + 1.0), first.qpos) > 0.1


def test_the_value_function_has_the_coefficients_of_its_data():
    random = np.random.default_rng(0)
    x = random.normal(size=(500, 6))
    truth = np.concatenate([[2.0], random.normal(size=6)])
    data = np.column_stack([np.ones(500), x, truth[0] + x @ truth[1:]])
    np.testing.assert_allclose(descent.fit(data.T @ data, 0.0), truth, atol=1e-9)
    shrunk = descent.fit(data.T @ data, 1e6)
    np.testing.assert_allclose(shrunk[1:], 0.0, atol=0.01)
    assert shrunk[0] == pytest.approx(data[:, -1].mean(), abs=0.01)  # the constant is free


def test_the_record_of_a_run_has_a_custom_optimiser():
    assert TuneGrad(optimiser=optax.sgd(0.3)).configuration()["optimiser"] == "custom"


def test_optimisers_are_those_of_optax_and_one_that_needs_more_is_refused():
    known = set(optimisers.optimisers())
    assert {"adam", "adamw", "sgd", "lion", "fixed_length"} <= known
    assert not [name for name in known if name.startswith(("_", "scale_by"))]
    for name in optimisers.SCHEDULES:
        rule = optimisers.optimiser("sgd", name, 0.1, 20)
        change, _ = rule.update(jnp.ones(3), rule.init(jnp.zeros(3)), jnp.zeros(3))
        assert (change <= 0).all()
    with refusing(r"optimiser = lbfgs .* needs more than gradients and a learning rate"):
        optimisers.optimiser("lbfgs", "constant", 0.1, 20)


test_bad_options_are_refused_before_anything_compiles = refusals(
    lambda **options: TuneGrad(**options).validate(),
    ({"optimiser": "adma"}, "unknown optimiser 'adma'.*did you mean 'adamax'"),
    ({"optimiser": 3.0}, "optimiser = 3.0 is not allowed: give a name or a transformation"),
    ({"schedule": "cosine"}, "unknown schedule 'cosine': .*cosine_decay"),
    ({"learning_rate": 0.0}, "learning_rate = 0.* is not allowed"),
    ({"learning_rate": float("nan")}, "learning_rate = nan is not allowed"),
    ({"law": "learned"}, "its parameters have no bounds"),
    ({"setting": Setting("mujoco")}, "engine = mujoco is not allowed: JAX must trace it"),
    ({"window": 301.0}, r"window = 301.0 .* at most 300 \[s\]"),
)


def test_the_former_flags_say_where_random_steps_are(capsys):
    for flag in ("--starts", "--spread"):
        text = refusal(capsys, f"tune grad {flag} 2")
        assert f"the option {flag[2:]} has been removed" in text
        assert "`rps tune es --estimator antithetic`" in text


# Cylinders on the quasi-static model, to compile few programs.
RUN = "--engine quasistatic --objects random_cylinder --worlds 2 --validation 2 "
RUN += "--horizon 5 --tuned L K_h v_lost --slots 8"
GRAD = "tune grad --optimiser sgd --windows 4 --trials 2 --checks 2 --window 1 --refresh 2 --steps"


@pytest.mark.slow
def test_the_command_line_tunes_by_derivatives_of_mjx(tmp_path, capsys):
    words = "--engine mjx --objects random_cylinder --worlds 2 --validation 2 --horizon 1 --out"
    command = f"{GRAD} 2 --tuned L K_h --slots 4 {words}".replace("--checks 2", "--checks 0")
    assert rps(command.replace("--window 1", "--window 0.2"), tmp_path) == 0
    curve = read_curve(tmp_path)
    assert curve.windows.tolist() == [1, 1, 0]
    assert (curve.finite[:2] == 1).all()


@pytest.mark.slow
@pytest.mark.parametrize("command", ["tune es --estimator antithetic --generations", GRAD])
def test_the_command_line_and_a_run_of_another_kind(tmp_path, capsys, command):
    assert rps(f"{command} 2 {RUN} --out", tmp_path) == 0
    curve = read_curve(tmp_path).reset_index()
    assert len(curve) == 3
    assert (curve.finite[:2] == 1.0).all()
    assert np.isfinite(curve[["gradient", "gradient_error"]][:2]).all(axis=None)
    assert curve["params.L"][1] != curve["params.L"][0] or curve.gradient[0] == 0
    names = {"L", "K_h", "v_lost"}
    assert set(json.loads((tmp_path / "tuned.json").read_text())) == names
    assert "seed = 0 there, 1 asked" in refusal(
        capsys, f"{command} 2 {RUN} --seed 1 --out", tmp_path
    )
