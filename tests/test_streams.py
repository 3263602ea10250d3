"""Random numbers of worlds by name, and quantities and tasks from outside of the package."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest

import rps_jax
from rps_jax import Domain, InputError, Quantity, Range, engines, register_quantity, register_task
from rps_jax.engines.quasistatic import QuasistaticEngine
from rps_jax.world import domain, draws, points, quantity, tasks
from rps_jax.world.tasks.base import Task
from rps_jax.world.tasks.path import LOOKAHEAD
from rps_jax.world.tasks.path import Path as PathTask
from rps_jax.world.tasks.reach import Reach

INDEX = np.arange(2000)
THRESHOLD = Quantity("1", "threshold of the skin", ge=0.05, le=1, owner="skin")


def test_no_two_names_of_a_world_have_correlated_numbers(registries):
    """The names are those of all quantities, and new ones; tasks share columns."""
    register_quantity("threshold", THRESHOLD)
    register_quantity("max_compression", Quantity("1", "share", ge=0, le=0.99, owner="skin"))
    names = domain.number_names()
    assert {"threshold", "max_compression", "mass", "com_bearing", "corner_3", "route"} <= {*names}
    numbers = draws.numbers(0, INDEX)
    correlation = np.corrcoef([numbers[name] for name in names]) - np.eye(len(names))
    for pair in (("turn_angle_6", "route"), ("width", "scale")):
        i, j = map(names.index, pair)
        assert correlation[i, j] > 0.999
        correlation[i, j] = correlation[j, i] = 0
    assert np.abs(correlation).max() < 0.1
    uniform = np.sort(numbers["threshold"]) - (INDEX + 0.5) / INDEX.size
    assert np.abs(uniform).max() < 1.36 / np.sqrt(INDEX.size)  # Kolmogorov-Smirnov, 5 %


def test_a_new_quantity_is_drawn_independently_of_every_other(registries):
    register_quantity("threshold", THRESHOLD)
    optional = {x: Range(q.low, q.high) for x, q in domain.QUANTITIES.items() if hasattr(Domain, x)}
    optional = {x: r for x, r in optional.items() if getattr(Domain, x) is None}
    others = {"slope_bearing", "boundary", "support"}  # go with slopes, other floors and no feet
    changes = {x: Range(0.3, 0.4) if x == "feet" else r for x, r in optional.items()}
    plain = Domain(("random_prism",), **{x: r for x, r in changes.items() if x not in others})
    full = plain.with_changes({"threshold": Range(0.1, 0.5)})
    old, new = (draws.draw(x, 0, INDEX).values for x in (plain, full))
    assert new.keys() - old.keys() == {"threshold"}
    for name, values in old.items():
        np.testing.assert_array_equal(values, new[name])
        assert abs(np.corrcoef(values, new["threshold"])[0, 1]) < 0.1, name
    assert 0.1 <= new["threshold"].min() < new["threshold"].max() < 0.5


@pytest.mark.parametrize("name", ["mass", "threshold"])
def test_a_number_depends_on_seed_index_and_name_alone(name):
    index = np.array([7, 0, 123_456, 8])
    numbers = quantity.stream(3, name, index)
    for i, value in zip(index, numbers, strict=True):
        assert quantity.stream(np.int64(3), name, np.array([i]))[0] == value
    assert (quantity.stream(4, name, index) != numbers).all()


def test_the_numbers_of_names_are_frozen():
    """Published worlds depend on them; the second name has no column."""
    index = np.array([0, 1, 1000])
    expected = {
        "mass": [0.7337459554446363, 0.23977256769716782, 0.9783784981101183],
        "threshold": [0.056742026178911664, 0.7637135980157267, 0.07944936203022857],
    }
    assert set(quantity.COLUMNS.values()) == set(range(64))
    for name, values in expected.items():
        np.testing.assert_array_equal(quantity.stream(5, name, index), values, name)


def test_a_quantity_of_another_owner_says_what_it_sets(registries):
    def apply(draw, values):
        return draw._replace(robot=draw.robot, velocity_error=draw.velocity_error + values[:, None])

    drift = Quantity("1", "drift of the wheels", ge=0, le=0.5, owner="task", apply=apply)
    register_quantity("drift", drift)
    plain, ranges = Domain(), Domain(custom={"drift": Range(0.2, 0.3)})
    index = np.arange(0, 30, 3)
    added = draws.draw(ranges, 0, index).velocity_error - draws.draw(plain, 0, index).velocity_error
    np.testing.assert_allclose(added.T, [draws.draw(ranges, 0, index).values["drift"]] * 3)
    assert "drift" in points.names(ranges, "range")
    assert "drift" not in points.names(plain)
    with pytest.raises(InputError, match=r"domain drift \(high\) = 0.9 is not allowed"):
        Domain(custom={"drift": Range(0.2, 0.9)})


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"custom": {"treshold": Range(0.1, 0.5)}}, "unknown registered quantity 'treshold'"),
        ({"custom": {"threshold": (0.1, 0.5)}}, "domain custom = "),
        ({"custom": 0.3}, "domain custom = 0.3 is not allowed: give ranges by name"),
        ({"custom": {"threshold": Range(0.5, 0.1)}}, "domain threshold = 0.5 to 0.1"),
        (
            {"custom": {"threshold": Range(0.1, 0.5)}, "skin": "ideal"},
            "its ideal skin leaves no threshold to draw",
        ),
    ],
)
def test_bad_ranges_of_registered_quantities_are_refused(registries, changes, sentence):
    register_quantity("threshold", THRESHOLD)
    with pytest.raises(InputError, match=sentence):
        Domain(**changes)


TAKEN = ["mass", "com_bearing", "corner_3", "feet_number", "key_0", "v_x_error", "velocity_error",
         "route", "turn_angle_2", "width", "objects", "corners", "success", "time"]  # fmt: skip


@pytest.mark.parametrize("name", TAKEN)
def test_a_name_that_another_owner_has_is_refused(registries, name):
    with pytest.raises(InputError, match=f"= {name} is not allowed: .* has this name"):
        register_quantity(name, THRESHOLD)


@pytest.mark.parametrize(
    ("name", "quantity", "sentence"),
    [
        ("threshold", Quantity("m", "another", ge=0, le=1, owner="skin"), "choose another name"),
        ("grip", THRESHOLD, "unknown quantity of the skin 'grip': choose from foam, "),
        ("two words", THRESHOLD, "write a name of Python"),
        ("idler", Quantity("1", "idler", ge=0, le=1, owner="floor"), "without a function `apply`"),
        (
            "noise_2",
            Quantity("1", "noise", ge=0, le=1, owner="skin", numbers=("mass",)),
            "leave numbers out",
        ),
        ("robot_grip", Quantity("1", "grip", ge=0, le=1, owner="robot"), "robot_bandwidth"),
        (
            "robot_force_max",
            Quantity("N", "force", ge=0, le=1, owner="robot"),
            "unknown quantity of the robot 'robot_force_max'",
        ),
    ],
)
def test_a_quantity_without_a_meaning_of_its_own_is_refused(registries, name, quantity, sentence):
    register_quantity("threshold", THRESHOLD)
    register_quantity("threshold", THRESHOLD)  # as a notebook's cell that runs again
    with pytest.raises(InputError, match=sentence):
        register_quantity(name, quantity)


@dataclass(frozen=True)
class Strip(Reach):
    """A task with a quantity."""

    kind: str = "strip"
    grip: Annotated[Range, Quantity("1", "grip", ge=0, le=1, owner="course")] = Range(0, 1)


def test_tasks_claim_the_names_of_their_quantities(registries):
    register_task(Strip)
    register_task(Strip)
    with pytest.raises(InputError, match="= grip is not allowed: the task strip has this name"):
        register_quantity("grip", THRESHOLD)
    drawn = draws.draw(
        domain.parse_domain("wide", task="strip,grip=0.2:0.4"), 0, np.arange(0, 9, 3)
    )
    assert ((drawn.values["grip"] >= 0.2) & (drawn.values["grip"] <= 0.4)).all()
    assert draws.table(drawn)["grip"][1] == "1"

    @dataclass(frozen=True)
    class Heavy(Reach):
        kind: str = "heavy"
        mass: Annotated[Range, Quantity("kg", "mass", ge=0, le=1, owner="course")] = Range(0, 1)

    @dataclass(frozen=True)
    class Shorter(PathTask):
        kind: str = "shorter"
        length: Annotated[Range, Quantity("m", "length", ge=0, le=1, owner="course")] = Range(0, 1)

    @dataclass(frozen=True)
    class Unnamed(Reach):
        kind: str = "path"

    class Same(PathTask):
        kind: str = "same"
        lookahead: Annotated[Range, LOOKAHEAD] = Range(1, 1)

    for bad, sentence in (
        (Heavy, "= mass is not allowed: a domain has this name"),
        (Shorter, "= length is not allowed: "),
        (Unnamed, "kind of the task Unnamed = 'path' is not allowed"),
        (Task, "kind of the task Task = '' is not allowed"),
        ("strip", "task = 'strip' is not allowed: give a dataclass"),
    ):
        with pytest.raises(InputError, match=sentence):
            register_task(bad)
    assert tasks.QUANTITIES["length"].high == 40
    register_task(dataclass(frozen=True)(Same))


def test_engines_are_registered(registries):
    class Slow(QuasistaticEngine):
        name = "slow"

    class Other(QuasistaticEngine):
        name = "fused"

    with pytest.raises(InputError, match="unknown engine 'slow'"):
        rps_jax.Setting("slow")
    engines.register_engine(Slow())
    assert rps_jax.Setting("slow").simulator.name == "slow"
    for bad, sentence in ((Other(), "name of an engine = fused"), (Slow, "engine = <class")):
        with pytest.raises(InputError, match=sentence):
            engines.register_engine(bad)
