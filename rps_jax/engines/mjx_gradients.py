"""MJX with exact derivatives through contacts, limits and friction, for any MJX model.

`jax.grad` of `mjx.step` fails: its solver is a `while_loop`. Here the solver runs without
derivatives. Its result minimises MuJoCo's convex cost, so the gradient g of the cost is zero there,
and the implicit function theorem gives the derivative of the accelerations: minus the inverse of
the Hessian, which MJX's Newton solver builds, times dg. Values are those of MJX, bit for bit.

    step = rps_jax.engines.mjx_gradients.step  # instead of mjx.step
    jax.grad(lambda qvel: step(model, data.replace(qvel=qvel)).qpos[0])(data.qvel)
"""

from __future__ import annotations

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name, checkpoint_policies

from rps_jax import errors
from rps_jax.engines.fused.newton import SOLUTION
from rps_jax.engines.mjx_colliders import forward, math, mjx, sensor, solver, types

T = TypeVar("T")
SAVED = checkpoint_policies.save_only_these_names(SOLUTION)  # policy of a `jax.checkpoint` of steps
_SMALL = 1e-4  # [rad] half angle of a step below which its sine is a series


@jax.custom_jvp
def with_derivative(value: T, twin: T) -> T:
    """Return `value`, with the derivative of `twin`."""
    return value


@with_derivative.defjvp
def _(primals: Any, tangents: Any) -> Any:
    return primals[0], tangents[1]


def solve(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Solve for the constraint forces as MJX does, with derivatives in both modes.

    Supported are the solvers Newton and CG, both cones, contacts of all dimensions, limits,
    equality constraints and friction loss. Where a constraint switches, as when a contact appears
    or starts to slide, the derivative is one-sided. Second derivatives do not exist. Far from the
    minimum, after too few iterations, the derivative is inexact.

    Args:
      model: of MJX, with its implementation in JAX.
      data: after `make_constraint`, with `qfrc_smooth`, `qacc_smooth` and `qacc_warmstart`.

    Returns:
      The data with `qacc` [m/s^2, rad/s^2], `qfrc_constraint` and `efc_force` [N, N m].

    Raises:
      InputError: the model is not of MJX, or its implementation is not in JAX.
    """
    _check(model)
    held_model, held = jax.lax.stop_gradient((model, data))
    solved = solver.solve(held_model, held)
    results = solved.qacc, solved.qfrc_constraint, solved._impl.efc_force
    minimum, force, rows = checkpoint_name(results, SOLUTION)
    newton: Any = {"opt.solver": types.SolverType.NEWTON}  # which has a Hessian
    models: Any = [x.tree_replace(newton) for x in (model, held_model)]
    model, held_model = models
    at = solver.Context.create(model, data.replace(qacc=minimum), grad=False)
    gradient = at.Ma - data.qfrc_smooth - at.qfrc_constraint
    zero = jnp.zeros_like(gradient)
    at = jax.lax.stop_gradient(at).replace(Ma=gradient, qfrc_constraint=zero)
    move = solver._update_gradient(held_model, held.replace(qfrc_smooth=zero), at).Mgrad
    qacc = with_derivative(minimum, -move)
    at = solver.Context.create(model, data.replace(qacc=qacc), grad=False)
    # The terms of J^T f are stiff: they would cancel in its sum with qfrc_smooth.
    force = with_derivative(force, at.Ma - data.qfrc_smooth)
    rows = with_derivative(rows, at.efc_force)
    fields: Any = {"qacc": qacc, "qfrc_constraint": force, "_impl.efc_force": rows}
    return data.tree_replace(fields)  # pyright: ignore[reportReturnType]


def step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute one step as `mjx.step` does, with derivatives in both modes: see `solve`.

    Kinematics, collisions, sensors and actuators have MJX's derivatives.

    Raises:
      InputError: the model is not of MJX, its implementation is not in JAX, or its integrator is
        not Euler or implicitfast.
    """
    _check(model)
    euler, implicit = types.IntegratorType.EULER, types.IntegratorType.IMPLICITFAST
    if model.opt.integrator not in (euler, implicit):
        name = types.IntegratorType(model.opt.integrator).name
        raise errors.not_allowed("integrator", name, "derivatives need Euler or implicitfast")
    data = forward.fwd_position(model, data)
    data = sensor.sensor_pos(model, data)
    data = forward.fwd_velocity(model, data)
    data = sensor.sensor_vel(model, data)
    data = forward.fwd_actuation(model, data)
    data = forward.fwd_acceleration(model, data)
    if data._impl.efc_J.size:  # pyright: ignore[reportAttributeAccessIssue]
        data = sensor.sensor_acc(model, solve(model, data))
    else:
        data = data.replace(qacc=data.qacc_smooth)
    integrate = forward.euler if model.opt.integrator == euler else forward.implicit
    return with_turns(model, data, integrate(model, data))


def with_turns(model: mjx.Model, data: mjx.Data, stepped: mjx.Data) -> mjx.Data:
    """Return the data after a step, with derivatives of quaternions by any angular velocity.

    Those of MJX are zero below 1e-8 rad/s, as of a body at rest.
    """
    qpos, free = stepped.qpos, model.jnt_type == types.JointType.FREE
    for joint in np.flatnonzero(free | (model.jnt_type == types.JointType.BALL)):
        q, v = (x[joint] + 3 * free[joint] for x in (model.jnt_qposadr, model.jnt_dofadr))
        half = 0.5 * model.opt.timestep * stepped.qvel[v : v + 3]
        square = half @ half
        small = square < _SMALL**2
        angle = jnp.sqrt(jnp.where(small, 1.0, square))
        cosine = jnp.where(small, 1 - square / 2, jnp.cos(angle))
        sinc = jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)
        turn = jnp.concatenate([cosine[None], sinc * half])
        quat = math.normalize(math.quat_mul(data.qpos[q : q + 4], turn))
        qpos = qpos.at[q : q + 4].set(with_derivative(qpos[q : q + 4], quat))
    return stepped.replace(qpos=qpos)


def _check(model: Any) -> None:
    impl = getattr(getattr(model, "impl", None), "name", type(model).__name__)
    if impl != types.Impl.JAX.name:
        rule = "derivatives need mujoco.mjx.put_model(model, impl='jax')"
        raise errors.not_allowed("model", impl.lower(), rule)
