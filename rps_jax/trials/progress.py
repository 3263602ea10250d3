"""Progress of a run and its times: records, callbacks and the progress bar."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, NamedTuple, NoReturn

if TYPE_CHECKING:
    from tqdm import tqdm


class Segment(NamedTuple):
    """Call of a program: some control steps of the trials in its slots."""

    device: int  # its number on the host
    start: float  # [s] since the start of the run
    end: float  # [s] when its results were on the host
    live: dict[int, int]  # trials that ran, by the index of their job


@dataclass(frozen=True)
class Progress:
    """Progress of a run."""

    finished: int  # trials
    simulated: float  # [s] summed over trials, ended or running
    compile: float = 0.0  # [s] until the worker who waited longest had its programs
    rounds: int = 0  # generations or updates that are done
    compiled: int = 0  # programs
    programs: int = 0  # that the run needs, if it is known
    segment: Segment | None = None  # that was reported last, of a run in JAX


ProgressCallback = Callable[[Progress], object]


def no_progress(progress: Progress) -> None:
    """Ignore the progress of a run."""


class SequentialProgress:
    """Callback of successive runs, which reports them as one run."""

    def __init__(self, callback: ProgressCallback):
        self._callback = callback
        self._previous = self._current = Progress(0, 0.0)  # of finished runs, and in all

    def __call__(self, progress: Progress) -> None:
        previous = self._previous
        self._current = replace(
            progress,
            finished=previous.finished + progress.finished,
            simulated=previous.simulated + progress.simulated,
            compile=previous.compile + progress.compile,
        )
        self._callback(self._current)

    def finish(self, trials: int) -> None:
        """Count a run of this number of trials as finished, even if it had nothing left to run."""
        finished = self._previous.finished + trials
        self._previous = self._current = replace(self._current, finished=finished)


@dataclass(frozen=True)
class Timing:
    """Times of a run."""

    compile: float  # [s] until the worker who waited longest had its programs
    run: float  # [s] wall clock after that
    simulated: float  # [s] of trials

    def __str__(self) -> str:
        rate = self.simulated / max(self.run, 1e-9)
        return f"compile {self.compile:.1f} s, run {self.run:.1f} s ({rate:.0f} simulated s per s)"


class Bar:
    """Progress bar on the error stream, with rate and time left; a callback of a run.

    It shows `compile` until the first trials have run, and then the phase of the run. Without a
    known total it appears with the first trials and counts.

    Examples:
      >>> import rps_jax
      >>> from rps_jax.trials.progress import Bar
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> with Bar("sweep", 8, shown=False) as bar:
      ...     results = rps_jax.sweep("rps", drums, worlds=8, setting=setting, report_to=bar)
      >>> bar.timing.simulated > 0
      True
    """

    def __init__(
        self,
        phase: str,
        total: float | None = None,
        over: Literal["trials", "simulated", "clock", "generations", "updates"] = "trials",
        *,
        shown: bool = True,
    ):
        """A bar over trials, simulated seconds, seconds of wall clock, generations or updates."""
        self._phase, self._total, self.over, self._shown = phase, total, over, shown
        self._bar: tqdm[NoReturn] | None = None
        self._start_time = time.perf_counter()
        self._last = Progress(0, 0.0)
        self.on_compiled: Callable[[], object] | None = None  # called once, when trials run

    def __enter__(self) -> Bar:
        self._start_time = time.perf_counter()
        if self._total is not None:
            self._open("compile")
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def _open(self, phase: str) -> tqdm[NoReturn]:
        from tqdm import tqdm

        interval, smoothing = (0.1, 0.05) if self.over == "simulated" else (0.5, 0.3)
        unit = "s" if self.over in ("simulated", "clock") else self.over.removesuffix("s")
        self._bar = tqdm(
            total=self._total,
            unit=unit,
            desc=phase,
            disable=not self._shown,
            file=sys.stderr,
            mininterval=interval,
            smoothing=smoothing,
        )
        return self._bar

    @property
    def elapsed(self) -> float:
        """Wall clock [s] since the start of the bar."""
        return time.perf_counter() - self._start_time

    def phase(self, name: str) -> None:
        """Show the name of the next phase of the run."""
        self._phase = name
        if self._bar is not None:
            self._bar.set_description(name)

    def __call__(self, progress: Progress) -> None:
        self._last = progress
        if progress.compile and self.on_compiled is not None:
            on_compiled, self.on_compiled = self.on_compiled, None
            on_compiled()
        note = f"{progress.simulated:.0f} s simulated"
        if progress.compiled < progress.programs:
            note = f"{progress.compiled} of {progress.programs} programs compiled"
        trials, clock = progress.finished, min(self.elapsed, self._total or math.inf)
        moves = {
            "trials": (trials, note),
            "simulated": (progress.simulated, ""),
            "clock": (clock, f"{trials} trials"),
        }
        done, note = moves.get(self.over, (progress.rounds, note))
        bar = self._open(self._phase) if self._bar is None else self._bar
        starts = self._last.programs and not self._last.simulated
        bar.set_description("compile" if starts else self._phase, refresh=False)
        if note:
            bar.set_postfix_str(note, refresh=False)
        bar.update(round(done - bar.n, 3))

    @property
    def timing(self) -> Timing:
        """Times of the run so far."""
        return Timing(self._last.compile, self.elapsed - self._last.compile, self._last.simulated)


def set_phase(callback: ProgressCallback, name: str) -> None:
    """Show the name of the next phase if the callback is a bar."""
    if isinstance(callback, Bar):
        callback.phase(name)


def is_interactive() -> bool:
    """Return whether the error stream is a terminal, or this is a notebook."""
    return "ipykernel" in sys.modules or (sys.stderr is not None and sys.stderr.isatty())
