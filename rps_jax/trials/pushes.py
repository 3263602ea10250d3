"""Named cases: their worlds, their outcomes (`run`), and their trajectories (`record_batch`)."""

import math
import time
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Unpack

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.control.base import Law, LawParams
from rps_jax.control.laws.rps import RPSParams
from rps_jax.engines import device
from rps_jax.geometry import solid
from rps_jax.geometry.arrays import Pytree
from rps_jax.robot.base import Odometry
from rps_jax.robot.robot import Robot
from rps_jax.trials import trial, worlds
from rps_jax.trials.batch import outcomes, stepper
from rps_jax.trials.case import Case
from rps_jax.trials.progress import Progress, ProgressCallback, Timing, no_progress
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Outcome, Shift, Snapshot, Trial, World
from rps_jax.trials.worlds import BatchOptions, Job, WorldBatch, rows
from rps_jax.world import draws, objects, scene
from rps_jax.world.objects import FAMILIES
from rps_jax.world.scene import JOINTS, Friction, Scene, WorldInputs
from rps_jax.world.tasks.base import CourseInputs


@dataclass(frozen=True)
class Trajectory:
    """Trial over time: snapshots at equal intervals, arrays (T, ...)."""

    snapshots: Snapshot
    outcome: Outcome  # without a leading axis
    world: World  # without a leading axis
    params: LawParams
    law_states: Pytree  # (T, ...) what the law remembers at the snapshots

    @property
    def p_world_target(self) -> tuple[float, float]:
        """Target [m] in the world."""
        x, y = self.world.p_world_target
        return float(x), float(y)


def scene_of(case: Case, setting: Setting, index: int = 0) -> Scene:
    """Compile the scene of a case; (setting.world_seed, index) draws what its object guesses."""
    options = {"rear": case.rear, "mass": case.mass, "robot": case.base}
    numbers = draws.numbers(setting.world_seed, np.array([index]))
    drawn = objects.draw_guesses(case.object_name, numbers)
    options["drawn"] = None if drawn is None else rows(drawn, 0)
    return scene.load(case.object_name, setting.physics, case.contact, **options)


def title_of(case: Case, at: Scene) -> str:
    """Return the title of a case, with the guessed size and mass of its object."""
    if objects.guesses_of(case.object_name) is None:
        return case.title
    sizes = [*2 * at.solid.vertices[0], float(at.solid.height)]
    size, mass = " x ".join(f"{x:.2f}" for x in sizes), float(at.solid.mass)
    return f"{case.title}, guessed {size} m and {mass:.1f} kg"


def _start_of(case: Case, at: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return start (10,) and target (2,) of a case, both turned by its bearing."""
    qpos = scene.initial_qpos(at, case.gap)
    c, s = math.cos(case.bearing), math.sin(case.bearing)
    turn = np.array([[c, -s], [s, c]])
    x = JOINTS.object.start
    for position in (JOINTS.base_position, slice(x, x + 2)):
        qpos[position] = turn @ qpos[position]
    qpos[JOINTS.base_yaw] += case.bearing
    quaternion = [math.cos(case.bearing / 2), 0.0, 0.0, math.sin(case.bearing / 2)]
    qpos[JOINTS.object_quaternion] = quaternion
    return qpos, turn @ np.array(case.target)


def build(
    cases: Sequence[Case], setting: Setting, indices: Sequence[int] | None = None
) -> WorldBatch:
    """Return the worlds of n cases of one kind (see `kind`), on the host.

    (setting.world_seed, index) is the key of the imperfections of the skin of a world; by default
    the indices count from 0.
    """
    trials = np.arange(len(cases)) if indices is None else np.asarray(indices)
    for case in cases:
        setting.check_here(case.base, [case.params])
    guessed = {x for x in {x.object_name for x in cases} if objects.guesses_of(x) is not None}
    keys = [
        (case.object_name, case.mass, case.rear, case.base, i * (case.object_name in guessed))
        for case, i in zip(cases, trials.tolist(), strict=True)
    ]
    different = dict(zip(keys, cases, strict=True))
    scenes = {key: scene_of(case, setting, key[-1]) for key, case in different.items()}
    traced = setting.simulator.traced
    solids = {key: x.rounded_solid if traced else x.solid for key, x in scenes.items()}
    starts = [_start_of(case, scenes[key]) for case, key in zip(cases, keys, strict=True)]
    qpos, targets = (np.array(column) for column in zip(*starts, strict=True))
    courses, final = [], []
    numbers = draws.numbers(setting.world_seed, trials)
    for i, (case, target) in enumerate(zip(cases, targets, strict=True)):
        u = {name: values[i : i + 1] for name, values in numbers.items()}
        front = np.array([float(case.base.sizes[0])])
        end, course = case.challenge.courses(CourseInputs(u, target[None], front, case.bearing))
        final.append(end[0])
        courses.append(rows(course, 0))
    shifts = zip(*(case.shift for case in cases), strict=True)
    high, low = divmod(setting.world_seed, 2**32)
    root = jax.random.PRNGKey(low)
    root = jax.random.fold_in(root, high) if high else root
    inputs = WorldInputs(
        FAMILIES[cases[0].object_name],
        solid.stack([solids[key] for key in keys], setting.physics.support),
        Friction(*np.array([case.contact for case in cases], float).T),
        setting.physics,
        _stack([case.base for case in cases]),
    )
    batch = worlds.build(
        trials,
        inputs,
        setting,
        skin=_stack([case.sensor for case in cases]),
        p_world_target=np.array(final),
        task=_stack(courses),
        shift=Shift(*(np.array(column, float) for column in shifts)),
        qpos=qpos,
        key=jax.device_get(jax.vmap(partial(jax.random.fold_in, root))(trials)),
        odometry=_odometry([case.base for case in cases], setting.physics.control_period),
    )
    has_end = not cases[0].challenge.HAS_TARGET
    for i in np.flatnonzero(trial.fails_at_start(batch.worlds) if has_end else ()).tolist():
        rule = "a wall crosses base or object at the start; widen it, or start the path ahead"
        raise errors.not_allowed("task", cases[i].challenge, rule)
    params = _stack([case.params for case in cases], jnp.result_type(float))
    return batch._replace(params=params)


def _odometry(robots: Sequence[Robot], period: float) -> Odometry:
    """Return odometry without noise, with the latencies of robots."""
    pairs = np.array([[x.pose_latency or 0.0, x.command_delay or 0.0] for x in robots], float)
    steps = 1 + round(float(pairs.max()) / period) if pairs.any() else 0
    still = Odometry(velocity_error=np.zeros(3), past=np.zeros(steps)) if steps else Odometry()
    rows = [still._replace(pose_latency=age, command_delay=delay) for age, delay in pairs]
    return _stack(rows)


def kind(case: Case) -> Hashable:
    """Return the key of the compiled program for a case: family, law, sensor and robot."""
    structure = jax.tree.structure((case.sensor, case.base))
    return FAMILIES[case.object_name], type(case.params), structure, case.challenge.shape


def _stack(trees: Sequence[Pytree], dtype: Pytree = float) -> Pytree:
    """Return pytrees of numbers stacked leaf by leaf."""
    return jax.tree.map(lambda *leaves: np.array([np.asarray(x) for x in leaves], dtype), *trees)


class Cases(NamedTuple):
    """Request of named cases, in any mixture of objects, frictions, targets and parameters."""

    cases: Sequence[Case]

    @property
    def shape(self) -> tuple[int]:
        """Shape of the outcomes, in the order of the cases."""
        return (len(self.cases),)

    def jobs(self, setting: Setting) -> Iterator[Job]:
        """Yield the cases of each kind."""
        # Without reaction most trials lose the object and run to the horizon. They start first, so
        # that few slots are idle at the end.
        params = [case.params for case in self.cases]
        order = [float(p.reactive) if isinstance(p, RPSParams) else 0.0 for p in params]
        groups: dict[Hashable, list[int]] = {}
        for i in np.argsort(order, kind="stable").tolist():
            groups.setdefault(kind(self.cases[i]), []).append(i)
        for program, indices in groups.items():
            worlds = build([self.cases[i] for i in indices], setting, indices)
            yield Job(program, len(indices), [worlds])


def run(
    cases: Sequence[Case], setting: Setting = Setting(engine="mjx"), **options: Unpack[BatchOptions]
) -> tuple[Outcome, Timing]:
    """Run every case to its end, by `run_batch` with its options.

    Results are bit-identical for equal slots on one kind of device, whatever shares the batch.

    Returns:
      Outcomes as numpy arrays (len(cases), ...), in the order of `cases`; and the timing.
    """
    (outcome,), timing = outcomes([Cases(cases)], setting, **options)
    return outcome, timing


def record_batch(
    worlds: WorldBatch,
    setting: Setting,
    law: Law | None = None,  # whose details the snapshots have; None: that of the law parameters
    *,
    interval: float = 0.1,
    slots: int | None = None,
    callback: ProgressCallback = no_progress,
) -> list[Trajectory]:
    """Run trials of one stage as `watch` does, with a snapshot every `interval` [s]."""
    period, start_time, compile_time = setting.physics.control_period, time.perf_counter(), None
    moments, ends = list[tuple[Snapshot, Pytree]](), list[Outcome]()
    for trials, snapshot, outcome in watch(worlds, setting, law, interval=interval, slots=slots):
        ends = [outcome]
        compile_time = compile_time or time.perf_counter() - start_time  # of the first snapshot
        moments.append((snapshot, jax.device_get(trials.law_state)))
        simulated = float(trials.steps.sum()) * period
        callback(Progress(int(trials.done.sum()), simulated, compile_time))
    columns, states = jax.tree.map(lambda *leaves: np.stack(leaves), *moments)
    trajectories = list[Trajectory]()
    for i in range(worlds.indices.size):
        recorded = ~columns.done[:, i], i  # until its end
        outcome, world, params = rows((ends[0], *worlds.inputs), i)
        states_of_trial = rows(states, recorded)
        snapshots = rows(columns, recorded)
        trajectories.append(Trajectory(snapshots, outcome, world, params, states_of_trial))
    return trajectories


def watch(
    worlds: WorldBatch,
    setting: Setting,
    law: Law | None = None,
    *,
    interval: float,
    slots: int | None = None,
) -> Iterator[tuple[Trial, Snapshot, Outcome]]:
    """Run trials of one stage; yield them every `interval` [s], with snapshots and outcomes so far.

    The first are at the start, and the last when all have ended. Trials have the bits of a run in
    programs with so many slots; by default one for each trial.
    """
    loop = ControlLoop(setting.physics, setting.rules, law or worlds.law)
    stride = max(1, round(interval / setting.physics.control_period))
    for trials, outcome in _states(worlds, setting, stride, slots or worlds.indices.size):
        snapshots = _snapshots(*worlds.inputs, trials, loop)
        yield trials, jax.tree.map(np.asarray, snapshots), outcome


# Snapshots are computed outside of the program that steps trials, whose bits they leave alone.
_snapshots = jax.jit(jax.vmap(lambda *inputs: trial.decide(*inputs)[2], (0, 0, 0, None)))


def _states(
    worlds: WorldBatch, setting: Setting, stride: int, slots: int
) -> Iterator[tuple[Trial, Outcome]]:
    """Yield trials and their outcomes at the start, after every `stride` steps and at the end."""
    if not setting.simulator.traced:
        threads = 1 if worlds.indices.size == 1 else device.count_processors()
        loop = ControlLoop(setting.physics, setting.rules, worlds.law)
        steps = trial.run_on_host(setting.simulator, worlds.stage, *worlds.inputs, loop, threads)
        for step, trials in enumerate(steps):
            if step % stride == 0 or trials.done.all():
                outcomes = trial.compiled_outcome(trials, worlds.worlds, loop)
                yield jax.device_get((trials, outcomes))
        return
    advance = stepper(worlds, setting, slots)
    state = advance(worlds.inputs, None, 0)
    yield state
    while not state[0].done.all():
        state = advance(worlds.inputs, state[0], stride)
        yield state
