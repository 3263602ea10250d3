"""Declarations of numbers, and what derives from them."""

import dataclasses
import importlib
import inspect
import math
import pkgutil
import re
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Annotated, NamedTuple

import jax
import numpy as np
import pytest
from helpers import ROOT

import rps_jax
from rps_jax import Details, InputError, Law, Quantity, Spec, Twist, register_law, spec
from rps_jax.app.export import c, program
from rps_jax.control import registry, validation
from rps_jax.control.base import unit_of_leaf
from rps_jax.control.laws.rps import RPSParams
from rps_jax.control.laws.rps_plus import RPSPlusParams
from rps_jax.lowering.routine import fields_of
from rps_jax.record.options import check_fields, option
from rps_jax.spec import Bound, spec_of, specs_of


class Sizes(NamedTuple):
    width: Annotated[float, Spec("m", "width of the base", gt=0, le=2)] = 1.0
    share: Annotated[float, SimpleNamespace(ge=0, lt=1), Spec("1", "share of the width")] = 0.5
    count: int = 3
    angle: Annotated[float | None, Spec("rad", "turn", ge=-math.pi, le=math.inf)] = None


@dataclasses.dataclass(frozen=True)
class Options:
    width: Annotated[float, Spec("m", "width of the base", gt=0, le=2)] = 1.0
    count: Annotated[int, Spec("1", "number of bases", ge=1, le=5)] = 3
    place: Annotated[tuple[float, float], Spec("m", "position", ge=-2, le=2)] = (0.0, 0.0)
    older: float = option(0.5, 0, above=-1, unit="s")


def test_a_declaration_stands_on_the_field_of_any_record():
    assert list(specs_of(Sizes)) == ["width", "share", "angle"]
    assert str(specs_of(Sizes)["width"]) == "[m] width of the base"
    assert specs_of(Sizes)["share"].bounds == {"at_least": 0, "below": 1}  # as annotated_types
    assert specs_of(Options)["older"].bounds == {"at_least": 0, "above": -1, "unit": "s"}
    assert specs_of(Options)["width"] == specs_of(Sizes)["width"]
    assert specs_of(Options)["width"].attributes == {"units": "m", "long_name": "width of the base"}
    assert spec_of(float) is None
    assert spec.document(Sizes).width.__doc__ == "[m] width of the base"


@pytest.mark.parametrize(
    ("record", "sentence"),
    [
        (
            Sizes(width=0),
            "base width = 0 is not allowed: it must be a number and above 0 and at most 2",
        ),
        (Sizes(width=math.nan), "base width = nan is not allowed"),
        (
            Sizes(share=1),
            "base share = 1 is not allowed: it must be a number and at least 0 and below 1",
        ),
        (Sizes(share=-0.1), "base share = -0.1"),
        (Sizes(angle=-4), r"base angle = -4 is not allowed: .* \[rad\]"),
        (Sizes(angle=math.nan), "base angle = nan"),
        (Options(width=3), r"base width = 3 is not allowed: .* at most 2 \[m\]"),
        (Options(count=0), "base count = 0 is not allowed: it must be a whole number from 1 to 5"),
        (Options(place=(0.0, 3.0)), r"base place = 3.0 is not allowed: .* \[m\]"),
        (Options(older=-1), r"base older = -1 is not allowed: .* \[s\]"),
    ],
)
def test_a_number_beyond_its_limits_is_refused(record, sentence):
    check = check_fields if isinstance(record, Options) else spec.check
    with pytest.raises(InputError, match=sentence):
        check(record, "base ")


def test_numbers_at_their_limits_are_allowed():
    assert spec.check(Sizes(2, 0, angle=math.inf)) == Sizes(2, 0, angle=math.inf)
    check_fields(Options(2.0, 5, (-2.0, 2.0), 0.0))


BAD = {
    "a limit above another": ({"ge": 2, "le": 1}, "limits of Spec of 'size' = 2 to 1"),
    "an empty open interval": ({"gt": 1, "le": 1}, "limits of Spec of 'size' = 1 to 1"),
    "a limit that is no number": ({"ge": math.nan}, "limits of Spec of 'size' = nan to inf"),
    "an interval beyond the limits": ({"ge": 0, "tune": Bound(-1, 1)}, "tune of Spec of 'size'"),
    "an interval upside down": ({"tune": Bound(2, 1)}, "tune of Spec of 'size' = 2 to 1"),
    "a logarithm of zero": ({"tune": Bound(0, 1, log=True)}, "tune of Spec of 'size' = 0 to 1"),
    "an unknown unit": ({"unit": "furlong"}, "unit of Spec of 'size' = 'furlong' is not allowed"),
    "an unknown factor": ({"unit": "m/fortnight"}, "unit of Spec of 'size' = 'm/fortnight'"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_declaration_is_refused_where_it_is_written(case):
    keywords, sentence = BAD[case]
    with pytest.raises(InputError, match=re.escape(sentence)):
        Spec(**{"unit": "m", "about": "size"} | keywords)


def test_a_drawn_quantity_has_two_limits_and_a_known_owner():
    with pytest.raises(InputError, match="limits of 'size' = 0 to inf is not allowed"):
        Quantity("m", "size", ge=0)
    with pytest.raises(InputError, match="unknown owner of 'size' 'sky'"):
        Quantity("m", "size", ge=0, le=1, owner="sky")


def test_units_are_products_and_quotients_of_known_symbols():
    for unit in ("", "1", "m/s^2", "kg m^2", "m, m, rad", "N m", "m/s/N", "1/m", "rad^2"):
        Spec(unit, "size")


def test_annotations_that_cannot_be_evaluated_are_refused_if_they_declare():
    class Plain(NamedTuple):
        v: "Unknown" = 1.0  # noqa: F821  # pyright: ignore

    class Declared(NamedTuple):
        v: "Annotated[Unknown, 1]" = 1.0  # noqa: F821  # pyright: ignore

    assert specs_of(Plain) == {}
    with pytest.raises(InputError, match="the annotations of Declared cannot be evaluated"):
        specs_of(Declared)


# --- laws --------------------------------------------------------------------------------------


def test_every_number_of_every_law_has_unit_and_meaning():
    """The C header, the module and the model of a law print them; studies may add other laws."""
    offered = registry.LAWS | registry._HIDDEN
    ours = "rps_jax."
    laws = [(name, x) for name, x in offered.items() if type(x).__module__.startswith(ours)]
    records = [program.SkinParams, program.Skin, program.Scan, program.Contact, Twist, Details]
    for senses in ("touch", "taxels", "ends", "force", "pose"):
        observation = validation.observation_shapes(senses, heading=True)
        assert all(re.match(r"\[.+\] \S", x.about) for x in fields_of(observation)), senses
    for kind in records:
        assert all(re.match(r"\[.+\] \S", str(specs_of(kind)[name])) for name in kind._fields)
    for name, params in laws:
        memory = jax.eval_shape(registry.law_of(params).init, params)
        for field in (*fields_of(params), *fields_of(memory)):
            assert re.match(r"\[.+\] \S", field.about), (name, field.name)
    assert len(laws) > 10


def test_the_header_has_unit_and_meaning_at_each_field():
    text = c.header(program.program("rps_plus"), "law")
    structs = re.findall(r"typedef struct \{(.*?)\}", text, re.DOTALL)
    lines = [line for struct in structs for line in struct.strip().splitlines() if ";" in line]
    assert len(lines) > 45
    assert [line for line in lines if not re.search(r"/\* .*\[.+\] \S.*\*/", line)] == []


class Gains(NamedTuple):
    k: Annotated[float, Spec("1/s", "gain", gt=0, le=5, tune=Bound(0.1, 2))] = 1.0
    d_success: float = 0.05


def test_a_custom_law_is_checked_and_tuned_by_its_declarations(registries):
    law = Law(
        lambda params: (),
        lambda p, state, obs: (state, Twist(p.k, 0.0, 0.0), Details.from_obs(obs)),
    )
    register_law("gains", law, Gains())
    assert dict(registry.law_of(Gains).bounds) == {"k": Bound(0.1, 2)}
    assert unit_of_leaf(Gains(), "k") == "1/s"
    assert unit_of_leaf(Gains(), "d_success") == ""
    with pytest.raises(InputError, match=r"k = 6.0 is not allowed: .* at most 5 \[1/s\]"):
        registry.resolve_laws("gains,k=6")
    assert [field.about for field in fields_of(Gains())] == ["[1/s] gain", ""]


def test_declared_limits_hold_for_nested_parameters():
    assert unit_of_leaf(RPSPlusParams(), "law.K_v") == "1/s"
    with pytest.raises(
        InputError, match=r"rps\.K_h = 0 is not allowed: it must be a number and above 0"
    ):
        registry.check_params(RPSPlusParams(law=RPSParams(K_h=0)))
    assert registry.check_params(RPSParams(gamma_max=math.inf)).gamma_max == math.inf


# --- the package ---------------------------------------------------------------------------------


def records() -> Iterator[type]:
    """Yield the classes of the package that may have declarations."""
    for module in pkgutil.walk_packages(rps_jax.__path__, "rps_jax."):
        if not module.name.endswith("__main__"):
            for kind in vars(importlib.import_module(module.name)).values():
                if inspect.isclass(kind) and kind.__module__ == module.name:
                    yield kind


def test_defaults_are_within_their_limits():
    count = 0
    for kind in records():
        for name, declaration in specs_of(kind).items():
            default = getattr(kind, "_field_defaults", vars(kind)).get(name)
            if default is not None and not isinstance(default, Annotated.__class__):
                values = np.ravel(np.asarray(default, object)) if np.ndim(default) else [default]
                for value in values:
                    if isinstance(value, int | float) and not isinstance(value, bool):
                        declaration.check(f"{kind.__name__}.{name}", value)
                        count += 1
    assert count > 150


def test_no_source_text_of_a_law_or_record_is_read():
    folders = ("control", "lowering", "robot", "world", "record")
    files = [x for name in folders for x in (ROOT / "rps_jax" / name).rglob("*.py")]
    assert [x for x in files if "getsource" in x.read_text()] == []
