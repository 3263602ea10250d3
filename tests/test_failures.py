"""Studies of failures: severity, rare events, attacks, Sobol indices and regression worlds."""

import numpy as np
import pytest
import xarray as xr
from helpers import (
    CYLINDERS,
    PAPER,
    ROOT,
    printed,
    refusal,
    refusing,
    results_of,
    rps,
)
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

import rps_jax
from rps_jax.control.laws.rps_plus import RPSPlusParams
from rps_jax.runs.question import Run
from rps_jax.studies import attack, rare, regress, sensitivity
from rps_jax.studies.probe import Probe
from rps_jax.studies.rare import Rare
from rps_jax.trials.progress import no_progress
from rps_jax.trials.score import severity
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.world import points
from rps_jax.world.domain import DOMAINS
from sweeps.failures.drawn import of_drawn

RULES = Rules(horizon=10.0, max_lost=5.0)
BRIEF = Setting("quasistatic", rules=RULES)


# --- severity ------------------------------------------------------------------------------


def severity_of(success, time, missed, lost, tilt, rules=RULES):
    """Return the severity of trials with these outcomes."""
    outcomes = {"success": success, "time": time, "contact_lost_time": lost, "tilt": tilt}
    return severity(outcomes, missed, rules)


def test_severity_by_hand():
    still = [0.0, 0.002, 0.001]
    success = severity_of([1, 1, 1], [5.0, 2.0, 10.0], [0.05] * 3, [0.0, 4.0, 0.0], still)
    assert_allclose(success, [0.5, 0.8, 1.0])
    assert (success < 1).all()  # also a success at the last moment
    # 2 mrad to pi / 4 is a factor of 392.7; its root is half way in the logarithm.
    tilt = [0.002 * 392.7**0.5, 0.79]
    leaning = severity_of([1, 1], [1.0, 1.0], [0.05] * 2, [0.0] * 2, tilt)
    assert_allclose(leaning, [0.5, 1.0], rtol=1e-4)
    assert (leaning < 1).all()
    failed = severity_of([0, 0], [10.0, 3.0], [0.3, 0.0], [0.0, 5.0], [0.9, 0.0])
    assert_allclose(failed, [1.3, 1.0])


def probe_in(folder):
    return Probe(CYLINDERS, PAPER, BRIEF, Run(folder, no_progress, slots=8, workers=1))


def test_a_probe_agrees_with_a_sweep_and_resumes(tmp_path, monkeypatch):
    u = points.points_of(CYLINDERS, np.arange(8))  # one for each slot, as in other tests
    probe = probe_in(tmp_path)
    trials = probe(u)
    sweep = rps_jax.sweep({"law": PAPER}, CYLINDERS, points=u, setting=BRIEF, slots=8)
    assert_allclose(trials.time, sweep.time[0], atol=0.3)
    assert_array_equal(trials.severity >= 1, sweep.success[0] == 0)
    assert_allclose(probe.simulated, trials.time.sum())
    monkeypatch.setattr(Probe, "_simulate", None)  # a resumed probe runs no trial
    xr.testing.assert_identical(probe_in(tmp_path)(u), trials)
    with refusing("step 0 is of another search"):
        probe_in(tmp_path)(u[::-1])


# --- rare events ---------------------------------------------------------------------------


def normal_severity(p, ranges):
    """A severity that reaches 1 with probability p: the sum of four normal coordinates."""

    def score(u):
        return 1 + 0.1 * (stats.norm.ppf(u[:, :4]).sum(axis=1) / 2 - stats.norm.isf(p))

    return score, ["range"] * ranges + ["noise"] * 2


def simulate(score, kinds, options, seed=0):
    """Result of a subset simulation."""
    (result,) = rare.run_together(score, [rare.subset_simulation(kinds, options, seed)])
    return result


def estimates(p, ranges, options, seeds):
    """Fields of the estimates of several subset simulations: arrays (seeds,)."""
    score, kinds = normal_severity(p, ranges)
    rows = [simulate(score, kinds, options, seed).estimate for seed in range(seeds)]
    return rare.Estimate(*np.array(rows).T)


def test_subset_simulation_is_unbiased_and_its_interval_covers():
    p, low, high, variation, _ = estimates(0.01, 12, Rare(particles=1000, groups=10), 60)
    assert abs(p.mean() / 0.01 - 1) < 3 * p.std() / p.mean() / np.sqrt(60)
    assert np.mean((low <= 0.01) & (high >= 0.01)) >= 0.9
    assert np.mean(variation) == pytest.approx(p.std() / 0.01, rel=0.35)


def test_concurrent_simulations_equal_separate_ones():
    score, kinds = normal_severity(0.01, 6)
    options, seeds = Rare(particles=200, groups=4, share=0.5), range(3)
    requests = []

    def counted(u):
        requests.append(len(u))
        return score(u)

    runs = [rare.subset_simulation(kinds, options, seed) for seed in seeds]
    together = rare.run_together(counted, runs)
    separate = [simulate(score, kinds, options, seed) for seed in seeds]
    assert [x.estimate for x in together] == [x.estimate for x in separate]
    assert requests[:2] == [600, 300]
    assert len(requests) == max(len(x.levels) for x in separate)


@pytest.mark.slow
def test_a_failure_probability_of_1e_5_needs_a_twentieth_of_the_worlds():
    p, *_, trials = estimates(1e-5, 18, Rare(particles=18_000, groups=20), 8)
    assert p.std(ddof=1) / 1e-5 <= 0.2
    assert np.mean(p) == pytest.approx(1e-5, rel=0.15)
    assert trials.max() <= 0.05 * rare.worlds_needed(1e-5, 0.2)


def test_estimates_where_no_trial_or_all_trials_fail():
    options = Rare(particles=200, groups=4, levels=3)
    never = simulate(lambda u: 0.5 * u[:, 0], ["range"] * 3, options)
    assert (never.estimate.p, never.estimate.low, never.estimate.high) == (0, 0, 1)
    always = simulate(lambda u: 1 + u[:, 0], ["range"] * 3, Rare(particles=200, groups=4))
    assert always.estimate.p == 1
    assert always.u.shape == (200, 3)
    results = xr.Dataset({k: ("repetition", [v]) for k, v in always.estimate._asdict().items()})
    assert rare.estimate_table(results)[1][1:] == ["1", "[1, 1]", "0.00", "200", ""]


def test_estimates_by_hand():
    # Three groups of mean 2 and standard deviation 1: t with two degrees of freedom is 4.303.
    estimate = rare.combine(np.array([1.0, 2.0, 3.0]), 30)
    assert estimate.variation == pytest.approx(1 / (2 * 3**0.5))
    assert estimate.high == 1  # a probability
    assert estimate.low == pytest.approx(2 * np.exp(-4.3027 * estimate.variation), rel=1e-4)
    assert rare.worlds_needed(1e-5, 0.2) == pytest.approx(2.5e6, rel=1e-4)
    drawn = of_drawn(25, 1000)
    assert (drawn.p, drawn.variation) == (0.025, pytest.approx((0.975 / 25) ** 0.5))
    assert drawn.low < 0.025 < drawn.high


@pytest.mark.slow
def test_the_command_compares_subset_simulation_with_drawn_worlds(tmp_path, capsys):
    domain = "wide,objects=random_cylinder,distance=0.7:0.72,bearing=-0.3:0.3"
    options = f"--law rps --engine quasistatic --domain {domain} --particles 40 --groups 4"
    options += f" --horizon 20 --brute 30 --slots 8 --workers 1 --out {tmp_path / 'run'}"
    command = [ROOT / "sweeps" / "failures" / "drawn.py", *options.split()]
    text = printed(capsys, *command)
    assert "| drawn worlds " in text
    assert "intervals hold the rate of the drawn worlds" in text
    assert "holds another run" in refusal(capsys, *command, "--seed", 1)


# --- attack --------------------------------------------------------------------------------


def synthetic_trials(self, at):
    """Trials of a law that fails with small, slippery and heavy objects, partly by noise."""
    u = dict(zip(points.names(self.domain), at.u.T, strict=True))
    depth = 1.5 * u["mass"] + u["friction_ground"] + 0.5 * u["lateral"] + 0.2 * u["key_0"] - 2.8
    success = depth < 0
    time = np.where(success, 80 * np.exp(np.minimum(depth, 0)), 300.0)
    distance = np.where(success, 0.05, 0.05 + np.maximum(depth, 0))
    still = np.zeros((2, len(time)))
    severe = severity_of(success, time, distance, *still, self.setting.rules)
    columns = {"success": success * 1.0, "time": time, "left": distance, "severity": severe}
    variables = {name: ("world", values) for name, values in columns.items()}
    return xr.Dataset({"u": (("world", "quantity"), at.u), **variables})


@pytest.fixture
def synthetic(monkeypatch):
    """Probes simulate nothing, and attacks store no worlds."""
    monkeypatch.setattr(Probe, "_simulate", synthetic_trials)
    monkeypatch.setattr(attack.Attack, "_store_worst", lambda *_: None)


SMALL = {"generations": 12, "batch": 32, "drawn": 600, "cells": 8, "repeats": 1, "check_again": 0}


@pytest.mark.slow
def test_an_attack_fills_many_more_cells_than_drawn_worlds(synthetic):
    results = rps_jax.attack("rps", "wide", **SMALL)
    assert results.margin.sizes == {"object": 3, "size": 8, "com_offset": 8, "friction_robot": 8}
    assert results.failing[-1] == (results.margin >= 0).sum() == results.sizes["elite"]
    assert attack.yields(results)["times"] > 4
    assert (np.diff(results.severity) <= 0).all()
    worlds, elite = points.worlds_at("wide", results.u), results.isel(elite=0)
    at = {axis: float(worlds[axis][0]) for axis in ("com_offset", "friction_robot")}
    margin = results.margin.sel(object=elite.elite_object)
    assert float(elite.severity) - 1 in margin.sel(at, method="nearest").values
    assert {"random_box", "random_cylinder"} <= set(results.elite_object.values)


def test_a_killed_attack_resumes_with_the_same_results(synthetic, tmp_path):
    short = SMALL | {"generations": 7, "drawn": 100, "check_again": 4}
    whole = rps_jax.attack("rps", "wide", **short)
    rps_jax.attack("rps", "wide", **short | {"generations": 5}, out=tmp_path)
    checkpoints = sorted((tmp_path / "parts").iterdir())
    checkpoints[3].write_bytes(b"damaged")
    resumed = rps_jax.attack("rps", "wide", **short, out=tmp_path)  # the search goes on
    xr.testing.assert_identical(resumed.drop_attrs(), whole.drop_attrs())
    with refusing("holds another run"):
        rps_jax.attack("rps", "hostile", **short, out=tmp_path)


def test_an_elite_fails_whatever_the_noise(synthetic):
    """A fifth of a severity depends on the noise; four trials remove most accidental failures."""
    probe = Probe(DOMAINS["wide"], PAPER, BRIEF)
    rng = default_rng(0)

    def failure_rate(results):
        u = np.repeat(results.u.values, 8, axis=0)
        u[:, results.quantity.values == "key_0"] = rng.random((len(u), 1))
        return float((probe(u).success == 0).mean())

    once, often = (rps_jax.attack("rps", "wide", **SMALL | {"repeats": n}) for n in (1, 4))
    assert failure_rate(often) > failure_rate(once) + 0.02


@pytest.mark.slow
def test_the_command_searches_checks_lists_and_draws(tmp_path, capsys):
    """Cells that are tried fail within a short horizon, also in C MuJoCo."""
    out = tmp_path / "run"
    command = "attack --engine quasistatic --cells 2 --batch 8 --generations 2 --drawn 3 "
    command += f"--horizon 1 --check-again 2 --worst 2 --slots 8 --workers 1 --out {out}"
    printed(capsys, command.replace("generations 2", "generations 1"))
    text = printed(capsys, command)  # the search goes on, with other elites
    assert "2 of 2 elites" in text
    assert f"rps replay {out / 'worlds'} 0 --law rps_tuned" in text
    assert [path.name for path in out.glob("*.png")] == ["archive.png"]
    assert rps(command) == 0  # resumes, with the same report
    reports = [output.split("## Failing cells")[1] for output in (text, capsys.readouterr().out)]
    assert reports[0] == reports[1]
    (out / "manifest.json").write_text("{")
    assert "manifest.json is corrupt" in refusal(capsys, command)


# --- Sobol indices -------------------------------------------------------------------------


def analyzed(design, success):
    """Indices of a design whose trials succeed where `success` (worlds,) is true."""
    time, distance = np.where(success, 80.0, 300.0), np.where(success, 0.05, 0.5)
    columns = {"success": success.astype(np.int8)[None], "time": time[None]}
    columns |= {"min_distance": distance[None], "distance": np.ones(success.size)}
    results = results_of(**columns)
    return sensitivity.analyze(design, results.assign_coords(world=np.arange(success.size)))


def test_a_decisive_quantity_has_all_the_variance():
    design = sensitivity.Sensitivity("rps", "wide", 8192)
    assert {"noise", "key", "object", "mass", "com_bearing", "shape"} <= set(design.factors)
    assert design.groups.count("key") == 2  # both numbers of the key
    assert design.groups.count("noise") == 1  # of the skin
    assert len(design.factors) == 24 + 1 + 2  # ranges, the object, corners and the key
    assert (design.base, design.plan.worlds) == (256, 256 * (len(design.factors) + 2))
    results = analyzed(design, design.u()[:, design.groups.index("mass")] < 0.8)
    assert sensitivity.rank_factors(results)[0] == "mass"
    first, total = (results[name].sel(output="success") for name in ("first", "total"))
    assert float(first.sel(factor="mass")) == pytest.approx(1, abs=0.2)
    assert float(total.sel(factor="mass")) == pytest.approx(1, abs=0.2)
    assert np.abs(total.drop_sel(factor="mass")).max() < 0.02
    assert sensitivity.index_table(results)[1][0] == "mass of the object"
    assert sensitivity.reliability(results).startswith("Trials fail at ")
    assert "run more worlds" not in sensitivity.reliability(results)
    never = analyzed(design, np.ones(design.plan.worlds, bool))
    assert sensitivity.reliability(never).endswith("run more worlds.")
    assert (never.total.sel(output="success") == 0).all()


def test_two_quantities_that_only_matter_together_have_only_total_indices():
    """Success where both are on the same side (XOR): first-order indices 0, totals 1."""
    design = sensitivity.Sensitivity("rps", "wide", 16_384)
    u = design.u()
    a, b = (u[:, design.groups.index(name)] > 0.5 for name in ("mass", "gap"))
    results = analyzed(design, a == b).sel(output="success", factor=["mass", "gap"])
    assert_allclose(results.first, 0, atol=0.1)
    assert_allclose(results.total, 1, atol=0.1)


def test_a_design_needs_four_worlds_for_each_factor():
    with refusing(r"worlds = 50 is not allowed: 27 quantities need"):
        sensitivity.Sensitivity("rps", "wide", 50).check()


def test_the_command_of_sensitivity_draws_and_continues(tmp_path, capsys):
    options = "--engine mujoco --horizon 1 --slots 8 --workers 1 --out"
    assert rps(f"sensitivity --domain hardware --worlds 32 {options}", tmp_path) == 0
    assert "Trials fail at" in capsys.readouterr().out
    for name in ("sobol", "interactions"):
        assert (tmp_path / f"{name}.png").stat().st_size > 5000
    indices = rps_jax.load(tmp_path)
    assert indices.total.sizes["factor"] == 5


# --- regression worlds ---------------------------------------------------------------------


def test_the_regression_set_is_small_hard_and_diverse():
    known = regress.worlds()
    assert known.u.shape == (200, len(points.names(DOMAINS["wide"])))
    assert regress.FILE.stat().st_size < 200_000
    assert known.known.values.tolist() == ["rps", "rps_tuned", "rps_plus", "learned_gru"]
    points.check_points(DOMAINS["wide"], known)
    assert len(np.unique(known.u, axis=0)) == 200
    failed = known.success.values == 0
    assert (failed.sum(axis=1) >= 10).all()  # of each law
    assert (known.severity.values > 0.7).any(axis=0).all()  # some law fails, or nearly
    assert (~failed).any(axis=0).sum() > 50  # some law succeeds


@pytest.mark.slow
def test_a_law_of_the_file_succeeds_again():
    """Outcomes of hard worlds are chaotic: another processor may change a few."""
    results = rps_jax.regress({"again": RPSPlusParams()}, worlds=6, slots=8)
    known = results.known_success.sel(known="rps_plus")
    assert int((results.success[0] == known).sum()) >= 4


def test_gains_and_losses_by_hand():
    known = np.array([[1, 1, 0, 0], [0, 1, 0, 0]])
    results = results_of(
        ["mine"],
        success=[[1, 0, 1, 0]],
        time=np.full((1, 4), 30.0),
        min_distance=[[0.05, 0.25, 0.05, 0.5]],
        contact_lost_time=np.zeros((1, 4)),
        tilt=np.zeros((1, 4)),
        distance=np.ones(4),
    ).assign_coords(known=["a", "b"], object=("world", ["random_box"] * 2 + ["random_prism"] * 2))
    results["known_success"] = ("known", "world"), known
    results["known_severity"] = ("known", "world"), np.where(known, 0.3, 1.1)
    assert regress.success_table(results)[-1] == ["mine", "2 of 4", "+1 -1", "+2 -1", "1"]
    assert regress.changes(results, "mine", "a")[1:] == [
        ["1", "random box", "succeeds", "fails, 25 cm off"],
        ["2", "random prism", "fails, 10 cm off", "succeeds"],
    ]


@pytest.mark.slow
def test_the_command_of_regress_reports_known_laws(tmp_path, capsys):
    options = "--engine mujoco --horizon 5 --slots 8 --workers 1 --out"
    text = printed(capsys, f"regress --laws rps --worlds 1 {options}", tmp_path)
    assert "rps_plus (file)" in text
    assert "simulated s per s" in text
