"""Which parts of a run wait, which worker has begun which, and what came back. No JAX, no Ray."""

import math
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple


class News(NamedTuple):
    """What has happened on the workers."""

    parts: list[tuple[int, bytes]]  # number and content of those that came back since last time
    ended: int  # trials, in all, but for those that were lost with a worker
    simulated: float  # [s] in all
    workers: dict[int, dict[str, Any]]  # the environment of each that has begun


class Board:
    """The parts of a run, each of a kind, and the workers 0, 1, ... that run them.

    A part is given to one worker, and to another only after the first has died.
    """

    def __init__(self, waiting: Sequence[Sequence[int]], workers: int):
        """At first the parts `waiting` wait, kind by kind, for so many workers."""
        self._waiting = [deque(numbers) for numbers in waiting]
        # The slots of one worker may hold all there is: none begins more than its share at once.
        self._share = math.ceil(sum(map(len, waiting)) / workers)
        self._begun: dict[int, dict[int, int]] = {}  # by worker: kinds of parts, until they return
        self._ended: dict[int, int] = {}  # by worker: trials
        self._returned: dict[int, int] = {}  # by worker: those of them in parts that came back
        self._simulated = 0.0
        self._parts: list[tuple[int, bytes]] = []
        self._workers: dict[int, dict[str, Any]] = {}

    def enter(self, worker: int, environment: dict[str, Any]) -> None:
        """A worker begins, perhaps again after its death: parts that it had begun wait again."""
        for number, kind in self._begun.pop(worker, {}).items():
            self._waiting[kind].append(number)
        self._begun[worker] = {}
        self._ended[worker] = self._returned.setdefault(worker, 0)
        self._workers[worker] = environment

    def first(self, worker: int) -> tuple[int, int] | None:
        """A kind, and a part of it, for a worker that has nothing to do; None if none waits."""
        kinds = [kind for kind, numbers in enumerate(self._waiting) if numbers]
        if not kinds:
            return None
        kind = kinds[worker % len(kinds)]
        return kind, self._begin(worker, kind)

    def next(self, worker: int, kind: int) -> int | None:
        """One more part of a kind for a worker with free slots; None if it may have none."""
        if not self._waiting[kind] or len(self._begun[worker]) >= self._share:
            return None
        return self._begin(worker, kind)

    def _begin(self, worker: int, kind: int) -> int:
        number = self._waiting[kind].popleft()
        self._begun[worker][number] = kind
        return number

    def deliver(self, worker: int, number: int, trials: int, content: bytes) -> None:
        """A part came back, with so many trials."""
        del self._begun[worker][number]
        self._returned[worker] += trials
        self._parts.append((number, content))

    def tell(self, worker: int, ended: int, simulated: float) -> None:
        """So many more trials of a worker ended, and so many more seconds were simulated."""
        self._ended[worker] += ended
        self._simulated += simulated

    def news(self) -> News:
        """What came back since the last time, and the state of the whole."""
        parts, self._parts = self._parts, []
        return News(parts, sum(self._ended.values()), self._simulated, self._workers)
