"""Objects on custom feet in the engines."""

import re

import numpy as np
import pytest
from helpers import refusing, same, slow
from numpy.testing import assert_allclose, assert_array_equal
from staging import FINE, simulate, staged, step_in_c

from rps_jax import engines
from rps_jax.geometry import footprint, solid
from rps_jax.geometry.footprint import Footprint
from rps_jax.geometry.solid import SIDES
from rps_jax.trials.worlds import starts
from rps_jax.world import domain as domains
from rps_jax.world import draws, objects, points, scene
from rps_jax.world.scene import Friction, WorldInputs
from sweeps.ground import rigid

FEET = np.array([[0.1, 0.1], [-0.15, 0.05], [0.05, -0.2]])
LOADS = np.linalg.solve(np.vstack([FEET.T, np.ones(3)]), [0, 0, 1])  # [1] shares of the weight
FRICTION = Friction(0.3, 0.4)
TWIST = (0.05, 0.0, 0.03)


@pytest.fixture(scope="module", autouse=True)
def registered_boxes(tmp_path_factory):
    """A box on feet, a box on its corners, and a box whose feet are at its corners."""
    path = tmp_path_factory.mktemp("feet") / "wedge.xml"
    box = (objects.mjcf_folder() / "box.xml").read_text().replace("0.20 0.20 0.40", "0.2 0.3 0.25")
    path.write_text(re.sub('mass="20"', 'mass="12"', re.sub('pos="[^"]*"', "", box)))
    corners = solid.rectangles(np.array([0.2]), np.array([0.3]))[0]
    objects.register_object("on_feet", path, feet=FEET)
    objects.register_object("on_corners", path)
    objects.register_object("on_both", path, feet=corners)
    yield path
    for name in ("on_feet", "on_corners", "on_both"):
        del objects.REGISTERED[name], objects.FAMILIES[name]


def start(name):
    """Return a scene and its initial positions, with the base at the object, off its middle."""
    loaded = scene.load(name, FINE, FRICTION)
    qpos = scene.initial_qpos(loaded, -0.0005, 0.2)
    qpos[4:6] += 0.1, -0.0005  # sunk, so that rounding does not decide what touches
    return loaded, qpos


def pushed_in_c(name):
    """Return positions (10,) after 3 s at TWIST in C MuJoCo."""
    loaded, qpos = start(name)
    return step_in_c(loaded.physics, qpos, TWIST, 300).qpos


def driven(engine, names, steps):
    """Return positions (n, 10) after steps at TWIST in an engine."""
    scenes, qpos = zip(*map(start, names), strict=True)
    stage, fields = staged(engine, scenes, FINE)
    return simulate(engine, stage, fields, np.array(qpos), TWIST, FINE, steps).qpos[-1]


Y = 4  # of the object, along the base's front, on which it comes to lie


@pytest.mark.parametrize("engine", ["fused", slow("mjx")])
def test_feet_change_the_final_pose_and_engines_agree_with_c_mujoco(engine):
    feet, corners = (pushed_in_c(name) for name in ("on_feet", "on_corners"))
    assert feet[Y] - corners[Y] > 0.01
    qpos = driven(engine, ["on_feet", "on_both"], 300)
    assert_allclose(qpos[0], feet, atol=2e-3)
    assert_allclose(qpos[1, :6], corners[:6], atol=3e-3)


def test_quasistatic_is_nearer_to_c_mujoco_with_equal_feet():
    feet, corners = (pushed_in_c(name) for name in ("on_feet", "on_corners"))
    qpos = driven("quasistatic", ["on_feet", "on_both"], 300)
    for expected, equal, unequal in ((feet, *qpos), (corners, *qpos[::-1])):
        assert abs(equal[Y] - expected[Y]) < abs(unequal[Y] - expected[Y])


def test_a_scene_returns_its_feet():
    row = scene.solid_of(scene.load("on_feet", FINE, FRICTION))
    assert_array_equal(row.feet[0, :3], np.column_stack([FEET, np.ones(3)]))
    assert_array_equal(row.feet[0, 3:, 2], 0)
    assert row.feet.shape == (1, SIDES, 3)
    assert scene.solid_of(scene.load("on_corners", FINE, FRICTION)).feet is None


def test_the_arm_of_friction_is_that_of_the_feet():
    row = scene.solid_of(scene.load("on_feet", FINE, FRICTION))
    arm = solid.friction_arm(row)[0]
    assert arm == pytest.approx(LOADS @ np.linalg.norm(FEET, axis=1), rel=1e-4)
    names = ("on_both", "on_corners")
    both, corners = (scene.solid_of(scene.load(name, FINE, FRICTION)) for name in names)
    assert solid.friction_arm(both) == pytest.approx(solid.friction_arm(corners))
    # A foot that is heavy on the load counts for more: four in a square, about the middle.
    square = np.array([[0.1, 0.1], [-0.1, 0.1], [-0.1, -0.1], [0.1, -0.1], [0.0, 0.0]])
    for weight, expected in ((1.0, 0.8), (4.0, 0.5), (1e9, 0.0)):
        feet = np.zeros((1, SIDES, 3))
        feet[0, :5] = np.column_stack([square, [1, 1, 1, 1, weight]])
        share = solid.friction_arm(row._replace(feet=feet))[0] / np.hypot(0.1, 0.1)
        assert share == pytest.approx(expected, abs=1e-6)


def test_the_rigid_solver_supports_feet():
    row = scene.solid_of(scene.load("on_feet", FINE, FRICTION))
    feet = rigid.supports(row, np.zeros(1), np.zeros((1, 2)))
    assert_allclose(feet[0, :3], FEET, atol=1e-9)
    load = rigid.supported_load(feet, np.zeros((1, 2)), np.zeros((1, 1)), row.feet[..., 2])
    assert_allclose(load[0], [*LOADS, *np.zeros(SIDES - 3)], atol=1e-9)


@pytest.mark.parametrize(
    ("feet", "message"),
    [
        (FEET[:2], "give 3 to 8 rows"),
        (np.column_stack([FEET, [1, 0, 1]]), "must be positive"),
        (FEET + 0.3, "it tips over"),
        (FEET * np.nan, "must be finite"),
    ],
)
def test_feet_without_sense_are_refused(registered_boxes, feet, message):
    with refusing(message):
        objects.register_object("wrong", registered_boxes, feet=feet)
    assert "wrong" not in objects.REGISTERED


# --- feet that are drawn ---


def drawn_on_feet(name, count=4):
    """Return worlds with drawn feet, and the same worlds without feet."""
    changes = f"wide,objects={name},gap=0,lateral=-0.05:0.05,height=0.3:0.4,friction_ground=0.1:0.4"
    ranges = [domains.parse_domain(changes), domains.parse_domain(f"{changes},feet=0.5:0.9")]
    plain, on_feet = (draws.draw(domain, 3, np.arange(count)) for domain in ranges)
    return plain, on_feet, ranges[1].families[0]


def stepped(engine, family, drawn, steps):
    """Return positions (n, 10) of drawn worlds after steps at TWIST in an engine."""
    stage, fields = engines.get(engine).stage(
        WorldInputs(family, drawn.solid, drawn.friction, FINE)
    )
    qpos = starts(drawn)
    qpos[:, [3, 5]] -= 0.0005
    return simulate(engine, stage, fields, qpos, TWIST, FINE, steps).qpos[-1]


@pytest.mark.parametrize("name", domains.RANDOM)
def test_drawn_feet_change_nothing_else_and_bear_the_object(name):
    plain, drawn, _ = drawn_on_feet(name, 64)
    assert plain.solid.feet is None
    same(*(x._replace(solid=None, values=None) for x in (plain, drawn)))
    assert_array_equal(plain.solid.mass, drawn.solid.mass)
    assert set(drawn.values) - set(plain.values) == {"feet"}
    feet, com = drawn.solid.feet, drawn.solid.p_object_com[:, :2]
    assert set(feet[..., 2].sum(axis=1)) == {3.0, 4.0}
    bearing = np.linspace(0, 2 * np.pi, 90)
    for i, share in enumerate(drawn.values["feet"]):
        reach = feet[i, :, :2] - com[i]
        # Stretched by the share, a foot lies on the outline.
        edge = com[i] + reach[feet[i, :, 2] > 0] / share
        outline = Footprint(drawn.solid.vertices[i], drawn.solid.radius[i])
        assert_allclose(footprint.signed_distance(outline, edge), 0, atol=1e-6)
        assert (reach @ [np.cos(bearing), np.sin(bearing)]).max(axis=0).min() > 0


@pytest.mark.parametrize(
    ("engine", "name"),
    [
        ("fused", "random_cylinder"),
        slow("fused", "random_box"),
        slow("mjx", "random_cylinder"),
    ],
)
def test_objects_on_drawn_feet_end_where_those_of_c_mujoco_do(engine, name):
    plain, drawn, family = drawn_on_feet(name)
    expected = stepped("mujoco", family, drawn, 300)
    of_plain = stepped("mujoco", name.removeprefix("random_"), plain, 300)
    off = np.abs(stepped(engine, family, drawn, 300) - expected)[:, 3:5].max()
    assert off < 0.5 * np.abs(of_plain - expected)[:, 3:5].max()
    assert off < 0.012


def test_quasistatic_slides_on_drawn_feet():
    plain, drawn, family = drawn_on_feet("random_prism")
    inputs = WorldInputs(family, drawn.solid, drawn.friction, FINE)
    _, sliders = engines.get("quasistatic").stage(inputs)
    three = drawn.solid.feet[..., 2].sum(axis=1) == 3
    assert three.any()
    for i in np.flatnonzero(three):
        r = drawn.solid.feet[i, :3, :2] - drawn.solid.p_object_com[i, :2]
        load = np.linalg.solve(np.vstack([r.T, np.ones(3)]), [0, 0, 1])
        assert sliders.arm[i] == pytest.approx(load @ np.linalg.norm(r, axis=1), rel=1e-6)
    assert (np.asarray(sliders.arm) < solid.friction_arm(plain.solid)).all()


def test_feet_are_drawn_only_for_random_objects():
    with refusing("only random objects have drawn feet"):
        domains.parse_domain("wide,objects=box,feet=0.5:0.9")
    with refusing("the feet of on_feet leave no support to draw"):
        domains.parse_domain("wide,objects=on_feet,support=0:2")
    ranges, plain = (domains.parse_domain(f"wide{feet}") for feet in (",feet=0.5:0.9", ""))
    names = {"feet", "feet_number", "feet_turn"}
    assert set(points.names(ranges)) - set(points.names(plain)) == names
    u = points.points_of(ranges, np.arange(6), 1)
    again = points.draw(ranges, 1, points.check_points(ranges, u), [0, 3])
    drawn = draws.draw(ranges, 1, [0, 3])
    assert_array_equal(again.solid.feet, drawn.solid.feet)
