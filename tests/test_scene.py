"""The scenes agree with the paper, and MJX steps them like C MuJoCo."""

import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import extent, refusing, slow, temporary_names
from numpy.testing import assert_allclose, assert_array_equal
from staging import simulate, stack, staged, step_in_c

from rps_jax.engines import mjx as mjx_engine
from rps_jax.geometry import footprint as fp
from rps_jax.robot import shell
from rps_jax.trials import pushes
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.world import draws, objects, scene
from rps_jax.world.domain import parse_domain
from rps_jax.world.objects import FAMILIES, OBJECTS
from rps_jax.world.physics import Physics
from rps_jax.world.scene import FRICTION, JOINTS

STEP = 0.01  # [s]
TWIST = np.array([0.05, 0.01, 0.1])  # base x, y [m/s], yaw [rad/s] in the world


def load(name, **options):
    return scene.load(name, Physics(timestep=STEP), **options)


def touching(loaded):
    """A start with the object half a millimetre inside the skin, so that contact acts at once."""
    return scene.initial_qpos(loaded, gap=-0.0005)


@pytest.mark.parametrize("family", [slow("box"), "cylinder"])
def test_mjx_agrees_with_c_mujoco_at_one_step_and_over_0_4_seconds(family):
    names = [name for name in OBJECTS if FAMILIES[name] == family]
    scenes = [load(name, friction=f) for name in names for f in FRICTION.values()]
    # Where capsule and face are exactly parallel, MJX reports both ends of the line of contact
    # and C MuJoCo one: the first step of a cylinder is compared before it touches.
    gap = 0.005 if family == "cylinder" else -0.0005
    starts = np.array([scene.initial_qpos(s, gap=x) for x in (gap, -0.0005) for s in scenes])
    physics, count = Physics(timestep=STEP, control_period=STEP), len(scenes)
    near, pushed = slice(0, count), slice(count, None)
    ours, theirs = (
        simulate(engine, *staged(engine, 2 * scenes, physics), starts, TWIST, physics, 40)
        for engine in ("mjx", "mujoco")
    )
    assert_allclose(ours.qpos[1, near], theirs.qpos[1, near], atol=2e-6)
    assert_allclose(ours.qvel[1, near], theirs.qvel[1, near], atol=1e-3)

    # After a push of 20 mm the x position is sharp; y depends on stick and slip at a corner.
    qpos, want = ours.qpos[40, pushed], theirs.qpos[40, pushed]
    assert (want[:, 3] - starts[pushed, 3] > 0.02).all(), "the base must have pushed every object"
    assert_allclose(qpos[:, 3], want[:, 3], atol=1e-3)
    assert_allclose(qpos[:, 4], want[:, 4], atol=3e-3)
    assert_allclose(qpos[:, JOINTS.base], want[:, JOINTS.base], atol=5e-5)


@pytest.mark.parametrize("name", OBJECTS)
def test_the_stripped_model_moves_as_the_whole_scene(name):
    loaded = load(name)
    models = (loaded.model, loaded.physics)
    whole, stripped = (step_in_c(model, touching(loaded), TWIST, 20) for model in models)
    assert_allclose(stripped.qpos, whole.qpos, atol=5e-5)


@pytest.mark.parametrize(
    ("name", "mass", "half_extents"),
    [
        ("box", 20.0, (0.20, 0.20)),
        ("nonuniform_box", 15.0, (0.225, 0.225)),
        ("cylinder", 25.0, (0.25, 0.25)),
        ("hardware_box", 25.0, (0.16, 0.13)),
        ("hardware_cylinder", 12.0, (0.115, 0.115)),
    ],
)
def test_objects_have_the_papers_mass_and_size_and_stand_on_the_ground(name, mass, half_extents):
    loaded = load(name)
    assert loaded.physics.body("object").mass[0] == pytest.approx(mass)
    for axis, half in zip(np.eye(2), half_extents, strict=True):
        assert float(extent(loaded.footprint, axis)) == pytest.approx(half)
    geom = loaded.model.geom("object")
    half_height = geom.size[2] if geom.type[0] == mujoco.mjtGeom.mjGEOM_BOX else geom.size[1]
    assert loaded.model.body("object").pos[2] == pytest.approx(half_height)


def test_the_nonuniform_boxs_centre_of_mass_follows_from_its_two_parts():
    # 10 of 15 kg stand 12.5 cm back and left and 45 cm above the middle of the box.
    expected = np.array([-0.125, 0.125, 0.45]) * 10 / 15
    for rear, x in (("near", 1), ("far", -1)):
        ipos = load("nonuniform_box", rear=rear).physics.body("object").ipos
        assert_allclose(ipos, expected * [x, 1, 1], atol=5e-6)


@pytest.mark.parametrize("name", OBJECTS)
def test_the_base_is_as_large_as_its_skin(name):
    size = load(name).model.geom("base").size
    assert size[:2] == pytest.approx([shell.HALF_LENGTH, shell.HALF_WIDTH])


@pytest.mark.parametrize("label", FRICTION)
def test_friction_reaches_both_contact_pairs(label):
    pairs = load("cylinder", friction=FRICTION[label]).physics.pair_friction
    expected = {"S1": (0.3, 0.35), "S2": (0.2, 0.5)}[label]  # Table I
    assert pairs[:, :2] == pytest.approx(np.repeat(np.array(expected)[:, None], 2, axis=1))


def test_a_given_mass_scales_the_inertia_and_keeps_the_centre():
    plain, heavy = load("nonuniform_box"), load("nonuniform_box", mass=30.0)
    a, b = plain.physics.body("object"), heavy.physics.body("object")
    assert b.mass[0] == pytest.approx(30.0)
    assert_allclose(b.inertia, 2 * a.inertia, rtol=1e-6)
    assert_allclose(b.ipos, a.ipos, atol=1e-9)


@pytest.mark.parametrize("yaw", [0.0, 0.3, np.pi / 4])
def test_the_object_starts_the_gap_in_front_of_the_face(yaw):
    loaded = load("box")
    qpos = scene.initial_qpos(loaded, gap=0.02, yaw=yaw)
    placed = fp.place(loaded.footprint, jnp.asarray(qpos[3:5]), jnp.asarray(yaw))
    assert float(placed.vertices[:, 0].min()) == pytest.approx(shell.HALF_LENGTH + 0.02, abs=1e-6)


def test_a_stack_holds_every_field_of_each_recompiled_model():
    drawn = ("box", "S1", None), ("nonuniform_box", "S2", None), ("hardware_box", "S2", 7.0)
    scenes = [load(name, friction=FRICTION[label], mass=mass) for name, label, mass in drawn]
    model, fields = stack([s.physics for s in scenes])
    assert set(fields) == set(mjx_engine.FIELDS)
    for i, loaded in enumerate(scenes):
        applied = mjx_engine.apply(model, {name: values[i] for name, values in fields.items()})
        alone, _ = stack([loaded.physics])  # recompiled by itself
        jax.tree.map(assert_array_equal, applied, alone)


def test_the_base_keeps_its_commanded_speed_against_the_heaviest_object():
    loaded = load("cylinder")
    data = step_in_c(loaded.physics, touching(loaded), (*TWIST[:2], 0.0), 100)
    # 25 kg x 9.81 m/s^2 x 0.3 = 74 N against an armature of 1e6 kg.
    assert_allclose(data.qpos[:2], TWIST[:2] * 1.0, atol=5e-6)


def test_the_closets_sizes_and_mass_are_drawn_from_the_guesses_of_its_file():
    ranges = objects.guesses_of("closet")
    drawn = draws.draw(parse_domain("hardware,objects=closet"), 3, np.arange(200)).solid
    half = drawn.vertices[:, 0]
    values = np.column_stack([2 * half, drawn.height, drawn.mass])
    assert np.all((values >= ranges[:, 0]) & (values <= ranges[:, 1]))
    assert np.all(np.ptp(values, axis=0) > 0.9 * np.ptp(ranges, axis=1))
    case, setting = Case("closet"), Setting("mujoco")
    first, second = (pushes.scene_of(case, setting, i) for i in (0, 1))
    assert first.solid.mass != second.solid.mass
    geom = first.model.geom("object")
    assert_allclose(geom.size[:2], first.solid.vertices[0])
    assert_allclose(first.model.body("object").pos[2], geom.size[2])
    assert pushes.title_of(case, first).endswith(f"{float(first.solid.mass):.1f} kg")
    assert pushes.scene_of(Case("closet", mass=30.0), setting).solid.mass == 30.0
    start = pushes.build([case, case], setting).worlds.qpos
    assert start[0, JOINTS.object_height] != start[1, JOINTS.object_height]


def test_guesses_that_are_no_ranges_of_a_box_are_refused(tmp_path):
    text = (objects.mjcf_folder() / "closet.xml").read_text()
    for data in ("0.4 0.5", "0.6 0.35 0.5 1 0.8 1.8 20 60", "0.4 0.5 0.5 1 0.8 1.8 0 60"):
        path = tmp_path / "guessed.xml"
        path.write_text(re.sub('data="[^"]*"', f'data="{data}"', text))
        with temporary_names(), refusing("give low and high of depth"):
            objects.register_object("guessed", path)
