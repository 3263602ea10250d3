"""Fits to logs: validation of logs, their statistics, and the coverage of the posterior."""

import re
from typing import Any

import bad_tables
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from helpers import refusal, rps, same

import rps_jax
from rps_jax.errors import InputError
from rps_jax.geometry import solid
from rps_jax.record import bag
from rps_jax.robot.robot import Robot
from rps_jax.robot.skin import with_contacts
from rps_jax.tuning import fit, logs, posterior
from rps_jax.world import domain as domains
from sweeps.fit import bags

SHELL = Robot().shell


COLUMNS = "time,x,y,yaw,contact_type,contact_x,contact_y,v_x,v_y,omega,target_x,target_y"


def log_table(count=400):
    """Return the log of a base that drives ahead at 0.05 m/s with a contact at its front."""
    time = 0.02 * np.arange(count)
    values = {"contact_type": 1, "contact_x": 0.3625, "contact_y": 0.05, "v_x": 0.05}
    values |= {"target_x": 2.0, "target_y": 0.5, "time": time, "x": 0.05 * time}
    return pd.DataFrame(0.0, range(count), COLUMNS.split(",")).assign(**values)


def written(path, table):
    table.to_csv(path, index=False)
    return path


def put(column, value, where: Any = slice(None)):
    def change(table):
        table.loc[where, column] = value
        return table

    return change


WRONG = {
    "lacks the column contact_y": lambda table: table.drop(columns="contact_y"),
    "has a gap of 2 s at": lambda table: table.drop(index=range(100, 199)),
    "lasts 1.9 s: it must last 5 s": lambda table: table[:95],
    r"v_x and v_y up to 4 m/s, beyond the limit of 3: write SI units": put(
        "v_x", 4.0, slice(9, 12)
    ),
    "yaw may be in deg": lambda table: table.assign(yaw=10 * table.time),
    "has no contact": put("contact_type", 0),
    r"up to \(0.480, 0.050\) m, and the robot ends at": put("contact_x", 0.48),
    r"target is 20.\d+ m from its start": put("target_x", 20.0),
    r"has 1 taxels, and the robot 42": lambda t: t.drop(
        columns=["contact_type", "contact_x", "contact_y"]
    ).assign(taxel_0=1.0),
    "lacks the columns object_x, object_yaw": lambda t: t.assign(object_y=1.0),
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


def drive(delay=0, slip: Any = 0.0, blocked=0.0, noise=0.0, start=0.0, speed=0.1, period=0.02):
    """Return the log of a base that slips, lags or is blocked for a share of its commands.

    The slip is one number, or those of v_x, v_y and omega.
    """
    rng, time = np.random.default_rng(0), np.arange(0.0, 12.0, period)
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
    np.testing.assert_allclose(log.columns["pose"], table[["x", "y", "yaw"]], atol=1e-9)


def test_other_units_are_converted_and_reported(tmp_path):
    path = written(tmp_path / "log.csv", log_table().rename(columns={"yaw": "yaw [deg]"}))
    question = fit.Fit(path, columns={"x": "x [m]"})
    assert "Converted: yaw from deg to rad." in question.intro(None)
    with pytest.raises(InputError, match="columns = x=a is not allowed: no log is a table"):
        rps_jax.fit(tmp_path / "log.mcap", columns="x=a")


def test_parquet_needs_pyarrow(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    (tmp_path / "log.PARQUET").write_bytes(b"PAR1")
    with pytest.raises(InputError, match="run pip install pyarrow, or name a"):
        logs.read(tmp_path / "log.PARQUET", SHELL)


def test_parquet_is_read_as_csv_is(tmp_path):
    pytest.importorskip("pyarrow", reason="pip install pyarrow to read Parquet")
    table, path = bad_tables.push(), tmp_path / "log.parquet"
    expected = logs.read(bad_tables.reference(tmp_path), SHELL).columns
    stamps = pd.Timestamp("2026-03-01T10:15:00Z") + pd.to_timedelta(table.time, "s")
    for variant in (table, table.set_index("time"), table.assign(time=stamps)):
        variant.to_parquet(path)
        same(logs.read(path, SHELL).columns, expected, atol=1e-6)
    for column, value, cell in (
        *(("yaw", None, "an empty cell"), ("yaw", "1,2.5", "'1,2.5'"), ("yaw", "left", "'left'")),
        *(("contact_type", True, "'True'"), ("x", np.nan, "an empty cell")),
    ):
        table.assign(**{column: value}).to_parquet(path)
        with pytest.raises(InputError, match=f"{cell}.*row 1|row 1, column {column}, but {cell}"):
            logs.read(path, SHELL)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(InputError, match="is no Parquet table"):
        logs.read(path, SHELL)


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
            row[0], row[1:4], row[10:12], int(row[4]), row[5:7], row[7:10],
            **{name: values[i] for name, values in changes.items()},
        )
        for i, row in enumerate(table.to_numpy(float))
    ]  # fmt: skip
    return bag.write(path, steps, {})


def test_a_bag_is_the_log_that_a_table_is(tmp_path):
    # A heading that a quaternion breaks.
    rows = log_table().assign(yaw=np.linspace(3.0, 3.5, 400), x=lambda t: -t.x)
    table = logs.read(written(tmp_path / "log.csv", rows), SHELL)
    result = logs.read(bagged(tmp_path / "log.mcap", rows), SHELL)
    assert result.exact is table.exact is False
    assert set(result.columns) == set(table.columns)
    for name, values in table.columns.items():
        np.testing.assert_allclose(result.columns[name], values, atol=1e-6)
    signal = np.zeros((len(rows), SHELL.count))
    result = logs.read(bagged(tmp_path / "felt.mcap", rows, signal=signal), SHELL)
    np.testing.assert_array_equal(result.columns["signal"], signal)


def test_bags_that_are_no_log_are_refused_before_anything_compiles(tmp_path, compiled, capsys):
    rows, path = log_table(), tmp_path / "log.mcap"
    moving = put("target_x", 1.0, slice(200, None))
    for message, make in {
        "a target that moves": lambda: bagged(path, moving(rows.copy())),
        "has 41 taxels, and the robot 42": lambda: bagged(path, rows, signal=np.zeros((400, 41))),
        "lasts 1.9 s: it must last 5 s": lambda: bagged(path, rows[:95]),
        "no messages on /odom": lambda: bag.write(path, [], {}),
        "is no bag of ROS 2): give FILE.mcap": lambda: path.write_bytes(b"no bag"),
        "cut off or damaged, save the rest": lambda: path.write_bytes(
            bagged(path, rows).read_bytes()[:20_000]
        ),
    }.items():
        make()
        assert message in refusal(capsys, "fit", path, "--out", tmp_path / "run")
    assert not compiled
    assert not (tmp_path / "run").exists()


def test_traces_and_odometry_are_exclusive_and_one_is_required(tmp_path):
    with pytest.raises(InputError, match="give at least one"):
        rps_jax.fit(())
    brief = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=7.0))
    trace = rps_jax.push("cylinder", target=(1.0, 0.5), setting=brief)
    log = written(tmp_path / "log.csv", log_table())
    with pytest.raises(InputError, match="not allowed together"):
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
    np.testing.assert_allclose(result["p_robot_contact"][0], [0.3625, 0.0], atol=1e-6)
    np.testing.assert_allclose(result["p_robot_contact"][1], [0.3625, 3.5 * pitch], atol=1e-6)


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
    assert share == pytest.approx(0.9, abs=0.01)
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
    rng = np.random.default_rng(0)
    u = rng.random((3000, 2))
    x = np.stack([u[:, :1] + 0.1 * rng.standard_normal((3000, 1)) for _ in range(2)], 1)
    return posterior.train(u, x)


def test_a_posterior_is_as_wide_as_the_noise_and_else_the_prior(toy):
    result = posterior.sample(toy, np.array([[0.5]]), 4000)
    assert result[:, 0].mean() == pytest.approx(0.5, abs=0.03)
    assert result[:, 0].std() == pytest.approx(0.1, rel=0.25)
    assert result[:, 1].std() == pytest.approx(np.sqrt(1 / 12), rel=0.05)


def test_four_observations_halve_the_width(toy):
    result = posterior.sample(toy, np.full((4, 1), 0.5), 4000)
    assert result[:, 0].std() == pytest.approx(0.05, rel=0.3)


def test_a_fitted_domain_keeps_undetermined_ranges_and_all_commands_read_it(tmp_path):
    wide = domains.parse_domain("wide")
    u = np.random.default_rng(1).random((4000, len(fit.coordinates(wide))))
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


def test_a_log_is_fitted_from_the_shell(tmp_path, capsys, optimised):
    """A sweep accepts the fitted domain, and a bag is read as its table."""
    options = "--physics default,timestep=0.01 --domain wide,objects=random_box --worlds 96"
    ask = f"fit {bagged(tmp_path / 'log.mcap', log_table())} {options} --window 5 --out {tmp_path}"
    assert rps(ask) == 0
    text = capsys.readouterr().out
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
