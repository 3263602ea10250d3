"""Batch runs: the one way to run laws in worlds and to collect the outcomes of the trials.

A `Request` has the worlds of its trials, by the program that steps them. There are three kinds:
named cases (`pushes.Cases`), the chunks of a sweep (`runs.results.Results`), and here `Candidates`:
law parameters with leaves (P, ...) in random worlds.

    request = Candidates(stack(["rps", "rps,L=0.2"]), [domain], seed=3, worlds=np.arange(100))
    (outcome,), timing = outcomes([request], setting)
    outcome.success      # (2, 100)
    request.distances    # (100,) [m] from the start to the target

A probe is one candidate at given points: `Candidates(params, [domain], 0, np.arange(n), points)`.
`capacity` then rounds the number of trials up, so that few programs serve many numbers of points. A
planner sets `per_world` and gives leaves (P, W, ...), its own parameters for each world.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, Unpack

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.control.base import LawParams
from rps_jax.record.files import Arrays
from rps_jax.trials import batch
from rps_jax.trials.jobs import BatchOptions, Collect, Job, WorldBatch, rows
from rps_jax.trials.progress import Timing
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Outcome
from rps_jax.trials.worlds import drawn_worlds, remembered_steps
from rps_jax.world import points as points_
from rps_jax.world.domain import Domain
from rps_jax.world.draws import Draw
from rps_jax.world.points import Points


class Request(Protocol):
    """Trials to run."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the outcomes, in which the index of a trial counts in row-major order."""
        ...

    def jobs(self, setting: Setting) -> Iterable[Job]:
        """Return the worlds and law parameters of the trials, by the program that steps them."""
        ...


class RunOptions(BatchOptions, total=False):
    """Keyword arguments of `run_batch`."""

    capacity: Callable[[int], int]


def run_batch(
    requests: Sequence[Request],
    setting: Setting,
    collect: Collect,
    *,
    capacity: Callable[[int], int] = lambda trials: trials,
    **options: Unpack[BatchOptions],
) -> Timing:
    """Run every trial of every request to its end.

    Args:
      requests: their trials share programs. The indices of the trials of a request follow those of
        the previous request.
      setting: engine, physics and rules.
      collect: called with trials that ended, in any order, by one thread at a time.
      capacity: number of trials that a program has slots for, by the number of its trials.
      options: slots, workers and callback, as of `batch.run`.

    Returns:
      Where the time went.
    """
    groups: dict[Hashable, list[Job]] = {}
    for request, first in zip(requests, _first_trials(requests), strict=False):
        for job in request.jobs(setting):
            groups.setdefault(job.program, []).append(job.shifted(first))
    jobs = [Job.joined(group, capacity) for group in groups.values()]
    return batch.run(jobs, setting, collect=collect, **options)


def outcomes(
    requests: Sequence[Request], setting: Setting, **options: Unpack[RunOptions]
) -> tuple[list[Outcome], Timing]:
    """Run every trial of every request by `run_batch`, and collect the outcomes in arrays.

    Returns:
      The outcomes of each request, on the host with leaves (*shape, ...); and where the time went.
    """
    columns: Arrays = {}
    *firsts, count = _first_trials(requests)

    def collect(indices: np.ndarray, ended: Outcome) -> None:
        for name, leaf in ended.columns().items():
            if name not in columns:
                columns[name] = np.empty((count, *leaf.shape[1:]), leaf.dtype)
            columns[name][indices] = leaf

    timing = run_batch(requests, setting, collect, **options)
    whole = Outcome.of_columns(columns)
    trials = (np.arange(math.prod(x.shape)).reshape(x.shape) for x in requests)
    pairs = zip(firsts, trials, strict=True)
    return [rows(whole, first + index) for first, index in pairs], timing


def _first_trials(requests: Sequence[Request]) -> list[int]:
    """Return the index of the first trial of each request, and the number of all trials."""
    return np.cumsum([0, *(math.prod(request.shape) for request in requests)]).tolist()


@dataclass(frozen=True, eq=False)
class Candidates:
    """Parameters of one law, and the W worlds of each of D domains that the P candidates meet."""

    params: LawParams  # leaves (P, ...); (P, D * W, ...) with `per_world`
    domains: Sequence[Domain]
    seed: int  # of the worlds
    worlds: np.ndarray  # (W,) indices of the worlds, in each of the domains
    points: Points | None = None  # of the unit cube at which the worlds lie; None: drawn worlds
    per_world: bool = False  # whether a candidate has different parameters in each world

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (P, D * W) of the outcomes."""
        num_candidates = jax.tree.leaves(self.params)[0].shape[0]
        return num_candidates, len(self.domains) * self.worlds.size

    @functools.cached_property
    def draws(self) -> list[tuple[np.ndarray, Domain, Draw]]:
        """Worlds by domain and object: positions (n,) among all D * W, domain and draw."""
        return [
            (i * self.worlds.size + at, domain, drawn)
            for i, domain in enumerate(self.domains)
            for at, drawn in points_.draw_by_object(domain, self.seed, self.points, self.worlds)
        ]

    @property
    def distances(self) -> np.ndarray:
        """Distances (D * W,) [m] from the start to the target."""
        distances = np.empty(self.shape[1])
        for columns, _, drawn in self.draws:
            distances[columns] = np.linalg.norm(drawn.p_world_target, axis=1)
        return distances

    def batches(self, setting: Setting) -> Iterator[WorldBatch]:
        """Yield the worlds by domain and object, without law parameters.

        The indices (n,) of a batch are the positions of its worlds among all D * W.
        """
        # Odometry of equal length in all domains lets their worlds share a batch.
        period = setting.physics.control_period
        remembered = max(remembered_steps(domain, period) for domain in self.domains)
        for columns, domain, drawn in self.draws:
            worlds = drawn_worlds(domain, drawn, setting, remembered)
            yield worlds._replace(indices=columns)

    def jobs(self, setting: Setting) -> Iterator[Job]:
        """Yield the worlds of each domain and object, candidate after candidate."""
        num_candidates, width = self.shape
        params, dtype = jax.device_get(self.params), jnp.result_type(float)

        def candidate(worlds: WorldBatch, i: int) -> WorldBatch:
            trials = worlds._replace(indices=width * i + worlds.indices)
            if not self.per_world:
                return trials.with_params(rows(params, i))
            chosen = rows(params, (i, worlds.indices))
            return trials._replace(params=jax.tree.map(lambda x: np.asarray(x, dtype), chosen))

        for worlds in self.batches(setting):
            batches = [candidate(worlds, i) for i in range(num_candidates)]
            program = _shape_key(batches[0].inputs)
            yield Job(program, num_candidates * worlds.indices.size, batches)


def _shape_key(tree: object) -> Hashable:
    """Return the structure of a pytree and the shapes of its leaves without their first axis."""
    leaves, structure = jax.tree.flatten(tree)
    return structure, *(np.shape(leaf)[1:] for leaf in leaves)
