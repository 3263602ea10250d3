"""A sweep on several hosts, through Ray: its parts go to workers, and their files come back.

A task runs some parts of one kind on one GPU, or on processors where the cluster has no GPU, and
returns their contents. Ray gives tasks to whichever worker is free, and begins a task again when
its worker dies. The hosts need not share a file system: the process that was started by the user,
alone, writes into the run folder.

A part has the bits that one process gives it which sees one GPU, or processors alone, with as many
`slots`: whatever the number of workers and threads, whichever worker runs it, and with whatever
other parts. That asks for devices of one kind; versions and commit are compared in every task.
"""

import contextlib
import dataclasses
import functools
import logging
import math
import os
import socket
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from rps_jax import engines, errors
from rps_jax.engines import device as devices
from rps_jax.engines.device import Device
from rps_jax.errors import InputError
from rps_jax.record import cache, provenance
from rps_jax.record import folder as run_folder
from rps_jax.runs import execution, results
from rps_jax.runs.plan import Plan, Shard
from rps_jax.trials.progress import Progress, ProgressCallback, no_progress

PATIENCE = 10.0  # [s] to reach a cluster
RETRIES = 16  # how often a task is begun again
_TASKS = 4  # of each worker and kind, so that little is lost with a worker


# --- a worker ------------------------------------------------------------------------------


def _work(
    plan: Plan,
    numbers: Sequence[int],
    same: dict[str, Any],
    prepare: Callable[[], Any],
    slots: int | None,
    threads: int,
) -> tuple[dict[int, bytes], Progress, dict[str, Any]]:
    """Run parts of one kind, as a task of Ray: their contents, progress, and the environment."""
    prepare()
    environment = devices.collect_environment() | {
        "host": socket.gethostname(),
        "pid": os.getpid(),
    }
    if _same(environment) != same:
        raise InputError(
            f"ray: host {environment['host']} has other software "
            f"({run_folder.describe_difference(_same(environment), same)}): install the same on "
            "all hosts."
        )
    found, heard = dict[int, bytes](), [Progress(0, 0.0)]
    execution.run_chunks(
        plan,
        {plan.program_key(numbers[0]): numbers},
        lambda number, part: found.update({number: results.encoded(part)}),
        callback=heard.append,
        slots=slots,
        workers=threads,
    )
    return found, heard[-1], environment


# --- the process that the user started -----------------------------------------------------


@contextlib.contextmanager
def connected(address: str, **options: Any) -> Iterator[ModuleType]:
    """Ray itself, connected to the cluster at an address; left as it is if it was connected.

    The address is host:port, `auto` (the cluster that this host is part of), or `local`: one of
    this host alone, which ends with the context and reports to nobody. The options are of
    `ray.init`.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray = errors.require("ray", "cluster")
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
    callback: ProgressCallback = no_progress,
    slots: int | None = None,
    workers: int | None = None,
) -> None:
    """Run what is missing of a plan, as `execution.run_missing` does, on the workers of a cluster.

    What came back is kept whatever error ends the run, and `environment.json` names the workers.
    Each task calls `prepare` first, to choose its device and its cache of programs. It has as many
    threads as `workers` says, by default one, and claims as many processors, and with `gpus` a GPU
    if the cluster has any and the engine can use one.
    """
    own, known = devices.collect_environment(), dict[tuple[str, int], dict[str, Any]]()
    missing, before = execution.missing_chunks(folder, plan, shard)
    if missing:
        provenance.write_environment(folder, own)
    done = Progress(before, 0.0)
    callback(done)
    if not missing:
        return
    threads = workers or 1
    with connected(address) as ray:
        gpu = gpus and engines.get(plan.setting.engine).traced
        gpu = gpu and bool(ray.cluster_resources().get("GPU"))
        room = _room(ray.nodes(), threads, int(gpu))
        # A process of a GPU's task would else end with it, and compile again.
        kept = {"max_calls": 0, "max_retries": RETRIES, "scheduling_strategy": "SPREAD"}
        task = ray.remote(num_cpus=threads, num_gpus=int(gpu), **kept)(_work)
        bare = ray.put(dataclasses.replace(plan))  # without what it has worked out
        given = _same(own), prepare, slots, threads
        waiting = [task.remote(bare, some, *given) for some in _divided(missing.values(), room)]
        with _told_in_a_sentence(ray, waiting):
            while waiting:
                (ended,), waiting[:] = ray.wait(waiting)
                contents, progress, environment = ray.get(ended)
                for number, content in contents.items():
                    execution.store_chunk(folder, number, content)
                known[environment["host"], environment["pid"]] = environment
                provenance.write_environment(folder, own | _environment(list(known.values())))
                simulated = done.simulated + progress.simulated
                done = Progress(done.finished + progress.finished, simulated)
                callback(done)


def _divided(kinds: Iterable[Sequence[int]], workers: int) -> Iterator[Sequence[int]]:
    """Parts of each kind in equal shares, one after the other: a task has parts of one kind."""
    for numbers in kinds:
        size = math.ceil(len(numbers) / (workers * _TASKS))
        yield from (numbers[i : i + size] for i in range(0, len(numbers), size))


@contextlib.contextmanager
def _told_in_a_sentence(ray: ModuleType, waiting: Sequence[Any]) -> Iterator[None]:
    """Raise what went wrong in a task as itself; no other task runs on then."""
    try:
        yield
    except ray.exceptions.RayError as error:
        cause = getattr(error, "cause", None)
        if cause is not None and not isinstance(cause, ray.exceptions.RayError):
            raise cause from error
        raise InputError(
            f"ray has failed ({_line(error)}): what came back is kept; run the same command again."
        ) from error
    finally:
        for task in waiting:
            ray.cancel(task, force=True)


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

    devices.configure_xla()
    jax.config.update("jax_enable_x64", x64)
    devices.choose(device)
    cache.use_cache()


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


def _environment(workers: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the environment record of all workers, and who they are."""
    some = workers[0]
    processors = {worker["host"]: worker["processors"] for worker in workers}
    return {
        "processors": sum(processors.values()),
        "device": some["device"] | {"count": len(workers)},
        "workers": [
            {name: worker[name] for name in ("host", "pid", "device")} for worker in workers
        ],
    }


def _same(environment: Mapping[str, Any]) -> dict[str, Any]:
    """What all workers must have in common, or their bits differ."""
    return {name: environment[name] for name in ("packages", "commit", "x64")}
