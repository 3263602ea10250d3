"""Execution of a plan: in memory, in a run folder that can be resumed, or one shard of it.

A plan's trials are stored in chunks, each of one law and one object. A chunk is one file, which is
written as a whole when its last trial has ended, and named by the hash of its content. A stored
chunk is not run again. At the end `results.nc` has all chunks.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Unpack

import numpy as np
import xarray as xr

from rps_jax.engines import device
from rps_jax.record import files, provenance
from rps_jax.record import folder as run_folder
from rps_jax.record.checkpoint import Checkpoints
from rps_jax.runs.plan import Plan, Shard, open_run, shard_chunks
from rps_jax.runs.results import PlanRequest, Results, StoreChunk, name_of, store_chunk
from rps_jax.trials.batch import run_batch
from rps_jax.trials.progress import Progress, ProgressCallback, no_progress
from rps_jax.trials.worlds import BatchOptions, BatchSize

# Runs the missing chunks of a shard in a folder, and may return their results.
RunMissing = Callable[..., Results | None]


def run_chunks(
    plan: Plan,
    chunks: Sequence[int],
    store: StoreChunk | None = None,
    **options: Unpack[BatchOptions],
) -> Results:
    """Run chunks of a plan and return their results; each is stored when it is complete."""
    results = Results(plan, store)
    run_batch([PlanRequest(plan, chunks, results)], plan.setting, results.put, **options)
    return results


def run_missing(
    folder: Path,
    plan: Plan,
    *,
    shard: Shard = Shard(),
    callback: ProgressCallback = no_progress,
    **size: Unpack[BatchSize],
) -> Results:
    """Run the chunks of a shard that a folder lacks; `open_run` must have opened the folder.

    Returns:
      The results of these chunks, so that they need not be read again.
    """
    missing, finished = missing_chunks(folder, plan, shard)
    callback(Progress(finished, 0.0))
    if missing or not finished:  # a shard may have no trials
        slots = {"slots": size.get("slots")}  # on which the bits depend
        provenance.write_environment(folder, device.collect_environment() | slots)

    def add_finished(progress: Progress) -> None:
        callback(replace(progress, finished=finished + progress.finished))

    return run_chunks(plan, missing, partial(store_chunk, folder), callback=add_finished, **size)


def run_trials(
    plan: Plan,
    folder: Path | None,
    shard: Shard = Shard(),
    *,
    execute: RunMissing = run_missing,
    **options: Unpack[BatchOptions],
) -> xr.Dataset:
    """Run a plan in memory, or what a run folder lacks of it or of a shard.

    Args:
      plan: the trials.
      folder: run folder, which gets the chunks; None: in memory.
      shard: part of the plan that is run in the folder.
      execute: `run_missing` or `cluster.run_on_cluster`.
      options: slots, workers and callback.

    Returns:
      Outcomes (law, world), with the drawn quantities (world) as coordinates. Of a shard, its own
      outcomes (row), with the law and the world of each.
    """
    if folder is None:
        return run_chunks(plan, list(plan.chunks), **options).dataset()
    open_run(folder, plan)
    with run_folder.lock(folder, shard.index, shard.count):
        try:
            results = execute(folder, plan, shard=shard, **options) or Results(plan)
        except Exception:
            _write_finished_laws(plan, folder)
            raise
        if shard.count == 1:
            return results.read_all([folder])
        chunks = shard_chunks(plan, shard)
        results.read(folder, set(chunks) & set(results.missing))
        no_trials = np.zeros(0, int)  # a small sweep has fewer chunks than shards
        trials = np.unravel_index(np.concatenate([no_trials, *chunks.values()]), results.shape)
        law, world = (xr.DataArray(index, dims="row") for index in trials)
        return results.dataset().isel(law=law, world=world)


def run_plan(plan: Plan, folder: Path | None, **options: Unpack[BatchOptions]) -> xr.Dataset:
    """Run what a run folder lacks of a plan; return the outcomes and write them there."""
    return write_dataset(run_trials(plan, folder, **options), folder)


def write_dataset(outcomes: xr.Dataset, folder: Path | None) -> xr.Dataset:
    """Write the outcomes of all trials into a run folder, if there is one, and return them."""
    if folder is not None:
        files.write_results(folder / "results.nc", outcomes)
    return outcomes


def _write_finished_laws(plan: Plan, folder: Path) -> None:
    """Write the results of the laws of which no chunk is missing, and name them in a warning."""
    results, laws = Results(plan), list(plan.laws)
    results.read(folder, list(plan.chunks))
    failed = {laws[plan.chunks[chunk][0] // plan.worlds] for chunk in results.missing}
    if finished := [law for law in laws if law not in failed]:
        write_dataset(results.dataset().sel(law=finished), folder)
        text = f"{folder / 'results.nc'} has the results of the laws that ran: "
        warnings.warn(text + ", ".join(finished), stacklevel=2)


def missing_chunks(folder: Path, plan: Plan, shard: Shard) -> tuple[list[int], int]:
    """Return the chunks of a shard that a run folder lacks, and the number of finished trials."""
    stored, chunks = Checkpoints(folder).paths(), shard_chunks(plan, shard)
    missing = [chunk for chunk in chunks if name_of(chunk) not in stored]
    return missing, sum(x.size for x in chunks.values()) - sum(chunks[i].size for i in missing)
