"""The shell: bases of any size with boards at any position, in skin, law and engines."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import PAPER, refusal
from staging import push_object, recompiled
from test_robot import reference_velocities

import rps_jax
from rps_jax import engines
from rps_jax.errors import InputError
from rps_jax.geometry import footprint as fp
from rps_jax.robot import robot
from rps_jax.robot.robot import ROBOTS, Robot
from rps_jax.robot.shell import BOARDS, Boards, Shell
from rps_jax.robot.skin import LINE, NONE, CapacitiveSkin, IdealSkin
from rps_jax.trials import pushes
from rps_jax.trials.pushes import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.world import draws, scene
from rps_jax.world.domain import DOMAINS
from rps_jax.world.physics import preset
from rps_jax.world.scene import FRICTION, JOINTS

FRONT_ONLY = (Boards("front", 2, 0.05),)  # six taxels of 5 cm, in the middle of the front
SETTLED = 1e3  # [s] after which the skin's low-pass filter has forgotten its past


def read(sensor, footprint):
    """Return the reading of a sensor of an object that has been there for a long time."""
    return sensor.sense(sensor.init(jax.random.key(0)), footprint, SETTLED)[1]


def box(x, y, half=0.1):
    """Return a square object with its middle at x, y [m] in the robot's frame."""
    return fp.place(fp.rectangle(half, half), jnp.array([x, y]), jnp.zeros(()))


def test_taxels_lie_on_their_boards():
    shell = Robot(0.5, 0.2, (Boards("front", 1, 0.1, middle=0.05),)).shell
    assert shell.count == 3
    # The strip runs to the right across the front: 5 cm along it is at y = -0.05.
    np.testing.assert_allclose(
        shell.taxels()[:, 0], [[0.5, 0.05], [0.5, -0.05], [0.5, -0.15]], atol=1e-7
    )
    left_board, right_board = Robot(
        0.5, 0.2, (Boards("left", 1, 0.1), Boards("right", 1, 0.1))
    ).shell.rows()
    np.testing.assert_allclose(left_board.start, [-0.15, 0.2], atol=1e-7)
    np.testing.assert_allclose(right_board.start, [0.15, -0.2], atol=1e-7)


@pytest.mark.parametrize("boards", [BOARDS, FRONT_ONLY, ROBOTS["ridgeback"].boards])
def test_rows_lie_on_the_strip(boards):
    shell = Robot(0.48, 0.3965, boards).shell
    for row in shell.rows():
        for s in (0.0, 0.3, 1.0):
            point = shell.on_strip(jnp.asarray(row.offset + s * row.length))
            np.testing.assert_allclose(point, row.start + s * row.length * row.along, atol=1e-6)


def test_taxels_are_sampled_a_centimetre_apart():
    assert Robot().shell.samples == 5  # of 4.8 cm
    assert Robot(boards=(Boards("front", 2),)).shell.samples == 10  # of 9.7 cm
    assert Robot(boards=(Boards("front", 4, 0.012),)).shell.samples == 2


def test_boards_at_the_papers_pitch_give_the_papers_readings():
    pitch = 0.58 / 12
    sides = Boards("left", 5, pitch), Boards("front", 4, pitch), Boards("right", 5, pitch)
    for sensor in (IdealSkin(), CapacitiveSkin(), IdealSkin(temperature=0.001)):
        for y in (0.0, 0.13, -0.33, 0.391):
            expected = read(sensor, box(0.46, y))
            reading = read(sensor._replace(shell=Robot(boards=sides).shell), box(0.46, y))
            for a, b in zip(expected, reading, strict=True):
                np.testing.assert_allclose(a, b, atol=1e-5)


@pytest.mark.parametrize("sensor", [IdealSkin(), CapacitiveSkin()])
def test_nothing_is_felt_without_a_board(sensor):
    worn = sensor._replace(shell=Robot(boards=FRONT_ONLY).shell)  # which covers |y| < 0.15
    assert int(read(sensor, box(0.46, 0.26)).contact_type) == LINE
    assert int(read(worn, box(0.46, 0.26)).contact_type) == NONE
    half = read(worn, box(0.46, 0.15))  # of an object from 0.05 to 0.25
    assert int(half.contact_type) == LINE
    np.testing.assert_allclose(half.p_robot_contact, [0.3625, 0.10], atol=0.006)
    smooth = read(
        worn._replace(temperature=0.0005 if isinstance(worn, IdealSkin) else 0.01), box(0.46, 0.15)
    )
    np.testing.assert_allclose(smooth.p_robot_contact, half.p_robot_contact, atol=0.006)


def test_a_corner_must_press_harder_on_coarser_taxels():
    """A corner a tenth as long as the taxel changes the mean capacitance very little."""
    corner = fp.place(
        fp.rectangle(0.1, 0.1), jnp.array([0.3625 + 0.1 * np.sqrt(2), 0.0]), jnp.asarray(np.pi / 4)
    )
    felt = []
    for count in (8, 4, 1):
        worn = CapacitiveSkin(shell=Robot(boards=(Boards("front", count),)).shell)
        state, reading = worn.sense(worn.init(jax.random.key(0)), corner, SETTLED)
        felt.append(float(state.signal.max()))
    assert felt == sorted(felt, reverse=True)
    assert int(reading.contact_type) == NONE


def test_paper_case_starts_before_the_front_of_its_own_base():
    case = Case("box", FRICTION["S1"], (2.0, 0.0), PAPER, robot=Robot(half_length=0.5))
    worlds = pushes.build([case], Setting(engine="fused")).worlds
    assert worlds.qpos[0][JOINTS.object][0] == pytest.approx(0.5 + 0.02 + 0.2, abs=1e-6)
    assert worlds.robot is None  # it has no limits
    assert worlds.skin.shell.half_length == pytest.approx(0.5)


def test_engines_agree_on_a_base_of_another_size():
    """A box off the axis is turned by the corner of a narrow base, else by the middle."""
    slim, twist = Robot(half_length=0.5, half_width=0.12), (0.05, 0.0, 0.1)
    names = ("fused", "mujoco", "mjx", "quasistatic")
    qpos = {name: push_object(name, slim, twist=twist).qpos[-1] for name in names}
    for name, final in qpos.items():
        bound = 0.02 if name == "quasistatic" else 2e-3
        np.testing.assert_allclose(final, qpos["mujoco"], atol=bound, err_msg=name)
    wide = push_object("fused", replace(slim, half_width=0.29), twist=twist).qpos[-1]
    assert np.abs(wide - qpos["fused"])[:9].max() > 0.005


@pytest.mark.parametrize("engine", ["fused", "mjx", "quasistatic"])
def test_worlds_by_template_equal_recompiled_ones(engine):
    drawn = draws.draw(replace(DOMAINS["wide"], objects=("random_box",)), 3, np.arange(3))
    args = ("box", drawn.solid, drawn.friction, preset())
    sizes = replace(
        drawn.robot,
        half_length=np.array([0.3, 0.4, 0.5]),
        half_width=np.array([0.2, 0.25, 0.4]),
    )
    _, fields = engines.get(engine).stage(*args, sizes)
    theirs = recompiled(engine, [scene.compile_row(*args, i, sizes) for i in range(3)])
    for ours, compiled in zip(*map(jax.tree.leaves, (fields, theirs)), strict=True):
        np.testing.assert_allclose(ours, compiled, rtol=2e-5, atol=2e-6)


def test_a_sweep_uses_the_base_of_its_robot():
    """A base is as wide as its boards: a narrow base loses objects that the default one keeps."""
    domain = replace(DOMAINS["wide"], objects=("random_cylinder",))
    setting = Setting(rules=Rules(horizon=20.0))
    wide, narrow, same = (
        rps_jax.sweep("rps", domain, worlds=8, robot=base, setting=setting)
        for base in (None, Robot(half_length=0.5, half_width=0.2), Robot())
    )
    assert (narrow.base_pose.values != wide.base_pose.values).any()
    assert np.isfinite(narrow.path_length).all()
    np.testing.assert_array_equal(same.base_pose, wide.base_pose)


def test_presets_have_as_many_boards_as_fit():
    for name, (side, front) in {"ridgeback": (6, 5), "mpo_500": (6, 4)}.items():
        assert [row.count for row in ROBOTS[name].boards] == [side, front, side]
        ROBOTS[name].check()


@pytest.mark.parametrize("source", ["array", "file"])
def test_boards_go_through_json(source, tmp_path):
    rows = [{"side": "front", "count": 2, "pitch": 0.05}, {"side": "right", "count": 1}]
    values = {"half_width": 0.3, "boards": rows}
    parsed = robot.parse_robot(values)
    assert parsed.boards == (Boards("front", 2, 0.05), Boards("right", 1))
    if source == "file":
        (tmp_path / "mine.json").write_text(json.dumps(values))
        assert robot.parse_robot(str(tmp_path / "mine.json")) == parsed


FRONT = Boards("front", 2, 0.05)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"half_length": -0.3}, "robot half_length = -0.3 is not allowed"),
        ({"half_width": 5.0}, "robot half_width = 5.0 is not allowed: .* at most 2"),
        ({"boards": ()}, "robot boards = .* name at least one"),
        ({"boards": (Boards("back", 2),)}, "unknown robot boards' side 'back'"),
        ({"boards": (Boards("front", 0),)}, "robot boards' count = 0 is not allowed"),
        (
            {"boards": (Boards("front", 5, 0.05),)},
            "front side are not allowed: they leave the base",
        ),
        (
            {"boards": (replace(FRONT, middle=0.2),)},
            "from 0.34 to 0.64 m of the front .* ends at 0.58",
        ),
        ({"boards": (FRONT, replace(FRONT, middle=0.1))}, "overlap the previous row"),
        ({"boards": (Boards("front", 2), FRONT)}, "overlap the previous row"),
        ({"boards": (Boards("right", 2), FRONT)}, "in the order left, front, right"),
        ({"boards": (Boards("front", 2, middle=0.1),)}, "without a pitch"),
        ({"v_max": (1.0, 0.0)}, "robot v_max = 0.0 is not allowed"),
        ({"v_max": (1.0, 0.5, 0.2)}, "give one number, or two"),
        ({"bandwidth": 0.0}, "robot bandwidth = 0.0 is not allowed"),
    ],
)
def test_bases_that_cannot_be_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        Robot(**changes).check()


def test_commands_refuse_them_in_one_sentence(capsys, tmp_path):
    mine = tmp_path / "mine.json"
    for text, message in (
        ('{"boards": [{"side": "front", "count": 9, "pitch": 0.05}]}', "they leave the base"),
        ('{"boards": [{"count": 9}]}', "write each row as"),
        ('{"boards": [{"side": "front", "count": 1, "width": 1}]}', "quantity 'width'"),
        ('{"v_max": [1.0, 0.0]}', "robot v_max = 0.0 is not allowed"),
    ):
        mine.write_text(text)
        assert message in refusal(capsys, "sweep", "--robot", str(mine))
    mine.write_text('{"half_length": 1.5}')
    assert "which reaches 1.53 m" in refusal(capsys, "sweep", "--robot", str(mine))
    assert "outside the robot" in refusal(
        capsys, "push", "--target", "1", "0", "--robot", str(mine)
    )


def test_a_force_limit_pushes_as_far_from_a_larger_base():
    larger = Robot(half_length=0.48, half_width=0.3965, mass=100.0, force_max=400.0)
    assert larger.inertia == pytest.approx(100 * (0.48**2 + 0.3965**2) / 3)
    assert push_object("fused", larger).qvel[-1, 0] == pytest.approx(0.05, rel=1e-2)


def test_speeds_ahead_and_sideways_are_bounded_with_the_direction_kept():
    ahead = reference_velocities(Robot(v_max=(0.5, 0.1)), (0.4, 0.2, 0.0), 1)[0]
    np.testing.assert_allclose(ahead, (0.2, 0.1, 0.0), rtol=1e-6)


def test_the_half_width_of_a_shell():
    assert Shell().half == (0.3625, 0.29)
    assert Robot(half_width=0.29).shell.half_width is None  # known to the compiler
    assert Robot(half_width=0.3).shell.half == (0.3625, 0.3)
