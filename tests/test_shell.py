"""The shell: bases of any size with boards at any position, in skin, law and engines."""

import json
from dataclasses import replace
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import SHORT, box, case, refusal, sense
from numpy.testing import assert_allclose, assert_array_equal
from staging import push_object

import rps_jax
from rps_jax.robot import robot
from rps_jax.robot.robot import ROBOTS, Robot
from rps_jax.robot.shell import BOARDS, Boards
from rps_jax.robot.skin import LINE, NONE, CapacitiveSkin, IdealSkin
from rps_jax.trials import pushes
from rps_jax.trials.setting import Setting
from rps_jax.world.domain import DOMAINS
from rps_jax.world.scene import JOINTS

FRONT_ONLY = (Boards("front", 2, 0.05),)  # six taxels of 5 cm, in the middle of the front


def read(sensor, footprint):
    """Return the reading of a sensor of an object that has been there for a long time."""
    return sense(sensor, footprint)[1]


square = partial(box, half=0.1)


def test_taxels_lie_on_their_boards():
    shell = Robot(0.5, 0.2, (Boards("front", 1, 0.1, middle=0.05),)).shell
    assert shell.count == 3
    # The strip runs to the right across the front: 5 cm along it is at y = -0.05.
    middles = [[0.5, 0.05], [0.5, -0.05], [0.5, -0.15]]
    assert_allclose(shell.taxels()[:, 0], middles, atol=1e-7)
    for side, start in (("left", [-0.15, 0.2]), ("right", [0.15, -0.2])):
        (board,) = Robot(0.5, 0.2, (Boards(side, 1, 0.1),)).shell.rows()
        assert_allclose(board.start, start, atol=1e-7)


@pytest.mark.parametrize("boards", [BOARDS, FRONT_ONLY, ROBOTS["ridgeback"].boards])
def test_rows_lie_on_the_strip(boards):
    shell = Robot(0.48, 0.3965, boards).shell
    for row in shell.rows():
        for s in (0.0, 0.3, 1.0):
            point = shell.on_strip(jnp.asarray(row.offset + s * row.length))
            assert_allclose(point, row.start + s * row.length * row.along, atol=1e-6)


def test_taxels_are_sampled_a_centimetre_apart():
    assert Robot().shell.samples == 5  # of 4.8 cm
    assert Robot(boards=(Boards("front", 2),)).shell.samples == 10  # of 9.7 cm
    assert Robot(boards=(Boards("front", 4, 0.012),)).shell.samples == 2


def test_boards_at_the_papers_pitch_give_the_papers_readings():
    pitch = 0.58 / 12
    sides = Boards("left", 5, pitch), Boards("front", 4, pitch), Boards("right", 5, pitch)
    for sensor in (IdealSkin(), CapacitiveSkin(), CapacitiveSkin(temperature=0.03)):
        for y in (0.0, 0.13, -0.33, 0.391):
            expected = read(sensor, square(0.46, y))
            reading = read(sensor._replace(shell=Robot(boards=sides).shell), square(0.46, y))
            for a, b in zip(expected, reading, strict=True):
                assert_allclose(a, b, atol=1e-5)


@pytest.mark.parametrize("sensor", [IdealSkin(), CapacitiveSkin()])
def test_nothing_is_felt_without_a_board(sensor):
    worn = sensor._replace(shell=Robot(boards=FRONT_ONLY).shell)  # which covers |y| < 0.15
    assert int(read(sensor, square(0.46, 0.26)).contact_type) == LINE
    assert int(read(worn, square(0.46, 0.26)).contact_type) == NONE
    half = read(worn, square(0.46, 0.15))  # of an object from 0.05 to 0.25
    assert int(half.contact_type) == LINE
    assert_allclose(half.p_robot_contact, [0.3625, 0.10], atol=0.01)
    if isinstance(worn, IdealSkin):
        return
    contact = read(worn._replace(temperature=0.01), square(0.46, 0.15)).p_robot_contact
    assert_allclose(contact, half.p_robot_contact, atol=0.01)


def test_a_corner_must_press_harder_on_coarser_taxels():
    """A corner a tenth as long as the taxel changes the mean capacitance very little."""
    corner = square(0.3625 + 0.1 * np.sqrt(2), 0.0, yaw=np.pi / 4)
    felt = []
    for count in (8, 1):
        worn = CapacitiveSkin(shell=Robot(boards=(Boards("front", count),)).shell)
        state, reading = sense(worn, corner)
        felt.append(float(state.signal.max()))
    assert felt == sorted(felt, reverse=True)
    assert int(reading.contact_type) == NONE


def test_paper_case_starts_before_the_front_of_its_own_base():
    far = case((2.0, 0.0), robot=Robot(half_length=0.5))
    worlds = pushes.build([far], Setting(engine="fused")).worlds
    assert worlds.qpos[0][JOINTS.object][0] == pytest.approx(0.5 + 0.02 + 0.2, abs=1e-6)
    assert worlds.robot is None  # it has no limits
    assert worlds.skin.shell.half_length == pytest.approx(0.5)


def test_engines_agree_on_a_base_of_another_size():
    """A box off the axis is turned by the corner of a narrow base, else by the middle."""
    slim, twist = Robot(half_length=0.5, half_width=0.12), (0.05, 0.0, 0.1)
    names = ("fused", "mujoco", "quasistatic")  # MJX drives such a base in test_robot
    qpos = {name: push_object(name, slim, twist=twist).qpos[-1] for name in names}
    for name, final in qpos.items():
        bound = 0.02 if name == "quasistatic" else 3e-3
        assert_allclose(final, qpos["mujoco"], atol=bound, err_msg=name)
    wide = push_object("fused", replace(slim, half_width=0.29), twist=twist).qpos[-1]
    assert np.abs(wide - qpos["fused"])[:9].max() > 0.005


def test_a_sweep_uses_the_base_of_its_robot():
    """A base is as wide as its boards: a narrow base loses objects that the default one keeps."""
    domain = replace(DOMAINS["wide"], objects=("random_cylinder",))
    wide, narrow, same = (
        rps_jax.sweep("rps", domain, worlds=8, robot=base, setting=SHORT)
        for base in (None, Robot(half_length=0.5, half_width=0.2), Robot())
    )
    assert (narrow.base_pose.values != wide.base_pose.values).any()
    assert np.isfinite(narrow.path_length).all()
    assert_array_equal(same.base_pose, wide.base_pose)


def test_presets_have_as_many_boards_as_fit():
    for name, (side, front) in {"ridgeback": (6, 5), "mpo_500": (6, 4)}.items():
        assert [row.count for row in ROBOTS[name].boards] == [side, front, side]
        ROBOTS[name].check()


_FRONT = '{"side": "front", "count": 2}'


def test_boards_go_through_json(tmp_path):
    rows = [{"side": "front", "count": 2, "pitch": 0.05}, {"side": "right", "count": 1}]
    values = {"half_width": 0.3, "boards": rows}
    parsed = robot.parse_robot(values)
    assert parsed.boards == (Boards("front", 2, 0.05), Boards("right", 1))
    (tmp_path / "mine.json").write_text(json.dumps(values))
    assert robot.parse_robot(str(tmp_path / "mine.json")) == parsed


def test_commands_refuse_them_in_one_sentence(capsys, tmp_path):
    mine = tmp_path / "mine.json"
    for text, words, message in (
        ('{"boards": [{"count": 9}]}', "sweep", "write each row as"),
        ('{"boards": [{"side": "front", "count": 1, "width": 1}]}', "sweep", "quantity 'width'"),
        ('{"half_length": 1.5}', "sweep", "which reaches 1.53 m"),
        (f'{{"boards": [{_FRONT}, {_FRONT}]}}', "sweep", "overlap the previous row"),
        (
            f"""{{"boards": [{_FRONT}, {_FRONT.replace("front", "left")}]}}""",
            "sweep",
            "left, front",
        ),
        ('{"half_length": 1.5}', "push --target 1 0", "outside the robot"),
    ):
        mine.write_text(text)
        assert message in refusal(capsys, *words.split(), "--robot", mine)


def test_the_half_width_of_a_shell():
    assert Robot(half_width=0.29).shell.half_width is None  # known to the compiler
    assert Robot(half_width=0.3).shell.half == (0.3625, 0.3)
