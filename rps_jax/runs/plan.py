"""Plans: all trials of a sweep, which are every law in the same random worlds, and their chunks.

A chunk has trials of one law and one object. One compiled program, named by its `ProgramKey`, runs
all chunks of the same shapes. The manifest of a run folder is the plan as JSON.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import math
import re
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.control import registry
from rps_jax.control.base import LawParams
from rps_jax.errors import InputError, UnknownNameError
from rps_jax.record import files, manifest, provenance
from rps_jax.record import folder as run_folder
from rps_jax.record.files import JsonObject
from rps_jax.record.manifest import Stored
from rps_jax.trials.setting import Setting
from rps_jax.trials.worlds import WorldBatch, drawn_scene, drawn_worlds
from rps_jax.world import draws, points
from rps_jax.world.domain import STORED as STORED_DOMAIN
from rps_jax.world.domain import Domain, name_or_custom, task_attribute
from rps_jax.world.draws import Draw
from rps_jax.world.points import Points
from rps_jax.world.scene import Scene

_REGISTERED = {"engine", "task", "domain object", "domain quantity"}  # kinds of names
_SETTING = Stored(
    lambda name, setting: setting.to_json(),
    lambda name, entries, folder: Setting.from_json(entries),
)
_POINTS = Stored(
    lambda name, at: {} if at is None else {name: at.digest},
    lambda name, entries, folder: None,  # `load_plan` reads their file
)
ProgramKey = tuple[Hashable, ...]  # index of the object, class and shapes of the law's parameters


@dataclass(frozen=True)
class Plan:
    """Trials to run: every law in the worlds 0 to `worlds` - 1 of a domain, or at its `points`.

    Trial a * `worlds` + i is that of law a in world i.
    """

    domain: Annotated[Domain, STORED_DOMAIN]
    worlds: int
    laws: Annotated[Mapping[str, LawParams], registry.STORED_LAWS]
    setting: Annotated[Setting, _SETTING] = Setting()  # its seed draws the worlds, too
    part: int = 1024  # trials of a chunk, at most
    points: Annotated[Points | None, _POINTS] = (
        None  # of the unit cube at which the worlds lie; None: drawn worlds
    )

    def __post_init__(self) -> None:
        errors.check_count("worlds", self.worlds, at_most=1_000_000_000)
        errors.check_count("part", self.part, at_most=1_000_000)
        if not self.laws:
            raise InputError("laws = {} is not allowed: name at least one law.")
        for params in self.laws.values():
            registry.check_params(params)
        if self.points is not None and len(self.points.u) != self.worlds:
            raise InputError(f"worlds = {self.worlds} is not allowed: {len(self.points.u)} points.")

    def check_here(self) -> None:
        """Raise InputError unless the engine can step these worlds on this machine."""
        self.setting.check_domain(self.domain, self.laws.values())

    @property
    def num_trials(self) -> int:
        """Number of trials."""
        return len(self.laws) * self.worlds

    def object_of(self, index: np.ndarray) -> np.ndarray:
        """Return the indices of the domain's objects in the worlds `index`."""
        return self.domain.object_of(points.cases(self.domain, self.points, index))

    @functools.cached_property
    def max_chunks(self) -> int:
        """Number of chunks of one law and one object, at most."""
        worlds_of_objects = np.bincount(self.object_of(np.arange(self.worlds)))
        return math.ceil(worlds_of_objects.max() / self.part)

    @functools.cached_property
    def chunks(self) -> dict[int, np.ndarray]:
        """Indices of the trials of every chunk, by the chunk's number."""
        chunks, objects = {}, self.object_of(np.arange(self.worlds))
        for object_index in range(len(self.domain.objects)):
            worlds = np.flatnonzero(objects == object_index)
            for law in range(len(self.laws)):
                first = (law * len(self.domain.objects) + object_index) * self.max_chunks
                for block, i in enumerate(range(0, worlds.size, self.part)):
                    chunks[first + block] = law * self.worlds + worlds[i : i + self.part]
        return chunks

    def program_key(self, chunk: int) -> ProgramKey:
        """Return the key of the program that runs a chunk."""
        law, object_index = divmod(chunk // self.max_chunks, len(self.domain.objects))
        params = list(self.laws.values())[law]
        return (
            object_index,
            self.domain.task.shape,
            type(params),
            *map(np.shape, jax.tree.leaves(params)),
        )

    def count_trials(self, law: str, world: int) -> int:
        """Return the number of trials of the program that runs a law in a world."""
        row, object_index = list(self.laws).index(law), int(self.object_of(np.asarray(world)))
        key = self.program_key((row * len(self.domain.objects) + object_index) * self.max_chunks)
        return sum(x.size for chunk, x in self.chunks.items() if self.program_key(chunk) == key)

    def configuration(self) -> JsonObject:
        """Return everything that the results depend on, as JSON."""
        return manifest.fields_to_json(self)


@dataclass(frozen=True)
class Shard:
    """Share of a plan: one of `count` equal shares, to be run separately and merged."""

    index: int = 1  # from 1 to `count`
    count: int = 1

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Read a shard written as K/N; raise InputError if it is not valid."""
        match = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", str(text))
        if not match:
            raise InputError(f"shard = {text} is not allowed: write k/n, as 3/8.")
        return cls(int(match[1]), int(match[2]))

    def __post_init__(self) -> None:
        errors.check_count("shard", self.count, at_most=1_000_000)
        errors.check_count("shard", self.index, at_most=self.count)


def shard_chunks(plan: Plan, shard: Shard) -> dict[int, np.ndarray]:
    """Return the chunks of one shard, every `count`-th: indices of their trials, by chunk."""
    return dict(itertools.islice(plan.chunks.items(), shard.index - 1, None, shard.count))


def chunks_by_key(plan: Plan, chunks: Iterable[int]) -> dict[ProgramKey, list[int]]:
    """Return chunks by the program that runs them."""
    groups: dict[ProgramKey, list[int]] = {}
    for chunk in chunks:
        groups.setdefault(plan.program_key(chunk), []).append(chunk)
    return groups


def open_run(folder: Path, plan: Plan) -> Path:
    """Write a plan into a run folder; raise InputError if the folder holds another one."""
    run_folder.claim(folder, plan.configuration())
    if plan.points is not None:
        plan.points.write(folder, plan.domain)
    return folder


def load_plan(folder: Path) -> Plan:
    """Read the plan of a run folder.

    Raises:
      InputError: the folder holds no plan, or one of another version.
    """
    record = run_folder.read_manifest(folder)
    if "laws" not in record:
        raise InputError(f"run = {folder} does not hold a sweep: give the folder of `rps sweep`.")
    try:
        plan = Plan(**manifest.fields_from_json(Plan, record, folder))
    except (LookupError, TypeError, ValueError, ArithmeticError) as error:
        unknown = error.__cause__ or error
        if isinstance(unknown, UnknownNameError) and unknown.kind in _REGISTERED:
            rule = "give the file that registers it before the command, as rps FILE.py replay RUN"
            text = f"unknown {unknown.kind} '{unknown.name}'"
            raise InputError(f"run = {folder} has an {text}: {rule}.") from error
        raise files.CorruptFileError(folder / run_folder.MANIFEST, error) from error
    if "points" in record:
        plan = dataclasses.replace(plan, points=Points.read(folder, str(record["points"])))
    # Options that an older version did not store would otherwise get the defaults of this version.
    current = json.loads(files.json_text(plan.configuration()))
    if words := run_folder.describe_difference(record, current):
        raise InputError(
            f"run = {folder} was written by another version ({words}), "
            f"{provenance.package_version(folder)}: use that one."
        )
    return plan


def attributes_of(plan: Plan) -> dict[str, str | int]:
    """Return seed, engine and domain of a plan, as attributes of results."""
    record = plan.setting.attributes | {"domain": name_or_custom(plan.domain)}
    return record | task_attribute(plan.domain)


def draw(plan: Plan, index: ArrayLike) -> Draw:
    """Draw worlds of one object, by their indices."""
    return points.draw(plan.domain, plan.setting.world_seed, plan.points, index)


def scene_of(plan: Plan, index: int) -> Scene:
    """Compile the scene of one world, for pictures."""
    return drawn_scene(plan.domain, draw(plan, [index]), plan.setting.physics, 0)


def world_title(plan: Plan, index: int) -> str:
    """Return the object and the main drawn quantities of a world, in words."""
    drawn = draws.table(draw(plan, [index]))
    name = plan.domain.objects[int(plan.object_of(np.asarray(index)))].replace("_", " ")
    value = {key: float(values[0]) for key, (values, _) in drawn.items()}
    return (
        f"world {index}: {name}, {value['mass']:.1f} kg, friction ground "
        f"{value['friction_ground']:.2f}, robot {value['friction_robot']:.2f}"
    )


def build_batch(plan: Plan, law: str, index: ArrayLike) -> WorldBatch:
    """Build worlds of one object, by their indices, with the parameters of a law."""
    return drawn_worlds(plan.domain, draw(plan, index), plan.setting).with_params(plan.laws[law])
