"""Batches of trials: a compiled program steps slots, and each slot is refilled when its trial ends.

A job holds the trials that one program can step: one law, one shape family. Its worlds are built
batch by batch when slots become free, so that memory does not grow with the number of trials.

- `WorldBatch`: worlds and law parameters of some trials of a job.
- `_TrialQueue`: the trials of a job that wait for a slot, and its suspended trials.
- `_Program`: a compiled program for the slots of one queue, or of several queues side by side.
- `_Slots`: the trials in the slots of one queue, on one worker.
- `_Monitor`: what all workers report to: finished trials, progress and the signal to stop.

`_schedule` orders the programs, and each worker, a host thread, runs them one after another.

A GPU steps a few thousand worlds in hardly less time than a few. When no trial of a job waits and
few of its trials still run, a worker there suspends these trials and takes the next job. At the end
the suspended trials of several jobs are resumed side by side in one program.
"""

from __future__ import annotations

import functools
import threading
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding
from jax.sharding import PartitionSpec as P

from rps_jax import engines, errors
from rps_jax.control import registry, soft
from rps_jax.control.base import Law, LawParams
from rps_jax.engines import device, programs
from rps_jax.trials import host, trial
from rps_jax.trials.progress import Progress, ProgressCallback, Timing, no_progress
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Outcome, Rules, Trial, World
from rps_jax.world.physics import Physics

if TYPE_CHECKING:
    from jaxlib._jax import pytree  # pyright rejects the alias jax.tree_util.PyTreeDef

SEGMENT = 10.0  # [s] of simulated time in one call of a program; then slots are refilled
_REPORT_STEPS = 500  # control steps between two reports of an engine outside of JAX
_MAX_SUSPENDED = 8192  # trials of a job per GPU
_MAX_SIDE_BY_SIDE = 4  # jobs in one program; more would take long to compile

Tree = TypeVar("Tree")  # a pytree


class WorldBatch(NamedTuple):
    """Worlds and law parameters of some trials of a job."""

    indices: np.ndarray  # (n,) indices of the trials in the run
    worlds: World  # leaves (n, ...), on the host
    stage: Any  # a `Stage`, or the models of an engine outside of JAX
    params: Any = ()  # `LawParams` with leaves (n, ...), on the host; () if not yet known

    def with_params(self, params: LawParams) -> WorldBatch:
        """Return the trials with the same law parameters in every world."""
        count, dtype = self.indices.size, jnp.result_type(float)
        same = jax.tree.map(lambda x: np.full((count, *np.shape(x)), x, dtype), params)
        return self._replace(params=same)

    @property
    def law(self) -> Law:
        """Law of the parameters."""
        return registry.law_of(self.params)

    @property
    def inputs(self) -> Inputs:
        """Inputs of the program, which differ from trial to trial."""
        return self.worlds, self.params

    def split(self, count: int) -> tuple[WorldBatch, WorldBatch | None]:
        """Return the first `count` trials, and the rest if there is one."""
        arrays = self._replace(stage=None)
        parts = slice(count), slice(count, None)
        first, rest = (rows(arrays, part)._replace(stage=self.stage) for part in parts)
        return first, rest if rest.indices.size else None


Inputs = tuple[World, LawParams]


class Job(NamedTuple):
    """Trials that one compiled program can step."""

    program: Hashable  # key of the program; jobs with equal keys can be joined
    num_trials: int  # at most; there are no more slots than that
    batches: Iterable[WorldBatch]  # of one law, and of one stage if JAX traces the engine

    def shifted(self, first: int) -> Job:
        """Return the job with indices of trials that count from `first`."""
        batches = (batch._replace(indices=first + batch.indices) for batch in self.batches)
        return self._replace(batches=batches)


Collect = Callable[[np.ndarray, Outcome], object]  # indices (m,) of trials and their outcomes


class BatchSize(TypedDict, total=False):
    """Resources of functions that run trials."""

    slots: int | None  # worlds that one worker steps at once on each device of the host
    workers: int | None  # host threads


class BatchOptions(BatchSize, total=False):
    """Keyword arguments of functions that run trials."""

    callback: ProgressCallback


def run(
    jobs: Sequence[Job],
    setting: Setting,
    *,
    slots: int | None = None,
    workers: int | None = None,
    collect: Collect,
    callback: ProgressCallback = no_progress,
) -> Timing:
    """Run every trial of every job to its end.

    Args:
      jobs: trials by the program that steps them.
      setting: engine, physics and rules.
      slots: worlds that one worker steps at once on each device; by default as suits the engine.
      workers: host threads, each with its slots, or the threads of an engine that JAX
        does not trace; by default as suits the engine.
      collect: called with trials that ended, in any order, by one thread at a time.
      callback: called with the progress after every segment, by one thread at a time.

    Returns:
      The times of compilation and run, and the simulated time.
    """
    engine, backend = engines.get(setting.engine), jax.default_backend()
    slots = engine.slots(backend) if slots is None else slots
    workers = engine.workers(backend) if workers is None else workers
    errors.check_count("slots", slots, at_most=10_000_000)
    errors.check_count("workers", workers, at_most=1024)
    monitor = _Monitor(collect, callback, workers)
    start_time = time.perf_counter()
    tasks: list[Callable[[], object]]
    if not engine.traced:
        count = max(1, min(workers, len(jobs)))
        tasks = [partial(_run_on_host, job, setting, workers // count, monitor) for job in jobs]
    else:
        queues = [_TrialQueue(job) for job in jobs]
        single, joint = _schedule(queues, setting, slots, workers)
        monitor.start(len(single) + len(joint))
        tasks = [partial(_work, single, joint, monitor, index) for index in range(workers)]
        if backend != "cpu":  # an idle processor: compile all programs at once, first used first
            tasks += [program.compiled for program in (*single, *joint)]
        count = len(tasks)
    _run_in_threads(tasks, count, monitor)
    total = time.perf_counter() - start_time
    monitor.warn_of_nan_twists()
    return Timing(monitor.compile, total - monitor.compile, monitor.simulated)


def rows(tree: Tree, index: Any) -> Tree:
    """Return the rows `index` of every leaf; an index is whatever arrays take."""
    return jax.tree.map(lambda leaf: leaf[index], tree)


def _run_in_threads(tasks: Sequence[Callable[[], object]], count: int, monitor: _Monitor) -> None:
    """Run tasks on `count` threads; the first that fails stops the others."""
    with ThreadPoolExecutor(count) as pool:
        futures = [pool.submit(device.standard_jax()(task)) for task in tasks]
        try:
            for future in as_completed(futures):
                future.result()
        except BaseException:
            monitor.stop = True
            monitor.queues_empty.abort()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


class _Monitor:
    """Finished trials, progress and stop signal of all workers of a run."""

    def __init__(self, collect: Collect, callback: ProgressCallback, workers: int):
        self.queues_empty = threading.Barrier(workers)  # workers wait until no trial waits
        self.simulated = 0.0  # [s] summed over trials
        self.compile = 0.0  # [s] that the worker who waited longest had no program
        self.stop = False  # set when one worker fails or the user interrupts
        self._finished = self._nan_twists = 0  # trials
        self._compiled: set[_Program] = set()
        self._programs = 0  # that the run needs
        self._waits: defaultdict[int, float] = defaultdict(float)  # [s] for compilation, by thread
        self._collect, self._callback = collect, callback
        self._lock = threading.Lock()

    def add(self, indices: np.ndarray, outcomes: Outcome, simulated: float) -> None:
        """Add the trials that ended in a segment, and the time [s] that all trials advanced."""
        with self._lock:
            if indices.size:
                self._collect(indices, outcomes)
            self._finished += indices.size
            self._nan_twists += int(np.count_nonzero(outcomes.nan_twist))
            self.simulated += simulated
            self._report()

    def warn_of_nan_twists(self) -> None:
        """Warn if a law returned a twist that is not finite."""
        if self._nan_twists:
            warnings.warn(
                f"a law returned NaN or infinity in {self._nan_twists} of {self._finished} trials: "
                "they ended as diverged",
                stacklevel=4,
            )

    def start(self, programs: int) -> None:
        """Report that a run starts, which needs this number of programs."""
        self._programs = programs
        self._report()

    def _report(self) -> None:
        counts = {"compiled": len(self._compiled), "programs": self._programs}
        self._callback(Progress(self._finished, self.simulated, self.compile, **counts))

    def add_compile_time(self, program: _Program, seconds: float) -> None:
        """Add a time [s] for which the worker of this thread waited for a program."""
        with self._lock:
            self._compiled.add(program)
            self._waits[threading.get_ident()] += seconds
            self.compile = max(self._waits.values())
            self._report()


# --- engines outside of JAX ----------------------------------------------------------------


def _run_on_host(job: Job, setting: Setting, threads: int, monitor: _Monitor) -> None:
    """Run the trials of a job with an engine that JAX does not trace, batch by batch."""
    period = setting.physics.control_period
    for batch in job.batches:
        loop = ControlLoop(setting.physics, setting.rules, batch.law)
        steps = host.run(batch.stage, *batch.inputs, loop, max(1, threads))
        reported, previous = np.zeros(batch.indices.size, bool), 0
        for index, (trials, _) in enumerate(steps, 1):
            done = np.asarray(trials.done)
            if index % _REPORT_STEPS and not done.all():
                continue
            ended, total = np.flatnonzero(done & ~reported), int(np.asarray(trials.steps).sum())
            outcomes = jax.device_get(trial.outcome(trials, period))
            simulated = (total - previous) * period
            monitor.add(batch.indices[ended], rows(outcomes, ended), simulated)
            reported, previous = done, total
            if monitor.stop:
                return


# --- engines in JAX ------------------------------------------------------------------------


class _Suspended(NamedTuple):
    """Running trials of a job that left their slots."""

    batch: WorldBatch
    trials: Trial  # leaves (n, ...), on the host
    fresh: np.ndarray  # (n,) whether a trial has yet to start


class _TrialQueue:
    """Trials of a job that wait for a slot, and its suspended trials; workers share it."""

    def __init__(self, job: Job):
        self.num_trials, self._batches = job.num_trials, iter(job.batches)
        self.example: WorldBatch = next(self._batches)  # for its stage and its shapes
        self._waiting: WorldBatch | None = self.example  # rest of the current batch
        self._lock = threading.Lock()
        self.suspended: list[_Suspended] = []

    @property
    def is_empty(self) -> bool:
        """Whether no trial waits."""
        with self._lock:
            self._waiting = self._waiting or next(self._batches, None)
            return self._waiting is None

    def take(self, count: int) -> list[WorldBatch]:
        """Remove and return up to `count` waiting trials."""
        batches = []
        with self._lock:
            while count and (batch := self._waiting or next(self._batches, None)):
                first, self._waiting = batch.split(count)
                batches.append(first)
                count -= first.indices.size
        return batches


def _schedule(
    queues: Sequence[_TrialQueue], setting: Setting, slots: int, workers: int
) -> tuple[list[_Program], list[_Program]]:
    """Return the programs to run first, one for each long queue until few of its trials run.

    Return also the programs to run then, for suspended trials and short queues, side by side.
    """
    devices, max_suspended = jax.device_count(), _max_suspended()
    single, joint = list[_Program](), list[_Program]()
    groups: dict[Hashable, list[tuple[_TrialQueue, int]]] = {}
    side_by_side = engines.get(setting.engine).side_by_side
    for index, queue in enumerate(queues):
        per_device = -(-queue.num_trials // devices)
        width = devices * min(slots, per_device)
        if width > max_suspended:
            single.append(_Program([queue], [width], setting))
            width = min(devices * per_device, workers * max_suspended)
        if width:
            key = queue.example.law if side_by_side else index
            groups.setdefault(key, []).append((queue, width))
    for group in groups.values():
        for i in range(0, len(group), _MAX_SIDE_BY_SIDE):
            members, widths = zip(*group[i : i + _MAX_SIDE_BY_SIDE], strict=True)
            joint.append(_Program(members, widths, setting))
    return single, joint


def _max_suspended() -> int:
    """Return how many running trials of a job a worker suspends, at most."""
    return 0 if jax.default_backend() == "cpu" else jax.device_count() * _MAX_SUSPENDED


class _Program:
    """Compiled program that steps the slots of one queue, or of several of one law side by side."""

    def __init__(self, queues: Sequence[_TrialQueue], slots: Sequence[int], setting: Setting):
        self.queues, self.slots, self.setting = queues, slots, setting
        self.law = queues[0].example.law
        self.stages = tuple(queue.example.stage for queue in queues)
        self.sharding = None
        if jax.device_count() > 1:
            mesh = jax.make_mesh((jax.device_count(),), ("worlds",), (AxisType.Auto,))
            self.sharding = NamedSharding(mesh, P("worlds"))
        self._lock = threading.Lock()
        self._compiled: _Advance | None = None

    def compiled(self) -> _Advance:
        """Return the compiled function; the first caller compiles it and others wait."""
        with self._lock:
            if self._compiled is None:
                self._compiled = self._compile()
            return self._compiled

    def put(self, tree: Tree) -> Tree:
        """Put leaves (slots, ...) on the device, or split them over all devices of the host."""
        return jax.device_put(tree, self.sharding)

    def _compile(self) -> _Advance:
        inputs, trials = zip(*map(self.shapes, range(len(self.queues))), strict=True)
        masks = tuple(jax.ShapeDtypeStruct((n,), bool, sharding=self.sharding) for n in self.slots)
        stages, rules = jax.eval_shape(lambda: (self.stages, self.setting.rules))
        leaves, structure = jax.tree.flatten((stages, inputs, trials, masks, masks, rules))
        physics = self.setting.physics
        return _compile_advance(physics, self.law, self.sharding, structure, tuple(leaves))

    def shapes(self, index: int) -> tuple[Inputs, Trial]:
        """Return the shapes of the inputs and trials (slots, ...) of a queue."""
        single = rows(self.queues[index].example.inputs, slice(1))
        started = jax.eval_shape(partial(trial.start_all, law=self.law), *single, np.ones(1, bool))

        def shape(leaf: jax.Array) -> jax.ShapeDtypeStruct:
            size = self.slots[index], *leaf.shape[1:]
            return jax.ShapeDtypeStruct(size, leaf.dtype, sharding=self.sharding)

        return jax.tree.map(shape, (single, started))


class _Segment(NamedTuple):
    """State of the slots of one queue after a segment."""

    steps: Any  # (slots,) int: control steps of each trial in this segment
    done: Any  # (slots,) bool
    outcome: Outcome  # (slots, ...)


_Advance = Callable[..., tuple[tuple[Trial, ...], tuple[_Segment, ...]]]


@functools.lru_cache(maxsize=32)
def _compile_advance(
    physics: Physics,
    law: Law,
    sharding: NamedSharding | None,
    structure: pytree.PyTreeDef,
    leaves: tuple[jax.ShapeDtypeStruct, ...],
) -> _Advance:
    """Compile `trial.advance` by one segment for arguments of these shapes; cached."""

    def advance(
        stages: tuple[Any, ...],
        inputs: tuple[Inputs, ...],
        trials: tuple[Trial, ...],
        fresh: tuple[jax.Array, ...],
        live: tuple[jax.Array, ...],
        rules: Rules,
    ) -> tuple[tuple[Trial, ...], tuple[_Segment, ...]]:
        pairs = zip(inputs, live, strict=True)
        started = [trial.start_all(*leaves, mask, law=law) for leaves, mask in pairs]
        current = tuple(map(jax.vmap(soft.tree_where), fresh, started, trials))
        steps = max(1, round(SEGMENT / physics.control_period))
        loop = ControlLoop(physics, rules, law)
        batches = zip(stages, inputs, current, strict=True)
        advanced = trial.advance([(stage, *x, state) for stage, x, state in batches], loop, steps)
        # Outcomes are in the same program: another one would wait for other workers' segments.
        return advanced, tuple(
            _Segment(b.steps - a.steps, b.done, trial.outcome(b, physics.control_period))
            for a, b in zip(current, advanced, strict=True)
        )

    if sharding is not None:  # each device runs its own worlds and waits for no other
        advance = jax.shard_map(
            advance,
            mesh=sharding.mesh,
            in_specs=(P(), *(P("worlds"),) * 4, P()),
            out_specs=P("worlds"),
            check_vma=False,
        )
    arguments = jax.tree.unflatten(structure, leaves)
    if sharding is None:
        static = (physics, SEGMENT)
        return programs.compile_function(advance, arguments, law=law, donate=2, static=static)
    return programs.compile_lowered(jax.jit(advance, donate_argnums=2).lower(*arguments))


class _Slots:
    """Slots of one queue in a program of one worker, and the trials in them."""

    def __init__(self, program: _Program, index: int, resume: bool):
        """Fill the slots of the queue `index` with suspended trials, or else waiting ones."""
        queue, slots = program.queues[index], program.slots[index]
        self._queue, self._program = queue, program
        self._indices = np.zeros(slots, np.int64)  # of the trials in the run
        self.live = np.zeros(slots, bool)  # whether a slot holds a trial that has not ended
        self._fresh = np.ones(slots, bool)  # whether a trial starts with the next segment
        example = queue.example.inputs
        self._host = jax.tree.map(lambda leaf: np.repeat(leaf[:1], slots, axis=0), example)
        _, shapes = program.shapes(index)
        trials, end = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes), 0
        suspended = queue.suspended if resume else []
        for batch, states, fresh in suspended:
            at = slice(end, end := end + batch.indices.size)
            _write(trials, at, states)
            self._fresh[at] = fresh
        self.trials = program.put(trials)
        batches = [batch for batch, *_ in suspended] or queue.take(slots)
        self.inputs = self._fill(np.arange(slots), batches)

    def _fill(self, at: np.ndarray, batches: Sequence[WorldBatch]) -> Inputs:
        """Fill the first of the slots `at` with trials; return the inputs of all slots."""
        end = 0
        for batch in batches:
            slots = at[end : (end := end + batch.indices.size)]
            self._indices[slots], self.live[slots] = batch.indices, True
            _write(self._host, slots, batch.inputs)
        # A copy: the device may otherwise share the host's memory, which the next call changes.
        return self._program.put(jax.tree.map(np.copy, self._host))

    def arguments(self) -> tuple[Inputs, Trial, jax.Array, jax.Array]:
        """Return the arguments of the program for the next segment, in which fresh trials start."""
        fresh, live = self._program.put(jax.tree.map(np.copy, (self._fresh, self.live)))
        self._fresh[:] = False
        return self.inputs, self.trials, fresh, live

    def refill(self, segment: _Segment) -> tuple[np.ndarray, Outcome, float]:
        """Replace the trials that ended in a segment; return the arguments of `_Monitor.add`."""
        steps, done, outcomes = segment
        at = np.flatnonzero(done & self.live)
        period = self._program.setting.physics.control_period
        ended = self._indices[at], rows(outcomes, at), float(steps.sum()) * period
        self.live[at] = False
        if batches := self._queue.take(at.size):
            self.inputs = self._fill(at, batches)
            self._fresh[at] = self.live[at]
        return ended

    def suspend(self) -> None:
        """Move the trials that run to the queue."""
        if (at := np.flatnonzero(self.live)).size:
            worlds, params = rows(self._host, at)
            batch = WorldBatch(self._indices[at], worlds, self._queue.example.stage, params)
            trials = rows(jax.device_get(self.trials), at)
            self._queue.suspended.append(_Suspended(batch, trials, self._fresh[at]))


def _write(tree: Tree, index: Any, values: Tree) -> None:
    """Write the rows `index` of every leaf."""
    for target, source in zip(jax.tree.leaves(tree), jax.tree.leaves(values), strict=True):
        target[index] = source


def _work(
    single: Sequence[_Program], joint: Sequence[_Program], monitor: _Monitor, index: int
) -> None:
    """Run programs on one worker until no trial waits or runs; `index` is the worker's."""
    first = index % max(1, len(single))
    for program in (*single[first:], *single[:first]):
        _run(program, _max_suspended(), monitor)
    monitor.queues_empty.wait()
    for program in joint[index :: monitor.queues_empty.parties]:
        _run(program, 0, monitor)


def _run(program: _Program, max_suspended: int, monitor: _Monitor) -> None:
    """Run segments until no trial waits and at most `max_suspended` run; suspend these."""
    if monitor.stop:
        return
    resume = not max_suspended
    queues = [_Slots(program, index, resume) for index in range(len(program.queues))]
    if not any(slots.live.any() for slots in queues):
        return
    start_time = time.perf_counter()
    advance, stages, rules = program.compiled(), program.stages, program.setting.rules
    monitor.add_compile_time(program, time.perf_counter() - start_time)
    with ThreadPoolExecutor(1) as reporter:  # reports a segment while the next one runs
        report: Future[object] = reporter.submit(int)  # of the last segment that was read
        unread: tuple[_Segment, ...] | None = None  # segment whose results are still on the GPU

        def read(segments: tuple[_Segment, ...]) -> Future[object]:
            segments = jax.device_get(segments)
            ended = [slots.refill(s) for slots, s in zip(queues, segments, strict=True)]
            report.result()
            return reporter.submit(lambda: [monitor.add(*arguments) for arguments in ended])

        while not monitor.stop and sum(slots.live.sum() for slots in queues) > max_suspended:
            arguments = zip(*(slots.arguments() for slots in queues), strict=True)
            advanced, segments = advance(stages, *arguments, rules)
            for slots, trials in zip(queues, advanced, strict=True):
                slots.trials = trials
            # Where no trial waits for a slot, a GPU runs the next segment while the host reads.
            overlap = _max_suspended() and all(queue.is_empty for queue in program.queues)
            segments, unread = (unread, segments) if overlap else (segments, None)
            if segments is not None:
                report = read(segments)
        if unread is not None:
            report = read(unread)
        report.result()
    for slots in queues:
        slots.suspend()
