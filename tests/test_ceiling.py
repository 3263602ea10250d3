"""The ceiling: plans around the law, their search, and their outcomes."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import xarray as xr
from helpers import (
    CYLINDERS,
    observation,
    refusal,
    refusals,
    refusing,
    setting_of,
)
from helpers import rps as command
from numpy.testing import assert_allclose, assert_array_equal

import rps_jax
from rps_jax import RPSParams, Rules
from rps_jax.control.laws import guided, rps
from rps_jax.control.laws.guided import GuidedParams
from rps_jax.control.laws.rps import RPSState
from rps_jax.record.checkpoint import Checkpoints
from rps_jax.studies import ceiling
from rps_jax.studies.ceiling import Ceiling
from rps_jax.trials import score
from rps_jax.trials.setting import seed_of
from rps_jax.trials.trial import Outcome

SHORT = setting_of(20.0)
SIZES = {"samples": 6, "rounds": 3, "window": 10.0}
SMALL = Ceiling(CYLINDERS, **SIZES)


def observe(touched=True):
    return observation((0.0, 0.0), 0.0, (0.4, 0.1), touched, (2.0, 0.5))


def test_without_offsets_a_guided_law_equals_the_law():
    params, state = GuidedParams(), guided.init(GuidedParams())
    alone = RPSState.init(params.law)
    for touched in (False, True, True, False):
        state, twist, _ = guided.step(params, state, observe(touched))
        alone, expected, _ = rps.step_with_details(params.law, alone, observe(touched))
        assert [float(x) for x in twist] == [float(x) for x in expected]
    assert int(state.steps) == 4


def test_offsets_are_added_in_turn_and_bounded():
    """G1 with bounds 0.05 m/s and 0.15 rad/s; without contact the law drives at 0.05 m/s."""
    plan = np.array([[-0.5, 0.0, 0.0], [0.0, 0.0, 1.0]])
    params = GuidedParams(RPSParams.paper(), plan, hold=2)
    state, twists = guided.init(params), []
    for _ in range(5):
        state, twist, _ = guided.step(params, state, observe(False))
        twists.append([float(x) for x in twist])
    _, unguided, _ = rps.step_with_details(params.law, RPSState.init(params.law), observe(False))
    unguided = [float(x) for x in unguided]
    slower = [unguided[0] - 0.5 * float(params.law.v_max), *unguided[1:]]
    assert_allclose(twists[:2], [slower] * 2, rtol=1e-5, atol=1e-7)
    turning = float(np.clip(unguided[2] + params.law.omega_max, None, params.law.omega_max))
    assert_allclose(twists[2:4], [[*unguided[:2], turning]] * 2, rtol=1e-5, atol=1e-7)
    assert twists[4] == unguided


test_invalid_plans_are_refused = refusals(
    lambda offsets: guided.check(GuidedParams(offsets=offsets)),
    *(
        ((offsets,), "offsets")
        for offsets in (np.zeros(3), np.zeros((0, 3)), np.full((2, 3), np.inf))
    ),
)


def test_costs_by_hand():
    """A success costs its time; a failure 1, distance, a tenth of the gap, and its early end."""
    zero = np.zeros(4)
    pose = np.zeros((4, 3))
    away = pose.copy()
    away[2, 0] = 2.0
    outcome = Outcome(
        success=np.array([True, False, False, False]),
        time=np.array([30.0, 300, 300, 150]),
        min_distance=np.array([0.04, 0.5, np.inf, 0.5]),
        contact_lost_time=zero,
        path_length=zero,
        repositions=zero,
        contact_lost_path=zero,
        mean_abs_l=zero,
        tilt=zero,
        tipped=np.array([False, False, False, True]),
        diverged=np.zeros(4, bool),
        nan_twist=np.zeros(4, bool),
        stalled=np.zeros(4, bool),
        unfelt=np.zeros(4, bool),
        base_pose=pose,
        object_pose=away,
    )
    assert_allclose(score.plan_costs(outcome, Rules()), [0.1, 1.5, 6.2, 2.0])


def test_the_temperature_weights_from_the_best_to_all_samples():
    cost = np.array([[1.0, 2.0, 3.0]])
    assert_allclose(ceiling._weights(cost, 1e-3)[0], [1, 0, 0], atol=1e-12)
    assert_allclose(ceiling._weights(cost, 1e6)[0], [1, 1, 1], rtol=1e-5)
    spread = np.sqrt(2 / 3)
    assert_allclose(ceiling._weights(cost, 1.0)[0, 1], np.exp(-1 / spread))
    assert_allclose(ceiling._weights(np.ones((1, 3)), 0.2)[0], [1, 1, 1])


def test_perturbations_depend_on_world_and_round_and_fill_one_window():
    both = SMALL.perturbations(np.array([4, 9]), 1, np.array([300.0, 60.0]))
    single = SMALL.perturbations(np.array([9]), 1, np.array([60.0]))
    assert_array_equal(both[1], single[0])
    assert not both[:, :2].any()
    # Window 10 s, knots of 5 s, in the second of three rounds: from 100 s and from 20 s on.
    for row, first in ((0, 20), (1, 4)):
        used = np.flatnonzero(both[row, 2:].any(axis=(0, 2)))
        assert used.tolist() == [first, first + 1]
    assert (SMALL.perturbations(np.array([9]), 2, np.array([60.0])) != single).any()


@pytest.mark.slow
def test_a_search_resumes_and_its_plans_succeed_in_a_sweep(tmp_path):
    options = SIZES | {"sample": 6, "setting": SHORT, "slots": 8, "out": tmp_path / "run"}
    whole = rps_jax.ceiling(CYLINDERS, **options)
    rounds = list(Checkpoints(tmp_path / "run").paths().values())
    assert len(rounds) >= 2
    rounds[-1].unlink()
    resumed = rps_jax.ceiling(CYLINDERS, **options)
    assert resumed.identical(whole)
    assert not whole.solved.all()  # else there was no search
    assert set(whole.trials.values) <= {6, 12, 18}
    assert (whole.cost.values[whole.solved.values == 0] > 1).all()
    # Each best plan is a law whose outcome in a sweep equals that in the search.
    plans = {f"{i}": GuidedParams(offsets=whole.offsets.sel(world=i).values) for i in (0, 1)}
    test = replace(SHORT, seed=seed_of(0, "test"))
    sweep = rps_jax.sweep(plans, CYLINDERS, worlds=6, setting=test, slots=8)
    for i in (0, 1):
        trial, search = sweep.sel(law=f"{i}").isel(world=i), whole.sel(world=i)
        assert int(trial.success) == int(search.solved)
        assert_allclose(float(trial.time), float(search.time), atol=0.021)


test_searches_without_worlds_or_perturbations_are_refused = refusals(
    partial(rps_jax.ceiling, CYLINDERS),
    *(({name: n}, f"{name} = {n}") for name, n in (("sample", 0), ("sample", -1), ("samples", 2))),
)


def test_the_first_worlds_and_common_failures_are_tried(monkeypatch):
    success = np.array([[0, 0, 1, 0, 0], [1, 0, 1, 0, 1]])
    results = xr.Dataset({"success": (("law", "world"), success)}, {"law": ["a", "b"]})
    assert ceiling.failed_worlds(results, ["a", "b"]).tolist() == [1, 3]
    monkeypatch.setattr(ceiling.files, "read_results", lambda path: results)

    def worlds(*lost_by, **options):
        return Ceiling(run="run", lost_by=lost_by, **options).world_indices.tolist()

    assert worlds("a", "b", sample=1) == [0, 1, 3]
    assert worlds(sample=0) == worlds("a", sample=0) == [0, 1, 3, 4]
    assert worlds("a", sample=0, most=2) == [0, 1]
    with refusing("unknown law of the run 'c'"):
        worlds("c", sample=0)


@pytest.mark.slow
def test_the_command_tries_the_failures_of_a_law(tmp_path, capsys):
    options = "--slots 8 --workers 1"
    ladder = "ladder --domain paper --worlds 6 --engine quasistatic --laws rps_tuned pursuit"
    assert command(f"{ladder} {options} --out", tmp_path) == 0
    capsys.readouterr()
    search = f"ceiling {tmp_path} --sample 2 --samples 3 --rounds 1 {options} --lost-by"
    assert command(search, "pursuit") == 0
    text = capsys.readouterr().out
    assert "A planner that knows the world" in text
    assert "of the first 2 worlds" in text
    rows = [line.split("|")[1].strip() for line in text.splitlines() if line.startswith("|")]
    assert {"box", "all"} < {*rows}
    assert {"timeout near the target", "timeout far from the target", "lost contact"} & {*rows}
    assert (tmp_path / "ceiling" / "results.nc").exists()
    assert "unknown law of the run 'rsp'" in refusal(capsys, search, "rsp")
