"""Many random worlds in a run folder that can be killed and continued, split and merged.

The design is paired: every arm (a strategy with its parameters) meets the same worlds. Trials are
kept in parts: a part is one file, written whole as soon as its last trial has ended, named by the
hash of its content. A part that is there is not run again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import functools
import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5netcdf
import h5py
import numpy as np
import xarray as xr

from rps_jax import analysis, domain, engines, errors, figures, record, score, slots, trial
from rps_jax.domain import Domain
from rps_jax.errors import InputError
from rps_jax.physics import Physics
from rps_jax.report import Section
from rps_jax.report import write_report as _write
from rps_jax.scene import Scene
from rps_jax.slots import Job, Part, Progress, Setting, Timing
from rps_jax.trial import Outcome, Params, Rules

MANIFEST = "manifest.json"
_TYPES = {"success": np.int8, "diverged": np.int8}  # of an outcome; the others are float32


@dataclass(frozen=True)
class Plan:
    """What is run: every arm in the worlds 0 to `worlds` - 1 of a domain."""

    domain: Domain
    worlds: int
    arms: Mapping[str, Params]
    setting: Setting = Setting()  # its seed draws the worlds, too
    part: int = 1024  # trials of a part, at most

    def __post_init__(self) -> None:
        """Raises InputError for no worlds or no arms."""
        errors.check_finite("worlds", self.worlds, at_least=1, at_most=1e9)
        errors.check_finite("part", self.part, at_least=1, at_most=1e6)
        if not self.arms:
            raise InputError("arms = {} is not allowed: name at least one strategy.")

    @property
    def trials(self) -> int:
        """How many: trial a * worlds + i is of arm a in world i."""
        return len(self.arms) * self.worlds

    @functools.cached_property
    def blocks(self) -> int:
        """Parts of one arm and one object, at most."""
        return math.ceil(self.worlds_of(0).size / self.part)

    def worlds_of(self, which: int) -> np.ndarray:
        """Indices of the worlds with the object `which` of the domain, in order."""
        every = np.arange(self.worlds)
        return every[self.domain.object_of(every) == which]

    @functools.cached_property
    def parts(self) -> dict[int, np.ndarray]:
        """Numbers of the trials of every part, by the part's number."""
        found = {}
        for which in range(len(self.domain.objects)):
            of_object = self.worlds_of(which)
            for arm in range(len(self.arms)):
                for block in range(math.ceil(of_object.size / self.part)):
                    some = of_object[block * self.part : (block + 1) * self.part]
                    number = (arm * len(self.domain.objects) + which) * self.blocks + block
                    found[number] = arm * self.worlds + some
        return found

    def configuration(self) -> dict[str, Any]:
        """All that the results depend on, as JSON."""
        whole = {
            "domain": dataclasses.asdict(self.domain),
            "worlds": self.worlds,
            "arms": {
                name: {"strategy": type(params).__name__} | _numbers(params)
                for name, params in self.arms.items()
            },
            "physics": dataclasses.asdict(self.setting.physics),
            "rules": _numbers(self.setting.rules),
            "seed": self.setting.seed,
            "engine": self.setting.engine,
            "part": self.part,
        }
        return json.loads(json.dumps(whole))


def _numbers(fields: Any) -> dict[str, float]:
    return {name: float(value) for name, value in fields._asdict().items()}


@dataclass(frozen=True)
class Shard:
    """One of several shares of a run, to be merged: parts number, number + of, ..."""

    number: int = 1
    of: int = 1

    def __post_init__(self) -> None:
        """Raises InputError unless 1 <= number <= of."""
        errors.check_finite("shard", self.of, at_least=1, at_most=1e6)
        errors.check_finite("shard", self.number, at_least=1, at_most=self.of)


# --- the run folder ------------------------------------------------------------------------


def open_run(folder: Path, plan: Plan) -> Path:
    """The run folder with the plan in it; a folder that has one must have the same.

    Raises:
      InputError: it cannot be written, or holds a run of another configuration; or the plan's
        engine cannot run it on this machine.
    """
    engines.check(plan.setting.engine, plan.domain.families)
    record.writable(folder)
    wanted = plan.configuration()
    if (folder / MANIFEST).exists():
        found = _manifest(folder)
        if found != wanted:
            raise InputError(
                f"out = {folder} holds another run ({_difference(found, wanted)}): choose another "
                "folder, or ask for the same."
            )
    else:
        record.write_json(folder / MANIFEST, wanted)
    (folder / "parts").mkdir(exist_ok=True)
    return folder


def _manifest(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    try:
        return json.loads(path.read_text())
    except FileNotFoundError as error:
        raise InputError(
            f"run = {folder} holds no {MANIFEST}: give the folder of a run."
        ) from error
    except ValueError as error:
        raise InputError(
            f"{path} is corrupt ({error}): restore it, or choose another folder."
        ) from error


def _difference(found: Any, wanted: Any, path: str = "") -> str:
    """The first few differences of two JSON values, in words."""
    differences = list(_differences(found, wanted, path))
    more = f" and {len(differences) - 3} more" if len(differences) > 3 else ""
    return "; ".join(differences[:3]) + more


def _differences(found: Any, wanted: Any, path: str) -> Iterator[str]:
    if isinstance(found, dict) and isinstance(wanted, dict):
        for key in [*found, *(k for k in wanted if k not in found)]:
            yield from _differences(
                found.get(key), wanted.get(key), f"{path}.{key}" if path else key
            )
    elif found != wanted:
        yield f"{path} = {found} there, {wanted} asked for"


def load_plan(folder: Path) -> Plan:
    """The plan of a run folder.

    Raises:
      InputError: it holds none, or a corrupt one.
    """
    found = _manifest(folder)
    try:
        physics: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in found["physics"].items()
        }
        return Plan(
            domain.from_json(found["domain"]),
            found["worlds"],
            {name: _params(dict(arm)) for name, arm in found["arms"].items()},
            Setting(Physics(**physics), Rules(**found["rules"]), found["seed"], found["engine"]),
            found["part"],
        )
    except (KeyError, TypeError) as error:
        raise InputError(
            f"{folder / MANIFEST} is corrupt ({error}): restore it, or choose another folder."
        ) from error


def _params(arm: dict[str, Any]) -> Params:
    name = arm.pop("strategy")
    (kind,) = [kind for kind in trial.STRATEGIES if kind.__name__ == name]
    return kind(**arm)


@contextlib.contextmanager
def lock(folder: Path, shard: Shard = Shard()) -> Iterator[None]:
    """Hold a run folder, or one shard of it, against other processes.

    Raises:
      InputError: another process holds it.
    """
    with open(folder / f".lock-{shard.number}-{shard.of}", "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(
                f"out = {folder} is in use by another process: wait for its end, or choose "
                "another folder."
            ) from error
        yield


def finished(folder: Path) -> dict[int, Path]:
    """Files of the parts that are done; one whose content is not what was written is set aside."""
    found = {}
    for path in sorted((folder / "parts").glob("[0-9]*-*.nc")):
        number, _, digest = path.stem.partition("-")
        if _digest(path) == digest:
            found[int(number)] = path
        else:
            path.rename(path.with_suffix(".nc.corrupt"))
    return found


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


@dataclass
class _Parts:
    """Trials on their way into the files of their parts."""

    folder: Path
    parts: dict[int, np.ndarray]  # numbers of the trials of each part still to be done
    _part_of: dict[int, int] = field(default_factory=dict)
    _open: dict[int, dict[int, Outcome]] = field(default_factory=dict)

    def start(self, number: int) -> np.ndarray:
        """Numbers of the trials of a part that is now begun."""
        trials = self.parts[number]
        self._part_of.update(dict.fromkeys(map(int, trials), number))
        return trials

    def collect(self, numbers: np.ndarray, outcomes: Outcome) -> None:
        """Outcomes of trials that ended; writes the parts that are complete with them."""
        for i, trial_number in enumerate(map(int, numbers)):
            part = self._part_of.pop(trial_number)
            rows = self._open.setdefault(part, {})
            rows[trial_number] = Outcome(*(leaf[i] for leaf in outcomes))
            if len(rows) == self.parts[part].size:
                self._write(part, self._open.pop(part))

    def _write(self, part: int, rows: dict[int, Outcome]) -> None:
        numbers = self.parts[part]
        leaves = zip(*(rows[int(n)] for n in numbers), strict=True)
        content: dict[str, Any] = {"trial": ("row", numbers)}
        for name, values in zip(Outcome._fields, leaves, strict=True):
            stacked = np.stack(values).astype(_TYPES.get(name, np.float32))
            content[name] = (("row", "pose")[: stacked.ndim], stacked)
        place = self.folder / "parts"
        path = record.write_results(place / f"{part:07d}.nc.new", xr.Dataset(content))
        path.rename(place / f"{part:07d}-{_digest(path)}.nc")


# --- running -------------------------------------------------------------------------------


def run(
    folder: Path,
    plan: Plan,
    *,
    shard: Shard = Shard(),
    report: Callable[[Progress], Any] = lambda progress: None,
    **shape: Any,
) -> Timing:
    """Run what is missing of a plan, or of one shard of it, in a folder that `open_run` opened."""
    mine, done = share(plan, shard), finished(folder)
    before = sum(trials.size for n, trials in mine.items() if n in done)
    report(Progress(before, 0.0))
    parts = _Parts(folder, {n: trials for n, trials in mine.items() if n not in done})
    # Of each kind the parts to do, and the trials of the whole plan: whatever is left of a run, it
    # has the slots of the whole, and so its bits.
    jobs: dict[Any, list[int]] = {}
    sizes: Counter[Any] = Counter()
    for number, trials in plan.parts.items():
        arm, which = _arm_and_object(plan, number)
        kind = (which, type(list(plan.arms.values())[arm]))
        sizes[kind] += trials.size
        if number in parts.parts:
            jobs.setdefault(kind, []).append(number)

    def tell(progress: Progress) -> None:
        report(Progress(before + progress.finished, progress.simulated))

    return slots.run(
        [
            Job(trial.STRATEGIES[kind[1]], sizes[kind], _made(plan, parts, numbers))
            for kind, numbers in jobs.items()
        ],
        plan.setting,
        collect=parts.collect,
        report=tell,
        **shape,
    )


def share(plan: Plan, shard: Shard) -> dict[int, np.ndarray]:
    """The parts of one shard: numbers of their trials, by the part's number."""
    every = plan.parts.items()
    return {n: trials for i, (n, trials) in enumerate(every) if i % shard.of == shard.number - 1}


def _arm_and_object(plan: Plan, part: int) -> tuple[int, int]:
    return divmod(part // plan.blocks, len(plan.domain.objects))


def _made(plan: Plan, parts: _Parts, numbers: list[int]) -> Iterator[Part]:
    """The worlds of parts, made one part at a time."""
    for number in numbers:
        trials = parts.start(number)
        arm, _ = _arm_and_object(plan, number)
        yield world_part(plan, arm, trials % plan.worlds)._replace(numbers=trials)


def scene_of(plan: Plan, index: int) -> Scene:
    """The compiled scene of one world, for pictures."""
    drawn = domain.draw(plan.domain, plan.setting.seed, [index])
    family = plan.domain.family_of(index)
    return engines.scene_of_solid(family, drawn.solid, drawn.friction, plan.setting.physics, 0)


def title_of(plan: Plan, index: int) -> str:
    """What one world is, in words."""
    drawn = domain.table(domain.draw(plan.domain, plan.setting.seed, [index]))
    name = plan.domain.objects[int(plan.domain.object_of(np.asarray(index)))].replace("_", " ")
    value = {key: float(values[0]) for key, (values, _) in drawn.items()}
    return (
        f"world {index}: {name}, {value['mass']:.1f} kg, $\\mu$ ground "
        f"{value['friction_ground']:.2f}, robot {value['friction_robot']:.2f}"
    )


def world_part(plan: Plan, arm: int, index: Any) -> Part:
    """Worlds of one object, by their indices, with the parameters of an arm."""
    drawn = domain.draw(plan.domain, plan.setting.seed, index)
    return domain.worlds(plan.domain, drawn, list(plan.arms.values())[arm], plan.setting)


# --- results -------------------------------------------------------------------------------


def merge(folders: list[Path], out: Path) -> Path:
    """One `results.nc` of all parts in run folders of one plan: (arm, world), and (world) drawn.

    It is written part by part, so that memory does not grow with the number of worlds.

    Raises:
      InputError: the folders differ in their plan, or parts are missing.
    """
    manifest = _manifest(folders[0])
    for other in folders[1:]:
        if (theirs := _manifest(other)) != manifest:
            raise InputError(
                f"run = {other} is of another plan than {folders[0]} "
                f"({_difference(manifest, theirs)}): merge shards of one run."
            )
    plan = load_plan(folders[0])
    found = {n: path for folder in folders for n, path in finished(folder).items()}
    missing = [n for n in plan.parts if n not in found]
    if missing:
        raise InputError(
            f"run = {', '.join(map(str, folders))} lacks {len(missing)} of {len(plan.parts)} "
            "parts: run the same command again, or give the folders of all shards."
        )
    return record.atomic(out / "results.nc", lambda path: _write_results(path, plan, found))


def _write_results(path: Path, plan: Plan, found: dict[int, Path]) -> None:
    with h5netcdf.File(path, "w") as file:
        sizes = {"arm": len(plan.arms), "world": plan.worlds, "pose": 3}
        file.dimensions = sizes | {"object": len(plan.domain.objects)}
        names = {"arm": list(plan.arms), "object": list(plan.domain.objects)}
        for name, values in names.items():
            file.create_variable(name, (name,), h5py.string_dtype(), data=np.array(values, object))
        every = np.arange(plan.worlds)
        file.create_variable("world", ("world",), data=every)
        which = plan.domain.object_of(every).astype(np.int16)
        file.create_variable("which_object", ("world",), data=which)
        outcomes, drawn = {}, {}
        for name, (unit, meaning) in score.UNITS.items():
            dims = ("arm", "world", "pose") if name.endswith("pose") else ("arm", "world")
            outcomes[name] = file.create_variable(name, dims, _TYPES.get(name, np.float32))
            outcomes[name].attrs.update(units=unit, long_name=meaning)
        for number, source in found.items():
            arm, _ = _arm_and_object(plan, number)
            part = record.read(source)
            world = part.trial.values % plan.worlds
            for name, variable in outcomes.items():
                _put(variable, (arm,), world, part[name].values)
            if arm == 0:
                columns = domain.table(domain.draw(plan.domain, plan.setting.seed, world))
                for name, (values, unit) in columns.items():
                    if name not in drawn:
                        drawn[name] = file.create_variable(name, ("world",), np.float32)
                        drawn[name].attrs["units"] = unit
                    _put(drawn[name], (), world, values)


def _put(variable: h5netcdf.Variable, at: tuple[int, ...], world: np.ndarray, values: Any) -> None:
    """Write the rows of some worlds, which are in order but seldom adjacent."""
    span = slice(int(world[0]), int(world[-1]) + 1)
    rows = variable[(*at, span)]
    rows[world - world[0]] = values
    variable[(*at, span)] = rows


def write_report(folder: Path) -> Path:
    """`report.md`, `report.html` and the figure of a run folder with results; returns the first."""
    plan, results = load_plan(folder), record.read_results(folder)
    environment = json.loads((folder / "environment.json").read_text())
    picture = figures.success_curves(results, folder / "success.png")
    intro = (
        f"{plan.worlds} worlds, seed {plan.setting.seed}, engine {plan.setting.engine}, "
        f"{1000 * plan.setting.physics.timestep:g} ms steps; every arm meets the same worlds. "
        "Intervals: Wilson 95 %.\n\n"
        f"Made by `{' '.join(environment['command'])}`, commit {environment['commit']}, "
        f"{environment['time']}, on {environment['device']['kind']} with "
        f"{environment['processors']} processors."
    )
    failures = (
        "CVaR: mean over the worst 5 % of worlds of the least distance between contact point and "
        "target; of an object that was never touched, the whole way."
    )
    hard = "Worlds in which most arms fail, and most distance is left."
    sections = [
        Section("Success", failures, analysis.rates(results, float(plan.setting.rules.max_lost))),
        Section("Success against what was drawn", "", (), picture),
        Section("The hardest worlds", hard, analysis.hardest_table(results, str(folder))),
    ]
    if len(plan.arms) > 1:
        paired = Section("Differences, world by world", "", analysis.differences(results))
        sections.insert(1, paired)
    _write(folder, "Sweep over random worlds", intro, sections)
    return folder / "report.md"
