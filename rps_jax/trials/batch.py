"""Trials on a device: slots of a batch, each refilled as soon as its trial ends.

A job is all that one compiled program runs; its trials come in parts, which are made only when a
slot waits for one of their trials, so that memory does not grow with the number of trials.
"""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from typing import Any, NamedTuple, TypedDict, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding
from jax.sharding import PartitionSpec as P

from rps_jax import engines, errors
from rps_jax.control.base import Law, LawParams
from rps_jax.engines import programs
from rps_jax.trials import host, trial
from rps_jax.trials.progress import Progress, ProgressCallback, Timing, no_progress
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Outcome, Rules, Trial, World
from rps_jax.world.physics import Physics

SEGMENT = 10.0  # [s] simulated between two looks at which trials have ended
# A GPU steps a few thousand worlds in hardly less time than a few. So a worker there sets aside
# what runs of a job when none of its trials waits and no more than this many run, and takes the
# next job; in the end what was set aside of all jobs is run side by side.
_ASIDE = 8192
_SIDE_BY_SIDE = 4  # jobs, at most: a program of more would be long in compiling


class WorldBatch(NamedTuple):
    """Some trials of a job."""

    indices: np.ndarray  # (n,) indices of the trials in the run
    worlds: World  # leaves (n, ...), on the host
    stage: Any
    params: Any = ()  # `LawParams` with leaves (n, ...), on the host; () if not yet known

    def with_params(self, params: LawParams) -> WorldBatch:
        """Return the trials with the same law parameters in every world."""
        count, dtype = self.indices.size, jnp.result_type(float)
        same = jax.tree.map(lambda x: np.full((count, *np.shape(x)), x, dtype), params)
        return self._replace(params=same)


class Job(NamedTuple):
    """Trials of one kind: one compiled program runs them all."""

    law: Law
    trials: int  # at most; there are no more slots than that
    parts: Iterable[WorldBatch]  # of one stage, if JAX traces the engine


Collect = Callable[[np.ndarray, Outcome], Any]  # numbers (m,) of trials and their outcomes


class BatchOptions(TypedDict, total=False):
    """Keyword arguments of functions that run trials."""

    slots: int | None  # worlds that one worker steps at once on each device of the host
    workers: int | None  # host threads
    callback: ProgressCallback


def run(
    jobs: Sequence[Job],
    setting: Setting,
    *,
    slots: int | None = None,  # worlds stepped at once by a worker on each device of the host
    workers: int | None = None,
    collect: Collect,  # called with trials that ended, in any order, one call at a time
    callback: ProgressCallback = no_progress,  # called after every segment, likewise
) -> Timing:
    """Run every trial of every job to its end.

    Workers are host threads that each drive a batch of their own, or that step worlds, if JAX does
    not trace the engine.
    """
    engine, backend = engines.get(setting.engine), jax.default_backend()
    slots = engine.slots(backend) if slots is None else slots
    workers = engine.workers(backend) if workers is None else workers
    errors.check_count("slots", slots, at_most=10_000_000)
    errors.check_count("workers", workers, at_most=1024)
    shared = _Shared(collect, callback, workers)
    began = time.perf_counter()
    if not engine.traced:
        count = max(1, min(workers, len(jobs)))
        tasks = [partial(_run_on_host, job, setting, workers // count, shared) for job in jobs]
    else:
        plan = _Schedule([_Queue(job) for job in jobs], setting, slots, workers)
        tasks = [partial(_Worker(plan, shared).work, number) for number in range(workers)]
        if backend != "cpu":  # the processor is idle: compile all at once, what is needed first
            tasks += [each.program for each in (*plan.own, *plan.last)]
        count = len(tasks)
    _side_by_side(tasks, count, shared)
    total = time.perf_counter() - began
    return Timing(shared.compile, total - shared.compile, shared.simulated)


def run_all(
    jobs: Sequence[Job], setting: Setting, count: int, **options: Unpack[BatchOptions]
) -> tuple[Outcome, Timing]:
    """Run every trial of every job, whose numbers are 0 to `count` - 1, by the `shape` of `run`.

    Returns their outcomes as numpy arrays (count, ...), and the timing.
    """
    found: dict[str, np.ndarray] = {}

    def collect(numbers: np.ndarray, outcome: Outcome) -> None:
        for name, leaf in outcome._asdict().items():
            if name not in found:
                found[name] = np.empty((count, *leaf.shape[1:]), leaf.dtype)
            found[name][numbers] = leaf

    timing = run(jobs, setting, collect=collect, **options)
    return Outcome(**found), timing  # pyright: ignore[reportArgumentType]


def _side_by_side(tasks: Sequence[Callable[[], None]], count: int, shared: _Shared) -> None:
    """Run tasks on `count` threads; the first that fails stops the others."""
    with ThreadPoolExecutor(count) as pool:
        jobs = [pool.submit(task) for task in tasks]
        try:
            for job in as_completed(jobs):
                job.result()
        except BaseException:
            shared.stop = True
            shared.drained.abort()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


class _Shared:
    """What the workers report into."""

    def __init__(self, collect: Collect, callback: Callable[[Progress], Any], workers: int):
        self.drained = threading.Barrier(workers)  # no trial of any queue waits
        self.simulated = 0.0
        self.compile = 0.0
        self.stop = False  # set when one worker fails or the user interrupts
        self._finished = 0
        self._collect, self._report = collect, callback
        self._lock = threading.Lock()

    def add(self, numbers: np.ndarray, trials: Outcome, simulated: float) -> None:
        """Trials that ended in a segment, and the time [s] all of the worker's trials advanced."""
        with self._lock:
            if numbers.size:
                self._collect(numbers, trials)
            self._finished += numbers.size
            self.simulated += simulated
            self._report(Progress(self._finished, self.simulated, self.compile))

    def compiled(self, seconds: float) -> None:
        """One worker had no program for this long."""
        with self._lock:
            self.compile = max(self.compile, seconds)
            self._report(Progress(self._finished, self.simulated, self.compile))


# --- on the host ---------------------------------------------------------------------------


def _run_on_host(job: Job, setting: Setting, threads: int, shared: _Shared) -> None:
    for part in job.parts:

        def tell(
            ended: np.ndarray, trials: Trial, simulated: float, part: WorldBatch = part
        ) -> bool:
            outcomes = jax.device_get(trial.outcome(trials, setting.physics.control_period))
            shared.add(part.indices[ended], rows(outcomes, ended), simulated)
            return not shared.stop

        if shared.stop:
            return
        loop = ControlLoop(setting.physics, setting.rules, job.law)
        engine, threads = engines.get(setting.engine), max(1, threads)
        host.run(engine, part.stage, part.worlds, part.params, loop, threads=threads, callback=tell)


# --- on a device -----------------------------------------------------------------------------


class _Queue:
    """The waiting trials of one job, and those that run and were set aside."""

    def __init__(self, job: Job):
        self.law, self.trials = job.law, job.trials
        self._parts = iter(job.parts)
        self.like: WorldBatch = next(self._parts)
        self._waiting: WorldBatch | None = self.like  # what is left of it
        self._lock = threading.Lock()
        self.aside: list[tuple[WorldBatch, Trial, np.ndarray]] = []  # with which are to be begun

    @property
    def waits(self) -> bool:
        """Whether any trial waits."""
        with self._lock:
            self._waiting = self._waiting or next(self._parts, None)
            return self._waiting is not None

    def take(self, count: int) -> list[WorldBatch]:
        """Up to `count` waiting trials, as pieces of parts."""
        taken = []
        with self._lock:
            while count and (part := self._waiting or next(self._parts, None)):
                piece, self._waiting = _cut(part, count)
                taken.append(piece)
                count -= piece.indices.size
        return taken


class _Schedule:
    """Which batches run which queues: first those of one queue, then those of several."""

    def __init__(self, queues: Sequence[_Queue], setting: Setting, slots: int, workers: int):
        devices, self.most_aside = jax.device_count(), _most_aside()
        self.own, groups = [], {}
        together = engines.get(setting.engine).side_by_side
        for number, queue in enumerate(queues):
            width = devices * min(slots, -(-queue.trials // devices))
            if width > self.most_aside:
                self.own.append(_Batch([queue], [width], setting))
                width = min(devices * -(-queue.trials // devices), workers * self.most_aside)
            if width:
                groups.setdefault(queue.law if together else number, []).append((queue, width))
        self.last = [
            _Batch([queue for queue, _ in some], [width for _, width in some], setting)
            for group in groups.values()
            for some in (group[i : i + _SIDE_BY_SIDE] for i in range(0, len(group), _SIDE_BY_SIDE))
        ]


def _most_aside() -> int:
    """How many running trials of a job a worker sets aside, at most."""
    return 0 if jax.default_backend() == "cpu" else jax.device_count() * _ASIDE


class _Batch:
    """So many slots for each of some queues on all devices of the host, and their program.

    All queues are of one law. What is done of a batch is done to its queues side by side.
    """

    def __init__(self, queues: Sequence[_Queue], slots: Sequence[int], setting: Setting):
        self.queues, self.slots, self.setting = queues, slots, setting
        self.law = queues[0].law
        self.stages = tuple(queue.like.stage for queue in queues)
        self.sharding = None
        if jax.device_count() > 1:
            mesh = jax.make_mesh((jax.device_count(),), ("worlds",), (AxisType.Auto,))
            self.sharding = NamedSharding(mesh, P("worlds"))
        self._compiling = threading.Lock()
        self._program = None
        self.ready = 0.0  # [s] of `time.perf_counter`, when the program was there

    def program(self) -> Any:
        """The compiled program; the first to come compiles, others wait."""
        with self._compiling:
            if self._program is None:
                self._program = self._compile()
                self.ready = time.perf_counter()
            return self._program

    def put(self, tree: Any) -> Any:
        """Leaves (slots, ...) on the device, or split over all devices of the host."""
        return jax.device_put(tree, self.sharding)

    def _compile(self) -> Any:
        inputs = [
            jax.tree.map(partial(self._batched, slots), _inputs(queue.like))
            for queue, slots in zip(self.queues, self.slots, strict=True)
        ]
        masks = tuple(jax.ShapeDtypeStruct((n,), bool, sharding=self.sharding) for n in self.slots)
        stages, rules = jax.eval_shape(lambda: (self.stages, self.setting.rules))
        shapes = (stages, tuple(inputs), self.blank, masks, masks, rules)
        leaves, tree = jax.tree.flatten(shapes)
        return _compiled(self.setting.physics, self.law, self.sharding, tree, tuple(leaves))

    @functools.cached_property
    def blank(self) -> tuple[Trial, ...]:
        """Shapes of the trials of each queue."""
        start, found = partial(trial.start_all, law=self.law), []
        for queue, slots in zip(self.queues, self.slots, strict=True):
            one = jax.tree.map(partial(self._batched, 1), _inputs(queue.like))
            like = jax.eval_shape(start, *one, jax.ShapeDtypeStruct((1,), bool))
            found.append(jax.tree.map(partial(self._batched, slots), like))
        return tuple(found)

    def _batched(self, slots: int, leaf: Any) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((slots, *leaf.shape[1:]), leaf.dtype, sharding=self.sharding)


@functools.lru_cache(maxsize=32)
def _compiled(
    physics: Physics,
    law: Law,
    sharding: NamedSharding | None,
    tree: Any,
    leaves: tuple[jax.ShapeDtypeStruct, ...],
) -> Any:
    """`trial.advance` compiled for arguments of these shapes; later runs of the kind reuse it.

    With the trials of each batch come their steps, who has ended, and how.
    """

    def advance(
        stages: tuple[Any, ...],
        inputs: tuple[tuple[World, LawParams], ...],
        trials: tuple[Trial, ...],
        fresh: tuple[jax.Array, ...],
        live: tuple[jax.Array, ...],
        rules: Rules,
    ) -> tuple[tuple[Trial, ...], tuple[tuple[jax.Array, jax.Array, Outcome], ...]]:
        worlds, params = zip(*inputs, strict=True)
        every = zip(worlds, params, live, strict=True)
        started = [trial.start_all(*each, law=law) for each in every]
        begun = tuple(map(_pick, fresh, started, trials))
        steps = max(1, round(SEGMENT / physics.control_period))
        after = trial.advance(
            stages, worlds, params, begun, ControlLoop(physics, rules, law), steps
        )
        # Of the same program: one of its own would wait for the other workers' segments.
        return after, tuple(
            (one.steps, one.done, trial.outcome(one, physics.control_period)) for one in after
        )

    if sharding is not None:  # each device runs its own worlds and waits for no other
        advance = jax.shard_map(
            advance,
            mesh=sharding.mesh,
            in_specs=(P(), *(P("worlds"),) * 4, P()),
            out_specs=P("worlds"),
            check_vma=False,
        )
    arguments = jax.tree.unflatten(tree, leaves)
    if sharding is None:
        static = (physics, SEGMENT)
        return programs.compile_function(advance, arguments, law=law, donate=2, static=static)
    return programs.compile_lowered(jax.jit(advance, donate_argnums=2).lower(*arguments))


def rows(tree: Any, which: Any) -> Any:
    """Take these rows of every leaf."""
    return jax.tree.map(lambda leaf: leaf[which], tree)


def _inputs(part: WorldBatch) -> tuple[World, LawParams]:
    """Return what differs between the trials of a part."""
    return part.worlds, part.params


def _cut(part: WorldBatch, count: int) -> tuple[WorldBatch, WorldBatch | None]:
    """The first `count` trials of a part, and the others if there are any."""

    def piece(which: slice) -> WorldBatch:
        worlds, params = rows(_inputs(part), which)
        return WorldBatch(part.indices[which], worlds, part.stage, params)

    over = part.indices.size > count
    return piece(slice(count)), piece(slice(count, None)) if over else None


def _pick(which: jax.Array, yes: Trial, no: Trial) -> Trial:
    """Rows of one batch of trials where `which` (B,) holds, and of another elsewhere."""
    one = partial(jax.vmap(lambda w, a, b: jnp.where(w, a, b)), which)
    return jax.tree.map(one, yes, no)


class _Slots:
    """The slots of one queue in a batch of one worker, and what is in them."""

    def __init__(self, batch: _Batch, number: int, resumed: bool):
        queue, slots = batch.queues[number], batch.slots[number]
        self._queue, self._batch = queue, batch
        self._numbers = np.zeros(slots, np.int64)
        self.live = np.zeros(slots, bool)
        self._before = np.zeros(slots, int)  # steps at the last look
        like = _inputs(queue.like)
        self._host = jax.tree.map(lambda leaf: np.repeat(leaf[:1], slots, axis=0), like)
        self._fresh = np.ones(slots, bool)  # begin with the next segment
        blank = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), batch.blank[number])
        self.trials = batch.put(blank)
        if not (aside := queue.aside if resumed else ()):
            self.inputs = self._put(np.arange(slots), queue.take(slots))
            return
        parts, states, fresh = zip(*aside, strict=True)
        self.inputs = self._put(np.arange(slots), parts)
        running = jax.tree.map(lambda *leaves: np.concatenate(leaves), *states)
        # What fills the other slots has ended.
        which = np.resize(np.arange(len(running.steps)), slots)
        running, self._fresh = rows(running, which), self.live & np.concatenate(fresh)[which]
        self._before = running.steps.copy()
        self.trials = batch.put(running._replace(done=~self.live))

    def _put(self, at: np.ndarray, taken: Sequence[WorldBatch]) -> tuple[World, LawParams]:
        """Put trials into the first of the slots `at`; return the inputs of all slots."""
        ends = np.cumsum([0, *(part.indices.size for part in taken)])
        at = at[: ends[-1]]
        for part, slots in zip(taken, np.split(at, ends[1:-1]) if taken else (), strict=True):
            self._numbers[slots] = part.indices
            for mine, theirs in zip(
                jax.tree.leaves(self._host), jax.tree.leaves(_inputs(part)), strict=True
            ):
                mine[slots] = theirs
        self.live[at], self._before[at] = True, 0
        # A copy: the device may otherwise share the host's memory, which the next call changes.
        return self._batch.put(jax.tree.map(np.copy, self._host))

    def give(self) -> tuple[tuple[World, LawParams], Trial, Any, Any]:
        """What the program takes; what is fresh then begins."""
        masks = self._batch.put((self._fresh.copy(), self.live.copy()))
        self._fresh[:] = False
        return self.inputs, self.trials, *masks

    def look(self, steps: np.ndarray, done: np.ndarray, outcomes: Outcome) -> tuple[Any, ...]:
        """What `_Shared.add` takes of a segment; what ended in it makes room."""
        at = np.flatnonzero(done & self.live)
        period = self._batch.setting.physics.control_period
        simulated = float((steps - self._before)[self.live].sum()) * period
        ended = self._numbers[at], rows(outcomes, at), simulated
        self._before = steps.copy()
        self.live[at] = False
        if taken := self._queue.take(at.size):
            self.inputs = self._put(at, taken)
            self._fresh[at] = self.live[at]
        return ended

    def set_aside(self) -> None:
        """Hand what runs over to the queue."""
        if (at := np.flatnonzero(self.live)).size:
            worlds, params = rows(self._host, at)
            part = WorldBatch(self._numbers[at], worlds, self._queue.like.stage, params)
            trials = rows(jax.device_get(self.trials), at)
            self._queue.aside.append((part, trials, self._fresh[at]))


class _Worker:
    """A host thread that drives batches of its own."""

    def __init__(self, schedule: _Schedule, shared: _Shared):
        self._schedule, self._shared = schedule, shared
        self._waited = 0.0  # [s] for programs

    def work(self, number: int) -> None:
        """Until no trial waits or runs; `number` is the worker's."""
        own, last = self._schedule.own, self._schedule.last
        first = number % max(1, len(own))
        for batch in own[first:] + own[:first]:
            self._run(batch, self._schedule.most_aside)
        self._shared.drained.wait()
        for batch in last[number :: self._shared.drained.parties]:
            self._run(batch, 0)

    def _program(self, batch: _Batch) -> Any:
        began = time.perf_counter()
        program = batch.program()
        self._waited += max(0.0, batch.ready - began)
        self._shared.compiled(self._waited)
        return program

    def _run(self, batch: _Batch, most_aside: int) -> None:
        """Run the trials of a batch until none waits, and no more than so many run."""
        if self._shared.stop:
            return
        every = [_Slots(batch, number, not most_aside) for number in range(len(batch.queues))]
        if not any(each.live.any() for each in every):
            return
        program, stages, rules = self._program(batch), batch.stages, batch.setting.rules
        with ThreadPoolExecutor(1) as teller:  # what ended is kept while the next segment runs
            telling, unseen = [], None

            def look(seen: Any) -> list[Any]:
                seen = jax.device_get(seen)
                ended = [each.look(*one) for each, one in zip(every, seen, strict=True)]
                for one in telling:
                    one.result()
                return [teller.submit(self._shared.add, *one) for one in ended]

            while sum(each.live.sum() for each in every) > most_aside and not self._shared.stop:
                given = zip(*(each.give() for each in every), strict=True)
                after, seen = program(stages, *given, rules)
                for each, trials in zip(every, after, strict=True):
                    each.trials = trials
                # Where no trial waits for room, a GPU goes on while the host looks.
                ahead = _most_aside() and not any(queue.waits for queue in batch.queues)
                seen, unseen = (unseen, seen) if ahead else (seen, None)
                if seen is not None:
                    telling = look(seen)
            if unseen is not None:
                telling = look(unseen)
            for one in telling:
                one.result()
        for each in every:
            each.set_aside()
