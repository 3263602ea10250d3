"""What all trials of a run share, and what a run tells of itself."""

from __future__ import annotations

from collections.abc import Callable
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


@dataclass(frozen=True)
class Timing:
    """Where the time of a sweep went."""

    compile: float  # [s] until the worker who waited longest had its programs
    run: float  # [s] wall clock after that
    simulated: float  # [s] of trials
