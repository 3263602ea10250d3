"""What several studies of this project share: nothing here is a question of its own.

Studies of the paper's trials run one `Grid` of them under many `Condition`s, so that conditions are
compared trial by trial. Studies of speed time the programs of `BATCHED`, with every world being
pushed from the first step: the base begins at the object, and no trial has ended. `publish` writes
the data file of a published table.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import re
import shlex
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar

import jax
import numpy as np
import xarray as xr

from rps_jax import engines
from rps_jax.analysis import statistics
from rps_jax.app.cli import flags, names
from rps_jax.control import registry
from rps_jax.control.base import Params
from rps_jax.control.laws.rps import RPSParams
from rps_jax.errors import InputError
from rps_jax.record import files, provenance
from rps_jax.record.checkpoint import Parts
from rps_jax.record.options import option
from rps_jax.runs.question import Question, Run
from rps_jax.trials import pushes, trial
from rps_jax.trials.case import Case
from rps_jax.trials.progress import Progress, Report, unheard
from rps_jax.trials.results import outcome_dataset
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Loop, Trial, World
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.world import draws, paper
from rps_jax.world.domain import DOMAINS, QUANTITIES, Range
from rps_jax.world.objects import PAPER_OBJECTS
from rps_jax.world.physics import MUJOCOS_GROUND, Physics, preset
from rps_jax.world.scene import FRICTION, Friction

T = TypeVar("T", covariant=True)


@dataclass(frozen=True, kw_only=True)
class Study(Question[T]):
    """A question about this project, whose run can grow in some of its options."""

    GROWS: ClassVar[tuple[str, ...]] = ()  # options of which a run folder may be asked for more

    def configuration(self) -> dict[str, Any]:
        """All that the parts of the answer depend on, as JSON."""
        found = super().configuration()
        return {name: value for name, value in found.items() if name not in self.GROWS}


@dataclass(frozen=True, kw_only=True)
class Trials(Study[T]):
    """A question about this project that is answered by trials in many settings."""

    slots: int | None = option(None, 1, 10_000_000, kw_only=True)
    """Number of worlds that one worker steps at once; by default as suits engine and device."""
    workers: int | None = option(None, 1, 1024, kw_only=True)
    """Number of host threads that drive worlds; by default as suits engine and device."""
    quick: bool = False
    """Whether to make a small run of minutes on two cores: what is not asked for becomes small."""

    def check(self) -> None:
        """Check slots and workers."""

    def run_in(self, out: Path | None, report: Report) -> Run:
        """Where and how the answer is made."""
        return Run(out, report, self.slots, self.workers)


# --- the paper's trials under changed conditions -------------------------------------------

# Trials run at once: more keep the device busier, fewer lose less when killed.
_TOGETHER = {"cpu": 600, "gpu": 100_000}


class Grid(NamedTuple):
    """Which trials, in the nesting order of `outcome_dataset`."""

    laws: tuple[str, ...] = ("rps",)
    objects: tuple[str, ...] = PAPER_OBJECTS
    friction: Mapping[str, Friction] = FRICTION
    targets: tuple[tuple[float, float], ...] = paper.TARGETS

    @property
    def size(self) -> int:
        """Trials."""
        return len(self.laws) * len(self.objects) * len(self.friction) * len(self.targets)


@dataclass(frozen=True)
class Condition:
    """What one row changes: of the setting, of the law's parameters, of every case."""

    what: str
    setting: Setting = Setting(engine="mjx")
    params: Mapping[str, float] = field(default_factory=dict)  # of RPS, also within other laws
    case: Mapping[str, Any] = field(default_factory=dict)  # skin, gap, rear, bearing, ...

    def cases(self, grid: Grid) -> list[Case]:
        """The trials of a grid under this condition."""
        changed = {name: self._changed(registry.LAWS[name]) for name in grid.laws}
        return [
            Case(name, friction, target, changed[law], **self.case)
            for law in grid.laws
            for name in grid.objects
            for friction in grid.friction.values()
            for target in grid.targets
        ]

    def allowed(self, laws: Sequence[str]) -> bool:
        """Whether the changed parameters mean something to every law."""
        try:
            for params in (self._changed(registry.LAWS[name]) for name in laws):
                registry.law_of(params).check(params)
        except InputError:
            return False
        return True

    def _changed(self, params: Params) -> Params:
        """Parameters of RPS, or of a law that has RPS within, with the changes; others as is."""
        if isinstance(params, RPSParams):
            return params._replace(**self.params)
        within = getattr(params, "law", None)
        if isinstance(within, RPSParams):
            return params._replace(law=within._replace(**self.params))
        return params


def run_conditions(
    conditions: Mapping[str, Condition],
    grid: Grid,
    folder: Path | None,
    *,
    slots: int | None = None,
    workers: int | None = None,
    report: Report = unheard,
) -> xr.Dataset:
    """Outcomes (condition, law, object, friction, target), run or found in `folder`.

    Without a folder all is kept in memory. Each condition is a part of the folder as soon as it is
    done; the same call computes only what is missing.

    Raises:
      InputError: the folder holds a condition of the same name that was run otherwise.
    """
    parts = None if folder is None else Parts(folder)
    found = {name: parts and _load(parts, name, c, grid) for name, c in conditions.items()}
    missing = [name for name, results in found.items() if results is None]
    finished, simulated = grid.size * (len(found) - len(missing)), 0.0
    report(Progress(finished, simulated))
    for chunk in _chunks(missing, conditions, grid):
        cases = [case for name in chunk for case in conditions[name].cases(grid)]

        def tell(progress: Progress, before=(finished, simulated)) -> None:
            report(Progress(before[0] + progress.finished, before[1] + progress.simulated))

        outcome, timing = pushes.run(
            cases, conditions[chunk[0]].setting, slots=slots, workers=workers, report=tell
        )
        finished, simulated = finished + len(cases), simulated + timing.simulated
        for i, name in enumerate(chunk):
            rows = slice(i * grid.size, (i + 1) * grid.size)
            part = type(outcome)(*(values[rows] for values in outcome))
            results = outcome_dataset(
                part, grid.laws, grid.objects, tuple(grid.friction), grid.targets
            )
            # Shared by all that ran together.
            share = grid.size / len(cases)
            results.attrs = {
                "run_as": _fingerprint(conditions[name], grid),
                "run_time": timing.run * share,
                "simulated": timing.simulated * share,
            }
            if parts is not None:
                parts.put(name, files.encoded(results))
            found[name] = results
    done = {name: results for name, results in found.items() if results is not None}
    whole = xr.concat(
        [results.drop_attrs(deep=False) for results in done.values()],
        xr.DataArray(list(done), dims="condition", name="condition"),
    )
    for attribute in ("run_time", "simulated"):
        values = [results.attrs[attribute] for results in done.values()]
        whole = whole.assign_coords({attribute: ("condition", values)})
    return whole.assign_coords(what=("condition", [conditions[name].what for name in done]))


def _fingerprint(condition: Condition, grid: Grid) -> str:
    """All that the outcomes depend on, as text."""
    same = replace(condition, what="", params=dict(condition.params), case=dict(condition.case))
    return f"{same!r} {grid._replace(friction=dict(grid.friction))!r}"


def _load(parts: Parts, name: str, condition: Condition, grid: Grid) -> xr.Dataset | None:
    """A condition's results, if it is among the finished parts."""
    if (content := parts.get(name)) is None:
        return None
    results = files.decoded(content, parts.folder / name, own=True)
    if results.attrs.get("run_as") != _fingerprint(condition, grid):
        raise InputError(
            f"{parts.folder / name}-*.nc was run with other options: choose another folder, or "
            "delete it to run again."
        )
    return results


def _chunks(
    names: Sequence[str], conditions: Mapping[str, Condition], grid: Grid
) -> list[list[str]]:
    """Names of conditions to run together: of one setting, and not too many."""
    groups: dict[Setting, list[str]] = {}
    for name in names:
        groups.setdefault(conditions[name].setting, []).append(name)
    at_once = max(1, _TOGETHER.get(jax.default_backend(), 600) // grid.size)
    return [
        group[i : i + at_once] for group in groups.values() for i in range(0, len(group), at_once)
    ]


def condition_rows(results: xr.Dataset, baseline: str, law: str = "rps") -> list[list[str]]:
    """Header and one row for each condition: counts, interval, median time, and the difference.

    The last column says how outcomes differ from the baseline's, and whether significantly:
    McNemar's exact test, false discoveries among all rows held at 5 % (Benjamini-Hochberg).
    """
    part = results.sel(law=law)
    base = part.success.sel(condition=baseline)
    names = [str(name) for name in part.condition.values]
    against = [statistics.compare(base, part.success.sel(condition=name)) for name in names]
    others = [i for i, name in enumerate(names) if name != baseline]
    q = np.ones(len(names))
    q[others] = statistics.false_discovery([against[i].p for i in others])
    objects = [str(o) for o in part.object.values]
    header = ["reading", *objects, "all", "95 %", "median time", "against the first"]
    table = [header]
    for i, name in enumerate(names):
        one = part.sel(condition=name)
        won = one.success.values.astype(bool)
        counts = one.success.sum("target").transpose("object", "friction").values.astype(int)
        low, high = statistics.wilson(int(won.sum()), won.size)
        time = one.time.values[won]
        difference = (
            ""
            if name == baseline
            else f"+{against[i].gained} -{against[i].lost}, q = {q[i]:.2g}"
            + (" *" if q[i] < 0.05 else "")
        )
        table.append(
            [
                str(one.what.values),
                *(" ".join(map(str, row)) for row in counts),
                f"{won.sum()} of {won.size}",
                f"{100 * low:.0f}-{100 * high:.0f} %",
                f"{np.median(time):.1f} s" if time.size else "-",
                difference,
            ]
        )
    return table


# --- programs whose speed is measured ------------------------------------------------------

FAMILIES = ("box", "cylinder", "prism")
_PRISMS = replace(
    DOMAINS["paper"], objects=("random_prism",), frictions=(FRICTION["S1"],), gap=Range(0.0, 0.0)
)
_MUJOCOS_OWN = Physics(
    timestep=0.002,
    cone="pyramidal",
    impratio=1.0,
    iterations=100,
    ls_iterations=50,
    tolerance=1e-8,
    **MUJOCOS_GROUND,
)
# What is timed, batched on JAX's device.
BATCHED = {
    "fused standard": Setting(engine="fused"),
    "fused fast": Setting(engine="fused", physics=preset(fidelity="fast")),
    "warp standard": Setting(engine="warp"),
    "warp fast": Setting(engine="warp", physics=preset(fidelity="fast")),
    "quasistatic": Setting(engine="quasistatic"),
    "mjx standard": Setting(engine="mjx"),
    "mjx fast": Setting(physics=preset(fidelity="fast"), engine="mjx"),
    "mjx, MuJoCo's defaults": Setting(physics=_MUJOCOS_OWN, engine="mjx"),
}


def timed_worlds(family: str, count: int, setting: Setting) -> tuple[Any, World]:
    """Stage and worlds (count, ...): the paper's targets under S1, a box, a cylinder or prisms."""
    if family == "prism":
        drawn = draws.draw(_PRISMS, 0, np.arange(count))
        part = drawn_worlds(_PRISMS, drawn, RPSParams.paper(), setting)
        return part.stage, part.worlds
    targets = paper.TARGETS
    cases = [Case(family, FRICTION["S1"], targets[i % len(targets)], gap=0) for i in range(count)]
    return pushes.build(cases, setting)


class Program(NamedTuple):
    """What is timed on JAX's device: a full batch, `simulated` [s] of each world at a go."""

    name: str
    family: str
    worlds: int
    simulated: float
    compile: float  # [s]
    memory: float  # [bytes] of its arguments, results and all in between
    contacts: int
    physics: Physics
    go: Callable[[Trial], Trial]
    start: Trial
    text: Callable[[], str | None]  # of the compiled program, if it has one


def traced(
    name: str,
    setting: Setting,
    family: str,
    worlds: int,
    *,
    simulated: float = 2.0,
    stage: Callable[[Any], Any] = lambda stage: stage,
    donated: bool = True,
    flags: dict[str, Any] | None = None,
) -> Callable[[], Program]:
    """What compiles a program that has been traced.

    Args:
      name: of the program, for tables.
      setting: physics and engine.
      family: of the worlds.
      worlds: how many.
      simulated: [s] of each world at a go.
      stage: changes the engine's stage.
      donated: whether the state of the worlds is overwritten at each go.
      flags: of XLA.
    """
    physics = setting.physics
    usual, few = timed_worlds(family, len(paper.TARGETS), setting)
    rows = np.arange(worlds) % len(paper.TARGETS)
    batch = jax.device_put(jax.tree.map(lambda leaf: leaf[rows], few))
    start = trial.start_all(batch, np.ones(worlds, bool))
    shared, steps = stage(usual), round(simulated / physics.control_period)
    began = time.perf_counter()

    # A new one: what was jitted before gives back what it has traced for such arguments.
    def advance(stage: Any, worlds: World, trials: Trial) -> Trial:
        return trial.advance((stage,), (worlds,), (trials,), Loop(physics), steps)[0]

    lowered = jax.jit(advance, donate_argnums=2 if donated else ()).lower(shared, batch, start)
    tracing = time.perf_counter() - began

    def compile_() -> Program:
        began = time.perf_counter()
        program = lowered.compile(compiler_options=flags)
        took = tracing + time.perf_counter() - began
        needs: Any = program.memory_analysis()
        parts = ("argument", "output", "temp")
        memory = sum(getattr(needs, f"{part}_size_in_bytes") for part in parts)
        corners = few.footprint.vertices.shape[-2]  # 1 of a cylinder
        contacts = engines.get(setting.engine).contacts(usual, corners)
        go = partial(program, shared, batch)
        return Program(
            name, family, worlds, simulated, took, memory, contacts, physics, go, start,
            program.as_text,
        )  # fmt: skip

    return compile_


def side_by_side(
    programs: Sequence[Callable[[], Callable[[], Program]]], at_once: int
) -> Iterator[Program]:
    """Programs in their order, `at_once` of them compiled side by side.

    Each call is of `traced`, and is made when its turn has come, one after the other. While the
    caller holds a program nothing is compiled, so that it can be timed.
    """
    with ThreadPoolExecutor(at_once) as pool:
        for first in range(0, len(programs), at_once):
            jobs = [pool.submit(trace()) for trace in programs[first : first + at_once]]
            wait(jobs)
            for job in jobs:
                yield job.result()


def machine() -> str:
    """Where speeds were measured, in a sentence."""
    return f"On {jax.devices()[0].device_kind}, {provenance.processors()} processors."


# --- published tables ----------------------------------------------------------------------

_VERSIONS = ("rps_jax", "jax", "mujoco", "mujoco-mjx")


def publish(
    path: Path,
    made: Sequence[Mapping[str, Any]],
    device: str,
    columns: Sequence[Mapping[str, Any]],
    rows: Sequence[Sequence[Any]],
    note: str = "",
) -> Path:
    """Write the data file of a table, which `render_tables.py` shows on the pages.

    Args:
      path: `results/NAME.json` of a study's folder.
      made: what each run behind it was made by, as `provenance.signed` tells of its folder.
      device: what they ran on, in words.
      columns: names and formats.
      rows: one cell for each column.
      note: what a reader of the numbers should know.
    """
    last, asked = made[-1], [one["command"] for one in made]
    commands = [_placeless(one, asked) for one in asked]
    noted = {}
    with contextlib.suppress(InputError):  # a script of one's own has no digest, and loses no run
        noted["digest"] = digest(commands)
    data = {
        "command": [shlex.join(one) for one in commands],
        "device": device,
        "versions": {name: last["packages"][name] for name in _VERSIONS},
        "commit": last["commit"],
        **noted,
        "date": last["time"][:10],
        **({"note": note} if note else {}),
        "columns": list(columns),
        "rows": list(rows),
    }
    path.parent.mkdir(exist_ok=True)
    return files.write_text(path, json.dumps(data, indent=1) + "\n")


def digest(commands: Sequence[Sequence[str]]) -> str:
    """What numbers hang on, in 16 letters: the questions, and the laws and domains they name.

    It is made of declared values alone (parameters, ranges, physics, rules, seeds), so that it
    lasts where code is only written anew, and changes where a default or a tuned law does.

    Raises:
      InputError: a command asks no question of today, or asks it in other words.
    """
    found: list[Any] = []
    for program, *words in commands:
        if program != "rps":
            raise InputError(
                f"command = {program} is not allowed: a digest is of rps NAME or PATH."
            )
        if _reads(_apart(words)[0]):  # a run, whose command stands beside it
            found.append(words)
            continue
        name, rest = names.split(words)
        asked, _ = flags.parse(names.question_of(name), name, rest)
        found.append(_declared(asked.asked().configuration()))
    return hashlib.sha256(json.dumps(found, sort_keys=True).encode()).hexdigest()[:16]


def _declared(value: Any) -> Any:
    """A configuration, with the names of laws and domains followed by what they stand for."""
    if isinstance(value, dict):  # a quantity that is not drawn is none, also one that is new
        drawn = (item for item in value.items() if item[1] is not None or item[0] not in QUANTITIES)
        return {key: _declared(one) for key, one in drawn}
    if isinstance(value, list | tuple):
        return [_declared(one) for one in value]
    if isinstance(value, str) and value in DOMAINS:
        ranges = dataclasses.asdict(DOMAINS[value])
        return [value, {name: one for name, one in ranges.items() if one is not None}]
    if isinstance(value, str) and value in registry.LAWS:
        return [value, registry.recorded(registry.LAWS[value])]
    return value


def _apart(command: Sequence[str]) -> tuple[list[str], str]:
    """Words of a command without its run folder, and that."""
    if "--out" not in command:
        return list(command), ""
    at = list(command).index("--out")
    return [*command[:at], *command[at + 2 :]], "".join(command[at + 1 : at + 2])


def _reads(words: Sequence[str], folder: str = "runs") -> bool:
    """Whether a command reads a run folder, or a file of it."""
    return any(re.search(rf"(^|,){re.escape(folder)}(/|$)", word) for word in words)


def _placeless(command: Sequence[str], others: Sequence[Sequence[str]]) -> list[str]:
    """Words of a command without its run folder, which is a place of one machine, unless others
    read it."""
    words, folder = _apart(command)
    read = folder and any(_reads(_apart(other)[0], folder) for other in others)
    return list(command) if read else words
