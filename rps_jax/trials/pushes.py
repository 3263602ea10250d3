"""The trials that are asked for one by one: cases -> worlds -> outcomes, or traces over time."""

import math
import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import engines
from rps_jax.control import registry
from rps_jax.control.base import Law, LawParams
from rps_jax.control.laws.rps import RPSParams
from rps_jax.engines import device, programs
from rps_jax.geometry import solid
from rps_jax.geometry.footprint import Footprint
from rps_jax.robot.base import Odometry
from rps_jax.robot.shell import Shell
from rps_jax.trials import batch, host, trial, worlds
from rps_jax.trials.batch import SEGMENT, Job, WorldBatch, rows
from rps_jax.trials.case import Case
from rps_jax.trials.progress import Progress, ProgressCallback, Timing, no_progress
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Outcome, Shift, Snapshot, Trial
from rps_jax.world import scene
from rps_jax.world.objects import FAMILIES
from rps_jax.world.physics import Physics
from rps_jax.world.scene import JOINTS, Friction, Scene


@dataclass(frozen=True)
class Trajectory:
    """One trial, seen every `interval` [s]: arrays over time, (T, ...)."""

    snapshots: Snapshot
    outcome: Outcome  # without a leading axis
    timing: Timing  # of all trials followed together
    p_world_target: tuple[float, float]  # [m]
    params: LawParams
    half: tuple[float, float]  # [m] half length and half width of the base
    outline: np.ndarray  # (N, 2) [m] of the object in its own frame, closed


def scene_of(case: Case, physics: Physics) -> Scene:
    """Compile the scene of a case."""
    return scene.load(
        case.object_name,
        physics,
        case.contact,
        rear=case.rear,
        mass=case.mass,
        robot=case.base,
    )


def _scenes(cases: Sequence[Case], physics: Physics) -> tuple[list[Scene], np.ndarray]:
    """Return the different scenes of cases, and the index (len(cases),) of each case's scene."""
    keys = [(c.object_name, c.mass, c.rear, c.base) for c in cases]
    different = dict(zip(keys, cases, strict=True))
    order = {key: i for i, key in enumerate(different)}
    scenes = [scene_of(case, physics) for case in different.values()]
    return scenes, np.array([order[key] for key in keys])


def _start_of(case: Case, at: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return start (10,) and target (2,) of a case, both turned by its bearing."""
    qpos = scene.initial_qpos(at, case.gap)
    c, s = math.cos(case.bearing), math.sin(case.bearing)
    turn = np.array([[c, -s], [s, c]])
    x = JOINTS.object.start
    qpos[:3] = [*(turn @ qpos[:2]), qpos[2] + case.bearing]
    qpos[x : x + 2] = turn @ qpos[x : x + 2]
    qpos[x + 3 : x + 7] = [math.cos(case.bearing / 2), 0.0, 0.0, math.sin(case.bearing / 2)]
    return qpos, turn @ np.array(case.target)


def build(
    cases: Sequence[Case], setting: Setting, indices: Sequence[int] | None = None
) -> WorldBatch:
    """Return the worlds of n cases of one kind (see `kind`), on the host.

    (setting.seed, index) is the key of the imperfections of the skin of a world; by default the
    indices count from 0.
    """
    engine = engines.get(setting.engine)
    for case in cases:
        engine.check_robot(case.base)
        engine.check_senses(registry.law_of(case.params).senses)
    scenes, scene_indices = _scenes(cases, setting.physics)
    solids = solid.stack([x.rounded_solid if engine.traced else x.solid for x in scenes])
    starts = [_start_of(case, scenes[i]) for case, i in zip(cases, scene_indices, strict=True)]
    qpos, targets = (np.array(column) for column in zip(*starts, strict=True))
    trials = np.arange(len(cases)) if indices is None else np.asarray(indices)
    root = jax.random.PRNGKey(setting.seed)
    batch = worlds.build(
        trials,
        FAMILIES[cases[0].object_name],
        rows(solids, scene_indices),
        Friction(*np.array([case.contact for case in cases], float).T),
        _stack([case.base for case in cases]),
        setting,
        skin=_stack([case.sensor for case in cases]),
        p_world_target=targets,
        shift=Shift(
            np.array([case.shift.time for case in cases], float),
            np.array([case.shift.p_robot for case in cases], float),
        ),
        qpos=qpos,
        key=jax.device_get(jax.vmap(partial(jax.random.fold_in, root))(trials)),
        odometry=_stack([Odometry()] * len(cases)),
    )
    params = _stack([case.params for case in cases], jnp.result_type(float))
    return batch._replace(params=params)


def kind(case: Case) -> Hashable:
    """What decides which compiled program runs a case: family, law, sensor and robot."""
    return (
        FAMILIES[case.object_name],
        type(case.params),
        jax.tree.structure((case.sensor, case.base)),
    )


def _stack(trees: Sequence[Any], dtype: Any = float) -> Any:
    """Return pytrees of numbers stacked leaf by leaf."""
    return jax.tree.map(lambda *leaves: np.array([np.asarray(x) for x in leaves], dtype), *trees)


def run(
    cases: Sequence[Case], setting: Setting = Setting(engine="mjx"), **shape: Any
) -> tuple[Outcome, Timing]:
    """Run every case to its end, in any mixture of objects, frictions, targets and parameters.

    Slots, workers and report are those of `batch.run`. Results are bit-identical for equal slots on
    one kind of device, whatever shares the batch.

    Returns:
      Outcomes as numpy arrays (len(cases), ...), in the order of `cases`; and the timing.
    """
    # Without reaction most trials lose the object and wait for their end: the longest go first, so
    # that the last slots to run are not theirs.
    lasts = [float(c.params.reactive) if isinstance(c.params, RPSParams) else 0.0 for c in cases]
    jobs, kinds = [], dict[Hashable, list[int]]()
    for i in np.argsort(lasts, kind="stable").tolist():
        kinds.setdefault(kind(cases[i]), []).append(i)
    for indices in kinds.values():
        mine = [cases[i] for i in indices]
        part = build(mine, setting, indices)
        jobs.append(Job(registry.law_of(mine[0].params), len(mine), [part]))
    return batch.run_all(jobs, setting, len(cases), **shape)


def record_cases(
    cases: Sequence[Case],
    setting: Setting = Setting(engine="mjx"),
    *,
    interval: float = 0.1,
    callback: ProgressCallback = no_progress,
) -> list[Trajectory]:
    """Run trials of one kind to their ends and keep what they looked like every `interval` [s]."""
    part = build(cases, setting)
    law = registry.law_of(cases[0].params)
    return record_batch(part, law, setting, interval=interval, callback=callback)


def record_batch(
    part: WorldBatch,
    law: Law,
    setting: Setting,
    *,
    interval: float = 0.1,
    callback: ProgressCallback = no_progress,
) -> list[Trajectory]:
    """`follow`, for worlds that are built."""
    period = setting.physics.control_period
    every = max(1, round(interval / period))
    if not engines.get(setting.engine).traced:
        return _followed(part, *_follow_on_host(part, law, setting, every, callback))
    steps = every * max(1, round(SEGMENT / (every * period)))
    part = jax.device_put(part)
    trials = trial.start_all(part.worlds, part.params, np.ones(part.indices.size, bool), law=law)
    began = time.perf_counter()
    record = recorder(part, trials, setting, law, steps=steps, every=every)
    compiled = time.perf_counter()
    parts = []
    while True:
        trials, snapshots, outcomes = record(trials)
        done, steps_done, snapshots, outcomes = jax.device_get(
            (trials.done, trials.steps, snapshots, outcomes)
        )
        parts.append(snapshots)
        callback(Progress(int(done.sum()), float(steps_done.sum()) * period, compiled - began))
        if done.all():
            break
    whole = jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)
    timing = Timing(compiled - began, time.perf_counter() - compiled, float(np.sum(outcomes.time)))
    return _followed(part, whole, outcomes, timing)


def recorder(
    part: WorldBatch, trials: Trial, setting: Setting, law: Law, *, steps: int, every: int
) -> Callable[[Trial], tuple[Trial, Snapshot, Outcome]]:
    """`trial.record` of a batch and how its trials stand then, compiled, or kept by a process."""
    own = {"physics": setting.physics, "law": law, "steps": steps, "every": every}

    def record(*given: Any) -> tuple[Trial, Snapshot, Outcome]:
        *batch, rules = given
        after, snapshots = trial.record(*batch, rules=rules, **own)
        return after, snapshots, trial.outcome(after, setting.physics.control_period)

    inputs = part.stage, part.worlds, part.params
    given = *inputs, trials, setting.rules
    static = (setting.physics, steps, every)
    program = programs.compile_function(record, given, law=law, donate=3, static=static)
    return lambda now: program(*inputs, now, setting.rules)


def _follow_on_host(
    part: WorldBatch, law: Law, setting: Setting, every: int, callback: ProgressCallback
) -> tuple[Snapshot, Outcome, Timing]:
    """What `host.run` sees every so many control steps: (T, B, ...), outcomes and timing."""
    seen: list[Snapshot] = []
    total, began, compiled = 0.0, time.perf_counter(), 0.0

    def watch(step: int, now: Snapshot) -> None:
        nonlocal compiled
        compiled = compiled or time.perf_counter() - began  # the first step is decided
        if step % every == 0:
            seen.append(jax.device_get(now))

    def tell(_: np.ndarray, trials: Trial, simulated: float) -> bool:
        nonlocal total
        total += simulated
        callback(Progress(int(np.asarray(trials.done).sum()), total, compiled))
        return True

    trials = host.run(
        engines.get(setting.engine),
        part.stage,
        part.worlds,
        part.params,
        ControlLoop(setting.physics, setting.rules, law),
        threads=1 if part.indices.size == 1 else device.count_processors(),
        callback=tell,
        watch=watch,
    )
    outcomes = jax.device_get(trial.outcome(trials, setting.physics.control_period))
    ran = time.perf_counter() - began - compiled
    timing = Timing(compiled, ran, float(np.sum(outcomes.time)))
    return jax.tree.map(lambda *each: np.stack(each), *seen), outcomes, timing


def _followed(
    part: WorldBatch, whole: Snapshot, outcomes: Outcome, timing: Timing
) -> list[Trajectory]:
    """What was seen (T, B, ...), trial by trial, each until its end."""
    return [
        Trajectory(
            rows(whole, (~whole.done[:, i], i)),
            rows(outcomes, i),
            timing,
            (float(part.worlds.p_world_target[i][0]), float(part.worlds.p_world_target[i][1])),
            rows(part.params, i),
            _half(rows(part.worlds.skin.shell, i)),
            _outline(rows(part.worlds.footprint, i)),
        )
        for i in range(part.indices.size)
    ]


def _outline(shape: Footprint) -> np.ndarray:
    """Outline (N, 2) [m] of a footprint, closed; a circle as a polygon."""
    corners, radius = np.asarray(shape.vertices, float), float(shape.radius)
    if radius > 0:
        angle = np.linspace(0, 2 * np.pi, 49)
        return corners[:1] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([corners, corners[:1]])


def _half(shell: Shell) -> tuple[float, float]:
    x, y = shell.half
    return float(x), float(y)
