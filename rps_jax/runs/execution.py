"""Execution of a sweep's plan: in memory, in a run folder that can be resumed, or one shard of it.

A plan's trials are stored in chunks. A chunk is one file, written as a whole as soon as its last
trial has ended, and named by the hash of its content. A chunk that is stored is not run again.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from rps_jax.control import registry
from rps_jax.engines import device
from rps_jax.record import folder as run_folder
from rps_jax.record import provenance
from rps_jax.record.checkpoint import Checkpoints
from rps_jax.runs import results
from rps_jax.runs.plan import Plan, ProgramKey, Shard, draw, made, open_run, shard_chunks
from rps_jax.runs.question import with_coordinates
from rps_jax.trials import batch
from rps_jax.trials.batch import Job, WorldBatch
from rps_jax.trials.progress import Progress, ProgressCallback, no_progress
from rps_jax.world.draws import table

_PREFETCH = 16384  # worlds of one program that are built before they are needed, about


def run_plan(
    plan: Plan, out: Path | None, *, callback: ProgressCallback = no_progress, **shape: Any
) -> xr.Dataset:
    """All results of a plan, in a run folder, in which it can be continued, or in memory alone."""
    if out is not None:
        found = run_in_folder(out, plan, callback=callback, **shape)
        assert found is not None
        return with_coordinates(found)
    made: dict[int, results.ResultChunk] = {}
    every: dict[ProgramKey, list[int]] = {}
    for number in plan.chunks:
        every.setdefault(plan.program_key(number), []).append(number)
    run_chunks(plan, every, made.__setitem__, callback=callback, **shape)
    return with_coordinates(results.dataset(plan, made.items()))


def shard_results(folder: Path, plan: Plan, shard: Shard) -> xr.Dataset:
    """Outcomes (row) of a shard's own trials, with the law and the world of each."""
    own = shard_chunks(plan, shard)
    kept = Checkpoints(folder).items([results.name_of(number) for number in own])
    parts = ((int(name), results.decoded(int(name), content)) for name, content in kept)
    found = results.dataset(plan, parts)
    law, world = np.divmod(np.concatenate(list(own.values())), plan.worlds)
    at = {"law": xr.DataArray(law, dims="row"), "world": xr.DataArray(world, dims="row")}
    return found[list(results.UNITS)].isel(at)


def run_missing(
    folder: Path,
    plan: Plan,
    *,
    shard: Shard = Shard(),
    callback: ProgressCallback = no_progress,
    **shape: Any,
) -> dict[int, results.ResultChunk]:
    """Run what is missing of a plan, or of one shard of it, in a folder that `open_run` opened.

    Returns the parts that were made, of a whole plan.
    """
    made = {}
    missing, before = missing_chunks(folder, plan, shard)
    callback(Progress(before, 0.0))
    if missing:
        provenance.write_environment(folder, device.collect_environment())

    def tell(progress: Progress) -> None:
        callback(replace(progress, finished=before + progress.finished))

    def keep(number: int, part: results.ResultChunk) -> None:
        store_chunk(folder, number, results.encoded(part))
        if shard.of == 1:
            made[number] = part

    run_chunks(plan, missing, keep, callback=tell, **shape)
    return made


def run_in_folder(
    folder: Path,
    plan: Plan,
    shard: Shard = Shard(),
    *,
    by: Callable[..., Any] = run_missing,
    **options: Any,
) -> xr.Dataset | None:
    """Run what a folder lacks of a plan, and gather the whole in `results.nc`; or run one shard.

    `by` runs it with its `options`, as `run_missing` or `cluster.run_on_cluster`.
    """
    open_run(folder, plan)
    with run_folder.lock(folder, shard.number, shard.of):
        made = by(folder, plan, shard=shard, **options) or {}
        return results.gather(plan, [folder], folder, made) if shard.of == 1 else None


def run_chunks(
    plan: Plan,
    numbers: Mapping[ProgramKey, Iterable[int]],
    keep: results.Keep,
    *,
    callback: Callable[[Progress], Any],
    **shape: Any,
) -> None:
    """Run some parts of a plan: of each kind those with these numbers, asked for one by one.

    There are as many slots as the whole plan has use for, whatever parts are run, so that a part
    has the same bits whoever runs it, and with whatever other parts.
    """
    jobs, collector = [], results.Collector(plan, keep)
    for kind, some in numbers.items():
        parts = _built(plan, some, collector)
        if isinstance(some, Sequence):  # what is asked for elsewhere is asked for when it is needed
            parts = _prefetched(parts, max(1, _PREFETCH // plan.part))
        jobs.append(Job(registry.law_of(kind[1]), plan.trials_by_key[kind], parts))
    batch.run(jobs, plan.setting, collect=collector.collect, callback=callback, **shape)


def missing_chunks(
    folder: Path, plan: Plan, shard: Shard
) -> tuple[dict[ProgramKey, list[int]], int]:
    """Parts of a shard that a run folder lacks, by kind, and how many trials it has."""
    done = Checkpoints(folder).paths()
    missing: dict[ProgramKey, list[int]] = {}
    before = 0
    for number, trials in shard_chunks(plan, shard).items():
        if results.name_of(number) in done:
            before += trials.size
        else:
            missing.setdefault(plan.program_key(number), []).append(number)
    return missing, before


def _built(
    plan: Plan, numbers: Iterable[int], collector: results.Collector
) -> Iterator[WorldBatch]:
    """The worlds of parts, made one part at a time; the first law's keep what was drawn."""
    for number in numbers:
        trials, (law, _) = plan.chunks[number], plan.law_and_object(number)
        drawn = draw(plan, trials % plan.worlds)
        if law == 0:
            collector.drawn[number] = table(drawn)
        yield made(plan, law, drawn)._replace(indices=trials)


def _prefetched(parts: Iterator[WorldBatch], count: int) -> Iterator[WorldBatch]:
    """Prefetch worlds: make `count` parts ahead while the ones before them run."""
    with ThreadPoolExecutor(1) as maker:
        coming = deque(maker.submit(next, parts, None) for _ in range(count))
        while (part := coming.popleft().result()) is not None:
            coming.append(maker.submit(next, parts, None))
            yield part


def store_chunk(folder: Path, part: int, content: bytes) -> Path:
    """Write the file of a part into a run folder, whole or not at all."""
    return Checkpoints(folder).put(results.name_of(part), content, ".npz", new=True)
