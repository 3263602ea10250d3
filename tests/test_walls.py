"""Objects that slide along walls: engines agree with converged C MuJoCo, and with mechanics."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jitted, refusing, slow
from numpy.testing import assert_allclose
from staging import Recording, drive, simulate

import rps_jax
from rps_jax import engines
from rps_jax.engines.base import Motion
from rps_jax.geometry import footprint
from rps_jax.geometry import solid as solids
from rps_jax.geometry.solid import Solid
from rps_jax.trials import worlds
from rps_jax.trials.setting import Setting
from rps_jax.world import draws
from rps_jax.world.domain import parse_domain
from rps_jax.world.physics import Physics, preset
from rps_jax.world.scene import Surroundings
from rps_jax.world.tasks import corridor, parse_task
from rps_jax.world.tasks.base import Positions

STANDARD, REFERENCE = preset(), preset("default", "reference")
Y = 0.22  # [m] of a straight wall, 2 cm beside the object
STRAIGHT, FAR = [[0.2, Y], [6, Y]], [[0, -9], [6, -9]]
# A wall that turns into the object's way by 45 degrees, as walls of a corridor meet.
CORNER = [[0.2, Y], [0.91, Y]], [[0.893, Y + 0.007], [2, Y - 1.1]]
MIRRORED = [[0.2, -Y], [6, -Y]]
LAYOUTS = (STRAIGHT, FAR), (FAR, STRAIGHT), CORNER, (MIRRORED, FAR)
FRICTION = (0.3, 1e-5, 0.3, 0.3)
TWISTS = np.array([[0.048, 0.013, 0], [0.048, 0.013, 0], [0.05, 0, 0], [0.048, -0.013, 0]])
GROUND, ROBOT, MASS = 0.3, 0.4, 15.0  # friction [1], and mass [kg] of the object


@cache
def staged(family: str, engine: str, physics: Physics):
    """Return stage and fields of four equal objects beside walls, and positions at the start."""
    single = f"mass={MASS},size=0.2,aspect=1,com_offset=0,lateral=0,yaw=0,gap=0"
    friction = f"friction_ground={GROUND},friction_robot={ROBOT}"
    domain = parse_domain(f"wide,objects=random_{family},{single},{friction}")
    drawn = draws.draw(domain, 0, np.zeros(len(LAYOUTS), int))
    around = Surroundings(walls=np.array(LAYOUTS), friction_wall=np.array(FRICTION))
    inputs = drawn.inputs(domain, physics)._replace(surroundings=around)
    qpos = worlds.starts(drawn)
    # A prism turns away before it comes far.
    qpos[:, 4] = Y - (0.003 if family == "prism" else 0.02) - outermost(drawn.solid, qpos)
    return *engines.get(engine).stage(inputs), qpos, drawn.solid


def outermost(solid: Solid, qpos: np.ndarray) -> np.ndarray:
    """Return the greatest y (..., n) [m] of objects at positions (..., n, 10)."""
    y, _, w, _, _, z = np.moveaxis(qpos[..., 4:], -1, 0)
    corners = solids.rotate(2 * np.arctan2(z, w)[..., None], solid.vertices)
    return y + corners[..., 1].max(axis=-1) + solid.radius


@cache
def slid(family: str, engine: str, physics: Physics) -> Recording:
    """Return eight seconds of pushes along walls."""
    stage, fields, qpos, _ = staged(family, engine, physics)
    return simulate(engine, stage, fields, qpos, TWISTS, physics, 400)


@pytest.mark.parametrize(
    ("family", "engine"),
    [
        (x, engine) if (x, engine) == ("box", "fused") else slow(x, engine)
        for x in ("box", "cylinder", "prism")
        for engine in ("fused", "mjx")
    ],
)
def test_slides_along_walls_agree_with_c_mujoco(family, engine):
    computed, expected = slid(family, engine, STANDARD), slid(family, "mujoco", REFERENCE)
    away = np.linalg.norm(computed.qpos[..., 3:5] - expected.qpos[..., 3:5], axis=-1)
    assert away.max() < (7e-3 if family == "prism" else 3e-3)  # a prism turns, and differences grow
    assert_allclose(computed.qpos[-1, :, 6:], expected.qpos[-1, :, 6:], atol=0.07)
    *_, solid = staged(family, engine, STANDARD)
    for qpos in (computed.qpos, expected.qpos):
        if family != "prism":
            assert_allclose(qpos[:, 3, 3:5], qpos[:, 0, 3:5] * [1, -1], atol=2e-3)
        beyond = outermost(solid, qpos)[:, :2] - Y
        assert -0.0011 < beyond.max() < -0.0005  # at the face of a sheet of 2 mm


def test_the_force_of_a_slide_is_that_of_coulombs_law():
    """The base pushes along the wall against the ground and, in the first world, the wall.

    The object rattles at the wall, so that some of its feet stick for a moment: 5 % less friction.
    """
    computed, expected = (
        -slid("box", engine, physics).force[-300:, :2, 0].mean(axis=0)
        for engine, physics in (("fused", STANDARD), ("mujoco", REFERENCE))
    )
    assert expected[1] == pytest.approx(GROUND * MASS * 9.81, rel=0.16)
    assert_allclose(computed, expected, rtol=0.15)
    for rough, smooth in (computed, expected):
        assert 1.01 < rough / smooth < 1 / (1 - ROBOT * FRICTION[0]) + 0.01


def test_engines_agree_with_a_friction_pyramid():
    physics = preset("paper_gazebo")
    computed, expected = slid("box", "fused", physics), slid("box", "mujoco", physics)
    away = np.linalg.norm(computed.qpos[..., 3:5] - expected.qpos[..., 3:5], axis=-1)
    assert away[:, [0, 2, 3]].max() < 0.01


@pytest.mark.slow
def test_derivatives_of_a_slide_are_those_of_its_wall(monkeypatch):
    """A wall that moves aside lets the object follow; so do functions of C and of XLA."""
    stage, fields, *_ = staged("cylinder", "fused", STANDARD)
    fields = jax.tree.map(lambda x: jnp.asarray(x, float), fields)
    middle = jax.tree.map(lambda x: jnp.asarray(x[300], float), slid("cylinder", "fused", STANDARD))
    motion = Motion(middle.qpos, middle.qvel, 0 * middle.qvel)
    twists = jnp.asarray(np.broadcast_to(TWISTS, (10, *TWISTS.shape)))

    def end(aside):
        ends = fields.walls.at[..., 1::2].add(aside)
        moved = drive(stage, fields._replace(walls=ends), motion, twists, STANDARD)
        return moved.qpos[-1, :, 4]

    def derivative():
        return jax.jit(lambda x: jax.jvp(end, (x,), (jnp.ones(()),)))(jnp.zeros(()))

    compiled, slope = derivative()
    monkeypatch.setenv("RPS_COMPILER", "none")
    assert (np.asarray(slope)[:2] > 0.3).all(), slope
    by_xla, xlas = derivative()
    assert_allclose(compiled, by_xla, atol=1e-5)
    assert_allclose(slope, xlas, atol=0.02)


REFUSED = {
    "corridor,touch=base": "task touch",
    "corridor,friction_wall=0.1": "without touch=object",
    "corridor,touch=object,friction_wall=-1": "task friction_wall",
    "corridor,touch=object,friction_wall=x": "task friction_wall = x",
}


@pytest.mark.parametrize("text", REFUSED)
def test_a_wrong_wall_is_refused(text):
    with refusing(REFUSED[text]):
        parse_task(text)


def test_the_quasistatic_engine_has_no_walls():
    with refusing("it has no walls; choose mjx or fused or mujoco"):
        rps_jax.draw_worlds(
            "wide,objects=random_box", task="corridor,touch=object", setting=Setting("quasistatic")
        )


def test_walls_of_a_corridor_have_no_inner_ends():
    """Past each corner, the next wall begins behind the line of the last one."""
    for task in ("corridor,turns=3,touch=object", "corridor,turns=0,touch=object"):
        course = rps_jax.draw_worlds("wide,objects=random_box", 8, task=task).worlds.task
        walls, solid = np.asarray(course.walls), course.surroundings["walls"]
        near = np.abs(solid).max(axis=(2, 3)) < 1e3
        assert (near.sum(axis=1) == (8 if "turns=3" in task else 2)).all()
        for row, mask, drawn in zip(solid, near, walls, strict=True):
            for start, end in row[mask]:
                assert np.abs(drawn - start).sum(axis=-1).min() < 0.05
                assert np.abs(drawn - end).sum(axis=-1).min() < 0.05


@pytest.mark.parametrize(
    ("touch", "depth", "expected"),
    [
        ("object", 0.008, corridor.NOTHING),
        ("object", 0.012, corridor.OBJECT),
        ("nothing", 0.001, corridor.OBJECT),
        ("nothing", -0.001, corridor.NOTHING),
    ],
)
def test_a_trial_fails_where_an_object_is_pressed_into_a_wall(touch, depth, expected):
    task = f"corridor,touch={touch},turns=0,width=1.4,length=6"
    drawn = rps_jax.draw_worlds("wide,objects=random_box", 1, task=task).worlds
    course = jax.tree.map(lambda x: jnp.asarray(x[0], float), drawn.task)
    box = footprint.rectangle(0.2, 0.2)
    at = jnp.array([1.2, 0.7 - 0.2 + depth])
    zero = jnp.zeros(())
    positions = Positions(
        at, at, zero > 0, jnp.zeros(3), footprint.rectangle(0.36, 0.29), at, zero, box
    )
    step = jitted(type(course).step)
    progress, aim = step(course, course.start(), positions)
    assert progress.wall_touch == expected
    assert aim.failed == (expected != corridor.NOTHING)
    positions = positions._replace(base=jnp.array([0.0, 0.45, 0.0]))
    assert step(course, course.start(), positions)[0].wall_touch == corridor.BASE
