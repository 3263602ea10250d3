"""Many random worlds in a run folder that can be killed and continued, split and merged.

The design is paired: every arm (a strategy with its parameters) meets the same worlds. Trials are
kept in parts: a part is one file, written whole as soon as its last trial has ended, named by the
hash of its content. A part that is there is not run again.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from rps_jax.trials.worlds import drawn_scene, drawn_worlds
from rps_jax import errors
from rps_jax.analysis import statistics
from rps_jax.world import domain
from rps_jax.analysis import figures
from rps_jax.record import files, provenance
from rps_jax.record import folder as run_folder
from rps_jax.record.checkpoint import Parts
from rps_jax.analysis import tables
from rps_jax.trials import batch
from rps_jax.control import strategies
from rps_jax.world.domain import Domain
from rps_jax.errors import InputError
from rps_jax.world.physics import Physics
from rps_jax.analysis.report import Section
from rps_jax.analysis.report import write_report as _write
from rps_jax.world.scene import Scene
from rps_jax.trials.batch import Job, Part
from rps_jax.trials.setting import Progress, Setting, Timing
from rps_jax.control.strategies import Params
from rps_jax.trials.trial import Outcome, Rules

Kind = tuple[int, type]  # of a part: the object's number and the type of the arm's parameters
Keep = Callable[[int, bytes], Any]  # called with the number and the content of a part
# Of an outcome; the others are float32.
_TYPES = dict.fromkeys(("success", "tipped", "diverged"), np.int8) | {"overflows": np.int32}


@dataclass(frozen=True)
class Plan:
    """What is run: every arm in the worlds 0 to `worlds` - 1 of a domain."""

    domain: Domain
    worlds: int
    arms: Mapping[str, Params]
    setting: Setting = Setting()  # its seed draws the worlds, too
    part: int = 1024  # trials of a part, at most

    def __post_init__(self) -> None:
        """Raises InputError for no worlds, no arms, or parameters that mean nothing."""
        errors.check_count("worlds", self.worlds, at_most=1_000_000_000)
        errors.check_count("part", self.part, at_most=1_000_000)
        if not self.arms:
            raise InputError("arms = {} is not allowed: name at least one strategy.")
        for params in self.arms.values():
            strategies.of(params).check(params)

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

    def arm_and_object(self, part: int) -> tuple[int, int]:
        """Which arm a part is of, and which object."""
        return divmod(part // self.blocks, len(self.domain.objects))

    def kind(self, part: int) -> Kind:
        """Parts of a kind are run by one compiled program."""
        arm, which = self.arm_and_object(part)
        return which, type(list(self.arms.values())[arm])

    @functools.cached_property
    def sizes(self) -> Counter[Kind]:
        """How many trials of each kind there are."""
        counts: Counter[Kind] = Counter()
        for number, trials in self.parts.items():
            counts[self.kind(number)] += trials.size
        return counts

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
        return whole


def _numbers(fields: Any) -> dict[str, float]:
    return {name: float(value) for name, value in fields._asdict().items()}


@dataclass(frozen=True)
class Shard:
    """One of several shares of a run, to be merged: parts number, number + of, ..."""

    number: int = 1
    of: int = 1

    def __post_init__(self) -> None:
        """Raises InputError unless 1 <= number <= of."""
        errors.check_count("shard", self.of, at_most=1_000_000)
        errors.check_count("shard", self.number, at_most=self.of)


# --- the run folder ------------------------------------------------------------------------


def open_run(folder: Path, plan: Plan) -> Path:
    """The run folder with the plan in it; a folder that has one must have the same.

    Raises:
      InputError: it cannot be written, or holds a run of another configuration.
    """
    run_folder.claim(folder, plan.configuration())
    return folder


def load_plan(folder: Path) -> Plan:
    """The plan of a run folder.

    Raises:
      InputError: it holds none, or a corrupt one, or one of another version of this code.
    """
    found = run_folder.manifest(folder)
    if "arms" not in found:
        raise InputError(f"run = {folder} is not of a sweep: give the folder of `rps sweep`.")
    try:
        physics: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in found["physics"].items()
        }
        plan = Plan(
            domain.from_json(found["domain"]),
            found["worlds"],
            {name: _params(dict(arm)) for name, arm in found["arms"].items()},
            Setting(Physics(**physics), Rules(**found["rules"]), found["seed"], found["engine"]),
            found["part"],
        )
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise files.corrupt(folder / run_folder.MANIFEST, error) from error
    # What an older version did not write down would else be what this one does by default.
    if (now := json.loads(json.dumps(plan.configuration()))) != found:
        raise InputError(
            f"run = {folder} was made by another version ({run_folder.difference(found, now)}): use "
            "that version."
        )
    return plan


def _params(arm: dict[str, Any]) -> Params:
    name = arm.pop("strategy")
    kinds = {kind.__name__: kind for kind in strategies.STRATEGIES}
    return kinds[errors.check_name("class of parameters", name, kinds)](**arm)


def finished(folder: Path) -> dict[int, Path]:
    """Files of the parts that are done; one whose content is not what was written is set aside."""
    return {int(name): path for name, path in Parts(folder).found().items() if name.isdigit()}


def store(folder: Path, number: int, content: bytes) -> Path:
    """Write the file of a part into a run folder, whole or not at all."""
    return Parts(folder).put(_name(number), content, new=True)


def _name(number: int) -> str:
    return f"{number:07d}"


class _Rows:
    """Outcomes of the trials of a part that is begun, by name."""

    def __init__(self, size: int, like: Outcome):
        self.missing = size
        self.leaves = {
            name: np.empty((size, *leaf.shape[1:]), _TYPES.get(name, np.float32))
            for name, leaf in like._asdict().items()
        }


class _Parts:
    """Trials on their way into the files of their parts."""

    def __init__(self, plan: Plan, keep: Keep):
        self._keep = keep
        self._parts = plan.parts
        self._part_of = np.empty(plan.trials, np.int32)
        for number, trials in plan.parts.items():
            self._part_of[trials] = number
        self._open: dict[int, _Rows] = {}

    def collect(self, numbers: np.ndarray, outcomes: Outcome) -> None:
        """Outcomes of trials that ended; the parts that are complete with them are kept."""
        part_of = self._part_of[numbers]
        for part in map(int, np.unique(part_of)):
            ended = part_of == part
            trials = self._parts[part]
            if part not in self._open:
                self._open[part] = _Rows(trials.size, outcomes)
            rows = self._open[part]
            at = np.searchsorted(trials, numbers[ended])
            for name, leaf in outcomes._asdict().items():
                rows.leaves[name][at] = leaf[ended]
            rows.missing -= at.size
            if not rows.missing:
                self._keep(part, _content(trials, self._open.pop(part).leaves))


def _content(trials: np.ndarray, leaves: dict[str, np.ndarray]) -> bytes:
    """The file of a part."""
    columns: dict[str, Any] = {"trial": ("row", trials)}
    for name, leaf in leaves.items():
        columns[name] = (("row", "pose")[: leaf.ndim], leaf)
    return files.encoded(xr.Dataset(columns))


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
    missing, before = remaining(folder, plan, shard)
    report(Progress(before, 0.0))
    if missing:
        provenance.sign(folder)

    def tell(progress: Progress) -> None:
        report(Progress(before + progress.finished, progress.simulated))

    return work(plan, missing, functools.partial(store, folder), report=tell, **shape)


def work(
    plan: Plan,
    numbers: Mapping[Kind, Iterable[int]],
    keep: Keep,
    *,
    report: Callable[[Progress], Any],
    **shape: Any,
) -> Timing:
    """Run some parts of a plan: of each kind those with these numbers, asked for one by one.

    There are as many slots as the whole plan has use for, whatever parts are run, so that a part
    has the same bits whoever runs it, and with whatever other parts.
    """
    jobs = []
    for kind, some in numbers.items():
        parts = _made(plan, some)
        if isinstance(some, Sequence):  # what is asked for elsewhere is asked for when it is needed
            parts = _ahead(parts)
        jobs.append(Job(strategies.STRATEGIES[kind[1]], plan.sizes[kind], parts))
    collect = _Parts(plan, keep).collect
    return batch.run(jobs, plan.setting, collect=collect, report=report, **shape)


def remaining(folder: Path, plan: Plan, shard: Shard) -> tuple[dict[Kind, list[int]], int]:
    """Parts of a shard that a run folder lacks, by kind, and how many trials it has."""
    done = finished(folder)
    missing: dict[Kind, list[int]] = {}
    before = 0
    for number, trials in share(plan, shard).items():
        if number in done:
            before += trials.size
        else:
            missing.setdefault(plan.kind(number), []).append(number)
    return missing, before


def share(plan: Plan, shard: Shard) -> dict[int, np.ndarray]:
    """The parts of one shard: numbers of their trials, by the part's number."""
    every = plan.parts.items()
    return {n: trials for i, (n, trials) in enumerate(every) if i % shard.of == shard.number - 1}


def _made(plan: Plan, numbers: Iterable[int]) -> Iterator[Part]:
    """The worlds of parts, made one part at a time."""
    for number in numbers:
        trials = plan.parts[number]
        arm, _ = plan.arm_and_object(number)
        yield world_part(plan, arm, trials % plan.worlds)._replace(numbers=trials)


def _ahead(parts: Iterator[Part]) -> Iterator[Part]:
    """The same, each made while what came before it runs."""
    with ThreadPoolExecutor(1) as maker:
        coming = maker.submit(next, parts, None)
        while (part := coming.result()) is not None:
            coming = maker.submit(next, parts, None)
            yield part


def scene_of(plan: Plan, index: int) -> Scene:
    """The compiled scene of one world, for pictures."""
    drawn = domain.draw(plan.domain, plan.setting.seed, [index])
    return drawn_scene(plan.domain, drawn, plan.setting.physics, 0)


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
    return drawn_worlds(plan.domain, drawn, list(plan.arms.values())[arm], plan.setting)


# --- results -------------------------------------------------------------------------------


def merge(folders: list[Path], out: Path) -> Path:
    """One `results.nc` of all parts in run folders of one plan: (arm, world), and (world) drawn.

    `out` becomes a run folder of that plan, if it is not one of these folders.

    Raises:
      InputError: the folders differ in their plan, or parts are missing; `out` cannot be written,
        or holds another run.
    """
    manifest = run_folder.manifest(folders[0])
    for other in folders[1:]:
        if (theirs := run_folder.manifest(other)) != manifest:
            raise InputError(
                f"run = {other} is of another plan than {folders[0]} "
                f"({run_folder.difference(manifest, theirs)}): merge shards of one run."
            )
    plan = load_plan(folders[0])
    kept = {name: part for one in folders for name, part in Parts(one).contents().items()}
    contents = {n: kept[_name(n)] for n in plan.parts if _name(n) in kept}
    if missing := len(plan.parts) - len(contents):
        raise InputError(
            f"run = {', '.join(map(str, folders))} lacks {missing} of {len(plan.parts)} parts: run "
            "the same command again, or give the folders of all shards."
        )
    return files.write_results(open_run(out, plan) / "results.nc", dataset(plan, contents))


def dataset(plan: Plan, contents: Mapping[int, bytes]) -> xr.Dataset:
    """All results of a plan, from the contents of all its parts: (arm, world), and (world) drawn.

    Raises:
      InputError: a part was made by another version of this code.
    """
    every = np.arange(plan.worlds)
    columns = {"which_object": xr.Variable("world", plan.domain.object_of(every).astype(np.int16))}
    for name, (unit, meaning) in tables.UNITS.items():
        dims = ("arm", "world", "pose") if name.endswith("pose") else ("arm", "world")
        shape = (len(plan.arms), plan.worlds, 3)[: len(dims)]
        values = np.zeros(shape, _TYPES.get(name, np.float32))
        columns[name] = xr.Variable(dims, values, {"units": unit, "long_name": meaning})
    for number, content in contents.items():
        arm, _ = plan.arm_and_object(number)
        part = files.decoded(content, f"part {number}")
        if lacking := sorted({"trial", *tables.UNITS} - set(part)):
            raise InputError(
                f"part {number} of the run was made by another version (it lacks "
                f"{', '.join(lacking)}): use that version."
            )
        world = part.trial.values % plan.worlds
        for name in tables.UNITS:
            columns[name].values[arm, world] = part[name].values
        if arm == 0:
            drawn = domain.table(domain.draw(plan.domain, plan.setting.seed, world))
            for name, (values, unit) in drawn.items():
                if name not in columns:
                    empty = np.zeros(plan.worlds, np.float32)
                    columns[name] = xr.Variable("world", empty, {"units": unit})
                columns[name].values[world] = values
    for column in columns.values():
        column.encoding["_FillValue"] = None  # every number is a result
    names = {"arm": list(plan.arms), "object": list(plan.domain.objects), "world": every}
    return xr.Dataset(columns, names)


def write_report(folder: Path) -> Path:
    """`report.md`, `report.html` and the figure of a run folder with results; returns the first."""
    plan, results = load_plan(folder), files.read_results(folder)
    intro = (
        f"{plan.worlds} worlds, seed {plan.setting.seed}, engine {plan.setting.engine}, "
        f"{1000 * plan.setting.physics.timestep:g} ms steps; every arm meets the same worlds. "
        f"Intervals: Wilson 95 %.\n\n{provenance.told(folder)}"
    )
    rates = statistics.rates(results, float(plan.setting.rules.max_lost))
    failures = (
        "CVaR: mean over the worst 5 % of worlds of the least distance between contact point and "
        "target; of an object that was never touched, the whole way."
    )
    if lost := int((results.overflows.values > 0).sum()):
        failures += f" {lost} trials lost contacts for want of room: they are not to be trusted."
    hard = "Worlds in which most arms fail, and most distance is left."
    sections = [Section("Success", failures, rates)]
    if len(plan.arms) > 1:
        sections.append(Section("Differences, world by world", "", statistics.differences(results)))
    if statistics.drawn(results):
        picture = figures.success_curves(results, folder / "success.png")
        sections.append(Section("Success against what was drawn", "", (), picture))
    hardest = statistics.hardest_table(results, str(folder))
    sections.append(Section("The hardest worlds", hard, hardest))
    _write(folder, "Sweep over random worlds", intro, sections)
    return folder / "report.md"
