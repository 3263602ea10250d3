"""Exact derivatives through MJX: of models that are not ours, and of our worlds."""

import contextlib
import importlib.metadata
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tomllib
from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import ROOT, slow
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax import engines
from rps_jax.control.observation import Twist
from rps_jax.engines import mjx_gradients
from rps_jax.engines.base import ControlPeriod, Motion
from rps_jax.engines.fused import contacts, newton
from rps_jax.engines.fused import step as fused
from rps_jax.engines.mjx_colliders import mjx
from rps_jax.geometry import vectors as sp
from rps_jax.robot.robot import Robot
from rps_jax.trials.worlds import starts
from rps_jax.world import domain as domains
from rps_jax.world import draws
from rps_jax.world.physics import Physics
from rps_jax.world.scene import WorldInputs

BOX = """<body pos="0 0 0.0985"><freejoint/>
<geom type="box" size="0.2 0.15 0.1" mass="2" friction="0.6"/></body>"""
BALL = """<body pos="0 0 0.098"><freejoint/><geom size="0.1" mass="1" friction="0.6"/></body>"""
# A thigh between limits, with friction, and an ankle with a limit; the foot is a capsule.
LEG = """<body pos="1 0 0.446"><joint type="slide" axis="0 0 1"/>
<joint type="slide" axis="1 0 0" damping="1"/><geom type="sphere" size="0.05" mass="3"/>
<body><joint axis="0 1 0" range="-60 20" limited="true" frictionloss="0.3"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.35" size="0.05" mass="2" contype="0" conaffinity="0"/>
<body pos="0 0 -0.4"><joint type="ball" range="0 40" limited="true" damping="0.1"/>
<geom type="capsule" fromto="-0.1 0 -0.02 0.15 0 -0.02" size="0.03" mass="0.5" condim="{condim}"
friction="0.7 0.02 0.005"/></body></body></body>"""
OPTION = 'timestep="0.004" ls_iterations="50" tolerance="1e-15"'


class Case:
    """A body on a plane: states are positions, velocities and a factor of all friction."""

    def __init__(self, body, cone="elliptic", solver="Newton", integrator="Euler", iterations=100):
        option = f'{OPTION} cone="{cone}" solver="{solver}" integrator="{integrator}"'
        self.plain = mujoco.MjModel.from_xml_string(
            f'<mujoco><option {option} iterations="{iterations}"/><worldbody>'
            f'<geom type="plane" size="0 0 1"/>{body}</worldbody></mujoco>'
        )
        self.model, self.data = mjx.put_model(self.plain), mjx.make_data(self.plain)

    def state(self, *qvel):
        return np.concatenate([self.plain.qpos0, qvel, [1.0]])

    def stepped(self, step, x):
        """Return model and data after a step from a state."""
        nq, nv = self.plain.nq, self.plain.nv
        model = self.model.tree_replace({"geom_friction": self.model.geom_friction * x[-1]})
        qvel = x[nq : nq + nv]
        return model, step(model, self.data.replace(qpos=x[:nq], qvel=qvel))

    def next_state(self, step, x):
        """Return the state after a step."""
        data = self.stepped(step, x)[1]
        return jnp.concatenate([data.qpos, data.qvel, x[-1:]])

    def next_states_in_c(self, states):
        """Return the states after a step in C MuJoCo."""
        ends, nq = np.array(states), self.plain.nq
        friction = self.plain.geom_friction.copy()
        for x in ends:
            data = mujoco.MjData(self.plain)
            data.qpos, data.qvel, self.plain.geom_friction = x[:nq], x[nq:-1], x[-1] * friction
            mujoco.mj_step(self.plain, data)
            x[:nq], x[nq:-1] = data.qpos, data.qvel
        return ends

    def forces(self, step, x):
        """Return the forces of the constraints in a step."""
        data = self.stepped(step, x)[1]
        return jnp.concatenate([data.qfrc_constraint, data._impl.efc_force])


def differences(function, x, h=1e-6, steps=1):
    """Return the matrix of central differences after some steps of a batched function."""
    sides = np.concatenate([x + h * np.eye(x.size), x - h * np.eye(x.size)])
    for _ in range(steps):
        sides = function(sides)
    up, down = np.split(np.asarray(sides), 2)
    return (up - down).T / (2 * h)


@pytest.fixture(scope="module", params=[BALL, slow(BOX)])
def compiled_body(request):
    """A body on a plane, with programs: step of MJX, our step, its derivatives."""
    with jax.enable_x64(True):
        case = Case(request.param)
        ours = partial(case.next_state, mjx_gradients.step)
        case.theirs = jax.jit(jax.vmap(partial(case.next_state, mjx.step)))
        case.ours, case.jacobian = jax.jit(jax.vmap(ours)), jax.jit(jax.jacrev(ours))
        case.forward = jax.jit(lambda x, way: jax.jvp(ours, (x,), (way,))[1])
        return case


@pytest.fixture
def body(compiled_body):
    with jax.enable_x64(True):
        yield compiled_body


@pytest.mark.slow
def test_derivatives_of_1_and_100_steps_on_a_plane_are_central_differences(body):
    """The body falls, slides and turns; derivatives of 100 steps are a product of matrices."""
    x = start = body.state(4.0, 1.0, 0.0, 0.2, 0.3, 3.0)
    product = np.eye(x.size)
    for i in range(100):
        matrix = body.jacobian(x)
        product, x = matrix @ product, body.ours(x[None])[0]
        if i in (0, 99):
            expected = differences(body.theirs, start, steps=i + 1)
            atol = 2e-3 * np.abs(expected).max()
            assert_allclose(product, expected, rtol=0, atol=atol)
    assert np.linalg.norm(x[7:9]) > 0.1  # it still slides


def some_states(body):
    """Return random states of a body near the ground (28, 14)."""
    return body.state(*np.zeros(6)) + 0.01 * default_rng(0).normal(size=(28, 14))


def test_values_are_those_of_mjx_bit_for_bit(body):
    states = some_states(body)
    assert_array_equal(body.ours(states), body.theirs(states))


@pytest.mark.slow
def test_both_modes_agree(body):
    states, rng = some_states(body), default_rng(1)
    for x, way in zip(states[:4], rng.normal(size=(4, 14)), strict=True):
        expected = np.asarray(body.jacobian(x)) @ way
        assert_allclose(body.forward(x, way), expected, rtol=1e-9, atol=1e-9)


def test_in_the_air_friction_has_no_effect_and_a_body_at_rest_can_turn(body):
    """The derivative by an angular velocity of zero, which that of MJX lacks."""
    x = body.state(*np.zeros(6))
    x[2] += 1.0
    matrix = body.jacobian(x)
    assert_array_equal(matrix[:-1, -1], 0.0)
    assert_allclose(matrix[4:7, 10:13], 0.002 * np.eye(3), atol=1e-12)
    assert_allclose(matrix[:-1], differences(body.theirs, x)[:-1], atol=1e-7)


# --- our worlds ---

STEP = Physics(control_period=0.01)
QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


@cache
def some_worlds(name, count, driven, x64=False, feet=""):
    """Return shape family, drawn worlds, robot, and states (count, ...) near contact by kind.

    Kinds are: at rest, sliding and turning flat, on an edge, on a corner. Some touch the base.
    """
    dtype, rng = np.float64 if x64 else np.float32, default_rng(0)
    ranges = domains.parse_domain(f"wide,objects={name},gap=0,lateral=-0.05:0.05{feet}")
    drawn = draws.draw(ranges, 3, np.arange(count))
    kind = np.arange(count)[:, None] % 4
    qpos = starts(drawn)
    qpos[:, [3, 5]] += 0.0005 * rng.uniform(-1, 0.2, (count, 2))
    lean = np.choose(kind, [0.0, 3e-4, [[0.1, 0.0]], 0.1]) * rng.normal(size=(count, 2))
    turned = sp.times(qpos[:, 6:10].T, np.column_stack([np.ones(count), lean, 0 * kind]).T)
    qpos[:, 6:10] = np.stack(turned, axis=1) / np.linalg.norm(turned, axis=0)[:, None]
    speeds = [0.05, 0.05, 0.1, 0.05, 0.05, 0.02, 0.1, 0.1, 0.2]
    qvel, twist = rng.normal(size=(count, 9)) * speeds, rng.normal(size=(count, 3)) * speeds[:3]
    state = [qpos, *(np.where(kind > 0, x, 0) for x in (qvel, twist))]
    robot = Robot(force_max=100.0) if driven else Robot()
    robots = jax.tree.map(lambda x: np.full(count, x, dtype), robot) if driven else None
    return ranges.families[0], drawn, robot, robots, [x.astype(dtype) for x in state]


def pulled_back(engine, worlds, physics, weights):
    """Return next states and forces (n, 22), and the gradients of their weighted sum, by input.

    Gradients by quaternions are tangential. Engines differ in the part along the quaternion, which
    has no meaning.
    """
    family, drawn, robot, robots, (qpos, qvel, twist) = worlds
    inputs = WorldInputs(family, drawn.solid, drawn.friction, physics, robot)
    stage, fields = engines.get(engine).stage(inputs)
    fields = jax.tree.map(lambda x: jnp.asarray(x, qpos.dtype), fields)

    def outputs(fields, qpos, qvel, twist, robots):
        integral = None if robots is None else jnp.zeros_like(twist)
        motion = Motion(qpos, qvel, jnp.zeros_like(qvel), integral)
        period = ControlPeriod(Twist(*twist.T), physics, robots, force=True)
        driven = stage.drive(fields, motion, period)
        return jnp.concatenate([driven.motion.qpos, driven.motion.qvel, driven.force], axis=1)

    @partial(jax.jit, compiler_options=QUICK if qpos.dtype == np.float64 else None)
    def run(*inputs):
        values, pull = jax.vjp(outputs, *inputs)
        return values, pull(weights)

    values, gradients = run(fields, qpos, qvel, twist, robots)
    at = np.array(gradients[1])
    q = qpos[:, 6:10]
    at[:, 6:10] -= (at[:, 6:10] * q).sum(axis=1, keepdims=True) * q
    return np.asarray(values), (gradients[0], at, *gradients[2:])


def check_finite(gradients):
    for path, leaf in jax.tree.leaves_with_path(gradients):
        assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)


CLASSES = ("sticking", "sliding", "edge", "corner", "tipping")
CONVERGED = {"iterations": 60, "ls_iterations": 60, "tolerance": 0.0}


def check_agreement(pairs, kinds, bounds):
    """Compare pairs of arrays (n, ...) by class of contact.

    `bounds` are the largest median, 95 % quantile and maximum of the relative errors in a class.
    """
    excess = {}
    for name, pair in pairs.items():
        ours, theirs = (np.reshape(x, (len(kinds), -1)) for x in pair)
        error = np.abs(ours - theirs).max(axis=1) / (np.abs(theirs).max(axis=1) + 1e-6)
        for kind, label in enumerate(CLASSES):
            quantiles = np.quantile(error[kinds == kind], (0.5, 0.95, 1.0))
            if (quantiles > bounds[label]).any():
                excess[name, label] = quantiles
    assert not excess


def sunk(worlds):
    """Return worlds whose lowest points are up to 0.4 mm below the ground, and their classes.

    Half of those on an edge turn about it. Cylinders are apart from the base: for MJX their side is
    a capsule, which touches the base at other points. None is upright, where the lowest point of
    its rim switches.
    """
    family, drawn, robot, robots, (qpos, qvel, twist) = worlds
    inputs = WorldInputs(family, drawn.solid, drawn.friction, STEP, robot)
    _, fields = engines.get("fused").stage(inputs)
    fields, qpos, qvel = jax.tree.map(jnp.asarray, fields), qpos.copy(), qvel.copy()
    index, rng = np.arange(len(qpos)), default_rng(1)
    kinds = np.where(index % 8 == 6, CLASSES.index("tipping"), index % 4)
    if family == "cylinder":
        qpos[:, 3] += 0.5
        qpos[kinds == 0, 7:9] += 1e-4 * rng.normal(size=(sum(kinds == 0), 2))
    state = fused.from_mujoco(fields, Motion(qpos, qvel, np.zeros_like(qvel)))
    r, exists = contacts._lower_face(fused.split_entries(fields), sp.matrix(state.q))
    depth = 4e-4 * rng.random(len(qpos))
    qpos[:, 5] -= np.min(np.where(exists, state.p[2] + r[2], 1.0), axis=0) + depth
    qvel[kinds == 2, 3:] *= 0.1
    qvel[kinds == 4, 6] *= 5.0
    return (family, drawn, robot, robots, (qpos, qvel, twist)), kinds


@pytest.mark.slow
@pytest.mark.parametrize("name", ["random_box", "random_cylinder"])
def test_gradients_of_both_engines_agree(name, monkeypatch):
    """Compare 200 states of our worlds by all inputs, in float64 with converged solvers."""
    monkeypatch.setattr(newton, "_TOLERANCE", 1e-13)
    physics = Physics(control_period=0.01, **CONVERGED)
    with jax.enable_x64(True):
        worlds, kinds = sunk(some_worlds(name, 200, driven=False, x64=True))
        weights = jax.random.normal(jax.random.key(0), (200, 22))
        (values, mjx_slopes), (expected, fused_slopes) = (
            pulled_back(engine, worlds, physics, weights) for engine in ("mjx", "fused")
        )
    ground, robot = np.moveaxis(mjx_slopes[0][".pair_friction"][:, :, :2].sum(axis=2), 1, 0)
    pairs = {
        "values": (values, expected),
        "ground": (ground, fused_slopes[0].friction_ground),
        "robot": (robot, fused_slopes[0].friction_robot),
    }
    inputs = enumerate(("qpos", "qvel", "twist"), 1)
    pairs |= {key: (mjx_slopes[i], fused_slopes[i]) for i, key in inputs}
    bounds = {
        "sticking": (1e-4, 2e-3, 5e-3),
        "sliding": (3e-3, 1e-2, 1e-1),
        "edge": (2e-3, 5e-3, 1e-2),
        "corner": (2e-3, 1e-2, 5e-2),
        "tipping": (2e-3, 2e-2, 1e-1),
    }
    check_agreement(pairs, kinds, bounds)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "driven", "cone", "feet"),
    [
        ("random_cylinder", True, "elliptic", ""),
        ("random_cylinder", False, "pyramidal", ",feet=0.5:0.9"),
        ("random_prism", True, "pyramidal", ""),
        ("random_prism", True, "elliptic", ",feet=0.5:0.9"),
        ("random_box", True, "pyramidal", ""),
    ],
)
def test_gradients_of_all_objects_are_finite(name, driven, cone, feet):
    """Check 10,000 states and weights of any size."""
    worlds = some_worlds(name, 10_000, driven, feet=feet)
    physics = Physics(control_period=0.01, cone=cone)
    weights = jax.random.normal(jax.random.key(0), (10_000, 22))
    weights = weights * 10 ** jax.random.uniform(
        jax.random.key(1), (10_000, 1), minval=-3, maxval=6
    )
    check_finite(pulled_back("mjx", worlds, physics, weights)[1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("condim", "options"),
    [
        (3, {}),
        (6, {"integrator": "implicitfast"}),
        (4, {"cone": "pyramidal"}),
        (1, {"cone": "pyramidal"}),
        (3, {"solver": "CG", "iterations": 3000}),
        (3, {"integrator": "RK4"}),
    ],
)
def test_derivatives_of_a_leg_are_central_differences(condim, options):
    """Contacts of all dimensions, limits, friction loss, damping; and the constraint forces."""
    with jax.enable_x64(True):
        case = Case(LEG.format(condim=condim), **options)
        # Differences of CG would have the error of its solution.
        exact = Case(LEG.format(condim=condim), **options | {"solver": "Newton"})
        rng = default_rng(1)
        for function in ("next_state", "forces"):
            jacobian = jax.jit(jax.jacrev(partial(getattr(case, function), mjx_gradients.step)))
            step = jax.jit(jax.vmap(partial(getattr(exact, function), mjx.step)))
            for thigh, ankle in ((0.1, 0.1), (-1.06, 0.3), (0.36, 0.8)):
                x = case.state(*rng.normal(size=6) * 0.3)
                x[2], x[3:7] = thigh, (np.cos(ankle / 2), 0, np.sin(ankle / 2), 0)
                expected = differences(step, x, 1e-5)
                atol = 1e-3 * np.abs(expected).max(axis=1, keepdims=True) + 1e-6
                assert (np.abs(jacobian(x) - expected) < atol).all()


# --- models of others ---

QUICK_JIT = partial(jax.jit, compiler_options=QUICK)
# MJX refuses elliptic cones in a model without contacts.
PENDULUM = """<body pos="2 0 1"><joint axis="0 1 0" range="-30 30" limited="true" damping="0.1"
frictionloss="0.01"/><geom pos="0 0 -0.4" size="0.03" contype="0" conaffinity="0"/></body>"""

SLIDING = (0.0, 0.0, 0.098, 1.0, 0.0, 0.0, 0.0, 0.5, 0.2, -0.5, 1.0, 2.0, 3.0)


def second_derivatives(case, steps=2):
    """Return a function of states (N, n): gradients (N, n) and second derivatives (N, n, n)."""
    weights = default_rng(0).normal(size=case.plain.nq + case.plain.nv)

    def value(x):
        states = jax.lax.scan(
            lambda x, _: (case.next_state(mjx_gradients.step, x), None), x, length=steps
        )[0]
        return states[:-1] @ weights

    def derivatives(x):
        gradient, push = jax.linearize(jax.grad(value), x)
        return gradient, jax.vmap(push)(jnp.eye(x.size))

    return QUICK_JIT(jax.vmap(derivatives))


def check_second_derivatives(case, states, atol=1e-5):
    """Compare with differences of the gradient, relative to the largest entry."""
    function = second_derivatives(case)
    for x in states:
        sides = x + 1e-6 * np.concatenate([0 * x[None], np.eye(x.size), -np.eye(x.size)])
        gradients, (second, *_) = map(np.asarray, function(sides))
        up, down = gradients[1:].reshape(2, x.size, -1)
        largest = np.abs(second).max()
        assert_allclose(second, (up - down) / 2e-6, rtol=0, atol=atol * largest)
        assert_allclose(second, second.T, rtol=0, atol=1e-6 / 3 * largest)


def test_second_derivatives_of_a_limit_are_those_of_its_formula():
    """Differentiate by the stiffness and the reference acceleration of a limit."""
    with jax.enable_x64(True):
        case = Case(PENDULUM.replace("frictionloss", "armature"), "pyramidal")
        data = mujoco.MjData(case.plain)
        data.qpos[:] = 0.55
        mujoco.mj_forward(case.plain, data)
        at, sign = mjx.put_data(case.plain, data), data.efc_J[0]
        mass = data.qfrc_smooth / data.qacc_smooth

        def solved(x):
            fields = {"_impl.efc_D": x[:1], "_impl.efc_aref": x[1:]}
            return mjx_gradients.solve(case.model, at.tree_replace(fields)).qacc[0]

        def scanned(x):  # drops the rules of `jax.custom_jvp`
            return jax.lax.scan(lambda *_: (solved(x), None), 0.0, length=1)[0]

        def formula(x):
            return ((data.qfrc_smooth + sign * x[0] * x[1]) / (mass + x[0]))[0]

        x = np.array([data.efc_D[0], data.efc_aref[0]])
        result = QUICK_JIT(jax.jacfwd(jax.grad(scanned)))(x)
        assert_allclose(result, jax.hessian(formula)(x), rtol=1e-9)


@pytest.mark.slow
def test_second_derivatives_of_a_pendulum_beyond_its_limit():
    with jax.enable_x64(True):
        case = Case(PENDULUM, "pyramidal")
        check_second_derivatives(case, [np.array([x, 0.3, 1.0]) for x in (0.0, 0.5238, 0.55)])


@pytest.mark.slow
@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_second_derivatives_of_a_ball_on_a_plane(cone, integrator):
    """The ball slides, rolls, and sticks."""
    with jax.enable_x64(True):
        case = Case(BALL, cone, integrator=integrator)
        speeds = [0.5, 0.2, -0.1, 1.0, 2.0, 3.0], [0.01, 0.02, -0.1, 0.2, -0.1, 0.3]
        check_second_derivatives(case, [case.state(*x) for x in speeds])


ITERATION_CASES = [
    ("Newton", PENDULUM, (0.55, 0.3)),
    pytest.param("Newton", BALL, SLIDING, marks=pytest.mark.slow),
    pytest.param("CG", BALL, SLIDING, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("solver", "body", "state"), ITERATION_CASES, ids=["limit", "ball", "CG"])
def test_after_few_iterations_derivatives_are_those_of_the_minimum(solver, body, state):
    """Values stay those of MJX."""
    with jax.enable_x64(True):
        cone = "pyramidal" if body == PENDULUM else "elliptic"
        few = Case(body, cone, solver, iterations=2)
        ours, theirs = (partial(few.next_state, x.step) for x in (mjx_gradients, mjx))
        x = np.array([*state, 1.0])
        slope = jax.jacfwd(lambda x: [ours(x)] * 2, has_aux=True)
        same, (slopes, value) = QUICK_JIT(lambda x: [f(x) for f in (theirs, slope)])(x)
    assert_array_equal(value, same)
    expected = differences(Case(body, cone).next_states_in_c, x)
    assert_allclose(slopes, expected, rtol=0, atol=3e-6 * np.abs(expected).max())


def test_after_one_iteration_derivatives_are_those_of_mjx():
    case, ones = Case(PENDULUM, "pyramidal", iterations=1), (np.ones(3, np.float32),)
    ours, theirs = (
        jax.make_jaxpr(partial(jax.jvp, partial(case.next_state, x.step)))(*2 * [ones])
        for x in (mjx_gradients, mjx)
    )
    assert str(ours) == str(theirs)


BOUNCE = """<mujoco><option timestep="2e-4" tolerance="1e-14"/>
<default><geom solref="-1e5 -20" solimp="{impedance} 0.95 0.001"/></default><worldbody>
<geom type="plane" size="0 0 1"/><body pos="0 0 0.3"><joint type="slide" axis="0 0 1"/>
<geom size="0.1" mass="1" condim="1"/></body></worldbody></mujoco>"""


@pytest.mark.slow
@pytest.mark.parametrize(("impedance", "error"), [(0.9, -4.0), (0.0, 0.0)])
def test_derivatives_of_a_stiff_bounce_are_slopes_if_its_force_starts_at_zero(impedance, error):
    """A damping force that starts with a jump shifts them, in short steps, too."""
    starts = jnp.linspace(-0.05, 0.05, 101)  # [m] of a ball that falls by 0.2 m
    with jax.enable_x64(True):
        plain = mujoco.MjModel.from_xml_string(BOUNCE.format(impedance=impedance))
        model, data = mjx.put_model(plain), mjx.make_data(plain)

        def height(start):
            def step(state, _):
                qpos, qvel = state
                after = mjx_gradients.step(model, data.replace(qpos=qpos, qvel=qvel))
                return (after.qpos, after.qvel), None

            state = start[None], jnp.zeros(1)
            return jax.lax.scan(step, state, length=2000)[0][0][0]

        run = QUICK_JIT(jax.vmap(lambda x: jax.jvp(height, (x,), (jnp.ones_like(x),))))
        heights, slopes = map(np.asarray, run(starts.astype(float)))
    assert_allclose(slopes.mean() - np.polyfit(starts, heights, 1)[0], error, atol=0.3)


CUBES = """<mujoco><worldbody><geom type="plane" size="0 0 1"/>
<body pos="0 0 0.051"><freejoint/><geom type="box" size="0.05 0.05 0.05" mass="0.2"/></body>
<body pos="0.01 0 0.152" euler="0 0 12"><freejoint/>
<geom type="box" size="0.05 0.05 0.05" mass="0.2"/></body>
</worldbody></mujoco>"""


def assets():
    """Return the MJCF files of MuJoCo, Gymnasium and MuJoCo Menagerie that are installed."""
    data = Path(mjx.__file__).parent / "test_data"
    files = {"humanoid of MJX": data / "humanoid/humanoid.xml"}
    files["barkour of MJX"] = data / "barkour_v0/assets/barkour_v0_mjx.xml"
    gym = Path(importlib.util.find_spec("gymnasium").origin).parent / "envs/mujoco/assets"
    names = "ant", "half_cheetah", "hopper", "humanoid", "inverted_pendulum", "walker2d"
    files |= {name: gym / f"{name}.xml" for name in names}
    folder = os.environ.get("MENAGERIE_PATH", "~/.cache/robot_descriptions/mujoco_menagerie")
    names = "unitree_go2", "anybotics_anymal_c"
    return files | {name: Path(folder).expanduser() / name / "scene_mjx.xml" for name in names}


def tangents(model, qpos):
    """Return the derivative (nq, nv) of a position by a motion."""
    columns = []
    for direction in np.eye(model.nv):
        sides = qpos.copy(), qpos.copy()
        mujoco.mj_integratePos(model, sides[0], direction, 1e-6)
        mujoco.mj_integratePos(model, sides[1], direction, -1e-6)
        columns.append((sides[0] - sides[1]) / 2e-6)
    return np.stack(columns, axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
@pytest.mark.parametrize("name", ["cubes", *assets()])
def test_derivatives_of_models_of_others_are_those_of_c_mujoco_and_differences(
    name, integrator, tmp_path, monkeypatch
):
    """Compare the Jacobian of a step after a fall, by state and controls, in double precision.

    C MuJoCo has no derivatives of RK4, and other contacts on boxes and height fields.
    """
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log about some models
    file = assets().get(name)
    if file is not None and not file.is_file():
        pytest.skip(f"{name} is not installed: set MENAGERIE_PATH")
    load = mujoco.MjModel.from_xml_path if file else mujoco.MjModel.from_xml_string
    plain = load(str(file or CUBES))
    plain.opt.solver, plain.opt.tolerance = mujoco.mjtSolver.mjSOL_NEWTON, 1e-15
    plain.opt.iterations, plain.opt.ls_iterations = 100, 50
    plain.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    data, rng = mujoco.MjData(plain), default_rng(0)
    data.ctrl[:] = 0.1 * rng.normal(size=plain.nu)
    data.qvel[:] = 0.1 * rng.normal(size=plain.nv)
    mujoco.mj_step(plain, data, round(0.6 / plain.opt.timestep))
    mujoco.mj_normalizeQuat(plain, data.qpos)
    with jax.enable_x64(True):
        model, start = mjx.put_model(plain), mjx.make_data(plain)
        start = start.replace(qacc_warmstart=jnp.array(data.qacc_warmstart))

        def next_state(step, x):
            qpos, qvel, ctrl = jnp.split(x, (plain.nq, plain.nq + plain.nv))
            after = step(model, start.replace(qpos=qpos, qvel=qvel, ctrl=ctrl))
            return jnp.concatenate([after.qpos, after.qvel])

        x = np.concatenate([data.qpos, data.qvel, data.ctrl])
        slopes = np.asarray(QUICK_JIT(jax.jacrev(partial(next_state, mjx_gradients.step)))(x))
        theirs = QUICK_JIT(jax.vmap(partial(next_state, mjx.step)))
        expected = differences(theirs, x)
        after = np.asarray(theirs(x[None]))[0]
    largest = np.abs(expected).max()
    assert_allclose(slopes, expected, rtol=0, atol=1e-5 * largest)
    if integrator == "RK4" or name in ("cubes", "barkour of MJX"):
        return
    rows, columns = 2 * plain.nv, 2 * plain.nv + plain.nu
    a, b = np.zeros((rows, rows)), np.zeros((rows, plain.nu))
    mujoco.mjd_transitionFD(plain, data, 1e-6, True, a, b, None, None)
    nq, inward = plain.nq, np.eye(x.size, columns)
    inward[:nq], inward[nq:] = 0, np.eye(x.size - nq, columns, plain.nv)
    inward[:nq, : plain.nv] = tangents(plain, data.qpos)
    outward = np.linalg.pinv(tangents(plain, after[:nq]))
    motion = slopes @ inward
    ours = np.concatenate([outward @ motion[:nq], motion[nq:]])
    assert_allclose(ours, np.hstack([a, b]), rtol=0, atol=1e-5 * largest)


def visible(*names):
    """Return the folders and files of packages and of all that they require."""
    paths, needs = set(), [(x, "") for x in names]
    for name, extra in needs:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            package = importlib.metadata.distribution(name)
            tops = {x.parts[0] for x in package.files} - {"..", "__pycache__"}
            paths |= {package.locate_file(x) for x in tops}
            for line in package.requires or ():
                need = re.match(r"([\w.-]+)(?:\[(\w+))?", line).groups(default="")
                needed = "extra ==" not in line or f'extra == "{extra}"' in line
                if needed and need not in needs:
                    needs.append(need)
    return paths


def test_the_file_alone_is_a_module(tmp_path):
    """Copy it where only its four packages, and what they require, can be imported."""
    shutil.copy(mjx_gradients.__file__, tmp_path)
    for path in visible("numpy", "jax", "mujoco", "mujoco-mjx"):
        (tmp_path / path.name).symlink_to(path)
    assert not (tmp_path / "rps_jax").exists()
    code = "import sys; sys.path.append(sys.argv[1]); import mjx_gradients as m; print(m.step)"
    command = [sys.executable, "-I", "-S", "-B", "-c", code, tmp_path]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.stdout.startswith("<function step"), result.stderr


def test_the_package_of_the_file_has_the_versions_of_this_package():
    single, whole = (
        tomllib.loads((ROOT / folder / "pyproject.toml").read_text())["project"]
        for folder in ("docs/mjx_gradients", ".")
    )
    assert set(single["dependencies"]) <= set(whole["dependencies"])
    assert single["requires-python"].startswith(whole["requires-python"].partition(",")[0])


def test_models_without_derivatives_are_refused(body):
    with pytest.raises(ValueError, match=r"model = mjmodel .*put_model\(model, impl='jax'"):
        mjx_gradients.solve(body.plain, body.data)


def test_third_derivatives_are_refused():
    case = Case(PENDULUM, "pyramidal")
    third = jax.jacfwd(jax.hessian(partial(case.next_state, mjx_gradients.step)))
    with pytest.raises(NotImplementedError, match="order = 3 is not allowed"):
        jax.eval_shape(third, np.array([0.5, 0.3, 1.0], np.float32))
