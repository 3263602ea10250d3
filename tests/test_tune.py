"""Tuning: the bounded map, the objective, evolution against a second implementation, resuming."""

import json
from dataclasses import replace

import cmaes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rps_jax.app import cli
from rps_jax.control import law
from rps_jax.control.law import RPSParams
from rps_jax.errors import InputError
from rps_jax.trials.setting import Setting, Timing
from rps_jax.trials.trial import Rules
from rps_jax.tuning import evolution as tune
from rps_jax.tuning.evolution import (
    BOUNDS,
    SUBSETS,
    Answer,
    Ask,
    Course,
    Evolution,
    Objective,
    Space,
)
from rps_jax.world import domain
from rps_jax.world.physics import preset

FULL = Space(SUBSETS["full"])
RULES = Rules(horizon=300.0, max_lost=150.0)


class TestSpace:
    vectors = np.random.default_rng(0).uniform(-6, 6, (500, len(BOUNDS)))

    def test_every_vector_is_parameters_within_their_bounds(self):
        params = FULL.params(jnp.asarray(self.vectors))
        for name, bound in BOUNDS.items():
            value = np.asarray(getattr(params, name))
            if bound.of:
                value = value / np.asarray(getattr(params, bound.of))
            assert (value >= bound.low - 1e-5 * abs(bound.low)).all()
            assert (value <= bound.high * (1 + 1e-5)).all()

    def test_there_and_back(self):
        vectors = self.vectors / 2
        np.testing.assert_allclose(FULL.vector(FULL.params(vectors)), vectors, atol=2e-3)

    def test_what_is_written_is_the_whole_law(self):
        """Also what is not tuned: of another start, or moved by a bound that is."""
        paper, tuned = RPSParams.paper(), RPSParams.tuned()
        narrow = Space(("l_cr",))
        low = narrow.params(narrow.vector(paper._replace(l_cr=0.12)))
        written = tune.named(narrow, narrow.vector(low))
        assert written == pytest.approx({"l_cr": 0.12, "l_mr": 0.12})
        law.check(paper._replace(**written))
        other = Space(("eta",), tuned)
        again = paper._replace(**tune.named(other, other.vector(tuned)))
        np.testing.assert_allclose(again, tuned, rtol=1e-5)
        assert set(tune.named(narrow, narrow.vector(paper))) == {"l_cr"}

    def test_the_papers_parameters_come_back(self):
        paper = RPSParams.paper()
        back = FULL.params(FULL.vector(paper))
        for name, value in paper._asdict().items():
            np.testing.assert_allclose(getattr(back, name), value, rtol=1e-5, atol=1e-6)

    def test_values_worked_out_by_hand(self):
        # eta, between 1 and 100 in its logarithm: 10 lies in the middle, logit(1/2) = 0.
        # beta, between 0.01 and 0.3: logit(0.11 / 0.29) = log(0.11 / 0.18).
        vector = Space(("eta", "beta")).vector(RPSParams.paper())
        np.testing.assert_allclose(vector, [0.0, np.log(0.11 / 0.18)], atol=1e-6)

    def test_what_is_not_tuned_stays(self):
        params = Space(("L",)).params(jnp.array([1.7]))
        paper = RPSParams.paper()
        assert all(
            float(value) == pytest.approx(float(getattr(paper, name)))
            for name, value in params._asdict().items()
            if name != "L"
        )

    def test_the_middle_region_never_reaches_beyond_the_critical_one(self):
        params = Space(("l_cr",)).params(jnp.array([[-8.0], [8.0]]))
        assert (params.l_mr <= params.l_cr).all()

    @pytest.mark.parametrize("names", [(), ("L", "L"), ("mass",), ("v_max",)])
    def test_names_are_checked(self, names):
        with pytest.raises(InputError):
            Space(names)

    def test_a_base_on_a_bound_is_refused(self):
        with pytest.raises(InputError, match="gamma_max"):
            Space(("gamma_max",), RPSParams(gamma_max=np.inf))


class TestObjective:
    def test_values_worked_out_by_hand(self):
        o = Objective(time=0.3, lost=0.1, miss=0.5)
        # A success after 60 of 300 s, 15 of 150 s without contact: 0.3 / 5 + 0.1 / 10.
        assert float(o.score(1.0, 60.0, 15.0, 0.04, RULES)) == pytest.approx(0.07)
        # A failure at the horizon, 20 cm off: 0.3 + 1 + 0.5 * 0.2.
        assert float(o.score(0.0, 300.0, 0.0, 0.2, RULES)) == pytest.approx(1.4)

    def test_a_failure_is_never_better_than_a_success(self):
        o = Objective()
        slowest = o.score(1.0, 300.0, 150.0, 0.05, RULES)
        assert float(slowest) < float(o.score(0.0, 0.0, 0.0, 0.0, RULES))

    def test_sooner_and_nearer_is_better(self):
        time, missed = np.meshgrid(np.linspace(0, 300, 20), np.linspace(0, 0.9, 20))
        scores = Objective().score(0.0, time, 0.0, missed, RULES)
        assert (np.diff(scores, axis=0) > 0).all()
        assert (np.diff(scores, axis=1) > 0).all()

    def test_risk(self):
        scores = jnp.arange(20.0)
        assert float(Objective().value(scores)) == pytest.approx(9.5)
        assert float(Objective(risk="cvar", tail=0.1).value(scores)) == pytest.approx(18.5)

    def test_bad_weights_are_refused(self):
        for bad in ({"risk": "worst"}, {"time": -1.0}, {"tail": 0.0}, {"miss": np.nan}):
            with pytest.raises(InputError):
                Objective(**bad)


def test_no_two_splits_share_a_seed():
    seeds = [tune.seed_of(seed, split) for seed in range(50) for split in tune.SPLITS]
    assert len(set(seeds)) == len(seeds)


def sphere(x):
    return jnp.sum((x - 0.7) ** 2, axis=-1)


def ellipsoid(x):
    return jnp.sum(10.0 ** (3 * jnp.arange(x.shape[-1]) / (x.shape[-1] - 1)) * x**2, axis=-1)


def rosenbrock(x):
    a, b = x[..., :-1], x[..., 1:]
    return jnp.sum(100 * (b - a**2) ** 2 + (1 - a) ** 2, axis=-1)


class TestEvolution:
    def minimise(self, function, size, generations, population=16, bad=0):
        evolution = Evolution(population=population, spread=0.5)
        space = Space(SUBSETS["full"][:size])
        search = tune.begin(evolution, space, jnp.zeros(size))
        found = []
        for _ in range(generations):
            candidates, asked = tune.propose(evolution, search)
            values = function(candidates).at[:bad].set(jnp.nan)
            search = tune.learn(evolution, search, asked, candidates, values)
            found.append(float(jnp.nanmin(values)))
        return np.array(found)

    @pytest.mark.parametrize(
        ("function", "generations"), [(sphere, 60), (ellipsoid, 120), (rosenbrock, 400)]
    )
    def test_as_good_as_a_second_implementation(self, function, generations):
        size = 6
        ours = self.minimise(function, size, generations)
        other = cmaes.CMA(np.zeros(size), 0.5, population_size=16, seed=1)
        theirs = []
        for _ in range(generations):
            xs = [other.ask() for _ in range(16)]
            values = [float(function(jnp.asarray(x))) for x in xs]
            other.tell(list(zip(xs, values, strict=True)))
            theirs.append(min(values))
        target = 1e-3
        assert min(ours) < target
        assert np.argmax(ours < target) < 2 * np.argmax(np.array(theirs) < target) + 10

    def test_a_value_that_is_not_a_number_ranks_worst(self):
        assert self.minimise(sphere, 4, 60, bad=2)[-1] < 1e-3

    def test_the_same_seed_proposes_the_same(self):
        evolution = Evolution(population=8)
        one, two = (
            tune.propose(evolution, tune.begin(evolution, FULL, jnp.zeros(13)))[0] for _ in range(2)
        )
        np.testing.assert_array_equal(one, two)

    @pytest.mark.parametrize("strategy", tune.STRATEGIES)
    def test_every_strategy_goes_downhill(self, strategy):
        evolution = Evolution(strategy=strategy, population=16)
        search = tune.begin(evolution, Space(("L", "K_h")), jnp.zeros(2))
        for _ in range(40):
            candidates, asked = tune.propose(evolution, search)
            search = tune.learn(evolution, search, asked, candidates, sphere(candidates))
        assert float(sphere(search.state.mean)) < 0.5 * float(sphere(jnp.zeros(2)))

    def test_unknown_strategies_are_named(self):
        with pytest.raises(InputError, match="CMA_ES"):
            Evolution(strategy="CMA")

    def test_a_stalled_search_begins_again_elsewhere(self):
        evolution = Evolution(population=8, patience=2)
        search = tune.begin(evolution, FULL, jnp.zeros(13))
        for value in (1.0, 2.0, 3.0):
            search = tune.validated(evolution, search, search.state.mean, value)
        assert int(search.restarts) == 1
        assert float(search.best_value) == 1.0
        assert float(jnp.abs(search.state.mean).max()) > 0.1


def pretend(asks, domains, setting, objective, **_):
    """Instead of worlds: the distance of L and K_h from a place, and a little of the worlds."""
    answers = []
    for ask in asks:
        value = (np.asarray(ask.params.L) - 0.4) ** 2 + (np.asarray(ask.params.K_h) - 0.6) ** 2
        scores = value[:, None] + 1e-3 * np.sin(ask.worlds + ask.seed)
        answers.append(Answer(scores, (scores < 0.05) * 1.0, scores, scores))
    return answers, Timing(0.0, 1.0, 1.0)


class TestRuns:
    space = Space(("L", "K_h"))
    course = Course(worlds=4, validation=4)

    def run(self, folder, generations, budget=0.0):
        evolution = Evolution(population=8, generations=generations, budget=budget)
        tune.open_run(folder, self.space, self.course, evolution)
        return tune.evolve(folder, self.space, self.course, evolution)

    def test_a_continued_run_is_the_uninterrupted_one(self, tmp_path, monkeypatch):
        monkeypatch.setattr(tune, "try_out", pretend)
        whole = self.run(tmp_path / "whole", 6)
        self.run(tmp_path / "parts", 2)
        parts = self.run(tmp_path / "parts", 6)
        assert [float(x) for x in whole] == [float(x) for x in parts]
        logs = [(tmp_path / name / "log.jsonl").read_text() for name in ("whole", "parts")]
        assert logs[0] == logs[1]
        assert len(logs[0].splitlines()) == 6

    def test_it_ends_when_its_budget_is_spent_and_goes_on_with_more(self, tmp_path, monkeypatch):
        monkeypatch.setattr(tune, "try_out", pretend)  # of 1 s a generation
        for budget, done in ((2.5, 3), (4.0, 4), (0.0, 6)):
            self.run(tmp_path, 6, budget)
            assert len(tune.read_log(tmp_path)) == done

    def test_it_finds_the_place_and_writes_it_down(self, tmp_path, monkeypatch):
        monkeypatch.setattr(tune, "try_out", pretend)
        self.run(tmp_path, 20)
        tuned = json.loads((tmp_path / "tuned.json").read_text())
        assert tuned == {"L": pytest.approx(0.4, abs=0.03), "K_h": pytest.approx(0.6, abs=0.03)}

    def test_another_configuration_is_refused_with_the_difference(self, tmp_path, monkeypatch):
        monkeypatch.setattr(tune, "try_out", pretend)
        self.run(tmp_path, 1)
        other = Evolution(population=10)
        with pytest.raises(InputError, match=r"population = 8 there, 10 asked for"):
            tune.open_run(tmp_path, self.space, self.course, other)

    def test_a_corrupt_state_is_refused(self, tmp_path, monkeypatch):
        monkeypatch.setattr(tune, "try_out", pretend)
        self.run(tmp_path, 1)
        whole = (tmp_path / "state.npz").read_bytes()
        for content in (b"no", b"", whole[:100]):
            (tmp_path / "state.npz").write_bytes(content)
            with pytest.raises(InputError, match="corrupt"):
                self.run(tmp_path, 2)


class TestInWorlds:
    """With the fused engine, cylinders alone, to compile but one program."""

    cylinders = replace(domain.DOMAINS["wide"], objects=("random_cylinder",))
    setting = Setting(preset(), Rules(horizon=8.0), engine="fused")

    def test_every_candidate_meets_the_same_worlds_whatever_shares_its_batch(self):
        params = jax.tree.map(lambda x: jnp.array([x, x], jnp.float32), RPSParams.paper())
        faster = params._replace(v_approach=jnp.array([0.01, 0.05]))
        hostile = replace(domain.DOMAINS["hostile"], objects=("random_cylinder",))
        asks = [Ask(faster, 3, np.arange(3)), Ask(params, 3, np.arange(3))]
        (one, two), _ = tune.try_out(
            asks, [self.cylinders, hostile], self.setting, Objective(), slots=6
        )
        assert one.score.shape == (2, 6)
        np.testing.assert_array_equal(one.score[0], two.score[0])
        np.testing.assert_array_equal(two.score[0], two.score[1])
        assert (one.score[1] != one.score[0]).any()
        (alone,), _ = tune.try_out(
            [Ask(params, 3, np.arange(1, 2))], [self.cylinders], self.setting, Objective(), slots=6
        )
        np.testing.assert_allclose(alone.score[0], two.score[0, 1:2], rtol=1e-4)

    def test_the_command_line(self, tmp_path, capsys):
        arguments = ["tune", "es", "--objects", "random_cylinder", "--worlds", "2"]
        arguments += ["--validation", "2", "--population", "4", "--generations", "2"]
        arguments += ["--horizon", "8", "--tuned", "L", "K_h", "--out", str(tmp_path / "run")]
        assert cli.main([*arguments, "--slots", "6"]) == 0
        assert set(json.loads((tmp_path / "run" / "tuned.json").read_text())) == {"L", "K_h"}
        assert (tmp_path / "run" / "tuning.png").stat().st_size > 10_000
        assert "validation" in capsys.readouterr().out
        assert cli.main([*arguments, "--seed", "1"]) == 2
        assert "seed = 0 there, 1 asked for" in capsys.readouterr().err
