"""Comparison of laws in C and ONNX with JAX: random inputs, whole trials, odd inputs and times.

Each random input is an observation with the state of the law in JAX, so a flipped switch does not
affect later inputs. Errors are relative to the greatest speed and turning rate of a law. Where an
error exceeds the tolerance, the inputs are changed by a few roundings: the twist in JAX changes as
much near a switch (a flip) or where the law is ill-conditioned. JAX in float32 is also compared
with float64, because XLA's float32 functions have rounding errors. An error that none of these
explains is a defect, and there must be none.
"""

from __future__ import annotations

import ctypes
import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import Law, Robot, Twist
from rps_jax.app.export import folder, onnx_model, program
from rps_jax.control import validation
from rps_jax.laws import law_of, resolve_law

Precision = Literal["float", "double"]
Result = tuple[np.ndarray, np.ndarray]  # twists (n, 3) and memories (n,) of steps
Form = Literal["float", "double", "onnx"]  # C in either precision, or ONNX in float
REAL: dict[str, Any] = {"float": np.float32, "double": np.float64, "onnx": np.float32}
TOLERANCE = {"float": 1e-6, "double": 1e-12, "onnx": 1e-6}
STRICT = ("-Wall", "-Wextra", "-Werror", "-pedantic")
STEPS = 100  # number of steps of each world
JUMP = 1e-3  # [1] larger differences are flips

DRIVER = """
#include "law.h"
void begin(int n, const law_params *params, law_memory *memory) {
  for (int i = 0; i < n; i++) law_init(params, memory + i);
}
void steps(int n, const law_params *params, law_memory *memory, const law_observation *obs,
           law_twist *twist, int *code) {
  for (int i = 0; i < n; i++) code[i] = law_step(params, memory + i, obs + i, twist + i);
}
void touches(int n, law_skin *skin, const law_real *taxels, const law_real *period,
             law_contact *contact, int *code) {
  const law_skin_params params = LAW_SKIN_PARAMS;
  for (int i = 0; i < n; i++)
    code[i] = law_skin_step(&params, skin + i, taxels + i * LAW_TAXELS, period[i], contact + i);
}
"""


def compiled(compiler: str, source: Path, precision: Precision, *flags: str) -> Path:
    """Compile a C file next to it, and return the binary."""
    binary = source.with_suffix(".so")
    double = ["-DLAW_DOUBLE"] if precision == "double" else []
    words = [compiler, "-std=c99", *flags, *double, str(source), "-lm", "-o", str(binary)]
    subprocess.run(words, check=True)
    return binary


class Structs:
    """Arrays of the input and output structs of a law."""

    def __init__(self, exported: Any, form: Form):
        """Create the types of a program's groups."""
        self.program, self.real = exported, REAL[form]
        self.dtypes = {name: self._dtype(group) for name, group in exported.groups.items()}

    def _dtype(self, group: Sequence[Any]) -> np.dtype:
        kinds = {"f": self.real, "i": np.int32, "b": np.int32}
        fields: list[Any] = [
            (field.name, kinds[field.kind], field.shape) for field in group if field.size
        ]
        return np.dtype(fields or [("nothing", np.int8)], align=True)

    def struct(self, group: str, count: int) -> np.ndarray:
        """Return `count` zeroed structs of a group."""
        return np.zeros(count, self.dtypes[group])

    def filled(self, group: str, leaves: Any, count: int) -> np.ndarray:
        """Return structs of a group from a pytree of arrays (count, ...)."""
        structs = self.struct(group, count)
        for field, leaf in zip(self.program.groups[group], jax.tree.leaves(leaves), strict=True):
            if field.size:
                structs[field.name] = leaf
        return structs


class Native(Structs):
    """A law in C, compiled and loaded."""

    def __init__(self, exported: Any, path: Path, precision: Precision, compiler: str = "gcc"):
        """Compile the law in a folder."""
        super().__init__(exported, precision)
        folder = Path(tempfile.mkdtemp(dir=path))  # a library is loaded once from one path
        (folder / "law.h").write_text(header(exported))
        driver = folder / "driver.c"
        driver.write_text(DRIVER)
        library = compiled(compiler, driver, precision, "-O2", *STRICT, "-fPIC", "-shared")
        self._library = ctypes.CDLL(str(library))
        self.params = self.struct("params", 1)
        for field in exported.groups["params"]:
            self.params[field.name] = field.value

    def begin(self, count: int) -> np.ndarray:
        """Return the memories before the first step."""
        memory = self.struct("memory", count)
        self._call("begin", count, self.params, memory)
        return memory

    def step(self, memory: np.ndarray, obs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return twists (n, 3) and codes (n,), and update the memory in place."""
        twist, code = self.struct("twist", len(obs)), np.zeros(len(obs), np.int32)
        self._call("steps", len(obs), self.params, memory, obs, twist, code)
        return np.stack([twist[name] for name in ("v_x", "v_y", "omega")], -1), code

    def touch(
        self, skin: np.ndarray, taxels: np.ndarray, period: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return contacts and codes (n,), and update the skin in place."""
        contact, code = self.struct("contact", len(skin)), np.zeros(len(skin), np.int32)
        inputs = (np.ascontiguousarray(x, self.real) for x in (taxels, period))
        self._call("touches", len(skin), skin, *inputs, contact, code)
        return contact, code

    def _call(self, name: str, count: int, *arrays: np.ndarray) -> None:
        pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in arrays]
        getattr(self._library, name)(ctypes.c_int(count), *pointers)


class Onnx(Structs):
    """A law as an ONNX model for a number of worlds, in a session of the runtime."""

    def __init__(self, exported: Any, count: int):
        """Write the model and load it."""
        import onnx
        import onnxruntime

        super().__init__(exported, "onnx")
        model = onnx_model.models(exported, "law", count)["law.onnx"]
        assert isinstance(model, bytes)
        self.session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
        metadata = onnx.load_from_string(model).metadata_props
        self.about = {entry.key: entry.value for entry in metadata}
        types = {"tensor(float)": np.float32, "tensor(bool)": np.bool_, "tensor(int32)": np.int32}
        self._types = {entry.name: types[entry.type] for entry in self.session.get_inputs()}
        self._names = [entry.name for entry in self.session.get_outputs()]

    def begin(self, count: int) -> np.ndarray:
        """Return the memories before the first step."""
        memory = self.struct("memory", count)
        for name, value in json.loads(self.about["memory_at_the_start"]).items():
            memory[name.removeprefix("memory_")] = np.array(value)
        return memory

    def step(self, memory: np.ndarray, obs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return twists (n, 3) and codes (n,), all 0, and update the memory in place."""
        values = {f"memory_{name}": memory[name] for name in memory.dtype.names or ()}
        values |= {name: obs[name] for name in obs.dtype.names or ()}
        inputs = {k: np.ascontiguousarray(values[k], kind) for k, kind in self._types.items()}
        outputs = dict(zip(self._names, self.session.run(None, inputs), strict=True))
        for name in memory.dtype.names or ():
            if (next_name := f"next_memory_{name}") in outputs:
                memory[name] = outputs[next_name]
        twist = np.stack([np.asarray(outputs[name]) for name in ("v_x", "v_y", "omega")], -1)
        return twist, np.zeros(len(obs), np.int32)


def header(exported: Any) -> str:
    """Return the header of a law in C."""
    return folder.files(exported, "law")["law.h"]


def build_law(form: Form, exported: Any, path: Path, count: int) -> Native | Onnx:
    """Return a law in C, or in ONNX for `count` worlds."""
    return Onnx(exported, count) if form == "onnx" else Native(exported, path, form)


def observations(exported: Any, rng: np.random.Generator, count: int, real: Any) -> Any:
    """Return random observations (count, ...) of a law."""

    def draw(name: str, shape: tuple[int, ...]) -> np.ndarray:
        size = (count, *shape)
        spread = {"yaw": 4.0, "f_robot": 60.0, "p_robot_contact": 0.4}.get(name, 3.0)
        values = rng.uniform(-spread, spread, size)
        if name == "p_world_target":  # near in some worlds
            values *= rng.choice([0.05, 0.3, 1.0], (count, 1))
        if name == "period":
            values = np.full(size, 0.02)
        if name == "r_object":
            values = rng.uniform(0.1, 0.5, size)
        if name == "signal":
            values = np.where(rng.random(size) < 0.2, rng.uniform(0, 2, size), 0.0)
        return values.astype(real)

    return [
        rng.random((count, *field.shape)) < (0.85 if field.name == "in_contact" else 0.5)
        if field.kind == "b"
        else draw(field.name, field.shape)
        for field in exported.groups["observation"]
    ]


class Agreement(NamedTuple):
    """Numbers of inputs by their difference between C or ONNX and JAX."""

    law: str
    form: str
    inputs: int = 0
    greatest: float = 0.0  # error
    beyond: int = 0  # error exceeds the tolerance; the next three divide these
    flips: int = 0  # a switch flips, as in JAX after a few roundings
    ill: int = 0  # JAX has or gets such an error by a few roundings
    unexplained: int = 0
    off: int = 0  # float32 differs from float64 by more than the tolerance
    off_in_jax: int = 0  # JAX in float32 does


def agreement(
    name: str, form: Form, inputs: int, path: Path, seed: int = 0, robot: str = "ideal"
) -> Agreement:
    """Compare a law's twist and memory in C or ONNX and in JAX."""
    label, params = resolve_law(name)
    exported, base = program.program(name, robot), Robot.parse(robot)

    def step(params: Any, memory: Any, obs: Any) -> Any:
        touch = getattr(obs, "touch", obs).with_base(base.radius, base)
        obs = obs._replace(touch=touch) if hasattr(obs, "touch") else touch
        return law_of(params).step(params, memory, obs)

    law = replace(law_of(params), step=step)
    worlds, real = max(1, min(inputs // STEPS, 5000)), REAL[form]
    native = build_law(form, exported, path, worlds)
    with jax.enable_x64(form == "double"):
        params = jax.tree.map(lambda x: jnp.asarray(x, real), params)
        step, initial = _in_jax(law, params, real, worlds)
        step, exact = jax.jit(step), None if form == "double" else _exact(law, params)
        rng, tally, scale = np.random.default_rng(seed), Agreement(label, form), scale_of(params)
        while tally.inputs < inputs:
            memory = initial
            for _ in range(STEPS):
                leaves = observations(exported, rng, worlds, real)
                next_memory, twist = jax.device_get(step(memory, leaves))
                native_memory = native.filled("memory", memory, worlds)
                native_twist, code = native.step(
                    native_memory, native.filled("observation", leaves, worlds)
                )
                if code.any():
                    raise AssertionError(f"{name}: codes {np.unique(code)}")
                result = _result(native, next_memory, twist)
                error = _difference((native_twist, native_memory), result, scale)
                spread = np.zeros(worlds)
                if exact is not None:
                    exact_twist = exact(memory, leaves)
                    spread = (np.abs(exact_twist - result[0]) / scale).max(-1)
                    off = (np.abs(exact_twist - native_twist) / scale).max(-1) > TOLERANCE[form]
                    tally = tally._replace(
                        off=tally.off + int(off.sum()),
                        off_in_jax=tally.off_in_jax + int((spread > TOLERANCE[form]).sum()),
                    )

                def moved(inputs: Any = (memory, leaves), result: Result = result) -> np.ndarray:
                    """Return the change of JAX's result after a rounding of its inputs."""
                    rounded = jax.tree.map(partial(_rounded, rng), inputs)
                    return _difference(result, _result(native, *step(*rounded)), scale)

                tally = _classify(tally, error, spread, moved)
                memory = next_memory
    return tally


def _result(structs: Structs, memory: Any, twist: Any) -> Result:
    """Return twists (n, 3) and memories as structs from results of JAX."""
    twists = np.stack(jax.device_get(jax.tree.leaves(twist)), -1)
    return twists, structs.filled("memory", memory, len(twists))


def _rounded(rng: np.random.Generator, x: Any) -> np.ndarray:
    """Return an input with relative changes of a few roundings."""
    x = np.asarray(x)
    if x.dtype.kind != "f":
        return x
    return (x * (1 + 4 * np.finfo(x.dtype).eps * rng.uniform(-1, 1, x.shape))).astype(x.dtype)


def _in_jax(law: Law, params: Any, real: type, count: int) -> tuple[Callable[..., Any], Any]:
    """Return the step of a law with numbers of a type, batched, and `count` initial memories.

    The step takes memories and the leaves of observations, and returns memories and twists.
    """
    params = jax.tree.map(lambda x: jnp.asarray(x, real), params)
    shapes = validation.observation_shapes(law.senses, heading=law.heading)
    tree = jax.tree.structure(shapes)

    def step(memory: Any, leaves: Any) -> tuple[Any, Twist]:
        memory, twist, _ = law.step(params, memory, jax.tree.unflatten(tree, leaves))
        return memory, twist

    initial = jax.tree.map(
        lambda x: np.broadcast_to(np.asarray(x), (count, *np.shape(x))), law.init(params)
    )
    return jax.vmap(step), initial


def _exact(law: Law, params: Any) -> Callable[[Any, Any], np.ndarray]:
    """Return the function of twists (n, 3) in float64 for parameters and inputs in float32."""

    def wide(x: Any) -> np.ndarray:
        return np.asarray(x, np.float64) if np.asarray(x).dtype.kind == "f" else np.asarray(x)

    rounded = jax.tree.map(lambda x: np.asarray(x, np.float32), params)
    with jax.enable_x64(True):
        step = jax.jit(_in_jax(law, rounded, np.float64, 1)[0])

    def twist(memory: Any, leaves: Any) -> np.ndarray:
        with jax.enable_x64(True):
            _, twists = step(*jax.tree.map(wide, (memory, leaves)))
            return np.stack(jax.device_get(jax.tree.leaves(twists)), -1)

    return twist


def _classify(
    tally: Agreement, error: np.ndarray, spread: np.ndarray, moved: Callable[[], np.ndarray]
) -> Agreement:
    """Return the tally after a batch with errors (n,), of which JAX itself has a `spread` (n,)."""
    beyond = error > TOLERANCE[tally.form]
    for _ in range(40):
        if not (beyond & (error > 4 * spread)).any():
            break
        spread = np.maximum(spread, moved())
    explained = beyond & (error <= 4 * spread)
    flips = explained & (error > JUMP)
    return tally._replace(
        inputs=tally.inputs + error.size,
        greatest=max(tally.greatest, float(error.max(initial=0))),
        beyond=tally.beyond + int(beyond.sum()),
        flips=tally.flips + int(flips.sum()),
        ill=tally.ill + int((explained & ~flips).sum()),
        unexplained=tally.unexplained + int((beyond & ~explained).sum()),
    )


def _difference(a: Result, b: Result, scale: np.ndarray) -> np.ndarray:
    """Return the largest difference (n,) of two results, twists (n, 3) and memories (n,)."""
    return np.maximum((np.abs(a[0] - b[0]) / scale).max(-1), _distance(a[1], b[1]))


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the largest difference (n,) of two memories, relative for values above 1."""
    worst = np.zeros(len(a))
    for name in a.dtype.names or ():
        x, y = (np.asarray(structs[name], float).reshape(len(a), -1) for structs in (a, b))
        worst = np.maximum(worst, (np.abs(x - y) / np.maximum(1, np.abs(y))).max(-1))
    return worst


def scale_of(params: Any) -> np.ndarray:
    """Return the greatest speeds and turning rate (3,) of a law."""
    inner = getattr(params, "law", params)
    speed, turn = (float(getattr(inner, name, 1.0)) for name in ("v_max", "omega_max"))
    return np.array([speed, speed, turn])


class TrialErrors(NamedTuple):
    """Errors (T,) of the twists over whole trials, by trial."""

    free: list[np.ndarray]  # each law has its own state from the first to the last step
    synchronised: list[np.ndarray]  # C or ONNX gets the state of JAX before each step
    in_jax: list[np.ndarray]  # JAX in float32 compared with JAX in float64


def trial_errors(name: str, form: Form, trials: Sequence[Any], path: Path) -> TrialErrors:
    """Return errors of the twists over whole trials, with observations of `loop.recorded`."""
    law_params = resolve_law(name)[1]
    law, exported, real = law_of(law_params), program.program(name), REAL[form]
    native = build_law(form, exported, path, len(trials))
    longest = max(len(trial[0]) for trial in trials)
    fields, scale = exported.groups["observation"], scale_of(law_params)

    def padded(leaves: Any) -> list[np.ndarray]:
        """Return leaves (longest, ...), padded with the last row."""
        rows = np.minimum(np.arange(longest), len(leaves[0]) - 1)
        padded = [np.asarray(leaf)[rows] for leaf in leaves]
        return [x.astype(real) if f.kind == "f" else x for f, x in zip(fields, padded, strict=True)]

    obs = [np.stack(columns, 1) for columns in zip(*map(padded, trials), strict=True)]
    memories, jax_twists = _trace(law, law_params, obs, real)
    state, free, synchronised = native.begin(len(trials)), [], []
    for i in range(longest):
        rows = native.filled("observation", [x[i] for x in obs], len(trials))
        free.append(native.step(state, rows)[0])
        jax_state = native.filled("memory", [x[i] for x in memories], len(trials))
        synchronised.append(native.step(jax_state, rows)[0])
    exact = jax_twists if form == "double" else _trace(law, law_params, obs, np.float64)[1]

    def errors(twists: Any, reference: np.ndarray) -> list[np.ndarray]:
        error = (np.abs(np.asarray(twists) - reference) / scale).max(-1)
        return [error[: len(trial[0]), i] for i, trial in enumerate(trials)]

    pairs = (free, jax_twists), (synchronised, jax_twists), (jax_twists, exact)
    return TrialErrors(*(errors(*pair) for pair in pairs))


def _trace(law: Law, params: Any, obs: Sequence[Any], real: Any) -> tuple[list[Any], np.ndarray]:
    """Return memories before each step and twists (T, n, 3) for observations (T, n, ...)."""
    with jax.enable_x64(real == np.float64):
        step, initial = _in_jax(law, params, real, obs[0].shape[1])
        inputs = [x.astype(real) if x.dtype.kind == "f" else x for x in obs]

        def scanned(memory: Any, leaves: Any) -> Any:
            next_memory, twist = step(memory, leaves)
            return next_memory, (memory, jnp.stack([jnp.asarray(x, real) for x in twist], -1))

        memories, twists = jax.jit(lambda m, x: jax.lax.scan(scanned, m, x)[1])(initial, inputs)
        return [np.asarray(x) for x in jax.tree.leaves(memories)], np.asarray(twists)


def latency(name: str, precision: Precision, path: Path, runs: int = 5) -> np.ndarray:
    """Return median and 99.9th percentile (runs, 2) [us] of a step of skin and law, on one core.

    The exported example times 200,000 steps per run.
    """
    exported, build = program.program(name), Path(tempfile.mkdtemp(dir=path))
    for file, text in folder.files(exported, "law").items():
        (build / file).write_text(text, encoding="utf-8")
    binary = compiled("gcc", build / "main.c", precision, "-O2")
    one_core = ["taskset", "-c", str(max(os.sched_getaffinity(0)))] * bool(shutil.which("taskset"))
    times = []
    for _ in range(runs):
        process = subprocess.run([*one_core, binary], check=True, capture_output=True, text=True)
        times.append([float(x) for x in re.findall(r"([\d.]+) us", process.stdout)[:2]])
    return np.array(times)


# Odd inputs: exit code 0 if all guarantees hold, else the number of the violated guarantee.
FUZZ = """
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "law.h"
static law_real odd(void) {
  static const float some[] = {0, -0.0f, 1e-38f, 1e38f, -1e38f, 3e9f, -3e9f, 1, 0.3f};
  int i = rand() % 40;
  return i == 0 ? (law_real)NAN : i == 1 ? (law_real)INFINITY : i == 2 ? (law_real)-INFINITY
       : (law_real)some[i % 9];
}
int main(void) {
  law_params params = LAW_PARAMS;
  law_skin_params skin_params = LAW_SKIN_PARAMS;
  law_memory memory;
  law_skin skin;
  int codes[3] = {0, 0, 0};
  law_init(&params, &memory);
  law_skin_init(&skin);
  for (int i = 0; i < INPUTS; i++) {
    law_observation obs;
    law_twist twist;
    law_contact contact;
    law_real taxels[LAW_TAXELS], numbers[sizeof obs / sizeof(law_real)];
    law_memory before = memory;
    int bad = 0;
    for (unsigned k = 0; k < sizeof numbers / sizeof numbers[0]; k++) numbers[k] = odd();
    memcpy(&obs, numbers, sizeof numbers); /* flags of any bits, too */
    int code = law_step(&params, &memory, &obs, &twist);
    codes[code]++;
    if (!isfinite(twist.v_x) || !isfinite(twist.v_y) || !isfinite(twist.omega)) return 2;
    if (code && (twist.v_x != 0 || twist.v_y != 0 || twist.omega != 0)) return 3;
    if (code && memcmp(&before, &memory, sizeof memory)) return 4;
    if (!isfinite(obs.yaw) && code != LAW_BAD_INPUT) return 5;
    if (rand() % 50 == 0) memset(&memory, rand() % 256, sizeof memory);
    for (int k = 0; k < LAW_TAXELS; k++) bad |= !isfinite(taxels[k] = rand() % 20 ? 1 : odd());
    law_real period = rand() % 9 ? (law_real)0.01 : odd();
    code = law_skin_step(&skin_params, &skin, taxels, period, &contact);
    if (bad && (code != LAW_BAD_INPUT || contact.in_contact)) return 6;
    for (int k = 0; k < LAW_TAXELS; k++) if (!isfinite(skin.signal[k])) return 7;
  }
  printf("%d %d %d\\n", codes[0], codes[1], codes[2]);
  return codes[0] && codes[1] ? 0 : 8;
}
"""
SANE = ("-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
ALL_COMPILERS = "gcc", "clang"
COMPILERS = tuple(name for name in ALL_COMPILERS if shutil.which(name))


class Fuzzed(NamedTuple):
    """Results of a law in C for odd inputs."""

    fault: int  # 0, the violated guarantee, or the negative number of a signal
    taken: int  # inputs with a twist
    refused: int  # inputs that are not finite
    no_result: int  # inputs without a finite twist
    said: str  # output of the sanitizers


def fuzzed(exported: Any, compiler: str, precision: Precision, inputs: int, path: Path) -> Fuzzed:
    """Step a law with odd inputs, with address and undefined-behaviour sanitizers."""
    build = Path(tempfile.mkdtemp(dir=path))
    (build / "law.h").write_text(header(exported))
    (build / "fuzz.c").write_text(FUZZ)
    options = (*STRICT, *SANE, f"-DINPUTS={inputs}")
    binary = compiled(compiler, build / "fuzz.c", precision, *options)
    process = subprocess.run([binary], capture_output=True, text=True)
    codes = [int(x) for x in process.stdout.split()] or [0, 0, 0]
    return Fuzzed(process.returncode, codes[0], codes[1], codes[2], process.stderr)
