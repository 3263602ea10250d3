"""What a run tells of itself while it runs: how far it is, and where the time went."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal


@dataclass(frozen=True)
class Progress:
    """A look at a run under way."""

    finished: int  # trials
    simulated: float  # [s] summed over trials, ended or running
    compile: float = 0.0  # [s] until the worker who waited longest had its programs
    rounds: int = 0  # generations or updates that are done


ProgressCallback = Callable[[Progress], object]  # called now and then by what runs


def no_progress(progress: Progress) -> None:
    """Ignore the progress of a run that nobody watches."""


class SequentialProgress:
    """ProgressCallback of runs that follow one another, as if they were one."""

    def __init__(self, callback: ProgressCallback):
        self._report = callback
        self._before = self._now = Progress(0, 0.0)

    def __call__(self, progress: Progress) -> None:
        before = self._before
        self._now = Progress(
            before.finished + progress.finished,
            before.simulated + progress.simulated,
            before.compile + progress.compile,
        )
        self._report(self._now)

    def finish(self, trials: int) -> None:
        """Count a run of so many trials as ended, even if it had nothing left to run."""
        self._before = self._now = replace(self._now, finished=self._before.finished + trials)


@dataclass(frozen=True)
class Timing:
    """Where the time of a run went."""

    compile: float  # [s] until the worker who waited longest had its programs
    run: float  # [s] wall clock after that
    simulated: float  # [s] of trials


class Bar:
    """Progress bar on the error stream, with rate and time left, to be handed to a run as `report`.

    It says `compile` until the first trials have run, and then the phase of the run. Without a
    known total it counts, and shows itself with the first trials.

    Example:
      >>> import rps_jax
      >>> from rps_jax.trials.progress import Bar
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> with Bar("sweep", 8, shown=False) as bar:
      ...     found = rps_jax.sweep("rps", drums, worlds=8, setting=setting, report_to=bar)
      >>> bar.timing.simulated > 0
      True
    """

    def __init__(
        self,
        what: str,
        total: float | None = None,
        over: Literal["trials", "simulated", "clock", "generations", "updates"] = "trials",
        *,
        shown: bool = True,
    ):
        """A bar over trials, simulated seconds, seconds of wall clock, generations or updates."""
        self._what, self._total, self.over, self._shown = what, total, over, shown
        self._bar: Any = None
        self._began = time.perf_counter()
        self._last = Progress(0, 0.0)
        self.on_compiled: Callable[[], object] | None = None  # called once, when trials run

    def __enter__(self) -> Bar:
        self._began = time.perf_counter()
        if self._total is not None:
            self._open("compile")
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def _open(self, what: str) -> Any:
        from tqdm import tqdm

        own: dict[str, Any] = {"mininterval": 0.5}
        if self.over == "simulated":
            own = {"smoothing": 0.05}
        unit = "s" if self.over in ("simulated", "clock") else self.over.removesuffix("s")
        self._bar = tqdm(
            total=self._total, unit=unit, desc=what, disable=not self._shown, file=sys.stderr, **own
        )
        return self._bar

    @property
    def elapsed(self) -> float:
        """Wall clock [s] since it began."""
        return time.perf_counter() - self._began

    def phase(self, what: str) -> None:
        """Say what is done from now on."""
        self._what = what
        if self._bar is not None:
            self._bar.set_description(what)

    def __call__(self, progress: Progress) -> None:
        self._last = progress
        if progress.compile and self.on_compiled is not None:
            called, self.on_compiled = self.on_compiled, None
            called()
        note = f"{progress.simulated:.0f} s simulated"
        if self.over == "trials":
            self.move(progress.finished, note)
        elif self.over == "simulated":
            self.move(progress.simulated)
        elif self.over == "clock":
            self.move(min(self.elapsed, self._total or math.inf), f"{progress.finished} trials")
        else:
            self.move(progress.rounds, note)

    def move(self, done: float, note: str = "") -> None:
        """Show that so many units are done, with a note beside."""
        bar = self._open(self._what) if self._bar is None else self._bar
        bar.set_description(self._what, refresh=False)
        if note:
            bar.set_postfix_str(note, refresh=False)
        bar.update(round(done - bar.n, 3))

    @property
    def timing(self) -> Timing:
        """Where the time went until now."""
        return Timing(self._last.compile, self.elapsed - self._last.compile, self._last.simulated)


def set_phase(callback: ProgressCallback, what: str) -> None:
    """Tell a bar what is done from now on; others do not hear of it."""
    if isinstance(callback, Bar):
        callback.phase(what)


def is_interactive() -> bool:
    """Whether somebody looks: the error stream is a terminal, or this is a notebook."""
    if "ipykernel" in sys.modules:
        return True
    return sys.stderr is not None and sys.stderr.isatty()
