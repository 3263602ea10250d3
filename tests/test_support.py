"""The pressure under objects: pads with its moments, in every engine."""

import re
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import diagonal, jitted, refusing, slow
from numpy.testing import assert_allclose, assert_array_equal
from staging import FINE, simulate, step_in_c

from rps_jax import engines
from rps_jax.control import registry
from rps_jax.engines import finger, quasistatic
from rps_jax.geometry import solid
from rps_jax.geometry.friction import friction_of_pads, solved
from rps_jax.runs.model_panel import model_plans
from rps_jax.runs.plan import Plan
from rps_jax.trials import pushes, worlds
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.world import draws, objects, scene
from rps_jax.world.domain import parse_domain
from rps_jax.world.physics import Physics
from rps_jax.world.scene import Friction, WorldInputs

KINDS = ("even", "rim")
HALF = 0.2  # [m] of the box
TRIANGLE = np.array([[0.24, -0.12], [0.0, 0.24], [-0.24, -0.12]])
OUTLINES = {
    "box": (solid.rectangles(np.array([HALF]), np.array([HALF]))[0], 0.0),
    "oblong": (solid.rectangles(np.array([0.14]), np.array([0.28]))[0], 0.0),
    "triangle": (TRIANGLE, 0.0),
    "cylinder": (np.zeros((1, 2)), HALF),
}


def solid_of(name, com_offset=0.0):
    """Return one solid (leaves (1, ...)) of an outline."""
    vertices, radius = OUTLINES[name]
    numbers = (radius, 0.2, 10.0, com_offset, 0.3, 0.2)
    return solid.build(vertices[None], *(np.array([x]) for x in numbers))


def distribution(name, kind, count=120):
    """Return points (P, 2) [m] and shares (P,) of even pressure or of a rim, by brute force."""
    vertices, radius = OUTLINES[name]
    if kind == "even":
        grid = 0.3 * (2 * (np.arange(count) + 0.5) / count - 1)
        at = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
        if radius:
            at = at[np.linalg.norm(at, axis=1) < radius]
        else:
            ahead = np.roll(vertices, -1, axis=0) - vertices
            side = ahead[:, 0] * (at[:, None] - vertices)[..., 1]
            at = at[((side - ahead[:, 1] * (at[:, None] - vertices)[..., 0]) > 0).all(axis=1)]
        return at, np.full(len(at), 1 / len(at))
    if radius:
        at = radius * solid.unit(2 * np.pi * np.arange(4 * count) / (4 * count))
        return at, np.full(len(at), 1 / len(at))
    share = (np.arange(count) + 0.5)[:, None, None] / count
    ahead = np.roll(vertices, -1, axis=0) - vertices
    length = np.linalg.norm(ahead, axis=1)
    loads = np.tile(length / length.sum() / count, count)
    return (vertices + share * ahead).reshape(-1, 2), loads


def force(at, share, radius, twist):
    """Return the wrenches (n, 3) of friction of pads at twists (n, 3)."""
    x, y = at.T
    v_x, v_y, spin = twist.T[..., None]
    u = np.stack([v_x - spin * y, v_y + spin * x, spin * (radius + 0 * x)])
    speed = np.sqrt((u**2).sum(axis=0) + 1e-14)
    f = share * u / speed
    moment = (x * f[1] - y * f[0] + radius * f[2]).sum(axis=1)
    return np.stack([*f[:2].sum(axis=2), moment], axis=1)


@jitted
def twists_under(at, share, radius, wrench, arm):
    """Return the twists (n, 3) of pads under wrenches, by the quasi-static engine's own cost."""
    pads: Any = tuple(x[:, None] for x in (*at.T, share, jnp.maximum(radius, 1e-4)))

    def refined(i: Any, v: Any) -> Any:
        g, h = friction_of_pads(pads, v, 1e-5)
        step = solved(tuple(a - b for a, b in zip(g, wrench.T, strict=True)), h)
        return tuple(a - jnp.where(i < 60, 0.5, 1.0) * b for a, b in zip(v, step, strict=True))

    start = tuple((wrench / jnp.array([1, 1, arm * arm])).T)
    return jnp.stack(jax.lax.fori_loop(0, 80, refined, start), axis=1)


ERRORS = {  # largest and root mean square of the error of a twist, over its length
    "box": {"even": (0.0231, 0.0091), "rim": (0.0307, 0.0087)},
    "oblong": {"even": (0.0327, 0.0118), "rim": (0.0328, 0.0092)},
    "triangle": {"even": (0.0294, 0.0104), "rim": (0.0284, 0.0087)},
    "cylinder": {"even": (0.0207, 0.0084), "rim": (0.0266, 0.0078)},
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", OUTLINES)
def test_pads_turn_as_the_integral_over_the_distribution(name, kind):
    """The twist under the same force, over the whole limit surface."""
    at, share = distribution(name, kind)
    arm = share @ np.linalg.norm(at, axis=1)
    twist = np.random.default_rng(0).normal(size=(400, 3)) / [1, 1, arm]
    wrench = force(at, share, 0.0, twist)
    row: Any = solid.on_support(solid_of(name), np.array([solid.SUPPORTS[kind]]))
    feet, radius = row.feet[0], row.pads[0, :, 1]
    assert feet[:, 2].sum() == pytest.approx(4)
    found = twists_under(feet[:, :2], feet[:, 2] / 4, radius, wrench, arm)
    expected, turned = (
        x / np.linalg.norm(x, axis=1)[:, None] for x in (twist * [1, 1, arm], found * [1, 1, arm])
    )
    off = np.linalg.norm(turned - expected, axis=1)
    sizes = off.max(), np.sqrt(np.mean(off**2))
    assert sizes == pytest.approx(ERRORS[name][kind], abs=3e-4)


def test_the_corners_of_a_prism_are_points():
    row: Any = solid.on_support(solid_of("triangle"), np.array([2.0]))
    used = row.feet[0, :, 2] > 0
    assert_allclose(np.sort(row.feet[0, used, :2], axis=0), np.sort(TRIANGLE, axis=0), atol=1e-12)
    assert_allclose(row.feet[0, used, 2], 4 / 3)
    assert_allclose(row.pads[0, used, 1], 0.0, atol=1e-6)


def inputs_of(name, kind, ground=0.05, robot=0.01):
    """Return the inputs of one world, and its start, with the base at the turned object."""
    row = solid_of(name)
    family = {"cylinder": "cylinder", "triangle": "prism"}.get(name, "box")
    friction = Friction(np.array([ground]), np.array([robot]))
    inputs = WorldInputs(family, row, friction, replace(FINE, support=kind)).supported
    front, yaw = scene.base_size(inputs.robots, 1)[0, 0], np.array([0.3])
    qpos = np.zeros(10)
    qpos[3:6] = front + 0.0005 + solid.extent(inputs.solids, yaw)[0], 0.1, 0.1 - 0.0005
    qpos[6:] = solid.quaternion(yaw[0])
    return inputs, qpos


def turn_in(engine, inputs, qpos, steps=375):
    """Return the angle [rad] by which an object turns before a base at 2 cm/s."""
    twist = (0.02, 0.0, 0.0)
    if engine == "mujoco":
        end = step_in_c(scene.compile_row(inputs, 0).physics, qpos, twist, steps).qpos
    else:
        stage, fields = engines.get(engine).stage(inputs)
        physics = replace(inputs.physics, support="corners")
        end = simulate(engine, stage, fields, qpos[None], twist, physics, steps).qpos[-1][0]
    return float(2 * np.arctan2(end[9], end[6]) - 2 * np.arctan2(qpos[9], qpos[6]))


@pytest.fixture(scope="module")
def integrals():
    """The turns of a box on many points, in the quasi-static engine."""
    turns = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quasistatic, "_LEAST_RADIUS", 1e-3)
        for kind in KINDS:
            at, share = distribution("box", kind, {"even": 18, "rim": 36}[kind])  # 144 points
            inputs, qpos = inputs_of("box", "corners")
            box = inputs.solids
            feet = np.column_stack([at, share])[None]
            pads = np.tile([1.0, 0.0], (1, len(at), 1))
            box = box._replace(vertices=solid.padded(box.vertices), feet=feet, pads=pads)
            turns[kind] = turn_in("quasistatic", inputs._replace(solids=box), qpos)
    return turns


@pytest.mark.parametrize(
    ("engine", "kind"),
    [
        *diagonal(("fused", "mujoco"), KINDS),
        *(slow(x, kind) for x in ("mjx", "quasistatic") for kind in KINDS),
    ],
)
def test_a_box_turns_by_its_pressure_in_every_engine(engine, kind, integrals):
    """A smooth base turns it until it lies on the front; on corners it turns less."""
    turned = turn_in(engine, *inputs_of("box", kind))
    assert turned == pytest.approx(integrals[kind], rel=0.03)
    assert 1 - turn_in(engine, *inputs_of("box", "corners")) / turned > 0.05


@pytest.fixture
def turn_on(tmp_path, registries):
    """The turn of a registered box on feet (S, 2) to (S, 5), in an engine."""
    path = tmp_path / "cart.xml"
    box = (objects.mjcf_folder() / "box.xml").read_text().replace("0.20 0.20 0.40", "0.2 0.2 0.1")
    path.write_text(re.sub('pos="[^"]*"', "", box))

    def turn(engine, feet):
        objects.register_object("cart", path, feet=feet)
        row = solid.stack([objects.REGISTERED["cart"].solid])
        inputs, qpos = inputs_of("box", "corners")
        return turn_in(engine, inputs._replace(family="prism", solids=row), qpos)

    return turn


@pytest.mark.parametrize("engine", ["fused", "mujoco", "quasistatic"])
def test_an_object_is_registered_on_the_pads_of_a_fit(engine, turn_on, integrals):
    """Pads of even pressure turn it as the integral over the pressure."""
    pads = finger.uniform_pads(OUTLINES["box"][0], 12)
    feet = np.insert(pads, 3, 1.0, axis=1)
    assert len(feet) > solid.SIDES
    assert turn_on(engine, feet) == pytest.approx(integrals["even"], rel=0.03)
    with refusing("radii at least 0"):
        turn_on(engine, feet * [1, 1, 1, 1, -1])


@pytest.mark.parametrize("engine", ["fused", "mujoco", slow("quasistatic"), slow("mjx")])
def test_weights_and_friction_of_feet_turn_a_cart(engine, turn_on):
    """Castors in front leave the friction to the rear feet."""
    at = solid.rectangles(np.array([0.18]), np.array([0.18]))[0]
    plain, cart, heavy = (
        turn_on(engine, np.column_stack([at, [1, 1, 1, weight], [castor, 1, 1, castor]]))
        for castor, weight in ((1.0, 1.0), (0.02, 1.0), (1.0, 3.0))
    )
    assert (cart - plain) / plain > 0.1
    assert abs(heavy - plain) > 0.002


def test_engines_agree_on_weighted_feet_and_tilt():
    """C MuJoCo and fused, on pads of unequal weight, with a base that rubs."""
    inputs: Any
    inputs, qpos = inputs_of("oblong", "even", 0.4, 0.6)
    weight = (
        inputs.solids.feet * np.array([1, 1, 0])
        + np.array([0, 0, 1]) * np.linspace(0.1, 0.5, 16)[:, None]
    )
    pads = np.stack([np.linspace(0.5, 1.5, 16), inputs.solids.pads[0, :, 1]], axis=1)[None]
    inputs = inputs._replace(solids=inputs.solids._replace(feet=weight, pads=pads))
    fused, in_c = (turn_in(engine, inputs, qpos) for engine in ("fused", "mujoco"))
    assert fused == pytest.approx(in_c, abs=3e-3)


def test_a_physics_or_a_domain_sets_the_support():
    even = Setting(physics="default,support=even")
    assert even.physics.support == "even"
    assert Setting.from_json(even.to_json()) == even
    assert "support" not in Setting().to_json()["physics"]
    bodies = pushes.build([Case("box"), Case("box")], even).worlds.fields
    assert bodies.feet.shape == (2, 16, 3)
    for text, kind in (("even", 0.0), ("rim", 1.0), ("0:2", None)):
        domain = parse_domain(f"wide,objects=random_box,support={text}")
        drawn: Any = draws.draw(domain, 0, np.arange(8))
        values = drawn.values["support"]
        assert (values == kind).all() if kind is not None else np.ptp(values) > 0.5
        assert_allclose(drawn.solid.feet[..., 2].sum(axis=1), 4)
    plain = draws.draw(parse_domain("wide,objects=random_box"), 0, np.arange(8))
    assert plain.solid.feet is None
    assert_array_equal(plain.solid.mass, drawn.solid.mass)
    named: Any = draws.draw(parse_domain("hardware,support=even"), 0, np.arange(0, 8, 2))
    assert named.solid.feet.shape[1] == 16


def test_supports_without_sense_are_refused():
    with refusing("friction pyramid"):
        Physics(support="even", cone="pyramidal")
    with refusing("support"):
        parse_domain("wide,support=feet")
    with refusing("leave it out, or feet"):
        parse_domain("wide,support=even,feet=0.5:0.9")
    domain = parse_domain("wide,objects=random_box,support=even")
    drawn = draws.draw(domain, 0, np.arange(2))
    plan = Plan(domain, 2, {"rps": registry.LAWS["rps"]}, Setting(), 2)
    assert not [x for x in model_plans(plan).values() if x.setting.physics.cone == "pyramidal"]
    with refusing("cone"):
        worlds.drawn_worlds(domain, drawn, Setting(physics="paper_gazebo"))
