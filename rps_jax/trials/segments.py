"""Order of a batch run on one device, as a state machine without side effects.

A segment is one call of a program: some control steps of the trials in its slots. `step` maps a
state and an event to the next state and to the actions that follow. The caller executes the actions
in order; the last one returns the next event. Without actions the program has ended.

    state, actions = start([64], ahead=0)     # Fill
    state, actions = step(state, Filled(...))  # Launch, Read
    state, actions = step(state, Ended(...))   # Report, Fill

A GPU runs some segments `ahead` of the one whose results the host reads. So a trial that has ended
keeps its slot for as many segments.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np


class Slots(NamedTuple):
    """Slots of one queue: arrays (S,) that no function changes."""

    trials: np.ndarray  # indices of the trials in the run
    first: np.ndarray  # segments with which the trials start; -1: they have started elsewhere
    live: np.ndarray  # whether a slot holds a trial that has not ended

    @property
    def free(self) -> np.ndarray:
        """Indices of the slots without a running trial."""
        return np.flatnonzero(~self.live)


@dataclass(frozen=True)
class State:
    """State of the slots of all queues of a program."""

    slots: tuple[Slots, ...]
    limits: tuple[int, ...]  # running trials of each queue with which the program may end
    ahead: int  # segments that run while the host reads another
    launched: int = 0  # segments
    read: int = 0


class Filled(NamedTuple):
    """Event: trials were written into the first free slots of each queue."""

    trials: Sequence[np.ndarray]  # their indices in the run
    stop: bool = False  # the run has ended early


class Ended(NamedTuple):
    """Event: the results of a segment were read."""

    done: Sequence[np.ndarray]  # (S,) whether the trials had ended, of each queue


class Fill(NamedTuple):
    """Action: write waiting trials into free slots, which returns `Filled`."""

    free: Sequence[np.ndarray]  # indices of slots of each queue


class Launch(NamedTuple):
    """Action: start a segment."""

    # (S,) whether trials start with it, of each queue; with the first, empty slots start as ended.
    fresh: Sequence[np.ndarray]
    live: Sequence[np.ndarray]  # (S,) whether slots hold trials


class Read(NamedTuple):
    """Action: wait for the oldest segment that is not read, which returns `Ended`."""


class Report(NamedTuple):
    """Action: report the trials that ended in the segment that was read."""

    slots: Sequence[np.ndarray]  # indices of their slots, of each queue
    trials: Sequence[np.ndarray]  # their indices in the run


Action = Fill | Launch | Read | Report


def occupied(size: int, trials: np.ndarray, fresh: np.ndarray) -> Slots:
    """Return slots of which the first hold trials (n,); those not `fresh` (n,) have started."""
    slots = Slots(np.zeros(size, np.int64), np.zeros(size, int), np.zeros(size, bool))
    slots.trials[: trials.size], slots.live[: trials.size] = trials, True
    slots.first[: trials.size] = np.where(fresh, 0, -1)
    return slots


def start(
    slots: Sequence[Slots], limits: Sequence[int], ahead: int = 0, at_first: int | None = None
) -> tuple[State, tuple[Action, ...]]:
    """Return the first state, and the action that fills at most `at_first` slots of each queue."""
    state = State(tuple(slots), tuple(limits), ahead)
    return state, (Fill([x.free[:at_first] for x in slots]),)


def step(state: State, event: Filled | Ended) -> tuple[State, tuple[Action, ...]]:
    """Return the state after an event, and the actions that follow."""
    if isinstance(event, Ended):
        return _free(state, event)
    slots = tuple(map(_fill, state.slots, event.trials, [state.launched] * len(state.slots)))
    runs = [np.count_nonzero(x.live) > limit for x, limit in zip(slots, state.limits, strict=True)]
    launches = any(runs) and not event.stop
    launch = Launch([x.first == state.launched for x in slots], [x.live for x in slots])
    state = replace(state, slots=slots, launched=state.launched + launches)
    waiting = state.launched - state.read
    if not waiting:
        return state, ()
    reads = waiting > state.ahead or not launches
    following = Read() if reads else Fill([x.free for x in slots])
    return state, (launch, following) if launches else (following,)


def _fill(slots: Slots, trials: np.ndarray, segment: int) -> Slots:
    """Return slots with trials in the first free ones, which start with a segment."""
    at, (indices, first, live) = slots.free[: trials.size], (x.copy() for x in slots)
    indices[at], first[at], live[at] = trials, segment, True
    return Slots(indices, first, live)


def _free(state: State, event: Ended) -> tuple[State, tuple[Action, ...]]:
    """Return the state without the trials that ended in the segment that was read."""
    pairs = zip(state.slots, event.done, strict=True)
    # The results of a segment say nothing about trials that start with a later one.
    ended = [done & x.live & (x.first <= state.read) for x, done in pairs]
    pairs = list(zip(state.slots, ended, strict=True))
    slots = tuple(x._replace(live=x.live & ~mask) for x, mask in pairs)
    report = Report([np.flatnonzero(x) for x in ended], [x.trials[mask] for x, mask in pairs])
    state = replace(state, slots=slots, read=state.read + 1)
    return state, (report, Fill([x.free for x in slots]))
