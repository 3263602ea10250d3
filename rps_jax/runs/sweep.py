"""Many random worlds, in memory or in a run folder that can be killed and continued, and split.

The design is paired: every arm (a strategy with its parameters) meets the same worlds. Trials are
kept in parts: a part is one file, written whole as soon as its last trial has ended, named by the
hash of its content. A part that is there is not run again.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from rps_jax.control import strategies
from rps_jax.control.strategies import Params
from rps_jax.engines import EngineName
from rps_jax.record import folder as run_folder
from rps_jax.record import provenance
from rps_jax.record.checkpoint import Parts
from rps_jax.robot.robot import Robot
from rps_jax.runs.plan import Kind, Plan, Shard, draw, made, open_run, share
from rps_jax.runs.results import (
    Collector,
    Keep,
    dataset,
    gather,
    labelled,
    name_of,
)
from rps_jax.trials import batch
from rps_jax.trials.batch import Job, Part
from rps_jax.trials.setting import Progress, Report, Setting, Timing, unheard
from rps_jax.trials.trial import Rules
from rps_jax.world import points
from rps_jax.world.domain import Domain, named
from rps_jax.world.draws import table
from rps_jax.world.physics import Fidelity, PhysicsName, preset

_AHEAD = 16384  # worlds of a kind that are made before they are asked for, about


def sweep(
    domain: Domain | str,
    arms: Mapping[str, Params],
    worlds: int | xr.Dataset | np.ndarray = 1000,
    seed: int = 0,
    engine: EngineName = "fused",
    out: str | Path | None = None,
    *,
    physics: PhysicsName = "default",
    fidelity: Fidelity = "standard",
    rules: Rules = Rules(),
    robot: Robot | str | None = None,
    part: int = 1024,
    slots: int | None = None,
    workers: int | None = None,
    report: Report = unheard,
) -> xr.Dataset:
    """Every arm in the same random worlds.

    Args:
      domain: ranges of what differs between worlds, or their name in `DOMAINS`.
      arms: names and parameters of any strategies.
      worlds: how many, of indices 0, 1, ...; or points of the unit cube, as `worlds_at` has them.
      seed: of the worlds, unless they are points.
      engine: what steps them.
      out: run folder, in which a sweep that was killed is continued; None keeps all in memory.
      physics: how friction is modelled.
      fidelity: how finely the physics is solved.
      rules: when a trial ends.
      robot: by its name in `ROBOTS`, or a JSON file's; None: the domain's.
      part: trials of a part at most, which is what a sweep that is killed loses.
      slots: worlds stepped at once by a worker; by default as suits engine and device.
      workers: host threads; by default as suits engine and device.
      report: called after every segment of the run.

    Returns:
      Outcomes (arm, world), and what was drawn (world) as coordinates.

    Raises:
      InputError: an argument is not allowed, or `out` holds another run.

    Example:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> both = {"paper": rps_jax.RPSParams.paper(), "tuned": rps_jax.RPSParams.tuned()}
      >>> found = rps_jax.sweep(drums, both, worlds=4, rules=rules)
      >>> dict(found.success.sizes)
      {'arm': 2, 'world': 4}
    """
    setting = Setting(preset(physics, fidelity), rules, seed, engine)
    chosen = named(domain, robot)
    count, at = points.asked(chosen, worlds)
    plan = Plan(chosen, count, arms, setting, part, at)
    plan.check_here()
    shape = {"slots": slots, "workers": workers, "report": report}
    return whole(plan, None if out is None else Path(out), **shape)


def whole(plan: Plan, out: Path | None, *, report: Report = unheard, **shape: Any) -> xr.Dataset:
    """All results of a plan, in a run folder, in which it can be continued, or in memory alone."""
    if out is not None:
        _, results = complete(out, plan, report=report, **shape)
        assert results is not None
        return labelled(results)
    contents: dict[int, bytes] = {}
    every: dict[Kind, list[int]] = {}
    for number in plan.parts:
        every.setdefault(plan.kind(number), []).append(number)
    work(plan, every, contents.__setitem__, report=report, **shape)
    return labelled(dataset(plan, contents))


def run_missing(
    folder: Path,
    plan: Plan,
    *,
    shard: Shard = Shard(),
    report: Report = unheard,
    **shape: Any,
) -> Timing:
    """Run what is missing of a plan, or of one shard of it, in a folder that `open_run` opened."""
    missing, before = remaining(folder, plan, shard)
    report(Progress(before, 0.0))
    if missing:
        provenance.sign(folder)

    def tell(progress: Progress) -> None:
        report(Progress(before + progress.finished, progress.simulated))

    return work(plan, missing, functools.partial(store, folder), report=tell, **shape)


def complete(
    folder: Path,
    plan: Plan,
    shard: Shard = Shard(),
    *,
    by: Callable[..., Timing] = run_missing,
    **options: Any,
) -> tuple[Timing, xr.Dataset | None]:
    """Run what a folder lacks of a plan, or of one shard of it; gather the whole in `results.nc`.

    Args:
      folder: the run folder, new or to be continued.
      plan: what is run.
      shard: the share that is run.
      by: what runs it, as `run_missing` or `cluster.run_on_cluster`.
      options: of `by`.

    Returns:
      Where the time went; and all results, unless it was but a share of them.

    Raises:
      InputError: the folder cannot be written, is in use, or holds another run.
    """
    open_run(folder, plan)
    with run_folder.hold(folder, shard.number, shard.of):
        timing = by(folder, plan, shard=shard, **options)
        return timing, gather(plan, [folder], folder) if shard.of == 1 else None


def work(
    plan: Plan,
    numbers: Mapping[Kind, Iterable[int]],
    keep: Keep,
    *,
    report: Callable[[Progress], Any],
    **shape: Any,
) -> Timing:
    """Run some parts of a plan: of each kind those with these numbers, asked for one by one.

    There are as many slots as the whole plan has use for, whatever parts are run, so that a part
    has the same bits whoever runs it, and with whatever other parts.
    """
    jobs, collector = [], Collector(plan, keep)
    for kind, some in numbers.items():
        parts = _made(plan, some, collector)
        if isinstance(some, Sequence):  # what is asked for elsewhere is asked for when it is needed
            parts = _ahead(parts, max(1, _AHEAD // plan.part))
        jobs.append(Job(strategies.STRATEGIES[kind[1]], plan.sizes[kind], parts))
    return batch.run(jobs, plan.setting, collect=collector.collect, report=report, **shape)


def remaining(folder: Path, plan: Plan, shard: Shard) -> tuple[dict[Kind, list[int]], int]:
    """Parts of a shard that a run folder lacks, by kind, and how many trials it has."""
    done = Parts(folder).found()
    missing: dict[Kind, list[int]] = {}
    before = 0
    for number, trials in share(plan, shard).items():
        if name_of(number) in done:
            before += trials.size
        else:
            missing.setdefault(plan.kind(number), []).append(number)
    return missing, before


def _made(plan: Plan, numbers: Iterable[int], collector: Collector) -> Iterator[Part]:
    """The worlds of parts, made one part at a time; the first arm's keep what was drawn."""
    for number in numbers:
        trials, (arm, _) = plan.parts[number], plan.arm_and_object(number)
        drawn = draw(plan, trials % plan.worlds)
        if arm == 0:
            collector.expect(number, table(drawn))
        yield made(plan, arm, drawn)._replace(numbers=trials)


def _ahead(parts: Iterator[Part], count: int) -> Iterator[Part]:
    """The same, so many of them made while what came before them runs."""
    with ThreadPoolExecutor(1) as maker:
        coming = deque(maker.submit(next, parts, None) for _ in range(count))
        while (part := coming.popleft().result()) is not None:
            coming.append(maker.submit(next, parts, None))
            yield part


def store(folder: Path, part: int, content: bytes) -> Path:
    """Write the file of a part into a run folder, whole or not at all."""
    return Parts(folder).put(name_of(part), content, new=True)
