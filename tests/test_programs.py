"""The cache of traced programs: reuse between processes, verification, eviction."""

import os
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import setting_of
from numpy.testing import assert_array_equal

from rps_jax.control import registry
from rps_jax.control.laws import rps
from rps_jax.engines import device, programs
from rps_jax.record import cache as program_cache
from rps_jax.runs.push import Push
from rps_jax.runs.sweep import Sweep
from rps_jax.trials import batch, pushes, trial
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting


@pytest.fixture
def cache(tmp_path):
    """The folder of traced programs in a temporary cache."""
    previous = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    batch._trace_advance.cache_clear()
    yield tmp_path / "traced"
    jax.config.update("jax_compilation_cache_dir", previous)


@pytest.fixture
def compiler():
    """A function that compiles and runs x + a y for n values, and the list of its tracings."""
    traced = []

    def run(n=3, factor=2.0, static=None, result=lambda x: {"sum": x}):
        def function(x, y):
            traced.append(n)
            return result(x + factor * y)

        shapes = 2 * [jax.ShapeDtypeStruct((n,), jnp.float32)]
        known = [factor] if static is None else [static]
        program = programs.trace_function(function, shapes, law=rps.LAW, donate=0, static=known)(
            None
        )
        (leaf,) = jax.tree.leaves(program(jnp.ones(n), jnp.ones(n)))
        return np.asarray(leaf).tolist()

    return run, traced


def test_a_program_is_traced_once_for_all_processes(cache, compiler):
    run, traced = compiler
    assert run() == run() == [3.0] * 3
    assert len(traced) == 1
    assert run(factor=3.0) == [4.0] * 3
    assert run(n=2) == [3.0] * 2
    assert len(traced) == 3
    assert len(list(cache.iterdir())) == 3


def test_a_recorded_trial_is_traced_once_for_all_processes(cache, monkeypatch):
    """A cached trial returns the same named tuples as a traced one."""
    traced, advance = [], trial.advance
    monkeypatch.setattr(trial, "advance", lambda *a: traced.append(1) or advance(*a))
    setting = setting_of(0.2, "fused")
    worlds = pushes.build([Case("box")], setting)
    first, again = (pushes.record_batch(worlds, setting)[0] for _ in range(2))
    assert len(traced) == 1
    assert jax.tree.structure(first.snapshots) == jax.tree.structure(again.snapshots)
    assert jax.tree.structure(first.outcome) == jax.tree.structure(again.outcome)
    assert_array_equal(first.snapshots.qpos, again.snapshots.qpos)


def test_a_program_with_results_of_unknown_type_is_not_cached(cache, compiler):
    run, traced = compiler
    for _ in range(2):
        assert run(result=lambda x: NamedTuple("Made", [("own", Any)])(x)) == [3.0] * 3
    assert len(traced) == 2
    assert not cache.exists()


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "of another program"])
def test_a_damaged_program_is_dropped_with_one_line(damage, cache, compiler):
    run, traced = compiler
    run()
    (file,) = cache.iterdir()
    content = file.read_bytes()
    run(n=2)
    (other,) = {*cache.iterdir()} - {file}
    contents = {
        "cut": content[:100],
        "empty": b"",
        "of another program": other.read_bytes(),
        "flipped": content[:-1] + bytes([content[-1] ^ 1]),
    }
    file.write_bytes(contents[damage])
    count = len(traced)
    with pytest.warns(UserWarning, match="is dropped, and traced again: it") as warnings:
        assert run() == [3.0] * 3
    assert len(warnings) == 1
    assert len(traced) == count + 1
    assert run() == [3.0] * 3  # the new program is cached
    assert len(traced) == count + 1


def test_programs_with_unidentified_dependencies_are_not_cached(cache, compiler):
    run, traced = compiler
    for static in (object(), np.arange(5000)):
        run(static=static)
        run(static=static)
    assert len(traced) == 4
    assert not cache.exists()


def test_a_cache_keeps_its_folder_when_the_process_changes_directory(cache, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert program_cache.use_cache("programs") == tmp_path / "programs"
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "programs")


def test_every_law_of_the_package_is_identified_by_functions_and_weights():
    laws = {name: registry.law_of(params) for name, params in registry.LAWS.items()}
    identities = {name: programs.identity(law) for name, law in laws.items()}
    assert None not in identities.values()
    assert identities["learned"] != identities["learned_small"]
    assert identities["rps"] == identities["rps_tuned"] != identities["rps_plus"]
    gru = laws["learned"]
    network, weights = gru.step.args
    changed_weights = weights | {"first.b": weights["first.b"] + 1}
    changed = replace(gru, step=partial(gru.step.func, network, changed_weights))
    assert programs.identity(changed) != identities["learned"]
    assert programs.identity(replace(gru, init=lambda params: None)) is None


def test_a_model_of_mjx_is_identified_by_its_values(cache):
    """This includes its static arrays, which JAX identifies by address."""
    setting = Setting("mjx")
    stages = [pushes.build([Case(name)], setting).stage for name in ("box", "box", "cylinder")]
    descriptions = [repr(programs._describe(jax.tree.structure(stage))) for stage in stages]
    assert descriptions[0] == descriptions[1] != descriptions[2]
    assert programs._path_of(descriptions[0]) is not None
    model = stages[0].model
    changed = stages[0]._replace(model=model.replace(geom_bodyid=model.geom_bodyid + 1))
    assert repr(programs._describe(jax.tree.structure(changed))) != descriptions[0]


def test_least_recently_used_programs_are_evicted_first(cache, compiler, monkeypatch):
    run, traced = compiler
    run(n=1)
    size = next(cache.iterdir()).stat().st_size
    monkeypatch.setattr(program_cache, "MAX_BYTES", int(2.5 * size))
    for n in (2, 3, 4):
        run(n=n)
    assert len(list(cache.iterdir())) == 2
    count = len(traced)
    run(n=4)
    assert len(traced) == count
    run(n=1)
    assert len(traced) == count + 1


def test_small_sweeps_run_on_the_cpu(monkeypatch):
    """At most 500 with a C compiler; any number in C MuJoCo."""
    monkeypatch.setattr(device, "find_compiler", lambda: "cc")
    previous = jax.config.jax_platforms
    jax.config.update("jax_platforms", None)
    try:
        sweep = Sweep("rps", worlds=500)
        assert sweep.suits_processors()
        assert Push(setting=Setting("fused")).suits_processors()
        assert not replace(sweep, worlds=501).suits_processors()
        assert not replace(sweep, setting=Setting("mjx")).suits_processors()
        assert replace(sweep, worlds=9000, setting=Setting("mujoco")).suits_processors()
        monkeypatch.setattr(device, "find_compiler", lambda: None)
        assert not sweep.suits_processors()
        jax.config.update("jax_platforms", "cuda")  # asked for by name
        assert not Push().suits_processors()
    finally:
        jax.config.update("jax_platforms", previous)


@pytest.mark.parametrize(
    ("release", "machine", "needs_avx"),
    [
        ("0.11.2", "x86_64", False),
        ("0.12.0.1", "x86_64", True),
        ("0.13.1", "arm64", False),
    ],
)
def test_jax_with_fusion_by_slot_gets_the_avx_flag(release, machine, needs_avx, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_of_ones_own")
    monkeypatch.setattr(device.metadata, "version", lambda _: release)
    monkeypatch.setattr(device.platform, "machine", lambda: machine)
    for _ in range(2):
        device.configure_xla()
        words = os.environ["XLA_FLAGS"].split()
        assert words[:2] == ["--xla_of_ones_own", "--xla_gpu_deterministic_ops=true"]
        assert words[2:] == ["--xla_cpu_max_isa=AVX"] * needs_avx
