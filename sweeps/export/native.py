"""Laws in C and ONNX beside those in JAX: chance inputs, whole trials, odd inputs and times.

Each chance input is an observation with the memory that JAX had there, so a switch that flips does
not spoil what follows. Errors are relative to the greatest speed and turning rate of a law. Where
one exceeds the tolerance, the inputs are moved by a few roundings: JAX's own twist moves as far
where a switch is near (a flip) or where the law is ill-conditioned; and JAX's float32 is compared
with its float64, since XLA's float32 functions are themselves off by some roundings. What none of
these explains is a fault, and there must be none.
"""

from __future__ import annotations

import ctypes
import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.app.export import c, folder, onnx_model, program
from rps_jax.app.export.program import Program
from rps_jax.control import registry, validation
from rps_jax.control.base import Law
from rps_jax.lowering.routine import Group

Precision = Literal["float", "double"]
Form = Literal["float", "double", "onnx"]  # C of either precision, or ONNX, which is of float
REAL: dict[str, Any] = {"float": np.float32, "double": np.float64, "onnx": np.float32}
TOLERANCE = {"float": 1e-6, "double": 1e-12, "onnx": 1e-6}
FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-fPIC", "-shared")
STEPS = 100  # of each world, from its first
JUMP = 1e-3  # [1] beyond which a difference is a flip

DRIVER = """
#include "{p}.h"
void begin(int n, const {p}_params *params, {p}_memory *memory);
void steps(int n, const {p}_params *params, {p}_memory *memory, const {p}_observation *seen,
           {p}_twist *twist, int *code);
void touches(int n, {p}_skin *skin, const {p}_real *taxels, const {p}_real *period,
             {p}_contact *contact, int *code);
void begin(int n, const {p}_params *params, {p}_memory *memory) {{
  for (int i = 0; i < n; i++) {p}_init(params, memory + i);
}}
void steps(int n, const {p}_params *params, {p}_memory *memory, const {p}_observation *seen,
           {p}_twist *twist, int *code) {{
  for (int i = 0; i < n; i++) code[i] = {p}_step(params, memory + i, seen + i, twist + i);
}}
void touches(int n, {p}_skin *skin, const {p}_real *taxels, const {p}_real *period,
             {p}_contact *contact, int *code) {{
  const {p}_skin_params params = {P}_SKIN_PARAMS;
  for (int i = 0; i < n; i++)
    code[i] = {p}_skin_step(&params, skin + i, taxels + i * {P}_TAXELS, period[i], contact + i);
}}
"""


class Structs:
    """Arrays of structs that a law takes and gives."""

    def __init__(self, made: Program, form: Form):
        """Take the types of a program's groups."""
        self.program, self.real = made, REAL[form]
        self.dtypes = {name: self._dtype(group) for name, group in made.groups.items()}

    def _dtype(self, group: Group) -> np.dtype:
        kinds = {"f": self.real, "i": np.int32, "b": np.int32}
        fields: list[Any] = [(one.name, kinds[one.kind], one.shape) for one in group if one.size]
        return np.dtype(fields or [("nothing", np.int8)], align=True)

    def struct(self, group: str, count: int) -> np.ndarray:
        """So many structs of a group."""
        return np.zeros(count, self.dtypes[group])

    def filled(self, group: str, leaves: Any, count: int) -> np.ndarray:
        """Structs of a group from a pytree of arrays (count, ...)."""
        found = self.struct(group, count)
        for one, leaf in zip(self.program.groups[group], jax.tree.leaves(leaves), strict=True):
            if one.size:
                found[one.name] = leaf
        return found


class Native(Structs):
    """A law in C, compiled and loaded."""

    def __init__(self, made: Program, where: Path, precision: Precision, compiler: str = "gcc"):
        """Compile it in a folder."""
        super().__init__(made, precision)
        p = "law"
        folder = Path(tempfile.mkdtemp(dir=where))  # a library is loaded once from one path
        (folder / "law.h").write_text(c.header(made, p))
        (folder / "driver.c").write_text(DRIVER.format(p=p, P=p.upper()))
        library = folder / f"{compiler}_{precision}.so"
        double = ["-DLAW_DOUBLE"] if precision == "double" else []
        command = [compiler, *FLAGS, *double, str(folder / "driver.c"), "-lm", "-o", str(library)]
        subprocess.run(command, check=True)
        self._library = ctypes.CDLL(str(library))
        self.params = self.struct("params", 1)
        for one in made.groups["params"]:
            self.params[one.name] = one.value

    def begin(self, count: int) -> np.ndarray:
        """Memories before the first step."""
        memory = self.struct("memory", count)
        self._call("begin", count, self.params, memory)
        return memory

    def step(self, memory: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Twists (n, 3) and codes (n,); the memory becomes that after the step."""
        twist, code = self.struct("twist", len(seen)), np.zeros(len(seen), np.int32)
        self._call("steps", len(seen), self.params, memory, seen, twist, code)
        return np.stack([twist[name] for name in ("v_x", "v_y", "omega")], -1), code

    def touch(
        self, skin: np.ndarray, taxels: np.ndarray, period: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Contacts and codes (n,); the skin becomes that after the scan."""
        contact, code = self.struct("contact", len(skin)), np.zeros(len(skin), np.int32)
        given = (np.ascontiguousarray(x, self.real) for x in (taxels, period))
        self._call("touches", len(skin), skin, *given, contact, code)
        return contact, code

    def _call(self, name: str, count: int, *arrays: np.ndarray) -> None:
        places = [array.ctypes.data_as(ctypes.c_void_p) for array in arrays]
        getattr(self._library, name)(ctypes.c_int(count), *places)


class Onnx(Structs):
    """A law as an ONNX model of so many worlds, in a session of the runtime."""

    def __init__(self, made: Program, count: int):
        """Write the model and load it."""
        import onnx
        import onnxruntime

        super().__init__(made, "onnx")
        model = onnx_model.models(made, "law", count)["law.onnx"]
        assert isinstance(model, bytes)
        self.session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
        self.about = {one.key: one.value for one in onnx.load_from_string(model).metadata_props}
        types = {"tensor(float)": np.float32, "tensor(bool)": np.bool_, "tensor(int32)": np.int32}
        self._types = {one.name: types[one.type] for one in self.session.get_inputs()}
        self._names = [one.name for one in self.session.get_outputs()]

    def begin(self, count: int) -> np.ndarray:
        """Memories before the first step."""
        memory = self.struct("memory", count)
        for name, value in json.loads(self.about["memory_at_the_start"]).items():
            memory[name.removeprefix("memory_")] = np.array(value)
        return memory

    def step(self, memory: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Twists (n, 3) and codes (n,), all 0; the memory becomes that after the step."""
        known = {f"memory_{name}": memory[name] for name in memory.dtype.names or ()}
        known |= {name: seen[name] for name in seen.dtype.names or ()}
        given = {k: np.ascontiguousarray(known[k], kind) for k, kind in self._types.items()}
        found = dict(zip(self._names, self.session.run(None, given), strict=True))
        for name in memory.dtype.names or ():
            if (after := f"next_memory_{name}") in found:
                memory[name] = found[after]
        twist = np.stack([np.asarray(found[name]) for name in ("v_x", "v_y", "omega")], -1)
        return twist, np.zeros(len(seen), np.int32)


def made_in(form: Form, made: Program, where: Path, count: int) -> Native | Onnx:
    """A law in C, or as ONNX for `count` worlds at once."""
    return Onnx(made, count) if form == "onnx" else Native(made, where, form)


def observations(made: Program, rng: np.random.Generator, count: int, real: Any) -> Any:
    """Chance observations (count, ...) as a law senses them."""

    def drawn(name: str, shape: tuple[int, ...]) -> np.ndarray:
        size = (count, *shape)
        spread = {"yaw": 4.0, "f_robot": 60.0, "p_robot_contact": 0.4}.get(name, 3.0)
        found = rng.uniform(-spread, spread, size)
        if name == "p_world_target":  # near for some
            found *= rng.choice([0.05, 0.3, 1.0], (count, 1))
        if name == "period":
            found = np.full(size, 0.02)
        if name == "r_object":
            found = rng.uniform(0.1, 0.5, size)
        if name == "signal":
            found = np.where(rng.random(size) < 0.2, rng.uniform(0, 2, size), 0.0)
        return found.astype(real)

    return [
        rng.random((count, *one.shape)) < (0.85 if one.name == "in_contact" else 0.5)
        if one.kind == "b"
        else drawn(one.name, one.shape)
        for one in made.groups["observation"]
    ]


class Agreement(NamedTuple):
    """How far C or ONNX is from JAX, counted in inputs."""

    law: str
    form: str
    inputs: int = 0
    greatest: float = 0.0  # error
    beyond: int = 0  # whose error exceeds the tolerance, of which
    flips: int = 0  # a switch flips, and JAX's own does after a few roundings
    ill: int = 0  # JAX's own twist is or moves as far off by a few roundings
    unexplained: int = 0
    off: int = 0  # in float, further than the tolerance from the twist of float64
    off_in_jax: int = 0  # where JAX's float32 is


def agreement(name: str, form: Form, inputs: int, where: Path, seed: int = 0) -> Agreement:
    """Compare a law's twist and memory in C or ONNX and in JAX."""
    label, params = registry.resolve_law(name)
    law, made = registry.law_of(params), program.program(name)
    worlds, real = max(1, min(inputs // STEPS, 5000)), REAL[form]
    native = made_in(form, made, where, worlds)
    with jax.enable_x64(form == "double"):
        params = jax.tree.map(lambda x: jnp.asarray(x, real), params)
        seen_tree = jax.tree.structure(validation.observation_shapes(law.senses))

        def step(memory: Any, leaves: Any) -> Any:
            memory, twist, _ = law.step(params, memory, jax.tree.unflatten(seen_tree, leaves))
            return memory, twist

        step = jax.jit(jax.vmap(step))
        exact = None if form == "double" else _exact(law, params, seen_tree)
        rng, found, scale = np.random.default_rng(seed), Agreement(label, form), scale_of(params)
        begin = jax.tree.map(
            lambda x: np.broadcast_to(np.asarray(x), (worlds, *np.shape(x))), law.init(params)
        )
        while found.inputs < inputs:
            memory = begin
            for _ in range(STEPS):
                leaves = observations(made, rng, worlds, real)
                after, twist = jax.device_get(step(memory, leaves))
                mine = native.filled("memory", memory, worlds)
                theirs, code = native.step(mine, native.filled("observation", leaves, worlds))
                if code.any():
                    raise AssertionError(f"{name}: codes {np.unique(code)}")
                both = np.stack(jax.tree.leaves(twist), -1)
                error = (np.abs(theirs - both) / scale).max(-1)
                error = np.maximum(error, _apart(mine, native.filled("memory", after, worlds)))
                spread = np.zeros(worlds)
                if exact is not None:
                    own = exact(memory, leaves)
                    spread = (np.abs(own - both) / scale).max(-1)
                    off = (np.abs(own - theirs) / scale).max(-1) > TOLERANCE[form]
                    found = found._replace(
                        off=found.off + int(off.sum()),
                        off_in_jax=found.off_in_jax + int((spread > TOLERANCE[form]).sum()),
                    )
                found = _judged(
                    found, error, native, step, memory, leaves, both, scale, rng, spread
                )
                memory = after
    return found


def _exact(law: Any, params: Any, seen_tree: Any) -> Any:
    """The twists (n, 3) of the law in float64, of numbers of float32."""

    def step(params: Any, memory: Any, leaves: Any) -> Any:
        return law.step(params, memory, jax.tree.unflatten(seen_tree, leaves))[1]

    compiled = jax.jit(jax.vmap(step, in_axes=(None, 0, 0)))

    def twist(memory: Any, leaves: Any) -> np.ndarray:
        def wide(x: Any) -> Any:
            return np.asarray(x, np.float64) if np.asarray(x).dtype.kind == "f" else x

        with jax.enable_x64(True):
            found = compiled(*jax.tree.map(wide, (params, memory, leaves)))
            return np.stack(jax.device_get(jax.tree.leaves(found)), -1)

    return twist


def _judged(
    found: Agreement, error: np.ndarray, native: Structs, step: Any, memory: Any, leaves: Any,
    both: np.ndarray, scale: np.ndarray, rng: np.random.Generator, spread: np.ndarray,
) -> Agreement:  # fmt: skip
    """The tally after one batch, of which JAX itself is off by `spread`."""
    beyond = error > TOLERANCE[found.form]
    found = found._replace(
        inputs=found.inputs + error.size,
        greatest=max(found.greatest, float(error.max(initial=0))),
        beyond=found.beyond + int(beyond.sum()),
    )
    few = 4 * np.finfo(native.real).eps

    def moved(x: Any) -> Any:
        x = np.asarray(x)
        if x.dtype.kind != "f":
            return x
        return (x * (1 + few * rng.uniform(-1, 1, x.shape))).astype(x.dtype)

    here = None
    for _ in range(40):
        if not (beyond & (error > 4 * spread)).any():
            break
        if here is None:
            here = native.filled("memory", step(memory, leaves)[0], error.size)
        other, twist = jax.device_get(step(*jax.tree.map(moved, (memory, leaves))))
        away = (np.abs(np.stack(jax.tree.leaves(twist), -1) - both) / scale).max(-1)
        away = np.maximum(away, _apart(here, native.filled("memory", other, error.size)))
        spread = np.maximum(spread, away)
    explained = beyond & (error <= 4 * spread)
    flips = explained & (error > JUMP)
    return found._replace(
        flips=found.flips + int(flips.sum()),
        ill=found.ill + int((explained & ~flips).sum()),
        unexplained=found.unexplained + int((beyond & ~explained).sum()),
    )


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Greatest difference (n,) of two memories, relative where a number is beyond 1."""
    worst = np.zeros(len(a))
    for name in a.dtype.names or ():
        x, y = (np.asarray(one[name], float).reshape(len(a), -1) for one in (a, b))
        worst = np.maximum(worst, (np.abs(x - y) / np.maximum(1, np.abs(y))).max(-1))
    return worst


def scale_of(params: Any) -> np.ndarray:
    """The greatest speeds and turning rate (3,) of a law."""
    own = getattr(params, "law", params)
    speed, turn = (float(getattr(own, name, 1.0)) for name in ("v_max", "omega_max"))
    return np.array([speed, speed, turn])


class Whole(NamedTuple):
    """Errors (T,) of the twists over whole trials, by trial."""

    own: list[np.ndarray]  # each law remembers by itself, from the first step to the last
    told: list[np.ndarray]  # before each step, the law in C or ONNX is given the memory of JAX
    in_jax: list[np.ndarray]  # of JAX in float32 from JAX in float64, which remember by themselves


def trial_errors(name: str, form: Form, trials: Sequence[Any], where: Path) -> Whole:
    """Errors of the twists over whole trials, observed as `recorded`, in a form's precision."""
    law_params = registry.resolve_law(name)[1]
    law, made, real = registry.law_of(law_params), program.program(name), REAL[form]
    native, longest = made_in(form, made, where, len(trials)), max(len(one[0]) for one in trials)
    fields, scale = made.groups["observation"], scale_of(law_params)

    def whole(leaves: Any) -> list[np.ndarray]:
        """Leaves (longest, ...), the last row held."""
        rows = np.minimum(np.arange(longest), len(leaves[0]) - 1)
        kinds = [real if one.kind == "f" else np.asarray(x).dtype
                 for one, x in zip(fields, leaves, strict=True)]  # fmt: skip
        return [np.asarray(x)[rows].astype(kind) for x, kind in zip(leaves, kinds, strict=True)]

    seen = [np.stack(columns, 1) for columns in zip(*map(whole, trials), strict=True)]
    memories, both = _in_jax(law, law_params, seen, real)
    mine, own, told = native.begin(len(trials)), [], []
    for i in range(longest):
        rows = native.filled("observation", [x[i] for x in seen], len(trials))
        own.append(native.step(mine, rows)[0])
        theirs = native.filled("memory", [x[i] for x in memories], len(trials))
        told.append(native.step(theirs, rows)[0])
    exact = both if form == "double" else _in_jax(law, law_params, seen, np.float64)[1]

    def errors(twists: Any, those: np.ndarray) -> list[np.ndarray]:
        error = (np.abs(np.asarray(twists) - those) / scale).max(-1)
        return [error[: len(one[0]), i] for i, one in enumerate(trials)]

    return Whole(errors(own, both), errors(told, both), errors(both, exact))


def _in_jax(law: Law, params: Any, seen: Sequence[Any], real: Any) -> tuple[list[Any], np.ndarray]:
    """Memories before each step and twists (T, n, 3) of a law that observes leaves (T, n, ...)."""
    with jax.enable_x64(real == np.float64):
        own = jax.tree.map(lambda x: jnp.asarray(x, real), params)
        tree = jax.tree.structure(validation.observation_shapes(law.senses))
        given = [x.astype(real) if x.dtype.kind == "f" else x for x in seen]

        def step(memory: Any, leaves: Any) -> Any:
            after, twist, _ = law.step(own, memory, jax.tree.unflatten(tree, leaves))
            return after, (memory, jnp.stack([jnp.asarray(x, real) for x in twist]))

        count = seen[0].shape[1]
        begin = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *jnp.shape(x))), law.init(own))
        memories, twists = jax.jit(lambda m, x: jax.lax.scan(jax.vmap(step), m, x)[1])(begin, given)
        return [np.asarray(x) for x in jax.tree.leaves(memories)], np.asarray(twists)


def latency(name: str, precision: Precision, where: Path, runs: int = 5) -> np.ndarray:
    """Median and 99.9th percentile (runs, 2) [us] of a step of skin and law, on one core.

    The exported example measures itself, 200,000 steps in a run.
    """
    made, place = program.program(name), Path(tempfile.mkdtemp(dir=where))
    for file, text in folder.files(made, "law").items():
        (place / file).write_text(text, encoding="utf-8")
    double = ["-DLAW_DOUBLE"] if precision == "double" else []
    source, binary = str(place / "main.c"), str(place / "main")
    subprocess.run(["gcc", "-std=c99", "-O2", *double, source, "-lm", "-o", binary], check=True)
    one_core = ["taskset", "-c", str(max(os.sched_getaffinity(0)))] * bool(shutil.which("taskset"))
    found = []
    for _ in range(runs):
        ran = subprocess.run([*one_core, binary], check=True, capture_output=True, text=True)
        found.append([float(x) for x in re.findall(r"([\d.]+) us", ran.stdout)[:2]])
    return np.array(found)


# Odd inputs: 0 if nothing that is not finite is taken, or comes out; else what went wrong.
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
    law_observation seen;
    law_twist twist;
    law_contact contact;
    law_real taxels[LAW_TAXELS], numbers[sizeof seen / sizeof(law_real)];
    law_memory before = memory;
    int bad = 0;
    for (unsigned k = 0; k < sizeof numbers / sizeof numbers[0]; k++) numbers[k] = odd();
    memcpy(&seen, numbers, sizeof numbers); /* flags of any bits, too */
    int code = law_step(&params, &memory, &seen, &twist);
    codes[code]++;
    if (!isfinite(twist.v_x) || !isfinite(twist.v_y) || !isfinite(twist.omega)) return 2;
    if (code && (twist.v_x != 0 || twist.v_y != 0 || twist.omega != 0)) return 3;
    if (code && memcmp(&before, &memory, sizeof memory)) return 4;
    if (!isfinite(seen.yaw) && code != LAW_BAD_INPUT) return 5;
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
COMPILERS = tuple(name for name in ("gcc", "clang") if shutil.which(name))


class Fuzzed(NamedTuple):
    """What a law in C made of odd inputs."""

    fault: int  # 0, or which promise was broken; a negative number is a signal's
    taken: int  # inputs that gave a twist
    refused: int  # that were not finite
    no_result: int  # for which the law has no finite twist
    said: str  # by the sanitizers


def fuzzed(made: Program, compiler: str, precision: Precision, inputs: int, where: Path) -> Fuzzed:
    """Step a law with odd inputs, under the sanitizers of addresses and undefined behaviour."""
    place = Path(tempfile.mkdtemp(dir=where))
    (place / "law.h").write_text(c.header(made, "law"))
    (place / "fuzz.c").write_text(FUZZ)
    double = ["-DLAW_DOUBLE"] if precision == "double" else []
    source, binary = str(place / "fuzz.c"), str(place / "fuzz")
    strict = [flag for flag in FLAGS if flag not in ("-O2", "-fPIC", "-shared")]
    options = [*strict, *SANE, *double, f"-DINPUTS={inputs}"]
    subprocess.run([compiler, *options, source, "-lm", "-o", binary], check=True)
    ran = subprocess.run([binary], capture_output=True, text=True)
    codes = [int(x) for x in ran.stdout.split()] or [0, 0, 0]
    return Fuzzed(ran.returncode, codes[0], codes[1], codes[2], ran.stderr)
