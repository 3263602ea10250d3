"""Trials on a device: slots of a batch, each refilled as soon as its trial ends.

A job is all that one compiled program runs; its trials come in parts, which are made only when a
slot waits for one of their trials, so that memory does not grow with the number of trials.
"""

from __future__ import annotations

import functools
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding
from jax.sharding import PartitionSpec as P

from rps_jax import engines, errors
from rps_jax.control.base import Law
from rps_jax.engines import programs
from rps_jax.trials import host, trial
from rps_jax.trials.progress import Progress, Report, Timing, unheard
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Outcome, Rules, Trial, World
from rps_jax.world.physics import Physics

SEGMENT = 10.0  # [s] simulated between two looks at which trials have ended
# A GPU takes the last trials of a job into ever fewer slots, each time a quarter of them, as long
# as there are this many: fewer take it as long.
_FEWEST = 4096


class Part(NamedTuple):
    """Some trials of a job."""

    numbers: np.ndarray  # (n,) of the trials
    worlds: World  # leaves (n, ...), on the host
    stage: Any


class Job(NamedTuple):
    """Trials of one kind: one compiled program runs them all."""

    law: Law
    trials: int  # at most; there are no more slots than that
    parts: Iterable[Part]  # of one stage, if JAX traces the engine


Collect = Callable[[np.ndarray, Outcome], Any]  # numbers (m,) of trials and their outcomes


def check_shape(slots: int | None, workers: int | None) -> None:
    """Raises InputError unless each is left open or a sensible number."""
    if slots is not None:
        errors.check_count("slots", slots, at_most=10_000_000)
    if workers is not None:
        errors.check_count("workers", workers, at_most=1024)


def run(
    jobs: Sequence[Job],
    setting: Setting,
    *,
    slots: int | None = None,
    workers: int | None = None,
    collect: Collect,
    report: Report = unheard,
) -> Timing:
    """Run every trial of every job to its end.

    Args:
      jobs: what to run.
      setting: what they share.
      slots: worlds stepped at once by one worker on each of the host's devices.
      workers: host threads that each drive a batch of their own, or that step worlds, if JAX does
        not trace the engine.
      collect: called with the outcomes of trials that ended, in any order, one call at a time.
      report: called after every segment, likewise.
    """
    check_shape(slots, workers)
    engine, backend = engines.get(setting.engine), jax.default_backend()
    slots = slots or engine.slots(backend)
    workers = workers or engine.workers(backend)
    shared = _Shared(collect, report)
    began = time.perf_counter()
    if not engine.traced:
        count = max(1, min(workers, len(jobs)))
        tasks = [partial(_run_on_host, job, setting, workers // count, shared) for job in jobs]
    else:
        count = workers
        queues = [_Queue(job, setting, slots) for job in jobs]
        orders = [queues[w % len(queues) :] + queues for w in range(count if queues else 0)]
        tasks = [_Worker(order, shared).work for order in orders]
        if backend != "cpu":  # the processor is idle: compile all at once, what is needed first
            programs = [width.program for width in sorted(_widths(queues), key=_slots_of)[::-1]]
            tasks += programs
            count += len(programs)
    _side_by_side(tasks, count, shared)
    warn_of_lost(shared.overflowed)
    total = time.perf_counter() - began
    return Timing(shared.compile, total - shared.compile, shared.simulated)


def gathered(
    jobs: Sequence[Job], setting: Setting, count: int, **shape: Any
) -> tuple[Outcome, Timing]:
    """Run every trial of every job, and gather the outcomes in the order of their numbers.

    Args:
      jobs: what to run, trials of the numbers 0 to `count` - 1.
      setting: what they share.
      count: how many trials there are.
      shape: `slots`, `workers` and `report` of `run`.

    Returns:
      Outcomes as numpy arrays (count, ...); and the timing.
    """
    found: dict[str, np.ndarray] = {}

    def collect(numbers: np.ndarray, outcome: Outcome) -> None:
        for name, leaf in outcome._asdict().items():
            if name not in found:
                found[name] = np.empty((count, *leaf.shape[1:]), leaf.dtype)
            found[name][numbers] = leaf

    timing = run(jobs, setting, collect=collect, **shape)
    return Outcome(**found), timing  # pyright: ignore[reportArgumentType]


def warn_of_lost(count: int) -> None:
    """Warns if in `count` trials, any at all, the engine lost contacts for want of room."""
    if count:
        warnings.warn(
            f"the engine lost contacts for want of room in {count} trials, which are not to be "
            "trusted",
            stacklevel=3,
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
            pool.shutdown(wait=False, cancel_futures=True)
            raise


class _Shared:
    """What the workers report into."""

    def __init__(self, collect: Collect, report: Callable[[Progress], Any]):
        self.simulated = 0.0
        self.compile = 0.0
        self.overflowed = 0  # trials
        self.stop = False  # set when one worker fails or the user interrupts
        self._finished = 0
        self._collect, self._report = collect, report
        self._lock = threading.Lock()

    def add(self, numbers: np.ndarray, trials: Outcome, simulated: float) -> None:
        """Trials that ended in a segment, and the time [s] all of the worker's trials advanced."""
        with self._lock:
            self.overflowed += int(np.count_nonzero(trials.overflows))
            if numbers.size:
                self._collect(numbers, trials)
            self._finished += numbers.size
            self.simulated += simulated
            self._report(Progress(self._finished, self.simulated, self.compile))

    def compiled(self, seconds: float) -> None:
        """One worker had no program for this long."""
        with self._lock:
            self.compile = max(self.compile, seconds)


# --- on the host ---------------------------------------------------------------------------


def _run_on_host(job: Job, setting: Setting, threads: int, shared: _Shared) -> None:
    for part in job.parts:

        def tell(ended: np.ndarray, trials: Trial, simulated: float, part: Part = part) -> bool:
            outcomes = jax.device_get(trial.outcome(trials, setting.physics.control_period))
            shared.add(part.numbers[ended], rows(outcomes, ended), simulated)
            return not shared.stop

        if shared.stop:
            return
        host.run(
            engines.get(setting.engine),
            part.stage,
            part.worlds,
            physics=setting.physics,
            rules=setting.rules,
            law=job.law,
            threads=max(1, threads),
            report=tell,
        )


# --- on a device -----------------------------------------------------------------------------


class _Queue:
    """The waiting trials of one job, and the batches that can run them, the widest first."""

    def __init__(self, job: Job, setting: Setting, slots: int):
        self.law = job.law
        self._parts = iter(job.parts)
        first = next(self._parts)
        self._waiting: Part | None = first  # what is left of it
        self._lock = threading.Lock()
        devices = jax.device_count()
        widest = min(slots, -(-job.trials // devices))
        fewest = _FEWEST if jax.default_backend() != "cpu" else widest
        self.widths = [
            _Width(job.law, setting, first, devices * each) for each in _ever_fewer(widest, fewest)
        ]

    def take(self, count: int) -> list[Part]:
        """Up to `count` waiting trials, as pieces of parts."""
        taken = []
        with self._lock:
            while count and (part := self._waiting or next(self._parts, None)):
                piece, self._waiting = _cut(part, count)
                taken.append(piece)
                count -= piece.numbers.size
        return taken


def _ever_fewer(slots: int, fewest: int) -> Iterator[int]:
    """`slots`, a quarter of them and so on, as long as that is not less than `fewest`."""
    yield slots
    while (slots := slots // 4) >= fewest:
        yield slots


class _Width:
    """A batch of so many slots on all devices of the host, and its program once compiled."""

    def __init__(self, law: Law, setting: Setting, like: Part, slots: int):
        self.slots = slots
        self.stage = like.stage
        self.setting = setting
        self._law = law
        self.sharding = None
        if jax.device_count() > 1:
            mesh = jax.make_mesh((jax.device_count(),), ("worlds",), (AxisType.Auto,))
            self.sharding = NamedSharding(mesh, P("worlds"))
        self._worlds = jax.tree.map(self._batched, like.worlds)
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

    def start(self, worlds: World, live: np.ndarray) -> Trial:
        """New trials in all slots."""
        return self.put(trial.start_all(worlds, live, law=self._law))

    def refill(self, worlds: World, trials: Trial, fresh: np.ndarray) -> Trial:
        """New trials in the slots that are `fresh` (slots,)."""
        return self.put(_refill(worlds, trials, fresh, law=self._law))

    def _batched(self, leaf: Any) -> jax.ShapeDtypeStruct:
        shape = (self.slots, *leaf.shape[1:])
        return jax.ShapeDtypeStruct(shape, leaf.dtype, sharding=self.sharding)

    def _compile(self) -> Any:
        start = partial(trial.start_all, law=self._law)
        live = jax.ShapeDtypeStruct((self.slots,), bool)
        trials = jax.tree.map(self._batched, jax.eval_shape(start, self._worlds, live))
        stage, rules = jax.eval_shape(lambda: (self.stage, self.setting.rules))
        leaves, tree = jax.tree.flatten((stage, self._worlds, trials, rules))
        return _compiled(self.setting.physics, self._law, self.sharding, tree, tuple(leaves))


def _widths(queues: Sequence[_Queue]) -> list[_Width]:
    return [width for queue in queues for width in queue.widths]


def _slots_of(width: _Width) -> int:
    return width.slots


@functools.lru_cache(maxsize=32)
def _compiled(
    physics: Physics,
    law: Law,
    sharding: NamedSharding | None,
    tree: Any,
    leaves: tuple[jax.ShapeDtypeStruct, ...],
) -> Any:
    """`trial.advance` compiled for arguments of these shapes; later runs of the kind reuse it.

    With the trials come their steps, who has ended, and how.
    """

    def advance(
        stage: Any, worlds: World, trials: Trial, rules: Rules
    ) -> tuple[Trial, tuple[jax.Array, jax.Array, Outcome]]:
        after = trial.advance(
            stage,
            worlds,
            trials,
            physics=physics,
            rules=rules,
            law=law,
            steps=max(1, round(SEGMENT / physics.control_period)),
        )
        # Of the same program: one of its own would wait for the other workers' segments.
        return after, (after.steps, after.done, trial.outcome(after, physics.control_period))

    if sharding is not None:  # each device runs its own worlds and waits for no other
        advance = jax.shard_map(
            advance,
            mesh=sharding.mesh,
            in_specs=(P(), P("worlds"), P("worlds"), P()),
            out_specs=P("worlds"),
            check_vma=False,
        )
    arguments = jax.tree.unflatten(tree, leaves)
    who = programs.identity(law)
    if sharding is None and who is not None:
        trials = arguments[2]
        names: tuple[Any, ...] = Outcome._fields  # any leaves: what counts is the structure
        result = trials, (trials.steps, trials.done, Outcome(*names))
        static = (physics, who, SEGMENT)
        return programs.compiled(advance, arguments, result, donate=2, static=static)
    return jax.jit(advance, donate_argnums=2).lower(*arguments).compile()


def rows(tree: Any, which: Any) -> Any:
    """Take these rows of every leaf."""
    return jax.tree.map(lambda leaf: leaf[which], tree)


def _cut(part: Part, count: int) -> tuple[Part, Part | None]:
    """The first `count` trials of a part, and the others if there are any."""

    def piece(which: slice) -> Part:
        return Part(part.numbers[which], rows(part.worlds, which), part.stage)

    over = part.numbers.size > count
    return piece(slice(count)), piece(slice(count, None)) if over else None


def _count(parts: Sequence[Part]) -> int:
    return sum(part.numbers.size for part in parts)


@partial(jax.jit, static_argnames=("law",), donate_argnames=("trials",))
def _refill(worlds: World, trials: Trial, fresh: jax.Array, *, law: Law) -> Trial:
    """Start a new trial in the slots that are `fresh` (B,)."""
    started = trial.start_all(worlds, jnp.ones_like(fresh), law=law)
    pick = partial(jax.vmap(lambda f, a, b: jnp.where(f, a, b)), fresh)
    return jax.tree.map(pick, started, trials)


class _Held:
    """The worlds in the slots of one worker, on the host."""

    def __init__(self, like: Part, slots: int):
        self.numbers = np.zeros(slots, np.int64)
        self._worlds = jax.tree.map(lambda leaf: np.repeat(leaf[:1], slots, axis=0), like.worlds)

    def put(self, at: np.ndarray, taken: Sequence[Part]) -> World:
        """Put trials into the slots `at`; returns the worlds."""
        ends = np.cumsum([part.numbers.size for part in taken])
        for part, slots in zip(taken, np.split(at, ends[:-1]), strict=True):
            self.numbers[slots] = part.numbers
            for mine, theirs in zip(
                jax.tree.leaves(self._worlds), jax.tree.leaves(part.worlds), strict=True
            ):
                mine[slots] = theirs
        # A copy: the device may otherwise share the host's memory, which the next call changes.
        return jax.tree.map(np.copy, self._worlds)

    def keep(self, at: np.ndarray) -> World:
        """Keep the slots `at` alone, in that order; returns their worlds."""
        self.numbers, self._worlds = self.numbers[at], rows(self._worlds, at)
        return jax.tree.map(np.copy, self._worlds)


class _Worker:
    """A host thread that drives a batch of its own through one queue after another."""

    def __init__(self, queues: list[_Queue], shared: _Shared):
        self._queues, self._shared = queues, shared
        self._waited = 0.0  # [s] for programs

    def work(self) -> None:
        """Until no trial waits in any queue."""
        for queue in self._queues:
            taken = [] if self._shared.stop else queue.take(queue.widths[0].slots)
            if taken:
                self._drain(queue, taken)

    def _program(self, width: _Width) -> Any:
        began = time.perf_counter()
        program = width.program()
        self._waited += max(0.0, width.ready - began)
        self._shared.compiled(self._waited)
        return program

    def _drain(self, queue: _Queue, taken: list[Part]) -> None:
        """Run trials, the `taken` first, until none waits and none of this worker's runs."""
        width, *narrower = queue.widths
        program, period = self._program(width), width.setting.physics.control_period
        held = _Held(taken[0], width.slots)
        first = np.arange(_count(taken))
        live = np.arange(width.slots) < first.size
        worlds = width.put(held.put(first, taken))
        trials = width.start(worlds, live)
        before = np.zeros(width.slots, int)
        with ThreadPoolExecutor(1) as teller:  # what ended is kept while the next segment runs
            telling = None
            while live.any() and not self._shared.stop:
                trials, seen = program(width.stage, worlds, trials, width.setting.rules)
                steps, done, outcomes = jax.device_get(seen)
                at = np.flatnonzero(done & live)
                simulated = float((steps - before)[live].sum()) * period
                if telling is not None:
                    telling.result()
                ended = held.numbers[at], rows(outcomes, at), simulated
                telling = teller.submit(self._shared.add, *ended)
                before = steps.copy()
                live[at] = False
                taken = queue.take(at.size)
                if taken:
                    fresh = at[: _count(taken)]
                    live[fresh], before[fresh] = True, 0
                    worlds = width.put(held.put(fresh, taken))
                    trials = width.refill(worlds, trials, np.isin(np.arange(width.slots), fresh))
                elif narrower and 0 < live.sum() <= narrower[0].slots:
                    running = np.flatnonzero(live)
                    width = narrower.pop(0)
                    program = self._program(width)
                    slots = np.resize(running, width.slots)  # the last ones are padding
                    live = np.arange(width.slots) < running.size
                    worlds, before = width.put(held.keep(slots)), before[slots]
                    last = rows(jax.device_get(trials), slots)
                    trials = width.put(last._replace(done=~live))
            if telling is not None:
                telling.result()
