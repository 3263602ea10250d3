"""Replays: every way to record a world of a sweep gives the bits of the sweep."""

import dataclasses
import warnings
from functools import partial

import numpy as np
import pytest
from helpers import refusing, rps, setting_of, slow
from numpy.testing import assert_array_equal

import rps_jax
from rps_jax.app import film
from rps_jax.record import files
from rps_jax.runs import push
from rps_jax.runs.plan import build_batch, load_plan
from rps_jax.studies import gallery
from rps_jax.trials.live import Live
from rps_jax.trials.progress import SequentialProgress, no_progress
from rps_jax.world.domain import DOMAINS

WORLDS = 5
SLOTS = 3  # two batches, and a number that only the record of the run has


def sweep(folder, law, domain, task="reach", engine="fused", horizon=4.0):
    options = {"setting": setting_of(horizon, engine), "worlds": WORLDS, "slots": SLOTS}
    return rps_jax.sweep(law, domain, task=task, out=folder, **options)


def assert_equal_bits(outcomes, results):
    """Compare outcomes (n, ...) with results (n, ...) by name."""
    assert {"time", "success", "object_pose", "min_distance"} <= outcomes.keys()
    for name, values in outcomes.items():
        expected = results[name].values
        assert_array_equal(np.asarray(values, expected.dtype), expected, err_msg=name)


def replayed(run, law):
    """Return the outcomes of replays of all worlds, by name."""
    columns = [rps_jax.replay(run, i, law).outcome.columns() for i in range(WORLDS)]
    return {name: np.stack([x[name] for x in columns]) for name in columns[0]}


CASES = {
    "a law in C, in hostile worlds": ("rps_plus", "hostile,objects=random_prism"),
    "an engine outside of JAX": ("rps", "paper,objects=cylinder", "reach", "mujoco", 1.0),
}
HALL = {"outline": [[0, 0], [9, 0], [9, 6], [0, 6]], "start": [1.5, 3, 0], "goal": [7, 3]}
TASKS = {
    "corridor": "corridor,width=2:2.2,length=8:10",
    "rooms": HALL,
}  # with places for the widest object
SLOW_CASES = {
    "a law that XLA compiles, along a path": (
        "learned",
        "wide,objects=random_cylinder",
        "path",
        "fused",
        1.0,
    ),
    "a law that senses force, on a robot with limits in a corridor": (
        "force_push_published",
        "real,objects=random_cylinder",
        TASKS["corridor"],
    ),
    "C MuJoCo": ("rps", "hostile,objects=random_box", "reach", "mujoco", 1.0),
    "MJX": ("rps", "wide,objects=random_box", "reach", "mjx", 1.0),
    "a planar engine": ("rps", "hostile,objects=random_prism", "reach", "quasistatic"),
    **{
        f"{law}, {domain}, {task}": (law, domain, TASKS.get(task, task))
        for law in ("rps", "aps", "learned_small")
        for domain in ("hostile", "real", "paper")
        for task in ("reach", "path", "corridor", "rooms")
    },
}


@pytest.mark.parity  # of a trial in C, and of a law in XLA
@pytest.mark.parametrize(
    "case", [*CASES.values(), *map(slow, SLOW_CASES.values())], ids=[*CASES, *SLOW_CASES]
)
def test_a_replay_has_the_bits_of_its_sweep(case, tmp_path):
    results = sweep(tmp_path, *case)
    with warnings.catch_warnings(action="error"):
        assert_equal_bits(replayed(tmp_path, case[0]), results.sel(law=case[0]))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a sweep whose trials XLA compiles, and its results."""
    folder = tmp_path_factory.mktemp("run")
    rules, objects = rps_jax.Rules(horizon=12.0), ("random_cylinder", "random_box")
    domain = dataclasses.replace(DOMAINS["wide"], objects=objects)
    setting = rps_jax.Setting("quasistatic", rules=rules)
    results = rps_jax.sweep("rps", domain, WORLDS, setting=setting, out=folder, slots=SLOTS)
    return folder, results.sel(law="rps")


def test_the_bits_depend_on_the_stored_number_of_slots(run):
    folder, _ = run
    plan = load_plan(folder)
    counts = {push.program_slots(folder, plan, "rps", i) for i in range(WORLDS)}
    assert counts == {2, SLOTS}  # there are 3 cylinders and 2 boxes


def test_replays_in_a_planar_engine_have_the_bits_of_their_sweep(run):
    folder, results = run
    assert_equal_bits(replayed(folder, "rps"), results)


def test_a_gallery_has_the_bits_of_its_sweep(run):
    folder, results = run
    plan, progress = load_plan(folder), SequentialProgress(no_progress)
    traces = gallery._simulate(folder, plan, "rps", np.arange(WORLDS), progress)
    assert not any(x.attrs["differs"] for x in traces.values())
    for i, trace in traces.items():
        columns = {name: trace[f"outcome_{name}"].values for name in results.data_vars}
        assert_equal_bits(columns, results.sel(world=i))


def test_a_film_has_the_bits_of_its_sweep(run):
    folder, results = run
    plan, outcomes = load_plan(folder), {}
    for take in film.of_sweep(folder, plan, ["rps"], range(WORLDS), (1, WORLDS)):
        take = take._replace(compare=partial(outcomes.__setitem__, tuple(take.tiles)))
        assert any(ended for ended, _ in film._shots(take, plan.setting, 25))
    assert len(outcomes) == 2
    for tiles, ended in outcomes.items():
        assert_equal_bits(ended.columns(), results.isel(world=list(tiles)))


def test_a_viewed_trial_has_the_bits_of_its_sweep(run):
    folder, results = run
    plan = load_plan(folder)
    slots = push.program_slots(folder, plan, "rps", 1)
    live = Live(build_batch(plan, "rps", [1]), plan.setting, slots)
    live.step(100_000)
    assert_equal_bits(live.outcome.columns(), results.sel(world=1))


def test_a_trial_that_ends_otherwise_is_named(run, monkeypatch, tmp_path, capsys):
    folder, _ = run
    read = files.read_results

    def of_another_device(path):
        results = read(path)
        results.time[0, 2] += 1
        return results

    monkeypatch.setattr(files, "read_results", of_another_device)
    with pytest.warns(UserWarning, match="1 of 1 trials end otherwise .*world 2: target not"):
        rps_jax.replay(folder, 2)
    assert rps(f"gallery {folder} --out {tmp_path / 'gallery'}") == 0
    assert "ends otherwise than in the sweep" in (tmp_path / "gallery" / "report.md").read_text()


def test_an_unknown_law_or_world_is_refused(run):
    folder, _ = run
    with refusing("unknown law of the run"):
        rps_jax.replay(folder, 0, "aps")
