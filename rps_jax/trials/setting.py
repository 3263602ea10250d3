"""What all trials of a run share, and what a run tells of itself while it runs."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from rps_jax import engines, errors
from rps_jax.engines import EngineName
from rps_jax.trials.trial import Rules
from rps_jax.world.physics import PHYSICS, Physics


@dataclass(frozen=True)
class Setting:
    """What all trials of a run share."""

    physics: Physics = PHYSICS["default"]["standard"]
    rules: Rules = Rules()
    seed: int = 0  # of the skins' imperfections, and of random worlds
    engine: EngineName = "mjx"

    def __post_init__(self) -> None:
        """Raises InputError for rules, a seed or an engine that mean nothing, or do together."""
        self.rules.check()
        errors.check_count("seed", self.seed, at_least=0, at_most=2**32 - 1)
        engines.get(self.engine).check_physics(self.physics)


@dataclass(frozen=True)
class Progress:
    """A look at a running sweep."""

    finished: int  # trials
    simulated: float  # [s] summed over trials, ended or running
    compile: float = 0.0  # [s] until the worker who waited longest had its programs


Report = Callable[[Progress], object]  # called now and then by what runs


def unheard(progress: Progress) -> None:
    """The report of a run that nobody watches."""


class InTurn:
    """The report of runs that follow one another, as if they were one."""

    def __init__(self, report: Report):
        """`report` hears of them all."""
        self._report = report
        self._before = self._now = Progress(0, 0.0)

    def __call__(self, progress: Progress) -> None:
        """A look at the run under way."""
        before = self._before
        self._now = Progress(
            before.finished + progress.finished, before.simulated + progress.simulated
        )
        self._report(self._now)

    def ended(self, trials: int) -> None:
        """A run of so many trials has ended, even if it had nothing left to run."""
        self._before = self._now = Progress(self._before.finished + trials, self._now.simulated)


@dataclass(frozen=True)
class Timing:
    """Where the time of a sweep went."""

    compile: float  # [s] until the worker who waited longest had its programs
    run: float  # [s] wall clock after that
    simulated: float  # [s] of trials


class Told:
    """What a run has reported: called with each `Progress`, it keeps the last."""

    def __init__(self, show: Report):
        """Shows each progress by `show`, too."""
        self._show, self._began = show, time.perf_counter()
        self._last = Progress(0, 0.0)

    def __call__(self, progress: Progress) -> None:
        """Take note of how far the run is."""
        self._last = progress
        self._show(progress)

    @property
    def timing(self) -> Timing:
        """Where the time went until now."""
        spent = time.perf_counter() - self._began
        compile_ = self._last.compile
        return Timing(compile_, spent - compile_, self._last.simulated)


@contextlib.contextmanager
def progress_bar(trials: int, what: str = "push") -> Iterator[Told]:
    """A bar over trials on the error stream, to be handed to a run as its `report`.

    Example:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> arms = {"rps": rps_jax.RPSParams.paper()}
      >>> with rps_jax.progress_bar(8) as report:
      ...     found = rps_jax.sweep(drums, arms, worlds=8, rules=rules, report=report)
      >>> report.timing.simulated > 0
      True
    """
    from tqdm import tqdm

    with tqdm(total=trials, unit="trial", desc="compile", mininterval=0.5) as bar:

        def show(progress: Progress) -> None:
            bar.set_description(what, refresh=False)
            bar.set_postfix_str(f"{progress.simulated:.0f} s simulated", refresh=False)
            bar.update(progress.finished - bar.n)

        yield Told(show)


@contextlib.contextmanager
def clock(horizon: float) -> Iterator[Told]:
    """A bar over the simulated seconds of one trial, likewise."""
    from tqdm import tqdm

    with tqdm(total=horizon, unit="s", desc="compile", smoothing=0.05) as bar:

        def show(progress: Progress) -> None:
            bar.set_description("push", refresh=False)
            bar.update(round(progress.simulated - bar.n, 3))

        yield Told(show)
