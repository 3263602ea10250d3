"""Run folder and resources of one execution of a command, and its resumable loop."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import xarray as xr

from rps_jax.record.checkpoint import Checkpoints
from rps_jax.trials.progress import ProgressCallback, SequentialProgress
from rps_jax.trials.worlds import BatchOptions


class Run(NamedTuple):
    """Run folder and resources of one execution of a question, and what the folder already holds.

    A long run is a sequence of steps that are stored as checkpoints, so that it can be killed and
    resumed. `checkpoint` runs one step; `steps` is the loop over numbered steps:

        state = initial
        for state in run.steps(lambda i: next_state(state, i), lambda i: i < 100):
            ...

    Steps in the folder are loaded and not computed again. The loop body must depend on nothing but
    the results of earlier steps, so that a resumed loop continues as if it had never stopped.
    """

    folder: Path | None  # None keeps all results in memory
    callback: ProgressCallback  # called with the progress of the run
    slots: int | None = None  # worlds that one worker steps at once
    workers: int | None = None  # host threads

    @property
    def checkpoints(self) -> Checkpoints | None:
        """Finished steps of the run, if it has a folder."""
        return None if self.folder is None else Checkpoints(self.folder)

    def checkpoint(self, name: str, compute: Callable[[], xr.Dataset]) -> xr.Dataset:
        """Return the dataset that is stored under a name; compute and store it if there is none."""
        stored = self.checkpoints
        return compute() if stored is None else stored.load_or_compute(name, compute)

    def steps(
        self,
        compute: Callable[[int], xr.Dataset],
        proceed: Callable[[int], bool],
        *,
        name: str = "{:06d}",
    ) -> Iterator[xr.Dataset]:
        """Yield the results of the steps 0, 1, ... of a loop, in this order.

        Args:
          compute: returns the result of a step by its index.
          proceed: whether a step is computed if the folder lacks it; if not, the loop ends.
          name: name of a step's checkpoint, with its index.
        """
        finished = {} if self.checkpoints is None else self.checkpoints.paths()
        for index in itertools.count():
            key = name.format(index)
            if key not in finished and not proceed(index):
                return
            yield self.checkpoint(key, partial(compute, index))

    def in_parts(self) -> tuple[Run, SequentialProgress]:
        """Return the run of successive parts, and their progress, which counts finished parts."""
        progress = SequentialProgress(self.callback)
        return self._replace(callback=progress), progress

    def inside(self, name: str) -> Run:
        """Return the run with a subfolder, if it has a folder."""
        return self._replace(folder=self.folder and self.folder / name)

    @property
    def batch_options(self) -> BatchOptions:
        """Slots, workers and callback, as keyword arguments of functions that run trials."""
        return BatchOptions(slots=self.slots, workers=self.workers, callback=self.callback)
