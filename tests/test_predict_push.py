"""Slow pushes by fingers: cases that are solved by hand, similarity, and a real push."""

import doctest

import numpy as np
import pytest
from helpers import refusing
from numpy.testing import assert_allclose

from rps_jax.geometry import solid
from rps_jax.geometry.solid import rotate
from sweeps.real_pushes import fingers, pushes, study
from sweeps.real_pushes import predict_push as predict_push_
from sweeps.real_pushes.predict_push import predict_push, uniform_pressure

SQUARE = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
FEET = np.array([[-0.08, -0.06], [0.08, -0.06], [0.0, 0.08]])
AHEAD = np.array([[-0.101, 0.0], [-0.081, 0.0], [-0.061, 0.0]])  # through the middle
KNOWN = {"mass": 2.0, "friction_ground": 0.3, "friction_finger": 0.5}
FORCE = 0.3 * 2.0 * 9.81  # [N] mu m g
MODELS = pytest.mark.parametrize("model", ["feet", "ellipsoid"])


def moved(path=AHEAD, outline=SQUARE, **options):
    return predict_push(outline, path, **KNOWN | options)


@MODELS
@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_a_push_through_the_centre_of_friction_translates(model, friction):
    """The load of a flat square, and of feet with their centre of mass, is balanced."""
    for feet in (None, FEET * [1, 0.75]):
        com = None if feet is None else (0.0, feet[:, 1].mean())
        path = AHEAD if com is None else AHEAD + com
        options = {"feet": feet, "com": com, "time": [2.0, 3.0, 5.0], "friction_finger": friction}
        result = moved(path, model=model, **options)
        x, y, yaw = result.object_pose.values.T
        assert_allclose(x, [0, 0.019, 0.039], atol=1e-6)
        assert_allclose([y, yaw], 0, atol=1e-6)
        assert_allclose(result.force[-1], [FORCE, 0], atol=2e-3 * FORCE)
        assert_allclose(result.gap[1:], 0, atol=1e-6)
        assert result.object_pose.dims == ("time", "pose")
        assert list(result.time.values) == [2.0, 3.0, 5.0]
        assert result.force.attrs["units"] == "N"


@MODELS
def test_two_fingers_about_the_centre_do_not_turn_it(model):
    two = np.stack([np.add(AHEAD, (0, 0.03)), np.subtract(AHEAD, (0, 0.03))], axis=1)
    result = moved(two, model=model, friction_finger=0.05)
    assert_allclose(result.object_pose[-1], [0.039, 0, 0], atol=2e-5)
    assert result.gap.dims == ("time", "finger")


def test_mirrored_pushes_have_mirrored_motions():
    path = np.stack([np.add(AHEAD, (0, 0.05)), np.subtract(AHEAD, (0, 0.05))])[:, :, None]
    result = moved(path)
    poses, force = result.object_pose.values, np.linalg.norm(result.force[:, -1], axis=-1)
    assert poses[0, -1, 2] < -0.1
    assert (force > 0.1 * FORCE).all()
    assert (force < 0.98 * FORCE).all()  # a turning object resists less
    assert_allclose(poses[1], poses[0] * [1, -1, -1], atol=1e-5)


def test_an_off_centre_push_turns_about_the_point_of_the_limit_surface():
    """A sticking finger moves along x at y = b: with c^2 omega = -b v_x, v_x - omega b = u."""
    b, way = 0.05, 1e-3
    path = np.array([[-0.1, b], [-0.1 + way, b]])
    result = moved(path, model="ellipsoid", friction_finger=3.0)
    points = uniform_pressure(SQUARE, np.zeros(2))
    arm = solid.mean_arm(points[None, :, :2], points[None, :, 2])[0]
    assert arm == pytest.approx(0.2 * (np.sqrt(2) + np.log(1 + np.sqrt(2))) / 6, rel=0.035)
    # Sticking: both components of the finger's velocity are those of the object's point.
    r = np.array([-0.1, b])
    cross = np.array([[1, 0, -r[1]], [0, 1, r[0]]])
    inverse = np.diag([1, 1, 1 / arm**2])
    twist = inverse @ cross.T @ np.linalg.solve(cross @ inverse @ cross.T, [way, 0])
    assert_allclose(result.object_pose[-1], twist, atol=2e-5)


def test_friction_decides_between_sticking_and_sliding():
    """A finger at 45 degrees sticks above friction 1 and slides at the edge of the cone below."""
    path = np.linspace([[-0.101, 0.0]], [[-0.061, 0.04]], 81)
    sticks, slides = (moved(path, friction_finger=mu) for mu in (3.0, 0.2))
    for result, mu in ((sticks, 3.0), (slides, 0.2)):
        force = rotate(-result.object_pose.values[1:, 2], result.force.values[1:])
        assert (np.abs(force[:, 1]) <= 1.02 * mu * force[:, 0] + 1e-9).all()
    assert force[-1] @ [0.2, -1] == pytest.approx(0, abs=0.01 * FORCE)  # the last one slides

    def slip(result):
        offset = path[:, 0] - result.object_pose.values[:, :2]
        at = rotate(-result.object_pose.values[:, 2], offset)
        return abs(at[-1, 1] - at[5, 1])

    assert slip(sticks) < 2e-4
    assert slip(slides) > 5e-3


def test_motions_are_similar():
    """Neither speed, mass nor friction with the ground matter; all lengths may be multiplied."""
    path = np.array([[-0.101, 0.04], [-0.06, 0.05]])
    first = moved(path, feet=FEET)
    light = moved(path, feet=FEET, mass=0.5, friction_ground=0.9, time=[0.0, 100.0])
    assert_allclose(light.object_pose, first.object_pose, atol=1e-12)
    assert light.force.values == pytest.approx(first.force.values * 0.75)
    for k in (0.1, 10.0):
        large = moved(k * path, k * SQUARE, feet=k * FEET)
        assert_allclose(large.object_pose, first.object_pose * [k, k, 1], rtol=1e-6)
    pose = np.array([0.3, -0.2, 2.0])
    turned = moved(pose[:2] + rotate(pose[2], path), feet=FEET, pose=pose)
    expected = pose + np.column_stack(
        [rotate(2.0, first.object_pose.values[:, :2]), first.object_pose.values[:, 2]]
    )
    assert_allclose(turned.object_pose, expected, atol=1e-5)


def test_many_pushes_are_those_of_single_calls():
    path = np.array([[[-0.101, y], [-0.08, y]] for y in (0.05, -0.02)])[:, :, None]
    pose, friction = np.array([[0, 0, 0], [0, 0, 0.1]]), np.array([0.2, 0.7])
    batch = moved(path, pose=pose, friction_finger=friction)
    assert batch.object_pose.dims == ("push", "time", "pose")
    for i in range(2):
        single = moved(path[i], pose=pose[i], friction_finger=friction[i])
        assert_allclose(single.object_pose, batch.object_pose[i], atol=1e-6)


def test_a_missed_object_stays():
    result = moved(np.subtract(AHEAD, (0, 0.2)))
    assert not result.object_pose.values.any()
    assert not result.force.values.any()
    assert (result.gap > 0.05).all()


def test_height_moves_the_load_and_may_tip():
    low, high = (moved(np.add(AHEAD, (0, 0.03)), feet=FEET, height=z) for z in (0.0, 0.1))
    assert abs(float((high - low).object_pose[-1, 2])) > 0.01
    with refusing(r"height = 0\.5 m is not allowed: the object would tip"):
        moved(feet=FEET, height=0.5)


def test_a_real_push_ends_where_it_was_measured():
    """The first push of the data, with one finger on three feet."""
    row = pushes.read().iloc[:1]
    path, feet = pushes.finger_paths(row, 10)[:, 0, 0], pushes.feet_of(row.support[0])
    known = {"mass": pushes.MASS, "friction_ground": 0.28, "friction_finger": 0.5}
    pose = pushes.initial_poses(row)[0]
    options = {"pose": pose, "feet": feet, "height": pushes.PUSHED_AT}
    result = predict_push(pushes.OUTLINE, path, **options, **known)
    off = pushes.errors_of(result.object_pose.values[-1], pushes.measured(row)[0])
    still = pushes.errors_of(pose, pushes.measured(row)[0])
    assert off.both < 2e-3
    assert off.both < still.both / 4
    measured = np.hypot(row.force_wx[0], row.force_wy[0])
    assert np.linalg.norm(result.force[-1]) == pytest.approx(measured, rel=0.3)


def test_the_example_of_the_docstring_runs():
    assert doctest.testmod(predict_push_) == (0, 6)


REFUSED = {
    "model": ({"model": "rigid"}, "unknown model 'rigid': choose from feet, ellipsoid"),
    "clockwise": ({"outline": SQUARE[::-1]}, "outline = .* strictly convex and counter-clockwise"),
    "outline in mm": ({"outline": 1000 * SQUARE}, "width of the outline = 200.0 .* at most 5"),
    "text": ({"outline": "square"}, r"outline = 'square' .* of shape \(N, 2\)"),
    "one point": ({"path": AHEAD[:1]}, "time = .* at least two points of the path"),
    "flat path": ({"path": AHEAD[0]}, r"path = of shape \(2,\) .* \(T, 2\) or \(T, F, 2\) or"),
    "NaN": ({"path": AHEAD * [1, np.nan]}, r"path = .*nan.* is not allowed: it must be finite"),
    "path in mm": ({"path": 1000 * AHEAD}, "path = .* in one frame, in metres"),
    "start inside": ({"path": np.add(AHEAD, (0.05, 0))}, "path = .* -0.049 m off .* start outside"),
    "squeezing": (
        {"path": [[(-0.101, 0), (0.101, 0)], [(-0.09, 0), (0.09, 0)]]},
        "path = that ends 0.01 m inside the object .* must not squeeze",
    ),
    "unequal squeezing": (
        {"path": [[(-0.101, 0), (0.101, 0)], [(-0.09, 0), (0.101, 0)]]},
        "do not balance, as between fingers that squeeze",
    ),
    "dates": ({"time": np.array(["2020", "2021", "2022"], "M8[Y]")}, "time = .*2020.* finite"),
    "feet in a line": ({"feet": FEET * [1, 0]}, "feet = .* must be between them, or it tips"),
    "order": ({"time": [0, 2, 1]}, "time = .* is not allowed: .* at increasing times"),
    "times": ({"time": [0, 1]}, r"time = of shape \(2,\) .* of shape \(3,\)"),
    "mass": ({"mass": 0}, r"mass = 0 is not allowed: .* at least 0.001 .* \[kg\]"),
    "pose": ({"pose": (0, 0)}, r"pose = of shape \(2,\) is not allowed: .* \(3,\)"),
    "tips": ({"feet": np.add(FEET, (0, 0.08))}, "feet = .* the centre of mass must be between"),
}


@pytest.mark.parametrize(("options", "message"), REFUSED.values(), ids=REFUSED)
def test_invalid_input_is_refused_in_one_sentence(options, message):
    with refusing(message) as refusal:
        moved(**options)
    assert "\n" not in str(refusal.value)


# --- the solver -----------------------------------------------------------------------------


# Pushes in which a line search with larger steps gets stuck, with unbalanced forces up to mu m g.
UNBALANCED = (133, 886, 1006, 1259, 1275, 1347)


def test_every_step_of_many_pushes_balances(monkeypatch):
    """The forces of each step balance: an incomplete line search would stop before."""
    table = pushes.read()
    table = pushes.chosen(table, np.isin(table.id, UNBALANCED))
    friction = np.array([study.FRICTION[name] for name in pushes.kind_of_finger(table)])
    solve, worst = fingers._solve, []

    def checked(step, twist):
        solution = solve(step, twist)
        worst.append(np.abs(fingers._derivatives(step, solution)[0]).max())
        return solution

    monkeypatch.setattr(fingers, "_solve", checked)
    pushes.slide(table, friction, on="feet", steps=60)
    assert len(worst) == 60
    assert max(worst) < 1e-4  # of mu m g; the solver stops at a tenth


def test_feet_bear_the_weight_about_its_centre():
    at = np.array([[[0.1, 0.0], [-0.1, 0.1], [-0.1, -0.1], [0.0, 0.02]]])
    weight, centre = np.array([[1.0, 2.0, 1.0, 0.5]]), np.array([[0.01, 0.02]])
    load = solid.supported_load(at, weight, centre)
    assert load.sum() == pytest.approx(1)
    assert (load >= 0).all()
    assert_allclose(np.einsum("bs,bsi->bi", load, at), centre, atol=1e-12)


def test_nearest_is_the_edge_or_the_corner():
    points = np.array([[0.05, -0.01], [-0.03, -0.04], [0.1, 0.1], [0.05, 0.05]])
    gap, normal = fingers.nearest(pushes.OUTLINE, points)
    root = np.sqrt(0.5)
    assert_allclose(gap, [0.01, 0.05, 0.05 * root, -0.05 * root], atol=1e-12)
    assert_allclose(normal, [[0, -1], [-0.6, -0.8], [root, root], [root, root]], atol=1e-12)


@pytest.mark.parametrize("corners", [3, 7, 72])
def test_a_uniform_pressure_has_the_area_and_the_centre_of_its_outline(corners):
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    outline = 0.1 * np.stack([np.cos(angle), np.sin(angle)], axis=1) + [0.3, 0.1]
    points = uniform_pressure(outline, np.array([0.3, 0.1]))
    area = 0.01 * corners * np.sin(2 * np.pi / corners) / 2
    assert points[:, 2].sum() == pytest.approx(area)
    assert_allclose(points[:, 2] @ points[:, :2] / area, [0.3, 0.1])
    assert (fingers.nearest(outline, points[:, :2])[0] < 0).all()
