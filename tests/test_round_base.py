"""Round bases: outline, skin, contact and parity of the engines."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    box,
    jitted,
    observation,
    refusals,
    sense,
    slow,
)
from numpy.testing import assert_allclose
from staging import FINE, simulate, staged

from rps_jax.control.laws import rps
from rps_jax.engines.fused.contacts import circle_and_base, polygon_and_base
from rps_jax.geometry import footprint as fp
from rps_jax.geometry.footprint import Footprint
from rps_jax.robot.robot import ROBOTS, Robot, parse_robot
from rps_jax.robot.shell import Boards
from rps_jax.robot.skin import NONE, POINT, SKINS, Skin
from rps_jax.trials.setting import Setting
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.world import draws, scene
from rps_jax.world.domain import parse_domain
from rps_jax.world.scene import FRICTION

polygon_contact, circle_contact = jitted(polygon_and_base), jitted(circle_and_base)
ROUND = Robot(radius=0.3)
ARC = 0.3 * 1.5 * math.pi  # [m] of its skin


def turned(shape: Footprint, angle: float) -> Footprint:
    """Return a shape in the robot frame, turned about the middle of the base."""
    return fp.place(shape, jnp.zeros(2), angle)


def read(sensor: Skin, shape: Footprint, robot: Robot = ROUND) -> Any:
    """Return the reading of a skin of an object that has been there for a long time."""
    return sense(sensor._replace(shell=robot.shell), shape)[1]


def meet(shape: Footprint, radius: float = 0.3) -> tuple[np.ndarray, np.ndarray, float]:
    """Return normal, point and distance [m] of a shape and a round base."""
    x, y = shape.vertices.T
    if len(x) == 1:
        normal, point, gap = circle_contact((x[0], y[0]), shape.radius, (radius,))
        return np.array(normal), np.array(point), float(gap)
    ahead = jnp.roll(x, -1), jnp.roll(y, -1)
    normal, (point,), (gap,) = polygon_contact((x, y), ahead, (radius,))
    return np.array(normal), np.array(point), float(gap)


def test_outline_and_sizes():
    shell = ROUND.shell
    assert shell.sizes == (0.3,)
    assert shell.half == (0.3, 0.3)
    assert float(fp.signed_distance(shell.outline, jnp.array([0.3, 0.4]))) == pytest.approx(0.2)
    driven = Robot(radius=0.3, mass=100.0, force_max=400.0)
    assert driven.inertia == pytest.approx(4.5)  # of a disc, m r^2 / 2
    assert driven.turn_max == pytest.approx(120.0)  # wheels at the rim
    assert parse_robot("round").sizes[0] == parse_robot("ideal").half_width


def test_taxels_are_evenly_spaced_along_the_front_270_degrees():
    taxels = np.asarray(ROUND.shell.taxels()[:, 0])
    bearing = np.arctan2(taxels[:, 1], taxels[:, 0])
    assert len(taxels) == 42
    assert_allclose(np.hypot(*taxels.T), 0.3, rtol=1e-6)
    assert_allclose(np.diff(bearing), -1.5 * np.pi / 42, rtol=1e-4)
    assert_allclose(bearing, -bearing[::-1], atol=1e-6)
    assert ROUND.shell.rows()[-1].offset + ROUND.shell.rows()[-1].length == pytest.approx(ARC)


@pytest.mark.parametrize(
    ("shape", "normal", "point", "gap"),
    [
        # A face, a corner, and a circle 2 cm away; a face pressed in by 1 cm.
        (box(0.52, 0.1), (1, 0), (0.31, 0), 0.02),
        (box(0.44, 0.52), (0.6, 0.8), (0.21, 0.28), 0.1),
        (Footprint(jnp.array([[0.0, -0.52]]), jnp.asarray(0.2)), (0, -1), (0, -0.31), 0.02),
        (box(-0.49, 0.0), (-1, 0), (-0.295, 0), -0.01),
        (box(0.1, 0.0), (1, 0), (0.1, 0), -0.4),  # around the middle of the base
    ],
)
def test_contact(shape, normal, point, gap):
    result = meet(shape)
    for value, expected in zip(result, (normal, point, gap), strict=True):
        assert_allclose(value, expected, atol=1e-6)


@pytest.mark.parametrize(
    "shape", [box(0.52, 0.1, yaw=0.3), fp.place(fp.circle(0.2), jnp.array([0.51, 0]), 0.0)]
)
def test_turning_the_base_changes_nothing_in_contact(shape):
    normal, point, gap = meet(shape)
    for angle in (0.5, 2.0, -3.0):
        c, s = math.cos(angle), math.sin(angle)
        turn = np.array([[c, -s], [s, c]])
        expected = turn @ normal, turn @ point, gap
        for value, other in zip(meet(turned(shape, angle)), expected, strict=True):
            assert_allclose(value, other, atol=1e-6)


def test_a_large_round_base_is_flat():
    shape, half = box(0.52, 0.05, yaw=0.01), 0.3
    x, y = shape.vertices.T
    flat, points, gaps = polygon_contact((x, y), (jnp.roll(x, -1), jnp.roll(y, -1)), (half, half))
    nearest = int(np.argmin(gaps))
    moved = fp.place(shape, jnp.array([1000.0 - half, 0.0]), 0.0)
    normal, point, gap = meet(moved, 1000.0)
    assert_allclose(normal, flat, atol=1e-3)
    assert gap == pytest.approx(float(gaps[nearest]), abs=2e-4)
    assert point[1] == pytest.approx(float(points[nearest][1]), abs=1e-3)


@pytest.mark.parametrize("name", ["ideal", "capacitive"])
@pytest.mark.parametrize("bearing", [0.0, 0.6, -1.2, 2.2])
def test_skin_senses_the_arc_length(name, bearing):
    ahead = box(0.503, 0.0)
    reading = read(SKINS[name], turned(ahead, bearing))
    assert reading.contact_type != NONE
    obs = observation([0, 0], 0.0, reading.p_robot_contact, True, [2, 0])
    tolerance = 1e-5 if name == "ideal" else 0.02  # 0.6 of a taxel
    l = obs._replace(base_radius=0.3).l  # noqa: E741
    assert float(l) == pytest.approx(0.3 * bearing, abs=tolerance)  # positive to the left
    mirrored = read(SKINS[name], turned(ahead, -bearing)).p_robot_contact
    assert_allclose(mirrored, reading.p_robot_contact * jnp.array([1, -1]), atol=1e-5)


def test_skin_ends_with_its_boards():
    ideal = SKINS["ideal"]
    assert read(ideal, turned(box(0.503, 0.0), 3.0)).contact_type == NONE
    assert read(ideal, turned(box(0.507, 0.0), 0.0)).contact_type == NONE  # 7 mm away
    front = Robot(radius=0.3, boards=(Boards("front", 2, 0.05),))  # |l| < 0.15 m
    assert read(ideal, turned(box(0.503, 0.0), 0.4), front).contact_type == POINT
    assert read(ideal, turned(box(0.503, 0.0), 0.9), front).contact_type == NONE


def test_drawn_worlds_have_round_bases():
    domain = parse_domain("wide,objects=random_box", "round")
    batch = drawn_worlds(domain, draws.draw(domain, 3, np.arange(4)), Setting("fused"))
    leaves = jax.tree.leaves((batch.worlds.skin, batch.worlds.robot))
    assert {np.shape(leaf)[0] for leaf in leaves} == {4}
    assert np.all(batch.worlds.skin.shell.radius == ROBOTS["round"].radius)


def test_rps_gets_the_arc_length():
    params, point = rps.RPSParams.paper(), (0.3 * math.cos(1.0), 0.3 * math.sin(1.0))
    obs = observation([0, 0], 0.0, point, True, [2, 0])._replace(base_radius=0.3)
    details = rps.step_with_details(params, rps.RPSState.init(params), obs)[2]
    assert float(details.l) == pytest.approx(0.3, rel=1e-6)
    assert bool(details.realigning)  # beyond l_cr


@pytest.mark.parametrize("engine", ["fused", "quasistatic", slow("mjx")])
@pytest.mark.parametrize("name", [slow("box"), "cylinder"])
def test_engines_agree(name, engine):
    """Compare pushes in which an object slides and turns on the arc."""
    loaded = scene.load(name, FINE, FRICTION["S1"], robot=ROUND)
    start = scene.initial_qpos(loaded, gap=0.001)[None]
    start[0, 4] += 0.05
    ends = {}
    for stepped in (engine, "mujoco"):
        stage, fields = staged(stepped, [loaded], FINE, ROUND)
        moved = simulate(stepped, stage, fields, start, (0.05, 0.02, 0.05), FINE, 200)
        ends[stepped] = moved.qpos[-1, 0]
    assert ends["mujoco"][4] - start[0, 4] > 0.02
    tolerance = 0.0125 if engine == "quasistatic" else 2e-4
    assert_allclose(ends[engine][3:5], ends["mujoco"][3:5], atol=tolerance)


def test_a_low_object_touches_below_its_top():
    loaded = scene.load("box", robot=ROUND)
    spheres = [loaded.physics.geom(f"base_{name}") for name in ("low", "high")]
    assert [geom.pos[2] for geom in spheres] == pytest.approx([0.06, 0.34])
    low = loaded.solid._replace(height=np.asarray(0.2))
    flat = scene.compile_solid("box", low, robot=ROUND).physics
    assert flat.geom("base_high").pos[2] == pytest.approx(0.196)


_LONG = {"side": "front", "count": 4, "pitch": 0.048}
test_refuses = refusals(
    parse_robot,
    (
        ("round,half_width=0.2",),
        "robot radius = 0.29 m with half_length, half_width = 0.3625, 0.2 m is not",
    ),
    (("ridgeback,radius=0.3",), "leave out radius, or the half sizes"),
    (({"radius": 0.05},), "robot radius = 0.05 m? ?is not allowed: .* at least 0.1"),
    (({"radius": [0.3, 0.4]},), "robot radius"),
    (({"radius": 0.2, "boards": _LONG},), "they leave the base"),
)
