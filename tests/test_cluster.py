"""Sweeps on Ray: results equal those of one process, even if workers die."""

import json
import os
import signal
import socket
import sys
from dataclasses import replace

import jax
import pytest
from helpers import (
    PLAN,
    ROOT,
    SLOTS,
    one_sentence,
    parts_of,
    refusing,
    rps,
    swept,
)

from rps_jax import Quantity, register_quantity, sweep
from rps_jax.engines import device
from rps_jax.record import files
from rps_jax.record.cache import use_cache
from rps_jax.runs import cluster
from rps_jax.runs.plan import open_run
from rps_jax.trials.progress import Bar
from rps_jax.world.domain import from_json

NEAR = {"objects": ["random_cylinder"], "distance": [0.7, 0.8], "bearing": [-0.5, 0.5]}
OF_NEAR = replace(PLAN, domain=from_json(NEAR))
SWEEP = "sweep --fidelity fast --horizon 20 --worlds 20 --laws rps nps --part 7"
SWEEP += f" --slots {SLOTS} --domain"


# --- by hand -------------------------------------------------------------------------------


def test_a_task_has_parts_of_one_family_and_each_part_has_one_task():
    kinds = [list(range(0, 20)), list(range(20, 27))]
    tasks = list(cluster._divide(kinds, 3))
    assert [index for task in tasks for index in task] == list(range(27))
    assert all(set(task) <= set(kinds[0]) or set(task) <= set(kinds[1]) for task in tasks)
    assert len(tasks) == 10 + 7  # four of each worker and kind, at most


def test_room_for_workers_by_hand():
    hosts = [
        {"Alive": True, "Resources": {"CPU": 8.0}},
        {"Alive": True, "Resources": {"CPU": 3.0, "GPU": 4.0}},
        {"Alive": False, "Resources": {"CPU": 8.0, "GPU": 8.0}},
    ]
    assert cluster._count_workers(hosts, 1, 0) == 11
    assert cluster._count_workers(hosts, 3, 0) == 3
    assert cluster._count_workers(hosts, 1, 1) == 3
    with refusing(r"workers = 9 .* so many processors"):
        cluster._count_workers(hosts, 9, 0)


# --- without a cluster ---------------------------------------------------------------------


@pytest.fixture
def domain(tmp_path):
    (tmp_path / "near.json").write_text(json.dumps(NEAR))
    return tmp_path / "near.json"


def closed_port():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


@pytest.mark.parametrize("wrong", ["closed", "auto", "what", "missing"])
def test_without_a_cluster_a_sweep_is_refused(wrong, domain, tmp_path, capsys, monkeypatch):
    nobody = f"127.0.0.1:{closed_port()}"
    address = {"closed": nobody, "missing": "local"}.get(wrong, wrong)
    monkeypatch.setenv("RAY_ADDRESS", nobody)
    if wrong == "missing":
        monkeypatch.setitem(sys.modules, "ray", None)
    assert rps(f"{SWEEP} {domain} --ray {address} --out", tmp_path / "run") == 2
    error = one_sentence(capsys.readouterr().err.splitlines(keepends=True)[-1])  # after its bar
    message = "pip install 'rps_jax[cluster]'" if wrong == "missing" else f"ray = {address}"
    assert message in error


def test_what_only_this_process_registers_is_refused(registries):
    register_quantity("threshold", Quantity("1", "threshold", ge=0, le=1, owner="skin"))
    law = f"{ROOT / 'notebooks/examples/custom_law.py'}:PParams"
    for laws, name in {law: "PParams", "rps": "threshold"}.items():
        with refusing(f"ray = with {name}"):
            sweep(laws, "wide,threshold=0.2:1", ray="local", out="run")
        with refusing("ray = with .*box.xml"):
            sweep(laws, f"wide,objects={ROOT / 'mjcf/box.xml'}", ray="local", out="run")


# --- a cluster of two workers --------------------------------------------------------------


@pytest.fixture(scope="module")
def two_workers():
    """Two workers of a local Ray cluster."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_worker_niceness", "0")  # or other tests starve them
        with cluster.connected("local", num_cpus=2, object_store_memory=100 * 2**20) as ray:
            yield ray
        assert not ray.is_initialized()


@pytest.fixture
def opened(tmp_path):
    """A run folder with the plan of `SWEEP` in it, and the plan."""
    return open_run(tmp_path / "run", OF_NEAR), OF_NEAR


@pytest.mark.slow
def test_killing_a_worker_changes_nothing(domain, opened, tmp_path, two_workers, monkeypatch):
    """SIGKILL after one of its tasks; the parts are those of one process without Ray."""
    out, plan = opened
    use_cache()
    plain = swept(tmp_path / "plain", plan)
    killed = []

    def workers():
        environment = json.loads((out / "environment.json").read_text())
        return [worker["pid"] for worker in environment.get("workers", ())]

    def killing(bar, progress):
        assert bar._total == plan.num_trials
        if 0 < progress.finished < plan.num_trials and not killed:
            killed.append(workers()[0])
            os.kill(killed[0], signal.SIGKILL)

    monkeypatch.setattr(Bar, "__call__", killing)
    assert rps(f"{SWEEP} {domain} --ray local --out", out) == 0
    assert killed
    assert set(workers()) - set(killed)  # another worker continued
    assert len(parts_of(plain)) == 6
    assert parts_of(out) == parts_of(plain)
    assert files.read_results(out).success.shape == (2, 20)


def test_an_error_of_a_worker_ends_the_run_unchanged(opened, two_workers):
    def prepare():
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory")

    with pytest.raises(RuntimeError, match="RESOURCE_EXHAUSTED: Out of memory"):
        cluster.run_on_cluster(*opened, address="local", prepare=prepare)


def test_workers_with_other_software_or_without_room_are_refused(opened, two_workers, monkeypatch):
    with refusing(r"workers = 3 .* so many processors"):
        cluster.run_on_cluster(*opened, address="local", prepare=int, workers=3)
    environment = device.collect_environment() | {"commit": "another"}
    monkeypatch.setattr(device, "collect_environment", lambda: environment)
    message = r"other software \(commit = .* there, .another. asked for"
    with refusing(message):
        cluster.run_on_cluster(*opened, address="local", prepare=int)
