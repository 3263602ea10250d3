"""A sweep on several hosts, through Ray: its parts go to workers, and their files come back.

A worker is a Ray task that claims one GPU, or processors where the cluster has no GPU. It asks for
one part after the other while its slots run, so that it compiles each kind once and its slots stay
full, and it sends the content of every part that is complete. The hosts need not share a file
system: the process that was started by the user, alone, writes into the run folder.

What holds: a part that came back is there as after `sweep.run_missing`. When a worker dies, Ray
starts its task again, on whatever host has room, and the parts it had begun are run again. A part
has the bits that one process gives it which sees one GPU, or processors alone, with as many
`slots`: whatever the number of workers and threads, whichever worker runs it, and with whatever
other parts. That asks for devices of one kind; versions and commit are compared when a worker
begins.
"""

import contextlib
import dataclasses
import functools
import itertools
import logging
import os
import socket
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import xarray as xr

from rps_jax import engines
from rps_jax.engines import device as devices
from rps_jax.engines.device import Device
from rps_jax.errors import InputError
from rps_jax.record import files, provenance
from rps_jax.record import folder as run_folder
from rps_jax.runs import sweep
from rps_jax.runs.board import Board
from rps_jax.runs.sweep import Plan, Shard
from rps_jax.trials.progress import Progress, Report, unheard

POLL = 0.5  # [s] between two looks at what the workers have done
PATIENCE = 10.0  # [s] to reach a cluster
RETRIES = 16  # how often the task of one worker is begun again


# --- a worker ------------------------------------------------------------------------------


def _work(
    board: Any,
    worker: int,
    plan: Plan,
    threads: int,
    same: dict[str, Any],
    prepare: Callable[[], Any],
    slots: int | None,
) -> None:
    """Run parts until none waits; a Ray task."""
    import ray

    def ask(what: str, *arguments: Any) -> Any:
        return ray.get(getattr(board, what).remote(worker, *arguments))

    prepare()
    environment = provenance.environment() | {"host": socket.gethostname(), "pid": os.getpid()}
    if _same(environment) != same:
        raise InputError(
            f"ray: host {environment['host']} has other software "
            f"({run_folder.difference(_same(environment), same)}): install the same on all hosts."
        )
    ask("enter", environment)
    tell, before = board.tell.remote, Progress(0, 0.0)

    def keep(number: int, part: xr.Dataset) -> None:
        ask("deliver", number, plan.parts[number].size, bytes(files.encoded(part)))

    def report(progress: Progress) -> None:
        nonlocal before
        tell(worker, progress.finished - before.finished, progress.simulated - before.simulated)
        before = progress

    while (found := ask("first")) is not None:  # and then what the board gives of its kind
        kind, first = found
        numbers = itertools.chain([first], iter(functools.partial(ask, "next", kind), None))
        before = Progress(0, 0.0)
        own = {plan.kind(first): numbers}
        sweep.work(plan, own, keep, report=report, slots=slots, workers=threads)


# --- the process that the user started -----------------------------------------------------


@contextlib.contextmanager
def connected(address: str, **options: Any) -> Iterator[ModuleType]:
    """Ray itself, connected to the cluster at an address; left as it is if it was connected.

    The address is host:port, `auto` (the cluster that this host is part of), or `local`: one of
    this host alone, which ends with the context and reports to nobody. The options are of
    `ray.init`.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as error:
        raise InputError("ray is not installed: pip install 'rps_jax[cluster]'.") from error
    if ray.is_initialized():
        yield ray
        return
    if address == "local":
        options = {"include_dashboard": False} | options
    try:
        _reach(address)
        with warnings.catch_warnings():  # Ray starts its processes by fork and exec
            warnings.filterwarnings("ignore", r"os\.fork", RuntimeWarning)
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR, **options)
    except (OSError, RuntimeError, ValueError, SystemExit) as error:  # SystemExit: Ray gave up
        raise InputError(
            f"ray = {address} is no cluster that can be reached ({_line(error)}): run `ray start` "
            "here and on its other hosts, or choose local."
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _reach(address: str) -> None:
    """Try the address soon: Ray itself tries for minutes, and then ends the process."""
    if address == "auto":
        address = os.environ.get("RAY_ADDRESS", "auto")
    host, _, port = address.rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host, int(port)), PATIENCE).close()


def _line(error: BaseException) -> str:
    """The last line of a message, which says what is wrong, without its full stop."""
    return (str(error).strip().splitlines() or [type(error).__name__])[-1].rstrip(".")


def run_on_cluster(
    folder: Path,
    plan: Plan,
    *,
    address: str,
    prepare: Callable[[], Any],
    gpus: bool = True,
    shard: Shard = Shard(),
    report: Report = unheard,
    slots: int | None = None,
    workers: int | None = None,
) -> None:
    """Run what is missing of a plan, as `sweep.run_missing` does, on the workers of a cluster.

    What came back is kept whatever error ends the run, and `environment.json` names the workers.
    Each calls `prepare` first, to choose its device and its cache of programs. It has as many
    threads as `workers` says, by default one, and claims as many processors, and with `gpus` a GPU
    if the cluster has any and the engine can use one.
    """
    own, known = provenance.environment(), {}
    missing, before = sweep.remaining(folder, plan, shard)
    if missing:
        provenance.sign(folder, own)
    report(Progress(before, 0.0))
    if not missing:
        return
    waiting = list(missing.values())
    lacking = set(itertools.chain.from_iterable(waiting))
    claim = {
        "num_cpus": workers or 1,
        "num_gpus": int(gpus and engines.get(plan.setting.engine).traced),
    }
    given = (_same(own), prepare, slots)
    with connected(address) as ray, _started(ray, plan, waiting, claim, given) as (board, tasks):
        while tasks and lacking:
            ended, tasks = ray.wait(tasks, num_returns=len(tasks), timeout=POLL)
            news = ray.get(board.news.remote())
            for number, content in news.parts:
                sweep.store(folder, number, content)
                lacking.discard(number)
            if news.workers != known:
                known = news.workers
                provenance.sign(folder, own | _environment(known))
            report(Progress(before + news.ended, news.simulated))
            if lacking:
                ray.get(ended)  # raises what ended a worker
    if lacking:
        raise InputError(f"ray = {address} lost {len(lacking)} parts: run the same command again.")


def on_cluster(address: str, device: Device) -> Callable[..., None]:
    """What runs a plan on the workers of a cluster, each on this device."""
    import jax

    return functools.partial(
        run_on_cluster,
        address=address,
        prepare=functools.partial(_prepare, device, bool(jax.config.jax_enable_x64)),
        gpus=device in ("auto", "gpu"),
    )


def _prepare(device: Device, x64: bool) -> None:
    """Make a worker's process compute as this one would."""
    import jax

    devices.be_deterministic()
    jax.config.update("jax_enable_x64", x64)
    devices.choose(device)
    devices.use_cache()


@contextlib.contextmanager
def _started(
    ray: ModuleType,
    plan: Plan,
    waiting: Sequence[Sequence[int]],
    claim: dict[str, int],
    given: tuple[Any, ...],
) -> Iterator[tuple[Any, list[Any]]]:
    """The board, on this host, and the tasks of as many workers as the cluster has room for."""
    if not ray.cluster_resources().get("GPU"):
        claim = claim | {"num_gpus": 0}
    count = min(_room(ray.nodes(), **claim), sum(map(len, waiting)))
    here = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(
        ray.get_runtime_context().get_node_id(), soft=False
    )
    board = ray.remote(num_cpus=0, scheduling_strategy=here)(Board).remote(waiting, count)
    task = ray.remote(**claim, max_retries=RETRIES, scheduling_strategy="SPREAD")(_work)
    bare = ray.put(dataclasses.replace(plan))  # without what it has worked out
    try:
        yield board, [task.remote(board, i, bare, claim["num_cpus"], *given) for i in range(count)]
    except ray.exceptions.RayError as error:
        cause = getattr(error, "cause", None)
        if cause is not None and not isinstance(cause, ray.exceptions.RayError):
            raise cause from error  # what went wrong in a worker
        raise InputError(
            f"ray has failed ({_line(error)}): what came back is kept; run the same command again."
        ) from error
    finally:
        ray.kill(board)  # workers that still run have nobody to work for


def _room(hosts: Sequence[Mapping[str, Any]], num_cpus: int, num_gpus: int) -> int:
    """How many workers with such claims the hosts of a cluster hold."""
    count = 0
    for host in hosts:
        there = host["Resources"] if host["Alive"] else {}
        room = there.get("CPU", 0) // num_cpus
        count += int(min(room, there.get("GPU", 0) // num_gpus) if num_gpus else room)
    if not count:
        with_gpu = " beside a GPU" if num_gpus else ""
        raise InputError(
            f"workers = {num_cpus} is not allowed: no host of the cluster has so many processors"
            f"{with_gpu}."
        )
    return count


def _environment(workers: Mapping[int, Mapping[str, Any]]) -> dict[str, Any]:
    """What `provenance.environment` says of one process, of all workers; and who they are."""
    some = next(iter(workers.values()))
    processors = {worker["host"]: worker["processors"] for worker in workers.values()}
    return {
        "processors": sum(processors.values()),
        "device": some["device"] | {"count": len(workers)},
        "workers": [
            {name: worker[name] for name in ("host", "pid", "device")}
            for worker in workers.values()
        ],
    }


def _same(environment: Mapping[str, Any]) -> dict[str, Any]:
    """What all workers must have in common, or their bits differ."""
    return {name: environment[name] for name in ("packages", "commit", "x64")}
