"""MuJoCo's equations for one free object on the ground before the base.

MJX solves any scene. Here the scene is fixed. The base is a velocity source, so that only the six
accelerations of the object are unknown, and three more of a base with a limited force. The object
touches the ground with the corners of its lower face, and the base along two lines. MuJoCo's soft
contacts, two cones, Newton solver and Euler rule are written out in scalars for this case, so that
a compiler can keep a whole world in registers.
"""

from __future__ import annotations

import functools
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_policies

from rps_jax.engines import device, native
from rps_jax.engines.base import ControlPeriod, Driven, Engine, Motion
from rps_jax.engines.fused.contacts import (
    Body,
    Corners,
    DrivenBase,
    State,
    nearest_walls,
    on_base,
    on_ground,
    on_wall,
)
from rps_jax.engines.fused.newton import SOLUTION, Base, Problem, accelerations, wrench_on_base
from rps_jax.geometry import solid
from rps_jax.geometry import vectors as sp
from rps_jax.geometry.arrays import Entries, Pytree
from rps_jax.geometry.vectors import Vec
from rps_jax.robot.base import Tyres, push
from rps_jax.robot.robot import Robot
from rps_jax.world import scene
from rps_jax.world.physics import Physics
from rps_jax.world.scene import JOINTS, OFF_CENTRE, WorldInputs

_SAVED = checkpoint_policies.save_only_these_names(SOLUTION)


def _split(array: Entries, at: slice = slice(None)) -> Entries:
    return tuple(array[..., i] for i in range(array.shape[-1]))[at]


def from_mujoco(
    body: Body, motion: Motion, robot: Robot | None = None, force: bool = False
) -> State:
    """Return the state of worlds from MuJoCo's; with `force`, the wrench on the base is summed."""
    qpos, qvel, warmstart, integral = motion
    free, spin = _split(qpos, JOINTS.object), _split(qvel, slice(6, 9))
    com, axes = _split(body.p_object_com), _split(body.q_object_body)
    m = sp.matrix(free[3:])
    v = sp.add(_split(qvel, slice(3, 6)), sp.to_world(m, sp.cross(spin, com)))
    driven = None
    if robot is not None:
        v_base, a_base = (_split(x, JOINTS.base) for x in (qvel, warmstart))
        driven = DrivenBase(v_base, a_base, _split(integral))
    return State(
        base=_split(qpos, JOINTS.base),
        p=sp.add(free[:3], sp.to_world(m, com)),
        q=sp.times(free[3:], axes),
        v=v,
        w=sp.to_body(sp.matrix(axes), spin),
        a=_split(warmstart, slice(3, 6)),
        alpha=_split(warmstart, slice(6, 9)),
        driven=driven,
        wrench_sum=_split(jnp.zeros_like(qpos[..., JOINTS.base])) if force else None,
    )


def to_mujoco(body: Body, state: State, twist: Vec) -> Motion:
    """Return MuJoCo's state of worlds after a period at `twist`: the inverse of `from_mujoco`."""
    com, axes = _split(body.p_object_com), _split(body.q_object_body)
    q = sp.times(state.q, (axes[0], -axes[1], -axes[2], -axes[3]))
    m = sp.matrix(q)
    spin = sp.to_world(sp.matrix(axes), state.w)
    v = sp.sub(state.v, sp.to_world(m, sp.cross(spin, com)))
    p = sp.sub(state.p, sp.to_world(m, com))
    if state.driven is None:
        turn = sp.turn(state.base[2])
        base = sp.turned(turn, twist)
        last, integral = tuple(jnp.zeros_like(x) for x in state.base), None
    else:
        base, last, integral = state.driven
    return Motion(
        jnp.stack([*state.base, *p, *q], axis=-1),
        jnp.stack([*base, *v, *spin], axis=-1),
        jnp.stack([*last, *state.a, *state.alpha], axis=-1),
        None if integral is None else jnp.stack(integral, axis=-1),
    )


def step(
    body: Body,
    state: State,
    twist: Vec,
    physics: Physics,
    robot: Robot | None = None,
    solution: list[Vec] | None = None,
) -> State:
    """Compute one step of MuJoCo's semi-implicit Euler rule with the base at `twist`.

    A `robot` with a limited force is pushed towards it. `twist` [m/s, m/s, rad/s] is in the base's
    frame. The derivatives of a step whose accelerations are known need no solver: `solution`.
    """
    m, dt, driven = sp.matrix(state.q), physics.timestep, state.driven
    contacts = [on_ground(body, state, m, physics), on_base(body, state, m, twist, physics)]
    contacts += [on_wall(body, state, m, wall, physics) for wall in body.walls or ()]
    turn = sp.turn(state.base[2])
    base = Base()
    if robot is not None and driven is not None:
        force, integral = push(robot, driven.integral, twist, driven.v, turn, dt)
        if body.gravity is not None:
            force = sp.add(force, sp.scale(robot.mass, (*body.gravity[:2], 0.0)))
        is_omni = robot.drive == "omni"
        tyres = None if is_omni else Tyres.of(robot, driven.v, turn, dt)
        base = Base((robot.mass, robot.mass, robot.inertia), force, tyres)
        driven = driven._replace(integral=integral)
    x = accelerations(Problem.of(body, state, m, contacts, base), physics, solution)
    a, alpha, *b = x
    if driven is not None:
        driven = driven._replace(v=sp.add(driven.v, sp.scale(dt, b[0])), a=b[0])
    wrench_sum = state.wrench_sum
    if wrench_sum is not None:
        arm = sp.add(contacts[1].r[:2], sp.sub(state.p[:2], state.base[:2]))
        wrench_sum = sp.add(wrench_sum, wrench_on_base(contacts[1], arm, x, turn, physics))
    v = sp.add(state.v, sp.scale(dt, a))
    w = sp.add(state.w, sp.scale(dt, sp.to_body(m, alpha)))
    angle = sp.scale(dt, w)
    half = 0.5 * sp.norm(angle)
    # Taylor series: the angles of one step are small.
    sinc = 0.5 * (1 - half * half / 6)
    q = sp.times(state.q, (1 - half * half / 2 + half**4 / 24, *sp.scale(sinc, angle)))
    length = jax.lax.rsqrt(sp.dot(q, q))
    velocity = sp.turned(turn, twist) if driven is None else driven.v
    base, p = sp.add(state.base, sp.scale(dt, velocity)), sp.add(state.p, sp.scale(dt, v))
    return State(base, p, sp.scale(length, q), v, w, a, alpha, driven, wrench_sum)


class FusedStage(NamedTuple):
    """Stage of the fused engine, whose worlds share nothing."""

    native = True
    engine = "fused"

    def drive(self, fields: Body, motion: Motion, period: ControlPeriod) -> Driven:
        """Step worlds for one control period: a batch (B,), or one world.

        A batch is stepped by a function of C, or a kernel on an NVIDIA GPU, where they can be
        compiled, and so are the derivatives; elsewhere XLA compiles it.
        """

        def steps(*inputs: Pytree) -> Driven:
            return _drive(*inputs, physics=period.physics, force=period.force)

        def with_solutions(inputs: Pytree, solutions: Pytree) -> tuple[Driven, Pytree]:
            driven = steps(*inputs, solutions)
            return driven._replace(solutions=None), driven.solutions

        inputs = fields, motion, period.twists, period.robot
        if motion.qpos.ndim != 2:
            return steps(*inputs, period.solutions)
        return native.batched(with_solutions, steps, has_residuals=True)(*inputs)


def _drive(
    body: Body,
    motion: Motion,
    twist: Vec,
    robot: Robot | None,
    solutions: Pytree = None,
    *,
    physics: Physics,
    force: bool,
) -> Driven:
    """Step a batch of worlds, or one world, for one control period."""
    scalars = split_entries(body)

    start = from_mujoco(body, motion, robot, force)
    if scalars.walls is not None:
        corners = _split(jnp.moveaxis(body.vertices, -2, 0))
        near = nearest_walls(scalars.walls, start.p, start.q, corners)
        scalars = scalars._replace(walls=near)

    # Derivatives compute each step again, without its solver.
    @partial(jax.checkpoint, prevent_cse=False, policy=_SAVED)
    def next_state(state: State, solution: list[Vec] | None = None) -> State:
        return step(scalars, state, twist, physics, robot, solution)

    def solve(state: State, solution: list[Vec] | None) -> tuple[State, list[Vec]]:
        state = next_state(state, solution)
        return state, state.accelerations

    if solutions is None:
        state = jax.lax.fori_loop(0, physics.substeps, lambda _, x: next_state(x), start)
    else:
        state, solutions = jax.lax.scan(solve, start, solutions or None, physics.substeps)
    wrench = state.wrench_sum and jnp.stack(state.wrench_sum, axis=-1) / physics.substeps
    return Driven(to_mujoco(body, state, twist), wrench, solutions)


def split_entries(body: Body) -> Body:
    """Return bodies (...) with each entry as a separate array, the input of `step`."""
    lists = ("feet", "foot_weight", "pads", "walls")
    leaves = body._replace(vertices=None, **dict.fromkeys(lists))
    entries = {
        name: _split(leaf) if jnp.ndim(leaf) > jnp.ndim(body.mass) else leaf
        for name, leaf in leaves._asdict().items()
        if leaf is not None
    }
    corners = _split(jnp.moveaxis(body.vertices, -2, 0))
    for name in lists:
        if (leaf := getattr(body, name)) is not None:
            entries[name] = _split(jnp.moveaxis(leaf, -2, 0))
    if body.vertices.shape[-2] == 1:
        return Body(vertices=tuple(x[0] for x in corners), **entries)
    return Body(vertices=Corners.of(corners), **entries)


# --- the engine ----------------------------------------------------------------------------------

_MAX_ON_PROCESSORS = 500  # trials that processors finish sooner than a GPU


class Fused(Engine):
    """MJX's equations, specialised to these scenes: the fastest engine on every device."""

    name = "fused"
    side_by_side = True
    modes = ("forward", "reverse")

    def stage(self, inputs: WorldInputs) -> tuple[FusedStage, Body]:
        """Return the stage, and the bodies (n, ...) of the worlds."""
        solids, (friction, physics, robots) = inputs.solids, inputs[2:5]
        com, axes = solids.p_object_com + OFF_CENTRE, solid.axes(solids)
        base_invweight, base_z = _base(physics)
        if robots.driven:
            # The mean over x, y and z of the acceleration by 1 N; along z the base is fixed.
            base_invweight = 2 / (3 * np.asarray(robots.mass, float))

        def lower(points: np.ndarray) -> np.ndarray:
            """Return points (n, N, 2) of the lower face in the body's frame."""
            z = np.broadcast_to(-solids.height[:, None, None] / 2, (*points.shape[:2], 1))
            return (np.concatenate([points, z], axis=-1) - com[:, None]) @ axes

        bodies = Body(
            mass=solids.mass,
            inertia=solids.inertia,
            p_object_com=com,
            q_object_body=solids.q_object_body,
            vertices=lower(solids.vertices),
            radius=solids.radius,
            height=solids.height,
            up=axes[:, 2],
            friction_ground=friction.ground,
            friction_robot=friction.robot,
            invweight=1 / solids.mass,
            base_invweight=np.broadcast_to(base_invweight, solids.mass.size),
            base_size=scene.base_size(robots, solids.mass.size),
            base_z=np.broadcast_to(base_z, (solids.mass.size, 2)),
            gravity=inputs.surroundings.slope,
            boundary=inputs.surroundings.boundary,
        )
        if solids.feet is not None:
            feet = lower(solids.feet[..., :2])
            weights = solids.feet[..., 2:]
            weights = np.sign(weights) if solids.pads is None else weights
            bodies = bodies._replace(feet=feet, foot_weight=weights, pads=solids.pads)
        around = inputs.surroundings
        if around.walls is not None:
            ends = around.walls.reshape(inputs.num_worlds, -1, 4)
            bodies = bodies._replace(walls=ends, friction_wall=around.friction_wall)
        return FusedStage(), bodies

    def slots(self, backend: str) -> int:
        """Return the number of worlds that one worker steps at once."""
        return 64 if backend == "cpu" else 32768

    def suits_processors(self, trials: int | None) -> bool:
        """Whether there are few trials and a C compiler: a GPU takes some 5 s to start."""
        few = trials is not None and trials <= _MAX_ON_PROCESSORS
        return few and device.find_compiler() is not None


@functools.cache
def _base(physics: Physics) -> tuple[float, np.ndarray]:
    """Return the inverse weight [1/kg] of the base, and the heights (2,) [m] of its edges."""
    model = scene.load("box", physics).physics
    body, geom = model.body("base"), model.geom("base")
    z = geom.pos[2] + geom.size[2] * np.array([-1.0, 1.0])
    return model.body_invweight0[body.id, 0], z


ENGINE = Fused()
