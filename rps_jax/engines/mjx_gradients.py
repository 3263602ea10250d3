"""MJX with exact derivatives through contacts, limits and friction, for any MJX model.

`jax.grad` of `mjx.step` fails: its solver is a `while_loop`. Here the solver runs without
derivatives. Its result minimises MuJoCo's convex cost, so the gradient of the cost is zero there,
and the implicit function theorem gives first and second derivatives. Values are those of MJX, bit
for bit. This file needs numpy, jax, mujoco and mujoco-mjx alone: copy it.

    step = mjx_gradients.step  # instead of mjx.step
    jax.grad(lambda qvel: step(model, data.replace(qvel=qvel)).qpos[0])(data.qvel)
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name, checkpoint_policies
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

with contextlib.redirect_stdout(io.StringIO()):  # MJX reports on the console that warp is absent
    from mujoco import mjx
    from mujoco.mjx._src import math, solver, types

SOLUTION = "mjx_solution"  # name of the solver's results, for policies of `jax.checkpoint`
SAVED = checkpoint_policies.save_only_these_names(SOLUTION)  # policy of a `jax.checkpoint` of steps
_ITERATIONS = 100  # MuJoCo's default; after fewer, derivatives are those of a refined solution
_ORDERS = 2  # of derivatives
_SMALL = 1e-4  # [rad] half angle of a step below which its sine is a series


def _primitive(name: str, jvp: Any) -> Any:
    """Return a primitive whose value is its first input, with a rule for derivatives.

    Reverse mode of a `scan` drops the rules of `jax.custom_jvp`, which second derivatives need.
    """
    primitive = Primitive(name)
    primitive.def_impl(lambda *x, **_: x[0])
    primitive.def_abstract_eval(lambda *x, **_: x[0])
    mlir.register_lowering(primitive, lambda _, *x, **__: x[:1])
    batching.defbroadcasting(primitive)
    ad.primitive_jvps[primitive] = jvp
    return primitive


def _zero(x: Any) -> ad.Zero:
    return ad.Zero(jax.typeof(x).to_tangent_aval())


def _jvp_of_constant(primals: Any, _: Any, orders: int) -> Any:
    if not orders:
        raise NotImplementedError("order = 3 is not allowed: MJX has first and second derivatives.")
    return _constant.bind(*primals, orders=orders - 1), _zero(primals[0])


# The first input, with the derivatives of the second.
_twins = _primitive("twins", lambda x, dx: (_twins.bind(*x), dx[1]))
# The first input without its first derivative by what the second depends on; with higher ones.
_held = _primitive("held", lambda x, _: (x[0], _zero(x[0])))
# The first input, a constant; refuses more derivatives than `orders` by what the second depends on.
_constant = _primitive("constant", _jvp_of_constant)


def solve(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Solve for the constraint forces as MJX does, with first and second derivatives in both modes.

    Supported are the solvers Newton and CG, both cones, contacts of all dimensions, limits,
    equality constraints and friction loss. Where a constraint switches, as when a contact appears
    or starts to slide, the derivative is one-sided.

    Derivatives are those of the minimum: if `model.opt.iterations` is below 100, Newton's method
    continues from the returned accelerations, which stay MJX's. After one iteration, derivatives
    are those of this iteration, as MJX has them.

    Args:
      model: of MJX, with its implementation in JAX.
      data: after `make_constraint`, with `qfrc_smooth`, `qacc_smooth` and `qacc_warmstart`.

    Returns:
      The data with `qacc` [m/s^2, rad/s^2], `qfrc_constraint` and `efc_force` [N, N m].

    Raises:
      ValueError: the model is not of MJX, or its implementation is not in JAX.
    """
    _check(model)
    if model.opt.iterations == 1:
        return solver.solve(model, data)
    fixed_model, fixed = jax.lax.stop_gradient((model, data))
    solved = solver.solve(fixed_model, fixed)
    results = solved.qacc, solved.qfrc_constraint, solved._impl.efc_force
    qacc, force, rows = checkpoint_name(results, SOLUTION)
    minimum = qacc
    if model.opt.iterations < _ITERATIONS:
        options: Any = {"opt.solver": types.SolverType.NEWTON, "opt.iterations": _ITERATIONS}
        refined: Any = fixed_model.tree_replace(options)
        minimum = solver.solve(refined, fixed.replace(qacc_warmstart=qacc)).qacc
        minimum = checkpoint_name(minimum, SOLUTION)

    def gradient(x: jax.Array) -> jax.Array:
        at = solver.Context.create(model, data.replace(qacc=x), grad=False)
        return at.Ma - data.qfrc_smooth - at.qfrc_constraint

    root = _constant.bind(minimum, gradient(minimum), orders=_ORDERS)
    for _ in range(_ORDERS):  # each step of Newton's method is right to one more order
        held = _held.bind(root, root)
        slope = gradient(held)
        matrix = jax.jacfwd(gradient)(held)
        matrix = _held.bind(matrix, jnp.broadcast_to(slope, matrix.shape))
        newton = jax.scipy.linalg.solve(matrix, slope, assume_a="pos")
        root = _twins.bind(minimum, held - newton)
    qacc = _twins.bind(qacc, root)
    at = solver.Context.create(model, data.replace(qacc=root), grad=False)
    # The terms of J^T f are stiff: they would cancel in its sum with qfrc_smooth.
    force = _twins.bind(force, at.Ma - data.qfrc_smooth)
    rows = _twins.bind(rows, at.efc_force)
    fields: Any = {"qacc": qacc, "qfrc_constraint": force, "_impl.efc_force": rows}
    return data.tree_replace(fields)  # pyright: ignore[reportReturnType]


def quat_integrate(q: jax.Array, v: jax.Array, dt: jax.Array) -> jax.Array:
    """Return the quaternion (4,) after a turn by `v` (3,) [rad/s] as MJX does, with derivatives.

    Those of MJX are zero below 1e-8 rad/s, as of a body at rest.
    """
    half = 0.5 * dt * v
    square = half @ half
    small = square < _SMALL**2
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    cosine = jnp.where(small, 1 - square / 2, jnp.cos(angle))
    sinc = jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)
    turn = jnp.concatenate([cosine[None], sinc * half])
    return _twins.bind(math.quat_integrate(q, v, dt), math.normalize(math.quat_mul(q, turn)))


def _forward() -> Any:
    """Return a second `forward` module of MJX that calls functions of this file."""
    spec: Any = importlib.util.find_spec("mujoco.mjx._src.forward")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    vars(module).update(
        solver=SimpleNamespace(solve=solve),
        math=SimpleNamespace(**vars(math) | {"quat_integrate": quat_integrate}),
    )
    return module


forward = _forward()


def step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute one step as `mjx.step` does, with first and second derivatives: see `solve`.

    All integrators are supported. Kinematics, collisions, sensors and actuators have MJX's
    derivatives.

    Raises:
      ValueError: the model is not of MJX, or its implementation is not in JAX.
    """
    _check(model)
    return forward.step(model, data)


def _check(model: Any) -> None:
    impl = getattr(getattr(model, "impl", None), "name", type(model).__name__)
    if impl != types.Impl.JAX.name:
        raise ValueError(
            f"model = {impl.lower()} is not allowed: derivatives need "
            "mujoco.mjx.put_model(model, impl='jax')."
        )
