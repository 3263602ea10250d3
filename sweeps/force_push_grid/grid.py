"""Force Push on its authors' own ground: 243 pushes of each of their two sliders along a path.

Heins and Schoellig (2024) push a box and a cylinder of 1 kg, 1 m wide and 0.12 m high, along the
x axis with one point, at 0.1 m/s for 300 s from the first contact: 3 moments of inertia, 3 contact
frictions, 3 lateral offsets of the slider, 3 of its angles and 3 points of contact. A push fails
whose point is 2 m from the slider's middle, or feels less than 1 N for 20 s. This is the grid of
their script `pyb_simulation_many.py`, with the law `force_push_published` for their controller.
Beside it stands the open loop of their experiments, which is back to the path by -k_y Delta alone.

What differs from theirs: MuJoCo's equations for PyBullet's, in steps of 5 ms for 1 ms. A square
base of 2 cm that never turns for a sphere of radius 5 cm on two prismatic joints; its contact spans
the heights 0.06 to 0.12 m where the sphere's is at 0.06 m. No friction of a contact is 0.001, since
MuJoCo's cones need some. The slider stands on the points on which this package's engines stand
solids: a box on its corners, a cylinder on three points of its rim.
"""

from __future__ import annotations

import itertools
import math
import time
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import Details, Law, Robot, Rules, Setting, Twist
from rps_jax.control.laws import force_push_published as force_push
from rps_jax.control.laws.force_push import steer
from rps_jax.geometry import planar, polyline, solid
from rps_jax.geometry.solid import Solid
from rps_jax.laws import resolve_law
from rps_jax.physics import FRICTION, EngineName, Physics
from rps_jax.robot.base import LoadCell, Odometry
from rps_jax.robot.shell import Boards
from rps_jax.trials import trial
from rps_jax.trials.progress import Progress, ProgressCallback, no_progress
from rps_jax.trials.trial import ControlLoop, Shift, Snapshot, Trial
from rps_jax.trials.worlds import build
from rps_jax.world.scene import JOINTS, WorldInputs
from rps_jax.worlds import Case, Polyline
from sweeps.study_base import Rows

SliderName = Literal["box", "cylinder"]
SLIDERS: tuple[SliderName, ...] = get_args(SliderName)
LawName = Literal["force_push", "open_loop"]
LAWS: tuple[LawName, ...] = get_args(LawName)
# Their controller, of their simulations: a gain k_y of 0.1 and their full speed.
PARAMS: Any = resolve_law("force_push_published")[1]._replace(
    k_y=0.1, k_omega=0.0, k_f=0.003, v_max=0.1, d_success=1e-6
)
INERTIAS = ("half", "even", "greatest")  # of a slider that is even, and with its mass at the edge
FRICTIONS = (0.0, 0.5, 1.0)  # [1] of the contact
LATERALS = (-0.4, 0.0, 0.4)  # [m] of the slider's middle, left of the path
ANGLES = (-math.pi / 8, 0.0, math.pi / 8)  # [rad] of the slider, counter-clockwise
CONTACTS = (-0.4, 0.0, 0.4)  # [m] along the slider's side, from its middle
DIMS = ("inertia", "friction", "lateral", "angle", "contact")
_VALUES = (INERTIAS, FRICTIONS, LATERALS, ANGLES, CONTACTS)
DURATION = 300.0  # [s] from the first contact
GROUND = 0.25  # [1] friction of the slider with the ground
PHYSICS = Physics(timestep=0.005, control_period=0.01)

_MASS, _HALF, _HEIGHT = 1.0, 0.5, 0.12  # [kg, m, m] of both sliders
_BEHIND = 0.5  # [m] of the pusher behind the point of contact, at the start
_MAX_DISTANCE, _SILENT = 2.0, 20.0  # [m, s] at which a push has failed
_LEAST_FRICTION = 1e-3  # [1]
_LEAD, _END, _ARC = 3.0, 100.0, 37  # [m] of a path before its turn and in all; points of a turn
_REACH, _TANGENT = 1.0, 0.05  # [m] in which the nearest point is sought; beside it, of a direction
_POINT = 0.01  # [m] half length and width of the base
_SEGMENT, _LOOK = 1000, 50  # control steps of a call of the program, and between two looks
_ROBOT = Robot(_POINT, _POINT, (Boards("front", 1, 2 * _POINT / 3),))


def curve(radius: float, length: float) -> np.ndarray:
    """Return the vertices (N, 2) [m] of a path: 3 m ahead, a quarter of a circle, straight on.

    The authors' script has a radius of 2 m. An infinite radius is the x axis.
    """
    if math.isinf(radius):
        return np.array([[0.0, 0.0], [length, 0.0]])
    angle = np.linspace(0, math.pi / 2, _ARC)
    arc = (_LEAD, 0.0) + radius * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=-1)
    end = arc[-1] + (0.0, length - _LEAD - radius * math.pi / 2)
    return np.concatenate([[(0.0, 0.0)], arc, [end]])


class FollowingState(NamedTuple):
    """State of the controller and the criterion of its trial."""

    arc: jax.Array  # () [m] of the path, of the point nearest to the contact
    theta_p: jax.Array  # () [rad] of the last push, relative to the path
    pushed: jax.Array  # () bool: a force has been felt
    clock: jax.Array  # () [s] since then
    silent: jax.Array  # () [s] current time without a force
    longest: jax.Array  # () [s] without a force, the longest time


def build_law(
    law: LawName = "force_push", duration: float = DURATION, radius: float = math.inf
) -> Law:
    """Return a law of a point at the base's origin, which follows the `curve` of a radius [m].

    The point stops `duration` [s] after the first contact.
    """
    line: Any = jax.tree.map(jnp.asarray, Polyline.through(curve(radius, _END)))

    def init(params: Any) -> FollowingState:
        zero = jnp.zeros_like(jnp.asarray(params.v_max, float))
        return FollowingState(zero, zero, jnp.zeros((), bool), zero, zero, zero)

    def step(
        params: Any, state: FollowingState, observation: Any
    ) -> tuple[FollowingState, Twist, Details]:
        touch = observation.touch
        period, zero = touch.period, jnp.zeros_like(touch.yaw)
        f_world = -planar.rotate(touch.yaw, observation.f_robot)
        felt = planar.norm(f_world) >= params.f_min
        pushed = state.pushed | felt
        # As theirs, the nearest point moves only forward.
        arc, _ = polyline.nearest(line, touch.p_world_robot, state.arc, state.arc + _REACH)
        ahead, behind = (polyline.at_arc(line, arc + step) for step in (_TANGENT, -_TANGENT))
        theta_d = planar.direction(ahead - behind)
        normal = jnp.stack([-jnp.sin(theta_d), jnp.cos(theta_d)])
        offset = jnp.sum((touch.p_world_robot - polyline.at_arc(line, arc)) * normal)
        if law == "force_push":
            theta_f = planar.wrap(planar.direction(f_world) - theta_d)
            limit = params.converge * period
            theta_p = steer(params, state.theta_p, theta_f, offset, limit, felt)
        else:
            theta_p = -params.k_y * offset
        theta_p = jnp.where(pushed, theta_p, 0.0)
        angle = theta_d + theta_p
        v_world = params.v_max * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        v_robot = planar.rotate(-touch.yaw, force_push.yield_to_force(params, v_world, f_world))
        going = state.clock < duration
        v_robot = jnp.where(going, v_robot, 0.0)
        silent = jnp.where(felt, 0.0, state.silent + period)
        longest = jnp.where(going, jnp.maximum(state.longest, silent), state.longest)
        clock = state.clock + jnp.where(pushed, period, 0.0)
        state = FollowingState(arc, theta_p, pushed, clock, silent, longest)
        return state, Twist(v_robot[0], v_robot[1], zero), Details.from_obs(touch)

    exact = LoadCell(noise=0.0, time_constant=0.05, threshold=0.0)
    return Law(init, step, "force", cell=exact)


def moments(slider: SliderName) -> np.ndarray:
    """Return moments of inertia (3, 3) [kg m^2] about x, y, z, in the order of `INERTIAS`."""
    flat, up = _HALF**2, (_HEIGHT / 2) ** 2
    if slider == "box":  # the greatest: eight points at its corners
        greatest = np.array([flat + up, flat + up, 2 * flat])
        even = greatest / 3
    else:  # the greatest: a thin wall
        even = np.array([flat / 4 + up / 3, flat / 4 + up / 3, flat / 2])
        greatest = np.array([flat / 2 + up / 3, flat / 2 + up / 3, flat])
    return _MASS * np.stack([even / 2, even, greatest])


class Cells(NamedTuple):
    """The grid, flat: (243,) each, inertia slowest and contact fastest."""

    inertia: np.ndarray  # which of `INERTIAS`
    friction: np.ndarray  # [1]
    lateral: np.ndarray  # [m]
    angle: np.ndarray  # [rad]
    contact: np.ndarray  # [m]


def cells() -> Cells:
    """Return all combinations."""
    combinations = itertools.product(range(len(INERTIAS)), *_VALUES[1:])
    columns = (np.array(column) for column in zip(*combinations, strict=True))
    return Cells(*columns)


def starts(slider: SliderName, grid: Cells) -> np.ndarray:
    """Return initial positions (n, 10), with the pusher behind the point of contact."""
    at = np.stack([np.zeros_like(grid.lateral), grid.lateral], axis=-1)
    if slider == "box":
        c, s = np.cos(grid.angle), np.sin(grid.angle)
        point = np.stack([-_HALF * c - grid.contact * s, -_HALF * s + grid.contact * c], axis=-1)
    else:
        turn = -grid.contact / _HALF
        point = -_HALF * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    qpos = np.zeros((grid.angle.size, 10))
    qpos[:, :2] = at + point - (_BEHIND, 0.0)
    half = grid.angle / 2
    zero = np.zeros_like(half)
    pose = [*at.T, zero + _HEIGHT / 2, np.cos(half), zero, zero, np.sin(half)]
    qpos[:, JOINTS.object] = np.stack(pose, axis=-1)
    return qpos


def worlds(slider: SliderName, grid: Cells, engine: EngineName) -> Any:
    """Return the worlds of cells of the grid, on the host."""
    count = grid.angle.size
    half = np.full(count, _HALF)
    box = slider == "box"
    solids = Solid(
        vertices=solid.rectangles(half, half) if box else np.zeros((count, 1, 2)),
        radius=np.zeros(count) if box else half,
        height=np.full(count, _HEIGHT),
        mass=np.full(count, _MASS),
        p_object_com=np.zeros((count, 3)),
        inertia=moments(slider)[grid.inertia],
        q_object_body=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
    )
    friction = FRICTION["S1"]._replace(
        ground=np.full(count, GROUND), robot=np.maximum(grid.friction, _LEAST_FRICTION)
    )

    def repeated(tree: Any) -> Any:
        return jax.tree.map(lambda x: np.repeat(np.asarray(x, float)[None], count, axis=0), tree)

    built = build(
        np.arange(count),
        WorldInputs(slider, solids, friction, PHYSICS, _ROBOT),
        Setting(engine, PHYSICS),
        skin=repeated(Case(skin="ideal").sensor._replace(shell=_ROBOT.shell)),
        p_world_target=np.tile([90.0, 0.0], (count, 1)),  # never reached
        shift=repeated(Shift(p_robot=jnp.zeros(2))),
        qpos=starts(slider, grid),
        odometry=repeated(Odometry()),
        key=np.zeros((count, 2), np.uint32),
    )
    return built.with_params(PARAMS)


@jax.jit
def _record(*state: Any) -> tuple[Trial, Snapshot]:
    """Run `_SEGMENT` control steps of a batch; return also a snapshot of every `_LOOK` steps."""
    stage, worlds, params, trials, loop = state

    def interval(trials: Trial, _: None) -> tuple[Trial, Snapshot]:
        trials, snapshots = trial.unroll(stage, worlds, params, trials, loop, _LOOK)
        return trials, jax.tree.map(lambda x: x[0], snapshots)

    return jax.lax.scan(interval, trials, length=_SEGMENT // _LOOK)


def run_grid(
    name: LawName,
    slider: SliderName,
    engine: EngineName = "fused",
    duration: float = DURATION,
    radius: float = math.inf,
    *,
    callback: ProgressCallback = no_progress,
) -> xr.Dataset:
    """Run one law with a slider on the whole grid.

    Args:
      name: force_push, open_loop.
      slider: box, cylinder.
      engine: what steps them, of those that tell the contact's force to a compiled program.
      duration: [s] from the first contact.
      radius: [m] of the turn of the path.
      callback: called after every 10 s that were simulated.

    Returns:
      Over (inertia, friction, lateral, angle, contact): `success` by their criterion; `silent` [s],
      the longest time without a force; `apart` [m], the farthest the pusher was from the slider's
      middle; `deviation` [m] of the slider from the path at the end; and `completion` [1], the way
      along the path that was made good, of an ideal pusher's; `error_mean` and `error_95` [m], mean
      and 95 % quantile of the pusher's distance from the path, from the contact on.
    """
    grid, law = cells(), build_law(name, duration, radius)
    batch = worlds(slider, grid, engine)
    period, count = PHYSICS.control_period, grid.angle.size
    horizon = duration + 2 * _BEHIND / float(PARAMS.v_max)
    loop = ControlLoop(PHYSICS, Rules(horizon=2 * horizon, max_lost=1e6), law)
    trials = trial.start_all(*batch.inputs, np.ones(count, bool), law=law)
    line: Any = Polyline.through(curve(radius, _END))
    away_from = jax.jit(jax.vmap(jax.vmap(_distance, (None, 0)), (None, 0)))
    errors: list[np.ndarray] = []  # [m] (n,) of the pusher
    apart, steps, start_time, waited = np.zeros(count), 0, time.perf_counter(), 0.0
    while steps * period < horizon:
        inputs = batch.stage, *batch.inputs, trials, loop
        trials, snapshots = _record(*inputs)
        away = np.asarray(snapshots.qpos[..., 3:5] - snapshots.qpos[..., :2])
        errors += list(np.asarray(away_from(line, snapshots.qpos[..., :2])))
        apart = np.maximum(apart, np.hypot(*np.moveaxis(away, -1, 0)).max(axis=0))
        waited = waited or time.perf_counter() - start_time  # of the first segment
        steps += _SEGMENT
        callback(Progress(0, steps * period * count, waited))
    state: FollowingState = jax.device_get(trials.law_state)
    end = np.asarray(trials.qpos)[:, JOINTS.object][:, :2].astype(float)
    path_length = float(PARAMS.v_max) * duration
    failed = (apart > _MAX_DISTANCE) | (state.longest > _SILENT) | ~state.pushed
    failed |= np.asarray(trials.tipped | trials.diverged)
    ideal = np.asarray(polyline.at_arc(line, jnp.asarray(path_length)))
    completion = 1 - np.hypot(*(end - ideal).T) / path_length
    first, period = int(_BEHIND / float(PARAMS.v_max) / period / _LOOK), period * _LOOK
    error = np.array(errors)[first : first + int(duration / period)]
    columns = {
        "success": ((~failed).astype(np.int8), "1"),
        "silent": (state.longest.astype(float), "s"),
        "apart": (apart, "m"),
        "deviation": (np.asarray(away_from(line, end[None])[0]), "m"),
        "error_mean": (error.mean(axis=0), "m"),
        "error_95": (np.quantile(error, 0.95, axis=0), "m"),
        "completion": (completion, "1"),
    }
    coords = dict(zip(DIMS, map(list, _VALUES), strict=True))
    shape = [len(values) for values in _VALUES]
    return xr.Dataset(
        {name: (DIMS, x.reshape(shape), {"units": unit}) for name, (x, unit) in columns.items()},
        coords,
        {"engine": engine, "duration": duration},
    )


def _distance(line: Polyline, point: jax.Array) -> jax.Array:
    """Return the distance () [m] of a point (2,) [m] from a path."""
    return polyline.nearest(line, point, 0.0, jnp.inf)[1]


def table(results: xr.Dataset) -> Rows:
    """Return a header and one row per law and slider: successes, completion, deviation."""
    rows = [["law", "slider", "success", "by contact friction", "completion", "deviation"]]
    for law, slider in itertools.product(results.law.values, results.slider.values):
        outcomes = results.sel(law=law, slider=slider)
        deviation, completion = np.abs(outcomes.deviation.values), 100 * outcomes.completion.values
        by_friction = [str(int(outcomes.success.sel(friction=mu).sum())) for mu in FRICTIONS]
        rows.append(
            [
                str(law),
                str(slider),
                f"{int(outcomes.success.sum())} of {outcomes.success.size}",
                ", ".join(by_friction),
                f"{np.median(completion):.1f} % (least {completion.min():.1f})",
                f"{np.median(deviation):.2f} m (most {deviation.max():.2f})",
            ]
        )
    return rows
