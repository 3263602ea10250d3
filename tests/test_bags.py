"""Bags: valid ROS 2 files, exact replay of every twist, and refusal of invalid files.

`bad_bags.py` has the kinds of bags that are read or refused.
"""

import json
import math

import bad_bags
import numpy as np
import pytest
import xarray as xr
from helpers import (
    SLOTS,
    printed,
    refusal,
    refusing,
    rps,
    setting_of,
    slow,
)
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

import rps_jax
from rps_jax.app.shadow import Shadow, shadow
from rps_jax.record import bag
from rps_jax.record.bag import Step
from rps_jax.robot.robot import Robot
from rps_jax.robot.skin import with_contacts
from rps_jax.runs.push import push

pytest.importorskip("mcap_ros2")
BRIEF = setting_of(6.0, "mujoco")
FUSED = setting_of(10.0, "fused")
TWIST = ("v_x", "v_y", "omega")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("bag") / "push.mcap"
    trace = push("cylinder", target=(-1.0, 0.5), law="rps_plus", bag=path, setting=BRIEF)
    return path, trace


LAWS = ("rps_plus", slow("learned_small"), slow("aps"), "force_push_published")


@pytest.mark.parametrize("law", LAWS)
def test_a_law_reproduces_every_twist_from_the_bag_of_a_simulation(law, tmp_path, recorded):
    """Also a law that senses force, or observes its last twist."""
    path = recorded[0] if law == "rps_plus" else tmp_path / "push.mcap"
    if law == "force_push_published":
        push("box", target=(1.5, 0.2), law=law, bag=path, setting=FUSED)
        assert np.abs(bag.read(path)["f_robot"]).max() > 1
    elif law != "rps_plus":
        pushed = "box" if law == "learned_small" else "cylinder"
        push(pushed, target=(-1.0, 0.5), law=law, bag=path, setting=BRIEF)
    results = shadow(path, law)
    assert results.sizes == {"source": 2, "time": 501 if law == "force_push_published" else 301}
    for name in TWIST:
        assert_allclose(results[name][1], results[name][0], atol=1e-6)
    assert float(np.abs(results.v_x).max()) > 0.005


def test_a_bag_does_not_change_the_trial(recorded):
    path, trace = recorded
    without_bag = push("cylinder", target=(-1.0, 0.5), law="rps_plus", setting=BRIEF)
    assert_array_equal(trace.data.time, without_bag.data.time)
    for name in ("v_x", "l", "distance"):
        assert_allclose(trace.data[name], without_bag.data[name], atol=1e-5)
    read = bag.read(path)
    assert_allclose(read["twist"][::5, 0], trace.data.v_x, atol=1e-7)


def test_another_law_gives_other_twists(recorded):
    results = shadow(recorded[0], "rps_plus,law.v_approach=0.02")
    assert float(np.abs(results.v_x[1] - results.v_x[0]).max()) == pytest.approx(0.01, abs=1e-4)


def test_a_third_party_reader_opens_the_bag(recorded):
    highlevel = pytest.importorskip("rosbags.highlevel")
    from rosbags.typesys import Stores, get_typestore

    path, trace = recorded
    with highlevel.AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bags:
        kinds = {connection.topic: connection.msgtype for connection in bags.connections}
        messages = {topic: [] for topic in kinds}
        for connection, _, raw in bags.messages():
            messages[connection.topic].append(bags.deserialize(raw, connection.msgtype))
    expected = {"/odom": "nav_msgs/msg/Odometry", "/cmd_vel": "geometry_msgs/msg/TwistStamped"}
    expected |= {"/tf": "tf2_msgs/msg/TFMessage", "/target_marker": "visualization_msgs/msg/Marker"}
    assert expected.items() <= kinds.items()
    assert {len(messages[topic]) for topic in ("/odom", "/cmd_vel", "/taxels")} == {301}
    assert len(messages["/target_marker"]) == 7
    position = messages["/odom"][250].pose.pose.position
    qpos = trace.snapshots.qpos[50, :2]
    assert_allclose((position.x, position.y), qpos, atol=1e-7)


def test_the_commands_write_and_shadow_a_bag(tmp_path, capsys):
    drums = "--domain wide,objects=random_cylinder"
    options = f"{drums} --laws rps --engine quasistatic --horizon 3 --slots {SLOTS}"
    run, path, out = tmp_path / "sweep", tmp_path / "world.mcap", tmp_path / "shadow"
    assert rps(f"sweep --worlds {SLOTS} {options} --out", run) == 0
    assert rps(f"replay {run} 1 --bag {path} --no-video --out", tmp_path / "replay") == 0
    mine = tmp_path / "mine.json"
    mine.write_text(json.dumps({"d_near": 0.3}))
    output = printed(capsys, f"shadow {path} --law rps_plus,{mine} --out", out)
    assert "151 commands in 3.0 s" in output
    assert "omega [rad/s]" in output


# --- other orders, formats, frames and names -----------------------------------------------


@pytest.fixture(scope="module")
def plain_steps(tmp_path_factory):
    return bad_bags.reference(tmp_path_factory.mktemp("bag"))


@pytest.mark.parametrize("case", bad_bags.ALL, ids=lambda case: case.kind)
def test_a_bag_gives_the_same_steps_or_one_sentence(case, tmp_path, plain_steps):
    result = bad_bags.result_of(case, tmp_path, plain_steps)
    assert "\n" not in result
    assert case.expected in result if case.expected else not result


def test_the_commands_take_the_names_of_topics(recorded, tmp_path, capsys):
    moved = [
        r._replace(topic=f"/r1{r.topic}") for r in bad_bags.records_of(recorded[0].read_bytes())
    ]
    path, out = bad_bags.mcap(moved)(tmp_path), tmp_path / "run"
    keys = ("odom", "target", "contact", "taxels", "cmd_vel")
    flags = [word for key in keys for word in ("--topic", f"{key}=/r1/{key}")]
    assert rps(f"shadow {path} --law rps_plus", *flags, "--out", out) == 0
    assert "301 commands in 6.0 s" in capsys.readouterr().out
    for command in ("shadow", "fit"):
        flags[1] = "odom=/r2/odom"
        error = refusal(capsys, command, path, *flags, "--out", tmp_path / command)
        assert "no messages on /r2/odom; its topics are /r1/cmd_vel (geometry_msgs/Twi" in error
        error = refusal(capsys, command, path, "--topic", "odo=/o", "--out", tmp_path / command)
        assert "unknown key of a topic 'odo'" in error
    assert not (tmp_path / "shadow").exists()


def test_the_steps_of_a_path_end_with_a_path_without_poses(tmp_path, capsys):
    """Users of docs/on_a_robot.md publish it at the end."""
    paths = {0: bad_bags.LINE, 20: bad_bags.LINE, 30: ()}
    rows = bad_bags.on_path(paths, "/target"), bad_bags.on_path({0: bad_bags.LINE}, "/target")
    ended, whole = (bad_bags.plain(x, name=f"{len(x)}.mcap")(tmp_path) for x in rows)
    assert rps("shadow", ended, "--law", "rps", "--out", tmp_path / "run") == 0
    assert "30 commands in 0.6 s" in capsys.readouterr().out
    both = shadow(ended, "rps"), shadow(whole, "rps")
    xr.testing.assert_allclose(both[0], both[1].isel(time=slice(30)))


@pytest.mark.parametrize("points", [bad_bags.LINE[:1], bad_bags.LINE[:1] * 3])
def test_a_path_of_equal_poses_is_refused(points, tmp_path, capsys):
    rows = bad_bags.on_path({0: points, 20: points}, "/target")
    path = bad_bags.plain(rows)(tmp_path)
    error = refusal(capsys, "shadow", path, "--law", "rps", "--out", tmp_path / "run")
    assert "a path without length: publish two different poses or more" in error


# --- invalid files -------------------------------------------------------------------------


def steps(count=3, **changes):
    step = Step(0.0, (0, 0, 0), (1, 0), 1, (0.36, 0), (0.05, 0, 0))._replace(**changes)
    return [step._replace(time=0.02 * i) for i in range(count)]


def test_a_bag_stores_pose_period_and_contact(tmp_path):
    rows = [step._replace(pose=(1, 2, 2.5 * i)) for i, step in enumerate(steps(4, contact_type=2))]
    columns = bag.read(bag.write(tmp_path / "a.mcap", rows, {}))
    assert_allclose(columns["pose"], [[1, 2, 2.5 * i] for i in range(4)], atol=1e-12)
    assert_allclose(columns["period"], 0.02, atol=1e-9)
    assert columns["contact_type"].tolist() == [2] * 4
    assert "signal" not in columns


def test_damage_anywhere_is_refused_or_read(tmp_path):
    """Any error of a reader becomes a single-sentence error."""
    whole = bag.write(tmp_path / "a.mcap", steps(30), {}).read_bytes()
    rng, path, refused = default_rng(0), tmp_path / "b.mcap", 0
    for _ in range(150):
        odd = bytearray(whole)
        for _ in range(4):
            odd[rng.integers(len(odd))] = rng.integers(256)
        path.write_bytes(odd)
        try:
            bag.read(path)
        except rps_jax.InputError:
            refused += 1
    assert refused > 20


def without_contacts(path, steps, monkeypatch, until=math.inf):
    """Write a bag with unfiltered taxels and with contacts only after some time [s]."""
    whole = bag._messages
    kept = lambda s: (m for m in whole(s) if m[0] != "/contact" or m[1] > until * 1e9)  # noqa: E731
    monkeypatch.setattr(bag, "_messages", kept)
    written = bag.write(path, steps, {})
    monkeypatch.undo()
    return written


def test_a_goal_gets_its_heading_at_the_end_of_a_path(tmp_path):
    """A law of poses alone begins there."""
    yaws = [math.nan] * 4 + [0.3] * 5
    series = steps(9, signal=np.zeros(42))
    series = [step._replace(yaw_target=yaw) for step, yaw in zip(series, yaws, strict=True)]
    path = bag.write(tmp_path / "path.mcap", series, {})
    assert_allclose(bag.read(path)["yaw_target"], yaws)
    assert_allclose(Shadow(path, "path_pose").steps["yaw_target"], yaws)
    assert_allclose(Shadow(path, "pose").steps["yaw_target"], yaws[4:])


def test_the_skin_feels_the_taxels_of_a_bag_without_contacts(tmp_path, capsys, monkeypatch):
    """The skin filters a taxel at 0.4: (1 - exp(-t / 50 ms)) 0.4 > 0.25 from the third step."""
    signal = np.zeros(42)
    signal[20] = 0.4
    path = without_contacts(tmp_path / "a.mcap", steps(9, signal=signal), monkeypatch)
    assert "contact_type" not in bag.read(path)
    columns = with_contacts(bag.read(path), Robot().shell, "bag")
    assert columns["contact_type"].tolist() == [0, 0] + [1] * 7
    p_robot_contact = [0.3625, 0.29 - 0.58 * 5.5 / 12]  # the sixth of the front's twelve
    assert_allclose(columns["p_robot_contact"][2:], [p_robot_contact] * 7, atol=1e-6)
    assert_allclose(columns["signal"][1, 20], 0.4 * (1 - np.exp(-0.8)), rtol=1e-5)
    alone = shadow(path, "rps")
    touched = steps(9, signal=signal, p_robot_contact=p_robot_contact)
    touched = [step._replace(contact_type=int(i > 1)) for i, step in enumerate(touched)]
    same = shadow(bag.write(tmp_path / "b.mcap", touched, {}), "rps")
    assert_allclose(alone.v_x[1], same.v_x[1], atol=1e-6)
    assert_allclose(alone.v_y[1], same.v_y[1], atol=1e-6)
    error = refusal(capsys, "shadow", path, "--robot", "ridgeback", "--out", tmp_path / "run")
    assert "has 42 taxels, and the robot 51: name the log's robot by --robot" in error


def test_steps_begin_with_the_first_contact(tmp_path, monkeypatch):
    rows = steps(6, signal=np.zeros(42))
    columns = bag.read(without_contacts(tmp_path / "a.mcap", rows, monkeypatch, until=0.05))
    assert_allclose(columns["time"], [0.06, 0.08, 0.1])
    assert columns["contact_type"].tolist() == [1, 1, 1]


def test_too_many_numbers_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    monkeypatch.setattr(bag, "_MAX_NUMBERS", 3000)
    bag.read(bag.write(path, steps(12), {}))  # 12 times 17 numbers in 4 messages
    with refusing("more than 3000 numbers"):
        bag.read(bag.write(path, steps(12, signal=np.zeros(500)), {}))


def test_a_missing_column_is_named(tmp_path):
    path = bag.write(tmp_path / "a.mcap", steps(), {})
    for law, column in (("learned_small", "signal"), ("aps", "p_world_object")):
        with refusing(f"has no {column}, which the law senses"):
            Shadow(path, law)()
