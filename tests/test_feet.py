"""Objects that stand on feet of their own, in the engines that know them."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rps_jax import engines
from rps_jax.control.observation import Twist
from rps_jax.engines.base import Motion
from rps_jax.engines.fused import step as fused
from rps_jax.errors import InputError
from rps_jax.geometry import footprint, solid
from rps_jax.geometry.solid import SIDES
from rps_jax.world import objects, scene
from rps_jax.world.physics import Physics
from rps_jax.world.scene import Friction
from sweeps.ground import rigid

XML = """
<mujoco model="wedge">
  <include file="base.xml"/>
  <worldbody>
    <body name="object">
      <freejoint name="object"/>
      <geom name="object" class="object" type="box" size="0.2 0.3 0.25" mass="12"/>
    </body>
  </worldbody>
</mujoco>"""
FEET = np.array([[0.1, 0.1], [-0.15, 0.05], [0.05, -0.2]])
FINE = Physics(control_period=0.01, iterations=30, ls_iterations=20)
FRICTION = Friction(0.3, 0.4)
TWIST = (0.05, 0.0, 0.03)


@pytest.fixture(scope="module", autouse=True)
def stands(tmp_path_factory):
    """A box on feet, a box on its corners, and one on feet that are its corners."""
    path = tmp_path_factory.mktemp("feet") / "wedge.xml"
    path.write_text(XML)
    corners = solid.rectangles(np.array([0.2]), np.array([0.3]))[0]
    objects.register_object("on_feet", path, feet=FEET)
    objects.register_object("on_corners", path)
    objects.register_object("on_both", path, feet=corners)
    yield path
    for name in ("on_feet", "on_corners", "on_both"):
        del objects.REGISTERED[name], objects.FAMILIES[name]


def start(name):
    """A scene, and where it begins: the base at the object, off its middle."""
    loaded = scene.load(name, FINE, FRICTION)
    qpos = scene.initial_qpos(loaded, -0.0005, 0.2)
    qpos[4:6] += 0.1, -0.0005  # sunk, so that rounding does not decide what touches
    return loaded, qpos


def in_c(name, steps):
    """Positions (10,) after steps at TWIST in C MuJoCo."""
    loaded, qpos = start(name)
    data = mujoco.MjData(loaded.physics)
    data.qpos[:] = qpos
    for _ in range(steps):
        c, s = np.cos(data.qpos[2]), np.sin(data.qpos[2])
        data.qvel[:3] = c * TWIST[0] - s * TWIST[1], s * TWIST[0] + c * TWIST[1], TWIST[2]
        mujoco.mj_step(loaded.physics, data)
    return data.qpos.copy()


def driven(engine, names, steps):
    """Positions (n, 10) after steps at TWIST in an engine."""
    scenes, qpos = zip(*map(start, names), strict=True)
    stage, fields = engines.get(engine).stage_of_scenes(scenes, np.arange(len(names)))
    twist = Twist(*(jnp.full(len(names), x) for x in TWIST))
    still = jnp.zeros((len(names), 9))

    @jax.jit
    def run(motion):
        return jax.lax.fori_loop(
            0, steps, lambda _, now: stage.drive(fields, now, twist, FINE).motion, motion
        )

    fields = jax.tree.map(lambda x: jnp.asarray(x, float), fields)
    return np.asarray(run(Motion(jnp.asarray(np.array(qpos), float), still, still)).qpos, float)


Y = 4  # of the object, along the base's front, on which it comes to lie


def test_feet_decide_where_an_object_ends_and_fused_ends_where_c_mujoco_does():
    feet, corners = in_c("on_feet", 300), in_c("on_corners", 300)
    assert feet[Y] - corners[Y] > 0.01
    found = driven("fused", ["on_feet", "on_both"], 300)
    np.testing.assert_allclose(found[0], feet, atol=2e-3)
    np.testing.assert_allclose(found[1, :6], corners[:6], atol=3e-3)


def test_quasistatic_ends_nearer_to_c_mujoco_with_the_same_feet():
    feet, corners = in_c("on_feet", 300), in_c("on_corners", 300)
    found = driven("quasistatic", ["on_feet", "on_both"], 300)
    assert found[0, Y] - found[1, Y] > 0.005
    for one, same, other in ((found[0], feet, corners), (found[1], corners, feet)):
        assert abs(one[Y] - same[Y]) < abs(one[Y] - other[Y])


@pytest.mark.slow
def test_the_kernel_stands_on_feet_too():
    """In Pallas's interpreter, beside XLA."""
    loaded, qpos = start("on_feet")
    _, bodies = engines.get("fused").stage_of_scenes([loaded], np.zeros(1, int))
    bodies = jax.tree.map(lambda x: jnp.asarray(x, float), bodies)
    still, physics = jnp.zeros((1, 9)), Physics(timestep=0.02)
    scalars = fused.spread(bodies)
    state = fused.enter(bodies, Motion(jnp.asarray(qpos, float)[None], still, still))
    twist = tuple(jnp.full(1, x) for x in TWIST)
    expected = fused.in_xla(scalars, state, twist, physics=physics)
    found = fused.in_a_kernel(scalars, state, twist, physics=physics, interpret=True)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3)


def test_a_scene_gives_its_feet_back():
    one = scene.solid_of(scene.load("on_feet", FINE, FRICTION))
    np.testing.assert_array_equal(one.feet[0, :3], np.column_stack([FEET, np.ones(3)]))
    np.testing.assert_array_equal(one.feet[0, 3:, 2], 0)
    assert one.feet.shape == (1, SIDES, 3)
    assert scene.solid_of(scene.load("on_corners", FINE, FRICTION)).feet is None


def test_the_arm_of_friction_is_that_of_the_feet():
    one = scene.solid_of(scene.load("on_feet", FINE, FRICTION))
    loads = np.linalg.solve(np.vstack([FEET.T, np.ones(3)]), [0, 0, 1])
    arm = solid.friction_arm(one)[0]
    assert arm == pytest.approx(loads @ np.linalg.norm(FEET, axis=1), rel=1e-4)
    names = ("on_both", "on_corners")
    both, corners = (scene.solid_of(scene.load(name, FINE, FRICTION)) for name in names)
    assert solid.friction_arm(both) == pytest.approx(solid.friction_arm(corners))
    # A foot that is heavy on the load counts for more: four in a square, about the middle.
    square = np.array([[0.1, 0.1], [-0.1, 0.1], [-0.1, -0.1], [0.1, -0.1], [0.0, 0.0]])
    for weight, expected in ((1.0, 0.8), (4.0, 0.5), (1e9, 0.0)):
        feet = np.zeros((1, SIDES, 3))
        feet[0, :5] = np.column_stack([square, [1, 1, 1, 1, weight]])
        share = solid.friction_arm(one._replace(feet=feet))[0] / np.hypot(0.1, 0.1)
        assert share == pytest.approx(expected, abs=1e-6)


def test_the_rigid_solver_stands_on_feet():
    one = scene.solid_of(scene.load("on_feet", FINE, FRICTION))
    feet = rigid.supports(one, np.zeros(1), np.zeros((1, 2)))
    np.testing.assert_allclose(feet[0, :3], FEET, atol=1e-9)
    load = rigid.borne(feet, np.zeros((1, 2)), np.zeros((1, 1)), one.feet[..., 2])
    expected = np.linalg.solve(np.vstack([FEET.T, np.ones(3)]), [0, 0, 1])
    np.testing.assert_allclose(load[0], [*expected, *np.zeros(SIDES - 3)], atol=1e-9)


@pytest.mark.parametrize(
    ("feet", "message"),
    [
        (FEET[:2], "give 3 to 8 rows"),
        (np.column_stack([FEET, [1, -1, 1]]), "weights positive"),
        (FEET + 0.3, "it tips over"),
        (FEET * np.nan, "must be finite"),
    ],
)
def test_feet_without_sense_are_refused(stands, feet, message):
    with pytest.raises(InputError, match=message):
        objects.register_object("wrong", stands, feet=feet)
    with pytest.raises(InputError, match="not allowed under a circle"):
        objects.register_object("wrong", stands, footprint.circle(0.2), FEET)
    assert "wrong" not in objects.REGISTERED


def test_mjx_says_that_it_knows_no_feet():
    with pytest.raises(InputError, match="engine = mjx is not allowed for objects with feet"):
        engines.get("mjx").stage_of_scenes([start("on_feet")[0]], np.zeros(1, int))
