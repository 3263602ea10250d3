"""Laws in C, compiled and loaded, beside those in JAX: chance inputs, whole trials, and times.

Each input is a chance observation with the memory that JAX had there, so a switch that flips does
not spoil what follows. Errors are relative to the greatest speed and turning rate of a law. Where
one exceeds the tolerance, the inputs are moved by a few roundings: JAX's own twist moves as far
where a switch is near (a flip) or where the law is ill-conditioned; and JAX's float32 is compared
with its float64, since XLA's float32 functions are themselves off by some roundings. What none of
these explains is a fault, and there must be none.
"""

from __future__ import annotations

import ctypes
import re
import subprocess
import tempfile
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.app.export import c, folder, program
from rps_jax.app.export.program import Group, Program
from rps_jax.control import registry, trying
from rps_jax.control.base import Law
from rps_jax.control.observation import Details, Twist
from rps_jax.runs.push import recorded_law
from rps_jax.trials import pushes
from rps_jax.trials.batch import Part
from rps_jax.trials.case import Case
from rps_jax.world import paper
from rps_jax.world.objects import PAPER_OBJECTS
from rps_jax.world.scene import FRICTION

Precision = Literal["float", "double"]
TOLERANCE = {"float": 1e-6, "double": 1e-12}
ROUNDING = {"float": 2.0**-23, "double": 2.0**-52}
FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-fPIC", "-shared")
STEPS = 100  # of each world, from its first
_JUMP = 1e-3  # [1] beyond which a difference is a flip

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


class Native:
    """A law in C, compiled and loaded; arrays of structs go in and out."""

    def __init__(self, made: Program, where: Path, precision: Precision, compiler: str = "gcc"):
        """Compile it in a folder."""
        self.program, self.real = made, {"float": np.float32, "double": np.float64}[precision]
        p = "law"
        folder = Path(tempfile.mkdtemp(dir=where))  # a library is loaded once from one path
        (folder / "law.h").write_text(c.header(made, p))
        (folder / "driver.c").write_text(DRIVER.format(p=p, P=p.upper()))
        library = folder / f"{compiler}_{precision}.so"
        double = ["-DLAW_DOUBLE"] if precision == "double" else []
        command = [compiler, *FLAGS, *double, str(folder / "driver.c"), "-lm", "-o", str(library)]
        subprocess.run(command, check=True)
        self._library = ctypes.CDLL(str(library))
        self.dtypes = {name: self._dtype(group) for name, group in made.groups.items()}
        self.params = self.struct("params", 1)
        for one in made.groups["params"]:
            self.params[one.name] = one.value

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
    """How far C is from JAX."""

    law: str
    precision: str
    inputs: int
    greatest: float  # error
    beyond: int  # inputs whose error exceeds the tolerance, of which
    flips: int  # a switch flips, and JAX's own does after a few roundings
    ill: int  # JAX's own twist is or moves as far off by a few roundings
    unexplained: int


def agreement(
    name: str, precision: Precision, inputs: int, where: Path, seed: int = 0
) -> Agreement:
    """Compare a law's twist and memory in C and in JAX."""
    label, params = registry.read_law(name)
    law, made = registry.law_of(params), program.program(name)
    native = Native(made, where, precision)
    real, worlds = native.real, max(1, min(inputs // STEPS, 5000))
    with jax.enable_x64(precision == "double"):
        params = jax.tree.map(lambda x: jnp.asarray(x, real), params)
        seen_tree = jax.tree.structure(trying.observation_of(law.senses))

        def step(memory: Any, leaves: Any) -> Any:
            memory, twist, _ = law.step(params, memory, jax.tree.unflatten(seen_tree, leaves))
            return memory, twist

        step = jax.jit(jax.vmap(step))
        exact = None if precision == "double" else _exact(law, params, seen_tree)
        rng, found = np.random.default_rng(seed), Agreement(label, precision, 0, 0.0, 0, 0, 0, 0)
        scale = _scale(params)
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
                own = None if exact is None or error.max() <= 1e-6 else exact(memory, leaves)
                found = _judged(found, error, native, step, memory, leaves, both, scale, rng, own)
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
    found: Agreement, error: np.ndarray, native: Native, step: Any, memory: Any, leaves: Any,
    both: np.ndarray, scale: np.ndarray, rng: np.random.Generator, own: np.ndarray | None,
) -> Agreement:  # fmt: skip
    precision: Precision = "float" if native.real == np.float32 else "double"
    beyond = error > TOLERANCE[precision]
    found = found._replace(
        inputs=found.inputs + error.size,
        greatest=max(found.greatest, float(error.max(initial=0))),
        beyond=found.beyond + int(beyond.sum()),
    )
    if not beyond.any():
        return found

    def moved(x: Any) -> Any:
        x = np.asarray(x)
        if x.dtype.kind != "f":
            return x
        return (x * (1 + 4 * ROUNDING[precision] * rng.uniform(-1, 1, x.shape))).astype(x.dtype)

    spread = np.zeros(error.size) if own is None else (np.abs(own - both) / scale).max(-1)
    here = native.filled("memory", step(memory, leaves)[0], error.size)
    for _ in range(40):
        other, twist = jax.device_get(step(*jax.tree.map(moved, (memory, leaves))))
        away = (np.abs(np.stack(jax.tree.leaves(twist), -1) - both) / scale).max(-1)
        away = np.maximum(away, _apart(here, native.filled("memory", other, error.size)))
        spread = np.maximum(spread, away)
    explained = beyond & (error <= 4 * spread)
    flips = explained & (error > _JUMP)
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


def _scale(params: Any) -> np.ndarray:
    """The greatest speeds and turning rate (3,) of a law."""
    own = getattr(params, "law", params)
    speed, turn = (float(getattr(own, name, 1.0)) for name in ("v_max", "omega_max"))
    return np.array([speed, speed, turn])


def trial_errors(name: str, case: Any, setting: Any, where: Path) -> np.ndarray:
    """Errors (T,) of the twists of a whole trial, C's memory being its own."""
    law = registry.law_of(case.params)
    stage, worlds = pushes.build([case], setting)
    period = setting.physics.control_period
    part = Part(np.arange(1), worlds, stage)
    (followed,) = pushes.follow_part(part, recorded_law(law), setting, interval=period)
    seen, native = followed.snapshots, Native(program.program(name), where, "float")
    observed = tuple(seen.details)[1]  # of `recorded_law`, with taxels
    observed = observed.touch if law.senses == "touch" else observed
    leaves, memory = jax.tree.leaves(observed), native.begin(1)
    count = len(seen.time)
    leaves = [np.broadcast_to(x, (count, *x.shape[1:])) for x in leaves]
    every = native.filled("observation", leaves, count)
    twists = np.concatenate([native.step(memory, every[i : i + 1])[0] for i in range(count)])
    both = np.stack([np.broadcast_to(x, (count,)) for x in seen.twist], -1)
    return (np.abs(twists - both) / _scale(case.params)).max(-1)


def ends(names: list[str], setting: Any, where: Path) -> list[dict[str, Any]]:
    """How the paper's 144 trials of RPS end with a law of JAX and with that of C in the loop."""
    found = []
    for name in names:
        label, params = registry.read_law(name)
        law, native = registry.law_of(params), Native(program.program(name), where, "float")

        def called(memory: Any, seen: Any, native: Native = native) -> Any:
            shape = np.shape(jax.tree.leaves(seen)[0])[:-1]
            count = int(np.prod(shape))
            given, fields = native.filled, native.program.groups["memory"]
            flat = [np.asarray(x).reshape(count, *np.shape(x)[len(shape) :]) for x in memory]
            mine = given("memory", flat, count)
            seen = [np.asarray(x).reshape(count, *np.shape(x)[len(shape) :]) for x in seen]
            twist, _ = native.step(mine, given("observation", seen, count))
            after = [
                np.asarray(mine[f.name]).reshape(np.shape(x)).astype(x.dtype) if f.size else x
                for f, x in zip(fields, memory, strict=True)
            ]
            return after, twist.reshape(*shape, 3)

        def step(_: Any, memory: Any, seen: Any, called: Any = called) -> Any:
            tree = jax.tree.structure(memory)
            shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in jax.tree.leaves(memory)]
            out = (shapes, jax.ShapeDtypeStruct((3,), np.float32))
            after, twist = jax.pure_callback(
                called, out, jax.tree.leaves(memory), jax.tree.leaves(seen),
                vmap_method="broadcast_all",
            )  # fmt: skip
            touch = getattr(seen, "touch", seen)
            return jax.tree.unflatten(tree, after), Twist(*twist), Details.of(touch)

        class InC(NamedTuple):
            law: Any
            d_success: Any

        mine = InC(params, params.d_success)
        native_law = Law(lambda p, law=law: law.init(p.law), step, senses=law.senses)
        registry.register_law(f"{program.identifier(label)}_in_c", native_law, mine)
        cases = [(o, f, t) for o in PAPER_OBJECTS for f in FRICTION for t in paper.TARGETS]
        outcomes = [
            pushes.run([Case(o, f, t, law=p) for o, f, t in cases], setting)[0]
            for p in (params, mine)
        ]
        jax_success, c_success = (np.asarray(one.success) for one in outcomes)
        found.append(
            {
                "law": label,
                "trials": len(cases),
                "succeed in JAX": int(jax_success.sum()),
                "succeed in C": int(c_success.sum()),
                "end alike": int((jax_success == c_success).sum()),
                "greatest difference of time [s]": float(
                    np.abs(outcomes[0].time - outcomes[1].time).max()
                ),
            }
        )
    return found


def latency(name: str, where: Path) -> tuple[float, float]:
    """Median and 99.9th percentile [us] of a step of skin and law, by the exported example."""
    made, place = program.program(name), Path(tempfile.mkdtemp(dir=where))
    for file, text in {"law.h": c.header(made, "law"), **folder.files(made, "law")}.items():
        (place / file).write_text(text, encoding="utf-8")
    command = ["gcc", "-std=c99", "-O2", str(place / "main.c"), "-lm", "-o", str(place / "main")]
    subprocess.run(command, check=True)
    ran = subprocess.run([str(place / "main")], check=True, capture_output=True, text=True)
    median, slow = re.findall(r"([\d.]+) us", ran.stdout)[:2]
    return float(median), float(slow)
