"""Jobs of a batch run: worlds and law parameters of trials, by the program that steps them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Any, NamedTuple, TypedDict, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.control import registry
from rps_jax.control.base import Law, LawParams
from rps_jax.trials.progress import ProgressCallback
from rps_jax.trials.trial import Outcome, World

Tree = TypeVar("Tree")  # a pytree
Inputs = tuple[World, LawParams]
Collect = Callable[[np.ndarray, Outcome], object]  # indices (m,) of trials and their outcomes


class BatchSize(TypedDict, total=False):
    """Resources of functions that run trials."""

    slots: int | None  # worlds that one worker steps at once on each device of the host
    workers: int | None  # host threads for each device


class BatchOptions(BatchSize, total=False):
    """Keyword arguments of functions that run trials."""

    callback: ProgressCallback


def rows(tree: Tree, index: Any) -> Tree:
    """Return the rows `index` of every leaf; an index is whatever arrays take."""
    return jax.tree.map(lambda leaf: leaf[index], tree)


class WorldBatch(NamedTuple):
    """Worlds and law parameters of some trials of a job."""

    indices: np.ndarray  # (n,) indices of the trials in the run
    worlds: World  # leaves (n, ...), on the host
    stage: Any  # a `Stage`, or the models of an engine outside of JAX
    params: Any = ()  # `LawParams` with leaves (n, ...), on the host; () if not yet known

    def with_params(self, params: LawParams) -> WorldBatch:
        """Return the trials with the same law parameters in every world."""
        count, dtype = self.indices.size, jnp.result_type(float)
        same = jax.tree.map(lambda x: np.full((count, *np.shape(x)), x, dtype), params)
        return self._replace(params=same)

    @property
    def law(self) -> Law:
        """Law of the parameters."""
        return registry.law_of(self.params)

    @property
    def inputs(self) -> Inputs:
        """Inputs of the program, which differ from trial to trial."""
        return self.worlds, self.params

    def split(self, count: int) -> tuple[WorldBatch, WorldBatch | None]:
        """Return the first `count` trials, and the rest if there is one."""
        arrays = self._replace(stage=None)
        parts = slice(count), slice(count, None)
        first, rest = (rows(arrays, part)._replace(stage=self.stage) for part in parts)
        return first, rest if rest.indices.size else None


class Job(NamedTuple):
    """Trials that one compiled program can step."""

    program: Hashable  # key of the program; jobs with equal keys can be joined
    num_trials: int  # at most; there are no more slots than that
    batches: Iterable[WorldBatch]  # of one law, and of one stage if JAX traces the engine

    def shifted(self, first: int) -> Job:
        """Return the job with indices of trials that count from `first`."""
        batches = (batch._replace(indices=first + batch.indices) for batch in self.batches)
        return self._replace(batches=batches)

    @classmethod
    def joined(cls, jobs: Sequence[Job], capacity: Callable[[int], int]) -> Job:
        """Return the trials of jobs of one program, with slots for `capacity` of their number."""
        count = capacity(sum(job.num_trials for job in jobs))
        batches = itertools.chain.from_iterable(job.batches for job in jobs)
        return cls(jobs[0].program, count, batches)
