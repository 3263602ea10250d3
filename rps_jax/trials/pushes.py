"""The trials that are asked for one by one: cases -> worlds -> outcomes, or traces over time."""

from __future__ import annotations

import math
import time
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import engines, errors
from rps_jax.control import strategies
from rps_jax.control.law import RPSParams
from rps_jax.control.strategies import Params, Strategy
from rps_jax.robot.base import Odometry
from rps_jax.robot.robot import Robot
from rps_jax.robot.shell import Shell
from rps_jax.robot.skin import IdealSkin, Skin
from rps_jax.trials import trial
from rps_jax.trials.batch import SEGMENT, Job, Part, rows, warn_of_lost
from rps_jax.trials.batch import run as _run
from rps_jax.trials.setting import Progress, Report, Setting, Timing, unheard
from rps_jax.trials.trial import Outcome, Shift, Snapshot, World
from rps_jax.world import scene
from rps_jax.world.objects import FAMILIES, OBJECTS
from rps_jax.world.physics import Physics
from rps_jax.world.scene import JOINTS, Friction, Scene, Side


@dataclass(frozen=True)
class Case:
    """One trial to run: all that may differ from world to world."""

    object: str
    friction: Friction
    p_world_target: tuple[float, float]  # [m]
    params: Params = RPSParams.paper()  # and with them the strategy
    mass: float | None = None  # [kg] of the object; None: its own
    skin: Skin = IdealSkin()
    gap: float = 0.02  # [m] between base and object at the start; left open by the paper
    rear: Side = "near"  # where the nonuniform box's load stands; left open by the paper
    bearing: float = 0.0  # [rad] turns the whole trial, and so matters to a friction pyramid alone
    shift: Shift = Shift()
    robot: Robot = Robot()

    def __post_init__(self) -> None:
        """Raises InputError for anything that names or means no trial."""
        errors.check_name("object", self.object, OBJECTS)
        strategies.of(self.params).check(self.params)
        scene.check(self.friction, self.mass)
        self.skin.check()
        errors.check_finite("gap", self.gap, at_least=0, at_most=1, unit="m")
        errors.check_name("rear", self.rear, scene.SIDES)
        errors.check_finite("bearing", self.bearing, at_least=-10, at_most=10, unit="rad")
        errors.check_number("shift time", self.shift.time, at_least=0, unit="s")
        for axis, value in zip("xy", self.shift.p_robot, strict=True):
            errors.check_finite(f"shift {axis}", value, at_least=-5, at_most=5, unit="m")
        self.robot.check()
        scene.check_target(self.p_world_target, self.robot.shell)

    @property
    def sensor(self) -> Skin:
        """The skin on the robot."""
        return self.skin.on(self.robot.shell)


@dataclass(frozen=True)
class Trace:
    """One trial, seen every `interval` [s]: arrays over time, (T, ...)."""

    snapshots: Snapshot
    outcome: Outcome  # without a leading axis
    timing: Timing  # of all trials followed together
    p_world_target: tuple[float, float]  # [m]
    params: Params
    half: tuple[float, float]  # [m] half length and half width of the base


def scene_of(case: Case, physics: Physics) -> Scene:
    """The scene that a case is run in."""
    return scene.load(
        case.object,
        physics,
        case.friction,
        rear=case.rear,
        mass=case.mass,
        robot=case.robot,
    )


def _scenes(cases: Sequence[Case], physics: Physics) -> tuple[list[Scene], np.ndarray]:
    """The different scenes of cases, and which of them each case has, (len(cases),)."""
    keys = [(c.object, c.friction, c.mass, c.rear, c.robot) for c in cases]
    different = dict(zip(keys, cases, strict=True))
    order = {key: i for i, key in enumerate(different)}
    scenes = [scene_of(case, physics) for case in different.values()]
    return scenes, np.array([order[key] for key in keys])


def _start_of(case: Case, at: Scene) -> tuple[np.ndarray, np.ndarray]:
    """The start (10,) and the target (2,) of a case, the whole turned by its bearing."""
    qpos = scene.initial_qpos(at, case.gap)
    c, s = math.cos(case.bearing), math.sin(case.bearing)
    turn = np.array([[c, -s], [s, c]])
    x = JOINTS.object.start
    qpos[:3] = [*(turn @ qpos[:2]), qpos[2] + case.bearing]
    qpos[x : x + 2] = turn @ qpos[x : x + 2]
    qpos[x + 3 : x + 7] = [math.cos(case.bearing / 2), 0.0, 0.0, math.sin(case.bearing / 2)]
    return qpos, turn @ np.array(case.p_world_target)


def build(
    cases: Sequence[Case], setting: Setting, indices: Sequence[int] | None = None
) -> tuple[Any, World]:
    """Stage and worlds of cases of one kind (see `kind`), on the host: leaves (len(cases), ...).

    Each world draws its skin's imperfections from (setting.seed, its index); by default the
    indices count from 0.
    """
    for case in cases:
        engines.get(setting.engine).check_robot(case.robot)
        engines.get(setting.engine).check_senses(strategies.of(case.params).senses)
    scenes, which = _scenes(cases, setting.physics)
    stage, fields = engines.get(setting.engine).stage_of_scenes(scenes, which)
    starts = [_start_of(case, scenes[i]) for case, i in zip(cases, which, strict=True)]
    dtype = jnp.zeros(()).dtype
    numbers = np.arange(len(cases)) if indices is None else np.asarray(indices)
    root = jax.random.PRNGKey(setting.seed)
    world = World(
        fields=jax.tree.map(lambda leaf: np.asarray(leaf, dtype), fields),
        footprint=_stack([s.footprint for s in scenes], dtype, which),
        skin=_stack([case.sensor for case in cases], dtype),
        params=_stack([case.params for case in cases], dtype),
        p_world_target=_stack([target for _, target in starts], dtype),
        shift=Shift(
            _stack([case.shift.time for case in cases], dtype),
            _stack([np.array(case.shift.p_robot) for case in cases], dtype),
        ),
        qpos=_stack([qpos for qpos, _ in starts], dtype),
        key=jax.device_get(jax.vmap(partial(jax.random.fold_in, root))(numbers)),
        odometry=_stack([Odometry()] * len(cases), dtype),
        robot=None if cases[0].robot.ideal else _stack([case.robot for case in cases], dtype),
    )
    return stage, world


def kind(case: Case) -> Hashable:
    """What decides which compiled program runs a case: family, strategy, sensor and robot."""
    return FAMILIES[case.object], type(case.params), jax.tree.structure((case.sensor, case.robot))


def _by_kind(cases: Sequence[Case]) -> list[list[int]]:
    """Indices of the cases of each kind.

    Without reaction most trials lose the object and wait for their end: the longest go first, so
    that the last slots to run are not theirs.
    """
    kinds: dict[Hashable, list[int]] = {}
    for i in sorted(range(len(cases)), key=lambda i: _expected_success(cases[i])):
        kinds.setdefault(kind(cases[i]), []).append(i)
    return list(kinds.values())


def _expected_success(case: Case) -> float:
    return float(case.params.reactive) if isinstance(case.params, RPSParams) else 0.0


def _stack(trees: Sequence[Any], dtype: np.dtype, which: np.ndarray | None = None) -> Any:
    """Pytrees of floats stacked leaf by leaf, then rows taken in the order `which`."""
    stacked = jax.tree.map(lambda *leaves: np.array([np.asarray(x) for x in leaves], dtype), *trees)
    return stacked if which is None else rows(stacked, which)


def run(
    cases: Sequence[Case],
    setting: Setting = Setting(),
    *,
    slots: int | None = None,
    workers: int | None = None,
    report: Report = unheard,
) -> tuple[Outcome, Timing]:
    """Run every case to its end.

    Args:
      cases: in any mixture of objects, frictions, targets and parameters.
      setting: what they share.
      slots: worlds stepped at once by one worker. Results are bit-identical for equal slots on
        one kind of device, whatever shares the batch.
      workers: host threads that each drive a batch of their own, or that step worlds, if JAX does
        not trace the engine; by default as many as suit the engine and the device.
      report: called after every segment, from worker threads, one at a time.

    Returns:
      Outcomes as numpy arrays (len(cases), ...), in the order of `cases`; and the timing.
    """
    jobs = []
    for indices in _by_kind(cases):
        mine = [cases[i] for i in indices]
        stage, worlds = build(mine, setting, indices)
        part = Part(np.array(indices), worlds, stage)
        jobs.append(Job(strategies.of(mine[0].params), len(mine), [part]))
    order, found = [], []

    def collect(numbers: np.ndarray, outcomes: Outcome) -> None:
        order.append(numbers)
        found.append(outcomes)

    timing = _run(jobs, setting, slots=slots, workers=workers, collect=collect, report=report)
    whole = jax.tree.map(lambda *parts: np.concatenate(parts), *found)
    return rows(whole, np.argsort(np.concatenate(order))), timing


def follow(
    cases: Sequence[Case],
    setting: Setting = Setting(),
    *,
    interval: float = 0.1,
    report: Report = unheard,
) -> list[Trace]:
    """Run trials of one kind to their ends and keep what they looked like every `interval` [s].

    Raises:
      InputError: the engine's trials cannot be followed on this machine.
    """
    engines.get(setting.engine).check_followed()
    stage, worlds = build(cases, setting)
    part = Part(np.arange(len(cases)), worlds, stage)
    strategy = strategies.of(cases[0].params)
    return follow_part(part, strategy, setting, interval=interval, report=report)


def follow_part(
    part: Part,
    strategy: Strategy,
    setting: Setting,
    *,
    interval: float = 0.1,
    report: Report = unheard,
) -> list[Trace]:
    """`follow`, for worlds that are built."""
    period = setting.physics.control_period
    every = max(1, round(interval / period))
    steps = every * max(1, round(SEGMENT / (every * period)))
    worlds = jax.device_put(part.worlds)
    trials = trial.start_all(worlds, np.ones(part.numbers.size, bool), strategy=strategy)
    options = {"physics": setting.physics, "rules": setting.rules, "strategy": strategy}
    began = time.perf_counter()
    program = trial.record.lower(
        part.stage, worlds, trials, **options, steps=steps, every=every
    ).compile()
    compiled = time.perf_counter()
    parts = []
    while not bool(trials.done.all()):
        trials, snapshots = program(part.stage, worlds, trials, rules=setting.rules)
        parts.append(jax.device_get(snapshots))
        report(Progress(int(trials.done.sum()), float(trials.steps.sum()) * period))
    whole = jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)
    outcomes = jax.device_get(trial.outcome(trials, period))
    warn_of_lost(int(np.count_nonzero(outcomes.overflows)))
    timing = Timing(compiled - began, time.perf_counter() - compiled, float(np.sum(outcomes.time)))
    return [
        Trace(
            rows(whole, (~whole.done[:, i], i)),
            rows(outcomes, i),
            timing,
            (float(part.worlds.p_world_target[i][0]), float(part.worlds.p_world_target[i][1])),
            rows(part.worlds.params, i),
            _half(rows(part.worlds.skin.shell, i)),
        )
        for i in range(part.numbers.size)
    ]


def _half(shell: Shell) -> tuple[float, float]:
    x, y = shell.half
    return float(x), float(y)
