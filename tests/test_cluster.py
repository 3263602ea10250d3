"""Sweeps through Ray: whoever runs a part and whoever dies, results are those of one process."""

import json
import os
import random
import signal
import socket
import sys
from dataclasses import replace

import jax
import pytest
from helpers import PLAN, SLOTS, one_sentence, parts_of, rps, swept

from rps_jax.engines.device import use_cache
from rps_jax.errors import InputError
from rps_jax.record import files, provenance
from rps_jax.runs import cluster, sweep
from rps_jax.runs.board import Board
from rps_jax.trials.progress import Bar
from rps_jax.world.domain import from_json

NEAR = {"objects": ["random_cylinder"], "distance": [0.7, 0.8], "bearing": [-0.5, 0.5]}
OF_NEAR = replace(PLAN, domain=from_json(NEAR))
SWEEP = [
    *("sweep", "--fidelity", "fast", "--horizon", 20, "--worlds", 20),
    *("--laws", "rps", "nps", "--part", 7, "--slots", SLOTS),
]


# --- the board -----------------------------------------------------------------------------


def test_every_part_comes_back_once_whoever_dies():
    """Workers ask, deliver and die in random order; the last two live."""
    dice = random.Random(0)
    kinds = [list(range(0, 20)), list(range(20, 27))]
    board, held, returned = Board(kinds, 3), {}, []
    for worker in range(3):
        board.enter(worker, {})
        held[worker] = []
    for turn in range(2000):
        worker = dice.randrange(3)
        mine = held[worker]
        act = dice.random()
        if act < 0.02 and turn < 1000:
            board.enter(worker, {})
            mine.clear()
        elif mine and act < 0.5:
            _, number = mine.pop(dice.randrange(len(mine)))
            board.tell(worker, 10, 1.0)
            board.deliver(worker, number, 10, b"")
        elif mine:
            number = board.next(worker, mine[0][0])
            mine += [] if number is None else [(mine[0][0], number)]
        elif (found := board.first(worker)) is not None:
            mine.append(found)
        assert len(mine) <= 9  # a third
        assert all(number in kinds[kind] for kind, number in mine)
        begun = [number for others in held.values() for _, number in others]
        assert len(set(begun)) == len(begun)
        news = board.news()
        returned += [number for number, _ in news.parts]
        assert news.ended == 10 * len(returned)
    assert sorted(returned) == list(range(27))


def test_trials_that_are_lost_with_a_worker_do_not_count():
    board = Board([[3, 4]], 1)
    board.enter(0, {"pid": 1})
    assert board.first(0) == (0, 3)
    assert board.next(0, 0) == 4
    board.tell(0, 8, 80.0)
    board.deliver(0, 3, 7, b"three")
    assert board.news()[:3] == ([(3, b"three")], 8, 80.0)
    board.enter(0, {"pid": 2})
    assert board.news() == ([], 7, 80.0, {0: {"pid": 2}})
    assert board.first(0) == (0, 4)
    assert board.first(0) is None


def test_workers_begin_with_different_kinds():
    board = Board([[1, 2], [3, 4], [5, 6]], 3)
    for worker in range(3):
        board.enter(worker, {})
    assert [board.first(worker) for worker in range(3)] == [(0, 1), (1, 3), (2, 5)]


def test_room_for_workers_by_hand():
    hosts = [
        {"Alive": True, "Resources": {"CPU": 8.0}},
        {"Alive": True, "Resources": {"CPU": 3.0, "GPU": 4.0}},
        {"Alive": False, "Resources": {"CPU": 8.0, "GPU": 8.0}},
    ]
    assert cluster._room(hosts, 1, 0) == 11
    assert cluster._room(hosts, 3, 0) == 3
    assert cluster._room(hosts, 1, 1) == 3
    with pytest.raises(InputError, match=r"workers = 9 .* so many processors"):
        cluster._room(hosts, 9, 0)


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
def test_without_a_cluster_a_sweep_ends_in_one_sentence(
    wrong, domain, tmp_path, capsys, monkeypatch
):
    nobody = f"127.0.0.1:{closed_port()}"
    address = {"closed": nobody, "missing": "local"}.get(wrong, wrong)
    monkeypatch.setenv("RAY_ADDRESS", nobody)
    if wrong == "missing":
        monkeypatch.setitem(sys.modules, "ray", None)
    out = tmp_path / "run"
    assert rps(*SWEEP, "--domain", domain, "--ray", address, "--out", out) == 2
    error = one_sentence(capsys.readouterr().err.splitlines(keepends=True)[-1])  # after its bar
    message = "pip install 'rps_jax[cluster]'" if wrong == "missing" else f"ray = {address}"
    assert message in error


# --- a cluster of two workers --------------------------------------------------------------


@pytest.fixture(scope="module")
def two_workers():
    """Ray, until the end of the module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_worker_niceness", "0")  # or other tests starve them
        with cluster.connected("local", num_cpus=2, object_store_memory=100 * 2**20) as ray:
            yield ray
        assert not ray.is_initialized()


def opened(folder):
    """A run folder with the plan of `SWEEP` in it, and the plan."""
    return sweep.open_run(folder, OF_NEAR), OF_NEAR


@pytest.mark.slow
def test_a_worker_killed_at_work_changes_nothing(domain, tmp_path, two_workers, monkeypatch):
    """SIGKILL after some of its trials; the parts are those of one process without Ray."""
    out, plan = opened(tmp_path / "run")
    use_cache()
    plain = swept(tmp_path / "plain", plan)
    seen, killed = set(), []

    def killing(bar, progress):
        assert bar._total == plan.trials
        environment = json.loads((out / "environment.json").read_text())
        pids = [worker["pid"] for worker in environment.get("workers", ())]
        seen.update(pids)
        if 0 < progress.finished < plan.trials and not killed:
            killed.append(pids[0])
            os.kill(pids[0], signal.SIGKILL)

    monkeypatch.setattr(Bar, "__call__", killing)
    assert rps(*SWEEP, "--domain", domain, "--out", out, "--ray", "local") == 0
    assert killed
    workers = json.loads((out / "environment.json").read_text())["workers"]
    assert killed[0] in seen - {worker["pid"] for worker in workers}  # another took its place
    assert len(parts_of(plain)) == 6
    assert parts_of(out) == parts_of(plain)
    assert files.read_results(out).success.shape == (2, 20)


def test_what_ends_a_worker_ends_the_run_as_itself(tmp_path, two_workers):
    def prepare():
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory")

    with pytest.raises(RuntimeError, match="RESOURCE_EXHAUSTED: Out of memory"):
        cluster.run_on_cluster(*opened(tmp_path), address="local", prepare=prepare)


def test_a_worker_with_other_software_is_refused(tmp_path, two_workers, monkeypatch):
    here = provenance.environment()
    monkeypatch.setattr(provenance, "environment", lambda: here | {"commit": "another"})
    with pytest.raises(
        InputError, match=r"other software \(commit = .* there, .another. asked for"
    ):
        cluster.run_on_cluster(*opened(tmp_path), address="local", prepare=int)


def test_a_cluster_without_room_for_a_worker_is_refused(tmp_path, two_workers):
    with pytest.raises(InputError, match=r"workers = 3 .* so many processors"):
        cluster.run_on_cluster(*opened(tmp_path), address="local", prepare=int, workers=3)
