"""The fused engine agrees with C MuJoCo."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import jitted, row
from numpy.random import default_rng
from numpy.testing import assert_allclose
from staging import FINE, simulate, staged, step_in_c
from staging import body as body_of

from rps_jax.engines.base import Motion
from rps_jax.engines.fused import contacts, newton
from rps_jax.engines.fused import step as fused
from rps_jax.geometry import vectors
from rps_jax.world import scene
from rps_jax.world.physics import Physics
from rps_jax.world.scene import Friction

TWIST = (0.05, 0.01, 0.05)  # [m/s, m/s, rad/s]
# Object, yaw [rad] and lateral offset [m]: flat on the face, corner first, the base's corner first.
STARTS = (
    ("box", 0.0, 0.0),
    ("box", 0.3, 0.05),
    ("box", 0.2, 0.41),
    ("nonuniform_box", -0.4, -0.1),
    ("cylinder", 0.0, 0.08),
    ("cylinder", 0.0, -0.40),
)


def start(name, yaw, offset, physics=FINE):
    loaded = scene.load(name, physics, Friction(0.3, 0.4))
    qpos = scene.initial_qpos(loaded, -0.0005, yaw)
    qpos[4:6] += offset, -0.0005  # sunk, so that rounding does not decide what touches
    qpos[:3] = 0.1, -0.2, 0.5  # and all of it turned
    c, s = np.cos(0.5), np.sin(0.5)
    qpos[3:5] = qpos[:2] + np.array([[c, -s], [s, c]]) @ qpos[3:5]
    half = (yaw + 0.5) / 2
    qpos[6:] = np.cos(half), 0.0, 0.0, np.sin(half)
    return loaded, qpos


def pushed(loaded, qpos, steps, physics=FINE):
    """Return position and velocity after steps at TWIST in the fused engine, and in C MuJoCo."""
    stage, fields = staged("fused", [loaded], physics)
    end = row(simulate("fused", stage, fields, qpos[None], TWIST, physics, steps)[:2], (-1, 0))
    return *end, step_in_c(loaded.physics, qpos, TWIST, steps)


@pytest.mark.parity
@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
@pytest.mark.parametrize(("name", "yaw", "offset"), STARTS)
def test_a_step_agrees_with_c_mujoco(name, yaw, offset, cone):
    physics = replace(FINE, cone=cone)
    pose, velocity, expected = pushed(*start(name, yaw, offset, physics), 1, physics)
    # C MuJoCo finds one contact of the cylinder with the base, of which the fused engine has two.
    near, slow = (1e-3, 0.2) if (name, offset) == ("cylinder", 0.08) else (1e-6, 3e-4)
    assert_allclose(pose, expected.qpos, atol=near)
    assert_allclose(velocity[:3], expected.qvel[:3], atol=1e-3)
    assert_allclose(velocity[3:], expected.qvel[3:], atol=slow)


@pytest.mark.parity
@pytest.mark.parametrize(("name", "yaw", "offset"), [STARTS[1], STARTS[3], STARTS[4]])
def test_a_push_of_three_seconds_agrees_with_c_mujoco(name, yaw, offset):
    """C MuJoCo drops one of two contacts of a tilted edge now and then, which rocks the object."""
    loaded, qpos = start(name, yaw, offset)
    pose, _, expected = pushed(loaded, qpos, 300)
    assert np.hypot(*(expected.qpos - qpos)[3:5]) > 0.1
    assert_allclose(pose, expected.qpos, atol=3e-3)


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_a_contacts_force_and_stiffness_are_derivatives_of_its_cost(cone):
    """Force = - d s / d x and stiffness = d^2 s / d x^2, with MuJoCo's s in its three zones."""
    physics = Physics(cone=cone)
    d, f = 20.0, 0.4
    point = contacts.Contact(vectors.X, vectors.X, vectors.Y, vectors.Z, vectors.X, d, f)

    def cost(x):
        if cone == "pyramidal":
            edges = jnp.stack([x[0] + f * x[1], x[0] - f * x[1], x[0] + f * x[2], x[0] - f * x[2]])
            stiff = d * physics.impratio / (2 * f**2 * (1 + f**2))
            return stiff / 2 * jnp.sum(jnp.minimum(edges, 0) ** 2)
        mu = f / np.sqrt(physics.impratio)
        n, slip = mu * x[0], f * jnp.hypot(x[1], x[2])
        sticking = d / 2 * (x[0] ** 2 + physics.impratio * (x[1] ** 2 + x[2] ** 2))
        sliding = d / (mu**2 * (1 + mu**2)) / 2 * (n - mu * slip) ** 2
        return jnp.where(n >= mu * slip, 0.0, jnp.where(mu * n + slip <= 0, sticking, sliding))

    xs = default_rng(0).normal(size=(40, 3)).astype(np.float32)
    functions = (
        lambda x: newton.contact_force(point, tuple(x), physics),
        jax.grad(cost),
        jax.hessian(cost),
    )
    (force, k), slope, curvature = (jitted(jax.vmap(function))(xs) for function in functions)
    assert_allclose(np.transpose(force), -slope, rtol=1e-3, atol=1e-3)
    nn, nt, ns, tt, ts, ss = k
    full = np.transpose([[nn, nt, ns], [nt, tt, ts], [ns, ts, ss]])
    assert_allclose(full, curvature, rtol=1e-3, atol=2e-3)
    assert len(set(zip(force[0] == 0, np.linalg.matrix_rank(full) == 3, strict=True))) > 1


@jitted
def contacts_ahead(body, qpos):
    """Return the contacts of objects at rest with the side of a base that heads along x."""
    still = jnp.zeros((1, 9))
    state = fused.from_mujoco(body, Motion(qpos, still, still))
    inputs = fused.split_entries(body), state, vectors.matrix(state.q)
    return contacts.side_contacts(*inputs, (jnp.ones(1), jnp.zeros(1)))


@pytest.mark.parametrize("name", ["box", "cylinder"])
@pytest.mark.parametrize("degrees", [0, 5, 10, 20, 40])
def test_the_contact_of_a_leaning_object_is_at_its_lower_edge(name, degrees):
    """Its rear lower edge 5 mm before the base, at any lean; below that edge there is nothing."""
    loaded = scene.load(name)
    size = loaded.physics.geom("object").size
    half, tall = (size[0], size[2]) if name == "box" else (size[0], size[1])
    lean = np.radians(degrees)
    c, s = np.cos(lean), np.sin(lean)
    front = loaded.physics.geom("base").size[0]
    x, z = front + 0.005 + tall * s + half * c, tall * c + half * s  # on its front lower edge
    qpos = np.array([0, 0, 0, x, 0, z, np.cos(lean / 2), 0, np.sin(lean / 2), 0])
    data = mujoco.MjData(loaded.physics)
    data.qpos[:] = qpos
    mujoco.mj_forward(loaded.physics, data)
    base, object_ = (loaded.physics.geom(g).id for g in ("base", "object"))
    true = mujoco.mj_geomDistance(loaded.physics, data, base, object_, 1.0, None)
    body = body_of(loaded.physics, np.asarray(loaded.footprint.vertices))
    heights, _, _, distances = contacts_ahead(
        *jax.tree.map(lambda x: np.asarray(x)[None], (body, qpos))
    )
    corner = z - tall * c + half * s
    assert heights.min() >= max(0.06, corner) - 1e-5
    assert distances.min() == pytest.approx(true, abs=5e-4)
