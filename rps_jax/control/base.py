"""Types of a control law: its two functions, its parameters, and the bounds for tuning them."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import (
    Annotated,
    Any,
    Generic,
    Literal,
    NamedTuple,
    Protocol,
    TypeVar,
    runtime_checkable,
)

import jax
import numpy as np
from numpy.typing import ArrayLike

from rps_jax.control.observation import Details, Twist
from rps_jax.geometry.arrays import Array, Parameter, Pytree
from rps_jax.robot.base import LoadCell
from rps_jax.robot.robot import DriveKind
from rps_jax.spec import Bound as Bound
from rps_jax.spec import Spec, spec_at, specs_of

# What a law observes in addition to odometry and the target: the contact point (`Observation`),
# the signal of each taxel as well (`TaxelObservation`), the ends of the contact on the front as
# well (`EndsObservation`), the contact force as well (`ForceObservation`), or the object's position
# and size (`PoseObservation`).
Senses = Literal["touch", "taxels", "ends", "force", "pose"]


class Memory(NamedTuple):
    """Mode of a law and the object's place in its state, for pictures and the viewer."""

    mode: str = ""  # in words; empty in a push
    p_world_object: ArrayLike = (np.nan, np.nan)  # (2,) [m] remembered middle; NaN: none


@runtime_checkable
class LawParams(Protocol):
    """Parameters of a law: a pytree of numbers whose class selects the law."""

    @property
    def d_success(self) -> Any:  # a number, or an array in a batch of parameters
        """Distance to the target at which a trial succeeds [m]."""
        ...


class Smoothing(Protocol):
    """Widths of the smoothed switches of a law; hashable."""

    def check(self) -> None:
        """Raise InputError for a width that is not allowed."""


# Parameters of several laws.
SpeedMax = Annotated[Parameter, Spec("m/s", "bound on the speed", gt=0)]
OmegaMax = Annotated[Parameter, Spec("rad/s", "bound on |omega|", gt=0)]
ApproachSpeed = Annotated[Parameter, Spec("m/s", "forward speed before the first contact", 0)]
SuccessDistance = Annotated[Parameter, Spec("m", "target reached", gt=0)]
# State of several laws.
LastContact = Annotated[Array, Spec("m", "the last contact")]  # (2,)
Touched = Annotated[Array, Spec("1", "whether there was a contact")]  # () bool
TimeLost = Annotated[Array, Spec("s", "time since the last contact")]  # ()

T = TypeVar("T")
Leaf = float | np.ndarray | Array  # of a pytree of parameters
Params = TypeVar("Params", bound=LawParams)
State = TypeVar("State")  # a pytree of arrays
Obs = TypeVar("Obs")


def bounds_of(kind: type) -> tuple[tuple[str, Bound], ...]:
    """Return the names of parameters and the intervals of tuners in their declarations."""
    return tuple((name, x.tune) for name, x in specs_of(kind).items() if x.tune is not None)


def nested_bounds(name: str, bounds: Mapping[str, Bound]) -> dict[str, Bound]:
    """Return the bounds of parameters that are the field `name` of others; relative ones last."""
    nested = {}
    for key, bound in sorted(bounds.items(), key=lambda item: bool(item[1].relative_to)):
        whole = f"{name}.{bound.relative_to}" if bound.relative_to else ""
        nested[f"{name}.{key}"] = bound._replace(relative_to=whole)
    return nested


def named_leaves(tree: object, is_leaf: Callable[[object], bool] | None = None) -> dict[str, Leaf]:
    """Return the leaves of a pytree by their paths, such as `gains.k`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree, is_leaf=is_leaf)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def entries(name: str, leaf: Leaf) -> list[tuple[str, tuple[int, ...]]]:
    """Return label and index of each entry of a leaf: `K` of a number, `K[0,1]` of an array."""
    indices = np.ndindex(np.shape(leaf))
    return [(f"{name}[{','.join(map(str, at))}]" if at else name, at) for at in indices]


@jax.tree_util.register_static
@dataclass(frozen=True)
class StaticLeaf:
    """Function in parameters, as an activation of a module; it is part of the program."""

    value: object


def freeze_functions(tree: Pytree) -> Pytree:
    """Replace functions in a pytree by static leaves, so that all of its leaves are numbers."""
    return jax.tree.map(lambda x: StaticLeaf(x) if callable(x) else x, tree)


def thawing(function: Callable[..., Pytree]) -> Callable[..., Pytree]:
    """Return a function that restores the functions in its first argument."""
    is_static = lambda x: isinstance(x, StaticLeaf)  # noqa: E731

    @functools.wraps(function)
    def call(tree: Pytree, *arguments: Pytree, **options: Pytree) -> Pytree:
        tree = jax.tree.map(lambda x: x.value if is_static(x) else x, tree, is_leaf=is_static)
        return function(tree, *arguments, **options)

    return call


def unit_of_leaf(params: object, path: str) -> str:
    """Return the declared unit of a parameter; empty if it has none."""
    declaration = spec_at(params, path)
    return "" if declaration is None else declaration.unit


def check_finite_leaves(tree: T) -> T:
    """Return the pytree if all its leaves are finite and within their declared limits.

    Raises:
      InputError: one is not.
    """
    for name, leaf in named_leaves(tree).items():
        for value in np.ravel(leaf):
            (spec_at(tree, name) or Spec()).check(name, value)
    return tree


@dataclass(frozen=True)
class Law(Generic[Params, State, Obs]):
    """Control law: two pure functions of one world.

    A law is static: each law is compiled to its own program. Its parameters are a pytree of
    numbers, which may be nested, and their class selects the law. Functions in them, as in modules
    of Equinox, are static. The field or property
    `d_success` [m] of the parameters is the distance to the target at which a trial succeeds.
    """

    init: Callable[[Params], State]
    step: Callable[[Params, State, Obs], tuple[State, Twist, Details]]
    senses: Senses = "touch"
    check: Callable[[Params], Params] = check_finite_leaves  # raises InputError for bad params
    # Of the parameters that may be tuned, by name; a registered law has those of its declarations.
    bounds: Mapping[str, Bound] | tuple[tuple[str, Bound], ...] = ()
    # Default widths of the smoothed law, which `init` and `step` accept as the keyword
    # `temperatures`. None: the law has no smooth form.
    temperatures: Smoothing | None = None
    smooth: bool = False  # whether this is the smooth form; it observes `in_contact` as a weight
    cell: LoadCell = LoadCell()  # the sensor of a law that senses force
    drives: tuple[DriveKind, ...] = ("omni",)  # whose bases can follow its twists
    room: float = 0.0  # [m] without walls around the object, for its detours
    # Whether it observes the heading of the goal. Of a goal without a heading, this is the
    # direction from the base's start to the target, or NaN for a law that follows paths.
    heading: bool = False
    follows: bool = False  # whether a law with a heading follows paths, while this is NaN
    # state -> bool: whether the law declares that it is done, which ends the trial.
    is_done: Callable[[State], Array] | None = None
    memory: Callable[[State], Memory] | None = None  # state -> Memory of one trial
    # (params, state, obs, sent twist) -> state, for a law whose state holds its last command.
    observe_sent: Callable[[Params, State, Obs, Twist], State] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "bounds", tuple(dict(self.bounds).items()))  # a law is hashable
