"""What a sweep runs: every law, a law with its parameters, in the same random worlds.

Trials are kept in parts, each of one law and one object; parts of one kind are run by one compiled
program.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rps_jax import errors
from rps_jax.control import registry
from rps_jax.control.base import LawParams
from rps_jax.errors import InputError
from rps_jax.record import files, provenance
from rps_jax.record import folder as run_folder
from rps_jax.trials.batch import WorldBatch
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.trials.worlds import drawn_scene, drawn_worlds
from rps_jax.world import domain, draws, points
from rps_jax.world.domain import Domain
from rps_jax.world.draws import Draw
from rps_jax.world.physics import Physics
from rps_jax.world.points import Points
from rps_jax.world.scene import Scene

ProgramKey = tuple[Any, ...]  # of a part: the object's number, and the form of the law's parameters


@dataclass(frozen=True)
class Plan:
    """What is run: every law in the worlds 0 to `worlds` - 1 of a domain, or of its `points`."""

    domain: Domain
    worlds: int
    laws: Mapping[str, LawParams]
    setting: Setting = Setting()  # its seed draws the worlds, too
    part: int = 1024  # trials of a part, at most
    points: Points | None = None  # of the unit cube at which the worlds lie; None: drawn ones

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
        """Raises InputError unless the engine can step these worlds on this machine."""
        self.setting.check_here(self.domain.weakest, self.laws.values())

    @property
    def num_trials(self) -> int:
        """How many: trial a * worlds + i is of law a in world i."""
        return len(self.laws) * self.worlds

    def object_of(self, index: np.ndarray) -> np.ndarray:
        """Which of the domain's objects the worlds `index` have."""
        return self.domain.object_of(points.cases(self.domain, self.points, index))

    @functools.cached_property
    def blocks(self) -> int:
        """Parts of one law and one object, at most."""
        of_objects = np.bincount(self.object_of(np.arange(self.worlds)))
        return math.ceil(of_objects.max() / self.part)

    @functools.cached_property
    def chunks(self) -> dict[int, np.ndarray]:
        """Numbers of the trials of every part, by the part's number."""
        found, objects = {}, self.object_of(np.arange(self.worlds))
        for which in range(len(self.domain.objects)):
            of_object = np.flatnonzero(objects == which)
            for law in range(len(self.laws)):
                for block in range(math.ceil(of_object.size / self.part)):
                    some = of_object[block * self.part : (block + 1) * self.part]
                    number = (law * len(self.domain.objects) + which) * self.blocks + block
                    found[number] = law * self.worlds + some
        return found

    def law_and_object(self, part: int) -> tuple[int, int]:
        """Which law a part is of, and which object."""
        return divmod(part // self.blocks, len(self.domain.objects))

    def program_key(self, part: int) -> ProgramKey:
        """Parts of a kind are run by one compiled program."""
        law, which = self.law_and_object(part)
        params = list(self.laws.values())[law]
        return which, type(params), *map(np.shape, jax.tree.leaves(params))

    @functools.cached_property
    def trials_by_key(self) -> Counter[ProgramKey]:
        """How many trials of each kind there are."""
        counts: Counter[ProgramKey] = Counter()
        for number, trials in self.chunks.items():
            counts[self.program_key(number)] += trials.size
        return counts

    def configuration(self) -> dict[str, Any]:
        """All that the results depend on, as JSON."""
        whole = {
            "domain": dataclasses.asdict(self.domain),
            "worlds": self.worlds,
            "laws": {name: registry.params_to_json(params) for name, params in self.laws.items()},
            "physics": dataclasses.asdict(self.setting.physics),
            "rules": registry.leaves_to_json(self.setting.rules),
            "seed": self.setting.seed,
            "engine": self.setting.engine,
            "part": self.part,
        }
        if self.points is not None:
            whole["points"] = self.points.digest
        return whole


@dataclass(frozen=True)
class Shard:
    """One of several shares of a run, to be merged: parts number, number + of, ..."""

    number: int = 1
    of: int = 1

    @classmethod
    def named(cls, text: str) -> Shard:
        """Read a share written as K/N; InputError if it is none."""
        found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", str(text))
        if not found:
            raise InputError(f"shard = {text} is not allowed: write k/n, as 3/8.")
        return cls(int(found[1]), int(found[2]))

    def __post_init__(self) -> None:
        errors.check_count("shard", self.of, at_most=1_000_000)
        errors.check_count("shard", self.number, at_most=self.of)


def open_run(folder: Path, plan: Plan) -> Path:
    """The run folder with the plan in it; InputError if it holds another one."""
    run_folder.claim(folder, plan.configuration())
    if plan.points is not None:
        plan.points.write(folder, plan.domain)
    return folder


def load_plan(folder: Path) -> Plan:
    """The plan of a run folder; InputError if it holds none, or one of another version."""
    found = run_folder.read_manifest(folder)
    if "arms" in found or "strategies" in found:  # as 0.2.0 called them
        raise InputError(
            f"run = {folder} was made by {provenance.package_version(folder)}: use that version."
        )
    if "laws" not in found:
        raise InputError(f"run = {folder} is not of a sweep: give the folder of `rps sweep`.")
    try:
        plan = Plan(
            domain.from_json(found["domain"]),
            found["worlds"],
            {name: registry.params_from_json(law) for name, law in found["laws"].items()},
            setting_of(found),
            found["part"],
        )
    except (LookupError, TypeError, AttributeError, ValueError, ArithmeticError) as error:
        raise files.CorruptFileError(folder / run_folder.MANIFEST, error) from error
    if "points" in found:
        plan = dataclasses.replace(plan, points=Points.read(folder, str(found["points"])))
    # What an older version did not write down would else be what this one does by default.
    if (now := json.loads(json.dumps(plan.configuration()))) != found:
        raise InputError(
            f"run = {folder} was made by another version "
            f"({run_folder.describe_difference(found, now)}), "
            f"{provenance.package_version(folder)}: use that one."
        )
    return plan


def setting_of(found: Mapping[str, Any]) -> Setting:
    """Read a setting as manifests have it; `question.setting_as_json` is the opposite."""
    physics: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in found["physics"].items()
    }
    rules = Rules(**found["rules"])
    return Setting(found["engine"], Physics(**physics), rules=rules, seed=found["seed"])


def shard_chunks(plan: Plan, shard: Shard) -> dict[int, np.ndarray]:
    """The parts of one shard: numbers of their trials, by the part's number."""
    every = plan.chunks.items()
    return {n: trials for i, (n, trials) in enumerate(every) if i % shard.of == shard.number - 1}


def draw(plan: Plan, index: Any) -> Draw:
    """What is drawn for worlds of one object, by their indices."""
    return points.draw(plan.domain, plan.setting.seed, plan.points, index)


def scene_of(plan: Plan, index: int) -> Scene:
    """The compiled scene of one world, for pictures."""
    return drawn_scene(plan.domain, draw(plan, [index]), plan.setting.physics, 0)


def world_title(plan: Plan, index: int) -> str:
    """What one world is, in words."""
    drawn = draws.table(draw(plan, [index]))
    name = plan.domain.objects[int(plan.object_of(np.asarray(index)))].replace("_", " ")
    value = {key: float(values[0]) for key, (values, _) in drawn.items()}
    return (
        f"world {index}: {name}, {value['mass']:.1f} kg, $\\mu$ ground "
        f"{value['friction_ground']:.2f}, robot {value['friction_robot']:.2f}"
    )


def build_batch(plan: Plan, law: int, index: Any) -> WorldBatch:
    """Worlds of one object, by their indices, with the parameters of a law."""
    return made(plan, law, draw(plan, index))


def made(plan: Plan, law: int, drawn: Draw) -> WorldBatch:
    """The worlds of a draw, with the parameters of a law."""
    params = list(plan.laws.values())[law]
    return drawn_worlds(plan.domain, drawn, plan.setting).with_params(params)
