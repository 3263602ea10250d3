"""Exported laws compile without a warning, and have the results of JAX."""

import json
import re
import shutil
import subprocess

import jax
import numpy as np
import pytest
from helpers import (
    ROOT,
    diagonal,
    output_of,
    refusal,
    rps,
    setting_of,
    slow,
)
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax.app.export import c, folder, js, onnx_model, program
from rps_jax.robot import robot as robots
from rps_jax.robot.skin import SKINS
from rps_jax.trials.case import Case
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
CUSTOM = f"{EXAMPLE}:PParams"
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
LAWS = [
    "rps",
    "nps",
    "rps_plus",
    "aps",
    "pursuit",
    "dipole",
    "force_push",
    "force_push_published",
    "learned_small",
    "learned",
    "unicycle",
    "pose",
]
# Law and robot, one that cannot move sideways.
DRIVEN = "unicycle_car ideal,drive=car,turning_radius=0.5,axle=0.3"


def compiled(compiler, source, *options):
    binary = source.with_suffix(".run")
    output_of(compiler, *STRICT, *options, source, "-lm", "-o", binary)
    return binary


# --- C -------------------------------------------------------------------------------------


QUICK = ("rps_plus", "force_push_published", "learned_small")


@pytest.mark.parametrize(
    "name", [x if x in QUICK else slow(x) for x in LAWS if x not in ("nps", "learned")]
)
def test_a_law_in_c_agrees_with_jax(name, tmp_path):
    result = agreement(name, "double", 10_000, tmp_path)
    assert (result.inputs, result.unexplained) == (10_000, 0)
    assert result.beyond == result.flips <= 10
    if name == "rps_plus":  # in float, where JAX's own twist is as uncertain
        result = agreement(name, "float", 20_000, tmp_path)
        assert (result.inputs, result.unexplained) == (20_000, 0)
        assert result.beyond < 200


@pytest.mark.parametrize("words", ["unicycle_round round", "pose_narrow turtlebot4"])
def test_a_law_of_a_round_or_narrow_base_agrees_with_jax(words, tmp_path):
    law, robot = words.split()
    assert agreement(law, "double", 1000, tmp_path, robot=robot).unexplained == 0


def test_a_law_of_a_base_with_an_axle_agrees_with_jax(tmp_path):
    law, robot = DRIVEN.split()
    for form, most in (("double", 10), ("onnx", 200)):
        result = agreement(law, form, 10_000, tmp_path, robot=robot)
        assert (result.inputs, result.unexplained) == (10_000, 0)
        assert result.beyond < most


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


@pytest.mark.parametrize(
    ("name", "compiler"),
    [
        *(("rps_plus", c) for c in COMPILERS),
        *(slow(x, c) for x in ("learned_small", "pose", CUSTOM) for c in COMPILERS),
    ],
)
def test_the_folder_compiles_without_a_warning_and_runs(name, compiler, tmp_path, registries):
    exported = program.program(name, "kairos")
    texts = folder.files(exported, "law")
    for file, text in texts.items():
        (tmp_path / file).write_text(text)
    (tmp_path / "main.c").write_text(texts["main.c"].replace("STEPS 200000", "STEPS 3000"))
    for options in (["-O2"], ["-O2", "-DLAW_DOUBLE"], SANE):
        output = output_of(compiled(compiler, tmp_path / "main.c", *options))
        assert re.match(r"3000 steps: median [\d.]+ us, 99.9th percentile [\d.]+ us\n", output)
    assert "#include <math.h>" in texts["law.h"]
    assert texts["law.h"].count("#include") == 1
    assert not re.search(r"\b(malloc|calloc|realloc|alloca)\b", texts["law.h"])


FAST = ["-ffast-math", "-Ofast", "-ffinite-math-only"]


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("flag", FAST)
def test_a_compiler_that_assumes_finite_numbers_is_refused(flag, compiler, tmp_path):
    (tmp_path / "law.h").write_text(c.header(program.program("rps"), "law"))
    (tmp_path / "main.c").write_text('#include "law.h"\nint main(void) { return 0; }\n')
    command = [compiler, "-std=c99", "-fsyntax-only", tmp_path / "main.c"]
    output_of(*command)
    refused = subprocess.run([*command, flag], capture_output=True, text=True, check=False)
    assert refused.returncode != 0
    assert "#error" in refused.stderr
    assert "the law stops at NaN" in refused.stderr


@pytest.mark.parametrize("flag", FAST)
def test_the_stop_at_nan_reads_the_bits_of_numbers(flag, tmp_path):
    """Even with a flag that lets compilers take `x != x` for false, if its refusal is cut out."""
    text = c.header(program.program("rps"), "law").replace("#error", "#warning")
    (tmp_path / "law.h").write_text(text)
    (tmp_path / "main.c").write_text(NAN_STOP)
    for real in ("-DLAW_DOUBLE", "-ULAW_DOUBLE"):
        binary = tmp_path / "stop"
        options = ["-std=gnu99", "-O2", flag, real]
        output_of("gcc", *options, tmp_path / "main.c", "-lm", "-o", binary)
        assert output_of(binary, "nan", "inf").split() == ["1", "1", "0"]


NAN_STOP = """
#include <stdio.h>
#include <stdlib.h>
#include "law.h"

int main(int count, char **words) {
  const law_params params = LAW_PARAMS;
  for (int i = 1; i <= count; i++) {
    law_memory memory;
    law_observation seen = {0};
    law_twist twist;
    law_init(&params, &memory);
    seen.period = (law_real)0.01;
    seen.p_world_target[0] = 1;
    if (i < count) seen.yaw = (law_real)strtod(words[i], 0);
    printf("%d ", law_step(&params, &memory, &seen, &twist));
  }
  return 0;
}
"""


@pytest.mark.parametrize("name", ["learned", "rps_plus", "force_push_published", CUSTOM])
def test_no_number_of_the_header_is_converted_without_a_cast(name, tmp_path, registries):
    text = c.header(program.program(name, "kairos"), "law")
    (tmp_path / "law.h").write_text(text)
    (tmp_path / "main.c").write_text('#include "law.h"\nint main(void) { return 0; }\n')
    for real in ("-DLAW_DOUBLE", "-ULAW_DOUBLE"):
        strict = [*STRICT, "-Wconversion", "-Wdouble-promotion", real]
        output_of("gcc", *strict, "-fsyntax-only", tmp_path / "main.c")


@pytest.mark.parametrize("name", [slow("learned"), "rps_plus"])
def test_the_header_and_the_page_state_the_stack(name, tmp_path):
    exported = program.program(name, "kairos")
    for file, text in folder.files(exported, "law").items():
        (tmp_path / file).write_text(text)
    stated = re.search(r"about (\d+) kB of stack", (tmp_path / "law.h").read_text())
    options = ["-std=c99", "-O2", "-fno-inline", "-fstack-usage", "-c"]
    output_of("gcc", *options, "main.c", "-o", "main.o", cwd=tmp_path)
    usage = (tmp_path / "main.su").read_text()
    measured = max(map(int, re.findall(r"law_(?:skin_)?step\S*\s+(\d+)", usage)))  # [B]
    assert 0.9 < 1000 * int(stated[1]) / measured < 2
    page = re.search(rf"`{name}`(?: needs)? ([\d.]+) kB", (ROOT / "docs/on_a_robot.md").read_text())
    assert float(page[1]) == pytest.approx(measured / 1000, rel=0.15)


@pytest.mark.parametrize(
    ("name", "compiler"),
    diagonal(("rps_plus", "learned_small", "force_push_published", CUSTOM), COMPILERS),
)
def test_non_finite_inputs_give_a_zero_twist(name, compiler, tmp_path, registries):
    result = fuzzed(program.program(name), compiler, "float", 20_000, tmp_path)
    assert result.fault == 0, result
    assert result.taken > 0 < result.refused


def test_a_law_of_a_users_file_is_exported(tmp_path, registries):
    for precision in ("float", "double"):
        result = agreement(CUSTOM, precision, 5_000, tmp_path)
        assert (result.inputs, result.unexplained, result.flips) == (5_000, 0, 0)


def test_the_skin_in_c_agrees_with_jax(tmp_path):
    native = Native(program.program("rps", "ridgeback"), tmp_path, "float")
    skin = SKINS["capacitive"]._replace(shell=robots.parse_robot("ridgeback").shell)
    count, rng = skin.shell.count, default_rng(0)
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
        signal = np.asarray(next_state.signal)
        assert_allclose(mine["signal"], signal, rtol=1e-6, atol=1e-6)
        near = (np.abs(signal - 0.25) < 1e-5).any(-1)  # of the threshold
        assert near.mean() < 0.05
        ours, theirs = contact[~near], jax.tree.map(lambda leaf, near=near: leaf[~near], reading)
        assert_array_equal(ours["contact_type"], theirs.contact_type)
        assert_array_equal(ours["line"], theirs.contact_type == 2)
        assert_allclose(ours["p_robot_contact"], theirs.p_robot_contact, atol=1e-6)
        assert_allclose(contact["signal"], np.where(alive, signal, 0), atol=1e-6)
        kinds |= set(contact["contact_type"].tolist())
        mine["signal"] = signal
    assert kinds == {0, 1, 2}


@pytest.mark.parametrize(
    ("name", "tolerance"),
    [("rps_plus", 2e-5), slow("learned", 4e-4)],
)
def test_a_whole_trial_step_by_step(name, tolerance, tmp_path):
    """The C law keeps its memory; observations are those of the trial in JAX.

    The memory of a network amplifies the rounding of floats.
    """
    case = Case("box", "S1", (-1.0, 0.5), law=name)
    setting = setting_of(12.0, "mujoco")
    trials = recorded([case], setting)
    assert len(trials[0][0]) > 500
    (errors,) = trial_errors(name, "double", trials, tmp_path).free
    assert errors.max() < 1e-12
    result = trial_errors(name, "float", trials, tmp_path)
    (errors,), (from_memory,) = result.free, result.synchronised
    assert np.quantile(from_memory, 0.999) < 1e-5  # given JAX's memory, all steps agree
    # A step differs where a switch flips in one of the two; it must not last.
    assert np.mean(errors > tolerance) < 0.01
    assert np.median(errors) < tolerance / 20


# --- unsupported operations, and the command -----------------------------------------------


WHILE = "jax.lax.while_loop(lambda x: x < 1, lambda x: x + 0.1, y)"


@pytest.mark.parametrize(
    ("operation", "code"), [("while", WHILE), ("lgamma", "jax.lax.lgamma(obs.p_robot_contact)[0]")]
)
def test_an_unsupported_operation_is_named(operation, code, tmp_path, capsys, registries):
    law = tmp_path / "law.py"
    text = EXAMPLE.read_text().replace("import jax", "import jax\nimport jax", 1)
    law.write_text(text.replace("jnp.arctan2(y, x)", code))
    for kind in ("c", "js", "onnx"):
        error = refusal(capsys, f"export {kind} --law {law}:PParams --out", tmp_path)
        assert f"operation `{operation}` cannot be translated" in error


def test_the_command_writes_a_folder_with_the_chosen_parameters(tmp_path, capsys):
    out = tmp_path / "c"
    options = "--law rps_plus,press=0.37 --robot ridgeback --prefix mine"
    assert rps(f"export c {options} --out", out) == 0
    assert str(out / "mine.h") in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {"mine.h", "main.c"}
    (out / "main.c").write_text("edited")
    with pytest.warns(UserWarning, match="main.c is kept"):
        assert rps(f"export c {options} --out", out) == 0
    assert (out / "main.c").read_text() == "edited"
    header = (out / "mine.h").read_text()
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
const short = [Array(41).fill(0), Array(42).fill(null)].map(
  (taxels) => skinStep(skinParams, skinInit(), taxels, 1).code,
);
console.log(JSON.stringify({ twists, odd, short, felt: felt.contact }));
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="Node.js is not there")
@pytest.mark.parametrize("name", ["rps_plus", slow("learned_small"), DRIVEN, CUSTOM])
def test_javascript_agrees_with_c(name, tmp_path, registries):
    exported = program.program(*name.split())
    native = Native(exported, tmp_path, "double")
    leaves = observations(exported, default_rng(0), 300, np.float64)
    obs = native.filled("observation", leaves, 300)
    memory = native.begin(1)
    expected = np.concatenate([native.step(memory, obs[i : i + 1])[0] for i in range(300)])
    names = [field.name for field in exported.groups["observation"]]
    rows = [dict(zip(names, (x[i].tolist() for x in leaves), strict=True)) for i in range(300)]
    (tmp_path / "seen.json").write_text(json.dumps(rows))
    (tmp_path / "law.mjs").write_text(module := js.module(exported, "law"))
    assert ("export const AXLE = 0.3;" in module) == (name == DRIVEN)
    (tmp_path / "run.mjs").write_text(NODE)
    result = json.loads(output_of("node", "run.mjs", "seen.json", cwd=tmp_path))
    twists = np.array(result["twists"])
    assert not twists[:, 3].any()
    assert_allclose(twists[:, :3], expected, rtol=1e-9, atol=1e-12)
    assert result["odd"]["code"] == 1
    assert result["odd"]["twist"] == {"v_x": 0, "v_y": 0, "omega": 0}
    assert result["short"] == [2, 1]  # too few taxels; null, as JSON has a number that is not one
    assert result["felt"]["in_contact"] is True
    assert_allclose(result["felt"]["p_robot_contact"], [0.3625, 0], atol=1e-9)


@pytest.mark.parametrize(
    "name", ["rps_plus", "learned_small", "aps", "force_push_published", DRIVEN]
)
def test_onnx_agrees_with_c(name, tmp_path):
    onnx, runtime = pytest.importorskip("onnx"), pytest.importorskip("onnxruntime")
    count, exported = 200, program.program(*name.split())
    model = onnx_model.models(exported, "law", count)["law.onnx"]
    session = runtime.InferenceSession(model, providers=["CPUExecutionProvider"])
    about = {entry.key: entry.value for entry in onnx.load_from_string(model).metadata_props}
    assert json.loads(about["units"])["yaw"] == "[rad] heading of the robot in the world"
    native, rng = Native(exported, tmp_path, "float"), default_rng(0)
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
