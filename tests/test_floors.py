"""Floors that slope, and floors with two frictions, by mechanics of rigid bodies."""

import dataclasses
import functools
import math

import numpy as np
import pytest
from helpers import refusing, same, slow
from numpy.testing import assert_allclose, assert_array_equal
from staging import FINE, simulate, staged

import rps_jax
from rps_jax import engines
from rps_jax.geometry import footprint, solid
from rps_jax.geometry.footprint import Footprint
from rps_jax.geometry.solid import SIDES
from rps_jax.robot.robot import Robot
from rps_jax.trials.worlds import starts
from rps_jax.tuning import derivatives
from rps_jax.world import domain as domains
from rps_jax.world import draws, points, scene
from rps_jax.world.physics import preset
from rps_jax.world.scene import Friction, Surroundings

G, MASS = 9.81, 20.0  # [m/s^2], [kg] of the box
STEEP = math.radians(6)  # [rad]
FAR = (1.0, 0.0, 1e3, 1.0)  # boundary that nothing reaches
SPEED = 0.2  # [m/s] of a push
PERIOD = preset().control_period  # [s]
# By name: slope [rad] and the bearing in which it falls [degrees], friction with the ground,
# boundary, speed of the base, and velocity of the box (v_x, v_y, omega) at the start.
WORLDS = {
    "down x": (STEEP, 0, 0.05, FAR, 0.0, 0.0),
    "down y": (STEEP, 90, 0.05, FAR, 0.0, 0.0),
    "down -y": (STEEP, -90, 0.05, FAR, 0.0, 0.0),
    "oblique": (STEEP / 2, 35, 0.02, FAR, 0.0, 0.0),
    "rough": (STEEP, 90, 0.3, FAR, 0.0, 0.0),
    "uphill": (STEEP, 180, 0.3, FAR, SPEED, 0.0),
    "downhill": (STEEP, 0, 0.3, FAR, SPEED, 0.0),
    "to carpet": (0.0, 0, 0.15, (1.0, 0.0, 0.9, 3.0), SPEED, 0.0),
    "to tile": (0.0, 0, 0.45, (1.0, 0.0, 0.9, 1 / 3), SPEED, 0.0),
    "carpet left": (0.0, 0, 0.1, (0.0, 1.0, 0.0, 3.0), 0.0, 0.5),
    "carpet right": (0.0, 0, 0.1, (0.0, -1.0, 0.0, 3.0), 0.0, 0.5),
}
ENGINES = ("mujoco", "fused", slow("mjx"))


def surroundings_of(rows):
    """Return the surroundings of rows of slope [rad], bearing [degrees] and boundary."""
    steep, bearing = (np.array([row[i] for row in rows]) for i in range(2))
    bearing = np.radians(bearing)
    along = np.stack([np.sin(steep) * np.cos(bearing), np.sin(steep) * np.sin(bearing)])
    gravity = G * np.stack([*along, -np.cos(steep)], axis=-1)
    return Surroundings(gravity, np.array([row[2] for row in rows]))


@functools.cache
def films(engine):
    """Return the recording of each world, of 4 s: positions, velocities and force on the base."""
    physics, names = preset(fidelity="reference" if engine == "mujoco" else "standard"), [*WORLDS]
    rows = [WORLDS[name] for name in names]
    box = scene.load("box").solid
    scenes = [
        scene.compile_solid("prism", solid.standing(box), physics, Friction(row[2], 0.02))
        for row in rows
    ]
    surroundings = surroundings_of([(*row[:2], row[3]) for row in rows])
    stage, fields = staged(engine, scenes, physics, surroundings=surroundings)
    qpos = np.array(
        [scene.initial_qpos(x, 0.0 if row[4] else 1.0) for x, row in zip(scenes, rows, strict=True)]
    )
    twists = np.array([[row[4], 0.0, 0.0] for row in rows])
    qvel = np.zeros((len(rows), 9))
    qvel[:, 3] = [row[5] for row in rows]
    recording = simulate(engine, stage, fields, qpos, twists, physics, 200, qvel=qvel)
    return {
        name: (recording.qpos[:, i], recording.qvel[:, i], recording.force[:, i])
        for i, name in enumerate(names)
    }


def between(values, start, end):
    """Return the mean of values (T, ...) from `start` to `end` [s]."""
    return values[round(start / PERIOD) : round(end / PERIOD)].mean(axis=0)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", ["down x", "down y", "down -y", "oblique"])
def test_steep_floors_accelerate_objects_by_gravity_less_friction(engine, name):
    steep, bearing, friction, *_ = WORLDS[name]
    _, qvel, _ = films(engine)[name]
    change = (qvel[100] - qvel[25])[3:5] / (75 * PERIOD)
    along = np.array([math.cos(math.radians(bearing)), math.sin(math.radians(bearing))])
    a = G * (math.sin(steep) - friction * math.cos(steep))
    assert change @ along == pytest.approx(a, rel=0.01)
    assert change @ [-along[1], along[0]] == pytest.approx(0, abs=0.005)


@pytest.mark.parametrize("engine", ENGINES)
def test_friction_above_the_slope_leaves_only_the_creep_of_soft_contacts(engine):
    qpos, qvel, _ = films(engine)["rough"]
    physics = preset()
    # Friction of a sticking contact is a damper: MuJoCo's stiffness of a row times b. Each of the
    # four feet has the stiffness d / (1 - d) m; friction has impratio times that.
    d, (time, _) = physics.ground_impedance, physics.ground_solref
    damping = 4 * physics.impratio * d / (1 - d) * 2 / (d * time)  # [1/s] over the mass
    creep = between(qvel[:, 4], 2, 4)  # float32 alternates between steps
    assert creep == pytest.approx(G * math.sin(STEEP) / damping, rel=0.02)
    assert 0 < qpos[-1, 4] < 0.012


@pytest.mark.parametrize("engine", ENGINES)
def test_pushes_need_the_force_of_slope_and_friction(engine):
    weight, cases = MASS * G, []
    for name, sign in (("uphill", 1), ("downhill", -1)):
        steep, _, friction, *_ = WORLDS[name]
        force = weight * (friction * math.cos(steep) + sign * math.sin(steep))
        cases.append((name, 1.0, 3.0, force))
    for name in ("to carpet", "to tile"):
        _, _, friction, (*_, factor), *_ = WORLDS[name]
        cases += [(name, 0.3, 0.6, friction * weight), (name, 3.2, 4.0, friction * factor * weight)]
    for name, start, end, force in cases:
        f_x, f_y, _ = between(films(engine)[name][2], start, end)
        assert -f_x == pytest.approx(force, rel=0.05), (name, start)
        assert f_y == pytest.approx(0, abs=0.1), (name, start)


@pytest.mark.parametrize("engine", ENGINES)
def test_half_of_the_feet_on_the_rough_side_turn_a_sliding_box_to_it(engine):
    left, right = (films(engine)[f"carpet {side}"][0][-1, 3:] for side in ("left", "right"))
    yaw, mirrored = 2 * math.asin(left[-1]), 2 * math.asin(right[-1])
    # A rigid box on four equally loaded feet, integrated in steps of 0.1 ms, turns by 85.4 mrad.
    assert yaw == pytest.approx(0.0854, abs=0.005 if engine == "mujoco" else 0.045)
    assert mirrored == pytest.approx(-yaw, rel=0.02)
    assert_allclose(right[:2], left[:2] * [1, -1], atol=2e-4)


@functools.cache
def driven_speeds(engine):
    """Return final speeds [m/s] of bases that push the box uphill, by their force limit."""
    weight = 20 * G * (0.3 * math.cos(STEEP) + math.sin(STEEP))
    need = weight + Robot().mass * G * math.sin(STEEP)  # the base itself does not roll down
    limits = np.array([0.95, 1.05]) * need
    robot = Robot(force_max=1.0, torque_max=500.0)
    bases = dataclasses.replace(scene.repeat_robot(robot, 2), force_max=limits)
    physics = preset()
    loaded = scene.load("box", physics, Friction(0.3, 0.02), robot=robot)
    surroundings = surroundings_of([(STEEP, 180, FAR)] * 2)._replace(boundary=None)
    stage, fields = staged(engine, [loaded] * 2, physics, bases, surroundings)
    qpos = np.repeat(scene.initial_qpos(loaded, 0.0)[None], 2, axis=0)
    film = simulate(engine, stage, fields, qpos, (0.1, 0.0, 0.0), physics, 150, bases)
    return film.qvel[-1, :, 0], -film.force[100:, 1, 0].mean() / weight


@pytest.mark.parametrize("engine", ENGINES)
def test_gravity_pulls_a_base_of_limited_force_too(engine):
    (weak, strong), force = driven_speeds(engine)
    assert abs(weak) < 0.005  # it creeps: friction below its limit is a damper
    assert strong == pytest.approx(0.1, rel=0.01)
    assert force == pytest.approx(1, rel=0.03)


# --- drawn floors ---

FLOORS = "slope=0.02:0.1,boundary=0.2:0.3,boundary_factor=0.3:3"


def drawn(name, changes=FLOORS, count=6):
    """Return the domain of an object with changes, and worlds of it."""
    height = "height=0.3:0.4," * (name in domains.RANDOM)
    gap = "gap=0," * ("gap=" not in changes)
    domain = domains.parse_domain(f"wide,objects={name},{gap}{height}{changes}")
    return domain, draws.draw(domain, 3, np.arange(count))


@pytest.mark.parametrize("name", [*domains.RANDOM, "box", "hardware_cylinder"])
def test_drawn_floors_change_nothing_else(name):
    first = "size=0.1:0.3" if name in domains.RANDOM else "friction_ground=0.2:0.3"
    (_, plain), (_, worlds) = drawn(name, first), drawn(name, f"{first},{FLOORS}")
    assert plain.surroundings == Surroundings()
    same(*(x._replace(solid=None, values=None, surroundings=None) for x in (plain, worlds)))
    same(*(x.solid._replace(vertices=None, feet=None) for x in (plain, worlds)))
    values = worlds.values
    added = {"slope", "slope_bearing", "boundary", "boundary_factor"}
    assert set(values) - set(plain.values) == added
    assert added <= set(draws.table(worlds))
    gravity, boundary = worlds.surroundings.slope, worlds.surroundings.boundary
    assert_allclose(np.linalg.norm(gravity, axis=1), G)
    assert_allclose(np.arccos(-gravity[:, 2] / G), values["slope"], rtol=1e-6)
    bearing = np.arctan2(gravity[:, 1], gravity[:, 0])
    assert_allclose(bearing, values["slope_bearing"])
    way = np.linalg.norm(worlds.p_world_target, axis=1)
    assert_allclose(boundary[:, :2] * way[:, None], worlds.p_world_target)
    assert_allclose(boundary[:, 2], values["boundary"] * way)
    assert_array_equal(boundary[:, 3], values["boundary_factor"])
    feet, shape = worlds.solid.feet, worlds.solid
    assert feet.shape == (6, SIDES, 3)
    for i in range(6):  # all feet are on the outline
        outline = Footprint(shape.vertices[i], shape.radius[i])
        distance = footprint.signed_distance(outline, feet[i, feet[i, :, 2] > 0, :2])
        assert_allclose(distance, 0, atol=1e-6)


@pytest.mark.parametrize("name", ["random_prism", slow("random_cylinder")])
def test_objects_slide_on_drawn_floors_as_in_c_mujoco(name):
    domain, worlds = drawn(name, "gap=1,friction_ground=0.02:0.05,slope=0.1,boundary_factor=0.2:3")
    qpos, twist, ends = starts(worlds), (-0.5, 0.0, 0.0), []
    qpos[:, 5] -= 0.0005
    at = qpos[:, 3:5] + [[0.02, 0.01]]  # the line passes under the object
    boundary = worlds.surroundings.boundary
    boundary[:, 2] = np.sum(boundary[:, :2] * at, axis=1)
    for engine in ("mujoco", "fused"):
        stage, fields = engines.get(engine).stage(worlds.inputs(domain, FINE))
        film = simulate(engine, stage, fields, qpos, twist, FINE, 200)
        ends.append(film.qpos[-1] - qpos)
    yaw = 2 * np.arcsin([end[:, 9] for end in ends])
    assert np.linalg.norm(ends[0][:, 3:5], axis=1).min() > 0.2
    assert np.abs(yaw).max() > 0.1
    assert_allclose(ends[1][:, 3:5], ends[0][:, 3:5], atol=0.005)
    assert_allclose(yaw[1], yaw[0], atol=0.02)


def test_ranges_of_floors_that_are_left_out_have_defaults():
    domain = domains.parse_domain("wide,slope=0.05,boundary_factor=2")
    assert domain.range_of("slope_bearing") == (-math.pi, math.pi, False)
    assert domain.range_of("boundary") == (0, 1, False)
    names, plain = (points.names(domains.parse_domain(x)) for x in ("wide,slope=0.05", "wide"))
    assert set(names) - set(plain) == {"slope_bearing"}
    assert domains.from_json(domains.to_json(domain)) == domain


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ("slope=0.2", "at most 0.105"),
        ("slope=-0.1:0.1", "at least 0"),
        ("slope=nan", "must be a number"),
        ("slope_bearing=0", "give slope too"),
        ("boundary=0.5", "give boundary_factor too"),
        ("boundary=1.5,boundary_factor=2", "at most 1"),
        ("boundary_factor=0", "at least 0.05"),
        ("slope=steep", "write low and high"),
    ],
)
def test_floors_without_sense_are_refused(changes, message):
    with refusing(message):
        domains.parse_domain(f"wide,{changes}")


@pytest.mark.parametrize(
    ("changes", "name"), [("slope=0.1", "slope"), ("boundary_factor=2", "boundary")]
)
def test_quasistatic_refuses_floors_before_it_compiles(changes, name):
    setting = rps_jax.Setting("quasistatic")
    message = f"engine = quasistatic is not allowed: it has no {name}; choose mjx"
    with refusing(message):
        rps_jax.sweep("rps", f"wide,{changes}", worlds=4, setting=setting)


def test_floors_have_derivatives_except_by_the_position_of_the_boundary():
    domain, worlds = drawn("random_box", FLOORS, 3)
    names = ("slope", "slope_bearing", "boundary_factor")
    coordinates = derivatives.coordinates_of(names, rps_jax.RPSParams.tuned(), domain)
    assert [(x.label, x.unit) for x in coordinates] == [
        *zip(names, ("rad", "rad", "1"), strict=True)
    ]
    setting = rps_jax.Setting("fused", seed=3)
    slopes, bends = derivatives.world_slopes(domain, worlds, setting, coordinates)
    gravity, turned, factor = slopes
    assert set(gravity) == set(turned) == {"world.fields.gravity"}
    steep = worlds.values["slope"]
    assert_allclose(gravity["world.fields.gravity"][:, 2], G * np.sin(steep), rtol=1e-6)
    assert_allclose(factor["world.fields.boundary"], [[0, 0, 0, 1]] * 3, atol=1e-8)
    assert bends.max() < 1e-3
    with refusing("boundary is not allowed: it has no derivative"):
        derivatives.coordinates_of(("boundary",), rps_jax.RPSParams.tuned(), domain)
