"""Execution of a plan: in memory, in a run folder that can be resumed, or one shard of it.

A plan's trials are stored in chunks, each of one law and one object. A chunk is one file, which is
written as a whole when its last trial has ended, and named by the hash of its content. A stored
chunk is not run again. `results.gather` joins the chunks into `results.nc`.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import xarray as xr

from rps_jax.control import registry
from rps_jax.engines import device
from rps_jax.record import folder as run_folder
from rps_jax.record import provenance
from rps_jax.record.checkpoint import Checkpoints
from rps_jax.runs import results
from rps_jax.runs.plan import Plan, ProgramKey, Shard, chunks_by_key, draw, open_run, shard_chunks
from rps_jax.runs.question import with_coordinates
from rps_jax.runs.results import Collector, ResultChunk, StoreChunk
from rps_jax.trials import batch
from rps_jax.trials.batch import BatchOptions, BatchSize, Job, WorldBatch
from rps_jax.trials.progress import Progress, ProgressCallback, no_progress
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.world.draws import table

_PREFETCH = 16384  # worlds of one program that are built before they are needed, about

# Runs the missing chunks of a shard in a folder, and may return those that it has in memory.
RunMissing = Callable[..., dict[int, ResultChunk] | None]


def run_plan(plan: Plan, folder: Path | None, **options: Unpack[BatchOptions]) -> xr.Dataset:
    """Run a plan in memory, or what a run folder lacks of it, and return all results."""
    if folder is not None:
        gathered = run_in_folder(folder, plan, **options)
        assert gathered is not None
        return with_coordinates(gathered)
    chunks: dict[int, ResultChunk] = {}
    run_chunks(plan, chunks_by_key(plan, plan.chunks), chunks.__setitem__, **options)
    return with_coordinates(results.dataset(plan, chunks.items()))


def run_in_folder(
    folder: Path,
    plan: Plan,
    shard: Shard = Shard(),
    *,
    by: RunMissing | None = None,
    **options: Any,
) -> xr.Dataset | None:
    """Run what a folder lacks of a plan, and gather all results; or run one shard.

    `by` runs the missing chunks with the `options`: `run_missing` or `cluster.run_on_cluster`.
    """
    open_run(folder, plan)
    with run_folder.lock(folder, shard.number, shard.of):
        chunks = (by or run_missing)(folder, plan, shard=shard, **options) or {}
        return results.gather(plan, [folder], folder, chunks) if shard.of == 1 else None


def run_missing(
    folder: Path,
    plan: Plan,
    *,
    shard: Shard = Shard(),
    callback: ProgressCallback = no_progress,
    **size: Unpack[BatchSize],
) -> dict[int, ResultChunk]:
    """Run the chunks of a shard that a folder lacks; `open_run` must have opened the folder.

    Returns:
      The new chunks if the shard is the whole plan, so that they need not be read again.
    """
    chunks = {}
    missing, finished = missing_chunks(folder, plan, shard)
    callback(Progress(finished, 0.0))
    if missing:
        provenance.write_environment(folder, device.collect_environment())

    def add_finished(progress: Progress) -> None:
        callback(replace(progress, finished=finished + progress.finished))

    def store(number: int, chunk: ResultChunk) -> None:
        store_chunk(folder, number, results.encoded(chunk))
        if shard.of == 1:
            chunks[number] = chunk

    run_chunks(plan, missing, store, callback=add_finished, **size)
    return chunks


def run_chunks(
    plan: Plan,
    numbers: Mapping[ProgramKey, Iterable[int]],
    store: StoreChunk,
    **options: Unpack[BatchOptions],
) -> None:
    """Run chunks of a plan, given by their numbers for each program, and store each when complete.

    The number of slots depends on the whole plan alone. So a chunk has the same bits whoever runs
    it, and whichever other chunks run beside it.
    """
    jobs, collector = [], Collector(plan, store)
    for key, chunks in numbers.items():
        batches = _build_batches(plan, chunks, collector)
        if isinstance(chunks, Sequence):  # otherwise a coordinator hands out numbers on demand
            batches = _prefetch(batches, max(1, _PREFETCH // plan.part))
        jobs.append(Job(registry.law_of(key[1]), plan.trials_by_key[key], batches))
    batch.run(jobs, plan.setting, collect=collector.collect, **options)


def missing_chunks(
    folder: Path, plan: Plan, shard: Shard
) -> tuple[dict[ProgramKey, list[int]], int]:
    """Return the chunks of a shard that a run folder lacks, and the number of finished trials."""
    stored, chunks = Checkpoints(folder).paths(), shard_chunks(plan, shard)
    missing = [number for number in chunks if results.name_of(number) not in stored]
    finished = sum(map(len, chunks.values())) - sum(len(chunks[number]) for number in missing)
    return chunks_by_key(plan, missing), finished


def shard_results(folder: Path, plan: Plan, shard: Shard) -> xr.Dataset:
    """Return the outcomes (row) of a shard's trials, with the law and the world of each."""
    chunks = shard_chunks(plan, shard)
    stored = Checkpoints(folder).items([results.name_of(number) for number in chunks])
    decoded = ((int(name), results.decoded(int(name), content)) for name, content in stored)
    whole = results.dataset(plan, decoded)
    law, world = np.divmod(np.concatenate(list(chunks.values())), plan.worlds)
    at = {"law": xr.DataArray(law, dims="row"), "world": xr.DataArray(world, dims="row")}
    return whole[list(results.UNITS)].isel(at)


def _build_batches(
    plan: Plan, numbers: Iterable[int], collector: Collector
) -> Iterator[WorldBatch]:
    """Build the worlds of chunks, one chunk at a time; chunks of the first law store the draws."""
    for number in numbers:
        trials, (law, _) = plan.chunks[number], plan.law_and_object(number)
        drawn = draw(plan, trials % plan.worlds)
        if law == 0:
            collector.drawn[number] = table(drawn)
        worlds = drawn_worlds(plan.domain, drawn, plan.setting)._replace(indices=trials)
        yield worlds.with_params(list(plan.laws.values())[law])


def _prefetch(batches: Iterator[WorldBatch], count: int) -> Iterator[WorldBatch]:
    """Build up to `count` batches ahead in a thread, while earlier ones run."""
    with ThreadPoolExecutor(1) as builder:
        queue = deque(builder.submit(next, batches, None) for _ in range(count))
        while (worlds := queue.popleft().result()) is not None:
            queue.append(builder.submit(next, batches, None))
            yield worlds


def store_chunk(folder: Path, number: int, content: bytes) -> Path:
    """Write the file of a chunk into a run folder, atomically."""
    return Checkpoints(folder).put(results.name_of(number), content, ".npz", new=True)
