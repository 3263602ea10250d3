"""Fits to logs: validation of logs, their statistics, and the coverage of the posterior."""

import re
from typing import Any

import numpy as np
import pytest
import xarray as xr
from helpers import refusal, rps

import rps_jax
from rps_jax.errors import InputError
from rps_jax.record import bag, files
from rps_jax.robot.robot import Robot
from rps_jax.tuning import fit, logs, posterior
from rps_jax.world import domain as domains
from sweeps.fit import bags

SHELL = Robot().shell
HEAD = "time,x,y,yaw,contact_type,contact_x,contact_y,v_x,v_y,omega,target_x,target_y"


def rows_of(count=400, interval=0.02):
    """Return rows of a base that drives ahead at 0.05 m/s with a contact at its front."""
    time = interval * np.arange(count)
    rows = np.zeros((count, 12))
    rows[:, 0], rows[:, 1], rows[:, 7] = time, 0.05 * time, 0.05
    rows[:, 4:7] = 1, 0.3625, 0.05
    rows[:, 10:] = 2.0, 0.5
    return rows


def written(path, rows, head=HEAD):
    path.write_text("\n".join([head, *(",".join(f"{x:.9g}" for x in row) for row in rows)]) + "\n")
    return path


def without(name):
    def change(rows, head):
        at = head.split(",").index(name)
        return np.delete(rows, at, 1), ",".join(h for h in head.split(",") if h != name)

    return change


def set_column(column, value, where: Any = slice(None)):
    def change(rows, head):
        rows[where, head.split(",").index(column)] = value
        return rows, head

    return change


def scaled(column, factor):
    def change(rows, head):
        rows[:, head.split(",").index(column)] *= factor
        return rows, head

    return change


WRONG = {
    "lacks the column omega": without("omega"),
    "lacks the column contact_y": without("contact_y"),
    "is empty: give a header": lambda rows, head: (rows[:0], head),
    "has no number for pose in row 7": set_column("yaw", np.nan, 7),
    "has a gap of 2 s at": lambda r, h: (np.delete(r, np.s_[100:199], 0), h),
    "its time must rise": set_column("time", 0.0, 9),
    r"has a row every 20 s: give the time in seconds": scaled("time", 1e3),
    "lasts 1.9 s: it must last 5 s": lambda rows, head: (rows[:95], head),
    r"twist up to 50: write v_x and v_y \[m/s\]": scaled("v_x", 1e3),
    "a pose that jumps": scaled("x", 1e3),
    "a pose that jumps by 6.28": set_column("yaw", 2 * np.pi, slice(200, None)),
    "has no contact": set_column("contact_type", 0),
    r"up to \(0.480, 0.050\) m, and the robot ends at": set_column("contact_x", 0.48),
    r"target is 20.\d+ m from its start": set_column("target_x", 20.0),
    r"has 1 taxels, and the robot 42": lambda r, h: (r, h.replace("contact_type", "taxel_0")),
}


@pytest.mark.parametrize("message", WRONG)
def test_logs_of_other_robots_are_refused_before_anything_compiles(
    message, tmp_path, compiled, capsys
):
    path = written(tmp_path / "log.csv", *WRONG[message](rows_of(), HEAD))
    assert re.search(message, refusal(capsys, "fit", path, "--out", tmp_path / "run"))
    assert not compiled
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nowhere.csv",), "give a trace, a run folder of rps push, FILE.csv or FILE.mcap"),
        (("log.csv", "--law", "aps"), "fit needs a law that senses touch"),
        (("log.csv", "--engine", "quasistatic"), "choose fused"),
        (("log.csv", "--robot", "mpo_500"), "it is of another robot"),
    ],
)
def test_what_cannot_be_fitted_is_refused(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "log.csv", rows_of())
    assert message in refusal(capsys, "fit", *arguments)


def bagged(path, rows, **changes):
    """Write the rows of a table as a bag."""
    steps = [
        bag.Step(
            row[0], row[1:4], row[10:12], int(row[4]), row[5:7], row[7:10],
            **{name: values[i] for name, values in changes.items()},
        )
        for i, row in enumerate(rows)
    ]  # fmt: skip
    return bag.write(path, steps, {})


def test_a_bag_is_the_log_that_a_table_is(tmp_path):
    rows = rows_of()
    rows[:, 3] = np.linspace(3.0, 3.5, len(rows))  # a heading that a quaternion breaks
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
    rows, path = rows_of(), tmp_path / "log.mcap"
    moving = rows.copy()
    moving[200:, 10] = 1.0
    for message, make in {
        "a target that moves": lambda: bagged(path, moving),
        "has 41 taxels, and the robot 42": lambda: bagged(path, rows, signal=np.zeros((400, 41))),
        "lasts 1.9 s: it must last 5 s": lambda: bagged(path, rows[:95]),
        "no messages on /odom": lambda: bag.write(path, [], {}),
        "give an MCAP file": lambda: path.write_bytes(b"no bag"),
        "cannot be read": lambda: path.write_bytes(bagged(path, rows).read_bytes()[:20_000]),
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
    log = written(tmp_path / "log.csv", rows_of())
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
    result = logs._contacts(signal, SHELL)
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
    assert (
        original["base/target_2"] == -mirrored["base/target_2"] == pytest.approx(5**-0.5, rel=1e-3)
    )
    assert original["base/target_0"] == mirrored["base/target_0"] == pytest.approx(5**0.5, rel=1e-3)
    for mine, again in zip(log, logs.mirror(logs.mirror(log)), strict=True):
        np.testing.assert_array_equal(mine, again)


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
    """A sweep accepts the fitted domain."""
    log = written(tmp_path / "log.csv", rows_of())
    ask = ["fit", log, "--domain", "wide,objects=random_box", "--worlds", 96, "--window", 5]
    assert rps(*ask, "--physics", "default,timestep=0.01", "--out", tmp_path / "run") == 0
    text = capsys.readouterr().out
    assert "undetermined" in text
    assert "this fit is invalid" in text  # no world gives such a log: its object never slides
    result = domains.parse_domain(str(tmp_path / "run" / "fitted.json"))
    assert result.objects == ("random_box",)
    assert (tmp_path / "run" / "marginals.png").stat().st_size > 10_000
    assert rps(*ask, "--physics", "default,timestep=0.01", "--out", tmp_path / "run") == 0
    ask[1] = bagged(tmp_path / "log.mcap", rows_of())
    assert rps(*ask, "--physics", "default,timestep=0.01", "--out", tmp_path / "bag") == 0
    both = [files.read_results(tmp_path / name) for name in ("run", "bag")]
    np.testing.assert_allclose(both[1]["median"], both[0]["median"], rtol=0.05, atol=1e-3)


def test_the_table_of_bags_counts_intervals_with_the_truth_and_moved_bounds():
    rank = [[[0.5, 0.01], [0.5, 0.5]], [[0.5, 0.5], [0.5, 0.5]]]  # (source, log, quantity)
    low = np.zeros((2, 2, 2))
    low[0, 1, 1] = -0.03
    result = xr.Dataset(
        {
            "rank": (("source", "log", "quantity"), rank),
            "undetermined": (("source", "log", "quantity"), np.zeros((2, 2, 2))),
            "low": (("source", "log", "quantity"), low),
            "high": (("source", "log", "quantity"), np.ones((2, 2, 2))),
        },
        {"source": ["bag", "the log itself"]},
    )
    result["undetermined"][:, 1] = 1
    _, ours, theirs = bags.table(result)
    assert ours[1:] == ["2", "3 of 4, 75.0 %", "1 of 2, 50.0 %", "3 of 4, 75.0 %", "3 of 4, 75.0 %"]
    assert theirs[1:] == ["2", "4 of 4, 100.0 %", "2 of 2, 100.0 %", "", ""]
