"""Helpers of several test files: commands, small trials and sweeps, shapes and comparisons."""

import ast
import contextlib
import itertools
import re
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import hypothesis
import imageio_ffmpeg
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import strategies
from numpy.testing import assert_allclose, assert_array_equal

import rps_jax
from rps_jax import engines
from rps_jax.app import cli
from rps_jax.control import registry
from rps_jax.control.laws.rps import RPSParams
from rps_jax.control.observation import Observation
from rps_jax.errors import InputError
from rps_jax.geometry import footprint as fp
from rps_jax.geometry.footprint import Footprint
from rps_jax.robot.shell import HALF_LENGTH, HALF_WIDTH
from rps_jax.runs import execution
from rps_jax.runs.plan import Plan, open_run
from rps_jax.trials import trial
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Rules, Trial
from rps_jax.trials.worlds import WorldBatch
from rps_jax.world import domain, objects, quantity, tasks
from rps_jax.world.domain import Range, parse_domain
from rps_jax.world.physics import preset

ROOT = Path(__file__).resolve().parent.parent
PAPER = RPSParams.paper()


# --- the command line ----------------------------------------------------------------------


def rps(first: Any, *rest: Any) -> int:
    """Run a command and return its exit code; a first argument may be several words of text."""
    words = first.split() if isinstance(first, str) else [first]
    return cli.main([str(word) for word in (*words, *rest)])


def printed(capsys, *arguments: Any) -> str:
    """Return what a command prints, which succeeds."""
    assert rps(*arguments) == 0
    return capsys.readouterr().out


def refusal(capsys, *arguments: Any) -> str:
    """Return the single-sentence error with which a command refuses its input."""
    capsys.readouterr()
    assert rps(*arguments) == 2
    return one_sentence(capsys.readouterr().err)


def one_sentence(error: str) -> str:
    """Assert that an error is one sentence of `rps`, and return it."""
    assert error.startswith("rps: error: ")
    assert error.count("\n") == 1
    assert error.endswith(".\n")
    return error


def refusing(pattern: str) -> Any:
    """Expect an InputError whose sentence has a pattern."""
    return pytest.raises(InputError, match=pattern)


def refusals(call: Callable[..., object], *cases: tuple[Any, str]) -> Callable[..., None]:
    """Return a test of a call's errors by its arguments, which are a tuple or keywords."""

    @pytest.mark.parametrize(("arguments", "message"), cases)
    def test(arguments: Any, message: str) -> None:
        with refusing(message):
            call(**arguments) if isinstance(arguments, dict) else call(*arguments)

    return test


def output_of(*command: Any, **options: Any) -> str:
    """Return what a process prints; an error fails the test."""
    words = [str(word) for word in command]
    done = subprocess.run(words, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stderr
    return done.stdout


def read_curve(folder: Path) -> pd.DataFrame:
    """Return the table of a tuner's generations."""
    return pd.read_csv(folder / "curve.csv", index_col="generation")


def jitted(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `jax.jit(function)` with results of NumPy: JAX compiles each index and comparison."""
    program = jax.jit(function)
    return lambda *arguments: jax.device_get(program(*arguments))


slow = partial(pytest.param, marks=pytest.mark.slow)  # values of a test that runs in .ci/slow


def diagonal(*axes: Sequence[Any]) -> list[Any]:
    """Return the product of axes as values of a test: a row for each value, the others slow."""
    quick = [tuple(x[i % len(x)] for x in axes) for i in range(max(map(len, axes)))]
    return [row if row in quick else slow(*row) for row in itertools.product(*axes)]


SEEDS = strategies.integers(0, 2**32 - 1)


def property_test(*arguments: strategies.SearchStrategy) -> Callable[..., Any]:
    """Return a decorator that runs a test for random arguments."""
    settings = hypothesis.settings(max_examples=16, deadline=None)
    return lambda test: settings(hypothesis.given(*arguments)(test))


# --- trials and sweeps ---------------------------------------------------------------------

FAST = preset(fidelity="fast")


@partial(jax.jit, static_argnames="steps")
def advance(
    stage: Any, worlds: Any, params: Any, trials: Trial, loop: ControlLoop, steps: int
) -> Trial:
    """Step one batch of worlds by up to `steps` control steps."""
    return trial.advance([(stage, worlds, params, trials)], loop, steps)[0]


def setting_of(horizon: float, engine: Any = "quasistatic") -> Setting:
    """Return a setting of trials that end after `horizon` [s]."""
    return Setting(engine, rules=Rules(horizon=horizon))


# The fused engine compiles fastest among the engines with contact dynamics.
SHORT = Setting("fused", FAST, rules=Rules(horizon=20.0))
# Near targets ahead, reached within a few seconds, and a perfect base.
_NEAR = "distance=0.7:0.72,bearing=-0.1:0.1,lateral=-0.03:0.03,com_offset=0:0,gap=0.02:0.02"
_PERFECT = {name: Range(0, 0) for name in domain.quantities_of("base")}
NEAR = replace(parse_domain(f"wide,{_NEAR}"), **_PERFECT)
SLOTS = 8  # equal in all sweeps, so that they share their programs
BOXES = parse_domain("wide,objects=random_box,distance=0.7:0.8,bearing=-0.5:0.5,gap=0:0.01")
CYLINDERS = replace(BOXES, objects=("random_cylinder",))
PLAN = Plan(BOXES, 20, {"rps": registry.LAWS["rps"], "nps": registry.LAWS["nps"]}, SHORT, part=7)


def case(
    target: tuple[float, float], name: str = "box", friction: str = "S1", **changes: Any
) -> Case:
    """Return a case of the law; changes are fields of `Case` or of the law's parameters."""
    fields = {k: changes.pop(k) for k in list(changes) if k in Case.__dataclass_fields__}
    return Case(name, friction, target, PAPER._replace(**changes), **fields)


def swept(folder: Path, plan: Plan = PLAN, **options: Any) -> Path:
    """Run a plan or one of its shards, and return the run folder."""
    open_run(folder, plan)
    execution.run_missing(folder, plan, slots=SLOTS, **options)
    return folder


def still(worlds: WorldBatch, *_):
    """Return a stepper of a live trial that stays at its start, without the program of a step."""
    start = jax.jit(partial(trial.start_all, law=worlds.law))
    return lambda inputs, *_: [start(*inputs, np.ones(1, bool))]


def results_of(laws: Sequence[str] = ("law",), **columns: Any) -> xr.Dataset:
    """Return results as of a sweep, from columns by law and world or by world."""
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    dims = ("law", "world")
    variables = {name: (dims[-array.ndim :], array) for name, array in arrays.items()}
    return xr.Dataset(variables, {"law": list(laws)})


def parts_of(folder: Path) -> dict[str, bytes]:
    """Return the contents of the parts in a run folder, by file name."""
    return {path.name: path.read_bytes() for path in (folder / "parts").iterdir()}


def observation(
    robot: Any, yaw: Any, contact: Any, in_contact: Any, target: Any, period: Any = 0.02
) -> Observation:
    """Return an observation of touch from numbers."""
    arrays = (jnp.asarray(x, float) for x in (robot, yaw, contact, target, period))
    robot, yaw, contact, target, period = arrays
    return Observation(robot, yaw, contact, jnp.asarray(in_contact), target, period)


def moved(
    touch: Observation, turn: float = 0.0, shift: Any = 0.0, mirror: bool = False
) -> Observation:
    """Return an observation of the world that is mirrored, turned [rad] and shifted [m]."""
    side, (c, s) = jnp.array([1.0, -1.0 if mirror else 1.0]), (np.cos(turn), np.sin(turn))
    place = lambda p: (p * side) @ jnp.array([[c, s], [-s, c]]) + jnp.asarray(shift)  # noqa: E731
    return touch._replace(
        p_world_robot=place(touch.p_world_robot),
        yaw=side[1] * touch.yaw + turn,
        p_robot_contact=touch.p_robot_contact * side,
        p_world_target=place(touch.p_world_target),
    )


@contextlib.contextmanager
def temporary_names() -> Iterator[None]:
    """Restore the registries at the end of the block."""
    tables = (
        objects.FAMILIES,
        objects.REGISTERED,
        registry.LAWS,
        registry._LAWS_BY_CLASS,
        domain.QUANTITIES,
        domain.LABELS,
        domain.REGISTERED,
        domain.OBJECT_QUANTITIES,
        tasks.TASKS,
        tasks.QUANTITIES,
        tasks.UNRANGED,
        tasks.OUTCOMES,
        tasks.FAILURES,
        quantity._OWNERS,
        engines._REGISTERED,
    )
    saved: list[Any] = [table.copy() for table in tables]
    try:
        yield
    finally:
        for table, content in zip(tables, saved, strict=True):
            table.clear()
            table.update(content)


# --- shapes before the robot ---------------------------------------------------------------

FRONT, SIDE = HALF_LENGTH, HALF_WIDTH  # [m] the front face is x = FRONT, the sides y = +-SIDE
SETTLED = 1e3  # [s] a period after which a skin's low-pass filter has forgotten its past


def box(x: Any, y: Any, half: float = 0.2, yaw: Any = 0.0) -> Footprint:
    """Return a square of half width `half` [m] about (x, y) [m]."""
    return fp.place(fp.rectangle(half, half), jnp.array([x, y]), jnp.float32(yaw))


def extent(footprint: Footprint, along: Any) -> jax.Array:
    """Return the support function: the furthest reach [m] in the unit direction `along` (2,)."""
    return jnp.max(footprint.vertices @ jnp.asarray(along)) + footprint.radius


@jitted
def sense(sensor: Any, footprint: Footprint) -> Any:
    """Return state and reading of a sensor of an object that has been there for a long time."""
    return sensor.sense(sensor.init(jax.random.key(0)), footprint, SETTLED)


@jax.jit
def place_before_the_front(shape: Footprint, yaw: Any, y: Any, gap: Any) -> Footprint:
    """Return `shape` turned by `yaw`, with its origin at `y` and `gap` to the front face."""
    turned = fp.place(shape, jnp.zeros(2), yaw)
    x = FRONT + gap + extent(turned, (-1.0, 0.0))
    return fp.place(turned, jnp.stack([x, jnp.asarray(y, x.dtype)]), 0.0)


# --- scripts -------------------------------------------------------------------------------


def imported(path: Path) -> Iterator[str]:
    """Yield the names of the package's modules that a script imports."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rps_jax"):
            yield str(node.module)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("rps_jax"))


def addresses() -> Iterator[tuple[str, str]]:
    """Yield module and name of each entry below the top level in the table of public names."""
    for line in (ROOT / "rps_jax" / "README.md").read_text().splitlines():
        if match := re.match(r"\| `(rps_jax[\w.]*)` \| (.*?) \|", line):
            yield from ((match[1], name) for name in re.findall(r"`(\w+)`", match[2]))


def inner_names(path: Path) -> set[str]:
    """Return the addresses of the package that a script uses and that are not public.

    Public are the names of the top level, the addresses of the README, and all members of a module
    that it lists.
    """
    public = {f"{module}.{name}" for module, name in addresses()}
    public |= {f"rps_jax.{name}" for name in rps_jax.__all__}
    nodes = list(ast.walk(ast.parse(path.read_text())))
    names, modules = set(), {}
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rps_jax"):
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                if name not in public and _is_module(name):
                    modules[alias.asname or alias.name] = name
                else:
                    names.add(name)
    for node in nodes:
        if isinstance(node, ast.Attribute):
            owner = ast.unparse(node.value)
            if owner in modules or (owner.startswith("rps_jax.") and _is_module(owner)):
                names.add(f"{modules.get(owner, owner)}.{node.attr}")
    return {x for x in names if x not in public and x.rpartition(".")[0] not in public}


def _is_module(address: str) -> bool:
    path = ROOT / address.replace(".", "/")
    return path.is_dir() or path.with_suffix(".py").exists()


def docstrings() -> list[str]:
    """Return the docstrings of the package."""
    return [
        ast.get_docstring(node) or ""
        for path in (ROOT / "rps_jax").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
    ]


# --- comparisons ---------------------------------------------------------------------------


def row(tree: Any, i: Any) -> Any:
    """Return a row or a slice of rows of every leaf."""
    return jax.tree.map(lambda leaf: leaf[i], tree)


def flatten(tree: Any) -> np.ndarray:
    """Return the leaves (n, ...) of a batch as vectors (n, D), the inverse of `unravel`."""
    leaves = jax.tree.leaves(jax.tree.map(np.asarray, tree))
    return np.concatenate([leaf.reshape(len(leaf), -1) for leaf in leaves], axis=1)


def central_differences(function: Callable[..., Any], x: np.ndarray, h: float) -> Any:
    """Return slopes of a batched function along each axis of x (n, D), and how much they bend."""
    slopes, bends = [], []
    for step in h * np.eye(x.shape[1]):
        up, middle, down = (np.asarray(function(x + sign * step)) for sign in (1, 0, -1))
        slopes.append((up - down) / (2 * h))
        bends.append(np.abs(up - 2 * middle + down) / h)
    return np.stack(slopes, -1), np.stack(bends, -1)


def same(a: Any, b: Any, **tolerances: float) -> None:
    """Assert that two trees are equal, bit for bit or within tolerances."""
    check = assert_allclose if tolerances else assert_array_equal
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        check(x, y, **tolerances)


def decode(path: Path) -> np.ndarray:
    """Return the images of a video (count, height, width, 3); JAX warns of the reader's fork."""
    reader = imageio_ffmpeg.read_frames(str(path))
    width, height = next(reader)["size"]
    return np.array([np.frombuffer(f, np.uint8).reshape(height, width, 3) for f in reader])
