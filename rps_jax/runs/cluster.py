"""A sweep on several hosts through Ray: workers run chunks, and this process stores their files.

A task runs some chunks of one program on one GPU, or on processors where the cluster has no GPU,
and returns their contents. Ray gives tasks to free workers, and restarts a task when its worker
dies. The hosts need no shared file system: only the process that the user started writes into the
run folder.

A chunk has the same bits as in one process that uses one GPU, or processors alone, with as many
`slots`. The number of workers and threads, the worker and the other chunks do not matter. All
devices must be of one kind; every task compares versions and commit.
"""

import contextlib
import dataclasses
import functools
import logging
import math
import os
import socket
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from types import ModuleType

from rps_jax import errors
from rps_jax.engines import device as devices
from rps_jax.errors import InputError
from rps_jax.record import cache, provenance
from rps_jax.record import folder as run_folder
from rps_jax.record.files import JsonObject
from rps_jax.runs import execution
from rps_jax.runs.plan import Plan, Shard, chunks_by_key
from rps_jax.runs.results import store_chunk
from rps_jax.trials.progress import Progress, ProgressCallback, no_progress
from rps_jax.trials.worlds import BatchOptions
from rps_jax.world.objects import custom_solids

PATIENCE = 10.0  # [s] to reach a cluster
RETRIES = 16  # of a task
_TASKS = 4  # per worker and program, so that little work is lost with a worker


# --- a worker ------------------------------------------------------------------------------


def _work(
    plan: Plan,
    chunks: Sequence[int],
    software: JsonObject,
    prepare: Callable[[], object],
    slots: int | None,
    threads: int,
) -> tuple[dict[int, bytes], Progress, JsonObject]:
    """Run chunks of one program as a task of Ray; return contents, progress and environment."""
    prepare()
    environment = devices.collect_environment()
    environment |= {"host": socket.gethostname(), "pid": os.getpid()}
    if _software(environment) != software:
        difference = run_folder.describe_difference(_software(environment), software)
        raise InputError(
            f"ray: host {environment['host']} has other software ({difference}): install the same "
            "on all hosts."
        )
    contents, progress = dict[int, bytes](), [Progress(0, 0.0)]
    options = BatchOptions(callback=progress.append, slots=slots, workers=threads)
    execution.run_chunks(plan, chunks, contents.__setitem__, **options)
    return contents, progress[-1], environment


# --- the process that the user started -----------------------------------------------------


@contextlib.contextmanager
def connected(address: str, **options: object) -> Iterator[ModuleType]:
    """Connect Ray to the cluster at an address, unless it is connected; yield the module.

    The address is host:port, `auto` (the cluster that this host is part of), or `local`: a cluster
    of this host alone, which ends with the context. The options are those of `ray.init`.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray = errors.require("ray", "cluster")
    if ray.is_initialized():
        yield ray
        return
    if address == "local":
        options = {"include_dashboard": False} | options
    try:
        # Try the address first: Ray itself tries for minutes, and then ends the process.
        known = os.environ.get("RAY_ADDRESS", "auto") if address == "auto" else address
        host, _, port = known.rpartition(":")
        if host and port.isdigit():
            socket.create_connection((host, int(port)), PATIENCE).close()
        with warnings.catch_warnings():  # Ray starts its processes by fork and exec
            warnings.filterwarnings("ignore", r"os\.fork", RuntimeWarning)
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR, **options)
    except (OSError, RuntimeError, ValueError, SystemExit) as error:  # SystemExit: Ray gave up
        raise InputError(
            f"ray = {address} cannot be reached as a cluster ({_last_line(error)}): run `ray "
            "start` here and on its other hosts, or choose local."
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _last_line(error: BaseException) -> str:
    """Return the last line of a message, which names the fault, without its full stop."""
    return (str(error).strip().splitlines() or [type(error).__name__])[-1].rstrip(".")


def check_registered(plan: Plan) -> None:
    """Raise InputError for parts of a plan that the package does not register in a worker."""
    domain = plan.domain
    parts = map(type, (*plan.laws.values(), domain.task, plan.setting.simulator))
    custom = [part.__name__ for part in parts if not part.__module__.startswith("rps_jax.")]
    custom += [*dict(domain.custom), *custom_solids(domain.objects)]
    if custom:
        rule = (
            "its workers have only what the package registers; run it in one process or in shards"
        )
        raise errors.not_allowed("ray", f"with {', '.join(custom)}", rule)


def run_on_cluster(
    folder: Path,
    plan: Plan,
    *,
    address: str,
    prepare: Callable[[], object],
    shard: Shard = Shard(),
    callback: ProgressCallback = no_progress,
    slots: int | None = None,
    workers: int | None = None,
) -> None:
    """Run the missing chunks of a plan on a cluster, as `execution.run_missing` does in a process.

    Returned chunks are stored, whatever error ends the run, and `environment.json` names the
    workers. Each task calls `prepare` first, to choose its device and its cache of programs. It has
    `workers` threads, by default one, and claims as many processors, and a GPU if the cluster has
    any and the engine can use one.
    """
    environment = devices.collect_environment() | {"slots": slots}
    missing, finished = execution.missing_chunks(folder, plan, shard)
    if missing:
        provenance.write_environment(folder, environment)
    total = Progress(finished, 0.0)
    callback(total)
    if not missing:
        return
    threads, known = workers or 1, dict[tuple[str, int], JsonObject]()
    with connected(address) as ray:
        gpu = plan.setting.simulator.traced and bool(ray.cluster_resources().get("GPU"))
        count = _count_workers(ray.nodes(), threads, int(gpu))
        # Otherwise the process of a GPU's task would end with the task, and compile again.
        options = {"max_calls": 0, "max_retries": RETRIES, "scheduling_strategy": "SPREAD"}
        task = ray.remote(num_cpus=threads, num_gpus=int(gpu), **options)(_work)
        bare_plan = ray.put(dataclasses.replace(plan))  # without its cached properties
        shared = _software(environment), prepare, slots, threads
        shares = _divide(chunks_by_key(plan, missing).values(), count)
        waiting = [task.remote(bare_plan, chunks, *shared) for chunks in shares]
        try:
            while waiting:
                (ended,), waiting[:] = ray.wait(waiting)
                contents, progress, worker = ray.get(ended)
                for chunk, content in contents.items():
                    store_chunk(folder, chunk, content)
                known[worker["host"], worker["pid"]] = worker
                all_workers = _join_environments(list(known.values()))
                provenance.write_environment(folder, environment | all_workers)
                simulated = total.simulated + progress.simulated
                total = Progress(total.finished + progress.finished, simulated)
                callback(total)
        except ray.exceptions.RayError as error:
            cause = getattr(error, "cause", None)
            if cause is not None and not isinstance(cause, ray.exceptions.RayError):
                raise cause from error
            raise InputError(
                f"ray has failed ({_last_line(error)}): finished chunks are stored; run the same "
                "command again."
            ) from error
        finally:
            for task in waiting:
                ray.cancel(task, force=True)


def _divide(groups: Iterable[Sequence[int]], workers: int) -> Iterator[Sequence[int]]:
    """Divide the chunks of each program into equal shares, one for each task."""
    for chunks in groups:
        size = math.ceil(len(chunks) / (workers * _TASKS))
        yield from (chunks[i : i + size] for i in range(0, len(chunks), size))


def on_cluster(address: str) -> Callable[..., None]:
    """Return a function that runs a plan on the workers of a cluster."""
    import jax

    prepare = functools.partial(_prepare, bool(jax.config.jax_enable_x64))
    return functools.partial(run_on_cluster, address=address, prepare=prepare)


def _prepare(x64: bool) -> None:
    """Configure the process of a worker as this process is configured."""
    import jax

    devices.configure_xla()
    jax.config.update("jax_enable_x64", x64)
    devices.choose("auto")
    cache.use_cache()


def _count_workers(hosts: Sequence[JsonObject], num_cpus: int, num_gpus: int) -> int:
    """Return how many workers with such claims fit on the hosts of a cluster."""
    claims = {"CPU": num_cpus} | ({"GPU": num_gpus} if num_gpus else {})
    resources = [host["Resources"] for host in hosts if host["Alive"]]
    count = sum(int(min(r.get(name, 0) // n for name, n in claims.items())) for r in resources)
    if not count:
        with_gpu = " beside a GPU" if num_gpus else ""
        rule = f"no host of the cluster has so many processors{with_gpu}"
        raise errors.not_allowed("workers", num_cpus, rule)
    return count


def _join_environments(workers: Sequence[JsonObject]) -> JsonObject:
    """Return the environment record of all workers, and their names."""
    processors = {worker["host"]: worker["processors"] for worker in workers}
    names = ("host", "pid", "device")
    return {
        "processors": sum(processors.values()),
        "device": workers[0]["device"] | {"count": len(workers)},
        "workers": [{name: worker[name] for name in names} for worker in workers],
    }


def _software(environment: JsonObject) -> JsonObject:
    """Return the part of the environment on which the bits of results depend."""
    return {name: environment[name] for name in ("packages", "commit", "x64")}
