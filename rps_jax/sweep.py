"""Many trials: cases -> worlds -> slots on a device, each refilled as soon as its trial ends."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors, law, scene, skin, trial
from rps_jax.law import RPSParams
from rps_jax.scene import PHYSICS, Friction, Physics, Scene, Side, mjx
from rps_jax.skin import IdealSkin, Skin
from rps_jax.trial import Outcome, Rules, Snapshot, Stage, Trial, World

_SEGMENT = 10.0  # [s] simulated between two looks at which trials have ended


@dataclass(frozen=True)
class Case:
    """One trial to run."""

    object: str
    friction: Friction
    p_world_target: tuple[float, float]  # [m]
    params: RPSParams
    mass: float | None = None  # [kg] of the object; None: its own

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
        law.check(self.params)
        scene.check(self.friction, self.mass)


@dataclass(frozen=True)
class Setting:
    """What all trials of a run share."""

    physics: Physics = PHYSICS["default"]
    rules: Rules = Rules()
    skin: Skin = field(default_factory=IdealSkin)
    gap: float = 0.02  # [m] between base and object at the start; left open by the paper
    rear: Side = "near"  # where the nonuniform box's load stands; left open by the paper
    seed: int = 0

    def __post_init__(self) -> None:
        """Raises InputError for a gap or a seed that means nothing."""
        errors.check_finite("gap", self.gap, at_least=0, at_most=1, unit="m")
        errors.check_finite("seed", self.seed, at_least=0, at_most=2**32 - 1)
        self.skin.check()


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
    timing: Timing


def scene_of(case: Case, setting: Setting) -> Scene:
    """The scene that a case is run in."""
    return scene.load(
        case.object, setting.physics, case.friction, rear=setting.rear, mass=case.mass
    )


def build(
    cases: Sequence[Case], setting: Setting, indices: Sequence[int] | None = None
) -> tuple[Stage, World]:
    """Worlds of cases of one shape family, stacked on the host: leaves (len(cases), ...).

    Each world draws its skin's imperfections from (setting.seed, its index); by default the
    indices count from 0.
    """
    kinds = list(dict.fromkeys((case.object, case.friction, case.mass) for case in cases))
    which = np.array([kinds.index((case.object, case.friction, case.mass)) for case in cases])
    first = [cases[int(np.argmax(which == i))] for i in range(len(kinds))]
    scenes = [scene_of(case, setting) for case in first]
    model, fields = scene.stack([s.physics for s in scenes])
    dtype = model.qpos0.dtype
    n = len(cases)
    numbers = np.arange(n) if indices is None else np.asarray(indices)
    root = jax.random.PRNGKey(setting.seed)
    world = World(
        fields=_rows(jax.device_get(fields), which),
        footprint=_stack([s.footprint for s in scenes], dtype, which),
        skin=_stack([setting.skin], dtype, np.zeros(n, int)),
        params=_stack([case.params for case in cases], dtype),
        p_world_target=_stack([np.array(case.p_world_target) for case in cases], dtype),
        qpos=_stack([scene.initial_qpos(s, setting.gap) for s in scenes], dtype, which),
        key=jax.device_get(jax.vmap(partial(jax.random.fold_in, root))(numbers)),
    )
    return Stage(model, mjx.make_data(scenes[0].physics)), world


def _stack(trees: Sequence[Any], dtype: np.dtype, which: np.ndarray | None = None) -> Any:
    """Pytrees of floats stacked leaf by leaf, then rows taken in the order `which`."""
    stacked = jax.tree.map(lambda *leaves: np.array([np.asarray(x) for x in leaves], dtype), *trees)
    return stacked if which is None else _rows(stacked, which)


def _rows(tree: Any, rows: Any) -> Any:
    """The same rows of every leaf."""
    return jax.tree.map(lambda leaf: leaf[rows], tree)


@partial(jax.jit, donate_argnames=("trials",))
def _refill(worlds: World, trials: Trial, fresh: jax.Array) -> Trial:
    """Start a new trial in the slots that are `fresh` (B,)."""
    started = trial.start_all(worlds, jnp.ones_like(fresh))
    pick = partial(jax.vmap(lambda f, a, b: jnp.where(f, a, b)), fresh)
    return jax.tree.map(pick, started, trials)


class _Queue:
    """The waiting trials of one shape family, its worlds, and its program once compiled."""

    def __init__(self, indices: list[int], cases: Sequence[Case], setting: Setting, slots: int):
        self.indices = indices
        # Without reaction most trials lose the object and wait for their end: the longest go
        # first, so that the last slots to run are not theirs.
        self.waiting = deque(
            sorted(range(len(indices)), key=lambda i: cases[indices[i]].params.reactive)
        )
        self.slots = min(slots, len(indices))
        self.setting = setting
        self.stage, self.worlds = build([cases[i] for i in indices], setting, indices)
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
                    steps=steps,
                ).compile()
            return self._program


def default_slots() -> int:
    """Worlds stepped at once: few on a processor (small caches), many on an accelerator."""
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
      workers: host threads that each drive a batch of their own; see `default_workers`.
      report: called after every segment, from worker threads, one at a time.

    Returns:
      Outcomes as numpy arrays (len(cases), ...), in the order of `cases`; and the timing.
    """
    slots = slots or default_slots()
    errors.check_finite("slots", slots, at_least=1)
    families: dict[str, list[int]] = {}
    for i, case in enumerate(cases):
        families.setdefault(scene.FAMILIES[case.object], []).append(i)
    began = time.perf_counter()
    queues = [_Queue(indices, cases, setting, slots) for indices in families.values()]
    results: list[Outcome | None] = [None] * len(cases)
    shared = _Shared(results, report)
    count = workers or default_workers()
    with ThreadPoolExecutor(count) as pool:
        jobs = [
            pool.submit(_work, queues[w % len(queues) :] + queues, shared) for w in range(count)
        ]
        try:
            for job in as_completed(jobs):
                job.result()
        except BaseException:
            shared.stop = True
            raise
    total = time.perf_counter() - began
    outcome = jax.tree.map(lambda *rows: np.stack(rows), *results)
    return outcome, Timing(shared.compile, total - shared.compile, shared.simulated)


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
    trials = trial.start_all(worlds, live)
    began = time.perf_counter()
    program = queue.program(worlds, trials)
    shared.compiled(time.perf_counter() - began)
    while live.any() and not shared.stop:
        before = np.asarray(trials.steps)
        trials = program(queue.stage, worlds, trials)
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
            trials = _refill(worlds, trials, np.isin(np.arange(queue.slots), fresh))


def follow(
    case: Case,
    setting: Setting = Setting(),
    *,
    interval: float = 0.1,
    report: Callable[[Progress], Any] = lambda progress: None,
) -> Trace:
    """Run one trial to its end and keep what it looked like every `interval` [s]."""
    period = setting.physics.control_period
    every = max(1, round(interval / period))
    steps = every * max(1, round(_SEGMENT / (every * period)))
    stage, worlds = build([case], setting)
    worlds = jax.device_put(worlds)
    trials = trial.start_all(worlds, np.ones(1, bool))
    options = {"physics": setting.physics, "rules": setting.rules}
    began = time.perf_counter()
    program = trial.record.lower(
        stage, worlds, trials, **options, steps=steps, every=every
    ).compile()
    compiled = time.perf_counter()
    parts = []
    while not bool(trials.done.all()):
        trials, snapshots = program(stage, worlds, trials)
        parts.append(jax.device_get(snapshots))
        report(Progress(int(trials.done.sum()), float(trials.steps[0]) * period))
    whole = jax.tree.map(lambda *arrays: np.concatenate(arrays)[:, 0], *parts)
    outcome = _rows(jax.device_get(trial.outcome(trials, period)), 0)
    timing = Timing(compiled - began, time.perf_counter() - compiled, float(outcome.time))
    return Trace(_rows(whole, ~whole.done), outcome, timing)
