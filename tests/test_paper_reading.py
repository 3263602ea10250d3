"""The study of the paper's readings: likelihood, proposals, posterior and tables."""

import numpy as np
import pytest
import xarray as xr
from helpers import ROOT
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax.control.laws.rps import RPSParams
from rps_jax.robot.robot import ROBOTS
from rps_jax.robot.skin import LINE, POINT
from rps_jax.world import paper
from rps_jax.world.objects import PAPER_OBJECTS
from sweeps import render_tables
from sweeps.paper_reading import drawing, evidence, experiments, printed
from sweeps.paper_reading.printed import PRINTED, Printed
from sweeps.paper_reading.unknowns import NAMES, UNKNOWNS, Proposal, redraw_hardware, texts

RNG = default_rng(0)


@pytest.mark.parametrize(
    ("number", "simulated", "trials", "likelihood"),
    [
        # With half a success in one trial both rates are Beta(1, 1): all counts are equally likely.
        (Printed(5, trials=8), 0.5, 1, 1 / 9),
        # Beta(3/2, 3/2): C(2, 1) B(5/2, 5/2) / B(3/2, 3/2) = 2 (3 pi / 128) / (pi / 8).
        (Printed(1, trials=2), 1, 2, 0.375),
        (Printed(0, trials=2), 1, 2, 0.3125),
        (Printed(1, trials=1), 1, 1, 0.9),
        (Printed(1, trials=1), 0, 1, 0.1),
        (Printed(0.03, deviation=0.004), 0.034, 8, np.exp(-0.5) / (0.004 * np.sqrt(2 * np.pi))),
        (Printed(0.03, deviation=0.004), np.nan, 8, 0),
    ],
)
def test_the_likelihood_of_a_number_equals_one_by_hand(number, simulated, trials, likelihood):
    with np.errstate(divide="ignore"):
        ours = number.log_likelihood(np.array([simulated]), trials)
    assert_allclose(np.exp(ours), [likelihood], rtol=1e-6)


def test_the_papers_numbers_are_all_there():
    parts = [printed.part_of(name) for name in PRINTED]
    assert [parts.count(part) for part in printed.PARTS] == [6, 18, 3, 5]
    assert PRINTED["Table II, RPS, nonuniform box S1"] == Printed(19, 24)
    assert PRINTED["hardware, box: D"].value == 0.032


def test_the_counts_of_table_ii_and_of_some_targets():
    dims = ("draw", "law", "object", "friction", "target")
    x, y = np.array(paper.TARGETS).T
    success = xr.DataArray(
        np.zeros((1, 3, 3, 2, 24), bool),
        {"law": list(paper.LAWS), "object": list(PAPER_OBJECTS), "friction": ["S1", "S2"]}
        | {"target_x": ("target", x), "target_y": ("target", y)},
        dims,
    )
    success[:, 1] = x > 0  # NPS reaches 10 targets ahead
    success[:, 0, 2, 0] = (x == 0) & (y == 1)
    counts = printed.counts(success)
    assert set(counts) == {n for n in PRINTED if not n.startswith(("hardware", "Fig. 6"))}
    sizes = {name: (int(count[0]), trials) for name, (count, trials) in counts.items()}
    assert sizes["Table II, NPS, cylinder S2"] == (10, 24)
    assert sizes["NPS, beside or behind"] == (0, 84)
    assert sizes["APS, not straight ahead"] == (0, 132)
    assert sizes["RPS, nonuniform box to (0, 1)"] == (1, 2)


def test_d_and_time_count_from_the_start_or_in_contact():
    u = np.full((2, len(NAMES)), 0.5)
    for name, choice in (("counts_d", 0.9), ("counts_time", 0.9)):
        u[:, NAMES.index(name)] = (0.1, choice)
    u[:, NAMES.index("robot_slip")] = 0
    shape, gap = (2, 2, 8), 0.03  # [m] the middle of its range, at v_approach
    approach = gap / RPSParams().v_approach
    trials = {"success": 1.0, "time": 80.0, "mean_abs_l": 0.04, "contact_lost_time": 17.0}
    trials = {name: np.full(shape, x) for name, x in trials.items()}
    trials["success"][:, 1] = 0
    found = experiments._hardware_numbers(u, trials)
    assert_allclose(found["hardware, box: D"], [0.04, 0.04 * (63 - approach) / 80])
    assert_allclose(found["hardware, box: time"], [80, 80 - approach])
    assert list(found["hardware, cylinder: successes"]) == [0, 0]
    assert np.isnan(found["hardware, cylinder: D"]).all()


def test_proposals_are_densities_whose_weights_recover_a_posterior():
    at = NAMES.index("saturate_first")
    weights = dict.fromkeys(("text", "hardware", "simulation"), np.ones(400))
    fitted = Proposal.fitted(RNG.random((400, len(NAMES))) ** 1.5, weights)
    assert_allclose(fitted.shares.sum(1), 1)
    assert (fitted.shares[:, 0] > 1.2 * fitted.shares[:, -1]).all()
    u = Proposal.prior().sample(50, RNG)
    assert_allclose(Proposal.prior().log_density(u), 0, atol=1e-12)
    # The likelihood of "yes" is four times that of "no", whatever the proposal.
    tilted = Proposal(np.where(np.arange(len(NAMES))[:, None] == at, fitted.shares, 1 / 6))
    u = tilted.sample(20_000, RNG)
    yes = np.array(texts(u, "saturate_first")) == "yes"
    results = xr.Dataset(
        {
            "u": (("draw", "unknown"), u),
            "log_proposal": ("draw", tilted.log_density(u)),
            "log_likelihood": (("draw", "number"), np.log(np.where(yes, 4, 1))[:, None]),
            "simulation": ("draw", np.arange(len(u)) // 2),
        },
        {"number": ["hardware, box: D"]},
    )
    posterior = evidence.normalised(evidence.log_weights(results))
    assert posterior[yes].sum() == pytest.approx(0.8, abs=0.015)
    rows = {tuple(row[:2]): row for row in evidence.readings_table(results)[1:]}
    assert rows["yes", "no"][-1].startswith(("39 ±", "40 ±", "41 ±"))
    left_out = evidence.normalised(evidence.log_weights(results, without="hardware, box: D"))
    assert left_out[yes].sum() == pytest.approx(0.5, abs=0.015)


def test_redrawn_hardware_leaves_the_text_and_the_simulation():
    u = Proposal.prior().sample(3, RNG)
    redrawn = redraw_hardware(Proposal.prior(), u, 4, RNG)
    assert redrawn.shape == (12, len(NAMES))
    for i, unknown in enumerate(UNKNOWNS.values()):
        if unknown.part == "hardware":
            assert len(np.unique(redrawn[:, i])) == 12
        else:
            assert_array_equal(redrawn[:, i], np.repeat(u[:, i], 4))


AS_TOLD = {  # a trial as the text tells of Fig. 6
    "contact_type": [0, POINT, POINT, LINE, LINE, LINE, LINE],
    "l": [0, -0.2, -0.22, -0.2, -0.1, 0.0, 0.0],
    "a_r": [0, -9.5, -9.8, -10, -10, -1, 0],
    "realigning": [0, 0, 0, 0, 1, 0, 0],
}


def observed(columns, success):
    variables = {name: ("time", np.asarray(values)) for name, values in columns.items()}
    return experiments.observations(xr.Dataset(variables | {"outcome_success": success}))


@pytest.mark.parametrize(
    ("changes", "violated"),
    [
        ({}, set()),
        ({"l": [0, 0.2, 0.2, 0, 0, 0, 0]}, {"the right corner touches first"}),
        ({"l": [0, -0.28, -0.2, 0, 0, 0, 0]}, {"the right corner touches first"}),
        ({"a_r": [0, -8.0, -10, -10, -10, 0, 0]}, {"a_r starts near its highest"}),
        (
            {"contact_type": [0, POINT, POINT, POINT, LINE, LINE, LINE]},
            {"line contact before Realignment"},
        ),
        ({"realigning": [0, 0, 0, 0, 1, 0, 1]}, {"one Realignment State"}),
        ({"realigning": [0] * 7}, {"one Realignment State"}),
    ],
)
def test_what_the_text_tells_of_fig_6_is_observed(changes, violated):
    holds = observed(AS_TOLD | changes, 1)
    assert {name for name, value in holds.items() if not value} == {
        f"Fig. 6: {x}" for x in violated
    }


def test_nothing_holds_of_a_trial_without_contact():
    holds = observed(dict.fromkeys(AS_TOLD, [0] * 7), 0)
    assert set(holds) == {name for name in PRINTED if name.startswith("Fig. 6")}
    assert not any(holds.values())


@pytest.fixture(scope="module")
def toy():
    """Three draws: the second has all of the paper's numbers, the others half of the counts."""
    values = np.array([number.value for number in PRINTED.values()])
    simulated = np.stack([0.5 * values, values, 0.5 * values])
    trials = xr.DataArray([max(number.trials, 1) for number in PRINTED.values()], dims="number")
    numbers = xr.DataArray(simulated, {"number": list(PRINTED)}, ("draw", "number"))
    return xr.Dataset(
        {
            "simulated": numbers,
            "trials": trials,
            "log_likelihood": printed.log_likelihoods(
                numbers, trials.assign_coords(number=list(PRINTED))
            ),
            "u": (("draw", "unknown"), Proposal.prior().sample(3, RNG)),
            "log_proposal": ("draw", np.zeros(3)),
            "simulation": ("draw", np.arange(3)),
        }
    )


def test_the_closest_draw_agrees_with_the_paper(toy):
    assert evidence.closest(toy) == 1
    rows = {row[0]: row for row in evidence.numbers_table(toy)}
    assert rows["hardware, box: D"][1:4] == [
        "0.032 m",
        "0.016 [0.016, 0.032]",
        "0.032 [0.032, 0.032]",
    ]
    assert rows["Table II, RPS, cylinder S1"][-2:] == ["19 of 24", "yes"]
    assert rows["inside the interval: cells of Table II"][5] == "18 of 18"
    assert rows["inside the interval: all of these"][5] == "32 of 32"
    assert "18 of 18 cells of Table II" in evidence.summary(toy)
    posterior = {row[1]: row for row in evidence.unknowns_table(toy)}
    assert posterior["omega from the saturated v_x"][3].split()[1] in ("0", "100")


@pytest.mark.parametrize(
    ("name", "value", "agrees"),
    [
        ("Table II, RPS, cylinder S1", 15, True),  # of the paper's 19: 14.3 to 21.8
        ("Table II, RPS, cylinder S1", 22, False),
        ("Table II, RPS, box S2", 24, True),
        ("hardware, box: D", 0.0399, True),
        ("hardware, box: D", 0.041, False),
        ("hardware, box: D", np.nan, False),
        ("Fig. 6: success", 0, False),
    ],
)
def test_a_number_agrees_within_the_papers_interval(name, value, agrees):
    assert bool(evidence.agrees(name, np.array(value))) is agrees


def test_the_papers_numbers_are_drawn_beside_their_predictions(toy):
    d, time, rates = drawing.predictions(toy).axes
    assert [label.get_text() for label in d.get_yticklabels()] == ["box: D", "cylinder: D"]
    stars = [line.get_xdata()[0] for line in time.lines if line.get_marker() == "*"]
    assert stars == [89, 88]
    assert len(rates.get_yticklabels()) == 23


def test_the_page_and_the_slipping_base_agree_with_the_published_inference():
    rows = render_tables.load("reading_numbers")["rows"]
    inside = [row[-1] == "yes" for row in rows if row[0].startswith("Table II")]
    page = (ROOT / "sweeps" / "paper_reading" / "README.md").read_text()
    assert sum(inside) > 0.7 * len(inside)
    assert f"most of the {len(inside)} cells of Table II" in page
    for name, label in {"slip": "v_x", "slip_sideways": "v_y", "slip_yaw": "omega"}.items():
        row = f"reading_posterior | hardware | share of {label} that is lost"
        median = float(render_tables.cell(f"{row} | posterior: median, 5 to 95 %"))
        assert getattr(ROBOTS["slipping"], name) == pytest.approx(median, abs=0.03)
    low = render_tables.load("reading_posterior")["rows"]
    (friction,) = (row[3] for row in low if row[1] == "friction box-robot")
    assert paper.HARDWARE_ROBOT[0] == pytest.approx(float(friction.split("[")[1][:4]), abs=0.05)
