"""Derivatives of the fused engine through contact."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slow
from numpy.random import default_rng

from rps_jax.control.observation import Twist
from rps_jax.engines.base import ControlPeriod, Motion
from rps_jax.engines.fused import contacts, newton
from rps_jax.engines.fused import step as fused
from rps_jax.geometry import planar
from rps_jax.geometry import vectors as sp
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import pushing
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.world import draws
from rps_jax.world.domain import parse_domain
from rps_jax.world.physics import Physics

CONVERGED = Physics(iterations=60, ls_iterations=60)
TWIST = (0.05, 0.01, 0.05)  # [m/s, m/s, rad/s]


def in_contact(domain, count, seed=0, spread=1.0):
    """Return random worlds of a domain that touch the base: stage, fields, motion, twists, robot.

    The object leans by some mrad, is sunk by some um, and moves about as fast as the base; all of
    these are multiplied by `spread`.
    """
    drawn = draws.draw(parse_domain(domain), seed, np.arange(count))
    drawn.values["yaw"][::2] *= 1e-3  # half of them lie flat on the base
    batch = drawn_worlds(parse_domain(domain), drawn, Setting())
    random, worlds = default_rng(seed), jax.tree.map(jnp.asarray, batch.worlds)
    qpos = np.array(worlds.qpos, float)
    qpos[:, 3] -= drawn.values["gap"] + 3e-4 * spread * random.random(count)
    qpos[:, 5] -= 2e-4 * spread * random.random(count)
    lean = 1e-3 * spread * random.normal(size=(count, 2))
    qpos[:, 7:9] += 0.5 * lean * random.integers(0, 2, (count, 1))  # half of them stand upright
    qpos[:, 6:] /= np.linalg.norm(qpos[:, 6:], axis=1, keepdims=True)
    qvel = 0.02 * spread * random.normal(size=(count, 9))
    robot = pushing(worlds)
    integral = None if robot is None else jnp.zeros((count, 3))
    motion = Motion(*map(jnp.asarray, (qpos, qvel, np.zeros((count, 9)))), integral)
    twists = Twist(*jnp.asarray(np.array(TWIST) * random.normal(1, 0.5, (count, 3))).T)
    return SimpleNamespace(
        stage=batch.stage, fields=worlds.fields, motion=motion, twists=twists, robot=robot
    )


def driven(x, arguments, physics=Setting().physics, steps=1):
    """Return the positions (n, 10) and velocities (n, 9) after some control periods."""
    fields, motion, twists = arguments

    def period(motion, _):
        return x.stage.drive(fields, motion, ControlPeriod(twists, physics, x.robot)).motion, None

    motion = jax.lax.scan(period, motion, length=steps)[0]
    return motion.qpos, motion.qvel


def inputs(x):
    return x.fields, x.motion, x.twists


def random_like(tree, seed=0):
    """Return random numbers of the shapes of a pytree, of the size of each number or of 1e-3."""
    random = default_rng(seed)
    return jax.tree.map(
        lambda a: jnp.asarray(random.normal(size=a.shape) * (np.abs(a) + 1e-3), a.dtype), tree
    )


@partial(jax.jit, static_argnames="physics")
def classes(fields, motion, twists, physics):
    """Return the state of each contact after the solver: with the ground and with the base.

    It is 0 for an open contact, 1 for one that slides and 2 for one that sticks: (n, C) each.
    """
    body, state = fused.split_entries(fields), fused.from_mujoco(fields, motion)
    m = sp.matrix(state.q)
    both = [
        contacts.on_ground(body, state, m, physics),
        contacts.on_base(body, state, m, twists, physics),
    ]
    problem = newton.Problem.of(body, state, m, both, newton.Base())
    a = newton.accelerations(problem, physics)
    states = []
    for contact in both:
        rows = sp.add(newton._rows(contact, a), contact.bias)
        stiffness = newton.contact_force(contact, rows, physics)[1][0]
        sticks = (stiffness == contact.d) & (contact.d > 0)
        states.append(jnp.where(sticks, 2, jnp.where(stiffness > 0, 1, 0)).T)
    return states


@pytest.mark.parametrize("name", [slow("random_box"), "random_cylinder"])
def test_a_step_has_the_derivative_of_its_difference(name, monkeypatch):
    """Vary 24 inputs and more at once, in 200 states of contact of each class."""
    monkeypatch.setattr(newton, "_TOLERANCE", 1e-13)
    with jax.enable_x64(True):
        x = in_contact(f"wide,objects={name}", 200)
        ground, base = map(np.array, classes(*inputs(x), CONVERGED))
        lines = (base[:, : base.shape[1] // 2] > 0).sum(axis=1)  # contacts with the lower edge
        tipping = (ground > 0).any(axis=1) & (ground[:, :3] == 0).any(axis=1)
        for states in ((base == 2).any(1), (base == 1).any(1), (ground == 1).any(1), lines == 1):
            assert states.sum() >= 20
        assert tipping.sum() >= 20
        assert name != "random_box" or (lines == 2).sum() >= 20

        direction = random_like(inputs(x))

        @jax.jit
        def run(step):
            """Return results and slopes after a step [1] along the direction."""
            start = jax.tree.map(lambda a, d: a + step * d, inputs(x), direction)
            return jax.jvp(partial(driven, x, physics=CONVERGED), (start,), (direction,))

        _, slope = run(0.0)

        def differences(h):
            results = [run(step)[0] for step in (h, 0.0, -h)]
            sides = [
                jax.tree.map(lambda a, b: (a - b) / h, *pair) for pair in (results[:2], results[1:])
            ]
            return [np.array(side[1]) for side in sides]

        up, down = differences(1e-7)
    slope, mean = np.array(slope[1]), (up + down) / 2
    size = np.abs(mean).max(axis=1)
    # Where a contact switches within the step of the differences, the two sides differ.
    smooth = np.abs(up - down).max(axis=1) < 1e-3 * size
    errors = np.abs(slope - mean).max(axis=1) / size
    assert np.isfinite(slope).all()
    assert smooth.mean() > 0.9
    assert np.median(errors[smooth]) < 1e-6
    assert errors[smooth].max() < 1e-3
    one_sided = np.minimum(*(np.abs(slope - side).max(axis=1) for side in (up, down)))
    assert (one_sided / size)[~smooth].max(initial=0) < 2e-2


def products(a, b):
    """Return the inner products (n,) of two arrays of n worlds."""
    return np.sum(np.reshape(np.asarray(a) * np.asarray(b), (len(a), -1)), axis=1)


@pytest.mark.parametrize(
    "domain",
    [
        "real,objects=random_cylinder",
        *(slow(x) for x in ("wide,objects=random_box", "real,objects=random_prism")),
    ],
)
def test_derivatives_are_finite_and_both_modes_agree(domain):
    """Check 10,000 states, up to far from any contact, in float32 and native functions."""
    count = 1120
    x = in_contact(domain, count)

    @jax.jit
    def both_modes(arguments, direction, weights):
        run = partial(driven, x)
        slopes = jax.jvp(run, (arguments,), (direction,))[1]
        return slopes, jax.vjp(run, arguments)[1](weights)[0]

    weights = random_like(x.motion[:2], 1)
    for spread in (1.0, 0.0, 30.0):
        at = in_contact(domain, count, int(spread), spread)
        direction = random_like(inputs(at))
        slopes, pulled = both_modes(inputs(at), direction, weights)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((slopes, pulled)))
        forward = sum(map(products, slopes, weights))
        pairs = zip(jax.tree.leaves(pulled), jax.tree.leaves(direction), strict=True)
        backward = sum(products(*pair) for pair in pairs)
        size = sum(products(*map(np.abs, pair)) for pair in zip(slopes, weights, strict=True))
        error = np.abs(forward - backward) / (size + 1e-6)
        assert np.median(error) < 1e-5
        assert np.quantile(error, 0.99) < 1e-2


ASIDE = np.array([0, 1, 0, 0, 0, 0, 0, 1.0])  # weights of y and yaw


@pytest.fixture(scope="module")
def pushes():
    """Boxes that are pushed for 0.4 s, and the gradients of a score by all inputs."""
    x = in_contact("wide,objects=random_box", 32)

    @jax.jit
    def gradient(arguments, weights):
        """Return the gradient of the weighted sum of final poses of objects and their yaws."""
        return jax.grad(lambda a: jnp.sum(score(driven(x, a, steps=20)[0]) @ weights))(arguments)

    def score(qpos):
        return jnp.column_stack([qpos[:, 3:], planar.yaw_of_quaternion(qpos[:, 6:])])

    return x, gradient


def test_the_mirrored_push_has_the_mirrored_gradient(pushes):
    x, gradient = pushes
    fields, motion, twists = inputs(x)

    def mirror(fields, motion, twists):
        """Mirror at the plane y = 0; corners stay in counter-clockwise order."""
        flip = np.array([1, -1, 1])
        turned = np.array([1, -1, 1, -1])  # a quaternion about x and z
        qpos = motion.qpos * np.array([1, -1, -1, 1, -1, 1, *turned])
        qvel = motion.qvel * np.array([1, -1, -1, 1, -1, 1, -1, 1, -1])
        fields = fields._replace(
            p_object_com=fields.p_object_com * flip,
            q_object_body=fields.q_object_body * turned,
            vertices=fields.vertices[:, ::-1] * flip,
            up=fields.up * flip,
        )
        return (
            fields,
            motion._replace(qpos=qpos, qvel=qvel),
            Twist(twists[0], -twists[1], -twists[2]),
        )

    plain = gradient((fields, motion, twists), ASIDE)
    mirrored = gradient(mirror(fields, motion, twists), ASIDE)
    back = mirror(*mirrored)
    for a, b in ((plain[2], back[2]), (plain[0].friction_robot, back[0].friction_robot)):
        a, b = np.array(a), -np.array(b)  # y and yaw change their signs
        assert np.median(np.abs(a - b) / (np.abs(a) + 1e-3)) < 1e-3


def test_the_mass_does_not_change_a_push_by_a_held_base(pushes):
    """Forces, inertia and stiffness are proportional to the mass."""
    x, gradient = pushes
    slopes, f = gradient(inputs(x), ASIDE)[0], x.fields
    weights = slopes.invweight * f.invweight + slopes.base_invweight * f.base_invweight
    scaled = slopes.mass * f.mass + jnp.sum(slopes.inertia * f.inertia, axis=1) - weights
    size = jnp.abs(slopes.mass * f.mass) + jnp.abs(weights)
    assert np.median(size) > 1e-3
    assert np.median(np.abs(scaled) / (size + 1e-6)) < 1e-3


def test_without_contact_the_base_does_not_matter(pushes):
    x, gradient = pushes
    away = x.motion._replace(qpos=x.motion.qpos.at[:, 3].add(0.5))
    assert not np.any(gradient((x.fields, away, x.twists), np.ones(8))[2])


def test_second_derivatives_of_native_functions_are_refused():
    x = in_contact("wide,objects=random_cylinder", 8)

    def final(scale):
        twists = jax.tree.map(lambda v: scale * v, x.twists)
        return jnp.sum(driven(x, (x.fields, x.motion, twists))[0])

    with pytest.raises(
        NotImplementedError, match="trials have no second derivatives: differentiate once"
    ):
        jax.jit(jax.grad(jax.grad(final))).lower(1.0)
