"""Candidates in random worlds: the same ones for all, one program, parameters of any law."""

from dataclasses import fields, replace
from functools import partial
from typing import Any, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import refusing, setting_of
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax.app.cli.names import known, question_type
from rps_jax.control import registry
from rps_jax.control.base import Law
from rps_jax.control.laws.rps import RPSParams
from rps_jax.control.observation import Details, Twist
from rps_jax.runs import evaluate as room
from rps_jax.runs.evaluate import Candidates, evaluate
from rps_jax.runs.plan import Plan
from rps_jax.runs.run import Run
from rps_jax.runs.sweep import describe_plan
from rps_jax.trials import pushes
from rps_jax.trials.case import Case
from rps_jax.trials.env import PushEnv
from rps_jax.trials.progress import no_progress
from rps_jax.trials.score import Objective
from rps_jax.trials.setting import Setting, seed_of
from rps_jax.tuning.fit import Bank, Fit
from rps_jax.tuning.learn import Learn
from rps_jax.tuning.space import Space
from rps_jax.world import draws
from rps_jax.world.domain import DOMAINS, Range
from rps_jax.world.physics import Physics

CYLINDERS = replace(DOMAINS["wide"], objects=("random_cylinder",))
BRIEF = setting_of(8.0)
SHORT: Any = {"setting": BRIEF, "slots": 8}


def seeded(seed):
    """Return the keyword arguments with another seed."""
    return SHORT | {"setting": replace(BRIEF, seed=seed)}


def paper(count, **changes):
    """Return the paper's parameters for `count` candidates, with changes."""
    same = jax.tree.map(lambda value: np.full(count, value), RPSParams.paper())
    return same._replace(**changes)


class StoppedError(Exception):
    """The end of a command at its first draw of worlds."""


TUNERS = {"fit", "learn", "tune es", "tune grad"}  # with worlds of tune, validate and test
SEARCHES = {"attack", "rare", "regress", "sensitivity"}  # their points are not drawn by index


def tuner_keys(command):
    """Return the keys of a tuner's worlds for tuning and for validation."""
    if isinstance(command, Learn):
        splits = (command.environments(split)[0] for split in ("tune", "validate"))
        return [{env.setting.world_seed} for env in splits]
    if isinstance(command, Fit):
        keys, bank = set(), Bank(CYLINDERS, RPSParams(), command.setting, 1.0, 0.1)
        patched = mock.patch.object(draws, "numbers", partial(stopped, keys))
        with patched, pytest.raises(StoppedError):
            bank.worlds(4, Run(None, no_progress))
        return keys, set()
    validation = command.validation_candidates(command.base)
    return {command.candidates(command.base[None], 3).seed}, {validation.seed}


def stopped(keys, seed, index):
    """Record the key of drawn worlds, and stop the command."""
    keys.add(seed)
    raise StoppedError


def masses(keys):
    """Return the masses of the first worlds of keys."""
    return {x for key in keys for x in draws.draw(CYLINDERS, key, np.arange(64)).values["mass"]}


def test_no_command_meets_the_worlds_of_a_tuner(monkeypatch):
    """A command that draws worlds stops at its first draw."""
    commands = {name: question_type(name) for name in known()}
    seeded = {k for k, kind in commands.items() if "setting" in {f.name for f in fields(kind)}}
    tuned, validated, rest = set(), set(), set()
    for seed in (0, 2**32 - 1):
        setting = Setting(seed=seed)
        for name in TUNERS:
            tune, validate = tuner_keys(commands[name](setting=setting))
            tuned |= tune
            validated |= validate
        with monkeypatch.context() as patch:
            patch.setattr(draws, "numbers", partial(stopped, rest))
            for name in sorted(seeded - TUNERS - SEARCHES):
                options = {"score": {"law": "rps"}, "view": {}, "push": {}}
                options = options.get(name, {"quick": True})
                with pytest.raises(StoppedError):
                    commands[name](setting=setting, **options)()
        rest.add(replace(setting, split="test").world_seed)  # in which tuners test their result
    assert not tuned & validated
    assert not (tuned | validated) & rest
    kinds = [masses(tuned), masses(validated), masses(rest)]
    assert len(set.union(*kinds)) == sum(map(len, kinds))


def test_a_sweep_and_the_test_split_have_the_worlds_of_earlier_versions():
    assert seed_of(7, "test") == 23
    assert Setting(seed=5).world_seed == 5
    drawn = draws.draw(CYLINDERS, 0, np.arange(2)).values["mass"]
    assert_allclose(drawn, [3.10558863261133, 29.18796442491775], rtol=1e-12)


def test_a_split_of_a_setting_is_that_of_its_worlds_and_of_its_record():
    tuning = Setting("quasistatic", seed=3, split="tune")
    assert Setting.from_json(tuning.to_json()) == tuning
    assert "split" not in Setting(seed=3).to_json()
    env = PushEnv("random_cylinder", setting=tuning, worlds=2)
    drawn = draws.draw(CYLINDERS, seed_of(3, "tune"), np.arange(2))
    assert_allclose(env.table.p_world_target, drawn.p_world_target, rtol=1e-6)
    case, sweeps = Case(task="path"), replace(tuning, split=None)
    pushed = [pushes.build([case], setting).worlds for setting in (sweeps, tuning)]
    assert (pushed[0].key != pushed[1].key).any()
    assert (pushed[0].p_world_target != pushed[1].p_world_target).any()
    plans = [Plan(CYLINDERS, 2, {"rps": RPSParams()}, setting) for setting in (sweeps, tuning)]
    assert [", split tune," in describe_plan(plan) for plan in plans] == [False, True]
    assert tuning.attributes == {"seed": 3, "engine": "quasistatic", "split": "tune"}
    with refusing("choose from tune, validate, test"):
        Setting(split="train")


def test_a_setting_has_numbers_of_python():
    tenths = Physics(timestep=jnp.float32(0.5**6), control_period=0.5**5, base_solref=[0.02, 1])
    assert hash(tenths) == hash(Physics(0.5**6, 0.5**5))
    assert Setting(seed=np.int32(3), split="tune").world_seed == seed_of(3, "tune")


def test_results_are_labelled_as_those_of_a_sweep():
    both = replace(CYLINDERS, objects=("random_cylinder", "cylinder"))
    results = evaluate(paper(2), both, 4, split="test", **seeded(4))
    assert dict(results.sizes) == {"candidate": 2, "world": 4, "pose": 3}
    assert results.object.values.tolist() == 2 * ["random_cylinder", "cylinder"]
    for index in range(4):
        drawn = draws.table(draws.draw(both, seed_of(4, "test"), [index]))
        for name, ((value,), unit) in drawn.items():
            assert results[name].values[index] == value
            assert results[name].attrs["units"] == unit
    assert results.time.attrs["units"] == "s"
    assert results.success.dtype == np.int8
    expected = Objective().score(0.0, results.time, results.contact_lost_time, 0.0, BRIEF.rules)
    away = np.where(np.isfinite(results.min_distance), results.min_distance, results.distance)
    missed = 0.5 * np.minimum(away, 1.0)
    assert (results.success == 0).all()
    assert_allclose(results.score, expected + missed, rtol=1e-5)


def test_another_call_of_the_same_shape_compiles_nothing(compiled):
    first = evaluate(paper(3), CYLINDERS, 4, **SHORT)
    count = len(compiled)
    L = np.array([0.1, 0.2, 0.4])
    second = evaluate(paper(3, L=L), CYLINDERS, 4, split="validate", **seeded(7))
    assert len(compiled) == count
    assert (first.score != second.score).any()


def test_candidates_differ_only_in_their_parameters():
    results = evaluate(paper(3, v_approach=np.array([0.01, 0.05, 0.01])), CYLINDERS, 4, **SHORT)
    first, faster, again = results.transpose("candidate", ...).path_length.values
    assert_array_equal(first, again)
    assert (first != faster).any()


def test_candidates_are_given_as_a_list_or_as_one_law():
    alone, several = room.candidates("rps"), room.candidates(["rps", "rps,K_h=0.3"])
    for single in (alone, room.candidates(RPSParams.paper())):
        assert {np.shape(leaf) for leaf in single} == {(1,)}
    assert_allclose(several.K_h, [*alone.K_h, 0.3])
    params = paper(3)
    assert room.candidates(params) is params
    with refusing("2 classes"):
        room.candidates(["rps", "pursuit"])


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        ({"law": paper(0)}, "one for each candidate"),
        ({"law": paper(3, L=np.ones(2))}, r"\.L of 2 are not allowed"),
        ({"law": paper(3, L=np.array([1, np.nan, 1]))}, r"RPSParams\.L of a candidate"),
        ({"law": paper(3, L=np.array([1, 1, np.inf]))}, r"candidate 2: rps\.L = inf"),
        ({"law": paper(3, l_mr=np.array([0.1, 0.3, 0.1]))}, r"candidate 1: rps\.l_mr"),
        ({"law": paper(2, L=np.array(["a", "b"]))}, "array of numbers"),
        ({"law": (np.ones(3),)}, "belong to no law"),
        ({"split": "train"}, "choose from tune, validate, test"),
        ({"domain": "wild"}, "did you mean 'wide'"),
        ({"worlds": 0}, "worlds = 0"),
        ({"slots": 0}, "slots = 0"),
    ],
)
def test_bad_input_is_refused_before_anything_compiles(bad, why, compiled):
    count = len(compiled)
    with refusing(why) as caught:
        evaluate(**{"law": paper(3), "worlds": 4} | SHORT | bad)
    assert "\n" not in str(caught.value)
    assert len(compiled) == count


class Nested(NamedTuple):
    """Parameters of a law that drives ahead: a nested pytree and a leaf with more axes."""

    gains: dict[str, Any]
    curve: Any  # (3,)
    d_success: Any = 0.05


@pytest.fixture
def nested(registries):
    """Register a law with nested parameters for one test."""

    def step(params, state, observation):
        v = params.gains["v"] * jnp.sum(params.curve)
        return state, Twist(v, 0 * v, 0 * v), Details.from_obs(observation.touch)

    law = Law(lambda params: (), step, "taxels", check=lambda params: params)
    registry.register_law("nested", law, Nested({"v": 0.01}, np.ones(3)))


def test_any_registered_law_with_nested_parameters(nested):
    curve = np.array([[1, 0, 0], [0, 0, 2], [0, 0, 0]])
    params = Nested({"v": np.full(3, 0.01)}, curve, np.full(3, 0.05))
    prompt = replace(CYLINDERS, velocity_error=Range(0, 0), command_delay=Range(0, 0))
    results = evaluate(params, prompt, 2, **SHORT)
    expected = np.array([[0.08], [0.16], [0.0]])  # [m] in 8 s
    assert_allclose(results.path_length, expected + np.zeros((3, 2)), rtol=0.01)


def test_candidates_have_equal_worlds_in_any_batch():
    faster, params = paper(2, v_approach=np.array([0.01, 0.05])), paper(2)
    hostile = replace(DOMAINS["hostile"], objects=("random_cylinder",))
    domains = [CYLINDERS, hostile]
    asks = [Candidates(x, domains, 3, np.arange(3)) for x in (faster, params)]
    (first, second), _ = room.score_candidates(asks, BRIEF, Objective(), slots=8)
    assert first.score.shape == (2, 6)
    assert_array_equal(first.score[0], second.score[0])
    assert_array_equal(second.score[0], second.score[1])
    assert (first.score[1] != first.score[0]).any()
    (alone,), _ = room.score_candidates(
        [Candidates(paper(8), domains, 3, np.arange(1, 2))], BRIEF, Objective(), slots=8
    )
    assert_allclose(alone.score[0], second.score[0, [1, 4]], rtol=1e-4)


def test_scores_are_those_of_the_first_version():
    """The last digits depend on the processor, and on the flags of XLA."""
    space = Space(("L", "K_h", "beta"))
    away = np.array([[0, 0, 0], [0.5, -0.5, 0.3], [-0.7, 0.4, -0.2]], np.float32)
    params = space.params(away + np.asarray(space.vector(space.base)))
    near = replace(CYLINDERS, distance=Range(0.7, 0.9), gap=Range(0, 0))
    setting = setting_of(20.0, "fused")
    ask = Candidates(params, [near], 1, np.arange(6))
    (answer,), _ = room.score_candidates([ask], setting, Objective())
    expected = [
        [1.5613247156, 1.6000000238, 1.3565973043, 1.5677981377, 1.3648988008, 1.6000000238],
        [1.5611727238, 1.6000000238, 1.3189700842, 1.5676416159, 1.3648886681, 1.6000000238],
        [1.5615780354, 1.6000000238, 1.3576272726, 1.5680555105, 1.3642046452, 1.6000000238],
    ]
    assert_allclose(answer.score, expected, rtol=2e-3)
