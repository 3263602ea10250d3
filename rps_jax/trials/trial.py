"""Trials: the control loop of a pushing robot in a batch of worlds, and the rules that end it.

A control step is `decide` (sense, judge, run the law), then the engine's physics steps, then
`settle`. `decide` and `settle` are pure functions of one world; the engine steps the batch between
them. `advance` runs many control steps, and `unroll` also returns snapshots. The state of a trial
that has ended stays as it is, and a batch stops when all its trials have ended.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import spec
from rps_jax.control import soft
from rps_jax.control.base import Law, LawParams
from rps_jax.control.laws import rps
from rps_jax.control.learned import features
from rps_jax.control.observation import (
    Details,
    ForceObservation,
    Observation,
    PoseObservation,
    Twist,
    displacement,
    with_base,
)
from rps_jax.engines import native
from rps_jax.engines.base import ControlPeriod, Driven, Engine, Motion, Stage
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Bool, Bools, Float, Floats, Ints, Pytree, Scalar, Vector
from rps_jax.geometry.footprint import Footprint
from rps_jax.robot import base
from rps_jax.robot.base import Drive, Load, Odometry
from rps_jax.robot.robot import Robot
from rps_jax.robot.skin import NONE, IdealSkin, Reading, Skin, SkinState
from rps_jax.spec import Spec
from rps_jax.world.physics import Physics
from rps_jax.world.scene import JOINTS
from rps_jax.world.tasks import reach
from rps_jax.world.tasks.base import Positions, Task

# A world is a runaway beyond these, far outside anything a base at 0.05 m/s can cause.
_MAX_SPEED = 20.0  # [m/s], [rad/s]
_MAX_DISTANCE = 100.0  # [m]
_REPOSITION = 2.0  # [s] without contact from which on a base has repositioned


class Rules(NamedTuple):
    """When a trial ends (Sec. III-B); of objects that fall over the paper says nothing."""

    horizon: Annotated[
        Scalar, Spec("s", "Time after which a trial has failed [s].", gt=0, le=1e5)
    ] = 300.0
    max_lost: Annotated[
        Scalar,
        Spec(
            "s",
            "Time without contact, in all after the first touch, after which it has failed [s].",
            0,
        ),
    ] = 150.0
    max_tilt: Annotated[
        Scalar, Spec("rad", "Tilt from which on an object has fallen over [rad].", gt=0, le=1.4)
    ] = math.pi / 4

    def check(self) -> None:
        """Raise InputError for times that are not positive and finite, or no tilt."""
        spec.check(self)


@partial(jax.tree_util.register_dataclass, data_fields=["rules"], meta_fields=["physics", "law"])
@dataclass(frozen=True)
class ControlLoop:
    """The loop of sensing, deciding and stepping; a pytree of the rules, the rest is static."""

    physics: Physics
    rules: Rules = Rules()
    law: Law = rps.LAW


class Shift(NamedTuple):
    """The object is moved by a hand during the push, as in the paper's video."""

    time: Annotated[
        float | Float[Array | np.ndarray, "*B"], Spec("s", "time of the shift", le=math.inf)
    ] = jnp.inf
    p_robot: Annotated[
        tuple[float, float] | Float[Array | np.ndarray, "*B 2"],
        Spec("m", "length and direction in the robot frame"),
    ] = (0.0, 0.0)


@jax.tree_util.register_static
@dataclass(frozen=True)
class Origin:
    """Physics and task with which worlds were drawn."""

    physics: Physics
    task: Task


class World(NamedTuple):
    """Object, robot, sensors and task of one world; every leaf is batched."""

    fields: Pytree  # for its engine's stage
    footprint: Footprint
    skin: Skin
    p_world_target: Float[Array, "*B 2"]  # [m]
    shift: Shift
    qpos: Float[Array, "*B 10"]  # at the start, as in `Trial`
    key: Array  # of the imperfections of skin and odometry
    odometry: Odometry = Odometry()
    robot: Robot | None = None  # with limits; None follows every twist
    task: Pytree = reach.Nothing()  # a `Course`
    origin: Origin | None = None  # of worlds for `rollout`


class Trial(NamedTuple):
    """The running state of one world."""

    # In the world: base x, y [m], yaw [rad]; object position [m] and quaternion, scalar first.
    qpos: Float[Array, "*B 10"]
    # Of these [m/s, rad/s]; the object's angular velocity is in its own frame.
    qvel: Float[Array, "*B 9"]
    warmstart: Float[Array, "*B 9"]  # [m/s^2, rad/s^2] last accelerations, for the solver
    law_state: Pytree  # what the law remembers
    skin: SkinState
    poses: Float[Array, "*B K 3"]  # [m, m, rad] of the base in the last steps, the latest first
    twists: Float[Array, "*B K 3"]  # [m/s, m/s, rad/s] commanded, the latest first
    steps: Ints  # control steps done
    contact_steps: Ints  # of them in contact
    lost_steps: Ints  # without contact after the first touch
    sum_abs_l: Floats  # [m] over the steps in contact
    min_distance: Floats  # [m] contact point to target; inf before the first touch
    path_length: Floats  # [m] of the base's way
    absent_steps: Ints  # since the last contact; 0 before the first touch
    repositions: Ints  # times without contact for `_REPOSITION`
    lost_path: Floats  # [m] of the base's way without contact after the first touch
    done: Bools
    success: Bools
    tilt: Floats  # [rad] greatest tilt of the object so far
    tipped: Bools  # the object has fallen over
    diverged: Bools
    nan_twist: Bools  # the law returned a twist that is not finite
    drive: Drive | None = None  # of a robot with limits
    load: Load | None = None  # of a law that senses the contact's force
    task: Pytree = reach.Nothing()  # progress of the task


class Snapshot(NamedTuple):
    """Observations and actions of one control step."""

    time: Floats  # [s]
    qpos: Float[Array, "*B 10"]  # as in `Trial`
    reading: Reading
    twist: Twist  # [m/s, m/s, rad/s] commanded, robot frame
    details: Details
    done: Bools  # the trial had ended


class Outcome(NamedTuple):
    """The result of one trial."""

    success: Annotated[Bools, Spec("1", "target reached within the rules")]
    time: Annotated[Floats, Spec("s", "simulated time at which the trial ended")]
    # Infinite if it never touched.
    min_distance: Annotated[Floats, Spec("m", "least distance of the contact point to the target")]
    contact_lost_time: Annotated[Floats, Spec("s", "time without contact after the first touch")]
    path_length: Annotated[Floats, Spec("m", "length of the base's way")]
    repositions: Annotated[
        Ints, Spec("1", "times without contact for 2 s or longer after the first touch")
    ]
    contact_lost_path: Annotated[
        Floats, Spec("m", "length of the base's way without contact after the first touch")
    ]
    # NaN if it never touched.
    mean_abs_l: Annotated[Floats, Spec("m", "mean |l| while in contact, the paper's D")]
    tilt: Annotated[Floats, Spec("rad", "greatest tilt of the object")]
    tipped: Annotated[Bools, Spec("1", "the object fell over")]
    diverged: Annotated[Bools, Spec("1", "physics became NaN or ran away")]
    nan_twist: Annotated[
        Bools, Spec("1", "it diverged since the law returned a twist that is not finite")
    ]
    stalled: Annotated[
        Bools, Spec("1", "it ended with the base standing still, whose force was too small")
    ]
    unfelt: Annotated[Bools, Spec("1", "it ended against the object, but the skin felt no contact")]
    base_pose: Annotated[
        Float[Array, "*B 3"], Spec("m, m, rad", "x, y, yaw of the base in the world at the end")
    ]
    object_pose: Annotated[
        Float[Array, "*B 3"], Spec("m, m, rad", "x, y, yaw of the object in the world at the end")
    ]
    task: Mapping[str, Array] = MappingProxyType({})  # by name: see `Task.OUTCOMES`

    def columns(self) -> dict[str, Pytree]:
        """Return all outcomes by name."""
        return {name: x for name, x in self._asdict().items() if name != "task"} | dict(self.task)

    @classmethod
    def of_columns(cls, columns: Mapping[str, Pytree]) -> Outcome:
        """Return the outcome of all columns by name."""
        fields = {name: columns[name] for name in cls._fields if name in columns}
        return cls(**fields, task={k: x for k, x in columns.items() if k not in fields})


def object_pose(qpos: Float[Array, "10"]) -> tuple[Vector, Float[Array, ""]]:
    """Return the planar position [m] and yaw [rad] of the object in the world."""
    free = qpos[JOINTS.object]
    return free[:2], planar.yaw_of_quaternion(free[3:])


@jax.jit
def p_world_contact(snapshots: Snapshot) -> Float[Array, "T 2"]:
    """Return the contact points of snapshots (T, ...) in the world [m]; NaN without contact."""
    point = contact_of(snapshots.qpos, snapshots.reading.p_robot_contact)
    return jnp.where((snapshots.reading.contact_type != NONE)[:, None], point, jnp.nan)


def start(world: World, params: LawParams, law: Law = rps.LAW) -> Trial:
    """Return the trial of a world before its first control step."""
    zero = jnp.zeros_like(world.qpos[0])
    count, false = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    return Trial(
        qpos=world.qpos,
        qvel=jnp.zeros_like(world.qpos[:9]),
        warmstart=jnp.zeros_like(world.qpos[:9]),
        law_state=law.init(params),
        skin=world.skin.init(world.key),
        poses=jnp.tile(world.qpos[JOINTS.base], (*world.odometry.past.shape, 1)),
        twists=jnp.zeros((*world.odometry.past.shape, 3), world.qpos.dtype),
        min_distance=jnp.full_like(zero, jnp.inf),
        **dict.fromkeys(("sum_abs_l", "path_length", "lost_path", "tilt"), zero),
        **dict.fromkeys(
            ("steps", "contact_steps", "lost_steps", "absent_steps", "repositions"), count
        ),
        **dict.fromkeys(("done", "success", "tipped", "diverged", "nan_twist"), false),
        drive=None if world.robot is None else base.init_drive(world.qpos),
        load=base.init_load(world.qpos) if law.senses == "force" else None,
        task=world.task.start(),
    )


def shifted(world: World, trial: Trial, period: float) -> Trial:
    """Return the trial with the world's scripted shift, if it is due in this control step."""
    # Compare step numbers: rounded times could be equal twice or never.
    due = trial.steps == jnp.round(world.shift.time / period)
    offset = planar.rotate(trial.qpos[JOINTS.base_yaw], jnp.asarray(world.shift.p_robot))
    x = JOINTS.object.start
    return trial._replace(qpos=trial.qpos.at[x : x + 2].add(jnp.where(due, offset, 0.0)))


def outline(world: World, qpos: Float[Array, "10"]) -> Footprint:
    """Return the object's outline in the robot frame, at the positions qpos."""
    p_world_robot, yaw = qpos[JOINTS.base_position], qpos[JOINTS.base_yaw]
    p_world_object, object_yaw = object_pose(qpos)
    p_robot_object = planar.rotate(-yaw, p_world_object - p_world_robot)
    return fp.place(world.footprint, p_robot_object, object_yaw - yaw)


def contact_of(
    qpos: Float[Array, "*B 10"], p_robot_contact: Float[Array, "*B 2"]
) -> Float[Array, "*B 2"]:
    """Return a contact point in the world [m]."""
    position, yaw = qpos[..., JOINTS.base_position], qpos[..., JOINTS.base_yaw]
    return position + planar.rotate(yaw, p_robot_contact)


def positions_of(
    world: World,
    qpos: Float[Array, "10"],
    p_robot_contact: Vector,
    touches: Array,
    declared: Array | None = None,
) -> Positions:
    """Return what a task judges, at the positions qpos."""
    contact = contact_of(qpos, p_robot_contact), touches
    bodies = qpos[JOINTS.base], world.skin.shell.outline, *object_pose(qpos), world.footprint
    return Positions(world.p_world_target, *contact, *bodies, declared)


@jax.jit
@jax.vmap
def fails_at_start(world: World) -> Bool[Array, ""] | bool:
    """Return whether the task has failed in each of several worlds before the first step."""
    positions = positions_of(world, world.qpos, jnp.zeros(2), jnp.zeros((), bool))
    return world.task.step(world.task.start(), positions)[1].failed


class Measurement(NamedTuple):
    """Readings of skin and odometry in one control step."""

    reading: Reading
    observation: Observation  # at the pose that the odometry estimates
    # [m] contact point to target, at the true pose; without contact, that of the base
    distance: Floats


def observe(
    world: World, params: LawParams, trial: Trial, loop: ControlLoop
) -> tuple[Trial, Measurement]:
    """Sense, and judge by the rules: the first half of `decide`.

    The rules use the true pose of the base; the law gets the pose that the odometry estimates.
    """
    period, rules = loop.physics.control_period, loop.rules
    time = trial.steps * period
    trial = shifted(world, trial, period)
    skin, reading = world.skin.sense(trial.skin, outline(world, trial.qpos), period)
    touched = reading.p_robot_contact, reading.in_contact
    pose = trial.qpos[JOINTS.base_position], trial.qpos[JOINTS.base_yaw]
    observation = Observation(*pose, *touched, world.p_world_target, period)
    observation = with_base(observation, world.skin.shell.radius, world.robot)
    distance = planar.norm(displacement(observation))
    motion = trial.poses, trial.qpos[JOINTS.base], world.key, trial.steps, period
    poses, believed = base.observe_pose(world.odometry, *motion)
    observation = observation._replace(p_world_robot=believed[:2], yaw=believed[2])

    touch = reading.contact_type != NONE
    is_lost = ~touch & (trial.contact_steps > 0)
    lost_steps = trial.lost_steps + is_lost
    absent_steps = jnp.where(is_lost, trial.absent_steps + 1, 0)
    is_done = loop.law.is_done
    declared = None if is_done is None else jnp.asarray(is_done(trial.law_state))
    positions = positions_of(world, trial.qpos, reading.p_robot_contact, touch, declared)
    task, aim = world.task.step(trial.task, positions)
    observation = observation._replace(
        p_world_target=aim.p_world_target, yaw_target=aim.yaw_target, relative=aim.relative
    )
    success = aim.success
    if success is None:
        success = touch & (distance < params.d_success) & aim.at_end
    tilt = planar.tilt(trial.qpos[JOINTS.object_quaternion])
    tipped = tilt > rules.max_tilt
    over = (time >= rules.horizon) | (lost_steps * period > rules.max_lost) | tipped | aim.failed
    judged = trial._replace(
        skin=skin,
        poses=poses,
        contact_steps=trial.contact_steps + touch,
        lost_steps=lost_steps,
        absent_steps=absent_steps,
        repositions=trial.repositions + (absent_steps == math.ceil(_REPOSITION / period)),
        sum_abs_l=trial.sum_abs_l + jnp.where(touch, jnp.abs(observation.l), 0.0),
        min_distance=jnp.where(
            touch, jnp.minimum(trial.min_distance, distance), trial.min_distance
        ),
        success=success & ~over,
        tilt=jnp.maximum(trial.tilt, tilt),
        tipped=tipped,
        done=success | over if declared is None else success | over | declared,
        task=task,
    )
    return judged, Measurement(reading, observation, distance)


def execute(world: World, trial: Trial, twist: Twist, period: float) -> tuple[Trial, Twist]:
    """Return the trial with a commanded twist stored, and the twist that the base executes.

    Both twists are in the robot frame; `period` [s] is the control period.
    """
    if trial.twists.shape[0]:
        delay = world.odometry.command_delay
        twists, late = base.delayed(trial.twists, jnp.stack(twist), delay, period)
        late = base.apply_errors(world.robot, late, world.odometry.velocity_error)
        trial, twist = trial._replace(twists=twists), Twist(*late)
    if world.robot is None or trial.drive is None:
        return trial, twist
    aim = base.aim(world.robot, trial.drive.aim, jnp.stack(twist), period)
    trial = trial._replace(drive=trial.drive._replace(aim=aim))
    return trial, Twist(*base.apply_slip(world.robot, aim))


def perceive(
    world: World, params: LawParams, trial: Trial, loop: ControlLoop
) -> tuple[Trial, Measurement, Pytree]:
    """Sense and judge; return the trial, the readings, and the observation of the law."""
    law = loop.law
    judged, measured = observe(world, params, trial, loop)
    obs: Pytree = measured.observation
    if law.heading and obs.yaw_target is None:
        yaw = planar.direction(obs.p_world_target)
        obs = obs._replace(yaw_target=jnp.full_like(yaw, jnp.nan) if law.follows else yaw)
    if not law.smooth:
        obs = obs._replace(in_contact=measured.reading.contact_type != NONE)
    if law.senses == "pose":
        radius = fp.circumradius(world.footprint)
        corners = outline(world, judged.qpos).vertices if law.heading else None
        obs = PoseObservation(obs, object_pose(judged.qpos)[0], radius, corners)
    if law.senses in ("taxels", "ends"):
        skin = world.skin, judged.skin, outline(world, judged.qpos)
        observation = features.OBSERVATIONS[law.senses]
        obs = observation(obs, measured.reading, *skin)
    if judged.load is not None and law.senses == "force":
        load, force = law.cell.read(
            judged.load, world.key, judged.steps, loop.physics.control_period
        )
        judged, obs = judged._replace(load=load), ForceObservation(obs, force)
    return judged, measured, obs


def decide(
    world: World, params: LawParams, trial: Trial, loop: ControlLoop
) -> tuple[Trial, Twist, Snapshot]:
    """Sense, judge and run the law in one world.

    Returns the trial before its physics steps, the twist that the base executes, and a snapshot.
    """
    period, law = loop.physics.control_period, loop.law
    judged, measured, obs = perceive(world, params, trial, loop)
    state, twist, details = law.step(params, trial.law_state, obs)
    twist = Twist(*twist)
    is_finite = functools.reduce(jnp.logical_and, map(jnp.isfinite, twist))
    judged = judged._replace(law_state=state, nan_twist=~judged.done & ~is_finite)
    time, reading = trial.steps * period, measured.reading
    snapshot = Snapshot(time, judged.qpos, reading, twist, details, trial.done)
    decided, twist = execute(world, judged, twist, period)
    return decided, twist, snapshot


def settle(world: World, previous: Trial, decided: Trial, driven: Driven) -> Trial:
    """Return the trial after one control period: `decided` at the positions `driven`, or ended.

    A trial that had ended before, as `previous` says, is returned as it was.
    """
    (qpos, qvel, warmstart, integral), force, *_ = driven
    xy = JOINTS.base_position
    sane = (
        ~decided.nan_twist
        & jnp.all(jnp.isfinite(qpos))
        & jnp.all(jnp.abs(qvel) < _MAX_SPEED)
        # The base may turn without limit.
        & jnp.all(jnp.abs(qpos.at[JOINTS.base_yaw].set(0.0)) < _MAX_DISTANCE)
    )
    state = decided.drive
    if world.robot is not None and state is not None:
        state = state if integral is None else state._replace(integral=integral)
        state = base.count_stalled_steps(world.robot, state, qvel)
    way = planar.norm(qpos[xy] - decided.qpos[xy])
    moved = decided._replace(
        qpos=qpos,
        qvel=qvel,
        warmstart=warmstart,
        path_length=decided.path_length + way,
        lost_path=decided.lost_path + jnp.where(decided.absent_steps > 0, way, 0.0),
        steps=decided.steps + 1,
        drive=state,
        load=decided.load and decided.load._replace(wrench=force),
    )
    ended = decided._replace(done=jnp.ones((), bool), diverged=~decided.done & ~sane)
    stepped = soft.tree_where(decided.done | ~sane, ended, moved)
    return soft.tree_where(previous.done, previous, stepped)


def control_step(
    stage: Stage,
    worlds: World,
    params: LawParams,
    trials: Trial,
    loop: ControlLoop,
    mapped: Callable[..., Pytree] = jax.vmap,
) -> tuple[Trial, Snapshot]:
    """Run one control step of a batch of worlds; trials that have ended do not change.

    For a single world without batch dimension, `mapped` returns its function unchanged.
    """
    return _solved_step(stage, worlds, params, trials, loop, mapped, None)[0]


def _solved_step(
    stage: Stage,
    worlds: World,
    params: LawParams,
    trials: Trial,
    loop: ControlLoop,
    mapped: Callable[..., Pytree],
    solutions: Pytree,
) -> tuple[tuple[Trial, Snapshot], Pytree]:
    """Run `control_step` with the solutions of `ControlPeriod`; return also those of `Driven`."""
    decided, twists, snapshots = mapped(decide, (0, 0, 0, None))(worlds, params, trials, loop)
    force = trials.load is not None
    period = ControlPeriod(twists, loop.physics, pushing(worlds), force, solutions)
    driven = stage.drive(worlds.fields, motion(decided), period)
    result = driven._replace(solutions=None)
    settled = mapped(settle, (0, 0, 0, 0))(worlds, trials, decided, result)
    return (settled, snapshots), driven.solutions


def unroll(
    stage: Stage,
    worlds: World,
    params: LawParams,
    trials: Trial,
    loop: ControlLoop,
    steps: int,
    mapped: Callable[..., Pytree] = jax.vmap,
    states: bool = False,
) -> tuple[Trial, Pytree]:
    """Run `steps` control steps of a batch; return also snapshots (steps, B, ...).

    With `states`, these are pairs of a snapshot and the state after the step. In reverse mode it
    stores the state of each step, some 1 kB. `mapped` is that of `control_step`; with
    `native.mapped`, derivatives are fastest.
    """

    def output(stepped: tuple[Trial, Snapshot]) -> tuple[Trial, Pytree]:
        trials, snapshots = stepped
        return trials, (snapshots, trials) if states else snapshots

    def single(
        trial: Trial, inputs: Pytree, solutions: Pytree
    ) -> tuple[tuple[Trial, Pytree], Pytree]:
        """Run one control step of one world."""
        world, params, rules = inputs
        world_loop = dataclasses.replace(loop, rules=rules)
        step = stage, world, params, trial, world_loop, lambda f, *_: f
        stepped, solutions = _solved_step(*step, solutions)
        return output(stepped), solutions

    if mapped is native.mapped and native.compiles(stage):
        rules = jax.tree.map(lambda x: jnp.broadcast_to(x, trials.done.shape), loop.rules)
        with contextlib.suppress(native.TooLargeError):  # of laws with large networks
            return native.scan(single, trials, (worlds, params, rules), steps)

    # Without a checkpoint, XLA would store all intermediate numbers.
    @partial(jax.checkpoint, prevent_cse=False)
    def step(trials: Trial, _: None) -> tuple[Trial, Pytree]:
        return output(control_step(stage, worlds, params, trials, loop, mapped))

    return jax.lax.scan(step, trials, length=steps)


class SingleWorld(NamedTuple):
    """Stage that steps one world without a batch axis; under `jax.vmap` it steps a batch."""

    native = False
    stage: Stage

    def drive(self, fields: Pytree, motion: Motion, period: ControlPeriod) -> Driven:
        """Step one world for one control period: see `Stage.drive`."""
        batch = jax.tree.map(lambda x: jnp.asarray(x)[None], (fields, motion, period))
        return jax.tree.map(lambda x: x[0], self.stage.drive(*batch))


def motion(trials: Trial) -> Motion:
    """Return the part of trials that an engine steps."""
    integral = None if trials.drive is None else trials.drive.integral
    return Motion(trials.qpos, trials.qvel, trials.warmstart, integral)


def pushing(worlds: World) -> Robot | None:
    """Return the bodies of the worlds' robots, if contact can slow and stop them."""
    return worlds.robot.body if worlds.robot is not None and worlds.robot.driven else None


def is_pressed(world: World, qpos: Float[Array, "10"]) -> Bool[Array, ""]:
    """Return whether the object touches a taxel, dead or alive, at the positions qpos."""
    shell = world.skin.shell
    points = jnp.asarray(shell.taxels(shell.samples), qpos.dtype)
    return jnp.any(fp.signed_distance(outline(world, qpos), points) < IdealSkin().tolerance)


def outcome(trial: Trial, worlds: World, loop: ControlLoop) -> Outcome:
    """Return the results of a batch of trials in their worlds."""
    period = loop.physics.control_period
    is_lost = (trial.contact_steps == 0) | (trial.lost_steps * period > loop.rules.max_lost)
    position, yaw = jax.vmap(object_pose)(trial.qpos.reshape(-1, 10))
    pose = jnp.concatenate([position, yaw[:, None]], axis=-1)
    stalled = False if trial.drive is None else trial.drive.stalled * period >= base.STALL
    return Outcome(
        success=trial.success,
        time=trial.steps * period,
        min_distance=trial.min_distance,
        contact_lost_time=trial.lost_steps * period,
        path_length=trial.path_length,
        repositions=trial.repositions,
        contact_lost_path=trial.lost_path,
        mean_abs_l=jnp.where(
            trial.contact_steps > 0, trial.sum_abs_l / jnp.maximum(trial.contact_steps, 1), jnp.nan
        ),
        tilt=trial.tilt,
        tipped=trial.tipped,
        diverged=trial.diverged,
        nan_twist=trial.nan_twist,
        stalled=stalled & ~trial.success & ~trial.diverged,
        unfelt=trial.done & is_lost & jax.vmap(is_pressed)(worlds, trial.qpos),
        base_pose=trial.qpos[..., JOINTS.base],
        object_pose=pose.reshape(*trial.qpos.shape[:-1], 3),
        task=trial.task.outcomes(),
    )


@partial(jax.jit, static_argnames=("law",))
def start_all(
    worlds: World, params: LawParams, live: Bool[Array, " B"] | None = None, law: Law = rps.LAW
) -> Trial:
    """Return the trials of a batch of worlds before their start; those not `live` are padding."""
    trials = jax.vmap(partial(start, law=law))(worlds, params)
    return trials if live is None else trials._replace(done=~live)


_UNCHECKED = 20  # control steps on a GPU before the host checks whether any trial runs


# Stage, worlds, law parameters and trials of a batch, with leaves (n, ...).
Batch = tuple[Stage, World, LawParams, Trial]


def advance(batches: Sequence[Batch], loop: ControlLoop, steps: int | Array) -> tuple[Trial, ...]:
    """Run up to `steps` control steps of batches side by side; fewer if all trials end.

    Every batch has its own stage and shape family. The number of steps is no part of the program,
    so that the same program runs a whole trial and stops wherever a trial is recorded.
    """
    stages = [stage for stage, *_ in batches]
    if not native.compiles(*stages):
        return _advance_in_xla(batches, loop, steps)

    def single(
        stage: Stage, world: World, params: LawParams, trial: Trial, rules: Pytree, steps: Array
    ) -> Trial:
        """Advance one world."""
        world_loop = dataclasses.replace(loop, rules=rules)

        def step(carry: tuple[int | Array, Trial]) -> tuple[int | Array, Trial]:
            count, trial = carry
            inputs = stage, world, params, trial, world_loop
            return count + 1, control_step(*inputs, mapped=lambda f, *_: f)[0]

        return jax.lax.while_loop(lambda c: (c[0] < steps) & ~c[1].done, step, (0, trial))[1]

    def in_xla(
        *inputs: Pytree,
    ) -> tuple[Trial, ...]:  # (worlds, params, trials, rules, steps) of each
        """Advance all batches where the native compiler is not used."""
        rules, steps = jax.tree.map(lambda x: x[0], inputs[0][-2:])
        shared, pairs = dataclasses.replace(loop, rules=rules), zip(stages, inputs, strict=True)
        return _advance_in_xla([(stage, *values[:-2]) for stage, values in pairs], shared, steps)

    def phase(world: World, params: LawParams, trial: Trial, *_: Pytree) -> Array:
        """Return 0 for trials that push, 1 for those before the first touch, above for ended."""
        return 2 * trial.done + (trial.contact_steps == 0)

    inputs = []
    for _, *values, trials in batches:
        rules = jax.tree.map(lambda x, n=trials.done.size: jnp.full(n, x, float), loop.rules)
        inputs.append((*values, trials, rules, jnp.full(trials.done.size, steps, jnp.int32)))
    singles = [partial(single, stage) for stage in stages]
    return tuple(native.concurrent(singles, in_xla, phase)(*inputs))


class SegmentState(NamedTuple):
    """State of a batch of trials after a segment."""

    steps: Pytree  # (B,) int: control steps of each trial in this segment
    done: Pytree  # (B,) bool
    outcome: Outcome  # (B, ...)


Advanced = tuple[tuple[Trial, ...], tuple[SegmentState, ...]]  # after a segment, by batch


def segment_of(physics: Physics, law: Law) -> Callable[..., Advanced]:
    """Return a function that starts fresh trials of batches, and runs some control steps of all.

    Its arguments are stages, inputs and trials of the batches; masks (B,) of the trials that start
    and of those that are no padding; rules, and a number of steps. It returns the trials and their
    states.
    """

    def segment(
        stages: tuple[Stage, ...],
        inputs: tuple[tuple[World, LawParams], ...],
        trials: tuple[Trial, ...],
        fresh: tuple[Array, ...],
        live: tuple[Array, ...],
        rules: Rules,
        steps: Array,
    ) -> Advanced:
        pairs = zip(inputs, live, strict=True)
        started = [start_all(*leaves, mask, law=law) for leaves, mask in pairs]
        current = tuple(map(jax.vmap(soft.tree_where), fresh, started, trials))
        loop = ControlLoop(physics, rules, law)
        batches = zip(stages, inputs, current, strict=True)
        advanced = advance([(stage, *x, state) for stage, x, state in batches], loop, steps)
        # Outcomes are in the same program: another one would wait for other workers' segments.
        return advanced, tuple(
            SegmentState(b.steps - a.steps, b.done, outcome(b, worlds, loop))
            for a, b, (worlds, _) in zip(current, advanced, inputs, strict=True)
        )

    return segment


def _advance_in_xla(
    batches: Sequence[Batch], loop: ControlLoop, steps: int | Array
) -> tuple[Trial, ...]:
    """Run `advance` as a program of XLA."""

    def any_runs(carry):
        count, trials = carry
        return (count < steps) & ~jnp.all(jnp.stack([jnp.all(batch.done) for batch in trials]))

    def single(stage, worlds, params, trials, count):
        is_over = trials.done | (count >= steps)  # in unchecked steps
        stepped, _ = control_step(stage, worlds, params, trials._replace(done=is_over), loop)
        return stepped._replace(done=jnp.where(is_over, trials.done, stepped.done))

    def step(_, carry):
        count, trials = carry
        pairs = zip(batches, trials, strict=True)
        return count + 1, tuple(single(*batch[:-1], current, count) for batch, current in pairs)

    def body(carry):
        # A GPU waits for the host at every check whether any trial runs.
        on_cpu = jax.default_backend() == "cpu"
        return step(0, carry) if on_cpu else jax.lax.fori_loop(0, _UNCHECKED, step, carry)

    return jax.lax.while_loop(any_runs, body, (0, tuple(batch[-1] for batch in batches)))[1]


# --- engines that JAX does not trace -------------------------------------------------------

_decide = jax.jit(jax.vmap(decide, (0, 0, 0, None)))
_settle = jax.jit(jax.vmap(settle))
compiled_outcome = jax.jit(outcome)


def run_on_host(
    engine: Engine, stage: Pytree, worlds: World, params: LawParams, loop: ControlLoop, threads: int
) -> Iterator[Trial]:
    """Run a batch of worlds to their ends with an engine that JAX does not trace.

    Sensing, laws and rules run in JAX. The engine gets positions in the precision of JAX and steps
    them in its own precision. `threads` is its number of threads.

    Yields:
      Trials at the start and after each control step.
    """
    worlds, params = jax.device_put((worlds, params), jax.devices("cpu")[0])
    trials = start_all(worlds, params, law=loop.law)
    dtype, qpos = trials.qpos.dtype, np.asarray(trials.qpos, float)
    yield trials
    opened = engine.open_batch(stage, qpos, threads, pushing(worlds), worlds.fields)
    with contextlib.closing(opened) as batch:
        while not np.asarray(trials.done).all():
            decided, twist, _ = _decide(worlds, params, trials, loop)
            qpos, running = np.asarray(decided.qpos), np.flatnonzero(~np.asarray(decided.done))
            # Only a scripted shift moves the object outside of the engine.
            moved = np.flatnonzero(np.any(qpos != np.asarray(trials.qpos), axis=1))
            batch.qpos[moved] = qpos[moved]
            if running.size:
                twists = np.stack(twist, axis=1)[running].astype(float)
                batch.drive(running, twists, loop.physics.substeps)
            driven = jax.tree.map(lambda x: x.astype(dtype), batch.driven)
            driven = driven if loop.law.senses == "force" else driven._replace(force=None)
            trials = _settle(worlds, trials, decided, driven)
            yield trials
