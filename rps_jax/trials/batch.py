"""Batch runs: a compiled program steps slots, and each slot is refilled when its trial ends.

A `Request` has the worlds of its trials, by the program that steps them. There are three kinds:
named cases (`pushes.Cases`), the chunks of a sweep (`runs.results.Results`), and `Candidates`.

    request = Candidates(stack(["rps", "rps,L=0.2"]), [domain], seed=3, worlds=np.arange(100))
    (outcome,), timing = outcomes([request], setting)
    outcome.success      # (2, 100)
    request.distances    # (100,) [m] from the start to the target

A job holds the trials that one program can step: one law, one shape family. Its worlds are built
batch by batch when slots become free, so that memory does not grow with the number of trials.

- `_TrialQueue`: the trials of a job that wait for a slot.
- `_Program`: a program for the slots of one queue, or of several queues side by side.
- `_SlotData`: the inputs and trials in the slots of one queue, on one worker; `segments` decides
  when they are filled, stepped and read.
- `_Monitor`: what all workers report to: finished trials, progress and the signal to stop.

Each worker is a host thread with its own slots on one device. The workers of all devices take
trials from the same queues after every segment, so that no device waits for another one. The same
program serves all devices of the host.

A GPU steps the trials of several jobs side by side, and runs a segment while the host reads the
previous one: a slot whose trial has ended is refilled one segment later. The programs of networks
step idle slots, too, so a worker moves the last trials to a program with fewer slots.
"""

from __future__ import annotations

import functools
import itertools
import math
import threading
import time
import warnings
from collections import defaultdict, deque
from collections.abc import Callable, Hashable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, Protocol, Unpack

import jax
import numpy as np

from rps_jax import engines, errors
from rps_jax.control.base import Law
from rps_jax.engines import device, programs
from rps_jax.record.files import Arrays
from rps_jax.trials import law_check, segments, trial
from rps_jax.trials.progress import Progress, ProgressCallback, Segment, Timing, no_progress
from rps_jax.trials.segments import Ended, Fill, Filled, Launch, Read, Report, Slots
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Outcome, SegmentState, Trial
from rps_jax.trials.worlds import BatchOptions, Collect, Inputs, Job, Tree, WorldBatch, rows
from rps_jax.world.physics import Physics

if TYPE_CHECKING:
    from jaxlib._jax import Device, pytree  # pyright rejects the aliases of both

SEGMENT = 10.0  # [s] of simulated time in one call of a program; then slots are refilled
_REPORT_STEPS = 500  # control steps between two reports of an engine outside of JAX
_FIRST_TRIALS = 16384  # of a job on a GPU in the first segment, while more are built
_TAIL_SLOTS = 8192  # of a job, on a GPU on which no trial waits
_MAX_SIDE_BY_SIDE = 4  # jobs in one program; more would take long to compile


class Request(Protocol):
    """Trials to run."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the outcomes, in which the index of a trial counts in row-major order."""
        ...

    def jobs(self, setting: Setting) -> Iterable[Job]:
        """Return the worlds and law parameters of the trials, by the program that steps them."""
        ...


class RunOptions(BatchOptions, total=False):
    """Keyword arguments of `run_batch`."""

    capacity: Callable[[int], int]


def run_batch(
    requests: Sequence[Request],
    setting: Setting,
    collect: Collect,
    *,
    capacity: Callable[[int], int] = lambda trials: trials,
    **options: Unpack[BatchOptions],
) -> Timing:
    """Run every trial of every request to its end.

    Args:
      requests: their trials share programs. The indices of the trials of a request follow those of
        the previous request.
      setting: engine, physics and rules.
      collect: called with trials that ended, in any order, by one thread at a time.
      capacity: number of trials that a program has slots for, by the number of its trials.
      options: slots, workers and callback, as of `run`.

    Returns:
      Where the time went.
    """
    groups: dict[Hashable, list[tuple[int, Iterable[WorldBatch]]]] = {}
    for request, first in zip(requests, _first_trials(requests), strict=False):
        for program, count, batches in request.jobs(setting):
            groups.setdefault(program, []).append((count, map(partial(_shifted, first), batches)))
    jobs = []
    for program, group in groups.items():
        counts, batches = zip(*group, strict=True)
        whole = itertools.chain.from_iterable(batches)
        jobs.append(Job(program, capacity(sum(counts)), whole))
    return run(jobs, setting, collect=collect, **options)


def _shifted(first: int, batch: WorldBatch) -> WorldBatch:
    """Return a batch with indices of trials that count from `first`."""
    return batch._replace(indices=first + batch.indices)


def outcomes(
    requests: Sequence[Request], setting: Setting, **options: Unpack[RunOptions]
) -> tuple[list[Outcome], Timing]:
    """Run every trial of every request by `run_batch`, and collect the outcomes in arrays.

    Returns:
      The outcomes of each request, on the host with leaves (*shape, ...); and where the time went.
    """
    columns: Arrays = {}
    *firsts, count = _first_trials(requests)

    def collect(indices: np.ndarray, ended: Outcome) -> None:
        for name, leaf in ended.columns().items():
            if name not in columns:
                columns[name] = np.empty((count, *leaf.shape[1:]), leaf.dtype)
            columns[name][indices] = leaf

    timing = run_batch(requests, setting, collect, **options)
    whole = Outcome.of_columns(columns)
    trials = (np.arange(math.prod(x.shape)).reshape(x.shape) for x in requests)
    pairs = zip(firsts, trials, strict=True)
    return [rows(whole, first + index) for first, index in pairs], timing


def _first_trials(requests: Sequence[Request]) -> list[int]:
    """Return the index of the first trial of each request, and the number of all trials."""
    return np.cumsum([0, *(math.prod(request.shape) for request in requests)]).tolist()


# --- jobs --------------------------------------------------------------------------------------


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
      workers: host threads for each device, each with its slots, or the threads of an engine that
        JAX does not trace; by default as suits the engine.
      collect: called with trials that ended, in any order, by one thread at a time.
      callback: called with the progress after every segment, by one thread at a time.

    Returns:
      The times of compilation and run, and the simulated time.

    Raises:
      Exception: the first one of a job, after all other jobs have ended.
    """
    engine, backend = engines.get(setting.engine), jax.default_backend()
    slots = slots_of(setting, slots)
    workers = engine.workers(backend) if workers is None else workers
    errors.check_count("slots", slots, at_most=10_000_000)
    errors.check_count("workers", workers, at_most=1024)
    monitor = _Monitor(collect, callback)
    tasks: list[Callable[[], object]]
    if not engine.traced:
        count = max(1, min(workers, len(jobs)))
        shared = setting, workers // count, monitor
        tasks = [
            partial(monitor.isolate, i, partial(_run_on_host, job, *shared))
            for i, job in enumerate(jobs)
        ]
    else:
        devices = _devices()
        groups = _schedule([*itertools.starmap(_TrialQueue, enumerate(jobs))], setting, slots)
        compilations = [
            partial(monitor.isolate, x.key, partial(x.compiled, d))
            for x in itertools.chain(*groups)
            for d in devices
        ]
        for program, *_ in groups:
            for queue in program.queues if programs.identity(program.law) is None else ():
                check = partial(law_check.warn_of_difference, queue.example, setting)
                monitor.isolate(program.key, check)
        monitor.programs = len(compilations)
        monitor.report()
        tasks = [partial(_work, groups, monitor, *x) for x in enumerate(devices * workers)]
        if backend != "cpu":  # idle processors: compile all programs at once, first used first
            tasks += compilations
        count = len(tasks)
    _run_in_threads(tasks, count, monitor)
    for error in monitor.failures.values():
        raise error
    monitor.warn_of_nan_twists()
    return Timing(monitor.compile, monitor.elapsed - monitor.compile, monitor.simulated)


def slots_of(setting: Setting, slots: int | None = None, trials: int | None = None) -> int:
    """Return the number of slots of a program, or of the program of a job with so many trials."""
    slots = engines.get(setting.engine).slots(jax.default_backend()) if slots is None else slots
    return slots if trials is None else min(slots, -(-trials // len(_devices())))


def _run_in_threads(tasks: Sequence[Callable[[], object]], count: int, monitor: _Monitor) -> None:
    """Run tasks on `count` threads; the first that fails stops the others."""
    with ThreadPoolExecutor(count) as pool:
        futures = [pool.submit(device.standard_jax()(task)) for task in tasks]
        try:
            for future in as_completed(futures):
                future.result()
        except BaseException:
            monitor.stop = True
            pool.shutdown(wait=False, cancel_futures=True)
            raise


class _Monitor:
    """Finished trials, progress and stop signal of all workers of a run."""

    def __init__(self, collect: Collect, callback: ProgressCallback):
        self.simulated = 0.0  # [s] summed over trials
        self.compile = 0.0  # [s] that the worker who waited longest had no program
        self.stop = False  # set when one worker fails or the user interrupts
        self.failures: dict[int, Exception] = {}  # of groups of jobs, as of a law that fails
        self._start_time = time.perf_counter()
        self._finished = self._nan_twists = 0  # trials
        self._compiled: set[object] = set()
        self.programs = 0  # that the run needs
        self._waits: defaultdict[int, float] = defaultdict(float)  # [s] for compilation, by thread
        self._collect, self._callback = collect, callback
        self._lock = threading.Lock()

    @property
    def elapsed(self) -> float:
        """Wall clock [s] since the start of the run."""
        return time.perf_counter() - self._start_time

    def add(self, *ended: _Ended, segment: Segment | None = None) -> None:
        """Add the trials of some queues that ended in a segment; an error here ends the run."""
        with self._lock:
            try:
                for indices, outcomes, simulated in ended:
                    if indices.size:
                        self._collect(indices, outcomes)
                    self._finished += indices.size
                    self._nan_twists += int(np.count_nonzero(outcomes.nan_twist))
                    self.simulated += simulated
                self.report(segment)
            except BaseException:
                self.stop = True
                raise

    def isolate(self, key: int, task: Callable[[], object]) -> None:
        """Run a task of a group of jobs; its error ends this group, and the others go on."""
        try:
            task()
        except Exception as error:
            if self.stop:
                raise
            self.failures.setdefault(key, error)

    def stops(self, program: _Program) -> bool:
        """Return whether the run or the group of a program has ended early."""
        return self.stop or program.key in self.failures

    def warn_of_nan_twists(self) -> None:
        """Warn if a law returned a twist that is not finite."""
        if self._nan_twists:
            warnings.warn(
                f"a law returned NaN or infinity in {self._nan_twists} of {self._finished} trials: "
                "they ended as diverged",
                stacklevel=4,
            )

    def report(self, segment: Segment | None = None) -> None:
        """Report the progress of the run."""
        counts = {"compiled": len(self._compiled), "programs": self.programs}
        times = self._finished, self.simulated, self.compile
        self._callback(Progress(*times, **counts, segment=segment))

    def add_compile_time(self, program: object, seconds: float) -> None:
        """Add a time [s] for which the worker of this thread waited for a program."""
        with self._lock:
            self._compiled.add(program)
            self._waits[threading.get_ident()] += seconds
            self.compile = max(self._waits.values())
            self.report()


# --- engines outside of JAX ----------------------------------------------------------------


def _run_on_host(job: Job, setting: Setting, threads: int, monitor: _Monitor) -> None:
    """Run the trials of a job with an engine that JAX does not trace, batch by batch."""
    period = setting.physics.control_period
    for batch in job.batches:
        loop = ControlLoop(setting.physics, setting.rules, batch.law)
        inputs = setting.simulator, batch.stage, *batch.inputs
        steps = trial.run_on_host(*inputs, loop, max(1, threads))
        reported, previous = np.zeros(batch.indices.size, bool), 0
        for index, trials in enumerate(steps):
            done = np.asarray(trials.done)
            if index % _REPORT_STEPS and not done.all():
                continue
            ended, total = np.flatnonzero(done & ~reported), int(np.asarray(trials.steps).sum())
            outcomes = jax.device_get(trial.compiled_outcome(trials, batch.worlds, loop))
            simulated = (total - previous) * period
            monitor.add((batch.indices[ended], rows(outcomes, ended), simulated))
            reported, previous = done, total
            if monitor.stop:
                return


# --- engines in JAX ------------------------------------------------------------------------


def _devices() -> list[Device]:
    """Return the devices of the host that run the same programs."""
    first, *rest = jax.local_devices()
    return [first, *(x for x in rest if x.device_kind == first.device_kind)]


class _Running(NamedTuple):
    """Running trials of a job that left the slots of a program."""

    indices: np.ndarray  # (n,) of the trials in the run
    inputs: Inputs  # leaves (n, ...), on the host
    trials: Trial  # leaves (n, ...), on the host
    fresh: np.ndarray  # (n,) whether a trial has yet to start


class _TrialQueue:
    """Trials of a job that wait for a slot; workers share it."""

    def __init__(self, index: int, job: Job):
        self.index, self.num_trials, self._batches = index, job.num_trials, iter(job.batches)
        self.example: WorldBatch = next(self._batches)  # for its stage and its shapes
        self._waiting: WorldBatch | None = self.example  # rest of the current batch
        self.size = sum(leaf[0].size for leaf in jax.tree.leaves(self.example.worlds))  # of a world
        inputs = rows(self.example.inputs, slice(1))
        start = partial(trial.start_all, law=self.example.law)
        self.shapes = inputs, jax.eval_shape(start, *inputs, np.ones(1, bool))  # of one trial
        self._lock = threading.Lock()

    def take(self, count: int) -> list[WorldBatch]:
        """Remove and return up to `count` waiting trials."""
        batches = []
        with self._lock:
            while count and (batch := self._waiting or next(self._batches, None)):
                first, self._waiting = batch.split(count)
                batches.append(first)
                count -= first.indices.size
        return batches


def _schedule(queues: Sequence[_TrialQueue], setting: Setting, slots: int) -> list[list[_Program]]:
    """Return groups of programs for the same queues, the group with most trials first.

    The second program of a group has fewer slots than the first; many groups have only one.
    """
    groups: dict[Hashable, list[_TrialQueue]] = {}
    tail, schedule = _tail_slots(), list[list[_Program]]()
    side_by_side = tail is not None and engines.get(setting.engine).side_by_side
    for index, queue in enumerate(queues):
        groups.setdefault(queue.example.law if side_by_side else index, []).append(queue)
    for group in groups.values():
        for i in range(0, len(group), _MAX_SIDE_BY_SIDE):
            # The largest worlds, which take longest, start first.
            members = sorted(group[i : i + _MAX_SIDE_BY_SIDE], key=lambda x: -x.size)
            widths = [slots_of(setting, slots, queue.num_trials) for queue in members]
            sizes = dict.fromkeys([tuple(widths), tuple(min(n, tail or n) for n in widths)])
            schedule.append([_Program(members, size, setting) for size in sizes])
    return sorted(schedule, key=lambda x: -sum(queue.num_trials for queue in x[0].queues))


def _tail_slots() -> int | None:
    """Return the number of slots of a job when no trial waits; None: it does not change."""
    return None if jax.default_backend() == "cpu" else _TAIL_SLOTS


class _Program:
    """Program that steps the slots of one queue, or of several of one law side by side."""

    def __init__(self, queues: Sequence[_TrialQueue], slots: Sequence[int], setting: Setting):
        self.queues, self.slots, self.setting = queues, slots, setting
        self.law, self.key = queues[0].example.law, queues[0].index  # the key of its group
        self.period = setting.physics.control_period
        self.stages = tuple(queue.example.stage for queue in queues)
        self._locks: defaultdict[object, threading.Lock] = defaultdict(threading.Lock)

    def compiled(self, device: Device) -> _Advance:
        """Return the function that a device runs; the first caller compiles it and others wait."""
        inputs, trials = zip(*map(self.shapes, range(len(self.queues))), strict=True)
        masks = tuple(jax.ShapeDtypeStruct((n,), bool) for n in self.slots)
        stages, rules = jax.eval_shape(lambda: (self.stages, self.setting.rules))
        steps = jax.ShapeDtypeStruct((), np.int32)
        leaves, structure = jax.tree.flatten((stages, inputs, trials, masks, masks, rules, steps))
        with self._locks[None]:  # one device traces for all
            traced = _trace_advance(self.setting.physics, self.law, structure, tuple(leaves))
        with self._locks[device]:
            return traced(device)

    def shapes(self, index: int) -> tuple[Inputs, Trial]:
        """Return the shapes of the inputs and trials (slots, ...) of a queue."""
        slots = self.slots[index]
        shape = lambda x: jax.ShapeDtypeStruct((slots, *x.shape[1:]), x.dtype)  # noqa: E731
        return jax.tree.map(shape, self.queues[index].shapes)


_Advance = Callable[..., trial.Advanced]
_Ended = tuple[np.ndarray, Outcome, float]  # indices of trials, outcomes, and [s] that all advanced


@functools.lru_cache(maxsize=32)
def _trace_advance(
    physics: Physics,
    law: Law,
    structure: pytree.PyTreeDef,
    leaves: tuple[jax.ShapeDtypeStruct, ...],
) -> Callable[[Device], _Advance]:
    """Trace `trial.segment_of` for arguments of these shapes; cached."""

    arguments = jax.tree.unflatten(structure, leaves)
    segment = trial.segment_of(physics, law)
    return programs.trace_function(segment, arguments, law=law, donate=2, static=(physics,))


class _SlotData:
    """Inputs and trials in the slots of one queue, on the host and on a device."""

    def __init__(self, program: _Program, index: int, running: _Running | None, device: Device):
        """Prepare the slots of the queue `index`, of which the first hold the running trials."""
        self.queue, self._device = program.queues[index], device
        size, example = program.slots[index], self.queue.example.inputs
        self._host = jax.tree.map(lambda leaf: np.repeat(leaf[:1], size, axis=0), example)
        self._inputs: Inputs | None = None  # on the device, if they are those on the host
        trials = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), program.shapes(index)[1])
        indices, fresh = np.zeros(0, int), np.zeros(0, bool)
        if running is not None:
            indices, fresh, at = running.indices, running.fresh, slice(running.indices.size)
            _write(self._host, at, running.inputs)
            _write(trials, at, running.trials)
        self.slots = segments.occupied(size, indices, fresh)
        self.trials = jax.device_put(trials, device)

    def fill(self, free: np.ndarray) -> np.ndarray:
        """Write waiting trials into the first of the free slots; return their indices."""
        indices = [np.zeros(0, int)]
        for batch in self.queue.take(free.size) if free.size else ():
            _write(self._host, free[: batch.indices.size], batch.inputs)
            free, self._inputs = free[batch.indices.size :], None
            indices.append(batch.indices)
        return np.concatenate(indices)

    @property
    def inputs(self) -> Inputs:
        """Inputs of the program on the device."""
        if (inputs := self._inputs) is None:
            # A copy: the device may share the host's memory, which `fill` changes.
            inputs = jax.device_put(jax.tree.map(np.copy, self._host), self._device)
            self._inputs = inputs
        return inputs

    def remove(self, slots: Slots, launched: int) -> _Running | None:
        """Return the trials that run after so many segments, if there are any."""
        at = np.flatnonzero(slots.live)
        if not at.size:
            return None
        inputs, trials = rows(self._host, at), rows(jax.device_get(self.trials), at)
        return _Running(slots.trials[at], inputs, trials, slots.first[at] >= launched)


def _write(tree: Tree, index: object, values: Tree) -> None:
    """Write the rows `index` of every leaf."""
    for target, source in zip(jax.tree.leaves(tree), jax.tree.leaves(values), strict=True):
        target[index] = source


def _work(
    groups: Sequence[Sequence[_Program]], monitor: _Monitor, index: int, device: Device
) -> None:
    """Run groups of programs on a device until no trial waits or runs; `index` of the worker."""
    first = index % max(1, len(groups))
    for group in (*groups[first:], *groups[:first]):
        monitor.isolate(group[0].key, partial(_run_group, group, device, monitor))


def _run_group(group: Sequence[_Program], device: Device, monitor: _Monitor) -> None:
    """Run a group of programs on a device until no trial waits or runs."""
    running: list[_Running | None] = [None] * len(group[0].queues)
    for program, following in itertools.zip_longest(group, group[1:]):
        limits = [0] * len(running) if following is None else following.slots
        if monitor.stops(program):
            return
        running = _run(program, limits, running, device, monitor)


def _run(
    program: _Program,
    limits: Sequence[int],
    running: Sequence[_Running | None],
    device: Device,
    monitor: _Monitor,
) -> list[_Running | None]:
    """Run segments until no trial waits and at most `limits` of each queue run; return these."""
    data = [_SlotData(program, *trials, device) for trials in enumerate(running)]
    # A GPU runs a segment while the host reads another.
    ahead, at_first = (0, None) if _tail_slots() is None else (1, _FIRST_TRIALS)
    state, following = segments.start([x.slots for x in data], limits, ahead, at_first)
    actions, advance, end = deque(following), None, 0.0
    unread = deque[tuple[float, list[int], tuple[SegmentState, ...]]]()  # start, trials and results
    results: Sequence[SegmentState] = ()  # of the segment that was read
    segment: Segment | None = None  # that was read
    with ThreadPoolExecutor(1) as reporter:  # reports a segment while the next one runs
        report: Future[object] = reporter.submit(int)  # of the last segment that was read
        while actions:
            match actions.popleft():
                case Launch(fresh, live):
                    if advance is None:
                        advance = _load(program, device, monitor)
                        if monitor.stops(program):
                            break
                    masks = jax.device_put((tuple(fresh), tuple(live)), device)
                    inputs, trials = zip(*((x.inputs, x.trials) for x in data), strict=True)
                    start_time = monitor.elapsed
                    advanced, states = advance(inputs, trials, *masks)
                    for slots, moved in zip(data, advanced, strict=True):
                        slots.trials = moved
                    unread.append((start_time, [*map(np.count_nonzero, live)], states))
                case Report(at, indices):
                    ended = [  # trials, their outcomes, and the time [s] that all advanced
                        (trials, rows(x.outcome, slots), float(x.steps.sum()) * program.period)
                        for trials, slots, x in zip(indices, at, results, strict=True)
                    ]
                    report.result()
                    report = reporter.submit(partial(monitor.add, *ended, segment=segment))
                case Fill(free):
                    filled = [x.fill(slots) for x, slots in zip(data, free, strict=True)]
                    state, following = segments.step(state, Filled(filled, monitor.stops(program)))
                    actions.extend(following)
                case Read():
                    start, counts, states = unread.popleft()
                    results = jax.device_get(states)
                    start, end = max(start, end), monitor.elapsed
                    live = dict(zip((x.queue.index for x in data), counts, strict=True))
                    segment = Segment(device.id, start, end, live)
                    state, following = segments.step(state, Ended([x.done for x in results]))
                    actions.extend(following)
        report.result()
    return [x.remove(slots, state.launched) for x, slots in zip(data, state.slots, strict=True)]


def _load(program: _Program, device: Device, monitor: _Monitor) -> _Advance:
    """Return the compiled program with its constants on the device, for one segment."""
    start_time = monitor.elapsed
    advance = program.compiled(device)
    stages, rules = jax.device_put((program.stages, program.setting.rules), device)
    steps = np.int32(max(1, round(SEGMENT / program.period)))
    monitor.add_compile_time((program, device), monitor.elapsed - start_time)
    return lambda *arguments: advance(stages, *arguments, rules, steps)


# --- trials on demand ----------------------------------------------------------------------


def stepper(
    worlds: WorldBatch, setting: Setting, slots: int
) -> Callable[[Inputs, Trial | None, int], tuple[Trial, Outcome]]:
    """Return a function that steps trials on demand, with the bits of `run` with so many slots.

    It runs the same program. Its arguments are worlds and law parameters (n, ...) of the shapes of
    `worlds`, their trials (None: they start) and a number of control steps. It returns the trials
    and their outcomes so far, on the host.
    """
    slots = min(slots, _tail_slots() or slots)  # trials end in the smaller program
    program = _Program([_TrialQueue(0, Job(None, slots, [worlds]))], [slots], setting)
    blank = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), program.shapes(0)[1])
    advance, fresh = program.compiled(_devices()[0]), np.ones(slots, bool)

    def step(inputs: Inputs, trials: Trial | None, steps: int) -> tuple[Trial, Outcome]:
        count, results = len(inputs[0].qpos), []
        for first in range(0, count, slots):
            index = np.arange(first, first + slots)
            live, index = index < count, np.minimum(index, count - 1)
            state = blank if trials is None else rows(trials, index)
            state = state._replace(done=state.done | ~live)
            arguments = (rows(inputs, index),), (state,), (fresh & (trials is None),), (live,)
            advanced, states = advance(program.stages, *arguments, setting.rules, np.int32(steps))
            result = jax.tree.map(np.asarray, (advanced[0], states[0].outcome))
            results.append(rows(result, slice(count - first)))
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *results)

    return step
