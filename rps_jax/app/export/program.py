"""What is exported of a law: its three routines, with the names of all that goes in and out."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.app.export import walk
from rps_jax.app.export.scalars import Node, Scalars
from rps_jax.control import registry, trying
from rps_jax.control.observation import TaxelObservation, Twist
from rps_jax.errors import InputError
from rps_jax.robot import robot as robots
from rps_jax.robot import skin as skins
from rps_jax.robot.skin import LINE, CapacitiveSkin

_REAL: Any = jax.ShapeDtypeStruct((), np.float64)


class Field(NamedTuple):
    """A number or an array of numbers of a group."""

    name: str
    shape: tuple[int, ...]
    kind: str  # f, i or b
    about: str = ""  # unit and meaning
    value: Any = None  # at the start

    @property
    def size(self) -> int:
        """How many numbers."""
        return int(np.prod(self.shape, dtype=int))


Group = tuple[Field, ...]


class Routine(NamedTuple):
    """A pure function of groups of fields, as a jaxpr over all their fields."""

    name: str
    jaxpr: Any
    given: Mapping[str, Group]
    found: Mapping[str, Group]

    def results(self, target: walk.Target, arguments: Sequence[Any]) -> dict[str, list[Any]]:
        """The results of a target, by group."""
        flat = iter(walk.walk(self.jaxpr, arguments, target))
        return {name: [next(flat) for _ in group] for name, group in self.found.items()}

    def scalars(self) -> tuple[Scalars, dict[str, list[list[Node]]]]:
        """The routine as single numbers: of each group the nodes of each field."""
        target = Scalars()
        given = [
            target.inputs(group, one.name, one.shape, one.kind)
            for group, fields in self.given.items()
            for one in fields
        ]
        found = self.results(target, given)
        nodes = {
            group: [list(target.array(value).reshape(-1)) for value in values]
            for group, values in found.items()
        }
        return target, nodes


class Program(NamedTuple):
    """A law with chosen parameters on a robot with a skin."""

    label: str  # of the law
    robot: str
    senses: str
    groups: dict[str, Group]
    init: Routine  # params -> memory
    step: Routine  # params, memory, observation -> memory, twist
    skin_step: Routine  # skin_params, skin, taxels, period -> skin, contact

    @property
    def taxels(self) -> int:
        """How many taxels the skin has."""
        return self.groups["skin"][0].size


def program(law: registry.LawLike, robot: Any = "ideal", skin: Any = "capacitive") -> Program:
    """Trace a law and a skin.

    Raises:
      InputError: there is no such law, robot or skin, or the skin has no taxels.
    """
    label, params = registry.read_law(law)
    params = registry.checked(params)
    of, base = registry.law_of(params), robots.named(robot)
    sensor = skins.named(skin).on(base.shell)
    if not isinstance(sensor, CapacitiveSkin) or not sensor.shell.count:
        raise InputError(
            f"skin = {skin} is not allowed: name one with taxels, as capacitive, on a robot with "
            "boards."
        )
    with jax.enable_x64(True):
        seen = trying.observation_of(of.senses)
        if isinstance(seen, TaxelObservation):
            taxels = jax.ShapeDtypeStruct((sensor.shell.count,), np.float64)
            seen = seen._replace(signal=taxels)
        # Parameters are real numbers, whatever they were written as, as in a trial.
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x), np.float64), params)
        made = jax.eval_shape(of.init, shapes)
        start = of.init(jax.tree.map(lambda x: np.asarray(x, float), params))

    def step(params: Any, memory: Any, seen: Any) -> Any:
        memory, twist, _ = of.step(params, memory, seen)
        return memory, Twist(*twist)

    twist = Twist(_REAL, _REAL, _REAL)
    numbers = {name: getattr(sensor, name) for name in ("time_constant", "threshold")}
    answers = jax.ShapeDtypeStruct((sensor.shell.count,), np.float64)
    groups = {
        "params": fields_of(params, values=params),
        "memory": fields_of(made, values=start),
        "observation": fields_of(seen),
        "twist": fields_of(twist),
        "skin_params": tuple(
            Field(name, (), "f", _ABOUT[name], np.asarray(float(value)))
            for name, value in numbers.items()
        ),
        "skin": (
            Field("signal", answers.shape, "f", "[1] filtered, of each taxel"),
            Field("alive", answers.shape, "b", "0 of a taxel that is to be ignored"),
        ),
        "taxels": (Field("taxels", answers.shape, "f", _ABOUT["taxels"]),),
        "period": (Field("period", (), "f", "[s] since the last step"),),
        "contact": (
            Field("contact_type", (), "i", "0 none, 1 a point, 2 a line"),
            Field("p_robot_contact", (2,), "f", "[m] in the robot frame; 0 without contact"),
            Field("in_contact", (), "b", "whether anything is felt"),
            Field("line", (), "b", "whether the contact is a line"),
            Field("signal", answers.shape, "f", "[1] filtered, 0 of a dead taxel"),
        ),
    }
    return Program(
        label,
        robot if isinstance(robot, str) else "of one's own",
        of.senses,
        groups,
        _routine("init", of.init, groups, ("params",), ("memory",), shapes),
        _routine(
            "step", step, groups, ("params", "memory", "observation"), ("memory", "twist"),
            shapes, made, seen,
        ),
        _routine(
            "skin_step", _skin_step(sensor), groups, ("skin_params", "skin", "taxels", "period"),
            ("signal", "contact"), (_REAL, _REAL), answers,
            jax.ShapeDtypeStruct(answers.shape, bool), answers, _REAL,
        ),
    )  # fmt: skip


_ABOUT = {
    "time_constant": "[s] of the low-pass filter",
    "threshold": "[1] relative change of capacitance that counts as touch",
    "taxels": "[1] relative change of capacitance of each taxel, along the strip",
}


def _skin_step(sensor: CapacitiveSkin) -> Callable[..., Any]:
    """One scan of a real skin."""

    def skin_step(numbers: Any, signal: Any, alive: Any, taxels: Any, period: Any) -> Any:
        time_constant, threshold = numbers
        own = sensor._replace(time_constant=time_constant, threshold=threshold)
        key: Any = jax.ShapeDtypeStruct(
            (2,), np.uint32
        )  # of noise, which a real skin has of its own
        state, reading = own.read(skins.SkinState(key, signal, signal, alive), taxels, period)
        line = reading.contact_type == LINE
        told = jnp.where(alive, state.signal, 0.0)
        return state.signal, (
            reading.contact_type, reading.p_robot_contact, reading.in_contact, line, told
        )  # fmt: skip

    return skin_step


def _routine(
    name: str,
    function: Callable[..., Any],
    groups: Mapping[str, Group],
    given: Sequence[str],
    found: Sequence[str],
    *arguments: Any,
) -> Routine:
    named = {**groups, "signal": groups["skin"][:1]}
    jaxpr, _ = walk.traced(function, *arguments)
    return Routine(name, jaxpr, {n: named[n] for n in given}, {n: named[n] for n in found})


def fields_of(tree: Any, values: Any = None) -> Group:
    """The leaves of a pytree as fields, named by their places."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    starts = jax.tree.leaves(values) if values is not None else [None] * len(leaves)
    found = []
    for (at, leaf), value in zip(leaves, starts, strict=True):
        path = jax.tree_util.keystr(at, simple=True, separator=".")
        name = identifier(path.removeprefix("touch.")) or "value"
        dtype = np.dtype(getattr(leaf, "dtype", np.asarray(leaf).dtype))
        kind = "f" if values is tree else walk.kind_of(dtype)
        value = None if value is None else np.asarray(value)
        found.append(Field(name, tuple(np.shape(leaf)), kind, _about(tree, path), value))
    names = [one.name for one in found]
    errors.check_each_once("names of the law's numbers", names) if names else None
    return tuple(found)


def _about(tree: Any, path: str) -> str:
    """What the comment behind a field in its class says of it."""
    *way, last = path.split(".")
    for step in way:
        tree = getattr(tree, step, None)
    try:
        source = inspect.getsource(type(tree))
    except (OSError, TypeError):
        return ""
    said = re.search(rf"^    {re.escape(last)}:[^#\n]*(?:# noqa\S* \S*)?# *(.*)$", source, re.M)
    return re.sub(r"^(\(\d*T?,?\) |noqa: \S+ +)", "", said[1]).replace("*/", "") if said else ""


def identifier(text: str) -> str:
    """A text as a name of C and JavaScript."""
    name = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_")
    return f"law_{name}" if name[:1].isdigit() else name
