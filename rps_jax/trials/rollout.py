"""Rollouts: candidates of one law in the worlds of domains, and the outcomes of all trials.

This is the one way to draw worlds, run a law in them and collect the outcomes in memory. A request,
`Candidates`, holds law parameters with leaves (P, ...) and says which W worlds of a domain each of
the P candidates meets: those of a seed by their indices, or those at points of the unit cube.

    request = Candidates(stack(["rps", "rps,L=0.2"]), seed=3, worlds=np.arange(100))
    (result,), timing = rollout([request], [domain], setting)
    result.outcome.success    # (2, 100)
    result.distance           # (100,) [m] from the start to the target

A probe is one candidate at given points: `Candidates(stack([params]), 0, np.arange(n), points)`.
`capacity` then rounds the number of trials up, so that few programs serve many numbers of points. A
planner sets `per_world` and gives leaves (P, W, ...), its own parameters for each world.
"""

from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import NamedTuple, Unpack

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.control import registry
from rps_jax.control.base import LawParams
from rps_jax.trials import batch
from rps_jax.trials.batch import BatchOptions, Job, WorldBatch, rows
from rps_jax.trials.progress import Timing
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Outcome
from rps_jax.trials.worlds import drawn_worlds, remembered_steps
from rps_jax.world import points as points_
from rps_jax.world.domain import Domain
from rps_jax.world.draws import Draw
from rps_jax.world.points import Points


class Candidates(NamedTuple):
    """Parameters of one law, and the worlds that each candidate meets."""

    params: LawParams  # leaves (P, ...); (P, D * W, ...) with `per_world`
    seed: int  # of the worlds
    worlds: np.ndarray  # (W,) indices of the worlds, in each of the D domains
    points: Points | None = None  # of the unit cube at which the worlds lie; None: drawn worlds
    per_world: bool = False  # whether a candidate has different parameters in each world

    @property
    def num_candidates(self) -> int:
        """Number of candidates, P."""
        return jax.tree.leaves(self.params)[0].shape[0]

    def object_of(self, domain: Domain) -> np.ndarray:
        """Return the indices (W,) of the worlds' objects in the domain."""
        return domain.object_of(points_.cases(domain, self.points, self.worlds))

    def draw(self, domain: Domain, rows: np.ndarray) -> Draw:
        """Draw the worlds at positions `rows` of `worlds`, which must have the same object."""
        return points_.draw(domain, self.seed, self.points, self.worlds[rows])


class Rollout(NamedTuple):
    """Outcomes of all candidates of a request in all their worlds."""

    outcome: Outcome  # leaves (P, D * W, ...), on the host
    distance: np.ndarray  # (D * W,) [m] from the start to the target


def rollout(
    requests: Sequence[Candidates],
    domains: Sequence[Domain],
    setting: Setting,
    *,
    capacity: Callable[[int], int] = lambda trials: trials,
    **options: Unpack[BatchOptions],
) -> tuple[list[Rollout], Timing]:
    """Run every candidate in every world of its request; one batch for each shape family.

    Args:
      requests: candidates and their worlds; requests of one law share batches.
      domains: the worlds of a request are drawn from each of these.
      setting: engine, physics and rules.
      capacity: number of trials that a program has slots for, by the number of its trials.
      options: slots, workers and callback, as of `batch.run`.

    Returns:
      The outcomes of each request, and where the time went.
    """
    groups: dict[Hashable, list[WorldBatch]] = {}
    distances, sizes = [], []
    for request in requests:
        first, width = sum(sizes), len(domains) * request.worlds.size
        distances.append(np.empty(width))
        sizes.append(request.num_candidates * width)
        params = _params_per_world(request, width)
        for worlds, columns, distance in world_batches(request, domains, setting):
            distances[-1][columns] = distance
            trials = first + width * np.arange(request.num_candidates)[:, None] + columns
            chosen = jax.tree.map(lambda leaf, at=columns: leaf[:, at], params)
            key = _shape_key(worlds.worlds, 1), _shape_key(chosen, 2)
            groups.setdefault(key, []).append(worlds._replace(indices=trials, params=chosen))
    jobs = [_job(group, capacity) for group in groups.values()]
    outcome, timing = batch.run_all(jobs, setting, sum(sizes), **options)
    results = []
    for distance, end, size in zip(distances, np.cumsum(sizes), sizes, strict=True):
        trials = np.arange(end - size, end).reshape(-1, distance.size)
        results.append(Rollout(rows(outcome, trials), distance))
    return results, timing


def world_batches(
    request: Candidates, domains: Sequence[Domain], setting: Setting
) -> Iterator[tuple[WorldBatch, np.ndarray, np.ndarray]]:
    """Yield the worlds of a request by domain and object, without law parameters.

    Beside each batch (n,) come the positions (n,) of its worlds among all D * W of the request, and
    the distances (n,) [m] from the start to the target.
    """
    # Odometry of equal length in all domains lets their worlds share a batch.
    history = max(remembered_steps(d, setting.physics.control_period) for d in domains)
    for number, domain in enumerate(domains):
        objects = request.object_of(domain)
        for index in np.unique(objects):
            at = np.flatnonzero(objects == index)
            drawn = request.draw(domain, at)
            batch_ = drawn_worlds(domain, drawn, setting)
            odometry = batch_.worlds.odometry
            past = np.zeros((at.size, history), odometry.past.dtype)
            worlds = batch_.worlds._replace(odometry=odometry._replace(past=past))
            distance = np.linalg.norm(drawn.p_world_target, axis=1)
            yield batch_._replace(worlds=worlds), number * request.worlds.size + at, distance


def _params_per_world(request: Candidates, width: int) -> LawParams:
    """Return the law parameters with leaves (P, `width`, ...), as views on the host."""

    def expand(leaf: np.ndarray) -> np.ndarray:
        leaf = np.asarray(leaf, jnp.result_type(float))
        if request.per_world:
            return leaf
        return np.broadcast_to(leaf[:, None], (len(leaf), width, *leaf.shape[1:]))

    return jax.tree.map(expand, jax.device_get(request.params))


def _shape_key(tree: object, batch_dims: int) -> Hashable:
    """Return the structure of a pytree and the shapes of its leaves without batch dimensions."""
    leaves, structure = jax.tree.flatten(tree)
    return structure, *(np.shape(leaf)[batch_dims:] for leaf in leaves)


def _job(group: Sequence[WorldBatch], capacity: Callable[[int], int]) -> Job:
    """Return the job of worlds of one shape family, candidate after candidate.

    A batch of n worlds has the indices (P, n) of its trials, and parameters (P, n, ...).
    """

    def batches() -> Iterator[WorldBatch]:
        for worlds in group:
            for candidate, trials in enumerate(worlds.indices):
                params = rows(worlds.params, candidate)
                yield worlds._replace(indices=trials, params=params)

    trials = sum(worlds.indices.size for worlds in group)
    return Job(registry.law_of(group[0].params), capacity(trials), batches())
