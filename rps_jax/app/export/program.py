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
from rps_jax.app.export.scalars import Node, Scalars
from rps_jax.control import registry, validation
from rps_jax.control.observation import TaxelObservation, Twist
from rps_jax.errors import InputError
from rps_jax.lowering import walk
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

    def scalars(self, compiler: str) -> tuple[Scalars, dict[str, list[list[Node]]]]:
        """The routine as single numbers: of each group the nodes of each field."""
        target = Scalars(compiler)
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
    skin_step: Routine  # skin_params, skin, scan -> filtered, contact

    @property
    def taxels(self) -> int:
        """How many taxels the skin has."""
        return self.groups["skin"][0].size


class SkinParams(NamedTuple):
    """Numbers of a skin."""

    time_constant: Any  # [s] of the low-pass filter
    threshold: Any  # [1] relative change of capacitance that counts as touch


class Skin(NamedTuple):
    """What a skin remembers."""

    signal: Any  # (T,) [1] filtered, of each taxel
    alive: Any  # (T,) 0 of a taxel that is to be ignored


class Scan(NamedTuple):
    """What a skin answers."""

    taxels: Any  # (T,) [1] relative change of capacitance of each taxel, along the strip
    period: Any  # [s] since the last step


class Filtered(NamedTuple):
    """What a scan changes of what a skin remembers."""

    signal: Any  # (T,) [1] filtered, of each taxel


class Contact(NamedTuple):
    """What a skin feels."""

    contact_type: Any  # 0 none, 1 a point, 2 a line
    p_robot_contact: Any  # [m] in the robot frame; 0 without contact
    in_contact: Any  # whether anything is felt
    line: Any  # whether the contact is a line
    signal: Any  # (T,) [1] filtered, 0 of a dead taxel


def program(law: registry.LawLike, robot: Any = "ideal", skin: Any = "capacitive") -> Program:
    """Trace a law and a skin.

    Raises:
      InputError: there is no such law, robot or skin, or the skin has no taxels.
    """
    label, params = registry.resolve_law(law)
    params = registry.check_params(params)
    of, base = registry.law_of(params), robots.named(robot)
    sensor = skins.named(skin).on(base.shell)
    if not isinstance(sensor, CapacitiveSkin) or not sensor.shell.count:
        raise InputError(
            f"skin = {skin} is not allowed: name one with taxels, as capacitive, on a robot with "
            "boards."
        )
    taxels = jax.ShapeDtypeStruct((sensor.shell.count,), np.float64)
    with jax.enable_x64(True):
        seen = validation.observation_shapes(of.senses)
        if isinstance(seen, TaxelObservation):
            seen = seen._replace(signal=taxels)
        # Parameters are real numbers, whatever they were written as, as in a trial.
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x), np.float64), params)
        made = jax.eval_shape(of.init, shapes)
        start = of.init(jax.tree.map(lambda x: np.asarray(x, float), params))

    def step(params: Any, memory: Any, seen: Any) -> Any:
        memory, twist, _ = of.step(params, memory, seen)
        return memory, Twist(*twist)

    def skin_step(numbers: Any, before: Any, scan: Any) -> Any:
        own = sensor._replace(**numbers._asdict())
        key: Any = jax.ShapeDtypeStruct((2,), np.uint32)  # of noise, which a real skin has itself
        state = skins.SkinState(key, before.signal, before.signal, before.alive)
        state, reading = own.read(state, scan.taxels, scan.period)
        line = reading.contact_type == LINE
        told = jnp.where(before.alive, state.signal, 0.0)
        touch = (reading.contact_type, reading.p_robot_contact, reading.in_contact)
        return Filtered(state.signal), Contact(*touch, line, told)

    numbers = SkinParams(*(np.asarray(float(getattr(sensor, x))) for x in SkinParams._fields))
    own = {
        "skin_params": SkinParams(_REAL, _REAL),
        "skin": Skin(taxels, jax.ShapeDtypeStruct(taxels.shape, bool)),
        "scan": Scan(taxels, _REAL),
    }
    given = {"params": shapes, "memory": made, "observation": seen}
    init = routine("init", lambda params: (of.init(params),), {"params": shapes}, ("memory",))
    stepped = routine("step", step, given, ("memory", "twist"))
    felt = routine("skin_step", skin_step, own, ("filtered", "contact"))
    groups = {**stepped.given, **stepped.found, **felt.given, **felt.found}
    for name, tree, values in (
        *(("params", shapes, params), ("memory", made, start)),
        ("skin_params", own["skin_params"], numbers),
    ):
        groups[name] = fields_of(tree, values)
    name = robot if isinstance(robot, str) else "of one's own"
    return Program(label, name, of.senses, groups, init, stepped, felt)


def routine(
    name: str, function: Callable[..., Any], given: Mapping[str, Any], found: Sequence[str]
) -> Routine:
    """A traced function of named pytrees, which returns as many as are named."""
    jaxpr, out = walk.traced(function, *given.values())
    return Routine(
        name,
        jaxpr,
        {key: fields_of(tree) for key, tree in given.items()},
        {key: fields_of(tree) for key, tree in zip(found, out, strict=True)},
    )


def fields_of(tree: Any, values: Any = None) -> Group:
    """The leaves of a pytree as fields, named by their places."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    starts = jax.tree.leaves(values) if values is not None else [None] * len(leaves)
    found = []
    for (at, leaf), value in zip(leaves, starts, strict=True):
        path = jax.tree_util.keystr(at, simple=True, separator=".")
        name = identifier(path.removeprefix("touch.")) or "value"
        dtype = np.dtype(getattr(leaf, "dtype", np.asarray(leaf).dtype))
        value = None if value is None else np.asarray(value)
        found.append(
            Field(name, tuple(np.shape(leaf)), walk.kind_of(dtype), _about(tree, path), value)
        )
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
