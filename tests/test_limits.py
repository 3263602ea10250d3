"""The cost of limits of a robot: paired losses, and the limit at a given loss."""

import math

import numpy as np
import pytest
from helpers import PAPER, refusals, results_of
from numpy.random import default_rng
from numpy.testing import assert_array_equal

from rps_jax.robot.robot import Robot
from rps_jax.trials.progress import Progress
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.world.domain import Domain, Range
from sweeps.limits import study as limits
from sweeps.limits.study import Limit, Limits, crossing

VALUE = np.arange(1.0, 41.0)


def test_a_crossing_is_where_losses_begin():
    lost = (VALUE > 30).astype(int)
    assert crossing(VALUE, lost, 0.1, harms=1) == 31
    assert crossing(VALUE, lost[::-1], 0.1, harms=-1) == 10
    assert crossing(VALUE[::-1], lost[::-1], 0.1, harms=1) == 31  # in any order
    assert math.isnan(crossing(VALUE, np.zeros(40, int), 0.01, harms=1))
    # A loss at 11 and the gain at 12 that follows cancel; those from 31 on do not.
    lost[10], lost[11] = 1, -1
    assert crossing(VALUE, lost, 0.1, harms=1) == 31


def test_a_bootstrap_interval_holds_the_crossing():
    value = default_rng(1).uniform(0, 1, 400)
    success = (value < 0.5).astype(np.int8)[None]
    results = results_of(["rps"], success=success, usual=np.ones_like(success), value=value)
    results = results.rename(world="case").assign_attrs(harms=1)
    at, low, high = limits.crossings(results, 0.1)["rps"]
    assert low <= at <= high
    assert 0.49 < low < high < 0.52


def test_every_robot_meets_the_worlds_of_the_ideal_one(monkeypatch):
    half_width = Robot().half_width
    kinds = {
        "lag": Limit("lag [s]", {"robot_lag": Range(0, 2)}, value=lambda f: f.robot_lag.values),
        "half_width": Limit("half width [m]", robots={half_width: Robot()}),
    }
    monkeypatch.setattr(limits, "LIMITS", kinds)
    progress: list[Progress] = []
    options = {"setting": Setting(seed=0, rules=Rules(horizon=6.0)), "report_to": progress.append}
    study = Limits({"rps": PAPER}, Domain(("random_cylinder",)), tuple(kinds), 3, **options)
    results = study()
    assert progress[-1].finished == study.num_trials() == 9
    rows = results["half_width"]
    assert_array_equal(rows.success, rows.usual)  # it is the ideal base itself
    assert_array_equal(rows.value, [half_width] * 3)
    assert ((results["lag"].value >= 0) & (results["lag"].value <= 2)).all()
    assert_array_equal(results["lag"].world, np.arange(3))


@pytest.mark.slow
def test_a_bounded_acceleration_makes_ramps_of_the_laws_turns():
    robot = Robot(acceleration_max=(1.0, 0.2))
    turns = limits.turning({"slow": robot}, PAPER, 4.0).sel(robot="slow")
    assert float(np.abs(np.diff(turns.asked)).max()) > 0.1  # it asks for jumps
    assert float(np.abs(np.diff(turns.done)).max()) <= 0.2 * 0.02 + 1e-4  # [rad/s] in a step


test_an_unknown_limit_is_named = refusals(
    Limits({"rps": PAPER}, limits=("leg",), worlds=1), ((), "did you mean 'lag'")
)
