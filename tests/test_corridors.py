"""The study of corridors: fitted widths, chosen lookaheads, kinds of failures, equal worlds."""

import math

import numpy as np
import pytest
import xarray as xr
from helpers import PAPER, refusing, results_of
from numpy.random import default_rng

from rps_jax.runs import execution
from rps_jax.runs.plan import Plan
from rps_jax.runs.run import Run
from rps_jax.trials.progress import no_progress
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.world.domain import parse_domain
from rps_jax.world.tasks.corridor import BASE, OBJECT
from sweeps.corridors import costs, maps, parity, study
from sweeps.corridors.widths import fit
from sweeps.study_base import run_together

RANDOM = default_rng(4)


def drawn(plateau: float, middle: float, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Return widths [m] and outcomes of 4,000 worlds on a known curve."""
    width = RANDOM.uniform(1.1, 2.5, 4000)
    return width, RANDOM.uniform(size=4000) < plateau / (1 + np.exp(-(width - middle) / spread))


@pytest.mark.parametrize(
    ("curve", "level"),
    [((0.998, 1.4, 0.1), 0.9), ((0.999, 1.4, 0.1), 0.99), ((0.8, 1.3, 0.05), 0.7)],
)
def test_a_fitted_width_is_that_of_the_curve(curve, level):
    plateau, middle, spread = curve
    at, low, high = fit(*drawn(*curve), 1.1, 2.5).needed(level)
    true = middle + spread * math.log(level / (plateau - level))
    assert low <= at <= high
    assert at == pytest.approx(true, abs=0.2)
    assert low - 0.03 <= true <= high + 0.03  # the step of the grid is 2.2 cm


def test_a_width_beyond_the_worlds_is_infinite_and_one_below_is_the_least():
    assert fit(*drawn(0.93, 1.3, 0.1), 1.1, 2.5).needed(0.99) == (math.inf,) * 3
    assert fit(*drawn(1.0, 2.6, 0.1), 1.1, 2.5).needed(0.9)[0] == math.inf
    assert fit(*drawn(1.0, 0.3, 0.02), 1.1, 2.5).needed(0.9) == (1.1,) * 3


def test_the_best_lookahead_is_chosen_in_worlds_that_begin_free():
    count = study.CENTRES.size
    lookahead = np.repeat(study.CENTRES, 20)
    success = np.zeros((2, lookahead.size), int)
    success[0, 20:35] = success[1, -20:] = 1
    touch, time = np.zeros((2, 20 * count)), np.full((2, 20 * count), 50.0)
    touch[:, :5], time[:, :5] = OBJECT, 0.0  # in a wall at the start
    choice = results_of(
        ("a", "b"), success=success, wall_touch=touch, time=time, lookahead=lookahead
    )
    best = study.best_lookaheads(choice)
    assert best == {"a": round(study.CENTRES[1], 2), "b": round(study.CENTRES[-1], 2)}
    (_, *spans, _), first, _ = study.lookahead_table(choice)
    assert len(spans) == count
    assert first[2].startswith("75.0 %")


def test_each_failure_has_the_kind_of_its_end():
    changes = {
        "base touched": {"wall_touch": BASE},
        "object touched": {"wall_touch": OBJECT},
        "lost contact": {"contact_lost_time": 200.0},
        "never touched": {"min_distance": np.inf},
        "fell over": {"tipped": 1},
        "out of time": {"time": 600.0},
        "diverged": {"diverged": 1},
    }
    defaults = {
        "success": 0,
        "wall_touch": 0,
        "contact_lost_time": 1.0,
        "min_distance": 0.5,
        "tipped": 0,
        "diverged": 0,
        "time": 90.0,
    }
    columns = {
        name: [end.get(name, value) for end in changes.values()] for name, value in defaults.items()
    }
    assert [study.KINDS[i] for i in study.failure_kinds(results_of((), **columns))] == list(changes)
    columns["success"] = [1] * len(changes)
    assert (study.failure_kinds(results_of((), **columns)) == -1).all()


@pytest.mark.slow
def test_plans_that_run_together_have_the_results_of_each_alone():
    setting = Setting("quasistatic", seed=3, rules=Rules(horizon=20.0))
    plans = [
        Plan(parse_domain("wide,objects=random_cylinder", None, task), 4, {"rps": PAPER}, setting)
        for task in ("corridor,width=1.42", "corridor,width=1.8,turn_angle=0.2")
    ]
    for plan, together in zip(plans, run_together(plans, Run(None, no_progress)), strict=True):
        alone = execution.run_plan(plan, None)
        xr.testing.assert_allclose(together, alone, rtol=1e-3, atol=1e-3)


def test_an_interval_is_shown_unless_it_is_a_point():
    width, success = drawn(0.92, 1.3, 0.1)
    text = study.width_text(fit(width[:200], success[:200], 1.1, 2.5), 0.93)
    assert text.startswith("not within the widths [1.")
    assert study.width_text(fit(*drawn(1.0, 0.3, 0.02), 1.1, 2.5), 0.9) == "at most 1.10 m"


def test_the_table_of_parity_counts_equal_outcomes():
    reference = results_of(("rps_tuned",), success=np.array([[1, 1, 0, 0]]))
    fused = results_of(("rps_tuned",), success=np.array([[1, 0, 0, 0]]))
    outcomes = xr.DataTree.from_dict({"path reference": reference, "path fused": fused})
    (table,) = parity.Parity(rows=("path",)).report_tables(outcomes)
    _, (name, _, _, law, *rates, changes) = table.rows
    assert (name, law, changes) == ("path", "rps_tuned", "+0 -1")
    assert [rate.split()[0] for rate in rates] == ["50.0", "25.0", "75.0"]


def test_all_rows_of_tasks_can_be_run():
    parity.Parity().validate()
    for task in costs.TASKS.values():
        costs.domain_of(task)


def test_costs_are_relative_to_reach():
    cost = np.array([[2e-5, 1e-5], [2e-5, 3e-5]])
    results = xr.Dataset({"cost": (("task", "round"), cost)})
    (table,) = costs.Costs(tasks=("reach", "path")).report_tables(results)
    assert table.rows[1][1:3] == ["10.0 µs", "1.000"]
    assert table.rows[2][2:] == ["2.000", "1.00 to 3.00"]


def test_a_push_in_a_map_is_found_and_a_broken_map_is_one_sentence(tmp_path):
    image = np.full((40, 100), 205, np.uint8)
    image[5:35, 5:95] = 254
    (tmp_path / "hall.pgm").write_bytes(b"P5 100 40 255\n" + image.tobytes())
    path = tmp_path / "hall.yaml"
    path.write_text("image: hall.pgm\nresolution: 0.1\norigin: [-1, 0, 0]\n")
    scale, start, goal, cells = maps.push_of(path)
    assert (scale, cells) == (1, 4000)
    assert start[1] == pytest.approx(2, abs=0.6)
    assert 4 < goal[0] - start[0] < 10
    for text, message in (
        ("image: [", "is no YAML mapping"),
        ("image: none.pgm", "image"),
        ("image: hall.pgm", "resolution = None"),
    ):
        path.write_text(text)
        with refusing(message):
            maps.push_of(path)
