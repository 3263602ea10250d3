"""The order of a batch run on one device: filling, launching and reading of segments."""

from itertools import pairwise

import numpy as np
import pytest

from rps_jax.trials import segments
from rps_jax.trials.segments import Ended, Fill, Filled, Launch, Read, Report, occupied


class Device:
    """Device on which a trial takes its number of segments; it executes actions and notes them."""

    def __init__(self, queues, sizes, lengths, *, limits=None, running=None, stop_at=None, **start):
        """Prepare slots for trials of some queues; a run stops before the fill `stop_at`."""
        self.queues, self.lengths, self.stop_at = list(map(list, queues)), lengths, stop_at
        none = np.zeros(0, int), np.zeros(0, bool)
        pairs = zip(sizes, running or [none] * len(sizes), strict=True)
        slots = [occupied(size, *trials) for size, trials in pairs]
        self.state, actions = segments.start(slots, limits or [0] * len(sizes), **start)
        self.left = dict(lengths)  # segments of each trial
        self.held = [dict(enumerate(x.trials[x.live].tolist())) for x in slots]
        self.unread, self.words, self.order, self.fills = [], [], [], 0
        pending = list(actions)
        while pending:
            if event := self.execute(pending.pop(0)):
                self.state, actions = segments.step(self.state, event)
                pending += actions

    def execute(self, action):
        """Execute an action as `batch` does; return the next event, if it has one."""
        self.words.append(type(action).__name__)
        match action:
            case Fill(free):
                self.fills += 1
                filled = []
                for queue, held, at in zip(self.queues, self.held, free, strict=True):
                    taken = [queue.pop(0) for _ in range(min(len(queue), len(at)))]
                    held.update(zip(at.tolist(), taken, strict=False))
                    filled.append(np.array(taken, int))
                return Filled(filled, self.stop_at is not None and self.fills >= self.stop_at)
            case Launch(fresh, live):
                done = []
                for held, mask in zip(self.held, live, strict=True):
                    for at in np.flatnonzero(mask).tolist():
                        self.left[held[at]] -= 1
                    ended = [at in held and self.left[held[at]] <= 0 for at in range(mask.size)]
                    done.append(np.array(ended))
                self.unread.append(done)
                pairs = zip(self.held, fresh, strict=True)
                starts = [
                    held.get(i) for held, mask in pairs for i in np.flatnonzero(mask).tolist()
                ]
                self.order.append([trial for trial in starts if trial is not None])
                return None
            case Read():
                return Ended(self.unread.pop(0))
            case Report(_, trials):
                self.order.append({int(i) for x in trials for i in x})
                return None


def test_a_slot_is_refilled_after_the_segment_in_which_its_trial_ends():
    run = Device([range(5)], [2], {0: 1, 1: 3, 2: 1, 3: 2, 4: 1})
    cycle = ["Fill", "Launch", "Read", "Report"]
    assert run.words == cycle * 4 + ["Fill"]
    # Trials that start with a segment, and those that end in it.
    assert run.order == [[0, 1], {0}, [2], {2}, [3], {1}, [4], {3, 4}]


def test_a_gpu_launches_a_segment_before_it_reads_the_previous_one():
    run = Device([range(5)], [2], {0: 1, 1: 3, 2: 1, 3: 2, 4: 1}, ahead=1)
    assert run.words[:7] == ["Fill", "Launch", "Fill", "Launch", "Read", "Report", "Fill"]
    assert all(pair != ("Read", "Read") for pair in pairwise(run.words))
    ended = [x for x in run.order if isinstance(x, set)]
    assert set().union(*ended) == set(range(5))
    assert sum(map(len, ended)) == 5  # each once, although an ended trial is stepped once more
    assert run.words.count("Launch") == run.words.count("Read")


def test_no_trial_ends_by_results_of_a_segment_before_its_first():
    """Slot 0 is refilled while a segment runs in which the previous trial had ended."""
    slots = [occupied(1, np.array([7]), np.array([True]))]
    state, _ = segments.start(slots, [0], ahead=1)
    state, actions = segments.step(state, Filled([np.zeros(0, int)]))
    assert [type(x) for x in actions] == [Launch, Fill]
    state, actions = segments.step(state, Filled([np.zeros(0, int)]))
    assert [type(x) for x in actions] == [Launch, Read]
    state, (report, _) = segments.step(state, Ended([np.array([True])]))
    assert report.trials[0].tolist() == [7]
    state, (launch, _) = segments.step(state, Filled([np.array([8])]))
    assert launch.fresh[0].tolist() == [True]
    state, (report, _) = segments.step(state, Ended([np.array([True])]))
    assert report.trials[0].size == 0
    assert state.slots[0].live.all()


def test_empty_slots_start_as_ended_in_the_first_segment_alone():
    """Otherwise a program would step their blank trials."""
    state, _ = segments.start([occupied(3, np.array([5]), np.array([False]))], [0])
    state, (launch, _) = segments.step(state, Filled([np.array([6])]))
    assert launch.fresh[0].tolist() == [False, True, True]
    assert launch.live[0].tolist() == [True, True, False]
    state, _ = segments.step(state, Ended([np.array([True, False, True])]))
    state, (launch, _) = segments.step(state, Filled([np.zeros(0, int)]))
    assert not launch.fresh[0].any()


@pytest.mark.parametrize("ahead", [0, 1])
def test_without_trials_nothing_is_launched(ahead):
    assert Device([[], []], [3, 2], {}, ahead=ahead).words == ["Fill"]


@pytest.mark.parametrize("ahead", [0, 1])
def test_a_run_that_stops_reads_what_it_launched_and_launches_no_more(ahead):
    run = Device([range(9)], [2], dict.fromkeys(range(9), 4), ahead=ahead, stop_at=3)
    stopped = [i for i, word in enumerate(run.words) if word == "Fill"][2]
    assert "Launch" not in run.words[stopped:]
    assert run.words.count("Launch") == run.words.count("Read")
    assert run.state.slots[0].live.sum() == 2  # they run on elsewhere, or are lost


def test_the_last_trials_are_left_to_a_program_with_fewer_slots_and_resume_there():
    lengths = {0: 1, 1: 1, 2: 5, 3: 1}
    wide = Device([range(4)], [4], lengths, limits=[1])
    slots = wide.state.slots[0]
    assert slots.trials[slots.live].tolist() == [2]
    resumed = np.array([2]), slots.first[slots.live] >= wide.state.launched
    assert not resumed[1].any()  # it has started
    narrow = Device([[]], [1], {2: wide.left[2]}, running=[resumed])
    assert narrow.order[0] == []  # nothing starts
    assert narrow.order[-1] == {2}
    assert narrow.words.count("Launch") == 4


def test_a_trial_that_was_filled_but_not_stepped_starts_where_it_resumes():
    stopped = Device([range(2)], [2], {0: 3, 1: 3}, stop_at=1)
    slots = stopped.state.slots[0]
    fresh = slots.first >= stopped.state.launched
    assert fresh.all()
    run = Device([[]], [2], {0: 3, 1: 3}, running=[(slots.trials, fresh)])
    assert run.order[0] == [0, 1]


def test_a_queue_goes_on_while_another_has_ended():
    run = Device([[0, 1], [10, 11, 12]], [2, 1], {0: 1, 1: 1, 10: 1, 11: 1, 12: 2})
    assert run.order == [[0, 1, 10], {0, 1, 10}, [11], {11}, [12], set(), [], {12}]


def test_the_first_fill_is_small_where_worlds_are_still_built():
    run = Device([range(4)], [4], dict.fromkeys(range(4), 3), ahead=1, at_first=1)
    assert run.order[:2] == [[0], [1, 2, 3]]
