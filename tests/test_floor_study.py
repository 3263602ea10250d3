"""The study of floors: equal worlds, costs against the level floor, and pushes against a step."""

import numpy as np
from helpers import results_of

from rps_jax.world.physics import Physics
from sweeps.floors import study


def test_floors_share_worlds_but_for_slope_and_factor():
    question = study.Floors(laws=("rps",), worlds=2)
    plans = [question._plan(f"slope={x}") for x in (0.0, 0.1)]
    level, steep = (plan.domain for plan in plans)
    assert level.slope != steep.slope
    assert (level.slope_bearing, level.families) == (steep.slope_bearing, steep.families)
    assert question.num_trials() == 2 * (len(study.SLOPES) + len(study.FACTORS))


def test_costs_are_those_of_equal_worlds():
    success = np.array([[[1, 1, 0, 1]], [[1, 0, 1, 1]]])  # (floor, law, world)
    time = np.array([[[10.0, 20, 300, 40]], [[20.0, 300, 60, 80]]])
    results = results_of(("a",), success=success[0], time=time[0]).expand_dims(floor=["0°", "6°"])
    results = results.assign(
        success=(("floor", "law", "world"), success), time=(("floor", "law", "world"), time)
    )
    uphill = np.array([True, True, False, False])
    header, level, steep = study.cost_table(results, "0°", {"uphill": uphill})
    assert header[-2:] == ["against 0°", "time ratio"]
    assert level[3][:7] == "100.0 %"[:7]
    assert steep[3].startswith("50.0 %")
    assert steep[4:] == ["60 s", "+1 -1, p = 1", "2.00"]


def test_the_force_on_a_step_is_that_of_the_soft_contact():
    """Rigid bodies tip at 115 N; here the softness of the ground and the edge decide."""
    soft, hard = (
        study.push_against_step(0.002, 0.01, Physics(**ground)) for ground in study.GROUNDS.values()
    )
    assert soft[0] == hard[0] == "climbs"
    assert hard[1] > 2 * soft[1] > 300
