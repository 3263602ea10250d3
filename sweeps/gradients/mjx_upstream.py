"""Reproducer and idea of a patch: exact derivatives of `mjx.step` through contacts and limits.

It needs mujoco, mujoco-mjx, jax and numpy. MJX's solver is a `while_loop`, so `jax.grad` fails, and
forward mode differentiates the iterations. `implicit_solve` runs the same solver without
derivatives. At its result the gradient g of MuJoCo's cost is zero, so the derivative of `qacc` is
-H^-1 dg, with the Hessian H of the Newton solver. Values do not change by a bit.

    python sweeps/gradients/mjx_upstream.py
"""

from functools import partial
from importlib import resources

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import solver
from mujoco.mjx._src.types import SolverType

BOX = """<mujoco><option timestep="0.005"/><worldbody><geom type="plane" size="0 0 1"/>
<body pos="0 0 0.099"><freejoint/><geom type="box" size="0.2 0.15 0.1" mass="2" friction="0.6"/>
</body></worldbody></mujoco>"""
HUMANOID = resources.files("mujoco") / "mjx/test_data/humanoid/humanoid.xml"
MODELS = {"box on a plane": BOX, "humanoid of MJX's tests": HUMANOID.read_text()}
CONES = {"elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC, "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL}
plain_solve = solver.solve


@jax.custom_jvp
def with_derivative(value, twin):
    """Return `value`, with the derivative of `twin`."""
    return value


@with_derivative.defjvp
def _(primals, tangents):
    return primals[0], tangents[1]


def implicit_solve(m, d):
    """Replace `solver.solve`."""
    m_held, d_held = jax.lax.stop_gradient((m, d))
    solved = plain_solve(m_held, d_held)
    m, m_held = (x.tree_replace({"opt.solver": SolverType.NEWTON}) for x in (m, m_held))
    ctx = solver.Context.create(m, d.replace(qacc=solved.qacc), grad=False)
    grad = ctx.Ma - d.qfrc_smooth - ctx.qfrc_constraint  # zero at the minimum
    zero = jnp.zeros_like(grad)
    ctx = jax.lax.stop_gradient(ctx).replace(Ma=grad, qfrc_constraint=zero)
    step = solver._update_gradient(m_held, d_held.replace(qfrc_smooth=zero), ctx).Mgrad
    qacc = with_derivative(solved.qacc, -step)
    ctx = solver.Context.create(m, d.replace(qacc=qacc), grad=False)
    force = with_derivative(solved.qfrc_constraint, ctx.Ma - d.qfrc_smooth)
    rows = with_derivative(solved._impl.efc_force, ctx.efc_force)
    return d.tree_replace({"qacc": qacc, "qfrc_constraint": force, "_impl.efc_force": rows})


def load(name, cone):
    """Return model, data and a state: a sliding box, or a humanoid that falls from a squat."""
    model = mujoco.MjModel.from_xml_string(MODELS[name])
    model.opt.cone, model.opt.tolerance = CONES[cone], 1e-15
    model.opt.iterations, model.opt.ls_iterations = 100, 50
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.qpos[2] -= 0.002
    data.qpos[3:7] += 1e-3 * random.normal(size=4)  # symmetric states are at switches
    data.qvel[:] = 0.1 * random.normal(size=model.nv)
    data.qvel[0] += 1.0
    state = np.concatenate([data.qpos, data.qvel, 0.1 * random.normal(size=model.nu)])
    return mjx.put_model(model), mjx.make_data(model), state


def next_state(step, model, data, x):
    """Return the state (qpos, qvel, ctrl) after one step."""
    q, v, u = jnp.split(x, [model.nq, model.nq + model.nv])
    data = step(model, data.replace(qpos=q, qvel=v, ctrl=u))
    return jnp.concatenate([data.qpos, data.qvel, u])


def measure(step, name, cone, counts, sizes=(1e-5, 1e-6, 1e-7)):
    """Return the error of the Jacobian after each count of steps, relative to its largest entry.

    Central differences are those of `mjx.step` with MJX's solver, with the best step of `sizes`:
    small ones magnify the solver's error, and large ones cross switches. Also returns the share of
    finite entries of a step from rest, in forward mode through the solver's iterations.
    """
    model, data, start = load(name, cone)
    patched, solver.solve = solver.solve, plain_solve
    plain = partial(next_state, mjx.step, model, data)
    rest = np.where(np.arange(start.size) < model.nq, start, 0.0)
    forward = np.asarray(jax.jit(lambda x: jax.jvp(plain, (x,), (start,))[1])(rest))
    batch = jax.jit(jax.vmap(plain))
    unit = np.concatenate([np.eye(start.size), -np.eye(start.size)])
    sides = {h: start + h * unit for h in sizes}
    batch(sides[sizes[0]]).block_until_ready()
    solver.solve = patched
    ours = partial(next_state, step, model, data)
    jacobian = jax.jit(lambda x: (jax.jacrev(ours)(x), ours(x)))
    product, x, errors = np.eye(start.size), start, {}
    for i in range(1, max(counts) + 1):
        slope, x = jacobian(x)
        product = np.asarray(slope) @ product
        sides = {h: batch(x) for h, x in sides.items()}
        if i in counts:
            pairs = {h: np.split(np.asarray(x), 2) for h, x in sides.items()}
            slopes = [(up - down).T / (2 * h) for h, (up, down) in pairs.items()]
            errors[i] = min(np.abs(product - x).max() / np.abs(x).max() for x in slopes)
    return errors, np.isfinite(forward).mean()


def failure(name, cone):
    """Return the error of `jax.grad` through `mjx.step` with MJX's solver."""
    model, data, start = load(name, cone)
    try:
        jax.eval_shape(jax.grad(lambda x: next_state(mjx.step, model, data, x).sum()), start)
    except ValueError as error:
        return f"{type(error).__name__}: {str(error).partition('.')[0]}"
    return ""


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print("jax.grad of mjx.step:", failure("box on a plane", "elliptic"))
    solver.solve = implicit_solve
    for name in MODELS:
        for cone in CONES:
            errors, finite = measure(mjx.step, name, cone, (1, 100))
            words = ", ".join(f"{count} steps {error:.1e}" for count, error in errors.items())
            print(
                f"{name}, {cone}: {words}; MJX in forward mode, from rest: {finite:.0%} finite",
                flush=True,
            )
