"""Fits to logs: validation of logs, their statistics, and the coverage of the posterior."""

import re
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import bad_tables
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from helpers import (
    ROOT,
    printed,
    refusal,
    refusing,
    rps,
    same,
    setting_of,
)
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

import rps_jax
from rps_jax.geometry import solid
from rps_jax.record import bag
from rps_jax.robot.robot import Robot
from rps_jax.robot.skin import with_contacts
from rps_jax.tuning import fit, logs, posterior
from rps_jax.world import domain as domains
from rps_jax.world import points
from sweeps.fit import bags, least_squares, methods, windows

SHELL = Robot().shell


COLUMNS = "time,x,y,yaw,contact_type,contact_x,contact_y,v_x,v_y,omega,target_x,target_y"


def log_table(count=400):
    """Return the log of a base that drives ahead at 0.05 m/s with a contact at its front."""
    time = 0.02 * np.arange(count)
    values = {"contact_type": 1, "contact_x": 0.3625, "contact_y": 0.05, "v_x": 0.05}
    values |= {"target_x": 2.0, "target_y": 0.5, "time": time, "x": 0.05 * time}
    return pd.DataFrame(0.0, range(count), COLUMNS.split(",")).assign(**values)


def drive(delay=0, slip: Any = 0.0, blocked=0.0, noise=0.0, start=0.0, speed=0.1, period=0.02):
    """Return the log of a base that slips, lags or is blocked for a share of its commands.

    The slip is one number, or those of v_x, v_y and omega.
    """
    rng, time = default_rng(0), np.arange(0.0, 12.0, period)
    count = len(time)
    twist = np.stack([speed + 0 * time, 0.03 * np.sin(time), 0.3 * np.sin(0.7 * time)], -1)
    blocks = (np.arange(count) % 200 < 200 * blocked)[:, None]
    share = np.where(blocks, 0.0, 1 - np.array(slip))
    done = share * np.concatenate([np.zeros((delay, 3)), twist[: count - delay]])
    yaw = start + period * np.cumsum(done[:, 2])
    velocity = solid.rotate(yaw, done)[:, :2]
    pose = np.column_stack([period * np.cumsum(velocity, 0), yaw]) + noise * rng.normal(
        size=(count, 3)
    )
    columns = dict(zip(("x", "y", "yaw", "v_x", "v_y", "omega"), (*pose.T, *twist.T), strict=True))
    touch = {"contact_type": 1, "contact_x": 0.3625, "contact_y": 0.05}
    return pd.DataFrame({"time": time, **columns, **touch, "target_x": 2.0, "target_y": 0.5})


@pytest.mark.parametrize(
    "faults",
    [
        {"delay": 25},
        {"slip": 0.5},
        {"slip": 0.9},
        {"slip": (0.1, 0.9, 0.9)},
        {"slip": (0.0, 0.2, 0.45)},
        {"blocked": 0.7},
        {"blocked": 1.0},
        {"blocked": 1.0, "noise": 0.005, "speed": 0.3},
        {"noise": 0.02},
        {"start": 40.0},
        {"speed": 0.0, "noise": 0.01},
        {"delay": 2, "slip": 0.3, "blocked": 0.5, "period": 0.1},
    ],
    ids=str,
)
def test_imperfect_robots_have_no_wrong_units(faults, tmp_path):
    table = drive(**faults)
    log = logs.read(written(tmp_path / "log.csv", table), SHELL)
    assert_allclose(log.columns["pose"], table[["x", "y", "yaw"]], atol=1e-9)


def written(path, table):
    table.to_csv(path, index=False)
    return path


def put(column, value, where: Any = slice(None)):
    def change(table):
        table.loc[where, column] = value
        return table

    return change


WRONG = {
    "yaw may be in deg": lambda table: table.assign(yaw=10 * table.time),
    "lacks contact_y": lambda table: table.drop(columns="contact_y"),
    "has a gap of 2 s at": lambda table: table.drop(index=range(100, 199)),
    "lasts 1.9 s: it must last 5 s": lambda table: table[:95],
    r"v_x and v_y up to 4 m/s, beyond the limit of 3: write SI units": put(
        "v_x", 4.0, slice(9, 12)
    ),
    "has no contact": put("contact_type", 0),
    r"up to \(0.480, 0.050\) m, and the robot ends at": put("contact_x", 0.48),
    r"target is 20.\d+ m from its start": put("target_x", 20.0),
    r"has 1 taxels, and the robot 42": lambda t: t.drop(
        columns=["contact_type", "contact_x", "contact_y"]
    ).assign(taxel_0=1.0),
    "lacks object_x, object_yaw": lambda t: t.assign(object_y=1.0),
}


@pytest.mark.parametrize("message", WRONG)
def test_logs_of_other_robots_are_refused(message, tmp_path, compiled, capsys):
    path = written(tmp_path / "log.csv", WRONG[message](log_table()))
    assert re.search(message, refusal(capsys, "fit", path, "--out", tmp_path / "run"))
    assert not compiled
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("kind", bad_tables.CASES)
def test_tables_are_read_as_users_write_them(kind, tmp_path, compiled):
    case = bad_tables.CASES[kind]
    result = bad_tables.result_of(case, tmp_path)
    assert (
        result == case.expected
        if case.expected == bad_tables.EQUAL
        else re.search(case.expected, result)
    )
    assert not compiled


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("log.csv --law aps", "fit needs a law that senses touch"),
        ("log.csv --engine quasistatic", "choose fused"),
        ("log.csv --robot mpo_500", "it is of another robot"),
    ],
)
def test_what_cannot_be_fitted_is_refused(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "log.csv", log_table())
    assert message in refusal(capsys, f"fit {arguments}")


def bagged(path, table, **changes):
    """Write a log as a bag."""
    steps = [
        bag.Step(
            row[0],
            row[1:4],
            row[10:12],
            int(row[4]),
            row[5:7],
            row[7:10],
            **{name: values[i] for name, values in changes.items()},
        )
        for i, row in enumerate(table.to_numpy(float))
    ]
    return bag.write(path, steps, {})


def test_a_bag_is_the_log_that_a_table_is(tmp_path):
    # A heading that a quaternion breaks.
    rows = log_table().assign(yaw=np.linspace(3.0, 3.5, 400), x=lambda t: -t.x)
    table = logs.read(written(tmp_path / "log.csv", rows), SHELL)
    result = logs.read(bagged(tmp_path / "log.mcap", rows), SHELL)
    assert result.exact is table.exact is False
    assert set(result.columns) == set(table.columns)
    for name, values in table.columns.items():
        assert_allclose(result.columns[name], values, atol=1e-6)
    signal = np.zeros((len(rows), SHELL.count))
    result = logs.read(bagged(tmp_path / "felt.mcap", rows, signal=signal), SHELL)
    assert_array_equal(result.columns["signal"], signal)


def test_traces_and_odometry_are_exclusive_and_one_is_required(tmp_path):
    with refusing("give at least one"):
        rps_jax.fit(())
    brief = setting_of(7.0)
    trace = rps_jax.push("cylinder", target=(1.0, 0.5), setting=brief)
    log = written(tmp_path / "log.csv", log_table())
    with refusing("not allowed together"):
        rps_jax.fit((trace, str(log)))
    log = logs.read(trace, SHELL)
    assert log.exact
    assert log.columns["object_pose"].shape == (len(trace.data.time), 3)
    # Of the start, 2 cm before the base: its half length, the gap and the radius of the cylinder.
    x, y, yaw = log.columns["object_pose"][0]
    assert (x, y, yaw) == pytest.approx((0.3625 + 0.02 + 0.25, 0.0, 0.0), abs=0.02)


def test_contacts_are_computed_from_taxels():
    """Two adjacent front taxels give a line; a single taxel gives a point."""
    signal = np.zeros((3, SHELL.count))
    front = np.flatnonzero(np.isclose(np.asarray(SHELL.taxels()[:, 0, 0]), 0.3625))
    signal[0, front[5:7]], signal[1, front[2]] = 1.0, 1.0
    scans = {"signal": signal, "period": np.full(3, np.inf)}
    result = with_contacts(scans, SHELL, "log")
    assert result["contact_type"].tolist() == [2, 1, 0]
    pitch = 0.58 / 12  # twelve taxels along the front
    assert_allclose(result["p_robot_contact"][0], [0.3625, 0.0], atol=1e-6)
    assert_allclose(result["p_robot_contact"][1], [0.3625, 3.5 * pitch], atol=1e-6)


def build_log(delay=0, share=1.0, count=500):
    """Return rows of a base that applies a share of a changing command, delayed by some rows."""
    time = 0.02 * np.arange(count)
    twist = np.zeros((1, count, 3))
    twist[0, :, 0] = 0.03 + 0.02 * np.sin(time)
    done = share * np.concatenate([np.zeros(delay), twist[0, : count - delay, 0]])
    pose = np.zeros((1, count, 3))
    pose[0, :, 0] = 0.02 * np.cumsum(done)
    contact = np.tile([0.3625, 0.04], (1, count, 1))
    return logs.Log(
        np.ones((1, count), bool), pose, np.ones((1, count)), contact, twist, np.array([[2.0, 1.0]])
    )


def test_delay_and_slip_are_read_off_the_base():
    """The motion is (1 - slip) (command - delay times the change of the command)."""
    result = logs.statistics(build_log(delay=10, share=0.9), 0.02)
    share, later = (float(result[f"base/follow_100_0_{i}"][0]) for i in range(2))
    assert share == pytest.approx(0.9, abs=0.02)
    assert -later / share == pytest.approx(0.2, abs=0.02)


def test_a_mirrored_log_has_a_mirrored_target():
    log = build_log()
    original, mirrored = (logs.statistics(x, 0.02).iloc[0] for x in (log, logs.mirror(log)))
    for name, sign, expected in (("base/target_2", -1, 5**-0.5), ("base/target_0", 1, 5**0.5)):
        assert original[name] == sign * mirrored[name] == pytest.approx(expected, rel=1e-3)
    same(log, logs.mirror(logs.mirror(log)))


@pytest.fixture(scope="module")
def toy():
    """Return networks trained on x = u_0 + noise of 0.1, independent of u_1."""
    rng = default_rng(0)
    u = rng.random((3000, 2))
    x = np.stack([u[:, :1] + 0.1 * rng.standard_normal((3000, 1)) for _ in range(2)], 1)
    return posterior.train(u, x)


def test_a_posterior_is_as_wide_as_the_noise_and_else_the_prior(toy):
    result = posterior.sample(toy, np.array([[0.5]]), 4000)
    assert result[:, 0].mean() == pytest.approx(0.5, abs=0.03)
    assert result[:, 0].std() == pytest.approx(0.1, rel=0.25)
    assert result[:, 1].std() == pytest.approx(np.sqrt(1 / 12), rel=0.05)


def test_four_observations_halve_the_width(toy):
    single, fourfold = (
        posterior.sample(toy, np.full((n, 1), 0.5), 2000)[:, 0].std() for n in (1, 4)
    )
    assert fourfold / single == pytest.approx(0.5, abs=0.24)


def test_a_fitted_domain_keeps_undetermined_ranges_and_all_commands_read_it(tmp_path):
    wide = domains.parse_domain("wide")
    u = default_rng(1).random((4000, len(fit.coordinates(wide))))
    at = {name: i for i, name in enumerate(fit.coordinates(wide))}
    u[:, at["mass"]] *= 0.5
    u[:, at["object"]] *= 0.3  # of three objects the first
    data = fit.summary(wide, u)
    assert data.undetermined.sel(quantity="size") == 1
    assert data.undetermined.sel(quantity="mass") == 0
    fitted = fit.fitted_domain(wide, data)
    assert fitted.size == wide.size
    assert fitted.objects == ("random_box",)
    # Even in the logarithm: from 3 (60 / 3)^0.025 to 3 (60 / 3)^0.475.
    assert fitted.mass.log
    assert fitted.mass[:2] == pytest.approx((3.23, 12.4), rel=0.03)
    with_a_box = replace(wide, objects=("box", "random_box", "random_cylinder"))
    assert fit.fitted_domain(with_a_box, fit.summary(with_a_box, u)).mass == wide.mass


@pytest.mark.slow
def test_a_log_is_fitted_from_the_shell(tmp_path, capsys, optimised):
    """A sweep accepts the fitted domain, and a bag is read as its table."""
    options = "--physics default,timestep=0.01 --domain wide,objects=random_box --worlds 96"
    ask = f"fit {bagged(tmp_path / 'log.mcap', log_table())} {options} --window 5 --out {tmp_path}"
    text = printed(capsys, ask)
    assert "undetermined" in text
    # No world gives such a log: its object never slides.
    words = " ".join(text.split())
    assert re.search(r"\d+ of 18 of the response to commands, .* fit is invalid", words)
    result = domains.parse_domain(str(tmp_path / "fitted.json"))
    assert result.objects == ("random_box",)
    assert (tmp_path / "marginals.png").stat().st_size > 10_000
    content = (tmp_path / "results.nc").read_bytes()
    assert rps(ask) == 0
    assert (tmp_path / "results.nc").read_bytes() == content


def test_the_table_of_bags_counts_intervals_with_the_truth_and_moved_bounds():
    dims, low = ("source", "log", "quantity"), np.zeros((2, 2, 2))
    low[0, 1, 1] = -0.03
    columns = {"low": low, "high": np.ones((2, 2, 2)), "undetermined": [[[0, 0], [1, 1]]] * 2}
    columns["rank"] = [[[0.5, 0.01], [0.5, 0.5]], [[0.5, 0.5], [0.5, 0.5]]]
    variables = {name: (dims, values) for name, values in columns.items()}
    result = xr.Dataset(variables, {"source": ["bag", "the log itself"]})
    _, ours, theirs = bags.table(result)
    assert ours[1:] == ["2", "3 of 4, 75.0 %", "1 of 2, 50.0 %", "3 of 4, 75.0 %", "3 of 4, 75.0 %"]
    assert theirs[1:] == ["2", "4 of 4, 100.0 %", "2 of 2, 100.0 %", "", ""]


# --- replayed windows ----------------------------------------------------------------------

PINNED = "mass=20:20,size=0.2:0.2,aspect=1:1,height=0.5:0.5,load_size=0.15:0.15"


class Pushes(NamedTuple):
    """Windows of pushes at the front of the base, without a log."""

    windows_: least_squares.Windows

    @property
    def first(self):
        return np.zeros(len(self.windows_.pose))

    def windows(self, latency):
        return self.windows_


def test_replayed_windows_determine_friction_and_the_centre_of_mass():
    """Minima of noiseless windows have the true values, to 3 %.

    Contacts that open and close make residuals rough, in float64 too: rounding selects the minimum.
    """
    rng, zero = default_rng(1), np.zeros((16, 1))
    domain = domains.parse_domain(f"wide,objects=random_box,{PINNED},friction_ground=0.3:0.3")
    twist = rng.uniform([0.03, -0.02, -0.05], [0.05, 0.02, 0.05], (16, 1, 3))
    y, yaw = rng.uniform(-0.1, 0.1, (16, 1)), rng.uniform(-0.2, 0.2, (16, 1))
    pose = np.hstack([0.3625 + 0.2 * (np.cos(yaw) + np.sin(abs(yaw))), y, yaw])
    pushes = Pushes(
        least_squares.Windows(np.repeat(twist, 20, 1), pose, 0 * pose, np.hstack([zero] * 6))
    )
    replay = least_squares.Replay(domain, [pushes], rps_jax.Setting("fused"), True)
    names = points.names(domain)
    assert [names[i] for i in replay.active] == ["com_offset", "com_bearing", "friction_robot"]
    start = rng.random((6, len(names)))
    truth = np.repeat(start[:1], 6, 0)
    truth[:, replay.active] = [0.6, 0.7, 0.4]
    whitened, _ = replay.derivatives(truth)
    common = (np.sqrt(17) - 1) * whitened[0].mean(axis=0)
    measured = pushes.windows_._replace(result=whitened[0] + common)
    replay = replay._replace(tracks=[Pushes(measured)])
    u, r, j = replay.minima(start)
    least = np.argmin(least_squares.cost(r))
    assert_allclose(u[least, replay.active], [0.6, 0.7, 0.4], rtol=0.03)
    samples, eigenvalues = least_squares.sample(replay, u, r, j, 500, 0)
    # Minima that are not the least have a share, which rounding moves.
    middle = np.median(samples[:, replay.active], axis=0)
    assert_allclose(middle, [0.6, 0.7, 0.4], atol=0.04)
    assert samples[:, replay.active].std(axis=0).max() < 0.25
    assert eigenvalues.min() > 12


def linear(rows, truth, noise=0.001):
    """Return `Replay.derivatives` of linear windows, with noise and a last unknown column."""
    a = default_rng(0).normal(size=(rows, 6, len(truth)))
    a[..., -1] = 0.0

    def derivatives(self, u):
        r = np.einsum("bcp,np->nbc", a, u[:, self.active] - truth)
        error = noise * default_rng(int(1e6 * truth[0])).normal(size=r[0].shape)
        return r + error, np.repeat(a[None], len(u), 0)

    return derivatives


def test_intervals_of_linear_windows_hold_the_truth(monkeypatch):
    monkeypatch.setattr(least_squares, "_INFORMATION", 1.0)
    monkeypatch.setattr(least_squares, "_PROPOSALS", 5_000)
    domain = domains.parse_domain(f"wide,objects=random_box,{PINNED}")
    names, inside = points.names(domain), []
    for case in range(40):
        replay = least_squares.Replay(domain, [], rps_jax.Setting(), True)
        truth = default_rng(case).uniform(0.2, 0.8, len(replay.active))
        monkeypatch.setattr(least_squares.Replay, "derivatives", linear(16, truth, 0.3))
        minima = replay.minima(default_rng(case).random((6, len(names))))
        samples, eigenvalues = least_squares.sample(replay, *minima, 1000, case)
        low, high = np.quantile(samples[:, replay.active], [0.05, 0.95], axis=0)
        inside.append((low <= truth) & (truth <= high))
        assert eigenvalues[-1] == pytest.approx(0, abs=1e-6)
        assert (high - low)[-1] > 0.8
    assert 0.8 < np.mean(inside) < 0.98


def test_cma_es_finds_the_minimum_of_least_squares(monkeypatch):
    domain = domains.parse_domain(f"wide,objects=random_box,{PINNED}")
    replay = least_squares.Replay(domain, [], rps_jax.Setting(), True)
    active, a = replay.active, default_rng(0).normal(size=(16, 6, len(replay.active)))

    def derivatives(self, u):
        r = np.einsum("bcp,np->nbc", a, u[:, active] - 0.4)
        return r + 0.3, np.repeat(a[None], len(u), 0)[..., : len(self.active)]

    monkeypatch.setattr(least_squares.Replay, "derivatives", derivatives)
    start = default_rng(1).random((30, len(points.names(domain))))
    for minima in (replay.minima, partial(methods.evolved, replay)):
        u, r, j = minima(start)
        assert least_squares.cost(r).min() == pytest.approx(
            least_squares.cost(replay.minima(start)[1]).min(), abs=0.1
        )
        assert j.shape == (len(u), 16, 6, len(active))


@pytest.fixture
def object_log(tmp_path):
    """Return a table of a base that pushes an object 12 s ahead, with the object's pose."""
    table = log_table(600)
    table = table.assign(x=0.02 * table.time, v_x=0.02)
    return written(
        tmp_path / "log.csv", table.assign(object_x=0.6 + table.x, object_y=0.05, object_yaw=0.0)
    )


WINDOW_FAULTS = {
    "they lack object_x, object_y and object_yaw: log them, or use rps fit": lambda t: t.drop(
        columns=["object_x", "object_y", "object_yaw"]
    ),
    "they have 2 windows of 2 s that are mostly in contact, and 5 are needed: give longer": put(
        "contact_type", 0, slice(200, None)
    ),
}


OPTION_FAULTS = {
    "mujoco": ("--engine", "mujoco"),
    "windows are replayed on a level, uniform floor": ("--domain", "wide,slope=0:0.1"),
}


@pytest.mark.parametrize("message", [*WINDOW_FAULTS, *OPTION_FAULTS])
def test_logs_that_cannot_be_replayed_are_refused(message, object_log, tmp_path, compiled, capsys):
    if message in WINDOW_FAULTS:
        written(object_log, WINDOW_FAULTS[message](pd.read_csv(object_log)))
    options = *OPTION_FAULTS.get(message, ()), "--out", tmp_path / "run"
    command = ROOT / "sweeps" / "fit" / "windows.py"
    assert re.search(message, refusal(capsys, command, object_log, *options))
    assert not compiled


def test_a_fit_of_windows_returns_the_variables_of_fit(object_log, monkeypatch, compiled):
    """It adds eigenvalues, and its report names what the windows do not determine."""
    monkeypatch.setattr(least_squares.Replay, "derivatives", linear(5, np.full(9, 0.5)))
    question = windows.FitWindows(object_log, domain="wide,objects=random_cylinder", worlds=6)
    assert question.num_trials() == 6
    fitted = question()
    width = len(fit.coordinates(question.ranges))
    expected = {*fit.summary(question.ranges, default_rng(0).random((50, width)))}
    assert {*fitted.data.data_vars} == expected | {"outside", "eigenvalue"}
    assert fitted.data.sizes["draw"] == fit.SAMPLES
    assert np.isfinite(fitted.data.sample).all()
    text = question.report(fitted, None)[0].text
    assert "determine 8 of 9 combinations" in text
    assert "mass has almost no influence" in text
    assert "invalid" not in text
    assert not compiled


def test_methods_are_compared_on_the_logs_that_all_fit():
    """Logs that CMA-ES does not fit count neither as covered nor as missed."""
    shape, study = ("kind", "log", "quantity"), methods.Methods()
    names, kinds = list(methods._QUANTITIES), list(methods.KINDS)

    def fits(logs, seconds):
        size = len(kinds), len(logs), len(names)
        columns = {name: (shape, np.zeros(size)) for name in ("truth", "median", "undetermined")}
        columns |= {"rank": (shape, np.full(size, 0.5))}
        columns |= {"prior_low": (shape, np.zeros(size)), "prior_high": (shape, np.ones(size))}
        row = np.full(size[:2], seconds)
        columns |= {"seconds": (shape[:2], row), "windows": (shape[:2], row)}
        return xr.Dataset(columns, {"kind": kinds, "log": logs, "quantity": names})

    parts = [fits([0, 1, 2, 3], 1.0), fits([0, 1, 2, 3], 2.0), fits([1, 3], 3.0)]
    results = xr.concat(parts, xr.IndexVariable("estimator", list(methods.METHODS)), join="outer")
    _, *rows = methods.method_rows(results.assign(simulation=4.0), study)
    counts = [(row[1], row[2], row[3]) for row in rows if row[0] == kinds[0]]
    everything = [("neural", "4", "100.0 %"), ("gradient", "4", "100.0 %")]
    common = [(method, "2", "100.0 %") for method in methods.METHODS]
    assert counts == everything + common


def test_statistics_that_no_world_has_are_left_out():
    values = np.array([[[1.0, np.nan, 1.0]]])
    names = {"statistic": ["base/a", "base/b", "signal/c"]}
    bank = xr.Dataset({"statistics": (("world", "way", "statistic"), values)}, names)
    assert fit.statistic_names(bank, ()) == ["base/a"]
