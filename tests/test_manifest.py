"""Manifests: the type of a field writes and reads it, and questions know no field by name."""

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import pytest
from helpers import PLAN

from rps_jax import RPSParams, Setting
from rps_jax.record import manifest
from rps_jax.record.manifest import Stored
from rps_jax.record.options import option
from rps_jax.runs.plan import Plan
from rps_jax.runs.question import LawQuestion, Question
from rps_jax.runs.sweep import Sweep
from rps_jax.world.domain import DomainLike

CELSIUS = Stored(
    lambda name, kelvin: {f"{name}_celsius": kelvin - 273},
    lambda name, entries, folder: entries[f"{name}_celsius"] + 273,
    kinds=(int,),
    label=lambda kelvin: f"{kelvin} K",
)
Temperature = Annotated[int, CELSIUS]


@dataclass(frozen=True)
class Oven(Question[Any]):
    """Custom question with a custom type of field."""

    RENAMED = {"heat": "power"}  # noqa: RUF012
    IGNORED_FIELDS = ("colour",)

    inside: Temperature = 300
    walls: Temperature | None = None
    zones: tuple[Temperature, ...] = (280, 290)
    power: float = option(2.0, 0, 10)
    colour: str = "red"


@dataclass(frozen=True)
class _Room:
    inside: Temperature
    floor: float


def test_the_type_of_a_field_writes_it_and_labels_results():
    record = Oven(walls=373).configuration()
    expected = {"question": "oven", "inside_celsius": 27, "walls_celsius": 100, "heat": 2.0}
    assert record == expected | {"zones": [280, 290]}
    assert Oven().configuration()["walls"] is None
    assert manifest.labels(Oven()) == {"inside": "300 K", "zones": "280 K 290 K"}


def test_the_type_of_a_field_reads_what_it_has_written():
    room = _Room(295, 4.0)
    entries = json.loads(json.dumps(manifest.fields_to_json(room)))
    assert entries == {"inside_celsius": 22, "floor": 4.0}
    assert _Room(**manifest.fields_from_json(_Room, entries, Path())) == room


def test_options_of_an_execution_are_not_in_a_manifest():
    options = {"slots": 3, "workers": 2, "overwrite": True, "out": "x", "progress": False}
    assert LawQuestion(**options).configuration() == LawQuestion().configuration()
    assert not set(options) & set(LawQuestion().configuration())


@pytest.mark.parametrize("law", ["rps_tuned", RPSParams.tuned()], ids=["text", "parameters"])
def test_a_law_is_stored_by_its_parameters(law):
    stored = LawQuestion(law=law).configuration()["law"]
    assert stored == {"law": "RPSParams", **RPSParams.tuned()._asdict()}


def test_a_plan_is_read_as_it_was_written():
    entries = json.loads(json.dumps(PLAN.configuration()))
    names = ["domain", "engine", "laws", "part", "physics", "rules", "seed", "worlds"]
    assert sorted(entries) == names
    assert Plan(**manifest.fields_from_json(Plan, entries, Path())) == PLAN


def test_plan_and_sweep_share_the_types_of_their_fields():
    of_sweep, of_plan = map(manifest.stored_types, (Sweep, Plan))
    shared = {f.name for f in fields(Sweep)} & {f.name for f in fields(Plan)}
    assert shared == {"domain", "worlds", "laws", "setting", "part", "points"}
    assert all(of_sweep[name] is of_plan[name] for name in ("domain", "laws"))
    assert Sweep(setting=Setting(seed=3)).configuration()["seed"] == 3
    assert DomainLike.__metadata__[0] is of_plan["domain"]
