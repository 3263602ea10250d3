"""Exported laws compile without a warning, and have the results of JAX."""

import json
import re
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ROOT, refusal, rps

from rps_jax.app.export import c, folder, js, onnx_model, program
from rps_jax.control import registry
from rps_jax.robot import robot as robots
from rps_jax.robot.skin import SKINS
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from sweeps.export.loop import recorded
from sweeps.export.native import (
    COMPILERS,
    SANE,
    Native,
    agreement,
    fuzzed,
    observations,
    trial_errors,
)

EXAMPLE = ROOT / "notebooks/examples/custom_law.py"
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
LAWS = [
    *("rps", "nps", "rps_plus", "aps", "pursuit", "dipole", "force_push", "force_push_published"),
    *("learned_mlp", "learned_gru"),
]
CUSTOM_LAW = '''"""A law that uses all that can be exported beyond arithmetic."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import Details, Law, Twist, register_law


class OwnParams(NamedTuple):
    v: Any = 0.05  # [m/s]
    gains: Any = np.array([[0.5, 1.0, 2.0], [0.1, 0.2, 0.3]])  # [1]
    d_success: float = 0.05  # [m]


class Memory(NamedTuple):
    trace: Any  # (4,) [m]
    count: Any  # () int32


def init(params):
    return Memory(jnp.zeros(4), jnp.zeros((), jnp.int32))


def step(params, memory, seen):
    l = seen.p_robot_contact[1]
    place = memory.count % 3
    gain = params.gains[jnp.int32(seen.in_contact), place]  # row and column known at run time
    other = jnp.take(jnp.array([1.0, 2.0, 3.0]), place + 1, mode="clip")
    trace = jnp.concatenate([memory.trace[1:], l[None]]).at[0].set(memory.trace[3])
    smooth = jax.lax.scan(lambda s, x: (0.5 * s + x, s), 0.0, trace)[0]
    # What is carried changes its places, which a loop must not do one after the other.
    swapped = lambda i, s: (s[1], s[0] + i * l)
    body = lambda i, s: jax.lax.fori_loop(0, 2, swapped, (s[1], 0.5 * s[0]))
    low, high = jax.lax.fori_loop(0, 3, body, (l, smooth))
    trace = trace.at[1:3].add(0.1 * low)
    side = jax.lax.cond(l > 0, lambda: 1.0, lambda: -1.0)
    level = jax.lax.switch(place, [lambda: 0.0, lambda: 1.0, lambda: 4.0])
    turn = jnp.argmax(jnp.abs(trace)) + jnp.cumsum(trace)[2] + jnp.expm1(high) + jnp.sum(trace**3)
    forward = params.v * gain * jnp.round(other) / (1 + level)
    return (
        Memory(trace, memory.count + 1),
        Twist(forward, 0.01 * side * jnp.max(jnp.abs(trace)), 0.1 * jnp.clip(turn, -1, 1)),
        Details.from_obs(seen),
    )


register_law("own", Law(init, step), OwnParams())
'''


@pytest.fixture
def custom_law(tmp_path, registries):
    path = tmp_path / "own.py"
    path.write_text(CUSTOM_LAW)
    return f"{path}:OwnParams"


def compiled(compiler, source, *options):
    binary = source.with_suffix(".run")
    command = [compiler, *STRICT, *options, str(source), "-lm", "-o", str(binary)]
    subprocess.run(command, check=True, capture_output=True, text=True)
    return binary


# --- C -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in LAWS if name not in ("nps", "learned_gru")])
def test_a_law_in_c_agrees_with_jax(name, tmp_path):
    result = agreement(name, "double", 10_000, tmp_path)
    assert (result.inputs, result.unexplained) == (10_000, 0)
    assert result.beyond == result.flips <= 10


def test_a_law_in_c_agrees_with_jax_in_float(tmp_path):
    """Differences beyond the tolerance are only where JAX's own twist is as uncertain."""
    result = agreement("rps_plus", "float", 20_000, tmp_path)
    assert (result.inputs, result.unexplained) == (20_000, 0)
    assert result.beyond < 200


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
def test_a_law_in_c_agrees_with_jax_for_many_inputs(name, tmp_path):
    for precision in ("float", "double"):
        assert agreement(name, precision, 500_000, tmp_path).unexplained == 0


def test_a_fault_in_c_is_detected(tmp_path, monkeypatch):
    """The fault is a constant with another eighth digit."""
    right, header = "params->law_K_v * v", c.header(program.program("rps_plus"), "law")
    assert right in header
    wrong = header.replace(right, f"(law_real)1.0000001 * {right}")
    monkeypatch.setattr(c, "header", lambda *_: wrong)
    assert agreement("rps_plus", "double", 2_000, tmp_path).unexplained > 20


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("name", ["rps_plus", "learned_mlp", f"{EXAMPLE}:PParams"])
def test_the_folder_compiles_without_a_warning_and_runs(name, compiler, tmp_path, registries):
    exported = program.program(name, "kairos")
    texts = folder.files(exported, "law")
    for file, text in texts.items():
        (tmp_path / file).write_text(text)
    (tmp_path / "main.c").write_text(texts["main.c"].replace("STEPS 200000", "STEPS 3000"))
    for options in (["-O2"], ["-O2", "-DLAW_DOUBLE"], SANE):
        run = [str(compiled(compiler, tmp_path / "main.c", *options))]
        output = subprocess.run(run, check=True, capture_output=True, text=True).stdout
        assert re.match(r"3000 steps: median [\d.]+ us, 99.9th percentile [\d.]+ us\n", output)
    assert "#include <math.h>" in texts["law.h"]
    assert texts["law.h"].count("#include") == 1
    assert not re.search(r"\b(malloc|calloc|realloc|alloca)\b", texts["law.h"])


@pytest.mark.parametrize("name", ["rps_plus", "learned_mlp", "force_push_published", "own"])
def test_non_finite_inputs_give_a_zero_twist_without_undefined_behaviour(
    name, tmp_path, custom_law
):
    exported = program.program(custom_law if name == "own" else name)
    for compiler in COMPILERS:
        result = fuzzed(exported, compiler, "float", 20_000, tmp_path)
        assert result.fault == 0, result
        assert result.taken > 0 < result.refused


def test_a_law_of_a_users_file_is_exported(custom_law, tmp_path):
    for precision in ("float", "double"):
        result = agreement(custom_law, precision, 5_000, tmp_path)
        assert (result.inputs, result.unexplained, result.flips) == (5_000, 0, 0)


@pytest.mark.parametrize("robot", ["ridgeback"])
def test_the_skin_in_c_agrees_with_jax(robot, tmp_path):
    native = Native(program.program("rps", robot), tmp_path, "float")
    skin = SKINS["capacitive"]._replace(shell=robots.parse_robot(robot).shell)
    count, rng = skin.shell.count, np.random.default_rng(0)
    state, worlds = skin.init(jax.random.PRNGKey(0)), 400
    alive = rng.random((worlds, count)) > 0.1
    read = jax.jit(jax.vmap(lambda s, a, x, p: skin.read(state._replace(signal=s, alive=a), x, p)))
    mine = native.struct("skin", worlds)
    mine["alive"], signal = alive, np.zeros((worlds, count), np.float32)
    kinds = set()
    for _ in range(30):
        active = rng.random((worlds, count)) < rng.choice([0.0, 0.02, 0.1], (worlds, 1))
        taxels = (active * rng.uniform(0, 2, active.shape)).astype(np.float32)
        period = rng.uniform(0.001, 0.1, worlds).astype(np.float32)
        next_state, reading = read(signal, alive, taxels, period)
        contact, code = native.touch(mine, taxels, period)
        assert not code.any()
        np.testing.assert_allclose(mine["signal"], next_state.signal, rtol=1e-6, atol=1e-6)
        near = (np.abs(np.asarray(next_state.signal) - 0.25) < 1e-5).any(-1)  # of the threshold
        assert near.mean() < 0.05
        same = ~near
        np.testing.assert_array_equal(contact["contact_type"][same], reading.contact_type[same])
        np.testing.assert_array_equal(contact["line"][same], reading.contact_type[same] == 2)
        np.testing.assert_allclose(
            contact["p_robot_contact"][same], reading.p_robot_contact[same], atol=1e-6
        )
        np.testing.assert_allclose(
            contact["signal"], np.where(alive, next_state.signal, 0), atol=1e-6
        )
        kinds |= set(contact["contact_type"].tolist())
        signal, mine["signal"] = np.asarray(next_state.signal), next_state.signal
    assert kinds == {0, 1, 2}


@pytest.mark.parametrize("name", ["rps_plus", pytest.param("learned_gru", marks=pytest.mark.slow)])
def test_a_whole_trial_step_by_step(name, tmp_path):
    """The C law keeps its memory; observations are those of the trial in JAX."""
    case = Case("box", "S1", (-1.0, 0.5), law=name)
    setting = Setting("quasistatic", rules=Rules(horizon=20.0))
    trials = recorded([case], setting)
    assert len(trials[0][0]) > 900
    (errors,) = trial_errors(name, "double", trials, tmp_path).own
    assert errors.max() < 1e-12
    result = trial_errors(name, "float", trials, tmp_path)
    (errors,), (from_memory,) = result.own, result.told
    assert np.quantile(from_memory, 0.999) < 1e-5  # given JAX's memory, all steps agree
    # A step differs where a switch flips in one of the two; it must not last.
    assert np.mean(errors > 2e-5) < 0.01
    assert np.median(errors) < 1e-6


# --- unsupported operations, and the command -----------------------------------------------


def test_an_unsupported_operation_is_named(tmp_path, capsys, registries):
    for operation, code in (
        ("while", "jax.lax.while_loop(lambda x: x < 1, lambda x: x + l * l + 0.1, l)"),
        ("sort", "jnp.sort(seen.p_robot_contact)[0]"),
    ):
        path = tmp_path / f"{operation}.py"
        head, _, rest = CUSTOM_LAW.partition("    place = ")
        rest = rest[rest.index("    return (") :].replace(
            "trace, memory.count", "memory.trace, 0 * memory.count"
        )
        rest = rest.replace(
            "forward, 0.01 * side * jnp.max(jnp.abs(trace)), 0.1 * jnp.clip(turn, -1, 1)",
            f"{code}, l, l",
        )
        path.write_text(head + rest)
        for kind in ("c", "js", "onnx"):
            error = refusal(capsys, "export", kind, "--law", f"{path}:OwnParams", "--out", tmp_path)
            name = {"c": "C", "js": "JavaScript", "onnx": "ONNX"}[kind]
            assert f"operation `{operation}` is not supported by the {name} exporter" in error
    error = refusal(capsys, "export", "c", "--law", "rps", "--skin", "ideal", "--out", tmp_path)
    assert "name one with taxels" in error
    error = refusal(capsys, "export", "c", "--law", "rps", "--prefix", "2 laws", "--out", tmp_path)
    assert "prefix = 2 laws is not allowed" in error


def test_the_command_writes_a_folder_with_the_chosen_parameters(tmp_path, capsys):
    arguments = ["--law", "rps_plus,press=0.37", "--robot", "ridgeback", "--prefix", "mine"]
    assert rps("export", "c", *arguments, "--out", tmp_path / "c") == 0
    assert str(tmp_path / "c" / "mine.h") in capsys.readouterr().out
    names = {path.name for path in (tmp_path / "c").iterdir()}
    assert names == {"mine.h", "main.c"}
    header = (tmp_path / "c" / "mine.h").read_text()
    assert "(mine_real)0.37, /* press */" in header
    assert "#define MINE_TAXELS 51" in header
    assert "mine_real yaw; /* [rad] heading of the robot in the world */" in header


# --- JavaScript and ONNX -------------------------------------------------------------------

NODE = """
import { readFileSync } from "node:fs";
import { params, init, step, skinInit, skinParams, skinStep } from "./law.mjs";
const given = JSON.parse(readFileSync(process.argv[2]));
let memory = init(params);
const twists = given.map((seen) => {
  const result = step(params, memory, seen);
  memory = result.memory;
  return [result.twist.v_x, result.twist.v_y, result.twist.omega, result.code];
});
const odd = step(params, memory, { ...given[0], yaw: NaN });
const felt = skinStep(skinParams, skinInit(), Array(42).fill(0).fill(0.6, 15, 27), 1);
console.log(JSON.stringify({ twists, odd, felt: felt.contact }));
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="Node.js is not there")
@pytest.mark.parametrize("name", ["rps_plus", "learned_mlp", "own"])
def test_javascript_agrees_with_c(name, tmp_path, custom_law):
    exported = program.program(custom_law if name == "own" else name)
    native = Native(exported, tmp_path, "double")
    leaves = observations(exported, np.random.default_rng(0), 300, np.float64)
    obs = native.filled("observation", leaves, 300)
    memory = native.begin(1)
    expected = np.concatenate([native.step(memory, obs[i : i + 1])[0] for i in range(300)])
    names = [field.name for field in exported.groups["observation"]]
    rows = [dict(zip(names, (x[i].tolist() for x in leaves), strict=True)) for i in range(300)]
    (tmp_path / "seen.json").write_text(json.dumps(rows))
    (tmp_path / "law.mjs").write_text(js.module(exported, "law"))
    (tmp_path / "run.mjs").write_text(NODE)
    ran = subprocess.run(
        ["node", "run.mjs", "seen.json"], cwd=tmp_path, check=True, capture_output=True, text=True
    )
    result = json.loads(ran.stdout)
    twists = np.array(result["twists"])
    assert not twists[:, 3].any()
    np.testing.assert_allclose(twists[:, :3], expected, rtol=1e-9, atol=1e-12)
    assert result["odd"]["code"] == 1
    assert result["odd"]["twist"] == {"v_x": 0, "v_y": 0, "omega": 0}
    assert result["felt"]["in_contact"] is True
    np.testing.assert_allclose(result["felt"]["p_robot_contact"], [0.3625, 0], atol=1e-9)


@pytest.mark.parametrize("name", ["rps_plus", "learned_mlp", "aps", "force_push_published"])
def test_onnx_agrees_with_c(name, tmp_path):
    onnx, runtime = pytest.importorskip("onnx"), pytest.importorskip("onnxruntime")
    count, exported = 200, program.program(name)
    model = onnx_model.models(exported, "law", count)["law.onnx"]
    session = runtime.InferenceSession(model, providers=["CPUExecutionProvider"])
    about = {entry.key: entry.value for entry in onnx.load_from_string(model).metadata_props}
    assert json.loads(about["units"])["yaw"] == "[rad] heading of the robot in the world"
    native, rng = Native(exported, tmp_path, "float"), np.random.default_rng(0)
    mine, start = native.begin(count), json.loads(about["memory_at_the_start"])
    types = {entry.name: entry.type for entry in session.get_inputs()}
    dtypes = {"tensor(float)": np.float32, "tensor(bool)": bool, "tensor(int32)": np.int32}
    memory = {
        key: np.broadcast_to(np.array(value, dtypes[types[key]]), (count, *np.shape(value)))
        for key, value in start.items()
    }
    names, fields = [entry.name for entry in session.get_outputs()], exported.groups["observation"]
    differences = []
    for _ in range(20):
        leaves = observations(exported, rng, count, np.float32)
        inputs = dict(zip((entry.name for entry in fields), leaves, strict=True))
        known = {key: value for key, value in (inputs | memory).items() if key in types}
        result = dict(zip(names, session.run(None, known), strict=True))
        twist, _ = native.step(mine, native.filled("observation", leaves, count))
        theirs = np.stack([result[key] for key in ("v_x", "v_y", "omega")], -1)
        differences.append(np.abs(theirs - twist).max(-1))
        memory = {key: result[f"next_{key}"] for key in memory}
    differences = np.concatenate(differences)
    assert np.mean(differences > 1e-5) < 0.02  # where a switch flips, and in later steps
    assert np.median(differences) < 1e-7


def test_the_command_names_missing_packages_of_onnx(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    error = refusal(capsys, "export", "onnx", "--law", "rps", "--out", tmp_path)
    assert "pip install 'rps_jax[export]'" in error


def test_a_law_that_is_exported_is_not_rounded_on_the_way():
    """Constants are those of float64, whatever JAX computes in elsewhere."""
    assert jnp.zeros(()).dtype == jnp.float32
    header = c.header(program.program(registry.LAWS["rps"]), "law")
    assert "6.283185307179586" in header
    assert jnp.zeros(()).dtype == jnp.float32
