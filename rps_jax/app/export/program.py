"""The exported program of a law: its three routines, with the names of their fields."""

from __future__ import annotations

from pathlib import Path
from string import Template
from typing import Annotated, Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import __version__
from rps_jax.control import registry, validation
from rps_jax.control.observation import Twist, with_base
from rps_jax.errors import not_allowed
from rps_jax.lowering.routine import Group, Pytree, Routine, fields_of, routine
from rps_jax.robot import robot as robots
from rps_jax.robot import skin as skins
from rps_jax.robot.skin import LINE, CapacitiveSkin
from rps_jax.spec import Spec

Leaf: TypeAlias = Any  # an array of JAX or NumPy, or its type
_AXLE = """

/* The base cannot move sideways. Its axle is this far behind its middle [m], whose pose and twist
   are those of the law. The base also drives in reverse, where the skin senses nothing: stop it
   there by a scanner or a bumper. */
"""
_REAL = jax.ShapeDtypeStruct((), np.float64)


class Program(NamedTuple):
    """A law with its parameters, and the skin of a robot."""

    label: str  # of the law
    robot: str
    senses: str
    axle: float | None  # [m] behind the middle, of a base that cannot move sideways
    groups: dict[str, Group]
    init: Routine  # params -> memory
    step: Routine  # params, memory, observation -> memory, twist
    skin_step: Routine  # skin_params, skin, scan -> filtered, contact

    def fill(self, name: str, prefix: str, **values: object) -> str:
        """Return the text of a template of this folder with values for its placeholders."""
        about = {"label": self.label, "robot": self.robot, "version": __version__}
        about |= {"p": prefix, "P": prefix.upper(), "taxels": str(self.taxels)}
        text = Path(__file__).with_name(name).read_text("utf-8")
        return Template(text).substitute(about, **values)

    def about_axle(self, line: str) -> str:
        """Return a line that declares the axle [m], after a comment; nothing without an axle."""
        return "" if self.axle is None else _AXLE + line.format(self.axle)

    @property
    def taxels(self) -> int:
        """Leaf of taxels of the skin."""
        return self.groups["skin"][0].size


class SkinParams(NamedTuple):
    """Parameters of a skin."""

    time_constant: Annotated[Leaf, Spec("s", "time constant of the low-pass filter")]
    threshold: Annotated[Leaf, Spec("1", "relative change of capacitance that counts as touch")]


class Skin(NamedTuple):
    """State of a skin."""

    signal: Annotated[Leaf, Spec("1", "filtered signal of each taxel")]  # (T,)
    alive: Annotated[Leaf, Spec("1", "0 of a taxel that is to be ignored")]  # (T,)


class Scan(NamedTuple):
    """Reading of all taxels."""

    taxels: Annotated[
        Leaf, Spec("1", "relative change of capacitance of each taxel, along the strip")
    ]  # (T,)
    period: Annotated[Leaf, Spec("s", "time since the last step")]


class Contact(NamedTuple):
    """Contact that a skin detects."""

    contact_type: Annotated[Leaf, Spec("1", "type of the contact: 0 none, 1 a point, 2 a line")]
    p_robot_contact: Annotated[
        Leaf, Spec("m", "contact in the robot frame; 0 without contact")
    ]  # (2,)
    in_contact: Annotated[Leaf, Spec("1", "whether there is a contact")]
    line: Annotated[Leaf, Spec("1", "whether the contact is a line")]
    signal: Annotated[Leaf, Spec("1", "filtered signal of each taxel, 0 of a dead one")]  # (T,)
    # Of a law that senses the ends of contacts: see `EndsObservation`.
    alive: Annotated[Leaf, Spec("1", "whether each taxel works")] = None  # (T,)
    ends: Annotated[Leaf, Spec("m", "offsets of the contact's left and right end")] = None  # (2,)
    seen: Annotated[Leaf, Spec("1", "whether the object ends there")] = None  # (2,)
    even: Annotated[Leaf, Spec("1", "whether a face lies flush on the front")] = None
    front: Annotated[Leaf, Spec("m", "distance of the front from the base's middle")] = None


def program(law: registry.LawLike, robot: Any = "ideal", skin: Any = "capacitive") -> Program:
    """Trace a law and a skin.

    Raises:
      InputError: there is no such law, robot or skin, or the skin has no taxels.
    """
    label, params = registry.resolve_law(law)
    params = registry.check_params(params)
    functions, base = registry.law_of(params), robots.parse_robot(robot)
    registry.check_drive(params, base.drive)
    sensor = skins.mounted(skin, base)
    if not isinstance(sensor, CapacitiveSkin) or not sensor.shell.count:
        rule = "name one with taxels, as capacitive, on a robot with boards"
        raise not_allowed("skin", skin, rule)
    taxels = jax.ShapeDtypeStruct((sensor.shell.count,), np.float64)
    with jax.enable_x64(True):
        sizes = sensor.shell.count, functions.heading
        observation = validation.observation_shapes(functions.senses, *sizes)
        # Parameters are reals, as in a trial, even if the user wrote integers.
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x), np.float64), params)
        memory = jax.eval_shape(functions.init, shapes)
        start = functions.init(jax.tree.map(lambda x: np.asarray(x, float), params))

    def step(params: Pytree, memory: Pytree, observation: Pytree) -> tuple[Pytree, Twist]:
        sensed = with_base(observation, base.radius, base)
        memory, twist, _ = functions.step(params, memory, sensed)
        return memory, Twist(*twist)

    def skin_step(skin_params: SkinParams, skin: Skin, scan: Scan) -> tuple[Pytree, Contact]:
        scaled = sensor._replace(**skin_params._asdict())
        key: Any = jax.ShapeDtypeStruct((2,), np.uint32)  # of simulated noise
        state = skins.SkinState(key, skin.signal, skin.signal, skin.alive)
        state, reading = scaled.read(state, scan.taxels, scan.period)
        signal = jnp.where(skin.alive, state.signal, 0.0)
        touch = (reading.contact_type, reading.p_robot_contact, reading.in_contact)
        contact = Contact(*touch, reading.contact_type == LINE, signal)
        if functions.senses == "ends":
            ends = skins.ends_of(signal, skin.alive, base.shell, scaled.threshold)
            contact = contact._replace(alive=skin.alive, **ends._asdict())
        return {"signal": state.signal}, contact

    values = SkinParams(*(np.asarray(float(getattr(sensor, x))) for x in SkinParams._fields))
    skin_inputs = {
        "skin_params": SkinParams(_REAL, _REAL),
        "skin": Skin(taxels, jax.ShapeDtypeStruct(taxels.shape, bool)),
        "scan": Scan(taxels, _REAL),
    }
    inputs = {"params": shapes, "memory": memory, "observation": observation}
    start_step = lambda params: (functions.init(params),)  # noqa: E731
    init = routine("init", start_step, {"params": shapes}, ("memory",))
    law_step = routine("step", step, inputs, ("memory", "twist"))
    touch = routine("skin_step", skin_step, skin_inputs, ("filtered", "contact"))
    groups = {**law_step.inputs, **law_step.outputs, **touch.inputs, **touch.outputs}
    groups |= {
        "params": fields_of(shapes, params),
        "memory": fields_of(memory, start),
        "skin_params": fields_of(skin_inputs["skin_params"], values),
    }
    name = robot if isinstance(robot, str) else "custom"
    axle = None if base.drive == "omni" else float(base.axle_behind)
    return Program(label, name, functions.senses, axle, groups, init, law_step, touch)
