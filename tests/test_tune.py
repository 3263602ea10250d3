"""Tuning: the bounded map, the objective, evolution, and resumed runs."""

import json
from typing import Any, NamedTuple
from unittest import mock

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from helpers import PAPER, read_curve, refusal, refusing, slow
from helpers import rps as command
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax.control import registry
from rps_jax.control.base import Bound, Law
from rps_jax.control.laws import rps
from rps_jax.control.laws.rps import BOUNDS, RPSParams
from rps_jax.control.observation import Details, Twist
from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.record.checkpoint import Checkpoints
from rps_jax.runs import evaluate
from rps_jax.runs.evaluate import CandidateScores
from rps_jax.runs.question import Run
from rps_jax.trials.progress import Timing, no_progress
from rps_jax.trials.score import Objective
from rps_jax.trials.setting import Setting, seed_of
from rps_jax.trials.trial import Outcome, Rules
from rps_jax.tuning import run as tuning
from rps_jax.tuning.descent import TuneGrad
from rps_jax.tuning.evolution import TuneES
from rps_jax.tuning.space import SUBSETS, Space

FULL = Space(SUBSETS["full"])
RULES = Rules(horizon=300.0, max_lost=150.0)


VECTORS = default_rng(0).uniform(-6, 6, (500, len(BOUNDS)))


def test_every_vector_is_parameters_within_their_bounds():
    params = FULL.params(jnp.asarray(VECTORS))
    for name, bound in BOUNDS.items():
        value = np.asarray(getattr(params, name))
        if bound.relative_to:
            value = value / np.asarray(getattr(params, bound.relative_to))
        assert (value >= bound.low - 1e-5 * abs(bound.low)).all()
        assert (value <= bound.high * (1 + 1e-5)).all()


def test_vectors_and_the_papers_parameters_go_there_and_back():
    vectors = VECTORS / 2
    assert_allclose(FULL.vector(FULL.params(vectors)), vectors, atol=2e-3)
    back = FULL.params(FULL.vector(PAPER))
    assert_allclose(back, PAPER, rtol=1e-5, atol=1e-6)


def test_the_written_file_has_the_whole_law():
    """Fixed parameters are written if they differ from the preset."""
    narrow, tuned = Space(("l_cr",)), RPSParams.tuned()
    low = narrow.params(narrow.vector(PAPER._replace(l_cr=0.12)))
    written = narrow.changed_values(narrow.vector(low))
    assert written == pytest.approx({"l_cr": 0.12, "l_mr": 0.12})
    rps.check(PAPER._replace(**written))
    second = Space(("eta",), tuned)
    again = PAPER._replace(**second.changed_values(second.vector(tuned)))
    assert_allclose(again, tuned, rtol=1e-5)
    assert set(narrow.changed_values(narrow.vector(PAPER))) == {"l_cr"}


def test_a_vector_worked_out_by_hand():
    # eta, between 1 and 100 in its logarithm: 10 lies in the middle, logit(1/2) = 0.
    # beta, between 0.01 and 0.3: logit(0.11 / 0.29) = log(0.11 / 0.18).
    vector = Space(("eta", "beta")).vector(PAPER)
    assert_allclose(vector, [0.0, np.log(0.11 / 0.18)], atol=1e-6)


def test_parameters_that_are_not_tuned_stay():
    params = Space(("L",)).params(jnp.array([1.7]))
    assert_allclose(params._replace(L=PAPER.L), PAPER, rtol=1e-6)
    assert params.L != PAPER.L


class Table(NamedTuple):
    """Parameters of a law with a table."""

    gain: float = 1.0
    table: Any = np.full((2, 3), 0.5)
    d_success: float = 0.05


@pytest.fixture
def table_law():
    def step(params, state, obs):
        speed = 0.05 * params.gain * jnp.mean(params.table)
        return state, Twist(speed, 0.0, 0.0), Details.from_obs(obs)

    bounds = {"table": Bound(0.1, 10.0, log=True), "gain": Bound(0.0, 2.0)}
    registry.register_law("tabled", Law(lambda params: (), step, bounds=bounds), Table())
    yield Table()
    kind = registry.LAWS.pop("tabled")
    del registry._LAWS_BY_CLASS[type(kind)]


def test_each_entry_of_a_table_is_a_coordinate(table_law, tmp_path):
    # log(0.5) between log(0.1) and log(10): logit(log(5) / log(100)).
    space = Space(("table", "gain"), table_law)
    share = np.log(5) / np.log(100)
    expected = [*[np.log(share / (1 - share))] * 6, 0.0]
    vector = np.asarray(space.vector(table_law))
    np.testing.assert_allclose(vector, expected, rtol=1e-5)
    assert list(space.parameters)[4:] == ["table[1,1]", "table[1,2]", "gain"]
    vectors = vector + np.arange(21.0).reshape(3, 7) / 10
    params = space.params(vectors)
    assert params.table.shape == (3, 2, 3)
    assert params.gain.shape == (3,)
    np.testing.assert_allclose(space.vector(params), vectors, atol=1e-5)
    (tmp_path / "t.json").write_text(json.dumps(space.changed_values(vectors[2])))
    _, written = registry.parse_law(f"tabled,{tmp_path / 't.json'}")
    np.testing.assert_allclose(written.table, params.table[2], rtol=1e-6)
    (tmp_path / "t.json").write_text(json.dumps({"table": [1, 2, 3]}))
    with pytest.raises(InputError, match=r"table = of shape \(3,\) .* give numbers \(2, 3\)"):
        registry.parse_law(f"tabled,{tmp_path / 't.json'}")


@pytest.mark.slow
def test_a_table_of_a_custom_law_is_tuned_by_derivatives(table_law):
    options = {"worlds": 2, "validation": 2, "trials": 2, "windows": 4, "checks": 0, "slots": 8}
    setting = Setting("quasistatic", rules=Rules(horizon=10.0, max_lost=10.0))
    question = TuneGrad("tabled", objects=("random_cylinder",), setting=setting, steps=2, **options)
    results = question()
    assert results.sizes["parameter"] == 7
    assert (results.params[1] != results.params[0]).any()


def test_scores_worked_out_by_hand():
    o = Objective(time=0.3, lost=0.1, miss=0.5)
    # A success after 60 of 300 s, 15 of 150 s without contact: 0.3 / 5 + 0.1 / 10.
    assert float(o.score(1.0, 60.0, 15.0, 0.04, RULES)) == pytest.approx(0.07)
    # A failure at the horizon, 20 cm off: 0.3 + 1 + 0.5 * 0.2.
    assert float(o.score(0.0, 300.0, 0.0, 0.2, RULES)) == pytest.approx(1.4)


def test_a_failure_is_never_better_than_a_success():
    o = Objective()
    slowest = o.score(1.0, 300.0, 150.0, 0.05, RULES)
    assert float(slowest) < float(o.score(0.0, 0.0, 0.0, 0.0, RULES))


def test_sooner_and_nearer_is_better():
    time, missed = np.meshgrid(np.linspace(0, 300, 20), np.linspace(0, 0.9, 20))
    scores = Objective().score(0.0, time, 0.0, missed, RULES)
    assert (np.diff(scores, axis=0) > 0).all()
    assert (np.diff(scores, axis=1) > 0).all()


def test_a_trial_without_contact_missed_by_the_whole_way():
    zero = np.zeros(1)
    for least, missed in ((np.inf, 0.5), (0.2, 0.2)):
        outcome = Outcome(zero, zero, np.full(1, least), *[zero] * (len(Outcome._fields) - 3))
        result = Objective().scores(outcome, np.full(1, 0.5), RULES)
        assert result == pytest.approx(1 + 0.5 * missed)


def sphere(x):
    return np.sum((x - 0.7) ** 2, axis=-1)


def rosenbrock(x):
    a, b = x[..., :-1], x[..., 1:]
    return np.sum(100 * (b - a**2) ** 2 + (1 - a) ** 2, axis=-1)


def search(size=4, **options):
    """Return an evolution about the paper's parameters, and its first proposal."""
    question = TuneES("rps", tuned=SUBSETS["full"][:size], **options)
    first = question.search()
    return question, first, next(first)


def minimise(function, generations, bad=0, **options):
    """Return the least value of every generation; the first `bad` candidates have none."""
    (_, first, proposal), result = search(**options), []
    for _ in range(generations):
        values = function(proposal["vectors"])
        values[:bad] = np.nan
        proposal = first.send(proposal | {"values": values})
        result.append(np.nanmin(values))
    return np.array(result)


def test_it_finds_a_minimum():
    assert minimise(rosenbrock, 400, population=16)[-1] < 1e-2


def test_a_value_that_is_not_a_number_ranks_worst():
    assert minimise(sphere, 60, bad=2, population=16)[-1] < 1e-3


def test_a_search_continues_after_a_generation_without_finite_values():
    assert np.isfinite(minimise(sphere, 3, bad=7, population=8)).all()
    _, first, proposal = search(population=8)
    assert np.isfinite(first.send(proposal | {"values": np.full(8, np.nan)})["vectors"]).all()


def test_the_seed_makes_the_proposals():
    settings = (Setting(seed=seed) for seed in (0, 0, 1))
    first, same, second = (search(population=8, setting=x)[2]["vectors"] for x in settings)
    assert_array_equal(first, same)
    assert (first != second).all()


def test_the_first_generation_spreads_about_the_start():
    question, _, proposal = search(population=4000, spread=0.3)
    away = proposal["vectors"] - question.base
    assert_allclose(away.std(axis=0), 0.3, rtol=0.05)
    assert_allclose(away.mean(axis=0), 0.0, atol=0.03)


def test_quick_tunes_few_parameters_of_rps_and_all_of_other_laws():
    quick = TuneES("rps", quick=True).with_quick_values()
    assert quick.tuned == ("K_h", "K_v", "l_cr", "d_th")
    assert TuneES("pursuit", quick=True).with_quick_values().tuned == ("full",)


def test_the_report_of_a_quick_run_says_so_first():
    assert TuneES("rps").quick_note() == ""
    note = TuneES("rps", quick=True, worlds=7).with_quick_values().quick_note()
    assert note.startswith("**This is a quick run**")


def test_the_test_of_a_tuned_law_says_whether_it_is_better():
    start, better = np.zeros(8), np.ones(8)
    for values, words in (
        ([start, better], "The tuned law is better."),
        ([better, start], "The tuned law is worse."),
        ([start, start], "Too few to tell which is better."),
    ):
        success = xr.DataArray(np.array(values), dims=("tested", "test_world"))
        sentences = tuning.test_sentences(success)
        assert sentences.endswith(words)
        assert "in 8 worlds that the search has not met" in sentences


def test_one_parameter_is_enough():
    assert np.isfinite(search(1)[2]["vectors"]).all()


# --- runs ----------------------------------------------------------------------------------


def pretend(asks, setting, objective, **_):
    """Score candidates by the distance of L and K_h from a point, instead of worlds."""
    answers = []
    for ask in asks:
        value = (np.asarray(ask.params.L) - 0.4) ** 2 + (np.asarray(ask.params.K_h) - 0.6) ** 2
        value = value.reshape(len(value), -1)  # (P, 1), or (P, W) if each world has parameters
        scores = value + 1e-3 * np.sin(ask.worlds + ask.seed)
        outcome = Outcome(scores < 0.05, *[scores] * (len(Outcome._fields) - 1))
        answers.append(CandidateScores(outcome, scores))
    return answers, Timing(0.0, 1.0, 1.0)


SMALL = {"tuned": ("L", "K_h"), "worlds": 4, "validation": 4}


def evolution(generations=6, **options):
    return TuneES("rps", population=8, **SMALL, **options), generations


def descents(generations=6):
    """Return a descent by antithetic steps; worlds need no derivatives."""
    options = {"estimator": "antithetic", "generations": 5, "pairs": 3}
    return TuneES("rps", **options, **SMALL), generations


def tune(folder, search):
    """Return the results of a search that ends, or is killed, after some generations."""
    question, generations = search
    with mock.patch.object(type(question), "num_generations", generations):
        return question.answer(Run(folder, no_progress))


def tuned(folder, search):
    return tune(folder, search).tuned.values.tolist()


@pytest.fixture
def pretended(monkeypatch):
    """Arguments of the calls that run worlds, which return a formula instead."""
    calls = []

    def score(asks, *args, **how):
        if asks[0].seed != seed_of(0, "test"):  # of the end
            calls.append(asks)
        return pretend(asks, *args, **how)

    monkeypatch.setattr(evaluate, "score_candidates", score)
    return calls


@pytest.mark.parametrize(("tuner", "done"), [(evolution, 4), slow(descents, 1)])
def test_a_continued_run_is_the_uninterrupted_one(tmp_path, pretended, tuner, done):
    folder, expected = tmp_path / "killed", tmp_path / "whole"
    whole = tuned(expected, tuner())
    tuned(folder, tuner(done))
    calls = len(pretended)
    assert tuned(folder, tuner()) == whole
    assert len(pretended) - calls == 6 - done  # each generation is one batch
    for name in ("tuned.json", "curve.csv"):
        assert (folder / name).read_text() == (expected / name).read_text()
    assert len(read_curve(expected)) == 6


@pytest.mark.parametrize("tuner", [slow(evolution), descents])
def test_only_a_damaged_generation_is_repeated(tmp_path, pretended, tuner):
    whole = tuned(tmp_path, tuner())
    curve = (tmp_path / "curve.csv").read_text()
    (third,) = (tmp_path / "parts").glob("000002*")
    third.write_bytes(third.read_bytes()[:-100])
    calls = len(pretended)
    assert tuned(tmp_path, tuner()) == whole
    assert len(pretended) == calls + 1
    assert (tmp_path / "curve.csv").read_text() == curve


def test_generations_that_the_seed_does_not_propose_are_refused(tmp_path, pretended):
    tuned(tmp_path / "one", evolution(3))
    tuned(tmp_path / "other", evolution(3, setting=Setting(seed=1)))
    for path in (tmp_path / "one" / "parts").glob("000001*"):
        path.unlink()
    (foreign,) = (tmp_path / "other" / "parts").glob("000001*")
    foreign.rename(tmp_path / "one" / "parts" / foreign.name)
    with refusing("generation 1 is of another search"):
        tuned(tmp_path / "one", evolution(3))


@pytest.mark.parametrize(("part", "name"), [("000001", "simulated"), ("test-", "test_success")])
def test_a_generation_with_an_odd_column_is_refused(part, name, tmp_path, pretended):
    tuned(tmp_path, evolution(2))
    stored = Checkpoints(tmp_path)
    (part,) = (key for key in stored.paths() if key.startswith(part))
    results = files.decode_results(stored.get(part), part)
    for odd in (results.assign({name: results[name] + 0j}), results.drop_vars(name)):
        stored.put(part, bytes(odd.to_netcdf(engine="h5netcdf", invalid_netcdf=True)))
        with refusing(rf"is corrupt \(.*{name}"):
            tuned(tmp_path, evolution(2))


def test_finished_generations_stay_when_fewer_are_requested(tmp_path, pretended):
    whole = tuned(tmp_path, evolution(6))
    assert tuned(tmp_path, evolution(2)) == whole
    assert len(read_curve(tmp_path)) == 6


def test_the_curve_is_a_table_that_grows_with_the_run(tmp_path, pretended):
    for done in (2, 6):
        results = tune(tmp_path, evolution(done))
        curve = read_curve(tmp_path)
        assert curve.index.tolist() == list(range(done))
        for name in ("validation_success", "simulated"):
            assert curve[name].tolist() == results[name].values.tolist()
        assert curve["params.K_h"].tolist() == results.params.values[:, 1].tolist()
        best = results.params.isel(generation=results.validation.argmin("generation"))
        assert_allclose(results.tuned, best, rtol=1e-5)


@pytest.mark.parametrize(("limit", "second"), [("budget", 1.0), ("minutes", 1 / 60)])
def test_a_search_ends_with_its_budget_and_resumes_with_more(tmp_path, pretended, limit, second):
    for seconds, done in ((2.5, 3), (4.0, 4), (0.0, 6)):  # 1 s a generation
        tuned(tmp_path, evolution(**{limit: seconds * second}))
        assert len(read_curve(tmp_path)) == done


def test_it_finds_the_place_and_writes_it_down(tmp_path, pretended):
    tuned(tmp_path, evolution(20))
    result = json.loads((tmp_path / "tuned.json").read_text())
    assert result == {"L": pytest.approx(0.4, abs=0.03), "K_h": pytest.approx(0.6, abs=0.03)}


def test_another_configuration_is_refused_with_the_difference(tmp_path, pretended):
    calls = SMALL | {"population": 8, "out": tmp_path}
    first = TuneES("rps", **calls, generations=1)()
    longer = TuneES("rps", **calls, generations=3)()  # of which the first is there
    assert first.params.equals(longer.params[:1])
    with refusing(r"spread = 0.5 there, 0.4 asked for"):
        TuneES("rps", **calls, spread=0.4)()
    with pytest.raises(InputError, match="holds another run"):
        TuneES("rps", **SMALL, estimator="antithetic", out=tmp_path)()


def test_the_report_of_a_descent_tells_its_times_and_parameters(pretended):
    calls = TuneES("rps", **SMALL, estimator="antithetic", generations=2)
    (section,) = calls.report(calls(), Run(None, no_progress))
    assert "after" in section.text
    assert "simulated" in section.text
    assert [name for name, *_ in section.table[1:]] == ["L", "K_h"]


def test_the_command_line(tmp_path, capsys):
    words = "tune es --engine fused --objects random_cylinder --worlds 2 --validation 2"
    words += " --population 4 --generations 2 --horizon 8 --tuned L K_h --slots 8 --out"
    calls = [*words.split(), tmp_path / "run"]
    assert command(*calls) == 0
    written = json.loads((tmp_path / "run" / "tuned.json").read_text())
    assert set(written) == {"L", "K_h"}
    assert (tmp_path / "run" / "tuning.png").stat().st_size > 10_000
    text = capsys.readouterr().out
    assert "Validation: objective" in text
    assert "Test: in 2 worlds that the search has not met, the start succeeds in " in text
    assert text.count("compile") == text.count("simulated") == 1
    assert "seed = 0 there, 1 asked for" in refusal(capsys, *calls, "--seed", 1)
