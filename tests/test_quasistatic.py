"""The quasi-static model against analytical motions and finite differences.

The motions are those of a point that pushes a slider with an ellipsoidal limit surface (Lynch,
Maekawa and Tanie 1992): what sticks moves with the base, what slides pushes along an edge of the
friction cone. Unless said otherwise, in double precision.
"""

import functools
import math
from functools import partial
from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose
from scipy.optimize import nnls
from staging import drive, staged

from rps_jax.control import registry
from rps_jax.engines import quasistatic
from rps_jax.engines.base import Motion
from rps_jax.engines.quasistatic import Contact, Problem, Quasistatic, Slider, solved
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import solid
from rps_jax.geometry.footprint import Footprint
from rps_jax.geometry.solid import Solid
from rps_jax.robot.robot import Robot
from rps_jax.trials import pushes
from rps_jax.trials.pushes import Case
from rps_jax.trials.setting import Setting
from rps_jax.world import objects, paper, scene
from rps_jax.world.physics import Physics, preset
from rps_jax.world.scene import FRICTION, OBJECTS

FRONT, SIDE = 0.3625, 0.29  # [m] half length and width of the base
HALF, RADIUS = 0.20, 0.25  # [m] half a side of the box; of the cylinder
ARM = {"box": HALF * math.sqrt(2), "cylinder": RADIUS}  # [m] c of the paper's objects
STEPS, PERIOD = 100, 0.02  # control steps of every film, and their length [s]


def box(half, radius=0.0):
    """A square with a corner given twice, as objects of few corners have it beside others."""
    plain = fp.rectangle(half, half)
    twice = jnp.concatenate([plain.vertices, plain.vertices[-1:]])
    return Footprint(twice, jnp.asarray(radius))


class Push(NamedTuple):
    """An object before the base, which moves at a constant twist."""

    twist: tuple[float, float, float] = (0.05, 0.0, 0.0)  # [m/s, m/s, rad/s]
    pose: tuple[float, float, float] = (FRONT + HALF, 0.0, 0.0)  # [m, m, rad] of the object
    base: tuple[float, float, float] = (0.0, 0.0, 0.0)  # [m, m, rad]
    arm: float = ARM["box"]  # [m]
    friction: float = 0.5  # [1] with the base
    com: tuple[float, float] = (0.0, 0.0)  # [m] in the object's frame
    outline: Footprint = box(HALF)
    scale: float = 1.0  # of time: so many times faster, and so much shorter


class Film(NamedTuple):
    """Poses (T, 3) [m, m, rad] of the base and of the object."""

    base: np.ndarray
    object_pose: np.ndarray

    @property
    def moved(self):
        return self.object_pose[-1] - self.object_pose[0]

    def velocity(self):
        """Velocity (3,) of the object in the last step."""
        return (self.object_pose[-1] - self.object_pose[-2]) / PERIOD


@partial(jax.jit, static_argnames="physics")
def positions(fields, qpos, twists, physics):
    """Positions (T + 1, B, 10) of worlds that start at (B, 10), driven by twists (T, B, 3)."""
    still = jnp.zeros_like(qpos[:, :9])
    return drive(Quasistatic(), fields, Motion(qpos, still, still), twists, physics).qpos


def film(pushes):
    """Return films of pushes of outlines with equal numbers of corners."""
    with jax.enable_x64(True):
        rows = lambda name: np.array([getattr(p, name) for p in pushes], float)  # noqa: E731
        base = np.tile([FRONT, SIDE], (len(pushes), 1))
        outline = jax.tree.map(lambda *x: np.array(x, float), *[p.outline for p in pushes])
        fields = Slider(rows("com"), rows("arm"), rows("friction"), base, *outline)
        pose, half = rows("pose"), rows("pose")[:, 2] / 2
        nil = np.zeros(len(pushes))
        quaternion = np.stack([np.cos(half), nil, nil, np.sin(half)], axis=1)
        start = np.column_stack([rows("base"), pose[:, :2], nil, quaternion])
        scale = rows("scale")
        going = np.arange(STEPS)[:, None] * scale < STEPS
        twists = (going * scale)[..., None] * rows("twist")
        physics = Physics(timestep=PERIOD, control_period=PERIOD)
        fields, start = jax.tree.map(lambda x: jnp.asarray(x, float), (fields, start))
        qpos = np.asarray(positions(fields, start, jnp.asarray(twists), physics))
    yaw = np.unwrap(2 * np.arctan2(qpos[..., 9], qpos[..., 6]), axis=0)
    object_pose = np.concatenate([qpos[..., 3:5], yaw[..., None]], axis=-1)
    return [Film(qpos[:, i, :3], object_pose[:, i]) for i in range(len(pushes))]


def at_corner(yaw, **changes):
    """The box turned by `yaw` > 0, its nearest corner, (-HALF, HALF) in its frame, at the face."""
    x, y = turn(yaw, (-HALF, HALF))
    return Push(pose=(FRONT - x, 0.02 - y, yaw), **changes)


def turn(angle, point):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c * point[0] - s * point[1], s * point[0] + c * point[1]])


# --- the motions that are known -------------------------------------------------------------


def twist_of(force, r, arm):
    """Return the twist (3,) of an object pushed with a force (2,) at r (2,), up to its scale."""
    return np.array([*force, (r[0] * force[1] - r[1] * force[0]) / arm**2])


def stuck(r, v, arm):
    """Return the twist (3,) of an object whose point at r from its centre moves at v (2,)."""
    (x, y), square = r, arm**2
    v_x = ((square + x * x) * v[0] + x * y * v[1]) / (square + x * x + y * y)
    v_y = (x * y * v[0] + (square + y * y) * v[1]) / (square + x * x + y * y)
    return np.array([v_x, v_y, (x * v_y - y * v_x) / square])


def pushed(r, n, v, arm, friction):
    """Return the twist (3,) of an object pushed at r by a point of velocity v; whether it slides.

    The normal n points to the object. If sticking takes a force outside the friction cone, the
    force is along the cone's edge and the object keeps up with the pusher along n alone.
    """
    t = np.array([-n[1], n[0]])
    still = stuck(r, v, arm)
    force = still[:2]  # the force goes as the velocity of the centre
    if abs(force @ t) <= friction * (force @ n):
        return still, False
    edge = twist_of(n + friction * np.sign(force @ t) * t, r, arm)
    point = edge[:2] + edge[2] * np.array([-r[1], r[0]])
    return edge * (v @ n) / (point @ n), True


def expected(push):
    """Pose (3,) of the box at the end, its corner at the face, by small steps of `pushed`."""
    fine = 20
    pose, twist = np.array(push.pose), np.array(push.twist)
    slid = set()
    for _ in range(STEPS * fine):
        r = turn(pose[2], (-HALF, HALF))
        v, slides = pushed(r, np.array([1.0, 0.0]), twist[:2], push.arm, push.friction)
        pose = pose + v * PERIOD / fine
        slid.add(slides)
    return pose, slid


# Yaw [rad], sideways velocity [m/s], friction [1] and arm [m] of pushes at a corner.
CORNERS = {
    "sticking 0": (0.1, 0.0, 1.0, 0.28),
    "sticking 1": (0.3, 0.02, 1.0, 0.28),
    "sticking 2": (0.2, 0.0, 1.0, 0.15),
    "sliding 0": (0.3, 0.03, 0.1, 0.28),
    "sliding 1": (0.2, -0.03, 0.2, 0.28),
    "sliding 2": (0.3, 0.0, 0.05, 0.2),
}
ROLLING = Push(
    (0.04, 0.03, 0.0),
    (FRONT + RADIUS, 0.0, 0.0),
    arm=ARM["cylinder"],
    friction=0.8,
    outline=fp.circle(RADIUS),
)
SLIPPING = ROLLING._replace(friction=0.1)
_ROUND = {"outline": box(1e-4, RADIUS - 1e-4)}
CASES = {
    "centre": Push(),
    "apart": Push(pose=(FRONT + HALF + 0.2, 0.0, 0.3)),
    "mirror": at_corner(0.3, twist=(0.05, 0.02, 0.05)),
    "mirrored": Push((0.05, -0.02, -0.05), (*(np.array([1, -1, -1]) * at_corner(0.3).pose),)),
    "once": at_corner(0.2, twist=(0.02, 0.01, -0.04), com=(0.05, -0.03)),
    "twice": at_corner(0.2, twist=(0.02, 0.01, -0.04), com=(0.05, -0.03), scale=2.0),
    "rolling": ROLLING._replace(**_ROUND),
    "slipping": SLIPPING._replace(**_ROUND),
    "here": at_corner(0.2, twist=(0.05, 0.01, 0.1), com=(0.05, -0.03)),
    **{
        name: at_corner(yaw, twist=(0.04, v_y, 0.0), friction=mu, arm=arm)
        for name, (yaw, v_y, mu, arm) in CORNERS.items()
    },
}
MOVE = (2.0, -1.0, 2.5)  # [m, m, rad]
BASE_CASE = CASES["here"]
CASES["there"] = BASE_CASE._replace(
    base=MOVE, pose=(*(turn(MOVE[2], BASE_CASE.pose[:2]) + MOVE[:2]), BASE_CASE.pose[2] + MOVE[2])
)
_rng = default_rng(1)
for _i in range(24):  # flat on the face
    _s, _mu, _y = _rng.uniform([-0.03, 0.1, -0.1], [0.03, 0.8, 0.1])
    CASES[f"flat {_i}"] = Push(
        (0.03, _s, _rng.uniform(-0.08, 0.08)), (FRONT + HALF, _y, 0.0), friction=_mu
    )


@functools.cache
def boxes():
    return dict(zip(CASES, film(list(CASES.values())), strict=True))


def test_a_box_pushed_through_its_centre_moves_as_the_base_does_and_one_apart_does_not():
    assert np.abs(boxes()["apart"].moved).max() < 1e-12
    assert_allclose(boxes()["centre"].moved, [0.05 * STEPS * PERIOD, 0, 0], atol=2e-4)


def test_the_base_moves_at_its_commanded_twist():
    twist = CASES["here"].twist
    base = boxes()["here"].base
    assert base[-1, 2] == pytest.approx(twist[2] * STEPS * PERIOD)
    way = np.diff(base[:, :2], axis=0)
    back = np.array([turn(-yaw, d) for yaw, d in zip(base[:-1, 2], way, strict=True)])
    assert_allclose(back, np.tile(twist[:2], (STEPS, 1)) * PERIOD, atol=1e-12)


@pytest.mark.parametrize("name", CORNERS)
def test_a_corner_sticks_as_in_lynch_or_slides_along_the_edge_of_the_cone(name):
    pose, slid = expected(CASES[name])
    assert slid == {name.startswith("sliding")}
    recorded = boxes()[name]
    moved = pose - recorded.object_pose[0]
    assert abs(moved[2]) > 0.03
    assert_allclose(recorded.moved, moved, rtol=0.02, atol=1e-3)


def can_be_carried(push):
    """Whether forces within the cones at both ends of the flat contact can hold the box, and by
    what margin [1] of the twist's force.

    The wrench that carries it with the base is L V; nnls finds the nearest that the four edges of
    the cones make.
    """
    p = np.array(push.pose[:2])
    v_x, v_y, omega = push.twist
    expected = np.array([v_x - omega * p[1], v_y + omega * p[0], push.arm**2 * omega])
    edges = []
    for y in np.clip(p[1] + np.array([-HALF, HALF]), -SIDE, SIDE):
        r = np.array([FRONT, y]) - p
        for force in ((1.0, -push.friction), (1.0, push.friction)):
            edges.append([*force, r[0] * force[1] - r[1] * force[0]])
    return nnls(np.array(edges).T, expected)[1] / np.linalg.norm(expected)


def test_a_flat_contact_holds_if_and_only_if_forces_within_its_cones_can():
    """Lynch and Mason's stable pushes: the box then stays where it is on the base."""
    held = []
    for name in (name for name in CASES if name.startswith("flat")):
        short = can_be_carried(CASES[name])
        base, pose = boxes()[name].base, boxes()[name].object_pose
        start, end = (turn(-base[i, 2], pose[i, :2] - base[i, :2]) for i in (0, 25))
        crept = np.hypot(*(end - start)) / (25 * PERIOD)
        turned = abs((pose - base)[25, 2]) / (25 * PERIOD)
        slipped = (crept + HALF * turned) / math.hypot(*CASES[name].twist[:2])
        if not 1e-9 <= short <= 0.15:
            held.append(short < 1e-9)
            assert (slipped < 0.065) == held[-1]
    assert held.count(True) > 4
    assert held.count(False) > 4


def test_mirrored_pushes_are_mirrored():
    a, b = boxes()["mirror"], boxes()["mirrored"]
    assert_allclose(a.moved, b.moved * [1, -1, -1], atol=1e-9)


def test_twice_the_speed_is_the_same_path_in_half_the_time():
    """Only the length of a step doubles."""
    a, b = boxes()["once"], boxes()["twice"]
    assert np.hypot(*a.moved[:2]) > 0.03
    assert_allclose(a.object_pose[::2], b.object_pose[: STEPS // 2 + 1], atol=5e-4)


def test_where_it_happens_does_not_matter():
    a, b = boxes()["here"], boxes()["there"]
    moved = [*turn(MOVE[2], a.moved[:2]), a.moved[2]]
    assert_allclose(b.moved, moved, atol=1e-9)


# --- round objects --------------------------------------------------------------------------


@functools.cache
def discs():
    return film([ROLLING, SLIPPING])


def rim(recorded, push):
    """Sideways velocity of the rim at the face, relative to the base's [1], and of rolling [1]."""
    _, v_y, omega = recorded.velocity() / push.twist[1]
    return v_y - RADIUS * omega - 1, -RADIUS * omega


def test_a_cylinder_rolls_along_the_face_without_slipping():
    """The force f goes with the twist (f_n, f_t, -R f_t / c^2): with c = R, half is rolled."""
    slip, rolled = rim(discs()[0], ROLLING)
    assert abs(slip) < 0.03
    assert rolled == pytest.approx(0.5, rel=0.03)


def test_a_cylinder_slips_along_a_slippery_face():
    """Then f_t = mu f_n, and its rim moves sideways at mu (1 + R^2 / c^2) v_n."""
    slip, _ = rim(discs()[1], SLIPPING)
    assert slip == pytest.approx(2 * 0.1 * 0.04 / 0.03 - 1, rel=0.01)


def test_a_tiny_box_with_a_round_edge_is_a_cylinder():
    for name, disc in zip(("rolling", "slipping"), discs(), strict=True):
        assert_allclose(boxes()[name].moved, disc.moved, atol=1e-3)


# --- the problem that is solved -------------------------------------------------------------


def some_problems(count=500):
    """Problems of one or two contacts at the front face, near, deep or far, and any base twist."""
    rng = default_rng(0)
    speed, angle = np.exp(rng.uniform(-7, -3, count)), rng.uniform(-1.5, 1.5, count)
    v_x, v_y, omega = speed * np.cos(angle), speed * np.sin(angle), rng.uniform(-0.15, 0.15, count)
    p = np.stack([FRONT + rng.uniform(0.1, 0.3, count), rng.uniform(-0.4, 0.4, count)])
    contacts = []
    for far in (0.0, 0.02):
        y = rng.uniform(-SIDE, SIDE, count)
        tilt = rng.choice([0.0, 0.5, -0.5], count)
        gap = rng.normal(0, 1e-4, count) + rng.choice([0.0, far], count)
        r, v = (FRONT - p[0], y - p[1]), (v_x - omega * y, v_y + omega * FRONT)
        contacts.append(Contact((np.cos(tilt), np.sin(tilt)), r, v, gap))
    reach = FRONT**2 + SIDE**2
    size = np.sqrt(v_x**2 + v_y**2 + reach * omega**2)
    problem = Problem(contacts, size, rng.uniform(0.1, 0.3, count), rng.uniform(0.05, 1.0, count))
    return problem, (v_x - omega * p[1], v_y + omega * p[0], omega)


def cost(problem, v, dt):
    """Written-out cost that the twist of one object minimises."""
    c, speed, depth = problem.arm, problem.speed, quasistatic.DEPTH
    total = (v[0] ** 2 + v[1] ** 2 + c**2 * v[2] ** 2) / (2 * speed)
    for contact in problem.contacts:
        n, r = contact.normal, contact.r
        u = jnp.stack([v[0] - v[2] * r[1], v[1] + v[2] * r[0]]) - jnp.stack(contact.v)
        v_n, v_t = u[0] * n[0] + u[1] * n[1], u[1] * n[0] - u[0] * n[1]
        tiny = quasistatic.SLIP * speed
        slide = jnp.sqrt(v_t**2 + tiny**2) - tiny
        inside = -(contact.gap + dt * (v_n - problem.friction * slide))
        x = jnp.maximum(inside / depth, -1.0)
        soft = (1 + x) ** 3 / 12
        total += depth / dt * jnp.where(x < 1, soft, x * x / 2 + 1 / 6)
    return total


def test_newtons_method_has_the_correct_derivatives_and_finds_the_minimum():
    dt = 0.01
    with jax.enable_x64(True):
        problem, v = jax.tree.map(lambda x: jnp.asarray(x, float), some_problems())
        gradient, hessian = (
            jax.vmap(derivative(cost, argnums=1), (0, 0, None))
            for derivative in (jax.grad, jax.hessian)
        )

        @jax.jit
        def both(v):  # as written, and by differentiation
            written = quasistatic.derivatives(problem, v, quasistatic.SLIP, dt)
            return written, (gradient(problem, v, dt), hessian(problem, v, dt))

        (g, h), (g_true, h_true) = both(v)
        assert_allclose(g, g_true, atol=1e-9)
        upper = [h_true[i][j] for i in range(3) for j in range(i, 3)]
        assert_allclose(np.stack(h), upper, rtol=1e-6, atol=1e-6)
        product = np.einsum("ij...,j...->i...", np.array(h_true), np.stack(solved(g, h)))
        assert_allclose(product, g_true, atol=1e-6)
        solution = jax.jit(partial(quasistatic.solve, dt=dt))(problem, v)
        (step, matrix), _ = both(solution)
        short = np.abs(np.stack(solved(step, matrix)))[:2].max(axis=0) / problem.speed
    assert np.mean(short > 1e-3) < 0.03
    assert np.median(short) < 1e-9


# --- derivatives ----------------------------------------------------------------------------


def moved_both_ways(inputs, seed):
    """Trees (7, ...) of `inputs` moved along a random direction in each of its three parts."""
    rng = default_rng(seed)
    ways = [jax.tree.map(lambda x: rng.normal(size=x.shape), part) for part in inputs]
    rows = [(0.0, 0)] + [(e, part) for part in range(3) for e in (1e-6, -1e-6)]
    stacked = []
    for part, (nominal, way) in enumerate(zip(inputs, ways, strict=True)):
        steps = np.array([e if part == moved_part else 0.0 for e, moved_part in rows])
        move = lambda x, d, s=steps: x + s.reshape(-1, *(1,) * x.ndim) * d  # noqa: E731
        stacked.append(jax.tree.map(move, nominal, way))
    return stacked, ways


def test_derivatives_of_a_push_are_those_of_finite_differences():
    """Derivatives of the final pose of a cylinder by its properties, start and push, in curves."""
    time = np.arange(50)[:, None] * PERIOD
    waves = 0.05 + 0.01 * np.sin(2 * time), 0.02 * np.cos(3 * time), 0.1 * np.sin(4 * time)
    parts = (0.01, 0.02), 0.2, 0.3, (FRONT, SIDE), np.zeros((1, 2)), RADIUS
    cylinder = Slider(*map(np.array, parts))
    pose = np.array([0, 0, 0, FRONT + RADIUS, 0, 0.2, 1, 0, 0, 0])
    inputs = cylinder, pose, np.concatenate(waves, axis=1)
    with jax.enable_x64(True):
        moved, ways = moved_both_ways(inputs, 0)
        physics = Physics(timestep=PERIOD, control_period=PERIOD)

        @jax.jit
        @partial(jax.value_and_grad, has_aux=True)
        def end(inputs):
            slider, start, twists = inputs
            qpos = positions(slider, start, twists.swapaxes(0, 1), physics)[-1]
            where = qpos[:, 3] + 2 * qpos[:, 4] + 3 * qpos[:, 9]
            return where[0], where

        (_, where), gradient = jax.device_get(end(jax.tree.map(jnp.asarray, moved)))
    for part in range(3):
        pairs = zip(jax.tree.leaves(gradient[part]), jax.tree.leaves(ways[part]), strict=True)
        slope = sum(np.vdot(a[0], b) for a, b in pairs)
        assert abs(slope) > 1e-3
        assert slope == pytest.approx((where[1 + 2 * part] - where[2 + 2 * part]) / 2e-6, rel=3e-3)


# --- the stage ------------------------------------------------------------------------------


def test_the_friction_arms_of_a_square_and_a_disc_are_the_known_values():
    box, disc = (scene.solid_of(scene.load(name)) for name in ("box", "cylinder"))
    assert solid.friction_arm(box) == pytest.approx([ARM["box"]])
    assert solid.friction_arm(disc) == pytest.approx([ARM["cylinder"]])


def test_feet_balance_the_centre_of_mass_without_pulling():
    """On four corners, half way to an edge: 3/8 and 1/8 each; at an edge: half and nothing."""

    def arm(x):
        com = np.array([[x, 0.0, 0.0]])
        rows = Solid(
            solid.rectangles(np.array([0.2]), np.array([0.1])),
            np.zeros(1),
            np.ones(1),
            np.ones(1),
            com,
            np.ones((1, 3)),
            np.array([[1.0, 0, 0, 0]]),
        )
        return solid.friction_arm(rows)[0]

    assert arm(0.1) == pytest.approx(0.75 * math.hypot(0.1, 0.1) + 0.25 * math.hypot(0.3, 0.1))
    assert arm(0.2) == pytest.approx(0.1)


@pytest.mark.parametrize("name", OBJECTS)
def test_every_scene_has_a_slider(name):
    base = Robot(half_length=0.3)
    loaded = scene.load(name, friction=scene.Friction(0.3, 0.4), robot=base)
    stage, slider = staged("quasistatic", [loaded], preset(), base)
    assert isinstance(stage, Quasistatic)
    assert_allclose(slider.friction_robot, [0.4])
    assert_allclose(slider.base_size, [[0.3, SIDE]])
    com = loaded.physics.body("object").ipos[:2]
    assert_allclose(slider.p_object_com[0], com, atol=1e-5)


@pytest.mark.slow
def test_the_papers_grid_agrees_with_the_other_engines(optimised):
    """RPS 140 of 144, as on the fused engine; NPS 26, and on the fused engine 27."""
    grid = product(("rps", "nps"), objects.PAPER_OBJECTS, FRICTION.values(), paper.TARGETS)
    cases = [
        Case(name, friction, target, registry.LAWS[law]) for law, name, friction, target in grid
    ]
    outcome, _ = pushes.run(cases, Setting(engine="quasistatic"))
    rps, nps = outcome.success.reshape(2, -1, len(paper.TARGETS)).sum(axis=-1)
    assert rps.tolist() == [24, 24, 22, 22, 24, 24]
    assert nps.tolist() == [4, 4, 4, 4, 4, 6]
    assert np.median(outcome.time[:144]) == pytest.approx(87, rel=0.08)
