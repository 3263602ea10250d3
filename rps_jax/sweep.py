"""Many trials: cases -> worlds -> slots on a device, each refilled as soon as its trial ends."""

from __future__ import annotations

import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import baselines, errors, fused, law, reference, scene, skin, trial
from rps_jax.law import RPSParams
from rps_jax.scene import JOINTS, PHYSICS, Friction, Physics, Scene, Side, mjx
from rps_jax.skin import IdealSkin, Skin
from rps_jax.trial import (
    Fused,
    Outcome,
    Params,
    Rules,
    Shift,
    Snapshot,
    Stage,
    Strategy,
    Trial,
    World,
)

Engine = Literal["mjx", "fused", "mujoco"]
_SEGMENT = 10.0  # [s] simulated between two looks at which trials have ended


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

    def __post_init__(self) -> None:
        """Raises InputError for anything that names or means no trial."""
        errors.check_name("object", self.object, scene.OBJECTS)
        for axis, value in zip("xy", self.p_world_target, strict=True):
            errors.check_finite(f"target {axis}", value, at_least=-50, at_most=50, unit="m")
        x, y = self.p_world_target
        if abs(x) <= skin.HALF_LENGTH and abs(y) <= skin.HALF_WIDTH:
            raise errors.InputError(
                f"target = ({x:g}, {y:g}) m is not allowed: it must lie outside the robot, which "
                f"covers |x| <= {skin.HALF_LENGTH:g} m and |y| <= {skin.HALF_WIDTH:g} m."
            )
        if isinstance(self.params, RPSParams):
            law.check(self.params)
        else:
            baselines.check(self.params)
        scene.check(self.friction, self.mass)
        self.skin.check()
        errors.check_finite("gap", self.gap, at_least=0, at_most=1, unit="m")
        errors.check_name("rear", self.rear, scene.SIDES)
        errors.check_finite("bearing", self.bearing, at_least=-10, at_most=10, unit="rad")
        errors.check_number("shift time", self.shift.time, at_least=0, unit="s")
        for axis, value in zip("xy", self.shift.p_robot, strict=True):
            errors.check_finite(f"shift {axis}", value, at_least=-5, at_most=5, unit="m")


@dataclass(frozen=True)
class Setting:
    """What all trials of a run share."""

    physics: Physics = PHYSICS["default"]["standard"]
    rules: Rules = Rules()
    seed: int = 0  # of the skins' imperfections
    engine: Engine = "mjx"

    def __post_init__(self) -> None:
        """Raises InputError for rules, a seed or an engine that mean nothing."""
        self.rules.check()
        errors.check_finite("seed", self.seed, at_least=0, at_most=2**32 - 1)
        errors.check_name("engine", self.engine, get_args(Engine))


@dataclass(frozen=True)
class Progress:
    """A look at a running sweep."""

    finished: int  # trials
    simulated: float  # [s] summed over trials, ended or running


@dataclass(frozen=True)
class Timing:
    """Where the time of a sweep went."""

    compile: float  # [s] on the critical path of the first worker
    run: float  # [s] wall clock after that
    simulated: float  # [s] of trials


@dataclass(frozen=True)
class Trace:
    """One trial, seen every `interval` [s]: arrays over time, (T, ...)."""

    snapshots: Snapshot
    outcome: Outcome  # without a leading axis
    timing: Timing  # of all trials followed together


def scene_of(case: Case, physics: Physics) -> Scene:
    """The scene that a case is run in."""
    return scene.load(
        case.object,
        physics,
        case.friction,
        rear=case.rear,
        mass=case.mass,
        half_length=float(case.skin.half_length),
    )


def _scenes(cases: Sequence[Case], physics: Physics) -> tuple[list[Scene], np.ndarray]:
    """The different scenes of cases, and which of them each case has, (len(cases),)."""
    keys = [(c.object, c.friction, c.mass, c.rear, float(c.skin.half_length)) for c in cases]
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
    """Worlds of cases of one kind (see `kind`), stacked on the host: leaves (len(cases), ...).

    Each world draws its skin's imperfections from (setting.seed, its index); by default the
    indices count from 0.
    """
    scenes, which = _scenes(cases, setting.physics)
    stage, fields = stage_of(scenes, setting)
    if isinstance(stage, list):
        stage = [stage[i] for i in which]
    starts = [_start_of(case, scenes[i]) for case, i in zip(cases, which, strict=True)]
    dtype = jnp.zeros(()).dtype
    numbers = np.arange(len(cases)) if indices is None else np.asarray(indices)
    root = jax.random.PRNGKey(setting.seed)
    world = World(
        fields=_rows(fields, which),
        footprint=_stack([s.footprint for s in scenes], dtype, which),
        skin=_stack([case.skin for case in cases], dtype),
        params=_stack([case.params for case in cases], dtype),
        p_world_target=_stack([target for _, target in starts], dtype),
        shift=Shift(
            _stack([case.shift.time for case in cases], dtype),
            _stack([np.array(case.shift.p_robot) for case in cases], dtype),
        ),
        qpos=_stack([qpos for qpos, _ in starts], dtype),
        key=jax.device_get(jax.vmap(partial(jax.random.fold_in, root))(numbers)),
    )
    return stage, world


def stage_of(scenes: list[Scene], setting: Setting) -> tuple[Any, Any]:
    """What an engine steps: shared by all worlds, and the fields of each scene.

    C MuJoCo shares nothing: its models, one for each scene.
    """
    if setting.engine == "mujoco":
        return [s.physics for s in scenes], {}
    if setting.engine == "fused":
        bodies = [fused.body(s.physics, np.asarray(s.footprint.vertices)) for s in scenes]
        return Fused(), _stack(bodies, jnp.zeros(()).dtype)
    model, fields = scene.stack([s.physics for s in scenes])
    return Stage(model, mjx.make_data(scenes[0].physics)), jax.device_get(fields)


def kind(case: Case) -> tuple[str, type, type]:
    """What decides which compiled program runs a case: family, strategy and sensor."""
    return scene.FAMILIES[case.object], type(case.params), type(case.skin)


def _by_kind(cases: Sequence[Case]) -> list[list[int]]:
    """Indices of the cases of each kind."""
    kinds: dict[Hashable, list[int]] = {}
    for i, case in enumerate(cases):
        kinds.setdefault(kind(case), []).append(i)
    return list(kinds.values())


def _stack(trees: Sequence[Any], dtype: np.dtype, which: np.ndarray | None = None) -> Any:
    """Pytrees of floats stacked leaf by leaf, then rows taken in the order `which`."""
    stacked = jax.tree.map(lambda *leaves: np.array([np.asarray(x) for x in leaves], dtype), *trees)
    return stacked if which is None else _rows(stacked, which)


def _rows(tree: Any, rows: Any) -> Any:
    """The same rows of every leaf."""
    return jax.tree.map(lambda leaf: leaf[rows], tree)


@partial(jax.jit, static_argnames=("strategy",), donate_argnames=("trials",))
def _refill(worlds: World, trials: Trial, fresh: jax.Array, *, strategy: Strategy) -> Trial:
    """Start a new trial in the slots that are `fresh` (B,)."""
    started = trial.start_all(worlds, jnp.ones_like(fresh), strategy=strategy)
    pick = partial(jax.vmap(lambda f, a, b: jnp.where(f, a, b)), fresh)
    return jax.tree.map(pick, started, trials)


class _Queue:
    """The waiting trials of one shape family, its worlds, and its program once compiled."""

    def __init__(self, indices: list[int], cases: Sequence[Case], setting: Setting, slots: int):
        self.indices = indices
        # Without reaction most trials lose the object and wait for their end: the longest go
        # first, so that the last slots to run are not theirs.
        self.waiting = deque(
            sorted(range(len(indices)), key=lambda i: _expected_success(cases[indices[i]]))
        )
        self.slots = min(slots, len(indices))
        self.setting = setting
        mine = [cases[i] for i in indices]
        self.strategy = trial.STRATEGIES[type(mine[0].params)]
        self.stage, self.worlds = build(mine, setting, indices)
        self._program = None
        self._lock = threading.Lock()

    def take(self, count: int) -> list[int]:
        """Up to `count` waiting trials."""
        taken = []
        while len(taken) < count:
            try:
                taken.append(self.waiting.popleft())
            except IndexError:
                break
        return taken

    def program(self, worlds: World, trials: Trial) -> Any:
        """The compiled `trial.advance`; the first worker to come compiles, others wait."""
        with self._lock:
            if self._program is None:
                physics = self.setting.physics
                steps = max(1, round(_SEGMENT / physics.control_period))
                self._program = trial.advance.lower(
                    self.stage,
                    worlds,
                    trials,
                    physics=physics,
                    rules=self.setting.rules,
                    strategy=self.strategy,
                    steps=steps,
                ).compile()
            return self._program


def default_slots(engine: Engine = "mjx") -> int:
    """Worlds stepped at once: few on a processor (small caches), many on an accelerator."""
    if engine == "fused":
        return 64 if jax.default_backend() == "cpu" else 65536
    return 24 if jax.default_backend() == "cpu" else 8192


def run(
    cases: Sequence[Case],
    setting: Setting = Setting(),
    *,
    slots: int | None = None,
    workers: int | None = None,
    report: Callable[[Progress], Any] = lambda progress: None,
) -> tuple[Outcome, Timing]:
    """Run every case to its end.

    Args:
      cases: in any mixture of objects, frictions, targets and parameters.
      setting: what they share.
      slots: worlds stepped at once by one worker. Results are bit-identical for equal slots on
        one kind of device, whatever shares the batch.
      workers: host threads that each drive a batch of their own, or, with the engine `mujoco`,
        that step worlds; see `default_workers`.
      report: called after every segment, from worker threads, one at a time.

    Returns:
      Outcomes as numpy arrays (len(cases), ...), in the order of `cases`; and the timing.
    """
    slots = slots or default_slots(setting.engine)
    workers = workers or default_workers()
    errors.check_finite("slots", slots, at_least=1)
    errors.check_finite("workers", workers, at_least=1)
    results: list[Outcome | None] = [None] * len(cases)
    shared = _Shared(results, report)
    began = time.perf_counter()
    if setting.engine == "mujoco":
        _run_in_c(cases, setting, workers, shared)
    else:
        _run_in_mjx(cases, setting, slots, workers, shared)
    total = time.perf_counter() - began
    outcome = jax.tree.map(lambda *rows: np.stack(rows), *results)
    return outcome, Timing(shared.compile, total - shared.compile, shared.simulated)


def _run_in_mjx(
    cases: Sequence[Case], setting: Setting, slots: int, count: int, shared: _Shared
) -> None:
    queues = [_Queue(indices, cases, setting, slots) for indices in _by_kind(cases)]
    orders = [queues[w % len(queues) :] + queues for w in range(count)]
    _side_by_side([partial(_work, order, shared) for order in orders], count, shared)


def _run_in_c(cases: Sequence[Case], setting: Setting, threads: int, shared: _Shared) -> None:
    kinds = _by_kind(cases)
    count = min(threads, len(kinds))
    _side_by_side(
        [
            partial(_run_kind_in_c, indices, cases, setting, threads // count, shared)
            for indices in kinds
        ],
        count,
        shared,
    )


def _side_by_side(tasks: Sequence[Callable[[], None]], count: int, shared: _Shared) -> None:
    """Run tasks on `count` threads; the first that fails stops the others."""
    with ThreadPoolExecutor(count) as pool:
        jobs = [pool.submit(task) for task in tasks]
        try:
            for job in as_completed(jobs):
                job.result()
        except BaseException:
            shared.stop = True
            raise


def _run_kind_in_c(
    indices: list[int], cases: Sequence[Case], setting: Setting, threads: int, shared: _Shared
) -> None:
    mine = [cases[i] for i in indices]
    strategy = trial.STRATEGIES[type(mine[0].params)]
    models, worlds = build(mine, setting, indices)

    def tell(ended: np.ndarray, trials: Trial, simulated: float) -> bool:
        outcomes = jax.device_get(trial.outcome(trials, setting.physics.control_period))
        shared.add({indices[i]: _rows(outcomes, i) for i in ended}, simulated)
        return not shared.stop

    reference.run(
        models,
        worlds,
        physics=setting.physics,
        rules=setting.rules,
        strategy=strategy,
        threads=threads,
        report=tell,
    )


def _expected_success(case: Case) -> float:
    return float(case.params.reactive) if isinstance(case.params, RPSParams) else 0.0


def default_workers() -> int:
    """One thread for each core of a processor, since XLA steps a small batch on one core."""
    return os.cpu_count() or 1 if jax.default_backend() == "cpu" else 1


class _Shared:
    """What the workers report into."""

    def __init__(self, results: list[Outcome | None], report: Callable[[Progress], Any]):
        self.results = results
        self.simulated = 0.0
        self.compile = 0.0
        self.stop = False  # set when one worker fails or the user interrupts
        self._finished = 0
        self._report = report
        self._lock = threading.Lock()

    def add(self, rows: dict[int, Outcome], simulated: float) -> None:
        """Trials that ended in a segment, and the time [s] all of the worker's trials advanced."""
        with self._lock:
            for index, outcome in rows.items():
                self.results[index] = outcome
            self._finished += len(rows)
            self.simulated += simulated
            self._report(Progress(self._finished, self.simulated))

    def compiled(self, seconds: float) -> None:
        """One worker waited this long for a program."""
        with self._lock:
            self.compile = max(self.compile, seconds)


def _work(queues: list[_Queue], shared: _Shared) -> None:
    for queue in queues:
        _drain(queue, shared)


def _drain(queue: _Queue, shared: _Shared) -> None:
    """Run the queue's trials until none waits and none of this worker's runs."""
    taken = queue.take(queue.slots)
    if not taken:
        return
    period = queue.setting.physics.control_period
    held = np.array(taken + [0] * (queue.slots - len(taken)))  # the trial in each slot
    live = np.arange(queue.slots) < len(taken)
    worlds = jax.device_put(_rows(queue.worlds, held))
    trials = trial.start_all(worlds, live, strategy=queue.strategy)
    began = time.perf_counter()
    program = queue.program(worlds, trials)
    shared.compiled(time.perf_counter() - began)
    while live.any() and not shared.stop:
        before = np.asarray(trials.steps)
        trials = program(queue.stage, worlds, trials, rules=queue.setting.rules)
        steps = np.asarray(trials.steps)
        ended = np.asarray(trials.done) & live
        outcomes = jax.device_get(trial.outcome(trials, period)) if ended.any() else None
        rows = {queue.indices[held[s]]: _rows(outcomes, s) for s in np.flatnonzero(ended)}
        shared.add(rows, float((steps - before)[live].sum()) * period)
        live &= ~ended
        taken = queue.take(int(ended.sum()))
        if taken:
            fresh = np.flatnonzero(ended)[: len(taken)]
            held[fresh] = taken
            live[fresh] = True
            worlds = jax.device_put(_rows(queue.worlds, held))
            trials = _refill(
                worlds, trials, np.isin(np.arange(queue.slots), fresh), strategy=queue.strategy
            )


def follow(
    cases: Sequence[Case],
    setting: Setting = Setting(),
    *,
    interval: float = 0.1,
    report: Callable[[Progress], Any] = lambda progress: None,
) -> list[Trace]:
    """Run trials of one kind to their ends and keep what they looked like every `interval` [s].

    Raises:
      InputError: the engine is `mujoco`, which is not followed.
    """
    if setting.engine == "mujoco":
        raise errors.InputError("engine = mujoco is not allowed: follow a trial with mjx or fused.")
    period = setting.physics.control_period
    every = max(1, round(interval / period))
    steps = every * max(1, round(_SEGMENT / (every * period)))
    strategy = trial.STRATEGIES[type(cases[0].params)]
    stage, worlds = build(cases, setting)
    worlds = jax.device_put(worlds)
    trials = trial.start_all(worlds, np.ones(len(cases), bool), strategy=strategy)
    options = {"physics": setting.physics, "rules": setting.rules, "strategy": strategy}
    began = time.perf_counter()
    program = trial.record.lower(
        stage, worlds, trials, **options, steps=steps, every=every
    ).compile()
    compiled = time.perf_counter()
    parts = []
    while not bool(trials.done.all()):
        trials, snapshots = program(stage, worlds, trials, rules=setting.rules)
        parts.append(jax.device_get(snapshots))
        report(Progress(int(trials.done.sum()), float(trials.steps.sum()) * period))
    whole = jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)
    outcomes = jax.device_get(trial.outcome(trials, period))
    timing = Timing(compiled - began, time.perf_counter() - compiled, float(np.sum(outcomes.time)))
    return [
        Trace(_rows(whole, (~whole.done[:, i], i)), _rows(outcomes, i), timing)
        for i in range(len(cases))
    ]
